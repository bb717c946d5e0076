"""Cameras in a rig's file: their places, intrinsics, and the fields of each kind."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.rig_recording import SensorKind
from amiwarp.io.camera_files import load_camera
from amiwarp.optics.camera import Camera, camera_from_json
from amiwarp.schema.records import at_field, build, check_given, fields_of, value_of, with_fields
from amiwarp.simulation.choices import FrameEncoding, Seeing
from amiwarp.simulation.encoder_model import EncoderModel
from amiwarp.simulation.imu_model import ImuModel
from amiwarp.simulation.rigs.cameras import (
    RigCamera,
    RigDepthCamera,
    RigEventCamera,
    RigFrameCamera,
)
from amiwarp.simulation.rigs.optic_entries import read_optic
from amiwarp.simulation.sensor_model import named_sensor
from amiwarp.simulation.worlds.trajectory import looking_at
from amiwarp.simulation.worlds.world_scene import BLUR_PX

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Row = tuple[float, float, float, float]

UP_ON_RIG = (0.0, -1.0, 0.0)
"""Direction in the rig's frame, whose y axis points down, that appears upwards in the image of a camera that looks
along a given direction."""


@dataclass(frozen=True)
class PlaceEntry:
    """Fields of the place of a camera on the rig."""

    position: Vector | None = None
    """Place of the camera's centre in the rig's frame [m]."""
    look: Vector | None = None
    """Direction in the rig's frame that the camera looks along."""
    rotation: Quaternion | None = None
    """Unit quaternion (x, y, z, w) from the camera's frame to the rig's."""
    to_rig: tuple[Row, Row, Row] | None = None
    """Matrix instead of all these."""

    def matrix(self) -> NDArray[np.float64]:
        """Return the matrix from the camera's frame to the rig's, shape (3, 4)."""
        from scipy.spatial.transform import Rotation

        if self.to_rig is not None:
            if (self.position, self.look, self.rotation) != (None, None, None):
                raise AmiwarpError(
                    "to_rig is given besides position, look or rotation; give one or the other",
                    ErrorCode.FIELD,
                )
            return np.array(self.to_rig)
        if self.look is not None and self.rotation is not None:
            raise AmiwarpError(
                "look and rotation are both given; give one of them", ErrorCode.FIELD
            )
        turn = Rotation.identity()
        if self.look is not None:
            if not any(self.look):
                raise AmiwarpError(
                    "look is a vector of length 0; give the direction that the camera looks along",
                    ErrorCode.FIELD,
                )
            turn = looking_at((0.0, 0.0, 0.0), self.look, UP_ON_RIG)
        if self.rotation is not None:
            turn = Rotation.from_quat(_unit(self.rotation))
        return np.column_stack([turn.as_matrix(), self.position or (0.0, 0.0, 0.0)])


@dataclass(frozen=True)
class PinholeEntry:
    """Fields of ``camera`` for a camera without distortion."""

    size: tuple[int, int] = (640, 480)
    """Width and height [px]."""
    fov_deg: float = 60.0
    """Horizontal field of view [deg]."""


@dataclass(frozen=True)
class EventEntry:
    """Fields of an event camera, but for its optic, sensor, encoder and IMU."""

    blur: float = BLUR_PX
    seeing: Seeing = Seeing.MAPS
    samples: int | None = None
    motion_px: float = 0.5
    truth_hz: float | None = None


@dataclass(frozen=True)
class FrameEntry:
    """Fields of a camera with frames."""

    blur: float = BLUR_PX
    rate_hz: float = 30.0
    exposure_us: int = 5000
    readout_us: int = 0
    colour: bool = False
    bits: int = 8
    encoding: FrameEncoding = FrameEncoding.SRGB
    white: float = 1.0
    electrons: float | None = None
    read_noise: float = 0.0
    samples: int | None = None


@dataclass(frozen=True)
class DepthEntry:
    """Fields of a depth camera."""

    rate_hz: float = 30.0
    nearest_m: float = 0.0
    farthest_m: float | None = None


_OWN: dict[SensorKind, type[Any]] = {
    SensorKind.EVENTS: EventEntry,
    SensorKind.FRAMES: FrameEntry,
    SensorKind.DEPTH: DepthEntry,
}
"""Fields of each kind of camera."""
_PLACE = tuple(PlaceEntry.__dataclass_fields__)
_PARTS = ("optic", "sensor", "encoder", "imu")
"""Fields of an event camera that are tables."""


def read_camera(data: dict[str, Any], where: str, folder: Path) -> RigCamera:
    """Return the camera of an entry of ``sensors``, without its name. ``folder``: folder of the files that it names."""
    check_given(data, where, "kind")
    kind = value_of(SensorKind, data["kind"], f"{where}.kind")
    own = _OWN[kind]
    names = tuple(own.__dataclass_fields__)
    parts = _PARTS if kind is SensorKind.EVENTS else ()
    fields_of(data, where, "kind", optional=("camera", *_PLACE, *names, *parts))

    def given(known: tuple[str, ...]) -> dict[str, Any]:
        return {name: data[name] for name in known if name in data}

    place = build(PlaceEntry, given(_PLACE), where)
    shared: dict[str, Any] = {
        "camera": _intrinsics(data.get("camera", {}), f"{where}.camera", folder),
        "to_rig": at_field(where, place.matrix),
    }
    values = vars(build(own, given(names), where))
    if kind is SensorKind.FRAMES:
        return at_field(where, lambda: RigFrameCamera(**shared, **values))
    if kind is SensorKind.DEPTH:
        return at_field(where, lambda: RigDepthCamera(**shared, **values))
    read = _event_parts(given(parts), where)
    return at_field(where, lambda: RigEventCamera(**shared, **values, **read))


def _intrinsics(data: Any, where: str, folder: Path) -> Camera:
    """Return the camera of a field: the name of a file, a size with a field of view, or all intrinsics."""
    if isinstance(data, str):
        return at_field(where, lambda: load_camera(folder / data))
    if isinstance(data, dict) and "fx" in data:
        return at_field(where, lambda: camera_from_json(data, where))
    entry = build(PinholeEntry, data, where)
    fov = math.radians(entry.fov_deg)
    return at_field(where, lambda: Camera.from_fov(*entry.size, fov))


def _event_parts(given: dict[str, Any], where: str) -> dict[str, Any]:
    """Return optic, sensor, encoder and IMU of an event camera, by the names of :class:`RigEventCamera`."""
    read: dict[str, Any] = {}
    if "optic" in given:
        optic = read_optic(given["optic"], f"{where}.optic")
        read["prism"] = optic.prism
        read["motion"] = optic.motion
        read["nominal_prism"] = optic.nominal
    if "sensor" in given:
        read["sensor"] = _from_preset(given["sensor"], f"{where}.sensor", named_sensor, "default")
    if "imu" in given:
        read["imu"] = _imu(given["imu"], f"{where}.imu")
    if "encoder" in given:
        if "optic" not in given:
            raise AmiwarpError(
                f"field {where}.encoder belongs to an optic; give {where}.optic, or remove it",
                ErrorCode.FIELD,
            )
        read["encoder_model"] = with_fields(EncoderModel(), given["encoder"], f"{where}.encoder")
    return read


def _from_preset(
    data: Any, where: str, named: Any, default: str, left_out: tuple[str, ...] = ()
) -> Any:
    """Return a model: one of a known name, or a table with other values, and optionally the name as ``preset``.

    ``named``: function of the name; ``default``: name of a table without ``preset``; ``left_out``: fields that the
    table cannot have.
    """
    table = {"preset": data} if isinstance(data, str) else data
    if not isinstance(table, dict):
        fields_of(table, where)  # raises the error of a field that is no table
    rest = dict(table)
    name = value_of(str, rest.pop("preset", default), f"{where}.preset")
    model = at_field(where, partial(named, name))
    names = [field for field in model.__dataclass_fields__ if field not in left_out]
    return with_fields(model, rest, where, names)


def _imu(data: Any, where: str) -> ImuModel:
    """Return the IMU of a field: its name, or a table with other values, its place and its rotation."""
    rest = dict(data) if isinstance(data, dict) else data
    arrays: dict[str, Any] = {}
    if isinstance(rest, dict):
        for name, kind in (("position", Vector), ("to_camera", tuple[Vector, Vector, Vector])):
            if name in rest:
                arrays[name] = value_of(kind, rest.pop(name), f"{where}.{name}")
    model = _from_preset(rest, where, ImuModel.preset, "ideal", ("position", "to_camera"))
    return at_field(where, lambda: replace(model, **arrays))


def _unit(quaternion: Quaternion) -> Quaternion:
    """Return a quaternion. Raises :class:`AmiwarpError` if its length is not 1."""
    length = math.hypot(*quaternion)
    if abs(length - 1.0) > 0.01:
        raise AmiwarpError(
            f"rotation has length {length:.3g}; give a unit quaternion (x, y, z, w)",
            ErrorCode.FIELD,
        )
    return quaternion
