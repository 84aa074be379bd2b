"""Independent jobs: in this process, in several on this machine (joblib), or on a Dask cluster.

docs/how_to/train_many_policies.md.
"""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from distributed import Client

P = ParamSpec("P")
T = TypeVar("T")
TIMEOUT = 10  # s, to reach a scheduler


@dataclass(frozen=True)
class Workers:
    """Where independent jobs run; no result depends on it."""

    jobs: int = 1
    """Jobs at a time on this machine; a cluster computes one on each of its workers."""
    backend: Literal["loky", "dask"] = "loky"
    """loky: processes on this machine. dask: the workers of a Dask cluster, which see the same files."""
    scheduler: str | None = None
    """dask: address of the scheduler, such as tcp://10.0.0.1:8786."""

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise ValueError(f"jobs {self.jobs}: 1 or more are needed")
        if self.backend not in ("loky", "dask"):
            raise ValueError(f"unknown backend {self.backend!r}; there are loky and dask")
        if self.backend == "dask" and not self.scheduler:
            raise ValueError("backend dask needs the address of a scheduler, such as tcp://10.0.0.1:8786")
        if self.backend == "loky" and self.scheduler:
            raise ValueError(f"backend loky has no scheduler; for that of {self.scheduler} say backend dask")


HERE = Workers()  # one job after the other, in this process


def one_blas_thread(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator: the last digits of a matrix product depend on how many threads share it, so one does it all."""
    limited: Callable[P, T] = threadpool_limits.wrap(limits=1, user_api="blas")(function)
    return limited


def each(function: Callable[..., T], arguments: Iterable[tuple[Any, ...]], workers: Workers = HERE) -> Iterator[T]:
    """The results of ``function`` for all arguments, in their order, each as soon as it and those before it are there.

    A job that writes its result into a file of its own can be skipped when the same command is given again, so an
    interruption loses only what is being computed. On a cluster the paths in the arguments have to be absolute, in a
    folder that all its machines share.

    Raises:
        ValueError: no scheduler answers, or a worker of the cluster runs several jobs in one process.
        ChildProcessError: a process on this machine died; or the scheduler, or every worker that took one of the jobs.
    """
    if workers.backend == "dask":
        yield from _on_cluster(function, arguments, workers.scheduler or "")
    elif workers.jobs == 1:
        for given in arguments:
            yield function(*given)
    else:
        yield from _on_this_machine(function, arguments, workers.jobs)


def _on_this_machine(function: Callable[..., T], arguments: Iterable[tuple[Any, ...]], jobs: int) -> Iterator[T]:
    from concurrent.futures import BrokenExecutor

    from joblib import Parallel, delayed

    try:
        yield from Parallel(n_jobs=jobs, return_as="generator")(delayed(function)(*given) for given in arguments)
    except BrokenExecutor as error:
        raise ChildProcessError("a process was killed, or ran out of memory; what is in files is kept, and the same "
                                "command goes on") from error  # fmt: skip


def side_by_side(threads: int, function: Callable[..., T], *arguments: Iterable[Any]) -> list[T]:
    """The results of ``function``, which leaves Python to simulate something of its own, as ``map`` gives them."""
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, *arguments))


def processors() -> int:
    """How many threads the job that calls this may use.

    OMP_NUM_THREADS if it is set: joblib gives each of its processes a share of this machine, Dask's workers have 1 if
    they were not started with another value. Otherwise the processors that this process may run on.
    """
    from joblib import cpu_count

    given = os.environ.get("OMP_NUM_THREADS", "")
    return int(given) if given.isdecimal() and int(given) else cpu_count()


def _on_cluster(function: Callable[..., T], arguments: Iterable[tuple[Any, ...]], scheduler: str) -> Iterator[T]:
    # not joblib's Dask backend (1.6): it waits forever for a job whose workers keep dying, fails when a worker dies
    # that held an argument of more than 1 kB, and gives a cluster 10 s to get its first worker from a queue
    with _client(scheduler) as client:
        from distributed import CancelledError, KilledWorker

        futures = deque(client.submit(_alone, function, *given, pure=False) for given in arguments)
        while futures:
            try:
                yield futures.popleft().result()
            except (KilledWorker, CancelledError) as error:
                raise ChildProcessError(str(error)) from error


def _client(scheduler: str) -> "Client":
    try:
        from distributed import Client
    except ImportError as error:
        raise ImportError("backend dask needs distributed: pip install soro_bench[cluster]") from error
    try:
        _check_address(scheduler)  # a client that could not even begin (distributed 2026.8) takes 20 s to end
        return Client(scheduler, timeout=TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"no Dask scheduler answers at {scheduler}: {error}") from error
    except AssertionError as error:  # of distributed (2026.8), where its own thread does not start within 10 s
        raise ValueError(f"no Dask scheduler answers at {scheduler}: this machine is too busy to ask") from error


def _check_address(address: str) -> None:
    """ValueError for what no scheduler could answer at."""
    from distributed import Security
    from distributed.comm.addressing import parse_address, parse_host_port

    scheme, location = parse_address(address)
    if scheme == "inproc":  # a cluster in this process
        return
    host, port = parse_host_port(location)
    if scheme not in ("tcp", "tls") or not host or not 0 < port < 65536:
        raise ValueError("an address such as tcp://10.0.0.1:8786 is needed")
    if scheme == "tls" and Security().get_connection_args("client")["ssl_context"] is None:
        raise ValueError("Dask's configuration names no certificates for tls")


def _alone(function: Callable[..., T], *given: Any) -> T:
    """Run a job on a worker of the cluster, unless it might run another one in the same process meanwhile."""
    from distributed import get_worker

    worker = get_worker()
    if (threads := worker.state.nthreads) > 1:
        # random generators such as torch's are shared by the threads of a process
        raise ValueError(f"worker {worker.address} runs {threads} jobs in one process; start it with --nthreads 1")
    return function(*given)
