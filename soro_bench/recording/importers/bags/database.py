"""ROS 2 bags in SQLite (.db3), which may come from a stranger: nothing in them is executed.

The file is opened read-only and nothing is written beside it. Only plain tables are read, by queries that call no
function, so that views, triggers, generated columns and virtual tables do nothing.
"""

import os
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from soro_bench.errors import one_line
from soro_bench.recording.importers.bags.layout import Channel
from soro_bench.recording.importers.bags.logs import MAX_MESSAGE, Message, Reading
from soro_bench.recording.recording import RecordingError

_MAGIC = b"SQLite format 3\0"
_COLUMNS = {
    "topics": {"id", "name", "type", "serialization_format"},
    "messages": {"topic_id", "timestamp", "data"},
    "message_definitions": {"topic_type", "encoding", "encoded_message_definition"},
}
_READS = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)  # what a query may do
_STEPS = 100_000  # of SQLite's machine between two looks at how many there were
_STEPS_PER_BYTE = 10  # of the file, beyond which a query is stopped
_LENGTH = 2 * MAX_MESSAGE  # bytes of a row


def database_messages(path: Path, reading: Reading) -> Iterator[Message]:
    """The messages of a .db3 file, in its order."""
    with _opened(path, reading) as database:
        definitions = {}
        if _has(database, "message_definitions"):
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {name: (definition, kind) for name, kind, definition in database.execute(query)}
        if not _has(database, "topics") or not _has(database, "messages"):
            raise RecordingError("is no bag of ROS 2: it has no tables topics and messages")
        channels: dict[int, Channel] = {}
        for number, topic, kind, encoding in database.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            definition = definitions.get(kind, ("", ""))
            if asked := reading.asked(
                Channel(str(topic), str(kind), str(encoding), *(str(text or "") for text in definition))
            ):
                channels[number] = asked
        places = ",".join("?" * len(channels))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({places})"
        rows = database.execute(query, tuple(channels)) if channels else iter(())
        done = 0
        while row := _next(rows, reading):
            number, received, data = row
            if type(received) is not int or type(data) is not bytes:
                return reading.cut("or damaged (a message has no whole timestamp, or no bytes)")
            done += len(data)
            reading.at(done)
            yield channels[number], received, None, data


def _next(rows: Iterator[tuple], reading: Reading) -> tuple | None:
    """The next row, or None at the end of what can be read."""
    try:
        return next(rows, None)
    except sqlite3.DatabaseError as error:
        if isinstance(error, sqlite3.OperationalError) or "malformed" not in str(error):
            raise RecordingError(f"cannot be read: {one_line(error)[:200]}") from error
        reading.cut(f"or damaged ({one_line(error)[:200]})")
        return None


@contextmanager
def _opened(path: Path, reading: Reading) -> Iterator[sqlite3.Connection]:
    """A connection that may only read plain tables."""
    with open(path, "rb") as file:
        head = file.read(100)
    if not head.startswith(_MAGIC) or len(head) < 100:
        raise RecordingError("is no SQLite database: it does not begin like one")
    size = path.stat().st_size
    logs = [path.with_name(path.name + end) for end in ("-wal", "-journal")]  # that a killed recorder leaves
    logs = [log for log in logs if log.is_file() and 0 < log.stat().st_size <= size + 10 * MAX_MESSAGE]
    page, is_cut = _pages(head, size)
    with tempfile.TemporaryDirectory() as folder:
        if logs:
            reading.notes.append(f"{logs[0].name} is read too: what a killed recorder had not yet written or undone")
        if logs or (is_cut and size % page):
            for each in (path, *logs):
                shutil.copy(each, Path(folder, each.name))
            if is_cut:  # SQLite would fill the last page up with zeros, and read them
                os.truncate(Path(folder, path.name), size - size % page)
            address = f"{Path(folder, path.name).as_uri()}?mode=rw"
        else:
            address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(address, uri=True, isolation_level=None)) as database:
            try:
                _restrict(database, size, is_cut)
                yield database
            except sqlite3.Error as error:
                raise RecordingError(f"cannot be read: {one_line(error)[:200]}") from error


def _pages(head: bytes, size: int) -> tuple[int, bool]:
    """The bytes of a page of a database, and whether the file has fewer bytes than all its pages."""
    (page,) = struct.unpack_from(">H", head, 16)
    (pages,) = struct.unpack_from(">I", head, 28)
    page = page if page > 1 else 65536  # which two bytes cannot hold
    return page, pages * page > size


def _restrict(database: sqlite3.Connection, size: int, is_cut: bool) -> None:
    """Let nothing run but queries of plain tables, and not for long; RecordingError for other tables."""
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LENGTH)
    steps = [0]

    def count() -> int:
        steps[0] += _STEPS
        return int(steps[0] > _STEPS_PER_BYTE * size + 100 * _STEPS)

    database.set_progress_handler(count, _STEPS)
    # writable_schema lets a cut file be read as far as it goes
    for pragma in (*(["writable_schema=ON"] if is_cut else []), "trusted_schema=OFF", "query_only=ON", "mmap_size=0"):
        database.execute(f"PRAGMA {pragma}")
    for name, columns in _COLUMNS.items():
        found = database.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (name,)).fetchall()
        if not found:
            continue
        if len(found) > 1 or found[0][0] != "table" or "VIRTUAL" in str(found[0][1]).split("(")[0].upper():
            raise RecordingError(f"{name} is no plain table")
        rows = database.execute(f"PRAGMA table_xinfo({name})").fetchall()
        if not columns <= {row[1] for row in rows} or any(row[6] for row in rows):
            raise RecordingError(f"the table {name} has not the columns {', '.join(sorted(columns))}, or computes some")
    database.set_authorizer(_allowed)


def _allowed(action: int, table: str | None, *_: object) -> int:
    known = table is None or table in _COLUMNS or table.startswith("sqlite_")
    return sqlite3.SQLITE_OK if action in _READS and known else sqlite3.SQLITE_DENY


def _has(database: sqlite3.Connection, name: str) -> bool:
    return bool(database.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?", (name,)).fetchall())
