"""MultiGait: walk forward by inflating chambers."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.effects.effect import Effect
from soro_bench.envs.single import SoftRobotEnv
from soro_bench.envs.task import ACTION_MODES, Task, checked_flag, effects_of, refuse_arguments
from soro_bench.envs.vector import SoftRobotVectorEnv
from soro_bench.models import walker
from soro_bench.models.simulation import Simulation
from soro_bench.models.walker_mesh import CHAMBERS, RESOLUTIONS
from soro_bench.parameters import ParameterSet
from soro_bench.randomization import TruncatedNormal

SCENE = "multigait.xml"
GROUPS = np.array([[1, 0, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, 0, 1, 1]])  # chambers moved together: centre, rear, front
INFLATION_PER_ACTION = 60 / 74  # published: 60 updates of 1/74 of the maximum
RAMP_SUBSTEPS = 2  # time steps between updates of the rest lengths
# Published noise: 0.5 mm, and 100 units of chambers that hold 3500 (centre) and 2000 (legs)
POSITION_NOISE = 0.0005  # m
INFLATION_NOISE = np.array([100 / 3500, *[100 / 2000] * 4])
# What the paper trains on: sigmas in the order of walker.PARAMETERS (kg, 1, Pa, 1, Pa), truncated at two of them
PUBLISHED_RANDOMIZATION = TruncatedNormal(
    tuple(p.name for p in walker.PARAMETERS),
    np.array([p.nominal for p in walker.PARAMETERS]),
    np.array([0.005, 0.005, 5e5, 0.01, 1e4]),
)


@lru_cache(maxsize=3)
def _compiled(mesh: str) -> mujoco.MjModel:
    return walker.build_spec(SCENE, mesh).compile()


@lru_cache(maxsize=3)
def _parameter_map(mesh: str) -> walker.WalkerParameters:
    return walker.WalkerParameters(_compiled(mesh), SCENE, mesh)


class MultiGaitTask(Task):
    """N simulations of MultiGait.

    Args:
        mesh: "fine" (accurate), "coarse" (cheap) or "finest".
        action: "discrete" (6 actions) or "continuous" (changes of 3 inflations).
        observation_noise: whether observations are noisy.
        effects: physics that the model leaves out, or an effects file (docs/reference/effects.md).
    """

    scene = SCENE
    variant_name, accurate, cheap = "mesh", "fine", "coarse"
    metric = "displacement"
    parameters = ParameterSet(*walker.PARAMETERS)
    randomized = walker.PARAMETERS
    signal_units: ClassVar = {"vertices": ("m", "world"), "inflation": ("1", "")}
    control_timestep = 0.6  # s
    inferred_from = ("vertices",)
    moves = GROUPS

    def __init__(
        self,
        num_envs: int = 1,
        num_threads: int = 1,
        mesh: str = "fine",
        action: str = "discrete",
        observation_noise: bool = False,
        effects: Sequence[Effect] | str | Path | None = None,
        simulation: Callable[..., Any] = Simulation,
        **unknown: Any,
    ):
        refuse_arguments(unknown, "mesh, action, observation_noise and effects")
        if not isinstance(mesh, str) or mesh not in RESOLUTIONS:
            raise ValueError(f"unknown mesh {mesh!r}; there are {', '.join(RESOLUTIONS)}")
        if action not in ACTION_MODES:
            raise ValueError(f"unknown action mode {action!r}; there are {', '.join(ACTION_MODES)}")
        self._noise = checked_flag("observation_noise", observation_noise)
        # its joints are sliders of mesh nodes, which have no springs: nothing to instrument
        model = _compiled(mesh)
        super().__init__(model, [_parameter_map(mesh)], num_envs, num_threads, effects_of(effects), simulation)
        self._mesh = mesh
        self._discrete = action == "discrete"
        self.single_action_space = spaces.Discrete(6) if self._discrete else spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.single_observation_space = spaces.Box(-1.0, 2.0, (3 + len(CHAMBERS),), np.float64)
        self._inflation = walker.Inflation(model, mesh, array=self.sim.array)
        self._share = self.sim.array(model.body_mass[1:] / model.body_mass[1:].sum())
        self._groups = self.sim.array(GROUPS.astype(float))
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._start, self._last = self.sim.array(np.zeros((2, num_envs)))  # m, x of the centre of mass
        self.sim.batch.bind("xpos")

    def spec(self) -> mujoco.MjSpec:
        return walker.build_spec(self.scene, self._mesh)

    def signals(self, ids: Ints) -> dict[str, Floats]:
        """vertices (n, V, 3) m, the mesh's nodes; inflation (n, 5) from 0 to 1."""
        return {"vertices": self.sim.batch.xpos[ids, 1:], "inflation": self.inflation(ids)}

    def center_of_mass(self, ids: Ints) -> Floats:
        """(n, 3) centre of mass [m]."""
        vertices = self.sim.batch.xpos[ids, 1:]
        if not isinstance(vertices, np.ndarray):
            return self._share @ vertices
        # one row at a time, so that a result does not depend on how many are asked for at once
        return np.stack([self._share @ each for each in vertices])

    def inflation(self, ids: Ints) -> Floats:
        """(n, 5) inflation of the chambers, 0 to 1, in the order of CHAMBERS."""
        return self.sim.batch.act[ids]

    def _sample_start(self, rng: np.random.Generator, options: Mapping[str, Any]) -> np.random.Generator:
        return rng

    def _place(self, ids: Ints, starts: Sequence[np.random.Generator]) -> None:
        for i, rng in zip(ids, starts, strict=True):
            self._rngs[i] = rng
        self.sim.expect(ids, mujoco.mjtWarning.mjWARN_INERTIA)  # in every step, by the cap on walker.ITERATIONS

    def _begin(self, ids: Ints) -> None:
        self._start[ids] = self._last[ids] = self.center_of_mass(ids)[:, 0]

    def _controls(self, actions: NDArray[Any]) -> Floats:
        limit = INFLATION_PER_ACTION / self.control_timestep  # 1/s
        if self._discrete:
            rate = self.xp.where(actions < 3, limit, -limit)
            return rate[:, None] * self._groups[actions % 3]
        return self.xp.astype(actions, self._groups.dtype) @ self._groups * limit

    def _advance(self, ids: Ints) -> None:
        batch, left = self.sim.batch, self._substeps
        while left:
            count = min(RAMP_SUBSTEPS, left)
            left -= count
            batch.plastic[ids[:, None], self._inflation.columns] = self._inflation.plastic(batch.act[ids])
            self.sim.step(ids, count, mujoco.mjtStage.mjSTAGE_NONE if left else mujoco.mjtStage.mjSTAGE_VEL)

    def _observe(self, ids: Ints) -> Floats:
        observation = self.xp.concat([self.center_of_mass(ids), self.inflation(ids)], axis=1)
        if self._noise:
            scale = np.concatenate([np.full(3, POSITION_NOISE), INFLATION_NOISE])
            observation += self.sim.array(scale * np.stack([self._rngs[i].standard_normal(len(scale)) for i in ids]))
        return observation

    def _score(self, ids: Ints) -> tuple[dict[str, Floats], Bools]:
        x = self.center_of_mass(ids)[:, 0]
        forward = 1e3 * (x - self._last[ids])  # mm
        self._last[ids] = x
        return {"reward_forward": forward}, self.xp.zeros_like(forward, dtype=self.xp.bool)

    def _info(self, ids: Ints) -> dict[str, Any]:
        return {**super()._info(ids), "displacement": self.center_of_mass(ids)[:, 0] - self._start[ids]}


class MultiGaitEnv(SoftRobotEnv):
    """Walk forward with a pneumatic soft quadruped.

    ## Description
    An X-shaped slab of soft silicone (EcoFlex), 136 x 59 x 6 mm and 35 g, with a stiff membrane (PDMS) on its lower
    face lies on a floor. Five chambers in it, one in the centre and one in each leg, inflate; as the membrane does not
    stretch, an inflated leg curls down and an inflated centre arches up. After the walker of Tiboni et al., "Domain
    Randomization for Robust, Affordable and Effective Closed-loop Control of Soft Robots", IROS 2023. Frame: x forward,
    z up, origin at the lower face of the flat body, below its centre.

    ## Actions
    `action="discrete"` (published): `Discrete(6)`; 0, 1, 2 inflate the centre, both rear legs, both front legs by 60/74
    of the maximum, at a steady rate over the step; 3, 4, 5 deflate them. Inflations stay within 0 and 1.
    `action="continuous"`: `Box(-1, 1, (3,))`, the change of inflation of centre, rear legs and front legs in units of
    60/74 a step.

    ## Observations
    `Box(-1, 2, (8,))`, float64: the centre of mass x, y, z [m], and the inflation, 0 to 1, of centre, rear left, rear
    right, front left, front right. With `observation_noise=True` normal noise is added, of 0.5 mm and of 100 published
    units, which are 1/35 (centre) and 1/20 (legs).

    ## Rewards
    `reward_forward`: how far the centre of mass moved along x in the step [mm].

    ## Episode
    Starts flat, at rest and deflated. Never terminates; truncated after 6 steps of 0.6 s
    (`gymnasium.make(..., max_episode_steps=12)` for the longer published variant). `info["displacement"]` is the way
    along x since the reset [m], the published metric.

    ## Arguments
    * `mesh`: "coarse" (110 nodes, to train on), "fine" (340, the default, to evaluate on), "finest" (708).
    * `action`: "discrete" or "continuous".
    * `observation_noise`: False or True.
    * `effects`: physics that the model leaves out, a list of `Effect` or an effects file (docs/reference/effects.md).
    * `reset(options={"params": {...}})` takes robot_mass, pdms_poisson_ratio, pdms_young_modulus,
      ecoflex_poisson_ratio, ecoflex_young_modulus.

    ## Version history
    * v0: after the paper. Steps of 0.6 s, as in SofaGym's multigaitrobot-v0; the paper's take 3 s
      (docs/archive/tasks_and_models.md). The published reward is clipped at zero, which also pays for rocking to and
      fro; this one is not. The published observation averages points of the chambers; this is the centre of mass.
      `MultiGaitContinuous-v0` is v0 with `action="continuous"`, for programs that know ids only.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # see SoftRobotEnv
        **SoftRobotEnv.metadata,
        "render_fps": 1 / MultiGaitTask.control_timestep,
    }
    task_type = MultiGaitTask


class MultiGaitVectorEnv(SoftRobotVectorEnv):
    """Vector form of :class:`MultiGaitEnv`."""

    task_type = MultiGaitTask
