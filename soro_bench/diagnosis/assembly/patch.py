"""The patch: physics that the simulation should have, and a MuJoCo model with as much of it as MJCF can express.

The model alone is replayed from its MJCF on the recordings. Where it is worse there than the model as it was built, or
than one with fitted parameters only, its parameters are fitted again with what MJCF can express; if it is still worse
than the model as built, there is no patched model.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.assembly.errors import plain, rms_as_it_is
from soro_bench.diagnosis.assembly.model_export import ExportedModel, PatchError, exported
from soro_bench.diagnosis.assembly.native_laws import LAWS
from soro_bench.diagnosis.candidates import Term, slices, term
from soro_bench.diagnosis.estimation.fit import LEAST_GAIN, Hypothesis, descended
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.result_robot import ReplayError
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.model_probabilities import Answer
from soro_bench.effects.catalogue import CATEGORIES
from soro_bench.effects.effect import Effect, Location

KEPT = 0.5  # of the share of the variance that is explained
_NOISE = 9.0  # of squared errors over that of the sensor: three standard deviations, once, make no model worse
_OF_FRICTION = ("coulomb_friction", "viscous_friction")  # what MJCF has of friction, whatever its law
_REFITTED = "Its parameters were fitted without what is not in this model: do not add that."


@dataclass(frozen=True)
class ModelPatch:
    """A model in MJCF with the fitted parameters.

    state: "as_found", "refitted" (other parameters, since it would be worse alone) or "not_written". xml: None where it
    is not written; ``obstacle`` says why it is not as found. effects: in the model. remaining: of the patch, those that
    are not. errors: of replays of the model alone, on the recordings fitted to and on held-out ones.
    """

    state: str
    xml: str | None
    effects: tuple[Effect, ...]
    remaining: tuple[Effect, ...]
    obstacle: str | None = None
    errors: tuple[ReplayError, ...] = ()


def patch(diagnosis: Diagnosis) -> list[Effect]:
    """The physics that the simulation should have; none where nothing is missing or held-out recordings got worse.

    Outside the catalogue, the nearest law is worth having if it is more than a description of the
    recordings that it was fitted to: if held-out ones keep ``KEPT`` of what it explains.
    """
    if law := described(diagnosis):
        return law.effects(diagnosis.explanation.problem.parameters)
    best = diagnosis.best
    wanted = {"outside_catalogue": keeps(best), "adequate": False}.get(diagnosis.verdict, True)
    if not wanted or rejected(diagnosis):
        return []
    return best.hypothesis.effects(diagnosis.explanation.problem.parameters)


def described(diagnosis: Diagnosis) -> Hypothesis | None:
    """The fitted law of a discrepancy outside the catalogue; None where none holds on held-out motion."""
    found = diagnosis.discovery if diagnosis.verdict == "outside_catalogue" else None
    return found.best.hypothesis if found and found.best else None


def keeps(answer: Answer) -> bool:
    """Whether an answer explains held-out recordings about as well as those that it was fitted to."""
    return answer.heldout is not None and answer.heldout.explained > KEPT * answer.train.explained


def kept(diagnosis: Diagnosis) -> Hypothesis:
    """What the patch is of; the nominal robot where there is none, since parameters that were fitted together with
    effects that are not there would be wrong."""
    best = described(diagnosis) or diagnosis.best.hypothesis
    return best if patch(diagnosis) else diagnosis.explanation.nominal


def rejected(diagnosis: Diagnosis) -> bool:
    """Whether the hypothesis that the report is of makes held-out recordings worse."""
    heldout = diagnosis.best.heldout if described(diagnosis) is None else None
    return heldout is not None and heldout.after > heldout.before


def model_patch(diagnosis: Diagnosis, built: Sequence[float]) -> ModelPatch:
    """The robot's model with what was fitted: the parameters, and those effects of the patch that MJCF can express.

    Args:
        built: errors of the model as built [signal's unit], on the recordings fitted to and on held-out ones.
    """
    robot = diagnosis.robot
    effects = (*robot.known_effects, *patch(diagnosis))
    try:
        found = exported(robot, robot.parameters(kept(diagnosis).x), effects)
    except PatchError as error:
        return ModelPatch("not_written", None, (), effects, str(error))
    problems = [each for each in (diagnosis.explanation.problem, diagnosis.tested) if each is not None]
    alone = rms_as_it_is(robot.as_built(found.xml), problems)
    first, simple = _errors(built, alone), _with_parameters_only(diagnosis)
    least = rms_as_it_is(robot.as_built(simple.xml), problems) if simple else built
    good = not _worse(first, problems)
    if good and not (found.remaining and _worse(_errors(least, alone), problems)):
        return ModelPatch("as_found", found.xml, found.effects, found.remaining, None, first)
    obstacle = "replayed alone, it is worse than the model as built"
    if good:
        obstacle = "replayed alone, it is worse than with parameters that were fitted without effects"
    for other in _refitted(diagnosis):
        after = rms_as_it_is(robot.as_built(other.xml), problems)
        errors = _errors(built, after)
        if not (_worse(errors, problems) or _worse(_errors(least, after), problems)):
            return ModelPatch("refitted", other.xml, other.effects, lacking(effects, other.effects), obstacle, errors)
    if simple and not _worse(errors := _errors(built, least), problems):
        return ModelPatch("refitted", simple.xml, simple.effects, lacking(effects, simple.effects), obstacle, errors)
    if good:
        return ModelPatch("as_found", found.xml, found.effects, found.remaining, None, first)
    obstacle += ", and so is every one with parameters that were fitted to it alone"
    return ModelPatch("not_written", None, (), effects, obstacle, first)


def lacking(effects: Sequence[Effect], held: Sequence[Effect]) -> tuple[Effect, ...]:
    """Those of some effects that are not among the ones that a model has, whatever their magnitudes."""
    found = {(each.name, each.location) for each in held}
    return tuple(each for each in effects if (each.name, each.location) not in found)


def _with_parameters_only(diagnosis: Diagnosis) -> ExportedModel | None:
    """The model with parameters that were fitted without the patch; None if MJCF cannot hold it."""
    robot = diagnosis.robot
    try:
        return exported(robot, robot.parameters(diagnosis.explanation.nominal.x), robot.known_effects, _REFITTED)
    except PatchError:
        return None


def _errors(before: Sequence[float], after: Sequence[float]) -> tuple[ReplayError, ...]:
    return tuple(ReplayError(*pair) for pair in zip(before, after, strict=True))


def _worse(errors: Sequence[ReplayError], problems: Sequence[Problem]) -> bool:
    """Whether any errors grew by more than the sensor's noise could do."""
    samples = (sum(part.sum() for part in p.split(p.weight)) for p in problems)  # of the signal that errors are of
    rows = zip(errors, problems, samples, strict=True)
    return any((e.patched**2 - e.built**2) * count > _NOISE * p.sensor**2 for e, p, count in rows)


def _refitted(diagnosis: Diagnosis) -> Iterator[ExportedModel]:
    """Models with parameters, and laws of MJCF in the place of the patch's, that were fitted by least squares, from one
    start after the other. A fit ends where a step changes the rms by less than what counts as the same error."""
    robot, problem = diagnosis.robot, plain(diagnosis.explanation.problem, diagnosis.robot)
    least_gain = max(LEAST_GAIN, 2.0 * problem.settings.report.same_error)
    for start in _begun(diagnosis, problem):
        (each,) = descended(problem, [start], least_gain)
        effects = (*robot.known_effects, *each.effects(problem.parameters))
        try:
            yield exported(robot, robot.parameters(each.x), effects, _REFITTED)
        except PatchError:
            continue


def _begun(diagnosis: Diagnosis, problem: Problem) -> list[Hypothesis]:
    """Where the fits begin: at what was found, at the parameters that were fitted alone, and at the model as built."""
    found, robot, d = kept(diagnosis), diagnosis.robot, problem.parameters
    pairs = zip(found.terms, slices(found.terms, d), strict=True)
    parts = [each for term, part in pairs for each in term.parts(found.x[part])]
    values = {(one.name, one.location): x for one, x in parts}
    terms = _expressible(robot, [one for one, _ in parts], problem)
    still = [np.zeros(one.size) for one in terms]
    as_found = [values.get((one.name, one.location), nothing) for one, nothing in zip(terms, still, strict=True)]
    points = [
        np.concatenate([found.x[:d], *as_found]),
        np.concatenate([diagnosis.explanation.nominal.x[:d], *still]),
        np.concatenate([np.zeros(d), *still]),
    ]
    points = [x for i, x in enumerate(points) if not any(np.array_equal(x, other) for other in points[:i])]
    rows = problem.residuals([(x, terms) for x in points])
    return [_hypothesis(problem, terms, x, row) for x, row in zip(points, rows, strict=True)]


def _hypothesis(problem: Problem, terms: tuple[Term, ...], x: Floats, residual: Floats) -> Hypothesis:
    nothing = np.zeros((0, residual.size))
    return Hypothesis(terms, x, residual, problem.cost(residual, x), nothing, nothing)


def _expressible(robot: Robot, terms: Sequence[Term], problem: Problem) -> tuple[Term, ...]:
    """Terms of laws that MJCF has: those of some terms, and dry and viscous friction in the place of other friction."""
    found: dict[tuple[str, object], Term] = {}
    for one in terms:
        if CATEGORIES.get(one.name) == "friction" and not one.removable:
            rubbed = [(name, at) for at in _rubbed(robot, one.location) for name in _OF_FRICTION]
            others = [term(robot, name, at, problem.settings.priors) for name, at in rubbed]
        else:
            effect = one.effect(np.zeros(one.size))
            others = [one] if one.name in LAWS or robot.native(effect) else []
        found |= {(each.name, each.location): each for each in others}
    chosen = tuple(found.values())
    return chosen if robot.accepts([each.effect(np.zeros(each.size)) for each in chosen]) else ()


def _rubbed(robot: Robot, location: Location) -> list[Location]:
    """Where friction at a location acts: of actuators at the joints and tendons that they drive."""
    elements = robot.elements
    return [elements.driven_by(at) for at in elements.expand(location)] if location.kind == "actuator" else [location]
