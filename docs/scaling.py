"""Time and memory of decoding against size, drawn into scaling.svg.

    cargo build --release --workspace
    python3 docs/scaling.py target/release WORKING_FOLDER [--prepare]

Makes clouds of one procedural object at growing bit depths, encodes them (what is there already is kept; with --prepare, that is all),
then decodes each to its finest level and plots medians and peak memory against the voxels of that level.
"""

import argparse
import json
import math
import subprocess
from pathlib import Path

# Bit depth, points drawn on the surface.
CLOUDS = [(6, 10**6), (7, 3 * 10**6), (8, 10**7), (9, 15 * 10**6), (10, 4 * 10**7), (11, 10**8)]
OBJECT = "procedural:stone"


def prepare(programs, folder, bits, points):
    """The stream of one cloud, or nothing with the reason printed."""
    cloud, stream = folder / f"{bits}.ply", folder / f"{bits}.b2p"
    if not stream.exists():
        if not cloud.exists():
            subprocess.run([programs / "b2p-lab", "voxelize", OBJECT, "-o", cloud, "--bits", str(bits), "--points", str(points)],
                           check=True)
        done = subprocess.run([programs / "b2p", "-q", "encode", cloud, "-o", stream], capture_output=True, text=True)
        if done.returncode:
            print(f"{cloud}: {done.stderr.strip()}")
            return None
    return stream


def measure(programs, stream):
    """Voxels, milliseconds, bytes."""
    done = subprocess.run([programs / "b2p", "-q", "bench", stream, "--json", "--repeat", "3"], capture_output=True, text=True)
    if done.returncode:
        print(f"{stream}: {done.stderr.strip()}")
        return None
    report = json.loads(done.stdout)
    voxels = max(stage["count"] for stage in report["stages"] if stage["unit"] == "voxels")
    print(f"{voxels:>9} voxels {report['decode_ms']:9.1f} ms {report['peak_memory_bytes'] / 1e6:7.0f} MB, {report['isa']}", flush=True)
    return voxels, report["decode_ms"], report["peak_memory_bytes"]


def panel(left, title, points):
    """A plot of points on logarithmic axes, 300 by 240, with the line through the last that is linear in voxels."""
    xs, ys = [math.log10(p[0]) for p in points], [math.log10(p[1]) for p in points]
    x0, x1, y0, y1 = (f(v) for v, f in ((min(xs), math.floor), (max(xs), math.ceil), (min(ys), math.floor), (max(ys), math.ceil)))
    px = lambda x: left + 50 + 240 * (x - x0) / (x1 - x0)
    py = lambda y: 220 - 180 * (y - y0) / (y1 - y0)
    out = [f'<text x="{left + 170}" y="24" text-anchor="middle" font-weight="bold">{title}</text>']
    for x in range(x0, x1 + 1):
        out.append(f'<path d="M{px(x):.1f} 40V220" stroke="#ddd"/><text x="{px(x):.1f}" y="236" text-anchor="middle">{10**x:,}</text>')
    for y in range(y0, y1 + 1):
        out.append(f'<path d="M{left + 50} {py(y):.1f}h240" stroke="#ddd"/><text x="{left + 46}" y="{py(y) + 4:.1f}" text-anchor="end">{10**y:,}</text>')
    end, rise = xs[-1], ys[-1] - xs[-1]
    start = max(x0, y0 - rise)
    out.append(f'<path d="M{px(start):.1f} {py(start + rise):.1f}L{px(end):.1f} {py(end + rise):.1f}" stroke="#999" stroke-dasharray="4 3"/>')
    path = "L".join(f"{px(x):.1f} {py(y):.1f}" for x, y in zip(xs, ys))
    out.append(f'<path d="M{path}" stroke="#06c" fill="none" stroke-width="1.5"/>')
    out += [f'<circle cx="{px(x):.1f}" cy="{py(y):.1f}" r="3" fill="#06c"/>' for x, y in zip(xs, ys)]
    out.append(f'<text x="{left + 170}" y="252" text-anchor="middle">voxels of the decoded level</text>')
    return "".join(out)


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("programs", type=Path)
    p.add_argument("folder", type=Path)
    p.add_argument("--prepare", action="store_true")
    p.add_argument("--most", type=float, default=math.inf, help="the most points to draw for a cloud")
    args = p.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    clouds = [cloud for cloud in CLOUDS if cloud[1] <= args.most]
    streams = [stream for cloud in clouds if (stream := prepare(args.programs, args.folder, *cloud))]
    if args.prepare:
        return
    results = sorted(result for stream in streams if (result := measure(args.programs, stream)))
    times = panel(0, "decoding, ms", [(voxels, time) for voxels, time, _ in results])
    memory = panel(310, "peak memory, MB", [(voxels, peak / 1e6) for voxels, _, peak in results])
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 620 264" font-family="sans-serif" font-size="11"><rect width="620" height="264" fill="#fff"/>{times}{memory}</svg>\n'
    (Path(__file__).parent / "scaling.svg").write_text(svg)


if __name__ == "__main__":
    main()
