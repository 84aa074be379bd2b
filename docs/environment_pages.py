"""The pages of the environments, from their classes: spaces, actions, observations and parameters."""

import inspect
import os
import re
from pathlib import Path

import gymnasium
import mujoco
import numpy as np

from soro_bench.envs.task import ACTION_MODES, Task
from soro_bench.leaderboard.boards import BOARDS
from soro_bench.markdown import table
from soro_bench.parameters import Parameter
from soro_bench.registration import CONTINUOUS_IDS, ENV_IDS, task_type

DOCS = Path(__file__).parent
REFERENCE = DOCS / "reference"
BEGIN, END = "<!-- written by docs/generate.py -->", "<!-- end of what docs/generate.py writes -->"
AXES, QUATERNION = "xyz", "wxyz"


def environment(env_id: str) -> str:
    """The page of an environment."""
    task = task_type(env_id)
    # the cheap model, as its spaces are those of the others and it is compiled faster
    envs = {mode: gymnasium.make(env_id, **{task.variant_name: task.cheap}, action=mode) for mode in ACTION_MODES}
    summary, text = inspect.getdoc(type(envs["discrete"].unwrapped)).split("\n", 1)
    sections = dict(re.findall(r"## (.*)\n((?:(?!## ).*\n?)*)", linked(text)))
    sections["Actions"] += "\n" + actions(envs)
    sections["Observations"] += "\n" + observations(envs["continuous"])
    sections["Parameters"] = parameter_table(task)
    parts = [f"# {env_id}", BEGIN, summary]
    if (DOCS / "images" / f"{env_id}.gif").exists():
        parts += [f"![{env_id} in motion](../../images/{env_id}.gif)"]
    parts += [overview(env_id, task, envs)]
    parts += [f"## {title}\n\n{body.strip()}" for title, body in sections.items()]
    parts += ["Arguments, reset options, info and randomisation that all environments share: [Environments](index.md)."]
    return "\n\n".join(parts) + "\n"


def overview(env_id: str, task: type[Task], envs: dict[str, gymnasium.Env]) -> str:
    """The table at the top of a page."""
    env = envs["discrete"]
    boards = {name: board for name, board in BOARDS.items() if board.env_id == env_id}
    rows = [
        ("Make", f'`gymnasium.make("{env_id}")` after `import soro_bench`'),
        ("With continuous actions by its id", f'`gymnasium.make("{CONTINUOUS_IDS[env_id]}")`'),
        *(("Later version", f"`{later}`, see [version history](#version-history)") for later in _later(env_id)),
        *((f"Action space, {mode}", f"`{made.action_space}`") for mode, made in envs.items()),
        ("Observation space", f"`{env.observation_space}`"),
        ("Episode", f"{env.spec.max_episode_steps} steps of {task.control_timestep:g} s"),
        ("Models", f"`{task.variant_name}`: `{task.accurate}` (default, accurate), `{task.cheap}` (cheap)"),
        ("Fixed evaluation", f"{len(task.evaluation)} episode{'s' * (len(task.evaluation) > 1)}"),
    ]
    if boards:
        better = "larger" if next(iter(boards.values())).higher else "smaller"
        rows += [
            ("Metric", f'`info["{task.metric}"]` [m] at the end of an episode; {better} is better'),
            ("Boards", ", ".join(f"`{name}`" for name in boards)),
        ]
    return table(("property", "value"), rows)


def _later(env_id: str) -> list[str]:
    """The ids of later versions."""
    name, version = env_id.rsplit("-v", 1)
    return [each for each in ENV_IDS if each.startswith(f"{name}-v") and each != f"{name}-v{version}"]


def actions(envs: dict[str, gymnasium.Env]) -> str:
    """A table of continuous and one of discrete actions, from what they do to the model's controls."""
    space, task = envs["continuous"].action_space, envs["continuous"].unwrapped.task
    for env in envs.values():
        env.reset(seed=0)
    envs["continuous"].step(np.ones_like(space.low))
    unit = rate_unit(task)
    rows = []
    for i, unit_vector in enumerate(np.eye(len(space.low), dtype=np.float32)):
        moved = moved_by(envs["continuous"], unit_vector)
        span = {f"{ends[0]:g} .. {ends[1]:g}" for ends in (task.model.actuator(name).actrange for name in moved)}
        least, most = (f"{sign * next(iter(moved.values())):.3g}" for sign in (-1, 1))
        rows.append(
            (i, f"rate of {' and '.join(moved)}", f"{space.low[i]:g}", f"{space.high[i]:g}", least, most,
             ", ".join(f"`{name}`" for name in moved), "actuator", unit, ", ".join(span))
        )  # fmt: skip
    of_setpoint = f"limits of the setpoint [{unit.removesuffix('/s')}]"
    columns = ("num", "action", "min", "max", "control min", "control max", "name in the MJCF", "type", "unit")
    continuous = table((*columns, of_setpoint), rows)
    choices = []
    for i in range(int(envs["discrete"].action_space.n)):
        moved = moved_by(envs["discrete"], i)
        what = ", ".join(f"`{name}`" for name in moved)
        choices.append((i, f"sets the rate of {' and '.join(moved)}", f"{next(iter(moved.values())):+.3g}", what, unit))
    discrete = table(("action", "what it does", "control", "name in the MJCF", "unit"), choices)
    return f'With `action="continuous"`:\n\n{continuous}\n\nWith `action="discrete"`:\n\n{discrete}'


def moved_by(env: gymnasium.Env, action) -> dict[str, float]:
    """The controls that an action sets, by the name of the actuator."""
    env.step(action)
    task = env.unwrapped.task
    controls = task.sim.batch.ctrl[0]
    return {task.model.actuator(i).name: float(controls[i]) for i in np.flatnonzero(controls)}


def rate_unit(task: Task) -> str:
    """The unit of a control, which is the rate of a setpoint that is recorded as a signal."""
    signals = task.signals(np.arange(1))
    (unit,) = (task.signal_units[n][0] for n, value in signals.items() if np.array_equal(value, task.sim.batch.act))
    return f"{unit}/s"


def observations(env: gymnasium.Env) -> str:
    """A row for every entry of the observation, with the quantity of the model that it is equal to."""
    space = env.observation_space
    rows = [
        (i, *entry[:1], f"{space.low[i]:g}", f"{space.high[i]:g}", *entry[1:]) for i, entry in enumerate(entries(env))
    ]
    return table(("num", "observation", "min", "max", "name in the MJCF", "type", "unit"), rows)


def entries(env: gymnasium.Env) -> list[tuple[str, str, str, str]]:
    """Meaning, name in the MJCF, type and unit of every entry, found by comparing numbers after random actions."""
    env.reset(seed=0)
    env.action_space.seed(0)
    task = env.unwrapped.task
    task.sim.batch.bind("subtree_com")
    observed, known = [], []
    for _ in range(3):
        observed.append(env.step(env.action_space.sample())[0])
        known.append(quantities(task))
    left, found = list(known[0]), []
    for column in np.array(observed).T:
        same = (key for key in left if np.allclose([each[key] for each in known], column, rtol=0, atol=1e-9))
        found.append(next(same))
        left.remove(found[-1])  # two points of the clamp are equal and at rest: each is the next one
    return found


def quantities(task: Task) -> dict[tuple[str, str, str, str], float]:
    """What an observation may consist of: meaning, name, type and unit of numbers of the present state."""
    model, batch = task.model, task.sim.batch
    values = {}
    for site in (model.site(i) for i in range(model.nsite)):
        if not site.name.startswith("keypoint"):  # eyelets of cables are not observed, and some are at rest at 0
            continue
        of = re.sub(r"(\d+)", r" \1", site.name)
        for axis, value in zip(AXES, batch.site_xpos[0, site.id], strict=True):
            values[f"{axis} of {of}", f"`{site.name}`", "site", "m"] = value
    for body in (model.body(i) for i in range(model.nbody)):
        if body.mocapid[0] >= 0:
            for axis, value in zip(AXES, batch.mocap_pos[0, body.mocapid[0]], strict=True):
                values[f"{axis} of the {body.name}", f"`{body.name}`", "mocap body", "m"] = value
    for joint in (model.joint(i) for i in range(model.njnt)):
        if joint.type[0] == mujoco.mjtJoint.mjJNT_FREE:
            pose = batch.qpos[0, joint.qposadr[0] : joint.qposadr[0] + 7]
            for axis, value in zip(AXES, pose[:3], strict=True):
                values[f"{axis} of the {joint.name}'s centre", f"`{joint.name}`", "free joint", "m"] = value
            for axis, value in zip(QUATERNION, pose[3:], strict=True):
                values[f"{axis} of the {joint.name}'s unit quaternion", f"`{joint.name}`", "free joint", "1"] = value
    for axis, value in zip(AXES, task.sim.batch.subtree_com[0, 0], strict=True):
        values[f"{axis} of the centre of mass", "`world`", "body and all below it", "m"] = value
    for actuator in (model.actuator(i) for i in range(model.nu)):
        name = actuator.name
        unit = rate_unit(task).removesuffix("/s")
        values[f"setpoint of {name}", f"`{name}`", "actuator", unit] = batch.act[0, actuator.id]
    return values


def linked(text: str) -> str:
    """A docstring with its cross references as links, and without tables, which are written anew."""
    text = re.sub(r"(?m)^\|.*\n", "", text)
    text = re.sub(r":class:`(\w+)Env`", r"[\1-v0](\1-v0.md)", text)
    return doc_links(text, REFERENCE / "environments")


def doc_links(text: str, folder: Path) -> str:
    """A text with the pages that it names as links from a folder."""

    def link(match: re.Match) -> str:
        page = DOCS / match[1]
        title = page.read_text().split("# ", 1)[1].split("\n", 1)[0]
        return f"[{title}]({os.path.relpath(page, folder)})"

    return re.sub(r"docs/((?:\w+/)*\w+\.md)", link, text)


def parameter_table(task: type[Task]) -> str:
    """The parameters of a task."""
    randomized = {p.name: p for p in task.randomized}
    rows = [
        (*parameter_row(randomized.get(p.name, p)), "yes" if p.name in randomized else "no")
        for p in task.parameters.parameters.values()
    ]
    return table((*PARAMETER_COLUMNS, "randomised"), rows)


PARAMETER_COLUMNS = ("name", "nominal", "unit", "bounds", "search box", "meaning")


def parameter_row(p: Parameter) -> tuple[str, ...]:
    """A parameter's cells."""
    ranges = ("{:g} .. {:g}".format(*pair) for pair in (p.bounds, p.search))
    return (f"`{p.name}`", f"{p.nominal:g}", p.unit, *ranges, p.meaning)
