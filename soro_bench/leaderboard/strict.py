"""JSON from strangers, which says one thing only; ValueError names what is wrong."""

import json
import reprlib
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from soro_bench.files import parsed_json
from soro_bench.packed import read

if TYPE_CHECKING:
    from jsonschema import ValidationError
    from jsonschema.protocols import Validator

ENTRY_BYTES = 1_000_000
REPORT_BYTES = 10_000_000
MAX_DEPTH = 50  # of lists and objects in one another; Python's recursion ends at some hundreds


def read_strict(path: str | Path, max_bytes: int = ENTRY_BYTES) -> dict:
    """A JSON object without NaN, infinity, a name that comes twice or characters that cannot be shown.

    The file may be in the archive of its folder (:mod:`soro_bench.packed`).
    """
    data = read(path, max_bytes)
    try:
        found = parsed_json(data.decode(), max_digits=18)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no valid JSON: {str(error)[:200]}") from error
    try:
        _check_parts(found)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if not isinstance(found, dict):
        raise ValueError(f"{path} holds {reprlib.repr(found)}; a JSON object is needed")
    return found


def check(data: dict, schema: str, path: str | Path) -> None:
    """ValueError if ``data``, from the file ``path``, does not follow the schema in the file of that name here."""
    best = require_jsonschema().exceptions.best_match(_validator(schema).iter_errors(data))
    if best is not None:
        raise ValueError(f"{path}: {_said(best)}")


def _said(error: "ValidationError") -> str:
    """What is wrong in one line: the field, its value, what is allowed."""
    field = ".".join(map(str, error.absolute_path))[:100] or "the entry"
    if error.validator in ("required", "additionalProperties"):  # about the names in it, not about its value
        return f"in {field}: {error.message[:200]}"
    return f"{field} is {reprlib.repr(error.instance)}; allowed: {error.validator} {error.validator_value}"


def _check_parts(found: object) -> None:
    """ValueError for a text, anywhere, that cannot be shown, and for parts in parts in parts."""
    level, depth = [found], 0
    while level:
        if depth > MAX_DEPTH:
            raise ValueError(f"lists and objects in one another, more than {MAX_DEPTH} deep")
        for text in level:
            if isinstance(text, str) and not text.isprintable():
                raise ValueError(f"{reprlib.repr(text)} has characters that cannot be shown")
        level = [part for each in level for part in _parts(each)]
        depth += 1


def _parts(value: object) -> list:
    return [*value, *value.values()] if isinstance(value, dict) else value if isinstance(value, list) else []


@cache
def _validator(schema: str) -> "Validator":
    return require_jsonschema().Draft202012Validator(json.loads((Path(__file__).parent / schema).read_text()))


def require_jsonschema() -> ModuleType:
    """The module; ImportError with what to install."""
    try:
        import jsonschema
    except ImportError as error:
        raise ImportError("leaderboard entries need jsonschema: pip install soro_bench[board]") from error
    return jsonschema
