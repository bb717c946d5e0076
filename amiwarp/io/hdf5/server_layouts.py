"""Layout of an HDF5 file, which its groups and datasets tell. Runs in the reading process.

M3ED stores columns like amiwarp, in other groups. :mod:`amiwarp.io.hdf5.server_rows` reads MVSEC's and Prophesee's.
"""

from typing import Any

import h5py  # noqa: TID253 - only the reading process imports this module

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.columns.names import ROLES, names_roles
from amiwarp.io.hdf5.server_objects import Finder, all_values

SIDES = ("left", "right")
"""Cameras of M3ED and MVSEC."""


def find_layout(topic: str | None, objects: Finder) -> tuple[str, str]:
    """Return the layout of a file, and the group of its events. ``topic`` chooses among several cameras."""
    layouts = _layouts_by_group(objects)
    listed = ", ".join(layouts)
    if not layouts:
        layouts = {"": _own_or_columns(objects)}
        listed = "none, as it holds one stream of events"
    if topic is None:
        if len(layouts) > 1:
            remedy = "choose one with amiwarp convert --topic, in Python with topic="
            raise AmiwarpError(
                f"holds the events of several cameras: {listed}; {remedy}", ErrorCode.AMBIGUOUS
            )
        topic = next(iter(layouts))
    elif topic not in layouts:
        raise AmiwarpError(
            f"has no events in '{topic}'; the choices for --topic are {listed}",
            ErrorCode.CONTENT_MISSING,
        )
    return layouts[topic], topic


def _layouts_by_group(objects: Finder) -> dict[str, str]:
    """Return the groups of other programs' files that hold events, with their layouts."""
    layouts = {}
    for side in SIDES:
        if objects.find(f"prophesee/{side}/t") is not None:
            layouts[f"prophesee/{side}"] = "m3ed"
    for side in SIDES:
        if objects.find(f"davis/{side}/events") is not None:
            layouts[f"davis/{side}"] = "mvsec"
    if objects.find("CD/events") is not None:
        layouts["CD"] = "ecf"
    return layouts


def _own_or_columns(objects: Finder) -> str:
    """Return "native" for the layout of amiwarp and DSEC, or "columns" for any other."""
    events = objects.find("events")
    if not isinstance(events, h5py.h5g.GroupID):
        return "columns"
    names = list(h5py.Group(events))
    role_names = set(ROLES) & set(names)
    if not role_names:
        return "columns"
    if h5py.h5a.exists(objects.find(""), b"format"):
        return "native"
    # Others give the same names to times in seconds, or have only some of the names by chance.
    times = objects.find("events/t")
    has_seconds = isinstance(times, h5py.h5d.DatasetID) and times.dtype.kind == "f"
    has_other_names = len(role_names) < len(ROLES) and names_roles(names)
    return "columns" if has_seconds or has_other_names else "native"


M3ED_COLUMNS = {**{f"events/{name}": name for name in "xytp"}, "ms_to_idx": "ms_map_idx"}
"""Names of M3ED's datasets, by the names in the native layout."""


def m3ed_attributes(group: str, objects: Finder) -> dict[str, dict[str, Any]]:
    """Return the camera of an M3ED file as attributes of the native layout; nothing if it is not stored."""
    values = {}
    for name, count in (("resolution", 2), ("intrinsics", 4), ("distortion_coeffs", 4)):
        dataset = objects.find(f"{group}/calib/{name}")
        if (
            not isinstance(dataset, h5py.h5d.DatasetID)
            or dataset.shape != (count,)
            or dataset.dtype.kind not in "iuf"
        ):
            return {}
        values[name] = all_values(dataset).tolist()
    width, height = map(int, values["resolution"])
    fx, fy, cx, cy = map(float, values["intrinsics"])
    camera = {
        "width": width,
        "height": height,
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "distortion_model": "radial_tangential",
        # M3ED's model has no k3.
        "distortion": [*map(float, values["distortion_coeffs"]), 0.0],
    }
    return {"/": {"width": width, "height": height}, "camera": camera}
