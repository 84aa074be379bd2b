"""TrunkPush: push a cube to a place on the floor."""

import numpy as np

from soro_bench.arrays import Floats, Ints
from soro_bench.envs.single import SoftRobotEnv
from soro_bench.envs.trunk import ObjectTask
from soro_bench.envs.vector import SoftRobotVectorEnv
from soro_bench.models import trunk
from soro_bench.parameters import CUBE_MASS, FRICTION, POISSON_RATIO, TRUNK_MASS, YOUNG_MODULUS, ParameterSet

GOAL = np.array([0.100, -0.100, 0.050])  # m, published; only x and z matter


class TrunkPushTask(ObjectTask):
    """N simulations of TrunkPush."""

    scene = "push.xml"
    parameters = ParameterSet(CUBE_MASS, FRICTION, *trunk.PARAMETERS)
    randomized = (CUBE_MASS, FRICTION, TRUNK_MASS, POISSON_RATIO, YOUNG_MODULUS)

    def distance(self, ids: Ints) -> Floats:
        return self.xp.linalg.vector_norm((self.object_position(ids) - self.goal[ids])[:, ::2], axis=1)

    def _sample_goal(self, rng: np.random.Generator) -> Floats:
        return GOAL


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
    * v0: after the paper, see :class:`TrunkReachEnv`. The cube has the inertia of a solid cube; the published code
      leaves it at a default of about 1/200 of that. The floor is unbounded, the published one ends 0.3 m out.
      `TrunkPushContinuous-v0` is v0 with `action="continuous"`, for programs that know ids only.
    """

    task_type = TrunkPushTask


class TrunkPushVectorEnv(SoftRobotVectorEnv):
    """Vector form of :class:`TrunkPushEnv`."""

    task_type = TrunkPushTask
