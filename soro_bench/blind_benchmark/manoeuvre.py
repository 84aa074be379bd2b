"""A manoeuvre to test a diagnosis on: smooth motion like that of a task, unlike any excitation."""

from collections.abc import Sequence

import numpy as np

from soro_bench.blind_benchmark.robot import CONTROL_TIMESTEP
from soro_bench.models import trunk_geometry as geo

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
