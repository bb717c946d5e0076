"""What the rig's command refuses: each line names option, value, and the nearest one that can be built."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip(
    "manifold3d", reason="the rig's parts need manifold3d: pip install 'amiwarp[rig]'"
)
pytest.importorskip("trimesh", reason="the rig's parts need trimesh: pip install 'amiwarp[rig]'")

from rig import __main__ as command
from rig import limits, numbers, parts
from rig.gimbal import GIMBAL
from rig.numbers import View
from rig.parts import ONE_INCH, TWO_INCH, Rig

VGA = (640, 480, 9e-3)


def refused(*arguments: str) -> str:
    """Return what the command says when it refuses."""
    with pytest.raises(SystemExit) as caught:
        command.main(["never-written", *arguments])
    return str(caught.value)


def test_default_dimensions_can_be_built() -> None:
    assert [limits.refusals(rig) for rig in parts.RIGS] == [[], []]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--apex-deg -1", "one-inch: --apex-deg -1: give an angle above 0"),
        ("--apex-deg 0", "--apex-deg 0: give an angle above 0"),
        ("--apex-deg nan", "--apex-deg nan: give an angle above 0"),
        (
            "--thickness-mm 0.2 --apex-deg 1",
            "the thin edge is -0.02 mm, and 0.5 mm are needed; give 0.8 or more",
        ),
        (
            "--thickness-mm 12 --apex-deg 1",
            "--thickness-mm 12: the thick edge of 12.22 mm leaves the rotor no",
        ),
        ("--edges-mm 3 2", "--edges-mm 3 2: the thick edge comes second"),
        ("--edges-mm 0.3 3", "the thin edge is 0.30 mm"),
        ("--edges-mm 3 4 --apex-deg 1", "leave out --thickness-mm and --apex-deg"),
        (
            "--wedge-mm 36",
            "no bearing of series 67 leaves a wall of 2 mm around its seat; give at most 35.8",
        ),
        ("--wedge-mm nan", "--wedge-mm nan: give a number above 0"),
        (
            "--teeth 54 27",
            "the screws would overlap or leave walls below 1.2 mm; give 56 28 or more",
        ),
        ("--teeth 60 20", "--teeth 60 20: the ratio is not 2"),
        (
            "--motor-mm 28 40 12",
            "shaft 12: the motor's pulley of 30 teeth has no wall left; give at most 10.6",
        ),
        (
            "--motor-screws-mm 12 7",
            "--motor-screws-mm, distance 12: the heads of the screws overlap the boss of 7 mm",
        ),
        (
            "--motor-screws-mm 26 7",
            "--motor-screws-mm, distance 26: outside the motor of 28 mm; give at most 25",
        ),
        (
            "--motor-screws-mm 17 3",
            "--motor-screws-mm, boss 3: it is thinner than the shaft; give at least 4",
        ),
        (
            "--motor-mm 40 40 4",
            "touches camera, holder or housing; give a motor of at most 28.6, or a belt of at least 192 mm",
        ),
        (
            "--camera-mm 52 60 30",
            "--camera-mm, width 52, --lens-mm, diameter 17, and --motor-mm, diameter 28",
        ),
        (
            "--camera-mm 40 90 30",
            "--camera-mm, height 90: the camera touches the base; give at most 81.5",
        ),
        (
            "--lens-mm 60 30 --motor-mm 20 40 4 --belt-mm 220",
            "no wall left beside its screws; give at most 53.6",
        ),
        (
            "--lens-mm 50 30",
            "give a lens of at most 43.3, or a motor of at most 21.3, or a belt of at least",
        ),
        ("--camera-thread m12", "--camera-thread m12: the thread is on the camera's board"),
        (
            "--camera-thread c --lens-thread cs --flange-mm 17.526",
            "a lens with CS-mount must be 12.526 mm from the sensor",
        ),
        (
            "--lens-thread c --flange-mm 16",
            "the ring of 1.526 mm between this camera and a lens with C-mount is too narrow for the clamp, which "
            "needs 3 mm; give at most 14.526",
        ),
        (
            "--lens-thread c --grip-mm 30 4",
            "between a flange distance of 12.526 mm and a lens with C-mount belongs a ring of 5.000 mm",
        ),
        ("--grip-mm 26 5", "a ring around the thread of 25.4 mm has no wall; give at least 27.8"),
        ("--grip-mm 30 2", "--grip-mm, width 2: the clamp needs 3 mm or more"),
        ("--flange-mm 0", "--flange-mm 0: give a number above 0"),
        ("--belt-mm 50", "give a belt of at least 180 mm (--belt-mm)"),
        ("--pupil-mm -1", "--pupil-mm -1: the entrance pupil is said to lie outside the lens"),
        ("--pupil-mm 23", "0 to 22.5"),
        ("--lens-mm 0 5", "--lens-mm 0: give a number above 0"),
        (
            "--fov-deg 60",
            "--fov-deg 60: with the pupil 4 mm behind the lens's front (--pupil-mm) and at f/2",
        ),
        ("--fov-deg 23 --pupil-mm 12", "--fov-deg 23: with the pupil 12 mm behind"),
        (
            "--fov-deg 10 --f-number 0.7",
            "no view is free at this f-number; close the aperture (--f-number)",
        ),
        ("--fov-deg 0", "--fov-deg 0: give a number above 0"),
        ("--fov-deg 20 --size 640", "--size 640: give COLUMNSxROWS"),
        ("--rpm 4000", "--rpm 4000: give a speed above 0, at most 3000"),
    ],
)
def test_what_cannot_be_built_is_refused(options: str, says: str) -> None:
    assert says in refused("--rig", "one-inch", *options.split())
    assert not Path("never-written").exists()


@pytest.mark.slow
def test_an_unbalanced_wedge_is_refused_with_the_apex_and_the_speed_that_can_be_balanced() -> None:
    text = refused("--rig", "two-inch", "--apex-deg", "4")
    found = re.search(
        r"the rotor has G ([\d.]+) at 1440 rpm.* at most ([\d.]+), .* --rpm (\d+)$", text
    )
    assert found, text
    grade, apex, rpm = (float(value) for value in found.groups())
    own = replace(TWO_INCH, apex_deg=4.0)
    _, body = numbers.balance(own, numbers.rotating(own))
    assert grade == pytest.approx(numbers.grade(body, 1440.0), abs=0.06)
    assert limits.refusals(replace(TWO_INCH, apex_deg=apex)) == []
    assert limits.refusals(replace(TWO_INCH, apex_deg=apex + 0.3)) != []
    assert limits.refusals(own, rpm=rpm) == []
    assert limits.refusals(own, rpm=rpm + 10.0) != []


NEAREST: list[tuple[Callable[[float], Rig], float, float]] = [
    (lambda v: replace(ONE_INCH, apex_deg=1.0, thickness=v), 0.8, -0.1),
    (lambda v: replace(ONE_INCH, camera=(v, 60.0, 30.0)), 40.6, 0.1),
    (lambda v: replace(ONE_INCH, motor=(v, 40.0, 4.0)), 28.6, 0.1),
    (lambda v: replace(ONE_INCH, motor=(28.0, 40.0, v), motor_screws=(20.5, 11.0)), 10.6, 0.1),
    (lambda v: replace(ONE_INCH, belt=220.0, lens=v, threads=("cs", "c")), 53.6, 0.1),
    (lambda v: replace(ONE_INCH, motor_screws=(v, 7.0)), 15.4, -0.1),
    (lambda v: replace(ONE_INCH, motor=(40.0, 40.0, 4.0), belt=v), 192.0, -2.0),
    (lambda v: replace(GIMBAL, hollow=replace(GIMBAL.hollow, outer=110.0), belt=v), 320.0, -2.0),
]


@pytest.mark.slow
@pytest.mark.parametrize(("own", "nearest", "beyond"), NEAREST, ids=range(len(NEAREST)))
def test_the_nearest_that_is_named_is_buildable(
    own: Callable[[float], Rig], nearest: float, beyond: float
) -> None:
    """Also as solids, which know nothing of the formulas; a little beyond it is refused."""
    assert limits.refusals(own(nearest)) == []
    assert parts.problems(own(nearest), numbers.assembly(own(nearest))) == []
    assert limits.refusals(own(nearest + beyond)) != []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig", "wedge"), [(ONE_INCH, 12.5), (ONE_INCH, 35.8), (TWO_INCH, 38.1), (TWO_INCH, 55.8)]
)
def test_other_wedges_fit(rig: Rig, wedge: float) -> None:
    own = parts.for_wedge(rig, wedge, teeth=None, belt=None)
    assert own.wedge == wedge
    assert limits.refusals(own) == []
    assert parts.problems(own, parts.assembly(own)) == []


def test_walls_beside_and_between_the_screws() -> None:
    """With the least teeth, both walls are 1.2 mm or more, and with two teeth less, one of them is not."""

    def walls(rig: Rig) -> tuple[float, float]:
        inner = rig.wedge / 2 + rig.seat
        root = rig.teeth[0] / math.pi - 0.254 - 0.75
        radius, angles = parts.balance_holes(rig)
        at = np.array(parts.around(radius, angles))
        apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1)) + 1e3 * np.eye(len(at))
        return (root - inner - rig.screw[0]) / 2, float(apart.min()) - rig.screw[0]

    for rig, wedge in ((ONE_INCH, 12.5), (ONE_INCH, 25.4), (TWO_INCH, 50.8)):
        least = parts.least_teeth(wedge, rig.seat, rig.screw[0])
        assert min(walls(replace(rig, wedge=wedge, teeth=(least, least // 2)))) >= 1.2 - 1e-9
        assert min(walls(replace(rig, wedge=wedge, teeth=(least - 2, least // 2 - 1)))) < 1.2


def test_beam_by_hand() -> None:
    """Without refraction: the corner's ray from the rim of the pupil, against the stop that is hit first."""
    flat = replace(ONE_INCH, apex_deg=1e-6)
    focal = View(VGA, 23.0, 2.0).focal
    assert focal == pytest.approx(320 * 9e-3 / math.tan(math.radians(11.5)))
    corner = math.hypot(2.88, 2.16) / focal
    for pupil in (0.0, 4.0, 12.0):
        own = replace(flat, pupil=pupil)
        rim = [focal / 4 + (z - own.lens_z + pupil) * corner - radius for _, z, radius in own.stops]
        said = list(limits.beam(own, View(VGA, 23.0, 2.0)))
        assert bool(said) is (max(rim) > 0), pupil
        if said:
            assert f"is {max(rim):.1f} mm outside" in said[0]


def test_the_view_that_is_named_passes() -> None:
    (line,) = limits.beam(ONE_INCH, View(VGA, 60.0, 2.0))
    most = float(re.search(r"give at most ([\d.]+)", line)[1])
    assert list(limits.beam(ONE_INCH, View(VGA, most, 2.0))) == []
    assert list(limits.beam(ONE_INCH, View(VGA, most + 0.3, 2.0))) != []


def test_distance_from_a_hull() -> None:
    """Two circles of radius 1, 4 apart: from beside the middle 3 - 1, from beyond one end 3 - 1."""
    circles = ((0.0, 0.0, 1.0), (4.0, 0.0, 1.0))
    assert numbers.to_hull((2.0, 3.0), circles) == pytest.approx(2.0, abs=1e-5)
    assert numbers.to_hull((7.0, 0.0), circles) == pytest.approx(2.0, abs=1e-5)


@pytest.mark.slow
def test_what_was_not_given_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command.main([str(tmp_path), "--rig", "one-inch", "--edges-mm", "3", "3.6", "--wedge-mm", "30"])
    text = capsys.readouterr().out
    assert "belt 200 mm (--belt-mm), pulleys of 64 and 32 teeth (--teeth)" in text
    assert "pupil 4 mm behind the lens's front (--pupil-mm)" in text
    assert "view: not checked (--fov-deg); at most " in text
    command.main(
        [
            str(tmp_path),
            "--rig",
            "one-inch",
            "--fov-deg",
            "20",
            "--teeth",
            "60",
            "30",
            "--belt-mm",
            "180",
        ]
    )
    text = capsys.readouterr().out
    assert "view: 20° at f/2 passes the wedge" in text
    assert "belt" not in text
