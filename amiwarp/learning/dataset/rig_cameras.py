"""Cameras of the rig that records a data set: how a specification gives them, and what they draw."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name
from amiwarp.learning.dataset.digests import content_digest
from amiwarp.learning.dataset.randomise import OPTIC, SENSOR, DrawEntry
from amiwarp.optics.prism import Prism
from amiwarp.schema.records import at_field, build
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.rigs.cameras import (
    RigCamera,
    RigDepthCamera,
    RigEventCamera,
    RigFrameCamera,
    check_camera_names,
)
from amiwarp.simulation.rigs.rig_specification import CamerasEntry, read_cameras, read_rig_file

ONE_CAMERA = ("prisms", "speeds_rpm", "no_prism", "sensors", "camera", "truth_hz")
"""Fields of the optic and of the camera, which a rig's cameras have themselves."""


@dataclass(frozen=True)
class DatasetRig:
    """Cameras of the rig of a specification."""

    cameras: Mapping[str, RigCamera]
    """Cameras by name."""
    recipe: Mapping[str, Any]
    """Everything that determines the cameras, as JSON data."""


def check_fields_beside_rig(data: Mapping[str, Any]) -> None:
    """Raise :class:`AmiwarpError` for a field of one camera next to a rig, whose cameras have their own."""
    for name in ONE_CAMERA:
        if name in data:
            raise AmiwarpError(
                f"field {name} is of one camera, but rig is given, whose cameras have their own; remove one of them",
                ErrorCode.FIELD,
            )
    if "output" in data:
        raise AmiwarpError(
            "field output makes tensors of one camera, but rig is given; remove one of them",
            ErrorCode.FIELD,
        )


def read_dataset_rig(data: Any, folder: Path) -> DatasetRig:
    """Return the cameras of the field ``rig`` of a specification: the name of a rig's file, or a table.

    ``folder``: folder of the specification. World, trajectory, duration and seed of the file do not matter.
    """
    if isinstance(data, str):
        path = folder / data
        entry: CamerasEntry = read_rig_file(path)
        inner = Path(data).parent
        with errors_name(path, lambda: "is no file of a rig"):
            cameras = _checked_cameras(entry, path.parent, "")
    else:
        entry = build(CamerasEntry, data, "rig")
        inner = Path()
        cameras = _checked_cameras(entry, folder, "rig.")
    recipe = {
        "cameras": list(cameras),
        "rig": entry.rig,
        "sensors": list(entry.sensors),
        "folder": inner.as_posix(),
        "files": _files_of(entry, folder / inner),
    }
    return DatasetRig(cameras, recipe)


def cameras_of(recipe: Mapping[str, Any], folder: Path) -> dict[str, RigCamera]:
    """Return the cameras of a recipe. ``folder``: folder of the specification."""
    entry = CamerasEntry(rig=recipe["rig"], sensors=tuple(recipe["sensors"]))
    return read_cameras(entry, folder / recipe["folder"], "rig.")


def _checked_cameras(entry: CamerasEntry, folder: Path, within: str) -> dict[str, RigCamera]:
    """Return the cameras of a rig. Raises :class:`AmiwarpError` for names that do not fit together."""
    cameras = read_cameras(entry, folder, within)
    at_field(f"{within}sensors", lambda: check_camera_names(cameras))
    return cameras


def _files_of(entry: CamerasEntry, folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file of intrinsics that the cameras name."""
    digests = {}
    for sensor in entry.sensors:
        name = sensor.get("camera")
        if isinstance(name, str):
            digests[name] = content_digest(folder / name)
    return digests


def shortest_s(cameras: Mapping[str, RigCamera]) -> float:
    """Return the duration in which each camera takes one image at least [s]."""
    longest_us = 0
    for camera in cameras.values():
        if isinstance(camera, RigFrameCamera):
            longest_us = max(longest_us, camera.exposure_us + camera.readout_us)
    return longest_us * 1e-6


def check_duration(cameras: Mapping[str, RigCamera], duration_s: float, where: str) -> None:
    """Raise :class:`AmiwarpError` for a duration in which a camera takes no frame."""
    for name, camera in cameras.items():
        needed_s = shortest_s({name: camera})
        if duration_s < needed_s:
            raise AmiwarpError(
                f"field {where} is {duration_s:g} s, but the rig's camera {name!r} needs {needed_s:g} s for a frame; "
                "give a longer duration",
                ErrorCode.FIELD,
            )


def check_rig_randomise(entries: Mapping[str, DrawEntry], cameras: Mapping[str, RigCamera]) -> None:
    """Raise :class:`AmiwarpError` for values that no camera of the rig has, or that one of them cannot have."""
    wedges = [name for name, camera in cameras.items() if _has_wedge(camera)]
    of_events = [camera for camera in cameras.values() if isinstance(camera, RigEventCamera)]
    blurred = [camera for camera in cameras.values() if not isinstance(camera, RigDepthCamera)]
    for name, entry in entries.items():
        if name in OPTIC and len(wedges) != 1:
            found = ", ".join(wedges) or "none"
            raise AmiwarpError(
                f"field randomise.{name} is of the one camera behind a single rotating wedge; the rig has {found}; "
                "remove the field, or change the optics",
                ErrorCode.FIELD,
            )
        if name in SENSOR and not of_events:
            raise AmiwarpError(
                f"field randomise.{name} is of event cameras, and the rig has none; remove it",
                ErrorCode.FIELD,
            )
        if name == "blur_px" and not blurred:
            raise AmiwarpError(
                "field randomise.blur_px is of cameras with events or frames, and the rig has none; remove it",
                ErrorCode.FIELD,
            )
        for value in entry.ends:
            at_field(f"randomise.{name}", partial(drawn_cameras, cameras, {name: value}))


def drawn_cameras(
    cameras: Mapping[str, RigCamera], drawn: Mapping[str, float]
) -> dict[str, RigCamera]:
    """Return the cameras with drawn values: blur of all, sensor of all event cameras, and motion of the wedge."""
    changed = {}
    for name, camera in cameras.items():
        if "blur_px" in drawn and not isinstance(camera, RigDepthCamera):
            camera = replace(camera, blur=drawn["blur_px"])
        if isinstance(camera, RigEventCamera):
            of_sensor = {key: value for key, value in drawn.items() if key in SENSOR}
            camera = replace(camera, sensor=replace(camera.sensor, **of_sensor))
            if _has_wedge(camera):
                camera = _with_drawn_wedge(camera, drawn)
        changed[name] = camera
    return changed


def _has_wedge(camera: RigCamera) -> bool:
    """Return whether a camera is behind one rotating wedge, and not behind a pair."""
    if not isinstance(camera, RigEventCamera):
        return False
    return isinstance(camera.prism, Prism) and camera.prism.second is None


def _with_drawn_wedge(camera: RigEventCamera, drawn: Mapping[str, float]) -> RigEventCamera:
    """Return a camera behind a wedge with drawn apex angle, speed and azimuth at the start."""
    prism = camera.prism
    motion = camera.motion
    if not isinstance(motion, PrismMotion):
        motion = PrismMotion(motion)
    if "apex_deg" in drawn and isinstance(prism, Prism):
        prism = replace(prism, apex=math.radians(drawn["apex_deg"]))
    if "rpm" in drawn:
        motion = replace(motion, rpm=drawn["rpm"])
    if "start_deg" in drawn:
        motion = replace(motion, phase=math.radians(drawn["start_deg"]))
    return replace(camera, prism=prism, motion=motion)
