"""Published recordings: fetched, converted, checked; nothing here needs a network or the recordings."""

import hashlib
import io
import json
import re

import pytest

from soro_bench.cli import Data
from soro_bench.recording import published
from soro_bench.recording.published import PublishedFile, Source, bam_table, fetch, sources, summary

ENTRY = {
    "position": -0.0123456789, "speed": 0.5, "load": 65535.12345, "input_volts": 7.35049, "temp": 28.96,
    "goal_position": -1e-7, "torque_enable": False, "timestamp": 0.17500000000000002,
}  # fmt: skip
HEADER = b"t_s,goal_rad,pos_rad,speed_rad_s,load,volts,temp_C,torque_enable\r\n"
TABLE = HEADER + b"0.175,-0.0,-0.012346,0.5,65535.123,7.35,29.0,0\r\n"
LOG = json.dumps({"kp": 100, "entries": [ENTRY], "dt": 0.005}).encode()
FETCHED = [("a.csv", "dir/take 1.csv", b"t,x\n0,1\n", b"t,x\n0,1\n"), ("b.csv", "dir/take.json", LOG, TABLE)]


def source_of(name="a.csv", original="dir/take 1.csv", content=b"t,x\n0,1\n"):
    """A source of one file."""
    file = PublishedFile(name, hashlib.sha256(content).hexdigest(), original)
    return Source("arm", "https://github.com/lab/arm", "0123abc", "MIT", (file,), "Columns: t, x.")


@pytest.fixture
def web(monkeypatch):
    """What is published: content or error by address; and the addresses that were asked for."""
    contents, asked = {}, []

    def urlopen(address, timeout):
        asked.append(address)
        content = contents[address]
        if isinstance(content, Exception):
            raise content
        response = io.BytesIO(content)
        response.url = contents.get("redirect", address)
        return response

    monkeypatch.setattr(published, "urlopen", urlopen)
    return contents, asked


def files_in(folder):
    """All files below a folder, hidden ones too."""
    return [path.name for path in folder.rglob("*") if path.is_file()]


def test_known_sources():
    """Every robot has a licence, a page and checksums; what cannot be fetched has a text about it."""
    assert list(sources()) == ["opencr_tdcr", "bam_servo", "asl_trunk", "silicone_beam_arm"]
    for source in sources().values():
        assert re.fullmatch(r"https://github\.com/[\w.-]+/[\w.-]+", source.repository)
        assert source.licence in ("MIT", "Apache-2.0")
        assert all(re.fullmatch("[0-9a-f]{64}", file.sha256) for file in source.files)
        fetched = [file.conversion is not None for file in source.files]
        assert bool(source.by_hand) != all(fetched)
        assert not any(fetched) or re.fullmatch("[0-9a-f]{40}", source.commit)


def test_bam_table():
    """Numbers are rounded, booleans are 0 and 1."""
    assert bam_table(LOG) == TABLE


@pytest.mark.parametrize("log", [b"", b"404", b"[]", b"{}", b'{"entries": [{}]}', b'{"entries": 3}', b"\xff" * 9])
def test_no_bam_log(log):
    """Something else is refused."""
    with pytest.raises(ValueError, match="no log of a servo"):
        bam_table(log)


@pytest.mark.parametrize(("name", "original", "sent", "content"), FETCHED)
def test_fetch(web, tmp_path, name, original, sent, content):
    """A file is fetched from the commit and converted if need be; a second time it is not fetched."""
    contents, asked = web
    source = source_of(name, original, content)
    address = f"https://raw.githubusercontent.com/lab/arm/0123abc/{original.replace(' ', '%20')}"
    contents[address] = sent
    for _ in range(2):
        fetch(source, tmp_path / "arm")
        assert (tmp_path / "arm" / name).read_bytes() == content
        assert asked == [address]
    assert summary("arm", source, tmp_path / "arm").splitlines() == [
        "arm: arm; MIT", "    https://github.com/lab/arm/tree/0123abc", f"    {tmp_path / 'arm'}: 1 of 1 files",
    ]  # fmt: skip


REFUSED = [
    (b"t,x\n0,2\n", ValueError, ("a.csv", hashlib.sha256(b"t,x\n0,2\n").hexdigest(), "expected", "take%201.csv")),
    (b" " * 101, ValueError, ("take%201.csv", "more than 100 bytes")),
    (OSError("no route"), OSError, ("take%201.csv", "no route")),
]


@pytest.mark.parametrize(("content", "error", "parts"), REFUSED)
def test_refused(web, tmp_path, monkeypatch, content, error, parts):
    """Wrong content, too much, or none: the error names the file, and nothing is kept."""
    monkeypatch.setattr(published, "MAX_BYTES", 100)
    web[0]["https://raw.githubusercontent.com/lab/arm/0123abc/dir/take%201.csv"] = content
    with pytest.raises(error, match="(?s)" + ".*".join(map(re.escape, parts))):
        fetch(source_of(), tmp_path)
    assert files_in(tmp_path) == []


def test_no_https(web, tmp_path):
    """A redirection to plain http is refused."""
    contents, _ = web
    contents["https://raw.githubusercontent.com/lab/arm/0123abc/dir/take%201.csv"] = b"t,x\n0,1\n"
    contents["redirect"] = "http://elsewhere/take.csv"
    with pytest.raises(OSError, match="not https"):
        fetch(source_of(), tmp_path)
    assert files_in(tmp_path) == []


def test_other_file_is_left(web, tmp_path):
    """A file that is there with another checksum is neither fetched nor overwritten."""
    (tmp_path / "a.csv").write_bytes(b"mine")
    found = hashlib.sha256(b"mine").hexdigest()
    with pytest.raises(ValueError, match=rf"a\.csv: SHA-256 is {found}, expected {source_of().files[0].sha256}"):
        fetch(source_of(), tmp_path)
    assert (tmp_path / "a.csv").read_bytes() == b"mine"
    assert web[1] == []
    assert "0 of 1 files\n    a.csv has another checksum" in summary("arm", source_of(), tmp_path)


@pytest.mark.parametrize("original", ["", "dir/take.c3d"])
def test_by_hand(web, tmp_path, original):
    """A file without a known conversion is not fetched: its page and columns are named. Once there, it is checked."""
    source = source_of(original=original)
    with pytest.raises(ValueError, match=r"(?s)tree/0123abc.*Columns: t, x.*a\.csv.*" + re.escape(original)):
        fetch(source, tmp_path)
    assert "0 of 1 files; 1 not fetched" in summary("arm", source, tmp_path)
    (tmp_path / "a.csv").write_bytes(b"t,x\n0,1\n")
    fetch(source, tmp_path)
    assert web[1] == []


def test_command(web, tmp_path, capsys):
    """Without a robot all are listed; an unknown one is an error; nothing is fetched."""
    Data(out=tmp_path).run()
    listed = capsys.readouterr().out
    assert all(part in listed for name, source in sources().items() for part in (name, source.page, source.licence))
    with pytest.raises(ValueError, match="'moon' is unknown; there are opencr_tdcr, bam_servo"):
        Data(("moon",), tmp_path).run()
    assert web[1] == [] and files_in(tmp_path) == []
