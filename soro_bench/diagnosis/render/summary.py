"""The summary of a result for a console of 80 columns."""

import textwrap

from soro_bench.diagnosis.render import outside, replay_errors, sentences, words
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import Finding
from soro_bench.files import shown

WIDTH = 80
MENTIONED = 5  # laws in a list; report.html has all of them
USUAL = (  # in real robots, the most usual first
    "coulomb_friction", "backlash", "actuator_gain", "payload", "actuator_delay", "local_stiffness", "hysteresis",
    "viscous_friction", "pressure_leak", "sensor_bias", "sensor_delay",
)  # fmt: skip
_LABEL = 13  # columns of the labels
_NAME, _CELL = 22, 16  # columns of the table of errors


def summary(result: Result) -> str:
    """The answer first, then errors, law, location, magnitude, what else it may be, and what to record next."""
    unit = result.robot.unit
    lines = [sentences.headline(result) + _confidence(result), *_replays(result)]
    if result.outliers.share:
        share, size = 100 * result.outliers.share, words.number(result.outliers.size, unit)
        lines.append(line("outliers", f"{share:.2g} % of the points are {size} off (rms); left out"))
    lines += [line("data", each) for each in sentences.data(result)]
    for each in sentences.best_findings(result):
        lines += _finding(each, nearest=result.verdict == "outside_catalogue")
    if result.verdict == "outside_catalogue":
        lines += [line("" if i else outside.label(result), each) for i, each in enumerate(outside.described(result))]
        if found := result.discovery:
            lines += [line("", f"{each.name} = {words.estimate(each)}") for each in found.estimates]
        lines += [line("", each) for each in outside.discovered(result)]
        lines.append(line("location", outside.where(result)))
        if unconstrained := outside.unconstrained(result):
            lines.append(line("", unconstrained))
    lines += [line("" if i else "recordings", each) for i, each in enumerate(sentences.disagreement(result))]
    if known := sentences.known(result):
        lines.append(line("known", known))
    if not result.best.effects and result.verdict not in ("outside_catalogue", "undecided"):
        lines += _detectable(result)
    if also := sentences.alternatives(result):
        lines.append(line("or", "; ".join(also)))
    if seeds := sentences.seeds(result):
        lines.append(line("seeds", seeds))
    if kind := sentences.kind(result):
        lines.append(line("kind", kind))
    lines += [line("model", each) for each in sentences.patched_model(result)]
    lines += [line("" if i else "limits", each) for i, each in enumerate(sentences.limits(result))]
    lines += [line("note", each) for each in sentences.warnings(result)]
    if then := sentences.next_recording(result):
        lines.append(line("record next", then))
    return "\n".join(lines)


def _replays(result: Result) -> list[str]:
    """A table of plain replay errors, and what they rest on."""
    head = ("RMSE", "fitted to", *(["held out"] if result.heldout else []))
    lines = []
    for i, (name, *cells) in enumerate([head, *replay_errors.replays(result)]):
        row = "".join(f"{cell.replace(words.NO_BREAK, ' '):>{_CELL}}" for cell in cells)
        lines.append(f"  {'' if i else 'plain replay':<{_LABEL}}{name:<{_NAME}}{row}".rstrip())
    if worse := replay_errors.worse(result):
        lines.append(line("warning", worse))
    lines.append(line("noise", words.number(result.train.noise, result.robot.unit)))
    lines += [line("" if i else "signals", each) for i, each in enumerate(replay_errors.signals(result))]
    return lines + ([line("", said)] if (said := replay_errors.explained(result)) else [])


def _confidence(result: Result) -> str:
    if result.verdict == "adequate":
        return f" (probability {words.probability(result.healthy)})."
    if result.verdict == "outside_catalogue":
        return f" (probability {words.probability(result.unknown)})."
    found = sentences.best_findings(result)
    return f" (probability {words.probability(found[0].probability)})." if found else "."


def _finding(found: Finding, nearest: bool) -> list[str]:
    name = words.law(found.name)
    lines = [line("nearest law" if nearest else "law", f"{name} ({words.category(found.category)})")]
    if found.location is not None and not nearest:
        lines.append(line("location", str(found.location)))
    for each in found.estimates:
        lines.append(line("", f"{words.law(each.name)} {words.estimate(each)}"))
    if found.condition:
        lines.append(line("", found.condition))
    return lines


def _detectable(result: Result) -> list[str]:
    lines = []
    if result.detectable:
        least = {each.name: f"{words.law(each.name)} {words.detectable(each)}" for each in result.detectable}
        lines.append(line("detectable", f"at least {_some(least)}"))
    if result.undetectable:
        lines.append(line("invisible", f"in these recordings: {_laws(result.undetectable)}"))
    if result.not_searched:
        lines.append(line("not searched", f"no location in this robot: {_laws(result.not_searched)}"))
    return lines


def _laws(names: tuple[str, ...]) -> str:
    return _some({name: words.law(name) for name in names})


def _some(texts: dict[str, str]) -> str:
    """The most usual laws of some, and how many more there are."""
    order = sorted(texts, key=lambda name: (USUAL.index(name) if name in USUAL else len(USUAL), name))
    more = len(order) - MENTIONED
    said = ", ".join(texts[name] for name in order[:MENTIONED])
    return f"{said}; {more} more in report.html" if more > 0 else said


def line(label: str, text: str) -> str:
    """A labelled text, filled to the width of a console."""
    indent = " " * (_LABEL + 2)
    text = words.NO_BREAK.join(map(shown, text.split(words.NO_BREAK)))
    filled = textwrap.fill(text, WIDTH, initial_indent=indent, subsequent_indent=indent)
    filled = filled.replace(words.NO_BREAK, " ")
    return f"  {label:<{_LABEL}}{filled[_LABEL + 2 :]}" if label else filled
