"""Time stamps of a file: counters that overflow, stamps that repeat or go back, and what to do about them."""

import datetime
import re
from collections.abc import Sequence

import numpy as np

from soro_bench.recording.importers.wraps import unwrapped
from soro_bench.recording.recording import RecordingError

ORDERS = ("refuse", "keep_first", "keep_last", "sort", "continue")
_COUNTERS = (16, 24, 32)  # bits
_TICKS = (1e-3, 1e-6)  # such as microseconds in ms or in s
DATE_ORDERS = ("day/month/year", "month/day/year")
NO_STAMP = np.iinfo(np.int64).min
_DATE = re.compile(r"(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})|(\d{1,2})([./-])(\w{1,3})[./-](\d{4})")
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_GERMAN = {"m\u00e4r": "mar", "mrz": "mar", "mai": "may", "okt": "oct", "dez": "dec"}
_STAMP = re.compile(
    r"(?:(\d\S*?\d)[T_ ]+)?(\d{1,2}):([0-5]\d)(?::([0-5]\d|60)(?:[.,](\d{1,12}))?)? ?([AaPp][Mm])? ?"
    r"(Z|UTC|GMT|[+-]\d\d(?::?\d\d)?)?"
)
_MINUTES = re.compile(r"([0-5]?\d):([0-5]\d(?:[.,]\d{1,12})?)")  # and seconds: a log of hours and minutes is too slow
_COMPACT = re.compile(r"^(\d{4})(\d\d)(\d\d)[T_ ](\d?\d)(\d\d)(\d\d)")
_DIGITS = re.compile(  # a date and a time of day of digits only, at whole seconds, ms or us
    r"((?:19|20)\d\d(?:0[1-9]|1[0-2])(?:0[1-9]|[12]\d|3[01]))((?:[01]\d|2[0-3])[0-5]\d[0-5]\d)"
    r"(?:[.,](\d{1,12})|(\d{3}|\d{6}))?"
)
_DURATIONS = (  # sign, days, sign, hours, minutes, seconds; as pandas, Python and .NET write them, and ISO 8601
    re.compile(r"()([+-]?\d{1,4}) days?,? ([+-]?)(\d{1,2}):([0-5]\d):([0-5]\d(?:[.,]\d{1,12})?)"),
    re.compile(r"(-?)(\d{1,4})\.()(\d\d):([0-5]\d):([0-5]\d(?:\.\d{1,12})?)"),
    re.compile(
        r"([+-]?)P(?!$|T$)(?:(\d{1,4})D)?()(?:T(?=\d)(?:(\d{1,6})H)?(?:(\d{1,7})M)?(?:(\d{1,9}(?:[.,]\d{1,12})?)S)?)?"
    ),
)
_DAY = 86_400_000_000_000  # ns
_LONGEST = 64  # letters of a time stamp
_LATEST = 9.2e9  # s, whose nanoseconds fit into 64 bits
_YEARS = 1678, 2261  # whose nanoseconds since 1970 fit into 64 bits
_EPOCH = datetime.date(1970, 1, 1).toordinal()
_ANEW = 0.9  # of all times a step back at least goes where a clock begins anew
_SOON = 10  # median steps, within which a counter goes on after it has overflowed
_MINUTE, _DAY_END = 40.0, 240_000  # by which 100 is after 60 in numbers such as 235959 of a time of day; their end


def overflowed(numbers: np.ndarray) -> tuple[np.ndarray, str, float]:
    """(T,) numbers of a clock of 16, 24 or 32 bits as if it never overflowed, what there is to say, and its period.

    Its ticks may have been turned into milliseconds or seconds, by thousands. Every step back by more than half of the
    range has to be an overflow; otherwise the numbers stay as they are. Smaller steps back stay.
    """
    steps = np.diff(numbers)
    on = steps[steps > 0]
    if on.size in (0, steps.size):
        return numbers, "", 0.0
    whole = (numbers == np.rint(numbers)).all()
    for bits in _COUNTERS if whole else (_COUNTERS[-1],):
        for tick in (1.0,) if whole else _TICKS:
            period = tick * 2.0**bits
            low, high = numbers.min(), numbers.max()
            within = high - low < period and (low >= 0 or max(-low, high) <= period / 2)
            back = steps[steps < -period / 2]
            if within and back.size and (back + period < _SOON * np.median(on)).all():
                said = f"overflows of a clock of {bits} bits that are unwrapped: {back.size}"
                return unwrapped(numbers, period), said, period
    return numbers, "", 0.0


def of_day(numbers: np.ndarray) -> tuple[np.ndarray, str]:
    """(T,) seconds of numbers of hours, minutes and seconds, such as 235959.5, and what there is to say.

    Each new minute, and one at least, has to show it by a jump; otherwise the numbers stay as they are.
    """
    if not (known := np.isfinite(numbers)).all():
        found = numbers.copy()
        found[known], note = of_day(numbers[known])
        return found, note
    whole = np.floor(numbers)
    minutes = whole // 100
    if not len(numbers) or numbers.min() < 0 or numbers.max() >= _DAY_END or (np.c_[whole, minutes] % 100 >= 60).any():
        return numbers, ""
    seconds = numbers - _MINUTE * minutes - 60 * _MINUTE * (whole // 10_000)
    seconds += 86_400.0 * np.concatenate([[0], np.cumsum(np.diff(seconds) < -43_200.0)])
    steps, new = np.diff(seconds), np.diff(minutes) != 0
    usual = float(np.median(np.abs(steps[~new]))) if not new.all() else _MINUTE
    if not new.any() or not 0 < _SOON * usual < _MINUTE or (np.abs(steps[new]) > _SOON * usual).any():
        return numbers, ""
    return seconds, f"times such as {whole[-1]:06.0f} are taken for hours, minutes and seconds"


def continued(time: np.ndarray) -> tuple[np.ndarray, str]:
    """(T,) times that go on by a median step where the clock was set back, and what there is to say."""
    steps = np.diff(time)
    back = steps < 0
    if not back.any():
        return time, ""
    step = np.median(steps[steps > 0]) if (steps > 0).any() else time[0] * 0
    mended = np.where(back, step, steps).astype(time.dtype)
    most = "s" if time.dtype.kind == "f" else "ns"
    note = f"steps back of its clock: {int(back.sum())}, by up to {-steps.min():g} {most}; later stamps go on"
    return np.concatenate([time[:1], time[0] + np.cumsum(mended)]), note


def chosen(time: np.ndarray, order: str, rows: np.ndarray | None = None) -> tuple[np.ndarray, str]:
    """Which of (T,) times to keep, and in which order, for stamps that increase strictly; and what there is to say.

    Args:
        order: one of ORDERS. "keep_first" leaves out what is not later than everything before it, "keep_last" what is
            not earlier than everything after it; "sort" sorts, and of equal stamps keeps the last.
        rows: (T,) where the samples are in the file, for the message.

    Raises:
        RecordingError: stamps do not increase, and nothing says what to do.
    """
    if not np.isfinite(time).all():
        raise RecordingError("time is not finite")
    steps = np.diff(time)
    if not (steps <= 0).any():
        return np.arange(len(time)), ""
    if order == "refuse":
        raise RecordingError(_complaint(time, steps, rows))
    if order == "sort":
        _, last = np.unique(time[::-1], return_index=True)
        kept = len(time) - 1 - last
    elif order == "keep_last":
        after = np.minimum.accumulate(time[::-1])[::-1]
        kept = np.flatnonzero(np.append(time[:-1] < after[1:], True))
    else:
        before = np.maximum.accumulate(time)
        kept = np.flatnonzero(np.append(True, time[1:] > before[:-1]))
    return kept, f"stamps that repeat or go back: {int((steps <= 0).sum())}; samples left out: {len(time) - len(kept)}"


def _complaint(time: np.ndarray, steps: np.ndarray, rows: np.ndarray | None) -> str:
    i = int(np.flatnonzero(steps <= 0)[0])
    place = f"row {i + 1}" if rows is None else f"line {rows[i + 1]}"
    same, back = int((steps == 0).sum()), int((steps < 0).sum())
    others = 'or "continue" (a clock that was set back goes on)' if back else "or leave the times out and write rate"
    if back and time.dtype.kind == "f" and (-steps[steps < 0] > _ANEW * np.ptp(time)).all():
        others += ", or period = ... if it begins anew at a number such as 60 or 65536"
    return (
        f"time does not increase in {place}: {time[i + 1]} follows {time[i]}; "
        f"stamps that repeat: {same}, that go back: {back}; "
        f'write [time] order = "keep_first", "keep_last" or "sort", {others}, or cut with begin and until'
    )


def is_stamp(text: str) -> bool:
    """Whether a text is a time of day, with or without a date, or a duration."""
    return _found(text.strip()) is not None or _duration(text.strip()) is not None


def holds_stamps(cells: Sequence[str]) -> bool:
    """Whether cells hold times of day, dates or durations; of digits only, in each of them."""
    return bool(cells) and (all(map(is_stamp, cells)) or any(is_stamp(c) and not _DIGITS.fullmatch(c) for c in cells))


def is_minutes(text: str) -> bool:
    """Whether a text is read as minutes and seconds, such as 02:15 or 02:15.250."""
    return _MINUTES.fullmatch(text.strip()) is not None


def _found(text: str) -> re.Match[str] | None:
    if len(text) > _LONGEST:
        return None
    if minutes := _MINUTES.fullmatch(text):
        text = f"0:{minutes[1]:0>2}:{minutes[2]}"
    if digits := _DIGITS.fullmatch(text):
        text = f"{digits[1]}T{digits[2]}.{digits[3] or digits[4] or 0}"
    return _STAMP.fullmatch(_COMPACT.sub(r"\1-\2-\3 \4:\5:\6", text))


def _duration(text: str) -> int | None:
    """Whole ns of a duration such as "0 days 00:00:01.25" or PT1.25S; None for another text."""
    found = next(filter(None, (form.fullmatch(text) for form in _DURATIONS)), None) if len(text) <= _LONGEST else None
    if not found:
        return None
    sign, days, inner, hours, minutes, seconds = found.groups("0")
    whole, _, fraction = seconds.replace(",", ".").partition(".")
    clock = (3600 * int(hours) + 60 * int(minutes) + int(whole)) * 1_000_000_000 + int(fraction.ljust(9, "0")[:9])
    total = int(days) * _DAY + (-clock if inner == "-" else clock)
    return -total if sign == "-" else total


class Stamps:
    """Reads dates and times such as 2024-06-27T10:11:02.5+02:00, 27.06.2024 10:11:02,5 or 10:11:02.5, and durations.

    Those without a zone are taken for UTC; with and without one do not mix.

    Args:
        order: one of DATE_ORDERS, of dates such as 06/07/2024; "" refuses them.
    """

    def __init__(self, order: str = "") -> None:
        self._order = order
        self._days: dict[str, int] = {}
        self._zoned: bool | None = None

    def __call__(self, text: str) -> int:
        """ns since 1970, since midnight where there is no date, or of a duration; RecordingError for anything else."""
        if (duration := _duration(text)) is not None:
            return duration
        if not (found := _found(text)):
            raise RecordingError(f"{ascii(text)[:40]} is no time such as 2024-06-27T10:11:02.5Z")
        date, hours, minutes, whole, fraction, half, zone = found.groups()
        if self._zoned is not None and self._zoned != bool(zone):
            raise RecordingError(f"{ascii(text)[:40]}: some times have a zone and some have none")
        self._zoned = bool(zone)
        hour = int(hours)
        if half:
            hour = hour % 12 + (12 if half.lower() == "pm" else 0)
        seconds = 3600 * hour + 60 * int(minutes) + int(whole or 0)
        if zone and zone[0] in "+-":
            seconds -= int(zone[0] + "1") * (3600 * int(zone[1:3]) + 60 * int(zone[3:].lstrip(":") or 0))
        return (self._day(date) if date else 0) + 1_000_000_000 * seconds + int((fraction or "0").ljust(9, "0")[:9])

    def _day(self, date: str) -> int:
        """ns from 1970 to the beginning of a day."""
        if date not in self._days:
            year, month, day = self._parts(date)
            if not _YEARS[0] <= year <= _YEARS[1]:
                raise RecordingError(f"{ascii(date)[:40]}: expected a year from {_YEARS[0]} to {_YEARS[1]}")
            try:
                self._days[date] = (datetime.date(year, month, day).toordinal() - _EPOCH) * _DAY
            except ValueError as error:
                raise RecordingError(f"{ascii(date)[:40]} is no date: {error}") from error
        return self._days[date]

    def _parts(self, date: str) -> tuple[int, int, int]:
        """Year, month and day."""
        if not (found := _DATE.fullmatch(date)):
            raise RecordingError(f"{ascii(date)[:40]} is no date; expected year-month-day, or day.month.year")
        if found[1]:
            return int(found[1]), int(found[2]), int(found[3])
        first, mark, second, year = found[4], found[5], found[6], int(found[7])
        month = _GERMAN.get(second.lower(), second.lower())
        if month in _MONTHS:
            return year, _MONTHS.index(month) + 1, int(first)
        if not second.isdecimal():
            raise RecordingError(f"{ascii(date)[:40]} is no date; months are {', '.join(_MONTHS)}, or numbers")
        if mark != "." and not self._order:
            raise RecordingError(f"{ascii(date)[:40]}: month or day first? write [time] date = "
                                 f"{' or '.join(map(repr, DATE_ORDERS))}")  # fmt: skip
        day_first = mark == "." or self._order == DATE_ORDERS[0]
        return (year, int(second), int(first)) if day_first else (year, int(first), int(second))


def over_midnight(time: np.ndarray) -> np.ndarray:
    """(T,) times of day [ns] that go on the next day."""
    if not len(time) or time.min() < 0 or time.max() >= _DAY:
        return time
    return time + _DAY * np.concatenate([[0], np.cumsum(np.diff(time) < -_DAY // 2)])


def together(parts: list[np.ndarray], factors: list[float]) -> np.ndarray:
    """(T,) whole ns of a time in several columns, such as seconds and nanoseconds."""
    total = np.zeros(len(parts[0]), np.int64)
    for part, factor in zip(parts, factors, strict=True):
        if (np.abs(part * factor) > _LATEST).any():
            raise RecordingError(f"time {part[np.abs(part * factor) > _LATEST][0]:g} is too late; are the units right?")
        whole = np.floor(part)
        total += whole.astype(np.int64) * round(1e9 * factor) + np.rint((part - whole) * factor * 1e9).astype(np.int64)
    return total
