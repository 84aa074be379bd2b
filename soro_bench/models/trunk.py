"""The cable-driven trunk as a MuJoCo model: ten rigid vertebrae, ten elastic necks, eight cables.

Two models share keypoints, cables and parameters and differ in the necks:

- ``flex``, the reference: every vertebra floats freely (60 degrees of freedom) and every neck is a MuJoCo flex, one
  trilinear cell with four nodes on each of its two vertebrae. The cell's stiffness matrix is written at run time so
  that it bends, twists, shears and stretches exactly like the neck of the reference mesh.
- ``cable``, the cheap one: the vertebrae form a serial chain; a neck is an axial slide and two bending hinges (30
  degrees of freedom) with the same stiffness, rigid in shear and in twist, which taut cables stiffen anyway.

A cable is a spatial tendon through eyelets on the vertebrae, pulled by a servo on its displacement: its tension is
stiffness * (commanded - actual displacement), damped, between 0 (slack) and a limit, ``MAX_TENSION``. The commanded
displacement is the servo's activation; the control is its rate [m/s]. docs/explanation/models.md has the reasons.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from soro_bench import parameters as prm
from soro_bench.arrays import Floats
from soro_bench.files import mjcf_path
from soro_bench.models import trunk_geometry as geo
from soro_bench.models.simulation import FieldWrite
from soro_bench.models.trunk_geometry import add_skin

PARAMETERS = (
    prm.TRUNK_MASS,
    prm.POISSON_RATIO,
    prm.YOUNG_MODULUS,
    prm.DAMPING,
    prm.CABLE_STIFFNESS,
)
# N. The trunk's weight asks for 25 N at the first neck's upper cables. Opposing cables of 60 N buckle the necks, and
# their sideways stiffness (tension / gap) outgrows the time step.
MAX_TENSION = 30.0
# N, in each version; chosen. The reference has no limit: 62 N in a recording (benchmarks/trunk_fem.py)
MAX_TENSIONS = (MAX_TENSION, 50.0)
# s, damping of a cable per stiffness; one 10 ms command interval gives the reference's first-action tips best
CABLE_DAMPING_TIME = 0.01
# Joint limits of `cable` stand for rims that touch, which nothing else keeps apart; chosen: 4 mm, and the bend at which
# rims 5.5 mm apart meet (m over m is rad), of the slender vertebrae at the tip no more than 0.9 rad
_AXIAL_LIMIT, _RIM_GAP, _BEND_LIMITS = 0.004, 0.0055, (0.4, 0.9)
NODE_OFFSET = 0.003  # m, half edge of a neck's cell; its stiffness is prescribed, so the size does not matter


@dataclass(frozen=True)
class TrunkVariant:
    """What the two models need of the engine."""

    timestep: float  # s
    iterations: int
    tolerance: float
    # kg m^2, on top of each vertebra's own 3e-7 to 4e-6: opposing taut cables buckle the necks to and fro, at a
    # frequency that no affordable time step resolves
    added_inertia: float
    # kg m^2, of every joint, in version 1: `added_inertia` scales with the trunk's mass, so that light ones blew up
    armature: float


# Both use the discrete integrator: flex elasticity needs it, and it solves contacts with the same effective inertia
# that moves the bodies. Under implicitfast, 25 % cheaper, an object squeezed by the strongly damped chain is shot away.
VARIANTS = {
    # The inner solve takes up to 300 iterations, and a tolerance of 1e-5 leaves the tip within 0.01 mm of 1e-10 after
    # 3 s. Over 2 s of motion the tip ends 1.2 mm (median) from where half the time step would take it; with 10 ms, 4.6.
    "flex": TrunkVariant(timestep=0.005, iterations=500, tolerance=1e-5, added_inertia=5e-6, armature=1e-5),
    "cable": TrunkVariant(timestep=0.010, iterations=100, tolerance=1e-8, added_inertia=2e-5, armature=2e-4),
}


def build_spec(scene: str, model: str, version: int = 0) -> mujoco.MjSpec:
    """The trunk in a scene.

    Args:
        scene: an MJCF file of ``assets/mjcf`` that includes trunk.xml.
        model: "flex" or "cable".
        version: of the environments.
    """
    if model not in VARIANTS:
        raise ValueError(f"unknown trunk model {model!r}; there are {', '.join(VARIANTS)}")
    spec = mujoco.MjSpec.from_file(str(mjcf_path(scene)))
    variant = VARIANTS[model]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.timestep = variant.timestep
    spec.option.iterations = variant.iterations
    spec.option.tolerance = variant.tolerance
    links = [spec.body("base")]
    for k in range(geo.NUM_NECKS):
        parent = links[-1] if model == "cable" else spec.worldbody
        links.append(_add_vertebra(spec, parent, k, model, VARIANTS[model].armature if version else 0.0))
    if model == "flex":
        for k in range(geo.NUM_NECKS):
            _add_neck_flex(spec, k, links[k], links[k + 1])
    _add_keypoints(spec, links)
    for c in range(len(geo.CABLE_NAMES)):
        _add_cable(spec, c, links, MAX_TENSIONS[version])
    add_skin(spec, links)
    return spec


def _link_origin(k: int) -> float:
    """z [m] of the frame of link k: 0 is the base, link k + 1 is vertebra k with its frame at the neck's middle."""
    return 0.0 if k == 0 else geo.NECK_MIDDLE[k - 1]


def _add_vertebra(spec: mujoco.MjSpec, parent: mujoco.MjsBody, k: int, model: str, armature: float) -> mujoco.MjsBody:
    parent_z = 0.0 if parent is spec.worldbody else _link_origin(k)
    z = geo.NECK_MIDDLE[k]
    body = parent.add_body(name=f"vertebra{k}", pos=[0, 0, z - parent_z])
    if model == "flex":
        body.add_freejoint(name=f"vertebra{k}").armature = armature
    else:
        # Stiffness and damping are parameters; limits keep a violent pull from folding the chain
        limit = float(np.clip(_RIM_GAP / geo.outer_radius(z), *_BEND_LIMITS))
        hinge, slide = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
        for name, kind, axis, reach in (
            ("axial", slide, (0, 0, 1), _AXIAL_LIMIT),
            ("bend_x", hinge, (1, 0, 0), limit),
            ("bend_y", hinge, (0, 1, 0), limit),
        ):
            body.add_joint(name=f"{name}{k}", type=kind, axis=axis, range=[-reach, reach], armature=armature)
    _add_inertia(body, k, VARIANTS[model].added_inertia)
    near, far = geo.NECK_END[k] - z, geo.VERTEBRA_END[k] - z
    radius = float(geo.outer_radius((geo.NECK_END[k] + geo.VERTEBRA_END[k]) / 2))
    # a capsule whose round ends stay inside the trunk at the tip; elsewhere they overlap the next vertebra's
    tip = far - radius if k == geo.NUM_NECKS - 1 else far - 0.3 * (far - near)
    start = min(near + 0.3 * (far - near), tip - 1e-4)
    body.add_geom(
        spec.find_default("vertebra"), name=f"vertebra{k}", size=[radius, 0, 0], fromto=[0, 0, start, 0, 0, tip]
    )
    return body


def _add_inertia(body: mujoco.MjsBody, k: int, added: float) -> None:
    """Nominal mass and inertia of a uniform cylinder, and ``added``; all scale with trunk_mass at run time."""
    z = geo.NECK_MIDDLE[k]
    near, far = geo.NECK_END[k], geo.VERTEBRA_END[k]
    mass = prm.TRUNK_MASS.nominal * geo.VERTEBRA_MASS_SHARE[k]
    radius, length = geo.outer_radius((near + far) / 2), far - near
    body.explicitinertial = True
    body.mass = mass
    body.ipos = [0, 0, (near + far) / 2 - z]
    across = mass * (3 * radius**2 + length**2) / 12
    body.inertia = np.array([across, across, mass * radius**2 / 2]) + added


def _add_neck_flex(spec: mujoco.MjSpec, k: int, near_link: mujoco.MjsBody, far_link: mujoco.MjsBody) -> None:
    a, half = NODE_OFFSET, geo.NECK_LENGTH / 2
    corners = np.array([(x, y, z) for x in (-a, a) for y in (-a, a) for z in (-half, half)])
    near_z = geo.NECK_MIDDLE[k] - _link_origin(k)  # the neck's middle in the near link's frame
    nodes = corners + np.where(corners[:, 2:] < 0, [0, 0, near_z], 0.0)
    bodies = [near_link.name if z < 0 else far_link.name for z in corners[:, 2]]
    spec.add_flex(
        name=f"neck{k}",
        dim=3,
        order=1,
        radius=0,
        vert=nodes.ravel(),
        vertbody=bodies,
        node=nodes.ravel(),
        nodebody=bodies,
        # six tetrahedra that fill the cell
        elem=[0, 2, 4, 3, 0, 4, 1, 3, 4, 2, 6, 3, 4, 6, 7, 3, 4, 5, 1, 3, 4, 7, 5, 3],
        young=1e6,  # replaced at run time, as is the damping
        poisson=0.3,
        damping=prm.DAMPING.nominal,
        contype=0,
        conaffinity=0,
        selfcollide=mujoco.mjtFlexSelf.mjFLEXSELF_NONE,
        group=4,
    )


def _link_of_face(face: int) -> int:
    """The link that carries face ``face`` of the necks (near and far face of neck 0, of neck 1, ...)."""
    return (face + 1) // 2


def _add_keypoints(spec: mujoco.MjSpec, links: Sequence[mujoco.MjsBody]) -> None:
    default = spec.find_default("keypoint")
    for i, z in enumerate(geo.KEYPOINT_Z):
        k = 0 if i == 0 else _link_of_face(i - 1)
        links[k].add_site(default, name=f"keypoint{i}", pos=[0, 0, z - _link_origin(k)])


def _add_cable(spec: mujoco.MjSpec, c: int, links: Sequence[mujoco.MjsBody], max_tension: float) -> None:
    name, direction = geo.CABLE_NAMES[c], geo.CABLE_DIRECTIONS[c]
    eyelets = geo.LONG_CABLE_EYELETS if c < 4 else geo.SHORT_CABLE_EYELETS
    tendon = spec.add_tendon(spec.find_default("cable"), name=name)
    for i in range(eyelets):
        # eyelet 0 is the pull point in the clamp, eyelet i the face i - 1 of the necks
        k = 0 if i == 0 else _link_of_face(i - 1)
        radius = geo.CABLE_RADIUS[0] if i == 0 else geo.CABLE_RADIUS[(i - 1) // 2]
        pos = radius * direction + [0, 0, geo.KEYPOINT_Z[i] - _link_origin(k)]
        site = links[k].add_site(spec.find_default("eyelet"), name=f"{name}_{i}", pos=pos)
        tendon.wrap_site(site.name)
    limit = geo.CABLE_LIMITS[c]
    actuator = spec.add_actuator(
        name=name,
        trntype=mujoco.mjtTrn.mjTRN_TENDON,
        target=name,
        gear=[-1, 0, 0, 0, 0, 0],  # a positive force pulls
        forcelimited=True,
        forcerange=[0, max_tension],
        ctrllimited=True,
        ctrlrange=[-geo.CABLE_RATE, geo.CABLE_RATE],
        actlimited=True,
        actrange=[-limit, limit],
        dyntype=mujoco.mjtDyn.mjDYN_INTEGRATOR,
        actearly=True,  # as in the reference, a step uses the displacement commanded for its end
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
    )
    actuator.gainprm[0] = prm.CABLE_STIFFNESS.nominal  # replaced at run time, as is the bias


class TrunkParameters:
    """Model fields as a function of the trunk's parameters; linear in the stiffness, so nothing is recompiled."""

    def __init__(self, model: mujoco.MjModel):
        self._bodies = np.array([model.body(f"vertebra{k}").id for k in range(geo.NUM_NECKS)])
        self._cables = np.array([model.actuator(name).id for name in geo.CABLE_NAMES])
        self._rest_length = -model.actuator_length0[self._cables]  # m; the gear is -1
        self._mass = model.body_mass[self._bodies].copy()
        self._inertia = model.body_inertia[self._bodies].copy()
        if model.nflex:
            self._neck_writes = self._flex_writes
            bases = _neck_cell_bases()
            self._flex_kinds, self._flex_bases = tuple(bases), np.stack(list(bases.values()))  # (kinds, 576)
            self._flexes = np.array([
                mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, f"neck{k}") for k in range(geo.NUM_NECKS)
            ])
            self._flex_entries = model.flex_stiffnessadr[self._flexes][:, None] + np.arange(24 * 24)
        else:
            self._neck_writes = self._joint_writes
            self._joints = {
                kind: np.array([model.joint(f"{kind}{k}").id for k in range(geo.NUM_NECKS)])
                for kind in ("axial", "bend_x", "bend_y")
            }
            self._dofs = {kind: model.jnt_dofadr[joints] for kind, joints in self._joints.items()}

    def writes(self, params: Mapping[str, Floats]) -> list[FieldWrite]:
        """What to write into N models; ``params`` holds one (N,) array per parameter."""
        scale = params["trunk_mass"] / prm.TRUNK_MASS.nominal
        stiffness = geo.neck_stiffness(params["young_modulus"], params["poisson_ratio"])
        return [
            FieldWrite("body_mass", self._bodies, scale[:, None] * self._mass),
            FieldWrite("body_inertia", self._bodies, scale[:, None, None] * self._inertia),
            *self._neck_writes(stiffness, params["damping"][:, None]),
            # cables of one cross-section: the short ones are stiffer by the ratio of the lengths
            *self._cable_writes(params["cable_stiffness"][:, None] * self._rest_length[0] / self._rest_length),
        ]

    def _flex_writes(self, stiffness: Mapping[str, Floats], damping: Floats) -> list[FieldWrite]:
        cells = np.stack([stiffness[kind] for kind in self._flex_kinds], axis=-1) @ self._flex_bases
        n = len(damping)
        return [
            FieldWrite("flex_stiffness", self._flex_entries.ravel(), cells.reshape(n, -1)),
            FieldWrite("flex_damping", self._flexes, np.broadcast_to(damping, (n, geo.NUM_NECKS))),
        ]

    def _joint_writes(self, stiffness: Mapping[str, Floats], damping: Floats) -> list[FieldWrite]:
        writes = []
        for kind, joints in self._joints.items():
            values = stiffness[kind.removesuffix("_x").removesuffix("_y")]
            writes.append(FieldWrite("jnt_stiffness", joints, values))
            writes.append(FieldWrite("dof_damping", self._dofs[kind], damping * values))
        return writes

    def _cable_writes(self, stiffness: Floats) -> list[FieldWrite]:
        gain = np.zeros((len(stiffness), len(self._cables), mujoco.mjNGAIN))
        bias = np.zeros((len(stiffness), len(self._cables), mujoco.mjNBIAS))
        # tension = stiffness * (commanded - (rest length - length)) + damping * lengthening rate; length = -actuator's
        gain[:, :, 0] = stiffness
        bias[:, :, 0] = -stiffness * self._rest_length
        bias[:, :, 1] = -stiffness
        bias[:, :, 2] = -stiffness * CABLE_DAMPING_TIME
        return [
            FieldWrite("actuator_gainprm", self._cables, gain),
            FieldWrite("actuator_biasprm", self._cables, bias),
        ]


def _neck_cell_bases() -> dict[str, Floats]:
    """(576,) stiffness matrices of a trilinear neck cell, one per kind of deformation, for unit stiffness.

    A neck deforms by the relative motion of its two faces, each a least-squares fit to its four nodes: p is the row
    that reads one relative motion off the 24 node displacements, and k p p^T the cell's stiffness against it. MuJoCo
    stores the negative (force = K u) and applies it in the frame that follows the cell's mean rotation.
    """
    a, length = NODE_OFFSET, geo.NECK_LENGTH
    nodes = np.array([(x, y, z) for x in (-a, a) for y in (-a, a) for z in (-length / 2, length / 2)])
    far = nodes[:, 2] > 0
    sign = np.where(far, 1.0, -1.0)[:, None]

    def rotation(axis: Floats) -> Floats:
        """(8, 3): the rotation of each node's own face about ``axis`` is the sum of this times displacement."""
        arm = np.cross(axis, nodes * [1, 1, 0])
        return arm / np.square(arm[far]).sum()

    x, y, z = np.eye(3)
    rows = {
        "axial": [sign / 4 * z],
        "bend": [sign * rotation(x), sign * rotation(y)],
        "twist": [sign * rotation(z)],
        # sideways motion beyond what the mean rotation of the faces explains
        "shear": [sign / 4 * x - length / 2 * rotation(y), sign / 4 * y + length / 2 * rotation(x)],
    }
    return {kind: -sum((np.outer(p, p) for p in ps), start=np.zeros((24, 24))).ravel() for kind, ps in rows.items()}
