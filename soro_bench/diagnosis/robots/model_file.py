"""A MuJoCo model as a file has it: read, checked, and its elements found by name or number."""

import hashlib
import re
import warnings
from operator import attrgetter
from pathlib import Path
from typing import TypeAlias

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS

from soro_bench.diagnosis.result_robot import SourceFile
from soro_bench.effects.elements import AUXILIARY, instrument
from soro_bench.errors import one_line

_TIMESTEPS = 1e-6, 1.0  # s, least and longest of a model
_MOST_NAMES = 20  # in a message
_LONGEST = 400  # letters of one of MuJoCo's errors
_NUMBER = re.compile(r"#(\d{1,9})")  # how an unnamed element is called
_ADVICE = {  # what to do, by what MuJoCo's error says
    "plugin": "install that plugin where MuJoCo loads it, or take it out of the model",
    "decoder": "give MJCF (.xml) or URDF (.urdf)",
    "opening": "a model needs the files that it names, in the folders that it names, beside it",
    "resource": "a model needs the files that it names, in the folders that it names, beside it",
    "composite": "write a flexcomp instead, or save the model compiled by an older MuJoCo as XML",
}
_COUNTS = {"joint": "njnt", "actuator": "nu", "keyframe": "nkey"}
_KINDS = {"key": "keyframe"}


class ModelError(ValueError):
    """A model or its mapping cannot be used; says what is wrong and what is allowed."""


Model: TypeAlias = str | Path | mujoco.MjSpec  # an MJCF file, or what MuJoCo has made of one


def title(model: Model) -> str:
    """What a model is called: the name of its file without suffix, or that in a spec."""
    return model.modelname if isinstance(model, mujoco.MjSpec) else Path(model).stem


def source_files(*sources: object) -> tuple[SourceFile, ...]:
    """The files that a robot was made from; none if not all of them are files."""
    paths = [Path(each) for each in sources if isinstance(each, str | Path)]
    if len(paths) < len(sources) or not all(path.is_file() for path in paths):
        return ()
    return tuple(SourceFile(path.as_posix(), hashlib.sha256(path.read_bytes()).hexdigest()) for path in paths)


def load_spec(model: Model) -> mujoco.MjSpec:
    """A model with absolute paths of its files, prepared for effects; a spec stays as it is.

    Raises:
        ModelError: it is no model; in one line, with what to do.
    """
    spec, folder = _read(model)
    # a patched model, which lies elsewhere, finds the same files
    if spec.meshes or spec.hfields or spec.skins:
        spec.meshdir = str(folder / spec.meshdir)
    if spec.textures:
        spec.texturedir = str(folder / spec.texturedir)
    return instrument(_named(spec, title(model)))


def _read(model: Model) -> tuple[mujoco.MjSpec, Path]:
    """A spec of its own, and the folder that the names of its files are of."""
    if isinstance(model, mujoco.MjSpec):
        return model.copy(), Path(model.modelfiledir).resolve()
    if not Path(model).is_file():
        raise ModelError(f"there is no model {model}")
    try:
        return mujoco.MjSpec.from_file(str(model)), Path(model).resolve().parent
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(f"{model} is no MuJoCo model: {with_advice(error)}") from error


def load_model(model: Model, shorter: int = 1) -> mujoco.MjModel:
    """A model, prepared for effects.

    Args:
        shorter: how many times shorter its time steps will be; delays remember as many samples more.

    Raises:
        ModelError: it is none, or has values that cannot be simulated.
    """
    spec, path = load_spec(model), title(model) if isinstance(model, mujoco.MjSpec) else model
    for delayed in (*spec.actuators, *spec.sensors):
        delayed.nsample *= shorter
    try:
        with warnings.catch_warnings():  # of attributes that a later MuJoCo will not have
            warnings.simplefilter("ignore")
            compiled = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(f"{path} is no MuJoCo model: {with_advice(error)}") from error
    for field in MODEL_FIELDS:
        if np.isnan(attrgetter(field)(compiled)).any():  # MuJoCo only warns
            raise ModelError(f"{path}: {field} is not a number somewhere")
    low, high = _TIMESTEPS
    if not low <= compiled.opt.timestep <= high:
        raise ModelError(f"{path}: timestep is {compiled.opt.timestep} s; allowed is {low:g} to {high:g} s")
    if (several := compiled.actuator_ctrlnum != 1).any():
        i = int(several.argmax())
        raise ModelError(f"{path}: actuator {compiled.actuator(i).name!r} has {compiled.actuator_ctrlnum[i]} controls; "
                         "allowed is one")  # fmt: skip
    if not compiled.nv:
        raise ModelError(f"{path}: nothing moves in it; a robot has one joint at least")
    return compiled


def with_advice(error: Exception) -> str:
    """What MuJoCo says, in one line, with what to do about it where that is known."""
    text = one_line(error)
    text = text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."
    advice = next((each for word, each in _ADVICE.items() if word in text.lower()), None)
    return f"{text}; {advice}" if advice else text


def _named(spec: mujoco.MjSpec, model: str) -> mujoco.MjSpec:
    """The spec with names for elements without one, since effects need names; each model gets other names.

    Joints of a flex's vertices are not named: no effect acts on one alone.
    """
    vertices = {name for flex in spec.flexes for name in (*flex.vertbody, *flex.nodebody)}
    joints = [joint for joint in spec.joints if joint.parent.name not in vertices]
    for elements in (spec.tendons, joints, spec.actuators, spec.bodies):
        for i, one in enumerate(elements):
            one.name = one.name or f"{i} of {model}"
    return spec


def element(model: mujoco.MjModel, kind: mujoco.mjtObj, name: object) -> int:
    """MuJoCo's id of an element that is called by its name, or "#3" by its number.

    Raises:
        ModelError: there is none; lists those that there are.
    """
    found = mujoco.mj_name2id(model, kind, name) if isinstance(name, str) else -1
    if found < 0 and isinstance(name, str) and (number := _NUMBER.fullmatch(name)):
        found = int(number[1]) if int(number[1]) < count(model, kind) else -1
    if found < 0:
        raise ModelError(f"the model has no {label(kind)} {name!r}; it has {_names(model, kind)}")
    return found


def label(kind: mujoco.mjtObj) -> str:
    """What people call a kind of elements."""
    word = kind.name[6:].lower()
    return _KINDS.get(word, word)


def count(model: mujoco.MjModel, kind: mujoco.mjtObj) -> int:
    """Number of the model's elements of a kind, those that were added for effects apart."""
    word = label(kind)
    found = int(getattr(model, _COUNTS.get(word, f"n{word}")))
    return found - springs(model) if kind == mujoco.mjtObj.mjOBJ_TENDON else found


def name_of(model: mujoco.MjModel, kind: mujoco.mjtObj, number: int) -> str:
    """The name of an element, or "#3" where it has none."""
    return mujoco.mj_id2name(model, kind, number) or f"#{number}"


def springs(model: mujoco.MjModel) -> int:
    """Number of tendons that were added for effects; they come last."""
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TENDON, i) for i in range(model.ntendon)]
    return sum(bool(name) and name.startswith(AUXILIARY) for name in names)


def _names(model: mujoco.MjModel, kind: mujoco.mjtObj) -> str:
    """Names of the model's elements of a kind, or the first of many."""
    found = [name_of(model, kind, i) for i in range(min(count(model, kind), _MOST_NAMES + 1))]
    return ", ".join(found[:_MOST_NAMES] + ["..."] * (len(found) > _MOST_NAMES)) or "none"


def scalar_joint(model: mujoco.MjModel, name: object) -> int:
    """MuJoCo's id of a joint with one degree of freedom; ModelError for another one."""
    number = element(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    if (width := joint_width(model, number)[0]) > 1:
        raise ModelError(
            f"joint {name!r} has {width} numbers of different units; give a site or sensors of its body instead"
        )
    return number


def joint_width(model: mujoco.MjModel, number: int) -> tuple[int, int]:
    """How many positions and velocities a joint has: 7 and 6 of a free one, 4 and 3 of a ball, else 1 and 1."""
    return {"mjJNT_FREE": (7, 6), "mjJNT_BALL": (4, 3)}.get(mujoco.mjtJoint(model.jnt_type[number]).name, (1, 1))


def names_of(section: str, entry: object, key: str) -> list[str]:
    """The list of names that an entry of a section has; ModelError for anything else."""
    values = entry.get(key) if isinstance(entry, dict) else None
    if not isinstance(values, list) or not values or not all(isinstance(value, str) for value in values):
        raise ModelError(f"[{section}] {key} is {values!r}; expected a list of names")
    if len(set(values)) < len(values):
        raise ModelError(f"[{section}] {key} is {values!r}; expected each name once")
    return values


def number(name: str, value: object, low: float, high: float) -> float:
    """A value that is a number within bounds; ModelError for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise ModelError(f"{name} is {value!r}; expected a number from {low:g} to {high:g}")
    return float(value)


def check_keys(section: str, table: dict, allowed: tuple[str, ...]) -> None:
    """Refuse entries of a section that are not allowed."""
    for key in table:
        if key not in allowed:
            raise ModelError(f"unknown entry {key!r} in {section}; there are {', '.join(allowed)}")
