"""Event cameras in four worlds of Newton, each behind a prism at its own angle, beside plain ones: nothing moves.

A plain event camera at rest sees nothing of a scene at rest; behind the turning prism it sees all edges. The recording
of one camera is saved, as if a rig had recorded it. Needs ``pip install 'amiwarp[newton]'``; runs on CPUs and GPUs.
"""

import math

import newton
import numpy as np
import warp as wp

import amiwarp
from amiwarp.sensors import NewtonEventCamera

WORLDS, WIDTH, HEIGHT, STEP_US, STEPS = 4, 64, 48, 4_000, 6

world = newton.ModelBuilder()
random = np.random.default_rng(1)
for x, y in random.uniform(-1.0, 1.0, (12, 2)):
    place = wp.transform((x, y, 0.0), wp.quat_identity())
    grey = random.uniform(0.1, 1.0)
    world.add_shape_box(-1, xform=place, hx=0.2, hy=0.15, hz=0.1, color=(grey, grey, grey))
builder = newton.ModelBuilder()
builder.replicate(world, WORLDS)
model = builder.finalize()
state = model.state()

camera = amiwarp.Camera.from_fov(WIDTH, HEIGHT, math.radians(40.0))
prism = amiwarp.Prism(math.radians(1.5))
optic = amiwarp.ExactModel.from_prism(camera, prism)
above = (0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 1.0)  # position and quaternion; looks down, along -z
sensor = amiwarp.SensorModel.ideal(contrast=0.15)
plain = NewtonEventCamera(model, camera, pose=above, sensor=sensor)
eyes = NewtonEventCamera(
    model,
    camera,
    optic,
    motion=amiwarp.PrismMotion(rpm=720.0),
    start=np.linspace(0.0, math.pi, WORLDS),
    pose=above,
    sensor=sensor,
)

seen, moved = 0, []
for k in range(STEPS):
    # A solver's step would come here: solver.step(state, ...)
    seen += len(plain.step(state, k * STEP_US)[0])
    moved.append(eyes.step(state, k * STEP_US))
events, windows = moved[-1]
grids = amiwarp.voxel_grid(events, WIDTH, HEIGHT, bins=5, windows=windows)  # for a network
print(f"{seen} events of plain cameras, {sum(len(part) for part, _ in moved)} behind the prisms")
print(f"{eyes.pictures} pictures in a step of {STEP_US} us; tensors of shape {grids.shape}")
amiwarp.save_recording("camera_2.h5", eyes.recording(moved, 2, prism=prism))
print("saved camera_2.h5, for: amiwarp view camera_2.h5")
assert seen == 0
