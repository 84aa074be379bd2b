"""Tables on a console of 80 columns."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun", reason="needs the train extra")

from soro_bench.commands.recording import _describe
from soro_bench.progress import console
from soro_bench.recording.recording import Recording, Signal
from soro_bench.registration import ENV_IDS, task_type


@pytest.fixture(autouse=True)
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "width", 80)


def test_a_recording_is_described_without_a_cut_cell(capsys):
    time = np.arange(3.0)
    values = np.array([-0.00012345, 7.891e-05, np.nan])
    plain = {name: Signal(time, values, "m/s^2", "world") for name in ("link_quaternion", "object_quaternion")}
    _describe(Recording({"action": Signal(time, np.zeros((3, 8)))}, plain), Path("a.parquet"))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    header = lines[1].split()
    assert header == ["signal", "samples", "per", "s", "shape", "unit", "frame", "least", "largest", "gaps"]
    assert lines[-1].split() == ["object_quaternion", "3", "1", "m/s^2", "world", "-0.0001234", "7.891e-05", "1"]
    assert lines[3].split() == ["action", "3", "1", "8", "1", "0", "0"]


def test_a_long_name_goes_on_in_the_next_line(capsys):
    signals = {"q" * 64: Signal(np.arange(100_000.0), np.full((100_000, 2, 2), -1.234e-5), "y" * 32, "Z" * 32)}
    _describe(Recording({}, signals), Path("a.parquet"))
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert (text.count("q"), text.count("y"), text.count("Z")) == (64 + text.split("signal")[0].count("q"), 32, 32)
    assert "…" not in text


def test_the_list_of_environments_has_every_cell(call):
    text = call("list")
    assert max(map(len, text.splitlines())) <= 80
    for parameter in (p for env_id in ENV_IDS for p in task_type(env_id).parameters.parameters.values()):
        row = next(line for line in text.splitlines() if line.split()[:1] == [parameter.name])
        assert "{:g} .. {:g}".format(*parameter.bounds) in row and "{:g} .. {:g}".format(*parameter.search) in row
        assert set(parameter.meaning.split()) <= set(text.split())
