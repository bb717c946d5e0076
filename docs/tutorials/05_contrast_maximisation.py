"""
Contrast maximisation by hand
=============================

Contrast maximisation looks for the motion that makes the image of warped events (IWE) sharpest. With the right
parameters all events of an edge fall on one line, and the variance of the IWE is largest. For a prism there are two
main parameters: the apex angle, which sets the size of the circle, and the phase, which sets where on the circle an
event lies. This tutorial draws the sharpness over both and climbs to the maximum with an optimiser of SciPy.

The recording
-------------
"""

import math

import matplotlib.pyplot as plt
import numpy as np
from pyvista.examples import mapfile
from scipy.optimize import minimize

import amiwarp

camera = amiwarp.Camera.from_fov(320, 240, math.radians(60))
true_apex, true_phase = math.radians(2.0), math.radians(40.0)
recording = amiwarp.simulate(
    mapfile,
    camera,
    amiwarp.Prism(true_apex),
    duration_s=0.1,
    motion=amiwarp.PrismMotion(720.0, phase=true_phase),
    seed=0,
)
everything = recording.events.slice(0, len(recording.events))
events = everything[:: max(1, len(everything) // 100_000)]
print(f"{len(events):,} of {len(everything):,} events")

# %%
# One candidate
# -------------
#
# A candidate is an apex angle and a phase. The function below compensates the events with it and measures the IWE.


def warped(apex, phase):
    """Return the IWE for one apex angle and phase [rad]."""
    model = amiwarp.ExactModel(camera, amiwarp.Prism(apex), phase)
    return amiwarp.iwe(events, 320, 240, model=model, encoder=recording.encoder)


figure, axes = plt.subplots(1, 3, figsize=(8.0, 2.6))
for ax, (apex_deg, phase_deg) in zip(axes, ((2.0, 40.0), (2.0, 60.0), (1.0, 40.0)), strict=True):
    image = warped(math.radians(apex_deg), math.radians(phase_deg))
    ax.imshow(image, vmax=4.0)
    ax.set_title(f"apex {apex_deg:g}°, phase {phase_deg:g}°:\nsharpness {amiwarp.sharpness(image):.2f}")
    ax.set(xticks=[], yticks=[])
plt.show()

# %%
# The landscape
# -------------
#
# The sharpness over a grid of both parameters has one peak and a rough plain around it. A local search that starts on
# the plain gets lost. This is why :func:`amiwarp.calibrate` begins with a global search.

apexes = np.radians(np.linspace(0.0, 3.0, 16))
phases = np.radians(np.arange(-180.0, 180.0, 15.0))
landscape = np.array([[amiwarp.sharpness(warped(apex, phase)) for phase in phases] for apex in apexes])
best = np.unravel_index(landscape.argmax(), landscape.shape)
start = apexes[best[0]], phases[best[1]]

figure, ax = plt.subplots(figsize=(8.0, 3.6))
drawn = ax.pcolormesh(np.degrees(phases), np.degrees(apexes), landscape, cmap="cividis", shading="nearest")
ax.plot(math.degrees(true_phase), math.degrees(true_apex), "x", color="black", markersize=10, label="true")
ax.plot(
    math.degrees(start[1]),
    math.degrees(start[0]),
    "o",
    color="#d55e00",
    fillstyle="none",
    markersize=12,
    label="best of the grid",
)
ax.set(xlabel="phase [deg]", ylabel="apex angle [deg]", xticks=range(-180, 180, 60))
ax.legend(loc="lower left")
figure.colorbar(drawn, label="sharpness (variance)")
plt.show()

# %%
# The climb
# ---------
#
# From the best point of the grid a simplex search finds the peak. SciPy minimises, so the cost is the negative
# sharpness.

result = minimize(
    lambda x: -amiwarp.sharpness(warped(x[0], x[1])),
    start,
    method="Nelder-Mead",
    options={
        "xatol": 1e-4,
        "fatol": 1e-3,
        "initial_simplex": [start, (start[0] + 3e-3, start[1]), (start[0], start[1] + 0.1)],
    },
)
apex, phase = result.x
print(f"apex angle {math.degrees(apex):.3f} deg, true {math.degrees(true_apex):.3f} deg")
print(f"phase {math.degrees(phase):.2f} deg, true {math.degrees(true_phase):.2f} deg, after {result.nfev} evaluations")

# %%
# The phase found is smaller than the true one. An event comes later than the edge that causes it: the brightness must
# first change by a whole threshold, the sensor adds its latency, and meanwhile the prism turns on. This lag does not
# blur the image. It is removed before the model is compared with the truth.

truth = amiwarp.truth_model(camera, recording.truth, "scene")
error = amiwarp.model_error(amiwarp.ExactModel(camera, amiwarp.Prism(apex), phase), truth)
print(f"model error {error.rms:.3f} px rms with a lag of {math.degrees(error.lag):.2f} deg removed")
