"""Diagnoses of studies, and errors of their simulations: as built, with fitted parameters, and with effects."""

import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from soro_bench.diagnosis.assembly.build import build_result
from soro_bench.diagnosis.baseline import baseline
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.pipeline import Diagnosis, Run, run_diagnosis
from soro_bench.diagnosis.preparation import unexplained
from soro_bench.diagnosis.render import FILES, render
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.forward_selection import StageProgress, silent
from soro_bench.diagnosis.selection.model_probabilities import Answer
from soro_bench.diagnosis.study import Part, Study
from soro_bench.files import check_folder, read_json, read_toml, write_json
from soro_bench.markdown import table
from soro_bench.sources import method_version

SUMMARY = "summary.json"
METHOD = method_version()  # of the sources as this process loaded them


def run_study(
    study: Study, out: str | Path, seed: int = 0, threads: int = 0, progress: StageProgress = silent
) -> list[dict]:
    """Diagnose the parts that have no summary in the folder ``out`` yet; the summaries of all of them.

    Raises:
        ValueError: a summary there is of another seed, version of the method, model, mapping or recording; or a file
            cannot be written. Nothing has been diagnosed then.
    """
    check_summaries(study, out, seed)
    names = [part.name for part in study.parts]
    for part in study.parts:
        if part.after and part.after not in names and not (Path(out) / part.after).is_dir():
            raise ValueError(f"part {part.name} comes after {part.after}, of which {out} has no result; run it first")
        check_folder(Path(out) / part.name, [*FILES, SUMMARY])
    for part in study.parts:
        folder = Path(out) / part.name
        if not (folder / SUMMARY).exists():
            known = baseline(Path(out) / part.after) if part.after else None
            if known and part.anew:
                known = replace(known, spread={**known.spread, **dict.fromkeys(part.anew, math.inf)})
            robot = ModelRobot(study.model, study.map, threads, baseline=known)
            found = run_diagnosis(robot, part.train, part.heldout, Run(seed, _prefixed(progress, part.name)))
            text = render(build_result(found), folder)
            summary = _summary(study, part, found, text, seed)
            summary["known"] = [effect.to_json() for effect in known.effects] if known else []
            write_json(folder / SUMMARY, summary)
    return [read_json(Path(out) / part.name / SUMMARY) for part in study.parts]


def _prefixed(progress: StageProgress, name: str) -> StageProgress:
    """Report stages with the name of a part before them."""

    def report(stage: str) -> None:
        """Report a stage of the part."""
        progress(f"{name}: {stage}")

    return report


def check_summaries(study: Study, out: str | Path, seed: int) -> None:
    """Refuse a folder whose summaries are of another seed, method, model, mapping or recording.

    Raises:
        ValueError: says which, see :func:`run_study`.
    """
    for part in study.parts:
        path = Path(out) / part.name / SUMMARY
        if not path.exists():
            continue
        summary = read_json(path)
        if not isinstance(summary, dict):
            raise ValueError(f"{path} is no summary of a study; give another folder")
        for key, expected in {"seed": seed, "method": METHOD, "inputs": _inputs(study, part)}.items():
            if (found := summary.get(key)) != expected:
                raise ValueError(f"{path.parent} has results of {key} {found}, not {expected}; give another folder")


def _inputs(study: Study, part: Part) -> str:
    """A hash of models, mapping and recordings."""
    digest = hashlib.sha256()
    files = [study.model]
    if isinstance(study.map, Path):
        finer = read_toml(study.map)["robot"].get("accurate")
        files += [study.map, *([study.map.parent / finer] if finer else [])]
    else:
        digest.update(repr(study.map).encode())
    for path in files:
        digest.update(path.read_bytes())
    for recordings in (part.train, part.heldout, part.unseen):
        digest.update(f"{len(recordings)}, {part.after}, {part.anew}".encode())
        for recording in recordings:
            digest.update(repr(sorted(recording.metadata.items())).encode())
            for name, signal in sorted({**recording.commands, **recording.signals}.items()):
                digest.update(name.encode() + signal.time.tobytes() + signal.values.tobytes())
    return digest.hexdigest()


def _summary(study: Study, part: Part, found: Diagnosis, text: str, seed: int) -> dict:
    """The JSON summary of a part: errors of the simulation [signal's unit] and answers with their probabilities."""
    robot = found.explanation.problem.robot
    sets = {"train": part.train, "heldout": part.heldout, "unseen": part.unseen}
    measured = {key: tuple(robot.measured(each) for each in some) for key, some in sets.items() if some}
    unfitted = replace(found.explanation.nominal, x=np.zeros(len(robot.priors)))
    hypotheses = {"nominal": unfitted, "parameters": found.explanation.nominal}
    return {
        "study": study.name,
        "part": part.name,
        "question": part.question,
        "files": {kind: [each.metadata.get("source", "") for each in some] for kind, some in sets.items()},
        "seed": seed,
        "method": METHOD,
        "inputs": _inputs(study, part),
        "verdict": text,
        "noise": found.explanation.problem.sensor,
        "unit": robot.unit,
        **{key: errors_of(robot, measured, h) for key, h in hypotheses.items()},
        "answers": [
            _answer(found, each, errors_of(robot, measured, each.hypothesis)) for each in found.comparison.ranked
        ],
        "unknown": found.comparison.unknown,
        "seconds": round(found.seconds, 1),
    }


def _answer(found: Diagnosis, answer: Answer, errors: dict) -> dict:
    """An answer of a summary: effects, probability, gain in log evidence over the nominal robot, and errors."""
    problem, hypothesis = found.explanation.problem, answer.hypothesis
    gain = hypothesis.log_evidence(problem) - found.explanation.nominal.log_evidence(problem)
    effects = [effect.to_json() for effect in hypothesis.effects(problem.parameters)]
    return {"effects": effects, "probability": answer.probability, "evidence": gain, **errors}


def errors_of(robot: Robot, measured: dict[str, tuple[Measured, ...]], hypothesis: Hypothesis) -> dict:
    """Errors of a hypothesis on each set of recordings."""
    found = {}
    for key, some in measured.items():
        problem = unexplained(robot, some, 1.0)
        residual = problem.residuals([(hypothesis.x, hypothesis.terms)])[0]
        values, seen = (np.concatenate(problem.split(each)) for each in (residual, problem.weight))
        found[key] = errors(values, seen > 0)
    return found


def errors(residual: np.ndarray, seen: np.ndarray) -> dict[str, float | None]:
    """Of residuals (T, P, D) where they were seen: the mean absolute one of all coordinates, and root mean squares of
    the last point's distance, also without the mean of its residuals, and of all points' distances, their mean over the
    points; in the unit of the signal. None where no sample was seen."""
    points = [residual[:, p][seen[:, p].all(axis=1)] for p in range(residual.shape[1])]
    rms = [_rms(point) for point in points if len(point)]
    return {
        "mean_absolute": float(np.abs(residual[seen]).mean()) if seen.any() else None,
        "rms": _rms(points[-1]) if len(points[-1]) else None,
        "rms_without_mean": _rms(points[-1] - points[-1].mean(axis=0)) if len(points[-1]) else None,
        "rms_of_points": float(np.mean(rms)) if rms else None,
    }


def _rms(distances: np.ndarray) -> float:
    """Root mean square of the lengths of residuals (n, D)."""
    return float(np.sqrt((distances**2).sum(axis=1).mean()))


# of every error the mean absolute one, the last point's rms, and that without its mean
_ERRORS = ("nominal", "parameters fitted", "patched")
_NAMES = ("robot, part", "data", *_ERRORS, "what is missing", "considered too", "noise")
_SHOWN = 0.01  # least probability of an answer


def results(summaries: Sequence[dict]) -> str:
    """Markdown: errors of training, held-out and unseen data, three kinds of each, of the nominal robot, with fitted
    parameters and with the best answer that has a name; answers with their probabilities."""
    rows = []
    for summary in summaries:
        best = summary["answers"][0]
        first, *others = _answers(summary)
        for key in summary["parameters"]:
            errors = [_three(each[key]) for each in (summary["nominal"], summary["parameters"], best)]
            words = ["", "", "", ""]
            if key == "train":
                noise = f"{summary['noise']:.2g} {summary['unit']}"
                words = [f"{summary['study']}, {summary['part']}{_known(summary)}", first, "; ".join(others), noise]
            rows.append([words[0], key, *errors, *words[1:]])
    return table(_NAMES, rows)


def _answers(summary: dict) -> list[str]:
    """Answers in words, the verdict's first; outside the catalogue is one of them."""
    nameless = f"outside the catalogue ({summary['unknown']:.2f})"
    named = [_named(a) for i, a in enumerate(summary["answers"]) if i == 0 or a["probability"] >= _SHOWN]
    return [nameless, *named] if summary["unknown"] > _likeliest(summary["answers"]) else [*named, nameless]


def _likeliest(answers: Sequence[dict]) -> float:
    """The probability of the likeliest effect, whatever comes with it, by which a verdict goes; or of none at all."""
    chances: Counter[str] = Counter()
    for answer in answers:
        for name in map(named, answer["effects"]) if answer["effects"] else ["nothing"]:
            chances[name] += answer["probability"]
    return max(chances.values())


def _three(found: dict) -> str:
    """Mean absolute error, rms of the last point, and that without its mean."""
    values = (found[key] for key in ("mean_absolute", "rms", "rms_without_mean"))
    return " / ".join("-" if value is None else f"{value:.3g}" for value in values)


def _named(answer: dict) -> str:
    """The effects of an answer with its probability."""
    return f"{' + '.join(map(named, answer['effects'])) or 'nothing'} ({answer['probability']:.2f})"


def _known(summary: dict) -> str:
    """The effects that were known before, in words."""
    known = " + ".join(map(named, summary["known"]))
    return f", with {known} known before" if known else ""


def named(effect: dict) -> str:
    """An effect of a summary and its location, in words."""
    location = effect.get("location") or effect["where"]  # as older summaries have it
    point = "" if location.get("index") is None else f"[{location['index']}]"
    return f"{effect['name']} at {location['name']}{point}"
