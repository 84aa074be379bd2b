"""A model's text from a stranger's file: it is used only if it is the user's own robot with other numbers."""

import re
from xml.etree import ElementTree

import mujoco

from soro_bench.diagnosis.robots.model_file import ModelError, in_one_line
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.files import brief

# what a patched model never has: it would open files, load libraries or make many elements of one
_NEVER = re.compile(r"<\s*(!DOCTYPE|!ENTITY|include|plugin|extension|replicate|composite|flexcomp)\b")
# attributes that name files and folders, or ask for memory
_COSTLY = re.compile(r"file\w*|\w+dir|width|height|nrow|ncol|memory|count|nuser\w*|nstack|njmax|nconmax")
_SIZES = ("nq", "nv", "nu", "nbody", "nmesh", "ntex", "nhfield")
_MEMORY = 4  # times that of the robot's own model


def checked_model(xml: str, robot: Robot) -> str:
    """The MJCF text, if it is of this robot: no file beside those of its model, as many parts, the same time step.

    Raises:
        ModelError: it is another one; nothing that it names has been opened.
    """
    if found := _NEVER.search(xml):
        raise ModelError(f"it has <{found[1]}>")
    spec = robot.spec()
    own = spec.compile()
    if foreign := _costly(xml) - _costly(spec.to_xml()):
        raise ModelError(f"it has {brief(sorted(foreign)[0])}, which the model of the robot has not")
    try:
        model = mujoco.MjModel.from_xml_string(xml)
    except ValueError as error:
        raise ModelError(f"it is no MuJoCo model: {in_one_line(error)}") from error
    for name in _SIZES:
        if getattr(model, name) != getattr(own, name):
            raise ModelError(f"it has {name} {getattr(model, name)}, the model of the robot {getattr(own, name)}")
    if model.opt.timestep != own.opt.timestep:
        raise ModelError(f"its time step is {model.opt.timestep:g} s, that of the robot {own.opt.timestep:g} s")
    if model.narena > _MEMORY * own.narena:
        raise ModelError(f"it asks for {model.narena} bytes of memory, the model of the robot for {own.narena}")
    return xml


def _costly(xml: str) -> set[str]:
    """Attributes in MJCF that name files or ask for memory, with their values."""
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise ModelError(f"it is no XML: {error}") from error
    return {f"{key}={value}" for each in root.iter() for key, value in each.attrib.items() if _COSTLY.fullmatch(key)}
