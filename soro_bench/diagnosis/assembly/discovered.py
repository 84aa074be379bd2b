"""A discovered law as a result tells it."""

from collections.abc import Sequence

import mujoco
import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.assembly.findings import tempered
from soro_bench.diagnosis.candidates import slices
from soro_bench.diagnosis.discovery.discovery import Discovery, Found
from soro_bench.diagnosis.discovery.law_terms import LawTerm
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.result_parts import NEAR, NINETY, DiscoveredLaw, Estimate
from soro_bench.effects.custom_law import CustomLaw
from soro_bench.effects.effect import Effect, Location
from soro_bench.effects.expression import names_in

_SHOWN = 400  # points of a figure


def discovered_law(diagnosis: Diagnosis) -> DiscoveredLaw | None:
    """The law, or that none holds; None where none was looked for."""
    found = diagnosis.discovery
    if found is None:
        return None
    effects = _effects(diagnosis, found.best) if found.best else []
    state, force, law, labels = _curve(found, effects)
    equations = tuple(map(_equation, effects))
    others = ["; ".join(map(_equation, _effects(diagnosis, each))) for each in found.others]
    return DiscoveredLaw(
        location=found.location,
        effects=tuple(each.to_json() for each in effects),
        equations=equations,
        legend=legend(effects),
        estimates=_estimates(diagnosis, found.best) if found.best else (),
        explained=float(found.explained),
        noise_share=float(found.noise_share),
        nearest=float(1.0 - found.heldout_nearest / found.heldout_before),
        own_test=found.own_test,
        others=tuple(each for each in dict.fromkeys(others) if each != "; ".join(equations)),  # some differ in digits
        state=tuple(map(float, state)),
        force=tuple(map(float, force)),
        law=tuple(map(float, law)),
        state_label=labels[0],
        force_label=labels[1],
        peak=float(found.peaks[0]) if found.peaks else 0.0,
        peaks=tuple(map(float, found.peaks)),
        black_box=found.best is not None and found.best.boxed,
    )


def region(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Bodies, from the base on, that those at which an input explains nearly as much as at the best one span; empty
    where there is one such body, or where they are not on one chain."""
    ranked = diagnosis.ranked_locations
    near = [each.location for each in ranked if each.gain >= NEAR * ranked[0].gain and each.location.kind == "body"]
    if len(near) < 2 or ranked[0].location.kind != "body":
        return ()
    elements = diagnosis.robot.elements
    return spanned(elements.model, [elements.id(each) for each in near])


def spanned(model: mujoco.MjModel, bodies: Sequence[int]) -> tuple[str, ...]:
    """Names of the bodies of a chain from the first to the last of some, from the base on; empty where these are on
    several branches."""
    last = max(bodies)  # MuJoCo numbers children after their parents
    chain = [last]
    while chain[-1] not in (min(bodies), 0):
        chain.append(int(model.body_parentid[chain[-1]]))
    return tuple(model.body(i).name for i in reversed(chain)) if set(bodies) <= set(chain) else ()


def _effects(diagnosis: Diagnosis, found: Found) -> list[Effect]:
    return found.hypothesis.effects(diagnosis.explanation.problem.parameters)


def _law(effect: Effect) -> CustomLaw:
    assert effect.law is not None
    return effect.law


def legend(effects: Sequence[Effect]) -> dict[str, str]:
    """What the names in the equations of some effects are: each meaning once, with where it holds unless the name means
    the same in all of them."""
    meanings: dict[str, dict[tuple[str, Location | None], str]] = {}
    for effect, place in zip(effects, _places(effects), strict=True):
        law = _law(effect)
        anywhere = {each.name for each in law.variables if each.place is not None or each.of == "time"}
        for name, said in law.legend().items():
            meaning, of = (said, None if name in anywhere else effect.location), meanings.setdefault(name, {})
            of[meaning] = f"{of[meaning]} and{place}" if meaning in of else place
    several = len({each.location for each in effects}) > 1
    return {
        name + (place if len(of) > 1 or (own and several) else ""): said
        for name, of in meanings.items()
        for (said, own), place in of.items()
    }


def _places(effects: Sequence[Effect]) -> list[str]:
    """What tells the names of each effect from those of the others: where it acts."""
    return [f" at {each.location}{_along(_law(each))}" if len(effects) > 1 else "" for each in effects]


def _along(law: CustomLaw) -> str:
    return f" along {law.direction}" if isinstance(law.direction, str) and law.direction else ""


def _equation(effect: Effect) -> str:
    law = _law(effect)
    towards = _along(law)
    if isinstance(law.direction, tuple):
        point = ", ".join(f"{1e3 * effect.parameters[str(name)]:.0f}" for name in law.direction)
        towards = f" towards ({point}) mm"
    return f"{effect.location}: {law.equation(effect.parameters)} [{law.unit}]{towards}"


def _estimates(diagnosis: Diagnosis, found: Found) -> tuple[Estimate, ...]:
    """Coefficients and shapes with intervals."""
    hypothesis, first = found.hypothesis, diagnosis.explanation.problem.parameters
    spread = np.sqrt(np.diag(tempered(diagnosis, hypothesis)))
    estimates, places = [], _places(_effects(diagnosis, found))
    for term, part, place in zip(hypothesis.terms, slices(hypothesis.terms, first), places, strict=True):
        assert isinstance(term, LawTerm)
        for unknown, x, width in zip(term.unknowns, hypothesis.x[part], spread[part], strict=True):
            low, high = sorted(unknown.value(float(x + k * NINETY * width)) for k in (-1.0, 1.0))
            estimates.append(Estimate(unknown.name + place, unknown.value(float(x)), unknown.unit, low, high))
    return tuple(estimates)


def _curve(found: Discovery, effects: Sequence[Effect]) -> tuple[Floats, Floats, Floats, tuple[str, str]]:
    """The main variable, the input of its channel and the law, in some of the control steps, with labels."""
    located, channel = found.located, found.best.structure.candidates[0].channel if found.best else 0
    reads, force = located.reads[channel], located.force[:, channel]
    shown, law = next(each for each in reads if each.name == "t"), np.full(len(force), np.nan)
    place = ""
    if effects:
        assert found.best is not None
        which = sorted({each.channel for each in found.best.structure.candidates}).index(channel)
        effect, place = effects[which], _places(effects)[which]
        reads = [*reads, *located.distances(effect)]
        law, force = located.exerted(effect, reads), located.along(effect, channel)
        used = names_in(_law(effect).expression).union(*(names_in(each.input) for each in _law(effect).states))
        shown = next((each for each in reads if each.name in used), shown)
    order = np.arange(0, len(law), max(1, len(law) // _SHOWN))
    at = "" if shown.variable.place is None else f" of {shown.variable.place.kind} {shown.variable.place.name}"
    labels = f"{shown.variable.of}{at} [{shown.unit}]", f"input{place} [{located.channels[channel].unit}]"
    return shown.values[order], force[order], law[order], labels
