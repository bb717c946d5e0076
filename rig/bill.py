"""Bill of materials of a rig with its own dimensions, as a table and as CSV.

A part number is given only where a public source names it; the source is beside it. Other parts have a specification.
"""

import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass

import amiwarp
from rig import gimbal, numbers, parts, wires
from rig.gimbal import GimbalRig
from rig.numbers import View
from rig.parts import Rig


@dataclass(frozen=True)
class Item:
    """A row of the bill."""

    number: str
    """Number in the pictures, empty if it is not in them."""
    part: str
    quantity: str
    specification: str
    example: str = ""
    """Part number or type, and who names it."""


HEAD = ("number", "part", "quantity", "specification", "part number or example")

SCREWS = {
    "screws of the cap": (3, "M3×6", ""),
    "screws of the cover": (4, "M3×8", ""),
    "screws of the wedge ring": (4, "M2×8", ""),
    "screws of the rear ring": (3, "M2×8", "countersunk"),
    "screws of the holder": (4, "M2.5×8", ""),
    "screw of the clamp": (1, "M2.5×16", "with nut"),
    "screws of the motor plate": (2, "M3×8", ""),
    "screws of the encoder block": (2, "M3×8", ""),
    "screws of the cell": (4, "M3×5", ""),
    "screws of the base": (4, "M4×12", ""),
    "screws of the fork barrier": (2, "M2×5", ""),
    "screws of the encoder board": (2, "M2.5×8", "with nuts"),
}
"""Screws by their names in the assembly: number, size, and what else."""
MOTOR_SCREWS = {"belt": (2, "M3×6", "countersunk"), "gimbal": (4, "M3×8", "countersunk")}


def screws_of(rig: Rig) -> dict[str, tuple[int, str, str]]:
    """Return number, size and kind of the screws in a rig's assembly, by their names."""
    own = {
        **SCREWS,
        "screws of the motor": MOTOR_SCREWS["gimbal" if isinstance(rig, GimbalRig) else "belt"],
    }
    return {part.name: own[part.name] for part in numbers.assembly(rig) if part.kind == "screws"}


def mechanics(rig: Rig) -> list[Item]:
    """Return the mechanical parts of a rig, in the order of their numbers."""
    made = numbers.assembly(rig)
    at = {part.name: str(k) for k, part in enumerate(made, 1) if part.kind != "screws"}
    bought = {item.part: item for item in bought_parts(rig)}
    out = []
    for part in made:
        if part.kind == "screws":
            continue
        if part.kind == "printed":
            volume = part.solid.volume() / 1e3
            spec = f"printed: {part.name.replace(' ', '_')}.stl, {volume:.1f} cm³, {part.mass:.0f} g if solid"
            out.append(Item(at[part.name], part.name, "1", spec))
            continue
        item = bought[part.name]
        out.append(Item(at[part.name], item.part, item.quantity, item.specification, item.example))
    sizes: dict[tuple[str, str], list[str]] = {}
    for name, (count, size, kind) in screws_of(rig).items():
        sizes.setdefault((size, kind), []).append(f"{count} {name}")
    for (size, kind), uses in sorted(sizes.items()):
        total = sum(int(use.split()[0]) for use in uses)
        sunk = kind == "countersunk"
        head = "ISO 7046, 90°" if sunk else "ISO 4762"
        more = f", {kind}" if kind.startswith("with") else ""
        name = f"screw {size}{' countersunk' if sunk else ''}"
        out.append(Item("", name, str(total), f"{head}{more}: {'; '.join(uses)}"))
    pulley = "encoder pulley" if isinstance(rig, GimbalRig) else "motor pulley"
    out += [
        Item("", "set screw M3×5", "1", f"ISO 4026, in the {pulley}"),
        Item(
            "",
            f"set screw M{rig.screw[1]:g}, 3 to 8 mm",
            "up to 12",
            "ISO 4026; which ones, the command prints",
        ),
        Item(
            "",
            "foot",
            "4",
            "soft rubber, higher than 8 mm, with an M4 stud of 10 mm or more and a nut",
        ),
        Item(
            "",
            "board of the fork barrier",
            "1",
            "perfboard 20 × 16 mm, 1.6 mm thick: see “Two small boards”",
        ),
        Item("", "tape", "", "black, over the slits of the holder"),
        Item("", "glue, thread locker", "", consumables(rig)),
    ]
    return out


def consumables(rig: Rig) -> str:
    """Return what glue and oil are for."""
    if isinstance(rig, GimbalRig):
        return "retaining compound for both 625 bearings and the shaft in them; glue for cup and magnet; thread locker"
    return (
        "glue for cup and magnet; thread locker; white spirit and instrument oil for the bearings"
    )


FOCALS = (6.0, 8.0, 12.0, 16.0, 25.0, 35.0, 50.0)
"""Usual focal lengths of fixed lenses [mm]."""


def lens_item(rig: Rig) -> Item:
    """Return the lens, with the shortest focal length that this rig allows, at f/2 or else at f/4."""
    thread = rig.threads[1]
    m12 = thread == "m12"
    name = {"m12": "M12 × 0.5", "c": "C-mount", "cs": "CS-mount"}[thread]
    sensor_name, sensor = next(iter(numbers.SENSORS.items()))
    number = 2.0
    shortest = numbers.shortest_focal(rig, sensor, number)
    if not math.isfinite(shortest):
        number = 4.0
        shortest = numbers.shortest_focal(rig, sensor, number)
    limit = "no focal length is free of vignetting, even at f/4"
    if math.isfinite(shortest):
        widest = math.floor(10.0 * View(sensor, 1.0, number).degrees(shortest)) / 10.0
        limit = (
            f"**focal length at least {shortest:g} mm** for {sensor_name} at f/{number:g} (sees {widest:g}°); for "
            "another sensor see the numbers"
        )
    held = (
        "fixed aperture, and a lock nut or locking screw for the focus"
        if m12
        else "locking screws for both rings"
    )
    usual = next((focal for focal in FOCALS if focal >= shortest), None)
    kind = "M12 lens" if m12 else "fixed lens for machine vision"
    example = ""
    if usual is not None:
        sees = View(sensor, 1.0, number).degrees(usual)
        example = f"{kind}, {usual:g} mm (sees {sees:.1f}°) or longer"
    spec = (
        f"{name}, at most {rig.lens:g} mm wide, {rig.reach:g} mm before its ring; {limit}; {held}"
    )
    return Item("", "lens", "1", spec, example)


def bought_parts(rig: Rig) -> list[Item]:
    """Return what is bought, with the numbers that matter."""
    width, tall, _ = rig.camera
    of_camera, of_lens = rig.threads
    what = "adapter to M12" if of_lens == "m12" else f"ring to {of_lens.upper()}-mount"
    wide, long = rig.grip
    deviation = amiwarp.Prism(math.radians(rig.apex_deg)).deflection
    common = [
        Item(
            "",
            "mount ring",
            "1",
            f"{what}, {of_camera.upper()} thread (1 inch × 32 UN) towards the camera, {long:g} mm long, ⌀ {wide:g} mm, "
            "of metal, without knurls: the holder grips it",
        ),
        Item(
            "",
            "camera",
            "1",
            f"event camera with {of_camera.upper()}-mount ({rig.flange:g} mm from flange to sensor), trigger input, "
            f"body at most {width:g} mm wide and {tall:g} mm high, its front flat beside the mount",
            "DVXplorer, DAVIS346, EVK4 (compare mount and size)",
        ),
        Item(
            "",
            "belt",
            "1",
            f"GT2, 6 mm wide, closed, {rig.belt:g} mm ({rig.belt / 2:.0f} teeth)",
            "as for 3D printers",
        ),
        Item(
            "",
            "magnet",
            "1",
            "⌀ 6 × 2 mm, NdFeB, magnetised across its diameter; 35 to 70 mT at the chip, 1.1 mm from its axis; one of "
            "2.5 mm stands 0.5 mm nearer to the chip, which may be",
            "Radial Magnets 9042 (named by the manual of a JCS encoder board)",
        ),
        Item(
            "",
            "wedge",
            "1",
            f"⌀ {rig.wedge:g} mm, + 0 / − 0.1 mm; N-BK7, antireflection coating, {rig.thickness:g} ± 0.1 mm thick on "
            f"the axis; apex (angle between its faces) {rig.apex_deg:g}°, which deviates by "
            f"{math.degrees(deviation):.2f}°: shops name either; one face square to the rim within 0.1°",
            f"“wedge prism” of {math.degrees(deviation):.2f}° deviation, or “wedged window” of "
            f"{60.0 * rig.apex_deg:.0f} arcmin: ask for the thickness on the axis",
        ),
        Item(
            "",
            "fork barrier",
            "1",
            f"slot {parts.FORK_SLOT:g} mm wide, {parts.FORK_SLOT_DEPTH:g} mm deep; body at most "
            f"{parts.FORK_WIDTH:g} mm wide across the slot, {parts.FORK_LENGTH:g} mm long, {parts.FORK_DEPTH:g} mm "
            "high above its board; leads 2.54 mm apart on each side; phototransistor with 0.5 mA or more at 20 mA of "
            "its LED",
            "Omron EE-SX1041 (its data sheet)",
        ),
        Item(
            "",
            "encoder board",
            "1",
            "14 bit, SPI, at most 22 × 28 mm, chip in its middle; two holes of 2.7 mm on its long middle line, 23 mm "
            "apart: see “Two small boards”",
            "with ams AS5047P",
        ),
        Item(
            "",
            "O-ring",
            "1",
            f"silicone, soft, {rig.wedge - 1.9:.1f} mm inside × 1 mm, or cord of 1 mm, "
            f"{math.pi * (rig.wedge - 0.9):.0f} mm long",
        ),
        lens_item(rig),
    ]
    if isinstance(rig, GimbalRig):
        return common + gimbal_parts(rig)
    bearing = rig.bearing
    body, _, shaft = rig.motor
    spacing, boss = rig.motor_screws
    large = rig.wedge > 30.0
    torque = 30 if large else 10
    example = "Faulhaber 2657 CXR (40 mN m)" if large else "Faulhaber 2642 CXR (26 mN m)"
    spec = f"{bearing.bore:g} × {bearing.outer:g} × {bearing.width:g} mm, metal shields, no rubber seals"
    return [
        *common,
        Item(
            "",
            "motor",
            "1",
            f"12 V DC, {torque} mN m or more at 2,900 rpm, at most 2 A; ⌀ at most {body:g} mm, at most 80 mm "
            f"long with its encoder, two M3 threads {spacing:g} mm apart and at least {parts.MOTOR_THREAD:g} mm deep, "
            f"boss ⌀ at most {boss:g} mm and 3 mm high, shaft ⌀ {shaft:g} mm, 20 to 24 mm long (24 mm with an encoder "
            "board); encoder with A and B, 500 lines, open collector or 3.3 V push-pull outputs; or no encoder, and "
            "parts 15, 16, 21",
            f"not decided: {example} is the right class, but its order code with encoder, and shaft and threads of "
            "that code, were not compared. Ask the maker for these figures; other ones are options of the command",
        ),
        Item("", "rear bearing", "1", spec, f"{bearing.name}, any maker"),
        Item("", "front bearing", "1", spec, f"{bearing.name}, any maker"),
        Item(
            "",
            "wave spring",
            "1",
            f"outside at most {bearing.outer - 0.5:g} mm, **inside at least "
            f"{2 * (bearing.inner + rig.clearance + 0.02):.1f} mm**; 2.2 to 3 mm high, flat below 1.2 mm; rate × (free "
            "height "
            "− 1.5 mm) = 15 to 30 N",
        ),
    ]


def gimbal_parts(rig: GimbalRig) -> list[Item]:
    """Return what is bought for the hollow-shaft motor."""
    own = rig.hollow
    bore, outer, width = gimbal.SMALL
    low, high = gimbal.block_z(rig)[0] - 1.0, rig.front_z + 3.0
    spec = f"{bore:g} × {outer:g} × {width:g} mm, shielded"
    return [
        Item(
            "",
            "stator",
            "1",
            f"brushless outrunner, stator and bell, hollow: ⌀ at most {own.outer:g} mm, {own.height:g} mm high, bore "
            "at least "
            f"{own.bore:g} mm; four M3 threads on ⌀ {own.stator_circle:g} mm behind and on ⌀ {own.rotor_circle:g} mm "
            "in front, "
            f"at least {own.thread:g} mm deep; {own.kv:g} rpm/V or more, {own.resistance:g} Ω between wires, cogging "
            f"below {own.cogging:g} mN m; sensors as its driver asks for. Motors that are sold for gimbals mostly have "
            "15 to 60 rpm/V: with 12 V they end at 200 to 700 rpm",
            "none found that a public source names with such a bore: do not begin without one in hand",
        ),
        Item("", "bell", "", "part of the motor: its front face turns, and carries the cell"),
        Item("", "rear bearing", "1", spec, "625, any maker"),
        Item("", "front bearing", "1", spec, "625, any maker"),
        Item("", "encoder shaft", "1", f"⌀ {bore:g} mm h6, steel, {high - low:.1f} mm long"),
    ]


def electrics(kind: str, drive: str) -> list[Item]:
    """Return the electrical parts for a controller and a drive."""
    pico = kind == "rp2040"
    what = "RP2040 board with its LED at GPIO25" if pico else "ATmega2560 at 16 MHz, 5 V"
    which = (
        "Raspberry Pi Pico; not Pico W (LED elsewhere), not Pico 2 (another chip)"
        if pico
        else "Arduino Mega 2560"
    )
    out = [Item("U1", "controller", "1", what, which)]
    if drive == "belt":
        what = "12 V, 2 A, PWM of 25 kHz, direction, enable, open-drain fault output, current limit"
        which = "Pololu 4035 (carrier of TI's DRV8874), in PH/EN mode (PMODE to ground)"
        out.append(Item("", "motor driver", "1", what, which))
    else:
        what = (
            "three phases, 12 V, 2 A, sine commutation; takes the duty (voltage, not a speed) as PWM of 25 kHz, a "
            "direction that may change while it turns, and an enable that is high for on; open-drain fault output, low "
            f"for a fault; current limit of 1.5 A; logic of {'3.3' if pico else '5'} V"
        )
        which = "not decided: none found of which public sources say all this; see “Driver” below"
        out.append(Item("", "motor driver", "1", what, which))
    if pico:
        what = "optional, as the Pico's USB serves: 3.3 V, 460,800 baud or more; never wire an output called VCC or 3V3"
        out.append(Item("", "USB serial adapter", "0 or 1", what, "FT232R, CP2102N"))
    for value, refs in wires.small_parts(kind, drive):
        film = "metal film, 0207, 0.25 W, 1 %"
        kinds = "ceramic, 50 V, leads 5.08 mm apart" if value.endswith("F") else film
        common = [ref for ref in refs if ref != "R14"]
        if common:
            out.append(Item(", ".join(common), value, str(len(common)), kinds))
        if "R14" in refs:
            only = f"{film}; only for a driver's board without a pull-up at VREF: **not with Pololu 4035**"
            out.append(Item("R14", value, "1", only))
    connectors = sorted(
        (part for part in wires.components(kind, drive) if part.ref[0] == "J"),
        key=lambda part: part.ref,
    )
    widths = ", ".join(f"{part.ref} {len(part.pins)}" for part in connectors)
    strips = (
        "two of 20 pins for the Pico"
        if pico
        else f"one of {len(wires.MEGA)} pins for the wires to the Mega"
    )
    headers = (
        [Item("", "headers", "2", "2.54 mm, 20 pins each, to solder on the Pico, pins downwards")]
        if pico
        else []
    )
    plugs = ", ".join(f"{len(part.pins)}" for part in connectors)
    pins = sum(len(part.pins) for part in connectors)
    across = (
        [Item("", "capacitor", "1", "100 nF, 50 V, across the motor's wires")]
        if drive == "belt"
        else []
    )
    return [
        *out,
        Item(
            ", ".join(part.ref for part in connectors),
            "pin strips",
            "1 set",
            f"2.54 mm; pins: {widths}",
        ),
        Item("", "sockets", "1 set", f"2.54 mm, {strips}"),
        *headers,
        Item(
            "",
            "plugs for the pin strips",
            "1 set",
            f"housings of 2.54 mm with {plugs} places, {pins} crimp contacts for 0.08 to 0.2 mm² (J7: 0.5 mm², or "
            "solder its wires)",
        ),
        Item("", "perfboard", "1", "9 × 7 cm, 31 × 26 holes of 1 mm, 2.54 mm apart, single pads"),
        Item(
            "",
            "perfboard for a level shifter",
            "0 or 1",
            "3 × 3 cm or so, only if the table of levels asks for one",
        ),
        Item(
            "",
            "standoffs",
            "4 for each board",
            "M2.5 × 10 mm with screws, plastic, in holes drilled at the corners, beside all pads; boards stand on a "
            "plate of their own beside the base, not on it",
        ),
        Item("", "capacitor", "1", "470 µF, 25 V, at the driver"),
        *across,
        Item("", "supply", "1", "12 V with a current limit of 2 A", "laboratory supply"),
        Item("", "fuse with holder", "1", "2 A, slow"),
        Item("", "emergency stop", "1", "latching, normally closed contact, 12 V 2 A"),
        Item(
            "",
            "wire",
            "",
            "insulated 0.14 mm² for the board and signals, bare 0.5 mm for its rails, 0.5 mm² for 12 V and motor. "
            "Lengths, by rule of thumb: SPI (J2) at most 0.2 m, encoder A, B and fork barrier 0.5 m, trigger 2 m, "
            "12 V and motor 1 m",
        ),
    ]


def table(items: Iterable[Item]) -> str:
    """Return a bill as a table in Markdown."""
    lines = [f"| {' | '.join(HEAD)} |", f"|{'---|' * len(HEAD)}"]
    return "\n".join([*lines, *(f"| {' | '.join(astuple(item))} |" for item in items)]) + "\n"


def as_csv(groups: Sequence[tuple[str, Sequence[Item]]]) -> str:
    """Return bills as CSV, each row with the name of its group."""
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n").writerow
    write(("group", *HEAD))
    for name, items in groups:
        for item in items:
            write((name, *astuple(item)))
    return out.getvalue()


def of_rig(rig: Rig) -> str:
    """Return the whole bill of a rig as CSV: mechanics, and electrics with either controller."""
    drive = "gimbal" if isinstance(rig, GimbalRig) else "belt"
    groups = [("mechanics", mechanics(rig))]
    groups += [(f"electrics, {kind}", electrics(kind, drive)) for kind in wires.CONTROLLERS]
    return as_csv(groups)


def pages(rigs: Sequence[Rig] = (*parts.RIGS, gimbal.GIMBAL)) -> dict[str, str]:
    """Return the tables of the page by their names."""
    out = {rig.name: table(mechanics(rig)) for rig in rigs}
    for kind in wires.CONTROLLERS:
        for drive in wires.DRIVES:
            out[f"{kind}, {drive}"] = table(electrics(kind, drive))
    return out
