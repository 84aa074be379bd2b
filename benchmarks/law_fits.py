"""What laws leave of a study's recordings, each fitted whether or not a diagnosis would try it.

    python benchmarks/law_fits.py bam_servo gains --fit coulomb_friction:joint:hinge --seeds 0 1 2
    python benchmarks/law_fits.py asl_trunk random --fit "actuator_delay:actuator:*" local_stiffness:body:link3_3of3

A --fit is laws that act together, each LAW:KIND:NAME of where it acts; the parameters of the robot are fitted with
them, as hypotheses of a diagnosis are, and alone in the first row.
"""

import argparse
from itertools import product
from pathlib import Path

import numpy as np

from soro_bench.diagnosis.candidates import Term, terms
from soro_bench.diagnosis.data_quality.noise import data_quality
from soro_bench.diagnosis.estimation.fit import Guess, Hypothesis, fitted
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.pipeline import unexplained
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import FITTED, Robot
from soro_bench.diagnosis.selection.forward_selection import nominal_fit
from soro_bench.diagnosis.selection.moves import iterate_to_convergence
from soro_bench.diagnosis.study import STUDIES, errors_of, load_study

RADII = (0.7, 0.3)
SETS = ("train", "heldout", "unseen")


def main() -> None:
    """Print a table of errors in the signal's unit, a row as soon as it is there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("part")
    parser.add_argument("--fit", nargs="+", action="append", default=[], metavar="LAW:KIND:NAME")
    parser.add_argument("--data", type=Path, default=Path("data/real"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args()
    study = load_study(options.study, options.data)
    if options.part not in (parts := {part.name: part for part in study.parts}):
        parser.error(f"no part {options.part!r} in {study.name}; there are {', '.join(parts)}")
    part = parts[options.part]
    robot = ModelRobot(study.model, study.map, options.threads)
    fits = [[_term(parser, robot, text) for text in texts] for texts in options.fit]
    sets = {key: tuple(map(robot.measured, getattr(part, key))) for key in SETS if getattr(part, key)}
    sigma = min(data_quality(each).sigma for each in sets["train"])
    cells = [f"{key}: {error}" for key in sets for error in ("mean absolute", "rms")]
    print("| laws | seed | " + " | ".join(cells) + " | excess [nats] | |\n|" + "---|" * (len(cells) + 4))
    for seed in options.seeds:
        problem, nominal = nominal_fit(
            unexplained(robot.shortened(FITTED), sets["train"], sigma), robot.refined(), seed
        )
        _print_row(problem, sets, nominal, seed)
        for some in fits:
            guesses = [Guess(np.concatenate([nominal.x, *x]), tuple(some)) for x in product(*map(_starts, some))]
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


if __name__ == "__main__":
    main()
