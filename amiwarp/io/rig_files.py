"""Recorded rigs: a folder with one recording for each sensor, and ``rig.json``, which says how they belong together.

The format is described in ``docs/reference/recording-format.md``.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import MetadataValue
from amiwarp.events.rig_recording import (
    RigRecording,
    RigSensor,
    SensorKind,
    check_sensor_name,
    check_to_rig,
)
from amiwarp.events.truth import WorldLabels
from amiwarp.io.formats import RIG_FILE, open_recording
from amiwarp.io.inputs import errors_name
from amiwarp.io.json_files import read_json
from amiwarp.io.native.copying import copy_recording
from amiwarp.io.native.writer import RecordingWriter
from amiwarp.io.output_formats import Codec, make_folder
from amiwarp.io.outputs import check_output, write_text
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism
from amiwarp.schema.calls import guarded
from amiwarp.schema.records import at_field, check_given, fields_of, value_of
from amiwarp.tasks import Progress, part, silent
from amiwarp.validation import choice, shown

FORMAT = "amiwarp-rig"
"""Value of the field ``format``."""

FORMAT_VERSION = 1
"""Newest version of the format that is read, and the version that is written."""


@dataclass(frozen=True, slots=True)
class _StoredSensor:
    """Fields of a sensor in the file of a rig."""

    kind: SensorKind
    file: str
    """Name of the recording in the folder of the rig."""
    to_rig: list[list[float]]
    """Matrix of the shape (3, 4), row by row."""


@dataclass(frozen=True, slots=True)
class _StoredRig:
    """Fields of the file of a rig, but for its format."""

    sensors: Mapping[str, Any]
    metadata: Mapping[str, Any] = field(default_factory=dict)


def is_rig(path: Path) -> bool:
    """Return whether a path is the folder of a rig, or the file of a rig."""
    return path.name == RIG_FILE or (path / RIG_FILE).is_file()


@guarded
def open_rig(path: str | os.PathLike[str]) -> RigRecording:
    """Open a recorded rig. Events and frames are read on demand.

    Parameters
    ----------
    path : str or path-like
        The folder of the rig, or the file ``rig.json`` in it.

    Returns
    -------
    RigRecording
        The sensors with their recordings.

    Raises
    ------
    AmiwarpError
        If the folder holds no rig, or a field or a recording of it is missing or wrong.

    Examples
    --------
    >>> import numpy as np
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4))
    >>> left = amiwarp.RigSensor("events", recording, np.eye(3, 4))
    >>> amiwarp.save_rig("rig", amiwarp.RigRecording({"left": left}))
    >>> amiwarp.open_rig("rig")
    RigRecording('rig', left: events)
    """
    path = Path(path)
    file = path if path.name == RIG_FILE else path / RIG_FILE
    data = read_json(file, "a rig")
    with errors_name(file, lambda: "a rig"):
        check_given(data, "", "format", "format_version", "sensors")
        if data["format"] != FORMAT:
            raise AmiwarpError(
                f"field format is {shown(data['format'])}; expected {FORMAT!r}", ErrorCode.FIELD
            )
        version = value_of(int, data["format_version"], "format_version")
        if version > FORMAT_VERSION:
            raise AmiwarpError(
                f"format_version {version} is newer than {FORMAT_VERSION}; update amiwarp",
                ErrorCode.FORMAT_UNKNOWN,
            )
        stored = value_of(_StoredRig, _known_fields(_StoredRig, data), "")
        sensors = {}
        for name, entry in stored.sensors.items():
            sensors[name] = _open_sensor(file.parent, name, entry)
        metadata = {name: _metadata_value(name, value) for name, value in stored.metadata.items()}
        return RigRecording(sensors, metadata, file.parent.resolve().name)


def _known_fields(kind: type[Any], data: Any, where: str = "") -> dict[str, Any]:
    """Return the fields of an object that a dataclass has. Others are of later versions."""
    given = data if isinstance(data, dict) else fields_of(data, where)
    return {name: value for name, value in given.items() if name in kind.__dataclass_fields__}


def _open_sensor(folder: Path, name: str, entry: Any) -> RigSensor:
    """Open the recording of a sensor."""
    where = f"sensors.{name}"
    stored = value_of(_StoredSensor, _known_fields(_StoredSensor, entry, where), where)
    plain = {PurePosixPath(stored.file).name, PureWindowsPath(stored.file).name}
    if plain != {stored.file}:
        raise AmiwarpError(
            f"field {where}.file is {shown(stored.file)}; expected the name of a file in the folder of the rig",
            ErrorCode.FIELD,
        )

    def make() -> RigSensor:
        recording = open_recording(folder / stored.file)
        return RigSensor(stored.kind, recording, _matrix(stored.to_rig))

    return at_field(where, make)


def _matrix(rows: list[list[float]]) -> NDArray[np.float64]:
    """Return the rows of a matrix as an array. Raises :class:`AmiwarpError` if they are not of one length."""
    if len({len(row) for row in rows}) != 1:
        raise AmiwarpError(
            f"to_rig has rows of {[len(row) for row in rows]} numbers; give 3 rows of 4",
            ErrorCode.FIELD,
        )
    return np.array(rows, np.float64)


def _metadata_value(name: str, value: Any) -> MetadataValue:
    """Return a value of the metadata. Raises :class:`AmiwarpError` for lists and objects."""
    if not isinstance(value, str | int | float | bool):
        raise AmiwarpError(
            f"field metadata.{name} is {shown(value)}; expected a text, a number or a truth value",
            ErrorCode.FIELD,
        )
    return value


@guarded
class RigWriter:
    """Writer that streams the recordings of a rig into a folder.

    Use it in a ``with`` block. The recordings and ``rig.json``, which comes last, appear when the block ends without an
    exception. After an exception nothing remains.

    Parameters
    ----------
    folder : str or path-like
        The folder of the rig, which is made if it does not exist.
    metadata : mapping, optional
        Other information on the rig: text, numbers and truth values by name.
    overwrite : bool, default False
        Whether existing files may be replaced.

    Raises
    ------
    AmiwarpError
        If the folder or a file in it cannot be written, or a file exists without ``overwrite``.

    Examples
    --------
    >>> import numpy as np
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> with amiwarp.RigWriter("stereo") as rig:
    ...     left = rig.add("left", "events", np.eye(3, 4), width=4, height=4)
    ...     left.append(events)
    >>> amiwarp.open_rig("stereo")
    RigRecording('stereo', left: events)
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        metadata: Mapping[str, MetadataValue] | None = None,
        overwrite: bool = False,
    ) -> None:
        self.folder = Path(folder)
        """Folder of the rig."""
        self._overwrite = overwrite
        self._metadata: dict[str, MetadataValue] = {}
        for name, value in (metadata or {}).items():
            plain = value.item() if isinstance(value, np.generic) else value
            self._metadata[name] = _metadata_value(name, plain)
        self._sensors: dict[str, dict[str, Any]] = {}
        self._writers = contextlib.ExitStack()
        self._is_open = False

    def __enter__(self) -> RigWriter:
        make_folder(self.folder)
        check_output(self.folder / RIG_FILE, overwrite=self._overwrite)
        self._is_open = True
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._is_open = False
        self._writers.__exit__(kind, error, trace)
        if error is not None:
            return
        data = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "metadata": self._metadata,
            "sensors": self._sensors,
        }
        text = json.dumps(data, indent=1) + "\n"
        write_text(self.folder / RIG_FILE, text, overwrite=self._overwrite)

    def add(
        self,
        name: str,
        kind: SensorKind | str,
        to_rig: NDArray[np.float64],
        *,
        width: int,
        height: int,
        camera: Camera | None = None,
        prism: NominalPrism | None = None,
        encoder: Encoder | None = None,
        truth_parameters: Mapping[str, float] | None = None,
        truth_labels: WorldLabels | None = None,
        metadata: Mapping[str, MetadataValue] | None = None,
        codec: Codec | str = Codec.BLOSC,
    ) -> RecordingWriter:
        """Add a sensor, and return the writer of its recording, which the rig's block ends.

        Parameters
        ----------
        name : str
            Name of the sensor, which its file gets: letters, digits, ``_`` and ``-``.
        kind : SensorKind or str
            What the sensor records.
        to_rig : numpy.ndarray
            Rotation and translation [m] from the sensor's camera frame to the rig's frame, shape ``(3, 4)``.
        width, height : int
            Sensor size [px].
        camera : Camera, optional
            The camera, of the same size.
        prism : Prism or UnsizedPrism, optional
            The nominal prism.
        encoder : Encoder, optional
            The encoder. The writer's :meth:`RecordingWriter.set_encoder` can replace it later.
        truth_parameters : mapping of str to float, optional
            True parameters of a synthetic recording.
        truth_labels : WorldLabels, optional
            Names in the world of a synthetic recording.
        metadata : mapping, optional
            Other information on the sensor: text, numbers and truth values by name.
        codec : Codec or str, default "blosc"
            Compression, as of :class:`amiwarp.RecordingWriter`.

        Returns
        -------
        RecordingWriter
            The writer, which is open.

        Raises
        ------
        AmiwarpError
            If the name is taken or no name of a file, the matrix is no rotation and translation, or the file exists.
        """
        if not self._is_open:
            raise AmiwarpError(
                f"{self.folder}: the writer is used outside its 'with' block; add sensors inside it"
            )
        check_sensor_name(name)
        if name.lower() in map(str.lower, self._sensors):
            raise AmiwarpError(
                f"{self.folder}: sensor {name} is there already; give each its own name"
            )
        check_to_rig(to_rig)
        chosen = choice(SensorKind, kind, f"{self.folder}: kind of {name}")
        file = f"{name}.h5"
        writer = RecordingWriter(
            self.folder / file,
            width=width,
            height=height,
            camera=camera,
            prism=prism,
            encoder=encoder,
            truth_parameters=truth_parameters,
            truth_labels=truth_labels,
            metadata=metadata,
            overwrite=self._overwrite,
            codec=codec,
        )
        self._writers.enter_context(writer)
        self._sensors[name] = {"kind": chosen.value, "file": file, "to_rig": to_rig.tolist()}
        return writer


@guarded
def save_rig(
    folder: str | os.PathLike[str],
    rig: RigRecording,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> None:
    """Write a rig to a folder: a recording for each sensor, and ``rig.json``.

    Parameters
    ----------
    folder : str or path-like
        The folder, which is made if it does not exist.
    rig : RigRecording
        The rig.
    overwrite : bool, default False
        Whether existing files may be replaced.
    progress : callable, optional
        Called with the name of the step and the finished fraction of the task, 0 to 1.

    Raises
    ------
    AmiwarpError
        If a file cannot be written, is being read, or exists without ``overwrite``.

    Examples
    --------
    >>> import numpy as np
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4))
    >>> left = amiwarp.RigSensor("events", recording, np.eye(3, 4))
    >>> amiwarp.save_rig("saved", amiwarp.RigRecording({"left": left}))
    """
    count = len(rig.sensors)
    with RigWriter(folder, metadata=rig.metadata, overwrite=overwrite) as writer:
        for index, (name, sensor) in enumerate(rig.sensors.items()):
            recording = sensor.recording
            width, height = recording.events.size
            truth = recording.truth
            written = writer.add(
                name,
                sensor.kind,
                sensor.to_rig,
                width=width,
                height=height,
                camera=recording.camera,
                prism=recording.prism,
                encoder=recording.encoder,
                truth_parameters=None if truth is None else truth.parameters,
                truth_labels=None if truth is None else truth.labels,
                metadata=recording.metadata,
            )
            share = part(progress or silent, index / count, (index + 1) / count)
            copy_recording(recording, written, (width, height), share)
