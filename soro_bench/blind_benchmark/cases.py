"""A hidden case: the recordings of a real robot, and what its label says.

A case is drawn without simulating anything (``draw_cases``); then its effects are scaled so that each changes the
training recording's keypoints by a target. Every recording starts from a fresh robot, with the same laws: what has
drifted, slipped or yielded in one is as new in the other. Only gusts and outliers come at other times."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces

from soro_bench.blind_benchmark.draw import TARGETS, Case, manoeuvre
from soro_bench.blind_benchmark.hidden import ALL, UNKNOWN
from soro_bench.blind_benchmark.locations import Hidden
from soro_bench.blind_benchmark.report import released
from soro_bench.blind_benchmark.robot import CONTROL_TIMESTEP, Diverged, Law, Trace, simulate
from soro_bench.blind_benchmark.sensor_laws import SensorLaw
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo
from soro_bench.recording.excitation import excitation
from soro_bench.recording.recording import Recording, Signal
from soro_bench.recording.simulated import COMMAND

_TRIALS = 6  # simulations to find a magnitude
_CLOSE = 0.08  # largest log ratio of change and target that ends the search
_ACCEPTED = (0.85 * TARGETS[0], 1.15 * TARGETS[1])  # mm; else location and shape are drawn again
_DRAWS = 5
_TAIL = 0.6  # s after a recording, which a slow clock sees


@dataclass(frozen=True)
class Scaled:
    """An effect of a case with its magnitude."""

    name: str
    hidden: Hidden
    magnitude: float
    target: float  # mm
    change: float  # mm

    @property
    def law(self) -> Law | SensorLaw:
        """The law or fault with that magnitude."""
        return self.hidden.law(self.magnitude)

    def label(self) -> dict:
        """For the labels; an effect outside the catalogue is unknown there, and described."""
        parameters = self.hidden.parameters(self.magnitude)
        label = {
            "name": "unknown" if self.name in UNKNOWN else self.name,
            "class": released(ALL[self.name][0]),
            "where": self.hidden.location,
            "parameters": {name: {"value": float(value), "unit": unit} for name, (value, unit) in parameters.items()},
            "target_mm": self.target,
            "change_mm": self.change,
        }
        return label | ({"law": self.name, "description": self.hidden.description} if self.name in UNKNOWN else {})


class Bench:
    """Runs of one case's robot, of which those with the same laws are made once."""

    def __init__(self, case: Case, actions: dict[str, np.ndarray], streams: dict[str, tuple[int, ...]]) -> None:
        self._case, self._streams = case, streams
        tail = np.zeros((round(_TAIL / CONTROL_TIMESTEP) if "clock_skew" in case.effects else 0, len(geo.CABLE_NAMES)))
        self._stamps = {role: CONTROL_TIMESTEP * np.arange(len(rows) + 1) for role, rows in actions.items()}
        self._actions = {role: np.concatenate([rows, tail]) for role, rows in actions.items()}
        self._traces: dict[tuple, Trace] = {}

    def trace(self, role: str, laws: Sequence[Law]) -> Trace:
        """A run with ``laws``; Diverged if it is not sound."""
        key = (role, *map(repr, laws))
        if key not in self._traces:
            case = self._case
            self._traces[key] = simulate(case.robot, case.parameters, laws, self._actions[role], self._streams[role])
        return self._traces[key]

    def points(self, role: str, laws: Sequence[Law | SensorLaw]) -> np.ndarray:
        """(T + 1, 21, 3) m, keypoints as they are measured, but without noise."""
        faults = [law for law in laws if isinstance(law, SensorLaw)]
        stamps = self._stamps[role]
        times = stamps
        for fault in faults:
            times = fault.when(times)
        points = self.trace(role, [law for law in laws if not isinstance(law, SensorLaw)]).at(times)
        for fault in faults:
            points = fault.distort(stamps, points, np.random.default_rng([*self._streams[role], 2]))
        return points

    def realised(self, rng: np.random.Generator) -> tuple[list[Scaled], dict[str, np.ndarray]]:
        """The case's effects, and the keypoints [m] with them by role; drawn again if a run is not sound."""
        for _ in range(_DRAWS):
            try:
                effects = self._scaled_effects(rng)
                return effects, {role: self.points(role, [effect.law for effect in effects]) for role in self._stamps}
            except Diverged:
                continue
        raise Diverged(f"{self._case.effects} cannot be simulated on robot {self._case.robot}")

    def _scaled_effects(self, rng: np.random.Generator) -> list[Scaled]:
        """Each is scaled by what it changes on top of those before it."""
        effects: list[Scaled] = []
        for name, target in zip(self._case.effects, self._case.targets, strict=True):
            effects.append(self._scaled(name, target, [effect.law for effect in effects], rng))
        return effects

    def _scaled(self, name: str, target: float, laws: Sequence[Law | SensorLaw], rng: np.random.Generator) -> Scaled:
        """The first of a few draws of location and shape that comes into the range of targets, or else the one that
        comes closest to its own."""
        best: Scaled | None = None
        for _ in range(_DRAWS):
            hidden = ALL[name][1](rng, self.trace("train", []))
            magnitude, reached = self._search(hidden, target, laws)
            found = Scaled(name, hidden, magnitude, target, reached)
            if _ACCEPTED[0] <= reached <= _ACCEPTED[1]:
                return found
            if best is None or _miss(reached, target) < _miss(best.change, target):
                best = found
        if best is None or best.change == 0:
            raise Diverged(f"{name}: no magnitude that can be simulated")
        return best

    def _search(self, hidden: Hidden, target: float, laws: Sequence[Law | SensorLaw]) -> tuple[float, float]:
        """A magnitude and the change [mm] that it makes, by the secant method in logarithms."""
        without, tried, magnitude = self.points("train", laws), [], hidden.guess * target / 2.0
        ceiling = hidden.highest
        for _ in range(_TRIALS):
            magnitude = min(magnitude, ceiling)
            try:
                reached = change(self.points("train", [*laws, hidden.law(magnitude)]), without)
            except Diverged:
                ceiling = 0.7 * magnitude
                magnitude *= 0.5
                continue
            tried.append((magnitude, reached))
            if _miss(reached, target) < _CLOSE or (magnitude >= ceiling and reached < target):
                break
            magnitude = _next(tried, target)
        return min(tried, key=lambda pair: _miss(pair[1], target), default=(0.0, 0.0))


def change(points: np.ndarray, others: np.ndarray) -> float:
    """Root mean square over times and keypoints of the distances [mm] between two runs."""
    return 1e3 * float(np.sqrt(np.square(points - others).sum(axis=-1).mean()))


def _miss(reached: float, target: float) -> float:
    return abs(math.log(max(reached, 1e-6) / target))


def _next(tried: Sequence[tuple[float, float]], target: float) -> float:
    """The magnitude to try next: between those around the target if there are any, or beyond."""
    pairs = sorted((math.log(m), math.log(max(r, 1e-6) / target)) for m, r in tried)
    below, above = [p for p in pairs if p[1] < 0], [p for p in pairs if p[1] >= 0]
    if below and above:
        (a, low), (b, high) = below[-1], above[0]
        part = min(max(low / (low - high), 0.1), 0.9)
        return math.exp(a + part * (b - a))
    place, miss = below[-1] if below else above[0]
    slope = 1.0
    if len(pairs) > 1:
        (a, low), (b, high) = pairs[:2] if above else pairs[-2:]
        slope = (high - low) / (b - a) if b > a else 1.0
    return math.exp(place - min(max(miss / min(max(slope, 0.3), 3.0), -1.5), 1.5))


NOISE = 0.0005  # m, standard deviation of each coordinate
DURATIONS = {"train": 30.0, "heldout": 12.0, "task": 30.0}  # s; "task" is to train on where excitation is to be judged
_ROLES = ("train", "heldout", "task")


def build(case: Case, durations: dict[str, float] = DURATIONS) -> tuple[dict[str, Recording], dict]:
    """The recordings of a case by role, and its label."""
    streams: dict[str, tuple[int, ...]] = {name: (*case.seed, i) for i, name in enumerate(("drawing", *_ROLES), 1)}
    actions = {
        "train": excitation(_action_space(), CONTROL_TIMESTEP, durations["train"], _number(streams["train"])),
        "heldout": manoeuvre(durations["heldout"], streams["heldout"]),
        "task": manoeuvre(durations["task"], streams["task"]),
    }
    bench = Bench(case, actions, streams)
    effects, points = bench.realised(np.random.default_rng(streams["drawing"]))
    changes = {role: change(points[role], bench.points(role, [])) for role in _ROLES}
    recordings = {
        role: recording(actions[role], points[role], np.random.default_rng([*streams[role], 1])) for role in _ROLES
    }
    label = {
        "id": case.id,
        "group": case.group,
        "robot": case.robot,
        "parameters": {p.name: {"value": case.parameters[p.name], "unit": p.unit} for p in trunk.PARAMETERS},
        "effects": [effect.label() for effect in effects],
        "change_mm": changes,
        "noise": {"value": NOISE, "unit": "m"},
        "seeds": {name: list(stream) for name, stream in streams.items()},
    }
    return recordings, label


def _action_space() -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (len(geo.CABLE_NAMES),), np.float32)


def _number(stream: Sequence[int]) -> int:
    """A seed for what takes one number only."""
    return int(np.random.SeedSequence(stream).generate_state(1)[0])


def recording(actions: np.ndarray, points: np.ndarray, rng: np.random.Generator) -> Recording:
    """What is recorded of actions (T, 8) and keypoints (T + 1, 21, 3) [m], with noise."""
    stamps = CONTROL_TIMESTEP * np.arange(len(points))
    measured = points + NOISE * rng.standard_normal(points.shape)
    metadata = {"env_id": "TrunkReach-v0", "action": "continuous", "noise": repr(NOISE)}
    return Recording(
        {COMMAND: Signal(stamps[:-1], actions, "1")},
        {"keypoints": Signal(stamps, measured, "m", "world")},
        {},
        metadata,
    )
