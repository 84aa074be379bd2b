"""Where a law acts: what it does there in a replay, and how the same is done without it."""

from collections.abc import Sequence

import mujoco
import numpy as np

from soro_bench.diagnosis.candidates import Term
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.spread_terms import SpreadTerm
from soro_bench.effects.catalogue import PHYSICS
from soro_bench.effects.effect import Location
from soro_bench.effects.setpoints import SetpointLaw


def law_site(robot: Robot, term: Term) -> "Springs | Servos | None":
    """Where a candidate term acts; None for what is no passive force and no law of setpoints, or has no location, or is
    another function of the state at each."""
    elements, model, location = robot.elements, robot.elements.model, term.location
    if isinstance(term, SpreadTerm) or location.kind not in ("tendon", "joint", "body", "actuator"):
        return None
    locations = elements.expand(location, welded=True)
    ids = [elements.id(each) for each in locations]
    if location.kind == "actuator":
        servos = (model.actuator_biastype[ids] == mujoco.mjtBias.mjBIAS_AFFINE).all()
        return Servos(robot, locations) if servos and issubclass(PHYSICS[term.name], SetpointLaw) else None
    has_joints = location.kind != "body" or all(len(elements.joints_of(i)) for i in ids)
    return Springs(robot, locations) if has_joints else None


class Springs:
    """K tendons, joints or bodies with joints, on which a law acts by passive forces.

    Attributes:
        state, force: names of both, the second one with its unit.
        turns: whether the state is an angle [rad]; else it is a length [m].
        scale: from forces to the unit in which they are shown. of_state: from the state to its unit, and that.
    """

    scale = 1.0

    def __init__(self, robot: Robot, locations: Sequence[Location]):
        self._batch, self._model, elements = robot.simulation.batch, robot.simulation.model, robot.elements
        for name in ("ten_J", "ten_length", "qfrc_passive"):
            self._batch.bind(name)
        kind, self._ids = locations[0].kind, [elements.id(each) for each in locations]
        if kind == "tendon":
            self._joints, self.turns, self.of_state = None, False, (1e3, "mm")
            self.state, self.force = "length pulled in", "force in the tendon [N]"
            return
        bodies = kind == "body"
        self._joints = [elements.joints_of(i, bending_only=True) if bodies else np.array([i]) for i in self._ids]
        self.turns = _turns(self._model, self._joints[0][0])
        self.of_state = (1.0, "rad") if self.turns else (1e3, "mm")
        self.state, self.force = "bend" if bodies else "position", "moment [N m]" if self.turns else "force [N]"

    def observed(self) -> np.ndarray:
        """(2, K) states at the end of a control step, and what the law does.

        Simulation 0 has the law, simulation 1 all the rest; this has to be called before every step.
        """
        for name in ("qpos", "qvel", "plastic"):
            values = getattr(self._batch, name)
            values[1] = values[0]
        self._batch.forward(np.array([1]), stage=mujoco.mjtStage.mjSTAGE_VEL)
        along, extra = self._directions(1)[0], self._batch.qfrc_passive[0] - self._batch.qfrc_passive[1]
        return np.stack([self._states(), along @ extra / np.maximum((along**2).sum(axis=1), 1e-300)])

    def apply_input(self, forces: np.ndarray) -> None:
        """Let forces (N, K) act in the first N simulations from now on."""
        acting = np.einsum("nk,nkv->nv", forces, self._directions(len(forces)))
        self._batch.qfrc_applied[: len(forces)] = acting

    def _states(self) -> np.ndarray:
        if self._joints is None:
            return self._model.tendon_length0[self._ids] - self._batch.ten_length[0, self._ids]
        angles = [self._batch.qpos[0, self._model.jnt_qposadr[joints]] for joints in self._joints]
        return np.array([np.linalg.norm(each) if len(each) > 1 else each[0] for each in angles])

    def _directions(self, count: int) -> np.ndarray:
        """(count, K, nv) generalised forces of a unit force; the joints of one body bend it together."""
        found, model = np.zeros((count, len(self._ids), self._model.nv)), self._model
        for k, i in enumerate(self._ids):
            if self._joints is None:
                entries = model.ten_J_rowadr[i] + np.arange(model.ten_J_rownnz[i])
                found[:, k, model.ten_J_colind[entries]] = -self._batch.ten_J[:count, entries]
            else:
                angles = self._batch.qpos[:count, model.jnt_qposadr[self._joints[k]]]
                size = np.maximum(np.linalg.norm(angles, axis=1, keepdims=True), 1e-9)
                found[:, k, model.jnt_dofadr[self._joints[k]]] = angles / size if angles.shape[1] > 1 else 1.0
        return found


class Servos:
    """K servos whose setpoints a law changes; its "force" is how far. The same interface as Springs."""

    state = "command"

    def __init__(self, robot: Robot, locations: Sequence[Location]):
        self._simulation = robot.simulation
        self._bias, self._gain = (robot.simulation.batch.expand(f"actuator_{name}prm") for name in ("bias", "gain"))
        self._ids, self._timestep = [robot.elements.id(location) for location in locations], robot.control_timestep
        self._added = np.zeros(len(locations))
        unit = robot.setpoint_unit_at(locations[0])
        self.of_state = (1e3, "mm") if unit == "m" else (1.0, unit)
        self.scale, self.force = self.of_state[0], f"beside the command by [{self.of_state[1]}]"

    def observed(self) -> np.ndarray:
        """As of springs: commands, and what the law adds to them."""
        self._own = self._bias[0, self._ids, 0].copy()
        asked, added = (each[0, self._ids] for each in self._simulation.setpoints)
        mean, self._added = (added - self._added) / self._timestep, added
        return np.stack([asked, mean])

    def apply_input(self, forces: np.ndarray) -> None:
        """As of springs: shift the setpoints (N, K) of the first N simulations."""
        count = len(forces)
        self._bias[:count, self._ids, 0] = self._own + self._gain[:count, self._ids, 0] * forces


def _turns(model: mujoco.MjModel, joint: int) -> bool:
    return bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE)
