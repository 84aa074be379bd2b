"""The result of a diagnosis, from its internal state: everything that is shown, as plain numbers and names."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from soro_bench.diagnosis.assembly.agreement import agreement
from soro_bench.diagnosis.assembly.discovered import discovered_law, region
from soro_bench.diagnosis.assembly.errors import (
    PlainReplays,
    leave_most,
    plain_replays,
    replayed_robots,
    worse_replays,
)
from soro_bench.diagnosis.assembly.findings import deviations, findings, prior_values, tempered
from soro_bench.diagnosis.assembly.force_against_state import force_against_state
from soro_bench.diagnosis.assembly.limits import reached_limits
from soro_bench.diagnosis.assembly.patch import described, kept, model_patch, patch, rejected
from soro_bench.diagnosis.assembly.shapes import shapes
from soro_bench.diagnosis.candidates import Term
from soro_bench.diagnosis.localisation.residual_maps import explained_over_time
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.result import LawCurve, Result
from soro_bench.diagnosis.result_parts import (
    NINETY,
    Agreement,
    Detectable,
    Errors,
    Estimate,
    Finding,
    FittedTerms,
    HypothesisSummary,
    ModelForm,
    NamedLocation,
    NextRecording,
    ParameterEstimate,
    RankedLocation,
    ScreenedTerm,
    SelectionRound,
    UnknownInput,
)
from soro_bench.diagnosis.result_robot import Patch, Replay, RobotSummary, SignalErrors, SignalQuality
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.selection.model_probabilities import Answer, Comparison
from soro_bench.diagnosis.selection.rounds import Round
from soro_bench.diagnosis.selection.significance import alpha
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.effects.catalogue import ALL, CATEGORIES
from soro_bench.effects.effect import Location

CREDIBLE = 0.9  # probability of the credible set
SHOWN_LOCATIONS = 10

Rows = tuple[tuple[float, ...], ...]


def build_result(diagnosis: Diagnosis) -> Result:
    """The result that renderers show. Replays all hypotheses at the time step of the model, and the law of the best one
    once more."""
    comparison, explanation = diagnosis.comparison, diagnosis.explanation
    replays = plain_replays(diagnosis)
    train, heldout = replays.errors(diagnosis, diagnosis.best)
    found = _all_findings(diagnosis, replays)
    alone = agreement(diagnosis)
    settings, law = explanation.problem.settings, described(diagnosis)
    robots = replayed_robots(diagnosis, replays, bool(patch(diagnosis)), law)
    return Result(
        robot=_robot(diagnosis),
        verdict=_verdict(diagnosis, alone, heldout or train),
        p_value=comparison.p_value,
        alpha=alpha(settings),
        unknown=float(comparison.unknown),
        healthy=float(comparison.nothing),
        predicted_gain=float(explanation.predicted_gain),
        remaining_gain=float(explanation.remaining_gain),
        recordings=_recordings(diagnosis, replays),
        trained_on=len(explanation.problem.recordings),
        outliers=diagnosis.outliers,
        findings=found,
        categories=_categories(diagnosis, found),
        hypotheses=tuple(_hypothesis(diagnosis, replays, answer) for answer in comparison.ranked),
        rounds=tuple(_round(each) for each in explanation.rounds),
        credible_set=_credible(comparison, "outliers" if _only_outliers(diagnosis) else "none"),
        train=train,
        heldout=heldout,
        parameters_only=float(explanation.parameters_only_rms),
        parameters=_parameters(diagnosis),
        covariance=_covariance(diagnosis),
        trainable=isinstance(diagnosis.robot, SuiteRobot),
        patch=_patch(diagnosis, replays),
        locations=tuple(RankedLocation(p.location, float(p.gain)) for p in _ranked(diagnosis)),
        unknown_input=_unknown_input(diagnosis),
        detectable=detectable(diagnosis),
        undetectable=undetectable(diagnosis),
        not_searched=tuple(sorted(set(ALL) - explanation.looked_for - {"outliers"})),
        next_recording=_next_recording(diagnosis),
        curve=_curve(diagnosis),
        replay=_replay(diagnosis, replays),
        shapes=shapes(diagnosis),
        seed=diagnosis.seed,
        seconds=round(diagnosis.seconds, 1),
        settings=_changed(settings),
        notes=_notes(diagnosis),
        data=diagnosis.data,
        robots=robots,
        worse_replays=worse_replays(robots, settings.report.same_error),
        agreement=alone,
        limits=reached_limits(diagnosis),
        signals=_signals(diagnosis, replays),
        discovery=discovered_law(diagnosis),
        region=region(diagnosis),
        model_form=ModelForm(float(comparison.model_form), float(explanation.problem.model_form)),
    )


def _verdict(diagnosis: Diagnosis, alone: Sequence[Agreement], errors: Errors) -> str:
    """That of the diagnosis; where no law was detected, parameters that change from recording to recording count, and
    replays that leave most of the motion."""
    if diagnosis.detected:
        return diagnosis.verdict
    if any(each.changes for each in alone):
        return "recordings_disagree"
    return "undecided" if diagnosis.verdict == "adequate" and leave_most(errors) else diagnosis.verdict


def _notes(diagnosis: Diagnosis) -> tuple[str, ...]:
    """What a user should know of the model, the mapping and the recordings; the same only once."""
    recordings = [("recording", diagnosis.explanation.problem.recordings)]
    recordings += [("held-out recording", diagnosis.tested.recordings)] if diagnosis.tested else []
    found = [*diagnosis.robot.notes]
    found += [f"{name} {i}: {text}" for name, group in recordings for i, each in enumerate(group, 1)
              for text in each.notes]  # fmt: skip
    if diagnosis.comparison.within_steps:
        found.append("What is left is no noise, but within steps of the sensors: rounding takes half of one, and the "
                     "sensor itself may err by another. A finer sensor would show what it is")  # fmt: skip
    return tuple(dict.fromkeys(found))


def _changed(settings: Settings) -> dict[str, Any]:
    """The settings that differ from their defaults, by "stage.name"."""
    pairs = zip(settings.listed(), DEFAULT.listed(), strict=True)
    return {f"{own[0]}.{own[1]}": own[2] for own, usual in pairs if own[2] != usual[2]}


def _robot(diagnosis: Diagnosis) -> RobotSummary:
    robot = diagnosis.robot
    return RobotSummary(
        robot.name, robot.model_name, robot.signal, robot.unit, tuple(robot.channels), robot.from_baseline, robot.files,
        tuple(each.name for each in robot.others),
    )  # fmt: skip


def _recordings(diagnosis: Diagnosis, replays: PlainReplays) -> tuple[SignalQuality, ...]:
    """The quality of every recording, and what fits left out of it."""
    found = []
    for problem in replays.problems:
        for each, weight in zip(problem.recordings, problem.rows(problem.weight), strict=True):
            far = np.isfinite(each.columns) & (weight == 0)
            found.append(tuple((int(sample), int(column)) for sample, column in np.argwhere(far)))
    columns = zip(diagnosis.data_qualities, diagnosis.digests, found, strict=True)
    return tuple(SignalQuality(a.sigma, a.missing, digest, left_out) for a, digest, left_out in columns)


def _signals(diagnosis: Diagnosis, replays: PlainReplays) -> tuple[SignalErrors, ...]:
    """Errors of every signal, where there are several."""
    count = len(diagnosis.robot.signals)
    return tuple(replays.of_signal(diagnosis, which) for which in range(count)) if count > 1 else ()


def _ranked(diagnosis: Diagnosis) -> Sequence:
    return diagnosis.ranked_locations[:SHOWN_LOCATIONS]


def _all_findings(diagnosis: Diagnosis, replays: PlainReplays) -> tuple[Finding, ...]:
    """Effects of all hypotheses, and what stands for no effect, an unknown one and outliers."""
    outliers, comparison = diagnosis.outliers, diagnosis.comparison
    only = _only_outliers(diagnosis)
    location = diagnosis.ranked_locations[0].location if diagnosis.ranked_locations else None
    found = [*findings(diagnosis, replays)]
    found.append(Finding("none", "none", 0.0 if only else float(comparison.nothing)))
    found.append(Finding("unknown", "unknown", float(comparison.unknown), location))
    if outliers.share:
        unit = diagnosis.robot.unit
        estimates = (Estimate("share", outliers.share, "1"), Estimate("size", outliers.size, unit))
        chance = float(comparison.nothing) if only else 0.0
        found.append(Finding("outliers", "measurement", chance, Location("sensor", diagnosis.robot.signal), estimates))
    return tuple(sorted(found, key=lambda f: -f.probability))


def _only_outliers(diagnosis: Diagnosis) -> bool:
    """Whether samples that are far off are all that there is."""
    return diagnosis.outliers.share > 0 and not diagnosis.detected


def _categories(diagnosis: Diagnosis, found: Sequence[Finding]) -> dict[str, float]:
    """Kinds of laws, the most probable first: laws of one kind that look alike count together."""
    chances = {f.category: f.probability for f in found if f.name in ("none", "unknown", "outliers")}
    for answer in diagnosis.comparison.answers:
        for name in {CATEGORIES[each] for each in answer.names}:
            chances[name] = min(1.0, chances.get(name, 0.0) + answer.probability)
    return dict(sorted(chances.items(), key=lambda pair: (-pair[1], pair[0])))


def _named(term: Term) -> NamedLocation:
    return NamedLocation(term.name, term.location)


def _hypothesis(diagnosis: Diagnosis, replays: PlainReplays, answer: Answer) -> HypothesisSummary:
    problem, hypothesis = diagnosis.explanation.problem, answer.hypothesis
    train, heldout = replays.errors(diagnosis, answer)
    return HypothesisSummary(
        effects=tuple(map(_named, hypothesis.terms)),
        probability=float(answer.probability),
        unknowns=len(hypothesis.x),
        samples=int(problem.weight.sum()),
        misfit=float(problem.misfit(hypothesis.residual)),
        misfit_total=float(answer.misfit),
        log_evidence=float(hypothesis.log_evidence(problem)),
        evidence=float(answer.evidence),
        train=train,
        heldout=heldout,
    )


def _round(found: Round) -> SelectionRound:
    screened = tuple(ScreenedTerm(_named(term), float(gain)) for term, gain in found.predicted_gain)
    fitted = tuple(FittedTerms(tuple(map(_named, terms)), float(misfit)) for terms, misfit in found.fitted)
    return SelectionRound(tuple(map(_named, found.on)), screened, fitted)


def _credible(comparison: Comparison, nothing: str) -> tuple[str, ...]:
    """Names of the effects of the most probable hypotheses that together are as probable as asked; ``nothing`` is the
    name of the one without any."""
    ranked = [(answer.probability, answer.names or (nothing,)) for answer in comparison.answers]
    ranked = sorted([*ranked, (comparison.unknown, ("unknown",))], key=lambda pair: -pair[0])
    chosen: list[str] = []
    total = 0.0
    for probability, names in ranked:
        if total >= CREDIBLE:
            break
        total += probability
        chosen += [name for name in names if name not in chosen]
    return tuple(chosen)


def _parameters(diagnosis: Diagnosis) -> tuple[ParameterEstimate, ...]:
    """The fitted ones, then those that are known."""
    hypothesis, priors = kept(diagnosis), diagnosis.robot.priors
    spread = deviations(diagnosis, hypothesis)
    ends = [prior_values(priors, hypothesis.x + k * NINETY * spread) for k in (-1.0, 0.0, 1.0)]
    fitted = tuple(
        ParameterEstimate(
            Estimate(prior.name, float(middle), prior.unit, *sorted((float(low), float(high)))),
            float(prior.nominal),
            float(x),
        )
        for prior, low, middle, high, x in zip(priors, *ends, hypothesis.x, strict=False)
    )
    return fitted + tuple(
        ParameterEstimate(
            Estimate(each.name, each.value, each.unit, each.value, each.value),
            float(each.nominal),
            0.0,
            "recorded" if each.recorded else "told",
        )
        for each in diagnosis.robot.fixed
    )


def _covariance(diagnosis: Diagnosis) -> Rows:
    """Of the parameters of the patched robot, in their units."""
    fit, priors = kept(diagnosis), diagnosis.robot.priors
    spread = deviations(diagnosis, fit)
    low, high = (prior_values(priors, fit.x + k * spread) for k in (-1.0, 1.0))
    width, cov = 0.5 * (high - low), tempered(diagnosis, fit)[: len(priors), : len(priors)]
    scale = np.sqrt(np.diag(cov))
    return _rows(np.pad(np.outer(width / scale, width / scale) * cov, (0, len(diagnosis.robot.fixed))))


def _patch(diagnosis: Diagnosis, replays: PlainReplays) -> Patch:
    model, effects = model_patch(diagnosis, replays.built), [*diagnosis.robot.known_effects, *patch(diagnosis)]
    if rejected(diagnosis):
        state = "rejected"
    elif not patch(diagnosis):
        state = "none"
    else:
        state = "untested" if diagnosis.best.heldout is None and not described(diagnosis) else "accepted"
    return Patch(
        state=state,
        effects=tuple(effect.to_json() for effect in effects),
        model=model.xml,
        in_model=tuple(effect.name for effect in model.effects),
        remaining=tuple(effect.to_json() for effect in model.remaining),
        obstacle=model.obstacle,
        model_state=model.state,
        replays=model.errors,
    )


def _unknown_input(diagnosis: Diagnosis) -> UnknownInput | None:
    """The force at the best location of a discrepancy outside the catalogue, over time."""
    if not diagnosis.ranked_locations:
        return None
    best = diagnosis.ranked_locations[0]
    force = best.force
    return UnknownInput(
        location=best.location,
        components=tuple(force.components),
        units=tuple(force.units),
        recording=tuple(int(each) for each in force.recording),
        start_s=tuple(float(each) for each in force.start),
        values=_rows(force.values),
        rmse_after=float(force.remaining_rms),
        linear_in={name: float(share) for name, share in (force.shares or {}).items()},
    )


def detectable(diagnosis: Diagnosis) -> tuple[Detectable, ...]:
    """The smallest magnitude of each law, where it shows most, that would have been worth a fit.

    Those that a robot hardly has so much of that it would show are left out.
    """
    found: dict[str, Detectable] = {}
    for term, x in diagnosis.explanation.minimum:
        if term.removable or x > diagnosis.explanation.problem.settings.priors.limit:
            continue
        q = term.quantities[0]
        change = float(term.deviations[0]) * x
        if not q.bounds[0] <= q.null + change <= q.bounds[1]:
            continue
        if term.name not in found or abs(change) < found[term.name].minimum:
            unit = diagnosis.robot.unit_at(q.unit, term.location)
            found[term.name] = Detectable(term.name, q.name, float(abs(change)), unit, q.null, term.location)
    return tuple(found[name] for name in sorted(found))


def undetectable(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Sorted names of the laws that would not have shown in these recordings."""
    names = {term.name for term, _ in diagnosis.explanation.minimum}
    return tuple(sorted(names - {each.name for each in detectable(diagnosis)}))


def _next_recording(diagnosis: Diagnosis) -> NextRecording | None:
    proposal, robot = diagnosis.proposal, diagnosis.robot
    if proposal is None:
        return None
    actions = robot.commanded(proposal.motion.actions, diagnosis.explanation.problem.recorded)
    return NextRecording(
        motion=proposal.motion.words,
        duration_s=float(proposal.motion.duration),
        rivals=tuple(proposal.rivals),
        separates=tuple((a, b) for a, b in proposal.separates),
        evidence=float(proposal.evidence),
        control_timestep=float(robot.control_timestep),
        actions=_rows(actions),
    )


def _curve(diagnosis: Diagnosis) -> LawCurve | None:
    found = force_against_state(diagnosis)
    if found is None:
        return None
    rows = [_rows(each) for each in (found.state, found.law, found.measured, found.deviation)]
    effect = NamedLocation(found.effect.name, found.effect.location)
    return LawCurve(effect, rows[0], rows[1], rows[2], rows[3], float(found.share), *found.labels)


def _replay(diagnosis: Diagnosis, replays: PlainReplays) -> Replay:
    """The first recording, and replays of the nominal fit and of the best hypothesis."""
    explanation, best = diagnosis.explanation, diagnosis.best.hypothesis
    problem, measured = explanation.problem, explanation.problem.recordings[0]
    before, after = (problem.split(replays.of(each)[0])[0] for each in (explanation.nominal, best))
    count = len(measured.values)
    return Replay(
        time=tuple(float(each) for each in measured.time),
        shape=(int(measured.values.shape[1]), int(measured.values.shape[2])),
        measured=_rows(measured.values.reshape(count, -1)),
        before=_rows(before.reshape(count, -1)),
        after=_rows(after.reshape(count, -1)),
        gain=tuple(float(each) for each in explained_over_time(problem, explanation.nominal, best)),
    )


def _rows(values: np.ndarray) -> Rows:
    return tuple(tuple(float(each) for each in row) for row in np.atleast_2d(values))
