"""Whether `--budget` keeps its promises: a promised task may take at most a fifth more than its budget.

    python3 docs/budget.py --streams FOLDER --code --clouds NAME=CLOUD.ply …    codes each cloud at several sizes
    python3 docs/budget.py --streams FOLDER --clouds NAME …                     measures them; then does the rest
    python3 docs/budget.py                              from docs/budget.json: the table between the marks of docs/measurements.md

Clouds have 10 bits (`b2p-lab voxelize`); smaller sizes drop low bits. Rows of other clouds stay in the file. B2P names a
`b2p` that is built already. Run it on a quiet machine.
"""

import argparse
import json
import os
import re
import struct
import subprocess
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
KEPT = HERE / "budget.json"
BITS = (10, 9, 7)
BUDGETS = (10, 20, 50, 100, 200, 500, 1000, 2000)  # ms
SIZES = ("512x512", "1024x1024", "1920x1080")
LINE = re.compile(r"budget: (?P<choice>.*), expected (?P<expected>[\d.]+) ms; (?P<not_promised>no setting fits)?.*?(took|kept:) (?P<took>[\d.]+) ms")


def b2p(*args):
    program = [os.environ["B2P"]] if "B2P" in os.environ else ["cargo", "run", "--release", "--quiet", "--"]
    done = subprocess.run([*program, *map(str, args), "--force"], cwd=ROOT, check=True, capture_output=True, text=True)
    return done.stderr


def coarser(source, bits, to):
    """The cloud with the lowest of its 10 bits dropped, and colours of voxels that fall together averaged."""
    header, body = source.read_bytes().split(b"end_header\n", 1)
    count = int(re.search(rb"element vertex (\d+)", header)[1])
    types = re.findall(rb"property (\w+) (\w+)", header)
    form = "<" + "".join({b"float": "f", b"uchar": "B", b"ushort": "H", b"int": "i", b"double": "d"}[t] for t, _ in types)
    at = {name.decode(): i for i, (_, name) in enumerate(types)}
    places = {}
    for row in struct.iter_unpack(form, body[: count * struct.calcsize(form)]):
        key = tuple(int(row[at[axis]]) >> (10 - bits) for axis in "xyz")
        sums = places.setdefault(key, [0, 0, 0, 0])
        for i, colour in enumerate(("red", "green", "blue")):
            sums[i] += row[at[colour]]
        sums[3] += 1
    rows = b"".join(struct.pack("<HHHBBB", *key, *(round(s / n) for s in rgb)) for key, (*rgb, n) in places.items())
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(places)}\n" + "".join(f"property ushort {a}\n" for a in "xyz")
    to.write_bytes((head + "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n").encode() + rows)


def code(name, cloud, streams):
    with tempfile.TemporaryDirectory() as folder:
        for bits in BITS:
            source = cloud
            if bits < 10:
                source = Path(folder) / "coarser.ply"
                coarser(cloud, bits, source)
            b2p("encode", source, "-o", streams / f"{name}-{bits}.b2p", "--bits", bits)


def measure(name, streams, repeat):
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        for bits in BITS:
            stream = streams / f"{name}-{bits}.b2p"
            tasks = [("decode", ["decode", stream, "-o", folder / "g.ply"])]
            tasks += [(size, ["render", stream, "-o", folder / "p.png", "--size", size, "--views", 2]) for size in SIZES]
            for task, args in tasks:
                for budget in BUDGETS:
                    for _ in range(repeat):
                        found = LINE.search(b2p(*args, "--budget", f"{budget}ms"))
                        row = {"cloud": name, "bits": bits, "task": task, "budget": budget, "choice": found["choice"], "promised": not found["not_promised"]}
                        rows.append(row | {key: float(found[key]) for key in ("expected", "took")})
    return rows


def table(rows):
    out = ["| budget | decodes promised | longest | at most a fifth over | pictures promised | longest | at most a fifth over |", "|---:|---:|---:|---|---:|---:|---|"]
    for budget in BUDGETS:
        cells = []
        for decode in (True, False):
            all_ = [r for r in rows if r["budget"] == budget and (r["task"] == "decode") == decode]
            kept = [r for r in all_ if r["promised"]]
            worst = max((r["took"] for r in kept), default=None)
            held = "–" if worst is None else "yes" if worst <= 1.2 * budget else "**no**"
            cells += [f"{len(kept)} of {len(all_)}", "–" if worst is None else f"{worst:.0f} ms" if worst >= 10 else f"{worst:.1f} ms", held]
        out.append(f"| {budget} ms | " + " | ".join(cells) + " |")
    return "\n".join(out)


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--clouds", nargs="+", metavar="NAME[=CLOUD.ply]", default=[])
    p.add_argument("--streams", type=Path, help="where coded clouds are")
    p.add_argument("--code", action="store_true", help="code the clouds and do no more")
    p.add_argument("--repeat", type=int, default=1)
    args = p.parse_args()
    if args.code:
        for pair in args.clouds:
            name, path = pair.split("=", 1)
            code(name, Path(path).resolve(), args.streams.resolve())
        return
    rows = json.loads(KEPT.read_text()) if KEPT.exists() else []
    for name in args.clouds:
        rows = [r for r in rows if r["cloud"] != name] + measure(name, args.streams.resolve(), args.repeat)
        KEPT.write_text("[\n" + ",\n".join(json.dumps(r) for r in rows) + "\n]\n")
    text, page = table(rows), HERE / "measurements.md"
    marked = re.sub(r"(<!-- budget -->\n).*?(\n<!-- /budget -->)", lambda m: m[1] + "\n" + text + "\n" + m[2], page.read_text(), flags=re.S)
    page.write_text(marked)
    over = sorted((r for r in rows if r["promised"]), key=lambda r: -r["took"] / r["budget"])
    print(text)
    for r in over[:10]:
        print(f"{r['took'] / r['budget']:.2f} of the budget, {r['took'] / r['expected']:.2f} of what was expected: {r}")


if __name__ == "__main__":
    main()
