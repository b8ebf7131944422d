"""Pictures: to the bit those of the program, and cameras that mean what they say."""

import json
import struct
import zlib

import numpy as np
import pytest
from conftest import ROOT

import b2p

SCENE = ROOT / "models" / "scene.b2p"


def read_png(path):
    """The pixels of a PNG of eight bits a channel with alpha, all of whose filters are undone."""
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, packed = 8, b""
    while at < len(data):
        (length,), kind = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        body = data[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", body)
            assert (depth, colour, interlaced) == (8, 6, 0)
        if kind == b"IDAT":
            packed += body
        at += 12 + length
    rows = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(height, 1 + 4 * width)
    picture = np.zeros((height, 4 * width), np.int64)
    above = np.zeros(4 * width, np.int64)
    for y in range(height):
        kind, row = rows[y, 0], rows[y, 1:].astype(np.int64)
        if kind in (0, 2):
            row = row + (above if kind == 2 else 0)
        else:
            for x in range(4 * width):
                a, b = (row[x - 4] if x >= 4 else 0), above[x]
                c = above[x - 4] if x >= 4 else 0
                p = a + b - c
                nearest = min((abs(p - a), 0, a), (abs(p - b), 1, b), (abs(p - c), 2, c))[2]
                row[x] = (row[x] + {1: a, 3: (a + b) // 2, 4: nearest}[int(kind)]) & 255
        above = picture[y] = row & 255
    return picture.reshape(height, width, 4).astype(np.uint8)


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ([], {}),
        (["--orbit", "30,20"], {"camera": b2p.Camera.orbit(30, 20)}),
        (["--orbit", "30,20,2.6"], {"camera": b2p.Camera.orbit(30, 20, 2.6)}),
        (["--orbit=-10,5", "--orthographic", "--background", "black"],
         {"camera": b2p.Camera.orbit(-10, 5, orthographic=True), "background": "black"}),
        (["--orbit", "10,0,2", "--fov", "30", "--up", "z", "--background", "#102030"],
         {"camera": b2p.Camera.orbit(10, 0, 2, fov=30, up="z"), "background": "#102030"}),
        (["--background", "transparent", "--heads", "surfels"], {"background": "transparent", "heads": "surfels"}),
        (["--level", "7", "--heads", "quick", "--quality", "fast"], {"level": 7, "heads": "quick", "quality": "fast"}),
        (["--effect", "antialias=on"], {"effects": {"antialias": True}}),
    ],
)
def test_pictures_are_to_the_bit_those_of_the_program(program, tmp_path, words, options):
    out = tmp_path / "a.png"
    program("render", SCENE, "-o", out, "--size", "96x64", *words)
    picture = b2p.render(SCENE, width=96, height=64, **options)
    theirs = read_png(out)
    if options.get("background") != "transparent":
        assert np.all(theirs[..., 3] == 255)
        theirs = theirs[..., :3]
    assert picture.dtype == np.uint8 and picture.shape == theirs.shape
    assert np.array_equal(picture, theirs)


def test_a_picture_of_gaussians_is_that_of_their_stream(scene):
    camera = b2p.Camera.orbit(40, 10)
    gaussians = b2p.decode(scene, level=7)
    assert np.array_equal(
        b2p.render(gaussians, camera, 64, 64), b2p.render(scene, camera, 64, 64, level=7)
    )


def test_floats_are_what_bytes_are_rounded_from(scene_gaussians):
    camera = b2p.Camera.orbit(0, 10)
    for background, channels in [("transparent", 4), ((0.2, 0.4, 0.6), 3)]:
        floats = b2p.render(scene_gaussians, camera, 48, 32, background=background, dtype="float32")
        rounded = b2p.render(scene_gaussians, camera, 48, 32, background=background)
        assert floats.dtype == np.float32 and floats.shape == rounded.shape == (32, 48, channels)
        if channels == 3:
            assert np.abs(np.clip(floats, 0, 1) * 255 - rounded).max() <= 0.5 + 1e-4


def test_channels_agree_with_each_other(scene_gaussians):
    g = scene_gaussians
    camera = b2p.Camera.orbit(0, 0, 4)
    draw = lambda channel: b2p.render(g, camera, 40, 30, channel=channel)
    alpha, depth, normal, ids = map(draw, ["alpha", "depth", "normal", "ids"])
    assert alpha.shape == depth.shape == ids.shape == (30, 40) and normal.shape == (30, 40, 3)
    assert alpha.dtype == depth.dtype == normal.dtype == np.float32 and ids.dtype == np.int32
    nothing = alpha == 0
    assert nothing.any() and (ids >= 0).any() and ids.max() < len(g)
    assert np.isinf(depth[nothing]).all() and (normal[nothing] == 0).all()
    solid = (alpha > 0.99) & (ids >= 0)
    # Four units from the middle of the cube along z: a pixel is about as far as the Gaussian that it shows most of.
    expected = (4 - g.positions[ids[solid], 2]) * g.unit
    assert np.median(np.abs(depth[solid] - expected)) < 0.05 * g.unit
    assert (normal[solid, 2] < 0).mean() > 0.9


def test_matrices_of_every_convention_are_the_same_camera(scene_gaussians):
    g = scene_gaussians
    middle = np.array(g.origin) + g.unit
    distance = 3 * g.unit
    # In front of the object, looking along −z, with y up.
    to_world = np.eye(4)
    to_world[:3, 3] = middle + [0, 0, distance]
    flipped = to_world @ np.diag([1, -1, -1, 1])
    focal = 32 / np.tan(np.radians(22.5))
    wanted = b2p.render(g, b2p.Camera.orbit(0, 0, 3), 64, 48, dtype="float32")
    cameras = [
        b2p.Camera.from_matrix(to_world, 45, convention="opengl", kind="camera_to_world"),
        b2p.Camera.from_matrix(flipped, fov=45, kind="camera_to_world"),
        b2p.Camera.from_matrix(np.linalg.inv(flipped), fov=45),
        b2p.Camera.from_matrix(np.linalg.inv(to_world)[:3], fov=45, convention="opengl"),
        b2p.Camera.from_matrix(np.linalg.inv(flipped), intrinsics=[focal, focal, 32, 24]),
        b2p.Camera.from_matrix(
            np.linalg.inv(flipped), intrinsics=[[focal, 0, 32], [0, focal, 24], [0, 0, 1]], size=(64, 48)
        ),
    ]
    for camera in cameras:
        assert np.abs(b2p.render(g, camera, 64, 48, dtype="float32") - wanted).max() < 2e-3
    assert b2p.render(g, cameras[-1]).shape == (48, 64, 3)
    with pytest.raises(b2p.UsageError, match="not of 10×10"):
        b2p.render(g, cameras[-1], 10, 10)


def test_what_is_no_camera_is_refused():
    eye = np.eye(4)
    for arguments, options in [
        ((eye,), {}),
        ((eye, 45, [1, 1, 1, 1]), {}),
        ((eye, 0), {}),
        ((eye, 180), {}),
        ((eye * 2, 45), {}),
        ((np.diag([1, 1, -1, 1]), 45), {}),
        ((np.full((4, 4), np.nan), 45), {}),
        ((np.eye(3), 45), {}),
        ((eye + [[0], [0], [0], [1]], 45), {}),
        ((eye, 45), {"convention": "maya"}),
        ((eye, 45), {"kind": "sideways"}),
        ((eye, 45), {"near": -1}),
        ((eye,), {"intrinsics": [[1, 5, 1], [0, 1, 1], [0, 0, 1]]}),
        ((eye,), {"intrinsics": [0, 1, 1, 1]}),
    ]:
        with pytest.raises(b2p.UsageError):
            b2p.Camera.from_matrix(*arguments, **options)
    for arguments in [(float("nan"), 0), (0, 0, float("inf"))]:
        with pytest.raises(b2p.UsageError):
            b2p.Camera.orbit(*arguments)
    with pytest.raises(b2p.UsageError):
        b2p.Camera.orbit(fov=200)


def test_cameras_of_files_are_those_of_the_program(program, tmp_path, scene_gaussians):
    g = scene_gaussians
    eye = np.eye(4)
    eye[:3, 3] = np.array(g.origin) + g.unit + [0, 0, 3 * g.unit]
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({
        "camera_angle_x": 0.8, "w": 64, "h": 48,
        "frames": [{"file_path": name, "transform_matrix": eye.tolist()} for name in ("a", "b")],
    }))
    cameras = b2p.Camera.load(file)
    assert [camera.name for camera in cameras] == ["a", "b"]
    program("render", SCENE, "-o", tmp_path / "out.png", "--camera", file, "--level", "7")
    theirs = read_png(tmp_path / "out-001.png")
    assert np.array_equal(b2p.render(SCENE, cameras[1], level=7), theirs[..., :3])
    with pytest.raises(b2p.NotFoundError):
        b2p.Camera.load(tmp_path / "none.json")
    (tmp_path / "bad.json").write_text("{}")
    with pytest.raises(b2p.UsageError):
        b2p.Camera.load(tmp_path / "bad.json")


def test_what_cannot_be_drawn_is_refused(scene_gaussians):
    g = scene_gaussians
    for options in [
        {"width": 8},
        {"width": 8, "height": 0},
        {"channel": "smell"},
        {"dtype": "int8"},
        {"background": "mauve"},
        {"background": (0, 0, float("nan"))},
        {"effects": {"glow": True}},
        {"effects": {"near": "maybe"}},
        {"quality": "best"},
        {"level": 3},
        {"heads": "surfels"},
    ]:
        with pytest.raises(b2p.UsageError):
            b2p.render(g, **options)
    with pytest.raises(b2p.LimitExceeded) as caught:
        b2p.render(g, width=1 << 20, height=1 << 20)
    assert caught.value.option == "max_pixels"
