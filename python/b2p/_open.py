"""Streams that are decoded level by level, as their bytes arrive."""

from __future__ import annotations

import builtins
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from ._b2p import Gaussians, Limits, PointCloud, Stream
from ._errors import UsageError

_PIECE = 1 << 16


class Readable(Protocol):
    """Something with bytes to come: a file opened in binary mode, the response to an HTTP request, a pipe."""

    def read(self, size: int, /) -> bytes:
        """At most ``size`` bytes; none at the end."""


@dataclass(frozen=True)
class Level:
    """A level of a stream that is complete. It can be asked for what it holds until the next one is decoded."""

    number: int
    """The octree level."""
    stream: Stream
    """The stream that it belongs to."""

    @property
    def is_drawable(self) -> bool:
        """Whether the level has Gaussians. Learned heads do not draw level 0."""
        return self._current().is_drawable

    def gaussians(self) -> Gaussians:
        """The Gaussians of this level."""
        return self._current().gaussians()

    def points(self) -> PointCloud:
        """The voxels of this level with their colours."""
        return self._current().points()

    def _current(self) -> Stream:
        if self.stream.level != self.number:
            raise UsageError(f"level {self.number} is gone: the stream is decoded to level {self.stream.level}")
        return self.stream


def open(
    source: str | os.PathLike[str] | bytes | bytearray | memoryview | Readable | Iterable[bytes],
    *,
    level: int | None = None,
    heads: str | None = None,
    model: str | os.PathLike[str] | None = None,
    per_voxel: int | None = None,
    partial: bool = False,
    limits: Limits | None = None,
    threads: int | None = None,
) -> Iterator[Level]:
    """Decodes a stream level by level, each as soon as its bytes have arrived.

    ``source`` is a path, bytes, something with ``read(size)`` such as the response of ``urllib.request.urlopen``, or an
    iterable of pieces of any size. Nothing beyond the end of the stream is asked for. The other arguments are those of
    :func:`b2p.decode`; with ``partial``, a stream that ends early is no error.

    >>> for level in b2p.open("scene.b2p"):                                      # doctest: +SKIP
    ...     picture = b2p.render(level.gaussians(), camera, 640, 480)
    """
    stream = Stream(level=level, heads=heads, model=model, per_voxel=per_voxel, limits=limits, threads=threads)
    return _levels(stream, _pieces(source), partial)


def _levels(stream: Stream, pieces: Iterator[bytes], partial: bool) -> Iterator[Level]:
    for piece in pieces:
        stream.push(piece)
        while (number := stream.advance()) is not None:
            yield Level(number, stream)
        if stream.is_complete:
            return
    if not partial:
        before = stream.level
        stream.finish()
        if stream.level is not None and stream.level != before:
            yield Level(stream.level, stream)


def _pieces(source: Any) -> Iterator[bytes]:
    if isinstance(source, (bytes, bytearray, memoryview)):
        view = memoryview(source).cast("B")
        return (bytes(view[at : at + _PIECE]) for at in range(0, len(view), _PIECE))
    if isinstance(source, (str, os.PathLike)):
        return _file(source)
    if hasattr(source, "read"):
        return iter(lambda: source.read(_PIECE), b"")
    if isinstance(source, Iterable):
        return iter(source)
    raise TypeError(f"expected a path, bytes, a file or an iterable of bytes, not {type(source).__name__}")


def _file(path: str | os.PathLike[str]) -> Iterator[bytes]:
    with builtins.open(path, "rb") as file:
        while piece := file.read(_PIECE):
            yield piece
