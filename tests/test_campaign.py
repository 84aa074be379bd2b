"""Campaigns: what is planned, and one run from training to its entry."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the train extra")
pytest.importorskip("rerun", reason="needs the view extra")

from soro_bench import packed
from soro_bench.campaign.campaign import Seen, carry_out_all, state
from soro_bench.campaign.plan import (
    BOXES,
    MORE_SEEDS,
    SEEDS,
    UNMODELLED,
    chosen,
    paper,
    runs_of,
    variance_for_deviation,
)
from soro_bench.campaign.run import Run, carry_out
from soro_bench.commands.campaign import InferenceBaseline, UniversalBaseline, campaign
from soro_bench.diagnosis.render import render
from soro_bench.files import read_json, write_json
from soro_bench.leaderboard.boards import BOARDS, board_of
from soro_bench.leaderboard.enter import _check_fixed, enter
from soro_bench.leaderboard.entry import policy_of, read_entry
from soro_bench.leaderboard.page import build
from soro_bench.leaderboard.verify import verify_control
from soro_bench.parallel import HERE
from soro_bench.parameters import ALL_PARAMETERS
from soro_bench.policies.policy import Policy
from soro_bench.randomization import TruncatedNormal, Uniform, from_dict
from soro_bench.registration import task_type
from soro_bench.training.configuration import PPOConfig
from soro_bench.training.methods import MEMORY, ORACLE, Method, fixed, udr, universal
from soro_bench.training.ppo import TRAINER, train
from tests.results import adequate

TINY = PPOConfig(
    "TrunkReach-v0", total_steps=400, num_envs=2, rollout_steps=100, rollouts_per_segment=1, batch_size=100, epochs=1,
    hidden=(8,),
)  # fmt: skip


@pytest.fixture
def small_board(monkeypatch):
    """TrunkReach with two goals, on the cheap model only."""
    board = BOARDS["TrunkReach-v0"]
    cable = replace(board.conditions["cable"], starts=board.conditions["cable"].starts[:2])
    monkeypatch.setitem(BOARDS, "TrunkReach-v0", replace(board, conditions={"cable": cable}))


def test_the_paper_has_a_run_for_every_cell_of_its_tables():
    """Ten seeds of what claims 1 and 2 compare, ten boxes of uniform randomisation, three seeds of others' methods;
    no two runs share a name."""
    runs = paper()
    names = {run.name for run in runs}
    assert len(names) == len(runs)
    for board in ("TrunkReach-v0", "TrunkPush-v0"):
        for method in ("oracle", "rf_dropo", "rf_dropo_cable", "dr_box", "memory", "bayes_sim", "bayes_sim_variance"):
            assert {f"{board}/{method}/seed{k}" for k in MORE_SEEDS} <= names
        assert {f"{board}/udr/seed{k}" for k in BOXES} <= names
        for method in ("droid", "universal_rf_dropo", "universal_rf_dropo_cable", "oracle_memory"):
            assert {f"{board}/{method}/seed{k}" for k in SEEDS} <= names
    for method in ("rf_dropo_unmodelled", "bayes_sim_unmodelled"):
        assert {f"TrunkPush-v0/{method}/seed{k}" for k in MORE_SEEDS} <= names
    for board in [name for name in BOARDS if name.startswith(("TrunkLift", "MultiGait"))]:
        assert {f"{board}/{method}/seed{k}" for method in ("dr", "no_dr") for k in SEEDS} <= names


def test_runs_are_trained_on_the_cheap_model_unless_their_name_says_otherwise():
    for run in paper():
        task = task_type(run.config.env_id)
        expected = task.accurate if run.method.name == f"oracle_{task.accurate}" else task.cheap
        assert run.config.model == expected, run.name


def test_what_a_board_fixes_is_fixed_in_training(tmp_path):
    rng = np.random.default_rng(0)
    lift = runs_of("TrunkLift-v0-100g", ORACLE, [0]) + runs_of("TrunkLift-v0-100g", udr(), [0])
    for run in [run for run in [*paper(), *lift] if BOARDS[run.board].fixed]:
        drawn = run.distribution(tmp_path).sample(rng)
        for name, value in BOARDS[run.board].fixed.items():
            assert drawn[name] == pytest.approx(value), run.name


def test_a_policy_that_was_trained_with_something_else_than_its_board_gives_is_refused(tmp_path):
    heavy, light = (runs_of(f"TrunkLift-v0-{mass}", ORACLE, [0])[0].distribution(tmp_path) for mass in ("100g", "50g"))
    _check_fixed("TrunkLift-v0-50g", None, tmp_path)  # the nominal mass
    _check_fixed("TrunkLift-v0-100g", heavy.to_dict(), tmp_path)
    for distribution in (None, light.to_dict()):
        with pytest.raises(ValueError, match=r"TrunkLift-v0-100g gives: cube_mass = 0.1"):
            _check_fixed("TrunkLift-v0-100g", distribution, tmp_path)


def test_a_box_holds_what_is_known(tmp_path):
    box = udr(UNMODELLED).distribution("TrunkPush-v0", 3, tmp_path)
    assert box.sample(np.random.default_rng(0))["young_modulus"] == UNMODELLED["young_modulus"]
    known, free = (each.to_dict()["parameters"] for each in (box, udr().distribution("TrunkPush-v0", 3, tmp_path)))
    assert {name for name in free if known[name] != free[name]} == {"young_modulus"}


def test_variances_are_taken_for_deviations_in_published_units(tmp_path):
    """0.1 kg becomes 0.01 kg, and 500 kPa become 250,000 kPa."""
    own = TruncatedNormal(("trunk_mass", "young_modulus"), np.array([0.4, 4e6]), np.array([0.1, 5e5]))
    wrong = variance_for_deviation(Method("m", lambda *_: own)).distribution("TrunkReach-v0", 0, tmp_path / "b" / "c")
    assert wrong.std == pytest.approx([0.01, 2.5e8])


def test_only_some_runs_are_chosen_by_parts_of_their_names():
    assert {run.board for run in chosen(paper(), ["TrunkLift"])} == {"TrunkLift-v0-50g", "TrunkLift-v0-100g"}
    with pytest.raises(ValueError, match=r"no run's name holds TrunkFly; there are.*TrunkReach-v0/oracle"):
        chosen(paper(), ["TrunkFly"])


def test_runs_can_be_sent_to_other_machines():
    cloudpickle = pytest.importorskip("cloudpickle")
    for run in paper():
        assert cloudpickle.loads(cloudpickle.dumps(run)).name == run.name


def test_a_run_ends_in_an_entry_whose_policy_is_the_trained_one(small_board, tmp_path):
    known = fixed("known", Uniform(("trunk_mass",), np.array([0.4]), np.array([0.4])))
    runs = [Run("TrunkReach-v0", method, TINY) for method in (ORACLE, udr(), MEMORY, universal(known))]
    work, results, seen = tmp_path / "work", tmp_path / "results", []
    carry_out_all(runs, work, results, HERE, lambda share, active: seen.append(share))
    assert seen[-1] == 1.0
    for run in runs:
        path = run.result(results)
        entry, trained = read_entry(path), Policy.load(work / run.name)
        found = policy_of(path, entry)
        assert found.card == trained.card
        assert all(np.array_equal(found.tensors[name], trained.tensors[name]) for name in trained.tensors)
        assert (work / run.name / "evaluation_cable.rrd").exists()
    assert read_json(runs[0].result(results))["distribution"] is None
    from_dict(read_json(runs[1].result(results))["distribution"])
    assert read_json(runs[2].result(results))["training"]["settings"]["frames"] == MEMORY.frames
    assert read_json(runs[3].result(results))["training"]["told"]["trunk_mass"] == 0.4
    assert verify_control(runs[2].result(results)) == verify_control(runs[3].result(results)) == {"cable": "same"}


def test_an_entry_takes_the_place_of_no_other_policy_unasked(small_board, tmp_path):
    results, folders = tmp_path / "results", []
    for seed, name in ((0, "a"), (1, "b")):
        folders.append(tmp_path / name)
        train(replace(TINY, seed=seed, method="own"), folders[-1])
        card = folders[-1] / "policy.json"
        card.write_text(json.dumps(json.loads(card.read_text()) | {"seed": 0}))
    first = enter(folders[0], "TrunkReach-v0", "me", results)
    before = first.read_bytes()
    assert enter(folders[0], "TrunkReach-v0", "me", results) == first  # the same policy once more
    with pytest.raises(ValueError, match=r"seed0.json is the entry of another policy; --replace"):
        enter(folders[1], "TrunkReach-v0", "me", results)
    assert first.read_bytes() == before
    assert enter(folders[1], "TrunkReach-v0", "me", results, replace_other=True).read_bytes() != before


def test_what_is_no_training_of_ours_is_refused_before_it_is_evaluated(small_board, tmp_path):
    train(TINY, tmp_path / "a")
    config = read_json(tmp_path / "a" / "config.json")
    for told in ([1], {"trunk_mass": "0.4"}, {"trunk_mass": math.inf}):
        (tmp_path / "a" / "config.json").write_text(json.dumps(config | {"told": told}))
        with pytest.raises(ValueError, match=r"told is .*finite|no JSON"):
            enter(tmp_path / "a", "TrunkReach-v0", "me", tmp_path)
    write_json(tmp_path / "a" / "config.json", config)
    (tmp_path / "a" / "curve.csv").write_text("steps\n")
    with pytest.raises(ValueError, match=r"curve.csv has no rows"):
        enter(tmp_path / "a", "TrunkReach-v0", "me", tmp_path)
    (tmp_path / "a" / "curve.csv").write_text("steps\n3\n")
    with pytest.raises(ValueError, match=r"curve.csv is no table of steps, episodes"):
        enter(tmp_path / "a", "TrunkReach-v0", "me", tmp_path)
    (tmp_path / "a" / "config.json").write_text(json.dumps({"distribution": config["distribution"]}))
    with pytest.raises(ValueError, match=r"config.json lacks trainer"):
        enter(tmp_path / "a", "TrunkReach-v0", "me", tmp_path)
    (tmp_path / "a" / "config.json").write_text("[1]")
    with pytest.raises(ValueError, match=r"config.json lacks distribution, trainer"):
        enter(tmp_path / "a", "TrunkReach-v0", "me", tmp_path)
    with pytest.raises(ValueError, match=r"config.json describes no training: it is \[1\]"):
        train(TINY, tmp_path / "a")
    card = read_json(tmp_path / "a" / "policy.json")
    (tmp_path / "a" / "policy.json").write_text(json.dumps(card | {"method": 5}))
    with pytest.raises(ValueError, match="method is 5; expected str"):
        enter(tmp_path / "a", "TrunkReach-v0", "me", tmp_path)


def test_a_run_that_fails_costs_no_other(small_board, tmp_path):
    def fails(*_):
        raise ValueError("no distribution")

    runs = [Run("TrunkReach-v0", method, TINY) for method in (Method("broken", fails), ORACLE)]
    failures = carry_out_all(runs, tmp_path, tmp_path / "results", HERE)
    assert failures == ["TrunkReach-v0/broken/seed0: no distribution"]
    assert [run.done(tmp_path / "results") for run in runs] == [False, True]
    assert "no distribution" in (tmp_path / runs[0].name / "error.txt").read_text()


def test_the_page_of_a_campaign_is_written_whatever_fails(small_board, tmp_path):
    def fails(*_):
        raise ValueError("no distribution")

    runs = [Run("TrunkReach-v0", method, TINY) for method in (Method("broken", fails), ORACLE)]
    with pytest.raises(ValueError, match=r"1 of 2 runs failed:\nTrunkReach-v0/broken/seed0: no distribution"):
        campaign(runs, tmp_path, tmp_path / "results", HERE)
    assert "oracle" in (tmp_path / "index.html").read_text()


def test_a_page_that_could_not_be_written_is_said_before_the_work(small_board, tmp_path):
    (run,) = [Run("TrunkReach-v0", ORACLE, TINY)]
    with pytest.raises(ValueError, match=r"is within .*; choose another folder for the page"):
        campaign([run], tmp_path / "out", tmp_path, HERE)
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "notes.json").write_text("{}")
    with pytest.raises(ValueError, match=r"notes.json"):
        campaign([run], tmp_path / "out", tmp_path / "results", HERE)
    assert not (tmp_path / "out").exists()


def test_that_rerun_is_switched_off_is_said_before_the_work(small_board, tmp_path, monkeypatch):
    adequate().save(tmp_path / "result.json")
    (run,) = [Run("TrunkReach-v0", ORACLE, TINY)]
    monkeypatch.setenv("RERUN", "Off")
    for work in (
        lambda: carry_out(run, tmp_path / "work", tmp_path / "results"),
        lambda: build(tmp_path / "results", tmp_path / "page", record=True),
        lambda: render(adequate(), tmp_path),
    ):
        with pytest.raises(ValueError, match=r"^recordings need rerun, which .* RERUN=Off switches off; unset it$"):
            work()
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]


def test_a_method_that_was_changed_is_told_from_what_was_trained(small_board, tmp_path):
    def boxed(low):
        return Run("TrunkReach-v0", fixed("box", Uniform(("trunk_mass",), [low], [0.5])), TINY)

    carry_out_all([boxed(0.4)], tmp_path, tmp_path / "results", HERE)
    assert boxed(0.4).done(tmp_path / "results")
    with pytest.raises(ValueError, match="was trained on parameters drawn otherwise than box says"):
        boxed(0.3).done(tmp_path / "results")


def test_what_could_not_be_entered_is_refused_before_the_training():
    with pytest.raises(ValueError, match="seed 20260101: 0 to 1000000"):
        Run("TrunkReach-v0", ORACLE, replace(TINY, seed=20260101))
    with pytest.raises(ValueError, match="the method 'my method'"):
        Run("TrunkReach-v0", Method("my method", None), TINY)
    with pytest.raises(ValueError, match="seeds 0, 0: one of them comes twice"):
        runs_of("TrunkReach-v0", ORACLE, (0, 0))


def test_an_environment_without_a_board_or_with_others_is_an_error_in_words():
    with pytest.raises(ValueError, match="TrunkFly-v0 has no board; there are TrunkReach-v0"):
        board_of("TrunkFly-v0")
    with pytest.raises(ValueError, match="TrunkLift-v0 has no board 'TrunkReach-v0'; it has TrunkLift-v0-50g"):
        board_of("TrunkLift-v0", "TrunkReach-v0")
    assert board_of("TrunkLift-v0")[0] == "TrunkLift-v0-50g"


def test_finished_runs_are_not_carried_out_again(small_board, tmp_path):
    (run,) = [Run("TrunkReach-v0", ORACLE, TINY)]
    run.result(tmp_path).parent.mkdir(parents=True)
    training = {"trainer": TRAINER, "settings": run.config.settings()}
    run.result(tmp_path).write_text(json.dumps({"training": training, "distribution": None}))
    carry_out_all([run], tmp_path / "work", tmp_path, HERE)
    assert not (tmp_path / "work").exists()
    for name, value in (("total_steps", 600), ("discount", 0.5)):
        other = replace(run, config=replace(TINY, **{name: value}))
        with pytest.raises(ValueError, match=f"was trained with {name} .*, not {value}"):
            carry_out_all([other], tmp_path / "work", tmp_path, HERE)
    # with other settings, too
    run.result(tmp_path).write_text(json.dumps({"training": {"trainer": TRAINER - 1}}))
    assert not run.done(tmp_path)


def test_the_state_of_a_campaign_is_read_from_its_files(tmp_path):
    one, other = (Run("TrunkReach-v0", ORACLE, replace(TINY, seed=seed)) for seed in (0, 1))
    curve = tmp_path / one.name / "curve.csv"
    curve.parent.mkdir(parents=True)
    curve.write_text("steps,seconds,episodes,final_distance_mm,return\n200,1.0,2,50.125,-3.0\n")
    share, active = state([one, other], tmp_path, tmp_path / "results", seen := Seen())
    assert share == pytest.approx(0.25 * 0.95)
    assert active == [f"{one.name}: 200 of 400 steps, 50.125 mm in training"]
    curve.write_text(curve.read_text() + "400,2.0,2,40.125,-3.0\n")
    assert state([one, other], tmp_path, tmp_path / "results", seen)[1] == [f"{one.name}: 400 of 400 steps, evaluation"]


@pytest.mark.parametrize("table", ["", "steps\n", "steps,final_mm\n200\n", "episodes\n2\n", "steps\n2\n", "\xff\n1"])
def test_a_table_that_is_none_does_not_end_the_progress_of_other_runs(table, tmp_path):
    (run,) = [Run("TrunkReach-v0", ORACLE, TINY)]
    curve = tmp_path / run.name / "curve.csv"
    curve.parent.mkdir(parents=True)
    curve.write_text(table, encoding="latin-1")
    assert state([run], tmp_path, tmp_path / "results", Seen()) == (0.0, [f"{run.name}: begins"])


def test_who_watches_a_campaign_reads_an_archive_of_entries_only_when_it_has_changed(tmp_path, monkeypatch):
    (run,) = [Run("TrunkReach-v0", ORACLE, TINY)]
    read, read_bytes = [], packed.read_bytes

    def noted(path, *args, **how):
        read.append(path)
        return read_bytes(path, *args, **how)

    monkeypatch.setattr(packed, "read_bytes", noted)
    folder, seen = run.result(tmp_path).parent, Seen()
    for trainer, share in ((TRAINER - 1, 0.0), (TRAINER, 1.0)):
        training = {"trainer": trainer, "settings": run.config.settings()}
        archive = packed.pack(folder, {"seed0.json": json.dumps({"training": training, "distribution": None}).encode()})
        read.clear()
        assert state([run], tmp_path / "work", tmp_path, seen) == (share, []) and archive in read
        read.clear()
        assert state([run], tmp_path / "work", tmp_path, seen) == (share, []) and not read


def test_seeds_and_steps_are_those_asked_for():
    runs = runs_of("TrunkPush-v0", ORACLE, (4, 7), steps=64_000, model="flex")
    assert [(r.config.seed, r.config.total_steps, r.config.model) for r in runs] == [
        (4, 64_000, "flex"),
        (7, 64_000, "flex"),
    ]


@pytest.mark.parametrize("options", [InferenceBaseline, UniversalBaseline])
def test_baselines_with_many_options_have_names_that_fit(options, monkeypatch):
    chosen = []
    monkeypatch.setattr(options, "carry_out", lambda _, method: chosen.append(method))
    known = ("young_modulus=3600000.5", "trunk_mass=0.4200000001")
    options(HERE, "TrunkReach-v0", known=known).run("rf-dropo")
    runs_of("TrunkReach-v0", chosen[0], [0])


def test_a_method_decides_what_its_policies_remember_and_are_told(small_board, tmp_path):
    """A universal policy is told the means of what the method found, and nominal values of the rest."""
    found = Uniform(("trunk_mass",), np.array([0.3]), np.array([0.4]))
    (told,) = runs_of("TrunkReach-v0", universal(fixed("half", found)), [0], steps=100)
    (remembers,) = runs_of("TrunkReach-v0", MEMORY, [0], steps=100)
    box = told.distribution(tmp_path)
    values = told.told(box, tmp_path)
    assert (told.name, remembers.config.frames) == ("TrunkReach-v0/universal_half/seed0", MEMORY.frames)
    assert values["trunk_mass"] == 0.35 and values["young_modulus"] == ALL_PARAMETERS["young_modulus"].nominal
    assert tuple(values) == box.names and remembers.told(box, tmp_path) == {}


def test_a_policy_is_told_what_its_board_gives(tmp_path):
    """In training the object always has that mass: with another one the policy has never acted."""
    found = Uniform(("wall_offset",), np.array([0.0]), np.array([0.01]))
    (run,) = runs_of("TrunkLift-v0-100g", universal(fixed("half", found)), [0], steps=100)
    box = run.distribution(tmp_path)
    values = run.told(box, tmp_path)
    assert values == {"wall_offset": 0.005, "cube_mass": 0.1} and tuple(values) == box.names
