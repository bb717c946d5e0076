"""Events and images in arrays of other libraries: shared by pointer, equal to the host's results, safe on streams."""

from __future__ import annotations

import gc
import math
import os
import subprocess
import sys
import weakref
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

import amiwarp
from amiwarp import (
    AmiwarpError,
    Camera,
    Compensator,
    DeviceEvents,
    DeviceMemoryEvents,
    EllipseModel,
    Encoder,
    EncoderStream,
    Events,
    ExactModel,
    MemoryEvents,
    Prism,
    Recording,
    Scene,
    Simulation,
    validation,
)
from amiwarp.events.device_columns import converted, import_array

WIDTH, HEIGHT = 64, 48
CAMERA, PRISM = Camera.from_fov(WIDTH, HEIGHT, math.radians(60)), Prism(math.radians(2.0))
MODEL = ExactModel.from_prism(CAMERA, PRISM, 0.4)
ENCODER = Encoder.constant_speed(720.0, 0, 100_000)
NAMES = ("x", "y", "t", "p")
SHARED = [("numpy", "cpu"), ("warp", "cpu"), ("torch", "cpu")]
SHARED += [(library, "cuda:0") for library in ("warp", "torch", "cupy", "jax")]
"""Libraries and the devices on which they share arrays."""


def random_events(n: int = 5000, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    x, y = (rng.integers(0, size, n).astype(np.uint16) for size in (WIDTH, HEIGHT))
    return Events(
        x, y, np.sort(rng.integers(0, 100_000, n)), rng.integers(0, 2, n).astype(np.uint8)
    )


def foreign(library: str, device: str, values: np.ndarray) -> Any:
    """Return a copy of values as an array of a library. Without the library or the device, the test is skipped."""
    if device != "cpu" and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    if library == "warp":
        return wp.array(values, dtype=wp.dtype_from_numpy(values.dtype), device=device)
    if library == "torch":
        return pytest.importorskip("torch").from_numpy(values.copy()).to(device)
    if library == "cupy":
        return pytest.importorskip("cupy").asarray(values)
    if library == "jax":
        # Leave memory to the other libraries
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
        jax = pytest.importorskip("jax")
        jax.config.update("jax_enable_x64", True)
        try:
            return jax.device_put(values, jax.devices("gpu")[0])
        except RuntimeError:
            pytest.skip("JAX finds no GPU")
    return values.copy()


def pointer(array: Any) -> int:
    if isinstance(array, PlainArray):
        return pointer(array.values)
    for name in ("ptr", "data_ptr", "unsafe_buffer_pointer"):
        if hasattr(array, name):
            found = getattr(array, name)
            return int(found() if callable(found) else found)
    return int(array.ctypes.data if isinstance(array, np.ndarray) else array.data.ptr)


def as_columns(library: str, device: str, events: Events) -> dict[str, Any]:
    return {name: foreign(library, device, getattr(events, name)) for name in NAMES}


def falling(device: str) -> DeviceEvents:
    """Return two events on a device, of which the second is earlier than the first."""
    columns = zip(
        ([1, 1], [1, 1], [5, 4], [0, 1]), (wp.uint16, wp.uint16, wp.int64, wp.uint8), strict=True
    )
    return DeviceEvents(
        *(wp.array(values, dtype=dtype, device=device) for values, dtype in columns)
    )


def on_device(events: Events, device: str) -> DeviceEvents:
    return DeviceEvents.from_arrays(events.x, events.y, events.t, events.p, device=device)


def assert_equal(found: Events, expected: Events) -> None:
    for name in NAMES:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


# -- arrays in


@pytest.mark.parametrize(("library", "device"), SHARED)
def test_events_share_the_memory_of_the_arrays(library: str, device: str) -> None:
    host = random_events()
    given = as_columns(library, device, host)
    events = DeviceEvents.from_arrays(**given)
    assert {name: getattr(events, name).ptr for name in NAMES} == {
        name: pointer(given[name]) for name in NAMES
    }
    assert str(events.device) == device
    assert_equal(events.to_host(), host)


@pytest.mark.parametrize(("library", "device"), SHARED)
def test_truth_values_share_their_memory_as_polarities(library: str, device: str) -> None:
    host = random_events()
    p = foreign(library, device, host.p > 0)
    events = DeviceEvents.from_arrays(**{**as_columns(library, device, host), "p": p})
    assert events.p.ptr == pointer(p)
    assert_equal(events.to_host(), host)


@pytest.mark.parametrize("library", ["numpy", "warp", "torch"])
@pytest.mark.parametrize("truth", [False, True])
def test_numpy_events_share_the_memory_of_arrays_on_the_host(library: str, truth: bool) -> None:
    host = random_events()
    given = as_columns(library, "cpu", host)
    if truth:
        given["p"] = foreign(library, "cpu", host.p > 0)
    events = Events.from_arrays(**given)
    assert {name: pointer(getattr(events, name)) for name in NAMES} == {
        n: pointer(given[n]) for n in NAMES
    }
    assert_equal(events, host)


class PlainArray:
    """An array of a library that offers nothing but DLPack."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __dlpack__(self, **options: Any) -> Any:
        return self.values.__dlpack__(**options)

    def __dlpack_device__(self) -> tuple[int, int]:
        return self.values.__dlpack_device__()


def test_dlpack_alone_is_enough() -> None:
    host = random_events()
    given = {name: PlainArray(getattr(host, name)) for name in NAMES}
    for kind in (Events, DeviceEvents):
        events = kind.from_arrays(**given)
        assert {name: pointer(getattr(events, name)) for name in NAMES} == {
            n: pointer(getattr(host, n)) for n in NAMES
        }


def test_events_from_numpy_move_to_a_device(device: str) -> None:
    events = on_device(random_events(), device)
    assert str(events.device) == device
    assert_equal(events.to_host(), random_events())


COPIED = {
    "x": [np.arange(4, dtype=np.int32), np.array([0.0, np.nan, 1.5, -2.0])],
    "y": [np.arange(4, dtype=np.int64)],
    "t": [np.array([-3, 0, 5, 7], np.int32), np.array([0.0, 1.0, 2.0, 1e15])],
    "p": [np.array([-1, 1, -1, 1], np.int8), np.array([0.0, 1.0, 0.0, 1.0])],
}


@pytest.mark.parametrize("name", NAMES)
def test_other_types_are_converted_on_the_device_as_on_the_host(name: str, device: str) -> None:
    for values in COPIED[name]:
        plain = {"x": [0] * 4, "y": [0] * 4, "t": [0] * 4, "p": [0] * 4}
        pair = {"x": values, "y": values} if name in "xy" else {name: values}
        expected = getattr(Events.from_arrays(**{**plain, **pair}), name)
        given = wp.array(values, dtype=wp.dtype_from_numpy(values.dtype), device=device)
        found = converted(name, given)
        assert found.numpy().dtype == expected.dtype
        np.testing.assert_array_equal(found.numpy(), expected)
        np.testing.assert_array_equal(given.numpy(), values)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("x", np.array([0, 65536], np.int32), "x holds a coordinate outside 0 .. 65535"),
        ("y", np.array([0, -1], np.int64), "y holds a coordinate outside 0 .. 65535"),
        ("x", np.array([0.0, 1e300]), "x holds a coordinate that float32 cannot hold"),
        ("t", np.array([0.0, np.nan]), "t is not finite"),
        ("t", np.array([0.0, -(2.0**62)]), "t is not finite"),
        ("p", np.array([0.0, np.nan]), r"p holds nan \(number 1\)"),
    ],
)
def test_values_that_do_not_fit_are_refused_on_the_device(
    name: str, values: np.ndarray, message: str, device: str
) -> None:
    with pytest.raises(AmiwarpError, match=message):
        converted(name, wp.array(values, dtype=wp.dtype_from_numpy(values.dtype), device=device))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"x": [1]}, "expected one length"),
        ({"x": [[1, 2], [3, 4]]}, "expected one length"),
        ({"x": [-1, 2]}, "expected pixels in 0 .. 65535"),
        ({"x": [np.inf, 2.0], "y": [1.0, 2.0]}, "infinite coordinate|too large for float32"),
        ({"x": [1.0, 2.0]}, "both uint16.* or both float32"),
        ({"t": [0.0, np.nan]}, "not finite"),
        ({"t": [0, 2**62]}, "expected microseconds"),
        ({"p": [0.0, np.nan]}, r"p holds nan \(number 1\)"),
        ({"y": ["a", "b"]}, "expected numbers"),
        ({"y": None}, "expected numbers"),
    ],
)
@pytest.mark.parametrize("kind", [Events, DeviceEvents])
def test_bad_arrays_are_refused(kind: Any, changed: dict[str, Any], message: str) -> None:
    given = {"x": [1, 2], "y": [1, 2], "t": [0, 1], "p": [0, 1], **changed}
    with pytest.raises(AmiwarpError, match=message):
        kind.from_arrays(**given)


@pytest.mark.parametrize("kind", [Events, DeviceEvents])
def test_tensors_that_cannot_be_shared_are_refused(kind: Any) -> None:
    torch = pytest.importorskip("torch")
    for tensor, message in (
        (torch.ones(2, requires_grad=True), "x cannot be read as an array.*detach"),
        (torch.ones(2, dtype=torch.bfloat16), "expected numbers"),
    ):
        with pytest.raises(AmiwarpError, match=message):
            kind.from_arrays(tensor, tensor, [0, 1], [0, 1])


def test_device_arrays_of_other_types_are_refused() -> None:
    with pytest.raises(AmiwarpError, match="x has values of type vec2f"):
        import_array(wp.zeros(3, dtype=wp.vec2), "events' x")
    x, t, p = wp.zeros(3, dtype=wp.uint16), wp.zeros(3, dtype=wp.int64), wp.zeros(3, dtype=wp.uint8)
    with pytest.raises(AmiwarpError, match=r"int32.*expected x and y both uint16"):
        DeviceEvents(x, x, wp.zeros(3, dtype=wp.int32), p)
    with pytest.raises(AmiwarpError, match="gaps"):
        DeviceEvents(wp.zeros(6, dtype=wp.uint16)[::2], x, t, p)
    with pytest.raises(AmiwarpError, match=r"DeviceEvents: x is array.*expected warp\.array"):
        DeviceEvents(np.zeros(3, np.uint16), x, t, p)


@pytest.mark.parametrize("library", ["torch", "cupy"])
def test_arrays_on_cpu_and_cuda_are_refused(library: str) -> None:
    host = random_events()
    given = {**as_columns(library, "cuda:0", host), "p": host.p}
    with pytest.raises(AmiwarpError, match=r"on devices .*cuda:0.*put them on one device"):
        DeviceEvents.from_arrays(**given)
    assert_equal(DeviceEvents.from_arrays(**given, device="cuda:0").to_host(), host)
    with pytest.raises(AmiwarpError, match="x is on a GPU; copy it to the host"):
        Events.from_arrays(**given)
    with pytest.raises(AmiwarpError, match="events are on cuda:0, device is cpu"):
        amiwarp.iwe(DeviceEvents.from_arrays(**given, device="cuda:0"), WIDTH, HEIGHT, device="cpu")


@pytest.fixture
def all_on_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """The host's memory counts as a GPU's, so that the way of arrays on a GPU runs on a CPU too."""
    monkeypatch.setattr(validation, "HOST_MEMORY", ())


@pytest.mark.usefixtures("all_on_gpu")
@pytest.mark.parametrize("library", ["warp", "torch", "plain"])
def test_arrays_on_a_gpu_are_read_through_dlpack_alone(library: str) -> None:
    host = random_events()
    given = (
        {n: PlainArray(getattr(host, n)) for n in NAMES}
        if library == "plain"
        else as_columns(library, "cpu", host)
    )
    events = DeviceEvents.from_arrays(**given)
    found = {name: getattr(events, name).ptr for name in NAMES}
    assert found == {name: pointer(values) for name, values in given.items()}
    assert_equal(events.to_host(), host)
    with pytest.raises(AmiwarpError, match="x is on a GPU; copy it to the host"):
        Events.from_arrays(**given)


@pytest.mark.usefixtures("all_on_gpu")
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"x": np.array([1.0, np.inf], np.float32), "y": np.ones(2, np.float32)},
            "infinite coordinate",
        ),
        ({"x": np.array([1, -1])}, "x holds a coordinate outside"),
        ({"t": np.array([0, 2**62])}, "expected microseconds within"),
        ({"t": np.array([0, 1, 2])}, "expected one length"),
        ({"x": np.ones((2, 1), np.int64)}, "expected one length"),
        ({"p": np.ones(2, complex)}, "p cannot be read through DLPack: .*complex"),
    ],
)
def test_bad_arrays_on_a_gpu_are_refused(changed: dict[str, np.ndarray], message: str) -> None:
    plain = {
        "x": np.ones(2, np.uint16),
        "y": np.ones(2, np.uint16),
        "t": np.arange(2),
        "p": np.ones(2, np.uint8),
    }
    with pytest.raises(AmiwarpError, match=message):
        DeviceEvents.from_arrays(
            **{name: PlainArray(values) for name, values in {**plain, **changed}.items()}
        )


@pytest.mark.usefixtures("all_on_gpu")
@pytest.mark.parametrize(
    ("values", "dtype", "wrong"),
    [
        ([0, 1, 1, 0], np.uint8, ""),
        ([-1, 1, 1, -1], np.int8, ""),
        ([-1.0, 1.0, 1.0, -1.0], np.float32, ""),
        ([0.0, 1.0, 1.0, 0.0], np.float64, ""),
        ([0, 1, 2, 3], np.uint8, r"holds 2 \(number 2\)"),
        ([0, 1, 255, 0], np.uint8, r"holds 255 \(number 2\); .*give p > 0"),
        ([1, 0, -1, 0], np.int16, r"holds -1 \(number 2\), but also 0"),
        ([1, -1, -1, 0], np.int64, r"holds 0 \(number 3\), but also -1"),
        ([0.2, 1, 0, 0], np.float64, r"holds 0.2 \(number 0\)"),
        ([1, 1e30, 0, 0], np.float64, r"holds 1e\+30 \(number 1\)"),
        ([1, 0, 0, np.inf], np.float64, r"holds inf \(number 3\)"),
        ([1, np.nan, 0, 0], np.float32, r"holds nan \(number 1\)"),
    ],
)
def test_polarities_on_a_gpu_are_of_a_known_coding(
    values: list[float], dtype: type, wrong: str
) -> None:
    given = [PlainArray(np.arange(4).astype(kind)) for kind in (np.uint16, np.uint16, np.int64)]
    p = PlainArray(np.array(values, dtype))
    if wrong:
        with pytest.raises(AmiwarpError, match=f"events' p {wrong}"):
            DeviceEvents.from_arrays(*given, p)
    else:
        assert DeviceEvents.from_arrays(*given, p).p.numpy().tolist() == [
            int(value > 0) for value in values
        ]


def test_arrays_with_gaps_are_copied(device: str) -> None:
    host = random_events()
    wide = {n: np.repeat(getattr(host, n), 2) for n in NAMES}
    given = {
        n: wp.array(v, dtype=wp.dtype_from_numpy(v.dtype), device=device)[::2]
        for n, v in wide.items()
    }
    assert not given["x"].is_contiguous
    assert_equal(DeviceEvents.from_arrays(**given).to_host(), host)
    assert import_array(given["x"], "x").is_contiguous


def test_arrays_are_kept_alive_and_released() -> None:
    host = random_events()
    x = host.x.copy()
    reference = weakref.ref(x)
    events = DeviceEvents.from_arrays(x, host.y, host.t, host.p)
    part = events[10:20]
    del x, events
    gc.collect()
    assert reference() is not None
    np.testing.assert_array_equal(part.x.numpy(), host.x[10:20])
    del part
    gc.collect()
    assert reference() is None


def test_slices_and_joins_of_device_events(device: str) -> None:
    host = random_events()
    events = on_device(host, device)
    parts = [events[:100], events[100:100], events[100:]]
    assert parts[0].t.ptr == events.t.ptr
    assert_equal(DeviceEvents.concatenate(parts).to_host(), host)
    assert (events[5:].t_first, events[:-5].t_last) == (host.t[5], host.t[-6])
    assert len(events[7:3]) == len(events[9999:]) == 0
    with pytest.raises(AmiwarpError, match="no first or last time"):
        _ = events[:0].t_first
    with pytest.raises(AmiwarpError, match="steps of 2"):
        events[::2]
    with pytest.raises(AmiwarpError, match="give at least one"):
        DeviceEvents.concatenate([])


def test_no_array_library_is_needed() -> None:
    script = (
        "import sys, amiwarp; e = amiwarp.DeviceEvents.from_arrays([1], [2], [3], [1]); amiwarp.iwe(e, 4, 4);"
        "print('loaded:', *[m for m in ('torch', 'cupy', 'jax') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "loaded:"


# -- results


@pytest.mark.parametrize("options", [{}, {"per_polarity": True, "pad": 3}, {"vote": "nearest"}])
@pytest.mark.parametrize("compensated", [False, True])
def test_images_on_a_device_are_those_of_the_host(
    compensated: bool, options: dict[str, Any], device: str
) -> None:
    host = random_events()
    if compensated:
        options = {**options, "model": MODEL, "encoder": ENCODER}
    image = amiwarp.iwe(on_device(host, device), WIDTH, HEIGHT, **options)
    expected = amiwarp.iwe(host, WIDTH, HEIGHT, device=device, **options)
    assert (str(image.device), image.is_contiguous) == (device, True)
    np.testing.assert_array_equal(image.numpy(), expected)
    assert expected.sum() > len(host) / 2
    assert amiwarp.sharpness(image) == amiwarp.sharpness(expected, device=device)


def test_compensated_coordinates_on_a_device_are_images_again(device: str) -> None:
    host = random_events(5001)
    xy = amiwarp.compensate_events(on_device(host, device), MODEL, ENCODER)
    expected = amiwarp.compensate_events(host, MODEL, ENCODER, device=device)
    np.testing.assert_array_equal(xy.numpy(), expected)
    moved = on_device(Events(expected[:, 0].copy(), expected[:, 1].copy(), host.t, host.p), device)
    assert not moved.whole_pixels
    np.testing.assert_array_equal(
        amiwarp.iwe(moved, WIDTH, HEIGHT).numpy(),
        amiwarp.iwe(moved.to_host(), WIDTH, HEIGHT, device=device),
    )
    with pytest.raises(AmiwarpError, match="already compensated"):
        amiwarp.compensate_events(moved, MODEL, ENCODER)


def test_events_outside_the_sensor_on_a_device(device: str) -> None:
    """The ellipse model reads a table of the pixels; events outside must not be looked up in it."""
    host = random_events()
    host = Events(host.x + np.uint16(WIDTH), host.y, host.t, host.p)
    model = EllipseModel.from_prism(CAMERA, PRISM, 0.4)
    found = amiwarp.compensate_events(on_device(host, device), model, ENCODER)
    np.testing.assert_array_equal(
        found.numpy(), amiwarp.compensate_events(host, model, ENCODER, device=device)
    )


def test_no_events_on_a_device(device: str) -> None:
    none = on_device(Events.empty(), device)
    assert amiwarp.iwe(none, WIDTH, HEIGHT, model=MODEL, encoder=ENCODER).numpy().sum() == 0.0
    assert amiwarp.compensate_events(none, MODEL, ENCODER).shape == (0, 2)
    assert len(DeviceEvents.concatenate([none, none])) == 0


def reader(library: str) -> Any:
    """Return the function with which a library reads arrays through DLPack."""
    return pytest.importorskip({"jax": "jax.dlpack"}.get(library, library)).from_dlpack


def assert_shared(library: str, result: wp.array) -> None:
    """Check that a library reads a result through DLPack without a copy, with the same values."""
    shared = reader(library)(result)
    assert pointer(shared) == result.ptr
    assert tuple(shared.shape) == result.shape
    on_host = (
        shared.cpu().numpy()
        if library == "torch"
        else shared.get()
        if library == "cupy"
        else shared
    )
    np.testing.assert_array_equal(np.asarray(on_host), result.numpy())


@pytest.mark.parametrize(
    ("library", "device"), [case for case in SHARED if case[0] not in ("numpy", "warp")]
)
def test_other_libraries_share_the_memory_of_results(library: str, device: str) -> None:
    host = random_events()
    events = DeviceEvents.from_arrays(**as_columns(library, device, host))
    image = amiwarp.iwe(events, WIDTH, HEIGHT, model=MODEL, encoder=ENCODER)
    xy = amiwarp.compensate_events(events, MODEL, ENCODER)
    read = reader(library)
    for result in (image, xy, events.x):
        assert_shared(library, result)
    expected = amiwarp.sharpness(image.numpy(), smoothing=1.0, device=device)
    assert amiwarp.sharpness(read(image), smoothing=1.0) == expected
    assert amiwarp.sharpness(read(image).T.T, smoothing=1.0) == expected


def test_sharpness_refuses_bad_images_on_a_device(device: str) -> None:
    for shape in ((4,), (3, 4, 4), (0, 4), (1, 2, 4, 4)):
        with pytest.raises(AmiwarpError, match=r"expected \(height, width\)"):
            amiwarp.sharpness(wp.zeros(shape, dtype=float, device=device))
    for value in (np.nan, np.inf, -np.inf):
        image = np.ones((4, 5), np.float32)
        image[1, 2] = value
        with pytest.raises(AmiwarpError, match="not finite"):
            amiwarp.sharpness(wp.array(image, dtype=float, device=device))
    whole = wp.array(np.arange(20).reshape(4, 5), dtype=wp.int32, device=device)
    assert amiwarp.sharpness(whole) == amiwarp.sharpness(whole.numpy(), device=device)


def test_arrays_given_are_not_modified(device: str) -> None:
    host = random_events()
    events = on_device(Events(*(getattr(host, name).copy() for name in NAMES)), device)
    amiwarp.iwe(events, WIDTH, HEIGHT, model=MODEL, encoder=ENCODER, per_polarity=True)
    amiwarp.compensate_events(events, MODEL, ENCODER)
    source = DeviceMemoryEvents(events, WIDTH, HEIGHT)
    amiwarp.reconstruct(Recording(source, CAMERA, ENCODER, PRISM), model=MODEL)
    compensator = Compensator(MODEL, streamed(ENCODER), device=device)
    compensator.put(events, 0)
    assert len(compensator.take_on_device(2**62)) == 1
    assert_equal(events.to_host(), host)


# -- the simulator, sources and streams


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    picture = np.kron(
        np.random.default_rng(1).uniform(0.05, 1.0, (24, 32)), np.ones((4, 4))
    ).astype(np.float32)
    return Simulation(scene=Scene.from_picture(picture), camera=CAMERA, prism=PRISM, duration_s=0.1)


def test_simulated_events_stay_on_the_device(simulation: Simulation, device: str) -> None:
    simulation = replace(simulation, device=device)
    on_host = list(simulation.blocks(chunk_us=30_000))
    blocks = list(simulation.device_blocks(chunk_us=30_000))
    assert len(blocks) == len(on_host) == 4
    for (events, points), (expected, expected_points) in zip(blocks, on_host, strict=True):
        assert str(events.device) == device
        assert_equal(events.to_host(), expected)
        np.testing.assert_array_equal(points.numpy(), expected_points)
    assert sum(len(events) for events, _ in blocks) > 5000


def test_a_simulated_recording_stays_on_the_device(simulation: Simulation, device: str) -> None:
    """Over more than one chunk of simulated time."""
    simulation = replace(simulation, duration_s=0.6, device=device)
    expected, found = simulation.run(), simulation.run(on_device=True)
    n = len(expected.events)
    assert isinstance(found.events, DeviceMemoryEvents)
    assert (len(found.events), str(found.events.device)) == (n, device)
    assert_equal(found.events.slice(0, n), expected.events.slice(0, n))
    for start, stop in ((0, n), (5, 70), (n, n + 5)):
        for values, others in zip(
            truth_of(found, start, stop), truth_of(expected, start, stop), strict=True
        ):
            np.testing.assert_array_equal(values, others, strict=True)
    assert found.truth is not None
    assert expected.truth is not None
    assert found.truth.parameters == expected.truth.parameters
    np.testing.assert_array_equal(found.encoder.angle, expected.encoder.angle)  # type: ignore[union-attr]


def truth_of(recording: Recording, start: int, stop: int) -> tuple[Any, Any]:
    assert recording.truth is not None
    truth = recording.truth.of_events(start, stop)
    return truth.points, truth.cause


@pytest.mark.parametrize(("library", "device"), [case for case in SHARED if case[0] != "warp"])
def test_libraries_share_the_memory_of_simulated_events_and_pictures(
    simulation: Simulation, library: str, device: str
) -> None:
    foreign(library, device, np.zeros(1))  # skips without the library or the device
    recording = replace(simulation, device=device).run(on_device=True)
    assert isinstance(recording.events, DeviceMemoryEvents)
    events = recording.events.slice_on_device(0, len(recording.events))
    picture = amiwarp.reconstruct(recording, model=MODEL)
    for result in (
        events.x,
        events.y,
        events.t,
        events.p,
        picture.log,
        picture.known,
        picture.intensity(),
    ):
        assert str(result.device) == device
        assert_shared(library, result)
    views = recording.events.slice_on_device(0, 10), recording.events.between_on_device(-1, 2**40)
    assert {view.t.ptr for view in views} == {events.t.ptr}


def test_no_simulated_event_leaves_a_cuda_device(
    simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    sizes, to_host = [0], wp.array.numpy
    monkeypatch.setattr(
        wp.array, "numpy", lambda array: (sizes.append(array.size), to_host(array))[1]
    )
    recording = replace(simulation, device="cuda:0").run(on_device=True)
    assert max(sizes) < 10_000 < len(recording.events)  # tables of the scene are smaller


def test_functions_take_recordings_on_a_device(simulation: Simulation, device: str) -> None:
    simulation = replace(simulation, device=device)
    expected, found = simulation.run(), simulation.run(on_device=True)
    assert isinstance(found.events, DeviceMemoryEvents)
    n = len(found.events)
    host, events = expected.events.slice(0, n), found.events.slice_on_device(0, n)
    given = {"model": MODEL, "encoder": found.encoder}
    image = amiwarp.iwe(events, WIDTH, HEIGHT, **given)
    np.testing.assert_array_equal(
        image.numpy(), amiwarp.iwe(host, WIDTH, HEIGHT, device=device, **given)
    )
    assert found.encoder is not None
    compensator = Compensator(MODEL, streamed(found.encoder), device=device)
    compensator.put(events, 0)
    [packet] = compensator.take_on_device(2**62)
    xy = amiwarp.compensate_events(host, MODEL, found.encoder, device=device)
    np.testing.assert_array_equal(
        np.stack([packet.events.x.numpy(), packet.events.y.numpy()], axis=1), xy
    )


def test_calibration_takes_a_recording_on_a_device(recording: Recording, device: str) -> None:
    host = recording.events.slice(0, len(recording.events))
    moved = replace(
        recording, events=DeviceMemoryEvents(on_device(host, device), *recording.events.size)
    )
    found, expected = (
        amiwarp.calibrate(r, model="circle", stages=("sharpness",)) for r in (moved, recording)
    )
    assert found.parameters == expected.parameters


@pytest.mark.parametrize("fill", ["smooth", "none"])
def test_pictures_are_on_the_device_of_the_events(
    simulation: Simulation, fill: Any, device: str
) -> None:
    recording = simulation.run()
    host = recording.events.slice(0, len(recording.events))
    moved = replace(recording, events=DeviceMemoryEvents(on_device(host, device), WIDTH, HEIGHT))
    work = amiwarp.Reconstruction(moved, model=MODEL, fill=fill)
    reference = amiwarp.Reconstruction(recording, model=MODEL, fill=fill, device=device)
    windows = work.windows(0, 60_000, step_us=20_000), reference.windows(0, 60_000, step_us=20_000)
    for found, expected in zip(*windows, strict=True):  # each starts from the one before
        assert {str(found.log.device), str(found.known.device)} == {device}
        np.testing.assert_array_equal(found.to_host().log, expected.log, strict=True)
        np.testing.assert_array_equal(found.to_host().known, expected.known, strict=True)
        np.testing.assert_allclose(found.intensity(0.2).numpy(), expected.intensity(0.2), rtol=1e-5)
        assert expected.to_host() is expected
    assert isinstance(expected.log, np.ndarray)


def test_reconstruction_on_another_device_than_the_events_is_refused_on_cuda(
    simulation: Simulation,
) -> None:
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    recording = replace(simulation, device="cuda:0").run(on_device=True)
    with pytest.raises(AmiwarpError, match="events are on cuda:0, device is cpu; leave device out"):
        amiwarp.reconstruct(recording, model=MODEL, device="cpu")


def test_a_source_on_a_device_equals_a_source_in_memory(device: str) -> None:
    host = random_events()
    source, expected = (
        DeviceMemoryEvents(on_device(host, device), WIDTH, HEIGHT),
        MemoryEvents(host, WIDTH, HEIGHT),
    )
    assert isinstance(source, amiwarp.EventSource)
    assert (len(source), source.t_first, source.t_last, source.size) == (
        len(expected), expected.t_first, expected.t_last, expected.size)  # fmt: skip
    for t in (-1, 0, int(host.t[10]), 50_000, 10**9):
        assert source.find(t) == expected.find(t)
    assert_equal(source.between(20_000, 60_000), expected.between(20_000, 60_000))
    assert_equal(source.slice(5, 70), expected.slice(5, 70))
    for which in (slice(None), slice(100, 200), slice(-7, None), slice(9, 3)):
        assert isinstance(source[which], DeviceEvents)
        assert source[which].device == source.device
        assert_equal(source[which].to_host(), expected[which])
    assert repr(source[:]).startswith(
        f"DeviceEvents({len(host):,} events, on {source.device}, t {host.t[0]} .. "
    )
    assert repr(source).startswith(
        f"DeviceMemoryEvents({len(host):,} events, {WIDTH}x{HEIGHT} px, t "
    )
    for found, block in zip(
        source.blocks(duration_us=7000), expected.blocks(duration_us=7000), strict=True
    ):
        assert_equal(found, block)


def test_a_source_on_a_device_refuses_bad_events(device: str) -> None:
    host = random_events()
    with pytest.raises(AmiwarpError, match=r"event \d+ .*lies outside the 64x40 frame"):
        DeviceMemoryEvents(on_device(host, device), WIDTH, 40)
    with pytest.raises(AmiwarpError, match=r"event 1 .*earlier than the one before"):
        DeviceMemoryEvents(
            DeviceEvents.from_arrays([1, 1], [1, 1], [5, 4], [0, 1], device=device), WIDTH, HEIGHT
        )


def test_a_source_on_a_device_takes_compensated_events_that_left_the_frame(device: str) -> None:
    """NaN marks an event without a position. The first event out of order is named, not the first NaN."""
    x, t = np.array([math.nan, 200.0, 3.0], np.float32), np.array([5, 6, 7])
    arrays = [wp.array(values, device=device) for values in (x, x, t, np.ones(3, np.uint8))]
    assert len(DeviceMemoryEvents(DeviceEvents(*arrays), WIDTH, HEIGHT)) == 3
    arrays[2] = wp.array(t[[0, 2, 1]], device=device)
    with pytest.raises(AmiwarpError, match=r"event 2 .*earlier than the one before"):
        DeviceMemoryEvents(DeviceEvents(*arrays), WIDTH, HEIGHT)


@pytest.mark.parametrize("on", [2, 255])
def test_other_polarities_than_0_and_1_are_refused(on: int, device: str) -> None:
    place = wp.array(np.arange(3, dtype=np.uint16), device=device)
    columns = (
        place,
        place,
        wp.array(np.arange(3), device=device),
        wp.array(np.array([0, on, 0], np.uint8), device=device),
    )
    with pytest.raises(AmiwarpError, match=rf"events' p holds {on} \(number 1\)"):
        DeviceEvents.from_arrays(*columns)
    with pytest.raises(AmiwarpError, match=rf"events' p holds {on} \(number 1\)"):
        DeviceMemoryEvents(DeviceEvents(*columns), WIDTH, HEIGHT)


def streamed(encoder: Encoder) -> EncoderStream:
    stream = EncoderStream()
    stream.append(encoder.t, encoder.angle)
    return stream


@pytest.mark.parametrize("covered", [(-5000, 110_000), (20_000, 60_000)])
@pytest.mark.parametrize("kind", ["host", "device"])
def test_a_stream_on_a_device_comes_out_as_on_the_host(
    kind: str, covered: tuple[int, int], device: str
) -> None:
    """Also with events before the first encoder sample and after the last one."""
    host = random_events(20_000)
    packets = host if kind == "host" else on_device(host, device)
    plain, kept = (
        Compensator(
            MODEL, streamed(Encoder.constant_speed(720.0, *covered)), batch=4000, device=device
        )
        for _ in "ab"
    )
    expected, found, start = [], [], 0
    for n in (1, 0, 63, 65, 9000, 777, 20_000):
        plain.put(host[start : start + n], 0)
        kept.put(packets[start : start + n], 0)
        expected += plain.take(0)
        found += kept.take_on_device(0)
        start += n
    expected += plain.flush()
    found += kept.take_on_device(2**62)
    assert_equal(
        DeviceEvents.concatenate([packet.events for packet in found]).to_host(),
        Events.concatenate([packet.events for packet in expected]),
    )
    flags = np.concatenate([packet.flags.numpy() for packet in found])
    np.testing.assert_array_equal(flags, np.concatenate([packet.flags for packet in expected]))
    assert set(flags.tolist()) == ({0, 1} if covered[0] < 0 else {0, 1, 2, 3, 5})
    np.testing.assert_array_equal(kept.image_on_device().numpy(), plain.image())
    assert (kept.waiting, kept.waiting_bytes) == (0, 0)


def test_packets_on_a_device_can_be_taken_on_the_host(device: str) -> None:
    host = random_events()
    compensator = Compensator(MODEL, streamed(ENCODER), device=device)
    compensator.put(on_device(host, device), 0)
    [packet] = compensator.flush()
    np.testing.assert_array_equal(
        np.stack([packet.events.x, packet.events.y], axis=1),
        amiwarp.compensate_events(host, MODEL, ENCODER, device=device),
    )


def test_unsorted_packets_on_a_device_are_refused(device: str) -> None:
    compensator = Compensator(MODEL, EncoderStream(), device=device)
    with pytest.raises(AmiwarpError, match="not sorted"):
        compensator.put(falling(device), 0)
    compensator.put(DeviceEvents.from_arrays([1], [1], [5], [0], device=device), 0)
    with pytest.raises(AmiwarpError, match="start before 5 us"):
        compensator.put(DeviceEvents.from_arrays([1], [1], [4], [0], device=device), 0)
    assert compensator.waiting == 1


# -- times, order, masks and gaps


TIMES = np.array([0, 1000, 2000])
FLAT = {"x": [1, 2, 3], "y": [1, 2, 3], "p": [1, 0, 1]}


@pytest.mark.parametrize("kind", [Events, DeviceEvents])
@pytest.mark.parametrize("library", ["numpy", "torch"])
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0005])
def test_floating_times_with_fractions_are_refused(kind: Any, library: str, scale: float) -> None:
    """Times in seconds or milliseconds, which would become zeros or duplicates."""
    with pytest.raises(AmiwarpError, match=r"times hold .*whole microseconds.*t_unit='s'"):
        kind.from_arrays(**FLAT, t=foreign(library, "cpu", 1.0 + (TIMES + 300) * scale))


@pytest.mark.parametrize("kind", [Events, DeviceEvents])
def test_times_in_seconds_are_rounded_to_microseconds(kind: Any) -> None:
    for first in (0.0, 1_700_000_000.0):  # since the start, and since 1970
        events = kind.from_arrays(**FLAT, t=first + TIMES / 1e6, t_unit="s")
        events = events if kind is Events else events.to_host()
        np.testing.assert_array_equal(events.t, int(first * 1e6) + TIMES)
    assert kind.from_arrays(**FLAT, t=[0, 1, 2], t_unit="s").t.dtype in (np.int64, wp.int64)
    with pytest.raises(AmiwarpError, match="t_unit is 'ms'; choose among us, s"):
        kind.from_arrays(**FLAT, t=TIMES / 1e3, t_unit="ms")


@pytest.mark.parametrize("kind", [Events, DeviceEvents])
@pytest.mark.parametrize(
    ("t", "unit"),
    [
        (TIMES.astype(np.float32) + 2**25, "us"),
        ((100 + TIMES / 1e6).astype(np.float32), "s"),
        (TIMES + 1e18, "us"),
    ],
)
def test_floating_times_that_lost_their_microseconds_are_refused(
    kind: Any, t: np.ndarray, unit: str
) -> None:
    with pytest.raises(AmiwarpError, match="does not resolve 1 us"):
        kind.from_arrays(**FLAT, t=t, t_unit=unit)


@pytest.mark.parametrize(
    ("t", "unit", "message"),
    [
        (TIMES / 1e6, "us", "t_unit='s'"),
        (np.array([0.0, np.nan, 1.0]), "s", "not finite"),
        (np.array([0.0, 100.0], np.float32), "s", "does not resolve 1 us"),
        (np.array([0, 2**64 - 5], np.uint64), "us", "beyond 2"),
    ],
)
def test_times_are_checked_on_the_device_as_on_the_host(
    t: np.ndarray, unit: str, message: str, device: str
) -> None:
    with pytest.raises(AmiwarpError, match=message):
        converted("t", wp.array(t, dtype=wp.dtype_from_numpy(t.dtype), device=device), unit)


def test_seconds_are_converted_on_the_device(device: str) -> None:
    given = wp.array(1e9 + TIMES / 1e6, dtype=wp.float64, device=device)
    np.testing.assert_array_equal(converted("t", given, "s").numpy(), 10**15 + TIMES)


@pytest.mark.parametrize("kind", [Events, DeviceEvents])
def test_falling_times_are_refused(kind: Any) -> None:
    with pytest.raises(
        AmiwarpError, match=r"event 1 \(x=2, y=2, t=1000 us\) is earlier than the one before"
    ):
        kind.from_arrays(**FLAT, t=TIMES[::-1])


def test_falling_times_are_refused_where_events_are_computed(device: str) -> None:
    on_host = falling("cpu").to_host()
    for events in (on_host, falling(device)):
        with pytest.raises(AmiwarpError, match=r"event 1 .* is earlier than the one before"):
            amiwarp.iwe(events, WIDTH, HEIGHT)
        with pytest.raises(AmiwarpError, match=r"event 1 .* is earlier than the one before"):
            amiwarp.compensate_events(events, MODEL, ENCODER)


@pytest.mark.parametrize("kind", [Events, DeviceEvents])
@pytest.mark.parametrize("name", NAMES)
def test_masked_values_are_refused(kind: Any, name: str) -> None:
    columns = {**FLAT, "t": TIMES}
    masked = np.ma.masked_array(columns[name], [False, True, False])
    with pytest.raises(AmiwarpError, match=r"masked values; .*values\[~mask\]"):
        kind.from_arrays(**{**columns, name: masked})
    kind.from_arrays(**{**columns, name: np.ma.masked_array(columns[name])})  # no value is masked


def test_numpy_events_copy_arrays_with_gaps() -> None:
    packed = np.zeros(3, [("x", "u2"), ("y", "u2"), ("t", "i8"), ("p", "u1")])
    packed["x"], packed["y"], packed["t"], packed["p"] = FLAT["x"], FLAT["y"], TIMES, FLAT["p"]
    wide = {name: np.repeat(packed[name], 2) for name in NAMES}
    unaligned = np.frombuffer(b"\0" + np.array(FLAT["x"], np.uint16).tobytes(), np.uint16, offset=1)
    for columns in (
        {name: packed[name] for name in NAMES},
        {name: values[::2] for name, values in wide.items()},
        {**FLAT, "t": TIMES, "x": unaligned},
    ):
        events = Events.from_arrays(**columns)
        assert_equal(events, Events.from_arrays(**FLAT, t=TIMES))
        for name in NAMES:
            found = getattr(events, name)
            assert found.flags.c_contiguous
            assert found.flags.aligned
            if not isinstance(columns[name], list) and name != "t":
                assert not np.shares_memory(found, columns[name])


# -- streams of CUDA


def test_work_on_a_cuda_stream_of_pytorch_is_awaited() -> None:
    """Events are written on a side stream after a delay, and handed over without waiting."""
    host = random_events()
    late = as_columns("torch", "cuda:0", host)
    torch = pytest.importorskip("torch")
    early = {name: foreign("torch", "cuda:0", np.zeros_like(getattr(host, name))) for name in NAMES}
    torch.cuda.synchronize()
    expected = amiwarp.iwe(host, WIDTH, HEIGHT, model=MODEL, encoder=ENCODER, device="cuda:0")
    loaded = amiwarp.iwe(
        DeviceEvents.from_arrays(**late), WIDTH, HEIGHT, model=MODEL, encoder=ENCODER
    )
    np.testing.assert_array_equal(loaded.numpy(), expected)
    with torch.cuda.stream(torch.cuda.Stream()):
        torch.cuda._sleep(200_000_000)  # about 0.1 s
        for name, values in late.items():
            early[name].copy_(values)
        assert not torch.cuda.current_stream().query()  # the events are not written yet
        events = DeviceEvents.from_arrays(**early)
        image = amiwarp.iwe(events, WIDTH, HEIGHT, model=MODEL, encoder=ENCODER)
        found = torch.from_dlpack(image) * 2.0
        del image, events
        np.testing.assert_array_equal(found.cpu().numpy(), 2.0 * expected)


def test_images_on_cuda_streams_of_pytorch_and_cupy_are_awaited() -> None:
    host = random_events()
    tensor = foreign("torch", "cuda:0", amiwarp.iwe(host, WIDTH, HEIGHT))
    torch = pytest.importorskip("torch")
    expected = amiwarp.sharpness(tensor)
    late = torch.zeros_like(tensor)
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        torch.cuda._sleep(200_000_000)
        late.copy_(tensor)
        assert amiwarp.sharpness(late) == expected
    cupy = pytest.importorskip("cupy")
    source = cupy.asarray(tensor.cpu().numpy())
    late = cupy.zeros_like(source)
    cupy.cuda.Device().synchronize()
    with cupy.cuda.Stream(non_blocking=True):
        for _ in range(200):  # work that takes some milliseconds
            cupy.ones((2048, 2048), cupy.float32).sum()
        late[...] = source
        assert amiwarp.sharpness(late) == expected


def test_results_are_finished_on_a_cuda_stream_of_warp() -> None:
    """CuPy reads the array interface of CUDA, which names no stream: results must be finished on return."""
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    cupy = pytest.importorskip("cupy")
    host = random_events(2_000_000)
    events = on_device(host, "cuda:0")
    expected = amiwarp.iwe(host, WIDTH, HEIGHT, device="cuda:0")
    with wp.ScopedStream(wp.Stream("cuda:0")):
        image = amiwarp.iwe(events, WIDTH, HEIGHT)
        with cupy.cuda.Stream(non_blocking=True):
            np.testing.assert_array_equal(cupy.asarray(image).get(), expected)
