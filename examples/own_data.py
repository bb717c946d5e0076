"""Save your own arrays and encoder counts as a recording that every command of amiwarp reads."""

import math

import numpy as np

import amiwarp

rng = np.random.default_rng(0)
n = 100_000
events = amiwarp.Events.from_arrays(
    x=rng.integers(0, 640, n),
    y=rng.integers(0, 480, n),
    t=np.sort(rng.integers(0, 1_000_000, n)),  # microseconds
    p=rng.integers(0, 2, n),  # 1 is ON
)

# An encoder with 4096 counts per turn at 720 rpm, read every millisecond, with an index pulse every turn.
t = np.arange(-1000, 1_002_000, 1000)
count = np.round(t * 1e-6 * 12.0 * 4096).astype(int)
encoder = amiwarp.Encoder.from_counts(t, count, counts_per_turn=4096, index_t_us=np.arange(0, 12) * 1_000_000 // 12)

camera = amiwarp.Camera.from_fov(640, 480, math.radians(60))
prism = amiwarp.Prism(apex=math.radians(1.0), index=1.5168)
source = amiwarp.MemoryEvents(events, 640, 480)
amiwarp.save_recording("mine.h5", amiwarp.Recording(source, camera, encoder, prism, metadata={"lens": "8 mm"}))

opened = amiwarp.open_recording("mine.h5")
assert opened.encoder is not None
slip = math.degrees(float(np.abs(opened.encoder.slip()).max()))
print(f"{len(opened.events)} events, {opened.encoder.rpm:.1f} rpm, index slip at most {slip:.2f} deg")
