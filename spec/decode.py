"""Decodes streams of version 3, and holds a folder of conformance streams against their digests.

    python3 spec/decode.py STREAM.b2p           prints the digests of every level, of each block and of each frame
    python3 spec/decode.py --suite FOLDER       checks all streams of FOLDER/suite.txt
    python3 spec/decode.py --damage LIST        checks that the streams of LIST are refused for the stated clauses
"""

import hashlib
import struct
import sys
from pathlib import Path

sys.dont_write_bytecode = True

import colour
import container
import geometry
import head_map
import scene
import sequence
import surfels
from base import Refused, require
from octree import Voxels
from xxh3 import xxh3_64


class Decoder:
    """Decodes a stream level by level, or the sections of a frame of a sequence: then the header is given, and for a
    predicted frame its motion and how the levels of the frame before were shown."""

    def __init__(self, data, header=None, motion=None, shown_before=None):
        if header is None:
            header = container.parse_header(data)
            end = header.length + sum(map(sum, header.sections))
            require(len(data) <= end, "2.1.1", "bytes after the last section")
        self.data, self.header, self.motion = data, header, motion
        self.network = geometry.Network(geometry.WEIGHTS.read_bytes())
        self.levels, self.coloured = [], []
        self.shown, self.shown_before = {}, shown_before or {}  # filter and steps of a level
        self.reach(Voxels(0, [0], [(0, 0, 0)]))

    def reach(self, voxels):
        self.levels.append(voxels)
        if self.motion:
            self.motion.reach(voxels)

    def decode(self, level):
        """The next level: its voxels and its display colours."""
        part = container.read_level(self.data, self.header, level)
        for _, slices in sorted(part.geometry.items()):
            nodes, size = self.levels[-1], self.header.slice_voxels
            self.reach(geometry.decode_level(self.network, nodes, slices, size, self.motion))
        if part.trunk is not None:
            last, payload = part.trunk
            self.coloured = colour.decode_trunk(self.levels[: last + 1], payload, self.motion)
        for n, payloads in sorted(part.colours.items()):
            nodes, children = self.levels[n - 1 : n + 1]
            above, size = self.coloured[-1], self.header.colour_slice
            self.coloured.append(colour.decode_level(nodes, children, n, above, payloads, size, self.motion))
        voxels, values, steps = self.levels[level], self.coloured[-1].values, self.coloured[-1].steps
        found = xxh3_64(b"".join((x & 65535).to_bytes(2, "little") for value in values for x in value))
        require(found == part.colour_hash, "5.10.1", f"colour hash of level {level}")
        self.shown[level] = self.show(level, part.filter, steps)
        if self.shown[level][0] is not None:
            values = colour.filtered(voxels, values, self.shown[level][1], self.shown[level][0])
        blocks = len(self.levels[max(level - 3, 0)])
        sizes = part.head_map and head_map.parse(part.head_map, blocks)
        self.size = sizes[1] if sizes else 64
        return voxels, [colour.display(value, steps.fraction()) for value in values]

    def show(self, level, own_filter, steps):
        """17.4.3: the filter of a level, and the steps that it has for 5.11."""
        if own_filter is None and level in self.shown_before:
            own_filter, before = self.shown_before[level]
            if before.lossless() == steps.lossless():
                steps = before
        return own_filter, steps


def digest(level, voxels, colours, gaussians, count, part):
    """`level=geometry,colours,surfels` of a range of voxels, with `count` surfels each (16.2)."""
    keys = b"".join(struct.pack("<Q", voxels.keys[i]) for i in part)
    own_colours = bytes(x for i in part for x in colours[i])
    drawn = gaussians.tobytes(slice(count * part.start, count * part.stop))
    return f"{level}=" + ",".join(hashlib.sha256(part).hexdigest() for part in (keys, own_colours, drawn))


def digests(data, like=None):
    """For a stream, and for each block of a scene and each frame of a sequence, what is behind its name, and the digest of
    every level (16.2, 16.4, 16.5). It must be what `like` is: a stream of one frame, a sequence or a scene."""
    like = like or data
    if sequence.is_sequence(like):
        return sequence_digests(sequence.Sequence(data, Decoder))
    if scene.is_scene(like):
        decoder = scene.Scene(data, Decoder)
        return level_digests(decoder, ["", *(f"/{i}" for i in range(len(decoder.blocks)))])
    return level_digests(Decoder(data), [""])


def sequence_digests(decoder):
    """16.5"""
    lines, ticks = [], []
    for number, (tick, frame) in enumerate(decoder.frames()):
        lines += level_digests(frame, [f"/{number}"])
        ticks.append(tick)
    return [" ".join(map(str, ["", decoder.timescale, *ticks])), *lines]


def level_digests(decoder, names):
    """The digests of every level of a stream or a frame, or of a scene and each of its blocks."""
    lines = [[] for _ in names]
    for level in range(decoder.header.base, decoder.header.top + 1):
        voxels, colours, *of_scene = decoder.decode(level)
        sizes, blocks = of_scene or (decoder.size, [])
        count = 4 if level + 1 < decoder.header.bits else 1
        gaussians = surfels.surfels(voxels, colours, count, sizes, blocks)
        for line, part in zip(lines, [range(len(voxels)), *blocks]):
            line.append(digest(level, voxels, colours, gaussians, count, part))
    return [" ".join([name, *line]) for name, line in zip(names, lines)]


def check(folder):
    """How many streams of the suite decode to something else."""
    failed = 0
    lines = (folder / "suite.txt").read_text().splitlines()
    streams = [name for name in (line.split(" ")[0] for line in lines) if "/" not in name]
    for name in streams:
        expected = [line[len(name) :] for line in lines if line.startswith((f"{name} ", f"{name}/"))]
        try:
            found = digests((folder / f"{name}.b2p").read_bytes())
            good, why = found == expected, f"DIFFERS: {found}"
        except Refused as fault:
            good, why = False, f"REFUSED: {fault}"
        print(f"{name}: {'as expected' if good else why}", flush=True)
        failed += not good
    print(f"{len(streams)} streams, {failed} differ")
    return failed


def damaged(data, changes):
    """The stream after changes `offset:removed:inserted` (16.3)."""
    for change in reversed(changes):
        offset, removed, inserted = change.split(":")
        end = int(offset) + int(removed)
        data = data[: int(offset)] + bytes.fromhex(inserted) + data[end:]
    return data


def check_damage(path):
    """How many damaged streams are not refused for the stated clause."""
    failed = count = 0
    for line in path.read_text().splitlines():
        name, stream, expected, *changes = line.split(" ")
        if not stream.startswith(("version-3/", "scenes/", "sequences/")):
            continue
        whole = (path.parent / f"{stream}.b2p").read_bytes()
        try:
            digests(damaged(whole, changes), whole)
            found = "nothing"
        except Refused as fault:
            found = fault.clause
        if found != expected:
            print(f"{name}: REFUSED FOR {found}, not {expected}", flush=True)
        failed += found != expected
        count += 1
    print(f"{count} damaged streams, {failed} refused for another clause or not at all")
    return failed


def main(arguments):
    match arguments:
        case ["--suite", folder]:
            return min(check(Path(folder)), 1)
        case ["--damage", path]:
            return min(check_damage(Path(path)), 1)
        case [path]:
            print(*digests(Path(path).read_bytes()), sep="\n")
            return 0
    print(__doc__)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
