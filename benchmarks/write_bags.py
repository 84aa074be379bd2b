"""Small bags for tests and large ones to measure with, written by the libraries that others write theirs with."""

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

HUMBLE, NOETIC = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
JOINTS = "sensor_msgs/msg/JointState"
START, STEP, LATE = 1_719_433_753_230_789_413, 10_000_000, 1_000_000  # ns
TOPIC = "/joint_states"
PLUGINS = {"mcap": StoragePlugin.MCAP, "db3": StoragePlugin.SQLITE3}
State = tuple[int, int, Sequence[str], Sequence[float]]  # times of receipt and stamp [ns], names, positions


def mapping(fields: Sequence[str] = ("position",), time: str = "header.stamp", **others: Any) -> dict[str, Any]:
    """What a mapping says that takes one signal, q, of the topic."""
    return {"signals": {"q": {"topic": TOPIC, "fields": list(fields), "unit": "rad", "time": time, **others}}}


def states(first: int = 0, count: int = 200) -> Iterator[State]:
    """(times of receipt [ns], stamps [ns], names, positions) of messages that come 1 ms after their stamps."""
    for k in range(first, first + count):
        yield START + k * STEP + LATE, START + k * STEP, ["a", "b"], [np.sin(0.03 * k), -k]


def joint_state(store: Typestore, stamp: int, names: Sequence[str], position: Sequence[float]) -> Any:
    """A JointState without velocities and efforts."""
    types = store.types
    time = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    header = types["std_msgs/msg/Header"](*([0] if store is NOETIC else []), time, "base")
    return types[JOINTS](header, list(names), np.array(position, float), np.zeros(0), np.zeros(0))


def write_ros2(folder: Path, rows: Iterable[State], kind: str = "mcap", mode: str | None = None) -> Path:
    """A bag of ROS 2 with JointStates, as a folder."""
    writer = Ros2Writer(folder, version=9, storage_plugin=PLUGINS[kind])
    if mode:
        writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(TOPIC, JOINTS, typestore=HUMBLE)
        for received, stamp, names, position in rows:
            writer.write(
                connection, received, HUMBLE.serialize_cdr(joint_state(HUMBLE, stamp, names, position), JOINTS)
            )
    return folder


def write_ros1(path: Path, rows: Iterable[State], compression: str | None = None, **options: int) -> Path:
    """A bag of ROS 1 with JointStates."""
    writer = Ros1Writer(path)
    if compression:
        writer.set_compression(Ros1Writer.CompressionFormat[compression])
    with writer:
        writer.chunk_threshold = options.get("chunk", writer.chunk_threshold)
        connection = writer.add_connection(TOPIC, JOINTS, typestore=NOETIC)
        for received, stamp, names, position in rows:
            writer.write(
                connection, received, NOETIC.serialize_ros1(joint_state(NOETIC, stamp, names, position), JOINTS)
            )
    return path


def write_json(
    path: Path,
    rows: Iterable[tuple[int, Any]],
    compression: CompressionType = CompressionType.ZSTD,
    encoding: str = "json",
    schema: tuple[str, str, bytes] = ("s", "jsonschema", b"{}"),
    topic: str = TOPIC,
    **options: Any,
) -> Path:
    """An MCAP file of one topic with JSON messages, or bytes, at times [ns]."""
    with open(path, "wb") as file:
        writer = Writer(file, compression=compression, **options)
        writer.start()
        channel = writer.register_channel(topic, encoding, writer.register_schema(*schema))
        for time, data in rows:
            writer.add_message(channel, time, data if isinstance(data, bytes) else json.dumps(data).encode(), time)
        writer.finish()
    return path


def write_mcap(path: Path, rows: Iterable[State], **options: Any) -> Path:
    """An MCAP file with JointStates in CDR."""
    definition = HUMBLE.generate_msgdef(JOINTS, ros_version=2)[0].encode()
    data = (
        (time, bytes(HUMBLE.serialize_cdr(joint_state(HUMBLE, stamp, names, position), JOINTS)))
        for time, stamp, names, position in rows
    )
    return write_json(path, data, encoding="cdr", schema=(JOINTS, "ros2msg", definition), **options)
