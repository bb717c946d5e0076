"""A camera and a prism as attributes: of an HDF5 group, or of a JSON object in a stream."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.io.json_files import LARGEST_INTEGER
from amiwarp.optics.camera import Camera
from amiwarp.optics.lens import Distortion, Fisheye, RadialTangential
from amiwarp.optics.prism import FlatSide, Prism, UnsizedPrism
from amiwarp.validation import array, instance, one_of, real, shown, whole

if TYPE_CHECKING:
    from amiwarp.optics.prism import NominalPrism


LENSES: dict[str, tuple[type[RadialTangential] | type[Fisheye], int]] = {
    "radial_tangential": (RadialTangential, 5),
    "fisheye": (Fisheye, 4),
}
"""Models of distortion by name, and their numbers of coefficients."""


def attribute(attributes: Mapping[str, Any], where: str, name: str, kind: type[Any], default: Any = None) -> Any:
    """One attribute as ``kind``; :class:`AmiwarpError`, naming ``where``, if it is missing or something else."""
    if name not in attributes and default is None:
        raise AmiwarpError(f"{where} has no attribute '{name}'; add it")
    value = attributes.get(name, default)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    what = f"{where} attribute '{name}'"
    if kind is int:
        return whole(value, what, -LARGEST_INTEGER, LARGEST_INTEGER)
    if kind is float:
        return real(value, what)
    try:
        text = value.decode() if isinstance(value, bytes) else value
    except UnicodeDecodeError:
        text = value
    return instance(text, kind, what)


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
    model = one_of(attribute(attributes, where, "distortion_model", str, "none"), (*LENSES, "none"),
                   f"{where} attribute 'distortion_model'")  # fmt: skip
    distortion: Distortion | None = None
    if model in LENSES:
        kind, length = LENSES[model]
        coefficients = array(attributes.get("distortion", ()), f"{where} attribute 'distortion'")
        if coefficients.shape != (length,):
            raise AmiwarpError(f"camera distortion is {shown(coefficients)}; expected {length} numbers for {model}")
        distortion = kind(*coefficients.tolist())
    width, height = (attribute(attributes, where, name, int) for name in ("width", "height"))
    fx, fy, cx, cy = (attribute(attributes, where, name, float) for name in ("fx", "fy", "cx", "cy"))
    return Camera(width, height, fx, fy, cx, cy, distortion)


def prism_attributes(prism: NominalPrism) -> dict[str, float | str]:
    """A nominal prism's attributes; no apex where it is unknown."""
    known: dict[str, float | str] = {"apex": prism.apex} if isinstance(prism, Prism) else {}
    return {**known, "index": prism.index, "flat_side": prism.flat_side.value}


def read_prism(attributes: Mapping[str, Any], where: str) -> NominalPrism:
    """A nominal prism from its attributes; one of unknown apex where that is missing."""
    side = attribute(attributes, where, "flat_side", str, FlatSide.SCENE.value)
    prism = UnsizedPrism(attribute(attributes, where, "index", float), side)
    return prism.with_apex(attribute(attributes, where, "apex", float)) if "apex" in attributes else prism
