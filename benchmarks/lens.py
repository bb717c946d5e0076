"""Errors of the lens calibration over seeds, beside OpenCV on frames of the same poses.

``python -m benchmarks.lens --seeds 10 --out lens.json`` simulates 12 poses a seed: 640x480 px, default sensor with
noise, 0.25 s each. Each calibration starts 10 % off in focal length and apex. A row gives the relative errors of focal
length and apex, the error of the principal point [px], the reprojection error on held-out true corners [px rms], the
signed relative error of the orbits (apex times focal length, with the index held), and the same for OpenCV on frames
without noise and with the noise of a usual camera.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import amiwarp
from amiwarp.lens.board import Corners
from amiwarp.lens.corner_fit import fit_lens
from amiwarp.lens.projection import Projection, first_pose

BOARD = amiwarp.Board(9, 6, 0.03)
LENSES = {
    "radial-tangential": amiwarp.Camera(
        640, 480, 520.0, 521.5, 322.0, 236.0, amiwarp.RadialTangential(-0.12, 0.03, 0.0005, -0.0004)
    ),
    "fisheye": amiwarp.Camera(640, 480, 305.0, 305.6, 322.0, 236.0, amiwarp.Fisheye(-0.02, 0.004)),
}
SEEING: dict[str, dict[str, Any]] = {
    "radial-tangential": {},
    "fisheye": {"seeing": "rays", "samples": 16},
}
"""A map of what is seen covers 151 deg. The diagonal of a fisheye of 120 deg has more."""
DISTANCE_M = {"radial-tangential": (0.35, 0.7), "fisheye": (0.2, 0.4)}
FINE = 4
"""Number of samples per pixel of a frame along each axis."""
FRAME_NOISE = 0.02
"""Standard deviation of the noise of frames, as a share of white: a usual camera at ISO 400."""


def poses(
    rng: np.random.Generator, lens: str, count: int
) -> list[tuple[Rotation, NDArray[np.float64]]]:
    """Return orientations and middles [m] of boards that lie wholly in the image."""
    camera, half, out = LENSES[lens], BOARD.points.max(axis=0) / 2.0, []
    while len(out) < count:
        ray = np.asarray(
            camera.pixels_to_rays(rng.uniform([60, 60], [580, 420])[None]), np.float64
        )[0]
        middle = ray * rng.uniform(*DISTANCE_M[lens])
        turn, about = math.radians(rng.uniform(10.0, 40.0)), rng.uniform(0.0, math.tau)
        facing, _ = Rotation.align_vectors(ray[None], [[0.0, 0.0, 1.0]])
        rotation = facing * Rotation.from_rotvec(
            [turn * math.cos(about), turn * math.sin(about), 0.0]
        )
        xy = corners(camera, rotation, middle - rotation.apply(half))
        if np.isfinite(xy).all() and (xy > 12).all() and (xy < [627, 467]).all():
            out.append((rotation, middle))
    return out


def corners(
    camera: amiwarp.Camera, rotation: Rotation, origin: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the true corners [px] of a board whose first corner is at ``origin`` [m]."""
    points = rotation.apply(BOARD.points) + origin
    return np.asarray(
        camera.rays_to_pixels(points / np.linalg.norm(points, axis=1, keepdims=True)), np.float64
    )


def errors(
    camera: amiwarp.Camera, true: amiwarp.Camera, held: list[NDArray[np.float64]]
) -> dict[str, float]:
    """Return the errors of a camera; ``held`` are true corners of other poses [px]."""
    off = []
    for xy in held:
        seen = Corners(np.arange(len(xy)), xy)
        lens, pose = Projection(camera), first_pose(camera, BOARD, seen)
        for _ in range(5):  # the pose that fits best in pixels
            at, by = lens.of(pose, BOARD.points)
            pose = (
                pose
                - np.linalg.lstsq(by[:, :, -6:].reshape(-1, 6), (at - xy).ravel(), rcond=None)[0]
            )
        off.append(((lens.of(pose, BOARD.points)[0] - xy) ** 2).sum(axis=1))
    return {
        "focal": abs(camera.fx / true.fx - 1.0),
        "centre_px": max(abs(camera.cx - true.cx), abs(camera.cy - true.cy)),
        "held_out_px": float(np.sqrt(np.concatenate(off).mean())),
    }


def one(lens: str, seed: int, count: int, device: str, index: float) -> dict[str, Any]:
    """Return the row of a seed."""
    rng, true = np.random.default_rng(seed), LENSES[lens]
    half, placed = (
        BOARD.points.max(axis=0) / 2.0,
        poses(np.random.default_rng(seed), lens, count + 4),
    )
    xy = [corners(true, r, m - r.apply(half)) for r, m in placed]
    motion = amiwarp.PrismMotion(720.0, rng.uniform(-math.pi, math.pi))
    prism, recordings = amiwarp.Prism(math.radians(1.0), index), []
    for k, (rotation, middle) in enumerate(placed[:count]):
        world = BOARD.world(rotation.as_quat(), middle, seed=seed)
        scene = amiwarp.WorldScene(world, amiwarp.Trajectory.still([0, 0, 0]), **SEEING[lens])
        made = amiwarp.simulate(
            scene, true, prism, duration_s=0.25, motion=motion, seed=100 * seed + k, device=device
        )
        nominal = amiwarp.Prism(prism.apex * (1.1 if seed % 2 else 0.9))
        recordings.append(replace(made, camera=None, name=f"pose {k}", prism=nominal))
    fov = 640.0 / (0.9 * true.fx) if lens == "fisheye" else 2.0 * math.atan(320.0 / (0.9 * true.fx))
    row: dict[str, Any] = {"lens": lens, "seed": seed, "index": index}
    began = time.perf_counter()
    try:
        found = amiwarp.calibrate_lens(
            recordings, BOARD, fov=fov, fisheye=lens == "fisheye", device=device
        )
    except amiwarp.AmiwarpError as error:
        return {**row, "refused": str(error), "seconds": time.perf_counter() - began}
    apex, std = found.prism.parameters["apex"], found.prism.uncertainty["apex"]
    row |= errors(found.camera, true, xy[count:])
    row |= {
        "apex": abs(apex / prism.apex - 1.0), "seconds": time.perf_counter() - began, "poses": len(found.poses),
        "orbit": apex * found.camera.fx / (prism.apex * true.fx) - 1.0, "apex_std": std / prism.apex,
        "z_apex": (apex - prism.apex) / std, "notes": found.notes,
        **{f"z_{n}": (getattr(found.camera, n) - getattr(true, n)) / found.uncertainty[n] for n in ("fx", "cx", "cy")},
    }  # fmt: skip
    start = replace(true, fx=0.9 * true.fx, fy=0.9 * true.fx, cx=319.5, cy=239.5)
    for name, noise in (("frames", 0.0), ("noisy frames", FRAME_NOISE)):
        seen = [on_frame(each, true, noise, rng) for each in xy[:count]]
        row[name] = errors(fit_lens(start, BOARD, seen).camera, true, xy[count:])
    return row


def on_frame(
    xy: NDArray[np.float64], camera: amiwarp.Camera, noise: float, rng: np.random.Generator
) -> Corners:
    """Return the corners that OpenCV finds in a frame of a board whose true corners are ``xy`` [px].

    The frame is the board's picture, warped by the lens between the corners, with a blur of 0.5 px.
    """
    x, y = ((np.arange(FINE * n) + 0.5) / FINE - 0.5 for n in (640, 480))
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = np.asarray(camera.pixels_to_rays(pixels))
    pose = first_pose(camera, BOARD, Corners(np.arange(len(xy)), xy))
    turn = Rotation.from_rotvec(pose[:3])
    normal, origin = turn.apply([0.0, 0.0, 1.0]), pose[3:]
    at = (
        turn.inv().apply(rays * ((origin @ normal) / (rays @ normal))[:, None] - origin)
        / BOARD.square_m
    )
    u, v = at[:, 0] + 1.0, at[:, 1] + 1.0
    inside = (u > 0) & (u < BOARD.columns + 1) & (v > 0) & (v < BOARD.rows + 1) & np.isfinite(u)
    picture = np.where(inside & ((np.floor(u) + np.floor(v)) % 2 == 0), 0.04, 0.9)
    picture = picture.reshape(480, FINE, 640, FINE).mean(axis=(1, 3))
    picture = cv2.GaussianBlur(picture, (0, 0), 0.5) + rng.normal(0.0, noise, picture.shape)
    frame = np.clip(255.0 * picture, 0, 255).astype(np.uint8)
    found = BOARD.find(frame)
    assert found is not None
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    fine = cv2.cornerSubPix(
        frame, found.xy.astype(np.float32).reshape(-1, 1, 2), (5, 5), (-1, -1), until
    )
    found = replace(found, xy=fine.reshape(-1, 2).astype(np.float64))
    flipped = np.linalg.norm(found.xy[0] - xy[0]) > np.linalg.norm(found.xy[-1] - xy[0])
    return replace(found, xy=found.xy[::-1]) if flipped else found


def main() -> None:
    """Measure and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--poses", type=int, default=12)
    parser.add_argument("--lens", choices=[*LENSES], action="append")
    parser.add_argument("--index", type=float, default=1.5168)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    rows = []
    for lens in given.lens or LENSES:
        for seed in range(given.first, given.first + given.seeds):
            rows.append(one(lens, seed, given.poses, given.device, given.index))
            print(json.dumps(rows[-1]), flush=True)
            if given.out:
                given.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
