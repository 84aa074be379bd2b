"""Files: nobody ever sees half of one, and none from a stranger is read without end. Errors: one line."""

import io
import os
import re
import subprocess
import sys
import time
import tracemalloc
from functools import partial
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest

from soro_bench.diagnosis.robots.robot_map import read_mapping
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.effect import load_effects
from soro_bench.errors import SeveralErrors, one_line, plain_errors
from soro_bench.files import check_folder, check_output, is_temporary, read_json, read_toml, replacing, write_json
from soro_bench.markdown import table
from soro_bench.models.simulation import quiet
from soro_bench.randomization import load
from soro_bench.recording.importers.mapping import load_mapping
from soro_bench.sources import claim


@pytest.mark.parametrize(("path", "said"), [
    ("a.csv", "expected a name that ends in .json"),
    ("folder.json", "is a folder"),
    ("file/a.json", "is no folder, or one that may not be written to"),
    ("a\udce9.json", "expected a name in UTF-8"),
])  # fmt: skip
def test_where_nothing_can_be_written_is_said_before_the_work(tmp_path, path, said):
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "file").touch()
    check_output(tmp_path / "new" / "a.json", ".json")
    with pytest.raises(ValueError, match=said):
        check_output(tmp_path / path, ".json")
    assert not (tmp_path / "new").exists()


@pytest.mark.skipif(os.name != "posix", reason="needs a file system that tells how long names may be")
def test_a_name_is_as_long_as_the_file_system_allows_or_refused_before_the_work(tmp_path):
    allowed = os.pathconf(tmp_path, "PC_NAME_MAX")
    name = (allowed - 5) // 2 * "é" + (allowed - 5) % 2 * "a" + ".json"
    check_output(tmp_path / "new" / name, ".json")
    write_json(tmp_path / name, 1)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    for path in (tmp_path / f"a{name}", tmp_path / f"a{name}" / "a.json"):
        with pytest.raises(ValueError, match=rf"has {allowed + 1} bytes; {tmp_path} allows at most {allowed}$"):
            check_output(path, ".json")


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that nobody may write to")
def test_a_folder_that_nobody_may_write_to_is_said_before_the_work():
    with pytest.raises(ValueError, match=r"/proc/new cannot be written to: /proc is no folder, or one that may not be"):
        check_folder(Path("/proc/new"))


def killed(path: Path) -> Path:
    """The temporary file of a process that was killed while it wrote ``path``."""
    code = "import os, sys; from soro_bench import files\nwith files.replacing(sys.argv[1]): os.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", code, str(path)], check=False).returncode == -9
    (temporary,) = (each for each in path.parent.iterdir() if is_temporary(each))
    return temporary


def aged(path: Path, seconds: float) -> Path:
    then = time.time() - seconds
    os.utime(path, (then, then))
    return path


def test_a_run_that_was_killed_as_it_claimed_its_folder_claims_it_again(tmp_path):
    killed(tmp_path / "method.txt")
    claim(tmp_path / "method.txt", "abc")
    assert (tmp_path / "method.txt").read_text() == "abc\n"


def test_what_killed_processes_were_writing_is_swept_and_nothing_else(tmp_path):
    ours = killed(tmp_path / "a.json")
    foreign = tmp_path / ours.name.replace(".a.json.", ".b.json.0")[:-1]  # no name of ours
    other_machine = tmp_path / re.sub(r"[0-9a-f]{8}-", "00000000-", ours.name, count=1)
    for path in (foreign, other_machine):
        path.touch()
    with replacing(tmp_path / "c.json") as living:
        for path in (ours, foreign, other_machine, living):
            aged(path, 3600)
        write_json(tmp_path / "d.json", 1)
        assert living.exists()
    assert {path.name for path in tmp_path.iterdir()} == {"c.json", "d.json", foreign.name, other_machine.name}
    aged(other_machine, 2 * 86400)
    write_json(tmp_path / "d.json", 2)
    assert not other_machine.exists() and foreign.exists()


@pytest.mark.parametrize("key", [
    ".".join("a" * 50_000) + " = 1", "[" + " . ".join(['"x"'] * 50_000) + "]", "'a'." * 50_000 + "b = 1",
])  # fmt: skip
def test_a_key_of_thousands_of_parts_takes_no_memory(tmp_path, key):
    (tmp_path / "a.toml").write_text(key)
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"a\.toml is no TOML file: the key .* has too many parts; at most 8 are read"):
        read_toml(tmp_path / "a.toml")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10_000_000


@pytest.mark.parametrize("reads", [read_mapping, lambda path: load_mapping(path, ())])
def test_mappings_have_the_limits_of_toml(tmp_path, reads):
    (tmp_path / "a.toml").write_text(".".join("a" * 1000) + " = 1")
    with pytest.raises(ValueError, match="too many parts"):
        reads(tmp_path / "a.toml")


def test_tables_in_tables_without_end_are_no_toml(tmp_path):
    (tmp_path / "a.toml").write_text("a = " + "[" * 100_000)
    with pytest.raises(ValueError, match=r"a\.toml is no TOML file"):
        read_toml(tmp_path / "a.toml")
    (tmp_path / "a.toml").write_text('a.b.c = "one. two. three... 1.2.3.4.5"  # 0.1, 0.2, and so on ...........\n')
    assert read_toml(tmp_path / "a.toml") == {"a": {"b": {"c": "one. two. three... 1.2.3.4.5"}}}


def test_json_that_is_cut_off_in_the_middle_leaves_the_old_file(tmp_path, monkeypatch):
    write_json(path := tmp_path / "a.json", 1)

    def half(self, text):
        self.write_bytes(b"{")
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_text", half)
    with pytest.raises(KeyboardInterrupt):
        write_json(path, 2)
    assert path.read_bytes() == b"1\n" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("read", [read_json, load, lambda path: load_effects(path, ALL), read_mapping])
def test_what_is_huge_or_no_file_is_refused_at_once(tmp_path, read):
    """A link to a device has no size, and a pipe may never end."""
    with (tmp_path / "huge").open("wb") as file:
        file.truncate(1_000_000_000)
    with pytest.raises(ValueError, match="1000000000 bytes; at most"):
        read(tmp_path / "huge")
    (tmp_path / "device").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name in ("device", "pipe", "folder"):
        with pytest.raises(ValueError, match="no regular file"):
            read(tmp_path / name)


@pytest.mark.parametrize("text", ['{"a": 1, "a": 2}', '{"a": NaN}', "[1e999]", "1" * 301])
def test_json_that_says_two_things_or_no_number_is_refused(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ValueError, match=r"a\.json is no JSON file: .*(twice|no finite number|too large)"):
        read_json(tmp_path / "a.json")


def test_files_have_the_permissions_that_the_user_wants(tmp_path):
    before = os.umask(0o077)
    try:
        write_json(tmp_path / "a.json", 1)
    finally:
        os.umask(before)
    assert (tmp_path / "a.json").stat().st_mode & 0o777 == 0o600


def test_a_table_has_a_line_per_row_and_a_vertical_bar_stays_in_its_cell():
    expected = "| case | answer |\n|---|---|\n| 1 | a\\|b |\n| 2 |  |"
    assert table(("case", "answer"), [(1, "a|b"), (2, "")]) == expected


def mujoco_error():
    with pytest.raises(ValueError) as raised:
        mujoco.MjModel.from_xml_string("<mujoco><worldbody><body><joint type='zzz'/></body></worldbody></mujoco>")
    return raised.value


def pickled(save):
    """NumPy's error on loading a file with an object that pickle would make."""
    save(file := io.BytesIO(), np.array([{}], dtype=object))
    file.seek(0)
    with pytest.raises(ValueError, match="allow_pickle") as raised:
        found = np.load(file)
        found["arr_0"]
    return raised.value


def test_the_lines_of_mujoco_become_one():
    assert "\n" in str(mujoco_error())
    assert one_line(mujoco_error()) == "XML Error: invalid keyword: 'zzz'; Element 'joint', line 1"


@pytest.mark.parametrize("save", [np.save, np.savez])
def test_nobody_is_told_to_load_pickles(save):
    said = one_line(f"a.npz: {pickled(save)}")
    assert said == "a.npz: it holds pickled Python objects, which are never loaded; only numbers are read"


def test_no_error_is_empty_or_endless_or_moves_the_cursor():
    assert one_line(MemoryError()) == "MemoryError"
    assert len(one_line("a" * 100_000)) == 1000
    assert one_line("\x1b[2J") == "\\x1b[2J"


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("a\n b\n"), "soro-bench: a; b"),
        (SeveralErrors(["2 failed:", "a: 1\n2", "b: 3"]), "soro-bench: 2 failed:\na: 1; 2\nb: 3"),
    ],
)
def test_a_command_ends_with_a_line_for_each_error(error, said):
    with pytest.raises(SystemExit) as exit, plain_errors("soro-bench"):
        raise error
    assert exit.value.code == said


def test_a_command_says_what_the_machine_lacks_and_hides_no_mistake():
    torch = pytest.importorskip("torch")
    with pytest.raises(SystemExit, match=r"^train: not enough memory: .*you tried to allocate \d+ bytes"), \
            plain_errors("train"):  # fmt: skip
        torch.empty(2**50)
    no_device = "CUDA error: no CUDA-capable device is detected"
    with pytest.raises(SystemExit) as exit, plain_errors("train"):
        raise RuntimeError(f"{no_device}\nCUDA kernel errors might be asynchronously reported\n")
    assert exit.value.code == f"train: no GPU that can be used: {no_device}"
    with pytest.raises(RuntimeError, match="cannot be multiplied"), plain_errors("train"):
        torch.zeros(2, 3) @ torch.zeros(2, 3)


@pytest.mark.parametrize("maker", [gymnasium.make, partial(gymnasium.make_vec, num_envs=2, num_threads=2)])
def test_a_simulation_that_diverges_leaves_no_log_in_the_working_directory(tmp_path, monkeypatch, capfd, maker):
    monkeypatch.chdir(tmp_path)
    env = maker("TrunkReach-v0", model="cable")
    before = mujoco.get_mju_user_warning()
    env.reset(seed=0)
    env.unwrapped.task.sim.batch.qvel[:] = 1e13
    *_, info = env.step(env.action_space.sample())
    assert np.all(info["diverged"])
    assert list(tmp_path.iterdir()) == [] and "WARNING" not in "".join(capfd.readouterr())
    assert mujoco.get_mju_user_warning() is before  # other simulations of this process warn as they did


def test_silence_ends_with_the_last_who_wants_it():
    """Threads begin and end it in any order."""
    heard = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(heard.append)
    try:
        first, second = quiet(), quiet()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert mujoco.get_mju_user_warning() != heard.append
        second.__exit__(None, None, None)
        assert mujoco.get_mju_user_warning() == heard.append
    finally:
        mujoco.set_mju_user_warning(before)
