"""Draw the costs of both calibration stages around the true apex angle, and the errors of many recordings.

python -m benchmarks.stages_figure benchmarks/results/calibration_photometric_cuda.json docs/images/stages.png
"""

from __future__ import annotations

import argparse
import io
import json
import math
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from amiwarp.brightness.event_pairs import off_excess
from amiwarp.brightness.solver import BrightnessMap
from amiwarp.calib import Settings
from amiwarp.calib.calibration import prepare
from amiwarp.calib.photometric.cost import Cost, collect_pairs
from amiwarp.imaging.export import save_png
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.simulation.simulator import simulate
from amiwarp.studies.demo import earth

APEX = math.radians(0.5)
BLUE, ORANGE = "#0072b2", "#d55e00"


def costs(offsets_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sharpness and the residual of one brightness map at apex angles around the truth.

    ``offsets_px`` are the differences from the true apex angle, as displacements in the image [px].
    """
    recording = simulate(earth(), Camera.from_fov(346, 260, math.radians(60.0)), Prism(APEX), duration_s=0.34, seed=1)
    search = prepare(recording, Settings())[0]
    search.run()
    unit = search.space.pixels["apex"]
    points = [{**search.best, "apex": APEX + x / unit, "phase": 0.0} for x in offsets_px]
    sharp = np.array([search.fine.values(values) for values in points])
    pairs, tiles = collect_pairs(recording, search, search.settings.photometric)
    brightness = BrightnessMap(pairs, tiles, off_excess=off_excess(pairs))
    cost = Cost(search.space, brightness, 40)
    cost.warm_up(search.space.to_vector(points[len(points) // 2]))
    rest = np.array([-cost(search.space.to_vector(values)) for values in points])
    return sharp, rest


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    x = np.linspace(-0.8, 0.8, 33)
    sharp, rest = costs(x)
    figure = Figure(figsize=(11.0, 3.6), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3)
    for ax, values, colour, best, title in (
        (left, sharp, BLUE, int(sharp.argmax()), "sharpness (higher is better)"),
        (middle, 100.0 * rest, ORANGE, int(rest.argmin()), "residual of one map, % (lower is better)"),
    ):
        ax.plot(x, values, color=colour)
        ax.plot(x[best], values[best], "o", color=colour)
        ax.axvline(0.0, color="0.5", lw=1, ls="--")
        ax.set(xlabel="apex, away from the truth [px]", title=title)
    rows = json.loads(args.results.read_text())["rows"]
    for name, colour, label in (
        ("sharpness_model_error_px", BLUE, "sharpness"), ("model_error_px", ORANGE, "photometric"),
    ):  # fmt: skip
        values = np.sort([row[name] for row in rows])
        right.step(values, np.arange(1, len(values) + 1), where="post", color=colour, label=label)
    right.set(xscale="log", xlabel="model error [px]", title=f"recordings with a smaller error (of {len(rows)})")
    right.legend(frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    save_png(args.out, Image.open(buffer).convert("RGB"), overwrite=True)


if __name__ == "__main__":
    main()
