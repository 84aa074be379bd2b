"""How late a robot follows its commands, from its recordings alone.

    python benchmarks/command_lag.py --data data/real [--study asl_trunk --part random --signal disks]
    python benchmarks/command_lag.py --data data/real --signal motor_angles     # of the last motor

The last point of a signal is fitted as a linear function of the commands some time earlier, for every lag up to 0.5 s;
prints the best one, and the errors without any. No model is used: a simulation with a delay has to be better than this.
"""

import argparse
from pathlib import Path

import numpy as np

from soro_bench.diagnosis.study import load_study
from soro_bench.recording.recording import Recording

LAGS = np.arange(0.0, 0.5, 0.01)  # s


def rows(recording: Recording, name: str, lag: float) -> tuple[np.ndarray, np.ndarray]:
    """Commands some time ago and one, and the last point of the signal, at its samples."""
    (command,), signal = recording.commands.values(), recording.signals[name]
    late = signal.time - lag >= command.time[0]
    columns = [np.interp(signal.time[late] - lag, command.time, each) for each in command.values.T]
    return np.stack([*columns, np.ones(late.sum())], axis=1), signal.values[late, -1].reshape(late.sum(), -1)


def errors(train, heldout, name: str, lag: float) -> tuple[float, float]:
    """Root mean square distance [signal's unit] on what was fitted, and on what was held out."""
    x, y = map(np.concatenate, zip(*(rows(each, name, lag) for each in train), strict=True))
    weights = np.linalg.lstsq(x, y, rcond=None)[0]
    both = [(x, y), tuple(map(np.concatenate, zip(*(rows(each, name, lag) for each in heldout), strict=True)))]
    return tuple(float(np.sqrt(((a @ weights - b) ** 2).sum(axis=1).mean())) for a, b in both)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/real"))
    parser.add_argument("--study", default="asl_trunk")
    parser.add_argument("--part", default="random")
    parser.add_argument("--signal", default="disks")
    options = parser.parse_args()
    (part,) = [p for p in load_study(options.study, options.data).parts if p.name == options.part]
    found = {lag: errors(part.train, part.heldout, options.signal, lag) for lag in LAGS}
    best = min(found, key=lambda lag: found[lag][0])
    unit = f"1e-3 {part.train[0].signals[options.signal].unit}"
    for lag in (0.0, best):
        print(f"lag {lag:.2f} s: {1e3 * found[lag][0]:.1f} {unit}, held out {1e3 * found[lag][1]:.1f} {unit}")


if __name__ == "__main__":
    main()
