"""Every number that the diagnosis method was given, with its unit and its reason.

There is one frozen dataclass per stage, and ``Settings`` holds one of each. A problem carries the settings of its
diagnosis (``Problem.settings``). Functions without a problem take the settings of their stage as an argument.

``benchmarks/diagnosis_settings.py`` halves and doubles each value in turn. It writes docs/reference/settings.md.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import Any


def setting(default: Any, unit: str, reason: str) -> Any:
    """A field of a settings class.

    Args:
        default: its value.
        unit: of the value; "1" for a ratio, or the thing that is counted.
        reason: why it has this value, in one sentence.
    """
    return field(default=default, metadata={"unit": unit, "reason": reason})


@dataclass(frozen=True)
class DataQualitySettings:
    """Which recordings are usable, their noise, and their outliers."""

    window: int = setting(6, "samples", "short enough that a polynomial describes the motion in it")
    degree: int = setting(4, "1", "degree of that polynomial; it leaves one number of a window, which is noise")
    least_samples: int = setting(20, "samples", "fewer samples say nothing of the noise")
    least_present: float = setting(0.5, "1", "share of a coordinate's samples that has to be present")
    largest_signal: float = setting(1e4, "unit of the signal", "no robot is larger; the log is corrupt")
    quiet_windows: float = setting(0.05, "1", "share of the windows that hold noise only, as the robot rests in them")
    least_noise: float = setting(1e-6, "1", "share of the signal's range; simulated recordings have no other noise")
    repeated: float = setting(0.2, "1", "share of equal successive samples above which a signal is quantised")
    outlier_deviations: float = setting(6.0, "noise deviations", "normal noise goes so far once in 10^9 samples")
    outlier_times_usual: float = setting(4.0, "1", "times the usual jump nearby; fast motion is wrong in many samples")
    outlier_neighbours: int = setting(10, "samples", "on either side, from which the usual jump is taken")
    outlier_return: float = setting(0.5, "1", "share of the jump by which the samples before and after may differ")


@dataclass(frozen=True)
class UnitCheckSettings:
    """Whether the signal is in the unit that the recording names."""

    correlation: float = setting(0.9, "1", "of measured and simulated motion; below it the ratio means nothing")
    tolerance: float = setting(0.15, "1", "of the ratio to that of a wrong unit; parameters change motion by less")


@dataclass(frozen=True)
class DiscretisationSettings:
    """Errors of time step and model, which are no physics."""

    fitted_refinement: int = setting(2, "1", "of the time step in fits; one of a trunk's leaves 0.66 mm, half 0.29 mm")
    reference_refinement: int = setting(4, "1", "of the time step in the reference; twice as fine as that of the fits")
    negligible: float = setting(0.1, "noise deviations", "rms of an error that explains none of a large misfit")


@dataclass(frozen=True)
class LikelihoodSettings:
    """What is taken for noise."""

    misfit_dominated: float = setting(10.0, "noise deviations", "rms misfit above which the model's error is the noise")
    diverged: float = setting(1e3, "noise deviations", "residual of a sample where the simulation diverged")


@dataclass(frozen=True)
class PriorSettings:
    """How far parameters and effects may be from where a search begins."""

    limit: float = setting(4.0, "prior deviations", "farthest that a parameter or a law's shape may be from its prior")
    same_robot: float = setting(0.1, "prior deviations", "drift of a parameter since the baseline diagnosis")
    magnitude_deviation: float = setting(5.0, "typical magnitudes", "of an effect; wide, as any may be there")
    shape_deviation: float = setting(0.7, "1", "of the logarithm of a time, rate or exponent of a law: a factor of 2")


@dataclass(frozen=True)
class FitSettings:
    """Maximum a posteriori fits by statistical linearisation."""

    samples: int = setting(16, "replays", "least number per linearisation; a regression of few unknowns needs more")
    samples_with_jacobian: int = setting(6, "replays", "least number where the Jacobian is known from before")
    largest_step: float = setting(3.0, "prior deviations", "of an unknown in one step; linearisations end there")


@dataclass(frozen=True)
class DescentSettings:
    """Levenberg-Marquardt descent from a fit, where the misfit dominates."""

    difference: float = setting(0.01, "prior deviations", "of an unknown, for its column of the Jacobian")
    steps: int = setting(10, "steps", "at most")
    least_gain: float = setting(0.003, "1", "share of the cost that a step has to gain for another one")
    smallest_damping: float = setting(0.01, "1", "factor of the damping tried first; five more follow, each times 10")


@dataclass(frozen=True)
class CovarianceSettings:
    """Posterior covariance from replays that are as wide as the posterior."""

    parameter_width: float = setting(0.3, "prior deviations", "of the first samples; narrow ones see jumps only")
    magnitude_share: float = setting(0.3, "1", "of an effect's magnitude, likewise; the effect stays in all samples")
    rounds: int = setting(4, "rounds", "of samples, each as wide as the covariance before it")
    samples: int = setting(64, "replays", "of a round at least")
    samples_per_unknown: int = setting(4, "replays", "of a round for each unknown at least")


@dataclass(frozen=True)
class RobotSettings:
    """Simulations of a robot and its commands. A robot has them before it is diagnosed (``Robot.settings``)."""

    simulations: int = setting(128, "simulations", "side by side at least; replays of a fit fill them")
    most_simulations: int = setting(256, "simulations", "side by side at most")
    degrees_of_freedom: int = setting(2000, "1", "of all simulations; smaller models run more of them side by side")
    suite_deviation: float = setting(0.25, "1", "prior deviation of the logarithm of a suite robot's stiffness or mass")
    poisson_deviation: float = setting(0.03, "1", "prior deviation of a suite robot's Poisson's ratio")
    wall_deviation: float = setting(0.01, "m", "prior deviation of the wall's offset")
    solver_tolerance: float = setting(
        1e-5, "1", "of the suite's simulations; keypoints move by 0.1 um, steps cost less"
    )
    diverged: float = setting(1e6, "unit of the signal", "a simulation with a larger signal has diverged")
    test_range: float = setting(0.3, "1", "share of an actuator's range that a proposed motion uses")
    command_changes: int = setting(3, "changes", "of a command in a control step; more would be left out")
    range_tolerance: float = setting(1e-3, "1", "share of an actuator's range by which a command may exceed it")


@dataclass(frozen=True)
class Settings:
    """The settings of a diagnosis, one group per stage."""

    data_quality: DataQualitySettings = DataQualitySettings()
    unit_check: UnitCheckSettings = UnitCheckSettings()
    discretisation: DiscretisationSettings = DiscretisationSettings()
    likelihood: LikelihoodSettings = LikelihoodSettings()
    priors: PriorSettings = PriorSettings()
    fit: FitSettings = FitSettings()
    descent: DescentSettings = DescentSettings()
    covariance: CovarianceSettings = CovarianceSettings()

    def listed(self) -> Iterator[tuple[str, str, Any, str, str]]:
        """Stage, name, value, unit and reason of every setting."""
        for stage in fields(self):
            yield from listed(stage.name, getattr(self, stage.name))


def listed(stage: str, group: Any) -> Iterator[tuple[str, str, Any, str, str]]:
    """Stage, name, value, unit and reason of every setting of a group."""
    for each in fields(group):
        yield stage, each.name, getattr(group, each.name), each.metadata["unit"], each.metadata["reason"]
