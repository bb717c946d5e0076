"""An optical model in one file: a wedge with cylinder power. ``test_new_model.py`` adds it and removes it again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import warp as wp

from amiwarp import Camera, ExactModel, Model, Parameter, Prism
from amiwarp.kernels.camera import CameraParams, pixel_to_ray, ray_to_pixel
from amiwarp.kernels.exact import ExactParams, deflect_direction
from amiwarp.kernels.refraction import compensate_direction, deflect
from amiwarp.optics import MODELS
from amiwarp.optics.models.parameter import PHASE
from amiwarp.optics.models.structs import phase_values, struct_of
from amiwarp.schema.calls import guarded

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class CylinderParams:
    """Exact refraction, and a scale of the observed image along the azimuth of the tilt."""

    prism: ExactParams  # refraction at both faces
    phase: float  # phase of the prism angle [rad]
    phase_cos: float  # cosine of the phase
    phase_sin: float  # sine of the phase
    gain: float  # scale along the azimuth of the tilt


@wp.func
def compensate_direction(model: CylinderParams, x: float, y: float, z: float, w0: float, w1: float):  # noqa: F811
    """Return the direction without the prism: undo the scale, then the refraction."""
    along = (w0 * x + w1 * y) * (1.0 / model.gain - 1.0)
    return compensate_direction(model.prism, x + along * w0, y + along * w1, z, w0, w1)


@wp.func
def deflect(model: CylinderParams, camera: CameraParams, xy: wp.vec2, w: wp.vec2) -> wp.vec2:  # noqa: F811
    """Return the observed pixel: refract, then scale."""
    ray = pixel_to_ray(camera, xy)
    x, y, z = deflect_direction(model.prism, ray[0], ray[1], ray[2], w[0], w[1])
    along = (w[0] * x + w[1] * y) * (model.gain - 1.0)
    return ray_to_pixel(camera, wp.vec3(x + along * w[0], y + along * w[1], z))


@guarded
@dataclass(frozen=True)
class CylinderModel(Model):
    """Wedge with cylinder power: the exact model, scaled by 1 + power along the azimuth of the tilt."""

    NAME, TEXT, NUMBERS, STRUCT = "cylinder", "wedge with cylinder", "3", CylinderParams
    PARAMETERS = (
        Parameter("apex", "rad"),
        PHASE,
        Parameter(
            "power", "1", 0.1, limits=(-0.5, 0.5), label="cylinder power", slider=(-0.1, 0.1, 0.001)
        ),
    )

    camera: Camera
    prism: Prism
    phase: float = 0.0
    power: float = 0.0

    @classmethod
    def _of_values(cls, camera: Camera, prism: Prism, values: Mapping[str, float]) -> Self:
        wedge = Prism(values["apex"], prism.index, prism.flat_side)
        return cls(camera, wedge, values["phase"], values.get("power", 0.0))

    def kernel_values(self) -> tuple[Any, ...]:
        exact = ExactModel(self.camera, self.prism, self.phase)
        return exact.kernel_values(), *phase_values(self.phase), 1.0 + self.power

    def params(self, device: Any) -> Any:
        exact = ExactModel(self.camera, self.prism, self.phase).params(device)
        return struct_of(CylinderParams, [exact, *self.kernel_values()[1:]])


MODELS[CylinderModel.NAME] = CylinderModel
