"""What the diagnosis says of recordings of real robots, with several seeds.

    python benchmarks/real_robots.py --data data/real [--only bam_servo ...] [--seeds 3] [--alone]
    python benchmarks/real_robots.py --only bam_servo --fit coulomb_friction:joint:hinge [--fit ...]

Every part of a study is a folder in --work, and the same command goes on with what is missing. Prints tables and writes
docs/results/real_robots.json, which has the numbers of docs/archive/real_robots.md. A study whose data are missing or
cannot be diagnosed is named, and the others go on; then the exit status is 1.

--alone diagnoses nothing: it replays every patched_model.xml of --work alone on the recordings of its study, beside the
model as built. The exit status is 1 where one is worse on training or held-out recordings.

--fit fits laws whether or not a diagnosis would try them, and says what they leave of all recordings. Each is laws that
act together, each LAW:KIND:NAME of where it acts. The robot's parameters are fitted with them, as hypotheses of a
diagnosis are, and alone in the first row.
"""

import argparse
import re
import sys
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from soro_bench.diagnosis.candidates import Term, terms
from soro_bench.diagnosis.data_quality.noise import data_quality
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, fitted
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.outliers import nominal_fit
from soro_bench.diagnosis.preparation import unexplained
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import FITTED, Robot
from soro_bench.diagnosis.selection.moves import iterate_to_convergence
from soro_bench.diagnosis.study import STUDIES, load_study
from soro_bench.diagnosis.study_runs import check_summaries, errors_of, named, results, run_study
from soro_bench.files import read_json, write_json
from soro_bench.markdown import table
from soro_bench.recording.recording import Recording

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results" / "real_robots.json"
DATA = ("train", "heldout", "unseen")
RADII = (0.7, 0.3)  # prior deviations, of samples around fits of --fit


UNITS = {"m": (1000, "mm"), "rad": (1, "rad"), "N": (1, "N"), "m/s^2": (1, "m/s²")}  # of a table: factor and name


def left(summary: dict, fit: dict) -> str:
    """The rms distance of the last point that a fit leaves, of all kinds of data: train, held out, unseen."""
    factor, unit = UNITS[summary["unit"]]
    found = [errors["rms"] for key, errors in fit.items() if key in DATA]
    return ", ".join("-" if rms is None else f"{rms * factor:.3g}" for rms in found) + f" {unit}"


def unnamed(summary: dict) -> str:
    """The probability of a discrepancy outside the catalogue, and where it is, if that is the verdict."""
    first, *rest = summary["verdict"].splitlines()
    site = re.match(r"Something acts at (.+) that has no name", first)  # as older verdicts say it
    if "outside the catalogue" in first:
        site = next((found for line in rest if (found := re.match(r" +location +(\S.*)", line))), None)
    return f"{summary['unknown']:.2f}" + (f", {site[1]}" if site else "")


def every_seed() -> str:
    """Markdown: the answer of every seed and what it leaves, the table of docs/archive/real_robots.md."""
    rows = []
    for s in sorted(read_json(RESULTS), key=lambda s: (STUDIES.index(s["study"]), s["part"], s["seed"])):
        best = s["answers"][0]
        rows.append((
            f"{s['study']}, {s['part']}",
            s["seed"],
            left(s, s["parameters"]),
            left(s, best),
            " + ".join(map(named, best["effects"])) or "nothing",
            f"{best['probability']:.2f}",
            unnamed(s),
        ))
    names = ("robot, part", "seed", "parameters", "patched", "likeliest in the catalogue", "probability", "outside")
    return table(names, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT / "data" / "real")
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "studies")
    parser.add_argument("--only", nargs="+", default=list(STUDIES), choices=list(STUDIES))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--alone", action="store_true")
    parser.add_argument("--fit", nargs="+", action="append", default=[], metavar="LAW:KIND:NAME")
    options = parser.parse_args()
    if options.alone:
        sys.exit(1 if print_alone(options) else 0)
    if options.fit:
        print_fits(parser, options)
        return
    runs, found, failed = [], list[dict](), list[str]()
    for name in options.only:
        try:
            study = load_study(name, options.data)
            folders = [(study, options.work / f"{name}_{seed}", seed) for seed in range(options.seeds)]
            for each in folders:  # before hours of work, not after them
                check_summaries(*each)
        except (ValueError, OSError) as error:
            failed.append(f"{name}: {error}")
        else:
            runs += folders
    for study, folder, seed in runs:
        try:
            found += run_study(study, folder, seed, options.threads, partial(print, folder.name, flush=True))
        except (ValueError, OSError) as error:  # what a recording, a model or a folder lacks
            failed.append(f"{folder.name}: {error}")
            print("failed:", failed[-1], flush=True)
        write_results(found)
    print(first_seed(), every_seed(), sep="\n\n")
    if failed:
        sys.exit("\n".join(["failed:", *failed]))


def first_seed() -> str:
    """Markdown: what all studies have found with seed 0."""
    return results([s for s in read_json(RESULTS) if s["seed"] == 0])


def print_alone(options: argparse.Namespace) -> bool:
    """Print errors of all patched models of a folder of studies; whether one is worse than the model as built."""
    rows, worse = [], False
    for name in options.only:
        study = load_study(name, options.data)
        built = ModelRobot(study.model, study.map, options.threads)
        for seed in range(options.seeds):
            for part in study.parts:
                path = options.work / f"{name}_{seed}" / part.name / "patched_model.xml"
                if not path.exists():
                    continue
                patched = built.as_built(path.read_text(encoding="utf-8"))
                for key in DATA:
                    if some := getattr(part, key):
                        before, after = (replay_rms(robot, some) for robot in (built, patched))
                        worse |= after > before and key != "unseen"
                        rows.append((f"{name}, {part.name}", seed, key, f"{before:.4g}", f"{after:.4g}", built.unit))
    print(table(("robot, part", "seed", "data", "as built", "patched alone", "unit"), rows))
    return worse


def replay_rms(robot: Robot, recordings: Sequence[Recording]) -> float:
    """Root mean square [signal's unit] of all samples, of a robot with nominal parameters."""
    parameters, found = np.array([[prior.nominal for prior in robot.priors]]), []
    for recording in recordings:
        measured = robot.measured(recording)
        drive = measured.drive
        (values,) = robot.simulate(drive.actions, parameters, [()], drive.start, settings=drive.settings)
        found.append((values - measured.values).ravel())
    return float(np.sqrt(np.nanmean(np.concatenate(found) ** 2)))


def print_fits(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """A table of what laws leave of the studies asked for, in the signal's unit; a row as soon as it is there."""
    for name in options.only:
        study = load_study(name, options.data)
        robot = ModelRobot(study.model, study.map, options.threads)
        fits = [[_term(parser, robot, text) for text in texts] for texts in options.fit]
        for part in study.parts:
            sets = {key: tuple(map(robot.measured, getattr(part, key))) for key in DATA if getattr(part, key)}
            sigma = min(data_quality(each).sigma for each in sets["train"])
            cells = [f"{key}: {error}" for key in sets for error in ("mean absolute", "rms")]
            print(f"\n{name}, {part.name}\n\n| laws | seed | " + " | ".join(cells) + " | excess [nats] | |")
            print("|" + "---|" * (len(cells) + 4))
            for seed in range(options.seeds):
                problem = unexplained(robot.shortened(FITTED), sets["train"], sigma)
                problem, nominal = nominal_fit(problem, robot.refined(), seed)
                _print_row(problem, sets, nominal, seed)
                for some in fits:
                    starts = product(*map(_starts, some))
                    guesses = [Guess(np.concatenate([nominal.x, *x]), tuple(some)) for x in starts]
                    found = iterate_to_convergence(problem, fitted(problem, guesses, RADII, seed), seed)
                    _print_row(problem, sets, min(found, key=lambda h: h.cost), seed)


def _starts(term: Term) -> list[np.ndarray]:
    """Typical magnitudes, and their opposites where the law has such: softer as well as stiffer."""
    return [x for x in (term.simulated, -term.simulated) if (x >= term.bounds[0]).all()]


def _term(parser: argparse.ArgumentParser, robot: Robot, text: str) -> Term:
    known: dict[tuple[str, ...], Term] = {}
    for one in terms(robot):  # the first of the signatures that a law may have there
        if one.location.index is None:
            known.setdefault((one.name, one.location.kind, one.location.name), one)
    if (key := tuple(text.split(":"))) in known:
        return known[key]
    if len(key) != 3:
        parser.error(f"{text!r} is no LAW:KIND:NAME")
    parser.error(
        f"no {text}; of that law there are {', '.join(':'.join(k) for k in known if k[0] == key[0]) or 'none'}"
    )


def _print_row(problem: Problem, sets: dict[str, tuple[Measured, ...]], hypothesis: Hypothesis, seed: int) -> None:
    errors = errors_of(problem.robot, sets, hypothesis)
    cells = [f"{errors[key][error]:.4g}" for key in sets for error in ("mean_absolute", "rms")]
    laws = " + ".join(f"{s.name} at {s.location.name}" for s in hypothesis.terms) or "parameters alone"
    values = "; ".join(str(dict(e.parameters)) for e in hypothesis.effects(problem.parameters))
    print(
        f"| {laws} | {seed} | {' | '.join(cells)} | {problem.misfit(hypothesis.residual):.0f} | {values} |", flush=True
    )


def write_results(found: list[dict]) -> None:
    """Put summaries in the place of earlier ones. Others stay; ``method`` has their version (the oldest lack it)."""
    new = {(s["study"], s["part"], s["seed"]) for s in found}
    old = read_json(RESULTS) if RESULTS.exists() else []
    others = [s for s in old if (s["study"], s["part"], s["seed"]) not in new]
    write_json(RESULTS, sorted(others + found, key=lambda s: (STUDIES.index(s["study"]), s["seed"])))


if __name__ == "__main__":
    main()
