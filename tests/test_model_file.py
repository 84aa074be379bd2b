"""Files of MuJoCo models: all kinds are simulated as MuJoCo alone does, and what cannot be read is one clear line."""

import mujoco
import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.robots.model_file import ModelError
from soro_bench.models.simulation import quiet
from tests.hand import HAND, MAP, NOMINAL, SIGNAL, plain

_PENDULUM = """<mujoco><option timestep="0.005"/><default><geom contype="0" conaffinity="0"/></default><worldbody>{0}
<body name="a" pos="0 0 1"><joint name="hinge" axis="0 1 0" damping="0.1"/><geom type="capsule" size="0.02"
fromto="0 0 0 0.3 0 0" mass="1"/><site name="tip" pos="0.3 0 0"/>{1}</body></worldbody>{2}
<actuator><motor name="motor" joint="hinge" gear="2"/></actuator></mujoco>"""
_SECOND = '<body name="b" pos="0.3 0 0"><joint name="second" axis="0 1 0"/><geom size="0.05" mass="0.5"/></body>'
_SHEET = """<flexcomp name="sheet" type="grid" count="3 3 1" spacing="0.05 0.05 0.1" pos="0 1 1" dim="2" mass="0.1"
radius="0.001"><edge equality="true"/><pin id="0"/></flexcomp>"""
_COPIES = """<replicate count="3" offset="0 0.3 0"><body pos="0 1 1"><joint axis="0 1 0"/>
<geom size="0.05" pos="0.1 0 0"/></body></replicate>"""
_BOX = """<body pos="0.2 0 0.5"><freejoint/><geom type="box" size="0.1 0.1 0.1" contype="1" conaffinity="1"/></body>
<geom type="plane" size="1 1 1" contype="1" conaffinity="1"/>"""
_TENDON = """<tendon><fixed limited="true" range="-0.2 0.2" stiffness="3" damping="0.1"><joint joint="hinge" coef="1"/>
<joint joint="second" coef="1"/></fixed></tendon>"""
_GEARED = '<equality><joint joint1="second" joint2="hinge" polycoef="0 -1 0 0 0"/></equality>'
_LINKED = '<equality><connect body1="b" body2="world" anchor="0 0 0"/></equality>'
_MOCAP, _HELD = '<body name="m" mocap="true" pos="0.3 0 1"/>', '<equality><weld body1="m" body2="a"/></equality>'
_KINDS = {  # what is added to the world, to the arm, and beside the world
    "joint equality": ("", _SECOND, _GEARED),
    "connected": ("", _SECOND, _LINKED),
    "mocap weld": (_MOCAP, "", _HELD),
    "tendon": ("", _SECOND, _TENDON),
    "falling box": (_BOX, "", ""),
    "replicated": (_COPIES, "", ""),
    "flex": (_SHEET, "", ""),
}


@pytest.mark.parametrize("kind", _KINDS)
def test_models_of_all_kinds_move_as_mujoco_alone_moves_them(robot_of, kind):
    model = _PENDULUM.format(*_KINDS[kind])
    robot = robot_of(MAP.replace(":arm", ":a").replace(SIGNAL, 'name = "tip"\nsites = ["tip"]\nunit = "m"'), model)
    controls = np.sin(np.arange(50) / 5)[:, None]
    (values,) = robot.simulate(controls, NOMINAL, [()])
    np.testing.assert_allclose(values[:, 0], [state[2] for state in plain(model, controls, 4)], atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<worldbody>", '<extension><plugin plugin="no.such"/></extension><worldbody>', "install that plugin"),
        ("<worldbody>", '<asset><mesh name="m" file="there_is_none.stl"/></asset><worldbody>', "needs the files"),
        ("<worldbody>", '<include file="nowhere.xml"/><worldbody>', "needs the files"),
        ("<worldbody>", "<worldbody><bdy/>", "no MuJoCo model"),
    ],
)
def test_what_mujoco_says_of_a_model_is_one_line(robot_of, tmp_path, monkeypatch, old, new, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError, match=message) as caught:
        robot_of(MAP, HAND.replace(old, new, 1))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_mujoco_stays_quiet_until_the_last_caller_has_ended():
    """A handler that ends under the simulations of another thread would log their warnings to a file."""
    before = mujoco.get_mju_user_warning()
    with quiet():
        during = mujoco.get_mju_user_warning()
        with quiet():
            assert mujoco.get_mju_user_warning() is during
        assert mujoco.get_mju_user_warning() is during is not before
    assert mujoco.get_mju_user_warning() is before


def test_a_replay_that_diverges_logs_nothing(robot_of, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stiff = HAND.replace('kp="8" kv="0.5"', 'kp="1e7" kv="0"').replace("implicitfast", "Euler")
    assert np.isnan(robot_of(MAP, stiff).simulate(np.tile([1.0, 0.0], (50, 1)), NOMINAL, [()])).any()
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_a_model_in_which_nothing_moves_is_refused(robot_of):
    with pytest.raises(ModelError, match="nothing moves in it"):
        robot_of(MAP, "<mujoco><worldbody><body><geom size='1'/></body></worldbody></mujoco>")


def test_included_files_and_meshes_in_folders_are_found(robot_of, tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "meshes").mkdir()
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 0.1
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "".join(
        f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces
    )
    (tmp_path / "meshes" / "wedge.obj").write_text(text)
    (tmp_path / "parts" / "assets.xml").write_text('<mujoco><asset><mesh name="w" file="wedge.obj"/></asset></mujoco>')
    model = HAND.replace("<worldbody>", '<include file="parts/assets.xml"/><worldbody>', 1)
    model = model.replace('angle="degree"', 'angle="degree" meshdir="meshes"')
    hand, site = 'size="0.02" mass="0.1"/>', '<site name="tip"/>'
    robot = robot_of(MAP, model.replace(hand + site, f'type="mesh" mesh="w" mass="0.1"/>{site}'))
    assert np.isfinite(robot.simulate(np.zeros((5, 2)), NOMINAL, [()])).all()
