"""Closing the loop: is a policy better for a robot whose missing physics has been diagnosed?

    python baselines/closing_the_loop.py

Three trunks with wrong parameters and hidden physics (soro_bench/blind_benchmark, no code of the effects) are
recorded for 30 s and diagnosed with the cheap model. PPO is trained on TrunkReach four ways: on the nominal robot; on a
random box of the search space (UDR); on the patched robot, with the effects and the distribution that the diagnosis
wrote; and on the true robot (oracle: the true parameters and effect, in the catalogue's terms). Every policy is run on
the hidden robot, to the 27 fixed goals. Writes results.json and results.md into --out; an interrupted run goes on.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.progress import Progress, TaskID

from soro_bench.blind_benchmark import body_laws, cable_laws
from soro_bench.blind_benchmark.cases import recording
from soro_bench.blind_benchmark.draw import manoeuvre
from soro_bench.blind_benchmark.robot import CONTROL_TIMESTEP, Law, Robot, final_distances
from soro_bench.cli import plain_errors
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.render import render
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import EVERY, Effect, Location, save_effects
from soro_bench.envs.task import effects_of
from soro_bench.files import read_json, replacing, write_json
from soro_bench.leaderboard.statistics import interval
from soro_bench.markdown import table
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo
from soro_bench.options import check_seed
from soro_bench.policies.policy import Policy
from soro_bench.randomization import Distribution, holding, load
from soro_bench.recording.excitation import excitation
from soro_bench.registration import make_task
from soro_bench.sources import method_version
from soro_bench.training.configuration import default_config
from soro_bench.training.methods import METHODS
from soro_bench.training.ppo import TRAINER, train

ENV_ID, MODEL, KIND = "TrunkReach-v0", "cable", "fine"
DURATIONS = {"train": 30.0, "heldout": 12.0}  # s
METHOD = method_version()  # of the sources that this process has loaded, whatever happens to the files later
METHOD_NAMES = ("nominal", "udr", "patched", "oracle")


@dataclass(frozen=True)
class Hidden:
    """Factors of the nominal parameters, a law of the hidden robot, and the same in the catalogue's terms."""

    factors: dict[str, float]
    law: Callable[[], Law]
    effect: Effect

    @property
    def parameters(self) -> dict[str, float]:
        """The robot's parameters by name, in SI units."""
        return {p.name: p.nominal * self.factors.get(p.name, 1.0) for p in trunk.PARAMETERS}


HIDDEN = {
    "delay": Hidden(
        {"trunk_mass": 1.2, "young_modulus": 0.85},
        lambda: cable_laws.Delay(0.15),
        Effect("actuator_delay", Location("actuator", EVERY), {"delay": 0.15}),
    ),
    "weak_cable": Hidden(
        {"trunk_mass": 0.85, "young_modulus": 1.2},
        lambda: cable_laws.Gain(0, 0.5),
        Effect("actuator_gain", Location("actuator", geo.CABLE_NAMES[0]), {"gain": 0.5}),
    ),
    "payload": Hidden(
        {"trunk_mass": 1.1, "young_modulus": 0.8},
        lambda: body_laws.Payload(8, 0.1),
        Effect("payload", Location("body", "vertebra8"), {"mass": 0.1}),
    ),
}


def diagnosed(name: str, folder: Path) -> None:
    """The report of a hidden robot, in a folder; what is there is kept if it is of this version of the method."""
    if (folder / "method.json").exists():  # which is written last
        _same(folder / "method.json", {"method": METHOD})
        return
    robot, recordings = Robot(KIND, HIDDEN[name].parameters, [HIDDEN[name].law()]), {}
    space = make_task(ENV_ID, 1, 1, MODEL, action="continuous").single_action_space
    actions = {
        "train": excitation(space, CONTROL_TIMESTEP, DURATIONS["train"]),
        "heldout": manoeuvre(DURATIONS["heldout"], 1),
    }
    for k, (role, rows) in enumerate(actions.items()):
        points = robot.run(rows).at(CONTROL_TIMESTEP * np.arange(len(rows) + 1))
        recordings[role] = recording(rows, points, np.random.default_rng([k, 2]))
    found = diagnose(SuiteRobot(ENV_ID), [recordings["train"]], [recordings["heldout"]])
    render(found, folder)
    write_json(folder / "method.json", {"method": METHOD})


def _same(path: Path, expected: dict) -> None:
    """Refuse what was computed otherwise."""
    found = read_json(path)
    for key, value in expected.items():
        if found.get(key) != value:
            raise ValueError(f"{path} has {key} {found.get(key)}, not {value}; choose another --out")


def training(name: str, method: str, seed: int, folder: Path) -> tuple[Distribution | None, Path | None]:
    """What a policy is trained on: a distribution of the parameters, and an effects file."""
    if method == "patched":
        return load(folder / "report" / "posterior.json"), folder / "report" / "effects.json"
    if method == "oracle":
        path = folder / "truth.json"
        save_effects([HIDDEN[name].effect], path)
        return holding(None, HIDDEN[name].parameters), path
    return METHODS["udr" if method == "udr" else "oracle"].distribution(ENV_ID, seed, folder), None


def result(
    name: str, method: str, seed: int, folder: Path, steps: int, progress: Callable[[int, int, dict[str, float]], None]
) -> dict:
    """Train one policy and run it on the hidden robot; what is there is read."""
    path = folder / name / method / f"seed{seed}.json"
    about = {"robot": name, "method": method, "seed": seed, "steps": steps, "trainer": TRAINER,
             "diagnosis": METHOD}  # fmt: skip
    if path.exists():
        _same(path, about)
    else:
        distribution, effects = training(name, method, seed, folder / name)
        config = default_config(ENV_ID, steps, method=method, seed=seed, effects=effects and str(effects))
        # those that know nothing of the robot serve for all of them
        policy = folder / ("all" if effects is None else name) / "policies" / f"{method}_seed{seed}"
        train(config, policy, distribution, progress)
        robot = Robot(KIND, HIDDEN[name].parameters, [HIDDEN[name].law()])
        distances = final_distances(Policy.load(policy).act, robot)
        with_effects = [effect.name for effect in effects_of(str(effects)) or ()] if effects else []
        write_json(path, about | {"effects": with_effects, "distances_m": distances.tolist()})
    return read_json(path)


def gaps(results: list[dict]) -> str:
    """Markdown: mean final distance [mm], its 95 % interval over seeds, the share of the gap that is closed, and the
    effects that the patched robot has."""
    rows = []
    for name in dict.fromkeys(r["robot"] for r in results):
        cells, means = [], {}
        for method in METHOD_NAMES:
            own = [r["distances_m"] for r in results if (r["robot"], r["method"]) == (name, method)]
            values = 1e3 * np.array(own).mean(axis=1, keepdims=True)
            means[method], spread = float(values.mean()), interval(np.mean, (values,), np.random.default_rng(0))
            cells.append(f"{means[method]:.2f}" + (f" [{spread[0]:.2f}, {spread[1]:.2f}]" if spread else ""))
        gap = means["nominal"] - means["oracle"]
        closed = f"{(means['nominal'] - means['patched']) / gap:.0%}" if gap > 0 else "no gap"
        patch = next(r["effects"] for r in results if (r["robot"], r["method"]) == (name, "patched"))
        rows.append((name, *cells, closed, ", ".join(patch) or "nothing"))
    return table(("hidden", "nominal", "UDR", "patched", "oracle", "gap closed", "patched with"), rows)


def main() -> None:
    """Read the options and run what is missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/closing_the_loop"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=224_000, help="environment steps of each training")
    options = parser.parse_args()
    with plain_errors(parser.prog):
        close_the_loop(options)


def close_the_loop(options: argparse.Namespace) -> None:
    """Diagnose, train and evaluate what is missing; writes results.json and results.md."""
    default_config(ENV_ID, options.steps)  # wrong steps and seeds are said before the work, not after it
    for seed in options.seeds:
        check_seed(seed)
    results = []
    with Progress() as bars:
        for name in HIDDEN:
            waiting = bars.add_task(f"{name} diagnosis", total=1)
            diagnosed(name, options.out / name / "report")
            bars.update(waiting, completed=1)
            for method in METHOD_NAMES:
                for seed in options.seeds:
                    task = bars.add_task(f"{name} {method} {seed}", total=options.steps)

                    def show(done: int, total: int, row: dict[str, float], task: TaskID = task) -> None:
                        bars.update(task, completed=done, total=total)

                    results.append(result(name, method, seed, options.out, options.steps, show))
    write_json(options.out / "results.json", results)
    with replacing(options.out / "results.md") as temporary:
        temporary.write_text(gaps(results) + "\n")
    print(gaps(results))


if __name__ == "__main__":
    main()
