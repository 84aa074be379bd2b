"""The numbers of the comparison of paired recordings, with units and reasons."""

from dataclasses import dataclass

from soro_bench.diagnosis.settings.setting import setting


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
    most_steps: int = setting(1500, "control steps", "of all pairs that are simulated; the rest is compared without it")
    least_share: float = setting(
        0.03, "1", "share of the whole difference that one more change explains; changes that differ by less are alike"
    )
    least_gain: float = setting(5.0, "nats", "of evidence that one more change has to gain")
    unknown_share: float = setting(
        0.5, "1", "share of the difference left, where an unknown change is as likely as not"
    )
    unknown_width: float = setting(0.1, "1", "of that share, of the logistic function")
