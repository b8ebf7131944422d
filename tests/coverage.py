"""Line coverage by parts: tests/coverage.py LINES.lcov MISSED.txt, as `tests/coverage.sh` calls it.

Prints a table, and writes every line that no test reaches to MISSED.txt. Tests do not count as code.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
# What reads untrusted bytes, by the beginnings of paths.
PARTS = {
    "container": ["src/container/", "src/input.rs"],
    "entropy coders": ["src/coding/"],
    "geometry": ["src/geometry/codec/", "src/geometry/octree.rs", "src/geometry/voxels.rs"],
    "colours": ["src/colour/"],
    "latents and models": ["src/latents/", "src/layers/safetensors.rs", "src/gaussians/learned/load.rs", "src/gaussians/head_map.rs"],
    "decoder and `check`": ["src/decoder/"],
    "sequences": ["src/sequence/reader.rs", "src/sequence/decoder", "src/sequence/assembly.rs", "src/motion/payload.rs"],
    "scenes": ["src/scene/reader.rs", "src/scene/decoder.rs", "src/scene/arriving.rs", "src/scene/edit.rs"],
    "clouds": ["src/cloud/ply/", "src/cloud/raw.rs", "src/cloud/dialects.rs", "formats/src/clouds/", "formats/src/detect.rs"],
    "Gaussians": ["src/gaussians/ply", "formats/src/splats/", "formats/src/sidecar.rs"],
    "cameras": ["src/renderer/camera/files"],
}


def tests_of(source):
    """Numbers of the lines of `source` that belong to a `#[cfg(test)]` item at its margin."""
    inside, lines = False, set()
    for number, line in enumerate(source, 1):
        if re.match(r"#\[cfg\((all\()?test\b", line):
            inside = True
        if inside:
            lines.add(number)
            if line in ("}", "};") or re.match(r"(pub )?mod \w+;|use .*;", line):
                inside = False
    return lines


def main():
    found, name = {}, None
    for line in Path(sys.argv[1]).read_text().splitlines():
        key, _, value = line.partition(":")
        if key == "SF":
            path = Path(value)
            name = str(path.relative_to(ROOT)) if path.is_relative_to(ROOT) else None
        elif key == "DA" and name:
            number, count = value.split(",")[:2]
            lines = found.setdefault(name, {})
            lines[int(number)] = max(lines.get(int(number), 0), int(count))
    rows, missed = {part: [0, 0] for part in PARTS}, []
    for name, lines in sorted(found.items()):
        part = next((part for part, begins in PARTS.items() if name.startswith(tuple(begins))), None)
        if not part or re.search(r"tests?(\.rs|/)", name):
            continue
        source = (ROOT / name).read_text().splitlines()
        tests = tests_of(source)
        for number, count in sorted(lines.items()):
            if number not in tests:
                rows[part][0] += 1
                rows[part][1] += count > 0
                if count == 0:
                    missed.append(f"{name}:{number}: {source[number - 1].strip()}")
    rows["all"] = [sum(row[i] for row in rows.values()) for i in range(2)]
    print("| part | lines | reached |\n|---|---:|---:|")
    for part, (lines, reached) in rows.items():
        print(f"| {part} | {lines} | {100 * reached / max(lines, 1):.1f} % |")
    Path(sys.argv[2]).write_text("\n".join(missed) + "\n")


main()
