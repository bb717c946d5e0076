"""Rigs of the stability study: an optic in front of a scene, what its encoders read, and where its events belong."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.events.encoder import Encoder
from amiwarp.optics.prism import Plate
from amiwarp.simulation.description import Scene, Still
from amiwarp.simulation.motion import CameraMotion, Vibration
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.studies.stability.encoders import read
from amiwarp.studies.stability.optics import MAKERS, Array, varying
from amiwarp.studies.stability.rig_scenes import DEPTH_PER_M, SLANT, plane_at, scene_picture, wall

if TYPE_CHECKING:
    from amiwarp.studies.stability.condition import Condition


@dataclass(frozen=True)
class Rig:
    """An optic in front of a scene, what its encoders read, and where its events belong."""

    simulation: Simulation
    """Simulation of the recording."""
    encoder: Encoder | None
    """What the encoders read; None for a vibration, which has none."""
    model: str
    """Name of the model that the calibration is given."""
    swing: CameraMotion | None
    """Rotation that is part of the optic's motion, but not of its model; None if there is none."""
    inverse_depth: Callable[[Array], Array] | None
    """Inverse depth of what pixels see without the optic [1/m], for a plate; else None."""

    def places(self, xy: Array, t_us: Array) -> Array:
        """Return where what pixels see at times belongs in the image without the optic [px], shape ``(n, 2)``.

        A rotation of the camera is no part of it.
        """
        theta = self.simulation.prism_motion.angles(t_us)
        plate = self.simulation.plate
        if plate is not None:
            assert self.inverse_depth is not None
            places_of_pixels = xy
            for _ in range(6):  # the depth belongs to the place, which depends on the depth
                places_of_pixels = plate.compensate_at(
                    xy, theta, self.inverse_depth(places_of_pixels)
                )
            return places_of_pixels
        places = self.simulation.moving_model.compensate_points(xy, theta)
        if self.swing is None:
            return places
        camera = self.simulation.camera
        turned = self.swing.orientation(self.simulation.duration_s)(t_us * 1e-6)
        rays = np.einsum("nij,nj->ni", turned, camera.pixels_to_rays(places).astype(np.float64))
        return camera.rays_to_pixels(rays).astype(np.float64)


def rig_of(condition: Condition, seed: int, rng: np.random.Generator, device: str) -> Rig:
    """Return the rig of a condition, without background noise."""
    optic = MAKERS[condition.optic](condition, rng)
    turning = rng.standard_normal(3)
    turning *= math.radians(condition.camera_deg_s) / np.linalg.norm(turning)
    inverse_depth = None
    swing = None
    camera_motion = CameraMotion(turning)
    scene: Scene | WorldScene
    if isinstance(optic.glass, Plate):
        slant = (
            SLANT
            * DEPTH_PER_M
            / math.tan(math.radians(condition.fov_deg) / 2.0)
            * rng.uniform(-1.0, 1.0, 2)
        )
        scene = wall(condition, slant, turning, optic.duration_s, seed)
        inverse_depth = partial(plane_at, condition.camera, slant)
        camera_motion = CameraMotion()
    else:
        scene = Scene(Still(scene_picture(condition, seed, 1.0)))
    if condition.unsteady:
        assert isinstance(optic.glass, Vibration)
        swing = varying(optic.glass, condition.unsteady, optic.duration_s)
        rates = np.asarray(swing.rates) + np.array([0.0, *turning])
        camera_motion = CameraMotion(rates)
    simulation = Simulation(
        scene,
        condition.camera,
        optic.glass,
        optic.duration_s,
        optic.motion,
        camera_motion,
        condition.sensor,
        nominal_prism=optic.nominal,
        seed=seed,
        device=device,
    )
    encoder = None if isinstance(optic.glass, Vibration) else read(condition, optic, rng, seed)
    return Rig(simulation, encoder, optic.model, swing, inverse_depth)
