"""All tests and benchmarks for a CUDA GPU in one call.

    python -m benchmarks.gpu FOLDER_OF_PICTURES --out FOLDER [--limit-s 500] [--only tests speed …]

Runs the tests on the device, then each benchmark in a separate process. ``speed`` is ``python -m benchmarks``;
``chart`` makes the two charts. Writes the results and the logs to FOLDER, and prints a summary at the end. The exit
status is 1 if anything failed.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.copies import ROOT, files_of_tests

PICTURE = "china.jpg"
TESTS = (
    "camera", "optics", "iwe", "tiles", "uploads", "sharpness", "calibrate", "photometric", "compensate", "compensator",
    "simulate", "translate", "benchmarks", "worlds", "sensor", "reconstruct", "auto", "arrays", "dataset",
    "event_sensor", "corners", "edge_directions", "page_locked", "tensors", "device_picture",
)  # fmt: skip
"""Names of the test files that use a device and need neither the packages of the command line nor video."""
PLUGIN = () if importlib.util.find_spec("hdf5plugin") else ("test_file_keeps",)
"""Options that skip tests which need hdf5plugin, if a GPU machine lacks it."""


def commands(folder: Path, out: Path, limit: float) -> dict[str, list[str]]:
    """Return the commands to run, by name."""
    tests = files_of_tests(ROOT, TESTS)
    module = [sys.executable, "-m"]
    calibration = [*module, "benchmarks.calibration"]
    picture, device = str(folder / PICTURE), ["--device", "cuda:0"]
    return {
        "tests": [*module, "pytest", "-q", "-k", " and not ".join(("(cuda or test_tiles)", *PLUGIN)), *tests],
        "speed": [*module, "benchmarks", *device, "--picture", picture, "--out", str(out / "speed_cuda.json")],
        "chart": [*module, "benchmarks.chart", picture, *device, "--out", str(out / "chart")],
        "stream": [*module, "benchmarks.stream", *device, "--picture", picture, "--out", str(out / "stream_cuda.json")],
        "simulate": [*module, "benchmarks.simulate", *device, "--picture", picture],
        "event_sensor": [*module, "benchmarks.event_sensor", *device],
        "worlds": [*module, "benchmarks.worlds", *device, "--out", str(out / "worlds_cuda.json")],
        "worlds_calibration": [*module, "benchmarks.worlds_calibration", *device,
                               "--out", str(out / "worlds_calibration_cuda.json")],
        "dataset": [*module, "benchmarks.dataset", "--device", "cuda", "--limit-s", str(limit),
                    "--out", str(out / "dataset_cuda.json")],
        "two_gpus": [*module, "benchmarks.two_gpus", "--out", str(out / "two_gpus_cuda.json")],
        "corners": [*module, "benchmarks.corners", *device, "--out", str(out / "corners_cuda.json")],
        "tensors": [*module, "benchmarks.tensors", *device, "--out", str(out / "tensors_cuda.json")],
        "phase": [*module, "benchmarks.phase_cuda", *device, "--out", str(out / "phase_cuda.json")],
        **{
            what: [*calibration, what, str(folder), "--out", str(out / f"calibration_{what}_cuda.json"), *device,
                   "--limit-s", str(limit)]
            for what in ("moving", "photometric", "refiners", "shares", "costs", "videos", "algorithms", "pictures")
        },
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--limit-s",
        type=float,
        default=500.0,
        help="start no new row of a table after this time [s]",
    )
    parser.add_argument("--only", nargs="+")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    failed = []
    for name, command in commands(args.folder, args.out, args.limit_s).items():
        if args.only and name not in args.only:
            continue
        began = time.perf_counter()
        log = args.out / f"{name}_cuda.log"
        with log.open("w") as file:
            done = subprocess.run(command, stdout=file, stderr=subprocess.STDOUT, check=False)
        took, said = time.perf_counter() - began, log.read_text()[-1500:]
        print(f"{name}: exit {done.returncode}, {took:.0f} s\n{said}", flush=True)
        if done.returncode:
            failed.append(name)
    print("failed: " + ", ".join(failed) if failed else "all passed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
