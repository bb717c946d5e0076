"""
Contrast maximisation by hand
=============================

Contrast maximisation looks for the motion that makes the image of warped events
(IWE) sharpest. With the right parameters all events of an edge fall on one line,
and the variance of the IWE is largest. For a prism there are two main parameters:
the apex angle, which sets the size of the circle, and the phase, which sets where
on the circle an event lies. This tutorial draws the sharpness over both and climbs
to the maximum with an optimiser of SciPy.

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
everything = recording.events[:]
events = everything[:: max(1, len(everything) // 100_000)]
print(f"{len(events):,} of {len(everything):,} events")

# %%
# One candidate
# -------------
#
# A candidate is an apex angle and a phase. The function below compensates the
# events with it and returns the IWE. Part of it is shown for the true parameters,
# for a wrong phase, and for a wrong apex angle.


def warped(apex, phase):
    """Return the IWE for one apex angle and phase [rad]."""
    model = amiwarp.ExactModel(camera, amiwarp.Prism(apex), phase)
    return amiwarp.iwe(events, 320, 240, model=model, encoder=recording.encoder)


candidates = ((2.0, 40.0), (2.0, 60.0), (1.0, 40.0))
figure, axes = plt.subplots(1, 3, figsize=(8.0, 3.0))
for ax, (apex, phase) in zip(axes, candidates, strict=True):
    image = warped(math.radians(apex), math.radians(phase))
    ax.imshow(image[50:140, 120:240], vmax=12.0)
    ax.set(title=f"apex {apex:g}°, phase {phase:g}°", xticks=[], yticks=[])
    ax.set_xlabel(f"sharpness {amiwarp.sharpness(image):.2f}")
plt.show()

# %%
# The landscape
# -------------
#
# Over a grid of both parameters the sharpness has one high peak. A local search
# alone would depend on its start: at an apex angle of zero, for example, no change
# of the phase changes anything. This is why :func:`amiwarp.calibrate` begins with a
# global search.

apexes = np.radians(np.linspace(0.0, 3.0, 16))
phases = np.radians(np.arange(-180.0, 180.0, 15.0))
landscape = np.empty((len(apexes), len(phases)))
for i, apex in enumerate(apexes):
    for j, phase in enumerate(phases):
        landscape[i, j] = amiwarp.sharpness(warped(apex, phase))
best = np.unravel_index(landscape.argmax(), landscape.shape)
start = apexes[best[0]], phases[best[1]]

figure, ax = plt.subplots()
drawn = ax.pcolormesh(
    np.degrees(phases),
    np.degrees(apexes),
    landscape,
    cmap="cividis",
    shading="nearest",
)
ax.plot(*np.degrees((true_phase, true_apex)), "kx", markersize=10, label="true")
ax.plot(*np.degrees(start[::-1]), "o", color="#d55e00", label="best of the grid")
ax.set(xlabel="phase [deg]", ylabel="apex angle [deg]", xticks=range(-180, 180, 60))
ax.legend(loc="lower left")
figure.colorbar(drawn, label="sharpness (variance)")
plt.show()

# %%
# The climb
# ---------
#
# From the best point of the grid a simplex search finds the peak. SciPy minimises,
# so the cost is the negative sharpness.


def cost(parameters):
    """Return the negative sharpness."""
    return -amiwarp.sharpness(warped(*parameters))


simplex = [start, (start[0] + 3e-3, start[1]), (start[0], start[1] + 0.1)]
options = {"xatol": 1e-4, "fatol": 1e-3, "initial_simplex": simplex}
result = minimize(cost, start, method="Nelder-Mead", options=options)
apex, phase = result.x
apex_deg, phase_deg = np.degrees(result.x)
print(f"{result.nfev} evaluations")
print(f"apex   {apex_deg:6.3f} deg, true {math.degrees(true_apex):.3f} deg")
print(f"phase  {phase_deg:6.2f} deg, true {math.degrees(true_phase):.2f} deg")

# %%
# The phase found is smaller than the true one. An event comes later than the edge
# that causes it: the brightness must first change by a whole threshold, the sensor
# adds its latency, and meanwhile the prism turns on. This lag does not blur the
# image. It is removed before the model is compared with the truth.

truth = amiwarp.truth_model(camera, recording.truth, "scene")
found = amiwarp.ExactModel(camera, amiwarp.Prism(apex), phase)
error = amiwarp.model_error(found, truth)
print(f"lag removed {math.degrees(error.lag):.2f} deg")
print(f"model error {error.rms:.3f} px rms")
