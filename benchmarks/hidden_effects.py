"""Hidden effects in public MuJoCo models: does a diagnosis of 20 s, read by 12-bit sensors, name them and their place?

    python benchmarks/hidden_effects.py --models FOLDER --out FOLDER [--only payload]

Twelve fixed models of public_models.py are small, have no free body and move smoothly under their commands. Each robot
has other masses and damping than its model, within their priors, and one hidden effect. It is simulated by MuJoCo alone
with a quarter of the time step; the laws are coded here, apart from those of the catalogue. One JSON file for each
case; the same command goes on with what is missing. Prints a table; with all cases it writes
docs/results/measured.json."""

import argparse
import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.public_models import ZooModel, zoo
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.robots.model_file import load_model
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.files import read_json, write_json
from soro_bench.markdown import table
from soro_bench.recording.recording import Recording, Signal

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "measured.json"
DURATION, CONTROL, FINER = 20.0, 0.02, 4  # s, s, time steps for one of the model
BITS = 4096  # values of a sensor over a turn, or over the range of a slide
DEVIATION = 0.2  # of the priors of masses and damping, logarithmic
_RATES = 0.15, 0.9  # Hz, of the sines of a command
_SINES, _SHARE = 5, 0.7  # of a command; of the range that it has
_STIFF = 0.99  # of a slip that MuJoCo's friction stops; its default is soft, and no dry friction
_REST = 1.0  # s, at the beginning
_SCALAR = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_HINGE = _SCALAR[0]
NAMES = {
    "friction": ("coulomb_friction", "joint"),
    "delay": ("actuator_delay", "actuator"),
    "gain": ("actuator_gain", "actuator"),
    "payload": ("payload", "body"),
    "play": ("backlash", "actuator"),
    "tilt": ("base_tilt", "model"),
}


@dataclass(frozen=True)
class Case:
    """A model, what is hidden in it, and where."""

    model: str
    effect: str
    location: str
    magnitude: float

    @property
    def name(self) -> str:
        return f"{self.model.replace('/', '_')}-{self.effect}"


class Play:
    """An output that waits until the input has come back by the width."""

    def __init__(self, width: float):
        self.half, self.out = width / 2, 0.0

    def __call__(self, value: float, time: float) -> float:
        if value - self.out > self.half:
            self.out = value - self.half
        elif self.out - value > self.half:
            self.out = value + self.half
        return self.out


class Late:
    """What the input was a while ago."""

    def __init__(self, delay: float):
        self.delay = delay
        self.times: list[float] = []
        self.values: list[float] = []

    def __call__(self, value: float, time: float) -> float:
        self.times.append(time)
        self.values.append(value)
        i = int(np.searchsorted(self.times, time - self.delay + 1e-9, side="right")) - 1
        return self.values[max(i, 0)]


def hidden_robot(path: Path, case: Case | None, factors: dict[str, float]) -> tuple[mujoco.MjModel, dict]:
    """The model with other masses and damping, a finer time step and what is hidden in its fields; and laws of
    controls, by actuator."""
    model, laws = load_model(path), {}
    model.opt.timestep = model.opt.timestep / FINER
    model.body_mass[:] *= factors["mass"]
    model.body_inertia[:] *= factors["mass"]
    model.dof_damping[:] *= factors["damping"]
    model.actuator_ctrllimited[:] = 0
    if case and case.effect == "friction":
        dof = model.jnt_dofadr[model.joint(case.location).id]
        model.dof_frictionloss[dof] += case.magnitude
        model.dof_solref[dof], model.dof_solimp[dof, :2] = (2 * model.opt.timestep, 1.0), _STIFF
    elif case and case.effect == "payload":
        model.body_mass[model.body(case.location).id] += case.magnitude
    elif case and case.effect == "tilt":
        c, s = np.cos(case.magnitude), np.sin(case.magnitude)
        model.opt.gravity[:] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ model.opt.gravity
    elif case:
        law: dict[str, Callable[[], Callable]] = {
            "gain": lambda: lambda value, time: (1.0 - case.magnitude) * value,
            "delay": lambda: Late(case.magnitude),
            "play": lambda: Play(case.magnitude),
        }
        laws[model.actuator(case.location).id] = law[case.effect]()
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model, laws


def commands(model: mujoco.MjModel, rng: np.random.Generator, steps: int) -> np.ndarray:
    """(T, nu) controls: rest, then sums of sines over most of each range, or of the range from -1 to 1."""
    limited = model.actuator_ctrllimited[:, None].astype(bool)
    low, high = np.where(limited, model.actuator_ctrlrange, (-1.0, 1.0)).T
    time = CONTROL * np.arange(steps)[:, None, None]
    rates = rng.uniform(*_RATES, (_SINES, model.nu))
    moved = np.sin(2 * np.pi * (rates * time + rng.uniform(size=(_SINES, model.nu)))).sum(axis=1)
    moved *= np.minimum(time[:, 0] / _REST, 1.0)
    middle = np.clip(0.0, low, high)
    reach = np.minimum(high - middle, middle - low)
    reach, middle = np.where(reach > 0, reach, (high - low) / 2), np.where(reach > 0, middle, (high + low) / 2)
    return middle + _SHARE * reach * moved / np.abs(moved).max(axis=0)


def recorded(model: mujoco.MjModel, laws: dict, controls: np.ndarray, change: float = 0.0) -> np.ndarray:
    """(T + 1, J) positions of joints before the first and after every control step."""
    data = mujoco.MjData(model)
    data.qvel[:] = change
    steps = round(CONTROL / model.opt.timestep)
    found = [data.qpos.copy()]
    for row in controls:
        for _ in range(steps):
            data.ctrl[:] = row
            for actuator, law in laws.items():
                data.ctrl[actuator] = law(row[actuator], data.time)
            mujoco.mj_step(model, data)
        found.append(data.qpos.copy())
    return np.array(found)


def steps_of_sensors(model: mujoco.MjModel, values: np.ndarray) -> np.ndarray:
    """(J,) the step of each joint's sensor: of a turn, or of the range of a slide, else of its way."""
    ranges = np.where(model.jnt_limited.astype(bool), np.ptp(model.jnt_range, axis=1), np.ptp(values, axis=0))
    return np.where(model.jnt_type == _HINGE, 2 * np.pi, np.maximum(ranges, 1e-3)) / BITS


def mapping(model: mujoco.MjModel, timestep: float, unit: str = "1") -> str:
    """TOML of the robot's mapping: its joints in a unit, masses and damping."""
    joints = [model.joint(i).name for i in range(model.njnt)]
    bodies = [model.body(i).name for i in range(1, model.nbody) if model.body_mass[i] > 0]
    mass = [f"body_mass:{name}" for name in bodies]
    mass += [f"body_inertia:{name}" for name in bodies if model.body(name).inertia.any()]
    parameters = {"mass": mass} | ({"damping": ["dof_damping:*"]} if model.dof_damping.any() else {})
    text = f"[robot]\ncontrol_timestep = {CONTROL}\n[commands.all]\n"
    text += f"actuators = {json.dumps([model.actuator(i).name for i in range(model.nu)])}\n"
    text += f'[signal]\nname = "angles"\njoints = {json.dumps(joints)}\nunit = "{unit}"\n'
    for name, fields in parameters.items():
        text += f"[parameters.{name}]\nfields = {json.dumps(fields)}\ndeviation = {DEVIATION}\n"
    return text


def recording(controls: np.ndarray, values: np.ndarray, model: mujoco.MjModel) -> Recording:
    """What the sensors record."""
    step, times = steps_of_sensors(model, values), CONTROL * np.arange(len(values))
    read = step * np.round(values / step)
    return Recording({"all": Signal(times[:-1], controls)}, {"angles": Signal(times, read[:, :, None], "1")})


def examined(case: Case, path: Path, folder: Path, seed: int) -> dict:
    """The diagnosis of a case."""
    rng = np.random.default_rng([seed, zlib.crc32(case.name.encode())])
    model = load_model(path)
    factors = dict(zip(("mass", "damping"), np.exp(DEVIATION * rng.uniform(-1, 1, 2)), strict=True))
    controls = commands(model, rng, round(DURATION / CONTROL))
    values = recorded(*hidden_robot(path, case, factors), controls)
    healthy = recorded(*hidden_robot(path, None, factors), controls)
    visible = np.sqrt(np.mean(((values - healthy) / steps_of_sensors(model, values)) ** 2))
    mapped = folder / f"{case.name}.toml"
    mapped.write_text(mapping(model, model.opt.timestep), encoding="utf-8")
    robot = ModelRobot(path, mapped, threads=1)
    result = diagnose(robot, [recording(controls, values, model)], seed=seed)
    found = [each for each in result.findings if each.name != "outliers"]
    first = found[0]
    name, kind = NAMES[case.effect]
    place = None if first.location is None else [first.location.kind, first.location.name]
    return {
        "case": case.name, "effect": name, "location": [kind, case.location], "magnitude": case.magnitude,
        "visible": float(visible), "verdict": result.verdict, "first": first.name, "first_location": place,
        "probability": first.probability, "name_right": first.name == name,
        "location_right": place == [kind, case.location], "others": [[f.name, f.probability] for f in found[1:4]],
        "parameters": {p.estimate.name: [p.estimate.value, factors[p.estimate.name]] for p in result.parameters},
        "model_state": result.patch.model_state, "seconds": result.seconds,
    }  # fmt: skip


CASES = (
    Case("dm_control/suite/reacher", "friction", "wrist", 0.008),
    Case("dm_control/suite/finger", "friction", "proximal", 2.0),
    Case("gymnasium_robotics/envs/assets/point/point", "delay", "motor_x", 0.06),
    Case("dm_control/locomotion/soccer/assets/boxhead/boxhead", "delay", "roll", 0.06),
    Case("gymnasium/envs/mujoco/assets/swimmer", "gain", "0 of swimmer", 0.15),
    Case("dm_control/suite/point_mass", "gain", "t1", 0.15),
    Case("dm_control/third_party/ant/ant", "payload", "front_left_foot", 0.3),
    Case("dm_control/suite/cartpole", "payload", "pole_1", 0.03),
    Case("robosuite/models/assets/grippers/panda_gripper", "play", "gripper_finger_joint1", 0.004),
    Case("dm_control/locomotion/walkers/assets/jumping_ball/jumping_ball_with_head", "play", "kick", 0.1),
    Case("gymnasium/envs/mujoco/assets/inverted_pendulum", "tilt", "gravity", 0.03),
    Case("dm_control/suite/pendulum", "tilt", "gravity", 0.05),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", default=list(NAMES), choices=list(NAMES))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    models: dict[str, ZooModel] = {each.name: each for each in zoo(options.models)}
    if missing := sorted({case.model for case in CASES} - models.keys()):
        raise SystemExit(f"{', '.join(missing)} are not installed; see public_models.py")
    found = []
    for case in CASES:
        path = options.out / f"{case.name}.json"
        if not path.exists() and case.effect in options.only:
            write_json(path, examined(case, models[case.model].path, options.out, options.seed))
        found += [read_json(path)] if path.exists() else []
    print(summary(found))
    if len(found) == len(CASES):
        write_json(RESULTS, read_json(RESULTS) | {"hidden_effects": found})


def summary(found: list[dict]) -> str:
    """Markdown: what was hidden and what was found first."""
    rows = [
        (each["case"], f"{each['effect']} at {each['location'][1]}", f"{each['visible']:.1f}", each["first"],
         "none" if each["first_location"] is None else each["first_location"][1], f"{each['probability']:.2f}",
         f"{each['seconds']:.0f}")
        for each in found
    ]  # fmt: skip
    names = ("case", "hidden", "visible [steps]", "first", "at", "probability", "time [s]")
    right = [each for each in found if each["name_right"]]
    places = sum(each["location_right"] for each in right)
    return f"{table(names, rows)}\n\nname {len(right)}/{len(found)}, of these location {places}/{len(right)}"


if __name__ == "__main__":
    main()
