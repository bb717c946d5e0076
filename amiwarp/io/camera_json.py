"""Camera as a JSON object, in files of calibrations and cameras."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from amiwarp.io.json_files import build, fields_of
from amiwarp.optics.camera import CAMERA_NUMBERS, Camera
from amiwarp.optics.lens import DISTORTIONS
from amiwarp.validation import one_of


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
