"""What each recording alone says of the parameters and of the effects' magnitudes, for a result."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.assembly.findings import tempered_by
from soro_bench.diagnosis.assembly.patch import kept
from soro_bench.diagnosis.candidates import Term, slices
from soro_bench.diagnosis.estimation.agreement import Alone, fitted_alone, together
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.result_parts import NINETY, Agreement, Estimate
from soro_bench.diagnosis.robots.priors import Prior
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.spread_terms import SpreadTerm

Ends = tuple[Floats, Floats, Floats]  # (n,) unknowns: at the lower end of the interval, as fitted, at the upper end


def agreement(diagnosis: Diagnosis) -> tuple[Agreement, ...]:
    """Parameters, then magnitudes of effects, each with its estimates from every recording; none for one recording.

    Intervals are those of any result: under tempered evidence, as a model that is wrong knows less than it seems.
    """
    problem, joint = diagnosis.explanation.problem, kept(diagnosis)
    if len(problem.recordings) < 2 or not len(joint.x):
        return ()
    found = fitted_alone(problem, joint, diagnosis.seed)
    spreads = [np.sqrt(np.diag(tempered_by(each.problem, each.hypothesis))) for each in found]
    differences = together(found, spreads)
    ends = [_ends(each, spread) for each, spread in zip(found, spreads, strict=True)]
    alpha = problem.settings.agreement.alpha
    told = []
    for i, name, term, make in _quantities(diagnosis.robot, joint.terms):
        each = differences[i]
        told.append(
            Agreement(
                name=name,
                law=term.name if term else "",
                location=term.location if term else None,
                estimates=tuple(make(one) for one in ends),
                p_value=each.p_value,
                overlap=each.overlap,
                changes=each.is_change(alpha),
            )
        )
    return tuple(told)


def _ends(found: Alone, spread: Floats) -> Ends:
    x = found.hypothesis.x
    return x - NINETY * spread, x, x + NINETY * spread


def _quantities(
    robot: Robot, terms: tuple[Term, ...]
) -> Iterator[tuple[int, str, Term | None, Callable[[Ends], Estimate]]]:
    """Of unknowns: the index, name, term that it belongs to, and a function that makes an estimate of it.

    Laws at each element are left out: single unknowns of theirs are no magnitudes.
    """
    for i, prior in enumerate(robot.priors):
        yield i, prior.name, None, partial(_of_parameter, prior, i)
    for term, part in zip(terms, slices(terms, len(robot.priors)), strict=True):
        for i, quantity in enumerate(() if isinstance(term, SpreadTerm) else term.quantities, part.start):
            unit = robot.unit_at(quantity.unit, term.location)
            yield i, quantity.name, term, partial(_of_term, term, part, quantity.name, unit)


def _of_parameter(prior: Prior, i: int, ends: Ends) -> Estimate:
    return _estimate(prior.name, prior.unit, *(float(prior.value(x[i])) for x in ends))


def _of_term(term: Term, part: slice, name: str, unit: str, ends: Ends) -> Estimate:
    return _estimate(name, unit, *(float(term.effect(x[part]).parameters[name]) for x in ends))


def _estimate(name: str, unit: str, low: float, value: float, high: float) -> Estimate:
    return Estimate(name, value, unit, *sorted((low, high)))
