"""Forward selection: from the nominal robot one term further as long as the predicted gain is worth it.

Each round screens every candidate term beside the best hypothesis so far; from the second round on also every pair of
terms beside the nominal robot. It fits the best of them, and computes the discretisation error again with
their effects.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from soro_bench.diagnosis.candidates import Term
from soro_bench.diagnosis.estimation.discretisation import differences
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, allowing, descended, settled
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.moves import (
    iterate_to_convergence,
    laws,
    refitted,
    revisit_rivals,
    simplify,
    swap_delays,
    without_one,
)
from soro_bench.diagnosis.selection.rounds import (
    Round,
    at_each_element,
    cheapest,
    compatible,
    fitted_from_priors,
    from_base_if_worse,
    generalised,
    guesses_of,
    is_discrepant,
    may_imitate,
    refined_in_turns,
    replayed_anew,
    round_of,
    screened_again,
    under_present_error,
    with_own_discretisation,
    worth,
)
from soro_bench.diagnosis.selection.screening import Evidence, ScreenedCandidate, evidence, pairs, screen, singles
from soro_bench.diagnosis.selection.stopping import FormJudge, is_better, simplest, without_a_term

SEEDS = 10_000  # of samples, for each seed of a diagnosis
# times the gain before fits, or before further ones, that they give at most where simulators differ by so much
_MOST_BY_FITS = 2.0
_FIRST_SEED, _SEED_STEP = 10, 10  # after those of the nominal fit, and between those of two calls

StageProgress = Callable[[str], None]  # is told the name of each stage


def silent(stage: str) -> None:
    """Progress that nobody looks at."""


@dataclass(frozen=True)
class Explanation:
    """Hypotheses about recordings.

    problem: with the discretisation error under which all hypotheses are compared.
    nominal: has no term.
    found: the fitted hypotheses, the last round first and of each round the most probable first; empty where no term
        is worth a fit.
    parameters_only_rms: rms residual [signal's unit] of the nominal robot with fitted parameters, less discretisation
        error, before any term is fitted.
    predicted_gain: in log evidence, of the best candidate beside the nominal robot [nats].
    remaining_gain: the same beside the best hypothesis.
    minimum: of each candidate, the coordinate of its first magnitude that would just have been worth a fit beside the
        best hypothesis.
    rounds: how the hypotheses came about; one whose candidates may be model-form error may have fitted none.
    looked_for: names of the effects that were screened anywhere.
    of_all: misfit that all candidates explain together beside the nominal robot, to first order [nats].
    """

    problem: Problem
    nominal: Hypothesis
    found: tuple[Hypothesis, ...]
    parameters_only_rms: float
    predicted_gain: float
    remaining_gain: float
    minimum: tuple[tuple[Term, float], ...]
    rounds: tuple[Round, ...] = ()
    looked_for: frozenset[str] = frozenset()
    of_all: float = 0.0


def explained(
    problem: Problem,
    nominal: Hypothesis,
    robot: Robot,
    refined: Sequence[Robot],
    candidates: Sequence[Term],
    seed: int,
    progress: StageProgress = silent,
    heldout: Problem | None = None,
) -> Explanation:
    """One term further as long as a candidate's predicted gain is worth a fit.

    The last of a few terms (``SelectionSettings.unchecked_terms``) and all after it have to lower the error of held-out
    recordings beyond chance, or to have evidence where there are none; one that does not ends the search, and those
    after the few are left out then. Terms that are not worth having are removed in the end.

    A term may only lead the parameters out of a local minimum. Then the search starts again from those parameters, a
    few times at most (``SelectionSettings.turns``).

    Args:
        nominal: the fit without a term.
        robot: with the time steps of its model, for screening.
        refined: the robot simulated more accurately.
        candidates: the terms that are screened.
        seed: of the samples around fits.
        progress: is told the name of each stage.
        heldout: of recordings that are not fitted to; None without any.
    """
    settings = problem.settings.selection
    for restart in itertools.count():
        seeds = itertools.count(SEEDS * (seed + restart) + _FIRST_SEED, _SEED_STEP)
        search = _Search(problem, nominal, robot, refined, candidates, seeds, progress, heldout)
        search.begin()
        while search.goes_on and search.is_worth_a_round():
            search.add_one_term()
            if search.local_minimum and restart < settings.turns:
                break
        else:
            break
        problem, nominal = search.problem, search.nominal
    search.remove_terms()
    search.settle()
    return search.explanation()


@dataclass
class _Search:
    """Hypotheses on their way to an explanation.

    best: the most probable one. tried: all that were fitted, the last round first. possible: the candidates that the
    robot can have beside the best hypothesis. responses: theirs. screened: their predicted gains, the largest of which
    is ``remaining_gain``. simulated: the last ones by replays. first: beside the nominal robot. local_minimum: the
    first term has only led to parameters that explain as much without it, and those are now the nominal ones.
    goes_on: whether the last term was worth having, if it had to be. unfitted: a round whose candidates could only
    imitate model-form error. form: tells what may be model-form error.
    from_priors: where the next round begins if parameters had moved too far to see what is missing: predicted gains at
    their priors, and fits from there.
    """

    problem: Problem
    nominal: Hypothesis
    robot: Robot
    refined: Sequence[Robot]
    candidates: Sequence[Term]
    seeds: Iterator[int]
    progress: StageProgress
    heldout: Problem | None = None
    tried: list[Hypothesis] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    local_minimum: bool = False
    goes_on: bool = True
    unfitted: tuple[Round, ...] = ()
    from_priors: tuple[Evidence, list[Hypothesis]] | None = None
    form: FormJudge = field(init=False)
    best: Hypothesis = field(init=False)
    possible: Sequence[Term] = ()
    responses: list[np.ndarray] = field(default_factory=list)
    screened: Evidence = field(init=False)
    simulated: Evidence | None = None
    first: Evidence = field(init=False)
    parameters_only_rms: float = field(init=False)
    predicted_gain: float = field(init=False)
    remaining_gain: float = field(init=False)

    def __post_init__(self) -> None:
        self.form = FormJudge(self.heldout, self.refined)

    @property
    def worth(self) -> float:
        """The least predicted gain that is worth a fit [nats]."""
        return worth(self.problem, self.nominal, self.best)

    def begin(self) -> None:
        """The nominal robot, fitted and screened."""
        discrepant = is_discrepant(self.problem, self.nominal)
        self._start(refining=not self.problem.misfit_dominated and not discrepant)
        # parameters may cause so large a misfit after all, if neither a term nor model form is likely to explain it
        known = bool(self.problem.variants) and self.form.possible(self.problem, self.nominal)
        if not self.problem.misfit_dominated and not known and discrepant and self.remaining_gain < self.worth:
            self._start(refining=True)
        self.first, self.predicted_gain = self.screened, self.remaining_gain

    def _start(self, refining: bool) -> None:
        if refining:
            self.progress("joint fit of the parameters")
            self.problem, (self.nominal,) = refined_in_turns(
                self.problem, self.robot, self.refined, [self.nominal], self.seeds
            )
        self.parameters_only_rms = self.problem.left(self.nominal.residual)
        self.best = self.nominal
        self._screen(self.candidates)

    def is_worth_a_round(self) -> bool:
        """Whether the predicted gain of one more term is worth a fit.

        To first order a law explains less than as fitted, so the first term is judged as fitted where it may be one.
        """
        if self.rounds:
            if self._is_predicted() and not self.problem.misfit_dominated:
                self._screen(compatible(self.robot, self.best, self.candidates))  # where the best hypothesis is
            return self._is_predicted() or self._is_worth_it_from_priors()
        gain, least = self.remaining_gain, min(self.problem.settings.selection.least_gain, self.worth)
        rough, most = self.problem.misfit_dominated, _MOST_BY_FITS * gain
        of_all = self.screened.of_all
        if covered := not rough and gain >= least and self.form.covers(self.problem, self.best, most, of_all):
            self.unfitted = (round_of(self.problem, self.best, singles(self.screened), ()),)
        return (gain >= self.worth and not covered) or self._is_worth_it_from_priors()

    def _is_predicted(self) -> bool:
        """Whether one more term is predicted to gain what is worth a fit, and no model-form error."""
        gain = self.remaining_gain
        return gain >= self.worth and not self.form.covers(self.problem, self.best, gain, self.screened.of_all)

    def _is_worth_it_from_priors(self) -> bool:
        """Whether a law that promises nothing here explains more as fitted from the priors of parameters."""
        problem, best = self.problem, self.best
        if not self.candidates or not may_imitate(problem, best):
            return False
        promising = {each.terms[-1].name for each in singles(self.screened) if each.gain >= self.worth}
        if not (others := [one for one in self.candidates if one.name not in promising]):
            return False
        if self.rounds and not self.form.stands_out(problem, self.nominal, best, self.worth, self.first.of_all):
            return False  # what was found may be model-form error
        self.progress("fits from the parameters' priors")
        screened, fits = fitted_from_priors(problem, self.robot, best, self.screened, others, next(self.seeds))
        # how much better a further term is, only its own discretisation errors tell
        better = [h for h in fits if h.cost < best.cost - (0.0 if self.rounds else self.worth)]
        self.from_priors = (screened, better) if better else None
        return bool(better)

    def add_one_term(self) -> None:
        """One round: fit the best candidates, compare them with earlier hypotheses, and screen beside the best."""
        base, screened, number = self.best, self.screened, len(self.rounds) + 1
        unpromised = self.from_priors is not None and number > 1
        offered = singles(self.from_priors[0] if self.from_priors else screened)
        self.progress(f"refits with {number} effect{'s' * (number > 1)}")
        new = self._first_fits(offered)
        new = self._with_own_errors(new)
        if self.problem.misfit_dominated:
            self._keep_misfit_dominated(new)
        else:
            self._keep(new)
        self.best = self.tried[0]
        self._predict_gains()
        self.rounds.append(round_of(self.problem, base, offered, self.tried[: len(new)]))
        self.nominal = under_present_error(self.problem, self.nominal)
        without = without_one(self.problem, self.best, self.nominal, next(self.seeds))
        others = without if number > 1 else []
        known = {laws(h) for h in self.tried}
        others += swap_delays(self.problem, [self.best, *others], self.candidates, known, next(self.seeds))
        self.tried[1:1] = others
        settings, before = self.problem.settings.selection, self._as_tried(base)
        if unpromised:
            least = worth(self.problem, self.nominal, before)
            better = self.form.stands_out(self.problem, before, self.best, least, screened.of_all)
        else:
            better = number < settings.unchecked_terms or is_better(self.problem, self.heldout, before, self.best)
        if not better:
            self.goes_on = False
            if unpromised or number > settings.unchecked_terms:
                self._take(before, screened)
        if number == 1:
            before, self.nominal = self.nominal, min(self.nominal, *without, key=lambda h: h.cost)
            by_parameters, by_term = before.cost - self.nominal.cost, self.nominal.cost - self.best.cost
            rough = self.problem.misfit_dominated
            self.local_minimum = not rough and by_parameters > settings.least_gain > by_term

    def explanation(self) -> Explanation:
        """The hypotheses so far."""
        return Explanation(
            self.problem,
            self.nominal,
            tuple(cheapest(self.tried)),
            self.parameters_only_rms,
            self.predicted_gain,
            self.remaining_gain,
            self.screened.detectable(self.worth),
            tuple(self.rounds) or self.unfitted,
            frozenset(term.name for term in self.candidates),
            self.first.of_all,
        )

    def remove_terms(self) -> None:
        """Take away terms of the best hypothesis that are not worth having, one after the other."""
        while len(self.best.terms) > 1:
            known = [h for h in self.tried if h is not self.best]
            if not without_a_term(self.best, known):
                known = without_one(self.problem, self.best, self.nominal, next(self.seeds))
            if (fewer := simplest(self.problem, self.heldout, [self.best, *known])) is None:
                return
            self.progress(f"without {len(self.best.terms)} effects")
            self._take(fewer, None)

    def settle(self) -> None:
        """Bring the best hypothesis to the minimum of its cost: samples may leave it far from where priors would have
        it, along a direction that no recording shows. A robot with other simulations is too rugged for that."""
        if self.problem.misfit_dominated or self.problem.variants:
            return
        best = settled(self.problem, self.best)
        self.tried = [best if each is self.best else each for each in self.tried]
        self.nominal = best if self.best is self.nominal else self.nominal
        self.best = best

    def _as_tried(self, hypothesis: Hypothesis) -> Hypothesis:
        """A hypothesis of an earlier round, as it is under the present problem."""
        same = (h for h in (*self.tried, self.nominal) if laws(h) == laws(hypothesis))
        return min(same, key=lambda h: h.cost, default=hypothesis)

    def _take(self, hypothesis: Hypothesis, screened: Evidence | None) -> None:
        """Make another hypothesis the best one; ``screened`` beside it, or None to screen it."""
        self.best = hypothesis
        self.tried = [hypothesis, *(h for h in self.tried if h is not hypothesis)]
        if screened is None:
            self._screen(compatible(self.robot, hypothesis, self.candidates))
            return
        self.screened, self.possible, self.responses = screened, screened.candidates, list(screened.responses)
        self.remaining_gain = singles(screened)[0].gain

    def _screen(self, candidates: Sequence[Term]) -> None:
        """Screen candidates beside the best hypothesis; responses beside an earlier one say which are simulated."""
        self.progress("screening")
        known = dict(zip(self.possible, self.responses, strict=True))
        self.screened, self.simulated = screened_again(
            self.problem, self.best, candidates, self.robot, known, self.simulated
        )
        self.possible, self.responses = candidates, list(self.screened.responses)
        self.remaining_gain = singles(self.screened)[0].gain

    def _predict_gains(self) -> None:
        self.screened = evidence(self.problem, self.best, self.possible, self.responses)
        self.remaining_gain = singles(self.screened)[0].gain

    def _first_fits(self, offered: Sequence[ScreenedCandidate]) -> list[Hypothesis]:
        """Hypotheses of the best candidates, the most probable first, without discretisation errors of their own."""
        screened, best = self.screened, self.best
        if self.from_priors:
            screened, fits = self.from_priors
            guesses = [Guess(h.x, h.terms, h.jacobian) for h in fits]
            self.from_priors = None
        else:
            guesses = guesses_of(self.problem, screened, offered)
            guesses += at_each_element(self.problem, screened, offered)
            guesses += generalised(self.problem, screened, self.candidates, self.worth)
            if len(self.rounds) == 1 and not self.problem.misfit_dominated:
                guesses += guesses_of(self.problem, self.first, pairs(self.first))
        rough = self.problem.with_longer_steps(self.robot, best.x, best.terms, best.residual)
        new = replayed_anew(self.problem, refitted(rough, guesses, screened, next(self.seeds)))
        if not self.problem.misfit_dominated:
            new = from_base_if_worse(self.problem, under_present_error(self.problem, best), new)
        if self.rounds:
            new += revisit_rivals(self.problem, new[0], self.tried, next(self.seeds))
        if self.problem.misfit_dominated:
            new = iterate_to_convergence(self.problem, new, next(self.seeds))
            best = min(new, key=lambda h: h.cost)
            new += simplify(self.problem, best, new, self.possible, next(self.seeds))
        return new

    def _with_own_errors(self, new: list[Hypothesis]) -> list[Hypothesis]:
        """Hypotheses fitted once more under their own discretisation errors, the most probable first."""
        self.problem, new = with_own_discretisation(self.problem, self.refined, new, next(self.seeds))
        # its parameters may be far from the nominal ones, and other simulations of it differ there by something else
        best = min(new, key=lambda h: h.cost)
        self.problem = self.problem.with_discretisation(differences(self.problem, [best.x]))
        new = [under_present_error(self.problem, h) for h in new]
        return sorted(new, key=lambda h: -h.log_evidence(self.problem))

    def _keep(self, new: list[Hypothesis]) -> None:
        """The new hypotheses before the others, refined if they may be worth having; and the candidates that are
        possible beside the best one."""
        gain = under_present_error(self.problem, self.best).cost - min(h.cost for h in new)
        if not self.form.covers(self.problem, self.best, _MOST_BY_FITS * gain, self.screened.of_all):
            self.problem, new = refined_in_turns(self.problem, self.robot, self.refined, new, self.seeds)
        self.tried = [under_present_error(self.problem, h) for h in new + self.tried]
        allowed = compatible(self.robot, self.tried[0], self.possible)
        kept = zip(self.possible, self.responses, strict=True)
        self.responses = [response for term, response in kept if term in allowed]
        self.possible = allowed

    def _fit_to_noise(self) -> None:
        """The best hypothesis fitted to the sensor's noise, where a misfit was the noise before."""
        self.tried[:1] = descended(self.problem, self.tried[:1])

    def _keep_misfit_dominated(self, new: list[Hypothesis]) -> None:
        """The same where the best hypothesis says how large the noise is; the nominal robot is compared under it."""
        others = [self.nominal, *new, *self.tried]
        self.problem, (self.nominal, *self.tried) = allowing(self.problem, new[0], others)
        if not self.problem.misfit_dominated:
            self._fit_to_noise()
        self.possible = compatible(self.robot, self.tried[0], self.candidates)
        self.responses = list(screen(self.problem, self.tried[0], self.possible, self.robot).responses)
