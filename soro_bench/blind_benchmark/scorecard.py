"""A scorecard for people."""

from collections.abc import Sequence

from soro_bench.markdown import table

_OF_AN_EFFECT = (
    "hidden", "alone", "first answer right", "and its place", "with another effect", "among the first three",
)  # fmt: skip
_OF_A_CASE = (
    "case", "robot", "hidden", "verdict", "first three answers", "p", "unseen explained", "taken up by parameters",
)  # fmt: skip


def markdown(card: dict) -> str:
    """The scorecard as tables."""
    gates = []
    for gate in card["gates"]:
        bar = "" if gate["bar"] is None else f"{'<=' if gate['below'] else '>='} {gate['bar']:g}"
        value, interval, met = "", "", ""
        if gate["value"] is not None:
            value, interval = f"{gate['value']:.3g}", "{:.3g} .. {:.3g}".format(*gate["interval"])
            met = {True: "met", False: "MISSED", None: ""}[gate["met"]]
        gates.append((gate["gate"], gate["cases"], value, interval, bar, met))
    confusion = [(c["truth"], c["said"], c["cases"]) for c in card["confusion"]]
    calibration = [(f"{b['stated']:.2f}", f"{b['right']:.2f}", b["cases"]) for b in card["calibration"]]
    cases = []
    for row in card["cases"]:
        truth, said, hides = " + ".join(row["truth"]) or "none", ", ".join(row["said"]), row["absorbed"]
        shares = ("" if share is None else f"{share:.2f}" for share in (row["probability"], row["fve_unseen"], hides))
        cases.append((row["id"], row["robot"], truth, row["verdict"], said, *shares))
    tables = (
        table(("criterion", "cases", "value", "95 % interval", "threshold", ""), gates),
        table(("hidden", "first answer", "cases"), confusion),
        table(_OF_AN_EFFECT, _by_effect(card["cases"])),
        table(("stated probability", "right", "cases"), calibration),
        table(_OF_A_CASE, cases),
    )
    return "\n\n".join(tables)


def _by_effect(rows: Sequence[dict]) -> list[tuple]:
    """Of every hidden effect: in how many of the cases that have it alone the first answer and its place are right,
    and in how many that have another one too it is among the first three answers; the worst first."""
    found = []
    for name in sorted({name for row in rows for name in row["truth"] or ["none"]}):
        alone = [row for row in rows if (row["truth"] or ["none"]) == [name]]
        pairs = [row for row in rows if name in row["truth"] and len(row["truth"]) > 1]
        right = [row for row in alone if row["first"]]
        places = "" if name == "none" else sum(row["place"] for row in right)
        three = sum(name in row["said"] for row in pairs)
        missed = len(alone) - len(right) + len(pairs) - three
        found.append((-missed / (len(alone) + len(pairs)), name, len(alone), len(right), places, len(pairs), three))
    return [each[1:] for each in sorted(found)]
