"""Writes the golden files that hold the Rust code to this one: an untrained tiny model, and everything it computes on a small cloud.

    python golden.py [FOLDER]          (FOLDER/tiny.safetensors, FOLDER/golden.safetensors; default tests/data)

Tensors of golden.safetensors, n_R voxels at role R, all in Morton order:
  xyz.R, parent.R, rgb           the cloud, as in a training sample
  fc.R f32 [n_R, C]              encoder features (R = 0..2), float zone
  fs.R f32 [n_R, K]              squeezed features before clamping and rounding; latent.R i16 [n_R, K] after
  c.R, g.R i16 [n_R, C]          context and reconstruction, in integer steps of c_scale[R], g_scale[R]
  pem.R.conv_in, pem.R.blocks.B, fr.R.lin1, fr.R.blocks.B   i16, after their ReLU
  pem.mu.R i16, pem.sigma.R u8 [n_R, K]  what the level below predicts; mu.R, sigma.R  the same corrected from neighbours; float.mu.R, float.lnsigma.R f32: the float network on the same context
  raw.R f32 [m, 14]              output of head R = 1 (m = 8 n_1), R = 2 (m = n_2)
  gauss.R.{mean,cov,opacity,colour} f32   Gaussians, in finest-voxel units of the cloud's corner; cov is xx xy xz yy yz zz
  camera f32 [V, 16], picture.R f32 [V, 3, H, W]   pictures over white
  bits f64 [3]                   cost of the latents per role, from the tables of the model
"""

import os
import sys

import numpy as np
import torch
from safetensors.numpy import save_file

import data
import export
import integer
import ops


@torch.no_grad()
def main(folder):
    os.makedirs(folder, exist_ok=True)
    torch.set_num_threads(1)
    config = os.path.join(os.path.dirname(os.path.abspath(__file__)), "configs/tiny.json")
    samples = [data.procedural(i, size=32, views=2, pixels=40) for i in range(3)]
    model = export.untrained(config, samples)
    path = os.path.join(folder, "tiny.safetensors")
    export.export(model, samples, path, {"name": "tiny", "steps": 0})
    export.half_weights(model)

    s, trace = samples[0], {}
    exact = integer.Exact(path)
    bits, _ = integer.code(exact, model, s.crop, s.rgb, trace=trace)
    out = {f"xyz.{r}": s.crop.coords[r].numpy() for r in range(4)}
    for r in (1, 2, 3):
        count = (s.crop.first[r - 1][1:] - s.crop.first[r - 1][:-1]).numpy()
        out[f"parent.{r}"] = np.repeat(np.arange(len(count), dtype=np.int32), count)
    out["rgb"] = np.rint(s.rgb.numpy() * 255).astype(np.uint8)
    for name, value in trace.items():
        out[name] = value.astype(np.uint8 if name.startswith(("sigma", "pem.sigma")) else np.float32 if value.dtype == np.float32 else np.int16)
    for r in (1, 2):
        c = torch.from_numpy((trace[f"c.{r}"] * float(exact.t["c_scale"][r])).astype(np.float32))
        mu, log_sigma = model.pem[str(r)](c, s.crop.kernel3[r])
        out[f"float.mu.{r}"], out[f"float.lnsigma.{r}"] = mu.numpy(), log_sigma.numpy()
        g = torch.from_numpy((trace[f"g.{r}"] * float(exact.t["g_scale"][r])).astype(np.float32))
        splats, raw = model.generate(g, s.crop, r)
        out[f"raw.{r}"] = raw.numpy()
        for name, value in zip(("mean", "cov", "opacity", "colour"), splats):
            out[f"gauss.{r}.{name}"] = value.numpy()
        with ops.reference():
            double = [v.double() for v in (*splats, s.cameras, torch.ones(len(s.cameras), 3))]
            out[f"picture.{r}"] = ops.splat(*double, s.image.shape[3], s.image.shape[2]).float().numpy()
    out["camera"], out["bits"] = s.cameras.numpy(), np.array(bits)
    target = os.path.join(folder, "golden.safetensors")
    save_file({k: np.ascontiguousarray(v) for k, v in sorted(out.items())}, target)
    for p in (path, target):
        print(p, os.path.getsize(p), "bytes")
    print("voxels", [len(c) for c in s.crop.coords], "bits", [round(b, 1) for b in bits])


if __name__ == "__main__":
    here = os.path.dirname(os.path.abspath(__file__))
    main(sys.argv[1] if len(sys.argv) > 1 else os.path.join(here, "../../tests/data"))
