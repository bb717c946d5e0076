"""Set-up of a parameter space: checks of names and bounds, and the scale of each parameter in pixels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.optics.camera import Camera, given_lens
from amiwarp.optics.models.angles import wrap_angle
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.comparison import rms
from amiwarp.optics.models.registry import MODELS, build_model, size_names
from amiwarp.optics.models.several import compensate_by_each
from amiwarp.optics.prism import Plate, Prism
from amiwarp.optics.rotation_path import RotationPath
from amiwarp.results.parameters import (
    CHANGES,
    DRIFTS,
    GROWTH,
    LINEAR_UNKNOWNS,
    MOTION,
    RATES,
    ParameterSpace,
    optical_parameters,
    orbit_names,
    phase_names,
    units,
)

MOST_TURNS_OFF = 0.25
"""Largest error of the number of turns in a recording that the frequency of a vibrating camera may start with."""
_RELATIVE_RANGE = {"rpm": 0.02, "focal_length": 0.2}
"""Half width of the default bounds of these parameters about their start value, as a share of it."""
_HALF_RANGE = {
    "clock_offset": 5000.0,
    **dict.fromkeys(RATES, 5.0),
    **dict.fromkeys(CHANGES, 50.0),
    GROWTH: 5.0,
}
"""Half width of the default bounds of the other parameters about their start value, in the parameter's unit."""


def make_space(
    model: str,
    camera: Camera,
    prism: Prism | Plate,
    *,
    free: tuple[str, ...] | None,
    start: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
    rad_per_us: float,
    duration_us: float,
    middle_us: int = 0,
    pixels: Mapping[str, float] | None = None,
    path: RotationPath | None = None,
) -> ParameterSpace:
    """Return the parameter space: check names and bounds, and measure how far each parameter moves events.

    Parameters
    ----------
    model : str
        Name of the model.
    camera : Camera
        The camera.
    prism : Prism or Plate
        The nominal glass, which gives the default bounds of the size.
    free : tuple of str, or None
        Names of the free parameters; ``motion`` stands for all three rates. None: those that the model names.
    start : mapping of str to float
        Start values, in the parameters' units, moved into the bounds. Phases are wrapped, unless they have ``bounds``.
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
    path : RotationPath, optional
        Known part of the camera's rotation.

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
    model_class = MODELS[model]
    names = _ordered_names(model_class, model_class.FREED if free is None else free)
    _check_given(model_class, names, start, bounds)
    nominal = {**model_class.start_values(prism), "focal_length": camera.fx}
    values = {
        name: start.get(name, nominal.get(name, 0.0))
        for name in (*orbit_names(model_class), *names, *start)
    }

    # The bounds, and the start within them.
    low: dict[str, float] = {}
    high: dict[str, float] = {}
    for name in names:
        default = _default_bounds(model_class, name, values[name], camera, prism, duration_us)
        low[name], high[name] = bounds.get(name) or default
        if not low[name] < high[name]:
            raise AmiwarpError(
                f"bounds of {name} are {low[name]:.6g} .. {high[name]:.6g}; give the lower bound first"
            )
        if name not in bounds and name in phase_names():
            values[name] = math.remainder(values[name], math.tau)
        values[name] = min(max(values[name], low[name]), high[name])

    if pixels is None:
        pixels = _pixels_per_unit(
            model,
            camera,
            prism,
            names=names,
            values=values,
            rad_per_us=rad_per_us,
            duration_us=duration_us,
        )
    pixels = {name: pixels[name] for name in names}
    _check_scales(pixels)
    undrifted = {name: value for name, value in values.items() if name in DRIFTS}
    return ParameterSpace(
        model=model,
        camera=camera,
        prism=prism,
        names=names,
        low=low,
        high=high,
        start=values,
        pixels=pixels,
        middle_us=middle_us,
        duration_us=duration_us,
        undrifted=undrifted,
        path=path,
    )


def widened(space: ParameterSpace, names: tuple[str, ...]) -> ParameterSpace:
    """Return the space with more free parameters: of the lens (:data:`LENS`), or the tilt of the prism's axis.

    They start at their present values. Raises :class:`AmiwarpError` if one of them moves no event.
    """
    camera = space.camera
    given = {**given_lens(camera), "index": space.prism.index}
    values = {**{name: given.get(name, 0.0) for name in names}, **space.start}

    # Half widths of the bounds.
    half = {
        "focal_length": 0.6 * values.get("focal_length", 0.0),
        "k1": 0.5,
        "fy_over_fx": 0.3,
        "center_x": 0.2 * camera.width,
        "center_y": 0.2 * camera.width,
    }
    half |= {name: parameter.half_range for name, parameter in optical_parameters().items()}
    low = {name: values[name] - half[name] for name in names}
    high = {name: values[name] + half[name] for name in names}
    shifts = _pixels_per_unit(
        space.model,
        camera,
        space.prism,
        names=names,
        values=values,
        rad_per_us=0.0,
        duration_us=space.duration_us,
    )
    _check_scales(shifts)
    return replace(
        space,
        names=(*space.names, *names),
        start=values,
        pixels={**space.pixels, **shifts},
        low={**space.low, **low},
        high={**space.high, **high},
    )


def _ordered_names(model_class: type[Model], free: tuple[str, ...]) -> tuple[str, ...]:
    """Return the free parameters' names in the search vector's order; raise for unknown or conflicting names."""
    # Any model's name of the size stands for this model's.
    wanted = {
        model_class.SIZE if name in size_names() else name for name in free if name != "motion"
    }
    if "motion" in free:
        wanted |= set(RATES)
    unknown = wanted - set(units())
    if unknown:
        known = ", ".join((*units(), "motion", *LINEAR_UNKNOWNS))
        raise AmiwarpError(
            f"free parameter {sorted(unknown)[0]!r} is unknown; choose among {known}"
        )
    if not wanted:
        raise AmiwarpError("no parameter is free; name at least one free parameter")
    foreign = sorted(wanted - set(_names_of(model_class)))
    if foreign:
        other = next(model.NAME for model in MODELS.values() if foreign[0] in model.FREE)
        raise AmiwarpError(f"the {model_class.NAME} model has no {foreign[0]}; use model {other!r}")
    if set(DRIFTS) <= wanted:
        raise AmiwarpError(
            "clock_offset and rpm cannot both be free; free rpm only for recordings without an encoder, else free "
            "clock_offset",
            ErrorCode.OPTIONS,
        )
    return tuple(name for name in _names_of(model_class) if name in wanted)


def _names_of(model_class: type[Model]) -> tuple[str, ...]:
    """Return the names of all parameters that can be free for a model, in the search vector's order."""
    return (*model_class.FREE[:2], *DRIFTS, *model_class.FREE[2:], "focal_length", *MOTION)


def _check_given(
    model_class: type[Model],
    names: tuple[str, ...],
    start: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
) -> None:
    """Raise :class:`AmiwarpError` for start values that the model lacks and bounds of parameters that are not free."""
    known = _names_of(model_class)
    for name in start:
        if name not in known:
            raise AmiwarpError(
                f"start names {name}, which is no parameter of the {model_class.NAME} model; choose among "
                f"{', '.join(known)}"
            )
    for name in bounds:
        if name not in names:
            raise AmiwarpError(
                f"bounds are given for {name}, which is not free; add {name} to the free parameters",
                ErrorCode.OPTIONS,
            )


def _default_bounds(
    model_class: type[Model],
    name: str,
    value: float,
    camera: Camera,
    prism: Prism | Plate,
    duration_us: float,
) -> tuple[float, float]:
    """Return the bounds of a parameter that has none given, about its start value."""
    if name in model_class.FREE:
        return model_class.default_bounds(name, value, camera, prism)
    if name == "rpm" and not model_class.PRISM:
        half = MOST_TURNS_OFF * 60e6 / max(duration_us, 1.0)
    elif name in _RELATIVE_RANGE:
        half = _RELATIVE_RANGE[name] * abs(value)
    else:
        half = _HALF_RANGE[name]
    return value - half, value + half


def _pixels_per_unit(
    model: str,
    camera: Camera,
    prism: Prism | Plate,
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
    model_class = MODELS[model].closed_form()
    typical = {size: model_class.start_values(prism)[size] for size, _ in model_class.ORBITS}
    nominal = {**values, **typical, model_class.SIZE: model_class.typical_size(camera, prism)}
    drifts = bool(set(DRIFTS) & set(names))

    # The steps of the differences. The effect of a drift follows from the effect of the phase.
    steps = dict.fromkeys((model_class.SIZE, *optical_parameters()), 0.02)
    steps |= {"center_x": 1.0, "center_y": 1.0, "k1": 0.01, "fy_over_fx": 0.01}
    for size, phase in model_class.ORBITS:
        steps |= {size: 0.25 * nominal[size], phase: 0.05}
    needed = {*names, "phase"} if drifts else {*names}
    steps = {name: step for name, step in steps.items() if name in needed}
    if "focal_length" in names:
        steps["focal_length"] = 0.01 * camera.fx

    # All models are computed at once: larger and smaller values in turn.
    built = []
    for name, step in steps.items():
        for value in (nominal[name] + step, nominal[name] - step):
            built.append(build_model(model_class.NAME, camera, prism, {**nominal, name: value}))
    moved = compensate_by_each(built, *_grid_points(camera.width, camera.height))
    moved = (moved[0::2] - moved[1::2]) / (2.0 * np.array([*steps.values()])[:, None, None])
    shifts = dict(zip(steps, map(rms, moved), strict=True))

    if drifts:
        shifts["clock_offset"] = shifts["phase"] * abs(rad_per_us)
        shifts["rpm"] = shifts["phase"] * 2.0 * math.pi / 60e6 * duration_us / math.sqrt(12.0)
    seconds = duration_us * 1e-6
    shifts |= _pixels_of_motion(camera, seconds)
    # At least the effect that a camera rotation of 0.5 rad/s would make visible.
    if "focal_length" in names:
        shifts["focal_length"] = max(shifts["focal_length"], 0.5 * seconds / math.sqrt(12.0))
    return {name: shifts[name] for name in names}


def _pixels_of_motion(camera: Camera, seconds: float) -> dict[str, float]:
    """Return how far events move per unit of each parameter of the camera's motion [px rms], in a recording's time."""
    radius = math.sqrt((camera.width**2 + camera.height**2) / 12.0)
    about_axes = (camera.fy, camera.fx, radius)
    levers = dict(zip(MOTION, (*about_axes, *about_axes, radius), strict=True))
    # Standard deviations of τ and τ²/2 over the recording, τ being the time from its middle.
    of_rate = math.sqrt(1.0 / 12.0)
    of_change = seconds * math.sqrt(1.0 / 720.0)
    shifts = {}
    for name, lever in levers.items():
        shifts[name] = lever * seconds * (of_change if name in CHANGES else of_rate)
    return shifts


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
        np.linspace(0, width - 1, 8),
        np.linspace(0, height - 1, 6),
        np.arange(8) * (np.pi / 4),
        indexing="ij",
    )
    return np.stack([x.ravel(), y.ravel()], axis=1), wrap_angle(theta.ravel())
