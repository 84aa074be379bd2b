"""How well a diagnosis describes motion that had no say in it: neither fitted nor compared on."""

import math

import numpy as np

from soro_bench.diagnosis.assembly.patch import kept
from soro_bench.diagnosis.pipeline import Diagnosis, tried_on
from soro_bench.diagnosis.selection.model_probabilities import Fit
from soro_bench.recording.recording import Recording


def unseen(found: Diagnosis, recording: Recording) -> dict:
    """Errors on a recording before (the nominal robot with its parameters fitted) and after (the patched robot).

    Returns:
        rmse_before, rmse_after: rms of a coordinate [signal's unit], as any replay shows it, numerical error included;
        noise_floor; fve: the share of the variance above noise and numerical error that the patch explains, 0 where
        there is none.
    """
    robot = found.robot
    hypotheses = [found.explanation.nominal, kept(found)]
    tried = tried_on(found.explanation, (robot.measured(recording),), robot.refined(), hypotheses)
    assert tried is not None  # there is a recording
    problem, rows = tried
    before, after = (problem.sigma * float(np.sqrt((row**2).sum() / problem.weight.sum())) for row in rows)
    share = Fit(problem.left(rows[0]), problem.left(rows[1]), problem.sensor).explained
    return {
        "rmse_before": before,
        "rmse_after": after,
        "noise_floor": problem.sensor,
        "fve": 0.0 if math.isnan(share) else share,
    }
