"""The TOML file that says how the recordings and the parameters of a robot belong to its MuJoCo model.

[robot]
control_timestep = 0.02           # s, how long a command is held
settle = 1.0                      # s with the first command before a recording begins; none by default
relax = true                      # stop it behind positions of rest while it settles; false by default
accurate = "finer.xml"            # a more accurate model, if there is one (docs/how_to/use_your_own_robot.md)
ctrlrange = "widen"               # commands may exceed the actuators' ranges; by default the model clips them

[commands.goal]                   # a command of the recordings, one column for each actuator
actuators = ["motor"]             # by name, or "#0" by number; so are all elements
unit = "rad"                      # compared with the recording's, if it is given
ctrlrange = "widen"               # for these actuators only

[fixed]                           # constant controls of actuators without a command
gripper = 0.04

[signal]                          # what is explained: positions of sites, bodies or joints, or sensors
name = "angle"
joints = ["hinge"]                # or sites, bodies or sensors
unit = "rad"
frame = ""

[[signals]]                       # other signals that are explained too, each with its own unit and noise
name = "current"
sensors = ["torque"]
unit = "N m"

[initial]                         # where a recording begins (model_state.py)
keyframe = "home"                 # of the model; "" for its default position
joints = ["hinge"]                # joints that begin where the signal of this one joint does
[initial.signals.speed]           # and what begins at the first sample of another signal
velocities = ["hinge"]            # or joints = [...]

[settings.gain]                   # fields that are scaled by a number that is known of every recording,
metadata = "gain"                 # from its metadata, or command = "..." of one column for what changes with time
reference = 200                   # the number for which the fields are as in the model; 1 by default
fields = ["actuator_gainprm[0]:motor"]

[parameters.inertia]              # fields that are scaled together (none is 0), or with add = true and a unit shifted
fields = ["body_mass:arm", "body_inertia:arm"]  # a star in a name is for any text: "site_pos[0]:hole_*"
deviation = 0.3                   # of the prior: of the logarithm, or in the unit
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from soro_bench.arrays import Bools, Floats
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.model_file import ModelError, check_keys, element, name_of, names_of, number
from soro_bench.files import parsed_toml
from soro_bench.recording.importers.units import UNITS
from soro_bench.recording.recording import RecordingError, Signal
from soro_bench.recording.untrusted import read_bytes

_MAX_BYTES = 1_000_000
_MOST_SIGNALS = 100
_SIGNAL = ("name", "sites", "bodies", "joints", "sensors", "unit", "frame")
_SECTIONS = {
    "robot": ("control_timestep", "settle", "relax", "accurate", "ctrlrange"),
    "commands": None,
    "fixed": None,
    "signal": _SIGNAL,
    "initial": ("keyframe", "joints", "signals"),
    "settings": None,
    "parameters": None,
}
_COMMAND = ("actuators", "unit", "ctrlrange", "leave_out")
_LONGEST = 1e6  # s
_WIDEN = "widen"
_ACTUATOR = mujoco.mjtObj.mjOBJ_ACTUATOR
_EXACT = 1e-6  # share of a control step; a time step that fits so well stays as it is


@dataclass(frozen=True)
class Command:
    """A command of the recordings: MuJoCo's ids of its actuators, its unit if the mapping names one, whether it may
    exceed the ranges of these actuators, and how long after each of its changes nothing is explained [s]."""

    name: str
    actuators: list[int]
    unit: str | None
    widened: bool
    leave_out: float

    def without_changes(self, measured: Measured, control_timestep: float) -> Measured:
        """The same with nothing measured for a while after each change of the command.

        Raises:
            RecordingError: nothing is left.
        """
        if not self.leave_out:
            return measured
        own, steps = measured.actions[:, self.actuators], np.arange(len(measured.actions))
        anew = np.any(np.diff(own, axis=0, prepend=own[:1]), axis=1)
        since = steps - np.maximum.accumulate(np.where(anew, steps, -np.inf))
        out = np.asarray((since + 0.5) * control_timestep < self.leave_out)  # samples are at the ends of steps
        name = f"[commands.{self.name}] leave_out = {self.leave_out:g} s"
        if out[1:].all():  # nothing has changed before the first
            raise RecordingError(f"{name} leaves nothing of this recording, whose command changes all the time")
        note = f"{name} leaves out {100 * out.mean():.0f} % of the recording"
        return replace(measured.without(out), notes=(*measured.notes, note))


def read_mapping(mapping: str | Path | Mapping[str, Any]) -> dict[str, Any]:
    """A mapping, a file or its content, checked for its sections and entries; those left out are empty."""
    if isinstance(mapping, Mapping):
        table, label = dict(mapping), "the mapping"
    else:
        table, label = _parsed(mapping), str(mapping)
    check_keys(label, table, (*_SECTIONS, "signals"))
    _check_signals(table)
    for section, allowed in _SECTIONS.items():
        entries = table.setdefault(section, {})
        if not isinstance(entries, dict):
            raise ModelError(f"{section} has to be a section, [{section}]")
        if allowed is not None:
            check_keys(f"[{section}]", entries, allowed)
    return table


def _check_signals(table: dict[str, Any]) -> None:
    """Check the sections [[signals]]; the first of them is [signal] where that is not there."""
    others = table.get("signals", [])
    if not isinstance(others, list) or not all(isinstance(each, dict) for each in others):
        raise ModelError("signals have to be sections, [[signals]], one for each signal")
    if len(others) > _MOST_SIGNALS:
        raise ModelError(f"{len(others)} sections [[signals]]; at most {_MOST_SIGNALS} are allowed")
    for each in others:
        check_keys("[[signals]]", each, _SIGNAL)
    if "signal" not in table and others:
        table["signal"], *others = others
    table["signals"] = others


def _parsed(path: str | Path) -> dict[str, Any]:
    try:
        return parsed_toml(read_bytes(path, _MAX_BYTES).decode())
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{path} is no TOML file: {error}") from error


def accurate_of(settings: dict[str, Any], mapping: str | Path | Mapping[str, Any]) -> Path | None:
    """The finer model that the section [robot] of a mapping names, from the mapping's folder."""
    name = settings.get("accurate")
    if name is None:
        return None
    folder = Path() if isinstance(mapping, Mapping) else Path(mapping).parent
    path = folder / name if isinstance(name, str) else None
    if path is None or not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
        raise ModelError(f"[robot] accurate is {name!r}; expected a model in the folder of the mapping, or below it")
    return path


def time_steps(control_timestep: float, timestep: float) -> tuple[int, float]:
    """How many time steps a control step has, and how long they are [s].

    They are as long as the model's own if those fit; else a little shorter, so that a whole number of them does.

    Args:
        control_timestep: s.
        timestep: of the model [s].
    """
    nearest = round(control_timestep / timestep)
    if nearest >= 1 and abs(nearest * timestep / control_timestep - 1) <= _EXACT:
        return nearest, timestep
    steps = int(np.ceil(control_timestep / timestep))
    return steps, control_timestep / steps


def commands_of(model: mujoco.MjModel, table: dict[str, Any], widen_all: bool = False) -> list[Command]:
    """The commands of the mapping; ``widen_all``: whether all may exceed the ranges of their actuators."""
    found: list[Command] = []
    taken: set[int] = set()
    for name, entry in table.items():
        names = names_of(f"commands.{name}", entry, "actuators")
        check_keys(f"[commands.{name}]", entry, _COMMAND)
        try:
            actuators = [element(model, _ACTUATOR, one) for one in names]
        except ModelError as error:
            raise ModelError(f"[commands.{name}]: {error}") from error
        for i, one in enumerate(actuators):
            if one in taken or one in actuators[:i]:
                raise ModelError(f"[commands.{name}] has actuator {names[i]!r}, which has a command already")
        taken |= set(actuators)
        unit = entry.get("unit")
        if not isinstance(unit, str | None):
            raise ModelError(f"[commands.{name}] unit is {unit!r}; expected a text")
        label = f"[commands.{name}]"
        left_out = number(f"{label} leave_out", entry.get("leave_out", 0.0), 0.0, _LONGEST)
        found.append(Command(name, actuators, unit, widen_all or widened(label, entry), left_out))
    return found


def widened(section: str, entry: dict[str, Any]) -> bool:
    """Whether a section lets commands exceed the ranges of actuators."""
    if (value := entry.get("ctrlrange", _WIDEN)) != _WIDEN:
        raise ModelError(f'{section} ctrlrange is {value!r}; expected "{_WIDEN}", or nothing where the model clips')
    return "ctrlrange" in entry


def fixed_of(model: mujoco.MjModel, table: dict[str, Any], commands: list[Command]) -> dict[int, float]:
    """The constant controls of the mapping, by MuJoCo's id of the actuator; a name may have a star."""
    found: dict[int, float] = {}
    driven = {i for command in commands for i in command.actuators}
    for name, value in table.items():
        constant = number(f"[fixed] {name}", value, -1e9, 1e9)
        names = [name_of(model, _ACTUATOR, i) for i in range(model.nu)]
        ids = [i for i, one in enumerate(names) if "*" in name and fnmatchcase(one, name)]
        for i in ids or [element(model, _ACTUATOR, name)]:
            low, high = model.actuator_ctrlrange[i]
            if i in driven or i in found:
                raise ModelError(f"[fixed] {name}: actuator {names[i]} has a command or a control already")
            if model.actuator_ctrllimited[i] and not low <= constant <= high:
                raise ModelError(f"[fixed] {name} is {constant:g}; its ctrlrange is {low:g} to {high:g}")
            found[i] = constant
    return found


def check_unit(command: Signal, name: str, unit: str | None) -> None:
    """Refuse a command in another unit than ``unit``, by default the SI unit of its own.

    Raises:
        RecordingError: it is in another one.
    """
    expected = unit or UNITS.get(command.unit, (command.unit,))[0]
    if command.unit != expected:
        raise RecordingError(f"the command {name!r} is in {command.unit!r}; expected is {expected!r}")


def beyond(model: mujoco.MjModel, actuator: int, asked: Floats, tolerance: float) -> Bools:
    """(T,) whether MuJoCo clips the setpoints (T,) of an actuator.

    Args:
        tolerance: share of the actuator's range by which it may be exceeded.
    """
    low, high = model.actuator_ctrlrange[actuator]
    if not model.actuator_ctrllimited[actuator] or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        return np.zeros(len(asked), bool)
    return np.asarray(np.maximum(low - asked, asked - high) > tolerance * (high - low))
