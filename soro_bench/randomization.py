"""Distributions over named physical parameters, to and from JSON.

The three families of the published study: uniform boxes, independent normals truncated at two standard deviations, and
a full Gaussian. Samples never leave the parameters' bounds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Any, Protocol, overload

import numpy as np

from soro_bench.arrays import Bools, Floats
from soro_bench.files import brief, read_json
from soro_bench.parameters import ALL_PARAMETERS, Parameter


class Distribution(Protocol):
    """What domain randomisation samples from."""

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters that it is over."""

    @property
    def mean(self) -> Floats:
        """(d,) their means [SI units]."""

    @property
    def constant(self) -> Bools:
        """(d,) whether a parameter always has its mean."""

    def sample(self, rng: np.random.Generator) -> dict[str, float]:
        """One draw of all parameters, by name [SI units], within their bounds."""

    def to_dict(self) -> dict[str, Any]:
        """As JSON, which :func:`from_dict` reads."""


def _bounds(names: Sequence[str]) -> tuple[Floats, Floats]:
    """Least and largest values (d,) that the models accept; ValueError for unknown names and such that come twice."""
    if not names:
        raise ValueError(f"a distribution needs at least one parameter; there are {', '.join(ALL_PARAMETERS)}")
    unknown = [name for name in names if name not in ALL_PARAMETERS]
    if unknown:
        raise ValueError(f"unknown parameter {brief(unknown[0])}; there are {', '.join(ALL_PARAMETERS)}")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the parameter {twice!r} comes twice")
    low, high = np.array([ALL_PARAMETERS[name].bounds for name in names]).reshape(-1, 2).T
    return low, high


def _finite(label: str, names: Sequence[str], values: Floats, axes: int = 1) -> Floats:
    """Values (d,), or (d, d) of two axes, as floats; ValueError for another shape, and for what is not finite."""
    values, needed = np.asarray(values, float), (len(names),) * axes
    if values.shape != needed:
        raise ValueError(f"{label} of {', '.join(names)} has the shape {values.shape}; {needed} is needed")
    for name, value in zip(names, values.reshape(len(names), -1), strict=True):
        if not np.isfinite(value).all():
            raise ValueError(f"{label} of {name} is {value}; it has to be finite")
    return values


def _check_reach(names: Sequence[str], means: Floats, stds: Floats) -> None:
    """Refuse what has hardly a sample within the bounds, such as a value in another unit."""
    for name, mean, std, least, most in zip(names, means, stds, *_bounds(names), strict=True):
        if mean + 2 * std < least or mean - 2 * std > most:
            raise ValueError(f"{name}: {mean} +- 2 * {std} lies outside the bounds [{least}, {most}]")


@dataclass(frozen=True, eq=False)  # arrays have no truth value; to_dict() compares
class Uniform:
    """Independent uniform distributions on [low, high], both (d,) in SI units.

    Raises:
        ValueError: an interval is empty, or not inside the bounds of its parameter.
    """

    names: tuple[str, ...]
    low: Floats
    high: Floats

    def __post_init__(self) -> None:
        lowest, highest = _bounds(self.names)
        ends = (_finite(label, self.names, getattr(self, label)) for label in ("low", "high"))
        for name, low, high, least, most in zip(self.names, *ends, lowest, highest, strict=True):
            if not least <= low <= high <= most:
                raise ValueError(f"{name}: [{low}, {high}] is no interval inside the bounds [{least}, {most}]")

    @property
    def mean(self) -> Floats:
        """(d,) the middle of the box [SI units]."""
        return 0.5 * (np.asarray(self.low, float) + np.asarray(self.high, float))

    @property
    def constant(self) -> Bools:
        """(d,) whether a parameter always has its mean."""
        return np.asarray(self.low) == np.asarray(self.high)

    def sample(self, rng: np.random.Generator) -> dict[str, float]:
        """One draw of all parameters, by name [SI units]."""
        return dict(zip(self.names, rng.uniform(self.low, self.high).tolist(), strict=True))

    def to_dict(self) -> dict[str, Any]:
        """As JSON, which :func:`from_dict` reads."""
        return {"type": "uniform", **_columns(self.names, low=self.low, high=self.high)}


@dataclass(frozen=True, eq=False)
class TruncatedNormal:
    """Independent normals, truncated at mean +- 2 std, both (d,) in SI units, and at the parameters' bounds.

    Raises:
        ValueError: a standard deviation is negative, or what a parameter can be lies outside its bounds.
    """

    names: tuple[str, ...]
    mean: Floats
    std: Floats

    def __post_init__(self) -> None:
        _bounds(self.names)
        _finite("mean", self.names, self.mean)
        for name, std in zip(self.names, _finite("std", self.names, self.std), strict=True):
            if std < 0:
                raise ValueError(f"{name}: a standard deviation of {std} is negative")
        _check_reach(self.names, self.mean, self.std)

    @property
    def constant(self) -> Bools:
        """(d,) whether a parameter always has its mean."""
        return np.asarray(self.std) == 0.0

    def sample(self, rng: np.random.Generator) -> dict[str, float]:
        """One draw of all parameters, by name [SI units]."""
        draws = rng.random(len(self.names))  # one draw each, whatever the truncation
        return {
            name: _truncated_normal_quantile(u, mean, std, least, most)
            for name, u, mean, std, least, most in zip(
                self.names, draws, self.mean, self.std, *_bounds(self.names), strict=True
            )
        }

    def to_dict(self) -> dict[str, Any]:
        """As JSON, which :func:`from_dict` reads."""
        return {"type": "truncated_normal", **_columns(self.names, mean=self.mean, std=self.std)}


def _truncated_normal_quantile(u: float, mean: float, std: float, least: float, most: float) -> float:
    """Quantile u of a normal that is truncated at two standard deviations and at its bounds."""
    low, high = max(least, mean - 2 * std), min(most, mean + 2 * std)
    if low >= high:
        return float(np.clip(mean, least, most))
    normal = NormalDist(mean, std)
    p = normal.cdf(low) + u * (normal.cdf(high) - normal.cdf(low))
    return float(np.clip(normal.inv_cdf(p), low, high))


@dataclass(frozen=True, eq=False)
class Gaussian:
    """A normal distribution of mean (d,) and full covariance (d, d), clipped to the parameters' bounds as published.

    Raises:
        ValueError: the covariance is none, or what a parameter can be lies outside its bounds.
    """

    names: tuple[str, ...]
    mean: Floats
    cov: Floats

    def __post_init__(self) -> None:
        _bounds(self.names)
        _finite("mean", self.names, self.mean)
        cov = _finite("covariance", self.names, self.cov, axes=2)
        # scaled by the variances, as the parameters' units differ by many orders of magnitude
        scale = np.sqrt(np.maximum(np.diag(cov), np.finfo(float).tiny))
        with np.errstate(over="ignore"):
            correlation = cov / np.outer(scale, scale)
        if not np.allclose(correlation, correlation.T):
            raise ValueError(f"the covariance has to be a symmetric {len(self.names)} x {len(self.names)} matrix")
        if not (largest := np.abs(correlation).max()) <= 1 + 1e-9:  # also of a parameter without a variance
            raise ValueError(f"the covariance is not positive semi-definite: there are correlations of {largest:.3g}")
        if (lowest := np.linalg.eigvalsh(correlation).min()) < -1e-9:
            raise ValueError(f"the covariance is not positive semi-definite: its correlation has eigenvalue {lowest}")
        _check_reach(self.names, self.mean, np.sqrt(np.diag(cov)))

    @property
    def constant(self) -> Bools:
        """(d,) whether a parameter always has its mean."""
        return np.diag(self.cov) == 0.0

    def holds(self, name: str, value: float) -> bool:
        """Whether a parameter always has a value, as one that was known when the others were inferred."""
        i = self.names.index(name) if name in self.names else None
        return i is not None and bool(self.mean[i] == value) and not bool(self.cov[i, i])

    def sample(self, rng: np.random.Generator) -> dict[str, float]:
        """One draw of all parameters, by name [SI units]; what lies beyond the bounds becomes them."""
        scale = np.sqrt(np.diag(self.cov))
        unit = np.where(scale > 0, scale, 1.0)
        draw = rng.multivariate_normal(np.zeros(len(self.names)), self.cov / np.outer(unit, unit), method="eigh")
        values = np.clip(self.mean + unit * draw, *_bounds(self.names))
        return dict(zip(self.names, values.tolist(), strict=True))

    def to_dict(self) -> dict[str, Any]:
        """As JSON, which :func:`from_dict` reads."""
        return {
            "type": "gaussian",
            "names": list(self.names),
            "mean": np.asarray(self.mean).tolist(),
            "cov": np.asarray(self.cov).tolist(),
        }


def _columns(names: Sequence[str], **columns: Floats) -> dict[str, dict[str, dict[str, float]]]:
    """Numbers (d,) by column, as the rows of the parameters."""
    rows = zip(names, *(np.asarray(c).tolist() for c in columns.values()), strict=True)
    return {"parameters": {name: dict(zip(columns, values, strict=True)) for name, *values in rows}}


@overload
def holding(distribution: Distribution, values: Mapping[str, float]) -> Distribution: ...
@overload
def holding(distribution: None, values: Mapping[str, float]) -> TruncatedNormal | None: ...
@overload
def holding(distribution: Distribution | None, values: Mapping[str, float]) -> Distribution | None: ...
def holding(distribution: Distribution | None, values: Mapping[str, float]) -> Distribution | None:
    """A distribution in which some parameters are held at ``values``; None stands for nominal parameters."""
    if not values:
        return distribution
    constants = TruncatedNormal(tuple(values), np.array(list(values.values())), np.zeros(len(values)))
    if distribution is None:
        return constants
    if isinstance(distribution, Gaussian):
        if free := [name for name, value in values.items() if not distribution.holds(name, value)]:
            raise ValueError(f"{', '.join(free)} cannot be held in a Gaussian; infer the others with it known")
        return distribution
    columns = ("low", "high") if isinstance(distribution, Uniform) else ("mean", "std")
    rows = distribution.to_dict()["parameters"]
    for name, value in values.items():
        rows[name] = dict(zip(columns, (value, value) if columns[0] == "low" else (value, 0.0), strict=True))
    return from_dict({**distribution.to_dict(), "parameters": rows})


def told_values(found: Distribution | None, training: Distribution) -> dict[str, float]:
    """What a policy is told of a robot, of the parameters that its training draws [SI units].

    A parameter that training holds constant has that value. Any other one has the mean of ``found``, or the bound that
    this is beyond; the nominal value where ``found``, if it is not None, is not over it.
    """
    means = {} if found is None else dict(zip(found.names, np.clip(found.mean, *_bounds(found.names)), strict=True))
    drawn = zip(training.names, training.mean, training.constant, strict=True)
    means |= {name: mean for name, mean, constant in drawn if constant}
    return {name: float(means.get(name, ALL_PARAMETERS[name].nominal)) for name in training.names}


def alike(one: Any, other: Any) -> bool:
    """Whether two descriptions give the same samples: samples depend on the order of the parameters too."""
    return one == other and list((one or {}).get("parameters", ())) == list((other or {}).get("parameters", ()))


def search_box(parameters: Sequence[Parameter]) -> Uniform:
    """The uniform distribution over the published search box."""
    low, high = np.array([p.search for p in parameters]).T
    return Uniform(tuple(p.name for p in parameters), low, high)


def random_box(parameters: Sequence[Parameter], rng: np.random.Generator) -> Uniform:
    """A random box inside the search box: two uniform draws per parameter are its ends, as in published UDR."""
    box = search_box(parameters)
    ends = np.sort(rng.uniform(box.low, box.high, size=(2, len(parameters))), axis=0)
    return Uniform(box.names, ends[0], ends[1])


def from_dict(data: Mapping[str, Any]) -> Distribution:
    """The distribution that ``to_dict`` described; ValueError for anything else."""
    if not isinstance(data, Mapping):
        raise ValueError(f"{data!r} is no JSON object"[:200])
    kind = data.get("type")
    try:
        if kind == "gaussian":
            return Gaussian(tuple(data["names"]), _numbers(data["mean"]), _numbers(data["cov"]))
        families: dict[str, tuple[type[Uniform | TruncatedNormal], tuple[str, str]]]
        families = {"uniform": (Uniform, ("low", "high")), "truncated_normal": (TruncatedNormal, ("mean", "std"))}
        if kind not in families:
            raise ValueError(f"unknown distribution type {brief(kind)}; there are {', '.join([*families, 'gaussian'])}")
        family, columns = families[kind]
        rows = data["parameters"]
        values = _numbers([[rows[name][c] for c in columns] for name in rows]).reshape(-1, 2)
        return family(tuple(rows), values[:, 0], values[:, 1])
    except (KeyError, TypeError, OverflowError) as error:
        raise ValueError(f"incomplete {kind} distribution: {error!r} is missing or malformed") from error


def _numbers(values: Any) -> Floats:
    """Of a JSON file; TypeError for texts, and for true and false, which NumPy takes for numbers."""
    array = np.asarray(values)
    if array.size and array.dtype.kind not in "if":
        raise TypeError(f"{brief(values)}, which is not all numbers,")
    return array.astype(float)


def load(path: str | Path) -> Distribution:
    """Read a distribution from a JSON file."""
    try:
        return from_dict(read_json(path))
    except ValueError as error:
        raise ValueError(f"{path} is no distribution: {error}") from error
