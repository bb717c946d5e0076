"""Reader of the IMU samples in AEDAT 2.0 files of the DAVIS cameras.

A sample consists of seven records with the numbers 0 to 6: acceleration x, y, z, temperature, angular velocity x, y, z.
The values are 16-bit numbers of the IMU (InvenSense MPU-6100). Its ranges stand among the settings in the header.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.sensors import ImuSamples
from amiwarp.io.input_files import open_input
from amiwarp.io.sensor_streams import GRAVITY, imu_of

STEPS_PER_G = {2: 16384.0, 4: 8192.0, 8: 4096.0, 16: 2048.0}
"""Steps of the accelerometer per g, by its range [g]; from the data sheet of the MPU-6100."""

STEPS_PER_DEG_S = {250: 131.0, 500: 65.5, 1000: 32.8, 2000: 16.4}
"""Steps of the gyroscope per degree per second, by its range [deg/s]; from the same data sheet."""

RANGES = 8, 1000
"""Ranges [g] and [deg/s] that jAER sets by default, for files whose header does not state them."""

RECORDS_OF_SAMPLE = 7
"""Number of records of a sample."""

Records = Iterator[tuple[NDArray[Any], NDArray[np.int64]]]
"""Blocks of addresses and times [us]."""


def read_ranges(path: Path, offset: int) -> tuple[int, int] | None:
    """Return the ranges of accelerometer [g] and gyroscope [deg/s] in the header's settings, or None if not there."""
    with open_input(path) as file:
        header = file.read(offset)
    camera = re.search(rb"#\s*AEChip:\s*(\S+)", header)
    short = camera[1].rpartition(b".")[2] if camera else b""
    found = []
    for name, old, value, known in (
        (b"IMU.AccelScale", b"ImuAccelScale", rb"ImuAccelScaleG(\d{1,4})", STEPS_PER_G),
        (b"IMU.GyroScale", b"ImuGyroScale", rb"GyroFullScaleDegPerSec(\d{1,4})", STEPS_PER_DEG_S),
    ):
        # Settings of other cameras may be there too. Those of this camera begin with its name in new versions of jAER.
        keys = (re.escape(short + b"." + name), old)
        texts = (re.search(b'key="' + key + b'" value="' + value + b'"', header) for key in keys)
        stated = next((int(text[1]) for text in texts if text), 0)
        if stated not in known:
            return None
        found.append(stated)
    return found[0], found[1]


def read_imu(path: Path, records: Records, ranges: tuple[int, int]) -> ImuSamples:
    """Return all complete samples."""
    return imu_of(path, _columns(records, STEPS_PER_G[ranges[0]], STEPS_PER_DEG_S[ranges[1]]))


def _columns(records: Records, steps_per_g: float, steps_per_deg_s: float) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield time [us], angular velocity [rad/s] and acceleration [m/s^2] of the complete samples."""
    words, t = np.zeros(0, np.int64), np.zeros(0, np.int64)
    for block, times in records:
        at = (block >> 31 == 1) & (block >> 10 & 3 == 3)
        words, t = np.concatenate([words, block[at]]), np.concatenate([t, times[at]])
        starts = _starts(words >> 28 & 7)
        values = (words[starts[:, None] + np.arange(RECORDS_OF_SAMPLE)] >> 12 & 0xFFFF).astype(np.uint16).view(np.int16)
        turning = np.radians(values[:, 4:] / steps_per_deg_s)
        pulling = values[:, :3] / steps_per_g * GRAVITY
        yield t[starts], *turning.T, *pulling.T
        # The records of the last sample may continue in the next block.
        rest = max(0, len(words) - RECORDS_OF_SAMPLE + 1, int(starts[-1]) + RECORDS_OF_SAMPLE if len(starts) else 0)
        words, t = words[rest:], t[rest:]


def _starts(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices at which the numbers 0 to 6 follow each other."""
    if len(numbers) < RECORDS_OF_SAMPLE:
        return np.zeros(0, np.int64)
    windows = np.lib.stride_tricks.sliding_window_view(numbers, RECORDS_OF_SAMPLE)
    return np.flatnonzero((windows == np.arange(RECORDS_OF_SAMPLE)).all(axis=1))
