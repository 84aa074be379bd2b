"""Robots of other discretisations and simulators: known answers of their statics, and what is recorded of them."""

import mujoco
import numpy as np
import pytest

from soro_bench.blind_benchmark import healthy, sorosim
from soro_bench.blind_benchmark.robot import Engine, simulate
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo
from soro_bench.models.trunk_chain import simulate_chain

NOMINAL = {p.name: p.nominal for p in trunk.PARAMETERS}
DAMPED = NOMINAL | {"damping": 0.2}  # comes to rest within 2 s
TIP = {"L0": 41.6, "S0": 24.2}  # mm/N, per force on a cable without gravity, finite elements on the reference mesh
SHORT = {"train": 18.5, "heldout": 1.0}


def bent(points):
    """Distance [mm] of the last keypoint from where it begins, at the end."""
    return 1e3 * np.linalg.norm(points[-1, -1] - points[0, -1])


def test_chain_of_many_links_hangs_like_the_suite_chain():
    """With slack cables, under its own weight."""
    suite = simulate(Engine("cable", 0.0025), DAMPED, [], np.r_[np.full((6, 8), -1.0), np.zeros((34, 8))])
    assert bent(simulate_chain(30, 0.0025, DAMPED, np.full((800, 8), -0.03))) == pytest.approx(
        bent(suite.points), rel=0.03
    )


@pytest.mark.parametrize("cable", TIP)
def test_rod_bends_as_finite_elements_do(cable):
    pytest.importorskip("elastica")
    from soro_bench.blind_benchmark.cosserat import Arm, ArmLaw

    class Pulled(ArmLaw):
        """0.02 N on one cable, the others slack, no gravity."""

        def install(self, arm):
            arm.gravity[:] = 0

        def command(self, arm, pull):
            return pull - 0.01

        def cables(self, arm):
            return [(geo.CABLE_NAMES.index(cable), 0.02, 0.0, 0.02, 0.02)]

    points = Arm(DAMPED, [Pulled()], timestep=2e-4).run(np.zeros((10000, 8)), 10000)
    assert bent(points) / 0.02 == pytest.approx(TIP[cable], rel=0.02)


def test_recordings_are_the_same_for_a_seed_and_differ_for_others():
    once, again, other = (healthy.build("cable", seed, SHORT) for seed in (7, 7, 8))
    assert once[1] == again[1] and once[1]["robot"] in healthy.ROBOTS["cable"]
    keypoints = [recordings["train"].signals["keypoints"].values for recordings, _ in (once, again, other)]
    assert np.array_equal(keypoints[0], keypoints[1]) and not np.array_equal(keypoints[0], keypoints[2])
    assert once[1]["parameters"] != other[1]["parameters"]


def test_every_robot_without_further_packages_moves_within_a_few_millimetres_of_the_accurate_one():
    rng = np.random.default_rng(0)
    actions = np.repeat(rng.uniform(-0.5, 0.5, (4, 8)), 5, axis=0)
    accurate = healthy.keypoints(Engine("flex", 0.005), NOMINAL, actions)
    for kind in ("cable", "flex", "links"):
        for robot in healthy.ROBOTS[kind].values():
            points = healthy.keypoints(robot, NOMINAL, actions)
            assert np.abs(points - accurate).max() > 0.0 and np.sqrt(np.square(points - accurate).mean()) < 0.008


def test_hidden_physics_in_a_rod_changes_its_motion_and_is_labelled():
    pytest.importorskip("elastica")
    from soro_bench.blind_benchmark.cosserat import Arm
    from soro_bench.blind_benchmark.cosserat_laws import HIDDEN

    pulls = np.outer(np.linspace(0, 0.005, 600), [1.0, 0.5, 0.4, 0.6] * 2)
    healthy_points = Arm(NOMINAL).run(pulls, 600)
    for name, draw in HIDDEN.items():
        hidden = draw(np.random.default_rng(0))
        assert not np.array_equal(Arm(NOMINAL, hidden.laws()).run(pulls, 600) + hidden.offset, healthy_points), name
        assert {"kind", "name"} <= hidden.location.keys() and hidden.parameters


def test_release_of_a_sorosim_rod_is_a_recording_of_its_model(tmp_path):
    """The model with the rod's own constants is at rest where the forces hold it; the map fits the recording."""
    columns = ["mid_force_x", "mid_force_y", "mid_force_z", "tip_force_x", "tip_force_y", "tip_force_z"]
    head = ["take", "material", "gravity_x", "gravity_y", "gravity_z", *columns, "true_damping_s"]
    values = ["release_steel_01", "steel", 0, 0, -9.81, 0, 0, 0, 0, 0.1, 0, 0.004]
    (tmp_path / "releases.csv").write_text(",".join(head) + "\n" + ",".join(map(str, values)) + "\n")
    names = ["t_s", *(f"{point}_{axis}_m" for point in ("mid", "tip") for axis in "xyz")]
    rows = [[0.005 * i, 0.3, 0, -0.01, 0.59, 0, -0.04] for i in range(1100)]
    text = "\n".join(",".join(map(str, row)) for row in [names, *rows])
    (tmp_path / "release_steel_01.csv").write_text(text + "\n")
    model, robot_map, recording, label = sorosim.build(tmp_path, 3)
    (tmp_path / "model.xml").write_text(model)
    (tmp_path / "map.toml").write_text(robot_map)
    measured = ModelRobot(tmp_path / "model.xml", tmp_path / "map.toml", threads=1).measured(recording)
    assert measured.actions[0].tolist() == [0, 0, 0, 0, 0.1, 0] and not measured.actions[1:].any()
    assert label["effects"] == [] and set(label["parameters"]) == {"stiffness", "mass", "damping"}
    compiled = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    data = mujoco.MjData(compiled)
    mujoco.mj_resetDataKeyframe(compiled, data, 0)
    data.ctrl[:] = measured.actions[0]
    start = data.qpos.copy()
    mujoco.mj_step(compiled, data, 100)
    assert np.abs(data.qpos - start).max() < 0.01
