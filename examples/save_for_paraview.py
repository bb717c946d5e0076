"""Save the events of one turn before and after compensation as VTP files, which ParaView opens."""

import math

from pyvista.examples import mapfile

import amiwarp

camera, prism = (
    amiwarp.Camera.from_fov(320, 240, math.radians(60)),
    amiwarp.Prism(math.radians(2.0)),
)
recording = amiwarp.simulate(mapfile, camera, prism, duration_s=0.2, motion=720.0)
calibration = amiwarp.calibrate(recording)

start = recording.events.t_first + 50_000
one_turn = start, start + round(60e6 / 720)
for name, cloud in zip(
    ("before", "after"), amiwarp.event_clouds(recording, calibration, window=one_turn), strict=True
):
    cloud.save(f"{name}.vtp")
    print(f"{name}.vtp: {cloud.n_points:,} points with {', '.join(cloud.point_data)}")
