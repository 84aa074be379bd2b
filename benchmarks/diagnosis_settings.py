"""Halve and double every setting of the diagnosis, and record what changes.

    python benchmarks/diagnosis_settings.py [--anew] [--stages selection fit ...]
    python docs/generate.py

The first command takes an hour of one core and can be stopped: it goes on with what docs/results/measured.json lacks,
or begins again with --anew. The second one writes docs/reference/settings.md.

The cases (settings_cases.py) come one after the other, quick ones first, and a setting is varied until it changes
something. Each case runs once as it is, and once with settings that note when they are read. Where one is first read,
the process is copied: the copy goes on with the setting halved or doubled, and all that was done before counts for it
too. What no case shows, the tests of its stage may need (settings_tests.py).
"""

import argparse
import json
import os
import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.settings_cases import CaseRun, Groups, Outcome, cases
from benchmarks.settings_tests import FACTORS, RESULTS, apart, values_of
from soro_bench.diagnosis.settings import DEFAULT, listed
from soro_bench.files import read_json, write_json

ENDLESS = 10.0  # times as long as with default settings, of a run that is stopped
_NOTED = 0.01  # of a probability, from which a change is noted
_MOVED = 0.1  # posterior standard deviations of an unknown, and share of that deviation, likewise
_FIGURE = 0.1  # share of a figure, likewise
_TOLD = 2  # changes of one case that are told, beside the number of others


def main() -> None:
    """Vary the settings that are asked for in all cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stages", nargs="*", help="groups of settings, such as selection; all by default")
    parser.add_argument("--anew", action="store_true", help="forget what was measured of these groups")
    options = parser.parse_args()
    defaults = DEFAULT.groups()
    if unknown := sorted({*(options.stages or [])} - {*defaults}):
        parser.error(f"no group {unknown[0]}; there are {', '.join(defaults)}")
    groups = options.stages or [*defaults]
    measured = read_json(RESULTS)
    known, done = measured["settings_sensitivity"], measured.setdefault("settings_cases", {})
    names = [f"{group}.{each[1]}" for group, settings in defaults.items() for each in listed(group, settings)]
    forgotten = {key for key in known if key not in names or (options.anew and key.split(".")[0] in groups)}
    for key in forgotten:
        del known[key]

    def seen(key: str) -> bool:
        """Whether a setting changes something."""
        return any(known.get(key, {}).values())

    def prune() -> None:
        """Keep for every case only the settings that have changed nothing anywhere."""
        done.update({case: [key for key in keys if key in known and not seen(key)] for case, keys in done.items()})

    prune()
    asked = [key for key in names if key.split(".")[0] in groups]

    def idle(case: str, without: Sequence[str] = ()) -> list[str]:
        """Settings to vary in a case."""
        return [
            key
            for key in asked
            if not seen(key) and key not in done.setdefault(case, []) and key.split(".")[0] not in without
        ]

    def note(case: str, keys: Sequence[str], found: dict[str, str]) -> None:
        """Write what a case has shown."""
        for key in keys:
            for label in FACTORS:
                texts = known.setdefault(key, {}).setdefault(label, {})
                if text := found.get(f"{key} {label}"):
                    texts[case] = text
                    print(key, label, case, text, flush=True)
        done[case] += keys
        prune()
        write_json(RESULTS, measured)

    with tempfile.TemporaryDirectory() as folder:
        for name, case in cases(Path(folder)).items():
            if keys := idle(name, case.without):
                print(f"{name}: {len(keys)} settings", flush=True)
                note(name, keys, apart(partial(vary, case.build, defaults, keys, Path(folder))))


@dataclass
class Copies:
    """Settings, and a copy of the process for each that is varied.

    keys: "group.name" of settings to vary. folder: of the outcomes. seconds: after which a copy is stopped. found: what
    is said of those that are refused or stopped. copied: which setting this process varies, if it is a copy.
    """

    defaults: Groups
    keys: Sequence[str]
    folder: Path
    seconds: float
    found: dict[str, str] = field(default_factory=dict)
    copied: Path | None = None
    read: set[str] = field(default_factory=set)
    watching: bool = False

    def groups(self) -> Groups:
        """The same settings, but for that they are varied when they are first read."""
        groups = {name: self._watched(name, group) for name, group in self.defaults.items()}
        self.watching = True
        return groups

    def _watched(self, group: str, settings: Any) -> Any:
        kind, names = type(settings), {each.name for each in fields(settings)}

        def read(watched: Any, attribute: str) -> Any:
            key = f"{group}.{attribute}"
            if attribute in names and self.watching and not self.copied and key not in self.read:
                self.read.add(key)
                if key in self.keys:
                    self._vary(key, watched)
            return object.__getattribute__(watched, attribute)

        return type(kind.__name__, (kind,), {"__getattribute__": read})(**asdict(settings))

    def _vary(self, key: str, watched: Any) -> None:
        """Copy the process once for each factor; a copy returns with another value."""
        group, name = key.split(".")
        for label, value in values_of(self.defaults, key).items():
            try:
                replace(self.defaults[group], **{name: value})
            except ValueError as error:
                self.found[f"{key} {label}"] = f"refused, {error}"
                continue
            path = self.folder / f"{key} {label}.json"
            path.unlink(missing_ok=True)
            if not (child := os.fork()):
                self.copied = path
                object.__setattr__(watched, name, value)
                signal.alarm(int(self.seconds))
                return
            os.waitpid(child, 0)
            if not path.exists():
                self.found[f"{key} {label}"] = "does not end"


def vary(build: Callable[[], CaseRun], defaults: Groups, keys: Sequence[str], folder: Path) -> Groups:
    """What changes in a case by each setting halved and doubled ("group.name halved"); none of those not read."""
    start, run = time.perf_counter(), build()
    usual = run(defaults, lambda stage: None)
    copies = Copies(defaults, keys, folder, ENDLESS * (time.perf_counter() - start) + 60.0)
    try:
        outcome = asdict(run(copies.groups(), lambda stage: None))
    except (ValueError, ArithmeticError, LookupError, TypeError, np.linalg.LinAlgError) as error:
        if not copies.copied:
            raise
        outcome = {"refused": f"refused: {error}".split("\n")[0][:80]}
    if copies.copied:
        write_json(copies.copied, {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in outcome.items()})
        os._exit(0)
    found: Groups = dict(copies.found)
    for key in keys:
        for label in FACTORS:
            path = folder / f"{key} {label}.json"
            if path.exists():
                found[f"{key} {label}"] = changed(json.loads(path.read_text()), usual)
                path.unlink()
    return found


def changed(outcome: dict[str, Any], usual: Outcome) -> str:
    """What changes in a case; nothing where all that is said, its probability and the unknowns stay."""
    if "refused" in outcome:
        return str(outcome["refused"])
    now = Outcome(**{**outcome, **{name: np.array(outcome[name]) for name in ("numbers", "deviation")}})
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
    for name, before in usual.figures.items():
        if abs((after := now.figures.get(name, 0.0)) - before) > _FIGURE * abs(before):
            said.append(f"{name} {before:.2g} to {after:.2g}")
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
