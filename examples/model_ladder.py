"""Predict the error of each optical model without a recording, compared with the exact model [px]."""

import math

from amiwarp import Camera, ExactModel, Prism
from amiwarp.optics.models import MODELS, predicted_error

camera = Camera.from_fov(640, 480, math.radians(60))
for apex_deg in (0.5, 1.0, 2.0, 4.0):
    prism = Prism(math.radians(apex_deg))
    exact = ExactModel(camera, prism)
    print(f"apex {apex_deg} deg, deflection {math.degrees(prism.deflection):.3f} deg")
    for name in ("circle", "radial", "ellipse"):
        error = predicted_error(MODELS[name].from_prism(camera, prism), exact)
        print(f"  {name:8} rms {error.rms:.4f} px, worst {error.worst:.4f} px")
