"""A cloud's coordinates and kernel maps for all roles."""

from dataclasses import dataclass

import torch

import ops


@dataclass
class Crop:
    """coords[r] int32 [n_r, 3]; kernel3[r]; first[r] = first child (in role r + 1) of each voxel, n_r + 1 entries;
    descent[r] maps role r - 1 to r; corners = 2x2x2 map of role 2; children, children3 = generated level of role 1."""

    coords: list
    kernel3: list
    first: list
    descent: dict
    corners: ops.Map
    children: torch.Tensor
    children3: ops.Map

    @property
    def points(self):
        return self.coords[3].shape[0]

    def to(self, device):
        if device == "cpu":
            return self
        return Crop([c.to(device) for c in self.coords], [k.to(device) for k in self.kernel3], [f.to(device) for f in self.first],
                    {r: m.to(device) for r, m in self.descent.items()}, self.corners.to(device), self.children.to(device),
                    self.children3.to(device))


def join(crops):
    """Several crops as one, far apart."""
    step = 4096  # finest voxels
    coords = [torch.cat([c.coords[r] + torch.tensor([i * step >> (3 - r), 0, 0], dtype=torch.int32) for i, c in enumerate(crops)]) for r in range(4)]
    parents = {}
    for r in (1, 2, 3):
        count = torch.cat([c.first[r - 1][1:] - c.first[r - 1][:-1] for c in crops]).long()
        parents[r] = torch.repeat_interleave(torch.arange(len(count)), count).int()
    return make_crop(coords, parents)


def make_crop(coords, parents, finest=True):
    """coords: four int32 tensors, role 0 .. 3, Morton-sorted; parents[r] (r = 1..3): row of each voxel's parent in role r - 1.
    `finest`: with the kernel map of role 3."""
    first = []
    for r in range(3):
        counts = torch.bincount(parents[r + 1].long(), minlength=coords[r].shape[0])
        first.append(torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)]).int())
    descent = {r: ops.descent(coords[r], parents[r], coords[r - 1].shape[0]) for r in (1, 2, 3)}
    kernel3 = [ops.neighbours(coords[0])]
    for r in (1, 2, 3) if finest else (1, 2):
        kernel3.append(ops.neighbours_below(kernel3[-1], descent[r].back, parents[r], coords[r]))
    children, n = ops.all_children(coords[1]), coords[1].shape[0]
    every = torch.arange(8 * n, dtype=torch.int32)
    children3 = ops.neighbours_below(kernel3[1], every.view(n, 8).T.contiguous(), every // 8, children)
    return Crop(coords, kernel3, first, {r: descent[r] for r in (1, 2)}, ops.corners(coords[2]), children, children3)
