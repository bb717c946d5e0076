"""Reader of native recordings. DSEC and M3ED store events alike, and are read here.

The format is described in ``docs/reference/recording-format.md``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.other_sensors import DEPTH_DTYPE, ImuSamples, check_exposure
from amiwarp.events.recording import MetadataValue, Recording
from amiwarp.io.assumptions import ASSUMED_SIZE, assumed_size
from amiwarp.io.columns import served as served_columns
from amiwarp.io.columns.layout import SAMPLE, is_plain_polarity
from amiwarp.io.columns.options import GivenLayout
from amiwarp.io.columns.units import are_microseconds
from amiwarp.io.hdf5.chunks import CHUNK
from amiwarp.io.hdf5.file import Column, Hdf5File
from amiwarp.io.hdf5.rows import open_rows
from amiwarp.io.inputs import errors_name
from amiwarp.io.native.attributes import attribute, read_camera, read_prism
from amiwarp.io.native.events import NativeEvents
from amiwarp.io.native.layout import ENCODERS, FORMAT, FORMAT_VERSION
from amiwarp.io.native.stored import StoredImages, dataset_of
from amiwarp.io.native.truth import read_truth
from amiwarp.io.opening import given_size
from amiwarp.validation import array as as_numbers
from amiwarp.validation import rounded_times


def open_hdf5(path: Path, topic: str | None, given: GivenLayout) -> Recording:
    """Open a native recording, or a file of another layout. ``topic`` chooses among several cameras.

    Raises :class:`AmiwarpError` for other files.
    """
    with errors_name(path, lambda: "opening HDF5"):
        file = Hdf5File(path, topic)
        try:
            is_native = file.attributes.get("/", {}).get("format") == FORMAT
            if is_native and given != GivenLayout():
                raise AmiwarpError(
                    f"{path}: is amiwarp's own format, whose layout is fixed; leave out {given.options}",
                    ErrorCode.OPTIONS,
                )
            if file.layout == "columns" or given != GivenLayout() or _has_other_values(file):
                file.close()
                return served_columns.open_hdf5_columns(path, given)
            if file.layout in ("mvsec", "ecf"):
                file.close()
                return open_rows(path, file.layout, file.group)
            recording = _read_recording(path, file)
            file.opened()
            return recording
        except BaseException:
            file.close()
            raise


def _has_other_values(file: Hdf5File) -> bool:
    """Return whether a file of another program has other polarities or another unit of time than the native layout.

    The first polarities are then not 1 for ON, 0 or -1 for OFF, or the first times can be no microseconds.
    """
    if file.attributes.get("/", {}).get("format") == FORMAT or file.unfinished:
        return False
    p = file.columns.get("events/p")
    if p is not None and not is_plain_polarity(p.read(0, min(len(p), CHUNK))):
        return True
    # With an index of the milliseconds, as in DSEC's files, the unit of time is known.
    t = file.columns.get("events/t")
    if t is None or "ms_to_idx" in file.columns or file.layout != "native":
        return False
    return not are_microseconds(t.read(0, min(len(t), SAMPLE)))


def _read_recording(path: Path, file: Hdf5File) -> Recording:
    root = file.attributes.get("/", {})
    version = attribute(root, f"{path}: /", "format_version", int, FORMAT_VERSION)
    if version > FORMAT_VERSION:
        raise AmiwarpError(
            f"{path}: format_version {version} is newer than {FORMAT_VERSION}; update amiwarp",
            ErrorCode.FORMAT_UNKNOWN,
        )
    events = NativeEvents(path, file)
    metadata = _read_metadata(path, file, events)
    events.size_is_known = ASSUMED_SIZE not in metadata

    camera = encoder = prism = truth = None
    if "camera" in file.attributes:
        camera = read_camera(file.attributes["camera"], f"{path}: /camera")
        if (camera.width, camera.height) != events.size:
            raise AmiwarpError(
                f"{path}: camera is {camera.width}x{camera.height}, events are {events.size}; both must have the same "
                "size",
                ErrorCode.FILE_DAMAGED,
            )
    if "encoder" in file.attributes:
        encoder = _read_encoder(path, file)
    if "prism" in file.attributes:
        prism = read_prism(file.attributes["prism"], f"{path}: /prism")
    if "truth" in file.attributes:
        truth = read_truth(path, file, len(events), events.size)

    frames, depth = _read_frames(path, file)
    return Recording(
        events=events,
        camera=camera,
        encoder=encoder,
        prism=prism,
        truth=truth,
        metadata=metadata,
        name=path.stem,
        imu=_read_imu(path, file),
        frames=frames,
        depth=depth,
    )


def _read_metadata(path: Path, file: Hdf5File, events: NativeEvents) -> dict[str, MetadataValue]:
    """Return the stored metadata, with the format and with the sensor size if that is assumed."""
    metadata: dict[str, MetadataValue] = {}
    for name, value in file.attributes.get("metadata", {}).items():
        metadata[name] = value if isinstance(value, (str, int, float, bool)) else str(value)

    root = file.attributes.get("/", {})
    is_native = attribute(root, f"{path}: /", "format", str, "") == FORMAT
    metadata["format"] = "native" if is_native else "dsec"
    if file.layout == "m3ed":
        metadata["format"] = "m3ed"
        metadata["topic"] = file.group

    # A stored assumption comes from the file that the recording was converted from. A given size replaces it.
    if given_size() is not None:
        metadata.pop(ASSUMED_SIZE, None)
    elif not events.size_is_stored:
        metadata |= [assumed_size(events.size).entry]
    return metadata


def _read_encoder(path: Path, file: Hdf5File) -> Encoder | None:
    samples = _read_samples(file, ENCODERS[0])
    if samples is None:
        return None
    t, angle = samples

    index_t = _read_pulses(file, ENCODERS[0], t)

    second = None
    if "encoder/second_t" in file.columns:
        samples_of_second = _read_samples(file, ENCODERS[1])
        if samples_of_second is not None:
            second_t, second_angle = samples_of_second
            second_index_t = _read_pulses(file, ENCODERS[1], second_t)
            second = Encoder(second_t, second_angle, index_t=second_index_t)

    offset_us = attribute(
        file.attributes["encoder"], f"{path}: /encoder", "clock_offset_us", float, 0.0
    )
    return Encoder(t, angle, offset_us, index_t, second)


def _read_samples(
    file: Hdf5File, name: str
) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
    """Return times [us] and angles [rad] of an encoder whose datasets begin with ``name``; None without samples."""
    times = dataset_of(file, name + "t")
    angles = dataset_of(file, name + "angle")
    t = rounded_times(times.read(0, len(times)))
    angle = angles.read(0, len(angles)).astype(np.float64)
    if file.unfinished:
        # Times are written before angles, and may be more.
        count = min(t.size, angle.size)
        t = t[:count]
        angle = angle[:count]
    # A live recording has datasets for an encoder before it is known whether an encoder is connected.
    if t.size < 2 and (file.unfinished or t.size == angle.size == 0):
        return None
    return t, angle


def _read_pulses(file: Hdf5File, name: str, t: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Return times of the index pulses [us] of the encoder with samples at ``t`` [us]; None without pulses."""
    if f"{name}index_t" not in file.columns:
        return None
    pulses = file.columns[f"{name}index_t"]
    index_t = rounded_times(pulses.read(0, len(pulses)))
    if file.unfinished:
        # The last samples may not be written yet.
        index_t = index_t[(index_t >= t[0]) & (index_t <= t[-1])]
    # A live recording has the dataset before it is known whether there are pulses.
    return index_t if index_t.size else None


def _read_imu(path: Path, file: Hdf5File) -> ImuSamples | None:
    """Return the IMU samples of a file, or None if it has none."""
    if "imu/t" not in file.columns:
        return None
    with errors_name(path, lambda: "imu"):
        times = file.columns["imu/t"]
        count = len(times)
        angular_velocity = dataset_of(file, "imu/angular_velocity", count, (3,))
        acceleration = dataset_of(file, "imu/acceleration", count, (3,))
        return ImuSamples(
            rounded_times(times.read(0, count)),
            angular_velocity.read(0, count).astype(np.float64, copy=False),
            acceleration.read(0, count).astype(np.float64, copy=False),
            _rotation_of_imu(file),
        )


def _rotation_of_imu(file: Hdf5File) -> NDArray[np.float64] | None:
    """Return the rotation from the IMU to the camera, shape (3, 3), or None if the file has none."""
    rotation = file.attributes.get("imu", {}).get("to_camera")
    if rotation is None:
        return None
    rotation = as_numbers(rotation, "attribute 'to_camera'").astype(np.float64)
    if rotation.shape != (9,):
        raise AmiwarpError(
            f"attribute 'to_camera' has shape {rotation.shape}; expected 9 numbers, row by row",
            ErrorCode.FILE_DAMAGED,
        )
    return np.asarray(rotation.reshape(3, 3))


def _read_frames(path: Path, file: Hdf5File) -> tuple[StoredImages | None, StoredImages | None]:
    """Return the frames and the depth maps of a file, each None if it has none."""
    if "frames/t" not in file.columns:
        return None, None
    with errors_name(path, lambda: "frames"):
        times = file.columns["frames/t"]
        count = len(times)
        t = rounded_times(times.read(0, count))
        if (t[1:] < t[:-1]).any():
            raise AmiwarpError("frames/t decreases; the file is damaged", ErrorCode.FILE_DAMAGED)
        exposure = None
        if "frames/exposure" in file.columns:
            pairs = dataset_of(file, "frames/exposure", count, (2,))
            exposure = pairs.read(0, count).astype(np.int64)
            check_exposure(exposure, t)
        frames = depth = None
        if "frames/depth" not in file.columns or "frames/image" in file.columns:
            image = dataset_of(file, "frames/image", count)
            has_shape = len(image.row) == 2 or image.row[2:] == (3,)
            if image.dtype not in (np.uint8, np.uint16) or not has_shape or not all(image.row):
                raise AmiwarpError(
                    f"frames are {image.dtype} of shape {image.row}; expected uint8 or uint16, grey or RGB",
                    ErrorCode.FILE_DAMAGED,
                )
            frames = _images_of(path, file, image, t, exposure)
        if "frames/depth" in file.columns:
            maps = dataset_of(file, "frames/depth", count)
            if maps.dtype != DEPTH_DTYPE or not all(maps.row):
                raise AmiwarpError(
                    f"frames/depth is {maps.dtype} of shape {maps.row}; expected float32",
                    ErrorCode.FILE_DAMAGED,
                )
            depth = _images_of(path, file, maps, t, exposure)
        return frames, depth


def _images_of(
    path: Path,
    file: Hdf5File,
    stored: Column,
    t: NDArray[np.int64],
    exposure: NDArray[np.int64] | None,
) -> StoredImages:
    """Return the images of a dataset, which are read on demand."""
    height, width = stored.row[:2]

    def read(index: int) -> Any:
        return stored.read(index, index + 1)[0]

    return StoredImages(path, stored.name, t, (width, height), read, file, exposure)
