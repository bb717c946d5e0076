"""
A picture from events
=====================

Events tell where the brightness changes, not how bright a pixel is. Behind a
rotating prism every pixel sees a small circle of the scene in each turn, so the
changes connect neighbouring places in all directions. From one turn amiwarp solves
for the log intensity of the whole picture, without a neural network. This tutorial
reconstructs a picture and compares it with the original.

The recording
-------------

:class:`amiwarp.Simulation` describes a recording before it is made. Its
:meth:`~amiwarp.Simulation.log_view` is the ground truth: the log intensity that the
camera would see without the prism.
"""

import math

import matplotlib.pyplot as plt
import numpy as np
from pyvista.examples import mapfile

import amiwarp

camera = amiwarp.Camera.from_fov(320, 240, math.radians(60))
prism = amiwarp.Prism(math.radians(1.5))
scene = amiwarp.Scene.from_picture(mapfile)
simulation = amiwarp.Simulation(scene, camera, prism, duration_s=0.2, seed=0)
recording = simulation.run()
original = simulation.log_view()
print(
    f"{len(recording.events):,} events in {0.2 * 720 / 60:.1f} turns of the prism"
)

# %%
# One turn, and less
# ------------------
#
# Here the true model is known, so no calibration is needed. For a recording of
# yours give the result of :func:`amiwarp.calibrate` instead. By default the window
# starts after the first turn, because the first event of a pixel has no earlier one
# to be compared with.

model = amiwarp.truth_model(camera, recording.truth, prism.flat_side)
pictures = {}
for turns in (0.25, 0.5, 1.0):
    pictures[turns] = amiwarp.reconstruct(recording, model=model, turns=turns)


def fitted(picture):
    """Fit gain and offset to the original: events determine neither."""
    gain, offset = np.polyfit(picture.log.ravel(), original.ravel(), 1)
    return gain * picture.log + offset


figure, axes = plt.subplots(2, 2, figsize=(8.0, 6.2))
limits = np.percentile(original, (1, 99))
axes[0, 0].imshow(original, vmin=limits[0], vmax=limits[1])
axes[0, 0].set_title("original (log intensity)")
for ax, (turns, picture) in zip(axes.ravel()[1:], pictures.items(), strict=True):
    ax.imshow(fitted(picture), vmin=limits[0], vmax=limits[1])
    ax.set_title(f"from {turns:g} turns")
for ax in axes.ravel():
    ax.set(xticks=[], yticks=[])
plt.show()

# %%
# How close it is
# ---------------
#
# The correlation of the log intensities needs no scale.

for turns, picture in pictures.items():
    value = np.corrcoef(picture.log.ravel(), original.ravel())[0, 1]
    print(f"{turns:4g} turns: {picture.pairs:7,} pairs, correlation {value:.3f}")

# %%
# Where events determine the picture
# ----------------------------------
#
# Regions without texture give no events. There the picture is filled smoothly from
# around, and :attr:`amiwarp.Picture.known` is false. With ``fill="none"`` these
# pixels are NaN.

known = pictures[1.0].known
error = np.abs(fitted(pictures[1.0]) - original)
figure, axes = plt.subplots(1, 2)
axes[0].imshow(known)
axes[0].set_title(f"determined by events: {known.mean():.0%}")
drawn = axes[1].imshow(error, cmap="cividis", vmax=np.percentile(error, 99))
axes[1].set_title("error of one turn (log intensity)")
figure.colorbar(drawn, ax=axes[1], shrink=0.85)
for ax in axes:
    ax.set(xticks=[], yticks=[])
plt.show()
print(f"median error {np.median(error[known]):.3f} where events determine it")
print(f"             {np.median(error[~known]):.3f} elsewhere")
