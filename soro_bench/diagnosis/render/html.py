"""report.html: the answer within ten seconds, and below it what it rests on."""

from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, select_autoescape
from latex2mathml.converter import convert
from markupsafe import Markup, escape

from soro_bench.diagnosis.render import figures, outside, replay_errors, sentences, words
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import Finding
from soro_bench.effects.equations import EQUATIONS
from soro_bench.files import replacing

RANKED = 10  # effects of the table

TEMPLATES = Environment(
    loader=PackageLoader("soro_bench.diagnosis.render"), autoescape=select_autoescape(), trim_blocks=True,
    lstrip_blocks=True,
)  # fmt: skip


@dataclass(frozen=True)
class Figure:
    """A picture with its heading and caption; ``image`` is base64 PNG."""

    title: str
    caption: str
    image: str


@dataclass(frozen=True)
class Table:
    """A table with its heading."""

    title: str
    head: tuple[str, ...]
    rows: words.Rows


def write_html(result: Result, path: str | Path) -> None:
    """Write the report: one file, pictures inside, readable on a phone and in print."""
    with replacing(path) as temporary:
        temporary.write_text(html(result), encoding="utf-8")


def html(result: Result) -> str:
    """The report as HTML."""
    return TEMPLATES.get_template("report.html").render(
        result=result,
        outside=outside,
        replay_errors=replay_errors,
        sentences=sentences,
        words=words,
        tone="good" if sentences.headline(result).startswith("Adequate") else "bad",
        laws=[(each, equation(each.name)) for each in sentences.best_findings(result)],
        picture=figures.robot(result),
        marked=figures.marked(result),
        points=any(each.kind == "sensor" for shape in result.shapes for each in shape.locations),
        figures=[each for each in _figures(result) if each.image],
        tables=[each for each in _tables(result) if each.rows],
    )


def equation(name: str) -> Markup:
    """The equation of a law as MathML, with what its parameters' symbols stand for; empty for what has none."""
    if name not in EQUATIONS:
        return Markup("")
    found = EQUATIONS[name]
    symbols = {**{latex: words.law(each) for each, latex in found.symbols.items()}, **found.other}
    legend = ", ".join(f"{convert(latex)} {escape(text)}" for latex, text in symbols.items())
    return Markup(f"{convert(found.latex)}<br><small>{legend}</small>")


def _figures(result: Result) -> list[Figure]:
    which = " The first recording." if result.trained_on > 1 else ""
    found = [
        Figure("Where and when", "Error of a plain replay with fitted parameters." + which, figures.error(result)),
        Figure(
            "Before and after",
            "Measured less simulated at the point with the largest error. The band is two standard deviations of the "
            f"noise.{which}",
            figures.before_and_after(result),
        ),
    ]
    if result.best.effects:
        caption = "Evidence that the best hypothesis gains in every second." + which
        found.append(Figure("When the law acts", caption, figures.gain(result)))
    if curve := result.curve:
        caption = (
            f"Lines: the fitted law at {curve.effect.location}, which they describe to {100 * curve.share:.0f} %. "
            "Points: the force that the recordings ask for, to first order, with 90 % intervals. Points beside the "
            "lines speak for another law."
        )
        found.append(Figure(f"Force against state: {words.law(curve.effect.name)}", caption, figures.law_curve(result)))
    if (law := result.discovery) and law.effects:
        label = outside.label(result)
        caption = f"Points: the input that explains most, free in time. Red: the {label}, {'; '.join(law.equations)}."
        found.append(
            Figure(f"Force against state: a {label} outside the catalogue", caption, figures.discovered(result))
        )
    if unknown := result.unknown_input:
        form = "linear in commands and shape" if unknown.linear_in else "free in time"
        caption = f"The input at {unknown.location} that explains most, {form}.{which}"
        found.append(Figure("Unknown input", caption, figures.unknown_input(result)))
    return found


def _tables(result: Result) -> list[Table]:
    return [
        Table("Candidates", ("probability", "law", "location", "magnitudes", "drawbacks"), _candidates(result)),
        Table("Parameters", ("parameter", "value [90 %]", "nominal", "prior sd"), _parameters(result)),
        Table("Recordings one by one", ("quantity", "values [90 %]", "agreement"), _agreement(result)),
        Table("Limits in the replay", ("limit", "element", "value", "share of the time"), _limits(result)),
        Table("Selection", ("on top of", "predicted gain [nats]", "misfit after the fit [nats]"), _rounds(result)),
        Table("Smallest detectable magnitudes", ("law", "quantity", "magnitude"), _detectable(result)),
    ]


def _candidates(result: Result) -> words.Rows:
    return [_candidate(each, result) for each in result.findings if each.name not in ("none",)][:RANKED]


def _candidate(found: Finding, result: Result) -> tuple[str, ...]:
    name = outside.unnamed(result) if found.name == "unknown" else words.law(found.name)
    magnitudes = "; ".join(f"{words.law(each.name)} {words.estimate(each)}" for each in found.estimates)
    location = str(found.location) if found.location else ""
    return words.probability(found.probability), name, location, magnitudes, words.plain("; ".join(found.drawbacks))


def _parameters(result: Result) -> words.Rows:
    return [
        (
            words.law(each.estimate.name),
            words.parameter(each),
            words.number(each.nominal, each.estimate.unit),
            "" if each.known else f"{each.prior_deviations:+.1f}",
        )
        for each in result.parameters
    ]


def _limits(result: Result) -> words.Rows:
    return [
        (
            words.law(each.name),
            each.element,
            "" if each.value is None else words.number(each.value, each.unit),
            f"{100 * each.share:.0f} %",
        )
        for each in result.limits
    ]


def _agreement(result: Result) -> words.Rows:
    return [(words.quantity(each), words.each_recording(each), words.agreement(each)) for each in result.agreement]


def _rounds(result: Result) -> words.Rows:
    return [
        (
            words.terms(each.on_top_of) or "fitted parameters",
            "; ".join(f"{words.terms((one.term,))} {one.predicted_gain:.0f}" for one in each.screened),
            "; ".join(f"{words.terms(one.terms)} {one.misfit:.0f}" for one in each.fitted),
        )
        for each in result.rounds
    ]


def _detectable(result: Result) -> words.Rows:
    rows: words.Rows = [
        (
            words.law(each.name),
            words.law(each.quantity),
            words.detectable(each),
        )
        for each in result.detectable
    ]
    rows += [(words.law(name), "", "not visible in these recordings") for name in result.undetectable]
    return rows + [(words.law(name), "", "not searched: no location in this robot") for name in result.not_searched]
