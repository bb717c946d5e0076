"""
Your own arrays and encoder counts
==================================

Events often come as NumPy arrays from another program, and the encoder as a log of
counts. This tutorial makes a recording of both, saves it, and checks that the index
pulses agree with the counts.

The arrays
----------

Events are four arrays of equal length: column ``x``, row ``y``, time ``t`` in
microseconds, and polarity ``p`` (1 for ON, 0 for OFF). Times must not decrease.
Here the arrays come from the simulator; in your program they come from your camera.
"""

import math
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
from pyvista.examples import mapfile

import amiwarp

camera = amiwarp.Camera.from_fov(320, 240, math.radians(60))
prism = amiwarp.Prism(apex=math.radians(2.0), index=1.5168)
simulated = amiwarp.simulate(
    mapfile, camera, prism, duration_s=0.2, motion=600.0, seed=0
)
block = simulated.events[:]
x, y, t, p = block.x, block.y, block.t, block.p

events = amiwarp.Events.from_arrays(x, y, t, p)
print(f"{len(events):,} events from {events.t[0]} to {events.t[-1]} us")
print(f"{np.mean(events.p == 1):.0%} of them ON")

# %%
# The encoder
# -----------
#
# The encoder here has 4096 counts per turn and an 8-bit counter, which wraps 16
# times per turn. It is read every millisecond. :meth:`amiwarp.Encoder.from_counts`
# unwraps the counts and turns them into prism angles. An index pulse marks the same
# orientation of the prism once per turn, so that the angle is absolute.

t_encoder = np.arange(-1000, 202_000, 1000)
turns = t_encoder * 1e-6 * 600.0 / 60.0
count = np.round(turns * 4096).astype(int) % 256
encoder = amiwarp.Encoder.from_counts(
    t_encoder,
    count,
    counts_per_turn=4096,
    counter_bits=8,
    index_t_us=[0, 100_000, 200_000],
)

figure, (left, right) = plt.subplots(1, 2)
left.plot(t_encoder / 1e3, count, ".-", markersize=6, linewidth=0.5)
left.set(xlabel="time [ms]", ylabel="count of the 8-bit counter", xlim=(0, 20))
right.plot(t_encoder / 1e3, np.degrees(encoder.angle_at(t_encoder)))
right.set(xlabel="time [ms]", ylabel="prism angle [deg]", yticks=range(0, 721, 180))
plt.show()

# %%
# :meth:`amiwarp.Encoder.slip` compares the counts with the index pulses. A large
# slip means lost counts or a wrong number of counts per turn.

slip = math.degrees(float(np.abs(encoder.slip()).max()))
print(f"{encoder.rpm:.1f} turns/min, largest slip {slip:.2f} deg")

# %%
# The recording
# -------------
#
# A :class:`amiwarp.Recording` joins the events with the camera, the encoder and the
# prism. The file has amiwarp's HDF5 format, which every command reads.

recording = amiwarp.Recording(
    events, camera, encoder, prism, metadata={"lens": "8 mm"}
)

with TemporaryDirectory() as folder:
    amiwarp.save_recording(f"{folder}/mine.h5", recording)
    opened = amiwarp.open_recording(f"{folder}/mine.h5")
    print(
        f"{len(opened.events):,} events of a sensor of {opened.events.size} pixels"
    )
    print(f"lens: {opened.metadata['lens']}")

# %%
# The prism angle of each event
# -----------------------------
#
# The encoder gives the prism angle at any time, interpolated between its samples.
# Below are the events of three rows near one edge of the scene, over the prism
# angle. As recorded, the edge moves to and fro once per turn. Compensated with a
# model of the prism, it stays at its place.

theta = np.degrees(encoder.angle_at(events.t)) % 360.0
model = amiwarp.ExactModel(camera, prism)
xy = amiwarp.compensate_events(events, model, encoder)

row, column = 90, 135
panels = {
    "as recorded": np.stack([events.x, events.y], axis=1).astype(np.float32),
    "compensated": xy,
}
colours = np.where(events.p == 1, "#d55e00", "#0072b2")
figure, axes = plt.subplots(1, 2, sharey=True)
for ax, (title, place) in zip(axes, panels.items(), strict=True):
    near = (abs(place[:, 1] - row) <= 1.5) & (abs(place[:, 0] - column) < 12)
    ax.scatter(theta[near], place[near, 0], s=1.5, c=colours[near])
    ax.set(title=title, xlabel="prism angle [deg]", xticks=range(0, 361, 90))
axes[0].set_ylabel("column x [px], ON orange, OFF blue")
plt.show()
