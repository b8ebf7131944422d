"""What the heads of a trained network say of samples: raw numbers of both, for new heads to imitate. teach.py WEIGHTS OUT SAMPLE…

WEIGHTS is a file of `export.py --weights`. Of every sample OUT gets a file of its name, with `raw.1` and `raw.2`: f16 [8 n_1, 14] and [n_2, 14],
from rounded latents.
"""

import json
import os
import sys

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

import data
from model import B2P


def load_teacher(path):
    with safe_open(path, "pt") as f:
        model = B2P(json.loads(f.metadata()["config"]))
    model.load_state_dict({k: v.float() for k, v in load_file(path).items()})
    return model.eval()


@torch.no_grad()
def raw_of(model, sample):
    features = model.analyse(sample.crop, sample.rgb)
    trail, _, _ = model.code(sample.crop, features, 2, "round")
    return {f"raw.{head}": model.generate(trail[head], sample.crop, head)[1].half().contiguous() for head in (1, 2)}


def main():
    weights, out, *paths = sys.argv[1:]
    torch.set_num_threads(1)
    os.makedirs(out, exist_ok=True)
    model = load_teacher(weights)
    for path in paths:
        target = os.path.join(out, os.path.basename(path))
        if not os.path.exists(target):
            save_file(raw_of(model, data.load_sample(path)), target + ".part")
            os.replace(target + ".part", target)


if __name__ == "__main__":
    main()
