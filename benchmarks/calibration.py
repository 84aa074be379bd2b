"""Probabilities of first answers against how often these were right, and monotone maps that would calibrate them.

    python benchmarks/calibration.py [PATH ...] [--leave-out case | source]

A PATH is a packed release (docs/results/releases/release_6.json.xz), a folder as soro-bench blind-benchmark leaves it,
or one of benchmarks/other_simulators.py with --diagnose. By default the open releases 2 to 6. Prints, for probabilities
as stated and for maps of them that never saw the case they are judged on: expected calibration error (ten bins),
Brier and log score, and of the Brier score miscalibration and resolution after isotonic recalibration (Dimitriadis,
Gneiting, Jordan, "Stable reliability diagrams for probabilistic classifiers", PNAS 2021). Then how many cases it takes
to tell a map from what is stated by its log score, and two of the maps. Cases of test seeds are refused.

The maps: "temperature" divides log odds by a number; "isotonic" is monotone in the stated probability; "answer" is the
frequency of answers of a kind (none, a law, unknown); "answer and margin" is, for laws, monotone in the margin of
evidence to the best hypothesis without the law, in temperatures; "logistic" is linear, in log odds, in the stated log
odds, log(1 + margin) and the kind of answer (Platt, "Probabilistic outputs for support vector machines", 1999).
"""

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import isotonic_regression, minimize_scalar
from scipy.special import expit, logit

from soro_bench.arrays import Bools, Floats
from soro_bench.blind_benchmark.criteria import BINS
from soro_bench.blind_benchmark.score import case_row
from soro_bench.diagnosis.selection.model_probabilities import temperature
from soro_bench.files import read_json
from soro_bench.leaderboard.diagnosis_entry import Release
from soro_bench.markdown import table

RELEASES = Path(__file__).parents[1] / "docs" / "results" / "releases"
OPEN = tuple(RELEASES / f"release_{i}.json.xz" for i in range(2, 7))  # the first one had no cap of probabilities
TEST_SEEDS = 500_000  # of other simulators, from here on; no threshold is set on them
ERRORS = 2.0  # standard errors, by which a map has to be better than what is stated
_SURE = 1e-6  # a stated probability is no nearer to 0 or 1: its log score would be infinite
_HOTTEST = 20.0  # temperature
_NEWTON, _RIDGE = 30, 0.1  # steps; precision of weights, as where no answer of a kind is wrong
COLUMNS = ("log odds as stated", "log(1 + margin) of a law", "a law", "none", "unknown")


@dataclass(frozen=True)
class Answers:
    """First answers of N cases.

    source: (N,) number of the PATH. stated: (N,) probabilities. right: (N,). kind: (N,) 0 none, 1 a law, 2 unknown.
    margin: (N,) of evidence, in temperatures; 0 where it is unknown.
    """

    source: Floats
    stated: Floats
    right: Bools
    kind: Floats
    margin: Floats

    def only(self, chosen: Bools) -> "Answers":
        """Some of them."""
        source, stated, right, kind, margin = (self.source, self.stated, self.right, self.kind, self.margin)
        return Answers(source[chosen], stated[chosen], right[chosen], kind[chosen], margin[chosen])


Map = Callable[[Answers], Floats]
Row = tuple[float, bool, str, float]  # stated probability, right, name of the first answer, margin


def read_answers(paths: Sequence[Path]) -> Answers:
    """All cases of all paths.

    Raises:
        ValueError: a path has no diagnosed case, or one of a test seed.
    """
    rows = []
    for number, path in enumerate(paths):
        found = _of_release(path) if path.suffix == ".xz" or (path / "reports").is_dir() else _of_simulators(path)
        if not found:
            raise ValueError(f"{path} has no diagnosed case; expected a release or folders with label and answer.json")
        rows += [(number, *row) for row in found]
    source, stated, right, names, margin = zip(*rows, strict=True)
    kinds = [{"none": 0, "unknown": 2}.get(name, 1) for name in names]
    return Answers(np.array(source), np.clip(stated, _SURE, 1 - _SURE), np.array(right), np.array(kinds),
                   np.array(margin))  # fmt: skip


def _of_release(path: Path) -> list[Row]:
    release, rows = Release.load(path) if path.suffix == ".xz" else Release.gather(path), []
    for label in release.labels["cases"]:
        report = release.reports[label["id"]]
        row, hypotheses = case_row(label, report), report["hypotheses"]
        compared = [(h["names"], h["evidence"], h["excess_of_all"]) for h in hypotheses]
        rows.append((row["probability"], row["first"], row["said"][0], margin(row["said"][0], compared)))
    return rows


def _of_simulators(folder: Path) -> list[Row]:
    rows = []
    for path in sorted(folder.glob("*/answer.json")):
        label, answer = read_json(path.parent / "label.json"), read_json(path)
        if label["seed"] >= TEST_SEEDS:
            raise ValueError(f"{path.parent} has the seed {label['seed']}; seeds from {TEST_SEEDS} on are for tests")
        healthy, name = not label["effects"], answer["name"]
        right = answer["verdict"] == "adequate" if healthy else name in label["effects"][0]["names"]
        rows.append((answer["probability"], right, name, margin(name, answer.get("hypotheses", []))))
    return rows


def margin(first: str, hypotheses: Sequence[tuple[Sequence[str], float, float]]) -> float:
    """How much more evidence a law has than the best other hypothesis without it, in temperatures; 0 without one.

    Args:
        hypotheses: names of effects, log evidence and misfit [nats] of each.
    """
    with_it = [evidence for names, evidence, _ in hypotheses if first in names]
    others = [evidence for names, evidence, _ in hypotheses if names and first not in names]
    if not with_it or not others:
        return 0.0
    return (max(with_it) - max(others)) / temperature(min(misfit for _, _, misfit in hypotheses))


def as_stated(_: Answers) -> Map:
    """Nothing is changed."""
    return lambda answers: answers.stated


def by_temperature(answers: Answers) -> Map:
    """The temperature whose log score is best."""
    odds = logit(answers.stated)
    found = minimize_scalar(
        lambda t: log_score(expit(odds / t), answers.right), bounds=(1 / _HOTTEST, _HOTTEST), method="bounded"
    )
    return lambda others: expit(logit(others.stated) / found.x)


def by_isotonic(answers: Answers) -> Map:
    """Monotone in the stated probability."""
    steps = Steps.of(answers.stated, answers.right)
    return lambda others: steps(others.stated)


def by_answer(answers: Answers) -> Map:
    """How often answers of a kind are right."""
    shares = [_smoothed(answers.right[answers.kind == kind]) for kind in range(3)]
    return lambda others: np.array(shares)[others.kind.astype(int)]


def by_margin(answers: Answers) -> Map:
    """Of laws monotone in the margin, of other answers how often they are right."""
    laws, shares = answers.only(answers.kind == 1), by_answer(answers)
    steps = Steps.of(laws.margin, laws.right)
    return lambda others: np.where(others.kind == 1, steps(others.margin), shares(others))


def _columns(answers: Answers) -> Floats:
    """(N, 5) what the logistic map is linear in."""
    laws = answers.kind == 1
    margins = np.log1p(np.maximum(answers.margin, 0.0)) * laws
    return np.column_stack([logit(answers.stated), margins, laws, answers.kind == 0, answers.kind == 2])


def weights(answers: Answers) -> Floats:
    """(5,) of the columns of the logistic map, by Newton's method; small ones are likelier."""
    columns, found = _columns(answers), np.zeros(5)
    for _ in range(_NEWTON):
        p = expit(columns @ found)
        gradient = columns.T @ (p - answers.right) + _RIDGE * found
        hessian = (columns * (p * (1.0 - p))[:, None]).T @ columns + _RIDGE * np.eye(5)
        found = found - np.linalg.solve(hessian, gradient)
    return found


def by_logistic(answers: Answers) -> Map:
    """Monotone in log odds and margin, with a level for each kind of answer."""
    found = weights(answers)
    return lambda others: np.clip(expit(_columns(others) @ found), _SURE, 1 - _SURE)


MAPS: dict[str, Callable[[Answers], Map]] = {
    "as stated": as_stated,
    "temperature": by_temperature,
    "isotonic": by_isotonic,
    "answer": by_answer,
    "answer and margin": by_margin,
    "logistic": by_logistic,
}


@dataclass(frozen=True)
class Steps:
    """A step function that never falls: from ``start`` (K,) on it is ``value`` (K,), of ``count`` (K,) cases."""

    start: Floats
    value: Floats
    count: Floats

    @classmethod
    def of(cls, x: Floats, right: Bools) -> "Steps":
        """Pool adjacent violators; a block of n cases with k right is (k + 1) / (n + 2), as few say little."""
        if not x.size:
            return cls(np.zeros(1), np.full(1, 0.5), np.zeros(1))
        starts, inverse, counts = np.unique(x, return_inverse=True, return_counts=True)
        means = np.bincount(inverse, weights=right.astype(float)) / counts
        found = isotonic_regression(means, weights=counts)
        first = found.blocks[:-1]
        count = np.add.reduceat(counts, first)
        value = (count * found.x[first] + 1.0) / (count + 2.0)
        return cls(starts[first], np.maximum.accumulate(value), count)

    def __call__(self, x: Floats) -> Floats:
        """(N,) probabilities at x (N,)."""
        return self.value[np.maximum(np.searchsorted(self.start, x, side="right") - 1, 0)]


def _smoothed(right: Bools) -> float:
    return float((right.sum() + 1.0) / (right.size + 2.0))


def left_out(fit: Callable[[Answers], Map], answers: Answers, groups: Floats) -> Floats:
    """(N,) probabilities by maps that were made without the group (N,) of the case."""
    found = np.zeros(answers.stated.size)
    for group in np.unique(groups):
        inside = groups == group
        found[inside] = fit(answers.only(~inside))(answers.only(inside))
    return found


def calibration_error(p: Floats, right: Bools) -> float:
    """Expected calibration error in ten bins (Naeini et al., AAAI 2015)."""
    bins = np.minimum((BINS * p).astype(int), BINS - 1)
    return float(sum(abs((p - right)[bins == k].sum()) for k in range(BINS)) / p.size)


def brier(p: Floats, right: Bools) -> float:
    """Mean squared error."""
    return float(np.mean((p - right) ** 2))


def log_score(p: Floats, right: Bools) -> float:
    """Mean surprise [nats]."""
    return float(-np.mean(np.log(np.where(right, p, 1.0 - p))))


def recalibrated(p: Floats, right: Bools) -> Floats:
    """(N,) the isotonic regression of what is right on p (N,), of the same cases."""
    _, inverse, counts = np.unique(p, return_inverse=True, return_counts=True)
    means = np.bincount(inverse, weights=right.astype(float)) / counts
    return np.asarray(isotonic_regression(means, weights=counts).x[inverse], float)


def figures(p: Floats, right: Bools) -> tuple[float, ...]:
    """Calibration error, Brier and log score; miscalibration and resolution of the Brier score."""
    again = brier(recalibrated(p, right), right)
    resolution = brier(np.full(p.size, right.mean()), right) - again
    return calibration_error(p, right), brier(p, right), log_score(p, right), brier(p, right) - again, resolution


def needed(p: Floats, stated: Floats, right: Bools) -> float:
    """How many cases tell that a map has the better log score, by ``ERRORS`` standard errors; NaN if it has not."""
    gain = np.log(np.where(right, p, 1.0 - p)) - np.log(np.where(right, stated, 1.0 - stated))
    return math.ceil((ERRORS * gain.std() / gain.mean()) ** 2) if gain.mean() > 0 else math.nan


def summary(answers: Answers, by_source: bool = False) -> str:
    """Markdown: how good the maps are, and the one by answer and margin."""
    groups = answers.source if by_source else np.arange(answers.stated.size, dtype=float)
    rows = []
    for name, fit in MAPS.items():
        p = left_out(fit, answers, groups)
        count = "" if fit is as_stated else f"{needed(p, answers.stated, answers.right):.0f}"
        rows.append((name, *(f"{value:.3f}" for value in figures(p, answers.right)), count))
    head = ("map", "calibration error", "Brier", "log score", "miscalibration", "resolution", "cases needed")
    shares = by_answer(answers)
    laws = answers.only(answers.kind == 1)
    steps = Steps.of(laws.margin, laws.right)
    columns = zip(steps.start, steps.value, steps.count, strict=True)
    found = [(f"a law, margin from {start:.2f}", f"{p:.3f}", int(count)) for start, p, count in columns]
    for kind, name in ((0, "none"), (2, "unknown")):
        some = answers.only(answers.kind == kind)
        found += [(name, f"{shares(some)[0]:.3f}", some.stated.size)] if some.stated.size else []
    said = f"{answers.stated.size} cases, {100 * answers.right.mean():.1f} % right, stated {answers.stated.mean():.3f}"
    logistic = [(name, f"{weight:.3f}") for name, weight in zip(COLUMNS, weights(answers), strict=True)]
    return "\n\n".join([said, table(head, rows), table(("answer", "probability", "cases"), found),
                        table(("logistic", "weight"), logistic)])  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", type=Path, nargs="*", default=list(OPEN), metavar="PATH")
    parser.add_argument("--leave-out", choices=("case", "source"), default="case", help="what a map does not see")
    chosen = parser.parse_args()
    by_source = chosen.leave_out == "source"
    if by_source and len(chosen.paths) < 2:
        raise SystemExit("--leave-out source needs two paths or more")
    try:
        answers = read_answers(chosen.paths)
    except (OSError, ValueError) as error:
        raise SystemExit(str(error)) from error
    print(summary(answers, by_source))


if __name__ == "__main__":
    main()
