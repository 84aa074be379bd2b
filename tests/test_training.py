"""PPO training: resumable, deterministic, and policies are data."""

import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs the train extra")

import torch
from safetensors.numpy import load_file, save_file

from soro_bench.effects.effect import Effect, Location, save_effects
from soro_bench.errors import plain_errors
from soro_bench.evaluation import evaluate
from soro_bench.files import read_json, write_json
from soro_bench.policies.policy import Policy, PolicyCard
from soro_bench.randomization import Uniform
from soro_bench.training.configuration import PPOConfig, default_config
from soro_bench.training.ppo import TRAINER, make_env, train

CONFIG = PPOConfig(
    "TrunkReach-v0", total_steps=600, num_envs=2, rollout_steps=100, rollouts_per_segment=1, batch_size=100, epochs=2,
    hidden=(16,), num_threads=1,
)  # fmt: skip


def _bytes(folder):
    return {name: (folder / name).read_bytes() for name in ("policy.safetensors", "policy.json")}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    train(CONFIG, folder)
    return folder


def test_interrupted_training_ends_with_the_same_bytes(trained, tmp_path):
    """A run that stops after one of three segments and goes on equals one that never stopped."""

    class Stop(Exception):
        pass

    def stop_in_second_segment(steps, total, row):
        if steps > CONFIG.segment_steps:
            raise Stop

    with pytest.raises(Stop):
        train(CONFIG, tmp_path, progress=stop_in_second_segment)
    assert not (tmp_path / "policy.json").exists()
    later = []
    train(CONFIG, tmp_path, progress=lambda steps, total, row: later.append(steps))
    assert min(later) > CONFIG.segment_steps
    assert _bytes(tmp_path) == _bytes(trained)


def test_learning_rate_and_exploration_end_with_the_training_and_not_with_a_segment(tmp_path):
    """As the checkpoints of all segments have them."""
    import torch

    seen = {}

    def look(*_):
        if (path := tmp_path / "checkpoint.pt").exists():
            found = torch.load(path, weights_only=True)
            rate = found["optimizer"]["param_groups"][0]["lr"]
            seen[found["segment"]] = rate, float(found["policy"]["log_std"].mean())

    train(replace(CONFIG, initial_log_std=-1.0, final_log_std=-2.0), tmp_path, progress=look)
    look()
    rates, deviations = zip(*seen.values(), strict=True)
    assert rates == pytest.approx([CONFIG.learning_rate * share for share in (2 / 3, 1 / 3, 0)])
    assert deviations == pytest.approx([-1.0, -1.5, -2.0])


def test_observations_that_hardly_vary_are_not_blown_up(trained, tmp_path):
    train(replace(CONFIG, observation_floor=0.1), tmp_path)
    assert Policy.load(tmp_path).tensors["std"].min() >= 0.1 > Policy.load(trained).tensors["std"].min()


def test_discrete_actions_have_no_deviation_to_lead(tmp_path):
    train(replace(CONFIG, total_steps=200, action="discrete", final_log_std=-2.0), tmp_path)


def test_two_threads_train_the_same_policy(trained, tmp_path):
    """The number of simulation threads, or of PyTorch's, does not change a byte, and PyTorch has as many as before."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        train(PPOConfig(**{**CONFIG.__dict__, "num_threads": 2}), tmp_path)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert _bytes(tmp_path) == _bytes(trained)


def test_a_policy_is_trained_with_the_physics_of_an_effects_file(trained, tmp_path):
    path = tmp_path / "effects.json"
    save_effects([Effect("actuator_delay", Location("actuator", "*"), {"delay": 0.1})], path)
    train(PPOConfig(**{**CONFIG.__dict__, "effects": str(path)}), tmp_path / "run")
    assert _bytes(tmp_path / "run") != _bytes(trained)
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["effects"][0]["parameters"] == {"delay": 0.1}
    assert "effects" not in json.loads((trained / "config.json").read_text())


def test_killed_training_loses_at_most_one_segment(trained, tmp_path):
    """After kill -9 the folder holds a complete checkpoint, and the run goes on to the same policy."""
    code = (
        "import sys, tests.test_training as t; from soro_bench.training.ppo import train;"
        "train(t.CONFIG, sys.argv[1], progress=lambda *a: print('row', flush=True))"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not (tmp_path / "checkpoint.pt").exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert (tmp_path / "checkpoint.pt").exists()
    later = []
    train(CONFIG, tmp_path, progress=lambda steps, total, row: later.append(steps))
    assert min(later) > CONFIG.segment_steps
    assert _bytes(tmp_path) == _bytes(trained)


def half(folder):
    path = folder / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def of_an_object(folder):
    """What would remove the folder if it were unpickled."""

    class Code:
        def __reduce__(self):
            return shutil.rmtree, (str(folder),)

    torch.save({"segment": 1, "policy": Code()}, folder / "checkpoint.pt")


def of_a_larger_network(folder):
    train(replace(CONFIG, hidden=(32,)), folder / "larger")
    shutil.copy(folder / "larger" / "checkpoint.pt", folder)


def of_a_longer_training(folder):
    checkpoint = torch.load(folder / "checkpoint.pt", weights_only=True)
    torch.save({**checkpoint, "segment": 4}, folder / "checkpoint.pt")


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (half, "it is cut off, or another program has written it"),
        (lambda folder: (folder / "checkpoint.pt").write_bytes(b""), "it is cut off"),
        (lambda folder: torch.save([1], folder / "checkpoint.pt"), "it has not just count, curve, mean"),
        (of_an_object, "it holds pickled Python objects, which are never loaded"),
        (of_a_larger_network, "size mismatch"),
        (of_a_longer_training, "segment 4; 1 to 3 are those of this training"),
    ],
)
def test_a_checkpoint_that_cannot_be_read_says_in_a_line_what_to_remove(trained, tmp_path, spoil, said):
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    spoil(tmp_path)
    with pytest.raises(SystemExit) as exit, plain_errors("train"):
        train(CONFIG, tmp_path)
    assert "\n" not in exit.value.code and said in exit.value.code
    assert exit.value.code.endswith("remove checkpoint.pt to train from the beginning")
    (tmp_path / "checkpoint.pt").unlink()
    train(CONFIG, tmp_path)
    assert _bytes(tmp_path) == _bytes(trained)


def test_nobody_is_told_to_remove_a_checkpoint_where_memory_is_missing(trained, tmp_path, monkeypatch):
    shutil.copytree(trained, tmp_path / "run")

    def scarce(*args, **how):
        raise RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB.")

    monkeypatch.setattr(torch, "load", scarce)
    with pytest.raises(RuntimeError, match=r"^CUDA out of memory"):
        train(CONFIG, tmp_path / "run")


def test_a_full_disk_is_said_in_a_line_and_loses_no_checkpoint(trained, tmp_path):
    """A disk that takes no file larger than 20 kB, which a checkpoint is and a curve is not."""
    code = (
        "import resource, sys, tests.test_training as t; resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "with t.plain_errors('train'): t.train(t.CONFIG, sys.argv[1])"
    )
    run = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True)
    assert run.returncode == 1 and re.fullmatch(
        r"train: .*checkpoint\.pt cannot be written: .*File too large.*; make room, and repeat the command.*\n",
        run.stderr,
    )
    train(CONFIG, tmp_path)
    assert _bytes(tmp_path) == _bytes(trained)


def test_a_folder_with_another_run_is_refused(trained):
    """Training into a folder of another configuration names what differs and changes nothing."""
    before = (trained / "config.json").read_bytes()
    with pytest.raises(ValueError, match="another learning_rate"):
        train(PPOConfig(**{**CONFIG.__dict__, "learning_rate": 1e-3}), trained)
    with pytest.raises(ValueError, match="another distribution"):
        train(CONFIG, trained, Uniform(("trunk_mass",), np.array([0.1]), np.array([0.2])))
    assert (trained / "config.json").read_bytes() == before


def test_a_run_whose_parameters_are_drawn_in_another_order_is_another_one(tmp_path):
    """Samples depend on the order, so that the run would go on with others than it began with."""
    ends = {"trunk_mass": (0.3, 0.5), "young_modulus": (3e6, 5e6)}
    boxes = [Uniform(names, *np.array([ends[name] for name in names]).T) for names in (tuple(ends), (*ends,)[::-1])]
    train(CONFIG, tmp_path, boxes[0])
    train(CONFIG, tmp_path, boxes[0])
    with pytest.raises(ValueError, match="another distribution"):
        train(CONFIG, tmp_path, boxes[1])


def test_what_cannot_be_trained_claims_no_folder(tmp_path):
    with pytest.raises(ValueError, match="unknown model 'cabel'"):
        train(replace(CONFIG, model="cabel"), tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_run_of_an_older_trainer_begins_anew(trained, tmp_path):
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    older = {**read_json(tmp_path / "config.json"), "trainer": 1}
    del older["observation_floor"]
    write_json(tmp_path / "config.json", older)
    (tmp_path / "checkpoint.pt").write_bytes(b"of the older trainer")
    train(CONFIG, tmp_path)
    assert _bytes(tmp_path) == _bytes(trained)


def test_what_does_not_say_of_which_run_it_is_is_neither_resumed_nor_replaced(trained, tmp_path):
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    (tmp_path / "config.json").unlink()
    before = _bytes(tmp_path)
    with pytest.raises(ValueError, match=r"has checkpoint\.pt, .*and no config\.json that says of which run"):
        train(replace(CONFIG, seed=7), tmp_path)
    assert _bytes(tmp_path) == before


@pytest.mark.parametrize("name", ["total_steps", "num_envs", "epochs"])
def test_counts_of_a_training_are_one_or_more(name):
    with pytest.raises(ValueError, match=f"{name} = 0; at least 1 is needed"):
        replace(CONFIG, **{name: 0})


@pytest.mark.parametrize(("env_id", "first"), [("TrunkPush-v1", "TrunkPush-v0"), ("TrunkGrasp-v0", "TrunkLift-v0")])
def test_later_tasks_are_trained_as_the_one_they_come_from(env_id, first):
    assert default_config(env_id) == replace(default_config(first), env_id=env_id)


def test_a_run_of_a_newer_trainer_or_of_another_robot_is_kept(trained, tmp_path):
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    config = read_json(tmp_path / "config.json")
    for changes, said in (
        ({"trainer": TRAINER + 1}, "a newer trainer"),
        ({"trainer": 1, "effects": []}, "another effects"),
    ):
        write_json(tmp_path / "config.json", {**config, **changes})
        before = _bytes(tmp_path)
        with pytest.raises(ValueError, match=said):
            train(CONFIG, tmp_path)
        assert _bytes(tmp_path) == before


def test_what_cannot_be_trained_deletes_no_older_run(trained, tmp_path):
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    write_json(tmp_path / "config.json", {**read_json(tmp_path / "config.json"), "trainer": 1, "rollout_steps": 1})
    before = _bytes(tmp_path)
    with pytest.raises(ValueError, match=r"no episode of .* ends in a segment"):
        train(replace(CONFIG, rollout_steps=1, rollouts_per_segment=1), tmp_path)
    assert _bytes(tmp_path) == before


@pytest.mark.parametrize("steps", [CONFIG.rollout_steps * CONFIG.rollouts_per_segment + 1, 0, -1])
def test_episodes_that_end_in_no_segment_are_refused_and_claim_no_folder(tmp_path, steps):
    with pytest.raises(ValueError, match=rf"{steps}"):
        train(replace(CONFIG, episode_steps=steps), tmp_path)
    assert not list(tmp_path.iterdir())


def test_an_episode_that_is_shorter_than_registered_may_end_in_a_shorter_segment(tmp_path):
    config = replace(CONFIG, total_steps=CONFIG.num_envs * 8, rollout_steps=8, rollouts_per_segment=1, batch_size=8)
    train(replace(config, episode_steps=5), tmp_path)
    assert (tmp_path / "policy.json").exists()


def test_exported_policy_acts_as_the_trained_network(trained):
    """The numpy policy gives the actions of Stable-Baselines3's deterministic policy."""
    import torch

    from soro_bench.training.ppo import CheckpointFolder, Curve, _restore, make_agent, make_env

    env = make_env(CONFIG, None)
    agent = make_agent(CONFIG, env)
    CheckpointFolder(trained, CONFIG, Curve()).load(lambda found: _restore(found, agent, env))
    env.training = False
    observations = np.random.default_rng(0).uniform(-0.2, 0.2, (50, 66))
    with torch.no_grad():
        expected, _ = agent.predict(env.normalize_obs(observations), deterministic=True)
    np.testing.assert_allclose(Policy.load(trained).act(observations), expected, atol=1e-5)


def test_evaluation_does_not_depend_on_how_episodes_are_batched(trained):
    """Two goals evaluated together give the bytes of each alone."""
    policy = Policy.load(trained)
    goals = [{"goal": np.array([0.02, -0.015, 0.1325])}, {"goal": np.array([0.0, 0.005, 0.12])}]
    together = evaluate(policy.act, "TrunkReach-v0", "cable", "continuous", goals)
    for episode, goal in zip(together, goals, strict=True):
        alone = evaluate(policy.act, "TrunkReach-v0", "cable", "continuous", [goal])[0]
        assert alone.metric.tobytes() == episode.metric.tobytes()
        assert alone.actions.tobytes() == episode.actions.tobytes()


BOX = Uniform(("trunk_mass", "young_modulus"), np.array([0.3, 3e6]), np.array([0.5, 6e6]))


def test_a_policy_with_a_memory_sees_the_last_observations():
    """The newest last, and zeros for those before the first."""
    seen = []

    def act(observations):
        seen.append(observations.reshape(3, -1).copy())
        return np.full((1, 8), 0.5)

    evaluate(act, "TrunkReach-v0", "cable", "continuous", [{}], max_episode_steps=4, inputs=3 * 66)
    assert not seen[0][:2].any() and not seen[1][0].any() and seen[0][2].any()
    for before, after in itertools.pairwise(seen):
        np.testing.assert_array_equal(after[:2], before[1:])
        assert (after[2] != before[2]).any()
    with pytest.raises(ValueError, match="100 inputs; observations have 66 numbers"):
        evaluate(act, "TrunkReach-v0", "cable", "continuous", [{}], inputs=100)
    with pytest.raises(ValueError, match="101 observations; at most 100 are remembered"):
        evaluate(act, "TrunkReach-v0", "cable", "continuous", [{}], inputs=101 * 66)
    with pytest.raises(ValueError, match="frames = 101; at most 100"):
        replace(CONFIG, frames=101)


def test_training_and_evaluation_remember_alike(tmp_path):
    """The same actions from the same start: what training shows the policy is what evaluation does."""
    env, shown, seen = make_env(replace(CONFIG, frames=3, num_envs=1)), [], []

    def act(observations):
        seen.append(observations[0])
        return np.full((1, 8), 0.5)

    env.seed(0)
    env.reset()
    for _ in range(4):
        shown.append(env.get_original_obs()[0])
        env.step(np.full((1, 8), 0.5))
    goal = {"goal": env.venv.unwrapped.envs.task.goal[0]}
    evaluate(act, "TrunkReach-v0", "cable", "continuous", [goal], max_episode_steps=4, inputs=3 * 66)
    np.testing.assert_allclose(seen, shown, atol=1e-12)


def test_a_policy_is_told_the_parameters_of_its_episode():
    """The last observation of an episode those of that episode, not those of the next one."""
    env = make_env(replace(CONFIG, episode_steps=3), BOX, BOX.names)
    task = env.venv.envs.task
    columns = [task.parameters.names.index(name) for name in BOX.names]
    env.reset()
    for step in range(1, 8):
        before = task.sim.params[:, columns].copy()
        _, _, done, infos = env.step(np.zeros((2, 8)))
        np.testing.assert_array_equal(env.get_original_obs()[:, 66:], task.sim.params[:, columns])
        assert done.all() == (step % 3 == 0)
        for i in np.flatnonzero(done):
            last = env.unnormalize_obs(infos[i]["terminal_observation"])[66:]
            np.testing.assert_allclose(last, before[i], rtol=1e-6)
            assert (before[i] != task.sim.params[i, columns]).all()


def test_a_policy_is_told_no_parameter_that_the_robot_has_not(tmp_path):
    with pytest.raises(ValueError, match="the robot has no parameter 'mass'; it has trunk_mass"):
        train(CONFIG, tmp_path / "run", BOX, told={"mass": 0.4})
    assert not (tmp_path / "run").exists()


def test_what_a_policy_is_told_is_part_of_it():
    """It acts on the rest of an observation as on the whole."""
    rng = np.random.default_rng(0)
    tensors = {"mean": rng.normal(size=5), "std": np.ones(5), "w0": rng.normal(size=(4, 5)), "b0": rng.normal(size=4),
               "w1": 0.2 * rng.normal(size=(2, 4)), "b1": np.zeros(2)}  # fmt: skip
    policy = Policy(PolicyCard("TrunkReach-v0", "cable", "continuous", "own", 0, 1), tensors)
    seen, values = rng.normal(size=(7, 3)), np.array([0.3, -50.0])
    whole = np.hstack([seen, np.tile(values, (7, 1))])
    told = policy.told(values)
    assert told.inputs == 3
    np.testing.assert_allclose(told.act(seen), policy.act(whole), atol=1e-12)


def test_a_policy_is_told_other_values_without_training(tmp_path):
    train(CONFIG, tmp_path, BOX, told={"trunk_mass": 0.4, "young_modulus": 4e6})
    first, more = _bytes(tmp_path), []
    train(CONFIG, tmp_path, BOX, lambda *_: more.append(1), told={"trunk_mass": 0.3, "young_modulus": 4e6})
    assert not more
    assert read_json(tmp_path / "config.json")["told"]["trunk_mass"] == 0.3
    assert _bytes(tmp_path)["policy.safetensors"] != first["policy.safetensors"]
    told = _bytes(tmp_path)
    train(CONFIG, tmp_path, BOX, told={"young_modulus": 4e6, "trunk_mass": 0.3})  # in another order
    assert _bytes(tmp_path) == told
    with pytest.raises(ValueError, match="another told"):
        train(CONFIG, tmp_path, BOX, told={"trunk_mass": 0.4})


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "policy.json").unlink(), "policy.json is missing"),
        (lambda f: (f / "policy.json").write_text("{"), "no JSON file"),
        (lambda f: (f / "policy.json").write_text(json.dumps({"env_id": 1})), "no valid policy"),
        (lambda f: (f / "policy.safetensors").write_bytes(b"\x80\x04pickle"), "no valid policy"),
        (lambda f: (f / "policy.safetensors").write_bytes((f / "policy.safetensors").read_bytes()[:200]), "no valid"),
        (lambda f: _rewrite(f, "w0", lambda w: w[:, 1:]), "do not fit together"),
        (lambda f: _rewrite(f, "b0", lambda b: b * np.nan), "not finite"),
    ],
)
def test_a_spoilt_policy_is_refused(trained, tmp_path, spoil, message):
    """Missing, truncated, foreign, misshapen and NaN files give a clear error."""
    for name, content in _bytes(trained).items():
        (tmp_path / name).write_bytes(content)
    spoil(tmp_path)
    with pytest.raises(ValueError, match=message):
        Policy.load(tmp_path)


def _rewrite(folder, name, change):
    tensors = load_file(str(folder / "policy.safetensors"))
    tensors[name] = np.ascontiguousarray(change(tensors[name]))
    save_file(tensors, str(folder / "policy.safetensors"))
