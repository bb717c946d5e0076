"""
The paper's platform: two event cameras, colour and depth
=========================================================

The platform of the AMI-EV paper carries a plain event camera, an event camera behind
a rotating wedge (the AMI-EV), and an Intel RealSense, which takes frames and depth.
This tutorial puts that platform into a simulated room, records all cameras on one
clock, and compares what they see.

Cameras on one rig
------------------

:meth:`amiwarp.Rig.paper_platform` returns the platform: five cameras by name, each
with its place on the rig. The rig follows one trajectory; each camera's pose is the
rig's, composed with its place. Images are small here, so that the page is built in
seconds. Without ``size`` they have 640 x 480 pixels, as on the platform.
"""

import matplotlib.pyplot as plt
import numpy as np

import amiwarp

rig = amiwarp.Rig.paper_platform("room", duration_s=0.15, size=(160, 120), seed=2)
for name, sensor in rig.sensors.items():
    right, down, ahead = 1000.0 * np.asarray(sensor.to_rig)[:, 3]
    kind = type(sensor).__name__
    print(f"{name:7} {kind:15} {right:4.0f} mm right, {0.0 - down:3.0f} mm up")

# %%
# A rig of your own is a dictionary of :class:`amiwarp.RigEventCamera`,
# :class:`amiwarp.RigFrameCamera` and :class:`amiwarp.RigDepthCamera`, or a TOML file:
# see :doc:`/how-to/rigs`.
#
# Record
# ------
#
# ``run`` keeps the recordings in memory. ``rig.write("platform")`` writes them to a
# folder instead, one file for each camera. The command for two seconds at full size
# is ``amiwarp simulate platform --rig platform.toml`` with the file
#
# .. code-block:: toml
#
#    format = "amiwarp-rig-specification"
#    version = 1
#    world = "room"
#    duration_s = 2.0
#    rig = "paper-platform"

recorded = rig.run()
for name, sensor in recorded.sensors.items():
    recording = sensor.recording
    numbers = {
        "events": len(recording.events),
        "frames": len(recording.frames or ()),
        "depth images": len(recording.depth or ()),
    }
    print(
        f"{name:7}", ", ".join(f"{n:,} {what}" for what, n in numbers.items() if n)
    )

# %%
# One instant, five cameras
# -------------------------
#
# All times are on one clock. The middle of a colour frame's exposure is the instant;
# the events of one turn of the wedge, 83 ms, lie around it.
# :func:`amiwarp.compensate_events` moves each event of the AMI-EV back to where a
# camera without the wedge would have seen it.

colour = recorded["colour"].recording.frames
index = 2
t_us = int(colour.t[index])


def around(name, span_us=83_333):
    """Return the events of a camera around the instant."""
    events = recorded[name].recording.events
    first, last = np.searchsorted(
        events[:].t, [t_us - span_us // 2, t_us + span_us // 2]
    )
    return events[int(first) : int(last)]


ami = recorded["ami"].recording
model = amiwarp.ExactModel.from_prism(ami.camera, ami.prism)
raw = around("ami")
compensated = amiwarp.compensate_events(raw, model, ami.encoder)
WIDTH, HEIGHT = 160, 120


def picture(x, y):
    """Return an image of events: their number at each pixel, without those outside."""
    edges = (np.arange(HEIGHT + 1) - 0.5, np.arange(WIDTH + 1) - 0.5)
    return np.histogram2d(y, x, bins=edges)[0]


def show(ax, title, image, **style):
    """Draw an image."""
    drawn = ax.imshow(image, **style)
    ax.set(xticks=[], yticks=[])
    ax.set_title(title, fontsize=9)
    return drawn


depths = recorded["depth"].recording.depth
depth = depths[int(np.argmin(np.abs(depths.t - t_us)))]
counts = {"cmap": "gray_r", "vmin": 0, "vmax": 40}
plain = around("plain")
figure, axes = plt.subplots(2, 3, figsize=(9.0, 5.2), layout="constrained")
show(axes[0, 0], "colour, rolling shutter", colour[index])
show(axes[0, 1], "grey", recorded["grey"].recording.frames[index], cmap="gray")
drawn = show(axes[0, 2], "depth (m)", depth, cmap="viridis")
figure.colorbar(drawn, ax=axes[0, 2], shrink=0.8)
show(
    axes[1, 0],
    f"plain: {len(plain):,} events",
    picture(plain.x, plain.y),
    **counts,
)
show(axes[1, 1], f"AMI-EV, raw: {len(raw):,}", picture(raw.x, raw.y), **counts)
show(
    axes[1, 2],
    "AMI-EV, compensated",
    picture(*compensated.T),
    **counts,
)
plt.show()

# %%
# The plain camera has events only where the slow motion of the hand crosses an edge.
# The AMI-EV has many more, of edges in all directions. Raw, each edge is smeared over
# the wedge's circle; compensated, the events lie on the edges again.
#
# Where a point of one camera lies in another
# -------------------------------------------
#
# ``between`` returns the matrix from one camera's frame to another's. With the depth
# image it says where each of its pixels lies in the colour frame: this is how a
# RealSense aligns its depth to its colour.

camera = recorded["depth"].recording.camera
rows, columns = np.indices(depth.shape)
pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
rays = camera.pixels_to_rays(pixels.astype(np.float64))
points = rays / rays[:, 2:] * depth.reshape(-1, 1)
to_colour = recorded.between("depth", "colour")
points = points @ to_colour[:, :3].T + to_colour[:, 3]
seen = recorded["colour"].recording.camera.rays_to_pixels(points)
x, y = np.rint(seen).astype(int).T
visible = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
aligned = np.zeros((*depth.shape, 3), np.uint8)
aligned[rows.ravel()[visible], columns.ravel()[visible]] = colour[index][
    y[visible], x[visible]
]

figure, axes = plt.subplots(1, 2, figsize=(7.0, 2.9), layout="constrained")
show(axes[0], "grey", recorded["grey"].recording.frames[index], cmap="gray")
show(axes[1], "its pixels with the colours of the colour camera", aligned)
plt.show()

assert len(raw) > 5 * len(plain)
assert 0.4 < visible.mean() < 0.9
