"""A scorecard for people."""

from soro_bench.markdown import table

_OF_AN_EFFECT = ("hidden", "cases", "first answer right", "among the first three", "place right")
_OF_A_CASE = (
    "case", "robot", "hidden", "verdict", "first three answers", "p", "unseen explained", "hidden by parameters",
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
        truth, said, hides = " + ".join(row["truth"]) or "none", ", ".join(row["said"]), row["concealed"]
        shares = ("" if share is None else f"{share:.2f}" for share in (row["probability"], row["fve_unseen"], hides))
        cases.append((row["id"], row["robot"], truth, row["verdict"], said, *shares))
    tables = (
        table(("gate", "cases", "value", "95 % interval", "bar", ""), gates),
        table(("hidden", "first answer", "cases"), confusion),
        table(_OF_AN_EFFECT, _by_effect(card["cases"])),
        table(("stated probability", "right", "cases"), calibration),
        table(_OF_A_CASE, cases),
    )
    return "\n\n".join(tables)


def _by_effect(rows) -> list[tuple]:
    """Of every concealed effect, alone or with another one: in how many of its cases the first answer and its place are
    right, and in how many the effect is among the first three; the worst first."""
    found = []
    for name in sorted({name for row in rows for name in row["truth"] or ["none"]}):
        own = [row for row in rows if name in (row["truth"] or ["none"])]
        right = [row for row in own if row["first"]]
        three = sum(name in row["said"] for row in own)
        places = "" if name == "none" else f"{sum(row['place'] for row in right)} of {len(right)}"
        found.append((name, len(own), len(right), three, places))
    return sorted(found, key=lambda each: (each[2] / each[1], each[3] / each[1]))
