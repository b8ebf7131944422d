"""Exceptions: one for each way in which the library fails, with its fields as attributes."""

from __future__ import annotations

from typing import Any


class Error(Exception):
    """Everything that the library can fail with. ``str(error)`` says what is wrong, where, and what was expected."""

    fields: dict[str, Any]
    """All attributes that the kind of error has, by name."""

    def __init__(self, message: str, **fields: Any) -> None:
        super().__init__(message)
        self.fields = fields
        for name, value in fields.items():
            setattr(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (type(self), str(self), self.fields)


def _rebuilt(kind: type[Error], message: str, fields: dict[str, Any]) -> Error:
    return kind(message, **fields)


class IoError(Error, OSError):
    """The operating system failed to read or write a file."""

    path: str
    """The file."""

    def __str__(self) -> str:
        return str(self.args[0])


class NotFoundError(IoError, FileNotFoundError):
    """There is no such file."""


class FormatError(Error, ValueError):
    """The input is not what its format says: it is damaged, cut, or something else."""


class TruncatedError(FormatError):
    """The input ends before it is complete."""

    stage: str
    """The stage that noticed, such as ``"bitstream"`` or ``"geometry"``."""
    offset: int
    """Byte offset from the start of the input."""
    field: str
    """What was being read."""
    needed: int
    """How many bytes are missing at least."""


class ChecksumError(FormatError):
    """The bytes are not what was written."""

    clause: str
    """The clause of docs/format.md that says so."""
    what: str
    """The header, or which chunk."""
    offset: int
    """Byte offset of the damaged part."""
    expected: int
    """The checksum that the stream declares."""
    found: int
    """The checksum of the bytes."""


class MalformedError(FormatError):
    """A field of the input holds what its format forbids."""

    clause: str | None
    """The clause of docs/format.md that a stream breaks; None for other files."""
    stage: str
    """The stage that noticed."""
    at: str
    """A byte offset, a line, a point, or the name of a tensor."""
    field: str
    """The field."""
    found: str
    """What it holds."""
    expected: str
    """What it may hold."""


class DeterminismError(FormatError):
    """All checksums hold, but what was decoded is not what was coded."""

    what: str
    """What was decoded: latents or colours."""
    level: int
    """The octree level."""
    expected: int
    """The hash in the stream."""
    found: int
    """The hash of what was decoded."""


class ModelError(Error):
    """A stream of version 2 is to be decoded without the model that coded it."""

    expected: str
    """The id in the stream, hexadecimal."""
    found: str | None
    """The id of the model that is loaded, or None."""


class LimitExceeded(Error):
    """The input asks for more than the limits allow; see :class:`b2p.Limits`."""

    what: str
    """The quantity."""
    needed: int
    """What the input asks for."""
    limit: int
    """What is allowed."""
    option: str
    """The argument of :class:`b2p.Limits` that rules it."""


class OutOfMemory(Error, MemoryError):
    """The machine has no memory for what the limits allow."""

    what: str
    """What takes it."""
    bytes: int
    """How many bytes were asked for at once."""


class UnsupportedError(Error):
    """The input is well-formed, but this decoder cannot do it."""

    what: str
    """The feature."""
    detail: str
    """What was found, and what would do."""


class TooFewBits(Error, ValueError):
    """No stream of this cloud is as small as was asked for."""

    asked: float
    """Bits per point that were asked for."""
    least: float
    """Bits per point of the smallest stream that was tried."""


class Cancelled(Error):
    """The work was stopped."""


class UsageError(Error, ValueError):
    """The caller asked for something that makes no sense."""


class InputWarning(UserWarning):
    """Something about an input was mended, guessed or left out."""
