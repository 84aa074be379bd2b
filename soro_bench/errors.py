"""Errors as a command shows them."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from soro_bench.files import shown

_LINE = 1000  # letters of an error: what it quotes may be a stranger's, and long


@contextmanager
def plain_errors(program: str) -> Iterator[None]:
    """One clear line for what a user can mend, no traceback."""
    try:
        yield
    except ModuleNotFoundError as error:
        sys.exit(f"{program}: {error}: pip install 'soro_bench[all]'")
    except (ValueError, OSError, ImportError) as error:
        if sys.flags.dev_mode:  # PYTHONDEVMODE=1: the traceback, to find out where it comes from
            raise
        sys.exit("\n".join(shown(line[:_LINE]) for line in f"{program}: {error}".split("\n")))
    except KeyboardInterrupt:
        sys.exit(f"{program}: interrupted; train, run, infer, study and blind-benchmark resume if repeated")
