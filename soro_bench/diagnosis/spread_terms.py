"""Laws that act at every tendon, joint or actuator, with a magnitude of its own at each: one term of a hypothesis.

Elements of one robot are built alike, so their magnitudes are: a hierarchical prior gives them a common part and parts
of their own (Gelman et al., "Bayesian Data Analysis", 2013, chapter 5). The magnitude of element i is, in standard
deviations of the prior that it would have alone, u_i = c x_0 + d x_i with c² + d² = 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.candidates import Term
from soro_bench.effects.catalogue import PHYSICS
from soro_bench.effects.effect import EACH, Effect, Location

KINDS = ("tendon", "joint", "actuator")


@dataclass(frozen=True)
class SpreadTerm(Term):
    """A law at several elements. Its coordinates are x_0, x_1 .. x_n, and those of its shape, which all elements share.

    members: the terms of the same law at each element, with one magnitude each.
    """

    members: tuple[Term, ...] = ()

    @property
    def count(self) -> int:
        """Number of elements n."""
        return len(self.members)

    @property
    def weights(self) -> tuple[float, float]:
        """c and d, of the common part and of that of an element."""
        common = self.settings.common_share
        return float(np.sqrt(common)), float(np.sqrt(1.0 - common))

    @property
    def mixing(self) -> Floats:
        """(1 + n, n) derivatives of the magnitudes u by x_0 .. x_n."""
        c, d = self.weights
        return np.vstack([np.full(self.count, c), d * np.eye(self.count)])

    @property
    def deviations(self) -> Floats:
        """(size,) of the priors; coordinates of magnitudes are in units of those of the members."""
        return np.concatenate([np.ones(1 + self.count), self.members[0].deviations[1:]])

    @property
    def simulated(self) -> Floats:
        """(size,) coordinates at which the magnitude of every element is typical."""
        return self.coordinates_of([member.simulated[0] for member in self.members], np.zeros(self.size))

    @property
    def bounds(self) -> Floats:
        """(2, size) least and largest coordinates; the effect keeps each magnitude within its own bounds."""
        c, _ = self.weights
        common = np.array([member.bounds[:, 0] for member in self.members])
        ends = np.array([[common[:, 0].min()], [common[:, 1].max()]]) / c
        own = np.full((2, self.count), self.settings.limit) * [[-1.0], [1.0]]
        return np.hstack([ends, own, self.members[0].bounds[:, 1:]])

    def coordinates_of(self, magnitudes: Sequence[float] | Floats, shape: Floats) -> Floats:
        """(size,) the most probable coordinates with magnitudes u (n,), and the last ones of ``shape``."""
        mixing = self.mixing
        x = mixing @ np.linalg.solve(mixing.T @ mixing, np.asarray(magnitudes, float))
        return np.concatenate([x, shape[len(shape) - (self.size - len(x)) :]])

    def parts(self, x: Floats) -> list[tuple[Term, Floats]]:
        """The terms of all elements, with their coordinates."""
        first = 1 + self.count
        return [
            (member, np.concatenate([[u], x[first:]]))
            for member, u in zip(self.members, x[:first] @ self.mixing, strict=True)
        ]

    def deviations_of_parts(self, covariance: Floats) -> list[Floats]:
        """(1 + shape) of the coordinates of each element's term, from the covariance (size, size) of all."""
        first = 1 + self.count
        own = np.sqrt(np.diag(self.mixing.T @ covariance[:first, :first] @ self.mixing))
        shape = np.sqrt(np.diag(covariance))[first:]
        return [np.concatenate([[each], shape]) for each in own]

    def effect(self, x: Floats) -> Effect:
        """Not one effect but several.

        Raises:
            TypeError: always; ``effects`` has them.
        """
        raise TypeError(f"{self.name} at {self.location} is several effects")


def spread(members: Sequence[Term]) -> SpreadTerm:
    """The term of a law at several elements.

    Args:
        members: of one law at elements of one kind.
    """
    first = members[0]
    magnitudes = (True,) * (1 + len(members))
    shape = first.typical[1:]
    return SpreadTerm(
        first.name, Location(first.location.kind, EACH), (1.0,) * len(magnitudes) + shape,
        magnitudes + (False,) * len(shape), first.idle, first.settings, first.removable, tuple(members),
    )  # fmt: skip


def alike(candidates: Sequence[Term]) -> list[list[Term]]:
    """Groups of single terms that a law may have at elements of one kind, two or more each: the first one at each.

    What is the same everywhere, such as a property of the material, has none.
    """
    groups: dict[tuple[str, str, bool], dict[Location, Term]] = {}
    for each in candidates:
        if is_single(each):
            groups.setdefault(law_of(each), {}).setdefault(each.location, each)
    return [list(group.values()) for group in groups.values() if len(group) > 1]


def law_of(term: Term) -> tuple[str, str, bool]:
    """What the terms of one law at like elements have in common: name, kind of location, whether it takes away."""
    return term.name, term.location.kind, term.removable > 0


def is_single(term: Term) -> bool:
    """Whether a term acts at one element with one magnitude, and its law may act at others too."""
    local = term.location.kind in KINDS and not term.location.name.startswith("*")
    return local and not PHYSICS[term.name].only_shared and sum(term.magnitudes) == 1
