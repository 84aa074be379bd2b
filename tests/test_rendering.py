"""Pictures, drawn in a process of their own: OpenGL is chosen at import and may end the process that tries it."""

import json
import os
import subprocess
import sys
from unittest.mock import MagicMock

import gymnasium
import pytest

SCRIPT = """
import json, sys
import gymnasium
import numpy as np
import soro_bench

try:
    env = gymnasium.make(sys.argv[1], **json.loads(sys.argv[2]), action="continuous", render_mode="rgb_array")
    env.reset(seed=0)
    pictures = [env.render()]
    again = env.render()
except RuntimeError as error:
    print(json.dumps({"missing": str(error)}))
    sys.exit()
for _ in range(4):
    env.step(np.full(env.action_space.shape, float(sys.argv[3]), np.float32))
pictures.append(env.render())
env.close()
env.close()
first, last = (picture.astype(int) for picture in pictures)
print(json.dumps({
    "shape": first.shape,
    "dtype": str(pictures[0].dtype),
    "levels": len(np.unique(first)),
    "repeatable": bool((first == again).all()),
    "moved": float((np.abs(first - last).max(axis=-1) > 20).mean()),
}))
"""


@pytest.mark.parametrize("env_id", ["TrunkReach-v0", "TrunkPush-v0", "TrunkLift-v0", "MultiGait-v0"])
def test_videos_run_in_real_time(env_id):
    """The rate of the pictures is that of the control steps."""
    env = gymnasium.make(env_id)
    assert env.metadata["render_fps"] * env.unwrapped.task.control_timestep == pytest.approx(1)
    env.close()


@pytest.mark.parametrize(("env_id", "arguments", "action"), [
    ("TrunkReach-v0", {"model": "cable"}, 0.0),
    ("TrunkPush-v0", {"model": "cable"}, 0.0),
    ("TrunkPush-v0", {"model": "flex"}, 0.0),
    ("TrunkLift-v0", {"model": "cable"}, 0.0),
    ("MultiGait-v0", {"mesh": "coarse"}, 0.3),
])  # fmt: skip
def test_rgb_array(env_id, arguments, action):
    """rgb_array gives a 480 x 640 picture with content, the same twice, which changes when the robot moves."""
    command = [sys.executable, "-c", SCRIPT, env_id, json.dumps(arguments), str(action)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120)
    if run.returncode < 0:
        pytest.skip(f"OpenGL ended the process with signal {-run.returncode}")
    assert run.returncode == 0, run.stderr
    picture = json.loads(run.stdout.splitlines()[-1])
    if "missing" in picture:
        assert "rendering needs OpenGL" in picture["missing"]  # no other reason to go without a picture
        pytest.skip(picture["missing"])
    assert picture["shape"] == [480, 640, 3]
    assert picture["dtype"] == "uint8"
    assert picture["levels"] > 20
    assert picture["repeatable"]
    assert 0.005 < picture["moved"] < 0.5


OF_MANY = """
import gymnasium
import numpy as np
import soro_bench

arguments = {"model": "cable", "action": "continuous", "render_mode": "rgb_array"}
actions = np.array([[1.0] * 8, [-1.0] * 8], np.float32)
try:
    envs = gymnasium.make_vec("TrunkReach-v0", num_envs=2, **arguments)
    envs.reset(seed=0)
    envs.step(actions)
    pictures = envs.render()
except RuntimeError as error:
    print("missing:", error)
    raise SystemExit
for i, action in enumerate(actions):
    env = gymnasium.make("TrunkReach-v0", **arguments)
    env.reset(seed=i)
    env.step(action)
    print((env.render() == pictures[i]).all(), (envs.call("render")[i] == pictures[i]).all())
    env.close()
print((pictures[0] == pictures[1]).all())
envs.close()
envs.close()
"""


def test_a_vector_environment_draws_each_simulation_as_the_single_environment_does():
    run = subprocess.run([sys.executable, "-c", OF_MANY], capture_output=True, text=True, timeout=120)
    if run.returncode < 0:
        pytest.skip(f"OpenGL ended the process with signal {-run.returncode}")
    assert run.returncode == 0, run.stderr
    if run.stdout.startswith("missing: rendering needs OpenGL"):
        pytest.skip(run.stdout)
    assert run.stdout.split() == ["True", "True", "True", "True", "False"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux can take the display away")
def test_human_mode_needs_a_display():
    """Without a display the viewer is refused with a hint, instead of ending the process."""
    code = """
import gymnasium
env = gymnasium.make("soro_bench:TrunkReach-v0", model="cable", render_mode="human")
try:
    env.reset(seed=0)
except RuntimeError as error:
    print(error)
"""
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    assert "rgb_array" in run.stdout


def test_the_viewer_shows_pictures_in_real_time(monkeypatch):
    """Though simulation is a hundred times faster: it waits for the rest of every control step."""
    viewer = MagicMock()
    monkeypatch.setattr("glfw.init", lambda: True)
    monkeypatch.setattr("mujoco.viewer.launch_passive", lambda *_: viewer)
    clock, waits = [100.0], []
    monkeypatch.setattr("soro_bench.envs.rendering.time.monotonic", lambda: clock[0])
    monkeypatch.setattr("soro_bench.envs.rendering.time.sleep", waits.append)
    env = gymnasium.make("TrunkReach-v0", model="cable", render_mode="human", disable_env_checker=True)
    env.reset(seed=0)
    clock[0] += 0.01  # what the step takes
    env.step(0)
    assert waits == pytest.approx([0.0, 0.04])
    assert viewer.sync.call_count == 2
