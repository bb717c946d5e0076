"""The measured cases, as data.

To add a row, add a :class:`Case` and a function that makes its :class:`Job`. To add a kind of scene, add an entry to
``SCENES``; to add a target, add an entry to ``AIMS``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from amiwarp import Vote
from amiwarp.calib.settings import STAGES
from benchmarks import libraries, ours
from benchmarks.job import Job
from benchmarks.peers import image
from benchmarks.scenes import RECORDED, event_scene, file_scene, recording_scene


@dataclass(frozen=True, slots=True)
class SceneKind:
    """Kind of input on which cases are measured."""

    make: Callable[[int, str, Path | None], Any]
    """Function that makes the input from the number of events, the device and the picture of the scene."""
    events: dict[str, int]
    """Default number of events on a CPU and on CUDA."""


def _events(name: str, points: int) -> SceneKind:
    return SceneKind(
        lambda n, *_: event_scene(name, n, points=points), {"cpu": 5_000_000, "cuda": 100_000_000}
    )


EVENT_SCENES = ("random pixels", "20,000 edge points", "500 edge points")
RECORDING, FILE = "simulated recording", "recording in a file"
SCENES = {
    **{
        name: _events(name, points)
        for name, points in zip(EVENT_SCENES, (0, 20_000, 500), strict=True)
    },
    RECORDING: SceneKind(recording_scene, {"cpu": RECORDED, "cuda": RECORDED}),
    FILE: SceneKind(lambda n, *_: file_scene(n), {"cpu": 100_000_000, "cuda": 100_000_000}),
}

IMAGE = "image of warped events"
PREPARED = "votes of prepared events, 12 candidates a pass"
SHARPNESS = "calibration without a guess, sharpness stage"
BOTH = "calibration without a guess, both stages"
PICTURE = "picture of one turn, from given parameters"
MOVED = "compensation of a file"
EXACT_PX = {"plane circle": 4.0, "circle": 2.5, "radial": 0.1, "ellipse": 0.02, "exact": 0.002}
"""Largest accepted rms error of each model's positions [px]: slightly above the model's error with this camera."""


@dataclass(frozen=True, slots=True)
class Case:
    """Method that is measured on one or more kinds of scene."""

    what: str
    """Task of the method; the results of one task share a table."""
    name: str
    """Name of the method."""
    make: Callable[[Any, str, str, Vote], Job]
    """Function of scene, device, model and vote that prepares the data and returns the :class:`Job`."""
    model: str = "plane circle"
    """Optical model that the method compensates."""
    vote: Vote = Vote.BILINEAR
    """How an event's vote is shared among pixels."""
    scenes: tuple[str, ...] = EVENT_SCENES
    """Scenes on which the case runs."""
    devices: tuple[str, ...] = ("cpu", "cuda")
    """Kinds of device on which the case runs."""
    bars: dict[str, float] = field(default_factory=dict)
    """Largest accepted error by name. With a larger error, or NaN, the result is wrong."""
    unit: str = "ev"
    """Unit of the job's ``work``; empty if the time itself is reported."""
    most_repeats: int = 1_000
    """Largest number of timed passes of the method."""


def image_bars(model: str, vote: Vote) -> dict[str, float]:
    """Return the largest accepted errors of an image of events.

    Votes in steps of 1/256 px misplace 0.2 % of the votes, less if more events meet in a pixel. A nearest vote at half
    a pixel may go to either side, so a pixel may differ by a few events.
    """
    return {
        "misplaced": 4e-3,
        "local": 6e-3 if vote is Vote.BILINEAR else 0.3,
        "exact_px": EXACT_PX[model],
    }


def _peer(
    name: str, way: Callable[..., libraries.Peer], *devices: str, most_repeats: int = 1_000
) -> Case:
    bars = image_bars("plane circle", Vote.BILINEAR)
    return Case(
        IMAGE, name, partial(image, way), devices=devices, bars=bars, most_repeats=most_repeats
    )


LADDER = tuple(
    Case(
        IMAGE,
        f"amiwarp {model} {vote.value}",
        ours.image,
        model,
        vote,
        bars=image_bars(model, vote),
    )
    for model in ("circle", "radial", "ellipse", "exact")
    for vote in (Vote.BILINEAR, Vote.NEAREST)
)
PEERS = (
    _peer("NumPy", libraries.with_numpy, "cpu"),
    _peer("NumPy, blocks of 65,536", partial(libraries.with_numpy, block=libraries.BLOCK), "cpu"),
    _peer("Numba", libraries.with_numba, "cpu"),
    _peer("Numba, angle table", libraries.with_numba_table, "cpu"),
    _peer("PyTorch", libraries.with_torch, "cpu", "cuda"),
    _peer("PyTorch, blocks of 65,536", partial(libraries.with_torch, block=libraries.BLOCK), "cpu", most_repeats=5),
    _peer("PyTorch, index_put_", libraries.with_torch_index_put, "cpu", most_repeats=5),
    _peer("CuPy add.at", libraries.with_cupy, "cuda"),
    _peer("CuPy, four float atomics", libraries.with_cupy_kernel, "cuda"),
    Case(IMAGE, "Warp, four float atomics", ours.warp_atomics, devices=("cuda",),
         bars=image_bars("plane circle", Vote.BILINEAR)),
)  # fmt: skip
PREPARED_VOTES = tuple(
    Case(PREPARED, f"amiwarp circle {vote.value}, prepared", ours.prepared, "circle", vote, devices=("cuda",),
         bars=image_bars("circle", vote), unit="votes")
    for vote in (Vote.BILINEAR, Vote.NEAREST)
)  # fmt: skip
WHOLE = (
    Case(SHARPNESS, "amiwarp sharpness stage", partial(ours.calibration, stages=STAGES[:1]), "exact",
         scenes=(RECORDING,), bars={"model_px": 0.3}, unit="", most_repeats=7),
    Case(BOTH, "amiwarp both stages", partial(ours.calibration, stages=STAGES), "exact",
         scenes=(RECORDING,), bars={"model_px": 0.02}, unit="", most_repeats=7),
    Case(PICTURE, "amiwarp picture", ours.picture, "exact",
         scenes=(RECORDING,), bars={"decorrelation": 0.1}, unit="", most_repeats=7),
    *(
        Case(MOVED, f"amiwarp {model}, file to file", ours.file, model,
             scenes=(FILE,), bars={"places_px": 1e-3}, most_repeats=ours.FILE_PASSES)
        for model in ("circle", "exact")
    ),
)  # fmt: skip
"""Cases of complete tasks, from end to end."""
CASES = (*LADDER, *PEERS, *PREPARED_VOTES, *WHOLE)


@dataclass(frozen=True, slots=True)
class Aim:
    """Target of the benchmarks: a rate, a time, a memory size, or a ratio between two cases."""

    what: str
    """Description of the target in the table of targets."""
    device: str
    """Kind of device for which the target holds: cpu or cuda."""
    of: str
    """Name of the case to which the target applies."""
    bars: dict[str, float]
    """Target value of each scene, by name of the scene."""
    unit: str
    """Unit of the target, which also determines whether it is a minimum or a maximum.

    Rates such as ``Gev/s`` and ``x faster`` are minima. ``s``, ``x time`` and ``MiB`` (peak memory of the process) are
    maxima.
    """
    compared_with: str | None = None
    """Name of the case to compare with, pass by pass of the same run."""


def _everywhere(bar: float, scenes: tuple[str, ...] = EVENT_SCENES) -> dict[str, float]:
    return dict.fromkeys(scenes, bar)


def _whole(device: str, seconds: tuple[float, float, float], mev_per_s: float) -> tuple[Aim, ...]:
    """Return the targets of the complete tasks on one kind of device: both calibrations, the picture and the file."""
    names, moved = [case.name for case in WHOLE[:3]], WHOLE[-1].name
    whats = (SHARPNESS, "the same with the photometric stage, to 0.02 px", PICTURE)
    return (
        *(
            Aim(what, device, of, {RECORDING: bar}, "s")
            for what, of, bar in zip(whats, names, seconds, strict=True)
        ),
        Aim("compensation of a file, exact model", device, moved, {FILE: mev_per_s}, "Mev/s"),
        Aim("the same, peak memory", device, moved, {FILE: 1024.0}, "MiB"),
    )


CIRCLE, EXACT = "amiwarp circle bilinear", "amiwarp exact bilinear"
AIMS = (
    Aim("bilinear image, one pass, from device memory, exact model", "cuda", EXACT,
        dict(zip(EVENT_SCENES, (80.0, 75.0, 55.0), strict=True)), "Gev/s"),
    Aim("bilinear votes of prepared events", "cuda", "amiwarp circle bilinear, prepared",
        dict(zip(EVENT_SCENES, (350.0, 350.0, 240.0), strict=True)), "Gvotes/s"),
    Aim("nearest votes of prepared events", "cuda", "amiwarp circle nearest, prepared", _everywhere(700.0), "Gvotes/s"),
    Aim("exact model over circle, time", "cuda", EXACT, _everywhere(1.1), "x time", CIRCLE),
    *_whole("cuda", (0.03, 0.08, 0.03), 200.0),
    Aim("bilinear image by the circle, compared with Numba and its table", "cpu", CIRCLE, _everywhere(1.3), "x faster",
        "Numba, angle table"),
    Aim("the same by the exact model", "cpu", EXACT, _everywhere(1.0), "x faster", "Numba, angle table"),
    Aim("exact model over circle, time", "cpu", EXACT, _everywhere(1.5), "x time", CIRCLE),
    *_whole("cpu", (0.3, 1.5, 0.8), 90.0),
)  # fmt: skip
