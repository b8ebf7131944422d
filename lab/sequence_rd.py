#!/usr/bin/env python3
"""Rate and distortion of sequences: codes every frame at several rates, judges with `b2p-lab eval-sequence`.

    lab/sequence_rd.py DIR -o OUT --codec 'b2p=b2p encode {in} -o {out}.b2p --bits-per-point {rate}' --rates 0.1,0.2

DIR is what `b2p-lab animate` wrote. A codec is NAME=COMMAND, repeatable. {in} is a frame's cloud, {out} its output
without ending, {rate} one of the rates; the command must write {out}.b2p, or {out}.ply with a line of the size of its
bitstream in bytes in {out}.bytes. Commands run without a shell. Outputs that exist are not made again.
"""
import argparse
import json
import pathlib
import shlex
import subprocess
import sys


def codec(text):
    name, sign, command = text.partition("=")
    if not (name and sign and command) or "/" in name:
        raise argparse.ArgumentTypeError("expected NAME=COMMAND")
    return name, command


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=pathlib.Path, metavar="DIR")
    parser.add_argument("-o", "--output", type=pathlib.Path, required=True)
    parser.add_argument("--codec", type=codec, action="append", required=True)
    parser.add_argument("--rates", required=True, help="values of {rate}, with commas between")
    parser.add_argument("--frames", type=int, help="the first frames alone")
    parser.add_argument("--lab", default="b2p-lab", help="the program b2p-lab, with arguments if need be")
    parser.add_argument("--eval", default="", help="more arguments of eval-sequence, such as '--heads quick'")
    return parser.parse_args()


def code(args, frames, name, command, rate):
    """Codes all frames; the folder, and the bits per point if the codec says its own sizes."""
    folder = args.output / f"{name}_{rate}"
    folder.mkdir(parents=True, exist_ok=True)
    size, sized = 0, 0
    for frame in frames:
        out = folder / pathlib.Path(frame["file"]).stem
        results = [out.with_suffix(".b2p"), out.with_suffix(".ply")]
        if not any(r.exists() for r in results):
            fields = {"in": str(args.sequence / frame["file"]), "out": str(out), "rate": rate}
            words = [word.format(**fields) for word in shlex.split(command)]
            subprocess.run(words, check=True)
        if not any(r.exists() for r in results):
            sys.exit(f"{name}: the command wrote neither {results[0]} nor {results[1]}")
        sizes = out.with_suffix(".bytes")
        if sizes.exists():
            size, sized = size + int(sizes.read_text()), sized + 1
    points = sum(frame["voxels"] for frame in frames)
    return folder, 8 * size / points if sized == len(frames) else None


def main():
    args = arguments()
    frames = json.loads((args.sequence / "sequence.json").read_text())["frames"][: args.frames]
    items = []
    for name, command in args.codec:
        for rate in args.rates.split(","):
            folder, bits = code(args, frames, name, command, rate)
            items.append(f"{name} {rate}={folder}" + (f"@{bits:.6f}" if bits is not None else ""))
    judge = [*shlex.split(args.lab), "eval-sequence", "--truth", str(args.sequence), "--frames", str(len(frames))]
    subprocess.run([*judge, *shlex.split(args.eval), "-o", str(args.output), *items], check=True)


if __name__ == "__main__":
    main()
