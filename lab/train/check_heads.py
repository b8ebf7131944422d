"""Checks of the heads' trainer: the C++ path against plain PyTorch, the coding noise, and the model file. Prints `ok` or raises."""

import json
import os
import tempfile

import numpy as np
import torch
from safetensors import safe_open

import data
import ops
from export_heads import main as export
from heads import Head, draw, parameters, per_voxel, place
from octree_samples import Sample, Tree, decoded_colours, inverse, transform

SHAPES = [{"channels": 16, "parent_blocks": 1, "child_blocks": 1, "gaussians": k} for k in (1, 8)]


def sample_file(folder, seed=0):
    path = os.path.join(folder, f"procedural-{seed}.safetensors")
    data.save_sample(data.procedural(seed, size=32, views=2, pixels=40), path, 40)
    return path


def gradients(head, sample, role):
    """Raw numbers, a picture, and the gradient of a loss of both, of the path in use."""
    head.zero_grad()
    above, here, rgb = sample.tree.head_inputs(role, decoded_colours(sample.tree, role, 8.0, np.random.default_rng(0)), 8.0)
    level, k = sample.tree.level(role), head.shape["gaussians"]
    raw = head(above, here, level)
    image = draw(place(parameters(raw, rgb, k), level.coords, k), sample.cameras, 2 ** (3 - role) / per_voxel(k), torch.ones(len(sample.cameras), 3), 40)
    (image.pow(2).mean() + raw.pow(2).mean()).backward()
    return raw.detach(), image.detach(), {n: p.grad.clone() for n, p in head.named_parameters()}


def near(a, b, tolerance):
    assert (a - b).abs().max() <= tolerance * (1 + b.abs().max()), (a - b).abs().max()


def check_both_paths_agree(path):
    sample = Sample(path)
    for shape in SHAPES:
        torch.manual_seed(1)
        head = Head(shape)
        fast = gradients(head, sample, 2)
        with ops.reference():
            plain = gradients(head, sample, 2)
        near(fast[0], plain[0], 1e-5)
        near(fast[1], plain[1], 1e-3)
        for name in fast[2]:
            near(fast[2][name], plain[2][name], 2e-3)


def check_noise(path):
    tree = Sample(path).tree
    rng = np.random.default_rng(0)
    for role in (2, 1):
        exact = decoded_colours(tree, role, 1.0, rng)[role]
        assert np.abs(exact - tree.colours[role]).max() <= 0.5001
        errors = [np.abs(decoded_colours(tree, role, step, rng)[role] - tree.colours[role]).mean() for step in (1.01, 8.0, 40.0)]
        assert errors[0] < errors[1] < errors[2] and errors[0] < 1.5, errors


def check_transform_inverts():
    rng = np.random.default_rng(0)
    there = rng.random((50, 8)) < 0.5
    there[:, 3] = True
    values = rng.normal(size=(50, 8, 3)) * there[:, :, None]
    steps, mean = transform(values, there)
    assert np.abs((values * there[:, :, None]).sum(1) / there.sum(1)[:, None] - mean).max() < 1e-6
    back = inverse(steps, [s[0] for s in steps], mean)
    assert np.abs(back - values)[there].max() < 1e-6


def check_file(folder, path):
    torch.manual_seed(2)
    arguments = [os.path.join(folder, "heads.safetensors")]
    for shape in SHAPES:
        name, checkpoint = f"quick.{shape['gaussians']}", os.path.join(folder, f"{shape['gaussians']}.pt")
        torch.save({"shape": shape, "average": Head(shape).state_dict()}, checkpoint)
        arguments.append(f"{name}={checkpoint}")
    export([*arguments, "--samples", path])
    with safe_open(arguments[0], "pt") as f:
        note = json.loads(f.metadata()["b2p-heads"])
        assert note["version"] == 1 and set(note["sets"]) == {"quick.1", "quick.8"}
        assert f.get_slice("quick.8.out.weight").get_shape() == [27, 16, 112]
        assert set(note["sets"]["quick.1"]["ranges"]) == {"parent.in", "parent.0.a", "parent.0.b", "child.in", "child.0.a", "child.0.b"}


def main():
    torch.set_num_threads(1)
    ops.extension().set_bf16(False)
    with tempfile.TemporaryDirectory() as folder:
        path = sample_file(folder)
        check_transform_inverts()
        check_noise(path)
        check_both_paths_agree(path)
        check_file(folder, path)
    print("ok")


if __name__ == "__main__":
    main()
