"""Coloured point clouds as small streams, decoded to 3D Gaussians and pictures on a CPU.

>>> import b2p
>>> stream = b2p.encode(xyz, rgb, bits_per_point=0.5)             # doctest: +SKIP
>>> gaussians = b2p.decode(stream)                                # doctest: +SKIP
>>> picture = b2p.render(gaussians, b2p.Camera.orbit(30, 20))     # doctest: +SKIP

Arrays are NumPy's. Two frames of coordinates occur:

- the *world*, in which the points of a cloud are given and decoded points are returned, in the cloud's own unit;
- the *cube frame*, to which the arrays of :class:`Gaussians` refer and in which the voxel cube is ``[-1, 1]``³.
  ``world = origin + (position + 1) * unit``, with ``origin`` and ``unit`` of the Gaussians.

Work runs on threads of its own, outside of Python's lock, and ends at Ctrl-C. Failures are :class:`Error`.
"""

from ._b2p import (
    Camera,
    Gaussians,
    Limits,
    PointCloud,
    Stream,
    __version__,
    decode,
    decode_points,
    encode,
    info,
    read,
    render,
    set_threads,
    write,
)
from ._errors import (
    Cancelled,
    ChecksumError,
    DeterminismError,
    Error,
    FormatError,
    InputWarning,
    IoError,
    LimitExceeded,
    MalformedError,
    ModelError,
    NotFoundError,
    OutOfMemory,
    TooFewBits,
    TruncatedError,
    UnsupportedError,
    UsageError,
)
from ._open import Level, open

__all__ = [
    "Camera",
    "Cancelled",
    "ChecksumError",
    "DeterminismError",
    "Error",
    "FormatError",
    "Gaussians",
    "InputWarning",
    "IoError",
    "Level",
    "LimitExceeded",
    "Limits",
    "MalformedError",
    "ModelError",
    "NotFoundError",
    "OutOfMemory",
    "PointCloud",
    "Stream",
    "TooFewBits",
    "TruncatedError",
    "UnsupportedError",
    "UsageError",
    "__version__",
    "decode",
    "decode_points",
    "encode",
    "info",
    "open",
    "read",
    "render",
    "set_threads",
    "write",
]
