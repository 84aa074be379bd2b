"""Effects: what each law does on the trunk, and the files of effects."""

import json
import re

import gymnasium
import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

import soro_bench  # noqa: F401
from soro_bench.effects import springs
from soro_bench.effects.catalogue import ALL, CATEGORIES, MEASUREMENT, PHYSICS, QUANTITIES
from soro_bench.effects.effect import Effect, EffectError, Location, effect_from, load_effects, save_effects
from soro_bench.effects.elements import Elements, instrument
from soro_bench.effects.equations import EQUATIONS
from soro_bench.effects.runtime import ActiveEffects
from soro_bench.models.simulation import Simulation
from soro_bench.parameters import ParameterSet
from soro_bench.registration import make_task
from tests.arm import damaged

PLACES = {"tendon": "L1", "actuator": "L1", "body": "vertebra4", "joint": "bend_x3", "model": "gravity",
          "geom": "object"}  # fmt: skip
# which the trunk cannot have: its cables have one actuator each, and those integrate (test_effects_on_a_hinge.py)
ELSEWHERE = ("lost_motion", "input_friction")
CASES = [(name, kind) for name, law in PHYSICS.items() if name not in ELSEWHERE for kind in law.kinds if kind != "flex"]
SEVERAL = (
    "base_tilt",
    "rest_bend",
)  # whose quantities are all magnitudes

# a finger of two links that a cable bends; the cable's servo takes rates
FINGER = """<mujoco><option timestep="0.002" integrator="implicitfast"/><default><geom contype="0" conaffinity="0"/>
<joint axis="0 1 0" stiffness="0.5" damping="0.02"/></default><worldbody><site name="eyelet0" pos="0 0 0.02"/>
<body name="near" pos="0.02 0 0"><joint name="near"/><geom type="capsule" size="0.01" fromto="0 0 0 0.1 0 0"
mass="0.05"/><site name="eyelet1" pos="0.05 0 0.02"/><site name="eyelet2" pos="0.09 0 0.02"/>
<body name="far" pos="0.1 0 0"><joint name="far"/><geom type="capsule" size="0.01" fromto="0 0 0 0.1 0 0" mass="0.05"/>
<site name="eyelet3" pos="0.01 0 0.02"/><site name="eyelet4" pos="0.05 0 0.02"/></body></body></worldbody>
<tendon><spatial name="cable"><site site="eyelet0"/><site site="eyelet1"/><site site="eyelet2"/><site site="eyelet3"/>
<site site="eyelet4"/></spatial></tendon><actuator><general name="cable" tendon="cable" gear="-1" dyntype="integrator"
gainprm="2000" biasprm="0 -2000 -40" biastype="affine" forcerange="0 20" forcelimited="true" ctrlrange="-0.1 0.1"
ctrllimited="true" actrange="-0.05 0.05" actlimited="true"/></actuator></mujoco>"""


def effect(elements, name, kind, share=1.0, place=None):
    """An effect of a share of its typical magnitude."""
    values = {}
    for i, q in enumerate(QUANTITIES[name]):
        location = Location(kind, place or PLACES[kind])
        typical = q.typical * elements.scale(location, q.of)
        if i == 0 or name in SEVERAL:
            typical = float(np.clip(q.null + share * (typical - q.null), *q.bounds))
        values[q.name] = typical
    return Effect(name, Location(kind, place or PLACES[kind]), values)


def trunk(effects, nsim=1):
    task = make_task("TrunkPush-v0", nsim, 1, "cable", action="continuous", effects=())
    if effects:
        task.sim.assign_effects(effects)
    return task


def motion(task, steps=30, seed=0):
    """(N, steps, 21, 3) keypoints of N trunks that get the same random actions, each held for five steps."""
    ids, rng = np.arange(task.num_envs), np.random.default_rng(seed)
    task.reset(ids, [np.random.default_rng(0)] * task.num_envs, [{"goal": [0.05, 0.05, 0.15]}] * task.num_envs)
    rows = []
    for step in range(steps):
        if step % 5 == 0:
            action = rng.uniform(-1, 1, (1, 8)).astype(np.float32)
        stepped = task.step(ids, np.repeat(action, task.num_envs, axis=0))
        assert not stepped.diverged.any()  # MuJoCo begins anew from a state that is not finite
        rows.append(task.keypoints(ids).copy())
    return np.stack(rows, axis=1)


@pytest.fixture(scope="module")
def elements():
    return Elements(trunk(None).model)


@pytest.fixture(scope="module")
def nominal():
    return motion(make_task("TrunkPush-v0", 1, 1, "cable", action="continuous"))[0]


def test_a_model_that_is_ready_for_effects_moves_bit_for_bit_as_before(nominal):
    assert np.array_equal(motion(trunk(None))[0], nominal)


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_no_magnitude_is_no_effect_and_ten_times_the_typical_one_stays_finite(name, kind, elements, nominal):
    effects = [(effect(elements, name, kind, share),) for share in (0.0, 10.0)]
    none, strong = motion(trunk(effects, nsim=2))
    assert np.array_equal(none, nominal)
    assert np.isfinite(strong).all()


@pytest.mark.parametrize(("name", "kind"), [case for case in CASES if CATEGORIES[case[0]] != "contact"])
def test_a_signature_changes_by_less_than_a_twentieth_with_half_the_time_step(name, kind):
    responses = []
    for timestep in (0.002, 0.001):
        places = Elements(instrument(mujoco.MjSpec.from_string(FINGER)).compile())
        location = {"tendon": "cable", "actuator": "cable", "joint": "far", "body": "far", "model": "gravity"}[kind]
        effects = [effect(places, name, kind, place=location)]
        responses.append(bend(effects, timestep) - bend((), timestep))
    assert np.abs(responses[0]).max() > 1e-6 or name == "supply_coupling"  # of a single chamber
    assert np.linalg.norm(responses[1] - responses[0]) <= 0.05 * np.linalg.norm(responses[0]) + 1e-9


def test_a_result_does_not_depend_on_what_else_is_simulated(elements):
    chosen = [(effect(elements, name, kind),) for name, kind in CASES if kind in ("tendon", "actuator")]
    together = motion(trunk(chosen, nsim=len(chosen)), steps=10)
    for i in (0, len(chosen) // 2, len(chosen) - 1):
        assert np.array_equal(motion(trunk([chosen[i]]), steps=10)[0], together[i])


@pytest.mark.parametrize("name", ["actuator_delay", "backlash", "actuator_gain"])
def test_no_magnitude_is_no_effect_with_a_refined_time_step_either(name, elements):
    """A law that took the model's own time step would move the setpoints twice as far."""
    runs = []
    for effects in ((), (effect(elements, name, "actuator", 0.0),)):
        task = trunk(None)
        task.refine(2)
        task.sim.assign_effects([effects])
        runs.append(motion(task))
    assert np.array_equal(*runs)


def test_only_laws_of_setpoints_change_while_they_act(elements):
    """Others would keep what they have written to fields, and a law at several joints has several values."""
    stiff, late = (effect(elements, *where) for where in (("local_stiffness", "body"), ("pretension", "actuator")))
    sim = trunk([(stiff, late)]).sim
    sim.change(late.name, 0, late.location, "offset", 0.001)
    with pytest.raises(EffectError, match="no law of setpoints called local_stiffness at"):
        sim.change(stiff.name, 0, stiff.location, "factor", 2.0)


def test_a_time_step_is_not_refined_under_effects_that_know_it(elements):
    with pytest.raises(RuntimeError, match="before there are effects"):
        trunk([(effect(elements, "actuator_delay", "actuator"),)]).refine(2)


def test_effects_end_with_their_assignment(elements, nominal):
    task = trunk([(effect(elements, "local_stiffness", "body"), effect(elements, "actuator_delay", "actuator"))])
    motion(task, steps=3)
    task.sim.assign_effects([()])
    assert np.array_equal(motion(task)[0], nominal)


def bend(effects, timestep):
    """(40, 2) joint angles of the finger over 2 s, in which the cable is pulled, held and released."""
    spec = mujoco.MjSpec.from_string(FINGER)
    spec.option.timestep = timestep
    sim = Simulation(instrument(spec).compile(), ParameterSet(), (), 1, 1, effects)
    # from where the finger hangs at rest: the servo's length at zero is that of the straight finger
    sim.batch.expand("actuator_biasprm")[:, 0, 0] = -2000 * -sim.model.actuator_length0[0]
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.begin(np.arange(1))
    rows = []
    for step in range(40):
        sim.batch.ctrl[0, 0] = 0.03 * np.sin(2 * np.pi * step / 40)
        sim.step(np.arange(1), round(0.05 / timestep))
        rows.append(sim.batch.qpos[0].copy())
    return np.array(rows)


def test_a_sensor_delay_shifts_a_signal_and_a_bias_moves_one_marker():
    time = 0.05 * np.arange(100)
    values = np.sin(time)[:, None, None] * np.ones((1, 4, 3))
    later = MEASUREMENT["sensor_delay"].apply(time, values, {"delay": 0.1}, 0)
    assert later[10:] == pytest.approx(values[8:-2], abs=1e-12)
    fast = np.sin(2 * np.pi * 2.0 * time)[:, None, None]  # 2 Hz, ten samples a period
    late = MEASUREMENT["sensor_delay"].apply(time, fast, {"delay": 0.0125}, 0)[:, 0, 0]
    assert late[2:] == pytest.approx(np.sin(2 * np.pi * 2.0 * (time[2:] - 0.0125)), abs=1e-3)
    fast[60:] = np.nan  # it diverged
    late = MEASUREMENT["sensor_delay"].apply(time, fast, {"delay": 0.0125}, 0)[:, 0, 0]
    assert np.isnan(late).tolist() == [False] * 60 + [True] * 40
    moved = MEASUREMENT["sensor_bias"].apply(time, values, {"x": 1.0, "y": 0.0, "z": 0.0}, 2)
    assert np.abs(moved - values).max(axis=(0, 2)).tolist() == [0, 0, 1, 0]


# --- files and environments ---


def test_every_law_has_an_equation_with_a_symbol_for_each_of_its_parameters():
    assert EQUATIONS.keys() == ALL.keys()
    for name, equation in EQUATIONS.items():
        assert equation.symbols.keys() == {q.name for q in QUANTITIES[name]}, name
        # an offset is a vector, whose components are not named one by one
        symbols = [re.sub("_[xyz]$", "", symbol) for symbol in (*equation.symbols.values(), *equation.other)]
        assert [symbol for symbol in symbols if symbol not in equation.latex] == [], name


def test_an_environment_with_an_effects_file_differs_and_without_effects_does_not(tmp_path):
    path = tmp_path / "effects.json"
    moved = []
    for effects in ([], [Effect("payload", Location("body", "vertebra9"), {"mass": 0.05})]):
        save_effects(effects, path)
        env = gymnasium.make("TrunkReach-v0", model="cable", effects=path)
        env.reset(seed=0)
        moved.append([env.step(0)[0] for _ in range(3)][-1])
        env.close()
    plain = gymnasium.make("TrunkReach-v0", model="cable")
    plain.reset(seed=0)
    assert np.array_equal([plain.step(0)[0] for _ in range(3)][-1], moved[0])
    assert not np.array_equal(moved[0], moved[1])


def test_an_environment_leaves_out_faults_of_measurement_and_says_so(tmp_path):
    save_effects(
        [Effect("sensor_delay", Location("sensor", "keypoints"), {"delay": 0.1})], path := tmp_path / "effects.json"
    )
    with pytest.warns(UserWarning, match="do nothing here: sensor_delay"):
        gymnasium.make("TrunkReach-v0", model="cable", effects=path).close()


def test_an_effects_file_is_read_as_it_was_written(tmp_path):
    effects = (Effect("backlash", Location("actuator", "*"), {"width": 0.001}),
               Effect("sensor_bias", Location("sensor", "keypoints", 3), {"x": 0.1, "y": 0.0, "z": 0.0}))  # fmt: skip
    save_effects(effects, tmp_path / "effects.json")
    assert load_effects(tmp_path / "effects.json", ALL) == effects


GOOD = {"name": "backlash", "location": {"kind": "actuator", "name": "L0"}, "parameters": {"width": 0.001}}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([], "schema"),
        ({"schema": "soro-bench/effects/2", "effects": [{**GOOD, "name": "magic"}]}, "unknown effect"),
        ({"schema": "soro-bench/effects/2", "effects": [{**GOOD, "name": []}]}, "unknown effect"),
        ({"schema": "soro-bench/effects/2", "effects": [{**GOOD, "location": "L0"}]}, "location"),
        ({"schema": "soro-bench/effects/2", "effects": [{**GOOD, "parameters": {"width": -1}}]}, "allowed is"),
        ({"schema": "soro-bench/effects/2", "effects": [{**GOOD, "parameters": {}}]}, "needs its width"),
        ({"schema": "soro-bench/effects/2", "effects": [{**GOOD, "parameters": {"wide": 1}}]}, "has no"),
        ({"schema": "soro-bench/effects/2", "effects": [GOOD] * 101}, "at most 100"),
        (
            {"schema": "soro-bench/effects/2", "effects": [{**GOOD, "parameters": {"width": 10**400}}]},
            "at most 300 digits",
        ),
        (
            {"schema": "soro-bench/effects/2", "effects": [{**GOOD, "location": {"kind": "sensor", "name": "tip"}}]},
            "acts on",
        ),
    ],
)
def test_a_bad_effects_file_is_refused_in_words(tmp_path, data, message):
    path = tmp_path / "effects.json"
    path.write_text(json.dumps(data))
    with pytest.raises(EffectError, match=message):
        load_effects(path, ALL)


def test_an_error_in_an_effects_file_says_which_effect_of_which_file(tmp_path):
    path = tmp_path / "effects.json"
    bad = {**GOOD, "parameters": {"width": -1}}
    path.write_text(json.dumps({"schema": "soro-bench/effects/2", "effects": [GOOD, bad]}))
    with pytest.raises(EffectError, match=rf"^{path}, effect 2: width of backlash is -1; allowed is"):
        load_effects(path, ALL)


def test_a_damaged_effects_file_is_refused_in_a_line_or_gives_effects(tmp_path):
    whole = json.dumps({"schema": "soro-bench/effects/2", "effects": [GOOD]}).encode()
    path, rng = tmp_path / "effects.json", np.random.default_rng(0)
    for _ in range(200):
        path.write_bytes(damaged(whole, rng))
        try:
            effects = load_effects(path, ALL)
        except EffectError as error:
            assert "\n" not in str(error) and str(error).startswith(str(path))
        else:
            assert tuple(effect_from(each.to_json(), ALL) for each in effects) == effects


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ([Effect("payload", Location("body", "nose"), {"mass": 0.1})], "no body 'nose'"),
        ([Effect("payload", Location("tendon", "L0"), {"mass": 0.1})], "acts on body"),
        ([Effect("sensor_delay", Location("sensor", "keypoints"), {"delay": 0.1})], "no physics"),
        ([Effect("coulomb_friction", Location("tendon", "L0"), {"friction": 1.0}),
          Effect("load_friction", Location("tendon", "L0"), {"mu": 0.1})], "same spring"),
        ([Effect("actuator_gain", Location("actuator", "*"), {"gain": 0.9}),
          Effect("actuator_gain", Location("actuator", "L0"), {"gain": 0.9})], "acts twice at actuator L0"),
    ],
)  # fmt: skip
def test_effects_that_have_no_place_are_refused_in_words(effects, message):
    with pytest.raises(EffectError, match=message):
        trunk([effects])


def test_friction_needs_a_tendon_without_a_spring_of_its_own_that_yields():
    """Its own would be lost, with a friction of nothing too."""
    spring = """<joint name="j"/><geom size=".1"/></body></worldbody>
    <tendon><fixed name="t" stiffness="3" springyield=".1"><joint joint="j" coef="1"/></fixed></tendon>"""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody><body>{spring}</mujoco>")
    assert model.tendon_plasticadr[0] >= 0
    run = ActiveEffects(Batch(model, 1, 1, persistent=True))
    with pytest.raises(EffectError, match="without a spring of their own"):
        run.assign([[Effect("coulomb_friction", Location("tendon", "t"), {"friction": 0.0})]])


def test_load_friction_needs_a_tendon_that_goes_through_sites_and_takes_its_branches_apart():
    """A branch that stays on one body does not bend, and beyond a pulley another one begins."""
    bodies = """<geom name="drum" type="cylinder" size=".03 .1"/><site name="w0"/><site name="w1" pos=".1 0 0"/>
    <body name="b"><joint name="j" axis="0 1 0"/><geom size=".01" pos=".1 0 0"/><site name="b0"/>
    <site name="b1" pos=".1 0 0"/></body>"""
    branches = '<site site="w0"/><site site="w1"/><pulley divisor="2"/><site site="b0"/><site site="b1"/>'
    wrapped = '<site site="w0"/><geom geom="drum"/><site site="b1"/>'
    for path, refused in ((branches, False), (wrapped, True)):
        tendons = f'<tendon><spatial name="t">{path}</spatial></tendon>'
        spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{bodies}</worldbody>{tendons}</mujoco>")
        model = instrument(spec).compile()
        law = [Effect("load_friction", Location("tendon", "t"), {"mu": 0.1})]
        assert Simulation(model, ParameterSet(), (), 1, 1, ()).accepts(law) != refused
        assert refused or springs._bends(model, 0) == []


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_from_a_state_an_episode_goes_on_with_the_same_bytes_as_it_would_have(name, kind, elements):
    """A setpoint that a law has changed is not changed again, and what a law remembers is there."""
    effects = (effect(elements, name, kind),)
    task, ids = trunk([effects]), np.arange(1)
    motion(task, steps=7)
    state, motions = {key: values[0] for key, values in task.state(ids).items()}, []
    other = make_task("TrunkPush-v0", 1, 1, "cable", action="continuous", effects=effects)
    other.reset(ids, [np.random.default_rng(0)], [{"state": state}])
    for one in (task, other):
        rows = []
        for action in np.random.default_rng(1).uniform(-1, 1, (8, 1, 8)).astype(np.float32):
            one.step(ids, action)
            rows.append(one.keypoints(ids).copy())
        motions.append(rows)
    assert np.array_equal(*motions)


def test_what_effects_remember_is_refused_where_there_are_none_and_may_be_left_out(elements):
    ids, effects = np.arange(1), (effect(elements, "actuator_gain", "actuator"),)
    state = {key: values[0] for key, values in trunk([effects]).state(ids).items()}
    begins = [np.random.default_rng(0)]
    with pytest.raises(ValueError, match="has effects, and this environment has none; leave it out"):
        trunk(None).reset(ids, begins, [{"state": state}])
    with pytest.raises(ValueError, match=r"state effects .* has to be"):
        trunk([effects]).reset(ids, begins, [{"state": {**state, "effects": state["effects"][1:]}}])
    del state["effects"]
    for task in (trunk(None), trunk([effects])):
        task.reset(ids, begins, [{"state": state}])


def test_typical_forces_and_masses_are_those_of_the_robot():
    """A motor without a limit of force gives what its largest control does; a joint without one, as much."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body name="arm"><joint name="driven"/>
        <geom size="0.1" mass="3"/>
        <body name="end"><joint name="passive"/><geom size="0.1" mass="4"/></body></body>
        <body name="loose"><freejoint/><geom size="0.1" mass="9"/></body><body><geom size="0.1" mass="8"/></body>
        </worldbody>
        <actuator><motor name="motor" joint="driven" gear="0.05" ctrlrange="-2 2"/></actuator></mujoco>""")
    elements = Elements(model)
    for name in ("driven", "passive"):
        assert elements.scale(Location("joint", name), "force") == pytest.approx(0.03 * 0.1)
    assert elements.scale(Location("body", "end"), "mass") == pytest.approx(7.0)


@pytest.mark.parametrize(
    ("name", "values", "factor"),
    [
        ("local_stiffness", {"factor": 0.5}, lambda q: 0.5),
        ("stiffening", {"beta": 5.0}, lambda q: 1.0 + 5.0 * q**2),
        ("hysteresis", {"ratio": 0.5, "yield_strain": 9.0}, lambda q: 1.5),  # which does not slip
        ("viscoelastic_creep", {"ratio": 0.5, "time_constant": 1e4}, lambda q: 1.5),
        ("plastic_set", {"softness": 0.1, "share": 0.5}, lambda q: 1.0),  # which does not yield
    ],
)
def test_a_law_of_springs_acts_on_all_coefficients_of_a_polynomial(name, values, factor):
    """A hinge with a spring of q + 20 q^3 [N m] and a law that multiplies it holds 0.5 N m."""
    spec = mujoco.MjSpec.from_string("""<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body name="arm">
        <joint name="hinge" axis="0 1 0" stiffness="1 0 20" damping="0.05"/><geom size="0.05" pos="0.1 0 0" mass="0.1"/>
        </body></worldbody><actuator><motor joint="hinge"/></actuator></mujoco>""")
    law = [Effect(name, Location("joint", "hinge"), values)]
    sim = Simulation(instrument(spec).compile(), ParameterSet(), (), 1, 1, law)
    sim.begin(np.arange(1))
    for step in range(1500):
        sim.batch.ctrl[0] = 0.5 * min(1.0, step / 1000)
        sim.step(np.arange(1), 1)
    angle = sim.batch.qpos[0, 0]
    assert factor(angle) * (angle + 20.0 * angle**3) == pytest.approx(0.5, rel=1e-3)


def test_behind_a_compliance_the_damping_of_an_actuator_is_that_of_its_servo():
    """With a gear of 2; without damping it would swing on."""
    ways = []
    for servo, own in ((-0.005, 0.0), (0.0, 0.005)):
        spec = mujoco.MjSpec.from_string(f"""<mujoco><option timestep="0.002" integrator="implicitfast"
        gravity="0 0 0"/><worldbody><body name="arm"><joint name="hinge" axis="0 1 0"/><geom size="0.05" pos="0.1 0 0"
        mass="0.1"/></body></worldbody><actuator><general name="servo" joint="hinge" gear="2" gainprm="4"
        biasprm="0 -4 {servo}" biastype="affine" damping="{own}"/></actuator></mujoco>""")
        law = [Effect("compliance", Location("actuator", "servo"), {"compliance": 0.5})]
        sim = Simulation(instrument(spec).compile(), ParameterSet(), (), 1, 1, law)
        sim.batch.qpos[:] = 0.3
        sim.begin(np.arange(1))
        way = []
        for _ in range(500):
            sim.step(np.arange(1), 1)
            way.append(sim.batch.qpos[0, 0])
        ways.append(way)
    assert ways[1] == pytest.approx(ways[0], abs=1e-9)
    assert min(ways[0]) < -0.1
