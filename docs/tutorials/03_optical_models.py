"""
Which optical model does my prism need?
=======================================

amiwarp has four models of the displacement by the prism. The circle model has one
size for the whole image, the radial model lets the circle grow with the distance
from the centre, the ellipse model fits an ellipse to each place, and the exact
model traces the ray through both faces. Simple models are faster. This tutorial
shows what each one costs in pixels, before anything is recorded.

The path of one pixel
---------------------

The models agree in the centre of the image and differ in its corners. The paths are
shown for a corner and one turn of the prism, at an apex angle of 4°, relative to
the pixel without the prism.
"""

import math

import matplotlib.pyplot as plt
import numpy as np

import amiwarp

camera = amiwarp.Camera.from_fov(640, 480, math.radians(60))
models = {
    "circle": amiwarp.CircleModel,
    "radial": amiwarp.RadialCircleModel,
    "ellipse": amiwarp.EllipseModel,
    "exact": amiwarp.ExactModel,
}
styles = {"circle": ":", "radial": "--", "ellipse": "-.", "exact": "-"}

theta = np.linspace(0.0, 2.0 * math.pi, 181).astype(np.float32)
places = {"centre": (319.5, 239.5), "corner": (0.0, 0.0)}
prism = amiwarp.Prism(math.radians(4.0))

figure, axes = plt.subplots(1, 2, figsize=(8.0, 4.2))
for ax, (title, place) in zip(axes, places.items(), strict=True):
    xy = np.tile(np.float32(place), (len(theta), 1))
    for name, model in models.items():
        path = model.from_prism(camera, prism).deflect_points(xy, theta) - xy
        ax.plot(path[:, 0], path[:, 1], styles[name], label=name, linewidth=1.3)
    ax.set(title=title, xlabel="displacement in x [px]", aspect="equal")
axes[0].set_ylabel("displacement in y [px]")
axes[1].legend(loc="center")
plt.show()

# %%
# The error of each model
# -----------------------
#
# :func:`amiwarp.model_error` gives the distance of two models over the whole image
# and one turn. A constant lag is removed first, because calibration would absorb it
# in the phase.

apexes = np.array([0.25, 0.5, 1.0, 2.0, 4.0])
errors = {name: [] for name in ("circle", "radial", "ellipse")}
for apex in apexes:
    prism = amiwarp.Prism(math.radians(apex))
    exact = amiwarp.ExactModel(camera, prism)
    for name, found in errors.items():
        model = models[name].from_prism(camera, prism)
        found.append(amiwarp.model_error(model, exact))

print("rms and worst error [px]")
for i, apex in enumerate(apexes):
    row = [
        f"{name} {found[i].rms:5.3f} {found[i].worst:5.2f}"
        for name, found in errors.items()
    ]
    print(f"apex {apex:4.2f} deg:  " + "   ".join(row))

# %%
# The dotted line is the error of rounding to whole pixels, 0.29 px. A model whose
# error lies far below it costs nothing that can be seen in images at the sensor's
# resolution.

figure, ax = plt.subplots(figsize=(6.5, 3.6))
for name, found in errors.items():
    ax.loglog(
        apexes, [error.rms for error in found], "o" + styles[name], label=name
    )
ax.axhline(1.0 / math.sqrt(12.0), color="0.5", linestyle=":", linewidth=1.0)
ax.set(xlabel="apex angle [deg]", ylabel="rms error [px]")
ax.set_xticks(apexes, [f"{apex:g}" for apex in apexes])
ax.minorticks_off()
ax.legend()
plt.show()

# %%
# The field of view matters too: a wider lens needs a better model at the same apex
# angle. These are errors of the circle model for an apex angle of 1°.

prism = amiwarp.Prism(math.radians(1.0))
for fov in (20, 40, 60, 90):
    wide = amiwarp.Camera.from_fov(640, 480, math.radians(fov))
    circle = amiwarp.CircleModel.from_prism(wide, prism)
    error = amiwarp.model_error(circle, amiwarp.ExactModel(wide, prism))
    print(f"{fov} deg: {error.rms:.3f} px rms, {error.worst:.2f} px at most")

# %%
# :func:`amiwarp.calibrate` makes this choice by itself: it always calibrates the
# exact model, and then returns the cheapest model that predicts the same places
# within an error budget.
