"""Fuzz tests: damaged input is read or refused in one line, without crashes, hangs or high memory use.

    python -m benchmarks.fuzz --seconds 60
    python -m benchmarks.fuzz --files 20000 --frames 100000 --out benchmarks/results/fuzz.json
    python -m benchmarks.fuzz --events 4000 --out benchmarks/results/fuzz_events.json
    python -m benchmarks.fuzz --guided stream --seconds 60

Files are mutated samples of every format, read completely in supervised processes. Frames are mutated packets of the
event stream and mutated messages of the serial port. Of ``--events``, mutated event files of each decoder, the events
that are read are compared with what the damaged bytes say. ``--seed`` selects another series. ``--guided`` uses Atheris
(``pip install '.[fuzz]'``) to search for inputs that reach new code in one of the decoders written in Python. Findings
are printed and saved in the folder ``--keep``; the exit status is then 1.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import json
import random
import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from amiwarp import AmiwarpError
from amiwarp.tasks import cpu_threads

LONGEST_S = 300.0
"""Time after which a decoder that still works on one input is considered hanging [s]."""


def files(count: int | None, until: float | None, seed: int, keep: Path) -> dict[str, Counter[str]]:
    """Check ``count`` mutated files, or files until the time limit, on all cores; return the outcomes by kind."""
    from reference.mutation_files import KINDS

    kinds = list(KINDS)
    outcomes: dict[str, Counter[str]] = {kind: Counter() for kind in kinds}
    workers = cpu_threads()
    with ThreadPoolExecutor(workers) as pool, tempfile.TemporaryDirectory() as folder:
        parts = [
            pool.submit(_files, range(k, count if count is not None else 1 << 62, workers), until, seed,
                        Path(folder), keep)
            for k in range(workers)
        ]  # fmt: skip
        for part in parts:
            for kind, found in part.result().items():
                outcomes[kind] += found
    return outcomes


def _files(
    numbers: range, until: float | None, seed: int, folder: Path, keep: Path
) -> dict[str, Counter[str]]:
    """Check the mutated files with these numbers in one supervised process."""
    from reference import mutation_files as mutation

    kinds = list(mutation.KINDS)
    outcomes: dict[str, Counter[str]] = {kind: Counter() for kind in kinds}
    with contextlib.closing(mutation.Checker()) as checker:
        for number in numbers:
            if until is not None and time.monotonic() > until:
                break
            kind = kinds[number % len(kinds)]
            path = folder / f"{kind}-{seed}-{number}{mutation.KINDS[kind][0]}"
            path.write_bytes(
                mutation.mutated(mutation.sample(kind), random.Random(f"{kind} {seed} {number}"))
            )
            try:
                outcomes[kind]["read" if checker.check(path, kind) is None else "refused"] += 1
            except AssertionError as finding:
                outcomes[kind]["defects"] += 1
                print(finding, file=sys.stderr, flush=True)
                keep.mkdir(parents=True, exist_ok=True)
                (keep / path.name).write_bytes(path.read_bytes())
            path.unlink()
    return outcomes


def event_files(count: int, seed: int, keep: Path) -> dict[str, Counter[str]]:
    """Check ``count`` mutated files of each decoder of events on all cores; return what became of their events."""
    workers = min(cpu_threads(), count)
    outcomes: dict[str, Counter[str]] = {}
    with ThreadPoolExecutor(workers) as pool, tempfile.TemporaryDirectory() as folder:
        numbers = [range((seed << 32) + k, (seed << 32) + count, workers) for k in range(workers)]
        for part in pool.map(lambda each: _event_files(each, Path(folder), keep), numbers):
            for decoder, found in part.items():
                outcomes[decoder] = outcomes.get(decoder, Counter[str]()) + found
    return outcomes


def _event_files(numbers: range, folder: Path, keep: Path) -> dict[str, Counter[str]]:
    """Check the mutated files with these numbers in one supervised process."""
    from reference.mutation_events import DECODERS, count_outcomes, event_checker

    with contextlib.closing(event_checker()) as checker:
        return {
            decoder: count_outcomes(checker, decoder, numbers, folder, keep) for decoder in DECODERS
        }


def frames(
    count: int | None, until: float | None, seed: int, keep: Path
) -> dict[str, Counter[str]]:
    """Feed ``count`` mutated packets and messages to their decoders, or as many as fit into the time limit."""
    from reference import mutation_frames as mutation

    wires: dict[str, tuple[Callable[[int], bytes], Callable[[bytes], int]]] = {
        "stream": (mutation.mutated_stream, mutation.read_stream),
        "serial": (mutation.mutated_serial, mutation.read_serial),
    }
    outcomes: dict[str, Counter[str]] = {wire: Counter() for wire in wires}
    number = seed << 32
    while (count is None or sum(found["frames"] for found in outcomes.values()) < count) and (
        until is None or time.monotonic() < until
    ):
        for wire, (make, read) in wires.items():
            data = make(number)
            outcomes[wire]["frames"] += mutation.frames_in(data, wire)
            faulthandler.dump_traceback_later(LONGEST_S, exit=True)
            try:
                read(data)
                outcomes[wire]["read"] += 1
            except AmiwarpError as error:
                outcomes[wire]["refused" if "\n" not in str(error) else "defects"] += 1
            except Exception as finding:
                outcomes[wire]["defects"] += 1
                print(
                    f"{wire} {number}: {type(finding).__name__}: {finding}",
                    file=sys.stderr,
                    flush=True,
                )
                keep.mkdir(parents=True, exist_ok=True)
                (keep / f"{wire}-{number}").write_bytes(data)
            faulthandler.cancel_dump_traceback_later()
        number += 1
    return outcomes


def guided(target: str, seconds: float, keep: Path) -> None:
    """Let Atheris search for new paths through a decoder. This ends the process."""
    import atheris

    with atheris.instrument_imports(include=["amiwarp"]):
        targets = dict(_targets())

    def once(data: bytes) -> None:
        with contextlib.suppress(AmiwarpError):
            targets[target](data)

    keep.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as corpus:
        for k, sample in enumerate(_samples(target)):
            (Path(corpus) / str(k)).write_bytes(sample)
        options = [
            f"-max_total_time={round(seconds)}",
            f"-artifact_prefix={keep}/",
            "-rss_limit_mb=1536",
            "-timeout=60",
        ]
        atheris.Setup([sys.argv[0], *options, corpus], once)
        atheris.Fuzz()


GUIDED = ("stream", "serial", "encoder_csv", "calibration_json", "camera_json", "calib_txt", "text", "aedat2", "aedat3",
          "evt21", "n_mnist")  # fmt: skip


def _targets() -> Iterator[tuple[str, Callable[[bytes], Any]]]:
    # Imported only now, so that Atheris sees the branches of what they import.
    from reference.mutation_files import KINDS
    from reference.mutation_frames import read_serial, read_stream

    yield "stream", read_stream
    yield "serial", read_serial
    for name in GUIDED[2:]:
        yield name, partial(_from_file, KINDS[name])


def _from_file(kind: tuple[str, Any, Callable[[Path], object]], data: bytes) -> None:
    with tempfile.NamedTemporaryFile(
        suffix=kind[0], dir="/dev/shm" if Path("/dev/shm").is_dir() else None
    ) as file:
        file.write(data)
        file.flush()
        kind[2](Path(file.name))


def _samples(target: str) -> Iterator[bytes]:
    from reference.mutation_files import sample
    from reference.mutation_frames import mutated_serial, mutated_stream

    if target in ("stream", "serial"):
        make = mutated_stream if target == "stream" else mutated_serial
        yield from (make(seed) for seed in range(50))
    else:
        yield sample(target)


def summary(outcomes: dict[str, Counter[str]], seconds: float) -> dict[str, Any]:
    total = sum(outcomes.values(), Counter())
    return {
        "total": dict(total),
        "seconds": seconds,
        "kinds": {name: dict(found) for name, found in outcomes.items()},
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, help="time limit: half for files, half for frames")
    parser.add_argument("--files", type=int)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--events", type=int, help="mutated event files of each decoder")
    parser.add_argument("--guided", choices=GUIDED)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("fuzz-findings"))
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if args.guided:
        guided(args.guided, args.seconds or 60.0, args.keep)
    data: dict[str, Any] = {"seed": args.seed}
    for name, run, count in (("files", files, args.files), ("frames", frames, args.frames)):
        if count is None and args.seconds is None:
            continue
        began = time.monotonic()
        until = None if args.seconds is None else began + args.seconds / 2.0
        data[name] = summary(run(count, until, args.seed, args.keep), time.monotonic() - began)
        print(json.dumps({name: data[name]}), flush=True)
    if args.events is not None:
        began = time.monotonic()
        data["events"] = summary(
            event_files(args.events, args.seed, args.keep), time.monotonic() - began
        )
    largest = max(
        resource.getrusage(who).ru_maxrss
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    data["most_memory_mib"] = largest / 1024.0
    if args.out is not None:
        args.out.write_text(json.dumps(data, indent=1) + "\n")
    found = sum(part["total"].get("defects", 0) for part in data.values() if isinstance(part, dict))
    print(f"{found} findings, at most {data['most_memory_mib']:.0f} MiB in one process")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
