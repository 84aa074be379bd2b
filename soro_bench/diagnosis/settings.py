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
    refits: int = setting(3, "fits", "without the outliers of the fit before, at most")
    refit_noise: float = setting(0.5, "1", "share of the noise before a fit, below which the fit is made again")

    def __post_init__(self) -> None:
        """Refuse a window whose polynomial goes through all of its samples.

        Raises:
            ValueError: no number of a window is noise.
        """
        if self.window < self.degree + 2:
            raise ValueError(f"a window of {self.window} samples says nothing beside a polynomial of {self.degree}")


@dataclass(frozen=True)
class SignalSettings:
    """What sensors and loggers do to signals, looked for in the samples as they were recorded."""

    least_samples: int = setting(20, "samples", "fewer samples say nothing of a sensor")
    largest_number: float = setting(1e30, "unit of the signal", "nothing that stands for a missing sample is larger")
    # steps of a quantised signal (data_quality/lattice.py)
    least_step: float = setting(
        0.3, "noise deviations", "of a step; rounding to smaller ones adds nothing to the noise"
    )
    most_levels: int = setting(2**18, "levels", "in the range of a signal; finer steps are below the least noise")
    fewest_levels: int = setting(4, "levels", "in the range of a signal; of coarser ones nothing can be told")
    whole_step: float = setting(0.02, "steps", "by which changes over a few levels may differ from whole steps")
    least_levels: int = setting(20, "samples", "on different levels, without which there is no evidence of levels")
    level_sharpness: float = setting(0.5, "1", "of the characteristic function; noise of 0.2 steps leaves 0.45")
    surely_levels: float = setting(0.8, "1", "of the characteristic function of all levels, for a multiple of a step")
    least_changes: int = setting(12, "samples", "after which the increment changes, for evidence of levels")
    least_sharpness: float = setting(0.15, "1", "of the same function of many changes; noise of 0.12 steps leaves it")
    most_sharpness: float = setting(0.9, "1", "that is asked of the same function of few changes")
    change_deviations: float = setting(3.0, "deviations", "of that quantity of changes that are no multiples")
    level_evidence: float = setting(7.0, "nats", "against levels by chance, beside the number of steps that are tried")
    # samples that a sensor or a logger has spoilt (data_quality/samples.py)
    least_placeholders: int = setting(3, "samples", "of one far-off value; fewer may be spikes")
    spike_noise: float = setting(8.0, "noise deviations", "that samples are off at least, before anything is fitted")
    usual_change: float = setting(0.9, "1", "quantile of the changes of a point, below which no sample is a spike")
    spike_changes: float = setting(3.0, "1", "times the changes beside them; bounces change these too")
    spike_reach: float = setting(0.02, "1", "share of the range that a value for missing samples is off at least")
    wrap_tolerance: float = setting(0.25, "1", "share of a turn that an angle may move between two samples")
    clip_steps: float = setting(3.5, "steps", "by which values come to the end of a range and leave it, at least")
    clip_levels: int = setting(
        20, "levels", "in the range of a signal, of which the times on the last one tell anything"
    )
    clip_times: float = setting(6.0, "1", "times as long on the last level as on those beside it; rest begins slowly")
    least_clipped: int = setting(5, "samples", "at the end of a range; fewer are no evidence")
    random_noise: float = setting(2e-5, "1", "share of the range, above which noise makes equal values unlikely")
    random_flips: float = setting(0.42, "1", "share of sign changes of differences; 0.6 in noise, 0.25 without any")
    quiet_share: float = setting(0.5, "1", "share of the differences that count, the smallest; motion adds to others")
    least_flips: int = setting(20, "pairs", "of differences, without which nothing is known of the noise")
    least_frozen: int = setting(4, "samples", "of one value; noise hardly repeats itself so often")
    least_held: int = setting(5, "runs", "of equal values between jumps; fewer are no evidence of a slow sensor")
    held_share: float = setting(0.03, "1", "share of the samples; rounding to six digits repeats 0.1 % by chance")
    held_jumps: float = setting(0.15, "1", "share of the jumps beside equal values, where these may be rest or levels")
    held_steps: float = setting(2.5, "steps", "of a jump; slow motion takes one level after the other")
    held_reach: float = setting(
        1e-4, "1", "share of the range of a jump; a robot that comes to rest makes smaller ones"
    )
    held_even: float = setting(0.8, "1", "share of runs of the same length, but for one sample")
    frozen_jump: float = setting(1.5, "1", "times the next change; motion that begins is smaller than what follows")
    # time stamps (data_quality/stamps.py)
    regular: float = setting(0.01, "1", "share of the period by which stamps may differ; 0.2 ms at 50 Hz")
    stamp_window: int = setting(20, "samples", "in which some are received at once; bursts are shorter")
    whole_gap: float = setting(0.1, "1", "share of the period by which a gap may differ from whole periods")
    least_even: int = setting(8, "gaps", "that a coarse clock makes evenly; lost rows come at random")
    even_ticks: float = setting(0.6, "ticks", "that stamps are off even spacing at most; rounding leaves half a tick")
    one_sided: float = setting(2.0, "1", "times as far as stamps are early, that they are late in bursts")
    least_tick: float = setting(0.02, "1", "share of the period that a clock rounds to")
    whole_tick: float = setting(0.05, "1", "share of a tick by which intervals may differ from whole ticks")
    mostly: float = setting(0.9, "1", "share of the samples for which a rule has to hold")
    level_step: float = setting(0.3, "1", "share of the period that a clock is set by, at least")
    level_times_usual: float = setting(6.0, "1", "times the usual change of the earliest stamps nearby, likewise")
    smoother: float = setting(0.8, "1", "times as rough as with regular stamps, below which given stamps are right")
    same_time: float = setting(1e-3, "1", "share of a control step by which a sample may be early or late")
    cubic_error: float = setting(
        0.3, "1", "share of its distance from the line that a cubic errs by where motion begins"
    )
    clock_rate: float = setting(5e-4, "1", "deviation of a clock's rate where stamps are rebuilt; crystals have 1e-4")
    snapped: float = setting(1e-3, "1", "of a whole number of control steps; clocks differ by less")


@dataclass(frozen=True)
class ResponseSettings:
    """Whether a signal answers to commands, beside replays of the nominal robot."""

    least_samples: int = setting(20, "samples", "of a coordinate; fewer say nothing of its motion")
    least_motion: float = setting(0.1, "1", "share of the widest motion of a replay; less is no evidence of standstill")
    still_motion: float = setting(0.01, "1", "share of a replay's motion below which a coordinate stands still")
    still_noise: float = setting(0.3, "1", "the same share of white noise, which is no motion")
    still_correlation: float = setting(3.0, "deviations", "of successive samples; motion correlates nearly all of them")
    parameter_step: float = setting(0.5, "prior deviations", "of the differences that say what parameters change")
    unanswered: float = setting(0.3, "1", "by which the missing share of a response may differ from all of it")
    unanswered_deviation: float = setting(0.1, "1", "standard deviation of that share, above which nothing is known")
    unanswered_left: float = setting(
        0.3, "1", "share of the squared misfit without these commands; swapped ones leave a half"
    )


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
    model_form_share: float = setting(0.75, "1", "of how far simulators of the robot are apart; others differ so much")
    model_form_left: float = setting(
        0.7, "1", "share of a possible model-form error that a law may leave: half its power"
    )
    model_form_predicted: float = setting(0.9, "1", "likewise, predicted to first order; of friction less is predicted")


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
    offset_share: float = setting(0.02, "1", "share of the range of a signal beside the first: a typical offset of it")
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
class ScreeningSettings:
    """What each candidate term would gain, to first order."""

    largest_step: float = setting(1.0, "prior deviations", "of a parameter beside added terms; linear only so far")
    paired: int = setting(20, "candidate terms", "that gain most alone; each is paired with every other one")


@dataclass(frozen=True)
class SelectionSettings:
    """Forward selection of terms, and the moves that refine hypotheses on the way."""

    # the fit without a term; its discretisation error is computed as far from the fit as its samples go
    nominal_radius: float = setting(0.7, "prior deviations", "of the first samples; parameters may be anywhere there")
    nominal_radius_second: float = setting(0.3, "prior deviations", "of the next samples; cables fall slack nearby")
    nominal_radius_near: float = setting(0.15, "prior deviations", "of samples once most of the motion is explained")
    nominal_radius_last: float = setting(0.05, "prior deviations", "of the last samples; narrower ones see jumps only")
    nominal_replays: int = setting(3, "replays", "of each refined robot, before anything is known of the parameters")
    nominal_reach: float = setting(2.0, "prior deviations", "farthest of such a replay near a fit")
    # which terms are tried
    candidates: int = setting(6, "screened candidates", "that are fitted in a round; the right one was among them")
    candidates_per_law: int = setting(2, "screened candidates", "of the same laws, so that other laws are tried too")
    spread_laws: int = setting(2, "laws", "at each element of a kind that are fitted in a round beside the others")
    least_share_of_gain: float = setting(0.3, "1", "share of the best predicted gain below which none is tried")
    unchecked_terms: int = setting(3, "terms", "before each must lower held-out error; recordings of 30 s show so many")
    least_gain: float = setting(400.0, "nats", "predicted gain that is worth a fit; 40 healthy cases reach 85, but one")
    least_gain_of_misfit: float = setting(0.05, "1", "share of the misfit, likewise; small shares come of unknown laws")
    least_gain_of_explained: float = setting(0.005, "1", "share of what is explained, likewise; no law is quite right")
    beyond_chance: float = setting(2.0, "standard errors", "by which held-out error has to fall for another term")
    restarts: int = setting(5, "restarts", "from better parameters, where a term only led out of a local minimum")
    # fits
    fit_radius: float = setting(0.15, "prior deviations", "of the samples that fit a new term")
    fit_radius_last: float = setting(0.07, "prior deviations", "of the samples of the last fit of a hypothesis")
    move_radius: float = setting(0.3, "prior deviations", "of the first samples after a move of a hypothesis")
    move_radius_second: float = setting(0.1, "prior deviations", "of the next samples after a move")
    fitted: int = setting(4, "laws", "of the tried ones that are fitted, after a replay of each")
    kept: int = setting(3, "laws", "of the fitted ones that are kept")
    smaller_start: float = setting(0.5, "1", "share of estimated magnitudes from which a fit may begin too")
    smallest_start: float = setting(0.1, "1", "likewise, where a term is taken away; Jacobians vanish without any")
    simplified_starts: tuple[float, ...] = setting(
        (0.1, 0.3, 1.0, 3.0, 10.0), "typical magnitudes", "from which fits of simpler laws may begin"
    )
    # refinement of hypotheses
    discretisations: int = setting(2, "hypotheses", "of a round whose discretisation error is computed")
    refinements: int = setting(4, "fits", "of a hypothesis and its discretisation error in turns, at most")
    refinement_gain: float = setting(0.1, "1", "share of the misfit that a refinement has to remove for another one")
    healthy_misfit: float = setting(1000.0, "nats", "below which no hypothesis is refined; healthy cases leave as much")
    rival_misfit: float = setting(2.0, "1", "times the best misfit, below which a hypothesis is a rival of the best")
    discrepant_misfit: float = setting(10_000.0, "nats", "that parameters hardly cause; then terms come before fits")
    discrepant_misfit_per_sample: float = setting(0.26, "nats", "likewise, of a sample of a long recording")
    convergence_fits: int = setting(5, "fits", "in a row at most, where the misfit dominates")
    convergence_gain: float = setting(0.1, "1", "share of the cost that such a fit has to gain for another one")


@dataclass(frozen=True)
class ProbabilitySettings:
    """How probable hypotheses are, from development cases and from opened blind benchmarks."""

    gumbel_location: float = setting(60.0, "nats", "of predicted gains of healthy cases; 39 of 40 reach 85 at most")
    gumbel_scale: float = setting(60.0, "nats", "of that Gumbel distribution, with some to spare")
    gain_of_term: float = setting(100.0, "nats", "that a fit gains by chance from one more term")
    gain_of_unknown: float = setting(50.0, "nats", "that a fit gains by chance from each unknown of a term")
    law_error: float = setting(0.006, "1", "share of the explained misfit that each unknown takes up of wrong laws")
    temperature: float = setting(100.0, "nats", "least, by which log evidence is divided (power posterior)")
    temperature_of_misfit: float = setting(0.1, "1", "share of the best misfit that adds to it; models are as wrong")
    unknown_share: float = setting(
        0.25, "1", "share of the misfit that is left where a catalogue law is as likely as not"
    )
    unknown_share_width: float = setting(0.06, "1", "of that share, of the logistic function")
    healthy_misfit_per_sample: float = setting(0.066, "nats", "left of fitted samples; 158 of 160 healthy cases: 0.06")
    unknown_gain: float = setting(
        500.0, "nats", "predicted for one more term, where a catalogue law is as likely as not"
    )
    unknown_gain_of_explained: float = setting(0.006, "1", "share of the explained misfit that adds to it")
    unknown_gain_width: float = setting(0.2, "1", "of the logarithm of that gain; right laws leave two thirds of it")
    wrong_when_certain: float = setting(0.03, "1", "share of answers that seemed certain and were wrong: 5 of 111")
    slow_variance: float = setting(
        0.12, "1", "of the residual, slow over fast, where a discrepancy is as likely as not"
    )
    slow_deviations: float = setting(5.0, "deviations", "the same from few pairs of samples")
    slow_power: float = setting(5.0, "1", "with which larger slow variances of healthy cases get rarer")
    slow_lag: float = setting(0.15, "s", "after which white noise is forgotten and motion is not")
    largest_sample: float = setting(4.0, "noise deviations", "that a sample counts as; outliers may be left")
    compared: int = setting(6, "hypotheses", "with terms that are simulated on held-out recordings")


@dataclass(frozen=True)
class LocalisationSettings:
    """Where an unknown input acts, and when a hypothesis explains more than another one."""

    # test inputs
    weight_share: float = setting(0.02, "1", "of a robot's weight, first size of a force on a body")
    sensor_offset: float = setting(2.0, "noise deviations", "of a measured point")
    reach: float = setting(4.0, "noise deviations", "rms motion under a unit input; large enough to be seen")
    # input models
    node_spacing: float = setting(0.1, "s", "of piecewise linear inputs; a base may rock at 2 Hz")
    memory: float = setting(0.9, "s", "after which a trunk is where it would be without a pulse")
    most_values: int = setting(
        1000, "values", "of an input at one location; nodes of long recordings are farther apart"
    )
    correlation_times: tuple[float, ...] = setting(
        (0.2, 0.6, 2.0), "s", "of a free input, Matern 3/2; the best one counts"
    )
    shapes: int = setting(8, "principal components", "of the signal, in which an input may be linear")
    # screening of locations
    window: float = setting(0.15, "s", "in which an input is constant, times its directions")
    located: int = setting(6, "locations", "with the largest predicted gain, that are looked at")
    located_per_kind: int = setting(2, "locations", "of every kind at least, as the prediction is linear")
    least_scale: float = setting(0.03, "unit inputs", "smallest prior deviation of an input")
    screened_scale: float = setting(30.0, "unit inputs", "largest prior deviation of a screened input")
    screened_scales: int = setting(13, "1", "prior deviations that are screened")
    # unknown-input estimation
    estimated_scale: float = setting(1000.0, "unit inputs", "largest prior deviation of an estimated input")
    estimated_scales: int = setting(14, "1", "prior deviations that are tried")
    finalists: int = setting(8, "locations", "that go on after the first round")
    rounds: int = setting(8, "rounds", "of Gauss-Newton steps at most")
    steps: int = setting(4, "steps", "of a round with the same Jacobian, at most")
    step_shares: tuple[float, ...] = setting((0.1, 0.4, 1.0), "1", "of a step that are replayed; cables fall slack")
    smaller_inputs: float = setting(16.0, "1", "times smaller than predicted inputs are tried too")
    together: int = setting(8, "locations", "that are replayed side by side")
    pulse: float = setting(0.5, "unit inputs", "of a pulse, for a column of the Jacobian")
    parameter_difference: float = setting(0.05, "prior deviations", "of a parameter, for a column of the Jacobian")
    least_gain: float = setting(1.0, "nats", "of a round or a step that is worth another one")
    # maps of the residual
    map_window: float = setting(1.0, "s", "of maps over time; short beside a recording")
    shown_share: float = setting(0.8, "1", "of the improvement that lies in the intervals that are named")
    after_reversal: float = setting(0.25, "s", "after a command reverses; play and friction act then")
    rest_rate: float = setting(1e-3, "1", "share of the fastest command below which a command rests")
    fast_rate: float = setting(0.5, "1", "share of the fastest command above which motion is fast")


@dataclass(frozen=True)
class AgreementSettings:
    """Whether several recordings have the same parameters."""

    radii: tuple[float, ...] = setting(
        (0.15, 0.15, 0.07), "prior deviations", "of the samples of a recording's steps from the joint fit"
    )
    alpha: float = setting(0.05, "1", "chance of any difference that is called a change, of all that are compared")


@dataclass(frozen=True)
class ExperimentDesignSettings:
    """Which recording to make next."""

    duration: float = setting(10.0, "s", "of the recording that is proposed")
    hold: float = setting(4.0, "s", "of each position of a staircase; creep and leaks show then")
    least_probability: float = setting(0.05, "1", "of an answer that is still to be told apart")
    rivals: int = setting(3, "answers", "that are told apart, at most")
    finalists: int = setting(2, "motions", "that are simulated again with other values of the unknowns")
    directions: int = setting(2, "directions", "of the posterior, the widest, for those values")
    separating_odds: float = setting(20.0, "1", "tempered odds that tell two answers apart")
    rest: float = setting(0.05, "1", "share of the duration, at rest before and after a motion")
    stroke: int = setting(3, "control steps", "at full rate, of a fast triangle")
    slow: int = setting(10, "1", "times slower than that, of slow triangles")
    slow_loops: int = setting(4, "1", "times slower than full rate, of nested loops")


@dataclass(frozen=True)
class LimitSettings:
    """Which limits that a simulated robot reaches are told."""

    least_share: float = setting(0.05, "1", "of the time at a limit; a peak now and then says little")
    tolerance: float = setting(1e-3, "1", "share of a range within which a value is at its end; solvers round")


@dataclass(frozen=True)
class ReportSettings:
    """What is accepted, and which hypotheses and locations are worth more work at the end."""

    most_numbers: int = setting(300_000, "numbers", "four minutes of a trunk; every candidate term adds as many")
    least_probability: float = setting(0.05, "1", "of a hypothesis whose intervals are computed by replays")
    same_error: float = setting(0.01, "1", "share; a replay that is further from the printed error is noted")
    least_unknown: float = setting(0.1, "1", "probability of an unknown law, above which its location is searched")


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
    walker_duration: float = setting(
        36.0, "s", "of a recording of MultiGait that is explained: all channels move; a replay of 130 s takes 6 s"
    )
    diverged: float = setting(1e6, "unit of the signal", "a simulation with a larger signal has diverged")
    test_range: float = setting(0.3, "1", "share of an actuator's range that a proposed motion uses")
    command_changes: int = setting(3, "changes", "of a command in a control step; more would be left out")
    range_tolerance: float = setting(1e-3, "1", "share of an actuator's range by which a command may exceed it")
    most_clipped: float = setting(0.5, "1", "share of a command that a model may clip; more is in another unit")


@dataclass(frozen=True)
class Settings:
    """The settings of a diagnosis, one group per stage."""

    data_quality: DataQualitySettings = DataQualitySettings()
    signals: SignalSettings = SignalSettings()
    responses: ResponseSettings = ResponseSettings()
    unit_check: UnitCheckSettings = UnitCheckSettings()
    discretisation: DiscretisationSettings = DiscretisationSettings()
    likelihood: LikelihoodSettings = LikelihoodSettings()
    priors: PriorSettings = PriorSettings()
    fit: FitSettings = FitSettings()
    descent: DescentSettings = DescentSettings()
    covariance: CovarianceSettings = CovarianceSettings()
    screening: ScreeningSettings = ScreeningSettings()
    selection: SelectionSettings = SelectionSettings()
    probabilities: ProbabilitySettings = ProbabilitySettings()
    localisation: LocalisationSettings = LocalisationSettings()
    agreement: AgreementSettings = AgreementSettings()
    experiment_design: ExperimentDesignSettings = ExperimentDesignSettings()
    limits: LimitSettings = LimitSettings()
    report: ReportSettings = ReportSettings()

    def listed(self) -> Iterator[tuple[str, str, Any, str, str]]:
        """Stage, name, value, unit and reason of every setting."""
        for stage in fields(self):
            yield from listed(stage.name, getattr(self, stage.name))


DEFAULT = Settings()


def listed(stage: str, group: Any) -> Iterator[tuple[str, str, Any, str, str]]:
    """Stage, name, value, unit and reason of every setting of a group."""
    for each in fields(group):
        yield stage, each.name, getattr(group, each.name), each.metadata["unit"], each.metadata["reason"]
