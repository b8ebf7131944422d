"""Scenes of blocks: whole, in part, as far as a camera sees them, and with damaged blocks."""

import io
import json

import numpy as np
import pytest
from conftest import CONFORMANCE
from test_decode import digest, morton, parameters
from test_render import read_png

import b2p

SCENES = CONFORMANCE / "scenes"
SUITE = [line for line in (SCENES / "suite.txt").read_text().splitlines() if "/" not in line.split(" ")[0]]
BALL = SCENES / "ball.b2p"


def damaged(block):
    """The ball with a bit of a block changed."""
    data = bytearray(BALL.read_bytes())
    entry = b2p.info(BALL)["blocks"][block]
    data[entry["offset"] + entry["bytes"] - 1] ^= 1
    return bytes(data)


@pytest.mark.parametrize("line", SUITE, ids=lambda line: line.split(" ")[0])
def test_scenes_of_the_conformance_suite_decode_to_their_digests(line):
    name, *levels = line.split(" ")
    for source in (SCENES / f"{name}.b2p", (SCENES / f"{name}.b2p").read_bytes()):
        for entry in levels:
            level, digests = entry.split("=")
            points = b2p.decode_points(source, level=int(level))
            gaussians = b2p.decode(source, level=int(level), heads="surfels")
            found = [digest(morton(points.voxels)), digest(points.rgb), digest(*parameters(gaussians))]
            assert found == digests.split(","), f"{name}, level {level}"
            assert gaussians.level == int(level)


def test_a_cloud_that_is_coded_in_blocks_decodes_to_the_points_of_one_piece(cloud):
    options = {"bits": 7, "lossless": True, "levels": (4, 7), "effort": 0}
    scene, stream = b2p.encode(*cloud, **options, block_size=2000), b2p.encode(*cloud, **options, blocks=False)
    assert len(b2p.info(scene)["blocks"]) > 1 and "blocks" not in b2p.info(stream)
    of_scene, of_stream = b2p.decode_points(scene), b2p.decode_points(stream)
    assert np.array_equal(of_scene.voxels, of_stream.voxels) and np.array_equal(of_scene.rgb, of_stream.rgb)
    for wrong in [{"block_size": 0}, {"block_size": 9, "blocks": False}]:
        with pytest.raises(b2p.UsageError, match="block_size"):
            b2p.encode(*cloud, **wrong)


def test_a_box_of_a_scene_has_the_points_and_gaussians_in_it():
    low, high = (3.0, -1.0, 2.5), (17.5, 40.0, 20.0)
    xyz, rgb = b2p.decode_points(BALL)
    inside = np.all((xyz >= low) & (xyz <= high), axis=1)
    assert 0 < inside.sum() < len(xyz)
    part = b2p.decode_points(BALL, box=(low, high))
    assert np.array_equal(part.xyz, xyz[inside]) and np.array_equal(part.rgb, rgb[inside])
    whole, some = b2p.decode(BALL, heads="surfels"), b2p.decode(BALL, heads="surfels", box=(low, high))
    assert np.array_equal(some.positions, whole.positions[inside])
    with pytest.raises(b2p.UsageError, match="no voxel"):
        b2p.decode(BALL, box=((900, 0, 0), (901, 1, 1)))


def test_what_a_camera_sees_makes_the_picture_of_the_whole_scene(program, tmp_path):
    camera = b2p.Camera.orbit(20, 10, 2.4)
    whole = b2p.decode(BALL, heads="surfels")
    seen = b2p.decode(BALL, heads="surfels", camera=camera)
    assert len(seen) <= len(whole)
    pictures = [b2p.render(scene, camera, 64, 64, **how) for scene, how in
                [(whole, {}), (seen, {}), (BALL, {"heads": "surfels"}), (BALL.read_bytes(), {"heads": "surfels"})]]
    for picture in pictures[1:]:
        assert np.abs(picture.astype(int) - pictures[0]).max() <= 1
    coarse = b2p.decode(BALL, heads="surfels", camera=b2p.Camera.orbit(20, 10, 9), lod=40.0)
    assert len(coarse) < len(whole) and coarse.level is None
    out = tmp_path / "a.png"
    program("render", BALL, "-o", out, "--size", "64x64", "--orbit", "20,10,2.4", "--heads", "surfels")
    assert np.array_equal(pictures[2], read_png(out)[..., :3])
    program("render", BALL, "-o", out, "--size", "64x64", "--force", "--lod", "3")
    assert np.array_equal(b2p.render(BALL, width=64, height=64, lod=3.0), read_png(out)[..., :3])


@pytest.mark.parametrize("piece", [7, 1000, 1 << 20])
def test_a_scene_that_arrives_gives_its_levels_when_all_of_it_is_there(piece):
    data = BALL.read_bytes()
    pieces = [data[at : at + piece] for at in range(0, len(data), piece)]
    found = [(level.number, digest(level.points().rgb), len(level.gaussians()))
             for level in b2p.open(pieces, heads="surfels")]
    expected = [(n, digest(b2p.decode_points(BALL, level=n).rgb), len(b2p.decode(BALL, level=n, heads="surfels")))
                for n in (3, 4, 5)]
    assert found == expected
    assert [level.number for level in b2p.open(io.BytesIO(data), level=4)] == [3, 4]
    stream = b2p.Stream(heads="surfels")
    stream.push(data[:-1])
    assert stream.advance() is None and stream.level is None and not stream.is_drawable
    with pytest.raises(b2p.TruncatedError):
        stream.finish()
    with pytest.raises(b2p.UsageError, match="no level"):
        stream.gaussians()
    stream.push(data[-1:] + b"more")
    assert stream.advance() == 3 and stream.is_drawable and not stream.is_complete


def test_a_damaged_block_is_an_error_or_with_partial_a_warning():
    data = damaged(2)
    for decode in (b2p.decode, b2p.decode_points):
        with pytest.raises(b2p.MalformedError, match="block 2") as raised:
            decode(data)
        assert (raised.value.block, raised.value.clause) == (2, "18.2.4")
        with pytest.warns(b2p.InputWarning, match="block 2"):
            rest = decode(data, partial=True)
        assert 0 < len(rest) < len(decode(BALL))
    with pytest.raises(b2p.MalformedError, match="block 2"):
        b2p.render(data, width=32, height=32)


def test_limits_hold_for_scenes():
    with pytest.raises(b2p.LimitExceeded) as raised:
        b2p.decode(BALL, limits=b2p.Limits(max_bytes=50_000))
    assert raised.value.option == "max_bytes"
    with pytest.raises(b2p.LimitExceeded):
        list(b2p.open([BALL.read_bytes()], limits=b2p.Limits(max_bytes=1000)))


def test_parts_are_asked_for_of_scenes_alone_and_in_one_way(scene):
    box, camera = ((0, 0, 0), (9, 9, 9)), b2p.Camera.orbit(0, 0)
    for how in ({"box": box}, {"camera": camera}):
        with pytest.raises(b2p.UsageError, match="scenes of blocks"):
            b2p.decode(scene, **how)
    with pytest.raises(b2p.UsageError, match="one of them"):
        b2p.decode(BALL, box=box, camera=camera)
    for how in ({"lod": 2.0}, {"lod": -1.0, "camera": camera}, {"lod": float("nan"), "camera": camera}):
        with pytest.raises(b2p.UsageError, match="lod"):
            b2p.decode(BALL, **how)


def test_a_scene_is_described_as_by_the_program(program):
    theirs, ours = json.loads(program("info", BALL, "--json")), b2p.info(BALL)
    for name in ("bits", "levels", "points", "voxels", "origin", "voxel_size", "blocks"):
        assert ours[name] == theirs[name]
    assert ours["total_bytes"] == len(BALL.read_bytes()) and ours["up"] == "z"
