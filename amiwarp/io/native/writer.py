"""Writer of a whole recording or none."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events import other_sensors, poses
from amiwarp.events.encoder import Encoder
from amiwarp.events.other_sensors import ImuSamples
from amiwarp.events.poses import Poses
from amiwarp.events.recording import Events, MetadataValue
from amiwarp.events.truth import MAPS, EventTruth, FrameTruth, WorldLabels
from amiwarp.io.hdf5.chunk_file import ChunkFile
from amiwarp.io.inputs import errors_name
from amiwarp.io.native.event_writer import EventWriter, FlaggedEvents
from amiwarp.io.native.header import check_sensor_size, write_header
from amiwarp.io.native.layout import POSE_TABLES, Columns
from amiwarp.io.native.records import Datasets, Records
from amiwarp.io.native.written_columns import encoder_columns
from amiwarp.io.output_formats import Codec, check_native
from amiwarp.io.outputs import NewFile
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism
from amiwarp.schema.calls import guarded
from amiwarp.validation import choice


@guarded
class RecordingWriter:
    """Writer that streams a recording into a native HDF5 file.

    Use it in a ``with`` block. The file appears under its name when the block ends without an exception. After an
    exception nothing remains.

    Parameters
    ----------
    path : str or path-like
        The file to write, which ends in ``.h5`` or ``.hdf5``.
    width, height : int
        Sensor size [px].
    camera : Camera, optional
        The camera, of the same size.
    prism : Prism or UnsizedPrism, optional
        The nominal prism.
    encoder : Encoder, optional
        The encoder. :meth:`set_encoder` can replace it later.
    truth_parameters : mapping of str to float, optional
        True parameters of a synthetic recording.
    truth_labels : WorldLabels, optional
        Names in the world of a synthetic recording.
    metadata : mapping, optional
        Other information: text, numbers and truth values by name.
    overwrite : bool, default False
        Whether an existing file may be replaced.
    codec : Codec or str, default "blosc"
        Compression. Programs without HDF5's Blosc filter read ``"gzip"``.

    Raises
    ------
    AmiwarpError
        If the path has another extension, cannot be written, is being read, or exists without ``overwrite``; or if
        events are unsorted or outside the frame.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> with amiwarp.RecordingWriter("short.h5", width=4, height=4) as writer:
    ...     writer.append(events)
    >>> len(amiwarp.open_recording("short.h5").events)
    2
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        width: int,
        height: int,
        camera: Camera | None = None,
        prism: NominalPrism | None = None,
        encoder: Encoder | None = None,
        truth_parameters: Mapping[str, float] | None = None,
        truth_labels: WorldLabels | None = None,
        metadata: Mapping[str, MetadataValue] | None = None,
        overwrite: bool = False,
        codec: Codec | str = Codec.BLOSC,
    ) -> None:
        self.path = Path(path)
        self._overwrite = overwrite
        check_native(self.path)
        self._codec = choice(Codec, codec, f"{self.path}: codec")
        check_sensor_size(self.path, width, height, camera)
        self._size = (int(width), int(height))
        self._camera = camera
        self._prism = prism
        self._encoder = encoder
        self._truth_parameters = truth_parameters
        self._truth_labels = truth_labels
        self._metadata = dict(metadata or {})
        # The file, from the beginning of the ``with`` block on.
        self._new: NewFile | None = None
        self._chunks: Any = None
        self._datasets: Any = None
        self._records: Any = None
        self._events: EventWriter | None = None
        self._open = False

    def __len__(self) -> int:
        return 0 if self._events is None else len(self._events)

    def __enter__(self) -> RecordingWriter:
        self._new = NewFile(self.path, overwrite=self._overwrite)
        try:
            with errors_name(self.path, lambda: "making the file"):
                self._chunks = ChunkFile(self._new.part)
                self._datasets = Datasets(self._chunks.hdf5, self._codec)
                self._records = Records(self.path, self._datasets)
                self._events = EventWriter(
                    self.path, self._size, self._chunks, self._datasets, self._codec
                )
                self._open = True
                write_header(
                    self._chunks.hdf5, self._size, self._camera, self._prism, self._metadata
                )
                self._write_truth_header()
        except BaseException:
            self._discard()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None or self._new is None:
            self._discard()
            return
        try:
            with errors_name(self.path, lambda: f"finishing after {len(self)} events"):
                self._finish()
                self._close()
                self._new.commit()
        except BaseException:
            self._discard()
            raise

    def append(
        self,
        events: Events,
        *,
        truth_points: ArrayLike | None = None,
        truth: EventTruth | None = None,
        inside: ArrayLike | None = None,
        extrapolated: ArrayLike | None = None,
    ) -> None:
        """Append events. All calls must give the same optional arrays.

        Parameters
        ----------
        events : Events
            The events, not earlier than those before.
        truth_points : array_like, optional
            Pixels of the scene points without the prism [px], shape (n, 2).
        truth : EventTruth, optional
            All ground truth of the events, the scene points included; then ``truth_points`` is not used.
        inside : array_like, optional
            For compensated events: whether each lies inside the image, shape (n,). Required if coordinates are NaN.
        extrapolated : array_like, optional
            For compensated events: whether the prism angle was extrapolated beyond the encoder's samples, shape (n,).

        Raises
        ------
        AmiwarpError
            If events are unsorted or outside the frame, or the arrays differ from the arrays of the first call.
        """
        writer = self._opened()
        if truth is None:
            with errors_name(self.path, lambda: f"after {len(self)} events"):
                points = None if truth_points is None else np.asarray(truth_points, np.float32)
                truth = EventTruth(points=points)
        writer.append(events, truth, inside=inside, extrapolated=extrapolated)

    def fill(
        self,
        pieces: Iterable[Callable[[], FlaggedEvents]],
        *,
        count: int,
        t_first: int,
    ) -> Generator[FlaggedEvents, None, None]:
        """Return an iterator that writes a whole recording of compensated events.

        Pieces are computed and written in parallel on all cores, some ahead of the iteration. Take them all: a writer
        that is closed before fails.

        Parameters
        ----------
        pieces : iterable of callable
            Functions that return events, their ``inside`` flags, and encoded chunks of columns by name, in order.
            Threads call them. If the codec is Blosc, encoded chunks are stored unchanged; the rest is encoded. If times
            and polarities are both encoded, they are not checked, nor are positions whose flag is 1.
        count : int
            Number of events of each piece: a whole number of chunks. Only the last piece may be shorter, or empty.
        t_first : int
            Time of the first event [us].

        Returns
        -------
        generator of tuple
            Each piece after it was written, in order.

        Raises
        ------
        AmiwarpError
            If other events were written before, events are unsorted or outside the frame, or another piece than the
            last one has not ``count`` events.
        """
        return self._opened().fill(pieces, count, t_first)

    def append_frame(self, frame: FrameTruth) -> None:
        """Append the ground truth of an instant.

        Parameters
        ----------
        frame : FrameTruth
            Ground truth of all pixels, at a later time than the frame before. All frames have the same joints.
        """
        with self._appending(lambda: f"truth of the instant {frame.t_us} us"):
            width, height = self._size
            maps: Columns = {}
            for name, (dtype, tail) in MAPS.items():
                values = np.asarray(getattr(frame, name), dtype)
                expected = (height, width, *tail)
                if values.shape != expected:
                    what = f"{name} of the instant {frame.t_us} us has shape {values.shape}"
                    raise AmiwarpError(f"{self.path}: {what}; expected {expected}")
                maps[f"truth/frames/{name}"] = values[None]
            rows = {
                "truth/frames/t": np.array([frame.t_us], np.int64),
                "truth/frames/pose": poses.as_poses(frame.rotation, frame.position)[None],
            }
            joints = {name: place[None] for name, place in frame.joints.items()}
            named = {"truth/joints/names": ("truth/frames/joints", joints)}
            self._records.append(rows, maps, named)

    def append_known(self, t_us: int, mask: NDArray[np.bool_]) -> None:
        """Append a mask of the pixels whose scene is known.

        Parameters
        ----------
        t_us : int
            Time from which the mask holds [us], later than the time of the mask before.
        mask : numpy.ndarray
            Whether the scene at each pixel without the prism is known, shape ``(height, width)``.
        """
        with self._appending(lambda: f"mask at {t_us} us"):
            if mask.shape != self._size[::-1]:
                what = f"mask at {t_us} us has shape {mask.shape}"
                raise AmiwarpError(f"{self.path}: {what}; expected {self._size[::-1]}")
            if mask.dtype != np.bool_:
                raise AmiwarpError(
                    f"{self.path}: mask at {t_us} us is {mask.dtype}; give truth values (bool)"
                )
            rows = {"truth/known/t": np.array([t_us], np.int64)}
            images = {"truth/known/mask": np.asarray(mask, np.uint8)[None]}
            self._records.append(rows, images)

    def append_poses(self, poses: Poses) -> None:
        """Append true poses of camera, bodies and joints.

        Parameters
        ----------
        poses : Poses
            Poses at later times than those before, of the same bodies and joints.
        """
        with self._appending(lambda: "true poses"):
            if not len(poses):
                return
            rows = {
                "truth/poses/t": np.asarray(poses.t, np.int64),
                "truth/poses/camera": np.asarray(poses.camera, np.float64),
            }
            named = {
                names: (values, getattr(poses, what))
                for what, (names, values, _) in POSE_TABLES.items()
            }
            self._records.append(rows, named=named)

    def append_imu(self, samples: ImuSamples) -> None:
        """Append samples of an inertial measurement unit.

        Parameters
        ----------
        samples : ImuSamples
            Samples, not earlier than those before.
        """
        with self._appending(lambda: "IMU samples"):
            rows = {
                "imu/t": samples.t,
                "imu/angular_velocity": samples.angular_velocity,
                "imu/acceleration": samples.acceleration,
            }
            self._records.append(rows)
            if samples.to_camera is not None:
                self._chunks.hdf5["imu"].attrs["to_camera"] = samples.to_camera.ravel()

    def append_image(
        self,
        t_us: int,
        image: NDArray[Any] | None = None,
        *,
        exposure_us: tuple[int, int] | None = None,
        depth: NDArray[np.float32] | None = None,
    ) -> None:
        """Append a frame, a depth map, or both of one time. All calls must give the same optional arrays.

        Parameters
        ----------
        t_us : int
            Time of the frame [us], not earlier than the frame before: the middle of its exposure.
        image : numpy.ndarray, optional
            Grey levels of shape ``(height, width)`` or RGB colours of shape ``(height, width, 3)``, uint8 or uint16, of
            the type and shape of the frames before.
        exposure_us : tuple of int, optional
            Begin and end of the exposure, of the middle row of a rolling shutter [us].
        depth : numpy.ndarray, optional
            Depth along the camera's axis [m], float32 of shape ``(height, width)``: infinite for the sky, and NaN if it
            is unknown.

        Raises
        ------
        AmiwarpError
            If the arrays have other types or shapes, neither an image nor a depth is given, the exposure does not hold
            the time, or the time is earlier than the time before.
        """
        with self._appending(lambda: f"frame at {t_us} us"):
            t = np.array([t_us], np.int64)
            rows: Columns = {"frames/t": t}
            images: Columns = {}
            if image is None and depth is None:
                raise AmiwarpError(
                    f"{self.path}: frame at {t_us} us: give an image, a depth map or both"
                )
            try:
                if image is not None:
                    stored = self._datasets.find("frames/image")
                    shape = image.shape if stored is None else stored.shape[1:]
                    dtype = image.dtype if stored is None else stored.dtype
                    other_sensors.check_image(image, shape, dtype)
                    images["frames/image"] = image[None]
                if depth is not None:
                    of_image = depth.shape if image is None else image.shape[:2]
                    other_sensors.check_depth(depth, of_image)
                    images["frames/depth"] = depth[None]
                if exposure_us is not None:
                    rows["frames/exposure"] = np.array([exposure_us], np.int64)
                    other_sensors.check_exposure(rows["frames/exposure"], t)
            except AmiwarpError as error:
                raise AmiwarpError(f"{self.path}: {error}") from error
            self._records.append(rows, images)

    @contextlib.contextmanager
    def _appending(self, place: Callable[[], str]) -> Iterator[None]:
        """Name the file and the place in errors, also if the writer is not open or the disk is full."""
        with errors_name(self.path, place):
            self._opened()
            yield
            self._chunks.check()

    def _write_truth_header(self) -> None:
        """Write the true parameters of a simulation, and the names of a world's instances and their classes."""
        if self._truth_parameters is not None:
            group = self._chunks.hdf5.create_group("truth")
            for name, value in self._truth_parameters.items():
                group.attrs[name] = float(value)
        if self._truth_labels is not None:
            self._chunks.hdf5.require_group("truth/world").attrs["name"] = self._truth_labels.name
            for what in ("instances", "categories"):
                names = getattr(self._truth_labels, what)
                self._datasets.write_names(f"truth/world/{what}", names)

    def _opened(self) -> EventWriter:
        """Return the writer of the events. Raises :class:`AmiwarpError` outside the ``with`` block."""
        if not self._open or self._events is None or self._events.failed:
            given = "the writer is used outside its 'with' block, before or after it, or after it failed"
            raise AmiwarpError(f"{self.path}: {given}; append inside the block of a new writer")
        return self._events

    def set_encoder(self, encoder: Encoder) -> None:
        """Set or replace the encoder, which is written at the end.

        Parameters
        ----------
        encoder : Encoder
            The encoder.

        Raises
        ------
        AmiwarpError
            If the file is finished.
        """
        if self._new is not None:
            self._opened()
        self._encoder = encoder

    def _finish(self) -> None:
        self._opened().finish()
        if self._encoder is not None:
            group = self._chunks.hdf5.create_group("encoder")
            group.attrs["clock_offset_us"] = float(self._encoder.clock_offset_us)
            for name, values in encoder_columns(self._encoder).items():
                self._datasets.extend(name, values)

    def _close(self) -> None:
        self._open = False
        if self._chunks is not None:
            self._chunks.close()
        self._datasets = None
        self._records = None

    def _discard(self) -> None:
        # The file is removed even if it cannot be closed.
        with contextlib.suppress(Exception):
            self._close()
        if self._new is not None:
            self._new.discard()
