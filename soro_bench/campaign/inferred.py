"""Inference as the way to a training distribution: what baselines/rf_dropo.py and bayes_sim.py run."""

from collections.abc import Mapping
from pathlib import Path

from soro_bench.files import read_json
from soro_bench.inference.methods import infer
from soro_bench.inference.replay import Replay
from soro_bench.randomization import Distribution, load
from soro_bench.recording import parquet
from soro_bench.training.methods import Method


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
