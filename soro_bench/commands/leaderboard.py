"""``soro-bench evaluate`` and ``leaderboard``: enter a policy, verify entries, build the page."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from soro_bench.files import shown
from soro_bench.options import check_name
from soro_bench.progress import console
from soro_bench.registration import task_type


@dataclass
class Evaluate:
    """Run a policy on the fixed evaluation episodes and record them."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Folder with policy.json and policy.safetensors, or an entry of the leaderboard, .json."""
    board: str | None = None
    """Which evaluation, such as TrunkLift-v0-50g; by default the first of the policy's environment."""
    on: str | None = None
    """Which of its conditions, such as cable or flex; the accurate model by default."""
    out: Path | None = None
    """Folder for the results; the policy's own by default; an entry needs it."""

    def run(self) -> None:
        """Play the policy, write its results and recording; ValueError names an option that is wrong."""
        from soro_bench.files import read_json, results_folder, write_json
        from soro_bench.leaderboard.boards import board_of
        from soro_bench.leaderboard.enter import record_evaluations
        from soro_bench.leaderboard.entry import load_policy

        policy, out = load_policy(self.policy), self.out or self.policy
        if out.suffix == ".json":
            raise ValueError(f"{out} is an entry: say with --out where its results go")
        name, board = board_of(policy.card.env_id, self.board)
        label = self.on or task_type(board.env_id).accurate
        path = out / f"evaluation_{label}.json"
        before = read_json(path) if path.exists() else {"board": name}
        if not isinstance(before, dict) or before.get("board") != name:
            raise ValueError(f"{path} holds other results: say with --out where those on {name} go")
        with results_folder(out, [path.name]):
            scores = record_evaluations(policy, name, (board.labelled(label),), out)
            write_json(path, {"board": name, **scores})
        final = scores[label]["final_mm"]
        mean, solved = sum(final) / len(final), sum(scores[label]["success"])
        said = f"{name} on {label}: final {board.metric} {mean:.2f} mm, mean of {len(final)} episodes; {solved} solved"
        console.print(said, soft_wrap=True)


@dataclass
class Build:
    """Write the page of all entries, index.html; an invalid entry stops it before anything is written."""

    out: Path
    """Folder for the page, the entries' files and recordings."""
    results: Path = Path("leaderboard", "results")
    """Folder of the entries."""
    record: bool = False
    """Also record the best policy of every method in every condition, for the Rerun viewer."""

    def run(self) -> None:
        """Write the page and say where it is; ValueError if there is no folder of entries."""
        from soro_bench.leaderboard.page import build

        if not self.results.is_dir():
            raise ValueError(f"{self.results} is no folder; --results says where the entries are")
        with console.status("entries ...") as status:
            page = build(self.results, self.out, self.record, lambda stage: status.update(f"{stage} ..."))
        console.print(f"{page}", soft_wrap=True)


@dataclass
class Enter:
    """Evaluate a policy that soro-bench train has written, on all conditions of its board, and write its entry."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Folder of the training."""
    entry: str
    """Who, or which code base, trained it: the name of the folder of all its entries."""
    board: str | None = None
    """Such as TrunkLift-v0-50g; by default the first of the policy's environment."""
    results: Path = Path("leaderboard", "results")
    """Folder of the entries."""
    replace: bool = False
    """Take the place of another policy's entry of the same names and seed."""

    def run(self) -> None:
        """Evaluate the policy and write its entry; ValueError if another policy has the place."""
        from soro_bench.leaderboard.boards import board_of
        from soro_bench.leaderboard.enter import enter
        from soro_bench.policies.policy import Policy

        card = Policy.load(self.policy).card
        for what, name in {"entry": self.entry, "method": card.method}.items():  # before the work, not after it
            check_name(what, name)
        board, _ = board_of(card.env_id, self.board)
        with console.status(f"evaluation on {board} ..."):
            path = enter(self.policy, board, self.entry, self.results, replace_other=self.replace)
        console.print(f"{path}", soft_wrap=True)


@dataclass
class Verify:
    """Compute the figures of entries again and compare them exactly; exit status 1 if one differs."""

    entries: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """.json files; a folder or .zip stands for all in it. What they hold is never executed."""
    labels: tuple[str, ...] = ()
    """Control: which conditions, such as cable; by default all that were entered."""
    cases: Path | None = None
    """Diagnosis: folder with the sealed labels and their digest."""
    reports: Path | None = None
    """Diagnosis: folder with the report of every case."""
    release: Path | None = None
    """Diagnosis: a file of docs/results/releases, .json.xz, which holds both."""

    def run(self) -> None:
        """Print whether each entry reproduces; the exit status is 1 if one does not."""
        if not self.entries:
            raise ValueError("say which entries to verify: soro-bench leaderboard verify ENTRY.json ...")
        differs = False
        for given in self.entries:
            for path, part, found in self._lines(given):
                console.print(f"{path}: {part}: {found}", soft_wrap=True)
                differs = differs or found.startswith("differs")
        if differs:
            sys.exit(1)

    def _lines(self, given: Path) -> Iterator[tuple[Path, str, str]]:
        """(entry, part, what is found) of all entries that a path stands for; an invalid one stops no other."""
        try:
            paths = _entries(given)
        except (ValueError, OSError) as error:
            paths = []
            yield given, "refused", f"differs: {shown(str(error))}"
        for path in paths:
            try:
                lines = self._verified(path)
            except (ValueError, OSError) as error:
                lines = {"refused": f"differs: {shown(str(error))}"}
            yield from ((path, part, found) for part, found in lines.items())

    def _verified(self, path: Path) -> dict[str, str]:
        from soro_bench.leaderboard import diagnosis_entry
        from soro_bench.leaderboard.strict import read_strict
        from soro_bench.leaderboard.verify import verify_control, verify_diagnosis, verify_release

        if read_strict(path).get("format") != diagnosis_entry.FORMAT:
            return verify_control(path, self.labels)
        if self.release:
            return verify_release(path, self.release)
        if not self.cases or not self.reports:
            raise ValueError(f"{path} is an entry of the diagnosis: --cases and --reports, or --release, say what to "
                             "score again")  # fmt: skip
        return verify_diagnosis(path, self.cases, self.reports)


def _entries(given: Path) -> list[Path]:
    """The entry files that a path stands for: itself, or all of a folder or archive of a method or an entry."""
    from soro_bench.leaderboard.entry import entries_of
    from soro_bench.packed import SUFFIX, archive_of, folders

    if given.suffix == SUFFIX and given.is_file():
        chosen = folders(given)
    elif given.suffix == ".json":
        return [given]
    else:
        inner = [path for path in given.iterdir() if path.is_dir()] if given.is_dir() else []
        chosen = [given, *inner, *(folders(archive_of(given)) if archive_of(given).is_file() else ())]
    if not (found := sorted({path for folder in chosen for path in entries_of(folder)})):
        raise ValueError(f"{given} has no entries")
    return found


@dataclass
class Pack:
    """Move the files of all seeds of a method, or of all methods of an entry, into one archive beside the folder;
    nothing else reads differently."""

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Of methods or entries: leaderboard/results/BOARD/ENTRY/METHOD or leaderboard/results/BOARD/ENTRY."""

    def run(self) -> None:
        """Print the archive of each folder."""
        from soro_bench.leaderboard.entry import pack_entries

        for folder in self.folders:
            console.print(f"{pack_entries(folder)}", soft_wrap=True)


@dataclass
class Leaderboard:
    """The leaderboard: its page, and whether its entries reproduce."""

    command: tyro.conf.OmitSubcommandPrefixes[
        Annotated[Build, tyro.conf.subcommand("build")]
        | Annotated[Enter, tyro.conf.subcommand("enter")]
        | Annotated[Pack, tyro.conf.subcommand("pack")]
        | Annotated[Verify, tyro.conf.subcommand("verify")]
    ]

    def run(self) -> None:
        """Run the chosen command."""
        self.command.run()
