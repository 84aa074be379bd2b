"""Independent jobs on the processors of this machine, by joblib."""

from collections.abc import Callable, Iterable, Iterator


def each(function: Callable, arguments: Iterable[tuple], jobs: int = 1) -> Iterator:
    """The results of ``function`` for all arguments, in their order, computed by so many processes.

    A job that writes its result into a file of its own can be skipped when the same command is given again, so an
    interruption loses only what is being computed.
    """
    from joblib import Parallel, delayed

    return Parallel(n_jobs=jobs, return_as="generator")(delayed(function)(*given) for given in arguments)
