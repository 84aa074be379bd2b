"""What single laws of friction leave of the servo's recordings, each fitted whether or not a diagnosis would try it.

    python benchmarks/servo_friction.py --data data/real [--laws coulomb_friction ...] [--seeds 3] [--threads 1]

Viscous friction is a parameter of the servo's model, so the default is Coulomb and viscous friction, the model that the
servo's simulators have. Fitted as hypotheses of a diagnosis are.
"""

import argparse
from pathlib import Path

import numpy as np

from soro_bench.diagnosis.audit import audit
from soro_bench.diagnosis.explain import nominal_fit
from soro_bench.diagnosis.fit import Guess, fitted
from soro_bench.diagnosis.model_robot import ModelRobot
from soro_bench.diagnosis.pipeline import unexplained
from soro_bench.diagnosis.refit import persevered
from soro_bench.diagnosis.robot import FITTED
from soro_bench.diagnosis.study import errors_of, load_study
from soro_bench.diagnosis.suspects import suspect
from soro_bench.effects.effect import Port

RADII = (0.7, 0.3)


def main() -> None:
    """Print a table: mean absolute errors [rad]."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/real"))
    parser.add_argument("--laws", nargs="+", default=["coulomb_friction"])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args()
    study = load_study("bam_servo", options.data)
    (part,) = study.parts
    robot = ModelRobot(study.model, study.map, options.threads)
    train = tuple(robot.measured(each) for each in part.train)
    sets = {key: tuple(map(robot.measured, getattr(part, key))) for key in ("train", "heldout", "unseen")}
    print("| friction | seed | fitted to | held out | unseen | excess | |\n|" + "---|" * 7)
    for seed in range(options.seeds):
        sigma = min(audit(each).sigma for each in train)
        problem, nominal = nominal_fit(unexplained(robot.shortened(FITTED), train, sigma), robot.refined(), seed)
        for law in options.laws:
            one = suspect(robot, law, Port("joint", "hinge"))
            found = fitted(problem, [Guess(np.concatenate([nominal.x, one.simulated]), (one,))], RADII, seed)
            found = persevered(problem, found, seed)
            errors = errors_of(problem.robot, sets, found[0])
            cells = [f"{errors[key]['mean_absolute']:.4f}" for key in sets]
            print(f"| {law} | {seed} | {' | '.join(cells)} | {problem.excess(found[0].residual):.0f} | "
                  f"{found[0].effects(problem.parameters)[0].parameters} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
