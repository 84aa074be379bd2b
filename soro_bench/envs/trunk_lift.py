"""TrunkLift: lift an object, if need be against a wall. TrunkGrasp: the same with a goal that can be met."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import mujoco
import numpy as np

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.envs.single import SoftRobotEnv
from soro_bench.envs.task import Task
from soro_bench.envs.trunk import ObjectTask, Version1
from soro_bench.envs.vector import SoftRobotVectorEnv
from soro_bench.models import trunk
from soro_bench.models.scene import WallOffset
from soro_bench.models.simulation import ParameterMap
from soro_bench.parameters import CUBE_MASS, FRICTION, WALL_OFFSET, Parameter, ParameterSet

GOAL = np.array([-0.100, -0.025, 0.120])  # m, published; only y matters
LIFT_WEIGHT, APPROACH_WEIGHT = 0.75, 0.25  # published
REST_HEIGHT = -0.107978 + 0.0105 + 0.005  # m: floor, half the object's height, the 5 mm that surfaces keep apart


class TrunkLiftTask(ObjectTask):
    """N simulations of TrunkLift."""

    scene, metric = "lift.xml", "elevation"
    # friction 0.9 and 0.05 kg are the published nominal values of this task
    parameters = ParameterSet(CUBE_MASS, FRICTION, WALL_OFFSET, *trunk.PARAMETERS).with_nominal(friction=0.9)
    randomized: ClassVar[tuple[Parameter, ...]] = (WALL_OFFSET,)
    evaluation = tuple({"params": {"cube_mass": mass}} for mass in (0.05, 0.1))  # kg, published

    signal_units: ClassVar = {**ObjectTask.signal_units, "elevation": ("m", "world"), "clearance": ("m", "world")}

    def distance(self, ids: Ints) -> Floats:
        position = self.object_position(ids)
        lift = self.xp.abs(position[:, 1] - self.goal[ids, 1])
        approach = self.xp.linalg.vector_norm(self.tip(ids) - position, axis=1)
        return LIFT_WEIGHT * lift + APPROACH_WEIGHT * approach

    def elevation(self, ids: Ints) -> Floats:
        """(n,) rise of the object's centre [m] above its rest on the floor: our reading of the published "elevation",
        whose definition is in neither paper nor code."""
        return self.object_position(ids)[:, 1] - REST_HEIGHT

    def clearance(self, ids: Ints) -> Floats:
        """(n,) rise of the object's lowest corner [m] above its rest: zero where it is tipped, not lifted."""
        half = self.sim.array(self.model.geom("object").size)
        return self.elevation(ids) + half[1] - self.xp.sum(self.xp.abs(self.vertical(ids)) * half, axis=1)

    def vertical(self, ids: Ints) -> Floats:
        """(n, 3) unit vector up, in the object's frame."""
        x, y, z, w = self._object_pose(ids)[:, 3:].T
        return self.xp.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=1)

    def signals(self, ids: Ints) -> dict[str, Floats]:
        """As for every object task, elevation (n,) and clearance (n,) [m]."""
        return {**super().signals(ids), **self._heights(ids)}

    def _heights(self, ids: Ints) -> dict[str, Floats]:
        return {"elevation": self.elevation(ids), "clearance": self.clearance(ids)}

    def _scene_parameters(self, model: mujoco.MjModel) -> Sequence[ParameterMap]:
        return (*super()._scene_parameters(model), WallOffset(model))

    def _sample_goal(self, rng: np.random.Generator) -> Floats:
        return GOAL

    def _info(self, ids: Ints) -> dict[str, Any]:
        return {**super()._info(ids), **self._heights(ids)}


class TrunkLiftV1Task(Version1, TrunkLiftTask):
    """N simulations of TrunkLift-v1."""


HEIGHT = 0.02  # m, clearance that is asked for
HELD_STEPS = 10  # control steps through which it has to be held: 0.5 s
FULL_RISE = 0.06  # m, rise of the centre that rewards count no more of
CLEARANCE_WEIGHT, RISE_WEIGHT = 2.0, 0.75  # of the whole way; a tipped object has little of the second only
HELD_REWARD, SUCCESS_REWARD, STEP_REWARD = 0.1, 5.0, -0.01
_MASSES = (0.05, 0.075, 0.1)  # kg, of evaluation; as the published ones, and between them
_MASS = replace(CUBE_MASS, search=(min(_MASSES), max(_MASSES)))
_WALLS = (-0.03, -0.01, 0.01, 0.03)  # m


class TrunkGraspTask(Version1, TrunkLiftTask):
    """N simulations of TrunkGrasp."""

    metric = "clearance"
    options = Task.options
    parameters = ParameterSet(_MASS, FRICTION, WALL_OFFSET, *trunk.PARAMETERS).with_nominal(friction=0.9)
    randomized = (WALL_OFFSET, _MASS)
    evaluation = tuple(
        {"params": {"wall_offset": wall, "cube_mass": mass}} for wall, mass in itertools.product(_WALLS, _MASSES)
    )

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._held = self.sim.array(np.zeros(self.num_envs))  # steps
        self._achieved = self.sim.array(np.zeros(self.num_envs))

    def distance(self, ids: Ints) -> Floats:
        """(n,) clearance [m] that is missing."""
        return self.xp.clip(HEIGHT - self.clearance(ids), 0.0, self._FARTHEST)

    def _place(self, ids: Ints, starts: Sequence[Floats]) -> None:
        super()._place(ids, starts)
        self.sim.batch.qpos[ids, self._object_qpos + 1] = REST_HEIGHT

    def _begin(self, ids: Ints) -> None:
        self._held[ids] = 0.0
        self._achieved[ids] = self._achievement(ids)

    def _achievement(self, ids: Ints) -> Floats:
        """(n,) how far the object has come, of which rewards are the changes."""
        lifted = self.xp.clip(self.clearance(ids) / HEIGHT, -1.0, 1.0)
        risen = self.xp.clip(self.elevation(ids) / FULL_RISE, -1.0, 1.0)
        return self.xp.nan_to_num(CLEARANCE_WEIGHT * lifted + RISE_WEIGHT * risen)

    def _score(self, ids: Ints) -> tuple[dict[str, Floats], Bools]:
        clear, now = self.clearance(ids) >= HEIGHT, self._achievement(ids)
        held = self.xp.where(clear, self._held[ids] + 1.0, 0.0)
        success = held >= HELD_STEPS
        terms = {
            "reward_progress": now - self._achieved[ids],
            "reward_held": self.xp.where(clear, HELD_REWARD, 0.0) + self.xp.where(success, SUCCESS_REWARD, 0.0),
            "reward_time": self.xp.full_like(now, STEP_REWARD),
        }
        self._held[ids], self._achieved[ids] = held, now
        return terms, success

    def _sample_goal(self, rng: np.random.Generator) -> Floats:
        return np.array([GOAL[0], REST_HEIGHT + HEIGHT, GOAL[2]])


class TrunkLiftEnv(SoftRobotEnv):
    """Lift an object with a cable-driven soft trunk that may press it against a wall.

    ## Description
    The trunk of :class:`TrunkReachEnv` above a floor, beside a wall at x = -100 mm; an object of 56 x 21 x 35 mm (0.05
    kg, friction 0.9) is dropped from y = -60 mm. Third task of Tiboni et al., IROS 2023, where randomising the wall
    makes the robot use it.

    ## Actions
    As in :class:`TrunkReachEnv`.

    ## Observations
    `Box(-1, 1, (73,))`, as in :class:`TrunkPushEnv`. The wall is not observed.

    ## Rewards
    As in :class:`TrunkReachEnv`, with d = 0.75 |y_object - y_goal| + 0.25 |tip - object|.

    ## Episode
    Starts straight and at rest with the object at (-30, -60, 120) mm; goal y = -25 mm. Terminates (`is_success`) at
    d <= 1 mm; truncated after 100 steps of 0.05 s.

    ## Arguments
    As in :class:`TrunkReachEnv`; `params` also takes cube_mass (published: 0.05 and 0.1 kg), friction and wall_offset
    (published randomisation: uniform in +-0.03 m; -0.2 puts the wall out of reach).

    `info` also has `elevation` [m], the rise of the object's centre above its rest, and `clearance` [m], that of its
    lowest corner: an object that is rolled onto a narrower face has the former only.

    ## Version history
    * v1: as of :class:`TrunkReachEnv`.
    * v0: after the paper, see :class:`TrunkReachEnv`. The wall is not observed, as the paper says (the published code
      writes its position into the goal's x).
      `TrunkLiftContinuous-v0` is v0 with `action="continuous"`, for programs that know ids only.
    """

    task_type = TrunkLiftTask


class TrunkLiftVectorEnv(SoftRobotVectorEnv):
    """Vector form of :class:`TrunkLiftEnv`."""

    task_type = TrunkLiftTask


class TrunkLiftV1Env(SoftRobotEnv):
    """Version 1 of :class:`TrunkLiftEnv`; its version history says what differs."""

    task_type = TrunkLiftV1Task


class TrunkLiftV1VectorEnv(SoftRobotVectorEnv):
    """Vector form of :class:`TrunkLiftV1Env`."""

    task_type = TrunkLiftV1Task


class TrunkGraspEnv(SoftRobotEnv):
    """Lift an object off the floor with a cable-driven soft trunk, and hold it.

    ## Description
    The floor, wall and object (56 x 21 x 35 mm) of :class:`TrunkLiftEnv`. Success needs a lift that is held; the
    published reward also pays for tipping the object over.

    ## Actions
    As in :class:`TrunkReachEnv`.

    ## Observations
    `Box(-1, 1, (73,))`, as in :class:`TrunkPushEnv`. The wall is not observed, and the goal is constant.

    ## Rewards
    `reward_progress`, the change in this step of 2 clearance / 20 mm + 0.75 elevation / 60 mm, both fractions clipped
    to +-1. `reward_held`: 0.1 a step at 20 mm clearance or more, and 5 at success. `reward_time`: -0.01.

    ## Episode
    Starts straight, with the object at rest on the floor at (-30, -92, 120) mm. Terminates (`is_success`) when every
    corner of the object has been 20 mm above its rest for 0.5 s; truncated after 100 steps of 0.05 s.

    ## Arguments
    As in :class:`TrunkLiftEnv`, but no `goal`. Randomised: cube_mass in 0.05 .. 0.1 kg, wall_offset in +-0.03 m.

    `info` also has `elevation` and `clearance` [m], as in :class:`TrunkLiftEnv`; `distance` is the clearance that is
    missing.

    ## Version history
    * v0: the trunk of TrunkReach-v1 (:class:`TrunkReachEnv`).
    """

    task_type = TrunkGraspTask


class TrunkGraspVectorEnv(SoftRobotVectorEnv):
    """Vector form of :class:`TrunkGraspEnv`."""

    task_type = TrunkGraspTask
