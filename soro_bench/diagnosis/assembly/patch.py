"""The patch: physics that the simulation should have, and a MuJoCo model with as much of it as a model can hold."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS

from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.pipeline import Diagnosis
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.selection.model_probabilities import Answer
from soro_bench.effects.effect import Effect, save_effects
from soro_bench.effects.elements import without_unused_springs
from soro_bench.files import replacing

KEPT = 0.5  # of the share of the variance that is explained
MODEL, REMAINING = "patched_model.xml", "remaining_effects.json"
# of a field's largest value: what compiling again changes in derived fields, and the six digits that MuJoCo writes
_ROUNDING, _PRECISION = 1e-12, 1e-5
_FLAGS = ("body_sameframe", "body_simple")  # the compiler's shortcuts, which it takes for other values of other fields


class PatchError(ValueError):
    """MJCF cannot say what the fitted model is."""


@dataclass(frozen=True)
class ModelPatch:
    """A model in MJCF with the fitted parameters.

    xml: None where MJCF cannot hold them; ``obstacle`` says why. effects: in the model. remaining: of the patch, those
    that are not.
    """

    xml: str | None
    effects: tuple[Effect, ...]
    remaining: tuple[Effect, ...]
    obstacle: str | None = None


def patch(diagnosis: Diagnosis) -> list[Effect]:
    """The physics that the simulation should have; none where nothing is missing or held-out recordings got worse.

    Outside the catalogue, the nearest law is worth having if it is more than a description of the
    recordings that it was fitted to: if held-out ones keep ``KEPT`` of what it explains.
    """
    best = diagnosis.best
    wanted = {"outside_catalogue": keeps(best), "adequate": False}.get(diagnosis.verdict, True)
    if not wanted or rejected(diagnosis):
        return []
    return best.hypothesis.effects(diagnosis.explanation.problem.parameters)


def keeps(answer: Answer) -> bool:
    """Whether an answer explains held-out recordings about as well as those that it was fitted to."""
    return answer.heldout is not None and answer.heldout.explained > KEPT * answer.train.explained


def kept(diagnosis: Diagnosis) -> Hypothesis:
    """What the patch is of; the nominal robot where there is none, since parameters that were fitted together with
    effects that are not there would be wrong."""
    return diagnosis.best.hypothesis if patch(diagnosis) else diagnosis.explanation.nominal


def rejected(diagnosis: Diagnosis) -> bool:
    """Whether the hypothesis that the report is of makes held-out recordings worse."""
    heldout = diagnosis.best.heldout
    return heldout is not None and heldout.after > heldout.before


def model_patch(diagnosis: Diagnosis) -> ModelPatch:
    """The robot's model with what was fitted: the parameters, and those effects of the patch that are native."""
    robot = diagnosis.robot
    effects = [*robot.known, *patch(diagnosis)]
    parameters = robot.parameters(kept(diagnosis).x)
    native = tuple(effect for effect in effects if robot.native(effect))
    remaining = tuple(effect for effect in effects if effect not in native)
    try:
        xml = written(patched_spec(robot, parameters, native), _comment(robot, parameters, native, remaining))
    except PatchError as error:
        return ModelPatch(None, (), tuple(effects), str(error))
    return ModelPatch(xml, native, remaining)


def write_model_patch(found: ModelPatch, folder: str | Path) -> None:
    """patched_model.xml, and remaining_effects.json where there are some, in a folder; older ones vanish."""
    folder = Path(folder)
    for name in (MODEL, REMAINING):
        (folder / name).unlink(missing_ok=True)
    if found.xml is None:
        return
    with replacing(folder / MODEL) as temporary:
        temporary.write_text(found.xml, encoding="utf-8")
    if found.remaining:
        save_effects(found.remaining, folder / REMAINING)


def patched_spec(robot: Robot, parameters: Mapping[str, float], effects: Sequence[Effect]) -> mujoco.MjSpec:
    """A robot's model with parameters and with effects that are native; it simulates the same numbers.

    Raises:
        PatchError: MJCF has no attribute for a field that they change, such as the stiffness matrix of a flex.
    """
    spec, model = robot.spec(), robot.model(parameters, effects)
    spec.compile()
    try:
        spec.copy_back(model)
        again = spec.compile()  # refuses, say, inertia that no body can have
    except ValueError as error:
        raise PatchError(f"MJCF cannot hold the fitted model: {error}") from error
    # copy_back passes over fields that it does not know
    if lost := _differing(model, again, _ROUNDING):
        raise PatchError(f"MJCF cannot hold the fitted {', '.join(lost)}")
    return without_unused_springs(spec)


def written(spec: mujoco.MjSpec, comment: str) -> str:
    """MJCF of a model, with a comment at its top; PatchError if it does not give the model again."""
    spec.comment = re.sub("-(?=-)", "- ", comment)  # two hyphens would end it
    model, xml = spec.compile(), spec.to_xml()
    try:
        again = mujoco.MjModel.from_xml_string(xml)
    except ValueError as error:
        raise PatchError(f"the fitted model cannot be read again from MJCF: {error}") from error
    if lost := _differing(model, again, _PRECISION):
        raise PatchError(f"{', '.join(lost)} cannot be read again from MJCF")
    return xml


def _differing(model: mujoco.MjModel, other: mujoco.MjModel, tolerance: float) -> list[str]:
    """Names of the fields that differ by more than a share of their largest values."""
    names = sorted(MODEL_FIELDS - set(_FLAGS))
    return [name for name in names if not _same(_values(model, name), _values(other, name), tolerance)]


def _values(model: mujoco.MjModel, name: str) -> np.ndarray:
    """A field, without what makes no difference: the lengths of quaternions, and where the mass of no mass is."""
    values = np.array(attrgetter(name)(model), float)
    if name in ("body_quat", "body_iquat"):
        values /= np.linalg.norm(values, axis=-1, keepdims=True)
    if name in ("body_ipos", "body_iquat"):
        values.reshape(model.nbody, -1)[model.body_mass.ravel() == 0] = 0.0
    return values


def _same(a: np.ndarray, b: np.ndarray, tolerance: float) -> bool:
    scale = np.abs(a).max(initial=0.0)
    return a.shape == b.shape and np.allclose(a, b, rtol=0.0, atol=tolerance * scale, equal_nan=True)


def _comment(
    robot: Robot, parameters: Mapping[str, float], native: Sequence[Effect], remaining: Sequence[Effect]
) -> str:
    values = ", ".join(f"{prior.name} {parameters[prior.name]:.6g} {prior.unit}" for prior in robot.priors)
    said = [f"Robot of {robot.name}, model {robot.model_name}, as diagnosed. Parameters: {values}."]
    said.append(f"Effects in this model: {_listed(native)}.")
    if remaining:
        said.append(f"It lacks {_listed(remaining)}: {REMAINING} has them.")
    if native:
        said.append("effects.json has all effects, those of this model too: do not apply it here.")
    return " ".join(said)


def _listed(effects: Sequence[Effect]) -> str:
    return ", ".join(f"{effect.name} at {effect.location}" for effect in effects) or "none"
