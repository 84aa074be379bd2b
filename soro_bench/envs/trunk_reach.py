"""TrunkReach: bring the tip to a goal."""

import itertools

import numpy as np

from soro_bench.arrays import Floats, Ints
from soro_bench.envs.single import SoftRobotEnv
from soro_bench.envs.trunk import TrunkTask, Version1
from soro_bench.envs.vector import SoftRobotVectorEnv
from soro_bench.models import trunk
from soro_bench.parameters import POISSON_RATIO, TRUNK_MASS, YOUNG_MODULUS, ParameterSet

GOAL_LOW = np.array([-0.030, -0.050, 0.115])  # m, training goals are uniform in this box (published)
GOAL_HIGH = np.array([0.030, 0.020, 0.150])
# (27, 3) m, in the published order: x outermost, z innermost
EVALUATION_GOALS = np.array(
    list(itertools.product((-0.020, 0.0, 0.020), (0.005, -0.015, -0.035), (0.120, 0.1325, 0.145)))
)


class TrunkReachTask(TrunkTask):
    """N simulations of TrunkReach."""

    scene = "trunk.xml"
    parameters = ParameterSet(*trunk.PARAMETERS)
    randomized = (TRUNK_MASS, POISSON_RATIO, YOUNG_MODULUS)
    evaluation = tuple({"goal": goal} for goal in EVALUATION_GOALS)

    def distance(self, ids: Ints) -> Floats:
        return self.xp.linalg.vector_norm(self.tip(ids) - self.goal[ids], axis=1)

    def _sample_goal(self, rng: np.random.Generator) -> Floats:
        return rng.uniform(GOAL_LOW, GOAL_HIGH)


class TrunkReachV1Task(Version1, TrunkReachTask):
    """N simulations of TrunkReach-v1."""


class TrunkReachEnv(SoftRobotEnv):
    """Bring the tip of a cable-driven soft trunk to a goal.

    ## Description
    A 195 mm soft trunk is clamped horizontally along z; gravity acts along -y. Eight cables pull it: four run to the
    tip, four end half-way. The task is the first of Tiboni et al., "Domain Randomization for Robust, Affordable and
    Effective Closed-loop Control of Soft Robots", IROS 2023. There is no contact. Frame: z along the undeformed trunk,
    y up, origin in the clamp.

    ## Actions
    `action="discrete"` (published): `Discrete(16)`; a < 8 pulls cable a by 5 mm, a >= 8 releases cable a - 8 by 5 mm,
    at a steady 0.1 m/s over the step. `action="continuous"`: `Box(-1, 1, (8,))`, the rate of every cable in units of
    0.1 m/s. Cables 0-3 (long) and 4-7 (short) lie at +y, -x, -y, +x. Commanded displacements accumulate within
    +-70 mm (long) and +-40 mm (short); a cable that is released further than it is stretched goes slack.

    ## Observations
    `Box(-1, 1, (66,))`, float64, metres:

    | index | what |
    |---|---|
    | 0-62 | x, y, z of 21 keypoints on the axis, clamp to tip |
    | 63-65 | x, y, z of the goal |

    ## Rewards
    `reward_progress = (P(d0) - P(d)) / P(d0)` with P(d) = -0.006 d^2 - 500 ln(d^2 + 0.001), d the distance from tip to
    goal in mm and d0 that at reset; `reward_time = -0.05`.

    ## Episode
    Starts straight and at rest. The goal is uniform in x +-30, y -50..20, z 115..150 mm. Terminates (`is_success`) at
    d <= 1 mm; truncated after 100 steps of 0.05 s.

    ## Arguments
    `model`: "flex" (accurate, default) or "cable" (cheap). `action`: see above. `render_mode`: "human", "rgb_array".
    `effects`: physics that the model leaves out, a list of `Effect` or an effects file (docs/reference/effects.md).
    `reset(options=...)`: `goal` (3,) in metres and `params`, a dict of trunk_mass, poisson_ratio, young_modulus,
    damping, cable_stiffness in SI units.

    `info`: `params`, `distance` [m], `is_success`, `diverged`, `reward_progress`, `reward_time`.

    ## Version history
    * v1: cables pull with up to 50 N (30 N in v0), which they hardly reach. Every joint has an armature, so that light
      and soft trunks stay stable. An episode is cut for numerical failures only; rewards count at most 1 m of distance.
    * v0: after the paper. Where the published code differs, the paper holds: five cable updates per action (the code
      makes six at some steps) and d0 taken at reset (the code takes it after the first step, whose reward is then 0).
      Commands are clamped to the cables' limits (the code lets them wind up without limit).
      `TrunkReachContinuous-v0` is v0 with `action="continuous"`, for programs that know ids only.
    """

    task_type = TrunkReachTask


class TrunkReachVectorEnv(SoftRobotVectorEnv):
    """Vector form of :class:`TrunkReachEnv`."""

    task_type = TrunkReachTask


class TrunkReachV1Env(SoftRobotEnv):
    """Version 1 of :class:`TrunkReachEnv`; its version history says what differs."""

    task_type = TrunkReachV1Task


class TrunkReachV1VectorEnv(SoftRobotVectorEnv):
    """Vector form of :class:`TrunkReachV1Env`."""

    task_type = TrunkReachV1Task
