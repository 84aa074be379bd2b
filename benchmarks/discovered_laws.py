"""Laws outside the catalogue, hidden in arms that MuJoCo alone simulates (hidden_arms.py): found, written, held out?

    python benchmarks/discovered_laws.py FOLDER [--seeds 0 1 2 3 4] [--families magnet cogging]
    python benchmarks/discovered_laws.py FOLDER --seeds 0 --families trunk_cross_talk trunk_world_spring trunk_gusts

The held-out recording also chooses between laws, so what a law explains is judged on a third one, which no diagnosis
sees, by replays of the result. One JSON a case, so a run goes on where it ended. Prints every case and the criteria.
Seeds from 900000 on are for releases: nothing is changed after looking at one of them.
"""

import argparse
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import hidden_arms as arms
from soro_bench.blind_benchmark import cases
from soro_bench.blind_benchmark.draw import draw_parameters, manoeuvre
from soro_bench.blind_benchmark.robot import Law, Robot, simulate
from soro_bench.diagnosis.api import diagnose
from soro_bench.diagnosis.replay_check import check_replays
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.diagnosis.robots.robot import Robot as DiagnosedRobot
from soro_bench.diagnosis.robots.suite_robot import SuiteRobot
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.custom_law import CustomLaw
from soro_bench.effects.effect import Effect, Location, effect_from
from soro_bench.effects.expression import evaluated, names_in
from soro_bench.files import write_json
from soro_bench.models import trunk_geometry as geo
from soro_bench.recording.recording import Recording, Signal

FITTED, TESTED, UNSEEN = 1, 1, 1  # recordings of a case
GRID = 2000  # random states, on which a law is compared with the true one
ALIKE = 0.9  # correlation from which forms and signs are the same
CRITERIA = {"flagged": 0.85, "located": 0.85, "explained": 0.8, "form": 0.6, "beats": 0.8}


# --- the same on a trunk, which the blind benchmark's own loop simulates at an eighth of the time step ---

TRUNK_SECONDS = 12.0  # of a recording


def trunk_cross_talk(rng: np.random.Generator) -> arms.HiddenLaw:
    """Another cable's command pulls a cable."""
    i, j = rng.choice(len(geo.CABLE_NAMES), 2, replace=False)
    k, read = rng.uniform(80.0, 160.0), f"command {geo.CABLE_NAMES[j]}"
    return arms.HiddenLaw("trunk_cross_talk", geo.CABLE_NAMES[i], (read,), lambda v: k * v[read])


def trunk_world_spring(rng: np.random.Generator) -> arms.HiddenLaw:
    """A spring from a vertebra to a point of the world, 60 to 100 mm beside the straight trunk."""
    body, k, rest = f"vertebra{rng.integers(5, geo.NUM_NECKS)}", rng.uniform(1.5, 4.0), rng.uniform(0.0, 0.03)
    radius, angle = rng.uniform(0.06, 0.1), rng.uniform(0.0, 2.0 * np.pi)
    point = (radius * float(np.cos(angle)), radius * float(np.sin(angle)), float(rng.uniform(0.1, 0.2)))
    read = f"distance {body}"
    return arms.HiddenLaw("trunk_world_spring", body, (read,), lambda v: k * (v[read] - rest), "pull", point)


def trunk_gusts(rng: np.random.Generator) -> arms.HiddenLaw:
    """A pull of a long cable that never comes again; it forgets in half a second."""
    kept, pull = float(np.exp(-0.00125 / 0.5)), [0.0]

    def force(v: arms.Values) -> float:
        """Of 1.5 N rms."""
        pull[0] = kept * pull[0] + 1.5 * np.sqrt(1.0 - kept**2) * float(v["chance "])
        return pull[0]

    cable = geo.CABLE_NAMES[int(rng.integers(4))]
    return arms.HiddenLaw("trunk_gusts", cable, (), force, of_state=False, settled=lambda v: 0.0)


TRUNK_FAMILIES = (trunk_cross_talk, trunk_world_spring, trunk_gusts)


@dataclass
class OnTrunk(Law):
    """A law at a cable of the trunk, or of a vertebra and a point."""

    law: arms.HiddenLaw

    def begin(self, robot: Robot, rng: np.random.Generator) -> None:
        """What this recording has by chance."""
        self._rng = rng

    def command(self, robot: Robot, pull: np.ndarray) -> np.ndarray:
        """Commands are read, not changed."""
        self._values = {f"command {name}": value for name, value in zip(geo.CABLE_NAMES, pull, strict=True)}
        return pull

    def push(self, robot: Robot) -> None:
        """Pull the cable, or the vertebra."""
        values = {**self._values, "time ": robot.data.time, "chance ": self._rng.standard_normal()}
        if self.law.kind == "torque":
            robot.push_cable(geo.CABLE_NAMES.index(self.law.where), float(self.law.force(values)))
            return
        body = robot.model.body(self.law.where).id
        way = np.array(self.law.point) - robot.data.xipos[body]
        values[f"distance {self.law.where}"] = distance = np.linalg.norm(way)
        robot.data.xfrc_applied[body, :3] += float(self.law.force(values)) * way / distance


def trunk_case(family: str, seed: int) -> tuple[arms.HiddenLaw, list[Recording]]:
    """The law of a case, and recordings of a trunk that has it."""
    draw = next(each for each in TRUNK_FAMILIES if each.__name__ == family)
    parameters, found = draw_parameters(np.random.default_rng([seed, 4])), []
    for k in range(FITTED + TESTED + UNSEEN):
        law, actions = draw(np.random.default_rng([seed, 1])), manoeuvre(TRUNK_SECONDS, [seed, 2, k])
        trace = simulate("fine", parameters, [OnTrunk(law)], actions, (seed, 3, k))
        points = trace.at(0.05 * np.arange(len(actions) + 1))
        found.append(cases.recording(actions, points, np.random.default_rng([seed, 5, k])))
    return law, found


def case(family: str, seed: int) -> tuple[arms.HiddenLaw, list[Recording]]:
    """The law of a case, and recordings of an arm, or of a trunk, that has it."""
    if family in [each.__name__ for each in TRUNK_FAMILIES]:
        return trunk_case(family, seed)
    draw = next(each for each in arms.FAMILIES if each.__name__ == family)
    found = []
    for k in range(FITTED + TESTED + UNSEEN):
        law = draw(np.random.default_rng([seed, 1]))
        actions = arms.goals(np.random.default_rng([seed, 2, k]))
        values = arms.simulated(law, actions, np.random.default_rng([seed, 3, k]))
        times = arms.STEP * np.arange(len(values))
        found.append(Recording({"goal": Signal(times[:-1], actions)}, {"angles": Signal(times, values, "rad")}))
    return law, found


def robot(folder: Path) -> ModelRobot:
    """The arm as its owner models it."""
    (folder / "arm.xml").write_text(arms.MODEL)
    (folder / "arm.toml").write_text(arms.MAP)
    return ModelRobot(folder / "arm.xml", folder / "arm.toml", threads=1)


def body_of(location: Location) -> str:
    """The body that a location belongs to."""
    rows = zip(arms.BODIES, arms.JOINTS, arms.MOTORS, strict=True)
    return next((row[0] for row in rows if location.name in row), location.name)


def reads(effect: Effect) -> set[str]:
    """What a law depends on, as ``HiddenLaw.reads`` has it."""
    law = effect.law
    assert law is not None
    used = names_in(law.expression)
    for state in reversed(law.states):
        used |= names_in(state.input) if state.name in used else set()
    found = set()
    for each in law.variables:
        if each.name in used:
            place = each.place.name if each.place else effect.location.name
            found.add(f"{each.of} {'' if each.of == 'time' else place}")
    return found


def same_form(law: arms.HiddenLaw, effects: list[Effect]) -> bool:
    """Whether one law reads the same variables as the true one, and rises and falls with them alike."""
    if len(effects) != 1 or reads(effects[0]) != set(law.reads):
        return False
    effect, rng = effects[0], np.random.default_rng(0)
    assert effect.law is not None
    drawn = {key: rng.uniform(*_range(effect, effect.law, key), GRID) for key in law.reads}
    values: dict[str, Any] = {name: np.full(GRID, value) for name, value in effect.parameters.items()}
    for each in effect.law.variables:
        place = each.place.name if each.place else effect.location.name
        values[each.name] = drawn[f"{each.of} {'' if each.of == 'time' else place}"]
    for state in effect.law.states:  # what remembers is compared at rest, where it has followed
        values[state.name] = evaluated(state.input, values)
    found = np.broadcast_to(evaluated(effect.law.expression, values), (GRID,))
    truth = np.array([float(law.at_rest({k: v[i] for k, v in drawn.items()})) for i in range(GRID)])
    if found.std() < 1e-12 or truth.std() < 1e-12:
        return False
    return bool(np.corrcoef(found, truth)[0, 1] >= ALIKE)


def _range(effect: Effect, law: CustomLaw, key: str) -> tuple[float, float]:
    for each in law.variables:
        place = each.place.name if each.place else effect.location.name
        if key == f"{each.of} {'' if each.of == 'time' else place}":
            if each.of == "time":
                return 0.0, arms.SECONDS
            return (0.05, 0.4) if each.of == "distance" else (each.low, each.high)
    raise KeyError(key)


def explained_unseen(result: Result, arm: DiagnosedRobot, recordings: list[Recording]) -> float:
    """Share of what fitted parameters leave of recordings above the noise, in mean square, that the law explains."""
    check = check_replays(result, arm, {str(k): each for k, each in enumerate(recordings)})
    left = {name: max(rms**2 - arms.NOISE**2, 0.0) for name, rms in check.pooled("new").items()}
    return 1.0 - left["patched"] / left["fitted"]


def scored(law: arms.HiddenLaw, result: Result, arm: DiagnosedRobot, unseen: list[Recording]) -> dict[str, Any]:
    """What is right of a result."""
    found, flagged = result.discovery, result.verdict == "outside_catalogue"
    effects = [effect_from(each, ALL) for each in found.effects] if found else []
    location = found.location if found else (result.locations[0].location if result.locations else None)
    described, black_box = bool(flagged and effects), bool(found and found.black_box)
    return {
        "family": law.family,
        "of_state": law.of_state,
        "verdict": result.verdict,
        "unknown": result.unknown,
        "best": [str(each) for each in result.best.effects],
        "location": str(location),
        "flagged": flagged,
        "located": location is not None and body_of(location) == law.where,
        "described": described,
        "black_box": black_box,
        "explained": explained_unseen(result, arm, unseen) if described else 0.0,
        "heldout": found.explained if found and described else 0.0,
        "nearest": found.nearest if found else None,
        "noise_share": found.noise_share if found else None,
        "form": bool(described and not black_box and same_form(law, effects)),
        "beats": bool(found and described and not black_box and found.explained > found.nearest),  # held out
        "equations": list(found.equations) if found else [],
        "others": list(found.others) if found else [],
        "truth": [law.where, *law.reads],
    }


def run(folder: Path, family: str, seed: int) -> dict[str, Any]:
    """Diagnose a case, or read what became of it."""
    path = folder / f"{family}_{seed}.json"
    if path.exists():
        return dict(json.loads(path.read_text()))
    law, recordings = case(family, seed)
    start = time.process_time()
    with tempfile.TemporaryDirectory() as temporary:
        on_trunk = family.startswith("trunk")
        arm = SuiteRobot("TrunkReach-v0", threads=1) if on_trunk else robot(Path(temporary))
        fitted, tested = recordings[:FITTED], recordings[FITTED:-UNSEEN]
        result = diagnose(arm, fitted, tested, seed=seed)
        took = round(time.process_time() - start, 1)
        found = {"seed": seed, **scored(law, result, arm, recordings[-UNSEEN:]), "cpu": took}
    result.save(folder / f"{family}_{seed}_result.json")
    write_json(path, found)
    return found


def summary(cases: list[dict[str, Any]]) -> str:
    """The criteria, of laws of state; and whether a disturbance was left without a law."""
    state = [each for each in cases if each["of_state"]]
    lines = []
    for name, least in CRITERIA.items() if state else ():
        values = [float(each[name]) for each in state]
        value = float(np.median(values) if name == "explained" else np.mean(values))
        how = "median, of unseen motion" if name == "explained" else f"{sum(values):.0f} of {len(values)}"
        lines.append(f"{name:10} {value:.3f} ({how}), required {least}: {'met' if value >= least else 'missed'}")
    if state:
        lines.append(f"{sum(each.get('black_box', False) for each in state)} of {len(state)} described by a black box")
    if rest := [each for each in cases if not each["of_state"]]:
        lines.append(f"{sum(not each['described'] for each in rest)} of {len(rest)} disturbances left without a law")
    return "\n".join(lines)


def main() -> None:
    """Run the cases that are asked for."""
    names = [each.__name__ for each in arms.FAMILIES]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    more = [each.__name__ for each in TRUNK_FAMILIES]
    parser.add_argument("--families", nargs="+", choices=[*names, *more], default=names)
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    cases = []
    for seed in asked.seeds:
        for family in asked.families:
            found = run(asked.folder, family, seed)
            cases.append(found)
            marks = " ".join(name if found[name] else "-" for name in ("flagged", "located", "form", "beats"))
            print(f"{family:22} {seed:6} {marks:30} {found['explained']:.3f} {found['cpu']:5.0f} s  "
                  f"{'; '.join(found['equations']) or found['best']}", flush=True)  # fmt: skip
    print(summary(cases))


if __name__ == "__main__":
    main()
