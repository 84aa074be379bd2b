"""The report of a case, as the blind benchmark scores it: the format of its first releases."""

import math
from typing import Any

import numpy as np

from soro_bench.diagnosis.assembly.patch import kept
from soro_bench.diagnosis.pipeline import Diagnosis, tried_on
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import Errors, Estimate, Finding, NamedLocation
from soro_bench.diagnosis.selection.model_probabilities import Fit
from soro_bench.effects.effect import Location
from soro_bench.recording.recording import Recording

_RELEASED = {
    "friction": "dry_loss",
    "hysteresis_or_play": "rate_independent_memory",
    "static_error": "static_one_sided",
}


def released(name: str) -> str:
    """The name that labels and reports of releases have for a class."""
    return _RELEASED.get(name, name)


SCHEMA = "soro-bench/diagnosis/1"
VERDICTS = {
    "adequate": "none_detected",
    "undecided": "none_detected",
    "discrepancy": "missing_physics",
    "outside_catalogue": "unknown_physics",
}


def report_of(result: Result) -> dict[str, Any]:
    """What scoring reads of a result, under the keys that the labels and packed releases have."""
    return {
        "schema": SCHEMA,
        "verdict": VERDICTS.get(result.verdict, result.verdict),
        "p_value": result.p_value,
        "alpha": result.alpha,
        "promised": result.predicted_gain,
        "still_promised": result.remaining_gain,
        "effects": [_effect(each) for each in result.findings],
        "classes": [{"class": released(name), "probability": chance} for name, chance in result.categories.items()],
        "hypotheses": [
            {
                "names": list(each.names),
                "where": [effect.location.to_json() for effect in each.effects],
                "probability": each.probability,
                "unknowns": each.unknowns,
                "excess": each.misfit,
                "excess_of_all": each.misfit_total,
                "log_evidence": each.log_evidence,
                "evidence": each.evidence,
                "samples": each.samples,
            }
            for each in result.hypotheses
        ],
        "rounds": [
            {
                "on_top_of": [_named(each) for each in found.on_top_of],
                "promised": [_named(each.term) | {"gain": each.predicted_gain} for each in found.screened],
                "fitted": [
                    {"effects": [_named(t) for t in each.terms], "excess": each.misfit} for each in found.fitted
                ],
            }
            for found in result.rounds
        ],
        "credible_set": list(result.credible_set),
        "fit": {
            "train": _fit(result.train),
            "heldout": _fit(result.heldout) if result.heldout else None,
            "fve_heldout": _share(result.heldout) if result.heldout else None,
            "parameters_only": result.parameters_only,
            "unit": result.robot.unit,
            "patch": result.patch.state,
        },
        "parameters": {
            each.estimate.name: _estimate(each.estimate) | {"prior_tension_sd": each.prior_deviations}
            for each in result.parameters
        },
        "places": [{"where": each.location.to_json(), "gain": each.gain} for each in result.locations],
        "seconds": result.seconds,
    }


def _effect(found: Finding) -> dict[str, Any]:
    return {
        "name": found.name,
        "class": released(found.category),
        "probability": found.probability,
        "where": _location(found.location),
        "when": [{"start_s": start, "end_s": end} for start, end in found.intervals],
        "condition": found.condition,
        "parameters": {each.name: _estimate(each) for each in found.estimates},
        "evidence": [],
        "against": list(found.drawbacks),
        "together_with": list(found.together_with),
    }


def _location(location: Location | None) -> dict[str, Any] | None:
    return location.to_json() if location else None


def _named(effect: NamedLocation) -> dict[str, Any]:
    return {"name": effect.name, "where": effect.location.to_json()}


def _estimate(found: Estimate) -> dict[str, Any]:
    interval = {} if found.low is None else {"ci90": [found.low, found.high]}
    return {"value": found.value, "unit": found.unit, **interval}


def _fit(errors: Errors) -> dict[str, float]:
    return {"rmse_before": errors.corrected_before, "rmse_after": errors.corrected_after, "noise_floor": errors.noise}


def _share(errors: Errors) -> float | None:
    return errors.explained if errors.explained == errors.explained else None


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
