"""Read an earlier diagnosis of a robot, so that a later one begins where it ended."""

from pathlib import Path

from soro_bench.diagnosis.result import SCHEMA, Result
from soro_bench.diagnosis.result_parts import NINETY
from soro_bench.diagnosis.robots.priors import Baseline
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.effect import effect_from, load_effects
from soro_bench.files import brief, read_json

OLD_SCHEMA = "soro-bench/diagnosis/1"  # report.json of the version before, still read


def baseline(folder: str | Path) -> Baseline:
    """What the files of a diagnosis say of a robot: result.json, or the older report.json.

    Raises:
        ValueError: there are other files, or parameters without values and intervals.
    """
    folder = Path(folder)
    if (folder / "result.json").exists() or not (folder / "report.json").exists():
        result = Result.load(folder / "result.json")
        estimates = [each.estimate for each in result.parameters]
        values = {each.name: each.value for each in estimates}
        spread = {each.name: _spread(each.low, each.high) for each in estimates}
        return Baseline(values, spread, tuple(effect_from(each, ALL) for each in result.patch.effects))
    return _of_report(folder)


def _of_report(folder: Path) -> Baseline:
    path = folder / "report.json"
    report = read_json(path)
    if not isinstance(report, dict) or report.get("schema") != OLD_SCHEMA:
        raise ValueError(f"{path} is no result of a diagnosis: its schema has to be {SCHEMA} or {OLD_SCHEMA}")
    try:
        found = report["parameters"].items()
        values = {name: _finite(each["value"]) for name, each in found}
        spread = {name: _spread(_finite(each["ci90"][0]), _finite(each["ci90"][1])) for name, each in found}
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        raise ValueError(f"{path} has no parameters with values and intervals ({error!r})") from error
    return Baseline(values, spread, load_effects(folder / "effects.json", ALL))


def _spread(low: float | None, high: float | None) -> float:
    """The standard deviation of a 90 % interval."""
    if low is None or high is None:
        raise ValueError("a parameter has no interval")
    return abs(high - low) / (2 * NINETY)


def _finite(value: object) -> float:
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not abs(value) < 1e300:
        raise ValueError(f"{brief(value)} is no number")
    return float(value)
