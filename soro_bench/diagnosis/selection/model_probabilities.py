"""Which hypothesis, how probable, and whether it holds on recordings that it was not fitted to.

Log evidence is a sum over thousands of samples, and no simulation is right to the last of them. Taken at its word it
would call everything certain. So it is divided by a temperature (a power posterior: Friel, Pettitt, "Marginal
likelihood estimation via power posteriors", 2008), which grows with the misfit that the best hypothesis leaves.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.model_form import UnderModelForm
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.selection.forward_selection import Explanation
from soro_bench.diagnosis.selection.significance import alpha, p_of, p_slow, p_value, slow_variance
from soro_bench.diagnosis.selection.stopping import evidence_beyond_chance
from soro_bench.diagnosis.settings import DEFAULT, ProbabilitySettings
from soro_bench.effects.effect import Location


@dataclass(frozen=True)
class Fit:
    """How a hypothesis fits recordings.

    before, after: rms residual of a coordinate [signal's unit] without and with its terms, less discretisation error;
        of several signals in units of their noise, times that of the first one.
    noise: of the sensor [signal's unit].
    own: the same errors of the first signal alone, where there are others.
    """

    before: float
    after: float
    noise: float
    own: tuple[float, float] | None = None

    @property
    def explained(self) -> float:
        """Share of the variance above the noise that is explained; NaN where there is none."""
        above = self.before**2 - self.noise**2
        return 1.0 - max(self.after**2 - self.noise**2, 0.0) / above if above > 0 else math.nan


@dataclass(frozen=True)
class Answer:
    """A hypothesis and how probable it is.

    evidence: natural logarithm, of all recordings, but for a common constant; less what its terms gain by chance and
        what they take up of other laws' errors.
    train: its fit of the recordings that it was fitted to. heldout: of others; None where there are none.
    misfit: above white noise, of all recordings [nats].
    """

    hypothesis: Hypothesis
    probability: float
    evidence: float
    train: Fit
    heldout: Fit | None
    misfit: float

    @property
    def names(self) -> tuple[str, ...]:
        """Of its terms."""
        return tuple(term.name for term in self.hypothesis.terms)


@dataclass(frozen=True)
class Comparison:
    """Answers, the most probable first, the nominal robot among them.

    unknown: probability that none of them is right, as the discrepancy is outside the catalogue.
    p_value: of a healthy robot, for the largest predicted gain and for slow residuals, the smaller one; None where the
        misfit dominates, as nobody has counted false alarms there.
    model_form: what the nominal robot leaves beside noise and discretisation error, rms [signal's unit].
    within_steps: whether there is evidence of a discrepancy, but of one that is within the steps of the sensors.
    """

    answers: tuple[Answer, ...]
    unknown: float
    p_value: float | None
    model_form: float = 0.0
    within_steps: bool = False

    @property
    def likeliest(self) -> float:
        """The probability of the likeliest term, whatever comes with it."""
        return max(self._probabilities().values(), default=0.0)

    @property
    def nothing(self) -> float:
        """The probability that nothing is missing."""
        return sum(answer.probability for answer in self.answers if not answer.names)

    @property
    def detected(self) -> bool:
        """Whether a discrepancy is likelier than none."""
        return max(self.likeliest, self.unknown) > self.nothing

    @property
    def best(self) -> Answer:
        """The most probable answer; where a discrepancy is detected, of those with the likeliest term."""
        probabilities = self._probabilities()
        if not self.detected or not probabilities:
            return self.answers[0]
        likeliest = max(probabilities, key=lambda term: probabilities[term])
        return next(a for a in self.answers if likeliest in [(t.name, t.location) for t in a.hypothesis.terms])

    @property
    def ranked(self) -> tuple[Answer, ...]:
        """The answers, the one that the report is of first."""
        best = self.best
        return (best, *(answer for answer in self.answers if answer is not best))

    def _probabilities(self) -> dict[tuple[str, Location], float]:
        """Of each law at a location, summed over the answers that have it."""
        probabilities: dict[tuple[str, Location], float] = {}
        for answer in self.answers:
            for term in answer.hypothesis.terms:
                key = term.name, term.location
                probabilities[key] = probabilities.get(key, 0) + answer.probability
        return probabilities


def temperature(misfit: float, settings: ProbabilitySettings = DEFAULT.probabilities) -> float:
    """By which log evidence is divided where the best hypothesis leaves that misfit [nats]."""
    return settings.temperature + settings.temperature_of_misfit * max(misfit, 0.0)


def shortlist(explanation: Explanation) -> list[Hypothesis]:
    """The hypotheses that are compared: the nominal robot, and of the others those with most evidence."""
    problem, hypotheses = explanation.problem, [explanation.nominal, *explanation.found]
    misfits = [problem.misfit(h.residual) for h in hypotheses]
    scores = _evidence(problem, hypotheses) - _of_law_errors(problem, hypotheses, misfits)
    order = np.argsort(-scores[1:], kind="stable")[: problem.settings.selection.candidates]
    return [explanation.nominal, *(explanation.found[i] for i in order)]


@dataclass(frozen=True)
class _Weighed:
    """What recordings say of hypotheses, the nominal robot first.

    scores: (H,) log evidence. misfits: (H,) above white noise [nats]. tested: fits of held-out recordings. of_nominal:
    problems, and what the nominal robot leaves (M,) of each. form: what may be model-form error. gain: log evidence of
    the best law. stands_out: (H,) probability that what a law gains is no model-form error. named: the same, 0 where
    the law does harm to held-out motion.
    """

    scores: np.ndarray
    misfits: np.ndarray
    tested: Sequence[Fit | None]
    of_nominal: Sequence[tuple[Problem, np.ndarray]]
    form: UnderModelForm
    gain: float
    stands_out: np.ndarray
    named: np.ndarray


def compared(explanation: Explanation, heldout: tuple[Problem, np.ndarray] | None) -> Comparison:
    """Probabilities of the hypotheses of an explanation, and their fits.

    Args:
        heldout: the problem of the held-out recordings, and its residuals (H, M) under the short list.
    """
    problem, hypotheses = explanation.problem, shortlist(explanation)
    weighed = _weighed(explanation, hypotheses, heldout)
    form, misfits, settings = weighed.form, weighed.misfits, problem.settings.probabilities
    p = _p_of_healthy(weighed)
    small = p < alpha(problem.settings) and all(each.within_steps(left) for each, left in weighed.of_nominal)
    p = 1.0 if small else p
    unknown, none = _unknown_and_none(explanation, hypotheses, weighed, p)
    scores = weighed.scores - _of_law_errors(problem, hypotheses, misfits)
    probabilities = (1.0 - unknown) * _probabilities(scores, none, temperature(misfits.min(), settings))
    train = _fits(problem, [h.residual for h in hypotheses], problem.sensor)
    parts = zip(
        hypotheses, probabilities.tolist(), scores.tolist(), train, weighed.tested, misfits.tolist(), strict=True
    )
    ranked = tuple(sorted((Answer(*each) for each in parts), key=lambda a: -a.probability))
    uncounted = problem.misfit_dominated and not form.possible[0]
    return Comparison(ranked, unknown, None if uncounted else p, float(form.left[0]) * problem.sensor, small)


def _weighed(
    explanation: Explanation, hypotheses: Sequence[Hypothesis], heldout: tuple[Problem, np.ndarray] | None
) -> _Weighed:
    """The hypotheses by the recordings that they were fitted to, and by held-out ones."""
    problem, residuals = explanation.problem, [h.residual for h in hypotheses]
    scores, misfits = _evidence(problem, hypotheses), np.array([problem.misfit(row) for row in residuals])
    # the predicted gain, and where the simulation was too far off for a prediction, what has been gained
    gain = max(explanation.predicted_gain, *(scores - scores[0]))
    gains = misfits[0] - misfits if explanation.found else np.array([explanation.predicted_gain])
    form = UnderModelForm.of(problem, residuals)
    stands_out = form.missing(gains, explanation.of_all, problem.settings.discretisation)
    nominal = problem, residuals[0]
    if heldout is None:
        nobody: list[Fit | None] = [None] * len(hypotheses)
        return _Weighed(scores, misfits, nobody, [nominal], form, gain, stands_out, stands_out)
    unfitted, rows = heldout
    further, named = np.array([unfitted.misfit(row) for row in rows]), stands_out
    if explanation.found:  # what is missing may not show there, but does no harm
        harmless = further - further[0] <= problem.settings.probabilities.lost_by_chance * gains
        named = np.where(harmless, stands_out, 0.0)
    return _Weighed(
        scores - further, misfits + further, _fits(unfitted, rows, problem.sensor), [nominal, (unfitted, rows[0])],
        form.beside(UnderModelForm.of(unfitted, rows)), gain, stands_out, named,
    )  # fmt: skip


def _unknown_and_none(
    explanation: Explanation, hypotheses: Sequence[Hypothesis], weighed: _Weighed, p: float
) -> tuple[float, float]:
    """Probabilities that no hypothesis is right, and that nothing is missing if one of them is.

    Args:
        p: of a healthy robot; see ``_p_of_healthy``.
    """
    settings, form = explanation.problem.settings, weighed.form
    remaining, hidden = 0.0 if form.possible.any() else explanation.remaining_gain, 0.0
    outside = _probability_of_unknown(explanation.problem, hypotheses, remaining)
    if form.possible[0]:
        # what stands out is missing physics even where the law that gains by it does harm to other motion
        named = float(weighed.named.max()) / max(float(weighed.stands_out.max()), 1e-300)
        outside = 1.0 - (1.0 - outside) * named
        hidden = min(settings.probabilities.hidden * float(form.left[0]), settings.probabilities.most_hidden)
    nothing = p / (p + alpha(settings))
    # what may hide changes no verdict: it is taken from what is beyond even odds
    none, law = nothing - hidden * max(2.0 * nothing - 1.0, 0.0), (1.0 - nothing) * (1.0 - outside)
    mistaken = settings.probabilities.wrong_when_certain
    unknown = float(np.clip(1.0 - none - law, mistaken, 1.0 - mistaken))
    return unknown, none / max(none + law, 1e-300)


def _p_of_healthy(weighed: _Weighed) -> float:
    """Probability that a healthy robot gives as much evidence of a discrepancy."""
    problem, _ = weighed.of_nominal[0]
    p = p_value(weighed.gain, problem.settings.probabilities)
    if weighed.form.possible[0]:
        return max(p, p_of(float(weighed.stands_out.max()), problem.settings))
    # where the misfit is far above the sensor's noise something is missing, whether or not a law explains it
    return 0.0 if problem.misfit_dominated else min(p, p_slow(*slow_variance(weighed.of_nominal), problem.settings))


def _fits(problem: Problem, residuals: Iterable[np.ndarray], sensor: float) -> list[Fit]:
    """Of hypotheses to recordings, by their residuals (M,), the nominal robot's first.

    Args:
        sensor: noise of the first signal [its unit].
    """
    first, *_ = rows = list(residuals)
    return [Fit(problem.left(first), problem.left(row), sensor, _own(problem, first, row)) for row in rows]


def _own(problem: Problem, before: np.ndarray, after: np.ndarray) -> tuple[float, float] | None:
    """What residuals (M,) leave of the first signal alone, where there are others."""
    if not problem.others:
        return None
    return problem.left_of_each(before)[0], problem.left_of_each(after)[0]


def _evidence(problem: Problem, hypotheses: Sequence[Hypothesis]) -> np.ndarray:
    """(H,) of the recordings that they were fitted to, less what their terms gain by chance."""
    return np.array([evidence_beyond_chance(problem, h) for h in hypotheses])


def _of_law_errors(
    problem: Problem, hypotheses: Sequence[Hypothesis], misfits: Sequence[float] | np.ndarray
) -> np.ndarray:
    """(H,) log evidence that terms gain as other laws are not quite right, by the number of their unknowns.

    Args:
        hypotheses: the nominal robot first.
        misfits: of each [nats].
    """
    explained = misfits[0] - min(misfits)
    return problem.settings.probabilities.law_error * explained * np.array([_unknowns(h) for h in hypotheses])


def _unknowns(hypothesis: Hypothesis) -> int:
    """How many its terms have."""
    return sum(term.size for term in hypothesis.terms)


def _probabilities(scores: np.ndarray, nothing: float, temperature: float) -> np.ndarray:
    """(H,) from log evidence (H,), if it is one of them; the first is that of nothing missing, which is known."""
    if len(scores) == 1:
        return np.ones(1)
    tempered = scores[1:] / temperature
    others = np.exp(tempered - tempered.max())
    return np.concatenate([[nothing], (1.0 - nothing) * others / others.sum()])


def _probability_of_unknown(problem: Problem, hypotheses: Sequence[Hypothesis], remaining_gain: float) -> float:
    """Probability that a discrepancy is outside the catalogue.

    Then all hypotheses leave a large share of the nominal robot's misfit; or one more term beside the best of them is
    predicted to gain more than where the laws are right.

    Args:
        hypotheses: the nominal robot first.
        remaining_gain: predicted for one more term [nats].
    """
    if len(hypotheses) == 1:
        return 1.0  # if anything is missing: no term was worth a fit
    settings = problem.settings.probabilities
    misfits = [problem.misfit(h.residual) for h in hypotheses]
    samples = float(problem.weight.sum())
    larger = [problem.larger_than_sensor(h.residual) for h in hypotheses]
    above_sensor = [0.5 * ((2.0 * misfit + samples) * by - samples) for misfit, by in zip(misfits, larger, strict=True)]
    healthy = (settings.healthy_misfit_per_sample + 0.5 * (problem.model_form / problem.sensor) ** 2) * samples
    share = (min(above_sensor) - healthy) / max(above_sensor[0] - healthy, 1.0)
    terms, usual = len(hypotheses[int(np.argmin(misfits))].terms), problem.settings.selection.unchecked_terms
    # several laws describe one outside the catalogue too: the more of them, the less they may leave
    limit = settings.unknown_share * min(1.0, (usual / max(terms, 1)) ** 2)
    known = expit((limit - share) / settings.unknown_share_width)
    if not problem.misfit_dominated:  # where the whole residual counts as noise, predicted gains are small
        limit = settings.unknown_gain + settings.law_error * (misfits[0] - min(misfits))
        known *= expit(math.log(limit / max(remaining_gain, 1.0)) / settings.unknown_gain_width)
    return 1.0 - float(known)
