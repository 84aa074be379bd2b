"""An arm with a gripper, a ball and a box, and what MuJoCo alone simulates of it."""

import mujoco
import numpy as np

from soro_bench.recording.recording import Signal

HAND = """<mujoco><compiler angle="degree"/><option timestep="0.002" integrator="implicitfast"/>
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
<body name="arm" pos="0 0 1"><joint name="hinge" axis="0 1 0" range="-170 170" damping="0.05"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0.3 0 0" mass="0.2"/>
<body name="hand" pos="0.3 0 0"><geom size="0.02" mass="0.1"/><site name="tip"/>
<body name="finger" pos="0.05 0 0"><joint name="slide" type="slide" axis="1 0 0" range="0 0.1" damping="5"/>
<geom size="0.01" mass="0.02"/></body></body></body>
<body name="ball" pos="0 1 1"><joint name="ball" type="ball" damping="0.01"/>
<geom pos="0.1 0 0" size="0.02" mass="0.1"/></body>
<body name="box" pos="0 2 1"><freejoint name="free"/><geom type="box" size="0.1 0.1 0.1" mass="1"/><site name="corner"/>
</body>
<body name="target" mocap="true" pos="1 0 1"/>
</worldbody>
<actuator><position name="motor" joint="hinge" kp="8" kv="0.5" ctrlrange="-1 1" ctrllimited="true"/>
<position name="gripper" joint="slide" kp="100" ctrlrange="0 0.1" ctrllimited="true"/></actuator>
<sensor><framequat name="turn" objtype="body" objname="ball"/><accelerometer name="felt" site="tip"/>
<jointactuatorfrc name="torque" joint="hinge"/><jointpos joint="hinge"/></sensor>
<keyframe><key name="home" qpos="0.5 0.04  0.7071068 0 0.7071068 0  0 2 1 1 0 0 0" ctrl="0.5 0.04"/></keyframe>
</mujoco>"""
MAP = """
[robot]
control_timestep = 0.02
[commands.goal]
actuators = ["motor"]
[signal]
name = "angle"
joints = ["hinge"]
unit = "rad"
[parameters.inertia]
fields = ["body_mass:arm", "body_inertia:arm"]
deviation = 0.2
"""
SIGNAL = 'name = "angle"\njoints = ["hinge"]\nunit = "rad"'
NOMINAL = np.array([[1.0]])


def with_initial(text: str) -> str:
    return f"{MAP}\n[initial]\n{text}"


def goals(values, step=0.02) -> Signal:
    return Signal(step * np.arange(len(values)), np.asarray(values, float)[:, None], "rad")


def plain(model_text: str, controls, steps: int, timestep: float | None = None, keyframe: int = -1) -> list[tuple]:
    """What MuJoCo alone simulates: positions, sensors and the site "tip" after each control step."""
    model = mujoco.MjModel.from_xml_string(model_text)
    model.opt.timestep = timestep or model.opt.timestep
    data = mujoco.MjData(model)
    if keyframe >= 0:
        mujoco.mj_resetDataKeyframe(model, data, keyframe)
    states = []
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data, steps)
        mujoco.mj_forward(model, data)
        states.append((data.qpos.copy(), data.sensordata.copy(), data.site("tip").xpos.copy()))
    return states
