"""Writes the parts of docs/reference that say what the code says: environments, effects, parameters and commands.

python docs/generate.py

A page of an environment is written whole; in other pages the text between two marks is replaced. A test compares.
"""

import argparse
import dataclasses
import inspect
import json
import re
import textwrap
import types
import typing
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tyro

from docs.environment_pages import BEGIN, DOCS, END, PARAMETER_COLUMNS, REFERENCE, doc_links, environment, parameter_row
from soro_bench.cli import COMMANDS
from soro_bench.diagnosis.result import SCHEMA, Result
from soro_bench.diagnosis.settings import DEFAULT, RobotSettings, listed
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.effect import Quantity
from soro_bench.effects.equations import EQUATIONS
from soro_bench.markdown import table
from soro_bench.parameters import ALL_PARAMETERS
from soro_bench.registration import FIRST_IDS, task_type


def pages() -> dict[Path, str]:
    """The texts of all pages that have a generated part, by their paths."""
    return {
        **{REFERENCE / "environments" / f"{env_id}.md": environment(env_id) for env_id in FIRST_IDS},
        **{REFERENCE / name: filled(REFERENCE / name, text()) for name, text in PARTS.items()},
    }


def filled(path: Path, part: str) -> str:
    """A page with its generated part anew."""
    page = path.read_text()
    begin, end = page.index(BEGIN) + len(BEGIN), page.index(END)
    return f"{page[:begin]}\n\n{part}\n\n{page[end:]}"


# --- parameters ---


def parameters() -> str:
    """The table of all parameters, and the environments that have them."""
    rows = []
    for p in ALL_PARAMETERS.values():
        having = {env_id: task_type(env_id).parameters.parameters.get(p.name) for env_id in FIRST_IDS}
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
    positional = action.dest.rpartition(".")[2].upper()
    name = ", ".join(f"`{option}`" for option in action.option_strings or [positional])
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


OTHER_SETTINGS = {"robots": RobotSettings()}  # which Settings does not hold


def settings() -> str:
    """A table for every stage."""
    tables = [_settings(stage, group) for stage, group in {**DEFAULT.groups(), **OTHER_SETTINGS}.items()]
    return "\n\n".join([_settings_counts(), *tables])


def _settings_counts() -> str:
    """How many settings change something, in one sentence."""
    changes, groups = measured("settings_sensitivity"), {**DEFAULT.groups(), **OTHER_SETTINGS}
    keys = [f"{stage}.{name}" for stage, group in groups.items() for _, name, *_ in listed(stage, group)]
    known = [key for key in keys if key in changes]
    changing = sum(any(changes[key].values()) for key in known)
    return (
        f"Of {len(keys)} settings, {changing} change something, {len(known) - changing} change nothing in these cases "
        f"and tests, and {len(keys) - len(known)} are not measured."
    )


def _settings(stage: str, group) -> str:
    changes = measured("settings_sensitivity")
    rows = [
        (f"`{name}`", f"{value}", unit, reason, *_changes(changes.get(f"{stage}.{name}", {})))
        for _, name, value, unit, reason in listed(stage, group)
    ]
    summary = re.sub(r"\s+", " ", inspect.getdoc(group))
    title = stage.replace("_", " ").capitalize()
    return f"## {title}\n\n{summary}\n\n{table(('setting', 'value', 'unit', 'reason', 'halved', 'doubled'), rows)}"


def _changes(measured: dict[str, dict[str, str]]) -> Iterator[str]:
    """What changes when a setting is halved, and doubled, in the cases and tests that it was varied in."""
    for factor in ("halved", "doubled"):
        texts = [f"{case}: {text}" for case, text in measured.get(factor, {}).items()]
        yield "; ".join(texts) or ("no change" if factor in measured else "not measured")


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
    said = {name: meanings.get(name) or meaning_of(hints[name]) for name in names}
    rows = [(f"`{name}`", in_json(hints[name]), re.sub(r"\bNone\b", "`null`", said[name])) for name in names]
    return f"### {kind.__name__}\n\n{summary}\n\n{table(('key', 'value', 'what'), rows)}"


def meaning_of(hint) -> str:
    """What the objects of an annotation are, if they are of one kind."""
    kinds = objects_in(hint)
    if len(kinds) != 1:
        return ""
    first = re.split(r"[.:;] |\.$", re.sub(r"\s+", " ", inspect.getdoc(kinds[0])))[0]
    return first[:1].lower() + first[1:]


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
    "result_files.md": result,
    "settings.md": settings,
}

if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for path, text in pages().items():
        path.write_text(text)
