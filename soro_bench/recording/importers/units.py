"""Units that measurements come in, and their factors to SI."""

import math
import re

from soro_bench.recording.recording import RecordingError

# unit: SI unit and how many of it
UNITS = {
    "1": ("1", 1.0), "%": ("1", 0.01),
    "um": ("m", 1e-6), "mm": ("m", 1e-3), "cm": ("m", 1e-2), "m": ("m", 1.0), "in": ("m", 0.0254),
    "mm/s": ("m/s", 1e-3), "cm/s": ("m/s", 1e-2), "m/s": ("m/s", 1.0),
    "m/s^2": ("m/s^2", 1.0), "g0": ("m/s^2", 9.80665),
    "deg": ("rad", math.pi / 180), "rad": ("rad", 1.0), "rev": ("rad", 2 * math.pi),
    "deg/s": ("rad/s", math.pi / 180), "rad/s": ("rad/s", 1.0), "rpm": ("rad/s", math.pi / 30),
    "g": ("kg", 1e-3), "kg": ("kg", 1.0),
    "mN": ("N", 1e-3), "N": ("N", 1.0), "kN": ("N", 1e3), "gf": ("N", 9.80665e-3), "kgf": ("N", 9.80665),
    "mNm": ("N m", 1e-3), "Nm": ("N m", 1.0),
    "Nm/rad": ("N m/rad", 1.0), "Nm/deg": ("N m/rad", 180 / math.pi),
    "Pa": ("Pa", 1.0), "hPa": ("Pa", 1e2), "kPa": ("Pa", 1e3), "MPa": ("Pa", 1e6), "mbar": ("Pa", 1e2),
    "bar": ("Pa", 1e5), "psi": ("Pa", 6894.757293168361),
    "ns": ("s", 1e-9), "100ns": ("s", 1e-7), "us": ("s", 1e-6), "ms": ("s", 1e-3), "s": ("s", 1.0), "min": ("s", 60.0),
    "h": ("s", 3600.0), "d": ("s", 86400.0),
    "Hz": ("1/s", 1.0), "ml": ("m^3", 1e-6), "l": ("m^3", 1e-3),
    "ml/min": ("m^3/s", 1e-6 / 60), "l/min": ("m^3/s", 1e-3 / 60),
    "mV": ("V", 1e-3), "V": ("V", 1.0), "mA": ("A", 1e-3), "A": ("A", 1.0), "ohm": ("ohm", 1.0), "K": ("K", 1.0),
}  # fmt: skip
EPOCH = 1e9, 1e10  # s since 1970 of the years 2001 to 2286
_ORIGINS: tuple[tuple[str, float, float, str], ...] = (  # unit, least and largest number, and what it counts
    *((u, EPOCH[0] / UNITS[u][1], EPOCH[1] / UNITS[u][1], "a time since 1970") for u in ("s", "ms", "us", "ns")),
    ("d", 20_000.0, 80_000.0, "days since 1899-12-30, as in spreadsheets"),
    ("d", 710_000.0, 770_000.0, "days since the year 0, as in MATLAB"),
    ("100ns", 1.2e17, 1.6e17, "a time since 1601, as in Windows"),
    ("100ns", 6.3e17, 6.7e17, "a time since the year 1, as in .NET"),
)
_SELDOM = 5.0  # s between dates at most; a counter of smaller units may be as large
TIME_UNITS = ", ".join(unit for unit, (dimension, _) in UNITS.items() if dimension == "s")


def si(unit: str) -> tuple[str, float]:
    """SI unit and factor of a unit; RecordingError lists the known ones."""
    if not isinstance(unit, str) or unit not in UNITS:
        raise RecordingError(f"unknown unit {ascii(unit)[:40]}; there are {', '.join(UNITS)}")
    return UNITS[unit]


_NAMES = {
    "\u00b0": "deg", "\u00ba": "deg", "degree": "deg", "degrees": "deg", "\u00b0/s": "deg/s", "deg/sec": "deg/s",
    "dps": "deg/s", "radian": "rad", "radians": "rad", "rad/sec": "rad/s", "rev/min": "rpm", "u/min": "rpm",
    "1/min": "rpm",
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sek", "sekunde", "sekunden"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "millisec", "millisecond", "milliseconds",
                     "millisekunden"), "ms"),
    **dict.fromkeys(("us", "\u00b5s", "\u03bcs", "usec", "usecs", "micros", "microsec", "microsecond", "microseconds",
                     "mikrosekunden"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecond", "nanoseconds", "nanosekunden"), "ns"),
    "100 ns": "100ns", "filetime": "100ns", "\u79d2": "s", "\u30df\u30ea\u79d2": "ms",
    **dict.fromkeys(("min", "mins", "minute", "minutes", "minuten"), "min"),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours", "stunden"), "h"), "day": "d", "days": "d", "tage": "d",
    "\u00b5m": "um", "\u03bcm": "um", "mm/sec": "mm/s", "m/sec": "m/s", "m/s\u00b2": "m/s^2", "m/s2": "m/s^2",
    "n": "N", "newton": "N", "n*m": "Nm", "n m": "Nm", "n\u00b7m": "Nm", "nm": "Nm", "n-m": "Nm", "n.m": "Nm",
    "n*mm": "mNm", "nmm": "mNm", "pascal": "Pa", "pa": "Pa", "hz": "Hz", "v": "V", "volt": "V", "volts": "V", "a": "A",
    "amp": "A", "amps": "A", "-": "1", "": "1", "none": "1", "a.u.": "1", "bool": "1", "percent": "%",
    "\u03a9": "ohm", "kelvin": "K", "meter": "m", "meters": "m", "metre": "m", "metres": "m",
    **dict.fromkeys(("centimeter", "centimeters", "centimetres"), "cm"),
    **dict.fromkeys(("millimeter", "millimeters", "millimetres"), "mm"), "mm": "mm", "cm": "cm",
    "m": "m",
}  # fmt: skip


def of_text(text: str) -> str | None:
    """The unit that a text in a file stands for, such as "[mm]" or "rad/sec"; None if it is unknown."""
    name = text.strip().strip("[](){}<>\"'").strip()
    return name if name in UNITS else _NAMES.get(name.lower())


_BRACKETS = re.compile(r"^(.*?)\s*[\[(]([^\])]*)[\])]\s*$")
_SHORT = ("1", "%", "in", "l", "g", "min", "h", "d")  # endings that rarely mean a unit
_ORDINARY = ("second", "meter", "metre", "day", "none", "-")  # words that as rarely do
_DIVIDED = re.compile(r"^(?=.*?(\s/\s|\sin\s)|)([^/]*?\S)\s*(?:/|\sin\s)\s*(\S+)$")
_MARKED = re.compile(r"^(.*[^\s_.,:-])[\s_.,:-]+([^\s_,:-]+?)_*$")
_CAMEL = re.compile(r"^(.*[a-z0-9])([A-Z][A-Za-z]+|\u00b0)$")


def in_brackets(name: str) -> tuple[str, str] | None:
    """A name in a header and the text in brackets at its end, such as "q" and "deg"; None without brackets."""
    return (found[1], found[2]) if (found := _BRACKETS.match(name)) else None


def split_unit(name: str) -> tuple[str, str | None]:
    """A name in a header without its unit, and the unit: of "q [deg]", "pos_mm", "speed_rad_s", "F / N", "x in mm" or
    "angleDeg". A ratio of units that is none of UNITS, as in "compliance_mm_N", is not taken for the last of them."""
    found = in_brackets(name)
    if found and found[1].isdecimal():  # an index
        return "".join(found), None
    if found:
        return found[0] or name, of_text(found[1])
    if "_per_" in name:
        amount, _, time = name.rpartition("_per_")
        stem, _, unit = amount.rpartition("_")
        return (stem, f"{unit}/{time}") if f"{unit}/{time}" in UNITS else (name, None)
    parts = name.split("_")
    ratio = len(parts) > 2 and len(parts[-2]) > 1 and _is_unit(parts[-2]) and _is_unit(parts[-1])
    for count in (3, 2) if ratio else (3, 2, 1):
        if len(parts) <= count:
            continue
        ending = parts[-count:]
        for text in ("_".join(ending), "/".join([*ending[:-1], re.sub(r"(?<=s)2$", "^2", ending[-1])])):
            if _is_unit(text):
                return "_".join(parts[:-count]), text
    return (name, None) if ratio else _written_unit(name)


def _written_unit(name: str) -> tuple[str, str | None]:
    """A name without the unit that is written behind a blank, a slash or another mark, or as a word."""
    found = _DIVIDED.match(name)
    unit = _ending(found[3], 1) if found else None
    if found and unit and (found[1] or (unit != "s" and not _ending(re.split(r"[\W_]", found[2])[-1], 1))):
        return found[2], unit  # as physicists write quantities, and no ratio of two units
    for pattern in (_MARKED, _CAMEL):
        unit = _ending(found[2], 2) if (found := pattern.match(name)) else None
        if found and unit and (si(unit)[0] != "s" or found[2].lower() in UNITS):  # "tv_sec" is a name of times
            return found[1], unit
    return name, None


def _ending(text: str, least: int) -> str | None:
    """The unit that an ending of at least so many letters means; None for what rarely means one."""
    if text in UNITS:
        return text if len(text) >= least and text not in _SHORT else None
    lower = text.lower()
    if lower in _ORDINARY or (len(text) < 3 and text.isascii() and text.isalpha() and lower not in UNITS):
        return None
    unit = lower if lower in UNITS and lower not in _SHORT else _NAMES.get(lower)
    return None if unit == "1" else unit


def time_unit(name: str) -> str | None:
    """The unit that a name of times says somewhere, such as "TimeUS", "t/ms" or "ms since start"; None for several."""
    found = in_brackets(name)
    words = re.split(r"[^A-Za-z\u00b5\u03bc]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name))
    units = {unit for word in words if (unit := _ending(word, 2)) and si(unit)[0] == "s"}
    if (found and found[1]) or not units:
        unit = split_unit(name)[1] or of_text(name)
        return unit if unit and si(unit)[0] == "s" else None
    return units.pop() if len(units) == 1 else None


def origin(number: float, step: float) -> tuple[str, str] | None:
    """The unit in which a number is a date, if others follow it in such steps, and what it counts; None if it is
    none."""
    for unit, least, most, counts in _ORIGINS:
        if least < number < most and step * UNITS[unit][1] < _SELDOM:
            return unit, counts
    return None


def _is_unit(text: str) -> bool:
    """Whether the end of a name means a unit."""
    return text in UNITS and text not in _SHORT
