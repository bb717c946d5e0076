"""Simulate a recording, calibrate the prism without an initial guess, and compensate the motion of the prism."""

import math

from pyvista.examples import mapfile

import amiwarp

camera = amiwarp.Camera.from_fov(320, 240, math.radians(60))
true, nominal = amiwarp.Prism(math.radians(2.0)), amiwarp.Prism(math.radians(2.3))
recording = amiwarp.simulate(mapfile, camera, true, duration_s=0.2, motion=720.0, nominal_prism=nominal)

calibration = amiwarp.calibrate(recording)
apex = calibration.exact.parameters["apex"]
print(f"{calibration.model_name} model; apex {math.degrees(apex):.3f} deg, true {math.degrees(true.apex):.3f} deg")
print(f"sharpness {calibration.sharpness_before:.2f} -> {calibration.sharpness_after:.2f}")

done = amiwarp.compensate(recording, calibration, "compensated.h5")
print(f"compensated.h5: {done.events} events written at {done.mev_per_s:.1f} Mev/s")
