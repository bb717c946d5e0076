"""Make an image of compensated events for every 50 ms: a video of the edges in the scene."""

import math

import numpy as np
from pyvista.examples import mapfile

import amiwarp

camera = amiwarp.Camera.from_fov(320, 240, math.radians(60))
recording = amiwarp.simulate(mapfile, camera, amiwarp.Prism(math.radians(2.0)), duration_s=0.2)
calibration = amiwarp.calibrate(recording)
encoder = recording.encoder
assert encoder is not None

images = []
for block in recording.events.blocks(duration_us=50_000):
    image = amiwarp.iwe(
        block, 320, 240, model=calibration.model, encoder=encoder, per_polarity=True
    )
    raw = amiwarp.sharpness(amiwarp.iwe(block, 320, 240))
    print(
        f"{len(block)} events: sharpness {raw:.2f} raw, {amiwarp.sharpness(image.sum(axis=0)):.2f} compensated"
    )
    images.append(image)
np.save("windows.npy", np.stack(images))
