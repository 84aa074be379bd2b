"""What recordings show: noise, outliers, what sensors and loggers do, whether signals answer, and their unit."""

from dataclasses import dataclass

from soro_bench.diagnosis.settings.setting import setting


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
    held_jumps: float = setting(0.05, "1", "share of the jumps beside equal values, where these may be rest or levels")
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
    at_once: float = setting(0.12, "1", "share of stamps received at once, likewise; many are, of few that are late")
    at_once_spread: float = setting(0.05, "1", "share of the spread of stamps that such ones are late at most")
    least_tick: float = setting(0.02, "1", "share of the period that a clock rounds to")
    whole_tick: float = setting(0.05, "1", "share of a tick by which intervals may differ from whole ticks")
    mostly: float = setting(0.9, "1", "share of the samples for which a rule has to hold")
    level_step: float = setting(0.3, "1", "share of the period that a clock is set by, at least")
    level_windows: int = setting(3, "windows", "beside a step in which it lasts; bursts of late stamps end before")
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
    parameter_limit: float = setting(4.0, "prior deviations", "farthest that they go to tell whether commands arrived")
    parameter_fits: int = setting(8, "steps", "of such a fit at most")
    parameter_gain: float = setting(0.5, "nats", "twice what a step of such a fit has to gain for another one")
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
