"""Whether two MuJoCo models are one robot: whether they move alike."""

from dataclasses import dataclass

import mujoco
import numpy as np

from soro_bench.arrays import Floats
from soro_bench.models.simulation import quiet

ALIKE = 1e-6  # m or rad, and of positions beyond 1 their share: models that differ by less are one
LONG, SHORT = 2.0, 0.2  # s, replayed; the short one of chaotic models
_SEQUENCES = 3  # of random commands
_HELD = 0.1  # s, a command
_SAMPLES = 100  # at most, of a replay
_SPEED = 0.1  # m/s or rad/s, of the first motion: masses and dampings show in all degrees of freedom
_CHANGE = 1e-10  # m/s or rad/s; it shows how chaotic a model is
_RESET = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{what}")) for what in ("QPOS", "QVEL", "QACC")]


@dataclass(frozen=True)
class MotionDifference:
    """How two models differ over some seconds. largest: [m or rad], as ``ALIKE`` says; infinite where their positions
    are not the same numbers. chaotic: whether a change by 1e-10 m/s or rad/s would grow beyond ``ALIKE``."""

    largest: float
    seconds: float
    chaotic: bool

    @property
    def alike(self) -> bool:
        """Whether the models are one."""
        return self.largest <= ALIKE


@quiet()
def motion_difference(model: mujoco.MjModel, other: mujoco.MjModel) -> MotionDifference:
    """Compare replays of random commands, the same ones each time: of 2 s, or of 0.2 s where the motion is chaotic."""
    if (model.nq, model.nv, model.nu, model.nbody) != (other.nq, other.nv, other.nu, other.nbody):
        return MotionDifference(np.inf, 0.0, False)
    short = _compared(model, other, SHORT)
    if short > ALIKE:  # a long replay could only be farther away
        return MotionDifference(short, SHORT, False)
    chaotic = any(
        _largest(_replay(model, seed, LONG), _replay(model, seed, LONG, _CHANGE)) > ALIKE for seed in range(_SEQUENCES)
    )
    if chaotic:
        return MotionDifference(short, SHORT, True)
    return MotionDifference(_compared(model, other, LONG), LONG, False)


def _compared(model: mujoco.MjModel, other: mujoco.MjModel, seconds: float) -> float:
    """The largest difference in several replays of some seconds."""
    return max(_largest(_replay(model, seed, seconds), _replay(other, seed, seconds)) for seed in range(_SEQUENCES))


def _replay(model: mujoco.MjModel, seed: int, seconds: float, change: float = 0.0) -> Floats:
    """(T, n) positions of joints and bodies; they end where MuJoCo finds that the simulation diverges.

    Args:
        change: of the first velocities [m/s or rad/s], of random sign.
    """
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    data.qvel[:] = _SPEED * rng.standard_normal(model.nv) + change * rng.choice([-1.0, 1.0], model.nv)
    limited = model.actuator_ctrllimited[:, None].astype(bool)
    low, high = np.where(limited, model.actuator_ctrlrange, (-1.0, 1.0)).T
    steps = max(round(seconds / model.opt.timestep), 1)
    held, every = max(round(_HELD / model.opt.timestep), 1), max(steps // _SAMPLES, 1)
    found = []
    for step in range(steps):
        if step % held == 0:
            data.ctrl[:] = rng.uniform(low, high)
        mujoco.mj_step(model, data)
        if any(data.warning[each].number for each in _RESET):
            break
        if step % every == 0:
            found.append(np.concatenate([data.qpos, data.xpos.ravel()]))
    return np.array(found).reshape(len(found), -1)


def _largest(one: Floats, other: Floats) -> float:
    """The largest difference of positions (T, n), of large ones as a share."""
    if one.shape != other.shape:
        return np.inf
    return float((np.abs(one - other) / np.maximum(np.abs(one), 1.0)).max(initial=0.0))
