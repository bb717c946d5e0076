"""Write the rig's printable parts, drawings, pictures and numbers: ``python -m rig OUT``."""

import argparse
import math
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import amiwarp
from rig import bill, drive, files, gimbal, limits, numbers, parts, perfboard
from rig.gimbal import GimbalRig
from rig.numbers import OVERSPEED, SPEEDS, Tolerance, View
from rig.parts import Part, Rig

APEXES = (0.5, 1.0, 2.0)


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table in Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return (
        "\n".join([*lines, *("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows)])
        + "\n"
    )


def list_of_parts(made: Sequence[Part]) -> str:
    """Return the masses of the parts."""
    rows = [
        ("" if part.kind == "screws" else k, part.name, part.kind, f"{part.mass:.1f}")
        for k, part in enumerate(made, 1)
    ]
    return table(
        ("number", "part", "kind", "mass [g]"),
        [*rows, ("", "all", "", f"{sum(p.mass for p in made):.0f}")],
    )


def balance_rows(
    rigs: Sequence[Rig] = parts.RIGS, apexes: Sequence[float] = APEXES
) -> list[tuple[str, ...]]:
    """Return unbalance, grade, forces and vibration of both rigs, for each apex, without and with set screws."""
    rows = []
    for rig in rigs:
        for apex in apexes:
            own = replace(rig, apex_deg=apex)
            body = numbers.rotating(own)
            screws, balanced = numbers.balance(own, body)
            slack = own.seat * numbers.glass_mass(own)
            held = balanced + numbers.point(1e-9, slack / 1e-9, 0.0, own.seat_z + own.thickness / 2)
            for name, each in (
                ("no screws", body),
                (words(screws) + f", wedge off by {own.seat} mm", held),
            ):
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
        greased, oiled = (
            [numbers.friction(rig, rpm, *oil) for rpm in SPEEDS]
            for oil in ((100.0, 1.8), (15.0, 0.8))
        )
        stress = numbers.stress(rig, OVERSPEED)
        rows.append(
            (
                rig.name,
                rig.bearing.name,
                " / ".join(f"{v:.0f}" for v in greased),
                " / ".join(f"{v:.1f}" for v in oiled),
                *(
                    f"{stress[name]:.2f}"
                    for name in ("glass", "rotor", "wedge's pull", "shock", "rim", "energy")
                ),
            )
        )
    return rows


def lens_rows(rigs: Sequence[Rig] = parts.RIGS) -> list[tuple[str, ...]]:
    """Return the shortest focal lengths for each lens."""
    rows = []
    for rig in rigs:
        for lens, own in numbers.lenses(rig).items():
            for name, sensor in numbers.SENSORS.items():
                found = [
                    numbers.shortest_focal(own, sensor, *at) for at in ((2.0,), (4.0,), (4.0, OFF))
                ]
                wide = [
                    math.degrees(2 * math.atan(sensor[0] * sensor[2] / 2 / focal))
                    for focal in found[:2]
                ]
                cells = [
                    f"{f:.1f} ({w:.0f}°)" if w else "none"
                    for f, w in zip(found[:2], wide, strict=True)
                ]
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
    out = [
        Tolerance(
            "bearings with play, not preloaded", f"axis off by {loose:.2f}°", tilt_deg=(loose, 0.0)
        )
    ]
    for name, (seat, race) in wobbles.items():
        total = math.degrees(math.hypot(seat, race))
        half = total / math.sqrt(2)
        size = f"seat {math.degrees(seat):.2f}°, races {math.degrees(race):.2f}°"
        out.append(Tolerance(f"wobble of the wedge, {name} seat", size, wobble_deg=(half, half)))
    wide, long = rig.grip
    seated = math.degrees(math.hypot(0.1 / wide, 0.1 / (rig.bearing.outer + 8.0)))
    askew = math.degrees(0.2 / long)
    for name, tilt in (
        ("holder: printed faces off by 0.1 mm", seated),
        ("holder: ring askew in its clamp", askew),
    ):
        out.append(
            Tolerance(name, f"camera tilted by {tilt:.2f}°", tilt_deg=(tilt / math.sqrt(2),) * 2)
        )
    off = math.degrees(0.05 / pulley)
    out.append(
        Tolerance(
            "printed pulley off by 0.05 mm", f"{off:.2f}° once a turn", harmonics_deg=(off, 0, 0, 0)
        )
    )
    small = math.degrees(0.05 / pulley)
    out.append(
        Tolerance(
            "motor's pulley off by 0.05 mm",
            f"{small:.2f}° twice a turn",
            harmonics_deg=(0, 0, small, 0),
        )
    )
    out.append(
        Tolerance(
            "encoder's magnet: 1° of the motor", "0.5° twice a turn", harmonics_deg=(0, 0, 0, 0.5)
        )
    )
    body = numbers.rotating(rig)
    lean = numbers.vibration(rig, body)[1]
    out.append(
        Tolerance(
            "unbalanced, on soft feet",
            f"camera shaken by {math.degrees(lean):.3f}°",
            shake=(lean, 0.0),
        )
    )
    return out


FREED = ((), ("tilt", "wobble"), ("tilt", "wobble", "harmonics"))
"""What calibration frees besides apex and phase, in the columns of the table of errors."""


def error_rows() -> list[tuple[str, ...]]:
    """Return the error that each tolerance costs at 640×480 and 60°."""
    rows = []
    for drawn in parts.RIGS:
        rig = replace(drawn, apex_deg=1.0)  # as the heading says
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
        recording = amiwarp.simulate(
            light, camera, prism, duration_s=0.35, motion=motion, encoder=encoder, seed=1
        )
        true = amiwarp.ExactModel(camera, prism, 0.3, tilt=tilts, wobble=wobbles)
        found = amiwarp.calibrate(recording).model
        rows.append((name, f"{amiwarp.predicted_error(found, true, remove_lag=True).rms:.3f}"))
    return rows


def checked(rig: Rig, view: View | None = None, rpm: float = max(SPEEDS)) -> Sequence[Part]:
    """Return the rig's parts, or end with what is wrong with them."""
    if refused := limits.refusals(rig, view, rpm):
        sys.exit("\n".join(f"{rig.name}: {line}" for line in refused))
    made = numbers.assembly(rig)
    wrong = parts.problems(rig, made)
    wrong += [
        f"{part.name} is not watertight" for part in made if not numbers.in_file(part).is_watertight
    ]
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
        text += [
            f"## Parts: {rig.name}\n\nPrinted parts are taken as solid PETG.\n",
            list_of_parts(checked(rig)),
        ]
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
            (
                "rig",
                "lens",
                "lens to wedge [mm]",
                "sensor",
                "f/2 [mm]",
                "f/4 [mm]",
                f"f/4, off by {OFF} mm [mm]",
            ),
            lens_rows(),
        ),
        "## Error that tolerances cost, apex 1°, 640×480, 60°\n\n"
        "Rms over image and turn [px]. A lens that is off the axis costs nothing that can be seen: "
        f"{OFF} mm move a point at the border by "
        f"{numbers.offset_error(replace(parts.ONE_INCH, apex_deg=1.0), OFF, 1000.0):.4f} px if it is 1 m away. "
        "Freed besides apex and phase:\n",
        table(
            ("rig", "what is off", "by", *(", ".join(free) or "nothing" for free in FREED)),
            error_rows(),
        ),
        "## The same by simulation and calibration, apex 1°, 320×240, 60°\n\n"
        "Rms error of what `amiwarp calibrate` finds with its defaults [px].\n",
        table(("what is off", "error"), simulated_rows()),
    ]
    return "\n".join(text)


def balance_text(rig: Rig) -> str:
    """Return the set screws, and the unbalance that they leave."""
    screws, body = numbers.balance(rig, numbers.rotating(rig))
    left = float(np.hypot(*numbers.unbalance(body)))
    return f"set screws M{rig.screw[1]:g}, angles from the thick edge: {words(screws)}; they leave {left:.2f} g mm"


def view_text(rig: Rig, view: View | None) -> str:
    """Return what the lens may see through the wedge, and whether this was checked for a given view."""
    if view is not None:
        return f"view: {view.fov_deg:g}° at f/{view.number:g} passes the wedge"
    name, sensor = next(iter(numbers.SENSORS.items()))
    shortest = numbers.shortest_focal(rig, sensor)
    if not math.isfinite(shortest):
        return "view: not checked (--fov-deg); no view of 640×480 pixels of 9 µm passes the wedge at f/2"
    widest = math.floor(10.0 * View(sensor, 1.0, 2.0).degrees(shortest)) / 10.0
    return f"view: not checked (--fov-deg); at most {widest:g}° for {name} at f/2 (--size, --pitch-um, --f-number)"


def arguments_of(given: Sequence[str] | None) -> argparse.Namespace:
    """Return the parsed command line."""
    parser = argparse.ArgumentParser(prog="python -m rig", description=__doc__)
    parser.add_argument("out", type=Path, help="folder for the files")
    parser.add_argument("--rig", choices=[rig.name for rig in gimbal.KINDS], help="only this rig")
    parser.add_argument("--pictures", action="store_true", help="write drawing and pictures, too")
    parser.add_argument(
        "--format",
        nargs="+",
        choices=("stl", "3mf", "step"),
        default=["stl"],
        help="formats of the parts; default stl",
    )
    parser.add_argument(
        "--boards", action="store_true", help="write the wiring and the perfboard plans, too"
    )
    parser.add_argument("--numbers", type=Path, help="page of numbers to write; takes some minutes")

    def sizes(group: argparse._ArgumentGroup, name: str, text: str, *values: str) -> None:
        count = (
            {"nargs": len(values), "metavar": values} if len(values) > 1 else {"metavar": values[0]}
        )
        group.add_argument(name, type=float, help=text, **count)

    wedge = parser.add_argument_group("wedge")
    sizes(
        wedge,
        "--wedge-mm",
        "diameter [mm]; default: 25.4 for one-inch, 50.8 for the others",
        "DIAMETER",
    )
    sizes(wedge, "--thickness-mm", "thickness on the axis [mm]", "THICKNESS")
    sizes(
        wedge,
        "--apex-deg",
        "apex angle [deg]; default: 0.5 for one-inch, 1 for the others",
        "ANGLE",
    )
    sizes(
        wedge,
        "--edges-mm",
        "thin and thick edge [mm], instead of thickness and apex",
        "THIN",
        "THICK",
    )
    sizes(
        wedge,
        "--rpm",
        "fastest speed of the prism, at which it must be balanced; default 1440",
        "RPM",
    )
    lens = parser.add_argument_group("lens and camera")
    sizes(
        lens, "--lens-mm", "lens: diameter, and length before its ring [mm]", "DIAMETER", "LENGTH"
    )
    sizes(lens, "--pupil-mm", "entrance pupil of the lens: distance behind its front [mm]", "DEPTH")
    sizes(
        lens,
        "--grip-mm",
        "ring that the holder grips: diameter and width [mm]",
        "DIAMETER",
        "WIDTH",
    )
    sizes(lens, "--camera-mm", "camera's body [mm]", "WIDTH", "HEIGHT", "LENGTH")
    threads = ("c", "cs", "m12")
    lens.add_argument("--camera-thread", choices=threads, help="thread of the camera; default cs")
    lens.add_argument("--lens-thread", choices=threads, help="thread of the lens")
    sizes(
        lens,
        "--flange-mm",
        "distance from flange to sensor; default 12.526 (cs), 17.526 (c)",
        "DISTANCE",
    )
    view = parser.add_argument_group("view, to check that the wedge is wide enough")
    sizes(
        view, "--fov-deg", "horizontal field of view [deg]; without it no view is checked", "ANGLE"
    )
    view.add_argument(
        "--size", default="640x480", help="columns x rows of the sensor; default 640x480"
    )
    view.add_argument("--pitch-um", type=float, default=9.0, help="pixel pitch [µm]; default 9")
    view.add_argument("--f-number", type=float, default=2.0, help="f-number of the lens; default 2")
    motor = parser.add_argument_group("motor and belt")
    sizes(
        motor,
        "--motor-mm",
        "motor: diameter, length, and diameter of the shaft [mm]",
        "DIAMETER",
        "LENGTH",
        "SHAFT",
    )
    sizes(
        motor,
        "--motor-screws-mm",
        "distance of its two M3 threads, and its boss [mm]",
        "DISTANCE",
        "BOSS",
    )
    motor.add_argument(
        "--teeth", type=int, nargs=2, metavar=("ROTOR", "MOTOR"), help="teeth of both pulleys"
    )
    sizes(motor, "--belt-mm", "length of the belt [mm]", "LENGTH")
    hollow = parser.add_argument_group("hollow-shaft motor, with --rig gimbal")
    sizes(hollow, "--hollow-mm", "outer diameter, height and bore [mm]", "OUTER", "HEIGHT", "BORE")
    sizes(
        hollow,
        "--hollow-screws-mm",
        "circles of its 4 × M3 threads, rear and front [mm]",
        "STATOR",
        "ROTOR",
    )
    sizes(hollow, "--kv", "speed without load for each volt [turns/min/V]", "KV")
    sizes(hollow, "--resistance-ohm", "between two wires [Ω]", "OHM")
    sizes(hollow, "--current-a", "current limit of its driver [A]", "AMPERE")
    sizes(hollow, "--cogging-mnm", "amplitude of its cogging [mN m]", "TORQUE")
    sizes(
        hollow, "--friction-mnm", "friction of its bearings and the encoder's belt [mN m]", "TORQUE"
    )
    hollow.add_argument(
        "--slots-poles",
        type=int,
        nargs=2,
        metavar=("SLOTS", "POLES"),
        help="of its stator and bell",
    )
    return parser.parse_args(given)


def wedge_of(rig: Rig, given: argparse.Namespace) -> Rig:
    """Return a rig with the wedge, the pulleys and the belt of the command line."""
    thickness = rig.thickness if given.thickness_mm is None else given.thickness_mm
    apex = rig.apex_deg if given.apex_deg is None else given.apex_deg
    diameter = rig.wedge if given.wedge_mm is None else given.wedge_mm
    if given.edges_mm is not None:
        if given.thickness_mm is not None or given.apex_deg is not None:
            sys.exit(
                "--edges-mm: thickness and apex follow from the edges; leave out --thickness-mm and --apex-deg"
            )
        thin, thick = given.edges_mm
        if not thick > thin:
            sys.exit(
                f"--edges-mm {thin:g} {thick:g}: the thick edge comes second, and is the thicker one"
            )
        thickness = (thin + thick) / 2.0
        apex = math.degrees(math.atan2(thick - thin, diameter))
    teeth = None if given.teeth is None else tuple(given.teeth)
    own = replace(rig, thickness=thickness, apex_deg=apex)
    if not (math.isfinite(diameter) and diameter > 0.0):
        sys.exit(f"--wedge-mm {diameter:g}: give a number above 0")
    if not isinstance(rig, GimbalRig) and (
        refused := list(limits.bearings(replace(own, wedge=diameter)))
    ):
        sys.exit(f"{rig.name}: " + refused[0])
    return parts.for_wedge(own, diameter, teeth=teeth, belt=given.belt_mm)


def optics_of(rig: Rig, given: argparse.Namespace) -> Rig:
    """Return a rig with the lens and the camera of the command line."""
    lens, reach = given.lens_mm or (rig.lens, rig.reach)
    of_camera = given.camera_thread or rig.threads[0]
    of_lens = given.lens_thread or rig.threads[1]
    if given.lens_mm is not None and given.lens_thread is None:
        # a lens with M12 thread is slimmer than the thread of C-mount
        of_lens = "m12" if lens < limits.THREAD else "c"
    flange = given.flange_mm
    if flange is None:
        flange = limits.FLANGES.get(of_camera, rig.flange)
    return replace(
        rig,
        lens=lens,
        reach=reach,
        pupil=rig.pupil if given.pupil_mm is None else given.pupil_mm,
        grip=tuple(given.grip_mm or rig.grip),
        camera=tuple(given.camera_mm or rig.camera),
        threads=(of_camera, of_lens),
        flange=flange,
    )


def rig_of(rig: Rig, given: argparse.Namespace) -> Rig:
    """Return a rig with the dimensions of the command line."""
    own = replace(
        rig,
        motor=tuple(given.motor_mm or rig.motor),
        motor_screws=tuple(given.motor_screws_mm or rig.motor_screws),
    )
    hollow = hollow_of(given)
    if isinstance(own, GimbalRig):
        if given.motor_mm or given.motor_screws_mm:
            sys.exit(
                "--motor-mm, --motor-screws-mm: the gimbal has no such motor; give --hollow-mm, --hollow-screws-mm"
            )
        own = replace(own, hollow=replace(own.hollow, **hollow))
    elif hollow and given.rig is not None:
        sys.exit(f"--rig {given.rig}: options of the hollow-shaft motor belong to --rig gimbal")
    return wedge_of(optics_of(own, given), given)


def hollow_of(given: argparse.Namespace) -> dict[str, float | int]:
    """Return the fields of the hollow-shaft motor that the command line gives."""
    fields: dict[str, float | int] = {}
    if given.hollow_mm:
        fields |= dict(zip(("outer", "height", "bore"), given.hollow_mm, strict=True))
    if given.hollow_screws_mm:
        fields |= dict(zip(("stator_circle", "rotor_circle"), given.hollow_screws_mm, strict=True))
    if given.slots_poles:
        fields |= dict(zip(("slots", "poles"), given.slots_poles, strict=True))
    for name, value in (
        ("kv", given.kv),
        ("resistance", given.resistance_ohm),
        ("current", given.current_a),
        ("cogging", given.cogging_mnm),
        ("friction", given.friction_mnm),
    ):
        if value is not None:
            fields[name] = value
    return fields


def view_of(given: argparse.Namespace) -> View | None:
    """Return the view of the command line, or None if its field of view is not given."""
    if given.fov_deg is None:
        return None
    size = re.fullmatch(r"(\d+)x(\d+)", given.size)
    if size is None or not (int(size[1]) and int(size[2])):
        sys.exit(f"--size {given.size}: give COLUMNSxROWS, for example 640x480")
    for name, value, most in (
        ("--fov-deg", given.fov_deg, 170.0),
        ("--pitch-um", given.pitch_um, 1e3),
        ("--f-number", given.f_number, 1e3),
    ):
        if not 0.0 < value <= most:
            sys.exit(f"{name} {value:g}: give a number above 0, at most {most:g}")
    return View((int(size[1]), int(size[2]), given.pitch_um * 1e-3), given.fov_deg, given.f_number)


def said(rig: Rig, given: argparse.Namespace) -> list[str]:
    """Return lines about what was chosen without an option."""
    lines = []
    if rig.belt != given.belt_mm or given.teeth is None:
        large, small = rig.teeth
        lines.append(
            f"belt {rig.belt:g} mm (--belt-mm), pulleys of {large} and {small} teeth (--teeth)"
        )
    of_camera, of_lens = (name.upper() for name in rig.threads)
    lines.append(
        f"lens: its front is {rig.seat_z - rig.lens_z:.1f} mm from the wedge; {of_lens} on a camera with {of_camera} "
        f"(--lens-thread, --camera-thread), sensor {rig.flange:g} mm behind its flange (--flange-mm), pupil "
        f"{rig.pupil:g} mm behind the lens's front (--pupil-mm)"
    )
    return lines


def write_part(part: Part, folder: Path, formats: Sequence[str]) -> None:
    """Write a part in each format."""
    out = folder / part.name.replace(" ", "_")
    if "stl" in formats:
        files.write_stl(part.solid, out.with_suffix(".stl"))
    if "3mf" in formats:
        files.write_3mf([(part.name, part.solid)], out.with_suffix(".3mf"))
    if "step" in formats:
        files.write_step(part.name, [(part.name, part.solid)], out.with_suffix(".step"))


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the files."""
    given = arguments_of(arguments)
    view = view_of(given)
    rpm = max(SPEEDS) if given.rpm is None else given.rpm
    for rig in gimbal.KINDS:
        if given.rig not in (None, rig.name):
            continue
        own = rig_of(rig, given)
        made = checked(own, view, rpm)
        folder = given.out / own.name
        folder.mkdir(parents=True, exist_ok=True)
        printed = [part for part in made if part.kind == "printed"]
        for part in printed:
            write_part(part, folder, given.format)
        files.written(folder / "bill.csv", bill.of_rig(own).encode())
        print(
            f"{folder}: {len(printed)} parts to print, all watertight, none overlaps; {', '.join(given.format)}"
        )
        lines = [*said(own, given), view_text(own, view), balance_text(own)]
        if isinstance(own, GimbalRig):
            lines += drive.text(drive.drive_of(own))
        for line in lines:
            print(line)
        if given.pictures:
            from rig import drawings

            drawings.drawing(own, made, folder / "drawing.svg")
            drawings.exploded(made, folder / "exploded.png")
            drawings.exploded(made, folder / "whole.png", apart=0.0)
    if given.boards:
        names = perfboard.write(given.out)
        print(f"{given.out}: {', '.join(names)}")
    if given.numbers:
        given.numbers.write_text(report(), encoding="utf-8")


if __name__ == "__main__":
    main()
