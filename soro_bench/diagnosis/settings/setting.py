"""A setting: a field of a dataclass with its value, its unit and its reason."""

from collections.abc import Iterator
from dataclasses import field, fields
from typing import Any


def setting(default: Any, unit: str, reason: str) -> Any:
    """A field of a settings class.

    Args:
        default: its value.
        unit: of the value; "1" for a ratio, or the thing that is counted.
        reason: why it has this value, in one sentence.
    """
    return field(default=default, metadata={"unit": unit, "reason": reason})


def listed(stage: str, group: Any) -> Iterator[tuple[str, str, Any, str, str]]:
    """Stage, name, value, unit and reason of every setting of a group."""
    for each in fields(group):
        yield stage, each.name, getattr(group, each.name), each.metadata["unit"], each.metadata["reason"]
