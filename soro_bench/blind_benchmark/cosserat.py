"""The trunk as a Cosserat rod in PyElastica, with cables and damping of its own: another simulator of the same robot.

PyElastica integrates the rod explicitly (position Verlet). Cables (10 kN/m, 10 mm from the axis of elements of
1e-7 kg m^2) and material damping (0.1 s) are too stiff for that: they act on the velocities at the end of each of its
steps, where its own dampers do, and implicitly (``cosserat_step.py``). Needs the package ``pyelastica``.

Source of the rod: Gazzola et al., Forward and inverse problems in the mechanics of soft filaments, R. Soc. Open Sci. 5
(2018) 171628.
"""

from collections.abc import Mapping, Sequence

import elastica
import numpy as np
from elastica.dissipation import DamperBase

from soro_bench.blind_benchmark.cosserat_step import settle
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo

TIMESTEP = 2e-4  # s; half of it moves keypoints by 0.01 mm (rms over 10 s of an excitation)
PIECES = 2  # elements of a neck; three move keypoints by 0.1 mm in a bent posture
_CLAMPED = 0.003  # m, length of the rod's first element, which is held
_VERTEBRA_SHARE = 0.1  # of a neck's compliance that is in the vertebra behind it
_HELD = 1e-3  # kg, of what does not move: nothing depends on it
_STIFF = 1e-9  # the clamp's compliance, in any unit
_REACH = 0.5  # m, no point of a sound simulation gets so far from the clamp
_CABLES = len(geo.CABLE_NAMES)
# a force along a cable: its number; clip(constant + slope * lengthening rate, low, high) [N, N s/m, N, N]
Row = tuple[int, float, float, float, float]


class ArmLaw:
    """Hidden physics of an arm. A law changes nothing where its magnitude is zero."""

    def install(self, arm: "Arm") -> None:
        """Change masses, stiffness or gravity before it moves."""

    def command(self, arm: "Arm", pull: np.ndarray) -> np.ndarray:
        """(8,) displacements [m] that reach the servos at the end of this step instead of ``pull``."""
        return pull

    def cables(self, arm: "Arm") -> Sequence[Row]:
        """Further forces along cables, which lengthened at ``arm.rates`` (8,) [m/s]; ``arm.forces`` are their last."""
        return ()

    def push(self, arm: "Arm") -> None:
        """Add to the external forces and torques of ``arm.rod``."""


class _Simulation(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing, elastica.Damping):
    """One rod, its clamp and its forces."""


class Arm:
    """A trunk made of a rod, for one run.

    Args:
        parameters: of the trunk, by name.
        laws: in the order in which they act on the commands.
        pieces: elements of a neck; a vertebra is one.
        timestep: s.
    """

    def __init__(
        self,
        parameters: Mapping[str, float],
        laws: Sequence[ArmLaw] = (),
        pieces: int = PIECES,
        timestep: float = TIMESTEP,
    ) -> None:
        self.timestep, self.time, self.parameters, self.laws = timestep, 0.0, dict(parameters), tuple(laws)
        self.gravity = np.array([0.0, -9.81, 0.0])  # m/s^2
        self.nodes = _mesh(pieces)  # m, along the axis
        self.rod = _straight_rod(self.nodes)
        material = [np.array([parameters[name]]) for name in ("young_modulus", "poisson_ratio")]
        self.stiffness = {name: k[0] for name, k in geo.neck_stiffness(*material).items()}
        self.payloads = np.zeros(geo.NUM_NECKS)  # kg, at the middle of each vertebra
        self.pull, self.rates = np.zeros(_CABLES), np.zeros(_CABLES)  # m, m/s
        self.forces: np.ndarray = np.zeros(_CABLES)  # N, of the servos and then of the laws, in the step before
        for law in self.laws:
            law.install(self)
        self._write_masses(parameters["trunk_mass"])
        self._write_stiffness()
        self._simulation, self._stepper = _Simulation(), elastica.PositionVerlet()
        self._simulation.append(self.rod)
        self._simulation.constrain(self.rod).using(
            elastica.FixedConstraint, constrained_position_idx=(0, 1), constrained_director_idx=(0,)
        )
        self._simulation.add_forcing_to(self.rod).using(_Pushes, arm=self)
        self._simulation.dampen(self.rod).using(_CablesAndDamping, arm=self)
        self._simulation.finalize()

    def run(self, pulls: np.ndarray, every: int) -> np.ndarray:
        """Keypoints (n + 1, 21, 3) [m] at the start and after each ``every`` time steps.

        Args:
            pulls: (T, 8) commanded displacements [m] at the end of each time step.

        Raises:
            ValueError: the simulation diverged.
        """
        found = [self.keypoints()]
        for i, self.pull in enumerate(pulls, 1):
            self.time = float(self._stepper.step(self._simulation, self.time, self.timestep))
            if i % every == 0:
                found.append(self.keypoints())
                if not np.abs(found[-1]).max() < _REACH:
                    raise ValueError("the simulation diverged")
        return np.array(found)

    def keypoints(self) -> np.ndarray:
        """(21, 3) m, now: the clamped end, and the rod's nodes on the faces of the necks."""
        places = [_node(self.nodes, z) for z in geo.KEYPOINT_Z[1:]]
        return np.concatenate([np.zeros((1, 3)), self.rod.position_collection[:, places].T])

    def _write_masses(self, mass: float) -> None:
        """A vertebra's mass is spread evenly between the middles of two necks; the first begins at the clamp."""
        rod, middles = self.rod, (self.nodes[1:] + self.nodes[:-1]) / 2
        places = np.array([geo.NECK_START[0], *geo.NECK_MIDDLE[1:], geo.LENGTH])
        sums = mass * np.append(0, np.cumsum(geo.VERTEBRA_MASS_SHARE))
        rod.mass[:] = np.diff(np.interp([self.nodes[0], *middles, self.nodes[-1]], places, sums))
        for z, payload in zip((geo.NECK_END + geo.VERTEBRA_END) / 2, self.payloads, strict=True):
            i = int(np.searchsorted(self.nodes, z))
            part = (self.nodes[i] - z) / (self.nodes[i] - self.nodes[i - 1])
            rod.mass[[i - 1, i]] += payload * np.array([part, 1 - part])
        rod.mass[:2] = _HELD
        own, radius = np.diff(np.interp(self.nodes, places, sums)), geo.outer_radius(middles)
        own[0] = _HELD
        self.inertia = own * (3 * radius**2 + np.diff(self.nodes) ** 2) / 12  # kg m^2, across
        inertia = np.array([self.inertia, self.inertia, own * radius**2 / 2])
        rod.mass_second_moment_of_inertia[:] = _diagonal(inertia)
        rod.inv_mass_second_moment_of_inertia[:] = _diagonal(1 / inertia)

    def _write_stiffness(self) -> None:
        """Of elements (axial, shear) and of the nodes between them (bend, twist)."""
        lengths, middles = np.diff(self.nodes), (self.nodes[1:] + self.nodes[:-1]) / 2
        self.axial, shear = (1 / self._compliance(name, self.nodes) for name in ("axial", "shear"))  # N/m
        self.rod.shear_matrix[:] = _diagonal(np.array([shear, shear, self.axial]) * lengths)
        self.bend, twist = (1 / self._compliance(name, middles) for name in ("bend", "twist"))  # N m/rad
        self.rod.bend_matrix[:] = _diagonal(np.array([self.bend, self.bend, twist]) * np.diff(middles))

    def _compliance(self, kind: str, places: np.ndarray) -> np.ndarray:
        """Of the pieces of the axis between places (n,) [m]; (n - 1,)."""
        borders = np.array([0.0, *np.column_stack([geo.NECK_START, geo.NECK_END]).ravel(), geo.LENGTH])
        shares = np.array([1 - _VERTEBRA_SHARE, _VERTEBRA_SHARE])
        sums = np.cumsum([0.0, _STIFF, *np.outer(1 / self.stiffness[kind], shares).ravel()])
        return np.diff(np.interp(places, borders, sums))


def _mesh(pieces: int) -> np.ndarray:
    """Places [m] of the nodes along the axis."""
    ends = [geo.NECK_START[0] - _CLAMPED, geo.NECK_START[0]]
    for start, middle, end in zip(geo.NECK_START, geo.NECK_END, geo.VERTEBRA_END, strict=True):
        ends += [*np.linspace(start, middle, pieces + 1)[1:], end]
    return np.array(ends)


def _node(nodes: np.ndarray, z: float) -> int:
    return int(np.argmin(np.abs(nodes - z)))


def _straight_rod(nodes: np.ndarray) -> elastica.CosseratRod:
    """A rod along z, whose masses and stiffness are written later."""
    position = np.zeros((3, len(nodes)))
    position[2] = nodes
    return elastica.CosseratRod.straight_rod(
        len(nodes) - 1, position[:, 0].copy(), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]),
        float(nodes[-1] - nodes[0]), 0.01, 1000.0, youngs_modulus=1e6, shear_modulus=4e5, position=position,
    )  # fmt: skip


def _diagonal(values: np.ndarray) -> np.ndarray:
    """(3, 3, n) matrices with diagonals (3, n)."""
    return np.eye(3)[:, :, None] * values[:, None, :]


class _Pushes(elastica.NoForces):
    """Gravity and the forces of laws."""

    def __init__(self, arm: Arm) -> None:
        super().__init__()
        self._arm = arm

    def apply_forces(self, system: elastica.CosseratRod, time: float = 0.0) -> None:
        system.external_forces += self._arm.gravity[:, None] * system.mass
        for law in self._arm.laws:
            law.push(self._arm)


class _CablesAndDamping(DamperBase):
    """Changes the velocities at the end of a step by what damping and cables do at these velocities."""

    def __init__(self, arm: Arm, **kwargs: elastica.CosseratRod) -> None:
        super().__init__(**kwargs)
        self._arm, rod, n = arm, arm.rod, len(arm.inertia)
        self._lightness = np.where(np.arange(n + 1) < 2, 0.0, 1 / rod.mass)  # 1/kg
        damped = np.diag(arm.inertia)
        for j, k in enumerate(arm.timestep * arm.parameters["damping"] * arm.bend):
            damped[j : j + 2, j : j + 2] += k * np.array([[1, -1], [-1, 1]])
        self._turn = np.zeros((n, n))  # angular velocities after damping, by angular momentum before; one is held
        self._turn[1:, 1:] = np.linalg.inv(damped[1:, 1:])
        self._loss = arm.timestep * arm.parameters["damping"] * arm.axial  # kg
        self._eyelets = _eyelets(arm.nodes)
        self._rest = np.zeros(_CABLES)
        self._settle(np.arange(0), np.zeros((0, 5)), np.zeros(0), self._rest, np.zeros(_CABLES))
        self._spring = arm.parameters["cable_stiffness"] * self._rest[0] / self._rest  # N/m
        self._rows = np.zeros((_CABLES, 5))  # of the servos
        self._rows[:, 1] = self._spring
        self._rows[:, 2] = self._spring * (trunk.CABLE_DAMPING_TIME + arm.timestep)  # at the end of the step
        self._rows[:, 4] = trunk.MAX_TENSION
        self._lengths = self._rest.copy()

    def dampen_rates(self, system: elastica.CosseratRod, time: float) -> None:
        arm, pull = self._arm, self._arm.pull
        more: list[Row] = []
        for law in arm.laws:
            pull = law.command(arm, pull)
            more += law.cables(arm)
        self._rows[:, 0] = self._spring * (pull - self._rest)
        rows, cables = self._rows, np.arange(_CABLES)
        if more:
            added = np.array(more)
            cables = np.append(cables, added[:, 0].astype(int))
            rows = np.concatenate([rows, np.insert(added[:, 1:], 1, 0.0, axis=1)])
        if len(arm.forces) != len(rows):
            arm.forces = np.zeros(len(rows))
        self._settle(cables, rows, arm.forces, self._lengths, arm.rates)

    def _settle(
        self, cables: np.ndarray, rows: np.ndarray, forces: np.ndarray, lengths: np.ndarray, rates: np.ndarray
    ) -> None:
        rod = self._arm.rod
        settle(
            rod.position_collection, rod.velocity_collection, rod.director_collection, rod.omega_collection,
            rod.tangents, self._arm.inertia, self._turn, self._lightness, self._loss, self._arm.timestep,
            *self._eyelets, cables, rows, forces, lengths, rates,
        )  # fmt: skip


def _eyelets(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """How many each cable has (8,), and the node and element (8, 21) and the place from there (8, 21, 3) [m] of each.

    An eyelet is on the vertebra's side of a face of a neck; the first is the pull point in the clamp.
    """
    counts = np.array([geo.LONG_CABLE_EYELETS] * 4 + [geo.SHORT_CABLE_EYELETS] * 4)
    node, element = np.zeros((2, _CABLES, counts.max()), dtype=np.int64)
    offset = np.zeros((_CABLES, counts.max(), 3))
    for c, direction in enumerate(geo.CABLE_DIRECTIONS):
        offset[c, 0] = geo.CABLE_RADIUS[0] * direction - [0, 0, nodes[0]]
        for i in range(1, counts[c]):
            node[c, i] = _node(nodes, geo.KEYPOINT_Z[i])
            element[c, i] = node[c, i] - i % 2  # a near face, which comes first, ends a vertebra
            offset[c, i] = geo.CABLE_RADIUS[(i - 1) // 2] * direction
    return counts, node, element, offset
