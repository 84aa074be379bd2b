"""Which laws are tried, how probable they are, where an unknown one acts, and what is told at the end."""

from dataclasses import dataclass

from soro_bench.diagnosis.settings.setting import setting


@dataclass(frozen=True)
class ScreeningSettings:
    """What each candidate term would gain, to first order."""

    largest_step: float = setting(1.0, "prior deviations", "of a parameter beside added terms; linear only so far")
    least_share: float = setting(
        0.3, "1", "of the largest predicted gain, below which no term is tried, paired, or simulated if it was assumed"
    )
    largest_response: float = setting(
        10.0,
        "times the misfit",
        "response to a typical magnitude, where the misfit dominates; beyond it is scaled down",
    )

    def __post_init__(self) -> None:
        """Refuse a share that no term has.

        Raises:
            ValueError: not even the best term would be tried.
        """
        if self.least_share > 1.0:
            raise ValueError(f"least_share = {self.least_share:.3g}; at most 1 is allowed")


@dataclass(frozen=True)
class SelectionSettings:
    """Forward selection of terms, and the moves that refine hypotheses on the way."""

    # the fit without a term; its discretisation error is computed as far from the fit as its samples go
    nominal_radius: float = setting(0.7, "prior deviations", "of the first samples; parameters may be anywhere there")
    nominal_radius_last: float = setting(0.05, "prior deviations", "of the last samples; narrower ones see jumps only")
    nominal_replays: int = setting(3, "replays", "of each refined robot, before anything is known of the parameters")
    part_growth: float = setting(
        2**0.5, "1", "by which parts of recordings grow; where motion is chaotic, a fit leads no further"
    )
    part_left: float = setting(2.0, "noise deviations", "rms misfit of a part at most; more is no error of parameters")
    # which terms are tried
    candidates: int = setting(6, "screened candidates", "replayed in a round, and hypotheses that are compared")
    candidates_per_law: int = setting(2, "screened candidates", "of the same laws, and laws at each element of a kind")
    unchecked_terms: int = setting(3, "terms", "from which on each must lower held-out error; 30 s show so many")
    least_gain: float = setting(
        400.0, "nats", "predicted gain that is worth a fit; 39 of 40 healthy cases stay below 85"
    )
    least_gain_of_misfit: float = setting(
        0.05,
        "1",
        "of the misfit, likewise, also by a change or a term of a discovered law; small ones come of others",
    )
    beyond_chance: float = setting(
        2.0,
        "standard deviations",
        "of a fall of held-out error that is worth a term; of a parameter that may imitate one",
    )
    # fits
    fit_radius: float = setting(0.15, "prior deviations", "of samples once most of the motion is explained")
    fit_radius_last: float = setting(0.07, "prior deviations", "of the samples of the last fit of a hypothesis")
    move_radius: float = setting(0.3, "prior deviations", "of samples after a move or a first fit; cables fall slack")
    move_radius_second: float = setting(0.1, "prior deviations", "of the next samples after a move")
    fitted: int = setting(4, "laws", "of the tried ones that are fitted, after a replay of each")
    kept: int = setting(3, "laws", "of the fitted ones that are kept; locations where others are looked for")
    starts: tuple[float, ...] = setting(
        (0.1, 0.3, 1.0, 3.0, 10.0), "1", "times magnitudes from which fits may begin; of a simpler law also larger ones"
    )
    # refinement of hypotheses
    discretisations: int = setting(2, "hypotheses", "of a round whose discretisation error is computed")
    healthy_misfit: float = setting(1000.0, "nats", "below which no hypothesis is refined; healthy cases leave as much")
    rival_misfit: float = setting(2.0, "1", "times the best misfit, below which a hypothesis is a rival of the best")
    discrepant_misfit: float = setting(10_000.0, "nats", "that parameters hardly cause; then terms come before fits")
    discrepant_misfit_per_sample: float = setting(0.26, "nats", "likewise, of a sample of a long recording")
    turns: int = setting(5, "fits", "in a row, without outliers, or of terms scaled down, at most")
    turn_gain: float = setting(
        0.1, "1", "of the cost or misfit that a turn removes if another one follows; laws that differ by less are alike"
    )

    def __post_init__(self) -> None:
        """Refuse parts that do not grow, and rounds without a candidate.

        Raises:
            ValueError: no part would ever be the whole recording, or no term would be tried.
        """
        for name in ("candidates", "candidates_per_law"):
            if (count := getattr(self, name)) < 1:
                raise ValueError(f"{name} = {count}; at least 1 is needed")
        if self.part_growth <= 1.0:
            raise ValueError(f"parts that grow by {self.part_growth:.3g} never reach the whole; more than 1 is needed")


@dataclass(frozen=True)
class ProbabilitySettings:
    """How probable hypotheses are, from development cases and from opened blind benchmarks."""

    healthy_gain: float = setting(
        60.0,
        "nats",
        "location and scale of a Gumbel distribution of gains; 39 of 40 healthy cases stay below 85",
    )
    gain_of_term: float = setting(100.0, "nats", "that a fit gains by chance from one more term")
    gain_of_unknown: float = setting(50.0, "nats", "that a fit gains by chance from each unknown of a term")
    law_error: float = setting(
        0.006, "1", "share of the explained misfit that an unknown takes up, or one more term gains, of wrong laws"
    )
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
    unknown_gain_width: float = setting(0.2, "1", "of the logarithm of that gain; right laws leave two thirds of it")
    lost_by_chance: float = setting(
        0.1, "1", "of its gain that a law that is missing may lose on held-out motion, where it need not show"
    )
    hidden: float = setting(
        0.27, "1", "of robots hide physics, for each noise deviation of model-form error that they leave; release 7"
    )
    most_hidden: float = setting(0.45, "1", "of robots at most, likewise; 15 of 31 that left more than 1.3 deviations")
    wrong_when_certain: float = setting(0.03, "1", "share of answers that seemed certain and were wrong: 5 of 111")
    slow_variance: float = setting(
        0.12, "1", "of the residual, slow over fast, where a discrepancy is as likely as not"
    )
    slow_deviations: float = setting(5.0, "deviations", "the same from few pairs of samples")
    slow_power: float = setting(5.0, "1", "with which larger slow variances of healthy cases get rarer")
    slow_lag: float = setting(0.15, "s", "after which white noise is forgotten and motion is not")


@dataclass(frozen=True)
class LocalisationSettings:
    """Where an unknown input acts, and when a hypothesis explains more than another one. As many locations are looked
    at as candidates are fitted (``SelectionSettings.candidates``)."""

    # test inputs
    reach: float = setting(4.0, "noise deviations", "rms motion under a unit input; large enough to be seen")
    # input models
    node_spacing: float = setting(0.1, "s", "of piecewise linear inputs; a base may rock at 2 Hz")
    memory: float = setting(0.9, "s", "after which a trunk is where it would be without a pulse")
    most_values: int = setting(
        1000, "values", "of an input at one location; nodes of long recordings are farther apart"
    )
    # unknown-input estimation
    pulse: float = setting(0.5, "unit inputs", "of a pulse, for a column of the Jacobian")
    # maps of the residual
    map_window: float = setting(1.0, "s", "of maps over time; short beside a recording")
    shown_share: float = setting(0.8, "1", "of the improvement that lies in the intervals that are named")
    after_reversal: float = setting(0.25, "s", "after a command reverses; play and friction act then")
    fast_rate: float = setting(0.5, "1", "share of the fastest command above which motion is fast")


@dataclass(frozen=True)
class DiscoverySettings:
    """Laws at the location: from a grammar of terms to one that holds on held-out motion. It is looked for at as
    many locations as laws are kept (``SelectionSettings.kept``)."""

    location_share: float = setting(0.8, "1", "of the best location's gain, below which none is looked at")
    elements: int = setting(
        12, "elements", "of each kind that a law may read: of more joints or tendons none, of more actuators the first"
    )
    replayed: tuple[int, ...] = setting(
        (6, 5, 2), "laws", "of one to three terms that are replayed; half are fitted; as many as the last, again"
    )
    deviation: float = setting(2.0, "1", "of a coefficient's prior, times its regressed value")
    least_explained: float = setting(0.6, "1", "of held-out variance above the noise; laws took up to 0.40 of gusts")
    least_removed: float = setting(
        0.5, "1", "of held-out misfit: by a black box, or by a law from the catalogue's answer, which it then replaces"
    )
    limit: float = setting(3.0, "1", "times the largest force that was seen, which a law never exceeds")


@dataclass(frozen=True)
class ExperimentDesignSettings:
    """Which recording to make next."""

    duration: float = setting(10.0, "s", "of the recording that is proposed")
    hold: float = setting(4.0, "s", "of each position of a staircase; creep and leaks show then")
    rivals: int = setting(3, "answers", "that are told apart, at most")
    finalists: int = setting(2, "motions", "that are simulated again, along as many directions of the posterior")
    rest: float = setting(0.05, "1", "share of the duration, at rest before and after a motion")
    stroke: int = setting(3, "control steps", "at full rate, of a fast triangle")
    slow: int = setting(10, "1", "times slower than that, of slow motions")


@dataclass(frozen=True)
class LimitSettings:
    """Which limits that a simulated robot reaches are told."""

    least_share: float = setting(0.05, "1", "of the time at a limit; a peak now and then says little")
    tolerance: float = setting(
        1e-3, "1", "share of a range within which a value is at its end, or a command rests; solvers round"
    )


@dataclass(frozen=True)
class ReportSettings:
    """What is accepted, and which hypotheses and locations are worth more work at the end."""

    least_probability: float = setting(
        0.05,
        "1",
        "of an answer whose intervals are computed and that is told apart; of an unknown law, to locate it",
    )
    same_error: float = setting(0.01, "1", "share; a replay that is further from the printed error is noted")


@dataclass(frozen=True)
class PairedSettings:
    """When commands are the same, when a difference is a change, and how sure its explanation is. Candidates and fits
    are those of a diagnosis."""

    # commands
    same_commands: float = setting(0.02, "1", "share of a command's range, rms, by which the same commands may differ")
    least_overlap: float = setting(0.5, "1", "share of the shorter recording that both have to have")
    # model-free difference
    blocks: int = setting(
        10, "blocks", "of time, of as many samples at least, taken for independent; longer than motion lasts"
    )
    alpha: float = setting(0.01, "1", "p-value below which a difference is a change")
    beyond: float = setting(2.0, "1", "times the noise, or what runs of one robot differ by, that a difference has")
    # explanation
    unknown_share: float = setting(
        0.5, "1", "share of the difference left, where an unknown change is as likely as not"
    )
    unknown_width: float = setting(0.1, "1", "of that share, of the logistic function")
