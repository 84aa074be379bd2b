"""Models of real robots: what beam theory and geometry say of them, and their recordings where those are at hand."""

import os
from pathlib import Path

import mujoco
import numpy as np
import pytest

from soro_bench.assets import mjcf_path
from soro_bench.diagnosis.robots.model_robot import ModelRobot
from soro_bench.effects.effect import Effect, Location
from soro_bench.models.real_robots import ASL, OPENCR, ROBOTS

FILES = [f"{name}{fine}.xml" for name in ROBOTS for fine in ("", "_fine")]
DATA = os.environ.get("SORO_BENCH_DATA", "")


def loaded(name):
    model = mujoco.MjModel.from_xml_path(str(mjcf_path(f"real/{name}")))
    return model, mujoco.MjData(model)


def settled(model, data, steps=200):
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return data


def robot(name):
    return ModelRobot(mjcf_path(f"real/{name}.xml"), mjcf_path(f"real/{name}.toml"), threads=1)


def nominal(each):
    return np.array([[prior.nominal for prior in each.priors]])


def missed(name, file, steps, effects):
    """What the nominal robot misses of a recording's last point [mm, root mean square], its mean taken off."""
    pytest.importorskip("pyarrow")
    from soro_bench.recording.importers import import_recording

    if not DATA or not Path(DATA, name).is_dir():
        pytest.skip(f"no recordings: the environment variable SORO_BENCH_DATA names no folder with {name}")
    one = robot(name)
    measured = one.measured(import_recording(Path(DATA, name, file), mjcf_path(f"real/{name}_import.toml")))
    (found,) = one.simulate(measured.actions[:steps], nominal(one), [effects], measured.start)
    error = 1e3 * (measured.values[:steps] - found)[:, -1]
    return np.linalg.norm(np.nanstd(error, axis=0))


@pytest.mark.parametrize("file", FILES)
def test_the_files_are_what_the_module_builds(file):
    name = file.removesuffix(".xml").removesuffix("_fine")
    assert ROBOTS[name](fine=file.endswith("_fine.xml")).to_xml() in mjcf_path(f"real/{file}").read_text()


@pytest.mark.parametrize("file", FILES)
def test_robots_hang_straight_without_commands(file):
    model, data = loaded(file)
    mujoco.mj_kinematics(model, data)
    straight = data.site_xpos.copy()
    np.testing.assert_allclose(settled(model, data).site_xpos, straight, atol=3e-4)
    tip = "tip" if file.startswith("opencr") else "disk3"
    reach = np.linalg.norm(data.site(tip).xpos - data.body("base").xpos)
    assert reach == pytest.approx(0.1945 if file.startswith("opencr") else sum(ASL.lengths), abs=1e-4)


@pytest.mark.parametrize("file", ["opencr_tdcr.xml", "opencr_tdcr_fine.xml"])
def test_a_load_at_the_tip_bends_the_backbone_as_beam_theory_says(file):
    """F a^2 (3 x - a) / (6 E I) at x, for a force at a, where tendons are slack."""
    model, data = loaded(file)
    data.ctrl[:] = -0.010  # m
    last, force = int(model.site("tip").bodyid[0]), 0.01
    settled(model, data)
    at, tip = float(data.body(last).xpos[2]), float(data.site("tip").xpos[2])
    data.xfrc_applied[last, 0] = force
    settled(model, data)
    expected = force * at**2 * (3 * tip - at) / (6 * OPENCR.bending)
    assert data.site("tip").xpos[0] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("file", ["opencr_tdcr.xml", "opencr_tdcr_fine.xml"])
def test_one_tendon_bends_the_robot_to_a_circular_arc(file):
    """Tension times radius is the moment everywhere; the way of the servo turns the tip and stretches the servo."""
    model, data = loaded(file)
    pulled, stiffness, pretension = 0.004, 7000.0, 3.87  # m, N/m, N
    data.ctrl[:], data.actuator("servo_6").ctrl = -0.010, pulled
    tip = settled(model, data).site("tip").xpos
    length, radius = sum(OPENCR.lengths), OPENCR.radius
    tension = (pulled + pretension / stiffness) / (radius**2 * length / OPENCR.bending + 1 / stiffness)
    angle = tension * radius * length / OPENCR.bending
    aside = length / angle * (1 - np.cos(angle)) + 0.008 * np.sin(angle)
    along = length / angle * np.sin(angle) + 0.008 * np.cos(angle)
    direction = np.arctan2(tip[1], tip[0])
    assert np.cos(direction - OPENCR.tendons[6].angle) == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose([np.hypot(tip[0], tip[1]), tip[2]], [aside, along], atol=1.5e-3)


def test_a_motor_of_the_trunk_pulls_one_tendon_and_lets_go_of_the_other():
    model, data = loaded("asl_trunk.xml")
    ends = []
    for sign in (1, -1):
        mujoco.mj_resetData(model, data)
        data.actuator("motor2").ctrl = 0.5 * sign
        settled(model, data, 600)
        ends.append(data.site("disk3").xpos - [0.1, 0, 0.105])
        both = [model.tendon(f"tendon2{side}").id for side in "ab"]
        assert list(data.ten_length[both] > model.tendon_lengthspring[both, 1]) == [sign > 0, sign < 0]
    assert np.degrees(np.arctan2(ends[0][2], ends[0][0])) == pytest.approx(-105, abs=2)
    np.testing.assert_allclose(ends[0][[0, 2]], -ends[1][[0, 2]], atol=1e-3)


@pytest.mark.parametrize("name", list(ROBOTS))
def test_the_mapping_fits_the_model_and_its_finer_one(name):
    one = robot(name)
    finer = one.accurate()
    assert [prior.name for prior in finer.priors] == [prior.name for prior in one.priors]
    assert finer.shape == one.shape


def test_the_robot_is_at_rest_when_a_sample_ends():
    """Halving and doubling the number of time steps moves the tip by less than 0.3 mm."""
    one = robot("opencr_tdcr")
    pulls = 1e-3 * np.abs(np.random.default_rng(0).normal(size=(20, 9))).cumsum(axis=0) / 4
    tips = [r.simulate(pulls, nominal(r), [()]) for r in (one, one.shortened(2))]
    np.testing.assert_allclose(*tips, atol=3e-4)


def test_the_model_is_near_the_recording_of_opencr_tdcr():
    """The authors' model, fitted to all of it, has 6.68 mm."""
    assert missed("opencr_tdcr", "v4_train.csv", 500, []) < 7.0


def test_the_model_is_near_the_recording_of_the_asl_trunk_if_commands_come_late():
    late = [Effect("actuator_delay", Location("actuator", "*"), {"delay": 0.22})]
    assert missed("asl_trunk", "servo_random1_0g.npz", 500, late) < 13.0
    assert missed("asl_trunk", "servo_random1_0g.npz", 500, []) > 25.0
