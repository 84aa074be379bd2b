"""What ``soro-bench run`` runs."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from soro_bench.campaign.inputs import inferred
from soro_bench.campaign.run import Run
from soro_bench.envs.multigait import PUBLISHED_RANDOMIZATION
from soro_bench.files import asset_path
from soro_bench.leaderboard.boards import BOARDS
from soro_bench.parameters import ALL_PARAMETERS, WALL_OFFSET
from soro_bench.randomization import TruncatedNormal, search_box
from soro_bench.registration import task_type
from soro_bench.training.configuration import default_config
from soro_bench.training.methods import MEMORY, ORACLE, Method, fixed, udr, universal

SEEDS, BOXES = range(3), range(10)  # published: three repetitions, and ten random boxes for UDR
# of what the first and the second claim compare: three seeds cannot tell methods apart
MORE_SEEDS = range(10)
# The published misspecification: Young's modulus at 0.8 of the truth
UNMODELLED = {"young_modulus": 0.8 * ALL_PARAMETERS["young_modulus"].nominal}


def runs_of(
    board: str, method: Method, seeds: Sequence[int], steps: int | None = None, model: str | None = None
) -> list[Run]:
    """A run for every seed; steps and model are by default what the board's environment is learned with."""
    if board not in BOARDS:
        raise ValueError(f"there is no board {board!r}; there are {', '.join(BOARDS)}")
    env_id = BOARDS[board].env_id
    if not seeds:
        raise ValueError("no seeds; say one or more, such as --seeds 0 1 2")
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds {', '.join(map(str, seeds))}: one of them comes twice")
    config = default_config(env_id, steps, **({} if model is None else {"model": model}))
    return [Run(board, method, replace(config, seed=seed)) for seed in seeds]


def paper() -> list[Run]:
    """The published study: its four tables, and the question of its second claim asked of the trunk as well."""
    return [*_identified("TrunkReach-v0"), *_identified("TrunkPush-v0"), *_unmodelled(), *_lift(), *_walker(),
            *_accurately()]  # fmt: skip


def quick() -> list[Run]:
    """Oracle and UDR briefly on TrunkReach."""
    return [run for method in (ORACLE, udr()) for run in runs_of("TrunkReach-v0", method, [0], 200_000)]


PRESETS = {"quick": quick, "paper": paper}


def recording_path(env_id: str) -> Path:
    """The recording that methods infer parameters from, of the accurate model with nominal ones; ValueError for an
    environment that has none."""
    try:
        return asset_path(f"recordings/{env_id}.parquet")
    except FileNotFoundError as error:
        raise ValueError(f"no recording of {env_id} comes with the suite; say which one: --recording") from error


def _identified(board: str) -> list[Run]:
    recording, task = recording_path(board), task_type(BOARDS[board].env_id)
    rf_dropo, bayes_sim = (inferred(method, recording) for method in ("rf-dropo", "bayes-sim"))
    # the cheap model explains the recording as well as it can: parameters that make up for what it simplifies
    cheaply = replace(inferred("rf-dropo", recording, model=task.cheap), name=f"{rf_dropo.name}_{task.cheap}")
    # what wide randomisation does by itself, about no inferred value
    box = fixed("dr_box", search_box(task.randomized))
    methods = (ORACLE, rf_dropo, cheaply, box, MEMORY, bayes_sim, variance_for_deviation(bayes_sim))
    # methods of others, which the study names and did not run; and what a memory does by itself
    alone = replace(ORACLE, name=f"{ORACLE.name}_{MEMORY.name}", frames=MEMORY.frames)
    others = (inferred("droid", recording), universal(rf_dropo), universal(cheaply), alone)
    seeds = dict.fromkeys(methods, MORE_SEEDS) | dict.fromkeys(others, SEEDS) | {udr(): BOXES}
    return [run for method, some in seeds.items() for run in runs_of(board, method, some)]


def _accurately() -> list[Run]:
    """What training on the cheap model is to be compared with: nothing is transferred, and every step costs more."""
    task = task_type("TrunkReach-v0")
    method = replace(ORACLE, name=f"{ORACLE.name}_{task.accurate}")
    return runs_of("TrunkReach-v0", method, MORE_SEEDS, model=task.accurate)


def _unmodelled() -> list[Run]:
    board = "TrunkPush-v0"
    recording = recording_path(board)
    runs = runs_of(board, udr(UNMODELLED, "udr_unmodelled"), BOXES)
    for method in ("rf-dropo", "bayes-sim"):
        known = inferred(method, recording, UNMODELLED)
        runs += runs_of(board, replace(known, name=f"{known.name}_unmodelled"), MORE_SEEDS)
    return runs


def _lift() -> list[Run]:
    runs, wall = [], fixed("dr", search_box([WALL_OFFSET]))
    for board in ("TrunkLift-v0-50g", "TrunkLift-v0-100g"):
        runs += [*runs_of(board, replace(ORACLE, name="no_dr"), SEEDS), *runs_of(board, wall, SEEDS)]
    return runs


def _walker() -> list[Run]:
    runs = []
    for board in ("MultiGait-v0-6", "MultiGait-v0-12"):
        for method in (replace(ORACLE, name="no_dr"), fixed("dr", PUBLISHED_RANDOMIZATION)):
            runs += runs_of(board, method, MORE_SEEDS)
    return runs


def variance_for_deviation(method: Method) -> Method:
    """A method whose variances are taken for standard deviations, as the published code does with BayesSim's.

    In its units (kg, kPa), which makes a Young's modulus known to 0.5 MPa one that is not known at all. Where the
    published code then falls back on the middle of the bounds, samples here are drawn within them.
    """

    def distribution(env_id: str, seed: int, folder: Path) -> TruncatedNormal:
        # the method's own run has the same, if it is further
        sibling = Path(folder).parents[1] / method.name / f"seed{seed}"
        found = method.distribution(env_id, seed, sibling if (sibling / "posterior.json").exists() else folder)
        if not isinstance(found, TruncatedNormal):
            raise TypeError(f"{method.name} gives no standard deviations")
        unit = np.array([_PUBLISHED_UNITS.get(name, 1.0) for name in found.names])
        return replace(found, std=unit * (found.std / unit) ** 2)

    return Method(f"{method.name}_variance", distribution)


_PUBLISHED_UNITS = {"young_modulus": 1e3}  # Pa


def chosen(runs: Sequence[Run], only: Sequence[str]) -> list[Run]:
    """The runs whose names (board/method/seed<k>) hold one of the texts; all without any."""
    found = [run for run in runs if not only or any(text in run.name for text in only)]
    if not found:
        raise ValueError(f"no run's name holds {' or '.join(only)}; there are, for example, "
                         f"{', '.join(sorted({run.name.rpartition('/')[0] for run in runs}))}")  # fmt: skip
    return found
