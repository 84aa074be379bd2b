"""Sets of hidden cases with other simulators: how they are drawn, written and scored."""

import hashlib
import importlib.util
from collections import Counter

import numpy as np
import pytest

pytest.importorskip("pyarrow")

from benchmarks import hidden_arms as arms
from benchmarks.discovered_laws import TRUNK_FAMILIES, OnTrunk, same_form, trunk_cross_talk
from soro_bench.blind_benchmark.criteria import CRITERIA, OF_OTHERS
from soro_bench.blind_benchmark.draw import Case, draw_cases, draw_parameters
from soro_bench.blind_benchmark.others import HIDDEN, KINDS, LAWS, SOROSIM, OtherCase, build_other, draw_set
from soro_bench.blind_benchmark.report import released
from soro_bench.blind_benchmark.robot import simulate
from soro_bench.blind_benchmark.run import run_blind_benchmark
from soro_bench.blind_benchmark.score import opened_labels, scored
from soro_bench.blind_benchmark.sealed import write_cases
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.effect import effect_from
from soro_bench.files import write_json
from soro_bench.leaderboard.diagnosis_entry import opened, read_entry, rescored, write_entry
from soro_bench.recording.parquet import load
from tests.test_blind_benchmark_score import label, report

DRY = released("friction")
SHORT = {"train": 18.5, "heldout": 1.0, "task": 1.0}  # s; an excitation is no shorter
SEED = 15  # whose only case of another simulator is of the lumped model, with long time steps


def test_half_of_a_set_is_of_other_simulators_and_half_of_these_are_healthy():
    drawn = draw_set(200, 5, sorosim=True)
    others = [case for case in drawn if isinstance(case, OtherCase)]
    assert [case.id for case in drawn] == [f"case_{i:03d}" for i in range(200)]
    assert len(others) == 100 and sum(case.kind == HIDDEN for case in others) == 50
    assert Counter(case.kind for case in others if case.kind != HIDDEN) == dict.fromkeys((*KINDS, SOROSIM), 10)
    laws = Counter(case.law for case in others if case.kind == HIDDEN)
    assert set(laws) == set(LAWS) and max(laws.values()) - min(laws.values()) <= 1
    own = Counter(case.group for case in drawn if isinstance(case, Case))
    assert own == Counter(case.group for case in draw_cases(100, 5))
    assert len({case.seed for case in drawn}) == 200
    assert {case.group for case in others} == {"none", "one", "measurement"}


def test_the_same_seed_draws_the_same_set_and_another_one_does_not():
    assert draw_set(60, 5) == draw_set(60, 5) != draw_set(60, 6)
    assert draw_set(60, 5, others=0) == draw_cases(60, 5)
    assert SOROSIM not in {case.kind for case in draw_set(60, 5) if isinstance(case, OtherCase)}


@pytest.mark.parametrize(("healthy", "others"), [(0, 20), (14, 20), (40, 20), (7, 40), (33, 0)])
def test_as_many_are_healthy_as_are_asked_for(healthy, others):
    drawn = draw_set(40, 1, healthy, others)
    assert sum(case.group == "none" for case in drawn) == healthy
    assert sum(isinstance(case, OtherCase) for case in drawn) == others


@pytest.mark.parametrize(("name", "given"), [("others", {"others": 5}), ("healthy", {"healthy": 5, "others": 1})])
def test_more_than_there_are_cases_is_refused(name, given):
    with pytest.raises(ValueError, match=f"{name} 5: 0 to 4"):
        draw_set(4, 0, **given)


def test_seeds_of_robots_take_turns_and_are_no_longer_than_labels_may_have():
    numbers = [OtherCase("", "cable", turn, (2**59 - 1, turn)).number(6) for turn in range(12)]
    assert [number % 6 for number in numbers] == [*range(6)] * 2
    assert all(1e12 < number < 1e18 for number in numbers)
    assert OtherCase("", "cable", 3, (1, 1)).number(6, 1) % 6 == 3


def test_laws_are_those_that_the_rod_can_have():
    pytest.importorskip("elastica", reason="needs the simulators extra")
    from soro_bench.blind_benchmark.cosserat_laws import HIDDEN as there_are

    assert tuple(there_are) == LAWS
    case = OtherCase("case_000", HIDDEN, LAWS.index("friction"), (1, 1))
    recordings, files, found = build_other(case, SHORT)
    (effect,) = found["effects"]
    assert (found["group"], effect["class"], effect["law"]) == ("one", DRY, "friction") and not files
    assert set(recordings) == set(SHORT) and found["change_mm"]["task"] > 0
    assert set(effect["names"]) == {"coulomb_friction", "stribeck_friction", "load_friction"}


def test_a_set_that_cannot_be_had_leaves_nothing_behind(tmp_path):
    with pytest.raises(ValueError, match="others 9: 0 to 4"):
        run_blind_benchmark(tmp_path / "set", 4, others=9)
    with pytest.raises(FileNotFoundError):
        run_blind_benchmark(tmp_path / "set", 4, others=0, sorosim=tmp_path)
    assert not any(tmp_path.iterdir())


@pytest.mark.skipif(importlib.util.find_spec("elastica") is not None, reason="PyElastica is there")
def test_a_missing_simulator_is_named_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match=r'pip install "\.\[simulators\]"; --others 0'):
        write_cases(tmp_path, 2, 0, others=2, healthy=0)
    assert not any(tmp_path.iterdir())


def files(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_set_is_written_committed_to_and_scored_as_others_are(tmp_path):
    (case,) = draw_set(1, SEED, 1, 1)
    assert case.kind == "cable"
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        write_cases(folder, 1, SEED, healthy=1, durations=SHORT, others=1)
    assert files(first) == files(second)
    committed = (first / "commitment.txt").read_text().strip()
    assert committed == hashlib.sha256((first / "sealed" / "labels.json").read_bytes()).hexdigest()
    (first / "case_000" / "task.parquet").unlink()
    write_cases(first, 1, SEED, healthy=1, durations=SHORT, others=1)
    assert files(first) == files(second)

    (found,) = opened_labels(first)
    assert (found["group"], found["kind"], found["effects"]) == ("none", "cable", [])
    assert set(found["sha256"]) == {path.name for path in (first / "case_000").iterdir()}
    for role, duration in SHORT.items():
        recording = load(first / "case_000" / f"{role}.parquet")
        assert recording.duration == pytest.approx(duration, abs=0.051)
        assert set(recording.metadata) == {"env_id", "action", "noise"} and recording.parameters == {}

    reports = tmp_path / "reports"
    write_json(reports / "case_000.json", report("none", "none", verdict="none_detected"))
    card = rescored(first, reports) | {"ablations": []}
    write_entry(tmp_path / "entry.json", "ours", "a test", first, card)
    entry = read_entry(tmp_path / "entry.json")
    (alarms,) = (gate for gate in entry["gates"] if gate["gate"] == "other simulators, cable: false alarms")
    assert (alarms["cases"], alarms["value"]) == (1, 0.0) and alarms["interval"] == pytest.approx([0.0, 0.975])
    assert entry["set"] == opened(first)


def test_a_rod_has_a_model_of_its_own_and_no_motion_that_is_unseen(tmp_path):
    """Its label is scored without errors on such motion, and others are not."""
    data, cases = tmp_path / "data", tmp_path / "cases"
    data.mkdir()
    forces = [f"{part}_force_{axis}" for part in ("mid", "tip") for axis in "xyz"]
    gravity = [f"gravity_{axis}" for axis in "xyz"]
    (data / "releases.csv").write_text(
        f"take,material,true_damping_s,{','.join([*gravity, *forces])}\nrelease_a,steel,0.01,0,0,-9.81{',0' * 6}\n"
    )
    points = [f"{p}_{a}_m" for p in ("mid", "tip") for a in "xyz"]
    rows = np.tile([0.3, 0, 0, 0.6, 0, 0], (200, 1))
    (data / "release_a.csv").write_text("\n".join([",".join(points), *(",".join(map(str, row)) for row in rows)]))
    seed = next(s for s in range(99) if draw_set(1, s, 1, 1, True)[0].kind == SOROSIM)
    write_cases(cases, 1, seed, healthy=1, durations=SHORT, others=1, sorosim=data)
    (found,) = opened_labels(cases)
    assert set(found["sha256"]) == {"train.parquet", "model.xml", "map.toml", "finer.xml"}
    assert {name: each["unit"] for name, each in found["parameters"].items()} == dict.fromkeys(
        ("stiffness", "mass", "damping"), "1"
    )
    said = report("none", "none", verdict="none_detected")
    write_json(tmp_path / "reports" / "case_000.json", said | {"unseen": None})
    (row,) = rescored(cases, tmp_path / "reports")["cases"]
    assert (row["kind"], row["alarm"], row["fve_unseen"]) == (SOROSIM, False, None)


def test_criteria_about_other_simulators_come_last_and_take_any_right_name():
    """Sets without them have the criteria of earlier releases and the same figures; their thresholds are lower."""
    hidden = label(0, "one", "coulomb_friction", DRY, "tendon", "L2")
    hidden["effects"][0]["names"] = ["coulomb_friction", "load_friction"]
    said = {"case_000": report("load_friction", DRY, "tendon", "L2")}
    gates, earlier = (scored([each], said)["gates"] for each in (hidden | {"kind": HIDDEN}, hidden))
    shared = gates[: len(CRITERIA)]
    assert [(g["gate"], g["value"], g["cases"]) for g in earlier] == [
        (g["gate"], g["value"], g["cases"]) for g in shared
    ]
    assert [gate["gate"] for gate in earlier] == [name for name, *_ in CRITERIA]
    stricter = {g["gate"]: g["bar"] for g, old in zip(shared, earlier, strict=True) if g["bar"] != old["bar"]}
    assert stricter["false alarms"] == 0.01 and stricter["first answer right"] == 0.92 and len(stricter) == 4
    assert [gate["gate"] for gate in gates[len(CRITERIA) :]] == [name for name, *_ in OF_OTHERS]
    found = {gate["gate"]: gate["value"] for gate in gates}
    assert found["other simulators: first answer right"] == 1.0
    assert found["other simulators: of right names, place right"] == 1.0
    assert found["other simulators: false alarms"] is None


def test_gusts_never_come_again_and_a_shaken_base_does():
    """Two recordings of the same commands differ by gusts, and by no more than noise where the base shakes."""
    goals = arms.goals(np.random.default_rng(0))

    def apart(family):
        runs = [arms.simulated(family(np.random.default_rng(3)), goals, np.random.default_rng(k)) for k in (1, 2)]
        return np.abs(runs[0] - runs[1]).max()

    assert apart(arms.periodic_base) < 8 * arms.NOISE < 100 * arms.NOISE < apart(arms.gusts)


def test_gusts_on_a_trunk_never_come_again_and_laws_do():
    """Runs of the same commands for a second; a law moves the trunk."""
    rng, actions = np.random.default_rng(0), np.tile(np.linspace(0.0, 0.5, 8), (20, 1))
    parameters = draw_parameters(rng)
    without = simulate("fine", parameters, [], actions).points
    for family in TRUNK_FAMILIES:
        on_trunk = [OnTrunk(family(np.random.default_rng(3))) for _ in range(2)]
        one, other = (simulate("fine", parameters, [each], actions, (k,)).points for k, each in enumerate(on_trunk))
        assert np.abs(one - without).max() > 1e-3
        assert (np.abs(one - other).max() > 1e-3) == (not on_trunk[0].law.of_state)


def test_a_law_found_in_a_trunk_is_compared_with_the_true_one():
    hidden = trunk_cross_talk(np.random.default_rng(3))
    (read,) = hidden.reads
    place = {"kind": "actuator", "name": read.split()[1]}
    variables = {"u": {"of": "command", "range": [-0.03, 0.03], "location": place}}
    for sign in (1.0, -1.0):
        law = {"unit": "N", "limit": 10.0, "variables": variables, "expression": ["multiply", 90.0 * sign, "u"]}
        at = {"name": "custom", "location": {"kind": "tendon", "name": hidden.where}, "parameters": {}, "law": law}
        assert same_form(hidden, [effect_from(at, ALL)]) == (sign > 0)
