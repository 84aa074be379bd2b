"""A policy on a robot with hidden physics: TrunkReach in closed loop."""

from collections.abc import Callable

import numpy as np

from soro_bench.blind_benchmark.robot import Diverged, Robot
from soro_bench.envs.trunk import SUCCESS_DISTANCE
from soro_bench.envs.trunk_reach import EVALUATION_GOALS

STEPS = 100  # of an episode, as registered


def final_distances(act: Callable[[np.ndarray], np.ndarray], robot: Robot) -> np.ndarray:
    """(27,) m, from the tip to each of the fixed goals when the episode ends: at 1 mm, or after 100 steps. An episode
    in which the simulation diverges counts as one without motion.

    Args:
        act: observations (1, 66) as TrunkReach gives them to actions (1, 8).
    """
    return np.array([_final_distance(act, robot, goal) for goal in EVALUATION_GOALS])


def _final_distance(act: Callable[[np.ndarray], np.ndarray], robot: Robot, goal: np.ndarray) -> float:
    robot.begin(STEPS)
    start = distance = _distance(robot, goal)
    for _ in range(STEPS):
        if distance <= SUCCESS_DISTANCE:
            break
        robot.advance(act(np.append(robot.keypoints().ravel(), goal)[None])[0])
        distance = _distance(robot, goal)
    try:
        robot.check(robot.keypoints())
    except Diverged:
        return start
    return distance


def _distance(robot: Robot, goal: np.ndarray) -> float:
    return float(np.linalg.norm(robot.keypoints()[-1] - goal))
