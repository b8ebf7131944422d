#!/usr/bin/env python3
"""Makes docs/captured.png: simulated captures of the sample scene, their points as points beside streams of them.

    cargo build --release && cargo build --release -p b2p-lab
    python3 docs/captured.py [FOLDER OF THE PROGRAMS]

Above a laser scanner, below photogrammetry. Needs nothing but the two programs and Python.
"""
import json
import math
import struct
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

DOCS = Path(__file__).parent
SIZE = (480, 560)
KINDS = ("lidar", "photogrammetry")
POINTS = 150_000
# σ of a point, in units of the scene.
POINT = 0.0012


def points(path):
    """The rows x, y, z, r, g, b of a binary PLY of the laboratory."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in head.decode().splitlines()]
    kinds = {"float": "f", "double": "d", "uchar": "B"}
    row = struct.Struct("<" + "".join(kinds[line[1]] for line in lines if line[0] == "property"))
    return [values[:3] + values[-3:] for values in row.iter_unpack(body)]


def as_points(rows, grid, path):
    """Writes a small round Gaussian for each point, in the cube of this grid."""
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    head = "ply\nformat binary_little_endian 1.0\n"
    head += f"comment b2p bits {grid['bits']}\ncomment b2p origin {' '.join(map(str, grid['origin']))}\n"
    head += f"comment b2p voxel_size {grid['voxel_size']}\nelement vertex {len(rows)}\n"
    head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    zeroth = math.sqrt(4 * math.pi)
    size = math.log(POINT)
    pack = struct.Struct("<14f").pack
    body = (pack(*row[:3], *((c / 255 - 0.5) * zeroth for c in row[3:]), 8, size, size, size, 1, 0, 0, 0) for row in rows)
    path.write_bytes(head.encode() + b"".join(body))


def pixels(program, path, folder):
    """The rows of the picture of a file."""
    picture = folder / "picture.ppm"
    view = ["--size", "x".join(map(str, SIZE)), "--orbit", "20,20,2.9", "--fov", "40"]
    subprocess.run([program, "-q", "-f", "render", path, picture, *view], check=True)
    return [picture.read_bytes()[-3 * SIZE[0] * SIZE[1] :][3 * SIZE[0] * y :][: 3 * SIZE[0]] for y in range(SIZE[1])]


def png(rows, path):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", len(rows[0]) // 3, len(rows), 8, 2, 0, 0, 0)
    # The filter "up" for every row.
    above, filtered = bytes(len(rows[0])), b""
    for row in rows:
        filtered += b"\2" + bytes((a - b) & 255 for a, b in zip(row, above))
        above = row
    data = zlib.compress(filtered, 9)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b""))


def main():
    programs = Path(sys.argv[1] if len(sys.argv) > 1 else DOCS.parent / "target/release")
    b2p, lab = programs / "b2p", programs / "b2p-lab"
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        for kind in KINDS:
            cloud, stream = folder / "cloud.ply", folder / "cloud.b2p"
            capture = ["procedural:scene", "-o", cloud, "--kind", kind, "--points", str(POINTS), "--seed", "1"]
            subprocess.run([lab, "capture", *capture], check=True)
            said = subprocess.run([b2p, "-f", "encode", cloud, stream, "--quality", "62"], check=True, capture_output=True)
            print(kind, said.stderr.decode().strip().splitlines()[-1])
            info = subprocess.run([b2p, "info", stream, "--json"], check=True, capture_output=True)
            as_points(points(cloud), json.loads(info.stdout), folder / "points.ply")
            left, right = (pixels(b2p, path, folder) for path in (folder / "points.ply", stream))
            rows += [a + b for a, b in zip(left, right)]
    png(rows, DOCS / "captured.png")


main()
