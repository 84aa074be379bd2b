"""The Gymnasium vector environment: a task with many simulations on a thread pool."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from soro_bench.arrays import Bools, Floats, Ints, on_host
from soro_bench.envs.gymnasium_vector import AutoresetMode, VectorEnv, need_vector_environments
from soro_bench.envs.task import CopiedWithTask, checked_flag, checked_options, shown

if TYPE_CHECKING:  # imported when something is drawn
    from soro_bench.envs.rendering import Camera, Picture


class SoftRobotVectorEnv(CopiedWithTask, VectorEnv[Floats, Any, NDArray[Any]]):
    """``num_envs`` simulations of ``task_type``, bit-identical to as many single environments.

    A copy, by ``copy.deepcopy`` or ``pickle``, goes on with the same bytes. Simulation i of ``reset(seed=s)`` is the
    single environment reset with seed s + i. A reset option may hold one value for all simulations or one per
    simulation.

    Args:
        num_envs: number of simulations.
        max_episode_steps: steps after which an episode is truncated; -1: never. ``gymnasium.make_vec`` gives the
            registered number unless it is told another.
        num_threads: threads, 0 for all processors; results do not depend on it.
        render_mode: None, or "rgb_array" (480 x 640 pixels for each simulation).
        autoreset_mode: Gymnasium's "NextStep" (default), "SameStep" or "Disabled".
        flat_info: whether ``info`` has parameters as param_<name> and no dict of them, for libraries such as TorchRL.
        backend: "mujoco" (default), or "warp" for a GPU, by MuJoCo Warp (docs/how_to/gpu.md). TorchVectorEnv
            (torch_vector.py) is the same without copies to the CPU.
        device: of "warp": "cuda:0" (default), another GPU, or "cpu".
        room: of "warp": contacts of a world on average, "nconmax", and most constraint rows of each, "njmax".
        task_options: what the task takes: model (or mesh), action, effects.
    """

    _renderer: "Camera | None" = None

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int = -1,
        num_threads: int = 0,
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        flat_info: bool = False,
        backend: str = "mujoco",
        device: str | None = None,
        room: Mapping[str, int] | None = None,
        **task_options: Any,
    ):
        need_vector_environments()
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode {render_mode!r}: of vector environments allowed are None and 'rgb_array'")
        self._flat_info = checked_flag("flat_info", flat_info)
        self._task_options = {
            "num_envs": num_envs, "num_threads": num_threads, **_simulation(backend, device, room), **task_options
        }  # fmt: skip
        self.task = self._build_task()
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._added: list[dict[str, Any]] = [{} for _ in range(num_envs)]  # what set_attr has set
        self._max_steps = _limit(max_episode_steps)
        self.autoreset_mode = _mode(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": 1 / self.task.control_timestep,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = self.task.single_observation_space
        self.single_action_space = self.task.single_action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        pairs = [seeding.np_random() for _ in range(num_envs)]  # until reset(seed=...)
        self._rngs, self._seeds = [rng for rng, _ in pairs], [seed for _, seed in pairs]
        space = self.single_observation_space
        self._observation: NDArray[Any] = np.zeros((num_envs, *space.shape), space.dtype)
        self._elapsed = np.zeros(num_envs, int)
        self._done = np.zeros(num_envs, bool)
        self._begun = np.zeros(num_envs, bool)

    @property  # type: ignore[misc]  # which nobody sets
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]  # Gymnasium has one
        """The generators of all environments."""
        return tuple(self._rngs)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]  # Gymnasium has one
        """What they were seeded with."""
        return tuple(self._seeds)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """As Gymnasium's; ``options["reset_mask"]`` (num_envs,) picks the simulations to reset."""
        seeds, options = _seeds_of(seed, self.num_envs), dict(checked_options(options))
        ids = _masked(options.pop("reset_mask", np.ones(self.num_envs, bool)), self.num_envs)
        seeded = {i: seeding.np_random(int(one)) for i in ids if (one := seeds[i]) is not None}  # or none of them
        for i, (rng, used) in seeded.items():
            self._rngs[i], self._seeds[i] = rng, used
        info: dict[str, Any] = {}
        self._restart(ids, [_options_of(options, int(i), self.num_envs) for i in ids], info)
        return self._observation.copy(), info

    def step(self, actions: ArrayLike) -> tuple[Floats, Floats, Bools, Bools, dict[str, Any]]:
        """As Gymnasium's: observations (N, k), rewards (N,), whether episodes ended or were cut (N,), and info."""
        if not self._begun.all():
            waiting = np.flatnonzero(~self._begun).tolist()
            raise gymnasium.error.ResetNeeded(f"environments {waiting} have begun no episode; reset them first")
        actions = self.task.check_actions(actions, self.num_envs)
        if self.autoreset_mode is AutoresetMode.DISABLED and self._done.any():
            raise ValueError(f"environments {np.flatnonzero(self._done).tolist()} are done; reset them first")
        restarting, ids = np.flatnonzero(self._done), np.flatnonzero(~self._done)
        reward = np.zeros(self.num_envs)
        terminated, truncated = np.zeros((2, self.num_envs), bool)
        info: dict[str, Any] = {}
        if len(ids):
            sim = self.task.sim
            step = self.task.step(sim.array(ids), sim.array(actions[ids]))
            self._elapsed[ids] += 1
            self._observation[ids], reward[ids] = sim.on_host(step.observation), sim.on_host(step.reward)
            terminated[ids] = sim.on_host(step.terminated)
            truncated[ids] = sim.on_host(step.diverged) | (self._elapsed[ids] >= self._max_steps)
            _scatter(info, shown(sim.on_host(step.info), self._flat_info), ids, self.num_envs)
        self._restart(restarting, [{}] * len(restarting), info)
        self._done = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._done.any():
            self._restart_at_once(info)
        return self._observation.copy(), reward, terminated, truncated, info

    def _restart_at_once(self, info: dict[str, Any]) -> None:
        """Reset the simulations that are done; what they ended with goes to Gymnasium's ``final_`` keys of ``info``."""
        done = np.flatnonzero(self._done)
        final = _moved_out(info, done)
        if self._done.all():  # then no row is left, and Gymnasium's environments have no such keys
            info.clear()
        _scatter(info, {"final_info": final}, done, self.num_envs)
        # one observation each and None, as Gymnasium has them
        info["final_obs"], info["_final_obs"] = np.full(self.num_envs, None), self._done.copy()
        for i in done:
            info["final_obs"][i] = self._observation[i].copy()
        self._restart(done, [{}] * len(done), info)

    def render(self) -> "tuple[Picture, ...] | None":
        """(480, 640, 3) pixels of every simulation; None, with a warning, without a render_mode."""
        pictures = [self.picture(i) for i in range(self.num_envs if self.render_mode else 1)]
        return tuple(each for each in pictures if each is not None) or None

    def picture(self, row: int) -> "Picture | None":
        """(480, 640, 3) pixels of simulation ``row``; None, with a warning, without a render_mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs render_mode='rgb_array' in gymnasium.make_vec")
            return None
        if self._renderer is None:
            from soro_bench.envs.rendering import Camera

            self._renderer = Camera(self.task.sim)
        return self._renderer.render(row)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """What a method gives in each simulation (:class:`OneOfMany`), or an attribute."""
        found = self.get_attr(name)
        return tuple(each(*args, **kwargs) if callable(each) else each for each in found)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute of each simulation, such as the single spaces; AttributeError names those that there are."""
        return tuple(getattr(each, name) for each in self._simulations())

    def set_attr(self, name: str, values: Any, indices: Sequence[int] | None = None) -> None:
        """Set an attribute of each simulation, or of ``indices``: one value, or a list or tuple with one for each."""
        chosen = range(self.num_envs) if indices is None else indices
        if not isinstance(values, list | tuple):
            values = [values] * len(chosen)
        if len(values) != len(chosen):
            raise ValueError(f"{len(values)} values of {name} for {len(chosen)} environments")
        simulations = self._simulations()
        for i, value in zip(chosen, values, strict=True):
            simulations[i].set_wrapper_attr(name, value)

    def _simulations(self) -> "list[OneOfMany]":
        return [OneOfMany(self, i, added) for i, added in enumerate(self._added)]

    def close_extras(self, **_: Any) -> None:
        """Close what draws, if something does."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _restart(self, ids: Ints, options: Sequence[Mapping[str, Any]], info: dict[str, Any]) -> None:
        """Reset simulations ``ids``; their rows of the observation and of ``info`` become those of the reset."""
        if len(ids) == 0:
            return
        self._begun[ids] = False  # if the task refuses, say a goal that is reached at reset, nothing has begun
        found = self.task.reset(self.task.sim.array(ids), [self._rngs[i] for i in ids], options)
        self._observation[ids], rows = (self.task.sim.on_host(each) for each in found)
        self._elapsed[ids] = 0
        self._done[ids] = False
        self._begun[ids] = True
        _scatter(info, shown(rows, self._flat_info), ids, self.num_envs)


class OneOfMany:
    """Simulation ``row`` of a vector environment, for ``get_attr``, ``set_attr`` and ``call``.

    It has what a single environment has, but for ``reset`` and ``step``, which take all simulations at once.

    Args:
        envs: the vector environment.
        row: number of the simulation.
        added: other attributes, which may be set.
    """

    def __init__(self, envs: SoftRobotVectorEnv, row: int, added: dict[str, Any]):
        self._envs, self._row, self._added = envs, row, added

    @property
    def observation_space(self) -> gymnasium.spaces.Box:
        """Of one simulation."""
        return self._envs.task.single_observation_space

    @property
    def action_space(self) -> gymnasium.spaces.Discrete | gymnasium.spaces.Box:
        """Of one simulation."""
        return self._envs.task.single_action_space

    @property
    def spec(self) -> Any:
        """The vector environment's."""
        return self._envs.spec

    @property
    def metadata(self) -> dict[str, Any]:
        """The vector environment's."""
        return self._envs.metadata

    @property
    def render_mode(self) -> str | None:
        """The vector environment's."""
        return self._envs.render_mode

    @property
    def np_random(self) -> np.random.Generator:
        """The generator of this simulation."""
        return self._envs.np_random[self._row]

    @property
    def np_random_seed(self) -> int:
        """What it was seeded with."""
        return self._envs.np_random_seed[self._row]

    @property
    def unwrapped(self) -> "OneOfMany":
        """Itself."""
        return self

    def render(self) -> "Picture | None":
        """(480, 640, 3) pixels of this simulation; None without a render_mode."""
        return self._envs.picture(self._row)

    def has_wrapper_attr(self, name: str) -> bool:
        """Whether it has an attribute."""
        return hasattr(self, name)

    def get_wrapper_attr(self, name: str) -> Any:
        """An attribute."""
        return getattr(self, name)

    def set_wrapper_attr(self, name: str, value: Any) -> None:
        """Set an attribute; AttributeError for one that every simulation has."""
        if hasattr(type(self), name):
            raise AttributeError(f"{name} cannot be set for one simulation of a vector environment")
        self._added[name] = value

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # a copy has none of its own yet when it is asked how it is to be copied
            raise AttributeError(name)
        if name in self._added:
            return self._added[name]
        names = [*(own for own in dir(type(self)) if not own.startswith("_")), *self._added]
        raise AttributeError(f"one simulation of a vector environment has no {name!r}; it has {', '.join(names)}")


def _simulation(backend: str, device: str | None, room: Mapping[str, int] | None) -> dict[str, Any]:
    """What a task is told of what simulates it."""
    if backend not in ("mujoco", "warp"):
        raise ValueError(f"backend {backend!r}: allowed are 'mujoco' and 'warp'")
    if backend == "mujoco":
        for name, value in (("device", device), ("room", room)):
            if value is not None:
                raise ValueError(f"{name}={value!r} is for backend='warp'; MuJoCo simulates on the CPU")
        return {}
    from soro_bench.models.warp_simulation import WarpSimulation  # which few have installed

    device = "cuda:0" if device is None else device
    return {"simulation": partial(WarpSimulation, device=device, on_nan="truncate", room=room)}


def _mode(autoreset_mode: str | AutoresetMode) -> AutoresetMode:
    """ValueError names the modes, which Gymnasium's does not."""
    try:
        return AutoresetMode(autoreset_mode)
    except ValueError:
        allowed = ", ".join(mode.value for mode in AutoresetMode)
        raise ValueError(f"autoreset_mode {autoreset_mode!r}: allowed are {allowed}") from None


def _limit(max_episode_steps: int) -> float:
    """Steps after which an episode is truncated, as Gymnasium understands them."""
    if max_episode_steps == -1:
        return np.inf
    if not isinstance(max_episode_steps, int | np.integer) or max_episode_steps < 1:
        raise ValueError(f"max_episode_steps {max_episode_steps!r}: an integer of 1 or more, or -1 for none, is needed "
                         "(the registered number holds without the argument)")  # fmt: skip
    return int(max_episode_steps)


def _seeds_of(seed: Any, num_envs: int) -> list[int | None]:
    """The seed of each environment, None for those that go on with their generators; ValueError for what is none."""
    if seed is None:
        return [None] * num_envs
    if isinstance(seed, int | np.integer):
        return [int(seed) + i for i in range(num_envs)]
    seeds = list(seed) if isinstance(seed, Iterable) else [seed]
    if not all(one is None or isinstance(one, int | np.integer) for one in seeds):
        raise ValueError(f"seed {seed!r} has to be an integer, or one for each of {num_envs} environments")
    if len(seeds) != num_envs:
        raise ValueError(f"{len(seeds)} seeds for {num_envs} environments")
    return seeds


def _masked(given: object, num_envs: int) -> Ints:
    """The environments that a reset mask picks; ValueError for what is no mask, or picks none."""
    mask = np.asarray(given)
    if mask.shape != (num_envs,) or mask.dtype != bool or not mask.any():
        raise ValueError(f"reset_mask {mask.tolist()} has to be {num_envs} booleans, one of them true")
    return np.flatnonzero(mask)


def _options_of(options: Mapping[str, Any], i: int, num_envs: int) -> dict[str, Any]:
    """Environment i's options: rows of arrays whose first axis has one entry per environment, else shared values."""

    def pick(value: Any, ndim: int) -> Any:
        try:
            array = np.asarray(on_host(value))
        except ValueError:  # lists of unlike lengths, which the task refuses
            return value
        return array[i] if array.ndim == ndim + 1 and len(array) == num_envs else value

    picked = {name: pick(value, 1) for name, value in options.items()}
    if isinstance(options.get("state"), Mapping):
        picked["state"] = {name: pick(value, 1) for name, value in options["state"].items()}
    if isinstance(options.get("params"), Mapping):
        picked["params"] = {name: pick(value, 0) for name, value in options["params"].items()}
    return picked


def _scatter(info: dict[str, Any], rows: Mapping[str, Any], ids: Ints, num_envs: int) -> None:
    """Write each (len(ids), ...) array of ``rows`` into rows ``ids`` of ``info``, with Gymnasium's _<key> masks."""
    for key, value in rows.items():
        if isinstance(value, Mapping):
            _scatter(info.setdefault(key, {}), value, ids, num_envs)
        else:
            info.setdefault(key, np.zeros((num_envs, *value.shape[1:]), value.dtype))[ids] = value
        info.setdefault(f"_{key}", np.zeros(num_envs, bool))[ids] = True


def _moved_out(info: Mapping[str, Any], ids: Ints) -> dict[str, Any]:
    """Rows ``ids`` of every array of ``info``, which then has zeros there, and masks that no longer count them."""
    taken = {}
    for key, value in info.items():
        if isinstance(value, Mapping):
            taken[key] = _moved_out(value, ids)
            continue
        if not key.startswith("_"):
            taken[key] = value[ids]
        value[ids] = 0
    return taken
