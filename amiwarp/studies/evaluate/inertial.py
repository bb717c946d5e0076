"""Evaluation of the camera's rotation from events against a gyroscope, and of the bias of the gyroscope."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from amiwarp.calib.camera_rates import estimate_rates
from amiwarp.events.other_sensors import ImuSamples
from amiwarp.optics.camera import Camera
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.simulation.imu_model import ImuModel
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.studies.evaluate.camera_motion import estimate_rotation
from amiwarp.studies.evaluate.claims import Claim, differences, judge
from amiwarp.studies.evaluate.conditions import Condition, Settings
from amiwarp.studies.evaluate.flow import edge_pixels
from amiwarp.studies.evaluate.optical_flow import rotation_flow
from amiwarp.studies.evaluate.results import (
    Amount,
    CellResult,
    Chart,
    ChartKind,
    Table,
    grouped,
    rows_of,
    where,
)
from amiwarp.studies.evaluate.stereo import conditions as stereo_conditions
from amiwarp.studies.evaluate.streams import Stream, Streams

TITLE = "Rotation and gyroscope"
PROTOCOL = (
    "In successive windows of a half or a whole turn, contrast maximisation finds the angular velocity of the "
    "camera from its events. 'Turn to turn' compares raw events at the same angle of the prism in successive turns "
    "instead, as calibration does. The rate error is the rms over the windows of the distance from the true mean "
    "rate, and the drift the angle between the true and the integrated rotation over their time. A gyroscope, the "
    "model of the BMI160 of the DVXplorer, moves with the camera. The median over the windows of its rate less the "
    "rate of the events is taken for its bias. The bias error is the distance from the true bias; for the "
    "gyroscope alone it is the size of the bias. The gyroscope's angle error is the angle between the true "
    "rotation of the whole recording and its integrated rates less the bias found. 'True flow' is the rotation "
    "that fits the true optical flow at edges best: it differs from the truth because the camera also translates. "
    "'No motion' takes the camera to rest."
)
DIFFERENCES = (
    "The paper does not evaluate this: all verdicts here are checks of ours. No method knows the camera's "
    "translation. A recording is short; over a longer one the gyroscope alone drifts further."
)
VERSION = 1
NEEDS_TRUTH = True

TURNS = (0.5, 1.0)
"""Lengths of the windows [turns]."""
LEFT_OUT = (Stream.RAW, Stream.SAME_COUNT)
"""Streams without rates: raw events show the prism's motion, and windows of equal count have other lengths."""
GYROSCOPE = "gyroscope"
TURN_TO_TURN = "AMI-EV, turn to turn"
TRUE_FLOW = "true flow"
NO_MOTION = "no motion"
"""Names of the other sources of rates, among the streams."""
IMU = "bmi160"
"""Name of the IMU, see :meth:`amiwarp.ImuModel.preset`."""
UNIT_RATE = 0.1
"""Rate of the rotations whose flow is fitted to the true one [rad/s]."""
KNOWN_BIAS_DEG_S = 0.5
"""Bias error below which a bias counts as found [deg/s]; the gyroscope's bias has a standard deviation of 3 deg/s."""


class _Row(TypedDict):
    stream: Literal["gyroscope", "AMI-EV, turn to turn", "true flow", "no motion", *Stream]  # type: ignore[valid-type]
    turns: Amount
    rate_error: Amount
    drift: Amount
    bias_error: Amount
    gyroscope_angle: Amount


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]


def conditions(settings: Settings) -> list[Condition]:
    """Return the room at rest, and in slow and fast motion; in full also the desk."""
    return stereo_conditions(settings)


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return the errors of each source of rates, over the length of the windows."""
    gyroscope = Gyroscope.of(streams)
    turn_us = 60e6 / streams.condition.rpm
    rows: list[dict[str, Any]] = []
    for turns in TURNS:
        windows = max(1, round((streams.end_us - streams.start_us) / (turns * turn_us)))
        ends = np.linspace(streams.start_us, streams.end_us, windows + 1)
        ends_us = np.rint(ends).astype(np.int64)
        sources = _sources(streams, gyroscope, ends_us)
        if turns == 1.0 and windows > 1:
            sources[TURN_TO_TURN] = _turn_to_turn(streams, ends_us)
        for name, source in sources.items():
            bias = np.zeros(3)
            if name != GYROSCOPE:
                bias = np.median(gyroscope.mean_rates(source.ends_us) - source.rates, axis=0)
            errors = rate_errors(source, bias, gyroscope)
            rows.append({"stream": name, "turns": turns, **errors})
    return {"rows": rows}


@dataclass(frozen=True, eq=False)
class Rates:
    """Mean angular velocities of a camera in its own frame, between successive times."""

    ends_us: NDArray[np.int64]
    """These times [us], shape (n + 1,)."""
    rates: NDArray[np.float64]
    """Mean rates [rad/s], shape (n, 3)."""

    def end(self) -> Any:
        """Return the rotation to which the rates add up, as a SciPy ``Rotation``."""
        from scipy.spatial.transform import Rotation

        whole = Rotation.identity()
        for turn in Rotation.from_rotvec(self.rates * 1e-6 * np.diff(self.ends_us)[:, None]):
            whole = whole * turn
        return whole


@dataclass(frozen=True, eq=False)
class Gyroscope:
    """Gyroscope that moves with a camera, in the camera's frame."""

    samples: ImuSamples
    """Samples."""
    bias: NDArray[np.float64]
    """True bias, the mean over the recording [rad/s], shape (3,)."""
    trajectory: Trajectory
    """Path of the camera."""

    @classmethod
    def of(cls, streams: Streams) -> Gyroscope:
        """Simulate the gyroscope that moves with the camera of streams."""
        scene = streams.simulation.scene
        assert isinstance(scene, WorldScene)
        model = ImuModel.preset(IMU)
        samples = replace(streams.simulation, imu=model).imu_samples()
        # The same random numbers without noise and rounding: the bias alone, added to the truth
        exact = replace(model, gyroscope_noise=0.0, bits=0)
        biased = replace(streams.simulation, imu=exact).imu_samples()
        true = replace(streams.simulation, imu=ImuModel(rate_hz=model.rate_hz)).imu_samples()
        assert samples is not None
        assert biased is not None
        assert true is not None
        bias = (biased.angular_velocity - true.angular_velocity).mean(axis=0)
        return cls(samples, bias, scene.trajectory)

    def mean_rates(self, ends_us: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return its mean rates between successive times [rad/s], shape (n, 3)."""
        return mean_rates(self.samples.t, self.samples.angular_velocity, ends_us)


def rate_errors(source: Rates, bias: NDArray[np.float64], gyroscope: Gyroscope) -> dict[str, float]:
    """Return the errors of rates and of the gyroscope less a ``bias`` [rad/s], as values of a row [deg/s and deg]."""
    true = true_rates(gyroscope.trajectory, source.ends_us)
    distance = np.linalg.norm(source.rates - true.rates, axis=1)
    seconds = 1e-6 * float(source.ends_us[-1] - source.ends_us[0])
    angle = (source.end().inv() * true.end()).magnitude()

    times = gyroscope.samples.t
    whole = Rates(times, gyroscope.mean_rates(times) - bias)
    true_end = true_rates(gyroscope.trajectory, times[[0, -1]]).end()
    errors = {
        "rate_error": np.sqrt(np.mean(distance**2)),
        "drift": angle / seconds,
        "bias_error": np.linalg.norm(bias - gyroscope.bias),
        "gyroscope_angle": (whole.end().inv() * true_end).magnitude(),
    }
    return {name: float(np.degrees(value)) for name, value in errors.items()}


def mean_rates(
    t_us: NDArray[np.int64], rates: NDArray[np.float64], ends_us: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the means of sampled rates between successive times, shape (n, 3). Between samples the angle grows evenly.

    ``t_us``: times of the samples [us]; ``ends_us``: the successive times [us], shape (n + 1,).
    """
    seconds = 1e-6 * t_us
    angles = cumulative_trapezoid(rates, seconds, axis=0, initial=0)
    ends = 1e-6 * ends_us
    at_ends = np.stack([np.interp(ends, seconds, angle) for angle in angles.T], axis=1)
    return np.asarray(np.diff(at_ends, axis=0) / np.diff(ends)[:, None])


def true_rates(trajectory: Trajectory, ends_us: NDArray[np.int64]) -> Rates:
    """Return the mean rates of a camera between successive times."""
    from scipy.spatial.transform import Rotation

    ends = 1e-6 * ends_us
    matrices, _ = trajectory.poses(ends)
    turns = Rotation.from_matrix(np.swapaxes(matrices[:-1], 1, 2) @ matrices[1:])
    return Rates(ends_us, np.asarray(turns.as_rotvec() / np.diff(ends)[:, None]))


def _sources(
    streams: Streams, gyroscope: Gyroscope, ends_us: NDArray[np.int64]
) -> dict[str, Rates]:
    """Return the rates in the windows between successive times, by the names of their sources."""
    rates = {GYROSCOPE: gyroscope.mean_rates(ends_us)}
    for stream in streams.names:
        if stream not in LEFT_OUT:
            rates[stream.value] = _rates_of_events(streams, stream, ends_us)
    rates[TRUE_FLOW] = _rates_of_flow(streams, ends_us)
    rates[NO_MOTION] = np.zeros((len(ends_us) - 1, 3))
    return {name: Rates(ends_us, found) for name, found in rates.items()}


def _rates_of_events(
    streams: Streams, stream: Stream, ends_us: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the angular velocity that the events of each window show [rad/s], shape (n, 3)."""
    rates = []
    for start, end in pairwise(ends_us.tolist()):
        found = estimate_rotation(streams.window(stream, start, end), streams.camera)
        rates.append(found.angular_velocity)
    return np.array(rates)


def _turn_to_turn(streams: Streams, ends_us: NDArray[np.int64]) -> Rates:
    """Return the rates from each turn to the next, between the middles of the turns. ``ends_us``: ends of the turns."""
    encoder = streams.recording.encoder
    assert encoder is not None
    rates = []
    for start, _, end in zip(ends_us, ends_us[1:], ends_us[2:], strict=False):
        events = streams.window(Stream.RAW, int(start), int(end))
        rates.append(estimate_rates(events, encoder, streams.camera))
    middles = (ends_us[:-1] + ends_us[1:]) // 2
    return Rates(middles, np.reshape(rates, (-1, 3)))


def _rates_of_flow(streams: Streams, ends_us: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the angular velocity that fits the true flow in the middle of each window [rad/s], shape (n, 3)."""
    rates = []
    for start, end in pairwise(ends_us.tolist()):
        truth = streams.frame((start + end) // 2)
        edges = edge_pixels(truth) & np.isfinite(truth.flow).all(axis=-1)
        rates.append(fitted_rate(streams.camera, truth.flow, edges))
    return np.array(rates)


def fitted_rate(
    camera: Camera, flow: NDArray[np.floating], where: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the angular velocity [rad/s] that fits an optical flow [px/s] best, in the least squares of its pixels.

    The flow of a rotation is a linear function of its rate.
    """
    flows = []
    for x, y, z in (UNIT_RATE * np.eye(3)).tolist():
        flows.append(rotation_flow(camera, CameraRotation((x, y, z)))[where].ravel())
    share, *_ = np.linalg.lstsq(np.stack(flows, axis=1), flow[where].ravel(), rcond=None)
    return np.asarray(UNIT_RATE * share)


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the errors of all sources of rates with windows of a whole turn, and those over the window's length."""
    rows = rows_of(results, "rows")
    whole_turns = where(rows, turns=1.0)
    names = ("scene", "camera", "stream")
    rate = ("rate error [deg/s]", "std", "drift [deg/s]", "std of drift")
    bias = (
        "bias error [deg/s]",
        "std",
        "angle error of the gyroscope [deg]",
        "std of the angle error",
    )

    def chart(y: str) -> Chart:
        return Chart(
            "camera", y, "stream", "std", panels=("scene",), kind=ChartKind.BARS, log_y=True
        )

    return [
        Table(
            "inertial_rate",
            "Angular velocity from events, and from the gyroscope, windows of a turn",
            (*names, "seeds", *rate),
            grouped(whole_turns, names, ["rate_error", "drift"]),
            "The gyroscope's own error is its bias. At rest 'no motion' is right, but a camera that sees noise alone "
            "cannot tell that it rests. An error of 0 has no bar.",
            chart(rate[0]),
        ),
        Table(
            "inertial_bias",
            "Bias of the gyroscope, found from events in windows of a turn",
            (*names, "seeds", *bias),
            grouped(whole_turns, names, ["bias_error", "gyroscope_angle"]),
            "For the gyroscope alone the error is its bias, and nothing is taken off. The angle is the one after the "
            "whole recording.",
            chart(bias[0]),
        ),
        Table(
            "inertial_window",
            "Angular velocity over the length of the window",
            (*names, "window [turns]", "seeds", *rate),
            grouped(rows, (*names, "turns"), ["rate_error", "drift"]),
            "A longer window holds more events, but a camera in fast motion does not keep its rate.",
        ),
    ]


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return our checks: the paper does not evaluate this."""
    rows = where(rows_of(results, "rows"), turns=1.0)
    checks = []
    for motion, text in (
        ("still", "At rest"),
        ("handheld", "With a handheld camera"),
        ("fast", "With a fast camera"),
    ):
        moving = [row for row in rows if row["camera"] == motion]
        for source in (Stream.CALIBRATED, TURN_TO_TURN):
            checks += _checks(moving, text, source)
    return checks


def _checks(rows: Sequence[dict[str, Any]], motion: str, source: str) -> list[Claim]:
    """Judge the rates of a source in one motion of the camera, with windows of a whole turn."""
    ours = {"stream": source}
    return [
        judge(
            None,
            f"{motion}, '{source}' finds the gyroscope's bias to {KNOWN_BIAS_DEG_S:g} deg/s.",
            differences(rows, "bias_error", ours),
            f"the bias error of '{source}'",
            below=KNOWN_BIAS_DEG_S,
            unit="deg/s",
        ),
        judge(
            None,
            f"{motion}, the rate error of '{source}' is smaller than the error of '{Stream.PLAIN}'.",
            differences(rows, "rate_error", ours, {"stream": Stream.PLAIN}),
            f"the rate error of '{source}' less the error of '{Stream.PLAIN}'",
            below=0.0,
            unit="deg/s",
        ),
        judge(
            None,
            f"{motion}, the gyroscope less the bias that '{source}' finds has a smaller angle error than alone.",
            differences(rows, "gyroscope_angle", ours, {"stream": GYROSCOPE}),
            f"the angle error of the gyroscope with the bias of '{source}' less the error without",
            below=0.0,
            unit="deg",
        ),
    ]
