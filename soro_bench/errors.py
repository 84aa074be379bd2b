"""Errors as a command shows them."""

import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from soro_bench.files import shown

_LENGTH = 1000  # letters of an error: what it quotes may be a stranger's, and long
_HINT = re.compile(  # of NumPy and of PyTorch, to load what could run any code
    r"(Object arrays cannot|Cannot load file|This file contains pickled).*?(allow_pickle=False|pickle\.load\(\)`\.)"
    r"|Weights only load failed.*",
    re.DOTALL,
)
# what PyTorch, CUDA and Warp say of the machine; their other RuntimeErrors are mistakes of a program
_MACHINE = {
    "not enough memory": re.compile(r"out of memory|can't allocate memory|not enough memory|[Ff]ailed to allocate"),
    "no GPU that can be used": re.compile(
        r"No CUDA GPUs|no CUDA-capable device|no NVIDIA driver|invalid device ordinal|driver version is insufficient"
        r"|CUDA-capable device.* busy or unavailable"
    ),
}
_NOT_LOADED = "it holds pickled Python objects, which are never loaded; only numbers are read"


class SeveralErrors(ValueError):
    """Several errors at once; ``messages`` has a line for each."""

    def __init__(self, messages: Sequence[str]) -> None:
        super().__init__("\n".join(messages))
        self.messages = tuple(messages)


def one_line(error: BaseException | str) -> str:
    """What an error of any library says, as one printable line of at most 1,000 letters.

    Lines are joined with semicolons. Instead of a hint of NumPy or PyTorch to load pickles it says that they are
    never loaded. An error without a message is named by its type.

    Args:
        error: an exception, or its message.
    """
    said = _HINT.sub(_NOT_LOADED, _of_file(error) or str(error))
    lines = (" ".join(line.split()).strip(" ;") for line in said.splitlines())
    return shown("; ".join(line for line in lines if line) or type(error).__name__)[:_LENGTH]


def _of_file(error: BaseException | str) -> str:
    """What the system says of one file, without a number of its own; "" for any other error."""
    if not isinstance(error, OSError) or not error.strerror or error.filename is None or error.filename2 is not None:
        return ""
    return f"{error.filename}: {error.strerror}"


def missing(error: BaseException) -> str:
    """What the machine lacks, memory or a GPU, if an error is about that; else ""."""
    if isinstance(error, MemoryError):
        return "not enough memory"
    said = str(error) if isinstance(error, RuntimeError) else ""
    return next((what for what, words in _MACHINE.items() if words.search(said)), "")


@contextmanager
def plain_errors(program: str) -> Iterator[None]:
    """One clear line for what a user can mend, no traceback."""
    try:
        yield
    except ModuleNotFoundError as error:
        sys.exit(f"{program}: {one_line(error)}: pip install 'soro_bench[all]'")
    except (ValueError, OSError, ImportError) as error:
        if sys.flags.dev_mode:  # PYTHONDEVMODE=1: the traceback, to find out where it comes from
            raise
        messages = error.messages if isinstance(error, SeveralErrors) else [error]
        sys.exit("\n".join([f"{program}: {one_line(messages[0])}", *map(one_line, messages[1:])]))
    except (MemoryError, RuntimeError) as error:
        if sys.flags.dev_mode or not (what := missing(error)):
            raise
        first = str(error).strip().partition("\n")[0]  # CUDA adds lines on how to find mistakes of a program
        sys.exit(f"{program}: {what}: {one_line(first or error)}")
    except KeyboardInterrupt:
        sys.exit(f"{program}: interrupted; train, run, infer, study and blind-benchmark resume if repeated")
