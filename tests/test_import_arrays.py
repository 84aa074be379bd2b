"""Recordings from arrays (.npz, .npy, .mat): which entries are samples, episodes and labels; what MATLAB writes."""

import tomllib

import numpy as np
import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("scipy")
pytest.importorskip("h5py")

import h5py
from scipy.io import savemat
from scipy.io.matlab import MatlabObject

from benchmarks.fuzz_recordings import write_v73
from soro_bench.recording.importers import guess_mapping, import_recording
from soro_bench.recording.recording import NOTES, RecordingError
from tests.arm import says

RNG = np.random.default_rng(0)
T = 6
TIME = 0.1 * np.arange(T)
FLAT = RNG.normal(size=(T, 3))
BOXES = RNG.normal(size=(4, T, 2, 3))  # episodes, times, and points in the plane of samples
MAPPING = '[time]\narray = "t"\n[signals.x]\narrays = ["x"]\nunit = "mm"\n'


@pytest.fixture
def read(tmp_path):
    """Reads arrays, as a file of that kind, with a mapping."""

    def read(mapping, suffix="npz", **arrays):
        path = tmp_path / f"a.{suffix}"
        if suffix == "npz":
            np.savez(path, **arrays)
        elif suffix == "npy":
            np.save(path, arrays["x"])
        elif suffix == "v73":
            path = tmp_path / "a.mat"
            write_v73(path, arrays)
        else:
            path = tmp_path / "a.mat"
            savemat(path, arrays, format=suffix.removeprefix("v"), do_compression=suffix == "5")
        (tmp_path / "a.toml").write_text(mapping)
        return import_recording(path, tmp_path / "a.toml")

    return read


@pytest.mark.parametrize("shape", [(T,), (T, 1), (1, T)])
def test_times_may_be_a_row_or_a_column(read, shape):
    signal = read(MAPPING, t=TIME.reshape(shape), x=FLAT).signals["x"]
    np.testing.assert_allclose(signal.time, TIME)
    np.testing.assert_allclose(signal.values, 1e-3 * FLAT)


@pytest.mark.parametrize("numbers", [FLAT, np.arange(3.0 * T).reshape(T, 3).astype(int)])
def test_numbers_that_stand_for_missing_ones_are_none(read, numbers):
    lost = np.where(np.arange(T)[:, None] == 2, -99, numbers)
    values = read(MAPPING + "missing = [-99]\n", t=TIME, x=lost).signals["x"].values
    np.testing.assert_allclose(values, 1e-3 * np.where(lost == -99, np.nan, numbers))


@pytest.mark.parametrize("missing", ['["lost"]', "-99", "[[1]]"])
def test_texts_stand_for_no_missing_number_of_an_array(read, missing):
    with pytest.raises(RecordingError, match=says("signals.x", "missing")):
        read(MAPPING + f"missing = {missing}\n", t=TIME, x=FLAT)


@pytest.mark.parametrize(
    ("indices", "x", "expected"),
    [
        ("[2, 0]", FLAT, FLAT[:, [2, 0]]),
        ("[1]", FLAT, FLAT[:, 1]),
        ('[":", "rows"]', FLAT.T, FLAT),
        ('[[0, 2], "rows"]', FLAT.T, FLAT[:, [0, 2]]),
        ('[3, ":", [0], 2]', BOXES, BOXES[3, :, 0, 2]),
        ('[3, ":", 1]', BOXES, BOXES[3, :, 1]),
        ('[[0, 1], "rows", 1, ":"]', BOXES, BOXES[:2, :, 1].transpose(1, 0, 2).reshape(T, 6)),
    ],
)
def test_indices_choose_entries(read, indices, x, expected):
    """Of each sample, or along each axis."""
    signal = read(MAPPING + f"indices = {indices}\n", t=TIME, x=x).signals["x"]
    np.testing.assert_allclose(signal.values, 1e-3 * expected)


@pytest.mark.parametrize(
    ("indices", "parts"),
    [
        ("[3]", ("index 3 of x: expected 0 to 2",)),
        ("[]", ("indices = []", "(6, 3)")),
        ('"all"', ("indices = 'all'",)),
        ('["rows", ":", 0]', ("(6, 3)",)),
        ('["rows", "rows"]', ("twice",)),
        ('["rows", 1.5]', ("1.5", '":" or "rows"')),
        ('["rows", -1]', ("index -1",)),
    ],
)
def test_indices_that_fit_no_array(read, indices, parts):
    with pytest.raises(RecordingError, match=says("signals.x", *parts)):
        read(MAPPING + f"indices = {indices}\n", t=TIME, x=FLAT)


def test_an_episode_of_arrays_that_have_an_axis_of_episodes(read, tmp_path):
    """The times may be shared, or one row for each; episodes of other lengths are filled up with NaN."""
    x = BOXES.reshape(4, T, 6).copy()
    x[2, 4:] = np.nan
    for t in (TIME, np.stack([TIME + i for i in range(4)])):
        for episode, rows in ((1, T), (2, 4)):
            signal = read(f"[format]\nepisode = {episode}\n" + MAPPING, t=t, x=x).signals["x"]
            np.testing.assert_allclose(signal.time, TIME[:rows], atol=1e-12)
            np.testing.assert_allclose(signal.values, 1e-3 * x[episode, :rows])
    (tmp_path / "a.toml").write_text(MAPPING)
    chosen = import_recording(tmp_path / "a.npz", tmp_path / "a.toml", episode=3)
    np.testing.assert_allclose(chosen.signals["x"].values, 1e-3 * x[3])
    with pytest.raises(RecordingError, match=says("a.npz", "episode = 4; there are 4, counted from 0")):
        import_recording(tmp_path / "a.npz", tmp_path / "a.toml", episode=4)


@pytest.mark.parametrize(("key", "numbers"), [("ends", [2, 5, 6]), ("lengths", [2, 3, 1])])
def test_an_episode_of_rows_one_after_the_other(read, key, numbers):
    mapping = f'[format]\nepisode = 1\n{key} = "n"\n' + MAPPING
    signal = read(mapping, t=TIME, x=FLAT, n=np.array(numbers)).signals["x"]
    np.testing.assert_allclose(signal.values, 1e-3 * FLAT[2:5])
    with pytest.raises(RecordingError, match=says("(6, 3) fits neither 3 episodes nor 7 rows")):
        read(mapping, t=TIME, x=FLAT, n=np.array([2, 5, 7] if key == "ends" else [2, 3, 2]))


@pytest.mark.parametrize(
    ("labels", "only"),
    [
        (np.array([0, 0, 1, 1, 1, 2]), "[1]"),
        (np.array(["a", "a", "pull 1", "pull 1", "pull 2", "b"]), '["pull"]'),
        (np.array(["pull 10", "a", "pull 1", "pull 1", "pull 1 ", "b"]), '["pull 1"]'),
    ],
)
def test_rows_with_a_label(read, labels, only):
    mapping = f'[format]\nlabel = "trial"\nonly = {only}\n' + MAPPING
    signal = read(mapping, t=TIME, x=FLAT, trial=labels).signals["x"]
    np.testing.assert_allclose(signal.values, 1e-3 * FLAT[2:5])
    for wrong, parts in (('["no"]', "'no'"), ("[9]", "[9]"), ("3", "3"), ("[]", "[]")):
        with pytest.raises(RecordingError, match=says("[format] only", parts)):
            read(mapping.replace(only, wrong), t=TIME, x=FLAT, trial=labels)


def test_times_of_single_precision_that_repeat(read, tmp_path):
    """Seconds since 1970 do not fit into one; what to write stands there, and works."""
    t = (1.7e9 + TIME).astype(np.float32)
    with pytest.raises(RecordingError, match=says("'t'", "single precision, steps of 128", "interval")):
        read(MAPPING, t=t, x=FLAT)
    signal = read(MAPPING.replace('array = "t"', "interval = 0.1"), t=t, x=FLAT).signals["x"]
    np.testing.assert_allclose(signal.time, TIME)
    assert "t does not increase" in guess_mapping(tmp_path / "a.npz")


def test_times_in_whole_nanoseconds_and_dates_keep_every_digit(read):
    steps = np.array([0, 1, 2, 3, 5, 8])
    stamps = 1_700_000_000_000_000_000 + steps
    whole = read(MAPPING.replace('"t"', '"t"\nunit = "ns"'), t=stamps, x=FLAT)
    dates = read(MAPPING, t=stamps.astype("datetime64[ns]"), x=FLAT)
    for recording in (whole, dates):
        np.testing.assert_allclose(recording.signals["x"].time, 1e-9 * steps, rtol=1e-12)


def test_dates_that_repeat_or_are_missing_stay_dates(read):
    dates = (1_700_000_000_000 + 100 * np.arange(T)).astype("datetime64[ms]")
    dates[2], dates[4] = dates[1], np.datetime64("NaT")
    recording = read(MAPPING.replace('"t"', '"t"\norder = "keep_first"'), t=dates, x=FLAT)
    np.testing.assert_allclose(recording.signals["x"].time, np.delete(0.1 * np.arange(T), [2, 4]))
    assert float(recording.metadata["start_time"]) == 1.7e9


def test_a_counter_of_microseconds_that_overflows_goes_on(read):
    t = (np.int64(2**32) - 250_000 + np.arange(T) * 100_000).astype(np.uint32)
    recording = read(MAPPING.replace('"t"', '"t"\nunit = "us"'), t=t, x=FLAT)
    np.testing.assert_allclose(recording.signals["x"].time, TIME, atol=1e-9)
    with pytest.raises(RecordingError, match="unit has no effect: 't' holds dates"):
        read(MAPPING.replace('"t"', '"t"\nunit = "us"'), t=t.astype("datetime64[us]"), x=FLAT)


def test_a_guess_knows_dates_in_numbers_by_their_size(tmp_path):
    days = 739947.5 + np.arange(T) / 86400
    times = {
        unit: np.int64((1.7e9 + np.arange(T)) * factor)
        for unit, factor in [("s", 1), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)]
    }
    for unit, stamp in {"d": days, **times}.items():
        np.savez(tmp_path / "a.npz", stamp=stamp, x=FLAT)
        mapping = tomllib.loads(guess_mapping(tmp_path / "a.npz"))
        assert mapping["time"] == {"array": "stamp", "unit": unit}


@pytest.mark.parametrize(
    ("name", "times"),
    [
        ("elapsed_s", TIME),
        ("time_posix", TIME),
        ("simTime", TIME),
        ("ts", TIME),
        ("epoch", 1.7e9 + TIME),
        ("dates", np.datetime64("2025-11-28T10:00", "ns") + np.int64(1e9 * TIME)),
    ],
)
def test_a_guess_knows_times_that_increase_by_other_names(tmp_path, name, times):
    np.savez(tmp_path / "a.npz", q=FLAT, **{name: times})
    mapping = tomllib.loads(guess_mapping(tmp_path / "a.npz"))
    assert mapping["time"]["array"] == name
    assert import_recording(tmp_path / "a.npz", mapping).duration == pytest.approx(np.ptp(TIME))
    np.savez(tmp_path / "a.npz", q=FLAT, **{name: times[::-1].astype(float) % 7})
    assert tomllib.loads(guess_mapping(tmp_path / "a.npz"))["time"] == {}


def test_a_guess_for_a_file_without_numbers_says_what_it_holds(tmp_path):
    np.savez(tmp_path / "a.npz", log=np.array({"t": TIME}, object))
    with pytest.raises(RecordingError, match=says("no array of numbers", "log", "Python objects")):
        guess_mapping(tmp_path / "a.npz")
    np.save(tmp_path / "a.npy", FLAT)
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:-20])
    with pytest.raises(RecordingError, match=says("no array of numbers", "144 bytes, and has 124")):
        guess_mapping(tmp_path / "a.npy")


def test_durations_a_matrix_with_its_times_and_one_sample(read, tmp_path):
    durations = read(MAPPING, t=(1000 * TIME).astype("timedelta64[ms]"), x=np.where(FLAT > 1, np.inf, FLAT))
    np.testing.assert_allclose(durations.signals["x"].time, TIME)
    np.testing.assert_allclose(durations.signals["x"].values, 1e-3 * np.where(FLAT > 1, np.nan, FLAT))
    assert f"{(FLAT > 1).sum()} infinite numbers are taken as missing" in durations.metadata[NOTES]
    signal = MAPPING.removeprefix('[time]\narray = "t"\n')
    for indices, others, x in (
        ("[0]", "[1, 2, 3]", np.c_[TIME, FLAT]),
        ('[0, "rows"]', '[[1, 2, 3], "rows"]', np.c_[TIME, FLAT].T[:, :]),
    ):
        mapping = f'[time]\narray = "x"\nindices = {indices}\n{signal}indices = {others}\n'
        matrix = read(mapping, x=x).signals["x"]
        guess = import_recording(tmp_path / "a.npz", tomllib.loads(guess_mapping(tmp_path / "a.npz"))).signals["x"]
        for found, unit in ((matrix, 1e-3), (guess, 1)):
            np.testing.assert_allclose(found.time, TIME)
            np.testing.assert_allclose(found.values, unit * FLAT)
    assert read(MAPPING, t=TIME[:1], x=FLAT[:1]).signals["x"].values.shape == (1, 3)


def test_npy(read):
    """A plain array, and one with fields."""
    mapping = '[time]\ninterval = 0.1\n[signals.x]\narrays = ["array"]\nunit = "mm"\n'
    np.testing.assert_allclose(read(mapping, "npy", x=FLAT).signals["x"].values, 1e-3 * FLAT)
    fields = np.zeros(T, [("t", float), ("q", float, 3)])
    fields["t"], fields["q"] = TIME, FLAT
    named = read(MAPPING.replace('"t"', '"array.t"').replace('["x"]', '["array.q"]'), "npy", x=fields)
    np.testing.assert_allclose(named.signals["x"].values, 1e-3 * FLAT)
    with pytest.raises(RecordingError, match=says("its fields are t, q")):
        read(mapping, "npy", x=fields)


@pytest.mark.parametrize("suffix", ["npz", "npy"])
def test_objects_are_refused_in_one_line_of_our_own(read, suffix):
    """Without NumPy's hint to allow pickles."""
    mapping = MAPPING if suffix == "npz" else '[time]\ninterval = 1\n[signals.x]\narrays = ["array"]\nunit = "mm"\n'
    with pytest.raises(RecordingError, match="holds Python objects, which are never read: save numbers") as error:
        read(mapping, suffix, t=TIME, x=np.array([{"a": 1}] * T, object))
    assert "pickle" not in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("version", ["v4", "5", "v73"])
def test_mat(read, version):
    """Numbers of every version; MATLAB has vectors as rows, and axes in its own order."""
    values = read(MAPPING, version, t=TIME, x=FLAT).signals["x"].values
    np.testing.assert_allclose(values, 1e-3 * FLAT)
    values = read(MAPPING + 'indices = [":", "rows"]\n', version, t=TIME, x=FLAT.T).signals["x"].values
    np.testing.assert_allclose(values, 1e-3 * FLAT)
    with pytest.raises(RecordingError, match=says("(6,); expected (3,)", 'indices = [":", "rows"]')):
        read(MAPPING, version, t=TIME, x=FLAT.T)


@pytest.mark.parametrize("version", ["5", "v73"])
def test_structs_of_numbers_have_dotted_names(read, version):
    mapping = MAPPING.replace('"t"', '"log.t"').replace('["x"]', '["log.arm.x"]')
    signal = read(mapping, version, log={"t": TIME, "arm": {"x": FLAT}}).signals["x"]
    np.testing.assert_allclose(signal.values, 1e-3 * FLAT)


def test_several_structs_and_cells_of_numbers_are_counted_as_in_matlab(read):
    log = np.zeros(2, [("t", object), ("x", object)])
    for i in range(2):
        log[i] = (TIME, FLAT + i)
    cell = np.array([FLAT, FLAT + 2, None], object)[:2]
    mapping = MAPPING.replace('"t"', '"log(2).t"').replace('["x"]', '["log(2).x", "c{2}"]')
    signal = read(mapping, "5", log=log, c=cell).signals["x"]
    np.testing.assert_allclose(signal.values, 1e-3 * np.concatenate([FLAT + 1, FLAT + 2], axis=1))


@pytest.mark.parametrize(
    ("version", "arrays", "parts"),
    [
        ("5", {"x": MatlabObject(np.array([(1.0,)], [("a", object)]), "mine")}, ("x is no array of numbers", "object")),
        ("5", {"x": FLAT + 1j}, ("x is complex", "real(x)")),
        ("5", {"x": "text"}, ("x has type <U4", "real numbers")),
        ("5", {"y": FLAT}, ("no array is called 'x'", "y, t")),
        ("v73", {"y": FLAT, "x": "y"}, ("x is a cell or an array of structs", "-v7")),
    ],
)
def test_what_is_no_number_of_matlab_is_refused(read, version, arrays, parts):
    with pytest.raises(RecordingError, match=says("a.mat", *parts)) as error:
        read(MAPPING, version, **arrays, t=TIME)
    assert "\n" not in str(error.value)


def test_links_and_data_outside_a_file_of_matlab_are_not_followed(tmp_path):
    (tmp_path / "secret").write_bytes(TIME.tobytes())
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["x"] = FLAT
    with h5py.File(tmp_path / "a.mat", "w") as file:
        file["t"] = TIME
        file["x"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "x")
        file["loop"] = file["/"]
        file.create_dataset("raw", (T,), float, external=str(tmp_path / "secret"))
    for name, message in (("x", "no array is called 'x'"), ("raw", "lies in another file")):
        mapping = {"time": {"interval": 0.1}, "signals": {"x": {"arrays": [name], "unit": "m"}}}
        with pytest.raises(RecordingError, match=message):
            import_recording(tmp_path / "a.mat", mapping)


@pytest.mark.parametrize("version", ["5", "v73"])
def test_a_small_file_that_would_take_much_memory_is_refused(tmp_path, version):
    """Whatever it declares: a compressed array of 96 MB, of which 4 MB may be read."""
    zeros = np.zeros(12_000_000)
    if version == "5":
        savemat(tmp_path / "a.mat", {"x": zeros}, do_compression=True)
    else:
        write_v73(tmp_path / "a.mat", {"x": zeros})
    mapping = {"time": {"interval": 0.1}, "signals": {"x": {"arrays": ["x"], "unit": "m"}}}
    assert (tmp_path / "a.mat").stat().st_size < 1_000_000
    with pytest.raises(RecordingError, match=r"memory|at most 500000"):
        import_recording(tmp_path / "a.mat", mapping, max_bytes=1_000_000)


@pytest.mark.parametrize("data", [b"", b"MATLAB 5.0", bytes(500), b"\x89HDF\r\n\x1a\n" + bytes(900)])
def test_what_is_no_file_of_matlab(tmp_path, data):
    (tmp_path / "a.mat").write_bytes(data)
    with pytest.raises(RecordingError, match=r"a\.mat.*-v7"):
        import_recording(tmp_path / "a.mat", {"signals": {"x": {"arrays": ["x"], "unit": "m"}}})


def test_the_unit_in_the_name_of_an_array_is_guessed_and_doubted(read, tmp_path):
    mapping = '[time]\ninterval = 0.1\n[signals.x]\narrays = ["angle_rad"]\nunit = "deg"\n'
    recording = read(mapping, angle_rad=TIME)
    assert "and the name 'angle_rad' says rad" in recording.metadata["import_notes"]
    assert tomllib.loads(guess_mapping(tmp_path / "a.npz"))["signals"]["angle_rad"]["unit"] == "rad"


@pytest.mark.parametrize("suffix", ["npz", "5", "v73"])
def test_a_guess_is_a_mapping_that_imports_the_file(read, tmp_path, suffix):
    """It finds the times, the commands and the axis of the samples, and leaves out what does not fit."""
    arrays = {"time": TIME, "q": FLAT.T, "u": TIME, "gains": np.arange(4.0)}
    read('[time]\ninterval = 1\n[signals.x]\narrays = ["time"]\nunit = "s"\n', suffix, **arrays)
    path = tmp_path / ("a.npz" if suffix == "npz" else "a.mat")
    written = guess_mapping(path)
    assert f', not {T} rows\n# arrays = ["gains"]' in written
    recording = import_recording(path, tomllib.loads(written))
    assert (recording.commands.keys(), recording.signals.keys()) == ({"u"}, {"q"})
    np.testing.assert_allclose(recording.signals["q"].values, FLAT)
    np.testing.assert_allclose(recording.signals["q"].time, TIME)
    with pytest.raises(RecordingError, match="--guess"):
        import_recording(path)
    np.savez(tmp_path / "z.npz", t=TIME, z=1j * TIME)
    assert "z is left out: complex numbers" in guess_mapping(tmp_path / "z.npz")
    for times, said in ((np.arange(T).astype("datetime64[s]"), {"array": "t"}), (["10:11:02"] * T, {})):
        np.savez(tmp_path / "b.npz", t=times, x=FLAT)
        assert tomllib.loads(guess_mapping(tmp_path / "b.npz"))["time"] == said
