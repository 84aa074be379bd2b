"""How the distribution of training parameters comes about."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from soro_bench.randomization import Distribution, holding, random_box
from soro_bench.registration import task_type


@dataclass(frozen=True)
class Method:
    """A way to the distribution of training parameters.

    Args:
        name: short name for folders and tables.
        distribution: gives it for an environment id, a seed and a folder to keep files in; None means the nominal
            parameters.
        at_once: whether it is given without much work and without files, so that a finished run is asked whether it
            had the same.
    """

    name: str
    distribution: Callable[[str, int, Path], Distribution | None]
    at_once: bool = False


ORACLE = Method("oracle", lambda env_id, seed, folder: None, at_once=True)  # trained on the evaluation dynamics


def udr(known: Mapping[str, float] | None = None, name: str = "udr") -> Method:
    """A random box of the search space for every seed, as published; ``known`` parameters stay as given."""
    known = dict(known or {})

    def distribution(env_id: str, seed: int, folder: Path) -> Distribution:
        # drawn for all, so that boxes with and without known parameters are alike otherwise
        return holding(random_box(task_type(env_id).randomized, np.random.default_rng(seed)), known)

    return Method(name, distribution, at_once=True)


def fixed(name: str, distribution: Distribution) -> Method:
    """The same distribution for every seed."""
    return Method(name, lambda env_id, seed, folder: distribution, at_once=True)


UDR = udr()
METHODS = {method.name: method for method in (ORACLE, UDR)}
