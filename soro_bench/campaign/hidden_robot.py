"""A robot whose physics is hidden from the diagnosis that ``soro-bench run --preset quick`` ends with."""

from pathlib import Path

from soro_bench.effects.effect import Effect, Location
from soro_bench.recording.parquet import save
from soro_bench.recording.simulated import record

ENV_ID = "TrunkReach-v0"
HIDDEN = Effect("actuator_gain", Location("actuator", "S1"), {"gain": 0.6})
PARAMETERS = {"trunk_mass": 0.5}  # kg, nominal is 0.42
NOISE = 0.0005  # m, of motion capture
SUMMARY = "a trunk of 0.5 kg instead of 0.42 kg, whose cable S1 moves 0.6 times as far as it is told"


def record_hidden(folder: Path) -> tuple[Path, Path]:
    """Record the hidden robot: 18.2 s, the shortest excitation, and 6 s of random motion to hold out.

    Returns:
        the two files, in ``folder``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for name, policy, steps, seed in (("recording", "excitation", 364, 0), ("heldout", "random", 120, 1)):
        recording = record(ENV_ID, policy, "cable", params=PARAMETERS, steps=steps, seed=seed, noise=NOISE,
                           effects=[HIDDEN])  # fmt: skip
        save(recording, folder / f"{name}.parquet")
        found.append(folder / f"{name}.parquet")
    return found[0], found[1]
