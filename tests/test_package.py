"""The package: its assets, its registration, and what importing it does not need."""

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import soro_bench
from benchmarks.lift_rounding import RECORDED, SEQUENCES, TOLERANCE, copies
from soro_bench.assets import mjcf_path
from soro_bench.leaderboard.strict import read_strict

CHECKOUT = Path(soro_bench.__file__).parents[1]
EPISODE_STEPS = {"TrunkReach-v0": 100, "TrunkPush-v0": 100, "TrunkLift-v0": 100, "MultiGait-v0": 6}
USE = "import gymnasium; env = gymnasium.make('soro_bench:TrunkPush-v0', model='cable'); env.reset(seed=0); env.step(3)"


def run_python(code, cwd):
    """Run ``code`` in a fresh interpreter that finds packages in ``cwd`` first; return what it printed."""
    run = subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    return run.stdout.strip()


@pytest.mark.parametrize("name", ["trunk.xml", "reach.xml", "push.xml", "lift.xml"])
def test_assets_are_found(name):
    """Every scene file is found."""
    assert mjcf_path(name).read_text().startswith("<!--")


def test_missing_asset():
    """A file that is not there is named."""
    with pytest.raises(FileNotFoundError, match=r"moon\.xml"):
        mjcf_path("moon.xml")


@pytest.mark.parametrize("env_id", soro_bench.ENV_IDS)
def test_import_registers_environments(env_id):
    """Importing the package registers its environments, single and vector."""
    spec = gymnasium.spec(env_id)
    assert spec.max_episode_steps == EPISODE_STEPS[env_id]
    assert spec.vector_entry_point is not None


def test_module_id_in_a_fresh_interpreter():
    """gymnasium.make("soro_bench:TrunkPush-v0") imports the package by itself."""
    assert run_python(f"{USE}; print(env.unwrapped.spec.id)", CHECKOUT) == "TrunkPush-v0"


def test_environments_need_no_extras():
    """Making and stepping an environment imports neither torch, Stable-Baselines3, Rerun, PyArrow nor other extras."""
    extras = ("torch", "stable_baselines3", "rerun", "matplotlib", "scipy", "tyro", "pyarrow", "rosbags")
    assert run_python(f"{USE}; import sys; print([m for m in {extras} if m in sys.modules])", CHECKOUT) == "[]"


def test_assets_inside_the_package(tmp_path):
    """As in an installed wheel, the package works with its assets inside it and no checkout around it."""
    shutil.copytree(CHECKOUT / "soro_bench", tmp_path / "soro_bench", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(CHECKOUT / "assets", tmp_path / "soro_bench" / "assets", dirs_exist_ok=True)
    found = run_python(f"{USE}; from soro_bench.assets import mjcf_path; print(mjcf_path('push.xml'))", tmp_path)
    assert Path(found).resolve() == (tmp_path / "soro_bench/assets/mjcf/push.xml").resolve()


@pytest.mark.parametrize(
    "part", ["soro_bench/parameters.py", "assets/mjcf/trunk.xml", "assets/mjcf/real/bam_servo.xml"]
)
def test_another_simulation_is_another_version_of_the_method(part, tmp_path):
    for folder in ("soro_bench", "assets"):
        shutil.copytree(CHECKOUT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    code = "from soro_bench.sources import method_version; print(method_version())"
    before = run_python(code, tmp_path)
    (tmp_path / part).write_text((tmp_path / part).read_text() + "\n")
    assert run_python(code, tmp_path) != before


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="EGL is asked for on Linux only")
def test_without_egl_the_package_is_imported_all_the_same():
    """With MUJOCO_GL=egl MuJoCo could not be."""
    code = "import ctypes.util, os; ctypes.util.find_library = lambda _: None; import soro_bench; print(os.environ)"
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    assert "MUJOCO_GL" not in run.stdout


SCRIPTS = [path for folder in ("benchmarks", "baselines", "docs/images") for path in (CHECKOUT / folder).glob("*.py")]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_what_scripts_import_is_there(script, monkeypatch):
    """Slow scripts are not run by tests; what they take from the package still has to exist."""
    pytest.importorskip("stable_baselines3", reason="needs all extras")
    monkeypatch.syspath_prepend(script.parent)
    runpy.run_path(str(script), run_name="imported")


# contacts on `flex` amplify the last bit, so that another processor sees another course
# (docs/archive/tasks_and_models.md)
COPIES = 6


@pytest.mark.parametrize("path", SEQUENCES, ids=lambda path: path.stem)
def test_sequence_holds_the_recorded_elevation(path):
    """Each copy of the object on `cable`, and one of them at least on `flex`."""
    sequence = read_strict(path)
    assert len(sequence["actions"]) == 100
    found, recorded = copies(sequence, COPIES), [sequence[key] for key in RECORDED]
    as_recorded = np.isclose(found, recorded, rtol=0, atol=TOLERANCE).all(axis=1)
    assert as_recorded.all() if sequence["model"] == "cable" else as_recorded.any(), found
