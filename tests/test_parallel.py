"""Independent jobs on several processes and on a cluster: the same bytes as one after the other."""

import numpy as np
import pytest

pytest.importorskip("joblib", reason="needs the infer extra")

import joblib
from threadpoolctl import threadpool_info, threadpool_limits

from soro_bench import parallel
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.inference.methods import infer
from soro_bench.inference.replay import SIMULATIONS, Replay
from soro_bench.parallel import HERE, Workers, each, processors
from soro_bench.recording.simulated import record
from tests.jobs import counted, die, squared, trained

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
