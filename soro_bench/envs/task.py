"""A task: N simulations of one robot in one scene, with actions, observations and rewards as arrays.

The single environment (single.py) is a task with N = 1 and the vector environment (vector.py) a task with N
simulations, so there is one code path for both.
"""

import copy
import functools
import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar, Self

import mujoco
import numpy as np
from gymnasium import logger, spaces
from numpy.typing import ArrayLike, NDArray

from soro_bench.arrays import Bools, Floats, Ints, on_host
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.effect import Effect, effect_from, load_effects
from soro_bench.files import brief
from soro_bench.models.simulation import ParameterMap, Simulation
from soro_bench.parameters import Parameter, ParameterSet
from soro_bench.randomization import Distribution

ACTION_MODES = ("discrete", "continuous")
# How far beyond its bounds, as a share of them, a number of an action is taken for one at the bound: some roundings of
# a float32, as gymnasium.wrappers.RescaleAction makes them
ROUNDING = 1e-6
_REBUILT = ("sim", "model")  # what a task has that cannot be copied
_NOT_COPIED = ("task", "_renderer")  # what an environment has: simulations, and a window or an OpenGL context
STATE = ("qpos", "qvel", "act", "qacc_warmstart")  # what a simulation goes on from; MuJoCo's names
EFFECTS = "effects"  # beside these, what effects remember


def effects_of(effects: Sequence[Effect | dict] | str | Path | None) -> tuple[Effect, ...] | None:
    """Effects, perhaps given in their JSON form, or those of an effects file.

    With a warning, those of a file that are faults of a measurement are left out: nothing is measured here.
    """
    if effects is None:
        return None
    if not isinstance(effects, str | Path):
        return _checked_effects(effects)
    found = load_effects(effects, ALL)
    physics = tuple(effect for effect in found if effect.location.kind != "sensor")
    if faults := ", ".join(effect.name for effect in found if effect not in physics):
        logger.warn(f"{effects} has faults of measurement, which do nothing here: {faults}")
    return physics


def _checked_effects(effects: object) -> tuple[Effect, ...]:
    if not isinstance(effects, Sequence) or not all(isinstance(effect, Effect | dict) for effect in effects):
        raise ValueError(f"effects {effects!r}: a list of Effect, or an effects file, is needed")
    return tuple(effect if isinstance(effect, Effect) else effect_from(effect, ALL) for effect in effects)


def checked_options(options: Mapping[str, Any] | None) -> Mapping[str, Any]:
    """Reset options, none of them for None; ValueError for anything but a dict."""
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"reset options {options!r}: a dict is needed")
    return options or {}


def checked_flag(name: str, value: object) -> bool:
    """True or False; ValueError for anything else."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} = {value!r}; True or False is needed")
    return bool(value)


def refuse_arguments(unknown: Mapping[str, object], known: str) -> None:
    """TypeError for arguments that an environment does not take, in Python's words, for which libraries look."""
    for name, value in unknown.items():
        raise TypeError(f"{name}={value!r}: unexpected keyword argument {name!r}; this environment takes {known}")


def shown(info: Mapping[str, Any], flat: bool) -> Mapping[str, Any]:
    """An info dict; a flat one has the parameters as param_<name> beside the other entries."""
    if not flat:
        return info
    rest = {key: value for key, value in info.items() if key != "params"}
    return {**{f"param_{name}": value for name, value in info["params"].items()}, **rest}


@dataclass
class Step:
    """What one step of the simulations ``ids`` gave; every array has len(ids) rows."""

    observation: Floats
    reward: Floats
    terminated: Bools
    diverged: Bools
    info: dict[str, Any]  # a nested dict of arrays for "params"


class Task(ABC):
    """N simulations of one task.

    Subclasses set the attributes and implement the hooks below; they read the state from ``self.sim.batch``.
    """

    variant_name: ClassVar[str]  # the argument that picks how accurate the robot's model is
    accurate: ClassVar[str]  # its default value, to evaluate on
    cheap: ClassVar[str]  # another, to train on
    metric: ClassVar[str]  # the entry of ``info`` [m] that the published study reports at the end of an episode
    goal: Floats | None = None  # (N, 3) m, where to bring things, if the task has such a place
    scene: ClassVar[str]  # MJCF file of assets/mjcf
    parameters: ClassVar[ParameterSet]
    randomized: ClassVar[tuple[Parameter, ...]]  # what the published study of the task randomises
    evaluation: ClassVar[tuple[Mapping[str, Any], ...]] = ({},)  # reset options of the fixed evaluation episodes
    options: ClassVar[tuple[str, ...]] = ("params", "state")
    signal_units: ClassVar[Mapping[str, tuple[str, str]]]  # SI unit and frame ("" if none) of each of signals()
    control_timestep: ClassVar[float]  # s
    inferred_from: ClassVar[tuple[str, ...]]  # the signals that parameters are inferred from: what is observed
    moves: ClassVar[np.ndarray]  # (A, nu) 1 where a number of a continuous action moves an actuator, else 0
    single_observation_space: spaces.Box  # with the same bounds for all numbers
    single_action_space: spaces.Discrete | spaces.Box

    def __init__(
        self,
        model: mujoco.MjModel,
        maps: Sequence[ParameterMap],
        num_envs: int,
        num_threads: int,
        effects: Sequence[Effect] | None = None,
        simulation: type[Simulation] | Callable[..., Any] = Simulation,
    ):
        for name, value, least in (("num_envs", num_envs, 1), ("num_threads", num_threads, 0)):
            if not isinstance(value, int | np.integer) or value < least:
                raise ValueError(f"{name} = {value!r}; an integer of {least} or more is needed")
        self.num_envs = num_envs
        self.model = model
        self.effects = effects
        self.sim: Simulation = simulation(model, self.parameters, maps, num_envs, num_threads, effects)
        self._distribution: Distribution | None = None
        self._substeps = round(self.control_timestep / model.opt.timestep)

    def reset(
        self, ids: Ints, rngs: Sequence[np.random.Generator], options: Sequence[Mapping[str, Any]]
    ) -> tuple[Floats, dict[str, Any]]:
        """Start new episodes in simulations ``ids``.

        Args:
            ids: (n,) which simulations.
            rngs: one generator per simulation of ``ids``.
            options: one mapping per simulation of ``ids``: "params" overrides what the distribution draws; "state", one
                row of what ``state`` gave, is where the episode begins; a task may take more.

        Returns:
            (n, k) observations and a dict of (n,) info arrays.
        """
        self.begin(ids, *self.draw(rngs, options), self.states(options))
        return self.observe(ids), self._info(ids)

    def draw(
        self, rngs: Sequence[np.random.Generator], options: Sequence[Mapping[str, Any]]
    ) -> tuple[list[Any], Floats]:
        """What n new episodes start from, and their parameters (n, d); arguments as those of ``reset``."""
        checked = [self._checked_options(option) for option in options]
        starts = [self._sample_start(rng, option) for rng, option in zip(rngs, checked, strict=True)]
        return starts, np.array([self._sample_params(rng, option) for rng, option in zip(rngs, checked, strict=True)])

    def begin(
        self, ids: Ints, starts: Sequence[Any], params: Floats, states: Sequence[Mapping[str, Floats] | None] = ()
    ) -> None:
        """Begin episodes in simulations ``ids`` with what ``draw`` gave, and with ``states`` where there are any."""
        self.sim.set_params(ids, params)
        self.sim.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._place(ids, starts)
        self.sim.begin(ids)
        given = [(int(i), state) for i, state in zip(ids, states, strict=False) if state is not None]
        for names in dict.fromkeys(tuple(state) for _, state in given):  # with what effects remember, and without
            chosen, alike = zip(*((i, state) for i, state in given if tuple(state) == names), strict=True)
            rows = {name: self.sim.array(np.stack([state[name] for state in alike])) for name in names}
            self.set_state(self.sim.array(chosen), rows)
        self._begin(ids)

    def step(self, ids: Ints, actions: NDArray[Any]) -> Step:
        """Apply one checked action to each simulation of ``ids`` for ``control_timestep``."""
        observation, diverged = self.hold(ids, actions)
        reward_terms, success = self._score(ids)
        info = {**self._info(ids), **reward_terms, "is_success": success, "diverged": diverged}
        reward = functools.reduce(operator.add, reward_terms.values())
        return Step(observation, reward, success, diverged, info)

    def hold(self, ids: Ints, actions: NDArray[Any]) -> tuple[Floats, Bools]:
        """The same without rewards: (n, k) observations, and (n,) whether the simulations have diverged."""
        batch = self.sim.batch
        batch.ctrl[ids] = self._controls(actions)
        self._advance(ids)
        diverged = self.sim.bad_states(ids)
        observation = self._observe(ids)
        inside = self._clipped(observation)
        return inside, diverged | self._lost(observation, inside)

    def observe(self, ids: Ints) -> Floats:
        """(n, k) observations, clipped to the space."""
        return self._clipped(self._observe(ids))

    def _clipped(self, observation: Floats) -> Floats:
        space = self.single_observation_space
        return self.xp.clip(observation, float(space.low.min()), float(space.high.max()))

    @property
    def xp(self) -> Any:
        """The array library of the state: NumPy, or PyTorch on a GPU."""
        return self.sim.xp

    @property
    def distribution(self) -> Distribution | None:
        """What the parameters of every episode are drawn from; None: they are nominal."""
        return self._distribution

    def randomize(self, distribution: Distribution | None) -> None:
        """Draw the parameters of every episode from ``distribution`` from the next reset on; None: nominal ones."""
        if distribution is None:
            self._distribution = None
            return
        if not hasattr(distribution, "names") or not hasattr(distribution, "sample"):
            raise ValueError(f"{distribution!r} is no distribution, such as soro_bench.randomization.Uniform")
        self.parameters.check_names(distribution.names)
        self._distribution = distribution

    def state(self, ids: Ints) -> dict[str, Floats]:
        """What simulations go on from, bit for bit: arrays of n rows by MuJoCo's name, and "effects" where there are
        some, which say what they remember."""
        for name in STATE:
            self.sim.batch.bind(name)
        found = {name: getattr(self.sim.batch, name)[ids] for name in STATE}
        return found if (memory := self.sim.remembered(ids)) is None else {**found, EFFECTS: memory}

    def set_state(self, ids: Ints, state: Mapping[str, Floats]) -> None:
        """Continue simulations ``ids`` from a state; parameters, goals and what rewards count from stay. Where it does
        not say what effects remember, as that of a robot without some, they begin anew."""
        for name in STATE:
            self.sim.batch.bind(name)
            getattr(self.sim.batch, name)[ids] = state[name]
        self.sim.begin(ids)
        if EFFECTS in state:
            self.sim.go_on(ids, state[EFFECTS])

    def saved(self) -> dict[str, Any]:
        """Everything that this task has and one that is just built has not: what a copy resumes from."""
        own = {name: value for name, value in vars(self).items() if name not in _REBUILT}
        return {"own": own, "sim": self.sim.saved()}

    def resume(self, saved: Mapping[str, Any]) -> None:
        """Go on as the task that saved this, which was built with the same arguments, to the last bit."""
        vars(self).update(saved["own"])
        self.sim.resume(saved["sim"])

    def refine(self, factor: int | Fraction) -> None:
        """Simulate with time steps that are shorter by a factor; effects, which know the time step, come after this."""
        if not self.sim.native:
            raise RuntimeError("shorten the time steps before there are effects, whose laws know them")
        substeps = Fraction(self._substeps) * factor
        if substeps.denominator != 1:
            raise ValueError(f"{self._substeps} time steps of a control step cannot become {float(substeps):g}")
        self.sim.batch.expand("opt.timestep")[...] /= float(factor)
        self._substeps = int(substeps)

    def check_actions(self, actions: ArrayLike, count: int) -> NDArray[Any]:
        """Return ``actions`` as an array of ``count`` valid actions, those that a rounding took beyond the bounds at
        the bounds; raise ValueError otherwise."""
        space = self.single_action_space
        actions = np.asarray(actions)
        low: Any
        high: Any
        if actions.shape != (expected := (count, *(space.shape or ()))):
            raise ValueError(f"actions have shape {actions.shape}; expected {expected}")
        if isinstance(space, spaces.Discrete):
            kinds, low, high, allowed = "iu", 0, space.n - 1, f"integers from 0 to {space.n - 1}"
        else:
            kinds, low, high = "fiu", space.low, space.high
            allowed = f"finite numbers from {low.min()} to {high.max()}"
        if actions.dtype.kind not in kinds:
            raise ValueError(f"action {brief(actions.tolist())} is invalid; allowed are {allowed}")
        if ((actions >= low) & (actions <= high)).all():
            return actions
        if isinstance(space, spaces.Box):
            inside = np.clip(actions, low, high)
            valid = np.abs(actions - inside) <= ROUNDING * np.maximum(np.abs(low), np.abs(high))
        else:
            inside = actions
            valid = (actions >= low) & (actions <= high)
        if not valid.all():  # NaN is not
            first = np.argwhere(~valid)[0].tolist()
            value = f"{brief(actions.tolist())} is invalid: {actions[tuple(first)]} at {first}"
            raise ValueError(f"action {value}; allowed are {allowed}")
        return inside

    def _checked_options(self, options: Mapping[str, Any]) -> Mapping[str, Any]:
        for name in options:
            if name not in self.options:
                raise ValueError(f"unknown reset option {name!r}; this environment has {', '.join(self.options)}")
        return {**options, "params": self.parameters.check(options.get("params", {}))}

    def states(self, options: Sequence[Mapping[str, Any]]) -> list[dict[str, Floats] | None]:
        """The states that options give, None where there is none; ValueError for what is no row of a state."""
        return [self._checked_state(option["state"]) if "state" in option else None for option in options]

    def _checked_state(self, given: Any) -> dict[str, Floats]:
        own, found = self.state(np.arange(1)), {}
        if isinstance(given, Mapping) and EFFECTS in given and EFFECTS not in own:
            raise ValueError(f"state has {EFFECTS}, and this environment has none; leave it out to go on without them")
        if not isinstance(given, Mapping) or set(given) | {EFFECTS} != {*STATE, EFFECTS}:
            raise ValueError(f"state {brief(given)} has to be a dict with {', '.join(own)}")
        for name, rows in ((name, rows) for name, rows in own.items() if name in given):
            found[name] = values = np.asarray(on_host(given[name]))
            numbers = values.shape == rows.shape[1:] and values.dtype.kind in "fiu"
            if not numbers or not (np.abs(values) <= mujoco.mjMAXVAL).all():
                raise ValueError(
                    f"state {name} {brief(values.tolist())} has to be {rows.shape[1]} finite numbers up to "
                    f"{mujoco.mjMAXVAL:g}"
                )
        return found

    def _sample_params(self, rng: np.random.Generator, options: Mapping[str, Any]) -> Floats:
        drawn = self._distribution.sample(rng) if self._distribution else {}
        return self.parameters.to_array({**drawn, **options["params"]})

    def _advance(self, ids: Ints) -> None:
        """Simulate ``control_timestep``."""
        self.sim.step(ids, self._substeps)

    @abstractmethod
    def spec(self) -> mujoco.MjSpec:
        """What the model is compiled from, without what effects need."""

    @abstractmethod
    def signals(self, ids: Ints) -> dict[str, Floats]:
        """What a recording holds of the present state, arrays of n rows by name; ``signal_units`` has their units."""

    def signal(self, ids: Ints, name: str) -> Floats:
        """One of the signals, an array of n rows."""
        return self.signals(ids)[name]

    @abstractmethod
    def _sample_start(self, rng: np.random.Generator, options: Mapping[str, Any]) -> Any:
        """What one episode starts from (its goal, say), drawn from ``rng`` or taken from the options."""

    @abstractmethod
    def _place(self, ids: Ints, starts: Sequence[Any]) -> None:
        """Write the initial states of simulations that were just reset."""

    @abstractmethod
    def _begin(self, ids: Ints) -> None:
        """Note what the rewards of an episode are measured from."""

    def _lost(self, observation: Floats, inside: Floats) -> Bools:
        """(n,) whether a simulation has diverged, from observations (n, k) before and after they were clipped.

        A state on its way to infinity leaves the space before the engine calls it bad; a unit quaternion does by
        rounding. What is no number is outside too.
        """
        return ~self.xp.all(self.xp.abs(observation - inside) <= 1e-6, axis=1)

    @abstractmethod
    def _controls(self, actions: NDArray[Any]) -> Floats:
        """(n, nu) controls for n checked actions."""

    @abstractmethod
    def _observe(self, ids: Ints) -> Floats:
        """(n, k) observations."""

    @abstractmethod
    def _score(self, ids: Ints) -> tuple[dict[str, Floats], Bools]:
        """Reward terms, each (n,) and named reward_<term>, and (n,) whether the task is solved."""

    def _info(self, ids: Ints) -> dict[str, Any]:
        """(n,) arrays for ``info``, one nested dict of them for "params"."""
        return {"params": dict(zip(self.parameters.names, self.sim.params[ids].T, strict=True))}


class CopiedWithTask:
    """An environment with a task, whose copies, also through a pickle, go on from its present state to the last bit.

    A copy's task is built again from the same options, effects included. A renderer is opened when it is needed.
    """

    task_type: ClassVar[type[Task]]
    task: Task
    _task_options: dict[str, Any]

    def _build_task(self) -> Task:
        """The task of the options; the effects of a file are those of this moment, also in later copies."""
        build: Callable[..., Task] = self.task_type
        task = build(**self._task_options)
        if "effects" in self._task_options:
            self._task_options["effects"] = task.effects
        return task

    def __copy__(self) -> Self:
        """A deep copy: simulations cannot be shared."""
        return copy.deepcopy(self)

    def __getstate__(self) -> dict[str, Any]:
        """What the copy begins with."""
        own = {name: value for name, value in vars(self).items() if name not in _NOT_COPIED}
        return {"own": own, "task": self.task.saved()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Begin as a copy."""
        vars(self).update(state["own"], _renderer=None)
        self.task = self._build_task()
        self.task.resume(state["task"])
