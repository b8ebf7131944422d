"""Colour bits of b2p and of TMC13 at equal PSNR of voxels, both coding the same colours: TMC13's own recolouring of the cloud.

    python3 lab/colour_bits.py --data FOLDER --clouds FOLDER --out FOLDER --tmc3 PROGRAM [--objects NAME …]

DATA holds TMC13's decoded clouds (`gpcc/*.ply.zst`) and rates (`SOURCES.md`), CLOUDS the clouds that `b2p-lab voxelize` made of the meshes. What TMC13
recolours the cloud to comes from its encoder at QP 4, which is next to lossless (`--tmc3`). b2p codes that cloud, voxel by voxel. PSNR of decoded
8-bit colours is of BT.709 Y, of (6 Y + Cb + Cr) / 8, and of RGB. The logarithm of b2p's bits is interpolated linearly over PSNR; means over QP 28, 34
and 40 are geometric. Needs numpy and the program zstd; B2P names the program.
"""

import argparse
import json
import os
import re
import subprocess
from pathlib import Path

import numpy as np

OBJECTS = ("person_Asian_F_3_Casual", "person_Hispanic_M_3_Milit", "tds_Penelope", "coffee_grinder", "avocado", "gso_frypan", "tds_Hermes")
LEVELS = {8: ("s0.25", 4), 9: ("s0.5", 2)}
STEPS = (6, 12, 24, 48, 90)
TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1", "ushort": "<u2", "uint16": "<u2", "int": "<i4", "int32": "<i4"}


def read(path):
    """Whole positions and colours of a binary PLY."""
    path = str(path)
    data = subprocess.run(["zstd", "-dc", path], check=True, capture_output=True).stdout if path.endswith(".zst") else Path(path).read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    header = data[:end].decode("latin1")
    kind = np.dtype([(name, TYPES[t]) for t, name in re.findall(r"^property (\w+) (\w+)$", header, re.M)])
    rows = np.frombuffer(data[end:], kind, int(re.search(r"element vertex (\d+)", header)[1]))
    return np.stack([np.rint(rows[a]) for a in "xyz"], 1).astype(np.int64), np.stack([rows[c] for c in ("red", "green", "blue")], 1).astype(float)


def keys(voxels):
    return (voxels[:, 0] << 40) | (voxels[:, 1] << 20) | voxels[:, 2]


def psnr(colours, truth):
    """Y, 611, RGB."""
    d = colours - truth
    y = d @ [0.2126, 0.7152, 0.0722]
    cb, cr = (d[:, 2] - y) / 1.8556, (d[:, 0] - y) / 1.5748
    db = lambda e: 10 * np.log10(255**2 / max((e**2).mean(), 1e-9))
    return db(y), (6 * db(y) + db(cb) + db(cr)) / 8, db(d)


TMC3 = ("--mode=0 --trisoupNodeSizeLog2=0 --mergeDuplicatedPoints=1 --neighbourAvailBoundaryLog2=8 --intra_pred_max_node_size_log2=6 "
        "--maxNumQtBtBeforeOt=4 --minQtbtSizeLog2=0 --planarEnabled=1 --planarModeIdcmUse=0 --rahtPredictionSearchRange=50000 "
        "--convertPlyColourspace=1 --transformType=0 --qp=4 --qpChromaOffset=0 --bitdepth=8 --attribute=color").split()


def target(tmc3, cloud, level, out):
    """Voxels of a level and the colours that TMC13 gives them before it codes them; as a PLY, too."""
    step, decoded = LEVELS[level][1], out / "decoded.ply"
    subprocess.run([tmc3, *TMC3, f"--positionQuantizationScale={1 / step}", f"--uncompressedDataPath={cloud}", f"--compressedStreamPath={out}/stream.bin",
                    f"--reconstructedDataPath={decoded}"], check=True, capture_output=True)
    xyz, rgb = read(decoded)
    voxels = xyz // step if not (xyz % step).any() else xyz
    order = np.argsort(keys(voxels))
    voxels, rgb = voxels[order], rgb[order]
    kind = np.dtype([("p", "<i4", 3), ("c", "u1", 3)])
    rows = np.zeros(len(voxels), kind)
    rows["p"], rows["c"] = voxels, rgb
    names = "".join(f"property int {a}\n" for a in "xyz") + "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    (out / "target.ply").write_bytes(f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{names}end_header\n".encode() + rows.tobytes())
    return keys(voxels), rgb


def peer(data, name, level, known, truth):
    """[(bits per point, PSNRs)] of TMC13's colours."""
    scale, step = LEVELS[level]
    text, out = (data / "SOURCES.md").read_text(), []
    for quality in (28, 34, 40):
        file = f"{name}_{scale}_q{quality}.ply.zst"
        rate = float(re.search(rf"^\| {re.escape(file)} \|(.*)\|$", text, re.M)[1].split("|")[2])
        xyz, rgb = read(data / "gpcc" / file)
        order = np.argsort(keys(xyz // step))
        assert (keys(xyz // step)[order] == known).all(), "TMC13's voxels are the same at every QP"
        out.append((rate, psnr(rgb[order], truth)))
    return out


def own(program, level, known, truth, points, out):
    """The same of b2p's streams."""
    rows = []
    for step in STEPS:
        stream, decoded = out / "stream.b2p", out / "points.ply"
        run = lambda *args: subprocess.run([program, *map(str, args)], check=True, capture_output=True, text=True).stdout
        run("encode", out / "target.ply", "-o", stream, "--bits", level, "--levels", f"{level}..{level}", "--step", step, "-q", "--force")
        parts = json.loads(run("info", stream, "--json"))["levels"]
        bits = 8 * sum(part["colour_bytes"] for part in parts) / points
        run("decode", stream, "-o", decoded, "--points", "-q", "--force")
        xyz, rgb = read(decoded)
        order = np.argsort(keys(xyz))
        assert len(xyz) == len(known), "the stream has TMC13's voxels"
        rows.append((bits, psnr(rgb[order], truth)))
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--clouds", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tmc3", type=Path, required=True)
    parser.add_argument("--objects", nargs="*", default=OBJECTS)
    parser.add_argument("--levels", nargs="*", type=int, default=(9, 8))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    program, all_rows = os.environ.get("B2P", "target/release/b2p"), {}
    for name in args.objects:
        path = args.clouds / f"{name}.ply"
        points = len(read(path)[0])
        for level in args.levels:
            known, truth = target(args.tmc3, path, level, args.out)
            theirs, ours = peer(args.data, name, level, known, truth), sorted(own(program, level, known, truth, points, args.out))
            ratios = []
            for rate, scores in theirs:
                bits = [np.exp(np.interp(score, [row[1][k] for row in ours], [np.log(row[0]) for row in ours])) for k, score in enumerate(scores)]
                ratios.append([b / rate for b in bits])
            mean = np.exp(np.log(ratios).mean(0))
            all_rows.setdefault(level, []).append(mean)
            y = [" ".join("%.1f at %.4f" % (scores[0], rate) for rate, scores in rows) for rows in (theirs, ours)]
            print(f"| {name} | {level} |", " | ".join("%.2f" % x for x in mean), "| Y by QP", *("%.2f" % r[0] for r in ratios), "| TMC13", y[0], "| b2p", y[1], flush=True)
    for level, rows in all_rows.items():
        print(f"| mean | {level} |", " | ".join("%.2f" % x for x in np.mean(rows, 0)), "|")


if __name__ == "__main__":
    main()
