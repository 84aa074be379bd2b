"""Options that several commands take."""

import re
from collections.abc import Iterable
from typing import Annotated

import tyro

from soro_bench.parallel import Workers

EnvId = Annotated[str, tyro.conf.Positional]
Parallel = Annotated[Workers, tyro.conf.arg(name="")]  # --jobs, --backend, --scheduler
# --known a=1 b=2, and --known a=1 --known b=2
KnownParameters = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction]

MAX_NAME = 60  # letters
FOLDER = r"^[A-Za-z0-9][A-Za-z0-9._+-]{0,59}$"  # what a leaderboard calls methods and entries, which are folders there


MAX_SEED = 1_000_000  # of a training that is to be entered


def joined(groups: Iterable[Iterable[str]]) -> list[str]:
    """The texts of an option that may be given several times."""
    return [text for group in groups for text in group]


def check_seed(seed: int) -> None:
    """ValueError for the seed of a training that could not be entered."""
    if not 0 <= seed <= MAX_SEED:
        raise ValueError(f"seed {seed}: 0 to {MAX_SEED} are allowed")


def check_name(what: str, name: str) -> None:
    """ValueError if a method or an entry could not be called so."""
    if not re.fullmatch(FOLDER, name):
        raise ValueError(f"{what} {name!r}: up to 60 letters, digits and ._+- are allowed, a letter or digit first")
