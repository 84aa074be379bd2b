"""Simulations, the noise model, priors, fits and their covariance."""

from dataclasses import dataclass

from soro_bench.diagnosis.settings.setting import setting


@dataclass(frozen=True)
class RobotSettings:
    """Simulations of a robot and its commands. A robot has them before it is diagnosed (``Robot.settings``)."""

    suite_deviation: float = setting(0.25, "1", "prior deviation of the logarithm of a suite robot's stiffness or mass")
    poisson_deviation: float = setting(0.03, "1", "prior deviation of a suite robot's Poisson's ratio")
    wall_deviation: float = setting(0.01, "m", "prior deviation of the wall's offset")
    test_range: float = setting(0.3, "1", "share of an actuator's range that a proposed motion uses")
    command_changes: int = setting(3, "changes", "of a command in a control step; more would be left out")
    range_tolerance: float = setting(1e-3, "1", "share of an actuator's range by which a command may exceed it")
    most_clipped: float = setting(0.5, "1", "share of a command that a model may clip; more is in another unit")


@dataclass(frozen=True)
class DiscretisationSettings:
    """Errors of time step and model, which are no physics."""

    fitted_refinement: int = setting(2, "1", "of the time step in fits; one of a trunk's leaves 0.66 mm, half 0.29 mm")
    reference_refinement: int = setting(4, "1", "of the time step in the reference; twice as fine as that of the fits")
    negligible: float = setting(0.1, "noise deviations", "rms of an error that explains none of a large misfit")
    model_form_share: float = setting(0.75, "1", "of how far simulators of the robot are apart; others differ so much")
    model_form_gain: float = setting(
        0.012,
        "1",
        "of the largest model-form error's misfit, gained by a law that explains as much as all others: even odds",
    )
    model_form_power: float = setting(2.0, "1", "with which these odds grow with the gain")


@dataclass(frozen=True)
class LikelihoodSettings:
    """What is taken for noise."""

    misfit_dominated: float = setting(10.0, "noise deviations", "rms misfit above which the model's error is the noise")


@dataclass(frozen=True)
class PriorSettings:
    """How far parameters and effects may be from where a search begins."""

    limit: float = setting(4.0, "prior deviations", "farthest that a parameter or a law's shape may be from its prior")
    same_robot: float = setting(0.1, "prior deviations", "drift of a parameter since the baseline diagnosis")
    magnitude_deviation: float = setting(5.0, "typical magnitudes", "of an effect; wide, as any may be there")
    common_share: float = setting(0.8, "1", "of the prior variance of magnitudes, that like elements have in common")
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
    smallest_damping: float = setting(0.01, "1", "factor of the damping tried first; five more follow, each times 10")


@dataclass(frozen=True)
class AgreementSettings:
    """Whether several recordings have the same parameters."""

    alpha: float = setting(0.05, "1", "chance of any difference that is called a change, of all that are compared")
