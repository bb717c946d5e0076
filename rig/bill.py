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
MOTOR_SCREWS = {"belt": (2, "M3×8", "countersunk"), "gimbal": (4, "M3×8", "countersunk")}


def screws_of(rig: Rig) -> dict[str, tuple[int, str, str]]:
    """Return number, size and kind of the screws in a rig's assembly, by their names."""
    own = {**SCREWS, "screws of the motor": MOTOR_SCREWS["gimbal" if isinstance(rig, GimbalRig) else "belt"]}
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
        Item("", f"set screw M{rig.screw[1]:g}, 3 to 8 mm", "up to 12", "ISO 4026; which ones, the command prints"),
        Item("", "foot", "4", "soft rubber, higher than 8 mm, with an M4 stud of 10 mm or more and a nut"),
        Item("", "tape", "", "black, over the slits of the holder"),
        Item("", "glue, thread locker", "", consumables(rig)),
    ]
    return out


def consumables(rig: Rig) -> str:
    """Return what glue and oil are for."""
    if isinstance(rig, GimbalRig):
        return "retaining compound for both 625 bearings and the shaft in them; glue for cup and magnet; thread locker"
    return "glue for cup and magnet; thread locker; white spirit and instrument oil for the bearings"


def lens_item(rig: Rig) -> Item:
    """Return the lens."""
    thread = rig.threads[1]
    name = {"m12": "M12 × 0.5", "c": "C-mount", "cs": "CS-mount"}[thread]
    example = "M12 lens of 16 mm" if thread == "m12" else "fixed lens of 6 to 16 mm for machine vision"
    spec = (
        f"{name}, at most {rig.lens:g} mm wide, {rig.reach:g} mm before its ring; locking screws for focus and "
        "aperture; no shorter than the page's table allows"
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
            f"⌀ {rig.wedge:g} mm, N-BK7, antireflection coating, {rig.thickness:g} mm thick on the axis, apex "
            f"{rig.apex_deg:g}°: shops name the deviation, {math.degrees(deviation):.2f}°",
            "“wedge prism” or “wedged window”",
        ),
        Item(
            "",
            "fork barrier",
            "1",
            "slot 5 mm wide, 7 mm deep, body at most 14 mm wide; phototransistor with 0.5 mA or more at 20 mA; on a "
            "piece "
            "of perfboard, 20 × 16 mm, 1.6 mm thick, with two holes of 2.2 mm, 14 mm apart, beside the body's middle",
            "Omron EE-SX1041 (its data sheet)",
        ),
        Item(
            "",
            "encoder board",
            "1",
            "14 bit, SPI, at most 22 × 28 mm, chip in its middle, two holes of 2.7 mm 23 mm apart (drill them)",
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
            f"12 V DC, {torque} mN m or more at 2,900 rpm, ⌀ at most {body:g} mm, two M3 threads {spacing:g} mm apart "
            "and 4 mm "
            f"deep, boss ⌀ {boss:g} mm, shaft ⌀ {shaft:g} × 20 mm (24 mm with an encoder board); encoder with A and B, "
            "500 "
            "lines or more, open collector or 3.3 V outputs; or no encoder, and parts 15, 16, 21",
            f"{example} with an encoder: compare shaft and threads",
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
            f"3 mm deep; {own.kv:g} rpm/V, {own.resistance:g} Ω between wires, cogging below {own.cogging:g} mN m. "
            "Motors "
            "that are sold for gimbals mostly have 15 to 60 rpm/V: with 12 V they end at 200 to 700 rpm",
            "none found that a public source names with such a bore",
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
    which = "Raspberry Pi Pico; not Pico W (LED elsewhere), not Pico 2 (another chip)" if pico else "Arduino Mega 2560"
    out = [Item("U1", "controller", "1", what, which)]
    if drive == "belt":
        what = "12 V, 2 A, PWM of 25 kHz, direction, enable, open-drain fault output, current limit"
        out.append(Item("", "motor driver", "1", what, "TI DRV8874 on a board, in PH/EN mode (PMODE to ground)"))
    else:
        what = (
            "three phases, 12 V, 2 A, commutates by itself; takes the voltage as PWM of 25 kHz, a direction and an "
            "enable "
            "(high: on); open-drain fault output; current limit of 1.5 A"
        )
        which = "TI MCF8316A commutates without sensors and has a PWM input (TI's page); compare the other inputs"
        out.append(Item("", "motor driver", "1", what, which))
    if pico:
        out.append(Item("", "USB serial adapter", "1", "3.3 V, 460,800 baud or more", "FT232R, CP2102N"))
    for value, refs in wires.small_parts(kind, drive):
        count = refs.count(",") + 1
        kinds = "ceramic, 50 V, leads 5.08 mm apart" if value.endswith("F") else "metal film, 0207, 0.25 W, 1 %"
        out.append(Item(refs, value, str(count), kinds))
    connectors = sorted(
        (part for part in wires.components(kind, drive) if part.ref[0] == "J"), key=lambda part: part.ref
    )
    widths = ", ".join(f"{part.ref} {len(part.pins)}" for part in connectors)
    strips = "two of 20 pins for the Pico" if pico else f"one of {len(wires.MEGA)} pins for the Mega"
    across = [Item("", "capacitor", "1", "100 nF, 50 V, across the motor's wires")] if drive == "belt" else []
    return [
        *out,
        Item(", ".join(part.ref for part in connectors), "pin strips", "1 set", f"2.54 mm; pins: {widths}"),
        Item("", "sockets", "1 set", f"2.54 mm, {strips}"),
        Item("", "perfboard", "1", "9 × 7 cm, 31 × 26 holes of 1 mm, 2.54 mm apart, single pads"),
        Item("", "capacitor", "1", "470 µF, 25 V, at the driver"),
        *across,
        Item("", "supply", "1", "12 V with a current limit of 2 A", "laboratory supply"),
        Item("", "fuse with holder", "1", "2 A, slow"),
        Item("", "emergency stop", "1", "latching, normally closed contact, 12 V 2 A"),
        Item(
            "",
            "wire",
            "",
            "insulated 0.14 mm² for the board and signals, bare 0.5 mm for its rails, 0.5 mm² for 12 V and motor",
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
