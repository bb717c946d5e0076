"""What cannot be built: each dimension is checked, and refused in a line with its option, its value and the nearest one
that can be built.

All lengths are in millimetres. What follows from the shapes themselves (a part that touches another one) is found
afterwards by :func:`rig.parts.problems`, on the solids.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

from rig import gimbal, numbers, parts
from rig.drive import SUPPLY, Drive
from rig.gimbal import GimbalRig
from rig.numbers import View
from rig.parts import BEARINGS, HEADS, LEAST_WALL, SLIDE, Rig

LEAST_EDGE = 0.5
"""Smallest thickness of the wedge at its thin edge. Thinner glass chips."""
LEAST_HEIGHT = 10.0
"""Smallest height of a hollow-shaft motor."""
LEAST_GRIP = 3.0
"""Smallest width of the ring that the holder grips. On a shorter one the camera tilts."""
FLANGES = {"c": 17.526, "cs": 12.526}
"""Distance from the thread's flange to the sensor, of C-mount and CS-mount."""
THREAD = 25.4
"""Outer diameter of the thread 1"-32 UN of both mounts."""
FOCUS = 0.05
"""Error of the flange distance that a lens can focus out: it moves its image plane by as much."""
BALANCED = 2.5
"""Balance quality G of ISO 21940-11 [mm/s] of a rotor that is called balanced."""


def refusals(rig: Rig, view: View | None = None, rpm: float = max(numbers.SPEEDS)) -> list[str]:
    """Return what cannot be built; nothing if all can.

    Parameters
    ----------
    view : View or None
        What the camera sees; without it, no beam is checked.
    rpm : float
        Fastest speed of the prism [turns/min], at which it must be balanced.
    """
    drive = (hollow(rig, rpm),) if isinstance(rig, GimbalRig) else (bearings(rig), motor(rig))
    for check in (sizes(rig), *drive, glass(rig), rotor(rig), camera(rig), lens(rig)):
        # Later checks take for granted what earlier ones have found.
        if found := list(check):
            return found
    found = [] if view is None else list(beam(rig, view))
    return found or list(balance(rig, rpm))


def sizes(rig: Rig) -> Iterator[str]:
    """Refuse lengths that are not positive numbers."""
    values = {
        "--wedge-mm": (rig.wedge,),
        "--thickness-mm": (rig.thickness,),
        "--lens-mm": (rig.lens, rig.reach),
        "--grip-mm": rig.grip,
        "--camera-mm": rig.camera,
        "--flange-mm": (rig.flange,),
        "--motor-mm": rig.motor,
        "--motor-screws-mm": rig.motor_screws,
        "--belt-mm": (rig.belt,),
        "--teeth": (float(rig.teeth[0]), float(rig.teeth[1])),
    }
    for option, given in values.items():
        for value in given:
            if not (math.isfinite(value) and value > 0.0):
                yield f"{option} {value:g}: give a number above 0"
    if not (math.isfinite(rig.pupil) and 0.0 <= rig.pupil <= rig.reach + FLANGES["c"]):
        yield (
            f"--pupil-mm {rig.pupil:g}: the entrance pupil is said to lie outside the lens; give its distance behind "
            f"the lens's front, 0 to {rig.reach + FLANGES['c']:.1f}"
        )


def glass(rig: Rig) -> Iterator[str]:
    """Refuse wedges that cannot be ground or held."""
    if not 0.0 < rig.apex_deg < 90.0:
        yield (
            f"--apex-deg {rig.apex_deg:g}: give an angle above 0 and below 90; the thick edge is at 0° of the rotor, "
            "whatever the sign"
        )
        return
    if rig.thin_edge < LEAST_EDGE:
        least = math.ceil(10.0 * (rig.thickness - rig.thin_edge + LEAST_EDGE) - 1e-9) / 10.0
        yield (
            f"--thickness-mm {rig.thickness:g}: with an apex of {rig.apex_deg:g}° the thin edge is "
            f"{rig.thin_edge:.2f} mm, and {LEAST_EDGE:g} mm are needed; give {least:.1f} or more on the "
            "axis, or a smaller apex"
        )
    if rig.edge > (thickest := rig.thickest_edge) + 1e-9:
        slope = rig.edge - rig.thickness
        yield (
            f"--thickness-mm {rig.thickness:g}: the thick edge of {rig.edge:.2f} mm leaves the rotor no shoulder "
            f"behind the wedge; give at most {math.floor(10.0 * (thickest - slope)) / 10.0:.1f} on the axis"
        )


def bearings(rig: Rig) -> Iterator[str]:
    """Refuse wedges around which no bearing fits."""
    largest = largest_wedge(rig)
    if rig.wedge > largest + 1e-9:
        yield (
            f"--wedge-mm {rig.wedge:g}: no bearing of series {rig.series} leaves a wall of {rig.wall:g} mm around its "
            f"seat; give at most {largest:.1f}"
        )


def largest_wedge(rig: Rig) -> float:
    """Return the diameter of the largest wedge for which there is a bearing."""
    return max(each.bore for each in BEARINGS if each.name.startswith(rig.series)) - 2.0 * (
        rig.seat + rig.wall
    )


def rotor(rig: Rig) -> Iterator[str]:
    """Refuse pulleys whose walls are too thin beside the wedge's seat, and screws that run into each other.

    The screws of the wedge's ring, and the set screws, stand on one circle between the seat and the roots of the
    teeth. The wall beside a hole of diameter d on radius r is half of the ring's width, less d / 2; between two holes
    that are 15° apart it is 2 r sin 7.5° - d.
    """
    least = parts.least_teeth(rig.wedge, rig.seat, rig.screw[0])
    if rig.teeth[0] < least:
        yield (
            f"--teeth {rig.teeth[0]} {rig.teeth[1]}: beside the seat of a wedge of {rig.wedge:g} mm, the screws would "
            f"overlap or leave walls below {LEAST_WALL:g} mm; give {least} {least // 2} or more"
        )
    if rig.teeth[0] != 2 * rig.teeth[1]:
        even = 2 * math.ceil(max(rig.teeth[0], least) / 2)
        yield (
            f"--teeth {rig.teeth[0]} {rig.teeth[1]}: the ratio is not 2, so errors of the motor's side would not "
            f"repeat with the prism; give {even} {even // 2}"
        )


def motor(rig: Rig) -> Iterator[str]:
    """Refuse motors that touch housing or camera, or whose pulley, screws or boss leave no wall."""
    body, _, shaft = rig.motor
    spacing, boss = rig.motor_screws
    root = rig.pitch(rig.teeth[1]) - parts.PITCH_LINE - parts.TOOTH_DEPTH
    thickest = 2.0 * (root - LEAST_WALL - 2.0)  # 2 mm of thread for the set screw
    if shaft > thickest + 1e-9:
        yield (
            f"--motor-mm, shaft {shaft:g}: the motor's pulley of {rig.teeth[1]} teeth has no wall left; "
            f"give at most {math.floor(10.0 * thickest + 1e-9) / 10.0:.1f}, or more teeth"
        )
    if shaft > boss:
        yield f"--motor-screws-mm, boss {boss:g}: it is thinner than the shaft; give at least {shaft:g}"
    sunk = HEADS[3.0][0] / 2 + 0.15
    least = boss + 0.2 + 2.0 * (sunk + LEAST_WALL)
    if spacing < least - 1e-9:
        yield (
            f"--motor-screws-mm, distance {spacing:g}: the heads of the screws overlap the boss of {boss:g} mm, or "
            f"leave less than {LEAST_WALL:g} mm; give at least {least:.1f}, or a thinner boss"
        )
    if spacing + 3.0 > body:
        yield f"--motor-screws-mm, distance {spacing:g}: outside the motor of {body:g} mm; give at most {body - 3.0:g}"
    if beside_motor(rig) < 0.0:
        widest = largest(lambda width: replace(rig, camera=(width, *rig.camera[1:])), rig.camera[0])
        thickest = largest(lambda size: replace(rig, motor=(size, *rig.motor[1:])), body)
        slimmest = largest(lambda size: replace(rig, lens=size), rig.lens)
        ways = [
            f"a camera of at most {widest:.1f}" if widest else "",
            f"a lens of at most {slimmest:.1f}" if slimmest and slimmest < rig.lens - 0.1 else "",
            f"a motor of at most {thickest:.1f}" if thickest else "",
            longer_belt(rig),
        ]
        nearest = ", or ".join(way for way in ways if way)
        yield (
            f"--camera-mm, width {rig.camera[0]:g}, --lens-mm, diameter {rig.lens:g}, and --motor-mm, diameter "
            f"{body:g}: with the belt slack, the motor touches camera, holder or housing; give {nearest}"
        )


def hollow(rig: GimbalRig, rpm: float) -> Iterator[str]:
    """Refuse hollow-shaft motors whose screws do not fit beside bore and wedge, that are too wide, or too slow."""
    own = rig.hollow
    for option, values in (
        ("--hollow-mm", (own.outer, own.height, own.bore)),
        ("--hollow-screws-mm", (own.stator_circle, own.rotor_circle)),
        ("--kv", (own.kv,)),
        ("--resistance-ohm", (own.resistance,)),
        ("--current-a", (own.current,)),
    ):
        for value in values:
            if not (math.isfinite(value) and value > 0.0):
                yield f"{option} {value:g}: give a number above 0"
                return
    if own.height < LEAST_HEIGHT:
        yield f"--hollow-mm, height {own.height:g}: too flat for stator and bell; give at least {LEAST_HEIGHT:g}"
        return
    sunk = gimbal.SUNK + LEAST_WALL
    inner, outer = own.bore + 2.0 * sunk, own.outer - 14.0
    if inner > outer:
        yield (
            f"--hollow-mm, bore {own.bore:g}: beside it, a motor of {own.outer:g} mm has no room for the housing's "
            f"screws; give at most {outer - 2.0 * sunk:.1f}, or a motor of at least {inner + 14.0:.1f}"
        )
    elif not inner - 1e-9 <= own.stator_circle <= outer + 1e-9:
        yield (
            f"--hollow-screws-mm, stator {own.stator_circle:g}: beside a bore of {own.bore:g} mm and within the motor "
            f"of {own.outer:g} mm, the housing's screws need a circle of {inner:.1f} to {outer:.1f}; give one of them"
        )
    head = HEADS[3.0][0] / 2 + 0.15
    widest = rig.wedge + 2.0 * (rig.seat - head)
    least = own.bore + 3.0 + 2.0 * LEAST_WALL
    if least > widest:
        yield (
            f"--wedge-mm {rig.wedge:g}: under it there is no room for the cell's screws beside a bore of {own.bore:g} "
            f"mm; give at least {rig.wedge + least - widest:.1f}, or a narrower bore (--hollow-mm)"
        )
    elif not least - 1e-9 <= own.rotor_circle <= widest + 1e-9:
        yield (
            f"--hollow-screws-mm, rotor {own.rotor_circle:g}: the heads of the cell's screws must lie under the wedge "
            f"of {rig.wedge:g} mm, and beside the bore of {own.bore:g} mm; give {least:.1f} to {widest:.1f}, or "
            "another wedge"
        )
    if beside_motor(rig) < 0.0:
        widest = largest(lambda size: replace(rig, hollow=replace(own, outer=size)), own.outer)
        camera_width = largest(
            lambda width: replace(rig, camera=(width, *rig.camera[1:])), rig.camera[0]
        )
        ways = [
            f"a motor of at most {widest:.1f}" if widest else "",
            f"a camera of at most {camera_width:.1f}" if camera_width else "",
            longer_belt(rig),
        ]
        nearest = ", or ".join(way for way in ways if way)
        yield (
            f"--hollow-mm, outer diameter {own.outer:g}, and --camera-mm, width {rig.camera[0]:g}: camera, housing or "
            f"index flag touches the encoder shaft's side; give {nearest}"
        )
    slim = 2.0 * (own.bore / 2 - 2.0 - LEAST_WALL - 1.0)
    if rig.lens > slim + 1e-9:
        yield (
            f"--lens-mm, diameter {rig.lens:g}: the bore of {own.bore:g} mm (--hollow-mm) is too narrow for it and the "
            f"holder's spigot; give at most {slim:.1f}, or a wider bore"
        )
    torques = own.friction, own.cogging
    if (
        not all(math.isfinite(value) and value >= 0.0 for value in torques)
        or own.slots < 1
        or own.poles < 2
    ):
        yield "--friction-mnm, --cogging-mnm, --slots-poles: give numbers that are not negative"
        return
    engine = Drive(own, 1.0)  # its speed does not depend on the inertia
    if engine.fastest < rpm:
        yield (
            f"--rpm {rpm:g}: with --kv {own.kv:g}, {SUPPLY:g} V and its friction, the motor reaches "
            f"{engine.fastest:.0f} rpm; give at most that, or --kv {math.ceil(own.kv * rpm / engine.fastest * 1.05):d}"
            if engine.fastest
            else f"--current-a {own.current:g}: {1e3 * engine.torque:.0f} mN m do not overcome the friction of "
            f"{own.friction:g} mN m (--friction-mnm); give {own.friction * 1e-3 / engine.constant * 1.5:.1f} or more"
        )


STILL = 0.3
"""Smallest gap between two parts that do not turn."""


def beside_motor(rig: Rig) -> float:
    """Return the smallest gap between motor with its plate and what stands beside it, less :data:`STILL`.

    The motor is where it slackens the belt. Its pulley must also stay away from the index flag. Holder and housing are
    hulls of circles: barrel, and eyes of the screws.
    """
    x = parts.holder_screws(rig)[0][0]
    at = rig.distance - SLIDE
    body = rig.motor[0] / 2
    eye, barrel = (at - 8.0, body + 3.0), (0.0, 0.0, rig.barrel + 4.0)
    gaps = (
        numbers.to_hull((at, 0.0), (barrel, (x, x, 4.0), (x, -x, 4.0))) - body,
        numbers.to_hull((at, 0.0), (barrel, (x, x, 3.2))) - body,
        at - body - parts.clamp_radius(rig),
        numbers.to_hull(eye, (barrel, (x, x, 3.2))) - 4.5,
        at - body - rig.camera[0] / 2,
        at - rig.pitch(rig.teeth[1]) - 1.2 - rig.flag - rig.clearance + STILL,
    )
    return min(gaps) - STILL


def longer_belt(rig: Rig) -> str:
    """Return the shortest belt that leaves room beside the motor, as words; nothing if none up to 600 mm does."""
    lengths = (float(length) for length in range(2 * math.ceil(rig.belt / 2), 602, 2))
    length = next((each for each in lengths if beside_motor(replace(rig, belt=each)) >= 0.0), None)
    return "" if length is None else f"a belt of at least {length:g} mm (--belt-mm)"


def largest(of: Callable[[float], Rig], value: float) -> float:
    """Return the largest value below one that leaves room beside the motor, a multiple of 0.1; 0 if none does."""
    tenths = range(math.floor(10.0 * value), 0, -1)
    return next((tenth / 10.0 for tenth in tenths if beside_motor(of(tenth / 10.0)) >= 0.0), 0.0)


def camera(rig: Rig) -> Iterator[str]:
    """Refuse cameras that touch the base, and rings that do not fit between camera and lens."""
    tall = rig.camera[1]
    tallest = 2.0 * (rig.height - rig.clearance)
    if tall > tallest + 1e-9:
        yield (
            f"--camera-mm, height {tall:g}: the camera touches the base; give at most "
            f"{math.floor(10.0 * tallest) / 10.0:.1f}"
        )
    of_camera, of_lens = rig.threads
    wide, long = rig.grip
    if of_camera == "m12":
        yield (
            "--camera-thread m12: the thread is on the camera's board, and no holder is drawn for it; give c or cs, "
            "with an adapter to M12 if the lens needs one"
        )
        return
    if of_lens in FLANGES:
        ring = FLANGES[of_lens] - rig.flange
        if ring < -FOCUS:
            yield (
                f"--flange-mm {rig.flange:g}: a lens with {of_lens.upper()}-mount must be {FLANGES[of_lens]:g} mm "
                f"from the sensor, and this camera keeps it further away; give at most "
                f"{FLANGES[of_lens]:g}, or another lens"
            )
        elif FOCUS < ring < LEAST_GRIP:
            yield (
                f"--flange-mm {rig.flange:g}: the ring of {ring:.3f} mm between this camera and a lens with "
                f"{of_lens.upper()}-mount is too narrow for the clamp, which needs {LEAST_GRIP:g} mm; give at most "
                f"{FLANGES[of_lens] - LEAST_GRIP:g}, or {FLANGES[of_lens]:g} and grip the lens itself"
            )
        elif ring > FOCUS and abs(long - ring) > FOCUS:
            yield (
                f"--grip-mm, width {long:g}: between a flange distance of {rig.flange:g} mm and a lens with "
                f"{of_lens.upper()}-mount belongs a ring of {ring:.3f} mm, else it does not focus; give {ring:.2f}"
            )
    if wide < THREAD + 2 * LEAST_WALL - 1e-9:
        yield (
            f"--grip-mm, diameter {wide:g}: a ring around the thread of {THREAD:g} mm has no wall; give at least "
            f"{THREAD + 2 * LEAST_WALL:.1f}"
        )
    if long < LEAST_GRIP:
        yield f"--grip-mm, width {long:g}: the clamp needs {LEAST_GRIP:g} mm or more; give {LEAST_GRIP:g}"


def lens(rig: Rig) -> Iterator[str]:
    """Refuse lenses and rings that leave the holder no wall beside its screws."""
    corner = math.hypot(*parts.holder_screws(rig)[0])
    widest = 2.0 * (
        corner - 2.6 - LEAST_WALL - 1.0
    )  # holes of 5.2 mm for the heads, and 1 mm of air around the lens
    for option, value in (("--lens-mm, diameter", rig.lens), ("--grip-mm, diameter", rig.grip[0])):
        if value > widest + 1e-9:
            yield (
                f"{option} {value:g}: the holder has no wall left beside its screws; give at most "
                f"{math.floor(10.0 * widest) / 10.0:.1f}, or a wider camera"
            )


def beam(rig: Rig, view: View) -> Iterator[str]:
    """Refuse views of which an aperture cuts off a part.

    From the rim of the entrance pupil, the outermost rays are r = p + (z - z₀) tan β off the axis at z, with the
    pupil's radius p = f / 2N at z₀; behind the wedge, :class:`amiwarp.ExactModel` gives their direction. See
    :func:`rig.numbers.clear_of_stops`.
    """
    short = -numbers.clear_of_stops(rig, view.sensor, view.focal, view.number)
    if short <= 0.0:
        return
    shortest = numbers.shortest_focal(rig, view.sensor, view.number)
    best = "no view is free at this f-number; close the aperture (--f-number)"
    if math.isfinite(shortest):
        best = f"give at most {math.floor(10.0 * view.degrees(shortest)) / 10.0:.1f}"
    wider = math.ceil(10.0 * (rig.wedge + 2.0 * short)) / 10.0
    if wider <= largest_wedge(rig):
        best += f", or a wedge of at least {wider:.1f} (--wedge-mm)"
    yield (
        f"--fov-deg {view.fov_deg:g}: with the pupil {rig.pupil:g} mm behind the lens's front (--pupil-mm) and at "
        f"f/{view.number:g}, the rim of the beam is {short:.1f} mm outside the aperture of a wedge of {rig.wedge:g} "
        f"mm; {best}, or a lens that stands nearer to it"
    )


def balance(rig: Rig, rpm: float) -> Iterator[str]:
    """Refuse wedges whose unbalance the set screws do not take up."""
    if not (math.isfinite(rpm) and 0.0 < rpm <= numbers.OVERSPEED):
        yield f"--rpm {rpm:g}: give a speed above 0, at most {numbers.OVERSPEED:g}"
        return
    grade = balanced_grade(rig)
    if grade * rpm <= BALANCED:
        return
    yield (
        f"--apex-deg {rig.apex_deg:g}: with all set screws the rotor has G {grade * rpm:.1f} at {rpm:g} rpm, more than "
        f"G {BALANCED:g}; give at most {largest_apex(rig, rpm):.1f}, a smaller wedge, or --rpm "
        f"{math.floor(BALANCED / grade / 10.0) * 10:d}"
    )


def balanced_grade(rig: Rig) -> float:
    """Return the balance quality G with the best set screws, for each turn per minute [mm/s min]."""
    _, body = numbers.balance(rig, numbers.rotating(rig))
    return numbers.grade(body, 1.0)


def largest_apex(rig: Rig, rpm: float) -> float:
    """Return the largest apex angle that the set screws balance [deg], a multiple of 0.1 below the rig's own.

    Beyond what the screws take up, the unbalance grows in proportion to tan α.
    """
    body = numbers.rotating(rig)
    _, screwed = numbers.balance(rig, body)
    left = numbers.grade(screwed, rpm) - BALANCED
    per_tan = (
        numbers.wedge_unbalance(rig)
        / math.tan(math.radians(rig.apex_deg))
        / screwed.mass
        * numbers.omega(rpm)
    )
    apex = math.degrees(math.atan(math.tan(math.radians(rig.apex_deg)) - left / per_tan))
    tenth = math.floor(10.0 * apex)
    while tenth > 1 and balanced_grade(replace(rig, apex_deg=tenth / 10.0)) * rpm > BALANCED:
        tenth -= 1
    return tenth / 10.0
