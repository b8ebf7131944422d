"""Rate against distortion of the models and of MPEG's G-PCC on whole objects, by `b2p-lab eval`'s protocol.

    python3 docs/rd.py --data FOLDER [--models NAME=FILE …]   measures these models, and TMC13 if that has not been yet; then does the rest
    python3 docs/rd.py                                        from docs/rd.json: the tables between the marks of README.md and docs/MEASUREMENTS.md, and docs/rd.svg

FOLDER holds `val/*.glb`, and TMC13's decoded clouds in `gpcc/`. B2P and B2P_LAB name a `b2p` and a `b2p-lab` that are built already.
"""

import argparse
import json
import math
import os
import re
import subprocess
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
OBJECTS = {"person_Asian_F_3_Casual": "Asian_F_3", "person_Hispanic_M_3_Milit": "Hispanic_M_3", "tds_Penelope": "Penelope (statue)", "coffee_grinder": "Coffee grinder"}
# TMC13 v23: bits per input point of whole streams.
PEERS = {
    "person_Asian_F_3_Casual": {"s0.25_q34": 0.1005, "s0.25_q28": 0.1400, "s0.5_q34": 0.2975, "s0.5_q28": 0.4092},
    "person_Hispanic_M_3_Milit": {"s0.25_q34": 0.0944, "s0.25_q28": 0.1571, "s0.5_q34": 0.2775, "s0.5_q28": 0.4457},
}
MODELS = {name: f"models/{name}.safetensors" for name in ("lite", "lite-low", "lite-least")} | {"lite-quick": "models/lite.safetensors", "lite-price": "models/lite.safetensors", "lite-residual": "models/lite.safetensors"}
QUICK = "-quick"  # ends the name of a model whose quick heads are measured
PRICE, RESIDUAL = "-price", "-residual"  # of a model whose streams are made with an option
OPTIONS = {PRICE: ("--bit-price", (0, 0.5, 2, 4)), RESIDUAL: ("--residual", ("none", 96, 48, 24))}
DEFAULTS = {PRICE: "1", RESIDUAL: "coarse"}
COLOURS = ["#1d4ed8", "#c2410c", "#15803d", "#7e22ce", "#b45309", "#be185d"]
PEER = "TMC13"  # begins the names of its series
PEER_COLOURS = {f"{PEER} squares": "#6b7280", f"{PEER} Gaussians": "#d1a3a3"}
SCORES = {"psnr": "PSNR", "foreground_psnr": "foreground PSNR", "ms_ssim": "MS-SSIM", "ssimulacra2": "SSIMULACRA2"}


# ---------------------------------------------------------------------------------------------------------------------
# Measuring


def run(package, *args):
    built = os.environ.get(package.upper().replace("-", "_"))
    program = [built] if built else ["cargo", "run", "--release", "--quiet", "-p", package, "--"]
    subprocess.run([*program, *map(str, args)], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


def lab(*args):
    run("b2p-lab", *args)


def evaluate(mesh, cloud, out, *args):
    lab("eval", "--mesh", mesh, "--cloud", cloud, "-o", out, *args)
    return json.loads((Path(out) / "scores.json").read_text())["rows"]


def measure(data, models, peers):
    rows = []
    for name in OBJECTS:
        with tempfile.TemporaryDirectory() as folder:
            folder, mesh = Path(folder), data / "val" / f"{name}.glb"
            cloud = folder / "cloud.ply"
            lab("voxelize", mesh, "-o", cloud)
            for model, path in models.items():
                args = ["--model", ROOT / path, "--heads", "quick" if model.endswith(QUICK) else "best"]
                option, values = OPTIONS.get("-" + model.split("-")[-1], ("", ()))
                for value in values:
                    run("b2p", "encode", cloud, "-o", folder / f"{value}.b2p", "--model", ROOT / path, option, value)
                args += [f"{value}={folder / f'{value}.b2p'}" for value in values]
                if model.endswith(RESIDUAL):
                    args += ["--levels", "9"]
                for row in evaluate(mesh, cloud, folder / model, *args):
                    if values and row["name"] not in map(str, values):
                        continue  # the cloud, coded without the option, is among them
                    parts = {part["level"]: part for part in row["rate"]["levels"]}
                    rows.append({"object": name, "series": model, "level": row["level"], "rate": row["rate"]["total"],
                                 "geometry": sum(p["geometry"] for p in parts.values()), **row["scores"]})
                    if values:
                        rows[-1]["option"] = row["name"]
            items = [f"{item}={data}/gpcc/{name}_{item}.ply.zst@{rate}" for item, rate in PEERS.get(name, {}).items() if peers]
            for row in evaluate(mesh, cloud, folder / "peer", *items) if items else []:
                item = row["name"]  # the cloud, coded by the program's own model, is among them
                if item in PEERS[name]:
                    level, drawn = {"s0.25": 8, "s0.5": 9}[item.split("_")[0]], "squares" if row["drawn"].startswith("squares") else "Gaussians"
                    rows.append({"object": name, "series": f"{PEER} {drawn}", "level": level, "rate": PEERS[name][item], "quality": item.split("_q")[1], **row["scores"]})
    return rows


def is_peer(row):
    return row["series"].startswith(PEER)


# ---------------------------------------------------------------------------------------------------------------------
# Bjøntegaard's differences, over the concave envelopes of both's points: a better point never counts against whose it is


def envelope(rows, score):
    out = []
    for x, y in sorted((math.log(row["rate"]), row[score]) for row in rows):
        if out and y <= out[-1][1]:
            continue
        while len(out) > 1 and (out[-1][1] - out[-2][1]) * (x - out[-2][0]) <= (y - out[-2][1]) * (out[-1][0] - out[-2][0]):
            out.pop()
        out.append((x, y))
    return out


def along(curve, low, high, steps=1000):
    """A piecewise linear curve of (x, y), x rising, at so many places from `low` to `high`."""
    def at(x):
        for (x0, y0), (x1, y1) in zip(curve, curve[1:]):
            if x <= x1:
                return y0 + (y1 - y0) * (x - x0) / (x1 - x0)
        return curve[-1][1]
    return [at(low + (high - low) * (i + 0.5) / steps) for i in range(steps)]


def mean_between(curve, low, high):
    both = along(curve, low, high)
    return sum(both) / len(both)


def bjontegaard(ours, peers, score):
    """(mean and least difference of the score at equal rates, rates they were taken over, mean change of the rate at equal scores; None without overlap)."""
    a, b = envelope(ours, score), envelope(peers, score)
    low, high = max(a[0][0], b[0][0]), min(a[-1][0], b[-1][0])
    gains = [x - y for x, y in zip(along(a, low, high), along(b, low, high))] if low < high else None
    gain = gains and (sum(gains) / len(gains), min(gains))
    turn = lambda curve: [(y, x) for x, y in curve]
    least, most = max(a[0][1], b[0][1]), min(a[-1][1], b[-1][1])
    saved = math.expm1(mean_between(turn(a), least, most) - mean_between(turn(b), least, most)) if least < most else None
    return gain, (math.exp(low), math.exp(high)), saved


# ---------------------------------------------------------------------------------------------------------------------
# Tables and the plot


def table(rows):
    out = ["| | bits/point | PSNR | foreground PSNR | MS-SSIM | SSIMULACRA2 |", "|---|---:|---:|---:|---:|---:|"]
    for name, title in OBJECTS.items():
        for i, r in enumerate(sorted((r for r in rows if r["object"] == name), key=lambda r: (is_peer(r), r["rate"]))):
            what = f"`{r['series']}` level {r['level']}"
            for end in OPTIONS:
                if r["series"].endswith(end):
                    what = f"`{r['series'].removesuffix(end)}` level {r['level']}, {end[1:]} {r['option']}"
            if is_peer(r):
                what = f"{PEER} level {r['level']}, QP {r['quality']}, {r['series'].split()[1]}"
            head = f"**{title}**, " if i == 0 else ""
            out.append(f"| {head}{what} | {r['rate']:.3f} | {r['psnr']:.2f} | {r['foreground_psnr']:.2f} | {r['ms_ssim']:.4f} | {r['ssimulacra2']:.1f} |")
    return out


def summary(rows):
    """A line for each object, a column for each point of the models themselves."""
    columns = [(name, level) for name in ("lite-least", "lite-low", "lite") for level in (8, 9)]
    out = ["| bits/point: PSNR / foreground | " + " | ".join(f"`{name}`, level {level}" for name, level in columns) + " |", "|---|" + "---:|" * len(columns)]
    for name, title in OBJECTS.items():
        own = {(r["series"], r["level"]): r for r in rows if r["object"] == name and not is_peer(r)}
        cells = [f"{r['rate']:.3f}: {r['psnr']:.2f} / {r['foreground_psnr']:.2f}" for r in (own[column] for column in columns)]
        out.append(f"| {title} | " + " | ".join(cells) + " |")
    return out


def optional(rows, end, levels):
    """As `summary`, of one model with the values of an option, the default among them."""
    values, default = [str(value) for value in OPTIONS[end][1]], DEFAULTS[end]
    own = [r | {"option": r.get("option", default)} for r in rows if r["series"] in ("lite", "lite" + end)]
    values.insert(2 if end == PRICE else 1, default)
    columns = [(level, value) for level in levels for value in values]
    heading = lambda level, value: (f"level {level}, " if len(levels) > 1 else "") + f"`{value}`"
    out = ["| bits/point: PSNR / foreground | " + " | ".join(heading(*column) for column in columns) + " |", "|---|" + "---:|" * len(columns)]
    for name, title in OBJECTS.items():
        found = {(r["level"], r["option"]): r for r in own if r["object"] == name}
        cells = [f"{r['rate']:.3f}: {r['psnr']:.2f} / {r['foreground_psnr']:.2f}" for r in (found[column] for column in columns)]
        out.append(f"| {title} | " + " | ".join(cells) + " |")
    return out


def differences(rows):
    out = ["| at equal rates, ours less TMC13's, on average | " + " | ".join(SCORES.values()) + " | bits saved at equal PSNR |", "|---|" + "---:|" * (len(SCORES) + 1)]
    for name in PEERS:
        ours, peers = ([r for r in rows if r["object"] == name and is_peer(r) == peer] for peer in (False, True))
        gains = [bjontegaard(ours, peers, score) for score in SCORES]
        (low, high), saved = gains[0][1], gains[0][2]
        digits = lambda score: ".2f" if "psnr" in score else ".4f" if score == "ms_ssim" else ".1f"
        cells = ["—" if g is None else f"{g[0]:+{digits(score)}}, at least {g[1]:{digits(score)}}" for score, (g, _, _) in zip(SCORES, gains)]
        out.append(f"| {OBJECTS[name]}, {low:.2f} to {high:.2f} bits/point | " + " | ".join(cells) + f" | {'no equal PSNR' if saved is None else f'{-100 * saved:.0f} %'} |")
    return out


def panel(x0, y0, title, rows, score, colours):
    width, height = 340, 240
    values = [r[score] for r in rows]
    low, high = min(values) - 0.5, max(values) + 0.5
    x = lambda r: x0 + (r - 0.05) / 0.75 * width
    y = lambda v: y0 + height - (v - low) / (high - low) * height
    out = [f'<text x="{x0}" y="{y0 - 12}" font-weight="bold">{title}</text>', f'<rect x="{x0}" y="{y0}" width="{width}" height="{height}" fill="none" stroke="#d1d5db"/>']
    out += [f'<text x="{x(r)}" y="{y0 + height + 16}" text-anchor="middle">{r}</text>' for r in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)]
    for v in range(int(low) + 1, int(high) + 1, 2):
        out.append(f'<path d="M{x0} {y(v):.1f}h{width}" stroke="#e5e7eb"/><text x="{x0 - 6}" y="{y(v) + 4:.1f}" text-anchor="end">{v}</text>')
    for series, colour in colours.items():
        own = sorted((r["rate"], r[score], r.get("option", r["level"]), r["level"]) for r in rows if r["series"] == series)
        for level in {p[3] for p in own} if series.endswith(PRICE) else {None}:
            path = "L".join(f"{x(r):.1f} {y(v):.1f}" for r, v, _, at in own if level in (None, at))
            out += [f'<path d="M{path}" fill="none" stroke="{colour}" stroke-width="2"/>'] * bool(path)
        out += [f'<circle cx="{x(r):.1f}" cy="{y(v):.1f}" r="4" fill="{colour}"/><text x="{x(r) + 6:.1f}" y="{y(v) + 14:.1f}" fill="{colour}">{level}</text>' for r, v, level, _ in own]
    return out


def plot(rows):
    series = dict.fromkeys(r["series"] for r in rows if not is_peer(r))
    colours, body = dict(zip(series, COLOURS)) | PEER_COLOURS, []
    for column, name in enumerate(PEERS):
        own = [r for r in rows if r["object"] == name]
        for line, score in enumerate(("psnr", "foreground_psnr")):
            body += panel(50 + column * 410, 40 + line * 310, f"{OBJECTS[name]}: {SCORES[score]}, dB", own, score, colours)
    for i, (name, colour) in enumerate(colours.items()):
        body.append(f'<text x="{50 + 94 * i}" y="654" fill="{colour}" font-weight="bold">{name}</text>')
    body.append(f'<text x="50" y="674">bits per input point, geometry included; numbers are octree levels, or what the option says: the price of a bit, or the step of residuals at level 9</text>')
    head = '<svg xmlns="http://www.w3.org/2000/svg" width="870" height="688" font-family="sans-serif" font-size="12">'
    return f'{head}<rect width="100%" height="100%" fill="white"/>{"".join(body)}</svg>\n'


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--models", nargs="*", default=[f"{name}={path}" for name, path in MODELS.items()])
    args = parser.parse_args()
    measured = HERE / "rd.json"
    if args.data:
        models = dict(model.split("=", 1) for model in args.models)
        kept = json.loads(measured.read_text()) if measured.exists() else []
        kept = [row for row in kept if row["series"] not in models]
        rows = kept + measure(args.data.resolve(), models, not any(map(is_peer, kept)))
        measured.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")
    rows = json.loads(measured.read_text())
    for path, mark, lines in ((ROOT / "README.md", "rd", [*summary(rows), "", *differences(rows)]), (ROOT / "README.md", "rd-price", optional(rows, PRICE, (9,))), (ROOT / "README.md", "rd-residual", optional(rows, RESIDUAL, (9,))), (HERE / "MEASUREMENTS.md", "rd-all", table(rows))):
        text = "\n".join(lines)
        path.write_text(re.sub(rf"(<!-- {mark} -->\n).*?(\n<!-- /{mark} -->)", lambda m: m[1] + "\n" + text + "\n" + m[2], path.read_text(), flags=re.S))
    (HERE / "rd.svg").write_text(plot(rows))


if __name__ == "__main__":
    main()
