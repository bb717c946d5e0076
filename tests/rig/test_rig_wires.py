"""Wiring and perfboard: the nets are those of the firmware's pins, and the plan connects them and nothing else."""

import csv
import io
import itertools
import re
import xml.etree.ElementTree as ElementTree
from collections import defaultdict

import pytest

from rig import perfboard, wires
from tests import ROOT

BOARDS = [(kind, drive) for kind in wires.CONTROLLERS for drive in wires.DRIVES]


def defined() -> dict[str, int]:
    """Return the pins of ``firmware/pins.h``."""
    text = (ROOT / "firmware" / "pins.h").read_text()
    return {name: int(number) for name, number in re.findall(r"#define (PIN_\w+) (\d+)", text)}


def test_gpios_are_those_of_the_firmware() -> None:
    """Every pin of the firmware but the LED on the board is in the list; only the measured voltage may be missing."""
    there = defined()
    listed = {signal.define: signal.gpio for signal in wires.SIGNALS}
    assert {name: listed[name] for name in there if name != "PIN_LED"} == {
        name: number for name, number in there.items() if name != "PIN_LED"
    }
    assert set(listed) - set(there) <= {"PIN_SUPPLY_ADC"}


def test_divider_is_that_of_the_firmware_if_it_names_one() -> None:
    text = (ROOT / "firmware" / "pins.h").read_text()
    values = re.findall(r"#define DIVIDER_(UPPER|LOWER) (\d+)u", text)
    ohm = {
        part.ref: part.what
        for part in wires.components("rp2040", "belt")
        if part.ref in ("R9", "R10")
    }
    for name, value in values:
        assert ohm[{"UPPER": "R9", "LOWER": "R10"}[name]] == f"{int(value) // 1000} kΩ"
    assert ohm == {"R9": "47 kΩ", "R10": "10 kΩ"}


def test_pins_of_the_mega_are_those_of_its_port() -> None:
    """As the comment at the head of ``avr/main.c`` lists them: port, and the number on the board."""
    text = " ".join((ROOT / "firmware" / "avr" / "main.c").read_text().split("*/")[0].split())
    for what, net in (
        (r"A on (P\w\d) \((\d+)\)", "A"),
        (r"B on (P\w\d) \((\d+)\)", "B"),
        (r"index on (P\w\d) \((\d+)\)", "INDEX"),
        (r"camera on (P\w\d) \((\d+)\)", "SYNC_IN"),
        (r"PWM of 27 kHz on (P\w\d) \((\d+)\)", "PWM"),
        (r"direction (P\w\d) \((\d+)\)", "DIRECTION"),
        (r"enable (P\w\d) \((\d+)\)", "ENABLE"),
        (r"fault (P\w\d) \((\d+)\)", "FAULT"),
        (r"pulse to the camera (P\w\d) \((\d+)\)", "TRIGGER"),
        (r"divided, (P\w\d) \((\d+)\)", "SUPPLY"),
    ):
        signal = next(each for each in wires.SIGNALS if each.net == net)
        assert re.search(what, text).groups() == (signal.port, signal.mega), net


def test_pins_of_the_pico_by_its_pattern() -> None:
    """GP0 is pin 1; four GPIOs share a ground between them, down the left side and up the right side to GP22."""
    for gpio in range(16):
        assert wires.PICO[f"GP{gpio}"] == 1 + gpio + (gpio + 2) // 4
    for gpio in range(16, 22):
        assert wires.PICO[f"GP{gpio}"] == 21 + gpio - 16 + (gpio - 16 + 2) // 4
    named = {
        "GP22": 29,
        "RUN": 30,
        "GP26": 31,
        "GP27": 32,
        "GP28": 34,
        "3V3": 36,
        "VSYS": 39,
        "VBUS": 40,
    }
    assert {name: wires.PICO[name] for name in named} == named
    assert not set(wires.PICO.values()) & {3, 8, 13, 18, 23, 28, 33, 38}
    assert set(wires.PICO_GROUND) <= {3, 8, 13, 18, 23, 28, 33, 38}


@pytest.mark.parametrize(("kind", "drive"), BOARDS)
def test_each_net_has_a_purpose(kind: str, drive: str) -> None:
    """Each signal of the controller ends at a connector, by a wire or a resistor, and the supplies reach all."""
    found = wires.nets(kind, drive)
    assert {"GND", "VIO", "VM"} <= set(found)
    assert any(ref == "U1" for ref, _ in found["VIO"])
    assert any(ref == "U1" for ref, _ in found["GND"])
    parts = {part.ref: part for part in wires.components(kind, drive)}
    for net, pins in found.items():
        refs = {ref for ref, _ in pins}
        through = {other for ref in refs if ref[0] == "R" for other in parts[ref].nets} - {net}
        reached = refs | {ref for other in through - {"GND", "VIO"} for ref, _ in found[other]}
        assert any(ref[0] == "J" for ref in reached), net
    for ref in ("J3", "J5", "J6", "J7"):
        assert "GND" in parts[ref].nets
    assert ("J2" in parts) is (kind == "rp2040")
    assert ("J1" in parts) is (kind == "avr" or drive == "belt")


@pytest.mark.parametrize("kind", wires.CONTROLLERS)
def test_dividers_and_the_led_keep_their_limits(kind: str) -> None:
    """9 V are high and 0 V low at the pin, also against its pull-up of 50 or 20 kΩ, and 15 V no danger to it.

    The LED gets the 20 mA at which the data sheet of the EE-SX1041 promises 0.5 mA, more than the pull-up needs.
    """
    ohm = {}
    for part in wires.components(kind, "belt"):
        if found := re.fullmatch(r"([\d.]+) (k?)Ω", part.what):
            ohm[part.ref] = float(found[1]) * (1e3 if found[2] else 1.0)
    level, high, low, pull = (3.3, 2.0, 0.8, 50e3) if kind == "rp2040" else (5.0, 3.0, 1.5, 20e3)
    ratio, weak = ohm["R8"] / (ohm["R7"] + ohm["R8"]), {"rp2040": 80e3, "avr": 50e3}[kind]
    source = ratio * ohm["R7"]
    lowest = 0.99 * ratio * 9
    assert lowest + (level - lowest) * source / (source + weak) > high
    assert 15 * ratio < level * 1.03
    assert level * ohm["R8"] / (ohm["R8"] + pull) < low
    assert 16 * ohm["R10"] / (ohm["R9"] + ohm["R10"]) < 3.3
    assert 20e-3 < (level - 1.2) / ohm["R6"] < 25e-3
    assert (level - low) / ohm["R3"] < 0.5e-3 / 1.4
    # R14 or the driver's board pulls up by 10 kΩ, never both
    limit = level * ohm["R13"] / (ohm["R13"] + ohm["R14"]) / (450e-6 * 2490)
    assert 0.8 < limit < 1.2
    both = level * ohm["R13"] / (ohm["R13"] + ohm["R14"] / 2) / (450e-6 * 2490)
    assert both > 1.3


# The board, as its lists say


def lists(kind: str, drive: str) -> tuple[list[dict[str, str]], list[list[str]]]:
    """Return the leads and the wires of a board, read from its CSV file."""
    first, second, _ = perfboard.as_csv(kind, drive).split("\n\n")
    return list(csv.DictReader(io.StringIO(first))), list(csv.reader(io.StringIO(second)))[1:]


def hole(text: str) -> tuple[int, int]:
    """Return column and row of a hole: A, ..., Z, AA, AB, ..."""
    letters, row = re.fullmatch(r"([A-Z]+)(\d+)", text).groups()
    column = 0
    for letter in letters:
        column = 26 * column + ord(letter) - 64
    return column, int(row)


@pytest.mark.parametrize(("kind", "drive"), BOARDS)
def test_every_lead_has_a_hole_of_its_own(kind: str, drive: str) -> None:
    leads, found = lists(kind, drive)
    places = [hole(lead["hole"]) for lead in leads]
    assert len(set(places)) == len(places)
    assert all(1 <= column <= 31 and 1 <= row <= 26 for column, row in places)
    # wires on a rail have a place each, too
    on_rail = [hole(wire[5]) for wire in found if wire[4].startswith("rail") and wire[0] != "bare"]
    on_rail += [hole(end) for wire in found if wire[0] == "bare" for end in (wire[3], wire[5])]
    assert len(set(on_rail)) == len(on_rail)
    rails = {hole(wire[3])[1] for wire in found if wire[0] == "bare"}
    assert not rails & {row for _, row in places}
    assert len(rails) == 2


@pytest.mark.parametrize(("kind", "drive"), BOARDS)
def test_the_plan_connects_each_net_of_the_wiring_and_no_two(kind: str, drive: str) -> None:
    """Walk from hole to hole over wires and rails: what can be reached is exactly one net of the list."""
    leads, found = lists(kind, drive)
    beside: dict[tuple[int, int], set[tuple[int, int]]] = defaultdict(set)
    for wire in found:
        one, other = hole(wire[3]), hole(wire[5])
        if wire[0] == "bare":
            row = [(column, one[1]) for column in range(one[0], other[0] + 1)]
            for a, b in itertools.pairwise(row):
                beside[a].add(b)
                beside[b].add(a)
        else:
            beside[one].add(other)
            beside[other].add(one)
    at = {hole(lead["hole"]): (lead["part"], lead["pin"]) for lead in leads}
    seen: set[tuple[int, int]] = set()
    groups = []
    for start in at:
        if start in seen:
            continue
        waiting, group = [start], set()
        while waiting:
            place = waiting.pop()
            if place in group:
                continue
            group.add(place)
            waiting += beside[place]
        seen |= group
        groups.append(frozenset(at[place] for place in group if place in at))
    wanted = {frozenset(pins) for pins in wires.nets(kind, drive).values()}
    assert {group for group in groups if len(group) > 1} == wanted


def test_the_pico_fits_its_holes() -> None:
    """Two rows of 20 pins, 17.78 mm apart; pin 1 is opposite pin 40, and pin 20 opposite pin 21."""
    leads, _ = lists("rp2040", "belt")
    at = {int(lead["pin"].split()[0]): hole(lead["hole"]) for lead in leads if lead["part"] == "U1"}
    for pin in range(1, 21):
        (left, up), (right, across) = at[pin], at[41 - pin]
        assert right - left == 7
        assert up == across == at[1][1] + pin - 1


def test_two_leads_are_as_far_apart_as_the_parts_need() -> None:
    """Resistors of 0207 size need 10.16 mm, ceramic capacitors 5.08 mm."""
    leads, _ = lists("rp2040", "belt")
    ends = defaultdict(list)
    for lead in leads:
        ends[lead["part"]].append(hole(lead["hole"]))
    for ref, places in ends.items():
        if ref[0] in "RC":
            (a, b), (c, d) = places
            assert abs(a - c) + abs(b - d) == {"R": 4, "C": 2}[ref[0]], ref


@pytest.mark.parametrize(("kind", "drive"), BOARDS)
def test_the_drawing_shows_each_lead_in_its_hole(kind: str, drive: str) -> None:
    space = "{http://www.w3.org/2000/svg}"
    picture = ElementTree.fromstring(perfboard.drawing(kind, drive))
    drawn = {
        (
            (float(each.attrib["cx"]) - 60) / 26 + 1,
            (float(each.attrib["cy"]) - 60) / 26 + 1,
            each.attrib["data-net"],
        )
        for each in picture.iter(f"{space}circle")
        if "data-net" in each.attrib
    }
    leads, found = lists(kind, drive)
    assert drawn == {(*map(float, hole(lead["hole"])), lead["net"]) for lead in leads}
    numbers = {text.text for text in picture.iter(f"{space}text")}
    assert {wire[0] for wire in found if wire[0] != "bare"} <= numbers
    # no wire passes through a lead of another net
    for path in picture.iter(f"{space}path"):
        points = [
            tuple(map(float, pair.split()))
            for pair in re.findall(r"[\d.]+ [\d.]+", path.attrib["d"])
        ]
        if len(points) < 3:
            continue
        ends = {tuple((round((v - 60) / 26 + 1)) for v in points[k]) for k in (0, -1)}
        for lead in leads:
            place = hole(lead["hole"])
            if place not in ends:
                x, y = (60 + 26 * (v - 1) for v in place)
                assert min((x - a) ** 2 + (y - b) ** 2 for a, b in points) > 6.0**2, (
                    path.attrib,
                    lead,
                )


@pytest.mark.parametrize(("kind", "drive"), BOARDS)
def test_what_is_left_out_takes_its_wires_along_and_parts_no_net(kind: str, drive: str) -> None:
    """Without these wires, what stays is connected as before."""
    _, _, third = perfboard.as_csv(kind, drive).split("\n\n")
    _, found = lists(kind, drive)
    rows = list(csv.reader(io.StringIO(third)))[1:]
    assert {row[0] for row in rows} >= {"J8"}
    assert ("R14" in {row[0] for row in rows}) is (drive == "belt")
    for what, _, numbers in rows:
        gone = set(what.split(", "))
        cut = set(numbers.split(", "))
        ends = {
            wire[0]: {wire[2].split(".")[0], wire[4].split(".")[0]}
            for wire in found
            if wire[0] != "bare"
        }
        assert cut == {number for number, refs in ends.items() if refs & gone}
        beside: dict[str, set[str]] = defaultdict(set)
        for wire in found:
            if wire[0] != "bare" and wire[0] not in cut:
                one, other = (
                    f"rail {wire[1]}" if pin == "rail" else pin for pin in (wire[2], wire[4])
                )
                beside[one].add(other)
                beside[other].add(one)
        for net, pins in wires.nets(kind, drive).items():
            stay = {f"{ref}.{pin}" for ref, pin in pins if ref not in gone}
            if len(stay) < 2:
                continue
            reached: set[str] = set()
            waiting = [min(stay)]
            while waiting:
                pin = waiting.pop()
                if pin not in reached:
                    reached.add(pin)
                    waiting += beside[pin]
            assert stay <= reached, (what, net)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(("kind", "drive"), BOARDS)
def test_no_words_of_the_drawing_overlap(kind: str, drive: str, mirrored: bool) -> None:
    """Words on the board, by a width of 0.55 of their size for each letter."""
    picture = ElementTree.fromstring(perfboard.drawing(kind, drive, mirrored))
    boxes = []
    for text in picture.iter("{http://www.w3.org/2000/svg}text"):
        if "paint-order" not in text.attrib:
            continue
        x, y, size = (float(text.attrib[name]) for name in ("x", "y", "font-size"))
        wide = 0.55 * size * len(text.text)
        start = {"start": 0.0, "middle": -wide / 2, "end": -wide}[text.attrib["text-anchor"]]
        if "transform" in text.attrib:
            boxes.append((x - 0.7 * size, y - start - wide, x, y - start, text.text))
        else:
            boxes.append((x + start, y - 0.7 * size, x + start + wide, y, text.text))
    assert len(boxes) > 80
    for (a, b, c, d, one), (e, f, g, h, other) in itertools.combinations(boxes, 2):
        assert not (a < g and e < c and b < h and f < d), (one, other)


@pytest.mark.parametrize(("kind", "drive"), BOARDS)
def test_each_net_has_a_colour_of_its_own(kind: str, drive: str) -> None:
    picture = ElementTree.fromstring(perfboard.drawing(kind, drive))
    colours = defaultdict(set)
    for each in picture.iter("{http://www.w3.org/2000/svg}circle"):
        if "data-net" in each.attrib:
            colours[each.attrib["data-net"]].add(each.attrib["fill"])
    assert all(len(found) == 1 for found in colours.values())
    assert len(set().union(*colours.values())) == len(colours)


@pytest.mark.parametrize(("kind", "drive"), BOARDS)
def test_the_solder_side_is_the_mirror_image(kind: str, drive: str) -> None:
    def leads_of(mirrored: bool) -> set[tuple[float, str, str]]:
        picture = ElementTree.fromstring(perfboard.drawing(kind, drive, mirrored))
        circles = [each.attrib for each in picture.iter("{http://www.w3.org/2000/svg}circle")]
        return {
            (float(each["cx"]), each["cy"], each["data-net"])
            for each in circles
            if "data-net" in each
        }

    right = 60 + 26 * 30
    assert leads_of(True) == {(60 + right - x, y, net) for x, y, net in leads_of(False)}
    assert "left and right exchanged" in perfboard.drawing(kind, drive, mirrored=True)


@pytest.mark.parametrize(("kind", "drive"), BOARDS)
def test_pictures_of_the_page_are_those_of_the_code(kind: str, drive: str) -> None:
    folder = ROOT / "docs" / "images"
    assert (folder / f"board_{kind}_{drive}.svg").read_text() == perfboard.drawing(kind, drive)
    solder = (folder / f"board_{kind}_{drive}_solder.svg").read_text()
    assert solder == perfboard.drawing(kind, drive, mirrored=True)
    assert (folder / f"board_{kind}_{drive}.csv").read_text() == perfboard.as_csv(kind, drive)
    assert (folder / "wires.csv").read_text() == wires.as_csv()


def table(head: str) -> set[tuple[str, ...]]:
    """Return the rows of a table of the page that begins with a head."""
    page = (ROOT / "docs" / "how-to" / "build-a-rig.md").read_text()
    lines = page[page.index(head) :].split("\n\n")[0].splitlines()[2:]
    return {tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines}


def test_tables_of_the_page_are_those_of_the_list() -> None:
    assert table("| net | pin of the Pico") == set(wires.controller_rows())
    assert table("| connector | pin | net") == set(wires.connector_rows())
    assert table("| from | to, belt") == set(wires.POWER)
