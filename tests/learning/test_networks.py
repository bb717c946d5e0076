"""Networks of TorchScript and ONNX files: results against NumPy, states, padding, devices and refusals."""

import json
import math
import re
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import onnx
import onnx.numpy_helper
import onnx.parser
import onnxruntime
import pytest
import warp as wp
from PIL import Image
from scipy.signal import correlate2d
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    DeviceEvents,
    DeviceMemoryEvents,
    Encoder,
    Events,
    ExactModel,
    MemoryEvents,
    Network,
    Prism,
    PrismMotion,
    Recording,
    Scene,
    Simulation,
    ToTensor,
    Windows,
    compensate_events,
    polarity_histogram,
    save_recording,
    time_surface,
    voxel_grid,
    windows,
)
from amiwarp.imaging import picture_quality
from amiwarp.learning import network_files, networks, quarter_turn
from reference import optics as reference
from tests.command_line import app

WIDTH, HEIGHT, BINS = 37, 22, 3
RNG = np.random.default_rng(5)
WEIGHTS = RNG.normal(0.0, 0.3, (3, BINS + 1, 3, 3)).astype(np.float32)
"""Of a convolution of a voxel grid and a state, to two images and the next state."""
GRID = ToTensor(voxel_grid, bins=BINS, normalize=True)


def some_events(n: int = 900, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    x, y, p = rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n), rng.integers(0, 2, n)
    return Events.from_arrays(x, y, np.sort(rng.integers(1_000, 31_000, n)), p)


EVENTS = some_events()


def step(grid: Any, state: Any) -> tuple[Any, Any]:
    """The network in float64: the images, shape (2, rows, columns), and the next state, shape (rows, columns)."""
    layers = np.concatenate([grid, [state]]).astype(np.float64)
    pairs = [
        [correlate2d(one, w, "same") for one, w in zip(layers, kernel, strict=True)]
        for kernel in WEIGHTS
    ]
    sums = [np.sum(pair, axis=0) for pair in pairs]
    return np.stack(sums[:2]), np.tanh(sums[2])


def padded(grid: Any, multiple: int) -> tuple[Any, tuple[slice, ...]]:
    """The grid between zeros, of which there are more above and on the left, and the place of the image in it."""
    more = [-size % multiple for size in grid.shape[1:]]
    before = [math.ceil(0.5 * number) for number in more]
    inside = tuple(slice(b, b + size) for b, size in zip(before, grid.shape[1:], strict=True))
    return np.pad(grid, [(0, 0), *((b, m - b) for b, m in zip(before, more, strict=True))]), (
        slice(None),
        *inside,
    )


def expected(grids: list[Any], multiple: int = 8) -> list[Any]:
    """The results for the tensors of successive windows."""
    found, state = [], None
    for grid in grids:
        values, inside = padded(grid, multiple)
        images, state = step(values, np.zeros(values.shape[1:]) if state is None else state)
        found.append(images[inside])
    return found


def torch_file(path: Path, kind: str = "Recurrent") -> Path:
    """A TorchScript file: the network of :func:`step`, or another one."""
    torch = pytest.importorskip("torch")
    weights = torch.from_numpy(WEIGHTS.copy())

    class Recurrent(torch.nn.Module):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.weights = torch.nn.Parameter(weights)

        def forward(self, grid: torch.Tensor, before: torch.Tensor | None):  # type: ignore[no-untyped-def]
            if before is None:
                before = torch.zeros_like(grid[:, :1])
            sums = torch.nn.functional.conv2d(torch.cat([grid, before], 1), self.weights, padding=1)
            return sums[:, :2], torch.tanh(sums[:, 2:])

    class Nested(Recurrent):  # as E2VID: one state of several layers, each of two tensors
        def forward(
            self, grid: torch.Tensor, before: list[tuple[torch.Tensor, torch.Tensor]] | None
        ):  # type: ignore
            state = torch.zeros_like(grid[:, :1]) if before is None else before[0][0] + before[0][1]
            sums = torch.nn.functional.conv2d(torch.cat([grid, state], 1), self.weights, padding=1)
            state = torch.tanh(sums[:, 2:])
            return sums[:, :2], [(0.25 * state, 0.75 * state)]

    class Positions(torch.nn.Module):  # type: ignore[misc]
        def forward(self, grid: torch.Tensor):  # type: ignore[no-untyped-def]
            row = torch.arange(grid.shape[2])[:, None].expand(grid.shape[2:])
            column = torch.arange(grid.shape[3])[None].expand(grid.shape[2:])
            image = torch.stack(
                [
                    row,
                    column,
                    torch.full_like(row, grid.shape[2]),
                    torch.full_like(row, grid.shape[3]),
                ]
            )
            # As EV-FlowNet: flow in several sizes
            return [
                image[None].to(grid),
                grid[:, :, ::2, ::2],
            ]

    class InPlace(torch.nn.Module):  # type: ignore[misc]
        def forward(self, grid: torch.Tensor, before: torch.Tensor):  # type: ignore[no-untyped-def]
            before += grid
            grid *= 0.0
            return before, before

    class Half(torch.nn.Module):  # type: ignore[misc]
        def forward(self, grid: torch.Tensor):  # type: ignore[no-untyped-def]
            return grid[:, :, ::2, ::2]

    class Text(torch.nn.Module):  # type: ignore[misc]
        def forward(self, grid: torch.Tensor) -> str:
            return "flow"

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        made = {one.__name__: one for one in (Recurrent, Nested, Positions, InPlace, Half, Text)}
        torch.jit.script(made[kind]()).save(path)
    return path


def onnx_file(
    path: Path, rows: Any = 24, columns: Any = 40, outputs: int = 2, images: int = 2
) -> Path:
    """An ONNX file with the network of :func:`step`, or with its last images only."""
    size = f"{rows},{columns}"
    after = f", float[1,1,{size}] after" if outputs > 1 else ""
    text = f"""<ir_version: 8, opset_import: ["": 18]>
    recurrent (float[1,{BINS},{size}] grid, float[1,1,{size}] before) => (float[1,{images},{size}] images{after}) {{
        layers = Concat <axis = 1> (grid, before)
        sums = Conv <pads = [1, 1, 1, 1]> (layers, weights)
        images, next = Split <axis = 1> (sums, sizes)
        after = Tanh (next)
    }}"""
    model = onnx.parser.parse_model(text)
    arrays = {"weights": WEIGHTS[2 - images :], "sizes": np.array([images, 1], np.int64)}
    model.graph.initializer.extend(
        onnx.numpy_helper.from_array(values, name) for name, values in arrays.items()
    )
    onnx.save(model, path)
    return path


@pytest.fixture(params=["recurrent.pt", "nested.pt", "recurrent.onnx"])
def recurrent(request: pytest.FixtureRequest, tmp_path: Path, device: str) -> Network:
    """The network of :func:`step` from a file of each kind, on each device."""
    path = tmp_path / request.param
    if path.suffix == ".pt":
        return Network(torch_file(path, path.stem.capitalize()), GRID, device=device)
    if device != "cpu" and "CUDAExecutionProvider" not in onnxruntime.get_available_providers():
        pytest.skip("onnxruntime without CUDA")
    return Network(onnx_file(path), GRID, device=device)


def test_states_are_carried_until_reset(recurrent: Network) -> None:
    blocks = [some_events(seed=k) for k in range(3)]
    wanted = expected([voxel_grid(one, WIDTH, HEIGHT, BINS, normalize=True) for one in blocks])
    found = [recurrent(one, WIDTH, HEIGHT) for one in blocks]
    for images, truth in zip(found, wanted, strict=True):
        assert isinstance(images, np.ndarray)
        assert images.dtype == np.float32
        np.testing.assert_allclose(images, truth, rtol=0, atol=1e-5)
    assert (
        np.abs(
            wanted[1] - expected([voxel_grid(blocks[1], WIDTH, HEIGHT, BINS, normalize=True)])[0]
        ).max()
        > 0.1
    )
    # Later calls do not write to it
    np.testing.assert_allclose(found[0], wanted[0], rtol=0, atol=1e-5)
    recurrent.reset()
    np.testing.assert_allclose(recurrent(blocks[0], WIDTH, HEIGHT), wanted[0], rtol=0, atol=1e-5)


def test_events_on_a_device_give_arrays_there(recurrent: Network, device: str) -> None:
    there = DeviceEvents.from_arrays(EVENTS.x, EVENTS.y, EVENTS.t, EVENTS.p, device=device)
    found = recurrent(there, WIDTH, HEIGHT)
    assert isinstance(found, wp.array)
    assert found.device == wp.get_device(device)
    wanted = expected([voxel_grid(EVENTS, WIDTH, HEIGHT, BINS, normalize=True)])[0]
    np.testing.assert_allclose(found.numpy(), wanted, rtol=0, atol=1e-5)


def test_windows_of_a_recording_raw_and_compensated(recurrent: Network, device: str) -> None:
    camera, prism = Camera.from_fov(WIDTH, HEIGHT, 1.0), Prism(0.03)
    encoder = Encoder.constant_speed(1200.0, 0, 40_000)
    recording = Recording(MemoryEvents(EVENTS, WIDTH, HEIGHT), camera, encoder, prism)
    there = DeviceEvents.from_arrays(EVENTS.x, EVENTS.y, EVENTS.t, EVENTS.p, device=device)
    on_device = Recording(DeviceMemoryEvents(there, WIDTH, HEIGHT), camera, encoder, prism)
    cut = windows(EVENTS, duration_us=9_000, incomplete=True)
    optic: dict[str, Any] = {"model": ExactModel(camera, prism), "encoder": encoder}
    options: dict[str, Any]
    for options in ({}, optic):
        grids = voxel_grid(EVENTS, WIDTH, HEIGHT, BINS, normalize=True, windows=cut, **options)
        wanted = expected(list(grids))
        first, second = (
            recurrent.over(recording, cut, **options),
            recurrent.over(on_device, cut, **options),
        )
        for truth, images, warp_images in zip(
            wanted, first, second, strict=True
        ):  # each with its own states
            np.testing.assert_allclose(images, truth, rtol=0, atol=2e-5)
            np.testing.assert_allclose(warp_images.numpy(), truth, rtol=0, atol=2e-5)
    places = compensate_events(EVENTS, optic["model"], encoder)
    compensated = Events(places[:, 0].copy(), places[:, 1].copy(), EVENTS.t, EVENTS.p)
    whole = recurrent(compensated, WIDTH, HEIGHT)  # no iteration has left states
    wanted = expected([voxel_grid(EVENTS, WIDTH, HEIGHT, BINS, normalize=True, **optic)])
    np.testing.assert_allclose(whole, wanted[0], rtol=0, atol=2e-5)
    grid = voxel_grid(EVENTS, WIDTH, HEIGHT, BINS, normalize=True, windows=cut[:1])[0]
    # An iteration does not begin with the states of a call
    first_images = next(iter(recurrent.over(recording, cut)))
    np.testing.assert_allclose(first_images, expected([grid])[0], rtol=0, atol=2e-5)
    with pytest.raises(AmiwarpError, match="windows reach to event 900 of 500"):
        recurrent.over(Recording(MemoryEvents(EVENTS[:500], WIDTH, HEIGHT)), cut)


@pytest.mark.parametrize(("multiple", "height", "width", "top", "left"), [
    (1, 22, 37, 0, 0), (2, 22, 38, 0, 1), (5, 25, 40, 2, 2), (8, 24, 40, 1, 2), (16, 32, 48, 5, 6),
    (64, 64, 64, 21, 14),
])  # fmt: skip
def test_padding_and_cropping(
    tmp_path: Path, multiple: int, height: int, width: int, top: int, left: int
) -> None:
    network = Network(torch_file(tmp_path / "n.pt", "Positions"), GRID, multiple=multiple)
    rows, columns, heights, widths = network(EVENTS, WIDTH, HEIGHT)
    np.testing.assert_array_equal(rows[:, 0], top + np.arange(HEIGHT))
    np.testing.assert_array_equal(columns[0], left + np.arange(WIDTH))
    assert (heights == height).all()
    assert (widths == width).all()


def test_what_is_given_is_not_changed_and_results_are_own(tmp_path: Path, device: str) -> None:
    kept = RNG.random((2, HEIGHT, WIDTH)).astype(np.float32)
    first = RNG.random((1, 2, HEIGHT, WIDTH)).astype(np.float32)
    tensor, state = wp.array(kept, device=device), wp.array(first, device=device)
    path = torch_file(tmp_path / "n.pt", "InPlace")
    network = Network(
        path, lambda events, width, height: tensor, multiple=1, states=[state], device=device
    )
    for _ in range(2):
        found = [network(EVENTS, WIDTH, HEIGHT) for _ in range(3)]
        for k, images in enumerate(found):
            np.testing.assert_allclose(images, first[0] + (k + 1) * kept, rtol=0, atol=1e-6)
        network.reset()
    np.testing.assert_array_equal(tensor.numpy(), kept)
    np.testing.assert_array_equal(state.numpy(), first)


def test_own_input_of_counts_and_times(tmp_path: Path, device: str) -> None:
    """EV-FlowNet takes the counts of ON and OFF events, then the times of the latest ones in the window."""
    torch = pytest.importorskip("torch")
    seen = []

    def counts_and_times(events: DeviceEvents, **options: Any) -> Any:
        seen.append((events, options))
        duration = options["t_end"] - options["t_start"]
        parts = (
            polarity_histogram(events, **options),
            time_surface(events, tau_us=duration, linear=True, **options),
        )
        return torch.cat([torch.from_dlpack(part).flip(0) for part in parts])

    path = torch_file(tmp_path / "n.pt", "InPlace")
    first = np.zeros((1, 4, HEIGHT, WIDTH))
    network = Network(
        path, counts_and_times, multiple=1, states=[first.astype(np.float32)], device=device
    )
    found = network(EVENTS, WIDTH, HEIGHT, t_start=5_000, t_end=25_000)
    for t, x, y, p in zip(EVENTS.t, EVENTS.x, EVENTS.y, EVENTS.p, strict=True):
        if 5_000 <= t <= 25_000:
            first[0, 1 - p, y, x] += 1
            first[0, 3 - p, y, x] = (t - 5_000) / 20_000
    np.testing.assert_allclose(found, first[0], rtol=0, atol=1e-5)
    assert seen[0][0].device == wp.get_device(device)
    assert seen[0][1] == {"width": WIDTH, "height": HEIGHT, "t_start": 5_000, "t_end": 25_000}


def test_whole_numbers_and_numpy_arrays_are_taken(tmp_path: Path) -> None:
    path = torch_file(tmp_path / "n.pt", "Half")
    whole = partial(np.ones, (1, HEIGHT, WIDTH), np.int32)
    with pytest.raises(
        AmiwarpError, match=r"output has shape \(1, 1, 11, 19\); expected \(1, channels, 22, 37\)"
    ):
        Network(path, lambda events, width, height: whole(), multiple=1)(EVENTS, WIDTH, HEIGHT)
    first = np.zeros((1, 2, HEIGHT, WIDTH), np.float32)
    network = Network(
        torch_file(path, "InPlace"), ToTensor(polarity_histogram), multiple=1, states=[first]
    )
    np.testing.assert_array_equal(
        network(EVENTS, WIDTH, HEIGHT), polarity_histogram(EVENTS, WIDTH, HEIGHT)
    )


def test_inputs_with_gaps_are_taken(tmp_path: Path, device: str) -> None:
    """Such as channels that come last in memory."""
    torch = pytest.importorskip("torch")
    values = torch.from_numpy(RNG.random((HEIGHT, WIDTH, 2)).astype(np.float32)).permute(2, 0, 1)
    given = wp.from_torch(values.to(wp.device_to_torch(wp.get_device(device))))
    first = np.zeros((1, 2, HEIGHT, WIDTH), np.float32)
    path = torch_file(tmp_path / "n.pt", "InPlace")
    network = Network(
        path, lambda events, width, height: given, multiple=1, states=[first], device=device
    )
    np.testing.assert_array_equal(network(EVENTS, WIDTH, HEIGHT), values.numpy())


@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize(("value", "shown"), [("nan", "nan"), ("inf", "inf"), ("-inf", "-inf")])
def test_a_network_that_gives_no_number_is_named(
    tmp_path: Path, kind: str, value: str, shown: str, device: str
) -> None:
    """The picture is a sum over the bins, and at one pixel of the second row and third column a bad value."""
    text = f"""<ir_version: 8, opset_import: ["": 18]> sum ({kind}[1,5,h,w] grid) => ({kind}[1,1,h,w] picture) {{
        axes = Constant <value_ints: ints = [1]> ()
        sums = ReduceSum (grid, axes)
        picture = Add (sums, extra)
    }}"""
    model = onnx.parser.parse_model(text)
    extra = np.zeros((1, 1, HEIGHT, WIDTH), np.float32 if kind == "float" else np.float64)
    extra[0, 0, 1, 2] = float(value)
    model.graph.initializer.append(onnx.numpy_helper.from_array(extra, "extra"))
    onnx.save(model, tmp_path / "n.onnx")
    network = Network(tmp_path / "n.onnx", multiple=1, device=device)
    where = f"its first output 'picture' holds {shown} in channel 0 at row 1, column 2"
    with pytest.raises(AmiwarpError, match=rf"n\.onnx: {where}; expected finite numbers"):
        network(EVENTS, WIDTH, HEIGHT)


def test_states_of_onnx_files_of_any_size(tmp_path: Path) -> None:
    path = onnx_file(tmp_path / "n.onnx", "rows", "columns")
    with pytest.raises(
        AmiwarpError, match=r"before has the shape \[1, 1, 'rows', 'columns'\]; give .* in states"
    ):
        Network(path, GRID)(EVENTS, WIDTH, HEIGHT)
    network = Network(path, GRID, states=[np.zeros((1, 1, 24, 40), np.float32)])
    wanted = expected([voxel_grid(EVENTS, WIDTH, HEIGHT, BINS, normalize=True)] * 2)
    for truth in wanted:
        np.testing.assert_allclose(network(EVENTS, WIDTH, HEIGHT), truth, rtol=0, atol=1e-5)
    with pytest.raises(AmiwarpError, match="call reset"):
        network(EVENTS, 60, 50)


def make(folder: Path, name: str, **options: Any) -> Network:
    """A network of a file that is made by its name."""
    path = folder / name
    if path.suffix == ".onnx":
        onnx_file(path, outputs=1 if path.stem == "stateless" else 2)
    elif path.suffix == ".pt":
        torch_file(path, path.stem)
    return Network(path, **{"input": GRID, **options})


WRONG = partial(ToTensor, voxel_grid)

REFUSALS: dict[str, Callable[[Path], Any]] = {
    "none.jpg: networks are read as .pt, .pth, .ts or .onnx": lambda folder: Network(folder / "none.jpg"),
    "none.pt: no such file": lambda folder: Network(folder / "none.pt"),
    "torch.jit.script": lambda folder: broken(folder / "broken.pt"),
    "broken.onnx: not an ONNX file": lambda folder: broken(folder / "broken.onnx"),
    "Text.pt: the first output": lambda folder: make(folder, "Text.pt")(EVENTS, WIDTH, HEIGHT),
    "to have 4 channels, but got 6": lambda folder: make(folder, "Recurrent.pt", input=WRONG(bins=5))(EVENTS, 37, 22),
    "change the bins of the input": lambda folder: make(folder, "n.onnx", input=WRONG(bins=5))(EVENTS, WIDTH, HEIGHT),
    "not [1, 3, 22, 37]; change multiple": lambda folder: make(folder, "n.onnx", multiple=1)(EVENTS, WIDTH, HEIGHT),
    "has 1 inputs after the first and 0 outputs": lambda folder: make(folder, "stateless.onnx"),
    "takes 1 states, not 2": lambda folder: make(folder, "n.onnx", states=[np.zeros(1), np.zeros(1)]),
    "a state cannot be read as an array": lambda folder: make(folder, "n.onnx", states=["zero"]),
    "multiple = 0": lambda folder: make(folder, "n.onnx", multiple=0),
    "gives shape (5, 22, 30)": lambda folder: make(
        folder, "n.onnx", input=lambda events, width, height: np.zeros((5, 22, 30))
    )(EVENTS, WIDTH, HEIGHT),
    "only one of model and encoder": lambda folder: make(folder, "n.onnx")(
        EVENTS, WIDTH, HEIGHT, encoder=Encoder.constant_speed(600.0, 0, 40_000)
    ),
}  # fmt: skip


def declaring(path: Path, state: str, output: str = "1") -> Network:
    """A network of a file that declares a state and an output of these shapes, but has no such arrays."""
    text = f"""<ir_version: 8, opset_import: ["": 18]>
    large (float[1,{BINS},h,w] grid, float[{state}] before) => (float[1,1,h,w] image, float[{output}] after) {{
        axes = Constant <value_ints: ints = [1]> ()
        image = ReduceSum (grid, axes)
        after = Identity (before)
    }}"""
    onnx.save(onnx.parser.parse_model(text), path)
    return Network(path, GRID)


@pytest.mark.parametrize(
    ("state", "output", "message"),
    [
        (
            "400000,400000",
            "x,y",
            "its states of shape [400000, 400000] take 596 GiB; expected at most 4 GiB",
        ),
        ("1000000000,1000000000,1000000000", "x,y,z", "take 3.725e+18 GiB"),
        ("1073741825", "x", "its states of shape [1073741825] take 4 GiB"),
        (
            "a,b,c,d",
            "2000,1000,c,1000",
            "its output after of shape [2000, 1000, 'c', 1000] take 7.451 GiB",
        ),
    ],
)
def test_onnx_files_of_absurd_sizes_are_refused_at_once(
    tmp_path: Path, state: str, output: str, message: str
) -> None:
    with pytest.raises(
        AmiwarpError, match=re.escape(f"a.onnx: {message}" if "its" in message else message)
    ):
        declaring(tmp_path / "a.onnx", state, output)


def test_an_onnx_state_of_no_size_must_be_given(tmp_path: Path) -> None:
    with pytest.raises(
        AmiwarpError, match=r"before has the shape \[0, 5\]; give its first value in states"
    ):
        declaring(tmp_path / "a.onnx", "0,5", "0,5")(EVENTS, WIDTH, HEIGHT)


def test_states_up_to_the_limit_are_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = onnx_file(tmp_path / "n.onnx", images=1)
    monkeypatch.setattr(network_files, "LARGEST_BYTES", 4 * 24 * 40)
    assert Network(path, GRID)(EVENTS, WIDTH, HEIGHT).shape == (1, HEIGHT, WIDTH)
    monkeypatch.setattr(network_files, "LARGEST_BYTES", 4 * 24 * 40 - 1)
    with pytest.raises(AmiwarpError, match=r"its states of shape \[1, 1, 24, 40\] take"):
        Network(path, GRID)


def broken(path: Path) -> Network:
    path.write_bytes(b"no network")
    return Network(path)


@pytest.mark.parametrize("message", REFUSALS)
def test_refusals(tmp_path: Path, message: str) -> None:
    if "torch" in message:
        pytest.importorskip("torch")
    with pytest.raises(AmiwarpError, match=re.escape(message)):
        REFUSALS[message](tmp_path)


@pytest.mark.parametrize(("name", "package", "extra"), [
    ("Half.pt", "torch", "amiwarp[torch]"), ("n.onnx", "onnxruntime", "amiwarp[onnx]"),
])  # fmt: skip
def test_a_missing_package_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str, extra: str
) -> None:
    make(tmp_path, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(AmiwarpError, match=re.escape(f"pip install '{extra}'")):
        Network(tmp_path / name)


@pytest.mark.parametrize(("name", "said"), [
    ("Half.pt", "PyTorch has no CUDA here"), ("n.onnx", "onnxruntime has no CUDA here; install onnxruntime-gpu"),
])  # fmt: skip
def test_a_package_without_cuda_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, said: str
) -> None:
    torch = pytest.importorskip("torch")
    make(tmp_path, name)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    kind = network_files.TorchFile if name.endswith(".pt") else network_files.OnnxFile
    with pytest.raises(AmiwarpError, match=said):
        kind(tmp_path / name, SimpleNamespace(is_cuda=True, ordinal=0))


# The command ``amiwarp reconstruct --network``.

CAMERA, PRISM = Camera.from_fov(WIDTH, HEIGHT, 1.0), Prism(0.03)
ENCODER = Encoder.constant_speed(6000.0, 0, 40_000)  # 10 ms a turn
TRACKED = Recording(MemoryEvents(EVENTS, WIDTH, HEIGHT), CAMERA, ENCODER, PRISM)


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Network:
    """Make the folder of a recording, its calibration and a network the current one; return the network."""
    monkeypatch.chdir(tmp_path)
    save_recording("r.h5", TRACKED)
    SMALL_CALIBRATION.save("c.json")
    onnx_file(Path("two.onnx"))
    onnx_file(Path("n.onnx"), images=1)
    return Network("n.onnx", GRID)


SMALL_CALIBRATION = Calibration(
    model_name="exact", camera=CAMERA, prism=PRISM, parameters={"apex": 0.03, "phase": 0.5}, uncertainty={},
    free=("phase",), sharpness_name="variance", sharpness_before=1.0, sharpness_after=2.0, stages=(), events=10,
    seconds=1.0,
)  # fmt: skip


def run(*arguments: str) -> Any:
    bins = (
        ["--bins", str(BINS)]
        if any(Path(each).suffix in (".onnx", ".pt") for each in arguments)
        else []
    )
    return CliRunner().invoke(
        app, ["reconstruct", "r.h5", *arguments, *bins, "--device", "cpu", "--json"]
    )


@pytest.mark.parametrize("calibrated", [False, True])
def test_the_command_makes_a_picture(files: Network, calibrated: bool) -> None:
    more = ["--calibration", "c.json"] if calibrated else []
    optic: dict[str, Any] = {}
    if calibrated:
        optic = {
            "model": SMALL_CALIBRATION.model,
            "encoder": SMALL_CALIBRATION.encoder_for(ENCODER, 0, 1),
        }
    done = run("p.npy", "--network", "n.onnx", *more, "--start", "0.02", "--length", "0.005")
    assert done.exit_code == 0, done.stderr
    data = json.loads(done.stdout)
    first = EVENTS.t[0]
    edges = first + 5_000 * np.arange(6)
    at = np.searchsorted(EVENTS.t, edges)
    *_, (last,) = files.over(TRACKED, Windows(at[:-1], at[1:], edges[:-1], edges[1:]), **optic)
    np.testing.assert_array_equal(np.load("p.npy"), last)
    assert data["start_us"] == first + 20_000
    assert data["length_us"] == 5_000
    assert data["windows"] == 5
    assert data["events"] == at[-1] - at[0]
    for tone, dark, bright in (("mapped", *np.percentile(last, [0.5, 99.5])), ("linear", 0.0, 1.0)):
        grey = ["--start", "0.02", "--length", "0.005", "--tone", tone, "--bits", "16"]
        assert run(f"{tone}.png", "--network", "n.onnx", *more, *grey).exit_code == 0
        values = np.asarray(Image.open(f"{tone}.png")) / 65535.0
        np.testing.assert_allclose(
            values, np.clip((last - dark) / (bright - dark), 0.0, 1.0), rtol=0, atol=2e-5
        )


def test_the_command_writes_no_picture_without_numbers(files: Network) -> None:
    model = onnx.load("n.onnx")
    first = model.graph.output[0].name
    for node in model.graph.node:
        node.output[:] = ["sound" if name == first else name for name in node.output]
    model.graph.node.append(onnx.helper.make_node("Log", ["negative"], ["nothing"]))
    model.graph.initializer.append(
        onnx.numpy_helper.from_array(np.array([-1.0], np.float32), "negative")
    )
    model.graph.node.append(onnx.helper.make_node("Mul", ["sound", "nothing"], [first]))
    onnx.save(model, "bad.onnx")
    more = ("--bins", str(BINS), "--multiple", "8", "--start", "0.02", "--length", "0.005")
    done = run("p.png", "--network", "bad.onnx", *more)
    assert done.exit_code == 1
    assert f"bad.onnx: its first output '{first}' holds nan in channel 0" in done.stderr
    assert not Path("p.png").exists()


def test_the_command_makes_a_video(files: Network) -> None:
    done = run("v.mp4", "--network", "n.onnx", "--fps", "200")
    assert done.exit_code == 0, done.stderr
    data = json.loads(done.stdout)
    lasts = int(EVENTS.t[-1] - EVENTS.t[0])
    assert data["frames"] == lasts // 5_000
    assert data["length_us"] == 5_000
    with av.open("v.mp4") as film:
        assert sum(1 for _ in film.decode(video=0)) == data["frames"]
    assert run("turn.npy", "--network", "n.onnx").exit_code == 0  # the picture of the second turn
    edges = EVENTS.t[0] + 10_000 * np.arange(3)
    at = np.searchsorted(EVENTS.t, edges)
    *_, (last,) = files.over(TRACKED, Windows(at[:-1], at[1:], edges[:-1], edges[1:]))
    np.testing.assert_array_equal(np.load("turn.npy"), last)


@pytest.mark.parametrize(("more", "said"), [
    ((), "--calibration is missing; give a calibration file, or a network"),
    (("--network", "n.onnx", "--fill", "edge"), "--mask, --fill and --omega apply to the solver"),
    (("--network", "n.onnx", "--contrast", "0.5"), "--contrast applies to the solver and to the network quarter-turn"),
    (("--network", "two.onnx"), "two.onnx: makes 2 channels"),
    (("--network", "none.onnx"), "none.onnx: no such file"),
    (("--network", "n.onnx", "--start", "9"), "no events in"),
])  # fmt: skip
@pytest.mark.usefixtures("files")
def test_the_command_refuses(more: tuple[str, ...], said: str) -> None:
    before = {path.name for path in Path().iterdir()}
    done = run("p.png", *more)
    assert done.exit_code == 1
    assert said in done.stderr
    assert {path.name for path in Path().iterdir()} == before


def test_windows_without_events_are_taken(files: Network) -> None:
    empty = np.array([5, 5], np.int64)
    optic: dict[str, Any] = {"model": ExactModel(CAMERA, PRISM), "encoder": ENCODER}
    for options in ({}, optic):
        for images in files.over(
            TRACKED, Windows(empty, empty, 100 * empty, 200 * empty), **options
        ):
            np.testing.assert_array_equal(images, 0.0)


# amiwarp's own network.


@pytest.fixture(scope="module")
def quarter(texture: np.ndarray) -> tuple[Any, Events, dict[str, Any], dict[str, int]]:
    """Simulation of a texture, the events of a quarter turn, the optic, and the window's times."""
    camera = Camera.from_fov(160, 120, math.radians(40.0))
    prism, motion = Prism(math.radians(1.0)), PrismMotion(720.0, 0.4)
    simulation = Simulation(Scene.from_picture(texture), camera, prism, 0.12, motion)
    recording = simulation.run()
    window = {"t_start": 84_000, "t_end": 104_833}
    events = recording.events.between(*window.values())
    return (
        simulation,
        events,
        {"model": ExactModel(camera, prism, 0.4), "encoder": recording.encoder},
        window,
    )


def test_own_sums_are_the_gradient_of_polarities(quarter: Any) -> None:
    pytest.importorskip("torch")
    _, events, optic, window = quarter
    here = DeviceEvents.from_arrays(events.x, events.y, events.t, events.p)
    found = networks.quarter_turn_sums(here, 160, 120, **window, **optic).numpy()

    n = quarter_turn.BINS
    ends = window["t_start"] + np.arange(n + 1) * (window["t_end"] - window["t_start"]) // n
    xy = compensate_events(events, optic["model"], optic["encoder"]).astype(np.float64)
    counts = np.zeros((n, 2, 122, 162))
    part = np.clip(np.searchsorted(ends, events.t, side="right") - 1, 0, n - 1)
    base = np.floor(xy).astype(int)
    for dx, dy in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = np.abs(1 - dx - xy[:, 0] + base[:, 0]) * np.abs(1 - dy - xy[:, 1] + base[:, 1])
        x, y = base[:, 0] + dx, base[:, 1] + dy
        inside = (x >= 0) & (x < 160) & (y >= 0) & (y < 120)
        np.add.at(counts, (part[inside], events.p[inside], y[inside], x[inside]), share[inside])
    counts = counts[:, :, :120, :160]

    theta = optic["encoder"].angles_at(ends)
    path = reference.move(optic["model"].camera, optic["model"].prism, np.tile([79.5, 59.5], (n + 1, 1)), theta,
                          to_scene=True, phase=0.4)  # fmt: skip
    chord = np.diff(path, axis=0)
    signed, total = counts[:, 1] - counts[:, 0], counts.sum(1)
    gradient = np.linalg.lstsq(chord, signed.reshape(n, -1), rcond=None)[0].reshape(2, 120, 160)
    np.testing.assert_allclose(found[:2], gradient, atol=2e-3)
    late = np.linspace(-1.0, 1.0, n)
    length, twice = np.hypot(*chord.T).sum(), 2.0 * np.arctan2(chord[:, 1], chord[:, 0])
    for k, weight in enumerate((np.ones(n), np.cos(twice), np.sin(twice), late)):
        np.testing.assert_allclose(found[4 + k], np.tensordot(weight / length, total, 1), atol=2e-3)
    towards = np.linalg.pinv(chord) * late
    np.testing.assert_allclose(found[2:4], np.tensordot(towards, signed, 1), atol=2e-3)


def test_own_sums_are_those_of_the_events_in_the_window(quarter: Any) -> None:
    pytest.importorskip("torch")
    simulation, events, optic, window = quarter
    found = []
    for given in (events, simulation.run().events[:]):
        here = DeviceEvents.from_arrays(given.x, given.y, given.t, given.p)
        found.append(networks.quarter_turn_sums(here, 160, 120, **window, **optic).numpy())
    np.testing.assert_array_equal(*found)


def test_own_sums_hold_an_event_at_the_end_of_the_window(quarter: Any) -> None:
    pytest.importorskip("torch")
    _, events, optic, window = quarter
    last = Events.from_arrays([80, 80], [60, 60], [window["t_end"], window["t_end"] + 1], [1, 1])
    totals = []
    for n in range(3):
        given = Events.concatenate([events, last[:n]])
        here = DeviceEvents.from_arrays(given.x, given.y, given.t, given.p)
        # Per path length
        totals.append(float(networks.quarter_turn_sums(here, 160, 120, **window, **optic)[4].sum()))
    path = optic["model"].compensate_points(
        np.tile([79.5, 59.5], (7, 1)),
        optic["encoder"].angles_at(np.linspace(*window.values(), 7).astype(np.int64)),
    )
    length = np.hypot(*np.diff(path, axis=0).T).sum()
    assert totals[1] - totals[0] == pytest.approx(1.0 / length, rel=0.02)
    assert totals[2] == totals[1]


def test_own_network_shows_the_scene(quarter: Any, device: str) -> None:
    torch = pytest.importorskip("torch")
    if device != "cpu" and not torch.cuda.is_available():
        pytest.skip("PyTorch without CUDA")
    simulation, events, optic, window = quarter
    found = Network.quarter_turn(device=device)(events, 160, 120, **window, **optic)
    assert found.shape == (1, 120, 160)
    quality = picture_quality(found[0], simulation.log_view())
    assert quality.correlation > 0.85
    # The threshold is 0.25, and the network's picture is in thresholds
    assert 0.1 < quality.gain < 0.5
    half = {**window, "t_start": window["t_start"] - 21_000}
    with pytest.raises(AmiwarpError, match=r"turns by 0\.5 of a turn in the window.*turns=0\.25"):
        Network.quarter_turn(device=device)(events, 160, 120, **half, **optic)
    with pytest.raises(AmiwarpError, match="give model and encoder"):
        Network.quarter_turn(device=device)(events, 160, 120, **window)


def test_own_network_takes_a_prism_that_turns_backwards(quarter: Any) -> None:
    """A prism that turns forwards, seen in a mirror image: its sums along y have the opposite sign."""
    pytest.importorskip("torch")
    _, events, optic, window = quarter
    model, encoder = optic["model"], optic["encoder"]
    flipped = DeviceEvents.from_arrays(events.x, 119 - events.y, events.t, events.p)
    back = {
        "model": replace(model, phase=-model.phase),
        "encoder": replace(encoder, angle=-encoder.angle),
    }
    found = networks.quarter_turn_sums(flipped, 160, 120, **window, **back).numpy()
    here = DeviceEvents.from_arrays(events.x, events.y, events.t, events.p)
    expected = networks.quarter_turn_sums(here, 160, 120, **window, **optic).numpy()[:, ::-1]
    # Of the gradient, its change, and the counts
    signs = np.array([1, -1, 1, -1, 1, 1, -1, 1])[:, None, None]
    np.testing.assert_allclose(found, signs * expected, rtol=0, atol=5e-3)


def test_own_network_makes_several_pictures_at_a_time(
    quarter: Any, device: str, monkeypatch: Any
) -> None:
    """They are those of single calls, also of windows that do not follow one another."""
    torch = pytest.importorskip("torch")
    if device != "cpu" and not torch.cuda.is_available():
        pytest.skip("PyTorch without CUDA")
    simulation, _, optic, _ = quarter
    recording, network = simulation.run(), Network.quarter_turn(device=device)
    cut = windows(recording.events[:], encoder=optic["encoder"], turns=0.25)[np.array([0, 1, 2, 4])]
    sizes: list[int] = []
    run = Network._run_grids
    monkeypatch.setattr(
        Network,
        "_run_grids",
        lambda self, z, states: (sizes.append(len(z)), run(self, z, states))[1],
    )
    found = list(network.over(recording, cut, **optic))
    assert sizes == [3, 1]
    for picture, first, last, t0, t1 in zip(
        found, cut.start, cut.stop, cut.t_start, cut.t_end, strict=True
    ):
        window = {"t_start": int(t0), "t_end": int(t1)}
        one = network(
            recording.events[int(first) : int(last)], *recording.events.size, **window, **optic
        )
        np.testing.assert_allclose(picture, one, atol=1e-4)


def test_own_network_keeps_all_bits_of_float32_on_cuda() -> None:
    """Rounding to 10 bits (TF32), which a trace holds as the last input of a convolution, is off."""
    pytest.importorskip("torch")
    network: Any = Network.quarter_turn()
    graph = network._file._module.inlined_graph
    rounding = [
        list(node.inputs())[-1].toIValue() for node in graph.findAllNodes("aten::_convolution")
    ]
    assert rounding == [False] * 18


def test_the_command_uses_the_own_network(
    quarter: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch")
    simulation, _, optic, window = quarter
    monkeypatch.chdir(tmp_path)
    save_recording("r.h5", simulation.run())
    model = optic["model"]
    calibration = replace(
        SMALL_CALIBRATION, camera=model.camera, prism=model.prism,
        parameters={"apex": model.prism.apex, "phase": model.phase},
    )  # fmt: skip
    calibration.save("c.json")
    own = "--network", "quarter-turn", "--start", str(1e-6 * window["t_start"])
    refused = run("p.npy", *own)
    assert refused.exit_code == 1
    assert "--calibration is missing" in refused.stderr
    for name in ("p.npy", "p.png", "p.mp4"):
        more = ["--length", "0.0208", "--fps", "100"] if name == "p.mp4" else []
        done = run(name, *own, *more, "--calibration", "c.json")
        assert done.exit_code == 0, done.stderr
    truth = simulation.log_view()
    quality = picture_quality(np.load("p.npy"), truth)
    assert quality.correlation > 0.85
    assert 0.4 < quality.gain < 2.0  # both are natural logarithms
    shown = np.asarray(Image.open("p.png"), np.float64)
    assert picture_quality(shown, np.exp(truth / 2.2)).correlation > 0.85
    data = json.loads(done.stdout)
    assert data["frames"] == 2


def test_own_network_is_small() -> None:
    pytest.importorskip("torch")
    assert networks.OWN.stat().st_size < 500_000
    assert sum(p.numel() for p in Network.quarter_turn()._file._module.parameters()) < 100_000
