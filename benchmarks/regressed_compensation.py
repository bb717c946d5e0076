"""A network that regresses the compensation of each event, and its spiking conversion, beside exact refraction.

    python -m benchmarks.regressed_compensation --out FILE.json [--figure FILE.png] [--steps N]

He et al. (2024) suggest to regress the compensation by a network, which could also spike. Here a perceptron with two
hidden layers learns the displacement of a pixel of a 640 × 480 camera (60°, apex 1°) from its place and the cosine and
sine of the angle. It learns from exact refraction itself, the best case: with events alone it could only be worse. Each
row states its error on places and angles that it has not seen, what it computes for an event, and the processor time,
beside amiwarp's exact model over the same events. The spiking network has the same weights: each rectified unit becomes
a neuron that integrates its input and fires (B. Rueckauer et al., "Conversion of continuous-valued deep networks to
efficient event-driven networks for image classification", Frontiers in Neuroscience, 2017), for a number of time steps
for each event.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp import Camera, Encoder, Events, ExactModel, Prism, compensate_events
from amiwarp.studies.machine import machine, versions

Array = NDArray[np.float32]

WIDTH = 640
HEIGHT = 480
PHASE = 0.7
WIDTHS = (8, 16, 32, 64, 128)
"""Numbers of units of each hidden layer."""
SPIKING_STEPS = (16, 64, 256, 1024, 4096)
BATCH = 4096
RATE = 3e-3
"""Step size of Adam at the start; it falls to 0 along a half cosine."""
TESTED = 200_000
SPIKING_TESTED = 2_000


def samples(model: ExactModel, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return inputs of events at random places and angles, shape (n, 4), and their displacements [px], (n, 2)."""
    places = rng.uniform((0.0, 0.0), (WIDTH - 1.0, HEIGHT - 1.0), (count, 2))
    angles = rng.uniform(0.0, math.tau, count)
    moved = model.compensate_points(places, angles) - places
    return inputs_of(places, angles), moved.astype(np.float32)


def inputs_of(places: NDArray[Any], angles: NDArray[Any]) -> Array:
    """Return places from -1 to 1, and cosine and sine of angles, shape (n, 4)."""
    x = 2.0 * places[:, 0] / (WIDTH - 1.0) - 1.0
    y = 2.0 * places[:, 1] / (HEIGHT - 1.0) - 1.0
    return np.stack([x, y, np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)


@dataclass
class Network:
    """Two hidden layers of rectified units."""

    weights: list[Array]
    biases: list[Array]

    @classmethod
    def random(cls, width: int, rng: np.random.Generator) -> Network:
        """Return a network with random weights (K. He et al., "Delving deep into rectifiers", ICCV 2015)."""
        sizes = [4, width, width, 2]
        pairs = list(pairwise(sizes))
        weights = [rng.normal(0.0, math.sqrt(2.0 / a), (a, b)).astype(np.float32) for a, b in pairs]
        return cls(weights, [np.zeros(b, np.float32) for _, b in pairs])

    @property
    def additions(self) -> int:
        """Number of multiplications with addition for an event."""
        return sum(weight.size for weight in self.weights)

    def layers(self, inputs: Array) -> list[Array]:
        """Return the values of all layers, the inputs first."""
        values = [inputs]
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            out = values[-1] @ weight + bias
            values.append(out if k == len(self.weights) - 1 else np.maximum(out, 0.0))
        return values

    def gradients(self, inputs: Array, wanted: Array) -> list[Array]:
        """Return the gradients of the mean squared error, of all weights and then all biases."""
        values = self.layers(inputs)
        back = 2.0 * (values[-1] - wanted) / len(inputs)
        of_weights: list[Array] = []
        of_biases: list[Array] = []
        for k in reversed(range(len(self.weights))):
            of_weights.insert(0, values[k].T @ back)
            of_biases.insert(0, back.sum(axis=0))
            back = (back @ self.weights[k].T) * (values[k] > 0.0)
        return of_weights + of_biases


def train(network: Network, model: ExactModel, steps: int, rng: np.random.Generator) -> None:
    """Train a network by Adam (Kingma and Ba, ICLR 2015)."""
    parameters = network.weights + network.biases
    first = [np.zeros_like(p) for p in parameters]
    second = [np.zeros_like(p) for p in parameters]
    inputs, wanted = samples(model, 100 * BATCH, rng)
    for step in range(1, steps + 1):
        chosen = rng.integers(0, len(inputs), BATCH)
        rate = RATE * 0.5 * (1.0 + math.cos(math.pi * step / steps))
        rate *= math.sqrt(1.0 - 0.999**step) / (1.0 - 0.9**step)
        gradients = network.gradients(inputs[chosen], wanted[chosen])
        for p, g, m, v in zip(parameters, gradients, first, second, strict=True):
            m += 0.1 * (g - m)
            v += 0.001 * (g * g - v)
            p -= (rate * m / (np.sqrt(v) + 1e-8)).astype(np.float32)


def spiking(network: Network, inputs: Array, steps: int) -> tuple[NDArray[Any], float]:
    """Return the displacements that a spiking network finds [px], and its additions for an event.

    The inputs and biases are constant currents. A neuron whose potential reaches 1 fires and loses 1. Its threshold
    stands for the largest value of its layer.
    """
    values = network.layers(inputs)
    largest = [1.0, *(float(np.percentile(v, 99.9)) for v in values[1:-1])]
    potentials = [np.zeros_like(v) for v in values[1:]]
    additions = 0
    for _ in range(steps):
        sent = inputs
        for k, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
            potentials[k] += (largest[k] * (sent @ weight) + bias) / steps_scale(largest, k)
            if k == len(network.weights) - 1:
                break
            fired = potentials[k] >= 1.0
            potentials[k] -= fired
            sent = fired.astype(np.float32)
            additions += int(fired.sum()) * network.weights[k + 1].shape[1]
    return potentials[-1] / steps, additions / len(inputs)


def steps_scale(largest: list[float], layer: int) -> float:
    """Return the value of a layer for which a neuron fires in each step; 1 for the outputs."""
    return largest[layer + 1] if layer + 1 < len(largest) else 1.0


def rms(found: NDArray[Any], wanted: NDArray[Any]) -> float:
    """Return the rms length of differences [px]."""
    return float(np.sqrt(((found - wanted) ** 2).sum(axis=1).mean()))


def processor_time(work: Callable[[], Any]) -> float:
    """Return the shortest processor time of some runs [s]."""
    taken = []
    for _ in range(5):
        before = time.process_time()
        work()
        taken.append(time.process_time() - before)
    return min(taken)


def exact_time(model: ExactModel, rng: np.random.Generator) -> tuple[float, float]:
    """Return amiwarp's processor time for an event [s], and its error against the model in float64 [px]."""
    x = rng.integers(0, WIDTH, TESTED)
    y = rng.integers(0, HEIGHT, TESTED)
    t = np.sort(rng.integers(0, 83_333, TESTED))
    events = Events.from_arrays(x, y, t, rng.integers(0, 2, TESTED))
    encoder = Encoder.constant_speed(720.0, 0, 83_334)
    found = compensate_events(events, model, encoder)
    places = np.stack([x, y], axis=1).astype(np.float64)
    error = rms(found, model.compensate_points(places, encoder.angle_at(events.t)))
    return processor_time(lambda: compensate_events(events, model, encoder)) / TESTED, error


def figure(rows: list[dict[str, Any]], exact: dict[str, float], path: Path) -> None:
    """Draw error against additions for an event."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(6.4, 4.0), dpi=110, layout="constrained")
    FigureCanvasAgg(drawing)
    axes = drawing.subplots()
    axes.loglog(
        [row["additions"] for row in rows], [row["error_px"] for row in rows], "o-", label="network"
    )
    for row in rows:
        spikes = row["spiking"]
        axes.loglog(
            [s["additions"] for s in spikes],
            [s["error_px"] for s in spikes],
            ".--",
            alpha=0.6,
            label=f"spiking, {row['width']} units",
        )
    axes.axhline(exact["error_px"], color="black", lw=1.0, label="exact refraction")
    axes.set(xlabel="additions for an event", ylabel="error [px rms]")
    axes.legend(fontsize=8)
    drawing.savefig(path)


def main() -> int:
    """Train, convert, measure and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--steps", type=int, default=6000)
    args = parser.parse_args()
    camera = Camera.from_fov(WIDTH, HEIGHT, math.radians(60.0))
    model = ExactModel(camera, Prism(math.radians(1.0)), PHASE)
    rng = np.random.default_rng(0)
    inputs, wanted = samples(model, TESTED, rng)
    seconds, error = exact_time(model, rng)
    exact = {"error_px": error, "ns_per_event": 1e9 * seconds}
    print(f"exact refraction: {error:.6f} px, {1e9 * seconds:.1f} ns of a processor for an event")
    rows = []
    for width in WIDTHS:
        network = Network.random(width, rng)
        train(network, model, args.steps, rng)
        found = network.layers(inputs)[-1]
        row: dict[str, Any] = {
            "width": width,
            "parameters": sum(p.size for p in network.weights + network.biases),
            "additions": network.additions,
            "error_px": rms(found, wanted),
            "ns_per_event": 1e9 * processor_time(partial(network.layers, inputs)) / TESTED,
            "spiking": [],
        }
        few = inputs[:SPIKING_TESTED]
        for steps in SPIKING_STEPS:
            spiked, additions = spiking(network, few, steps)
            row["spiking"].append(
                {
                    "steps": steps,
                    "additions": additions,
                    "error_px": rms(spiked, wanted[:SPIKING_TESTED]),
                }
            )
        rows.append(row)
        last = row["spiking"][-1]
        print(
            f"{width} units: {row['error_px']:.4f} px, {row['additions']} additions, {row['ns_per_event']:.0f} ns; "
            f"spiking {last['steps']} steps: {last['error_px']:.4f} px, {last['additions']:.0f} additions",
            flush=True,
        )
    about = {"machine": machine("cpu"), "versions": versions(["warp-lang", "numpy"])}
    text = json.dumps({**about, "steps": args.steps, "exact": exact, "rows": rows}, indent=1)
    args.out.write_text(text + "\n", encoding="utf-8")
    if args.figure is not None:
        figure(rows, exact, args.figure)
    return 0


if __name__ == "__main__":
    sys.exit(main())
