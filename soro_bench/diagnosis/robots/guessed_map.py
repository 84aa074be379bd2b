"""A guess of the robot map of a model, with comments, for a person to correct.

What a recording says is matched with the model by names first, then by numbers of columns and units. Everything that
was matched by numbers only, and everything that was not matched, is said in a comment.
"""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from soro_bench.arrays import Floats, Ints
from soro_bench.diagnosis.robots.model_file import joint_width, load_model, name_of, springs
from soro_bench.effects.elements import setpoint_unit
from soro_bench.files import shown
from soro_bench.models.simulation import quiet
from soro_bench.recording.recording import Recording, Signal

_BARE = re.compile(r"[A-Za-z0-9_-]+")  # a key of TOML that needs no quotes
_CONTROL_STEP = 0.02  # s, where no recording says how long a command is held
_SPARSE = 2.5  # times the spacing of a signal; commands that are rarer come only where they change
_BEGINS_THERE = 0.1  # of the range of the motion, as near as a recording begins to where the model does
_AS_NEAR = 2.0  # times the distance of the nearest; the first sample is as noisy
_MOST_NAMES = 12  # in a comment
_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
_ACTUATOR, _JOINT = mujoco.mjtObj.mjOBJ_ACTUATOR, mujoco.mjtObj.mjOBJ_JOINT
_BODY = mujoco.mjtObj.mjOBJ_BODY
_SITE, _SENSOR, _KEY = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_SENSOR, mujoco.mjtObj.mjOBJ_KEY
# fields that a parameter scales, the deviation of its logarithm, and what it is
_SCALED = (
    ("mass", ("body_mass", "body_inertia"), 0.2, "of all bodies; one section for each body that is unsure by itself"),
    ("damping", ("dof_damping",), 0.5, "of all joints"),
    ("friction_loss", ("dof_frictionloss",), 0.5, "dry friction of all joints"),
    ("armature", ("dof_armature",), 0.3, "inertia of the motors"),
    ("stiffness", ("jnt_stiffness",), 0.3, "of springs in joints"),
    ("tendon_stiffness", ("tendon_stiffness",), 0.3, "of springs in tendons"),
    ("tendon_damping", ("tendon_damping",), 0.5, "of tendons"),
)
_GAIN_DEVIATION = 0.2
_NO_PRODUCT = ("mjGAIN_MUSCLE", "mjGAIN_USER")  # kinds of gains that are no factor of a control


@dataclass(frozen=True)
class _Match:
    """Elements of the model that a signal may be of. kind: a key of [signal]. score: how sure that is."""

    kind: str
    names: tuple[str, ...]
    ids: Ints
    score: int


def guess_map(model: str | Path, recording: Recording | None = None) -> str:
    """The text of a robot map (TOML) with comments.

    Args:
        model: MJCF file.
        recording: of the robot, in SI units; without one, names of commands and signals are placeholders.

    Raises:
        ModelError: the file is no model.
    """
    with quiet():
        guess = _Guess(load_model(model), Path(model), recording)
        parts = [guess.head(), guess.robot(), guess.commands(), guess.signal(), guess.initial(), guess.parameters()]
    return "\n".join(line.rstrip() for part in parts for line in part) + "\n"


class _Guess:
    """The guess of one map, section by section; each gives lines."""

    def __init__(self, model: mujoco.MjModel, path: Path, recording: Recording | None):
        self.model, self.path, self.recording = model, path, recording
        self.matches = (
            {name: self._matches(name, each) for name, each in recording.signals.items()} if recording else {}
        )
        ranked = sorted(self.matches, key=lambda name: -max((m.score for m in self.matches[name]), default=0))
        self.chosen = ranked[0] if ranked and self.matches[ranked[0]] else None

    # --- elements ---

    def called(self, kind: mujoco.mjtObj, i: int) -> str:
        """The name of an element, "#3" for one that is unnamed in the file."""
        name = name_of(self.model, kind, i)
        return f"#{i}" if re.fullmatch(rf"\d+ of {re.escape(self.path.stem)}", name) else name

    def all_called(self, kind: mujoco.mjtObj, ids: Sequence[int] | Ints) -> list[str]:
        """Names of elements."""
        return [self.called(kind, int(i)) for i in ids]

    def scalar_joints(self, kind: mujoco.mjtJoint) -> Ints:
        """Hinges, or slides."""
        return np.flatnonzero(self.model.jnt_type == int(kind))

    def driven_joints(self) -> Ints:
        """Scalar joints with an actuator, in the order of the actuators."""
        model = self.model
        own = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
        found = [int(i) for i in model.actuator_trnid[own, 0] if joint_width(model, int(i))[0] == 1]
        return np.array(list(dict.fromkeys(found)), int)

    def _matches(self, name: str, signal: Signal) -> list[_Match]:
        """What a signal of the recording may be of, the surest first."""
        model, numbers = self.model, signal.values[0].size
        found: list[tuple[str, mujoco.mjtObj, Ints, int]] = []
        if signal.unit == "m" and numbers == 3 * model.nsite:
            found.append(("sites", _SITE, np.arange(model.nsite), 2))
        for i in range(model.nsite if signal.unit == "m" and numbers == 3 else 0):
            if alike := _alike(self.called(_SITE, i), name):
                found.append(("sites", _SITE, np.array([i]), 4 + alike))
        for i in range(1, model.nbody if signal.unit == "m" and numbers == 3 else 1):
            if alike := _alike(self.called(_BODY, i), name):
                found.append(("bodies", _BODY, np.array([i]), 3 + alike))
        kinds = {"rad": (_HINGE,), "m": (_SLIDE,)}.get(signal.unit, ())
        joints = np.concatenate([np.zeros(0, int), *(self.scalar_joints(kind) for kind in kinds)])
        driven = np.array([i for i in self.driven_joints() if i in joints], int)
        for ids, score in ((driven, 4), (joints, 3)):
            found += [("joints", _JOINT, ids, score)] if len(ids) == numbers else []
        for i in joints if numbers == 1 else ():
            if alike := _alike(self.called(_JOINT, int(i)), name):
                found.append(("joints", _JOINT, np.array([i]), 5 + alike))
        for i in range(model.nsensor):
            if int(model.sensor_dim[i]) == numbers and (alike := _alike(self.called(_SENSOR, i), name)):
                found.append(("sensors", _SENSOR, np.array([i]), 5 + alike))
        matches = [_Match(kind, tuple(self.all_called(obj, ids)), ids, score) for kind, obj, ids, score in found]
        return sorted(matches, key=lambda match: -match.score)

    # --- sections ---

    def head(self) -> Iterator[str]:
        """What the file is."""
        of = f"{self.path.name} and a recording" if self.recording else f"{self.path.name}, without a recording"
        yield f"# Robot map guessed from {of}: check every line. docs/reference/robot_map.md"

    def robot(self) -> Iterator[str]:
        """The control step."""
        step, why = self._control_step()
        yield "\n[robot]"
        yield f"control_timestep = {step:.9g}   # s, {why}"
        yield "# settle = 1.0   # s under the first command, if the robot was at rest when the recording began"

    def _control_step(self) -> tuple[float, str]:
        own = float(self.model.opt.timestep)
        if self.recording is None:
            return max(round(_CONTROL_STEP / own), 1) * own, "a guess: how long a command is held"
        signals = [_spacing(each) for each in self.recording.signals.values()]
        commands = [_spacing(each) for each in self.recording.commands.values()]
        signal, command = min(signals, default=_CONTROL_STEP), min(commands, default=np.inf)
        if command <= _SPARSE * signal:
            return command, "the spacing of the command"
        if not commands:
            return signal, "the spacing of the signal, as no command was recorded"
        return signal, "the spacing of the signal, as commands come rarely"

    def commands(self) -> Iterator[str]:
        """Commands with their actuators, and what is left."""
        model, left = self.model, list(range(self.model.nu))
        if self.recording is None:
            if left:
                yield "\n[commands.action]   # placeholder: the name of the command in the recording"
                yield f"actuators = {_list(self.all_called(_ACTUATOR, left))}"
            return
        width = {name: each.values[0].size for name, each in self.recording.commands.items()}
        for name, columns in width.items():
            alike = {i: max(_alike(self.called(_ACTUATOR, i), name), _alike(self._target(i), name)) for i in left}
            best = max(alike.values(), default=0) if columns == 1 else 0
            named = [i for i in left if best and alike[i] == best]
            in_order = sum(width.values()) == model.nu or columns == len(left)
            unit = self.recording.commands[name].unit
            alike_in_unit = [i for i in left if setpoint_unit(model, i) == unit]
            exact = len(alike_in_unit) == columns < len(left)
            chosen = named[:1] or (alike_in_unit if exact else left[:columns] if in_order else [])
            if len(chosen) != columns:
                yield f"\n# command {name!r} has {columns} columns; say which actuators they move:"
                yield f"# [commands.{_key(name)}]\n# actuators = {_list(self.all_called(_ACTUATOR, left))}"
                continue
            left = [i for i in left if i not in chosen]
            by = "unit" if exact else "number of columns"
            yield f"\n[commands.{_key(name)}]" + ("" if named else f"   # matched by {by}: check the order")
            yield f"actuators = {_list(self.all_called(_ACTUATOR, chosen))}"
            yield f"unit = {_text(unit)}"
        if left:
            yield "\n# no command drives these; give constant controls, or they are held at 0 or as in the keyframe"
            yield "# [fixed]"
            yield from (f"# {_key(self.called(_ACTUATOR, i))} = 0.0" for i in left)

    def _target(self, actuator: int) -> str:
        """The name of the joint that an actuator drives, if it does."""
        own = self.model.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_JOINT)
        return self.called(_JOINT, int(self.model.actuator_trnid[actuator, 0])) if own else ""

    def signal(self) -> Iterator[str]:
        """What is explained, and what else could be."""
        yield "\n[signal]   # what is explained"
        if self.recording and self.chosen:
            best, signal = self.matches[self.chosen][0], self.recording.signals[self.chosen]
            yield f"name = {_text(self.chosen)}"
            yield f"{best.kind} = {_list(best.names)}"
            yield f"unit = {_text(signal.unit)}"
            yield from [f"frame = {_text(signal.frame)}"] if signal.frame else []
        elif self.recording and self.recording.signals:
            name, signal = next(iter(self.recording.signals.items()))
            yield f"name = {_text(name)}   # a sample has {signal.values[0].size}; nothing in the model is called so"
            yield f"sites = []   # write sites, bodies, joints or sensors\nunit = {_text(signal.unit)}"
        else:
            yield from self._placeholder()
        yield from self._others()

    def _placeholder(self) -> Iterator[str]:
        """The signal of a model without a recording: joints that are driven, or any."""
        driven, hinges = self.driven_joints(), self.scalar_joints(_HINGE)
        turning = [i for i in driven if i in hinges] or list(driven) or list(hinges) or list(self.scalar_joints(_SLIDE))
        if turning:
            turns = self.model.jnt_type[turning[0]] == int(_HINGE)
            same = [i for i in turning if (i in hinges) == turns]
            yield 'name = "angles"   # placeholder: the name of the signal in the recording' if turns else (
                'name = "positions"   # placeholder: the name of the signal in the recording')  # fmt: skip
            yield f"joints = {_list(self.all_called(_JOINT, same))}\nunit = {_text('rad' if turns else 'm')}"
        else:
            yield 'name = "markers"   # placeholder: the name of the signal in the recording'
            yield f'sites = {_list(self.all_called(_SITE, range(self.model.nsite)))}\nunit = "m"\nframe = "world"'

    def _others(self) -> Iterator[str]:
        """Comments: other signals, and what the model has to compare with."""
        for name, matches in self.matches.items():
            if name != self.chosen and matches:
                yield f"# instead, or also in [[signals]], {name!r}: {matches[0].kind} = {_list(matches[0].names)}"
        if unmatched := [name for name, matches in self.matches.items() if not matches]:
            yield f"# signals that nothing in the model is called like: {_shown(unmatched)}"
        for label, kind, count in (
            ("sites", _SITE, self.model.nsite),
            ("sensors", _SENSOR, self.model.nsensor),
            ("joints", _JOINT, self.model.njnt),
        ):
            if count:
                yield f"# {label} of the model: {_shown(self.all_called(kind, range(count)))}"

    def initial(self) -> Iterator[str]:
        """Where a recording begins: at the keyframe or default position that is nearest, or where it says."""
        keys = self.all_called(_KEY, range(self.model.nkey))
        if self.recording is None or self.chosen is None:
            if keys:
                yield f"\n[initial]\nkeyframe = {_text(keys[0])}   # one of {_shown(keys)}"
                yield '# keyframe = "" begins in the default position; joints = [...] at the first sample'
            return
        best, signal = self.matches[self.chosen][0], self.recording.signals[self.chosen]
        first = signal.values[0].ravel()
        misses = np.array([np.abs(self._simulated(best, key) - first).max() for key in range(-1, len(keys))])
        equal = np.flatnonzero(misses <= _AS_NEAR * misses.min()).tolist()  # a signal may not show the difference
        nearest, motion = next((i for i in equal if i), 0), float(np.nanmax(np.ptp(signal.values, axis=0), initial=0.0))
        there = bool(misses[nearest] <= _BEGINS_THERE * motion)
        yield "\n[initial]" if keys or not there else ""
        if keys:
            names = ["the default position", *keys]
            why = "; as near: " + _shown([names[i] for i in equal if i != nearest]) if len(equal) > 1 else ""
            yield f"keyframe = {_text(names[nearest] if nearest else '')}   # the nearest of {_shown(names)}{why}"
        given = set(best.names if best.kind == "joints" else ())
        if not there and np.isfinite(first).all():
            yield from self._first_samples(best, float(misses[nearest]), given)
        yield from self._other_joints(given, nearest - 1)

    def _first_samples(self, best: _Match, miss: float, given: set[str]) -> Iterator[str]:
        """Joints that begin at the first sample of a signal, added to those ``given``; ``miss``: how far from there the
        model begins."""
        if best.kind == "joints":
            yield f"joints = {_list(best.names)}   # the recording begins elsewhere"
            yield from self._speeds(best)
            return
        starts = {name: [m for m in self.matches[name] if m.kind == "joints"] for name in self.matches}
        if begins := next(((name, found[0]) for name, found in starts.items() if found), None):
            yield f"[initial.signals.{_key(begins[0])}]   # the recording begins elsewhere"
            yield f"joints = {_list(begins[1].names)}"
            yield from self._speeds(begins[1])
            given.update(begins[1].names)
        else:
            yield f"# the recording begins {miss:.3g} from there, in the unit of the signal; settle, or give joints"

    def _other_joints(self, given: set[str], keyframe: int) -> Iterator[str]:
        """Other joints than those ``given`` that a signal shows to begin elsewhere than at a keyframe."""
        assert self.recording is not None
        for name, matches in self.matches.items():
            match = next((each for each in matches if each.kind == "joints"), None)
            if match is None or given & set(match.names):
                continue
            values = self.recording.signals[name].values.reshape(-1, len(match.ids))
            miss, motion = np.abs(self._simulated(match, keyframe) - values[0]).max(), np.ptp(values, axis=0)
            if miss > _BEGINS_THERE * float(np.nanmax(motion, initial=0.0)):
                given.update(match.names)
                yield f"[initial.signals.{_key(name)}]   # the recording begins elsewhere"
                yield f"joints = {_list(match.names)}"

    def _speeds(self, match: _Match) -> Iterator[str]:
        """Comments: a signal that may be the velocities of joints."""
        assert self.recording is not None
        for name, signal in self.recording.signals.items():
            if signal.unit in ("rad/s", "m/s") and signal.values[0].size == len(match.names):
                yield f"# [initial.signals.{_key(name)}]   # if the robot moves then"
                yield f"# velocities = {_list(match.names)}"

    def _simulated(self, match: _Match, keyframe: int) -> Floats:
        """(n,) the signal where the model begins."""
        model, data = self.model, mujoco.MjData(self.model)
        if keyframe >= 0:
            mujoco.mj_resetDataKeyframe(model, data, keyframe)
        mujoco.mj_forward(model, data)
        if match.kind == "sites":
            return np.asarray(data.site_xpos[match.ids].ravel())
        if match.kind == "bodies":
            return np.asarray(data.xpos[match.ids].ravel())
        if match.kind == "joints":
            return np.asarray(data.qpos[model.jnt_qposadr[match.ids]])
        first = int(model.sensor_adr[match.ids[0]])
        return np.asarray(data.sensordata[first : first + int(model.sensor_dim[match.ids[0]])])

    def parameters(self) -> Iterator[str]:
        """What is unsure of most models: masses, damping, gains; only what is not 0."""
        model = self.model
        for name, fields, deviation, what in _SCALED:
            values = getattr(model, fields[0])
            values = values[: len(values) - springs(model)] if fields[0].startswith("tendon") else values
            if np.any(values):
                yield from _parameter(name, [f"{field}:*" for field in fields], deviation, what)
        for name, columns, ids, what in _gains(model):
            # the bias of a servo that is at rest elsewhere is a product with its gain too
            rests = [("biasprm", 0)] if name == "position_gain" and model.actuator_biasprm[ids, 0].any() else []
            columns = [columns[0], *rests, *columns[1:]]
            of = ["*"] if len(ids) == model.nu else self.all_called(_ACTUATOR, ids)
            gains = [f"actuator_{field}[{column}]:{one}" for one in of for field, column in columns]
            yield from _parameter(name, gains, _GAIN_DEVIATION, what)
        if model.ngeom and np.any(model.geom_contype | model.geom_conaffinity):
            yield "\n# [parameters.sliding_friction]   # if the robot touches something"
            yield '# fields = ["geom_friction[0]:*"]\n# deviation = 0.3'


def _gains(model: mujoco.MjModel) -> Iterator[tuple[str, list[tuple[str, int]], Ints, str]]:
    """Groups of actuators of one kind: name, fields with their columns, ids, and what that is."""
    gain, bias = model.actuator_gainprm, model.actuator_biasprm
    product = ~np.isin(model.actuator_gaintype, [int(getattr(mujoco.mjtGain, each)) for each in _NO_PRODUCT])
    affine = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    position, velocity = affine & (bias[:, 1] != 0), affine & (bias[:, 1] == 0) & (bias[:, 2] != 0)
    kinds: tuple[tuple[str, Any, list[tuple[str, int]], str], ...] = (
        ("position_gain", position, [("gainprm", 0), ("biasprm", 1)], "stiffness of position servos"),
        ("velocity_gain", velocity, [("gainprm", 0), ("biasprm", 2)], "of velocity servos"),
        ("motor_gain", ~affine, [("gainprm", 0)], "force of the motors"),
    )
    for name, which, columns, what in kinds:
        if len(ids := np.flatnonzero(which & product & (gain[:, 0] != 0))):
            yield name, columns, ids, what


def _parameter(name: str, fields: Sequence[str], deviation: float, what: str) -> Iterator[str]:
    yield f"\n[parameters.{name}]   # {what}"
    yield f"fields = {_list(fields)}"
    yield f"deviation = {deviation}   # of the logarithm of a factor: {100 * (np.exp(deviation) - 1):.0f} % either way"


def _spacing(signal: Signal) -> float:
    """Median spacing of the samples of a signal [s]."""
    return float(np.median(np.diff(signal.time))) if len(signal.time) > 1 else np.inf


def _alike(one: str, other: str) -> int:
    """2 where two names are the same but for letters' case and separators; 1 where one is a part of the other, such as
    "gripper" of "left_gripper_goal"; else 0."""
    a, b = (re.findall(r"[a-z0-9]+", each.lower()) for each in (one, other))
    short, long = sorted((a, b), key=len)
    parts = (long[i : i + len(short)] for i in range(len(long) - len(short) + 1))
    return 2 if "".join(a) == "".join(b) != "" else int(bool(short) and short in parts)


def _shown(names: Sequence[str]) -> str:
    """Names in a comment, the first of many."""
    return shown(", ".join([*names[:_MOST_NAMES], *["..."] * (len(names) > _MOST_NAMES)]))


def _text(text: str) -> str:
    """A text of TOML."""
    return json.dumps(text, ensure_ascii=False)


def _list(texts: Sequence[str]) -> str:
    return "[" + ", ".join(map(_text, texts)) + "]"


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else _text(name)
