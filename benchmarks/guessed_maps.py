"""Guess the maps of public MuJoCo models, and check that the guessed robots replay what the models themselves do.

    python benchmarks/guessed_maps.py [--models FOLDER] [--only TEXT]

MuJoCo alone simulates two seconds of each model under smooth commands. The recording has normal noise of a thousandth
of the motion. A map is guessed from both, and the robot of that map replays the recording. It does so within the noise
if the root mean square of the residuals is that of the noise within a tenth.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.public_models import zoo
from soro_bench.diagnosis.robots.guessed_map import guess_map
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.models.simulation import quiet
from soro_bench.parallel import one_blas_thread
from soro_bench.recording.recording import Recording, Signal

UNSTABLE = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
DURATION, CONTROL_STEP = 2.0, 0.02  # s
NOISE = 1e-3  # of the range of the motion
WITHIN = 0.1  # of the noise
SHARE = 0.3  # of the range of a control, on either side of its middle


def simulated(path: Path, rng: np.random.Generator) -> tuple[Recording, float]:
    """A recording by MuJoCo alone, from the first keyframe if there is one; and its noise.

    The signal has the positions of the driven hinges, of the driven slides, of all hinges, of all slides or of the
    sites, whichever there are first.
    """
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    substeps = max(round(CONTROL_STEP / model.opt.timestep), 1)
    step = substeps * model.opt.timestep
    steps = round(DURATION / step)
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = np.where(limited, model.actuator_ctrlrange.T, ((-1.0,), (1.0,)))
    rates, phases = rng.uniform(0.3, 1.5, model.nu), rng.uniform(0, 2 * np.pi, model.nu)
    waves = np.sin(2 * np.pi * rates * step * np.arange(steps)[:, None] + phases)
    controls = 0.5 * (low + high) + SHARE * (high - low) * waves
    name, unit, read = source(model)
    values = [read(data)]
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data, substeps)
        mujoco.mj_kinematics(model, data)
        values.append(read(data))
    if data.warning.number[[int(each) for each in UNSTABLE]].any():
        raise FloatingPointError("MuJoCo itself finds it unstable")
    clean = np.array(values)
    sigma = NOISE * float(np.ptp(clean, axis=0).max())
    noisy = clean + sigma * rng.standard_normal(clean.shape)
    time = step * np.arange(steps + 1)
    frame = "world" if name == "markers" else ""
    commands = {"action": Signal(time[:-1], controls)} if model.nu else {}
    return Recording(commands, {name: Signal(time, noisy, unit, frame)}), sigma


def source(model: mujoco.MjModel) -> tuple[str, str, Callable[[mujoco.MjData], np.ndarray]]:
    """Name, unit and reader of the signal."""
    driven = model.actuator_trnid[model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT), 0].tolist()
    for joints in (list(dict.fromkeys(driven)), range(model.njnt)):
        for kind, name, unit in ((mujoco.mjtJoint.mjJNT_HINGE, "angles", "rad"),
                                 (mujoco.mjtJoint.mjJNT_SLIDE, "positions", "m")):  # fmt: skip
            if at := [model.jnt_qposadr[i] for i in joints if model.jnt_type[i] == int(kind)]:
                return name, unit, lambda data, at=tuple(at): data.qpos[list(at)].copy()
    return "markers", "m", lambda data: data.site_xpos.copy()


@one_blas_thread
def checked(path: Path, seed: int = 0) -> tuple[bool, str]:
    """Whether the robot of a guessed map replays a recording within its noise, and in words how it went."""
    with quiet(), tempfile.TemporaryDirectory() as folder:
        recording, sigma = simulated(path, np.random.default_rng(seed))
        mapping = Path(folder) / "map.toml"
        try:
            mapping.write_text(guess_map(path, recording), encoding="utf-8")
            robot = ModelRobot(path, mapping, threads=1)
            measured = robot.measured(recording)
            nominal = np.array([[prior.nominal for prior in robot.priors]])
            (values,) = robot.simulate(measured.actions, nominal, [()], measured.start)
        except ValueError as error:
            return False, str(error)
        ratio = float(np.sqrt(np.nanmean((values - measured.values) ** 2))) / sigma
        said = f"residual {ratio:.3f} of the noise; {robot.signal} of {len(measured.values)} samples"
        return abs(ratio - 1) < WITHIN, "; ".join([said, *robot.notes, *measured.notes])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path, help="a folder with MJCF files; the installed packages without it")
    parser.add_argument("--only", default="", help="a text in the names of the models")
    arguments = parser.parse_args()
    models = [model for model in zoo(arguments.models) if arguments.only in model.name]
    good = unstable = 0
    for model in models:
        try:
            right, said = checked(model.path)
        except FloatingPointError as error:
            print(f"--  {model.name}: {error}", flush=True)
            unstable += 1
            continue
        good += right
        print(f"{'ok ' if right else 'NOT'} {model.name}: {said}", flush=True)
    total = len(models) - unstable
    print(f"{good} of {total} models are replayed within the noise; {unstable} are unstable by themselves")
    sys.exit(good < total)


if __name__ == "__main__":
    main()
