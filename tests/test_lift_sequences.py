"""The committed sequences raise the object of TrunkLift as their files say."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest

import soro_bench  # noqa: F401  registers the environments
from soro_bench.files import read_json

FILES = sorted((Path(__file__).parents[1] / "baselines" / "lift_sequences").glob("*.json"))
# mm; the same machine repeats a sequence to the last bit, another may round contacts differently
TOLERANCE = 3.0
HELD_STEPS = 10


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_sequence_holds_the_recorded_elevation(path):
    sequence = read_json(path)
    env = gymnasium.make(sequence["env_id"], model=sequence["model"], action=sequence["action"])
    env.reset(seed=0, options={"params": sequence["params"]})
    steps = [env.step(np.array(action, np.float32)) for action in sequence["actions"]]
    elevation = 1e3 * np.array([info["elevation"] for *_, info in steps])
    assert len(elevation) == 100 and not any(info["diverged"] for *_, info in steps)
    assert elevation[-HELD_STEPS:].min() == pytest.approx(sequence["elevation_held_mm"], abs=TOLERANCE)
    assert elevation[-1] == pytest.approx(sequence["elevation_end_mm"], abs=TOLERANCE)
    clearance = 1e3 * np.array([info["clearance"] for *_, info in steps])
    assert clearance[-HELD_STEPS:].min() == pytest.approx(sequence["lowest_corner_held_mm"], abs=TOLERANCE)
