"""Files of cameras: JSON of this package, YAML of ROS, OpenCV and Kalibr, and ``calib.txt``.

The layout of ROS is described in `camera_calibration_parsers <https://wiki.ros.org/camera_calibration_parsers>`_, with
the distortion models of ``sensor_msgs/CameraInfo``; Kalibr's is its `camchain
<https://github.com/ethz-asl/kalibr/wiki/yaml-formats>`_.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name, open_input
from amiwarp.io.json_files import read_json
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import write_text
from amiwarp.optics.camera import Camera, camera_from_json, camera_to_json
from amiwarp.optics.distortion import Fisheye, RadialTangential
from amiwarp.schema.calls import guarded
from amiwarp.schema.records import LARGEST_INTEGER
from amiwarp.validation import one_of, real, shown, vector, whole

ROS_MODELS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4, "fisheye": 4}
"""Distortion models of ROS that this package has, with their numbers of coefficients."""
KALIBR_MODELS = {"radtan": 4, "equidistant": 4, "none": 0}
"""Distortion models of Kalibr's pinhole camera that this package has, with their numbers of coefficients."""
FISHEYES = ("equidistant", "fisheye")
"""Names of OpenCV's fisheye model in these files."""
OPENCV_YAML = (
    (b"%YAML:1.0", b"%YAML 1.1"),
    (b"!!opencv-matrix", b""),
    (b"!!opencv-nd-matrix", b""),
)
"""What OpenCV writes, and what is read instead: in old releases a first line that is no YAML, and tags."""
MOST_YAML_BYTES = 1 << 16
"""Largest YAML file that is read [bytes], because PyYAML parses only 100 kB in a second. A camera takes 1 kB."""


@guarded
def load_camera(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> Camera:
    """Read a camera from a file.

    Parameters
    ----------
    path : str or Path
        A file ``.json`` (a camera or a calibration), ``.yaml`` or ``.yml`` (ROS's camera info, what OpenCV's
        calibration programs write, or Kalibr's camchain with one camera), or with any other extension a
        ``calib.txt`` (fx fy cx cy k1 k2 p1 p2 k3).
    size : tuple of int, optional
        Width and height of the image [px], which ``calib.txt`` does not hold.

    Returns
    -------
    Camera
        The camera.

    Raises
    ------
    AmiwarpError
        If the file cannot be read, or holds a lens of another model. The message names the file and the field.

    Examples
    --------
    >>> amiwarp.save_camera("kalibr.yaml", amiwarp.Camera.from_fov(640, 480, 1.0), layout="kalibr")
    >>> amiwarp.load_camera("kalibr.yaml").width
    640
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending == ".json":
        data = read_json(path, "a camera")
        with errors_name(path, lambda: "is not a camera file"):
            # A calibration holds its camera.
            if "camera" in data:
                return camera_from_json(data["camera"], "camera")
            return camera_from_json(data)
    if ending in (".yaml", ".yml"):
        with errors_name(path, lambda: "is not a camera file"):
            return _camera_from_yaml(_read_yaml(path))
    if size is None:
        raise AmiwarpError(
            f"{path}: holds no size of the image; give size=(width, height)",
            ErrorCode.CONTENT_MISSING,
        )
    return read_calib(path, *size)


@guarded
def save_camera(
    path: str | os.PathLike[str], camera: Camera, *, layout: str = "ros", overwrite: bool = False
) -> None:
    """Write a camera to a file.

    Parameters
    ----------
    path : str or Path
        The file, which ends in ``.json``, ``.yaml`` or ``.yml``.
    camera : Camera
        The camera.
    layout : str, default "ros"
        Layout of a YAML file: "ros" (camera info) or "kalibr" (camchain).
    overwrite : bool, default False
        Whether to replace an existing file.

    Raises
    ------
    AmiwarpError
        If the layout cannot hold the lens, the file has another extension, exists and ``overwrite`` is False, or cannot
        be written.

    Examples
    --------
    >>> amiwarp.save_camera("ros.yaml", amiwarp.Camera.from_fov(640, 480, 1.0))
    """
    path = Path(path)
    one_of(layout, ("ros", "kalibr"), "layout")
    if check_ending(path, "cameras are written", [".json", ".yaml", ".yml"]) == ".json":
        text = json.dumps(camera_to_json(camera), indent=1, allow_nan=False) + "\n"
    else:
        import yaml

        data = _to_ros(camera, path.stem) if layout == "ros" else {"cam0": kalibr_camera(camera)}
        text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120)
    write_text(path, text, overwrite=overwrite)


def _read_yaml(path: Path) -> Any:
    import yaml

    with open_input(path) as file:
        text = file.read(MOST_YAML_BYTES + 1)
    if len(text) > MOST_YAML_BYTES:
        raise AmiwarpError(
            f"{path}: is larger than {MOST_YAML_BYTES >> 10} KiB, so it is no camera; give another file",
            ErrorCode.FORMAT_UNKNOWN,
        )
    for written, read in OPENCV_YAML:
        text = text.replace(written, read)
    try:
        return yaml.safe_load(text)
    except RecursionError as error:
        raise AmiwarpError(
            f"{path}: is nested too deeply, so it is no camera; give another file",
            ErrorCode.FORMAT_UNKNOWN,
        ) from error
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f" in line {error.problem_mark.line + 1}"
        raise AmiwarpError(
            f"{path}: is not YAML: {error.problem}{line}; correct it", ErrorCode.FORMAT_UNKNOWN
        ) from error


def _camera_from_yaml(data: Any) -> Camera:
    """Return the camera of the content of a YAML file, in the layout of ROS, OpenCV or Kalibr."""
    if isinstance(data, dict) and "camera_matrix" in data:
        return _from_ros(data)
    cameras: dict[Any, dict[str, Any]] = {}
    if isinstance(data, dict):
        for name, given in data.items():
            if isinstance(given, dict) and "camera_model" in given:
                cameras[name] = given
    if len(cameras) > 1:
        raise AmiwarpError(
            f"holds {len(cameras)} cameras ({', '.join(map(str, cameras))}); leave one of them in the file",
            ErrorCode.AMBIGUOUS,
        )
    if not cameras:
        raise AmiwarpError(
            "holds neither camera_matrix (ROS, OpenCV) nor cam0.camera_model (Kalibr); give a file of one of them",
            ErrorCode.FORMAT_UNKNOWN,
        )
    [(name, given)] = cameras.items()
    return _from_kalibr(given, str(name))


def _from_ros(data: dict[str, Any]) -> Camera:
    width = whole(_field(data, "image_width"), "field image_width", 1, LARGEST_INTEGER)
    height = whole(_field(data, "image_height"), "field image_height", 1, LARGEST_INTEGER)
    matrix = np.reshape(_numbers(data, "camera_matrix", (9,)), (3, 3))
    model = data.get("distortion_model", _unnamed_model(data))
    one_of(model, ROS_MODELS, "field distortion_model")
    counts = (4, 5) if model == "plumb_bob" else (ROS_MODELS[model],)
    coefficients = _numbers(data, "distortion_coefficients", counts)
    return Camera.from_opencv(matrix, coefficients, (width, height), fisheye=model in FISHEYES)


def _unnamed_model(data: dict[str, Any]) -> str:
    """Return the lens model of a file without its name: one of OpenCV, or an old one of ROS.

    Raises :class:`AmiwarpError` for four coefficients, which two models have.
    """
    if data.get("fisheye_model"):
        return "fisheye"
    given = data.get("distortion_coefficients")
    values = given.get("data") if isinstance(given, dict) else given
    count = len(values) if isinstance(values, list) else 0
    if count == 4 and "distortion_model" not in data and "fisheye_model" not in data:
        raise AmiwarpError(
            "field distortion_model is missing, and 4 coefficients are k1, k2, p1, p2 or a fisheye's k1 to k4; add "
            "distortion_model: plumb_bob, or distortion_model: equidistant",
            ErrorCode.AMBIGUOUS,
        )
    return "rational_polynomial" if count == 8 else "plumb_bob"


def _from_kalibr(data: dict[str, Any], name: str) -> Camera:
    one_of(data["camera_model"], ("pinhole",), f"field {name}.camera_model")
    model = one_of(
        data.get("distortion_model", "none"), KALIBR_MODELS, f"field {name}.distortion_model"
    )
    fx, fy, cx, cy = _numbers(data, "intrinsics", (4,), name)

    def side(value: Any, what: str) -> int:
        return whole(value, what, 1, LARGEST_INTEGER)

    resolution = _field(data, "resolution", f"{name}.")
    width, height = vector(resolution, 2, f"field {name}.resolution", side)
    coefficients = None
    if KALIBR_MODELS[model]:
        coefficients = _numbers(data, "distortion_coeffs", (KALIBR_MODELS[model],), name)
    matrix = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    return Camera.from_opencv(matrix, coefficients, (width, height), fisheye=model in FISHEYES)


def _field(data: dict[str, Any], name: str, prefix: str = "") -> Any:
    if data.get(name) is None:
        raise AmiwarpError(f"field {prefix}{name} is missing; add this field", ErrorCode.FIELD)
    return data[name]


def _numbers(
    data: dict[str, Any], name: str, counts: tuple[int, ...], where: str = ""
) -> list[float]:
    """Return the numbers of a list, or of a matrix with ``data``, whose count is one of ``counts``."""
    prefix = f"{where}." if where else ""
    given = _field(data, name, prefix)
    full = f"{prefix}{name}"
    if isinstance(given, dict):
        given = _field(given, "data", f"{full}.")
        full = f"{full}.data"
    if not isinstance(given, list) or len(given) not in counts:
        expected = " or ".join(map(str, counts))
        raise AmiwarpError(
            f"field {full} is {shown(given)}; expected a list of {expected} numbers",
            ErrorCode.FIELD,
        )
    return [_number(value, f"field {full}") for value in given]


def _number(value: Any, what: str) -> float:
    """Return a number. PyYAML takes numbers without a point, such as 1e-05 of ROS, for text."""
    try:
        return real(float(value) if isinstance(value, str) else value, what)
    except ValueError:
        return real(value, what)


def _matrix(values: Sequence[float], columns: int) -> dict[str, Any]:
    return {"rows": len(values) // columns, "cols": columns, "data": list(values)}


def _to_ros(camera: Camera, name: str) -> dict[str, Any]:
    matrix, coefficients = camera.to_opencv()
    models = {4: "equidistant", 5: "plumb_bob", 8: "rational_polynomial"}
    projection = np.c_[matrix, np.zeros(3)]
    return {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _matrix(matrix.ravel().tolist(), 3),
        "distortion_model": models[len(coefficients)],
        "distortion_coefficients": _matrix(coefficients.tolist(), len(coefficients)),
        "rectification_matrix": _matrix(np.eye(3).ravel().tolist(), 3),
        "projection_matrix": _matrix(projection.ravel().tolist(), 4),
    }


def kalibr_camera(camera: Camera) -> dict[str, Any]:
    """Return a camera as the fields of Kalibr. Raises :class:`AmiwarpError` for a lens that it does not have."""
    lens = camera.distortion
    model = "none"
    coefficients: list[float] = []
    if lens is not None:
        model = "equidistant" if isinstance(lens, Fisheye) else "radtan"
        _, opencv_coefficients = camera.to_opencv()
        coefficients = opencv_coefficients.tolist()
    if isinstance(lens, RadialTangential) and any(coefficients[4:]):
        raise AmiwarpError(
            f"Kalibr's radtan has no coefficients after p2, the lens has {lens}; write ROS's layout"
        )
    return {
        "camera_model": "pinhole",
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion_model": model,
        "distortion_coeffs": coefficients[:4],
        "resolution": [camera.width, camera.height],
    }


def read_calib(path: Path, width: int, height: int) -> Camera:
    """Return the camera of a ``calib.txt``. Raises :class:`AmiwarpError` unless it holds nine finite numbers."""
    wanted = "expected a camera as text (fx fy cx cy k1 k2 p1 p2 k3), or as .json or .yaml"
    with errors_name(path, lambda: wanted):
        with open_input(path) as file:
            words = file.read(10_000).decode("utf-8").split()
        numbers = [float(word) for word in words]
        if len(numbers) != 9 or not np.isfinite(numbers).all():
            raise AmiwarpError(
                f"{path}: has {len(numbers)} numbers; expected finite fx fy cx cy k1 k2 p1 p2 k3",
                ErrorCode.FILE_DAMAGED,
            )
        fx, fy, cx, cy = numbers[:4]
        return Camera(width, height, fx, fy, cx, cy, RadialTangential(*numbers[4:]))
