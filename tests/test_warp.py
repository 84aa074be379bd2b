"""Environments in MuJoCo Warp, which also runs on a CPU; skipped without the gpu extra."""

import json
import pickle

import gymnasium
import numpy as np
import pytest

import soro_bench
from soro_bench.randomization import search_box
from soro_bench.registration import task_type

pytest.importorskip("mujoco_warp")
torch = pytest.importorskip("torch")

from soro_bench.envs.torch_vector import TorchVectorEnv  # noqa: E402
from soro_bench.models.warp_simulation import WorldError  # noqa: E402
from soro_bench.training.ppo import train  # noqa: E402

WORLDS = 3
SLACK = -1e-6  # m: at rest cables are neither slack nor taut, and rounding decides which


def torch_env(env_id="TrunkReach-v0", **options):
    return TorchVectorEnv(env_id, WORLDS, device="cpu", **options)


def vector_env(env_id="TrunkReach-v0", **options):
    kind = task_type(env_id)
    return gymnasium.make_vec(env_id, WORLDS, vectorization_mode="vector_entry_point",
                              **{kind.variant_name: kind.cheap}, **options)  # fmt: skip


@pytest.fixture(scope="module")
def reach():
    return torch_env(distribution=search_box(task_type("TrunkReach-v0").randomized), max_episode_steps=3)


def test_starts_are_those_of_the_cpu(reach):
    """Goals and parameters of all episodes, also of those that begin in a step."""
    envs = vector_env(action="continuous", max_episode_steps=3, autoreset_mode="SameStep")
    envs.task.randomize(search_box(envs.task.randomized))
    _, info = envs.reset(seed=5)
    _, found = reach.reset(seed=5)
    actions = np.zeros((WORLDS, 8), np.float32)
    for step in range(7):
        for name, values in info["params"].items():
            if not name.startswith("_"):
                np.testing.assert_allclose(found["params"][name].numpy(), values, rtol=1e-6)
        np.testing.assert_allclose(reach.task.goal.numpy(), envs.task.goal, atol=1e-7)
        _, _, _, truncated, info = envs.step(actions)
        *_, cut, found = reach.step(torch.as_tensor(actions))
        assert cut.tolist() == truncated.tolist() == [step % 3 == 2] * WORLDS
        if truncated.any():
            found = reach.task._info(reach._everyone)


def test_a_world_begins_in_a_given_state(reach):
    """All in that of the first one."""
    reach.reset(seed=0)
    observation, *_ = reach.step(torch.ones((WORLDS, 8)))
    state = {name: rows[0] for name, rows in reach.task.state(reach._everyone).items()}
    begun, _ = reach.reset(seed=1, options=[{"state": state}] * WORLDS)
    np.testing.assert_allclose(begun.numpy()[:, :63], np.tile(observation.numpy()[0, :63], (WORLDS, 1)), atol=1e-6)


@pytest.mark.parametrize("env_id", soro_bench.ENV_IDS)
def test_moves_as_mujoco(env_id):
    """To 1e-5 m before anything touches, where single precision leaves 1e-7 m; 1e-4 m for the walker on its floor."""
    cpu = vector_env(env_id, action="continuous")
    device = vector_env(env_id, action="continuous", backend="warp", device="cpu")
    trunk = env_id.startswith("Trunk")
    for envs in (cpu, device):
        envs.task.randomize(search_box(envs.task.randomized) if trunk else None)
        envs.reset(seed=3)
        if trunk:
            envs.task.sim.batch.bind("act")[:] = SLACK
            envs.task.sim.begin(envs.task.sim.array(np.arange(WORLDS)))
    rng = np.random.default_rng(0)
    for _ in range(2):
        actions = rng.uniform(-1, 1, cpu.action_space.shape).astype(np.float32)
        (expected, reward, *_), (found, gained, *_) = cpu.step(actions), device.step(actions)
        np.testing.assert_allclose(found[:, :63], expected[:, :63], atol=1e-5 if trunk else 1e-4)
        np.testing.assert_allclose(gained, reward, atol=0.1)


def test_effects_in_model_fields_act(reach):
    """A payload bends the trunk by as much as on the CPU."""
    payload = [{"name": "payload", "location": {"kind": "body", "name": "vertebra9"}, "parameters": {"mass": 0.05}}]
    cpu = vector_env(action="continuous", effects=payload)
    device = torch_env(effects=payload)
    expected, _ = cpu.reset(seed=1)
    device.reset(seed=1)
    for envs in (cpu, device):
        envs.task.sim.batch.bind("act")[:] = SLACK
    actions = np.zeros((WORLDS, 8), np.float32)
    expected = cpu.step(actions)[0]
    found = device.step(torch.as_tensor(actions))[0]
    np.testing.assert_allclose(found.numpy()[:, :63], expected[:, :63], atol=1e-5)


def test_effects_between_time_steps_are_refused():
    delay = [{"name": "actuator_delay", "location": {"kind": "actuator", "name": "L0"}, "parameters": {"delay": 0.1}}]
    with pytest.raises(ValueError, match="actuator_delay: some act between time steps"):
        torch_env(effects=delay)


def test_parameters_that_all_worlds_share_are_refused():
    kind = task_type("MultiGait-v0")
    with pytest.raises(ValueError, match="flex_stiffness is the same for all worlds"):
        torch_env("MultiGait-v0", distribution=search_box(kind.randomized)).reset(seed=0)


def test_no_number_is_raised_with_world_and_step(reach, tmp_path):
    """And written down with the state before."""
    reach.reset(seed=0)
    sim = reach.task.sim
    sim.guard, sim._steps = tmp_path, 0
    sim.batch.bind("qvel")[1, 0] = float("nan")
    with pytest.raises(WorldError, match="world 1 is no number after control step 1"):
        reach.step(torch.zeros(WORLDS, 8))
    assert [path.name for path in tmp_path.iterdir()] == ["world_1_step_1.npz"]  # and nothing temporary
    with np.load(tmp_path / "world_1_step_1.npz") as written:
        assert np.isnan(written["qvel"][0])
        assert written["param_trunk_mass"] > 0
    sim.guard = None
    reach.reset(seed=0)


def test_a_world_that_is_no_number_may_be_truncated():
    """What is observed and rewarded stays finite, and the others go on."""
    envs = torch_env(on_nan="truncate")
    envs.reset(seed=0)
    envs.task.sim.batch.bind("qvel")[1, 0] = float("nan")
    observation, reward, _, truncated, info = envs.step(torch.zeros(WORLDS, 8))
    assert truncated.tolist() == info["diverged"].tolist() == [False, True, False]
    assert all(bool(each.isfinite().all()) for each in (observation, reward, info["final_obs"]))


def test_overflow_is_raised_with_the_world():
    envs = torch_env("TrunkPush-v0", room={"nconmax": 1})
    envs.reset(seed=0)
    with pytest.raises(WorldError, match=r"world \d overflows at control step .*more room"):
        for _ in range(20):  # the cube falls to the floor
            envs.step(torch.zeros(WORLDS, 8))


def test_room_is_given_to_vector_environments_too():
    envs = vector_env("TrunkPush-v0", action="continuous", backend="warp", device="cpu", room={"nconmax": 1})
    envs.reset(seed=0)
    with pytest.raises(WorldError, match="more room"):
        for _ in range(20):
            envs.step(np.zeros((WORLDS, 8), np.float32))


def test_a_reset_with_options_draws_what_comes_next():
    """Not what comes after the episodes that were drawn ahead."""
    envs = torch_env(max_episode_steps=3)
    single = gymnasium.make("TrunkReach-v0", model="cable", action="continuous")
    envs.reset(seed=5)
    single.reset(seed=5)
    for _ in range(2):  # while which the next episodes are drawn
        envs.step(torch.zeros(WORLDS, 8))
    envs.reset(options=[{}] * WORLDS)
    single.reset()
    np.testing.assert_allclose(envs.task.goal[0].numpy(), single.unwrapped.task.goal[0], atol=1e-7)


def test_actions_of_a_wrong_shape_are_refused(reach):
    reach.reset(seed=0)
    with pytest.raises(ValueError, match=r"actions have shape \(3, 7\); expected \(3, 8\)"):
        reach.step(torch.zeros(WORLDS, 7))


def test_an_action_that_is_no_number_is_refused_with_its_world(reach):
    reach.reset(seed=0)
    actions = torch.zeros((WORLDS, 8))
    actions[1, 3] = torch.nan
    with pytest.raises(WorldError, match="the action of world 1 at control step"):
        reach.step(actions)
    reach.reset(seed=0)
    reach.step(torch.zeros((WORLDS, 8)))


def test_a_step_before_a_reset_and_options_of_other_worlds_are_refused():
    envs = torch_env()
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(torch.zeros((WORLDS, 8)))
    with pytest.raises(ValueError, match="1 reset options for 3 worlds"):
        envs.reset(options=[{}])


def test_what_the_device_cannot_train_deletes_no_older_run(tmp_path):
    pytest.importorskip("rsl_rl")
    from soro_bench.training.configuration import default_config
    from soro_bench.training.device import train_on_device

    box = search_box(task_type("MultiGait-v0").randomized)
    config = default_config("MultiGait-v0", action="continuous", num_envs=2, rollout_steps=6, rollouts_per_segment=1,
                            batch_size=6, total_steps=12)  # fmt: skip
    (tmp_path / "config.json").write_text(json.dumps({**config.settings(), "distribution": box.to_dict(), "trainer": 3,
                                                      "learner": "rsl_rl"}))  # fmt: skip
    (tmp_path / "curve.csv").write_text("steps\n")
    with pytest.raises(ValueError, match="is the same for all worlds of a GPU"):
        train_on_device(config, tmp_path, box, device="cpu")
    assert json.loads((tmp_path / "config.json").read_text())["trainer"] == 3 and (tmp_path / "curve.csv").exists()


def test_same_bytes_twice(reach):
    """With the deterministic option of Warp; on a CPU without."""

    def run():
        observation, _ = reach.reset(seed=4)
        for _ in range(4):
            observation, *_ = reach.step(0.5 * torch.ones(WORLDS, 8))
        return observation.numpy().tobytes()

    assert run() == run()


def test_training_is_resumed_and_its_policy_is_that_of_the_cpu(tmp_path):
    """The same bytes as without a break; and an evaluation on the CPU like any other."""
    pytest.importorskip("rsl_rl")
    from soro_bench.policies.policy import Policy
    from soro_bench.training.configuration import default_config
    from soro_bench.training.device import train_on_device

    config = default_config("TrunkReach-v0", num_envs=WORLDS, rollout_steps=4, rollouts_per_segment=1, batch_size=6,
                            epochs=1, total_steps=24, episode_steps=4, hidden=(8,))  # fmt: skip

    class Stop(Exception):
        pass

    def stop(steps, total, row):
        if steps > config.segment_steps:
            raise Stop

    train_on_device(config, tmp_path / "whole", device="cpu")
    with pytest.raises(Stop):
        train_on_device(config, tmp_path / "broken", progress=stop, device="cpu")
    later = []
    train_on_device(config, tmp_path / "broken", progress=lambda *row: later.append(row[0]), device="cpu")
    assert later == [24]
    policies = [Policy.load(tmp_path / name) for name in ("whole", "broken")]
    assert policies[0].to_bytes() == policies[1].to_bytes()
    assert policies[0].act(np.zeros((2, 66))).shape == (2, 8)
    with pytest.raises(ValueError, match="another learner"):
        train(config, tmp_path / "whole")


@pytest.mark.parametrize("finite_horizon", [False, True])
def test_what_comes_after_an_episode_counts_as_the_critic_expects_it_to(finite_horizon):
    """After success too, as on the CPU: otherwise waiting beside the goal would be worth more than reaching it."""
    pytest.importorskip("rsl_rl")
    from soro_bench.training.configuration import default_config
    from soro_bench.training.device import DeviceTrainer

    config = default_config("TrunkReach-v0", num_envs=WORLDS, rollout_steps=4, rollouts_per_segment=1, batch_size=6,
                            total_steps=12, episode_steps=4, hidden=(8,), finite_horizon=finite_horizon)  # fmt: skip
    trainer = DeviceTrainer(config, None, "cpu")
    observation, _ = trainer.envs.reset(seed=0)
    seen, ends, step = [], torch.tensor([True, False, False]), trainer.envs.step

    def succeeded(actions):
        following, reward, _, truncated, info = step(actions)
        seen[:] = reward, info["final_obs"]
        return following, reward, ends, truncated, {**info, "done": ends}

    trainer.envs.step, trainer.normaliser.update = succeeded, lambda observations: None
    trainer._step(observation, torch.zeros(WORLDS), [])
    reward, last = seen
    with torch.inference_mode():
        after = config.discount * trainer.agent.critic(trainer.normaliser(last))[:, 0]
    expected = torch.zeros(WORLDS) if finite_horizon else after * ends
    np.testing.assert_allclose((trainer.agent.storage.rewards[0, :, 0] - reward).numpy(), expected.numpy(), atol=1e-6)


def test_wrong_arguments_are_refused_in_one_line():
    with pytest.raises(ValueError, match="there is no such device here; there are cpu"):
        TorchVectorEnv("TrunkReach-v0", 2, device="cuda:7")
    with pytest.raises(ValueError, match="backend 'jax': allowed are 'mujoco' and 'warp'"):
        vector_env(backend="jax")
    for steps in (-1, 0, 2.5, np.inf, np.nan):
        with pytest.raises(ValueError, match=f"max_episode_steps={steps}: a whole number of 1 or more"):
            torch_env(max_episode_steps=steps)
    with pytest.raises(ValueError, match="is for backend='warp'"):
        vector_env(device="cuda:0")
    with pytest.raises(TypeError, match="cannot be copied"):
        pickle.dumps(vector_env(backend="warp", device="cpu"))
