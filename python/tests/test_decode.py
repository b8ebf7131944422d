"""Streams become the same Gaussians and points as everywhere else."""

import hashlib
import io
import json

import numpy as np
import pytest
from conftest import CONFORMANCE, ROOT

import b2p

SUITE = (CONFORMANCE / "version-3" / "suite.txt").read_text().splitlines()


def digest(*arrays):
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()


def morton(voxels):
    keys = np.zeros(len(voxels), np.uint64)
    for bit in range(21):
        for axis in range(3):
            keys |= ((voxels[:, axis].astype(np.uint64) >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return keys


def parameters(gaussians):
    return [getattr(gaussians, name) for name in ("positions", "scales", "rotations", "opacities", "colours")]


@pytest.mark.parametrize("line", SUITE, ids=lambda line: line.split(" ")[0])
def test_streams_of_the_conformance_suite_decode_to_their_digests(line):
    name, *levels = line.split(" ")
    stream = CONFORMANCE / "version-3" / f"{name}.b2p"
    assert levels
    for entry in levels:
        level, digests = entry.split("=")
        points = b2p.decode_points(stream, level=int(level))
        gaussians = b2p.decode(stream, level=int(level), heads="surfels")
        found = [digest(morton(points.voxels)), digest(points.rgb), digest(*parameters(gaussians))]
        assert found == digests.split(","), f"{name}, level {level}"
        assert gaussians.level == int(level)


def test_learned_streams_of_the_conformance_suite_decode_to_the_digests_of_their_gaussians():
    lines = [line for line in (CONFORMANCE / "suite.txt").read_text().splitlines() if line.startswith("lite-")][:3]
    assert lines
    checked = 0
    for line in lines:
        name, _, *levels = line.split(" ")
        for entry in levels:
            level, digests = entry.split("=")
            if len(digests.split(",")) == 4:
                gaussians = b2p.decode(CONFORMANCE / f"{name}.b2p", level=int(level))
                assert digest(*parameters(gaussians)) == digests.split(",")[3], line
                checked += 1
    assert checked


@pytest.mark.parametrize("heads", ["best", "quick", "surfels"])
def test_gaussians_are_those_that_the_program_writes(program, scene, tmp_path, heads):
    out = tmp_path / "scene.npz"
    program("decode", ROOT / "models" / "scene.b2p", "-o", out, "--heads", heads, "--level", 7)
    ours = b2p.decode(scene, level=7, heads=heads)
    mine = tmp_path / "mine.npz"
    b2p.write(mine, ours)
    assert mine.read_bytes() == out.read_bytes()


def test_points_are_those_that_the_program_writes(program, scene, tmp_path):
    out, mine = tmp_path / "out.ply", tmp_path / "mine.ply"
    program("decode", ROOT / "models" / "scene.b2p", "-o", out, "--points")
    points = b2p.decode_points(scene)
    b2p.write(mine, points)
    assert mine.read_bytes() == out.read_bytes()
    xyz, rgb = points
    assert xyz.shape == rgb.shape == (len(points), 3)
    level = b2p.info(scene)["top_level"]
    assert points.bits == level
    centres = np.array(points.origin) + (points.voxels + 0.5) * points.voxel_size
    assert np.array_equal(xyz, centres)


def test_the_best_heads_draw_by_default_and_a_file_of_weights_can_be_named(scene):
    usual = b2p.decode(scene, level=8)
    named = b2p.decode(scene, 8, "best", model=ROOT / "models" / "heads.safetensors")
    file = b2p.decode(scene, 8, str(ROOT / "models" / "heads.safetensors"))
    for a, b, c in zip(parameters(usual), parameters(named), parameters(file), strict=True):
        assert np.array_equal(a, b) and np.array_equal(a, c)


def test_paths_and_bytes_of_every_kind_are_streams(scene, tmp_path):
    path = tmp_path / "a.b2p"
    path.write_bytes(scene)
    wanted = b2p.decode(scene, level=7, heads="surfels").positions
    for stream in [path, str(path), bytearray(scene), memoryview(scene), np.frombuffer(scene, np.uint8)]:
        assert np.array_equal(b2p.decode(stream, level=7, heads="surfels").positions, wanted)


def test_a_cut_stream_gives_its_finest_whole_level_if_that_is_asked_for(scene):
    levels = b2p.info(scene)["levels"]
    cut = scene[: levels[-1]["prefix_bytes"] - 100]
    with pytest.raises(b2p.TruncatedError):
        b2p.decode(cut)
    with pytest.raises(b2p.TruncatedError):
        b2p.decode_points(cut)
    below = levels[-2]["level"]
    assert b2p.decode(cut, partial=True).level == below
    assert b2p.decode_points(cut, partial=True).bits == below
    assert b2p.info(cut)["complete_to_level"] == below and b2p.info(cut)["damage"]
    exact = scene[: levels[-2]["prefix_bytes"]]
    assert b2p.decode(exact).level == below and b2p.info(exact)["damage"] is None


def test_what_info_says_is_what_the_program_says(program, scene):
    ours = b2p.info(scene)
    theirs = json.loads(program("info", ROOT / "models" / "scene.b2p", "--json"))
    for name, value in ours.items():
        if name != "levels":
            assert theirs[name] == value, name
    for a, b in zip(ours["levels"], theirs["levels"], strict=True):
        assert {name: b[name] for name in a if name != "prefix_bytes"} == {
            name: value for name, value in a.items() if name != "prefix_bytes"
        }
    assert ours["levels"][-1]["prefix_bytes"] == len(scene)


def test_a_stream_is_decoded_level_by_level_as_it_arrives(scene):
    info = b2p.info(scene)
    numbers = [level["level"] for level in info["levels"]]
    asked = []

    def pieces():
        for at in range(0, len(scene), 1000):
            asked.append(at)
            yield scene[at : at + 1000]

    seen = []
    for level in b2p.open(pieces(), heads="surfels"):
        seen.append(level.number)
        assert len(level.points()) == info["levels"][len(seen) - 1]["voxels"]
        # No more has been taken than the level needs.
        assert asked[-1] <= info["levels"][len(seen) - 1]["prefix_bytes"]
        last = level.gaussians()
    assert seen == numbers
    assert np.array_equal(last.positions, b2p.decode(scene, heads="surfels").positions)


def test_paths_files_and_bytes_are_opened_alike(scene, tmp_path):
    path = tmp_path / "a.b2p"
    path.write_bytes(scene)
    for source in [scene, path, str(path), io.BytesIO(scene), memoryview(scene), [scene[:5], scene[5:]]]:
        levels = list(b2p.open(source, heads="surfels"))
        assert [level.number for level in levels] == [level["level"] for level in b2p.info(scene)["levels"]]
        with pytest.raises(b2p.UsageError, match="is gone"):
            levels[0].gaussians()
    with pytest.raises(TypeError):
        b2p.open(7)


def test_a_stream_that_ends_early_is_an_error_unless_a_part_is_enough(scene):
    cut = scene[: len(scene) - 10]
    with pytest.raises(b2p.TruncatedError):
        list(b2p.open(cut))
    assert [level.number for level in b2p.open(cut, partial=True)] == [
        level["level"] for level in b2p.info(scene)["levels"][:-1]
    ]
    for length in [0, 5, 9, 30]:
        with pytest.raises(b2p.Error):
            list(b2p.open(scene[:length]))
    stream = b2p.Stream()
    with pytest.raises(b2p.UsageError):
        stream.gaussians()
    with pytest.raises(b2p.UsageError):
        stream.points()
    assert stream.level is None and not stream.is_drawable and not stream.is_complete
