"""Everything a CUDA GPU is asked for, in one call: correctness, then every figure, each with the error of its own run.

    python -m benchmarks.gpu FOLDER_OF_PICTURES --out FOLDER [--limit-s 500] [--only tests simulate …]

Runs the tests on the device, then each benchmark as a process of its own; writes one JSON file each, and ends with a
summary. Exit status 1 where anything failed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

NEEDS_FILES = "test_file_keeps"  # writes HDF5 through a plug-in that a bare GPU machine may lack


def commands(folder: Path, out: Path, limit: float) -> dict[str, list[str]]:
    """Every run by name."""
    modules = ("camera", "optics", "iwe", "sharpness", "calibrate", "photometric", "compensate", "simulate")
    tests = [f"tests/test_{m}.py" for m in modules]
    module = [sys.executable, "-m"]
    calibration = [*module, "benchmarks.calibration"]
    device = ["--device", "cuda:0"]
    return {
        "tests": [*module, "pytest", "-q", "-k", f"cuda and not {NEEDS_FILES}", *tests],
        "simulate": [*module, "benchmarks.simulate", *device, "--picture", str(folder / "china.jpg")],
        **{
            what: [*calibration, what, str(folder), "--out", str(out / f"calibration_{what}_cuda.json"), *device,
                   "--limit-s", str(limit)]
            for what in ("moving", "photometric", "refiners", "shares", "costs", "videos", "algorithms", "pictures")
        },
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--limit-s", type=float, default=500.0, help="no new row of a table after so long")
    parser.add_argument("--only", nargs="+")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    failed = []
    for name, command in commands(args.folder, args.out, args.limit_s).items():
        if args.only and name not in args.only:
            continue
        began = time.perf_counter()
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
        (args.out / f"{name}_cuda.log").write_text(done.stdout)
        print(f"{name}: exit {done.returncode}, {time.perf_counter() - began:.0f} s\n{done.stdout[-1500:]}", flush=True)
        if done.returncode:
            failed.append(name)
    print("failed: " + ", ".join(failed) if failed else "all passed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
