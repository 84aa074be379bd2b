"""Recordings of simulated episodes, and simulated episodes after recordings."""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

import soro_bench
from soro_bench.arrays import Floats
from soro_bench.effects.effect import Effect
from soro_bench.envs.task import ACTION_MODES
from soro_bench.evaluation import Episode, evaluate
from soro_bench.files import brief
from soro_bench.packed import is_there
from soro_bench.policies.policy import Policy, TrainedPolicy
from soro_bench.recording.excitation import excitation
from soro_bench.recording.recording import Recording, RecordingError, Signal, latest
from soro_bench.registration import ENV_IDS, make_task, task_type

POLICIES = ("random", "excitation")  # and the folder or leaderboard entry of a trained one
COMMAND = "action"  # the command that an episode is driven by
_OBJECT = "object_position"  # the signal of an object's centre
MAX_STEPS = 100_000  # of a replay
MARKER_DISTANCE = 0.0125  # m: orientations are as noisy as those of markers so far off the centre


def record(
    env_id: str,
    policy: str | Floats = "random",
    model: str | None = None,
    action: str | None = None,
    params: Mapping[str, float] | None = None,
    steps: int | None = None,
    seed: int = 0,
    noise: float = 0.0,
    full_state: bool = False,
    effects: str | Path | Sequence[Effect] | None = None,
    load: Callable[[str], TrainedPolicy] = Policy.load,
) -> Recording:
    """Simulate an episode and record what there is to measure.

    Args:
        policy: "random" (uniform actions), "excitation", the folder of a trained policy, or continuous actions
            (T, nu), which are replayed.
        model: the environment's model or mesh; the accurate one by default.
        action: "discrete" or "continuous"; by default continuous, or what the trained policy needs.
        params: physical parameters; nominal where none is given.
        steps: the episode does not end before; by default what the environment is registered with, and 30 s (or what
            it takes) for an excitation. Given actions decide it themselves.
        seed: of the goal, the actions and the noise.
        noise: m, standard deviation of normal noise on every number of all positions; orientations are as noisy as
            those of markers 12.5 mm off the centre.
        full_state: whether to record the simulation's whole state too, as signals named state.qpos and so on.
        effects: physics that the model leaves out, as the environment takes it; a replay does not have it.
        load: reads a trained policy; :func:`soro_bench.leaderboard.entry.load_policy` also takes leaderboard entries.

    Raises:
        ValueError: names what is wrong and what is allowed, or says when the simulation diverged.
    """
    if env_id not in ENV_IDS:
        raise ValueError(f"unknown environment {env_id!r}; there are {', '.join(ENV_IDS)}")
    given = None if isinstance(policy, str) else policy
    steps = steps if given is None else len(given)
    if not 0 <= noise < math.inf or (steps is not None and steps < 1) or seed < 0:
        raise ValueError(f"noise {noise}, steps {steps} and seed {seed}: at least 0, 1 and 0 are needed")
    policy = policy if isinstance(policy, str) else "actions"
    trained = None if given is not None or policy in POLICIES else _trained(policy, env_id, action, load)
    action = trained.card.action if trained else action or "continuous"
    model = model or task_type(env_id).accurate
    if action not in ACTION_MODES:
        raise ValueError(f"unknown action mode {action!r}; there are {', '.join(ACTION_MODES)}")
    task = make_task(env_id, 1, 1, model, action=action)
    if policy == "excitation":
        duration = None if steps is None else steps * task.control_timestep
        actions = excitation(task.single_action_space, task.control_timestep, duration, seed)
        act, steps = _in_turn(actions), len(actions)
    elif given is not None:
        act = _in_turn(given)
    else:
        act = trained.act if trained else _random(task.single_action_space, seed)
    inputs = trained.inputs if trained else None
    steps = steps or gymnasium.spec(env_id).max_episode_steps
    missing = {} if effects is None else {"effects": effects}
    start = {"params": params or {}}
    episode = _run(act, env_id, model, action, start, steps, seed, full_state, inputs=inputs, **missing)
    if episode.diverged:
        raise ValueError(f"the simulation diverged after {episode.time[-1]:g} s; parameters nearer to the nominal "
                         "ones, or softer actions, are needed")  # fmt: skip
    metadata = {"policy": policy[:1000], "seed": str(seed), "soro_bench": soro_bench.__version__}
    return _recording(episode, action, noise, seed, metadata)


def replay(recording: Recording, model: str | None = None, **options: Any) -> Episode:
    """Simulate what a recording's actions do to a robot with its parameters.

    A recording of the same simulation without noise gives its signals again, bit for bit.

    Args:
        recording: with the command "action" and env_id, action and perhaps model and goal in its metadata.
        model: instead of the recording's; the accurate one if neither is given.
        options: further arguments of the environment, such as effects.

    Raises:
        ValueError: names what the recording lacks.
    """
    metadata = recording.metadata
    env_id, actions = recorded_actions(recording)
    start = {"params": recording.parameters, **start_of(recording)}
    if "goal" in metadata and "goal" in task_type(env_id).options:
        start["goal"] = _coordinates("goal", metadata["goal"])
    model = model or metadata.get("model") or task_type(env_id).accurate
    return _run(_in_turn(actions), env_id, model, metadata["action"], start, len(actions), **options)


def replay_begins(recording: Recording) -> float:
    """When time is 0 in a replay [s], in the time of the recording: when the first action of it is sent."""
    timestep = task_type(recording.metadata["env_id"]).control_timestep
    return recording.control_steps([COMMAND], timestep)[0]


def start_of(recording: Recording) -> dict[str, list[float]]:
    """Reset options that say where an object begins, for environments that may put it anywhere: by the metadata, or by
    the first sample.

    Raises:
        RecordingError: the recording does not say where.
    """
    if "object" not in task_type(recording.metadata["env_id"]).options:
        return {}
    if "object" in recording.metadata:
        return {"object": _coordinates("object", recording.metadata["object"])}
    if _OBJECT not in recording.signals:
        raise RecordingError(f"the recording says nowhere where the object begins: metadata have no object, x and z "
                             f"[m], and there is no {_OBJECT}")  # fmt: skip
    first = np.ravel(recording.signals[_OBJECT].values[0])  # a stranger's may have any shape
    return {"object": first[::2].tolist()}


def recorded_actions(recording: Recording) -> tuple[str, np.ndarray]:
    """The environment of a recording, and its action (T, ...) in each control step: the last one sent until its
    beginning; before the first, continuous actions are zero. ValueError names what the recording lacks."""
    metadata = recording.metadata
    env_id, action = metadata.get("env_id"), metadata.get("action")
    if env_id not in ENV_IDS:
        raise RecordingError(
            f"its env_id is {brief(env_id)}, none of {', '.join(ENV_IDS)}; for another robot use soro-bench "
            "diagnose with --model and --map"
        )
    if action not in ACTION_MODES:
        raise RecordingError(f"its action is {brief(action)}; allowed are {', '.join(ACTION_MODES)}")
    if COMMAND not in recording.commands:
        raise RecordingError(f"there is no command {COMMAND!r} to replay; there are {sorted(recording.commands)}")
    timestep = task_type(env_id).control_timestep
    begin, steps = recording.control_steps([COMMAND], timestep)
    if not 1 <= steps <= MAX_STEPS:
        raise RecordingError(f"{recording.duration} s are {steps} control steps; expected 1 to {MAX_STEPS}")
    times = begin + timestep * np.arange(steps)
    return env_id, _held(recording.commands[COMMAND], times, action == "discrete")


def parse_params(pairs: Sequence[str]) -> dict[str, float]:
    """Numbers by name from texts such as "trunk_mass=0.3"; ValueError for anything else."""
    params: dict[str, float] = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        if name in params:
            raise ValueError(f"{name} is given twice, {params[name]:g} and {value}")
        try:
            params[name] = float(value)
        except ValueError:
            raise ValueError(f"{pair!r} is no NAME=NUMBER; expected something like trunk_mass=0.3") from None
    return params


def _run(
    act: Callable[[np.ndarray], np.ndarray],
    env_id: str,
    model: str,
    action: str,
    start: Mapping[str, Any],
    steps: int | None,
    seed: int = 0,
    full_state: bool = False,
    **options: Any,
) -> Episode:
    (episode,) = evaluate(
        act, env_id, model, action, [start], 1, steps, seed, stop_when_solved=False, full_state=full_state, **options
    )
    return episode


def _recording(episode: Episode, action: str, noise: float, seed: int, metadata: dict[str, str]) -> Recording:
    rng, turns = np.random.default_rng((seed, 2)), np.random.default_rng((seed, 3))
    units, signals = task_type(episode.env_id).signal_units, {}
    for name, values in sorted(episode.signals.items()):
        unit, frame = units.get(name, ("1", ""))  # the parts of the state have several
        if noise and (unit, frame) == ("m", "world"):
            values = values + noise * rng.standard_normal(values.shape)
        if noise and (unit, frame) == ("1", "world"):  # orientations
            half_angle = noise / (2 * MARKER_DISTANCE)  # rad, what a unit quaternion changes by
            values = values + half_angle * turns.standard_normal(values.shape)
            values /= np.linalg.norm(values, axis=-1, keepdims=True)
        signals[name] = Signal(episode.time, values, unit, frame)
    commands = {COMMAND: Signal(episode.time[: len(episode.actions)], episode.actions, "1")}
    metadata |= {"env_id": episode.env_id, "model": episode.model, "action": action, "noise": repr(float(noise))}
    if episode.goal is not None:
        metadata["goal"] = json.dumps(episode.goal.tolist())
    if "object" in task_type(episode.env_id).options:  # x and z of its place
        metadata["object"] = json.dumps(episode.signals[_OBJECT][0, ::2].tolist())
    return Recording(commands, signals, episode.params, metadata)


def _trained(path: str, env_id: str, action: str | None, load: Callable[[str], TrainedPolicy]) -> TrainedPolicy:
    if not is_there(path):
        raise ValueError(f"policy {path!r} is neither {', '.join(POLICIES)} nor a folder or entry")
    policy = load(path)
    if policy.card.env_id != env_id or action not in (None, policy.card.action):
        raise ValueError(f"the policy in {path} is for {policy.card.env_id} with {policy.card.action} actions")
    return policy


def _random(space: spaces.Discrete | spaces.Box, seed: int) -> Callable[[np.ndarray], np.ndarray]:
    rng = np.random.default_rng((seed, 1))
    if isinstance(space, spaces.Discrete):
        return lambda observation: rng.integers(space.n, size=len(observation))
    return lambda observation: rng.uniform(space.low, space.high, (len(observation), *space.shape))


def _in_turn(actions: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    rows: Iterator[np.ndarray] = iter(actions)
    return lambda observation: next(rows)[None]


def _held(command: Signal, times: np.ndarray, discrete: bool) -> np.ndarray:
    """The last action at or before each of the times."""
    last = latest(command, times)
    actions = command.values[np.maximum(last, 0)]
    if np.isnan(actions).any():
        raise RecordingError(f"the command {COMMAND!r} has missing numbers")
    if not discrete:
        actions[last < 0] = 0.0
        return actions
    if last[0] < 0 or (actions != np.round(actions)).any() or (np.abs(actions) > 1000).any():
        raise RecordingError(f"the command {COMMAND!r} has to be integers from the first time stamp on")
    return actions.astype(int)


def _coordinates(name: str, text: str) -> list[float]:
    try:
        point = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{name} {text[:80]!r} is no list of coordinates") from error
    return point
