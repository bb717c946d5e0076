"""Event cameras in Newton: error of the prism that they see, and speed of many cameras. Prints JSON, one row per line.

    python -m benchmarks.sensors prism [--device cuda:0] [--size 320 240]
    python -m benchmarks.sensors speed [--device cuda:0] [--cameras 1 64 1024] [--side 128] [--steps 20] [--own-angles]

``prism``: a textured wall that fills the view, seen through a prism of 1 deg at 720 rpm for two turns by an ideal
sensor, in Newton and by :func:`amiwarp.simulate` with the wall as a picture at infinity. Both recordings are
calibrated, and the distance of the displacements from the true ones is said [px rms], also of both calibrations from
each other.

``speed``: boxes in each world, cameras that rest behind turning prisms. Times of a step of 4 ms [s]: ``whole``, a
step as users call it; ``with_tensors``, and voxel grids of 5 bins; ``render``, Newton alone with ready rays, for as
many pictures; ``rays``, making these. And the device's memory.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import amiwarp
from amiwarp.optics.models.comparison import predicted_error
from amiwarp.sensors import NewtonEventCamera

HALF = 0.9
"""Tangent of the angle between the middle of the wall and its edge."""
WALL = 3.0
"""Distance of the wall [m]."""
TEXELS = 2048
"""Width of its texture."""
FINEST_PX = 5.0
"""Wave length, over 2 pi, of the finest patches [px]."""
RPM = 720.0
STEP_US = 4000


def texture(side: int, finest: float) -> np.ndarray:
    """Return the luminance of the wall: smooth random patches, without what is finer than some texels."""
    rng = np.random.default_rng(0)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    coarse = 20.0 * finest
    share = np.exp(-0.5 * (frequency * finest) ** 2)
    share *= -np.expm1(-0.5 * (frequency * coarse) ** 2)
    noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal((side, side))) * share).real
    return np.clip(0.5 + 0.18 * noise / noise.std(), 0.05, 1.0)


def coded(light: np.ndarray) -> np.ndarray:
    """Return 8-bit sRGB values of linear luminance, with three equal colours."""
    curved = np.where(light < 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return np.repeat(np.rint(255.0 * curved).astype(np.uint8)[..., None], 3, axis=2)


def wall_model(picture: np.ndarray, device: str) -> Any:
    """Return a model of Newton with the wall before a camera at the origin that looks along -z."""
    import newton

    half = WALL * HALF
    corners = [[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]]
    mesh = newton.Mesh(
        np.array(corners, np.float32),
        np.array([0, 1, 2, 0, 2, 3], np.int32),
        uvs=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32),
        texture=picture,
        compute_inertia=False,
    )
    builder = newton.ModelBuilder()
    place = wp.transform((0.0, 0.0, -WALL), wp.quat_identity())
    builder.add_shape_mesh(-1, xform=place, mesh=mesh, color=(1.0, 1.0, 1.0))
    return builder.finalize(device=device)


def newton_recording(
    optic: amiwarp.ExactModel,
    picture: np.ndarray,
    sensor: amiwarp.SensorModel,
    end_us: int,
    device: str,
) -> amiwarp.Recording:
    """Return what an event camera in Newton records of the wall."""
    model = wall_model(picture, device)
    eyes = NewtonEventCamera(
        model,
        optic.camera,
        optic,
        motion=amiwarp.PrismMotion(RPM),
        sensor=sensor,
        rays_per_pixel=16,
    )
    eyes.renderer.sensor.set_ambient_light((1.0, 1.0, 1.0))
    eyes.renderer.sensor.create_default_light(color=(0.0, 0.0, 0.0))
    state = model.state()
    steps = [eyes.step(state, t) for t in range(0, end_us + 1, STEP_US)]
    return eyes.recording(steps, prism=optic.prism)


def prism_row(size: tuple[int, int], device: str) -> dict[str, Any]:
    """Return the errors of the calibrations of both recordings."""
    camera = amiwarp.Camera.from_fov(*size, math.radians(60.0))
    prism = amiwarp.Prism(math.radians(1.0))
    optic = amiwarp.ExactModel.from_prism(camera, prism, 0.4)
    sensor = amiwarp.SensorModel.ideal(0.1)
    texels_per_px = TEXELS / (2.0 * HALF * camera.fx)
    picture = coded(texture(TEXELS, FINEST_PX * texels_per_px))
    end_us = 42 * STEP_US
    ours = newton_recording(optic, picture, sensor, end_us, device)
    simulated = amiwarp.simulate(
        amiwarp.Scene.from_picture(picture, fov=2.0 * math.atan(HALF)),
        camera,
        prism,
        duration_s=end_us * 1e-6,
        motion=amiwarp.PrismMotion(RPM, 0.4),
        sensor=sensor,
        device=device,
    )
    found = {}
    row: dict[str, Any] = {"size": size, "device": device}
    for name, recording in (("newton", ours), ("simulate", simulated)):
        calibration = amiwarp.calibrate(recording, model="exact", device=device)
        found[name] = calibration.model
        row[f"{name}_events"] = len(recording.events)
        row[f"{name}_error_px"] = amiwarp.model_error(calibration.model, optic).rms
    row["between_px"] = predicted_error(found["newton"], found["simulate"], remove_lag=True).rms
    return row


def boxes_model(worlds: int, device: str) -> Any:
    """Return a model with 25 boxes in each world."""
    import newton

    world = newton.ModelBuilder()
    rng = np.random.default_rng(1)
    for x, y, grey in rng.uniform(-1.0, 1.0, (25, 3)):
        place = wp.transform((x, y, 0.0), wp.quat_identity())
        colour = (0.55 + 0.45 * grey,) * 3
        world.add_shape_box(-1, xform=place, hx=0.2, hy=0.15, hz=0.1, color=colour)
    builder = newton.ModelBuilder()
    builder.replicate(world, worlds)
    return builder.finalize(device=device)


def seconds_of(call: Callable[[int], Any], steps: int, device: str) -> float:
    """Return the mean time of a call [s], after two calls that do not count."""
    for k in range(2):
        call(k)
    wp.synchronize_device(device)
    began = time.perf_counter()
    for k in range(2, 2 + steps):
        call(k)
    wp.synchronize_device(device)
    return (time.perf_counter() - began) / steps


def speed_row(
    cameras: int, side: int, steps: int, device: str, own_angles: bool, rays: int
) -> dict[str, Any]:
    """Return the times of a step by part [s], and the memory."""
    model = boxes_model(cameras, device)
    state = model.state()
    camera = amiwarp.Camera.from_fov(side, side, math.radians(45.0))
    optic = amiwarp.ExactModel.from_prism(camera, amiwarp.Prism(math.radians(1.0)))
    start = np.linspace(0.0, 2.0, cameras) if own_angles else 0.0
    eyes = NewtonEventCamera(
        model,
        camera,
        optic,
        motion=amiwarp.PrismMotion(RPM),
        start=start,
        pose=(0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 1.0),
        sensor=amiwarp.SensorModel.preset("davis346"),
        rays_per_pixel=rays,
    )
    last: list[Any] = []

    def whole(k: int) -> None:
        last[:] = eyes.step(state, (k + 1) * STEP_US)

    def with_tensors(k: int) -> None:
        whole(k)
        amiwarp.voxel_grid(last[0], side, side, bins=5, windows=last[1])

    renderer = eyes.renderer
    row: dict[str, Any] = {
        "cameras": cameras,
        "side": side,
        "rays_per_pixel": rays,
        "own_angles": own_angles,
        "device": device,
        "step_us": STEP_US,
        "whole": seconds_of(whole, steps, device),
    }
    row["pictures"] = eyes.pictures
    row["events"] = len(last[0])
    eyes.reset()
    row["with_tensors"] = seconds_of(with_tensors, steps, device)
    scene = renderer.snapshot(state)
    ready = eyes.rays(0)
    count = eyes.pictures
    row["rays"] = count * seconds_of(lambda k: eyes.rays(k * 1000), steps, device)
    row["render"] = count * seconds_of(lambda k: renderer.luminance(scene, ready), steps, device)
    row["on_top_of_render"] = row["whole"] / row["render"] - 1.0
    row["steps_per_s"] = cameras / row["with_tensors"]
    row["memory_gb"] = memory_gb(device)
    return row


def memory_gb(device: str) -> float:
    """Return the memory that is in use on a device, or by the process on a CPU [GB]."""
    here = wp.get_device(device)
    if here.is_cuda:
        return (here.total_memory - here.free_memory) * 1e-9
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1e-6


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=["prism", "speed"])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--size", type=int, nargs=2, default=(320, 240))
    parser.add_argument("--cameras", type=int, nargs="+", default=[1, 64])
    parser.add_argument("--side", type=int, default=128)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--rays", type=int, default=4)
    parser.add_argument("--own-angles", action="store_true")
    given = parser.parse_args()
    if given.what == "prism":
        print(json.dumps(prism_row(tuple(given.size), given.device)))
        return
    for cameras in given.cameras:
        row = speed_row(
            cameras, given.side, given.steps, given.device, given.own_angles, given.rays
        )
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
