"""
A lens from a board that stands still
=====================================

An event camera at rest sees nothing. Behind the turning prism a printed board that
stands still is a picture, and its corners give the lens. This program simulates
twelve poses of a board, forgets the camera, and gets it back. It needs
``pip install 'amiwarp[lens]'``.
"""

import math
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import amiwarp

camera = amiwarp.Camera(
    320, 240, 262.0, 261.0, 163.0, 117.0, amiwarp.RadialTangential(k1=-0.1, k2=0.02)
)
prism = amiwarp.Prism(math.radians(1.0))
board = amiwarp.Board(6, 5, square_m=0.03)

# %%
# Twelve poses: in all parts of the image, tilted by 29 degrees in five ways. A
# real recording knows neither the lens nor the true prism, only a data sheet, here
# 10 % off.
nominal = amiwarp.Prism(1.1 * prism.apex)
motion = amiwarp.PrismMotion(720.0, 0.7)
still = amiwarp.Trajectory.still([0.0, 0.0, 0.0])
recordings = []
for k in range(12):
    place = [(k % 4 - 1.5) * 0.045, (k // 4 - 1) * 0.045, 0.36]
    about = k * math.tau / 5.0
    tilt = Rotation.from_rotvec([0.5 * math.cos(about), 0.5 * math.sin(about), 0.0])
    scene = amiwarp.WorldScene(board.world(tilt.as_quat(), place), still)
    made = amiwarp.simulate(
        scene, camera, prism, duration_s=0.17, motion=motion, seed=k
    )
    made = replace(made, camera=None, name=f"pose {k}", prism=nominal)
    recordings.append(made)

# %%
# A rough field of view is all that must be known of the lens.
found = amiwarp.calibrate_lens(recordings, board, fov=math.radians(68.0))
K, dist = found.camera.to_opencv()
true_K, true_dist = camera.to_opencv()
print("found", K[[0, 1, 0, 1], [0, 1, 2, 2]].round(2), dist.round(4))
print("true ", true_K[[0, 1, 0, 1], [0, 1, 2, 2]], true_dist)
print(
    "standard deviations",
    {n: round(std, 4) for n, std in found.uncertainty.items()},
)
apex, std = found.prism.parameters["apex"], found.prism.uncertainty["apex"]
print(f"apex {math.degrees(apex):.4f} ± {math.degrees(std):.4f} deg, true 1 deg")
print(f"corners are off by {found.rms:.3f} px rms;", *found.notes)

# %%
# Two of the pictures that the events gave, with the corners.
figure, panels = plt.subplots(1, 2, figsize=(9.0, 3.6))
for axes, pose in zip(panels, found.poses[:2], strict=True):
    axes.imshow(pose.picture, cmap="gray")
    axes.plot(*pose.corners.xy.T, "r.", markersize=4)
    axes.set_title(f"{pose.name}: {pose.rms:.2f} px rms")
figure.tight_layout()
assert abs(found.camera.fx / camera.fx - 1.0) < 0.005
assert np.hypot(found.camera.cx - camera.cx, found.camera.cy - camera.cy) < 2.0
