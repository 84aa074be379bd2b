"""The ``soro-bench`` command."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

try:
    import tyro
    from rich.text import Text

    from soro_bench.commands.blind_benchmark import BlindBenchmark
    from soro_bench.commands.campaign import RunPreset
    from soro_bench.commands.leaderboard import Evaluate, Leaderboard
    from soro_bench.commands.learning import Infer, Train
    from soro_bench.commands.recording import Data, Import, Record, View
    from soro_bench.diagnosis.commands import Check, Diagnose, Excite, Map, Report, Study
    from soro_bench.progress import console, table
except ImportError as error:
    sys.exit(f"soro-bench needs more than the core install: pip install soro_bench[all] ({error})")

from soro_bench.errors import plain_errors
from soro_bench.models.simulation import quiet
from soro_bench.registration import ENV_IDS, task_type


@dataclass
class List:
    """Show the environments and their parameters."""

    def run(self) -> None:
        """Print a table for every environment."""
        for env_id in ENV_IDS:
            task = task_type(env_id)
            names = ("parameter", "nominal", "unit", "bounds", "search box", "meaning")
            title = Text.assemble((env_id, "bold"), f": {len(task.evaluation)} evaluation episodes")
            lines = table(*names, title=title, wraps="meaning")
            for p in task.parameters.parameters.values():
                name = Text(f"{p.name} *", "bold") if p.name in {q.name for q in task.randomized} else p.name
                bounds, search = ("{:g} .. {:g}".format(*pair) for pair in (p.bounds, p.search))
                lines.add_row(name, f"{p.nominal:g}", p.unit, bounds, search, p.meaning)
            console.print(lines)
        console.print("* what uniform randomisation (UDR) draws, from the search box")


class Command(Protocol):
    """A command: its arguments are the fields of a dataclass."""

    def run(self) -> None:
        """Do it; ValueError for what a user can mend."""


COMMANDS: dict[str, Callable[..., Command]] = {
    "list": List,
    "run": RunPreset,
    "train": Train,
    "evaluate": Evaluate,
    "record": Record,
    "infer": Infer,
    "import": Import,
    "data": Data,
    "view": View,
    "excite": Excite,
    "map": Map,
    "diagnose": Diagnose,
    "report": Report,
    "check": Check,
    "study": Study,
    "blind-benchmark": BlindBenchmark,
    "leaderboard": Leaderboard,
}
ALIASES = {"prove": "blind-benchmark"}  # names of the version before, which go with the next one


def main() -> None:
    """Entry point. MuJoCo's warnings are neither printed nor logged to a file in the working directory."""
    arguments = [ALIASES.get(each, each) if i == 0 else each for i, each in enumerate(sys.argv[1:])]
    with plain_errors("soro-bench"), quiet():
        tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="soro-bench", args=arguments).run()


if __name__ == "__main__":
    main()
