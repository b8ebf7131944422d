import os
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal, TypeAlias, final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Buffer

_Path: TypeAlias = str | os.PathLike[str]
_Stream: TypeAlias = _Path | Buffer
_Axis: TypeAlias = Literal["x", "-x", "y", "-y", "z", "-z", "auto"]
_Point: TypeAlias = tuple[float, float, float] | list[float] | NDArray[np.floating[Any]]
_Progress: TypeAlias = Callable[[str], object]
_Choice: TypeAlias = bool | Literal["on", "off", "auto"]

__version__: str

@final
class Limits:
    def __new__(
        cls,
        *,
        max_points: int | None = None,
        max_depth: int | None = None,
        max_pixels: int | None = None,
        max_pairs: int | None = None,
        max_bytes: int | None = None,
    ) -> Limits: ...
    @staticmethod
    def unlimited() -> Limits: ...
    @staticmethod
    def embedded() -> Limits: ...
    @property
    def max_points(self) -> int: ...
    @property
    def max_depth(self) -> int: ...
    @property
    def max_pixels(self) -> int: ...
    @property
    def max_pairs(self) -> int: ...
    @property
    def max_bytes(self) -> int: ...
    def __reduce__(self) -> tuple[Any, tuple[()]]: ...

@final
class PointCloud:
    def __new__(
        cls,
        xyz: ArrayLike,
        rgb: ArrayLike | None = None,
        *,
        up: _Axis | None = None,
        unit: str | float | None = None,
        crs: str | None = None,
        limits: Limits | None = None,
    ) -> PointCloud: ...
    @property
    def xyz(self) -> NDArray[np.float64]: ...
    @property
    def rgb(self) -> NDArray[np.uint8]: ...
    @property
    def voxels(self) -> NDArray[np.uint32] | None: ...
    @property
    def bits(self) -> int | None: ...
    @property
    def origin(self) -> tuple[float, float, float] | None: ...
    @property
    def voxel_size(self) -> float | None: ...
    @property
    def up(self) -> str | None: ...
    @property
    def metres_per_unit(self) -> float | None: ...
    @property
    def crs(self) -> str: ...
    @property
    def notes(self) -> list[str]: ...
    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[NDArray[Any]]: ...

@final
class Gaussians:
    def __new__(
        cls,
        positions: ArrayLike,
        scales: ArrayLike,
        rotations: ArrayLike,
        opacities: ArrayLike,
        colours: ArrayLike,
        harmonics: ArrayLike | None = None,
        *,
        coordinates: Literal["world", "cube"] = "world",
        bits: int | None = None,
        origin: _Point | None = None,
        voxel_size: float | None = None,
        blur: float = 0.0,
        compensated: bool = False,
        up: _Axis | None = None,
        level: int | None = None,
        limits: Limits | None = None,
    ) -> Gaussians: ...
    @property
    def positions(self) -> NDArray[np.float32]: ...
    @property
    def scales(self) -> NDArray[np.float32]: ...
    @property
    def rotations(self) -> NDArray[np.float32]: ...
    @property
    def opacities(self) -> NDArray[np.float32]: ...
    @property
    def colours(self) -> NDArray[np.float32]: ...
    @property
    def harmonics(self) -> NDArray[np.float32] | None: ...
    @property
    def world_positions(self) -> NDArray[np.float64]: ...
    @property
    def world_scales(self) -> NDArray[np.float64]: ...
    @property
    def origin(self) -> tuple[float, float, float]: ...
    @property
    def unit(self) -> float: ...
    @property
    def bits(self) -> int: ...
    @property
    def voxel_size(self) -> float: ...
    @property
    def blur(self) -> float: ...
    @property
    def compensated(self) -> bool: ...
    @property
    def up(self) -> str | None: ...
    @property
    def level(self) -> int | None: ...
    def __len__(self) -> int: ...
    def __reduce__(self) -> tuple[Any, tuple[()]]: ...

@final
class Stream:
    def __new__(
        cls,
        *,
        level: int | None = None,
        heads: str | None = None,
        model: _Path | None = None,
        per_voxel: int | None = None,
        limits: Limits | None = None,
        threads: int | None = None,
    ) -> Stream: ...
    def push(self, data: Buffer) -> None: ...
    def advance(self) -> int | None: ...
    def finish(self) -> None: ...
    def gaussians(self) -> Gaussians: ...
    def points(self) -> PointCloud: ...
    @property
    def level(self) -> int | None: ...
    @property
    def is_drawable(self) -> bool: ...
    @property
    def is_complete(self) -> bool: ...

@final
class Camera:
    @staticmethod
    def orbit(
        azimuth: float = 0.0,
        elevation: float = 0.0,
        distance: float | None = None,
        *,
        fov: float = ...,
        look_at: _Point | None = None,
        up: _Axis | None = None,
        orthographic: bool = False,
    ) -> Camera: ...
    @staticmethod
    def from_matrix(
        matrix: ArrayLike,
        fov: float | None = None,
        intrinsics: ArrayLike | None = None,
        *,
        convention: Literal["opencv", "opengl"] = "opencv",
        kind: Literal["world_to_camera", "camera_to_world"] = "world_to_camera",
        size: tuple[int, int] | None = None,
        near: float | None = None,
    ) -> Camera: ...
    @staticmethod
    def load(path: _Path, *, limits: Limits | None = None) -> list[Camera]: ...
    @property
    def name(self) -> str: ...

def encode(
    xyz: ArrayLike | PointCloud,
    rgb: ArrayLike | None = None,
    *,
    bits: int | None = None,
    bits_per_point: float | None = None,
    quality: int | None = None,
    step: float | tuple[float, float] | None = None,
    lossless: bool = False,
    geometry: str | float | None = None,
    levels: tuple[int, int] | None = None,
    effort: int | None = None,
    tune: str | None = None,
    outline: str = "surface",
    filter: bool = True,
    head_maps: bool = True,
    block_size: int | None = None,
    blocks: bool = True,
    up: _Axis | None = None,
    unit: str | float | None = None,
    crs: str | None = None,
    limits: Limits | None = None,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> bytes: ...
def decode(
    stream: _Stream,
    level: int | None = None,
    heads: str | None = None,
    *,
    model: _Path | None = None,
    per_voxel: int | None = None,
    box: tuple[_Point, _Point] | None = None,
    camera: Camera | None = None,
    lod: float = 0.0,
    partial: bool = False,
    limits: Limits | None = None,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> Gaussians: ...
def decode_points(
    stream: _Stream,
    level: int | None = None,
    *,
    box: tuple[_Point, _Point] | None = None,
    partial: bool = False,
    limits: Limits | None = None,
    threads: int | None = None,
    progress: _Progress | None = None,
) -> PointCloud: ...
def render(
    scene: Gaussians | _Stream,
    camera: Camera | None = None,
    width: int | None = None,
    height: int | None = None,
    *,
    background: str | _Point | None = None,
    effects: Mapping[str, _Choice] | None = None,
    channel: Literal["colour", "alpha", "depth", "normal", "ids"] = "colour",
    quality: Literal["fast", "fine", "exact"] = "fine",
    dtype: Literal["uint8", "float32"] = "uint8",
    level: int | None = None,
    heads: str | None = None,
    model: _Path | None = None,
    per_voxel: int | None = None,
    lod: float = 0.0,
    limits: Limits | None = None,
    threads: int | None = None,
) -> NDArray[Any]: ...
def info(stream: _Stream, *, limits: Limits | None = None) -> dict[str, Any]: ...
def read(
    path: _Path,
    *,
    format: str | None = None,
    up: _Axis | None = None,
    unit: str | float | None = None,
    crop: tuple[_Point, _Point] | None = None,
    drop_outliers: bool = False,
    drop_hidden: bool = False,
    vertices: bool = False,
    limits: Limits | None = None,
    threads: int | None = None,
) -> PointCloud | Gaussians: ...
def write(
    path: _Path,
    thing: PointCloud | tuple[ArrayLike, ArrayLike] | Gaussians,
    *,
    format: str | None = None,
    double: bool = False,
    limits: Limits | None = None,
    threads: int | None = None,
) -> None: ...
def set_threads(count: int | None = None) -> None: ...
