"""Closed-form Gaussians: clause 6 of docs/format.md."""

from dataclasses import dataclass, replace

import numpy as np

from octree import ABSENT, OFFSETS

F = np.float32
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@dataclass
class Gaussians:
    """6.1.2: arrays of f32, one row for each Gaussian."""

    position: np.ndarray
    scale: np.ndarray
    rotation: np.ndarray
    opacity: np.ndarray
    colour: np.ndarray

    def tobytes(self):
        """16.1"""
        return b"".join(np.ascontiguousarray(array, dtype="<f4").tobytes() for array in vars(self).values())

    def of(self, rows):
        """Some of them."""
        return Gaussians(*(array[rows] for array in vars(self).values()))

    def thicker(self, by):
        """7.5.5: by so much in the cube frame."""
        if by == 0:
            return self
        scale, rows = self.scale.copy(), np.arange(len(self.scale))
        least = scale.argmin(axis=1)
        s = scale[rows, least]
        scale[rows, least] = np.sqrt(s * s + by * by)
        return replace(self, scale=scale)

    def followed_by(self, others):
        both = zip(vars(self).values(), vars(others).values())
        return Gaussians(*(np.concatenate(arrays) for arrays in both))


def moments(voxels):
    """6.2.1: near and far moments, [voxels, 10] modulo 2^16."""
    x, y, z = np.array(voxels.coordinates, dtype=np.int64).T
    own = np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], axis=1) & 65535
    near = np.array(voxels.near)
    present = (near != ABSENT)[:, :, None]

    def step(m):
        return np.where(present, m[near], 0).sum(axis=1) & 65535

    first = step(own)
    return first, step(step(first))


def signed(x):
    """Numbers modulo 2^16 as i16."""
    return (x + 32768 & 65535) - 32768


def relative(m, coordinates):
    """6.2.2, in f32: n, s, q."""
    c = np.array(coordinates, dtype=np.int64)
    s = [m[:, 1 + a] - m[:, 0] * c[:, a] & 65535 for a in range(3)]
    q = []
    for k, (a, b) in enumerate(PAIRS):
        moved = m[:, 4 + k] - (c[:, a] * s[b] + c[:, b] * m[:, 1 + a]) & 65535
        q.append(F(moved if a == b else signed(moved)))
    return F(m[:, 0]), [F(signed(x)) for x in s], q


def sparsity(degree, n, levels):
    """6.3.2: masks of the voxels in open blocks, and of those that are noise unless they take a window. `levels` are
    the ranges of voxels of which each counts as a level: those of the blocks of a scene (18.4.2)."""
    parts = [sparsity_of_level(degree[part.start : part.stop], n[part.start : part.stop]) for part in levels]
    return [np.concatenate(masks) for masks in zip(*parts)]


def sparsity_of_level(degree, n):
    """6.3.2"""
    is_open, noise = np.zeros(len(n), dtype=bool), np.zeros(len(n), dtype=bool)
    if len(n) < 1024 or 512 * (degree == 1).sum() < len(n):
        return is_open, noise
    for first in range(0, len(n), 1024):
        block = slice(first, first + 1024)
        specks = n[block] < 27
        few = (n[block] < 300) & ~specks
        noisy = 4 * specks.sum() < len(specks)
        is_open[block] = 8 * few.sum() >= len(specks) or not noisy
        noise[block] = specks & noisy
    return is_open, noise


def windows(voxels, wanted):
    """6.3.3: rows, n, s, q (as in 6.2.2) and reach of the voxels that take a window."""
    all_voxels = np.array(voxels.coordinates, dtype=np.int64)
    scales = range(1, min(3, voxels.level) + 1)
    cells = {k: {} for k in scales}
    for k in scales if wanted.any() else ():
        for i, c in enumerate(all_voxels):
            cells[k].setdefault(tuple(c >> k), []).append(i)
    found = []
    for i in np.flatnonzero(wanted):
        for k in scales:
            around = [tuple((all_voxels[i] >> k) + delta) for delta in OFFSETS]
            near = [j for cell in around for j in cells[k].get(cell, ())]
            d = all_voxels[near] - all_voxels[i]
            d = d[(abs(d) <= 1 << k).all(axis=1)]
            if len(d) >= 16:
                found.append((i, len(d), *d.sum(axis=0), *((d[:, a] * d[:, b]).sum() for a, b in PAIRS), 1 << k))
                break
    table = np.array(found, dtype=np.int64).reshape(-1, 12).T
    return table[0], F(table[1]), [F(x) for x in table[2:5]], [F(x) for x in table[5:11]], F(table[11])


def dot(a, b):
    """6.5"""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def normals(cov):
    """6.4: the normal, and the least and the middle variance."""
    d, off = list(cov[:3]), list(cov[3:])
    axes = [[np.full_like(d[0], k == i) for i in range(3)] for k in range(3)]
    for entry, p, q, g, h in 4 * [(0, 0, 1, 1, 2), (1, 0, 2, 0, 2), (2, 1, 2, 0, 1)]:
        difference, double = d[q] - d[p], F(2) * off[entry]
        length = np.sqrt(difference * difference + double * double)
        t = double / (difference + np.copysign(length, difference) + np.copysign(F(1e-20), difference))
        c = F(1) / np.sqrt(t * t + F(1))
        s = t * c
        shift = t * off[entry]
        d[p], d[q], off[entry] = d[p] - shift, d[q] + shift, np.zeros_like(shift)
        x, y = off[g], off[h]
        off[g], off[h] = c * x - s * y, s * x + c * y
        for row in axes:
            x, y = row[p], row[q]
            row[p], row[q] = c * x - s * y, s * x + c * y
    of_z = (d[2] <= d[0]) & (d[2] <= d[1])
    of_y = d[1] <= d[0]
    normal = [np.where(of_z, row[2], np.where(of_y, row[1], row[0])) for row in axes]
    up = np.copysign(F(1), normal[2])
    low, high = np.minimum(d[0], d[1]), np.maximum(d[0], d[1])
    return [n * up for n in normal], np.minimum(low, d[2]), np.maximum(low, np.minimum(high, d[2]))


def window_spacing(n, shift, density, reach):
    """6.5.3"""
    side = F(2) * reach + F(1)
    border = F(1) + F(4) * shift / (reach * reach)
    filled = np.minimum(n * border / (side * side * density), F(1))
    return np.minimum((F(1) + F(0.5) * (F(1) - filled)) / np.sqrt(filled), reach)


def disc(near, n, s, q, reach=None):
    """6.3 to 6.5: place, radius, thickness, rotation and spacing, as one array of 10 rows."""
    centre = [x / n for x in s]
    normal, least, middle = normals([x / n - centre[a] * centre[b] for x, (a, b) in zip(q, PAIRS)])
    low, high = dot(near, normal), dot(centre, normal)
    density = abs(normal[0]) + abs(normal[1]) + abs(normal[2])
    thick = np.clip((least - density * density / F(12)) / F(0.4), F(0), F(1))
    height = high + thick * (low - high)
    place = [normal[a] * height + F(0.2) * (centre[a] - high * normal[a]) for a in range(3)]
    if reach is None:
        flat = np.minimum(middle / F(0.6), F(1))
        spacing = np.ones_like(flat)
    else:
        shift = np.maximum(dot(centre, centre) - high * high, F(0))
        extent = np.minimum(middle / (F(0.15) * (reach * reach)), F(1))
        flat = extent * np.clip(F(2) - F(4) * least / (middle + F(1e-6)), F(0), F(1))
        spacing = window_spacing(n, shift, density, reach)
    radius = F(0.4) + flat * (F(0.62) / np.sqrt(density) * spacing - F(0.4))
    thickness = F(0.4) + flat * (F(0.01) - F(0.4))
    w = F(1) + normal[2]
    norm = np.sqrt(w * w + normal[0] * normal[0] + normal[1] * normal[1])
    rotation = [w / norm, -normal[1] / norm, normal[0] / norm, np.zeros_like(w)]
    return np.stack([*place, radius, thickness, *rotation, spacing])


def discs(voxels, levels):
    """6.5: place, radius, thickness, rotation, spacing and opacity of every voxel's disc."""
    near, far = moments(voxels)
    is_open, noise = sparsity(near[:, 0], far[:, 0], levels)
    n, s, _ = relative(near, voxels.coordinates)
    near = np.stack([x / n for x in s])
    made = disc(near, *relative(far, voxels.coordinates))
    rows, *window = windows(voxels, is_open & (far[:, 0] < 300))
    opacity = np.where(noise, F(1 / 64), F(1))
    opacity[rows] = 1
    if len(rows):
        made[:, rows] = disc(near[:, rows], *window)
    return list(made[:3]), made[3], made[4], list(made[5:9]), made[9], opacity


def quarters(voxels, colours, place, rotation, spacing):
    """6.6.3: offsets and colours of four Gaussians for each voxel."""
    w, x, y, _ = rotation
    one, two = F(1), F(2)
    u = [one - two * y * y, two * x * y, -two * w * y]
    v = [two * x * y, one - two * x * x, two * w * x]
    uu, uv, vv = np.full_like(w, 0.3), np.zeros_like(w), np.full_like(w, 0.3)
    ru, rv = [np.zeros((3, len(w)), dtype=F) for _ in range(2)]
    for k, j in enumerate(np.array(voxels.near).T):
        there = j != ABSENT
        delta = [F(d) for d in OFFSETS[k]]
        a, b = (np.where(there, dot(delta, axis), F(0)) for axis in (u, v))
        change = np.where(there, colours[:, j] - colours, F(0))
        uu, uv, vv = uu + a * a, uv + a * b, vv + b * b
        ru, rv = ru + a * change, rv + b * change
    det = uu * vv - uv * uv
    gu, gv = (vv * ru - uv * rv) / det, (uu * rv - uv * ru) / det
    far = F(0.25) * spacing
    for a, b in ((-far, -far), (far, -far), (-far, far), (far, far)):
        offset = [place[i] + a * u[i] + b * v[i] for i in range(3)]
        yield offset, np.clip(colours + a * gu + b * gv, F(0), F(255))


def surfels(voxels, colours, count, size, levels=None):
    """6.6: one or four Gaussians for each voxel; `size`, one or one of each voxel, in 64ths. `levels`: see sparsity."""
    place, radius, thickness, rotation, spacing, opacity = discs(voxels, levels or [range(len(voxels))])
    colours = np.array(colours, dtype=F).T
    edge = F(2) / F(1 << voxels.level)
    parts, narrow = [(place, colours)], F(1)
    if count == 4:
        parts, narrow = list(quarters(voxels, colours, place, rotation, spacing)), F(0.6)
    centre = (np.array(voxels.coordinates, dtype=np.float64) + 0.5) * np.float64(edge) - 1
    r = radius * narrow * (F(size) / F(64)) * edge

    def rows(arrays):
        return np.stack([np.stack(list(a), axis=1) for a in arrays], axis=1).reshape(-1, len(arrays[0]))

    return Gaussians(
        rows([[F(centre[:, a]) + offset[a] * edge for a in range(3)] for offset, _ in parts]),
        rows([[r, r, thickness * edge]] * len(parts)),
        rows([rotation] * len(parts)),
        np.repeat(opacity, len(parts)),
        rows([rgb / F(255) for _, rgb in parts]),
    )
