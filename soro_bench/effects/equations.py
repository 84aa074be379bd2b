"""The equation of every law as LaTeX, and the symbols of its parameters: for reports and for the reference.

z is the elastic strain of an element that yields: it follows the motion until it is as large as its limit, and stays
there until the motion turns back. A condition in square brackets is 1 where it holds, and 0 otherwise.
"""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Equation:
    """A law as one line of LaTeX.

    Attributes:
        latex: without dollar signs.
        symbols: of the law's parameters, LaTeX by their names.
        other: what its other symbols are, LaTeX to text.
    """

    latex: str
    symbols: Mapping[str, str]
    other: Mapping[str, str]


_FRICTION = {"friction": "F_c", "presliding": r"\delta"}
_STRIBECK = {"static_ratio": r"\rho", "stribeck_velocity": "v_s", "presliding": r"\delta"}
_OFFSET = {"x": "b_x", "y": "b_y", "z": "b_z"}
_ROTATION = {"about_x": r"\theta_x", "about_y": r"\theta_y", "about_z": r"\theta_z"}

_F, _V, _Z = {"F": "force or torque"}, {"v": "velocity"}, {"z": "elastic strain, which slips at its limit"}
_UY = {"u": "setpoint asked for", "y": "setpoint that acts"}
_XY = {"x": "what happened", "y": "what was recorded"}
_Q = {r"\tau": "torque or force of the joint's spring", "k": "its stiffness", "q": "angle or way from its rest"}
_P = {"p": "pressure", "u": "pressure asked for"}
_MU = {r"\mu": "friction coefficient of the model"}

EQUATIONS: Mapping[str, Equation] = {
    "coulomb_friction": Equation(
        r"F = -F_c \, \frac{z}{\delta}, \quad \left| z \right| \le \delta", _FRICTION, {**_F, **_Z}
    ),
    "stribeck_friction": Equation(
        r"F = -F_c \left[ 1 + (\rho - 1) \, e^{-(v / v_s)^2} \right] \frac{z}{\delta}, "
        r"\quad \left| z \right| \le \delta",
        {"friction": "F_c", **_STRIBECK},
        {**_F, **_V, **_Z},
    ),
    "load_friction": Equation(
        r"F = -F_{\max} \, \frac{z}{\delta}, \quad F_{\max} = (1 - e^{-\mu \theta}) \, T \text{ (pulled)}, "
        r"\quad (e^{\mu \theta} - 1) \, T \text{ (paid out)}, "
        r"\quad \mu \, \left| \tau \right| \text{ (joint)}",
        {"mu": r"\mu", "presliding": r"\delta"},
        {**_F, **_Z, "T": "tension", r"\theta": "sum of the tendon's bends", r"\tau": "torque of the actuators"},
    ),
    "gear_friction": Equation(
        r"F = -\mu \, (\left| T - b L \right| + P) \left[ 1 + (\rho - 1) \, e^{-(v / v_s)^2} \right] \frac{z}{\delta}, "
        r"\quad \left| z \right| \le \delta",
        {"mu": r"\mu", "backdrive": "b", "preload": "P", **_STRIBECK},
        {**_F, **_Z, "T": "torque of the actuators", "L": "torque of the load", **_V},
    ),
    "input_friction": Equation(
        r"F = -\mu \, (\left| T \right| + P) \, \frac{z}{\delta}, \quad \left| z \right| \le \delta",
        {"mu": r"\mu", "preload": "P", "presliding": r"\delta"},
        {**_F, **_Z, "T": "force of the actuator"},
    ),
    "viscous_friction": Equation("F = -c \\, v", {"damping": "c"}, {**_F, **_V}),
    "backlash": Equation(
        r"y_t = \min \left( \max \left( y_{t-1}, \, u_t - \frac{w}{2} \right), \, u_t + \frac{w}{2} \right)",
        {"width": "w"},
        _UY,
    ),
    "lost_motion": Equation(
        r"F = k \left[ e - \min \left( \max \left( e, \, -\frac{w}{2} \right), \, \frac{w}{2} \right) \right], "
        r"\quad e = u - x",
        {"width": "w"},
        {"F": "force of the servo", "k": "its stiffness", "u": "setpoint", "x": "position"},
    ),
    "actuator_deadband": Equation(r"y = u - \min(\max(u, -w), \, w)", {"width": "w"}, _UY),
    "hysteresis": Equation(
        r"\tau = -k \, (q + \rho \, z), \quad \left| z \right| \le \epsilon",
        {"ratio": r"\rho", "yield_strain": r"\epsilon"},
        {**_Q, **_Z},
    ),
    "compliance": Equation(
        r"F = \frac{k \, (u - x) - d \, v}{1 + k c}",
        {"compliance": "c"},
        {**_F, "k": "stiffness of the servo", "d": "its damping", "u": "setpoint", "x": "position", **_V},
    ),
    "actuator_gain": Equation(r"y = g \, u", {"gain": "g"}, _UY),
    "pretension": Equation("y = u + o", {"offset": "o"}, _UY),
    "base_tilt": Equation(r"\mathbf{g}' = R(\theta) \, \mathbf{g}", _ROTATION, {r"\mathbf{g}": "gravity"}),
    "actuator_lag": Equation(r"T \, \dot y = u - y", {"time_constant": "T"}, _UY),
    "actuator_delay": Equation(r"y(t) = u(t - \Delta)", {"delay": r"\Delta"}, _UY),
    "pressure_asymmetry": Equation(r"\dot p = \frac{u - p}{T + D \, [u > p]}", {"difference": "D", "venting": "T"}, _P),
    "actuator_saturation": Equation(
        r"\left| F \right| \le (1 - \ell) \, F_{\max}", {"loss": r"\ell"}, {**_F, r"F_{\max}": "limit of the model"}
    ),
    "supply_coupling": Equation(
        r"\dot p = \max(0, \, 1 - c \, n) \, \dot u \quad \text{while } \dot u > 0",
        {"coupling": "c"},
        {**_P, "n": "other chambers that fill"},
    ),
    "stiffening": Equation(r"\tau = -k \, q \, (1 + \beta \, \left| q \right|^2)", {"beta": r"\beta"}, _Q),
    "mullins_softening": Equation(
        r"\tau = -k \, q \left[ 1 - s \, (1 - e^{-m / \epsilon}) \left( 1 - \frac{\left| q \right|}{m} \right) \right]",
        {"softening": "s", "strain": r"\epsilon"},
        {**_Q, "m": "largest strain so far"},
    ),
    "pressure_leak": Equation(r"\dot p = \dot u - r \, p", {"rate": "r"}, _P),
    "viscoelastic_creep": Equation(
        r"\tau = -k \, [q + \rho \, (q - r)], \quad T \, \dot r = q - r",
        {"ratio": r"\rho", "time_constant": "T"},
        {**_Q, "r": "rest of the second spring"},
    ),
    "plastic_set": Equation(
        r"\tau = -k \, [(1 - \sigma) \, q + \sigma \, z], \quad \left| z \right| \le \frac{1}{s}",
        {"softness": "s", "share": r"\sigma"},
        {**_Q, **_Z},
    ),
    "rest_bend": Equation(
        r"\tau = -k \, (q - q_0), \quad q_0 = (\alpha_x, \alpha_y)",
        {"angle_x": r"\alpha_x", "angle_y": r"\alpha_y"},
        _Q,
    ),
    "local_stiffness": Equation("k' = f k, \\quad d' = f d", {"factor": "f"}, {"k": "stiffness", "d": "damping"}),
    "stiffness_drift": Equation(
        r"k(t) = k \, \max(0.05, \, 1 + r t)", {"rate": "r"}, {"k": "stiffness", "t": "time since the start"}
    ),
    "payload": Equation("m' = m + M", {"mass": "M"}, {"m": "mass of the body"}),
    "fluid_drag": Equation(
        r"\mathbf{F} = -c \, \left| \mathbf{v} \right| \, \mathbf{v}",
        {"drag": "c"},
        {r"\mathbf{v}": "velocity of the body"},
    ),
    "anisotropic_friction": Equation(
        r"\mu' = \mu \, (1 + e \, [v_x < 0])", {"excess": "e"}, {**_MU, "v_x": "velocity along the world's x"}
    ),
    "stiction": Equation(
        r"\mu' = \mu \left( 1 + e \, \exp(-\left| \mathbf{v} \right|^2 / v_s^2) \right)",
        {"excess": "e", "velocity": "v_s"},
        {**_MU, r"\mathbf{v}": "velocity of the geom"},
    ),
    "adhesion": Equation(r"F_n \ge -A", {"force": "A"}, {"F_n": "normal force of each contact point"}),
    "sensor_delay": Equation(r"y(t) = x(t - \Delta)", {"delay": r"\Delta"}, _XY),
    "clock_skew": Equation(
        r"y(t) = x(t_0 + (1 - r)(t - t_0))", {"rate": "r"}, {**_XY, "t_0": "time of the first sample"}
    ),
    "sensor_bias": Equation(r"\mathbf{y} = \mathbf{x} + \mathbf{b}", _OFFSET, _XY),
    "marker_slip": Equation(
        r"\mathbf{y} = \mathbf{x} + \mathbf{b} \, [t - t_0 \ge t_s]",
        {**_OFFSET, "time": "t_s"},
        {**_XY, "t_0": "time of the first sample"},
    ),
    "frame_misalignment": Equation(r"\mathbf{y} = R(\theta) \, \mathbf{x} + \mathbf{b}", {**_ROTATION, **_OFFSET}, _XY),
    "outliers": Equation(
        r"\mathbf{y} = \mathbf{x} + s \, \mathbf{n} \quad \text{with probability } p",
        {"share": "p", "size": "s"},
        {**_XY, r"\mathbf{n}": "standard normal numbers"},
    ),
}
