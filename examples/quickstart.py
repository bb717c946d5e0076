"""Simulate a recording, calibrate the prism without an initial guess, and compensate the motion of the prism."""

import math

from pyvista.examples import mapfile

import amiwarp

camera = amiwarp.Camera.from_fov(320, 240, math.radians(60))
true = amiwarp.Prism(math.radians(2.0))
on_the_sheet = amiwarp.Prism(math.radians(2.3))
recording = amiwarp.simulate(
    mapfile, camera, true, duration_s=0.2, motion=720.0, nominal_prism=on_the_sheet
)

calibration = amiwarp.calibrate(recording)
apex = calibration.exact.parameters["apex"]
print(f"apex {math.degrees(apex):.3f} deg, true {math.degrees(true.apex):.3f} deg")

done = amiwarp.compensate(recording, calibration, "from_python.h5")
print(f"{done.events} events at {done.mev_per_s:.1f} Mev/s into from_python.h5")
