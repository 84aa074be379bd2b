"""What holds for importers of every kind of file: what cannot be imported, damaged files, the command line."""

import sys

import numpy as np
import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("mcap")
pytest.importorskip("hypothesis")
pytest.importorskip("c3d")
pytest.importorskip("h5py")
import hypothesis
from hypothesis import strategies as st

from benchmarks.fuzz_recordings import mutated, outcome, readers, write_lerobot
from soro_bench.cli import main
from soro_bench.recording.importers import import_recording
from soro_bench.recording.parquet import load
from soro_bench.recording.recording import RecordingError


def test_what_cannot_be_imported(tmp_path):
    write_lerobot(tmp_path / "set")
    with pytest.raises(RecordingError, match="no episode 7"):
        import_recording(tmp_path / "set", episode=7)
    with pytest.raises(RecordingError, match=r"expected \.csv"):
        import_recording(tmp_path / "a.pickle")
    with pytest.raises(RecordingError, match="needs a mapping"):
        import_recording(tmp_path / "a.csv")
    with pytest.raises(RecordingError, match="has no episodes"):
        import_recording(tmp_path / "a.csv", episode=1)
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match=r"info\.json"):
        import_recording(tmp_path / "empty")


def test_command_line(tmp_path, monkeypatch, capsys):
    """Import and record write files that can be read; what is wrong takes one line."""

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["soro-bench", *map(str, words)])
        main()

    (tmp_path / "a.csv").write_text("t,f\n0,1\n1,2\n")
    (tmp_path / "a.toml").write_text('[time]\ncolumn = "t"\n[signals.f]\ncolumns = ["f"]\nunit = "N"\n')
    run("import", tmp_path / "a.csv", "--mapping", tmp_path / "a.toml", "--out", tmp_path / "a.parquet")
    assert load(tmp_path / "a.parquet").names == ["f"]
    run(
        "record", "TrunkReach-v0", "--policy", "random", "--model", "cable", "--steps", 3, "--params", "trunk_mass=0.3",
        "damping=0.05", "--noise", 0.0005, "--out", tmp_path / "b.parquet",
    )  # fmt: skip
    recording = load(tmp_path / "b.parquet")
    assert recording.parameters["trunk_mass"] == 0.3
    assert recording.metadata["noise"] == "0.0005"
    run("view", tmp_path / "b.parquet", "--no-open")
    assert (tmp_path / "b.rrd").stat().st_size > 10_000
    with pytest.raises(SystemExit, match="is of no environment that could be simulated"):
        run("view", tmp_path / "a.parquet", "--no-open")


@pytest.fixture(scope="module")
def kinds(tmp_path_factory):
    """The valid content of each kind of file, its path and its reader."""
    files = readers(tmp_path_factory.mktemp("fuzz"))
    return {name: (path.read_bytes(), path, read) for name, (path, read) in files.items()}


@pytest.mark.parametrize(
    "kind",
    [
        "native",
        "csv",
        "mapping",
        "npz",
        "npz array",
        "mcap",
        "mcap lz4",
        "mcap cdr",
        "db3",
        "bag",
        "bag metadata",
        "lerobot",
        "lerobot info",
        "c3d",
        "trc",
        "mat 7.3",
    ],
)
@hypothesis.settings(max_examples=200, deadline=None, derandomize=True, database=None)
@hypothesis.given(seed=st.integers(0, 2**32 - 1))
def test_damaged_files(kinds, kind, seed):
    """Only a RecordingError comes of a damaged file, if it is damaged at all."""
    valid, path, read = kinds[kind]
    try:
        outcome(path, read, mutated(valid, np.random.default_rng(seed)))
    finally:
        path.write_bytes(valid)
