"""Searches that can be killed: every expensive result goes into a log, from which the same search replays itself."""

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from soro_bench.arrays import Floats

SearchProgress = Callable[[int, int, float], None]  # what is done, what there is to do, and the cost so far
Residuals = Callable[[Floats, int], Floats]  # points (N, d), steps -> (N, steps, k) measured less simulated
WORST = 1e300  # the cost of a replay that diverges: worse than those of all that do not


class EvaluationLog:
    """The results of expensive calls in the order in which they were made, a line of JSON each.

    A search is deterministic, so a second one with the same settings asks for the same results in the same order: those
    in the file are read, the others computed and added. Nothing else has to be saved.

    Args:
        path: the file; None keeps no log.
        title: what is searched; a file with another title is refused.
    """

    def __init__(self, path: str | Path | None, title: str):
        self._path = None if path is None else Path(path)
        self._entries: list[dict[str, Any]] = []
        self.work = 0  # counted up by the functions, and from the log for what they need not do again
        if self._path is None:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        first = json.dumps({"title": title}).encode()
        content = self._path.read_bytes() if self._path.exists() else b""
        if first.startswith(content):  # nothing, or cut off as it began
            content = first + b"\n"
            self._path.write_bytes(content)
        *lines, cut_off = content.split(b"\n")
        try:
            header, *self._entries = [json.loads(line) for line in lines]
            if any(set(entry) != {"call", "work", "shape", "values"} for entry in self._entries):
                raise ValueError("a line has other entries")
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} is no log of evaluations ({error}); remove it, or choose another file") from error
        if header != {"title": title}:
            if self._entries or not isinstance(header, dict) or set(header) != {"title"}:
                raise ValueError(f"{path} is the log of another inference; remove it, or choose another file")
            self._path.write_text(json.dumps({"title": title}) + "\n")  # one that failed before it began
        else:
            os.truncate(self._path, len(content) - len(cut_off))

    @property
    def known(self) -> int:
        """How many of the next results are in the file already."""
        return len(self._entries)

    def __call__(self, function: Callable[[Floats], Floats], points: Floats, label: str) -> Floats:
        """``function(points)``, an array of floats; ``label`` tells apart calls with the same points."""
        digest = hashlib.sha256(label.encode() + np.ascontiguousarray(points, float).tobytes()).hexdigest()[:16]
        if self._entries:
            entry = self._entries.pop(0)
            if entry["call"] != digest:
                raise ValueError(f"{self._path} does not continue this inference; remove it to start anew")
            self.work += entry["work"]
            return np.array(entry["values"], float).reshape(entry["shape"])
        before = self.work
        values = np.asarray(function(points), float)
        if self._path is not None:
            entry = {"call": digest, "work": self.work - before, "shape": values.shape}
            self._append({**entry, "values": values.ravel().tolist()})
        return values

    def _append(self, entry: dict[str, Any]) -> None:
        if self._path is None:
            return
        with open(self._path, "a") as file:
            file.write(json.dumps(entry) + "\n")
            file.flush()
            os.fsync(file.fileno())


def cma_search(
    objective: Callable[[Floats, float], Floats],
    dimension: int,
    iterations: int,
    popsize: int,
    seed: int,
    progress: SearchProgress = lambda *_: None,
) -> Floats:
    """The best point (D,) of the unit cube that CMA-ES finds.

    Args:
        objective: takes points (N, D) and the share of the search that is done, gives costs (N,) to minimise.
        dimension: D.
        iterations: generations; it ends earlier when the generation has shrunk to a millionth of the cube.
        popsize: points per generation.
        seed: of CMA-ES.
        progress: called with iteration, iterations and the best cost of the generation.

    Raises:
        ValueError: no finalist has a finite cost.
    """
    import cma

    def finite(points: Floats, share: float) -> Floats:
        return np.nan_to_num(objective(points, share), nan=WORST, posinf=WORST)

    rng = np.random.default_rng(seed)
    options = {"popsize": popsize, "bounds": [0, 1], "verbose": -9, "seed": np.nan, "tolx": 1e-6, "tolfun": 0,
               "tolfunhist": 0, "tolstagnation": 10**9, "randn": lambda *shape: rng.standard_normal(shape)}  # fmt: skip
    if dimension == 1:  # cma (4.5) cannot limit the step in one dimension, which it wants to do beyond its default
        options["maxstd"] = [np.inf]
    # in the middle, as the published search; its step is 0.3 too, of variables from 0 to 4
    search = cma.CMAEvolutionStrategy(np.full(dimension, 0.5), 0.3, options)
    for iteration in range(iterations):
        points = search.ask()
        costs = finite(np.array(points), iteration / iterations)
        search.tell(points, costs.tolist())
        progress(iteration + 1, iterations, float(costs.min()))
        if search.sigma * search.sm.variances.max() ** 0.5 < 1e-6:
            break
    finalists = np.clip([search.result.xfavorite, points[int(np.argmin(costs))]], 0, 1)
    costs = finite(finalists, 1.0)
    if costs.min() >= WORST:
        raise ValueError("every replay diverged that the search has ended with; other parameters have to be tried")
    return finalists[int(np.argmin(costs))]
