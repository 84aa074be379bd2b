"""The diagnosis of a robot that is given by its MuJoCo model."""

import json
import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")

from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.assembly.model_export import exported
from soro_bench.diagnosis.baseline import baseline
from soro_bench.diagnosis.candidates import terms
from soro_bench.diagnosis.estimation.fit import Guess, fitted
from soro_bench.diagnosis.estimation.problem import SimulationError
from soro_bench.diagnosis.preparation import unexplained
from soro_bench.diagnosis.render import render
from soro_bench.diagnosis.robots.model_file import ModelError
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.priors import Baseline
from soro_bench.diagnosis.selection.moves import simplify
from soro_bench.effects.catalogue import QUANTITIES
from soro_bench.effects.effect import Effect, Location
from soro_bench.recording.parquet import save
from soro_bench.recording.recording import Signal
from tests.arm import ARM, MAP, TRUTH, recording, says

SURE = {"inertia": 0.0, "damping": 0.0, "zero": 0.0}  # standard deviations of what was found


@pytest.mark.parametrize(
    ("name", "parameters"),
    [("coulomb_friction", {"friction": 0.05}), ("actuator_delay", {"delay": 0.03})],
)
def test_a_hidden_effect_of_any_model_is_named_at_its_place(paths, tmp_path, request, name, parameters):
    location = Location("joint", "hinge") if name == "coulomb_friction" else Location("actuator", "motor")
    if name == "coulomb_friction":
        result = request.getfixturevalue("diagnosed_arm").result
    else:
        hidden = [Effect(name, location, parameters)]
        heldout = [recording(paths, hidden, 1)]
        result = diagnose(ModelRobot(*paths, threads=1), [recording(paths, hidden, 0)], heldout)
    assert result.verdict == "discrepancy"
    first, (quantity, truth) = result.findings[0], next(iter(parameters.items()))
    assert (first.name, first.location) == (name, location)
    (found,) = (each for each in first.estimates if each.name == quantity)
    assert found.value == pytest.approx(truth, rel=0.1) and found.low < found.value < found.high
    assert result.heldout.explained > 0.9 and result.heldout.after < 0.5 * result.heldout.before
    render(result, tmp_path / "report")
    assert (tmp_path / "report" / "comparison.rrd").stat().st_size > 0
    known = baseline(tmp_path / "report")
    assert [(e.name, e.location) for e in known.effects] == [(name, location)]
    values = {each.estimate.name: each.estimate.value for each in result.parameters}
    assert known.parameters == pytest.approx(values, rel=1e-6)


def test_what_is_known_of_a_robot_stays_and_what_has_changed_is_named(paths):
    friction = Effect("coulomb_friction", Location("joint", "hinge"), {"friction": 0.05, "presliding": 5e-4})
    delay = Effect("actuator_delay", Location("actuator", "motor"), {"delay": 0.03})
    known = Baseline(dict(zip(SURE, TRUTH[0].tolist(), strict=True)), SURE, (friction,))
    found = diagnose(ModelRobot(*paths, threads=1, baseline=known), [recording(paths, [friction, delay], 0)])
    assert found.best.names == ("actuator_delay",)
    assert [each.estimate.value for each in found.parameters] == pytest.approx(TRUTH[0], rel=0.05)


def test_what_was_hardly_known_before_is_hardly_known_now(paths):
    values = {"inertia": 1.1, "damping": 1.0, "zero": 0.0}
    first = ModelRobot(*paths, threads=1).priors
    again = ModelRobot(*paths, threads=1, baseline=Baseline(values, {"inertia": 1e-4, "damping": 0.1, "zero": 9.0}, ()))
    deviations = [prior.deviation for prior in again.priors]
    assert [prior.nominal for prior in again.priors] == [1.1, 1.0, 0.0]
    assert deviations == pytest.approx([0.1 * first[0].deviation, np.hypot(0.1, 0.03), first[2].deviation], rel=1e-3)


def test_a_known_effect_is_simulated_and_not_possible_twice(paths):
    friction = Effect("coulomb_friction", Location("joint", "hinge"), {"friction": 0.05})
    knows = ModelRobot(
        *paths, threads=1, baseline=Baseline({"inertia": 1.0, "damping": 1.0, "zero": 0.0}, SURE, (friction,))
    )
    goals = np.repeat([[0.5], [-0.5]], 10, axis=0)
    nominal = np.array([[1.0, 1.0, 0.0]])
    values = [r.simulate(goals, nominal, [e]) for r, e in ((knows, ()), (ModelRobot(*paths, threads=1), (friction,)))]
    assert np.array_equal(*values)
    assert not knows.accepts([friction])


def test_a_finer_model_without_a_place_for_what_is_known_is_left_out(paths):
    model, mapping = paths
    string = '<tendon><fixed name="string"><joint joint="hinge" coef="0.1"/></fixed></tendon>'
    model.with_name("finer.xml").write_text(ARM)
    model.write_text(ARM.replace("<actuator>", f"{string}<actuator>"))
    mapping.write_text(MAP.replace("[robot]", '[robot]\naccurate = "finer.xml"'))
    friction = Effect("coulomb_friction", Location("tendon", "string"), {"friction": 0.1, "presliding": 1e-3})
    values = {"inertia": 1.0, "damping": 1.0, "zero": 0.0}
    plain, knows = (
        ModelRobot(*paths, threads=1, baseline=Baseline(values, SURE, known)) for known in ((), (friction,))
    )
    assert [len(robot.refined()) for robot in (plain, knows)] == [2, 1]


@pytest.mark.parametrize(
    ("known", "message"),
    [
        (Baseline({"inertia": 1.0}, SURE, ()), "the baseline diagnosis has"),
        (Baseline({"inertia": -1.0, "damping": 1.0, "zero": 0.0}, SURE, ()), "inertia = -1.0 in the baseline"),
        (Baseline({"inertia": np.nan, "damping": 1.0, "zero": 0.0}, SURE, ()), "inertia = nan in the baseline"),
        (
            Baseline(
                {"inertia": 1.0, "damping": 1.0, "zero": 0.0},
                SURE,
                (Effect("coulomb_friction", Location("joint", "elbow"), {"friction": 1.0}),),
            ),
            "effects that this robot cannot have",
        ),
    ],
)
def test_what_was_found_of_another_robot_is_refused(paths, known, message):
    with pytest.raises(ValueError, match=message):
        ModelRobot(*paths, threads=1, baseline=known)


REPORT = '{"schema": "soro-bench/diagnosis/1", "parameters": {"a": {"value": %s, "ci90": [0, 1]}}}'


@pytest.mark.parametrize("text", ["[]", "{}", '{"schema": "soro-bench/diagnosis/1"}', "{",
                                  '{"schema": "soro-bench/diagnosis/1", "parameters": {"a": 1}}',
                                  REPORT % "true", REPORT % '"1"', REPORT % ("9" * 400)])  # fmt: skip
def test_a_file_that_is_no_report_is_refused(tmp_path, text):
    (tmp_path / "report.json").write_text(text)
    with pytest.raises(ValueError, match=r"report\.json"):
        baseline(tmp_path)


def test_the_command_says_of_an_arm_without_hidden_effects_that_nothing_is_missing(paths, tmp_path, call):
    """And finds its parameters."""
    model, mapping = paths
    save(recording(paths, [], 0), tmp_path / "train.parquet")
    said = call("diagnose", tmp_path / "train.parquet", "--model", model, "--map", mapping, "--out", tmp_path / "out")
    assert "no discrepancy detected" in said
    report = json.loads((tmp_path / "out" / "result.json").read_text())
    assert report["verdict"] == "adequate"
    values = [each["estimate"]["value"] for each in report["parameters"]]
    assert values == pytest.approx(TRUTH[0], rel=0.05)


def test_parameters_change_the_fields_they_name(paths):
    robot = ModelRobot(*paths, threads=1)
    robot.simulation.set_params(np.arange(64), np.tile([2.0, 3.0, 0.5], (64, 1)))
    batch, model = robot.simulation.batch, robot.simulation.model
    arm = model.body("arm").id
    assert batch.expand("body_mass")[0, arm] == 2 * model.body_mass[arm]
    assert np.array_equal(batch.expand("body_inertia")[0, arm], 2 * model.body_inertia[arm])
    assert batch.expand("dof_damping")[0].ravel()[0] == 3 * model.dof_damping.ravel()[0]
    assert batch.expand("actuator_biasprm")[0, 0, 0] == 0.5
    assert batch.expand("actuator_biasprm")[0, 0, 1] == model.actuator_biasprm[0, 1]


def test_a_star_in_a_name_stands_for_any_text(paths):
    model, mapping = paths
    mapping.write_text(MAP.replace("dof_damping:hinge", "dof_damping:h*e").replace("body_mass:arm", "body_mass:a*"))
    robot = ModelRobot(model, mapping, threads=1)
    robot.simulation.set_params(np.arange(64), np.tile([2.0, 3.0, 0.5], (64, 1)))
    batch, compiled = robot.simulation.batch, robot.simulation.model
    assert batch.expand("dof_damping")[0].ravel()[0] == 3 * compiled.dof_damping.ravel()[0]
    assert batch.expand("body_mass")[0].tolist() == (compiled.body_mass * [1, 2]).tolist()


def test_only_effects_that_a_model_can_have_are_suspects(paths):
    """Not an actuator without a limit of force that saturates, nor friction of a tendon with a spring of its own."""
    model, mapping = paths
    names = {(one.name, one.location.kind) for one in terms(ModelRobot(model, mapping, threads=1))}
    assert {("actuator_saturation", "actuator"), ("coulomb_friction", "joint")} <= names
    tendon = '<tendon><fixed name="belt" stiffness="1"><joint joint="hinge" coef="1"/></fixed></tendon></mujoco>'
    model.write_text(ARM.replace(' forcerange="-1 1"', "").replace("</mujoco>", tendon))
    names = {(one.name, one.location.kind) for one in terms(ModelRobot(model, mapping, threads=1))}
    assert ("actuator_saturation", "actuator") not in names
    assert ("coulomb_friction", "tendon") not in names
    assert {("coulomb_friction", "joint"), ("viscous_friction", "tendon")} <= names


def test_what_touches_and_flexes_of_any_model_are_places(paths):
    """But not a law of sliding at what never moves."""
    model, mapping = paths
    sheet = '<flexcomp name="sheet" type="grid" count="3 3 1" spacing="0.02 0.02 0.1" dim="2" mass="0.01" radius="1e-3"'
    sheet += '><elasticity young="1e5" thickness="1e-3" elastic2d="both"/><pin id="0"/></flexcomp>'
    touching = ARM.replace('contype="0" conaffinity="0"', 'name="skin"').replace("implicitfast", "Euler")
    discretisation = f'<worldbody><geom name="floor" type="plane" size="1 1 1" pos="0 0 -0.1"/>{sheet}'
    model.write_text(touching.replace("<worldbody>", discretisation))
    found = {(one.name, one.location.kind, one.location.name) for one in terms(ModelRobot(model, mapping, threads=1))}
    assert {("stiction", "geom", "skin"), ("adhesion", "geom", "floor"), ("local_stiffness", "flex", "sheet")} <= found
    assert {name for _, kind, name in found if kind == "joint"} == {"hinge"}
    assert ("stiction", "geom", "floor") not in found


def test_what_has_no_name_is_a_place_too(paths):
    """By its number and the model's name, which tells it from what another model has there."""
    model, mapping = paths
    finger = '<body pos="0.2 0 0"><joint axis="0 1 0"/><geom size="0.01" mass="0.01"/></body></body></worldbody>'
    model.write_text(ARM.replace("</body></worldbody>", finger))
    found = {(one.name, str(one.location)) for one in terms(ModelRobot(model, mapping, threads=1))}
    assert {("coulomb_friction", "joint 1 of arm"), ("payload", "body 2 of arm")} <= found


def test_laws_of_all_bodies_together_are_tried_at_a_single_one(paths):
    found = {(one.name, str(one.location)) for one in terms(ModelRobot(*paths, threads=1))}
    assert ("fluid_drag", "body arm") in found


def test_a_robot_settles_under_its_first_command(paths):
    model, mapping = paths
    mapping.write_text(MAP.replace("control_timestep = 0.02", "control_timestep = 0.02\nsettle = 5.0"))
    robot = ModelRobot(model, mapping, threads=1)
    (values,) = robot.simulate(np.full((10, 1), 0.3), np.array([[1.0, 1.0, 0.0]]), [()])
    assert np.ptp(values) < 1e-6


def test_a_robot_that_diverges_while_it_settles_has_no_numbers(paths):
    """And the one beside it has. Damping with the wrong sign throws the arm about."""
    model, mapping = paths
    mapping.write_text(MAP.replace("control_timestep = 0.02", "control_timestep = 0.02\nsettle = 5.0"))
    robot = ModelRobot(model, mapping, threads=1)
    still, thrown = robot.simulate(np.full((10, 1), 0.3), np.array([[1.0, 1.0, 0.0], [1.0, -1e6, 0.0]]), [(), ()])
    assert np.isfinite(still).all()
    assert np.isnan(thrown).all()


@pytest.mark.parametrize("damping", [0.01, 5.0, 20.0])
def test_two_masses_on_springs_hang_at_rest_after_two_seconds(tmp_path, damping):
    """Those that would swing for minutes, and those that creep, as damping brakes them before they are there."""
    (model := tmp_path / "springs.xml").write_text(
        """<mujoco><worldbody><body><joint name="upper" type="slide"
    axis="0 0 -1" stiffness="100" damping="DAMPING"/><geom size="0.05" mass="1"/><body><joint name="lower" type="slide"
    axis="0 0 -1" stiffness="50" damping="DAMPING"/><geom size="0.05" mass="0.5"/></body></body></worldbody></mujoco>
    """.replace("DAMPING", str(damping))
    )
    (mapping := tmp_path / "map.toml").write_text("""[robot]
control_timestep = 0.02
settle = 2.0
relax = true
[signal]
name = "way"
joints = ["upper", "lower"]
unit = "m"
[parameters.stiffness]
fields = ["jnt_stiffness:*"]
deviation = 0.2""")
    (values,) = ModelRobot(model, mapping, threads=1).simulate(np.zeros((50, 0)), np.ones((1, 1)), [()])
    assert values[..., 0] == pytest.approx(np.tile([1.5 * 9.81 / 100, 0.5 * 9.81 / 50], (50, 1)), rel=0.01)


def test_a_setpoint_that_is_held_does_not_move_wherever_it_is(paths):
    goals = np.concatenate([np.full(10, 0.5), np.linspace(0.5, 0.1, 9), np.full(5, 0.1), np.linspace(0.1, 0.3, 5)])
    rates = ModelRobot(*paths, threads=1).rates(goals[:, None])[:, 0]
    assert (np.sign(rates) == [0] * 11 + [-1] * 8 + [0] * 6 + [1] * 4).all()


@pytest.mark.parametrize("later", [0.0007, 0.019])
def test_commands_with_time_stamps_of_their_own_are_not_late(paths, later):
    """Control steps begin with the first command."""
    given, robot = recording(paths, [], 0), ModelRobot(*paths, threads=1)
    goal = given.commands["goal"]
    logged = replace(given, commands={"goal": Signal(goal.time + later, goal.values)})
    assert robot.actions(logged)[: len(goal.values)].tolist() == robot.actions(given)[: len(goal.values)].tolist()
    assert robot.measured(logged).time == pytest.approx(robot.measured(given).time)


@pytest.mark.parametrize(
    ("sensor", "shape"),
    [
        ('<jointpos name="s" joint="hinge"/>', (1, 1)),
        ('<jointvel name="s" joint="hinge"/>', (1, 1)),
        ('<velocimeter name="s" site="tip"/>', (1, 3)),
    ],
)
def test_sensors_can_be_what_is_explained(paths, sensor, shape):
    model, mapping = paths
    model.write_text(ARM.replace("</mujoco>", f"<sensor>{sensor}</sensor></mujoco>"))
    mapping.write_text(MAP.replace('joints = ["hinge"]\nunit', 'sensors = ["s"]\nunit', 1).split("[initial]")[0]
                       + "[parameters" + MAP.split("[parameters", 1)[1])  # fmt: skip
    robot = ModelRobot(model, mapping, threads=1)
    assert robot.shape == shape
    bias = next(one for one in terms(robot) if one.name == "sensor_bias")
    assert bias.size == shape[1]
    goals = np.full((20, 1), 0.4)
    (values,) = robot.simulate(goals, np.array([[1.0, 1.0, 0.0]]), [()])
    assert np.isfinite(values).all() and np.ptp(values) > 0.01


def test_one_number_of_a_sensor_can_be_what_is_explained(paths):
    model, mapping = paths
    sensors = '<sensor><accelerometer name="imu" site="tip"/><jointvel name="rate" joint="hinge"/></sensor>'
    model.write_text(ARM.replace("</mujoco>", f"{sensors}</mujoco>"))
    text = MAP.split("[initial]")[0] + "[parameters" + MAP.split("[parameters", 1)[1]

    def replay(names):
        mapping.write_text(text.replace('joints = ["hinge"]\nunit', f"sensors = {names}\nunit", 1))
        robot = ModelRobot(model, mapping, threads=1)
        return robot.simulate(np.full((20, 1), 0.4), np.array([[1.0, 1.0, 0.0]]), [()])[0]

    every, rate = replay('["imu"]'), replay('["rate"]')
    some = replay('["imu[2]", "rate", "imu[0]"]')
    assert np.array_equal(some[..., 0], np.concatenate([every[:, 0, [2]], rate[:, 0], every[:, 0, [0]]], axis=1))
    with pytest.raises(ModelError, match=says("imu[3]", "0 to 2")):
        replay('["imu[3]"]')


STARTS = """[initial]
keyframe = "bent"
[parameters.bend]
fields = ["key_qpos[0]:bent"]
add = true
unit = "rad"
deviation = 0.1
[parameters.rate]
fields = ["key_qvel[0]:bent"]
deviation = 0.3
"""


def test_where_a_recording_begins_can_be_a_parameter(paths):
    """And the model that is written begins there."""
    model, mapping = paths
    model.write_text(ARM.replace("</mujoco>", '<keyframe><key name="bent" qpos="0.2" qvel="1"/></keyframe></mujoco>'))
    mapping.write_text(MAP.split("[initial]")[0] + STARTS)
    robot = ModelRobot(model, mapping, threads=1)
    (replayed,) = robot.simulate(np.zeros((1, 1)), np.array([[0.3, 2.0]]), [()])[:, 0, 0, 0]
    data = mujoco.MjData(plain := mujoco.MjModel.from_xml_path(str(model)))
    data.qpos[:], data.qvel[:] = 0.2 + 0.3, 2.0
    mujoco.mj_step(plain, data, 4)  # a control step
    assert replayed == pytest.approx(data.qpos[0], abs=1e-6)
    key = mujoco.MjModel.from_xml_string(exported(robot, {"bend": 0.3, "rate": 2.0}, []).xml).key("bent")
    assert (key.qpos[0], key.qvel[0]) == (pytest.approx(0.5), pytest.approx(2.0))


@pytest.mark.parametrize(("old", "new", "named"), [
    ('keyframe = "bent"', "", "keyframe = 'bent' in [initial]"), ("key_qpos", "key_ctrl", "key_ctrl is no number"),
])  # fmt: skip
def test_a_keyframe_that_no_recording_begins_at_is_no_parameter(paths, old, new, named):
    model, mapping = paths
    model.write_text(ARM.replace("</mujoco>", '<keyframe><key name="bent" qpos="0.2" qvel="1"/></keyframe></mujoco>'))
    mapping.write_text(MAP.split("[initial]")[0] + STARTS.replace(old, new))
    with pytest.raises(ModelError, match=says(named)):
        ModelRobot(model, mapping, threads=1)


def test_channels_are_those_of_all_actuators(paths):
    """Whether they have a name or not, and whatever their tendons are called."""
    model, mapping = paths
    string = '<tendon><fixed name="string"><joint joint="hinge" coef="0.1"/></fixed></tendon>'
    more = '<actuator><position joint="hinge"/><position name="pull" tendon="string"/>'
    model.write_text(ARM.replace("<actuator>", string + more))
    robot = ModelRobot(model, mapping, threads=1)
    assert robot.channels == ["actuator 0 of arm", "actuator pull", "actuator motor"]
    places = [
        Location("actuator", "motor"),
        Location("tendon", "string"),
        Location("actuator", "*"),
        Location("joint", "hinge"),
    ]
    assert [robot.channel(location) for location in places] == [2, 1, None, None]
    assert robot.commanded(np.eye(3), np.ones((1, 3))).shape == (3, 3)


def test_a_proposed_motion_of_controls_that_are_rates_comes_back(paths):
    model, mapping = paths
    valve = '<intvelocity name="motor" joint="hinge" kp="2" actrange="-1 1" ctrllimited="true" ctrlrange="-0.3 0.3"/>'
    model.write_text(re.sub(r"<actuator>.*</actuator>", f"<actuator>{valve}</actuator>", ARM, flags=re.DOTALL))
    rates = np.repeat([[1.0], [-1.0]], 50, axis=0)
    goals = ModelRobot(model, mapping, threads=1).commanded(rates, rates)
    assert goals.sum() == pytest.approx(0.0, abs=1e-9)
    assert np.abs(goals).max() == pytest.approx(0.3)
    assert 0.02 * np.abs(np.cumsum(goals)).max() <= 0.6 + 1e-9


def test_a_proposed_motion_is_within_the_range_of_an_actuator(paths):
    model, mapping = paths
    model.write_text(ARM.replace('kp="2"', 'kp="2" ctrllimited="true" ctrlrange="5 10"'))
    rates, recorded = np.array([[1.0], [1.0], [-1.0], [-1.0], [-1.0], [-1.0]]), np.array([[0.0], [20.0]])
    goals = ModelRobot(model, mapping, threads=1).commanded(rates, recorded)
    assert goals[:, 0] == pytest.approx([7.25, 8.0, 7.25, 6.5, 5.75, 5.0])


def test_a_proposed_motion_of_an_actuator_without_a_range_is_within_what_was_recorded(paths):
    goals = ModelRobot(*paths, threads=1).commanded(np.array([[1.0], [-1.0], [-1.0]]), np.array([[200.0], [300.0]]))
    assert goals[:, 0] == pytest.approx([260.0, 230.0, 200.0])


def test_a_delayed_servo_stays_where_its_first_command_holds_it(paths):
    model, mapping = paths
    mapping.write_text(MAP.replace("control_timestep = 0.02", "control_timestep = 0.02\nsettle = 5.0"))
    delay = Effect("actuator_delay", Location("actuator", "motor"), {"delay": 0.1})
    robot, parameters = ModelRobot(model, mapping, threads=1), np.array([[1.0, 1.0, 0.0]])
    mapping.write_text(MAP)
    begun = ModelRobot(model, mapping, threads=1)
    goals = np.full((5, 1), 0.3)
    (rest,) = robot.simulate(goals, parameters, [()])
    (values,) = begun.simulate(goals, parameters, [(delay,)], rest[-1])
    assert np.abs(values - rest[-1]).max() < 1e-4


@pytest.mark.parametrize(
    ("name", "kind", "place", "unit"),
    [
        ("compliance", "actuator", "motor", "rad/(N m)"),
        ("pretension", "actuator", "motor", "rad"),
        ("coulomb_friction", "joint", "hinge", "N m"),
        ("sensor_bias", "sensor", "angle", "rad"),
    ],
)
def test_units_are_those_of_what_turns(paths, name, kind, place, unit):
    assert ModelRobot(*paths, threads=1).unit_at(QUANTITIES[name][0].unit, Location(kind, place)) == unit


@pytest.mark.parametrize("stiffness", [20000, 500])
def test_a_simulation_that_diverges_is_no_physics(paths, stiffness, tmp_path, monkeypatch, capfd):
    """With any time step; or with that of the model only (of 5 ms: beyond 220 N m/rad), by which effects are screened,
    while fits have half of it. MuJoCo's warnings of every replay are not shown."""
    monkeypatch.chdir(tmp_path)
    given = recording(paths, [], 0)
    stiff = ARM.replace('kp="2" kv="0.05" forcerange="-1 1"', f'kp="{stiffness}"').replace(
        'damping="0.02"', 'damping="1e-9"'
    )
    paths[0].write_text(stiff.replace("implicitfast", "Euler"))
    with pytest.raises(SimulationError, match=r"the simulation by arm diverges .* s into recording 1"):
        diagnose(ModelRobot(*paths, threads=1), [given])
    assert "WARNING" not in "".join(capfd.readouterr()) and not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_a_delay_of_everything_measured_is_compared_with_one_of_everything_commanded(paths):
    """Whichever the search meets first, and on whatever else."""
    hidden = [Effect("actuator_delay", Location("actuator", "motor"), {"delay": 0.16})]
    found = diagnose(ModelRobot(*paths, threads=1), [recording(paths, hidden, 2)])
    names = [each.names for each in found.hypotheses]
    assert ("actuator_delay",) in names
    assert ("sensor_delay",) in names
    assert found.findings[0].indistinguishable_from


def test_a_plainer_law_than_that_of_the_best_hypothesis_is_tried_where_that_ended(paths):
    """Dry friction, where friction of a loaded gear, which has it too, leads."""
    hidden = [Effect("coulomb_friction", Location("joint", "hinge"), {"friction": 0.05, "presliding": 0.0005})]
    robot = ModelRobot(*paths, threads=1)
    problem = unexplained(robot, (robot.measured(recording(paths, hidden, 0)),), 5e-4)
    candidates = terms(robot)
    gear = next(s for s in candidates if s.name == "gear_friction")
    (best,) = fitted(problem, [Guess(np.concatenate([np.zeros(3), gear.simulated]), (gear,))], (0.3,), 0)
    found = {h.terms[-1].name: h for h in simplify(problem, best, [best], candidates, 0)}
    assert {"coulomb_friction", "stribeck_friction"} <= found.keys() and "gear_friction" not in found
    assert found["coulomb_friction"].cost < best.cost
    assert found["coulomb_friction"].effects(3)[0].parameters["friction"] == pytest.approx(0.05, rel=0.2)
