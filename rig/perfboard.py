"""Perfboard plan of the controller's board, made from the nets of :mod:`rig.wires`.

Holes are 2.54 mm apart, columns are A, B, C, ... from the left and rows 1, 2, 3, ... from the top, seen from the side
of the parts. Each lead has a hole of its own. Two bare wires on the solder side are rails, for ground and for the level
of the logic. All other wires are insulated, run on the solder side, and are soldered to the leads at both ends.
"""

import colorsys
import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from rig import wires
from rig.wires import GND, V5, VIO, VM, Component

COLUMNS, ROWS = 31, 26
"""Holes of a board of 9 x 7 cm as it is sold."""
Hole = tuple[int, int]
"""Column and row, from 1."""

RAILS = {VIO: 1, GND: 24}
"""Rows of the rails, which reach from the first column to the last; their wires end between, so each hole holds one."""
PICO_AT, PICO_WIDE = (16, 3), 7
"""Hole of the Pico's pin 1, and distance of its two rows of pins [holes]: 17.78 mm."""

STRIPS: dict[str, tuple[Hole, Hole]] = {
    "J4": ((2, 3), (0, 1)),
    "J1": ((2, 8), (0, 1)),
    "J3": ((2, 13), (0, 1)),
    "J6": ((2, 18), (0, 1)),
    "J5": ((4, 26), (1, 0)),
    "J7": ((14, 26), (1, 0)),
    "J8": ((29, 3), (0, 1)),
    "J2": ((29, 15), (0, 1)),
}
"""First hole of each connector, and the step to the next."""
LEADS: dict[str, tuple[Hole, Hole]] = {
    "R1": ((6, 3), (10, 3)),
    "R2": ((6, 5), (10, 5)),
    "R3": ((6, 7), (10, 7)),
    "R6": ((6, 9), (10, 9)),
    "R5": ((6, 11), (10, 11)),
    "R11": ((6, 13), (10, 13)),
    "R12": ((6, 15), (10, 15)),
    "R4": ((6, 17), (10, 17)),
    "R14": ((6, 19), (10, 19)),
    "R13": ((6, 21), (10, 21)),
    "R7": ((6, 23), (10, 23)),
    "R8": ((12, 23), (12, 19)),
    "R9": ((25, 23), (25, 19)),
    "R10": ((27, 19), (27, 23)),
    "C1": ((25, 6), (27, 6)),
    "C2": ((25, 16), (25, 14)),
}
"""Holes of the two leads of each resistor and capacitor."""


@dataclass(frozen=True)
class Lead:
    """A lead in its hole; of a rail, a place on it."""

    ref: str
    pin: str
    net: str
    hole: Hole


def holes_of(part: Component, kind: str) -> list[Hole]:
    """Return the holes of a part's pins."""
    if part.ref == "U1":
        column, row = PICO_AT
        if kind == "avr":
            return [(column, row + k) for k in range(len(part.pins))]
        left = [(column, row + k) for k in range(20)]
        right = [(column + PICO_WIDE, row + 19 - k) for k in range(20)]
        return left + right
    if part.ref in STRIPS:
        (column, row), (across, down) = STRIPS[part.ref]
        return [(column + k * across, row + k * down) for k in range(len(part.pins))]
    return list(LEADS[part.ref])


def leads(kind: str, drive: str) -> list[Lead]:
    """Return all leads; those that meet no other have no net."""
    out = []
    joined = wires.nets(kind, drive)
    for part in wires.components(kind, drive):
        for pin, net, hole in zip(part.pins, part.nets, holes_of(part, kind), strict=True):
            out.append(Lead(part.ref, pin, net if net in joined else "", hole))
    return out


def rail(net: str) -> list[Lead]:
    """Return the places on a rail for wires: all but its ends, where the bare wire itself is soldered."""
    return [
        Lead(f"rail {net}", str(column), net, (column, RAILS[net])) for column in range(2, COLUMNS)
    ]


def far(one: Hole, other: Hole) -> float:
    """Return the squared distance of two holes."""
    return (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2


def links(kind: str, drive: str) -> list[tuple[Lead, Lead]]:
    """Return the insulated wires: for each net a tree, which grows by the shortest wire to what is connected already.

    On a rail, each place takes one wire.
    """
    out = []
    by_net: dict[str, list[Lead]] = {}
    for lead in leads(kind, drive):
        if lead.net:
            by_net.setdefault(lead.net, []).append(lead)
    for net, members in by_net.items():
        places = rail(net) if net in RAILS else []
        done = list(places) or members[:1]
        left = members if places else members[1:]
        while left:
            pairs = ((far(a.hole, b.hole), a.hole, b.hole, a, b) for a in done for b in left)
            *_, old, new = min(pairs, key=lambda pair: pair[:3])
            out.append((old, new))
            left = [lead for lead in left if lead is not new]
            done = [lead for lead in done if lead is not old or old not in places]
            if not places:
                done.append(new)
    return out


def name(hole: Hole) -> str:
    """Return a hole as text: column in letters, and row."""
    column, row = hole
    letters = chr(64 + column) if column <= 26 else "A" + chr(38 + column)
    return f"{letters}{row}"


def wire_rows(kind: str, drive: str) -> list[tuple[str, ...]]:
    """Return number, net, and both ends of each wire, with their holes."""
    out = [
        ("bare", net, "rail", name((1, row)), "rail", name((COLUMNS, row)))
        for net, row in RAILS.items()
    ]
    for number, (old, new) in enumerate(links(kind, drive), 1):
        start = "rail" if old.ref.startswith("rail") else f"{old.ref}.{old.pin}"
        out.append(
            (str(number), new.net, f"{new.ref}.{new.pin}", name(new.hole), start, name(old.hole))
        )
    return out


def touching(kind: str, drive: str, refs: Iterable[str]) -> list[int]:
    """Return the numbers of the wires that end at one of some parts: they go if the parts are left out."""
    parts = set(refs)
    return [
        number
        for number, ends in enumerate(links(kind, drive), 1)
        if parts & {lead.ref for lead in ends}
    ]


LEFT_OUT = (
    ("R14", "with Pololu 4035, or another board with a pull-up at VREF", ("R14",)),
    ("J1, R1, R2", "with a magnetic encoder on SPI", ("J1", "R1", "R2")),
    ("J2", "with an encoder at J1", ("J2",)),
    ("J4", "without a serial adapter", ("J4",)),
    ("J8", "if nothing needs 5 V", ("J8",)),
)
"""Parts that not every rig needs, when they are left out, and their names."""


def left_out_rows(kind: str, drive: str) -> list[tuple[str, str, str]]:
    """Return parts that may be left out, when, and the numbers of their wires."""
    there = {part.ref for part in wires.components(kind, drive)}
    out = []
    for what, when, refs in LEFT_OUT:
        if there.issuperset(refs):
            numbers = ", ".join(str(number) for number in touching(kind, drive, refs))
            out.append((what, when, numbers))
    return out


def as_csv(kind: str, drive: str) -> str:
    """Return where each lead goes, and all wires, as CSV."""
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n").writerow
    whats = {part.ref: part.what for part in wires.components(kind, drive)}
    write(("part", "what", "pin", "hole", "net"))
    for lead in leads(kind, drive):
        write((lead.ref, whats[lead.ref], lead.pin, name(lead.hole), lead.net))
    write(())
    write(("wire", "net", "from", "hole", "to", "hole"))
    for row in wire_rows(kind, drive):
        write(row)
    write(())
    write(("left out", "when", "and these wires"))
    for row in left_out_rows(kind, drive):
        write(row)
    return out.getvalue()


PITCH, EDGE = 26, 60
"""Distance of holes, and margin around the board, in the drawing [px]."""
COLOURS = {GND: "#222222", VIO: "#c0392b", V5: "#e67e22", VM: "#8e44ad"}
LETTER = 0.58
"""Width of a letter, relative to the size of its type."""


@dataclass(frozen=True)
class Text:
    """Words in the drawing [px]."""

    x: float
    y: float
    """Base line."""
    words: str
    anchor: str = "middle"
    size: float = 11.0
    look: str = 'font-weight="bold" stroke="#f7f0dc" stroke-width="2.5" paint-order="stroke"'
    upright: bool = False
    """Turned about its point, to be read from below to above."""

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Its rectangle: left, top, right, bottom."""
        wide = LETTER * self.size * len(self.words)
        start = {"start": 0.0, "middle": -wide / 2, "end": -wide}[self.anchor]
        if self.upright:
            return (
                self.x - 0.8 * self.size,
                self.y - start - wide,
                self.x + 0.2 * self.size,
                self.y - start,
            )
        return (
            self.x + start,
            self.y - 0.8 * self.size,
            self.x + start + wide,
            self.y + 0.2 * self.size,
        )

    def svg(self) -> str:
        """Return it as an element."""
        turn = f' transform="rotate(-90 {self.x:.1f} {self.y:.1f})"' if self.upright else ""
        return (
            f'<text x="{self.x:.1f}" y="{self.y:.1f}" text-anchor="{self.anchor}" font-size="{self.size:g}" '
            f"{self.look}{turn}>{escape(self.words)}</text>"
        )


def colours(kind: str, drive: str) -> dict[str, str]:
    """Return a colour of its own for each net: hues in equal steps, light and dark by turns."""
    order = sorted({lead.net for lead in leads(kind, drive)} - {"", *COLOURS})
    out = dict(COLOURS)
    for k, net in enumerate(order):
        lightness = (0.30, 0.42, 0.54)[k % 3]
        red, green, blue = colorsys.hls_to_rgb(k / len(order), lightness, 0.75)
        out[net] = f"#{round(255 * red):02x}{round(255 * green):02x}{round(255 * blue):02x}"
    return out


def at(hole: Hole, mirrored: bool = False) -> tuple[int, int]:
    """Return the middle of a hole in the drawing [px]; mirrored: seen from the solder side."""
    column = COLUMNS + 1 - hole[0] if mirrored else hole[0]
    return EDGE + (column - 1) * PITCH, EDGE + (hole[1] - 1) * PITCH


def drawing(kind: str, drive: str, mirrored: bool = False) -> str:
    """Return the plan as SVG, seen from the side of the parts, or mirrored as the solder side shows it."""
    wide, high = 2 * EDGE + (COLUMNS - 1) * PITCH, 2 * EDGE + (ROWS - 1) * PITCH
    whats = {part.ref: part.what for part in wires.components(kind, drive)}
    by_net = colours(kind, drive)
    title = f"{whats['U1']}, {'DC motor with belt' if drive == 'belt' else 'hollow-shaft motor'}"
    seen = (
        "solder side, left and right exchanged"
        if mirrored
        else "seen from the parts; wires lie on the other side"
    )
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {high}" font-family="sans-serif" font-size="11">',
        f"<title>Perfboard plan: {escape(title)}</title>",
        f'<rect width="{wide}" height="{high}" fill="#ffffff"/>',
        f'<rect x="{EDGE - 18}" y="{EDGE - 18}" width="{wide - 2 * EDGE + 36}" height="{high - 2 * EDGE + 36}" rx="4" '
        'fill="#f7f0dc" stroke="#b8a878"/>',
        f'<text x="{wide / 2}" y="16" text-anchor="middle" font-size="14" font-weight="bold">{escape(title)}: '
        f"{seen}</text>",
    ]
    for column in range(1, COLUMNS + 1):
        x, y = at((column, 1), mirrored)
        label = name((column, 1))[:-1]
        out.append(f'<text x="{x}" y="{y - 24}" text-anchor="middle" fill="#666">{label}</text>')
        out.append(
            f'<text x="{x}" y="{high - EDGE + 32}" text-anchor="middle" fill="#666">{label}</text>'
        )
    for row in range(1, ROWS + 1):
        x, y = at((1, row))
        out.append(f'<text x="{x - 24}" y="{y + 4}" text-anchor="end" fill="#666">{row}</text>')
        out.append(f'<text x="{wide - EDGE + 24}" y="{y + 4}" fill="#666">{row}</text>')
        out += [
            f'<circle cx="{x + k * PITCH}" cy="{y}" r="2.6" fill="#fff" stroke="#c9ba8c"/>'
            for k in range(COLUMNS)
        ]
    out += bodies(kind, drive, mirrored)
    for net, row in RAILS.items():
        (x, y), (end, _) = at((1, row)), at((COLUMNS, row))
        out.append(
            f'<path d="M{x} {y}H{end}" stroke="{COLOURS[net]}" stroke-width="5" opacity="0.45"/>'
        )
    texts = names(kind, drive, mirrored) + labels(kind, drive, mirrored)
    lines, numbers = wire_lines(kind, drive, mirrored, by_net, texts)
    out += lines
    for lead in leads(kind, drive):
        x, y = at(lead.hole, mirrored)
        fill = by_net[lead.net] if lead.net else "#ffffff"
        out.append(
            f'<circle cx="{x}" cy="{y}" r="5" fill="{fill}" stroke="#333" data-net="{lead.net}"/>'
        )
    out += [text.svg() for text in (*texts, *numbers)]
    return "\n".join([*out, "</svg>", ""])


def wire_lines(
    kind: str, drive: str, mirrored: bool, by_net: dict[str, str], texts: Sequence[Text]
) -> tuple[list[str], list[Text]]:
    """Return the insulated wires, bent so that they pass no lead of another net, and their numbers beside all words."""
    lines = []
    numbers: list[Text] = []
    taken = [at(lead.hole, mirrored) for lead in leads(kind, drive)]
    boxes = [text.box for text in texts]
    for number, (old, new) in enumerate(links(kind, drive), 1):
        foreign = [
            at(lead.hole, mirrored)
            for lead in leads(kind, drive)
            if lead.hole not in (old.hole, new.hole)
        ]
        bends = (0.0, 0.5, -0.5, 0.9, -0.9, 1.4, -1.4, 2.0, -2.0, 2.8, -2.8)
        paths = [
            curve(at(old.hole, mirrored), at(new.hole, mirrored), bend * PITCH) for bend in bends
        ]
        points = max(
            paths, key=lambda path: (min(gap(path, foreign), 0.42 * PITCH), -paths.index(path))
        )
        colour = by_net[new.net]
        line = "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
        lines.append(
            f'<path d="M{line}" stroke="{colour}" stroke-width="2.2" opacity="0.8" fill="none"/>'
        )
        look = f'fill="{colour}" stroke="#fff" stroke-width="2.5" paint-order="stroke"'
        places = [Text(x, y + 3.0, str(number), size=9.0, look=look) for x, y in points[2:-2]]
        best = max(places, key=lambda place: free(place, taken, boxes))
        numbers.append(best)
        boxes.append(best.box)
    return lines, numbers


def free(
    place: Text,
    points: Iterable[tuple[float, float]],
    boxes: Iterable[tuple[float, float, float, float]],
) -> float:
    """Return how far words are from leads and from other words [px], at most 8; negative if they overlap."""
    left, top, right, bottom = place.box
    least = 8.0
    for x, y in points:
        least = min(least, max(left - x, x - right, top - y, y - bottom) - 5.0)
    for a, b, c, d in boxes:
        least = min(least, max(left - c, a - right, top - d, b - bottom))
    return least


def curve(start: tuple[int, int], end: tuple[int, int], bend: float) -> list[tuple[float, float]]:
    """Return points on an arc between two points, whose middle is ``bend`` beside the straight line."""
    (x1, y1), (x2, y2) = start, end
    long = math.hypot(x2 - x1, y2 - y1)
    across = (y1 - y2) / long, (x2 - x1) / long
    out = []
    for k in range(25):
        t = k / 24
        side = bend * 4 * t * (1 - t)
        out.append((x1 + t * (x2 - x1) + side * across[0], y1 + t * (y2 - y1) + side * across[1]))
    return out


def gap(path: Iterable[tuple[float, float]], points: Iterable[tuple[float, float]]) -> float:
    """Return the smallest distance of a path's points from others [px]."""
    return min((math.dist(p, q) for p in path for q in points), default=math.inf)


def outline(part: Component, kind: str, mirrored: bool) -> tuple[float, float, float, float]:
    """Return the rectangle around the holes of a part: left, top, right, bottom."""
    points = [at(hole, mirrored) for hole in holes_of(part, kind)]
    across, down = zip(*points, strict=True)
    return min(across), min(down), max(across), max(down)


def bodies(kind: str, drive: str, mirrored: bool) -> list[str]:
    """Return the outlines of the parts; on the solder side they are pale."""
    out = []
    opacity = 0.3 if mirrored else 0.85
    for part in wires.components(kind, drive):
        x1, y1, x2, y2 = outline(part, kind, mirrored)
        pad = 7 if part.ref[0] in "RC" else 11
        fill = {"R": "#d8e6f3", "C": "#f3e3b8", "J": "#dddddd", "U": "#cfe8cf"}[part.ref[0]]
        out.append(
            f'<rect x="{x1 - pad}" y="{y1 - pad}" width="{x2 - x1 + 2 * pad}" height="{y2 - y1 + 2 * pad}" rx="4" '
            f'fill="{fill}" stroke="#555" opacity="{opacity}"/>'
        )
    return out


def names(kind: str, drive: str, mirrored: bool) -> list[Text]:
    """Return the names of the parts and of the rails."""
    out = []
    for part in wires.components(kind, drive):
        x1, y1, x2, y2 = outline(part, kind, mirrored)
        middle = (x1 + x2) / 2
        words = f"{part.ref} {part.what}"
        if part.ref[0] in "RC" and x1 == x2:
            beside = 16 if mirrored else -9  # away from the names of the strips
            out.append(Text(middle + beside, (y1 + y2) / 2, words, upright=True))
        elif part.ref[0] in "RC":
            out.append(Text(middle, y1 - 9, words))
        elif part.ref == "U1" and kind == "rp2040":
            out.append(Text(middle, y1 - 14, f"{part.what}, USB at this end"))
        elif y1 == y2:
            out.append(Text(middle, y1 - 30, words))
        elif x1 < at((COLUMNS // 2, 1))[0]:
            out.append(Text(x1 - 10, y1 - 14, words, "start"))
        else:
            out.append(Text(x2 + 10, y1 - 14, words, "end"))
    for net, row in RAILS.items():
        x, y = at((14, row), mirrored)
        out.append(Text(x, y - 6, f"{net} rail"))
    return out


def labels(kind: str, drive: str, mirrored: bool) -> list[Text]:
    """Return the names of the pins of controller and connectors."""
    out = []
    halo = 'stroke="#f7f0dc" stroke-width="2" paint-order="stroke"'
    for lead in leads(kind, drive):
        x, y = at(lead.hole, mirrored)
        if lead.ref[0] not in "UJ":
            continue
        if lead.ref in STRIPS and STRIPS[lead.ref][1] == (1, 0):
            out.append(Text(x, y - 13, lead.pin, size=9.0, look=halo))
            continue
        inside = lead.ref == "U1" and kind == "rp2040"
        right = lead.hole[0] > PICO_AT[0] or (lead.ref == "U1" and not inside)
        side = 9 if inside else 13
        if right is not mirrored:
            out.append(Text(x - side, y + 4, lead.pin, "end", 9.0, halo))
        else:
            out.append(Text(x + side, y + 4, lead.pin, "start", 9.0, halo))
    return out


def write(folder: Path) -> list[str]:
    """Write plans and lists of both controllers and both drives, and return the names of the files."""
    out = []
    for kind in wires.CONTROLLERS:
        for drive in wires.DRIVES:
            stem = f"board_{kind}_{drive}"
            (folder / f"{stem}.svg").write_text(drawing(kind, drive), encoding="utf-8")
            (folder / f"{stem}_solder.svg").write_text(
                drawing(kind, drive, mirrored=True), encoding="utf-8"
            )
            (folder / f"{stem}.csv").write_text(as_csv(kind, drive), encoding="utf-8")
            out += [f"{stem}.svg", f"{stem}_solder.svg", f"{stem}.csv"]
    (folder / "wires.csv").write_text(wires.as_csv(), encoding="utf-8")
    return [*out, "wires.csv"]
