"""Train policies by one method, evaluate them on the fixed starts and write everything down."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from soro_bench.evaluation import evaluate
from soro_bench.files import read_json, write_json
from soro_bench.randomization import Distribution, random_box
from soro_bench.recording.rerun_log import require_rerun, write_recording
from soro_bench.registration import task_type
from soro_bench.results import summarise, versions
from soro_bench.training.policy import Policy
from soro_bench.training.ppo import PPOConfig, train


@dataclass(frozen=True)
class Method:
    """How the distribution of training parameters comes about.

    Args:
        name: short name for folders and tables.
        distribution: gives it for an environment id, a seed and a folder to keep files in; None means the nominal
            parameters.
    """

    name: str
    distribution: Callable[[str, int, Path], Distribution | None]


def _udr_box(env_id: str, seed: int, folder: Path) -> Distribution:
    return random_box(task_type(env_id).randomized, np.random.default_rng(seed))


ORACLE = Method("oracle", lambda env_id, seed, folder: None)  # trained on the evaluation dynamics
UDR = Method("udr", _udr_box)  # a random box of the search space per seed, as published
METHODS = {method.name: method for method in (ORACLE, UDR)}


def run_method(
    method: Method,
    config: PPOConfig,
    seeds: Sequence[int],
    eval_models: Sequence[str],
    folder: str | Path,
    progress: Callable[[str, int, int, dict], None] = lambda label, steps, total, row: None,
) -> list[dict]:
    """Train one policy per seed, evaluate each on every model, and write results, recordings and curves.

    Goes on where it was interrupted. ``folder`` gets ``<method>/seed<k>/`` with the policy, its curve,
    ``evaluation_<model>.json`` and ``evaluation_<model>.rrd``.

    Returns:
        One result per seed and model, as written to the JSON files.
    """
    results = []
    for seed in seeds:
        run_folder = Path(folder) / method.name / f"seed{seed}"
        distribution = method.distribution(config.env_id, seed, run_folder)
        run_config = replace(config, method=method.name, seed=seed)

        def report(steps, total, row, label=f"{method.name} seed {seed}"):
            progress(label, steps, total, row)

        policy = train(run_config, run_folder, distribution, report)
        for model in eval_models:
            path = run_folder / f"evaluation_{model}.json"
            results.append(read_json(path) if path.exists() else write_evaluation(policy, model, run_folder))
    return results


def write_evaluation(policy: Policy, model: str, folder: str | Path, label: str | None = None, **options) -> dict:
    """Evaluate ``policy`` on ``model``; write evaluation_<label>.json and .rrd into ``folder``; return the result.

    ``label`` is the model by default; ``options`` are further arguments of :func:`soro_bench.evaluation.evaluate`.
    """
    require_rerun()  # before the work, not after it
    folder, label = Path(folder), label or model
    start = time.monotonic()
    card = policy.card
    episodes = evaluate(policy.act, card.env_id, model, card.action, **options)
    result = {
        "policy": asdict(card),
        "evaluated_on": label,
        **summarise(episodes),
        "evaluation_seconds": round(time.monotonic() - start, 1),
        "versions": versions(),
    }
    write_recording(folder / f"evaluation_{label}.rrd", episodes, f"{card.env_id} {card.method} on {label}")
    # last, as its presence says that the evaluation is complete
    write_json(folder / f"evaluation_{label}.json", result)
    return result
