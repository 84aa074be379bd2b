"""Any robot: a MuJoCo model, and a mapping of its recordings and parameters to it (robot_map.py)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from gymnasium.spaces import Box

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.diagnosis.robots.map_parameters import Entry, held, parameters_of, settings_of
from soro_bench.diagnosis.robots.measured import Drive, Measured, ObservedSignal
from soro_bench.diagnosis.robots.model_file import (
    Model,
    ModelError,
    load_model,
    load_spec,
    name_of,
    number,
    source_files,
    title,
)
from soro_bench.diagnosis.robots.model_state import initial_state, signal_sources, unused_keyframes
from soro_bench.diagnosis.robots.priors import Baseline, Prior
from soro_bench.diagnosis.robots.replays import SIMULATIONS
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.robots.robot_map import (
    accurate_of,
    beyond,
    check_unit,
    commands_of,
    fixed_of,
    read_mapping,
    time_steps,
    widened,
)
from soro_bench.diagnosis.settings import RobotSettings
from soro_bench.effects.effect import Effect
from soro_bench.models.simulation import ParameterMap, Simulation, quiet
from soro_bench.parameters import Parameter, ParameterSet
from soro_bench.recording.excitation import excitation
from soro_bench.recording.known import Known
from soro_bench.recording.recording import Recording, RecordingError, Signal

_MOST_STEPS = 100_000  # of a recording; bounds the memory of its replays
_MOST_SIMULATIONS, _MOST_FREEDOMS = 256, 2000  # side by side, and degrees of freedom of all of them
_DIVERGED = 1e6  # unit of the signal, of a simulation that has diverged
_MOST_NAMES = 10  # in a note
_SETTINGS = RobotSettings()
_NOTHING = Known()


class ModelRobot(Robot):
    """A robot from a MuJoCo model.

    Args:
        model: MJCF file, or a spec, which stays as it is.
        mapping: TOML file, as ``robot_map.py`` describes it, or its content.
        threads: 0 for all processors; results do not depend on it.
        shorter: how many times shorter the model's time step is made.
        baseline: result of a baseline diagnosis of the same robot.
        known: parameters that are known.
        patched: whether the model is one that a diagnosis wrote: an effect may have taken all that a parameter scales.

    Raises:
        ModelError: says what is wrong with either of them.
    """

    kinds = ("tendon", "joint", "actuator", "body", "flex", "geom", "model")

    def __init__(
        self,
        model: Model,
        mapping: str | Path | Mapping[str, Any],
        threads: int = 0,
        shorter: int = 1,
        baseline: Baseline | None = None,
        known: Known = _NOTHING,
        patched: bool = False,
    ):
        self._patched = patched
        self._sources, self.threads, self._baseline = (model, mapping), threads, baseline
        self._known_parameters = known
        self.shorter = shorter
        table = read_mapping(mapping)
        self.files = source_files(model, mapping)
        self.name = self.model_name = title(model)
        settings = table["robot"]
        with quiet():
            self._model = compiled = load_model(model, shorter)
        self.control_timestep = number("[robot] control_timestep", settings.get("control_timestep"), 1e-5, 100.0)
        steps, self._timestep = time_steps(self.control_timestep, own := compiled.opt.timestep)
        self._substeps, compiled.opt.timestep = steps * shorter, self._timestep / shorter
        self.settling = round(number("[robot] settle", settings.get("settle", 0.0), 0, 1e4) / self.control_timestep)
        if not isinstance(relax := settings.get("relax", False), bool):
            raise ModelError(f"[robot] relax is {relax!r}; expected true or false")
        self.relaxing = relax
        self._accurate = accurate_of(settings, mapping)
        self._commands = commands_of(compiled, table["commands"], widened("[robot]", settings))
        self._widened = [i for command in self._commands if command.widened for i in command.actuators]
        compiled.actuator_ctrllimited[self._widened] = False
        fixed = fixed_of(compiled, table["fixed"], self._commands)
        if compiled.nu and not self._commands and not fixed:
            raise ModelError(
                "the mapping has no [commands.<name>], and the model has actuators; say what moves them, or give "
                "constant controls in [fixed]"
            )
        (first, *others), self._signals = signal_sources(compiled, table["signal"], table["signals"])
        self.signal, self.unit, self.frame, self.shape = first.name, first.unit, first.frame, first.shape
        self.others = tuple(others)
        self._stage = max(each.stage for each in self._signals.values())
        self._initial = initial_state(compiled, table["initial"], self._signals[self.signal], self.signal)
        self._control = self._initial.control
        self._control[list(fixed)] = list(fixed.values())
        self._settings, scaled = settings_of(compiled, table["settings"])
        self.has_commands = bool(self._commands) or any(setting.command for setting in self._settings)
        self.priors, fields = self._parameters(compiled, table["parameters"], scaled)
        self.notes = tuple(self._said(own, set(fixed), unused_keyframes(compiled, table["initial"], self._initial)))
        scales = [Prior(name, "1", 1.0, 1.0, True, (0.0, np.inf)) for name in scaled]
        parameters = [Parameter(p.name, p.unit, p.nominal, p.bounds, p.bounds, "") for p in (*self.priors, *scales)]
        many = max(_MOST_FREEDOMS // max(compiled.nv, 1), SIMULATIONS)
        count = min(many, _MOST_SIMULATIONS)
        with quiet():
            self.simulation = Simulation(compiled, ParameterSet(*parameters), [fields], count, threads, ())
            self._remember(baseline)
            self._fix(known)

    def shortened(self, factor: int) -> Robot:
        """The same model with time steps shorter by a factor."""
        robot = ModelRobot(*self._sources, self.threads, factor, self._baseline, self._known_parameters, self._patched)
        return self._alike(robot)

    def knowing(self, known: Known) -> Robot:
        """The same robot with some parameters fixed."""
        robot = ModelRobot(*self._sources, self.threads, self.shorter, self._baseline, known, self._patched)
        return self._alike(robot)

    def as_built(self, xml: str | None = None) -> Robot:
        """The same robot by its model file or another one, without a baseline."""
        if xml is None:
            return self._alike(ModelRobot(*self._sources, self.threads, patched=self._patched))
        spec = mujoco.MjSpec.from_string(xml)
        spec.modelname = self.name  # by which unnamed parts are called
        return self._alike(ModelRobot(spec, self._sources[1], self.threads, patched=True))

    def accurate(self) -> Robot | None:
        """The same robot by the accurate model of the mapping, if there is one."""
        if self._accurate is None:
            return None
        try:
            robot = ModelRobot(
                self._accurate, self._sources[1], self.threads, 1, self._baseline, self._known_parameters
            )
            return self._alike(robot)
        except ModelError as error:
            raise ModelError(f"the accurate model {self._accurate}: {error}") from error

    def _parameters(
        self, model: mujoco.MjModel, table: dict[str, Any], scaled: dict[str, list[Entry]]
    ) -> tuple[tuple[Prior, ...], ParameterMap]:
        """Priors of the parameters, and the fields that these and the settings change; settings change ``scaled``."""
        return parameters_of(model, table, scaled, self._patched, self._initial.keyframe)

    def _said(self, timestep: float, fixed: set[int], keyframes: str | None) -> list[str]:
        """What a user should know of the model and the mapping.

        Args:
            timestep: of the model's file [s].
            fixed: actuators with a constant control of the mapping.
            keyframes: what there is to say of the model's keyframes.
        """
        model, said = self._model, []
        if self._timestep != timestep:
            said.append(
                f"a control step of {self.control_timestep:g} s is no multiple of the model's time step, "
                f"{timestep:g} s; simulated with {self._timestep:.6g} s"
            )
        said += [keyframes] if keyframes else []
        driven = fixed.union(*(command.actuators for command in self._commands))
        ignores = (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED) & (model.actuator_gainprm[:, 0] == 0)
        groups = np.clip(model.actuator_group, -1, 31)  # those of 0 to 30 can be disabled
        off = (groups >= 0) & (groups < 31) & ((model.opt.disableactuator >> groups.clip(0)) & 1 == 1)
        left = [i for i in range(model.nu) if i not in driven and not ignores[i] and not off[i]]
        where = "at their controls in the keyframe" if self._initial.keyframe >= 0 else "at 0"
        if left:
            names = _listed(model, mujoco.mjtObj.mjOBJ_ACTUATOR, left)
            said.append(f"no command drives {names}; held {where}; [fixed] gives other controls")
        if idle := [i for i in sorted(driven) if off[i]]:
            names = _listed(model, mujoco.mjtObj.mjOBJ_ACTUATOR, idle)
            said.append(f"commands of {names} do nothing: actuatorgroupdisable of the model disables their group")
        if mocap := [i for i in range(model.nbody) if model.body_mocapid[i] >= 0]:
            names = _listed(model, mujoco.mjtObj.mjOBJ_BODY, mocap)
            said.append(f"mocap bodies stay where the model has them: {names}")
        return said

    def spec(self) -> mujoco.MjSpec:
        """The model of the file, prepared for effects."""
        spec = load_spec(self._sources[0])
        spec.option.timestep = self._timestep
        for i in self._widened:
            spec.actuators[i].ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        return spec

    def actions(self, recording: Recording) -> Floats:
        """(T, nu) setpoints of all actuators; those without a command are held.

        Raises:
            RecordingError: says what is wrong with the commands.
        """
        _, steps = recording.control_steps(self._named, self.control_timestep)
        if not 1 <= steps <= _MOST_STEPS:
            raise RecordingError(f"{recording.duration} s are {steps} control steps; expected 1 to {_MOST_STEPS}")
        actions = np.tile(self._control, (steps, 1))
        for each in self._commands:
            command = recording.commands[each.name]
            actions[:, each.actuators] = held(recording, each.name, self._times(recording, steps), len(each.actuators))
            check_unit(command, each.name, each.unit)
            self._check_rate(each.name, command)
        if mostly := [text for share, text in self._clipped(actions) if share > _SETTINGS.most_clipped]:
            raise RecordingError(f"{mostly[0]}; most of it would be lost")
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

    def _clipped(self, actions: Floats) -> list[tuple[float, str]]:
        """Which commands MuJoCo clips in setpoints (T, nu): the share of the time, and what to say."""
        found, model = [], self._model
        for command in self._commands:
            for i in command.actuators:
                asked, (low, high) = actions[:, i], model.actuator_ctrlrange[i]
                share = float(beyond(model, i, asked, _SETTINGS.range_tolerance).mean())
                text = (
                    f"the command {command.name!r} is from {asked.min():g} to {asked.max():g}; the model clips what is "
                    f"not within the ctrlrange of actuator {model.actuator(i).name!r}, {low:g} to {high:g} "
                    f'({100 * share:.2g} % of the time); [commands.{command.name}] ctrlrange = "widen" lets it through'
                )
                found += [(share, text)] if share else []
        return found

    def settings(self, recording: Recording, steps: int) -> Floats | None:
        """(steps, S) values of the mapping's settings, as multiples of their references; None without settings."""
        times = self._times(recording, steps)
        return np.stack([s.values(recording, times) for s in self._settings], axis=1) if self._settings else None

    def begins(self, recording: Recording) -> float:
        """When the first command of the mapping begins [s]."""
        return recording.control_steps(self._named, self.control_timestep)[0]

    def _setpoint_unit(self, actuator: int) -> str:
        """The unit of the mapping's command, or the one that the model implies if the mapping names none."""
        named = next((each.unit for each in self._commands if actuator in each.actuators), None)
        return named or super()._setpoint_unit(actuator)

    @property
    def _named(self) -> list[str]:
        """Names of the commands."""
        return [command.name for command in self._commands]

    def _times(self, recording: Recording, steps: int) -> Floats:
        """(steps,) s, the beginnings of the control steps."""
        return np.asarray(self.begins(recording) + self.control_timestep * np.arange(steps), float)

    def measured(self, recording: Recording) -> Measured:
        """The part of a recording that a diagnosis uses.

        Raises:
            RecordingError: as of any robot; or the robot begins at a signal, and its first sample is missing or late.
        """
        found = super().measured(recording)
        found = replace(found, notes=(*found.notes, *(text for _, text in self._clipped(found.actions))))
        for command in self._commands:
            found = command.without_changes(found, self.control_timestep)
        if not self._initial.parts:
            return found
        early = self._initial.begun(recording, self.begins(recording), self.control_timestep)
        own = [part.signal for part in self._initial.parts] == [self.signal] and early[0].size == np.prod(self.shape)
        return replace(found, start=early[0].reshape(self.shape) if own else early[0], early=early)

    def converted(self, signal: ObservedSignal, given: Signal) -> Signal:
        """A recorded signal as it is explained: of quaternions the axes of their frames."""
        return self._signals[signal.name].converted(signal.name, given)

    def rates(self, actions: Floats) -> Floats:
        """(T, nu) changes of setpoints in a control step, as shares of the largest; controls, where they are rates."""
        moved = np.diff(actions, axis=0, prepend=actions[:1])
        shares = moved / np.maximum(np.abs(moved).max(axis=0), 1e-12)
        return np.where(self._model.actuator_dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR, actions, shares)

    def commanded(self, rates: Floats, recorded: Floats) -> Floats:
        """(T, nu) setpoints with given rates (T, nu), or controls with them where controls are rates.

        They stay within a share of each actuator's range on both sides of the keyframe's control, zero without one, or
        of the value nearest to it. An actuator without a range has that of the recorded setpoints; one without a
        command is held.
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
        found = np.where(integrates, speeds / slower, np.clip(self._control, low + reach, high - reach) + moved)
        return np.where(self.driven, found, self._control)

    def excited(self, recording: Recording | None = None, duration: float | None = None, seed: int = 0) -> Floats:
        """(T, nu) controls of an identification experiment, as :func:`soro_bench.recording.excitation.excitation` has
        it for the commanded actuators; the others are held.

        Args:
            recording: says how far actuators without a range may go.
            duration: s; 30 by default, or what it takes.
            seed: of the random phases.

        Raises:
            ValueError: no actuator is commanded, one may go nowhere, or the duration is too short.
        """
        driven = self.driven
        if not driven.any():
            raise ValueError("the map has no [commands]; there is no actuator to move")
        rates = excitation(Box(-1.0, 1.0, (int(driven.sum()),)), self.control_timestep, duration, seed)
        whole = np.zeros((len(rates), len(driven)))
        whole[:, driven] = rates
        controls = self.commanded(whole, self.measured(recording).actions if recording else np.zeros((1, len(driven))))
        if still := [self.channels[i] for i in np.flatnonzero(driven & (np.ptp(controls, axis=0) == 0.0))]:
            raise ValueError(f"{still[0]} has no ctrlrange; give --recording with commands that it may have")
        return controls

    @property
    def driven(self) -> Bools:
        """(nu,) whether a command moves an actuator."""
        return np.isin(np.arange(self._model.nu), [i for command in self._commands for i in command.actuators])

    def simulate_all(
        self,
        drives: Sequence[Drive],
        parameters: Floats,
        effects: Sequence[Sequence[Effect]],
        before_step: Callable[[int], None] | None = None,
    ) -> list[Floats]:
        """Replays under several drives, see :meth:`Robot.simulate_all`; MuJoCo logs no warnings."""
        with quiet():
            return super().simulate_all(drives, parameters, effects, before_step)

    def _begin(self, parameters: Floats, start: Floats | None) -> None:
        """Start the simulations; see :meth:`Robot._begin`."""
        ids = np.arange(len(parameters))
        self._set_all(ids, parameters, np.ones((len(ids), len(self._settings))))
        self._initial.write(self.simulation.batch, ids, start)
        self.simulation.begin(ids)

    def _happened(self, start: Floats, early: Floats, effects: Sequence[Effect]) -> Floats:
        """The start without faults of sensors; see :meth:`Robot._happened`."""
        return self._initial.happened(start, early, self.control_timestep, effects, self.signals)

    def _set(self, ids: Ints, settings: Floats) -> None:
        """Give simulations their settings; their parameters stay."""
        if len(ids):
            self._set_all(ids, self.simulation.params[ids, : len(self._names)], settings)

    def _set_all(self, ids: Ints, parameters: Floats, settings: Floats) -> None:
        """Give simulations ``ids`` (n,) parameters (n, d) and settings (n, S)."""
        self.simulation.set_params(ids, np.hstack([parameters, settings]))

    def _step(self, actions: Floats) -> Bools:
        """Advance the simulations by a control step; (n,) whether each diverged."""
        ids = np.arange(len(actions))
        self.simulation.batch.ctrl[ids] = actions
        self.simulation.step(ids, self._substeps, self._stage)
        return self.simulation.bad_states(ids)

    def _read(self, count: int) -> Floats:
        """(count, P, D) the first signal now."""
        return self._read_signal(self.signal, count)

    def _read_others(self, count: int) -> list[Floats]:
        """(count, P, D) each of the other signals now."""
        return [self._read_signal(each.name, count) for each in self.others]

    def _read_signal(self, name: str, count: int) -> Floats:
        """(count, P, D) a signal of the first ``count`` simulations now."""
        values = self._signals[name].read(self.simulation.batch, count)
        return np.where(np.abs(values) < _DIVERGED, values, np.nan)


def _listed(model: mujoco.MjModel, kind: mujoco.mjtObj, ids: Sequence[int]) -> str:
    """Names of elements, the first of many."""
    names = ", ".join(name_of(model, kind, i) for i in ids[:_MOST_NAMES])
    more = len(ids) - _MOST_NAMES
    return f"{names} and {more} more" if more > 0 else names
