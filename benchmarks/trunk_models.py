"""Both trunk models against figures of the reference simulator and of finite elements.

    python benchmarks/trunk_models.py necks
    python benchmarks/trunk_models.py tips
    python benchmarks/trunk_models.py rounding [--copies 20]
    python benchmarks/trunk_models.py reference --recordings FOLDER

necks: stiffness of every neck of the compiled models against the finite-element table. The trunk beyond a neck is moved
rigidly by a small amount (a bend or twist about the neck's middle, a stretch, a sideways shift) and the elastic force
on it read from MuJoCo's ``qfrc_spring``, at E = 4.5 MPa.

tips: where the tip is after one action from rest, in TrunkReach; the same as a function of the time step and of the
integrator; tip deflection per newton on one cable, without gravity, and how it depends on Poisson's ratio.

rounding: how much the sequences of TrunkLift depend on the last bit (docs/archive/tasks_and_models.md): each is
replayed with objects whose masses differ in the twelfth digit.

reference: how far both models are from recordings of TrunkReach and TrunkPush by the reference simulator. Each .npz
file of the folder has ``actions`` (T,), from 0 to 15, and ``observations`` and ``next_observations`` (T, 66 or 73) in
mm, as those of the environments. The actions are replayed from reset with nominal parameters.
"""

import argparse
import itertools
import zipfile
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from rich.progress import track

import soro_bench  # noqa: F401  registers the environments
from soro_bench import parameters as prm
from soro_bench.envs.trunk import REACH_LIMIT
from soro_bench.leaderboard.strict import read_strict
from soro_bench.markdown import table
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo
from soro_bench.models.simulation import Simulation
from soro_bench.packed import names
from soro_bench.parameters import ParameterSet

# motion -> the freejoint coordinate (3 translations, 3 rotations) that it moves and that resists it
MOTIONS = {"bend": 3, "bend_y": 4, "twist": 5, "axial": 2, "shear": 0}
STEP = {"bend": 1e-4, "bend_y": 1e-4, "twist": 1e-4, "axial": 1e-6, "shear": 1e-6}  # rad or m
# The table's compliance between and at its rows, relative to nu = 0.45
MEAN_COMPLIANCE = {
    "bend": {0.40: 1.10, 0.425: 1.06, 0.475: 0.89, 0.49: 0.74},
    "axial": {0.40: 1.07, 0.49: 0.87},
    "twist": {0.40: 1.08, 0.49: 0.69},
}


def compiled(name: str, poisson_ratio: float) -> mujoco.MjModel:
    """The model with its parameters written, as an environment uses it."""
    model = trunk.build_spec("trunk.xml", name).compile()
    parameters = ParameterSet(*trunk.PARAMETERS)
    sim = Simulation(model, parameters, [trunk.TrunkParameters(model)], nsim=1)
    values = {"poisson_ratio": poisson_ratio, "young_modulus": geo.YOUNG_MODULUS_OF_TABLE}
    sim.set_params(np.arange(1), parameters.to_array(values)[None])
    return sim.batch.get_model(0)


def flex_stiffness(model: mujoco.MjModel, motion: str, size: float | None = None) -> np.ndarray:
    """(10,) N/m or N m/rad, from central differences of +-``size``."""
    data = mujoco.MjData(model)
    size = STEP[motion] if size is None else size
    coordinate = MOTIONS[motion]
    return np.array([
        (_flex_force(model, data, k, coordinate, -size) - _flex_force(model, data, k, coordinate, size)) / (2 * size)
        for k in range(geo.NUM_NECKS)
    ])


def _flex_force(model: mujoco.MjModel, data: mujoco.MjData, k: int, coordinate: int, size: float) -> np.ndarray:
    """Force or torque on vertebra ``k`` along ``coordinate``, the trunk beyond neck k moved by ``size`` along it."""
    mujoco.mj_resetData(model, data)
    pivot = data.qpos[7 * k : 7 * k + 3].copy()  # the vertebra's frame, at the neck's middle
    turn = np.array([1.0, 0, 0, 0])
    if coordinate >= 3:
        mujoco.mju_axisAngle2Quat(turn, np.eye(3)[coordinate - 3], size)
    for j in range(k, geo.NUM_NECKS):
        pose = data.qpos[7 * j : 7 * j + 7]
        moved = np.empty(3)
        mujoco.mju_rotVecQuat(moved, pose[:3] - pivot, turn)
        pose[:3] = pivot + moved
        if coordinate < 3:
            pose[coordinate] += size
        pose[3:] = turn
    mujoco.mj_forward(model, data)
    return data.qfrc_spring[6 * k + coordinate]


def cable_stiffness(model: mujoco.MjModel, motion: str) -> np.ndarray:
    """(10,) the same for the joints of the serial chain."""
    data = mujoco.MjData(model)
    joint = {"bend": "bend_x"}.get(motion, motion)
    force = []
    for k in range(geo.NUM_NECKS):
        mujoco.mj_resetData(model, data)
        data.joint(f"{joint}{k}").qpos[0] = STEP[motion]
        mujoco.mj_forward(model, data)
        force.append(-data.qfrc_spring[model.joint(f"{joint}{k}").dofadr[0]] / STEP[motion])
    return np.array(force)


def necks() -> None:
    """Print the tables of the necks."""
    tables = {"bend": geo.BEND, "axial": geo.AXIAL, "twist": geo.TWIST}
    tables |= {"bend_y": geo.BEND, "shear": geo.AXIAL / geo.AXIAL_PER_SHEAR}
    for name, measure in (("flex", flex_stiffness), ("cable", cable_stiffness)):
        print(f"{name}: measured stiffness / table - 1, in parts per million, necks 0 to 9")
        for motion in MOTIONS if name == "flex" else ("bend", "bend_y", "axial"):
            for row, nu in enumerate(geo.POISSON_RATIO_OF_TABLE):
                error = 1e6 * (measure(compiled(name, nu), motion) / tables[motion][row] - 1)
                print(f"  {motion:7} nu {nu:.2f} " + " ".join(f"{e:8.3f}" for e in error))
    print("mean compliance relative to nu 0.45, all necks: model (finite elements)")
    for motion, expected in MEAN_COMPLIANCE.items():
        reference = flex_stiffness(compiled("flex", 0.45), motion)
        for nu, value in expected.items():
            ratio = (reference / flex_stiffness(compiled("flex", nu), motion)).mean()
            print(f"  {motion:7} nu {nu:.3f} {ratio:.3f} ({value})  {100 * (ratio / value - 1):+.1f} %")
    print("flex: secant stiffness at a finite motion / that at a small one, mean over necks")
    model = compiled("flex", prm.POISSON_RATIO.nominal)
    for motion, sizes in {"bend": (0.1, 0.3, 0.6, 1.0), "twist": (0.1, 0.3), "axial": (1e-3, 2e-3)}.items():
        small = flex_stiffness(model, motion)
        for size in sizes:
            ratio = (flex_stiffness(model, motion, size) / small).mean()
            print(f"  {motion:7} {size:5} {'m' if motion == 'axial' else 'rad':3} {ratio:.3f}")


# mm, tip after the action. Action 15 releases a slack cable: free fall. Recorded with the reference simulator by the
# authors of the published study (docs/archive/tasks_and_models.md).
REFERENCE_TIPS = {
    1: (-10.36, -16.37, 181.36),
    3: (10.12, -16.29, 181.40),
    5: (-5.08, -17.37, 181.79),
    15: (0.01, -12.13, 183.36),
}
DEFLECTION = {"L0": 41.6, "S0": 24.2}  # mm/N, tip, finite elements on the reference mesh
# tip compliance relative to nu = 0.45, finite elements
COMPLIANCE = {0.40: 1.10, 0.425: 1.06, 0.475: 0.89, 0.49: 0.74}
LOAD = 0.02  # N, small enough for a linear answer and within the range of every activation
SETTLING_TIME = 5.0  # s


def tips_of_environment(env_id: str, name: str) -> dict[int, np.ndarray]:
    """Tip [mm] after the first action of an episode of TrunkReach."""
    env = gymnasium.make(env_id, model=name)
    tips = {}
    for action in REFERENCE_TIPS:
        env.reset(seed=0)
        observation, *_ = env.step(action)
        tips[action] = 1e3 * observation[60:63]
    env.close()
    return tips


def tips_of_model(name: str, timestep: float, integrator: mujoco.mjtIntegrator) -> dict[int, np.ndarray]:
    """The same with another time step [s] and integrator."""
    model = parametrised(name, {}, timestep, integrator)
    tips = {}
    for action in REFERENCE_TIPS:
        data = mujoco.MjData(model)
        data.ctrl[action % 8] = geo.CABLE_RATE if action < 8 else -geo.CABLE_RATE
        mujoco.mj_step(model, data, round(0.05 / timestep))
        mujoco.mj_kinematics(model, data)
        tips[action] = 1e3 * data.site("keypoint20").xpos
    return tips


def tip_deflection(name: str, cable: str, poisson_ratio: float) -> float:
    """Tip deflection per force on a cable [mm/N], without gravity."""
    model = parametrised(name, {"poisson_ratio": poisson_ratio})
    model.opt.gravity[:] = 0
    model.actuator_gainprm[:] = 0
    model.actuator_biasprm[:] = 0
    data = mujoco.MjData(model)
    model.actuator(cable).gainprm[0] = 1.0  # tension = activation, which stays as long as the control is 0
    data.act[model.actuator(cable).actadr[0]] = LOAD
    mujoco.mj_step(model, data, round(SETTLING_TIME / model.opt.timestep))
    mujoco.mj_kinematics(model, data)
    tip = data.site("keypoint20").xpos
    return float(1e3 * np.linalg.norm(tip - [0, 0, geo.KEYPOINT_Z[-1]]) / LOAD)


def parametrised(
    name: str, params: dict[str, float], timestep: float | None = None, integrator: int | None = None
) -> mujoco.MjModel:
    """The model with its parameters written, as an environment uses it."""
    spec = trunk.build_spec("trunk.xml", name)
    if timestep is not None:
        spec.option.timestep, spec.option.integrator = timestep, integrator
    model, parameters = spec.compile(), ParameterSet(*trunk.PARAMETERS)
    sim = Simulation(model, parameters, [trunk.TrunkParameters(model)], nsim=1)
    sim.set_params(np.arange(1), parameters.to_array(params)[None])
    return sim.batch.get_model(0)


def print_tips(label: str, tips: dict[int, np.ndarray]) -> None:
    """One row per action: tip, difference from the reference, its length."""
    for action, tip in tips.items():
        difference = tip - REFERENCE_TIPS[action]
        vectors = [" ".join(f"{value:7.2f}" for value in vector) for vector in (tip, difference)]
        print(f"{label:26} a = {action:2}  {vectors[0]}  {vectors[1]}  {np.linalg.norm(difference):5.2f}")


def tips() -> None:
    """Print the three tables of the tips."""
    print("tip after one action [mm]        x       y       z     minus reference: x y z  distance")
    for env_id, name in itertools.product(("TrunkReach-v0", "TrunkReach-v1"), trunk.VARIANTS):
        print_tips(f"{env_id} {name}", tips_of_environment(env_id, name))
    print("\ndistance of the tip from the reference [mm]" + "".join(f"  a = {a:2}" for a in REFERENCE_TIPS))
    discrete, fast = mujoco.mjtIntegrator.mjINT_DISCRETE, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for name, integrator in (("flex", discrete), ("cable", discrete), ("cable", fast)):
        for timestep in (0.010, 0.005, 0.0025, 0.0005):
            tips = tips_of_model(name, timestep, integrator)
            distances = [np.linalg.norm(tip - REFERENCE_TIPS[action]) for action, tip in tips.items()]
            label = f"{name} {integrator.name.removeprefix('mjINT_').lower()} {1e3 * timestep:g} ms"
            print(f"{label:43}" + "".join(f"{d:8.2f}" for d in distances))
    print("\ntip deflection without gravity [mm/N]  (finite elements)")
    for name in trunk.VARIANTS:
        for cable, expected in DEFLECTION.items():
            nominal = tip_deflection(name, cable, 0.45)
            print(f"{name:6} {cable}  nu 0.45  {nominal:6.2f}  ({expected})  {100 * (nominal / expected - 1):+.1f} %")
            for nu, ratio in COMPLIANCE.items():
                value = tip_deflection(name, cable, nu) / nominal
                print(f"{name:6} {cable}  nu {nu:<5}  x {value:.3f}  ({ratio})  {100 * (value / ratio - 1):+.1f} %")


FOLDER = Path(__file__).parents[1] / "baselines" / "lift_sequences"  # or the archive beside it
SEQUENCES = [FOLDER / name for name in names(FOLDER)]
RECORDED = "elevation_held_mm", "elevation_end_mm", "lowest_corner_held_mm"  # in the files
TOLERANCE = 3.0  # mm
HELD_STEPS = 10  # as in baselines/lift_search.py


def copies(sequence: dict, count: int) -> np.ndarray:
    """(count, 3) what ``RECORDED`` is for objects lighter by 0, 1, 2 ... parts in 1e12; NaN where it diverges."""
    env = gymnasium.make(f"soro_bench:{sequence['env_id']}", model=sequence["model"], action=sequence["action"])
    return np.array([_replayed(env, sequence, 1e-12 * k) for k in range(count)])


def _replayed(env: gymnasium.Env, sequence: dict, lighter: float) -> list[float]:
    mass = sequence["params"]["cube_mass"] * (1 - lighter)
    env.reset(seed=0, options={"params": {**sequence["params"], "cube_mass": mass}})
    infos = [env.step(np.array(action, np.float32))[-1] for action in sequence["actions"]]
    if any(info["diverged"] for info in infos):
        return [np.nan] * len(RECORDED)
    elevation, clearance = (1e3 * np.array([info[key] for info in infos]) for key in ("elevation", "clearance"))
    return [elevation[-HELD_STEPS:].min(), elevation[-1], clearance[-HELD_STEPS:].min()]


def rounding(count: int) -> None:
    """How many copies of each sequence lift as recorded."""
    rows = []
    for path in track(SEQUENCES, "sequences"):
        sequence = read_strict(path)
        recorded, held = sequence[RECORDED[0]], copies(sequence, count)[:, 0]
        share = np.mean(np.abs(held - recorded) < TOLERANCE)
        figures = (f"{value:.1f}" for value in (recorded, np.median(held), held.min()))
        rows.append((path.stem, *figures, f"{share:.0%}"))
    print(table(("sequence", "recorded [mm]", "median", "least", "within 3 mm"), rows))


KINDS = {66: "TrunkReach-v0", 73: "TrunkPush-v0"}  # environments by how many numbers they observe


def reference(folder: Path) -> None:
    """How far the models are from every recording of the reference simulator."""
    rows = []
    for name, first, actions, seen in track(recordings_of(folder), "recordings"):
        for env_id, model in itertools.product((first, first.replace("-v0", "-v1")), trunk.VARIANTS):
            options = {"object": 1e-3 * seen[0, 66:69:2]} if env_id == "TrunkPush-v1" else {}
            replayed = replayed_actions(env_id, model, actions, options)
            error = np.linalg.norm(points_of(replayed) - points_of(seen), axis=2)
            keypoints, others = error[:, :21], error[:, 21:]
            end = f"{others[-1, 0]:.1f}" if others.size else ""
            rows.append((name, env_id, model, f"{np.sqrt((keypoints**2).mean()):.1f}", f"{error[-1, 20]:.1f}", end))
    errors = ("keypoints, rms [mm]", "tip at the end [mm]", "object at the end [mm]")
    print(table(("recording", "environment", "model", *errors), rows))


def recordings_of(folder: Path) -> list[tuple[str, str, np.ndarray, np.ndarray]]:
    """Of each .npz file of a folder: its name, the environment, (T,) actions and (T + 1, k) observations in mm."""
    found = []
    for path in sorted(folder.glob("*.npz")):
        try:
            with np.load(path, allow_pickle=False) as file:
                actions, seen = file["actions"], np.concatenate([file["observations"][:1], file["next_observations"]])
            fits = seen.ndim == 2 and seen.shape[1] in KINDS and actions.shape == (len(seen) - 1,)
            whole = fits and np.isfinite(seen).all() and np.isin(actions, range(16)).all()
            whole = whole and (np.abs(seen[0, 66:69]) <= 1e3 * REACH_LIMIT).all()
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            whole = False
        if not whole:
            raise SystemExit(f"{path}: actions (T,) from 0 to 15, observations and next_observations (T, "
                             f"{' or '.join(map(str, KINDS))}) finite numbers are needed, "
                             f"and an object that begins within {1e3 * REACH_LIMIT:g} mm")  # fmt: skip
        found.append((path.stem, KINDS[seen.shape[1]], actions.astype(int), seen))
    return found


def points_of(observations: np.ndarray) -> np.ndarray:
    """(T, 21 or 22, 3) keypoints, and the object's centre if there is one."""
    return np.concatenate([observations[:, :63], observations[:, 66:69]], axis=1).reshape(len(observations), -1, 3)


def replayed_actions(env_id: str, model: str, actions: np.ndarray, options: dict | None = None) -> np.ndarray:
    """(T + 1, k) observations in mm; options of the reset."""
    env = gymnasium.make(f"soro_bench:{env_id}", model=model, max_episode_steps=len(actions) + 1)
    observations = [env.reset(seed=0, options=options)[0], *(env.step(int(action))[0] for action in actions)]
    env.close()
    return 1e3 * np.array(observations)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("necks", "tips", "rounding", "reference"))
    parser.add_argument("--copies", type=int, default=20)
    parser.add_argument("--recordings", type=Path, help="the folder of reference")
    options = parser.parse_args()
    if options.what == "reference":
        if not options.recordings or not sorted(options.recordings.glob("*.npz")):
            parser.error(f"--recordings {options.recordings}: a folder with .npz files is needed")
        reference(options.recordings)
    elif options.what == "rounding":
        rounding(options.copies)
    else:
        {"necks": necks, "tips": tips}[options.what]()


if __name__ == "__main__":
    main()
