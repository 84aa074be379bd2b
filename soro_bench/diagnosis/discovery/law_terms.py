"""Discovered laws as terms of a hypothesis: their coefficients and shapes are unknowns of fits by replays."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.candidates import Term as CandidateTerm
from soro_bench.diagnosis.discovery.library import Read, Shape, Term
from soro_bench.diagnosis.discovery.located_input import LocatedInput
from soro_bench.diagnosis.discovery.regression import Structure
from soro_bench.diagnosis.settings import DiscoverySettings, PriorSettings
from soro_bench.effects.custom_law import NAME, CustomLaw, Memory, Variable
from soro_bench.effects.effect import Effect, Location, Quantity
from soro_bench.effects.expression import Bumps, Node

_POINT = ("px", "py", "pz")
_APART = 0.05  # m, standard deviation of the prior of a point
_WIDER = 1.0  # of a range, on both sides of it, until held-out motion has been seen
_ANYTHING = (-np.inf, np.inf)


@dataclass(frozen=True)
class Unknown:
    """A parameter of a law: its prior's centre and deviation, of its logarithm if it is positive.

    start: where its fit begins, a coordinate. is_coefficient: of a term; else it shapes one.
    """

    name: str
    unit: str
    centre: float
    deviation: float
    positive: bool
    start: float = 0.0
    is_coefficient: bool = False

    def value(self, x: float) -> float:
        """At a coordinate."""
        return float(self.centre * np.exp(self.deviation * x) if self.positive else self.centre + self.deviation * x)


@dataclass(frozen=True)
class LawTerm(CandidateTerm):
    """A law that is data, at a location; its unknowns are the coordinates."""

    law: CustomLaw | None = None
    unknowns: tuple[Unknown, ...] = ()

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Of the parameters, with their units."""
        return tuple(Quantity(each.name, each.unit, each.centre, _ANYTHING) for each in self.unknowns)

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.unknowns)

    @property
    def deviations(self) -> Floats:
        """(size,) of the priors."""
        return np.array([each.deviation for each in self.unknowns])

    @property
    def simulated(self) -> Floats:
        """(size,) where a fit begins."""
        return np.array([each.start for each in self.unknowns])

    @property
    def bounds(self) -> Floats:
        """(2, size) least and largest coordinates."""
        return np.full((2, self.size), self.settings.limit) * [[-1.0], [1.0]]

    def effect(self, x: Floats) -> Effect:
        """The effect at coordinates x (size,)."""
        values = {each.name: each.value(at) for each, at in zip(self.unknowns, x.tolist(), strict=True)}
        return Effect(NAME, self.location, values, self.law)


def law_terms(structure: Structure) -> tuple[LawTerm, ...]:
    """The law of each channel that a structure has one of, with unknowns that begin at its regressed coefficients."""
    located, found = structure.located, []
    settings = located.problem.settings.discovery
    for number in sorted({each.channel for each in structure.candidates}):
        parts = [
            (term, coefficient)
            for candidate, own in zip(structure.candidates, structure.coefficients, strict=True)
            if candidate.channel == number
            for term, coefficient in zip(candidate.terms, own, strict=True)
        ]
        point = next((each.point for each in structure.candidates if each.channel == number), ())
        found.append(_law_term(located, number, parts, point, settings))
    return tuple(found)


def _law_term(
    located: LocatedInput, number: int, parts: Sequence[tuple[Term, float]], point: tuple[float, ...],
    settings: DiscoverySettings,
) -> LawTerm:  # fmt: skip
    channel, reads = located.channels[number], {each.name: each for each in located.reads[number]}
    unknowns, nodes = [], list[Node]()
    shapes: dict[str, Shape] = {}
    variables: dict[str, Variable] = {}
    states: dict[str, Memory] = {}
    for i, (term, coefficient) in enumerate(parts):
        name = f"c{i + 1}" if len(parts) > 1 else "c"
        unit = channel.unit if term.unit == "1" else f"{channel.unit}/({term.unit})"
        deviation = settings.deviation * max(abs(coefficient), 1e-12)
        unknowns.append(
            Unknown(name, unit, 0.0, deviation, False, float(np.sign(coefficient)) / settings.deviation, True)
        )
        nodes.append(name if term.expression == 1.0 else ("multiply", name, term.expression))
        shapes |= {each.name: each for each in term.shapes}
        wider = 0.0 if isinstance(term.expression, Bumps) else _WIDER
        variables |= {each.name: _ranged(each, reads, wider) for each in term.variables}
        states |= {each.name: each for each in term.states}
    priors = located.problem.settings.priors
    unknowns += [_of_shape(each, priors) for each in shapes.values()]
    unknowns += [Unknown(name, "m", at, _APART, False) for name, at in zip(_POINT, point, strict=False)]
    boxed = any(isinstance(term.expression, Bumps) for term, _ in parts)
    largest = (1.0 if boxed else settings.limit) * float(np.abs(located.force).max()) + 1e-9
    expression: Node = nodes[0] if len(nodes) == 1 else ("add", *nodes)
    law = CustomLaw(
        channel.unit, largest, expression, tuple(variables.values()), tuple(states.values()),
        tuple((each.name, each.unit) for each in unknowns), _POINT if point else channel.direction,
    )  # fmt: skip
    location: Location = channel.location
    return LawTerm(NAME, location, tuple(each.centre for each in unknowns), (True,) * len(unknowns),
                   settings=priors, law=law, unknowns=tuple(unknowns))  # fmt: skip


def _of_shape(shape: Shape, settings: PriorSettings) -> Unknown:
    deviation = settings.shape_deviation if shape.positive else shape.deviation
    return Unknown(shape.name, shape.unit, shape.value, deviation, shape.positive)


def _ranged(variable: Variable, reads: dict[str, Read], wider: float) -> Variable:
    """The variable with the range in which it was seen, ``wider`` on both sides of it; time goes on."""
    if variable.of == "time" or variable.name not in reads:
        return replace(variable, low=0.0)
    values = reads[variable.name].values
    low, high = float(values.min()), float(values.max())
    return replace(variable, low=low - wider * (high - low), high=high + wider * (high - low))
