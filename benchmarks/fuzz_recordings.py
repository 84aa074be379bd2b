"""Damaged and hostile recordings: every reader has to refuse them with a RecordingError, or read something valid.

Takes a valid file of each kind, changes it at random (flips, overwrites, removes, repeats and moves bytes, cuts its end
off) and counts what the reader makes of it.

    python -m benchmarks.fuzz_recordings --examples 2000
"""

import argparse
import json
import resource
import shutil
import tempfile
import time
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mcap.writer import CompressionType, Writer

from benchmarks.write_bags import mapping, states, write_ros1, write_ros2
from benchmarks.write_bags import write_mcap as write_bag_mcap
from soro_bench.markdown import header, row
from soro_bench.recording.importers import import_recording
from soro_bench.recording.parquet import load, save
from soro_bench.recording.recording import Recording, RecordingError, Signal

CSV = """[time]
column = "t"
unit = "ms"
[signals.markers]
columns = ["x", "y", "z"]
unit = "mm"
frame = "world"
[commands.action]
columns = ["u"]
unit = "1"
"""
MCAP = """[signals.force]
topic = "/force"
fields = ["value[0]", "value[1]"]
unit = "N"
[commands.action]
topic = "/command"
fields = ["u"]
unit = "1"
time = "stamp"
"""


NPZ = """[time]
array = "t"
[signals.markers]
arrays = ["a", "b"]
unit = "mm"
[commands.action]
arrays = ["u"]
time = "t_u"
unit = "1"
"""


TRC = """PathFileType\t4\t(X/Y/Z)\ta.trc
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits
100\t100\t3\t2\tmm
Frame#\tTime\ttip\t\t\tbase\t\t
\t\tX1\tY1\tZ1\tX2\tY2\tZ2
1\t0.00\t1.5\t0.0\t132.0\t0.0\t0.0\t0.1
2\t0.01\t2.5\t0.0\t132.0\t\t\t
3\t0.02\t3.5\t0.1\t131.0\t0.0\t0.0\t0.1
"""


def example() -> Recording:
    """A small recording with several rates, missing samples and arrays."""
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.01, 0.1, 20))
    points = rng.normal(size=(20, 3, 3))
    points[4, 1] = np.nan
    signals = {
        "points": Signal(times, points, "m", "world"),
        "force": Signal(times[::3], rng.normal(size=7), "N"),
    }
    metadata = {"env_id": "TrunkReach-v0", "model": "cable", "action": "continuous"}
    return Recording({"action": Signal(times[:-1], rng.normal(size=(19, 2)))}, signals, {"trunk_mass": 0.4}, metadata)


def write_csv(folder: Path) -> Path:
    """A table of four columns and its mapping."""
    (folder / "map.toml").write_text(CSV)
    rows = [f"{10 * i},{0.5 * i},{-i},{i * i},{i % 2}" for i in range(20)]
    (folder / "table.csv").write_text("\n".join(["t,x,y,z,u", *rows]) + "\n")
    return folder / "table.csv"


def write_npz(folder: Path) -> Path:
    """Five arrays and their mapping."""
    (folder / "map.toml").write_text(NPZ)
    rng = np.random.default_rng(0)
    arrays = {"t": np.arange(20) / 20, "a": rng.normal(size=(20, 3)), "b": rng.normal(size=(20, 2)).astype("float32")}
    more = {"u": np.arange(19), "t_u": np.arange(19) / 20}
    savez: Callable[..., None] = np.savez_compressed
    savez(folder / "log.npz", **more, **arrays)
    return folder / "log.npz"


def import_array(array: Path, archive: Path) -> Recording:
    """The archive with one array in the place of its own, under a check sum that fits."""
    whole = archive.with_name("whole.npz")
    with zipfile.ZipFile(archive) as old, zipfile.ZipFile(whole, "w") as new:
        for name in old.namelist():
            new.writestr(name, array.read_bytes() if name == array.name else old.read(name))
    return import_recording(whole, archive.with_name("map.toml"))


def write_mcap(folder: Path, compression: CompressionType = CompressionType.ZSTD) -> Path:
    """Two topics in several chunks, and their mapping."""
    (folder / "map.toml").write_text(MCAP)
    path = folder / "log.mcap"
    with open(path, "wb") as file:
        writer = Writer(file, chunk_size=500, compression=compression)
        writer.start()
        schema = writer.register_schema("numbers", "jsonschema", b"{}")
        topics = [writer.register_channel(topic, "json", schema) for topic in ("/force", "/command")]
        for i in range(20):
            stamp = 1_700_000_000_000_000_000 + 10_000_000 * i
            for channel, content in zip(topics, ({"value": [i, -i]}, {"u": i % 2, "stamp": stamp / 1e9}), strict=True):
                data = json.dumps(content).encode()
                writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    return path


def write_lerobot(folder: Path) -> Path:
    """A dataset of two episodes in one data file."""
    features = {
        "action": {"dtype": "float32", "shape": [2]},
        "observation.state": {"dtype": "float32", "shape": [3]},
        "observation.images.top": {"dtype": "video", "shape": [48, 64, 3]},
    }
    info = {"codebase_version": "v3.0", "robot_type": "trunk", "fps": 20, "features": features}
    data = folder / "data" / "chunk-000" / "file-000.parquet"
    data.parent.mkdir(parents=True)
    (folder / "meta").mkdir()
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    rng = np.random.default_rng(0)
    columns = {
        "action": pa.array(rng.normal(size=(20, 2)).astype("float32").tolist(), pa.list_(pa.float32(), 2)),
        "observation.state": pa.array(rng.normal(size=(20, 3)).astype("float32").tolist(), pa.list_(pa.float32())),
        "timestamp": pa.array(np.tile(np.arange(10) / 20, 2).astype("float32")),
        "episode_index": pa.array(np.repeat([0, 1], 10)),
        "task": pa.array(["reach"] * 20),
    }
    pq.write_table(pa.table(columns), data)
    return data


def write_c3d(
    path: Path,
    points: np.ndarray,
    names: Sequence[str] = ("tip", "base"),
    channels: np.ndarray | None = None,
    units: str = "mm",
) -> Path:
    """A C3D file of (T, n, 3) points, where NaN is a marker that no camera saw, and of channels at twice the rate."""
    import c3d

    writer = c3d.Writer(point_rate=100.0, analog_rate=200.0, point_scale=-1.0)
    for i, point in enumerate(points):
        rows = np.zeros((len(point), 5), np.float32)
        rows[:, :3] = np.nan_to_num(point)
        rows[np.isnan(point).any(axis=1), 3] = -1.0
        analog = np.zeros((1, 2)) if channels is None else channels[:, 2 * i : 2 * i + 2]
        writer.add_frames([(rows, analog.astype(np.float32))])
    writer.set_point_labels(list(names))
    writer.set_analog_labels(["pump"])
    writer.point_group.set_str("UNITS", "", units, len(units))
    writer.analog_group.set_str("UNITS", "", "V", 1)
    with open(path, "wb") as file:
        writer.write(file)
    return path


def write_v73(path: Path, arrays: dict[str, Any]) -> Path:
    """As MATLAB 7.3 does: HDF5 behind a header of its own, axes reversed, the class of each array beside it."""

    import h5py

    def write(group: h5py.Group, name: str, value: Any) -> None:
        if isinstance(value, dict):
            below = group.create_group(name)
            below.attrs["MATLAB_class"] = np.bytes_("struct")
            for key, part in value.items():
                write(below, key, part)
            return
        value = np.atleast_2d(value)
        chunks = {} if value.dtype == h5py.ref_dtype else {"compression": "gzip", "chunks": value.T.shape}
        made = group.create_dataset(name, data=value.T, **chunks)
        made.attrs["MATLAB_class"] = np.bytes_("cell" if value.dtype == h5py.ref_dtype else "double")

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in arrays.items():
            write(file, name, file[value].ref if isinstance(value, str) else value)
    data = bytearray(path.read_bytes())
    data[:19] = b"MATLAB 7.3 MAT-file"
    path.write_bytes(data)
    return path


def readers(folder: Path) -> dict[str, tuple[Path, Callable[[], Recording]]]:
    """The file to damage and what reads it, by kind; everything lies in ``folder``."""
    folders = {name: folder / name for name in ("csv", "npz", "mcap", "mcap_lz4", "lerobot", "other")}
    for sub in folders.values():
        sub.mkdir(parents=True)
    native = folder / "native.parquet"
    save(example(), native)
    table, data = write_csv(folders["csv"]), write_lerobot(folders["lerobot"])
    archive = write_npz(folders["npz"])
    array = folders["npz"] / "t.npy"
    array.write_bytes(zipfile.ZipFile(archive).read(array.name))
    log, log_lz4 = write_mcap(folders["mcap"]), write_mcap(folders["mcap_lz4"], CompressionType.LZ4)
    mapping = folders["csv"] / "map.toml"
    info = folders["lerobot"] / "meta" / "info.json"
    points, matrix, trajectories = (folders["other"] / name for name in ("a.c3d", "a.mat", "a.trc"))
    write_c3d(points, np.ones((20, 2, 3)))
    write_v73(matrix, {"x": np.ones((20, 3))})
    trajectories.write_text(TRC)
    tip = {"signals": {"tip": {"markers": ["tip"]}}}
    numbers = {"time": {"rate": 50}, "signals": {"x": {"arrays": ["x"], "unit": "m"}}}
    return {
        **bag_readers(folder / "bags"),
        "native": (native, lambda: load(native)),
        "csv": (table, lambda: import_recording(table, mapping)),
        "mapping": (mapping, lambda: import_recording(table, mapping)),
        "npz": (archive, lambda: import_recording(archive, folders["npz"] / "map.toml")),
        "npz array": (array, lambda: import_array(array, archive)),
        "mcap": (log, lambda: import_recording(log, folders["mcap"] / "map.toml")),
        "mcap lz4": (log_lz4, lambda: import_recording(log_lz4, folders["mcap_lz4"] / "map.toml")),
        "lerobot": (data, lambda: import_recording(folders["lerobot"], episode=1)),
        "lerobot info": (info, lambda: import_recording(folders["lerobot"], episode=1)),
        "c3d": (points, lambda: import_recording(points, tip)),
        "trc": (trajectories, lambda: import_recording(trajectories, tip)),
        "mat 7.3": (matrix, lambda: import_recording(matrix, numbers)),
    }


def bag_readers(folder: Path) -> dict[str, tuple[Path, Callable[[], Recording]]]:
    """Bags with binary messages, by kind."""
    folder.mkdir()
    rows = list(states(count=50))
    paths = {
        "mcap cdr": write_bag_mcap(folder / "cdr.mcap", rows, chunk_size=2000),
        "mcap cdr plain": write_bag_mcap(folder / "plain.mcap", rows, use_chunking=False),
        "db3": write_ros2(folder / "sqlite", rows, "db3") / "sqlite.db3",
        "bag": write_ros1(folder / "plain.bag", rows, chunk=2000),
        "bag bz2": write_ros1(folder / "packed.bag", rows, "BZ2"),
        "bag metadata": write_ros2(folder / "ros2", rows) / "metadata.yaml",
    }
    read = {name: path.parent if name == "bag metadata" else path for name, path in paths.items()}
    return {name: (path, partial(import_recording, read[name], mapping(names=["b"]))) for name, path in paths.items()}


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes after one to four random changes, half of which fall into the last fifth, where footers are."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        if not changed:
            break
        first = 0 if rng.random() < 0.5 else len(changed) * 4 // 5
        i = int(rng.integers(first, len(changed)))
        n = int(rng.integers(1, 17))
        kind = rng.integers(7)
        if kind == 0:
            changed[i] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            changed[i : i + n] = rng.bytes(n)
        elif kind == 2:
            changed[i : i + n] = bytes([int(rng.choice([0, 1, 127, 128, 255]))] * n)
        elif kind == 3:
            del changed[i : i + n]
        elif kind == 4:
            j = int(rng.integers(len(changed)))
            changed[i:i] = changed[j : j + 4 * n]
        elif kind == 5:
            changed[i] = (changed[i] + int(rng.choice([1, 255]))) % 256
        elif rng.random() < 0.3:
            del changed[i:]
    return bytes(changed)


def outcome(path: Path, read: Callable[[], Recording], data: bytes) -> str:
    """ "read" or "refused", in one line; any other error escapes."""
    path.write_bytes(data)
    try:
        read()
    except RecordingError as error:
        if "\n" in str(error):
            raise AssertionError(f"a message of several lines: {error}") from error
        return "refused"
    return "read"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--examples", type=int, default=2000, help="of each kind of file")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    folder = Path(tempfile.mkdtemp())
    heads = "file", "examples", "refused", "read", "other errors", "seconds", "largest memory so far [MB]"
    print(header(heads))
    for name, (path, read) in readers(folder).items():
        valid, counts, start = path.read_bytes(), {"read": 0, "refused": 0, "other": 0}, time.monotonic()
        for _ in range(arguments.examples):
            data = mutated(valid, rng)
            try:
                counts[outcome(path, read, data)] += 1
            except Exception as error:
                counts["other"] += 1
                print(f"{name}: {type(error).__name__}: {error}")
        path.write_bytes(valid)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        numbers = (counts[kind] for kind in ("refused", "read", "other"))
        print(row((name, arguments.examples, *numbers, f"{time.monotonic() - start:.0f}", f"{memory:.0f}")))
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
