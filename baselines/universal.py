"""Universal policy: PPO on the whole search box, told the parameters; on the robot it is told those of a recording.

    python baselines/universal.py TrunkReach-v0 --seeds 0 1 2

After Yu et al., "Preparing for the unknown: learning a universal policy with online system identification", RSS 2017.
RF-DROPO infers the parameters from the recording in assets/recordings, or from --recording; another recording later
needs no other training (`soro-bench train --told`). Trains on the cheap model, evaluates on both; goes on where it
stopped.
"""

from soro_bench.commands.campaign import UniversalBaseline, script

if __name__ == "__main__":
    script(UniversalBaseline, "rf-dropo", __doc__)
