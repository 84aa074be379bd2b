"""Uniform domain randomisation: PPO on a random box of the search space per seed, as in the published study.

    python baselines/udr.py TrunkReach-v0 --seeds 0 1 2 3 4

Trains on the cheap model, evaluates on both, writes policies, results and rerun recordings; goes on where it stopped.
"""

from soro_bench.commands.campaign import Baseline, script
from soro_bench.training.methods import UDR

if __name__ == "__main__":
    script(Baseline, UDR, __doc__)
