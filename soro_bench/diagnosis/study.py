"""Studies of real robots: diagnoses of their recordings, and errors of the simulation before and after them.

A study is a table of ``assets/studies.toml``: a model, its mapping, how its recordings are imported, and parts. A part
names recordings to explain, held-out ones and unseen ones, as files with the changes that their import makes to the
mapping. The result of the part that it comes ``after`` is its baseline. Where a table of the recordings has a row for
each file (``takes``), its numbers become commands of that recording. What the groups of ``name`` find in a file's name
become metadata."""

import csv
import glob
import hashlib
import io
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

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
from soro_bench.files import asset_path, brief, check_folder, read_json, read_toml, write_json
from soro_bench.markdown import table
from soro_bench.recording.importers import import_recording
from soro_bench.recording.importers.mapping import in_utf8, texts
from soro_bench.recording.importers.source import check_keys, read_source
from soro_bench.recording.recording import Recording, RecordingError, Signal
from soro_bench.recording.untrusted import named_errors, read_bytes
from soro_bench.sources import method_version

SUMMARY = "summary.json"
METHOD = method_version()  # of the sources as this process loaded them
STUDIES = tuple(read_toml(asset_path("studies.toml")))
_TAKES = ("file", "key", "commands")
_MAX_BYTES = 1_000_000
KINDS = ("train", "heldout", "unseen")  # of recordings of a part


@dataclass(frozen=True)
class Part:
    """Recordings of one question: to explain (train), to compare answers on too (heldout), and that play no part
    (unseen). ``after`` names the part whose result is the baseline."""

    name: str
    question: str
    train: tuple[Recording, ...]
    heldout: tuple[Recording, ...]
    after: str | None
    unseen: tuple[Recording, ...] = ()


@dataclass(frozen=True)
class Study:
    """A robot and its recordings; its map is a file or the content of one."""

    name: str
    model: Path
    map: Path | Mapping[str, Any]
    parts: tuple[Part, ...]


def load_study(
    name: str, data: str | Path, files: Mapping[str, Sequence[str]] | None = None, part: str | None = None
) -> Study:
    """A study of the suite with its recordings, from a folder that ``soro-bench data`` has filled.

    Args:
        name: of the study.
        data: the folder with the study's own folder of recordings in it, that folder, or one in it.
        files: patterns of other files to explain ("train"), to hold out and not to see, instead of all of the part's.
        part: the only part to load; needed with ``files`` where there are several.

    Raises:
        ValueError: there is no such study or part, or ``files`` needs one.
        FileNotFoundError: a recording is not there.
    """
    if name not in STUDIES:
        raise ValueError(f"unknown study {name!r}; there are {', '.join(STUDIES)}")
    table = read_toml(asset_path("studies.toml"))[name]
    parts = table["parts"]
    if part is not None and part not in parts:
        raise ValueError(f"unknown part {part!r} of {name}; there are {', '.join(parts)}")
    chosen = {key: each for key, each in parts.items() if part in (None, key)}
    if files and len(chosen) > 1:
        raise ValueError(f"which part of {name} are these files for? Write --part and one of {', '.join(parts)}")
    given = Path(data).resolve()
    folder = given if table["data"] in given.parts else given / table["data"]
    loaded = []
    for key, each in chosen.items():
        entries = _replaced(folder, table, each, files) if files else {kind: each.get(kind, []) for kind in KINDS}
        train, heldout, unseen = (_recordings(folder, table, entries[kind]) for kind in KINDS)
        question = f"other files: {_listed(files)}" if files else each["question"]
        loaded.append(Part(key, question, train, heldout, each.get("after"), unseen))
    robot_map = table["map"]
    if isinstance(robot_map, str):
        robot_map = asset_path(f"mjcf/{robot_map}")
    return Study(name, asset_path(f"mjcf/{table['model']}"), robot_map, tuple(loaded))


def _listed(files: Mapping[str, Sequence[str]]) -> str:
    return "; ".join(f"{kind} {', '.join(patterns)}" for kind, patterns in files.items() if patterns)


def _replaced(
    folder: Path, study: Mapping[str, Any], part: Mapping[str, Any], files: Mapping[str, Sequence[str]]
) -> dict[str, list[dict]]:
    """Entries for other files, one each. A file is imported as the entry of the same kind whose pattern it matches; any
    other with the changes that all entries of the part have in common."""
    own = [entry for kind in KINDS for entry in part.get(kind, [])]
    common = {key: value for key, value in own[0].items() if all(entry.get(key) == value for entry in own)}

    def like(kind: str, path: Path) -> dict:
        name = path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name
        matching = [entry for entry in part.get(kind, []) if fnmatchcase(name, entry["files"])]
        return {**(matching[0] if matching else common), "files": str(path)}

    return {
        kind: [like(kind, path) for pattern in files.get(kind, ()) for path in _paths(folder, study, pattern)]
        for kind in KINDS
    }


def _paths(folder: Path, study: Mapping[str, Any], pattern: str) -> list[Path]:
    """The files of a pattern below a folder, or of one with a path of its own, but for a table of takes.

    Raises:
        FileNotFoundError: there are none.
    """
    takes = study.get("takes", {}).get("file")
    named = [pattern] if (folder / pattern).is_file() else sorted(glob.glob(pattern, root_dir=folder))
    paths = [folder / each for each in named if Path(each).name != takes]
    if not paths:
        raise FileNotFoundError(f"no {pattern} in {folder}; --data names another folder, soro-bench data gets some")
    return paths


def _recordings(folder: Path, study: Mapping[str, Any], entries: Sequence[dict]) -> tuple[Recording, ...]:
    """Of each entry the files, imported by the study's mapping with the sections that the entry changes."""
    found, mapping = [], study["import"]
    if isinstance(mapping, str):
        mapping = read_toml(asset_path(f"mjcf/{mapping}"))
    for entry in entries:
        changes = {key: value for key, value in entry.items() if isinstance(value, dict)}
        sections = {key: {**mapping.get(key, {}), **value} for key, value in changes.items()}
        for path in _paths(folder, study, entry["files"]):
            changed = {**mapping, **sections}
            if in_name := _from_name(path, study):
                changed["metadata"] = {**changed.get("metadata", {}), **in_name}
            recording = import_recording(path, changed)
            if takes := study.get("takes"):
                recording = replace(recording, commands={**recording.commands, **commands_of_take(path, takes)})
            found.append(recording)
    return tuple(found)


def _from_name(path: Path, study: Mapping[str, Any]) -> dict[str, str]:
    """Metadata in the name of a file; RecordingError where its study needs some and finds none."""
    if "name" not in study:
        return {}
    if not (found := re.search(study["name"], path.name)):
        raise RecordingError(f"{path}: this study's recordings have names like {study['name']}, a regular expression; "
                             "is it of another robot or kind?")  # fmt: skip
    return {name: text for name, text in found.groupdict().items() if text is not None}


def commands_of_take(path: Path, takes: Mapping[str, Any]) -> dict[str, Signal]:
    """The commands that a table has for a recording, each one sample at time 0.

    Args:
        path: of the recording; the table lies in its folder.
        takes: ``file``, the name of the table; ``key``, its column with the names of recordings without suffix; and
            ``commands``, a section as in an import mapping for each command.

    Raises:
        RecordingError: the table has no row for the recording, or several; or a number is none.
        FileNotFoundError: there is no table.
    """
    check_keys("takes", takes, _TAKES)
    table = path.parent / takes["file"]
    if not table.is_file():
        raise FileNotFoundError(f"no {takes['file']} beside {path}; it has a row for each recording")
    with named_errors(table):
        # of which some spreadsheets end lines as old Macs do
        reader = csv.DictReader(io.StringIO(in_utf8(read_bytes(table, _MAX_BYTES)), newline=None))
        columns, rows = [takes["key"], *_columns(takes["commands"])], list(reader)
        if wrong := [each for each in columns if list(reader.fieldnames or ()).count(each) != 1]:
            raise RecordingError(f"its first line has to name {', '.join(columns)} once each, between commas; "
                                 f"not so {', '.join(wrong)}")  # fmt: skip
        found = [row for row in rows if row.get(takes["key"]) == path.stem]
        if len(found) != 1:
            raise RecordingError(f"{len(found)} rows with {takes['key']} {path.stem!a}; expected one")
        return {name: _command(name, entry, found[0]) for name, entry in takes["commands"].items()}


def _columns(commands: Mapping[str, Any]) -> list[str]:
    """The columns of all commands of a table of takes."""
    return [column for name, entry in commands.items() for column in texts(f"{name} columns", entry.get("columns"))]


def _command(name: str, entry: Mapping[str, Any], row: Mapping[str, str]) -> Signal:
    """One command of a row."""
    source = read_source(entry, ("columns",), False)
    numbers = []
    for column in texts(f"{name} columns", entry.get("columns")):
        text = row[column] or ""
        try:
            numbers.append(float(text.replace("_", "no number")))
        except ValueError:
            numbers.append(math.nan)
        if not math.isfinite(numbers[-1]):
            raise RecordingError(f"commands.{name}: {brief(text)} in {column} is no finite number")
    return source.signal(np.zeros(1), np.array([numbers]))


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
        digest.update(f"{len(recordings)}, {part.after}".encode())
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
