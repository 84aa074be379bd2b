"""How the distribution of training parameters comes about."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from soro_bench.randomization import Distribution, holding, random_box, search_box
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
        frames: observations that the policy sees; see :class:`soro_bench.training.configuration.PPOConfig`.
        told: gives a distribution of the robot's parameters, likewise, whose means the policy is told; in training it
            is told those of each episode.
    """

    name: str
    distribution: Callable[[str, int, Path], Distribution | None]
    at_once: bool = False
    frames: int = 1
    told: Callable[[str, int, Path], Distribution | None] | None = None


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


def whole_box(env_id: str, seed: int, folder: Path) -> Distribution:
    """The search box of an environment, the same for every seed."""
    return search_box(task_type(env_id).randomized)


# Peng et al., "Sim-to-real transfer of robotic control with dynamics randomization", ICRA 2018: what a policy remembers
# tells it the dynamics of its episode; there by recurrence, here by the observations of the last quarter of a second
MEMORY = Method("memory", whole_box, at_once=True, frames=5)


def universal(found: Method) -> Method:
    """A universal policy, told what a method finds (Yu et al., "Preparing for the unknown", RSS 2017).

    Args:
        found: gives the distribution of the robot's parameters.
    """
    return Method(f"universal_{found.name}", whole_box, told=found.distribution)


UDR = udr()
METHODS = {method.name: method for method in (ORACLE, UDR)}
