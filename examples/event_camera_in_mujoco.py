"""Event cameras in eight worlds of MuJoCo Warp: arms that turn at different speeds, seen through a prism.

Each arm carries a camera behind a turning prism. Its events become voxel grids for a network, without a copy to the
host. Needs ``pip install 'amiwarp[mujoco]'``; runs on CPUs and GPUs.
"""

import math

import mujoco
import mujoco_warp
import numpy as np
import warp as wp

import amiwarp
from amiwarp.sensors import MujocoWarpEventCamera

ARM = """<mujoco><option timestep="0.002"/>
<asset><texture name="tiles" type="2d" builtin="checker" rgb1=".2 .2 .2" rgb2=".8 .8 .8" width="64" height="64"/>
<material name="floor" texture="tiles" texrepeat="8 8"/></asset>
<worldbody><light pos="0 0 3"/><geom type="plane" size="2 2 .1" material="floor"/>
<geom type="box" pos=".3 .2 .2" size=".1 .1 .2" rgba=".9 .4 .2 1"/>
<body pos="0 0 1.2"><joint axis="0 0 1" damping="0.02"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".04"/>
<camera name="eye" pos=".4 0 0" xyaxes="0 -1 0 1 0 0"/></body></worldbody></mujoco>"""
WORLDS, SIDE, STEPS = 8, 48, 6

device = wp.get_preferred_device()
mjm = mujoco.MjModel.from_xml_string(ARM)
start = mujoco.MjData(mjm)
mujoco.mj_forward(mjm, start)
with wp.ScopedDevice(device):
    model = mujoco_warp.put_model(mjm)
    data = mujoco_warp.put_data(mjm, start, nworld=WORLDS)
    data.qvel.assign(np.linspace(-1.0, 1.0, WORLDS)[:, None])  # speed of each arm [rad/s]

    camera = amiwarp.Camera.from_fov(SIDE, SIDE, math.radians(60.0))
    optic = amiwarp.ExactModel.from_prism(camera, amiwarp.Prism(math.radians(1.0)))
    eyes = MujocoWarpEventCamera(
        mjm,
        model,
        data,
        "eye",
        camera,
        optic,
        motion=amiwarp.PrismMotion(rpm=720.0),
        sensor=amiwarp.SensorModel.preset("davis346"),
    )
    for k in range(STEPS):
        mujoco_warp.step(model, data)
        events, windows = eyes.step(data, t_us=2_000 * (k + 1))
        grids = amiwarp.voxel_grid(events, SIDE, SIDE, bins=5, windows=windows)
print(f"events of each arm in the last step: {(windows.stop - windows.start).tolist()}")
print(f"{eyes.pictures} pictures a step; tensors of shape {grids.shape} on {grids.device}")
