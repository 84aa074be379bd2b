"""Halve and double every setting that no case shows, and record which test of known answers fails.

    python benchmarks/settings_tests.py [--stages data_quality paired ...]
    python docs/generate.py

The command goes on with settings that change nothing so far in docs/results/measured.json
(diagnosis_settings.py), and with those of the robots, which no diagnosis changes. The tests run once, each with a note
of the settings that it reads. Then they run for every such setting, those that read it, the shortest first and up to
the first that fails, in a process of its own in which the setting has another default.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import mujoco  # noqa: F401  before the process is copied, as it takes long to import
import pytest
import scipy.stats  # noqa: F401

from soro_bench.diagnosis.settings import DEFAULT, RobotSettings, listed
from soro_bench.files import read_json, write_json

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results" / "measured.json"
FACTORS = {"halved": 0.5, "doubled": 2.0}
FILES = (
    "custom_laws", "data_quality", "model_probabilities", "model_robot", "moves", "paired", "replay_check", "search",
    "settings", "told_and_telling",
)  # fmt: skip
LONGEST, TOGETHER = 30.0, 60.0  # s of a test, and of all that run for a setting
ROBOTS = "robots"  # a group that Settings does not hold
_UNREAD = "listed", "replace", "_replace", "asdict", "_asdict_inner", "__eq__", "__repr__"  # copy, compare or show
Groups = dict[str, Any]  # settings by the names of their stages


def main() -> None:
    """Vary the settings that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    groups = {**DEFAULT.groups(), ROBOTS: RobotSettings()}
    parser.add_argument("--stages", nargs="*", choices=groups, help="groups of settings, such as paired; else all")
    asked = parser.parse_args().stages or [*groups]
    measured = read_json(RESULTS)
    known, done = measured["settings_sensitivity"], measured["settings_cases"].setdefault("tests", [])
    names = [f"{group}.{each[1]}" for group in asked for each in listed(group, groups[group])]
    idle = [key for key in names if key not in done and not any(known.get(key, {}).values())]
    readers = tests_that_read(groups)
    for key in idle:
        for label, value in values_of(groups, key).items():
            found = failing(groups, readers, key, value)
            texts = known.setdefault(key, {}).setdefault(label, {})
            if found:
                texts["test"] = found
            print(key, label, found or "no change", flush=True)
        done.append(key)
        write_json(RESULTS, measured)


def values_of(groups: Groups, key: str) -> dict[str, Any]:
    """A setting "group.name" halved and doubled."""
    group, name = key.split(".")
    return {label: times(getattr(groups[group], name), factor) for label, factor in FACTORS.items()}


def times(value: Any, factor: float) -> Any:
    """A setting times a factor; whole numbers stay whole."""
    if isinstance(value, tuple):
        return tuple(times(each, factor) for each in value)
    return round(value * factor) if isinstance(value, int) else value * factor


@dataclass(eq=False)  # pytest puts plugins into sets
class Reads:
    """A plugin of pytest that notes which settings each test reads, by itself and by its fixtures.

    by: of every test and fixture. all: that are read when modules are imported. seconds: of every test.
    """

    by: dict[str, set[str]] = field(default_factory=dict)
    all: set[str] = field(default_factory=set)
    fixtures: dict[str, list[str]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    failed: set[str] = field(default_factory=set)
    inside: list[str] = field(default_factory=list)

    def watch(self, group: str, kind: type) -> None:
        """Note reads of settings of a class."""
        names = {each.name for each in fields(kind)}

        def read(settings: Any, attribute: str) -> Any:
            if attribute in names:
                caller = sys._getframe(1).f_code.co_name
                if caller not in _UNREAD:
                    found = self.by.setdefault(self.inside[-1], set()) if self.inside else self.all
                    found.add(f"{group}.{attribute}")
            return object.__getattribute__(settings, attribute)

        kind.__getattribute__ = read  # type: ignore[method-assign, assignment]

    @contextmanager
    def _during(self, name: str) -> Iterator[None]:
        self.inside.append(name)
        try:
            yield
        finally:
            self.inside.pop()

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """What a fixture reads."""
        with self._during(f"fixture {fixturedef.argname}"):
            return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """What a test reads, and how long it takes."""
        self.fixtures[item.nodeid] = [f"fixture {name}" for name in getattr(item, "fixturenames", ())]
        start = time.perf_counter()
        with self._during(item.nodeid):
            result = yield
        self.seconds[item.nodeid] = time.perf_counter() - start
        return result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Which tests fail as it is; they tell nothing."""
        if report.failed:
            self.failed.add(report.nodeid)

    def readers(self) -> dict[str, list[str]]:
        """Of every setting the tests that read it, the shortest first."""
        found: dict[str, list[str]] = {}
        for test in sorted(self.seconds, key=lambda test: self.seconds[test]):
            if self.seconds[test] > LONGEST or test in self.failed:
                continue
            of_fixtures = (self.by.get(name, set()) for name in self.fixtures[test])
            for key in self.by.get(test, set()).union(self.all, *of_fixtures):
                found.setdefault(key, []).append(test)
        return {key: self._of_time(tests) for key, tests in found.items()}

    def _of_time(self, tests: Sequence[str]) -> list[str]:
        """As many as run in time."""
        total, chosen = 0.0, []
        for test in tests:
            total += self.seconds[test]
            if total < TOGETHER:
                chosen.append(test)
        return chosen


@dataclass(eq=False)
class Failures:
    """A plugin of pytest that notes the first test that fails."""

    first: str = ""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note it."""
        if report.failed and not self.first:
            self.first = report.nodeid.split("::")[-1]


def tests_that_read(groups: Groups) -> dict[str, list[str]]:
    """Of every setting the tests that read it, the shortest first."""

    def run() -> dict[str, list[str]]:
        reads = Reads()
        for group, settings in groups.items():
            reads.watch(group, type(settings))
        pytest.main(["-q", "-p", "no:cacheprovider", *files()], plugins=[reads])
        return reads.readers()

    return dict(apart(run))


def files() -> list[str]:
    """Paths of the tests."""
    return [str(path) for name in FILES if (path := ROOT / "tests" / f"test_{name}.py").exists()]


def failing(groups: Groups, readers: dict[str, list[str]], key: str, value: Any) -> str:
    """The first test that fails with another default, or why that one is refused; else nothing."""
    if key not in readers:
        return ""
    group, name = key.split(".")
    try:
        type(groups[group])(**{name: value})
    except ValueError as error:
        return f"refused, {error}"

    def run() -> str:
        set_default(groups[group], name, value)
        failures = Failures()
        pytest.main(["-qx", "-p", "no:cacheprovider", *readers[key]], plugins=[failures])
        return failures.first

    return str(apart(run))


def set_default(settings: Any, name: str, value: Any) -> None:
    """Change a default, of settings to come and of those that are there."""
    kind = type(settings)
    kind.__init__.__defaults__ = tuple(value if each.name == name else each.default for each in fields(kind))
    object.__setattr__(settings, name, value)


def apart(run: Callable[[], Any]) -> Any:
    """What a function returns in a copy of this process, which prints nothing."""
    with tempfile.NamedTemporaryFile() as file:
        sys.stdout.flush()
        if not (child := os.fork()):
            status = 1
            try:
                os.chdir(ROOT)
                for stream in (1, 2):
                    os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
                Path(file.name).write_text(json.dumps(run()))
                status = 0
            finally:
                os._exit(status)
        if os.waitpid(child, 0)[1]:
            raise RuntimeError("the tests have ended the process in which they ran")
        return json.loads(Path(file.name).read_text())


if __name__ == "__main__":
    main()
