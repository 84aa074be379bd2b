"""Searches for plans that bring the tip of the trunk to goals: random moves, Newton steps on them, and CMA-ES."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from soro_bench.envs.trunk import SUCCESS_DISTANCE, TrunkTask
from soro_bench.models import trunk_geometry as geo
from soro_bench.planning import EPISODE_STEPS, NUM_CABLES, actions_from_knots, antagonistic, roll_out

HOLD = (20, EPISODE_STEPS)  # steps at which the knots of a move that is then held are due: 1 s for up to 70 mm
SWING = (25, 50, 75, EPISODE_STEPS)  # the same of a plan that may pass the goal in motion


def final_distance(distance: np.ndarray) -> np.ndarray:
    """(...,) distance [m] at the end of episodes with distances (..., t): at success (1 mm) or after the last step."""
    solved = distance <= SUCCESS_DISTANCE
    end = np.where(solved.any(axis=-1), solved.argmax(axis=-1), distance.shape[-1] - 1)
    final = np.take_along_axis(distance, end[..., None], axis=-1)[..., 0]
    return np.where(np.isnan(final), np.inf, final)


@dataclass
class ReachPlan:
    """The best plan found for one goal."""

    goal: np.ndarray  # (3,) m
    knots: np.ndarray | None = None  # (k, 8) m
    due: Sequence[int] = HOLD
    final: float = np.inf  # m, distance at the end of the episode
    closest: float = np.inf  # m, smallest distance of the episode
    rollouts: int = 0  # of the search for this goal

    @property
    def found(self) -> np.ndarray:
        """The knots; ValueError before any plan was tried."""
        if self.knots is None:
            raise ValueError("no plan was tried yet")
        return self.knots

    @property
    def solved(self) -> bool:
        return self.final <= SUCCESS_DISTANCE


@dataclass
class ReachPlanner:
    """Plans for several goals of TrunkReach at once; a rollout made for one goal is scored for all.

    Args:
        task: a TrunkReachTask with continuous actions.
        goals: (g, 3) m.
        popsize: candidates per goal and iteration.
        seed: of the random candidates and of CMA-ES.
    """

    task: TrunkTask
    goals: np.ndarray
    popsize: int = 12
    seed: int = 0
    plans: list[ReachPlan] = field(init=False)

    def __post_init__(self) -> None:
        self.plans = [ReachPlan(goal) for goal in self.goals]
        self._rng = np.random.default_rng(self.seed)
        self._searches: list[KnotSearch | None] = [None] * len(self.plans)
        self._starts = [0] * len(self.plans)

    def try_random(self, count: int) -> None:
        """Score ``count`` random moves that are then held."""
        bends = self._rng.uniform(-1, 1, (count, 4)) * [0.07, 0.07, 0.04, 0.04]
        tightening = self._rng.uniform(0, 0.01, (count, 1))
        moves = antagonistic(bends, tightening)
        self.try_knots(np.repeat(moves[:, None], len(HOLD), axis=1), HOLD)

    def try_knots(self, knots: np.ndarray, due: Sequence[int]) -> None:
        """Score plans (n, k, 8) [m]."""
        self._evaluate(knots, tuple(due))

    def correct(self, cheap: TrunkTask, rounds: int = 10) -> Iterator[int]:
        """Quasi-Newton steps of the unsolved plans; yields the number of unsolved goals after each round.

        Args:
            cheap: a TrunkReachTask whose finite differences give the first Jacobians of the final tip position with
                respect to the knots; Broyden's updates follow.
            rounds: one rollout per goal each.
        """
        steps = {
            g: QuasiNewton(plan.goal, plan.found, plan.due, cheap)
            for g, plan in enumerate(self.plans)
            if not plan.solved
        }
        for _ in range(rounds):
            for due in (HOLD, SWING):
                members = [g for g, step in steps.items() if step.due == due and not self.plans[g].solved]
                if members:
                    tips = self._evaluate(np.stack([steps[g].ask() for g in members]), due)[1]
                    for g, tip in zip(members, tips[:, -1], strict=True):
                        steps[g].tell(tip)
                        self.plans[g].rollouts += 1
            yield sum(not plan.solved for plan in self.plans)

    def improve(self) -> Iterator[int]:
        """Run CMA-ES for every unsolved goal; yields the number of unsolved goals after each iteration.

        The first search of a goal varies the eight displacements of a held move; later ones, from the best plan so
        far, a swing of four knots, or a held move in turn as long as the best plan is one.
        """
        while unsolved := [g for g, plan in enumerate(self.plans) if not plan.solved]:
            for due in (HOLD, SWING):
                members = [g for g in unsolved if self._search(g).due == due]
                if not members:
                    continue
                asked = [self._search(g).ask() for g in members]
                costs = self._evaluate(np.concatenate(asked), due)[0]  # (candidates, goals)
                for i, g in enumerate(members):
                    own = slice(i * self.popsize, (i + 1) * self.popsize)
                    self._search(g).tell(costs[own, g])
                    self.plans[g].rollouts += self.popsize
            yield len([g for g in unsolved if not self.plans[g].solved])

    def _search(self, g: int) -> "KnotSearch":
        search = self._searches[g]
        if search is None or search.exhausted:
            plan, start = self.plans[g], self._starts[g]
            due = HOLD if start % 2 == 0 and len(plan.due) == len(HOLD) else SWING
            seed = 1 + self.seed + 1000 * g + start
            search = self._searches[g] = KnotSearch(resample(plan.found, plan.due, due), due, self.popsize, seed)
            self._starts[g] += 1
        return search

    def _evaluate(self, knots: np.ndarray, due: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """(n, g) final distances [m] of plans (n, k, 8) [m] to every goal, and (n, t, 3) tips [m] on the way.

        Better plans replace the goals' plans.
        """
        tips = play_tips(self.task, knots, due)
        distance = np.linalg.norm(tips[:, None] - self.goals[:, None], axis=-1)  # (n, g, t)
        final = final_distance(distance)
        for g, plan in enumerate(self.plans):
            best = int(final[:, g].argmin())
            if final[best, g] < plan.final:
                plan.knots, plan.due = knots[best].copy(), due
                plan.final, plan.closest = float(final[best, g]), float(np.nanmin(distance[best, g]))
        return final, tips


def resample(knots: np.ndarray, due: Sequence[int], new_due: Sequence[int]) -> np.ndarray:
    """(k', 8) the displacements [m] of the plan (k, 8) at the steps ``new_due``."""
    padded = np.concatenate([np.zeros((1, knots.shape[1])), knots])
    return np.stack([np.interp(new_due, [0, *due], column) for column in padded.T], axis=1)


def play_tips(task: TrunkTask, knots: np.ndarray, due: Sequence[int]) -> np.ndarray:
    """(n, t, 3) tip positions [m] on the way of plans (n, k, 8) [m]; the goal is out of reach."""
    return roll_out(task, actions_from_knots(knots, due), {"goal": [0.0, 0.0, -0.2]}, task.tip)


class QuasiNewton:
    """Damped steps that bring the final tip to a goal, with Broyden's updates of the Jacobian.

    Args:
        goal: (3,) m.
        start: (k, 8) m.
        due: k steps.
        cheap: the task whose finite differences give the first Jacobian.
    """

    DIFFERENCE = 0.001  # m, of a knot
    LONGEST = 0.006  # m, change of a knot per step
    DAMPING = 0.1  # tip motion per knot motion below which a direction is not used

    def __init__(self, goal: np.ndarray, start: np.ndarray, due: Sequence[int], cheap: TrunkTask):
        self.due = tuple(due)
        self._goal, self._knots = goal, start
        self._spread = _spread(self.due)  # (free, knots)
        moves = np.einsum("fk,cd->fckd", self._spread, np.eye(NUM_CABLES)).reshape(-1, len(self.due), NUM_CABLES)
        tips = play_tips(cheap, start + self.DIFFERENCE * np.concatenate([moves, 0 * moves[:1]]), due)[:, -1]
        self._moves = moves
        self._jacobian = (tips[:-1] - tips[-1]).T / self.DIFFERENCE  # (3, free * 8)
        self._tip: np.ndarray | None = None
        self._change = np.zeros(len(moves))

    def ask(self) -> np.ndarray:
        """(k, 8) m: the plan to play next, at first the start."""
        return self._knots + np.einsum("i,ikd->kd", self._change, self._moves)

    def tell(self, tip: np.ndarray) -> None:
        """Where the plan asked for last ended, (3,) m; NaN if it diverged."""
        if np.isnan(tip).any():
            self._change = self._change / 2
            return
        if self._tip is None:
            self._tip = tip
        else:
            miss = tip - self._tip - self._jacobian @ self._change
            self._jacobian += np.outer(miss, self._change) / (self._change @ self._change + 1e-12)
            if np.linalg.norm(tip - self._goal) < np.linalg.norm(self._tip - self._goal):
                self._knots, self._tip = self.ask(), tip
        normal = self._jacobian @ self._jacobian.T + self.DAMPING**2 * np.eye(3)
        change = self._jacobian.T @ np.linalg.solve(normal, self._goal - self._tip)
        self._change = change * min(1.0, self.LONGEST / np.abs(change).max())


def _spread(due: Sequence[int]) -> np.ndarray:
    """(free, k): which knots each free knot sets; a held move has one free knot."""
    return np.ones((1, len(due))) if tuple(due) == HOLD else np.eye(len(due))


class KnotSearch:
    """CMA-ES over the knots of one plan, in mm; a held move has one knot to vary.

    Args:
        start: (k, 8) m.
        due: k steps.
        popsize: candidates per iteration.
        seed: at least 1.
    """

    def __init__(self, start: np.ndarray, due: Sequence[int], popsize: int, seed: int, step: float = 0.004):
        import cma

        self.due = due
        self._free = len(_spread(due))
        limits = np.tile(1e3 * geo.CABLE_LIMITS, self._free)
        x = np.clip(1e3 * start[-self._free :].ravel(), -limits, limits)
        options = {"popsize": popsize, "seed": seed, "bounds": [-limits, limits], "verbose": -9, "tolfun": 1e-3,
                   "tolflatfitness": 5, "maxiter": 60 * self._free}  # fmt: skip
        self._cma = cma.CMAEvolutionStrategy(x, 1e3 * step, options)
        self._asked: list[np.ndarray] = []

    @property
    def exhausted(self) -> bool:
        return bool(self._cma.stop())

    def ask(self) -> np.ndarray:
        """(popsize, k, 8) candidates [m]."""
        self._asked = self._cma.ask()
        knots = 1e-3 * np.array(self._asked).reshape(-1, self._free, NUM_CABLES)
        return np.repeat(knots, len(self.due), axis=1) if self._free == 1 else knots

    def tell(self, costs: np.ndarray) -> None:
        """Costs [m] of the candidates asked for last."""
        self._cma.tell(self._asked, list(np.nan_to_num(1e3 * costs, posinf=1e6)))
