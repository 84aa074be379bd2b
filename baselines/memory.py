"""Memory: PPO on the whole search box, with a policy that sees the last five observations.

    python baselines/memory.py TrunkReach-v0 --seeds 0 1 2

After Peng et al., "Sim-to-real transfer of robotic control with dynamics randomization", ICRA 2018: how the robot moves
tells a policy that remembers it which parameters the episode has. Needs no recording. Trains on the cheap model,
evaluates on both; goes on where it stopped.
"""

from soro_bench.commands.campaign import Baseline, script
from soro_bench.training.methods import MEMORY

if __name__ == "__main__":
    script(Baseline, MEMORY, __doc__)
