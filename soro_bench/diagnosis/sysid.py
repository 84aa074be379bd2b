"""A bridge for users of mujoco.sysid: its sequences are diagnosed, and a result gives its parameters back.

mujoco.sysid fits parameters of a model to measured sequences. What no parameter explains stays in the residual: a
diagnosis says which law it is, and where.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.robots.model_file import ModelError
from soro_bench.diagnosis.robots.sysid_robot import COMMAND, SIGNAL, STATE, SysidRobot, free, names_of
from soro_bench.diagnosis.selection.forward_selection import StageProgress, silent
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.recording.recording import Recording, RecordingError, Signal

if TYPE_CHECKING:
    from mujoco.sysid import ModelSequences, ParameterDict, TimeSeries

_SENSOR = mujoco.mjtSensor
_UNITS = {  # of sensors; those of joints depend on the joint
    _SENSOR.mjSENS_FRAMEPOS: "m", _SENSOR.mjSENS_SUBTREECOM: "m", _SENSOR.mjSENS_TENDONPOS: "m",
    _SENSOR.mjSENS_RANGEFINDER: "m", _SENSOR.mjSENS_FRAMEQUAT: "1", _SENSOR.mjSENS_BALLQUAT: "1",
    _SENSOR.mjSENS_FRAMELINVEL: "m/s", _SENSOR.mjSENS_VELOCIMETER: "m/s", _SENSOR.mjSENS_TENDONVEL: "m/s",
    _SENSOR.mjSENS_FRAMEANGVEL: "rad/s", _SENSOR.mjSENS_GYRO: "rad/s", _SENSOR.mjSENS_BALLANGVEL: "rad/s",
    _SENSOR.mjSENS_ACCELEROMETER: "m/s^2", _SENSOR.mjSENS_FRAMELINACC: "m/s^2", _SENSOR.mjSENS_FRAMEANGACC: "rad/s^2",
    _SENSOR.mjSENS_FORCE: "N", _SENSOR.mjSENS_TOUCH: "N", _SENSOR.mjSENS_TORQUE: "N m",
}  # fmt: skip
_OF_JOINTS = {  # turning, sliding
    _SENSOR.mjSENS_JOINTPOS: ("rad", "m"),
    _SENSOR.mjSENS_JOINTVEL: ("rad/s", "m/s"),
    _SENSOR.mjSENS_JOINTACTFRC: ("N m", "N"),
}
_EXPLAINED = ("rad", "m")  # units of the sensors that are taken if none are named: positions, which forces add up in


def diagnose_sequences(
    parameters: "ParameterDict",
    sequences: "ModelSequences | Sequence[ModelSequences]",
    heldout: "Sequence[ModelSequences]" = (),
    sensors: Sequence[str] = (),
    control_timestep: float | None = None,
    units: Mapping[str, str] | None = None,
    threads: int = 0,
    seed: int = 0,
    progress: StageProgress = silent,
    settings: Settings = DEFAULT,
) -> Result:
    """Say which physics a model lacks, from the parameters and sequences that mujoco.sysid fits it to.

    Args:
        parameters: with modifiers; those that are not frozen are fitted.
        sequences: of one model. Control, sensors and initial state are as ``mujoco.sysid.residual`` takes them.
        heldout: sequences of another motion, to test the explanation on.
        sensors: names of those to explain, of one unit; by default all of joint angles, or else of positions.
        control_timestep: s, for which a control is held; by default the interval of the measured controls.
        units: of the parameters, by name; "1" for others.
        threads: 0 for all processors; results do not depend on it.
        seed, progress, settings: as of :func:`soro_bench.diagnosis.api.diagnose`.

    Raises:
        ModelError: says what is wrong with the model or a parameter.
        RecordingError: says what is wrong with a sequence.
    """
    given = list(sequences) if isinstance(sequences, Sequence) else [sequences]
    robot = sysid_robot(parameters, [*given, *heldout], sensors, control_timestep, units, threads)
    recorded, tested = ([each for one in some for each in recordings(robot, one)] for some in (given, heldout))
    return diagnose(robot, recorded, tested, seed, progress, settings)


def sysid_robot(
    parameters: "ParameterDict",
    sequences: "Sequence[ModelSequences]",
    sensors: Sequence[str] = (),
    control_timestep: float | None = None,
    units: Mapping[str, str] | None = None,
    threads: int = 0,
) -> SysidRobot:
    """The robot of :func:`diagnose_sequences`, to whose arguments these are equal."""
    if not sequences:
        raise RecordingError("no sequence to explain; give one ModelSequences or more")
    first = sequences[0]
    if any(each.spec is not first.spec and each.spec.to_xml() != first.spec.to_xml() for each in sequences):
        raise ModelError("the sequences are of several models; diagnose those of one at a time")
    model = first.spec.copy().compile()
    chosen, unit = _chosen(model, first, sensors)
    if control_timestep is None:
        control_timestep = max(_interval(first.control[0].times), model.opt.timestep)
    steps = max(round(control_timestep / model.opt.timestep), 1)
    return SysidRobot(first.spec, parameters, chosen, unit, steps * model.opt.timestep, units, threads=threads)


def recordings(robot: SysidRobot, sequences: "ModelSequences") -> list[Recording]:
    """The sequences as recordings of a robot: what it is told, the sensors that it explains, and where it begins.

    Controls are interpolated at the model's time steps, as mujoco.sysid does, and averaged over a control step.
    """
    found = []
    for name, start, control, sensors in zip(
        sequences.sequence_name, sequences.initial_state, sequences.control, sequences.sensordata, strict=True
    ):
        try:
            found.append(_recording(robot, np.asarray(start, float), control, sensors))
        except ValueError as error:
            raise RecordingError(f"the sequence {name!r}: {error}") from error
    return found


def parameter_dict(result: Result, parameters: "ParameterDict") -> "ParameterDict":
    """Parameters with the values that a diagnosis has fitted beside the laws that it found.

    The laws are no parameters: ``result.patch.model`` is MJCF that has them, and ``result.patch.effects`` names them.

    Args:
        result: of :func:`diagnose_sequences`.
        parameters: those that were diagnosed, which stay as they are; the copy has their bounds and modifiers.

    Raises:
        ValueError: the result is of other parameters.
    """
    found, copied = {each.estimate.name: each.estimate.value for each in result.parameters}, parameters.copy()
    names = {name for each in free(copied) for name in names_of(each)}
    if names != found.keys():
        raise ValueError(f"the result has {', '.join(found) or 'no parameters'}; the parameters are {', '.join(names)}")
    for each in free(copied):
        each.update_from_vector(np.array([found[name] for name in names_of(each)]))
    return copied


def _recording(robot: SysidRobot, start: Floats, control: "TimeSeries", sensors: "TimeSeries") -> Recording:
    model, step = robot.simulation.model, robot.control_timestep
    begin = float(sensors.times[0] if not model.nu else control.times[0])
    commands = {}
    if model.nu:
        fine = control.resample(target_dt=step / robot.substeps)
        count = len(fine.times) // robot.substeps
        values = fine.data[: count * robot.substeps].reshape(count, robot.substeps, -1).mean(axis=1)
        commands[COMMAND] = Signal(begin + step * np.arange(count), values)
    columns = np.concatenate([_columns(model, sensors, name) for name in robot.sensors])
    signals = {SIGNAL: Signal(np.asarray(sensors.times, float), sensors.data[:, columns].astype(float), robot.unit)}
    # as in mjSTATE_FULLPHYSICS: time, positions, velocities, activations, and what else a model has
    sizes = {"qpos": model.nq, "qvel": model.nv, "act": model.na}
    done = 1
    for field, size in sizes.items():
        if size:
            signals[STATE[field]] = Signal(np.array([begin]), start[None, done : done + size])
        done += size
    return Recording(commands, signals)


def _interval(times: Floats) -> float:
    if len(times) < 2:
        raise RecordingError("a sequence has one control only; two or more are needed")
    return float(np.median(np.diff(times)))


def _columns(model: mujoco.MjModel, measured: "TimeSeries", name: str) -> Floats:
    """Columns of measured data that a sensor has."""
    if measured.signal_mapping is not None:
        if name not in measured.signal_mapping:
            raise ValueError(f"no sensor {name!r}; it has {', '.join(measured.signal_mapping)}")
        return np.asarray(measured.signal_mapping[name][1])
    sensor = model.sensor(name)
    return np.asarray(sensor.adr[0] + np.arange(sensor.dim[0]))


def _chosen(model: mujoco.MjModel, sequences: "ModelSequences", names: Sequence[str]) -> tuple[list[str], str]:
    """The sensors to explain, and their unit; data without a mapping of names have all sensors of the model."""
    measured = sequences.sensordata[0].signal_mapping
    named = [(model.sensor(i).name, _unit(model, i)) for i in range(model.nsensor)]
    units = {name: unit for name, unit in named if unit and (not measured or name in measured)}
    if names:
        if unknown := [name for name in names if name not in units]:
            raise ModelError(f"no measured sensor {unknown[0]!r} with a known unit; there are {', '.join(units)}")
        if len(found := {units[name] for name in names}) > 1:
            raise ModelError(f"sensors of units {', '.join(sorted(found))}; name those of one unit")
        return list(names), found.pop()
    if not units:
        raise ModelError(
            "the sequences measure no sensor whose unit is known; states such as hinge_qpos are not read: give the "
            "model jointpos sensors, and their names to the data"
        )
    for unit in _EXPLAINED:
        if chosen := [name for name, of in units.items() if of == unit]:
            widths = [int(model.sensor(name).dim[0]) for name in chosen]
            return [name for name, width in zip(chosen, widths, strict=True) if width == max(widths)], unit
    raise ModelError(f"no measured sensor of angles or positions; name sensors of one unit: {', '.join(units)}")


def _unit(model: mujoco.MjModel, sensor: int) -> str | None:
    """The unit of a sensor; None for one whose unit is not known."""
    kind = mujoco.mjtSensor(model.sensor_type[sensor])
    if kind in _OF_JOINTS:
        turning, sliding = _OF_JOINTS[kind]
        return sliding if model.jnt_type[model.sensor_objid[sensor]] == mujoco.mjtJoint.mjJNT_SLIDE else turning
    return _UNITS.get(kind)
