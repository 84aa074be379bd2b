"""Cases of other simulators in a blind set: healthy robots of five kinds, and laws that are hidden in PyElastica's rod.

Users' robots are not simulated by the models that a diagnosis knows. Half of a set comes from here: half of that is
healthy, the kinds, their robots and the laws in turn. Nothing is simulated to draw a case.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from soro_bench.blind_benchmark.cases import NOISE
from soro_bench.blind_benchmark.draw import Case, draw_cases
from soro_bench.blind_benchmark.hidden import ALL
from soro_bench.blind_benchmark.report import released
from soro_bench.models import trunk
from soro_bench.recording.recording import Recording

SEED_BITS = 59  # as many as labels, which are read as strictly as files of strangers, may have digits for
KINDS = ("cable", "flex", "links", "pyelastica")  # of healthy trunks
SOROSIM, HIDDEN = "sorosim", "hidden"
MODEL, MAP = "model.xml", "map.toml"  # of robots that are none of the suite
LAWS = (  # as cosserat_laws.py has them; that needs PyElastica
    "payload", "friction", "weak cable", "delay", "soft neck", "tilt", "sensor shift", "play", "Dahl friction",
    "lateral drag", "lag", "neck hysteresis", "pretension",
)  # fmt: skip
_OF_SENSORS = ("sensor shift",)
_HEALTHY = 0.5  # share of these cases
_OF_HEALTHY = 5 / 7  # share of a set's healthy cases: of 200 they are 50, and a fifth of the others 20
_TRIES = 5  # simulations of a case, of which none diverges


@dataclass(frozen=True)
class OtherCase:
    """A case of another simulator before anything is simulated.

    Args:
        kind: of KINDS, SOROSIM or HIDDEN.
        turn: which of the kind's robots, releases or laws, counted round and round.
        seed: of everything that is drawn later.
    """

    id: str
    kind: str
    turn: int
    seed: tuple[int, int]

    @property
    def group(self) -> str:
        """As cases of the suite's models have it."""
        if self.kind != HIDDEN:
            return "none"
        return "measurement" if self.law in _OF_SENSORS else "one"

    @property
    def law(self) -> str:
        """What is hidden, if something is."""
        return LAWS[self.turn % len(LAWS)] if self.kind == HIDDEN else ""

    @property
    def needs_pyelastica(self) -> bool:
        """Whether it is simulated by that package."""
        return self.kind in ("pyelastica", HIDDEN)

    def number(self, among: int, tried: int = 0) -> int:
        """A seed of so many bits whose turn it is among some, another one after each failure."""
        found = int(np.random.SeedSequence((*self.seed, tried)).generate_state(1, np.uint64)[0]) >> (64 - SEED_BITS)
        return found - found % among + self.turn % among


AnyCase = Case | OtherCase


def draw_set(
    count: int, seed: int, healthy: int | None = None, others: int | None = None, sorosim: bool = False
) -> list[AnyCase]:
    """``count`` cases in random order.

    Args:
        healthy: how many have no effect; by default a fifth of the suite's models and half of the other simulators.
        others: how many are of other simulators; half by default.
        sorosim: whether its data is there.
    """
    others = count // 2 if others is None else others
    if not 0 <= others <= count:
        raise ValueError(f"others {others}: 0 to {count}, as many as there are cases, can be asked for")
    if not others:
        return list(draw_cases(count, seed, healthy))
    if healthy is not None and not 0 <= healthy <= count:
        raise ValueError(f"healthy {healthy}: 0 to {count}, as many as there are cases, can be asked for")
    own = count - others
    if healthy is None:
        of_others, of_own = round(_HEALTHY * others), None
    else:
        of_others = min(max(round(_OF_HEALTHY * healthy), healthy - own), others)
        of_own = healthy - of_others
    rng = np.random.default_rng([seed, others])
    found: list[AnyCase] = list(draw_cases(own, seed, of_own)) if own else []
    kinds = [*KINDS, *([SOROSIM] if sorosim else [])]
    names = [*np.resize(rng.permutation(kinds), of_others).tolist(), *[HIDDEN] * (others - of_others)]
    turns = {kind: int(rng.integers(1000)) for kind in (*kinds, HIDDEN)}
    for i, kind in enumerate(names):
        found.append(OtherCase("", kind, turns[kind], (seed, own + i)))
        turns[kind] += 1
    return [replace(found[k], id=f"case_{i:03d}") for i, k in enumerate(rng.permutation(count))]


def build_other(
    case: OtherCase, durations: Mapping[str, float], sorosim: Path | None = None
) -> tuple[dict[str, Recording], dict[str, str], dict]:
    """The recordings of a case by role, further files by name, and its label.

    Args:
        durations: s, by role.
        sorosim: folder with SoroSim's releases.csv.

    Raises:
        ValueError: all simulations diverged.
    """
    for tried in range(_TRIES):
        try:
            recordings, files, found = _built(case, durations, sorosim, tried)
            return recordings, files, _label(case, found)
        except ValueError as error:
            diverged = error
    raise ValueError(f"{case.kind} cannot be simulated: {diverged}") from diverged


def _built(
    case: OtherCase, durations: Mapping[str, float], folder: Path | None, tried: int
) -> tuple[dict[str, Recording], dict[str, str], dict]:
    """The same with the label that the simulator's own module writes."""
    from soro_bench.blind_benchmark import healthy, sorosim

    if case.kind == SOROSIM:
        if folder is None:
            raise FileNotFoundError("the cases have rods of SoroSim; give the folder of its releases")
        number = case.number(len(sorosim.releases(folder)), tried)
        files, recording, label = sorosim.build(folder, number)
        return {"train": recording}, files, label
    if case.kind == HIDDEN:
        from soro_bench.blind_benchmark import cosserat_laws  # needs a package that the others do not

        recordings, label = cosserat_laws.build(case.number(len(LAWS), tried), durations)
    else:
        number = case.number(len(healthy.ROBOTS[case.kind]), tried)
        recordings, label = healthy.build(case.kind, number, durations)
    return recordings, {}, label


def _label(case: OtherCase, found: dict) -> dict:
    """As those of the suite's models, with the kind of the robot."""
    units = {} if case.kind == SOROSIM else {each.name: each.unit for each in trunk.PARAMETERS}  # a rod has factors
    effects = [each | {"class": released(ALL[each["name"]][0]), "law": case.law} for each in found["effects"]]
    return {
        "id": case.id,
        "group": case.group,
        "kind": case.kind,
        "robot": found["robot"],
        "parameters": {
            name: {"value": value, "unit": units.get(name, "1")} for name, value in found["parameters"].items()
        },
        "effects": effects,
        "change_mm": {"train": 0.0, "heldout": 0.0, "task": 0.0} | found.get("change_mm", {}),
        "noise": {"value": NOISE, "unit": "m"},
        "seeds": {"case": found["seed"]},
    }
