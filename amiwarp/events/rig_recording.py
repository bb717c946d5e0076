"""Recording of a rig: the recordings of several sensors on one clock, and where the sensors are."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode, Option
from amiwarp.events.poses import check_rotation
from amiwarp.events.recording import MetadataValue, Recording
from amiwarp.schema.calls import guarded
from amiwarp.validation import choice, finite, instance, shown

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,63}")
"""Pattern of the names of sensors, which are names of files too."""


class SensorKind(Option):
    """What a sensor of a rig records.

    Examples
    --------
    >>> amiwarp.SensorKind("events")
    <SensorKind.EVENTS: 'events'>
    """

    EVENTS = "events"
    """Events; a camera that also has frames, such as a DAVIS, is of this kind."""
    FRAMES = "frames"
    """Frames without events."""
    DEPTH = "depth"
    """Depth maps, with or without frames."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class RigSensor:
    """A sensor of a rig: its recording, and its place on the rig.

    Raises
    ------
    AmiwarpError
        If the kind is unknown, the recording does not hold what the kind means, or ``to_rig`` is no 3x4 matrix of a
        rotation and a translation.

    Examples
    --------
    >>> import numpy as np
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4))
    >>> amiwarp.RigSensor("events", recording, np.eye(3, 4)).kind
    <SensorKind.EVENTS: 'events'>
    """

    kind: SensorKind
    """What the sensor records. Its name may be given, such as ``"events"``."""
    recording: Recording
    """Recording of the sensor, with its camera. A sensor without events has a recording of 0 events."""
    to_rig: NDArray[np.float64]
    """Rotation and translation [m], shape ``(3, 4)``, that turn a point in the sensor's camera frame into the rig's
    frame. A camera looks along z, with x to the right and y down."""

    def __init__(
        self, kind: SensorKind | str, recording: Recording, to_rig: NDArray[np.float64]
    ) -> None:
        """Store the fields."""
        chosen = choice(SensorKind, kind, "kind of a sensor")
        needed = {SensorKind.FRAMES: "frames", SensorKind.DEPTH: "depth"}.get(chosen, "events")
        if getattr(recording, needed) is None:
            raise AmiwarpError(
                f"sensor {recording.name} is of the kind {chosen.value}, but its recording has no {needed}; give "
                "another kind, or the recording of the sensor",
                ErrorCode.CONTENT_MISSING,
            )
        check_to_rig(to_rig)
        object.__setattr__(self, "kind", chosen)
        object.__setattr__(self, "recording", recording)
        object.__setattr__(self, "to_rig", to_rig)


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class RigRecording:
    """Recordings of the sensors of a rig, whose times are all on one clock.

    Raises
    ------
    AmiwarpError
        If there is no sensor, or the name of a sensor has other characters than letters, digits, ``_`` and ``-``.

    Examples
    --------
    >>> import numpy as np
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4))
    >>> shifted = np.eye(3, 4)
    >>> shifted[0, 3] = 0.1
    >>> left = amiwarp.RigSensor("events", recording, np.eye(3, 4))
    >>> right = amiwarp.RigSensor("events", recording, shifted)
    >>> rig = amiwarp.RigRecording({"left": left, "right": right})
    >>> rig.between("left", "right")[:, 3].tolist()
    [-0.1, 0.0, 0.0]
    """

    sensors: Mapping[str, RigSensor]
    """Sensors by name, in order."""
    metadata: Mapping[str, MetadataValue] = field(default_factory=dict)
    """Other information by name, such as the world."""
    name: str = "rig"
    """Short name of the rig in messages and titles: the name of its folder."""

    def __post_init__(self) -> None:
        if not self.sensors:
            raise AmiwarpError("a rig has no sensors; give at least one")
        for name, sensor in self.sensors.items():
            check_sensor_name(name)
            instance(sensor, RigSensor, f"sensor {name}")

    def __getitem__(self, name: str, /) -> RigSensor:
        """Return the sensor of a name. Raises :class:`AmiwarpError` for an unknown one."""
        if not isinstance(name, str) or name not in self.sensors:
            raise AmiwarpError(
                f"{self.name}: has no sensor {shown(name)}; choose among {', '.join(self.sensors)}",
                ErrorCode.CONTENT_MISSING,
            )
        return self.sensors[name]

    def __repr__(self) -> str:
        listed = [f"{name}: {sensor.kind.value}" for name, sensor in self.sensors.items()]
        return f"RigRecording({self.name!r}, {', '.join(listed)})"

    def between(self, source: str, target: str) -> NDArray[np.float64]:
        """Return the matrix that turns points in the frame of one sensor into the frame of another.

        Parameters
        ----------
        source, target : str
            Names of the sensors.

        Returns
        -------
        numpy.ndarray
            Rotation and translation [m], shape ``(3, 4)``.

        Raises
        ------
        AmiwarpError
            If a name is unknown.
        """
        from_source = self[source].to_rig
        from_target = self[target].to_rig
        rotation = from_target[:, :3].T @ from_source[:, :3]
        translation = from_target[:, :3].T @ (from_source[:, 3] - from_target[:, 3])
        return np.column_stack([rotation, translation])


def check_to_rig(to_rig: NDArray[np.float64]) -> None:
    """Raise :class:`AmiwarpError` for other than a rotation and a translation, float64 of shape ``(3, 4)``."""
    if to_rig.dtype != np.float64 or to_rig.shape != (3, 4):
        raise AmiwarpError(
            f"to_rig is {to_rig.dtype} of shape {to_rig.shape}; give float64 of shape (3, 4)"
        )
    finite(to_rig, "to_rig")
    try:
        check_rotation(to_rig[:, :3])
    except AmiwarpError as error:
        raise AmiwarpError(f"to_rig: {error}") from error


def check_sensor_name(name: str) -> None:
    """Raise :class:`AmiwarpError` for a name of a sensor that is no name of a file on every system."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise AmiwarpError(
            f"sensor {shown(name)}: give a name of at most 64 letters, digits, _ and -, as 'left'"
        )
