"""Sets of hidden cases: recordings for everybody, and sealed labels with a digest that is published first."""

import hashlib
import importlib.util
import os
import secrets
from collections.abc import Callable, Sequence
from pathlib import Path

from soro_bench.blind_benchmark.cases import DURATIONS, build
from soro_bench.blind_benchmark.others import SEED_BITS, AnyCase, OtherCase, build_other, draw_set
from soro_bench.blind_benchmark.score import opened_labels
from soro_bench.blind_benchmark.sorosim import releases
from soro_bench.files import read_json, replacing, write_json
from soro_bench.parallel import HERE, Workers, each
from soro_bench.recording.parquet import save

_DATE = 946684800  # s, the 1st of January 2000: when a file was made would tell how long its case took


def write_cases(
    folder: str | Path,
    count: int,
    seed: int,
    healthy: int | None = None,
    workers: Workers = HERE,
    progress: Callable[[int, int], None] = lambda done, count: None,
    durations: dict[str, float] = DURATIONS,
    others: int | None = None,
    sorosim: str | Path | None = None,
) -> None:
    """Write the recordings of ``count`` cases, the sealed labels and their digest.

    In ``folder``: case_000/train.parquet, heldout.parquet, task.parquet and so on; sealed/labels.json; commitment.txt,
    the SHA-256 of the labels. Rods of SoroSim have train.parquet only, and model.xml and map.toml. Called again, it
    goes on where it stopped; what has been committed to stays.

    Args:
        healthy, others: as of :func:`soro_bench.blind_benchmark.others.draw_set`.
        workers: what simulates them; those of a cluster see the same folder.
        progress: is told how many of the cases are done.
        durations: s, of the recordings by role; an excitation takes at least 18.2 s.
        sorosim: folder with SoroSim's releases.csv; without it there are no such rods.

    Raises:
        ValueError: the folder has other cases, or recordings that are not those of the labels; or a package is missing.
        FileNotFoundError: there is no releases.csv.
    """
    folder = Path(folder).resolve()  # workers of a cluster start elsewhere
    data = None if sorosim is None else Path(sorosim).resolve()
    cases = drawn_cases(count, seed, healthy, others, data)
    plan = {"count": count, "seed": seed, "nulls": healthy, "durations": durations, "others": others}
    _check_plan(folder, plan | {"sorosim": data is not None})
    for i, _ in enumerate(each(_write_case, [(folder, case, durations, data) for case in cases], workers)):
        progress(i + 1, count)
    if (folder / "commitment.txt").exists():
        _check_recordings(folder)
        return
    labels = {
        "count": count,
        "seed": seed,
        "cases": [read_json(_label_path(folder, case)) for case in cases],
    }
    path = folder / "sealed" / "labels.json"
    write_json(path, labels)
    with replacing(folder / "commitment.txt") as temporary:
        temporary.write_text(hashlib.sha256(path.read_bytes()).hexdigest() + "\n")


def sealed_seed(folder: str | Path) -> int:
    """The seed of the cases in a folder; if there are none a new one.

    Commands are drawn from it, as all that is sealed is: whoever can count up to a seed finds it by the commands of a
    recording, and with it the labels.
    """
    path = Path(folder) / "sealed" / "plan.json"
    return read_json(path)["seed"] if path.exists() else secrets.randbits(SEED_BITS)


def drawn_cases(
    count: int, seed: int, healthy: int | None, others: int | None, data: str | Path | None
) -> list[AnyCase]:
    """The cases that :func:`write_cases` writes, which nothing has simulated yet; ``data`` is SoroSim's folder.

    Raises:
        ValueError, FileNotFoundError: some of them cannot be had here.
    """
    cases = draw_set(count, seed, healthy, others, data is not None)
    _check_simulators(cases, None if data is None else Path(data))
    return cases


def _check_simulators(cases: Sequence[AnyCase], data: Path | None) -> None:
    """Refuse cases that nothing here can simulate, before hours of work."""
    needed = any(isinstance(case, OtherCase) and case.needs_pyelastica for case in cases)
    if needed and importlib.util.find_spec("elastica") is None:
        raise ValueError('cases of other simulators need PyElastica: pip install ".[simulators]"; '
                         "--others 0 does without them")  # fmt: skip
    if data is not None:
        releases(data)


def _check_plan(folder: Path, plan: dict) -> None:
    """Refuse to mix two sets of cases in one folder."""
    path = folder / "sealed" / "plan.json"
    if not path.exists():
        write_json(path, plan)
    elif (other := read_json(path)) != plan:
        raise ValueError(f"{folder} has the cases of {other}, not of {plan}")


def _check_recordings(folder: Path) -> None:
    """Refuse recordings other than those that the labels belong to."""
    for label in opened_labels(folder):
        for name, committed in label["sha256"].items():
            path = folder / label["id"] / name
            if (found := hashlib.sha256(path.read_bytes()).hexdigest()) != committed:
                raise ValueError(f"{path} has the hash {found}, its label says {committed}")


def _label_path(folder: Path, case: AnyCase) -> Path:
    return folder / "sealed" / "cases" / f"{case.id}.json"


def _write_case(folder: Path, case: AnyCase, durations: dict[str, float], sorosim: Path | None) -> None:
    """Unless it is there. The label, which has the hashes of the files, is written last."""
    label_path, place = _label_path(folder, case), folder / case.id
    if label_path.is_file() and all((place / name).is_file() for name in read_json(label_path)["sha256"]):
        return
    place.mkdir(parents=True, exist_ok=True)
    files: dict[str, str] = {}
    if isinstance(case, OtherCase):
        recordings, files, label = build_other(case, durations, sorosim)
    else:
        recordings, label = build(case, durations)
    for role, recording in recordings.items():
        save(recording, place / f"{role}.parquet")
    for name, text in files.items():
        (place / name).write_text(text, encoding="utf-8")
    hashes = {}
    for name in (*(f"{role}.parquet" for role in recordings), *files):
        hashes[name] = hashlib.sha256((place / name).read_bytes()).hexdigest()
        os.utime(place / name, (_DATE, _DATE))
    os.utime(place, (_DATE, _DATE))
    write_json(label_path, label | {"sha256": hashes})
