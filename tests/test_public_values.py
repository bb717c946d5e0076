"""Public constructors with any values: a valid object or an AmiwarpError of one line; arrays are not changed."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amiwarp.calib import Settings
from amiwarp.errors import AmiwarpError
from amiwarp.events.checks import TIME_LIMIT, check_events
from amiwarp.events.encoder import LARGEST_ANGLE, Encoder
from amiwarp.events.events import Events, MemoryEvents
from amiwarp.io import RecordingWriter, open_recording
from amiwarp.io.live_writer import LiveWriter
from amiwarp.optics.camera import LARGEST_FOCAL, Camera
from amiwarp.optics.circle_models import CircleModel, RadialCircleModel
from amiwarp.optics.ellipse_model import EllipseModel
from amiwarp.optics.exact_model import ExactModel
from amiwarp.optics.lens import Fisheye, RadialTangential
from amiwarp.optics.prism import FlatSide, Prism, UnsizedPrism
from amiwarp.simulation.motion import CameraMotion, EncoderModel, PrismMotion
from amiwarp.simulation.scene import Scene
from amiwarp.simulation.sensor import SensorModel
from amiwarp.simulation.simulator import Simulation

CAMERA = Camera.from_fov(4, 3, 1.0)
TABLE = np.zeros((3, 4, 2), np.float32)
STILL = Scene.from_picture(np.ones((4, 4), np.float32))


class Odd:
    """A value of an unknown class, whose conversion to text and comparisons fail."""

    def __repr__(self) -> str:
        raise RuntimeError("no text")

    def __eq__(self, other: object) -> bool:
        raise RuntimeError("not comparable")

    __hash__ = None  # type: ignore[assignment]


def nested(depth: int) -> list[Any]:
    out: list[Any] = []
    for _ in range(depth):
        out = [out]
    return out


JUNK = st.one_of(
    st.sampled_from(
        [None, True, False, "", "scene", "1.5", b"1", 1j, math.nan, math.inf, -math.inf, 1e300, -1e300, 1e-300, 5e-324,
         10**400, -(10**400), 10**5000, 2**62, -(2**63), 2**64, -1, 0, 65536, 65537, [], {}, (), object, Odd(),
         Fraction(1, 3), nested(200), nested(5000), [1, "a"], [[1], [2, 3]], {"a": 1}, range(3)]
    ),
    st.sampled_from(
        [np.float32(1.5), np.float64(math.nan), np.int64(3), np.uint16(7), np.bool_(True), np.str_("scene"),
         np.datetime64("2020"), np.array(2.0), np.array([math.nan, 1.0]), np.array([None, 3], object),
         np.array(["a"]), np.array([1 + 2j]), np.zeros((2, 2)), np.zeros(0), np.arange(3, dtype=np.int64),
         np.array([-(2**63), 2**63 - 1]), np.array([1e300, 2.0]), np.array([0.0, 10.0]), np.zeros((3, 4, 2))]
    ),
    st.floats(),
    st.integers(-(2**70), 2**70),
    st.text(max_size=5),
    st.lists(st.floats() | st.integers() | st.none() | st.text(max_size=2), max_size=5),
)  # fmt: skip


@dataclass(frozen=True)
class Door:
    """A public constructor and valid arguments."""

    make: Callable[..., Any]
    good: dict[str, Any]


MADE = np.array([0, 1000], np.int64), np.array([0.0, 0.1])
DOORS = [
    Door(Camera, {"width": 4, "height": 3, "fx": 3.0, "fy": 3.0, "cx": 1.5, "cy": 1.0, "distortion": None}),
    Door(Camera.from_fov, {"width": 4, "height": 3, "fov": 1.0, "distortion": None}),
    Door(RadialTangential, {"k1": 0.1, "k2": 0.1, "p1": 0.0, "p2": 0.0, "k3": 0.0}),
    Door(Fisheye, {"k1": 0.1, "k2": 0.1, "k3": 0.0, "k4": 0.0}),
    Door(Prism, {"apex": 0.02, "index": 1.5, "flat_side": "scene"}),
    Door(UnsizedPrism, {"index": 1.5, "flat_side": "scene"}),
    Door(CircleModel, {"camera": CAMERA, "deflection": 0.01, "phase": 0.0, "flat_side": "scene"}),
    Door(RadialCircleModel, {"camera": CAMERA, "deflection": 0.01, "phase": 0.0, "index": 1.5, "flat_side": "scene"}),
    Door(ExactModel, {"camera": CAMERA, "prism": Prism(0.02), "phase": 0.0, "tilt": (0.0, 0.0)}),
    Door(EllipseModel, {"camera": CAMERA, "offset": TABLE, "cosine": TABLE, "sine": TABLE, "phase": 0.0}),
    Door(PrismMotion, {"rpm": 720.0, "phase": 0.0, "tilt": (0.0, 0.0)}),
    Door(lambda **g: PrismMotion.from_function(lambda t: g["rpm"], g["duration_s"]), {"rpm": 720.0, "duration_s": 0.1}),
    Door(CameraMotion, {"rates": (0.0, 0.0, 0.0)}),
    Door(EncoderModel, {"counts_per_turn": 100, "rate_hz": 1e3, "jitter_us": 1.0, "clock_offset_us": 0.0,
                        "dropouts_hz": 0.0, "dropout_us": 1.0}),
    Door(SensorModel, {"contrast_on": 0.2, "contrast_off": 0.2, "mismatch": 0.0, "refractory_us": 1.0,
                       "latency_us": 1.0, "latency_jitter_us": 1.0, "leak_hz": 0.0, "shot_noise_hz": 0.0,
                       "hot_fraction": 0.0, "hot_hz": 0.0, "cutoff_hz": 300.0, "shot_noise_dark": 4.0,
                       "leak_jitter_fraction": 0.1, "noise_rate_cov_decades": 0.1, "row_us": 1.0,
                       "bus_rate_mev_s": 10.0, "bus_queue": 100.0}),
    Door(SensorModel.preset, {"name": "gen4"}),
    Door(Scene, {"frames": STILL.frames, "fov": None, "blur": 0.5}),
    Door(Simulation, {"scene": STILL, "camera": CAMERA, "prism": Prism(0.02), "duration_s": 0.1,
                      "motion": PrismMotion(), "camera_motion": CameraMotion(), "sensor": SensorModel(),
                      "encoder_model": EncoderModel(), "nominal_prism": None, "seed": 0}),
    Door(Events.from_arrays, {"x": [1], "y": [2], "t": [3], "p": [1]}),
    Door(Events, {"x": np.zeros(1, np.uint16), "y": np.zeros(1, np.uint16), "t": np.zeros(1, np.int64),
                  "p": np.zeros(1, np.uint8)}),
    Door(MemoryEvents, {"events": Events.from_arrays([1], [2], [3], [1]), "width": 4, "height": 3}),
    Door(Encoder, {"t": MADE[0], "angle": MADE[1], "clock_offset_us": 0.0, "index_t": None}),
    Door(Encoder.from_angles, {"t_us": MADE[0], "angle": MADE[1], "clock_offset_us": 0.0}),
    Door(lambda **g: Encoder(*MADE).with_index(g["pulses"]), {"pulses": [500]}),
    Door(Encoder.constant_speed, {"rpm": 720.0, "t_first": 0, "t_last": 1000, "interval_us": 1000}),
    Door(lambda **g: Settings(**g).check(), {
        "model": "exact", "sharpness": "variance", "global_algorithm": None, "stages": ("sharpness",), "events": 100,
        "global_evaluations": 10, "tolerance_px": 0.01, "smoothing_px": 1.0, "fold": 0, "seed": 0,
        "start": {"apex": 0.02}, "bounds": {"apex": (0.0, 0.1)},
    }),
]  # fmt: skip


@pytest.mark.parametrize("door", DOORS, ids=lambda door: getattr(door.make, "__qualname__", "?"))
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_valid_object_or_one_line(door: Door, data: st.DataObject) -> None:
    door.make(**door.good)
    name = data.draw(st.sampled_from(list(door.good)))
    junk = data.draw(JUNK)
    before = copy.deepcopy(junk) if isinstance(junk, np.ndarray) else None
    said = ""
    try:
        door.make(**{**door.good, name: junk})
    except AmiwarpError as error:
        said = str(error)
    assert "\n" not in said
    assert len(said) < 1000
    if before is not None:
        np.testing.assert_array_equal(junk, before)


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ({"width": math.nan}, "width = nan"),
        ({"width": 1.5}, "width = 1.5 is not a whole number"),
        ({"width": True}, "width = True"),
        ({"height": 65537}, "height = 65537 is not a whole number in 1 .. 65536"),
        ({"fx": 1e300}, "fx = 1e\\+300"),
        ({"fy": 1e-300}, "fy = 1e-300"),
        ({"fx": 10**400}, "fx = 1000"),
        ({"cx": 1e9}, "cx = 1000000000.0"),
        ({"cy": None}, "cy = None"),
    ],
)
def test_cameras_that_no_one_has(values: dict[str, Any], what: str) -> None:
    with pytest.raises(AmiwarpError, match=what):
        Camera(**{"width": 240, "height": 180, "fx": 200.0, "fy": 200.0, "cx": 1.0, "cy": 1.0, **values})


def test_numpy_s_numbers_become_plain_ones() -> None:
    camera = Camera(np.int64(240), np.uint16(180), np.float32(200), np.int8(100), np.float64(3), np.array(4.0))
    assert camera == Camera(240, 180, 200.0, 100.0, 3.0, 4.0)
    assert {type(value) for value in (camera.width, camera.height)} == {int}
    assert {type(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)} == {float}


@pytest.mark.parametrize("focal", [0.24, 200.0, LARGEST_FOCAL])
def test_float32_holds_the_promised_focal_lengths(focal: float) -> None:
    """Pixel to ray and back returns the pixel at both ends of the documented range."""
    camera = Camera(240, 240, focal, focal, 119.5, 119.5)
    xy = np.array([[119.0, 120.0], [30.0, 200.0], [0.0, 239.0]])
    np.testing.assert_allclose(camera.rays_to_pixels(camera.pixels_to_rays(xy)), xy, rtol=0, atol=0.01)


def test_a_prism_that_reflects_the_axial_ray_says_so() -> None:
    steep = Prism(math.radians(29.9), 3.9)
    with pytest.raises(AmiwarpError, match="reflects the camera's axial ray"):
        _ = steep.deflection


@pytest.mark.parametrize("size", [(70000, 5), (5, 70000), (0, 5), (5.0, 5), (None, 5), (5, True), (math.nan, 5)])
def test_frames_that_uint16_cannot_index(size: tuple[Any, Any]) -> None:
    with pytest.raises(AmiwarpError, match=r"frame size = .* is not a whole number in 1 .. 65536"):
        MemoryEvents(Events.empty(), *size)


def test_polarities_that_are_taken() -> None:
    for p, expected in (([0, 1], [0, 1]), ([-1, 1], [0, 1]), ([False, True], [0, 1]), ([0.0, 1.0], [0, 1])):
        assert Events.from_arrays([0, 0], [0, 0], [0, 1], p).p.tolist() == expected
    for wrong in ([math.nan, 1.0], ["0", "1"], [None, 1], [1j, 0]):
        with pytest.raises(AmiwarpError, match="events' p"):
            Events.from_arrays([0, 0], [0, 0], [0, 1], wrong)


def test_coordinates_that_are_taken() -> None:
    nowhere = Events.from_arrays([math.nan, 1.0], [0.5, math.nan], [0, 1], [0, 1])
    assert len(MemoryEvents(nowhere, 4, 3)) == 2
    for wrong in ([math.inf, 1.0], [1e300, 1.0]):
        with pytest.raises(AmiwarpError, match="too large for float32"):
            Events.from_arrays(wrong, [0.0, 0.0], [0, 1], [0, 1])
    infinite = Events(np.array([1, np.inf], np.float32), np.zeros(2, np.float32), nowhere.t, nowhere.p)
    with pytest.raises(AmiwarpError, match=r"event 1 \(x=inf.* infinite"):
        MemoryEvents(infinite, 4, 3)


def late(t: list[int]) -> Events:
    none = np.zeros(len(t), np.uint16)
    return Events(none, none, np.array(t, np.int64), np.zeros(len(t), np.uint8))


@pytest.mark.parametrize("t", [[-(2**63), 0], [-TIME_LIMIT, 0], [0, TIME_LIMIT], [0, 2**63 - 1]])
def test_times_beyond_the_limit_are_refused_by_all_writers(t: list[int], tmp_path: Any) -> None:
    events = late(t)
    with pytest.raises(AmiwarpError, match=f"has a time beyond {TIME_LIMIT} us"):
        check_events(events, 4, 3, where="here")
    with pytest.raises(AmiwarpError, match="time beyond"):
        MemoryEvents(events, 4, 3)
    with (
        pytest.raises(AmiwarpError, match=r"a\.h5: event . .* time beyond"),
        RecordingWriter(tmp_path / "a.h5", width=4, height=3) as writer,
    ):
        writer.append(events)
    with LiveWriter(tmp_path / "b.h5", width=4, height=3) as live:
        with pytest.raises(AmiwarpError, match=r"b\.h5: event . .* time beyond"):
            live.append(events)
        live.append(late([1, 2]))
    assert [path.name for path in tmp_path.iterdir()] == ["b.h5"]
    assert open_recording(tmp_path / "b.h5").events.t_first == 1


@pytest.mark.parametrize("first", [-TIME_LIMIT + 1, TIME_LIMIT - 3])
def test_a_recording_at_the_limit_of_time_opens_again(first: int, tmp_path: Any) -> None:
    with RecordingWriter(tmp_path / "a.h5", width=4, height=3) as writer:
        writer.append(late([first, first + 1, first + 2]))
    source = open_recording(tmp_path / "a.h5").events
    assert (source.t_first, source.t_last) == (first, first + 2)
    assert source.slice(0, 3).t.tolist() == [first, first + 1, first + 2]


@pytest.mark.parametrize(
    ("t", "angle", "message"),
    [
        ([0, 1], [0.0, 1e300], "sample 1 has angle 1e\\+300"),
        ([0, 1], [0.0, 1.01 * LARGEST_ANGLE], "within 1e\\+10 rad"),
        ([0, 1], [math.nan, 0.0], "sample 0 has angle nan"),
        ([-(2**63), 1], [0.0, 0.1], "beyond"),
        ([0, 2**63 - 1], [0.0, 0.1], "beyond"),
    ],
)
def test_encoders_beyond_the_limits(t: list[int], angle: list[float], message: str) -> None:
    with pytest.raises(AmiwarpError, match=message):
        Encoder(np.array(t, np.int64), np.array(angle))


def test_an_unsized_prism_has_a_valid_index() -> None:
    for index in (1.0, 4.0, math.nan):
        with pytest.raises(AmiwarpError, match="prism index"):
            UnsizedPrism(index=index)
    assert UnsizedPrism(index=1.6, flat_side="camera").with_apex(0.03) == Prism(0.03, 1.6, FlatSide.CAMERA)
