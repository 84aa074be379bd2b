"""The parameters and settings of a robot map: model fields that are scaled or shifted together."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import mujoco
import numpy as np

from soro_bench.arrays import Floats, Ints
from soro_bench.diagnosis.robots.model_file import (
    ModelError,
    check_keys,
    element,
    joint_width,
    name_of,
    names_of,
    number,
    springs,
)
from soro_bench.diagnosis.robots.priors import Prior
from soro_bench.effects.elements import AUXILIARY
from soro_bench.models.simulation import FieldWrite
from soro_bench.recording.recording import Recording, RecordingError, latest

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
    "key": mujoco.mjtObj.mjOBJ_KEY,
}
_STATES = ("key_qpos", "key_qvel", "key_act")  # fields of keyframes that a robot begins with
_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_length0", "tendon_invweight0")
_FAR = 100.0  # prior deviations, bounds of a shifted parameter
_NEAREST = 0.49  # of the spacing of commands, by which one may be late; half-way it counts from the next step on


@dataclass(frozen=True)
class Entry:
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

    def __init__(self, model: mujoco.MjModel, entries: dict[str, list[Entry]], added: set[str]):
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


def held(recording: Recording, name: str, times: Floats, columns: int) -> Floats:
    """(T, columns) the numbers of a command from each of the evenly spaced times [s] on; before its first, those.

    Each sample counts from the nearest time on, unless samples are closer together: with time stamps that are a little
    late, it would count from nearly a step later.

    Raises:
        RecordingError: the recording has no such command, or not in so many columns, or numbers are missing.
    """
    if name not in recording.commands:
        raise RecordingError(f"no command {name!r}, which the mapping names; there are {sorted(recording.commands)}")
    command = recording.commands[name]
    values = command.values.reshape(len(command.time), -1)
    if values.shape[1] != columns:
        raise RecordingError(f"command {name!r} has {values.shape[1]} columns; expected {columns}")
    apart = [float(np.median(np.diff(each))) for each in (command.time, times) if len(each) > 1]
    nearest = times + _NEAREST * min(apart) if len(apart) == 2 else times
    held = values[np.maximum(latest(command, nearest), 0)]
    if (missing := np.isnan(held).any(axis=1)).any():
        raise RecordingError(f"the command {name!r} has missing numbers, first at {times[missing.argmax()]:.6g} s")
    return held


def settings_of(model: mujoco.MjModel, table: dict[str, Any]) -> tuple[list[Setting], dict[str, list[Entry]]]:
    """Settings, and the fields that each of them scales."""
    settings: list[Setting] = []
    entries: dict[str, list[Entry]] = {}
    for name, entry in table.items():
        label = f"[settings.{name}]"
        if not isinstance(entry, dict):
            raise ModelError(f"{label} has to be a section")
        check_keys(label, entry, _SETTING)
        source = [entry[key] for key in ("metadata", "command") if key in entry]
        if len(source) != 1 or not isinstance(source[0], str):
            raise ModelError(f"{label} needs either metadata or command, the name of one")
        reference = number(f"{label} reference", entry.get("reference", 1.0), 1e-9, 1e9)
        settings.append(Setting(entry.get("metadata"), entry.get("command"), reference))
        entries[name] = [_entry(model, label, text) for text in names_of(f"settings.{name}", entry, "fields")]
    return settings, entries


def parameters_of(
    model: mujoco.MjModel,
    table: dict[str, Any],
    scaled: dict[str, list[Entry]],
    patched: bool = False,
    keyframe: int = -1,
) -> tuple[tuple[Prior, ...], Fields]:
    """Priors of the parameters, and the fields that these and the settings change; settings change ``scaled``.

    Args:
        patched: whether the model is one that a diagnosis wrote: an effect may have taken all that is scaled.
        keyframe: number of the one that recordings begin at; -1 for the default position.
    """
    priors: list[Prior] = []
    entries, added = dict(scaled), set()
    for name, entry in table.items():
        label = f"[parameters.{name}]"
        if not isinstance(entry, dict):
            raise ModelError(f"{label} has to be a section")
        check_keys(label, entry, _PARAMETER)
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
                if not patched:
                    _check_scaled(model, label, text, one)
            priors.append(Prior(name, "1", 1.0, deviation, True, (1e-3, 1e3)))
    _check_begins(model, entries, keyframe)
    if not priors:
        raise ModelError("the mapping has no [parameters.<name>]; a diagnosis fits at least one")
    return tuple(priors), Fields(model, entries, added)


def _entry(model: mujoco.MjModel, label: str, text: str) -> Entry:
    """The field, rows and column of "field[column]:element"."""
    match = _FIELD.fullmatch(text)
    kind = match["field"].split("_")[0] if match else ""
    field = getattr(model, match["field"], None) if match and kind in _OBJECTS else None
    if match is None or not isinstance(field, np.ndarray) or not field.ndim:
        raise ModelError(f"{label} has {text!r}; expected field:element of {', '.join(_OBJECTS)}: body_mass:arm")
    if field.dtype.kind != "f" or match["field"] in _DERIVED or (kind == "key" and match["field"] not in _STATES):
        raise ModelError(f"{label}: {match['field']} is no number that a model is made of")
    column = int(match["column"]) if match["column"] else None
    if column is not None and (field.ndim < 2 or column >= field.shape[1]):
        raise ModelError(f"{label}: {match['field']} has no column {column}; its shape is {field.shape}")
    if match["element"] == "*":
        return Entry(match["field"], np.arange(len(field) - springs(model) * (kind == "tendon")), column)
    count = model.njnt if kind == "dof" else len(field)
    numbers = _matching(model, kind, count, match["element"], label)
    if kind == "dof":
        widths = [joint_width(model, i)[1] for i in numbers]
        numbers = [model.jnt_dofadr[i] + k for i, width in zip(numbers, widths, strict=True) for k in range(width)]
    return Entry(match["field"], np.array(numbers), column)


def _check_begins(model: mujoco.MjModel, entries: Mapping[str, Sequence[Entry]], keyframe: int) -> None:
    """Refuse changes of a keyframe that no recording begins at: they would do nothing."""
    for name, each in entries.items():
        rows = [int(row) for one in each if one.field in _STATES for row in one.rows]
        if others := [row for row in rows if row != keyframe]:
            there = name_of(model, _OBJECTS["key"], others[0])
            raise ModelError(f"{name} changes keyframe {there!r}, and recordings do not begin there; write "
                             f"keyframe = {there!r} in [initial]")  # fmt: skip


def _check_scaled(model: mujoco.MjModel, label: str, text: str, entry: Entry) -> None:
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
