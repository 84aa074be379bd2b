"""Which version of the method a result comes from."""

from soro_bench.sources import SIMULATION, version_of

PARTS = (*SIMULATION, "diagnosis/**/*.py", "recording/*.py", "inference/statistical_linearisation.py")


def method_version() -> str:
    """A hash of the source files that the method consists of."""
    return version_of(PARTS)
