"""Patched models of public MuJoCo models: are they written, do they load, do they move as the fitted simulation?

    python benchmarks/public_models.py --models FOLDER                 # prints the models, and what cannot be one
    python benchmarks/public_models.py --models FOLDER --out FOLDER    # resumable: one JSON file for each model

FOLDER of --models is a site-packages folder or any folder with MJCF files; without it the packages of this Python are
searched. They are neither imported nor run. These have models:

    pip install --no-deps --target FOLDER gymnasium gymnasium-robotics dm_control robosuite metaworld gym-aloha \
        gym-xarm gym-hil

Each model is patched as it is, and with every mass, all damping and all gains changed by
random factors. Its MJCF is then replayed beside the simulation with those factors under random commands: for 2 s, or
0.2 s where a change by 1e-10 grows beyond 1e-6. Prints a table, and every model that is not alike with the reason;
writes docs/results/measured.json.
"""

import argparse
import hashlib
import importlib.util
import json
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from rich.progress import track

from soro_bench.diagnosis.assembly.model_export import ALIKE, PatchError, exported, motion_difference
from soro_bench.diagnosis.robots.model_file import ModelError, load_model
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.files import read_json, write_json
from soro_bench.markdown import table
from soro_bench.models.simulation import quiet

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "measured.json"
CASES = ("nominal", "changed")
CONTROL = 0.02  # s, how long a command is held, about
_FACTORS = 0.5, 2.0  # of masses, damping and gains
_ONE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


PACKAGES = (
    "gymnasium", "gymnasium_robotics", "dm_control", "robosuite", "metaworld", "gym_aloha", "gym_xarm", "gym_hil",
)  # fmt: skip
_HEAD = 20_000  # characters, in which a file says that it is a model


@dataclass(frozen=True)
class ZooModel:
    """A model that loads, moves and has actuators. name: package and path within it, without its suffix."""

    name: str
    path: Path

    @property
    def package(self) -> str:
        return self.name.split("/")[0]


def zoo(folder: Path | None = None) -> list[ZooModel]:
    """The models of a folder or of the installed packages, sorted by name; of files with the same bytes one."""
    return [model for model, reason in surveyed(folder) if not reason]


def surveyed(folder: Path | None = None) -> Iterator[tuple[ZooModel, str]]:
    """Every MJCF file with the reason why it is no model of the zoo, empty if it is one."""
    seen: set[str] = set()
    for root, path in _files(folder):
        text = path.read_bytes()
        if b"<mujoco" not in text[:_HEAD] or b"<mujocoinclude" in text[:_HEAD]:
            continue
        model = ZooModel(str(path.relative_to(root).with_suffix("")), path)
        digest = hashlib.sha256(text).hexdigest()
        yield model, "the same bytes as another file" if digest in seen else unfit(path)
        seen.add(digest)


def _files(folder: Path | None) -> Iterator[tuple[Path, Path]]:
    """Folders to which names are relative, and MJCF files."""
    if folder is not None:
        yield from ((folder, path) for path in sorted(folder.rglob("*.xml")))
        return
    for package in sorted(PACKAGES):
        spec = importlib.util.find_spec(package)  # of a package without a dot it imports nothing
        for place in (spec.submodule_search_locations or []) if spec else []:
            yield from ((Path(place).parent, path) for path in sorted(Path(place).rglob("*.xml")))


def unfit(path: Path) -> str:
    """Why a file is no model that can be driven, in one line; empty if it is one."""
    try:
        with quiet():
            model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        return str(error).splitlines()[0]
    return "" if model.nv and model.nu else "it has no degree of freedom" if not model.nv else "it has no actuator"


def mapping(model: mujoco.MjModel) -> str:
    """TOML of a mapping: all actuators, the joints of one degree of freedom (else sites), masses, damping, gains."""
    control = model.opt.timestep * max(round(CONTROL / model.opt.timestep), 1)
    actuators = [model.actuator(i).name for i in range(model.nactuator)]
    joints = [model.joint(i).name for i in range(model.njnt) if model.jnt_type[i] in _ONE]
    sites = [model.site(i).name for i in range(model.nsite) if model.site(i).name]
    read = f"joints = {json.dumps(joints)}" if joints else f"sites = {json.dumps(sites)}"
    bodies = [model.body(i).name for i in range(1, model.nbody) if model.body_mass[i] > 0]
    fields = {}
    for i, name in enumerate(bodies):
        some = ("body_mass", "body_inertia") if model.body(name).inertia.any() else ("body_mass",)
        fields[f"mass_{i}"] = [f"{field}:{name}" for field in some]
    if model.dof_damping.any():
        fields["damping"] = ["dof_damping:*"]
    if model.actuator_gainprm[:, 0].any():
        fields["gain"] = ["actuator_gainprm[0]:*"]
    parts = [f"[robot]\ncontrol_timestep = {control!r}", f"[commands.all]\nactuators = {json.dumps(actuators)}"]
    parts.append(f'[signal]\nname = "positions"\n{read}\nunit = "1"')
    parts += [f"[parameters.{name}]\nfields = {json.dumps(each)}\ndeviation = 0.3" for name, each in fields.items()]
    return "\n".join(parts) + "\n"


def robot_of(zoo_model: ZooModel, folder: Path) -> ModelRobot:
    """The robot of a model with a mapping of its own, which is written to a folder."""
    path = folder / "map.toml"
    path.write_text(mapping(load_model(zoo_model.path)), encoding="utf-8")
    return ModelRobot(zoo_model.path, path, threads=1)


def examined(robot: ModelRobot, changed: bool, rng: np.random.Generator) -> dict:
    """How far the written model is from the simulation, or why it is not written."""
    factors = rng.uniform(*_FACTORS, len(robot.priors)) if changed else np.ones(len(robot.priors))
    parameters = {prior.name: float(value) for prior, value in zip(robot.priors, factors, strict=True)}
    model = robot.model(parameters, [])
    try:
        xml = exported(robot, parameters, []).xml
        found = motion_difference(model, mujoco.MjModel.from_xml_string(xml))
    except PatchError as error:
        return {"alike": False, "reason": str(error)}
    replayed = replay_difference(robot, parameters, xml, found.seconds, rng)
    largest = max(found.largest, replayed)
    reason = "" if largest <= ALIKE else f"it is {largest:.2g} away after {found.seconds:g} s"
    return {"alike": not reason, "largest": largest, "seconds": found.seconds, "chaotic": found.chaotic,
            "reason": reason}  # fmt: skip


def replay_difference(
    robot: ModelRobot, parameters: dict[str, float], xml: str, seconds: float, rng: np.random.Generator
) -> float:
    """The largest difference of the signal between the fitted simulation and the written file, as a diagnosis replays
    them."""
    model, steps = robot.elements.model, max(round(seconds / robot.control_timestep), 1)
    limited = model.actuator_ctrllimited[:, None].astype(bool)
    low, high = np.where(limited, model.actuator_ctrlrange, (-1.0, 1.0)).T
    actions = rng.uniform(low, high, (steps, model.nu))
    rows = np.array([list(parameters.values()), [prior.nominal for prior in robot.priors]])
    (one,) = robot.simulate(actions, rows[:1], [()])
    (other,) = robot.as_built(xml).simulate(actions, rows[1:], [()])
    if not np.array_equal(np.isnan(one), np.isnan(other)):
        return float("inf")
    return float(np.nanmax(np.abs(one - other) / np.maximum(np.abs(one), 1.0), initial=0.0))


def case(zoo_model: ZooModel, folder: Path, seed: int) -> dict:
    """What becomes of a model, nominal and changed."""
    rng = np.random.default_rng([seed, zlib.crc32(zoo_model.name.encode())])
    try:
        robot = robot_of(zoo_model, folder)
    except (ModelError, ValueError) as error:
        return {"name": zoo_model.name, **{name: {"alike": False, "reason": f"no robot: {error}"} for name in CASES}}
    return {"name": zoo_model.name, **{name: examined(robot, name == "changed", rng) for name in CASES}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.out is None:
        survey(options.models)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    found = []
    for model in track(zoo(options.models), "models"):
        path = options.out / f"{model.name.replace('/', '_')}.json"
        if not path.exists():
            write_json(path, case(model, options.out, options.seed))
        found.append(read_json(path))
    write_json(RESULTS, read_json(RESULTS) | {"public_models": found})
    print(summary(found))


def survey(folder: Path | None) -> None:
    """Print the models, and what cannot be one with the reason."""
    found = list(surveyed(folder))
    for model, reason in found:
        print(f"{model.name}: {reason}" if reason else model.name)
    counts = Counter(model.package for model, reason in found if not reason)
    print(f"{counts.total()} models: {', '.join(f'{name} {count}' for name, count in counts.items())}")


def summary(found: list[dict]) -> str:
    """Markdown: models alike by package, and the others with their reasons."""
    rows = []
    for package in (*sorted({each["name"].split("/")[0] for each in found}), "all"):
        some = [each for each in found if package in ("all", each["name"].split("/")[0])]
        alike = [f"{sum(each[name]['alike'] for each in some)}/{len(some)}" for name in CASES]
        rows.append((package, *alike, sum(bool(each["changed"].get("chaotic")) for each in some)))
    others = [f"{each['name']}, {name}: {each[name]['reason']}" for each in found for name in CASES
              if not each[name]["alike"]]  # fmt: skip
    return "\n".join([table(("package", *CASES, "chaotic"), rows), *others])


if __name__ == "__main__":
    main()
