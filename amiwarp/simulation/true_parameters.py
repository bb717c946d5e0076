"""True values of a simulation's parameters, by the names that calibration uses."""

import math
from dataclasses import asdict
from typing import cast

import numpy as np

from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.simulation.description import SimulationValues
from amiwarp.simulation.motion import Moved
from amiwarp.simulation.worlds.world_scene import WorldScene


def true_parameters(simulation: SimulationValues) -> dict[str, float]:
    """Return the true values by the names that calibration uses, and the sensor's parameters."""
    sensor = asdict(simulation.sensor)
    clock = {}
    if simulation.encoder_model is not None:
        clock["clock_offset_us"] = simulation.encoder_model.clock_offset_us
    turning = of_camera(simulation)
    optic = simulation.prism
    if isinstance(optic, Moved):
        return {**optic.parameters(), **clock, **turning, **sensor}

    motion = simulation.prism_motion
    if isinstance(optic, Prism):
        size = {"apex": optic.apex}
        uneven = {
            **by_axis("tilt", motion.tilt),
            **by_axis("cylinder", motion.cylinder),
            **by_axis("wobble", motion.wobble),
        }
    else:
        size = {"thickness": optic.thickness, "plate_tilt": optic.tilt}
        uneven = by_axis("wedge", motion.wedge)
    return {
        **size,
        "index": optic.index,
        "phase": motion.phase,
        **of_second_prism(simulation),
        **clock,
        **uneven,
        **turning,
        **sensor,
    }


def by_axis(name: str, values: tuple[float, float]) -> dict[str, float]:
    """Return the values of a parameter in x and y by their names."""
    x, y = values
    return {f"{name}_x": x, f"{name}_y": y}


def of_camera(simulation: SimulationValues) -> dict[str, float]:
    """Return the camera's angular velocity; none if it is not constant, as along a trajectory."""
    scene = simulation.scene
    on_its_way = isinstance(scene, WorldScene) and scene.trajectory.moves
    if on_its_way or not simulation.camera_motion.constant:
        return {}
    rates = np.asarray(simulation.camera_motion.rates).ravel()[-3:].tolist()
    names = ("omega_x", "omega_y", "omega_z")
    return {name: rate for name, rate in zip(names, rates, strict=True) if math.isfinite(rate)}


def of_second_prism(simulation: SimulationValues) -> dict[str, float]:
    """Return the true values of the second prism of a pair; none for one prism."""
    model = simulation.bending
    if isinstance(model, ExactModel):
        return {}
    second = cast("Prism", model.prism.second)
    return {
        "second_apex": second.apex,
        "second_index": second.index,
        "second_phase": model.second_phase,
        "ratio": model.ratio,
    }
