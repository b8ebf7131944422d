"""Decodes streams of version 3, and holds a folder of conformance streams against their digests.

    python3 spec/decode.py STREAM.b2p           prints voxels and digests of every level
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
import surfels
from base import Refused, require
from octree import Voxels
from xxh3 import xxh3_64


class Decoder:
    """Decodes a stream level by level."""

    def __init__(self, data):
        self.data = data
        self.header = container.parse_header(data)
        end = self.header.length + sum(map(sum, self.header.sections))
        require(len(data) <= end, "2.1.1", "bytes after the last section")
        self.network = geometry.Network(geometry.WEIGHTS.read_bytes())
        self.levels = [Voxels(0, [0], [(0, 0, 0)])]
        self.coloured = None

    def decode(self, level):
        """The next level: its voxels and its display colours."""
        part = container.read_level(self.data, self.header, level)
        for n, slices in sorted(part.geometry.items()):
            self.levels.append(geometry.decode_level(self.network, self.levels[-1], slices, self.header.slice_voxels))
        if part.trunk is not None:
            last, payload = part.trunk
            self.coloured = colour.decode_trunk(self.levels[: last + 1], payload)
        for n, payloads in sorted(part.colours.items()):
            nodes, children = self.levels[n - 1 : n + 1]
            self.coloured = colour.decode_level(nodes, children, n, self.coloured, payloads, self.header.colour_slice)
        voxels, values = self.levels[level], self.coloured.values
        found = xxh3_64(b"".join((x & 65535).to_bytes(2, "little") for value in values for x in value))
        require(found == part.colour_hash, "5.10.1", f"colour hash of level {level}")
        if part.filter is not None:
            values = colour.filtered(voxels, self.coloured, part.filter)
        blocks = len(self.levels[max(level - 3, 0)])
        sizes = part.head_map and head_map.parse(part.head_map, blocks)
        self.size = sizes[1] if sizes else 64
        fraction = self.coloured.steps.fraction()
        return voxels, [colour.display(value, fraction) for value in values]


def digests(data):
    """For every level `level=geometry,colours,surfels` (16.2)."""
    decoder = Decoder(data)
    for level in range(decoder.header.base, decoder.header.top + 1):
        voxels, colours = decoder.decode(level)
        keys = b"".join(struct.pack("<Q", key) for key in voxels.keys)
        count = 4 if level + 1 < decoder.header.bits else 1
        gaussians = surfels.surfels(voxels, colours, count, decoder.size)
        parts = [keys, bytes(x for rgb in colours for x in rgb), gaussians.tobytes()]
        yield f"{level}=" + ",".join(hashlib.sha256(part).hexdigest() for part in parts)


def check(folder):
    """How many streams of the suite decode to something else."""
    failed = 0
    lines = (folder / "suite.txt").read_text().splitlines()
    for line in lines:
        name, *expected = line.split(" ")
        try:
            found = list(digests((folder / f"{name}.b2p").read_bytes()))
            good, why = found == expected, f"DIFFERS: {found}"
        except Refused as fault:
            good, why = False, f"REFUSED: {fault}"
        print(f"{name}: {'as expected' if good else why}", flush=True)
        failed += not good
    print(f"{len(lines)} streams, {failed} differ")
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
        if not stream.startswith("version-3/"):
            continue
        try:
            list(digests(damaged((path.parent / f"{stream}.b2p").read_bytes(), changes)))
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
