"""Halve and double every setting of the diagnosis, and record what changes on development robots.

    python benchmarks/diagnosis_settings.py [--anew] [--stages selection fit ...] [--quick]
    python docs/generate.py

The first command takes an hour of one core and can be stopped: it goes on with the settings that
docs/results/measured.json lacks, or begins again with --anew. The second one writes docs/reference/settings.md.

The robots are an arm of one joint: healthy, with a payload, with a delayed motor, and with dry friction. A healthy arm
with spikes, coarse levels and late stamps serves the data quality; an arm that something pushes at random serves the
localisation of what no law explains; and one that has got a payload serves the comparison of pairs.

Each case runs once with settings that note where they are read. A setting that nobody has read can change nothing, and
is not varied. The spoilt and the pushed arm are for settings that are first read in their stages, or nowhere else: all
others the first four cases show.

What changes nothing there is varied in harder cases (harder_settings.py), if not --quick: many settings at once, and
of those that change something halves, until single ones are left. Two that cancel each other would stay unseen.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.settings_cases import (
    CASES,
    PAIRED,
    CaseRun,
    Groups,
    Outcome,
    RememberingRobot,
    arm_files,
    harder_cases,
    runner,
)
from soro_bench.diagnosis.settings import DEFAULT, listed
from soro_bench.files import read_json, write_json

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "measured.json"
NOT_READ = "not read in these cases"
FACTORS = {"halved": 0.5, "doubled": 2.0}
_NOTED = 0.01  # of a probability, from which a change is noted
_MOVED = 0.1  # posterior standard deviations of an unknown, and share of that deviation, likewise
_TOLD = 2  # changes of one case that are told, beside the number of others


@dataclass
class Reads:
    """Where settings were first read: stages by "group.name"."""

    stage: str = "data quality"
    first: dict[str, str] = field(default_factory=dict)

    def begin(self, stage: str) -> None:
        """A stage begins."""
        self.stage = stage

    def watched(self, name: str, group: Any) -> Any:
        """The same settings, but for that they note when they are read."""
        kind = type(group)
        names = {each.name for each in fields(kind)}

        def read(settings: Any, attribute: str) -> Any:
            if attribute in names:
                self.first.setdefault(f"{name}.{attribute}", self.stage)
            return object.__getattribute__(settings, attribute)

        watched = type(kind.__name__, (kind,), {"__getattribute__": read})
        return watched(**{each: getattr(group, each) for each in names})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stages", nargs="*", help="groups of settings, such as selection; all by default")
    parser.add_argument("--quick", action="store_true", help="leave out the harder cases")
    parser.add_argument("--anew", action="store_true", help="forget what was measured of these groups")
    options = parser.parse_args()
    defaults = {each.name: getattr(DEFAULT, each.name) for each in fields(DEFAULT)}
    if unknown := sorted({*(options.stages or [])} - {*defaults}):
        parser.error(f"no group {unknown[0]}; there are {', '.join(defaults)}")
    groups = options.stages or [*defaults]
    measured = read_json(RESULTS)
    known = measured["settings_sensitivity"]
    names = {f"{group}.{each[1]}" for group, settings in defaults.items() for each in listed(group, settings)}
    for key in [each for each in known if each not in names or (options.anew and each.split(".")[0] in groups)]:
        del known[key]
    harder = measured.setdefault("settings_harder", {})
    for done in (by_label[label] for by_label in harder.values() for label in by_label):
        done[:] = [key for key in done if key in known]
    with tempfile.TemporaryDirectory() as folder:
        paths = arm_files(Path(folder))
        runs = {name: runner(paths, case) for name, case in CASES.items() if (name == PAIRED) <= (PAIRED in groups)}
        usual, read = with_defaults(runs, defaults)
        remembered = RememberingRobot.replays
        for key, label, settings in varied(defaults, groups):
            RememberingRobot.replays = dict(remembered)  # of the defaults only, to bound the memory
            if label in known.get(key, {}):
                continue
            reading = [name for name in runs if key in read[name]]
            if isinstance(settings, ValueError):
                found: Any = {"all": f"refused, {settings}"}
            elif not reading:
                found = NOT_READ
            else:
                texts = {name: changed(runs[name], settings, usual[name]) for name in reading}
                found = {name: text for name, text in texts.items() if text}
            known.setdefault(key, {})[label] = found
            write_json(RESULTS, measured)
            print(key, label, found or "no change", flush=True)
        if not options.quick:
            vary_harder(Path(folder), defaults, known, harder, lambda: write_json(RESULTS, measured))


def vary_harder(folder: Path, defaults: Groups, known: Groups, harder: Groups, save: Callable[[], None]) -> None:
    """Vary in harder cases what changes nothing so far.

    Args:
        known: by setting and factor, what changes in each case. harder: by case and factor, the settings that were
            varied there. save: writes both.
    """
    for name, build in harder_cases(folder).items():
        run, usual, read = None, None, set[str]()
        for label, factor in FACTORS.items():
            done = harder.setdefault(name, {}).setdefault(label, [])
            idle = [key for key in known if key not in done and not seen(known[key]) and key.split(".")[0] in defaults]
            if not idle:
                continue
            if run is None or usual is None:
                run, reads = build(), Reads()
                watched = {group: reads.watched(group, each) for group, each in defaults.items()}
                reads.first.clear()
                usual, read = run(watched, reads.begin), {*reads.first}
            asked = [key for key in idle if key in read]
            for key, text in bisected(run, usual, defaults, asked, factor).items():
                known[key][label] = {**(known[key][label] if isinstance(known[key][label], dict) else {}), name: text}
                print(key, label, name, text, flush=True)
            for key in asked:
                known[key][label] = {} if known[key][label] == NOT_READ else known[key][label]
            done += idle
            save()


def seen(changes: Groups) -> bool:
    """Whether a setting changes anything."""
    return any(isinstance(each, dict) and each for each in changes.values())


def bisected(run: CaseRun, usual: Outcome, defaults: Groups, keys: Sequence[str], factor: float) -> dict[str, str]:
    """What changes by which settings, of some that are varied together."""
    if not keys:
        return {}
    groups: dict[str, Groups] = {name: {} for name in defaults}
    for key in keys:
        group, name = key.split(".")
        groups[group][name] = times(getattr(defaults[group], name), factor)
    try:
        text = changed(run, {name: replace(defaults[name], **each) for name, each in groups.items()}, usual)
    except ValueError as error:
        text = f"refused, {error}"
    if not text or len(keys) == 1:
        return {keys[0]: text} if text else {}
    half = len(keys) // 2
    return {
        **bisected(run, usual, defaults, keys[:half], factor),
        **bisected(run, usual, defaults, keys[half:], factor),
    }


def with_defaults(runs: dict[str, CaseRun], defaults: Groups) -> tuple[dict[str, Outcome], dict[str, set[str]]]:
    """Outcomes of all cases with default settings, and the settings that are varied in each."""
    usual, stages = {}, {}
    for name, run in runs.items():
        reads = Reads()
        watched = {group: reads.watched(group, each) for group, each in defaults.items()}
        reads.first.clear()  # as they were made
        usual[name] = run(watched, reads.begin)
        stages[name] = reads.first
    return usual, varied_in(stages)


def varied_in(stages: dict[str, dict[str, str]]) -> dict[str, set[str]]:
    """The settings that are varied in each case.

    Args:
        stages: by case, where each setting was first read.
    """
    everywhere = {key for name, first in stages.items() if not CASES[name].stages for key in first}
    return {
        name: {key for key, stage in first.items() if stage in CASES[name].stages or key not in everywhere}
        if CASES[name].stages
        else {*first}
        for name, first in stages.items()
    }


def varied(defaults: Groups, groups: Sequence[str]) -> Iterator[tuple[str, str, Groups | ValueError]]:
    """Name of a setting, name of the factor, and settings with that one times the factor, or why they are refused."""
    for group in groups:
        for _, name, value, _, _ in listed(group, defaults[group]):
            for label, factor in FACTORS.items():
                try:
                    changed = replace(defaults[group], **{name: times(value, factor)})
                except ValueError as error:
                    yield f"{group}.{name}", label, error
                else:
                    yield f"{group}.{name}", label, {**defaults, group: changed}


def times(value: Any, factor: float) -> Any:
    """A setting times a factor; whole numbers stay whole."""
    if isinstance(value, tuple):
        return tuple(times(each, factor) for each in value)
    return round(value * factor) if isinstance(value, int) else value * factor


def changed(run: CaseRun, settings: Groups, usual: Outcome) -> str:
    """What changes in a case; nothing where all that is said, its probability and the unknowns stay."""
    try:
        now = run(settings, lambda stage: None)
    except (ValueError, ArithmeticError, LookupError, TypeError, np.linalg.LinAlgError) as error:
        return f"refused: {error}".split("\n")[0][:80]
    pairs = {about: (usual.said[about], now.said[about]) for about in usual.said}
    said = [
        f"{before} becomes {after}" if about == "answer" else f"{about}: {before} becomes {after}"
        for about, (before, after) in pairs.items()
        if before != after
    ]
    if len(said) > _TOLD + 1:
        said[_TOLD:] = [f"and {len(said) - _TOLD} more"]
    if usual.said.get("answer") != now.said.get("answer"):
        return ", ".join(said)
    if abs(now.probability - usual.probability) >= _NOTED:
        said.append(f"probability {usual.probability:.2f} to {now.probability:.2f}")
    if len(now.numbers) != len(usual.numbers):
        return ", ".join([*said, f"{len(usual.numbers)} unknowns become {len(now.numbers)}"])
    moved = float(np.max(np.abs(now.numbers - usual.numbers) / usual.deviation, initial=0.0))
    if moved >= _MOVED:
        of_result = f"unknowns by {moved:.1f} deviations"
        said.append(of_result if "answer" in usual.said else f"samples or noise by {10 * moved:.0f} %")
    wider = now.deviation / usual.deviation - 1.0
    if "answer" in usual.said and np.abs(wider).max(initial=0.0) >= _MOVED:
        said.append(f"intervals by {100 * wider[np.abs(wider).argmax()]:+.0f} %")
    return ", ".join(said)


if __name__ == "__main__":
    main()
