"""Checks of the GPU's trainer, on the CPU: levels, coding noise, heads and splatter of batches against those of single samples. Prints `ok` or raises."""

import os
import tempfile

import numpy as np
import torch

import octree_samples
import ops
import train_gpu
from batch import Batch, decoded_colours
from check_heads import SHAPES, near, sample_file
from heads import Head, parameters, per_voxel, place
from octree_samples import Sample
from splat_gpu import splat

STEPS, ROUNDING, GAIN, CHROMA = [10.0, 1.0], 0.4, 0.8, [1.5, 2.0]


class Fixed:
    """Random numbers in the order in which `octree_samples.decoded_colours` draws them."""

    def __init__(self):
        self.left = [ROUNDING, GAIN, *CHROMA]

    def uniform(self, low, high):
        return self.left.pop(0)


def batch_of(samples, role):
    voxels = [samples[i].tree.coords[role] for i in range(2)]
    which = torch.tensor([0] * len(voxels[0]) + [1] * len(voxels[1]))
    colours = torch.from_numpy(np.concatenate([s.tree.colours[role] for s in samples]))
    return Batch(role, samples[0].tree.depth - (3 - role), torch.from_numpy(np.concatenate(voxels)), which, colours, 2, dtype=torch.float32)


def check_levels(samples, role, batch):
    for r in (role, role - 1):
        first = 0
        for s in samples:
            n = len(s.tree.coords[r])
            table = batch.at[r].near[first : first + n].T
            assert (torch.where(table == len(batch.at[r].coords), -1, table - first).int() == s.tree.map[r].table).all()
            first += n


def check_noise(samples, role, batch):
    numbers = torch.tensor(STEPS), torch.full((2,), ROUNDING), torch.full((2,), GAIN), torch.tensor([[1.0, *CHROMA]] * 2)
    mine = decoded_colours(batch, *numbers)
    for r in (role, role - 1):
        theirs = np.concatenate([octree_samples.decoded_colours(s.tree, role, step, Fixed())[r] for s, step in zip(samples, STEPS)])
        apart = np.abs(theirs - mine[r].numpy())
        assert (apart > 0).mean() < 0.002 and apart.max() <= 1, (r, apart.max())  # roundings of f32 and f64 differ now and then
    return mine


def check_head(shape, samples, role, batch, decoded):
    torch.manual_seed(1)
    head = Head(shape)

    def gradients(raw):
        head.zero_grad()
        raw.pow(2).mean().backward()
        return raw.detach(), {n: p.grad.clone() for n, p in head.named_parameters()}

    above, here, rgb = batch.head_inputs(decoded, torch.tensor(STEPS))
    together = gradients(head(above, here, batch.level()))
    parts = []
    for i, (s, step) in enumerate(zip(samples, STEPS)):
        own = {r: decoded[r][batch.at[r].which == i].numpy().astype(np.uint8) for r in (role, role - 1)}
        above, here, _ = s.tree.head_inputs(role, own, step)
        parts.append(head(above, here, s.tree.level(role)))
    apart = gradients(torch.cat(parts))
    near(together[0], apart[0], 1e-5)
    for name in apart[1]:
        near(together[1][name], apart[1][name], 1e-4)
    return place(parameters(together[0], rgb, shape["gaussians"]), batch.at[role].coords, shape["gaussians"])


def check_splatter(gaussians, k, samples, role, batch):
    """In f64 up to the order of splats, which would differ where distances are equal in f32."""
    gaussians = [g.detach().double().requires_grad_() for g in gaussians]
    cameras = torch.cat([s.cameras for s in samples]).double()
    cameras[:, 9:12] /= 2 ** (3 - role) / per_voxel(k)
    cloud, which = torch.tensor([0, 0, 1, 1]), batch.at[role].which.repeat_interleave(k)
    background, weight = torch.rand(4, 3), torch.randn(4, 3, 40, 40)

    def gradients(image):
        for g in gaussians:
            g.grad = None
        (image * weight).sum().backward()
        return image.detach(), [g.grad.clone() for g in gaussians]

    mine = gradients(splat(*gaussians, which, cameras, cloud, background, 40))
    with ops.reference():
        views = [ops.splat(*(g[which == c] for g in gaussians), cameras[v : v + 1], background[v : v + 1].double(), 40, 40) for v, c in enumerate(cloud.tolist())]
    plain = gradients(torch.cat(views))
    near(mine[0], plain[0], 1e-4)
    for a, b in zip(mine[1], plain[1]):
        near(a, b, 2e-3)


def check_training(folder):
    """A few steps from the project's heads run, and every head is written."""
    out = os.path.join(folder, "out")
    steps = train_gpu.main(["--device", "cpu", "--data", folder, "--out", out, "--minutes", "0.1", "--wait", "2", "--most", "2",
                            "--init", os.path.join(os.path.dirname(os.path.abspath(__file__)), "../../models/heads.safetensors")])
    assert steps > 0
    assert sorted(os.listdir(out)) == ["best.1.pt", "best.8.pt", "quick.1.pt", "quick.8.pt"]


def main():
    torch.set_num_threads(1)
    ops.extension().set_bf16(False)
    with tempfile.TemporaryDirectory() as folder:
        samples = [Sample(sample_file(folder, seed), 3) for seed in range(2)]
        for role in (3, 2):
            batch = batch_of(samples, role)
            check_levels(samples, role, batch)
            decoded = check_noise(samples, role, batch)
            for shape in SHAPES:
                check_splatter(check_head(shape, samples, role, batch, decoded), shape["gaussians"], samples, role, batch)
        check_training(folder)
    print("ok")


if __name__ == "__main__":
    main()
