"""``soro-bench record``, ``import``, ``data`` and ``view``."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from soro_bench.files import check_output, replacing
from soro_bench.options import EnvId
from soro_bench.progress import ReadingBar, console, table
from soro_bench.recording.recording import NOTES, Recording


@dataclass
class Record:
    """Simulate one episode and save its signals as a recording."""

    env: EnvId
    out: Path
    """The file to write, .parquet."""
    policy: str = "random"
    """random, excitation (rest, triangles, loops, holds, sums of sines), the folder of a trained policy, or the .json
    of a leaderboard entry."""
    params: tuple[str, ...] = ()
    """Physical parameters such as trunk_mass=0.3; the others are nominal."""
    model: str | None = None
    """The environment's model or mesh; the accurate one by default."""
    action: Literal["discrete", "continuous"] | None = None
    """Continuous by default, or what the trained policy needs."""
    steps: int | None = None
    """The environment's length by default; 30 s, or as long as it needs, for an excitation."""
    seed: int = 0
    noise: float = 0.0
    """Standard deviation [m] of normal noise on all positions; orientations are as noisy as 12.5 mm off the centre."""
    full_state: bool = False
    """Record the simulation's whole state too, which DROPO restarts from."""
    effects: Path | None = None
    """JSON file of physics that the model leaves out (docs/reference/effects.md); for a robot to try a diagnosis on."""

    def run(self) -> None:
        """Simulate, save and describe the recording; ValueError names an option that is wrong."""
        from soro_bench.leaderboard.entry import load_policy
        from soro_bench.recording.parquet import save
        from soro_bench.recording.simulated import parse_params, record

        check_output(self.out, ".parquet")
        recording = record(
            self.env, self.policy, self.model, self.action, parse_params(self.params), self.steps, self.seed,
            self.noise, self.full_state, self.effects, load_policy,
        )  # fmt: skip
        save(recording, self.out)
        _describe(recording, self.out)


@dataclass
class Import:
    """Turn a log into a recording: a table, arrays, a bag, motion capture or a LeRobot dataset."""

    file: Annotated[Path, tyro.conf.Positional]
    """.csv, .npz, .mcap and others (docs/reference/recordings.md), or the folder of a LeRobot dataset."""
    out: Path | None = None
    """The file to write, .parquet; with --guess .toml, beside the log by default."""
    mapping: Path | None = None
    """TOML file that says what is what (docs/how_to/import_a_log.md); a LeRobot dataset needs none."""
    episode: int | None = None
    """Which episode of a LeRobot dataset (the first by default) or of arrays."""
    guess: bool = False
    """Write a mapping that the file suggests, to be corrected, instead of a recording."""

    def run(self) -> None:
        """Read, save and describe the recording; RecordingError says what is wrong with the file or its mapping."""
        from soro_bench.recording.importers import import_recording
        from soro_bench.recording.parquet import save

        if self.guess:
            return self._guess()
        if self.out is None:
            raise ValueError("write --out with the name of the .parquet file, or --guess for a mapping to begin with")
        check_output(self.out, ".parquet")
        selection = {} if self.episode is None else {"episode": self.episode}
        begin = time.monotonic()
        with ReadingBar() as bar:
            recording = import_recording(self.file, self.mapping, bar, **selection)
        took = time.monotonic() - begin
        save(recording, self.out)
        _describe(recording, self.out)
        size = f"{self.file.stat().st_size / 1e6:.1f} MB " if self.file.is_file() else ""
        console.print(f"{size}read and checked in {took:.1f} s", soft_wrap=True)

    def _guess(self) -> None:
        """Write a mapping; ValueError if there is one already or if there is nothing to guess from."""
        from soro_bench.recording.importers import guess_mapping

        if self.mapping is not None or self.episode is not None:
            raise ValueError("--guess writes a mapping: leave --mapping and --episode out")
        out = self.out or self.file.with_suffix(".toml")
        check_output(out, ".toml")
        if out.exists():
            raise ValueError(f"{out} is there already and may hold corrections: write --out with another name")
        text = guess_mapping(self.file)
        with replacing(out) as temporary:
            temporary.write_text(text, encoding="utf-8")
        console.print(
            f"{out}: correct it, then\n"
            f"soro-bench import {self.file} --mapping {out} --out {self.file.with_suffix('.parquet')}",
            soft_wrap=True,
        )


@dataclass
class Data:
    """Get published recordings of real robots, and check them; docs/how_to/import_a_log.md."""

    robots: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Which; without any, all are listed, and what of them is there."""
    out: Path = Path("data/real")
    """Folder with a folder for each robot."""

    def run(self) -> None:
        """List the robots, or fetch the chosen ones; ValueError names an unknown robot or a file that cannot be had."""
        from soro_bench.recording.published import fetch, sources, summary

        known = sources()
        if unknown := [name for name in self.robots if name not in known]:
            raise ValueError(f"robot {unknown[0]!r} is unknown; there are {', '.join(known)}")
        for name in self.robots or known:
            if self.robots:
                fetch(known[name], self.out / name)
            text = summary(name, known[name], self.out / name)
            console.print(text, soft_wrap=True)


@dataclass
class View:
    """Open a recording in the rerun viewer; a .parquet one beside the simulated robot."""

    recording: Annotated[Path, tyro.conf.Positional]
    """.rrd, or .parquet, whose actions are replayed."""
    out: Path | None = None
    """Where to write the .rrd of a .parquet; beside it by default."""
    open: bool = True
    """Whether to open the viewer."""

    def run(self) -> None:
        """Draw a .parquet beside its replay, and open the viewer; ValueError if the file cannot be shown."""
        from soro_bench.recording.rerun_log import open_viewer

        path = self.recording
        if path.suffix not in (".rrd", ".parquet") or not path.is_file():
            raise ValueError(f"{path} is no recording; expected is a file .rrd or .parquet")
        if path.suffix == ".rrd" and self.out:
            raise ValueError(f"--out {self.out} is for the .rrd of a .parquet; {path} is one already")
        if path.suffix == ".parquet":
            from soro_bench.recording.parquet import load
            from soro_bench.recording.rerun_stream import require_rerun

            require_rerun()
            from soro_bench.recording.rerun_runs import write_comparison

            path = self.out or path.with_suffix(".rrd")
            check_output(path, ".rrd")
            recording = load(self.recording)
            if "env_id" not in recording.metadata:
                raise ValueError(f"{self.recording} is of no environment that could be simulated beside it; of other "
                                 "robots soro-bench diagnose writes comparison.rrd")  # fmt: skip
            write_comparison(recording, path, self.recording.stem)
            console.print(f"{path}", soft_wrap=True)
        if self.open:
            open_viewer(path)


def _describe(recording: Recording, path: Path) -> None:
    names = ("signal", "samples", "per s", "shape", "unit", "frame", "least", "largest", "gaps")
    lines = table(*names, title=f"{path}: {recording.duration:g} s")
    for name, signal in (*recording.commands.items(), *sorted(recording.signals.items())):
        count, shape = len(signal.time), " x ".join(map(str, signal.values.shape[1:]))
        rate = f"{1 / np.median(np.diff(signal.time)):.4g}" if count > 1 else ""
        gaps = int(np.isnan(signal.values.reshape(count, -1)).any(axis=1).sum())
        seen = signal.values[~np.isnan(signal.values)]
        ends = (f"{seen.min():.4g}", f"{seen.max():.4g}") if seen.size else ("", "")
        lines.add_row(name, str(count), rate, shape, signal.unit, signal.frame, *ends, str(gaps or ""))
    console.print(lines)
    for note in recording.metadata.get(NOTES, "").splitlines():
        console.print(f"note: {note}", soft_wrap=True)
