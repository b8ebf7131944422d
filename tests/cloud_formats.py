"""LAS, LAZ and E57 files of b2p read by laspy and pye57, and theirs read by b2p. Run by tests/cloud_formats.sh."""

import subprocess
import sys
import tempfile
from pathlib import Path

import laspy
import numpy as np
import pye57

PROGRAM = sys.argv[1]
COUNT = 5000
WKT = 'PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],' \
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],UNIT["metre",1]]'


def b2p(*arguments):
    done = subprocess.run([PROGRAM, "-q", "-f", *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, f"b2p {arguments}: {done.stderr}"
    return done.stdout


def cloud():
    """Millimetres at a place like those of UTM, and colours."""
    random = np.random.default_rng(5)
    steps = random.integers(0, 2_000_000, size=(COUNT, 3))
    places = np.array([500_000.0, 4_649_000.0, 100.0]) + steps * 0.001
    return places, random.integers(0, 256, size=(COUNT, 3), dtype=np.uint8)


def write_ply(path, places, colours):
    rows = np.empty(COUNT, dtype=[("xyz", "<f8", 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = places, colours
    names = "".join(f"property double {axis}\n" for axis in "xyz")
    names += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    told = f"comment up z\ncomment metres_per_unit 1\ncomment crs {WKT}\n"
    header = f"ply\nformat binary_little_endian 1.0\n{told}element vertex {COUNT}\n{names}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())


def read_ply(path):
    header, rows = path.read_bytes().split(b"end_header\n", 1)
    assert b"property double x" in header, header
    rows = np.frombuffer(rows, dtype=[("xyz", "<f8", 3), ("rgb", "u1", 3)])
    return header.decode(), rows["xyz"], rows["rgb"]


def check(what, places, colours, found_places, found_colours, most=1e-6):
    assert len(found_places) == COUNT, f"{what}: {len(found_places)} points"
    error = np.abs(np.asarray(found_places) - places).max()
    assert error <= most, f"{what}: places differ by {error}"
    assert (np.asarray(found_colours) == colours).all(), f"{what}: colours differ"
    print(f"{what}: {COUNT} points, places within {error:.1e}")


def las(folder, source, places, colours):
    for ending in ("las", "laz"):
        ours = folder / f"ours.{ending}"
        b2p("convert", source, ours)
        with laspy.open(ours) as file:
            found = file.read()
        rgb = np.stack([found.red, found.green, found.blue], axis=1)
        assert (rgb % 257 == 0).all(), "colours fill 16 bits"
        assert str(found.header.version) == "1.4" and found.header.global_encoding.wkt
        crs = [vlr for vlr in found.header.vlrs if vlr.record_id == 2112]
        assert len(crs) == 1 and crs[0].string.rstrip("\0") == WKT, crs
        assert np.allclose(found.header.mins, places.min(axis=0), atol=1e-6)
        check(f"{ending} of b2p in laspy", places, colours, found.xyz, rgb // 257)
        for version, point_format in (("1.2", 3), ("1.4", 7)):
            header = laspy.LasHeader(version=version, point_format=point_format)
            header.scales, header.offsets = [0.001] * 3, np.floor(places.min(axis=0))
            theirs = laspy.LasData(header)
            theirs.x, theirs.y, theirs.z = places.T
            theirs.red, theirs.green, theirs.blue = colours.T.astype(np.uint16) * 257
            theirs.write(folder / f"theirs.{ending}")
            b2p("convert", folder / f"theirs.{ending}", folder / "back.ply")
            _, found_places, rgb = read_ply(folder / "back.ply")
            check(f"{ending} {version} of laspy in b2p", places, colours, found_places, rgb)


def e57(folder, source, places, colours):
    b2p("convert", source, folder / "ours.e57")
    file = pye57.E57(str(folder / "ours.e57"))
    found = file.read_scan(0, colors=True, ignore_missing_fields=True)
    xyz = np.stack([found[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    rgb = np.stack([found[f"color{name}"] for name in ("Red", "Green", "Blue")], axis=1)
    assert file.scan_count == 1
    assert file.root["coordinateMetadata"].value() == WKT
    check("e57 of b2p in pye57", places, colours, xyz, rgb, 0.0)
    file.close()
    path = folder / "theirs.e57"
    theirs = pye57.E57(str(path), mode="w")
    # It writes single precision, which resolves no millimetres at places like those of UTM.
    near = places - np.floor(places.min(axis=0))
    data = {f"cartesian{axis}": near[:, k].copy() for k, axis in enumerate("XYZ")}
    data |= {f"color{name}": colours[:, k].copy() for k, name in enumerate(("Red", "Green", "Blue"))}
    # A pose: a quarter turn about z, and a shift.
    half = np.sqrt(0.5)
    theirs.write_scan_raw(data, rotation=np.array([half, 0, 0, half]), translation=np.array([10.0, 20.0, 30.0]))
    theirs.close()
    b2p("convert", path, folder / "back.ply")
    _, found_places, rgb = read_ply(folder / "back.ply")
    turned = np.stack([10 - near[:, 1], 20 + near[:, 0], 30 + near[:, 2]], axis=1)
    check("e57 of pye57 in b2p", turned, colours, found_places, rgb, 2e-4)


def main():
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        places, colours = cloud()
        source = folder / "source.ply"
        write_ply(source, places, colours)
        las(folder, source, places, colours)
        e57(folder, source, places, colours)


if __name__ == "__main__":
    main()
