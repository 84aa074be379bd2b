"""A trained policy as data: safetensors for the numbers, JSON for their meaning. Nothing is ever unpickled."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from soro_bench.files import read_json, replacing, write_json

_WEIGHTS, _CARD = "policy.safetensors", "policy.json"
_MAX_BYTES = 100_000_000


@dataclass(frozen=True)
class PolicyCard:
    """What a policy was trained for."""

    env_id: str
    model: str  # of the robot it was trained on
    action: str  # action mode
    method: str  # oracle, udr, ...
    seed: int
    steps: int  # environment steps of training


@dataclass(frozen=True)
class Policy:
    """Deterministic tanh MLP: normalised observation -> action.

    Args:
        tensors: "mean" and "std" (k,) of the observation; "w0", "b0", ... of the layers.
    """

    card: PolicyCard
    tensors: dict[str, np.ndarray]

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions for (n, k) observations: (n,) integers if the action mode is discrete, else (n, nu) in [-1, 1]."""
        x = (observations - self.tensors["mean"]) / self.tensors["std"]
        x = np.clip(x, -OBSERVATION_CLIP, OBSERVATION_CLIP)
        layers = self.num_layers
        for i in range(layers):
            # one row at a time, so that an action does not depend on how many are asked for at once
            x = np.stack([row @ self.tensors[f"w{i}"].T for row in x]) + self.tensors[f"b{i}"]
            if i < layers - 1:
                x = np.tanh(x)
        return x.argmax(axis=1) if self.card.action == "discrete" else np.clip(x, -1.0, 1.0)

    @property
    def num_layers(self) -> int:
        """Number of linear layers."""
        return sum(name.startswith("w") for name in self.tensors)

    def save(self, folder: str | Path) -> None:
        """Write policy.safetensors and policy.json into ``folder``."""
        from safetensors.numpy import save_file

        folder = Path(folder)
        with replacing(folder / _WEIGHTS) as temporary:
            save_file({name: np.ascontiguousarray(value) for name, value in self.tensors.items()}, str(temporary))
        write_json(folder / _CARD, asdict(self.card))

    @classmethod
    def load(cls, folder: str | Path) -> "Policy":
        """Read a policy; ValueError if the folder does not hold one."""
        from safetensors import SafetensorError
        from safetensors.numpy import load_file

        folder = Path(folder)
        for name in (_WEIGHTS, _CARD):
            if not (folder / name).is_file():
                raise ValueError(f"{folder} holds no policy: {name} is missing")
        if (size := (folder / _WEIGHTS).stat().st_size) > _MAX_BYTES:
            raise ValueError(f"{folder / _WEIGHTS} has {size} bytes; at most {_MAX_BYTES} are read")
        try:
            card = PolicyCard(**read_json(folder / _CARD))
            tensors = load_file(str(folder / _WEIGHTS))
        except (TypeError, SafetensorError) as error:
            raise ValueError(f"{folder} holds no valid policy: {error}") from error
        policy = cls(card, tensors)
        policy._check_shapes(folder)
        return policy

    def _check_shapes(self, folder) -> None:
        names = ["mean", "std", *(f"{kind}{i}" for i in range(self.num_layers) for kind in "wb")]
        if self.num_layers == 0 or sorted(names) != sorted(self.tensors):
            raise ValueError(f"{folder} holds no valid policy: its tensors are {', '.join(sorted(self.tensors))}")
        size = self.tensors["mean"].shape
        shapes_fit = self.tensors["std"].shape == size and len(size) == 1
        for i in range(self.num_layers):
            weight, bias = self.tensors[f"w{i}"], self.tensors[f"b{i}"]
            shapes_fit = shapes_fit and weight.shape == (*bias.shape, *size)
            size = bias.shape
        if not shapes_fit or not all(np.isfinite(value).all() for value in self.tensors.values()):
            raise ValueError(f"{folder} holds no valid policy: its layers do not fit together or are not finite")


OBSERVATION_CLIP = 10.0  # standard deviations
