"""Frequency and decay of the silicone beam, recorded and simulated with fitted parameters.

    python benchmarks/beam_decay.py gravity --data data/real
    python benchmarks/beam_decay.py load52 --data data/real --report runs/studies/silicone_beam_0/load

The parameters are fitted to the recording a, without effects; with --report those and the effects are what a diagnosis
has found. Then what is left of the recordings a and b, and of the height of the first marker in windows of two periods
a fit of A exp(-s t) cos(2 pi f t + p) + c + d t: amplitude A, frequency f, logarithmic decrement s / f.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from soro_bench.assets import mjcf_path
from soro_bench.diagnosis.baseline import baseline
from soro_bench.diagnosis.estimation.data_quality import data_quality
from soro_bench.diagnosis.estimation.problem import Problem
from soro_bench.diagnosis.pipeline import unexplained
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import FITTED
from soro_bench.diagnosis.selection.forward_selection import nominal_fit
from soro_bench.recording.importers import import_recording

FREQUENCY = {"gravity": 7.7, "load52": 4.4}  # Hz, about
WINDOWS, FROM = 5, 0.3  # from 0.3 s after the hand lets go: its fingers and the slack string are out of the way


def decay(time: np.ndarray, height: np.ndarray, frequency: float) -> np.ndarray:
    """(WINDOWS, 3) amplitude [mm], frequency [Hz] and logarithmic decrement."""
    found = []
    for k in range(WINDOWS):
        chosen = (time >= 2 * k / frequency) & (time < 2 * (k + 1) / frequency)
        t, h = time[chosen] - time[chosen][0], 1e3 * height[chosen]

        def left(q, t=t, h=h):
            return q[0] * np.exp(-q[1] * t) * np.cos(2 * np.pi * q[2] * t + q[3]) + q[4] + q[5] * t - h

        starts = [[np.ptp(h) / 2, 2.0, frequency, phase, h.mean(), 0.0] for phase in (0, 1.5, 3, 4.5)]
        best = min((least_squares(left, start) for start in starts), key=lambda fit: fit.cost)
        found.append([abs(best.x[0]), best.x[2], best.x[1] / best.x[2]])
    return np.array(found)


def main() -> None:
    """Print the table of a kind of recordings."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=list(FREQUENCY))
    parser.add_argument("--data", type=Path, default=Path("data/real"))
    parser.add_argument("--report", type=Path, help="folder of a diagnosis")
    options = parser.parse_args()
    kind, model = options.kind, mjcf_path("real/silicone_beam.xml")
    found = baseline(options.report) if options.report else None
    robot = ModelRobot(model, model.with_suffix(".toml"), baseline=found).shortened(FITTED)
    mapping, folder = mjcf_path(f"real/silicone_beam_{kind}_import.toml"), options.data / "silicone_beam_arm"
    measured = [robot.measured(import_recording(folder / f"beam_{kind}_V2_{run}.csv", mapping)) for run in "ab"]
    x = np.zeros(len(robot.priors))
    if not found:
        _, nominal = nominal_fit(
            unexplained(robot, (measured[0],), data_quality(measured[0]).sigma), robot.refined(), seed=0
        )
        x = nominal.x
    print("; ".join(map(str, robot.known)) or "no effects")
    print(", ".join(f"{name} {value:.4g}" for name, value in robot.parameters(x).items()))
    for run, each in zip("ab", measured, strict=True):
        _compare(unexplained(robot, (each,), 1.0), x, f"{kind} {run}", FREQUENCY[kind])


def _compare(problem: Problem, x: np.ndarray, label: str, frequency: float) -> None:
    (measured,) = problem.recordings
    simulated = problem.simulated(problem.robot, [(x, ())])[0].reshape(measured.values.shape)
    left = 1e3 * np.sqrt(np.nanmean((measured.values - simulated) ** 2))
    since = measured.time - measured.time[np.flatnonzero(measured.settings[:, 0] == 0)[0]] - FROM
    seen = np.isfinite(measured.values[:, 0, 0])  # not every step of the simulation was recorded
    rows = [decay(since[seen], each[seen, 0, 0], frequency) for each in (measured.values, simulated)]
    print(f"{label}: {left:.3f} mm rms of a coordinate; recorded | simulated amplitude mm, Hz, decrement")
    for recorded, replayed in zip(*rows, strict=True):
        print("   " + " | ".join(f"{a:6.3f} {f:6.3f} {d:6.3f}" for a, f, d in (recorded, replayed)))


if __name__ == "__main__":
    main()
