"""Arms with a law that no catalogue has, simulated by MuJoCo alone: nothing here imports the package's laws.

Each family says what its law reads, its force as a function of that, and where it acts. A case draws the joint, the
signs and the size, so that the law moves the arm by some twenty to a hundred times the noise of its sensors.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

JOINTS = ("yaw", "shoulder", "elbow")
BODIES = ("turret", "upper", "lower")
MOTORS = ("m0", "m1", "m2")
NOISE = 5e-4  # rad
STEP, SUBSTEPS, SECONDS = 0.02, 4, 5.0
MODEL = """<mujoco model="arm"><option timestep="0.01" integrator="implicitfast"/>
<default><geom type="capsule" size="0.012" contype="0" conaffinity="0"/></default>
<worldbody><body name="turret" pos="0 0 0.3"><joint name="yaw" axis="0 0 1" damping="0.03"/>
<geom fromto="0 0 0 0 0 0.05" mass="0.15"/>
<body name="upper" pos="0 0 0.05"><joint name="shoulder" axis="0 1 0" damping="0.03"/>
<geom fromto="0 0 0 0.2 0 0" mass="0.12"/>
<body name="lower" pos="0.2 0 0"><joint name="elbow" axis="0 1 0" damping="0.02"/>
<geom fromto="0 0 0 0.15 0 0" mass="0.08"/><site name="tip" pos="0.15 0 0"/></body></body></body></worldbody>
<actuator><position name="m0" joint="yaw" kp="1.5" kv="0.06"/><position name="m1" joint="shoulder" kp="2.5" kv="0.08"/>
<position name="m2" joint="elbow" kp="1.2" kv="0.04"/></actuator></mujoco>"""
MAP = """[robot]
control_timestep = 0.02
[commands.goal]
actuators = ["m0", "m1", "m2"]
[signal]
name = "angles"
joints = ["yaw", "shoulder", "elbow"]
unit = "rad"
[parameters.mass]
fields = ["body_mass:turret", "body_inertia:turret", "body_mass:upper", "body_inertia:upper", "body_mass:lower",
 "body_inertia:lower"]
deviation = 0.2
[parameters.damping]
fields = ["dof_damping:yaw", "dof_damping:shoulder", "dof_damping:elbow"]
deviation = 0.3
"""

Values = dict[str, Any]  # by "kind element", such as "position elbow"; "chance " is drawn anew at every substep


@dataclass(frozen=True)
class HiddenLaw:
    """A law of a case.

    family: its kind. where: the body that it acts on. reads: keys of ``Values`` of what it depends on. force: of them
    [N m, N, m/s^2]; ``settled`` is it at rest, if it remembers. kind: "torque" of that body's joint, "pull" towards
    ``point``, or "shake" of the base along x. of_state: whether it comes again with the same state or time.
    """

    family: str
    where: str
    reads: tuple[str, ...]
    force: Callable[[Values], Any]
    kind: str = "torque"
    point: tuple[float, ...] = ()
    of_state: bool = True
    settled: Callable[[Values], Any] | None = None

    def at_rest(self, values: Values) -> float:
        """Its force where what it remembers has followed."""
        return float((self.settled or self.force)(values))


def _drawn(rng: np.random.Generator) -> tuple[int, int, float]:
    i = int(rng.integers(3))
    j = int(rng.choice([k for k in range(3) if k != i]))
    return i, j, float(rng.choice([-1.0, 1.0]))


def coupled_bends(rng: np.random.Generator) -> HiddenLaw:
    """The bend of another joint turns one."""
    i, j, sign = _drawn(rng)
    k = sign * rng.uniform(0.2, 0.5)
    read = f"position {JOINTS[j]}"
    return HiddenLaw("coupled_bends", BODIES[i], (read,), lambda v: k * v[read])


def cross_talk(rng: np.random.Generator) -> HiddenLaw:
    """Another motor's command turns a joint."""
    i, j, sign = _drawn(rng)
    k = sign * rng.uniform(0.15, 0.4)
    read = f"command {MOTORS[j]}"
    return HiddenLaw("cross_talk", BODIES[i], (read,), lambda v: k * v[read])


def world_spring(rng: np.random.Generator) -> HiddenLaw:
    """A spring from the forearm to a point of the world."""
    k, rest = rng.uniform(6.0, 15.0), rng.uniform(0.0, 0.05)
    point = tuple(rng.uniform((0.15, -0.2, 0.15), (0.35, 0.2, 0.3)).tolist())
    return HiddenLaw("world_spring", "lower", ("distance lower",), lambda v: k * (v["distance lower"] - rest), "pull",
                     point)  # fmt: skip


def magnet(rng: np.random.Generator) -> HiddenLaw:
    """A magnet near the forearm."""
    c = rng.uniform(0.02, 0.05)
    point = tuple(rng.uniform((0.2, -0.15, 0.05), (0.35, 0.15, 0.15)).tolist())
    return HiddenLaw("magnet", "lower", ("distance lower",),
                     lambda v: c / np.maximum(v["distance lower"], 0.03) ** 2, "pull", point)  # fmt: skip


def position_friction(rng: np.random.Generator) -> HiddenLaw:
    """Friction that grows with the square of the angle."""
    i, _, _ = _drawn(rng)
    c = rng.uniform(0.3, 0.8)
    q, w = f"position {JOINTS[i]}", f"velocity {JOINTS[i]}"
    return HiddenLaw("position_friction", BODIES[i], (q, w), lambda v: -c * v[q] ** 2 * np.tanh(v[w] / 0.03))


def asymmetric_stiffness(rng: np.random.Generator) -> HiddenLaw:
    """A spring that resists one way only."""
    i, _, sign = _drawn(rng)
    k = rng.uniform(0.6, 1.5)
    q = f"position {JOINTS[i]}"
    return HiddenLaw("asymmetric_stiffness", BODIES[i], (q,), lambda v: -k * sign * np.maximum(sign * v[q], 0.0))


def periodic_base(rng: np.random.Generator) -> HiddenLaw:
    """The base shakes."""
    a, w, phase = rng.uniform(2.0, 4.0), 2 * np.pi * rng.uniform(0.8, 2.0), rng.uniform(0, 6)
    return HiddenLaw("periodic_base", "gravity", ("time ",), lambda v: a * np.sin(w * v["time "] + phase), "shake")


def warming_motor(rng: np.random.Generator) -> HiddenLaw:
    """A motor loses force with time."""
    i, _, _ = _drawn(rng)
    g = rng.uniform(0.04, 0.08)
    f, t = f"force {MOTORS[i]}", "time "
    return HiddenLaw("warming_motor", BODIES[i], (f, t), lambda v: -g * v[t] * v[f])


def one_sided_damping(rng: np.random.Generator) -> HiddenLaw:
    """Damping of one way of turning."""
    i, _, sign = _drawn(rng)
    c = rng.uniform(0.06, 0.15)
    w = f"velocity {JOINTS[i]}"
    return HiddenLaw("one_sided_damping", BODIES[i], (w,), lambda v: -c * sign * np.maximum(sign * v[w], 0.0))


def command_stiffness(rng: np.random.Generator) -> HiddenLaw:
    """A joint that another motor's command stiffens."""
    i, j, sign = _drawn(rng)
    k = sign * rng.uniform(0.6, 1.4)
    q, u = f"position {JOINTS[i]}", f"command {MOTORS[j]}"
    return HiddenLaw("command_stiffness", BODIES[i], (q, u), lambda v: -k * v[q] * v[u])


def delayed_coupling(rng: np.random.Generator) -> HiddenLaw:
    """The bend of another joint turns one, late."""
    i, j, sign = _drawn(rng)
    k, time = sign * rng.uniform(0.25, 0.5), rng.uniform(0.15, 0.4)
    q = f"position {JOINTS[j]}"
    lagged = list[float]()

    def force(v: Values) -> float:
        """First-order lag, stepped with the simulation."""
        if not lagged:
            lagged.append(float(v[q]))
        lagged[0] += (float(v[q]) - lagged[0]) * STEP / SUBSTEPS / time
        return k * lagged[0]

    return HiddenLaw("delayed_coupling", BODIES[i], (q,), force, settled=lambda v: k * v[q])


def quadratic_spring(rng: np.random.Generator) -> HiddenLaw:
    """A torque by the square of the angle."""
    i, _, sign = _drawn(rng)
    k = sign * rng.uniform(0.3, 0.6)
    q = f"position {JOINTS[i]}"
    return HiddenLaw("quadratic_spring", BODIES[i], (q,), lambda v: k * v[q] ** 2)


def coupled_damping(rng: np.random.Generator) -> HiddenLaw:
    """The speed of another joint turns one."""
    i, j, sign = _drawn(rng)
    c = sign * rng.uniform(0.05, 0.1)
    w = f"velocity {JOINTS[j]}"
    return HiddenLaw("coupled_damping", BODIES[i], (w,), lambda v: c * v[w])


def cogging(rng: np.random.Generator) -> HiddenLaw:
    """A torque that repeats with the angle."""
    i, _, sign = _drawn(rng)
    a, n = sign * rng.uniform(0.08, 0.15), float(rng.integers(6, 13))
    q = f"position {JOINTS[i]}"
    return HiddenLaw("cogging", BODIES[i], (q,), lambda v: a * np.sin(n * v[q]))


def gusts(rng: np.random.Generator) -> HiddenLaw:
    """What no law can carry over: a torque that never comes again, as each recording has chances of its own."""
    i, _, _ = _drawn(rng)
    state = [0.0]

    def force(v: Values) -> float:
        """An Ornstein-Uhlenbeck process that forgets in half a second."""
        state[0] += -state[0] * 0.01 + 0.02 * float(v["chance "])
        return state[0]

    return HiddenLaw("gusts", BODIES[i], (), force, of_state=False, settled=lambda v: 0.0)


FAMILIES = (
    coupled_bends, cross_talk, world_spring, magnet, position_friction, asymmetric_stiffness, periodic_base,
    warming_motor, one_sided_damping, command_stiffness, delayed_coupling, quadratic_spring, coupled_damping, cogging,
    gusts,
)  # fmt: skip


def goals(rng: np.random.Generator) -> np.ndarray:
    """(T, 3) rad, held and ramped in turn."""
    count, found, last = round(SECONDS / STEP), list[np.ndarray](), np.zeros(3)
    while len(found) < count:
        goal, hold, ramp = rng.uniform(-0.8, 0.8, 3), int(rng.integers(8, 25)), int(rng.integers(1, 20))
        found += [last + (goal - last) * k / ramp for k in range(1, ramp + 1)] + [goal] * hold
        last = goal
    return np.array(found[:count])


def simulated(law: HiddenLaw, actions: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(1 + T, 3) noisy angles [rad] of an arm with other parameters and the law."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.opt.timestep = STEP / SUBSTEPS
    model.body_mass[1:] *= 1.12
    model.body_inertia[1:] *= 1.12
    model.dof_damping[:] *= 0.85
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rows, (chance,) = [data.qpos.copy()], rng.spawn(1)  # leaves what rng draws as it is
    body = None if law.kind == "shake" else model.body(law.where).id
    for action in actions:
        data.ctrl[:] = action
        for _ in range(SUBSTEPS):
            data.qfrc_applied[:], data.xfrc_applied[:] = 0.0, 0.0
            force = float(law.force({**_values(model, data, law), "chance ": chance.standard_normal()}))
            if law.kind == "torque":
                data.qfrc_applied[model.body_dofadr[body]] = force
            elif law.kind == "pull":
                way = np.array(law.point) - data.xipos[body]
                data.xfrc_applied[body, :3] = force * way / np.linalg.norm(way)
            else:
                data.xfrc_applied[1:, 0] = force * model.body_mass[1:]
            mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
    return np.array(rows) + NOISE * rng.standard_normal((len(rows), 3))


def _values(model: mujoco.MjModel, data: mujoco.MjData, law: HiddenLaw) -> Values:
    found = {"time ": data.time}
    for i in range(3):
        found[f"position {JOINTS[i]}"], found[f"velocity {JOINTS[i]}"] = data.qpos[i], data.qvel[i]
        found[f"command {MOTORS[i]}"], found[f"force {MOTORS[i]}"] = data.ctrl[i], data.actuator_force[i]
    if law.point:
        found["distance lower"] = np.linalg.norm(np.array(law.point) - data.xipos[model.body("lower").id])
    return found
