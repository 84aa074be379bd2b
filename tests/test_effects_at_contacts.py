"""Known answers of the effects at contacts: a block on a plane."""

import mujoco
import numpy as np
import pytest

from soro_bench.effects.effect import Effect, EffectError, Location
from soro_bench.effects.elements import instrument
from soro_bench.models.simulation import Simulation
from soro_bench.parameters import ParameterSet

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
