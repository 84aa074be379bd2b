"""Halve and double every setting of the diagnosis, and record what changes on four development robots.

    python benchmarks/diagnosis_settings.py
    python docs/generate.py

The first command takes hours on two cores and can be stopped: it goes on with the settings that
docs/results/measured.json lacks. The second one writes the changes into docs/reference/settings.md.

The robots are an arm of one joint: healthy, with a payload, with a delayed motor, and with dry friction. The payload
shows as a discrepancy outside the catalogue, since the arm's inertia is a parameter.
"""

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.diagnosis.pipeline import Run, run_diagnosis
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.effects.effect import Effect, Location
from soro_bench.files import read_json, write_json
from tests.arm import ARM, MAP, recording

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "measured.json"
FACTORS = {"halved": 0.5, "doubled": 2.0}
CASES = {
    "healthy": (),
    "payload": (Effect("payload", Location("body", "arm"), {"mass": 0.1}),),
    "delay": (Effect("actuator_delay", Location("actuator", "motor"), {"delay": 0.03}),),
    "friction": (Effect("coulomb_friction", Location("joint", "hinge"), {"friction": 0.05}),),
}
_NOTED = 0.01  # of a probability, from which a change is noted
_MOVED = 0.1  # posterior standard deviations of an unknown, likewise


class RememberingRobot(ModelRobot):
    """A robot that simulates each replay once: most settings leave most replays as they were."""

    replays: ClassVar[dict[tuple, Floats]] = {}

    def shortened(self, factor: int) -> Robot:
        """The same robot with time steps shorter by a factor."""
        return RememberingRobot(*self._sources, self.threads, factor, self._baseline)

    def _roll_out(self, drives: Any, parameters: Any, physics: Any, before_step: Any) -> Floats:
        if before_step:
            return super()._roll_out(drives, parameters, physics, before_step)
        columns = zip(drives, parameters, physics, strict=True)
        keys = [(self.shorter, d.actions.tobytes(), d.start.tobytes(), x.tobytes(), repr(e)) for d, x, e in columns]
        new = [i for i, key in enumerate(keys) if key not in self.replays]
        if new:
            values = super()._roll_out([drives[i] for i in new], parameters[new], [physics[i] for i in new], None)
            self.replays.update({keys[i]: each for i, each in zip(new, values, strict=True)})
        return np.stack([self.replays[key] for key in keys])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stages", nargs="*", help="of these stages only")
    options = parser.parse_args()
    measured = read_json(RESULTS)
    known = measured["settings_sensitivity"]
    with tempfile.TemporaryDirectory() as folder:
        paths = Path(folder) / "arm.xml", Path(folder) / "arm.toml"
        for path, text in zip(paths, (ARM, MAP), strict=True):
            path.write_text(text)
        usual = {case: outcome(paths, case, DEFAULT) for case in CASES}
        remembered = RememberingRobot.replays
        for key, name, settings in varied(options.stages):
            RememberingRobot.replays = dict(remembered)  # of the defaults only, to bound the memory
            if name in known.get(key, {}):
                continue
            if isinstance(settings, ValueError):
                found = {"all": f"refused, {settings}"}
            else:
                found = {case: changed(paths, case, settings, usual[case]) for case in CASES}
            known.setdefault(key, {})[name] = {case: text for case, text in found.items() if text}
            write_json(RESULTS, measured)
            print(key, name, known[key][name] or "no change", flush=True)


def varied(stages: list[str] | None) -> Iterator[tuple[str, str, Settings | ValueError]]:
    """Name of a setting, name of the factor, and settings with that one times the factor, or why they are refused."""
    for stage, name, value, _, _ in DEFAULT.listed():
        if stages and stage not in stages:
            continue
        for label, factor in FACTORS.items():
            number = round(value * factor) if isinstance(value, int) else value * factor
            try:
                group = replace(getattr(DEFAULT, stage), **{name: number})
            except ValueError as error:
                yield f"{stage}.{name}", label, error
            else:
                yield f"{stage}.{name}", label, replace(DEFAULT, **{stage: group})


def outcome(paths: tuple[Path, Path], case: str, settings: Settings) -> dict[str, Any]:
    """Best answer of a diagnosis, its probability, and its unknowns with their posterior deviations."""
    robot = RememberingRobot(*paths, threads=1)
    train, heldout = (recording(paths, CASES[case], seed) for seed in (0, 1))
    found = diagnosed(robot, train, heldout, settings)
    best = found.best
    deviation = np.sqrt(np.diag(best.hypothesis.covariance(found.explanation.problem)))
    return {
        "answer": "discrepancy outside the catalogue"
        if found.detected and found.comparison.unknown > found.comparison.likeliest
        else answer(best),
        "probability": best.probability,
        "x": best.hypothesis.x,
        "deviation": deviation,
    }


def answer(best: Any) -> str:
    """An answer in words."""
    return " + ".join(best.names) or "nothing"


def diagnosed(robot: ModelRobot, train: Any, heldout: Any, settings: Settings) -> Any:
    """The diagnosis with some settings."""
    return run_diagnosis(robot, [train], [heldout], Run(settings=settings))


def changed(paths: tuple[Path, Path], case: str, settings: Settings, usual: dict[str, Any]) -> str:
    """What changes in a case; nothing where answer, probability and unknowns stay."""
    try:
        now = outcome(paths, case, settings)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        return f"refused: {error}".split("\n")[0][:80]
    if now["answer"] != usual["answer"]:
        return f"{usual['answer']} becomes {now['answer']}"
    said = []
    if abs(now["probability"] - usual["probability"]) >= _NOTED:
        said.append(f"probability {usual['probability']:.2f} to {now['probability']:.2f}")
    moved = float(np.max(np.abs(now["x"] - usual["x"]) / usual["deviation"], initial=0.0))
    if moved >= _MOVED:
        said.append(f"unknowns by {moved:.1f} deviations")
    return ", ".join(said)


if __name__ == "__main__":
    main()
