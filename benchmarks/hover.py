"""A policy that holds a drone over a mark at rest, by a plain event camera, through a prism, or blind.

    python -m benchmarks.hover train prism --minutes 10 --device cuda:0 --out prism.json --weights prism.pt
    python -m benchmarks.hover film prism --weights prism.pt --drones 4 --out prism.mp4

Needs PyTorch and Newton. Drones of one batch fly over worlds of their own, in wind. A network of the same size and the
same number of seconds of training commands them by the events of each step of 20 ms (``hover_drones.py``,
``hover_policy.py``). After each round of training, drones over worlds that were not trained on fly for 6 s; the score
is their distance from the mark in the last 2 s [m rms], and the share that was lost. The expert, who knows place and
velocity, flies the same worlds.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from amiwarp.reconstruction.film_files import save_film
from amiwarp.studies.machine import machine
from benchmarks.hover_drones import KINDS, LOST_M, SIDE, STEP_US, Drones, Flight
from benchmarks.hover_policy import Policy, expert

FLIGHT_STEPS = 300
"""Steps of a flight of 6 s."""
LAST_STEPS = 100
"""Steps at the end of a flight that count for the score."""
PIECE = 25
"""Steps through which gradients go back."""
MAP_SIDE = 256
"""Width of the map of a film [px]."""
NEW_WORLDS = 100_000
"""Seed of the worlds of the score; those of the training begin at 0."""


@dataclass(frozen=True)
class Score:
    """How well drones hold their place."""

    rms_m: float
    """Distance from the mark over the last steps of the drones that were not lost [m]."""
    lost: float
    """Share of drones that were lost."""
    events_per_step: float
    """Mean number of events of a drone in a step."""


def score_of(drones: Drones, command_of: Callable[[Tensor], Tensor], steps: int) -> Score:
    """Fly drones by a function that takes what they see, and return how well they hold their place."""
    grids = drones.start()
    lost = torch.zeros(drones.count, dtype=torch.bool, device=drones.device)
    square = torch.zeros(drones.count, device=drones.device)
    counted = min(LAST_STEPS, steps)
    for k in range(steps):
        grids = drones.advance(command_of(grids))
        lost |= drones.flight.lost()
        if k >= steps - counted:
            square += (drones.flight.place**2).sum(dim=1) / counted
    kept = square[~lost]
    rms = float(kept.mean().sqrt()) if len(kept) else float("nan")
    return Score(rms, float(lost.float().mean()), drones.events / (steps * drones.count))


def score_of_policy(policy: Policy, drones: Drones, steps: int) -> Score:
    """Return the score of a policy."""
    memory = policy.start(drones.count, drones.device)

    def command(grids: Tensor) -> Tensor:
        nonlocal memory
        tilt, _, memory = policy(grids, drones.known(), memory)
        return tilt

    with torch.no_grad():
        return score_of(drones, command, steps)


def train_flight(
    policy: Policy,
    optimiser: torch.optim.Optimizer,
    drones: Drones,
    by_expert: float,
    steps: int,
) -> float:
    """Fly once and learn on the way, and return the mean error of the commands [rad rms].

    A drone of the share ``by_expert`` flies by the expert's command, all others by the policy's.
    """
    device = drones.device
    expert_flies = (torch.rand(drones.count, 1) < by_expert).to(device)
    memory = policy.start(drones.count, device)
    grids = drones.start()
    loss = torch.zeros((), device=device)
    whole = 0.0
    for k in range(steps):
        command, guess, memory = policy(grids, drones.known(), memory)
        flight = drones.flight
        right = expert(flight)
        # Drones that were lost see no mark any more: they do not count
        counts = (~flight.lost()).float()[:, None]
        error = counts * (command - right) ** 2
        truth = torch.cat([flight.place, flight.speed], dim=1)
        loss = loss + 100.0 * error.mean() + (counts * (guess - truth) ** 2).mean()
        whole += float(error.detach().mean())
        if (k + 1) % PIECE == 0 or k + 1 == steps:
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
            optimiser.step()
            loss = torch.zeros((), device=device)
            memory = memory.detach()
        with torch.no_grad():
            grids = drones.advance(torch.where(expert_flies, right, command.detach()))
    return float(np.sqrt(whole / steps))


def train(
    kind: str,
    device: str,
    drones: int,
    minutes: float,
    seed: int,
    steps: int = FLIGHT_STEPS,
    fleets: int = 8,
) -> tuple[Policy, dict[str, Any]]:
    """Train a policy for some minutes, and return it with its curve and scores.

    Training goes round over ``fleets`` batches of worlds. Scores are not part of the time.
    """
    torch.manual_seed(seed)
    policy = Policy().to(device)
    optimiser = torch.optim.Adam(policy.parameters(), 1e-3)
    trained = [Drones(drones, kind, 1000 * seed + k, device) for k in range(fleets)]
    fresh = Drones(drones, kind, NEW_WORLDS, device)
    by_expert = score_of(fresh, lambda _: expert(fresh.flight), steps)
    at_rest = score_of(fresh, lambda _: torch.zeros((drones, 2), device=device), steps)
    curve = []
    spent = 0.0
    flights = 0
    while spent < 60.0 * minutes:
        began = time.perf_counter()
        errors = []
        for fleet in trained:
            share = max(0.0, 1.0 - flights / 16)
            errors.append(train_flight(policy, optimiser, fleet, share, steps))
            flights += 1
        spent += time.perf_counter() - began
        # The last fifth of the time goes on with smaller steps
        for group in optimiser.param_groups:
            group["lr"] = 2e-4 if spent > 48.0 * minutes else 1e-3
        score = score_of_policy(policy, fresh, steps)
        row = {"minutes": spent / 60.0, "flights": flights * drones, "error_rad": errors[-1]}
        curve.append(row | asdict(score))
        print(kind, json.dumps(curve[-1]), flush=True)
    return policy, {
        "kind": kind,
        "machine": machine(device),
        "drones": drones,
        "seed": seed,
        "step_us": STEP_US,
        "steps": steps,
        "expert": asdict(by_expert),
        "without_commands": asdict(at_rest),
        "curve": curve,
    }


def ground_map(flight: Flight, drone: int, trail: list[tuple[int, int]]) -> NDArray[np.uint8]:
    """Return a map of the ground with the mark and the way of a drone, to which its place is added."""
    picture = np.full((MAP_SIDE, MAP_SIDE), 60, np.uint8)
    middle = MAP_SIDE // 2
    per_m = MAP_SIDE / (2.0 * LOST_M)
    arm, half = round(0.3 * per_m), round(0.06 * per_m)
    picture[middle - half : middle + half, middle - arm : middle + arm] = 130
    picture[middle - arm : middle + arm, middle - half : middle + half] = 130
    east, north = (per_m * flight.place[drone]).round().int().tolist()
    trail.append((middle - north, middle + east))
    for row, column in trail[:-1]:
        picture[max(row, 0) : row + 1, max(column, 0) : column + 1] = 200
    row, column = trail[-1]
    picture[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4] = 255
    return picture


def film_frames(policy: Policy, drones: Drones, steps: int) -> Iterator[NDArray[np.uint8]]:
    """Fly, and yield a frame of each step: above what the drones see, below where they are."""
    memory = policy.start(drones.count, drones.device)
    grids = drones.start()
    trails: list[list[tuple[int, int]]] = [[] for _ in range(drones.count)]
    larger = MAP_SIDE // SIDE
    for _ in range(steps):
        with torch.no_grad():
            tilt, _, memory = policy(grids, drones.known(), memory)
            grids = drones.advance(tilt)
        seen = 128.0 + 40.0 * grids.sum(dim=1).cpu().numpy()
        grey = np.clip(seen, 0, 255).astype(np.uint8).repeat(larger, axis=1).repeat(larger, axis=2)
        maps = [ground_map(drones.flight, k, trail) for k, trail in enumerate(trails)]
        yield np.vstack([np.hstack(list(grey)), np.hstack(maps)])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=["train", "film"])
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--drones", type=int, default=64)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=FLIGHT_STEPS)
    parser.add_argument("--fleets", type=int, default=8)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    if given.what == "film":
        policy = Policy().to(given.device)
        policy.load_state_dict(torch.load(given.weights, map_location=given.device))
        drones = Drones(given.drones, given.kind, NEW_WORLDS + 1, given.device)
        frames = film_frames(policy, drones, given.steps)
        save_film(frames, given.out, fps=1e6 / STEP_US, overwrite=True)
        return
    policy, found = train(
        given.kind, given.device, given.drones, given.minutes, given.seed, given.steps, given.fleets
    )
    given.out.write_text(json.dumps(found, indent=1) + "\n")
    if given.weights:
        torch.save(policy.state_dict(), given.weights)


if __name__ == "__main__":
    main()
