"""Speed of amiwarp and of other libraries, with the error of each timed run.

    python -m benchmarks [--device cuda:0] [--only NAME …] [--events N] [--repeats R] [--picture FILE] [--cpu NAME]
        [--out FILE.json]

The methods alternate, one pass each, so that other load on the machine affects all of them equally. The first pass
includes compilation and is reported separately. A run of all cases at full size writes
benchmarks/results/speed_cpu.json or speed_cuda.json, and updates the tables of benchmarks/results/speed.md from both
(``python -m benchmarks.report`` does only the latter). The exit status is 1 if a result is wrong; the row is printed.
"""

from __future__ import annotations

import argparse
import datetime
import gc
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from amiwarp.studies.machine import processor
from amiwarp.tasks import cpu_threads
from benchmarks import report
from benchmarks.cases import CASES, SCENES, Case
from benchmarks.job import Job
from benchmarks.libraries import Missing

ROOT = Path(__file__).parents[1]
LIBRARIES = ("warp-lang", "numpy", "numba", "torch", "cupy")
REST_S = 0.02
"""Pause before each pass on a CPU [s], because other libraries' idle threads spin for a while before they sleep."""


def seconds_of(job: Job, device: str) -> float:
    """Return the duration of one pass [s]. The device is idle before and after the pass."""
    if job.seconds is not None:
        return next(job.seconds)
    if device == "cpu":
        time.sleep(REST_S)
    wp.synchronize_device(device)
    began = time.perf_counter()
    job.run()
    wp.synchronize_device(device)
    return time.perf_counter() - began


def wrong(case: Case, errors: dict[str, float]) -> list[str]:
    """Return the errors that exceed the case's limits, as text."""
    return [
        f"{k} {errors[k]:.3g} > {bar:g}" for k, bar in case.bars.items() if not errors[k] <= bar
    ]


def row_of(case: Case, scene: str) -> dict[str, Any]:
    return {
        "what": case.what, "scene": scene, "name": case.name, "model": case.model, "vote": case.vote.value,
        "unit": case.unit,
    }  # fmt: skip


def prepared(case: Case, scene: Any, device: str, row: dict[str, Any]) -> Job | None:
    """Return the job after its first pass.

    If its library is missing, return None, and the reason in ``row``.
    """
    try:
        began = time.perf_counter()
        job = case.make(scene, device, case.model, case.vote)
        row["prepare_s"] = time.perf_counter() - began
    except Missing as missing:
        row["skipped"] = str(missing)
        return None
    row["first_s"] = seconds_of(job, device)
    return job


def measured(
    cases: list[Case],
    name: str,
    device: str,
    *,
    events: int | None,
    repeats: int,
    picture: Path | None,
) -> list[dict[str, Any]]:
    """Measure all cases on one scene, and return the results as rows."""
    rows = [row_of(case, name) for case in cases]
    try:
        scene = SCENES[name].make(events or SCENES[name].events[kind(device)], device, picture)
    except Missing as missing:
        for row in rows:
            row["skipped"] = str(missing)
            print(line(row), flush=True)
        return rows
    jobs = [prepared(case, scene, device, row) for case, row in zip(cases, rows, strict=True)]
    seconds: list[list[float]] = [[] for _ in cases]
    for k in range(repeats):
        for case, job, times in zip(cases, jobs, seconds, strict=True):
            if job is not None and k < case.most_repeats:
                times.append(seconds_of(job, device))
    for case, row, job, times in zip(cases, rows, jobs, seconds, strict=True):
        if job is not None:
            errors = job.errors()
            low, middle, high = np.percentile(times, [25, 50, 75])
            row |= {"work": job.work, "median_s": middle, "quartiles_s": [low, high], "rate_per_s": job.work / middle,
                    "events": len(scene), "seconds": times, "errors": errors, "also": job.also(), "note": job.note,
                    "wrong": wrong(case, errors)}  # fmt: skip
        print(line(row), flush=True)
    return rows


def line(row: dict[str, Any]) -> str:
    """Return the result of one case as one line of text."""
    start = f"{row['scene']:20} {row['name']:28}"
    if "skipped" in row:
        return f"{start} skipped: {row['skipped']}"
    low, high = row["quartiles_s"]
    rate = (
        f"{row['rate_per_s'] / 1e6:10.1f} M{row['unit']}/s"
        if row["unit"]
        else f"{row['events']:13,} ev"
    )
    results = ", ".join(f"{k} {v:.4g}" for k, v in (row["errors"] | row["also"]).items())
    bad = f"  WRONG: {'; '.join(row['wrong'])}" if row["wrong"] else ""
    note = f"  ({row['note']})" if row["note"] else ""
    return f"{start} {rate} {row['median_s'] * 1e3:9.3f} ms [{low * 1e3:.3f}, {high * 1e3:.3f}]  {results}{note}{bad}"


def versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    installed = {
        d.metadata["Name"]: d.version
        for d in importlib.metadata.distributions()
        if d.metadata["Name"]
    }
    for name in LIBRARIES:
        for full in sorted(installed):
            if full == name or full.startswith(f"{name}-cuda"):
                found[full] = installed[full]
    return found


def commit() -> str:
    """Return the git commit of the checkout, followed by + if files have changed since."""
    try:
        git = ["git", "-C", str(ROOT), "describe", "--always", "--dirty=+"]
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def about(device: str) -> dict[str, Any]:
    """Return a description of the machine, the library versions, the date and the commit."""
    cpu = f"{processor()}, {cpu_threads()} cores"
    return {
        "machine": cpu if device == "cpu" else wp.get_device(device).name, "host": cpu, "device": device,
        "versions": versions(), "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"), "commit": commit(),
        "load": [round(os.getloadavg()[0], 1)],
    }  # fmt: skip


def rounded(value: Any) -> Any:
    """Return the value with all floats rounded to four significant digits."""
    if isinstance(value, dict):
        return {k: rounded(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(v) for v in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def write(path: Path, results: dict[str, Any]) -> None:
    """Write the results as JSON with one row per line."""
    head = json.dumps({k: v for k, v in results.items() if k != "rows"}, ensure_ascii=False)
    rows = ",\n".join(json.dumps(rounded(row), ensure_ascii=False) for row in results["rows"])
    part = path.with_name(path.name + ".part")
    part.write_text(f'{head[:-1]}, "rows": [\n{rows}\n]}}\n')
    os.replace(part, path)


def kind(device: str) -> str:
    return "cpu" if device == "cpu" else "cuda"


def chosen(device: str, only: list[str] | None) -> list[Case]:
    return [
        c
        for c in CASES
        if kind(device) in c.devices
        and (not only or any(o.lower() in c.name.lower() for o in only))
    ]


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="only cases whose name contains NAME"
    )
    parser.add_argument(
        "--scenes", nargs="+", choices=SCENES, default=list(SCENES), metavar="SCENE"
    )
    parser.add_argument(
        "--events", type=int, help="events per scene; the error limits are for the default"
    )
    parser.add_argument(
        "--repeats", type=int, default=15, help="passes of each method; complete jobs have fewer"
    )
    parser.add_argument(
        "--picture", type=Path, help="scene of the recording; default: PyVista's map of the earth"
    )
    parser.add_argument(
        "--cpu",
        metavar="NAME",
        help="older processor to compile for; haswell has AVX2, not AVX-512",
    )
    parser.add_argument("--out", type=Path)
    args = parser.parse_args(arguments)
    if not chosen(args.device, args.only):
        names = ", ".join(c.name for c in chosen(args.device, None))
        parser.error(f"no case for {kind(args.device)} matches --only; the cases are: {names}")
    return args


def compile_for(cpu: str) -> None:
    """Let Warp, Numba and PyTorch compile for this processor, of which PyTorch only knows whether it has AVX-512."""
    wp.config.cpu_compiler_flags = str(wp.config.cpu_compiler_flags).replace(
        "-march=native", f"-target-cpu {cpu}"
    )
    os.environ["NUMBA_CPU_NAME"], os.environ["NUMBA_CPU_FEATURES"] = cpu, ""
    os.environ["ATEN_CPU_CAPABILITY"] = "avx2"


def main(arguments: list[str] | None = None) -> int:
    args = parse(arguments)
    if args.cpu:
        compile_for(args.cpu)
    cases = chosen(args.device, args.only)
    whole = args.only is None and args.events is None and len(args.scenes) == len(SCENES)
    out = args.out or (report.FILES[kind(args.device)] if whole else None)
    picture = args.picture.name if args.picture else "earth"
    results = about(args.device) | {
        "repeats": args.repeats,
        "picture": picture,
        "cpu": args.cpu,
        "rows": [],
    }
    print(
        json.dumps({k: v for k, v in results.items() if k != "rows"}, ensure_ascii=False),
        flush=True,
    )
    for scene in args.scenes:
        of_scene = [case for case in cases if scene in case.scenes]
        if of_scene:
            results["rows"] += measured(
                of_scene,
                scene,
                args.device,
                events=args.events,
                repeats=args.repeats,
                picture=args.picture,
            )
        if args.out is not None:
            write(args.out, results)  # so that an interrupted run keeps the scenes before
        gc.collect()
    results["load"].append(round(os.getloadavg()[0], 1))
    if out is not None:
        write(out, results)
    if out in report.FILES.values():
        report.write_page()
    bad = [
        f"{row['scene']}, {row['name']}: {'; '.join(row['wrong'])}"
        for row in results["rows"]
        if row.get("wrong")
    ]
    print("wrong answers:\n" + "\n".join(bad) if bad else "all answers are correct")
    return 1 if bad else 0


if __name__ == "__main__":
    wp.init()
    sys.exit(main())
