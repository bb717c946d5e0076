"""The rig with a hollow-shaft motor: its solids, what is refused, its encoder's magnet, the speeds that it holds."""

import importlib.util
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests import ROOT

pytest.importorskip(
    "manifold3d", reason="the rig's parts need manifold3d: pip install 'amiwarp[rig]'"
)
pytest.importorskip("trimesh", reason="the rig's parts need trimesh: pip install 'amiwarp[rig]'")
from manifold3d import Manifold

from amiwarp.live.link.protocol import SETTINGS
from rig import __main__ as command
from rig import drive, limits, magnet, numbers, parts
from rig.drive import Drive
from rig.gimbal import GIMBAL, GimbalRig, HollowMotor
from rig.parts import Part

FIRMWARE = ROOT / "firmware"


def made_of(rig: GimbalRig) -> Sequence[Part]:
    return numbers.assembly(rig)


def solids(rig: GimbalRig = GIMBAL) -> dict[str, Manifold]:
    return {part.name: part.solid for part in made_of(rig)}


def test_parts_neither_overlap_nor_come_too_close() -> None:
    assert limits.refusals(GIMBAL) == []
    assert parts.problems(GIMBAL, made_of(GIMBAL)) == []
    assert all(numbers.in_file(part).is_watertight for part in made_of(GIMBAL))


@pytest.mark.slow
@pytest.mark.parametrize(
    "own",
    [
        replace(GIMBAL, hollow=replace(GIMBAL.hollow, outer=90.8)),
        replace(GIMBAL, hollow=replace(GIMBAL.hollow, bore=33.0, height=30.0)),
        replace(GIMBAL, hollow=replace(GIMBAL.hollow, rotor_circle=41.4)),
        replace(GIMBAL, hollow=replace(GIMBAL.hollow, rotor_circle=45.2, stator_circle=66.0)),
        replace(GIMBAL, apex_deg=2.0, thickness=8.0),
        replace(GIMBAL, lens=27.6, reach=35.0),
    ],
    ids=range(6),
)
def test_what_is_not_refused_fits(own: GimbalRig) -> None:
    assert limits.refusals(own) == []
    assert parts.problems(own, made_of(own)) == []
    assert all(
        numbers.in_file(part).is_watertight for part in made_of(own) if part.kind == "printed"
    )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (
            "--hollow-mm 110 22 36",
            "--hollow-mm, outer diameter 110, and --camera-mm, width 40: camera, housing or index flag touches",
        ),
        (
            "--hollow-mm 110 22 36",
            "give a motor of at most 90.8, or a belt of at least 320 mm (--belt-mm)",
        ),
        (
            "--hollow-mm 80 22 40",
            "beside a bore of 40 mm and within the motor of 80 mm, the housing's screws need a circle",
        ),
        ("--hollow-screws-mm 68 44", "need a circle of 44.2 to 66.0"),
        (
            "--hollow-screws-mm 46 60",
            "--hollow-screws-mm, rotor 60: the heads of the cell's screws must lie under the wedge",
        ),
        ("--hollow-screws-mm 46 60", "give 41.4 to 45.2"),
        (
            "--lens-mm 40 30",
            "--lens-mm, diameter 40: the bore of 36 mm (--hollow-mm) is too narrow",
        ),
        ("--lens-mm 40 30", "give at most 27.6"),
        ("--kv 17", "--rpm 1440: with --kv 17, 12 V and its friction, the motor reaches 203 rpm"),
        ("--kv 17 --rpm 720", "give at most that, or --kv 64"),
        ("--current-a 0.2", "--current-a 0.2: 14 mN m do not overcome the friction of 20 mN m"),
        ("--camera-mm 120 60 30", "give a camera of at most "),
        (
            "--hollow-mm 80 1 36",
            "--hollow-mm, height 1: too flat for stator and bell; give at least 10",
        ),
        (
            "--hollow-mm 50 22 36",
            "--hollow-mm, bore 36: beside it, a motor of 50 mm has no room for the housing's screws",
        ),
        (
            "--wedge-mm 20",
            "--wedge-mm 20: under it there is no room for the cell's screws beside a bore of 36 mm",
        ),
        (
            "--friction-mnm nan",
            "--friction-mnm, --cogging-mnm, --slots-poles: give numbers that are not negative",
        ),
        ("--kv 0", "--kv 0: give a number above 0"),
        ("--hollow-mm 80 nan 36", "--hollow-mm nan: give a number above 0"),
        ("--motor-mm 20 20 5", "the gimbal has no such motor; give --hollow-mm"),
        ("--fov-deg 60", "--fov-deg 60: with the pupil 4 mm"),
    ],
)
def test_what_cannot_be_built_is_refused(options: str, says: str) -> None:
    with pytest.raises(SystemExit) as caught:
        command.main(["never-written", "--rig", "gimbal", *options.split()])
    assert says in str(caught.value)


def test_options_of_the_hollow_motor_belong_to_its_rig() -> None:
    with pytest.raises(SystemExit, match="belong to --rig gimbal"):
        command.main(["never-written", "--rig", "one-inch", "--kv", "100"])


def test_a_speed_that_is_named_is_reached() -> None:
    slow = replace(GIMBAL, hollow=replace(GIMBAL.hollow, kv=64.0))
    assert limits.refusals(slow, rpm=720.0) == []


def holes_in(shape: object, diameter: float) -> list[tuple[float, float]]:
    """Return the middles of the round holes of a diameter in a cut, by their areas."""
    area = math.pi * diameter**2 / 4
    found = []
    for polygon in shape.to_polygons():
        x, y = np.asarray(polygon).T
        cross = x * np.roll(y, -1) - y * np.roll(x, -1)
        if cross.sum() < 0 and abs(-cross.sum() / 2 / area - 1) < 0.03:
            found.append((float(x.mean()), float(y.mean())))
    return found


@pytest.mark.parametrize(
    ("name", "z", "diameter", "circle", "angle"),
    [
        ("housing", parts.PLATE - 0.5, 3.4, GIMBAL.hollow.stator_circle, 45.0),
        ("stator", parts.PLATE + 1.0, 2.5, GIMBAL.hollow.stator_circle, 45.0),
        ("cell", GIMBAL.shoulder_z + 0.5, 3.4, GIMBAL.hollow.rotor_circle, 0.0),
        ("bell", GIMBAL.shoulder_z - 1.0, 2.5, GIMBAL.hollow.rotor_circle, 0.0),
    ],
)
def test_bolt_patterns_meet(
    name: str, z: float, diameter: float, circle: float, angle: float
) -> None:
    """Four holes on the motor's circles, at 45° in the rear and at 0° in the front, in both parts that meet."""
    found = [
        (x, y)
        for x, y in holes_in(solids()[name].slice(z), diameter)
        if abs(math.hypot(x, y) - circle / 2) < 0.01
    ]
    at = sorted(math.degrees(math.atan2(y, x)) % 360 for x, y in found)
    assert [round(value % 360, 3) % 360 for value in at] == [angle + 90.0 * k for k in range(4)]


def test_the_encoder_block_screws_meet_the_housing() -> None:
    """They are not mirrored: two threads beside the shaft, towards the axis."""
    z = GIMBAL.face_z - parts.PLATE + 0.5
    found = [
        at
        for at in holes_in(solids()["housing"].slice(z), 2.5)
        if abs(at[0] - GIMBAL.distance + 8.0) < 0.01
    ]
    assert sorted(y for _, y in found) == pytest.approx([-14.0, 14.0], abs=0.01)
    low, high = np.array(solids()["screws of the encoder block"].bounding_box()).reshape(2, 3)
    assert (low[0] + high[0]) / 2 == pytest.approx(GIMBAL.distance - 8.0, abs=0.01)


def test_the_light_passes_the_motor() -> None:
    """Nothing is within the clear aperture between holder and wedge, and the wedge has its seat."""
    # The holder's spigot, around the lens, ends at 1.5
    tube = parts.rod(GIMBAL.clear - 0.01, 1.51, GIMBAL.seat_z - 0.01)
    for part in made_of(GIMBAL):
        assert (part.solid ^ tube).volume() < 1e-9, part.name
    low, high = np.array(solids()["wedge"].bounding_box()).reshape(2, 3)
    assert high[1] - low[1] == pytest.approx(50.8, abs=0.01)
    seat = solids()["cell"].slice(GIMBAL.seat_z + 0.5)
    assert max(math.hypot(x, y) for x, y in holes_in_ring(seat)) == pytest.approx(25.5, abs=0.01)


def holes_in_ring(shape: object) -> list[tuple[float, float]]:
    """Return the corners of the hole around the axis."""
    inner = min(
        shape.to_polygons(), key=lambda polygon: abs(np.hypot(*np.asarray(polygon).T).max() - 25.5)
    )
    return [tuple(point) for point in inner]


# The magnet


def test_a_centred_magnet_is_read_without_error() -> None:
    assert magnet.largest_error(magnet.DISC, 0.0, 1.0) < 1e-9


def test_the_field_is_that_of_a_dipole_far_away() -> None:
    """A small magnet with moment m = π R² h M along x: Bz = 3 m x z / r⁵, in units of M."""
    small = magnet.Magnet(0.5, 0.0, 0.2)
    x, y, gap = np.array([30.0, 12.0]), np.array([0.0, 25.0]), 20.0
    z = gap + 0.1
    expected = 3.0 * math.pi * 0.25 * 0.2 * x * z / (x**2 + y**2 + z**2) ** 2.5
    assert magnet.field(small, x, y, gap, 0.0) == pytest.approx(expected, rel=2e-3)
    turned = magnet.field(small, x, y, gap, math.pi / 2)
    assert turned == pytest.approx(
        3.0 * math.pi * 0.25 * 0.2 * y * z / (x**2 + y**2 + z**2) ** 2.5, rel=2e-3, abs=1e-12
    )


def test_a_magnet_half_a_millimetre_off_is_read_to_a_degree() -> None:
    """As the data sheets of this family of chips say: within a degree or so for 0.5 to 0.7 mm."""
    assert 0.2 < math.degrees(magnet.largest_error(magnet.DISC, 0.5, 1.0)) < 1.2


def test_beside_a_hollow_shaft_the_chip_cannot_be_used() -> None:
    _, error = magnet.around_shaft(GIMBAL.hollow.bore)
    assert math.degrees(error) > 20.0
    ring = magnet.Magnet(22.0, 19.0, 3.0)
    assert magnet.largest_error(ring, 28.0, 1.0) == math.inf  # it counts backwards


def test_the_error_beside_the_axis_follows_from_the_field() -> None:
    """Twice a turn, by k = ρ f' / f: as the module's text derives it, here for Hall elements that are near."""
    ring, rho, step = magnet.Magnet(22.0, 19.0, 3.0), 8.0, 1e-3
    f = [
        float(magnet.field(ring, np.array([rho + s]), np.array([0.0]), 6.0, 0.0)[0])
        for s in (-step, 0.0, step)
    ]
    k = rho * (f[2] - f[0]) / (2 * step) / f[1]
    expected = math.asin(abs(1 - k) / (1 + k))
    assert magnet.largest_error(ring, rho, 6.0) == pytest.approx(expected, rel=0.05)


# The drive


def test_numbers_of_a_motor_by_hand() -> None:
    """KV 100: K = 0.0955 N m/A; 1e-4 kg m², 2 Ω: 1e-4 * 2 / 0.0955² = 22 ms."""
    own = Drive(
        HollowMotor(kv=100.0, resistance=2.0, current=1.5, friction=20.0, cogging=8.0), 1e-4
    )
    assert own.constant == pytest.approx(0.09549, abs=1e-5)
    assert own.rise == pytest.approx(0.02193, abs=1e-5)
    assert own.torque == pytest.approx(0.14324, abs=1e-5)
    assert own.no_load == 1200.0
    assert own.fastest == pytest.approx(1200.0 * (1 - 0.02 * 2 / 0.09549 / 12), abs=0.1)
    assert own.cogs == 168
    w = 720 * math.tau / 60
    assert own.ripple(720.0) == pytest.approx(8e-3 / (1e-4 * 168 * w**2))
    assert own.gains["friction"] == pytest.approx(32767 * 0.02 * 2 / 0.09549 / 12, abs=1.0)


def test_the_inertia_is_that_of_what_turns() -> None:
    """Bell, cell, wedge and rings; the bell as a ring of 80 mm outside has about 90 g * (0.03 m)²."""
    own = drive.drive_of(GIMBAL)
    bell = next(part for part in made_of(GIMBAL) if part.name == "bell")
    alone = numbers.Body.of(bell).inertia[2, 2] * 1e-9
    assert own.inertia > alone > 90e-3 * 0.028**2
    assert own.inertia - alone < 5e-5


def test_the_command_prints_its_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command.main([str(tmp_path), "--rig", "gimbal"])
    text = capsys.readouterr().out
    assert "9 parts to print" in text
    assert "motor: at most 1598 rpm at 12 V" in text
    assert "not linear to 0.4° of the prism" in text
    assert "computed and simulated, never built" in text


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[ModuleType, Path]:
    """Return ``firmware/gimbal.py``, and the core with its simulated motor."""
    if shutil.which("make") is None or shutil.which("cc") is None:
        pytest.skip("the core needs make and a C compiler")
    folder = tmp_path_factory.mktemp("gimbal")
    subprocess.run(["make", "-s", "-C", str(FIRMWARE), f"BUILD={folder}", "native"], check=True)
    sys.path.insert(0, str(FIRMWARE))
    try:
        spec = importlib.util.spec_from_file_location("firmware_gimbal", FIRMWARE / "gimbal.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules["firmware_gimbal"] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(FIRMWARE))
    return module, folder / "libboard.so"


@pytest.mark.parametrize("rpm", [60.0, 720.0, 1440.0])
def test_the_core_holds_speeds_with_the_simulated_motor(
    simulated: tuple[ModuleType, Path], rpm: float
) -> None:
    module, library = simulated
    found = module.hold(drive.drive_of(GIMBAL), rpm, seconds=2.0, library=library)
    assert found.held, found
    assert found.ripple < 0.04
    assert found.over < 0.15
    # the non-linearity of the encoder, and its noise of three times its rms on either side
    assert found.angle_deg == pytest.approx(drive.INL / 2, abs=0.1)


def test_the_simulated_motor_obeys_its_numbers(simulated: tuple[ModuleType, Path]) -> None:
    """Too fast, it stops with a fault; with little current it does not follow; cogging roughens slow turns."""
    module, library = simulated
    own = drive.drive_of(GIMBAL)
    slow = Drive(replace(own.motor, kv=60.0), own.inertia)
    found = module.hold(slow, 900.0, seconds=1.0, library=library)
    assert slow.fastest < 900.0
    assert not found.held
    assert found.faults
    weak = Drive(replace(own.motor, current=0.32), own.inertia)  # 22 mN m, and 20 for its friction
    assert weak.fastest > 720.0
    assert not module.hold(weak, 720.0, seconds=0.5, library=library).held
    rough = Drive(replace(own.motor, cogging=60.0), own.inertia)
    smooth = Drive(replace(own.motor, cogging=0.0), own.inertia)
    ripples = [
        module.hold(each, 60.0, seconds=1.0, library=library).ripple for each in (rough, smooth)
    ]
    assert ripples[0] > 1.2 * ripples[1]


def test_the_page_of_the_firmware_states_what_is_simulated(
    simulated: tuple[ModuleType, Path],
) -> None:
    """The table in ``firmware/README.md``: speeds that are held, ripple and error."""
    module, library = simulated
    page = (FIRMWARE / "README.md").read_text()
    own = drive.drive_of(GIMBAL)
    for rpm in (30.0, 720.0):
        assert module.row(module.hold(own, rpm, library=library)) in page


def test_motor_screws_end_before_the_bottom_of_their_threads() -> None:
    """Of housing and cell, with the depth that the bill asks for; they hold by more than four turns."""
    made = {name: solid.bounding_box() for name, solid in solids().items()}
    behind = made["screws of the motor"][5] - parts.PLATE
    before = GIMBAL.shoulder_z - made["screws of the cell"][2]
    for inside in (behind, before):
        assert 2.0 <= inside <= GIMBAL.hollow.thread - 0.5


def test_the_printed_gains_are_settings_of_the_firmware() -> None:
    """Each within its range; what is not among them is as the firmware was built."""
    lines = drive.text(drive.drive_of(GIMBAL))
    (line,) = (each for each in lines if "amiwarp motor settings" in each)
    changes = dict(re.findall(r"--change (\S+)=(\d+)", line))
    ranges = {each.name: each for each in SETTINGS}
    assert set(changes) == {"no-load-rpm", "friction", "kp", "ki", "rise-ms"}
    assert all(ranges[name].contains(int(value)) for name, value in changes.items())
    built = (FIRMWARE / "core" / "settings.c").read_text()
    assert f".duty_slew = {drive.drive_of(GIMBAL).gains['duty_slew']}" in built
