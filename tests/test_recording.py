"""Recordings: their file, what is refused, and simulated episodes recorded and replayed."""

import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

from soro_bench.recording import comparison
from soro_bench.recording.excitation import excitation, shortest
from soro_bench.recording.recording import SCHEMA, Recording, RecordingError, Signal, resampled
from soro_bench.recording.simulated import parse_params, record, replay
from soro_bench.registration import ENV_IDS, make_task, task_type
from soro_bench.training.policy import Policy, PolicyCard

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
from soro_bench.recording.parquet import load, save  # noqa: E402

KEY = b"soro_bench"
ONE = Signal([0.0, 0.1], [1.0, 2.0], "N")


def says(*parts):
    """A pattern for a message in which ``parts`` follow one another."""
    return "(?s)" + ".*".join(re.escape(part) for part in parts)


def example():
    """Irregular times, several rates, missing samples, arrays, and numbers that only their bits tell apart."""
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.001, 0.1, 50))
    points = rng.normal(size=(50, 4, 3))
    points[3, 1, 2], points[7] = np.nan, np.nan
    signals = {
        "points": Signal(times, points, "m", "world"),
        "force": Signal([0.0, 0.25, times[20]], [1.0, -0.0, 5e-324], "N"),
        "once": Signal([1 / 3], [[[1, 2], [3, 4]]], "rad"),
    }
    commands = {"action": Signal(times[:-1], rng.normal(size=(49, 2))), "pump": Signal([0.5, 0.6], [1, 0], "Pa")}
    return Recording(commands, signals, {"trunk_mass": 0.1 + 0.2}, {"robot": "trunk no. 3, größer"})


def assert_same(a, b):
    """Equal to the last bit."""
    for group in ("commands", "signals"):
        first, second = getattr(a, group), getattr(b, group)
        assert first.keys() == second.keys()
        for name in first:
            x, y = first[name], second[name]
            assert (x.unit, x.frame, x.values.shape) == (y.unit, y.frame, y.values.shape)
            assert x.time.tobytes() == y.time.tobytes()
            assert x.values.tobytes() == y.values.tobytes()
    assert (a.parameters, a.metadata) == (b.parameters, b.metadata)


def test_round_trip_is_exact(tmp_path):
    save(example(), tmp_path / "a.parquet")
    assert_same(load(tmp_path / "a.parquet"), example())


def test_the_same_recording_gives_the_same_bytes(tmp_path):
    first = example()
    other_order = Recording(
        dict(reversed(first.commands.items())), dict(reversed(first.signals.items())), first.parameters, first.metadata
    )
    save(first, tmp_path / "a.parquet")
    save(other_order, tmp_path / "b.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


def test_file_is_a_table_for_any_reader(tmp_path):
    """Columns as in LeRobot's datasets, null where a signal has no sample; units are in the columns' metadata."""
    save(example(), tmp_path / "a.parquet")
    table = pq.read_table(tmp_path / "a.parquet")
    assert table.schema.names == [
        "timestamp", "action", "action.pump", "observation.force", "observation.once", "observation.points",
    ]  # fmt: skip
    assert len(table) - table.column("observation.force").null_count == 3
    assert table.schema.field("observation.points").metadata == {b"unit": b"m", b"frame": b"world", b"shape": b"[4, 3]"}
    assert json.loads(table.schema.metadata[KEY])["schema"] == SCHEMA


def test_a_file_of_another_writer_is_read(tmp_path):
    """Lists of any length in place of lists of fixed length, several row groups, another compression."""
    save(example(), tmp_path / "a.parquet")
    table = pq.read_table(tmp_path / "a.parquet")
    lists = table.column("observation.points").cast(pa.list_(pa.float64()))
    i = table.schema.get_field_index("observation.points")
    table = table.set_column(i, table.schema.field(i).with_type(lists.type), lists)
    pq.write_table(table, tmp_path / "b.parquet", row_group_size=7, compression="snappy")
    assert_same(load(tmp_path / "b.parquet"), example())


def test_duration_and_names():
    assert example().duration == pytest.approx(example().signals["points"].time[-1])
    assert example().names == ["force", "once", "points"]


def test_resampling_bridges_no_gap():
    """Outside, beside missing samples and in a long gap there is nothing; samples themselves stay."""
    times = [0, 0.5, 1, 1.5, 3, 4, 10.5, 11, 12]
    irregular = Signal([0, 1, 2, 3, 10, 11], [0, 1, np.nan, 3, 4, 5.0], "m")
    got = resampled(irregular, times)
    np.testing.assert_array_equal(got.values, [0, 0.5, 1, np.nan, 3, np.nan, 4.5, 5, np.nan])
    assert got.unit == "m"
    np.testing.assert_allclose(resampled(irregular, [6.5], max_gap=7).values, [3.5])
    assert resampled(Signal([0, 1], np.ones((2, 3, 2))), [0.25, 0.5, 2.0]).values.shape == (3, 3, 2)


@pytest.mark.parametrize(
    ("make", "parts"),
    [
        (lambda: Signal([], []), ("time has shape (0,)",)),
        (lambda: Signal([[0.0]], [1]), ("time has shape (1, 1)",)),
        (lambda: Signal([0, 0], [1, 2]), ("increase strictly", "row 1")),
        (lambda: Signal([1, 0.5], [1, 2]), ("increase strictly", "0.5 s follows 1.0 s")),
        (lambda: Signal([-0.1, 0], [1, 2]), ("begins at -0.1",)),
        (lambda: Signal([0, np.nan], [1, 2]), ("time is not finite",)),
        (lambda: Signal([0, 1], [1]), ("values have shape (1,)", "2 rows")),
        (lambda: Signal([0, 1], [1, np.inf]), ("infinite",)),
        (lambda: Signal([0, 1], ["a", "b"]), ("type <U1", "real numbers")),
        (lambda: Signal([0, 1], [1, 2j]), ("complex", "real numbers")),
        (lambda: Signal([0], np.zeros((1, 0))), ("shape (0,)", "positive integers")),
        (lambda: Signal([0], [1], unit=""), ('"1"',)),
        (lambda: Signal([0], [1], unit="m\n"), ("unit 'm\\n'", "printable")),
        (lambda: Signal([0], [1], frame=3), ("frame 3", "printable")),
        (lambda: Recording(), ("0 commands and signals",)),
        (lambda: Recording(signals={"../../etc": ONE}), ("'../../etc'", "A-Z a-z")),
        (lambda: Recording(signals={"": ONE}), ("name ''",)),
        (lambda: Recording(signals={"a" * 65: ONE}), ("aaa", "63")),
        (lambda: Recording(signals={"f": ONE}, parameters={"m": np.nan}), ("parameter m is nan", "finite")),
        (lambda: Recording(signals={"f": ONE}, parameters={"m": "1"}), ("parameter m is '1'", "finite")),
        (lambda: Recording(signals={"f": ONE}, metadata={"robot": 3}), ("metadata robot is 3", "text")),
        (lambda: Recording(signals={"f": ONE}, metadata={"a": "x" * 10_001}), ("metadata a is", "10000")),
    ],
)
def test_invalid_content(make, parts):
    """What is no signal or recording is refused before it gets into a file."""
    with pytest.raises(RecordingError, match=says(*parts)):
        make()


def table_of(columns, head=None):
    """A table as in a native file; columns are arrays and their metadata by name."""
    head = {"schema": SCHEMA, "parameters": {}, "metadata": {}} if head is None else head
    fields = [pa.field(name, array.type, metadata=about) for name, (array, about) in columns.items()]
    metadata = {KEY: head if isinstance(head, bytes) else json.dumps(head)}
    return pa.Table.from_arrays([array for array, _ in columns.values()], schema=pa.schema(fields, metadata=metadata))


TIME = (pa.array([0.0, 0.1]), None)
FORCE = (pa.array([1.0, 2.0]), {"unit": "N", "frame": "", "shape": "[]"})
HEAD = {"schema": SCHEMA, "parameters": {}, "metadata": {}}


def lists(*rows, shape="[2]", kind=None):
    return pa.array(rows, kind or pa.list_(pa.float64())), {"unit": "N", "frame": "", "shape": shape}


BAD_TABLES = [
    ({"timestamp": TIME, "f": FORCE}, None, ("unknown column 'f'", "observation.<name>")),
    ({"timestamp": TIME, "observation": FORCE}, None, ("unknown column 'observation'",)),
    ({"timestamp": TIME, "action.action": FORCE}, None, ("unknown column 'action.action'",)),
    ({"timestamp": TIME, "observation.../../x": FORCE}, None, ("'../../x'", "A-Z a-z")),
    ({"timestamp": TIME, "observation.a\x00b": FORCE}, None, ("a\\x00b",)),
    ({"observation.f": FORCE}, None, ("first column", "timestamp")),
    ({"timestamp": TIME}, None, ("0 commands and signals",)),
    ({"timestamp": (pa.array([0, 1]), None), "observation.f": FORCE}, None, ("timestamp, float64",)),
    ({"timestamp": (pa.array([0.0, None]), None), "observation.f": FORCE}, None, ("nulls",)),
    ({"timestamp": (pa.array([0.0, np.nan]), None), "observation.f": FORCE}, None, ("not finite",)),
    ({"timestamp": (pa.array([-1.0, 0.0]), None), "observation.f": FORCE}, None, ("begins at -1.0",)),
    ({"timestamp": (pa.array([0.0, 0.0]), None), "observation.f": FORCE}, None, ("increase strictly",)),
    ({"timestamp": TIME, "observation.f": (FORCE[0], None)}, None, ("observation.f", "shape", "missing")),
    ({"timestamp": TIME, "observation.f": (pa.array([1, 2]), FORCE[1])}, None, ("int64", "float64")),
    ({"timestamp": TIME, "observation.f": (pa.array(["a", "b"]), FORCE[1])}, None, ("string", "numbers")),
    ({"timestamp": TIME, "observation.f": (pa.array([None, None], pa.float64()), FORCE[1])}, None, ("shape (0,)",)),
    ({"timestamp": TIME, "observation.f": lists([1.0, 2.0], [3.0])}, None, ("2 numbers",)),
    ({"timestamp": TIME, "observation.f": lists([1.0, 2.0], [3.0, None])}, None, ("nulls inside",)),
    ({"timestamp": TIME, "observation.f": lists([1.0], [2.0], shape="[]")}, None, ("shape []", "float64")),
    ({"timestamp": TIME, "observation.f": lists([1.0], [2.0], shape="[-1]")}, None, ("shape [-1]", "positive")),
    ({"timestamp": TIME, "observation.f": lists([1.0], [2.0], shape="[1e9]")}, None, ("positive",)),
    ({"timestamp": TIME, "observation.f": lists([1.0], [2.0], shape="[100000000]")}, None, ("100000",)),
    ({"timestamp": TIME, "observation.f": lists([1.0], [2.0], shape="[" * 100_000)}, None, ("cannot be read",)),
    ({"timestamp": TIME, "observation.f": FORCE}, {**HEAD, "schema": "other/9"}, ("'other/9'", SCHEMA)),
    ({"timestamp": TIME, "observation.f": FORCE}, [1], ("schema none", SCHEMA)),
    ({"timestamp": TIME, "observation.f": FORCE}, {"schema": SCHEMA}, ("metadata, parameters, schema",)),
    ({"timestamp": TIME, "observation.f": FORCE}, {**HEAD, "parameters": {"m": "x"}}, ("m is 'x'",)),
    ({"timestamp": TIME, "observation.f": FORCE}, {**HEAD, "parameters": [1]}, ("parameters [1]",)),
    ({"timestamp": TIME, "observation.f": FORCE}, {**HEAD, "metadata": {"a": {"b": 1}}}, ("metadata a",)),
    ({"timestamp": TIME, "observation.f": FORCE}, b'{"schema": NaN', ("cannot be read",)),
    ({"timestamp": TIME, "observation.f": FORCE}, b"[" * 100_000, ("cannot be read",)),
    ({"timestamp": TIME, "observation.f": FORCE}, b"\xff", ("cannot be read",)),
    ({"timestamp": TIME, "observation.f": FORCE}, b" " * 2_000_000, ("footer",)),
]


@pytest.mark.parametrize(("columns", "head", "parts"), BAD_TABLES)
def test_invalid_file(tmp_path, columns, head, parts):
    """A Parquet file with the wrong content; the file is named."""
    path = tmp_path / "bad.parquet"
    pq.write_table(table_of(columns, head), path)
    with pytest.raises(RecordingError, match=says(str(path), *parts)):
        load(path)


def test_another_table_is_no_recording(tmp_path):
    pq.write_table(pa.table({"timestamp": [0.0]}), tmp_path / "a.parquet")
    with pytest.raises(RecordingError, match="importer"):
        load(tmp_path / "a.parquet")


@pytest.mark.parametrize("content", [b"", b"PAR1", b"PAR1" * 3, b"PAR1\xff\xff\xff\xffPAR1", b"\x80\x04pickle" * 9])
def test_no_parquet_file(tmp_path, content):
    (tmp_path / "a.parquet").write_bytes(content)
    with pytest.raises(RecordingError, match=r"a\.parquet"):
        load(tmp_path / "a.parquet")


def test_truncated_and_altered_files(tmp_path):
    """Every length but the whole one, and a flipped bit in every byte of the data: refused, or without effect."""
    path = tmp_path / "a.parquet"
    recording, refused = Recording(signals={"f": ONE}), 0
    save(recording, path)
    data = path.read_bytes()
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        with pytest.raises(RecordingError):
            load(path)
    footer = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    for i in range(4, footer):
        path.write_bytes(data[:i] + bytes([data[i] ^ 16]) + data[i + 1 :])
        try:
            assert_same(load(path), recording)
        except RecordingError:
            refused += 1
    assert refused > 0.9 * (footer - 4)


@pytest.mark.parametrize("compression", ["zstd", "gzip", "none"])
@pytest.mark.parametrize("dictionary", [True, False])
def test_a_decompression_bomb_is_refused_before_it_is_decompressed(tmp_path, compression, dictionary):
    """A small file that says it has few bytes to a row but is many times as large in memory."""
    zeros = pa.array(np.zeros(200_000))
    columns = {"timestamp": (pa.array(np.arange(200_000.0)), None), "observation.f": (zeros, FORCE[1])}
    path = tmp_path / "bomb.parquet"
    pq.write_table(table_of(columns), path, compression=compression, use_dictionary=dictionary)
    with pytest.raises(RecordingError, match=r"memory|bytes"):
        load(path, max_bytes=700_000)


def test_a_list_of_millions_in_a_few_bytes_is_refused(tmp_path):
    """A run of equal numbers takes no space in the file, whatever the footer says of sizes."""
    zeros = pa.array([np.zeros(5_000_000)], pa.list_(pa.float64()))
    columns = {"timestamp": (pa.array([0.0]), None), "observation.f": (zeros, {**FORCE[1], "shape": "[5000000]"})}
    path = tmp_path / "bomb.parquet"
    pq.write_table(table_of(columns), path, compression="zstd", use_dictionary=True)
    assert path.stat().st_size < 10_000
    with pytest.raises(RecordingError, match="memory"):
        load(path, max_bytes=10_000_000)


def test_file_size_is_bounded(tmp_path):
    save(example(), tmp_path / "a.parquet")
    with pytest.raises(RecordingError, match="more than 100 bytes"):
        load(tmp_path / "a.parquet", max_bytes=100)


def test_what_is_no_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "missing.parquet")
    if not hasattr(os, "mkfifo"):
        pytest.skip("no pipes among the files of this system")
    os.mkfifo(tmp_path / "pipe.parquet")
    with pytest.raises(RecordingError, match="no regular file"):
        load(tmp_path / "pipe.parquet")
    with pytest.raises((RecordingError, OSError)):
        load(tmp_path)


WRITER = """
import sys, time
import pyarrow.parquet as pq
from soro_bench.recording.parquet import save
from tests.test_recording import example

def slow(table, path, **options):
    path.write_bytes(b"half")
    print("writing", flush=True)
    time.sleep(60)

pq.write_table = slow
save(example(), sys.argv[1])
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_killed_writer_leaves_no_half_file(tmp_path, how):
    """The old file stays; interrupted, the writer cleans up as well."""
    path = tmp_path / "a.parquet"
    save(example(), path)
    before = path.read_bytes()
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=CHECKOUT
    )
    assert process.stdout.readline() == b"writing\n"
    process.send_signal(how)
    process.wait(30)
    process.stdout.close()
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.glob("*.parquet")] == ["a.parquet"]
    if how == signal.SIGINT:
        assert len(list(tmp_path.iterdir())) == 1


CHECKOUT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
CASES = [
    ("TrunkReach-v0", "cable", "continuous", {"trunk_mass": 0.3}),
    ("TrunkPush-v0", "cable", "discrete", {"friction": 0.5}),
    ("TrunkLift-v0", "cable", "continuous", {"wall_offset": 0.02}),
    ("MultiGait-v0", "coarse", "discrete", {"robot_mass": 0.03}),
]


@pytest.mark.parametrize(("env_id", "model", "action", "params"), CASES)
def test_a_recording_replays_bit_for_bit(tmp_path, env_id, model, action, params):
    """Simulated, saved, read again and simulated after what was read."""
    recording = record(env_id, "random", model, action, params, steps=5, seed=4)
    save(recording, tmp_path / "a.parquet")
    loaded = load(tmp_path / "a.parquet")
    assert_same(loaded, recording)
    assert params.items() <= loaded.parameters.items()
    episode = replay(loaded)
    assert episode.signals.keys() == loaded.signals.keys()
    for name, signal_ in loaded.signals.items():
        np.testing.assert_array_equal(episode.signals[name], signal_.values, err_msg=name)
        np.testing.assert_array_equal(episode.time, signal_.time)


def test_a_trained_policy_is_recorded(tmp_path):
    """As it acts in an evaluation; a policy of another environment is refused."""
    rng = np.random.default_rng(0)
    tensors = {"mean": np.zeros(66), "std": np.ones(66), "w0": rng.normal(size=(8, 66)), "b0": np.zeros(8)}
    tensors = {name: values.astype(np.float32) for name, values in tensors.items()}
    Policy(PolicyCard("TrunkReach-v0", "cable", "continuous", "oracle", 0, 0), tensors).save(tmp_path / "policy")
    recording = record("TrunkReach-v0", str(tmp_path / "policy"), "cable", steps=4)
    assert recording.commands["action"].values.any()
    np.testing.assert_array_equal(replay(recording).signals["keypoints"], recording.signals["keypoints"].values)
    with pytest.raises(ValueError, match=says("TrunkReach-v0 with continuous actions")):
        record("TrunkPush-v0", str(tmp_path / "policy"), "cable")


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_every_signal_has_a_unit(env_id):
    task = make_task(env_id, 1, 1, task_type(env_id).cheap)
    task.reset(np.arange(1), [np.random.default_rng(0)], [{}])
    assert task.signals(np.arange(1)).keys() == task.signal_units.keys()


def test_noise_is_seeded_and_falls_on_positions_only():
    clean, noisy, again, other = (
        record("TrunkReach-v0", model="cable", steps=20, seed=1, noise=noise) for noise in (0.0, 1e-3, 1e-3, 2e-3)
    )
    assert_same(noisy, again)
    for name, values in ((n, s.values) for n, s in clean.signals.items()):
        difference = noisy.signals[name].values - values
        if name in ("keypoints", "link_position"):
            assert np.std(difference) == pytest.approx(1e-3, rel=0.15)
            np.testing.assert_allclose(other.signals[name].values - values, 2 * difference, atol=1e-12)
        else:
            assert not difference.any()
    assert noisy.metadata["noise"] == "0.001"


def test_a_recording_may_be_longer_than_an_episode_and_goes_on_when_solved(monkeypatch):
    monkeypatch.setattr("soro_bench.envs.trunk.SUCCESS_DISTANCE", 1.0)
    monkeypatch.setattr("soro_bench.envs.trunk.TrunkTask._begin", lambda self, ids: None)
    recording = record("TrunkReach-v0", model="cable", steps=110)
    assert len(recording.commands["action"].time) == 110
    assert len(recording.signals["tension"].time) == 111


def test_actions_of_a_robot_are_held_until_the_next():
    """Commands at their own times, which begin after the signals do."""
    recording = record("TrunkReach-v0", model="cable", steps=4)
    values = np.array([np.full(8, 0.5), np.full(8, -0.5)])
    commands = {"action": Signal([0.06, 0.14], values)}
    episode = replay(replace(recording, commands=commands, metadata={**recording.metadata, "model": "cable"}))
    np.testing.assert_array_equal(episode.actions[:, 0], [0, 0, 0.5, -0.5])


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"metadata": {}}, ("env_id None", "TrunkReach-v0", "continuous")),
        ({"metadata": {"env_id": "os:Trunk-v0", "action": "discrete"}}, ("'os:Trunk-v0'", "TrunkReach-v0")),
        ({"commands": {}}, ("no command 'action'",)),
        ({"commands": {"action": Signal([0.0, 1e9], np.zeros((2, 8)))}}, ("control steps", "100000")),
        ({"commands": {"action": Signal([0.0], np.full((1, 8), np.nan))}}, ("missing numbers",)),
        ({"commands": {"action": Signal([0.0], np.full((1, 8), 7.0))}}, ("finite numbers from -1.0 to 1.0",)),
        ({"commands": {"action": Signal([0.0], np.zeros((1, 3)))}}, ("expected (1, 8)",)),
        ({"parameters": {"mass": 1.0}}, ("'mass'", "trunk_mass")),
        ({"parameters": {"trunk_mass": 1e9}}, ("trunk_mass = 1000000000.0", "[0.001, 2.0] kg")),
    ],
)
def test_what_cannot_be_replayed(change, parts):
    with pytest.raises(ValueError, match=says(*parts)):
        replay(replace(record("TrunkReach-v0", model="cable", steps=2), **change))


@pytest.mark.parametrize(
    "metadata", [{"goal": "left"}, {"goal": "[" * 5000}, {"goal": "[1e9, 0, 0]"}, {"model": "fem"}]
)
def test_hostile_metadata(metadata):
    recording = record("TrunkReach-v0", model="cable", steps=2)
    with pytest.raises(ValueError, match=r"goal|model"):
        replay(replace(recording, metadata={**recording.metadata, **metadata}))


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ({"env_id": "Walker-v0"}, ("'Walker-v0'", "TrunkReach-v0")),
        ({"policy": "clever"}, ("'clever'", "random, excitation", "folder")),
        ({"action": "torque"}, ("'torque'", "discrete, continuous")),
        ({"model": "fem"}, ("'fem'", "flex, cable")),
        ({"steps": 0}, ("steps 0",)),
        ({"noise": -1.0}, ("noise -1.0",)),
        ({"policy": "excitation", "action": "discrete"}, ("continuous",)),
        ({"policy": "excitation", "steps": 50}, ("50 steps are too few",)),
    ],
)
def test_what_cannot_be_recorded(arguments, parts):
    with pytest.raises(ValueError, match=says(*parts)):
        record(**{"env_id": "TrunkReach-v0", "model": "cable", "steps": 2, **arguments})


def test_parameters_of_the_command_line():
    assert parse_params(("trunk_mass=0.3", "damping=1e-1")) == {"trunk_mass": 0.3, "damping": 0.1}
    for bad in ("trunk_mass", "trunk_mass=heavy", "=", "a=b=c"):
        with pytest.raises(ValueError, match=re.escape(repr(bad))):
            parse_params((bad,))


@pytest.mark.parametrize(("channels", "timestep", "duration"), [(8, 0.05, 30.0), (8, 0.05, 60.0), (3, 0.6, 120.0)])
def test_excitation(channels, timestep, duration):
    """It fills its duration, keeps within the action space, moves every channel alone and ends where it began."""
    actions = excitation(spaces.Box(-1, 1, (channels,)), timestep, duration)
    assert actions.shape == (round(duration / timestep), channels)
    assert np.abs(actions).max() <= 1
    np.testing.assert_allclose(actions.sum(axis=0), 0, atol=1e-9)
    assert not actions[:10].any()
    assert not actions[-10:].any()
    alone = (actions != 0).sum(axis=1) == 1
    assert ((actions != 0)[alone].sum(axis=0) > 10).all()
    for rate in (1, 1 / 2, 1 / 3):
        assert (np.isclose(actions, rate).any(axis=0)).all()
    np.testing.assert_array_equal(actions, excitation(spaces.Box(-1, 1, (channels,)), timestep, duration))
    assert len(excitation(spaces.Box(-1, 1, (channels,)), 0.05, shortest(channels) * 0.05)) == shortest(channels)


def test_excitation_has_odd_harmonics_of_its_band():
    actions = excitation(spaces.Box(-1, 1, (2,)), 0.05, 60.0)
    quiet = np.flatnonzero(~actions.any(axis=1))
    rich = actions[quiet[quiet < len(actions) - 16][-1] + 1 : -16]
    power = np.abs(np.fft.rfft(rich[:, 0])) ** 2
    frequency = np.fft.rfftfreq(len(rich), 0.05)
    strong = frequency[power > 1e-3 * power.max()]
    assert 0.15 < strong[0] < 0.25
    assert 1.5 < strong[-1] <= 2.05
    np.testing.assert_allclose((strong / strong[0]) % 2, 1, atol=1e-6)


def test_comparison_shows_the_measured_points_at_their_times(tmp_path):
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    recording = record("TrunkReach-v0", model="cable", steps=5, noise=1e-3)
    keypoints = recording.signals["keypoints"]
    keypoints.values[2, 4] = np.nan
    comparison.write_comparison(recording, tmp_path / "a.rrd", "a")
    chunks = RrdReader(tmp_path / "a.rrd").stream().to_chunks()
    (chunk,) = [c for c in chunks if c.entity_path.endswith("measured/keypoints") and not c.is_static]
    batch = chunk.to_record_batch()
    positions = batch.column("Points3D:positions").to_pylist()
    assert [len(row) for row in positions] == [21, 21, 20, 21, 21, 21]
    np.testing.assert_allclose(positions[1], keypoints.values[1], atol=1e-6)
    assert any(c.entity_path == "/episode_01/world/backbone" for c in chunks)
    assert comparison.measured_points(recording).keys() == {"keypoints", "link_position"}
