"""Errors of hypotheses: those of plain replays, and without what discretisation error explains."""

import numpy as np

from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.pipeline import Diagnosis, key_of
from soro_bench.diagnosis.result_parts import Errors
from soro_bench.diagnosis.selection.model_probabilities import Answer


def plain_rms(problem: Problem, residual: np.ndarray) -> float:
    """Root mean square [signal's unit] of a residual (M,) in units of sigma, as any replay shows it."""
    return problem.sigma * float(np.sqrt((residual**2).sum() / problem.weight.sum()))


def errors_of_answer(diagnosis: Diagnosis, answer: Answer) -> tuple[Errors, Errors | None]:
    """Of the recordings that it was fitted to, and of held-out ones, if there are any."""
    problem, nominal = diagnosis.explanation.problem, diagnosis.explanation.nominal
    plain = [plain_rms(problem, h.residual) for h in (nominal, answer.hypothesis)]
    train = Errors(plain[0], plain[1], answer.train.noise, answer.train.before, answer.train.after)
    if answer.heldout is None or diagnosis.tested is None:
        return train, None
    tested, rows = diagnosis.tested, diagnosis.tested_residuals
    plain = [plain_rms(tested, rows[key_of(h)]) for h in (nominal, answer.hypothesis)]
    heldout = answer.heldout
    return train, Errors(plain[0], plain[1], heldout.noise, heldout.before, heldout.after)
