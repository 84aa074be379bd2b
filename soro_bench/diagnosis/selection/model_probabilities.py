"""Compare: which hypothesis, how probable, and whether it holds on recordings that it was not fitted to.

Evidence is a sum over thousands of samples, and a simulation is never right to the last of them: taken at its word it
would call everything certain. It is tempered by what the best hypothesis leaves unexplained (``TEMPER``), which is how
wrong the models are at any rate. The constants are from development sets and from final sets that are open.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.selection.forward_selection import WORTH, Explanation

# evidence that the best lead promises where nothing is missing (40 cases: at most 85, but for one whose nominal fit had
# not found its parameters), with some to spare: a Gumbel distribution
GUMBEL_LOCATION, GUMBEL_SCALE = 60.0, 60.0
EFFECT, UNKNOWNS = 100.0, 50.0  # nats that a rugged fit gains by chance from one more effect, from each unknown of it
# of what is explained, by which each unknown of an effect has to improve on laws with fewer: what a law has not quite
# right, one that contains it can always take up (up to 0.9 per cent by two more; 2 to 8 where they are real:
# docs/archive/diagnosis_development.md)
SPARE = 0.006
TEMPERATURE = (100.0, 0.1)  # nats, and share of the excess
# share of the excess left where the physics is as likely unknown as not, width, and what nulls leave of what was fitted
# (nats per sample, 0.02 to 0.06 but for two of 160)
UNKNOWN = (0.25, 0.06, 0.066)
# evidence that one more effect still promises where the physics is as likely unknown as not: nats, and share of what is
# explained, as no law is right to the last per mille; and the width in its logarithm. Right laws leave a promise of a
# third of that and two thirds at most (55 cases), nameless physics beyond the limit above 0.7 to 8 times as much.
STILL = (500.0, 0.006, 0.2)
BLUNDER = 0.03  # of answers that seem certain, how many are wrong all the same (5 of 111)
# what is left without any effect and still there LAG later [s], as noise is not: its variance, in units of that of the
# rest, at which something is missing as likely as nothing, whatever promises to explain it; the same of few samples,
# in standard deviations; and the power with which more gets rarer (docs/archive/diagnosis_development.md). No sample
# counts more than FAR standard deviations of the noise, as it may be an outlier that has not been recognised
SLOW, FEW, POWER, LAG, FAR = 0.12, 5.0, 5.0, 0.15, 4.0
COMPARED = 6  # hypotheses that are simulated on held-out recordings


@dataclass(frozen=True)
class Fit:
    """How a hypothesis fits recordings, before and after: rms of a coordinate [signal's unit], numerical error taken
    off; and the noise."""

    before: float
    after: float
    noise: float

    @property
    def explained(self) -> float:
        """Share of the variance above the noise that is explained; NaN where there is none."""
        above = self.before**2 - self.noise**2
        return 1.0 - max(self.after**2 - self.noise**2, 0.0) / above if above > 0 else math.nan


@dataclass(frozen=True)
class Answer:
    """A hypothesis and how probable it is.

    evidence: natural logarithm, of all recordings, less what its effects gain by chance and by what no law has quite
        right, but for a common constant.
    heldout: None where no recording is held out. excess: what is left of all recordings over white noise [nats].
    """

    hypothesis: Hypothesis
    probability: float
    evidence: float
    train: Fit
    heldout: Fit | None
    misfit: float

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.hypothesis.terms)


@dataclass(frozen=True)
class Comparison:
    """Answers, the most probable first, the nominal robot among them; and the probability that it is none of them.

    p_value: of the least probable of what is promised and what is left where nothing is missing; None where more is
        taken for noise than the sensor's, as nobody has counted false alarms there.
    """

    answers: tuple[Answer, ...]
    unknown: float
    p_value: float | None

    @property
    def likeliest(self) -> float:
        """The probability of the likeliest effect at a place, whatever comes with it."""
        return max(self._chances().values(), default=0.0)

    @property
    def nothing(self) -> float:
        """The probability that nothing is missing."""
        return sum(answer.probability for answer in self.answers if not answer.names)

    @property
    def detected(self) -> bool:
        """Whether something is missing: whether nothing else is likelier."""
        return max(self.likeliest, self.unknown) > self.nothing

    @property
    def best(self) -> Answer:
        """The most probable answer; where something is missing, of those that have its likeliest effect."""
        chances = self._chances()
        if not self.detected or not chances:
            return self.answers[0]
        likeliest = max(chances, key=chances.get)
        return next(a for a in self.answers if likeliest in [(s.name, s.location) for s in a.hypothesis.terms])

    @property
    def ranked(self) -> tuple[Answer, ...]:
        """The answers, the one that the report is of first."""
        best = self.best
        return (best, *(answer for answer in self.answers if answer is not best))

    def _chances(self) -> Counter:
        chances = Counter()
        for answer in self.answers:
            for term in answer.hypothesis.terms:
                chances[term.name, term.location] += answer.probability
        return chances


def p_value(gain: float) -> float:
    """Probability that one more effect gains so much evidence where nothing is missing."""
    return float(-np.expm1(-np.exp(-(gain - GUMBEL_LOCATION) / GUMBEL_SCALE)))


ALPHA = p_value(WORTH)  # of the least that is worth a fit: with it, nothing missing is as likely as something


def p_left(slow: float, pairs: float) -> float:
    """Probability that nothing is missing and the variance of what is left and slow is as large, of pairs of samples;
    in units of that of the rest."""
    limit = max(SLOW, FEW / math.sqrt(max(pairs, 1.0)))
    return min(1.0, ALPHA * (limit / slow) ** POWER) if slow > 0 else 1.0


def slowness(left: Sequence[tuple[Problem, np.ndarray]]) -> tuple[float, float]:
    """Of residuals (M,) of problems: the variance of what is still there ``LAG`` later, in units of that of the rest;
    and the number of pairs of samples that say so."""
    squares, count, products, pairs = np.sum([_products(*each) for each in left], axis=0)
    slow = products / max(pairs, 1.0)
    return slow / max(squares / max(count, 1.0) - slow, 1e-9), pairs


def _products(problem, residual):
    """Sums of squares and of products with what is ``LAG`` later, of what the numerical floor does not explain; each
    with its number."""
    near, found = np.clip(problem.discretisation.without(residual), -FAR, FAR), np.zeros(4)
    parts = zip(problem.split(near), problem.split(problem.weight), problem.recordings, strict=True)
    for part, weight, each in parts:
        sampled = weight.any(axis=(1, 2))
        part, weight, time = part[sampled], weight[sampled], each.time[sampled]
        lag = math.ceil(LAG / float(np.median(np.diff(time))) - 1e-6)
        later = (part[lag:] * part[:-lag]).sum(), (weight[lag:] * weight[:-lag]).sum()
        found += [(part**2).sum(), weight.sum(), *later]
    return found


def temperature(misfit: float) -> float:
    """By which evidence is divided where the best hypothesis leaves that excess."""
    return TEMPERATURE[0] + TEMPERATURE[1] * max(misfit, 0.0)


def shortlist(found: Explanation) -> list[Hypothesis]:
    """The hypotheses that are compared: the nominal robot, and of the others those with most evidence."""
    problem, hypotheses = found.problem, [found.nominal, *found.found]
    scores = _evidence(problem, hypotheses) - _spare(hypotheses, [problem.misfit(h.residual) for h in hypotheses])
    order = np.argsort(-scores[1:], kind="stable")[:COMPARED]
    return [found.nominal, *(found.found[i] for i in order)]


def compared(found: Explanation, heldout: tuple[Problem, np.ndarray] | None) -> Comparison:
    """Probabilities of the hypotheses of an explanation, and their fits.

    Args:
        heldout: the problem of the held-out recordings, and its residuals (H, M) under the short list.
    """
    problem, hypotheses = found.problem, shortlist(found)
    scores = _evidence(problem, hypotheses)
    # what was promised, and where the simulation was too far off for a promise, what has been gained
    chance = p_value(max(found.predicted_gain, *(scores - scores[0])))
    train, unexplained = [problem.left(h.residual) for h in hypotheses], [(problem, hypotheses[0].residual)]
    tested, left = [None] * len(hypotheses), [problem.misfit(h.residual) for h in hypotheses]
    if heldout is not None:
        unfitted, residuals = heldout
        misfit = [unfitted.misfit(row) for row in residuals]
        scores, left = scores - misfit, [a + b for a, b in zip(left, misfit, strict=True)]
        tested = [unfitted.left(row) for row in residuals]
        unexplained.append((unfitted, residuals[0]))
    # where much more is left than the sensor's noise something is missing, whether or not a law explains it
    chance = 0.0 if problem.misfit_dominated else min(chance, p_left(*slowness(unexplained)))
    nothing = chance / (chance + ALPHA)
    scores = scores - _spare(hypotheses, left)
    chances = _chances(scores, nothing, min(left))
    answers = [
        Answer(h, p, e, Fit(train[0], a, problem.sensor), None if b is None else Fit(tested[0], b, problem.sensor), c)
        for h, p, e, a, b, c in zip(hypotheses, chances, scores.tolist(), train, tested, left, strict=True)
    ]
    unknown = float(np.clip((1.0 - nothing) * _unknown(problem, hypotheses, found.left), BLUNDER, 1.0 - BLUNDER))
    answers = [replace(a, probability=a.probability * (1.0 - unknown)) for a in answers]
    ranked = tuple(sorted(answers, key=lambda a: -a.probability))
    return Comparison(ranked, unknown, None if problem.misfit_dominated else chance)


def _evidence(problem, hypotheses) -> np.ndarray:
    """(H,) of what they were fitted to, less what their effects gain by chance."""
    chance = [EFFECT * len(h.terms) + UNKNOWNS * _unknowns(h) for h in hypotheses]
    return np.array([h.log_evidence(problem) for h in hypotheses]) - chance


def _spare(hypotheses, left) -> np.ndarray:
    """(H,) what a law that is not quite right leaves for others with more unknowns, where hypotheses, the nominal robot
    first, leave ``left``."""
    return SPARE * (left[0] - min(left)) * np.array([_unknowns(h) for h in hypotheses])


def _unknowns(hypothesis) -> int:
    return sum(term.size for term in hypothesis.terms)


def _chances(scores, nothing, misfit):
    """Tempered probabilities; the first is that of nothing missing, which what is promised decides."""
    if len(scores) == 1:
        return np.ones(1)
    tempered = scores[1:] / temperature(misfit)
    others = np.exp(tempered - tempered.max())
    return np.concatenate([[nothing], (1.0 - nothing) * others / others.sum()])


def _unknown(problem, hypotheses, predicted_gain) -> float:
    """Probability that the physics has no name: of what the nominal robot leaves, the first, all leave much; or one
    more effect, on top of the best of all, still promises more than where the laws are right."""
    if len(hypotheses) == 1:
        return 1.0  # if anything is missing: nothing promised to explain enough of it to be tried
    samples, more = float(problem.weight.sum()), (problem.sigma / problem.sensor) ** 2
    left = [0.5 * ((2.0 * problem.misfit(h.residual) + samples) * more - samples) for h in hypotheses]
    share, width, least = UNKNOWN[0], UNKNOWN[1], UNKNOWN[2] * samples
    named = expit((share - (min(left) - least) / max(left[0] - least, 1.0)) / width)
    if not problem.misfit_dominated:  # where all that is left is taken for noise, promises are small
        explained = problem.misfit(hypotheses[0].residual) - min(problem.misfit(h.residual) for h in hypotheses)
        named *= expit(math.log((STILL[0] + STILL[1] * explained) / max(predicted_gain, 1.0)) / STILL[2])
    return 1.0 - float(named)
