"""Samples as octree levels: occupancy, true and decoded colours of every level from the root to the finest."""

import os

import numpy as np
import torch
from safetensors.numpy import load_file

import data
import ops
from heads import Level, inputs

FINEST = 3  # the role of the finest voxels; every level above has one less
OCTANTS = np.array([[o & 1, o >> 1 & 1, o >> 2] for o in range(8)])


class Tree:
    """All levels of a sample from the root (`roles[0]`) to `top`. coords[r] int32 [n_r, 3]; parent[r], octant[r]; children[r] [n_r, 8], rows of role r + 1
    or -1; colours[r] f32 [n_r, 3] in 0..255, of which a parent's is the mean of its children's; map[r] the 3x3x3 kernel map. `xyz` and `rgb` are voxels
    of role `finest` in Morton order; `depth` is the level of role FINEST."""

    def __init__(self, xyz, rgb, depth, top, finest=FINEST):
        self.depth = depth
        self.roles = range(FINEST - depth, top + 1)
        self.coords, self.colours, self.parent, self.octant, self.children = {finest: xyz}, {finest: rgb.astype(np.float32)}, {}, {}, {}
        for r in range(finest - 1, self.roles[0] - 1, -1):
            self._above(r)
        self.map = {self.roles[0]: ops.neighbours(torch.from_numpy(self.coords[self.roles[0]]))}
        for r in self.roles[1:]:
            child = torch.from_numpy(np.ascontiguousarray(self.children[r - 1].T))
            self.map[r] = ops.neighbours_below(self.map[r - 1], child, torch.from_numpy(self.parent[r]), torch.from_numpy(self.coords[r]))
        self._levels = {}

    def _above(self, r):
        below = self.coords[r + 1]
        up = below >> 1
        first = np.concatenate([[True], (up[1:] != up[:-1]).any(1)])
        parent = (np.cumsum(first) - 1).astype(np.int32)
        self.coords[r] = np.ascontiguousarray(up[first])
        self.parent[r + 1] = parent
        self.octant[r + 1] = (below & 1) @ np.array([1, 2, 4])
        self.children[r] = np.full((len(self.coords[r]), 8), -1, np.int32)
        self.children[r][parent, self.octant[r + 1]] = np.arange(len(below))
        count = np.bincount(parent)[:, None]
        sums = np.stack([np.bincount(parent, self.colours[r + 1][:, c]) for c in range(3)], 1)
        self.colours[r] = (sums / count).astype(np.float32)

    def level(self, r):
        """The kernel maps that a head at role r needs."""
        if r not in self._levels:
            coords = torch.from_numpy(self.coords[r])
            descent = ops.descent(coords, torch.from_numpy(self.parent[r]), len(self.coords[r - 1]))
            self._levels[r] = Level(coords, self.map[r - 1], self.map[r], descent)
        return self._levels[r]

    def head_inputs(self, r, decoded, step):
        """Input channels of both levels, and the decoded colours in 0..1. `decoded`: {role: u8 [n, 3]} of r and r - 1."""
        occupancy = torch.from_numpy((self.children[r - 1] >= 0).astype(np.float32))
        above, here = (torch.from_numpy(decoded[k]).float() for k in (r - 1, r))
        return *inputs(occupancy, above, here, torch.from_numpy(self.parent[r]).long(), step), here / 255

    def child_colours(self, r):
        """True colours [8 n_r, 3] of the children of every voxel of role r, its own where there is none, in 0..1; and which there are."""
        rows = self.children[r].reshape(-1)
        own = np.repeat(self.colours[r], 8, 0)
        return torch.from_numpy(np.where(rows[:, None] >= 0, self.colours[r + 1][rows], own) / 255).float(), torch.from_numpy(rows >= 0)


# ---------------------------------------------------------------------------------------------------------------------
# Coding noise, as transform coding with prediction makes it


def forward_ycc(rgb):
    r, g, b = rgb.T
    return np.stack([(r + 2 * g + b) / 4, r - b, g - (r + b) / 2], 1)


def inverse_ycc(ycc):
    y, co, cg = ycc.T
    t = y - cg / 2
    b = t - co / 2
    return np.stack([b + co, y + cg / 2, b], 1)


def neighbour_weights(width=0.7):
    """Gaussian weights [8, 7] of a parent and its six face neighbours (taps of the 3x3x3 map) for each of its children."""
    taps = [13, 12, 14, 10, 16, 4, 22]
    offset = ops.OFFSETS3[taps].numpy().astype(float)
    child = OCTANTS / 2 - 0.25
    return taps, np.exp(-((child[:, None] - offset[None]) ** 2).sum(-1) / (2 * width * width)).astype(np.float32)


TAPS, WEIGHTS = neighbour_weights()


def predict(above, table):
    """[n, 8, c]: what every child, there or not, would have as the weighted mean of its parent and that one's face neighbours."""
    rows = table[TAPS]  # [7, n]
    there = (rows >= 0).astype(np.float32)
    weighted = np.einsum("ot,tn,tnc->noc", WEIGHTS, there, above[rows], optimize=True)
    return weighted / np.einsum("ot,tn->no", WEIGHTS, there)[:, :, None]


def transform(values, there):
    """Two-point butterflies along x, y, z of [n, 8, c] where `there` [n, 8]: lists of (coefficients, which exist, weights), then the means."""
    weight, steps = there.astype(np.float32), []
    for _ in range(3):
        a, b, wa, wb = values[:, 0::2], values[:, 1::2], weight[:, 0::2], weight[:, 1::2]
        total = np.maximum(wa + wb, 1e-9)
        gain = np.sqrt(wa * wb / total)[:, :, None]
        steps.append(((b - a) * gain, gain, wa / total, wb / total))
        values, weight = (a * wa[:, :, None] + b * wb[:, :, None]) / total[:, :, None], wa + wb
    return steps, values[:, 0]


def inverse(steps, coefficients, mean):
    values = mean[:, None]
    for (_, gain, wa, wb), c in zip(reversed(steps), reversed(coefficients)):
        d = c / np.maximum(gain, 1e-9) * (gain > 0)
        a, b = values - d * wb[:, :, None], values + d * wa[:, :, None]
        values = np.stack([a, b], 2).reshape(len(a), -1, values.shape[2])
    return values


def quantise(x, step, rounding):
    return np.sign(x) * np.floor(np.abs(x) / step + rounding) * step


def smooth(values, table, truth, step):
    """One pass of a fitted bilateral filter: differences to neighbours, bounded at two multiples of the step, weighted by least squares per channel."""
    near = {1: ([], 1.0), 2: ([], 0.6), 3: ([], 0.35)}  # faces, edges, corners
    for tap, offset in enumerate(ops.OFFSETS3.numpy()):
        if np.abs(offset).sum():
            near[int(np.abs(offset).sum())][0].append(tap)
    terms = {}
    for kind, (taps, weight) in near.items():
        rows = table[taps]
        d = np.where(rows[:, :, None] >= 0, values[rows] - values, 0)
        for k in (0.4, 1.6):
            terms[kind, k] = weight / 16 * (d / (1 + (d / (k * step)) ** 2)).sum(0)
    five = [terms[1, 0.4], terms[2, 0.4], terms[3, 0.4], terms[1, 1.6], terms[2, 1.6] + terms[3, 1.6]]
    out = values.copy()
    for c in range(3):
        a = np.stack([t[:, c] for t in five], 1)
        out[:, c] += a @ np.linalg.lstsq(a.T @ a + 1e-3 * np.eye(5), a.T @ (truth[:, c] - values[:, c]), rcond=None)[0]
    return out


def decoded_colours(tree, role, step, rng):
    """{role: u8 [n, 3]} of `role` and the one above, as if coded with luma's `step` at `role`, half of it above, and so on, and `role` filtered twice.
    Step 1: the true ones, rounded."""
    to_bytes = lambda rgb: np.clip(np.rint(rgb), 0, 255).astype(np.uint8)
    if step <= 1:
        return {k: to_bytes(tree.colours[k]) for k in (role - 1, role)}
    rounding, gain = rng.uniform(0.3, 0.5), rng.uniform(0.6, 0.9)
    chroma = np.array([1, rng.uniform(1, 2), rng.uniform(1.4, 2.2)]) * step
    roles = [r for r in tree.roles if r <= role]
    first = max(roles[0], role - 6)  # what is coarser has lost nothing that shows
    values, out = forward_ycc(tree.colours[first]), {}
    for r in range(first + 1, role + 1):
        rows = tree.children[r - 1]
        there = rows >= 0
        steps, _ = transform(forward_ycc(tree.colours[r])[rows], there)
        guess, _ = transform(predict(values, tree.map[r - 1].table.numpy()), there)
        size = np.maximum(chroma / 2 ** (role - r), 1)
        coded = [g[0] * gain + quantise(s[0] - g[0] * gain, size, rounding) for s, g in zip(steps, guess)]
        values = inverse(steps, coded, values)[there]
        if r == role:
            for _ in range(2):
                values = smooth(values, tree.map[r].table.numpy(), forward_ycc(tree.colours[r]), size)
        if r >= role - 1:
            out[r] = to_bytes(inverse_ycc(values))
    return out


# ---------------------------------------------------------------------------------------------------------------------


class Sample:
    """A file of `b2p-lab dataset` as a tree, with its pictures, and what a teacher said of it, if that is known. `moved[r]` are trees whose role r is
    optimised occupancy, if `moved.py` wrote some to the folder `moved`."""

    def __init__(self, path, top=2, teacher=None, moved=None):
        self.name = os.path.basename(path).removesuffix(".safetensors")
        d = load_file(path)
        depth = max(int(d["xyz.3"].max()).bit_length(), 5)  # a crop is the root of a tree of its own
        self.tree = Tree(d["xyz.3"], d["rgb"], depth, top)
        self.cameras, self.image = torch.from_numpy(d["camera"]), d["image"]
        self.taught = None
        if teacher and os.path.exists(taught := os.path.join(teacher, os.path.basename(path))):
            self.taught = {k: torch.from_numpy(v) for k, v in load_file(taught).items()}
        self.moved = {}
        if moved and os.path.exists(moved := os.path.join(moved, os.path.basename(path))):
            d = load_file(moved)
            for key in sorted(k for k in d if k.startswith("xyz.")):
                role = int(key.split(".")[1])
                if role <= top:
                    self.moved.setdefault(role, []).append(Tree(d[key], d[key.replace("xyz", "rgb")], depth, role, role))

    def pictures(self, views):
        """Cameras, premultiplied colours [V, 3, H, W] and coverage [V, 1, H, W]."""
        image, coverage = data.pictures(self.image, views)
        return self.cameras[views].contiguous(), image, coverage
