"""The figure of a calibration's cost: where nothing was sampled, and what the photometric stage moved."""

import math
from dataclasses import replace
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

from amiwarp import Calibration, Camera, PhotometricSummary, Prism, StageSummary
from amiwarp.plotting.calibration_figure import draw_cost
from amiwarp.plotting.figures import blank
from reference.calibration_sample import exact_calibration

SHARPEST, FOUND = (math.radians(0.8), 0.4), (math.radians(1.0), 0.5)
STAGE = PhotometricSummary(
    accepted=True,
    verdict="",
    parameters={},
    uncertainty={},
    sharpness_parameters={"apex": SHARPEST[0], "phase": SHARPEST[1]},
    moved_px=0.1234,
    cost=0.1,
    cost_at_sharpness=0.2,
    residual=0.1,
    pairs=10,
    off_over_on=1.0,
)


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    """A calibration whose global search sampled only the left half of the plane."""
    x, y = np.meshgrid(np.linspace(-2.0, 0.0, 9), np.linspace(-2.0, 2.0, 9))
    apex, phase = np.radians(np.hypot(x, y)).ravel().tolist(), np.arctan2(y, x).ravel().tolist()
    points = [
        {"apex": size, "phase": angle, "score": float(k)}
        for k, (size, angle) in enumerate(zip(apex, phase, strict=True))
    ]
    searched = StageSummary(
        name="global",
        algorithm="GN_DIRECT_L",
        evaluations=81,
        seconds=1.0,
        sharpness=80.0,
        ended="",
        points=points,
    )
    found = exact_calibration(
        Camera.from_fov(64, 48, 0.7), Prism(FOUND[0]), {"apex": FOUND[0], "phase": FOUND[1]}
    )
    return replace(found, stages=(searched,))


def drawn(calibration: Calibration) -> tuple[Any, dict[str, Any]]:
    """Return the axes of the figure, and the entries of its legend by name."""
    figure = blank((5.0, 4.0))
    axes = figure.subplots()
    draw_cost(figure, axes, calibration)
    figure.canvas.draw()
    handles, names = axes.get_legend_handles_labels()
    return axes, dict(zip(names, handles, strict=True))


def test_what_was_never_sampled_has_no_colour_of_the_scale(calibration: Calibration) -> None:
    axes, legend = drawn(calibration)
    left, top = axes.transData.transform((0.5, -0.5))
    right, bottom = axes.transData.transform((2.0, -1.9))
    pixels = np.asarray(axes.figure.canvas.buffer_rgba())[..., :3].astype(int)
    height = len(pixels)
    part = pixels[height - int(top) : height - int(bottom), int(left) : int(right)].reshape(-1, 3)
    assert len(part) > 1000
    # White and grey hatches; the scale's lowest colour is dark blue
    assert np.ptp(part, axis=1).max() == 0
    assert part.min() < 200 < part.max()
    lowest = 255.0 * np.array(mpl.colormaps["cividis"](0.0)[:3])
    assert (np.abs(part - lowest).max(axis=1) > 50.0).all()
    assert legend["not sampled"].get_hatch() == axes.patch.get_hatch() != ""


def test_the_figure_says_what_moved_the_result_from_the_peak(calibration: Calibration) -> None:
    axes, legend = drawn(replace(calibration, photometric=STAGE))
    for name, (size, phase) in {"sharpest": SHARPEST, "found": FOUND}.items():
        at = math.degrees(size) * np.array([math.cos(phase), math.sin(phase)])
        np.testing.assert_allclose(np.ravel(legend[name].get_data()), at)
    assert "photometric stage moved it by 0.12 px" in axes.get_title()


@pytest.mark.parametrize("stage", [None, replace(STAGE, accepted=False)])
def test_a_result_that_nothing_moved_has_one_mark(
    calibration: Calibration, stage: PhotometricSummary | None
) -> None:
    axes, legend = drawn(replace(calibration, photometric=stage))
    assert "found" in legend
    assert "sharpest" not in legend
    assert "photometric" not in axes.get_title()


def test_the_legend_covers_nothing_of_the_map(calibration: Calibration) -> None:
    axes, legend = drawn(replace(calibration, photometric=STAGE))
    map_box, legend_box = axes.get_window_extent(), axes.get_legend().get_window_extent()
    assert not map_box.overlaps(legend_box)
    numbers = axes.xaxis.get_tightbbox()
    assert legend_box.y1 <= numbers.y0  # below the numbers and the title of the axis
    assert legend["global search"].get_markersize() >= 4.0
