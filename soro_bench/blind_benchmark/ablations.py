"""What each part of the diagnosis is worth: the same cases without it, and what others would do instead."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from soro_bench.blind_benchmark.report import report_of, unseen
from soro_bench.diagnosis.assembly.build import build_result
from soro_bench.diagnosis.data_quality.noise import data_quality
from soro_bench.diagnosis.outliers import nominal_fit
from soro_bench.diagnosis.pipeline import run_diagnosis
from soro_bench.diagnosis.preparation import unexplained
from soro_bench.diagnosis.robots.measured import Measured
from soro_bench.diagnosis.robots.robot import FITTED, REFINED, Robot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.robots.variants import Variant
from soro_bench.files import write_json
from soro_bench.parallel import one_blas_thread, processors
from soro_bench.recording.parquet import load

ENV_ID = "TrunkReach-v0"
FROZEN = 1e-6  # of a parameter's prior standard deviation, where it is not fitted


class Unrefined(SuiteRobot):
    """A robot of which no more accurate simulation is known: there is no discretisation error."""

    def refined(self, refinement: int = REFINED) -> list[Robot]:
        """None."""
        return []

    def variants(self) -> tuple[Variant, ...]:
        """None."""
        return ()


class Calibrated(SuiteRobot):
    """A robot whose parameters have been fitted before anything else is looked at, and stay.

    Args:
        x: (d,) where they stay, in standard deviations of their priors.
    """

    def __init__(self, env_id: str, x: np.ndarray, threads: int = 0) -> None:
        super().__init__(env_id, threads=threads)
        self.priors = tuple(
            replace(prior, nominal=float(prior.value(value)), deviation=FROZEN * prior.deviation)
            for prior, value in zip(self.priors, x, strict=True)
        )

    def shortened(self, factor: int) -> Robot:
        """As the robot's, with the same parameters."""
        return self._same(super().shortened(factor))

    def accurate(self) -> Robot | None:
        """As the robot's, with the same parameters."""
        finer = super().accurate()
        return finer and self._same(finer)

    def _same(self, robot: Robot) -> Robot:
        robot.priors = self.priors
        return robot


def without_discretisation(robot: SuiteRobot, case: Path) -> dict:
    """No discretisation error."""
    return _report(Unrefined(robot.env_id, threads=robot.threads), case)


def without_joint_fit(robot: SuiteRobot, case: Path) -> dict:
    """Parameters fitted first, effects looked for in what that leaves."""
    measured = robot.measured(load(case / "train.parquet"))
    problem = unexplained(robot.shortened(FITTED), (measured,), data_quality(measured).sigma)
    _, nominal = nominal_fit(problem, robot.refined(), 0)
    return _report(Calibrated(robot.env_id, nominal.x, robot.threads), case)


def on_task_motion(robot: SuiteRobot, case: Path) -> dict:
    """A recording of smooth motion like that of a task, instead of an excitation; then no motion is left unseen."""
    return report_of(
        build_result(run_diagnosis(robot, [load(case / "task.parquet")], [load(case / "heldout.parquet")]))
    ) | {"unseen": None}


def network_only(robot: SuiteRobot, case: Path) -> dict:
    """Parameters fitted, and a network for what they leave; it names nothing."""
    train, unseen_motion = (robot.measured(load(case / f"{role}.parquet")) for role in ("train", "task"))
    problem = unexplained(robot.shortened(FITTED), (train,), data_quality(train).sigma)
    _, nominal = nominal_fit(problem, robot.refined(), 0)
    before, after = residual_rms(problem.robot, nominal.x, train, unseen_motion)
    return {"unseen": {"rmse_before": before, "rmse_after": after, "noise_floor": problem.sigma}}


def parameters_only(robot: SuiteRobot, case: Path) -> dict:
    """Parameters fitted by mujoco.sysid, from the nominal values, with the time steps of the model; before is the
    nominal robot."""
    from soro_bench.inference.methods import infer
    from soro_bench.inference.replay import Replay

    names = [prior.name for prior in robot.priors]
    recording, other = load(case / "train.parquet"), robot.measured(load(case / "task.parquet"))
    found = infer("sysid", Replay(recording, names, model=robot.model_name, noise=5e-4, threads=robot.threads))
    rows = np.array([[prior.nominal for prior in robot.priors], [found.estimate[name] for name in names]])
    simulated = robot.simulate(other.actions, rows, [(), ()])
    before, after = np.sqrt(np.nanmean((other.values - simulated) ** 2, axis=(1, 2, 3)))
    return {
        "unseen": {"rmse_before": float(before), "rmse_after": float(after), "noise_floor": data_quality(other).sigma}
    }


ABLATIONS: dict[str, Callable[[SuiteRobot, Path], dict]] = {
    "no_floor": without_discretisation,
    "no_joint_fit": without_joint_fit,
    "task_motion": on_task_motion,
    "parameters_only": parameters_only,
    "network_only": network_only,
}


@one_blas_thread
def ablated(name: str, case: Path, path: Path) -> None:
    """Write what an ablation says of a case."""
    write_json(path, ABLATIONS[name](SuiteRobot(ENV_ID, threads=processors()), case))


def _report(robot: SuiteRobot, case: Path) -> dict:
    found = run_diagnosis(robot, [load(case / "train.parquet")], [load(case / "heldout.parquet")])
    # all are measured alike: numerical error is taken off of motion that has not been seen, whatever was fitted with
    same = replace(found, robot=SuiteRobot(robot.env_id, threads=robot.threads))
    return report_of(build_result(found)) | {"unseen": unseen(same, load(case / "task.parquet"))}


HISTORY = 10  # control steps of commands that it sees
HIDDEN, EPOCHS, PATIENCE, LEARNING_RATE, DECAY = 128, 2000, 100, 1e-3, 1e-3
_VALIDATION = 0.2  # of the recording, its end


def residual_rms(robot: Robot, x: np.ndarray, train: Measured, other: Measured) -> tuple[float, float]:
    """rms [signal's unit] of a coordinate on another recording, without and with the network.

    Args:
        x: (d,) parameters of the simulation, in standard deviations of their priors.
        train, other: what it is trained on, and what it is tried on.
    """
    parameters = np.array([[prior.value(value) for prior, value in zip(robot.priors, x, strict=True)]])
    inputs, left = [], []
    for each in (train, other):
        (simulated,) = robot.simulate(each.actions, parameters, [()], each.start)
        left.append((each.values - simulated).reshape(len(each.values), -1))
        inputs.append(_inputs(each.actions, simulated))
    predicted = _predicted(inputs[0], left[0], inputs[1])
    without, with_network = (float(np.sqrt(np.nanmean(rows**2))) for rows in (left[1], left[1] - predicted))
    return without, with_network


def _inputs(actions: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    """(T, k) commands of the last steps, where they led to, and the simulated signal."""
    padded = np.concatenate([np.zeros((HISTORY - 1, actions.shape[1])), actions])
    past = np.lib.stride_tricks.sliding_window_view(padded, HISTORY, axis=0).reshape(len(actions), -1)
    return np.concatenate([past, np.cumsum(actions, axis=0), simulated.reshape(len(actions), -1)], axis=1)


def _predicted(inputs: np.ndarray, targets: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """What a network that was trained until it did not get better on the end of the recording says of ``asked``."""
    import torch

    torch.manual_seed(0)
    torch.set_num_threads(1)  # sums would depend on the number
    known = np.isfinite(targets).all(axis=1)
    inputs, targets = inputs[known], targets[known]
    (centre, width), (mean, size) = ((a.mean(axis=0), a.std(axis=0) + 1e-9) for a in (inputs, targets))
    cut = round((1 - _VALIDATION) * len(inputs))
    x, y, new = (torch.tensor(a, dtype=torch.float32) for a in ((inputs - centre) / width, (targets - mean) / size,
                                                               (asked - centre) / width))  # fmt: skip
    network = torch.nn.Sequential(torch.nn.Linear(x.shape[1], HIDDEN), torch.nn.Tanh(),
                                  torch.nn.Linear(HIDDEN, y.shape[1]))  # fmt: skip
    optimizer = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=DECAY)
    best, answer, waited = float("inf"), np.zeros((len(asked), targets.shape[1])), 0
    for _ in range(EPOCHS):
        optimizer.zero_grad()
        ((network(x[:cut]) - y[:cut]) ** 2).mean().backward()
        optimizer.step()
        with torch.no_grad():
            loss, waited = float(((network(x[cut:]) - y[cut:]) ** 2).mean()), waited + 1
            if loss < best:
                best, answer, waited = loss, network(new).numpy() * size + mean, 0
        if waited > PATIENCE:
            break
    return answer
