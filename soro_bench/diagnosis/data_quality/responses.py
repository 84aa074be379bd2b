"""Whether a signal answers to commands: points that stand still although the robot is told to move, and commands that
nothing in the signal follows.

To a fit both look like physics: a motor without force, or friction that holds everything. Replays of the nominal robot
tell them apart. A signal less the replay, r, consists of what parameters change (columns J) and of what is missing of
the response to each command (columns H, the replay without the command less the one with it):

    r = J theta + H h + noise,    theta ~ N(0, 1) in prior deviations

h is 0 for a command that arrives and 1 for one that never does. A motor with a wrong gain lies between.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from soro_bench.arrays import Bools, Floats, Ints
from soro_bench.diagnosis.data_quality.lattice import chance
from soro_bench.diagnosis.data_quality.noise import noise_or_zero
from soro_bench.diagnosis.data_quality.texts import text
from soro_bench.diagnosis.result_robot import DataFinding
from soro_bench.diagnosis.robots.measured import Drive, Measured
from soro_bench.diagnosis.robots.robot import Robot
from soro_bench.diagnosis.settings import DEFAULT, Settings
from soro_bench.inference.statistical_linearisation import LENGTHS
from soro_bench.recording.recording import RecordingError

_MOST_NAMES = 5  # in a sentence
_EMPTY = 1e-6  # of a whole response, that is seen in what lacks of a command without any; it is then not known
_MOVES = 0.1  # share of the widest motion, of less nothing is known
_STEPS = 10  # of a descent, at most
_STEP = 0.3  # prior deviations, for a slope by replays; narrow ones see jumps only
_UNEXPLAINED = 0.3  # of the signal's squares about its mean, above its noise, that a command which never arrived leaves
_NO_MOTION = 2.0  # times the squares of the noise
_SMALLEST = 1e-300  # sum of squares, of which there is a logarithm


@dataclass(frozen=True)
class Answered:
    """What is measured, without points that stand still, and with commands as they arrived.

    findings: what was found.
    """

    measured: Measured
    findings: tuple[DataFinding, ...] = ()


def answered(measured: Measured, number: int, robot: Robot, settings: Settings = DEFAULT) -> Answered:
    """A recording whose first signal was compared with its commands.

    Args:
        number: index of the recording in the result.

    Raises:
        RecordingError: the whole signal stands still.
    """
    return _Comparison(measured, number, robot, settings).result()


class _Comparison:
    """One recording on its way through the checks; ``measured`` loses what says nothing of the robot."""

    def __init__(self, measured: Measured, number: int, robot: Robot, settings: Settings):
        self.measured, self.number, self.robot = measured, number, robot
        self.method, self.settings = settings, settings.data_quality
        self.nominal = np.zeros(len(robot.priors))
        self.findings: list[DataFinding] = []
        moved = np.ptp(measured.actions, axis=0) > 0
        self.moving, self.constant = np.flatnonzero(robot.driven & moved), np.flatnonzero(robot.driven & ~moved)

    def result(self) -> Answered:
        """What was found, and what is left."""
        if len(self.constant):
            self._note_commands("constant_command", self.constant)
        expected = self._replay(self.measured.drive) if len(self.moving) else None
        if expected is None or not np.isfinite(expected).all():
            return Answered(self.measured, tuple(self.findings))
        self._leave_out_still(expected, noisy=False)
        if self._is_left:
            for replay in self._replays_as_arrived(expected):
                self._leave_out_still(replay, noisy=True)
        if not self._is_left:
            raise RecordingError("; ".join(each.text for each in self.findings if each.name != "constant_command"))
        return Answered(self.measured, tuple(self.findings))

    @property
    def _is_left(self) -> bool:
        """Whether there is any sample."""
        return bool(np.isfinite(self.measured.values).any())

    def _replay(self, drive: Drive) -> Floats:
        """(T, P, D) the signal of the nominal robot."""
        return self._replays([drive], self.nominal[None])[0]

    def _replays(self, drives: Sequence[Drive], points: Floats) -> Floats:
        """(N, T, P, D) replays of the robot under drives, with parameters (n, d) in prior deviations."""
        values = [np.asarray(prior.value(points[:, i]), float) for i, prior in enumerate(self.robot.priors)]
        parameters = np.stack(values, axis=1) if values else points
        found = np.concatenate(self.robot.simulate_all(drives, parameters, [()] * len(points)))
        first = self.robot.signals[0]
        return found[:, :, : first.size].reshape(*found.shape[:2], *first.shape)

    def _note_commands(self, name: str, channels: Ints) -> None:
        """Tell of the commands of some channels."""
        names = [self.robot.channels[i] for i in channels]
        count, share = len(names) * len(self.measured.time), len(names) / int(self.robot.driven.sum())
        said = text(name, _listed(names), "1", share, {})
        self.findings.append(DataFinding(name, _listed(names), self.number, count, share, said))

    def _leave_out_still(self, expected: Floats, noisy: bool) -> None:
        """Leave out points that stand still where the replay (T, P, D) moves.

        Args:
            noisy: whether points count that have noise, but no motion.
        """
        values, found = self.measured.values, self._still(expected, noisy)
        if not len(found):
            return
        left = values.copy()
        left[:, found] = np.nan
        count, whole = np.isfinite(values[:, found]).sum(), not np.isfinite(left).any()
        share = float(count / np.isfinite(values).sum())
        reach = float((np.nanmax(values[:, found], axis=0) - np.nanmin(values[:, found], axis=0)).max())
        points = f", point{'s' * (len(found) > 1)} {_listed([str(p) for p in found])}"
        said = text(
            "unmoved",
            self.measured.signal + points * (not whole),
            self.measured.unit,
            share,
            {"reach": reach, "motion": float(np.ptp(expected[:, found], axis=0).max())},
        )
        self.findings.append(DataFinding("unmoved", self.measured.signal, self.number, int(count), share, said))
        self.measured = replace(self.measured, values=left)

    def _still(self, expected: Floats, noisy: bool) -> Ints:
        """Numbers of the points of :meth:`_leave_out_still`."""
        values, motion = self.measured.values, expected.std(axis=0)
        moves = motion > _MOVES * motion.max()
        still = np.array([
            [self._is_still(values[:, p, i], expected[:, p, i], noisy) for i in range(values.shape[2])]
            for p in range(values.shape[1])
        ])
        return np.flatnonzero(moves.any(axis=1) & (still | ~moves).all(axis=1))

    def _is_still(self, values: Floats, expected: Floats, noisy: bool) -> bool:
        """Whether a coordinate (T,) stands still where the replay moves."""
        settings, seen = self.settings, np.isfinite(values)
        if seen.sum() < settings.least_samples:
            return False
        x, motion = values[seen], float(expected[seen].std())
        if not noisy or np.ptp(x) == 0:
            return bool(np.ptp(x) == 0)
        about = x - x.mean()
        correlation = float(about[1:] @ about[:-1] / (about @ about))  # of white noise 0, deviation 1 / root T
        white = abs(correlation) < chance(len(x), settings)
        return bool(white and x.std() < settings.still_noise * motion)

    def _replays_as_arrived(self, expected: Floats) -> Iterator[Floats]:
        """Hold commands that nothing follows. The replay (T, P, D) then, and the one of all commands if it differs: a
        point that either moves and that stands still tells nothing, as its sensor may have failed instead."""
        arrived = self._without_unanswered(expected)
        yield arrived
        if arrived is not expected:
            yield expected

    def _without_unanswered(self, expected: Floats) -> Floats:
        """Hold commands that nothing follows; the replay (T, P, D) then."""
        seen = np.isfinite(self.measured.values)
        misfit = (self.measured.values - expected)[seen]
        if not misfit.any():
            return expected
        step = _STEP
        slopes = np.zeros((0, *expected.shape))
        if len(self.nominal):
            slopes = (self._replays([self.measured.drive], step * np.eye(len(self.nominal))) - expected) / step
        slopes = slopes[np.isfinite(slopes).all(axis=(1, 2, 3))][:, seen].T
        goals, without = self._held()
        lacking = np.nan_to_num(without - expected)[:, seen].T
        never = self._unanswered(misfit, slopes, lacking)[0]
        # a point that stands still may have lost its sensor instead: then others move as if the command arrived
        others = np.ones(seen.shape, bool)
        others[:, self._still(expected, noisy=True)] = False
        beside = others[seen]
        if never.any() and beside.any() and not beside.all():
            never &= ~self._unanswered(misfit[beside], slopes[beside], lacking[beside])[1]
        chosen = np.flatnonzero(never)
        if not len(chosen):
            return expected
        actions = self.measured.actions.copy()
        actions[:, self.moving[chosen]] = goals[chosen]
        held = replace(self.measured, actions=actions)
        # slopes mislead where the robot touches something: the parameters are fitted to tell
        left = self._least_misfit(held)
        if not left < self.settings.unanswered * self._least_misfit(self.measured):
            return expected
        # a missing spring makes a replay drift as if a command had not arrived; then that explains no motion
        if not self._explains(left):
            return expected
        self.measured = held
        self._note_commands("unanswered_command", self.moving[chosen])
        return self._replay(held.drive)

    def _least_misfit(self, measured: Measured) -> float:
        """Sum of the squares that the signal less its replay has under the most probable parameters.

        Its mean square counts as the variance of the noise, which is not known yet.
        """
        settings, misfits = self.method, partial(self._misfits, measured)
        low, high = np.array([prior.reach(settings.priors.limit) for prior in self.robot.priors]).reshape(-1, 2).T
        x, best, width = self.nominal, misfits(self.nominal[None])[0], _STEP
        for _ in range(_STEPS if len(x) and np.isfinite(best).all() else 0):
            step = np.where(x + width <= high, width, -width)
            slopes = (misfits(x + np.diag(step)) - best) / step[:, None]
            level = float(np.sqrt(np.mean(best**2)))
            columns = np.vstack([np.where(np.isfinite(slopes), slopes, 0.0).T, level * np.eye(len(x))])
            change = np.linalg.lstsq(columns, -np.r_[best, level * x], rcond=None)[0]
            points = np.clip(x + np.outer(LENGTHS, change), low, high)
            tried = misfits(points)
            cost, before = _costs(points, tried), _costs(x[None], best[None])[0]
            if not cost.min() < before:
                break
            x, best = points[cost.argmin()], tried[cost.argmin()]
        return float((best**2).sum())

    def _explains(self, left: float) -> bool:
        """Whether a sum of squares is little beside that of the signal's own motion above its noise."""
        values = self.measured.values.reshape(len(self.measured.values), -1)
        values = values[:, np.isfinite(values).any(axis=0)]
        motion = float(np.nansum((values - np.nanmean(values, axis=0)) ** 2))
        white = int(np.isfinite(values).sum()) * noise_or_zero(values, self.settings) ** 2
        return left - white <= _UNEXPLAINED * (motion - white) or motion <= _NO_MOTION * white

    def _misfits(self, measured: Measured, points: Floats) -> Floats:
        """(n, M) signal less replays with parameters (n, d) in prior deviations; infinite where one diverges."""
        seen = np.isfinite(measured.values)
        found = measured.values[seen] - self._replays([measured.drive], points)[:, seen]
        return np.where(np.isfinite(found), found, np.inf)

    def _unanswered(self, misfit: Floats, slopes: Floats, lacking: Floats) -> tuple[Bools, Bools]:
        """(A,) whether nothing follows each command, and whether something surely does; see :func:`_shares`."""
        never, deviation = _shares(misfit, slopes, lacking)
        known, missing = 3.0 * deviation < self.settings.unanswered, np.abs(never - 1.0) < self.settings.unanswered
        return known & missing, known & ~missing

    def _held(self) -> tuple[Floats, Floats]:
        """(A,) where each moving channel seems to be if its command never arrives, at its first one or at 0; and
        (A, T, P, D) the replays then."""
        given = self.measured.actions
        goals = np.stack([given[0, self.moving], np.zeros(len(self.moving))], axis=1)
        drives = []
        for channel, pair in zip(self.moving, goals, strict=True):
            for goal in pair:
                actions = given.copy()
                actions[:, channel] = goal
                drives.append(replace(self.measured.drive, actions=actions))
        replays = self._replays(drives, self.nominal[None]).reshape(*goals.shape, *self.measured.values.shape)
        best = np.nansum((self.measured.values - replays) ** 2, axis=(2, 3, 4)).argmin(axis=1)
        each = np.arange(len(goals))
        return goals[each, best], replays[each, best]


def _shares(misfit: Floats, slopes: Floats, lacking: Floats) -> tuple[Floats, Floats]:
    """(A,) shares of what lacks of the response to each command, and their standard deviations.

    Args:
        misfit: (M,) signal less replay. slopes: (M, d) per prior deviation. lacking: (M, A) of whole responses.
    """
    size = np.linalg.norm(lacking, axis=0)
    size[size == 0] = 1.0
    d, columns = slopes.shape[1], np.hstack([slopes, lacking / size])
    weights = np.full(columns.shape[1], _EMPTY)
    weights[:d] = np.sqrt(np.mean(misfit**2))
    found = np.linalg.lstsq(np.vstack([columns, np.diag(weights)]), np.r_[misfit, np.zeros(len(weights))], rcond=None)[
        0
    ]
    left = float(np.mean((misfit - columns @ found) ** 2))
    covariance = np.linalg.inv(columns.T @ columns + np.diag(weights**2)) * left
    return found[d:] / size, np.sqrt(np.diag(covariance)[d:]) / size


def _costs(points: Floats, misfits: Floats) -> Floats:
    """(n,) minus twice the log posterior of parameters (n, d) that leave misfits (n, M), up to a constant."""
    squares = np.maximum((misfits**2).sum(axis=1), _SMALLEST)
    return np.asarray(misfits.shape[1] * np.log(squares) + (points**2).sum(axis=1))


def _listed(names: Sequence[str]) -> str:
    """Names, the first of many."""
    more = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {more} more" if more > 0 else "")
