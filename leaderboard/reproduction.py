"""The published study's tables beside ours.

    python leaderboard/reproduction.py

Reads the entries in leaderboard/results and writes tables of docs/explanation/reproduction.md and, a row per policy, of
docs/archive/training_and_speed.md, in the paper's units.
"""

import argparse
import re
from functools import partial
from pathlib import Path

import numpy as np

from soro_bench.campaign.plan import paper
from soro_bench.campaign.run import ENTRY
from soro_bench.files import replacing
from soro_bench.leaderboard.boards import BOARDS
from soro_bench.leaderboard.gather import OLD, Group, gather_control
from soro_bench.leaderboard.statistics import (
    chance_of_difference,
    interval,
    markdown_table,
    mean_and_interval,
    probability_of_improvement,
)
from soro_bench.markdown import table
from soro_bench.packed import is_there
from soro_bench.parameters import ALL_PARAMETERS
from soro_bench.registration import task_type

RESULTS = Path(__file__).parent / "results"
DOCS = Path(__file__).parents[1] / "docs"
PAGES = (DOCS / "explanation" / "reproduction.md", DOCS / "archive" / "training_and_speed.md")
Groups = dict[tuple[str, str], Group]  # by board and method
TABLE = re.compile(r"(<!-- (\w+): leaderboard/reproduction.py -->\n\n).*?(\n\n<!-- end -->)", re.DOTALL)
UNITS = {"young_modulus": 1e3}  # kPa are kg/(mm s²); masses are in kg
COLUMNS = ("cube_mass", "friction", "trunk_mass", "poisson_ratio", "young_modulus")
# Tiboni et al., IROS 2023, Tables I to III: means and, of RF-DROPO, standard deviations of the dynamics parameters, of
# the repetition that is printed there
PUBLISHED = {
    ("TrunkReach-v0", "rf_dropo"): {
        "trunk_mass": (0.64196, 1.04e-5), "poisson_ratio": (0.450002, 1.02e-5), "young_modulus": (6878.01, 0.02773),
    },
    ("TrunkReach-v0", "bayes_sim"): {"trunk_mass": (0.32,), "poisson_ratio": (0.49,), "young_modulus": (1914.25,)},
    ("TrunkPush-v0", "rf_dropo"): {
        "cube_mass": (0.061397, 0.00440), "friction": (0.301427, 0.00151), "trunk_mass": (0.517406, 0.003242),
        "poisson_ratio": (0.450255, 0.000448), "young_modulus": (5557.07, 2.447),
    },
    ("TrunkPush-v0", "bayes_sim"): {
        "cube_mass": (0.3715,), "friction": (0.3746,), "trunk_mass": (0.6867,), "poisson_ratio": (0.4248,),
        "young_modulus": (1855.10,),
    },
    ("TrunkPush-v0", "rf_dropo_unmodelled"): {
        "cube_mass": (0.07,), "friction": (0.30,), "trunk_mass": (0.50,), "poisson_ratio": (0.45,),
        "young_modulus": (3600.0,),
    },
    ("TrunkPush-v0", "bayes_sim_unmodelled"): {
        "cube_mass": (0.52,), "friction": (0.51,), "trunk_mass": (0.48,), "poisson_ratio": (0.44,),
        "young_modulus": (3600.0,),
    },
}  # fmt: skip
# Rows of the tables of the first two claims: a method and what it is called there
ROBUST = {
    "oracle": "true parameters (`oracle`)",
    "rf_dropo": "inferred by RF-DROPO",
    "bayes_sim": "inferred by BayesSim",
    "bayes_sim_variance": "BayesSim, variances taken for deviations, as published",
    "dr_box": "whole box (`dr_box`)",
    "udr": "random-box UDR",
    "rf_dropo_unmodelled": "RF-DROPO, Young's modulus held at 0.8 of the truth",
    "bayes_sim_unmodelled": "BayesSim, the same",
    "udr_unmodelled": "random-box UDR, the same",
}
TRUNK = ("TrunkReach-v0", "TrunkPush-v0")
AFFORDABLE_BOARDS = {
    "TrunkReach-v0": "TrunkReach",
    "TrunkPush-v0": "TrunkPush",
    "MultiGait-v0-6": "MultiGait, 6 steps",
    "MultiGait-v0-12": "MultiGait, 12 steps",
}
AFFORDABLE = {
    "oracle": "true parameters",
    "rf_dropo": "RF-DROPO",
    "dr_box": "whole box",
    "rf_dropo_cable": "RF-DROPO that replays with the simple model",
    "bayes_sim": "BayesSim",
    "bayes_sim_variance": "BayesSim, variances for deviations",
    "bayes_sim_unmodelled": "BayesSim, modulus held wrong",
    "udr": "random-box UDR",
    "droid": "DROID: one value, fitted",
    "memory": "whole box, and five observations remembered",
    "oracle_memory": "true parameters, and five observations remembered",
    "universal_rf_dropo": "whole box, and told RF-DROPO's means",
    "universal_rf_dropo_cable": "whole box, and told those of the simple model",
    "oracle_flex": "true parameters, trained on the accurate model",
    "dr": "randomised",
    "no_dr": "nominal",
}
# Pairs of methods that the first two claims compare, on the simple and the accurate model
ROBUSTER = (("rf_dropo", "oracle"), ("rf_dropo", "bayes_sim"), ("rf_dropo", "dr_box"), ("rf_dropo", "udr"))
WALKER = (("dr", "no_dr"),)
_TRANSFERRED = ("rf_dropo", "rf_dropo_cable", "bayes_sim", "bayes_sim_variance", "dr_box", "udr", "oracle_memory")
_OF_OTHERS = ("memory", "universal_rf_dropo", "universal_rf_dropo_cable")
TRANSFERS = (*((each, "oracle") for each in _TRANSFERRED), *((each, "dr_box") for each in _OF_OTHERS))
# Table IV: elevation [mm], mean and standard deviation of three seeds
LIFT = {
    ("TrunkLift-v0-100g", "no_dr"): (2.34, 4.03),
    ("TrunkLift-v0-100g", "dr"): (7.96, 1.67),
    ("TrunkLift-v0-50g", "no_dr"): (8.55, 1.27),
    ("TrunkLift-v0-50g", "dr"): (12.07, 4.72),
}


def parameters_table(groups: Groups) -> str:
    """Markdown: what was inferred, mean and standard deviation, a row for each of our seeds."""
    nominal = [f"{ALL_PARAMETERS[name].nominal / UNITS.get(name, 1.0):g}" for name in COLUMNS]
    lines = [("", "truth", "", *nominal)]
    for (board, method), published in PUBLISHED.items():
        cells = [_value(*published[name]) if name in published else "" for name in COLUMNS]
        lines.append((board, method, "paper", *cells))
        for _, entry in groups[board, method].entries if (board, method) in groups else ():
            rows = entry["distribution"]["parameters"]
            cells = [_value(*(rows[name][k] / UNITS.get(name, 1.0) for k in ("mean", "std"))) if name in rows else ""
                     for name in COLUMNS]  # fmt: skip
            lines.append((board, method, f"seed {entry['seed']}", *cells))
    heads = ("board", "method", "", "cube mass [kg]", "friction", "trunk mass [kg]", "nu", "E [kPa]")
    return table(heads, lines)


def _value(mean: float, std: float | None = None) -> str:
    return f"{mean:.5g}" if std is None else f"{mean:.5g} ± {std:.2g}"


def robust_table(groups: Groups) -> str:
    """Markdown: final distance on the simple model, by how the training parameters were chosen."""
    heads = ["trained on", *(head for board in TRUNK for head in (f"{board.partition('-')[0]} [mm]", "seeds"))]
    rows = []
    for method, called in ROBUST.items():
        cells = [_mean(groups.get((board, method)), "cable") for board in TRUNK]
        rows.append((called, *(each for pair in cells for each in pair)))
    return table(heads, rows)


def affordable_table(groups: Groups) -> str:
    """Markdown: the metric on the simple model and on the accurate one."""
    rows = []
    for board, name in AFFORDABLE_BOARDS.items():
        simple, accurate = task_type(BOARDS[board].env_id).cheap, task_type(BOARDS[board].env_id).accurate
        for method, called in AFFORDABLE.items():
            if group := groups.get((board, method)):
                (left, seeds), (right, _) = _mean(group, simple), _mean(group, accurate)
                rows.append((name, called, left, right, seeds))
                name = ""
    return table(("task", "trained on", "simple model [mm]", "accurate model [mm]", "seeds"), rows)


def compared_table(groups: Groups) -> str:
    """Markdown: how probable it is that a policy of the first method is better than one of the second one."""
    rows = []
    for board in AFFORDABLE_BOARDS:
        task = task_type(BOARDS[board].env_id)
        pairs = ((task.cheap, ROBUSTER), (task.accurate, TRANSFERS)) if board in TRUNK else ((task.accurate, WALKER),)
        for label, methods in pairs:
            for first, second in methods:
                if not {(board, first), (board, second)} <= groups.keys():
                    continue
                values = [groups[board, method].scores(label) for method in (first, second)]
                better = partial(probability_of_improvement, higher=BOARDS[board].higher)
                low, high = interval(better, tuple(values), np.random.default_rng(0)) or (0.0, 1.0)
                chance = f"{better(*values):.2f} [{low:.2f}, {high:.2f}]"
                seeds = " and ".join(str(len(each)) for each in values)
                rows.append((board, label, first, second, chance, f"{chance_of_difference(*values):.2g}", seeds))
    head = ("board", "evaluated on", "first", "second", "first is better, probability", "p by chance", "seeds")
    return table(head, rows)


def _mean(group: Group | None, label: str) -> tuple[str, str]:
    """The mean of a group's policies under a condition with its interval, and how many there are."""
    if group is None:
        return "", ""
    values = group.scores(label)
    return mean_and_interval(values), str(len(values))


def lift_table(groups: Groups) -> str:
    """Markdown: elevation, the published one beside ours, and how high our objects' lowest corners are."""
    head = ["object", "wall in training", "paper [mm]"]
    head += [f"{what} on `{model}` [mm]" for model in ("cable", "flex") for what in ("ours", "lowest corner")]
    rows = []
    for (board, method), (mean, deviation) in LIFT.items():
        cells = [f"{1e3 * BOARDS[board].fixed['cube_mass']:.0f} g", {"dr": "random", "no_dr": "fixed"}[method]]
        cells.append(f"{mean:.2f} ± {deviation:.2f}")
        old = (board, method) not in groups  # then what was trained before trainers had numbers, if anything was
        group = groups.get((board, method + OLD * old))
        for label in ("cable", "flex"):
            for name in ("final_mm", "clearance_mm"):
                scores = group.scores(label, name).mean(axis=1) if group and group.has(label, name) else np.zeros(0)
                cells.append(f"{scores.mean():.2f} ± {scores.std(ddof=1):.2f}{OLD * old}" if len(scores) > 1 else "")
        rows.append(cells)
    return table(head, rows)


def tables() -> dict[str, str]:
    """The tables of the pages by their names, Markdown."""
    found = gather_control(RESULTS)
    # ours alone: others may enter methods of the same names
    groups = {(board, g.name): g for board, members in found.items() for g in members if g.entry == ENTRY}
    planned = paper()
    done = sum(run.done(RESULTS) for run in planned)
    older = sum(is_there(run.result(RESULTS)) for run in planned) - done
    state = f"{len(planned)} runs are planned, {done} are done; {older} more have results of an older trainer."
    return {
        "state": f"**State: {state}**",
        "parameters": parameters_table(groups),
        "policies": markdown_table(groups.values()),
        "robust": robust_table(groups),
        "affordable": affordable_table(groups),
        "compared": compared_table(groups),
        "lift": lift_table(groups),
    }


def filled(page: str) -> str:
    """The page with its tables as the entries have them now."""
    found = tables()
    return TABLE.sub(lambda match: match[1] + found[match[2]] + match[3], page)


def main() -> None:
    """Write the tables into the pages."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for page in PAGES:
        with replacing(page) as temporary:
            temporary.write_text(filled(page.read_text()))


if __name__ == "__main__":
    main()
