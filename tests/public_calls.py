"""All public functions, classes and methods, by the stub ``amiwarp/__init__.pyi``, each with valid arguments."""

import enum
import functools
import inspect
import itertools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import amiwarp as aw
from tests.networks import write_network

NAMES = re.findall(r"import (\w+) as \1", Path(aw.__file__).with_suffix(".pyi").read_text())
NOT_CALLED = {
    "AmiwarpError",
    "CalibrationOptions",
    "CameraPackets",
    "InspectorHandle",
    "LivePackets",
    "LivePicture",
    "LockedAngles",
    "Model",
    "Packet",
    "PhaseImage",
    "PhaseSums",
    "PhaseUpdate",
    "PlacesInCamera",
    "Rays",
    "Renderer",
    "RingPart",
    "Surfaces",
    "Triggers",
}
"""Public classes that users catch, receive, derive from or annotate with, and do not make."""

_count = itertools.count()


def _ring() -> aw.PhaseRing:
    """Return a ring that holds a turn."""
    ring = aw.PhaseRing(4, 3)
    ring.add(EVENTS, TURNED)
    return ring


class Black(aw.Renderer):
    """Renderer that sees nothing."""

    def luminance(self, scene: Any, rays: aw.Rays) -> Any:
        return np.zeros((2, 3, 4), np.float32)


def _eyes() -> aw.EventCamera:
    return aw.EventCamera(Black(2, "cpu"), CAMERA, pictures=1)


def _new(suffix: str) -> Callable[[], str]:
    """Return a function that gives the name of a new file."""
    return lambda: f"out{next(_count)}{suffix}"


def _all(record: Any) -> dict[str, Any]:
    return {one.name: getattr(record, one.name) for one in fields(record) if one.init}


RANDOM = np.random.default_rng(0)
CAMERA = aw.Camera.from_fov(4, 3, 1.0)
TABLE = np.zeros((3, 4, 2), np.float32)
PIXELS = aw.PixelMap(*np.ones((8, 3, 4)))
DEPTHS = aw.DepthMap(np.ones((3, 4)), np.ones((3, 4)), np.ones((3, 4, 3)))
PLATE = aw.Plate(0.01, 0.7)
ROTATION_PATH = aw.RotationPath(0, np.tile([0.0, 0.0, 0.0, 1.0], (3, 1)))
EVENTS = aw.Events.from_arrays([1, 2, 1], [0, 1, 2], [0, 400, 900], [1, 0, 1])
ON_DEVICE = aw.DeviceEvents.from_arrays(EVENTS.x, EVENTS.y, EVENTS.t, EVENTS.p)
SOURCE = aw.MemoryEvents(EVENTS, 4, 3)
WINDOWS = aw.windows(EVENTS, count=1)
ENCODER = aw.Encoder(np.array([0, 1000], np.int64), np.array([0.0, 0.1]))
PRISM = aw.Prism(0.02)
MODEL = aw.ExactModel(CAMERA, PRISM)
PAIR = aw.Prism(0.02, second=aw.Prism(0.01))
RECORDING = aw.Recording(SOURCE, CAMERA, ENCODER, PRISM)
STILL = aw.Trajectory.still((0, 0, 0))
MESH = aw.Mesh([[0, 0, 2], [1, 0, 2], [0, 1, 2]], [[0, 1, 2]])
WORLD = aw.World("w", (aw.Body("b", MESH),))
SCENE = aw.Scene.from_picture(np.ones((4, 4), np.float32))
IN_WORLD = aw.Simulation(aw.WorldScene(WORLD, STILL), CAMERA, PRISM, 0.001)
FRAME = aw.TruthRenderer(IN_WORLD).at(0)
FRAMES = IN_WORLD.run(truth_times_us=[0, 1000]).truth.frames
POSES = aw.Poses(np.array([0]), np.array([[0.0, 0, 0, 0, 0, 0, 1]]))
IMU = aw.ImuSamples(np.array([0, 5]), np.zeros((2, 3)), np.zeros((2, 3)))
IMAGES = aw.MemoryImages(np.array([0, 5]), np.zeros((2, 3, 4), np.uint8))
RIG_SENSOR = aw.RigSensor("events", RECORDING, np.eye(3, 4))
SIMULATED_RIG = aw.Rig(WORLD, STILL, {"left": aw.RigEventCamera(CAMERA)}, 0.001)
RIG = aw.RigRecording({"left": RIG_SENSOR})
STAGE = aw.SearchStage(
    algorithm="a",
    x=np.zeros(1),
    score=1.0,
    evaluations=1,
    seconds=1.0,
    ended="e",
    points=np.zeros((1, 1)),
    scores=np.zeros(1),
)
SUMMARY = aw.StageSummary(
    name="n", algorithm="a", evaluations=1, seconds=1.0, sharpness=1.0, ended="e"
)
CALIBRATION = aw.Calibration(
    model_name="exact",
    camera=CAMERA,
    prism=PRISM,
    parameters={"apex": 0.02, "phase": 0.0},
    uncertainty={"apex": 1e-4, "phase": 1e-3},
    free=("apex", "phase"),
    sharpness_name="variance",
    sharpness_before=1.0,
    sharpness_after=2.0,
    stages=(SUMMARY,),
    events=10,
    seconds=1.0,
)
SPACE = aw.ParameterSpace(
    model="exact",
    camera=CAMERA,
    prism=PRISM,
    names=("apex",),
    low={"apex": 0.0},
    high={"apex": 0.1},
    start={"apex": 0.02, "phase": 0.0, "clock_offset": 0.0},
    pixels={"apex": 100.0},
    middle_us=0,
    duration_us=1000.0,
    undrifted={},
)
SUMS = aw.phase_sums(EVENTS, np.zeros(3), 4, 3)
PHASE_IMAGE = aw.phase_image(SUMS, MODEL)
TURNED = np.array([0.0, 3.0, 8.0])
BOARD = aw.Board(3, 4, 0.03)
CORNERS = aw.Corners(
    np.arange(12), np.mgrid[20:50:10, 20:60:10].reshape(2, -1).T.astype(np.float64)
)
BOARD_POSE = aw.BoardPose(
    "a", CORNERS, np.zeros((12, 2)), np.zeros(3), np.ones(3), np.zeros((60, 80), np.uint8)
)
LENS = aw.LensCalibration(CAMERA, {}, CALIBRATION, (BOARD_POSE,), {}, (), (), 1.0)
STACK = aw.PictureStack(np.zeros((2, 3, 4), np.uint8), 100.0, "s")
FOLDER = aw.PictureFolder((Path("a.png"), Path("b.png")), np.array([0, 10]), (4, 3))
VIDEO = aw.VideoFile(Path("v.mp4"), (4, 3), 30.0, 1000.0)
ZERO = np.zeros((3, 4), np.float32)
PICTURE = aw.Picture(ZERO, np.ones((3, 4), bool), 0, 10, 4, 0.0, 1.0, 0.1, 0, 0.0, ZERO)
XY = RANDOM.uniform(0, 3, (200, 2))


def _pose(_: float) -> Any:
    from scipy.spatial.transform import Rotation

    return Rotation.identity(), (0, 0, 0)


def _stream() -> aw.EncoderStream:
    stream = aw.EncoderStream()
    stream.append([0, 1000], [0.0, 0.1])
    return stream


def _writer() -> aw.RecordingWriter:
    return aw.RecordingWriter(_new(".h5")(), width=4, height=3).__enter__()


BY_NAME: dict[str, Any] = {
    "recording": RECORDING,
    "calibration": CALIBRATION,
    "camera": CAMERA,
    "prism": PRISM,
    "model": MODEL,
    "encoder": ENCODER,
    "events": EVENTS,
    "width": 4,
    "height": 3,
    "size": (4, 3),
    "t_us": [0, 500],
    "angle": [0.0, 0.1],
    "t": [0, 500],
    "start": 0,
    "stop": 2,
    "t_start": 0,
    "t_end": 500,
    "t_first": 0,
    "t_last": 1000,
    "x": [1, 2],
    "y": [0, 1],
    "p": [1, 0],
    "values": {"apex": 0.02, "phase": 0.0},
    "path": _new(".h5"),
    "out_path": _new(".h5"),
    "name": "n",
    "duration_s": 0.001,
    "simulation": IN_WORLD,
    "xy": np.zeros((2, 2)),
    "theta": np.zeros(2),
    "now_us": 0,
    "device": "cpu",
    "start_us": 0,
    "length_us": 1000,
    "step_us": 500.0,
    "scene": SCENE,
    "motion": aw.PrismMotion(),
    "trajectory": STILL,
    "world": WORLD,
    "poses": POSES,
    "mesh": MESH,
}  # fmt: skip
"""Arguments by the name of the parameter, for parameters without a default."""

OWN: dict[str, dict[str, Any]] = {
    "calibrate": {"recording": aw.Recording(SOURCE)},
    "SearchStage": _all(STAGE),
    "ParameterSpace": _all(SPACE),
    "ParameterSpace.deviations": {"v": np.zeros(1), "covariance": np.eye(1)},
    "ParameterSpace.to_values": {"v": np.zeros(1)},
    "ParameterSpace.without": {"names": ("apex",)},
    "Calibration": _all(CALIBRATION),
    "Calibration.load": {"path": "calibration.json"},
    "Calibration.save": {"path": _new(".json")},
    "FreedParameter": {
        "name": "n",
        "freed": True,
        "determined": True,
        "std_px": 0.1,
        "gain_px": (0.1, 0.1),
        "verdict": "v",
    },
    "ModelCandidate": {
        "model": "exact",
        "numbers": "n",
        "predicted_px": 0.1,
        "sharpness": 0.1,
        "loss": 0.1,
        "loss_std": 0.1,
        "seen_px": (0.1, 0.1),
        "cost_ns": 1.0,
        "chosen": True,
        "verdict": "v",
    },
    "ModelChoice": {
        "budget_px": 0.1,
        "timing_px": 0.1,
        "agreed": True,
        "exact": {"apex": 0.1},
        "exact_uncertainty": {"apex": 0.1},
        "rungs": (),
        "parameters": (),
        "seconds": 1.0,
    },
    "PhotometricSummary": {
        "accepted": True,
        "verdict": "v",
        "parameters": {"apex": 0.1},
        "uncertainty": {"apex": 0.1},
        "sharpness_parameters": {},
        "moved_px": 0.1,
        "cost": 0.1,
        "cost_at_sharpness": 0.1,
        "residual": 0.1,
        "pairs": 1,
        "off_over_on": 1.0,
    },
    "StageSummary": _all(SUMMARY),
    "StageSummary.of": {"name": "n", "stage": STAGE, "names": ("apex",), "values": [{"apex": 0.1}]},
    "compensate_live": {"source": "in.h5"},
    "pictures_live": {"source": "in.h5"},
    "stream_live": {"source": "in.h5"},
    "StageStatus": {"name": "read"},
    "open_camera": {"name": "camera:"},
    "CameraSettings": {"biases": {"diff_on": 20}, "region": (1, 2, 3, 4), "masked": ((1, 2),), "flicker_hz": (90, 130)},
    "CompensationSummary": {"events": 1, "outside": 1, "seconds": 1.0},
    "Compensated": {"events": EVENTS, "flags": np.zeros(3, np.uint8)},
    "Compensator": {"model": MODEL, "encoder": aw.EncoderStream()},
    "DeviceCompensated": {"events": ON_DEVICE, "flags": wp.zeros(3, dtype=wp.uint8)},
    "DeviceEvents": _all(ON_DEVICE),
    "DeviceEvents.concatenate": {"blocks": [ON_DEVICE, ON_DEVICE[2:]]},
    "DeviceMemoryEvents": {"events": ON_DEVICE, "width": 4, "height": 3},
    "DeviceMemoryEvents.find": {"t": 5},
    "Events": _all(EVENTS),
    "Events.from_structured": {"array": EVENTS.to_structured()},
    "Events.concatenate": {"blocks": [EVENTS, EVENTS[2:]]},
    "MemoryEvents.find": {"t": 5},
    "Encoder": _all(ENCODER),
    "EvtDecoder": {"version": "2.1", "swapped": True, "device": "cpu"},
    "BytesDecoder": {"format": "aedat2", "chip": "dvs128", "device": "cpu"},
    "BytesDecoder.decode": {"data": b"\0" * 8},
    "EvtDecoder.decode": {"data": b"\x00\x80\x01\x60"},
    "Encoder.from_counts": {"count": [0, 1], "counts_per_turn": 100},
    "Encoder.constant_speed": {"rpm": 720.0},
    "Encoder.gaps": {"max_interval_us": 100.0},
    "Encoder.with_clock_offset": {"clock_offset_us": 1.0},
    "Encoder.with_harmonics": {"harmonics": [0.1, 0.0, 0.0, 0.0]},
    "Encoder.with_second": {"second": -0.5},
    "Encoder.from_command": {"t_us": np.arange(20) * 1000, "command": np.sin(np.arange(20))},
    "Encoder.with_index": {"index_t_us": [500]},
    "EncoderStream.append": {"t_us": [2000, 3000]},
    "EncoderStream.append_command": {"t_us": [2000, 3000], "command": [0.0, 0.5], "largest": 1.0},
    "EncoderStream.guessed": {"t": np.array([0, 5])},
    "Recording": {"events": SOURCE},
    "ImuSamples": _all(IMU),
    "MemoryImages": {"t": np.array([0, 5]), "images": np.zeros((2, 3, 4), np.uint8)},
    "FrameTruth": _all(FRAME),
    "Poses": _all(POSES),
    "Poses.concatenate": {"blocks": [POSES]},
    "WorldLabels": {"instances": ("a",), "categories": ("b",)},
    "edge_blur": {
        "sharp_xy": np.stack([20.0 + RANDOM.normal(0.0, 0.5, 9000), RANDOM.uniform(0.0, 39.0, 9000)], axis=1).astype(
            np.float32
        ),
        "width": 40,
        "height": 40,
    },
    "model_error": {"truth": MODEL},
    "truth_model": {"truth": aw.Truth({"apex": 0.02, "index": 1.5, "phase": 0.0}), "flat_side": "scene"},
    "sharpness": {"image": RANDOM.uniform(0, 1, (8, 8)).astype(np.float32)},
    "ConversionSummary": {
        "events": 1,
        "repairs": {},
        "encoder_covers": True,
        "encoder_gaps": (),
        "index_slip": None,
        "format": next(iter(aw.OutputFormat)),
        "left_out": (),
    },
    "convert": {"source_path": "in.h5"},
    "EventFilter.apply": {"size": (4, 3)},
    "StreamTensor": {"tensor": np.zeros((2, 3)), "t_start": 0, "t_end": 10, "events": 0},
    "TensorStream": {"representation": aw.ToTensor(aw.event_count, width=4, height=3), "rate_hz": 50.0},
    "filter_recording": {"chosen": aw.EventFilter(every=2)},
    "render": {"path": _new(".mp4")},
    "FilmSummary": {"frames": 1, "height": 2, "fps": 30.0, "speed": 1.0, "decay_us": None, "events": 5},
    "FilterSummary": {
        "events": 2,
        "kept": 1,
        "removed": {"every": 1},
        "hot_pixels": (),
        "duration_us": 5,
        "kept_us": 0,
        "left_out": (),
        "removed_records": {},
    },
    "Board": {"columns": 3, "rows": 4, "square_m": 0.03},
    "Board.save": {"path": _new(".svg")},
    "Board.world": {"rotation": (0, 0, 0, 1), "position": (0, 0, 1)},
    "Board.find": {"picture": np.zeros((60, 80), np.uint8)},
    "Board.missing": {"picture": np.zeros((60, 80), np.uint8)},
    "Board.has_another": {"picture": np.zeros((60, 80), np.uint8), "corners": CORNERS},
    "Corners": {"ids": CORNERS.ids, "xy": CORNERS.xy},
    "BoardPose": _all(BOARD_POSE),
    "LensCalibration": _all(LENS),
    "calibrate_lens": {"recordings": [RECORDING], "board": BOARD},
    "Windows": _all(WINDOWS),
    "windows": {"duration_us": 300},
    "collate": {"blocks": [EVENTS, EVENTS[2:]]},
    "voxel_grid": {"bins": 2},
    "stacked_histogram": {"bins": 2},
    "time_surface": {"tau_us": 100.0},
    "tore_volume": {"depth": 2},
    "mixed_density_stack": {"stacks": 2},
    "event_spike_tensor": {"bins": 2},
    "ToTensor": {"representation": aw.event_count},
    "Network": {"path": "sum.onnx"},
    "Network.over": {"windows": WINDOWS},
    "load_camera": {"path": "none.json"},
    "save_camera": {"path": _new(".json"), "camera": CAMERA},
    "PixelMap": _all(PIXELS),
    "DepthMap": _all(DEPTHS),
    "DepthMap.load": {"path": "none.npz"},
    "DepthMap.save": {"path": _new(".npz")},
    "DepthMap.save_points": {"path": _new(".ply")},
    "Plate": {"thickness": 0.01, "tilt": 0.7},
    "PlateModel": {"camera": CAMERA, "plate": PLATE},
    "PlateModel.from_prism": {"prism": PLATE},
    "PlateModel.from_values": {"prism": PLATE, "values": {"inverse_depth": 1.0, "phase": 0.0}},
    "PlateModel.compensate_at": {"xy": XY, "theta": np.linspace(0, 6, 200), "inverse_depth": np.ones(200)},
    "PlateModel.with_depths": {"depths": np.ones((3, 4))},
    "PixelMap.load": {"path": "none.npz"},
    "PixelMap.save": {"path": _new(".npz")},
    "pixel_thresholds": {"model": MODEL},
    "phase_sums": {"angles": np.zeros(3)},
    "PhaseSums.from_integers": {"integers": np.zeros((3, 4, 5), np.int32), "turns": 1.0, "off_ratio": 1.0},
    "phase_tensor": {"harmonics": 2},
    "weighted_sums": {"parts": [SUMS, SUMS], "weights": [1.0, 2.0]},
    "phase_picture": {"sums": SUMS, "model": MODEL},
    "PhaseCamera": {"model": MODEL, "encoder": aw.EncoderStream()},
    "PhaseRing.add_part": {"part": _ring().split(EVENTS, TURNED)[0]},
    "PhaseRing.add": {"angles": TURNED + 1.0},
    "PhaseRing.split": {"angles": TURNED + 1.0},
    "PhaseRing.span_us": {"bins": 16},
    "PhaseRing.update": {"prior": _ring().sums(), "turns": 0.25},
    "phase_image": {"sums": SUMS, "model": MODEL},
    "PhaseImage.save": {"path": _new(".npz")},
    "PhaseReconstruction": {"recording": RECORDING, "calibration": CALIBRATION},
    "open_recording": {"path": "in.h5"},
    "open_rig": {"path": "in_rig"},
    "save_rig": {"folder": _new(""), "rig": RIG},
    "RigSensor": _all(RIG_SENSOR),
    "RigRecording": {"sensors": {"left": RIG_SENSOR}},
    "RigRecording.between": {"source": "left", "target": "left"},
    "RigWriter": {"folder": _new("")},
    "RigConversionSummary": {"format": "ros1", "files": 1, "roles": {}, "notes": (), "left_out": ()},
    "convert_rig": {"rig": RIG, "out": _new(".bag")},
    "RigWriter.add": {"name": "left", "kind": "events", "to_rig": np.eye(3, 4)},
    "RecordingWriter.append_frame": {"frame": FRAME},
    "RecordingWriter.append_image": {"t_us": 0, "image": np.zeros((3, 4), np.uint8)},
    "RecordingWriter.append_imu": {"samples": IMU},
    "RecordingWriter.append_known": {"t_us": 0, "mask": np.zeros((3, 4), np.bool_)},
    "RecordingWriter.fill": {"pieces": [], "count": 1 << 18},
    "RecordedDataset": {"folder": "."},
    "places_in": {"places": np.ones((2, 3)), "trajectory": STILL, "world": WORLD},
    "disparity": {"depth": np.ones(2), "left": CAMERA, "right": CAMERA, "baseline_m": 0.1},
    "save_flow_dsec": {"folder": _new(""), "frames": FRAMES},
    "save_flow_mvsec": {"path": _new(".npz"), "frames": FRAMES},
    "save_poses_tum": {"path": _new(".tum")},
    "Camera": _all(CAMERA),
    "Camera.from_fov": {"fov": 1.0},
    "Camera.from_opencv": {"K": CAMERA.to_opencv()[0], "dist": np.zeros(5), "size": (4, 3)},
    "Camera.rays_to_pixels": {"rays": np.ones((2, 3))},
    "CameraRotation.about": {"middle_us": 5},
    "CameraRotation.params": {"device": "cpu"},
    "CameraRotation.reach": {"half_s": 0.1},
    "RotationPath": _all(ROTATION_PATH),
    "RotationPath.from_rates": {"t": np.array([0, 1000]), "rates": np.zeros((2, 3)), "span": (0, 1000)},
    "RotationPath.orientations": {"t": np.zeros(2)},
    "RotationPath.vectors": {"middle_us": 0},
    "RotationPath.at": {"tau": np.zeros(2), "middle_us": 0},
    "CameraRotation.rotation": {"tau": np.zeros(2)},
    **{
        f"{name}.{method}": given
        for name in (
            "CircleModel", "EllipseModel", "ExactModel", "MirrorModel", "PlateModel", "RadialCircleModel",
            "RisleyModel", "SteererModel", "VibrationModel",
        )
        for method, given in (("apex_from_size", {"size": 0.02}), ("size_from_apex", {"apex": 0.02}))
    },
    **{
        f"{name}.{method}": given
        for name, size in (
            ("CircleModel", "deflection"), ("EllipseModel", "apex"), ("ExactModel", "apex"),
            ("PlateModel", "inverse_depth"), ("RadialCircleModel", "deflection"), ("RisleyModel", "apex"),
            ("MirrorModel", "amplitude"), ("SteererModel", "amplitude"), ("VibrationModel", "amplitude"),
        )
        for method, given in (
            ("freed", {"ratio": 1.0}),
            ("twin_values", {"values": {size: 0.01, "phase": 0.0, "second_phase": 0.1, "fold": 0.2}}),
            ("turned_values", {"values": {size: 0.01, "phase": 0.0}, "angle": 0.1}),
            ("reversed_values", {"values": {size: 0.01, "phase": 0.0}}),
            ("default_bounds", {"name": size, "value": 0.01}),
        )
    },
    "CircleModel": {"deflection": 0.01},
    "VibrationModel": {"amplitude": 0.01},
    "MirrorModel": {"amplitude": 0.01},
    "MirrorModel.from_values": {"values": {"amplitude": 0.01, "phase": 0.0}},
    "MirrorModel.rotations": {"theta": np.zeros((20, 2))},
    "Mirror": {"hz": (60.0, 77.0), "amplitude": (0.01, 0.01)},
    "SteererModel": {"amplitude": 0.01},
    "SteererModel.from_values": {"values": {"amplitude": 0.01, "phase": 0.0}},
    "SteererModel.added": {"theta": np.zeros((20, 2))},
    "Steerer": {"hz": (5000.0, 6100.0), "amplitude": (0.01, 0.01)},
    "VibrationModel.from_values": {"values": {"amplitude": 0.01, "phase": 0.0}},
    "VibrationModel.rotations": {"theta": np.linspace(0, 6, 20)},
    "Vibration": {"hz": 100.0, "amplitude": 0.01},
    "CircleModel.from_values": {"values": {"deflection": 0.01, "phase": 0.0}},
    "RadialCircleModel.from_values": {"values": {"deflection": 0.01, "phase": 0.0}},
    "RadialCircleModel": {"deflection": 0.01},
    "RisleyModel": {"prism": PAIR},
    "EllipseModel": {"offset": TABLE, "cosine": TABLE, "sine": TABLE},
    "EllipseModel.fit": {"xy": XY, "theta": np.linspace(0, 6, 200), "compensated": XY, "degree": 1},
    "ModelError": {"rms": 0.1, "worst": 0.1, "lag": 0.0},
    "predicted_error": {"exact": MODEL},
    "Parameter": {"name": "apex", "unit": "rad"},
    "Prism": {"apex": 0.02},
    "UnsizedPrism.with_apex": {"apex": 0.02},
    "apex_from_deflection": {"deflection": 0.01, "index": 1.5},
    "deflection_from_apex": {"apex": 0.02, "index": 1.5},
    "Reconstruction": {"model": MODEL},
    "reconstruct": {"model": MODEL},
    "Picture": _all(PICTURE),
    "EncoderModel.sample": {"duration_us": 1000, "seed": 0},
    "PrismMotion.from_function": {"rpm": lambda t: 720.0 + 0.0 * t, "duration_s": 0.01},
    "Scene": {"frames": SCENE.frames},
    "Scene.from_picture": {"picture": np.ones((4, 4), np.float32)},
    "SensorModel.preset": {"name": "gen4"},
    "SensorModel.with_davis_biases": {"diff": 1.0, "on": 2.0, "off": 0.5},
    "EventCamera": {"renderer": Black(2, "cpu")},
    "EventCamera.angles": {"t_us": 0},
    "EventCamera.flow_to": {"state": None},
    "EventCamera.rays": {"t_us": 0},
    "EventCamera.recording": {"steps": [_eyes().step(None, 0)]},
    "EventCamera.step": {"state": None, "t_us": 0},
    "ImuModel.preset": {"name": "bmi160"},
    "ImuModel.follow": {"trajectory": STILL, "duration_s": 0.01},
    "ImuModel.turn": {"rotation": aw.CameraMotion(), "duration_s": 0.01},
    "EventSensor": {"cameras": 2},
    "EventSensor.step": {"images": np.zeros((2, 3, 4), np.float32), "t_us": 0},
    "PictureFolder": _all(FOLDER),
    "PictureStack": _all(STACK),
    "VideoFile": _all(VIDEO),
    "TruthRenderer.at": {"t_us": 0, "next_us": 100, "before_us": 50},
    "TruthRenderer.displacement": {"t0_us": 0, "t1_us": 100},
    "Simulation.displacement": {"t0_us": 0, "t1_us": 100},
    "TruthRenderer.luminance": {"t_us": 0},
    "named_world": {"name": "person"},
    "Lamp": {"position": (0.0, 0.0, 0.0)},
    "Mesh": {"vertices": [[0, 0, 2], [1, 0, 2], [0, 1, 2]], "faces": [[0, 1, 2]]},
    "Sun": {"direction": (0.0, 1.0, 0.0)},
    "World": {"bodies": WORLD.bodies},
    "Trajectory": {"t": [0.0], "position": np.zeros((1, 3)), "rotation": [[0, 0, 0, 1]]},
    "Trajectory.from_file": {"path": "poses.tum"},
    "Trajectory.from_function": {"pose": _pose, "duration_s": 0.01},
    "Trajectory.still": {"position": (0, 0, 0)},
    "Trajectory.save_tum": {"path": _new(".tum")},
    "load_world": {"path": "none.toml"},
    "load_rig": {"path": "none.toml"},
    "Rig": {"sensors": SIMULATED_RIG.sensors, "trajectory": STILL, "duration_s": 0.001},
    "Rig.paper_platform": {"size": (4, 3), "duration_s": 0.1},
    "Rig.seed_of": {"name": "left"},
    "Rig.simulation": {"name": "left"},
    "Rig.trajectory_of": {"name": "left"},
    "Rig.write": {"folder": _new("")},
    "RigDepthCamera.times": {"duration_s": 0.1},
    "RigFrameCamera.exposures": {"duration_s": 0.1},
    "RigFrameCamera.times": {"duration_s": 0.1},
    "DatasetPlan": {
        "recordings": 1,
        "missing": 0,
        "splits": {},
        "sources": {},
        "samples": 1,
        "uncertainty": 0.1,
        "sources_of_splits": {},
        "events": 1.0,
        "size_bytes": 1.0,
        "worker_seconds": 1.0,
        "workers": 1,
    },
    "DatasetSummary": {
        "sources_of_splits": {},
        "recordings": 1,
        "made": 1,
        "kept": 0,
        "failed": {},
        "not_in_specification": (),
        "splits": {},
        "events": 1,
        "size_bytes": 1,
        "seconds": 1.0,
        "worker_seconds": 1.0,
        "processor_seconds": 1.0,
        "workers": 1,
    },
    "ExportSummary": {"splits": {}, "files": (), "events": 1, "size_bytes": 1, "seconds": 1.0},
    "export_dataset": {"folder": "none", "out": _new(""), "to": "parquet"},
    "plan_dataset": {"specification": "none.toml", "out": _new("")},
    "make_dataset": {"specification": "none.toml", "out": _new("")},
    "EvaluationSummary": {
        "cells": 1,
        "new_cells": 0,
        "failed": 0,
        "verdicts": {},
        "files": {},
        "seconds": 1.0,
        "processor_seconds": 1.0,
    },
    "evaluate": {"out": _new(""), "only": ("nothing",)},
    "translate": {"source": STACK, "duration_s": 0.001},
}  # fmt: skip
"""Arguments of one callable, before those by name."""

OBJECTS: dict[str, Any] = {
    "Board": BOARD,
    "ParameterSpace": SPACE,
    "PhotometricSettings": aw.PhotometricSettings(),
    "Calibration": CALIBRATION,
    "Settings": aw.Settings(),
    "StageSummary": SUMMARY,
    "DeviceEvents": ON_DEVICE,
    "DeviceMemoryEvents": aw.DeviceMemoryEvents(ON_DEVICE, 4, 3),
    "Encoder": ENCODER,
    "Events": EVENTS,
    "MemoryEvents": SOURCE,
    "Truth": aw.Truth(),
    "Poses": POSES,
    "Camera": CAMERA,
    "CameraRotation": aw.CameraRotation((0.0, 0.1, 0.0)),
    "RotationPath": ROTATION_PATH,
    "CircleModel": aw.CircleModel(CAMERA, 0.01),
    "RadialCircleModel": aw.RadialCircleModel(CAMERA, 0.01),
    "EllipseModel": aw.EllipseModel(CAMERA, *[TABLE] * 3),
    "ExactModel": MODEL,
    "RisleyModel": aw.RisleyModel(CAMERA, PAIR),
    "VibrationModel": aw.VibrationModel(CAMERA, 0.01),
    "Vibration": aw.Vibration(100.0, 0.01),
    "MirrorModel": aw.MirrorModel(CAMERA, 0.01),
    "Mirror": aw.Mirror((60.0, 77.0), (0.01, 0.01)),
    "SteererModel": aw.SteererModel(CAMERA, 0.01),
    "Steerer": aw.Steerer((5000.0, 6100.0), (0.01, 0.01)),
    "UnsizedPrism": aw.UnsizedPrism(),
    "Picture": PICTURE,
    "PixelMap": PIXELS,
    "PhaseImage": PHASE_IMAGE,
    "PhaseReconstruction": aw.PhaseReconstruction(RECORDING, CALIBRATION),
    "DepthMap": DEPTHS,
    "PlateModel": aw.PlateModel(CAMERA, PLATE),
    "CameraMotion": aw.CameraMotion(),
    "EncoderModel": aw.EncoderModel(),
    "PrismMotion": aw.PrismMotion(),
    "Scene": SCENE,
    "SensorModel": aw.SensorModel(),
    "ImuModel": aw.ImuModel(),
    "PictureFolder": FOLDER,
    "PictureStack": STACK,
    "VideoFile": VIDEO,
    "Simulation": aw.Simulation(SCENE, CAMERA, PRISM, 0.001),
    "TruthRenderer": aw.TruthRenderer(IN_WORLD),
    "Trajectory": STILL,
    "MemoryImages": IMAGES,
    "Rig": SIMULATED_RIG,
    "RigDepthCamera": aw.RigDepthCamera(CAMERA),
    "RigFrameCamera": aw.RigFrameCamera(CAMERA),
    "RigRecording": RIG,
    "EventFilter": aw.EventFilter(every=2),
    "BytesDecoder": aw.BytesDecoder("dat2"),
    "EvtDecoder": aw.EvtDecoder("3.0"),
}
"""Objects whose methods are called."""

MADE: dict[str, Callable[[], Any]] = {
    "Compensator": lambda: aw.Compensator(MODEL, _stream()),
    "PhaseCamera": lambda: aw.PhaseCamera(MODEL, _stream()),
    "TensorStream": lambda: aw.TensorStream(
        aw.ToTensor(aw.event_count, width=4, height=3), rate_hz=50.0
    ),
    "PhaseRing": _ring,
    "EncoderStream": _stream,
    "EventCamera": _eyes,
    "EventSensor": lambda: aw.EventSensor(2, 3, 4),
    "CornerDetector": lambda: aw.CornerDetector((4, 3)),
    "RecordingWriter": _writer,
    "RigWriter": lambda: aw.RigWriter(_new("")()).__enter__(),
    "Network": lambda: aw.Network("sum.onnx"),
    "Reconstruction": lambda: aw.Reconstruction(RECORDING, model=MODEL),
}
"""Makers of objects that a call changes."""

REFUSED = {
    "calibrate": "camera is unknown",
    "RecordedDataset": "no manifest",
    "Reconstruction.window": "no pixel fires twice",
    "Reconstruction.windows": "no pixel fires twice",
    "PhaseReconstruction.sums": "need a whole turn",
    "PhaseReconstruction.window": "need a whole turn",
    "PhaseReconstruction.windows": "need a whole turn",
    "reconstruct": "outside the encoder's",
    "PictureFolder.read": "no such file",
    "VideoFile.read": "v.mp4",
    "calibrate_lens": "the prism makes",
    "Simulation.displacement": "picture at infinity",
    "load_camera": "no such file",
    "PixelMap.load": "no such file",
    "DepthMap.load": "no such file",
    "depth": "depth is not determined",
    "pixel_thresholds": "no pixel fires twice",
    "load_world": "no such file",
    "load_rig": "no such file",
    "export_dataset": "has no manifest.json",
    "plan_dataset": "no such file",
    "make_dataset": "no such file",
    "evaluate": "unknown evaluation",
    "EventCamera.camera_poses": "call step first",
    "EventCamera.flow_to": "call step first",
    "EventCamera.surfaces": "call step first",
    "view": "in a notebook",
}
"""Calls that would take minutes, or need a file or a browser: what they say to the arguments above."""

SETTINGS = {
    "calibrate": [one.name for one in fields(aw.Settings)],
    "translate": [
        "interpolation",
        "fps",
        "fov",
        "blur",
        "camera",
        "duration_s",
        "motion",
        "sensor",
        "encoder",
        "nominal_prism",
        "seed",
        "device",
    ],
}
"""Settings that are given by keyword and are not in the signature."""


@dataclass(frozen=True)
class PublicCall:
    """A public function, class or method."""

    label: str
    function: Callable[..., Any] | None
    """The function, or None for a method of :meth:`target`."""

    def target(self) -> tuple[Any, Callable[..., Any]]:
        """Return the object of a method, or None, and what is called."""
        if self.function is not None:
            return None, self.function
        kind, name = self.label.split(".")
        thing = MADE[kind]() if kind in MADE else OBJECTS[kind]
        return thing, getattr(thing, name)

    @functools.cached_property
    def _signature(self) -> inspect.Signature:
        """What is called, by its parameters. Finding this takes as long as many of the calls."""
        return inspect.signature(self.target()[1])

    def parameters(self) -> dict[str, str]:
        """Return the annotation of each parameter by name."""
        named = {
            one.name: str(one.annotation)
            for one in self._signature.parameters.values()
            if one.kind is not one.VAR_KEYWORD
        }
        return {**named, **dict.fromkeys(SETTINGS.get(self.label, ()), "")}

    def arguments(self) -> dict[str, Any]:
        """Return valid arguments."""
        needed = [
            name for name, one in self._signature.parameters.items() if one.default is one.empty
        ]
        given = {**{n: BY_NAME[n] for n in needed if n in BY_NAME}, **OWN.get(self.label, {})}
        return {
            n: v() if getattr(v, "__qualname__", "").startswith("_new.") else v
            for n, v in given.items()
        }


def public_calls() -> Iterator[PublicCall]:
    """Yield all public functions, classes and methods."""
    for name in NAMES:
        thing = getattr(aw, name)
        if inspect.isfunction(thing):
            yield PublicCall(name, thing)
        elif not inspect.isclass(thing) or name in NOT_CALLED or issubclass(thing, enum.Enum):
            continue
        elif not getattr(thing, "_is_protocol", False):
            yield PublicCall(name, thing)
            for method in sorted(entry for entry in dir(thing) if not entry.startswith("_")):
                found = inspect.getattr_static(thing, method)
                if isinstance(found, classmethod | staticmethod):
                    yield PublicCall(f"{name}.{method}", getattr(thing, method))
                elif inspect.isfunction(found):
                    yield PublicCall(f"{name}.{method}", None)


def write_files() -> None:
    """Write the files that the calls read, to the current folder."""
    aw.save_recording("in.h5", RECORDING)
    aw.save_rig("in_rig", RIG)
    CALIBRATION.save("calibration.json")
    STILL.save_tum("poses.tum")
    write_network(Path("sum.onnx"))
