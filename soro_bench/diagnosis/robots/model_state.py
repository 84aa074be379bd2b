"""What of a MuJoCo model's state a recording shows (the signal), and where a recording begins (the initial state)."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from soro_bench.arrays import Floats, Ints, rotate_by_quaternion
from soro_bench.diagnosis.robots.measured import ObservedSignal
from soro_bench.diagnosis.robots.model_file import (
    ModelError,
    check_keys,
    count,
    element,
    joint_width,
    name_of,
    names_of,
    scalar_joint,
)
from soro_bench.effects.catalogue import MEASUREMENT
from soro_bench.effects.effect import Effect
from soro_bench.effects.measurement import SensorDelay, undone
from soro_bench.recording.recording import Recording, RecordingError, Signal

_PLACES = ("sites", "bodies", "joints", "sensors")
_COORDINATES = 3  # of a point, at most
_QUATERNION = 4  # numbers
_UNIT_LENGTH = 0.05  # by which the length of a quaternion may differ from 1, as rounded ones do
_LATEST = SensorDelay.quantities[0].bounds[1]  # s, by which a sensor may be late
_KEYFRAME = mujoco.mjtObj.mjOBJ_KEY
_JOINT = mujoco.mjtObj.mjOBJ_JOINT
_NUMBER_OF = re.compile(r"(.+)\[(\d{1,9})\]")  # of the numbers of a sensor


@dataclass(frozen=True)
class SignalSource:
    """Where the explained signal is in MuJoCo's data.

    field: of the data. ids: which entries of it. shape: (P, D), points and coordinates. quaternions: whether ``ids``
    are those of quaternions; each is explained as three points, the axes of its frame, which have no sign to choose.
    stage: which of MuJoCo's stages computes it.
    """

    field: str
    ids: Ints
    shape: tuple[int, int]
    quaternions: bool = False
    stage: int = int(mujoco.mjtStage.mjSTAGE_VEL)

    @property
    def recorded(self) -> int:
        """How many numbers a sample of the recording has."""
        return len(self.ids) if self.quaternions else self.shape[0] * self.shape[1]

    def read(self, batch: Batch, simulations: int) -> Floats:
        """(n, P, D) the signal of the first n simulations now."""
        values = getattr(batch, self.field)[:simulations, self.ids]
        return (axes(values) if self.quaternions else values).reshape(simulations, *self.shape)

    def converted(self, name: str, signal: Signal) -> Signal:
        """A recorded signal as it is explained.

        Raises:
            RecordingError: a quaternion is none.
        """
        samples = signal.values.reshape(len(signal.time), -1)
        if samples.shape[1] != self.recorded:
            return signal  # refused later, as for any robot
        if self.quaternions:
            return as_axes(name, signal, self.shape)
        if self.field == "sensordata" and self.shape[1] == 1:  # numbers of wide sensors
            return replace(signal, values=samples)
        return signal


def as_axes(name: str, signal: Signal, shape: tuple[int, int]) -> Signal:
    """A signal of unit quaternions (T, 4 K), w first, as the axes of the frames that they turn, of shape (3 K, 3).

    Raises:
        RecordingError: a quaternion is none.
    """
    samples = signal.values.reshape(len(signal.time), -1)
    lengths = np.linalg.norm(samples.reshape(len(samples), -1, _QUATERNION), axis=2)
    if (odd := (np.abs(lengths - 1.0) > _UNIT_LENGTH).any(axis=1)).any():
        at = signal.time[odd.argmax()]
        raise RecordingError(f"{name} is no unit quaternion (w, x, y, z) at {at:.6g} s")
    return replace(signal, values=axes(samples).reshape(len(samples), *shape))


def axes(quaternions: Floats) -> Floats:
    """(n, P, 9) the three axes of the frames that unit quaternions (n, 4 P), w first, turn."""
    each = quaternions.reshape(len(quaternions), -1, 1, _QUATERNION)
    each = each / np.linalg.norm(each, axis=-1, keepdims=True)
    found = rotate_by_quaternion(np.eye(3), np.broadcast_to(each, (*each.shape[:2], 3, _QUATERNION)))
    return np.asarray(found.reshape(*each.shape[:2], 9))


def quaternions(frames: Floats) -> Floats:
    """(4 K,) the unit quaternions, w first, that turn the axes of K frames (3 K, 3): what ``axes`` makes of them."""
    found = np.zeros((len(frames) // 3, _QUATERNION))
    for each, frame in zip(found, frames.reshape(-1, 3, 3), strict=True):
        mujoco.mju_mat2Quat(each, frame.T.ravel())
    return found.ravel()


def signal_sources(
    model: mujoco.MjModel, first: dict[str, Any], others: list[dict[str, Any]]
) -> tuple[list[ObservedSignal], dict[str, SignalSource]]:
    """The signals of a mapping, the first one first, and where each is in the model.

    Args:
        first: the section [signal].
        others: the sections [[signals]].

    Raises:
        ModelError: says what is wrong.
    """
    found, sources = [], {}
    for section, table in [("signal", first), *(("signals", each) for each in others)]:
        source = signal_source(model, table, section)
        name = table["name"]
        if name in sources:
            raise ModelError(f"[[signals]] has {name!r} twice; a signal is explained once")
        sources[name] = source
        frame = table.get("frame", "")
        found.append(ObservedSignal(name, table["unit"], frame, source.shape, source.quaternions))
    return found, sources


def signal_source(model: mujoco.MjModel, table: dict[str, Any], section: str = "signal") -> SignalSource:
    """Look up a signal of a mapping in the model.

    Args:
        section: of the mapping, for messages.

    Raises:
        ModelError: says what is wrong.
    """
    places = [key for key in _PLACES if key in table]
    if len(places) != 1 or not isinstance(table.get("name"), str) or not isinstance(table.get("unit"), str):
        raise ModelError(f"[{section}] needs a name, a unit, and one of {', '.join(_PLACES)}")
    names = names_of(section, table, places[0])
    if places[0] == "sites":
        sites = np.array([element(model, mujoco.mjtObj.mjOBJ_SITE, name) for name in names])
        return SignalSource("site_xpos", sites, (len(names), 3))
    if places[0] == "bodies":
        bodies = np.array([element(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in names])
        return SignalSource("xpos", bodies, (len(names), 3))
    if places[0] == "joints":
        return _of_joints(model, names, table["unit"])
    return _of_sensors(model, names, table["unit"])


def _of_joints(model: mujoco.MjModel, names: list[str], unit: str) -> SignalSource:
    ids = [element(model, _JOINT, name) for name in names]
    first = model.jnt_qposadr[ids]
    if all(model.jnt_type[i] == mujoco.mjtJoint.mjJNT_BALL for i in ids):
        return _quaternions("qpos", first, unit)
    return SignalSource("qpos", np.array([model.jnt_qposadr[scalar_joint(model, name)] for name in names]),
                        (len(names), 1))  # fmt: skip


def _of_sensors(model: mujoco.MjModel, names: list[str], unit: str) -> SignalSource:
    ids, parts = zip(*(_sensor(model, name) for name in names), strict=True)
    if len(widths := {len(part) for part in parts}) > 1:
        raise ModelError(f"[signal] sensors {', '.join(names)} have {sorted(widths)} numbers; all need as many")
    (width,), rows = widths, list(ids)
    # those of accelerations and forces too
    stage = max(int(mujoco.mjtStage.mjSTAGE_VEL), int(model.sensor_needstage[rows].max()))
    turns = (model.sensor_datatype[rows] == mujoco.mjtDataType.mjDATATYPE_QUATERNION).all()
    if turns and width == _QUATERNION:
        return replace(_quaternions("sensordata", model.sensor_adr[rows], unit), stage=stage)
    numbers = np.concatenate(parts)
    shape = (len(names), width) if width <= _COORDINATES else (len(numbers), 1)
    return SignalSource("sensordata", numbers, shape, stage=stage)


def _sensor(model: mujoco.MjModel, name: str) -> tuple[int, Ints]:
    """The id of a sensor, and where its numbers are in the data: all of them, or the one that "imu[1]" means."""
    kind = mujoco.mjtObj.mjOBJ_SENSOR
    of_one = _NUMBER_OF.fullmatch(name) if mujoco.mj_name2id(model, kind, name) < 0 else None
    i = element(model, kind, of_one[1] if of_one else name)
    every = np.arange(model.sensor_dim[i])
    if of_one and int(of_one[2]) >= len(every):
        raise ModelError(f"[signal] has {name!r}; that sensor has the numbers 0 to {len(every) - 1}")
    return i, model.sensor_adr[i] + (every[[int(of_one[2])]] if of_one else every)


def _quaternions(field: str, first: Ints, unit: str) -> SignalSource:
    """The signal of quaternions that begin at ``first`` (P,) of a field."""
    if unit != "1":
        raise ModelError(f'[signal] unit is {unit!r}; quaternions have "1"')
    return SignalSource(field, (first[:, None] + np.arange(_QUATERNION)).ravel(), (3 * len(first), 3), True)


@dataclass(frozen=True)
class Part:
    """Positions or velocities that begin at the first sample of a signal: entries ``ids`` of MuJoCo's ``field``."""

    signal: str
    field: str
    ids: Ints


@dataclass(frozen=True)
class InitialState:
    """Where a recording begins: the model's default position or a keyframe, and on top what the recording says.

    keyframe: its number; -1 for the default position. parts: what the recording says.
    control: (nu,) controls of actuators without a command.
    """

    keyframe: int
    parts: tuple[Part, ...]
    control: Floats

    def write(self, batch: Batch, ids: Ints, start: Floats | None) -> None:
        """Set the state of simulations ``ids`` (n,) to ``start`` (n, S), as ``begun`` gives it for each of them."""
        batch.reset(ids, keyframe=self.keyframe, stage=mujoco.mjtStage.mjSTAGE_NONE)
        if start is None or not self.parts:
            return
        numbers, done = start.reshape(len(ids), -1), 0
        for part in self.parts:
            values = numbers[:, done : done + len(part.ids)]
            getattr(batch, part.field)[np.ix_(ids, part.ids)] = values
            done += len(part.ids)

    def happened(
        self,
        start: Floats,
        early: Floats,
        step: float,
        effects: Sequence[Effect],
        signals: Sequence[ObservedSignal],
    ) -> Floats:
        """What was there of a state of which ``start`` was recorded, with faults of sensors among ``effects``.

        Args:
            start: the first row of ``early``, of any shape; or not far from it, as noise is.
            early: (E, S) as ``begun`` gives it.
            step: s, of the control.
            signals: that are explained; the sensors of others have no faults.
        """
        rows, time = early + (start.ravel() - early[0]), np.asarray(step * np.arange(len(early)), float)
        found, done = rows[0], 0
        for part in self.parts:
            where = slice(done, done := done + len(part.ids))
            for signal in signals:
                if signal.name == part.signal:
                    turned = len(part.ids) != signal.size  # quaternions, which are explained as axes
                    values = (axes(rows[:, where]) if turned else rows[:, where]).reshape(-1, *signal.shape)
                    first = undone(MEASUREMENT, effects, time, values, signal.name)[0]
                    found[where] = quaternions(first) if turned else first.ravel()
        return found.reshape(start.shape)

    def begun(self, recording: Recording, begin: float, step: float) -> Floats:
        """(E, S) what the recording says of the state at its begin [s], and in the control steps after until its
        sensors cannot be later.

        Args:
            step: s, of the control; a sample counts if it is not later than that.

        Raises:
            RecordingError: a signal is not there, or its first sample is missing or late.
        """
        found, after = [], begin + step * np.arange(1, int(_LATEST / step) + 1)
        for part in self.parts:
            if part.signal not in recording.signals:
                raise RecordingError(f"[initial] names the signal {part.signal!r}; there are {recording.names}")
            signal = recording.signals[part.signal]
            samples, later = signal.values.reshape(len(signal.time), -1), float(signal.time[0]) - begin
            first = samples[0]
            if len(first) != len(part.ids):
                raise RecordingError(f"[initial] needs {len(part.ids)} numbers of {part.signal}; it has {len(first)}")
            if not np.isfinite(first).all():
                raise RecordingError(f"the first sample of {part.signal} has gaps; [initial] needs all of it")
            if later > step * (1 + 1e-6):
                raise RecordingError(
                    f"the first sample of {part.signal} is {later:g} s after the recording begins; [initial] needs one "
                    f"within a control step, {step:g} s"
                )
            columns = [(column, np.isfinite(column)) for column in samples.T]
            rows = [np.interp(after, signal.time[seen], column[seen]) for column, seen in columns]
            found.append(np.vstack([first, np.transpose(rows)]))
        return np.hstack(found)


def initial_state(model: mujoco.MjModel, table: dict[str, Any], source: SignalSource, signal: str) -> InitialState:
    """The section [initial] of a mapping.

    Args:
        signal: name of the explained signal.

    Raises:
        ModelError: says what is wrong.
    """
    parts = []
    if "joints" in table:
        ids = _positions(model, names_of("initial", table, "joints"))
        if len(ids) != source.recorded:
            raise ModelError(f"[initial] has {len(ids)} joints; the signal has samples of shape {source.shape}")
        parts.append(Part(signal, "qpos", ids))
    signals = table.get("signals", {})
    if not isinstance(signals, dict):
        raise ModelError("[initial] signals has to be sections, [initial.signals.<name of a signal>]")
    for name, entry in signals.items():
        section = f"initial.signals.{name}"
        if not isinstance(entry, dict) or len(entry) != 1:
            raise ModelError(f"[{section}] needs joints or velocities, a list of joints")
        check_keys(f"[{section}]", entry, ("joints", "velocities"))
        (key,) = entry
        names = names_of(section, entry, key)
        found = _positions(model, names) if key == "joints" else _velocities(model, names)
        parts.append(Part(name, "qpos" if key == "joints" else "qvel", found))
    for field in ("qpos", "qvel"):
        ids = np.concatenate([[], *(part.ids for part in parts if part.field == field)])
        if len(set(ids)) < len(ids):
            raise ModelError("[initial] gives a joint two positions or two velocities; one is enough")
    keyframe = _keyframe(model, table.get("keyframe", ""))
    control = model.key_ctrl[keyframe].copy() if keyframe >= 0 else np.zeros(model.nu)
    return InitialState(keyframe, tuple(parts), control)


def _keyframe(model: mujoco.MjModel, name: object) -> int:
    if name == "":
        return -1
    if not count(model, _KEYFRAME):
        raise ModelError(f"[initial] keyframe is {name!r}; the model has no keyframes")
    return element(model, _KEYFRAME, name)


def _positions(model: mujoco.MjModel, names: list[str]) -> Ints:
    """Entries of qpos of joints; of a free one position and quaternion (w first), of a ball its quaternion."""
    ids = [element(model, _JOINT, name) for name in names]
    return np.concatenate([model.jnt_qposadr[i] + np.arange(joint_width(model, i)[0]) for i in ids])


def _velocities(model: mujoco.MjModel, names: list[str]) -> Ints:
    """Entries of qvel of joints; of a free one the velocity in the world and the rate of turn in the body's frame."""
    ids = [element(model, _JOINT, name) for name in names]
    return np.concatenate([model.jnt_dofadr[i] + np.arange(joint_width(model, i)[1]) for i in ids])


def unused_keyframes(model: mujoco.MjModel, table: dict[str, Any], initial: InitialState) -> str | None:
    """What to say where a model has keyframes that the mapping does not mention, and that are elsewhere."""
    known = np.concatenate([[], *(part.ids for part in initial.parts if part.field == "qpos")]).astype(int)
    others = np.setdiff1d(np.arange(model.nq), known)
    elsewhere = [
        i
        for i in range(model.nkey)
        if not np.allclose(model.key_qpos[i, others], model.qpos0[others]) or model.key_ctrl[i].any()
    ]
    if "keyframe" in table or not elsewhere:
        return None
    names = ", ".join(name_of(model, _KEYFRAME, i) for i in elsewhere)
    return (
        f"the model has keyframes ({names}) and the robot begins in its default position; "
        f'[initial] keyframe = "{name_of(model, _KEYFRAME, elsewhere[0])}" begins there, "" keeps the default'
    )
