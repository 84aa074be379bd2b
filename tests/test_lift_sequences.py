"""The committed sequences raise the object of TrunkLift as their files say."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest

import soro_bench  # noqa: F401  registers the environments
from soro_bench.files import read_json

FILES = sorted((Path(__file__).parents[1] / "baselines" / "lift_sequences").glob("*.json"))
TOLERANCE = 3.0  # mm
HELD_STEPS = 10
# Contacts on `flex` amplify the last bit, so that another processor sees another course (docs/lift.md)
LIGHTER = 1e-12 * np.arange(6)


def replayed(sequence, lighter):
    """Elevation held and at the end and lowest corner held [mm], of an object whose mass is less by this share."""
    env = gymnasium.make(sequence["env_id"], model=sequence["model"], action=sequence["action"])
    mass = sequence["params"]["cube_mass"] * (1 - lighter)
    env.reset(seed=0, options={"params": {**sequence["params"], "cube_mass": mass}})
    infos = [env.step(np.array(action, np.float32))[-1] for action in sequence["actions"]]
    assert len(infos) == 100 and not any(info["diverged"] for info in infos)
    elevation, clearance = (1e3 * np.array([info[key] for info in infos]) for key in ("elevation", "clearance"))
    return elevation[-HELD_STEPS:].min(), elevation[-1], clearance[-HELD_STEPS:].min()


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_sequence_holds_the_recorded_elevation(path):
    """Each copy of the object on `cable`, and one of them at least on `flex`."""
    sequence = read_json(path)
    recorded = [sequence[key] for key in ("elevation_held_mm", "elevation_end_mm", "lowest_corner_held_mm")]
    copies = [replayed(sequence, lighter) for lighter in LIGHTER]
    as_recorded = [np.allclose(copy, recorded, rtol=0, atol=TOLERANCE) for copy in copies]
    assert all(as_recorded) if sequence["model"] == "cable" else any(as_recorded), copies
