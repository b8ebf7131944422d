"""A network of twice as many channels that does what another does (Net2Net, arXiv 1511.05641), as a start for its training."""

import torch

from layers import NormConv
from model import latents_of

UNEVEN = 0.2  # the two copies of a channel weigh 0.5 ± this wherever they are read, so that they learn different things


@torch.no_grad()
def grow(model, narrow):
    """Gives `model` the weights of `narrow`, every channel of which stands side by side with its copy. Pictures and bits stay, but for rounding."""
    weights, norms = narrow.state_dict(), {name for name, m in model.named_modules() if isinstance(m, NormConv)}
    for name, own in model.state_dict().items():
        layer, _, kind = name.rpartition(".")
        w = twice(weights[name], -1, own.shape[-1])
        if kind == "weight" and own.ndim == 3:
            k = latents_of(model.cfg, int(layer.split(".")[1])) if layer.startswith("fr.") and layer.endswith(".lin1") else 0
            read = own.shape[1] - k
            if read != w.shape[1] - k:
                wide = twice(w[:, k:], 1, read)
                sign = torch.randint(2, (1, read // 2, own.shape[2])).to(wide) * 2 - 1
                wide *= 0.5 + UNEVEN * torch.stack([sign, -sign], 2).flatten(1, 2)
                w = torch.cat([w[:, :k], wide], 1)
        if kind == "gain" and layer in norms and model.get_submodule(layer).weight.shape[1] != weights[layer + ".weight"].shape[1]:
            w = w * (0.5 + 2 * UNEVEN**2) ** 0.5  # what the norm of the weights has become smaller by
        own.copy_(w)


def twice(x, axis, size):
    """Every channel along an axis followed by its copy, if the axis is to be so long."""
    if x.shape[axis] == size:
        return x.clone()
    assert 2 * x.shape[axis] == size, f"{x.shape[axis]} channels become twice as many, not {size}"
    return x.repeat_interleave(2, axis)
