"""Checks of the trainer, in a few minutes on two cores: `./check.sh`. Each prints one line; any failure raises."""

import json
import os
import tempfile
import time

import numpy as np
import torch

import data
import export
import ops
import prune
import rates
import train
import tune
from model import Conv, NormConv

HERE = os.path.dirname(os.path.abspath(__file__))


def near(a, b, tolerance, what):
    error = ((a.double() - b.double()).norm() / b.double().norm().clamp_min(1e-12)).item()
    assert error < tolerance, f"{what}: relative error {error:.2e}"
    return error


def gradients(f, inputs, weight):
    leaves = [t.detach().clone().requires_grad_() for t in inputs]
    y = f(*leaves)
    (y * weight.to(y.dtype)).sum().backward()
    return y.detach(), [t.grad for t in leaves]


def against_reference(f, inputs, tolerance, what):
    """Value and gradients of the extension (f32) against plain PyTorch (f64), and the latter against finite differences."""
    with torch.no_grad():
        weight = torch.randn_like(f(*inputs))
    y, grads = gradients(f, inputs, weight)
    with ops.reference():
        doubles = [t.double() for t in inputs]
        y_ref, grads_ref = gradients(f, doubles, weight)
        worst = near(y, y_ref, tolerance, what)
        for i, (a, b) in enumerate(zip(grads, grads_ref)):
            worst = max(worst, near(a, b, 20 * tolerance, f"{what}, gradient {i}"))
        step = 1e-6
        for i, g in enumerate(grads_ref):
            direction = torch.randn_like(doubles[i])
            moved = lambda s: [t + s * direction if j == i else t for j, t in enumerate(doubles)]
            with torch.no_grad():
                slope = ((f(*moved(step)) - f(*moved(-step))) * weight.double()).sum() / (2 * step)
            expected = (g * direction).sum()
            assert abs(slope - expected) < 1e-4 * (g.norm() * direction.norm() + 1e-9), f"{what}: slope {slope:.6f}, gradient {expected:.6f} of input {i}"
    return worst


def operators_agree_with_plain_pytorch():
    torch.manual_seed(0)
    crop = data.procedural(1, size=24, views=1, pixels=16).crop
    worst = 0.0
    for kmap, taps, rows in ((crop.kernel3[3], 27, crop.points), (crop.corners, 8, len(crop.coords[2])), (crop.descent[2], 8, len(crop.coords[1]))):
        for cin, cout in ((3, 64), (64, 14), (8, 16), (16, 32), (72, 24), (128, 64)):
            x, w, b, g = torch.randn(rows, cin), torch.randn(taps, cin, cout) / cin, torch.randn(cout), torch.randn(cout)
            worst = max(worst, against_reference(lambda x, w, b: ops.conv(x, w, b, kmap), [x, w, b], 1e-5, f"conv {taps} {cin} {cout}"))
            if taps * cin == 27 * 3 or cin == 64:
                worst = max(worst, against_reference(lambda x, w, g, b: ops.norm_conv(x, w, g, b, kmap), [x, w, g, b], 1e-5, f"norm conv {taps} {cin} {cout}"))
    for cin, cout in ((72, 64), (128, 64), (64, 8)):
        x, w, b = torch.randn(777, cin), torch.randn(1, cin, cout), torch.randn(cout)
        worst = max(worst, against_reference(lambda x, w, b: ops.linear(x, w, b), [x, w, b], 1e-5, f"linear {cin} {cout}"))
    worst = max(worst, against_reference(lambda x: ops.pool(x, crop.first[2]), [torch.randn(crop.points, 5)], 1e-5, "pool"))
    # A rectified layer: compared away from zero, where the two precisions agree on the sign.
    x, w = torch.randn(crop.points, 16), torch.randn(27, 16, 16) / 16
    worst = max(worst, against_reference(lambda x, w: ops.conv(x, w, torch.full((16,), 9.0).to(x), crop.kernel3[3], True), [x, w], 1e-5, "rectified conv"))
    return f"worst relative error {worst:.1e}"


def rounded_operands_stay_close_where_the_processor_has_them():
    if not ops.extension().set_bf16(True):
        return "no such processor"
    torch.manual_seed(0)
    crop, worst = data.procedural(1, size=24, views=1, pixels=16).crop, 0.0
    for cin, cout in ((3, 64), (64, 14), (8, 8), (16, 32), (33, 48), (72, 24), (128, 64), (32, 256)):
        inputs = [torch.randn(crop.points, cin), torch.randn(27, cin, cout) / cin, torch.randn(cout), torch.randn(cout)]
        f = lambda x, w, g, b: ops.norm_conv(x, w, g, b, crop.kernel3[3])
        weight = torch.randn(crop.points, cout)
        ops.extension().set_bf16(False)
        y_ref, grads_ref = gradients(f, inputs, weight)
        ops.extension().set_bf16(True)
        y, grads = gradients(f, inputs, weight)
        for i, (a, b) in enumerate(zip([y, *grads], [y_ref, *grads_ref])):
            worst = max(worst, near(a, b, 1e-2, f"bf16 {cin} {cout}, result {i}"))
    ops.extension().set_bf16(False)
    return f"worst relative error {worst:.1e}"


def maps_from_above_are_those_found_by_searching():
    crop = data.procedural(1, size=40, views=1, pixels=16).crop
    for coords, found in zip([*crop.coords, crop.children], [*crop.kernel3, crop.children3]):
        assert torch.equal(ops.neighbours(coords).table, found.table)
    return f"{len(crop.children)} generated voxels and four levels"


def the_splatter_agrees_with_plain_pytorch():
    torch.manual_seed(0)
    s = data.procedural(2, size=24, views=3, pixels=40)
    n = 400
    mean = torch.rand(n, 3) * 24
    scale, rotation = torch.rand(n, 3) * 1.5 + 0.2, torch.nn.functional.normalize(torch.randn(n, 4), dim=1)
    opacity, colour = torch.rand(n) * 0.95 + 0.02, torch.rand(n, 3)
    background = torch.rand(3, 3)

    def draw(mean, scale, rotation, opacity, colour):
        cameras, bg = s.cameras.to(mean), background.to(mean)
        return ops.splat(mean, ops.covariance(scale, rotation), opacity, colour, cameras, bg, 40, 37)

    inputs = [mean, scale, rotation, opacity, colour]
    with torch.no_grad():
        weight = torch.randn(3, 3, 37, 40)
    y, grads = gradients(draw, inputs, weight)
    with ops.reference():
        y_ref, grads_ref = gradients(draw, [t.double() for t in inputs], weight)
    # A pixel whose alpha lies at ALPHA_MIN may be decided differently in f32 and f64; it changes by no more than that.
    assert (y - y_ref).abs().max() < 2e-4, "a pixel is off"
    worst = near(y, y_ref, 1e-4, "picture")
    for name, a, b in zip(("mean", "scale", "rotation", "opacity", "colour"), grads, grads_ref):
        worst = max(worst, near(a, b, 1e-2, f"gradient of {name}"))
    return f"worst relative error {worst:.1e}"


def arguments(**changes):
    args = dict(config=os.path.join(HERE, "configs/full.json"), device="cpu", seed=0, lr_conv=3e-4, lr_linear=1e-3, minutes=0, steps=100000,
                rate_start=0.003, rate_ramp=0.6, warmup=10, decay_from=0.6, rounding_from=0.6, coarse=0.0, both=False, lam=5.0, pyramid=1.0, square=0.0,
                clip=1.0, average=0.9, hint=0.0, hint_until=0.5, freeze_finest=False,
                only_heads=False, lr_heads=1.0, quick_of=None, imitate=1.0, imitate_until=2.0, draw_from=0.0)
    return type("Arguments", (), args | changes)()


def a_crop_overfits():
    sample = data.procedural(0, size=48, views=4, pixels=80)
    trainer = train.Trainer(arguments())
    for step in range(120):
        info = trainer.train_step([sample])
        reached = train.psnr(info["mse"])
        if reached > 28:
            return f"{reached:.1f} dB after {step + 1} steps"
    raise AssertionError(f"only {reached:.1f} dB after 120 steps")


def a_resumed_run_equals_an_unbroken_one():
    with tempfile.TemporaryDirectory() as folder:
        os.makedirs(f"{folder}/data")
        for i in range(5):
            data.save_sample(data.procedural(i, size=32, views=3, pixels=40), f"{folder}/data/{i}.safetensors", 32)
        common = ["--data", f"{folder}/data", "--held-out", "2", "--views", "2", "--steps", "8", "--config", os.path.join(HERE, "configs/tiny.json"), "--log-every", "100"]
        whole = train.main([*common, "--out", f"{folder}/whole"])
        train.main([*common, "--out", f"{folder}/broken", "--stop-after", "5"])
        resumed = train.main([*common, "--out", f"{folder}/broken", "--resume"])
        for (name, a), b in zip(whole.model.state_dict().items(), resumed.model.state_dict().values()):
            assert torch.equal(a, b), f"{name} differs"
        for name, a in whole.average.items():
            assert torch.equal(a, resumed.average[name]), f"the average of {name} differs"
        assert whole.step == resumed.step == 8
    ops.extension().set_bf16(False)
    return "8 steps, broken after 5: every weight is equal"


def a_frozen_first_encoder_changes_nothing_but_its_own_gradient():
    sample, losses = data.procedural(2, size=48, views=2, pixels=60), []
    for frozen in (False, True):
        trainer = train.Trainer(arguments(config=os.path.join(HERE, "configs/tiny.json"), freeze_finest=frozen))
        torch.manual_seed(3)
        losses.append(trainer.loss(sample, 2, 1.0, "mixed", 0.0)[0])
        losses[-1].backward()
        assert (trainer.model.fc[3].conv_in.weight.grad is None) == frozen
    worst = near(losses[1], losses[0], 1e-3, "loss")
    return f"losses differ by {worst:.1e}: features are kept in f16"


def heads_alone_learn_and_leave_the_bits_as_they_are():
    sample = data.procedural(4, size=48, views=2, pixels=60)
    trainer = train.Trainer(arguments(config=os.path.join(HERE, "configs/tiny.json"), only_heads=True))
    trainer.train_step([sample])  # the first finds starting values for everything
    before = {name: p.detach().clone() for name, p in trainer.model.named_parameters()}
    trainer.train_step([sample])
    moved = {name for name, p in trainer.model.named_parameters() if not torch.equal(p, before[name])}
    assert moved and all(name.startswith("gg.2.") for name in moved), sorted(moved)[:3]
    return f"{len(moved)} tensors of the head that was drawn with move, no other"


def everything_else_learns_while_heads_stay():
    sample = data.procedural(4, size=48, views=2, pixels=60)
    trainer = train.Trainer(arguments(config=os.path.join(HERE, "configs/tiny.json"), lr_heads=0.0, rate_start=1.0, rounding_from=0.0))
    trainer.train_step([sample])
    before = {name: p.detach().clone() for name, p in trainer.model.named_parameters()}
    trainer.train_step([sample])
    moved = {name.split(".")[0] for name, p in trainer.model.named_parameters() if not torch.equal(p, before[name])}
    assert moved == {"fc", "fs", "fr", "pem", "prior", "base", "near", "up"}, sorted(moved)
    return "what predicts from neighbours is among it"


def quick_heads_are_made_for_a_network_that_has_learned_and_stand_beside_its_own():
    samples, tiny = [data.procedural(i, size=48, views=2, pixels=60) for i in range(2)], os.path.join(HERE, "configs/tiny.json")
    trainer = train.Trainer(arguments(config=tiny))
    trainer.train_step(samples)
    model = trainer.model.eval()
    with tempfile.TemporaryDirectory() as folder:
        weights, config, old, new = (f"{folder}/{name}" for name in ("w.safetensors", "quick.json", "old.safetensors", "new.safetensors"))
        export.save_file({k: v.numpy() for k, v in model.state_dict().items()}, weights)
        export.export(model, samples, old, {"steps": 1})
        with open(config, "w") as f:
            json.dump({**model.cfg, "gg": [{**g, "channels": 12, "blocks_before": 0} for g in model.cfg["gg"]]}, f)
        quick = train.Trainer(arguments(config=config, only_heads=True))
        quick.start_from(weights)
        assert quick.new_heads
        quick.start_heads(samples)
        s, error = samples[0], 0.0
        with torch.no_grad():
            trail, _, _ = quick.model.code(s.crop, quick.model.analyse(s.crop, s.rgb), 2, "round")
            colour = quick.model.generate(trail[2], s.crop, 2)[0][3]
            error, spread = (colour - quick.model.colours(s.crop, s.rgb)[2]).std().item(), s.rgb.std().item()
        assert error < 0.3 * spread, f"colours start {error:.3f} off, where they vary by {spread:.3f}"
        for s in samples:
            quick.train_step([s])
        for name, p in quick.model.state_dict().items():
            assert name.startswith("gg.") or torch.equal(p, model.state_dict()[name]), f"{name} has changed"
        export.export_quick(quick.model.eval(), samples, new, {"steps": 2}, old)
        again = train.Trainer(arguments(config=config, only_heads=True, quick_of=new))
        again.start_from(weights)
        again.start_heads(samples)
        with torch.no_grad():
            own, read = (t.model.generate(trail[2], samples[0].crop, 2)[1] for t in (quick, again))
        near(read, own, 1e-2, "heads read back from the file")
        (before, tensors), (after, more) = export.read(old), export.read(new)
        assert all(np.array_equal(more[k], v) for k, v in tensors.items())
        added = more.keys() - tensors.keys()
        assert added and all(export.is_quick(k) for k in added)
        assert {"gg": after.pop("gg")[:2], "quick": after.pop("quick_steps")} == {"gg": before.pop("gg"), "quick": 2} and before == after
    return f"{len(added)} tensors more, all others as they were; colours start {error:.3f} off of {spread:.3f}"


def heads_that_imitate_others_come_to_say_what_these_say():
    samples, tiny = [data.procedural(i, size=48, views=2, pixels=60) for i in range(2)], os.path.join(HERE, "configs/tiny.json")
    trainer = train.Trainer(arguments(config=tiny))
    trainer.train_step(samples)
    with tempfile.TemporaryDirectory() as folder:
        weights, config = f"{folder}/w.safetensors", f"{folder}/quick.json"
        model = trainer.model.eval()
        export.save_file({k: v.numpy() for k, v in model.state_dict().items()}, weights, metadata={"config": json.dumps(model.cfg)})
        with open(config, "w") as f:
            json.dump({**model.cfg, "gg": [{**g, "channels": 12, "blocks_before": 0} for g in model.cfg["gg"]]}, f)
        quick = train.Trainer(arguments(config=config, only_heads=True, draw_from=2.0, lr_conv=2e-3, lr_linear=4e-3))
        quick.start_from(weights)
        quick.start_heads(samples)
        quick.learn_from(weights)
        s = samples[0]
        with torch.no_grad():
            raw = model.generate(quick.heads_read(s, 2), s.crop, 2)[1]
            near(quick.taught_raw(s, 2), raw, 1e-2, "what the teacher says")
            itself = train.imitation(*[train.parameters(raw, model.cfg, True)] * 2).item()
        first = [quick.train_step([s])["loss"] for s in samples]
        for step in range(60):
            quick.train_step([samples[step % 2]])
        last = [quick.train_step([s])["loss"] for s in samples]
        reached = {k: v.clone() for k, v in quick.average.items()}
        start = f"{folder}/start.pt"
        torch.save({"average": {k: torch.zeros_like(v) for k, v in reached.items()}}, start)
        quick.stay_near(start, 0.25)
        assert all(torch.allclose(v, 0.75 * reached[k]) for k, v in quick.average.items())
    assert itself == 0 and sum(last) < 0.5 * sum(first), f"{itself}, {first} and {last}"
    return f"apart by {sum(first) / 2:.3f} at first and {sum(last) / 2:.3f} after 60 steps without a picture"


def fit_near(model, samples, steps=60):
    """Fits what corrects from neighbours; bits of roles 1 and 2 before and after."""
    known = [tune.inputs(model, s) for s in samples]
    bits = lambda: sum(sum(tune.rates(model, roles, crop, True)[1:]) for roles, crop, _ in known)
    before, optimiser = bits().item(), torch.optim.Adam(model.near.parameters(), 1e-2)
    for _ in range(steps):
        optimiser.zero_grad()
        (bits() / 1e4).backward()
        optimiser.step()
    return before, bits().item()


def what_neighbours_tell_saves_bits_and_comes_from_those_before_alone():
    samples = [data.procedural(i, size=48, views=2, pixels=60) for i in range(2)]
    with open(os.path.join(HERE, "configs/tiny.json")) as f:
        model = train.B2P(json.load(f))
    model.calibrate(samples[0].crop, samples[0].rgb)
    model.pass_colour()
    roles, crop, _ = tune.inputs(model, samples[0])
    with torch.no_grad():
        c, y, kmap = roles[2]
        predicted = model.pem["2"](c, kmap)
        untouched = rates.bits(rates.bin_mass(y, torch.round(predicted[0] * 16) / 16, rates.bounded_sigma(predicted[1])))
        assert torch.isclose(model.bits(2, y, *predicted, crop), untouched), "at first nothing changes"
    before, after = fit_near(model, samples)
    octant = ops.octants(crop.coords[2])
    with torch.no_grad():
        correct = lambda y: model.near["2"](y, *predicted, crop.coords[2], kmap.table)
        for last in range(8):
            later = torch.where((octant >= last)[:, None], y + 7, y)
            same = [torch.equal(a[octant <= last], b[octant <= last]) for a, b in zip(correct(y), correct(later))]
            assert all(same), f"octant {last} knows of itself or of later ones"
        assert not torch.equal(correct(y)[0], correct(y + 7)[0])
    y, fixed = y.requires_grad_(), [t.detach() for t in predicted]
    own, = torch.autograd.grad(model.bits(2, y, *fixed, crop, seen=y.detach(), learn=False), y)
    full, = torch.autograd.grad(model.bits(2, y, *fixed, crop, learn=False), y)
    others = (full - own).abs().sum(1) > 1e-6
    assert others[octant < 7].any() and not others[octant == 7].any(), "a latent's gradient is also what it does to those coded after it"
    assert not model.bits(2, y.detach(), *fixed, crop, learn=False).requires_grad, "nothing learns"
    assert after < 0.9 * before, f"{before} -> {after}"
    return f"{before:.0f} -> {after:.0f} bits"


def the_integer_path_follows_the_float_path(**changes):
    samples = [data.procedural(i, size=48, views=2, pixels=80) for i in range(3)]
    with tempfile.TemporaryDirectory() as folder:
        config = f"{folder}/config.json"
        with open(os.path.join(HERE, "configs/tiny.json")) as f, open(config, "w") as to:
            json.dump(json.load(f) | changes, to)
        trainer = train.Trainer(arguments(config=config, rate_start=1.0, lam=60.0, lr_conv=2e-3, lr_linear=4e-3))
        for step in range(150):
            trainer.train_step([samples[step % 3]])
        fit_near(trainer.model, samples)
        path = f"{folder}/model.safetensors"
        export.export(trainer.model.eval(), samples, path, {"steps": 150})
        export.half_weights(trainer.model)
        penalty = export.verify(path, trainer.model, samples)
    assert abs(penalty) < 0.02, f"rate penalty {100 * penalty:.2f} %"
    return f"rate {100 * penalty:+.2f} %"


def so_it_does_where_the_finest_role_has_no_latents():
    return the_integer_path_follows_the_float_path(latent_roles=2, near_channels=[16, 0])


def and_where_nothing_makes_its_features():
    return the_integer_path_follows_the_float_path(latent_roles=2, fr_roles=2, near_channels=[16, 0])


def a_network_without_a_reconstruction_starts_near_one_that_had_it():
    samples = [data.procedural(i, size=48, views=2, pixels=60) for i in range(2)]
    with tempfile.TemporaryDirectory() as folder, open(os.path.join(HERE, "configs/tiny.json")) as f:
        config = json.load(f) | {"latent_roles": 2, "near_channels": [16, 0]}
        paths = {}
        for roles in (3, 2):
            paths[roles] = f"{folder}/{roles}.json"
            with open(paths[roles], "w") as to:
                json.dump(config | {"fr_roles": roles}, to)
        longer = train.Trainer(arguments(config=paths[3], rate_start=1.0, lam=60.0, lr_conv=2e-3, lr_linear=4e-3))
        for step in range(40):
            longer.train_step([samples[step % 2]])
        longer.average = longer.model.state_dict()
        train.atomic_save(longer.state(), f"{folder}/longer.pt")
        shorter = train.Trainer(arguments(config=paths[2]))
        shorter.start_from(f"{folder}/longer.pt")
        shorter.shorten(samples)
    left, whole = 0.0, 0.0
    with torch.no_grad():
        for s in samples:
            (want, bits, _), (got, same_bits, _) = (m.code(s.crop, m.analyse(s.crop, s.rgb), 2, "round") for m in (longer.model, shorter.model))
            assert torch.equal(want[1], got[1]) and all_equal(bits, same_bits), "what was coded stays"
            left, whole = left + (want[2] - got[2]).pow(2).sum().item(), whole + (want[2] - want[2].mean(0)).pow(2).sum().item()
    assert left < 0.5 * whole, f"{left} of {whole}"
    return f"{100 * left / whole:.0f} % of the features' variance is left"


def a_network_of_half_as_many_channels_grows_and_does_the_same():
    sample, changes = data.procedural(1, size=48, views=2, pixels=60), {"latent_roles": 2, "fr_roles": 2, "near_channels": [16, 0]}
    with tempfile.TemporaryDirectory() as folder, open(os.path.join(HERE, "configs/tiny.json")) as f:
        config, paths = json.load(f) | changes, {}
        for channels in (8, 16):
            paths[channels] = f"{folder}/{channels}.json"
            heads = [gg | {"channels": channels} for gg in config["gg"]]
            with open(paths[channels], "w") as to:
                json.dump(config | {"channels": channels, "gg": heads}, to)
        narrow = train.Trainer(arguments(config=paths[8], rate_start=1.0, lam=60.0, lr_conv=2e-3, lr_linear=4e-3))
        for _ in range(20):
            narrow.train_step([sample])
        narrow.average = narrow.model.state_dict()
        train.atomic_save(narrow.state(), f"{folder}/narrow.pt")
        wide = train.Trainer(arguments(config=paths[16], rate_start=1.0, lam=60.0))
        wide.start_from(f"{folder}/narrow.pt")
    with torch.no_grad():
        said = []
        for trainer in (narrow, wide):
            trail, bits, latents = trainer.model.code(sample.crop, trainer.model.analyse(sample.crop, sample.rgb), 2, "round")
            said.append([torch.cat([y.flatten() for y in latents]), torch.stack(bits), *(trainer.model.generate(trail[r], sample.crop, r)[1] for r in (1, 2))])
    worst = max(((a - b).abs().max() / b.abs().max()).item() for a, b in zip(*said, strict=True))
    assert worst < 2e-3, f"{worst:.1e}"
    head = wide.model.gg["2"].before[0].c1.weight
    wide.train_step([sample])
    apart = (head.grad[..., ::2] - head.grad[..., 1::2]).abs().max() / head.grad.abs().max()
    assert apart > 0.05, "both copies of a channel learn the same"
    return f"at most {worst:.1e} apart"


def latents_that_never_change_can_be_left_out():
    samples, changes = [data.procedural(i, size=48, views=2, pixels=60) for i in range(2)], {"latent_roles": 2, "fr_roles": 2, "near_channels": [16, 0], "base_channels": 16}
    with tempfile.TemporaryDirectory() as folder, open(os.path.join(HERE, "configs/tiny.json")) as f:
        path = f"{folder}/config.json"
        with open(path, "w") as to:
            json.dump(json.load(f) | changes, to)
        whole = train.Trainer(arguments(config=path, rate_start=1.0, lam=60.0, lr_conv=2e-3, lr_linear=4e-3))
        for step in range(20):
            whole.train_step([samples[step % 2]])
        model = whole.model
        with torch.no_grad():  # the second is always 2 and the last always 0, of which the networks are sure
            for k, constant in ((1, 2.0), (3, 0.0)):
                for layer in [fs.lin2 for fs in model.fs] + [m for n in (model.base, model.near["1"], model.pem["1"]) for m in (n.mu, n.sigma)]:
                    layer.weight[..., k] = layer.bias[k] = 0
                for layer in [fs.lin2 for fs in model.fs] + [model.base.mu, model.pem["1"].mu]:
                    layer.bias[k] = constant
                model.base.sigma.bias[k] = model.pem["1"].sigma.bias[k] = -9
                model.prior.mean[k], model.prior.log_sigma[k] = constant, -9
        keep, cfg, weights = prune.prune(model, samples)
        assert keep == [0, 2] and cfg["latents"] == 2
        narrow = model.__class__(cfg)
        narrow.load_state_dict(weights)
        assert prune.prune(model, samples, 3)[0] in ([0, 1, 2], [0, 2, 3]), "those that vary are kept first"
    worst = 0.0
    with torch.no_grad():
        for s in samples:
            (want, bits, latents), (got, same_bits, left) = (m.code(s.crop, m.analyse(s.crop, s.rgb), 2, "round") for m in (model, narrow))
            pairs = [*zip(want, got, strict=True), (torch.stack(bits[:2]), torch.stack(same_bits[:2]))]
            pairs += [(y[:, keep], z) for y, z in zip(latents[:2], left[:2], strict=True)]
            worst = max(worst, *(((a - b).abs().max() / a.abs().max()).item() for a, b in pairs))
    assert worst < 1e-3, f"{worst:.1e}"
    return f"features and bits are at most {worst:.1e} apart"


def all_equal(a, b):
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


if __name__ == "__main__":
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "2")))
    for check in (operators_agree_with_plain_pytorch, rounded_operands_stay_close_where_the_processor_has_them,
                  maps_from_above_are_those_found_by_searching, the_splatter_agrees_with_plain_pytorch, a_resumed_run_equals_an_unbroken_one,
                  a_frozen_first_encoder_changes_nothing_but_its_own_gradient, heads_alone_learn_and_leave_the_bits_as_they_are,
                  quick_heads_are_made_for_a_network_that_has_learned_and_stand_beside_its_own, heads_that_imitate_others_come_to_say_what_these_say,
                  everything_else_learns_while_heads_stay, what_neighbours_tell_saves_bits_and_comes_from_those_before_alone,
                  the_integer_path_follows_the_float_path, so_it_does_where_the_finest_role_has_no_latents, and_where_nothing_makes_its_features,
                  a_network_without_a_reconstruction_starts_near_one_that_had_it, a_network_of_half_as_many_channels_grows_and_does_the_same,
                  latents_that_never_change_can_be_left_out, a_crop_overfits):
        begin = time.monotonic()
        said = check()
        print(f"{check.__name__.replace('_', ' ')}: {said} ({time.monotonic() - begin:.0f} s)", flush=True)
