"""Files of a folder in one archive beside it."""

import os
import zipfile

import pytest

from soro_bench.packed import archive_of, folder_of, is_there, names, pack, read
from tests.test_bad_input import says


@pytest.fixture
def folder(tmp_path):
    """Two files, a.json in the archive only and b.json in both."""
    folder = tmp_path / "oracle"
    folder.mkdir()
    for name in ("a.json", "b.json"):
        (folder / name).write_text(f"old {name}")
    assert pack(folder, ("a.json", "b.json")) == archive_of(folder) == tmp_path / "oracle.zip"
    assert not folder.exists() and folder_of(tmp_path / "oracle.zip") == folder
    folder.mkdir()
    (folder / "b.json").write_text("new b.json")
    return folder


def archive(folder, *members, **how):
    """An archive of members (name, content) for a folder."""
    with zipfile.ZipFile(archive_of(folder), "w", **how) as file:
        for name, content in members:
            file.writestr(name, content)


def test_a_file_is_read_from_its_folder_and_else_from_the_archive(folder):
    assert names(folder) == ["a.json", "b.json"]
    assert read(folder / "a.json", 100) == b"old a.json" and read(folder / "b.json", 100) == b"new b.json"
    assert is_there(folder / "a.json") and not is_there(folder / "c.json")
    for path in (folder / "c.json", folder.parent / "other" / "a.json"):
        with pytest.raises(FileNotFoundError, match=says(str(path))):
            read(path, 100)


def test_paths_without_a_folder_are_read_from_where_one_is(folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert read("a.json", 100) == b"old a.json" and not is_there("c.json")
    assert not is_there("/c.json")


def test_what_is_packed_again_takes_the_place_of_what_was_there(folder):
    pack(folder, ["b.json"])
    assert read(folder / "b.json", 100) == b"new b.json" and read(folder / "a.json", 100) == b"old a.json"
    before = archive_of(folder).read_bytes()
    pack(folder, ["a.json"])
    assert archive_of(folder).read_bytes() == before, "the same files give the same bytes"


def test_a_file_that_could_not_be_read_again_is_not_packed(folder):
    (folder / "a b.json").write_text("")
    before = archive_of(folder).read_bytes()
    with pytest.raises(ValueError, match=says("oracle.zip", "member 'a b.json'", "allowed")):
        pack(folder, ["a b.json"])
    assert archive_of(folder).read_bytes() == before and (folder / "a b.json").exists()


@pytest.mark.parametrize("name", ["../outside.json", "/etc/passwd", "sub/seed0.json", ".hidden", "C:\\seed0.json"])
def test_members_that_are_no_plain_files_of_the_folder_are_refused(tmp_path, name):
    archive(tmp_path / "oracle", (name, "x"))
    with pytest.raises(ValueError, match=says("oracle.zip has the member", "allowed")):
        names(tmp_path / "oracle")


def test_an_archive_that_says_two_things_or_is_too_large_or_none_is_refused(tmp_path):
    folder = tmp_path / "oracle"
    with pytest.warns(UserWarning, match="Duplicate"):
        archive(folder, ("a.json", "1"), ("a.json", "2"))
    with pytest.raises(ValueError, match=says("oracle.zip has a.json twice")):
        read(folder / "a.json", 100)
    archive(folder, ("a.json", 10_000_000 * "0"), compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(ValueError, match=says("a.json", "10000000 bytes; at most 1000")):
        read(folder / "a.json", 1000)
    archive(folder, ("a.json", "1"), compression=zipfile.ZIP_LZMA)
    with pytest.raises(ValueError, match=says("oracle.zip has a.json", "deflate")):
        read(folder / "a.json", 1000)
    archive_of(folder).write_bytes(b"no archive")
    with pytest.raises(ValueError, match=says("oracle.zip is no valid archive")):
        read(folder / "a.json", 1000)
    os.truncate(archive_of(folder), 1_000_000_000)
    with pytest.raises(ValueError, match=says("oracle.zip has 1000000000 bytes")):
        read(folder / "a.json", 1000)


def test_a_member_that_was_changed_or_is_longer_than_it_says_is_refused(tmp_path):
    folder = tmp_path / "oracle"
    archive(folder, ("a.json", "content"))
    whole = archive_of(folder).read_bytes()
    archive_of(folder).write_bytes(whole.replace(b"content", b"C0ntent", 1))
    with pytest.raises(ValueError, match=says("oracle.zip is no valid archive", "CRC")):
        read(folder / "a.json", 1000)
    archive_of(folder).write_bytes(whole.replace(b"PK\x03\x04", b"PK\x03\x05", 1))
    with pytest.raises(ValueError, match=says("oracle.zip is no valid archive")):
        read(folder / "a.json", 1000)


def test_a_link_is_no_archive(tmp_path):
    archive(tmp_path / "oracle", ("a.json", "content"))
    archive_of(tmp_path / "linked").symlink_to(archive_of(tmp_path / "oracle"))
    with pytest.raises(ValueError, match=says("linked.zip is a link")):
        read(tmp_path / "linked" / "a.json", 1000)
