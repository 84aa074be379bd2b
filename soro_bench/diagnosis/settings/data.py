"""What recordings show: noise, outliers, what sensors and loggers do, whether signals answer, and their unit."""

from dataclasses import dataclass

from soro_bench.diagnosis.settings.setting import setting


@dataclass(frozen=True)
class DataQualitySettings:
    """Which recordings are usable, their noise and outliers, what sensors and loggers do to signals, and whether these
    answer to commands."""

    least_samples: int = setting(20, "samples", "fewer samples, changes or levels say nothing of a sensor or clock")
    mostly: float = setting(0.9, "1", "share of samples, runs or evidence for which a rule has to hold")
    # noise and outliers (data_quality/noise.py)
    window: int = setting(6, "samples", "in which a polynomial that leaves one number for noise describes the motion")
    largest_signal: float = setting(1e4, "unit of the signal", "no robot is larger; the log is corrupt")
    quiet_windows: float = setting(0.05, "1", "share of the windows that hold noise only, as the robot rests in them")
    least_noise: float = setting(1e-6, "1", "share of the signal's range; simulated recordings have no other noise")
    repeated: float = setting(0.2, "1", "share of equal successive samples above which a signal is quantised")
    outlier_deviations: float = setting(6.0, "noise deviations", "normal noise goes so far once in 10^9 samples")
    outlier_times_usual: float = setting(4.0, "1", "times the usual jump nearby; fast motion has many")
    outlier_return: float = setting(0.5, "1", "share of the jump by which the samples before and after may differ")
    # steps of a quantised signal (data_quality/lattice.py)
    least_step: float = setting(
        0.3, "noise deviations", "of a step; rounding to smaller ones adds nothing to the noise"
    )
    fewest_levels: int = setting(4, "levels", "in the range of a signal; of coarser ones nothing can be told")
    whole: float = setting(
        0.05, "1", "by which a number of steps, ticks or periods may differ from a whole one; and of delays, from none"
    )
    level_sharpness: float = setting(0.5, "1", "of the characteristic function; noise of 0.2 steps leaves 0.45")
    evidence: float = setting(7.0, "nats", "against levels, or motion in noise, by chance: one in 1000")
    sensor_error: float = setting(1.0, "steps", "beside rounding; makers of encoders state a step or more")
    within_steps: float = setting(0.99, "1", "share of the samples of each number that such errors hold for")
    # samples that a sensor or a logger has spoilt (data_quality/samples.py)
    least_repeats: int = setting(
        4, "samples or runs", "of one value, as a held sensor has; noise hardly repeats itself"
    )
    spike_changes: float = setting(3.0, "1", "times the changes beside them; bounces change these too")
    wrap_tolerance: float = setting(0.25, "1", "share of a turn that an angle may move between two samples")
    jump_steps: float = setting(3.0, "steps", "of a jump; slow motion takes one level after the other")
    jump_reach: float = setting(
        1e-4, "1", "share of the range of a jump, as robots that come to rest make smaller ones; or of random noise"
    )
    clip_speed: float = setting(0.25, "1", "of the usual speed, that motion has where a sensor's range ends")
    stands_still: float = setting(0.05, "1", "share of a range, by which a stop may be elsewhere in the simulation")
    rest_slows: float = setting(0.7, "1", "share of the step before, below which motion comes to rest before its end")
    random_flips: float = setting(0.42, "1", "share of sign changes of differences; 0.6 in noise, 0.25 without any")
    held_share: float = setting(0.03, "1", "share of the samples; rounding to six digits repeats 0.1 % by chance")
    # time stamps (data_quality/stamps.py)
    regular: float = setting(0.01, "1", "share of the period by which stamps may differ; 0.2 ms at 50 Hz")
    one_sided: float = setting(2.0, "1", "times as far as stamps are early, that they are late in bursts")
    at_once: float = setting(0.12, "1", "share of stamps received at once, likewise; many are, of few that are late")
    level_step: float = setting(0.3, "1", "share of the period that a clock is set by, at least")
    same_time: float = setting(1e-3, "1", "share of a control step by which a sample or a period may differ")
    cubic_error: float = setting(
        0.3, "1", "share of its distance from the line that a cubic errs by where motion begins"
    )
    # whether the signal answers to commands, beside replays (data_quality/responses.py), and its unit
    still_noise: float = setting(0.3, "1", "share of a replay's motion below which white noise is no motion")
    unanswered: float = setting(
        0.3, "1", "by which the missing share of a response may be off, by 3 deviations; share of the misfit without it"
    )
    unit_tolerance: float = setting(
        0.15, "1", "of the ratio of motions to that of a wrong unit, and of their correlation; parameters change less"
    )

    def __post_init__(self) -> None:
        """Refuse a window in which no polynomial leaves a number.

        Raises:
            ValueError: a window has too few samples.
        """
        if self.window < 2:
            raise ValueError(f"a window of {self.window} samples; at least 2 are needed to tell noise from motion")
