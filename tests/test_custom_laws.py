"""Laws that are data: known answers, hostile ones refused or harmless; and laws that a diagnosis finds."""

import json
from dataclasses import replace

import gymnasium
import mujoco
import numpy as np
import pytest

import soro_bench  # noqa: F401  (registers environments)
from benchmarks.discovered_laws import case
from benchmarks.hostile_laws import hostile, outcome
from benchmarks.law_baselines import Data, error, nothing, parameters_only, sindy
from soro_bench.diagnosis.api import with_seeds
from soro_bench.diagnosis.assembly.discovered import legend, spanned
from soro_bench.diagnosis.discovery.discovery import discovered
from soro_bench.diagnosis.discovery.library import Read, Term, groups, series, variables_at
from soro_bench.diagnosis.discovery.located_input import LocatedInput
from soro_bench.diagnosis.estimation.fit import Guess, allowing, fitted
from soro_bench.diagnosis.localisation.ranking import ranked_locations
from soro_bench.diagnosis.render.html import html
from soro_bench.diagnosis.render.summary import summary
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import DiscoveredLaw, Estimate
from soro_bench.diagnosis.settings import DEFAULT
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.custom_law import Memory, Variable
from soro_bench.effects.effect import Effect, EffectError, Location, effect_from, load_effects, save_effects
from soro_bench.effects.expression import name_of, names_in
from tests.arm import ARM, HAND, MAP, problem, says
from tests.results import outside_catalogue
from tests.test_effects_on_a_hinge import flat, servo, turn

WIDE = [-100.0, 100.0]
CUBE = {
    "unit": "N m",
    "limit": 10.0,
    "variables": {"q": {"of": "position", "range": WIDE}},
    "expression": ["multiply", "k", "q", "q", "q"],
    "units": {"k": "N m/rad^3"},
}


def custom(law, kind="joint", name="hinge", **parameters):
    data = {"name": "custom", "location": {"kind": kind, "name": name}, "parameters": parameters, "law": law}
    return effect_from(json.loads(json.dumps(data)), ALL)


def law(expression, variables=None, states=None, **more):
    read = {name: {"range": WIDE, **each} for name, each in (variables or {}).items()}
    return {"unit": "N m", "limit": 10.0, "variables": read, "states": states or {}, "expression": expression, **more}


def test_a_cubic_spring_holds_a_torque():
    way = turn(flat(servo([custom(CUBE, k=-0.8), damper()])), torque=0.1, steps=8000)
    assert way[-1] == pytest.approx((0.1 / 0.8) ** (1 / 3), rel=1e-3)


def damper():
    return custom(law(["multiply", -0.02, "v"], {"v": {"of": "velocity"}}))


def test_it_is_held_outside_the_range_that_was_seen():
    held = {**CUBE, "variables": {"q": {"of": "position", "range": [-0.3, 0.3]}}}
    sim = flat(servo([custom(held, k=-0.8)]))
    sim.batch.qpos[0] = 2.0
    assert exerted(sim) == pytest.approx(-0.8 * 0.3**3)


def exerted(sim):
    """The moment of the law in the next time step, the others' taken off."""
    sim.begin(np.arange(1))
    sim.step(np.arange(1), 1)
    return sim.batch.qfrc_applied[0, 0]


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        ({"of": "lag", "input": "q", "time": 0.1}, lambda t: t - 0.1 * (1 - np.exp(-t / 0.1))),
        ({"of": "maxwell", "input": "q", "time": 0.1}, lambda t: 0.1 * (1 - np.exp(-t / 0.1))),
        ({"of": "play", "input": "q", "width": 0.2}, lambda t: np.maximum(t - 0.1, 0.0)),
        ({"of": "bouc_wen", "input": "q", "width": 0.2}, lambda t: 1 - np.exp(-t / 0.2)),
    ],
)
def test_what_a_state_remembers_of_a_ramp(state, expected):
    """The hinge turns by 1 rad/s, as its moment is read and taken away again."""
    sim = flat(servo([custom(law("z", {"q": {"of": "position"}}, {"z": state}))], timestep=0.0005))
    ids, batch = np.arange(1), sim.batch
    batch.reset(ids)
    sim.begin(ids)
    found = []
    for step in range(400):
        batch.qpos[0], batch.qvel[0] = 0.0005 * step, 0.0
        sim.step(ids, 1)
        found.append(batch.qfrc_applied[0, 0])
    assert np.array(found) == pytest.approx(expected(0.0005 * np.arange(400)), abs=2e-3)


def test_a_pull_towards_a_point_falls_with_the_distance():
    """An arm hangs level where a magnet above its middle carries it: c / d^2 is its weight."""
    pull = law(
        ["multiply", "c", ["power", "d", -2]], {"d": {"of": "distance", "point": [0.1, 0.0, 0.2]}},
        unit="N", direction=[0.1, 0.0, 0.2],
    )  # fmt: skip
    sim = servo([custom(pull, "body", "arm", c=9.81 * 0.1 * 0.2**2)])
    sim.batch.reset(np.arange(1))
    sim.begin(np.arange(1))
    sim.step(np.arange(1), 1)
    assert sim.batch.xfrc_applied[0, 1, :3] == pytest.approx([0.0, 0.0, 0.981], rel=1e-6)
    assert sim.batch.qvel[0, 0] == pytest.approx(0.0, abs=1e-6)


def test_an_acceleration_of_everything_is_gravity():
    """The arm falls as under other gravity, and no more after many steps."""
    ways = []
    for gravity, effects in ((-9.81, [custom(law(4.0, unit="m/s^2", direction="z"), "model", "gravity")]), (-5.81, [])):
        sim = servo(effects)
        sim.batch.expand("opt.gravity")[:] = (0.0, 0.0, gravity)
        ways.append(turn(sim, steps=50))
    assert ways[0] == pytest.approx(ways[1], rel=1e-9)


def test_an_offset_of_a_setpoint_follows_the_time():
    drift = law(["multiply", "r", "t"], {"t": {"of": "time"}}, unit="rad")
    sim = flat(servo([custom(drift, "actuator", "servo", r=0.1)]))
    assert turn(sim, angle=lambda step: 0.0, steps=2000)[-1] == pytest.approx(0.1 * 4.0, rel=0.02)


@pytest.mark.parametrize("count", [1, 2])
def test_offsets_of_a_setpoint_read_the_command_as_it_was_given_and_add_up(count):
    """Over several time steps of a control step too."""
    half = law(["multiply", 0.5, "u"], {"u": {"of": "command"}}, unit="rad")
    sim, ids = flat(servo([custom(half, "actuator", "servo")] * count)), np.arange(1)
    sim.batch.reset()
    sim.begin(ids)
    for _ in range(200):
        sim.batch.ctrl[0] = [0.0, 0.2]
        sim.step(ids, 10)
    assert sim.batch.qpos[0, 0] == pytest.approx(0.2 * (1.0 + 0.5 * count), rel=1e-3)


def test_a_file_keeps_it(tmp_path):
    memory = law("z", {"q": {"of": "position"}}, {"z": {"of": "play", "input": "q", "width": "w"}}, units={"w": "rad"})
    effects = (custom(CUBE, k=-0.8), custom(memory, w=0.1))
    save_effects(effects, tmp_path / "effects.json")
    assert load_effects(tmp_path / "effects.json", ALL) == effects


@pytest.mark.parametrize("count", [1, 3])
def test_an_environment_has_it_in_each_of_its_copies(count):
    """A cable that pulls harder the farther its neighbour goes; the copies are the same to the last bit."""
    pull = law(
        ["multiply", "k", "x"], {"x": {"of": "position", "location": {"kind": "tendon", "name": "L1"}}}, unit="N"
    )
    effect = custom(pull, "tendon", "L0", k=400.0).to_json()
    one = gymnasium.make("TrunkReach-v0", model="cable", effects=[effect])
    many = gymnasium.make_vec("TrunkReach-v0", num_envs=count, model="cable", effects=[effect])
    plain = gymnasium.make("TrunkReach-v0", model="cable", effects=[])
    one.reset(seed=1), many.reset(seed=[1] * count), plain.reset(seed=1)
    action = np.asarray(one.action_space.sample())
    action[...] = 2
    for _ in range(5):
        seen, together, without = (
            one.step(action)[0], many.step(np.stack([action] * count))[0], plain.step(action)[0]
        )  # fmt: skip
    assert all(np.array_equal(row, seen) for row in together)
    assert not np.allclose(seen, without)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"expression": ["system", "q"]}, ("function", "system", "multiply")),
        ({"expression": "__import__"}, ("name", "__import__")),
        ({"expression": ["add", *["q"] * 20]}, ("add", "20 arguments")),
        ({"expression": [["q"]]}, ("function",)),
        ({"expression": ["multiply", "q", 1e300]}, ("a number", "1e+09 at most")),
        ({"limit": -1.0}, ("limit is -1", "above 0")),
        ({"unit": 3}, ("unit", "short text")),
        ({"variables": {"q": {"of": "position", "range": [1, -1]}}}, ("range of q", "rise")),
        ({"variables": {"q": {"of": "weather", "range": WIDE}}}, ("weather", "position")),
        ({"states": {"z": {"of": "play", "input": "q"}}}, ("state z", "width")),
        ({"expression": ["bumps", ["q"], [0.0], [[0.0, 1.0]]]}, ("width", "1e-09 and more")),
        ({"expression": ["bumps", ["q"], [1.0], [[0.0]]]}, ("row", "1 numbers and a weight")),
        ({"expression": ["bumps", ["v"], [1.0], [[0.0, 1.0]]]}, ("name", "v")),
        ({"code": "x"}, ("unit, limit and expression",)),
    ],
)
def test_a_bad_law_is_refused_in_words(change, message):
    with pytest.raises(EffectError, match=says("custom at joint hinge", *message)):
        custom({**CUBE, **change}, k=1.0)


def test_an_element_that_is_not_there_is_refused():
    at = {**CUBE, "variables": {"q": {"of": "position", "range": WIDE, "location": {"kind": "joint", "name": "elbow"}}}}
    with pytest.raises(EffectError, match="no joint 'elbow'"):
        servo([custom(at, k=1.0)])
    with pytest.raises(EffectError, match="has no law"):
        servo([Effect("custom", Location("joint", "hinge"), {})])
    with pytest.raises(EffectError, match="lacks its parameter k"):
        servo([replace(custom(CUBE, k=1.0), parameters={})])


def test_hostile_laws_are_refused_or_harmless():
    """Ten thousand of them by ``python benchmarks/hostile_laws.py 10000``."""
    rng = np.random.default_rng(0)
    seen = {outcome(hostile(rng)) for _ in range(150)}
    assert seen == {"refused", "harmless"}


@pytest.mark.parametrize(
    ("of", "expected"),
    [
        ("lag", lambda t: t - 0.2 * (1 - np.exp(-t / 0.2))),
        ("maxwell", lambda t: 0.2 * (1 - np.exp(-t / 0.2))),
        ("play", lambda t: np.maximum(t - 0.1, 0.0)),
        ("bouc_wen", lambda t: 1 - np.exp(-t / 0.2)),
    ],
)
def test_a_term_remembers_along_each_recording(of, expected):
    """Two recordings of the same ramp: the second one begins anew."""
    time = 0.001 * np.arange(400)
    term = Term("z", "1", (), (Memory("z", of, "q", "w"),), ())
    found = series(term, {"q": np.tile(time, 2), "w": np.asarray(0.2)}, [400, 400], 0.001)
    assert np.array_equal(*np.split(found, 2))
    assert found[:400] == pytest.approx(expected(time), abs=2e-3)


@pytest.fixture
def paths(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "arm.toml").write_text(MAP)
    return tmp_path / "arm.xml", tmp_path / "arm.toml"


def test_a_wave_has_so_many_periods_in_the_range_of_a_position_that_is_far_from_zero():
    read = Read(Variable("q", "position", -9.0, 9.0), 2.0 + 0.1 * np.sin(np.linspace(0.0, 20.0, 2000)), "m")
    waves = [shape.value for term, *_ in groups([read], []) for shape in term.shapes if shape.name == "n_q"]
    assert 0.2 * np.array(waves) / (2.0 * np.pi) == pytest.approx([1.0, 1.5, 2.0, 3.0], rel=0.01)


def test_a_spring_of_one_side_is_written_down_and_holds_on_what_was_not_fitted(paths):
    """It resists only where the angle is positive; no law of the catalogue does."""
    hidden = law(["multiply", -0.8, ["positive", "q"]], {"q": {"of": "position"}})
    effect = {"name": "custom", "location": {"kind": "joint", "name": "hinge"}, "parameters": {}, "law": hidden}
    given = problem(paths, [effect_from(effect, ALL)], steps=225)
    (base,) = fitted(given, [Guess(np.zeros(3))], (0.7, 0.3, 0.1), seed=0)
    given, (base,) = allowing(given, base, [base])
    ranked = [each for each in ranked_locations(given, given.robot, base) if each.location.kind == "body"]
    found = discovered(given, None, given.robot, base, base, ranked, seed=0)
    assert found is not None and found.best is not None
    (written,) = found.best.hypothesis.effects(3)
    assert {each.of for each in written.law.variables if each.name in names_in(written.law.expression)} == {"position"}
    assert found.own_test
    assert found.explained > 0.9
    again = effect_from(written.to_json(), ALL)
    assert replace(again, parameters=written.parameters) == written


def test_products_of_what_forces_change_are_those_of_the_changes(paths):
    """Under the covariance, though only pulses near each other are multiplied."""
    given = problem(paths, [custom(law(["multiply", -0.8, "q"], {"q": {"of": "position"}}))], steps=225)
    (base,) = fitted(given, [Guess(np.zeros(3))], (0.7, 0.3, 0.1), seed=0)
    (best, *_) = (each for each in ranked_locations(given, given.robot, base) if each.location.kind == "body")
    located = LocatedInput(given, given.robot, base, best.estimates[0])
    forces = np.random.default_rng(0).standard_normal((3, *located.force.shape))
    changes, white = np.array([located.changed(each) for each in forces]), located.covariance.white
    with_each_other, with_origin = located.products(np.array([located.at_nodes(each) for each in forces]))
    assert with_each_other == pytest.approx(changes @ changes.T - white(changes) @ white(changes).T)
    explained = white(changes) @ white(located.origin[None])[0]
    assert with_origin == pytest.approx(changes @ located.origin - explained)


WELLS = ["bumps", ["q", "v"], [0.2, 1.0], [[-0.4, 0.0, 0.5], [0.1, 0.0, -0.6], [0.5, 0.0, 0.4]]]


def test_bumps_are_summed_and_kept_in_a_file(tmp_path):
    wells = custom(law(WELLS, {"q": {"of": "position"}, "v": {"of": "velocity"}}))
    sim = flat(servo([wells]))
    sim.batch.qpos[0], sim.batch.qvel[0] = 0.3, 0.5
    centres, weights = np.array([-0.4, 0.1, 0.5]), np.array([0.5, -0.6, 0.4])
    expected = np.exp(-0.5 * (((0.3 - centres) / 0.2) ** 2 + 0.25)) @ weights
    assert exerted(sim) == pytest.approx(expected)
    save_effects([wells], tmp_path / "effects.json")
    assert load_effects(tmp_path / "effects.json", ALL) == (wells,)


def test_a_black_box_describes_what_no_law_does(paths):
    """Of the grammar one term may act, and none is good enough; the box has not seen the recording that judges it."""
    read = {"q": {"of": "position"}, "v": {"of": "velocity"}}
    effects = [custom(law(["multiply", 0.3, WELLS], read))]
    strict = replace(DEFAULT, discovery=replace(DEFAULT.discovery, least_explained=1.1, replayed=(2, 1, 1)))
    given = problem(paths, effects, steps=225, settings=strict)
    (base,) = fitted(given, [Guess(np.zeros(3))], (0.7, 0.3, 0.1), seed=0)
    given, (base,) = allowing(given, base, [base])
    ranked = [each for each in ranked_locations(given, given.robot, base) if each.location.kind == "body"]
    heldout = problem(paths, effects, seed=1, steps=225, settings=strict)
    found = discovered(given, heldout, given.robot, base, base, ranked, seed=0)
    assert found is not None and found.best is not None and found.best.boxed
    assert found.explained > 0.5
    for box in found.best.hypothesis.effects(3):
        assert box.law.limit == pytest.approx(np.abs(found.located.force).max(), rel=1e-6)
        assert effect_from(box.to_json(), ALL).law == box.law


def test_a_rival_finds_the_polynomial_that_a_joint_feels():
    """The bend of one joint turns another: sparse regression leaves a fifth of what parameters alone leave."""
    _, recordings = case("coupled_bends", 1)
    fitted_to, tested, unseen = map(Data.of, recordings)
    parameters = parameters_only(fitted_to)
    alone = error(parameters, nothing, unseen)
    assert error([0.0, 0.0], nothing, fitted_to) > error(parameters, nothing, fitted_to)
    assert error(*sindy(fitted_to, tested, parameters), unseen) < 0.2 * alone


def test_a_law_in_time_is_kept_where_it_comes_again(paths):
    """A hum that begins anew with each recording. One that is late by a tenth of a period is explained to more than the
    least share, but so is one of seven of any phase."""
    quick = replace(DEFAULT, discovery=replace(DEFAULT.discovery, replayed=(2, 1, 1)))

    def hum(late, seed):
        force = ["multiply", 0.1, ["sin", ["multiply", 8.0, ["add", "t", -late]]]]
        return problem(paths, [custom(law(force, {"t": {"of": "time"}}))], seed=seed, steps=120, settings=quick)

    given = hum(0.0, 0)
    (base,) = fitted(given, [Guess(np.zeros(3))], (0.7, 0.3, 0.1), seed=0)
    given, (base,) = allowing(given, base, [base])
    (ranked,) = [each for each in ranked_locations(given, given.robot, base) if each.location.kind == "body"]
    again, late = (discovered(given, hum(by, 1), given.robot, base, base, [ranked], 0) for by in (0.0, 0.08))
    assert again is not None and again.best is not None
    assert late is not None and late.best is None
    assert late.explained > quick.discovery.least_explained


def test_a_result_says_the_law_its_ranges_and_what_it_explains():
    effect = effect_from(
        {"name": "custom", "location": {"kind": "joint", "name": "hinge"}, "parameters": {"c": -0.8},
         "law": law(["multiply", "c", ["positive", "q"]], {"q": {"of": "position", "range": [-0.5, 0.7]}})}, ALL
    )  # fmt: skip
    assert effect.law is not None
    told = DiscoveredLaw(
        location=effect.location, effects=(effect.to_json(),), equations=(effect.law.equation(effect.parameters),),
        legend=effect.law.legend(), estimates=(Estimate("c", -0.8, "N m/rad", -0.9, -0.7),), explained=0.96,
        noise_share=0.001, nearest=0.4, own_test=False, others=(), state=(0.0, 0.5), force=(0.0, -0.41),
        law=(0.0, -0.4), state_label="position [rad]", force_label="input [N m]", peak=0.5,
    )  # fmt: skip
    result = replace(outside_catalogue(), discovery=told)
    assert Result.from_json(result.to_json()).discovery == told
    for text in (" ".join(summary(result).split()), " ".join(html(result).split())):
        assert "outside the catalogue, described by F = -0.8 max(q, 0)" in text
        assert "position, seen from -0.5 to 0.7" in text
        assert "96.0 % of the squared error (0.1 % is noise), the nearest law of the catalogue 40.0 %" in text
    box = replace(result, discovery=replace(told, black_box=True))
    for text in (" ".join(summary(box).split()), " ".join(html(box).split())):
        assert "described by a black box, F = " in text
        assert "It is no law: g is a sum of bumps that says where and how much, not why, 10 N m at most." in text


def test_what_is_seen_in_time_only_has_a_spectrum_and_a_recording_to_make():
    told = DiscoveredLaw(
        location=Location("joint", "hinge"), effects=(), equations=(), legend={}, estimates=(), explained=0.1,
        noise_share=0.001, nearest=0.0, own_test=False, others=(), state=(), force=(), law=(), state_label="",
        force_label="", peak=0.5, peaks=(0.5, 1.25, 3.0),
    )  # fmt: skip
    for found, said in (
        (told, "seen in time only. Its spectrum peaks at 0.5, 1.25 and 3 Hz. Record the same commands twice"),
        (None, "seen in time only. Record the same commands twice"),
    ):
        result = replace(outside_catalogue(), discovery=found)
        assert said in " ".join(summary(result).split())
        assert said in " ".join(html(result).split())


def test_names_in_several_laws_say_where_each_acts():
    one, other = custom(CUBE, k=1.0), custom(CUBE, name="elbow", k=1.0)
    assert list(legend([one])) == ["q"]
    assert list(legend([one, other])) == ["q at joint hinge", "q at joint elbow"]
    read = {"x": {"of": "position", "axis": "x"}, "t": {"of": "time"}}
    push = [custom(law("x", read, unit="N", direction=axis), "body", "arm") for axis in "xyz"]
    assert legend(push) == push[0].law.legend()
    wind = custom(law("t", {"t": {"of": "time"}}), name="elbow")
    at_the_arm = " and".join(f" at body arm along {axis}" for axis in "xyz")
    assert list(legend([*push, wind])) == [f"x{at_the_arm}", "t"]


def test_a_discovered_law_of_several_components_names_each_once():
    box = [custom(law("x", {"x": {"of": "position", "axis": "x"}}, unit="N", direction=axis), "body", "arm")
           for axis in "xyz"]  # fmt: skip
    told = DiscoveredLaw(
        location=box[0].location, effects=tuple(each.to_json() for each in box),
        equations=tuple(f"body arm: F = g{axis}(x) [N] along {axis}" for axis in "xyz"), legend=legend(box),
        estimates=(), explained=0.9, noise_share=0.1, nearest=0.1, own_test=False, others=(), state=(0.0, 0.1),
        force=(0.0, 0.1), law=(0.0, 0.1), state_label="position [m]", force_label="input at body arm along x [N]",
        peak=0.5, black_box=True,
    )  # fmt: skip
    page = " ".join(html(replace(outside_catalogue(), discovery=told)).split())
    assert page.count("<dt>black box</dt>") == page.count("position along x, seen from") == 1
    assert page.count("not why, 10 N at most") == 1
    for axis in "xyz":
        assert page.count(f'<span class="law">body arm: F = g{axis}(x) [N] along {axis}</span>') == 1


def test_bodies_that_cannot_be_told_apart_span_a_region_of_one_branch():
    model = mujoco.MjModel.from_xml_string(HAND)
    named = {name: model.body(name).id for name in ("arm", "hand", "finger", "ball")}
    assert spanned(model, [named["finger"], named["arm"]]) == ("arm", "hand", "finger")
    assert spanned(model, [named["arm"], named["hand"]]) == ("arm", "hand")
    assert spanned(model, [named["finger"], named["ball"]]) == ()


@pytest.mark.parametrize(("joints", "read"), [(11, 10), (19, 0)])
def test_a_law_reads_other_joints_where_there_are_a_dozen(robot_of, joints, read):
    bodies = "".join(
        f'<body><joint name="j{i}" type="slide" damping="1"/><geom size="0.01"/></body>' for i in range(joints)
    )
    mapping = '[robot]\ncontrol_timestep = 0.02\n[signal]\nname = "x"\njoints = ["j0"]\nunit = "m"\n'
    mapping += '[parameters.damping]\nfields = ["dof_damping:j0"]\ndeviation = 0.3\n'
    robot = robot_of(mapping, f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    found = variables_at(robot, Location("joint", "j0"), DEFAULT.discovery)
    assert sum(variable.of == "position" for variable, _ in found) == 1 + read


def test_names_in_laws_are_short_and_distinct_where_elements_have_long_names_that_begin_alike(robot_of):
    joints = [f"left_shadow_hand/finger_{i}" for i in range(9)]
    bodies = "".join(f'<body><joint name="{each}" damping="1"/><geom size="0.01"/></body>' for each in joints)
    motors = "".join(f'<position name="{each}_motor" joint="{each}" kp="1"/>' for each in joints)
    mapping = f"[robot]\ncontrol_timestep = 0.02\n[commands.goal]\nactuators = {[f'{each}_motor' for each in joints]}\n"
    mapping += f'[signal]\nname = "q"\njoints = ["{joints[0]}"]\nunit = "rad"\n'
    mapping += '[parameters.damping]\nfields = ["dof_damping:*"]\ndeviation = 0.3\n'
    robot = robot_of(mapping, f"<mujoco><worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>")
    read, rng = variables_at(robot, Location("joint", joints[0]), DEFAULT.discovery), np.random.default_rng(0)
    meanings = {}
    for term, *_ in groups([Read(each, rng.normal(size=50), unit) for each, unit in read], []):
        said = [(each.name, each) for each in term.variables]
        for state in term.states:
            said += [(name, (state.of, state.input)) for name in (state.name, state.parameter)]
        if not term.states and len(term.variables) == 1:
            said += [(shape.name, term.variables[0].name) for shape in term.shapes]
        for name, meaning in said:
            meanings.setdefault(name_of(name, "a name"), set()).add(meaning)
    assert len(meanings) > len(read) and {len(each) for each in meanings.values()} == {1}


def test_seeds_that_disagree_are_alternatives_with_their_shares():
    outside, healthy = outside_catalogue(), replace(outside_catalogue(), verdict="adequate")
    result = with_seeds([outside, healthy, outside])
    assert [(each.answer, each.count) for each in result.seeds] == [
        ("outside the catalogue at body vertebra4", 2), ("adequate", 1)
    ]  # fmt: skip
    assert Result.from_json(result.to_json()) == Result.from_json(replace(outside, seeds=result.seeds).to_json())
    for text in (summary(result), html(result)):
        said = " ".join(text.replace("\u00a0", " ").split())
        assert "of 3: outside the catalogue at body vertebra4 (0.67), adequate (0.33)" in said
        assert "of 3" not in " ".join(summary(outside).split())
    region = replace(outside, region=("vertebra4", "vertebra5"))
    assert "bodies vertebra4 to vertebra5, best vertebra4" in summary(region)
