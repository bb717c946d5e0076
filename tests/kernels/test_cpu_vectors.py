"""Vectorised kernels for CPUs compute what the kernels with one pair, node or unknown per thread compute."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from amiwarp import CameraRotation, ExactModel, RadialTangential, Recording
from amiwarp.brightness.event_table import EventTable
from amiwarp.brightness.multigrid import GridHierarchy
from amiwarp.brightness.pair_ends import PairEnds
from amiwarp.brightness.solver import BrightnessMap, Smoothness
from amiwarp.brightness.tiles import Tiles
from amiwarp.kernels import conjugate_gradients as cg
from amiwarp.kernels import equations_cuda, multilevel
from amiwarp.kernels.conjugate_gradients import Prior
from amiwarp.kernels.program import Program
from amiwarp.kernels.residual_slopes import slope_between
from tests.conftest import TRUE_PHASE, TRUE_PRISM

SCALE = 2.0**-32


@pytest.fixture(scope="module")
def placed(recording: Recording) -> BrightnessMap:
    """Map over a part of the image, with all unknowns, whose pairs are placed and have random residuals."""
    assert recording.camera is not None
    assert recording.encoder is not None
    width, height = recording.events.size
    table = EventTable(
        [recording.events.slice(0, 60_000)], np.zeros((height, width), np.int32), "cpu"
    )
    pairs = table.pairs(recording.encoder, longest_gap_us=60_000)
    assert pairs.arrays.stride > len(pairs)  # the last block is not full
    tiles = Tiles(np.array([[4.0, 3.0]], np.float32), height, width, 1.5)
    brightness = BrightnessMap(pairs, tiles, with_leak=True, smoothness=Smoothness(0.1))
    brightness.place(ExactModel(recording.camera, TRUE_PRISM, TRUE_PHASE))
    rng = np.random.default_rng(1)
    brightness.unknowns = rng.normal(size=len(brightness.unknowns)).astype(np.float32)
    brightness.solve(1.0, steps=0)
    return brightness


@pytest.mark.parametrize("name", ["add_diagonal", "add_transpose", "add_product"])
def test_sums_over_blocks_of_pairs(
    placed: BrightnessMap, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sums over blocks of pairs, as on a CPU, equal those over the sorted ends of pairs, as on CUDA."""
    # One thread writes to the sums
    monkeypatch.setattr("amiwarp.kernels.launch.cpu_threads", lambda: 1)
    monkeypatch.setattr("amiwarp.kernels.program.cpu_threads", lambda: 1)
    weight, found = placed.residuals.weight, []
    vectors = {
        "add_diagonal": [],
        "add_transpose": [placed.residuals.values],
        "add_product": [placed._image],
    }[name]
    for equations in (
        placed._equations,
        PairEnds(placed.pairs, placed._atlas, placed._positions.geometry),
    ):
        out, program = wp.zeros(len(placed.unknowns), dtype=wp.int64, device="cpu"), Program("cpu")
        equations.take_positions()
        getattr(equations, name)(program, weight, *vectors, [out])
        program.launch()
        found.append(out.numpy() * SCALE)
    assert np.count_nonzero(found[1]) > 1000
    np.testing.assert_allclose(*found, rtol=1e-5, atol=1e-4)


def test_residuals_over_blocks_of_pairs(placed: BrightnessMap) -> None:
    at, stride = placed._positions, placed.pairs.arrays.stride
    weight, values, rest = (wp.zeros(stride, dtype=float, device="cpu") for _ in "wvr")
    given = [placed.pairs.arrays, placed._atlas, at.geometry]
    wp.launch(equations_cuda.weigh, placed.count, [*given, placed._image, placed._scale, 0], [weight, values],
              device="cpu")  # fmt: skip
    n = placed.count
    np.testing.assert_allclose(
        placed.residuals.values.numpy()[:n], values.numpy()[:n], rtol=1e-5, atol=1e-5
    )
    np.testing.assert_allclose(
        placed.residuals.weight.numpy()[:n], weight.numpy()[:n], rtol=1e-5, atol=1e-5
    )
    assert not placed.residuals.weight.numpy()[n:].any()  # padding has no weight
    wp.launch(equations_cuda.subtract, n, [*given, placed._image, 0], [rest], device="cpu")
    other = wp.zeros(stride, dtype=float, device="cpu")
    placed._subtract(placed._image, other)
    np.testing.assert_allclose(other.numpy()[:n], rest.numpy()[:n], rtol=1e-5, atol=1e-5)


def test_slopes_over_blocks_of_pairs(placed: BrightnessMap, recording: Recording) -> None:
    at, n = placed._positions, placed.count
    assert recording.camera is not None
    sides = [
        {
            "model": ExactModel(recording.camera, TRUE_PRISM, TRUE_PHASE + shift),
            "drift": 0.0,
            "camera_rotation": None,
        }
        for shift in (0.01, -0.01)
    ]
    slope = placed.find_slope(*sides, 0.02).numpy()[:n]
    plus, minus = at._sides
    inputs = [placed.pairs.arrays, placed._atlas, plus, minus, placed._image, 0.02, 0]
    for side, values in zip((plus, minus), sides, strict=True):
        at.place(**values, out=side)
    other = wp.zeros(placed.pairs.arrays.stride, dtype=float, device="cpu")
    wp.launch(slope_between, n, inputs, [other], device="cpu")
    assert 1000 < np.count_nonzero(slope) < n  # some pairs are off the map
    np.testing.assert_allclose(slope, other.numpy()[:n], rtol=1e-4, atol=2e-4)


@pytest.mark.parametrize("distortion", [None, RadialTangential(-0.1)])
def test_a_slope_with_other_columns_leaves_the_pairs_as_they_are(
    placed: BrightnessMap, recording: Recording, distortion: RadialTangential | None
) -> None:
    """With a distortion, the pairs are placed one by one."""
    assert recording.camera is not None
    pairs = placed.pairs
    n = len(pairs)
    before = {name: getattr(pairs.arrays, name) for name in type(pairs.arrays)._cls.vars}
    camera = replace(recording.camera, distortion=distortion)
    at = {"model": ExactModel(camera, TRUE_PRISM, TRUE_PHASE), "camera_rotation": None}

    def change(factor: float, drift: float) -> np.ndarray:
        """Return the change of the residuals by a drift that turns all angles by ``factor`` times itself."""
        column = wp.full(2 * pairs.arrays.stride, factor, dtype=float, device="cpu")
        drifting = {**at, "arrays": pairs.with_columns(slope=column)}
        sides = {**drifting, "drift": drift}, {**drifting, "drift": -drift}
        return placed.find_slope(*sides, 1.0).numpy()[:n]

    twice = change(2.0, 0.005)
    assert np.abs(twice).max() > 0.1
    np.testing.assert_array_equal(twice, change(1.0, 0.01))
    assert (change(0.0, 0.01) == 0.0).all()

    other = pairs.with_columns(weak=0.5)
    assert other.weak == 0.5
    assert other.slope is pairs.arrays.slope
    for name, value in before.items():
        now = getattr(pairs.arrays, name)
        assert now is value or now == value, name


def test_only_pairs_of_two_events_cover_the_map(recording: Recording) -> None:
    assert recording.camera is not None
    assert recording.encoder is not None
    width, height = recording.events.size
    events = recording.events.slice(0, 20_000)
    table = EventTable([events], np.zeros((height, width), np.int32), "cpu")
    window = (int(events.t[0]), int(events.t[-1]) + 1)
    tiles = Tiles(np.array([[4.0, 3.0]], np.float32), height, width, 1.0)
    found = []
    for ends in ({}, {"window": window, "weak": 0.5}):
        pairs = table.pairs(recording.encoder, longest_gap_us=60_000, **ends)
        brightness = BrightnessMap(pairs, tiles)
        brightness.place(ExactModel(recording.camera, TRUE_PRISM, TRUE_PHASE))
        found.append((len(pairs), brightness.coverage()))
        assert pairs.arrays.weak == ends.get("weak", 0.0)
    (fewer, alone), (more, with_ends) = found
    assert more > fewer
    assert alone.max() > 1.0
    np.testing.assert_array_equal(alone, with_ends)


@pytest.mark.parametrize("linked", [False, True])
def test_steps_over_ranges_of_unknowns(linked: bool) -> None:
    """One step of conjugate gradients with one unknown per thread, and with many."""
    n, columns, rng = 3001, 60, np.random.default_rng(2)

    def floats(*shape: int) -> np.ndarray:
        return rng.uniform(0.5, 1.5, shape).astype(np.float32)

    links = floats(2, n)
    links[:, 3000:] = links[1, 2940:] = 0.0  # 50 rows of a map, and another unknown
    links[0, columns - 1 :: columns] = 0.0
    start = {
        name: floats(n) for name in ("diagonal", "residual", "direction", "product", "image", "z")
    }
    sums = rng.integers(2**30, 2**33, (3, n))

    def step(width: int) -> dict[str, np.ndarray]:
        v = {name: wp.array(values, dtype=float, device="cpu") for name, values in start.items()}
        u, dots, prior, parts = cg.Unknowns(), cg.Dots(), Prior(), -(-n // width)
        for name in ("diagonal", "residual", "direction", "product"):
            setattr(u, name, v[name])
        for name in ("pq", "rz"):
            setattr(dots, name, wp.full(parts, n / parts, dtype=wp.float64, device="cpu"))
        dots.scalars = wp.array([float(n), float(n)], dtype=wp.float64, device="cpu")
        prior.damping, prior.linked, prior.columns, prior.held = (
            wp.full(1, 0.3, device="cpu"),
            int(linked),
            columns,
            n,
        )
        prior.right, prior.down = (wp.array(links[k], device="cpu") for k in range(2))
        left = wp.array(sums, dtype=wp.int64, device="cpu")
        for kernel, inputs, outputs in (
            (cg.update_search_direction, [], [u, dots]), (cg.update_search_direction_with, [v["z"]], [u, dots]),
            (cg.finish_product, [left, prior], [u, dots]), (cg.descend, [], [v["image"], u, dots]),
        ):  # fmt: skip
            wp.launch(kernel, parts, [*inputs, width, 0], outputs, device="cpu")
        product = wp.empty(parts, dtype=wp.float64, device="cpu")
        wp.launch(cg.dot, parts, [u.residual, v["z"], width, 0], [product], device="cpu")
        assert not left.numpy().any()
        found = {name: values.numpy() for name, values in v.items()}
        return found | {k: getattr(dots, k).numpy().sum(keepdims=True) for k in ("pq", "rz")} | {
            "dot": product.numpy().sum(keepdims=True)
        }  # fmt: skip

    one, many = step(1), step(512)
    assert not np.array_equal(one["image"], start["image"])
    for name, values in one.items():
        np.testing.assert_allclose(many[name], values, rtol=2e-5, atol=2e-5, err_msg=name)


@pytest.mark.parametrize("shape", [(77, 83), (300, 400), (301, 402), (12, 13), (13, 700)])
def test_rows_of_grids(shape: tuple[int, int]) -> None:
    rows, columns = shape
    few_rows, few_columns = rows // 2 + 1, columns // 2 + 1
    rng, prior = np.random.default_rng(3), Prior()
    prior.smooth, prior.damping = (
        wp.full(1, value, dtype=float, device="cpu") for value in (0.01, 1e-6)
    )
    fine = wp.array(rng.normal(size=rows * columns).astype(np.float32), device="cpu")
    diagonal = wp.array(rng.random(few_rows * few_columns).astype(np.float32), device="cpu")
    one, other = ([wp.zeros_like(diagonal), wp.zeros_like(diagonal)] for _ in "oo")
    inputs = [fine, rows, columns, diagonal, prior, 4.0, 0]
    wp.launch(multilevel.restrict, few_rows * few_columns, inputs, one, device="cpu")
    wp.launch(multilevel.restrict_rows, few_rows, inputs, other, device="cpu")
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(b.numpy(), a.numpy(), rtol=1e-5, atol=1e-5)
    a, b = wp.clone(fine), wp.clone(fine)
    wp.launch(multilevel.prolong, rows * columns, [one[0], rows, columns, 0], [a], device="cpu")
    wp.launch(multilevel.prolong_rows, rows, [one[0], few_columns, columns, 0], [b], device="cpu")
    np.testing.assert_allclose(b.numpy(), a.numpy(), rtol=1e-5, atol=1e-5)


class OneThread:
    """Stand-in for a program on CUDA that runs its kernels on a CPU, where a block is one thread."""

    device = SimpleNamespace(is_cpu=False)

    def add(
        self, kernel: Any, n: int, inputs: list[Any], outputs: list[Any], *, smallest: int = 0
    ) -> None:
        wp.launch(
            kernel,
            1 if kernel is multilevel.correct_small else n,
            [*inputs, 0],
            outputs,
            device="cpu",
        )


@pytest.mark.parametrize("shape", [(9, 40), (12, 13), (40, 50), (77, 83), (301, 402), (13, 700)])
def test_corrections_of_small_grids_in_one_block(shape: tuple[int, int]) -> None:
    rng, prior, found = np.random.default_rng(4), Prior(), []
    prior.smooth, prior.damping = (
        wp.full(1, value, dtype=float, device="cpu") for value in (0.01, 1e-6)
    )
    residual, diagonal = (
        rng.uniform(0.5, 1.5, shape[0] * shape[1]).astype(np.float32) for _ in "rd"
    )
    for program in (Program("cpu"), OneThread()):
        grids, out = (
            GridHierarchy(*shape, wp.get_device("cpu")),
            wp.zeros(len(residual), dtype=float, device="cpu"),
        )
        for k, part in enumerate(grids._diagonal):
            part.fill_(0.5 + k)
        grids.correct(
            program, wp.array(diagonal, device="cpu"), prior, wp.array(residual, device="cpu"), out
        )
        if isinstance(program, Program):
            program.launch()
        found.append(out.numpy())
    # It has one grid only
    assert np.allclose(found[0], residual / diagonal, rtol=0.1) == (shape == (9, 40))
    np.testing.assert_allclose(*found, rtol=1e-5)


@pytest.mark.parametrize("drift", [0.0, 0.3])
@pytest.mark.parametrize(
    "rotation",
    [
        CameraRotation(),
        CameraRotation((0.3, -0.2, 0.5), (1.0, 0.0, -2.0), growth=0.6),
        CameraRotation(growth=0.6),
    ],
    ids=["still", "turns", "grows"],
)
def test_positions_of_blocks_of_pairs(
    recording: Recording, drift: float, rotation: CameraRotation
) -> None:
    """A camera without distortion is fast; with a distortion of zero it takes the general path."""
    assert recording.camera is not None
    assert recording.encoder is not None
    width, height = recording.events.size
    table = EventTable(
        [recording.events.slice(0, 60_000)], np.zeros((height, width), np.int32), "cpu"
    )
    pairs = table.pairs(recording.encoder, longest_gap_us=60_000)
    if drift:
        pairs = pairs.with_slope(lambda t: t * 1e-6, 0)
    tiles = Tiles(np.array([[4.0, 3.0]], np.float32), height, width, 1.0)
    brightness = BrightnessMap(pairs, tiles)
    found = []
    for camera in (recording.camera, replace(recording.camera, distortion=RadialTangential())):
        brightness.place(
            ExactModel(camera, TRUE_PRISM, TRUE_PHASE), drift=drift, camera_rotation=rotation
        )
        g, n = brightness._positions.geometry, len(pairs)
        cell = g.cell.numpy().reshape(2, -1)[:, :n]
        part = g.part.numpy().reshape(2, 2, -1)[:, :, :n]
        at = np.stack([cell % tiles.columns, cell // tiles.columns], axis=1) + part
        found.append(np.where(cell[:, None] >= 0, at, np.nan))
    both = np.isfinite(found).all(axis=0)
    assert both.mean() > 0.5
    assert (np.isfinite(found[0]) != np.isfinite(found[1])).mean() < 1e-3
    np.testing.assert_allclose(found[0][both], found[1][both], rtol=0, atol=2e-3)
