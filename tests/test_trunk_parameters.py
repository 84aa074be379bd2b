"""What the physical parameters of the trunk's tasks change."""

import numpy as np
import pytest

TIP, OBJECT = slice(60, 63), slice(66, 69)
# y [mm] at which the reference's objects rest, 5 mm above the floor
REST_HEIGHT = {"TrunkPush-v0": -82.819, "TrunkLift-v0": -92.478}
IDLE = np.zeros(8, np.float32)


@pytest.mark.parametrize("env_id", REST_HEIGHT)
def test_object_comes_to_rest(make, env_id, model):
    """The dropped object rests where the reference's does, 5 mm above the floor, within 0.2 mm."""
    env = make(env_id, model=model, action="continuous")
    env.reset(seed=0, options={"params": {"trunk_mass": 0.001}})  # a light trunk does not sag onto the object
    for _ in range(20):
        observation, *_, info = env.step(IDLE)
    assert 1e3 * observation[67] == pytest.approx(REST_HEIGHT[env_id], abs=0.2)
    np.testing.assert_allclose(observation[[66, 68]], [0, 0.1] if "Push" in env_id else [-0.03, 0.12], atol=1e-4)
    if env_id == "TrunkLift-v0":
        assert info["elevation"] == pytest.approx(0, abs=2e-4)
        assert info["clearance"] == pytest.approx(0, abs=2e-4)


@pytest.mark.parametrize(("env_id", "size"), [("TrunkPush-v0", (35, 35, 35)), ("TrunkLift-v0", (56, 21, 35))])
def test_scene_parameters_reach_the_model(make, model, env_id, size):
    """The object is a solid box of the given mass, and every pair in contact has the given friction."""
    env = make(env_id, model=model)
    env.reset(seed=0, options={"params": {"cube_mass": 0.12, "friction": 0.7}})
    compiled = env.unwrapped.task.sim.batch.get_model(0)
    thing = compiled.body("object")
    x, y, z = (s / 1000 for s in size)
    assert thing.mass[0] == pytest.approx(0.12)
    moments = 0.12 / 12 * np.array([y**2 + z**2, x**2 + z**2, x**2 + y**2])
    np.testing.assert_allclose(np.sort(thing.inertia), np.sort(moments), rtol=1e-6)
    colliding = (compiled.geom_contype | compiled.geom_conaffinity) > 0
    np.testing.assert_array_equal(compiled.geom_friction[colliding, 0], 0.7)
    assert colliding.sum() >= 12  # ten vertebrae, the floor and the object


def test_wall_is_not_observed(make, model):
    """In TrunkLift walls that nothing touches give equal observations, wherever they stand that is allowed."""
    env = make("TrunkLift-v0", model=model)

    def rollout(offset):
        start, _ = env.reset(seed=0, options={"params": {"wall_offset": offset}})
        return np.array([start, *(env.step(2)[0] for _ in range(3))])

    nominal = rollout(0.0)
    for offset in (-0.2, 0.035):
        np.testing.assert_array_equal(rollout(offset), nominal)
        simulated = env.unwrapped.task.sim.batch.get_model(0)
        assert simulated.body("wall").pos[0] == pytest.approx(-0.1 + offset)


@pytest.mark.parametrize(
    ("env_id", "name", "value"),
    [
        ("TrunkReach-v0", "trunk_mass", 0.2), ("TrunkReach-v0", "poisson_ratio", 0.49),
        ("TrunkReach-v0", "young_modulus", 2e6), ("TrunkReach-v0", "damping", 0.2),
        ("TrunkReach-v0", "cable_stiffness", 5e3), ("TrunkPush-v0", "cube_mass", 0.5),
        ("TrunkPush-v0", "friction", 0.9), ("TrunkLift-v0", "cube_mass", 0.5), ("TrunkLift-v0", "friction", 0.1),
    ],
)  # fmt: skip
def test_every_parameter_matters(make, model, env_id, name, value):
    """Each parameter changes the motion: the tip's in Reach, the object's in the other tasks."""
    env = make(env_id, model=model)

    def last(params):
        env.reset(seed=0, options={"params": params})
        return [env.step(action)[0] for action in [2] * 8 + [1] * 8][-1]

    watched = TIP if env_id == "TrunkReach-v0" else OBJECT
    assert np.linalg.norm(last({name: value})[watched] - last({})[watched]) > 1e-4


def test_heavier_or_softer_trunk_sags_more(make, model):
    """A trunk of more mass, or of a lower Young's modulus, hangs lower."""
    env = make("TrunkReach-v0", model=model, action="continuous")

    def sag(**params):
        env.reset(seed=0, options={"params": params})
        return -np.mean([env.step(IDLE)[0][61] for _ in range(15)])

    nominal = sag()
    assert sag(trunk_mass=0.6) > 1.05 * nominal
    assert sag(young_modulus=3e6) > 1.05 * nominal
