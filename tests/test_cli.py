"""The soro-bench command, as it is called from a shell; what takes minutes is tested without it.

Independent jobs on several processes and on a cluster: the same bytes as one after the other.
"""

import json
import re

import joblib
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

pytest.importorskip("tyro", reason="needs the train extra")

pytest.importorskip("pyarrow", reason="needs the train extra")

pytest.importorskip("rerun", reason="needs the train extra")

pytest.importorskip("joblib", reason="needs the infer extra")


from soro_bench import parallel
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.study import Part, Study
from soro_bench.diagnosis.study_runs import run_study
from soro_bench.files import mjcf_path, write_json
from soro_bench.inference.methods import infer
from soro_bench.inference.replay import SIMULATIONS, Replay
from soro_bench.parallel import HERE, Workers, each, processors
from soro_bench.recording.simulated import record
from soro_bench.registration import ENV_IDS, task_type
from soro_bench.training.ppo import TRAINER
from tests.arm import ARM
from tests.jobs import counted, die, squared, trained
from tests.results import policy


def test_list_shows_every_environment(call):
    text = call("list")
    assert all(env_id in text for env_id in ENV_IDS)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_excite_writes_actions_for_every_robot(call, tmp_path, env_id):
    text = call("excite", env_id, "--out", tmp_path / "actions.csv")
    assert f"soro-bench diagnose RECORDING --env {env_id} --out FOLDER" in text
    table = np.loadtxt(tmp_path / "actions.csv", delimiter=",", skiprows=1)
    task = task_type(env_id)
    assert table.shape[1] == 1 + len(task.moves)
    assert table[1, 0] == pytest.approx(task.control_timestep)
    assert len(table) * task.control_timestep >= 30.0
    assert np.abs(table[:, 1:]).max() <= 1.0


def test_excite_writes_controls_of_a_model(call, paths, tmp_path):
    """In the unit of its commands; an environment and a model at once are refused."""
    paths[0].write_text(ARM.replace('name="motor"', 'name="motor" ctrlrange="-1 1"'))
    robot = ("--model", paths[0], "--map", paths[1])
    assert "soro-bench diagnose RECORDING --model" in call("excite", *robot, "--out", tmp_path / "actions.csv")
    table = np.loadtxt(tmp_path / "actions.csv", delimiter=",", skiprows=1)
    assert table.shape == (1500, 2) and table[1, 0] == 0.02 and 0.1 < np.abs(table[:, 1]).max() < 1.0
    assert (tmp_path / "actions.csv").read_text().startswith("time,actuator motor\n")
    with pytest.raises(SystemExit, match="say which robot moves"):
        call("excite", "TrunkReach-v0", *robot, "--out", tmp_path / "a.csv")


def test_a_recording_is_made_viewed_and_inferred_from(call, tmp_path):
    recording, posterior = tmp_path / "reach.parquet", tmp_path / "posterior.json"
    call("record", "TrunkReach-v0", "--model", "cable", "--steps", "4", "--params", "trunk_mass=0.3",
         "--out", recording)  # fmt: skip
    call("view", recording, "--no-open")
    assert (tmp_path / "reach.rrd").stat().st_size > 0
    call("infer", "sysid", recording, "--env", "TrunkReach-v0", "--model", "cable", "--infer", "trunk_mass",
         "--out", posterior)  # fmt: skip
    with pytest.raises(SystemExit, match="is of TrunkReach-v0, not of TrunkPush-v0"):
        call("infer", "sysid", recording, "--env", "TrunkPush-v0", "--out", posterior)
    with pytest.raises(SystemExit, match="--simulations is a setting of bayes-sim; sysid has none"):
        call("infer", "sysid", recording, "--simulations", "100", "--out", posterior)
    assert json.loads(posterior.read_text())["estimate"]["trunk_mass"] == pytest.approx(0.3, rel=0.01)


@pytest.mark.parametrize("arguments", [
    ("record", "TrunkReach-v0", "--out", "log.csv"),
    ("import", "log.csv", "--out", "log.csv"),
    ("infer", "rf-dropo", "log.parquet", "--out", "log.parquet"),
    ("view", "log.parquet", "--out", "log.parquet", "--no-open"),
    ("excite", "TrunkReach-v0", "--out", "log.parquet"),
])  # fmt: skip
def test_what_is_written_takes_the_place_of_nothing_else(call, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    for name in ("log.csv", "log.parquet"):
        (tmp_path / name).write_text("measured")
    with pytest.raises(SystemExit, match=r"log\..*: expected a name that ends in "):
        call(*arguments)
    assert [(tmp_path / name).read_text() for name in ("log.csv", "log.parquet")] == ["measured"] * 2


def test_a_campaign_is_planned_without_being_run(call, tmp_path):
    text = call("run", "--preset", "quick", "--plan", "--out", tmp_path)
    assert "TrunkReach-v0" in text
    assert not list(tmp_path.rglob("*.safetensors"))


def test_a_diagnosis_of_what_is_no_recording_says_so_and_leaves_no_folder(call, tmp_path):
    (tmp_path / "run.csv").write_text("t,angle\n0,0\n")
    with pytest.raises(SystemExit, match=r"run.csv: no complete Parquet file; soro-bench import makes one"):
        call("diagnose", tmp_path / "run.csv", "--env", "TrunkReach-v0", "--out", tmp_path / "reports" / "run")
    assert not (tmp_path / "reports" / "run").exists()


def test_an_error_is_one_line(call):
    with pytest.raises(SystemExit, match="soro-bench: 60 steps are too few for an excitation; it needs 364"):
        call("excite", "TrunkReach-v0", "--duration", "3", "--out", "a.csv")


def test_a_file_that_is_not_there_is_named_without_a_number_of_the_system(call):
    with pytest.raises(SystemExit, match=r"^soro-bench: nowhere\.json: No such file or directory$"):
        call("report", "nowhere.json", "--out", "report")


@pytest.mark.parametrize("arguments", [
    ("train", "TrunkReach-v0", "--name", "../mine"),
    ("leaderboard", "enter", "POLICY", "--entry", "../mine"),
])  # fmt: skip
def test_names_that_no_entry_could_have_are_refused_before_the_work(call, tmp_path, monkeypatch, arguments):
    def work(*_, **__):
        raise AssertionError("it began to work")

    monkeypatch.setattr("soro_bench.training.ppo.train", work)
    monkeypatch.setattr("soro_bench.leaderboard.enter.enter", work)
    policy().save(tmp_path)
    arguments = [tmp_path if each == "POLICY" else each for each in arguments]
    with pytest.raises(SystemExit, match=r"'../mine': up to 60 letters, digits"):
        call(*arguments)


@pytest.mark.parametrize("arguments", [
    ("study", "bam_servo", "--out", "OUT"),
    ("evaluate", "POLICY", "--on", "cable", "--out", "OUT"),
    ("leaderboard", "enter", "POLICY", "--entry", "me", "--results", "OUT"),
    ("leaderboard", "build", "--results", "POLICY", "--out", "OUT"),
    ("blind-benchmark", "--count", "5", "--out", "OUT"),
    ("run", "--preset", "quick", "--out", "OUT"),
    ("diagnose", "run.parquet", "--env", "TrunkReach-v0", "--out", "OUT"),
    ("infer", "sysid", "run.parquet", "--out", "OUT/posterior.json"),
])  # fmt: skip
def test_where_nothing_can_be_written_is_said_before_the_work(call, tmp_path, arguments):
    """A folder within a file, as whoever mistypes a path may ask for."""
    put_training(trained := tmp_path / "trained")
    (tmp_path / "file").touch()
    if "build" in arguments:
        (trained := tmp_path / "entries").mkdir()
    before = sorted(tmp_path.rglob("*"))
    places = {"OUT": str(tmp_path / "file" / "out"), "POLICY": str(trained)}
    with pytest.raises(SystemExit, match=r"cannot be written to: .*file is no folder, or one that may not be"):
        call(*(re.sub("OUT|POLICY", lambda match: places[match[0]], each) for each in arguments))
    assert sorted(tmp_path.rglob("*")) == before


def put_training(folder):
    """What soro-bench train would leave in a folder."""
    policy().save(folder)
    write_json(folder / "config.json", {"distribution": None, "trainer": TRAINER})
    (folder / "curve.csv").write_text("steps,episodes,final_distance_mm,seconds\n100,1,3.0,0.5\n")


@pytest.mark.parametrize(("arguments", "taken"), [
    (("evaluate", "--on", "cable", "--out", "."), "evaluation_cable.rrd"),
    (("leaderboard", "enter", "--entry", "me", "--results", "results"), "evaluation_flex.rrd"),
    (("leaderboard", "enter", "--entry", "me", "--results", "results"),
     "results/TrunkReach-v0/me/oracle/seed0.safetensors"),
])  # fmt: skip
def test_an_evaluation_that_could_not_be_written_is_not_begun(call, tmp_path, monkeypatch, arguments, taken):
    monkeypatch.chdir(tmp_path)
    put_training(tmp_path)
    (tmp_path / taken).mkdir(parents=True)
    with pytest.raises(SystemExit, match=f"{taken} is a folder; the name of a file is needed"):
        call(*arguments, tmp_path)
    assert not any(path.is_file() for path in tmp_path.rglob("*.rrd"))


def test_a_study_whose_report_could_not_be_written_is_not_begun(tmp_path):
    part = Part("alone", "what is missing", (), (), None)
    (tmp_path / "alone" / "report.html").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"alone/report\.html is a folder"):
        run_study(Study("a", mjcf_path("real/bam_servo.xml"), mjcf_path("real/bam_servo.toml"), (part,)), tmp_path)


def test_a_study_without_its_recordings_says_which_is_missing(call, tmp_path):
    with pytest.raises(SystemExit, match=r"no v4_train.csv in .*opencr_tdcr; --data names another folder"):
        call("study", "opencr_tdcr", "--data", tmp_path, "--out", tmp_path / "out")


def test_the_evaluation_of_another_board_is_not_replaced(call, tmp_path):
    policy().save(tmp_path)
    (tmp_path / "evaluation_cable.json").write_text('{"board": "another"}')
    with pytest.raises(SystemExit, match=r"evaluation_cable.json holds other results: say with --out"):
        call("evaluate", tmp_path, "--on", "cable")


TWO = Workers(jobs=2)


@pytest.fixture(scope="module")
def cluster():
    """Two worker processes that are started again when they are killed; a job may be tried twice."""
    dask = pytest.importorskip("dask", reason="needs the cluster extra")
    distributed = pytest.importorskip("distributed", reason="needs the cluster extra")
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as local,
    ):
        yield Workers(backend="dask", scheduler=local.scheduler_address)


@pytest.fixture(params=["one", "two", "cluster"])
def workers(request):
    return {"one": HERE, "two": TWO}.get(request.param) or request.getfixturevalue("cluster")


def test_results_come_in_the_order_of_the_arguments(workers):
    assert list(each(squared, [(3, 0.3), (2,), (1,)], workers)) == [9, 4, 1]
    assert list(each(squared, [], workers)) == []


def test_an_error_in_a_job_is_raised_with_its_message(workers):
    results = each(squared, [(2,), (-3,), (4,)], workers)
    with pytest.raises(ValueError, match="-3 is negative"):
        list(results)


def test_an_inference_ends_with_the_same_bytes(cluster, tmp_path):
    recording = record("TrunkReach-v0", model="cable", params={"trunk_mass": 0.31}, steps=10)
    settings = {"optimizer": "sampled", "iterations": 1, "popsize": 3, "samples": SIMULATIONS}
    for name, workers in (("one", HERE), ("two", TWO), ("cluster", cluster)):
        replay = Replay(recording, ("trunk_mass", "young_modulus"), threads=1)
        infer("rf-dropo", replay, tmp_path / f"{name}.log", workers=workers, **settings).save(tmp_path / f"{name}.json")
    for suffix in ("json", "log"):
        assert len({(tmp_path / f"{name}.{suffix}").read_bytes() for name in ("one", "two", "cluster")}) == 1


def test_jobs_of_a_worker_that_was_killed_are_done_by_others(cluster, tmp_path):
    # 8 kB: joblib would have kept them on a worker only
    results = list(each(counted, [(tmp_path, i, np.ones(1000)) for i in range(8)], cluster))
    assert results == [i * i + 1000 for i in range(8)]
    computed = sorted(map(int, (tmp_path / "computed").read_text().split()))
    assert computed.count(3) == 2
    assert [i for i in computed if i != 3] == [0, 1, 2, 4, 5, 6, 7]


def test_a_training_whose_worker_is_killed_goes_on_and_ends_with_the_same_bytes(cluster, tmp_path):
    pytest.importorskip("stable_baselines3", reason="needs the train extra")
    here, there = tmp_path / "here", tmp_path / "there"
    assert list(each(trained, [(there, True)], cluster)) == list(each(trained, [(here, False)]))
    assert (there / "died").exists()
    assert (there / "steps").read_text().split() == ["200", "400", "400", "600"]


def test_a_process_that_is_killed_ends_the_command_in_words():
    with pytest.raises(ChildProcessError, match="killed, or ran out of memory"):
        list(each(die, [()] * 2, TWO))
    assert list(each(squared, [(2,)] * 2, TWO)) == [4, 4]


def test_a_job_that_kills_every_worker_is_given_up(cluster):
    with pytest.raises(ChildProcessError, match="workers died"):
        list(each(die, [()], cluster))
    assert list(each(squared, [(2,)], cluster)) == [4]


def test_a_job_knows_its_share_of_the_processors(cluster, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert set(each(processors, [()] * 4, TWO)) == {max(1, joblib.cpu_count() // 2)}
    assert set(each(processors, [()] * 4, cluster)) == {1}
    assert processors() == joblib.cpu_count()
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert processors() == 3


def test_a_worker_that_would_run_several_jobs_in_a_process_is_refused():
    distributed = pytest.importorskip("distributed", reason="needs the cluster extra")
    with distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None) as local:
        workers = Workers(backend="dask", scheduler=local.scheduler_address)
        with pytest.raises(ValueError, match="runs 2 jobs in one process; start it with --nthreads 1"):
            list(each(squared, [(2,)], workers))


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    pytest.importorskip("distributed", reason="needs the cluster extra")
    monkeypatch.setattr(parallel, "TIMEOUT", 0.5)
    wrong = ("nonsense", "tls://127.0.0.1:9", "http://a:1", "tcp://", "tcp://a:99999")
    for address in ("tcp://127.0.0.1:9", *wrong):
        with pytest.raises(ValueError, match=f"no Dask scheduler answers at {address}"):
            list(each(squared, [(2,)], Workers(backend="dask", scheduler=address)))


def test_a_machine_that_is_too_busy_to_ask_a_scheduler_says_so(monkeypatch):
    distributed = pytest.importorskip("distributed", reason="needs the cluster extra")

    def starved(*_, **__):
        raise AssertionError

    monkeypatch.setattr(distributed, "Client", starved)
    with pytest.raises(ValueError, match="this machine is too busy"):
        list(each(squared, [(2,)], Workers(backend="dask", scheduler="tcp://127.0.0.1:9")))


@pytest.mark.parametrize("settings, message", [
    ({"jobs": 0}, "jobs 0: 1 or more are needed"),
    ({"backend": "dask"}, "needs the address of a scheduler"),
    ({"scheduler": "tcp://10.0.0.1:8786"}, "loky has no scheduler"),
    ({"backend": "spark"}, "unknown backend 'spark'; there are loky and dask"),
])  # fmt: skip
def test_settings_that_contradict_each_other_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Workers(**settings)


def test_the_command_line_takes_workers_without_a_prefix(monkeypatch, capsys):
    pytest.importorskip("tyro", reason="needs the train extra")
    from soro_bench import cli

    arguments = ["blind-benchmark", "--out", "folder", "--jobs", "2", "--backend", "dask"]
    command = cli.tyro.extras.subcommand_cli_from_dict(cli.COMMANDS, args=[*arguments, "--scheduler", "tcp://a:1"])
    assert command.workers == Workers(2, "dask", "tcp://a:1")
    monkeypatch.setattr("sys.argv", ["soro-bench", *arguments])
    with pytest.raises(SystemExit, match="soro-bench: backend dask needs the address of a scheduler"):
        cli.main()


class Looked(Exception):
    """Ends what has been looked at."""


@pytest.mark.parametrize("what", ["diagnosis", "inference"])
def test_matrix_products_take_one_thread_however_many_blas_has(what):
    def look(*_):
        raise Looked({library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"})

    recording = record("TrunkReach-v0", model="cable", steps=10, full_state=True)
    with threadpool_limits(2, "blas"), pytest.raises(Looked) as looked:
        if what == "diagnosis":
            diagnose(SuiteRobot("TrunkReach-v0", threads=1), [recording], progress=look)
        else:
            infer("rf-dropo", Replay(recording, threads=1), progress=look)
    assert looked.value.args == ({1},)
