"""
Events from a picture, with ground truth
========================================

The simulator makes the events that an event camera would see of any picture. It
needs no hardware, and works without a prism as well: then a rotation of the camera
makes the events. This tutorial draws a test picture, simulates a clean and a noisy
sensor, and shows what ground truth comes with the events.

A picture and a moving camera
-----------------------------

The scene is an array of brightness on a plane far away. The camera rolls about its
optical axis at 90° per second. A prism of apex angle zero displaces nothing.
"""

import math

import matplotlib.pyplot as plt
import numpy as np

import amiwarp

rows, columns = np.mgrid[-1:1:480j, -1.33:1.33:640j]
picture = np.full(rows.shape, 60, np.uint8)
picture[np.hypot(rows, columns) < 0.75] = 120
picture[(abs(rows) < 0.35) & (abs(columns) < 0.35)] = 230
picture[(abs(rows - 0.55) < 0.06) & (abs(columns) < 1.0)] = 15

camera = amiwarp.Camera.from_fov(160, 120, math.radians(50))
roll = amiwarp.CameraMotion((0.0, 0.0, math.radians(90.0)))


def record(sensor):
    """Simulate 0.3 s of the picture with one sensor."""
    return amiwarp.simulate(
        picture,
        camera,
        amiwarp.Prism(0.0),
        duration_s=0.3,
        motion=0.0,
        camera_motion=roll,
        sensor=sensor,
        seed=1,
    )


# %%
# A clean and a noisy sensor
# --------------------------
#
# :meth:`amiwarp.SensorModel.ideal` has equal thresholds and no noise. The other
# sensor has a threshold mismatch, latency, a refractory period, leak and shot
# noise, and hot pixels, each with a field of its own in
# :class:`amiwarp.SensorModel`.

sensors = {
    "ideal": amiwarp.SensorModel.ideal(0.2),
    "noisy": amiwarp.SensorModel(
        contrast_on=0.2,
        contrast_off=0.22,
        mismatch=0.06,
        shot_noise_hz=10.0,
        leak_hz=0.5,
    ),
}
recordings = {name: record(sensor) for name, sensor in sensors.items()}

figure, axes = plt.subplots(1, 3, figsize=(8.0, 2.6))
axes[0].imshow(picture, vmin=0, vmax=255)
axes[0].set_title("the picture")
for ax, (name, recording) in zip(axes[1:], recordings.items(), strict=True):
    events = recording.events.between(100_000, 130_000)
    off, on = amiwarp.iwe(events, 160, 120, per_polarity=True)
    ax.imshow(np.clip(on - off, -2, 2), cmap="PuOr_r", vmin=-2, vmax=2)
    ax.set_title(f"{name}: {len(events):,} events in 30 ms")
for ax in axes:
    ax.set(xticks=[], yticks=[])
plt.show()

# %%
# The events over time
# --------------------
#
# Each event has a place, a time and a polarity. Over time the edges of the turning
# picture become surfaces. ON events are orange, OFF events blue.

events = recordings["ideal"].events.between(0, 300_000)[::3]
colours = np.where(events.p == 1, "#d55e00", "#0072b2")
figure = plt.figure(figsize=(8.0, 4.4))
ax = figure.add_subplot(projection="3d")
ax.scatter(events.t / 1e3, events.x, -events.y.astype(int), s=0.3, c=colours)
ax.set(xlabel="time [ms]", ylabel="x [px]", zlabel="-y [px]")
ax.set(yticks=(0, 80, 160), zticks=(-120, -60, 0))
ax.set_box_aspect((2.2, 1.3, 1.0), zoom=1.25)
ax.view_init(elev=18, azim=-62)
plt.show()

# %%
# The ground truth
# ----------------
#
# ``recording.truth`` holds the values that made the recording, and for each event
# the pixel at which its scene point lies without the prism. A compensation of yours
# can be judged event by event. Here a prism of 2° is added, and the circle model
# and the exact model are compared with the truth.

prism = amiwarp.Prism(math.radians(2.0))
recording = amiwarp.simulate(
    picture, camera, prism, duration_s=0.2, sensor=sensors["ideal"], seed=1
)
events = recording.events[:]
true_xy = recording.truth.points(0, len(events))

for name, model in (("circle", amiwarp.CircleModel), ("exact", amiwarp.ExactModel)):
    fixed = model.from_prism(camera, prism)
    xy = amiwarp.compensate_events(events, fixed, recording.encoder)
    distance = np.hypot(*(xy - true_xy).T)
    print(f"{name:6} model: median distance {np.nanmedian(distance):.4f} px")
