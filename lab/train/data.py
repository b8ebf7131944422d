"""Training samples: the files of `b2p-lab dataset`, and a small procedural generator that needs none."""

import glob
import hashlib
import os
import queue
import threading
from dataclasses import dataclass

import numpy as np
import torch
from safetensors.numpy import load_file, save_file

from crop import Crop, make_crop


@dataclass
class Sample:
    """rgb float [n_3, 3] in 0..1; cameras [V, 16]; image float [V, 3, H, W], premultiplied; coverage [V, 1, H, W]."""

    name: str
    crop: Crop
    rgb: torch.Tensor
    cameras: torch.Tensor
    image: torch.Tensor
    coverage: torch.Tensor

    def to(self, device):
        if device == "cpu":
            return self
        move = lambda t: t.to(device, non_blocking=True)
        return Sample(self.name, self.crop.to(device), move(self.rgb), move(self.cameras), move(self.image), move(self.coverage))


def pictures(image, views):
    t = torch.from_numpy(np.ascontiguousarray(image[views])).permute(0, 3, 1, 2).float().div_(255)
    return t[:, :3].contiguous(), t[:, 3:].contiguous()


def load_sample(path, views=None, rng=None, finest=True):
    """One file. `views`: how many views to draw at random (all, in order, when None); `finest` as in `make_crop`."""
    d = load_file(path)
    chosen = np.arange(len(d["camera"])) if views is None else rng.permutation(len(d["camera"]))[:views]
    coords = [torch.from_numpy(d[f"xyz.{r}"]).int().contiguous() for r in range(4)]
    parents = {r: torch.from_numpy(d[f"parent.{r}"]) for r in (1, 2, 3)}
    image, coverage = pictures(d["image"], chosen)
    return Sample(os.path.basename(path), make_crop(coords, parents, finest), torch.from_numpy(d["rgb"]).float().div_(255),
                  torch.from_numpy(d["camera"][chosen]).contiguous(), image, coverage)


def split(folder, held_out):
    """Files of the folder: (training, held out). The choice depends on the names alone."""
    files = sorted(glob.glob(os.path.join(folder, "*.safetensors")), key=lambda f: hashlib.sha256(os.path.basename(f).encode()).digest())
    if len(files) <= held_out:
        raise SystemExit(f"{folder}: {len(files)} samples, {held_out} wanted for the held-out set alone")
    return files[held_out:], sorted(files[:held_out])


class Stream:
    """Samples in an order that is a function of (seed, position), loaded ahead by one thread; without the finest kernel map those
    whose name is in `known`."""

    def __init__(self, files, views, seed, start=0, ahead=3, known=()):
        self.files, self.views, self.seed, self.known = files, views, seed, known
        self.queue = queue.Queue(ahead)
        self.stopped = False
        threading.Thread(target=self._run, args=(start,), daemon=True).start()

    def _run(self, position):
        torch.set_num_threads(1)
        try:
            while not self.stopped:
                epoch, at = divmod(position, len(self.files))
                order = np.random.default_rng((self.seed, epoch)).permutation(len(self.files))
                rng = np.random.default_rng((self.seed, epoch, at))
                path = self.files[order[at]]
                self.queue.put(load_sample(path, self.views, rng, os.path.basename(path) not in self.known))
                position += 1
        except Exception as error:
            self.queue.put(error)

    def next(self):
        item = self.queue.get()
        if isinstance(item, Exception):
            raise item
        return item


# ---------------------------------------------------------------------------------------------------------------------
# Procedural samples


def morton(c):
    c = np.asarray(c, dtype=np.int64)
    key = np.zeros(len(c), dtype=np.int64)
    for bit in range(20):
        for axis in range(3):
            key |= ((c[:, axis] >> bit) & 1) << (3 * bit + axis)
    return key


def hierarchy(xyz):
    """Sorted unique coordinates of roles 0 .. 3 and the parents of roles 1 .. 3 from finest coordinates; also their order."""
    order = np.argsort(morton(xyz), kind="stable")
    coords, parents = {3: xyz[order]}, {}
    for r in (2, 1, 0):
        up = coords[r + 1] >> 1
        key = morton(up)
        first = np.concatenate([[True], key[1:] != key[:-1]])
        coords[r] = up[first]
        parents[r + 1] = (np.cumsum(first) - 1).astype(np.int32)
    return [torch.from_numpy(coords[r].astype(np.int32)) for r in range(4)], {r: torch.from_numpy(p) for r, p in parents.items()}, order


def texture(p, waves, phase, mix):
    s = np.sin(p @ waves.T + phase)
    return np.clip(0.5 + s @ mix, 0, 1)


def look_at(eye, target):
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    r = np.stack([x, np.cross(z, x), z])
    return r, -r @ eye


def procedural(seed, size=64, views=4, pixels=80):
    """Textured spheres in a box of `size`^3 finest voxels, with analytically ray-cast pictures of the same sample format."""
    rng = np.random.default_rng(seed)
    spheres = [(rng.uniform(0.2, 0.8, 3) * size, rng.uniform(0.15, 0.35) * size) for _ in range(3)]
    waves = rng.normal(size=(6, 3)) * rng.uniform(4, 24, (6, 1)) / size
    phase, mix = rng.uniform(0, 6.28, 6), rng.normal(size=(6, 3)) * 0.22
    grid = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), -1).reshape(-1, 3)
    depth = np.min([np.linalg.norm(grid + 0.5 - c, axis=1) - r for c, r in spheres], axis=0)
    xyz = grid[np.abs(depth) < 0.6]
    coords, parents, order = hierarchy(xyz)
    rgb = np.round(texture(coords[3].numpy() + 0.5, waves, phase, mix) * 255) / 255
    cameras, image, coverage = [], [], []
    sub = 3
    for _ in range(views):
        azimuth, height = rng.uniform(0, 6.28), rng.normal() * 0.4
        direction = np.array([np.cos(height) * np.sin(azimuth), np.sin(height), np.cos(height) * np.cos(azimuth)])
        eye = size / 2 + direction * 4 * size
        r, t = look_at(eye, np.full(3, size / 2))
        f = 4 * pixels * rng.uniform(0.75, 1.1)
        cameras.append(np.concatenate([r.reshape(-1), t, [f, f, pixels / 2, pixels / 2]]))
        at = (np.arange(pixels * sub) + 0.5) / sub - pixels / 2
        ray = np.stack([*np.meshgrid(at / f, at / f), np.ones((pixels * sub,) * 2)], -1) @ r
        near = np.full(ray.shape[:2], np.inf)
        for c, radius in spheres:
            a, b, cc = (ray**2).sum(-1), ray @ (eye - c), ((eye - c) ** 2).sum() - radius**2
            root = b * b - a * cc
            s = np.sqrt(np.maximum(root, 0))
            for d in ((-b - s) / a, (-b + s) / a):
                p = eye + ray * d[..., None]
                near = np.where((root > 0) & (d < near) & ((p >= 0) & (p < size)).all(-1), d, near)
        hit = np.isfinite(near)
        colour = texture(eye + ray * np.where(hit, near, 0)[..., None], waves, phase, mix) * hit[..., None]
        box = lambda v: v.reshape(pixels, sub, pixels, sub, -1).mean((1, 3))
        image.append(box(colour).transpose(2, 0, 1))
        coverage.append(box(hit.astype(float)[..., None]).transpose(2, 0, 1))
    tensor = lambda a: torch.from_numpy(np.ascontiguousarray(a)).float()
    return Sample(f"procedural-{seed}", make_crop(coords, parents), tensor(rgb), tensor(np.stack(cameras)), tensor(np.stack(image)), tensor(np.stack(coverage)))


def save_sample(sample, path, size):
    """Writes a sample in the file format of `b2p-lab dataset`."""
    crop = sample.crop
    out = {f"xyz.{r}": crop.coords[r].numpy() for r in range(4)}
    for r in (1, 2, 3):
        count = (crop.first[r - 1][1:] - crop.first[r - 1][:-1]).numpy()
        out[f"parent.{r}"] = np.repeat(np.arange(len(count), dtype=np.int32), count)
    byte = lambda t: np.clip(np.rint(t.numpy() * 255), 0, 255).astype(np.uint8)
    out["rgb"], out["camera"] = byte(sample.rgb), sample.cameras.numpy()
    out["image"] = np.ascontiguousarray(byte(torch.cat([sample.image, sample.coverage], 1)).transpose(0, 2, 3, 1))
    save_file(out, path, metadata={"name": sample.name, "bits": str(int(size).bit_length() - 1), "size": str(size)})
