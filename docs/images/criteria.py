"""Draws criteria.png: the acceptance criteria of the last release of the diagnosis.

python docs/images/criteria.py
"""

import runpy
from pathlib import Path

from soro_bench.plotting import pyplot

ROOT = Path(__file__).parents[2]
COLORS = {True: "tab:green", False: "tab:red"}


def panel(axes, criteria, called):
    """A dot per criterion with its 95 % interval, and the threshold, black."""
    for y, each in enumerate(reversed(criteria)):
        color = COLORS[each["met"]]
        axes.plot(each["interval"], [y, y], color=color, lw=1.5)
        axes.plot(each["value"], y, "o", color=color, ms=5)
        axes.plot([each["bar"]] * 2, [y - 0.35, y + 0.35], color="black", lw=1.5)
    axes.set_yticks(range(len(criteria)), [f"{called(each)} (of {each['cases']})" for each in reversed(criteria)])
    axes.grid(axis="x", alpha=0.3)


def main():
    script = runpy.run_path(str(ROOT / "benchmarks" / "final_sets.py"))
    release = script["releases"]()[-1]
    criteria = [each for each in script["scores"](release) if each["met"] is not None]
    shares = [each for each in criteria if each["bar"] <= 1]  # all but the time
    least, most = ([each for each in shares if each["below"] is below] for below in (False, True))
    figure, (upper, lower) = pyplot().subplots(
        2, 1, figsize=(9, 5.4), layout="constrained", sharex=True, height_ratios=(len(least), len(most))
    )
    panel(upper, least, script["called"])
    panel(lower, most, script["called"])
    upper.set_title(f"{script['name_of'](release)}; black: the least that is allowed")
    lower.set_title("black: the most that is allowed")
    lower.set_xlabel("share of the robots")
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=120)


if __name__ == "__main__":
    main()
