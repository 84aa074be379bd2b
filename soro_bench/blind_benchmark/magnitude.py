"""Whether a report says how much: the magnitudes of labels and reports, which name them in their own ways."""

# of an effect: what the label calls its magnitude, what a report does, and how many of its units one of the label's is
_SAME = {
    "actuator_deadband": ("width", "width", 1.0),
    "actuator_delay": ("delay", "delay", 1.0),
    "actuator_gain": ("gain", "gain", 1.0),
    "actuator_lag": ("time_constant", "time_constant", 1.0),
    "backlash": ("width", "width", 1.0),
    "clock_skew": ("skew", "rate", -1.0),  # of a slow clock, and of a fast one
    "compliance": ("compliance", "compliance", 1.0),
    "coulomb_friction": ("friction", "friction", 1.0),
    "fluid_drag": ("drag", "drag", 1.0),
    "load_friction": ("coefficient", "mu", 1.0),
    "local_stiffness": ("factor", "factor", 1.0),
    "mullins_softening": ("softening", "softening", 1.0),
    "payload": ("mass", "mass", 1.0),
    "pretension": ("offset", "offset", 1.0),
    "sensor_delay": ("delay", "delay", 1.0),
    "stiffening": ("cubic", "beta", 1.0),
    "stiffness_drift": ("rate", "rate", 60.0),  # 1/s and 1/min
    "stribeck_friction": ("friction", "friction", 1.0),
    "viscoelastic_creep": ("stiffness_ratio", "ratio", 1.0),
    "viscous_friction": ("drag", "damping", 1.0),
}
_NULL = {"actuator_gain": 1.0, "local_stiffness": 1.0}  # what stands for no effect, where that is not zero


def magnitude_errors(truth: dict, said: dict) -> tuple[float, bool] | None:
    """Error of the magnitude, as a share of how far it is from that of no effect, and whether the truth is in its 90 %
    interval; None where the two sides have no magnitude in common.

    Args:
        truth: an effect of a label.
        said: the same effect in a report.
    """
    if truth["name"] != said["name"] or truth["name"] not in _SAME:
        return None
    own, others, factor = _SAME[truth["name"]]
    exact, found = factor * truth["parameters"][own]["value"], said["parameters"][others]
    low, high = found["ci90"]
    size = abs(exact - _NULL.get(truth["name"], 0.0))
    return abs(found["value"] - exact) / size, bool(low <= exact <= high)
