"""What limits the votes on CUDA: hardware counters of their kernels, read by Nsight Compute.

    python -m benchmarks.bounds [--events 20000000] [--out FILE.json]      on a machine with a GPU and ncu
    python -m benchmarks.bounds --from counters.csv --plan plan.json       results of an earlier run of ncu

The first command runs ncu on this module, which votes each case twice and lets ncu read the second pass:

    ncu --profile-from-start off --kernel-name regex:"vote_|four_atomics|mark_case" --clock-control none \\
        --cache-control none --csv --page raw --print-units base --metrics gpu__time_duration.sum,... \\
        --log-file counters.csv python -m benchmarks.bounds --run plan.json

A kernel ``mark_case`` runs before each case; the size of its grid is the number of the case. Images of events and
prepared votes run on the scenes of the benchmark, and the images are checked as there. ``instructions_per_vote`` counts
instructions of a thread, ``issue_percent`` the share of clock cycles in which a scheduler issues an instruction while
its multiprocessor is busy. ``stalls`` are warps that wait for each reason per issued instruction. Writes
benchmarks/results/bounds_cuda.json. The exit status is 1 if an image is wrong or a case has no counters.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import gc
import itertools
import json
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import warp as wp

from benchmarks.__main__ import about, rounded, wrong
from benchmarks.cases import CASES, EVENT_SCENES, SCENES, Case

wp.set_module_options({"enable_backward": False})

RESULTS = Path(__file__).parent / "results" / "bounds_cuda.json"
NAMES = (
    "amiwarp circle bilinear", "amiwarp exact bilinear", "amiwarp circle nearest", "Warp, four float atomics",
    "amiwarp circle bilinear, prepared", "amiwarp circle nearest, prepared",
)  # fmt: skip
BLOCK = 256
"""Number of threads per block of :func:`mark_case`."""
NCU = ("/opt/nvidia/nsight-compute/2025.3.1/ncu", "/usr/local/cuda/bin/ncu")
"""Places of ncu if it is not on the path."""
DURATION, INSTRUCTIONS, THREADS = "gpu__time_duration.sum", "sm__inst_executed.sum", "smsp__thread_inst_executed.sum"
PERCENT = {
    "issue_percent": "smsp__issue_active.avg.pct_of_peak_sustained_active",
    "sm_percent": "sm__throughput.avg.pct_of_peak_sustained_elapsed",
    "warps_percent": "sm__warps_active.avg.pct_of_peak_sustained_active",
    "shared_percent": "l1tex__data_pipe_lsu_wavefronts_mem_shared.sum.pct_of_peak_sustained_elapsed",
    "l1_percent": "l1tex__throughput.avg.pct_of_peak_sustained_elapsed",
    "l2_percent": "lts__throughput.avg.pct_of_peak_sustained_elapsed",
    "l2_atomic_percent": "lts__d_atomic_input_cycles_active.avg.pct_of_peak_sustained_elapsed",
    "dram_percent": "dram__throughput.avg.pct_of_peak_sustained_elapsed",
    "clock_hz": "sm__cycles_elapsed.avg.per_second",
}
"""Counters whose mean over the launches of a case is reported, weighted by their duration."""
SUMS = {
    "shared_atomics": "smsp__inst_executed_op_shared_atom.sum",
    "shared_wavefronts": "l1tex__data_pipe_lsu_wavefronts_mem_shared.sum",
    "shared_atomic_wavefronts": "l1tex__data_pipe_lsu_wavefronts_mem_shared_op_atom.sum",
    "shared_conflicts": "l1tex__data_bank_conflicts_pipe_lsu_mem_shared.sum",
    "shared_atomic_conflicts": "l1tex__data_bank_conflicts_pipe_lsu_mem_shared_op_atom.sum",
    "global_reductions": "smsp__inst_executed_op_global_red.sum",
    "global_reduction_sectors": "l1tex__t_sectors_pipe_lsu_mem_global_op_red.sum",
    "l2_reductions": "lts__t_sectors_op_red.sum",
    "l2_atomics": "lts__t_sectors_op_atom.sum",
    "dram_bytes": "dram__bytes.sum",
}
"""Counters that are reported per vote. Instructions and wavefronts are those of a warp."""
FEW = (DURATION, INSTRUCTIONS, THREADS, *list(PERCENT.values())[:3], PERCENT["l2_percent"], PERCENT["dram_percent"])
"""Counters of a second run, if ncu refuses one of the others."""
STALLS = (
    "long_scoreboard", "short_scoreboard", "mio_throttle", "lg_throttle", "math_pipe_throttle", "tex_throttle", "wait",
    "not_selected", "no_instruction", "dispatch_stall", "branch_resolving", "barrier", "membar", "sleeping", "selected",
    "drain", "imc_miss", "misc",
)  # fmt: skip
STALL = "smsp__average_warps_issue_stalled_{}_per_issue_active.ratio"


@wp.kernel
def mark_case(out: wp.array(dtype=int)):
    """Mark in the list of kernels where a case begins."""
    if wp.tid() < 0:
        out[0] = 0


def metrics() -> list[str]:
    """Return the names of all counters."""
    return [DURATION, INSTRUCTIONS, THREADS, *PERCENT.values(), *SUMS.values(), *(STALL.format(s) for s in STALLS)]


def chosen() -> Iterator[tuple[str, Case]]:
    """Yield each scene with each case."""
    by_name = {case.name: case for case in CASES}
    for scene in EVENT_SCENES:
        yield from ((scene, by_name[name]) for name in NAMES)


def run_cases(plan: Path, device: str, events: int) -> None:
    """Vote every case twice, the second time with the profiler on; write the cases and their errors to ``plan``."""
    driver: Any = ctypes.CDLL("libcuda.so.1")
    nothing = wp.zeros(1, dtype=int, device=device)
    wp.get_device(device).make_current()
    rows: list[dict[str, Any]] = []
    for name, cases in itertools.groupby(chosen(), lambda pair: pair[0]):
        scene = SCENES[name].make(events, device, None)
        for _, case in cases:
            job = case.make(scene, device, case.model, case.vote)
            job.run()
            wp.synchronize_device(device)
            if failed := driver.cuProfilerStart():
                raise SystemExit(f"the profiler does not start: CUDA error {failed}")
            wp.launch(mark_case, BLOCK * (len(rows) + 1), [nothing], device=device, block_dim=BLOCK)
            job.run()
            wp.synchronize_device(device)
            driver.cuProfilerStop()
            errors = job.errors()
            rows.append({"scene": name, "name": case.name, "what": case.what, "work": job.work, "errors": errors,
                         "wrong": wrong(case, errors)})  # fmt: skip
            del job
        del scene
        gc.collect()
    plan.write_text(json.dumps(about(device) | {"events": events, "rows": rows}))


def launches(text: str) -> Iterator[dict[str, Any]]:
    """Yield kernel, grid and counters of each launch in ncu's output: one column, or one line, per counter."""
    lines = text.splitlines()
    start = next((k for k, line in enumerate(lines) if line.startswith('"ID"')), None)
    if start is None:
        return
    rows = list(csv.DictReader(lines[start:]))
    if rows and "Metric Name" in rows[0]:
        for _, of_one in itertools.groupby(rows, lambda row: row["ID"]):
            every = list(of_one)
            yield launch_of(every[0], {row["Metric Name"]: row["Metric Value"] for row in every})
        return
    yield from (launch_of(row, row) for row in rows if row["ID"])  # the line below the names holds the units


def launch_of(row: dict[str, str], values: dict[str, str]) -> dict[str, Any]:
    """Return one launch: its kernel, the number of blocks, and its counters that have a number."""
    found: dict[str, float] = {}
    for name in metrics():
        try:
            found[name] = float(values.get(name, "").replace(",", ""))
        except ValueError:
            continue
    grid = int(row["Grid Size"].strip("() ").split(",")[0])
    return {"kernel": row["Kernel Name"], "blocks": grid, "counters": found}


def by_case(text: str) -> dict[int, list[dict[str, Any]]]:
    """Return the launches of each case by its number."""
    found: dict[int, list[dict[str, Any]]] = defaultdict(list)
    number = -1
    for launch in launches(text):
        if "mark_case" in launch["kernel"]:
            number = launch["blocks"] - 1
        elif number >= 0:
            found[number].append(launch)
    return found


def summary(case: dict[str, Any], found: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the row of a case: its counters over all launches, per vote or as a mean weighted by the duration."""
    seconds = sum(launch["counters"][DURATION] for launch in found) * 1e-9

    def total(name: str) -> float | None:
        values = [launch["counters"].get(name) for launch in found]
        return None if None in values else sum(v for v in values if v is not None)

    def mean(name: str) -> float | None:
        weighted = [
            launch["counters"][name] * launch["counters"][DURATION] for launch in found if name in launch["counters"]
        ]
        return sum(weighted) / (seconds * 1e9) if len(weighted) == len(found) else None

    instructions, threads = total(INSTRUCTIONS), total(THREADS)
    per_vote = {name: value / case["work"] for name, key in SUMS.items() if (value := total(key)) is not None}
    stalls = {s: value for s in STALLS if (value := mean(STALL.format(s))) is not None and value >= 0.005}
    return case | {
        "kernels": sorted({launch["kernel"].split("_cuda_kernel")[0] for launch in found}), "launches": len(found),
        "seconds": seconds, "votes_per_s": case["work"] / seconds,
        "instructions_per_vote": None if threads is None else threads / case["work"],
        "warp_instructions_per_vote": None if instructions is None else 32.0 * instructions / case["work"],
        **{name: mean(key) for name, key in PERCENT.items()}, "per_vote": per_vote,
        "stalls": dict(sorted(stalls.items(), key=lambda item: -item[1])),
    }  # fmt: skip


def results(plan: dict[str, Any], text: str) -> dict[str, Any]:
    """Return the results of a run from its plan and the output of ncu."""
    found = by_case(text)
    rows = [
        summary(case, found[k]) if found.get(k) else case | {"skipped": "ncu gave no counters"}
        for k, case in enumerate(plan["rows"])
    ]
    return plan | {"benchmark": "bounds", "rows": rows}


def known_metrics(ncu: str) -> list[str]:
    """Return the counters that this version of ncu knows for this GPU, or all if it does not say."""
    ran = subprocess.run([ncu, "--query-metrics", "--chips", "gh100"], capture_output=True, text=True, check=False)
    known = {line.split()[0] for line in ran.stdout.splitlines() if line.strip()}
    found = [name for name in metrics() if name.split(".")[0] in known]
    return found if DURATION in found else metrics()


def profile(device: str, events: int, folder: Path) -> tuple[dict[str, Any], str]:
    """Run ncu on this module; return the plan and the output of ncu."""
    ncu = shutil.which("ncu") or next((path for path in NCU if Path(path).exists()), None)
    if ncu is None:
        raise SystemExit("ncu is not installed; it is part of Nsight Compute")
    plan, counters = folder / "plan.json", folder / "counters.csv"
    for names in (known_metrics(ncu), FEW):
        command = [
            ncu, "--profile-from-start", "off", "--kernel-name", "regex:vote_|four_atomics|mark_case",
            "--clock-control", "none", "--cache-control", "none", "--csv", "--page", "raw", "--print-units", "base",
            "--metrics", ",".join(names), "--log-file", str(counters), sys.executable, "-m", "benchmarks.bounds",
            "--run", str(plan), "--device", device, "--events", str(events),
        ]  # fmt: skip
        subprocess.run(command, check=False, cwd=Path(__file__).parents[1])
        text = counters.read_text() if counters.exists() else ""
        if plan.exists() and any(launches(text)):
            return json.loads(plan.read_text()), text
    raise SystemExit(f"the run failed: {text[-2000:]}")


def line(row: dict[str, Any]) -> str:
    """Return the result of one case as one line of text."""
    start = f"{row['scene']:20} {row['name']:36}"
    if "skipped" in row:
        return f"{start} {row['skipped']}"
    values = (f"{name} {row[name]:.4g}" for name in ("instructions_per_vote", *PERCENT) if row[name] is not None)
    stalls = ", ".join(f"{k} {v:.2f}" for k, v in list(row["stalls"].items())[:5])
    return f"{start} {row['votes_per_s'] / 1e9:8.1f} G/s  {', '.join(values)}; stalls {stalls}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--events", type=int, default=20_000_000)
    parser.add_argument("--from", type=Path, dest="counters", metavar="counters.csv")
    parser.add_argument("--plan", type=Path, help="plan of the earlier run")
    parser.add_argument("--keep", type=Path, help="folder for the output of ncu and the plan")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--run", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.run:
        run_cases(args.run, args.device, args.events)
        return 0
    if args.counters:
        plan, text = json.loads(args.plan.read_text()), args.counters.read_text()
    else:
        with tempfile.TemporaryDirectory() as name:
            folder = args.keep or Path(name)
            folder.mkdir(parents=True, exist_ok=True)
            plan, text = profile(args.device, args.events, folder)
    found = results(plan, text)
    args.out.write_text(json.dumps(rounded(found), indent=1, ensure_ascii=False) + "\n")
    print("\n".join(line(row) for row in found["rows"]))
    bad = [row["name"] for row in found["rows"] if row["wrong"] or "skipped" in row]
    print(f"wrong or without counters: {', '.join(bad)}" if bad else "all images are right")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
