"""Any robot: a MuJoCo model, and a TOML file that says how its recordings and its parameters belong to it.

[robot]
control_timestep = 0.02           # s, how long a command is held
settle = 1.0                      # s with the first command before a recording begins; none by default
accurate = "finer.xml"            # a more accurate model with the same names, if there is one

[commands.goal]                   # a command of the recordings, one column for each actuator
actuators = ["motor"]

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

[parameters.inertia]              # fields that are scaled together, or with add = true and a unit shifted
fields = ["body_mass:arm", "body_inertia:arm"]  # a star in a name is for any text: "site_pos[0]:hole_*"
deviation = 0.3                   # of the prior: of the logarithm, or in the unit
"""

import re
import tomllib
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import mujoco
import numpy as np

from soro_bench.diagnosis.robot import SIMULATIONS, Earlier, Prior, Robot
from soro_bench.effects.elements import instrument
from soro_bench.models.simulation import FieldWrite, Simulation
from soro_bench.parameters import Parameter, ParameterSet
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.untrusted import read_bytes

_MAX_BYTES = 1_000_000
_MOST_STEPS = 100_000
_LARGE = 1e6  # of a signal, in its unit: the simulation has diverged
_SECTIONS = {
    "robot": ("control_timestep", "settle", "accurate"),
    "commands": None,
    "signal": ("name", "sites", "joints", "sensors", "unit", "frame"),
    "initial": ("joints",),
    "settings": None,
    "parameters": None,
}
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
_WIDTH = {"mjJNT_FREE": 6, "mjJNT_BALL": 3}  # degrees of freedom of a joint; others have one
# degrees of freedom of all simulations side by side, where these are more than SIMULATIONS then, and these at most: a
# time step of a small model costs less than what calls it
_FREEDOM, _MOST_SIMULATIONS = 2000, 256
_SHARE = 0.3  # of an actuator's range, how far a proposed motion goes
_FAR = 100.0  # deviations, the bounds of a parameter that is added


class ModelError(ValueError):
    """A model or its mapping cannot be used; says what is wrong and what is allowed."""


@dataclass(frozen=True)
class _Entry:
    """One field that a parameter changes: some rows of it, in one column or all."""

    field: str
    rows: np.ndarray
    column: int | None


@dataclass(frozen=True)
class _Setting:
    """What is known of a recording: a number of its metadata, or a command of one column. It has the value 1 where the
    number is the reference."""

    metadata: str | None
    command: str | None
    reference: float

    def values(self, recording: Recording, times: np.ndarray) -> np.ndarray:
        """(T,) values at times [s]; RecordingError says what the recording lacks."""
        if self.command:
            return _held(recording, self.command, times, 1)[:, 0] / self.reference
        text = recording.metadata.get(self.metadata)
        try:
            return np.full(len(times), float(text) / self.reference)
        except (TypeError, ValueError) as error:
            message = f"metadata {self.metadata!r} of the recording is {text!r}; a number is needed"
            raise RecordingError(message) from error


class _Fields:
    """Parameters and settings as changes of model fields."""

    def __init__(self, model, entries: dict[str, list[_Entry]], added: set[str]):
        self._model, self._entries, self._added = model, entries, added

    def writes(self, params):
        """The changed fields, each with all its changes."""
        found: dict[str, np.ndarray] = {}
        for name, entries in self._entries.items():
            for entry in entries:
                own = getattr(self._model, entry.field)
                values = found.setdefault(entry.field, np.repeat(own[None], len(params[name]), axis=0))
                at = (slice(None), entry.rows) if entry.column is None else (slice(None), entry.rows, entry.column)
                by = params[name].reshape(-1, *[1] * (values[at].ndim - 1))
                values[at] = values[at] + by if name in self._added else values[at] * by
        return [FieldWrite(field, np.arange(values.shape[1]), values) for field, values in found.items()]


class ModelRobot(Robot):
    """A robot from a MuJoCo model.

    Args:
        model: MJCF file.
        mapping: TOML file, as this module describes it.
        threads: 0 for all processors; results do not depend on it.
        shorter: how many times shorter the model's time step is made.
        earlier: what is known of the robot from an earlier diagnosis.

    Raises:
        ModelError: says what is wrong with either file.
    """

    kinds = ("tendon", "joint", "actuator", "body", "model")

    def __init__(
        self, model: str | Path, mapping: str | Path, threads: int = 0, shorter: int = 1, earlier: Earlier | None = None
    ):
        self._paths, self.threads, self._earlier = (Path(model), Path(mapping)), threads, earlier
        table = _table(mapping)
        self.name = self.model_name = Path(model).stem
        compiled = _compiled(model)
        self._model = compiled
        compiled.opt.timestep /= shorter
        settings = table["robot"]
        self.control_timestep = _number("[robot] control_timestep", settings.get("control_timestep"), 1e-5, 100.0)
        self._substeps = round(self.control_timestep / compiled.opt.timestep)
        if self._substeps < 1 or abs(self._substeps * compiled.opt.timestep / self.control_timestep - 1) > 1e-6:
            raise ModelError(f"control_timestep {self.control_timestep} s is no multiple of {compiled.opt.timestep} s")
        self._settle = round(_number("[robot] settle", settings.get("settle", 0.0), 0, 1e4) / self.control_timestep)
        self._accurate = settings.get("accurate")
        self._commands = [
            (name, [_id(compiled, mujoco.mjtObj.mjOBJ_ACTUATOR, each) for each in _names(f"commands.{name}", entry,
                                                                                         "actuators")])
            for name, entry in table["commands"].items()
        ]  # fmt: skip
        self._set_signal(table["signal"])
        self._initial = [_joint(compiled, name) for name in table["initial"].get("joints", [])]
        if self._initial and len(self._initial) != self.shape[0] * self.shape[1]:
            raise ModelError(f"[initial] has {len(self._initial)} joints; the signal has samples of shape {self.shape}")
        self._settings, scaled = _settings(compiled, table["settings"])
        self.priors, fields = _parameters(compiled, table["parameters"], scaled)
        known = [Prior(name, "1", 1.0, 1.0, True, (0.0, np.inf)) for name in scaled]
        parameters = [Parameter(p.name, p.unit, p.nominal, p.bounds, p.bounds, "") for p in (*self.priors, *known)]
        count = min(max(_FREEDOM // max(compiled.nv, 1), SIMULATIONS), _MOST_SIMULATIONS)
        self.simulation = Simulation(compiled, ParameterSet(*parameters), [fields], count, threads, ())
        self._bad = np.zeros(count, int)
        self._remember(earlier)

    def shortened(self, factor: int) -> Robot:
        """The same model with shorter time steps."""
        return ModelRobot(*self._paths, self.threads, factor, self._earlier)

    def accurate(self) -> list[Robot]:
        """By the model that the mapping calls accurate, if it does."""
        if self._accurate is None:
            return []
        mapping = self._paths[1]
        return [ModelRobot(mapping.parent / self._accurate, mapping, self.threads, earlier=self._earlier)]

    def spec(self) -> mujoco.MjSpec:
        """The model of the file, with what effects need."""
        return _spec(self._paths[0])

    def actions(self, recording: Recording) -> np.ndarray:
        """(T, nu) setpoints of all actuators; those that no command names are zero."""
        steps = int(np.ceil(recording.duration / self.control_timestep - 1e-6))
        if not 1 <= steps <= _MOST_STEPS:
            raise RecordingError(f"{recording.duration} s are {steps} control steps; expected 1 to {_MOST_STEPS}")
        actions = np.zeros((steps, self._model.nu))
        for name, actuators in self._commands:
            actions[:, actuators] = _held(recording, name, self._times(recording, steps), len(actuators))
        return actions

    def settings(self, recording: Recording, steps: int) -> np.ndarray | None:
        """(steps, S) of the mapping's settings, as multiples of their references."""
        times = self._times(recording, steps)
        return np.stack([s.values(recording, times) for s in self._settings], axis=1) if self._settings else None

    def _times(self, recording, steps):
        """(steps,) s, the beginnings of the control steps."""
        return recording.start + self.control_timestep * np.arange(steps)

    def commanded(self, rates: np.ndarray) -> np.ndarray:
        """(T, nu) setpoints that go the way of rates (T, nu), within a share of each actuator's range."""
        way, model = np.cumsum(rates, axis=0), self._model
        low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, (-1.0, 1.0)).T
        return np.clip(way / max(np.abs(way).max(), 1e-9) * _SHARE * (high - low), low, high)

    def _set_signal(self, table):
        model, places = self._model, [key for key in ("sites", "joints", "sensors") if key in table]
        if len(places) != 1 or not isinstance(table.get("name"), str) or not isinstance(table.get("unit"), str):
            raise ModelError("[signal] needs a name, a unit, and one of sites, joints, sensors")
        self.signal, self.unit, self.frame = table["name"], table["unit"], table.get("frame", "")
        names = _names("signal", table, places[0])
        if places[0] == "sites":
            self._source, self._ids = "site_xpos", [_id(model, mujoco.mjtObj.mjOBJ_SITE, name) for name in names]
            self.shape = (len(names), 3)
        elif places[0] == "joints":
            self._source, self._ids = "qpos", [model.jnt_qposadr[_joint(model, name)] for name in names]
            self.shape = (len(names), 1)
        else:
            sensors = [_id(model, mujoco.mjtObj.mjOBJ_SENSOR, name) for name in names]
            if len(widths := {int(model.sensor_dim[i]) for i in sensors}) > 1:
                raise ModelError(f"[signal] sensors {', '.join(names)} have {sorted(widths)} numbers; all need as many")
            if (model.sensor_needstage[sensors] > mujoco.mjtStage.mjSTAGE_VEL).any():
                raise ModelError("[signal] sensors have to depend on positions and velocities only")
            self._source, (width,) = "sensordata", widths
            self._ids = np.concatenate([model.sensor_adr[i] + np.arange(width) for i in sensors])
            self.shape = (len(names), width)

    def _begin(self, parameters, start):
        ids = np.arange(len(parameters))
        batch = self.simulation.batch
        self._set_all(ids, parameters, np.ones((len(ids), len(self._settings))))
        batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        if self._initial and start is not None:
            batch.qpos[np.ix_(ids, self._model.jnt_qposadr[self._initial])] = start.reshape(len(ids), -1)
        self.simulation.begin(ids)
        self._bad[ids], self._settled = self.simulation.bad_states(ids), False

    def _set(self, ids, settings):
        if len(ids):
            self._set_all(ids, self.simulation.params[ids, : len(self.priors)], settings)

    def _set_all(self, ids, parameters, settings):
        self.simulation.set_params(ids, np.hstack([parameters, settings]))

    def _step(self, actions):
        ids = np.arange(len(actions))
        self.simulation.batch.ctrl[ids] = actions
        for _ in range(1 if self._settled else 1 + self._settle):
            self.simulation.step(ids, self._substeps)
        self._settled = True
        return self.simulation.bad_states(ids) > self._bad[ids]

    def _read(self, count):
        values = getattr(self.simulation.batch, self._source)[:count, self._ids].reshape(count, *self.shape)
        return np.where(np.abs(values) < _LARGE, values, np.nan)


def _table(path) -> dict:
    """The mapping, checked for its sections and entries; those left out are empty."""
    try:
        table = tomllib.loads(read_bytes(path, _MAX_BYTES).decode())
    except ValueError as error:
        raise ModelError(f"{path} is no TOML file: {error}") from error
    _check_keys(str(path), table, tuple(_SECTIONS))
    for section, allowed in _SECTIONS.items():
        entries = table.setdefault(section, {})
        if not isinstance(entries, dict):
            raise ModelError(f"{section} has to be a section, [{section}]")
        if allowed is not None:
            _check_keys(f"[{section}]", entries, allowed)
    return table


def _spec(path) -> mujoco.MjSpec:
    return instrument(mujoco.MjSpec.from_file(str(path)))


def _compiled(path) -> mujoco.MjModel:
    """The model, with what effects need."""
    if not Path(path).is_file():
        raise ModelError(f"there is no model {path}")
    try:
        return _spec(path).compile()
    except ValueError as error:
        raise ModelError(f"{path} is no MuJoCo model: {error}") from error


def _held(recording, name, times, columns) -> np.ndarray:
    """(T, columns) the last numbers of a command until each of the times [s], or the first ones."""
    if name not in recording.commands:
        raise RecordingError(f"the recording has no command {name!r}; it has {sorted(recording.commands)}")
    command = recording.commands[name]
    values = command.values.reshape(len(command.time), -1)
    if values.shape[1] != columns:
        raise RecordingError(f"command {name!r} has {values.shape[1]} columns; expected {columns}")
    held = values[np.maximum(np.searchsorted(command.time, times + 1e-9, side="right") - 1, 0)]
    if np.isnan(held).any():
        raise RecordingError(f"the command {name!r} has missing numbers")
    return held


def _settings(model, table) -> tuple[list[_Setting], dict[str, list[_Entry]]]:
    """Settings, and the fields that each of them scales."""
    settings, entries = [], {}
    for name, entry in table.items():
        label = f"[settings.{name}]"
        if not isinstance(entry, dict):
            raise ModelError(f"{label} has to be a section")
        _check_keys(label, entry, _SETTING)
        source = [entry[key] for key in ("metadata", "command") if key in entry]
        if len(source) != 1 or not isinstance(source[0], str):
            raise ModelError(f"{label} needs either metadata or command, the name of one")
        reference = _number(f"{label} reference", entry.get("reference", 1.0), 1e-9, 1e9)
        settings.append(_Setting(entry.get("metadata"), entry.get("command"), reference))
        entries[name] = [_entry(model, label, text) for text in _names(f"settings.{name}", entry, "fields")]
    return settings, entries


def _parameters(model, table, scaled: dict[str, list[_Entry]]) -> tuple[tuple[Prior, ...], _Fields]:
    """Priors, and what they and the settings, whose fields are ``scaled``, change."""
    priors, entries, added = [], dict(scaled), set()
    for name, entry in table.items():
        label = f"[parameters.{name}]"
        if not isinstance(entry, dict):
            raise ModelError(f"{label} has to be a section")
        _check_keys(label, entry, _PARAMETER)
        if name in scaled:
            raise ModelError(f"{label} has the name of a setting")
        deviation = _number(f"{label} deviation", entry.get("deviation"), 1e-9, 1e9)
        entries[name] = [_entry(model, label, text) for text in _names(f"parameters.{name}", entry, "fields")]
        if entry.get("add", False):
            added.add(name)
            bounds = (-_FAR * deviation, _FAR * deviation)
            priors.append(Prior(name, str(entry.get("unit", "1")), 0.0, deviation, False, bounds))
        else:
            priors.append(Prior(name, "1", 1.0, deviation, True, (1e-3, 1e3)))
    if not priors:
        raise ModelError("the mapping has no [parameters.<name>]; a diagnosis fits at least one")
    return tuple(priors), _Fields(model, entries, added)


def _entry(model, label, text) -> _Entry:
    """What "field[column]:element" means."""
    match = _FIELD.fullmatch(text)
    kind = match["field"].split("_")[0] if match else ""
    if not match or kind not in _OBJECTS or not hasattr(model, match["field"]):
        raise ModelError(f"{label} has {text!r}; expected field:element of {', '.join(_OBJECTS)}: body_mass:arm")
    field, column = getattr(model, match["field"]), match["column"] and int(match["column"])
    if column is not None and (field.ndim < 2 or column >= field.shape[1]):
        raise ModelError(f"{label}: {match['field']} has no column {column}; its shape is {field.shape}")
    if match["element"] == "*":
        return _Entry(match["field"], np.arange(len(field)), column)
    count = model.njnt if kind == "dof" else len(field)
    numbers = _matching(model, kind, count, match["element"], label)
    if kind == "dof":
        widths = [_WIDTH.get(mujoco.mjtJoint(model.jnt_type[i]).name, 1) for i in numbers]
        numbers = [model.jnt_dofadr[i] + k for i, width in zip(numbers, widths, strict=True) for k in range(width)]
    return _Entry(match["field"], np.array(numbers), column)


def _matching(model, kind, count, name, label) -> list[int]:
    """MuJoCo's numbers of the element with a name, or of those, of ``count``, that match one with a star in it."""
    if "*" not in name:
        return [_id(model, _OBJECTS[kind], name)]
    names = [mujoco.mj_id2name(model, _OBJECTS[kind], i) for i in range(count)]
    if not (found := [i for i, each in enumerate(names) if each and fnmatchcase(each, name)]):
        raise ModelError(f"{label}: no {kind} of the model is called {name!r}")
    return found


def _id(model, kind, name) -> int:
    """MuJoCo's number of an element."""
    if not isinstance(name, str) or (number := mujoco.mj_name2id(model, kind, name)) < 0:
        raise ModelError(f"the model has no {kind.name[6:].lower()} {name!r}")
    return number


def _joint(model, name) -> int:
    """MuJoCo's number of a joint with one degree of freedom."""
    number = _id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    if mujoco.mjtJoint(model.jnt_type[number]).name in _WIDTH:
        raise ModelError(f"joint {name!r} has several degrees of freedom; one is needed")
    return number


def _names(label, entry, key) -> list[str]:
    values = entry.get(key) if isinstance(entry, dict) else None
    if not isinstance(values, list) or not values or not all(isinstance(value, str) for value in values):
        raise ModelError(f"[{label}] {key} is {values!r}; expected a list of names")
    return values


def _number(label, value, low, high) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise ModelError(f"{label} is {value!r}; expected a number from {low:g} to {high:g}")
    return float(value)


def _check_keys(label, table, allowed) -> None:
    for key in table:
        if key not in allowed:
            raise ModelError(f"unknown entry {key!r} in {label}; there are {', '.join(allowed)}")
