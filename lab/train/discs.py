"""The closed form's discs (`src/gaussians/surfels`) of a level, in floats."""

import numpy as np
import torch

import ops

RADIUS, THICKNESS, SPHERE, SURFACE, THICK, INWARDS = 0.62, 0.01, 0.4, 0.6, 0.4, 0.2
OFFSET, SHRINK, DAMPING = 0.25, 0.6, 0.3
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def moments(coords, table):
    """Mean [n, 3], relative to the voxel, and covariance [n, 3, 3] of the neighbourhoods after one step and after three."""
    at = coords.double()
    m = torch.cat([torch.ones(len(at), 1).double(), at] + [at[:, a : a + 1] * at[:, b : b + 1] for a, b in PAIRS], 1)
    out = []
    rows = torch.where(table >= 0, table, len(at)).long()
    for step in range(3):
        padded = torch.cat([m, m.new_zeros(1, m.shape[1])])
        m = sum(padded[row] for row in rows)
        if step != 1:
            mean = m[:, 1:4] / m[:, :1]
            second = m[:, 4:] / m[:, :1]
            cov = torch.stack([second[:, k] - mean[:, a] * mean[:, b] for k, (a, b) in enumerate(PAIRS)], 1)
            out.append((mean - at, cov[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].view(-1, 3, 3)))
    return out


class Discs:
    """centre [n, 3] relative to the voxel's centre, axes [n, 3, 3] (columns u, v, normal), radius and thickness [n], in voxels."""

    def __init__(self, coords, table):
        (near, _), (far, cov) = moments(coords, table)
        values, vectors = torch.linalg.eigh(cov)
        normal = vectors[:, :, 0]
        normal = normal * torch.where(normal[:, 2:] < 0, -1.0, 1.0)
        low, high = (near * normal).sum(1), (far * normal).sum(1)
        density = normal.abs().sum(1)
        self.excess = values[:, 0] - density**2 / 12
        thick = (self.excess / THICK).clamp(0, 1)
        height = high + thick * (low - high)
        self.centre = (normal * height[:, None] + INWARDS * (far - high[:, None] * normal)).float()
        self.middle = values[:, 1]
        flat = (self.middle / SURFACE).clamp(max=1)
        self.radius = (SPHERE + flat * (RADIUS / density.sqrt() - SPHERE)).float()
        self.thickness = (SPHERE + flat * (THICKNESS - SPHERE)).float()
        x, y, z = normal.T
        w = 1 + z
        norm = (w * w + x * x + y * y).sqrt()
        w, x, y = w / norm, -y / norm, x / norm
        u = torch.stack([1 - 2 * y * y, 2 * x * y, -2 * w * y], 1)
        v = torch.stack([2 * x * y, 1 - 2 * x * x, 2 * w * x], 1)
        self.axes = torch.stack([u, v, normal], 2).float()

    def gradient(self, table, rgb):
        """Colour gradients [n, 3] along u and v, by least squares over neighbours."""
        u, v = self.axes[:, :, 0], self.axes[:, :, 1]
        uu = u.new_full((len(u),), DAMPING)
        uv, vv, ru, rv = torch.zeros_like(uu), uu.clone(), torch.zeros_like(rgb), torch.zeros_like(rgb)
        for row, offset in zip(table, ops.OFFSETS3.float()):
            there = (row >= 0).float()
            a, b = (u @ offset) * there, (v @ offset) * there
            uu, uv, vv = uu + a * a, uv + a * b, vv + b * b
            change = rgb[row.clamp_min(0).long()] - rgb
            ru, rv = ru + a[:, None] * change, rv + b[:, None] * change
        det = uu * vv - uv * uv
        solve = lambda a, b, c, d: (a[:, None] * b - c[:, None] * d) / det[:, None]
        return solve(vv, ru, uv, rv), solve(uu, rv, uv, ru)

    def place(self, coords, table, rgb, times, four, factor=1.0):
        """What the splatter draws, `times` units a voxel: one disc a voxel, or four."""
        at = coords + 0.5 + self.centre
        size = self.radius * factor
        if four:
            gu, gv = self.gradient(table, rgb)
            signs = ((-OFFSET, -OFFSET), (OFFSET, -OFFSET), (-OFFSET, OFFSET), (OFFSET, OFFSET))
            at = torch.stack([at + a * self.axes[:, :, 0] + b * self.axes[:, :, 1] for a, b in signs], 1).reshape(-1, 3)
            rgb = torch.stack([(rgb + a * gu + b * gv).clamp(0, 1) for a, b in signs], 1).reshape(-1, 3)
            size = size * SHRINK
        sigma = torch.stack([size, size, self.thickness], 1)
        scaled = self.axes * sigma[:, None, :]
        cov = (scaled @ scaled.transpose(1, 2)) * times**2
        cov = cov.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]].contiguous()
        if four:
            cov = cov.repeat_interleave(4, 0)
        return times * at, cov, torch.ones(len(at)), rgb
