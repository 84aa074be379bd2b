"""Names of classes of effects in labels and reports: releases keep those of the first one."""

_RELEASED = {
    "friction": "dry_loss",
    "hysteresis_or_play": "rate_independent_memory",
    "static_error": "static_one_sided",
}


def released(name: str) -> str:
    """The name that labels and reports of releases have for a class."""
    return _RELEASED.get(name, name)
