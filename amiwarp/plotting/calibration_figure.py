"""Figure of a calibration: images before and after compensation, and the cost surface with its samples."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.settings import PHASE
from amiwarp.calib.thinning import thin
from amiwarp.events.recording import Events, Recording
from amiwarp.imaging.export import PERCENTILE
from amiwarp.imaging.iwe import iwe
from amiwarp.imaging.palette import BLACK, BLUE, ORANGE, VERMILION
from amiwarp.optics.models.registry import MODELS
from amiwarp.plotting.figures import blank, save
from amiwarp.results.calibration import Calibration, PhotometricSummary, cost_surface

EVENTS = 2_000_000
"""Largest number of events in the image of a figure; more events are thinned evenly."""
FOUND = VERMILION
"""Colour of the calibrated parameters."""
TRUTH = BLACK
"""Colour of the true parameters."""
LOCAL = ORANGE
"""Colour of the samples of the local search."""
SHARPEST = BLUE
"""Colour of the sharpest parameters."""
FEWEST_SAMPLES = 10
"""Smallest number of samples of which a map is drawn."""
LEGEND = "#dddddd"
"""Background of the legend, on which white and orange marks can be seen."""
HATCHES = "#999999"
"""Colour of the hatches where nothing was sampled."""


@dataclass(frozen=True)
class Images:
    """Images of the events before and after compensation [events per pixel], shape ``(height, width)`` each."""

    before: NDArray[np.float32]
    """Image of the events as recorded [events per pixel], shape ``(height, width)``."""
    after: NDArray[np.float32]
    """Image of the compensated events [events per pixel], shape ``(height, width)``."""

    @property
    def top(self) -> float:
        """Number of events per pixel that both images show as white."""
        counts = self.after[self.after > 0]
        return float(np.percentile(counts, PERCENTILE)) if counts.size else 1.0


def draw_calibration(
    path: Path, recording: Recording, calibration: Calibration, *, device: Any
) -> None:
    """Draw the images before and after compensation, and the cost surface with the samples of all stages."""
    figure = blank((14.0, 4.8), layout="compressed")
    axes = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 0.8))
    draw_images(axes[:2], images(thin(recording, EVENTS), recording, calibration, device=device))
    draw_cost(figure, axes[2], calibration)
    save(figure, path)


def images(
    events: Events, recording: Recording, calibration: Calibration, *, device: Any
) -> Images:
    """Return the images of ``events`` before and after compensation, made on the device."""
    source = recording.events
    encoder = calibration.encoder_for(recording.encoder, source.t_first, source.t_last)
    before = iwe(events, *source.size, device=device)
    after = iwe(events, *source.size, model=calibration.model, encoder=encoder, device=device)
    return Images(before, after)


def draw_images(axes: Any, pair: Images) -> None:
    """Draw the images before and after compensation on the same scale."""
    for ax, image, title in zip(axes, (pair.before, pair.after), ("before", "after"), strict=True):
        show(ax, image, pair.top, f"events {title} compensation")


def show(ax: Any, image: NDArray[np.float32], top: float, title: str) -> None:
    """Draw an image of events; brightness is the square root of the count."""
    from matplotlib.colors import PowerNorm

    ax.imshow(image, cmap="gray", norm=PowerNorm(0.5, 0.0, top, clip=True), interpolation="nearest")
    ax.set(xticks=(), yticks=())
    ax.set_title(title)


def draw_cost(
    figure: Any, ax: Any, calibration: Calibration, truth: tuple[float, float] | None = None
) -> None:
    """Draw the global search's cost over (size cos phase, size sin phase), all samples, and the result.

    If the photometric stage has moved the result, the sharpest parameters are marked too. Where nothing was sampled,
    the map is hatched. ``truth`` is the true size and phase [rad]. Without a global search only the samples are drawn.
    """
    calibration = calibration.exact
    size = MODELS[calibration.model_name].SIZE
    sizes, phases, costs, stages = cost_surface(calibration.stages, size).T
    x = np.degrees(sizes) * np.cos(phases)
    y = np.degrees(sizes) * np.sin(phases)
    of_global_search = np.array([stage.name == "global" for stage in calibration.stages], bool)
    coarse = of_global_search[stages.astype(int)]

    # A map needs samples that span an area.
    if coarse.sum() >= FEWEST_SAMPLES and np.ptp(x[coarse]) > 0 and np.ptp(y[coarse]) > 0:
        _draw_map(figure, ax, (x[coarse], y[coarse]), costs[coarse], calibration)
    ax.plot(
        x[~coarse],
        y[~coarse],
        "+",
        color=LOCAL,
        markersize=7,
        markeredgewidth=1.4,
        label="local search",
    )
    found = _polar(calibration.parameters[size], calibration.parameters["phase"])
    moved = ""
    stage = calibration.photometric
    if stage is not None and _draw_sharpest(ax, stage, size):
        moved = f"\nphotometric stage moved it by {stage.moved_px:.2g} px"
    ax.plot(
        *found,
        "o",
        markersize=13,
        fillstyle="none",
        color=FOUND,
        markeredgewidth=2.2,
        label="found",
    )

    if truth is not None:
        ax.plot(*_polar(*truth), "x", color=TRUTH, markersize=9, markeredgewidth=1.8, label="true")
    reach = 1.05 * max(np.abs([*x, *y, *found]))
    ax.set(xlim=(-reach, reach), ylim=(-reach, reach), box_aspect=1.0)
    ax.set(xlabel=f"{size} · cos phase [deg]", ylabel=f"{size} · sin phase [deg]")
    ax.set_title(f"cost surface and its samples{moved}")
    below = 0.5, -0.15  # below the axes, where it covers nothing of the map
    ax.legend(
        loc="upper center",
        bbox_to_anchor=below,
        ncols=3,
        fontsize=9,
        facecolor=LEGEND,
        framealpha=1.0,
    )


def _draw_map(
    figure: Any,
    ax: Any,
    places: tuple[NDArray[np.float64], NDArray[np.float64]],
    costs: NDArray[np.float64],
    calibration: Calibration,
) -> None:
    """Draw the map of the global search's costs, with its samples at ``places``, columns and rows [deg]."""
    surface = ax.tricontourf(*places, costs, levels=24, cmap="cividis")
    label = f"sharpness ({calibration.sharpness_name}, coarse image)"
    if any(stage.algorithm == PHASE for stage in calibration.stages):
        label = "minus the unexplained share of the sums in phase"
    figure.colorbar(surface, ax=ax, label=label, shrink=0.85)
    dots = {
        "color": "white",
        "markersize": 4.0,
        "markeredgecolor": "black",
        "markeredgewidth": 0.7,
    }
    ax.plot(*places, "o", label="global search", **dots)
    _hatch_the_unsampled(ax)


def _hatch_the_unsampled(ax: Any) -> None:
    """Hatch the background of a map, which shows where nothing was sampled, and name it in the legend."""
    how = {"facecolor": "white", "edgecolor": HATCHES, "hatch": "////", "linewidth": 0.0}
    ax.patch.set(**how)
    ax.fill((), (), label="not sampled", **how)  # draws nothing but the legend's entry


def _draw_sharpest(ax: Any, stage: PhotometricSummary, size: str) -> bool:
    """Mark the sharpest parameters if the photometric stage has moved the result from them; return whether it has."""
    parameters = stage.sharpness_parameters
    if not stage.accepted or size not in parameters or "phase" not in parameters:
        return False
    sharpest = _polar(parameters[size], parameters["phase"])
    ax.plot(
        *sharpest,
        "s",
        markersize=8,
        fillstyle="none",
        color=SHARPEST,
        markeredgewidth=1.6,
        label="sharpest",
    )
    return True


def _polar(size: float, phase: float) -> tuple[float, float]:
    """Return size · cos phase and size · sin phase [deg]."""
    return math.degrees(size) * math.cos(phase), math.degrees(size) * math.sin(phase)
