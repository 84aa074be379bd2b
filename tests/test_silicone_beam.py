"""The silicone beam: what beam theory says of it, how damping laws show in its decay, and its recordings."""

import os
from pathlib import Path

import mujoco
import numpy as np
import pytest

from soro_bench.assets import mjcf_path
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.effects.effect import Effect, Location
from soro_bench.models import silicone_beam as beam

BENDING = beam.YOUNG * beam.SIDE**4 / 12  # N m^2
SHEARING = beam.SHEAR * beam.SIDE**2  # N
STEP = 0.002  # s, the control step
HELD, WINDOW = 25, 142  # control steps: in the hand; two periods of the beam alone
DATA = Path(os.environ.get("SORO_BENCH_DATA", ""), "silicone_beam_arm")


def robot():
    return ModelRobot(mjcf_path("real/silicone_beam.xml"), mjcf_path("real/silicone_beam.toml"), threads=1)


def released(effects=(), load=0.0, seconds=1.5):
    """(T,) m, how high the first marker is after the hand has let go, without damping of the model's own."""
    one = robot()
    assert one.control_timestep == STEP
    steps = round(seconds / STEP)
    held = (np.arange(steps) < HELD).astype(float)
    settings = np.stack([held, np.full(steps, load)], axis=1)
    nominal = {prior.name: prior.nominal for prior in one.priors} | {"damping": 1e-3}
    commands = np.tile([0.074, 0.0306], (steps, 1))
    rows = np.array([list(nominal.values())])
    return one.simulate(commands, rows, [effects], settings=settings)[0, HELD:, 0, 0]


def decrements(height):
    """Logarithmic decrements per period, of the first four periods and of the last four, from the rms of two each."""
    windows = np.resize(height, (len(height) // WINDOW, WINDOW))
    logs = np.log(windows.std(axis=1))
    return (logs[0] - logs[1]) / 2, (logs[-2] - logs[-1]) / 2


def test_the_file_is_what_the_module_builds():
    assert beam.silicone_beam().to_xml() in mjcf_path("real/silicone_beam.xml").read_text()


@pytest.mark.parametrize("slices", [beam.COARSE, beam.FINE])
def test_a_force_at_the_end_bends_and_shears_the_beam_as_theory_says(slices):
    """F (L^3 / (3 E I) + L / (k G A)) at the end."""
    model = beam.silicone_beam(slices).compile()
    model.opt.gravity, model.dof_damping = 0, 100 * model.dof_damping
    model.actuator_biasprm = 0  # the hand lets go
    data, last = mujoco.MjData(model), model.site("edge").bodyid[0]
    mujoco.mj_forward(model, data)
    before = data.site("edge").xpos.copy()
    data.xfrc_applied[last, 1], force = 0.05, 0.05
    # a force in the middle of the last slice turns the end as well
    data.xfrc_applied[last, 3] = -force * beam.LENGTH / slices.count / 2
    for _ in range(round(1.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    expected = force * (beam.LENGTH**3 / (3 * BENDING) + beam.LENGTH / SHEARING)
    assert (data.site("edge").xpos - before)[1] == pytest.approx(expected, rel=0.03)


def test_the_beam_swings_as_fast_as_theory_says():
    """Without shear and turning inertia the first frequency is 3.516 sqrt(E I / m L^3) / (2 pi), with both 7 % less."""
    height = released()
    rising = np.flatnonzero(np.diff((height > height.mean()).astype(int)) > 0)
    frequency = 8 / (STEP * (rising[8] - rising[0]))
    slender = 3.516 / (2 * np.pi) * np.sqrt(BENDING / (beam.DENSITY * beam.SIDE**2 * beam.LENGTH**4))
    assert frequency == pytest.approx(0.93 * slender, rel=0.02)


def test_nothing_is_damped_but_by_the_model():
    assert np.abs(decrements(released())).max() < 2e-3


@pytest.mark.parametrize(
    ("name", "port", "parameters", "last_over_first"),
    [
        ("coulomb_friction", Location("joint", "bend_y1of4"), {"friction": 1e-3, "presliding": 1e-3}, (1.4, 2.5)),
        ("fluid_drag", Location("body", "*"), {"drag": 0.5}, (0.2, 0.6)),
        ("hysteresis", Location("body", "*"), {"ratio": 0.1, "yield_strain": 0.02}, (0.1, 0.6)),
        ("viscoelastic_creep", Location("body", "*"), {"ratio": 0.2, "time_constant": 0.05}, (0.85, 1.15)),
        ("viscous_friction", Location("joint", "bend_y1of4"), {"damping": 2e-3}, (0.85, 1.15)),
    ],
)
def test_damping_laws_show_in_how_the_decrement_changes_as_the_swing_dies_down(name, port, parameters, last_over_first):
    first, last = decrements(released([Effect(name, port, parameters)]))
    assert first > 0.02
    assert last_over_first[0] < last / first < last_over_first[1]


def test_the_load_takes_the_beam_down_further_and_hangs_slack_at_first():
    free, loaded = released(), released(load=1.0)
    sag = beam.LOAD * beam.GRAVITY * (beam.LENGTH**3 / (3 * BENDING) + beam.LENGTH / SHEARING)
    assert free[-250:].mean() - loaded[-250:].mean() == pytest.approx(sag, rel=0.2)
    assert np.abs(free[:12] - loaded[:12]).max() < 1e-3 < free[30] - loaded[30]


@pytest.mark.parametrize(("kind", "missed"), [("gravity", 3.0), ("load52", 8.0)])
def test_the_nominal_beam_is_near_its_recordings(kind, missed):
    """Root mean square distance of the markers [mm] before anything is fitted, and how long the hand holds on."""
    pytest.importorskip("pyarrow")
    from soro_bench.recording.importers import import_recording

    if not DATA.is_dir():
        pytest.skip("no recordings: the environment variable SORO_BENCH_DATA names no folder with silicone_beam_arm")
    one, mapping = robot(), mjcf_path(f"real/silicone_beam_{kind}_import.toml")
    measured = one.measured(import_recording(DATA / f"beam_{kind}_V2_a.csv", mapping))
    let_go = STEP * np.flatnonzero(measured.settings[:, 0] == 0)[0]
    assert let_go == pytest.approx({"gravity": 0.706, "load52": 0.4355}[kind], abs=0.002)
    rows = np.array([[prior.nominal for prior in one.priors]])
    (found,) = one.simulate(measured.actions, rows, [()], measured.start, settings=measured.settings)
    error = 1e3 * np.linalg.norm(found - measured.values, axis=2)
    assert np.sqrt(np.nanmean(error**2)) < missed
