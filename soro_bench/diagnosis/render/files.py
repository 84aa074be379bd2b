"""Files of a result for programs: effects, posterior, patched model, actions to record next, and the result itself."""

from pathlib import Path

import numpy as np

from soro_bench.diagnosis.result import Result
from soro_bench.effects.effect import SCHEMA
from soro_bench.files import replacing, write_json
from soro_bench.randomization import Gaussian
from soro_bench.recording.excitation import write_actions

MODEL, REMAINING, NEXT = "patched_model.xml", "remaining_effects.json", "next_actions.csv"
OPTIONAL = ("posterior.json", MODEL, REMAINING, NEXT)


def write_files(result: Result, folder: str | Path) -> None:
    """Write them; result.json last, so that it stands for a complete folder. Those of an earlier diagnosis vanish."""
    folder = Path(folder)
    for name in OPTIONAL:
        (folder / name).unlink(missing_ok=True)
    write_json(folder / "effects.json", {"schema": SCHEMA, "effects": list(result.patch.effects)})
    if result.trainable:
        write_json(folder / "posterior.json", posterior(result).to_dict())
    if result.patch.model is not None:
        with replacing(folder / MODEL) as temporary:
            temporary.write_text(result.patch.model, encoding="utf-8")
        if result.patch.remaining and result.patch.model_state != "refitted":  # whose parameters are for itself alone
            write_json(folder / REMAINING, {"schema": SCHEMA, "effects": list(result.patch.remaining)})
    if (found := result.next_recording) is not None:
        write_actions(folder / NEXT, found.control_timestep, np.array(found.actions))
    result.save(folder / "result.json")


def posterior(result: Result) -> Gaussian:
    """The parameters of the patched robot, as a distribution to train on."""
    names = tuple(each.estimate.name for each in result.parameters)
    mean = np.array([each.estimate.value for each in result.parameters])
    return Gaussian(names, mean, np.array(result.covariance))
