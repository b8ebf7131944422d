"""Scenes against their size: objects placed at random, coded from disk, decoded and drawn. User CPU seconds on two threads.

    python3 docs/scenes.py MESH… [--most POINTS]     measures (a larger cloud takes minutes), then does the rest
    python3 docs/scenes.py --plot                    from docs/scenes.json: docs/scenes.svg, and the table on standard output
"""

import argparse
import json
import math
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
BUILT = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release"
# Objects, and bits of the cell of each.
SIZES = [(1, 7), (1, 8), (1, 9), (1, 10), (3, 10), (9, 10), (30, 10), (100, 10)]
SERIES = {"encode_s": ("encode, s", "#1d4ed8"), "decode_s": ("decode, s", "#c2410c"), "encode_mb": ("memory to encode, 100 MB", "#15803d")}


def run(*args):
    """What a program printed, its user CPU seconds, and its peak memory in MB."""
    timed = ["/usr/bin/time", "-f", "%U %M", *map(str, args)]
    done = subprocess.run(timed, check=True, capture_output=True, text=True)
    user, kilobytes = done.stderr.strip().splitlines()[-1].split()
    return done.stdout or done.stderr, float(user), int(kilobytes) / 1e3


def measure(meshes, objects, bits, folder):
    b2p, lab = BUILT / "b2p", BUILT / "b2p-lab"
    cloud, scene, out = folder / "cloud.ply", folder / "scene.b2p", folder / "out"
    made, *_ = run(lab, "scene", *meshes, "--objects", objects, "--bits", bits, "--density", 0.5, "-o", cloud)
    points = int(re.search(r"(\d+) points", made)[1])
    row = {"objects": objects, "points": points}
    _, row["encode_s"], row["encode_mb"] = run(b2p, "--threads", 2, "-f", "encode", cloud, "-o", scene, "--max-memory", "400M", "--no-head-maps")
    cloud.unlink()
    row["bytes"] = scene.stat().st_size
    info = json.loads(run(b2p, "info", scene, "--json")[0])
    row["blocks"] = len(info.get("blocks", [0]))
    _, row["decode_s"], row["decode_mb"] = run(b2p, "--threads", 2, "-f", "decode", scene, "--points", "-o", out.with_suffix(".ply"), "--max-memory", "6G")
    _, row["view_s"], row["view_mb"] = run(b2p, "--threads", 2, "-f", "render", scene, "-o", out.with_suffix(".png"), "--heads", "surfels", "--lod", 1, "--orbit", "30,20,2", "--max-memory", "6G")
    return row


def plot(rows):
    width, height, left, top = 560, 320, 60, 20
    x = lambda v: left + (math.log10(v) - 4) / 4.2 * width
    y = lambda v: top + height - (math.log10(max(v, 0.01)) + 2) / 5 * height
    out = [f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="none" stroke="#d1d5db"/>']
    for e, name in zip(range(4, 9), ("10 k", "100 k", "1 M", "10 M", "100 M")):
        out.append(f'<path d="M{x(10**e)} {top}v{height}" stroke="#e5e7eb"/><text x="{x(10**e)}" y="{top + height + 16}" text-anchor="middle">{name}</text>')
    for e in range(-2, 4):
        out.append(f'<path d="M{left} {y(10**e)}h{width}" stroke="#e5e7eb"/><text x="{left - 6}" y="{y(10**e) + 4}" text-anchor="end">{10**e:g}</text>')
    for i, (key, (name, colour)) in enumerate(SERIES.items()):
        scale = 0.01 if key.endswith("mb") else 1
        places = [(x(r["points"]), y(r[key] * scale)) for r in rows]
        path = "L".join(f"{a:.1f} {b:.1f}" for a, b in places)
        out.append(f'<path d="M{path}" fill="none" stroke="{colour}" stroke-width="2"/>')
        out += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.5" fill="{colour}"/>' for a, b in places]
        out.append(f'<text x="{left + 12}" y="{top + 20 + 18 * i}" fill="{colour}" font-weight="bold">{name}</text>')
    out.append(f'<text x="{left + width / 2}" y="{top + height + 36}" text-anchor="middle">points</text>')
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{left + width + 20}" height="{top + height + 48}" font-family="sans-serif" font-size="12">'
    return f'{head}<rect width="100%" height="100%" fill="white"/>{"".join(out)}</svg>\n'


def table(rows):
    print("| objects | points | blocks | bits per point | encode | MB | decode | MB | one view | MB |")
    print("|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
    for r in rows:
        bits = 8 * r["bytes"] / r["points"]
        times = " | ".join(f"{r[k + '_s']:.1f} s | {r[k + '_mb']:,.0f}" for k in ("encode", "decode", "view"))
        print(f"| {r['objects']} | {r['points']:,} | {r['blocks']} | {bits:.3f} | {times} |")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--plot", action="store_true")
    parser.add_argument("--most", type=float, default=2e8)
    args = parser.parse_args()
    path = HERE / "scenes.json"
    if not args.plot:
        rows = []
        with tempfile.TemporaryDirectory() as folder:
            for objects, bits in SIZES:
                if objects * 1.2e6 * 4.0 ** (bits - 10) > args.most:
                    break
                rows.append(measure(args.meshes, objects, bits, Path(folder)))
                print(rows[-1], file=sys.stderr)
                path.write_text("[\n" + ",\n".join(json.dumps(r) for r in rows) + "\n]\n")
    rows = json.loads(path.read_text())
    (HERE / "scenes.svg").write_text(plot(rows))
    table(rows)


if __name__ == "__main__":
    main()
