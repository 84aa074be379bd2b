"""What the three trunk tasks share: cable actions, keypoints, goals and the published reward."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.effects.effect import Effect
from soro_bench.effects.elements import instrument
from soro_bench.envs.task import ACTION_MODES, Task, effects_of, refuse_arguments
from soro_bench.files import brief
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo
from soro_bench.models.scene import ContactFriction, ObjectMass
from soro_bench.models.simulation import ParameterMap, Simulation

NUM_KEYPOINTS = len(geo.KEYPOINT_Z)
SUCCESS_DISTANCE = 0.001  # m, published
TIME_PENALTY = 0.05  # per step, published
REACH_LIMIT = 0.3  # m, how far from the clamp a goal may be given


def potential(distance: ArrayLike, xp: Any = np) -> Floats:
    """The published potential P(d) = -0.006 d^2 - 500 ln(d^2 + 0.001) of a distance d [m], which it takes in mm.

    Args:
        distance: of any shape.
        xp: its array library.
    """
    d = 1000.0 * xp.asarray(distance)
    return -0.006 * d**2 - 500.0 * xp.log(d**2 + 0.001)


def given_point(name: str, given: Any, count: int) -> Floats:
    """(count,) coordinates [m] that a reset option gives; ValueError for anything else."""
    try:
        point = np.asarray(given)
    except ValueError:  # rows of different lengths
        point = np.empty(0)
    if point.shape != (count,) or point.dtype.kind not in "fiu" or not (np.abs(point) <= REACH_LIMIT).all():
        raise ValueError(f"{name} {brief(given)} has to be {count} coordinates from -{REACH_LIMIT} to {REACH_LIMIT} m")
    return point.astype(float)


@lru_cache(maxsize=16)
def _compiled(scene: str, model: str, version: int, instrumented: bool) -> mujoco.MjModel:
    spec = trunk.build_spec(scene, model, version)
    return (instrument(spec) if instrumented else spec).compile()


class TrunkTask(Task):
    """N simulations of the cable-driven trunk in one scene.

    Args:
        model: "flex" (accurate) or "cable" (cheap).
        action: "discrete" (16 actions: pull or release one cable by 5 mm) or "continuous" (8 cable rates in units of
            0.1 m/s).
        effects: physics that the model leaves out, or an effects file (docs/reference/effects.md).
    """

    variant_name, accurate, cheap = "model", "flex", "cable"
    version: ClassVar[int] = 0
    metric = "distance"
    options: ClassVar[tuple[str, ...]] = (*Task.options, "goal")
    signal_units: ClassVar = {
        "keypoints": ("m", "world"),
        "link_position": ("m", "world"),
        "link_quaternion": ("1", "world"),
        "tension": ("N", ""),
        "commanded": ("m", ""),
    }
    goal: Floats
    control_timestep = 0.05  # s: five command updates of 10 ms
    inferred_from: ClassVar[tuple[str, ...]] = ("keypoints",)
    moves = np.eye(len(geo.CABLE_NAMES))

    def __init__(
        self,
        num_envs: int = 1,
        num_threads: int = 1,
        model: str = "flex",
        action: str = "discrete",
        effects: Sequence[Effect] | str | Path | None = None,
        simulation: Callable[..., Any] = Simulation,
        **unknown: Any,
    ):
        refuse_arguments(unknown, "model, action and effects")
        if not isinstance(model, str) or model not in trunk.VARIANTS:
            raise ValueError(f"unknown model {model!r}; there are {', '.join(trunk.VARIANTS)}")
        if action not in ACTION_MODES:
            raise ValueError(f"unknown action mode {action!r}; there are {', '.join(ACTION_MODES)}")
        effects = effects_of(effects)
        compiled = _compiled(self.scene, model, self.version, effects is not None)
        maps = [trunk.TrunkParameters(compiled), *self._scene_parameters(compiled)]
        super().__init__(compiled, maps, num_envs, num_threads, effects, simulation)
        self._variant = model
        cables = len(geo.CABLE_NAMES)
        self._discrete = action == "discrete"
        self.single_action_space = (
            spaces.Discrete(2 * cables) if self._discrete else spaces.Box(-1.0, 1.0, (cables,), np.float32)
        )
        self.single_observation_space = spaces.Box(-1.0, 1.0, (self._observation_size(),), np.float64)
        self._keypoints = self.sim.array([compiled.site(f"keypoint{i}").id for i in range(NUM_KEYPOINTS)])
        self._goal_mocap = compiled.body("goal").mocapid[0]
        self.goal = self.sim.array(np.zeros((num_envs, 3)))  # m
        self._initial_distance = self.sim.array(np.ones(num_envs))  # m
        rates = geo.CABLE_RATE * np.eye(cables)  # of the discrete actions: pull each cable, then release each
        self._rates = self.sim.array(np.concat([rates, np.where(rates > 0, -rates, 0.0)]))
        self._links = [compiled.body("base").id, *(compiled.body(f"vertebra{k}").id for k in range(geo.NUM_NECKS))]
        for field in ("site_xpos", "xpos", "xquat", "actuator_length", "actuator_velocity"):
            self.sim.batch.bind(field)

    def spec(self) -> mujoco.MjSpec:
        return trunk.build_spec(self.scene, self._variant, self.version)

    def signals(self, ids: Ints) -> dict[str, Floats]:
        """What a recording of simulations ``ids`` holds; every array has n rows.

        keypoints (n, 21, 3) m; link_position (n, 11, 3) m and link_quaternion (n, 11, 4) w, x, y, z of the base and
        the ten vertebrae; tension (n, 8) N; commanded (n, 8) commanded cable displacements [m].
        """
        batch, links = self.sim.batch, (np.asarray(ids)[:, None], self._links)
        return {
            "keypoints": self.keypoints(ids),
            "link_position": batch.xpos[links],
            "link_quaternion": batch.xquat[links],
            "tension": self._tension(np.asarray(ids)),
            "commanded": batch.act[ids],
        }

    def signal(self, ids: Ints, name: str) -> Floats:
        """One of the signals, an array of n rows; keypoints need none of the others."""
        return self.keypoints(ids) if name == "keypoints" else super().signal(ids, name)

    def _tension(self, ids: Ints) -> Floats:
        """(n, 8) N at the present state (MuJoCo's actuator_force is that of the time step before)."""
        batch = self.sim.batch
        gain, bias, limits = (batch.expand(f"actuator_{name}")[ids] for name in ("gainprm", "biasprm", "forcerange"))
        of_length, of_velocity = bias[..., 1] * batch.actuator_length[ids], bias[..., 2] * batch.actuator_velocity[ids]
        force = gain[..., 0] * batch.act[ids] + bias[..., 0] + of_length + of_velocity
        return np.clip(force, limits[..., 0], limits[..., 1])

    def keypoints(self, ids: Ints) -> Floats:
        """(n, 21, 3) keypoint positions [m], from the clamp to the tip."""
        return self.sim.batch.site_xpos[self.sim.array(ids)[:, None], self._keypoints]

    def tip(self, ids: Ints) -> Floats:
        """(n, 3) tip position [m]: the last keypoint."""
        return self.sim.batch.site_xpos[ids, self._keypoints[-1]]

    def distance(self, ids: Ints) -> Floats:
        """(n,) the distance [m] that the task asks to bring to zero."""
        raise NotImplementedError

    def _scene_parameters(self, model: mujoco.MjModel) -> Sequence[ParameterMap]:
        return ()

    def _observation_size(self) -> int:
        return 3 * NUM_KEYPOINTS + 3

    def _sample_start(self, rng: np.random.Generator, options: Mapping[str, Any]) -> Floats:
        drawn = self._sample_goal(rng)  # also when it is given, so that what is drawn next does not depend on it
        return given_point("goal", options["goal"], 3) if "goal" in options else drawn

    def _sample_goal(self, rng: np.random.Generator) -> Floats:
        raise NotImplementedError

    def _place(self, ids: Ints, starts: Sequence[Floats]) -> None:
        self.goal[ids] = self.sim.array(np.array(starts))
        self.sim.batch.mocap_pos[ids, self._goal_mocap] = self.goal[ids]

    def _begin(self, ids: Ints) -> None:
        self._initial_distance[ids] = self.distance(ids)
        if (solved := self._initial_distance[ids] <= SUCCESS_DISTANCE).any():
            raise ValueError(f"goal {self.goal[ids][solved][0].tolist()} is reached at reset; choose another")

    def _controls(self, actions: NDArray[Any]) -> Floats:
        if self._discrete:
            return self._rates[actions]
        return geo.CABLE_RATE * self.xp.astype(actions, self._rates.dtype)

    def _observe(self, ids: Ints) -> Floats:
        return self.xp.concat([self.keypoints(ids).reshape(len(ids), -1), self.goal[ids]], axis=1)

    def _score(self, ids: Ints) -> tuple[dict[str, Floats], Bools]:
        return self._scored(ids, self.distance(ids))

    def _scored(self, ids: Ints, distance: Floats) -> tuple[dict[str, Floats], Bools]:
        """Reward terms and success at a distance (n,) [m]."""
        initial = potential(self._initial_distance[ids], self.xp)
        terms = {
            "reward_progress": (initial - potential(distance, self.xp)) / initial,
            "reward_time": self.xp.full_like(distance, -TIME_PENALTY),
        }
        return terms, distance <= SUCCESS_DISTANCE

    def _info(self, ids: Ints) -> dict[str, Any]:
        return {**super()._info(ids), "distance": self.distance(ids)}


class Version1(TrunkTask):
    """What version 1 of every trunk task has otherwise: stronger cables, joints with an armature, and no episode that
    is cut for anything but a numerical failure."""

    version = 1
    _FARTHEST = 1.0  # m, a distance that rewards count no more of

    def _lost(self, observation: Floats, inside: Floats) -> Bools:
        robot = 3 * NUM_KEYPOINTS  # an object may leave the space, and is observed at its edge
        finite = self.xp.all(self.xp.isfinite(observation), axis=1)
        return ~finite | super()._lost(observation[:, :robot], inside[:, :robot])

    def _score(self, ids: Ints) -> tuple[dict[str, Floats], Bools]:
        near = self.xp.clip(self.distance(ids), 0.0, self._FARTHEST)
        return self._scored(ids, self.xp.where(self.xp.isnan(near), self._FARTHEST, near))


class ObjectTask(TrunkTask):
    """A trunk task with a floor and a free object, which is observed behind the goal."""

    inferred_from = ("keypoints", "object_position", "object_quaternion")
    signal_units: ClassVar = {
        **TrunkTask.signal_units,
        "object_position": ("m", "world"),
        "object_quaternion": ("1", "world"),
    }

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._object_qpos = self.model.joint("object").qposadr[0]
        self._object_body = self.model.body("object").id

    def signals(self, ids: Ints) -> dict[str, Floats]:
        """As the trunk's, and of the object's centre object_position (n, 3) m, object_quaternion (n, 4) w, x, y, z."""
        pose = self.sim.batch.qpos[ids, self._object_qpos : self._object_qpos + 7]
        return {**super().signals(ids), "object_position": pose[:, :3], "object_quaternion": pose[:, 3:]}

    def object_position(self, ids: Ints) -> Floats:
        """(n, 3) centre of the object [m]."""
        return self.sim.batch.xpos[ids, self._object_body]

    def _object_pose(self, ids: Ints) -> Floats:
        """(n, 7) centre [m] and orientation x, y, z, w of the object."""
        pose = self.sim.batch.qpos[ids, self._object_qpos : self._object_qpos + 7]
        return self.xp.concat([pose[:, :3], pose[:, 4:], pose[:, 3:4]], axis=1)

    def _scene_parameters(self, model: mujoco.MjModel) -> Sequence[ParameterMap]:
        return (ContactFriction(model), ObjectMass(model))

    def _observation_size(self) -> int:
        return super()._observation_size() + 7

    def _observe(self, ids: Ints) -> Floats:
        return self.xp.concat([super()._observe(ids), self._object_pose(ids)], axis=1)
