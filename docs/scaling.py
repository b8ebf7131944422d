"""Time and memory against the size of the cloud: the procedural scene at several bit depths, decoded to its finest level.

    python3 docs/scaling.py [BITS …]      measures (default 7 to 13; the last two take some minutes), then does the rest
    python3 docs/scaling.py --plot        from docs/scaling.json: docs/scaling.svg, and the table on standard output
"""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
# Samples of the surface at 13 bits: all of its voxels would not encode in 24 GB.
SPARSE = 48_000_000
SERIES = {"ms": ("decode, two threads", "#1d4ed8"), "ms_one": ("decode, one thread", "#c2410c"), "mb": ("memory", "#15803d")}


def run(*args):
    return subprocess.run([str(a) for a in args], cwd=ROOT, check=True, capture_output=True, text=True).stdout


def measure(bits):
    built = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    program, lab, folder = built / "release/b2p", built / "release/b2p-lab", built / "scaling"
    folder.mkdir(exist_ok=True)
    cloud, stream = folder / f"{bits}.ply", folder / f"{bits}.b2p"
    if not stream.exists():
        run(lab, "voxelize", "procedural:scene", "--bits", bits, "--points", max(200_000, min(200_000_000, 14 * 4**bits)) if bits < 13 else SPARSE, "-o", cloud)
        run(program, "-q", "--force", "encode", cloud, "-o", stream, "--limits", "unlimited", "--no-blocks")
        cloud.unlink()
    out = {"bits": bits, "bytes": stream.stat().st_size}
    for key, more in (("ms", []), ("ms_one", ["--threads", 1])):
        report = json.loads(run(program, "bench", stream, "--json", "--repeat", 7 if bits < 10 else 3 if bits < 12 else 1, "--limits", "unlimited", *more))
        out[key] = report["decode_ms"]
        if key == "ms":
            out |= {"mb": report["peak_memory_bytes"] / 1e6, "isa": report["isa"], "level": report["level"]}
            out["voxels"] = max(s["count"] for s in report["stages"] if s["stage"] == f"geometry of level {report['level']}")
    return out


def plot(rows):
    width, height, left, top = 560, 320, 60, 20
    x = lambda v: left + (math.log10(v) - 3) / 5 * width
    y = lambda v: top + height - (math.log10(v) - 0) / 5 * height
    out = [f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="none" stroke="#d1d5db"/>']
    for e, name in zip(range(3, 9), ("1 k", "10 k", "100 k", "1 M", "10 M", "100 M")):
        out.append(f'<path d="M{x(10**e)} {top}v{height}" stroke="#e5e7eb"/><text x="{x(10**e)}" y="{top + height + 16}" text-anchor="middle">{name}</text>')
    for e in range(0, 6):
        out.append(f'<path d="M{left} {y(10**e)}h{width}" stroke="#e5e7eb"/><text x="{left - 6}" y="{y(10**e) + 4}" text-anchor="end">{10**e}</text>')
    for i, (key, (name, colour)) in enumerate(SERIES.items()):
        path = "L".join(f"{x(r['voxels']):.1f} {y(r[key]):.1f}" for r in rows)
        out.append(f'<path d="M{path}" fill="none" stroke="{colour}" stroke-width="2"/>')
        out += [f'<circle cx="{x(r["voxels"]):.1f}" cy="{y(r[key]):.1f}" r="3.5" fill="{colour}"/>' for r in rows]
        out.append(f'<text x="{left + 12}" y="{top + 20 + 18 * i}" fill="{colour}" font-weight="bold">{name}, {"MB" if key == "mb" else "ms"}</text>')
    out.append(f'<text x="{left + width / 2}" y="{top + height + 36}" text-anchor="middle">voxels of the finest decoded level</text>')
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{left + width + 20}" height="{top + height + 48}" font-family="sans-serif" font-size="12">'
    return f'{head}<rect width="100%" height="100%" fill="white"/>{"".join(out)}</svg>\n'


def main():
    kept = HERE / "scaling.json"
    if "--plot" not in sys.argv:
        run("cargo", "build", "--release", "--workspace", "--bins")
        rows = [measure(bits) for bits in map(int, sys.argv[1:] or range(7, 14))]
        kept.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")
    rows = json.loads(kept.read_text())
    print("| voxels | two threads | one thread | µs a voxel | memory |\n|---:|---:|---:|---:|---:|")
    for r in rows:
        print(f"| {r['voxels']:,} | {r['ms']:.0f} ms | {r['ms_one']:.0f} ms | {1e3 * r['ms'] / r['voxels']:.2f} | {r['mb']:.0f} MB |")
    (HERE / "scaling.svg").write_text(plot(rows))


if __name__ == "__main__":
    main()
