"""Everything a CUDA GPU is asked for, in one call: correctness, then every figure, each with the error of its own run.

    python -m benchmarks.gpu FOLDER_OF_PICTURES --out FOLDER [--limit-s 500] [--only tests speed …]

Runs the tests on the device, then each benchmark as a process of its own: ``speed`` is ``python -m benchmarks``,
``chart`` the two charts. Writes what they found beside what they said, and ends with a summary. Exit status 1 where
anything failed.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
import time
from pathlib import Path

PICTURE = "china.jpg"
TESTS = (
    "camera", "optics", "iwe", "tiles", "uploads", "sharpness", "calibrate", "photometric", "compensate", "compensator",
    "simulate", "translate", "benchmarks",
)  # fmt: skip
"""Of what runs on a device, and needs neither the command line's packages nor video."""
PLUGIN = () if importlib.util.find_spec("hdf5plugin") else ("test_file_keeps",)
"""What writes HDF5 through a plug-in that a bare GPU machine may lack."""


def commands(folder: Path, out: Path, limit: float) -> dict[str, list[str]]:
    """Every run by name."""
    tests = [f"tests/test_{name}.py" for name in TESTS]
    module = [sys.executable, "-m"]
    calibration = [*module, "benchmarks.calibration"]
    picture, device = str(folder / PICTURE), ["--device", "cuda:0"]
    return {
        "tests": [*module, "pytest", "-q", "-k", " and not ".join(("(cuda or test_tiles)", *PLUGIN)), *tests],
        "speed": [*module, "benchmarks", *device, "--picture", picture, "--out", str(out / "speed_cuda.json")],
        "chart": [*module, "benchmarks.chart", picture, *device, "--out", str(out / "chart")],
        "stream": [*module, "benchmarks.stream", *device, "--picture", picture, "--out", str(out / "stream_cuda.json")],
        "simulate": [*module, "benchmarks.simulate", *device, "--picture", picture],
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
