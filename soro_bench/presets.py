"""What ``soro-bench run`` runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from soro_bench.experiment import ORACLE, UDR, Method
from soro_bench.training.ppo import PPOConfig, default_config


@dataclass(frozen=True)
class Part:
    """One environment of a plan: which methods, on which seeds."""

    config: PPOConfig
    methods: Sequence[Method]
    seeds: Mapping[str, Sequence[int]]  # by method
    eval_models: Sequence[str] = ("cable", "flex")


def _paper(env_id: str) -> Part:
    # published: ten random boxes for UDR, three repetitions otherwise, two million steps
    seeds = {"oracle": range(3), "udr": range(10)}
    return Part(default_config(env_id, 2_000_000), (ORACLE, UDR), seeds)


PRESETS = {
    "quick": [
        Part(
            default_config("TrunkReach-v0", 200_000),
            (ORACLE, UDR),
            {"oracle": [0], "udr": [0]},
            eval_models=("flex",),
        )
    ],
    "paper": [_paper(env_id) for env_id in ("TrunkReach-v0", "TrunkPush-v0", "TrunkLift-v0")],
}
