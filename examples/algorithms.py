"""Calibrate one recording with different NLopt algorithms and measures of sharpness."""

import math

from pyvista.examples import mapfile

import amiwarp
from amiwarp import Sharpness

camera = amiwarp.Camera.from_fov(320, 240, math.radians(60))
prism = amiwarp.Prism(math.radians(2.0))
recording = amiwarp.simulate(mapfile, camera, prism, duration_s=0.2, seed=1)
assert recording.truth is not None
truth = amiwarp.truth_model(camera, recording.truth, prism.flat_side)

for sharpness, global_algorithm, local_algorithm in (
    (Sharpness.VARIANCE, "GN_DIRECT_L", "LN_BOBYQA"),
    (Sharpness.GRADIENT, "GN_CRS2_LM", "LN_SBPLX"),
    (Sharpness.ENTROPY, "GN_DIRECT_L", "LN_NELDERMEAD"),
):
    found = amiwarp.calibrate(
        recording,
        stages=("sharpness",),
        sharpness=sharpness,
        global_algorithm=global_algorithm,
        local_algorithm=local_algorithm,
        events=100_000,
        global_evaluations=150,
    )
    error = amiwarp.model_error(found.model, truth).rms
    print(
        f"{sharpness.value:9} {global_algorithm:12} {local_algorithm:14} {found.seconds:5.1f} s, error {error:.3f} px"
    )
