"""Ground truth of AMI-Bench's recordings, which is kept apart from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.array_maps import save_map
from amiwarp.io.output_formats import make_folder
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.simulation.picture_light import DARK
from amiwarp.simulation.truth_renderer import TruthRenderer
from amiwarp.simulation.worlds.world import World
from amiwarp.studies.bench.answer_files import ArrayField, read_arrays
from amiwarp.studies.bench.specification import PLAIN, PRISM, Entry
from amiwarp.studies.evaluate.flow import edge_pixels
from amiwarp.studies.evaluate.inertial import true_rates
from amiwarp.tasks import Progress, silent

BALL = "ball"
"""Name of the body that is detected."""
LEAST_BALL = 20
"""Fewest pixels of the ball that the specification may have in a recording with the task detection."""


@dataclass(frozen=True, eq=False)
class BenchTruth:
    """Ground truth of a recording."""

    optics: NDArray[np.float64]
    """Apex angle [rad], refractive index, and phase of the prism [rad], shape (3,)."""
    log: NDArray[np.float32]
    """Log luminance without the prism at the moment, shape (height, width)."""
    flow: NDArray[np.float32]
    """Optical flow without the prism at the moment [px/s], shape (height, width, 2); NaN where it is not defined."""
    edges: NDArray[np.bool_]
    """Pixels at the edges of the true picture, shape (height, width)."""
    ball: NDArray[np.bool_]
    """Pixels of the ball, shape (height, width)."""
    rates: NDArray[np.float64]
    """Mean angular velocity of the camera in its own frame in each window [deg/s], shape (n, 3)."""

    def model(self, entry: Entry) -> ExactModel:
        """Return the true model of the prism."""
        apex, index, phase = self.optics.tolist()
        return ExactModel(entry.camera, Prism(apex, index), phase)


def truth_of(entry: Entry, device: str = "cpu") -> BenchTruth:
    """Return the ground truth of a recording, from its specification. No events are simulated."""
    rig = entry.rig(device)
    behind_prism = rig.simulation(PRISM)
    moment = TruthRenderer(rig.simulation(PLAIN)).at(entry.moment_us)
    ball = np.isin(moment.instance, _instances(rig.world))
    if "detection" in entry.tasks and np.count_nonzero(ball) < LEAST_BALL:
        raise AmiwarpError(
            f"{entry.name}: the ball has {np.count_nonzero(ball)} pixels at the moment; choose another seed in the "
            "specification"
        )
    rates = true_rates(rig.trajectory_of(PRISM), entry.rotation_ends_us)
    known = behind_prism.truth_parameters()
    return BenchTruth(
        optics=np.array([known["apex"], known["index"], known["phase"]]),
        log=np.log(moment.intensity.astype(np.float64) + DARK).astype(np.float32),
        flow=moment.flow,
        edges=edge_pixels(moment),
        ball=ball,
        rates=np.degrees(rates.rates),
    )


def _instances(world: World) -> list[int]:
    """Return the instance numbers of the ball."""
    return [number for number, name in enumerate(world.instances, start=1) if name == BALL]


def make_truth(
    folder: Path, entries: Sequence[Entry], device: str, progress: Progress = silent
) -> None:
    """Write the ground truth of recordings to a folder, one file for each.

    Raises :class:`AmiwarpError` if a file exists and may not be replaced.
    """
    make_folder(folder)
    for place, entry in enumerate(entries):
        progress(f"truth of {entry.name}", place / len(entries))
        arrays: dict[str, NDArray[Any]] = vars(truth_of(entry, device))
        save_map(folder / f"{entry.name}.npz", "ground truth", arrays, overwrite=False)


def load_truth(folder: Path, entry: Entry) -> BenchTruth:
    """Read the ground truth of a recording. Raises :class:`AmiwarpError`, which names the file and the array."""
    image = (entry.camera.height, entry.camera.width)
    windows = len(entry.rotation_ends_us) - 1
    fields = {
        "optics": ArrayField("f", (3,)),
        "log": ArrayField("f", image),
        "flow": ArrayField("f", (*image, 2), may_be_nan=True),
        "edges": ArrayField("b", image),
        "ball": ArrayField("b", image),
        "rates": ArrayField("f", (windows, 3)),
    }
    path = folder / f"{entry.name}.npz"
    return BenchTruth(**read_arrays(path, fields, "make it with 'amiwarp bench truth'"))
