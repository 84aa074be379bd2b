"""What time steps leave, how much of the accurate trunk the discretisation error explains, with and
without a hidden effect, and how fits converge.

    python benchmarks/diagnosis_floor.py

Prints the tables of the discretisation error. The recorded robots are those of soro_bench.blind_benchmark, 30 s of
excitation.
"""

import argparse

import numpy as np
from gymnasium import spaces

from soro_bench.diagnosis.candidates import term
from soro_bench.diagnosis.estimation.discretisation import discretisation_and_residuals
from soro_bench.diagnosis.estimation.fit import Guess, fitted
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.robot import FITTED, Robot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import EVERY, Location
from soro_bench.inference.statistical_linearisation import LowRank
from soro_bench.markdown import header, row
from soro_bench.recording.excitation import excitation

NOISE, TRUTH = 5e-4, np.array([0.5, -0.4, -0.6, 0.3, 0.2])  # m; standard deviations of the priors
FAR, NEAR = 0.7, 0.15  # of draws, in standard deviations of the priors


def problem(robot: Robot, recorded: Robot, effects=(), noise=0.0) -> Problem:
    """A recording of another robot with parameters at TRUTH."""
    actions = excitation(spaces.Box(-1, 1, (8,), np.float32), 0.05).astype(np.float32)
    parameters = np.array([[prior.value(x) for prior, x in zip(robot.priors, TRUTH, strict=True)]])
    (values,) = recorded.simulate(actions, parameters, [effects])
    values = values + noise * np.random.default_rng(1).standard_normal(values.shape)
    measured = Measured(actions, 0.05 * np.arange(1, len(actions) + 1), values, "keypoints", "m")
    return Problem(robot, (measured,), NOISE, np.ones(values.size), LowRank(np.zeros((0, values.size))))


def left(given: Problem) -> float:
    """mm, rms of a coordinate at the truth that the floor does not explain."""
    residual = given.residuals([(TRUTH, ())])[0]
    return 1e3 * NOISE * float(np.sqrt((given.discretisation.without(residual) ** 2).mean()))


def time_steps() -> None:
    """What longer time steps leave of a trunk with an eighth of the model's, before and after the parameters fit."""
    given, recorded = SuiteRobot("TrunkReach-v0"), SuiteRobot("TrunkReach-v0", shorter=8)
    print(header(("time step [ms]", "left at the truth [mm]", "after fitting", "nu off by [sd]")))
    for shorter in (1, 2, 4):
        exact = problem(given.shortened(shorter), recorded)
        (found,) = fitted(exact, [Guess(TRUTH)], (0.3, 0.15, 0.08), seed=0)
        after = 1e3 * NOISE * float(np.sqrt((found.residual**2).mean()))
        off = f"{found.x[1] - TRUTH[1]:+.2f}"
        print(row((f"{10 / shorter:g}", f"{left(exact):.2f}", f"{after:.2f}", off)), flush=True)


def floor_at(given, refined, points):
    """(F, M) the discretisation error at points."""
    return discretisation_and_residuals(given, refined, points, ())[0]


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    time_steps()
    given = SuiteRobot("TrunkReach-v0")
    robot, (finer, accurate) = given.shortened(FITTED), given.refined()
    rng = np.random.default_rng(0)
    given = problem(robot, accurate)
    print("\n" + header(("differences at", "number", "left [mm]")))
    print(row(("none", "", f"{left(given):.2f}")))
    for name, count, centre, spread in (("the prior", 5, np.zeros(5), FAR), ("around the truth", 3, TRUTH, NEAR)):
        points = [(centre + spread * rng.standard_normal(5), ()) for _ in range(count)]
        discretisation = floor_at(given, [finer, accurate], points)
        print(row((f"draws from {name}", count, f"{left(given.with_discretisation(discretisation)):.2f}")), flush=True)

    print("\n" + header(("hidden", "without", "with it")))
    for name, location in (("actuator_delay", Location("actuator", EVERY)), ("stiffening", Location("body", EVERY))):
        one = term(robot, name, location)
        x = np.append(TRUTH, 0.15)
        given = problem(robot, accurate, (one.effect(x[5:]),), NOISE)
        near = [(TRUTH + NEAR * rng.standard_normal(5), ()) for _ in range(3)]
        plain = given.with_discretisation(floor_at(given, [finer, accurate], near))
        both = plain.with_discretisation(floor_at(given, [finer, accurate], [(x, (one,))]))
        residual = given.residuals([(x, (one,))])[0]
        print(row((name, f"{plain.misfit(residual):.0f}", f"{both.misfit(residual):.0f}")), flush=True)

    given = problem(robot, robot, noise=NOISE)
    print("\n" + header(("sampling radii", "chi2 per sample")))
    for count in range(1, 5):
        scales = (0.7, 0.4, 0.2, 0.1)[:count]
        (found,) = fitted(given, [Guess(np.zeros(5))], scales, seed=0)
        print(row((", ".join(map(str, scales)), f"{2 * found.cost / found.residual.size:.3f}")), flush=True)


if __name__ == "__main__":
    main()
