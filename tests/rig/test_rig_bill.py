"""The bill of materials: complete, and the same in code, on the page and in the files."""

import csv
import io
import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from tests import ROOT

pytest.importorskip(
    "manifold3d", reason="the rig's parts need manifold3d: pip install 'amiwarp[rig]'"
)
pytest.importorskip("trimesh", reason="the rig's parts need trimesh: pip install 'amiwarp[rig]'")

from rig import bill, gimbal, numbers, page, parts, wires
from rig.parts import Rig


@pytest.fixture(scope="module", params=gimbal.KINDS, ids=lambda rig: rig.name)
def rig(request: pytest.FixtureRequest) -> Rig:
    return request.param


def listed(rig: Rig) -> list[dict[str, str]]:
    """Return the rows of a rig's file."""
    return list(csv.DictReader(io.StringIO(bill.of_rig(rig))))


def test_each_part_has_its_row_and_number(rig: Rig) -> None:
    made = [part for part in numbers.assembly(rig) if part.kind != "screws"]
    rows = [row for row in listed(rig) if row["group"] == "mechanics" and row["number"]]
    assert [(int(row["number"]), row["part"]) for row in rows] == [
        (k, part.name) for k, part in enumerate(made, 1)
    ]
    for part, row in zip(made, rows, strict=True):
        assert (part.kind == "printed") is row["specification"].startswith("printed: ")
        if part.kind == "printed":
            volume = float(re.search(r"([\d.]+) cm³", row["specification"])[1])
            assert volume == pytest.approx(part.solid.volume() / 1e3, abs=0.06)


def test_screws_are_those_of_the_solids(rig: Rig) -> None:
    """Number, thread, length and head of the solids, and the sums of the list."""
    wanted: Counter[str] = Counter()
    for part in numbers.assembly(rig):
        if part.kind != "screws":
            continue
        count, size, kind = bill.screws_of(rig)[part.name]
        thread, length = (float(text) for text in size[1:].split("×"))
        each = part.solid.decompose()
        nuts = len(each) - count
        assert (
            nuts == (count if kind == "with nuts" else 1 if kind == "with nut" else 0) or nuts == 0
        ), part.name
        ends = np.array(max(each, key=lambda solid: solid.volume()).bounding_box()).reshape(2, 3)
        head = 0.0 if kind == "countersunk" else parts.HEADS[thread][1]
        sizes = sorted(ends[1] - ends[0])
        assert sizes[2] == pytest.approx(length + head, abs=0.15) or kind == "with nut", part.name
        wanted[f"screw {size}{' countersunk' if kind == 'countersunk' else ''}"] += count
    rows = [row for row in listed(rig) if row["part"].startswith("screw M")]
    found: Counter[str] = Counter()
    for row in rows:
        found[row["part"]] += int(row["quantity"])
    assert found == wanted


def test_numbers_of_the_specification_are_those_of_the_dimensions() -> None:
    """A wedge, a belt and bearings of other sizes are listed."""
    own = parts.for_wedge(parts.TWO_INCH, 38.1, teeth=None, belt=None)
    rows = {row["part"]: row for row in listed(own)}
    assert "⌀ 38.1 mm" in rows["wedge"]["specification"]
    assert rows["rear bearing"]["part number or example"].startswith("6810")
    assert f"{own.belt:g} mm" in rows["belt"]["specification"]
    assert "36.2 mm inside" in rows["O-ring"]["specification"]


@pytest.mark.parametrize("kind", wires.CONTROLLERS)
@pytest.mark.parametrize("drive", wires.DRIVES)
def test_electrical_parts_are_those_of_the_board(kind: str, drive: str) -> None:
    items = bill.electrics(kind, drive)
    refs: dict[str, str] = {}
    for item in items:
        for ref in re.findall(r"\b[RC]\d+\b", item.number):
            refs[ref] = item.part
            assert int(item.quantity) == item.number.count(",") + 1
    assert refs == {
        part.ref: part.what for part in wires.components(kind, drive) if part.ref[0] in "RC"
    }
    strips = next(item for item in items if item.part == "pin strips")
    pins = {
        part.ref: len(part.pins) for part in wires.components(kind, drive) if part.ref[0] == "J"
    }
    assert {
        ref: int(count) for ref, count in re.findall(r"(J\d) (\d+)", strips.specification)
    } == pins


def test_tables_of_the_page_are_up_to_date() -> None:
    """Else: python -m rig.page."""
    text = (ROOT / "docs" / "how-to" / "build-a-rig.md").read_text()
    made = re.findall(r"<!-- made: (.*) -->\n\|", text)
    assert sorted(made) == sorted(page.tables())
    assert page.updated(text) == text


def test_no_prices() -> None:
    for rig in gimbal.KINDS:
        assert not re.search(r"[€$£]|EUR|USD", bill.of_rig(rig))


@pytest.mark.parametrize("series", ["67", "68"])
def test_the_lens_of_the_list_is_free_of_vignetting(series: str) -> None:
    """Its shortest focal length is the one of these dimensions, and the example obeys it: 6806 narrows the view."""
    own = replace(parts.ONE_INCH, series=series)
    row = next(row for row in listed(own) if row["part"] == "lens")
    least = float(re.search(r"focal length at least ([\d.]+) mm", row["specification"])[1])
    example = float(re.search(r"([\d.]+) mm \(sees", row["part number or example"])[1])
    sensor = numbers.SENSORS["640×480, 9 µm"]
    assert least <= example
    assert (
        numbers.clear_of_stops(own, sensor, least)
        >= 0.0
        > numbers.clear_of_stops(own, sensor, least - 0.1)
    )
    assert {"67": 13.7, "68": 20.4}[series] == least


def test_page_and_list_name_one_apex() -> None:
    """Of the one-inch rig: its list, the command that makes it, and the command that records."""
    text = (ROOT / "docs" / "how-to" / "build-a-rig.md").read_text()
    apex = f"{parts.ONE_INCH.apex_deg:g}"
    assert f"--rig one-inch --apex-deg {apex} " in text
    assert set(re.findall(r"--nominal-apex-deg ([\d.]+)", text)) == {apex}
    row = next(row for row in listed(parts.ONE_INCH) if row["part"] == "wedge")
    assert (
        f"apex (angle between its faces) {apex}°, which deviates by 0.26°" in row["specification"]
    )
    assert "30 arcmin" in row["part number or example"]


def test_a_driver_that_pulls_vref_up_gets_no_second_resistor() -> None:
    for kind in wires.CONTROLLERS:
        rows = {item.number: item for item in bill.electrics(kind, "belt")}
        assert "**not with Pololu 4035**" in rows["R14"].specification
        assert any(
            "Pololu 4035" in item.example
            for item in bill.electrics(kind, "belt")
            if item.part == "motor driver"
        )
