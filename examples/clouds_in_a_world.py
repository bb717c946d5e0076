"""Show where in a simulated world events come from: an event cloud, and the same events on the world's meshes."""

import math

import numpy as np
import pyvista
from scipy.spatial.transform import Rotation

import amiwarp

world, way = amiwarp.named_world("room", "still", duration_s=0.1)
camera, prism = (
    amiwarp.Camera.from_fov(160, 120, math.radians(60)),
    amiwarp.Prism(math.radians(1.5)),
)
recording = amiwarp.simulate(amiwarp.WorldScene(world, way), camera, prism, duration_s=0.1)
calibration = amiwarp.calibrate(recording)
before, after = amiwarp.event_clouds(recording, calibration)
print(
    f"{after.n_points:,} events; residual {before['residual_px'].mean():.2f} px recorded, "
    f"{np.nanmean(after['residual_px']):.2f} px compensated"
)

plotter = pyvista.Plotter(off_screen=True, shape=(1, 2), window_size=(1200, 500))
plotter.add_mesh(after, scalars="residual_px", point_size=2, cmap="cividis")
plotter.add_text("compensated events over x, y and prism angle", font_size=9)

plotter.subplot(0, 1)
for body in world.bodies:
    mesh = pyvista.PolyData.from_regular_faces(body.mesh.vertices, body.mesh.faces)
    if body.trajectory is not None:  # where the body is at the start
        mesh.points = (
            Rotation.from_quat(body.trajectory.rotation[0]).apply(mesh.points)
            + body.trajectory.position[0]
        )
    plotter.add_mesh(mesh, color="lightgrey", opacity=0.15)
seen = after.extract_points(np.isfinite(after["place_m"]).all(axis=1), include_cells=False)
on_the_meshes = pyvista.PolyData(seen["place_m"])
on_the_meshes["polarity"] = seen["polarity"]
plotter.add_mesh(
    on_the_meshes,
    scalars="polarity",
    point_size=3,
    cmap=["#0072b2", "#d55e00"],
    show_scalar_bar=False,
)
plotter.view_vector((-1.0, -1.0, 0.8), viewup=(0.0, 0.0, 1.0))
plotter.add_text("the same events in the room", font_size=9)
plotter.screenshot("clouds_in_a_world.png")
