"""Cost of an event of the sums in phase on microcontrollers, in simulators, with the integers checked in the same run.

    python -m benchmarks.small_machines [--out FILE.json]

Exports the C for 32 x 32 px with each number of harmonics, as ``amiwarp export-c`` does, builds it with
``arm-none-eabi-gcc``, and runs it twice: on rp2040js, which counts the cycles of a Cortex-M0+, and on QEMU as a
Cortex-M7, where one instruction takes one nanosecond, which counts instructions and not cycles. The 512 events of the
exported test are added 8 times: all with one polarity, and then each with another polarity than the event before of its
pixel, for which it adds three rows instead of one. What an event costs includes the call, and the loop that takes it
from an array. Program, tables and sums are in RAM. Then the exported test compares all integers.

Needs gcc-arm-none-eabi, qemu-system-arm, Node.js and ``npm install --prefix firmware/simulator``. Writes
benchmarks/results/small_machines.json. The exit status is 1 if an integer differs.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from amiwarp.imaging.c_sums import TEST_EVENTS, CSums, write_c_sums
from amiwarp.studies.machine import versions

HERE = Path(__file__).parent
RESULTS = HERE / "results"
SIMULATOR = HERE.parent / "firmware" / "simulator"
HARMONICS = (1, 3, 5, 9)
PASSES = 8
"""How often the events are added, as in small_machines.c."""
NS_PER_TICK = 40
"""A tick of QEMU's mps2-an500, whose clock has 25 MHz."""
CHANGES = 0.35
"""Share of the events that follow one of the other polarity: 0.29, 0.35 and 0.39 in a turn of scikit-image's astronaut,
camera and coffee, simulated with 320 x 240 px and an apex of 1 deg."""
M0_MHZ = 125
M7_MHZ = 480
"""Clocks of an RP2040, and of an STM32H743."""
FLAGS = ["-O2", "-std=gnu99", "-Wall", "-Wextra", "-Werror", "-mthumb", "-ffreestanding"]
FLAGS += ["-fno-tree-loop-distribute-patterns", "-ffunction-sections"]


def build(folder: Path, name: str, machine: list[str], start: int) -> Path:
    """Build the exported C in ``folder`` with the loop that is counted, and return the program."""
    program = folder / f"{name}.elf"
    where = ["-nostdlib", "-T", str(HERE / "small_machines.ld"), f"-Wl,--defsym,START={start}"]
    sources = [str(HERE / "small_machines.c"), str(folder / "phase_sums.c"), "-lgcc"]
    command = ["arm-none-eabi-gcc", *FLAGS, *machine, f"-I{folder}", *where]
    subprocess.run([*command, "-o", str(program), *sources], check=True)
    return program


def text_bytes(folder: Path, cpu: str) -> int:
    """Return the size of code and table of phase_sums.c [bytes]."""
    made = folder / "phase_sums.o"
    command = ["arm-none-eabi-gcc", *FLAGS, cpu, "-c", str(folder / "phase_sums.c")]
    subprocess.run([*command, "-o", str(made)], check=True)
    size = subprocess.run(
        ["arm-none-eabi-size", str(made)], check=True, capture_output=True, text=True
    )
    return int(size.stdout.splitlines()[1].split()[0])


def on_m0(folder: Path) -> tuple[list[int], int]:
    """Return the cycles of the events of both kinds on a Cortex-M0+, and what the test of the integers returned."""
    program = build(folder, "m0", ["-mcpu=cortex-m0plus", "-DRP2040"], 0x20000000)
    image = program.with_suffix(".bin")
    subprocess.run(["arm-none-eabi-objcopy", "-O", "binary", str(program), str(image)], check=True)
    ran = subprocess.run(
        ["node", str(SIMULATOR / "cycles.mjs"), str(image)],
        check=True,
        capture_output=True,
        text=True,
        timeout=300,
    )
    found = json.loads(ran.stdout)
    return found["cycles"], found["result"]


def on_m7(folder: Path) -> tuple[list[int], int]:
    """Return the instructions of the events of both kinds on a Cortex-M7, to 40, and what the test returned."""
    program = build(folder, "m7", ["-mcpu=cortex-m7"], 0)
    machine = ["-M", "mps2-an500", "-icount", "shift=0", "-display", "none"]
    host = ["-semihosting-config", "enable=on,target=native"]
    ran = subprocess.run(
        ["qemu-system-arm", *machine, *host, "-kernel", str(program)],
        check=True,
        capture_output=True,
        text=True,
        timeout=300,
    )
    # The text of semihosting comes on standard error.
    *ticks, result = (ran.stdout + ran.stderr).split()[-3:]
    return [NS_PER_TICK * int(number, 16) for number in ticks], int(result)


def mixed(costs: list[int]) -> float:
    """Return the cost of events of which a share changes the polarity."""
    return costs[0] + CHANGES * (costs[1] - costs[0])


def measure(harmonics: int) -> dict[str, Any]:
    """Return what an event costs with a number of harmonics."""
    settings = CSums(32, 32, harmonics)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_c_sums(folder, settings)
        cycles, m0_result = on_m0(folder)
        instructions, m7_result = on_m7(folder)
        code = text_bytes(folder, "-mcpu=cortex-m0plus") - settings.rows.nbytes
    events = PASSES * TEST_EVENTS
    return {
        "harmonics": harmonics,
        "ram_bytes": settings.ram_bytes,
        "table_bytes": settings.rows.nbytes,
        "m0_code_bytes": code,
        "m0_cycles": cycles[0] / events,
        "m0_cycles_of_change": cycles[1] / events,
        "m0_events_per_s": M0_MHZ * 1e6 * events / mixed(cycles),
        "m7_instructions": instructions[0] / events,
        "m7_instructions_of_change": instructions[1] / events,
        "m7_events_per_s": M7_MHZ * 1e6 * events / mixed(instructions),
        "wrong": bool(m0_result or m7_result),
    }


def first_line(*command: str) -> str:
    """Return the first line that a program prints: its version."""
    ran = subprocess.run(command, check=True, capture_output=True, text=True)
    return ran.stdout.splitlines()[0]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=RESULTS / "small_machines.json")
    args = parser.parse_args()

    rows = []
    for harmonics in HARMONICS:
        row = measure(harmonics)
        print(
            f"{harmonics} harmonics: M0+ {row['m0_cycles']:.1f}, {row['m0_cycles_of_change']:.1f} cycles, "
            f"M7 {row['m7_instructions']:.1f}, {row['m7_instructions_of_change']:.1f} instructions an event"
            f"{', INTEGERS DIFFER' if row['wrong'] else ', all integers right'}",
            flush=True,
        )
        rows.append(row)
    package = SIMULATOR / "node_modules" / "rp2040js" / "package.json"
    tools = {
        "gcc": first_line("arm-none-eabi-gcc", "--version"),
        "qemu": first_line("qemu-system-arm", "--version"),
        "rp2040js": json.loads(package.read_text())["version"],
    }
    report = {"versions": versions(()) | tools, "rows": rows}
    args.out.write_text(json.dumps(report, indent=1) + "\n")
    return int(any(row["wrong"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
