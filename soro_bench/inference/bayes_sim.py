"""BayesSim: a mixture density network from summaries of simulated recordings to the posterior over parameters.

Ramos, Possas, Fox, "BayesSim: adaptive domain randomization via probabilistic inference for robotics simulators", RSS
2019, by sbi's neural posterior estimation. What differs from the published study's implementation is in
docs/explanation/inference.md.
"""

import contextlib
import io
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from sbi.inference import NPE
from sbi.inference.posteriors.base_posterior import NeuralPosterior
from sbi.neural_nets import posterior_nn
from sbi.utils import BoxUniform
from torch import nn

from soro_bench.arrays import Floats

FEATURES = ("mdn", "mdrff")
COMPONENTS, HIDDEN = 5, 24  # published, for one layer; sbi's network has two
BATCHES = 1000  # of samples, in which as many as one batch have to lie in the search box
RANDOM_FEATURES, KERNEL_WIDTH, MATERN = 1000, 3.0, 3  # published: Matern 3/2, so Student's t with 3 degrees of freedom


@dataclass(frozen=True)
class Estimator:
    """A trained posterior on the unit cube of the search box."""

    posterior: NeuralPosterior
    dimension: int
    center: Floats
    scale: Floats

    def sample(self, summary: Floats, count: int, seed: int) -> Floats:
        """(count, d) points inside the search box for one (m,) summary; ValueError if the network has hardly any."""
        torch.manual_seed(seed)
        x = torch.as_tensor((summary - self.center) / self.scale, dtype=torch.float32)
        kept = np.zeros((0, self.dimension))
        for _ in range(BATCHES):  # sbi's own rejection goes on for ever where nothing is accepted
            with _quiet():
                drawn = self.posterior.sample((count,), x=x, show_progress_bars=False, reject_outside_prior=False)
            inside = drawn[((drawn >= 0) & (drawn <= 1)).all(dim=1)]
            kept = np.concatenate([kept, inside.detach().numpy().astype(float)])
            if len(kept) >= count:
                return kept[:count]
        raise ValueError(f"{len(kept)} of {BATCHES * count} samples of BayesSim's network lie in the search box: "
                         "it has learned too little, and more simulations are needed, or no parameters explain the "
                         "recording")  # fmt: skip


def summarise(signals: Floats, actions: ArrayLike) -> Floats:
    """(N, m) cross-correlations of signals and actions, means and standard deviations over time (published).

    Args:
        signals: (N, T, k).
        actions: (T,) or (T, nu).
    """
    steps = signals.shape[1]
    actions = np.asarray(actions, float).reshape(steps, -1)
    cross = np.einsum("ntk,ta->nka", signals, actions) / (steps - 1)
    return np.concatenate([cross.reshape(len(signals), -1), signals.mean(axis=1), signals.std(axis=1)], axis=1)


def train(points: Floats, summaries: Floats, features: str = "mdn", seed: int = 0) -> Estimator:
    """Fit the estimator to points (n, d) of the unit cube and the summaries (n, m) of what was simulated there.

    Args:
        features: "mdn" (a network sees the summaries) or "mdrff" (it sees random Fourier features of them).
        seed: of the network, the order of the batches and the random features.
    """
    if features not in FEATURES:
        raise ValueError(f"unknown features {features!r}; there are {', '.join(FEATURES)}")
    torch.manual_seed(seed)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # results do not depend on the machine's processors
    try:
        center, scale = summaries.mean(axis=0), np.maximum(summaries.std(axis=0), 1e-12)
        x = torch.as_tensor((summaries - center) / scale, dtype=torch.float32)
        theta = torch.as_tensor(points, dtype=torch.float32)
        embedding = RandomFourierFeatures(x.shape[1]) if features == "mdrff" else nn.Identity()
        build = posterior_nn("mdn", z_score_x="none", z_score_theta="independent", hidden_features=HIDDEN,
                             num_components=COMPONENTS, embedding_net=embedding)  # fmt: skip
        prior = BoxUniform(torch.zeros(theta.shape[1]), torch.ones(theta.shape[1]))
        inference = NPE(prior, density_estimator=build, show_progress_bars=False, tracker=_NoTracker())
        with _quiet():
            inference.append_simulations(theta, x).train(show_train_summary=False)
        return Estimator(inference.build_posterior(), theta.shape[1], center, scale)
    finally:
        torch.set_num_threads(threads)


class RandomFourierFeatures(nn.Module):
    """Fixed features cos(W x + b) of a Matern 3/2 kernel (Rahimi and Recht, NIPS 2007).

    The width is that of the study times the square root of the number of inputs, which the distance of two normalised
    summaries grows with.
    """

    def __init__(self, inputs: int):
        super().__init__()
        normal = torch.randn(RANDOM_FEATURES, inputs)
        heavy = torch.distributions.Chi2(MATERN).sample((RANDOM_FEATURES, 1)) / MATERN
        weight = normal / heavy.sqrt() / (KERNEL_WIDTH * inputs**0.5)
        # parameters that are never trained, since sbi asks a network for its parameters' device
        self.weight = nn.Parameter(weight, requires_grad=False)
        self.phase = nn.Parameter(2 * torch.pi * torch.rand(RANDOM_FEATURES), requires_grad=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(n, RANDOM_FEATURES) features of summaries (n, m)."""
        return (2 / RANDOM_FEATURES) ** 0.5 * torch.cos(x @ self.weight.T + self.phase)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without what sbi prints into progress bars, and its warnings of what is taken care of here: summaries that are
    always the same say nothing, and samples outside the search box are left out."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        for text in ("Data has constant values", ".* lie outside the prior support"):
            warnings.filterwarnings("ignore", text)
        yield


class _NoTracker:
    """Keeps sbi from leaving a folder of TensorBoard logs where the command runs."""

    log_dir = None

    def log_metric(self, name: str, value: float, step: int | None = None) -> None:
        pass

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        pass

    def log_params(self, params: dict[str, Any]) -> None:
        pass

    def add_figure(self, name: str, figure: Any, step: int | None = None) -> None:
        pass

    def flush(self) -> None:
        pass
