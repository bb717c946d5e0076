"""The rig's printable parts, and the numbers that its pages state."""

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests import ROOT

pytest.importorskip(
    "manifold3d", reason="the rig's parts need manifold3d: pip install 'amiwarp[rig]'"
)
from manifold3d import Manifold

trimesh = pytest.importorskip(
    "trimesh", reason="the rig's parts need trimesh: pip install 'amiwarp[rig]'"
)

import amiwarp  # noqa: E402
from rig import __main__ as command  # noqa: E402
from rig import numbers, parts  # noqa: E402
from rig.parts import ONE_INCH, RIGS, TWO_INCH, Part, Rig  # noqa: E402

PAGE = (ROOT / "rig" / "numbers.md").read_text()


@pytest.fixture(scope="module", params=RIGS, ids=lambda rig: rig.name)
def rig(request: pytest.FixtureRequest) -> Rig:
    return request.param


assembled = functools.cache(parts.assembly)


@functools.cache
def wrong_with(rig: Rig) -> list[str]:
    return parts.problems(rig, assembled(rig))


@pytest.fixture(scope="module")
def made(rig: Rig) -> Sequence[Part]:
    return assembled(rig)


def test_parts_neither_overlap_nor_come_too_close(rig: Rig) -> None:
    assert wrong_with(rig) == []


def test_a_steeper_wedge_fits(rig: Rig) -> None:
    assert wrong_with(replace(rig, apex_deg=2.0)) == []


def test_wider_bearings_leave_room_for_a_wider_spring() -> None:
    """The way out that the page names for the one-inch rig: 6806, and a band of 3.3 mm."""
    own = replace(ONE_INCH, series="68")
    assert wrong_with(own) == []
    inner = own.bearing.inner + own.clearance
    assert (own.bearing.name, own.bearing.outer / 2 - 0.25 - inner > 3.3) == ("6806", True)


def test_an_overlap_a_narrow_gap_and_a_loose_piece_are_seen(made: Sequence[Part], rig: Rig) -> None:
    by_name = {part.name: part for part in made}
    turning, still = by_name["rear ring"], by_name["holder"]
    assert parts.problems(rig, [turning, still]) == []
    low = replace(turning, solid=turning.solid.translate((0, 0, -0.5)))
    assert parts.problems(rig, [low, still]) == [
        "rear ring and holder are 0.50 mm apart, less than 0.7 mm"
    ]
    lower = replace(turning, solid=turning.solid.translate((0, 0, -2.0)))
    assert any("overlap" in text for text in parts.problems(rig, [lower, still]))
    pieces = replace(still, solid=still.solid + still.solid.translate((0, 0, 50)))
    assert any("pieces" in text for text in parts.problems(rig, [pieces]))


def replaced(made: Sequence[Part], name: str, solid: Manifold, beside: str = "") -> list[Part]:
    """Return the parts with another solid for one of them, or only that one and the part ``beside`` it."""
    assert {name, beside} - {""} <= {part.name for part in made}
    some = [part for part in made if not beside or part.name in (name, beside)]
    return [replace(part, solid=solid) if part.name == name else part for part in some]


def test_a_screw_head_under_the_flange_is_seen() -> None:
    """The cap's screws 3.5 mm outside the bearing, as in a first design: the flange of the one-inch rotor hits them."""
    made, z = assembled(ONE_INCH), parts.cap_z(ONE_INCH)
    inner = parts.at_z(parts.around(ONE_INCH.bearing.outer / 2 + 3.5, (30, 150, 210, 330)), z)
    wrong = parts.problems(
        ONE_INCH, replaced(made, "screws of the cap", parts.screws(3.0, 6.0, 1.9, inner), "rotor")
    )
    assert any(text.startswith("rotor and screws of the cap overlap") for text in wrong)


def test_a_motor_as_long_as_the_bill_allows_fits(rig: Rig) -> None:
    """80 mm with its encoder: it stands beside the camera, and reaches beyond it."""
    assert wrong_with(replace(rig, motor=(rig.motor[0], 80.0, rig.motor[2]))) == []


def test_motor_screws_that_reach_the_bottom_of_their_threads_are_seen(
    rig: Rig, made: Sequence[Part]
) -> None:
    """M3×8 through the plate of 4 mm: 4 mm of thread, of which the bill asks for 3. M3×6 has more than four turns."""
    at = parts.at_z(parts.motor_points(rig), rig.face_z - parts.PLATE)
    long = parts.screws(3.0, 8.0, parts.MOTOR_PLATE, at, sunk=True)
    wrong = parts.problems(rig, replaced(made, "screws of the motor", long, "motor"))
    assert any(text.startswith("motor and screws of the motor overlap") for text in wrong)
    right = next(part.solid for part in made if part.name == "screws of the motor")
    inside = rig.face_z - parts.PLATE - parts.MOTOR_PLATE - right.bounding_box()[2]
    assert 2.0 <= inside <= parts.MOTOR_THREAD - 0.5


def test_heads_that_stand_out_are_seen(rig: Rig, made: Sequence[Part]) -> None:
    """Cylinder heads on the rear ring touch the holder, and under the motor's pulley they touch that."""
    behind, low = (180.0, 0.0, 0.0), rig.bearing_z[0] - 2.5
    ring = parts.screws(2.0, 8.0, 2.5, parts.at_z(parts.rear_screws(rig), low), behind)
    wrong = parts.problems(rig, replaced(made, "screws of the rear ring", ring, "holder"))
    assert any(text.startswith("holder and screws of the rear ring overlap") for text in wrong)
    on_face = parts.screws(3.0, 8.0, 5.0, parts.at_z(parts.motor_points(rig), rig.face_z))
    wrong = parts.problems(rig, replaced(made, "screws of the motor", on_face, "motor pulley"))
    assert any(text.startswith("motor pulley and screws of the motor overlap") for text in wrong)


def test_a_screw_that_is_too_long_is_seen(rig: Rig, made: Sequence[Part]) -> None:
    """The holder's threads end 8 mm deep; a longer screw of the fork barrier reaches the flag's path."""
    at = parts.at_z(parts.holder_screws(rig), -parts.HOLDER)
    long = parts.screws(2.5, 12.0, parts.HOLDER, at, (180.0, 0.0, 0.0))
    wrong = parts.problems(rig, replaced(made, "screws of the holder", long, "housing"))
    assert any(text.startswith("housing and screws of the holder overlap") for text in wrong)
    board = [(x, y + 1.6, z) for x, y, z in parts.fork_screws(rig)]
    long = parts.screws(2.0, 8.0, 1.6, board, (-90.0, 0.0, 0.0))
    wrong = parts.problems(rig, replaced(made, "screws of the fork barrier", long, "rotor"))
    assert any(text.startswith("rotor and screws of the fork barrier") for text in wrong)


def test_a_wave_spring_that_rubs_is_seen(rig: Rig, made: Sequence[Part]) -> None:
    """The rear ring turns inside the spring: a wider band comes too close."""
    spring = next(part.solid for part in made if part.name == "wave spring")
    low, high = spring.bounding_box()[2], spring.bounding_box()[5]
    wider = parts.ring(rig.bearing.inner + 0.3, rig.bearing.outer / 2 - 0.25, low, high)
    wrong = parts.problems(rig, replaced(made, "wave spring", wider, "rear ring"))
    assert wrong == ["rear ring and wave spring are 0.30 mm apart, less than 0.7 mm"]


def test_a_key_reaches_the_screws_that_tighten_the_belt(rig: Rig, made: Sequence[Part]) -> None:
    """From behind, wherever the motor stands. From the front, the pulley covers the motor's own screws."""
    face = rig.face_z - parts.PLATE - parts.MOTOR_PLATE - parts.HEADS[3.0][1]
    key = parts.holes(parts.plate_screws(rig), 2.9, face - 100.0, face)
    sliding = {"motor", "motor plate", "screws of the motor"}
    for travel in (-parts.SLIDE, 0.0, parts.SLIDE):
        for part in made:
            solid = part.solid.translate((travel, 0, 0)) if part.name in sliding else part.solid
            assert (solid ^ key).volume() < 1e-9, part.name
    front = parts.holes(parts.motor_points(rig), 2.9, rig.face_z, rig.front_z)
    pulley = next(part for part in made if part.name == "motor pulley")
    assert (pulley.solid ^ front).volume() > 1.0


LENSES = [(rig, name) for rig in RIGS for name in numbers.lenses(rig)]


@pytest.mark.parametrize(
    ("rig", "name"), LENSES, ids=lambda value: value if isinstance(value, str) else value.name
)
def test_the_holder_grips_each_lens(rig: Rig, name: str) -> None:
    """Nothing overlaps, the lens's front is at its distance from the ring, and before the rotor if it is too wide."""
    own = numbers.lenses(rig)[name]
    made = assembled(own)
    assert wrong_with(own) == []
    assert all(numbers.in_file(part).is_watertight for part in made)
    solid = {part.name: part.solid for part in made}
    low, high = np.array(solid["lens"].bounding_box()).reshape(2, 3)[:, 2]
    assert high - low == pytest.approx(own.reach)
    assert solid["mount ring"].bounding_box()[5] == pytest.approx(low)
    assert solid["camera"].bounding_box()[5] == pytest.approx(low - 5.0)  # from CS-mount to C-mount
    assert high <= own.seat_z - 2.0 + 1e-9
    assert own.lens / 2 < own.clear if high > -1.0 else own.lens / 2 > own.clear


def test_the_clamp_fits_its_ring_and_opens_at_the_screw(rig: Rig, made: Sequence[Part]) -> None:
    """A bore 0.2 mm wider than the ring, cut by the slit that the screw closes; the spigot fits the housing's bore."""
    solid = {part.name: part.solid for part in made}
    jaws = solid["holder"].slice(rig.grip_z - 1.0)
    radius = rig.grip[0] / 2 + 0.1
    disc = Manifold.cylinder(1.0, radius - 0.01, radius - 0.01, 180).slice(0.5)
    assert (jaws ^ disc).area() == pytest.approx(0.0, abs=1e-9)
    assert (jaws ^ disc.scale((1.02, 1.02))).area() > 0.9 * (
        math.pi * ((1.02 * radius) ** 2 - radius**2)
    )
    slit = parts.box(
        (-0.9, 0.9), (radius - 1.0, radius + 20.0), (rig.grip_z - 4.0, rig.grip_z + 0.5)
    )
    assert (solid["holder"] ^ slit).volume() == pytest.approx(0.0, abs=1e-9)
    screw = np.array(solid["screw of the clamp"].bounding_box()).reshape(2, 3)
    assert screw[0, 0] < -parts.CLAMP
    assert screw[1, 0] > parts.CLAMP
    moved = solid["holder"].translate((0.04, 0, 0))
    assert (moved ^ solid["housing"]).volume() < 0.01
    assert (solid["holder"].translate((0.2, 0, 0)) ^ solid["housing"]).volume() > 0.1


def test_a_key_reaches_the_screws_of_the_holder(rig: Rig, made: Sequence[Part]) -> None:
    """From behind, beside the camera, which is clamped before."""
    face = -parts.HOLDER - parts.HEADS[2.5][1]
    key = parts.holes(parts.holder_screws(rig), 2.3, face - 100.0, face)
    for part in made:
        assert (part.solid ^ key).volume() < 1e-9, part.name


@pytest.mark.parametrize("travel", [-parts.SLIDE, parts.SLIDE])
def test_the_motor_slides_and_touches_nothing(
    rig: Rig, made: Sequence[Part], travel: float
) -> None:
    sliding = {
        "motor",
        "motor plate",
        "screws of the motor",
        "encoder board",
        "screws of the encoder board",
    }
    moved = []
    for part in made:
        if part.moves == "motor":
            swept = parts.swept(part.solid, rig.distance).translate((travel, 0, 0))
            moved.append(replace(part, solid=swept, moves="motor, slid"))
        elif part.name in sliding:
            moved.append(replace(part, solid=part.solid.translate((travel, 0, 0))))
        elif part.moves != "belt":
            moved.append(part)
    assert parts.problems(rig, moved) == []


def test_swept_space_of_a_box() -> None:
    """A box off the axis passes a ring: up to its far corners, and down to its near face."""
    solid = parts.box((10.0, 12.0), (-1.0, 1.0), (0.0, 3.0)).translate((5.0, 0, 0))
    low, high = np.array(parts.swept(solid, 5.0).bounding_box()).reshape(2, 3)
    assert (low[2], high[2]) == pytest.approx((0.0, 3.0))
    assert high[0] - 5.0 == pytest.approx(math.hypot(12.0, 1.0), rel=5e-3)
    assert parts.swept(solid, 5.0).volume() == pytest.approx(
        3 * math.pi * (145.0 - 100.0), rel=0.03
    )


@pytest.mark.parametrize("apex", [0.5, 1.0, 2.0])
def test_the_o_ring_leaves_the_aperture_clear(rig: Rig, apex: float) -> None:
    """Squeezed to 0.75 mm, and as thick all around, whatever the apex."""
    own = replace(rig, apex_deg=apex)
    assert own.o_ring >= own.clear
    rubber = parts.o_ring(own)
    assert rubber.volume() == pytest.approx(
        math.pi * (own.wedge / 2 + own.seat - 0.52) * 2 * math.pi * 0.25, rel=0.01
    )


def test_volumes(rig: Rig, made: Sequence[Part]) -> None:
    """Regular polygons of 180 sides are smaller than their circles by 2e-4."""
    volume = {part.name: numbers.to_mesh(part).volume for part in made}
    assert all(value > 0 for value in volume.values())
    assert volume["wedge"] == pytest.approx(
        math.pi * (rig.wedge / 2) ** 2 * rig.thickness, rel=3e-4
    )
    bearing = rig.bearing
    each = math.pi / 4 * (bearing.outer**2 - bearing.bore**2) * bearing.width
    assert volume["rear bearing"] == pytest.approx(each, rel=3e-4)


def test_bearings_and_belt_fit(rig: Rig) -> None:
    assert rig.bearing.name == {"one-inch": "6706", "two-inch": "6811"}[rig.name]
    r, s = (teeth / math.pi for teeth in rig.teeth)  # pitch of 2 mm
    c = rig.distance
    wrapped = math.pi + 2 * math.asin((r - s) / c), math.pi - 2 * math.asin((r - s) / c)
    assert 2 * math.sqrt(c**2 - (r - s) ** 2) + r * wrapped[0] + s * wrapped[1] == pytest.approx(
        rig.belt, abs=1e-6
    )
    assert rig.teeth[1] * wrapped[1] / (2 * math.pi) > 6  # teeth in mesh on the small pulley
    assert rig.teeth[0] == 2 * rig.teeth[1]  # errors of the motor's side repeat twice a turn


def test_written_files_are_watertight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command.main([str(tmp_path), "--rig", "one-inch"])
    files = sorted((tmp_path / "one-inch").glob("*.stl"))
    assert len(files) == 12
    assert "12 parts to print" in capsys.readouterr().out
    for file in files:
        mesh = trimesh.load(file)
        assert mesh.is_watertight, file.name
        assert mesh.is_winding_consistent, file.name
        assert mesh.volume > 0, file.name


def test_lens_and_ring_are_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A long lens stands 2 mm behind the wedge, and the clamp far behind the plate."""
    command.main(
        [str(tmp_path), "--rig", "two-inch", "--lens-mm", "34", "45", "--grip-mm", "32", "5"]
    )
    assert "its front is 2.0 mm from the wedge" in capsys.readouterr().out
    low, high = trimesh.load(tmp_path / "two-inch" / "holder.stl").bounds
    front = TWO_INCH.seat_z - 2.0 - 45.0
    assert (low[2], high[2]) == pytest.approx((front - 4.9, 1.5), abs=1e-3)


def test_wedge_unbalance_is_that_of_its_mesh(rig: Rig, made: Sequence[Part]) -> None:
    mesh = numbers.to_mesh(next(part for part in made if part.name == "wedge"))
    by_mesh = mesh.volume * mesh.center_mass[0] * 2.51e-3
    assert numbers.wedge_unbalance(rig) == pytest.approx(by_mesh, rel=1e-3)


def test_set_screws_balance_the_rotor(rig: Rig) -> None:
    body = numbers.rotating(rig)
    screws, balanced = numbers.balance(rig, body)
    left = np.hypot(*numbers.unbalance(balanced))
    assert left < 0.15  # g mm
    radius = parts.balance_holes(rig)[0]
    pull = sum(
        numbers.screw_mass(rig, length) * radius * math.cos(math.radians(angle))
        for angle, length in screws
    )
    assert numbers.unbalance(body)[0] + pull == pytest.approx(
        numbers.unbalance(balanced)[0], abs=1e-9
    )


def test_forces_of_a_single_mass() -> None:
    """A mass in the plane of the front bearing loads that bearing alone."""
    front = ONE_INCH.bearing_z[1] + ONE_INCH.bearing.width / 2
    rear, loaded = numbers.bearing_forces(ONE_INCH, numbers.point(0.1, 20.0, 0.0, front), 1440.0)
    assert rear == pytest.approx(0.0, abs=1e-12)
    assert loaded == pytest.approx(0.1e-3 * 20e-3 * (2 * math.pi * 24) ** 2, rel=1e-9)  # m r ω²


def test_friction_by_hand() -> None:
    """Mean diameter 33.5 mm, 100 mm²/s, 1,000 rpm: (1e5)^(2/3) = 2154.4; 2 · 1e-7 · 1.8 · 2154.4 · 33.5³."""
    assert numbers.friction(ONE_INCH, 1000.0, 100.0, 1.8) == pytest.approx(29.16, abs=0.01)


def test_lens_is_clear_of_the_stops(rig: Rig) -> None:
    """A prism that does nothing, against the rays' geometry; then the focal lengths of the page."""
    sensor = numbers.SENSORS["640×480, 9 µm"]
    flat, focal, number = replace(rig, apex_deg=1e-6), 8.0, 2.0
    corner = math.hypot(320 * 9e-3, 240 * 9e-3) / focal
    at = flat.lens_z - flat.pupil
    left = min(radius - focal / (2 * number) - (z - at) * corner for _, z, radius in flat.stops)
    assert numbers.clear_of_stops(flat, sensor, focal, number) == pytest.approx(left, abs=1e-3)
    shortest = numbers.shortest_focal(rig, sensor)
    assert shortest == {"one-inch": 13.7, "two-inch": 3.5}[rig.name]
    assert (
        numbers.clear_of_stops(rig, sensor, shortest - 0.1)
        < 0
        <= numbers.clear_of_stops(rig, sensor, shortest)
    )


def test_a_lens_off_the_axis(rig: Rig) -> None:
    """It takes its offset from what is left to each stop; a point moves by what a traced ray does."""
    sensor = numbers.SENSORS["640×480, 9 µm"]
    centred, off = (numbers.clear_of_stops(rig, sensor, 16.0, 2.0, by) for by in (0.0, 0.3))
    assert off == pytest.approx(centred - 0.3)

    def traced(x: float, angle: float) -> float:
        """Return where a ray from x in the plane of the wedge's flat face meets a wall 1 m away [mm]."""
        n, tilt = amiwarp.Prism(0.01).index, math.radians(rig.apex_deg)
        inside = math.asin(math.sin(angle) / n)
        # The second face: z = thickness + x tan(tilt); its normal leans by the tilt.
        z = (rig.thickness + x * math.tan(tilt)) / (1 - math.tan(inside) * math.tan(tilt))
        at, out = x + z * math.tan(inside), math.asin(n * math.sin(inside + tilt)) - tilt
        return at + (1000.0 - z) * math.tan(out)

    edge = math.radians(30.0)
    shift = (traced(0.3, edge) - 0.3) - traced(0.0, edge)
    assert numbers.offset_error(rig, 0.3, 1000.0) == pytest.approx(
        abs(shift) / 1000.0 * 320 / math.tan(edge), rel=0.1
    )


def test_wobble_costs_little_and_nothing_once_it_is_freed() -> None:
    off = numbers.Tolerance("wobble", "", wobble_deg=(0.35, 0.35))
    size = {"apex_deg": 1.0, "width": 320}
    assert 0.01 < numbers.error(off, (), **size) < 0.02  # px
    assert numbers.error(off, ("wobble",), **size) < 1e-3


def test_page_states_what_is_computed() -> None:
    for row in [
        *command.balance_rows([ONE_INCH], [1.0]),
        *command.speed_rows(),
        *command.lens_rows([TWO_INCH]),
    ]:
        assert "| " + " | ".join(row) + " |" in PAGE
    assert TWO_INCH.bearing.name in PAGE
