"""Files of points and Gaussians, read and written."""

import numpy as np
import pytest

import b2p

POINTS = [".ply", ".las", ".laz", ".pcd", ".e57", ".xyz"]
SPLATS = {
    ".ply": 1e-6,
    ".compressed.ply": 2e-3,
    ".spz": 1e-2,
    ".sog": 2e-2,
    ".splat": 1e-5,
    ".glb": 1e-5,
    ".gltf": 1e-5,
    ".csv": 1e-5,
    ".npz": 1e-6,
}


def read(path):
    """What a file holds. Of text without a title, what columns hold is guessed."""
    if path.suffix != ".xyz":
        return b2p.read(path)
    with pytest.warns(b2p.InputWarning, match="x y z red green blue"):
        return b2p.read(path)


@pytest.mark.parametrize("ending", POINTS)
def test_decoded_points_are_written_and_read(scene, tmp_path, ending):
    points = b2p.decode_points(scene, level=7)
    path = tmp_path / f"a{ending}"
    b2p.write(path, points)
    again = read(path)
    assert isinstance(again, b2p.PointCloud)
    assert np.allclose(np.sort(again.xyz, axis=0), np.sort(points.xyz, axis=0), atol=0.01 * points.voxel_size)
    assert np.array_equal(again.rgb, points.rgb)


@pytest.mark.parametrize("ending", POINTS)
def test_points_on_no_grid_are_written_within_a_millionth_of_their_extent(cloud, tmp_path, ending):
    xyz, rgb = cloud
    path = tmp_path / f"a{ending}"
    b2p.write(path, (xyz, rgb))
    again = read(path)
    if ending == ".ply":
        assert np.array_equal(again.xyz, xyz) and np.array_equal(again.rgb, rgb)
    # Where the torus closes, points coincide: within the same voxel they become one.
    assert len(xyz) - 200 <= len(again) <= len(xyz)
    for axis in range(3):
        assert np.abs(np.quantile(again.xyz[:, axis], [0, 1]) - np.quantile(xyz[:, axis], [0, 1])).max() < 1e-5


@pytest.mark.parametrize("ending", SPLATS)
def test_gaussians_are_written_and_read(scene_gaussians, tmp_path, ending):
    path = tmp_path / f"a{ending}"
    b2p.write(path, scene_gaussians)
    again = b2p.read(path)
    assert isinstance(again, b2p.Gaussians) and len(again) == len(scene_gaussians)
    off = np.sort(again.world_positions, axis=0) - np.sort(scene_gaussians.world_positions, axis=0)
    assert np.abs(off).max() < SPLATS[ending] * 2 * scene_gaussians.unit


def test_a_file_keeps_what_a_cloud_says_of_its_coordinates(cloud, tmp_path):
    points = b2p.PointCloud(*cloud, up="z", unit="cm", crs="EPSG:32633")
    assert (points.up, points.metres_per_unit, points.crs) == ("z", 0.01, "EPSG:32633")
    path = tmp_path / "a.ply"
    b2p.write(path, points)
    again = b2p.read(path)
    assert (again.up, again.metres_per_unit, again.crs) == ("z", 0.01, "EPSG:32633")
    stream = b2p.encode(again, bits=6)
    info = b2p.info(stream)
    assert (info["up"], info["metres_per_unit"], info["crs"]) == ("z", 0.01, "EPSG:32633")
    assert b2p.decode_points(stream).crs == "EPSG:32633" and b2p.decode(stream).up == "z"
    assert b2p.info(b2p.encode(again, bits=6, up="-y", unit=2))["up"] == "-y"
    assert b2p.read(path, up="x", unit="ft").metres_per_unit == 0.3048
    with pytest.raises(b2p.UsageError, match="parsec"):
        b2p.PointCloud(*cloud, unit="parsec")


def test_coordinates_far_away_are_restored_from_the_file_beside(tmp_path):
    n = 30
    far = np.array([4e6, 5e5, 0]) + np.random.default_rng(3).uniform(0, 10, (n, 3))
    g = b2p.Gaussians(far, np.full((n, 3), 0.1), np.tile([1.0, 0, 0, 0], (n, 1)), np.ones(n), np.ones((n, 3)))
    path = tmp_path / "a.splat"
    with pytest.warns(b2p.InputWarning, match="offset"):
        b2p.write(path, g)
    assert (tmp_path / "a.splat.json").exists()
    assert np.abs(b2p.read(path).world_positions - far).max() < 1e-4


def test_files_that_hold_neither_say_what_they_are(scene, tmp_path):
    path = tmp_path / "a.bin"
    for content, what in [(scene, "b2p decode"), (b"\x89PNG\r\n\x1a\n", "PNG"), (b"", "empty")]:
        path.write_bytes(content)
        with pytest.raises(b2p.UnsupportedError, match=what):
            b2p.read(path)
    for thing in [3, "a", (1, 2, 3), None]:
        with pytest.raises(b2p.UsageError):
            b2p.write(tmp_path / "a.ply", thing)
    with pytest.raises(b2p.UsageError, match="no points end like this"):
        b2p.write(tmp_path / "a.docx", (np.zeros((1, 3)), np.zeros((1, 3), np.uint8)))


def test_streams_are_equal_to_those_of_the_program(program, cloud, tmp_path):
    path, out = tmp_path / "a.ply", tmp_path / "a.b2p"
    b2p.write(path, cloud)
    for words, options in [
        (["--bits", 7], {"bits": 7}),
        (["--bits-per-point", 2], {"bits_per_point": 2}),
        (["--quality", 80, "--bits", 6], {"quality": 80, "bits": 6}),
        (["--lossless", "--levels", "3..6", "--bits", 6], {"lossless": True, "levels": (3, 6), "bits": 6}),
        (["--step", "8,24", "--no-head-maps", "--bits", 6], {"step": (8, 24), "head_maps": False, "bits": 6}),
        (["--no-filter", "--effort", 0, "--bits", 6], {"filter": False, "effort": 0, "bits": 6}),
        (["--effort", 0, "--bits", 7, "--block-size", 2000], {"effort": 0, "bits": 7, "block_size": 2000}),
        (["--effort", 0, "--bits", 7, "--block-size", 2000, "--bits-per-point", 3],
         {"effort": 0, "bits": 7, "block_size": 2000, "bits_per_point": 3}),
        (["--effort", 0, "--bits", 6, "--up", "z", "--unit", "mm"],
         {"effort": 0, "bits": 6, "up": "z", "unit": "mm"}),
    ]:
        program("encode", path, "-o", out, "-f", *words)
        assert b2p.encode(*cloud, **options) == out.read_bytes(), words
        assert b2p.encode(b2p.read(path), **options) == out.read_bytes(), words


def test_points_inside_of_a_closed_surface_are_left_out_on_request(tmp_path):
    count = 60_000
    z = 1 - (2 * np.arange(count) + 1) / count
    across, turn = np.sqrt(1 - z * z), 2.399963 * np.arange(count)
    shell = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
    inside = np.stack([np.linspace(-0.3, 0.3, 50), np.zeros(50), np.zeros(50)], axis=1)
    xyz = np.concatenate([shell, inside])
    path = tmp_path / "filled.ply"
    b2p.write(path, (xyz, np.full(xyz.shape, 90, np.uint8)))
    assert len(b2p.read(path).xyz) == count + 50
    with pytest.warns(b2p.InputWarning, match="left out 50 points: not seen from outside"):
        assert len(b2p.read(path, drop_hidden=True).xyz) == count


def test_lossless_streams_give_back_every_voxel():
    rng = np.random.default_rng(5)
    voxels = np.unique(rng.integers(0, 32, (3000, 3)), axis=0)
    rgb = rng.integers(0, 256, voxels.shape).astype(np.uint8)
    points = b2p.decode_points(b2p.encode(voxels, rgb, bits=5, lossless=True, levels=(3, 5)))
    order = np.lexsort(voxels.T)
    found = np.lexsort(points.voxels.T)
    assert np.array_equal(points.voxels[found], voxels[order])
    assert np.array_equal(points.rgb[found], rgb[order])
    assert np.array_equal(points.xyz, points.voxels)


def test_rates_are_kept_and_impossible_ones_say_what_is_possible(cloud):
    count = b2p.info(b2p.encode(*cloud, bits=7))["points"]
    assert 8 * len(b2p.encode(*cloud, bits=7, bits_per_point=3)) <= 3 * count
    with pytest.raises(b2p.TooFewBits) as caught:
        b2p.encode(*cloud, bits=7, bits_per_point=1e-6)
    assert caught.value.least > caught.value.asked
    for options in [
        {"bits": 0},
        {"bits": 22},
        {"quality": 101},
        {"quality": 3, "lossless": True},
        {"bits_per_point": 1, "step": 3},
        {"bits_per_point": float("nan")},
        {"bits_per_point": -1},
        {"step": 0},
        {"levels": (5, 3)},
        {"levels": (3, 9), "bits": 6},
        {"up": "sideways"},
        {"threads": 0},
    ]:
        with pytest.raises(b2p.UsageError):
            b2p.encode(*cloud, **options)
