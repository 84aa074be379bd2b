"""A result as JSON and back."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest

from soro_bench.diagnosis.result import SCHEMA, Result
from tests.results import RESULTS


def _same(a: Any, b: Any) -> bool:
    """Equal to seven digits, NaN equal to NaN, of the same types."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(_same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, tuple):
        return type(b) is tuple and len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, float):
        return type(b) is float and (math.isclose(a, b, rel_tol=1e-6) or (math.isnan(a) and math.isnan(b)))
    return a == b


@pytest.mark.parametrize("name", RESULTS)
def test_round_trip(name: str, tmp_path: Path) -> None:
    """What is read is what was written, NaN of missing samples included, and is written the same again."""
    result = RESULTS[name]()
    result.save(tmp_path / "result.json")
    read = Result.load(tmp_path / "result.json")
    assert math.isnan(read.replay.measured[3][0])
    assert _same(result, read)
    assert read.to_json() == result.to_json()


def test_file_is_plain_json_with_its_schema(tmp_path: Path) -> None:
    RESULTS["adequate"]().save(tmp_path / "result.json")
    data = json.loads((tmp_path / "result.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert data["schema"] == SCHEMA and data["replay"]["measured"][3] == [None]


def _changed(path: str, value: object) -> dict[str, Any]:
    data: dict[str, Any] = json.loads(json.dumps(RESULTS["trunk friction"]().to_json()))
    *parents, last = path.split(".")
    inner: Any = data
    for each in parents:
        inner = inner[int(each)] if isinstance(inner, list) else inner[each]
    inner[last] = value
    return data


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("schema", "soro-bench/diagnosis/1", SCHEMA),
        ("verdict", 3, "result.verdict"),
        ("train.noise", "small", "result.train.noise"),
        ("findings", {}, "result.findings"),
        ("findings.0.location", "L2", "result.findings[0].location"),
        ("findings.0.estimates.0.value", True, "result.findings[0].estimates[0].value"),
        ("replay.shape", [6], "result.replay.shape"),
        ("hypotheses.0.surprise", 1, "result.hypotheses[0]"),
    ],
)
def test_bad_json_is_named_in_one_line(path: str, value: object, named: str, tmp_path: Path) -> None:
    file = tmp_path / "result.json"
    file.write_text(json.dumps(_changed(path, value)))
    with pytest.raises(ValueError) as error:
        Result.load(file)
    assert named in str(error.value) and str(file) in str(error.value) and "\n" not in str(error.value)


def test_missing_entry_is_named() -> None:
    data = RESULTS["adequate"]().to_json()
    del data["train"]["noise"]
    with pytest.raises(ValueError, match=r"result\.train lacks .*noise"):
        Result.from_json(data)


def test_what_is_no_object_is_no_result() -> None:
    with pytest.raises(ValueError, match=SCHEMA):
        Result.from_json([])


@pytest.mark.parametrize(
    ("part", "change", "said"),
    [
        ("verdict", "great", "verdict is 'great'"),
        ("hypotheses", [], "needs a hypothesis"),
        ("replay.time", [], "time of a replay has 0 stamps"),
        ("replay.shape", [10**9, 10**9], "rows of 1000000000000000000 numbers"),
        ("replay.measured", [[0.0]], "measured of a replay needs"),
        ("shapes", [{"points": [], "radius": 1.0, "locations": []}], "a shape needs points"),
        ("shapes", [{"points": [[0, 0, 0]], "radius": 1e300, "locations": []}], "a shape needs points"),
    ],
)
def test_a_result_that_cannot_be_drawn_is_refused(part: str, change: Any, said: str) -> None:
    """Before anything is written, and before memory is asked for."""
    data = RESULTS["adequate"]().to_json()
    *outer, name = part.split(".")
    (data[outer[0]] if outer else data)[name] = change
    with pytest.raises(ValueError, match=said):
        Result.from_json(data)
