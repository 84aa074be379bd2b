"""The how-to pages: what they say to write works."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import soro_bench

CHECKOUT = Path(soro_bench.__file__).parents[1]
BLOCK = re.compile(r"```(python|diff|xml)\n(.*?)```", re.DOTALL)
FILE = re.compile(r"`((?:soro_bench|assets)/[\w/]+\.(?:py|xml))`")
TRY = """
import gymnasium, soro_bench, numpy as np
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.diagnosis.candidates import terms
env = gymnasium.make("FingerReach-v0", model="coarse")
start, _ = env.reset(seed=0, options={"params": {"finger_mass": 0.025}})
assert env.observation_space.contains(start)
assert env.step(2)[1] < 0
envs = gymnasium.make_vec("FingerReach-v0", num_envs=2, action="continuous")
envs.reset(seed=0)
assert envs.step(np.zeros((2, 1), np.float32))[0].shape == (2, 7)
assert terms(SuiteRobot("FingerReach-v0", threads=1))
print(soro_bench.__file__)
"""


def follow(page: str, root: Path) -> None:
    """Write the files of a page and apply its changes, each to the file that is named last before it."""
    for block in BLOCK.finditer(page):
        named = FILE.findall(page[: block.start()])
        if not named or "tests/" in page[page.rfind("\n\n", 0, block.start() - 2) : block.start()]:
            continue  # what is to be tried, and tests
        path, (kind, text) = root / named[-1], block.groups()
        if kind == "diff":
            old, new = ("".join(f"{line[1:]}\n" for line in text.splitlines() if line[:1] in f" {sign}")
                        for sign in "-+")  # fmt: skip
            assert old in path.read_text(), f"{path} has no longer what the page changes"
            path.write_text(path.read_text().replace(old, new, 1))
        elif not path.exists():
            path.write_text(text)


def test_an_environment_that_is_added_as_the_page_says_is_made_stepped_and_diagnosed(tmp_path):
    page = CHECKOUT / "docs" / "how_to" / "add_an_environment.md"
    if not page.exists():
        pytest.skip("needs a checkout")
    for folder in ("soro_bench", "assets"):
        shutil.copytree(CHECKOUT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    follow(page.read_text(), tmp_path)
    run = subprocess.run([sys.executable, "-c", TRY], cwd=tmp_path, capture_output=True, text=True, timeout=120,
                         env={"PYTHONPATH": str(tmp_path), "MUJOCO_GL": "egl", "PATH": ""})  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert str(tmp_path) in run.stdout
