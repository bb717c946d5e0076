"""
A first calibration
===================

An event camera behind a rotating wedge prism sees each edge move in a circle.
Motion compensation moves every event back to where it would be without the prism.
It needs the apex angle of the prism and its phase, that is its orientation at
encoder angle zero. This tutorial simulates a recording, finds both from the events
alone, and compensates the events.

The recording
-------------

The simulator needs a picture, a camera and a prism. The picture here is a map of
the earth that comes with PyVista. The true apex angle is 2.0°. The recording states
2.3°, as if the data sheet of the prism were wrong: the calibration may only use
that value as its starting range.
"""

import math
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
from pyvista.examples import mapfile

import amiwarp

camera = amiwarp.Camera.from_fov(320, 240, math.radians(60))
true_prism = amiwarp.Prism(math.radians(2.0))
stated_prism = amiwarp.Prism(math.radians(2.3))
recording = amiwarp.simulate(
    mapfile,
    camera,
    true_prism,
    duration_s=0.2,
    motion=720.0,
    nominal_prism=stated_prism,
    seed=0,
)
print(f"{len(recording.events):,} events in 0.2 s")
print(f"prism at {recording.encoder.rpm:.0f} turns/min")

# %%
# The calibration
# ---------------
#
# :func:`amiwarp.calibrate` searches in two stages. The first one is contrast
# maximisation: it looks for the parameters that make the image of warped events
# (IWE) sharpest. The second one refines them with the photometric model: one
# brightness map must explain all events.

calibration = amiwarp.calibrate(recording, seed=0)
found = calibration.exact.parameters
print(f"model       {calibration.model_name}")
print(f"apex angle  {math.degrees(found['apex']):.3f} deg")
print(f"true apex   {math.degrees(true_prism.apex):.3f} deg")
print(f"sharpness   {calibration.sharpness_before:.2f} before")
print(f"            {calibration.sharpness_after:.2f} after")

# %%
# A simulated recording knows its ground truth, so the error of the calibrated model
# can be stated in pixels.

truth = amiwarp.truth_model(camera, recording.truth, true_prism.flat_side)
error = amiwarp.model_error(calibration.model, truth)
print(f"model error {error.rms:.3f} px rms, {error.worst:.3f} px at most")

# %%
# The image of warped events, before and after
# --------------------------------------------
#
# :func:`amiwarp.iwe` counts the events at each pixel. With a model and an encoder
# it displaces them first.

events = recording.events[:]
before = amiwarp.iwe(events, 320, 240)
after = amiwarp.iwe(
    events, 320, 240, model=calibration.model, encoder=recording.encoder
)

figure, axes = plt.subplots(1, 2)
images = {"as recorded": before, "compensated": after}
for ax, (title, image) in zip(axes, images.items(), strict=True):
    ax.imshow(image, vmax=after.max() * 0.4)
    ax.set(title=title, xticks=[], yticks=[])
plt.show()

# %%
# The blur of the edges is the standard deviation of the events across them.
# Quantisation to whole pixels alone leaves 0.29 px.

raw = np.stack([events.x, events.y], axis=1).astype(np.float32)
sharp = amiwarp.compensate_events(events, calibration.model, recording.encoder)
before_px = amiwarp.edge_blur(sharp, 320, 240, of=raw)
after_px = amiwarp.edge_blur(sharp, 320, 240)
print(f"blur before {before_px:.2f} px, after {after_px:.2f} px")

# %%
# A compensated recording on disk
# -------------------------------
#
# :func:`amiwarp.compensate` writes all events with their new places to a file,
# block by block, in constant memory. The calibration is saved as JSON. Every
# command of amiwarp reads both files.

with TemporaryDirectory() as folder:
    done = amiwarp.compensate(recording, calibration, f"{folder}/compensated.h5")
    calibration.save(f"{folder}/calibration.json")
print(f"{done.events:,} events, {done.outside:,} of them outside the image")
