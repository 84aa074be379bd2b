"""Known answers of the effects at chambers, filled through a supply or those of the walker, and at contacts."""

import mujoco
import numpy as np
import pytest

from soro_bench.effects.catalogue import PHYSICS, QUANTITIES
from soro_bench.effects.effect import Effect, EffectError, Location
from soro_bench.effects.elements import instrument
from soro_bench.effects.setpoints import SetpointLaw
from soro_bench.models.simulation import Simulation
from soro_bench.parameters import ParameterSet
from soro_bench.registration import make_task

# three chambers: actuators that integrate the rate of their pressure
CHAMBERS = """<mujoco><option timestep="0.001"/><worldbody><body><joint name="hinge" armature="1"/>
<geom size="0.01" contype="0" conaffinity="0"/></body></worldbody><actuator>
<general name="a" joint="hinge" dyntype="integrator" gainprm="0.001" ctrlrange="-9 9" ctrllimited="true"/>
<general name="b" joint="hinge" dyntype="integrator" gainprm="0.001" ctrlrange="-9 9" ctrllimited="true"/>
<general name="c" joint="hinge" dyntype="integrator" gainprm="0.001" ctrlrange="-9 9" ctrllimited="true"/>
</actuator></mujoco>"""


def pressures(effects, rates, chambers=CHAMBERS):
    """(T, 3) activations of chambers that are filled at rates (T, 3) [1/s]."""
    model = instrument(mujoco.MjSpec.from_string(chambers)).compile()
    sim = Simulation(model, ParameterSet(), (), 1, 1, effects)
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.begin(np.arange(1))
    rows = []
    for rate in rates:
        sim.batch.ctrl[0] = rate
        sim.step(np.arange(1), 1)
        rows.append(sim.batch.act[0].copy())
    return np.array(rows)


def test_chambers_on_one_supply_fill_more_slowly_together_and_vent_as_alone():
    rates = np.repeat([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0], [-1.0, -1.0, 0.0]], 100, axis=0)
    found = pressures([Effect("supply_coupling", Location("actuator", "*"), {"coupling": 0.25})], rates)
    assert found[99] == pytest.approx([0.1, 0, 0], abs=0.002)
    assert found[199] == pytest.approx([0.1, 0.075, 0.075], abs=0.002)
    assert found[299] == pytest.approx([0.0, -0.025, 0.075], abs=0.002)


def test_a_leak_loses_pressure_with_its_rate():
    rates = np.repeat([[1.0, 1.0, 0.0], [0.0, 0.0, 0.0]], [100, 900], axis=0)
    found = pressures([Effect("pressure_leak", Location("actuator", "a"), {"rate": 2.0})], rates)
    assert found[-1] == pytest.approx([0.1 * np.exp(-2.0 * 0.95), 0.1, 0.0], rel=0.01, abs=1e-12)


CLOSED = CHAMBERS.replace('ctrllimited="true"/>', 'ctrllimited="true" actlimited="true" actrange="0 1"/>')


@pytest.mark.parametrize(
    ("effect", "held"),
    [
        (Effect("pressure_leak", Location("actuator", "a"), {"rate": 0.5}), np.exp(-0.5)),
        (Effect("supply_coupling", Location("actuator", "*"), {"coupling": 0.25}), 1.0),
    ],
)
def test_a_chamber_is_filled_again_and_never_below_nothing(effect, held):
    """For 2 s to the full, held for 1 s, filled again, vented for 3 s."""
    rates = np.repeat([[1.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]], [2000, 1000, 2000, 3000],
                      axis=0)  # fmt: skip
    found = pressures([effect], rates, CLOSED)[:, 0]
    full = found[1999]
    assert 0.75 < full <= 1.0
    assert found[2999] == pytest.approx(held * full, rel=0.01)
    assert found[4999] == pytest.approx(full, rel=0.02)
    assert found.min() == found[-1] == 0.0


def test_filling_lags_and_venting_does_not():
    rates = np.repeat([[5.0, 0.0, 0.0], [0.0, 0.0, 0.0], [-5.0, 0.0, 0.0]], [20, 480, 40], axis=0)
    asymmetry = [Effect("pressure_asymmetry", Location("actuator", "a"), {"difference": 0.1, "venting": 0.001})]
    found = pressures(asymmetry, rates)[:, 0]
    assert found[120] == pytest.approx(0.1 * (1 - np.exp(-1.1)), rel=0.05)
    assert found[499] == pytest.approx(0.1, rel=0.02)
    assert found[539] == pytest.approx(-0.1, rel=0.1)


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("pressure_leak", {"rate": 1e-9}),
        ("supply_coupling", {"coupling": 1e-9}),
    ],
)
def test_a_weak_supply_leaves_what_laws_before_it_have_done(name, parameters):
    """A chamber that is filled half as far as it is told, or that leaks, long after it was told to be full."""
    rates, location = np.repeat([[2.0, 0.0, 0.0]], 2000, axis=0), Location("actuator", "a")
    before = [Effect("actuator_gain", location, {"gain": 0.5})]
    if name == "supply_coupling":
        before = [Effect("pressure_leak", location, {"rate": 5.0})]
    found = pressures([*before, Effect(name, location, parameters)], rates, CLOSED)
    assert found[:, 0] == pytest.approx(pressures(before, rates, CLOSED)[:, 0], abs=1e-5)


@pytest.mark.parametrize("name", [name for name, law in PHYSICS.items() if issubclass(law, SetpointLaw)])
def test_a_law_of_the_chambers_without_magnitude_moves_the_walker_bit_for_bit_as_before(name):
    null = {q.name: q.null if i == 0 else q.typical for i, q in enumerate(QUANTITIES[name])}
    assert np.array_equal(walk([Effect(name, Location("actuator", "*"), null)]), walk(None))


def walk(effects):
    """(3, n) observations of a walker under random rates of inflation."""
    task, rng = (
        make_task("MultiGait-v0", 1, 1, "coarse", action="continuous", effects=effects),
        np.random.default_rng(0),
    )
    task.reset(np.arange(1), [rng], [{}])
    return np.concatenate([task.step(np.arange(1), rng.uniform(-0.3, 1, (1, 3))).observation for _ in range(3)])


WEAK = {
    "pressure_leak": {"rate": 2.0},
    "supply_coupling": {"coupling": 0.5},
    "pressure_asymmetry": {"difference": 1.0, "venting": 0.1},
}


@pytest.mark.parametrize("name", WEAK)
def test_a_walker_whose_supply_is_weak_is_inflated_less(name):
    inflation = []
    for effects in ((), [Effect(name, Location("actuator", "*"), WEAK[name])]):
        task = make_task("MultiGait-v0", 1, 1, "coarse", action="continuous", effects=effects)
        task.reset(np.arange(1), [np.random.default_rng(0)], [{}])
        task.step(np.arange(1), np.ones((1, 3), np.float32))
        inflation.append(task.sim.batch.act[0].mean())
    assert inflation[1] < 0.9 * inflation[0]


TIMESTEP, FRICTION, GRAVITY = 0.001, 0.3, 9.81
BLOCK = f"""<mujoco><option timestep="{TIMESTEP}"/>
<default><geom friction="{FRICTION} 0 0" solref="0.004 1"/></default>
<worldbody><geom name="ground" type="plane" size="5 5 0.1"/><body name="block" pos="0 0 0.009996"><freejoint/>
<geom name="block" type="box" size="0.05 0.05 0.01" mass="0.2"/></body></worldbody></mujoco>"""


def slide(effects, velocity=0.0, tilt=0.0, gravity=GRAVITY, duration=1.0, height=0.0):
    """(T, 3) m, the way of a block on a plane, or above it, that is tilted about y (a slope down along +x) [rad]."""
    model = instrument(mujoco.MjSpec.from_string(BLOCK)).compile()
    sim = Simulation(model, ParameterSet(), (), 1, 1, effects)
    sim.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    sim.batch.expand("opt.gravity")[:] = gravity * np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    sim.batch.qvel[0, 0] = velocity
    sim.batch.qpos[0, 2] += height
    sim.begin(np.arange(1))
    way = []
    for _ in range(round(duration / TIMESTEP)):
        sim.step(np.arange(1), 1)
        way.append(sim.batch.qpos[0, :3].copy())
    return np.array(way) - [0, 0, 0.01]


def on_block(name, **values):
    return [Effect(name, Location("geom", "block"), values)]


@pytest.mark.parametrize(("slope", "factor"), [(0.8, 1.0), (-0.8, 2.0)])
def test_anisotropic_friction_brakes_more_one_way(slope, factor):
    """A block that slides down a slope in 1 s, along x or against it."""
    way = slide(on_block("anisotropic_friction", excess=1.0), tilt=np.arctan(slope))[-1, 0]
    expected = 0.5 * GRAVITY * (abs(slope) - factor * FRICTION) / np.hypot(1, slope)
    assert way * np.sign(slope) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(("excess", "velocity", "rests"), [(0.0, 0.0, False), (1.0, 0.0, True), (1.0, 0.3, False)])
def test_stiction_holds_what_rests_and_not_what_slides(excess, velocity, rests):
    """On a slope of tan 0.45, between the friction of sliding, 0.3, and that of rest, 0.6."""
    way = slide(on_block("stiction", excess=excess, velocity=0.02), velocity, tilt=np.arctan(0.45))
    acceleration = GRAVITY * (0.45 - FRICTION) / np.hypot(1, 0.45)
    expected = 0.0 if rests else velocity + 0.5 * acceleration
    assert way[-1, 0] == pytest.approx(expected, rel=0.05, abs=0.01)


@pytest.mark.parametrize("name", ["anisotropic_friction", "stiction"])
def test_friction_that_depends_on_a_velocity_needs_a_geom_that_moves(name):
    with pytest.raises(EffectError, match="geom ground never moves"):
        slide([Effect(name, Location("geom", "ground"), {})])


@pytest.mark.parametrize(("pull", "holds"), [(0.8, True), (1.2, False)])
def test_adhesion_holds_up_to_its_force(pull, holds):
    """A block that hangs from the plane by its four corners, pulled at with ``pull`` times what they hold."""
    way = slide(on_block("adhesion", force=0.2 * GRAVITY / pull / 4), gravity=-GRAVITY, duration=0.5)
    assert (way[-1, 2] < 0.005) == holds


def test_adhesion_does_not_cushion_a_fall():
    """A block that falls 2 cm meets the plane as it would without."""
    before = slide([], gravity=GRAVITY, height=0.02, duration=0.2)
    after = slide(on_block("adhesion", force=1e-6), gravity=GRAVITY, height=0.02, duration=0.2)
    assert np.abs(after - before).max() < 1e-4
