"""The pneumatic MultiGait walker as a MuJoCo model: two flexes that share their vertex bodies, five chambers.

The body, soft silicone (EcoFlex), is a 3D flex of tetrahedra; the stiff membrane (PDMS) under it a 2D flex of triangles
on the same vertex bodies, so the two are perfectly bonded. A chamber inflates by eigenstrain: the rest lengths of its
tetrahedra grow along the chamber and upwards, as imposed growth of volume does in the reference. MuJoCo keeps rest
lengths in its plastic state (the flex "yields" at a strain that is never reached, so nothing else changes them):
implicit, stable, and saved, reset and batched like any state.

The inflation of a chamber, from 0 to 1, is the activation of an integrating actuator that exerts no force; its control
is the rate [1/s]. :class:`Inflation` turns activations into the plastic state.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import mujoco
import numpy as np

from soro_bench import parameters as prm
from soro_bench.arrays import Floats, Ints
from soro_bench.files import mjcf_path
from soro_bench.models.simulation import FieldWrite
from soro_bench.models.walker_mesh import CHAMBERS, RESOLUTIONS, Mesh, build_mesh, chamber_axes

PARAMETERS = (
    prm.ROBOT_MASS,
    prm.PDMS_POISSON_RATIO,
    prm.PDMS_YOUNG_MODULUS,
    prm.ECOFLEX_POISSON_RATIO,
    prm.ECOFLEX_YOUNG_MODULUS,
)
TIMESTEP = 0.02  # s
# Newton needs 1 to 5. The cap also ends MuJoCo's own first solve without contacts, which would take 200 iterations and
# half of the time and is only a second candidate to start Newton from; the warning that it was ended is not shown.
ITERATIONS = 10
TOLERANCE = 1e-5
# Feet carry the body's internal stress: with MuJoCo's default of 1 they creep, a fifth of the displacement of a gait
FRICTION_IMPEDANCE_RATIO = 100
UPWARD_GROWTH = 0.5  # of the growth along the chamber: assumed, the calibration of GROWTH goes with it
# Growth of each mesh's chambers at full inflation, (centre, leg): of the coarse mesh chosen
# (docs/archive/tasks_and_models.md), of the others calibrated to bend as it does by benchmarks/walker_calibration.py
GROWTH = {"coarse": (0.55, 0.55), "fine": (0.8526, 0.7271), "finest": (0.6235, 0.4456)}
# m. The reference gives none; its membrane elements have the thickness 1 in a scene in millimetres.
MEMBRANE_THICKNESS = 0.001
DAMPING = 0.01  # s, Rayleigh coefficient of the stiffness in the reference
_NEVER = 1e9  # yield strain
Value = TypeVar("Value", float, Floats)


def build_spec(scene: str, mesh: str, poisson: float = 0.0) -> mujoco.MjSpec:
    """The walker in a scene.

    Args:
        scene: an MJCF file of ``assets/mjcf``.
        mesh: "coarse", "fine" or "finest".
        poisson: Poisson's ratio of both materials, until parameters are set.
    """
    if mesh not in RESOLUTIONS:
        raise ValueError(f"unknown mesh {mesh!r}; there are {', '.join(RESOLUTIONS)}")
    body = build_mesh(RESOLUTIONS[mesh])
    spec = mujoco.MjSpec.from_file(str(mjcf_path(scene)))
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.timestep = TIMESTEP
    spec.option.iterations = ITERATIONS
    spec.option.tolerance = TOLERANCE
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = FRICTION_IMPEDANCE_RATIO
    # else contacts become as soft as the time step, and the body sinks in by 4 mm; "discrete" is stable without
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_REFSAFE
    names = _add_vertices(spec, body)
    _add_flex(spec, "ecoflex", body, body.tetrahedra, names, poisson)
    _add_flex(spec, "pdms", body, body.bottom, names, poisson)
    _add_chambers(spec)
    return spec


def _add_vertices(spec: mujoco.MjSpec, mesh: Mesh) -> list[str]:
    """A body with three slides per node."""
    share = _mass_shares(mesh)
    names = [f"vertex{i}" for i in range(len(mesh.nodes))]
    for name, position, mass in zip(names, mesh.nodes, prm.ROBOT_MASS.nominal * share, strict=True):
        body = spec.worldbody.add_body(name=name, pos=position)
        body.explicitinertial = True
        body.mass, body.ipos = mass, [0, 0, 0]
        body.inertia = np.full(3, 1e-12)  # kg m^2, slides do not feel it
        for axis, direction in zip("xyz", np.eye(3), strict=True):
            body.add_joint(name=f"{name}_{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction)
    # A row of constraint that is always there. Without any, Newton takes another path, which is not converged after
    # ITERATIONS when the body is in the air (docs/archive/tasks_and_models.md).
    spec.joint("vertex0_x").frictionloss = 1e-9
    return names


def _mass_shares(mesh: Mesh) -> Floats:
    """(N,) each node's part of the mass: a quarter of each of its tetrahedra."""
    edges = mesh.nodes[mesh.tetrahedra[:, 1:]] - mesh.nodes[mesh.tetrahedra[:, :1]]
    volume = np.linalg.det(edges) / 6
    share = np.bincount(mesh.tetrahedra.ravel(), np.repeat(volume / 4, 4), minlength=len(mesh.nodes))
    return share / volume.sum()


def _add_flex(
    spec: mujoco.MjSpec, name: str, mesh: Mesh, elements: Ints, bodies: Sequence[str], poisson: float
) -> None:
    """A flex of some of the mesh's elements, tetrahedra (E, 4) or triangles (F, 3), on the nodes' bodies."""
    used = np.unique(elements)
    local = np.full(len(mesh.nodes), -1)
    local[used] = np.arange(len(used))
    flex = spec.add_flex(
        name=name,
        dim=elements.shape[1] - 1,
        vertbody=[bodies[i] for i in used],
        vert=np.zeros(3 * len(used)),
        elem=local[elements].ravel().tolist(),
        radius=1e-4,  # m; of the nodes in contacts, which have margins of their own
        damping=DAMPING,
        selfcollide=mujoco.mjtFlexSelf.mjFLEXSELF_NONE,
        young=1.0,  # replaced at run time, as is Poisson's ratio
        poisson=poisson,
    )
    flex.material = name
    if flex.dim == 3:
        flex.stressyield = [_NEVER, 0]
    else:
        flex.elastic2d = 2  # stretching only
        flex.thickness = MEMBRANE_THICKNESS
        flex.contype = flex.conaffinity = 0  # the silicone's contacts do


def _add_chambers(spec: mujoco.MjSpec) -> None:
    for name in CHAMBERS:
        actuator = spec.add_actuator(
            name=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target="vertex0_x",  # any: it exerts no force
            dyntype=mujoco.mjtDyn.mjDYN_INTEGRATOR,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_NONE,
            actlimited=True,
            actrange=[0, 1],
            ctrllimited=False,
            actearly=True,  # so that effects can change the inflation of the coming time step, not the one after
        )
        actuator.gainprm[0] = 0.0


class Inflation:
    """The plastic state for given inflations of the chambers.

    For the growth tensor G = g (a aᵀ + 0.5 z zᵀ), with a the chamber's axis, an edge e of a tetrahedron at rest grows
    to (1 + G) e, so MuJoCo's offset of its squared rest length is 2 e·G e + |G e|².
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        mesh: str,
        growth: tuple[float, float] | None = None,
        array: Callable[[Any], Any] = np.asarray,  # of the library that plastic() computes in
    ):
        centre, leg = GROWTH[mesh] if growth is None else growth
        self._growth = array(np.array([centre, leg, leg, leg, leg]))
        body = build_mesh(RESOLUTIONS[mesh])
        inflated = np.flatnonzero(body.chamber >= 0)
        chamber = body.chamber[inflated]
        axis = chamber_axes()[chamber]
        ecoflex = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, "ecoflex")
        edges = _element_edges(model, ecoflex, body)[inflated]  # (E, 6, 3)
        grown = axis[:, None] * np.einsum("eki,ei->ek", edges, axis)[..., None]
        grown[..., 2] += UPWARD_GROWTH * edges[..., 2]
        self._chamber = array(np.repeat(chamber, 6))
        self._linear = array(2 * (edges * grown).sum(axis=-1).ravel())
        self._quadratic = array((grown**2).sum(axis=-1).ravel())
        first = model.flex_plasticadr[ecoflex]
        self.columns = array((first + 6 * inflated[:, None] + np.arange(6)).ravel())

    def plastic(self, inflation: Floats) -> Floats:
        """(n, len(columns)) m^2, what belongs into ``columns`` of the plastic state; ``inflation`` is (n, 5)."""
        growth = (inflation * self._growth)[:, self._chamber]
        return growth * (self._linear + growth * self._quadratic)


def _element_edges(model: mujoco.MjModel, flex: int, body: Mesh) -> Floats:
    """(E, 6, 3) m, the edge vectors of every tetrahedron in MuJoCo's order."""
    first, count = model.flex_edgeadr[flex], model.flex_elemnum[flex]
    start = model.flex_elemedgeadr[flex]
    edge = model.flex_elemedge[start : start + 6 * count].reshape(count, 6)
    ends = model.flex_edge[first + edge]
    return body.nodes[ends[..., 1]] - body.nodes[ends[..., 0]]


class WalkerParameters:
    """Model fields as a function of the walker's parameters.

    The stiffness of a flex is linear in the Lamé parameters, K = lambda A + mu B, so nothing is recompiled. MuJoCo's
    compiler gives A and B: with E = 1 and nu = 0, lambda is 0 and mu 1/2.
    """

    def __init__(self, model: mujoco.MjModel, scene: str, mesh: str):
        self._bodies = np.array([model.body(f"vertex{i}").id for i in range(model.nbody - 1)])
        self._mass = model.body_mass[self._bodies].copy()
        sheared = build_spec(scene, mesh).compile().flex_stiffness
        stretched = build_spec(scene, mesh, poisson=_PROBE).compile().flex_stiffness
        self._entries, self._shear, self._bulk = {}, {}, {}
        for name, lame in _LAME.items():
            flex = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, name)
            first = model.flex_stiffnessadr[flex]
            others = model.flex_stiffnessadr[model.flex_stiffnessadr > first]
            entries = np.arange(first, others.min() if len(others) else len(sheared))
            bulk, shear = lame(1.0, _PROBE)
            self._entries[name] = entries
            self._shear[name] = 2 * sheared[entries]
            self._bulk[name] = (stretched[entries] - shear * self._shear[name]) / bulk

    def writes(self, params: Mapping[str, Floats]) -> list[FieldWrite]:
        """What to write into N models; ``params`` holds one (N,) array per parameter."""
        scale = params["robot_mass"] / prm.ROBOT_MASS.nominal
        writes = [FieldWrite("body_mass", self._bodies, scale[:, None] * self._mass)]
        for name, lame in _LAME.items():
            bulk, shear = lame(params[f"{name}_young_modulus"], params[f"{name}_poisson_ratio"])
            values = bulk[:, None] * self._bulk[name] + shear[:, None] * self._shear[name]
            writes.append(FieldWrite("flex_stiffness", self._entries[name], values))
        return writes


_PROBE = 0.25  # Poisson's ratio, any but 0


def _lame_solid(young: Value, poisson: Value) -> tuple[Value, Value]:
    """Lamé parameters lambda and mu [Pa] of a solid of Young's modulus [Pa] and Poisson's ratio."""
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def _lame_membrane(young: Value, poisson: Value) -> tuple[Value, Value]:
    """The same of a membrane, in plane stress."""
    return young * poisson / (1 - poisson**2), young / (2 * (1 + poisson))


_LAME = {"ecoflex": _lame_solid, "pdms": _lame_membrane}
