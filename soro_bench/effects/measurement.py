"""Faults of measurement: laws from what happened to what was recorded.

A fault changes the samples of one signal, ``values`` (T, P, D): T times, P points (markers, joints, channels) of D
coordinates.
"""

from collections.abc import Iterable, Mapping
from typing import ClassVar

import numpy as np

from soro_bench.arrays import Bools, Floats, rotate_by_vector
from soro_bench.effects.effect import Effect, EffectError, Quantity

_ANY = (-np.inf, np.inf)
_DEGREE = 5  # of the splines between samples


class Fault:
    """One kind of fault."""

    name: ClassVar[str]
    category = "measurement"
    kinds: ClassVar[tuple[str, ...]] = ("sensor",)
    quantities: ClassVar[tuple[Quantity, ...]]
    local: ClassVar[bool] = False  # concerns one point

    @classmethod
    def idle(cls, coordinates: int) -> frozenset[str]:
        """Quantities that can do nothing to points of so many coordinates."""
        return frozenset()

    @staticmethod
    def apply(time: Floats, values: Floats, p: Mapping[str, float], index: int) -> Floats:
        """(T, P, D) what is recorded at ``time`` (T,) s of what happened."""
        raise NotImplementedError

    @staticmethod
    def undone(time: Floats, values: Floats, p: Mapping[str, float], index: int) -> Floats:
        """(T, P, D) what happened at ``time`` (T,) s of what was recorded; asked of the beginning of a recording."""
        return values


class SensorDelay(Fault):
    """Every sample shows what was some time before."""

    name = "sensor_delay"
    quantities = (Quantity("delay", "s", 0.015, (-2.0, 2.0)),)

    @staticmethod
    def apply(time: Floats, values: Floats, p: Mapping[str, float], index: int) -> Floats:
        return _at(time - p["delay"], time, values)

    @staticmethod
    def undone(time: Floats, values: Floats, p: Mapping[str, float], index: int) -> Floats:
        return _at(time + p["delay"], time, values)


class ClockSkew(Fault):
    """The clock of the sensor runs faster than that of the commands."""

    name = "clock_skew"
    quantities = (Quantity("rate", "1", 0.001, (-0.5, 0.5)),)

    @staticmethod
    def apply(time: Floats, values: Floats, p: Mapping[str, float], index: int) -> Floats:
        return _at(time[0] + (time - time[0]) * (1.0 - p["rate"]), time, values)


class SensorBias(Fault):
    """One point is recorded with a constant offset."""

    name, local = "sensor_bias", True
    quantities = tuple(Quantity(axis, "signal", 0.002, _ANY) for axis in "xyz")

    @classmethod
    def idle(cls, coordinates: int) -> frozenset[str]:
        return frozenset("xyz"[coordinates:])

    @staticmethod
    def apply(time: Floats, values: Floats, p: Mapping[str, float], index: int) -> Floats:
        return _shifted(values, p, index, np.ones(len(time), bool))

    @staticmethod
    def undone(time: Floats, values: Floats, p: Mapping[str, float], index: int) -> Floats:
        return _shifted(values, _opposite(p), index, np.ones(len(time), bool))


class MarkerSlip(Fault):
    """One point is recorded with an offset from some time on."""

    name, local = "marker_slip", True
    quantities = (*SensorBias.quantities, Quantity("time", "s", 10.0, (0.0, 1e6)))

    @classmethod
    def idle(cls, coordinates: int) -> frozenset[str]:
        return SensorBias.idle(coordinates)

    @staticmethod
    def apply(time: Floats, values: Floats, p: Mapping[str, float], index: int) -> Floats:
        return _shifted(values, p, index, time - time[0] >= p["time"])

    @staticmethod
    def undone(time: Floats, values: Floats, p: Mapping[str, float], index: int) -> Floats:
        return _shifted(values, _opposite(p), index, time - time[0] >= p["time"])


class FrameMisalignment(Fault):
    """The frame of the sensor is turned and shifted against the robot's."""

    name = "frame_misalignment"
    quantities = (
        *(Quantity(f"about_{axis}", "rad", 0.02, (-np.pi, np.pi)) for axis in "xyz"),
        *(Quantity(axis, "signal", 0.002, _ANY) for axis in "xyz"),
    )

    @staticmethod
    def apply(time: Floats, values: Floats, p: Mapping[str, float], index: int) -> Floats:
        return _turned(_in_space(values), p) + np.array([p[axis] for axis in "xyz"])

    @staticmethod
    def undone(time: Floats, values: Floats, p: Mapping[str, float], index: int) -> Floats:
        return _turned(_in_space(values) - np.array([p[axis] for axis in "xyz"]), _opposite(p))


class Outliers(Fault):
    """Isolated samples that are far off. They have no signature to fit: the data-quality check leaves them out."""

    name = "outliers"
    quantities = (Quantity("share", "1", 0.01, (0.0, 0.5)), Quantity("size", "signal", 0.02, (0.0, np.inf)))

    @staticmethod
    def apply(time: Floats, values: Floats, p: Mapping[str, float], index: int) -> Floats:
        rng = np.random.default_rng(0)
        hit = rng.random(values.shape[:2]) < p["share"]
        return values + p["size"] * hit[:, :, None] * rng.standard_normal(values.shape)


def distorted(
    faults: Mapping[str, type[Fault]], effects: Iterable[Effect], time: Floats, values: Floats, signal: str
) -> Floats:
    """(T, P, D) samples of a signal with the measurement faults among ``effects`` that concern it."""
    for effect in _of(effects, values, signal):
        values = faults[effect.name].apply(time, values, effect.parameters, _point(effect))
    return values


def undone(
    faults: Mapping[str, type[Fault]], effects: Iterable[Effect], time: Floats, values: Floats, signal: str
) -> Floats:
    """(T, P, D) what happened when samples of a signal were recorded with the measurement faults among ``effects``."""
    for effect in reversed(_of(effects, values, signal)):
        values = faults[effect.name].undone(time, values, effect.parameters, _point(effect))
    return values


def _of(effects: Iterable[Effect], values: Floats, signal: str) -> list[Effect]:
    """The measurement faults among ``effects`` that concern a signal with samples (T, P, D)."""
    found = [each for each in effects if each.location.kind == "sensor" and each.location.name in ("*", signal)]
    for effect in found:
        if _point(effect) >= values.shape[1]:
            raise EffectError(f"{effect.name} is at {effect.location}; {signal} has {values.shape[1]} points")
    return found


def _point(effect: Effect) -> int:
    return 0 if effect.location.index is None else effect.location.index


def _at(when: Floats, time: Floats, values: Floats) -> Floats:
    """Values (T, ...) at other times, by a spline; beyond the ends those of the ends, and NaN from the first NaN on.

    Of a trunk at 20 Hz that is 5 ms late, straight lines leave 4,000 nats beyond 0.5 mm of noise, and this 360.
    """
    from scipy.interpolate import make_interp_spline  # environments, which need no SciPy, have no faults of measurement

    when = np.clip(when, time[0], time[-1])
    sound = int(np.isfinite(values).all(axis=(1, 2)).cumprod().sum())  # samples before the first NaN
    found = np.full((len(when), *values.shape[1:]), np.nan)
    if sound > 1:
        before = when <= time[sound - 1]
        found[before] = make_interp_spline(time[:sound], values[:sound], k=min(_DEGREE, sound - 1))(when[before])
    # bit for bit where nothing is between samples
    return np.where(np.isin(when, time)[:, None, None], values[np.searchsorted(time, when)], found)


def _opposite(p: Mapping[str, float]) -> dict[str, float]:
    """The offset and the turn that take those of ``p`` back."""
    return {name: -value for name, value in p.items()}


def _in_space(values: Floats) -> Floats:
    if values.shape[-1] != 3:
        raise EffectError(f"frame_misalignment turns points of 3 coordinates; these have {values.shape[-1]}")
    return values


def _turned(values: Floats, p: Mapping[str, float]) -> Floats:
    flat = values.reshape(-1, 3)
    vector = np.array([p[f"about_{axis}"] for axis in "xyz"])
    return rotate_by_vector(flat, np.broadcast_to(vector, flat.shape)).reshape(values.shape)


def _shifted(values: Floats, p: Mapping[str, float], index: int, when: Bools) -> Floats:
    shifted = values.copy()
    shifted[when, index] += np.array([p[axis] for axis in "xyz"])[: values.shape[2]]
    return shifted
