"""Hidden cases: the real robots, their hidden physics, and what is written of them."""

import hashlib
import json
from collections import Counter

import gymnasium
import mujoco
import numpy as np
import pytest

from soro_bench.blind_benchmark import body_laws, cable_laws
from soro_bench.blind_benchmark import robot as robot_module
from soro_bench.blind_benchmark.draw import manoeuvre
from soro_bench.blind_benchmark.hidden import ALL, MEASUREMENT, PHYSICS, UNKNOWN
from soro_bench.blind_benchmark.robot import CONTROL_TIMESTEP, Diverged, Robot, simulate
from soro_bench.blind_benchmark.sensor_laws import SensorLaw
from soro_bench.campaign.inputs import HIDDEN, NOISE, PARAMETERS, record_hidden
from soro_bench.effects.catalogue import CATEGORIES
from soro_bench.files import write_json
from soro_bench.models import trunk
from soro_bench.models import trunk_geometry as geo

pytest.importorskip("pyarrow")
from soro_bench.blind_benchmark import cases, draw, sealed
from soro_bench.recording.parquet import load
from soro_bench.recording.simulated import replay

NOMINAL = {p.name: p.nominal for p in trunk.PARAMETERS}
DURATIONS = {"train": 1.0, "heldout": 0.5, "task": 0.5}


def rates(steps, seed=0):
    """Actions that first pull all cables taut, and are then held for four control steps each."""
    actions = np.repeat(np.random.default_rng(seed).uniform(-1, 1, (-(-steps // 4), 8)), 4, axis=0)[:steps]
    actions[:4] = 0.5
    return actions


@pytest.fixture(scope="module")
def base():
    return simulate("fine", NOMINAL, [], rates(16))


@pytest.fixture
def short(monkeypatch):
    """Excitations of any duration."""
    monkeypatch.setattr(
        cases, "excitation", lambda space, timestep, duration, seed: rates(round(duration / 0.05), seed)
    )


def test_without_effects_it_is_the_plain_trunk(base):
    spec = trunk.build_spec("trunk.xml", "cable")
    spec.option.timestep = 0.00125
    model = spec.compile()
    for write in trunk.TrunkParameters(model).writes({name: np.array([value]) for name, value in NOMINAL.items()}):
        getattr(model, write.field)[write.rows] = write.values[0]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    sites = [model.site(f"keypoint{i}").id for i in range(21)]
    expected = [data.site_xpos[sites].copy()]
    for action in rates(16):
        data.ctrl[:] = geo.CABLE_RATE * action
        mujoco.mj_step(model, data, 40)
        mujoco.mj_kinematics(model, data)
        expected.append(data.site_xpos[sites].copy())
    assert np.array_equal(base.points[::40], expected)
    assert np.allclose(base.at(CONTROL_TIMESTEP * np.arange(17)), expected, rtol=0, atol=1e-12)


def test_bend_is_that_of_the_chain():
    """The chain's hinges are the bend, to second order in it."""
    robot = Robot("fine", NOMINAL)
    robot.data.qpos[:] = np.random.default_rng(0).uniform(-0.02, 0.02, robot.model.nq)
    mujoco.mj_kinematics(robot.model, robot.data)
    hinges = robot.data.qpos.reshape(10, 3)[:, 1:]
    assert np.allclose(robot.bend()[:, :2], hinges, atol=5e-4)


@pytest.mark.parametrize("name", ALL)
def test_no_magnitude_no_change(name, base):
    law = ALL[name][1](np.random.default_rng(1), base).law(0.0)
    if isinstance(law, SensorLaw):
        stamps = CONTROL_TIMESTEP * np.arange(17)
        points = base.at(law.when(stamps))
        changed = law.distort(stamps, points, np.random.default_rng(2))
        assert np.allclose(changed, base.at(stamps), rtol=0, atol=1e-15)
    else:
        assert np.array_equal(simulate("fine", NOMINAL, [law], rates(16)).points, base.points)


@pytest.mark.parametrize("name", [*PHYSICS, *UNKNOWN])
def test_ten_times_the_guess_is_stable(name, base):
    hidden = ALL[name][1](np.random.default_rng(1), base)
    law = hidden.law(min(10 * hidden.guess, hidden.highest))
    assert not np.array_equal(simulate("fine", NOMINAL, [law], rates(16)).points, base.points)


@pytest.mark.parametrize("kind", ["flex", "fine"])
def test_friction_sticks(kind):
    """While the motors hold, it keeps a force below its limit, and nothing moves."""
    law = cable_laws.Friction(0, 1.0)
    actions = np.zeros((50, 8))
    actions[:6, 0], actions[6:8, 0] = 1.0, -1.0
    held = simulate(kind, NOMINAL, [law], actions)
    free = simulate(kind, NOMINAL, [], actions)
    second = round(1 / held.timestep)
    assert np.ptp(held.points[-second // 2 :], axis=0).max() < 2e-5
    assert 0.1 < abs(law.force) <= 1.0
    assert np.abs(held.points[-1] - free.points[-1]).max() > 1e-4


@pytest.mark.parametrize("law", [
    body_laws.StiffnessDrift(0.3), body_laws.Tilt(0.2, 0.3, 1.0), cable_laws.Capstan(0, 0.5)
], ids=lambda law: type(law).__name__)  # fmt: skip
def test_a_robot_that_runs_twice_does_the_same_twice(law):
    robot = Robot("fine", NOMINAL, [law])
    first, second = robot.run(rates(8)), robot.run(rates(8))
    np.testing.assert_array_equal(first.points, second.points)


def test_what_a_capstan_acts_on_has_the_laws_that_came_after_it():
    capstan, compliance = cable_laws.Capstan(0, 0.5), cable_laws.Compliance(0, 1e-4)
    after, before, alone = (
        simulate("fine", NOMINAL, laws, rates(8)).points
        for laws in ([capstan, compliance], [compliance, capstan], [capstan])
    )
    np.testing.assert_allclose(after, before, atol=1e-9)
    assert np.abs(after - alone).max() > 1e-4


def test_the_seed_of_a_proof_is_drawn_once(tmp_path):
    first = sealed.sealed_seed(tmp_path)
    assert 0 <= first < 10**18 and first != sealed.sealed_seed(tmp_path)
    write_json(tmp_path / "sealed" / "plan.json", {"seed": first})
    assert sealed.sealed_seed(tmp_path) == first


def test_what_explodes_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where the engine logs its warnings
    with pytest.raises(Diverged):
        simulate("fine", NOMINAL, [body_laws.Wall(9, -1e5, np.array([1.0, 0, 0]), -0.01)], rates(8))


def test_laws_that_need_no_robot():
    class Stub:
        timestep, cables = 0.01, np.arange(8)

    path = [np.full(8, x) for x in (0.0, 1.0, 2.0, 1.5, 1.0, 0.0)]
    for law, expected in (
        (cable_laws.Backlash(3, 1.0), [0, 0.5, 1.5, 1.5, 1.5, 0.5]),
        (cable_laws.Deadband(3, 1.2), [0, 0, 0.8, 0.3, 0, 0]),
        (cable_laws.Delay(0.015), [0, 0, 0.5, 1.5, 1.75, 1.25]),
    ):
        law.begin(Stub, None)
        assert np.allclose([law.command(Stub, pull)[3] for pull in path], expected)


def test_plastic_set_keeps_its_shape():
    """A neck that was bent too far springs back less far, by the share of what exceeds the yield."""

    class Stub:
        neck_stiffness = np.ones(10)
        angles = iter([0.1, 0.5, 0.3, 0.2])

        def bend(self):
            return np.tile([next(self.angles), 0, 0], (10, 1))

        def push_necks(self, moments):
            self.moment = moments[4, 0]

    law, stub, moments = body_laws.PlasticSet(4, 0.3, 0.5), Stub(), []
    law.begin(stub, None)
    for _ in range(4):
        law.push(stub)
        moments.append(stub.moment)
    assert np.allclose(moments, [0, 0.1, 0.1, 0.1])


def test_manoeuvre_keeps_the_limits():
    actions = manoeuvre(12.0, (1, 2))
    pulls = np.cumsum(actions, axis=0) * geo.CABLE_RATE * CONTROL_TIMESTEP
    assert actions.shape == (240, 8) and np.abs(actions).max() <= 1
    assert (np.abs(pulls) <= geo.CABLE_LIMITS).all()
    reach = np.abs(pulls).max(axis=0)
    assert ((reach > 0.004) & (reach < 0.0351)).all() and (reach[4:] < 0.0201).all()
    assert np.allclose(pulls[:, [0, 1, 4, 5]], -pulls[:, [2, 3, 6, 7]])
    assert np.abs(actions[0]).max() < 0.05


def test_mix():
    drawn = draw.draw_cases(120, seed=3, healthy=40)
    assert Counter(case.group for case in drawn) == {
        "none": 40, "one": 45, "two": 15, "measurement": 10, "unknown": 10
    }  # fmt: skip
    assert Counter(case.group for case in draw.draw_cases(100, 0))["none"] == 20
    assert [case.id for case in drawn] == [f"case_{i:03d}" for i in range(120)]
    for group, names in (("one", PHYSICS), ("measurement", MEASUREMENT), ("unknown", UNKNOWN)):
        counts = Counter(case.effects for case in drawn if case.group == group)
        assert {name for (name,) in counts} == set(names) and max(counts.values()) - min(counts.values()) <= 1
    for group in draw.GROUPS:
        robots = Counter(case.robot for case in drawn if case.group == group)
        assert abs(robots["flex"] - robots["fine"]) <= 1
    for case in drawn:
        assert len({ALL[name][0] for name in case.effects}) == len(case.effects)
        assert all(0.7 <= target <= 4.0 for target in case.targets)
        for p in trunk.PARAMETERS:
            value = case.parameters[p.name]
            if p.name == "poisson_ratio":
                assert abs(value - p.nominal) <= 0.03
            else:
                assert 1 / 1.3 <= value / p.nominal <= 1.3
    with pytest.raises(ValueError, match="healthy 5"):
        draw.draw_cases(4, 0, healthy=5)


def files(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_written_cases(tmp_path, short):
    first, second, told = tmp_path / "first", tmp_path / "second", []
    sealed.write_cases(
        first, 2, seed=5, healthy=1, durations=DURATIONS, others=0, progress=lambda *done: told.append(done)
    )
    sealed.write_cases(second, 2, seed=5, healthy=1, durations=DURATIONS, others=0)
    written = files(first)
    assert told == [(1, 2), (2, 2)]
    assert files(second) == written

    # goes on where it stopped, and mixes nothing
    (first / "case_001" / "train.parquet").unlink()
    sealed.write_cases(first, 2, seed=5, healthy=1, durations=DURATIONS, others=0)
    assert files(first) == written
    with pytest.raises(ValueError, match="has the cases of"):
        sealed.write_cases(first, 2, seed=6, healthy=1, durations=DURATIONS, others=0)

    # and what has been committed to stays
    path = second / "case_000" / "train.parquet"
    path.write_bytes((second / "case_001" / "train.parquet").read_bytes())
    with pytest.raises(ValueError, match="its label says"):
        sealed.write_cases(second, 2, seed=5, healthy=1, durations=DURATIONS, others=0)

    labels = json.loads(written["sealed/labels.json"])
    assert written["commitment.txt"].decode().strip() == hashlib.sha256(written["sealed/labels.json"]).hexdigest()
    assert sorted(len(label["effects"]) for label in labels["cases"]) == [0, 1]
    for label in labels["cases"]:
        assert {path.name for path in (first / label["id"]).iterdir()} == set(label["sha256"])
        for name, digest in label["sha256"].items():
            path = first / label["id"] / name
            assert hashlib.sha256(path.read_bytes()).hexdigest() == digest
            assert path.stat().st_mtime == 946684800
            recording = load(path)
            assert recording.metadata == {"env_id": "TrunkReach-v0", "action": "continuous", "noise": "0.0005"}
            assert recording.parameters == {}
            assert list(recording.commands) == ["action"] and recording.names == ["keypoints"]
            keypoints, action = recording.signals["keypoints"], recording.commands["action"]
            assert (keypoints.unit, keypoints.frame, action.unit) == ("m", "world", "1")
            assert keypoints.values.shape == (len(action.time) + 1, 21, 3)
            assert np.allclose(np.diff(keypoints.time), CONTROL_TIMESTEP)


def test_effects_are_scaled(short):
    """Each effect changes what is measured by its target, also a second one, and the noise is as stated."""
    case = draw.Case(
        "case_000", "two", "fine", NOMINAL, ("payload", "actuator_delay"), (1.0, 2.0), (0, 0)
    )  # fmt: skip
    recordings, label = cases.build(case, {"train": 3.0, "heldout": 1.0, "task": 1.0})
    for effect, target in zip(label["effects"], case.targets, strict=True):
        assert effect["target_mm"] == target
        assert abs(np.log(effect["change_mm"] / target)) < 0.1
    assert label["effects"][1]["where"] == {"kind": "actuator", "name": "*"}
    clamped = recordings["train"].signals["keypoints"].values[:, 0]
    assert 0.8 * cases.NOISE < clamped.std() < 1.2 * cases.NOISE


def test_labels_name_what_is_outside_the_catalogue_unknown(base):
    for name in UNKNOWN:
        hidden = UNKNOWN[name][1](np.random.default_rng(0), base)
        label = cases.Scaled(name, hidden, 1.0, 2.0, 2.0).label()
        assert (label["name"], label["class"], label["law"]) == ("unknown", "unknown", name)
        assert label["description"] and label["where"]["name"]
        assert json.dumps(label)


def test_both_sides_mean_the_same_classes():
    """Labels and diagnosis name the same class for the same effect."""
    for name, (category, _) in (PHYSICS | MEASUREMENT).items():
        assert CATEGORIES[name] == category, name


def test_a_policy_sees_on_a_concealed_robot_what_the_environment_shows(monkeypatch):
    monkeypatch.setattr(robot_module, "EVALUATION_GOALS", [np.array([0.0, -0.015, 0.12])])
    monkeypatch.setattr(robot_module, "STEPS", 3)
    env, seen = gymnasium.make("soro_bench:TrunkReach-v0", model="cable", action="continuous"), []

    def act(observation):
        seen.append(observation[0])
        return np.full((1, 8), 0.5)

    (distance,) = robot_module.final_distances(act, Robot("fine", NOMINAL))
    shown, _ = env.reset(options={"goal": [0.0, -0.015, 0.12]})
    assert np.array_equal(seen[0], shown)
    for one in seen:
        assert np.allclose(one, shown, atol=0.01)  # the environment's time step is eight times as long
        shown, _, _, _, info = env.step(np.full(8, 0.5, np.float32))
    assert distance == pytest.approx(info["distance"], abs=0.01)


def test_an_episode_that_diverges_counts_as_one_without_motion(monkeypatch):
    class Wild:
        """Jumps away, and is not sound."""

        tip = np.zeros(3)

        def begin(self, steps):
            self.tip = np.zeros(3)

        def keypoints(self):
            return np.repeat(self.tip[None], 21, axis=0)

        def advance(self, action):
            self.tip = self.tip + 1.0

        def check(self, points):
            raise Diverged("the simulation diverged")

    monkeypatch.setattr(robot_module, "EVALUATION_GOALS", [np.array([0.0, 0.0, 0.12])])
    assert robot_module.final_distances(lambda observations: np.zeros((1, 8)), Wild()) == pytest.approx([0.12])


def test_only_its_own_physics_explains_the_recordings_of_the_hidden_robot(tmp_path):
    paths = record_hidden(tmp_path)
    assert [path.name for path in paths] == ["recording.parquet", "heldout.parquet"]
    for path in paths:
        recording = load(path)
        assert recording.parameters.items() >= PARAMETERS.items()
        measured = recording.signals["keypoints"].values
        rms = [
            np.sqrt(np.mean((replay(recording, **options).signals["keypoints"] - measured) ** 2))
            for options in ({"effects": [HIDDEN]}, {})
        ]
        assert abs(rms[0] / NOISE - 1.0) < 0.05 and rms[1] > 3 * NOISE
