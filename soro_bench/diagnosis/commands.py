"""``soro-bench excite``, ``map``, ``diagnose``, ``report``, ``check`` and ``study``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from soro_bench.files import check_folder, check_output, read_json, results_folder
from soro_bench.options import KnownParameters, joined
from soro_bench.progress import StageStatus, console, table

if TYPE_CHECKING:
    from soro_bench.diagnosis.active import Source
    from soro_bench.diagnosis.robots.robot import Robot
    from soro_bench.recording.recording import Recording


@dataclass
class Excite:
    """Write the actions that show what a robot does: the recording that a diagnosis needs."""

    out: Path
    """.csv with a row per control step: time [s], and the action of every channel: from -1 to 1 for an environment, in
    the model's units for a robot of your own."""
    env: Annotated[str | None, tyro.conf.Positional] = None
    """Environment whose robot moves; or --model and --map."""
    model: Path | None = None
    """MJCF file of another robot, from someone you trust: MuJoCo opens every file that a model names."""
    map: Path | None = None
    """TOML file that says which actuators are commanded, and how often (docs/reference/robot_map.md)."""
    recording: Path | None = None
    """.parquet of such a robot, whose commands say how far actuators without a range may go."""
    duration: float | None = None
    """s; 30 by default, or what it takes."""
    seed: int = 0

    def run(self) -> None:
        check_output(self.out, ".csv")
        if self.env and not (self.model or self.map or self.recording):
            self._of_environment(self.env)
        elif self.model and self.map and not self.env:
            self._of_model(self.model, self.map)
        else:
            raise ValueError("say which robot moves: an environment, or --model ROBOT.xml --map MAP.toml")

    def _of_model(self, model: Path, map_file: Path) -> None:
        from soro_bench.diagnosis.robots.model_robot import ModelRobot
        from soro_bench.recording.excitation import write_actions
        from soro_bench.recording.parquet import load

        robot = ModelRobot(model, map_file, threads=1)
        actions = robot.excited(load(self.recording) if self.recording else None, self.duration, self.seed)
        write_actions(self.out, robot.control_timestep, actions, robot.channels)
        command = f"soro-bench diagnose RECORDING --model {model} --map {map_file} --out FOLDER"
        console.print(f"{self.out}: replay it on the robot, record what it does, and: {command}", soft_wrap=True)

    def _of_environment(self, env: str) -> None:
        from soro_bench.recording.excitation import excitation, write_actions
        from soro_bench.registration import make_task, task_type

        task = make_task(env, 1, 1, task_type(env).cheap, action="continuous")
        actions = excitation(task.single_action_space, task.control_timestep, self.duration, self.seed)
        write_actions(self.out, task.control_timestep, actions)
        command = f"soro-bench diagnose RECORDING --env {env} --out FOLDER"
        console.print(f"{self.out}: replay it on the robot, record what it does, and: {command}", soft_wrap=True)


@dataclass
class Map:
    """Guess the robot map of a MuJoCo model, with comments, for you to correct."""

    model: Annotated[Path, tyro.conf.Positional]
    """MJCF file, from someone you trust: MuJoCo opens every file that a model names."""
    out: Path
    """The file to write, .toml; it must not exist."""
    recording: Annotated[Path | None, tyro.conf.Positional] = None
    """.parquet of the robot, whose commands and signals are matched with the model."""

    def run(self) -> None:
        from soro_bench.diagnosis.robots.guessed_map import guess_map
        from soro_bench.diagnosis.robots.model_robot import ModelRobot
        from soro_bench.files import replacing
        from soro_bench.recording.parquet import load

        check_output(self.out, ".toml")
        if self.out.exists():
            raise ValueError(f"{self.out} exists, and may be corrected already; give another name")
        recording = load(self.recording) if self.recording else None
        text = guess_map(self.model, recording)
        with replacing(self.out) as temporary:
            temporary.write_text(text, encoding="utf-8")
        console.print(f"{self.out}: check every line", soft_wrap=True)
        try:
            robot = ModelRobot(self.model, self.out)
            said = [*robot.notes, *(robot.measured(recording).notes if recording else [])]
        except ValueError as error:
            said = [f"to correct before it can be used: {error}"]
        for note in said:
            console.print(f"note: {note}", soft_wrap=True, highlight=False, markup=False)


@dataclass
class Diagnose:
    """Say what physics is missing in a simulation, from recordings of the real robot."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """.parquet; `soro-bench excite` writes the actions for a good one."""
    out: Path
    """Folder for report.html, result.json, effects.json, posterior.json, patched_model.xml, comparison.rrd,
    next_actions.csv."""
    env: str | None = None
    """Environment whose robot was recorded."""
    model: str | None = None
    """MJCF file of another robot, from someone you trust: MuJoCo opens every file that a model names. With --env the
    model to simulate, the cheap one by default."""
    map: Path | None = None
    """TOML file that says how recordings and parameters belong to the MJCF file (docs/reference/robot_map.md);
    `soro-bench map` guesses one."""
    heldout: tuple[Path, ...] = ()
    """Recordings of another motion, to test what is found."""
    known: KnownParameters = ()
    """Parameters that are known and not fitted, such as trunk_mass=0.42; `recorded` takes those that the recordings
    have."""
    baseline: Annotated[Path | None, tyro.conf.arg(aliases=["--since"])] = None
    """Folder of an earlier diagnosis of the same robot: its findings are known, and changes since then are looked
    for."""
    before: tuple[Path, ...] = ()
    """Instead of recordings to explain: some before a change of the robot, ..."""
    after: tuple[Path, ...] = ()
    """... and some after it, under the same commands: what differs is measured and tested, and with a model explained.
    The folder gets report.html and paired.json."""
    signals: tuple[str, ...] = ()
    """With --env: further signals to explain, such as tension; [[signals]] of the map are those of another robot."""
    next: int = 0
    """Ask for so many further recordings at most, as long as several answers are left. The command writes
    next_1.csv into the folder and waits for next_1.parquet, and so on; it goes on with those that are there."""
    answer: Path | None = None
    """With --next: JSON file of effects. A simulated robot with them answers, otherwise like that of the first
    recording, made by `soro-bench record`."""
    seed: int = 0
    seeds: int = 1
    """Diagnose with so many seeds, from --seed on. The report is of the first one, and says which share of them gives
    each answer."""

    def run(self) -> None:
        from soro_bench.diagnosis.active import diagnose_actively
        from soro_bench.diagnosis.api import diagnose, with_seeds
        from soro_bench.diagnosis.render import FILES, render, require_packages
        from soro_bench.recording.parquet import load

        if self.next < 0 or (self.answer and not self.next):
            raise ValueError(f"--next {self.next}: 0 or more recordings; --answer needs 1 or more")
        if self.seeds < 1 or (self.seeds > 1 and (self.next or self.before or self.after)):
            raise ValueError(f"--seeds {self.seeds}: 1 or more; above 1 without --next, --before and --after")
        if self.before or self.after:
            if self.next:
                raise ValueError("--next is for a diagnosis; --before and --after compare recordings that are there")
            self._compare()
            return
        if not self.recordings:
            raise ValueError("no recording to explain; give one or more .parquet files, or --before and --after")
        require_packages()
        with results_folder(self.out, FILES), StageStatus() as status:
            robot = self._robot()
            for note in robot.notes:
                console.print(f"note: {note}", soft_wrap=True, highlight=False, markup=False)
            recordings, heldout = ([load(path) for path in paths] for paths in (self.recordings, self.heldout))
            source = self._source(recordings, robot)
            result, rounds = diagnose_actively(
                robot, recordings, source, self.next, heldout, self.seed, status, known=joined(self.known)
            )
            results = [result]
            for seed in range(self.seed + 1, self.seed + self.seeds):
                results.append(diagnose(robot, recordings, heldout, seed, status, known=joined(self.known)))
            result = with_seeds(results) if self.seeds > 1 else result
            status("report")
            text = render(result, self.out)
        console.print(text, soft_wrap=True, highlight=False)
        if self.next:
            lines = table("recordings", "likeliest", "probability", "asked for", title="Rounds")
            for each in rounds:
                lines.add_row(str(each.recordings), each.answer, f"{each.probability:.2f}", each.proposed or "nothing")
            console.print(lines)
        console.print(f"{self.out / 'report.html'}, {self.out / 'result.json'}; {result.seconds:.0f} s", soft_wrap=True)

    def _source(self, recordings: Sequence["Recording"], robot: "Robot") -> "Source":
        """Who answers proposals."""
        from soro_bench.diagnosis.active import DroppedFile, SimulatedAnswer

        if self.answer:
            return SimulatedAnswer(recordings[0], self.answer)

        def say(text: str) -> None:
            console.print(text, soft_wrap=True, highlight=False, markup=False)

        return DroppedFile(self.out, say, robot.channels)

    def _compare(self) -> None:
        """Compare recordings before and after a change."""
        from soro_bench.diagnosis.paired.api import compare
        from soro_bench.diagnosis.render.paired import FILES, render
        from soro_bench.plotting import pyplot
        from soro_bench.recording.parquet import load

        if self.recordings or self.heldout:
            raise ValueError("--before and --after have all recordings of a change; give no others")
        if not (self.before and self.after):
            raise ValueError("a change needs recordings of both sides: --before A.parquet --after B.parquet")
        pyplot()  # before the work, not after it
        with results_folder(self.out, FILES), StageStatus() as status:
            robot = self._robot() if self.env or self.model or self.map else None
            before, after = ([load(path) for path in paths] for paths in (self.before, self.after))
            result = compare(before, after, robot, self.seed, status, known=joined(self.known))
            status("report")
            text = render(result, self.out)
        console.print(text, soft_wrap=True, highlight=False, markup=False)
        console.print(f"{self.out / 'report.html'}, {self.out / 'paired.json'}; {result.seconds:.0f} s", soft_wrap=True)

    def _robot(self) -> "Robot":
        from soro_bench.diagnosis.baseline import baseline
        from soro_bench.diagnosis.robots.model_robot import ModelRobot
        from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
        from soro_bench.registration import task_type

        known = baseline(self.baseline) if self.baseline else None
        if self.env and not self.map:
            more = (*task_type(self.env).inferred_from[1:], *self.signals) if self.signals else None
            return SuiteRobot(self.env, self.model, baseline=known, signals=more)
        if self.signals:
            raise ValueError("--signals is for --env; the map names signals of another robot, in [[signals]] sections")
        if self.model and self.map and not self.env:
            return ModelRobot(self.model, self.map, baseline=known)
        raise ValueError("say which robot was recorded: --env ENV, or --model ROBOT.xml --map MAP.toml")


@dataclass
class Report:
    """Render an earlier result again: report.html, comparison.rrd, the files for programs, and the summary."""

    result: Annotated[Path, tyro.conf.Positional]
    """result.json of a diagnosis, or paired.json of a comparison."""
    out: Path
    """Folder for what is rendered."""

    def run(self) -> None:
        from soro_bench.diagnosis.paired.result import SCHEMA, PairedResult
        from soro_bench.diagnosis.render import FILES, paired, render
        from soro_bench.diagnosis.result import Result

        data = read_json(self.result)
        if isinstance(data, dict) and data.get("schema") == SCHEMA:
            with results_folder(self.out, paired.FILES):
                text = paired.render(PairedResult.load(self.result), self.out)
        else:
            result = Result.load(self.result)
            with results_folder(self.out, FILES):
                text = render(result, self.out)
        console.print(text, soft_wrap=True, highlight=False)


@dataclass
class Check:
    """Replay the robot of a result on recordings, and say how far off it is: as built, with fitted parameters, with
    effects, and by patched_model.xml alone."""

    result: Annotated[Path, tyro.conf.Positional]
    """result.json of a diagnosis."""
    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """.parquet of the same robot, also such as the diagnosis has not seen."""
    model: Path | None = None
    """MJCF file of a robot of your own, where it is not at the path that the result has. Only of someone you trust."""
    map: Path | None = None
    """TOML file of such a robot, likewise."""
    out: Path | None = None
    """Folder for check.html, with errors of every point, and check.json."""

    def run(self) -> None:
        from soro_bench.diagnosis.render.replay_check import FILES, tables, write_check
        from soro_bench.diagnosis.replay_check import check_replays, robot_of
        from soro_bench.diagnosis.result import Result
        from soro_bench.recording.parquet import load

        if not self.recordings:
            raise ValueError("no recording to replay; give one or more .parquet files")
        if self.out:
            check_folder(self.out, FILES)
        result = Result.load(self.result)
        robot, notes = robot_of(result, self.result.parent, self.model, self.map)
        found = check_replays(result, robot, {str(path): load(path) for path in self.recordings}, notes)
        for errors in tables(found):
            lines = table(*errors.head, title=errors.title)
            for row in errors.rows:
                lines.add_row(*row)
            console.print(lines)
        for note in found.notes:
            console.print(f"note: {note}", soft_wrap=True, highlight=False, markup=False)
        if self.out:
            write_check(found, self.out)
            console.print(f"{self.out / FILES[0]}, {self.out / FILES[1]}", soft_wrap=True)


@dataclass
class Study:
    """Diagnose the recordings of a real robot; an interrupted study goes on with the parts that are missing."""

    name: Annotated[str, tyro.conf.Positional]
    """A table of assets/studies.toml, such as bam_servo or pendulum."""
    out: Path
    """Folder for the reports, one folder for each part, and for a table of all of them, results.md."""
    data: Path = Path("data/real")
    """Folder with the recordings; `soro-bench data` gets some of them, and says where they come from."""
    part: str | None = None
    """The only part to run; all of them by default."""
    train: tuple[str, ...] = ()
    """Patterns of files to explain instead of the part's own, such as 'single/piece_0*.csv'. With any of these three
    nothing of the part's own is left."""
    heldout: tuple[str, ...] = ()
    """Patterns of files to hold out."""
    unseen: tuple[str, ...] = ()
    """Patterns of files that are only replayed in the end."""
    seed: int = 0

    def run(self) -> None:
        from soro_bench.diagnosis.render import require_packages
        from soro_bench.diagnosis.study import load_study
        from soro_bench.diagnosis.study_runs import results, run_study
        from soro_bench.files import replacing

        require_packages()
        check_folder(self.out, ["results.md"])
        files = {"train": self.train, "heldout": self.heldout, "unseen": self.unseen}
        if any(files.values()) and not self.train:
            raise ValueError("--heldout and --unseen need --train, the files to explain")
        study = load_study(self.name, self.data, files if self.train else None, self.part)
        with StageStatus() as status:
            summaries = run_study(study, self.out, self.seed, progress=status)
        with replacing(self.out / "results.md") as temporary:
            temporary.write_text(results(summaries) + "\n")
        for summary in summaries:
            text = f"{summary['part']} ({summary['question']})\n{summary['verdict']}\n"
            console.print(text, soft_wrap=True)
        console.print(f"{self.out}", soft_wrap=True)
