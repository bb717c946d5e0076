"""Speed of reading event files into arrays, beside other readers in the same run, with all events checked.

    python -m benchmarks.decoders [--events 20000000] [--recording FILE …] [--device cuda:0] [--out FILE.json]

The events are those of tiles that move on a circle before a 640 x 480 sensor, with noise, written as EVT 2.0, EVT 3.0,
DAT, AEDAT 4 and text; ``--recording`` adds files. Each reader runs in a process of its own, ``REPEATS`` times in turns
with the others, on a file that the system holds in memory. ``Mev/s`` is from the least elapsed time, and ``cpu_ns`` the
least processor time per event, which depends less on other load.

``amiwarp file`` opens the file as a user does, with all checks and repairs, and then takes all events, for which large
files are read twice; ``amiwarp pass`` is one pass over the opened file in blocks; ``amiwarp words`` decodes words that
are in memory. On a GPU, ``words on the GPU`` are there before the timing starts, and ``page-locked words`` are copied
to it. A reader is right if its x, y, t and p are those of the events that were written; of ``--recording`` if they are
those of amiwarp, and the table says which columns differ. Writes benchmarks/results/decoders_cpu.json or
decoders_cuda.json. The exit status is 1 if amiwarp reads what was not written.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp import (
    Events,
    EvtDecoder,
    MemoryEvents,
    Recording,
    convert,
    open_recording,
    save_recording,
)
from amiwarp.io.prophesee.raw import read_evt_header
from amiwarp.studies.machine import machine, versions
from benchmarks.corners import moving_tiles

RESULTS = Path(__file__).parent / "results"
REPEATS = 3
SLOW_EVENTS = 6_000_000
"""Number of events of the text file, which all read more slowly."""

Columns = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]
"""Arrays x, y, t and p of all events."""


# Readers, as their users would call them. Each returns a function to time, which returns the columns.


def by_amiwarp_file(path: Path, _: str) -> Callable[[], Columns]:
    def read() -> Columns:
        source = open_recording(path).events
        events = source.slice(0, len(source))
        return events.x, events.y, events.t, events.p

    return read


def by_amiwarp_pass(path: Path, _: str) -> Callable[[], Columns]:

    source = open_recording(path).events

    def read() -> Columns:
        events = Events.concatenate([*source.blocks()])
        return events.x, events.y, events.t, events.p

    return read


def words_in(path: Path) -> tuple[str, NDArray[Any]]:
    """Return the version of EVT of a RAW file, and its words."""

    about = read_evt_header(path)
    return about.version, about.words(path.read_bytes()[about.offset :])


def by_amiwarp_words(path: Path, _: str) -> Callable[[], Columns]:

    version, words = words_in(path)

    def read() -> Columns:
        events = EvtDecoder(version).decode(words)[0].to_host()
        return events.x, events.y, events.t, events.p

    return read


def by_amiwarp_gpu(path: Path, device: str) -> Callable[[], Any]:

    version, words = words_in(path)
    there = wp.array(words, dtype=wp.dtype_from_numpy(words.dtype), device=device)

    def read() -> Any:
        events, _ = EvtDecoder(version, device=device).decode(there)
        wp.synchronize_device(device)
        return events

    return read


def by_amiwarp_page_locked(path: Path, device: str) -> Callable[[], Any]:

    version, words = words_in(path)
    dtype = wp.dtype_from_numpy(words.dtype)
    host = wp.array(words, dtype=dtype, device="cpu", pinned=True)
    there = wp.empty(len(words), dtype=dtype, device=device)

    def read() -> Any:
        wp.copy(there, host)
        events, _ = EvtDecoder(version, device=device).decode(there)
        wp.synchronize_device(device)
        return events

    return read


def by_faery(path: Path, _: str) -> Callable[[], Columns]:
    import faery

    def read() -> Columns:
        events = faery.events_stream_from_file(path).to_array()
        return events["x"], events["y"], events["t"], events["p"]

    return read


def by_evt3(path: Path, _: str) -> Callable[[], Columns]:
    import evt3

    def read() -> Columns:
        events = evt3.decode_file(str(path))
        return events.x, events.y, events.t, events.p

    return read


def by_eventcv(path: Path, _: str) -> Callable[[], Columns]:
    import eventcv

    def read() -> Columns:
        x, y, t, p = eventcv.load(str(path)).numpy().T[:4]
        return x, y, t, p

    return read


def by_evlib(path: Path, _: str) -> Callable[[], Columns]:
    import evlib

    def read() -> Columns:
        frame = evlib.load_events(str(path), sort=False).collect()
        t = frame["t"].dt.total_microseconds()
        return (
            frame["x"].to_numpy(),
            frame["y"].to_numpy(),
            t.to_numpy(),
            frame["polarity"].to_numpy(),
        )

    return read


def by_expelliarmus(path: Path, _: str) -> Callable[[], Columns]:
    from expelliarmus import Wizard

    encoding = "dat" if path.suffix == ".dat" else f"evt{words_in(path)[0][0]}"

    def read() -> Columns:
        events = Wizard(encoding=encoding).read(path)
        return events["x"], events["y"], events["t"], events["p"]

    return read


def by_dv_processing(path: Path, _: str) -> Callable[[], Columns]:
    import dv_processing as dv

    def read() -> Columns:
        recording = dv.io.MonoCameraRecording(str(path))
        parts = []
        while (batch := recording.getNextEventBatch()) is not None:
            parts.append(batch.numpy())
        events = np.concatenate(parts)
        return events["x"], events["y"], events["timestamp"], events["polarity"]

    return read


READERS: dict[str, tuple[Callable[[Path, str], Callable[[], Any]], tuple[str, ...]]] = {
    "amiwarp file": (by_amiwarp_file, (".raw", ".dat", ".aedat4", ".txt")),
    "amiwarp pass": (by_amiwarp_pass, (".raw", ".dat", ".aedat4", ".txt")),
    "amiwarp words": (by_amiwarp_words, (".raw",)),
    "faery": (by_faery, (".raw", ".dat", ".aedat4")),
    "evt3": (by_evt3, (".raw",)),
    "eventcv": (by_eventcv, (".raw", ".aedat4", ".txt")),
    "evlib": (by_evlib, (".raw", ".aedat4", ".txt")),
    "expelliarmus": (by_expelliarmus, (".raw", ".dat")),
    "dv-processing": (by_dv_processing, (".aedat4",)),
}
"""Function of each reader, and the endings of the files that it reads."""
ON_GPU = {"words on the GPU": by_amiwarp_gpu, "page-locked words": by_amiwarp_page_locked}
"""Rows of a GPU."""
PACKAGES = (
    "warp-lang",
    "numpy",
    "faery",
    "evt3",
    "eventcv",
    "evlib",
    "expelliarmus",
    "dv-processing",
)


def columns_of(found: Any) -> Columns:
    """Return what a reader returned as NumPy arrays; polarities as 0 and 1."""
    if not isinstance(found, tuple):
        found = tuple(getattr(found, name).numpy() for name in "xytp")
    x, y, t, p = (np.asarray(values) for values in found)
    return x, y, t, p > 0


def compared(found: Columns, known: Columns) -> str:
    """Return in words how the columns of a reader differ from those that are known; nothing if they do not."""
    if len(found[2]) != len(known[2]):
        return f"{len(found[2]):,} of {len(known[2]):,} events"
    wrong = [(name, int((a != b).sum())) for name, a, b in zip("xytp", found, known, strict=True)]
    return ", ".join(f"{name} of {count:,} events" for name, count in wrong if count)


def run_reader(name: str, path: Path, device: str, known: Path) -> None:
    """Measure one reader in this process, and print its row as JSON."""
    make = ON_GPU[name] if name in ON_GPU else READERS[name][0]
    read = make(path, device)
    if name.startswith("amiwarp") or name in ON_GPU:
        read()  # compiles or loads the kernels
    wall, busy = time.perf_counter(), time.process_time()
    found = read()
    wall, busy = time.perf_counter() - wall, time.process_time() - busy
    columns = columns_of(found)
    written = np.load(known)
    differs = compared(columns, tuple(written[each] for each in "xytp"))  # type: ignore[arg-type]
    print(
        json.dumps({"events": len(columns[2]), "seconds": wall, "busy": busy, "differs": differs})
    )


def write_evt2(path: Path, events: Events) -> None:
    """Write events as EVT 2.0, which amiwarp itself does not write."""
    words = events.p.astype(np.uint32) << 28
    words |= (events.t & 0x3F).astype(np.uint32) << 22
    words |= events.x.astype(np.uint32) << 11
    words |= events.y
    high = events.t >> 6
    changes = np.flatnonzero(np.diff(high, prepend=-1))
    words = np.insert(words, changes, (0x8 << 28 | high[changes]).astype(np.uint32))
    path.write_bytes(
        b"% evt 2.0\n% format EVT2;height=480;width=640\n% end\n" + words.astype("<u4").tobytes()
    )


def write_files(folder: Path, count: int) -> list[tuple[Path, Path]]:
    """Write the events in every format. Return each file, and the file with the columns that are known."""

    out = []
    for name, many, endings in (
        ("tiles", count, ("evt3.raw", "dat", "aedat4")),
        ("tiles_text", min(count, SLOW_EVENTS), ("txt",)),
    ):
        events = moving_tiles(many)
        known = folder / f"{name}_known.npz"
        np.savez(known, x=events.x, y=events.y, t=events.t, p=events.p > 0)
        native = folder / f"{name}.h5"
        save_recording(native, Recording(events=MemoryEvents(events, 640, 480)))
        for ending in endings:
            path = folder / f"{name}.{ending}"
            convert(native, path)
            out.append((path, known))
        if "dat" in endings:
            path = folder / f"{name}.evt2.raw"
            write_evt2(path, events)
            out.insert(0, (path, known))
    return out


def measure(path: Path, known: Path, device: str) -> list[dict[str, Any]]:
    """Run all readers of a file in turns, and return a row for each."""
    names = [*ON_GPU]
    if device == "cpu":
        names = [name for name, (_, endings) in READERS.items() if path.suffix in endings]
        if path.suffix == ".raw" and words_in(path)[0] != "3.0":
            names.remove("evt3")
    results: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    missing: dict[str, str] = {}
    for _ in range(REPEATS):
        for name in names:
            if name in missing:
                continue
            command = [
                sys.executable,
                "-m",
                "benchmarks.decoders",
                "--one",
                name,
                str(path),
                str(known),
            ]
            done = subprocess.run(
                [*command, "--device", device], capture_output=True, text=True, timeout=900
            )
            if done.returncode:
                missing[name] = (done.stderr.strip().splitlines() or ["ended without a message"])[
                    -1
                ][:200]
            else:
                results[name].append(json.loads(done.stdout.splitlines()[-1]))
    rows: list[dict[str, Any]] = []
    for name in names:
        if name in missing:
            print(f"  {name:20} {missing[name]}", flush=True)
            rows.append({"reader": name, "missing": missing[name]})
            continue
        runs = results[name]
        events = runs[0]["events"]
        rate = events / min(run["seconds"] for run in runs) * 1e-6
        spread = events / max(run["seconds"] for run in runs) * 1e-6
        cpu_ns = min(run["busy"] for run in runs) / events * 1e9
        row = {
            "reader": name,
            "events": events,
            "mev_per_s": rate,
            "slowest_mev_per_s": spread,
            "cpu_ns": cpu_ns,
        }
        rows.append({**row, "differs": runs[0]["differs"]})
        differs = f"differs: {runs[0]['differs']}" if runs[0]["differs"] else "all events right"
        print(
            f"  {name:20} {rate:9.1f} Mev/s {cpu_ns:8.2f} ns/event on the CPU, {differs}",
            flush=True,
        )
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--events", type=int, default=20_000_000)
    parser.add_argument("--recording", type=Path, nargs="*", default=[])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path)
    parser.add_argument(
        "--one", nargs=3, metavar=("READER", "FILE", "KNOWN"), help=argparse.SUPPRESS
    )
    args = parser.parse_args()
    if args.one:
        run_reader(args.one[0], Path(args.one[1]), args.device, Path(args.one[2]))
        return 0

    before, results = os.getloadavg()[0], {}
    with tempfile.TemporaryDirectory() as folder:
        files = write_files(Path(folder), args.events)
        for k, path in enumerate(args.recording):
            known = Path(folder) / f"recording{k}.npz"
            np.savez(
                known, **dict(zip("xytp", columns_of(by_amiwarp_file(path, "cpu")()), strict=True))
            )
            files.append((path, known))
        if args.device != "cpu":
            files = [(path, known) for path, known in files if path.suffix == ".raw"]
        for path, known in files:
            size = path.stat().st_size
            print(f"{path.name}: {size / 1e6:.1f} MB", flush=True)
            results[path.name] = {"bytes": size, "rows": measure(path, known, args.device)}
    report = {
        "machine": machine(args.device),
        "cpu": machine("cpu"),
        "load": [before, os.getloadavg()[0]],
    }
    report |= {"versions": versions(PACKAGES), "files": results}
    kind = "cpu" if args.device == "cpu" else "cuda"
    (args.out or RESULTS / f"decoders_{kind}.json").write_text(json.dumps(report, indent=1) + "\n")
    ours = [
        row
        for file in results.values()
        for row in file["rows"]
        if row["reader"].startswith(("amiwarp", *ON_GPU))
    ]
    return int(any(row.get("differs", "missing") for row in ours))


if __name__ == "__main__":
    sys.exit(main())
