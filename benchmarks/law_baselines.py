"""What other methods make of the arms of discovered_laws.py, on the same recordings, in the same unit, beside ours.

    python benchmarks/law_baselines.py FOLDER

FOLDER has the results of discovered_laws.py; every case there is a row, rms [mrad] of open-loop replays of its third
recording. Every method gets the model, the first recording to fit to and the second one to choose by. All replay at a
quarter of a control step.

parameters: mass and damping, by mujoco.sysid.
ladder: friction of every joint as in BAM (Duclusaud et al. 2025): Coulomb, then with Stribeck's term, load, and the
square of the velocity; the rung of least error on the second recording.
sindy: torques by the inverse dynamics of smoothed motion, regressed on polynomials of position, velocity and command,
sequentially thresholded (Brunton et al. 2016).
network: the same torques by a network of two layers.
"""

import argparse
import io
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement, product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from benchmarks import hidden_arms as arms
from benchmarks.discovered_laws import case
from soro_bench.arrays import Floats
from soro_bench.diagnosis.replay_check import check_replays
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.files import write_json
from soro_bench.recording.recording import Recording

RUNGS = (1, 2, 3, 4)  # coefficients of a joint: Coulomb, Stribeck, load, square
_CREEP, _STRIBECK = 0.03, 0.3  # rad/s, where friction changes its sign, and where Stribeck's term has fallen
_WINDOW, _ORDER = 9, 3  # samples and order of the polynomial that smooths angles
_THRESHOLDS = (0.003, 0.01, 0.02, 0.05, 0.1, 0.2)  # N m, of a coefficient of features of mean square one
_DEGREES = (1, 2)  # of the polynomials
_UNITS, _STEPS, _RATE, _SEED = 32, 1500, 3e-3, 0  # of the network
_WORST = 10.0  # rad, of a replay that diverges

Values = Sequence[float] | Floats
Torque = Callable[[Floats, Floats, Floats, Floats], Floats]  # (3,) N m, of q, v, command and motor torque


@dataclass(frozen=True)
class Data:
    """A recording: commands (T, 3) and angles (1 + T, 3) [rad]."""

    actions: Floats
    angles: Floats

    @classmethod
    def of(cls, recording: Recording) -> "Data":
        """Of the arm."""
        return cls(np.asarray(recording.commands["goal"].values), np.asarray(recording.signals["angles"].values))


def nothing(q: Floats, v: Floats, u: Floats, f: Floats) -> Floats:
    """No torque."""
    return np.zeros(3)


def model_of(parameters: Values) -> mujoco.MjModel:
    """The arm as its owner models it, masses and dampings times factors whose logarithms are given."""
    model = mujoco.MjModel.from_xml_string(arms.MODEL)
    model.opt.timestep = arms.STEP / arms.SUBSTEPS
    mass, damping = np.exp(np.clip(parameters, -2.0, 2.0))
    model.body_mass[1:] *= mass
    model.body_inertia[1:] *= mass
    model.dof_damping[:] *= damping
    return model


def replay(parameters: Values, torque: Torque, data: Data) -> Floats:
    """(1 + T, 3) angles [rad] under the commands of a recording."""
    model = model_of(parameters)
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    rows = [state.qpos.copy()]
    for action in data.actions:
        state.ctrl[:] = action
        for _ in range(arms.SUBSTEPS):
            state.qfrc_applied[:] = torque(state.qpos, state.qvel, state.ctrl, state.qfrc_actuator)
            mujoco.mj_step(model, state)
        rows.append(state.qpos.copy())
    return np.clip(np.nan_to_num(np.array(rows), nan=_WORST), -_WORST, _WORST)


def error(parameters: Values, torque: Torque, data: Data) -> float:
    """rms [rad] of an open-loop replay."""
    return float(np.sqrt(((data.angles - replay(parameters, torque, data)) ** 2).mean()))


def parameters_only(fitted: Data) -> list[float]:
    """(2,) of least squares by mujoco.sysid."""
    from mujoco import sysid

    names = ("mass", "damping")
    params = sysid.ParameterDict({name: sysid.Parameter(name, 0.0, -1.5, 1.5) for name in names})

    def residual(x: Floats, _params: Any) -> tuple[list[Floats], None, None]:
        points = np.reshape(x, (len(names), -1)).T
        found = np.stack([(fitted.angles - replay(p, nothing, fitted)).ravel() / arms.NOISE for p in points], axis=1)
        return [found if np.ndim(x) > 1 else found[:, 0]], None, None

    _, best = sysid.optimize(params, residual, verbose=False, eps=1e-4, output=io.StringIO())
    return [float(each) for each in np.ravel(best.x)]


def _friction(coefficients: Floats) -> Torque:
    """Of each joint with coefficients (3, rung)."""
    full = np.zeros((3, RUNGS[-1]))
    full[:, : coefficients.shape[1]] = coefficients
    coulomb, stribeck, load, square = full.T

    def torque(q: Floats, v: Floats, u: Floats, f: Floats) -> Floats:
        size = coulomb + stribeck * np.exp(-((v / _STRIBECK) ** 2)) + load * np.abs(f)
        return np.asarray(-size * np.tanh(v / _CREEP) - square * v * np.abs(v))

    return torque


def ladder(fitted: Data, tested: Data, begin: Values) -> tuple[list[float], Torque]:
    """Parameters and friction of the rung that leaves least of the second recording."""
    x, found = np.array(begin), list[tuple[float, list[float], Torque]]()
    coefficients = np.zeros((3, 0))
    for rung in RUNGS:
        coefficients = np.column_stack([coefficients, np.full((3, rung - coefficients.shape[1]), 1e-3)])

        def residual(y: Floats, rung: int = rung) -> Floats:
            return (fitted.angles - replay(y[:2], _friction(y[2:].reshape(3, rung)), fitted)).ravel()

        least = least_squares(residual, np.concatenate([x, coefficients.ravel()]), diff_step=1e-4, max_nfev=12)
        x, coefficients = least.x[:2], least.x[2:].reshape(3, rung)
        torque = _friction(coefficients)
        found.append((error(x.tolist(), torque, tested), x.tolist(), torque))
    return min(found, key=lambda each: each[0])[1:]


def torques(parameters: Values, data: Data) -> tuple[Floats, Floats]:
    """(T, 9) positions, velocities and commands, and (T, 3) the torques [N m] that the model lacks there."""
    model, filtered = model_of(parameters), []
    for order in (0, 1, 2):
        filtered.append(savgol_filter(data.angles, _WINDOW, _ORDER, order, delta=arms.STEP, axis=0)[1:])
    state, found = mujoco.MjData(model), []
    for q, v, a, u in zip(*filtered, data.actions, strict=True):
        state.qpos[:], state.qvel[:], state.qacc[:], state.ctrl[:] = q, v, a, u
        mujoco.mj_forward(model, state)  # motor torques
        motor = state.qfrc_actuator.copy()
        state.qacc[:] = a
        mujoco.mj_inverse(model, state)
        found.append(state.qfrc_inverse - motor)
    return np.column_stack([*filtered[:2], data.actions]), np.array(found)


def library(states: Floats, degree: int) -> Floats:
    """(n, F) of states (n, 9): one, each, and for a degree of two all products of two."""
    pairs = combinations_with_replacement(range(states.shape[1] if degree > 1 else 0), 2)
    return np.column_stack([np.ones(len(states)), states, *(states[:, i] * states[:, j] for i, j in pairs)])


def _thresholded(features: Floats, torque: Floats, threshold: float) -> Floats:
    """(F,) coefficients by least squares, again and again without those below a threshold."""
    kept, found = np.ones(features.shape[1], bool), np.zeros(features.shape[1])
    for _ in range(10):
        found[:] = 0.0
        if not kept.any():
            break
        found[kept] = np.linalg.lstsq(features[:, kept], torque, rcond=None)[0]
        smaller = kept & (np.abs(found) < threshold)
        if not smaller.any():
            break
        kept &= ~smaller
    return found


def sindy(fitted: Data, tested: Data, begin: Values) -> tuple[list[float], Torque]:
    """A polynomial of state and command at every joint, of the degree and threshold that leave least of the second
    recording."""
    states, missing = torques(begin, fitted)
    most, found = np.abs(missing).max(), []
    for degree, threshold in product(_DEGREES, _THRESHOLDS):
        features = library(states, degree)
        size = np.sqrt((features**2).mean(axis=0))
        weights = np.column_stack([_thresholded(features / size, each, threshold) / size for each in missing.T])

        def torque(q: Floats, v: Floats, u: Floats, f: Floats, w: Floats = weights, n: int = degree) -> Floats:
            row = library(np.clip(np.concatenate([q, v, u]), -50.0, 50.0)[None], n)[0]
            return np.asarray(np.clip(row @ w, -most, most))

        found.append((error(begin, torque, tested), torque))
    return list(begin), min(found, key=lambda each: each[0])[1]


def network(fitted: Data, tested: Data, begin: Values) -> tuple[list[float], Torque]:
    """A network of state and command, trained until its torques on the second recording are best."""
    import torch

    torch.manual_seed(_SEED)
    (states, missing), (others, wanted) = torques(begin, fitted), torques(begin, tested)
    centre, size, scale = states.mean(axis=0), states.std(axis=0) + 1e-6, missing.std(axis=0) + 1e-9
    given = [torch.tensor((each - centre) / size, dtype=torch.float32) for each in (states, others)]
    asked = [torch.tensor(each / scale, dtype=torch.float32) for each in (missing, wanted)]
    layers = torch.nn.Sequential(
        torch.nn.Linear(9, _UNITS), torch.nn.Tanh(), torch.nn.Linear(_UNITS, _UNITS), torch.nn.Tanh(),
        torch.nn.Linear(_UNITS, 3),
    )  # fmt: skip
    optimizer = torch.optim.Adam(layers.parameters(), _RATE, weight_decay=1e-4)
    best, kept = np.inf, [each.detach().numpy().copy() for each in layers.parameters()]
    for _ in range(_STEPS):
        optimizer.zero_grad()
        loss = ((layers(given[0]) - asked[0]) ** 2).mean()
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            held = float(((layers(given[1]) - asked[1]) ** 2).mean())
        if held < best:
            best, kept = held, [each.detach().numpy().copy() for each in layers.parameters()]
    w1, b1, w2, b2, w3, b3 = kept
    most = np.abs(missing).max(axis=0)

    def torque(q: Floats, v: Floats, u: Floats, f: Floats) -> Floats:
        x = np.tanh(w1 @ ((np.concatenate([q, v, u]) - centre) / size) + b1)
        return np.asarray(np.clip((w3 @ np.tanh(w2 @ x + b2) + b3) * scale, -most, most))

    return list(begin), torque


def errors(recordings: Sequence[Recording], result: Result, arm: ModelRobot) -> dict[str, float]:
    """rms [rad] of every method on the last of three recordings, and of the model as built."""
    fitted, tested, unseen = map(Data.of, recordings)
    begin = parameters_only(fitted)
    found = {"as built": error([0.0, 0.0], nothing, unseen), "parameters": error(begin, nothing, unseen)}
    for method in (ladder, sindy, network):
        found[method.__name__] = error(*method(fitted, tested, begin), unseen)
    replayed = check_replays(result, arm, {"unseen": recordings[-1]}).pooled("new")
    return {**found, "ours": replayed.get("patched", replayed["fitted"])}


def finer(folder: Path) -> ModelRobot:
    """The arm with the time step of the other methods."""
    text = arms.MODEL.replace('timestep="0.01"', f'timestep="{arms.STEP / arms.SUBSTEPS:g}"')
    (folder / "arm.xml").write_text(text)
    (folder / "arm.toml").write_text(arms.MAP)
    return ModelRobot(folder / "arm.xml", folder / "arm.toml", threads=1)


def row(path: Path) -> dict[str, float]:
    """Errors [rad] of a case, kept beside its result."""
    kept = path.with_name(path.name.replace("_result", "_baselines"))
    if kept.exists():
        return dict(json.loads(kept.read_text()))
    family, seed = path.name.removesuffix("_result.json").rsplit("_", 1)
    _, recordings = case(family, int(seed))
    with tempfile.TemporaryDirectory() as temporary:
        found = errors(recordings, Result.load(path), finer(Path(temporary)))
    write_json(kept, found)
    return found


def main() -> None:
    """Print a row as soon as it is there, then medians, and how often ours is the smallest."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    rows: list[dict[str, float]] = []
    for path in sorted(parser.parse_args().folder.glob("*_result.json")):
        found = row(path)
        if not rows:
            print("| case | " + " | ".join(found) + " |\n|" + "---|" * (len(found) + 1))
        rows.append(found)
        cells = " | ".join(f"{1e3 * each:.2f}" for each in found.values())
        print(f"| {path.name.removesuffix('_result.json')} | {cells} |", flush=True)
    if rows:
        print(
            "| median | "
            + " | ".join(f"{1e3 * np.median([each[name] for each in rows]):.2f}" for name in rows[0])
            + " |"
        )
        print(f"ours is smallest in {sum(min(each.values()) == each['ours'] for each in rows)} of {len(rows)}")


if __name__ == "__main__":
    main()
