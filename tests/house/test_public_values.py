"""Public functions, classes and methods with any values: a result, or an AmiwarpError of one line."""

from __future__ import annotations

import contextlib
import copy
import inspect
import itertools
import math
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
from numpy.typing import NDArray

import amiwarp
from amiwarp import (
    AmiwarpError,
    Camera,
    Encoder,
    Events,
    ExactModel,
    FlatSide,
    MemoryEvents,
    Prism,
    RecordingWriter,
    RigWriter,
    UnsizedPrism,
    open_recording,
)
from amiwarp.events.encoder import LARGEST_ANGLE
from amiwarp.events.recording import check_events
from amiwarp.io import LiveWriter
from amiwarp.optics.camera import LARGEST_FOCAL
from amiwarp.schema.calls import guarded
from amiwarp.validation import TIME_LIMIT, shown
from tests.public_calls import (
    CALIBRATION,
    CAMERA,
    FRAME,
    PICTURE,
    RECORDING,
    REFUSED,
    SPACE,
    PublicCall,
    public_calls,
    write_files,
)


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


HOSTILE: list[Any] = [
    None, True, False, "", "scene", "nothing", "1.5", "a\0b", b"1", 1j, math.nan, math.inf, -math.inf, 1e300, -1e300,
    1e-300, 5e-324, 0.5, 10**400, -(10**400), 10**5000, 2**62, -(2**63), 2**64, 2**70, -1, 0, [], {}, (),
    object(), Odd(), Camera, Fraction(1, 3), nested(200), nested(5000), [1, "a"], [None], [[1], [2, 3]], [math.nan],
    {"a": None}, {1: 2}, {1.5}, (1, 2, 3, 4, 5), range(3),
    np.float32(1.5), np.float64(math.nan), np.int64(3), np.uint16(7), np.bool_(True), np.str_("scene"),
    np.datetime64("2020"), np.array(2.0), np.array([math.nan, 1.0]), np.array([None, 3], object), np.array(["a"]),
    np.array([1 + 2j]), np.zeros((2, 2)), np.zeros(0), np.arange(3, dtype=np.int64), np.array([-(2**63), 2**63 - 1]),
    np.array([1e300, 2.0]), np.array([0.0, 10.0]), np.zeros((3, 4, 2)), np.ma.masked_array([1, 2], [0, 1]),
]  # fmt: skip
"""Values of every wrong kind: one of them fits each parameter at most."""


def use(result: Any) -> None:
    """Read what a result holds: the first items of an iterator, and the properties of an object."""
    if isinstance(result, Iterator):
        for _ in itertools.islice(result, 2):
            pass
    kind = type(result)
    if kind.__module__.startswith("amiwarp"):
        for name in (name for name in dir(kind) if not name.startswith("_")):
            if isinstance(inspect.getattr_static(kind, name), property):
                with contextlib.suppress(AmiwarpError):
                    getattr(result, name)
        if hasattr(kind, "check"):
            result.check()


def outcome(call: PublicCall, **changed: Any) -> str:
    """Call a function, and return its error message; empty if there is none."""
    thing, function = call.target()
    try:
        use(function(**{**call.arguments(), **changed}))
    except AmiwarpError as error:
        return str(error)
    finally:
        if isinstance(thing, RecordingWriter | RigWriter):
            thing.__exit__(ValueError, None, None)
    return ""


CALLS = list(public_calls())


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The files that the calls read, not to be written to."""
    folder = tmp_path_factory.mktemp("calls")
    with contextlib.chdir(folder):
        write_files()
    return list(folder.iterdir())


@pytest.fixture
def folder(files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a folder with copies of the files that the calls read the current one."""
    monkeypatch.chdir(tmp_path)
    for file in files:
        if file.is_dir():
            shutil.copytree(file, tmp_path / file.name)
        else:
            shutil.copy(file, tmp_path)

    def no_display(remedy: str) -> None:
        raise AmiwarpError(remedy)

    # Else a window opens for each call
    monkeypatch.setattr("amiwarp.viewer.handle.check_display", no_display)


@pytest.mark.parametrize("call", CALLS, ids=lambda call: call.label)
@pytest.mark.usefixtures("folder")
def test_public_calls_return_or_say_what_is_wrong(call: PublicCall) -> None:
    if call.label == "Network.quarter_turn":
        pytest.importorskip("torch")
    message = outcome(call)
    assert (REFUSED[call.label] in message) if call.label in REFUSED else (message == "")
    for name, annotation in call.parameters().items():
        for junk in HOSTILE:
            if isinstance(junk, type) and re.search("Callable|Progress", annotation):
                continue  # a class can be called
            if (
                (call.label, name) == ("evaluate", "only")
                and isinstance(junk, list | tuple)
                and not len(junk)
            ):
                continue  # runs every evaluation
            before = copy.deepcopy(junk) if isinstance(junk, np.ndarray) else None
            try:
                message = outcome(call, **{name: junk})
            except Exception as error:
                raise AssertionError(
                    f"{call.label}({name}={shown(junk)}) ends in {type(error).__name__}"
                ) from error
            assert "\n" not in message
            assert len(message) < 1000
            assert f"{name} is unknown" not in message
            if before is not None:
                np.testing.assert_array_equal(junk, before)


POINTS = (
    "compensate_points",
    "deflect_points",
    "compensate_at",
    "rotations",
    "SteererModel.added",
    "all_angles",
)
MEANT: dict[tuple[str, str], str] = {
    ("FrameTruth", "depth"): "infinite",
    **{
        ("FrameTruth", f"{what}{seen}"): "NaN"
        for what in ("flow", "displacement")
        for seen in ("", "_with_prism")
    },
    ("Truth.known_at", "xy"): "NaN",
    ("edge_blur", "sharp_xy"): "NaN",
    **{("DepthMap", name): "NaN" for name in ("inverse_depth", "points")},
    **{("PixelMap", name): "NaN" for name in ("on", "off", "on_std", "off_std")},
    ("Camera.pixels_to_rays", "xy"): "NaN",
    ("Camera.rays_to_pixels", "rays"): "NaN",
    **{("EllipseModel", name): "NaN" for name in ("offset", "cosine", "sine")},
    **{("EllipseModel.fit", name): "NaN" for name in ("xy", "theta", "compensated")},
    ("Parameter", "limits"): "infinite",
    ("Picture", "log"): "not checked",
    ("Picture", "unknowns"): "not checked",
}
"""Parameters for which NaN or infinity means something, and a word of the description that says so. The functions of
points, whose names are :data:`POINTS`, give NaN for them."""


def spoiled(value: Any, bad: float) -> Iterator[Any]:
    """Yield the value with one of its floating numbers replaced, if it has any."""
    if isinstance(value, float | np.floating):
        yield bad
    elif isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.size:
        changed = value.copy()
        changed.flat[value.size // 2] = bad
        yield changed
    elif isinstance(value, dict | list | tuple):
        for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
            for changed in spoiled(entry, bad):
                if isinstance(value, dict):
                    yield {**value, key: changed}
                else:
                    yield type(value)([*value[:key], changed, *value[key + 1 :]])


def described(call: PublicCall) -> str:
    """Return the description of a public function, method or class, with those of a class's fields."""
    thing, function = call.target()
    if isinstance(thing, RecordingWriter | RigWriter):
        thing.__exit__(ValueError, None, None)
    return (
        inspect.getsource(function) if inspect.isclass(function) else str(inspect.getdoc(function))
    )


@pytest.mark.parametrize(
    "call", [call for call in CALLS if call.label not in REFUSED], ids=lambda call: call.label
)
@pytest.mark.usefixtures("folder")
def test_nan_and_infinity_are_refused_or_have_a_meaning(call: PublicCall) -> None:
    if call.label == "Network.quarter_turn":
        pytest.importorskip("torch")
    thing, function = call.target()
    given = call.arguments()
    if isinstance(thing, RecordingWriter | RigWriter):
        thing.__exit__(ValueError, None, None)
    for name, one in inspect.signature(function).parameters.items():
        for bad in (math.nan, math.inf, -math.inf):
            for changed in spoiled(given.get(name, one.default), bad):
                message = outcome(call, **{name: changed})
                if message:
                    continue
                word = "NaN" if call.label.endswith(POINTS) else MEANT.get((call.label, name))
                assert word is not None, f"{call.label} takes {name} with {bad}"
                assert word in described(call), f"{call.label}: {name}"


def test_truth_is_of_whole_numbers_and_finite_poses(tmp_path: Path) -> None:
    size = CAMERA.height, CAMERA.width
    for name in ("instance", "occlusion", "occlusion_with_prism"):
        with pytest.raises(AmiwarpError, match=f"truth's {name} is float64; give uint"):
            replace(FRAME, **{name: np.full(size, math.nan)})
    with (
        pytest.raises(AmiwarpError, match="mask at 0 us is float64; give truth values"),
        RecordingWriter(tmp_path / "a.h5", width=size[1], height=size[0]) as writer,
    ):
        writer.append_known(0, np.full(size, math.nan))
    pose = np.array([[0.0, 0, 0, 0, 0, 0, 1]])
    for where in ("bodies", "joints"):
        table = np.full((1, 7), math.nan) if where == "bodies" else np.full((1, 3), math.inf)
        with pytest.raises(AmiwarpError, match=r"poses of 'hand' hold (nan|inf) \(number 0\)"):
            amiwarp.Poses(np.array([0]), pose, **{where: {"hand": table}})


FRACTIONS = {"PrismMotion.angle", "PrismMotion.angles", "Trajectory", "Trajectory.poses"}
"""Calls whose times may have fractions: motions are functions of the time."""


@pytest.mark.parametrize("call", CALLS, ids=lambda call: call.label)
@pytest.mark.usefixtures("folder")
def test_masked_values_and_times_in_seconds_are_refused(call: PublicCall) -> None:
    thing, _ = call.target()
    given = call.arguments()
    if isinstance(thing, RecordingWriter | RigWriter):
        thing.__exit__(ValueError, None, None)
    for name, annotation in call.parameters().items():
        if "Array" not in annotation or name not in given:
            continue
        values = np.asarray(given[name])
        masked = np.ma.masked_array(
            values, np.arange(values.size).reshape(values.shape) == values.size - 1
        )
        assert "masked" in outcome(call, **{name: masked}), name
        if re.fullmatch("t|t_us|times_us|index_t_us", name) and call.label not in FRACTIONS:
            assert re.search("whole|int64", outcome(call, **{name: values * 1e-6 + 0.1})), name


@pytest.mark.parametrize("call", CALLS, ids=lambda call: call.label)
@pytest.mark.usefixtures("folder")
def test_unknown_keywords_and_too_many_arguments(call: PublicCall) -> None:
    _, function = call.target()
    with pytest.raises((TypeError, AmiwarpError), match="nothing_like_it"):
        function(**call.arguments(), nothing_like_it=1)
    with pytest.raises((TypeError, AmiwarpError)):
        function(*[None] * 30)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            lambda: amiwarp.calibrate("rec.h5"),
            "calibrate: recording is 'rec.h5'; expected Recording; open it with",
        ),
        (
            lambda: amiwarp.calibrate(RECORDING, modle="exact"),
            "calibrate: setting modle is unknown; did you mean m",
        ),
        (
            lambda: amiwarp.calibrate(RECORDING, {"model": "exact"}),
            "settings is {'model'.*expected Settings or None",
        ),
        (
            lambda: amiwarp.translate("a.mp4", Prism(0.02), sede=1),
            "translate: setting sede is unknown; did you mean",
        ),
        (
            lambda: amiwarp.calibrate(RECORDING, device="gpu"),
            "device is 'gpu'; expected a device of this machine.*cpu",
        ),
        (lambda: RECORDING.encoder.angle_at(math.nan), "nan|NaN|whole"),
        (lambda: amiwarp.World(1.0, ()), "World|world"),
        (
            lambda: amiwarp.Recording(RECORDING.events, "davis"),
            "Recording: camera is 'davis'; expected Camera or None",
        ),
        (lambda: amiwarp.Camera(CAMERA), "missing"),
        (lambda: amiwarp.event_count(RECORDING.events, 4, 3), r"give its events, source\[:\]"),
        (
            lambda: amiwarp.Compensator(CALIBRATION, RECORDING.encoder),
            "give its model, calibration.model",
        ),
        (lambda: amiwarp.truth_model(RECORDING, RECORDING), "give its camera, recording.camera"),
        (
            lambda: amiwarp.save_recording(RECORDING, "a.h5"),
            r"amiwarp.save_recording\(path, recording\)",
        ),
        (lambda: amiwarp.Encoder([0, 1], [0.0, 0.1]), "make arrays of lists, with numpy.array"),
        (lambda: Events(*np.ones((4, 2), np.int64)), "amiwarp.Events.from_arrays converts"),
        (
            lambda: amiwarp.calibrate(amiwarp.Recording(RECORDING.events)),
            r"in Python dataclasses.replace\(recording, camera=amiwarp.Camera.from_fov",
        ),
    ],
)
def test_common_mistakes(wrong: Callable[[], Any], message: str) -> None:
    with pytest.raises((AmiwarpError, TypeError), match=message):
        wrong()


def test_a_misspelt_name_is_refused_with_what_python_needs_to_suggest_one() -> None:
    with pytest.raises(
        AttributeError, match="module 'amiwarp' has no attribute 'voxelgrid'"
    ) as caught:
        amiwarp.voxelgrid  # noqa: B018
    assert (caught.value.name, caught.value.obj) == ("voxelgrid", amiwarp)


def test_long_objects_print_on_one_line() -> None:
    imu = amiwarp.ImuSamples(np.arange(3) * 1000, np.zeros((3, 3)), np.zeros((3, 3)))
    assert repr(imu) == "ImuSamples(3 samples, t 0 .. 2000 us, 1000 Hz)"
    assert repr(amiwarp.ImuSamples(np.arange(1), np.zeros((1, 3)), np.zeros((1, 3)))) == (
        "ImuSamples(1 sample, t 0 .. 0 us)"
    )
    cut = amiwarp.windows(RECORDING.events[:], count=1)
    assert repr(cut) == "Windows(3 windows, 3 events, t 0 .. 900 us)"
    assert (repr(cut[:1]), repr(cut[:0])) == (
        "Windows(1 window, 1 event, t 0 .. 0 us)",
        "Windows(0 windows)",
    )
    assert repr(PICTURE) == "Picture(4x3 px, t 0 .. 10 us, 4 pairs, residual 0.1)"


NOT_CALLED = {
    "NominalPrism": "use Prism, UnsizedPrism or Plate",
    "Distortion": "use RadialTangential or Fisheye",
    "Pictures": "use PictureFolder, PictureStack or VideoFile",
    "MetadataValue": "use str, int, float or bool",
    "Progress": r"give a function of \(str, float\)",
    "EventSource": "wrap events as amiwarp.MemoryEvents",
    "EventValues": "a NumPy array",
    "PointStore": "a NumPy array",
    "FrameStore": "simulate",
    "KnownStore": "translate",
    "PoseStore": "amiwarp.Poses",
    "ImageStore": "amiwarp.MemoryImages",
    "Frames": "amiwarp.Scene.from_picture",
    "Model": "amiwarp.ExactModel",
}
"""Public names of types that users annotate with or derive from, and what a call of them says."""


@pytest.mark.parametrize("name", amiwarp.PUBLIC_NAMES)
def test_names_that_are_not_called_say_what_is(name: str) -> None:
    public = getattr(amiwarp, name)
    made = isinstance(public, type) and not getattr(public, "_is_protocol", False)
    if name in NOT_CALLED:
        for arguments in ((), (1, "two")):
            with pytest.raises(
                AmiwarpError, match=f"{name} is a type for annotations.*; .*{NOT_CALLED[name]}"
            ):
                public(*arguments)
    else:
        assert made or inspect.isfunction(public) or name == "__version__"


def test_names_of_unions_serve_in_checks_and_annotations() -> None:
    named, union = amiwarp.NominalPrism, Prism | UnsizedPrism | amiwarp.Plate
    assert isinstance(Prism(0.02), named)
    assert not isinstance(CAMERA, named)
    assert issubclass(amiwarp.Plate, named)
    assert not issubclass(Camera, named)
    assert (named | None, None | named, named | int) == (union | None, None | union, union | int)
    assert named is amiwarp.NominalPrism

    def use(one: amiwarp.NominalPrism, other: amiwarp.Progress | None) -> None: ...

    assert get_type_hints(use)["one"] is named
    assert repr(named) == "amiwarp.NominalPrism"

    class Own(amiwarp.EventSource):
        def __init__(self, count: int) -> None:
            self.count = count

        def __len__(self) -> int:
            return self.count

    assert len(Own(3)) == 3


def test_the_name_of_a_function_type_serves_in_checks() -> None:
    assert isinstance(print, amiwarp.Progress)
    assert not isinstance(3, amiwarp.Progress)
    assert issubclass(type(print), amiwarp.Progress)
    assert not issubclass(int, amiwarp.Progress)


@pytest.mark.usefixtures("folder")
def test_one_word_does_as_a_tuple_of_it() -> None:
    """One text or path is neither taken for its letters nor refused for its type, in any public call."""
    seen = set()
    for call in CALLS:
        for name, annotation in call.parameters().items():
            if re.match(r"tuple\[str, \.\.\.|Sequence\[str", annotation):
                seen.add(f"{call.label}.{name}")
                for word in ("apex", Path("apex")):
                    assert outcome(call, **{name: word}) == outcome(call, **{name: (word,)})
    assert seen >= {"Settings.free", "Settings.stages", "evaluate.only", "evaluate.recordings"}
    labels = amiwarp.WorldLabels("room", "wall", amiwarp.Cause.SIGNAL)
    assert (labels.instances, labels.categories) == (("wall",), ("signal",))
    assert SPACE.without("apex").names == ()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda t: amiwarp.Poses(t, np.zeros((3, 7))),
            r"pose 2 \(5 us\) is not later than the one before",
        ),
        (
            lambda t: amiwarp.Encoder(t, np.zeros(3)),
            r"encoder sample 2 \(5 us\) is not later than the one before",
        ),
        (
            lambda t: amiwarp.PictureFolder((Path("a.png"),) * 3, t, (4, 3)),
            r"picture 2 \(5 us\) is not later than",
        ),
        (
            lambda t: amiwarp.Poses(t[:2], np.zeros((3, 7))),
            r"'camera' have shape \(3, 7\) for 2 times; .* \(2, 7\)",
        ),
        (
            lambda t: amiwarp.Poses(t[:2], np.zeros((2, 7)), {"b": np.zeros((2, 3))}),
            r"'b' have shape \(2, 3\)",
        ),
        (
            lambda t: amiwarp.Poses(t[:2], np.zeros((2, 7)), {}, {"j": np.zeros((2, 7))}),
            r"'j' have shape \(2, 7\)",
        ),
        (
            lambda t: amiwarp.PictureFolder((Path("a.png"),) * 2, t[1:], (4, 3)),
            "int64 times from 5 on; give .* at 0",
        ),
        (
            lambda t: amiwarp.PictureFolder((Path("a.png"),) * 2, t[:2], (4, 3), 0.5),
            "start_us = 0.5 is not a whole",
        ),
        (
            lambda t: amiwarp.MemoryImages(t[1::-1], np.zeros((2, 3, 4), np.uint8)),
            "give ordered int64 times",
        ),
        (
            lambda t: amiwarp.VideoFile(Path("v.mp4"), (4, 3), 30.0, math.nan),
            "duration_us = nan is not",
        ),
        (
            lambda t: amiwarp.VideoFile(Path("v.mp4"), (4, 0), 30.0, 1.0),
            "size of the frames = 0 is not",
        ),
    ],
)
def test_times_and_shapes_of_records(make: Callable[[Any], Any], message: str) -> None:
    with pytest.raises(AmiwarpError, match=message):
        make(np.array([0, 5, 5]))


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
        Camera(
            **{
                "width": 240,
                "height": 180,
                "fx": 200.0,
                "fy": 200.0,
                "cx": 1.0,
                "cy": 1.0,
                **values,
            }
        )


def test_numpy_s_numbers_become_plain_ones() -> None:
    camera = Camera(
        np.int64(240), np.uint16(180), np.float32(200), np.int8(100), np.float64(3), np.array(4.0)
    )
    assert camera == Camera(240, 180, 200.0, 100.0, 3.0, 4.0)
    assert {type(value) for value in (camera.width, camera.height)} == {int}
    assert {type(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)} == {float}


@pytest.mark.parametrize("focal", [0.24, 200.0, LARGEST_FOCAL])
def test_float32_holds_the_promised_focal_lengths(focal: float) -> None:
    """Pixel to ray and back returns the pixel at both ends of the documented range."""
    camera = Camera(240, 240, focal, focal, 119.5, 119.5)
    xy = np.array([[119.0, 120.0], [30.0, 200.0], [0.0, 239.0]])
    np.testing.assert_allclose(
        camera.rays_to_pixels(camera.pixels_to_rays(xy)), xy, rtol=0, atol=0.01
    )


def test_a_prism_that_reflects_the_axial_ray_says_so() -> None:
    steep = Prism(math.radians(29.9), 3.9)
    with pytest.raises(AmiwarpError, match="reflects the camera's axial ray"):
        _ = steep.deflection


@pytest.mark.parametrize(
    "size", [(70000, 5), (5, 70000), (0, 5), (5.0, 5), (None, 5), (5, True), (math.nan, 5)]
)
def test_frames_that_uint16_cannot_index(size: tuple[Any, Any]) -> None:
    with pytest.raises(AmiwarpError, match=r"frame size = .* is not a whole number in 1 .. 65536"):
        MemoryEvents(Events.empty(), *size)


def test_polarities_that_are_taken() -> None:
    for p, expected in (
        ([0, 1], [0, 1]), ([-1, 1], [0, 1]), ([False, True], [0, 1]), ([0.0, 1.0], [0, 1]), ([-1.0, -1.0], [0, 0]),
    ):  # fmt: skip
        assert Events.from_arrays([0, 0], [0, 0], [0, 1], p).p.tolist() == expected
    for wrong in ([math.nan, 1.0], ["0", "1"], [None, 1], [1j, 0]):
        with pytest.raises(AmiwarpError, match="events' p"):
            Events.from_arrays([0, 0], [0, 0], [0, 1], wrong)


@pytest.mark.parametrize(
    ("p", "message"),
    [
        ([1, 0.2, 0], r"holds 0\.2 \(number 1\); expected 1 for ON, and 0 or -1 for OFF$"),
        ([1.0, 0.0, 1e30], r"holds 1e\+30 \(number 2\)"),
        ([math.inf, 0.0, 1.0], r"holds inf \(number 0\)"),
        ([0.0, -math.inf, 1.0], r"holds -inf \(number 1\)"),
        ([1.0, 0.0, math.nan], r"holds nan \(number 2\)"),
        (
            np.array([0, 255, 255], np.uint8),
            r"holds 255 \(number 1\); .*; if ON is 255 and OFF is 0, give p > 0",
        ),
        (np.array([0, 1, 2], np.uint16), r"holds 2 \(number 2\)"),
        (np.array([0, 1, 2**63], np.uint64), r"holds 9223372036854775808 \(number 2\)"),
        ([1, -2, 0], r"holds -2 \(number 1\)"),
        ([1, 1, 0, -1], r"holds -1 \(number 3\), but also 0; OFF is either 0 or -1"),
        ([1, -1, 0, -1], r"holds 0 \(number 2\), but also -1; OFF is either 0 or -1"),
    ],
)
def test_polarities_of_unknown_coding_are_refused(p: Any, message: str) -> None:
    place, t = np.arange(len(p)), np.arange(len(p))
    row = np.zeros(len(p), [("t", "i8"), ("x", "u2"), ("y", "u2"), ("p", np.asarray(p).dtype)])
    row["p"] = p
    for make in (
        lambda: Events.from_arrays(place, place, t, p),
        lambda: amiwarp.DeviceEvents.from_arrays(place, place, t, p),
        lambda: Events.from_structured(row),
    ):
        with pytest.raises(AmiwarpError, match=f"events' p {message}"):
            make()


def test_coordinates_that_are_taken() -> None:
    nowhere = Events.from_arrays([math.nan, 1.0], [0.5, math.nan], [0, 1], [0, 1])
    assert len(MemoryEvents(nowhere, 4, 3)) == 2
    for wrong in ([math.inf, 1.0], [1e300, 1.0]):
        with pytest.raises(AmiwarpError, match="too large for float32"):
            Events.from_arrays(wrong, [0.0, 0.0], [0, 1], [0, 1])
    infinite = Events(
        np.array([1, np.inf], np.float32), np.zeros(2, np.float32), nowhere.t, nowhere.p
    )
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


def test_equations_without_a_solution_are_a_plain_error() -> None:
    @guarded
    def solve(matrix: NDArray[np.float64]) -> Any:
        return np.linalg.inv(matrix)

    with pytest.raises(
        AmiwarpError, match=r"solve: a system of equations has no solution \(Singular matrix\)"
    ):
        solve(np.zeros((2, 2)))


def test_an_unsized_prism_has_a_valid_index() -> None:
    for index in (1.0, 4.0, math.nan):
        with pytest.raises(AmiwarpError, match="prism index"):
            UnsizedPrism(index=index)
    assert UnsizedPrism(index=1.6, flat_side="camera").with_apex(0.03) == Prism(
        0.03, 1.6, FlatSide.CAMERA
    )


def test_a_tilt_lies_below_a_right_angle() -> None:
    below = math.nextafter(math.pi / 2.0, 0.0)
    assert ExactModel(CAMERA, Prism(0.03), tilt=(below, -below)).tilt == (below, -below)
    for tilt in ((math.pi / 2.0, 0.0), (0.0, -math.pi / 2.0), (0.1,)):
        with pytest.raises(AmiwarpError, match="tilt"):
            ExactModel(CAMERA, Prism(0.03), tilt=tilt)  # type: ignore[arg-type]
