"""A law in N simulations: what all the laws of the catalogue have in common."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import numpy as np
from mujoco.batch import Batch

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.effects.effect import Effect, EffectError, Location, Quantity
from soro_bench.effects.elements import Elements

if TYPE_CHECKING:
    from soro_bench.effects.runtime import ActiveEffects


_HIGHER = ("jnt_stiffnesspoly", "tendon_stiffnesspoly", "dof_dampingpoly")  # coefficients of polynomials


def coefficients(model: mujoco.MjModel, field: str) -> tuple[str, ...]:
    """A model field of linear coefficients of springs or dampers, then that of higher ones if the model has any."""
    higher = field + "poly"
    has = higher in _HIGHER and any(getattr(model, name).any() for name in _HIGHER)
    return (field, higher) if has else (field,)


def per_row(factor: Floats, values: Floats) -> Floats:
    """Factors (n,) in the shape that multiplies rows of values (n, ...)."""
    return factor.reshape(-1, *[1] * (values.ndim - 1))


class Law:
    """One law at n locations: entry i acts in simulation ``rows[i]`` at ``locations[i]`` with ``values[quantity][i]``.

    A law writes model fields after the parameters are set (``write``), starts an episode (``reset``), and may do
    something before every time step (``step``). Everything is elementwise in the entries, so a result does not depend
    on what else is simulated. ``which`` picks entries: a boolean array.
    """

    name: ClassVar[str]
    category: ClassVar[str]
    kinds: ClassVar[tuple[str, ...]]
    quantities: ClassVar[tuple[Quantity, ...]]
    fields: ClassVar[tuple[str, ...]] = ()  # model fields that it writes; restored when effects change
    outputs: ClassVar[tuple[str, ...]] = ()  # data fields that step() reads
    stepped: ClassVar[bool] = False
    shared: ClassVar[bool] = False  # may act at all locations of a kind, from one cause such as a slow controller
    only_shared: ClassVar[bool] = False  # a property of the material or the surroundings, the same everywhere
    adds: ClassVar[bool] = False  # may come several times at one location
    welded: ClassVar[bool] = False  # may act at a body without a joint that moves with one before it
    remembers: ClassVar[tuple[str, ...]] = ()  # its arrays (n, ...) that change from one time step to the next
    elastic: ClassVar[bool] = False  # of the material: every body is then every one that hangs on springs or a flex

    def __init__(self, run: "ActiveEffects", entries: Sequence[tuple[int, Location, Effect]]):
        self.run, self.batch, self.model = run, run.batch, run.batch.model
        self.rows = np.array([row for row, _, _ in entries])
        self.locations = [location for _, location, _ in entries]
        self.values = {q.name: np.array([e.parameters[q.name] for _, _, e in entries]) for q in self.quantities}
        self.fields = tuple(each for name in self.fields for each in coefficients(self.model, name))  # type: ignore[misc]
        for name in self.outputs:
            self.batch.bind(name)
        self.prepare(run.elements)

    @classmethod
    def idle(cls, elements: Elements, location: Location) -> frozenset[str]:
        """Quantities that can do nothing at a location, as a second direction of bending where there is one hinge."""
        return frozenset()

    @classmethod
    def removable(cls, elements: Elements, location: Location) -> float:
        """How far below null the first quantity can be at a location, as much as the model has of it; 0 if none."""
        return 0.0

    @property
    def dt(self) -> float:
        """s, a time step."""
        return self.run.timestep

    def prepare(self, elements: Elements) -> None:
        """Look up what the locations are in the model."""
        self.ids = np.array([elements.id(location) for location in self.locations])

    def write(self, which: Bools) -> None:
        """Change model fields."""

    def reset(self, which: Bools) -> None:
        """Begin an episode."""

    def step(self, which: Bools) -> None:
        """Before a time step."""

    def remembered(self, own: Bools) -> list[tuple[np.ndarray, Any]]:
        """Arrays, and where in them is what the entries ``own`` (n,) go on from."""
        return [(getattr(self, name), own) for name in self.remembers]

    def field(self, name: str) -> Floats:
        """The per-simulation values of a model field."""
        return self.batch.expand(name)

    def time(self, which: Bools) -> Floats:
        """(n,) s since the reset."""
        return self.batch.time[self.rows[which]]


class Scaled:
    """A model field that several laws scale, each by a factor of the moment: every time step begins with what it was
    after all laws had written.

    Args:
        values: (N, ...) of the field.
    """

    def __init__(self, values: Floats):
        self.values, self._own = values, values.copy()

    def keep(self, ids: Ints) -> None:
        """Remember the values of simulations ``ids``."""
        self._own[ids] = self.values[ids]

    def begin(self, ids: Ints) -> None:
        """Begin a time step of simulations ``ids``."""
        self.values[ids] = self._own[ids]


class OnJoints(Law):
    """A law on the scalar joints of a body, or on one joint: entries are repeated for each of the joints."""

    kinds: ClassVar[tuple[str, ...]] = ("body", "joint")
    elastic = True
    bending_only: ClassVar[bool] = False

    def prepare(self, elements: Elements) -> None:
        joints = [self._joints(elements, location) for location in self.locations]
        counts = [len(each) for each in joints]
        self.place = np.repeat(np.arange(len(counts)), counts)
        self.rows = np.repeat(self.rows, counts)
        self.values = {name: np.repeat(values, counts) for name, values in self.values.items()}
        self.joints = np.concatenate(joints) if joints else np.zeros(0, int)
        self.dofs = self.model.jnt_dofadr[self.joints]
        self.qpos = self.model.jnt_qposadr[self.joints]

    def strain(self) -> Floats:
        """(n,) of each entry [rad, m], from where its spring is at rest: the joints of one body bend it together, in no
        preferred direction."""
        strained = self.batch.qpos[self.rows, self.qpos] - self.field("qpos_spring")[self.rows, self.qpos]
        return np.sqrt(np.bincount(self.place, strained * strained))[self.place]

    def _joints(self, elements: Elements, location: Location) -> Ints:
        one = location.kind == "joint"
        body = self.model.jnt_bodyid[elements.id(location)] if one else elements.id(location)
        joints = elements.sprung(body, self.bending_only and not one)
        if not len(joints):
            raise EffectError(f"{self.name} acts on springs of joints or of a neck of flex; {location} has none")
        return np.array([elements.id(location)]) if one else joints


def tension(batch: Batch, rows: Ints, actuators: Ints) -> Floats:
    """(n,) force [N, N m] of the actuators (n, a; -1 is none) on a tendon or joint, in the last time step."""
    ids = np.maximum(actuators, 0)
    force = batch.model.actuator_gear[ids, 0] * batch.actuator_force[rows[:, None], ids]
    return np.abs(np.where(actuators >= 0, force, 0.0).sum(axis=1))
