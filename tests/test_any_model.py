"""Any MuJoCo model: where a recording begins, controls, time steps, ranges, elements and sensors of all kinds."""

import re
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.candidates import terms
from soro_bench.diagnosis.data_quality.inspection import inspected
from soro_bench.diagnosis.data_quality.responses import answered
from soro_bench.diagnosis.data_quality.signals import explaining
from soro_bench.diagnosis.preparation import unexplained
from soro_bench.diagnosis.robots.model_file import ModelError
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.effects.catalogue import MEASUREMENT, QUANTITIES
from soro_bench.effects.effect import EVERY, Effect, Location
from soro_bench.effects.measurement import distorted
from soro_bench.recording.recording import Recording, RecordingError, Signal
from tests.arm import HAND, HAND_MAP, NOMINAL, SIGNAL, goals, plain, with_initial

PENDULUM = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" damping="0.05" springref="0"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0 0 0.3" mass="0.2" contype="0" conaffinity="0"/></body></worldbody>
<keyframe><key name="left" qpos="-0.1"/><key name="right" qpos="0.1"/></keyframe></mujoco>"""
WITHOUT_COMMANDS = re.sub(r"\[commands.goal\]\n.*\n", "", HAND_MAP).replace(":arm", ":*")


def begun(robot: ModelRobot, recording: Recording) -> ModelRobot:
    """The robot after it has begun a recording."""
    robot._begin(NOMINAL, robot.measured(recording).start[None])
    return robot


# --- where a recording begins ---


def test_a_keyframe_is_where_the_robot_begins_and_what_holds_undriven_actuators(robot_of):
    robot = robot_of(with_initial('keyframe = "home"'))
    recording = Recording({"goal": goals([0.5] * 10)}, {"angle": Signal(0.02 * np.arange(11), np.full(11, 0.5), "rad")})
    actions = robot.actions(recording)
    assert actions.tolist() == [[0.5, 0.04]] * 10
    (values,) = robot.simulate(actions, NOMINAL, [()])
    expected = [state[0][0] for state in plain(HAND, actions, 10, keyframe=0)]
    np.testing.assert_allclose(values[:, 0, 0], expected, atol=1e-12)
    assert any("no command drives gripper; held at their controls in the keyframe" in note for note in robot.notes)


def test_keyframes_that_the_mapping_does_not_mention_are_said(robot_of):
    assert any("keyframes (home)" in note for note in robot_of(HAND_MAP).notes)
    assert not any("keyframes" in note for note in robot_of(with_initial('keyframe = ""')).notes)
    assert not any("keyframes" in note for note in robot_of(with_initial('keyframe = "#0"')).notes)
    with pytest.raises(ModelError, match="no keyframe 'rest'; it has home"):
        robot_of(with_initial('keyframe = "rest"'))


def test_free_and_ball_joints_and_velocities_begin_at_other_signals(robot_of):
    """On top of a keyframe, which says the rest."""
    text = """keyframe = "home"
[initial.signals.pose]
joints = ["free"]
[initial.signals.turned]
joints = ["ball"]
[initial.signals.speed]
velocities = ["hinge", "free"]
"""
    pose, turned = np.array([0.1, 2.0, 1.5, 0.6, 0.0, 0.8, 0.0]), np.array([0.8, 0.6, 0.0, 0.0])
    speed = np.arange(1.0, 8.0)
    time = 0.02 * np.arange(6)
    signals = {"angle": Signal(time, np.zeros(6), "rad")} | {
        name: Signal(time, np.tile(first, (6, 1)))
        for name, first in (("pose", pose), ("turned", turned), ("speed", speed))
    }
    recording = Recording({"goal": goals([0.0] * 5)}, signals)
    robot = begun(robot_of(with_initial(text)), recording)
    batch, model = robot.simulation.batch, robot.simulation.model
    np.testing.assert_allclose(batch.qpos[0], [0.5, 0.04, *turned, *pose])
    hinge, free = model.joint("hinge").dofadr[0], model.joint("free").dofadr[0]
    assert batch.qvel[0, hinge] == 1.0 and batch.qvel[0, free : free + 6].tolist() == speed[1:].tolist()
    late = replace(signals["pose"], time=time + 0.05)
    with pytest.raises(RecordingError, match=r"first sample of pose is 0\.05 s after the recording begins"):
        robot.measured(replace(recording, signals={**signals, "pose": late}))
    short = Signal(time, np.zeros((6, 3)))
    with pytest.raises(RecordingError, match=r"\[initial\] needs 7 numbers of speed; it has 3"):
        robot.measured(replace(recording, signals={**signals, "speed": short}))
    without = {name: signal for name, signal in signals.items() if name != "turned"}
    with pytest.raises(RecordingError, match=r"\[initial\] names the signal 'turned'; there are"):
        robot.measured(replace(recording, signals=without))


@pytest.mark.parametrize(
    ("text", "errors"), [('joints = ["hinge"]', 1), ('[initial.signals.speed]\nvelocities = ["hinge"]', 0)]
)
def test_the_noise_of_the_first_signal_is_in_a_start_at_that_signal_only(robot_of, text, errors):
    """Another signal may have as many numbers."""
    time, robot = 0.02 * np.arange(6), robot_of(with_initial(text))
    signals = {"angle": Signal(time, 0.1 * time, "rad"), "speed": Signal(time, np.full(6, 0.1))}
    measured = robot.measured(Recording({"goal": goals([0.0] * 5)}, signals))
    assert measured.start.size == 1
    assert unexplained(robot, (measured,), 1e-3).of_recordings == errors


@pytest.mark.parametrize(
    ("joint", "unit", "fault", "happened", "recorded"),
    [
        ("hinge", "rad", ("sensor_bias", {"x": 0.03}), 0.5, 0.53),
        ("hinge", "rad", ("marker_slip", {"x": 0.03, "time": 0.0}), 0.5, 0.53),
        ("ball", "1", ("frame_misalignment", {"about_x": 1.0}), (1, 0, 0, 0), (np.cos(0.5), np.sin(0.5), 0, 0)),
    ],
)
def test_a_replay_begins_where_the_robot_was_not_where_a_wrong_sensor_saw_it(
    robot_of, joint, unit, fault, happened, recorded
):
    name, values = fault
    fault = Effect(name, Location("sensor", "s"), {**{q.name: 0.0 for q in QUANTITIES[name]}, **values})
    mapping = HAND_MAP.replace(SIGNAL, f'name = "s"\njoints = ["{joint}"]\nunit = "{unit}"')
    robot, actions = robot_of(f'{mapping}[initial]\njoints = ["{joint}"]'), np.zeros((20, 2))
    (true,) = robot.simulate(actions, NOMINAL, [()], np.array(happened, float))
    (seen,) = robot.simulate(actions, NOMINAL, [[fault]], np.array(recorded, float))
    np.testing.assert_allclose(seen, distorted(MEASUREMENT, [fault], np.arange(20), true, "s"), atol=1e-9)


def test_a_replay_under_a_delay_begins_where_the_late_sensor_saw_the_robot_later(robot_of):
    """Somebody held and moved it, and let go when the commands began."""
    robot, time = robot_of(with_initial('joints = ["hinge"]')), 0.02 * np.arange(21)
    (true,) = robot.simulate(np.zeros((20, 2)), NOMINAL, [()], np.array([[0.5]]))
    late = np.concatenate([[0.3, 0.4, 0.5], true[:-2].ravel()])
    measured = robot.measured(Recording({"goal": goals([0.0] * 20)}, {"angle": Signal(time, late, "rad")}))
    fault = Effect("sensor_delay", Location("sensor", "angle"), {"delay": 0.04})
    ((seen,),) = robot.simulate_all([measured.drive], NOMINAL, [[fault]])
    np.testing.assert_allclose(seen.ravel()[1:], late[2:], atol=1e-9)


def test_a_part_of_a_recording_without_commands_is_replayed_for_its_own_time(robot_of):
    """Replays are remembered by their input, of which such a part has as little as the whole."""
    robot, time = robot_of(f'{WITHOUT_COMMANDS}[initial]\njoints = ["hinge"]', PENDULUM), 0.02 * np.arange(21)
    whole = robot.measured(Recording({}, {"angle": Signal(time, np.full(21, 0.5), "rad")}))
    found = [robot.simulate_all([each.drive], NOMINAL, [()])[0] for each in (whole, whole.first(7))]
    assert [values.shape[1] for values in found] == [20, 7]


def test_a_robot_settles_from_where_it_begins(robot_of):
    """A bistable one stays on the side of its keyframe."""
    mapping = WITHOUT_COMMANDS.replace("0.02", "0.02\nsettle = 20")
    for side, sign in (("left", -1.0), ("right", 1.0)):
        robot = robot_of(f'{mapping}[initial]\nkeyframe = "{side}"', PENDULUM)
        (values,) = robot.simulate(np.zeros((3, 0)), NOMINAL, [()])
        assert values[:, 0, 0] == pytest.approx(sign * np.pi, abs=1e-3)


# --- controls ---


def test_constant_controls_are_given_and_an_actuator_that_nothing_drives_is_said(robot_of):
    recording = Recording({"goal": goals([0.5] * 10)}, {"angle": Signal(0.02 * np.arange(11), np.full(11, 0.5), "rad")})
    robot = robot_of(f"{HAND_MAP}\n[fixed]\ngripper = 0.03")
    assert robot.actions(recording)[:, 1].tolist() == [0.03] * 10
    assert not any("drives" in note for note in robot.notes)
    assert robot_of(f'{HAND_MAP}\n[fixed]\n"grip*" = 0.03').actions(recording)[0, 1] == 0.03
    silent = robot_of(HAND_MAP)
    assert silent.actions(recording)[:, 1].tolist() == [0.0] * 10
    assert any(note.startswith("no command drives gripper; held at 0;") for note in silent.notes)
    with pytest.raises(ModelError, match=r"\[fixed\] gripper is 5; its ctrlrange is 0 to 0.1"):
        robot_of(f"{HAND_MAP}\n[fixed]\ngripper = 5")


@pytest.mark.parametrize(("off", "said"), [("gripper", ""), ("motor", "commands of motor do nothing")])
def test_commands_of_actuators_in_disabled_groups_are_told(robot_of, off, said):
    model = HAND.replace("<option ", '<option actuatorgroupdisable="3" ')
    model = model.replace(f'name="{off}"', f'name="{off}" group="3"')
    notes = "\n".join(robot_of(HAND_MAP, model).notes)
    assert said in notes and ("no command drives gripper" in notes) == (off != "gripper")
    assert ("do nothing" in notes) == bool(said)


def test_a_robot_of_constant_controls_needs_no_command(robot_of):
    mapping = re.sub(r"\[commands.goal\]\n.*\n", "[fixed]\nmotor = 0.2\n", HAND_MAP)
    falling = Recording({}, {"angle": Signal(0.02 * np.arange(20), np.linspace(0.0, 0.3, 20), "rad")})
    assert robot_of(mapping).measured(falling).actions[0].tolist() == [0.2, 0.0]


def test_commands_beyond_a_range_are_a_note_and_can_be_let_through(robot_of):
    asked = np.concatenate([np.full(30, 0.5), np.full(10, 1.5)])
    recording = Recording({"goal": goals(asked)}, {"angle": Signal(0.02 * np.arange(41), np.linspace(0, 1, 41), "rad")})
    clipped = robot_of(HAND_MAP)
    (note,) = clipped.measured(recording).notes
    assert "'goal' is from 0.5 to 1.5" in note and "'motor', -1 to 1 (25 % of the time)" in note
    ends = {}
    for name, mapping in (
        ("clipped", HAND_MAP),
        ("widened", HAND_MAP.replace('["motor"]', '["motor"]\nctrlrange = "widen"')),
        ("all", HAND_MAP.replace("[robot]", '[robot]\nctrlrange = "widen"')),
    ):
        robot = robot_of(mapping)
        measured = robot.measured(recording)
        assert bool(measured.notes) == (name == "clipped")
        ends[name] = robot.simulate(np.tile(measured.actions[-1:], (200, 1)), NOMINAL, [()])[0, -1, 0, 0]
        assert robot.spec().compile().actuator_ctrllimited[0] == (name == "clipped")
    assert ends["widened"] == ends["all"] > ends["clipped"] + 0.3


# --- time steps ---


def test_control_steps_of_30_hz_are_met_by_a_slightly_shorter_time_step(robot_of):
    step = 1 / 30
    mapping = HAND_MAP.replace("control_timestep = 0.02", f"control_timestep = {step!r}")
    robot = robot_of(mapping)
    timestep = robot.simulation.model.opt.timestep
    assert timestep == pytest.approx(step / 17) and timestep < 0.002
    assert any("0.0333333 s is no multiple of the model's time step, 0.002 s" in note for note in robot.notes)
    controls = 0.5 * np.sin(np.arange(60) / 5)[:, None] * [1.0, 0.0]
    (values,) = robot.simulate(controls, NOMINAL, [()])
    expected = [state[0][0] for state in plain(HAND, controls, 17, step / 17)]
    np.testing.assert_allclose(values[:, 0, 0], expected, atol=1e-12)
    assert robot.shortened(2).simulation.model.opt.timestep == pytest.approx(step / 34)
    assert robot.spec().option.timestep == timestep
    longer = robot_of(HAND_MAP.replace("control_timestep = 0.02", "control_timestep = 0.0015"))
    assert longer.simulation.model.opt.timestep == 0.0015


def test_a_time_step_that_fits_stays_as_it_is(robot_of):
    robot = robot_of(HAND_MAP)
    assert robot.simulation.model.opt.timestep == 0.002 and not any("time step" in note for note in robot.notes)


# --- elements ---


def test_a_payload_may_be_on_a_body_that_is_welded_to_one_that_moves(robot_of):
    """It adds its mass at the body's own centre of mass; a body that is fixed to the world, or by mocap, has none."""
    robot = robot_of(HAND_MAP)
    at = {one.location.name for one in terms(robot) if one.name == "payload"}
    assert at == {"arm", "hand", "finger", "ball", "box"}
    names = {one.location.name for one in terms(robot) if one.name == "viscous_friction"}
    assert names == {"hinge", "slide", EVERY}
    controls = 0.5 * np.sin(np.arange(60) / 5)[:, None] * [1.0, 0.0]
    (values,) = robot.simulate(controls, NOMINAL, [(Effect("payload", Location("body", "hand"), {"mass": 0.3}),)])
    hand, more = (
        '<geom size="0.02" mass="0.1"/>',
        '<inertial pos="0 0 0" mass="0.4" diaginertia="1.6e-5 1.6e-5 1.6e-5"/>',
    )
    heavier = HAND.replace(hand, more + hand)
    expected = [state[0][0] for state in plain(heavier, controls, 10)]
    np.testing.assert_allclose(values[:, 0, 0], expected, atol=1e-6)


def test_welded_bodies_that_share_a_centre_of_mass_or_have_none_carry_nothing(robot_of):
    more = '<body name="pad"><geom size="0.01" mass="0.01"/></body><body name="frame" pos="0 0 0.1"/>'
    more += '<body name="camera" pos="0 0 0.1"><geom size="0.01" mass="0.01"/></body>'
    model = HAND.replace('<site name="tip"/>', f'<site name="tip"/>{more}')
    at = {one.location.name for one in terms(robot_of(HAND_MAP, model)) if one.name == "payload"}
    assert at == {"arm", "hand", "camera", "finger", "ball", "box"}


def test_an_actuator_that_ignores_its_control_needs_none(robot_of):
    """Such as one that is a damper."""
    damper = '<general name="drag" joint="hinge" gainprm="0" biastype="affine" biasprm="0 0 -0.1"/>'
    model = HAND.replace("</actuator>", f"{damper}</actuator>").replace('ctrl="0.5 0.04"', 'ctrl="0.5 0.04 0"')
    robot = robot_of(f"{HAND_MAP}\n[fixed]\ngripper = 0.03", model)
    assert not any("drives" in note for note in robot.notes)


def test_unnamed_elements_are_called_by_number(robot_of):
    nameless = HAND.replace('<site name="tip"/>', "<site/>")
    mapping = HAND_MAP.replace(SIGNAL, 'name = "tip"\nsites = ["#0"]\nunit = "m"\nframe = "world"')
    nameless = re.sub(r"<accelerometer.*?/>", "", nameless)
    robot = robot_of(mapping, nameless)
    (values,) = robot.simulate(np.zeros((5, 2)), NOMINAL, [()])
    np.testing.assert_allclose(values[:, 0], [state[2] for state in plain(HAND, np.zeros((5, 2)), 10)], atol=1e-12)
    with pytest.raises(ModelError, match="no site 'tip'; it has #0, corner"):
        robot_of(mapping.replace('"#0"', '"tip"'), nameless)
    with pytest.raises(ModelError, match="no site '#7'"):
        robot_of(mapping.replace('"#0"', '"#7"'), nameless)


def test_origins_of_bodies_can_be_what_is_explained(robot_of):
    robot = robot_of(HAND_MAP.replace(SIGNAL, 'name = "hand"\nbodies = ["hand"]\nunit = "m"\nframe = "world"'))
    (values,) = robot.simulate(np.zeros((5, 2)), NOMINAL, [()])  # the site is at its origin
    np.testing.assert_allclose(values[:, 0], [state[2] for state in plain(HAND, np.zeros((5, 2)), 10)], atol=1e-12)


def test_a_proposed_motion_leaves_actuators_without_a_command_where_they_are(robot_of):
    robot = robot_of(f"{HAND_MAP}\n[fixed]\ngripper = 0.03")
    found = robot.commanded(np.tile([[1.0], [-1.0]], (1, 2)), np.zeros((3, 2)))
    assert found[:, 1].tolist() == [0.03, 0.03] and np.ptp(found[:, 0]) > 0.1


def test_an_actuator_of_several_controls_is_refused(robot_of):
    several = HAND.replace("<actuator>", '<actuator><pid name="both" joint="slide" kp="1"/>')
    with pytest.raises(ModelError, match="actuator 'both' has 2 controls; allowed is one"):
        robot_of(HAND_MAP, several)


def test_an_accurate_model_without_the_keyframe_is_named(robot_of, tmp_path):
    (tmp_path / "finer.xml").write_text(re.sub("<keyframe>.*</keyframe>", "", HAND))
    mapping = with_initial('keyframe = "home"').replace("[robot]", '[robot]\naccurate = "finer.xml"')
    with pytest.raises(ModelError, match=r"the accurate model .*finer.xml: .* the model has no keyframes"):
        robot_of(mapping).accurate()


def test_mocap_bodies_are_said_to_stay(robot_of):
    assert any("mocap bodies stay where the model has them: target" in note for note in robot_of(HAND_MAP).notes)


# --- sensors ---


def test_quaternions_are_explained_as_the_axes_of_their_frame(robot_of):
    """Whatever their sign: a recording may change it."""
    mapping = HAND_MAP.replace(SIGNAL, 'name = "turn"\nsensors = ["turn"]\nunit = "1"')
    states = plain(HAND, np.zeros((30, 2)), 10)
    quaternions = np.array([[1.0, 0, 0, 0], *(state[1][:4] for state in states)])
    flipped = quaternions * np.where(np.arange(31) % 3 == 1, -1.0, 1.0)[:, None]
    robot = robot_of(mapping)
    measured = robot.measured(Recording({"goal": goals([0.0] * 30)}, {"turn": Signal(0.02 * np.arange(31), flipped)}))
    assert measured.values.shape == (30, 3, 3)
    (values,) = robot.simulate(measured.actions, NOMINAL, [()])
    np.testing.assert_allclose(values, measured.values, atol=1e-12)
    assert np.ptp(values[:, 0, 2]) > 0.5
    as_joint = robot_of(mapping.replace('sensors = ["turn"]', 'joints = ["ball"]'))
    np.testing.assert_allclose(as_joint.simulate(measured.actions, NOMINAL, [()])[0], values, atol=1e-12)
    bad = Recording({"goal": goals([0.0] * 30)}, {"turn": Signal(0.02 * np.arange(31), 2 * flipped)})
    with pytest.raises(RecordingError, match="turn is no unit quaternion"):
        robot.measured(bad)


@pytest.mark.parametrize(("sensor", "entries", "unit"), [("felt", [4, 5, 6], "m/s^2"), ("torque", [7], "N m")])
def test_sensors_of_accelerations_and_forces_are_those_of_the_end_of_a_step(robot_of, sensor, entries, unit):
    robot = robot_of(HAND_MAP.replace(SIGNAL, f'name = "s"\nsensors = ["{sensor}"]\nunit = "{unit}"'))
    controls = 0.5 * np.sin(np.arange(40) / 5)[:, None] * [1.0, 0.0]
    (values,) = robot.simulate(controls, NOMINAL, [()])
    expected = np.array([state[1][entries] for state in plain(HAND, controls, 10)])
    np.testing.assert_allclose(values.reshape(40, -1), expected, atol=1e-5 * np.abs(expected).max())


def test_the_reach_of_signals_is_that_of_their_live_channels(robot_of):
    robot = robot_of(HAND_MAP + '[[signals]]\nname = "felt"\nsensors = ["felt"]\nunit = "m/s^2"')
    time, noise = 0.02 * np.arange(101), 1e-3 * np.random.default_rng(0).standard_normal((101, 3))
    felt = noise + np.stack([np.sin(time), 3.0 * np.sin(time), np.full(101, np.nan)], axis=1)
    signals = {"angle": Signal(time, np.sin(time), "rad"), "felt": Signal(time, felt[:, None], "m/s^2")}
    seen = inspected(Recording({"goal": goals([0.0] * 100)}, signals), 0, robot)
    angle, other = explaining(robot, ((seen,), ()), DEFAULT)[0].signals
    assert angle.reach == pytest.approx(np.ptp(np.sin(time[1:])))
    assert other.reach == pytest.approx(np.ptp(felt[1:, 1]))


def test_a_free_joint_is_no_signal(robot_of):
    with pytest.raises(ModelError, match="joint 'free' has 7 numbers of different units; give a site or sensors"):
        robot_of(HAND_MAP.replace('joints = ["hinge"]', 'joints = ["free"]'))


def test_a_wide_sensor_is_so_many_numbers(robot_of):
    """Here nine of the contact of a corner, with shape (T, 1, 9) in the recording."""
    model = re.sub("<accelerometer.*?/>", "", HAND).replace('contype="0" conaffinity="0"', "").replace(
        "<sensor>", '<sensor><contact name="touch" body1="box" data="force torque pos"/>').replace(
        "<worldbody>", '<worldbody><geom name="floor" type="plane" size="5 5 1" pos="0 0 0.85"/>')  # fmt: skip
    robot = robot_of(HAND_MAP.replace(SIGNAL, 'name = "touch"\nsensors = ["touch"]\nunit = "N"'), model)
    controls = np.zeros((20, 2))
    expected = np.array([state[1][:9] for state in plain(model, controls, 10)])
    signal = Signal(0.02 * np.arange(21), np.concatenate([expected[:1], expected])[:, None], "N")
    measured = robot.measured(Recording({"goal": goals(controls[:, 0])}, {"touch": signal}))
    assert robot.shape == (9, 1) and expected[-1, 0] == pytest.approx(9.81 / 4, rel=0.01)
    (values,) = robot.simulate(measured.actions, NOMINAL, [()])
    np.testing.assert_allclose(values, measured.values, atol=1e-3)


CART = """<mujoco><option timestep="0.005" integrator="implicitfast"/>
<worldbody><body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="2" {spring}/>
<geom size="0.05" mass="1" contype="0" conaffinity="0"/></body></worldbody>
<actuator><motor name="drive" joint="rail"/></actuator></mujoco>"""
RAIL = """[robot]
control_timestep = 0.02
[commands.force]
actuators = ["drive"]
[signal]
name = "position"
joints = ["rail"]
unit = "m"
[parameters.damping]
fields = ["dof_damping:rail"]
deviation = 0.3
"""


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_command_arrives_though_a_missing_spring_makes_the_model_drift(seed, tmp_path):
    """The model drifts as if the command that pushes it were one that never came."""
    robots = []
    for name, spring in (("real", 'stiffness="40"'), ("model", "")):
        (tmp_path / f"{name}.xml").write_text(CART.format(spring=spring))
        (tmp_path / f"{name}.toml").write_text(RAIL)
        robots.append(ModelRobot(tmp_path / f"{name}.xml", tmp_path / f"{name}.toml", threads=1))
    rng = np.random.default_rng(seed)
    force = np.repeat(rng.uniform(-5, 5, 20), 10)[:, None]
    (values,) = robots[0].simulate(force, np.ones((1, 1)), [()])
    values = np.concatenate([np.zeros(1), values.ravel()]) + 5e-4 * rng.standard_normal(len(force) + 1)
    time = 0.02 * np.arange(len(values))
    recording = Recording({"force": Signal(time[:-1], force)}, {"position": Signal(time, values, "m")})
    assert answered(robots[1].measured(recording), 0, robots[1]).findings == ()


def test_a_patched_model_may_have_nothing_left_of_what_a_parameter_scales(tmp_path):
    """A law took it away; a user's own model is refused."""
    for name, text in (("cart.xml", CART.format(spring="")), ("cart.toml", RAIL)):
        (tmp_path / name).write_text(text)
    robot = ModelRobot(tmp_path / "cart.xml", tmp_path / "cart.toml", threads=1)
    bare = CART.format(spring="").replace('damping="2"', 'damping="0"')
    assert robot.as_built(bare).priors[0].name == "damping"
    (tmp_path / "cart.xml").write_text(bare)
    with pytest.raises(ModelError, match="is 0 in the model, and no factor changes that"):
        ModelRobot(tmp_path / "cart.xml", tmp_path / "cart.toml", threads=1)
