"""Wiring: one list of nets, from which come the wiring tables, the perfboard plan and its tests.

Two controllers (Raspberry Pi Pico with an RP2040, Arduino Mega with an ATmega2560) and two drives (DC motor with a
belt, brushless motor with a hollow shaft) share a board. Only values and the far ends of wires differ.
"""

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass

CONTROLLERS = ("rp2040", "avr")
DRIVES = ("belt", "gimbal")

GND, VIO, V5, VM = "GND", "VIO", "5V", "VM"
"""Nets of the supplies. VIO is the level of the logic: 3.3 V with the Pico, 5 V with the Mega."""


@dataclass(frozen=True)
class Signal:
    """A net between controller and a connector of the board."""

    net: str
    define: str
    """Name in ``firmware/pins.h``."""
    gpio: int
    """Number of the RP2040's GPIO."""
    port: str
    """Port of the ATmega2560, empty if it has none."""
    mega: str
    """Pin of an Arduino Mega."""
    what: str


SIGNALS = (
    Signal("UART_TX", "PIN_UART_TX", 0, "", "USB", "link, from the controller"),
    Signal("UART_RX", "PIN_UART_RX", 1, "", "USB", "link, to the controller"),
    Signal("A", "PIN_A", 2, "PE4", "2", "encoder A"),
    Signal("B", "PIN_B", 3, "PE5", "3", "encoder B"),
    Signal("INDEX", "PIN_INDEX", 4, "PL0", "49", "index of the prism"),
    Signal(
        "SYNC_IN",
        "PIN_CAMERA_SYNC",
        5,
        "PL1",
        "48",
        "pulses of the camera, only with PULSES_CAMERA",
    ),
    Signal("TRIGGER", "PIN_TRIGGER", 6, "PA3", "25", "pulses to the camera"),
    Signal("PWM", "PIN_PWM", 8, "PE3", "5", "voltage of the motor, 25 kHz (Mega: 27 kHz)"),
    Signal("DIRECTION", "PIN_DIRECTION", 9, "PA0", "22", "high: forwards"),
    Signal("ENABLE", "PIN_ENABLE", 10, "PA1", "23", "high: on"),
    Signal("FAULT", "PIN_DRIVER_FAULT", 11, "PA2", "24", "low: fault of the driver"),
    Signal("SUPPLY", "PIN_SUPPLY", 12, "PA4", "26", "12 V present"),
    Signal("VOLTS", "PIN_SUPPLY_ADC", 26, "PF0", "A0", "12 V measured"),
    Signal("MISO", "PIN_SPI_MISO", 16, "", "", "magnetic encoder"),
    Signal("CSN", "PIN_SPI_CS", 17, "", "", "magnetic encoder"),
    Signal("SCK", "PIN_SPI_SCK", 18, "", "", "magnetic encoder"),
    Signal("MOSI", "PIN_SPI_MOSI", 19, "", "", "magnetic encoder"),
)

PICO = {
    "GP0": 1,
    "GP1": 2,
    "GP2": 4,
    "GP3": 5,
    "GP4": 6,
    "GP5": 7,
    "GP6": 9,
    "GP7": 10,
    "GP8": 11,
    "GP9": 12,
    "GP10": 14,
    "GP11": 15,
    "GP12": 16,
    "GP13": 17,
    "GP14": 19,
    "GP15": 20,
    "GP16": 21,
    "GP17": 22,
    "GP18": 24,
    "GP19": 25,
    "GP20": 26,
    "GP21": 27,
    "GP22": 29,
    "RUN": 30,
    "GP26": 31,
    "GP27": 32,
    "GP28": 34,
    "ADC_VREF": 35,
    "3V3": 36,
    "3V3_EN": 37,
    "VSYS": 39,
    "VBUS": 40,
}
"""Pins of a Raspberry Pi Pico by their names; those in between are ground."""
PICO_GROUND = (18, 23)
"""Pins of its ground that are wired; the other six are joined to them on the Pico."""
MEGA = (
    "A",
    "B",
    "INDEX",
    "SYNC_IN",
    "TRIGGER",
    "PWM",
    "DIRECTION",
    "ENABLE",
    "FAULT",
    "SUPPLY",
    "VOLTS",
    VIO,
    GND,
)
"""Nets of the strip that stands for the Mega on the board, whose pins are wired to it."""


@dataclass(frozen=True)
class Component:
    """A part on the board, with the net of each pin; an empty net is not connected."""

    ref: str
    what: str
    nets: tuple[str, ...]
    pins: tuple[str, ...]
    """Names of the pins."""


def two(ref: str, what: str, first: str, second: str) -> Component:
    """Return a resistor or a capacitor."""
    return Component(ref, what, (first, second), ("1", "2"))


def strip(ref: str, what: str, *pins: tuple[str, str]) -> Component:
    """Return a connector by name and net of its pins."""
    return Component(ref, what, tuple(net for _, net in pins), tuple(name for name, _ in pins))


def controller(kind: str) -> Component:
    """Return the Pico, or the strip to the Mega."""
    if kind == "avr":
        names = {signal.net: signal.mega for signal in SIGNALS} | {VIO: "5V", GND: "GND"}
        return strip("U1", "strip to the Arduino Mega", *((names[net], net) for net in MEGA))
    nets = {signal.gpio: signal.net for signal in SIGNALS}
    by_pin = {number: name for name, number in PICO.items()}
    pins = []
    for number in range(1, 41):
        name = by_pin.get(number, "GND")
        net = {"3V3": VIO, "VBUS": V5}.get(name, GND if number in PICO_GROUND else "")
        if name.startswith("GP"):
            net = nets.get(int(name[2:]), "")
        pins.append((f"{number} {name}", net))
    return strip("U1", "Raspberry Pi Pico", *pins)


def components(kind: str, drive: str) -> list[Component]:
    """Return the parts on the board.

    Values: the fork barrier's LED gets 21 mA; the divider of the supply gives a high level from 9 V on, no more than
    the level of the logic at 15 V (both are the firmware's limits of the voltage), and a low one without supply, also
    against the pin's pull-up; 47 kΩ and 10 kΩ give 2.1 V at 12 V and 3.3 V at 18.8 V.
    """
    pico = kind == "rp2040"
    out = [
        controller(kind),
        strip("J3", "fork barrier", ("A", "LED"), ("K", GND), ("C", "INDEX"), ("E", GND)),
        strip("J5", "motor driver", *driver_pins(drive)),
        strip("J6", "camera", ("TRIG", "TRIG_OUT"), ("SYNC", "SYNC_CAM"), ("GND", GND)),
        strip("J7", "12 V, behind the emergency stop", ("VM", VM), ("GND", GND)),
        strip("J8", "5 V", ("5V", V5 if pico else VIO), ("GND", GND)),
        two("R3", "10 kΩ", "INDEX", VIO),
        two("R4", "10 kΩ", "ENABLE", GND),
        two("R5", "10 kΩ", "FAULT", VIO),
        two("R6", "100 Ω" if pico else "180 Ω", VIO, "LED"),
        two("R7", "22 kΩ" if pico else "12 kΩ", VM, "SUPPLY"),
        two("R8", "6.2 kΩ", "SUPPLY", GND),
        two("R9", "47 kΩ", VM, "VOLTS"),
        two("R10", "10 kΩ", "VOLTS", GND),
        two("R11", "100 Ω", "TRIGGER", "TRIG_OUT"),
        two("R12", "100 Ω" if pico else "1 kΩ", "SYNC_CAM", "SYNC_IN"),
        two("C1", "100 nF", VIO, GND),
        two("C2", "100 nF", "VOLTS", GND),
    ]
    if pico:
        link = (("RXD", "UART_TX"), ("TXD", "UART_RX"), ("GND", GND), ("VCCIO", VIO))
        out.append(strip("J4", "USB serial adapter", *link))
    if drive == "belt" or not pico:
        # the Mega reads A and B of an AS5047P, too
        out.append(strip("J1", "encoder A, B", ("V+", VIO), ("A", "A"), ("B", "B"), ("GND", GND)))
        out += [two("R1", "4.7 kΩ", "A", VIO), two("R2", "4.7 kΩ", "B", VIO)]
    if pico:
        spi = (
            ("MISO", "MISO"),
            ("CSn", "CSN"),
            ("CLK", "SCK"),
            ("MOSI", "MOSI"),
            ("3V3", VIO),
            ("GND", GND),
        )
        out.append(strip("J2", "AS5047P board", *spi))
    if drive == "belt":
        out += [
            two("R13", "5.1 kΩ" if pico else "2.7 kΩ", "VREF", GND),
            two("R14", "10 kΩ", "VREF", VIO),
        ]
    return out


def driver_pins(drive: str) -> list[tuple[str, str]]:
    """Return names and nets of the driver's connector."""
    pins = [
        ("PWM", "PWM"),
        ("DIR", "DIRECTION"),
        ("EN", "ENABLE"),
        ("FLT", "FAULT"),
        ("GND", GND),
        ("VIO", VIO),
    ]
    return [*pins, ("VREF", "VREF")] if drive == "belt" else pins


def nets(kind: str, drive: str) -> dict[str, list[tuple[str, str]]]:
    """Return each net with its pins, as pairs of part and pin."""
    found: dict[str, list[tuple[str, str]]] = {}
    for part in components(kind, drive):
        for pin, net in zip(part.pins, part.nets, strict=True):
            if net:
                found.setdefault(net, []).append((part.ref, pin))
    return {net: pins for net, pins in found.items() if len(pins) > 1}


FAR = {
    ("J1", "V+"): ("motor encoder: supply, if it takes this level", "AS5047P board: 5V (Mega)"),
    ("J1", "A"): (
        "motor encoder: A; 5 V push-pull only through a 74LVC125A",
        "AS5047P board: A (Mega)",
    ),
    ("J1", "B"): (
        "motor encoder: B; 5 V push-pull only through a 74LVC125A",
        "AS5047P board: B (Mega)",
    ),
    ("J1", "GND"): ("motor encoder: GND", "AS5047P board: GND (Mega)"),
    ("J2", "MISO"): ("AS5047P board, without A and B: MISO (DO)", "AS5047P board: MISO (DO)"),
    ("J2", "CSn"): ("AS5047P board: CSn", "AS5047P board: CSn"),
    ("J2", "CLK"): ("AS5047P board: CLK", "AS5047P board: CLK"),
    ("J2", "MOSI"): ("AS5047P board: MOSI (DI)", "AS5047P board: MOSI (DI)"),
    ("J2", "3V3"): ("AS5047P board: VDD and VDD3V3", "AS5047P board: VDD and VDD3V3"),
    ("J2", "GND"): ("AS5047P board: GND", "AS5047P board: GND"),
    ("J3", "A"): ("fork barrier: anode (A)", "fork barrier: anode (A)"),
    ("J3", "K"): ("fork barrier: cathode (K)", "fork barrier: cathode (K)"),
    ("J3", "C"): ("fork barrier: collector (C)", "fork barrier: collector (C)"),
    ("J3", "E"): ("fork barrier: emitter (E)", "fork barrier: emitter (E)"),
    ("J4", "RXD"): ("serial adapter: RXD", "serial adapter: RXD"),
    ("J4", "TXD"): ("serial adapter: TXD", "serial adapter: TXD"),
    ("J4", "GND"): ("serial adapter: GND", "serial adapter: GND"),
    ("J4", "VCCIO"): (
        "serial adapter: input for its level (VCCIO), never an output called VCC or 3V3; else open",
        "serial adapter: input for its level (VCCIO), never an output called VCC or 3V3; else open",
    ),
    ("J5", "PWM"): ("DRV8874: EN / IN1", "brushless driver: PWM input for the voltage"),
    ("J5", "DIR"): ("DRV8874: PH / IN2", "brushless driver: direction"),
    ("J5", "EN"): ("DRV8874: nSLEEP (SLP)", "brushless driver: enable, high is on"),
    ("J5", "FLT"): ("DRV8874: nFAULT", "brushless driver: fault, open drain, low is a fault"),
    ("J5", "GND"): (
        "DRV8874: GND; its PMODE and IMODE go to its GND, too",
        "brushless driver: GND of its logic",
    ),
    ("J5", "VIO"): ("open", "brushless driver: level of its logic, if it asks for one"),
    ("J5", "VREF"): ("DRV8874: VREF; no R14 with Pololu 4035, which has its own", ""),
    ("J6", "TRIG"): ("camera: trigger input", "camera: trigger input"),
    ("J6", "SYNC"): ("open, or the camera's sync output", "open, or the camera's sync output"),
    ("J6", "GND"): ("camera: ground of the trigger", "camera: ground of the trigger"),
    ("J7", "VM"): ("VM of the driver (VIN on Pololu's board)", "supply of the brushless driver"),
    ("J7", "GND"): ("GND of the driver, the star point", "GND of the driver, the star point"),
    ("J8", "5V"): (
        "motor encoder or level shifter, if they need 5 V, else open",
        "74AHCT125, if the camera needs 5 V, else open",
    ),
    ("J8", "GND"): ("the same: GND", "the same: GND"),
}
"""What is at the other end of each connector's pin, for a belt and for a hollow-shaft motor."""

POWER = (
    ("12 V supply +", "fuse, 2 A slow", "fuse, 2 A slow"),
    ("fuse", "emergency stop", "emergency stop"),
    ("emergency stop", "DRV8874: VM (VIN on Pololu's board)", "brushless driver: supply"),
    ("12 V supply −", "DRV8874: GND, the star point", "brushless driver: GND, the star point"),
    (
        "470 µF 25 V",
        "+ at VM, − at GND of the driver, at the driver",
        "+ at its supply, − at its GND, at the driver",
    ),
    (
        "driver, outputs",
        "OUT1, OUT2: the motor's two wires, 100 nF across",
        "U, V, W: the motor's three wires; exchange two if it turns backwards",
    ),
    ("DRV8874: IPROPI (CS)", "open if the board has its resistor, else 2.49 kΩ to GND", ""),
    ("USB of the controller", "a port of the computer", "a port of the computer"),
    ("USB of the camera, and of the serial adapter if you have one", "a port each", "a port each"),
)
"""Wires beside the board: from, and to with a belt and with a hollow-shaft motor."""


def pin_of(signal: Signal, kind: str) -> str:
    """Return the pin of a controller that carries a signal, as its owner finds it; empty if there is none."""
    if kind == "rp2040":
        return f"{PICO[f'GP{signal.gpio}']} (GP{signal.gpio})"
    return f"{signal.mega} ({signal.port})" if signal.port else signal.mega


def controller_rows() -> Iterator[tuple[str, str, str, str, str]]:
    """Yield net, pin of the Pico, pin of the Mega, what it is for, and what it meets on the board."""
    pico, mega = nets("rp2040", "belt"), nets("avr", "belt")
    for signal in SIGNALS:
        met = [
            f"{ref}.{pin}" if ref[0] == "J" else ref for ref, pin in pico[signal.net] if ref != "U1"
        ]
        there = pin_of(signal, "avr") if signal.net in mega or signal.mega == "USB" else "none"
        yield signal.net, pin_of(signal, "rp2040"), there, signal.what, ", ".join(met)
    yield (
        VIO,
        "36 (3V3)",
        "5V",
        "level of the logic",
        "J1.V+, J2.3V3, J4.VCCIO, J5.VIO, pull-ups, R6, C1",
    )
    yield V5, "40 (VBUS)", "5V", "5 V of USB", "J8.5V"
    yield GND, " and ".join(map(str, PICO_GROUND)), "GND", "ground", "all"


def connector_rows() -> Iterator[tuple[str, str, str, str, str]]:
    """Yield connector, pin, net, and the far end with a belt and with a hollow-shaft motor."""
    seen = set()
    for kind, drive in (("rp2040", "belt"), ("avr", "belt")):
        for part in components(kind, drive):
            if part.ref[0] != "J" or part.ref in seen:
                continue
            seen.add(part.ref)
            for pin, net in zip(part.pins, part.nets, strict=True):
                belt, gimbal = FAR[part.ref, pin]
                yield part.ref, pin, net, belt, gimbal


def small_parts(kind: str, drive: str) -> list[tuple[str, list[str]]]:
    """Return resistors and capacitors on the board, as value and references."""
    found: dict[str, list[str]] = {}
    for part in components(kind, drive):
        if part.ref[0] in "RC":
            found.setdefault(part.what, []).append(part.ref)
    return list(found.items())


def as_csv() -> str:
    """Return both tables and the power wires as CSV."""
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n").writerow
    write(("net", "pin of the Pico", "pin of the Mega", "what", "on the board"))
    for row in controller_rows():
        write(row)
    write(())
    write(("connector", "pin", "net", "goes to (belt, DC motor)", "goes to (hollow-shaft motor)"))
    for row in connector_rows():
        write(row)
    write(())
    write(("from", "to (belt, DC motor)", "to (hollow-shaft motor)"))
    for row in POWER:
        write(row)
    return out.getvalue()
