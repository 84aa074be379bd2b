"""The real robot of a hidden case: a trunk in a plain MuJoCo loop, into which laws of hidden physics reach.

No law is shared with what diagnoses; the builder of the trunk is. The robot is stepped by ``mj_step1`` and
``mj_step2``, which together are ``mj_step``; between them each law sees the present positions and adds forces, changes
the commanded displacements or writes model fields.
"""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np

from soro_bench.envs.trunk import SUCCESS_DISTANCE
from soro_bench.envs.trunk_reach import EVALUATION_GOALS
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo

CONTROL_TIMESTEP = 0.05  # s
_FIRST_LAW = 10  # tag of the first law's random numbers; seeds that differ by trailing zeros only are the same
_REACH = 0.5  # m, no keypoint of a sound simulation gets so far from the clamp


class Diverged(ValueError):
    """A simulation left what a trunk can do."""


@dataclass(frozen=True)
class Engine:
    """A model of the trunk and the options of MuJoCo that differ from the suite's.

    Args:
        model: "flex" or "cable".
        timestep: s.
        options: fields of MuJoCo's option, with their values.
    """

    model: str
    timestep: float
    options: tuple[tuple[str, float], ...] = ()


# the accurate model as it is, and the cheap one at an eighth of its step, half of the shortest that the diagnosis
# simulates
KINDS = {"flex": Engine("flex", 0.005), "fine": Engine("cable", 0.00125)}


class Law:
    """Hidden physics. A law changes nothing where its magnitude is zero."""

    def install(self, robot: "Robot") -> None:
        """Write model fields, once, before the derived constants are computed."""

    def begin(self, robot: "Robot", rng: np.random.Generator) -> None:
        """Reset the law's own state at the start of a recording."""

    def command(self, robot: "Robot", pull: np.ndarray) -> np.ndarray:
        """(8,) displacements [m] that reach the cables' servos instead of ``pull``, at the end of this step."""
        return pull

    def push(self, robot: "Robot") -> None:
        """Add forces at the present positions."""


@dataclass(frozen=True)
class Trace:
    """What a run of T control steps of n engine steps each gave, without noise."""

    timestep: float  # s, of the engine
    points: np.ndarray  # (T n + 1, 21, 3) m, keypoints
    vertebrae: np.ndarray  # (T + 1, 10, 3) m, centres of mass
    bend: np.ndarray  # (T + 1, 10) rad, how much each neck is bent
    tension: np.ndarray  # (T + 1, 8) N, of the step before

    def at(self, times: np.ndarray) -> np.ndarray:
        """(len(times), 21, 3) keypoints [m] at times [s], those of the start before and of the end after the run."""
        place = np.clip(times / self.timestep, 0, len(self.points) - 1)
        left = np.floor(place + 1e-6).astype(int)
        weight = np.maximum(place - left, 0.0)[:, None, None]
        right = np.minimum(left + 1, len(self.points) - 1)
        return (1 - weight) * self.points[left] + weight * self.points[right]


def simulate(
    kind: str | Engine,
    parameters: Mapping[str, float],
    laws: Sequence[Law],
    actions: np.ndarray,
    seed: Sequence[int] = (0,),
) -> Trace:
    """What a new robot does with (T, 8) actions from its reset state; ``seed`` is of what its laws draw.

    Raises:
        Diverged: the simulation is not sound.
    """
    return Robot(kind, parameters, laws).run(actions, seed)


class Robot:
    """A trunk with parameters and laws, for one run.

    Args:
        kind: of KINDS, or another engine.
        parameters: of the trunk, by name.
        laws: in the order in which they act on the commands.
    """

    def __init__(self, kind: str | Engine, parameters: Mapping[str, float], laws: Sequence[Law] = ()) -> None:
        self.model = model = copy.copy(_compiled(_engine(kind)))
        self.data = mujoco.MjData(model)
        self.laws = tuple(laws)
        self.duration = 0.0  # s, of the present run
        self.cables = np.array([model.actuator(name).id for name in geo.CABLE_NAMES])
        self.links = np.array([model.body("base").id, *(model.body(f"vertebra{k}").id for k in range(geo.NUM_NECKS))])
        self._keypoints = np.array([model.site(f"keypoint{i}").id for i in range(len(geo.KEYPOINT_Z))])
        values = {name: np.array([value]) for name, value in parameters.items()}
        for write in trunk.TrunkParameters(model).writes(values):
            getattr(model, write.field)[write.rows] = write.values[0]
        self.neck_stiffness = geo.neck_stiffness(values["young_modulus"], values["poisson_ratio"])["bend"][0]  # N m/rad
        self._neck_fields = [(getattr(model, name), rows, necks) for name, rows, necks in _neck_fields(model)]
        self._neck_values = [field[rows].copy() for field, rows, _ in self._neck_fields]
        self.neck_factors = np.ones(geo.NUM_NECKS)  # how much stiffer each neck is for good
        model.actuator_actlimited[:] = 0  # the motor's limits hold before the laws, in ``run``
        for law in self.laws:
            law.install(self)
        mujoco.mj_setConst(model, self.data)
        self._installed = [(field, field.copy()) for field in (
            model.opt.gravity, model.actuator_gainprm, model.actuator_biasprm, model.actuator_forcerange
        )]  # fmt: skip

    @property
    def timestep(self) -> float:
        """Of the engine [s]."""
        return self.model.opt.timestep

    def run(self, actions: np.ndarray, seed: Sequence[int] = (0,)) -> Trace:
        """Simulate (T, 8) actions from the reset state; see ``simulate``."""
        self.begin(len(actions), seed)
        pieces, rows = [], []
        for action in actions:
            rows.append(self._row())
            pieces.append(self.advance(action))
        points = np.concatenate([*pieces, self.keypoints()[None]])
        rows.append(self._row())
        self.check(points)
        return Trace(self.timestep, points, *map(np.array, zip(*rows, strict=True)))

    def begin(self, steps: int, seed: Sequence[int] = (0,)) -> None:
        """The reset state, for a run of so many control steps at most."""
        self.duration = steps * CONTROL_TIMESTEP
        mujoco.mj_resetData(self.model, self.data)
        for field, value in self._installed:  # laws have moved them in the run before
            field[:] = value
        self.scale_necks()
        mujoco.mj_step1(self.model, self.data)
        self._pull = np.zeros(len(self.cables))
        for i, law in enumerate(self.laws):
            law.begin(self, np.random.default_rng([*seed, _FIRST_LAW + i]))

    def advance(self, action: np.ndarray) -> np.ndarray:
        """Apply (8,) an action for a control step; (n, 21, 3) m, keypoints before each of its engine steps."""
        points = []
        for _ in range(round(CONTROL_TIMESTEP / self.timestep)):
            points.append(self.keypoints())
            way = self._pull + geo.CABLE_RATE * action * self.timestep
            self._pull = np.clip(way, -geo.CABLE_LIMITS, geo.CABLE_LIMITS)
            self._step(self._pull)
        return np.array(points)

    def keypoints(self) -> np.ndarray:
        """(21, 3) m, now."""
        return self.data.site_xpos[self._keypoints].copy()

    def check(self, points: np.ndarray) -> None:
        """Raise Diverged unless a run that went through points (..., 3) was sound."""
        if any(warning.number for warning in self.data.warning) or not np.abs(points).max() < _REACH:
            raise Diverged("the simulation diverged")

    def bend(self) -> np.ndarray:
        """(10, 3) rotation vector [rad] across each neck without its twist, in the frame of the link before it."""
        near, far = self.data.xquat[self.links[:-1]], self.data.xquat[self.links[1:]]
        w = (near * far).sum(axis=1)
        n, f = near[:, 1:], far[:, 1:]
        vector = near[:, :1] * f - far[:, :1] * n - _cross(n, f)
        sine = np.sqrt((vector * vector).sum(axis=1))
        bend = vector * (2 * np.sign(w) * np.arctan2(sine, np.abs(w)) / np.maximum(sine, 1e-12))[:, None]
        bend[:, 2] = 0.0
        return bend

    def push_necks(self, moments: np.ndarray) -> None:
        """Act on the vertebrae with (10, 3) moments [N m] in the frames of ``bend``; the links before react."""
        world = (self.data.xmat[self.links[:-1]].reshape(-1, 3, 3) @ moments[:, :, None])[:, :, 0]
        self.data.xfrc_applied[self.links[1:], 3:] += world
        self.data.xfrc_applied[self.links[:-1], 3:] -= world

    def push_cable(self, cable: int, force: float) -> None:
        """Pull a cable with a further force [N]."""
        data, row = self.data, self.cables[cable]
        start = data.moment_rowadr[row]
        entries = slice(start, start + data.moment_rownnz[row])
        data.qfrc_applied[data.moment_colind[entries]] += force * data.actuator_moment[entries]

    def scale_necks(self, factor: float = 1.0) -> None:
        """Write the necks' stiffness and damping: those of the parameters times ``neck_factors`` times ``factor``."""
        factors = factor * self.neck_factors
        for (field, rows, necks), values in zip(self._neck_fields, self._neck_values, strict=True):
            field[rows] = factors[necks] * values

    def _step(self, pull: np.ndarray) -> None:
        """One engine step, and then the positions after it."""
        model, data = self.model, self.data
        data.xfrc_applied[:] = 0
        data.qfrc_applied[:] = 0
        for law in self.laws:
            pull = law.command(self, pull)
            law.push(self)
        data.act[self.cables] = pull
        mujoco.mj_step2(model, data)
        mujoco.mj_step1(model, data)

    def _row(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        data = self.data
        bend = np.linalg.norm(self.bend(), axis=1)
        return data.xipos[self.links[1:]].copy(), bend, data.actuator_force[self.cables].copy()


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of rows; NumPy's takes five times as long for few of them."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def _engine(kind: str | Engine) -> Engine:
    if isinstance(kind, str) and kind not in KINDS:
        raise ValueError(f"unknown robot {kind!r}; there are {', '.join(KINDS)}")
    return KINDS[kind] if isinstance(kind, str) else kind


@lru_cache(maxsize=2)
def _compiled(engine: Engine) -> mujoco.MjModel:
    spec = trunk.build_spec("trunk.xml", engine.model)
    spec.option.timestep = engine.timestep
    for name, value in engine.options:
        setattr(spec.option, name, value)
    return spec.compile()


def _neck_fields(model: mujoco.MjModel) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Field, rows and the neck of each row, of all that is proportional to the necks' stiffness."""
    necks = np.arange(geo.NUM_NECKS)
    if model.nflex:
        cells = np.array([mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, f"neck{k}") for k in necks])
        size = 24 * 24
        rows = (model.flex_stiffnessadr[cells][:, None] + np.arange(size)).ravel()
        yield "flex_stiffness", rows, np.repeat(necks, size)  # damping is a time in seconds, in proportion to it
        return
    for kind in ("axial", "bend_x", "bend_y"):
        joints = np.array([model.joint(f"{kind}{k}").id for k in necks])
        yield "jnt_stiffness", joints, necks
        yield "dof_damping", model.jnt_dofadr[joints], necks


# --- a policy on the robot: TrunkReach in closed loop ---

STEPS = 100  # of an episode, as registered


def final_distances(act: Callable[[np.ndarray], np.ndarray], robot: Robot) -> np.ndarray:
    """(27,) m, from the tip to each of the fixed goals when the episode ends: at 1 mm, or after 100 steps. An episode
    in which the simulation diverges counts as one without motion.

    Args:
        act: observations (1, 66) as TrunkReach gives them to actions (1, 8).
    """
    return np.array([_final_distance(act, robot, goal) for goal in EVALUATION_GOALS])


def _final_distance(act: Callable[[np.ndarray], np.ndarray], robot: Robot, goal: np.ndarray) -> float:
    robot.begin(STEPS)
    start = distance = _distance(robot, goal)
    for _ in range(STEPS):
        if distance <= SUCCESS_DISTANCE:
            break
        robot.advance(act(np.append(robot.keypoints().ravel(), goal)[None])[0])
        distance = _distance(robot, goal)
    try:
        robot.check(robot.keypoints())
    except Diverged:
        return start
    return distance


def _distance(robot: Robot, goal: np.ndarray) -> float:
    return float(np.linalg.norm(robot.keypoints()[-1] - goal))
