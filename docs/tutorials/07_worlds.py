"""
Events from a 3-D world, with depth and flow
============================================

A picture at infinity has no depth. A world does: its bodies lie at different
distances, move by themselves, and hide each other. This tutorial builds a small
world from NumPy arrays, moves a camera past it, and simulates the recording with
and without the prism. The ground truth then tells what each event saw.

A wall and two boxes
--------------------

A body has a mesh of triangles and a material. World coordinates are in metres, and
z points up. :class:`amiwarp.Mesh` needs corners and triangles. ``uv`` places a
texture on it.
"""

import math

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

import amiwarp

rng = np.random.default_rng(7)


def squares(n):
    """Return a texture of n x n squares of random brightness."""
    return np.kron(rng.uniform(0.1, 1.0, (n, n)), np.ones((8, 8)))


def box(size):
    """Return a cuboid around the origin. Each side shows the whole texture."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2.0
    vertices, faces, uv = [], [], []
    for axis in range(3):
        for side in (-0.5, 0.5):
            faces += (np.array([[0, 1, 2], [0, 2, 3]]) + 4 * len(vertices)).tolist()
            vertices.append(np.insert(corners, axis, side, axis=1) * size)
            uv.append(corners + 0.5)
    return amiwarp.Mesh(np.concatenate(vertices), faces, np.concatenate(uv))


def place(position, turn_deg=0.0):
    """Return a pose that never changes, turned about the vertical axis."""
    turn = Rotation.from_euler("z", turn_deg, degrees=True)
    return amiwarp.Trajectory.still(position, rotation=turn.as_quat())


# %%
# The camera looks along the y axis. The wall is 3 m away, one box 1.8 m, and the
# other, smaller box 1 m.

bodies = (
    amiwarp.Body(
        "wall",
        box((5.0, 0.1, 4.0)),
        amiwarp.Material(0.8, texture=squares(40)),
        place((0.0, 3.0, 0.0)),
    ),
    amiwarp.Body(
        "far box",
        box((0.6, 0.6, 0.6)),
        amiwarp.Material(0.9, texture=squares(5)),
        place((-0.45, 1.8, 0.1), turn_deg=30.0),
    ),
    amiwarp.Body(
        "near box",
        box((0.3, 0.3, 0.3)),
        amiwarp.Material(0.9, texture=squares(4)),
        place((0.22, 1.0, -0.1), turn_deg=-25.0),
    ),
)
world = amiwarp.World(
    "two boxes",
    bodies,
    sun=amiwarp.Sun(direction=(0.6, -1.0, 0.8), intensity=0.6),
)

# %%
# A camera that moves
# -------------------
#
# A trajectory is a table of poses, or a function of time. This camera moves to the
# right at 1 m/s and looks at the same point all the time.


def pose(t):
    """Return orientation and position at a time [s]."""
    position = np.array([t - 0.03, 0.0, 0.0])
    still = amiwarp.Trajectory.still(position, look_at=(0.0, 2.0, 0.0))
    return Rotation.from_quat(still.rotation[0]), position


way = amiwarp.Trajectory.from_function(pose, duration_s=0.06)

# %%
# :class:`amiwarp.WorldScene` joins world and trajectory. The simulation runs twice,
# with the same sensor and seed: through a prism of 1° at 720 turns per minute, and
# without the prism.

simulation = amiwarp.Simulation(
    amiwarp.WorldScene(world, way),
    amiwarp.Camera.from_fov(160, 120, math.radians(50)),
    amiwarp.Prism(math.radians(1.0)),
    duration_s=0.06,
)
instant_us = 45_000
recordings = {
    "without the prism": simulation.without_prism().run(),
    "through the prism": simulation.run(truth_times_us=[instant_us]),
}

figure, axes = plt.subplots(1, 2, figsize=(8.0, 3.2))
for ax, (name, recording) in zip(axes, recordings.items(), strict=True):
    events = recording.events.between(instant_us - 5_000, instant_us + 5_000)
    off, on = amiwarp.iwe(events, 160, 120, per_polarity=True)
    ax.imshow(np.clip(on - off, -2, 2), cmap="PuOr_r", vmin=-2, vmax=2)
    ax.set_title(f"{name}: {len(events):,} events in 10 ms")
    ax.set(xticks=[], yticks=[])
plt.show()

# %%
# The camera moves to the right. Without the prism, horizontal edges cause hardly
# any events. Over a turn of the prism, edges of every orientation do.
#
# What each event saw
# -------------------
#
# Each event has an instance, a depth, a point in the world and a cause. An instance
# is a body, or several bodies that count as one thing; number 0 is the sky.

recording = recordings["through the prism"]
truth = recording.truth
count = len(recording.events)
events, seen = recording.events.slice(0, count), truth.of_events(0, count)

for number, name in enumerate(truth.labels.instances, start=1):
    own = seen.instance == number
    depth = np.median(seen.depth[own])
    print(f"{name:9} {own.sum():6,} events, median depth {depth:.2f} m")

# %%
# Depth and flow
# --------------
#
# ``truth.frames`` holds the instants for which the ground truth of all pixels was
# requested: depth, instances, normals, luminance and optical flow, the latter
# without the prism (blue) and through it (orange). The prism adds nearly the same
# motion to all pixels. The camera's motion has a larger effect on near bodies.

frame = truth.frames[0]
window = (events.t > instant_us - 1_500) & (events.t < instant_us + 1_500)

figure, axes = plt.subplots(1, 3, figsize=(8.0, 2.5))
axes[0].imshow(frame.depth, cmap="viridis_r", vmin=0.8, vmax=3.2)
axes[0].set_title("depth [m] of pixels")
axes[1].scatter(
    events.x[window],
    events.y[window],
    s=0.6,
    c=seen.depth[window],
    cmap="viridis_r",
    vmin=0.8,
    vmax=3.2,
)
axes[1].set_title("depth of events in 3 ms")
y, x = np.mgrid[6:120:12, 6:160:12]
for flow, colour in ((frame.flow, "#0072b2"), (frame.flow_with_prism, "#d55e00")):
    u, v = np.moveaxis(flow[y, x], 2, 0)
    axes[2].quiver(
        x, y, u, v, color=colour, angles="xy", scale=15.0, scale_units="xy"
    )
axes[2].set_title("optical flow")
for ax in axes:
    ax.set(xlim=(0, 160), ylim=(120, 0), aspect="equal", xticks=[], yticks=[])
plt.show()

for name in ("far box", "near box", "wall"):
    on_body = frame.instance == 1 + truth.labels.instances.index(name)
    speed = np.linalg.norm(frame.flow[on_body], axis=1)
    print(f"{name:9} mean speed without the prism {speed.mean():5.1f} px/s")
