"""Errors of other libraries reach a user as one line of ours."""

import io

import mujoco
import numpy as np
import pytest

from soro_bench.errors import SeveralErrors, one_line, plain_errors


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
