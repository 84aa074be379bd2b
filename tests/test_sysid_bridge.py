"""What mujoco.sysid fits is diagnosed as it is, and gets its parameters back."""

import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs the train extra")
pytest.importorskip("tabulate", reason="needs the infer extra, mujoco[sysid]")

from mujoco import sysid

from soro_bench.diagnosis.result_parts import Estimate, ParameterEstimate
from soro_bench.diagnosis.robots.model_file import ModelError
from soro_bench.diagnosis.sysid import parameter_dict, recordings, sysid_robot
from soro_bench.recording.known import Known
from soro_bench.recording.recording import RecordingError
from tests.results import adequate
from tests.test_bad_input import says

ARM = """<mujoco model="arm"><option timestep="0.01" integrator="implicitfast"/>
<worldbody><body name="arm"><joint name="hinge" axis="0 1 0" damping="0.02" armature="0.001"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0.2 0 0" mass="0.1" contype="0" conaffinity="0"/></body></worldbody>
<actuator><position name="motor" joint="hinge" kp="2" kv="0.05"/></actuator>
<sensor><jointpos name="angle" joint="hinge"/><jointvel name="speed" joint="hinge"/></sensor></mujoco>"""
TRUTH = {"mass": 0.13, "damping": 0.03}
NOISE = 5e-4  # rad


def parameters():
    """The mass of the arm and the damping of its hinge, which are not as in the model."""
    found = sysid.ParameterDict()

    def mass(spec, parameter):
        spec.body("arm").geoms[0].mass = parameter.value[0]

    def damping(spec, parameter):
        spec.joint("hinge").damping[0] = parameter.value[0]

    found.add(sysid.Parameter("mass", 0.1, 0.05, 0.2, modifier=mass))
    found.add(sysid.Parameter("damping", 0.02, 0.005, 0.08, modifier=damping))
    found.add(sysid.Parameter("length", 0.2, 0.1, 0.3, frozen=True))
    return found


def sequences(friction=0.0, seed=0, steps=1200, interval=1, xml=ARM):
    """An arm with other parameters and dry friction, measured at all time steps; controls every so many of them."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec.from_string(xml)
    truth = parameters()
    truth.update_from_vector(np.array([TRUTH["mass"], TRUTH["damping"]]))
    real = sysid.apply_param_modifiers_spec(truth, spec.copy())
    real.joint("hinge").frictionloss = friction
    real.joint("hinge").solref_friction = [0.004, 1.0]
    real.option.timestep = 0.001
    model = real.compile()
    data = mujoco.MjData(model)
    data.qpos[0] = 0.2
    start = sysid.create_initial_state(spec.compile(), np.array([0.2]), np.zeros(1))
    corners = np.concatenate([[0.2], rng.uniform(-0.6, 0.6, steps // 30)])
    control = np.interp(np.arange(steps) / 30, np.arange(len(corners)), corners)
    control = np.interp(np.arange(steps), np.arange(0, steps, interval), control[::interval])
    measured = np.zeros((steps, 2))
    for i in range(steps):
        mujoco.mj_forward(model, data)
        measured[i] = data.sensordata
        data.ctrl[0] = control[i]
        mujoco.mj_step(model, data, 10)
    measured += NOISE * rng.standard_normal(measured.shape)
    times = 0.01 * np.arange(steps)
    mapping = sysid.TimeSeries.compute_all_sensor_mapping(spec.compile())
    return sysid.ModelSequences(
        "arm", spec, f"seed {seed}", start, sysid.TimeSeries(times[::interval], control[::interval, None]),
        sysid.TimeSeries(times, measured, mapping),
    )  # fmt: skip


PAGE = Path(__file__).parents[1] / "docs" / "how_to" / "use_your_own_robot.md"


@pytest.mark.skipif(not PAGE.exists(), reason="needs a checkout")
def test_friction_that_no_parameter_explains_is_named_and_the_parameters_come_back():
    """As the page says, with the arm of the page."""
    exec("\n".join(re.findall(r"(?ms)^```python\n(.*?)^```", PAGE.read_text())), page := {})
    result, given, fitted = (page[name] for name in ("result", "parameters", "fitted"))
    best = result.findings[0]
    assert result.verdict == "discrepancy"
    assert (best.name, best.location.kind, best.location.name) == ("coulomb_friction", "joint", "hinge")
    assert [each.estimate.unit for each in result.parameters] == ["kg"]
    assert fitted.keys() == ["mass"] and fitted["mass"].value[0] == pytest.approx(0.13, rel=0.05)
    assert given["mass"].value == 0.1  # those that were given stay as they are
    # mujoco.sysid takes them, and the patched model, which has the friction, leaves little
    before = residual(given, page["sequences"], page["spec"])
    assert residual(fitted, page["sequences"], page["patched"]) < 0.4 * before


def residual(given, measured, spec):
    """The norm of what mujoco.sysid leaves with a model; its sensors are those of a time step before."""
    (control,), (sensors,), (start,) = measured.control, measured.sensordata, measured.initial_state
    late = sysid.TimeSeries(sensors.times + 0.01, sensors.data, sensors.signal_mapping)
    again = sysid.ModelSequences("arm", spec, "again", start, control, late)
    found, *_ = sysid.build_residual_fn(models_sequences=[again])(given.as_vector(), given.copy())
    return np.linalg.norm(np.concatenate(found))


BOTH = {"mass": 0.12, "damping": 0.05}


def test_parameters_come_back_in_their_shapes_and_those_of_another_result_do_not():
    given = parameters()
    estimates = (ParameterEstimate(Estimate(name, value, "1"), 0.1, 0.5) for name, value in BOTH.items())
    result = replace(adequate(), parameters=tuple(estimates))
    fitted = parameter_dict(result, given)
    assert fitted["mass"].value == [0.12] and fitted["damping"].value == [0.05]
    assert fitted["length"].value == given["length"].value and fitted["length"].frozen
    given["damping"].frozen = True
    with pytest.raises(ValueError, match=says("the result has mass, damping", "the parameters are mass")):
        parameter_dict(result, given)


@pytest.mark.parametrize(("interval", "error"), [(1, 1e-9), (3, 5e-3)])
def test_the_robot_moves_as_mujoco_sysid_lets_it_move(interval, error):
    """Controls that come at every third time step are interpolated there and held here, but not late.

    MuJoCo computes sensors before it moves, so that mujoco.sysid has them a time step after what they show.
    """
    given, measured = parameters(), sequences(steps=300, interval=interval)
    robot = sysid_robot(given, [measured], threads=1)
    assert robot.control_timestep == pytest.approx(0.01 * interval) and robot.unit == "rad"
    (drive,) = (robot.measured(each) for each in recordings(robot, measured))
    (angles,) = robot.simulate(drive.actions, np.array([[0.15, 0.03]]), [()], drive.start)
    given.update_from_vector(np.array([0.15, 0.03]))
    _, (rolled,), _ = sysid.model_residual(
        given.as_vector(), given, lambda each: sysid.apply_param_modifiers(each, measured.spec),
        measured.measured_rollout, resample_true=True,
    )  # fmt: skip
    expected = np.interp(drive.time + 0.01, rolled.times, rolled.data[:, 0])
    assert np.abs(angles[:-2, 0, 0] - expected[:-2]).max() < error


def test_data_without_names_of_sensors_are_those_of_all_sensors_of_the_model():
    named = sequences(steps=10)
    (control,), (sensors,), (start,) = named.control, named.sensordata, named.initial_state
    bare = sysid.TimeSeries(sensors.times, sensors.data)
    unnamed = sysid.ModelSequences("arm", named.spec, "unnamed", start, control, bare)
    robot = sysid_robot(parameters(), [unnamed], threads=1)
    (one,), (other,) = recordings(robot, named), recordings(robot, unnamed)
    assert robot.sensors == ["angle"] and one.digest() == other.digest()


def test_a_model_that_has_its_parameters_already_is_not_given_them_again():
    robot = sysid_robot(parameters(), [sequences(steps=10)], threads=1)
    heavy = robot.as_built(ARM.replace('mass="0.1"', 'mass="0.15"'))
    for again in (heavy, heavy.shortened(2), heavy.knowing(Known({"mass": 0.1})), heavy.as_built()):
        assert again.model({"mass": 0.1, "damping": 0.02}, ()).body("arm").mass[0] == pytest.approx(0.15)


def test_every_number_of_a_parameter_is_fitted_and_fields_need_not_be_linear_in_it():
    """Mass and radius of gyration of a point: its inertia is the one times the square of the other."""

    def modifier(spec, parameter):
        mass, radius = parameter.value
        body = spec.body("arm")
        body.explicitinertial, body.mass, body.ipos = True, mass, [radius, 0.0, 0.0]
        body.inertia = 3 * [mass * radius**2]

    given = sysid.ParameterDict()
    given.add(sysid.Parameter("arm", [0.1, 0.1], [0.05, 0.05], [0.2, 0.2], modifier=modifier))
    robot = sysid_robot(given, [sequences(steps=10)], threads=1)
    assert [(prior.name, prior.nominal) for prior in robot.priors] == [("arm[0]", 0.1), ("arm[1]", 0.1)]
    model = robot.model({"arm[0]": 0.15, "arm[1]": 0.12}, ())
    assert model.body("arm").mass == pytest.approx(0.15)
    assert model.body("arm").inertia == pytest.approx(3 * [0.15 * 0.12**2])
    assert model.body("arm").ipos == pytest.approx([0.12, 0.0, 0.0])


def test_parameters_of_which_no_model_can_be_made_are_taken_half_as_far():
    """Up to 0.15 kg the modifier works."""

    def modifier(spec, parameter):
        if parameter.value[0] > 0.15:
            raise ValueError("too heavy")
        spec.body("arm").geoms[0].mass = parameter.value[0]

    given = sysid.ParameterDict()
    given.add(sysid.Parameter("mass", 0.1, 0.05, 0.2, modifier=modifier))
    robot = sysid_robot(given, [sequences(steps=10)], threads=1)
    assert robot.model({"mass": 0.14}, ()).body("arm").mass == pytest.approx(0.14)
    assert robot.model({"mass": 0.18}, ()).body("arm").mass == pytest.approx(0.14)


def without_modifier(given):
    given.add(sysid.Parameter("drag", 1.0, 0.5, 2.0))


def without_effect(given):
    given.add(sysid.Parameter("drag", 1.0, 0.5, 2.0, modifier=lambda spec, parameter: None))


def without_bounds(given):
    given["mass"].max_value = np.array([np.inf])


def of_time_steps(given):
    given.add(sysid.Parameter("step", 0.01, 0.005, 0.02, modifier=set_step))


def set_step(spec, parameter):
    spec.option.timestep = parameter.value[0]


def of_nothing(given):
    for each in given.values():
        each.frozen = True


@pytest.mark.parametrize(("change", "parts"), [
    (without_modifier, ("'drag' has no modifier", "give it one, or freeze it")),
    (without_effect, ("'drag' changes nothing in the model",)),
    (without_bounds, ("'mass' is 0.1, its bounds 0.05 and inf", "finite bounds")),
    (of_time_steps, ("'step' changes opt.timestep",)),
    (of_nothing, ("no parameter is free",)),
    (lambda given: given.add(sysid.Parameter("m", 1.0, 0.5, 2.0, modifier=lambda spec, p: spec.joint("none").damping)),
     ("the modifier of 'm' fails",)),
])  # fmt: skip
def test_a_parameter_that_no_diagnosis_can_fit_is_named(change, parts):
    change(given := parameters())
    with pytest.raises(ModelError, match=says(*parts)):
        sysid_robot(given, [sequences(steps=10)], threads=1)


def test_sensors_and_sequences_that_do_not_fit_are_named():
    measured = sequences(steps=10)
    with pytest.raises(ModelError, match=says("no measured sensor 'torque'", "angle, speed")):
        sysid_robot(parameters(), [measured], sensors=["torque"])
    with pytest.raises(ModelError, match=says("units rad, rad/s", "of one unit")):
        sysid_robot(parameters(), [measured], sensors=["angle", "speed"])
    with pytest.raises(ModelError, match=says("of several models", "one at a time")):
        sysid_robot(parameters(), [measured, sequences(steps=10, xml=ARM.replace('kp="2"', 'kp="3"'))])
    with pytest.raises(RecordingError, match="no sequence to explain"):
        sysid_robot(parameters(), [])
    assert sysid_robot(parameters(), [measured], sensors=["speed"], threads=1).unit == "rad/s"
