"""Laws that are data, made to break something: each has to be refused in one line or to do no harm.

    python benchmarks/hostile_laws.py 10000

Prints how many were refused and how many were simulated. A failure, such as a step that takes long, ends it with the
law that caused it.
"""

import argparse
import json
import math
import time
from typing import Any

import mujoco
import numpy as np

from soro_bench.effects.catalogue import ALL
from soro_bench.effects.custom_law import AXES, KINDS, MEMORIES, READS
from soro_bench.effects.effect import EffectError, effect_from
from soro_bench.effects.elements import instrument
from soro_bench.effects.expression import FUNCTIONS
from soro_bench.models.simulation import Simulation, quiet
from soro_bench.parameters import ParameterSet

ARM = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="a"><joint name="one" axis="0 1 0" damping="0.01"/><geom type="capsule" size="0.01" fromto="0 0 0 0.2 0 0"
 mass="0.1" contype="0" conaffinity="0"/><site name="s" pos="0.2 0 0"/></body><site name="t" pos="0.2 0 0.2"/>
</worldbody><tendon><spatial name="cable"><site site="s"/><site site="t"/></spatial></tendon>
<actuator><position name="motor" joint="one" kp="2" ctrlrange="-1 1"/></actuator></mujoco>"""
STEPS, SECONDS = 20, 0.005  # of processor time, that a step may take on average
_ODD: tuple[Any, ...] = (
    None, True, "", "q", "__class__", "q.__class__", "eval('1')", "\u0000", "x" * 10_000, [], {}, [[]], -1, 0, 1e-300,
    1e9, -1e9, 1e10, 1e308, 10**400, math.nan, math.inf, -math.inf, ["exp", ["exp", ["exp", 1e9]]], ["power", 0, -6],
    ["sign", 0, 0], ["os.system", "ls"], ["lambda", "q"], [["add"], 1, 2],
)  # fmt: skip
_NAMES = {"joint": "one", "tendon": "cable", "body": "a", "actuator": "motor", "model": "gravity"}


def hostile(rng: np.random.Generator) -> dict[str, Any]:
    """An effect, mostly of the right form, with odd things in it."""
    kind = str(rng.choice(KINDS))
    variables = {name: _variable(rng) for name in ("q", "v", "w")[: rng.integers(4)]}
    states = {name: _state(rng, list(variables)) for name in ("y", "z")[: rng.integers(3)]}
    law: dict[str, Any] = {
        "unit": "N", "limit": float(10.0 ** rng.uniform(-3, 6)), "variables": variables, "states": states,
        "expression": _tree(rng, [*variables, *states, "k"], 1), "units": {"k": "1"},
    }  # fmt: skip
    if kind in ("body", "model"):
        law["direction"] = str(rng.choice(AXES)) if rng.random() < 0.7 else [0.0, "k", 1e9]
    if rng.random() < 0.25:
        law[str(rng.choice([*law, "code"]))] = _odd(rng)
    parameters = {"k": _number(rng)}
    name = _NAMES[kind] if rng.random() < 0.95 else "*"
    return {"name": "custom", "location": {"kind": kind, "name": name}, "parameters": parameters, "law": law}


def outcome(effect: dict[str, Any]) -> str:
    """ "refused" or "harmless": simulated, with finite numbers and in time."""
    try:
        text = json.dumps(effect)
        read = effect_from(json.loads(text), ALL)
        sim = Simulation(instrument(mujoco.MjSpec.from_string(ARM)).compile(), ParameterSet(), (), 2, 1, [read])
    except EffectError as error:
        assert "\n" not in str(error) and len(str(error)) < 1000, "an error in one line"
        return "refused"
    except ValueError as error:
        assert "digits" in str(error), error  # of Python's own reader of numbers
        return "refused"
    ids = np.arange(2)
    sim.batch.reset(ids)
    sim.begin(ids)
    start = time.process_time()
    with quiet():
        for _ in range(STEPS):
            sim.step(ids, 1)
            assert np.isfinite(sim.batch.qpos).all() and np.isfinite(sim.batch.qfrc_applied).all(), "finite numbers"
    assert time.process_time() - start < STEPS * SECONDS, "steps take too long"
    return "harmless"


def _odd(rng: np.random.Generator) -> Any:
    return _ODD[rng.integers(len(_ODD))]


def _number(rng: np.random.Generator) -> Any:
    return float(rng.normal() * 10.0 ** rng.uniform(-9, 9)) if rng.random() < 0.95 else _odd(rng)


def _variable(rng: np.random.Generator) -> Any:
    of = str(rng.choice(list(READS)))
    found: dict[str, Any] = {"of": of, "range": sorted([_range(rng), _range(rng)])}
    if READS[of] and rng.random() < 0.7:
        kind = str(rng.choice(READS[of]))
        found["location"] = {"kind": kind, "name": _NAMES[kind]}
        if kind == "body" and of != "distance":
            found["axis"] = str(rng.choice(AXES))
    if of == "distance":
        found["point"] = [0.0, 0.0, float(rng.normal())]
    if rng.random() < 0.03:
        found[str(rng.choice([*found, "extra"]))] = _odd(rng)
    return found


def _range(rng: np.random.Generator) -> float:
    return float(rng.normal() * 10.0 ** rng.uniform(-3, 8))


def _state(rng: np.random.Generator, names: list[str]) -> Any:
    of = str(rng.choice(list(MEMORIES)))
    found = {"of": of, "input": _tree(rng, [*names, "k"], 6), MEMORIES[of]: _number(rng)}
    if rng.random() < 0.03:
        found[str(rng.choice([*found, "extra"]))] = _odd(rng)
    return found


def _tree(rng: np.random.Generator, names: list[str], depth: int) -> Any:
    chance = rng.random()
    if chance < 0.01:
        return _odd(rng)
    if (depth > 7 and chance < 0.98) or chance < 0.15 * depth:
        return str(rng.choice(names)) if rng.random() < 0.7 else _number(rng)
    if chance > 0.95 and names:
        return _bumps(rng, names)
    name = str(rng.choice(list(FUNCTIONS)))
    least, most, _ = FUNCTIONS[name]
    return [name, *(_tree(rng, names, depth + 1) for _ in range(rng.integers(least, min(most, 3) + 1)))]


def _bumps(rng: np.random.Generator, names: list[str]) -> Any:
    """Mostly of the right form; some are too many, or of numbers that are too large."""
    of = rng.choice(names, rng.integers(1, 6)).tolist()
    widths = [abs(_range(rng)) for _ in of]
    rows: list[Any] = [[_number(rng) for _ in range(len(of) + 1)] for _ in range(rng.integers(0, 70))]
    if rng.random() < 0.1:
        rows.append(_odd(rng))
    return ["bumps", of, widths if rng.random() < 0.9 else _odd(rng), rows]


def main() -> None:
    """Try as many as asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("laws", type=int, nargs="?", default=10_000)
    laws = parser.parse_args().laws
    rng, found = np.random.default_rng(0), {"refused": 0, "harmless": 0}
    for number in range(laws):
        effect = hostile(rng)
        try:
            found[outcome(effect)] += 1
        except Exception:
            print(f"law {number}: {effect}")
            raise
    print(f"{found['refused']} refused in one line, {found['harmless']} simulated without harm, 0 others")


if __name__ == "__main__":
    main()
