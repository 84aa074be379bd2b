"""Recordings to test with, and what is compared."""

import re

import numpy as np

from soro_bench.recording.recording import Recording, Signal


def says(*parts: str) -> str:
    """A pattern for a message in which ``parts`` follow one another."""
    return "(?s)" + ".*".join(re.escape(part) for part in parts)


def example() -> Recording:
    """Irregular times, several rates, missing samples, arrays, and numbers that only their bits tell apart."""
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.001, 0.1, 50))
    points = rng.normal(size=(50, 4, 3))
    points[3, 1, 2], points[7] = np.nan, np.nan
    signals = {
        "points": Signal(times, points, "m", "world"),
        "force": Signal(np.array([0.0, 0.25, times[20]]), np.array([1.0, -0.0, 5e-324]), "N"),
        "once": Signal(np.array([1 / 3]), np.array([[[1, 2], [3, 4]]]), "rad"),
    }
    commands = {
        "action": Signal(times[:-1], rng.normal(size=(49, 2))),
        "pump": Signal(np.array([0.5, 0.6]), np.array([1, 0]), "Pa"),
    }
    return Recording(commands, signals, {"trunk_mass": 0.1 + 0.2}, {"robot": "trunk no. 3, größer"})


def assert_same(a: Recording, b: Recording) -> None:
    """Equal to the last bit."""
    for group in ("commands", "signals"):
        first, second = getattr(a, group), getattr(b, group)
        assert first.keys() == second.keys()
        for name in first:
            x, y = first[name], second[name]
            assert (x.unit, x.frame, x.values.shape) == (y.unit, y.frame, y.values.shape)
            assert x.time.tobytes() == y.time.tobytes()
            assert x.values.tobytes() == y.values.tobytes()
    assert (a.parameters, a.metadata) == (b.parameters, b.metadata)
