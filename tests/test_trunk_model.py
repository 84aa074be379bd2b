"""The two trunk models against known answers, the reference mesh's geometry, its linear FEM and its simulator; and what
the tasks' parameters change."""

import gymnasium
import mujoco
import numpy as np
import pytest

from benchmarks import trunk_fem
from soro_bench import parameters as prm
from soro_bench.envs.trunk_push import TrunkPushTask
from soro_bench.envs.trunk_reach import TrunkReachTask
from soro_bench.models import trunk_geometry as geo

TIP, OBJECT = slice(60, 63), slice(66, 69)
# y [mm] at which the reference's objects rest, 5 mm above the floor
REST_HEIGHT = {"TrunkPush-v0": -82.819, "TrunkLift-v0": -92.478}
IDLE = np.zeros(8, np.float32)
# mm along the trunk, read off the reference simulator's first observation
KEYPOINTS_AT_REST = (
    0, 21, 27, 38.485, 44.485, 55.971, 61.971, 73.456, 79.456, 90.941, 96.941, 108.427, 114.427, 125.912, 131.912,
    143.397, 149.397, 160.882, 166.882, 178.368, 184.368,
)  # fmt: skip
# linear FEM of the reference mesh at E = 4.5 MPa, nu = 0.45
LONG_CABLE_DEFLECTION, SHORT_CABLE_DEFLECTION = 41.6e-3, 24.2e-3  # m of the tip per N
COMPLIANCE_BY_POISSON = {0.40: 1.10, 0.425: 1.06, 0.45: 1.0, 0.475: 0.89, 0.49: 0.74}  # relative to 0.45
NECK_STIFFNESS = {  # at nu = 0.45: N m/rad, N/m, N m/rad
    "bend": (0.244, 0.196, 0.171, 0.184, 0.142, 0.0933, 0.0803, 0.0706, 0.0748, 0.0744),
    "axial": (41971, 34136, 33942, 26970, 23701, 19514, 16844, 18797, 19077, 20683),
    "twist": (0.342, 0.307, 0.270, 0.306, 0.360, 0.101, 0.087, 0.080, 0.080, 0.105),
}
# tip [mm] of the reference simulator after one action from the start: environment, action, tip
FIRST_ACTIONS = (
    ("TrunkPush-v0", 5, (-5.08, -17.37, 181.79)),
    ("TrunkPush-v0", 3, (10.12, -16.29, 181.40)),
    ("TrunkPush-v0", 15, (0.007, -12.13, 183.36)),
    ("TrunkReach-v0", 1, (-10.36, -16.37, 181.36)),
)
# mm. The bar is 2 mm: cable meets it in all four cases (1.7, 1.9, 0.8, 1.9 mm), flex in three (2.2, 1.7, 0.7, 1.7 mm).
FIRST_ACTION_TOLERANCE = {"flex": 2.5, "cable": 2.0}


def with_params(task, **params):
    """The task with its simulations given ``params``, one value for all or one each."""
    values = {**task.parameters.to_dict(task.parameters.nominal), **params}
    rows = np.column_stack([np.broadcast_to(values[name], task.num_envs) for name in task.parameters.names])
    task.sim.set_params(np.arange(task.num_envs), rows)
    return task


def tip_displacement(model, forces, **params):
    """(n, 3) tip displacement [m] at rest under constant cable forces (n, 8) [N], without gravity."""
    forces = np.asarray(forces, float)
    # without gravity a light trunk comes to rest in the same place as a heavy one, but sooner
    task = with_params(TrunkReachTask(len(forces), 2, model=model), trunk_mass=0.001, damping=0.02, **params)
    batch = task.sim.batch
    batch.expand("opt.gravity")[:] = 0
    batch.expand("actuator_gainprm")[:] = 0
    bias = batch.expand("actuator_biasprm")
    bias[:] = 0
    bias[:, :, 0] = forces
    batch.reset()
    batch.step(nstep=round(0.4 / task.model.opt.timestep), stage=mujoco.mjtStage.mjSTAGE_VEL)
    assert np.abs(batch.qvel).max() < 1e-4 * np.abs(forces).max(), "the trunk has not come to rest"
    return task.tip(np.arange(len(forces))) - [0, 0, geo.KEYPOINT_Z[-1]]


def nominal_model(model, **params):
    """A compiled model with ``params``, and a state of it at rest."""
    compiled = with_params(TrunkReachTask(model=model), **params).sim.batch.get_model(0)
    compiled.actuator_gainprm[:] = 0  # no cable pulls
    compiled.actuator_biasprm[:] = 0
    return compiled, mujoco.MjData(compiled)


def move_links(compiled, data, first, rotation_vector=(0, 0, 0), shift=(0, 0, 0)):
    """(10, 6) passive forces on flex vertebrae after those from ``first`` on moved as one about neck ``first``."""
    quaternion, matrix = np.zeros(4), np.zeros(9)
    angle = np.linalg.norm(rotation_vector)
    mujoco.mju_axisAngle2Quat(quaternion, np.asarray(rotation_vector) / max(angle, 1e-300), angle)
    mujoco.mju_quat2Mat(matrix, quaternion)
    mujoco.mj_resetData(compiled, data)
    poses = data.qpos.reshape(geo.NUM_NECKS, 7)[first:]
    pivot = np.array([0, 0, geo.NECK_MIDDLE[first]])
    poses[:, :3] = pivot + (poses[:, :3] - pivot) @ matrix.reshape(3, 3).T + shift
    poses[:, 3:] = quaternion
    mujoco.mj_forward(compiled, data)
    return data.qfrc_passive.reshape(geo.NUM_NECKS, 6).copy()


def test_keypoints_at_rest(model):
    """The keypoints of the straight trunk lie where the reference's do, within 0.01 mm."""
    task = TrunkReachTask(model=model)
    task.sim.batch.forward()
    expected = np.zeros((21, 3))
    expected[:, 2] = KEYPOINTS_AT_REST
    np.testing.assert_allclose(1e3 * task.keypoints([0])[0], expected, atol=0.01)


def test_moving_mass(model):
    """The moving links carry 587 of the mesh's 709 nodes, and the given trunk mass in that proportion."""
    compiled, _ = nominal_model(model, trunk_mass=0.3)
    moving = [compiled.body(f"vertebra{k}").mass[0] for k in range(geo.NUM_NECKS)]
    assert sum(moving) == pytest.approx(0.3 * 587 / 709)


def test_tip_deflection_per_newton(model):
    """A small pull on each cable bends the tip towards it by the FEM's 41.6 (long) or 24.2 (short) mm per N."""
    force = 0.05  # N
    displacement = tip_displacement(model, force * np.eye(8))[:, :2] / force
    expected = np.repeat([LONG_CABLE_DEFLECTION, SHORT_CABLE_DEFLECTION], 4)
    towards = np.einsum("ni,ni->n", displacement, geo.CABLE_DIRECTIONS[:, :2])
    np.testing.assert_allclose(towards, expected, rtol=0.03)
    np.testing.assert_allclose(np.linalg.norm(displacement, axis=1), towards, rtol=1e-3)


def test_deflection_depends_on_poisson_ratio(model):
    """The tip's compliance changes with Poisson's ratio as the FEM's bending compliance, within 5 %."""
    ratios = list(COMPLIANCE_BY_POISSON)
    forces = np.zeros((len(ratios), 8))
    forces[:, 0] = 0.05
    deflection = tip_displacement(model, forces, poisson_ratio=ratios)[:, 1]
    relative = deflection / deflection[ratios.index(0.45)]
    np.testing.assert_allclose(relative, list(COMPLIANCE_BY_POISSON.values()), rtol=0.05)


def test_statics_scale_with_young_modulus(model):
    """Forces and Young's modulus scaled together leave the shape at rest unchanged."""
    forces = np.zeros((3, 8))
    forces[:, 3] = np.array([0.1, 0.2, 0.3])
    tips = tip_displacement(model, forces, young_modulus=[2e6, 4e6, 6e6])
    np.testing.assert_allclose(tips[1:], tips[[0, 0]], atol=2e-6)


@pytest.mark.parametrize("row", range(3))
def test_stiffness_interpolation_meets_the_table(row):
    """At the tabulated Poisson's ratios the interpolated neck stiffness is the table's, proportional to E."""
    stiffness = geo.neck_stiffness(np.array([9e6]), geo.POISSON_RATIO_OF_TABLE[[row]])
    for kind, table in (("bend", geo.BEND), ("axial", geo.AXIAL), ("twist", geo.TWIST)):
        np.testing.assert_allclose(stiffness[kind][0], 2 * table[row], rtol=1e-12)


@pytest.mark.parametrize(("kind", "dof", "axis"), [("bend", 3, 0), ("bend", 4, 1), ("twist", 5, 2), ("axial", 2, None)])
def test_flex_neck_stiffness(kind, dof, axis):
    """A small motion of the links beyond each flex neck meets the FEM table's stiffness, within 0.1 %."""
    compiled, data = nominal_model("flex")
    step = 1e-6 if axis is None else 1e-4  # m or rad
    motion = {"shift": (0, 0, step)} if axis is None else {"rotation_vector": step * np.eye(3)[axis]}
    measured = [-move_links(compiled, data, k, **motion)[k, dof] / step for k in range(geo.NUM_NECKS)]
    np.testing.assert_allclose(measured, NECK_STIFFNESS[kind], rtol=1e-3)


@pytest.mark.parametrize(("kind", "joint"), [("bend", "bend_x"), ("bend", "bend_y"), ("axial", "axial")])
def test_cable_neck_stiffness(kind, joint):
    """A small motion of each joint of the cable chain meets the FEM table's stiffness, within 0.1 %."""
    compiled, data = nominal_model("cable")
    dofs = [compiled.joint(f"{joint}{k}").dofadr[0] for k in range(geo.NUM_NECKS)]
    step = 1e-6
    data.qpos[dofs] = step
    mujoco.mj_forward(compiled, data)
    np.testing.assert_allclose(-data.qfrc_passive[dofs] / step, NECK_STIFFNESS[kind], rtol=1e-3)


def test_rigid_motion_strains_no_flex_neck():
    """A large rigid motion of all vertebrae strains only the neck that joins them to the clamp."""
    compiled, data = nominal_model("flex")
    forces = move_links(compiled, data, 0, rotation_vector=(0.3, -0.5, 0.7), shift=(0.03, -0.02, 0.01))
    assert np.abs(forces[0]).max() > 1  # N: the motion is large
    assert np.abs(forces[1:]).max() < 1e-9


@pytest.mark.parametrize(("env_id", "action", "reference"), FIRST_ACTIONS)
def test_first_action_tip(model, env_id, action, reference):
    """After one action the tip is near the reference simulator's."""
    env = gymnasium.make(env_id, model=model)
    env.reset(seed=0)
    tip = 1e3 * env.step(action)[0][60:63]
    env.close()
    assert np.linalg.norm(tip - reference) < FIRST_ACTION_TOLERANCE[model]


def test_free_fall(model):
    """The cube falls by g h^2 n (n + 1) / 2 in n steps of length h, the semi-implicit Euler answer."""
    task = TrunkPushTask(model=model)
    ids = np.arange(1)
    task.reset(ids, [np.random.default_rng(0)], [{}])
    task.step(ids, np.array([15]))
    h = task.model.opt.timestep
    n = round(0.05 / h)
    assert task.object_position(ids)[0] == pytest.approx([0, -0.060 - 9.81 * h**2 * n * (n + 1) / 2, 0.1], abs=1e-9)


def test_tension_is_that_of_the_state_that_a_recording_has_beside_it(model):
    """What MuJoCo's servos pull with when they stop there, here while all cables move."""
    task = TrunkReachTask(1, 1, model=model, action="continuous")
    task.reset(np.arange(1), [np.random.default_rng(0)], [{}])
    for rates in np.random.default_rng(0).uniform(-1, 1, (6, 1, 8)):
        task.step(np.arange(1), rates)
    data = task.sim.batch.get_data(0)
    data.ctrl[:] = 0  # otherwise MuJoCo uses the displacement at the end of the next step
    mujoco.mj_fwdActuation(task.sim.batch.get_model(0), data)
    assert task.signals(np.arange(1))["tension"][0] == pytest.approx(data.actuator_force, rel=1e-9, abs=1e-9)
    assert data.actuator_force.max() > 1  # N


def test_tension_stays_within_limits(model):
    """Cables only pull, with at most 30 N, whatever is commanded."""
    task = TrunkReachTask(2, 2, model=model, action="continuous")
    ids, rng = np.arange(2), np.random.default_rng(0)
    task.reset(ids, [rng, rng], [{}, {}])
    tensions = []
    for _ in range(12):
        task.step(ids, np.sign(rng.standard_normal((2, 8))))
        tensions.append(task.signals(ids)["tension"])
    # the actuator's gear is -1, so its force is the tension
    assert np.min(tensions) == 0
    assert 1 < np.max(tensions) <= 30


# --- what the physical parameters of the tasks change ---


@pytest.mark.parametrize("env_id", REST_HEIGHT)
def test_object_comes_to_rest(make, env_id, model):
    """The dropped object rests where the reference's does, 5 mm above the floor, within 0.2 mm."""
    env = make(env_id, model=model, action="continuous")
    env.reset(seed=0, options={"params": {"trunk_mass": 0.001}})  # a light trunk does not sag onto the object
    for _ in range(20):
        observation, *_, info = env.step(IDLE)
    assert 1e3 * observation[67] == pytest.approx(REST_HEIGHT[env_id], abs=0.2)
    np.testing.assert_allclose(observation[[66, 68]], [0, 0.1] if "Push" in env_id else [-0.03, 0.12], atol=1e-4)
    if env_id == "TrunkLift-v0":
        assert info["elevation"] == pytest.approx(0, abs=2e-4)
        assert info["clearance"] == pytest.approx(0, abs=2e-4)


@pytest.mark.parametrize(("env_id", "size"), [("TrunkPush-v0", (35, 35, 35)), ("TrunkLift-v0", (56, 21, 35))])
def test_scene_parameters_reach_the_model(make, model, env_id, size):
    """The object is a solid box of the given mass, and every pair in contact has the given friction."""
    env = make(env_id, model=model)
    env.reset(seed=0, options={"params": {"cube_mass": 0.12, "friction": 0.7}})
    compiled = env.unwrapped.task.sim.batch.get_model(0)
    thing = compiled.body("object")
    x, y, z = (s / 1000 for s in size)
    assert thing.mass[0] == pytest.approx(0.12)
    moments = 0.12 / 12 * np.array([y**2 + z**2, x**2 + z**2, x**2 + y**2])
    np.testing.assert_allclose(np.sort(thing.inertia), np.sort(moments), rtol=1e-6)
    colliding = (compiled.geom_contype | compiled.geom_conaffinity) > 0
    np.testing.assert_array_equal(compiled.geom_friction[colliding, 0], 0.7)
    assert colliding.sum() >= 12  # ten vertebrae, the floor and the object


def test_wall_is_not_observed(make, model):
    """In TrunkLift walls that nothing touches give equal observations, wherever they stand that is allowed."""
    env = make("TrunkLift-v0", model=model)

    def rollout(offset):
        start, _ = env.reset(seed=0, options={"params": {"wall_offset": offset}})
        return np.array([start, *(env.step(2)[0] for _ in range(3))])

    nominal = rollout(0.0)
    for offset in (-0.2, 0.035):
        np.testing.assert_array_equal(rollout(offset), nominal)
        simulated = env.unwrapped.task.sim.batch.get_model(0)
        assert simulated.body("wall").pos[0] == pytest.approx(-0.1 + offset)


@pytest.mark.parametrize(
    ("env_id", "name", "value"),
    [
        ("TrunkReach-v0", "trunk_mass", 0.2), ("TrunkReach-v0", "poisson_ratio", 0.49),
        ("TrunkReach-v0", "young_modulus", 2e6), ("TrunkReach-v0", "damping", 0.2),
        ("TrunkReach-v0", "cable_stiffness", 5e3), ("TrunkPush-v0", "cube_mass", 0.5),
        ("TrunkPush-v0", "friction", 0.9), ("TrunkLift-v0", "cube_mass", 0.5), ("TrunkLift-v0", "friction", 0.1),
    ],
)  # fmt: skip
def test_every_parameter_matters(make, model, env_id, name, value):
    """Each parameter changes the motion: the tip's in Reach, the object's in the other tasks."""
    env = make(env_id, model=model)

    def last(params):
        env.reset(seed=0, options={"params": params})
        return [env.step(action)[0] for action in [2] * 8 + [1] * 8][-1]

    watched = TIP if env_id == "TrunkReach-v0" else OBJECT
    assert np.linalg.norm(last({name: value})[watched] - last({})[watched]) > 1e-4


def test_heavier_or_softer_trunk_sags_more(make, model):
    """A trunk of more mass, or of a lower Young's modulus, hangs lower."""
    env = make("TrunkReach-v0", model=model, action="continuous")

    def sag(**params):
        env.reset(seed=0, options={"params": params})
        return -np.mean([env.step(IDLE)[0][61] for _ in range(15)])

    nominal = sag()
    assert sag(trunk_mass=0.6) > 1.05 * nominal
    assert sag(young_modulus=3e6) > 1.05 * nominal


def box() -> tuple[np.ndarray, np.ndarray]:
    """Nodes and tetrahedra of a bar of 13 x 13 x 195 mm, five in each of four cubes along z."""
    corners = np.array([(x, y, z) for z in range(5) for x in (-1, 1) for y in (-1, 1)]) * [0.0065, 0.0065, 0.195 / 4]
    five = np.array([(0, 1, 2, 4), (3, 1, 2, 7), (5, 1, 4, 7), (6, 2, 4, 7), (1, 2, 4, 7)])
    return corners, np.concatenate([five + 4 * k for k in range(4)])


def test_finite_elements_do_not_resist_a_turn_and_resist_a_stretch_by_hooke() -> None:
    robot = trunk_fem.FiniteElementTrunk(*box())
    robot.x = robot.rest[:, [1, 2, 0]] + [0.1, 0.2, 0.3]  # a turn about (1, 1, 1)
    assert np.abs(robot.forces()[0]).max() < 1e-6
    robot.x = robot.rest * [1.0, 1.0, 1.01]  # as wide as before, so that the modulus is E (1 - nu) / (1 + nu)(1 - 2 nu)
    force = robot.forces()[0].reshape(-1, 3)
    young, nu = prm.YOUNG_MODULUS.nominal, prm.POISSON_RATIO.nominal
    modulus = young * (1 - nu) / (1 + nu) / (1 - 2 * nu)
    top = robot.rest[:, 2] > 0.19
    assert -force[top, 2].sum() == pytest.approx(0.01 * modulus * 0.013**2, rel=0.03)


def test_cables_of_the_finite_elements_pull_as_far_as_they_are_wanted_and_go_slack() -> None:
    robot = trunk_fem.FiniteElementTrunk(*box())
    robot.step(np.array([2e-4, *[-1e-3] * 7]))
    assert robot.displacements()[0] == pytest.approx(2e-4, rel=0.02)
    assert robot.tension[0] > 0.0 and not robot.tension[1:].any()


def test_a_mesh_is_read_as_it_was_written_and_refused_if_it_is_cut(tmp_path) -> None:
    nodes, tetrahedra = box()
    cells = np.insert(tetrahedra, 0, 4, axis=1).astype(">i4")
    head = b"# vtk DataFile Version 2.0\nbar\nBINARY\nDATASET UNSTRUCTURED_GRID\n"
    points = b"POINTS %d double\n" % len(nodes) + (1e3 * nodes).astype(">f8").tobytes()
    data = head + points + b"\nCELLS %d %d\n" % (len(cells), cells.size) + cells.tobytes()
    path = tmp_path / "bar.vtk"
    path.write_bytes(data)
    read = trunk_fem.read_mesh(path)
    assert read[0] == pytest.approx(nodes) and np.array_equal(read[1], tetrahedra)
    for wrong in (data[:-9], data[:40], data.replace(np.array(4, ">i4").tobytes(), np.array(-4, ">i4").tobytes())):
        path.write_bytes(wrong)
        with pytest.raises(ValueError, match=r"bar\.vtk is no mesh"):
            trunk_fem.read_mesh(path)
