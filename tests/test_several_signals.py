"""Robots with several signals, each in its own unit and with its own noise."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.candidates import late, terms
from soro_bench.diagnosis.commands import Diagnose
from soro_bench.diagnosis.data_quality.inspection import inspected
from soro_bench.diagnosis.data_quality.signals import explaining
from soro_bench.diagnosis.pipeline import unexplained
from soro_bench.diagnosis.render.summary import summary
from soro_bench.diagnosis.robots.model_file import ModelError
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.effects.effect import EVERY, Effect, Location
from soro_bench.recording.recording import Recording, RecordingError, Signal
from soro_bench.recording.simulated import record
from tests.arm import ARM, MAP, TRUTH

ANGLE, TORQUE = 5e-4, 1e-2  # rad and N m, of the noise
FRICTION = Effect("coulomb_friction", Location("joint", "hinge"), {"friction": 0.05})
SERVO = ARM.replace('kp="2" kv="0.05" forcerange="-1 1"', 'kp="200" kv="1"').replace('"0.005"', '"0.002"')
STIFF = SERVO.replace("</mujoco>", '<sensor><actuatorfrc name="gauge" actuator="motor"/></sensor></mujoco>')
BOTH = MAP + '[[signals]]\nname = "torque"\nsensors = ["gauge"]\nunit = "N m"\n'


@pytest.fixture
def robot_of(tmp_path):
    """Robots with a stiff servo, by their maps."""

    def robot(mapping: str = BOTH, shorter: int = 1) -> ModelRobot:
        (tmp_path / "arm.xml").write_text(STIFF)
        (tmp_path / "arm.toml").write_text(mapping)
        return ModelRobot(tmp_path / "arm.xml", tmp_path / "arm.toml", threads=1, shorter=shorter)

    return robot


def recording(robot: ModelRobot, hidden: list[Effect], seed: int = 0, steps: int = 150) -> Recording:
    """Of a robot with other parameters, whose friction shows in the torque only: it moves the angle by 0.25 mrad."""
    rng, time = np.random.default_rng(seed), 0.02 * np.arange(steps + 1)
    goals = sum(0.2 * np.sin(w * time[:-1] + p) for w, p in zip((0.9, 1.7, 2.3), rng.uniform(0, 6, 3), strict=True))
    (values,) = robot.simulate_all([drive(robot, goals[:, None])], TRUTH, [hidden])
    noise = rng.standard_normal((steps, 2)) * (ANGLE, TORQUE)
    angle, torque = (values[0] + noise).T
    angle = np.concatenate([goals[:1], angle])
    signals = {"angle": Signal(time, angle, "rad"), "torque": Signal(time[1:], torque, "N m")}
    return Recording({"goal": Signal(time[:-1], goals[:, None])}, signals)


def drive(robot: ModelRobot, goals: np.ndarray):
    """The drive of a robot that begins where its first goal is."""
    still = Signal(0.02 * np.arange(len(goals) + 1), np.full(len(goals) + 1, goals[0, 0]), "rad")
    return robot.measured(Recording({"goal": Signal(0.02 * np.arange(len(goals)), goals)}, {"angle": still})).drive


def test_what_shows_in_the_second_signal_only_is_named(robot_of):
    given = recording(robot_of(shorter=2), [FRICTION])
    result = diagnose(robot_of(), [given])
    assert [(each.name, str(each.location)) for each in result.findings if each.is_best] == [
        ("coulomb_friction", "joint hinge")
    ]
    (friction,) = (each for each in result.findings[0].estimates if each.name == "friction")
    assert friction.value == pytest.approx(0.05, rel=0.1)
    angle, torque = result.signals
    assert (angle.noise, torque.noise) == pytest.approx((ANGLE, TORQUE), rel=0.2)
    assert torque.unit == "N m" and TORQUE < torque.after < 0.6 * torque.before
    assert "torque: RMSE" in summary(result)


def test_a_signal_that_no_recording_has_changes_nothing_and_is_said(robot_of):
    given = recording(robot_of(), [])
    alone = Recording(given.commands, {"angle": given.signals["angle"]})
    plain, both = robot_of(MAP), robot_of()
    seen = inspected(alone, 0, both)
    both, _ = explaining(both, ((seen,), ()), DEFAULT)
    assert both.signals == plain.signals and both.shortened(2).signals == plain.signals
    assert [note for note in both.notes if note.startswith("torque is not explained")]
    points = [(np.array([0.3, -0.2, 0.1]), ()), (np.zeros(3), ())]
    rows = [unexplained(robot, (robot.measured(alone),), ANGLE).residuals(points) for robot in (plain, both)]
    assert np.array_equal(*rows)


def test_every_signal_has_its_own_noise_and_its_own_misfit(robot_of):
    robot = robot_of()
    problem = unexplained(robot, (robot.measured(recording(robot, [])),), ANGLE, others=(TORQUE,))
    residual = problem.residuals([(np.zeros(3), ())])[0]
    angle, torque = (problem.split(residual, which)[0] for which in (0, 1))
    assert np.array_equal(problem.joined([[angle], [torque]]), residual)
    off = problem.split(problem.measured - problem.simulated(robot, [(np.zeros(3), ())])[0], 1)[0]
    assert torque == pytest.approx(off / ANGLE)  # scaled, so that one noise is that of all
    assert problem.left_of_each(residual)[1] == pytest.approx(TORQUE * np.sqrt(np.mean(torque**2)))
    dominated = problem.allowing(2 * ANGLE, 50 * TORQUE)
    assert dominated.misfit_dominated
    assert dominated.sigmas == (ANGLE, 50 * TORQUE) and dominated.sensors == (ANGLE, TORQUE)
    angle_then, torque_then = (dominated.split(residual * problem.factor_to(dominated), which)[0] for which in (0, 1))
    assert np.array_equal(angle_then, angle) and torque_then == pytest.approx(torque / 50)


def test_sensors_have_faults_of_their_own(robot_of):
    robot = robot_of()
    found = terms(robot)
    at = {(one.name, one.location) for one in found if one.location.kind == "sensor"}
    delays = [location for name, location in at if name == "sensor_delay"]
    assert {each.name for each in delays} == {"angle", "torque", EVERY}
    assert [each.name for each in delays if late(robot, "sensor_delay", each)] == [EVERY]
    bias = Effect("sensor_bias", Location("sensor", "torque", 0), {"x": 0.1, "y": 0.0, "z": 0.0})
    goals = 0.3 * np.ones((20, 1))
    (values,) = robot.simulate_all([drive(robot, goals)], TRUTH.repeat(2, axis=0), [[], [bias]])
    assert np.allclose(values[1] - values[0], [0.0, 0.1])
    assert robot.unit_at("signal", bias.location) == "N m"


def test_bad_signals_are_refused(robot_of):
    twice = '[[signals]]\nname = "angle"\njoints = ["hinge"]\nunit = "rad"\n'
    with pytest.raises(ModelError, match=r"\[\[signals\]\] has 'angle' twice"):
        robot_of(MAP + twice)
    with pytest.raises(ModelError, match=r"\[signals\] needs a name, a unit"):
        robot_of(MAP + '[[signals]]\nname = "torque"\n')
    robot = robot_of()
    given = recording(robot, [])
    torque = given.signals["torque"]
    wrong = Recording(given.commands, {**given.signals, "torque": Signal(torque.time, torque.values, "N")})
    with pytest.raises(RecordingError, match="torque is in 'N', frame ''; expected are 'N m'"):
        diagnose(robot, [wrong])
    with pytest.raises(ValueError, match="TrunkReach-v0 has no signal 'heat'; it has keypoints"):
        SuiteRobot("TrunkReach-v0", threads=1, signals=["heat"])
    command = Diagnose((), Path("out"), model="arm.xml", map=Path("arm.toml"), signals=("torque",))
    with pytest.raises(ValueError, match="--signals is for --env"):
        command._robot()


def test_tensions_are_explained_where_they_are_asked_for():
    given = record("TrunkReach-v0", model="cable", steps=20, seed=1)
    alone, both = (SuiteRobot("TrunkReach-v0", threads=1, signals=names) for names in (None, ["tension"]))
    assert [(each.name, each.unit, each.shape) for each in both.others] == [("tension", "N", (8, 1))]
    assert both.shortened(2).others == both.accurate().others == both.others and alone.others == ()
    measured = both.measured(given)
    assert np.array_equal(measured.others[0][:, :, 0], given.signals["tension"].values[1:])
    nominal = np.array([[prior.nominal for prior in both.priors]])
    values, columns = (robot.simulate_all([measured.drive], nominal, [[]])[0] for robot in (alone, both))
    assert np.array_equal(columns[:, :, :63], values)
    assert np.allclose(columns[0, :, 63:], given.signals["tension"].values[1:], atol=0.05)


def test_of_a_walker_only_the_beginning_is_explained_and_that_is_said():
    """Its replays are slow: of 60 control steps, and not of all that an excitation needs."""
    robot = SuiteRobot("MultiGait-v0", threads=1)
    time, values = 0.6 * np.arange(201), np.zeros((201, 110, 3))
    commands = {"action": Signal(time[:-1], np.zeros((200, 3)))}
    about = {"env_id": "MultiGait-v0", "action": "continuous"}
    whole = Recording(commands, {"vertices": Signal(time, values, "m", "world")}, metadata=about)
    found = robot.measured(whole)
    assert found.values.shape == (60, 110, 3) and found.time[-1] == pytest.approx(36.0)
    assert found.notes == ("explained are the first 36 s of 120 s: replays of more take hours",)


def test_a_pushed_cube_is_explained_beside_the_trunk():
    """The same simulation leaves nothing of its pose, and a heavier cube shows in its own numbers."""
    robot = SuiteRobot("TrunkPush-v0", threads=1)
    given = record("TrunkPush-v0", "excitation", model="cable", steps=400, seed=1)
    problem = unexplained(robot, (robot.measured(given),), 5e-4, others=(5e-4, 5e-3))
    assert [each.name for each in robot.signals] == ["keypoints", "object_position", "object_quaternion"]
    heavy = Effect("payload", Location("body", "object"), {"mass": 0.2})
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    (values,) = robot.simulate_all([problem.recordings[0].drive], nominal.repeat(2, axis=0), [[], [heavy]])
    residual = problem.residuals([(np.zeros(len(robot.priors)), ())])[0]
    assert np.abs(residual).max() < 0.2
    change = np.abs(values[1] - values[0]).max(axis=0)
    assert change[63:66].max() > change[:63].max() and change[66:].max() > 1e-3
