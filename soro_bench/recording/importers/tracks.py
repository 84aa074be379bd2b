"""What a motion capture system followed: markers, rigid bodies and channels by name, each with times of its own.

The files of Motive, Vicon, Qualisys and OpenSim (soro_bench.recording.importers.motion_capture) and C3D files
(soro_bench.recording.importers.c3d_file) become tracks, of which a mapping chooses some by name.
"""

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from soro_bench.files import parsed_toml
from soro_bench.recording.importers.mapping import MAX_BYTES as MAX_MAPPING
from soro_bench.recording.importers.mapping import Source, load_mapping, texts
from soro_bench.recording.importers.units import of_text
from soro_bench.recording.recording import Recording, RecordingError
from soro_bench.recording.untrusted import EXPANSION, MAX_BYTES, named_errors, read_bytes

GROUPS = ("markers", "bodies", "rotations", "channels")
_MANY = 50  # signals that are written out


@dataclass(frozen=True)
class Track:
    """One thing that was followed.

    Args:
        time: (T,) s; None where the file has no times.
        values: (T, k) in the unit of the file; NaN where it was not seen.
        unit: as in units.py; "" where the file does not say one that is known.
    """

    time: np.ndarray | None
    values: np.ndarray
    unit: str = ""


@dataclass(frozen=True)
class Tracks:
    """Everything in a file.

    Args:
        kind: of file, for messages.
        markers: positions (T, 3).
        bodies: positions of rigid bodies (T, 3).
        rotations: of rigid bodies, as quaternions w, x, y, z (T, 4), or as the angles of the file (T, 3).
        channels: analogue signals (T, 1).
        notes: what was left out.
    """

    kind: str
    markers: dict[str, Track] = field(default_factory=dict)
    bodies: dict[str, Track] = field(default_factory=dict)
    rotations: dict[str, Track] = field(default_factory=dict)
    channels: dict[str, Track] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def named(self, group: str, name: str) -> Track:
        """A track by its name, or by what follows the subject in it, as in ``subject:marker``."""
        tracks = getattr(self, group)
        if name in tracks:
            return tracks[name]
        found = [full for full in tracks if full.rpartition(":")[2] == name]
        if len(found) != 1:
            label = f"{len(found)} {group} are" if found else f"none of the {group} is"
            there = ", ".join(ascii(each)[1:-1] for each in found or tracks)[:200] or "none"
            raise RecordingError(f"{label} called {ascii(name)[:80]}; there are {there}")
        return tracks[found[0]]


def import_tracks(
    path: str | Path, tracks: Tracks, mapping: str | Path | Mapping, max_bytes: int = MAX_BYTES
) -> Recording:
    """The recording of what a mapping chooses; RecordingError says what is wrong with it."""
    spec = load_mapping(mapping, GROUPS, ("interval", "rate"), unit_optional=True)

    def read(source: Source) -> tuple[np.ndarray, np.ndarray]:
        """(T,) times [s] and the numbers of the tracks: (T, k) of one, (T, n, k) of n; (T, n) of n channels."""
        group, found = _found(source, tracks)
        if len({track.values.shape for track in found}) > 1:
            raise RecordingError(f"these {group} have different lengths; take them one by one")
        if found[0].time is not None and (counted := [key for key in ("interval", "rate") if key in spec.time]):
            raise RecordingError(f"the file has times of its own; leave [time] {counted[0]} out")
        time = spec.counted(len(found[0].values)) if found[0].time is None else found[0].time
        numbers = np.stack([track.values for track in found], axis=1)
        if len(found) == 1 or group == "channels":
            numbers = numbers.reshape(len(numbers), -1)
        seen = ~np.isnan(numbers.reshape(len(numbers), -1)).all(axis=1) & ~np.isnan(time)
        if not seen.any():
            raise RecordingError(f"these {group} are never seen")
        return time[seen], numbers[seen]

    with named_errors(path):
        for note in tracks.notes:
            spec.notes.add("the file", note)
        return spec.recording(read, Path(path).name, EXPANSION * max_bytes, partial(_unit, tracks=tracks))


def written(tracks: Tracks) -> str:
    """A mapping (TOML) that takes every track, to be corrected."""
    lines = [f"# {tracks.kind}: times, units and names are those of the file"]
    if any(track.time is None for track in (*tracks.markers.values(), *tracks.bodies.values())):
        lines += ["[time]", "# interval = ...  # s between rows: the file has no times"]
    entries = [(group, name, track) for group in GROUPS for name, track in getattr(tracks, group).items()]
    lines += ["", "# [commands.NAME]: commands are in another file, or among the channels below"]
    for count, (group, name, track) in enumerate(entries):
        prefix = "" if count < _MANY else "# "  # a mapping has a limited number of signals
        label = signal_name(name) + ("_rotation" if group == "rotations" else "")
        entry = ["", f"[signals.{label}]", f"{group} = [{json.dumps(name)}]"]
        if not track.unit:
            entry.append('unit = "1"  # the file does not say one that is known')
        if group in ("markers", "bodies"):
            entry.append('frame = "world"  # if the axes of the capture are those of the robot')
        lines += [prefix + line if line else line for line in entry]
    return "\n".join(lines) + "\n"


def signal_name(name: str) -> str:
    """A name that a signal may have, after one in a file."""
    letters = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in name).strip("_")
    return (letters if letters[:1].isalpha() else f"s_{letters}")[:50]


def _found(source: Source, tracks: Tracks) -> tuple[str, list[Track]]:
    """The tracks of a command or signal, and in which group they are."""
    if len(source.place) != 1:
        raise RecordingError(f"expected one of {', '.join(GROUPS)}, each a list of names")
    ((group, names),) = source.place.items()
    found = [tracks.named(group, name) for name in texts(group, names)]
    if len(units := {track.unit for track in found}) > 1:
        raise RecordingError(f"units {sorted(units)} differ; take these {group} one by one")
    if source.unit is not None and found[0].unit not in ("", source.unit):
        raise RecordingError(f"unit = {source.unit!r}, and the file says {found[0].unit!r}; leave unit out")
    return group, found


def _unit(source: Source, tracks: Tracks) -> str:
    """The unit that the file says."""
    group, found = _found(source, tracks)
    if not found[0].unit:
        raise RecordingError(f"the file says no unit of these {group} that is known; the mapping needs unit = ...")
    return found[0].unit


def mentions(mapping: str | Path | Mapping, keys: Collection[str]) -> bool:
    """Whether a command or signal of a mapping has one of these keys."""
    try:
        table = mapping if isinstance(mapping, Mapping) else parsed_toml(read_bytes(mapping, MAX_MAPPING).decode())
    except (OSError, ValueError, RecursionError):
        return False  # load_mapping says what is wrong with it
    sections = [table.get(section) for section in ("commands", "signals")]
    entries = [entry for section in sections if isinstance(section, dict) for entry in section.values()]
    return any(isinstance(entry, dict) and not entry.keys().isdisjoint(keys) for entry in entries)


def known_unit(text: str) -> str:
    """The name that units.py has for a unit in a file; "" if it has none."""
    return (of_text(text) or "") if text.strip() else ""


def continuous(quaternions: np.ndarray) -> np.ndarray:
    """(T, 4) quaternions whose sign does not jump, so that they can be interpolated."""
    seen = ~np.isnan(quaternions).any(axis=1)
    rows = quaternions[seen]
    turned = np.cumprod(np.where((rows[1:] * rows[:-1]).sum(axis=1) < 0, -1.0, 1.0))
    found = quaternions.copy()
    found[np.flatnonzero(seen)[1:]] *= turned[:, None]
    return found


def read_text(path: str | Path, max_bytes: int) -> str:
    """The text of an export. Only names can hold letters beyond ASCII, so that an old code page does no harm."""
    data = read_bytes(path, max_bytes)
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")
