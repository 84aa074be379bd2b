"""Writes the parts of docs/reference that say what the code says: environments, effects, parameters and commands.

python docs/generate.py

A page of an environment is written whole; in other pages the text between two marks is replaced. A test compares.
"""

import argparse
import dataclasses
import inspect
import json
import os
import re
import textwrap
import types
import typing
import warnings
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import tyro

from soro_bench.cli import COMMANDS
from soro_bench.diagnosis.paired.settings import PairedSettings
from soro_bench.diagnosis.result import SCHEMA, Result
from soro_bench.diagnosis.settings import DEFAULT, RobotSettings, listed
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.effect import Quantity
from soro_bench.effects.equations import EQUATIONS
from soro_bench.envs.task import ACTION_MODES, Task
from soro_bench.leaderboard.boards import BOARDS
from soro_bench.markdown import table
from soro_bench.parameters import ALL_PARAMETERS, Parameter
from soro_bench.registration import CONTINUOUS_IDS, ENV_IDS, task_type

DOCS = Path(__file__).parent
REFERENCE = DOCS / "reference"
BEGIN, END = "<!-- written by docs/generate.py -->", "<!-- end of what docs/generate.py writes -->"
AXES, QUATERNION = "xyz", "wxyz"


def pages() -> dict[Path, str]:
    """The texts of all pages that have a generated part, by their paths."""
    return {
        **{REFERENCE / "environments" / f"{env_id}.md": environment(env_id) for env_id in ENV_IDS},
        **{REFERENCE / name: filled(REFERENCE / name, text()) for name, text in PARTS.items()},
    }


def filled(path: Path, part: str) -> str:
    """A page with its generated part anew."""
    page = path.read_text()
    begin, end = page.index(BEGIN) + len(BEGIN), page.index(END)
    return f"{page[:begin]}\n\n{part}\n\n{page[end:]}"


# --- environments ---


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
    parts = [f"# {env_id}", BEGIN, summary, f"![{env_id} in motion](../../images/{env_id}.gif)"]
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


# --- parameters ---


def parameter_table(task: type[Task]) -> str:
    """The parameters of a task."""
    randomized = {p.name for p in task.randomized}
    rows = [(*parameter_row(p), "yes" if p.name in randomized else "no") for p in task.parameters.parameters.values()]
    return table((*PARAMETER_COLUMNS, "randomised in the study"), rows)


PARAMETER_COLUMNS = ("name", "nominal", "unit", "bounds", "search box", "meaning")


def parameter_row(p: Parameter) -> tuple[str, ...]:
    """A parameter's cells."""
    ranges = ("{:g} .. {:g}".format(*pair) for pair in (p.bounds, p.search))
    return (f"`{p.name}`", f"{p.nominal:g}", p.unit, *ranges, p.meaning)


def parameters() -> str:
    """The table of all parameters, and the environments that have them."""
    rows = []
    for p in ALL_PARAMETERS.values():
        having = {env_id: task_type(env_id).parameters.parameters.get(p.name) for env_id in ENV_IDS}
        links = ", ".join(
            f"[{env_id}](environments/{env_id}.md)" + (f" ({own.nominal:g})" if own.nominal != p.nominal else "")
            for env_id, own in having.items()
            if own
        )
        rows.append((*parameter_row(p), links))
    return table((*PARAMETER_COLUMNS, "environments (other nominal value)"), rows)


# --- effects ---


def effects() -> str:
    """The catalogue: a table of all laws, then a section for each."""
    classes = list(dict.fromkeys(law.category for law in ALL.values()))
    order = sorted(ALL.values(), key=lambda law: classes.index(law.category))
    rows = [
        (f"[`{law.name}`](#{law.name})", law.category, ", ".join(law.kinds), f"${barless(EQUATIONS[law.name].latex)}$")
        for law in order
    ]
    parts = [table(("law", "class", "acts on", "equation"), rows)]
    return "\n\n".join([*parts, *(effect(law) for law in order)])


def barless(latex: str) -> str:
    """The same in a cell of a table, where a vertical bar would begin the next one."""
    return latex.replace("|", r"\vert ")


def effect(law) -> str:
    """The section of a law."""
    equation = EQUATIONS[law.name]
    summary = re.sub(r"\s+", " ", inspect.getdoc(law).split("\n\n")[0]).rstrip(".")
    others = ", ".join(f"${symbol}$ {meaning}" for symbol, meaning in equation.other.items())
    rows = [quantity_row(q, equation.symbols[q.name], q is law.quantities[0]) for q in law.quantities]
    return "\n\n".join([
        f"### {law.name}",
        f"{summary}. Class `{law.category}`; acts on: {', '.join(law.kinds)}.",
        f"$${equation.latex}$$",
        table(("symbol", "parameter", "unit", "typical", "bounds", "no effect at"), rows),
        f"Other symbols: {others}.",
    ])


def quantity_row(q: Quantity, symbol: str, first: bool) -> tuple[str, ...]:
    """A parameter of a law."""
    typical = f"{q.typical:g}" + (f" x typical {q.of}" if q.of else "")
    low, high = ("-∞" if end == -np.inf else "∞" if end == np.inf else f"{end:.3g}" for end in q.bounds)
    return (f"${symbol}$", f"`{q.name}`", f"{q.unit}", typical, f"{low} .. {high}", f"{q.null:g}" if first else "")


# --- command line ---


def command_line() -> str:
    """A section for every command."""
    return "\n\n".join(part for name, command in COMMANDS.items() for part in _command(name, _parser(command)))


def _parser(command) -> argparse.ArgumentParser:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of get_parser, for which there is no other way
        return tyro.extras.get_parser(command)


def _command(name: str, parser: argparse.ArgumentParser) -> list[str]:
    nested = [a for a in parser._actions if isinstance(a.choices, dict)]  # other commands
    plain = [a for a in parser._actions if a.dest != "help" and a not in nested]
    text = textwrap.dedent(parser.description or "").strip()
    parts = [f"## soro-bench {name}", text]
    if plain:
        parts.append(table(("argument", "value", "default", "meaning"), map(_option, plain)))
    return parts + [
        part for action in nested for sub, inner in action.choices.items() for part in _command(f"{name} {sub}", inner)
    ]


def _option(action: argparse.Action) -> tuple[str, ...]:
    """The row of an argument."""
    text = re.sub(r"\s+", " ", action.help or "")
    meaning, _, default = text.rpartition("(")
    default = default.rstrip(")").removeprefix("default:").strip()
    name = ", ".join(f"`{option}`" for option in action.option_strings) or f"`{action.dest.upper()}`"
    value = (action.metavar or "").replace("{None}|", "").replace("{None,", "{")
    if not action.option_strings and meaning.strip() == action.dest:
        meaning = ""
    names = value[1:-1].split(",") if value.startswith("{") else [value]
    value = ", ".join(f"`{name}`" for name in names if name)
    shown = "" if default in ("None", "") else default if default == "required" else f"`{default}`"
    return (name, value, shown, doc_links(meaning.strip().replace("<", "&lt;"), REFERENCE))


# --- settings of the diagnosis ---


def measured(what: str):
    """What benchmarks have measured."""
    return json.loads((DOCS / "results" / "measured.json").read_text())[what]


OTHER_SETTINGS = {"robots": RobotSettings(), "paired": PairedSettings()}  # which Settings does not hold


def settings() -> str:
    """A table for every stage."""
    groups = {field.name: getattr(DEFAULT, field.name) for field in dataclasses.fields(DEFAULT)}
    return "\n\n".join(_settings(stage, group) for stage, group in {**groups, **OTHER_SETTINGS}.items())


def _settings(stage: str, group) -> str:
    changes = measured("settings_sensitivity")
    rows = [
        (f"`{name}`", f"{value}", unit, reason, *_changes(changes.get(f"{stage}.{name}", {}), stage == "robots"))
        for _, name, value, unit, reason in listed(stage, group)
    ]
    summary = re.sub(r"\s+", " ", inspect.getdoc(group))
    title = stage.replace("_", " ").capitalize()
    return f"## {title}\n\n{summary}\n\n{table(('setting', 'value', 'unit', 'reason', 'halved', 'doubled'), rows)}"


def _changes(measured: dict[str, dict[str, str] | str], of_robot: bool) -> Iterator[str]:
    """What changes when a setting is halved, and doubled, in the cases of benchmarks/diagnosis_settings.py; or that no
    case reads it."""
    for factor in ("halved", "doubled"):
        if factor not in measured:
            yield "not a part of a diagnosis" if of_robot else "not measured"
        elif isinstance(found := measured[factor], str):
            yield found
        else:
            yield "; ".join(f"{case}: {text}" for case, text in found.items()) or "no change"


# --- result.json ---


def result() -> str:
    """A table for every kind of object in result.json, those that it is made of first to last."""
    kinds = [Result]
    for kind in kinds:  # grows as it goes
        for hint in typing.get_type_hints(kind).values():
            kinds += [each for each in objects_in(hint) if each not in kinds]
    first = f'The top object is [Result](#result), with `"schema": "{SCHEMA}"` besides.'
    return "\n\n".join([first, *(_object(kind) for kind in kinds)])


def objects_in(hint) -> list[type]:
    """The dataclasses that an annotation holds."""
    if dataclasses.is_dataclass(hint):
        return [hint]
    return [each for inner in typing.get_args(hint) for each in objects_in(inner)]


def _object(kind: type) -> str:
    """The section of a dataclass."""
    paragraphs = inspect.getdoc(kind).split("\n\n", 1)
    names = [field.name for field in dataclasses.fields(kind)]
    meanings = field_meanings(paragraphs[-1], names)
    summary = re.sub(r"\s+", " ", paragraphs[0])
    hints = typing.get_type_hints(kind)
    rows = [(f"`{name}`", in_json(hints[name]), meanings.get(name) or meaning_of(hints[name])) for name in names]
    return f"### {kind.__name__}\n\n{summary}\n\n{table(('key', 'value', 'what'), rows)}"


def meaning_of(hint) -> str:
    """What the objects of an annotation are, if they are of one kind."""
    kinds = objects_in(hint)
    return re.split(r"[.:;] |\.$", re.sub(r"\s+", " ", inspect.getdoc(kinds[0])))[0].lower() if len(kinds) == 1 else ""


def field_meanings(text: str, names: list[str]) -> dict[str, str]:
    """What a docstring says of fields: "name, other: text"."""
    text = re.sub(r"\s+", " ", text)
    known = "|".join(names)
    heads = list(re.finditer(rf"(?:^|(?<=[.;] ))((?:{known})(?:, (?:{known}))*): ", text))
    ends = [head.start() for head in heads[1:]] + [len(text)] * bool(heads)
    return {
        name: text[head.end() : end].strip().rstrip(".;").replace("``", "`")
        for head, end in zip(heads, ends, strict=True)
        for name in head[1].split(", ")
    }


def in_json(hint) -> str:
    """An annotation in the words of JSON."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return f"[{hint.__name__}](#{hint.__name__.lower()})"
    if origin in (typing.Union, types.UnionType):
        return " or ".join("null" if each is type(None) else in_json(each) for each in inner)
    if origin is tuple:
        several = inner[1:] == (Ellipsis,)
        return f"list of {in_json(inner[0])}" if several else f"list of {len(inner)}: {in_json(inner[0])}"
    if origin is dict:
        return "object" if inner[1] is typing.Any else f"object of {in_json(inner[1])}"
    return {float: "number", int: "integer", str: "text", bool: "true or false"}[hint]


# --- libraries ---


def libraries() -> str:
    """The table of what benchmarks/compatibility.py has run."""
    rows = []
    for result in measured("compatibility"):
        versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
        steps = f"{result['steps']:,}" if result["steps"] else ""
        rows.append((result["library"], "; ".join(result["did"]), steps, versions, result["note"]))
    return table(("what", "ran", "environment steps", "versions", "note"), rows)


PARTS = {
    "../how_to/use_a_library.md": libraries,
    "effects.md": effects,
    "parameters.md": parameters,
    "command_line.md": command_line,
    "result_json.md": result,
    "settings.md": settings,
}

if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text)
