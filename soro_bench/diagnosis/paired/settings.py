"""The numbers of the comparison of paired recordings, with units and reasons."""

from dataclasses import dataclass

from soro_bench.diagnosis.settings import setting


@dataclass(frozen=True)
class PairedSettings:
    """When commands are the same, when a difference is a change, and which changes are fitted."""

    # commands
    same_commands: float = setting(0.02, "1", "share of a command's range, rms, by which the same commands may differ")
    least_overlap: float = setting(0.5, "1", "share of the shorter recording that both have to have")
    longest_search: int = setting(50_000, "samples", "of a command, whose shift is looked for; more are thinned out")
    # model-free difference
    blocks: int = setting(10, "blocks", "of time whose differences are taken for independent; longer than motion lasts")
    least_block: int = setting(10, "samples", "of a block at least")
    alpha: float = setting(0.01, "1", "p-value below which a difference is a change")
    beyond_noise: float = setting(2.0, "1", "times the noise, above which two runs differ, whatever the cause")
    beyond_runs: float = setting(1.5, "1", "times what runs of one robot differ by, that a change differs by at least")
    start: int = setting(5, "samples", "at the beginning, whose mean is the initial state")
    start_deviations: float = setting(5.0, "noise deviations", "by which initial states differ")
    profile: int = setting(200, "windows", "of the difference over time, at most")
    # explanation
    most_steps: int = setting(1500, "control steps", "of all pairs that are simulated; the rest is compared without it")
    finalists: int = setting(8, "changes", "with the largest predicted gain that are fitted")
    finalists_per_law: int = setting(2, "changes", "of one law that are fitted, so that other laws are fitted too")
    refined: int = setting(3, "changes", "that are fitted together with the shared parameters")
    share_of_gain: float = setting(0.2, "1", "share of the best predicted gain below which no change is fitted")
    steps: int = setting(6, "steps", "of a least-squares fit at most")
    least_step_gain: float = setting(0.003, "1", "share of the cost that a step has to gain for another one")
    difference: float = setting(0.05, "prior deviations", "of an unknown, for a column of the Jacobian")
    least_share: float = setting(0.03, "1", "share of the whole difference that one more change has to explain")
    alike: float = setting(0.02, "1", "share of the difference by which changes of one kind are told apart")
    least_gain: float = setting(5.0, "nats", "of evidence that one more change has to gain")
    most_changes: int = setting(3, "changes", "at once; thirty seconds hardly tell more apart")
    unknown_share: float = setting(
        0.5, "1", "share of the difference left, where an unknown change is as likely as not"
    )
    unknown_width: float = setting(0.1, "1", "of that share, of the logistic function")
    model_change: float = setting(1.0, "prior deviations", "of a parameter that may have changed")
    listed: int = setting(10, "changes", "of the table")


DEFAULT = PairedSettings()
