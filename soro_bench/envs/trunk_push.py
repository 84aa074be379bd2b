"""TrunkPush: push a cube to a place on the floor."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from soro_bench.arrays import Floats, Ints
from soro_bench.envs.single import SoftRobotEnv
from soro_bench.envs.trunk import ObjectTask, Version1, given_point
from soro_bench.envs.vector import SoftRobotVectorEnv
from soro_bench.models import trunk
from soro_bench.parameters import CUBE_MASS, FRICTION, POISSON_RATIO, TRUNK_MASS, YOUNG_MODULUS, ParameterSet

GOAL = np.array([0.100, -0.100, 0.050])  # m, published; only x and z matter
# of version 1, m: training goals are on the published way of the cube or its mirror image, this share of it away
CENTRE, GOAL_SHARES = 0.100, (0.6, 1.0)  # z of the cube's published place, and the share
PLACE_LOW, PLACE_HIGH = np.array([-0.020, 0.090]), np.array([0.020, 0.110])  # x and z of the cube
EVALUATION_GOALS = GOAL * [[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]]
EVALUATION_PLACES = np.array([[0.0, CENTRE], PLACE_LOW, PLACE_HIGH])


class TrunkPushTask(ObjectTask):
    """N simulations of TrunkPush."""

    scene = "push.xml"
    parameters = ParameterSet(CUBE_MASS, FRICTION, *trunk.PARAMETERS)
    randomized = (CUBE_MASS, FRICTION, TRUNK_MASS, POISSON_RATIO, YOUNG_MODULUS)

    def distance(self, ids: Ints) -> Floats:
        return self.xp.linalg.vector_norm((self.object_position(ids) - self.goal[ids])[:, ::2], axis=1)

    def _sample_goal(self, rng: np.random.Generator) -> Floats:
        return GOAL


class TrunkPushV1Task(Version1, TrunkPushTask):
    """N simulations of TrunkPush-v1; a start is the goal and the cube's place, x and z."""

    options = (*TrunkPushTask.options, "object")
    evaluation = tuple(
        {"goal": goal, "object": place} for goal, place in itertools.product(EVALUATION_GOALS, EVALUATION_PLACES)
    )

    def _sample_start(self, rng: np.random.Generator, options: Mapping[str, Any]) -> Floats:
        goal, place = super()._sample_start(rng, options), rng.uniform(PLACE_LOW, PLACE_HIGH)
        return np.concatenate([goal, given_point("object", options["object"], 2) if "object" in options else place])

    def _sample_goal(self, rng: np.random.Generator) -> Floats:
        side, share = rng.choice([-1.0, 1.0]), rng.uniform(*GOAL_SHARES)
        return np.array([side * share * GOAL[0], GOAL[1], share * GOAL[2] + (1.0 - share) * CENTRE])

    def _place(self, ids: Ints, starts: Sequence[Floats]) -> None:
        super()._place(ids, [start[:3] for start in starts])
        self.put(ids, self.sim.array(np.array([start[3:] for start in starts])))

    def put(self, ids: Ints, places: Floats) -> None:
        """Put the cubes of simulations ``ids`` at places (n, 2), x and z [m]."""
        self.sim.batch.qpos[ids, self._object_qpos] = places[:, 0]
        self.sim.batch.qpos[ids, self._object_qpos + 2] = places[:, 1]


class TrunkPushEnv(SoftRobotEnv):
    """Push a cube over the floor with a cable-driven soft trunk.

    ## Description
    The trunk of :class:`TrunkReachEnv` above a floor; a 35 mm cube (0.05 kg) is dropped from y = -60 mm below it and is
    to be pushed to a goal. Second task of Tiboni et al., IROS 2023. Surfaces keep 5 mm apart, as in the reference.

    ## Actions
    As in :class:`TrunkReachEnv`.

    ## Observations
    `Box(-1, 1, (73,))`, float64, metres:

    | index | what |
    |---|---|
    | 0-62 | x, y, z of 21 keypoints on the axis, clamp to tip |
    | 63-65 | x, y, z of the goal |
    | 66-68 | x, y, z of the cube's centre |
    | 69-72 | x, y, z, w of the cube's orientation (unit quaternion) |

    ## Rewards
    As in :class:`TrunkReachEnv`, with d the distance from the cube's centre to the goal in the x-z plane.

    ## Episode
    Starts straight and at rest with the cube at (0, -60, 100) mm; goal (100, -100, 50) mm. Terminates (`is_success`) at
    d <= 1 mm; truncated after 100 steps of 0.05 s.

    ## Arguments
    As in :class:`TrunkReachEnv`; `params` also takes cube_mass and friction.

    ## Version history
    * v1: as of :class:`TrunkReachEnv`. The cube begins anywhere within x +-20, z 90..110 mm, and goals lie on either
      side, at 0.6 to 1 of the way to the published one. `reset(options=...)` also takes `object`, x and z of the cube's
      centre. Six fixed episodes: three places, two goals.
    * v0: after the paper, see :class:`TrunkReachEnv`. The cube has the inertia of a solid cube; the published code
      leaves it at a default of about 1/200 of that. The floor is unbounded, the published one ends 0.3 m out.
      `TrunkPushContinuous-v0` is v0 with `action="continuous"`, for programs that know ids only.
    """

    task_type = TrunkPushTask


class TrunkPushVectorEnv(SoftRobotVectorEnv):
    """Vector form of :class:`TrunkPushEnv`."""

    task_type = TrunkPushTask


class TrunkPushV1Env(SoftRobotEnv):
    """Version 1 of :class:`TrunkPushEnv`; its version history says what differs."""

    task_type = TrunkPushV1Task


class TrunkPushV1VectorEnv(SoftRobotVectorEnv):
    """Vector form of :class:`TrunkPushV1Env`."""

    task_type = TrunkPushV1Task
