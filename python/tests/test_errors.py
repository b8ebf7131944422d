"""Errors are exceptions that carry the fields of the library's own."""

import errno
import pickle

import pytest
from conftest import CONFORMANCE, ROOT

import b2p


def error_of(kind, call, *arguments, **options):
    with pytest.raises(kind) as caught:
        call(*arguments, **options)
    error = caught.value
    assert isinstance(error, b2p.Error) and str(error)
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error) and str(again) == str(error) and again.fields == error.fields
    for name, value in error.fields.items():
        assert getattr(error, name) == value
    return error


def test_a_missing_file_is_named_and_is_what_python_expects(tmp_path):
    path = tmp_path / "none.b2p"
    for call in [b2p.decode, b2p.decode_points, b2p.info, b2p.read, b2p.render]:
        error = error_of(b2p.NotFoundError, call, path)
        assert isinstance(error, FileNotFoundError) and isinstance(error, OSError)
        assert error.path == error.filename == str(path) and error.errno == errno.ENOENT
        assert str(error).startswith(str(path))
    error = error_of(b2p.IoError, b2p.decode, tmp_path)
    assert not isinstance(error, FileNotFoundError) and error.errno == errno.EISDIR


def test_a_damaged_stream_tells_what_and_where(scene):
    damaged = bytearray(scene)
    damaged[len(scene) // 2] ^= 1
    error = error_of(b2p.ChecksumError, b2p.decode, bytes(damaged))
    assert isinstance(error, b2p.FormatError) and isinstance(error, ValueError)
    assert 0 < error.offset <= len(scene) // 2 and error.expected != error.found and error.what


def test_a_cut_stream_tells_how_much_is_missing(scene):
    error = error_of(b2p.TruncatedError, b2p.decode, scene[:-7])
    assert error.stage == "bitstream" and error.needed >= 1 and error.field and 0 < error.offset <= len(scene)


def test_what_is_no_stream_says_what_was_expected():
    error = error_of(b2p.MalformedError, b2p.decode, b"ply\nformat ascii 1.0\n")
    assert error.stage == "bitstream" and error.field and error.found and error.expected and error.at


def test_limits_name_the_option_that_raises_them(scene):
    error = error_of(b2p.LimitExceeded, b2p.decode, scene, limits=b2p.Limits(max_points=10))
    assert error.option == "max_points" and error.limit == 10 and error.needed > 10 and error.what
    error = error_of(b2p.LimitExceeded, b2p.decode, scene, limits=b2p.Limits(max_bytes=1000))
    assert error.option == "max_bytes"
    error = error_of(b2p.LimitExceeded, b2p.decode, ROOT / "models" / "scene.b2p", limits=b2p.Limits(max_bytes=1000))
    assert error.option == "max_bytes" and error.needed == len(scene)


def test_streams_of_another_model_name_it():
    stream = next(CONFORMANCE.glob("tiny-small.b2p"))
    error = error_of(b2p.ModelError, b2p.decode, stream)
    assert len(error.expected) == 32 and error.found and error.found != error.expected


def test_points_of_a_learned_stream_and_gaussians_of_level_0_are_not_supported(scene):
    error = error_of(b2p.UnsupportedError, b2p.decode_points, ROOT / "models" / "sample.b2p")
    assert "version 2" in error.what and error.detail
    error_of(b2p.UnsupportedError, b2p.decode, scene, per_voxel=3)
    error_of(b2p.UnsupportedError, b2p.decode, ROOT / "models" / "sample.b2p", heads="surfels")


def test_mistakes_of_the_caller_are_value_errors(scene):
    for call, arguments, options in [
        (b2p.decode, (scene,), {"heads": "finest"}),
        (b2p.decode, (scene,), {"level": 99}),
        (b2p.decode, (scene,), {"heads": "a/b.safetensors", "model": "c.safetensors"}),
        (b2p.decode, (17,), {}),
        (b2p.decode, (scene,), {"threads": 0}),
        (b2p.set_threads, (0,), {}),
    ]:
        assert isinstance(error_of(b2p.UsageError, call, *arguments, **options), ValueError)


def test_every_kind_of_error_is_an_error():
    kinds = [kind for kind in vars(b2p).values() if isinstance(kind, type) and issubclass(kind, Exception)]
    assert len(kinds) >= 16
    assert all(issubclass(kind, b2p.Error) or kind is b2p.InputWarning for kind in kinds)


def test_any_damage_is_an_error_and_never_a_crash(scene):
    streams = [scene, (CONFORMANCE / "version-3" / "ball.b2p").read_bytes()]
    for stream in streams:
        for at in range(0, len(stream), max(len(stream) // 60, 1)):
            damaged = bytearray(stream)
            damaged[at] ^= 0x55
            with pytest.raises(b2p.Error):
                b2p.decode(damaged, heads="surfels")
