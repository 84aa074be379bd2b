"""Importers of every kind of file: entries of a mapping, what is refused, damaged files, the command line."""

import sys
import tomllib

import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("mcap")
pytest.importorskip("hypothesis")
pytest.importorskip("c3d")
pytest.importorskip("h5py")

import hypothesis
import numpy as np
from hypothesis import strategies as st

from benchmarks.fuzz_recordings import mutated, outcome, readers, write_lerobot
from soro_bench.cli import main
from soro_bench.recording.importers import guess_mapping, import_recording
from soro_bench.recording.importers.clock import of_day
from soro_bench.recording.importers.wraps import saw_period
from soro_bench.recording.parquet import load
from soro_bench.recording.recording import NOTES, Recording, RecordingError
from tests.arm import says


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


CLOCK = '[time]\ncolumn = "t"\n'
F = '[signals.f]\ncolumns = ["f"]\nunit = "N"\n'


@pytest.fixture
def read(tmp_path):
    """Reads a table with a mapping, both given as text."""

    def read(table: str, mapping: str) -> Recording:
        (tmp_path / "a.csv").write_text(table)
        (tmp_path / "a.toml").write_text(mapping)
        return import_recording(tmp_path / "a.csv", tmp_path / "a.toml")

    return read


@pytest.mark.parametrize(
    ("time", "expected"),
    [("interval = 10\nunit = 'ms'", 0.01), ("interval = 0.5", 0.5), ("rate = 50", 0.02)],
)
def test_rows_are_counted_in_the_unit_of_time_or_by_a_rate(read, time, expected):
    np.testing.assert_allclose(read("f\n1\n2\n3\n", f"[time]\n{time}\n{F}").signals["f"].time, expected * np.arange(3))


@pytest.mark.parametrize(
    ("mapping", "parts"),
    [
        ("[time]\ncolumn = 't'\ninterval = 0.1\n" + F, ("[time]", "column", "interval")),
        ("[time]\nrate = 10\ninterval = 0.1\n" + F, ("[time]", "interval", "rate")),
        ("[time]\nrate = 0\n" + F, ("[time] rate = 0", "positive")),
        ("[time]\nrate = 10\nunit = 'ms'\n" + F, ("[time] unit has no effect", "rate counts rows")),
        ("[time]\nrate = 10\norder = 'sort'\n" + F, ("[time] order has no effect", "rate")),
        ("[time]\nrate = 10\nunits = ['s']\n" + F, ("[time] units has no effect", "rate")),
        ("[time]\nrate = 10\ndate = 'day/month/year'\n" + F, ("[time] date has no effect", "rate")),
        ("[time]\ninterval = inf\n" + F, ("[time] interval = inf", "positive")),
        ("[time]\ncolumns = ['t', 1]\nunits = ['s', 'ns']\n" + F, ("columns", "'t', 1", "each once")),
        (CLOCK + "period = 0.5\n" + F, ("[time] period = 0.5", "span 1")),
        (CLOCK + "order = 'any'\n" + F, ("order = 'any'", "keep_first", "continue")),
        (CLOCK + F + "period = 3\n", ("signals.f", "period has no effect without unwrap")),
        (CLOCK + F + "unwrap = true\n", ("signals.f", "period = ", "'N'")),
        (CLOCK + F + "unwrap = 1\n", ("signals.f", "unwrap = 1", "true or false")),
        (CLOCK + F + "sign = 2\n", ("signals.f", "sign = 2.0", "1 or -1")),
        (CLOCK + F + "scale = [1, 2]\n", ("signals.f", "scale", "(2,)", "()")),
        (CLOCK + F + "scale = [[1], [1, 2]]\n", ("signals.f", "scale", "finite numbers")),
        (CLOCK + F + "leaves = 1\noffset = 1\n", ("signals.f", "offset has no effect beside leaves")),
        (CLOCK + F + "leaves = 1\n", ("signals.f", "leaves makes a command", "[commands.f]")),
        (CLOCK + F + "frame = 'robot'\n", ("signals.f", "frame = 'robot'", '"world"')),
        (CLOCK + F + "rotation = [[1, 0], [0, 1]]\n", ("rotation", "(2, 2)", "quaternion", "rpy")),
        (CLOCK + F + "rotation = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]\n", ("rotation is no rotation", "sign")),
        (CLOCK + F + "rotation = {quaternion = [1, 1, 0, 0]}\n", ("quaternion", "length 1")),
        (CLOCK + F + "rotation = {rpy = [0, 0, 90]}\n", ("rotation", "unit")),
        (CLOCK + F + "rotation = {quaternion = [1, 0, 0, 0]}\n", ("signals.f", "three numbers", "[n, 3]")),
    ],
)
def test_entries_that_contradict_each_other_or_do_nothing_are_refused_by_name(read, mapping, parts):
    with pytest.raises(RecordingError, match=says(*parts)):
        read("t,f\n0,1\n1,2\n", mapping)


def test_scale_sign_and_offset_of_each_number(read):
    mapping = (
        CLOCK + '[signals.q]\ncolumns = ["a", "b"]\nunit = "mm"\nscale = [2, 3]\nsign = [1, -1]\noffset = [0, 1]\n'
    )
    np.testing.assert_allclose(read("t,a,b\n0,10,20\n", mapping).signals["q"].values, [[0.02, 0.94]])


@pytest.mark.parametrize(
    "rotation",
    [
        "[[0, -1, 0], [1, 0, 0], [0, 0, 1]]",
        "{quaternion = [0.70710678, 0, 0, 0.70710678]}",
        '{rpy = [0, 0, 90], unit = "deg"}',
    ],
)
def test_a_rotation_takes_positions_into_the_frame(read, rotation):
    """A quarter turn about z takes x to y; the offset is in the frame."""
    place = (
        f'[signals.m]\ncolumns = ["a", "b", "c", "d", "e", "f"]\nunit = "m"\nshape = [2, 3]\nrotation = {rotation}\n'
    )
    values = read("t,a,b,c,d,e,f\n0,1,0,0,0,2,3\n", CLOCK + place + "offset = [0, 0, 1]\n").signals["m"].values
    np.testing.assert_allclose(values, [[[0, 1, 1], [-2, 0, 4]]], atol=1e-7)


def test_roll_pitch_and_yaw_turn_about_fixed_axes(read):
    """Roll takes y to z, and then pitch takes z to x."""
    place = '[signals.m]\ncolumns = ["a", "b", "c"]\nunit = "m"\nrotation = {rpy = [90, 90, 0], unit = "deg"}\n'
    np.testing.assert_allclose(read("t,a,b,c\n0,0,1,0\n", CLOCK + place).signals["m"].values, [[1, 0, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("cells", "entries", "expected"),
    [
        ("350 358 6 nan 14 2", 'unit = "deg"\nunwrap = true', np.radians([350, 358, 366, np.nan, 374, 362])),
        ("0.4 -0.4 0.3", 'unit = "rev"\nunwrap = true', 2 * np.pi * np.array([0.4, 0.6, 0.3])),
        ("4090 5 4000", 'unit = "1"\nunwrap = true\nperiod = 4096', [4090, 4101, 4000]),
        ("990 5 900", 'unit = "deg"\nscale = -0.36\nunwrap = true', -np.radians([356.4, 361.8, 324.0])),
    ],
)
def test_what_wraps_is_unwrapped(read, cells, entries, expected):
    table = "t,q\n" + "".join(f"{i},{cell}\n" for i, cell in enumerate(cells.split()))
    recording = read(table.replace("nan", "") + "9,\n", f'{CLOCK}[signals.q]\ncolumns = ["q"]\n{entries}\n')
    np.testing.assert_allclose(recording.signals["q"].values, np.array(expected)[~np.isnan(expected)])
    assert "unwrapped" in recording.metadata[NOTES]


def test_an_angle_that_seems_to_wrap_is_said(read):
    table = "t,q\n" + "".join(f"{i},{(300 + 30 * i) % 360}\n" for i in range(20))
    for unit in ("'deg'", "'rad'\nscale = 0.017453292519943295"):
        notes = read(table, CLOCK + f'[signals.q]\ncolumns = ["q"]\nunit = {unit}\n').metadata[NOTES]
        assert notes == "signals.q: jumps of nearly a turn: 2; if the angle wraps, write unwrap = true"
    assert NOTES not in read(table, CLOCK + '[signals.q]\ncolumns = ["q"]\nunit = "mm"\n').metadata


@pytest.mark.parametrize(
    ("counts", "low", "jitter", "said"),
    [
        (4096, 0, 0, "4096"),
        (4096, 0, 40, "4096"),
        (3600, 0, 0, "3600"),
        (2000, -1000, 0, "2000"),
        (65536, -32768, 0, "65536"),
        (3600, 0, 40, "3595 (about; its data sheet says it)"),
    ],
)
def test_a_counter_that_seems_to_wrap_is_said(read, counts, low, jitter, said):
    steps = np.cumsum(counts // 14 + np.random.default_rng(0).integers(0, jitter + 1, 40))
    table = "t,q\n" + "".join(f"{i},{step % counts + low}\n" for i, step in enumerate(steps))
    notes = read(table, CLOCK + '[signals.q]\ncolumns = ["q"]\nunit = "1"\n').metadata[NOTES]
    assert notes.startswith(f"signals.q: jumps of nearly {said.split()[0]}: ")
    assert notes.endswith(f"; if the counter wraps, write unwrap = true and period = {said}")
    square = "t,q\n" + "".join(f"{i},{1000 * (i // 5 % 2)}\n" for i in range(40))
    assert NOTES not in read(square, CLOCK + '[signals.q]\ncolumns = ["q"]\nunit = "1"\n').metadata
    assert NOTES not in read(table, CLOCK + '[commands.q]\ncolumns = ["q"]\nunit = "1"\n').metadata


SLOW = 300 + 2.9 * np.arange(80) + np.random.default_rng(1).normal(0, 0.1, 80)  # deg


@pytest.mark.parametrize(
    ("numbers", "unit", "said"),
    [
        (SLOW / 360 % 1, "1", "jumps of nearly 1: 1; if the counter"),
        (SLOW / 0.9 % 400, "1", "jumps of nearly 400: 1; if the counter"),
        (SLOW / 360 * 4096 % 4096, "1", "jumps of nearly 4096: 1; if the counter"),
        (np.radians(SLOW) % np.pi, "rad", "jumps of nearly 3.141592654: 1; if the angle"),
        (SLOW % 72, "deg", "jumps of nearly 72: 3; if the angle"),
        (np.where(np.arange(80) % 19 == 7, 340, 0) + SLOW % 360, "deg", "jumps of nearly a turn"),
        (np.where(np.arange(80) % 9 == 7, -1, SLOW % 360), "deg", "exactly -1, far from those beside"),
        (np.where(np.arange(80) % 9 == 7, -1, SLOW % 360), "deg", "jumps of nearly a turn: 1"),
        (SLOW % 300, "mm", ""),
        (90 - np.abs(SLOW % 180 - 90), "deg", ""),
    ],
)
def test_wraps_at_other_numbers_or_among_spikes_are_said(read, numbers, unit, said):
    table = "t,q\n" + "".join(f"{i},{number:.6f}\n" for i, number in enumerate(numbers))
    notes = read(table, CLOCK + f'[signals.q]\ncolumns = ["q"]\nunit = "{unit}"\n').metadata.get(NOTES, "")
    assert said in notes if said else not notes


def test_a_command_that_wraps_is_said_and_one_that_jumps_is_not(read):
    jumps = np.repeat([350, 5, 200, 20, 340, 10, 355, 3], 10)
    for goal, said in ((SLOW % 360, True), (jumps, False)):
        table = "t,q\n" + "".join(f"{i},{number:.3f}\n" for i, number in enumerate(goal))
        notes = read(table, CLOCK + '[commands.q]\ncolumns = ["q"]\nunit = "deg"\n').metadata.get(NOTES, "")
        assert ("commands.q: jumps of nearly a turn: 1" in notes) == said


def test_an_encoder_that_wraps_at_a_part_of_a_turn_is_unwrapped_there_or_asked_about(read, tmp_path):
    turning = 200 + 3.7 * np.arange(200)
    table = "t,q_deg\n" + "".join(f"{i},{number:.3f}\n" for i, number in enumerate(turning % 300))
    mapping = CLOCK + '[signals.q]\ncolumns = ["q_deg"]\nunit = "deg"\n'
    assert "unwrap = true and period = 300" in read(table, mapping).metadata[NOTES]
    wrong = read(table, mapping + "unwrap = true\n")
    assert "wraps at 360 that are unwrapped: 3; steps of 0.18 of a period are left" in wrong.metadata[NOTES]
    guess = guess_mapping(tmp_path / "a.csv")
    found = import_recording(tmp_path / "a.csv", tomllib.loads(guess)).signals["q"].values
    np.testing.assert_allclose(np.degrees(found), turning, atol=0.01)


@pytest.mark.parametrize("second", [30.0, 100.0, -170.0])
def test_relative_angles_that_wrap_begin_within_half_a_turn(read, second):
    table = "t,a,b\n" + "".join(f"{i},{angle % 360:.4f},{(angle + second) % 360:.4f}\n" for i, angle in enumerate(SLOW))
    signal = read(table, CLOCK + '[signals.q]\ncolumns = ["a", "b"]\nunit = "deg"\nunwrap = true\nrelative = true\n')
    np.testing.assert_allclose(np.degrees(signal.signals["q"].values[:, 1]), second, atol=1e-3)


@pytest.mark.parametrize(
    ("number", "center", "lost", "asked"),
    [
        (9999, 0, 1, True),
        (-999.25, 0, 1, True),
        (3.402823e38, 20, 3, True),
        (9999, 0, 20, True),
        (-1, 20, 1, True),
        (0, 20, 1, True),
        (-1, 20, 5, False),
        (0, 20, 5, False),
        (0, 0, 1, False),
        (-1.2345, 20, 1, False),
    ],
)
def test_numbers_that_seem_to_stand_for_missing_ones_are_asked_about(read, number, center, lost, asked):
    """Very far ones, and others that stand there shortly; 0 may be a number like others."""
    x = np.round(center + 9 * np.sin(0.1 * np.arange(200)) + np.random.default_rng(0).normal(0, 0.01, 200), 4)
    x[(np.arange(200) % 80 > 0) & (np.arange(200) % 80 <= lost)] = number
    table = "t,q\n" + "".join(f"{i},{each}\n" for i, each in enumerate(x))
    notes = read(table, CLOCK + '[signals.q]\ncolumns = ["q"]\nunit = "mm"\n').metadata.get(NOTES, "")
    assert (f"write missing = [{number:.10g}]" in notes) == asked


@pytest.mark.filterwarnings("error")
def test_a_period_is_seen_beside_a_column_without_numbers_and_huge_numbers_give_none():
    saw = 1.3 * np.arange(100) % 7
    assert saw_period(np.stack([saw, np.full(100, np.nan)], axis=1)).counts == pytest.approx(7)
    assert saw_period(np.where(saw > 3, 1e308, -1e308)) is None


def test_a_motion_of_few_large_steps_does_not_wrap(read, tmp_path):
    """Such as of a sensor that holds its values; each goes on a little before and after it comes back."""
    angle = np.repeat([0.0, 0.1, 0.2, 0.3, 0.4, -0.5, -0.4, -0.3, -0.2, -0.1, 0.0, 0.1, -0.75], 5)
    for unit, numbers in (("rad", angle), ("1", 1000 * angle)):
        table = f"t,q_{unit}\n" + "".join(f"{i},{number:g}\n" for i, number in enumerate(numbers))
        recording = read(table, CLOCK + f'[signals.q]\ncolumns = ["q_{unit}"]\nunit = "{unit}"\n')
        assert "wrap" not in recording.metadata.get(NOTES, "") + guess_mapping(tmp_path / "a.csv")


def test_lost_numbers_of_a_counter_are_no_wraps(read):
    counts = np.where(np.arange(200) % 90 == 60, 0, 3000 + 2 * np.arange(200))
    table = "t,q\n" + "".join(f"{i},{each}\n" for i, each in enumerate(counts))
    assert NOTES not in read(table, CLOCK + '[signals.q]\ncolumns = ["q"]\nunit = "1"\n').metadata


@pytest.mark.parametrize(
    ("first", "step", "said"),
    [(0, 10, "it lasts 1000 times as long as"), (0, 0.01, ""), (-5, 0.01, "begins 5 s before the first signal"),
     (-0.5, 0.01, "")],
)  # fmt: skip
def test_a_command_of_another_pace_or_from_long_before_is_asked_about(read, first, step, said):
    rows = "".join(f"{0.01 * i:.2f},{i},{first + step * i if i else first},{i // 9}\n" for i in range(100))
    u = '[commands.u]\ncolumns = ["u"]\ntime = "tu"\nunit = "1"\n'
    notes = read("t,f,tu,u\n" + rows, CLOCK + F + u).metadata.get(NOTES, "")
    assert said in notes if said else not notes


BACK = "t,f\n0,0\n1,1\n2,2\n1,3\n2,4\n3,5\n"


@pytest.mark.parametrize(
    ("table", "order", "time", "values"),
    [
        (BACK, "keep_first", [0, 1, 2, 3], [0, 1, 2, 5]),
        (BACK, "keep_last", [0, 1, 2, 3], [0, 3, 4, 5]),
        (BACK, "sort", [0, 1, 2, 3], [0, 3, 4, 5]),
        (BACK, "continue", [0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5]),
        ("t,f\n0,0\n1,1\n1,2\n2,3\n", "keep_first", [0, 1, 2], [0, 1, 3]),
        ("t,f\n0,0\n1,1\n1,2\n2,3\n", "keep_last", [0, 1, 2], [0, 2, 3]),
    ],
)
def test_stamps_that_repeat_or_go_back(read, table, order, time, values):
    """They are refused in one line that says what to write, unless the mapping says what to do."""
    with pytest.raises(RecordingError, match=says("signals.f: time does not increase in line", "order = ", order)):
        read(table, CLOCK + F)
    recording = read(table, f'{CLOCK}order = "{order}"\n{F}')
    np.testing.assert_allclose(recording.signals["f"].time, time)
    np.testing.assert_allclose(recording.signals["f"].values, values)
    assert ("steps back of its clock: 1," if order == "continue" else "signals.f: ") in recording.metadata[NOTES]


def test_stamps_are_looked_at_after_cutting(read):
    """Until a time is until the file first reaches it."""
    assert read(BACK, CLOCK + "until = 1.5\n" + F).signals["f"].values.tolist() == [0, 1]
    assert read(BACK, CLOCK + "until = 2\n" + F).signals["f"].values.tolist() == [0, 1]
    with pytest.raises(RecordingError, match="line 5"):
        read(BACK, CLOCK + "until = 2.5\n" + F)


@pytest.mark.parametrize(("bits", "first"), [(32, 2**32 - 25), (16, 2**16 - 25), (32, 2**31 - 25)])
def test_a_counter_that_overflows_is_unwrapped_and_said(read, bits, first):
    """Unsigned, and signed ones that go on from below zero."""
    low = -(2**31) if first < 2**31 and bits == 32 else 0
    table = "t,f\n" + "".join(f"{(first - low + 10 * i) % 2**bits + low},{i}\n" for i in range(6))
    recording = read(table, CLOCK + 'unit = "ms"\n' + F)
    np.testing.assert_allclose(recording.signals["f"].time, 0.01 * np.arange(6), atol=1e-9)
    assert f"a clock of {bits} bits that are unwrapped: 1" in recording.metadata[NOTES]


@pytest.mark.parametrize(("begin", "moved"), [(2, False), (6, True)])
def test_a_second_clock_that_begins_after_the_overflow_of_the_first_goes_on_with_it(read, begin, moved):
    stamps = [(2**32 - 45_000 + 10_000 * i) % 2**32 for i in range(10)]
    table = "t,f,tu,u\n" + "".join(
        f"{stamp},{i},{f'{(stamp + 500) % 2**32},{i}' if i >= begin else ','}\n" for i, stamp in enumerate(stamps)
    )
    recording = read(table, CLOCK + 'unit = "us"\n' + F + '[commands.u]\ncolumns = ["u"]\ntime = "tu"\nunit = "1"\n')
    np.testing.assert_allclose(recording.signals["f"].time, 0.01 * np.arange(10), atol=1e-9)
    np.testing.assert_allclose(recording.commands["u"].time, 0.01 * np.arange(begin, 10) + 0.0005, atol=1e-9)
    assert ("overflowed before its first sample" in recording.metadata[NOTES]) == moved


@pytest.mark.parametrize("stamps", ["58,59,0,1", "6.51,6.53,0.01", "990,995,0,5"])
def test_a_clock_that_begins_anew_at_another_number_is_told_about_period(read, stamps):
    table = "t,f\n" + "".join(f"{stamp},0\n" for stamp in stamps.split(","))
    with pytest.raises(RecordingError, match=says("order = ", "period = ")):
        read(table, CLOCK + F)


@pytest.mark.parametrize("first", [86_399, 86_395, 45_000, 59])
def test_numbers_of_hours_minutes_and_seconds_are_read_as_such_and_said(read, first):
    """As GPS receivers write them, also over midnight; without a new minute they are seconds anyway."""
    since = first + 0.25 * np.arange(40)
    stamps = [f"{t // 3600 % 24:02.0f}{t // 60 % 60:02.0f}{t % 60:05.2f}" for t in since]
    recording = read("t,f\n" + "".join(f"{t},1\n" for t in stamps), CLOCK + F)
    np.testing.assert_allclose(recording.signals["f"].time, since - first)
    assert ("hours, minutes and seconds" in recording.metadata.get(NOTES, "")) == (first != 45_000)


def test_a_missing_one_among_such_numbers_changes_no_others():
    for numbers, note in ((np.array([59.0, np.nan, 59.5, 100.0, 100.5]), True), (np.array([0.0, np.nan, 1.0]), False)):
        found, said = of_day(numbers)
        np.testing.assert_allclose(found, numbers - 40 * (numbers >= 100))
        assert bool(said) == note


@pytest.mark.parametrize("stamps", [np.arange(0, 3000, 100.0), np.r_[0:59, 300:350], np.arange(200.0)])
def test_other_seconds_are_no_hours_and_minutes(read, stamps):
    recording = read("t,f\n" + "".join(f"{t},1\n" for t in stamps), CLOCK + F)
    np.testing.assert_allclose(recording.signals["f"].time, stamps)


def test_a_clock_of_another_period_is_unwrapped_on_request(read):
    recording = read("t,f\n58,0\n59,1\n0,2\n1,3\n", CLOCK + "period = 60\n" + F)
    np.testing.assert_allclose(recording.signals["f"].time, range(4))


def test_a_unit_of_time_that_no_robot_has_is_asked_for(read):
    table = "t,f\n" + "".join(f"{10_000 * i},{i}\n" for i in range(20))
    assert read(table, CLOCK + F).metadata[NOTES] == "signals.f: a sample every 10000 s; is the unit of time right?"
    assert NOTES not in read(table, CLOCK + "unit = 'us'\n" + F).metadata
    assert "a sample every 10 s" in read(table, CLOCK + "unit = 'ms'\n" + F).metadata[NOTES]
    assert "a sample every 1e-05 s" in read(table, CLOCK + "unit = 'ns'\n" + F).metadata[NOTES]
    table = "t,f\n" + "".join(f"{1_719_433_753_000 + 10 * (i + 360_000 * (i > 9))},{i}\n" for i in range(20))
    notes = read(table, CLOCK + F).metadata[NOTES]
    assert "[time]: begins at 1.72e+12 s; is the unit of time right?" in notes
    notes = read(table, CLOCK + "unit = 'ms'\n" + F).metadata[NOTES]
    assert notes == "signals.f: nothing came for 3.6e+03 s, 0.09 s after its first sample; [time] begin and until cut"


@pytest.mark.parametrize(
    ("name", "unit"),
    [("time_usec", "us"), ("t_millis", "ms"), ("timeMs", "ms"), ("TimeUS", "us"), ("time/ms", "ms"), ("t.us", "us"),
     ("t \u00b5s", "us"),
     ("time-ms", "ms"), ("ms since start", "ms"), ("millis()", "ms"), ("time_nsec", "ns"), ("t_minutes", "min"),
     ("sec_nanosec", ""), ("status", "")],
)  # fmt: skip
def test_a_unit_in_the_name_of_times_is_asked_for_where_the_mapping_has_none(read, name, unit):
    x = '[signals.x]\ncolumns = ["x"]\nunit = "mm"\n'
    table, mapping = f"{name},x\n0,1\n10,2\n", f'[time]\ncolumn = "{name}"\n'
    if not unit:
        assert read(table, mapping + x).signals["x"].time.tolist() == [0, 10]
        return
    with pytest.raises(RecordingError, match=says(f"says {unit}", f'unit = "{unit}"')):
        read(table, mapping + x)
    parts, units = f"s,{name},x\n0,0,1\n1,0,2\n", f'[time]\ncolumns = ["s", "{name}"]\nunits = ["s", "h"]\n'
    assert f"says {unit}" in read(parts, units + x).metadata[NOTES]


def test_a_unit_that_the_header_contradicts_is_said_and_a_mapping_is_utf_8(read, tmp_path):
    mapping = CLOCK + F.replace('["f"]', '["f [mN]"]')
    said = "signals.f: unit = 'N', and the name 'f [mN]' says mN; which one is right?"
    assert read("t,f [mN]\n0,1\n1,2\n", mapping).metadata[NOTES] == said
    (tmp_path / "a.toml").write_bytes(mapping.encode("utf-8-sig"))
    assert import_recording(tmp_path / "a.csv", tmp_path / "a.toml").metadata[NOTES] == said
    (tmp_path / "a.toml").write_bytes(mapping.encode("utf-16"))
    with pytest.raises(RecordingError, match=says("a.toml", "line 1", "save it as UTF-8")):
        import_recording(tmp_path / "a.csv", tmp_path / "a.toml")


def test_absolute_angles_become_relative_and_a_measured_command_goes_on_along_a_line(tmp_path):
    (tmp_path / "log.csv").write_text("t,a,b,u\n0,10,30,1\n0.01,20,50,2\n0.05,20,40,4\n")
    found = import_recording(
        tmp_path / "log.csv",
        {
            "time": {"column": "t"},
            "commands": {"u": {"columns": ["u"], "unit": "1", "interpolate": 0.01}},
            "signals": {"angles": {"columns": ["a", "b"], "unit": "deg", "relative": True}},
        },
    )
    np.testing.assert_allclose(np.degrees(found.signals["angles"].values), [[10, 20], [20, 30], [20, 20]])
    np.testing.assert_allclose(found.commands["u"].time, 0.01 * np.arange(6), atol=1e-9)
    np.testing.assert_allclose(found.commands["u"].values, [1, 2, 2.5, 3, 3.5, 4])
    with pytest.raises(RecordingError, match="interpolate = 1e-09 makes 50000000 samples; 1000000 are allowed"):
        import_recording(
            tmp_path / "log.csv",
            {"time": {"column": "t"}, "commands": {"u": {"columns": ["u"], "unit": "1", "interpolate": 1e-9}}},
        )
