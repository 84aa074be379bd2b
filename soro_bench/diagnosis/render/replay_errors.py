"""What is said of errors of plain replays: a table, and warnings of what is not in it."""

import math

from soro_bench.diagnosis.render.words import Rows, change, error, listed, number
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_robot import ACCURATE

CORRECTED = 1.3  # ratio of plain to corrected errors from which the report warns
ROBOTS = {  # whose plain replays are shown
    "nominal": "model as built",
    "fitted": "fitted parameters",
    "patched": "with effects",
    "best": "best hypothesis",
    "accurate": "effects, accurate model",
}
BEYOND = "the variance beyond noise and discretisation error"


def plain_error(result: Result) -> float:
    """Of a plain replay with fitted parameters, of held-out recordings where there are any."""
    for each in result.robots:
        if each.name == "fitted":
            return each.train if each.heldout is None else each.heldout
    return (result.heldout or result.train).before  # results before replays were part of them


def replays(result: Result) -> Rows:
    """Errors of plain replays on the recordings fitted to and on held-out ones, a row for each robot; then what the
    covariance of discretisation error takes off the last one."""
    unit, both = result.robot.unit, [result.train, *([result.heldout] if result.heldout else [])]
    rows: Rows = []
    for each in filter(lambda robot: robot.name in ROBOTS, result.robots):
        name = "fitted, known effects" if each.name == "fitted" and each.effects else ROBOTS[each.name]
        if each.name == ACCURATE and not result.best.effects:
            rows.append((ROBOTS["patched"], "no effects", *[""] * (len(both) - 1)))
            name = "fitted, accurate model"
        values = [math.nan if value is None else value for value in (each.train, each.heldout)][: len(both)]
        rows.append((name, *(error(value, unit) for value in values)))
    if rows and not result.best.effects and not any(each.name == ACCURATE for each in result.robots):
        rows.append((ROBOTS["patched"], "no effects", *[""] * (len(both) - 1)))
    elif not rows:  # of an older version
        rows.append((ROBOTS["fitted"], *(error(each.before, unit) for each in both)))
        if result.best.effects:
            rows.append((ROBOTS["best"], *(error(each.after, unit) for each in both)))
    return [*rows, ("may be discretisation", *(_taken_off(each.after, each.corrected_after, unit) for each in both))]


def signals(result: Result) -> list[str]:
    """Errors of plain replays of every signal, where there are several, a sentence each."""
    found, what = [], f" by the {ROBOTS['best']}" if _of_best(result) else ""
    for each in result.signals:
        said = f"{each.name}: RMSE {change(each.before, each.after, each.unit)}"
        if each.heldout_before is not None and each.heldout_after is not None:
            said += f", held out {change(each.heldout_before, each.heldout_after, each.unit)}"
        found.append(f"{said}{what}; noise {number(each.noise, each.unit)}")
    return found


def _of_best(result: Result) -> bool:
    """Whether errors are of the best hypothesis, and the effects are others: a law that was found, or none."""
    return any(each.name == "best" for each in result.robots)


def _taken_off(plain: float, corrected: float, unit: str) -> str:
    """What the covariance of discretisation error takes off an error."""
    square = plain**2 - corrected**2
    if not math.isfinite(square):
        return ""
    return number(math.sqrt(square), unit) if square > 0 else "none"


def explained(result: Result) -> str:
    """What the effects explain beyond noise and discretisation error, in a sentence; empty without effects."""
    found, which = (result.heldout, "held-out") if result.heldout else (result.train, "fitted")
    if not result.best.effects or math.isnan(found.explained):
        return ""
    do = "add to" if found.is_worse else f"explain {100 * found.explained:.0f} % of"
    what = "the nearest laws of the catalogue" if result.verdict == "outside_catalogue" else "the effects"
    return f"On {which} recordings {what} {do} {BEYOND}."


def of_errors(result: Result) -> list[str]:
    """Where plain errors are not what the verdict is about, and where the effects make replays worse."""
    said, heldout, unit, far = [], result.heldout, result.robot.unit, []
    them = f"the {ROBOTS['best']}" if _of_best(result) else "the effects"
    if not result.robots:
        said.append("Of an older version: replays had half the model's time step, unlike those of soro-bench check.")
    for name, each in (("fitted", result.train), ("held-out", heldout)):
        pairs = [("with fitted parameters", each.before, each.corrected_before)] if each else []
        if each and result.best.effects:
            pairs.insert(0, (f"with {them}", each.after, each.corrected_after))
        large = [row for row in pairs if 0.0 < row[1] < math.inf and row[1] > CORRECTED * row[2]]
        far += [f"{_taken_off(error, left, unit)} of {number(error, unit)} {which} on {name} recordings"
                for which, error, left in large[:1]]  # fmt: skip
    if far:
        said.append(f"Discretisation error may be {listed(far)}. It is no evidence, and stays in every replay.")
    worse = heldout is None or heldout.after > heldout.before
    if result.patch.state == "rejected":
        off = "" if worse else ", discretisation error taken off"
        said.append(f"The patch is rejected: it makes held-out recordings worse{off}.")
    elif heldout and worse and result.best.effects:
        said.append(f"A plain replay of held-out recordings is worse with {them} than with fitted parameters alone.")
    return said


def worse(result: Result) -> str:
    """That replays are worse than those of the model as built, in a sentence; empty where none is."""
    found, unit = [], result.robot.unit
    for name in dict.fromkeys(each.robot for each in result.worse_replays):
        some = [each for each in result.worse_replays if each.robot == name]
        pairs = (f"{change(each.built, each.found, unit)} on {each.recordings} recordings" for each in some)
        found.append(f"{ROBOTS.get(name, name)} {listed(pairs)}")
    return f"Plain replays are worse than those of the model as built: {'; '.join(found)}." if found else ""


def alone(result: Result) -> str:
    """Errors of replays of the patched model alone, on the recordings fitted to and on held-out ones."""
    pairs = zip(("fitted", "held-out"), result.patch.replays, strict=False)
    return ", ".join(f"{change(each.built, each.patched, result.robot.unit)} on {name}" for name, each in pairs)
