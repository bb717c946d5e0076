"""A camera and a prism as attributes: of an HDF5 group, or of a JSON object in a stream."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.camera import Camera, Distortion, Fisheye, RadialTangential
from amiwarp.errors import AmiwarpError

if TYPE_CHECKING:
    from amiwarp.optics import Prism


def attribute(attributes: Mapping[str, Any], where: str, name: str, kind: type[Any], default: Any = None) -> Any:
    """One attribute as ``kind``; :class:`AmiwarpError`, naming ``where``, if it is missing or something else."""
    if name not in attributes and default is None:
        raise AmiwarpError(f"{where} has no attribute '{name}'; add it")
    value = attributes.get(name, default)
    try:
        return kind(value.decode() if isinstance(value, bytes) else value)
    except (TypeError, ValueError, OverflowError) as error:
        raise AmiwarpError(f"{where} attribute '{name}' is {repr(value)[:80]}; expected {kind.__name__}") from error


def camera_attributes(camera: Camera) -> dict[str, int | float | str | list[float]]:
    """A camera's attributes."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    attributes: dict[str, int | float | str | list[float]] = {name: getattr(camera, name) for name in names}
    distortion = camera.distortion
    if isinstance(distortion, RadialTangential):
        attributes["distortion_model"] = "radial_tangential"
        coefficients = (distortion.k1, distortion.k2, distortion.p1, distortion.p2, distortion.k3)
        attributes["distortion"] = [float(value) for value in coefficients]
    elif isinstance(distortion, Fisheye):
        attributes["distortion_model"] = "fisheye"
        attributes["distortion"] = [float(k) for k in (distortion.k1, distortion.k2, distortion.k3, distortion.k4)]
    else:
        attributes["distortion_model"] = "none"
    return attributes


def read_camera(attributes: Mapping[str, Any], where: str) -> Camera:
    """A camera from its attributes."""
    model = attribute(attributes, where, "distortion_model", str, "none")
    kinds: dict[str, tuple[type[RadialTangential] | type[Fisheye], int]]
    kinds = {"radial_tangential": (RadialTangential, 5), "fisheye": (Fisheye, 4)}
    distortion: Distortion | None = None
    if model in kinds:
        kind, length = kinds[model]
        try:
            coefficients = np.asarray(attributes.get("distortion", ()), np.float64)
        except (TypeError, ValueError) as error:
            raise AmiwarpError(f"{where} distortion is not numbers; expected {length} for {model}") from error
        if coefficients.shape != (length,) or not np.isfinite(coefficients).all():
            raise AmiwarpError(
                f"camera distortion is {str(coefficients.tolist())[:80]}; expected {length} numbers for {model}"
            )
        distortion = kind(*coefficients.tolist())
    elif model != "none":
        raise AmiwarpError(f"camera distortion_model '{model[:40]}'; expected none, radial_tangential or fisheye")
    width, height = (attribute(attributes, where, name, int) for name in ("width", "height"))
    fx, fy, cx, cy = (attribute(attributes, where, name, float) for name in ("fx", "fy", "cx", "cy"))
    return Camera(width, height, fx, fy, cx, cy, distortion)


def prism_attributes(prism: Prism) -> dict[str, float | str]:
    """A nominal prism's attributes."""
    return {"apex": float(prism.apex), "index": float(prism.index), "flat_side": prism.flat_side.value}


def read_prism(attributes: Mapping[str, Any], where: str) -> Prism:
    """A nominal prism from its attributes."""
    from amiwarp.optics import FlatSide, Prism

    side = attribute(attributes, where, "flat_side", str, FlatSide.SCENE.value)
    if side not in {member.value for member in FlatSide}:
        raise AmiwarpError(
            f"prism flat_side '{side[:40]}'; expected {' or '.join(member.value for member in FlatSide)}"
        )
    apex, index = (attribute(attributes, where, name, float) for name in ("apex", "index"))
    return Prism(apex, index, flat_side=FlatSide(side))
