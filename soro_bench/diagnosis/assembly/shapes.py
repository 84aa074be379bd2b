"""The robot as shapes to draw, each with the locations that it stands for."""

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from soro_bench.diagnosis.assembly.patch import kept
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.result_robot import Shape
from soro_bench.effects.effect import Location
from soro_bench.effects.elements import SCALAR_JOINTS

THIN = 0.02  # of the robot's extent: radius of what has none
MOST_VERTICES = 400  # of flexes; more would not be seen

_LONG = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
_THICK = (int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_ELLIPSOID))
_GROUND = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
MOST_JOINTS = 50  # that are drawn; more hide the robot


def shapes(diagnosis: Diagnosis) -> tuple[Shape, ...]:
    """Of the fitted robot in its initial configuration: geoms, tendons, joints, flexes and measured points."""
    robot = diagnosis.robot
    model = robot.model(robot.parameters(kept(diagnosis).x), [])
    thin, found = THIN * float(model.stat.extent), of_model(model)
    first = diagnosis.explanation.problem.recordings[0].values[0]
    if first.shape[1] == 3 and robot.unit == "m":
        found += [
            Shape((_point(row),), 0.5 * thin, (Location("sensor", robot.signal, i), Location("sensor", robot.signal)))
            for i, row in enumerate(first)
            if np.isfinite(row).all()
        ]
    return tuple(found)


def of_model(model: mujoco.MjModel) -> list[Shape]:
    """Of a model in its initial configuration: geoms, tendons, joints and flexes."""
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    thin = THIN * float(model.stat.extent)
    return [
        *_geoms(model, data, thin),
        *_joints(model, data, thin),
        *_tendons(model, data),
        *_flexes(model, data, thin),
    ]


def _point(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(each) for each in values)
    return x, y, z


def _actuators(model: mujoco.MjModel, kinds: tuple[int, ...], target: int) -> list[Location]:
    """Of the actuators that act on a joint or tendon."""
    ids = [i for i in range(model.nu) if model.actuator_trntype[i] in kinds and model.actuator_trnid[i, 0] == target]
    return [Location("actuator", model.actuator(i).name) for i in ids]


def _joint_locations(model: mujoco.MjModel, joint: int) -> list[Location]:
    kinds = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    return [Location("joint", model.joint(joint).name), *_actuators(model, kinds, joint)]


def _body_locations(model: mujoco.MjModel, body: int) -> list[Location]:
    joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    return [Location("body", model.body(body).name), *(each for j in joints for each in _joint_locations(model, j))]


def _geoms(model: mujoco.MjModel, data: mujoco.MjData, thin: float) -> Iterator[Shape]:
    """Capsules as lines with a radius, all others as balls of their size; planes are no part of the robot."""
    drawn = set()
    for i in range(model.ngeom):
        kind, size, centre = int(model.geom_type[i]), model.geom_size[i], data.geom_xpos[i]
        if kind in _GROUND:
            continue
        body = int(model.geom_bodyid[i])
        drawn.add(body)
        own = [Location("geom", name)] if (name := model.geom(i).name) else []
        locations = [*_body_locations(model, body), *own]
        if kind in _LONG:
            half = size[1] * data.geom_xmat[i].reshape(3, 3)[:, 2]
            yield Shape((_point(centre - half), _point(centre + half)), float(size[0]), tuple(locations))
        elif kind in _THICK:
            axis = int(np.argmax(size))
            radius = float(np.sort(size)[1])
            half = max(size[axis] - radius, 0.0) * data.geom_xmat[i].reshape(3, 3)[:, axis]
            yield Shape((_point(centre - half), _point(centre + half)), radius, tuple(locations))
        else:
            yield Shape((_point(centre),), float(model.geom_rbound[i]) or thin, tuple(locations))
    for body in range(1, model.nbody):
        if body not in drawn:  # a frame without geoms: a line to its parent
            ends = (_point(data.xpos[model.body_parentid[body]]), _point(data.xpos[body]))
            yield Shape(ends, 0.2 * thin, tuple(_body_locations(model, body)))


def _joints(model: mujoco.MjModel, data: mujoco.MjData, thin: float) -> Iterator[Shape]:
    for j in range(model.njnt):
        if int(model.jnt_type[j]) in SCALAR_JOINTS and model.njnt <= MOST_JOINTS:
            yield Shape((_point(data.xanchor[j]),), 0.5 * thin, tuple(_joint_locations(model, j)))


def _tendons(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[Shape]:
    for t in range(model.ntendon):
        start, count = int(data.ten_wrapadr[t]), int(data.ten_wrapnum[t])
        points = data.wrap_xpos.reshape(-1, 3)[start : start + count]
        if len(points):
            own = [Location("tendon", model.tendon(t).name)]
            own += _actuators(model, (int(mujoco.mjtTrn.mjTRN_TENDON),), t)
            yield Shape(tuple(_point(each) for each in points), 0.0, tuple(own))


def _flexes(model: mujoco.MjModel, data: mujoco.MjData, thin: float) -> Iterator[Shape]:
    for f in range(model.nflex):
        start, count = int(model.flex_vertadr[f]), int(model.flex_vertnum[f])
        step = max(1, math.ceil(count / MOST_VERTICES))
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, f)
        for point in data.flexvert_xpos[start : start + count : step]:
            yield Shape((_point(point),), 0.5 * thin, (Location("flex", name),) if name else ())
