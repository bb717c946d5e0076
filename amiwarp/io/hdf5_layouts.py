"""Layouts of other data sets' HDF5 files: M3ED, MVSEC and Prophesee's. Runs in the reading process.

M3ED stores columns like amiwarp, in other groups. :mod:`amiwarp.io.hdf5_row_server` reads the others.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import h5py  # noqa: TID253 - only the reading process imports this module

from amiwarp.errors import AmiwarpError

Member = Callable[[Any, str], Any]
"""Function that returns a member of a file by its name, or None, and refuses links."""

SIDES = ("left", "right")


def find_layout(file: Any, topic: str | None, member: Member) -> tuple[str, str]:
    """Return the layout of a file, and the group of its events. ``topic`` chooses among several cameras."""
    found = {f"prophesee/{side}": "m3ed" for side in SIDES if member(file, f"prophesee/{side}/t") is not None}
    found |= {f"davis/{side}": "mvsec" for side in SIDES if member(file, f"davis/{side}/events") is not None}
    found |= {"CD": "ecf"} if member(file, "CD/events") is not None else {}
    listed = ", ".join(found)
    if isinstance(member(file, "events"), h5py.Group) and not found:
        found, listed = {"": "native"}, "none, as it holds one stream of events"
    if not found:
        names = ", ".join(list(file)[:20]) or "none"
        raise AmiwarpError(f"HDF5 without a group 'events'; expected events/x, y, t, p; its groups are {names}")
    if topic is not None and topic not in found:
        raise AmiwarpError(f"has no events in '{topic}'; the choices for --topic are {listed}")
    if topic is None and len(found) > 1:
        remedy = "choose one with amiwarp convert --topic, in Python with topic="
        raise AmiwarpError(f"holds the events of several cameras: {listed}; {remedy}")
    chosen = next(iter(found)) if topic is None else topic
    return found[chosen], chosen


M3ED_COLUMNS = {**{f"events/{name}": name for name in "xytp"}, "ms_to_idx": "ms_map_idx"}
"""Names of M3ED's datasets by those of the native layout."""


def m3ed_attributes(file: Any, group: str, member: Member) -> dict[str, dict[str, Any]]:
    """Return the camera of an M3ED file as attributes of the native layout."""
    values = {}
    for name, count in (("resolution", 2), ("intrinsics", 4), ("distortion_coeffs", 4)):
        dataset = member(file, f"{group}/calib/{name}")
        if dataset is None or dataset.shape != (count,) or dataset.dtype.kind not in "iuf":
            return {}
        values[name] = dataset[()].tolist()
    size = dict(zip(("width", "height"), map(int, values["resolution"]), strict=True))
    pinhole = dict(zip(("fx", "fy", "cx", "cy"), map(float, values["intrinsics"]), strict=True))
    lens = {"distortion_model": "radial_tangential", "distortion": [*map(float, values["distortion_coeffs"]), 0.0]}
    return {"/": size, "camera": {**size, **pinhole, **lens}}
