"""The study of drones that hover: how they fly, what the expert does, what a policy learns from."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from benchmarks import hover, hover_drones, hover_policy  # noqa: E402
from benchmarks.hover_drones import Drones, Flight  # noqa: E402


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Let PyTorch use one thread: several that wait for each other take much longer beside other tests."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def rng(seed: int = 0) -> Any:
    return torch.Generator("cpu").manual_seed(seed)


def flight_of(place: tuple[float, float]) -> Flight:
    """Return one drone at rest."""
    rest = torch.zeros((1, 2))
    return Flight(torch.tensor([place]), rest, rest.clone(), rest.clone())


def test_a_drone_falls_along_its_tilt_after_the_lag(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hover_drones, "WIND", 0.0)
    flight = flight_of((0.0, 0.0))
    command = torch.tensor([[0.1, -0.05]])
    for _ in range(50):
        flight = flight.advance(command, rng())
    # After 1 s: lag of 0.1 s, then g tan(tilt) against a drag of 0.2/s
    lag, drag = hover_drones.TILT_LAG_S, hover_drones.DRAG_PER_S
    share = (1.0 - math.exp(-drag)) / drag
    ahead = (math.exp(-drag) - math.exp(-1.0 / lag)) / (1.0 / lag - drag)
    expected = hover_drones.GRAVITY * (share - ahead) * np.tan([0.1, -0.05])
    np.testing.assert_allclose(flight.speed[0].numpy(), expected, rtol=0.02)
    assert flight.place[0, 0] > 0 > flight.place[0, 1]


def test_the_thrust_of_a_tilted_drone_points_to_where_it_accelerates() -> None:
    flight = flight_of((0.3, -0.2))
    flight.tilt = torch.tensor([[0.1, -0.05]])
    x, y, z, *quaternion = flight.poses()[0].double().tolist()
    assert (x, y, z) == pytest.approx((0.3, -0.2, hover_drones.HEIGHT_M))
    i, j, k, w = quaternion
    assert i * i + j * j + k * k + w * w == pytest.approx(1.0, abs=1e-6)
    up = np.array([2 * (i * k + j * w), 2 * (j * k - i * w), 1 - 2 * (i * i + j * j)])
    np.testing.assert_allclose(
        up, [math.sin(0.1) * math.cos(0.05), -math.sin(0.05), 0.99], atol=6e-3
    )


def test_the_expert_brings_drones_back_through_the_wind() -> None:
    drones = Drones(16, "blind", 3, "cpu")
    score = hover.score_of(drones, lambda _: hover_policy.expert(drones.flight), 300)
    assert score.rms_m < 0.1
    assert score.lost == 0.0
    idle = hover.score_of(drones, lambda _: torch.zeros((16, 2)), 300)
    assert idle.lost > 0.3


def test_a_policy_learns_what_the_expert_would_do() -> None:
    drones = Drones(2, "blind", 0, "cpu")
    # The mark is always to the east: even without eyes, this can be learnt
    drones.start = lambda: _east(drones)  # type: ignore[method-assign]
    torch.manual_seed(0)
    policy = hover_policy.Policy()
    optimiser = torch.optim.Adam(policy.parameters(), 5e-3)
    errors = [hover.train_flight(policy, optimiser, drones, 1.0, 25) for _ in range(6)]
    assert errors[-1] < 0.5 * errors[0]


def _east(drones: Drones) -> Any:
    drones.flight = flight_of((0.25, 0.0))
    drones.flight = Flight(*(value.expand(2, 2) for value in vars(drones.flight).values()))
    return torch.zeros((2, hover_drones.BINS, hover_drones.SIDE, hover_drones.SIDE))


def test_drones_that_are_lost_are_counted_and_do_not_spoil_the_distance() -> None:
    drones = Drones(8, "blind", 0, "cpu")
    away = torch.zeros((8, 2))
    away[:4, 0] = hover_drones.MOST_TILT

    def command(_: Any) -> Any:
        kept = hover_policy.expert(drones.flight)
        return torch.where(away > 0, away, kept)

    score = hover.score_of(drones, command, 150)
    assert score.lost == 0.5
    assert score.rms_m < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "prism"])
def test_drones_at_rest_are_seen_through_the_prism_only(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("newton")
    monkeypatch.setattr(hover_drones, "WIND", 0.0)
    drones = Drones(1, kind, 0, "cpu")
    drones.start()
    drones.flight = flight_of((0.1, 0.0))
    drones.advance(torch.zeros((1, 2)))  # it jumps to its place
    drones.events = 0
    grids = drones.advance(torch.zeros((1, 2)))
    assert grids.shape == (1, hover_drones.BINS, hover_drones.SIDE, hover_drones.SIDE)
    assert (drones.events > 1000) == (kind == "prism")
    known = drones.known()[0, 2:]
    assert float(known.norm()) == pytest.approx(1.0 if kind == "prism" else 0.0, abs=1e-6)
