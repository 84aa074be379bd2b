"""DROID: fit one value of every parameter to a recording by CMA-ES, train PPO on it, evaluate.

    python baselines/droid.py TrunkReach-v0 --seeds 0 1 2

After Tsai et al., "DROID: minimizing the reality gap using single-shot human demonstration", RA-L 2021. The recording
is a simulated one of the accurate model with nominal parameters (assets/recordings), or --recording. Trains on the
cheap model, evaluates on both; goes on where it stopped.
"""

from soro_bench.commands.campaign import InferenceBaseline, script

if __name__ == "__main__":
    script(InferenceBaseline, "droid", __doc__)
