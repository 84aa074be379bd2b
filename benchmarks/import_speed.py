"""Time and memory that it takes to read and check large logs: a file of each kind, read by a process of its own.

    python -m benchmarks.import_speed --megabytes 100

A bag holds the states of seven joints at 1 kHz, of which the mapping takes the positions by name. A table holds the
same; with dates, with quotation marks that no quick reader takes, or with a row for each joint.
"""

import argparse
import multiprocessing
import resource
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.write_bags import (
    START,
    TOPIC,
    CompressionType,
    write_json,
    write_mcap,
    write_ros1,
    write_ros2,
)
from soro_bench.markdown import header, row
from soro_bench.progress import ReadingBar
from soro_bench.recording.importers import import_recording

JOINTS = [f"joint_{i}" for i in range(7)]
MAPPING = {"signals": {"q": {"topic": TOPIC, "fields": ["position"], "names": JOINTS, "unit": "rad",
                             "time": "header.stamp"}}}  # fmt: skip
STEP = 1_000_000  # ns
SAMPLE = 1000  # messages, of which one more file tells how large a message is


def states(count: int) -> Iterator[tuple]:
    """(time of receipt [ns], stamp [ns], names, positions) of so many messages."""
    rng = np.random.default_rng(0)
    for k in range(count):
        yield START + k * STEP + STEP // 2, START + k * STEP, JOINTS, rng.normal(size=len(JOINTS))


def json_states(count: int) -> Iterator[tuple]:
    """The same as JSON."""
    for received, stamp, names, positions in states(count):
        header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "base"}
        yield received, {"header": header, "name": names, "position": list(positions)}


TABLE = {"time": {"column": "t"}, "signals": {"q": {"columns": JOINTS, "unit": "rad"}}}
LONG = {"time": {"column": "t"}, "signals": {"q": {"columns": ["q"], "names": JOINTS, "names_from": "joint",
                                                   "unit": "rad"}}}  # fmt: skip


def write_table(folder: Path, count: int, time: Callable[[int], str], mark: str = "") -> Path:
    """A row of seven positions for each time, and ``mark`` in the last column."""
    path = folder / "a.csv"
    with open(path, "w") as file:
        file.write(",".join(["t", *JOINTS, "note"]) + "\n")
        for k, (_, _, _, positions) in enumerate(states(count)):
            file.write(f"{time(k)},{','.join(f'{q:.6f}' for q in positions)},{mark}\n")
    return path


def write_long_table(folder: Path, count: int) -> Path:
    """A row for each joint at each time."""
    path = folder / "a.csv"
    with open(path, "w") as file:
        file.write("t,joint,q\n")
        for k, (_, _, names, positions) in enumerate(states(count)):
            file.writelines(f"{k / 1000:.3f},{name},{q:.6f}\n" for name, q in zip(names, positions, strict=True))
    return path


def date(k: int) -> str:
    """A time of 1 kHz on one day."""
    return f"2026-11-27T{k // 3_600_000:02d}:{k // 60_000 % 60:02d}:{k // 1000 % 60:02d}.{k % 1000:03d}"


# by kind: what writes so many messages into a folder, and the mapping that reads them
KINDS: dict[str, tuple[Callable[[Path, int], Path], dict]] = {
    "CSV": (lambda folder, n: write_table(folder, n, lambda k: f"{k / 1000:.3f}"), TABLE),
    "CSV, dates": (lambda folder, n: write_table(folder, n, date), TABLE),
    "CSV, row by row": (lambda folder, n: write_table(folder, n, lambda k: f"{k / 1000:.3f}", '"a ""b"""'), TABLE),
    "CSV, a row a joint": (write_long_table, LONG),
    "MCAP, JSON": (
        lambda folder, n: write_json(folder / "a.mcap", json_states(n), compression=CompressionType.NONE), MAPPING,
    ),
    "MCAP, CDR": (lambda folder, n: write_mcap(folder / "a.mcap", states(n)), MAPPING),
    "MCAP, CDR, not compressed": (
        lambda folder, n: write_mcap(folder / "a.mcap", states(n), compression=CompressionType.NONE), MAPPING,
    ),
    "SQLite": (lambda folder, n: write_ros2(folder / "bag", states(n), "db3"), MAPPING),
    "ROS 1 bag": (lambda folder, n: write_ros1(folder / "a.bag", states(n)), MAPPING),
}  # fmt: skip


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    return sum(file.stat().st_size for file in path.iterdir()) if path.is_dir() else path.stat().st_size


def measure(path: Path, mapping: dict) -> tuple[int, float, float, float]:
    """Read a log: its samples, seconds, seconds of work, and the largest memory of this process [MB]."""
    begin, worked = time.perf_counter(), time.process_time()
    with ReadingBar() as bar:
        recording = import_recording(path, mapping, bar)
    took, work = time.perf_counter() - begin, time.process_time() - worked
    samples = len(recording.signals["q"].time)
    return samples, took, work, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--megabytes", type=float, default=100.0, help="of each file")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    arguments = parser.parse_args()
    context = multiprocessing.get_context("spawn")  # nothing of this process counts there
    rows = []
    for kind in arguments.kinds:
        write, mapping = KINDS[kind]
        folder = Path(tempfile.mkdtemp())
        small, some = size_of(write(folder, SAMPLE)), folder.with_name(folder.name + "_large")
        some.mkdir()
        path = write(some, max(1, round(SAMPLE * 1e6 * arguments.megabytes / small)))
        with ProcessPoolExecutor(1, context) as alone:  # says so if the process dies or refuses the log
            samples, took, work, memory = alone.submit(measure, path, mapping).result()
        size = size_of(path) / 1e6
        rows.append((kind, f"{size:.0f}", samples, f"{took:.1f}", f"{work:.1f}", f"{size / work:.0f}", f"{memory:.0f}"))
        for used in (folder, some):
            shutil.rmtree(used)
    print(header(("log", "MB", "samples", "s", "CPU s", "MB per CPU s", "largest memory [MB]")))
    for each in rows:
        print(row(each))


if __name__ == "__main__":
    main()
