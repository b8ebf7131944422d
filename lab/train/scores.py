"""Pictures of held-out objects scored: heads, a teacher's shapes and surfels, all with the same decoded colours.

scores.py NAME=CHECKPOINT … --samples A.safetensors,… [--teacher DIR] [--steps 4,16] [--no-baselines]
"""

import argparse

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree

from heads import Head, draw, parameters, per_voxel, place, saved_head
from octree_samples import Sample, decoded_colours


def psnr(mse):
    return -10 * float(np.log10(max(mse, 1e-10)))


def score(gaussians, sample, finest):
    """Whole and foreground PSNR over white at the 2x2 average, rounded to bytes, of all pictures of a sample."""
    cameras, image, coverage = sample.pictures(np.arange(len(sample.cameras)))
    seen = draw(gaussians, cameras, finest, torch.ones(len(image), 3), image.shape[-1])
    truth, mask = F.avg_pool2d(image + (1 - coverage), 2), F.avg_pool2d(coverage, 2) > 0.5
    seen = (F.avg_pool2d(seen, 2).clamp(0, 1) * 255).round() / 255
    e = (seen - truth).pow(2)
    return psnr(e.mean().item()), psnr(((e * mask).sum() / (3 * mask.sum())).item())


def surfels(coords, rgb, neighbours=40, sigma=0.42, thin=0.05):
    """Discs of voxels in units of half a voxel: normals are the least axes of neighbourhoods, centres lie on the planes through their means."""
    at = coords.numpy().astype(float) + 0.5
    near = at[cKDTree(at).query(at, k=min(neighbours, len(at)))[1]]
    mean = near.mean(1)
    off = near - mean[:, None]
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))[1][:, :, 0]
    at -= ((at - mean) * normal).sum(1, keepdims=True) * normal
    n = torch.from_numpy(normal).float()
    cov = 4 * (sigma**2 * torch.eye(3) + (thin**2 - sigma**2) * n[:, :, None] * n[:, None, :])
    return 2 * torch.from_numpy(at).float(), cov.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]].contiguous(), torch.ones(len(at)), rgb


def taught(sample, role, rgb, gaussians):
    """The teacher's shapes with decoded colours, in the finest voxels that it was trained to be widened by."""
    own = parameters(sample.taught[f"raw.{role}"].float(), rgb, gaussians)
    mean, cov, alpha, _ = place(own, torch.from_numpy(sample.tree.coords[role]), gaussians)
    times = 2 ** (3 - role) / per_voxel(gaussians)
    return mean * times, cov * times**2, alpha, rgb.repeat_interleave(gaussians, 0)


@torch.no_grad()
def compare(sample, step, heads, baselines):
    """{name: (whole, foreground)} of a sample. `heads`: {name: Head}, drawn at role 2 if of one Gaussian, else at role 1."""
    out = {}
    for k in (1, 8):
        role = {1: 2, 8: 1}[k]
        mine = {name: head for name, head in heads.items() if head.shape["gaussians"] == k}
        if not mine:
            continue
        decoded = decoded_colours(sample.tree, role, step, np.random.default_rng(0))
        above, here, rgb = sample.tree.head_inputs(role, decoded, step)
        level, voxel = sample.tree.level(role), 2 ** (3 - role)
        finest = voxel / per_voxel(k)
        for name, head in mine.items():
            own = parameters(head(above, here, level), rgb, k)
            out[name] = score(place(own, level.coords, k), sample, finest)
            decoded_only = place((*own[:4], rgb.repeat_interleave(k, 0)), level.coords, k)
            out[name + " shapes"] = score(decoded_only, sample, finest)
        if baselines:
            out[f"surfels of {role}"] = score(surfels(level.coords, rgb), sample, voxel / 2)
            if sample.taught:
                out[f"teacher of {role}"] = score(taught(sample, role, rgb, k), sample, 1)
    return out


def load_head(paths):
    """The averaged weights of a checkpoint or a set of a model file (`saved_head`); of several, joined by +, their mean."""
    shapes, weights = zip(*(saved_head(path) for path in paths.split("+")))
    head = Head(shapes[0])
    head.load_state_dict({k: torch.stack([w[k] for w in weights]).mean(0) for k in weights[0]})
    return head.eval()


def main():
    p = argparse.ArgumentParser()
    p.add_argument("heads", nargs="+", metavar="NAME=CHECKPOINT")
    p.add_argument("--samples", required=True, help="sample files, comma-separated")
    p.add_argument("--teacher")
    p.add_argument("--steps", default="4,16")
    p.add_argument("--no-baselines", action="store_true")
    args = p.parse_args()
    torch.set_num_threads(1)
    heads = {name: load_head(path) for name, path in (h.split("=") for h in args.heads)}
    sums = {}
    for path in args.samples.split(","):
        sample = Sample(path, 2, args.teacher)
        for step in map(float, args.steps.split(",")):
            result = compare(sample, step, heads, not args.no_baselines)
            print(sample.name, step, " ".join(f"{k} {w:.2f}/{f:.2f}" for k, (w, f) in result.items()), flush=True)
            for k, v in result.items():
                sums.setdefault((step, k), []).append(v)
    for (step, k), v in sums.items():
        print("mean", step, k, "%.2f / %.2f" % tuple(np.mean(v, 0)), flush=True)


if __name__ == "__main__":
    main()
