"""Compares pictures of b2p with the golden pictures of another renderer, splat-transform (PlayCanvas, MIT).

    python3 docs/golden.py CHECKOUT     a clone, with its history, of https://github.com/playcanvas/splat-transform

Its scenes are grids of equal balls, made here from the parameters in its test/render-golden.cases.mjs. A third scene has
depth of field, which b2p lacks. There are two generations of pictures, because since 958b004 splat-transform subtracts a
constant from every Gaussian. Each renderer is also compared with a double-precision model that has its cut-offs, which
shows that the cut-offs explain the whole difference. Needs numpy and a Pillow that reads WebP. B2P names a `b2p` that is
built already. Fails if a picture differs by more than WITHIN from its model.
"""

import argparse
import io
import json
import math
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).parent.parent
HARMONIC = 0.28209479177387814
FOV = 60.0  # degrees, vertical
OPACITY = 0.9
NEAR = 0.2
NOTHING = 9  # standard deviations, beyond which alpha is below 10^-17
WITHIN = 1  # of 255: largest difference between a picture and the model of its renderer
PICTURE = "test/fixtures/golden-render/{}.webp"


@dataclass(frozen=True)
class Scene:
    name: str
    side: int  # Gaussians in a row, and rows
    spacing: float
    scale: float  # standard deviation
    eye: tuple  # looks at the origin, +y up
    size: tuple


SCENES = (
    Scene("tiny", 20, 1.0, 0.1, (0, 5, -8), (320, 240)),
    Scene("mid", 220, 0.3, 0.05, (0, 10, -15), (640, 360)),
)


@dataclass(frozen=True)
class Cuts:
    """What a renderer leaves out of alpha = 0.9 * exp(-d^2 / 2), at most 0.99, of every Gaussian at every pixel."""

    sigmas: float = math.inf  # half the side of the square outside which a Gaussian is 0, in deviations of its longer axis
    rim: bool = False  # subtracts the value at the edge of that square everywhere, which hides the edge
    least: float = 0.0  # smallest alpha that is drawn
    through: float = 0.0  # transmittance below which a pixel is finished


NONE = Cuts()
EARLIER = Cuts(sigmas=3.0, least=1 / 255, through=1e-4)
GENERATIONS = {
    "cfee373f470b02f130decf81596c0d53cfd0b06a": EARLIER,
    "958b0043ff1d86b8bbf07d13cffdb0e228e7057c": replace(EARLIER, rim=True),
}


def gaussians(scene):
    """Centres and colours."""
    i = np.arange(scene.side**2)
    column, row = i % scene.side, i // scene.side
    centres = np.stack([(column - scene.side / 2) * scene.spacing, 0.0 * i, (row - scene.side / 2) * scene.spacing], 1)
    colours = np.stack([(column + 1) / (scene.side + 1), (row + 1) / (scene.side + 1), 0.5 + 0.0 * i], 1)
    return centres.astype("f4"), colours


def axes(scene):
    """The camera's right, down and forward in the world."""
    eye = np.array(scene.eye, float)
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def focal(scene):
    return scene.size[1] / 2 / math.tan(math.radians(FOV / 2))


def model(scene, cuts):
    """The picture in double precision, over black."""
    size, f = np.array(scene.size), focal(scene)
    centres, colours = gaussians(scene)
    seen = (centres - np.array(scene.eye, float)) @ axes(scene).T
    variance = math.exp(2 * np.float32(math.log(scene.scale)))
    light, through = np.zeros((*size[::-1], 3)), np.ones(size[::-1])
    for i in np.argsort(seen[:, 2].astype("f4"), kind="stable"):
        x, y, z = seen[i]
        if z <= NEAR:
            continue
        slope = np.array([x, y]) / z
        centre = f * slope + size / 2
        limit = 1.3 * size / 2 / f
        # Of a ball, the derivative J of the projection gives J J^T times its variance; 0.3 is the pixel's own.
        to = np.hstack([np.eye(2), -np.clip(slope, -limit, limit)[:, None]]) * f / z
        covariance = variance * to @ to.T + 0.3 * np.eye(2)
        half, determinant = np.trace(covariance) / 2, np.linalg.det(covariance)
        longer = math.sqrt(half + math.sqrt(max(0.1, half * half - determinant)))
        reach = math.ceil(cuts.sigmas * longer) if cuts.sigmas < math.inf else NOTHING * longer
        low = np.clip(np.ceil(centre - reach - 0.5), 0, size).astype(int)
        high = np.clip(np.floor(centre + reach - 0.5) + 1, 0, size).astype(int)
        if (low >= high).any():
            continue
        dx = np.arange(low[0], high[0]) + 0.5 - centre[0]
        dy = (np.arange(low[1], high[1]) + 0.5 - centre[1])[:, None]
        (a, b), (_, c) = np.linalg.inv(covariance)
        value = np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        if cuts.rim:
            value = np.maximum(value - math.exp(-0.5 * cuts.sigmas**2), 0)
        alpha = np.minimum(OPACITY * value, 0.99)
        part = slice(low[1], high[1]), slice(low[0], high[0])
        alpha[(alpha < cuts.least) | (through[part] < cuts.through)] = 0
        weight = alpha * through[part]
        light[part] += weight[:, :, None] * colours[i]
        through[part] -= weight
    return np.floor(np.clip(light, 0, 1) * 255 + 0.5)


def ours(scene, folder):
    """The picture of `b2p render`."""
    centres, colours = gaussians(scene)
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    rest = np.array([-math.log(1 / OPACITY - 1), *[math.log(scene.scale)] * 3, 0, 0, 0, 1])
    rows = np.hstack([centres, (colours - 0.5) / HARMONIC, np.tile(rest, (len(centres), 1))]).astype("<f4")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n" + "".join(f"property float {name}\n" for name in names)
    splats, camera, picture = (folder / f"{scene.name}.{ending}" for ending in ("ply", "json", "png"))
    splats.write_bytes(head.encode() + b"end_header\n" + rows.tobytes())
    right, down, forward = axes(scene)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, -down, -forward, np.array(scene.eye, float)], 1)
    width, height = scene.size
    camera.write_text(json.dumps({"fl_x": focal(scene), "w": width, "h": height, "frames": [{"transform_matrix": matrix.tolist()}]}))
    program = [os.environ["B2P"]] if "B2P" in os.environ else ["cargo", "run", "--release", "--quiet", "--"]
    command = [*program, "render", splats, "--camera", camera, "--background", "black", "-q", "--force", "-o", picture]
    subprocess.run([str(word) for word in command], cwd=ROOT, check=True)
    return np.asarray(Image.open(picture).convert("RGB"), float)


def apart(a, b):
    """PSNR in dB, and the worst and the mean difference, of 255."""
    error = a - b
    mean = np.mean(error**2)
    return (10 * math.log10(255**2 / mean) if mean > 0 else math.inf), np.abs(error).max(), error.mean()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path)
    checkout = parser.parse_args().checkout
    too_far = False

    def line(scene, what, a, b, within=math.inf):
        nonlocal too_far
        psnr, worst, mean = apart(a, b)
        too_far |= worst > within
        print(f"{scene.name:5} {what:42} {psnr:6.2f} dB, worst {worst:3.0f}/255, mean {mean:+.3f}")

    with tempfile.TemporaryDirectory() as folder:
        for scene in SCENES:
            mine, definition = ours(scene, Path(folder)), model(scene, NONE)
            line(scene, "b2p to the model without cuts", mine, definition, WITHIN)
            for commit, cuts in GENERATIONS.items():
                show = ["git", "-C", checkout, "show", f"{commit}:{PICTURE.format(scene.name)}"]
                file = subprocess.run(show, check=True, capture_output=True).stdout
                golden, theirs = np.asarray(Image.open(io.BytesIO(file)).convert("RGB"), float), model(scene, cuts)
                short = commit[:7]
                line(scene, f"{short} to the model with its cuts", golden, theirs, WITHIN)
                line(scene, f"b2p to {short}", mine, golden)
                line(scene, "  the model without cuts to that with them", definition, theirs)
                for cut in ("least", "rim"):
                    rest = replace(cuts, **{cut: getattr(NONE, cut)})
                    if rest != cuts:
                        line(scene, f"  … and with all but its `{cut}`", definition, model(scene, rest))
    sys.exit(too_far)


if __name__ == "__main__":
    main()
