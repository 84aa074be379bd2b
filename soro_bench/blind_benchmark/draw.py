"""What a case is drawn from: its robot and effects, and the manoeuvre that a diagnosis is tested on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soro_bench.blind_benchmark.hidden import MEASUREMENT, PHYSICS, UNKNOWN
from soro_bench.blind_benchmark.robot import CONTROL_TIMESTEP, KINDS
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo

TARGETS = (0.7, 4.0)  # mm, rms change of the keypoints by one effect
GROUPS = ("none", "one", "two", "measurement", "unknown")
_NULL_SHARE = 0.2
_SHARES = np.array([45, 15, 10, 10]) / 80  # of the rest, in the order of the other groups
_SPREAD = math.log(1.3)  # of every parameter but Poisson's ratio, about its nominal value
_POISSON_SPREAD = 0.03


@dataclass(frozen=True)
class Case:
    """What is drawn of a case before anything is simulated.

    Args:
        group: of GROUPS.
        robot: "flex" or "fine".
        effects: names in ``hidden.ALL``.
        targets: mm, rms change of the keypoints by each effect.
        seed: of everything that is drawn later.
    """

    id: str
    group: str
    robot: str
    parameters: dict[str, float]
    effects: tuple[str, ...]
    targets: tuple[float, ...]
    seed: tuple[int, int]


def draw_cases(count: int, seed: int, healthy: int | None = None) -> list[Case]:
    """``count`` cases in random order.

    Args:
        healthy: how many have no effect, a fifth by default; the rest is shared as in the design.
    """
    healthy = round(_NULL_SHARE * count) if healthy is None else healthy
    if count < 1 or seed < 0 or not 0 <= healthy <= count:
        raise ValueError(f"count {count}, seed {seed}, healthy {healthy}: 1, 0 and 0 to count are needed")
    rng = np.random.default_rng(seed)
    drawn: list[tuple[str, tuple[str, ...], str]] = []
    for group, size in zip(GROUPS, [healthy, *_apportioned(count - healthy)], strict=True):
        # half of each group on either robot, the odd one on a random one
        kinds = np.resize(rng.permutation(list(KINDS)), size)
        drawn += zip([group] * size, _effects(group, size, rng), map(str, kinds), strict=True)
    cases = []
    for i, k in enumerate(rng.permutation(count)):
        group, effects, robot = drawn[k]
        low, high = np.log(TARGETS)
        targets = tuple(float(t) for t in np.exp(rng.uniform(low, high, len(effects))))
        cases.append(Case(f"case_{i:03d}", group, robot, draw_parameters(rng), effects, targets, (seed, i)))
    return cases


def _apportioned(count: int) -> list[int]:
    """How many of ``count`` cases each group with an effect has: the largest remainders are rounded up."""
    exact = count * _SHARES
    sizes = np.floor(exact).astype(int)
    sizes[np.argsort(sizes - exact, kind="stable")[: count - sizes.sum()]] += 1
    return sizes.tolist()


def _effects(group: str, size: int, rng: np.random.Generator) -> list[tuple[str, ...]]:
    """The effects of each of ``size`` cases; within a group, every effect comes equally often."""
    if group == "none":
        return [()] * size
    if group == "two":
        return [_pair(rng) for _ in range(size)]
    names = list({"one": PHYSICS, "measurement": MEASUREMENT, "unknown": UNKNOWN}[group])
    rounds = [rng.permutation(names) for _ in range(-(-size // len(names)))]
    return [(str(name),) for name in np.concatenate([*rounds, []])[:size]]


def _pair(rng: np.random.Generator) -> tuple[str, ...]:
    """Two effects of different classes."""
    while True:
        a, b = map(str, rng.choice(list(PHYSICS), 2, replace=False))
        if PHYSICS[a][0] != PHYSICS[b][0]:
            return a, b


def draw_parameters(rng: np.random.Generator) -> dict[str, float]:
    """The trunk's parameters about their nominal values, within the prior of a diagnosis."""
    parameters = {p.name: p.nominal * math.exp(rng.uniform(-_SPREAD, _SPREAD)) for p in trunk.PARAMETERS}
    nominal = next(p.nominal for p in trunk.PARAMETERS if p.name == "poisson_ratio")
    return parameters | {"poisson_ratio": nominal + rng.uniform(-_POISSON_SPREAD, _POISSON_SPREAD)}


_PAIRS = ((0, 2), (1, 3), (4, 6), (5, 7))  # cables on opposite sides: one is pulled as the other is released
_AMPLITUDES = ((0.010, 0.035), (0.010, 0.035), (0.005, 0.020), (0.005, 0.020))  # m
_FREQUENCIES = (0.1, 0.6)  # Hz
_SINES = 3
_FADE = 2.0  # s
_SHARE_OF_RATE = 0.95


def manoeuvre(duration: float, seed: int | Sequence[int]) -> np.ndarray:
    """(T, 8) actions: every pair of cables follows a sum of slow sines, faded in from zero."""
    rng = np.random.default_rng(seed)
    time = CONTROL_TIMESTEP * np.arange(round(duration / CONTROL_TIMESTEP) + 1)
    fade = np.clip(time / _FADE, 0, 1)
    fade = fade * fade * (3 - 2 * fade)
    pulls = np.zeros((len(time), len(geo.CABLE_NAMES)))  # m
    for (a, b), amplitudes in zip(_PAIRS, _AMPLITUDES, strict=True):
        path = fade * _sines(time, rng)
        path *= rng.uniform(*amplitudes) / np.abs(path).max()
        path *= min(1.0, _SHARE_OF_RATE * geo.CABLE_RATE * CONTROL_TIMESTEP / np.abs(np.diff(path)).max())
        pulls[:, a], pulls[:, b] = path, -path
    return np.diff(pulls, axis=0) / (geo.CABLE_RATE * CONTROL_TIMESTEP)


def _sines(time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    low, high = np.log(_FREQUENCIES)
    frequencies = np.exp(rng.uniform(low, high, _SINES))
    weights, phases = rng.uniform(0.3, 1.0, _SINES), rng.uniform(0, 2 * np.pi, _SINES)
    return (weights * np.sin(2 * np.pi * frequencies * time[:, None] + phases)).sum(axis=1)
