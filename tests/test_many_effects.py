"""Several effects at once, and a law at every joint with a magnitude each, on an arm of three joints.

What a model has too much of is taken away, as what it lacks is added: known answers, and the search for them.
"""

import mujoco
import numpy as np
import pytest
from scipy.signal import lfilter

from soro_bench.diagnosis.assembly.findings import estimates_of
from soro_bench.diagnosis.candidates import Term, terms
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.outliers import nominal_fit
from soro_bench.diagnosis.preparation import unexplained
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.selection.forward_selection import Explanation, explained
from soro_bench.diagnosis.selection.screening import evidence, responses
from soro_bench.diagnosis.selection.stopping import (
    explained_beyond_chance,
    falls_beyond_chance,
    independent_values,
    simplest,
)
from soro_bench.diagnosis.spread_terms import alike, spread
from soro_bench.effects.catalogue import ALL, QUANTITIES
from soro_bench.effects.effect import EACH, EVERY, Effect, EffectError, Location, load_effects, save_effects
from soro_bench.effects.elements import instrument
from soro_bench.models.simulation import Simulation
from soro_bench.parameters import ParameterSet
from soro_bench.recording.recording import Recording, Signal
from tests.arm import ARM, MAP, problem

JOINTS, SIGMA = 3, 5e-4


NAMES = [f"j{i}" for i in range(JOINTS)]


def _link(i: int) -> str:
    inner = _link(i + 1) if i + 1 < JOINTS else ""
    return f"""<body name="link{i}" pos="{0.2 if i else 0} 0 0"><joint name="j{i}" axis="0 1 0" damping="0.02"/>
    <geom type="capsule" size="0.01" fromto="0 0 0 0.2 0 0" mass="0.1" contype="0" conaffinity="0"/>{inner}</body>"""


def _listed(*names: str) -> str:
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"


THREE = f"""<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>{_link(0)}</worldbody><actuator>
{"".join(f'<position name="m{i}" joint="j{i}" kp="{8 - 2 * i}" kv="0.2" forcerange="-3 3"/>' for i in range(JOINTS))}
</actuator></mujoco>"""


OF_THREE = f"""[robot]
control_timestep = 0.02
[commands.goal]
actuators = {_listed(*(f"m{i}" for i in range(JOINTS)))}
[signal]
name = "angle"
joints = {_listed(*NAMES)}
unit = "rad"
[initial]
joints = {_listed(*NAMES)}
[parameters.inertia]
fields = {_listed(*(f"body_{what}:link{i}" for i in range(JOINTS) for what in ("mass", "inertia")))}
deviation = 0.2
"""


FRICTION = (0.12, 0.07, 0.045)  # N m


EVERYWHERE = [
    Effect("coulomb_friction", Location("joint", name), {"friction": friction, "presliding": 5e-4})
    for name, friction in zip(NAMES, FRICTION, strict=True)
]


FOUR = [
    Effect("coulomb_friction", Location("joint", "j0"), {"friction": 0.1, "presliding": 5e-4}),
    Effect("actuator_gain", Location("actuator", "m1"), {"gain": 0.85}),
    Effect("payload", Location("body", "link2"), {"mass": 0.06}),
    Effect("backlash", Location("actuator", "m2"), {"width": 0.04}),
]


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    model, mapping = folder / "arm.xml", folder / "map.toml"
    model.write_text(THREE)
    mapping.write_text(OF_THREE)
    return ModelRobot(model, mapping, threads=1, shorter=2)


def hiding(robot, hidden, seed=0, goals=5, inertia=1.1):
    """A recording of the arm with hidden effects and with other inertia, to be explained."""
    rng = np.random.default_rng(seed)
    commands = np.repeat(rng.uniform(-0.6, 0.6, (goals, JOINTS)), 15, axis=0)
    start = np.full((1, JOINTS, 1), 0.1)
    (values,) = robot.simulate(commands, np.array([[inertia]]), [hidden], start)
    values = np.concatenate([start, values])[:, :, 0]
    values += SIGMA * rng.standard_normal(values.shape)
    time = 0.02 * np.arange(len(values))
    seen = Recording({"goal": Signal(time[:-1], commands)}, {"angle": Signal(time, values, "rad")})
    return unexplained(robot, (robot.measured(seen),), SIGMA)


def search(robot, hidden, names, goals=5) -> Explanation:
    """What is found among the laws with some names, with another motion held out."""
    given, nominal = nominal_fit(hiding(robot, hidden, goals=goals), (), 0)
    candidates = [each for each in terms(robot) if each.name in names and not each.removable]
    return explained(given, nominal, robot, (), candidates, 0, heldout=hiding(robot, hidden, 1, goals))


def test_friction_at_every_joint_is_one_term_with_a_magnitude_each(robot):
    found = search(robot, EVERYWHERE, ("coulomb_friction", "viscous_friction", "actuator_gain", "backlash"))
    best = found.found[0]
    (term,) = best.terms
    assert (term.name, str(term.location)) == ("coulomb_friction", "each joint")
    effects = best.effects(found.problem.parameters)
    assert [effect.location.name for effect in effects] == NAMES
    assert [effect.parameters["friction"] for effect in effects] == pytest.approx(FRICTION, rel=0.2)


def test_four_effects_at_once_are_found_and_no_fifth_one(robot):
    found = search(robot, FOUR, [effect.name for effect in FOUR], 6)
    best = found.found[0]
    effects = {(effect.name, effect.location): effect for effect in best.effects(found.problem.parameters)}
    assert effects.keys() == {(effect.name, effect.location) for effect in FOUR}
    for truth in FOUR:
        first = ALL[truth.name].quantities[0]
        value = effects[truth.name, truth.location].parameters[first.name]
        assert value - first.null == pytest.approx(truth.parameters[first.name] - first.null, rel=0.2)


def _friction(robot) -> list[Term]:
    return next(group for group in alike(terms(robot)) if group[0].name == "coulomb_friction")


def test_magnitudes_of_like_elements_have_a_part_in_common(robot):
    """By the prior each varies as it does alone, and any two of them correlate as the settings say."""
    whole = spread(_friction(robot))
    x = np.random.default_rng(0).standard_normal((20_000, whole.size))
    alone = x[:, : 1 + JOINTS] @ whole.mixing
    assert np.cov(alone.T) == pytest.approx(np.where(np.eye(JOINTS), 1.0, whole.settings.common_share), abs=0.03)


def test_coordinates_of_a_law_at_each_element_lead_to_its_effects_and_back(robot):
    members = _friction(robot)
    whole = spread(members)
    x = whole.coordinates_of([0.1, 0.2, 0.3], np.zeros(whole.size))
    expected = [member.effect(np.array([u, 0.0])) for member, u in zip(members, (0.1, 0.2, 0.3), strict=True)]
    for effect, other in zip(whole.effects(x), expected, strict=True):
        assert effect.location == other.location
        assert effect.parameters == pytest.approx(other.parameters)
    assert [effect.parameters["friction"] for effect in whole.effects(whole.simulated)] == pytest.approx([
        member.typical[0] for member in members
    ])


def test_a_law_at_each_element_is_reported_with_a_magnitude_of_each(robot):
    """The common part and that of an element are hardly known apart, and their sum is known well."""
    whole = spread(_friction(robot))
    x = whole.coordinates_of([0.1, 0.2, 0.3], np.zeros(whole.size))
    known = np.linalg.inv(np.pad(whole.mixing @ whole.mixing.T, (0, 1)) / 0.01**2 + np.eye(whole.size))
    found = estimates_of(robot, whole, x, known)
    assert [each.name for each in found] == [*(f"friction at {name}" for name in NAMES), "presliding"]
    for u, each, member in zip((0.1, 0.2, 0.3), found, whole.members, strict=False):
        assert each.unit == "N m"
        assert each.value == pytest.approx(u * member.deviations[0])
        assert each.high - each.value == pytest.approx(1.645 * 0.01 * member.deviations[0], rel=0.02)


def test_a_law_at_each_element_is_screened_from_the_responses_of_its_elements(robot):
    """As well as all of them as terms of their own, but for their priors."""
    given, nominal = nominal_fit(hiding(robot, EVERYWHERE), (), 0)
    members = _friction(robot)
    screened = evidence(given, nominal, members, responses(given, nominal, members, robot))
    together, each = screened.screened_candidate(range(JOINTS)), screened.at_each(spread(members))
    frictions = [[effect.parameters["friction"] for effect in found.effects] for found in (together, each)]
    assert frictions[0] == pytest.approx(frictions[1], rel=0.05)
    guess = screened.guess(each)
    first = len(nominal.x)
    assert guess.jacobian[first] == pytest.approx(np.sqrt(0.8) * np.sum([r[0] for r in screened.responses], axis=0))


def test_effects_files_have_no_law_at_each_element(tmp_path):
    path = tmp_path / "effects.json"
    save_effects([Effect("backlash", Location("actuator", EACH), {"width": 0.1})], path)
    with pytest.raises(EffectError, match="names no location; give every location an effect of its own"):
        load_effects(path, ALL)


def with_effects(given, *found: tuple[Term, Effect]) -> Hypothesis:
    """A hypothesis with nominal parameters, and effects."""
    x = np.concatenate([[0.0], *(term.coordinates(effect.parameters) for term, effect in found)])
    kept = tuple(term for term, _ in found)
    (residual,) = given.residuals([(x, kept)])
    nothing = np.zeros((0, residual.size))
    return Hypothesis(kept, x, residual, given.cost(residual, x), np.zeros((len(x), residual.size)), nothing)


def test_a_term_has_to_lower_the_error_of_another_motion_beyond_chance_or_goes(robot):
    given, heldout = (hiding(robot, FOUR[:1], seed, 8, 1.0) for seed in (0, 1))
    acts, idle = _friction(robot)[0], _friction(robot)[1]
    nothing = Effect(idle.name, idle.location, {"friction": 1e-9, "presliding": 5e-4})
    none, one = with_effects(given), with_effects(given, (acts, FOUR[0]))
    two = with_effects(given, (acts, FOUR[0]), (idle, nothing))
    assert falls_beyond_chance(heldout, none, one)
    assert not falls_beyond_chance(heldout, one, two)
    assert simplest(given, heldout, [two, one]) is one
    assert simplest(given, None, [two, one]) is one
    assert simplest(given, heldout, [one, none]) is None


MOTOR, HINGE = Location("actuator", "motor"), Location("joint", "hinge")


SERVO = ARM.replace("<position", "<general").replace(
    'kp="2" kv="0.05"', 'gainprm="2" biastype="affine" biasprm="0 -2 -0.05"'
)


STIFF = ARM.replace('kp="2" kv="0.05"', 'kp="4" kv="0.1"')


LIMITED = ARM.replace('"-1 1"', '"-0.25 0.25"')


LATE = ARM.replace("forcerange", 'nsample="10" interp="linear" delay="0.04" forcerange')


SLOW = SERVO.replace("forcerange", 'dyntype="filterexact" actearly="true" dynprm="0.04" forcerange')


STICKY = ARM.replace('damping="0.02"', 'damping="0.02" frictionloss="0.06"')


TAKEN = {  # an effect on a model, and the same model with other numbers
    "limit": (LIMITED, Effect("actuator_saturation", MOTOR, {"loss": -1.0}), LIMITED.replace("0.25", "0.5")),
    "part of a delay": (LATE, Effect("actuator_delay", MOTOR, {"delay": -0.03}), LATE.replace("0.04", "0.01")),
    "delay": (LATE, Effect("actuator_delay", MOTOR, {"delay": -0.04}), ARM),
    "part of a filter": (SLOW, Effect("actuator_lag", MOTOR, {"time_constant": -0.03}), SLOW.replace("0.04", "0.01")),
    "filter": (SLOW, Effect("actuator_lag", MOTOR, {"time_constant": -0.04}), SERVO),
    "dry friction": (STICKY, Effect("coulomb_friction", HINGE, {"friction": -0.02}), STICKY.replace("0.06", "0.04")),
    "damping": (ARM, Effect("viscous_friction", HINGE, {"damping": -0.015}), ARM.replace("0.02", "0.005")),
    "all damping": (ARM, Effect("viscous_friction", HINGE, {"damping": -1.0}), ARM.replace("0.02", "0")),
    "softness": (ARM, Effect("compliance", MOTOR, {"compliance": -0.25}), STIFF),
}  # fmt: skip


def moved(xml, effects):
    """(300,) rad, the hinge under a changing goal."""
    sim = Simulation(instrument(mujoco.MjSpec.from_string(xml)).compile(), ParameterSet(), (), 1, 1, effects)
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.begin(np.arange(1))
    angles = []
    for step in range(300):
        sim.batch.ctrl[:] = 0.6 * np.sin(0.05 * step) + 0.3 * (step > 150)
        sim.step(np.arange(1), 1)
        angles.append(sim.batch.qpos[0, 0])
    return np.array(angles)


@pytest.mark.parametrize("case", TAKEN)
def test_what_is_taken_away_leaves_a_model_with_less(case):
    model, effect, other = TAKEN[case]
    found, expected = moved(model, [effect]), moved(other, [])
    assert found == pytest.approx(expected, abs=1e-12)
    assert np.abs(found - moved(model, [])).max() > 1e-3


def test_nothing_is_taken_from_a_model_that_has_nothing():
    with pytest.raises(EffectError, match=r"delay of actuator_delay is -0.01.*nothing to take it from.*0 or more"):
        moved(ARM, [Effect("actuator_delay", MOTOR, {"delay": -0.01})])


TWO = LATE.replace(
    "</worldbody>", '<body pos="0 1 0"><joint name="other"/><geom size="0.1"/></body></worldbody>'
).replace("</actuator>", '<motor name="free" joint="other"/></actuator>')


BOTH = ("actuator_gain", "pretension", "local_stiffness")


@pytest.fixture
def paths(tmp_path):
    def written(xml):
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        folder.mkdir()
        model, mapping = folder / "arm.xml", folder / "map.toml"
        model.write_text(xml)
        mapping.write_text(MAP)
        return model, mapping

    return written


def test_there_are_candidates_of_both_signs(paths):
    """Gains, offsets and stiffness have them in one term; what the model has of a law is taken away by another one."""
    found = terms(ModelRobot(*paths(TWO), threads=1))
    taken = {(each.name, str(each.location)) for each in found if each.removable}
    expected = [("actuator_delay", MOTOR), ("actuator_saturation", MOTOR), ("compliance", MOTOR)]
    assert taken == {(name, str(location)) for name, location in [*expected, ("viscous_friction", HINGE)]}
    for each in found:
        low, high = each.bounds
        assert (low[0] < 0 < high[0]) == (each.name in BOTH or (not QUANTITIES[each.name][0].takes and low[0] < 0))
        assert (low <= each.simulated).all() and (each.simulated <= high).all()
    assert set(BOTH) <= {each.name for each in found}


def test_what_all_locations_have_is_taken_away_at_all_of_them_too(paths):
    several = LIMITED.replace("</actuator>", '<motor name="second" joint="hinge" forcerange="-2 2"/></actuator>')
    found = terms(ModelRobot(*paths(several), threads=1))
    taken = [each.location for each in found if each.name == "actuator_saturation" and each.removable]
    assert taken == [Location("actuator", EVERY), MOTOR, Location("actuator", "second")]


def test_the_delay_of_a_model_is_as_long_with_shorter_time_steps(paths):
    """MuJoCo remembers a number of samples, and each is shorter then."""
    late, plain = paths(LATE), paths(ARM)
    goals = np.repeat([[0.0], [0.5]], 20, axis=0)

    def angles(robot):
        return robot.simulate(goals, np.array([[1.0, 1.0, 0.0]]), [()], np.zeros((1, 1)))[0].ravel()

    for shorter in (1, 4):
        found, undelayed = (angles(ModelRobot(*each, threads=1, shorter=shorter)) for each in (late, plain))
        assert found[22:] == pytest.approx(undelayed[20:-2], abs=1e-3)  # 0.04 s are two control steps


@pytest.mark.parametrize(
    ("model", "real", "name", "location", "value"),
    [
        (LIMITED, ARM, "actuator_saturation", MOTOR, -3.0),
        (LATE, ARM, "actuator_delay", MOTOR, -0.04),
        (STICKY, ARM, "coulomb_friction", HINGE, -0.06),
    ],
    ids=["limit", "delay", "friction"],
)
def test_what_a_model_has_too_much_of_is_found_with_its_size(paths, model, real, name, location, value):
    given = problem(paths(model), real=paths(real), steps=75)
    given, nominal = nominal_fit(given, (), 0)
    candidates = [each for each in terms(given.robot) if QUANTITIES[each.name][0].takes or each.name in BOTH]
    found = explained(given, nominal, given.robot, (), candidates, 0)
    (term,) = found.found[0].terms
    (effect,) = found.found[0].effects(given.parameters)
    assert (term.name, term.location) == (name, location)
    assert effect.parameters[QUANTITIES[name][0].name] == pytest.approx(value, rel=0.1)


def of_time(kind, rng, count=225, dt=0.02):
    """(T, 1) of a disturbance that never comes again."""
    time = dt * np.arange(count)[:, None]
    if kind == "offset":
        return np.full((count, 1), rng.standard_normal())
    if kind == "hum":
        return rng.standard_normal() * np.sin(8.0 * time) + rng.standard_normal() * np.cos(8.0 * time)
    kept = np.exp(-dt / 0.5)
    driven = np.sqrt(1.0 - kept**2) * rng.standard_normal((count, 1))
    driven[0] = rng.standard_normal()
    return lfilter([1.0], [1.0, -kept], driven, axis=0)


@pytest.mark.parametrize("kind", ["offset", "hum", "gusts"])
def test_a_disturbance_that_never_comes_again_is_not_explained_by_another_one(paths, kind):
    """But for 2.3 % of pairs, as a normal value passes two standard errors; a law that leaves a thousandth is kept."""
    heldout, rng, accepted = problem(paths(ARM), steps=225), np.random.default_rng(0), 0
    for _ in range(400):
        one, other = of_time(kind, rng), of_time(kind, rng)
        share = 1.0 - float(((other - one) ** 2).sum() / (other**2).sum())
        accepted += share > 0.0 and explained_beyond_chance(heldout, other.ravel(), share)
        assert explained_beyond_chance(heldout, other.ravel(), 0.999)
    assert accepted <= 0.03 * 400


@pytest.mark.parametrize(("kind", "expected"), [("offset", (1.0, 1.0)), ("hum", (1.5, 2.5)), ("gusts", (3.0, 9.0))])
def test_independent_values_of_a_residual(kind, expected):
    """Of nine half seconds, in two recordings twice as many, and no more by a second joint that moves alike."""
    rng = np.random.default_rng(1)
    rows = [of_time(kind, rng) for _ in range(20)]
    low, high = expected
    assert low - 1e-9 <= np.median([independent_values([each]) for each in rows]) <= high + 1e-9
    assert independent_values([rows[0], rows[0]]) == pytest.approx(2.0 * independent_values([rows[0]]))
    assert independent_values([rows[0] @ [[1.0, -0.5]]]) == pytest.approx(independent_values([rows[0]]))
    noisy = [each + np.sqrt((each**2).mean()) * rng.standard_normal(each.shape) for each in rows]  # half is noise
    assert np.median([independent_values([each], 0.5) for each in noisy]) <= 1.2 * high


@pytest.mark.parametrize(("share", "expected"), [(0.99, True), (0.6, False)])
def test_a_law_of_large_angles_is_held_out_in_few_windows(paths, share, expected):
    """It explains nearly all of two seconds of five."""
    heldout = problem(paths(ARM), steps=225)
    time = heldout.recordings[0].time
    residual = 100.0 * ((time < 1.0) * np.sin(np.pi * time) - ((time > 3.0) & (time < 4.0)))
    assert explained_beyond_chance(heldout, residual, share) == expected
