"""What is shown of paired recordings: the summary on the console, report.html and paired.json."""

import math
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np

from soro_bench.diagnosis.paired.result import Change, Explanation, PairedResult, SignalDifference
from soro_bench.diagnosis.render import words
from soro_bench.diagnosis.render.figures import MM, image
from soro_bench.diagnosis.render.html import TEMPLATES, Table
from soro_bench.diagnosis.render.summary import WIDTH, line
from soro_bench.diagnosis.result_parts import Estimate
from soro_bench.files import replacing
from soro_bench.plotting import pyplot

FILES = ("report.html", "paired.json")
_POINTS = 3  # that are named on the console
_SHOWN = 0.01  # probability of a change that is listed on the console
_LISTED = 3  # changes that are listed whatever their probability
_TABLE = 19  # columns before the names of changes
_VERDICTS = {
    "same": "The same: no difference beyond noise",
    "differs": "Different: beyond noise, without a steady pattern; two runs of one robot may differ so",
    "changed": "Changed: a steady difference",
}


def render(result: PairedResult, folder: str | Path) -> str:
    """Write the files of a result into a folder, and return its summary for a console of 80 columns."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "paired.json").unlink(missing_ok=True)  # of an earlier comparison
    with replacing(folder / "report.html") as temporary:
        temporary.write_text(html(result), encoding="utf-8")
    result.save(folder / "paired.json")
    return summary(result)


def main_signal(result: PairedResult) -> SignalDifference:
    """The signal that a model explains, or the one with the largest difference against its noise."""
    if result.explanation is not None:
        return next(each for each in result.signals if each.name == result.explanation.signal)
    return max(result.signals, key=lambda each: (each.verdict == "changed", each.rms / max(each.noise, 1e-300)))


def headline(result: PairedResult) -> str:
    """The answer in one line."""
    found, main = result.explanation, main_signal(result)
    if found is None or not found.changes:
        return f"{_VERDICTS[main.verdict]} in {main.name}"
    return f"Changed: {' and '.join(map(label, found.changes))}"


def label(change: Change) -> str:
    """A change in words: what, where and how much."""
    where = f" at {change.location}" if change.location else ""
    name = words.law(change.name)
    what = change.kind if name == change.kind else f"{change.kind} ({name})"
    return f"{what}{where}, {size(change)}"


def size(change: Change) -> str:
    """How large a change is: its first quantity, and for a law that is gone the sign says so."""
    first = change.estimates[0]
    text = measure(first)
    named = "" if first.name in ("mass", "factor", "added") else f"{words.law(first.name)} "
    gone = " (before, not after)" if change.removed else ""
    return f"{named or ('factor ' if first.name == 'factor' else '')}{text}{gone}"


def measure(found: Estimate) -> str:
    """A value with its unit and interval; masses in grams, short times in ms."""
    for unit, shown in (("kg", "g"), ("s", "ms")):
        if found.unit == unit and abs(found.value) < 1.0:
            low, high = (None if each is None else MM * each for each in (found.low, found.high))
            return words.estimate(replace(found, value=MM * found.value, unit=shown, low=low, high=high))
    return words.estimate(found)


def summary(result: PairedResult) -> str:
    """The answer first, then the commands, the measured difference, and what explains it."""
    lines = [headline(result) + "."]
    lines += [line("commands", _commands(result))]
    main = main_signal(result)
    for each in sorted(result.signals, key=lambda s: s is not main):
        lines.append(line("difference", f"{each.name}: {_difference(each)}"))
    lines.append(line("points", _points(main)))
    if main.looks_like:
        lines.append(line("looks like", _looks_like(main)))
    lines += [line("start", each) for each in _starts(main)]
    if result.explanation is None:
        lines.append(line("cause", "needs a model: --model ROBOT.xml --map MAP.toml, or --env ENV"))
    else:
        lines += _explained(result.explanation)
    return "\n".join([*lines, *(line("note", each) for each in _notes(result))])


def _commands(result: PairedResult) -> str:
    worst = max(result.commands, key=lambda each: each.rms)
    parts = [f"the same within {100 * worst.rms:.2g} % of their range (rms; largest {100 * worst.largest:.2g} %)"]
    shifts = [each.shift for each in result.commands]
    if any(shifts):
        parts.append(f"clocks {', '.join(f'{each:.4g}' for each in shifts)} s apart, which is taken out")
    parts.append(f"{sum(each.overlap for each in result.commands):.4g} s compared")
    return "; ".join(parts)


def _difference(found: SignalDifference) -> str:
    noise = words.number(found.noise, found.unit, 2)
    runs = " (between runs of the same robot)" if found.run_to_run and found.run_to_run >= found.noise else ""
    rms, chance = words.number(found.rms, found.unit), words.chance(found.p_value)
    return f"{rms} rms of a coordinate, {noise} by noise{runs}; an offset, gain or delay: {chance}"


def _points(found: SignalDifference) -> str:
    order = sorted((each for each in found.points if math.isfinite(each.rms)), key=lambda each: -each.rms)
    texts = []
    for each in order[:_POINTS]:
        mean = ", ".join(words.number(value, found.unit, 2).split(words.NO_BREAK)[0] for value in each.mean)
        texts.append(f"{each.index} by {words.number(each.rms, found.unit)} rms, mean ({mean})")
    more = len(order) - _POINTS
    lost = [str(each.index) for each in found.points if each.present < 0.5]
    gone = f"; lost in one recording for most of the time: {', '.join(lost)}" if lost else ""
    return "; ".join(texts) + (f"; {more} more in report.html" if more > 0 else "") + gone


def _looks_like(found: SignalDifference) -> str:
    offset, amplitude, delay = found.looks_like
    parts = [f"a constant offset of {measure(offset.estimate)} rms ({100 * offset.explained:.0f} % of it)"]
    if math.isfinite(amplitude.estimate.value):
        parts.append(
            f"beside it {100 * amplitude.estimate.value:+.2g} % of the motion and {measure(delay.estimate)} of delay "
            f"({100 * delay.explained:.0f} %)"
        )
    return "; ".join(parts)


def _starts(found: SignalDifference) -> list[str]:
    return [
        f"initial states differ by {words.number(each.distance, found.unit)} at point {each.point}, "
        f"{each.deviations:.3g} times the noise"
        for each in found.starts
        if each.differs
    ]


def _explained(found: Explanation) -> list[str]:
    lines = [
        line("model", f"explains {100 * found.explained:.0f} % of the difference, of {found.signal} "
                      f"{words.change(found.before, found.after, found.unit)} rms; its own error of "
                      f"{words.number(found.replay, found.unit)} is in both recordings"),
        "",
        "  prob.  explains  change, size [90 %]",
    ]  # fmt: skip
    for number, (name, text, probability, share) in enumerate(candidates(found)):
        if number < _LISTED or float(probability) >= _SHOWN:
            what = f"{name}, {text}" if text else name
            filled = textwrap.wrap(what, WIDTH - _TABLE)
            lines.append(f"  {probability:>5}{share:>10}  {filled[0]}")
            lines += [" " * (_TABLE + 2) + each for each in filled[1:]]
    return [*lines, ""]


def candidates(found: Explanation) -> words.Rows:
    """Change, size, probability and share of the difference, of every candidate, nothing and unknown."""
    rows: words.Rows = []
    together = found.changes if len(found.changes) > 1 else ()
    for each in together:
        rows.append((f"with others: {_short(each)}", size(each).replace(words.NO_BREAK, " "),
                     words.probability(each.probability), f"{100 * found.explained:.0f} %"))  # fmt: skip
    for each in found.candidates:
        share = f"{100 * max(each.explained, 0.0):.0f} %"
        rows.append((_short(each), size(each).replace(words.NO_BREAK, " "), words.probability(each.probability), share))
    rows.append(("nothing", "", words.probability(found.nothing), ""))
    rows.append(("another change", "", words.probability(found.unknown), ""))
    return rows


def _short(change: Change) -> str:
    """What and where, without the size."""
    name = words.law(change.name)
    return f"{change.kind}: {name}" + (f" at {change.location}" if change.location else "")


def _notes(result: PairedResult) -> tuple[str, ...]:
    return (*result.notes, *(result.explanation.notes if result.explanation else ()))


def html(result: PairedResult) -> str:
    """The report as HTML."""
    main = main_signal(result)
    facts = [("commands", _commands(result))]
    facts += [(each.name, _difference(each)) for each in result.signals]
    facts += [("looks like", _looks_like(main))] if main.looks_like else []
    facts += [("start", each) for each in _starts(main)]
    if (found := result.explanation) is not None:
        facts.append(("model", f"explains {100 * found.explained:.0f} % of the difference: "
                               f"{words.change(found.before, found.after, found.unit)} rms"))  # fmt: skip
    return TEMPLATES.get_template("paired.html").render(
        headline=headline(result),
        tone="good" if main.verdict == "same" else "bad",
        facts=[(name, text.replace("->", "→")) for name, text in facts],
        notes=_notes(result),
        picture=over_time(main),
        signal=main.name,
        tables=_tables(result, main),
    )


def _tables(result: PairedResult, main: SignalDifference) -> list[Table]:
    rows: words.Rows = [
        (
            str(each.index),
            words.number(each.rms, main.unit),
            ", ".join(words.number(value, main.unit) for value in each.mean),
            words.number(each.largest, main.unit),
            f"{each.times_noise:.3g}",
            f"{100 * each.present:.0f} %",
        )
        for each in main.points
    ]
    points = Table(f"Points of {main.name}", ("point", "rms", "mean", "largest", "times noise", "in both"), rows)
    if result.explanation is None:
        return [points]
    head = ("change", "size [90 %]", "probability", "explains")
    estimates: words.Rows = [
        (_short(each), words.law(one.name), measure(one))
        for each in result.explanation.changes
        for one in each.estimates
    ]
    sizes = Table("The change in numbers", ("change", "quantity", "value [90 %]"), estimates)
    return [Table("What may have changed", head, candidates(result.explanation)), sizes, points]


def over_time(found: SignalDifference) -> str:
    """The difference of every point over time, and the noise; base64 PNG."""
    time, rms = np.array(found.profile.time), np.array(found.profile.rms)
    scale, unit = words.shown_unit(found.unit)
    figure, ax = pyplot().subplots(figsize=(6.5, 2.6), layout="constrained")
    shown = sorted(range(rms.shape[1]), key=lambda i: -np.nan_to_num(found.points[i].rms))[:6]
    for i in sorted(shown):
        ax.plot(time, scale * rms[:, i], lw=1.2, label=f"point {i}")
    ax.axhline(scale * found.noise, color="0.5", lw=1, ls="--", label="noise")
    ax.set(xlabel="time [s]", ylabel=f"difference [{unit}]")
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(fontsize=8, frameon=False, ncols=2)
    return image(figure)
