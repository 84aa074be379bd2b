"""What was found in a signal, what was done with it, and what to do, in one sentence each."""

import math
from collections.abc import Mapping

TEXTS = {
    "wrap": "it jumps back by {turn} after each turn, and was taken as one angle that goes on; write unwrap = true for "
    "it in the mapping of the import",
    "placeholders": "{share} of the samples are {value} where the motion is elsewhere, and were left out as missing; "
    "write that number, as it stands in the file, into missing = [...] of the mapping, or check the sensor's line",
    "quantisation": "its values are {step} apart, so the noise was taken as {rounding} at least and repeated values "
    "count once; a finer sensor would show smaller effects",
    "clipping": "{share} of the samples lie at the end of the sensor's range, or where something stops the robot, and "
    "were left out; use a larger range or a smaller motion",
    "held": "{share} of the samples only repeat the one before, and were left out; log the sensor at its own rate, as "
    "delays of less than a row cannot be told now",
    "frozen": "{share} of the samples are those of a sensor that stood still for a while, and were left out; check its "
    "cable and its driver",
    "spikes": "{share} of the samples are single ones about {size} off, and were left out before anything was fitted; "
    "check the sensor's cable or tracking",
    "bursts": "{share} of the time stamps are late, by up to {late}, and were replaced by regular ones; log the "
    "sensor's own time instead of that of receipt",
    "jitter": "{share} of the time stamps are off, by up to {late}, and were replaced by regular ones; log the "
    "sensor's own time instead of that of receipt",
    "coarse_clock": "its time stamps are rounded, by up to {late}, and were replaced by regular ones; use a finer "
    "clock",
    "clock_step": "its clock was set while it recorded, by up to {late}, and the stamps were put together again; use a "
    "clock that nobody sets",
    "irregular": "its samples come at irregular times, and where they are too far from a control step were left out; "
    "sample faster, or at control steps",
    "missing_samples": "{share} of the samples are missing, and count neither for nor against anything; check for lost "
    "messages or hidden markers",
    "unmoved": "{share} of the samples stay within {reach} although commands move, which would be {motion} in the "
    "model, and were left out; check that the sensor is connected and the right column, and that the motor is on",
    "unanswered_command": "nothing in the signal follows it, so it was taken as held; check its column, its line and "
    "the power of its motor",
    "constant_command": "it never changes, so nothing can be told of how it acts; move it in the next recording",
}  # fmt: skip


def text(name: str, signal: str, unit: str, share: float, values: Mapping[str, float]) -> str:
    """The sentence of a finding of a signal.

    Args:
        unit: of the signal. share: of its samples that are concerned.
        values: ``step``, ``size`` or ``value`` [unit], ``turn`` [rad] or ``late`` [s], as the finding has them.
    """
    said = {key: f"{value:.3g} {unit}" if unit != "1" else f"{value:.3g}" for key, value in values.items()}
    if "step" in values:
        rounding = values["step"] / math.sqrt(12)
        said["rounding"] = f"{rounding:.3g} {unit}" if unit != "1" else f"{rounding:.3g}"
    if "late" in values:
        said["late"] = f"{1e3 * values['late']:.3g} ms"
    percent = f"{100 * share:.2g} %" if share < 0.995 else "all"
    return f"{signal}: " + TEXTS[name].format(share=percent, **said)
