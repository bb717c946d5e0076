"""Write the rig's printable parts, drawings, pictures and numbers: ``python -m rig OUT``."""

import argparse
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import amiwarp
from rig import numbers, parts
from rig.numbers import OVERSPEED, SPEEDS, Tolerance
from rig.parts import Part, Rig

APEXES = (0.5, 1.0, 2.0)
FASTEST, BALANCED = max(SPEEDS), 2.5
"""Speed of the prism [turns/min], and balance quality G of ISO 21940-11 [mm/s] of a rotor that is called balanced."""


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table in Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows)]) + "\n"


def list_of_parts(made: Sequence[Part]) -> str:
    """Return the masses of the parts."""
    rows = [
        ("" if part.kind == "screws" else k, part.name, part.kind, f"{part.mass:.1f}") for k, part in enumerate(made, 1)
    ]
    return table(("number", "part", "kind", "mass [g]"), [*rows, ("", "all", "", f"{sum(p.mass for p in made):.0f}")])


def balance_rows(rigs: Sequence[Rig] = parts.RIGS, apexes: Sequence[float] = APEXES) -> list[tuple[str, ...]]:
    """Return unbalance, grade, forces and vibration of both rigs, for each apex, without and with set screws."""
    rows = []
    for rig in rigs:
        for apex in apexes:
            own = replace(rig, apex_deg=apex)
            body = numbers.rotating(own)
            screws, balanced = numbers.balance(own, body)
            slack = own.seat * numbers.glass_mass(own)
            held = balanced + numbers.point(1e-9, slack / 1e-9, 0.0, own.seat_z + own.thickness / 2)
            for name, each in (("no screws", body), (words(screws) + f", wedge off by {own.seat} mm", held)):
                path, lean = numbers.vibration(own, each)
                forces = [numbers.bearing_forces(own, each, rpm) for rpm in SPEEDS]
                rows.append(
                    (
                        f"{rig.name}, {apex:g}°",
                        name,
                        f"{numbers.wedge_unbalance(own):.2f}",
                        f"{float(np.hypot(*numbers.unbalance(each))):.2f}",
                        *(f"{numbers.grade(each, rpm):.1f}" for rpm in SPEEDS),
                        *(f"{rear:.2f} / {front:.2f}" for rear, front in forces),
                        f"{1e3 * path:.1f}",
                        f"{math.degrees(lean):.4f}",
                    )
                )
    return rows


def words(screws: list[tuple[float, float]]) -> str:
    """Return set screws in words."""
    return ", ".join(f"{length:g} mm at {angle:g}°" for angle, length in screws) or "none needed"


def speed_rows() -> list[tuple[str, ...]]:
    """Return friction at both speeds, and stresses at over-speed."""
    rows = []
    for rig in parts.RIGS:
        greased, oiled = ([numbers.friction(rig, rpm, *oil) for rpm in SPEEDS] for oil in ((100.0, 1.8), (15.0, 0.8)))
        stress = numbers.stress(rig, OVERSPEED)
        rows.append(
            (
                rig.name,
                rig.bearing.name,
                " / ".join(f"{v:.0f}" for v in greased),
                " / ".join(f"{v:.1f}" for v in oiled),
                *(f"{stress[name]:.2f}" for name in ("glass", "rotor", "wedge's pull", "shock", "rim", "energy")),
            )
        )
    return rows


def lens_rows(rigs: Sequence[Rig] = parts.RIGS) -> list[tuple[str, ...]]:
    """Return the shortest focal lengths for each lens."""
    rows = []
    for rig in rigs:
        for lens, own in numbers.lenses(rig).items():
            for name, sensor in numbers.SENSORS.items():
                found = [numbers.shortest_focal(own, sensor, *at) for at in ((2.0,), (4.0,), (4.0, OFF))]
                wide = [math.degrees(2 * math.atan(sensor[0] * sensor[2] / 2 / focal)) for focal in found[:2]]
                cells = [f"{f:.1f} ({w:.0f}°)" if w else "none" for f, w in zip(found[:2], wide, strict=True)]
                off = f"{found[2]:.1f}" if math.isfinite(found[2]) else "none"
                rows.append((rig.name, lens, f"{own.seat_z - own.lens_z:.1f}", name, *cells, off))
    return rows


OFF = 0.3
"""Distance of the lens's axis from that of the rotor: gaps of spigot, clamp and mount, and print [mm]."""


def tolerances(rig: Rig) -> list[Tolerance]:
    """Return what is off in a printed and in a turned rig, and its size."""
    apart = rig.between + rig.bearing.width
    play, runout = rig.bearing.play[1] / apart, 2 * rig.bearing.runout / apart
    pulley = rig.pitch(rig.teeth[0])
    loose = math.degrees(play)
    wobbles = {"print": (0.15 / rig.wedge, runout), "turned": (0.02 / rig.wedge, runout)}
    out = [Tolerance("bearings with play, not preloaded", f"axis off by {loose:.2f}°", tilt_deg=(loose, 0.0))]
    for name, (seat, race) in wobbles.items():
        total = math.degrees(math.hypot(seat, race))
        half = total / math.sqrt(2)
        size = f"seat {math.degrees(seat):.2f}°, races {math.degrees(race):.2f}°"
        out.append(Tolerance(f"wobble of the wedge, {name} seat", size, wobble_deg=(half, half)))
    wide, long = rig.grip
    seated = math.degrees(math.hypot(0.1 / wide, 0.1 / (rig.bearing.outer + 8.0)))
    askew = math.degrees(0.2 / long)
    for name, tilt in (("holder: printed faces off by 0.1 mm", seated), ("holder: ring askew in its clamp", askew)):
        out.append(Tolerance(name, f"camera tilted by {tilt:.2f}°", tilt_deg=(tilt / math.sqrt(2),) * 2))
    off = math.degrees(0.05 / pulley)
    out.append(Tolerance("printed pulley off by 0.05 mm", f"{off:.2f}° once a turn", harmonics_deg=(off, 0, 0, 0)))
    small = math.degrees(0.05 / pulley)
    out.append(Tolerance("motor's pulley off by 0.05 mm", f"{small:.2f}° twice a turn", harmonics_deg=(0, 0, small, 0)))
    out.append(Tolerance("encoder's magnet: 1° of the motor", "0.5° twice a turn", harmonics_deg=(0, 0, 0, 0.5)))
    body = numbers.rotating(rig)
    lean = numbers.vibration(rig, body)[1]
    out.append(Tolerance("unbalanced, on soft feet", f"camera shaken by {math.degrees(lean):.3f}°", shake=(lean, 0.0)))
    return out


FREED = ((), ("tilt", "wobble"), ("tilt", "wobble", "harmonics"))
"""What calibration frees besides apex and phase, in the columns of the table of errors."""


def error_rows() -> list[tuple[str, ...]]:
    """Return the error that each tolerance costs at 640×480 and 60°."""
    rows = []
    for rig in parts.RIGS:
        for each in tolerances(rig):
            left = [numbers.error(each, free, apex_deg=rig.apex_deg) for free in FREED]
            rows.append((rig.name, each.name, each.size, *(f"{value:.3f}" for value in left)))
    return rows


def simulated_rows() -> list[tuple[str, ...]]:
    """Return the error that ``amiwarp.calibrate`` leaves in simulated recordings, with its default settings."""
    camera = amiwarp.Camera.from_fov(320, 240, math.radians(60))
    prism = amiwarp.Prism(math.radians(1.0), flat_side="camera")
    light = np.kron(np.random.default_rng(0).random((60, 80)), np.ones((8, 8)))
    rows = []
    for name, tilt, wobble, wave in (
        ("as drawn", 0.0, 0.0, 0.0),
        ("wobble 0.4°", 0.0, 0.4, 0.0),
        ("tilt 1°", 1.0, 0.0, 0.0),
        ("tilt 2.3°, a ring askew in its clamp", 2.3, 0.0, 0.0),
        ("angle off by 0.5° twice a turn", 0.0, 0.0, 0.5),
        ("all three", 1.0, 0.4, 0.5),
    ):
        tilts, wobbles = ((math.radians(size) / math.sqrt(2),) * 2 for size in (tilt, wobble))
        motion = amiwarp.PrismMotion(720.0, 0.3, tilt=tilts, wobble=wobbles)
        encoder = amiwarp.EncoderModel(harmonics=(0.0, 0.0, 0.0, math.radians(wave)))
        recording = amiwarp.simulate(light, camera, prism, duration_s=0.35, motion=motion, encoder=encoder, seed=1)
        true = amiwarp.ExactModel(camera, prism, 0.3, tilt=tilts, wobble=wobbles)
        found = amiwarp.calibrate(recording).model
        rows.append((name, f"{amiwarp.predicted_error(found, true, remove_lag=True).rms:.3f}"))
    return rows


def checked(rig: Rig) -> Sequence[Part]:
    """Return the rig's parts, or end with what is wrong with them."""
    if refused := parts.impossible(rig):
        sys.exit(f"{rig.name}: " + "; ".join(refused))
    made = parts.assembly(rig)
    wrong = parts.problems(rig, made)
    wrong += [f"{part.name} is not watertight" for part in made if not numbers.in_file(part).is_watertight]
    if wrong:
        sys.exit(f"{rig.name}: " + "; ".join(wrong))
    return made


def report() -> str:
    """Return all numbers as a page in Markdown."""
    text = [
        "# Rig: numbers\n\n`python -m rig OUT --numbers rig/numbers.md` writes this page. All of it is computed; "
        "nothing was measured on metal.\n"
    ]
    for rig in parts.RIGS:
        text += [f"## Parts: {rig.name}\n\nPrinted parts are taken as solid PETG.\n", list_of_parts(checked(rig))]
    text += [
        "## Balance\n\nAngles of set screws count from the thick edge. Below each: with screws, and the wedge "
        "off the axis by the gap of its seat.\n",
        table(
            (
                "rig, apex",
                "set screws",
                "wedge [g mm]",
                "rotor [g mm]",
                *(f"G at {rpm:.0f} rpm [mm/s]" for rpm in SPEEDS),
                *(f"bearings at {rpm:.0f} rpm, rear / front [N]" for rpm in SPEEDS),
                "path of the rig [µm]",
                "camera's axis [deg]",
            ),
            balance_rows(),
        ),
        f"## Friction at {SPEEDS[0]:.0f} / {SPEEDS[1]:.0f} rpm, and stress at {OVERSPEED:.0f} rpm\n",
        table(
            (
                "rig",
                "bearings",
                "greased [mN m]",
                "oiled [mN m]",
                "glass [MPa]",
                "rotor [MPa]",
                "wedge pulls outwards [N]",
                "50 g shock on the ring [N]",
                "rim [m/s]",
                "energy [J]",
            ),
            speed_rows(),
        ),
        "## Shortest focal length without vignetting\n\nWith the widest field of view, for lenses in the holder. "
        f"Last column: the lens is {OFF} mm off the axis.\n",
        table(
            ("rig", "lens", "lens to wedge [mm]", "sensor", "f/2 [mm]", "f/4 [mm]", f"f/4, off by {OFF} mm [mm]"),
            lens_rows(),
        ),
        "## Error that tolerances cost, apex 1°, 640×480, 60°\n\n"
        "Rms over image and turn [px]. A lens that is off the axis costs nothing that can be seen: "
        f"{OFF} mm move a point at the border by "
        f"{numbers.offset_error(parts.ONE_INCH, OFF, 1000.0):.4f} px if it is 1 m away. "
        "Freed besides apex and phase:\n",
        table(("rig", "what is off", "by", *(", ".join(free) or "nothing" for free in FREED)), error_rows()),
        "## The same by simulation and calibration, apex 1°, 320×240, 60°\n\n"
        "Rms error of what `amiwarp calibrate` finds with its defaults [px].\n",
        table(("what is off", "error"), simulated_rows()),
    ]
    return "\n".join(text)


def balance_text(rig: Rig) -> str:
    """Return the set screws, and the unbalance that they leave."""
    screws, body = numbers.balance(rig, numbers.rotating(rig))
    left, grade = float(np.hypot(*numbers.unbalance(body))), numbers.grade(body, FASTEST)
    text = f"set screws M{rig.screw[1]:g}, angles from the thick edge: {words(screws)}; they leave {left:.2f} g mm"
    if grade <= BALANCED:
        return text
    return (
        f"{text}\nNOT BALANCED: G {grade:.0f} at {FASTEST:g} rpm, more than G {BALANCED:g}; take a smaller apex or "
        "wedge, or turn more slowly"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(prog="python -m rig", description=__doc__)
    parser.add_argument("out", type=Path, help="folder for the files")
    parser.add_argument("--rig", choices=[rig.name for rig in parts.RIGS], help="only this rig")
    parser.add_argument("--apex-deg", type=float, default=1.0, help="apex angle of the wedge [deg]")
    parser.add_argument("--thickness-mm", type=float, help="thickness of the wedge on the axis [mm]")
    parser.add_argument(
        "--lens-mm",
        type=float,
        nargs=2,
        metavar=("WIDTH", "REACH"),
        help="lens: diameter, and length before its ring [mm]",
    )
    parser.add_argument(
        "--grip-mm", type=float, nargs=2, metavar=("DIAMETER", "WIDTH"), help="ring that the holder grips [mm]"
    )
    parser.add_argument("--pictures", action="store_true", help="write drawing and pictures, too")
    parser.add_argument("--numbers", type=Path, help="page of numbers to write; takes some minutes")
    given = parser.parse_args(arguments)
    for rig in parts.RIGS:
        if given.rig not in (None, rig.name):
            continue
        lens, reach = given.lens_mm or (rig.lens, rig.reach)
        thickness, grip = given.thickness_mm or rig.thickness, tuple(given.grip_mm or rig.grip)
        own = replace(rig, apex_deg=given.apex_deg, thickness=thickness, lens=lens, reach=reach, grip=grip)
        made = checked(own)
        folder = given.out / own.name
        folder.mkdir(parents=True, exist_ok=True)
        for part in made:
            if part.kind == "printed":
                numbers.to_mesh(part).export(folder / f"{part.name.replace(' ', '_')}.stl")
        print(f"{folder}: {sum(part.kind == 'printed' for part in made)} parts to print, all watertight, none overlaps")
        print(f"lens: its front is {own.seat_z - own.lens_z:.1f} mm from the wedge")
        print(balance_text(own))
        if given.pictures:
            from rig import drawings

            drawings.drawing(own, made, folder / "drawing.svg")
            drawings.exploded(made, folder / "exploded.png")
            drawings.exploded(made, folder / "whole.png", apart=0.0)
    if given.numbers:
        given.numbers.write_text(report())


if __name__ == "__main__":
    main()
