"""A trained policy as data: safetensors for the numbers, JSON for their meaning. Nothing is ever unpickled."""

import reprlib
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soro_bench.arrays import Floats
from soro_bench.files import brief, read_bytes, read_json, replacing, write_json

_WEIGHTS, _CARD = "policy.safetensors", "policy.json"
MAX_BYTES = 20_000_000  # of a policy file
MAX_FRAMES = 100  # observations that a policy sees; a stranger's may take no more memory and time


@dataclass(frozen=True)
class PolicyCard:
    """What a policy was trained for."""

    env_id: str
    model: str  # of the robot it was trained on
    action: str  # action mode
    method: str  # oracle, udr, ...
    seed: int
    steps: int  # environment steps of training

    def __post_init__(self) -> None:
        for field in fields(self):
            expected = cast("type", field.type)  # not the name of one: annotations are evaluated here
            if type(value := getattr(self, field.name)) is not expected:
                raise TypeError(f"{field.name} is {brief(value)}; expected {expected.__name__}")


def check_observations(observations: ArrayLike, size: int) -> None:
    """ValueError unless they are (n, size), a row for each environment."""
    shape = np.shape(observations)
    if len(shape) != 2:
        raise ValueError(f"observations have the shape {shape}; (n, {size}) is needed, a row for each environment")
    if shape[1] != size:
        raise ValueError(f"the policy takes observations of {size} numbers; these have {shape[1]}")


class TrainedPolicy(Protocol):
    """What every policy can do, whatever it is made of."""

    suffix: ClassVar[str]  # of its file

    @property
    def card(self) -> PolicyCard:
        """What it was trained for."""

    @property
    def inputs(self) -> int:
        """How many numbers it sees: those of an observation, or a multiple for the last ones, the newest last."""

    def act(self, observations: Floats) -> NDArray[Any]:
        """Actions for (n, inputs) observations: (n,) integers if the action mode is discrete, else (n, nu) in
        [-1, 1]."""

    def to_bytes(self) -> bytes:
        """The content of its file."""


@dataclass(frozen=True)
class Policy:
    """Deterministic tanh MLP: normalised observation -> action.

    Args:
        tensors: "mean" and "std" (k,) of the observation; "w0", "b0", ... of the layers.
    """

    suffix: ClassVar[str] = ".safetensors"
    card: PolicyCard
    tensors: dict[str, NDArray[np.floating]]

    @property
    def inputs(self) -> int:
        """How many numbers it sees: those of an observation, or a multiple for the last ones, the newest last."""
        return len(self.tensors["mean"])

    def act(self, observations: Floats) -> NDArray[Any]:
        """Actions for (n, k) observations: (n,) integers if the action mode is discrete, else (n, nu) in [-1, 1]."""
        check_observations(observations, self.inputs)
        x = _normalised(observations, self.tensors["mean"], self.tensors["std"])
        layers = self.num_layers
        for i in range(layers):
            # one row at a time, so that an action does not depend on how many are asked for at once
            x = np.stack([row @ self.tensors[f"w{i}"].T for row in x]) + self.tensors[f"b{i}"]
            if i < layers - 1:
                x = np.tanh(x)
        return x.argmax(axis=1) if self.card.action == "discrete" else np.clip(x, -1.0, 1.0)

    def told(self, values: Floats) -> "Policy":
        """The policy that takes its last inputs for ``values`` (d,), and sees the others only."""
        seen, tensors = self.inputs - len(values), dict(self.tensors)
        first, normalised = tensors["w0"], _normalised(values, tensors["mean"][seen:], tensors["std"][seen:])
        tensors["b0"] = (tensors["b0"] + first[:, seen:] @ normalised).astype(tensors["b0"].dtype)
        tensors |= {"w0": first[:, :seen], "mean": tensors["mean"][:seen], "std": tensors["std"][:seen]}
        return replace(self, tensors=tensors)

    @property
    def num_layers(self) -> int:
        """Number of linear layers."""
        return sum(name.startswith("w") for name in self.tensors)

    def to_bytes(self) -> bytes:
        """The tensors as a safetensors file."""
        from safetensors.numpy import save

        return save({name: np.ascontiguousarray(value) for name, value in self.tensors.items()})

    def save(self, folder: str | Path) -> None:
        """Write policy.safetensors and policy.json into ``folder``."""
        with replacing(Path(folder) / _WEIGHTS) as temporary:
            temporary.write_bytes(self.to_bytes())
        write_json(Path(folder) / _CARD, asdict(self.card))

    @classmethod
    def load(cls, folder: str | Path) -> "Policy":
        """Read the policy that a training wrote into ``folder``; ValueError if there is none.

        :func:`soro_bench.leaderboard.entry.load_policy` also reads that of a leaderboard entry.
        """
        path = Path(folder)
        for name in (_WEIGHTS, _CARD):
            if not (path / name).is_file():
                raise ValueError(f"{path} holds no policy: {name} is missing")
        try:
            card = PolicyCard(**read_json(path / _CARD))
        except TypeError as error:
            raise ValueError(f"{path} holds no valid policy: {error}") from error
        return cls.from_bytes(card, read_bytes(path / _WEIGHTS, MAX_BYTES), path)

    @classmethod
    def from_bytes(cls, card: PolicyCard, data: bytes, source: str | Path) -> "Policy":
        """The policy in the content of a safetensors file; ``source`` is what errors call it."""
        from safetensors import SafetensorError
        from safetensors.numpy import load

        try:
            policy = cls(card, load(data))
        except (SafetensorError, KeyError, ValueError) as error:  # the latter two of types that numpy lacks
            raise ValueError(f"{source} holds no valid policy: {error}") from error
        policy._check_shapes(source)
        return policy

    def _check_shapes(self, source: str | Path) -> None:
        names = ["mean", "std", *(f"{kind}{i}" for i in range(self.num_layers) for kind in "wb")]
        if self.num_layers == 0 or sorted(names) != sorted(self.tensors):
            found = reprlib.repr(sorted(self.tensors))
            raise ValueError(f"{source} holds no valid policy: its tensors are {found}")
        if other := {str(value.dtype) for value in self.tensors.values()} - {"float32", "float64"}:
            raise ValueError(f"{source} holds no valid policy: it has numbers of type {other.pop()}, not float32 or "
                             "float64")  # fmt: skip
        size = self.tensors["mean"].shape
        shapes_fit = self.tensors["std"].shape == size and len(size) == 1 and size[0] > 0
        for i in range(self.num_layers):
            weight, bias = self.tensors[f"w{i}"], self.tensors[f"b{i}"]
            shapes_fit = shapes_fit and bias.ndim == 1 and weight.shape == (*bias.shape, *size)
            size = bias.shape
        if not shapes_fit or not all(np.isfinite(value).all() for value in self.tensors.values()):
            raise ValueError(f"{source} holds no valid policy: its layers do not fit together or are not finite")
        if (smallest := self.tensors["std"].min()) <= 0:
            raise ValueError(f"{source} holds no valid policy: its std has {smallest}; positive numbers are needed")


def _normalised(values: Floats, mean: NDArray[np.floating], std: NDArray[np.floating]) -> Floats:
    """Values (..., k) in standard deviations from their mean, as a network sees them."""
    return np.asarray(np.clip((values - mean) / std, -OBSERVATION_CLIP, OBSERVATION_CLIP), float)


OBSERVATION_CLIP = 10.0  # standard deviations
