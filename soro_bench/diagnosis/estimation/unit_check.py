"""Whether a signal is in the unit that it is said to be in: a wrong one would be taken for physics."""

import numpy as np

from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.recording.recording import RecordingError

ALIKE = 0.9  # correlation of measured and simulated motion, from which one is the other at another scale
SCALES, NEAR = (180 / np.pi, 100.0, 1000.0), 0.15  # of wrong units, and how near to them a factor is one of them


def check_scale(problem: Problem) -> None:
    """RecordingError if the signal moves as the robot does as it was built, but as many times as far as another unit
    would make it, or the other way."""
    parts = problem.split(problem.simulated(problem.robot, [(np.zeros(problem.parameters), ())])[0])
    pairs = [_motions(each.values, part) for each, part in zip(problem.recordings, parts, strict=True)]
    measured, simulated = (np.concatenate(one) for one in zip(*pairs, strict=True))
    product, squares = float(measured @ simulated), float(simulated @ simulated)
    if not abs(product) > ALIKE * np.sqrt(squares * float(measured @ measured)) > 0:
        return
    factor = product / squares
    for scale in (-1.0, *SCALES, *(1.0 / scale for scale in SCALES)):
        if abs(factor / scale - 1.0) < NEAR:
            each = problem.recordings[0]
            raise RecordingError(f"{each.signal} moves {factor:.3g} times as far in the recordings as in the model; is "
                                 f"it in {each.unit}, and the model the right way round?")  # fmt: skip


def _motions(measured, simulated) -> tuple[np.ndarray, np.ndarray]:
    """Samples (T, P, D) that both have, about their means, in a row."""
    seen = np.isfinite(measured) & np.isfinite(simulated)
    count = np.maximum(seen.sum(axis=0), 1)
    return tuple((np.where(seen, s - np.where(seen, s, 0.0).sum(axis=0) / count, 0.0)).ravel()
                 for s in (measured, simulated))  # fmt: skip
