"""What a simulation knows of its own limits: forces and controls at an end, slack cables, stops and contacts.

Read from replays of the fitted robot, at the ends of the control steps, by MuJoCo's fields alone: the suite's robots
and any other model have one code path.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.assembly.patch import kept
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.result_parts import ReachedLimit
from soro_bench.diagnosis.robots.measured import Drive
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import LimitSettings
from soro_bench.effects.effect import Effect
from soro_bench.effects.elements import AUXILIARY, OBJECTS, SCALAR_JOINTS

ORDER = ("force_limit", "control_limit", "slack", "stop", "contact")


@dataclass(frozen=True)
class _Reached:
    """A limit that is reached at one time: of which kind, of which element, and its value where it has one."""

    name: str
    element: str
    value: float | None = None
    unit: str = ""


def reached_limits(diagnosis: Diagnosis) -> tuple[ReachedLimit, ...]:
    """The limits that the fitted robot reaches for a share of the recordings that it was fitted to, the largest shares
    of each kind first."""
    problem, fit = diagnosis.explanation.problem, kept(diagnosis)
    parameters = np.array([list(diagnosis.robot.parameters(fit.x).values())])
    drives = [each.drive for each in problem.recordings]
    return limits_of(diagnosis.robot, drives, parameters, fit.effects(problem.parameters), problem.settings.limits)


def limits_of(
    robot: Robot, drives: Sequence[Drive], parameters: Floats, effects: Sequence[Effect], settings: LimitSettings
) -> tuple[ReachedLimit, ...]:
    """The same for any replays.

    Args:
        parameters: (1, d) in the order of the robot's priors.
    """
    found: Counter[_Reached] = Counter()
    steps = 0
    for drive in drives:
        watch = _Watch(robot, settings)
        robot.simulate_all([drive], parameters, [effects], watch)
        watch(len(drive.actions))
        found += watch.found
        steps += watch.steps
    shares = {one: count / max(steps, 1) for one, count in found.items()}
    said = sorted(shares.items(), key=lambda pair: (ORDER.index(pair[0].name), -pair[1], pair[0].element))
    return tuple(
        ReachedLimit(one.name, one.element, share, one.value, one.unit)
        for one, share in said
        if share >= settings.least_share
    )


class _Watch:
    """Counts limits that simulation 0 of a robot reaches. It is called before every control step and after the last."""

    def __init__(self, robot: Robot, settings: LimitSettings) -> None:
        self._robot, self._settings = robot, settings
        self._units = robot.force_units, robot.setpoint_units
        self._model: mujoco.MjModel | None = None
        self._data: mujoco.MjData | None = None
        self.found: Counter[_Reached] = Counter()
        self.steps = 0

    def __call__(self, step: int) -> None:
        """Count what is reached now, after the step before."""
        if step == 0:
            return  # nothing has acted
        self._model, self._data = self._robot.simulation.commanded(0, self._model, self._data)
        self.steps += 1
        self.found.update(set(self._reached(self._model, self._data)))

    def _reached(self, model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[_Reached]:
        tolerance = self._settings.tolerance
        yield from _of_actuators(model, data, tolerance, *self._units)
        yield from _of_tendons(model, data, tolerance)
        yield from _of_joints(model, data, tolerance)
        yield from _contacts(model, data)


def _of_actuators(
    model: mujoco.MjModel, data: mujoco.MjData, tolerance: float, forces: list[str], setpoints: list[str]
) -> Iterator[_Reached]:
    """Forces and controls at an end of their range; a force that can only pull and is at its zero end is slack.

    Args:
        forces, setpoints: units of the actuators' forces and setpoints.
    """
    integrates = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR
    pulls = model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON
    for i in range(model.nu):
        name = _name(model, "tendon", int(model.actuator_trnid[i, 0])) if pulls[i] else _name(model, "actuator", i)
        if model.actuator_forcelimited[i]:
            end = _end(data.actuator_force[i], model.actuator_forcerange[i], tolerance)
            if end is not None and end != 0.0:
                yield _Reached("force_limit", name, float(end), forces[i])
            elif end is not None and pulls[i]:
                yield _Reached("slack", name)
        # the rate of a setpoint is often at its end; what counts is the setpoint
        if integrates[i] and model.actuator_actlimited[i]:
            end = _end(data.act[model.actuator_actadr[i]], model.actuator_actrange[i], tolerance)
        elif not integrates[i] and model.actuator_ctrllimited[i]:
            end = _end(data.ctrl[i], model.actuator_ctrlrange[i], tolerance)
        else:
            end = None
        if end is not None and end != 0.0:  # at 0 nothing is asked for
            yield _Reached("control_limit", name, float(end), setpoints[i])


def _of_tendons(model: mujoco.MjModel, data: mujoco.MjData, tolerance: float) -> Iterator[_Reached]:
    """Springs that are slack between two lengths, and tendons at a limit of their length."""
    for i in range(model.ntendon):
        name, length = model.tendon(i).name, data.ten_length[i]
        if name.startswith(AUXILIARY):
            continue
        low, high = model.tendon_lengthspring[i]
        stiff = model.tendon_stiffness[i] != 0 or model.tendon_stiffnesspoly[i].any()
        if low < high and stiff and low <= length <= high:
            yield _Reached("slack", _name(model, "tendon", i))
        if model.tendon_limited[i] and _end(length, model.tendon_range[i], tolerance) is not None:
            yield _Reached("stop", _name(model, "tendon", i))


def _of_joints(model: mujoco.MjModel, data: mujoco.MjData, tolerance: float) -> Iterator[_Reached]:
    """Hinges and slides at a stop, and joints at the limit of their actuators' forces."""
    for i in range(model.njnt):
        if model.jnt_type[i] not in SCALAR_JOINTS:
            continue
        if model.jnt_limited[i]:
            position = data.qpos[model.jnt_qposadr[i]]
            if _end(position, model.jnt_range[i], tolerance) is not None:
                yield _Reached("stop", _name(model, "joint", i))
        if model.jnt_actfrclimited[i]:
            force = data.qfrc_actuator[model.jnt_dofadr[i]]
            end = _end(force, model.jnt_actfrcrange[i], tolerance)
            if end:
                turns = model.jnt_type[i] == int(mujoco.mjtJoint.mjJNT_HINGE)
                yield _Reached("force_limit", _name(model, "joint", i), float(end), "N m" if turns else "N")


def _contacts(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[_Reached]:
    """Pairs that press on each other."""
    for k in range(data.ncon):
        if data.contact.efc_address[k] >= 0:
            pair = sorted(_side(model, data.contact, k, side) for side in (0, 1))
            yield _Reached("contact", " and ".join(pair))


def _side(model: mujoco.MjModel, contact: mujoco.MjContact, k: int, side: int) -> str:
    """The body or flex on one side of a contact."""
    geom = int(contact.geom[k][side])
    if geom < 0:
        return _name(model, "flex", int(contact.flex[k][side]))
    named = model.geom(geom).name
    return f"geom {named}" if named else _name(model, "body", int(model.geom_bodyid[geom]))


def _name(model: mujoco.MjModel, kind: str, i: int) -> str:
    """The kind and name of an element, or its number where it has none."""
    return f"{kind} {mujoco.mj_id2name(model, OBJECTS[kind], i) or f'#{i}'}"


def _end(value: float, ends: Floats, tolerance: float) -> float | None:
    """The end of a range that a value is at or beyond; None between the ends, or without a range."""
    low, high = ends.tolist()
    near = tolerance * (high - low)
    if not low < high:
        return None
    return low if value <= low + near else high if value >= high - near else None
