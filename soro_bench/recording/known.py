"""Parameters that a user knows: fits leave them as they are."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.simulated import parse_params

RECORDED = "recorded"  # in the place of NAME=VALUE: what the recordings have
Told = str | Sequence[str] | Mapping[str, float]


@dataclass(frozen=True)
class Known:
    """Known parameters.

    values: by name, in the units of the parameters. recorded: names of those that the recordings have; a user gave the
    others.
    """

    values: Mapping[str, float] = field(default_factory=dict)
    recorded: frozenset[str] = frozenset()


def known_parameters(told: Told, recordings: Sequence[Recording], names: Iterable[str]) -> Known:
    """What a user tells of the parameters; of a value that is told and recorded, the told one counts.

    Args:
        told: values by name; or texts such as "trunk_mass=0.42", and "recorded" for what the recordings have.
        recordings: that are explained.
        names: of the parameters that the robot has.

    Raises:
        ValueError: a text is neither of these.
        RecordingError: the recordings have none of these parameters, or disagree.
    """
    if isinstance(told, Mapping):
        return Known(dict(told))
    texts = [told] if isinstance(told, str) else list(told)
    values = parse_params([text for text in texts if text != RECORDED])
    if RECORDED not in texts:
        return Known(values)
    found = {name: value for name, value in _recorded(recordings, names).items() if name not in values}
    return Known({**values, **found}, frozenset(found))


def _recorded(recordings: Sequence[Recording], names: Iterable[str]) -> dict[str, float]:
    """The parameters that recordings have, by name."""
    found: dict[str, float] = {}
    for name in (names := list(names)):
        values = sorted({each.parameters[name] for each in recordings if name in each.parameters})
        if len(values) > 1:
            raise RecordingError(f"the recordings have {name} = {' and '.join(map(repr, values))}; which one counts? "
                                 f"Give {name}=VALUE")  # fmt: skip
        if values:
            found[name] = values[0]
    if not found:
        there = sorted({name for each in recordings for name in each.parameters})
        raise RecordingError(f"the recordings have no known parameter of this robot, which has {', '.join(names)}; "
                             f"they have {', '.join(there) or 'none'}")  # fmt: skip
    return found
