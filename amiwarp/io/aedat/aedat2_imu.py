"""Samples of the inertial unit (IMU) of DAVIS cameras in AEDAT 2.0 files.

A sample consists of seven records with the numbers 0 to 6: acceleration x, y, z, temperature, angular velocity x, y, z.
The values are 16-bit numbers of the IMU (InvenSense MPU-6100). Its ranges stand among the settings in the header.
"""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.other_sensors import ImuSamples
from amiwarp.io.file_sensors import GRAVITY, imu_of
from amiwarp.io.inputs import open_input

STEPS_PER_G = {2: 16384.0, 4: 8192.0, 8: 4096.0, 16: 2048.0}
"""Steps of the accelerometer per g, by its range [g]; from the data sheet of the MPU-6100."""

STEPS_PER_DEG_S = {250: 131.0, 500: 65.5, 1000: 32.8, 2000: 16.4}
"""Steps of the gyroscope per degree per second, by its range [deg/s]; from the same data sheet."""

RANGES = (8, 1000)
"""Ranges [g] and [deg/s] that jAER sets by default, for files whose header does not state them."""

SETTINGS = (
    (b"IMU.AccelScale", b"ImuAccelScale", rb"ImuAccelScaleG(\d{1,4})", STEPS_PER_G),
    (b"IMU.GyroScale", b"ImuGyroScale", rb"GyroFullScaleDegPerSec(\d{1,4})", STEPS_PER_DEG_S),
)
"""Settings of the two ranges: their names in new and in old versions of jAER, the pattern of their values, and the
ranges that there are."""

RECORDS_OF_SAMPLE = 7
"""Number of records of a sample."""

Records = Iterable[tuple[NDArray[np.int64], NDArray[np.int64]]]
"""Addresses and times [us] of records of samples, in pieces."""


def read_ranges(path: Path, offset: int) -> tuple[int, int] | None:
    """Return the ranges of accelerometer [g] and gyroscope [deg/s] in the header's settings, or None if not there."""
    with open_input(path) as file:
        header = file.read(offset)
    camera = b""
    chip = re.search(rb"#\s*AEChip:\s*(\S+)", header)
    if chip is not None:
        _, _, camera = chip[1].rpartition(b".")
    ranges = []
    for name, old_name, value, known in SETTINGS:
        # Settings of other cameras may be there too. In new versions of jAER, the settings of this camera begin with
        # its name.
        of_camera = re.escape(camera + b"." + name)
        stated = 0
        for key in (of_camera, old_name):
            text = re.search(b'key="' + key + b'" value="' + value + b'"', header)
            if text is not None:
                stated = int(text[1])
                break
        if stated not in known:
            return None
        ranges.append(stated)
    range_g, range_deg_s = ranges
    return range_g, range_deg_s


class SampleCount:
    """Count of the complete samples among records that come in pieces."""

    def __init__(self) -> None:
        """Start without records."""
        self._rest = np.zeros(0, np.int64)
        """Records of a sample that may continue."""

    def add(self, words: NDArray[np.int64]) -> int:
        """Return the number of samples that are complete with the next records."""
        joined = np.concatenate([self._rest, words])
        starts, rest = _complete_samples(joined)
        self._rest = joined[rest:]
        return len(starts)


def read_samples(path: Path, records: Records, ranges: tuple[int, int]) -> ImuSamples:
    """Return all complete samples."""
    range_g, range_deg_s = ranges
    columns = _sample_columns(
        records,
        steps_per_g=STEPS_PER_G[range_g],
        steps_per_deg_s=STEPS_PER_DEG_S[range_deg_s],
    )
    return imu_of(path, columns)


def _sample_columns(
    records: Records,
    steps_per_g: float,
    steps_per_deg_s: float,
) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of the complete samples."""
    words = np.zeros(0, np.int64)
    t = np.zeros(0, np.int64)
    for more_words, more_t in records:
        words = np.concatenate([words, more_words])
        t = np.concatenate([t, more_t])
        starts, rest = _complete_samples(words)
        samples = words[starts[:, None] + np.arange(RECORDS_OF_SAMPLE)]
        values = (samples >> 12 & 0xFFFF).astype(np.uint16).view(np.int16)
        deg_per_s = values[:, 4:] / steps_per_deg_s
        acceleration = values[:, :3] / steps_per_g * GRAVITY
        yield t[starts], *np.radians(deg_per_s).T, *acceleration.T
        words = words[rest:]
        t = t[rest:]


def _complete_samples(words: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Return the indices at which complete samples begin among records of the IMU, and the index after them.

    The records of the last sample may continue in the next piece, so the records after this index are needed again.
    """
    starts = _starts(words >> 28 & 7)
    may_continue = max(0, len(words) - RECORDS_OF_SAMPLE + 1)
    if not len(starts):
        return starts, may_continue
    end = int(starts[-1]) + RECORDS_OF_SAMPLE
    return starts, max(may_continue, end)


def _starts(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices at which the numbers 0 to 6 follow each other."""
    if len(numbers) < RECORDS_OF_SAMPLE:
        return np.zeros(0, np.int64)
    windows = np.lib.stride_tricks.sliding_window_view(numbers, RECORDS_OF_SAMPLE)
    is_sample = (windows == np.arange(RECORDS_OF_SAMPLE)).all(axis=1)
    return np.flatnonzero(is_sample)
