"""Known answers of the laws, on an arm of one hinge with a motor and a servo."""

import mujoco
import numpy as np
import pytest

from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.effects.catalogue import ALL, PHYSICS
from soro_bench.effects.effect import Effect, EffectError, Location, effect_from
from soro_bench.effects.elements import Elements, instrument
from soro_bench.files import mjcf_path
from soro_bench.models.simulation import Simulation
from soro_bench.parameters import ParameterSet

SERVO = """<mujoco><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="arm"><joint name="hinge" axis="0 1 0" damping="0.01"/>
<geom name="arm" type="capsule" size="0.01" fromto="0 0 0 0.2 0 0" mass="0.1" contype="0" conaffinity="0"/></body>
</worldbody><actuator><motor name="motor" joint="hinge" ctrlrange="-5 5" ctrllimited="true"/>
<general name="servo" joint="hinge" gainprm="4" biasprm="0 -4 -0.1" biastype="affine" forcerange="-9 9"
forcelimited="true" ctrlrange="-2 2" ctrllimited="true"/></actuator></mujoco>"""
WEIGHT = 0.0981  # N m about the hinge, of the arm held level


def servo(effects, timestep=0.002):
    spec = mujoco.MjSpec.from_string(SERVO)
    spec.option.timestep = timestep
    return Simulation(instrument(spec).compile(), ParameterSet(), (), 1, 1, effects)


def turn(sim, torque=0.0, angle=None, steps=500, velocity=0.0):
    """(steps,) angles of the hinge under a torque, or with the servo commanded to angles."""
    ids, batch = np.arange(1), sim.batch
    batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    batch.qvel[:] = velocity
    sim.begin(ids)
    if angle is None:
        sim.set_params(ids, np.zeros((1, 0)))
        batch.expand("actuator_gainprm")[:, 1] = 0
        batch.expand("actuator_biasprm")[:, 1] = 0
    way = []
    for step in range(steps):
        batch.ctrl[0] = [torque(step) if callable(torque) else torque, 0.0 if angle is None else angle(step)]
        sim.step(ids, 1)
        way.append(batch.qpos[0, 0])
    return np.array(way)


def on_hinge(name, **values):
    return Effect(name, Location("joint", "hinge"), values)


def flat(sim):
    """Without weight."""
    sim.batch.expand("opt.gravity")[:] = 0
    return sim


def test_strain_counts_from_where_a_spring_is_at_rest():
    """0.1 N m bend a spring of 1 N m/rad that stiffens as much wherever it rests."""
    ways = []
    for rest in (0.0, 1.0):
        spec = mujoco.MjSpec.from_string(
            SERVO.replace("damping=", f'stiffness="1" springref="{57.29578 * rest}" damping=')
        )
        sim = Simulation(instrument(spec).compile(), ParameterSet(), (), 1, 1, [on_hinge("stiffening", beta=20.0)])
        ways.append(turn(flat(sim), torque=0.1, steps=4000)[-1] - rest)
    assert ways[1] == pytest.approx(ways[0], rel=1e-3)
    assert 0.05 < ways[0] < 0.1


def test_springs_of_the_effects_do_nothing_whatever_the_defaults_of_tendons_are():
    plain, given = [
        Simulation(instrument(mujoco.MjSpec.from_string(text)).compile(), ParameterSet(), (), 1, 1, [])
        for text in (SERVO, SERVO.replace("<worldbody>", '<default><tendon stiffness="7" damping="3" '
                                          'frictionloss="0.1"/></default><worldbody>', 1))
    ]  # fmt: skip
    assert np.array_equal(*(turn(flat(sim), torque=0.1) for sim in (plain, given)))


def test_dry_friction_sticks_below_its_force_and_slips_above():
    sim = flat(servo([on_hinge("coulomb_friction", friction=0.5)]))
    held = turn(sim, torque=lambda step: 0.49 * min(1.0, step / 3000), steps=6000)
    assert np.ptp(held[5000:]) < 1e-9  # it does not creep
    assert abs(held[-1]) < 0.003
    assert turn(sim, torque=lambda step: 0.51 * min(1.0, step / 3000), steps=6000)[-1] > 0.1


def test_dry_friction_stops_what_is_moving_without_adding_energy():
    sim = flat(servo([on_hinge("coulomb_friction", friction=0.05, presliding=2e-3)]))
    way = turn(sim, velocity=2.0, steps=1500)
    speed = np.abs(np.diff(way)) / 0.002
    inertia = 0.1 * 0.2**2 / 3  # of the arm about the hinge, nearly
    assert speed[-1] < 1e-3
    assert way.max() == pytest.approx(0.5 * inertia * 2.0**2 / 0.05, rel=0.25)  # less by the damper
    assert (np.diff(np.maximum.accumulate(speed[::-1])[::-1]) <= 1e-9).all()


def test_hysteresis_needs_a_spring_and_creep_relaxes_with_its_time_constant():
    spec = mujoco.MjSpec.from_string(SERVO)
    spec.joint("hinge").stiffness[0] = 1.0
    creep = on_hinge("viscoelastic_creep", ratio=1.0, time_constant=0.5)
    sim = flat(Simulation(instrument(spec).compile(), ParameterSet(), (), 1, 1, [creep]))
    way = turn(sim, torque=1.0, steps=4000)
    # standard linear solid: 1/(k + k1) at once, 1/k in the end, with the time constant (k + k1)/k * tau
    times = 0.002 * np.arange(1, 4001)
    expected = 1.0 - 0.5 * np.exp(-times / (2 * 0.5))
    assert np.abs(way - expected)[1000:].max() < 0.01


def test_hysteresis_is_a_spring_beside_that_slips():
    """A torque of 0.6 on springs of 1 and 0.5, of which the latter slips at 0.1 rad: (0.6 - 0.05) / 1."""
    spec = mujoco.MjSpec.from_string(SERVO)
    spec.joint("hinge").stiffness[0] = 1.0
    law = on_hinge("hysteresis", ratio=0.5, yield_strain=0.1)
    sim = flat(Simulation(instrument(spec).compile(), ParameterSet(), (), 1, 1, [law]))
    way = turn(sim, torque=lambda step: 0.6 * min(1.0, step / 4000), steps=6000)
    assert way[-1] == pytest.approx(0.55, rel=0.02)


@pytest.mark.parametrize(("torque", "slips"), [(0.45, False), (0.55, True)])
def test_stribeck_friction_breaks_away_at_its_static_level(torque, slips):
    law = on_hinge("stribeck_friction", friction=0.25, static_ratio=2.0, stribeck_velocity=0.02, presliding=2e-3)
    sim = flat(servo([law]))
    assert (turn(sim, torque=lambda step: torque * min(1.0, step / 3000), steps=6000)[-1] > 0.1) == slips


def test_a_lag_is_behind_a_ramp_by_its_time_constant():
    ramp = 0.001 * np.arange(1500)  # 0.5 rad/s
    late = flat(servo([Effect("actuator_lag", Location("actuator", "servo"), {"time_constant": 0.05})]))
    way = turn(late, angle=lambda step: ramp[step], steps=1500)
    expected = turn(flat(servo(())), angle=lambda step: ramp[step] - 0.025, steps=1500)
    assert way[-500:] == pytest.approx(expected[-500:], abs=1e-3)


def test_laws_that_scale_one_spring_all_act():
    spec = mujoco.MjSpec.from_string(SERVO)
    spec.joint("hinge").stiffness[0] = 1.0
    laws = [on_hinge("stiffening", beta=4.0), on_hinge("stiffness_drift", rate=-3.0),
            on_hinge("plastic_set", softness=5.0, share=0.5)]  # fmt: skip
    sim = flat(Simulation(instrument(spec).compile(), ParameterSet(), (), 1, 1, laws))
    angle = turn(sim, torque=lambda step: 0.3 * min(1.0, step / 4000), steps=5000)[-1]
    # one half of the spring has yielded at 0.2 rad; the other has lost a half after 10 s
    assert 0.5 * 0.2 + 0.25 * angle * (1.0 + 4.0 * angle**2) == pytest.approx(0.3, rel=1e-3)


def test_viscous_friction_is_a_damper():
    sim = flat(servo([on_hinge("viscous_friction", damping=0.09)]))
    way = turn(sim, torque=0.1, steps=3000)
    assert np.diff(way)[-1] / 0.002 == pytest.approx(0.1 / (0.01 + 0.09), rel=1e-3)


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("actuator_gain", {"gain": 0.5}, lambda u: 0.5 * u),
        ("pretension", {"offset": 0.1}, lambda u: u + 0.1),
        ("actuator_deadband", {"width": 0.2}, lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.2, 0)),
        ("actuator_delay", {"delay": 0.1}, lambda u: np.concatenate([np.zeros(50), u[:-50]])),
    ],
)
def test_a_command_law_gives_what_other_commands_would(name, values, expected):
    commands = 0.8 * np.sin(2 * np.pi * 0.002 * np.arange(1000))
    changed = expected(commands)
    faulty = flat(servo([Effect(name, Location("actuator", "servo"), values)]))
    way = turn(faulty, angle=lambda step: commands[step], steps=1000)
    assert way == pytest.approx(turn(flat(servo(())), angle=lambda step: changed[step], steps=1000), abs=1e-12)


def test_backlash_waits_for_its_width_after_a_reversal():
    sim = flat(servo([Effect("backlash", Location("actuator", "servo"), {"width": 0.2})]))
    ramp = np.concatenate([np.linspace(0, 1, 2000), np.linspace(1, 0, 2000)])
    way = turn(sim, angle=lambda step: ramp[step], steps=4000)
    assert way[1999] == pytest.approx(0.9, abs=0.02)
    assert np.abs(way[2300] - 0.9) < 0.005  # the command has come back by 0.15 only
    assert way[3999] == pytest.approx(0.1, abs=0.02)


def on_servo(name, **values):
    return Effect(name, Location("actuator", "servo"), values)


def test_a_compliant_servo_gives_way_by_its_compliance_more():
    """The arm hangs level on a servo of 4 N m/rad with 0.5 rad/(N m) behind it: 0.25 + 0.5 rad per N m."""
    sim = flat(servo([on_servo("compliance", compliance=0.5)]))
    assert turn(sim, torque=0.1, angle=lambda step: 0.0, steps=3000)[-1] == pytest.approx(0.075, rel=1e-3)


@pytest.mark.parametrize(("torque", "holds"), [(0.85, True), (0.95, False)])
def test_a_saturated_servo_holds_what_is_left_of_its_force(torque, holds):
    """A tenth of its 9 N m is 0.9 N m."""
    sim = flat(servo([on_servo("actuator_saturation", loss=0.9)]))
    # it gives way by no more than 0.9 / 4 rad while it holds
    assert (turn(sim, torque=torque, angle=lambda step: 0.0, steps=3000)[-1] < 0.25) == holds


@pytest.mark.parametrize("angle", [0.1, -0.1])
def test_on_a_tilted_base_the_arm_hangs_that_much_to_the_side(angle):
    tilt = Effect("base_tilt", Location("model", "gravity"), {"about_x": 0.0, "about_y": angle, "about_z": 0.0})
    ends = [turn(servo(effects), steps=6000)[-1] for effects in ((), [tilt])]
    assert ends[0] == pytest.approx(np.pi / 2, abs=1e-3)  # straight down
    assert ends[1] - ends[0] == pytest.approx(angle, abs=1e-3)


@pytest.mark.parametrize(("torque", "lifts"), [(1.2, False), (1.3, True)])
def test_a_joint_that_drags_with_its_load_loses_a_share_of_the_torque(torque, lifts):
    """Of a motor that lifts the level arm a fifth is lost: it needs a quarter more than the weight."""
    sim = servo([on_hinge("load_friction", mu=0.2, presliding=1e-3)])
    way = turn(sim, torque=-torque * WEIGHT, steps=1500)
    assert (way[-1] < -0.01) == lifts


def test_what_falls_through_a_fluid_ends_at_the_speed_at_which_drag_is_its_weight():
    xml = """<mujoco><option timestep="0.002"/><worldbody><body name="ball"><freejoint/><geom size="0.01" mass="0.1"/>
    </body></worldbody></mujoco>"""
    drag = Effect("fluid_drag", Location("body", "ball"), {"drag": 0.05})
    sim = Simulation(instrument(mujoco.MjSpec.from_string(xml)).compile(), ParameterSet(), (), 1, 1, [drag])
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.begin(np.arange(1))
    sim.step(np.arange(1), 1500)
    assert sim.batch.qvel[0, 2] == pytest.approx(-np.sqrt(0.1 * 9.81 / 0.05), rel=1e-3)


@pytest.mark.parametrize(("name", "values"), [("hysteresis", {"ratio": 3.0, "yield_strain": 10.0}),
                                              ("viscoelastic_creep", {"ratio": 3.0, "time_constant": 1e4}),
                                              ("plastic_set", {"softness": 1e-3, "share": 0.5})])  # fmt: skip
def test_springs_beside_that_do_not_yield_rest_where_a_bent_joint_does(name, values):
    spec = mujoco.MjSpec.from_string(SERVO)
    spec.joint("hinge").stiffness[0] = 1.0
    laws = [on_hinge("rest_bend", angle_x=0.2), on_hinge(name, **values)]
    sim = flat(Simulation(instrument(spec).compile(), ParameterSet(), (), 1, 1, laws))
    assert turn(sim, steps=4000)[-1] == pytest.approx(0.2, abs=2e-3)


FRICTION = {
    "coulomb_friction": {"friction": 0.05},
    "stribeck_friction": {"friction": 0.05, "static_ratio": 2.0, "stribeck_velocity": 5.0},
    "load_friction": {"mu": 0.1},
    "gear_friction": {"mu": 0.1, "preload": 0.02},
}


@pytest.mark.parametrize(("name", "values"), FRICTION.items())
def test_friction_of_a_fast_servo_is_the_same_with_half_the_time_step(name, values):
    """At 3 rad/s, of the real servo's model and its time step of 5 ms."""
    paths = [mjcf_path(f"real/bam_servo.{suffix}") for suffix in ("xml", "toml")]
    time = 0.01 * np.arange(300)
    goals = 0.8 * np.sin(2 * np.pi * 0.7 * time) + 0.3 * np.sin(2 * np.pi * 1.9 * time)
    actions, settings, found = np.stack([goals, 0 * goals], axis=1), np.ones((300, 2)) * [4.0, 1.0], []
    for shorter in (1, 2):
        robot = ModelRobot(*paths, threads=1, shorter=shorter)
        parameters = np.array([[prior.nominal for prior in robot.priors]] * 2)
        effects = [(), (on_hinge(name, **values),)]
        bare, dragging = robot.simulate(actions, parameters, effects, np.zeros((1, 1)), settings=settings)
        found.append(dragging - bare)
    assert np.linalg.norm(found[1] - found[0]) < 0.05 * np.linalg.norm(found[0])


def at_actuator(name, actuator, **values):
    return Effect(name, Location("actuator", actuator), values)


def test_lost_motion_is_no_force_within_half_its_width_and_the_servo_beyond():
    """0.2 N m displace a servo of 4 N m/rad by 0.05 rad, and by half the width more, to either side."""
    for torque in (0.2, -0.2):
        way = turn(flat(servo([at_actuator("lost_motion", "servo", width=0.06)])), torque, lambda _: 0.3, steps=4000)
        assert way[-1] == pytest.approx(0.3 + np.sign(torque) * (0.05 + 0.03), abs=1e-4)
    free = turn(flat(servo([at_actuator("lost_motion", "servo", width=0.06)])), 0.0, lambda _: 0.02, steps=50)
    assert np.abs(free).max() == 0.0


def test_input_friction_holds_as_much_as_its_share_of_one_actuator_and_a_preload():
    """A motor of 1 N m with friction 0.3 (1 + 0.5): 0.55 N m are left to turn the arm; with 0.7 (1 + 0.5) it sticks."""
    inertia = 0.1 * 0.2**2 / 3
    slips = turn(flat(servo([at_actuator("input_friction", "motor", mu=0.3, preload=0.5)])), 1.0, steps=100)
    speed = 0.55 / 0.01 * (1 - np.exp(-0.2 * 0.01 / inertia))  # after 0.2 s, with the damping of the hinge
    assert slips[-1] - slips[-2] == pytest.approx(speed * 0.002, rel=0.02)
    sticks = turn(flat(servo([at_actuator("input_friction", "motor", mu=0.7, preload=0.5)])), 1.0, steps=100)
    assert 0.0 < sticks[-1] < 0.03 and abs(sticks[-1] - sticks[-20]) < 1e-3


@pytest.mark.parametrize("name", ["lost_motion", "input_friction"])
def test_laws_of_one_servo_among_others_do_nothing_without_a_magnitude_and_stay_finite_with_ten(name):
    law, one = PHYSICS[name], Location("actuator", "servo")
    first = law.quantities[0]
    ways = []
    for share in (0.0, 10.0):
        sim = servo([])
        typical = {q.name: q.typical * Elements(sim.model).scale(one, q.of) for q in law.quantities}
        sim = servo([Effect(name, one, typical | {first.name: share * typical[first.name]})])
        ways.append(turn(sim, 0.1, lambda step: np.sin(0.01 * step)))
    assert np.array_equal(ways[0], turn(servo([]), 0.1, lambda step: np.sin(0.01 * step)))
    assert np.isfinite(ways[1]).all() and not np.array_equal(*ways)


def test_a_law_of_one_servo_among_others_is_refused_where_there_is_none():
    with pytest.raises(EffectError, match=r"lost_motion acts on servos of positions"):
        servo([at_actuator("lost_motion", "motor", width=0.1)])
    spec = mujoco.MjSpec.from_string(SERVO)
    spec.delete(spec.actuator("motor"))
    with pytest.raises(EffectError, match=r"input_friction acts where several actuators drive one joint"):
        Simulation(
            instrument(spec).compile(), ParameterSet(), (), 1, 1,
            [at_actuator("input_friction", "servo", mu=0.1, preload=1.0)],
        )  # fmt: skip


def test_a_typical_friction_of_a_joint_that_nothing_drives_is_a_share_of_what_hangs_on_it():
    spec = mujoco.MjSpec.from_string(SERVO)
    for name in ("motor", "servo"):
        spec.delete(spec.actuator(name))
    assert Elements(spec.compile()).scale(Location("joint", "hinge"), "force") == pytest.approx(0.03 * WEIGHT, rel=1e-6)


FALL = """<mujoco><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="light"><joint name="drop" type="slide" axis="0 0 1"/>
<inertial pos="0 0 0" mass="1e-4" diaginertia="1e-9 1e-9 1e-9"/>
<body name="heavy"><inertial pos="0 0 0" mass="0.9999" diaginertia="1e-3 1e-3 1e-3"/></body></body>
<body name="probe" pos="0 1 0"><joint name="still" type="slide" axis="0 0 1"/><geom size="0.01" mass="1"/></body>
</worldbody></mujoco>"""


def fallen(effects, steps=1000):
    """A simulation in which everything has fallen for two seconds."""
    sim = Simulation(instrument(mujoco.MjSpec.from_string(FALL)).compile(), ParameterSet(), (), 1, 1, effects)
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.begin(np.arange(1))
    sim.step(np.arange(1), steps)
    return sim


def test_drag_of_a_light_body_brakes_what_it_carries():
    """The terminal velocity is that of the whole weight."""
    sim = fallen([Effect("fluid_drag", Location("body", "light"), {"drag": 1.0})])
    assert sim.batch.qvel[0, 0] == pytest.approx(-np.sqrt(9.81), rel=1e-3)


def test_a_body_accelerates_as_the_joint_that_it_hangs_on():
    pushes = []
    for place, axis in (({"kind": "joint", "name": "drop"}, {}), ({"kind": "body", "name": "heavy"}, {"axis": "z"})):
        read = {"a": {"of": "acceleration", "range": [-100.0, 100.0], "location": place, **axis}}
        law = {"unit": "N", "limit": 100.0, "variables": read, "expression": ["multiply", 1.0, "a"]}
        data = {"name": "custom", "location": {"kind": "joint", "name": "still"}, "parameters": {}, "law": law}
        pushes.append(fallen([effect_from(data, ALL)]).batch.qfrc_applied[0, 1])
    np.testing.assert_allclose(pushes, -9.81, rtol=1e-6)


def test_a_variable_of_time_or_of_all_elements_has_no_location():
    for of, place in (("time", {"kind": "joint", "name": "still"}), ("velocity", {"kind": "joint", "name": "*"})):
        law = {"unit": "N", "limit": 1.0, "variables": {"x": {"of": of, "range": [0, 1], "location": place}},
               "expression": ["multiply", 1.0, "x"]}  # fmt: skip
        data = {"name": "custom", "location": {"kind": "joint", "name": "still"}, "parameters": {}, "law": law}
        with pytest.raises(EffectError, match="variable x"):
            effect_from(data, ALL)


def test_dry_friction_holds_whatever_a_parameter_makes_of_the_inertia():
    sim = flat(servo([on_hinge("coulomb_friction", friction=1.0, presliding=1e-5)]))
    for name in ("body_mass", "body_inertia"):
        sim.batch.expand(name)[...] *= 0.3
    sim.batch.set_const(np.arange(1))
    way = turn(sim, torque=0.5, steps=1000)
    assert np.abs(way).max() < 0.01


def test_what_is_refused_leaves_the_effects_before_it_as_they_were():
    sim = servo([on_hinge("stiffening", beta=10.0)])
    ways = [turn(sim, torque=0.2)]
    with pytest.raises(EffectError, match="need the same spring"):
        sim.assign_effects([[on_hinge("hysteresis"), on_hinge("viscoelastic_creep")]])
    np.testing.assert_array_equal(turn(sim, torque=0.2), ways[0])


def test_laws_of_setpoints_keep_what_models_and_parameters_limit():
    """A range of commands that a parameter has changed, and an activation that ends."""
    sim = servo([Effect("actuator_gain", Location("actuator", "servo"), {"gain": 1.0})])
    sim.set_params(np.arange(1), np.zeros((1, 0)))
    sim.batch.expand("actuator_ctrlrange")[0, 1] = (-0.5, 0.5)
    sim._instrumented.write(np.arange(1))
    assert sim._instrumented.within("ctrl", np.zeros(1, int), np.ones(1, int), np.array([2.0])) == [0.5]
    motor = '<general name="motor" dyntype="filter" dynprm="0.01" actlimited="true" actrange="-0.1 0.1"'
    slow = SERVO.replace('<motor name="motor"', motor)
    ways = []
    for effects in ([], [Effect("actuator_gain", Location("actuator", "motor"), {"gain": 1.0})]):
        spec = mujoco.MjSpec.from_string(slow)
        ways.append(turn(Simulation(instrument(spec).compile(), ParameterSet(), (), 1, 1, effects), torque=3.0))
    np.testing.assert_allclose(ways[1], ways[0], atol=1e-12)


def test_models_with_an_actuator_of_several_controls_have_no_laws_of_setpoints():
    text = SERVO.replace("</actuator>", '<pid name="two" joint="hinge" kp="1" kv="0.1"/></actuator>')
    spec, gain = mujoco.MjSpec.from_string(text), Effect("actuator_gain", Location("actuator", "motor"), {"gain": 0.5})
    with pytest.raises(EffectError, match="actuator two has 2 controls"):
        Simulation(instrument(spec).compile(), ParameterSet(), (), 1, 1, [gain])
