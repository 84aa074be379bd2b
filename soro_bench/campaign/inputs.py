"""What a campaign begins with: recordings of a hidden robot, and distributions that are inferred."""

from collections.abc import Mapping
from pathlib import Path

from soro_bench.effects.effect import Effect, Location
from soro_bench.files import read_json
from soro_bench.inference.methods import infer
from soro_bench.inference.replay import Replay
from soro_bench.randomization import Distribution, load
from soro_bench.recording import parquet
from soro_bench.recording.parquet import save
from soro_bench.recording.simulated import record
from soro_bench.training.methods import Method

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


def inferred(
    method: str,
    recording: str | Path,
    known: Mapping[str, float] | None = None,
    model: str | None = None,
    noise: float = 0.0,
) -> Method:
    """A training method whose distribution is inferred from a recording, anew for every seed.

    Args:
        method: see :func:`soro_bench.inference.methods.infer`.
        recording: file of a recording of the environment.
        known, model, noise: see :class:`soro_bench.inference.replay.Replay`.
    """

    def distribution(env_id: str, seed: int, folder: Path) -> Distribution:
        path, measured = Path(folder) / "posterior.json", parquet.load(recording)
        if (recorded := measured.metadata.get("env_id")) != env_id:
            raise ValueError(f"{recording} is a recording of {recorded}, not of {env_id}")
        replay = Replay(measured, known=known, model=model, noise=noise)
        if path.exists() and read_json(path).get("replay") != replay.fingerprint():
            raise ValueError(f"{path} was inferred from another recording, model or known values; choose another --out")
        if not path.exists():
            work = path.with_suffix(".log.jsonl")
            infer(method, replay, work, seed).save(path)
            work.unlink(missing_ok=True)  # up to 180 MB, and only an interrupted inference needs it
        return load(path)

    return Method(method.replace("-", "_"), distribution)
