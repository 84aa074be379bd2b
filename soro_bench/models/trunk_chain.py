"""The trunk as a chain of any number of links: the same robot in another discretisation.

Nothing is trained or evaluated on it. A diagnosis takes from it how far simulators of one robot are apart, and the
blind benchmark has healthy robots of it.
"""

from collections.abc import Mapping

import mujoco
import numpy as np

from soro_bench import parameters as prm
from soro_bench.files import mjcf_path
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo

_ADDED_INERTIA = 2e-4  # kg m^2, shared by all links: as much as the ten vertebrae of the suite's chain have more
_GRID = 1e-5  # m, on which compliance is summed up


def build_chain(links: int, parameters: Mapping[str, float]) -> mujoco.MjSpec:
    """A serial chain with keypoints, cables and masses of the trunk; every joint has the same bending compliance.

    A neck's compliance is spread evenly over its length. Joints are at the middles of equal shares of the whole.

    Args:
        links: number of moving links, 3 to 40.
        parameters: of the trunk, by name.
    """
    if not 3 <= links <= 40:
        raise ValueError(f"{links} links; 3 to 40 are allowed")
    stiffness = {name: k[0] for name, k in geo.neck_stiffness(
        np.array([parameters["young_modulus"]]), np.array([parameters["poisson_ratio"]])).items()}  # fmt: skip
    joints, bend, axial = _joints(links, stiffness)
    spec = mujoco.MjSpec.from_file(str(mjcf_path("trunk.xml")))
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    bodies, starts = [spec.body("base")], [0.0]
    for j, z in enumerate(joints):
        body = bodies[-1].add_body(name=f"link{j}", pos=[0, 0, z - starts[-1]])
        for name, kind, axis, k in (
            ("axial", mujoco.mjtJoint.mjJNT_SLIDE, (0, 0, 1), axial[j]),
            ("bend_x", mujoco.mjtJoint.mjJNT_HINGE, (1, 0, 0), bend[j]),
            ("bend_y", mujoco.mjtJoint.mjJNT_HINGE, (0, 1, 0), bend[j]),
        ):
            joint = body.add_joint(name=f"{name}{j}", type=kind, axis=axis)
            joint.stiffness[0], joint.damping[0] = k, k * parameters["damping"]
        end = joints[j + 1] if j + 1 < links else geo.LENGTH
        _add_inertia(body, z, end, parameters["trunk_mass"], links)
        bodies.append(body)
        starts.append(z)
    _add_sites(spec, bodies, np.array(starts))
    _add_cables(spec, bodies, np.array(starts), parameters["cable_stiffness"])
    return spec


def _joints(links: int, stiffness: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places [m] of the joints, their bending [N m/rad] and axial [N/m] stiffness; each (links,)."""
    z = np.arange(geo.NECK_START[0], geo.NECK_END[-1], _GRID) + _GRID / 2
    neck = np.clip(np.searchsorted(geo.NECK_START, z, side="right") - 1, 0, None)
    inside = z < geo.NECK_END[neck]
    bend, axial = (np.where(inside, _GRID / geo.NECK_LENGTH / stiffness[name][neck], 0.0) for name in ("bend", "axial"))
    share = (np.cumsum(bend) - bend / 2) / bend.sum()
    joint = np.minimum((share * links).astype(int), links - 1)
    total = np.bincount(joint, bend, links)
    return np.bincount(joint, bend * z, links) / total, 1 / total, 1 / np.bincount(joint, axial, links)


def _add_inertia(body: mujoco.MjsBody, near: float, far: float, mass: float, links: int) -> None:
    """Of the trunk between two places, whose mass is spread evenly between the middles of necks."""
    ends = np.append(geo.NECK_MIDDLE, geo.LENGTH)
    inside = np.append(0.0, np.cumsum(geo.VERTEBRA_MASS_SHARE))
    body.mass = mass * float(np.diff(np.interp([near, far], ends, inside))[0])
    radius, length = geo.outer_radius((near + far) / 2), far - near
    body.explicitinertial = True
    body.ipos = [0, 0, length / 2]
    across = body.mass * (3 * radius**2 + length**2) / 12
    added = _ADDED_INERTIA / links * mass / prm.TRUNK_MASS.nominal
    body.inertia = np.array([across, across, body.mass * radius**2 / 2]) + added


def _place(starts: np.ndarray, z: float) -> int:
    """The link that has a point of the axis."""
    return int(np.searchsorted(starts, z, side="right") - 1)


def _add_sites(spec: mujoco.MjSpec, bodies: list[mujoco.MjsBody], starts: np.ndarray) -> None:
    for i, z in enumerate(geo.KEYPOINT_Z):
        k = _place(starts, z)
        bodies[k].add_site(spec.find_default("keypoint"), name=f"keypoint{i}", pos=[0, 0, z - starts[k]])


def _add_cables(spec: mujoco.MjSpec, bodies: list[mujoco.MjsBody], starts: np.ndarray, stiffness: float) -> None:
    """Eyelets on the faces of the necks; a servo as of the suite's cables, whose command is the displacement [m]."""
    eyelets = [geo.LONG_CABLE_EYELETS] * 4 + [geo.SHORT_CABLE_EYELETS] * 4
    radius = geo.CABLE_RADIUS[np.maximum(np.arange(eyelets[0]) - 1, 0) // 2]
    points = radius[:, None, None] * geo.CABLE_DIRECTIONS + geo.KEYPOINT_Z[:, None, None] * [0, 0, 1]  # (21, 8, 3)
    lengths = np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=2), axis=0)
    for c, name in enumerate(geo.CABLE_NAMES):
        tendon = spec.add_tendon(spec.find_default("cable"), name=name)
        for i, point in enumerate(points[: eyelets[c], c]):
            k = _place(starts, point[2])
            site = bodies[k].add_site(spec.find_default("eyelet"), name=f"{name}_{i}", pos=point - [0, 0, starts[k]])
            tendon.wrap_site(site.name)
        rest = lengths[eyelets[c] - 2, c]
        k_cable = stiffness * lengths[-1, 0] / rest  # of one cross-section
        actuator = spec.add_actuator(
            name=name, trntype=mujoco.mjtTrn.mjTRN_TENDON, target=name, gear=[-1, 0, 0, 0, 0, 0],
            forcelimited=True, forcerange=[0, trunk.MAX_TENSION],
            gaintype=mujoco.mjtGain.mjGAIN_FIXED, biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        )  # fmt: skip
        actuator.gainprm[0] = k_cable
        actuator.biasprm[:3] = -k_cable * rest, -k_cable, -k_cable * trunk.CABLE_DAMPING_TIME


def displacements(actions: np.ndarray, timestep: float, every: int) -> np.ndarray:
    """(T n, 8) commanded displacements [m] of the cables at the ends of n time steps [s] for each of (T, 8) actions."""
    pull, found = np.zeros(actions.shape[1]), []
    for action in np.repeat(actions, every, axis=0):
        pull = np.clip(pull + geo.CABLE_RATE * timestep * action, -geo.CABLE_LIMITS, geo.CABLE_LIMITS)
        found.append(pull)
    return np.array(found)


def simulate_chain(
    links: int, timestep: float, parameters: Mapping[str, float], pulls: np.ndarray, every: int = 1
) -> np.ndarray:
    """(1 + T / every, 21, 3) keypoints [m] before the first of T steps and after each of some of them.

    NaN from where the simulation diverges.

    Args:
        pulls: (T, 8) displacements [m] at the ends of the steps.
        every: how many steps are between keypoints; a divisor of T.
    """
    spec = build_chain(links, parameters)
    spec.option.timestep = timestep
    model = spec.compile()
    data = mujoco.MjData(model)
    points = [model.site(f"keypoint{i}").id for i in range(len(geo.KEYPOINT_Z))]
    mujoco.mj_forward(model, data)
    found = np.full((len(pulls) // every + 1, len(points), 3), np.nan)
    found[0] = data.site_xpos[points]
    bad = data.warning[mujoco.mjtWarning.mjWARN_BADQACC]
    for step, pull in enumerate(pulls, 1):
        data.ctrl[:] = pull
        mujoco.mj_step(model, data)
        if bad.number:
            break
        if step % every == 0:
            mujoco.mj_kinematics(model, data)
            found[step // every] = data.site_xpos[points]
    return found
