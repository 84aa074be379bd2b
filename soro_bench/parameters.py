"""Physical parameters that a simulation can be given at run time.

``search`` is the box in which studies look for the parameter, published where they do; ``bounds`` is what the models
accept.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from soro_bench.arrays import Floats


@dataclass(frozen=True)
class Parameter:
    """One named scalar of the dynamics.

    Args:
        name: as files and commands call it.
        unit: SI; "1" without one.
        nominal: its value where none is given.
        search: the box in which it is looked for; published where the studies randomise it.
        bounds: what the models accept.
        meaning: for people.
    """

    name: str
    unit: str
    nominal: float
    search: tuple[float, float]
    bounds: tuple[float, float]
    meaning: str


# Nominal values and search boxes: Tiboni et al., IROS 2023, Tables I and II, and their configuration files
# (docs/archive/tasks_and_models.md). The published upper end of Poisson's ratio, 0.5, is singular in linear elasticity.
# Bounds without a reason of their own are chosen somewhat beyond the boxes, over which random actions are tried
# (docs/archive/training_and_speed.md).
TRUNK_MASS = Parameter(
    "trunk_mass", "kg", 0.42, (0.005, 1.0), (0.001, 2.0),
    "mass of the whole trunk; 83 % of it moves, the rest sits in the clamp",
)  # fmt: skip
YOUNG_MODULUS = Parameter("young_modulus", "Pa", 4.5e6, (2e6, 7e6), (1e6, 1e7), "Young's modulus of the trunk")
POISSON_RATIO = Parameter("poisson_ratio", "1", 0.45, (0.40, 0.495), (0.40, 0.495), "Poisson's ratio of the trunk")
# The reference simulator's Rayleigh stiffness coefficient is 0.1 s; not randomised in the published studies; the box
# is half to twice that.
DAMPING = Parameter("damping", "s", 0.1, (0.05, 0.2), (0.02, 0.5), "damping of the trunk per stiffness (Rayleigh)")
# Not in the reference, whose cables are rigid but pull on soft mesh nodes: chosen, not measured; 1 N stretches a long
# cable by 0.1 mm. The box is half to twice that.
CABLE_STIFFNESS = Parameter(
    "cable_stiffness", "N/m", 1e4, (5e3, 2e4), (1e3, 2e4), "stiffness of a long cable and what it pulls on"
)
FRICTION = Parameter("friction", "1", 0.3, (0.01, 1.0), (0.0, 2.0), "Coulomb friction of every pair in contact")
CUBE_MASS = Parameter("cube_mass", "kg", 0.05, (0.005, 1.0), (0.001, 2.0), "mass of the pushed or lifted object")
WALL_OFFSET = Parameter(
    # beyond 0.037 m the wall is in the object's way from the start
    "wall_offset", "m", 0.0, (-0.03, 0.03), (-0.2, 0.035),
    "wall position along x, from the nominal -0.1 m; -0.2 puts it out of reach",
)  # fmt: skip
# MultiGait: the same paper, Section IV, and its configuration files; the published search of the membrane's Poisson's
# ratio goes on to 0.515, which no material has.
ROBOT_MASS = Parameter("robot_mass", "kg", 0.035, (0.02, 0.05), (0.005, 0.2), "mass of the whole walker")
PDMS_POISSON_RATIO = Parameter(
    "pdms_poisson_ratio", "1", 0.49, (0.465, 0.5), (0.4, 0.5), "Poisson's ratio of the walker's membrane"
)
PDMS_YOUNG_MODULUS = Parameter(
    "pdms_young_modulus", "Pa", 5e6, (1e6, 7e6), (5e5, 2e7), "Young's modulus of the walker's membrane"
)
ECOFLEX_POISSON_RATIO = Parameter(
    "ecoflex_poisson_ratio", "1", 0.05, (0.02, 0.1), (0.001, 0.4), "Poisson's ratio of the walker's body"
)
ECOFLEX_YOUNG_MODULUS = Parameter(
    "ecoflex_young_modulus", "Pa", 7e4, (3e4, 1.3e5), (1e4, 5e5), "Young's modulus of the walker's body"
)


ALL_PARAMETERS = {
    p.name: p
    for p in (
        TRUNK_MASS,
        YOUNG_MODULUS,
        POISSON_RATIO,
        DAMPING,
        CABLE_STIFFNESS,
        FRICTION,
        CUBE_MASS,
        WALL_OFFSET,
        ROBOT_MASS,
        PDMS_POISSON_RATIO,
        PDMS_YOUNG_MODULUS,
        ECOFLEX_POISSON_RATIO,
        ECOFLEX_YOUNG_MODULUS,
    )
}


class ParameterSet:
    """An ordered set of parameters: checks values and converts between dicts and arrays."""

    def __init__(self, *parameters: Parameter):
        self.parameters = {p.name: p for p in parameters}
        self.names = tuple(self.parameters)

    def with_nominal(self, **values: float) -> "ParameterSet":
        """The same set with other nominal values."""
        return ParameterSet(*(replace(p, nominal=values.get(p.name, p.nominal)) for p in self.parameters.values()))

    @property
    def nominal(self) -> Floats:
        """(d,) nominal values in the order of ``names``."""
        return np.array([p.nominal for p in self.parameters.values()])

    def check_names(self, names: Iterable[str]) -> None:
        """Raise ValueError if one of ``names`` is not in the set."""
        for name in names:
            if name not in self.parameters:
                raise ValueError(f"unknown parameter {name!r}; this environment has {', '.join(self.names)}")

    def check(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return ``values`` as floats; raise ValueError for an unknown name or a value outside its bounds."""
        if not isinstance(values, Mapping):
            raise ValueError(f"params {values!r} has to be a dict of {', '.join(self.names)}")
        self.check_names(values)
        checked = {}
        for name, value in values.items():
            low, high = self.parameters[name].bounds
            try:
                if isinstance(value, str | bytes | bool | np.bool_):  # which float() would take
                    raise TypeError
                checked[name] = float(value)
            except OverflowError:
                checked[name] = np.inf
            except (TypeError, ValueError):
                raise ValueError(f"{name} = {value!r} has to be one number") from None
            if not low <= checked[name] <= high:
                raise ValueError(f"{name} = {value} is outside [{low}, {high}] {self.parameters[name].unit}")
        return checked

    def to_array(self, values: Mapping[str, float]) -> Floats:
        """(d,) array of checked values; missing names take their nominal value."""
        values = self.check(values)
        return np.array([values.get(name, p.nominal) for name, p in self.parameters.items()])

    def to_dict(self, values: Floats) -> dict[str, float]:
        """The (d,) array as a dict by name."""
        return dict(zip(self.names, map(float, values), strict=True))
