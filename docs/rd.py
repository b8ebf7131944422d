"""Draws docs/rd.svg, rate against PSNR, from the table of measurements in README.md: python3 docs/rd.py"""

import re
from pathlib import Path

HERE = Path(__file__).parent
SERIES = {"b2p lite-low": "#c2410c", "b2p": "#1d4ed8", "TMC13": "#6b7280"}
WIDTH, HEIGHT, LEFT, TOP, GAP = 340, 240, 50, 40, 70


def points():
    """(object, series, level, bits per point, PSNR, foreground PSNR) of every row."""
    out, name = [], None
    for line in (HERE.parent / "README.md").read_text().splitlines():
        cells = [c.replace("*", "").strip() for c in line.strip("|").split("|")]
        level = re.search(r"(TMC13|b2p)( `lite-low`)? level (\d)", cells[0])
        if len(cells) != 6 or not level:
            continue
        if line.startswith("| **"):
            name = re.match(r"\| \*\*(.+?)\*\*", line)[1]
        series = level[1] + (" lite-low" if level[2] else "")
        out.append((name, series, int(level[3]), *map(float, cells[1:4])))
    return out


def panel(x0, y0, title, rows, value):
    rates, values = [r[3] for r in rows], [r[value] for r in rows]
    low, high = min(values) - 0.5, max(values) + 0.5
    x = lambda r: x0 + (r - 0.1) / 0.45 * WIDTH
    y = lambda v: y0 + HEIGHT - (v - low) / (high - low) * HEIGHT
    out = [f'<text x="{x0}" y="{y0 - 12}" font-weight="bold">{title}</text>',
           f'<rect x="{x0}" y="{y0}" width="{WIDTH}" height="{HEIGHT}" fill="none" stroke="#d1d5db"/>']
    for r in (0.1, 0.2, 0.3, 0.4, 0.5):
        out.append(f'<text x="{x(r)}" y="{y0 + HEIGHT + 16}" text-anchor="middle">{r}</text>')
    for v in range(int(low) + 1, int(high) + 1, 2):
        out.append(f'<path d="M{x0} {y(v):.1f}h{WIDTH}" stroke="#e5e7eb"/><text x="{x0 - 6}" y="{y(v) + 4:.1f}" text-anchor="end">{v}</text>')
    for series, colour in SERIES.items():
        own = sorted((r[3], r[value], r[2]) for r in rows if r[1] == series)
        path = "L".join(f"{x(r):.1f} {y(v):.1f}" for r, v, _ in own)
        out.append(f'<path d="M{path}" fill="none" stroke="{colour}" stroke-width="2"/>')
        out += [f'<circle cx="{x(r):.1f}" cy="{y(v):.1f}" r="4" fill="{colour}"/><text x="{x(r) + 6:.1f}" y="{y(v) + 14:.1f}" fill="{colour}">{level}</text>'
                for r, v, level in own]
    return out


def main():
    rows, body = points(), []
    objects = [n for n in dict.fromkeys(r[0] for r in rows) if any(r[0] == n and r[1] == "TMC13" for r in rows)]
    for column, name in enumerate(objects):
        own = [r for r in rows if r[0] == name]
        for line, (value, what) in enumerate(((4, "PSNR"), (5, "foreground PSNR"))):
            body += panel(LEFT + column * (WIDTH + GAP), TOP + line * (HEIGHT + GAP), f"{name}: {what}, dB", own, value)
    foot = TOP + 2 * (HEIGHT + GAP) - 6
    for i, (series, colour) in enumerate(SERIES.items()):
        body.append(f'<text x="{LEFT + 130 * i}" y="{foot}" fill="{colour}" font-weight="bold">{series}</text>')
    body.append(f'<text x="{LEFT + 400}" y="{foot}">bits per input point, geometry included; numbers are octree levels</text>')
    size = (LEFT + len(objects) * (WIDTH + GAP), foot + 14)
    svg = f'<svg xmlns="http://www.w3.org/2000/svg" width="{size[0]}" height="{size[1]}" font-family="sans-serif" font-size="12">'
    (HERE / "rd.svg").write_text(f'{svg}<rect width="100%" height="100%" fill="white"/>{"".join(body)}</svg>\n')


if __name__ == "__main__":
    main()
