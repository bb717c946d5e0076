"""Names and types of the datasets of a native recording, which reader and writers share."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FORMAT = "amiwarp-recording"
"""Value of the attribute ``format`` of native recordings."""

FORMAT_VERSION = 1
"""Newest version of the format that is read, and the version that is written."""

EVENTS = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.uint8}
"""Types of the datasets of events. Coordinates of compensated events are float32."""

FLAGS = ("inside", "extrapolated")
"""Names of the flags of compensated events, uint8."""

ENCODERS = ("encoder/", "encoder/second_")
"""Beginnings of the names of the datasets of an encoder, and of the second encoder."""

POSE_TABLES = {
    "joints": ("truth/joints/names", "truth/joints/position", 3),
    "bodies": ("truth/poses/body_names", "truth/poses/bodies", 7),
}
"""Datasets of the names and of the values of what moves, and the length of a value."""

ATTRIBUTE_BYTES = 1 << 16
"""Size of the largest attribute that is written and read [bytes]."""

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Arrays of a block of events, by the names of their datasets in the file."""
