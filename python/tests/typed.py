"""What a typed program does with the package: `mypy --strict` accepts it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import b2p


def picture_of(xyz: NDArray[np.float64], rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    stream: bytes = b2p.encode(xyz, rgb, bits_per_point=0.5, up="z", progress=print)
    gaussians = b2p.decode(stream, heads="surfels", limits=b2p.Limits(max_points=1 << 20))
    positions: NDArray[np.float32] = gaussians.positions
    camera = b2p.Camera.orbit(20.0, 10.0, look_at=(0.0, 0.0, 0.0))
    picture: NDArray[np.uint8] = b2p.render(gaussians, camera, 640, 480, effects={"antialias": True})
    return picture if len(positions) else picture[:0]


def levels(path: Path) -> list[int]:
    return [level.number for level in b2p.open(path, partial=True) if level.is_drawable and len(level.gaussians())]


def explained(path: Path) -> str:
    try:
        read = b2p.read(path)
    except b2p.NotFoundError as error:
        return error.path
    except b2p.LimitExceeded as error:
        return f"{error.option}: {error.needed} > {error.limit}"
    if isinstance(read, b2p.PointCloud):
        xyz, rgb = read
        return f"{xyz.shape} {rgb.dtype} {read.crs}"
    b2p.write(path.with_suffix(".spz"), read)
    return str(b2p.info(path)["bits"])
