"""Fixtures that run a test for every environment, model and action mode."""

import pytest

import soro_bench  # before mujoco, which picks its OpenGL platform when it is imported
from soro_bench.envs.task import ACTION_MODES
from soro_bench.models.trunk import VARIANTS


@pytest.fixture(params=[env_id for env_id in soro_bench.ENV_IDS if env_id.startswith("Trunk")])
def env_id(request):
    return request.param


@pytest.fixture(params=VARIANTS)
def model(request):
    return request.param


@pytest.fixture(params=ACTION_MODES)
def action(request):
    return request.param
