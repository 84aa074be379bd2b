"""The blinded challenge: cases with hidden physics are written and committed to, diagnosed, and only then scored."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from pathlib import Path

from soro_bench.blind_benchmark.ablations import ABLATIONS, ENV_ID, ablated
from soro_bench.blind_benchmark.others import MAP, MODEL
from soro_bench.blind_benchmark.report import report_of, unseen
from soro_bench.blind_benchmark.score import opened_labels, scored
from soro_bench.blind_benchmark.scorecard import ablation_rows, as_tables, markdown
from soro_bench.blind_benchmark.sealed import drawn_cases, sealed_seed, write_cases
from soro_bench.diagnosis.assembly.build import build_result
from soro_bench.diagnosis.pipeline import run_diagnosis
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.files import read_json, replacing, write_json
from soro_bench.parallel import HERE, Workers, each, processors
from soro_bench.recording.parquet import load
from soro_bench.sources import claim, method_version

METHOD = "method.txt"

CaseProgress = Callable[[str, int, int], None]  # the stage, cases done, cases in all


def run_blind_benchmark(
    folder: str | Path, count: int, seed: int | None = None, healthy: int | None = None, ablations: int = 0,
    workers: Workers = HERE, progress: CaseProgress = lambda *_: None, others: int | None = None,
    sorosim: str | Path | None = None,
) -> str:  # fmt: skip
    """Write what is missing of cases, reports and scorecard in a folder; returns the scorecard, Markdown.

    The diagnosis sees recordings only; the labels are opened when every case has its report. Reports are of one version
    of the method.

    Args:
        seed: of the cases; that of those in the folder by default, or a new one that nobody can guess.
        ablations: how many of the cases, the first ones of the suite's robots, are also diagnosed without each part
            of the method.
        workers: what computes the cases; those of a cluster see the same folder.
        others: how many cases are of other simulators; half by default.
        sorosim: folder with SoroSim's releases.csv, for its rods among them.
    """
    if not 0 <= ablations <= count:
        raise ValueError(f"ablations {ablations}: 0 to {count}, as many as there are cases, can be asked for")
    folder = Path(folder).resolve()  # workers of a cluster start elsewhere
    cases, reports = folder / "cases", folder / "reports"
    seed = sealed_seed(cases) if seed is None else seed
    drawn_cases(count, seed, healthy, others, sorosim)  # before anything is written
    claim(reports / METHOD, method_version())
    told = partial(progress, "cases written")
    write_cases(cases, count, seed, healthy, workers, told, others=others, sorosim=sorosim)
    names = sorted(path.name for path in cases.glob("case_*"))
    wanted = [(cases / name, reports / f"{name}.json") for name in names]
    _carry_out(diagnosed, wanted, workers, partial(progress, "cases diagnosed"))
    text = _scorecard(folder)
    suite = [name for name in names if not (cases / name / MODEL).exists()]
    without = [
        (ablation, cases / name, folder / ablation / f"{name}.json")
        for ablation, name in product(ABLATIONS if ablations else (), suite[:ablations])
    ]
    _carry_out(ablated, without, workers, partial(progress, "ablations"))
    return _scorecard(folder) if ablations else text


def _carry_out(
    function: Callable, wanted: Sequence[tuple], workers: Workers, progress: Callable[[int, int], None]
) -> None:
    """Call the function for those whose file, the last of the arguments, is not there."""
    todo = [arguments for arguments in wanted if not arguments[-1].exists()]
    for i, _ in enumerate(each(function, todo, workers)):
        progress(len(wanted) - len(todo) + i + 1, len(wanted))


def _scorecard(folder: Path) -> str:
    """Open the labels and write the scorecard, with those ablations that are there; returns it."""
    labels, found = opened_labels(folder / "cases"), _read_all(folder / "reports")
    found_without = {name: reports for name in ABLATIONS if (reports := _read_all(folder / name))}
    card = scored(labels, found)
    card["ablations"] = ablation_rows(labels, found, found_without)
    write_json(folder / "scorecard.json", card)
    text = f"{markdown(card)}\n\n{as_tables(card['ablations'])}"
    with replacing(folder / "scorecard.md") as temporary:
        temporary.write_text(text + "\n")
    return text


def _read_all(folder: Path) -> dict[str, dict]:
    return {path.stem: read_json(path) for path in sorted(folder.glob("case_*.json"))}


def diagnosed(case: Path, path: Path) -> None:
    """Write the report of a case, and how it does on motion that it has not seen, if there is any."""
    if (case / MODEL).exists():
        result = build_result(run_diagnosis(ModelRobot(case / MODEL, case / MAP, threads=processors()),
                                            [load(case / "train.parquet")]))  # fmt: skip
        write_json(path, report_of(result) | {"unseen": None})
        return
    robot = SuiteRobot(ENV_ID, threads=processors())
    found = run_diagnosis(robot, [load(case / "train.parquet")], [load(case / "heldout.parquet")])
    write_json(path, report_of(build_result(found)) | {"unseen": unseen(found, load(case / "task.parquet"))})
