"""Decodes streams of version 3, and holds a folder of conformance streams against their digests.

    python3 spec/decode.py STREAM.b2p [HEADS.safetensors best|quick]
                                           prints the digests of every level, of each block and of each frame
    python3 spec/decode.py --suite FOLDER  checks all streams of FOLDER, drawn as surfels and with learned heads
    python3 spec/decode.py --damage LIST   checks that the streams of LIST are refused for the stated clauses
"""

import functools
import hashlib
import struct
import sys
from pathlib import Path

sys.dont_write_bytecode = True

import colour
import container
import geometry
import head_map
import heads
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
        """The next level."""
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
        self.shown[level] = own_filter, shown_steps = self.show(level, part.filter, steps)
        before = displayed(values, steps)
        if own_filter is not None:
            values = colour.filtered(voxels, values, shown_steps, own_filter)
        above = None
        if level > self.header.base or part.trunk is not None and part.trunk[0] < level:
            above = displayed(self.coloured[-2].values, self.coloured[-2].steps)
        drawn = self.drawn(level, part.head_map, shown_steps)
        return heads.Level(voxels, self.header.bits, displayed(values, steps), before, above, [drawn])

    def drawn(self, level, chunk, steps):
        """7.2.3, 7.5: what the stream says of how a level is drawn."""
        up = min(level, 3)
        keys = self.levels[level].keys
        blocks = self.levels[level - up].keys
        found = chunk and head_map.parse(chunk.payload, len(blocks))
        *sizes, how, bits = found or (64, 64, 0, [0] * len(blocks))
        thickness = head_map.thickness(chunk.count) if found else (0, 0)
        is_disc = dict(zip(blocks, bits))
        discs = None if how == 1 else [is_disc[key >> 3 * up] for key in keys]
        return heads.Part(range(len(keys)), steps.units(), sizes, thickness, discs)

    def show(self, level, own_filter, steps):
        """17.4.3: the filter of a level, and the steps that it has for 5.11."""
        if own_filter is None and level in self.shown_before:
            own_filter, before = self.shown_before[level]
            if before.lossless() == steps.lossless():
                steps = before
        return own_filter, steps


def displayed(values, steps):
    """5.11.4"""
    return [colour.display(value, steps.fraction()) for value in values]


def digest(level, rows, gaussians):
    """`level=geometry,colours,gaussians` of a range of voxels (16.2)."""
    voxels = level.voxels
    keys = b"".join(struct.pack("<Q", voxels.keys[i]) for i in rows)
    own_colours = bytes(x for i in rows for x in level.colours[i])
    parts = (keys, own_colours, gaussians.tobytes())
    return f"{voxels.level}=" + ",".join(hashlib.sha256(part).hexdigest() for part in parts)


def digests(data, like=None, ways=(heads.gaussians,)):
    """For a stream, and for each block of a scene and each frame of a sequence, what is behind its name, and the digest of
    every level (16.2, 16.4, 16.5), for each way to make Gaussians. It must be what `like` is: a stream of one frame, a
    sequence or a scene."""
    like = like or data
    if sequence.is_sequence(like):
        return sequence_digests(sequence.Sequence(data, Decoder), ways)
    if scene.is_scene(like):
        decoder = scene.Scene(data, Decoder)
        return level_digests(decoder, ["", *(f"/{i}" for i in range(len(decoder.blocks)))], ways)
    return level_digests(Decoder(data), [""], ways)


def sequence_digests(decoder, ways):
    """16.5"""
    lines, ticks = [[] for _ in ways], []
    for number, (tick, frame) in enumerate(decoder.frames()):
        for of_way, found in zip(lines, level_digests(frame, [f"/{number}"], ways)):
            of_way += found
        ticks.append(tick)
    return [[" ".join(map(str, ["", decoder.timescale, *ticks])), *of_way] for of_way in lines]


def level_digests(decoder, names, ways):
    """The digests of every level of a stream or a frame, or of a scene and each of its blocks, for each way."""
    lines = [[[name] for name in names] for _ in ways]
    for number in range(decoder.header.base, decoder.header.top + 1):
        level = decoder.decode(number)
        for of_way, draw in zip(lines, ways):
            parts = [(part.rows, gaussians) for part, gaussians in zip(level.parts, draw(level))]
            if len(names) > 1 and parts:
                whole = functools.reduce(surfels.Gaussians.followed_by, (gaussians for _, gaussians in parts))
                parts.insert(0, (range(len(level.voxels)), whole))
            for line, (rows, gaussians) in zip(of_way, parts):
                line.append(digest(level, rows, gaussians))
    return [[" ".join(line) for line in of_way] for of_way in lines]


def learned(model, quality):
    """How a level is drawn with learned heads, which do not draw level 0 (7.2.1)."""
    return lambda level: heads.gaussians(level, model, quality) if level.voxels.level else []


def check(folder):
    """How many streams of the suite decode to something else, drawn as surfels and with learned heads (16.6)."""
    model = heads.Model((folder.parent / "heads.safetensors").read_bytes())
    ways = {"suite.txt": heads.gaussians, "best.txt": learned(model, "best"), "quick.txt": learned(model, "quick")}
    lines = {file: (folder / file).read_text().splitlines() for file in ways}
    streams = [name for name in (line.split(" ")[0] for line in lines["suite.txt"]) if "/" not in name]
    failed = 0
    for name in streams:
        own = (f"{name} ", f"{name}/")
        expected = [[line[len(name) :] for line in lines[file] if line.startswith(own)] for file in ways]
        try:
            found = digests((folder / f"{name}.b2p").read_bytes(), ways=ways.values())
            wrong = [f"{file} DIFFERS: {f}" for file, e, f in zip(ways, expected, found) if e != f]
        except Refused as fault:
            wrong = [f"REFUSED: {fault}"]
        print(f"{name}: {'; '.join(wrong) or 'as expected'}", flush=True)
        failed += bool(wrong)
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
            print(*digests(Path(path).read_bytes())[0], sep="\n")
            return 0
        case [path, model, "best" | "quick" as quality]:
            way = learned(heads.Model(Path(model).read_bytes()), quality)
            print(*digests(Path(path).read_bytes(), ways=[way])[0], sep="\n")
            return 0
    print(__doc__)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
