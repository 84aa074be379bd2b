"""The ``soro-bench`` command."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

try:
    import tyro
    from rich.table import Table
    from rich.text import Text

    from soro_bench.blind_benchmark.commands import Prove
    from soro_bench.campaign.commands import RunPreset
    from soro_bench.diagnosis.commands import Diagnose, Excite, Study
    from soro_bench.inference.commands import Infer
    from soro_bench.leaderboard.commands import Evaluate, Leaderboard
    from soro_bench.progress import console
    from soro_bench.recording.commands import Data, Import, Record, View
    from soro_bench.training.commands import Train
except ImportError as error:
    sys.exit(f"soro-bench needs more than the core install: pip install soro_bench[all] ({error})")

from soro_bench.files import shown
from soro_bench.registration import ENV_IDS, task_type

_LINE = 1000  # letters of an error: what it quotes may be a stranger's, and long


@dataclass
class List:
    """Show the environments and their parameters."""

    def run(self) -> None:
        for env_id in ENV_IDS:
            task = task_type(env_id)
            table = Table(
                "parameter", "nominal", "unit", "bounds", "search box", "meaning",
                title=Text.assemble((env_id, "bold"), f": {len(task.evaluation)} evaluation episodes"),
                title_justify="left",
            )  # fmt: skip
            for p in task.parameters.parameters.values():
                name = Text(f"{p.name} *", "bold") if p.name in {q.name for q in task.randomized} else p.name
                bounds, search = ("{:g} .. {:g}".format(*pair) for pair in (p.bounds, p.search))
                table.add_row(name, f"{p.nominal:g}", p.unit, bounds, search, p.meaning)
            console.print(table)
        console.print("* what the published study randomises")


COMMANDS = {
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
    "diagnose": Diagnose,
    "study": Study,
    "prove": Prove,
    "leaderboard": Leaderboard,
}


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
        sys.exit(f"{program}: interrupted; train, run, infer, study and prove go on where they were, given again")


def main() -> None:
    """Entry point."""
    with plain_errors("soro-bench"):
        tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="soro-bench").run()


if __name__ == "__main__":
    main()
