"""Oracle: PPO on the nominal parameters, which the evaluation uses too.

    python baselines/oracle.py TrunkReach-v0 --seeds 0 1 2

Trains on the cheap model, evaluates on both, writes policies, results and rerun recordings; goes on where it stopped.
"""

from soro_bench.commands.campaign import Baseline, script
from soro_bench.training.methods import ORACLE

if __name__ == "__main__":
    script(Baseline, ORACLE, __doc__)
