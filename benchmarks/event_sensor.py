"""Speed of :class:`amiwarp.EventSensor`, and the error of its events. Prints JSON, one row per line.

    python -m benchmarks.event_sensor [--device cuda:0] [--cameras 1 16 256] [--side 128] [--steps 200]
        [--models default davis346 dvxplorer]

Each camera sees waves of its own direction. The images lie on the device, and drawing them is not included; events stay
on the device. ``realtime`` is simulated time over elapsed time: above 1, all cameras are faster than real time.
``grids`` also makes a voxel grid of 5 bins for each camera and step. ``cpu_ms`` is the processor time of a step, which
depends less on other load.

Two errors are measured in the same run: the number of values in the events of three cameras that differ from those of a
sensor with one camera, which must be 0; and the largest distance between the times of events on ramps of the log
intensity and the exact times [us].
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
from typing import Any

import numpy as np
import warp as wp

from amiwarp import DeviceEvents, EventSensor, SensorModel, Windows, voxel_grid

STEP_US, IMAGES = 1000, 16
"""Time between two images [us], and the number of different images of each camera: a period of its waves."""


def waves(cameras: int, side: int) -> np.ndarray:
    """Return log intensities, shape (IMAGES, cameras, side, side): in a period, waves move by their length."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:side, :side] / side
    turn, contrast = (
        rng.uniform(low, high, (cameras, 1, 1)) for low, high in ((0.0, 2.0 * math.pi), (0.2, 0.45))
    )
    phase = 2.0 * math.pi * 4.0 * (x * np.cos(turn) + y * np.sin(turn))
    images = np.empty((IMAGES, cameras, side, side), np.float32)
    for k in range(IMAGES):
        images[k] = np.log(0.52 + contrast * np.sin(phase - 2.0 * math.pi * k / IMAGES))
    return images


def differing(images: np.ndarray, cameras: int, device: str) -> int:
    """Return the number of values in the events of three cameras that differ from those of a sensor with one camera."""
    side, chosen = images.shape[-1], sorted({0, cameras // 2, cameras - 1})
    together = EventSensor(cameras, side, side, device=device)
    alone = [EventSensor(1, side, side, seed=k, device=device) for k in chosen]
    wrong = 0
    for step in range(4):
        events, found = together.step(images[step], step * STEP_US)
        host = events.to_host()
        for k, sensor in zip(chosen, alone, strict=True):
            own = host[int(found.start[k]) : int(found.stop[k])]
            other = sensor.step(images[step, k : k + 1], step * STEP_US)[0].to_host()
            if len(own) != len(other):
                wrong += abs(len(own) - len(other))
                continue
            wrong += int(
                sum(
                    np.count_nonzero(getattr(own, n) != getattr(other, n))
                    for n in ("x", "y", "t", "p")
                )
            )
    return wrong


def ramp_error_us(cameras: int, side: int, device: str) -> float:
    """Return the largest error of the times of events of ideal pixels on ramps that last one step [us].

    It is infinite if a pixel has a wrong number of events.
    """
    contrast, length = 0.2, 10_000
    rise = (0.3 + np.arange(cameras * side * side) % 7 * 0.23).reshape(cameras, side, side)
    sensor = EventSensor(cameras, side, side, SensorModel.ideal(contrast), device=device)
    sensor.step(np.zeros_like(rise, np.float32), 0)
    events, found = sensor.step(rise.astype(np.float32), length)
    host = events.to_host()
    camera = np.repeat(np.arange(cameras), found.stop - found.start)
    pixel = (camera * side + host.y) * side + host.x
    order = np.lexsort((host.t, pixel))
    count = (rise.ravel() / contrast).astype(int)
    if not np.array_equal(np.bincount(pixel, minlength=rise.size), count):
        return math.inf
    number = np.arange(len(pixel)) - np.repeat(np.cumsum(count) - count, count) + 1
    return float(
        np.abs(host.t[order] - number * contrast / rise.ravel()[pixel[order]] * length).max()
    )


def timed(
    images: list[Any], model: SensorModel, steps: int, device: str, grids: bool
) -> tuple[float, float, int]:
    """Return the elapsed and the processor time of a step [s], and the number of events of all steps."""
    cameras, side, _ = images[0].shape
    sensor, count = EventSensor(cameras, side, side, model, device=device), 0

    def one(k: int) -> int:
        found: tuple[DeviceEvents, Windows] = sensor.step(images[k % IMAGES], k * STEP_US)
        if grids:
            voxel_grid(found[0], side, side, bins=5, windows=found[1])
        return len(found[0])

    for k in range(IMAGES):
        one(k)
    wp.synchronize_device(device)
    began = time.perf_counter()
    processor = time.process_time()
    for k in range(IMAGES, IMAGES + steps):
        count += one(k)
    wp.synchronize_device(device)
    elapsed = time.perf_counter() - began
    return elapsed / steps, (time.process_time() - processor) / steps, count


def row(cameras: int, side: int, steps: int, device: str, name_of_model: str) -> dict[str, Any]:
    of_default = name_of_model == "default"
    model = SensorModel() if of_default else SensorModel.preset(name_of_model)
    host = waves(cameras, side)
    images = [wp.array(batch, dtype=float, device=device) for batch in host]
    result: dict[str, Any] = {"cameras": cameras, "side": side, "step_us": STEP_US}
    result["model"] = name_of_model
    for name, grids in (("events", False), ("grids", True)):
        seconds, processor, count = timed(images, model, steps, device, grids)
        result[name] = {"step_ms": 1e3 * seconds, "cpu_ms": 1e3 * processor, "realtime": STEP_US * 1e-6 / seconds,
                        "events_per_s": count / steps / seconds}  # fmt: skip
        result["events_per_step"] = count / steps
    result["differing"] = differing(host, cameras, device)
    result["ramp_error_us"] = ramp_error_us(cameras, side, device)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cameras", type=int, nargs="+", default=[1, 16, 256])
    parser.add_argument("--side", type=int, default=128)
    parser.add_argument("--steps", type=int, default=200)
    models = ("default", "davis346", "dvxplorer", "gen4")
    parser.add_argument("--models", nargs="+", choices=models, default=["default"])
    arguments = parser.parse_args()
    wp.init()
    print(json.dumps({"device": wp.get_device(arguments.device).name}))
    for cameras, model in itertools.product(arguments.cameras, arguments.models):
        result = row(cameras, arguments.side, arguments.steps, arguments.device, model)
        print(json.dumps(result), flush=True)
        if result["differing"] or not result["ramp_error_us"] <= 1.0:
            raise SystemExit(
                "wrong answer: events differ from those of one camera, or come at wrong times"
            )


if __name__ == "__main__":
    main()
