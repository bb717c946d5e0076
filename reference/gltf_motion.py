"""Motion of glTF nodes by the formulas of appendix C of the glTF 2.0 specification, one time at a time, in float64.

It reads the tables from which :mod:`tests.gltf_files` writes files, never a file.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def interpolated(kind: str, times: Any, values: Any, t: float, *, rotation: bool) -> Array:
    """The value of a sampler at time ``t`` [s].

    ``values`` of a cubic spline: in-tangent, value and out-tangent of each key.
    """
    cubic = kind == "CUBICSPLINE"
    keys = [np.array(value[1] if cubic else value, np.float64) for value in values]
    if t <= times[0]:
        return keys[0]
    if t >= times[-1]:
        return keys[-1]
    k = max(i for i, time in enumerate(times) if time <= t)
    td = times[k + 1] - times[k]
    share = (t - times[k]) / td
    if kind == "STEP":
        return keys[k]
    if cubic:
        out_tangent = np.array(values[k][2], np.float64)
        in_tangent = np.array(values[k + 1][0], np.float64)
        found = (
            (2 * share**3 - 3 * share**2 + 1) * keys[k]
            + td * (share**3 - 2 * share**2 + share) * out_tangent
            + (-2 * share**3 + 3 * share**2) * keys[k + 1]
            + td * (share**3 - share**2) * in_tangent
        )
        return np.asarray(found / math.sqrt(float(found @ found)) if rotation else found)
    if not rotation:
        return np.asarray((1 - share) * keys[k] + share * keys[k + 1])
    d = float(keys[k] @ keys[k + 1])
    a = math.acos(min(1.0, abs(d)))
    if a < 1e-7:
        return keys[k]
    s = d / abs(d) if d else 1.0
    found = math.sin(a * (1 - share)) * keys[k] + s * math.sin(a * share) * keys[k + 1]
    return np.asarray(found / math.sin(a))


def turned(quaternion: Array, vector: Array) -> Array:
    """A vector turned by a unit quaternion (x, y, z, w), by the product of quaternions."""
    axis, w = quaternion[:3], quaternion[3]
    twice = 2.0 * np.cross(axis, vector)
    return np.asarray(vector + w * twice + np.cross(axis, twice))


def global_matrix(nodes: Any, channels: Any, index: int, t: float) -> Array:
    """The transformation (4, 4) of node ``index`` in the scene at time ``t`` [s].

    ``nodes``: dictionaries as in a file; ``channels``: (node, path, interpolation, times, values).
    """
    place = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}
    place = {
        path: np.array(nodes[index].get(path, rest), np.float64) for path, rest in place.items()
    }
    for node, path, kind, times, values in channels:
        if node == index:
            place[path] = interpolated(kind, times, values, t, rotation=path == "rotation")
    matrix = np.eye(4)
    for axis in range(3):
        unit = np.eye(3)[axis] * place["scale"][axis]
        matrix[:3, axis] = turned(place["rotation"], unit)
    matrix[:3, 3] = place["translation"]
    if "matrix" in nodes[index]:
        matrix = np.array(nodes[index]["matrix"], np.float64).reshape(4, 4).T
    for parent, node in enumerate(nodes):
        if index in node.get("children", []):
            return np.asarray(global_matrix(nodes, channels, parent, t) @ matrix)
    return matrix
