"""The results of studies as a table."""

from collections import Counter
from collections.abc import Sequence

from soro_bench.markdown import table

# of every error the mean absolute one, the last point's rms, and that without its mean
_ERRORS = ("nominal", "parameters fitted", "patched")
_NAMES = ("robot, part", "data", *_ERRORS, "what is missing", "considered too", "noise")
_SHOWN = 0.01  # least probability of an answer


def results(summaries: Sequence[dict]) -> str:
    """Markdown: errors of training, held-out and unseen data, three kinds of each, of the nominal robot, with fitted
    parameters and with the best answer that has a name; answers with their probabilities."""
    rows = []
    for summary in summaries:
        best = summary["answers"][0]
        first, *others = _answers(summary)
        for key in summary["parameters"]:
            errors = [_three(each[key]) for each in (summary["nominal"], summary["parameters"], best)]
            words = ["", "", "", ""]
            if key == "train":
                noise = f"{summary['noise']:.2g} {summary['unit']}"
                words = [f"{summary['study']}, {summary['part']}{_known(summary)}", first, "; ".join(others), noise]
            rows.append([words[0], key, *errors, *words[1:]])
    return table(_NAMES, rows)


def _answers(summary: dict) -> list[str]:
    """Answers in words, the verdict's first; outside the catalogue is one of them."""
    nameless = f"outside the catalogue ({summary['unknown']:.2f})"
    named = [_named(a) for i, a in enumerate(summary["answers"]) if i == 0 or a["probability"] >= _SHOWN]
    return [nameless, *named] if summary["unknown"] > _likeliest(summary["answers"]) else [*named, nameless]


def _likeliest(answers: Sequence[dict]) -> float:
    """The probability of the likeliest effect, whatever comes with it, by which a verdict goes; or of none at all."""
    chances: Counter[str] = Counter()
    for answer in answers:
        for name in map(named, answer["effects"]) if answer["effects"] else ["nothing"]:
            chances[name] += answer["probability"]
    return max(chances.values())


def _three(found: dict) -> str:
    """Mean absolute error, rms of the last point, and that without its mean."""
    return " / ".join(f"{found[key]:.3g}" for key in ("mean_absolute", "rms", "rms_without_mean"))


def _named(answer: dict) -> str:
    """The effects of an answer with its probability."""
    return f"{' + '.join(map(named, answer['effects'])) or 'nothing'} ({answer['probability']:.2f})"


def _known(summary: dict) -> str:
    """The effects that were known before, in words."""
    known = " + ".join(map(named, summary["known"]))
    return f", with {known} known before" if known else ""


def named(effect: dict) -> str:
    """An effect of a summary and its location, in words."""
    location = effect.get("location") or effect["where"]  # as older summaries have it
    point = "" if location.get("index") is None else f"[{location['index']}]"
    return f"{effect['name']} at {location['name']}{point}"
