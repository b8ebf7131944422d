"""Tables and the plot that docs/rd.py makes of its measurements."""

import math

PEER, VPCC = "TMC13", "V-PCC"
OBJECTS = {
    "person_Asian_F_3_Casual": "Asian_F_3",
    "person_Hispanic_M_3_Milit": "Hispanic_M_3",
    "tds_Penelope": "Penelope (statue)",
    "coffee_grinder": "Coffee grinder",
    "avocado": "Avocado *",
    "gso_frypan": "Frying pan *",
    "tds_Hermes": "Hermes (head) *",
}
SCORES = {"psnr": ("PSNR", 2), "foreground_psnr": ("foreground PSNR", 2), "ms_ssim": ("MS-SSIM", 4), "ssimulacra2": ("SSIMULACRA2", 1)}
OURS = ("best", "quick", "surfels")
# Streams of the highest effort, drawn by `best`.
REFINED = "effort-9"
LEARNED = ("lite", "lite-low", "lite-least")
# Mean differences are taken over these rates, and columns of the summary stand at these, in bits per input point.
LOW, HIGH = 0.03, 1.0
COLUMNS = (0.05, 0.1, 0.2, 0.4, 0.8)
# Untrained heads with TMC13's colours and our geometry: rate, PSNR, foreground PSNR, SSIMULACRA2 at levels 8 and 9.
HYBRID = {
    "person_Asian_F_3_Casual": [(0.082, 34.9, 26.4, 53), (0.247, 38.5, 29.7, 67)],
    "person_Hispanic_M_3_Milit": [(0.075, 35.7, 27.0, 57), (0.226, 39.0, 30.0, 72)],
    "tds_Penelope": [(0.069, 35.0, 29.0, 55), (0.186, 37.7, 31.7, 69)],
    "coffee_grinder": [(0.041, 33.1, 27.9, 34), (0.118, 36.3, 30.9, 53)],
    "avocado": [(0.036, 35.0, 31.8, 49), (0.104, 38.4, 34.9, 67)],
}
# How far those scores are rounded, at most.
ROUNDED = {"psnr": 0.05, "foreground_psnr": 0.05, "ssimulacra2": 0.5}
COLOURS = {"best": "#1d4ed8", "quick": "#0e7490", "surfels": "#7e22ce", "lite": "#15803d", PEER: "#6b7280", VPCC: "#c2410c"}


def of(rows, name, series):
    return [row for row in rows if row["object"] == name and row["series"] == series]


# ---------------------------------------------------------------------------------------------------------------------
# Curves of a score over the logarithm of the rate


def best_points(rows, score):
    """(log rate, score) of the points that no cheaper point equals: at one rate the best drawing counts."""
    out = []
    for x, y in sorted((math.log(row["rate"]), row[score]) for row in rows):
        if out and x == out[-1][0]:
            out.pop()
        if not out or y > out[-1][1]:
            out.append((x, y))
    return out


def envelope(rows, score):
    """The concave envelope: a better point never counts against whose it is."""
    out = []
    for x, y in best_points(rows, score):
        while len(out) > 1 and (out[-1][1] - out[-2][1]) * (x - out[-2][0]) <= (y - out[-2][1]) * (out[-1][0] - out[-2][0]):
            out.pop()
        out.append((x, y))
    return out


def at(curve, x):
    """A piecewise linear curve, x rising; beyond its end what its end is, before its start nothing."""
    if not curve or x < curve[0][0] - 1e-9:
        return None
    for (x0, y0), (x1, y1) in zip(curve, curve[1:]):
        if x <= x1:
            return y0 + (y1 - y0) * (x - x0) / (x1 - x0)
    return curve[-1][1]


def differences(ours, peers, score, steps=1000):
    """(mean, least) of ours less the peer's at equal rates, along envelopes and over the rates that both reach; None without any."""
    a, b = envelope(ours, score), envelope(peers, score)
    if not a or not b:
        return None
    low, high = max(a[0][0], b[0][0], math.log(LOW)), min(a[-1][0], b[-1][0], math.log(HIGH))
    if low >= high:
        return None
    places = [low + (high - low) * (i + 0.5) / steps for i in range(steps)]
    gains = [at(a, x) - at(b, x) for x in places]
    return sum(gains) / len(gains), min(gains)


def bits_ratio(ours, peers, score, steps=1000):
    """Our bits over the peer's at equal scores, the geometric mean over the scores that both reach."""
    a, b = ([(y, x) for x, y in envelope(rows, score)] for rows in (ours, peers))
    if not a or not b:
        return None
    low, high = max(a[0][0], b[0][0]), min(a[-1][0], b[-1][0])
    if low >= high:
        return None
    places = [low + (high - low) * (i + 0.5) / steps for i in range(steps)]
    return math.exp(sum(at(a, y) - at(b, y) for y in places) / steps)


# ---------------------------------------------------------------------------------------------------------------------
# Tables


def mean(values):
    values = [value for value in values if value is not None]
    return sum(values) / len(values) if values else None


def signed(value, digits):
    return "–" if value is None else f"{value:+.{digits}f}"


def gains(rows, series, peer):
    """A line for each object, and the mean: differences at equal rates, and bits at equal foreground PSNR."""
    heading = [f"`{series}` minus {peer}", *(title for title, _ in SCORES.values()), "bits ratio"]
    out, columns, ratios = [cells(heading), "|---|" + "---:|" * 5], {score: [] for score in SCORES}, []
    for name, title in OBJECTS.items():
        ours, peers, line = of(rows, name, series), of(rows, name, peer), [title]
        for score, (_, digits) in SCORES.items():
            both = differences(ours, peers, score)
            columns[score].append(both and both[0])
            line.append("–" if both is None else f"{signed(both[0], digits)} ({signed(both[1], digits)})")
        ratios.append(bits_ratio(ours, peers, "foreground_psnr"))
        out.append(cells([*line, "–" if ratios[-1] is None else f"{ratios[-1]:.2f}"]))
    means = [signed(mean(columns[score]), digits) for score, (_, digits) in SCORES.items()]
    logs = mean([ratio and math.log(ratio) for ratio in ratios])
    return [*out, cells(["**mean**", *means, "–" if logs is None else f"{math.exp(logs):.2f}"])]


def headline(rows, times):
    """Means over all objects of what each set of heads gains on the peer, and times."""
    columns = {"best": "`best`", REFINED: "`best`, `--effort 9`", "quick": "`quick`", "surfels": "`surfels`"}
    out = [cells([f"compared with {PEER}", *columns.values()]), "|---|" + "---:|" * len(columns)]
    ours = {who: [(of(rows, name, who), of(rows, name, PEER)) for name in OBJECTS] for who in columns}
    for score, (title, digits) in SCORES.items():
        unit = ", dB" if "psnr" in score else ""
        found = [[differences(*pair, score) for pair in pairs] for pairs in ours.values()]
        means = [signed(mean([both and both[0] for both in column]), digits) for column in found]
        out.append(cells([f"{title}{unit}", *means]))
    ratios = [[bits_ratio(*pair, "foreground_psnr") for pair in pairs] for pairs in ours.values()]
    logs = [mean([ratio and math.log(ratio) for ratio in column]) for column in ratios]
    out.append(cells(["bits at equal foreground PSNR", *("–" if log is None else f"× {math.exp(log):.2f}" for log in logs)]))
    out.append(cells(["time to encode", *(f"{times['encode_s'][who]} s" if who in times["encode_s"] else "" for who in columns)]))
    out.append(cells(["time to decode", *(f"{times['decode_ms'][who]} ms" if who in times["decode_ms"] else "" for who in columns)]))
    return [*out, cells(["time to draw 1024×1024 pixels", f"{times['draw_ms']} ms", *[""] * (len(columns) - 1)])]


def cells(parts):
    return "| " + " | ".join(parts) + " |"


def summary(rows, series):
    """Whole / foreground PSNR at a few rates, between measured points."""
    heading = [f"PSNR / foreground: `{series}`; {PEER}; {VPCC}", *(f"{rate} bits/point" for rate in COLUMNS)]
    out = [cells(heading), "|---|" + "---:|" * len(COLUMNS)]
    for name, title in OBJECTS.items():
        for who in (series, PEER, VPCC):
            own, line = of(rows, name, who), []
            for rate in COLUMNS:
                pair = [at(best_points(own, score), math.log(rate)) for score in ("psnr", "foreground_psnr")]
                line.append("–" if None in pair else f"{pair[0]:.2f} / {pair[1]:.2f}")
            out.append(cells([f"**{title}**, `{who}`" if who == series else who, *line]))
    return out


def every_point(rows):
    """All series' points; of a peer's drawings the best, score by score."""
    out = [cells(["", "bits/point", "level", *(title for title, _ in SCORES.values())]), "|---|" + "---:|" * (2 + len(SCORES))]
    order = ["best", REFINED, *OURS[1:], *LEARNED, PEER, VPCC]
    for name, title in OBJECTS.items():
        own = [row for row in rows if row["object"] == name and row["series"] in order]
        points = {}
        for row in sorted(own, key=lambda row: (order.index(row["series"]), row["rate"])):
            points.setdefault((row["series"], row["label"]), []).append(row)
        for i, ((series, label), drawn) in enumerate(points.items()):
            what = (f"**{title}**, " if i == 0 else "") + (f"{series} {label}" if series in (PEER, VPCC) else f"`{series}`")
            values = [f"{max(row[score] for row in drawn):.{digits}f}" for score, (_, digits) in SCORES.items()]
            out.append(cells([what, f"{drawn[0]['rate']:.4f}", str(drawn[0]["level"]), *values]))
    return out


def optional(rows, option, default, values):
    """`lite` to level 9 with the values of an encoder's option, the four held-out objects."""
    own = [row | {"option": row.get("option", default)} for row in rows if row["series"] in ("lite", f"lite-{option}") and row["level"] == 9]
    out = [cells(["bits/point: PSNR / foreground", *(f"`{value}`" for value in values)]), "|---|" + "---:|" * len(values)]
    for name, title in OBJECTS.items():
        found = {row["option"]: row for row in own if row["object"] == name}
        if set(values) <= set(found):
            line = [f"{r['rate']:.3f}: {r['psnr']:.2f} / {r['foreground_psnr']:.2f}" for r in map(found.get, values)]
            out.append(cells([title, *line]))
    return out


def shortfalls(rows):
    """Series by series, where a score is below TMC13's, the hybrid's or a learned model's at their rate, between our points."""
    out = {}
    for series in (*OURS, REFINED):
        if not any(row["series"] == series for row in rows):
            continue
        lines = out.setdefault(series, [])
        for name, title in OBJECTS.items():
            ours = of(rows, name, series)
            marks = [(who, row) for who in (PEER, *LEARNED) for row in of(rows, name, who)]
            marks += [("hybrid", dict(zip(("rate", *ROUNDED), values))) for values in HYBRID.get(name, ())]
            for score, (label, digits) in SCORES.items():
                best = {}
                for who, row in marks:
                    if score in row and LOW <= row["rate"] <= HIGH:
                        best[who, row["rate"]] = max(row[score], best.get((who, row["rate"]), -math.inf))
                curve = best_points(ours, score)
                for (who, rate), value in sorted(best.items()):
                    got = at(curve, math.log(rate))
                    slack = ROUNDED[score] if who == "hybrid" else 0.5 * 0.1**digits
                    if got is None or got < value - slack:
                        found = "–" if got is None else f"{got:.{digits}f}"
                        lines.append(f"{title}, {rate:.4f} bits/point, {label}: {found} against {value:.{digits}f} ({who})")
    return out


def tables(rows, times):
    """Lines by file and mark."""
    series = "best" if any(row["series"] == "best" for row in rows) else "lite"
    more = [line for who in (REFINED, *OURS[1:], *LEARNED) if any(row["series"] == who for row in rows) for line in (*gains(rows, who, PEER), "")]
    refined = ["", *gains(rows, REFINED, VPCC)] if any(row["series"] == REFINED for row in rows) else []
    short = shortfalls(rows)
    falls = [f"- `{series}`, {line}" for line in short.get(series, [])]
    falls += [f"- `{who}`: {len(lines)} scores, listed by `python3 docs/rd.py`." for who, lines in short.items() if who != series]
    prices, residuals = ("0", "0.5", "1", "2", "4"), ("none", "coarse", "96", "48", "24")
    return {
        "README.md": {"rd": headline(rows, times)},
        "docs/measurements.md": {
            "rd-summary": summary(rows, series),
            "rd-gains": [*gains(rows, series, PEER), "", *gains(rows, series, VPCC), "", *more[:-1], *refined],
            "rd-short": falls or ["None."],
            "rd-all": every_point(rows),
        },
        "docs/learned.md": {"rd-price": optional(rows, "price", "1", prices), "rd-residual": optional(rows, "residual", "coarse", residuals)},
    }


# ---------------------------------------------------------------------------------------------------------------------
# The plot


def panel(x0, y0, title, rows, score):
    """Our series as lines, the peers' envelopes too; rates on a logarithmic axis."""
    width, height = 250, 190
    rows = [row for row in rows if LOW * 0.9 <= row["rate"] <= HIGH * 1.1 and row["series"] in COLOURS]
    curves = {who: best_points([row for row in rows if row["series"] == who], score) for who in COLOURS}
    values = [y for curve in curves.values() for _, y in curve]
    low, high = min(values, default=0) - 0.5, max(values, default=0) + 0.5
    x = lambda v: x0 + (v - math.log(LOW * 0.9)) / math.log(HIGH * 1.1 / (LOW * 0.9)) * width
    y = lambda v: y0 + height - (v - low) / (high - low) * height
    out = [f'<text x="{x0}" y="{y0 - 8}" font-weight="bold">{title}</text>', f'<rect x="{x0}" y="{y0}" width="{width}" height="{height}" fill="none" stroke="#d1d5db"/>']
    out += [f'<text x="{x(math.log(r)):.1f}" y="{y0 + height + 14}" text-anchor="middle">{r}</text>' for r in (0.03, 0.1, 0.3, 1)]
    for v in range(math.ceil(low), math.floor(high) + 1, 3):
        out.append(f'<path d="M{x0} {y(v):.1f}h{width}" stroke="#e5e7eb"/><text x="{x0 - 5}" y="{y(v) + 4:.1f}" text-anchor="end">{v}</text>')
    for who, curve in curves.items():
        if curve:
            path = "L".join(f"{x(a):.1f} {y(b):.1f}" for a, b in curve)
            out.append(f'<path d="M{path}" fill="none" stroke="{COLOURS[who]}" stroke-width="1.5"/>')
            out += [f'<circle cx="{x(a):.1f}" cy="{y(b):.1f}" r="2.5" fill="{COLOURS[who]}"/>' for a, b in curve]
    return out


def plot(rows):
    """Whole and foreground PSNR of every object."""
    body, column, line = [], 300, 245
    for i, (name, title) in enumerate(OBJECTS.items()):
        own = [row for row in rows if row["object"] == name]
        for j, score in enumerate(("psnr", "foreground_psnr")):
            at_x, at_y = 40 + (i % 4) * column, 30 + (2 * (i // 4) + j) * line
            body += panel(at_x, at_y, f"{title}: {SCORES[score][0]}, dB", own, score)
    x, y = 40 + 3 * column, 30 + 2 * line
    shown = [who for who in COLOURS if any(row["series"] == who for row in rows)]
    body += [f'<text x="{x}" y="{y + 18 * i}" fill="{COLOURS[who]}" font-weight="bold">{who}</text>' for i, who in enumerate(shown)]
    notes = ("bits per input point, geometry included", "* of the training set", "peers: the best of their drawings")
    body += [f'<text x="{x}" y="{y + 18 * (len(shown) + 1 + i)}">{note}</text>' for i, note in enumerate(notes)]
    width, height = 4 * column + 20, 4 * line + 20
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif" font-size="11">'
    return f'{head}<rect width="100%" height="100%" fill="white"/>{"".join(body)}</svg>\n'
