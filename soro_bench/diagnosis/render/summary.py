"""The summary of a result for a console of 80 columns."""

import textwrap

from soro_bench.diagnosis.render import words
from soro_bench.diagnosis.result import Finding, Result

WIDTH = 80
_LABEL = 13  # columns of the labels


def summary(result: Result) -> str:
    """The answer first, then law, location, magnitude, errors, what else it may be, and what to record next."""
    unit = result.robot.unit
    lines = [words.headline(result) + _confidence(result)]
    if result.outliers.share:
        share, size = 100 * result.outliers.share, words.number(result.outliers.size, unit)
        lines.append(_line("outliers", f"{share:.2g} % of the points are {size} off (rms); left out"))
    for each in words.best_findings(result):
        lines += _finding(each, nearest=result.verdict == "outside_catalogue")
    if result.verdict == "outside_catalogue":
        lines.append(_line("location", words.where(result)))
        if (found := result.unknown_input) is not None:
            left = words.change(result.train.corrected_before, found.rmse_after, unit)
            lines.append(_line("input", f"an unconstrained input there would reduce the RMSE, {left}"))
    lines.append(_line("noise", words.number(result.train.noise, unit)))
    if result.best.effects:
        lines.append(_line("replay", f"RMSE {words.errors(result.train, unit)}"))
        if result.heldout:
            lines.append(_line("held out", f"RMSE {words.errors(result.heldout, unit)}"))
        lines.append(_line("corrected", f"{words.corrected(result.train, unit)} (without discretisation error)"))
        if result.heldout:
            lines.append(_line("", f"{words.corrected(result.heldout, unit)} (held out)"))
    else:
        lines.append(_line("replay", f"RMSE {words.number(result.train.after, unit)}"))
        if result.heldout:
            lines.append(_line("held out", f"RMSE {words.number(result.heldout.after, unit)}"))
    if not result.best.effects and result.verdict != "outside_catalogue":
        lines += _detectable(result)
    if also := words.alternatives(result):
        lines.append(_line("or", "; ".join(also)))
    lines += [_line("note", each) for each in words.warnings(result)]
    if then := words.next_recording(result):
        lines.append(_line("record next", then))
    return "\n".join(lines)


def _confidence(result: Result) -> str:
    if result.verdict == "adequate":
        return f" ({words.p_value(result)})." if result.p_value is not None else "."
    if result.verdict == "outside_catalogue":
        return f" (probability {words.probability(result.unknown)})."
    found = words.best_findings(result)
    return f" (probability {words.probability(found[0].probability)})." if found else "."


def _finding(found: Finding, nearest: bool) -> list[str]:
    name = words.law(found.name)
    lines = [_line("nearest law" if nearest else "law", f"{name} ({words.law(found.category)})")]
    if found.location is not None and not nearest:
        lines.append(_line("location", str(found.location)))
    for each in found.estimates:
        lines.append(_line("", f"{words.law(each.name)} {words.estimate(each)}"))
    if found.condition:
        lines.append(_line("", found.condition))
    return lines


def _detectable(result: Result) -> list[str]:
    lines = []
    if result.detectable:
        shown = [f"{words.law(each.name)} {words.number(each.minimum, each.unit, 2)}" for each in result.detectable]
        lines.append(_line("detectable", f"smallest detectable magnitudes: {', '.join(shown)}"))
    if result.undetectable:
        lines.append(_line("hidden", f"not visible in these recordings: {_laws(result.undetectable)}"))
    if result.not_searched:
        lines.append(_line("not searched", f"no location in this robot: {_laws(result.not_searched)}"))
    return lines


def _laws(names: tuple[str, ...]) -> str:
    return ", ".join(map(words.law, names))


def _line(label: str, text: str) -> str:
    indent = " " * (_LABEL + 2)
    filled = textwrap.fill(text, WIDTH, initial_indent=indent, subsequent_indent=indent, break_long_words=False)
    return f"  {label:<{_LABEL}}{filled[_LABEL + 2 :]}" if label else filled
