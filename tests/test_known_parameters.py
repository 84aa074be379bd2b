"""Parameters that a user knows: fixed in every replay and fit, and said in the result."""

import re
from dataclasses import replace

import numpy as np
import pytest
import tyro

from soro_bench.commands.inference import Infer
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.commands import Diagnose
from soro_bench.diagnosis.render.files import posterior
from soro_bench.diagnosis.render.summary import summary
from soro_bench.diagnosis.render.words import parameter
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.options import joined
from soro_bench.recording.known import Known, known_parameters
from soro_bench.recording.recording import Recording, RecordingError, Signal
from tests.arm import TRUTH, recording

NAMES = ("inertia", "damping", "zero")


def _with(**parameters):
    return Recording({}, {"angle": Signal(np.arange(2.0), np.zeros(2), "rad")}, parameters)


def test_a_known_parameter_of_the_suite_is_simulated_and_not_fitted(robot, actions):
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    heavier = nominal.copy()
    heavier[0, [prior.name for prior in robot.priors].index("trunk_mass")] = 0.6
    told = robot.knowing(Known({"trunk_mass": 0.6}))
    assert "trunk_mass" not in [prior.name for prior in told.priors]
    others = np.array([[prior.nominal for prior in told.priors]])
    for one, other in ((told, robot), (told.shortened(2), robot.shortened(2))):
        np.testing.assert_array_equal(one.simulate(actions, others, [()]), other.simulate(actions, heavier, [()]))


def test_a_known_parameter_of_a_model_is_simulated_and_not_fitted(paths):
    robot, goals, start = ModelRobot(*paths, threads=1), np.full((20, 1), 0.4), np.full((1, 1), 0.2)
    told = robot.knowing(Known({"damping": 0.8, "inertia": 1.2}))
    values = told.simulate(goals, TRUTH[:, 2:], [()], start)
    np.testing.assert_array_equal(values, robot.simulate(goals, TRUTH, [()], start))


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ({"mass": 1.0}, "no parameter 'mass'; this robot has inertia, damping, zero"),
        ({"inertia": 5000.0}, "inertia = 5000 is not possible; allowed is 0.001 to 1000"),
        ({"zero": np.nan}, "zero = nan is not possible; allowed is -2 to 2 N m"),
        (["inertia"], "'inertia' is no parameter; expected something like trunk_mass=0.3"),
    ],
)
def test_what_a_robot_cannot_have_is_refused_in_one_line(paths, told, said):
    with pytest.raises(ValueError, match=f"^{re.escape(said)}$"):
        diagnose(ModelRobot(*paths, threads=1), [_with()], known=told)


def test_a_told_value_counts_before_a_recorded_one():
    recordings = [_with(inertia=1.3, damping=0.7, colour=3.0), _with(inertia=1.3)]
    found = known_parameters(["recorded", "damping=0.8"], recordings, NAMES)
    assert found == Known({"damping": 0.8, "inertia": 1.3}, frozenset({"inertia"}))


@pytest.mark.parametrize(
    ("recordings", "said"),
    [
        ([_with(inertia=1.3), _with(inertia=1.2)], "inertia = 1.2 and 1.3"),
        ([_with(colour=3.0)], "which has inertia, damping, zero; they have colour"),
    ],
)
def test_recordings_that_do_not_say_are_refused(recordings, said):
    with pytest.raises(RecordingError, match=said):
        known_parameters("recorded", recordings, NAMES)


def test_a_diagnosis_fits_the_others_and_says_what_it_was_told(paths):
    given = replace(recording(paths, [], 0), parameters={"inertia": 1.2})
    result = diagnose(ModelRobot(*paths, threads=1), [given], known=["recorded", "damping=0.8"])
    found = {each.estimate.name: each for each in result.parameters}
    assert [found[name].known for name in NAMES] == ["recorded", "told", ""]
    assert (found["damping"].estimate.low, found["damping"].estimate.high) == (0.8, 0.8)
    assert found["zero"].estimate.low < TRUTH[0, 2] < found["zero"].estimate.high
    assert "damping 0.8 (as told), inertia 1.2 (as recorded)" in summary(result).replace("\n" + " " * 15, " ")
    assert "inertia 1.2 1" in result.patch.model  # the comment of the patched model


def test_a_diagnosis_of_which_every_parameter_is_known_still_looks_for_laws(paths):
    told = dict(zip(NAMES, TRUTH[0], strict=True))
    result = diagnose(ModelRobot(*paths, threads=1), [recording(paths, [], 0)], known=told)
    assert result.verdict == "adequate" and {each.name for each in result.detectable} >= {"payload", "backlash"}


def test_a_posterior_holds_what_is_known():
    from tests.results import RESULTS

    result = next(found for each in RESULTS.values() if (found := each()).trainable)
    *others, last = result.parameters
    assert parameter(replace(last, known="told")).endswith("(as told)")
    covariance = np.array(result.covariance)
    covariance[-1], covariance[:, -1] = 0.0, 0.0
    rows = tuple(map(tuple, covariance.tolist()))
    held = posterior(replace(result, parameters=(*others, replace(last, known="told")), covariance=rows))
    draws = [held.sample(np.random.default_rng(seed))[last.estimate.name] for seed in range(3)]
    assert draws == [last.estimate.value] * 3


@pytest.mark.parametrize("command", [Diagnose, Infer])
def test_both_commands_take_the_same_spelling(command):
    first = ["r.parquet"] if command is Diagnose else ["sysid", "r.parquet"]
    options = ["--known", "trunk_mass=0.3", "damping=0.2", "--known", "recorded"]
    found = tyro.cli(command, args=[*first, "--out", "x", *options])
    assert joined(found.known) == ["trunk_mass=0.3", "damping=0.2", "recorded"]
