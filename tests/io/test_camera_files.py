"""Cameras in YAML files of ROS and Kalibr: round trips, files of other programs, and messages for what is refused."""

from pathlib import Path

import pytest
import yaml

from amiwarp import (
    AmiwarpError,
    Camera,
    Distortion,
    ErrorCode,
    Fisheye,
    RadialTangential,
    load_camera,
    save_camera,
)
from tests.errors import refused

ROS = """
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [438.783367, 0.000000, 305.593336, 0.000000, 437.302876, 243.738352, 0.000000, 0.000000, 1.000000]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.361976, 0.110510, 1e-03, 5.05e-4, 0]
"""
"""Layout of camera_calibration_parsers. 1e-03 is a number of YAML 1.2, and text of YAML 1.1."""
KALIBR = """
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]
  distortion_model: radtan
  intrinsics: [461.629, 460.152, 362.680, 246.049]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
"""
"""Example of Kalibr's documentation."""


OPENCV = """%YAML:1.0
---
calibration_time: "Tue 01 Dec 2026 11:00:00 AM UTC"
image_width: 640
image_height: 480
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 4.3878e+02, 0., 3.0559e+02, 0., 4.3730e+02, 2.4373e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -3.6e-01, 1.1e-01, 1.0e-03, 5.0e-04, -2.0e-02 ]
"""
"""Layout of OpenCV's sample ``camera_calibration.cpp``, as FileStorage writes it."""


def camera(lens: Distortion | None) -> Camera:
    return Camera(640, 480, 520.1, 521.7, 322.0, 1 / 3, lens)


@pytest.mark.parametrize("layout", ["json", "ros", "kalibr"])
@pytest.mark.parametrize(
    "lens",
    [
        None,
        RadialTangential(-0.3, 0.1, 1e-5, -2e-4),
        RadialTangential(k3=0.1),
        RadialTangential(k1=0.1, k6=1e-5),
        Fisheye(0.1, 0.0, 1e-7, -0.01),
        Fisheye(),
    ],
)
def test_every_camera_comes_back(tmp_path: Path, lens: Distortion | None, layout: str) -> None:
    path = tmp_path / ("camera.json" if layout == "json" else "camera.yaml")
    yaml_layout = "ros" if layout == "json" else layout
    if layout == "kalibr" and isinstance(lens, RadialTangential) and (lens.k3 or lens.k6):
        with pytest.raises(AmiwarpError, match=r"no coefficients after p2.*write ROS's layout"):
            save_camera(path, camera(lens), layout=yaml_layout)
        assert not path.exists()
        return
    save_camera(path, camera(lens), layout=yaml_layout)
    assert load_camera(path) == camera(lens)
    with refused(ErrorCode.OUTPUT_EXISTS):
        save_camera(path, camera(lens))


def test_files_of_other_programs(tmp_path: Path) -> None:
    path = tmp_path / "camera.yml"
    path.write_text(ROS)
    lens = RadialTangential(-0.361976, 0.110510, 1e-3, 5.05e-4)
    assert load_camera(path) == Camera(
        640, 480, 438.783367, 437.302876, 305.593336, 243.738352, lens
    )
    path.write_text(ROS.replace("distortion_model: plumb_bob\n", ""))  # files before 2010
    assert load_camera(path).distortion == lens
    path.write_text(KALIBR)
    lens = RadialTangential(-0.27695497, 0.06712482, 0.00087538, 0.00011556)
    assert load_camera(path) == Camera(752, 480, 461.629, 460.152, 362.680, 246.049, lens)
    path.write_text(KALIBR.replace("radtan", "equidistant"))
    assert load_camera(path).distortion == Fisheye(-0.27695497, 0.06712482, 0.00087538, 0.00011556)


def test_files_of_opencv(tmp_path: Path) -> None:
    path = tmp_path / "camera.yml"
    path.write_text(OPENCV)
    lens = RadialTangential(-0.36, 0.11, 1e-3, 5e-4, -0.02)
    assert load_camera(path) == Camera(640, 480, 438.78, 437.3, 305.59, 243.73, lens)
    path.write_text(OPENCV.replace("fisheye_model: 0\n", ""))
    assert load_camera(path).distortion == lens
    four = OPENCV.replace(", -2.0e-02", "")
    path.write_text(four)
    assert load_camera(path).distortion == RadialTangential(-0.36, 0.11, 1e-3, 5e-4)
    path.write_text(four.replace("model: 0", "model: 1"))
    assert load_camera(path).distortion == Fisheye(-0.36, 0.11, 1e-3, 5e-4)
    eight = OPENCV.replace("-2.0e-02", "-2.0e-02, 0.1, 0.2, 0.3")
    path.write_text(eight)
    assert load_camera(path).distortion == RadialTangential(
        -0.36, 0.11, 1e-3, 5e-4, -0.02, 0.1, 0.2, 0.3
    )
    path.write_text(four.replace("fisheye_model: 0\n", ""))
    with pytest.raises(AmiwarpError, match="4 coefficients are k1, k2, p1, p2 or a fisheye"):
        load_camera(path)


def test_what_opencv_writes_itself(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    path = tmp_path / "camera.yml"
    expected = camera(RadialTangential(-0.3, 0.1, 1e-5, -2e-4, 0.02))
    matrix, coefficients = expected.to_opencv()
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 640)
    file.write("image_height", 480)
    file.write("camera_matrix", matrix)
    file.write("distortion_coefficients", coefficients)
    file.release()
    assert "!!opencv-matrix" in path.read_text()
    assert load_camera(path) == expected


def test_written_files_have_the_fields_of_their_programs(tmp_path: Path) -> None:
    for layout, text in (("ros", ROS), ("kalibr", KALIBR)):
        path = tmp_path / f"{layout}.yaml"
        save_camera(path, camera(RadialTangential(-0.3)), layout=layout)
        given, expected = yaml.safe_load(path.read_text()), yaml.safe_load(text)
        if layout == "kalibr":
            assert given["cam0"].keys() == expected["cam0"].keys() - {"cam_overlaps", "rostopic"}
        else:
            assert given.keys() == expected.keys() | {"rectification_matrix", "projection_matrix"}
            assert given["distortion_coefficients"] == {
                "rows": 1,
                "cols": 5,
                "data": [-0.3, 0.0, 0.0, 0.0, 0.0],
            }


@pytest.mark.parametrize(
    ("text", "old", "new", "message"),
    [
        (KALIBR, "pinhole", "omni", "field cam0.camera_model is 'omni'; choose among pinhole"),
        (
            KALIBR,
            "radtan",
            "fov",
            "field cam0.distortion_model is 'fov'; choose among radtan, equidistant, none",
        ),
        (KALIBR, "461.629, ", "", r"field cam0.intrinsics is \[.*\]; expected a list of 4 numbers"),
        (KALIBR, "461.629", "x", "field cam0.intrinsics = 'x' is not a finite number"),
        (
            KALIBR,
            "  resolution: [752, 480]\n",
            "",
            "field cam0.resolution is missing; add this field",
        ),
        (KALIBR, "752", "0", "field cam0.resolution.* = 0"),
        (
            KALIBR,
            "cam0:",
            "cam0: {camera_model: pinhole}\ncam1:",
            "holds 2 cameras .cam0, cam1.; leave one",
        ),
        (
            ROS,
            "plumb_bob",
            "thin_prism",
            "field distortion_model is 'thin_prism'; choose among plumb_bob",
        ),
        (
            ROS,
            "plumb_bob",
            "rational_polynomial",
            "distortion_coefficients.data is .*; expected a list of 8 numbers",
        ),
        (ROS, "image_width: 640", "image_width: 640.5", "field image_width"),
        (ROS, "438.783367, 0.000000", "438.783367, 0.1", "skew of 0.1 px"),
        (ROS, "camera_matrix", "matrix", "holds neither camera_matrix"),
        (ROS, "image_width: 640", "image_width: [640", "is not YAML: .* in line 3; correct it"),
        (ROS, ROS, "[" * 20_000, "is nested too deeply"),
        (ROS, ROS, "- 1\n" * 20_000, "is larger than 64 KiB"),
        (ROS, ROS, "", "holds neither"),
        (ROS, ROS, "\0", "is not a camera file"),
        (
            ROS,
            "640",
            "!!python/object/apply:os.getcwd []",
            "is not YAML: could not determine a constructor",
        ),
    ],
)
def test_what_is_no_camera_is_named(
    tmp_path: Path, text: str, old: str, new: str, message: str
) -> None:
    path = tmp_path / "camera.yaml"
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(AmiwarpError, match=rf"camera\.yaml: .*({message})"):
        load_camera(path)


def test_calib_txt_needs_the_size(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text("200 201 150 110 0 0 0 0 0")
    with pytest.raises(
        AmiwarpError, match=r"holds no size of the image; give size=\(width, height\)"
    ):
        load_camera(path)
    assert load_camera(path, (240, 180)).fy == 201.0


def test_a_camera_among_many_comments_is_read(tmp_path: Path) -> None:
    path = tmp_path / "camera.yml"
    path.write_text("# measured twice\n" * 3000 + ROS)
    assert load_camera(path).fx == 438.783367
    path.write_text("# measured twice\n" * 5000 + ROS)
    with pytest.raises(AmiwarpError, match="is larger than 64 KiB, so it is no camera"):
        load_camera(path)
