"""Results of diagnoses, written down without any simulation: a trunk and an arm, with all four verdicts.

A small board with a small policy, and entries of it.
"""

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from soro_bench.blind_benchmark.criteria import CRITERIA
from soro_bench.diagnosis.result import LawCurve, Result
from soro_bench.diagnosis.result_parts import (
    Detectable,
    Errors,
    Estimate,
    Finding,
    FittedTerms,
    HypothesisSummary,
    NamedLocation,
    NextRecording,
    ParameterEstimate,
    RankedLocation,
    ScreenedTerm,
    SelectionRound,
    UnknownInput,
)
from soro_bench.diagnosis.result_robot import Outliers, Patch, Replay, ReplayedRobot, RobotSummary, Shape, SignalQuality
from soro_bench.effects.effect import Location
from soro_bench.files import write_json
from soro_bench.leaderboard.boards import BOARDS, Condition
from soro_bench.leaderboard.entry import evaluated, write_entry
from soro_bench.policies.policy import Policy, PolicyCard

CABLES = tuple(Location("tendon", f"L{i}") for i in range(4))


HINGE, ARM, MOTOR = Location("joint", "hinge"), Location("body", "arm"), Location("actuator", "motor")


_TRUNK = RobotSummary("TrunkReach-v0", "cable", "keypoints", "m", ("cable L0", "cable L1", "cable L2", "cable L3"))


_ARM = RobotSummary("arm", "arm", "angle", "rad", ("actuator motor",))


def _errors(before: float, after: float, noise: float) -> Errors:
    return Errors(before, after, noise, 0.9 * before, 0.9 * after)


def _robots(train: Errors, heldout: Errors | None, last: str = "", *effects: dict) -> tuple[ReplayedRobot, ...]:
    """The model as built, with fitted parameters, and one with effects if it has a name."""
    rows = [(each.before, each.after) for each in (train, heldout) if each]
    built = ReplayedRobot("nominal", {}, (), *(1.5 * before for before, _ in rows))
    fitted = ReplayedRobot("fitted", {}, (), *(before for before, _ in rows))
    best = ReplayedRobot(last, {}, effects, *(after for _, after in rows))
    return (built, fitted, best) if last else (built, fitted)


def _replay(points: int, coordinates: int, before: float, after: float) -> Replay:
    """4.5 s at 20 Hz; a sample is missing."""
    time = 0.05 * np.arange(1, 91)
    measured = np.sin(time)[:, None] * np.linspace(0.5, 1.0, points * coordinates) * 0.1
    wave = np.cos(5 * time)[:, None] * np.linspace(0.2, 1.0, points * coordinates)
    rows = {name: measured - size * wave for name, size in (("before", before), ("after", after))}
    measured[3, 0] = math.nan
    plain = {name: tuple(map(tuple, each.tolist())) for name, each in (*rows.items(), ("measured", measured))}
    return Replay(tuple(time.tolist()), (points, coordinates), gain=tuple((2.0 + np.sin(time)).tolist()), **plain)


def _trunk_shapes() -> tuple[Shape, ...]:
    bodies = [
        Shape(((0.0, 0.0, -0.03 * i), (0.0, 0.0, -0.03 * (i + 1))), 0.015, (Location("body", f"vertebra{i}"),))
        for i in range(10)
    ]
    sides = ((0.0, 0.02), (-0.02, 0.0), (0.0, -0.02), (0.02, 0.0))
    cables = [Shape(((x, y, 0.0), (x, y, -0.3)), 0.0, (cable,)) for (x, y), cable in zip(sides, CABLES, strict=True)]
    return (*bodies, *cables)


def _hypothesis(
    effects: tuple[NamedLocation, ...], probability: float, train: Errors, heldout: Errors | None
) -> HypothesisSummary:
    evidence = 100.0 * probability
    return HypothesisSummary(
        effects, probability, 3 + 2 * len(effects), 225, 12.0, 30.0, evidence - 5, evidence, train, heldout
    )


def _of(robot: RobotSummary, verdict: str, **changes: Any) -> Result:
    """A result with nothing found, with changes."""
    noise = 0.0004 if robot is _TRUNK else 0.0006
    errors = Errors(noise, noise, noise, noise, noise)
    known = (
        ParameterEstimate(Estimate("damping", 0.1, "s", 0.09, 0.11), 0.12, -0.9),
        ParameterEstimate(Estimate("friction", 0.4, "1", 0.38, 0.42), 0.5, 0.5),
    )
    found: dict[str, Any] = {
        "robot": robot,
        "verdict": verdict,
        "p_value": 0.934,
        "alpha": 0.0035,
        "unknown": 0.03,
        "healthy": 0.97,
        "predicted_gain": 0.0,
        "remaining_gain": 0.0,
        "recordings": (SignalQuality(noise, 0.0), SignalQuality(noise, 0.01)),
        "trained_on": 1,
        "outliers": Outliers(0.0, 0.0),
        "findings": (Finding("none", "none", 0.97), Finding("unknown", "unknown", 0.03)),
        "categories": {"none": 0.97, "unknown": 0.03},
        "hypotheses": (_hypothesis((), 0.97, errors, errors),),
        "rounds": (),
        "credible_set": ("none",),
        "train": errors,
        "heldout": errors,
        "parameters_only": noise,
        "parameters": known,
        "covariance": ((4e-5, 0.0), (0.0, 1.5e-4)),
        "trainable": robot is _TRUNK,
        "patch": Patch("none", (), "<mujoco/>\n", (), ()),
        "locations": (),
        "unknown_input": None,
        "detectable": (),
        "undetectable": (),
        "not_searched": (),
        "next_recording": None,
        "curve": None,
        "replay": _replay(6, 3, noise, noise) if robot is _TRUNK else _replay(1, 1, noise, noise),
        "shapes": _trunk_shapes()
        if robot is _TRUNK
        else (Shape(((0.0, 0.0, 0.0), (0.2, 0.0, 0.0)), 0.01, (ARM, HINGE, MOTOR)),),
        "seed": 0,
        "seconds": 31.4,
        "robots": _robots(errors, errors),
    }
    return Result(**{**found, **changes})


def trunk_friction() -> Result:
    """Dry friction on a cable of a trunk, which backlash might be too."""
    train, heldout = _errors(0.0042, 0.0007, 0.0004), _errors(0.0051, 0.0009, 0.0004)
    friction, backlash = NamedLocation("coulomb_friction", CABLES[2]), NamedLocation("backlash", CABLES[2])
    law = Finding(
        "coulomb_friction",
        "friction",
        0.74,
        CABLES[2],
        (Estimate("friction", 0.8, "N", 0.7, 0.9), Estimate("presliding", 0.0005, "m", 0.0002, 0.0012)),
        ((0.5, 4.0),),
        "Acts mainly just after L2 reverses: 83 % of the improvement falls in that 35 % of the recording.",
        train,
        heldout,
        is_best=True,
    )
    rival = Finding(
        "backlash",
        "hysteresis_or_play",
        0.2,
        CABLES[2],
        (Estimate("width", 0.0011, "m", 0.0009, 0.0013),),
        train=_errors(0.0042, 0.001, 0.0004),
        drawbacks=("leaves 1 mm, coulomb_friction 0.7 mm",),
    )
    effect = {
        "name": "coulomb_friction",
        "location": {"kind": "tendon", "name": "L2"},
        "parameters": {"friction": 0.8, "presliding": 0.0005},
    }
    return _of(
        _TRUNK,
        "discrepancy",
        p_value=1e-134,
        healthy=0.0,
        unknown=0.06,
        predicted_gain=103.5,
        findings=(law, rival, Finding("unknown", "unknown", 0.06)),
        categories={"friction": 0.74, "hysteresis_or_play": 0.2, "unknown": 0.06},
        hypotheses=(_hypothesis((friction,), 0.74, train, heldout), _hypothesis((backlash,), 0.2, train, heldout)),
        rounds=(SelectionRound((), (ScreenedTerm(friction, 103.5),), (FittedTerms((friction,), 12.0),)),),
        credible_set=("coulomb_friction", "backlash"),
        train=train,
        heldout=heldout,
        parameters=(ParameterEstimate(Estimate("young_modulus", 2e6, "Pa", 1.9e6, 2.1e6), 4e6, -3.4),),
        covariance=((3.7e7,),),
        patch=Patch("accepted", (effect,), None, (), (), "MJCF has no field for it"),
        next_recording=NextRecording(
            "slow sweeps of L2",
            10.0,
            ("coulomb_friction", "backlash"),
            (("coulomb_friction", "backlash"),),
            14.0,
            0.1,
            ((0.0, 0.0, 1.0, 0.0),) * 5,
        ),
        curve=LawCurve(
            friction,
            ((-0.02, -0.01), (0.01, 0.02)),
            ((0.8, 0.8), (-0.8, -0.8)),
            ((0.82, 0.79), (-0.81, math.nan)),
            ((0.05, 0.04), (0.05, math.nan)),
            0.98,
            "rate of the length [m/s]",
            "force [N]",
        ),
        replay=_replay(6, 3, 0.0042, 0.0007),
        robots=_robots(train, heldout, "patched", effect),
    )


def arm_gain() -> Result:
    """A gain of the motor of a user's arm that makes held-out recordings worse; of its kind several laws are likely."""
    train, heldout = _errors(0.0165, 0.0056, 0.0006), _errors(0.00129, 0.00358, 0.0006)
    gain, lag = NamedLocation("actuator_gain", MOTOR), NamedLocation("actuator_saturation", MOTOR)
    best = Finding("actuator_gain", "static_error", 0.5, MOTOR, (Estimate("gain", 0.9, "1", 0.88, 0.92),), is_best=True)
    other = Finding("actuator_saturation", "static_error", 0.45, MOTOR, (Estimate("loss", 0.1, "1"),))
    return _of(
        _ARM,
        "discrepancy",
        p_value=None,
        healthy=0.0,
        unknown=0.05,
        findings=(best, other),
        categories={"static_error": 0.95, "unknown": 0.05},
        hypotheses=(_hypothesis((gain,), 0.5, train, heldout), _hypothesis((lag,), 0.45, train, heldout)),
        train=train,
        heldout=heldout,
        patch=Patch("rejected", (), "<mujoco/>\n", (), ()),
        replay=_replay(1, 1, 0.0165, 0.0056),
        robots=_robots(train, heldout, "best"),
    )


def outside_catalogue() -> Result:
    """Something that no law describes, best explained at a vertebra."""
    train = Errors(0.0042, 0.0042, 0.0004, 0.003, 0.003)
    body = [Location("body", f"vertebra{i}") for i in range(10)]
    start = tuple((0.5 * np.arange(9)).tolist())
    return _of(
        _TRUNK,
        "outside_catalogue",
        p_value=0.0,
        healthy=0.0,
        unknown=0.98,
        findings=(Finding("unknown", "unknown", 0.98), Finding("none", "none", 0.02)),
        categories={"unknown": 0.98, "none": 0.02},
        hypotheses=(_hypothesis((), 0.02, train, None),),
        train=train,
        heldout=None,
        locations=(RankedLocation(body[4], 210.0), RankedLocation(body[5], 205.0), RankedLocation(body[9], 60.0)),
        unknown_input=UnknownInput(
            body[4],
            ("force x", "force y"),
            ("N", "N"),
            (0,) * 9,
            start,
            tuple(zip(np.sin(start).tolist(), np.cos(start).tolist(), strict=True)),
            0.0007,
            {},
        ),
        replay=_replay(6, 3, 0.0042, 0.0042),
        robots=_robots(train, None),
    )


def adequate() -> Result:
    """An arm whose simulation lacks nothing, with what the recordings would have shown."""
    least = (
        ("actuator_delay", "delay", 0.0021, "s", 0.0, MOTOR),
        ("actuator_gain", "gain", 0.0032, "1", 1.0, MOTOR),
        ("backlash", "width", 0.0029, "rad", 0.0, MOTOR),
        ("coulomb_friction", "friction", 0.0036, "N m", 0.0, HINGE),
        ("fluid_drag", "drag", 0.19, "N s^2/m^2", 0.0, ARM),
        ("payload", "mass", 0.024, "kg", 0.0, ARM),
        ("viscous_friction", "damping", 0.014, "N m s/rad", 0.0, HINGE),
    )
    return _of(
        _ARM,
        "adequate",
        detectable=tuple(Detectable(*each) for each in least),
        undetectable=("base_tilt", "hysteresis", "local_stiffness", "marker_slip", "plastic_set", "rest_bend"),
        not_searched=("adhesion", "stiction"),
    )


def outliers_only() -> Result:
    """A trunk that is simulated well, but for points that a camera lost; by a version that kept no robots."""
    return _of(
        _TRUNK,
        "measurement_fault",
        robots=(),
        outliers=Outliers(0.012, 0.031),
        findings=(Finding("outliers", "measurement", 0.97), Finding("unknown", "unknown", 0.03)),
        categories={"measurement": 0.97, "unknown": 0.03},
    )


RESULTS = {
    "trunk friction": trunk_friction,
    "arm gain": arm_gain,
    "outside the catalogue": outside_catalogue,
    "adequate": adequate,
    "outliers only": outliers_only,
}


BOARD = "TrunkReach-v0"


CARD = PolicyCard(BOARD, "cable", "continuous", "oracle", 0, 1000)


OBSERVED, PULLED = 66, 8


def shrink_board(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two starts of five steps, on the cheap model."""
    whole = BOARDS[BOARD]
    conditions = {"cable": Condition("cable", whole.conditions["cable"].starts[:2])}
    monkeypatch.setitem(BOARDS, BOARD, replace(whole, conditions=conditions, episode_steps=5))


def policy(seed: int = 0, **card: Any) -> Policy:
    """One random layer."""
    rng = np.random.default_rng(seed)
    tensors: dict[str, np.ndarray] = {"mean": np.zeros(OBSERVED), "std": np.ones(OBSERVED)}
    tensors |= {"w0": rng.normal(size=(PULLED, OBSERVED)), "b0": np.zeros(PULLED)}
    return Policy(replace(CARD, seed=seed, **card), tensors)


def scores(*final_mm: float) -> dict:
    """The scores of episodes that end with these metrics [mm], on the cheap model."""
    return {"cable": {"final_mm": list(final_mm), "return": [0.0] * len(final_mm), "success": [False] * len(final_mm),
                      "diverged": 0}}  # fmt: skip


def true_entry(results: Path, entry: str = "ours", given: Policy | None = None) -> Path:
    """An entry with what its policy does."""
    given = given or policy()
    return write_entry(results, BOARD, entry, given, evaluated(BOARDS[BOARD], given, num_threads=1))


def edit(path: Path, change: Callable[[dict], object]) -> None:
    """Change the content of an entry."""
    entry = json.loads(path.read_text())
    change(entry)
    write_json(path, entry)


def put_policy(path: Path, name: str, data: bytes) -> None:
    """Another policy file for an entry, with its hash."""
    (path.parent / name).write_bytes(data)
    edit(path, lambda entry: entry.update(policy={"file": name, "sha256": hashlib.sha256(data).hexdigest()}))


def gates(false_alarms: float) -> list[dict]:
    """Those of a diagnosis of which only the first has cases."""
    empty = {"cases": 0, "value": None, "interval": None, "met": None}
    found: list[dict] = [{"gate": name, "bar": bar, "below": below, **empty} for name, _, _, bar, below in CRITERIA]
    found[0] |= {"cases": 20, "value": false_alarms, "interval": [0.0, 0.1], "met": false_alarms <= found[0]["bar"]}
    return found
