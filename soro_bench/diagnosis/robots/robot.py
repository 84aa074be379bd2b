"""The robot of a diagnosis: a simulation that replays recordings under parameters and effects."""

import copy
import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import mujoco
import numpy as np

from soro_bench.arrays import Bools, Floats
from soro_bench.diagnosis.result_robot import SourceFile
from soro_bench.diagnosis.robots.measured import Measured, ObservedSignal, samples_at
from soro_bench.diagnosis.robots.priors import Baseline, CannotHave, FixedParameter, Prior
from soro_bench.diagnosis.robots.replays import Replays
from soro_bench.diagnosis.robots.variants import Variant
from soro_bench.diagnosis.settings import DiscretisationSettings
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.effect import EACH, EVERY, Effect, EffectError, Location
from soro_bench.effects.elements import Elements, length_unit, setpoint_unit
from soro_bench.files import brief
from soro_bench.recording.known import Known
from soro_bench.recording.recording import Recording, RecordingError, Signal

FITTED, REFINED = DiscretisationSettings().fitted_refinement, DiscretisationSettings().reference_refinement


class Robot(Replays):
    """A robot that replays recordings. Subclasses set the attributes and implement the hooks of both classes.

    Attributes, besides those of :class:`~soro_bench.diagnosis.robots.replays.Replays`:
        name: of the robot, for people.
        model_name: of its model, for people.
        unit, frame, shape: of the first signal; the shape is (P, D), points and coordinates.
        reach: largest range of a coordinate of the first signal in the recordings [unit]; 0 where it is not known.
        others: the other signals that are explained.
        kinds: kinds of locations that candidate terms may have.
        priors: of its parameters, but for the fixed ones.
        fixed: parameters that are known.
        pneumatic: whether its actuators fill chambers.
        has_commands: whether recordings have commands.
        from_baseline: whether its priors come from a baseline diagnosis.
        shorter: how many times shorter its time steps are than those of its model.
        files: that it was made from: its model and its mapping, if they are files.
        longest: s of a recording that are explained, from its beginning on; infinite but where replays are slow.
        notes: what a user should know of it before its results, in words.
    """

    name: str
    model_name: str
    threads: int
    unit: str
    frame: str
    shape: tuple[int, int]
    reach: float = 0.0
    others: tuple[ObservedSignal, ...] = ()
    kinds: tuple[str, ...]
    priors: tuple[Prior, ...]
    fixed: tuple[FixedParameter, ...] = ()
    pneumatic: bool = False
    has_commands: bool = True
    from_baseline: bool = False
    shorter: int = 1
    longest: float = math.inf
    files: tuple[SourceFile, ...] = ()
    notes: tuple[str, ...] = ()

    def _remember(self, baseline: Baseline | None) -> None:
        """Take priors and known effects from a baseline diagnosis.

        Raises:
            ValueError: it is of another robot.
            CannotHave: this robot cannot have its effects.
        """
        if baseline:
            names = [prior.name for prior in self.priors]
            if sorted(names) != sorted(baseline.parameters):
                raise ValueError(f"the baseline diagnosis has {sorted(baseline.parameters)}; this robot has {names}")
            self.known_effects, self.from_baseline = baseline.effects, True
            self.priors = tuple(p.about(baseline.parameters[p.name], baseline.spread[p.name]) for p in self.priors)
            if not self.accepts([]):
                raise CannotHave("the baseline diagnosis has effects that this robot cannot have")

    def _fix(self, known: Known) -> None:
        """Take known parameters out of the priors.

        Raises:
            ValueError: the robot has no such parameter, or it cannot have that value.
        """
        priors = {prior.name: prior for prior in self.priors}
        if unknown := [name for name in known.values if name not in priors]:
            raise ValueError(f"no parameter {brief(unknown[0])}; this robot has {', '.join(priors)}")
        self._names = tuple(priors)
        self.fixed = tuple(priors[name].fixed(value, name in known.recorded) for name, value in known.values.items())
        self.priors = tuple(prior for prior in self.priors if prior.name not in known.values)

    def _complete(self, parameters: Floats) -> Floats:
        """(N, D) values of all parameters in the order of the model, from those (N, d) that are not fixed."""
        if not self.fixed:
            return parameters
        values = {each.name: np.full(len(parameters), each.value) for each in self.fixed}
        values |= {prior.name: column for prior, column in zip(self.priors, parameters.T, strict=True)}
        return np.stack([values[name] for name in self._names], axis=1)

    @abstractmethod
    def knowing(self, known: Known) -> "Robot":
        """The same robot with some parameters fixed, instead of those that are now.

        Raises:
            ValueError: it has no such parameter, or cannot have that value.
        """

    @property
    def signals(self) -> tuple[ObservedSignal, ...]:
        """The signals that are explained, the first one first."""
        return ObservedSignal(self.signal, self.unit, self.frame, self.shape, reach=self.reach), *self.others

    def observed(self, location: Location) -> ObservedSignal:
        """The signal of a sensor's location; the first one where it is that of no signal."""
        return next((each for each in self.signals if each.name == location.name), self.signals[0])

    def explaining(self, others: Sequence[ObservedSignal], notes: Sequence[str] = (), reach: float = 0.0) -> "Robot":
        """The same robot, and the same simulations, of which only these other signals are explained.

        Args:
            others: some of its own, with what is known of them in the recordings.
            notes: what there is to say of those that are left out.
            reach: of the first signal [its unit]; 0 where it is not known.
        """
        found = copy.copy(self)
        found.__dict__.pop("_second", None)  # it has the signals that this one has
        found.others, found.notes, found.reach = tuple(others), (*self.notes, *notes), reach
        return found

    def _alike(self, robot: "Robot") -> "Robot":
        """Another simulation of this robot, with the signals that this one has."""
        robot.others, robot.reach = self.others, self.reach
        return robot

    @property
    def elements(self) -> Elements:
        """The elements of its model."""
        return Elements(self.simulation.model)

    @abstractmethod
    def shortened(self, factor: int) -> "Robot":
        """The same robot with time steps that are shorter by a factor than those of its model."""

    @abstractmethod
    def accurate(self) -> "Robot | None":
        """The same robot by a more accurate model, if there is one.

        Raises:
            CannotHave: that model has no location for a known effect.
        """

    @cached_property
    def _second(self) -> "Robot":
        """The same robot with other simulations, which run beside its own."""
        return self.shortened(self.shorter)

    def refined(self, refinement: int = REFINED) -> "list[Robot]":
        """The same robot simulated more accurately: with shorter time steps, and by its accurate model if it has one.

        Args:
            refinement: how many times shorter the time steps are than those of its model.
        """
        try:
            finer = self.accurate()
        except CannotHave:  # its parts are others; that of shorter time steps has the same
            finer = None
        return [self.shortened(refinement), *([finer] if finer else [])]

    def variants(self) -> tuple[Variant, ...]:
        """Other simulations of the same robot; none of a model of one's own.

        Another integrator would be one. It was tried, no farther off than half of what the time step changes: arms that
        MuJoCo's Euler integrator moves became adequate. But it also took 5 to 25 % of the evidence of the smallest
        frictions, and of one that was just found (413 nats, where 400 are needed) 98.
        """
        return ()

    @abstractmethod
    def as_built(self, xml: str | None = None) -> "Robot":
        """The same robot without a baseline; with nominal parameters it simulates its model file as it is.

        Args:
            xml: MJCF to simulate instead, of the same robot with other numbers. What is made of that robot simulates
                it too, but for the accurate model.
        """

    @abstractmethod
    def spec(self) -> mujoco.MjSpec:
        """What its model is compiled from."""

    @abstractmethod
    def actions(self, recording: Recording) -> Floats:
        """(T, ...) checked commands of a recording, one per control step; RecordingError says what it lacks."""

    @abstractmethod
    def begins(self, recording: Recording) -> float:
        """When the first control step of a recording begins [s]."""

    def settings(self, recording: Recording, steps: int) -> Floats | None:
        """(steps, S) what is known of the robot in each control step; None where it has no settings."""
        return None

    def locations(self, kind: str) -> list[Location]:
        """Locations of a kind that candidate terms may have."""
        return self.elements.locations(kind) if kind in self.kinds else []

    def welded(self) -> list[Location]:
        """Bodies without a joint of their own that candidate terms may have."""
        return self.elements.welded() if "body" in self.kinds else []

    def moved_at(self, location: Location) -> Location:
        """The tendon or scalar joint that an actuator drives; any other location itself."""
        if location.kind != "actuator" or location.name == EVERY:
            return location
        try:
            return self.elements.driven_by(location)
        except EffectError:  # it drives something else
            return location

    def beside(self, location: Location) -> list[Location]:
        """The neighbours of a body or of a measured point; none for other locations, which have no order."""
        if location.index is not None:
            row = [replace(location, index=i) for i in range(self.observed(location).shape[0])]
        else:
            row = self.locations("body") if location.kind == "body" else []
        if location not in row:
            return []
        i = row.index(location)
        return row[max(i - 1, 0) : i] + row[i + 1 : i + 2]

    @property
    def pulls_cables(self) -> bool:
        """Whether all its actuators pull tendons."""
        kinds = self.elements.model.actuator_trntype
        return "tendon" in self.kinds and bool((kinds == int(mujoco.mjtTrn.mjTRN_TENDON)).all())

    @property
    def setpoint_units(self) -> list[str]:
        """The unit of each actuator's setpoint."""
        return [self._setpoint_unit(i) for i in range(self.elements.model.nu)]

    @property
    def force_units(self) -> list[str]:
        """The unit of each actuator's force."""
        model = self.elements.model
        return [{"m": "N", "rad": "N m"}[length_unit(model, i)] for i in range(model.nu)]

    @property
    def setpoint_unit(self) -> str:
        """The unit of all setpoints; "1" where actuators have different ones (``setpoint_unit_at``)."""
        units = set(self.setpoint_units)
        return units.pop() if len(units) == 1 else "1"

    def setpoint_unit_at(self, location: Location) -> str:
        """The unit of the setpoint of the actuator at a location; for other locations that of all actuators."""
        named = location.kind == "actuator" and location.name not in (EVERY, EACH)
        return self._setpoint_unit(self.elements.id(location)) if named else self.setpoint_unit

    def _setpoint_unit(self, actuator: int) -> str:
        """The unit of an actuator's setpoint."""
        return setpoint_unit(self.elements.model, actuator)

    def unit_at(self, unit: str, location: Location) -> str:
        """The unit of a law's quantity at a location.

        Args:
            unit: as the law has it: "setpoint", "signal", or one unit for turning and one for sliding, "N or N m".
        """
        if unit == "setpoint":
            return self.setpoint_unit_at(location)
        parts = (self.observed(location).unit if unit == "signal" else unit).split(" or ")
        turning = [part for part in parts if "rad" in part or "N m" in part]
        sliding = [part for part in parts if part not in turning]
        return (turning if turning and self.elements.turns(location) else sliding or parts)[0]

    @property
    def moves(self) -> Floats:
        """(A, nu) 1 where a number of an action moves an actuator, else 0."""
        return np.eye(self.elements.model.nu)

    @property
    def driven(self) -> Bools:
        """(A,) whether recordings have a command for each number of an action."""
        return np.ones(len(self.moves), bool)

    @property
    def channels(self) -> list[str]:
        """Names of the numbers of an action, such as "cable L0"."""
        kind, names = "cable" if self.pulls_cables else "actuator", np.array(self.actuator_names)
        return [f"{kind} {' and '.join(names[row > 0])}" for row in self.moves]

    @property
    def actuator_names(self) -> list[str]:
        """Names of all actuators."""
        model = self.elements.model
        return [model.actuator(i).name for i in range(model.nu)]

    def channel(self, location: Location) -> int | None:
        """Index of the number of an action that moves a tendon or actuator; None if it is not exactly one."""
        if location.kind not in ("tendon", "actuator") or location.name in (EVERY, EACH):
            return None
        ids = self.elements.actuators_on(location) if location.kind == "tendon" else [self.elements.id(location)]
        channels = set(self.moves[:, ids].argmax(axis=0).tolist()) if len(ids) else set()
        return channels.pop() if len(channels) == 1 else None

    def rates(self, actions: Floats) -> Floats:
        """(T, A) rates at which actions (T, A) move each channel, in any unit."""
        return actions

    def commanded(self, rates: Floats, recorded: Floats) -> Floats:
        """(T, A) actions with given rates (T, A) from -1 to 1, one column per channel.

        Args:
            recorded: (S, A) actions of recordings, which bound the motion where the model does not.
        """
        return rates

    def parameters(self, x: Floats) -> dict[str, float]:
        """Values by name of the parameters that are not fixed; they are the first of the unknowns ``x`` (n,)."""
        return {prior.name: float(prior.value(value)) for prior, value in zip(self.priors, x, strict=False)}

    def every_parameter(self, x: Floats) -> dict[str, float]:
        """Values by name of all parameters, those that are not fixed at unknowns ``x`` (n,)."""
        return {**self.parameters(x), **{each.name: each.value for each in self.fixed}}

    def accepts(self, effects: Sequence[Effect]) -> bool:
        """Whether the robot can have these effects at once, beside the known ones. Its simulations stay as they are.

        It cannot have a law twice at a location, nor two laws on the same spring. A known law may come again if it adds
        up. Laws that are data are others where their data are.
        """
        found = [(e.name, e.location, e.law) for e in effects]
        once = [
            (e.name, e.location, e.law)
            for e in self.known_effects
            if e.name in ALL and not getattr(ALL[e.name], "adds", False)
        ]
        if len({*once, *found}) < len(once) + len(found):
            return False
        effects = [*self.known_effects, *effects]
        return self.simulation.accepts([e for e in effects if e.location.kind != "sensor"])

    def native(self, effect: Effect) -> bool:
        """Whether an effect is in fields of the model, and nowhere else. The simulations stay as they are.

        Raises:
            EffectError: the robot cannot have it.
        """
        return effect.location.kind != "sensor" and self.simulation.in_fields([effect])

    def model(self, parameters: Mapping[str, float], effects: Sequence[Effect]) -> mujoco.MjModel:
        """Its model with parameters, the fixed ones too, and with effects in its fields.

        Simulation 0 has them from then on.
        """
        sim, fixed = self.simulation, {each.name: each.value for each in self.fixed}
        sim.assign_effects([effects] * self._count)
        sim.set_params(np.arange(1), sim.parameters.to_array({**fixed, **parameters})[None])
        return sim.batch.get_model(0)

    def measured(self, recording: Recording) -> Measured:
        """The part of a recording that a diagnosis uses. Of the other signals all is missing that it lacks.

        Raises:
            RecordingError: says what the recording lacks.
        """
        actions, notes = self.actions(recording), tuple[str, ...]()
        if len(actions) * self.control_timestep > self.longest:
            whole, most = len(actions) * self.control_timestep, int(self.longest / self.control_timestep + 1e-9)
            actions = actions[:most]
            notes = (f"explained are the first {self.longest:g} s of {whole:.4g} s: replays of more take hours",)
        begin = self.begins(recording)
        times = np.asarray(begin + self.control_timestep * np.arange(1, len(actions) + 1), float)
        signal, *others = self.signals
        values = self._samples(signal, recording, times)
        more = tuple(self._samples(each, recording, times) for each in others)
        settings = self.settings(recording, len(actions))
        return Measured(
            actions, times - begin, values, self.signal, self.unit, settings=settings, notes=notes, others=more,
            file=recording.file,
        )  # fmt: skip

    def converted(self, signal: ObservedSignal, given: Signal) -> Signal:
        """A recorded signal as it is explained."""
        return given

    def _samples(self, signal: ObservedSignal, recording: Recording, times: Floats) -> Floats:
        """(T, P, D) a signal at times (T,); NaN where the recording lacks another signal than the first.

        Raises:
            RecordingError: the first signal is not there, or one is not as expected.
        """
        if signal.name in recording.signals:
            given = self.converted(signal, recording.signals[signal.name])
            return samples_at(signal, given, list(recording.commands.values()), times)
        if signal in self.others:
            return np.full((len(times), *signal.shape), np.nan)
        raise RecordingError(f"the recording has no signal {signal.name!r}; it has {', '.join(recording.names)}")
