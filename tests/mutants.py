#!/usr/bin/env python3
"""Mutation testing: cargo-mutants lists places at which the container's parsers, the limits, the memory bounds and the
entropy coders can be changed; each is changed by itself, and the tests must notice.

    tests/mutants.py [--sample N] [--seed S] [--all-tests]      N mutants (64) chosen at random, 0 for all of them

A mutant is tried with the unit tests of these modules, compiled without optimisation: about 4 s to compile and 2 s to run
on one core. With --all-tests, what they leave is tried with the tests of the library that decode whole streams, too, which
takes minutes for each. Works on a copy of the last commit in target/mutants. Prints each result, then those that no test
noticed; target/mutants/results.txt has all of them. Installs cargo-mutants into target/tools.
"""

import argparse
import collections
import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
OUT = TARGET / "mutants"
TREE, BUILD = OUT / "tree", OUT / "build"
FILES = ["src/container/**", "src/coding/**", "src/limits.rs", "src/memory.rs", "src/decoder/memory.rs"]
UNIT = ["container::", "limits::", "memory::", "coding::", "decoder::", "input::", "error::", "motion::payload"]
WHOLE = ["hostile", "memory", "scenes", "sequences", "conformance"]
# The optimisation of all tests is that of the workspace. A failing property is not kept: it would help the next mutant.
QUICK = {"CARGO_PROFILE_DEV_DEBUG": "0", "CARGO_PROFILE_DEV_OPT_LEVEL": "0", "PROPTEST_DISABLE_FAILURE_PERSISTENCE": "1"}


def listed():
    tool = ROOT / "target/tools/bin/cargo-mutants"
    if not tool.exists():
        version = ["--version", "27.1.0", "--locked", "--root", str(ROOT / "target/tools")]
        subprocess.run(["cargo", "install", "cargo-mutants", *version], check=True)
    files = [argument for file in FILES for argument in ("-f", file)]
    command = [tool, "mutants", "-p", "b2p", "--list", "--json", *files]
    return json.loads(subprocess.run(command, cwd=TREE, check=True, capture_output=True, text=True).stdout)


def mutated(text, mutant):
    lines = text.splitlines(True)
    at = lambda place: sum(map(len, lines[: place["line"] - 1])) + place["column"] - 1
    return text[: at(mutant["span"]["start"])] + mutant["replacement"] + text[at(mutant["span"]["end"]) :]


def cargo(arguments, environment, limit=None):
    environment = {**os.environ, "CARGO_TARGET_DIR": str(BUILD), **environment}
    return subprocess.run(["cargo", "test", "-p", "b2p", *arguments], cwd=TREE, env=environment, capture_output=True, text=True, timeout=limit)


def tried(limit, all_tests):
    """What becomes of the tree as it is."""
    built = cargo(["--lib", "--no-run"], QUICK)
    if built.returncode:
        return "does not compile"
    program = built.stderr.strip().splitlines()[-1].split("(")[1].rstrip(")")
    try:
        environment = {**os.environ, **QUICK}
        if subprocess.run([program, *UNIT], cwd=TREE, env=environment, capture_output=True, timeout=limit).returncode:
            return "caught"
        tests = [argument for name in WHOLE for argument in ("--test", name)]
        if all_tests and cargo(tests, {}, 20 * limit).returncode:
            return "caught by whole streams"
    except subprocess.TimeoutExpired:
        return "caught: it does not end"
    return "missed"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--sample", type=int, default=64)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--all-tests", action="store_true")
    args = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    if not TREE.exists():
        subprocess.run(["git", "clone", "--quiet", "--shared", ROOT, TREE], check=True)
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()
    subprocess.run(["git", "fetch", "--quiet", ROOT, commit], cwd=TREE, check=True)
    subprocess.run(["git", "checkout", "--quiet", "--force", commit], cwd=TREE, check=True)
    mutants = listed()
    # In no order, so that what is done when it is stopped is a sample, too.
    chosen = random.Random(args.seed).sample(range(len(mutants)), min(args.sample or len(mutants), len(mutants)))
    if (found := tried(600, args.all_tests)) != "missed":
        sys.exit(f"without any change: {found}")
    counts, missed = collections.Counter(), []
    with open(OUT / "results.txt", "w") as results:
        for number in chosen:
            mutant, start = mutants[number], time.monotonic()
            file = TREE / mutant["file"]
            text = file.read_text()
            try:
                file.write_text(mutated(text, mutant))
                found = tried(120, args.all_tests)
            finally:
                file.write_text(text)
            counts[found] += 1
            if found == "missed":
                missed.append(mutant["name"])
            line = f"{found}\t{time.monotonic() - start:.0f} s\t{mutant['name']}"
            print(line, flush=True)
            print(line, file=results, flush=True)
    print(f"\n{len(chosen)} of {len(mutants)} mutants: " + ", ".join(f"{n} {what}" for what, n in counts.items()))
    print("\n".join(missed))


if __name__ == "__main__":
    main()
