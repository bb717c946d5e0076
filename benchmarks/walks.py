"""Walks through the code: in how many files a function runs during a main call, and how deep the deepest launch is.

    python -m benchmarks.walks [--only NAME …] [--list]

Someone who follows a call from the front door to a kernel opens these files, and keeps these frames in mind. The calls
are ``compensate`` from a native file to one, ``calibrate`` with the default settings, and ``compensate_live`` of the
file, each without its first pass, in which kernels are loaded. Only functions of amiwarp count: neither the body of a
module or class, nor a comprehension. Frames are counted in the thread that launches, because a thread's job begins a
new stack. ``--list`` prints the files, with the functions that run in each, and the frames.
"""

from __future__ import annotations

import argparse
import inspect
import sys
import tempfile
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np
import warp as wp

import amiwarp

PACKAGE = Path(amiwarp.__file__).parent
LAUNCHES = frozenset({"launch", "capture_launch"})
"""Names of Warp's functions that start kernels."""
SIZE = (160, 120)
DURATION_S = 0.25
"""Size [px] and duration [s] of the simulated recording: three turns, enough for a calibration."""


@dataclass
class Walk:
    """Functions of amiwarp that ran during a call."""

    functions: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    """Names of the functions that ran, by the path of their file."""
    deepest: tuple[str, ...] = ()
    """Frames of amiwarp from the call to the deepest launch, the outermost first."""


def is_function(code: CodeType) -> bool:
    """Return whether code is a function's: neither the body of a module or class, nor a comprehension."""
    if code.co_name.startswith("<") and code.co_name != "<lambda>":
        return False
    return bool(code.co_flags & inspect.CO_OPTIMIZED)


def own_path(code: CodeType) -> str:
    """Return the path of code below the package, or an empty string for other code."""
    path = Path(code.co_filename)
    return str(path.relative_to(PACKAGE)) if path.is_relative_to(PACKAGE) else ""


class Walker:
    """Profile function for all threads, which notes functions and launches while a walk is followed."""

    def __init__(self) -> None:
        self._walk: Walk | None = None
        self._paths: dict[CodeType, str] = {}
        self._warp = str(Path(wp.__file__).parent)

    @contextmanager
    def following(self) -> Iterator[Walk]:
        """Yield the walk that is filled during the block."""
        self._walk = Walk()
        try:
            yield self._walk
        finally:
            self._walk = None

    def __call__(self, frame: FrameType, event: str, argument: Any) -> None:
        """Note a call."""
        walk = self._walk
        if walk is None or event != "call":
            return
        code = frame.f_code
        path = self._path(code)
        if path:
            walk.functions[path].add(code.co_qualname)
        elif code.co_name in LAUNCHES and code.co_filename.startswith(self._warp):
            frames = self._frames(frame)
            if len(frames) > len(walk.deepest):
                walk.deepest = frames

    def _path(self, code: CodeType) -> str:
        """Return the path of a function of amiwarp below the package, or an empty string for other code."""
        if code not in self._paths:
            self._paths[code] = own_path(code) if is_function(code) else ""
        return self._paths[code]

    def _frames(self, frame: FrameType) -> tuple[str, ...]:
        """Return the functions of amiwarp on the stack, the outermost first."""
        frames = []
        current: FrameType | None = frame
        while current is not None:
            path = self._path(current.f_code)
            if path:
                frames.append(f"{path} {current.f_code.co_qualname}")
            current = current.f_back
        return tuple(reversed(frames))


def make_calls(folder: Path) -> dict[str, Callable[[], object]]:
    """Simulate a recording into a folder, and return the calls by name."""
    width, height = SIZE
    rng = np.random.default_rng(0)
    squares = rng.integers(0, 255, (60, 80), dtype=np.uint8)
    texture = np.kron(squares, np.ones((8, 8), np.uint8))
    camera = amiwarp.Camera.from_fov(width, height, 0.9)
    simulated = amiwarp.simulate(
        texture, camera, amiwarp.Prism(apex=0.02), duration_s=DURATION_S, seed=0
    )
    path = folder / "recording.h5"
    amiwarp.save_recording(path, simulated)
    recording = amiwarp.open_recording(path)
    calibration = amiwarp.calibrate(recording)

    def live() -> None:
        with amiwarp.compensate_live(
            path, calibration, fast=True, say=lambda words: None
        ) as packets:
            for _ in packets:
                pass

    def compensate() -> None:
        amiwarp.compensate(recording, calibration, folder / "compensated.h5", overwrite=True)

    return {
        "compensate": compensate,
        "calibrate": lambda: amiwarp.calibrate(recording),
        "live": live,
    }


def main() -> None:
    """Print a row for each call: files, frames."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", help="calls to follow; default: all")
    parser.add_argument("--list", action="store_true", help="print the files and the frames")
    arguments = parser.parse_args()

    walker = Walker()
    # Threads that start later inherit the function, so it is set before the first pass.
    threading.setprofile(walker)
    sys.setprofile(walker)
    with tempfile.TemporaryDirectory() as folder:
        for name, call in make_calls(Path(folder)).items():
            if arguments.only and name not in arguments.only:
                continue
            call()
            with walker.following() as walk:
                call()
            print(f"{name:12} {len(walk.functions):3} files {len(walk.deepest):3} frames")
            if arguments.list:
                for path, functions in sorted(walk.functions.items()):
                    print(f"    {path}: {', '.join(sorted(functions))}")
                for frame in walk.deepest:
                    print(f"        {frame}")


if __name__ == "__main__":
    main()
