"""Reset-Free DROPO: infer a distribution from a recording, train PPO on it, evaluate.

    python baselines/rf_dropo.py TrunkReach-v0 --seeds 0 1 2
    python baselines/rf_dropo.py TrunkPush-v0 --known young_modulus=3.6e6

The recording is a simulated one of the accurate model with nominal parameters (assets/recordings), or --recording.
Trains on the cheap model, evaluates on both; writes posteriors, policies, results and rerun recordings; goes on where
it stopped.
"""

from soro_bench.commands.campaign import InferenceBaseline, script

if __name__ == "__main__":
    script(InferenceBaseline, "rf-dropo", __doc__)
