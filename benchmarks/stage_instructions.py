"""Instructions of each stage of a live stream for each event, counted by Valgrind's Callgrind.

    python -m benchmarks.stage_instructions [--only NAME ...] [--events 50000] [--out FILE.json]

Each stage runs over n events and over 2 n events, in packets of 10,000. The difference, divided by n, is what an event
costs, without what a start costs. The result over n events is compared with the one without Callgrind's counting, by a
checksum. The kernels are compiled for a processor with AVX2. Needs Valgrind with its headers, and a C compiler.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import math
import os
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.stages import HEIGHT, HOT, LENS, SIZE, WIDTH, cut, stream

PACKET = 10_000
MEV_S = 50.0
TURN_US = 250_000.0
"""Time of a turn: longer than the events, so that no picture is computed."""
CPU = "haswell"
"""Processor for which the kernels are compiled: with AVX2, as Valgrind knows it."""
CODE = """
#include <valgrind/callgrind.h>
void start(void) { CALLGRIND_ZERO_STATS; CALLGRIND_START_INSTRUMENTATION; }
void stop(const char *name) { CALLGRIND_STOP_INSTRUMENTATION; CALLGRIND_DUMP_STATS_AT(name); }
"""


def checksum(arrays: Iterable[Any]) -> int:
    """Return a checksum of arrays."""
    found = 0
    for array in arrays:
        found = zlib.crc32(np.ascontiguousarray(array).view(np.uint8).data, found)
    return found


def stages() -> dict[str, Callable[[], Callable[[Any], Any]]]:
    """Return for each stage what makes a new one: a function of the events, which returns arrays of its result."""
    from amiwarp import (
        Camera,
        CircleModel,
        Compensator,
        EllipseModel,
        EncoderStream,
        EventFilter,
        ExactModel,
        PhaseCamera,
        Prism,
        TensorStream,
        ToTensor,
        voxel_grid,
    )
    from amiwarp.imaging.filters import RunningFilter
    from amiwarp.live.event_sorter import EventSorter
    from amiwarp.live.stream import PacketDecoder, encode_events, encode_hello
    from amiwarp.optics.running_undistortion import RunningUndistortion

    region = (40, 20, WIDTH - 40, HEIGHT - 20)
    filters = {
        "filter: region": EventFilter(region=region),
        "filter: hot pixels": EventFilter(hot_pixels=HOT),
        "filter: refractory period": EventFilter(refractory_us=300),
        "filter: background activity": EventFilter(background_us=200),
        "filter: rate": EventFilter(most_per_s=0.8e6 * MEV_S),
        "filter: hot pixels, refractory period, background activity": EventFilter(
            hot_pixels=HOT, refractory_us=300, background_us=200
        ),
    }
    camera = Camera(WIDTH, HEIGHT, 900.0, 900.0, 639.5, 359.5)
    prism = Prism(math.radians(1.0))

    def columns(events: Any) -> list[Any]:
        return [events.x, events.y, events.t, events.p]

    def filtered(chosen: EventFilter) -> Callable[[Any], Any]:
        running = RunningFilter(chosen, SIZE)
        return lambda events: columns(running.kept(events))

    def undistorted() -> Callable[[Any], Any]:
        return RunningUndistortion(LENS).places

    def in_order() -> Callable[[Any], Any]:
        sorter = EventSorter()
        return lambda events: columns(sorter.put(events))

    def received() -> Callable[[Any], Any]:
        decoder = PacketDecoder("benchmark")
        list(decoder.feed(encode_hello(*SIZE)))

        def step(events: Any) -> list[Any]:
            (found,) = decoder.feed(encode_events(events))
            return columns(found)

        return step

    def encoder() -> EncoderStream:
        samples = EncoderStream()
        t = np.arange(0, 200_001, 1000)
        samples.append(t, t * (2.0 * math.pi / TURN_US))
        return samples

    def compensated(kind: Any) -> Callable[[Any], Any]:
        compensator = Compensator(kind.from_prism(camera, prism, 0.3), encoder(), device="cpu")

        def step(events: Any) -> list[Any]:
            compensator.put(events, 0)
            return [one for done in compensator.flush() for one in columns(done.events)]

        return step

    def summed() -> Callable[[Any], Any]:
        view = PhaseCamera(ExactModel.from_prism(camera, prism, 0.3), encoder(), turns=1.0)

        def step(events: Any) -> list[Any]:
            view.put(events, 0)
            return [found.picture.log for found in view.take(0)]

        step.finish = lambda: [found.picture.log.round(4) for found in view.flush()]  # type: ignore[attr-defined]
        return step

    def tensors() -> Callable[[Any], Any]:
        to_tensor = ToTensor(voxel_grid, width=WIDTH, height=HEIGHT, bins=5)
        made = TensorStream(to_tensor, rate_hz=1e6 * MEV_S / PACKET)
        return lambda events: [np.asarray(found.tensor) for found in made.put(events)]

    found: dict[str, Callable[[], Callable[[Any], Any]]] = {
        "encode and decode a packet": received,
        "read: order of time": in_order,
    }
    for name, chosen in filters.items():
        found[name] = lambda chosen=chosen: filtered(chosen)
    found["undistort"] = undistorted
    for name, kind in (("circle", CircleModel), ("ellipse", EllipseModel), ("exact", ExactModel)):
        found[f"compensate: {name}"] = lambda kind=kind: compensated(kind)
    found["picture: sums in phase"] = summed
    found["tensor: voxel grid of 5 bins, 10,000 events"] = tensors
    return found


def run_stages(names: list[str], count: int, library: str) -> None:
    """Run the stages in this process, counted if it runs under Callgrind, and print the checksums as JSON."""
    import warp as wp

    flags = str(wp.config.cpu_compiler_flags)  # with and without Valgrind the same code
    wp.config.cpu_compiler_flags = flags.replace("-march=native", f"-target-cpu {CPU}")
    marks = ctypes.CDLL(library)
    all_stages = stages()
    sums = {}
    for k, name in enumerate(names):
        events = stream(2 * count / MEV_S * 1e-6, MEV_S)
        packets = cut(events, PACKET)
        half = packets[: count // PACKET]
        run(all_stages[name](), half)  # loads the kernels
        for number, some in ((1, half), (2, packets)):
            step = all_stages[name]()
            run(step, some[:0])
            marks.start()
            found = run(step, some)
            marks.stop(f"{k}x{number}".encode())
            found += getattr(
                step, "finish", list
            )()  # the picture of the sums, which is not counted
            sums[f"{k}x{number}"] = checksum(found)
    print(json.dumps(sums), flush=True)


def run(step: Callable[[Any], Any], packets: list[Any]) -> list[Any]:
    """Return all arrays of the results of a stage."""
    return [array for packet in packets for array in step(packet)]


def totals(folder: Path) -> dict[str, int]:
    """Return the counted instructions by the names of the dumps."""
    found = {}
    for path in folder.glob("callgrind.out*"):
        name = ""
        total = 0
        for line in path.read_text(errors="replace").splitlines():
            if line.startswith("desc: Trigger: Client Request: "):
                name = line.rpartition(" ")[2]
            elif line.startswith(("totals: ", "summary: ")):
                total = max(total, int(line.split()[1]))
        if name:
            found[name] = found.get(name, 0) + total
    return found


def counted(names: list[str], count: int) -> list[dict[str, Any]]:
    """Return a row for each stage."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        source = folder / "marks.c"
        source.write_text(CODE)
        library = folder / "marks.so"
        subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", library, source], check=True)
        arguments = [sys.executable, "-m", "benchmarks.stage_instructions", "--child", str(library)]
        arguments += ["--events", str(count), "--only", *names]
        valgrind = [
            "valgrind",
            "--tool=callgrind",
            "--instr-atstart=no",
            "--smc-check=all-non-file",
        ]
        valgrind.append(f"--callgrind-out-file={folder}/callgrind.out")
        plain = subprocess.run(arguments, check=True, capture_output=True, text=True)
        ran = subprocess.run([*valgrind, *arguments], check=True, capture_output=True, text=True)
        sums = [json.loads(one.stdout.splitlines()[-1]) for one in (plain, ran)]
        instructions = totals(folder)
    rows = []
    for k, name in enumerate(names):
        once = instructions[f"{k}x1"]
        twice = instructions[f"{k}x2"]
        is_same = all(sums[0][f"{k}x{number}"] == sums[1][f"{k}x{number}"] for number in (1, 2))
        rows.append({"stage": name, "instructions": (twice - once) / count, "same": is_same})
        print(json.dumps(rows[-1]), flush=True)
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--events", type=int, default=50_000)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    names = args.only or list(stages())
    if args.child:
        run_stages(names, args.events, os.fspath(args.child))
        return 0
    rows = counted(names, args.events)
    if args.out:
        version = subprocess.run(
            ["valgrind", "--version"], capture_output=True, text=True, check=True
        )
        found = {"valgrind": version.stdout.strip(), "events": args.events, "rows": rows}
        args.out.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
