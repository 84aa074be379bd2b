"""What a simulation knows of its own limits, on models whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from soro_bench.diagnosis.assembly.limits import limits_of
from soro_bench.diagnosis.render.html import html
from soro_bench.diagnosis.render.summary import summary
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import ReachedLimit
from soro_bench.diagnosis.robots.measured import Drive
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import DEFAULT
from tests.results import RESULTS

STOPPED = """<mujoco><worldbody>
<body name="arm"><joint name="hinge" axis="0 1 0" range="-0.5 0.5" limited="true" damping="0.01"/>
<geom name="rod" type="capsule" size="0.01" fromto="0 0 0 0 0 -0.2" mass="0.1" contype="0" conaffinity="0"/></body>
</worldbody><actuator><position name="motor" joint="hinge" kp="5" forcerange="-2 2" ctrlrange="-3 3"/></actuator>
</mujoco>"""
PULLED = """<mujoco><worldbody><site name="top" pos="0 0 0.5"/>
<geom name="floor" type="plane" size="1 1 0.1"/>
<body name="load" pos="0 0 0.05"><joint name="lift" type="slide" axis="0 0 1" damping="1"/>
<geom name="box" type="box" size="0.05 0.05 0.05" mass="0.2"/><site name="hook" pos="0 0 0.05"/></body></worldbody>
<tendon><spatial name="rope"><site site="top"/><site site="hook"/></spatial></tendon>
<actuator><general name="winch" tendon="rope" gear="-1" gainprm="1" forcerange="0 1" forcelimited="true"/></actuator>
</mujoco>"""
MAP = """[robot]
control_timestep = 0.02
[commands.goal]
actuators = ["{actuator}"]
[signal]
name = "position"
joints = ["{joint}"]
unit = "{unit}"
[parameters.inertia]
fields = ["body_mass:{body}", "body_inertia:{body}"]
deviation = 0.2
"""


def _reached(robot: Robot, goals: np.ndarray) -> dict[tuple[str, str], ReachedLimit]:
    found = limits_of(robot, [Drive(goals[:, None])], np.ones((1, 1)), [], DEFAULT.limits)
    return {(each.name, each.element): each for each in found}


def test_an_arm_that_is_driven_into_its_stop_is_there_with_its_largest_force(robot_of):
    mapping = MAP.format(actuator="motor", joint="hinge", unit="rad", body="arm")
    robot = robot_of(mapping, STOPPED)
    found = _reached(robot, np.repeat([0.0, 2.9, 0.0], 100))
    stop, force = found["stop", "joint hinge"], found["force_limit", "actuator motor"]
    assert stop.share == pytest.approx(1 / 3, abs=0.05) and force.share == pytest.approx(1 / 3, abs=0.05)
    assert (force.value, force.unit) == (2.0, "N m")
    assert ("control_limit", "actuator motor") not in found  # 2.9 of 3
    assert found.keys() == {("stop", "joint hinge"), ("force_limit", "actuator motor")}


def test_a_control_at_the_end_of_its_range_is_told(robot_of):
    robot = robot_of(MAP.format(actuator="motor", joint="hinge", unit="rad", body="arm"), STOPPED)
    reached = _reached(robot, np.repeat([0.0, 3.0], [150, 50]))["control_limit", "actuator motor"]
    assert (reached.value, reached.unit) == (3.0, "rad")
    assert reached.share == pytest.approx(0.25, abs=0.01)


def test_a_rope_is_slack_at_its_limit_or_neither_and_its_load_rests_on_the_floor(robot_of):
    """Of 200 steps it is slack in 100, pulls half as much as it can in 50, and all that it can in 50; all of that is
    less than the load weighs."""
    robot = robot_of(MAP.format(actuator="winch", joint="lift", unit="m", body="load"), PULLED)
    found = _reached(robot, np.repeat([0.0, 0.5, 1.0], [100, 50, 50]))
    assert found["slack", "tendon rope"].share == pytest.approx(0.5, abs=0.02)
    assert found["force_limit", "tendon rope"].share == pytest.approx(0.25, abs=0.02)
    assert (found["force_limit", "tendon rope"].value, found["force_limit", "tendon rope"].unit) == (1.0, "N")
    assert found["contact", "geom box and geom floor"].share == pytest.approx(1.0, abs=0.02)


def test_a_trunk_that_pulls_one_cable_has_others_that_are_slack(robot):
    pull = np.zeros((40, 8), np.float32)
    pull[:, 0] = 1.0
    nominal = np.array([[prior.nominal for prior in robot.priors]])
    found = {(each.name, each.element) for each in limits_of(robot, [Drive(pull)], nominal, [], DEFAULT.limits)}
    assert ("force_limit", "tendon L0") in found and {("slack", "tendon S0"), ("slack", "tendon L1")} <= found
    assert ("slack", "tendon L0") not in found


def test_limits_are_on_the_console_in_the_report_and_in_the_file():
    limits = (
        *(ReachedLimit("force_limit", f"tendon L{i}", round(0.62 - 0.1 * i, 2), 30.0, "N") for i in range(6)),
        ReachedLimit("stop", "joint hinge", 0.1),
    )
    result = replace(next(iter(RESULTS.values()))(), limits=limits)
    assert Result.from_json(result.to_json()).limits == limits
    console, page = (
        text.replace("\u00a0", " ") for text in (summary(result).replace("\n" + " " * 15, " "), html(result))
    )
    for text in (console, page):
        assert "At a limit of force: tendon L0 (30 N) 62 %, tendon L1 (30 N) 52 %" in text
        assert "and 2 more of the time" in text and "At a stop: joint hinge 10 % of the time." in text
    assert "tendon L5" in page and "tendon L5" not in console
