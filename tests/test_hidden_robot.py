"""The robot with hidden physics of the demo."""

import numpy as np

from soro_bench.campaign.hidden_robot import HIDDEN, NOISE, PARAMETERS, record_hidden
from soro_bench.recording.parquet import load
from soro_bench.recording.simulated import replay


def test_only_its_own_physics_explains_the_recordings_of_the_hidden_robot(tmp_path):
    paths = record_hidden(tmp_path)
    assert [path.name for path in paths] == ["recording.parquet", "heldout.parquet"]
    for path in paths:
        recording = load(path)
        assert recording.parameters.items() >= PARAMETERS.items()
        measured = recording.signals["keypoints"].values
        rms = [
            np.sqrt(np.mean((replay(recording, **options).signals["keypoints"] - measured) ** 2))
            for options in ({"effects": [HIDDEN]}, {})
        ]
        assert abs(rms[0] / NOISE - 1.0) < 0.05 and rms[1] > 3 * NOISE
