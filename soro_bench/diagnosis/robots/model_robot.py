"""Any robot: a MuJoCo model, and a mapping of its recordings and parameters to it (robot_map.py)."""

from operator import attrgetter
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.priors import Baseline, Prior
from soro_bench.diagnosis.robots.robot import SIMULATIONS, Robot
from soro_bench.diagnosis.robots.robot_map import (
    ModelError,
    accurate_of,
    check_unit,
    commands_of,
    element,
    held,
    joint,
    names_of,
    number,
    parameters_of,
    read_mapping,
    settings_of,
)
from soro_bench.diagnosis.settings import RobotSettings
from soro_bench.effects.elements import instrument
from soro_bench.models.simulation import Simulation
from soro_bench.parameters import Parameter, ParameterSet
from soro_bench.recording.recording import Recording, RecordingError, Signal

_MOST_STEPS = 100_000  # of a recording; bounds the memory of its replays
_TIMESTEPS = 1e-6, 1.0  # s, least and longest of a model
_SETTINGS = RobotSettings()


class ModelRobot(Robot):
    """A robot from a MuJoCo model.

    Args:
        model: MJCF file.
        mapping: TOML file, as ``robot_map.py`` describes it.
        threads: 0 for all processors; results do not depend on it.
        shorter: how many times shorter the model's time step is made.
        baseline: result of a baseline diagnosis of the same robot.

    Raises:
        ModelError: says what is wrong with either file.
    """

    kinds = ("tendon", "joint", "actuator", "body", "flex", "geom", "model")

    def __init__(
        self,
        model: str | Path,
        mapping: str | Path,
        threads: int = 0,
        shorter: int = 1,
        baseline: Baseline | None = None,
    ):
        self._paths, self.threads, self._baseline = (Path(model), Path(mapping)), threads, baseline
        self.shorter = shorter
        table = read_mapping(mapping)
        self.name = self.model_name = Path(model).stem
        compiled = _compiled(model)
        self._model = compiled
        compiled.opt.timestep /= shorter
        settings = table["robot"]
        self.control_timestep = number("[robot] control_timestep", settings.get("control_timestep"), 1e-5, 100.0)
        self._substeps = round(self.control_timestep / compiled.opt.timestep)
        if self._substeps < 1 or abs(self._substeps * compiled.opt.timestep / self.control_timestep - 1) > 1e-6:
            raise ModelError(f"control_timestep {self.control_timestep} s is no multiple of {compiled.opt.timestep} s")
        self.settling = round(number("[robot] settle", settings.get("settle", 0.0), 0, 1e4) / self.control_timestep)
        self._accurate = accurate_of(settings, mapping)
        self._commands = commands_of(compiled, table["commands"])
        self._set_signal(table["signal"])
        wanted = names_of("initial", table["initial"], "joints") if table["initial"] else []
        self._initial = [joint(compiled, name) for name in wanted]
        if self._initial and len(self._initial) != self.shape[0] * self.shape[1]:
            raise ModelError(f"[initial] has {len(self._initial)} joints; the signal has samples of shape {self.shape}")
        self._settings, scaled = settings_of(compiled, table["settings"])
        self.priors, fields = parameters_of(compiled, table["parameters"], scaled)
        known = [Prior(name, "1", 1.0, 1.0, True, (0.0, np.inf)) for name in scaled]
        parameters = [Parameter(p.name, p.unit, p.nominal, p.bounds, p.bounds, "") for p in (*self.priors, *known)]
        many = max(_SETTINGS.degrees_of_freedom // max(compiled.nv, 1), SIMULATIONS)
        count = min(many, _SETTINGS.most_simulations)
        self.simulation = Simulation(compiled, ParameterSet(*parameters), [fields], count, threads, ())
        self._remember(baseline)

    def shortened(self, factor: int) -> Robot:
        """The same model with time steps shorter by a factor."""
        return ModelRobot(*self._paths, self.threads, factor, self._baseline)

    def accurate(self) -> Robot | None:
        """The same robot by the accurate model of the mapping, if there is one."""
        if self._accurate is None:
            return None
        return ModelRobot(self._accurate, self._paths[1], self.threads, baseline=self._baseline)

    def spec(self) -> mujoco.MjSpec:
        """The model of the file, prepared for effects."""
        return _spec(self._paths[0])

    def actions(self, recording: Recording) -> Floats:
        """(T, nu) setpoints of all actuators, zero for those without a command.

        Raises:
            RecordingError: says what is wrong with the commands.
        """
        _, steps = recording.control_steps(self._named, self.control_timestep)
        if not 1 <= steps <= _MOST_STEPS:
            raise RecordingError(f"{recording.duration} s are {steps} control steps; expected 1 to {_MOST_STEPS}")
        actions = np.zeros((steps, self._model.nu))
        for name, actuators, unit in self._commands:
            actions[:, actuators] = held(recording, name, self._times(recording, steps), len(actuators))
            check_unit(recording.commands[name], name, unit)
            self._check_rate(name, recording.commands[name])
            for actuator in actuators:
                self._check_range(name, actuator, actions[:, actuator])
        return actions

    def _check_rate(self, name: str, command: Signal) -> None:
        """Refuse control steps so long that they leave out most of a command: that would be taken for physics."""
        values = command.values.reshape(len(command.time), -1)
        changed = command.time[1:][(np.diff(values, axis=0) != 0).any(axis=1)]
        every = float(np.median(np.diff(changed))) if len(changed) > 1 else np.inf
        if self.control_timestep > _SETTINGS.command_changes * every * (1 + 1e-6):
            raise RecordingError(
                f"the command {name!r} changes every {every:.3g} s; a control_timestep of {self.control_timestep:g} s "
                f"leaves most of it out; allowed is {_SETTINGS.command_changes} times as long"
            )

    def _check_range(self, command: str, actuator: int, asked: Floats) -> None:
        """Refuse setpoints (T,) that MuJoCo would cut off."""
        model, (low, high) = self._model, self._model.actuator_ctrlrange[actuator]
        beyond = max(low - asked.min(), asked.max() - high)
        if model.actuator_ctrllimited[actuator] and beyond > _SETTINGS.range_tolerance * (high - low):
            raise RecordingError(
                f"the command {command!r} is from {asked.min():g} to {asked.max():g}; the model cuts off what is not "
                f"within the ctrlrange of actuator {model.actuator(actuator).name!r}, {low:g} to {high:g}"
            )

    def settings(self, recording: Recording, steps: int) -> Floats | None:
        """(steps, S) values of the mapping's settings, as multiples of their references; None without settings."""
        times = self._times(recording, steps)
        return np.stack([s.values(recording, times) for s in self._settings], axis=1) if self._settings else None

    def begins(self, recording: Recording) -> float:
        """When the first command of the mapping begins [s]."""
        return recording.control_steps(self._named, self.control_timestep)[0]

    def _setpoint_unit(self, actuator: int) -> str:
        """The unit of the mapping's command, or the one that the model implies if the mapping names none."""
        named = next((unit for _, actuators, unit in self._commands if actuator in actuators), None)
        return named or super()._setpoint_unit(actuator)

    @property
    def _named(self) -> list[str]:
        """Names of the commands."""
        return [name for name, _, _ in self._commands]

    def _times(self, recording: Recording, steps: int) -> Floats:
        """(steps,) s, the beginnings of the control steps."""
        return np.asarray(self.begins(recording) + self.control_timestep * np.arange(steps), float)

    def measured(self, recording: Recording) -> Measured:
        """The part of a recording that a diagnosis uses.

        Raises:
            RecordingError: as of any robot; or the robot begins at the signal, and its first sample is missing or late.
        """
        found = super().measured(recording)
        if self._initial and found.start is not None and not np.isfinite(found.start).all():
            raise RecordingError(f"the first sample of {self.signal} has gaps; [initial] needs all of it")
        later = float(recording.signals[self.signal].time[0]) - self.begins(recording)
        if self._initial and later > self.control_timestep * (1 + 1e-6):
            raise RecordingError(
                f"the first sample of {self.signal} is {later:g} s after the recording begins; [initial] needs one "
                f"within a control step, {self.control_timestep:g} s"
            )
        return found

    def rates(self, actions: Floats) -> Floats:
        """(T, nu) changes of setpoints in a control step, as shares of the largest; controls, where they are rates."""
        moved = np.diff(actions, axis=0, prepend=actions[:1])
        shares = moved / np.maximum(np.abs(moved).max(axis=0), 1e-12)
        return np.where(self._model.actuator_dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR, actions, shares)

    def commanded(self, rates: Floats, recorded: Floats) -> Floats:
        """(T, nu) setpoints with given rates (T, nu), or controls with them where controls are rates.

        They stay within a share of each actuator's range on both sides of zero, or of the value nearest to it. An
        actuator without a range has that of the recorded setpoints.
        """
        way, model = np.cumsum(rates, axis=0), self._model
        integrates = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR
        limited = np.where(integrates, model.actuator_actlimited, model.actuator_ctrllimited).astype(bool)
        ranges = np.where(integrates[:, None], model.actuator_actrange, model.actuator_ctrlrange)
        been = np.where(integrates, np.cumsum(recorded, axis=0) * self.control_timestep, recorded)
        low, high = np.where(limited, ranges.T, (been.min(axis=0), been.max(axis=0)))
        reach = _SETTINGS.test_range * (high - low)
        moved = way / max(np.abs(way).max(), 1e-9) * reach
        speeds = np.diff(moved, axis=0, prepend=0.0) / self.control_timestep
        bounds = np.abs(model.actuator_ctrlrange).min(axis=1)
        fastest = np.where(model.actuator_ctrllimited, bounds, np.abs(recorded).max(axis=0))
        slower = np.maximum(np.abs(speeds).max(axis=0) / np.maximum(fastest, 1e-9), 1.0)
        return np.where(integrates, speeds / slower, np.clip(0.0, low + reach, high - reach) + moved)

    def _set_signal(self, table: dict[str, Any]) -> None:
        """Look up the signal of the mapping in the model.

        Raises:
            ModelError: says what is wrong.
        """
        model, places = self._model, [key for key in ("sites", "joints", "sensors") if key in table]
        if len(places) != 1 or not isinstance(table.get("name"), str) or not isinstance(table.get("unit"), str):
            raise ModelError("[signal] needs a name, a unit, and one of sites, joints, sensors")
        self.signal, self.unit, self.frame = table["name"], table["unit"], table.get("frame", "")
        names = names_of("signal", table, places[0])
        self._ids: list[int] | Ints  # of the signal's numbers in its field of MuJoCo's data
        if places[0] == "sites":
            self._source, self._ids = "site_xpos", [element(model, mujoco.mjtObj.mjOBJ_SITE, name) for name in names]
            self.shape = (len(names), 3)
        elif places[0] == "joints":
            self._source, self._ids = "qpos", [model.jnt_qposadr[joint(model, name)] for name in names]
            self.shape = (len(names), 1)
        else:
            sensors = [element(model, mujoco.mjtObj.mjOBJ_SENSOR, name) for name in names]
            if len(widths := {int(model.sensor_dim[i]) for i in sensors}) > 1:
                raise ModelError(f"[signal] sensors {', '.join(names)} have {sorted(widths)} numbers; all need as many")
            if max(widths) > 3:
                raise ModelError(f"[signal] sensors {', '.join(names)} have {max(widths)} numbers; allowed are 1 to 3, "
                                 "coordinates")  # fmt: skip
            if (model.sensor_needstage[sensors] > int(mujoco.mjtStage.mjSTAGE_VEL)).any():
                raise ModelError("[signal] sensors have to depend on positions and velocities only")
            self._source, (width,) = "sensordata", widths
            self._ids = np.concatenate([model.sensor_adr[i] + np.arange(width) for i in sensors])
            self.shape = (len(names), width)

    def _begin(self, parameters: Floats, start: Floats | None) -> None:
        """Start the simulations; see :meth:`Robot._begin`."""
        ids = np.arange(len(parameters))
        batch = self.simulation.batch
        self._set_all(ids, parameters, np.ones((len(ids), len(self._settings))))
        batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        if self._initial and start is not None:
            batch.qpos[np.ix_(ids, self._model.jnt_qposadr[self._initial])] = start.reshape(len(ids), -1)
        self.simulation.begin(ids)

    def _set(self, ids: Ints, settings: Floats) -> None:
        """Give simulations their settings; their parameters stay."""
        if len(ids):
            self._set_all(ids, self.simulation.params[ids, : len(self.priors)], settings)

    def _set_all(self, ids: Ints, parameters: Floats, settings: Floats) -> None:
        """Give simulations ``ids`` (n,) parameters (n, d) and settings (n, S)."""
        self.simulation.set_params(ids, np.hstack([parameters, settings]))

    def _step(self, actions: Floats) -> Bools:
        """Advance the simulations by a control step; (n,) whether each diverged."""
        ids = np.arange(len(actions))
        self.simulation.batch.ctrl[ids] = actions
        self.simulation.step(ids, self._substeps)
        return self.simulation.bad_states(ids)

    def _read(self, count: int) -> Floats:
        """(count, P, D) the signal now."""
        values = getattr(self.simulation.batch, self._source)[:count, self._ids].reshape(count, *self.shape)
        return np.where(np.abs(values) < _SETTINGS.diverged, values, np.nan)


def _spec(path: str | Path) -> mujoco.MjSpec:
    """The model of a file with absolute paths of its files, prepared for effects."""
    spec, folder = mujoco.MjSpec.from_file(str(path)), Path(path).resolve().parent
    # a patched model, which lies elsewhere, finds the same files
    if spec.meshes or spec.hfields or spec.skins:
        spec.meshdir = str(folder / spec.meshdir)
    if spec.textures:
        spec.texturedir = str(folder / spec.texturedir)
    return instrument(_named(spec, Path(path).stem))


def _named(spec: mujoco.MjSpec, model: str) -> mujoco.MjSpec:
    """The spec with names for elements without one, since effects need names; each model gets other names.

    Joints of a flex's vertices are not named: no effect acts on one alone.
    """
    vertices = {name for flex in spec.flexes for name in (*flex.vertbody, *flex.nodebody)}
    joints = [joint for joint in spec.joints if joint.parent.name not in vertices]
    for elements in (spec.tendons, joints, spec.actuators, spec.bodies):
        for i, one in enumerate(elements):
            one.name = one.name or f"{i} of {model}"
    return spec


def _compiled(path: str | Path) -> mujoco.MjModel:
    """The model of a file, prepared for effects.

    Raises:
        ModelError: it is none, or has values that cannot be simulated.
    """
    if not Path(path).is_file():
        raise ModelError(f"there is no model {path}")
    try:
        model = _spec(path).compile()
    except ValueError as error:
        raise ModelError(f"{path} is no MuJoCo model: {error}") from error
    for field in MODEL_FIELDS:
        if np.isnan(attrgetter(field)(model)).any():  # MuJoCo only warns
            raise ModelError(f"{path}: {field} is not a number somewhere")
    low, high = _TIMESTEPS
    if not low <= model.opt.timestep <= high:
        raise ModelError(f"{path}: timestep is {model.opt.timestep} s; allowed is {low:g} to {high:g} s")
    return model
