#!/usr/bin/env python3
"""Checks of the documents: `check.py [links] [words] [size]`, all of them by default.

links  every relative link of a Markdown file leads to a file, and its anchor to a heading of it; links of the book stay
       within it, and its summary lists every chapter
words  the words of docs/avoided-words.txt occur in no tracked text file
size   the README has at most 150 lines; lines of all documents have at most 120 characters, tables, code and pictures aside
"""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BOOK = ROOT / "docs"
AVOIDED = "docs/avoided-words.txt"
# What may stand between the words of a phrase: the next line of a comment, or the underscores of a test's name.
BREAK = r"(?:_|\s+(?:(?:///|//!|//|#|\*|>)\s*)?)"
README_LINES, WIDTH = 150, 120
# Modules that implement no clause of the format.
NO_CLAUSE = {
    "src/colour/encode.rs",
    "src/colour/importance.rs",
    "src/gaussians/surfels/lanes.rs",
    "src/gaussians/surfels/passes.rs",
}


def tracked(*patterns):
    # In a container the checkout may belong to another user.
    command = ["git", "-c", f"safe.directory={ROOT}", "ls-files", "-z", "-co", "--exclude-standard", *patterns]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return [name for name in listed.stdout.decode().split("\0") if name and (ROOT / name).is_file()]


def anchors(text):
    """The anchors of a document's headings, as GitHub and mdBook make them."""
    seen = {}
    for heading in re.findall(r"^#{1,6}\s+(.*?)\s*#*$", without_code(text), re.M):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").lower()
        name = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        count = seen.get(name, 0)
        seen[name] = count + 1
        yield name if count == 0 else f"{name}-{count}"
    yield from re.findall(r'<a (?:id|name)="([^"]+)"', text)


def without_code(text):
    text = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    return re.sub(r"`[^`\n]*`", lambda code: code.group().replace("[", " ").replace("](", " "), text)


def links():
    for name in tracked("*.md"):
        path = ROOT / name
        text = path.read_text()
        for target in re.findall(r"\]\(([^)\s]+)\)", without_code(text)):
            if re.match(r"[a-z]+:", target):
                continue
            file, _, anchor = target.partition("#")
            to = (path.parent / file).resolve() if file else path
            if not to.exists():
                yield f"{name}: no file for {target}"
            elif path.parent == BOOK and not to.is_relative_to(BOOK):
                yield f"{name}: {target} leaves the book; name the file in code marks"
            elif anchor and to.suffix == ".md" and anchor not in set(anchors(to.read_text())):
                yield f"{name}: no heading for {target}"
    listed = set(re.findall(r"\]\(([\w-]+\.md)\)", (BOOK / "SUMMARY.md").read_text()))
    for chapter in sorted({path.name for path in BOOK.glob("*.md")} - listed - {"SUMMARY.md"}):
        yield f"docs/SUMMARY.md: lacks {chapter}"


def avoided():
    for line in (ROOT / AVOIDED).read_text().splitlines():
        if line and not line.startswith("#"):
            yield from line.split(" -> ")[0].split(", ")


def words():
    patterns = []
    for phrase in avoided():
        body = BREAK.join(re.escape(word) for word in phrase.split())
        code = re.search(r"[A-Z_.:*]", phrase)
        # Most files lack the longest word, and to look for it takes less time than the pattern does.
        longest = max(phrase.lower().split(), key=len)
        patterns.append((phrase, longest, re.compile(rf"(?<![^\W_]){body}(?![^\W_])", 0 if code else re.I)))
    for name in tracked():
        if name.startswith("fuzz/corpus/") or name.endswith((".lock", ".svg", ".json", ".txt")):
            continue
        try:
            text = (ROOT / name).read_text()
        except UnicodeDecodeError:
            continue
        lower = (name + text).lower()
        for phrase, longest, pattern in patterns:
            if longest not in lower:
                continue
            if pattern.search(name):
                yield f"{name}: its name has '{phrase}'"
            for found in pattern.finditer(text):
                yield f"{name}:{text.count(chr(10), 0, found.start()) + 1}: '{phrase}'"


def size():
    lines = len((ROOT / "README.md").read_text().splitlines())
    if lines > README_LINES:
        yield f"README.md: {lines} lines, at most {README_LINES}"
    for name in tracked("*.md"):
        code = False
        for number, line in enumerate((ROOT / name).read_text().splitlines(), 1):
            code ^= line.startswith("```")
            if len(line) > WIDTH and not code and not (line.lstrip().startswith("|") or line.startswith(("    ", "!["))):
                yield f"{name}:{number}: {len(line)} characters, at most {WIDTH}"


def clauses():
    """Clauses of the format that sources and documents cite, but that do not exist."""
    text = (BOOK / "format.md").read_text()
    known = set(re.findall(r"^#* ?(\d+(?:\.\d+)*) ", text, re.M))
    number = r"\d+(?:\.\d+)*"
    more = rf"(?:(?:,| and| to|–) ?{number})*"
    cited = re.compile(rf"\b(?:clauses? |format\.md`?,? (?:clauses? )?)({number}{more})", re.I)
    code = re.compile(r"(?:\.breaks\(|malformed\(|require\([^\n]*?, |Refused\(|clause: )\"(\d[\d.]*)\"")
    for name in tracked("*.rs", "*.py", "*.md"):
        if name.startswith("lab/"):
            continue
        text = (ROOT / name).read_text()
        # A citation may go on in the next line of a comment.
        plain = re.sub(r"\s*\n\s*(?:///|//!|//|#)?\s*", " ", text)
        found = [n for numbers in cited.findall(plain) for n in re.findall(number, numbers)]
        for clause in sorted({*found, *code.findall(text)} - known):
            yield f"{name}: docs/format.md has no clause {clause}"
    for folder in ("container", "geometry", "colour", "gaussians/surfels"):
        for path in sorted((ROOT / "src" / folder).rglob("*.rs")):
            name = path.relative_to(ROOT).as_posix()
            head = re.match(r"(?://!.*\n)*", path.read_text()).group().replace("\n//! ", " ")
            cites = re.search(r"format\.md`?,? (?:clauses? )?\d|clause \d", head)
            if "/tests" not in name and name not in NO_CLAUSE and not cites:
                yield f"{name}: its first comment names no clause of docs/format.md"


def main():
    checks = {"links": links, "words": words, "size": size, "clauses": clauses}
    asked = sys.argv[1:] or list(checks)
    if unknown := [name for name in asked if name not in checks]:
        sys.exit(f"no check {unknown[0]}; there are {', '.join(checks)}")
    faults = [fault for name in asked for fault in checks[name]()]
    print("\n".join(faults))
    if faults:
        sys.exit(f"documents: {len(faults)} faults")
    print(f"documents: {', '.join(asked)} hold")


main()
