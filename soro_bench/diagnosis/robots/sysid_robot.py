"""A robot from what mujoco.sysid identifies: a spec, parameters that change it, and sensors that are measured."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS

from soro_bench.arrays import Floats
from soro_bench.diagnosis.robots.map_parameters import Entry
from soro_bench.diagnosis.robots.model_file import ModelError, load_spec, with_advice
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.model_state import InitialState, Part
from soro_bench.diagnosis.robots.priors import Baseline, Prior
from soro_bench.models.simulation import FieldWrite, ParameterMap
from soro_bench.recording.known import Known

if TYPE_CHECKING:
    from mujoco.sysid import Parameter, ParameterDict

COMMAND, SIGNAL = "control", "sensors"  # names in the recordings of :mod:`soro_bench.diagnosis.sysid`
STATE = {"qpos": "initial_qpos", "qvel": "initial_qvel", "act": "initial_act"}  # signals of one sample
_BOX = 4.0  # standard deviations of a prior that the bounds of a parameter are apart
_RATIO = 3.0  # of positive bounds, from which the logarithm of a parameter is normal
_TRIED = 8  # random points at which fields are compared with linear functions
_ROUNDING = 1e-9  # of a field's largest value
_HALVED = 10  # times, how often the way to impossible parameters is halved
_NOTHING = Known()
_KEPT = 10_000  # rows of parameters whose fields are remembered


class SysidRobot(ModelRobot):
    """The robot of a ``ParameterDict`` and the spec that its modifiers change.

    The bounds of a parameter are four standard deviations of its prior apart, about its present value. If both are
    positive and far apart, its logarithm is normal. A parameter with several numbers becomes as many, ``name[0]`` and
    so on. As for mujoco.sysid, modifiers of frozen parameters are not called.

    Args:
        spec: as it is before a modifier is called; stays as it is.
        parameters: of mujoco.sysid; stay as they are.
        signal: names of sensors of one unit, all with as many numbers.
        unit: of these sensors.
        control_timestep: s, for which a control is held.
        units: of parameters, by name; "1" for others.
        modified: whether the parameters change the spec; if not, it stays as it is whatever their values.
        threads, shorter, baseline, known: as of :class:`ModelRobot`.

    Raises:
        ModelError: a parameter changes nothing, or what cannot change between simulations of one model.
    """

    def __init__(
        self,
        spec: mujoco.MjSpec,
        parameters: "ParameterDict",
        signal: Sequence[str],
        unit: str,
        control_timestep: float,
        units: Mapping[str, str] | None = None,
        modified: bool = True,
        threads: int = 0,
        shorter: int = 1,
        baseline: Baseline | None = None,
        known: Known = _NOTHING,
    ) -> None:
        self.sensors, self._units = list(signal), dict(units or {})
        self._spec, self._dict, self._modified = spec, parameters.copy(), modified
        model = spec.copy().compile()
        every = [f"#{i}" for i in range(model.njnt)]
        mapping: dict[str, Any] = {
            "robot": {"control_timestep": control_timestep},
            "commands": {COMMAND: {"actuators": [f"#{i}" for i in range(model.nu)]}},
            "signal": {"name": SIGNAL, "sensors": list(signal), "unit": unit},
            "initial": {
                "keyframe": "",
                "signals": {STATE["qpos"]: {"joints": every}, STATE["qvel"]: {"velocities": every}},
            },
        }
        if not model.nu:
            del mapping["commands"]
        super().__init__(spec, mapping, threads, shorter, baseline, known)
        if self._model.na:
            self._initial = with_activations(self._initial, self._model.na)

    @property
    def substeps(self) -> int:
        """Time steps of the spec in a control step."""
        return self._substeps // self.shorter

    def shortened(self, factor: int) -> "SysidRobot":
        """The same model with time steps shorter by a factor."""
        return self._again(
            self._spec, modified=self._modified, shorter=factor, baseline=self._baseline, known=self._known_parameters
        )

    def knowing(self, known: Known) -> "SysidRobot":
        """The same robot with some parameters fixed."""
        same = {"modified": self._modified, "shorter": self.shorter, "baseline": self._baseline}
        return self._again(self._spec, known=known, **same)

    def as_built(self, xml: str | None = None) -> "SysidRobot":
        """The same robot by its spec, or by another model that has its parameters already; without a baseline."""
        if xml is None:
            return self._again(self._spec, modified=self._modified)
        return self._again(mujoco.MjSpec.from_string(xml), modified=False)

    def accurate(self) -> None:
        """None: mujoco.sysid knows one model."""

    def _again(self, spec: mujoco.MjSpec, **changed: Any) -> "SysidRobot":
        same = (self.sensors, self.unit, self.control_timestep, self._units)
        return SysidRobot(spec, self._dict, *same, **{"threads": self.threads, **changed})

    def _parameters(
        self, model: mujoco.MjModel, table: dict[str, Any], scaled: dict[str, list[Entry]]
    ) -> tuple[tuple[Prior, ...], ParameterMap]:
        found = (priors_of(each, self._units.get(each.name, "1")) for each in free(self._dict))
        priors = tuple(prior for some in found for prior in some)
        if not priors:
            raise ModelError("no parameter is free; a diagnosis fits at least one")
        return priors, ModifiedFields(self._spec, self._dict, priors) if self._modified else Unchanged()


def with_activations(initial: InitialState, count: int) -> InitialState:
    """An initial state in which activations begin at a signal too."""
    return replace(initial, parts=(*initial.parts, Part(STATE["act"], "act", np.arange(count))))


def free(parameters: "ParameterDict") -> "list[Parameter]":
    """The parameters that are not frozen; ModelError for one that has no modifier."""
    found = [each for each in parameters.values() if not each.frozen]
    if none := next((each.name for each in found if each.modifier is None), None):
        raise ModelError(f"the parameter {none!r} has no modifier, so it changes nothing; give it one, or freeze it")
    return found


def names_of(parameter: "Parameter") -> list[str]:
    """Names of the numbers of a parameter."""
    return [parameter.name] if parameter.size == 1 else [f"{parameter.name}[{i}]" for i in range(parameter.size)]


def priors_of(parameter: "Parameter", unit: str) -> list[Prior]:
    """The priors of a parameter's numbers.

    Raises:
        ModelError: its bounds are no bounds of its value.
    """
    found = []
    ends = zip(parameter.as_vector(), *parameter.get_bounds(), strict=True)
    for name, (value, low, high) in zip(names_of(parameter), ends, strict=True):
        if not (np.isfinite([value, low, high]).all() and low <= value <= high and low < high):
            raise ModelError(f"the parameter {name!r} is {value:g}, its bounds {low:g} and {high:g}; expected are "
                             "finite bounds, one below the other, and a value within them")  # fmt: skip
        logarithmic = bool(low > 0 and high / low > _RATIO)
        width = np.log(high / low) if logarithmic else high - low
        found.append(Prior(name, unit, float(value), float(width / _BOX), logarithmic, (float(low), float(high))))
    return found


class Unchanged:
    """Parameters that change nothing."""

    def writes(self, params: Mapping[str, Floats]) -> list[FieldWrite]:
        """None."""
        return []


class ModifiedFields:
    """What the modifiers of mujoco.sysid make of a model's fields, for N values of every parameter at once.

    The spec is compiled for every row of parameters, unless all fields are linear in them, as those of masses, gains
    and damping are: then the slopes are enough. Where a row makes no model, as not all numbers are an inertia, the
    first one does that is half as far from the nominal values, or a quarter, and so on.
    """

    def __init__(self, spec: mujoco.MjSpec, parameters: "ParameterDict", priors: Sequence[Prior]) -> None:
        self._spec, self._parameters = spec, parameters.copy()
        self._names = [prior.name for prior in priors]
        self._nominal = np.array([prior.nominal for prior in priors])
        self._kept: dict[bytes, dict[str, Floats]] = {}
        ends = np.array([prior.bounds for prior in priors]).T
        before = self._compiled(self._nominal)
        self._fields: list[str] = []
        self._find(before, ends)
        self._base = self._of(self._nominal)
        self._slopes = self._linear(ends)

    def writes(self, params: Mapping[str, Floats]) -> list[FieldWrite]:
        """The changed fields for values (N,) of each number of the parameters."""
        rows = np.stack([params[name] for name in self._names], axis=1)
        if self._slopes is not None:
            found = {name: self._at(name, rows) for name in self._fields}
        else:
            each = [self._of(row) for row in rows]
            found = {name: np.stack([one[name] for one in each]) for name in self._fields}
        return [FieldWrite(name, np.arange(values.shape[1]), values) for name, values in found.items()]

    def _at(self, name: str, rows: Floats) -> Floats:
        """(N, ...) a field that is linear in parameters (N, d)."""
        assert self._slopes is not None
        return self._base[name] + np.tensordot(rows - self._nominal, self._slopes[name], axes=1)

    def _possible(self, row: Floats) -> mujoco.MjModel:
        """The model with one value of every parameter, or values nearer to the nominal ones."""
        for halved in range(_HALVED):
            with suppress(ModelError):
                return self._compiled(self._nominal + (row - self._nominal) / 2**halved)
        return self._compiled(self._nominal)

    def _compiled(self, row: Floats) -> mujoco.MjModel:
        """The model, prepared for effects, with one value of every parameter."""
        self._parameters.update_from_vector(row)
        spec = self._spec.copy()
        for parameter in free(self._parameters):
            try:
                parameter.apply_modifier(spec)
            except Exception as error:  # the user's own code
                raise ModelError(f"the modifier of {parameter.name!r} fails: {with_advice(error)}") from error
        try:
            return load_spec(spec).compile()
        except (ValueError, mujoco.FatalError) as error:
            said = ", ".join(f"{name} {value:g}" for name, value in zip(self._names, row, strict=True))
            raise ModelError(f"no model with {said}: {with_advice(error)}") from error

    def _of(self, row: Floats) -> dict[str, Floats]:
        """The changed fields with one value of every parameter."""
        if (key := row.tobytes()) not in self._kept:
            if len(self._kept) >= _KEPT:
                self._kept.clear()
            model = self._possible(row)
            self._kept[key] = {name: np.array(attrgetter(name)(model), float) for name in self._fields}
        return self._kept[key]

    def _find(self, before: mujoco.MjModel, ends: Floats) -> None:
        """Which fields change between the bounds ``ends`` (2, d)."""
        for i, name in enumerate(self._names):
            changed: set[str] = set()
            for end in ends[:, i]:
                row = self._nominal.copy()
                row[i] = end
                changed |= differing(before, self._possible(row), name)
            if not changed:
                raise ModelError(
                    f"the parameter {name!r} changes nothing in the model; freeze it, or mend its modifier"
                )
            self._fields = sorted({*self._fields, *changed})

    def _linear(self, ends: Floats) -> dict[str, Floats] | None:
        """(d, ...) slopes of every field, if all are linear; else None."""
        slopes: dict[str, list[Floats]] = {name: [] for name in self._fields}
        for i, end in enumerate(ends[1]):
            row = self._nominal.copy()
            row[i] = end if end != self._nominal[i] else ends[0, i]
            for name, values in self._of(row).items():
                slopes[name].append((values - self._base[name]) / (row[i] - self._nominal[i]))
        found = {name: np.stack(each) for name, each in slopes.items()}
        rng = np.random.default_rng(0)
        for row in [*ends, *rng.uniform(ends[0], ends[1], (_TRIED, len(self._nominal)))]:
            for name, values in self._of(row).items():
                linear = self._base[name] + np.tensordot(row - self._nominal, found[name], axes=1)
                if not np.allclose(linear, values, rtol=0.0, atol=_ROUNDING * np.abs(values).max(initial=0.0)):
                    return None
        return found


def differing(model: mujoco.MjModel, other: mujoco.MjModel, parameter: str) -> set[str]:
    """Fields of two models that differ, of those that can be given to single simulations.

    Raises:
        ModelError: another one differs.
    """
    found = set()
    for name in MODEL_FIELDS:
        a, b = np.array(attrgetter(name)(model)), np.array(attrgetter(name)(other))
        if a.shape == b.shape and np.array_equal(a, b, equal_nan=a.dtype.kind == "f"):
            continue
        if a.shape != b.shape or a.dtype.kind != "f" or not a.ndim:
            raise ModelError(f"the parameter {parameter!r} changes {name}, which all simulations of a model share")
        found.add(name)
    return found
