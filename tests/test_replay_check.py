"""What a diagnosis prints, anybody can replay: on recordings of the diagnosis and on new ones."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

pytest.importorskip("rerun", reason="needs the train extra")

from soro_bench.diagnosis.assembly.errors import plain_replays, replayed_robots
from soro_bench.diagnosis.assembly.model_export import exported
from soro_bench.diagnosis.candidates import term
from soro_bench.diagnosis.estimation.fit import Hypothesis
from soro_bench.diagnosis.preparation import unexplained
from soro_bench.diagnosis.render.html import html
from soro_bench.diagnosis.render.summary import summary
from soro_bench.diagnosis.replay_check import FITTED, HELD_OUT, NEW, check_replays, checked_model, robot_of
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_robot import Patch, ReplayedRobot, RobotSummary, SignalQuality
from soro_bench.diagnosis.robots.model_file import ModelError
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.effect import Effect, Location
from soro_bench.recording.known import Known
from soro_bench.recording.parquet import save
from soro_bench.recording.recording import RecordingError, Signal
from soro_bench.recording.simulated import record
from soro_bench.recording.simulated import replay as replay_episode
from tests.arm import ARM
from tests.results import RESULTS

NAMES = ("train", "heldout", "new")
LABELS = {"model as built": "nominal", "fitted parameters": "fitted", "with effects": "patched"}


@pytest.fixture(scope="module")
def read(diagnosed_arm):
    """The result of the arm as a file has it."""
    return Result.from_json(json.loads(json.dumps(diagnosed_arm.result.to_json())))


@pytest.fixture(scope="module")
def checked(diagnosed_arm, read):
    return check_replays(read, robot_of(read)[0], dict(zip(NAMES, diagnosed_arm.recordings, strict=True)))


def alone(model, recording):
    """(T,) angles after every control step of 20 ms, by MuJoCo alone."""
    data, angles = mujoco.MjData(model), []
    data.qpos[0] = recording.signals["angle"].values[0]
    for goal in recording.commands["goal"].values[:, 0]:
        data.ctrl[0] = goal
        mujoco.mj_step(model, data, nstep=round(0.02 / model.opt.timestep))
        angles.append(data.qpos[0])
    return np.array(angles)


def rms(model, recording):
    return float(np.sqrt(np.mean((alone(model, recording) - recording.signals["angle"].values[1:]) ** 2)))


def test_every_printed_error_of_a_users_robot_is_that_of_a_replay(read, checked):
    """To 1 %: in the result, on the console and in the report; with the effects and by the exported model alone."""
    assert [each.role for each in checked.files] == [FITTED, HELD_OUT, NEW]
    pooled = {role: checked.pooled(role) for role in (FITTED, HELD_OUT)}
    shown = [each for each in read.robots if each.name != "alternative"]
    assert [each.name for each in shown] == ["nominal", "fitted", "patched"]
    assert read.worse_replays == ()
    for each in shown:
        assert pooled[FITTED][each.name] == pytest.approx(each.train, rel=0.01)
        assert pooled[HELD_OUT][each.name] == pytest.approx(each.heldout, rel=0.01)
    for role, each in zip((FITTED, HELD_OUT), read.patch.replays, strict=True):
        assert pooled[role]["nominal"] == pytest.approx(each.built, rel=0.01)
        assert pooled[role]["model_alone"] == pytest.approx(each.patched, rel=0.01)
    for text in (summary(read), html(read)):
        for label, name in LABELS.items():
            found = re.search(rf"{label}[^0-9]+([0-9.]+)\W*rad[^0-9]+([0-9.]+)\W*rad", text)
            expected = [pooled[role][name] for role in (FITTED, HELD_OUT)]
            assert [float(each) for each in found.groups()] == pytest.approx(expected, rel=0.01)
    assert checked.notes == ()


def test_errors_are_those_of_mujoco_alone(diagnosed_arm, read, checked):
    """The model as built, with fitted parameters, and patched_model.xml, stepped without this library."""
    (fitted,) = (each.parameters for each in read.robots if each.name == "fitted")
    built, patched = (mujoco.MjModel.from_xml_path(str(diagnosed_arm.paths[0])) for _ in range(2))
    patched.body_mass[1] *= fitted["inertia"]
    patched.body_inertia[1] *= fitted["inertia"]
    patched.dof_damping[0] *= fitted["damping"]
    patched.actuator_biasprm[0, 0] += fitted["zero"]
    models = {"nominal": built, "fitted": patched, "model_alone": mujoco.MjModel.from_xml_string(read.patch.model)}
    for file, recording in zip(checked.files, diagnosed_arm.recordings, strict=True):
        for name, model in models.items():
            assert file.rms[name] == pytest.approx(rms(model, recording), rel=0.02)


def trunk_result(robot, recording):
    """A result whose robots are those of a diagnosis of a trunk with a payload."""
    problem = unexplained(robot.shortened(2), (robot.measured(recording),), 5e-4)
    one, nothing = term(robot, "payload", Location("body", "vertebra7")), np.zeros((0, problem.weight.size))
    x = 0.2 * np.ones(len(robot.priors))
    best = Hypothesis((one,), np.concatenate([x, one.coordinates({"mass": 0.04})]), nothing, 0.0, nothing, nothing)
    answer = SimpleNamespace(hypothesis=best, names=("payload",))
    comparison = SimpleNamespace(answers=(answer,), ranked=(answer,))
    nominal = replace(best, terms=(), x=x)
    found = SimpleNamespace(robot=robot, best=answer, discovery=None, comparison=comparison, tested=None,
                            explanation=SimpleNamespace(nominal=nominal, problem=problem))  # fmt: skip
    replays = plain_replays(found)
    robots = replayed_robots(found, replays, True)
    signals = tuple(replays.of_signal(found, which) for which in range(len(robot.signals)))
    others = tuple(each.name for each in robot.others)
    of = RobotSummary(robot.name, robot.model_name, robot.signal, robot.unit, (), others=others)
    patch = Patch("untested", robots[-1].effects, None, (), ())
    quality = (SignalQuality(5e-4, 0.0, recording.digest()),)
    return replace(
        RESULTS["trunk friction"](),
        robot=of,
        robots=robots,
        signals=signals,
        patch=patch,
        recordings=quality,
        heldout=None,
    )


def test_every_error_of_a_robot_of_the_suite_is_that_of_a_replay(robot):
    """By the check, and by an episode of the environment with the same parameters and effects."""
    hidden = [Effect("payload", Location("body", "vertebra7"), {"mass": 0.05})]
    recording = record("TrunkReach-v0", model="cable", steps=40, effects=hidden, noise=5e-4, seed=3)
    result = trunk_result(robot, recording)
    checked = check_replays(result, robot_of(result)[0], {"run": recording})
    assert [each.name for each in result.robots] == ["nominal", "fitted", "patched", "accurate"]
    for each in result.robots:
        assert checked.pooled(FITTED)[each.name] == pytest.approx(each.train, rel=0.01)
        laws = [Effect(law["name"], Location(**law["location"]), law["parameters"]) for law in each.effects]
        model = "flex" if each.name == "accurate" else "cable"
        episode = replay_episode(replace(recording, parameters=each.parameters), model, effects=laws)
        off = episode.signals["keypoints"] - recording.signals["keypoints"].values
        assert each.train == pytest.approx(np.sqrt(np.mean(off[1:] ** 2)), rel=0.01)
    assert len(checked.files[0].points["fitted"]) == 21


def test_errors_of_other_signals_are_those_of_a_replay_too():
    """Of the object that a trunk pushes."""
    robot = SuiteRobot("TrunkPush-v0", threads=1)
    recording = record("TrunkPush-v0", model="cable", steps=20, params={"trunk_mass": 0.5}, seed=3)
    result = trunk_result(robot, recording)
    checked = check_replays(result, robot_of(result)[0], {"run": recording})
    assert checked.signals == tuple(each.name for each in robot.signals) and len(checked.signals) > 1
    for each in result.signals:
        pooled = checked.pooled(FITTED, each.name)
        assert (pooled["fitted"], pooled["patched"]) == pytest.approx((each.before, each.after), rel=0.01)


def spoilt(recording, samples, size):
    signal = recording.signals["angle"]
    values = signal.values.copy()
    values[samples] += size
    return replace(recording, signals={"angle": Signal(signal.time, values, signal.unit)})


def test_what_the_inspection_leaves_out_does_not_count(diagnosed_arm, read, checked):
    """Three samples of 0.5 rad would make the error ten times as large."""
    given = spoilt(diagnosed_arm.recordings[2], [40, 90, 150], 0.5)
    (file,) = check_replays(read, robot_of(read)[0], {"run": given}).files
    assert file.role == NEW and file.samples <= 222
    assert file.rms["fitted"] == pytest.approx(checked.files[2].rms["fitted"], rel=0.05)


def test_what_fits_left_out_does_not_count_in_the_same_recording_again(diagnosed_arm, read, checked):
    qualities = [replace(read.recordings[0], left_out=((3, 0), (7, 0))), *read.recordings[1:]]
    result = replace(read, recordings=tuple(qualities))
    file = check_replays(result, robot_of(result)[0], {"run": diagnosed_arm.recordings[0]}).files[0]
    assert file.samples == checked.files[0].samples - 2
    wrong = replace(result, recordings=(replace(qualities[0], left_out=((10**9, 0),)), *qualities[1:]))
    with pytest.raises(ValueError, match="leaves out sample 1000000000 of a recording with 225"):
        check_replays(wrong, robot_of(wrong)[0], {"run": diagnosed_arm.recordings[0]})


def test_a_model_that_has_changed_is_named_with_the_errors_that_differ(diagnosed_arm, read, tmp_path):
    model = tmp_path / "arm.xml"
    model.write_text(diagnosed_arm.paths[0].read_text().replace('kp="2"', 'kp="1.8"'))
    robot, notes = robot_of(read, model=model)
    assert notes == [f"{model} has changed since the diagnosis"]
    found = check_replays(read, robot, {"run": diagnosed_arm.recordings[0]}, notes)
    assert any(
        re.match(r"nominal, fitted to: the diagnosis has 0\.028 rad, this replay 0\.0", each) for each in found.notes
    )


@pytest.mark.parametrize(("share", "named"), [(0.007, False), (0.015, True)])
def test_an_error_is_another_one_from_a_hundredth_on(diagnosed_arm, read, share, named):
    (printed,) = (each.train for each in read.robots if each.name == "nominal")
    result = changed(read, "nominal", train=(1.0 + share) * printed)
    found = check_replays(result, robot_of(read)[0], {"run": diagnosed_arm.recordings[0]})
    assert any(each.startswith("nominal, fitted to") for each in found.notes) == named


def changed(result, name, **changes):
    robots = tuple(replace(each, **changes) if each.name == name else each for each in result.robots)
    return replace(result, robots=robots)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda r: replace(r, robot=replace(r.robot, files=())),
            "file of 'arm' is not in the result; .* --model",
        ),
        (lambda r: replace(r, robot=replace(r.robot, signal="tip")), "result is of 'tip' in 'rad'; .*angle in rad"),
        (lambda r: changed(r, "fitted", parameters={"mass": 1.0}), "has parameters 'mass'; this robot has inertia"),
        (lambda r: changed(r, "fitted", parameters={"inertia": -1.0, "damping": 1.0, "zero": 0.0}), "inertia is -1 in"),
        (lambda r: changed(r, "patched", effects=({"name": "magic"},)), "an effect has name, location and parameters"),
        (lambda r: changed(r, "patched", effects=r.patch.effects * 101), "has 101 effects at once; at most 100"),
        (lambda r: changed(r, "patched", effects=r.patch.effects * 2), "cannot have coulomb_friction at joint hinge, "),
    ],
)
def test_a_result_that_is_not_of_the_robot_is_refused_in_one_line(diagnosed_arm, read, change, said):
    with pytest.raises(ValueError, match=said) as error:
        result = change(read)
        check_replays(result, robot_of(result)[0], {"run": diagnosed_arm.recordings[0]})
    assert "\n" not in str(error.value)


def test_a_signal_that_stands_still_is_refused_as_in_a_diagnosis(diagnosed_arm, read):
    signal = diagnosed_arm.recordings[2].signals["angle"]
    values = 0.2 + 5e-4 * np.random.default_rng(0).standard_normal(signal.values.shape)
    still = replace(diagnosed_arm.recordings[2], signals={"angle": replace(signal, values=values)})
    with pytest.raises(RecordingError, match=r"^run: .*angle: all of the samples stay within"):
        check_replays(read, robot_of(read)[0], {"run": still})


def test_a_law_that_adds_up_may_come_twice(diagnosed_arm, read):
    """As where it was known and more of it was found."""
    errors = []
    for masses in (0.01, 0.01), (0.02,):
        effects = tuple(Effect("payload", Location("body", "arm"), {"mass": mass}).to_json() for mass in masses)
        result = changed(read, "patched", effects=effects)
        found = check_replays(result, robot_of(result)[0], {"run": diagnosed_arm.recordings[0]})
        errors.append(found.files[0].rms["patched"])
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)


def test_a_recording_of_another_robot_is_named(diagnosed_arm, read):
    other = replace(diagnosed_arm.recordings[0], commands={"torque": diagnosed_arm.recordings[0].commands["goal"]})
    with pytest.raises(RecordingError, match=r"^b\.parquet: the recording has no command 'goal'"):
        check_replays(read, robot_of(read)[0], {"b.parquet": other})


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("<worldbody>", '<include file="/etc/passwd"/><worldbody>', "it has <include>"),
        ("<worldbody>", '<asset><mesh name="a" file="/etc/passwd"/></asset><worldbody>', "file=/etc/passwd"),
        ("<worldbody>", '<asset><texture builtin="flat" width="99999" height="9"/></asset><worldbody>', "height=9"),
        ("<worldbody>", '<worldbody><replicate count="999999"><body/></replicate>', "it has <replicate>"),
        ("<worldbody>", '<worldbody><body name="more"/>', "it has nbody 3, the model of the robot 2"),
        ('timestep="0.005"', 'timestep="0.00001"', "its time step is 1e-05 s, that of the robot 0.005 s"),
        ("<mujoco", "<!DOCTYPE a><mujoco", "it has <!DOCTYPE>"),
        ("</mujoco>", "", "it is no XML"),
    ],
)
def test_a_model_in_a_strangers_result_is_not_opened(diagnosed_arm, read, old, new, said):
    """It is a note; the other robots are replayed."""
    xml = read.patch.model.replace(old, new, 1)
    assert xml != read.patch.model
    with pytest.raises(ModelError, match=re.escape(said)):
        checked_model(xml, ModelRobot(*diagnosed_arm.paths, threads=1))
    result = replace(read, patch=replace(read.patch, model=xml))
    found = check_replays(result, robot_of(result)[0], {"run": diagnosed_arm.recordings[0]})
    assert "model_alone" not in found.robots and said in found.notes[0]


@pytest.mark.parametrize("kind", ["suite", "model"])
def test_a_robot_by_a_patched_model_keeps_it_with_other_time_steps_and_known_parameters(kind, robot, actions, paths):
    if kind == "suite":
        own, drive, start = robot, actions[:10], None
        xml = exported(own, own.parameters(np.ones(len(own.priors))), ()).xml
    else:
        own, drive, start = ModelRobot(*paths, threads=1), np.full((10, 1), 0.4), np.zeros((1, 1))
        xml = ARM.replace('damping="0.02"', 'damping="0"')  # of what a parameter scales, nothing is left
    first = own.priors[0]

    def moved(by):
        return by.simulate(drive, np.array([[prior.nominal for prior in by.priors]]), [()], start)

    alone = own.as_built(xml)
    told, finer = alone.knowing(Known({first.name: first.nominal})), alone.shortened(2)
    assert np.abs(moved(alone) - moved(own)).max() > 1e-3
    for again in (told, finer.shortened(1), finer.as_built()):
        np.testing.assert_array_equal(moved(again), moved(alone))
    assert first not in told.priors
    assert 0 < np.abs(moved(finer) - moved(alone)).max() < 0.3 * np.abs(moved(alone) - moved(own)).max()


def test_a_robot_of_the_suite_has_no_files():
    result = replace(RESULTS["trunk friction"](), robots=(ReplayedRobot("nominal", {}, (), 0.1),))
    with pytest.raises(ValueError, match="robot of the suite: leave out --model and --map"):
        robot_of(result, model="arm.xml")
    assert isinstance(robot_of(result)[0], SuiteRobot)
    more = replace(result, robot=replace(result.robot, others=("tension",)))
    assert [each.name for each in robot_of(more)[0].others] == ["tension"]


def test_the_command_prints_a_table_and_writes_page_and_json(diagnosed_arm, read, tmp_path, call):
    """Also of a result without robots, as older versions wrote it: then what its parameters and patch are of."""
    for name, recording in zip(NAMES, diagnosed_arm.recordings, strict=True):
        save(recording, tmp_path / f"{name}.parquet")
    read.save(tmp_path / "result.json")
    given = [tmp_path / f"{name}.parquet" for name in NAMES]
    said = call("check", tmp_path / "result.json", *given, "--out", tmp_path / "out")
    assert "RMSE of angle [rad]" in said and "with effects" in said
    data = json.loads((tmp_path / "out" / "check.json").read_text())
    assert data["schema"] == "soro-bench/replay-check/1" and [each["role"] for each in data["files"]] == [
        FITTED,
        HELD_OUT,
        NEW,
    ]
    page = (tmp_path / "out" / "check.html").read_text()
    assert f"{data['files'][2]['rms']['patched']:.3g}" in page and page.count("data:image/png") == 3
    replace(read, robots=()).save(tmp_path / "old.json")
    call("check", tmp_path / "old.json", given[1], "--out", tmp_path / "old")
    old = json.loads((tmp_path / "old" / "check.json").read_text())
    assert old["robots"] == ["nominal", "patched", "model_alone"]
    assert old["files"][0]["rms"]["patched"] == pytest.approx(data["files"][1]["rms"]["patched"], rel=1e-6)
