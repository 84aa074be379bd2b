"""Unit check: whether a signal is in the unit that its recording names. A wrong unit would be taken for physics."""

from collections.abc import Sequence

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.measured import ObservedSignal
from soro_bench.recording.recording import RecordingError

_WRONG_UNITS = (180 / np.pi, 100.0, 1000.0)  # degrees for rad, cm for m, mm for m


def check_unit_and_sign(problem: Problem) -> None:
    """Refuse a signal that moves like the nominal robot, but as many times as far as in another unit, or inverted.

    Raises:
        RecordingError: it does.
    """
    simulated = problem.simulated(problem.robot, [(np.zeros(problem.parameters), ())])[0]
    for which, signal in enumerate(problem.robot.signals):
        parts = zip(problem.split(problem.measured, which), problem.split(simulated, which), strict=True)
        _check(problem, signal, [_motions(*pair) for pair in parts])


def _check(problem: Problem, signal: ObservedSignal, pairs: Sequence[tuple[Floats, Floats]]) -> None:
    """Refuse a signal by its measured and simulated motions in every recording, each in a row."""
    settings = problem.settings.data_quality
    measured, simulated = (np.concatenate(one) for one in zip(*pairs, strict=True))
    product, squares = float(measured @ simulated), float(simulated @ simulated)
    if not abs(product) > (1.0 - settings.unit_tolerance) * np.sqrt(squares * float(measured @ measured)) > 0:
        return
    factor = product / squares
    for scale in (-1.0, *_WRONG_UNITS, *(1.0 / scale for scale in _WRONG_UNITS)):
        if abs(factor / scale - 1.0) < settings.unit_tolerance:
            raise RecordingError(
                f"{signal.name} moves {factor:.3g} times as far in the recordings as in the model; is "
                f"it in {signal.unit}, and the model the right way round?"
            )


def _motions(measured: Floats, simulated: Floats) -> tuple[Floats, Floats]:
    """Samples (T, P, D) that both have, about their means, in a row."""
    seen = np.isfinite(measured) & np.isfinite(simulated)
    count = np.maximum(seen.sum(axis=0), 1)

    def centred(samples: Floats) -> Floats:
        """Shared samples about their means, in a row."""
        mean = np.where(seen, samples, 0.0).sum(axis=0) / count
        return np.where(seen, samples - mean, 0.0).ravel()

    return centred(measured), centred(simulated)
