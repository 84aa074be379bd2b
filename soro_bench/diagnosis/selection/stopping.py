"""When a further term is worth having: it lowers the error of held-out motion beyond chance, or has evidence; and what
is left is more than model-form error."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import correlate
from scipy.stats import f as f_distribution
from scipy.stats import norm as normal

from soro_bench.arrays import Floats
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.estimation.model_form import UnderModelForm, unfitted_under_model_form
from soro_bench.diagnosis.estimation.problem import DIVERGED, Problem
from soro_bench.diagnosis.localisation.residual_maps import windows
from soro_bench.diagnosis.robots.robot import Robot

_FEWEST = 4  # windows, from which a standard error is taken


def by_chance(problem: Problem, hypothesis: Hypothesis) -> float:
    """Log evidence that the terms of a hypothesis gain by chance [nats]."""
    settings, unknowns = problem.settings.probabilities, sum(term.size for term in hypothesis.terms)
    return settings.gain_of_term * len(hypothesis.terms) + settings.gain_of_unknown * unknowns


def evidence_beyond_chance(problem: Problem, hypothesis: Hypothesis) -> float:
    """Log evidence of a hypothesis, less what its terms gain by chance [nats]."""
    return hypothesis.log_evidence(problem) - by_chance(problem, hypothesis)


def falls_beyond_chance(heldout: Problem, before: Hypothesis, after: Hypothesis) -> bool:
    """Whether the error of recordings that neither hypothesis was fitted to is smaller ``after``.

    Their errors are compared window by window, as errors of one window are not independent. They have to fall by as
    much as further unknowns gain by chance, too (Akaike 1974).

    Args:
        heldout: of those recordings.
    """
    rows = heldout.residuals([(h.x, h.terms) for h in (before, after)])
    settings = heldout.settings
    squares = np.minimum(rows**2, DIVERGED**2)
    _, number = np.unique(windows(heldout, settings.localisation.map_window), return_inverse=True)
    fallen = 0.5 * np.bincount(number, squares[0] - squares[1])  # nats
    fallen = fallen[np.bincount(number, heldout.weight) > 0]  # of windows that were measured
    error = fallen.std(ddof=1) * np.sqrt(len(fallen)) if len(fallen) >= _FEWEST else 0.0
    least = max(len(after.x) - len(before.x), 0)
    return bool(fallen.sum() > max(settings.selection.beyond_chance * error, least))


def explained_beyond_chance(heldout: Problem, residual: Floats, share: float, noise: float = 0.0) -> bool:
    """Whether a law explains so large a share of a held-out residual not only by chance.

    By chance, the forces in the recordings fitted to and in held-out ones are two draws p, r of one random process: of
    gusts, or of a hum of any phase. With n independent normal values each, p explains the share s of r where (1 - s)
    |r|^2 > |r - p|^2. That is a difference of two chi-squares of n degrees of freedom, weighted by the eigenvalues of
    the form, so its probability is that of an F distribution.

    Args:
        heldout: of recordings that were not fitted to. residual: (M,) of them without the law. share: of its squares
        above the noise. noise: share of its squares that is the sensor's noise.
    """
    root = float(np.hypot(1.0 - share, 2.0))
    independent = independent_values(heldout.rows(np.clip(residual, -DIVERGED, DIVERGED)), noise)
    chance = f_distribution.cdf((root - 1.0 - share) / (root + 1.0 + share), independent, independent)
    return bool(chance < normal.sf(heldout.settings.selection.beyond_chance))


def independent_values(parts: Sequence[Floats], noise: float = 0.0) -> float:
    """How many independent values residuals (T, C) of several recordings have, at least.

    These are the degrees of freedom of their sum of squares, tr(G)^2 / tr(G^2) of their covariance G [Satterthwaite
    1946]: a force that lasts has one, a sine two. G is |r_t| |r_s| times the autocorrelation at t - s, as sizes change
    in time. An autocorrelation of one recording errs upwards, so that values are too few rather than too many.

    Args:
        noise: share of the squares that is white noise, which lowers the autocorrelation and does not count.
    """
    total, of_pairs = 0.0, 0.0
    for rows in parts:
        squares = (rows**2).sum(axis=1)
        products = sum(_lagged(column) for column in rows.T)
        early, late = np.cumsum(squares)[::-1], np.cumsum(squares[::-1])[::-1]  # of the parts that a lag compares
        alike = np.minimum(products**2 / np.maximum((1.0 - noise) ** 2 * early * late, 1e-300), 1.0)
        pairs = alike * np.maximum(_lagged(squares), 0.0)
        total, of_pairs = total + float(squares.sum()), of_pairs + float(2.0 * pairs.sum() - pairs[0])
    return max(total**2 / max(of_pairs, 1e-300), 1.0)


def _lagged(values: Floats) -> Floats:
    """(T,) sums of products of values (T,) so many samples apart."""
    return np.asarray(correlate(values, values, method="fft")[len(values) - 1 :])


def is_better(problem: Problem, heldout: Problem | None, before: Hypothesis, after: Hypothesis) -> bool:
    """Whether a hypothesis with more terms is worth having instead of another one."""
    if heldout is not None:
        return falls_beyond_chance(heldout, before, after)
    return evidence_beyond_chance(problem, after) > evidence_beyond_chance(problem, before)


def without_a_term(whole: Hypothesis, others: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The hypotheses that have all terms of another one but one."""
    return [h for h in others if len(h.terms) == len(whole.terms) - 1 and set(h.terms) < set(whole.terms)]


def simplest(problem: Problem, heldout: Problem | None, hypotheses: Sequence[Hypothesis]) -> Hypothesis | None:
    """Of hypotheses with one term less than the first, the one with most evidence if that term is not worth having."""
    whole, *others = hypotheses
    best = max(without_a_term(whole, others), key=lambda h: evidence_beyond_chance(problem, h), default=None)
    if best is None or evidence_beyond_chance(problem, best) < evidence_beyond_chance(problem, whole):
        return None
    return None if heldout is not None and falls_beyond_chance(heldout, best, whole) else best


@dataclass
class FormJudge:
    """Tells what may be model-form error.

    heldout: of recordings that nothing is fitted to; None without any. refined: the robot simulated more accurately.
    """

    heldout: Problem | None
    refined: Sequence[Robot]
    _last: tuple[Hypothesis, UnderModelForm] | None = field(default=None, init=False)  # of held-out recordings

    def possible(self, problem: Problem, hypothesis: Hypothesis) -> bool:
        """Whether what a hypothesis leaves of all recordings may be model-form error, held-out ones included.

        The differences between simulations may take up a discrepancy in the motion that parameters are fitted to.
        """
        fitted = UnderModelForm.of(problem, [hypothesis.residual])
        if self.heldout is None or not fitted.possible[0]:
            return bool(fitted.possible[0])
        if self._last is None or self._last[0] is not hypothesis:
            points = [(hypothesis.x, hypothesis.terms)]
            self._last = hypothesis, UnderModelForm.of(*unfitted_under_model_form(self.heldout, self.refined, points))
        return bool(fitted.beside(self._last[1]).possible[0])

    def covers(self, problem: Problem, hypothesis: Hypothesis, gain: float, of_all: float) -> bool:
        """Whether what a hypothesis leaves may be model-form error, and is likelier to be that than one more term with
        so large a gain [nats].

        Args:
            of_all: misfit that all candidates explain together beside the hypothesis [nats].
        """
        form = UnderModelForm.of(problem, [hypothesis.residual])
        missing = form.missing(np.array([gain]), of_all, problem.settings.discretisation)
        return missing[0] < 0.5 and self.possible(problem, hypothesis)

    def stands_out(self, problem: Problem, before: Hypothesis, after: Hypothesis, least: float, of_all: float) -> bool:
        """Whether a hypothesis has so much less cost [nats] than another one, and is likelier than model-form error.

        Args:
            of_all: misfit that all candidates explain together beside ``before`` [nats].
        """
        gain = before.cost - after.cost
        return gain >= least and not self.covers(problem, before, gain, of_all)
