"""The TOML file that says how the recordings and the parameters of a robot belong to its MuJoCo model.

[robot]
control_timestep = 0.02           # s, how long a command is held
settle = 1.0                      # s with the first command before a recording begins; none by default
accurate = "finer.xml"            # a more accurate model, if there is one (docs/how_to/use_your_own_robot.md)

[commands.goal]                   # a command of the recordings, one column for each actuator
actuators = ["motor"]
unit = "rad"                      # compared with the recording's, if it is given

[signal]                          # what is explained: positions of sites, joints, or sensors
name = "angle"
joints = ["hinge"]                # or sites = [...], or sensors = [...]
unit = "rad"
frame = ""

[initial]                         # joints that begin where the signal of this one joint does
joints = ["hinge"]

[settings.gain]                   # fields that are scaled by a number that is known of every recording,
metadata = "gain"                 # from its metadata, or command = "..." of one column for what changes with time
reference = 200                   # the number for which the fields are as in the model; 1 by default
fields = ["actuator_gainprm[0]:motor"]

[parameters.inertia]              # fields that are scaled together (none is 0), or with add = true and a unit shifted
fields = ["body_mass:arm", "body_inertia:arm"]  # a star in a name is for any text: "site_pos[0]:hole_*"
deviation = 0.3                   # of the prior: of the logarithm, or in the unit
"""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from soro_bench.arrays import Floats, Ints
from soro_bench.diagnosis.robots.priors import Prior
from soro_bench.effects.elements import AUXILIARY
from soro_bench.models.simulation import FieldWrite
from soro_bench.recording.importers.units import UNITS
from soro_bench.recording.recording import Recording, RecordingError, Signal, latest
from soro_bench.recording.untrusted import read_bytes

_MAX_BYTES = 1_000_000
_SECTIONS = {
    "robot": ("control_timestep", "settle", "accurate"),
    "commands": None,
    "signal": ("name", "sites", "joints", "sensors", "unit", "frame"),
    "initial": ("joints",),
    "settings": None,
    "parameters": None,
}
_COMMAND = ("actuators", "unit")
_SETTING = ("fields", "metadata", "command", "reference")
_PARAMETER = ("fields", "deviation", "add", "unit")
_FIELD = re.compile(r"(?P<field>\w+)(\[(?P<column>\d+)\])?:(?P<element>.+)")
_OBJECTS = {
    "jnt": mujoco.mjtObj.mjOBJ_JOINT,
    "dof": mujoco.mjtObj.mjOBJ_JOINT,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}
_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_length0", "tendon_invweight0")
_WIDTH = {"mjJNT_FREE": 6, "mjJNT_BALL": 3}  # degrees of freedom of a joint; others have one
_MOST_NAMES = 20  # in a message
_FAR = 100.0  # prior deviations, bounds of a shifted parameter


class ModelError(ValueError):
    """A model or its mapping cannot be used; says what is wrong and what is allowed."""


@dataclass(frozen=True)
class _Entry:
    """One field that a parameter changes: some rows of it, in one column or all."""

    field: str
    rows: Ints
    column: int | None


@dataclass(frozen=True)
class Setting:
    """A known property of a recording, as a multiple of ``reference``: a number of its metadata, or a command of one
    column."""

    metadata: str | None
    command: str | None
    reference: float

    def values(self, recording: Recording, times: Floats) -> Floats:
        """(T,) values at times [s].

        Raises:
            RecordingError: says what the recording lacks.
        """
        if self.command:
            values = held(recording, self.command, times, 1)[:, 0]
            if not (np.isfinite(values) & (values >= 0)).all():
                raise RecordingError(f"the command {self.command!r} is a setting; it has to be finite and not negative")
            return values / self.reference
        text = recording.metadata.get(self.metadata or "")
        try:
            value = float(text)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            value = np.nan
        if not 0.0 <= value < np.inf:
            raise RecordingError(f"metadata {self.metadata!r} of the recording is {text!r}; a number is needed, not "
                                 "negative")  # fmt: skip
        return np.full(len(times), value / self.reference)


class Fields:
    """Parameters and settings as changes of model fields."""

    def __init__(self, model: mujoco.MjModel, entries: dict[str, list[_Entry]], added: set[str]):
        self._model, self._entries, self._added = model, entries, added

    def writes(self, params: Mapping[str, Floats]) -> list[FieldWrite]:
        """The changed fields, each with all its changes, for values (N,) of each parameter and setting."""
        found: dict[str, np.ndarray] = {}
        for name, entries in self._entries.items():
            for entry in entries:
                own = getattr(self._model, entry.field)
                values = found.setdefault(entry.field, np.repeat(own[None], len(params[name]), axis=0))
                at = (slice(None), entry.rows) if entry.column is None else (slice(None), entry.rows, entry.column)
                by = params[name].reshape(-1, *[1] * (values[at].ndim - 1))
                values[at] = values[at] + by if name in self._added else values[at] * by
        return [FieldWrite(field, np.arange(values.shape[1]), values) for field, values in found.items()]


def read_mapping(path: str | Path) -> dict[str, Any]:
    """The mapping, checked for its sections and entries; those left out are empty."""
    try:
        table = tomllib.loads(read_bytes(path, _MAX_BYTES).decode())
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{path} is no TOML file: {error}") from error
    _check_keys(str(path), table, tuple(_SECTIONS))
    for section, allowed in _SECTIONS.items():
        entries = table.setdefault(section, {})
        if not isinstance(entries, dict):
            raise ModelError(f"{section} has to be a section, [{section}]")
        if allowed is not None:
            _check_keys(f"[{section}]", entries, allowed)
    return table


def accurate_of(settings: dict[str, Any], mapping: str | Path) -> Path | None:
    """The finer model that the section [robot] of a mapping names, from the mapping's folder."""
    name = settings.get("accurate")
    if name is None:
        return None
    folder = Path(mapping).parent
    path = folder / name if isinstance(name, str) else None
    if path is None or not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
        raise ModelError(f"[robot] accurate is {name!r}; expected a model in the folder of the mapping, or below it")
    return path


def commands_of(model: mujoco.MjModel, table: dict[str, Any]) -> list[tuple[str, list[int], str | None]]:
    """Name, MuJoCo's actuator ids and unit of each command; None for one without a unit."""
    found: list[tuple[str, list[int], str | None]] = []
    taken: set[str] = set()
    for name, entry in table.items():
        actuators = names_of(f"commands.{name}", entry, "actuators")
        _check_keys(f"[commands.{name}]", entry, _COMMAND)
        if twice := sorted(taken & set(actuators)):
            raise ModelError(f"[commands.{name}] has actuator {twice[0]!r}, which has a command already")
        taken |= set(actuators)
        unit = entry.get("unit")
        if not isinstance(unit, str | None):
            raise ModelError(f"[commands.{name}] unit is {unit!r}; expected a text")
        try:
            found.append((name, [element(model, mujoco.mjtObj.mjOBJ_ACTUATOR, one) for one in actuators], unit))
        except ModelError as error:
            raise ModelError(f"[commands.{name}]: {error}") from error
    if model.nu and not found:
        raise ModelError("the mapping has no [commands.<name>], and the model has actuators; say what moves them")
    return found


def check_unit(command: Signal, name: str, unit: str | None) -> None:
    """Refuse a command in another unit than ``unit``, by default the SI unit of its own.

    Raises:
        RecordingError: it is in another one.
    """
    expected = unit or UNITS.get(command.unit, (command.unit,))[0]
    if command.unit != expected:
        raise RecordingError(f"the command {name!r} is in {command.unit!r}; expected is {expected!r}")


def held(recording: Recording, name: str, times: Floats, columns: int) -> Floats:
    """(T, columns) the latest numbers of a command at each of the times [s]; before its first, those.

    Raises:
        RecordingError: the recording has no such command, or not in so many columns, or numbers are missing.
    """
    if name not in recording.commands:
        raise RecordingError(f"no command {name!r}, which the mapping names; there are {sorted(recording.commands)}")
    command = recording.commands[name]
    values = command.values.reshape(len(command.time), -1)
    if values.shape[1] != columns:
        raise RecordingError(f"command {name!r} has {values.shape[1]} columns; expected {columns}")
    held = values[np.maximum(latest(command, times), 0)]
    if (missing := np.isnan(held).any(axis=1)).any():
        raise RecordingError(f"the command {name!r} has missing numbers, first at {times[missing.argmax()]:.6g} s")
    return held


def settings_of(model: mujoco.MjModel, table: dict[str, Any]) -> tuple[list[Setting], dict[str, list[_Entry]]]:
    """Settings, and the fields that each of them scales."""
    settings: list[Setting] = []
    entries: dict[str, list[_Entry]] = {}
    for name, entry in table.items():
        label = f"[settings.{name}]"
        if not isinstance(entry, dict):
            raise ModelError(f"{label} has to be a section")
        _check_keys(label, entry, _SETTING)
        source = [entry[key] for key in ("metadata", "command") if key in entry]
        if len(source) != 1 or not isinstance(source[0], str):
            raise ModelError(f"{label} needs either metadata or command, the name of one")
        reference = number(f"{label} reference", entry.get("reference", 1.0), 1e-9, 1e9)
        settings.append(Setting(entry.get("metadata"), entry.get("command"), reference))
        entries[name] = [_entry(model, label, text) for text in names_of(f"settings.{name}", entry, "fields")]
    return settings, entries


def parameters_of(
    model: mujoco.MjModel, table: dict[str, Any], scaled: dict[str, list[_Entry]]
) -> tuple[tuple[Prior, ...], Fields]:
    """Priors of the parameters, and the fields that these and the settings change; settings change ``scaled``."""
    priors: list[Prior] = []
    entries, added = dict(scaled), set()
    for name, entry in table.items():
        label = f"[parameters.{name}]"
        if not isinstance(entry, dict):
            raise ModelError(f"{label} has to be a section")
        _check_keys(label, entry, _PARAMETER)
        if name in scaled:
            raise ModelError(f"{label} has the name of a setting")
        deviation = number(f"{label} deviation", entry.get("deviation"), 1e-9, 1e9)
        entries[name] = [_entry(model, label, text) for text in names_of(f"parameters.{name}", entry, "fields")]
        if not isinstance(entry.get("add", False), bool):
            raise ModelError(f"{label} add is {entry['add']!r}; expected true or false")
        if entry.get("add", False):
            added.add(name)
            bounds = (-_FAR * deviation, _FAR * deviation)
            priors.append(Prior(name, str(entry.get("unit", "1")), 0.0, deviation, False, bounds))
        else:
            for text, one in zip(entry["fields"], entries[name], strict=True):
                _check_scaled(model, label, text, one)
            priors.append(Prior(name, "1", 1.0, deviation, True, (1e-3, 1e3)))
    if not priors:
        raise ModelError("the mapping has no [parameters.<name>]; a diagnosis fits at least one")
    return tuple(priors), Fields(model, entries, added)


def _entry(model: mujoco.MjModel, label: str, text: str) -> _Entry:
    """The field, rows and column of "field[column]:element"."""
    match = _FIELD.fullmatch(text)
    kind = match["field"].split("_")[0] if match else ""
    field = getattr(model, match["field"], None) if match and kind in _OBJECTS else None
    if match is None or not isinstance(field, np.ndarray) or not field.ndim:
        raise ModelError(f"{label} has {text!r}; expected field:element of {', '.join(_OBJECTS)}: body_mass:arm")
    if field.dtype.kind != "f" or match["field"] in _DERIVED:
        raise ModelError(f"{label}: {match['field']} is no number that a model is made of")
    column = int(match["column"]) if match["column"] else None
    if column is not None and (field.ndim < 2 or column >= field.shape[1]):
        raise ModelError(f"{label}: {match['field']} has no column {column}; its shape is {field.shape}")
    if match["element"] == "*":
        return _Entry(match["field"], np.arange(len(field) - _springs(model) * (kind == "tendon")), column)
    count = model.njnt if kind == "dof" else len(field)
    numbers = _matching(model, kind, count, match["element"], label)
    if kind == "dof":
        widths = [_WIDTH.get(mujoco.mjtJoint(model.jnt_type[i]).name, 1) for i in numbers]
        numbers = [model.jnt_dofadr[i] + k for i, width in zip(numbers, widths, strict=True) for k in range(width)]
    return _Entry(match["field"], np.array(numbers), column)


def _check_scaled(model: mujoco.MjModel, label: str, text: str, entry: _Entry) -> None:
    """Refuse a field of zeros, which no factor changes: its factor would get an interval all the same."""
    values = getattr(model, entry.field)[entry.rows]
    if not (values if entry.column is None else values[..., entry.column]).any():
        raise ModelError(
            f"{label}: {text} is 0 in the model, and no factor changes that; give it a value, or add = true"
        )


def _matching(model: mujoco.MjModel, kind: str, count: int, name: str, label: str) -> list[int]:
    """MuJoCo's ids of the element with a name, or of those of ``count`` that match a name with a star."""
    if "*" not in name:
        return [element(model, _OBJECTS[kind], name)]
    names = [mujoco.mj_id2name(model, _OBJECTS[kind], i) for i in range(count)]
    own = [i for i, each in enumerate(names) if each and not each.startswith(AUXILIARY)]
    if not (found := [i for i in own if fnmatchcase(names[i], name)]):
        raise ModelError(f"{label}: no {kind} of the model is called {name!r}")
    return found


def _springs(model: mujoco.MjModel) -> int:
    """Number of tendons that were added for effects; they come last."""
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TENDON, i) for i in range(model.ntendon)]
    return sum(bool(name) and name.startswith(AUXILIARY) for name in names)


def element(model: mujoco.MjModel, kind: mujoco.mjtObj, name: object) -> int:
    """MuJoCo's id of an element; ModelError if there is none."""
    if not isinstance(name, str) or (number := mujoco.mj_name2id(model, kind, name)) < 0:
        raise ModelError(f"the model has no {kind.name[6:].lower()} {name!r}; it has {_names(model, kind)}")
    return number


def _names(model: mujoco.MjModel, kind: mujoco.mjtObj) -> str:
    """Names of the model's elements of a kind, or the first of many."""
    label = kind.name[6:].lower()
    count = getattr(model, {"joint": "njnt", "actuator": "nu"}.get(label, f"n{label}"))
    found = [mujoco.mj_id2name(model, kind, i) for i in range(count)]
    own = [name for name in found if name and not name.startswith(AUXILIARY)]
    return ", ".join(own[:_MOST_NAMES] + ["..."] * (len(own) > _MOST_NAMES)) or "none with a name"


def joint(model: mujoco.MjModel, name: object) -> int:
    """MuJoCo's id of a joint with one degree of freedom; ModelError for another one."""
    number = element(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    if mujoco.mjtJoint(model.jnt_type[number]).name in _WIDTH:
        raise ModelError(f"joint {name!r} has several degrees of freedom; one is needed")
    return number


def names_of(label: str, entry: object, key: str) -> list[str]:
    """The list of names that an entry of a section has; ModelError for anything else."""
    values = entry.get(key) if isinstance(entry, dict) else None
    if not isinstance(values, list) or not values or not all(isinstance(value, str) for value in values):
        raise ModelError(f"[{label}] {key} is {values!r}; expected a list of names")
    if len(set(values)) < len(values):
        raise ModelError(f"[{label}] {key} is {values!r}; expected each name once")
    return values


def number(label: str, value: object, low: float, high: float) -> float:
    """A value that is a number within bounds; ModelError for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise ModelError(f"{label} is {value!r}; expected a number from {low:g} to {high:g}")
    return float(value)


def _check_keys(label: str, table: dict[str, Any], allowed: Sequence[str]) -> None:
    """Refuse entries of a section that are not allowed."""
    for key in table:
        if key not in allowed:
            raise ModelError(f"unknown entry {key!r} in {label}; there are {', '.join(allowed)}")
