"""Camera and prism in files: as JSON objects, and as attributes of an HDF5 group."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.io.json_files import LARGEST_INTEGER, build, fields_of
from amiwarp.optics.camera import CAMERA_NUMBERS, DISTORTIONS, Camera, Distortion
from amiwarp.optics.prism import FlatSide, NominalPrism, Prism, UnsizedPrism
from amiwarp.validation import array, instance, one_of, real, shown, whole

# Camera as a JSON object, in files of calibrations and cameras.


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Return a camera as a JSON object."""
    out = {name: getattr(camera, name) for name in CAMERA_NUMBERS}
    if camera.distortion is not None:
        [kind] = (name for name, lens in DISTORTIONS.items() if isinstance(camera.distortion, lens))
        out["distortion"] = {"kind": kind, **asdict(camera.distortion)}
    return out


def camera_from_json(data: Any, where: str = "") -> Camera:
    """Return a camera from a JSON object.

    ``where`` is the object's name in messages. Raises :class:`AmiwarpError` naming the field.
    """
    given = fields_of(data, where, *CAMERA_NUMBERS, optional=("distortion",))
    prefix, lens = f"{where}." if where else "", given.get("distortion")
    distortion = None
    if lens is not None:
        numbers = dict(lens) if isinstance(lens, dict) else fields_of(lens, f"{prefix}distortion")
        kind = one_of(numbers.pop("kind", None), DISTORTIONS, f"field {prefix}distortion.kind")
        distortion = build(DISTORTIONS[kind], numbers, f"{prefix}distortion")
    return Camera(**{name: given[name] for name in CAMERA_NUMBERS}, distortion=distortion)


# Camera and prism as attributes of an HDF5 group, or of a JSON object in a stream.


def attribute(attributes: Mapping[str, Any], where: str, name: str, kind: type[Any], default: Any = None) -> Any:
    """Return an attribute as type ``kind``; raise :class:`AmiwarpError` if it is missing or of another type."""
    if name not in attributes and default is None:
        raise AmiwarpError(f"{where} has no attribute '{name}'; add this attribute")
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
    model = one_of(attribute(attributes, where, "distortion_model", str, "none"), (*DISTORTIONS, "none"),
                   f"{where} attribute 'distortion_model'")  # fmt: skip
    distortion: Distortion | None = None
    if model in DISTORTIONS:
        length = len(fields(DISTORTIONS[model]))
        coefficients = array(attributes.get("distortion", ()), f"{where} attribute 'distortion'")
        if coefficients.shape != (length,):
            raise AmiwarpError(f"camera distortion is {shown(coefficients)}; expected {length} numbers for {model}")
        distortion = DISTORTIONS[model](*coefficients.tolist())
    kinds = dict(zip(CAMERA_NUMBERS, (int, int, float, float, float, float), strict=True))
    numbers = {name: attribute(attributes, where, name, kind) for name, kind in kinds.items()}
    return Camera(**numbers, distortion=distortion)


def prism_attributes(prism: NominalPrism) -> dict[str, float | str]:
    """Return the attributes of a nominal prism, without ``apex`` if that is unknown."""
    known: dict[str, float | str] = {"apex": prism.apex} if isinstance(prism, Prism) else {}
    return {**known, "index": prism.index, "flat_side": prism.flat_side.value}


def read_prism(attributes: Mapping[str, Any], where: str) -> NominalPrism:
    """Return the nominal prism stored in attributes. The apex angle is unknown if ``apex`` is missing."""
    side = attribute(attributes, where, "flat_side", str, FlatSide.SCENE.value)
    prism = UnsizedPrism(attribute(attributes, where, "index", float), side)
    return prism.with_apex(attribute(attributes, where, "apex", float)) if "apex" in attributes else prism
