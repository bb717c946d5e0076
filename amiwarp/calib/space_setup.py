"""Set-up of a parameter space: checks of names and bounds, and the scale of each parameter in pixels."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib.parameters import (
    CHANGES,
    DRIFTS,
    MOTION,
    RATES,
    UNITS,
    ParameterSpace,
    build_model,
    size_name,
)
from amiwarp.errors import AmiwarpError
from amiwarp.optics.displacement import compensate_by_each, rms, wrap_angle
from amiwarp.optics.prism import deflection_from_apex

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from amiwarp.optics.camera import Camera
    from amiwarp.optics.prism import Prism

_EXACT_ONLY = ("tilt_x", "tilt_y", "index")
_DEFAULT_RANGE = {
    "tilt_x": math.radians(5.0), "tilt_y": math.radians(5.0), "clock_offset": 5000.0, "index": 0.2,
    **dict.fromkeys(RATES, 5.0), **dict.fromkeys(CHANGES, 50.0),
}  # fmt: skip
"""Half width of the default bounds of each parameter about its start value, in the parameter's unit."""
_FULL_PHASE_RANGE = (-math.pi, math.pi)


def make_space(
    model: str,
    camera: Camera,
    prism: Prism,
    *,
    free: tuple[str, ...] | None,
    start: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
    rad_per_us: float,
    duration_us: float,
    middle_us: int = 0,
    pixels: Mapping[str, float] | None = None,
) -> ParameterSpace:
    """Return the parameter space: check names and bounds, and measure how far each parameter moves events.

    Parameters
    ----------
    model : str
        Name of the model.
    camera : Camera
        The camera.
    prism : Prism
        The nominal prism. The size ranges from 0 to that of twice its apex, unless ``bounds`` are given for it.
    free : tuple of str, or None
        Names of the free parameters; ``motion`` stands for all three rates. None: size and phase.
    start : mapping of str to float
        Start values, in the parameters' units.
    bounds : mapping of str to (float, float)
        Lower and upper bound by name, in the parameters' units.
    rad_per_us : float
        Mean speed of the prism [rad/us].
    duration_us : float
        Duration of the events [us].
    middle_us : int
        Time to whose camera orientation events are rotated back [us].
    pixels : mapping of str to float, optional
        Displacement of events per unit of each free parameter [px rms]. None: it is measured.

    Returns
    -------
    ParameterSpace
        The space.

    Raises
    ------
    AmiwarpError
        If a name is unknown, not part of the model or in conflict with another one, if the bounds are in the wrong
        order, or if a free parameter moves no event.
    """
    size = size_name(model)
    names = _ordered_names(model, (size, "phase") if free is None else free)
    _check_given(model, names, start, bounds)
    nominal = {
        "apex": prism.apex, "deflection": prism.deflection, "phase": 0.0, "index": prism.index,
        "focal_length": camera.fx,
    }  # fmt: skip
    values = {n: start.get(n, nominal.get(n, 0.0)) for n in (size, "phase", *names, *start)}
    low, high = {}, {}
    for name in names:
        low[name], high[name] = bounds.get(name) or _default_bounds(name, values[name], prism)
        if not low[name] < high[name]:
            raise AmiwarpError(f"bounds of {name} are {low[name]:.6g} .. {high[name]:.6g}; give the lower bound first")
        values[name] = min(max(values[name], low[name]), high[name])
    if pixels is None:
        pixels = _pixels_per_unit(
            model, camera, prism, names=names, values=values, rad_per_us=rad_per_us, duration_us=duration_us
        )
    pixels = {n: pixels[n] for n in names}
    _check_scales(pixels)
    undrifted = {n: x for n, x in values.items() if n in DRIFTS}
    return ParameterSpace(
        model=model, camera=camera, prism=prism, names=names, low=low, high=high, start=values, pixels=pixels,
        middle_us=middle_us, duration_us=duration_us, undrifted=undrifted,
    )  # fmt: skip


def widened(space: ParameterSpace, names: tuple[str, ...]) -> ParameterSpace:
    """Return the space with more free parameters: of the lens (:data:`LENS`), or the tilt of the prism's axis.

    They start at their present values. Raises :class:`AmiwarpError` if one of them moves no event.
    """
    camera, lens = space.camera, space.camera.distortion
    given = {"focal_length": camera.fx, "center_x": camera.cx, "center_y": camera.cy, "k1": lens.k1 if lens else 0.0}
    values = {**{n: given.get(n, 0.0) for n in names}, **space.start}
    half = {"focal_length": 0.6 * values.get("focal_length", 0.0), "k1": 0.5}
    half |= dict.fromkeys(("center_x", "center_y"), 0.2 * camera.width)
    half |= {n: _DEFAULT_RANGE[n] for n in ("tilt_x", "tilt_y")}
    shifts = _pixels_per_unit(
        space.model, camera, space.prism, names=names, values=values, rad_per_us=0.0, duration_us=space.duration_us
    )
    _check_scales(shifts)
    return replace(
        space, names=(*space.names, *names), start=values, pixels={**space.pixels, **shifts},
        low={**space.low, **{n: values[n] - half[n] for n in names}},
        high={**space.high, **{n: values[n] + half[n] for n in names}},
    )  # fmt: skip


def _ordered_names(model: str, free: tuple[str, ...]) -> tuple[str, ...]:
    """Return the free parameters' names in the search vector's order; raise for unknown or conflicting names."""
    size = size_name(model)
    wanted = {size if n in ("apex", "deflection") else n for n in free if n != "motion"}
    wanted |= set(RATES if "motion" in free else ())
    unknown = wanted - set(UNITS)
    if unknown:
        raise AmiwarpError(f"free parameter {sorted(unknown)[0]!r} is unknown; choose among {', '.join(UNITS)}")
    if not wanted:
        raise AmiwarpError("no parameter is free; name at least one free parameter")
    if model in ("circle", "radial") and wanted & set(_EXACT_ONLY):
        raise AmiwarpError(f"the {model} model has no {sorted(wanted & set(_EXACT_ONLY))[0]}; use model 'exact'")
    if set(DRIFTS) <= wanted:
        raise AmiwarpError(
            "clock_offset and rpm cannot both be free; free rpm only for recordings without an encoder, else free "
            "clock_offset"
        )
    return tuple(n for n in (size, "phase", *DRIFTS, *_EXACT_ONLY, "focal_length", *MOTION) if n in wanted)


def _check_given(
    model: str, names: tuple[str, ...], start: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]
) -> None:
    """Raise :class:`AmiwarpError` for start values that the model lacks and bounds of parameters that are not free."""
    exact = () if model in ("circle", "radial") else _EXACT_ONLY
    known = (size_name(model), "phase", *DRIFTS, *exact, "focal_length", *MOTION)
    for name in start:
        if name not in known:
            raise AmiwarpError(
                f"start names {name}, which is no parameter of the {model} model; choose among {', '.join(known)}"
            )
    for name in bounds:
        if name not in names:
            raise AmiwarpError(f"bounds are given for {name}, which is not free; add {name} to the free parameters")


def _default_bounds(name: str, value: float, prism: Prism) -> tuple[float, float]:
    if name == "apex":
        return 0.0, 2.0 * prism.apex
    if name == "deflection":
        return 0.0, deflection_from_apex(2.0 * prism.apex, prism.index, prism.flat_side)
    if name == "phase":
        return _FULL_PHASE_RANGE
    share = {"rpm": 0.02, "focal_length": 0.2}
    half = share[name] * abs(value) if name in share else _DEFAULT_RANGE[name]
    return value - half, value + half


def _pixels_per_unit(
    model: str,
    camera: Camera,
    prism: Prism,
    *,
    names: tuple[str, ...],
    values: Mapping[str, float],
    rad_per_us: float,
    duration_us: float,
) -> dict[str, float]:
    """Return how far events move per unit of each free parameter [px rms].

    The displacement is differentiated by finite differences over a grid of pixels and prism angles, at the nominal
    size.
    """
    nominal = {**values, "apex": prism.apex, "deflection": prism.deflection}
    kind = "exact" if model == "ellipse" else model  # the ellipse's tables are computed from the exact model
    size = size_name(model)
    lens = {"center_x": 1.0, "center_y": 1.0, "k1": 0.01}
    steps = {size: 0.25 * nominal[size], "phase": 0.05, **dict.fromkeys(_EXACT_ONLY, 0.02), **lens}
    steps = {n: h for n, h in steps.items() if n in names or (n == "phase" and set(DRIFTS) & set(names))}
    if "focal_length" in names:
        steps["focal_length"] = 0.01 * camera.fx
    built = [
        build_model(kind, camera, prism, {**nominal, n: nominal[n] + h}) for n, x in steps.items() for h in (x, -x)
    ]
    moved = compensate_by_each(built, *_grid_points(camera.width, camera.height))
    moved = (moved[0::2] - moved[1::2]) / (2.0 * np.array([*steps.values()])[:, None, None])
    shifts = dict(zip(steps, map(rms, moved), strict=True))
    if set(DRIFTS) & set(names):
        shifts["clock_offset"] = shifts["phase"] * abs(rad_per_us)
        shifts["rpm"] = shifts["phase"] * 2.0 * math.pi / 60e6 * duration_us / math.sqrt(12.0)
    seconds = duration_us * 1e-6
    radius = math.sqrt((camera.width**2 + camera.height**2) / 12.0)
    for name, lever in zip(MOTION, (camera.fy, camera.fx, radius) * 2, strict=True):
        # standard deviations of τ and τ²/2 over the recording, τ being the time from its middle
        shifts[name] = (
            lever * seconds * (seconds * math.sqrt(1.0 / 720.0) if name in CHANGES else math.sqrt(1.0 / 12.0))
        )
    # at least the effect that a camera rotation of 0.5 rad/s would make visible
    if "focal_length" in names:
        shifts["focal_length"] = max(shifts["focal_length"], 0.5 * seconds / math.sqrt(12.0))
    return {n: shifts[n] for n in names}


def _check_scales(pixels: Mapping[str, float]) -> None:
    """Raise :class:`AmiwarpError` if a parameter moves no event, or by an infinite distance."""
    if not all(math.isfinite(x) and x > 0.0 for x in pixels.values()):
        raise AmiwarpError(
            "a free parameter moves no event; give a nominal apex above 0 and an encoder whose angle changes"
        )


@lru_cache(maxsize=16)
def _grid_points(width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a grid of pixels [px], shape (n, 2), and of wrapped prism angles [rad], shape (n,)."""
    x, y, theta = np.meshgrid(
        np.linspace(0, width - 1, 8), np.linspace(0, height - 1, 6), np.arange(8) * (np.pi / 4), indexing="ij"
    )
    return np.stack([x.ravel(), y.ravel()], axis=1), wrap_angle(theta.ravel())
