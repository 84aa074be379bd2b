"""Several effects at once, and a law at every joint with a magnitude each, on an arm of three joints."""

import numpy as np
import pytest

from soro_bench.diagnosis.assembly.findings import estimates_of
from soro_bench.diagnosis.candidates import Term, terms
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.pipeline import unexplained
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.selection.forward_selection import Explanation, explained, nominal_fit
from soro_bench.diagnosis.selection.screening import evidence, responses
from soro_bench.diagnosis.selection.stopping import falls_beyond_chance, simplest
from soro_bench.diagnosis.spread_terms import alike, spread
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.effect import EACH, Effect, EffectError, Location, load_effects, save_effects
from soro_bench.recording.recording import Recording, Signal

JOINTS, SIGMA = 3, 5e-4
NAMES = [f"j{i}" for i in range(JOINTS)]


def _link(i: int) -> str:
    inner = _link(i + 1) if i + 1 < JOINTS else ""
    return f"""<body name="link{i}" pos="{0.2 if i else 0} 0 0"><joint name="j{i}" axis="0 1 0" damping="0.02"/>
    <geom type="capsule" size="0.01" fromto="0 0 0 0.2 0 0" mass="0.1" contype="0" conaffinity="0"/>{inner}</body>"""


def _listed(*names: str) -> str:
    return "[" + ", ".join(f'"{name}"' for name in names) + "]"


ARM = f"""<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>{_link(0)}</worldbody><actuator>
{"".join(f'<position name="m{i}" joint="j{i}" kp="{8 - 2 * i}" kv="0.2" forcerange="-3 3"/>' for i in range(JOINTS))}
</actuator></mujoco>"""
MAP = f"""[robot]
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
    model.write_text(ARM)
    mapping.write_text(MAP)
    return ModelRobot(model, mapping, threads=1, shorter=2)


def problem(robot, hidden, seed=0, goals=5, inertia=1.1):
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
    given, nominal = nominal_fit(problem(robot, hidden, goals=goals), (), 0)
    candidates = [each for each in terms(robot) if each.name in names and not each.removable]
    return explained(given, nominal, robot, (), candidates, 0, heldout=problem(robot, hidden, 1, goals))


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
    given, nominal = nominal_fit(problem(robot, EVERYWHERE), (), 0)
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
    given, heldout = (problem(robot, FOUR[:1], seed, 8, 1.0) for seed in (0, 1))
    acts, idle = _friction(robot)[0], _friction(robot)[1]
    nothing = Effect(idle.name, idle.location, {"friction": 1e-9, "presliding": 5e-4})
    none, one = with_effects(given), with_effects(given, (acts, FOUR[0]))
    two = with_effects(given, (acts, FOUR[0]), (idle, nothing))
    assert falls_beyond_chance(heldout, none, one)
    assert not falls_beyond_chance(heldout, one, two)
    assert simplest(given, heldout, [two, one]) is one
    assert simplest(given, None, [two, one]) is one
    assert simplest(given, heldout, [one, none]) is None
