"""N simulations of one model in MuJoCo Warp: on a GPU, or slowly on the CPU (needs the ``gpu`` extra).

A :class:`WarpSimulation` stands where a task has a :class:`~soro_bench.models.simulation.Simulation`. Its state is
PyTorch tensors on the device, which share their memory with Warp's arrays, so tasks compute there. Parameters and
effects become model fields on the CPU, by the same code and in the same precision as everywhere else.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS

from soro_bench.arrays import Floats, Ints
from soro_bench.effects.effect import Effect
from soro_bench.files import replacing
from soro_bench.models.simulation import ParameterMap, Simulation, quiet
from soro_bench.parameters import ParameterSet

try:
    import mujoco_warp as mjw
    import torch
    import warp as wp
    from array_api_compat import torch as torch_namespace
except ImportError as error:
    raise ImportError(f"simulations on a GPU need the gpu extra: pip install 'soro_bench[gpu]' ({error})") from error

_ROWS = 256  # whose model fields are computed on the CPU at once
_STATE = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat", "plastic")  # that a world goes on from
# What is too small for a world: contacts and constraints are then left out. Solvers that reach their last iteration are
# no such case.
_OVERFLOWS = (
    mjw.OverflowType.NEFC
    | mjw.OverflowType.NJMAX_NNZ
    | mjw.OverflowType.BROADPHASE
    | mjw.OverflowType.NARROWPHASE
    | mjw.OverflowType.CCD
)
# What MuJoCo derives from model fields that parameters and effects write (mj_setConst)
_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "tendon_invweight0", "actuator_acc0")
_UNREAD = ("dof_M0",)  # by simulations: MuJoCo derives other fields from it
_ROOM = ("nconmax", "njmax")


class WorldError(ValueError):
    """A world cannot go on; says which one, and at which control step."""


class WarpBatch:
    """The arrays of N worlds by MuJoCo's names, as ``mujoco.batch.Batch`` has them: tensors of N rows on the device.

    Args:
        model: with nominal parameters.
        nsim: number of worlds N.
        fields: model fields that each world has its own values of.
        device: of Warp and PyTorch, such as "cuda:0" or "cpu".
        deterministic: whether results are the same from run to run on one kind of GPU.
        room: see :class:`WarpSimulation`; MuJoCo Warp's defaults where it is empty.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        nsim: int,
        fields: Sequence[str],
        device: str,
        deterministic: bool,
        room: dict[str, int],
    ):
        self.model, self.nsim, self.device = model, nsim, device
        self.model_of: Callable[..., mujoco.MjModel] = lambda row, into: model
        with wp.ScopedDevice(device):
            # before a graph is captured, which goes on reading the arrays that there are now
            sizes = dict.fromkeys(fields, nsim)
            self.warp_model = mjw.put_model(model, batch_sizes=sizes)
            if self.warp_model.has_non_simple_flex or not self.warp_model.flex_interp_assemblable:
                model.opt.solver = mujoco.mjtSolver.mjSOL_CG  # Newton's is refused where flex nodes turn with bodies
                self.warp_model = mjw.put_model(model, batch_sizes=sizes)
            self.warp_data = mjw.make_data(model, nworld=nsim, **room)
        self.warp_model.opt.warn_overflow = 0  # raised instead
        if deterministic:
            self.warp_model.opt.deterministic = mjw.DeterminismType.ALL
        self._views: dict[str, torch.Tensor] = {}
        self._graphs: dict[tuple[str, int], Any] = {}
        self._resetting = torch.zeros(nsim, dtype=torch.bool, device=device)
        self._reset_mask = wp.from_torch(self._resetting)

    def bind(self, name: str) -> "torch.Tensor":
        """(N, ...) of a field of the state; always present."""
        if name not in self._views:
            self._views[name] = wp.to_torch(getattr(self.warp_data, name))
        return self._views[name]

    def __getattr__(self, name: str) -> "torch.Tensor":
        if name.startswith("_") or not hasattr(self.warp_data, name):
            raise AttributeError(name)
        return self.bind(name)

    def expand(self, name: str) -> "torch.Tensor":
        """(N, ...) of a model field of which each world has its own values."""
        key = f"model {name}"
        if key not in self._views:
            self._views[key] = wp.to_torch(_field(self.warp_model, name))
        return self._views[key]

    def reset(self, ids: Ints, stage: int = 0) -> None:
        """Take worlds ``ids`` to the model's initial state."""
        self._resetting[:] = False
        self._resetting[torch.as_tensor(ids, device=self.device)] = True
        self._run("reset", 1, lambda: mjw.reset_data(self.warp_model, self.warp_data, reset=self._reset_mask))

    def forward(self, ids: Ints, stage: int = 0) -> None:
        """Compute what positions determine, of all worlds."""
        self._run("positions", 1, lambda: mjw.kinematics(self.warp_model, self.warp_data))

    def step(self, ids: Ints, nstep: int = 1, stage: int = 0) -> None:
        """Advance all worlds by ``nstep`` time steps, and compute what positions determine."""

        def advance() -> None:
            for _ in range(nstep):
                mjw.step(self.warp_model, self.warp_data)
            mjw.kinematics(self.warp_model, self.warp_data)

        self._run("step", nstep, advance)

    def get_data(self, row: int, data: mujoco.MjData) -> None:
        """Write the state of world ``row`` into ``data``."""
        for name in _STATE:
            target = getattr(data, name)
            target[...] = self.bind(name)[row].cpu().numpy().reshape(target.shape)

    def get_model(self, row: int, into: mujoco.MjModel | None = None) -> mujoco.MjModel:
        """The model of world ``row``, perhaps written into another one."""
        return self.model_of(row, into)

    def _run(self, name: str, count: int, launch: Callable[[], None]) -> None:
        """Launch kernels; on a GPU from the second time on as one graph."""
        with wp.ScopedDevice(self.device):
            if (name, count) in self._graphs:
                wp.capture_launch(self._graphs[name, count])
                return
            launch()  # compiles; what is captured next does not run
            if wp.get_device(self.device).is_cuda:
                with wp.ScopedCapture() as capture:
                    launch()
                self._graphs[name, count] = capture.graph


class WarpSimulation:
    """N worlds of one compiled model with parameters of their own, in MuJoCo Warp.

    Arguments and methods as those of :class:`~soro_bench.models.simulation.Simulation`, but for:

    Args:
        effects: only those that are model fields; others act between time steps, on the CPU.
        device: "cuda:0", another GPU, or "cpu", which is slow: to develop and to test.
        deterministic: whether results are the same from run to run on one kind of GPU; slower.
        on_nan: "raise" a WorldError where a state is no number, or "truncate" the episode, as the CPU does.
        guard: folder that such a world is written to, with its state before the step and its parameters.
        room: contacts of a world on average ("nconmax"; worlds share the room), and most constraint rows of each
            ("njmax").

    Raises:
        ValueError: what the device cannot simulate; says what to do.
    """

    xp: Any = torch_namespace

    def __init__(
        self,
        model: mujoco.MjModel,
        parameters: ParameterSet,
        maps: Sequence[ParameterMap],
        nsim: int,
        nthread: int = 1,
        effects: Sequence[Effect] | None = None,
        *,
        device: str = "cuda:0",
        deterministic: bool = False,
        on_nan: str = "raise",
        guard: str | Path | None = None,
        room: Mapping[str, int] | None = None,
    ):
        _check(device, on_nan, room or {})
        self.parameters, self.device, self.on_nan = parameters, device, on_nan
        self.guard = None if guard is None else Path(guard)
        self._host = Simulation(model, parameters, maps, min(nsim, _ROWS), nthread, effects)
        if not self._host.native:
            names = ", ".join(sorted({effect.name for effect in effects or ()}))
            raise ValueError(f"effects {names}: some act between time steps, which a GPU does not; use the CPU's "
                             "environments for them (backend='mujoco')")  # fmt: skip
        written = [name for name in MODEL_FIELDS if self._host.batch.expanded(name) is not None]
        self._own = [name for name in (*written, *_DERIVED) if _is_per_world(name)]
        self._shared = [name for name in written if name not in (*self._own, *_UNREAD)]
        for name in self._own:
            self._host.batch.expand(name)
        self.model = self._host.batch.get_model(0)
        self._common = {name: np.array(_field(self.model, name)) for name in self._shared}
        self.batch = WarpBatch(self.model, nsim, self._own, device, deterministic, dict(room or {}))
        self.batch.model_of = self._model_of
        self.params = self.array(np.tile(parameters.nominal, (nsim, 1)))
        self._params = np.full((nsim, len(parameters.nominal)), np.nan)  # on the host; not written yet
        self._steps = 0
        self.refused = torch.zeros(nsim, dtype=torch.bool, device=device)  # worlds whose last action was no number
        self.meanwhile: Callable[[], None] = lambda: None  # work of the host while the device simulates
        self.set_params(np.arange(nsim), np.tile(parameters.nominal, (nsim, 1)))
        self._before: dict[str, torch.Tensor] = {}

    native = True  # all effects are model fields

    def remembered(self, ids: Ints) -> None:
        """Nothing: what such effects remember is on the device, and is not read."""

    def array(self, values: Any) -> torch.Tensor:
        """Numbers as a tensor on the device; those that are no integers in single precision."""
        if isinstance(values, torch.Tensor):
            return values
        array = np.asarray(values)
        return torch.as_tensor(array.astype(np.float32) if array.dtype.kind == "f" else array, device=self.device)

    def set_params(self, ids: Ints, params: Floats) -> None:
        """Give worlds ``ids`` the parameters ``params`` (len(ids), d), both on the host.

        Raises:
            ValueError: a parameter changes a model field that all worlds share.
        """
        ids = np.asarray(ids.cpu() if isinstance(ids, torch.Tensor) else ids)
        params = np.asarray(params, float)
        changed = (self._params[ids] != params).any(axis=1)
        ids, params = ids[changed], params[changed]
        for first in range(0, len(ids), _ROWS):
            self._write(ids[first : first + _ROWS], params[first : first + _ROWS])
        self._params[ids] = params
        self.params[self.array(ids)] = self.array(params)

    def on_host(self, values: Any) -> Any:
        """The same, a tensor or a dict of them, as NumPy arrays in double precision."""
        if isinstance(values, Mapping):
            return {name: self.on_host(each) for name, each in values.items()}
        array = values.cpu().numpy()
        return array.astype(float) if array.dtype.kind == "f" else array

    def saved(self) -> dict[str, Any]:
        """TypeError: what is on a device is not copied."""
        raise TypeError("environments on a device cannot be copied or pickled; make another one")

    def expect(self, ids: Ints, warning: mujoco.mjtWarning) -> None:
        """Nothing: the device gives no warnings."""

    def begin(self, ids: Ints) -> None:
        """Compute what positions determine, at the start of an episode or after a change of state."""
        self.batch.forward(ids)

    def step(self, ids: Ints, nstep: int, stage: int = 0) -> None:
        """Advance all worlds by ``nstep`` time steps, and compute what positions determine at the new state."""
        if self.guard is not None:
            self._before = {name: self.batch.bind(name).clone() for name in _STATE}
        self.batch.step(ids, nstep)
        self._steps += 1
        self.meanwhile()

    def bad_states(self, ids: Ints) -> torch.Tensor:
        """(n,) whether a state is no number; such worlds are back at the model's initial state.

        Raises:
            WorldError: so it is, and ``on_nan`` is "raise"; or a world has more contacts or constraints than fit.
        """
        overflow = self.batch.bind("overflow")
        # MuJoCo's limits; NaN is within none
        position, velocity = (self.batch.bind(name).abs() <= mujoco.mjMAXVAL for name in ("qpos", "qvel"))
        bad = ~(position.all(dim=1) & velocity.all(dim=1))
        full = (overflow & int(_OVERFLOWS)) != 0
        if bool((full | bad | self.refused).any()):
            if bool(self.refused.any()):
                world = int(self.refused.nonzero()[0])
                raise WorldError(f"the action of world {world} at control step {self._steps} is no number")
            if bool(full.any()):
                world = int(full.nonzero()[0])
                kinds = mjw.OverflowType(int(overflow[world]) & int(_OVERFLOWS))
                raise WorldError(
                    f"world {world} overflows at control step {self._steps} ({kinds!r}): it has more contacts or "
                    "constraints than fit; give more room, such as room={'njmax': 256, 'nconmax': 64}"
                )
            worlds = bad.nonzero().flatten().cpu().numpy()
            for world in worlds.tolist():
                self._guard(world)
            self.batch.reset(worlds)  # as MuJoCo does: what is observed of them are numbers
            self.batch.forward(ids)
        return bad[self.array(ids)]

    def _guard(self, world: int) -> None:
        """Write a world that is no number any more down, and raise WorldError if that is wanted."""
        where = ""
        if self.guard is not None:
            path = self.guard / f"world_{world}_step_{self._steps}.npz"
            arrays: dict[str, Any] = {name: values[world].cpu().numpy() for name, values in self._before.items()}
            params = zip(self.parameters.names, self._params[world], strict=True)
            arrays.update((f"param_{name}", np.array(value)) for name, value in params)
            with replacing(path) as temporary, temporary.open("wb") as file:
                np.savez(file, **arrays)
            where = f"; its state before that step and its parameters are in {path}"
        if self.on_nan == "raise":
            raise WorldError(f"the state of world {world} is no number after control step {self._steps}{where}")

    @quiet()
    def _write(self, ids: Ints, params: Floats) -> None:
        """Write the model fields of at most _ROWS worlds."""
        rows = np.arange(len(ids))
        self._host.set_params(rows, params)
        for name in self._shared:
            values = self._host.batch.expand(name)[rows]
            if not np.allclose(values, self._common[name]):
                raise ValueError(
                    f"{name} is the same for all worlds of a GPU, and a parameter changes it; on this model randomise "
                    "parameters that do not, or train on another model"
                )
        where = self.array(ids)
        for name in self._own:
            field = self.batch.expand(name)
            field[where] = self.array(self._host.batch.expand(name)[rows]).reshape(len(ids), *field.shape[1:])

    def _model_of(self, row: int, into: mujoco.MjModel | None) -> mujoco.MjModel:
        self._host.set_params(np.arange(1), self._params[row : row + 1])
        return self._host.batch.get_model(0, into)


def _field(model: Any, name: str) -> Any:
    """A field of a model, such as "body_mass" or "opt.timestep"."""
    for part in name.split("."):
        model = getattr(model, part)
    return model


def _is_per_world(name: str) -> bool:
    """Whether MuJoCo Warp can have a model field for each world."""
    kind: Any = mjw.Model
    *groups, last = name.split(".")
    if groups == ["opt"]:
        kind = mjw.Option
    field = kind.__dataclass_fields__.get(last)
    shape: Sequence[Any] = getattr(field.type, "shape", ()) if field else ()
    return len(shape) > 0 and shape[0] == "*"


def _check(device: str, on_nan: str, room: Mapping[str, int]) -> None:
    """ValueError for an argument that is not allowed."""
    if on_nan not in ("raise", "truncate"):
        raise ValueError(f"on_nan={on_nan!r}: allowed are 'raise' and 'truncate'")
    if unknown := set(room) - set(_ROOM):
        raise ValueError(f"room has no {', '.join(sorted(unknown))}; it has {', '.join(_ROOM)}")
    try:
        found = wp.get_device(device)
    except (ValueError, RuntimeError) as error:
        known = ", ".join(each.alias for each in wp.get_devices())
        raise ValueError(f"device {device!r}: there is no such device here; there are {known}") from error
    if found.is_cuda and not torch.cuda.is_available():
        raise ValueError(f"device {device!r} needs a CUDA build of torch; this is {torch.__version__}")
