"""Draws gates.png: the gates of the last final set of the diagnosis.

python docs/images/gates.py
"""

import runpy
from pathlib import Path

from soro_bench.plotting import pyplot

ROOT = Path(__file__).parents[2]
COLORS = {True: "tab:green", False: "tab:red"}


def panel(axes, gates):
    """A dot per gate with its 95 % interval, and the limit, black."""
    for y, gate in enumerate(reversed(gates)):
        color = COLORS[gate["met"]]
        axes.plot(gate["interval"], [y, y], color=color, lw=1.5)
        axes.plot(gate["value"], y, "o", color=color, ms=5)
        axes.plot([gate["bar"]] * 2, [y - 0.35, y + 0.35], color="black", lw=1.5)
    axes.set_yticks(range(len(gates)), [f"{gate['gate']} (of {gate['cases']})" for gate in reversed(gates)])
    axes.grid(axis="x", alpha=0.3)


def main():
    final_sets = runpy.run_path(str(ROOT / "benchmarks" / "final_sets.py"))
    release = final_sets["releases"]()[-1]
    gates = [gate for gate in final_sets["scores"](release) if gate["met"] is not None]
    shares = [gate for gate in gates if gate["bar"] <= 1]  # all but seconds
    least, most = ([gate for gate in shares if gate["below"] is below] for below in (False, True))
    figure, (upper, lower) = pyplot().subplots(
        2, 1, figsize=(9, 5.4), layout="constrained", sharex=True, height_ratios=(len(least), len(most))
    )
    panel(upper, least)
    panel(lower, most)
    upper.set_title(f"{final_sets['name_of'](release)}; black: the least that is allowed")
    lower.set_title("black: the most that is allowed")
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=120)


if __name__ == "__main__":
    main()
