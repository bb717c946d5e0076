"""Values of a simulation: their checks, and the true parameters that they mean."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.simulation.motion import LONGEST_S, CameraMotion, EncoderModel, PrismMotion
from amiwarp.simulation.scene import Scene
from amiwarp.simulation.sensor import SensorModel
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.validation import instance, real, whole

if TYPE_CHECKING:
    from amiwarp.simulation.simulator import Simulation


def check_values(simulation: Simulation) -> None:
    """Raise :class:`AmiwarpError` if a value is of another class or out of range."""
    if not isinstance(simulation.scene, WorldScene):
        instance(simulation.scene, Scene, "simulation's scene")
    kinds: dict[str, type] = {"camera": Camera, "prism": Prism, "motion": PrismMotion, "sensor": SensorModel,
             "camera_motion": CameraMotion}  # fmt: skip
    if simulation.encoder_model is not None:
        kinds["encoder_model"] = EncoderModel
    for name, kind in kinds.items():
        instance(getattr(simulation, name), kind, f"simulation's {name}")
    real(simulation.duration_s, "duration_s", 1e-3, LONGEST_S, " s")
    if simulation.camera.width * simulation.camera.height > 1 << 22:
        given = f"{simulation.camera.width}x{simulation.camera.height}"
        raise AmiwarpError(f"camera of {given} has more than 4194304 pixels; give a smaller camera")
    whole(simulation.seed, "seed", 0, (1 << 31) - 1)


def true_parameters(simulation: Simulation) -> dict[str, float]:
    """Return the true values by the names that calibration uses, and those of the sensor."""
    constant = simulation.camera_motion.constant and not (
        isinstance(simulation.scene, WorldScene) and simulation.scene.trajectory.moves
    )  # a trajectory has no constant angular velocity
    rates = np.asarray(simulation.camera_motion.rates) if constant else np.full(3, np.nan)
    omega = dict(zip(("omega_x", "omega_y", "omega_z"), rates.ravel()[-3:].tolist(), strict=True))
    clock = {} if simulation.encoder_model is None else {"clock_offset_us": simulation.encoder_model.clock_offset_us}
    return {
        "apex": simulation.prism.apex,
        "index": simulation.prism.index,
        "phase": simulation.motion.phase,
        **clock,
        "tilt_x": simulation.motion.tilt[0],
        "tilt_y": simulation.motion.tilt[1],
        **{name: value for name, value in omega.items() if math.isfinite(value)},
        **asdict(simulation.sensor),
    }
