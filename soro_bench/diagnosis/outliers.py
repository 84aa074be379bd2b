"""The nominal fit, and that without outliers: points that are alone and far off are left out, and the noise is what it
leaves."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from soro_bench.diagnosis.data_quality.inspection import Inspected
from soro_bench.diagnosis.data_quality.noise import compressed, noise
from soro_bench.diagnosis.data_quality.samples import far_off
from soro_bench.diagnosis.estimation.fit import (
    Guess,
    Hypothesis,
    allowing,
    descended,
    fitted_under_discretisation,
)
from soro_bench.diagnosis.estimation.model_form import may_be_model_form
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.result_robot import Outliers
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.forward_selection import SEEDS, StageProgress, silent
from soro_bench.diagnosis.selection.moves import iterate_to_convergence
from soro_bench.diagnosis.selection.rounds import fitted_in_growing_parts, is_discrepant
from soro_bench.diagnosis.settings import DataQualitySettings
from soro_bench.inference.statistical_linearisation import LowRank


def nominal_fit(
    problem: Problem, refined: Sequence[Robot], seed: int, progress: StageProgress = silent
) -> tuple[Problem, Hypothesis]:
    """The problem with its discretisation error, and the nominal robot fitted to it, in turns; from the beginning of
    the recordings on, where that explains much more.

    Args:
        refined: the robot simulated more accurately.
        seed: of the samples around the fit.
        progress: is told the name of each stage.
    """
    settings, rng, d, given = problem.settings.selection, np.random.default_rng(seed), problem.parameters, problem
    draws = settings.nominal_radius * rng.standard_normal((settings.nominal_replays, d))
    draws[0] = 0.0
    guess = Guess(np.zeros(d))
    near, last = settings.fit_radius, settings.nominal_radius_last
    stages = ((settings.nominal_radius, settings.move_radius), (near,), (last, last))
    for k, radii in enumerate(stages):
        progress("discretisation error and joint fit of the parameters")
        if k > 0:
            limit = problem.settings.priors.limit
            draws = np.clip(guess.x + radii[0] * rng.standard_normal((1, d)), -limit, limit)
        points = [(x, ()) for x in draws]
        problem, (fit,) = fitted_under_discretisation(
            problem, refined, points, [guess], radii, SEEDS * seed + k, list(draws[:1])
        )
        problem, (fit,) = allowing(problem, fit, [fit])
        guess = Guess(fit.x, jacobian=fit.jacobian)
    if problem.misfit_dominated:
        (fit,) = iterate_to_convergence(problem, [fit], SEEDS * seed + len(stages))
        problem, fit = _as_noise_falls(*_allowed(problem, fit))
    known = may_be_model_form(problem, fit.residual, fit.jacobian)
    if problem.misfit_dominated or (is_discrepant(problem, fit) and not known):
        other = fitted_in_growing_parts(given, refined, SEEDS * seed + len(stages))
        if other and other[0].left(other[1].residual) < problem.left(fit.residual):
            return other
    return problem, fit


def _allowed(problem: Problem, fit: Hypothesis) -> tuple[Problem, Hypothesis]:
    """The problem with a fit's misfit as noise, and the fit to it."""
    problem, (fit,) = allowing(problem, fit, [fit])
    return problem, fit


def _as_noise_falls(problem: Problem, fit: Hypothesis) -> tuple[Problem, Hypothesis]:
    """Descents in turns with the noise that the last one left, as long as it falls: priors count less and less."""
    for _ in range(problem.settings.selection.turns):
        before = problem.left(fit.residual)
        problem, fit = _allowed(problem, descended(problem, [fit])[0])
        if problem.left(fit.residual) > (1.0 - problem.settings.selection.turn_gain) * before:
            break
    return problem, fit


def of_samples(found: Sequence[Inspected], problem: Problem) -> Outliers:
    """The spikes that were found before anything was fitted, beside the points that are left."""
    count = sum(each.spikes for each in found)
    if not count:
        return Outliers(0.0, 0.0)
    square = sum(each.spikes * each.size**2 for each in found) / count
    points = sum(float(part.sum()) for part in problem.split(problem.weight)) / problem.robot.shape[1]
    return Outliers(count / (points + count), float(np.sqrt(square)))


def far_points(problem: Problem, residual: np.ndarray, spoilt: bool = False) -> np.ndarray:
    """(M,) whether a sample belongs to a point that is alone and far off; one of two, where others were ``spoilt``."""
    left = np.where(problem.weight > 0, problem.discretisation.without(residual), np.nan)
    found: list[list[np.ndarray]] = []
    for which in range(len(problem.robot.signals)):
        far = ((far_off(part, spoilt, problem.settings), part) for part in problem.split(left, which))
        found.append([np.repeat(each[:, :, None], part.shape[2], axis=2) for each, part in far])
    return problem.joined(found)


def masked(problem: Problem, far: np.ndarray) -> Problem:
    """The problem without some samples (M,)."""
    return replace(problem, weight=problem.weight * ~far, discretisation=LowRank(problem.discretisation.basis * ~far))


def fitted_again(
    problem: Problem,
    nominal: Hypothesis,
    untouched: Problem,
    refined: Sequence[Robot],
    found: Outliers,
    least: Sequence[float],
    spoilt: bool,
    seed: int,
    progress: StageProgress,
) -> tuple[Problem, Hypothesis, Outliers]:
    """The problem without outliers and with the noise that the nominal fit leaves, and that fit.

    It is made anew without the outliers of the fit before.

    Args:
        untouched: the problem before any fit.
        found: outliers so far.
        least: noise of each signal [its unit].
        spoilt: whether samples were left out before any fit.
    """
    turns = problem.settings.selection.turns
    for again in range(turns + 1):
        far = far_points(problem, nominal.residual, spoilt) & (problem.weight > 0)
        quiet = problem, nominal
        if not problem.misfit_dominated:
            quiet = _with_noise(problem, nominal, least, spoilt)
        if again == turns or not far.any():
            break
        found = _with_more(found, problem, nominal, far, untouched.weight)
        untouched = masked(untouched, far)
        problem, nominal = nominal_fit(untouched, refined, seed, progress)
    if far.any():  # of the last fit
        found, problem = _with_more(found, problem, nominal, far, untouched.weight), masked(problem, far)
        nominal = nominal.scaled(problem, np.where(far, 0.0, 1.0))
        quiet = (problem, nominal) if problem.misfit_dominated else _with_noise(problem, nominal, least, spoilt)
    return *quiet, found


def _with_noise(
    problem: Problem, nominal: Hypothesis, least: Sequence[float], spoilt: bool
) -> tuple[Problem, Hypothesis]:
    """The same with the noise of what the nominal fit leaves: little of the motion is in it, so it shows better.

    Args:
        least: noise of each signal [its unit]. spoilt: whether samples were left out, so that few windows are complete.
    """
    rest = np.where(problem.weight > 0, problem.discretisation.without(nominal.residual), np.nan)
    factors = []
    for which, (sigma, low) in enumerate(zip(problem.sigmas, least, strict=True)):
        found = max(_noises(problem.split(rest, which), spoilt, problem.settings.data_quality), default=1.0)
        factors.append(1.0 / min(1.0, max(low / sigma, found)))
    sigma, *others = (sigma / factor for sigma, factor in zip(problem.sigmas, factors, strict=True))
    factor = problem.of_samples(problem.of_columns(factors)) if others else factors[0]
    problem = replace(
        problem,
        sigma=sigma,
        others=tuple((each, 0.0) for each in others),
        discretisation=LowRank(problem.discretisation.basis * factor),
    )
    return problem, nominal.scaled(problem, factor)


def _noises(parts: Sequence[np.ndarray], spoilt: bool, settings: DataQualitySettings) -> list[float]:
    """Noise of the parts (T, P, D) of a signal that have enough samples; recordings may lack another one."""
    found = []
    for part in parts:
        values = compressed(part) if spoilt else part
        with suppress(ValueError):  # there are too few
            found.append(noise(values.reshape(len(values), -1), settings))
    return found


def _with_more(found: Outliers, problem: Problem, nominal: Hypothesis, far: np.ndarray, weight: np.ndarray) -> Outliers:
    """Outliers, and those that a fit found in the first signal: (M,) ``far``, of samples with a weight (M,)."""
    far, weight = (np.concatenate([part.ravel() for part in problem.split(each)]) for each in (far, weight))
    if not far.any():
        return found
    parts = problem.split(problem.discretisation.without(nominal.residual))
    left = problem.sigma * np.concatenate([part.ravel() for part in parts])[far]
    share = float(far.sum() / weight.sum())
    square = (found.share * found.size**2 + share * float((left**2).mean())) / (found.share + share)
    return Outliers(found.share + share, float(np.sqrt(square)))
