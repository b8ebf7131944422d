"""Arrays: zero copy out, every sensible kind of array in."""

import gc
import pickle

import numpy as np
import pytest

import b2p

NAMES = ["positions", "scales", "rotations", "opacities", "colours"]


def test_arrays_of_gaussians_are_read_only_views_of_the_same_memory(scene_gaussians):
    n = len(scene_gaussians)
    shapes = {"positions": (n, 3), "scales": (n, 3), "rotations": (n, 4), "opacities": (n,), "colours": (n, 3)}
    for name, shape in shapes.items():
        a, b = getattr(scene_gaussians, name), getattr(scene_gaussians, name)
        assert a.shape == shape and a.dtype == np.float32 and a.flags.c_contiguous
        assert a.ctypes.data == b.ctypes.data and not a.flags.writeable and not a.flags.owndata
        with pytest.raises(ValueError):
            a.flags.writeable = True
    assert scene_gaussians.harmonics is None


def test_arrays_outlive_what_they_came_from(scene):
    gaussians = b2p.decode(scene, level=7, heads="surfels")
    positions, expected = gaussians.positions, gaussians.positions.copy()
    xyz = b2p.decode_points(scene, level=7).xyz
    kept = xyz.copy()
    del gaussians
    gc.collect()
    garbage = [np.full(expected.shape, 7, np.float32) for _ in range(20)]
    assert np.array_equal(positions, expected) and np.array_equal(xyz, kept) and garbage


def test_pictures_own_their_memory_and_may_be_written(scene_gaussians):
    picture = b2p.render(scene_gaussians, None, 32, 24)
    picture[:] = 0
    assert picture.shape == (24, 32, 3)


def test_the_cube_frame_and_the_world_are_as_documented(scene_gaussians):
    g = scene_gaussians
    world = np.array(g.origin) + (g.positions.astype(np.float64) + 1) * g.unit
    assert np.allclose(g.world_positions, world, rtol=1e-12)
    assert np.allclose(g.world_scales, g.scales.astype(np.float64) * g.unit, rtol=1e-12)
    assert g.unit == 2 ** (g.bits - 1) * g.voxel_size


@pytest.mark.parametrize("harmonics", [None, 3, 8, 15])
def test_gaussians_are_built_of_arrays_and_pickled(harmonics):
    rng = np.random.default_rng(1)
    n = 50
    fields = {
        "positions": rng.uniform(100, 110, (n, 3)),
        "scales": rng.uniform(0.1, 0.2, (n, 3)),
        "rotations": np.tile([1.0, 0, 0, 0], (n, 1)),
        "opacities": rng.uniform(0, 1, n),
        "colours": rng.uniform(0, 1, (n, 3)),
    }
    if harmonics:
        fields["harmonics"] = rng.normal(size=(n, harmonics, 3))
    g = b2p.Gaussians(**fields, up="z", compensated=True)
    assert len(g) == n and g.up == "z" and g.compensated and g.level is None
    assert np.allclose(g.world_positions, fields["positions"], atol=1e-5)
    assert np.allclose(g.world_scales, fields["scales"], atol=1e-6)
    if harmonics:
        assert np.allclose(g.harmonics, fields["harmonics"], atol=1e-6)
    again = pickle.loads(pickle.dumps(g))
    for name in [*NAMES, "harmonics", "bits", "origin", "voxel_size", "blur", "up", "compensated"]:
        assert np.array_equal(getattr(again, name), getattr(g, name)), name


def test_blur_of_the_world_becomes_that_of_the_cube():
    one = ([[1, 2, 3]], [[0.1] * 3], [[1, 0, 0, 0]], [1], [[1, 0, 0]])
    cube = {"bits": 4, "origin": (0, 0, 0), "voxel_size": 0.5}
    world = b2p.Gaussians(*one, blur=16.0, **cube)
    assert world.blur == 1.0 and world.unit == 4.0
    assert np.allclose(world.positions, np.array([[1, 2, 3]]) / 4 - 1)
    same = b2p.Gaussians(*one, blur=16.0, coordinates="cube", **cube)
    assert same.blur == 16.0 and np.array_equal(same.positions, [[1, 2, 3]])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("positions", np.zeros((4, 2)), "positions has the shape"),
        ("scales", np.zeros((3, 3)), "4 positions"),
        ("rotations", np.zeros((4, 3)), r"expected \[n, 4\]"),
        ("opacities", np.zeros((4, 4)), "opacities"),
        ("colours", np.zeros((4, 3), "S1"), "expected numbers"),
        ("colours", np.zeros((4, 3), complex), "expected numbers"),
        ("harmonics", np.zeros((4, 4, 3)), "view-dependent"),
        ("harmonics", np.zeros((4, 0, 3)), "view-dependent"),
        ("coordinates", "moon", "moon"),
        ("bits", 10, "together"),
        ("up", "w", "w"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(name, value, message):
    fields = {
        "positions": np.zeros((4, 3)),
        "scales": np.ones((4, 3)),
        "rotations": np.tile([1.0, 0, 0, 0], (4, 1)),
        "opacities": np.ones(4),
        "colours": np.ones((4, 3)),
    }
    if name == "harmonics" and value.shape[1] == 0:
        # Of degree 0 there are none, and that is right.
        assert b2p.Gaussians(**fields, harmonics=value).harmonics is None
        return
    with pytest.raises(b2p.UsageError, match=message):
        b2p.Gaussians(**{**fields, name: value})


def test_cubes_that_are_none_are_refused():
    one = ([[1, 2, 3]], [[0.1] * 3], [[1, 0, 0, 0]], [1], [[1, 0, 0]])
    for cube in [(0, 1.0), (22, 1.0), (10, 0.0), (10, float("nan")), (10, -1.0)]:
        with pytest.raises(b2p.UsageError):
            b2p.Gaussians(*one, bits=cube[0], origin=(0, 0, 0), voxel_size=cube[1])


def test_no_gaussians_and_those_that_are_not_finite_draw_the_background():
    none = b2p.Gaussians(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 4)), [], np.zeros((0, 3)))
    assert len(none) == 0 and none.positions.shape == (0, 3)
    assert np.all(b2p.render(none, None, 8, 8) == 255)
    bad = b2p.Gaussians([[np.nan, 0, 0], [np.inf, 0, 0]], np.ones((2, 3)), np.ones((2, 4)), [1, 1], np.ones((2, 3)))
    assert np.all(b2p.render(bad, None, 8, 8, background="black") == 0)


def test_clouds_of_every_dtype_and_layout_are_the_same(cloud):
    xyz, rgb = cloud
    xyz = xyz.astype(np.float32)
    wanted = b2p.encode(xyz, rgb, bits=6)
    wide = np.zeros((len(xyz), 8), np.float32)
    wide[:, 1:7:2] = xyz
    bytes_of = np.zeros((3, len(rgb)), np.uint8)
    bytes_of[:] = rgb.T
    for points in [xyz.astype(np.float64), np.asfortranarray(xyz), wide[:, 1:7:2], xyz.tolist(), xyz.astype(">f4")]:
        assert b2p.encode(points, rgb, bits=6) == wanted
    for colours in [bytes_of.T, rgb[::-1][::-1], rgb / 255.0, (rgb / 255).astype(np.float32)]:
        assert b2p.encode(xyz, colours, bits=6) == wanted
    read_only = xyz.copy()
    read_only.flags.writeable = False
    assert b2p.encode(read_only, rgb, bits=6) == wanted
    voxels = np.argwhere(np.ones((4, 4, 4)))
    assert np.array_equal(b2p.PointCloud(voxels, np.zeros((64, 3), np.uint8)).xyz, voxels)


def test_gaussians_reach_as_far_as_the_cloud_if_asked_for(cloud):
    xyz, rgb = cloud
    surface, wider = (b2p.decode(b2p.encode(xyz, rgb, bits=6, outline=outline)) for outline in ("surface", "cloud"))
    assert np.array_equal(surface.positions, wider.positions)
    assert (wider.scales >= surface.scales).all() and (wider.scales > surface.scales).any()
    with pytest.raises(b2p.UsageError, match="'surface' or 'cloud'"):
        b2p.encode(xyz, rgb, bits=6, outline="mesh")


def test_arrays_that_are_no_cloud_are_refused(cloud):
    xyz, rgb = cloud
    for points, colours, message in [
        (xyz[:, :2], rgb, r"expected \[n, 3\]"),
        (xyz.ravel(), rgb, "xyz has the shape"),
        (xyz, rgb[:-1], "colours"),
        (xyz, rgb.astype(np.int64), "expected uint8"),
        (xyz, rgb.astype(np.uint16), "expected uint8"),
        (xyz, np.c_[rgb, rgb[:, :1]], "rgb has the shape"),
        (xyz.astype(complex), rgb, "expected numbers"),
        (np.full(xyz.shape, "1"), rgb, "expected numbers"),
        (xyz.astype(object), rgb, "expected numbers"),
    ]:
        with pytest.raises(b2p.UsageError, match=message):
            b2p.encode(points, colours)
    with pytest.raises(b2p.Error, match="red|255|expected"):
        b2p.encode(xyz, rgb.astype(np.float64))
    with pytest.raises(b2p.Error):
        b2p.encode(xyz, np.full(xyz.shape, np.nan))


def test_empty_clouds_and_clouds_without_a_finite_point_are_refused():
    with pytest.raises(b2p.MalformedError) as caught:
        b2p.encode(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    assert caught.value.found == "0" and "at least one" in caught.value.expected
    with pytest.raises(b2p.MalformedError):
        b2p.encode(np.full((3, 3), np.nan), np.zeros((3, 3), np.uint8))


def test_points_that_are_not_finite_are_left_out_with_a_warning(cloud):
    xyz, rgb = cloud
    spoilt, colours = np.r_[xyz, [[np.nan, 0, 0], [0, np.inf, 0]]], np.r_[rgb, rgb[:2]]
    with pytest.warns(b2p.InputWarning, match="left out 2 points"):
        stream = b2p.encode(spoilt, colours, bits=6)
    assert stream == b2p.encode(xyz, rgb, bits=6)


def test_points_without_colours_are_shaded_with_a_warning(cloud):
    with pytest.warns(b2p.InputWarning, match="shaded by their height"):
        shaded = b2p.PointCloud(cloud[0])
    assert len(np.unique(shaded.rgb)) > 20 and shaded.notes


def test_huge_counts_are_refused_before_anything_is_copied():
    huge = np.broadcast_to(np.zeros(3), (1 << 40, 3))
    with pytest.raises(b2p.LimitExceeded) as caught:
        b2p.encode(huge, None)
    assert caught.value.needed == 1 << 40 and caught.value.option == "max_points"
    with pytest.raises(b2p.LimitExceeded):
        b2p.PointCloud(np.zeros((11, 3)), np.zeros((11, 3), np.uint8), limits=b2p.Limits(max_points=10))
    with pytest.raises(b2p.LimitExceeded):
        b2p.Gaussians(huge, huge, np.broadcast_to(np.zeros(4), (1 << 40, 4)), [1], huge)
