"""The ``soro-bench`` command."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

try:
    import tyro
    from rich.table import Table

    from soro_bench.campaign.commands import RunPreset
    from soro_bench.leaderboard.commands import Leaderboard
    from soro_bench.progress import InferenceBar, StageBars, TrainingBars, console
except ImportError as error:
    sys.exit(f"soro-bench needs more than the core install: pip install soro_bench[all] ({error})")

from soro_bench.parallel import HERE, Workers
from soro_bench.registration import ENV_IDS, task_type

EnvId = Annotated[str, tyro.conf.Positional]
Parallel = Annotated[Workers, tyro.conf.arg(name="")]  # --jobs, --backend, --scheduler


@dataclass
class List:
    """Show the environments and their parameters."""

    def run(self) -> None:
        for env_id in ENV_IDS:
            task = task_type(env_id)
            table = Table(
                "parameter", "nominal", "unit", "bounds", "search box", "meaning",
                title=f"[bold]{env_id}[/bold]: {len(task.evaluation)} evaluation episodes", title_justify="left",
            )  # fmt: skip
            for p in task.parameters.parameters.values():
                name = f"[bold]{p.name} *[/bold]" if p.name in {q.name for q in task.randomized} else p.name
                bounds, search = ("{:g} .. {:g}".format(*pair) for pair in (p.bounds, p.search))
                table.add_row(name, f"{p.nominal:g}", p.unit, bounds, search, p.meaning)
            console.print(table)
        console.print("* what the published study randomises")


@dataclass
class Train:
    """Train one policy by PPO; goes on where an interrupted training stopped."""

    env: EnvId
    method: Literal["oracle", "udr"] = "oracle"
    """oracle: nominal parameters. udr: a random box of the search space, drawn from the seed."""
    randomization: Path | None = None
    """JSON file of a distribution to train on instead of the method's."""
    effects: Path | None = None
    """JSON file of physics that the model leaves out, such as `soro-bench diagnose` writes."""
    seed: int = 0
    steps: int | None = None
    """Environment steps; what the environment needs by default."""
    model: str | None = None
    """The environment's model or mesh to train on; the cheap one by default."""
    action: Literal["discrete", "continuous"] | None = None
    """What the environment is best learned with by default."""
    out: Path = Path("runs/train")

    def run(self) -> None:
        from soro_bench.randomization import load
        from soro_bench.training.methods import METHODS
        from soro_bench.training.ppo import default_config, train

        task_type(self.env)
        given = {"model": self.model, "action": self.action, "effects": self.effects and str(self.effects)}
        changes = {name: value for name, value in given.items() if value is not None}
        config = default_config(self.env, self.steps, method=self.method, seed=self.seed, **changes)
        box = METHODS[self.method].distribution(self.env, self.seed, self.out)
        distribution = load(self.randomization) if self.randomization else box
        with TrainingBars() as bar:
            train(config, self.out, distribution, lambda *progress: bar(f"{self.method} seed {self.seed}", *progress))
        console.print(f"policy in {self.out}")


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
    """Folder for the results; the policy's own by default, which an entry needs to be told."""

    def run(self) -> None:
        from soro_bench.campaign.run import record_evaluations
        from soro_bench.files import write_json
        from soro_bench.leaderboard.boards import board_of
        from soro_bench.training.policy import Policy

        policy, out = Policy.load(self.policy), self.out or self.policy
        if out.suffix == ".json":
            raise ValueError(f"{out} is an entry: say with --out where its results go")
        name, board = board_of(policy.card.env_id, self.board)
        label = self.on or task_type(board.env_id).accurate
        scores = record_evaluations(policy, name, (board.labelled(label),), out)
        write_json(out / f"evaluation_{label}.json", {"board": name, **scores})
        final = scores[label]["final_mm"]
        mean, solved = sum(final) / len(final), sum(scores[label]["success"])
        said = f"{name} on {label}: final {board.metric} {mean:.2f} mm, mean of {len(final)} episodes; {solved} solved"
        console.print(said, soft_wrap=True)


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
    """Standard deviation [m] of normal noise on all positions."""
    full_state: bool = False
    """Record the simulation's whole state too, which DROPO restarts from."""

    def run(self) -> None:
        from soro_bench.recording.parquet import save
        from soro_bench.recording.simulated import parse_params, record

        recording = record(
            self.env, self.policy, self.model, self.action, parse_params(self.params), self.steps, self.seed,
            self.noise, self.full_state,
        )  # fmt: skip
        save(recording, self.out)
        _describe(recording, self.out)


@dataclass
class Infer:
    """Infer a distribution over physical parameters from one recording."""

    method: Annotated[Literal["rf-dropo", "bayes-sim", "dropo", "droid", "sysid"], tyro.conf.Positional]
    recording: Annotated[Path, tyro.conf.Positional]
    """.parquet, of one of the environments from its reset on."""
    out: Path
    """The posterior, .json; train takes it for a distribution. A picture of it is written beside it."""
    infer: tuple[str, ...] = ()
    """Names of the parameters to infer; by default those that the published study randomises in the environment."""
    known: tuple[str, ...] = ()
    """Parameters that are known, such as trunk_mass=0.42; others that are not inferred are nominal."""
    model: str | None = None
    """Model or mesh to replay the recording on; the recorded one by default."""
    noise: float = 0.0
    """Standard deviation [m] of the recorded positions."""
    seed: int = 0
    published: bool = False
    """rf-dropo: the published search, CMA-ES with 100 replays per candidate; a thousand times slower."""
    features: Literal["mdn", "mdrff"] = "mdn"
    """bayes-sim: what its network sees."""
    simulations: int = 1000
    """bayes-sim: how many."""
    workers: Parallel = HERE

    def run(self) -> None:
        from soro_bench.inference.methods import infer
        from soro_bench.inference.replay import Replay
        from soro_bench.inference.report import write_report
        from soro_bench.recording.parquet import load
        from soro_bench.recording.simulated import parse_params

        known, restart = parse_params(self.known), self.method == "dropo"
        replay = Replay(load(self.recording), self.infer or None, known, self.model, self.noise, restart)
        settings = {}
        if self.published:
            settings = {"optimizer": "sampled"}
        if self.method == "bayes-sim":
            settings = {"features": self.features, "simulations": self.simulations}
        work = self.out.with_suffix(".log.jsonl")
        with InferenceBar(self.method) as steps:
            posterior = infer(self.method, replay, work, self.seed, steps, self.workers, **settings)
        posterior.save(self.out)
        work.unlink()  # up to 180 MB, and only an interrupted inference needs it
        console.print(write_report(posterior, replay, self.out), soft_wrap=True, markup=False, highlight=False)


@dataclass
class Import:
    """Turn a CSV, NPZ or MCAP file or a LeRobot dataset into a recording."""

    file: Annotated[Path, tyro.conf.Positional]
    """.csv, .npz, .mcap, or the folder of a LeRobot dataset."""
    out: Path
    """The file to write, .parquet."""
    mapping: Path | None = None
    """TOML file that says what is what (docs/recordings.md); a LeRobot dataset needs none."""
    episode: int | None = None
    """Which episode of a LeRobot dataset; the first by default."""

    def run(self) -> None:
        from soro_bench.recording.importers import import_recording
        from soro_bench.recording.parquet import save

        selection = {} if self.episode is None else {"episode": self.episode}
        recording = import_recording(self.file, self.mapping, **selection)
        save(recording, self.out)
        _describe(recording, self.out)


@dataclass
class Data:
    """Get recordings of real robots from where they are published, and check them; docs/data.md."""

    robots: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Which; without any, all are listed, and what of them is there."""
    out: Path = Path("data/real")
    """Folder with a folder for each robot."""

    def run(self) -> None:
        from soro_bench.recording.published import fetch, sources, summary

        known = sources()
        if unknown := [name for name in self.robots if name not in known]:
            raise ValueError(f"robot {unknown[0]!r} is unknown; there are {', '.join(known)}")
        for name in self.robots or known:
            if self.robots:
                fetch(known[name], self.out / name)
            text = summary(name, known[name], self.out / name)
            console.print(text, soft_wrap=True, markup=False, highlight=False)


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
        from soro_bench.recording.rerun_log import open_viewer

        path = self.recording
        if path.suffix == ".parquet":
            from soro_bench.recording.comparison import write_comparison
            from soro_bench.recording.parquet import load

            path = self.out or path.with_suffix(".rrd")
            write_comparison(load(self.recording), path, self.recording.stem)
            console.print(f"{path}", soft_wrap=True, markup=False, highlight=False)
        if self.open:
            open_viewer(path)


@dataclass
class Excite:
    """Write the actions that show what a robot does: the recording that a diagnosis needs."""

    env: EnvId
    out: Path
    """.csv with a row per control step: time [s], and the action of every channel, from -1 to 1."""
    duration: float = 30.0
    seed: int = 0

    def run(self) -> None:
        from soro_bench.recording.excitation import excitation, write_actions
        from soro_bench.registration import make_task

        task = make_task(self.env, 1, 1, action="continuous")
        actions = excitation(task.single_action_space, task.control_timestep, self.duration, self.seed)
        write_actions(self.out, task.control_timestep, actions)
        console.print(f"{self.out}: replay it on the robot, record what it does, and: soro-bench diagnose RECORDING")


@dataclass
class Diagnose:
    """Say what physics is missing in a simulation, from recordings of the real robot."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """.parquet; `soro-bench excite` writes the actions for a good one."""
    out: Path
    """Folder for report.html, report.json, effects.json, posterior.json, patched_model.xml, comparison.rrd,
    next_actions.csv."""
    env: str | None = None
    """Environment whose robot was recorded."""
    model: str | None = None
    """MJCF file of another robot; with --env the model to simulate, the cheap one by default."""
    map: Path | None = None
    """TOML file that says how recordings and parameters belong to the MJCF file; see docs/diagnosis.md."""
    heldout: tuple[Path, ...] = ()
    """Recordings of another motion, to test what is found."""
    since: Path | None = None
    """Folder of an earlier diagnosis of the same robot: what it found is known, and what has changed is looked for."""
    seed: int = 0

    def run(self) -> None:
        from soro_bench.diagnosis.page import write_reports
        from soro_bench.diagnosis.pipeline import diagnose
        from soro_bench.recording.parquet import load

        robot = self._robot()
        recordings, heldout = ([load(path) for path in paths] for paths in (self.recordings, self.heldout))
        with console.status("") as status:
            found = diagnose(robot, recordings, heldout, self.seed, lambda stage: status.update(f"{stage} ..."))
            status.update("report ...")
            text = write_reports(found, recordings, self.out)
        console.print(text, soft_wrap=True, markup=False, highlight=False)
        console.print(f"{self.out / 'report.html'}, {self.out / 'report.json'}; {found.seconds:.0f} s", soft_wrap=True)

    def _robot(self):
        from soro_bench.diagnosis.model_robot import ModelRobot
        from soro_bench.diagnosis.report import earlier
        from soro_bench.diagnosis.suite_robot import SuiteRobot

        known = earlier(self.since) if self.since else None
        if self.env and not self.map:
            return SuiteRobot(self.env, self.model, earlier=known)
        if self.model and self.map and not self.env:
            return ModelRobot(self.model, self.map, earlier=known)
        raise ValueError("say which robot was recorded: --env ENV, or --model ROBOT.xml --map MAP.toml")


@dataclass
class Study:
    """Diagnose the recordings of a real robot; an interrupted study goes on with the parts that are missing."""

    name: Annotated[str, tyro.conf.Positional]
    """opencr_tdcr, asl_trunk, bam_servo or silicone_beam."""
    out: Path
    """Folder for the reports, one folder for each part, and for the row of the table, row.md."""
    data: Path = Path("data/real")
    """Folder with the recordings; `soro-bench data` says where they come from."""
    seed: int = 0

    def run(self) -> None:
        from soro_bench.files import replacing
        from soro_bench.study import load_study, row, run_study

        study = load_study(self.name, self.data)
        with console.status("") as status:
            summaries = run_study(study, self.out, self.seed, progress=lambda stage: status.update(f"{stage} ..."))
        with replacing(self.out / "row.md") as temporary:
            temporary.write_text(row(summaries))
        for summary in summaries:
            text = f"{summary['part']} ({summary['question']})\n{summary['verdict']}\n"
            console.print(text, soft_wrap=True, markup=False, highlight=False)
        console.print(f"{self.out}", soft_wrap=True)


@dataclass
class Prove:
    """Test the diagnosis on robots with concealed physics; an interrupted proof goes on from its files."""

    out: Path
    """Folder for cases, reports and scorecard."""
    count: int = 120
    seed: int = 0
    """Of the cases; one that has been used to develop the method proves nothing."""
    nulls: int | None = None
    """Cases without any effect; a fifth by default."""
    ablations: int = 0
    """Of so many cases, what each part of the method is worth: five more diagnoses each."""
    workers: Parallel = HERE

    def run(self) -> None:
        from soro_bench.proof.prove import prove

        with StageBars() as bar:
            text = prove(self.out, self.count, self.seed, self.nulls, self.ablations, self.workers, bar)
        console.print(text, soft_wrap=True, markup=False, highlight=False)


def _describe(recording, path: Path) -> None:
    table = Table("signal", "samples", "shape", "unit", "frame", title=f"{path}: {recording.duration:g} s")
    for name, signal in (*recording.commands.items(), *sorted(recording.signals.items())):
        shape = " x ".join(map(str, signal.values.shape[1:]))
        table.add_row(name, str(len(signal.time)), shape, signal.unit, signal.frame)
    console.print(table)


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


def main() -> None:
    """Entry point: one clear line for what a user can mend, no traceback."""
    try:
        tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="soro-bench").run()
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"soro-bench: {error}")
    except KeyboardInterrupt:
        sys.exit("soro-bench: interrupted; the same command goes on from the last checkpoint")


if __name__ == "__main__":
    main()
