"""Print the tables of benchmarks/results/optics.md: errors of the models, and rounding errors of the exact model.

    python -m benchmarks.optics_table

The rounding errors are those against the float64 oracle in ``reference/optics.py``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy.optimize import minimize_scalar

from amiwarp import (
    Camera,
    CircleModel,
    Distortion,
    EllipseModel,
    ExactModel,
    Fisheye,
    FlatSide,
    ModelError,
    Prism,
    RadialCircleModel,
    RadialTangential,
    apex_from_deflection,
    predicted_error,
)
from reference import optics as oracle

INDEX = 1.55
GRID = 49  # number of rows of pixels; the number of angles is 36
LENSES: dict[str, Distortion | None] = {
    "no lens distortion": None,
    "radial-tangential": RadialTangential(-0.368, 0.151, -3e-4, -7.6e-4),
    "fisheye": Fisheye(-0.01, 0.005, -0.002, 0.0003),
}


def fitted_circle(exact: ExactModel) -> ModelError:
    """Return the error of the circle model with the constant deflection that has the smallest rms error."""
    start = CircleModel.from_prism(exact.camera, exact.prism).deflection

    def error(deflection: float) -> ModelError:
        model = CircleModel(exact.camera, deflection, flat_side=exact.prism.flat_side)
        return predicted_error(model, exact, grid=GRID)

    best = minimize_scalar(
        lambda d: error(d).rms, bounds=(0.8 * start, 2.0 * start), options={"xatol": 1e-6}
    ).x
    return error(float(best))


def ladder_rows() -> Iterator[str]:
    """Yield one table row per field of view, deflection and flat side: rms and worst error of every model [px]."""
    yield "| FOV | δ₀ | flat side | circle, on-axis δ | circle, fitted δ | radial circle | ellipse |"
    yield "|---|---|---|---|---|---|---|"
    for fov in (40, 60, 75, 90):
        camera = Camera.from_fov(640, 480, math.radians(fov))
        for deflection in (0.5, 1.0, 2.0):
            for side in FlatSide:
                prism = Prism(
                    apex_from_deflection(math.radians(deflection), INDEX, side), INDEX, side
                )
                exact = ExactModel(camera, prism)
                rungs = [
                    predicted_error(CircleModel.from_prism(camera, prism), exact, grid=GRID),
                    fitted_circle(exact),
                ]
                rungs += [predicted_error(m.from_prism(camera, prism), exact, grid=GRID)
                          for m in (RadialCircleModel, EllipseModel)]  # fmt: skip
                cells = [f"{e.rms:.2f}/{e.worst:.2f}" for e in rungs[:2]]
                cells += [f"{e.rms:.3f}/{e.worst:.3f}" for e in rungs[2:]]
                yield f"| {fov}° | {deflection:g}° | {side.value} | {' | '.join(cells)} |"


def lens_camera(width: int, height: int, fov: float, lens: Distortion | None) -> Camera:
    """Return a camera whose horizontal field of view, including the lens distortion, is ``fov`` [rad]."""
    bare = Camera(width, height, float(width), float(width), 0.0, 0.0, lens)
    edge = oracle.rays_to_pixels(bare, np.array([[math.sin(fov / 2), 0.0, math.cos(fov / 2)]]))[
        0, 0
    ]
    focal = width**2 / (2.0 * float(edge))
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, lens)


def rounding(camera: Camera, *, count: int = 20_000) -> tuple[float, float]:
    """Return the largest deviation from the float64 oracle and the largest round-trip error of the exact model [px].

    The apex angle is 4°; both orientations of the prism are included, with and without tilt.
    """
    rng = np.random.default_rng(0)
    given = rng.uniform(0.0, [camera.width - 1, camera.height - 1], (count, 2)).astype(np.float32)
    given[::2] = np.round(given[::2])
    xy, theta = given.astype(np.float64), rng.uniform(-np.pi, np.pi, count)
    deviation, back = 0.0, 0.0
    for side in FlatSide:
        for tilt in ((0.0, 0.0), (0.03, -0.02)):
            prism = Prism(math.radians(4.0), INDEX, side)
            model = ExactModel(camera, prism, tilt=tilt)
            seen = model.compensate_points(xy, theta)
            for to_scene, got in ((True, seen), (False, model.deflect_points(xy, theta))):
                expected = oracle.move(camera, prism, xy, theta, to_scene=to_scene, tilt=tilt)
                deviation = max(deviation, float(np.linalg.norm(got - expected, axis=1).max()))
            back = max(
                back, float(np.linalg.norm(model.deflect_points(seen, theta) - xy, axis=1).max())
            )
    return deviation, back


def rounding_rows() -> Iterator[str]:
    """Yield one table row per sensor and field of view: deviation and round-trip error [1e-3 px]."""
    yield f"| sensor | FOV | {' | '.join(LENSES)} |"
    yield "|---|---|---|---|---|"
    for width, height in ((346, 260), (640, 480), (1280, 720), (2560, 1440)):
        for fov in (40, 60, 90):
            pairs = [
                rounding(lens_camera(width, height, math.radians(fov), lens))
                for lens in LENSES.values()
            ]
            cells = " | ".join(f"{a * 1e3:.2f} / {b * 1e3:.2f}" for a, b in pairs)
            yield f"| {width}×{height} | {fov}° | {cells} |"


if __name__ == "__main__":
    for row in (*ladder_rows(), "", *rounding_rows()):
        print(row, flush=True)
