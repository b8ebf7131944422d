"""Sequences of frames: clauses 17.1 to 17.4 of docs/format.md."""

import struct
from dataclasses import dataclass, replace

import container
from base import Reader, require
from motion import Known, Motion
from xxh3 import xxh3_64

CRITICAL_FLAG, INDEX, FRAME_TABLE = 1, 10, 11
WHOLE, PREDICTED = 0, 1


@dataclass
class Group:
    """17.2.2: a group in the index. Its place counts from the end of the index."""

    frames: int
    first: int  # tick of its first frame
    ticks: int
    start: int
    end: int
    hash: int


@dataclass
class Frame:
    """17.3.2: a frame in the frame table."""

    kind: int
    tick: int  # in the group
    points: int
    voxels: list  # of level L, ..., M
    lengths: list  # of the motion, the geometry section and the colour section of level L, ..., M


def is_sequence(data):
    """2.2.1"""
    return len(data) >= 16 and data[8] == 3 and struct.unpack("<I", data[12:16])[0] == CRITICAL_FLAG


def read_chunk(reader):
    """The next chunk that is not ancillary."""
    chunk = container.Chunks.read(reader, (INDEX, FRAME_TABLE))
    return chunk if chunk.kind < 128 else read_chunk(reader)


def read_index(data, header):
    """17.2: the timescale and the groups, and where the index ends."""
    reader = Reader(data, "17.1.1", header.length)
    chunk = read_chunk(reader)
    fits = (chunk.kind, chunk.level, chunk.slice) == (INDEX, 0, 0)
    require(fits and chunk.count > 0, "17.2.1", "index of the sequence")
    payload = Reader(chunk.payload, "17.2.2")
    require(payload.number("B") == 0, "17.2.2", "units of the index")
    timescale, duration = payload.number("I"), payload.number("I")
    require(timescale > 0 and duration > 0, "17.2.2", "frame rate")
    groups, tick, at = [], 0, 0
    for _ in range(chunk.count):
        frames, gap, ticks, length = [payload.varint() for _ in range(4)]
        require(1 <= frames <= 65536, "17.2.2", "frames of a group")
        groups.append(Group(frames, tick + gap, ticks, at, at + length, payload.number("Q")))
        tick, at = tick + gap + ticks, at + length
    require(payload.at == payload.end, "17.2.2", "bytes after the last group of the index")
    return timescale, groups, reader.at


def read_frame(reader, header, before):
    """17.3.2"""
    kind = reader.number("B")
    require(kind in (WHOLE, PREDICTED), "17.3.2", "kind of a frame")
    step, points = reader.varint(), reader.varint()
    require(step > 0 if before else step == 0, "17.3.2", "time of a frame")
    frame = Frame(kind, before.tick + step if before else 0, points, [], [])
    require(frame.tick < 1 << 32, "17.3.2", "time of a frame")
    for _ in header.voxels:
        frame.voxels.append(reader.varint())
        moved = reader.varint() if kind == PREDICTED else 0
        frame.lengths.append((moved, reader.varint(), reader.varint()))
    container.check_counts(replace(header, points=points, voxels=frame.voxels), "17.3.2")
    within = all(own <= most for own, most in zip([points, *frame.voxels], [header.points, *header.voxels]))
    require(within, "17.1.2", "more voxels than the header states")
    return frame


def read_group(data, group, header):
    """17.3: the frames of a group's bytes, and where the first one starts."""
    reader = Reader(data, "17.3.1")
    chunk = read_chunk(reader)
    fits = (chunk.kind, chunk.level, chunk.slice, chunk.count) == (FRAME_TABLE, 0, 0, group.frames)
    require(fits, "17.3.1", "frame table")
    payload, frames = Reader(chunk.payload, "17.3.2"), []
    for _ in range(group.frames):
        frames.append(read_frame(payload, header, frames[-1] if frames else None))
    require(payload.at == payload.end, "17.3.2", "bytes after the last frame of the table")
    require(frames[0].kind == WHOLE and frames[-1].tick < group.ticks, "17.3.3", "first or last frame")
    length = sum(sum(lengths) for frame in frames for lengths in frame.lengths)
    require(reader.at + length == len(data), "17.3.4", "length of a group")
    return frames, reader.at


class Sequence:
    """A sequence. `stream` makes a decoder of a frame."""

    def __init__(self, data, stream):
        self.header = container.parse_header(data, CRITICAL_FLAG)
        require(not any(map(any, self.header.sections)), "17.1.2", "lengths of sections")
        self.timescale, self.groups, at = read_index(data, self.header)
        self.rest = data[at:]
        self.stream = stream

    def frames(self):
        """The tick of each frame and its decoder, which must decode all levels before the next frame is asked for."""
        for group in self.groups:
            part = self.rest[group.start : group.end]
            require(len(part) == group.end - group.start, "17.2.3", "group beyond the end of the sequence")
            require(xxh3_64(part) == group.hash, "17.2.3", "hash of a group")
            frames, at = read_group(part, group, self.header)
            decoder = None
            for frame in frames:
                decoder = self.frame(frame, part[at:], decoder)
                yield group.first + frame.tick, decoder
                at += sum(map(sum, frame.lengths))
        require(len(self.rest) == self.groups[-1].end, "17.1.1", "bytes after the last group")

    def frame(self, frame, data, before):
        """17.4: the decoder of a frame whose bytes these start with."""
        motion, body, at = [], b"", 0
        for moved, *sections in frame.lengths:
            motion.append(data[at : at + moved])
            body += data[at + moved : at + moved + sum(sections)]
            at += moved + sum(sections)
        sections = [lengths[1:] for lengths in frame.lengths]
        header = replace(self.header, points=frame.points, voxels=frame.voxels, sections=sections, length=0)
        if frame.kind == WHOLE:
            return self.stream(body, header)
        known = [Known(voxels, coloured.values) for voxels, coloured in zip(before.levels, before.coloured)]
        return self.stream(body, header, Motion(motion, header, known), before.shown)
