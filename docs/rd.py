"""Rate against distortion of b2p, MPEG's G-PCC (TMC13) and V-PCC (TMC2) on whole objects, by `b2p-lab eval`'s protocol.

    python3 docs/rd.py --data FOLDER --cache FOLDER [--series NAME …] [--objects NAME …]
                          measures these series of SERIES, and TMC13 where docs/rd.json lacks it, writes docs/rd.json, and goes on as below
    python3 docs/rd.py    from docs/rd.json and docs/times.json: tables, plot, and the list of lower scores

The data folder holds meshes (`val/*.glb`, `train/*.glb`), TMC13's decoded clouds (`gpcc/*.ply.zst`) with their rates (`SOURCES.md`), and
V-PCC's scores (`vpcc.md`). The cache holds clouds, streams and TMC13's scores; remove its `streams` when the
encoder has changed. B2P and B2P_LAB name programs that are built already, B2P_HEADS a file of heads for `best` and `quick`.
"""

import argparse
import json
import os
import re
import subprocess
import tempfile
from pathlib import Path

import rd_tables
from rd_tables import OBJECTS, PEER, VPCC

HERE = Path(__file__).parent
ROOT = HERE.parent
MEASURED = HERE / "rd.json"
TIMES = HERE / "times.json"
SCORES = ("psnr", "foreground_psnr", "ms_ssim", "ssimulacra2")
LEVELS = {"s0.25": 8, "s0.5": 9, "s1": 10}

# A series is a list of items: what they are called, arguments of `b2p encode`, the level that is drawn (None: the finest of the stream),
# arguments of `b2p decode`. Items with equal encoder arguments share a stream.


def at_rates(*heads, encode=()):
    """Streams of every rate that the tables compare at, coded with these arguments, drawn by these heads."""
    file = os.environ.get("B2P_HEADS")
    decode = (*heads, *(("--model", Path(file).resolve()) if file and "surfels" not in heads else ()))
    return lambda rates: [(f"{rate:.4f}", ("--bits-per-point", f"{rate:.4f}", *encode), None, decode) for rate in rates]


def learned(name):
    """A model with learned colours: both levels of one stream."""
    model = ("--model", str(ROOT / "models" / f"{name}.safetensors"))
    return lambda rates: [(f"level {level}", ("--colours", "learned", *model), level, model) for level in (8, 9)]


SERIES = {
    "best": at_rates("--heads", "best"),
    "effort-9": at_rates("--heads", "best", encode=("--effort", "9")),
    "quick": at_rates("--heads", "quick"),
    "surfels": at_rates("--heads", "surfels"),
    **{name: learned(name) for name in ("lite", "lite-low", "lite-least")},
}


def run(package, *args):
    built = os.environ.get(package.upper().replace("-", "_"))
    program = [built] if built else ["cargo", "run", "--release", "--quiet", "-p", package, "--"]
    done = subprocess.run([*program, *map(str, args)], cwd=ROOT, check=True, stdout=subprocess.PIPE)
    return done.stdout


def mesh_of(data, name):
    return next(path for folder in ("val", "train") if (path := data / folder / f"{name}.glb").exists())


def cloud_of(data, cache, name):
    cloud = cache / f"{name}.ply"
    if not cloud.exists():
        run("b2p-lab", "voxelize", mesh_of(data, name), "-o", cloud)
    return cloud


def evaluate(data, cache, name, items, out):
    """Rows of `b2p-lab eval` of items `NAME=PATH@BPP`."""
    cloud = cloud_of(data, cache, name)
    run("b2p-lab", "eval", "--mesh", mesh_of(data, name), "--cloud", cloud, "--items-only", *items, "-o", out, "--columns", 0)
    return json.loads((out / "scores.json").read_text())["rows"]


def row_of(name, series, row, **more):
    return {"object": name, "series": series, "label": row["name"], "rate": row["rate"]["total"], **more, **row["scores"]}


def peer_rates(data):
    """Bits per input point of TMC13's streams, by the name of the decoded cloud."""
    rows = re.findall(r"^\| (\S+)\.ply\.zst \|(.*)\|$", (data / "SOURCES.md").read_text(), re.M)
    return {cloud: float(cells.split("|")[3]) for cloud, cells in rows}


def measure_peer(data, cache, name):
    rates, rows = peer_rates(data), []
    for scale, level in LEVELS.items():
        out = cache / "tmc13" / f"{name}_{scale}"
        items = [f"{cloud}={data}/gpcc/{cloud}.ply.zst@{rate}" for cloud, rate in rates.items() if cloud.startswith(f"{name}_{scale}_")]
        if not (out / "scores.json").exists():
            evaluate(data, cache, name, items, out)
        for row in json.loads((out / "scores.json").read_text())["rows"]:
            quality = row["name"].rsplit("_q", 1)[1]
            rows.append(row_of(name, PEER, row | {"name": f"level {level}, QP {quality}"}, level=level, drawn=row["drawn"]))
    return rows


def read_vpcc(data):
    rows = []
    for line in (data / "vpcc.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) > 6 and cells[0] in OBJECTS and cells[2] != "–":
            scores = dict(zip(SCORES, map(float, cells[3:7])))
            rows.append({"object": cells[0], "series": VPCC, "label": cells[1], "rate": float(cells[2]), "level": 10, "drawn": "surfels", **scores})
    return rows


def measure(data, cache, name, series, rates):
    """Codes, decodes and judges every item of a series."""
    cloud, streams = cloud_of(data, cache, name), cache / "streams" / name
    streams.mkdir(parents=True, exist_ok=True)
    points = int(re.search(rb"element vertex (\d+)", cloud.open("rb").read(4000))[1])
    with tempfile.TemporaryDirectory() as folder:
        folder, items, levels = Path(folder), [], {}
        for i, (label, encode, level, decode) in enumerate(SERIES[series](rates)):
            stream = streams / (re.sub(r"[^\w.]+", "-", "-".join(Path(part).name for part in encode)) + ".b2p")
            if not stream.exists():
                run("b2p", "encode", cloud, "--force", "-o", stream, *encode)
            gaussians = folder / f"{i}.ply"
            run("b2p", "decode", stream, "--force", "-o", gaussians, *decode, *(("--level", level) if level else ()))
            coded = json.loads(run("b2p", "info", stream, "--json"))["levels"]
            parts = lambda part: sum(bytes for key, bytes in part.items() if key.endswith("_bytes"))
            finer = sum(parts(part) for part in coded if level and part["level"] > level)
            levels[label] = level or max(part["level"] for part in coded)
            items.append(f"{label}={gaussians}@{8 * (stream.stat().st_size - finer) / points}")
        rows = evaluate(data, cache, name, items, folder / "eval")
        return [row_of(name, series, row, level=levels[row["name"]]) for row in rows]


def measure_all(data, cache, wanted, objects, peer_too):
    """Measures object by object; what was measured is kept if a later object fails."""
    rows = json.loads(MEASURED.read_text()) if MEASURED.exists() else []
    rows = [row for row in rows if row["series"] != VPCC] + read_vpcc(data)
    for name in objects:
        peer = [row for row in rows if (row["object"], row["series"]) == (name, PEER)]
        if peer_too or not peer:
            peer = measure_peer(data, cache, name)
        rates = sorted({row["rate"] for row in peer} | {rate for rate, *_ in rd_tables.HYBRID.get(name, ())})
        rows = [row for row in rows if row["object"] != name or row["series"] not in (PEER, *wanted)] + peer
        for series in wanted:
            print(name, series, flush=True)
            rows += measure(data, cache, name, series, rates)
        MEASURED.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--series", nargs="*", default=[], choices=SERIES)
    parser.add_argument("--objects", nargs="*", default=list(OBJECTS), choices=OBJECTS)
    parser.add_argument("--peer", action="store_true", help="measure TMC13 again, too")
    args = parser.parse_args()
    if bool(args.data) != bool(args.cache):
        parser.error("--data and --cache go together")
    if args.data:
        measure_all(args.data.resolve(), args.cache.resolve(), args.series, args.objects, args.peer)
    rows = json.loads(MEASURED.read_text())
    for path, marks in rd_tables.tables(rows, json.loads(TIMES.read_text())).items():
        text = (ROOT / path).read_text()
        for mark, lines in marks.items():
            body = "\n".join(lines)
            text, count = re.subn(rf"(<!-- {mark} -->\n).*?(\n<!-- /{mark} -->)", lambda m: m[1] + "\n" + body + "\n" + m[2], text, flags=re.S)
            assert count == 1, f"{path} has no place for {mark}"
        (ROOT / path).write_text(text)
    (HERE / "rd.svg").write_text(rd_tables.plot(rows))
    for series, lines in rd_tables.shortfalls(rows).items():
        print(f"{series}: {len(lines)} scores below")
        print("\n".join(f"  {line}" for line in lines))


if __name__ == "__main__":
    main()
