"""Camera and prism as attributes of an HDF5 group, or of a JSON object in a stream."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.optics.camera import CAMERA_NUMBERS, Camera, camera_to_json
from amiwarp.optics.distortion import COEFFICIENTS, DISTORTIONS, Distortion
from amiwarp.optics.prism import FlatSide, NominalPrism, Plate, Prism, UnsizedPrism, as_wedge
from amiwarp.schema.records import LARGEST_INTEGER
from amiwarp.validation import array as as_numbers
from amiwarp.validation import instance, one_of, real, shown, whole


def attribute(
    attributes: Mapping[str, Any], where: str, name: str, kind: type[Any], default: Any = None
) -> Any:
    """Return an attribute as type ``kind``; raise :class:`AmiwarpError` if it is missing or of another type."""
    if name not in attributes and default is None:
        raise AmiwarpError(
            f"{where} has no attribute '{name}'; add this attribute", ErrorCode.CONTENT_MISSING
        )
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


def camera_attributes(camera: Camera) -> dict[str, Any]:
    """Return a camera as attributes of an HDF5 group, by name."""
    attributes = camera_to_json(camera)
    lens = attributes.pop("distortion", {"kind": "none"})
    attributes["distortion_model"] = lens.pop("kind")
    if lens:
        attributes["distortion"] = [float(value) for value in lens.values()]
    return attributes


def read_camera(attributes: Mapping[str, Any], where: str) -> Camera:
    """Return the camera stored in the attributes of a file or stream.

    Raises :class:`AmiwarpError` if an attribute is missing or unusable.
    """
    distortion = _read_distortion(attributes, where)
    kinds = dict(zip(CAMERA_NUMBERS, (int, int, float, float, float, float), strict=True))
    numbers = {name: attribute(attributes, where, name, kind) for name, kind in kinds.items()}
    return Camera(**numbers, distortion=distortion)


def _read_distortion(attributes: Mapping[str, Any], where: str) -> Distortion | None:
    """Return the distortion of a stored camera; None for a camera without one."""
    model = one_of(
        attribute(attributes, where, "distortion_model", str, "none"),
        (*DISTORTIONS, "none"),
        f"{where} attribute 'distortion_model'",
    )
    if model not in DISTORTIONS:
        return None
    lengths = COEFFICIENTS[model]
    coefficients = as_numbers(attributes.get("distortion", ()), f"{where} attribute 'distortion'")
    if coefficients.ndim != 1 or len(coefficients) not in lengths:
        expected = " or ".join(map(str, lengths))
        raise AmiwarpError(
            f"camera distortion is {shown(coefficients)}; expected {expected} numbers for {model}",
            ErrorCode.FILE_DAMAGED,
        )
    return DISTORTIONS[model](*coefficients.tolist())


def prism_attributes(prism: NominalPrism) -> dict[str, float | str]:
    """Return a plate or a nominal prism as attributes, without ``apex`` if the apex angle is unknown."""
    if isinstance(prism, Plate):
        return {"thickness": prism.thickness, "tilt": prism.tilt, "index": prism.index}
    known: dict[str, float | str] = {}
    if isinstance(prism, Prism):
        known["apex"] = prism.apex
    known["index"] = prism.index
    known["flat_side"] = prism.flat_side.value
    if isinstance(prism, Prism) and prism.second is not None:
        known |= {f"second_{name}": value for name, value in prism_attributes(prism.second).items()}
    return known


def read_prism(attributes: Mapping[str, Any], where: str) -> NominalPrism:
    """Return the nominal prism stored in attributes. The apex angle is unknown if ``apex`` is missing.

    A plate has a ``thickness``.
    """
    if "thickness" in attributes:
        return Plate(
            thickness=attribute(attributes, where, "thickness", float),
            tilt=attribute(attributes, where, "tilt", float),
            index=attribute(attributes, where, "index", float),
        )
    side = attribute(attributes, where, "flat_side", str, FlatSide.SCENE.value)
    unsized = UnsizedPrism(attribute(attributes, where, "index", float), side)
    if "apex" not in attributes:
        return unsized
    second = _read_second_prism(attributes, where)
    apex = attribute(attributes, where, "apex", float)
    return dataclasses.replace(unsized.with_apex(apex), second=second)


def _read_second_prism(attributes: Mapping[str, Any], where: str) -> Prism | None:
    """Return the second prism of a pair; None for a single prism."""
    second = {
        name: attributes[f"second_{name}"]
        for name in ("apex", "index", "flat_side")
        if f"second_{name}" in attributes
    }
    if not second:
        return None
    prism = as_wedge(read_prism(second, f"{where} second prism"))
    if isinstance(prism, UnsizedPrism):
        raise AmiwarpError(
            f"{where} has a second prism without 'second_apex'; add this attribute",
            ErrorCode.FILE_DAMAGED,
        )
    return prism
