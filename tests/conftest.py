"""Fixtures that run a test for every environment, model and action mode, commands as a shell would, and a trunk
as the diagnosis sees it."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

import soro_bench  # before mujoco, which picks its OpenGL platform when it is imported
from soro_bench.envs.task import ACTION_MODES
from soro_bench.models.trunk import VARIANTS


@pytest.fixture(params=[env_id for env_id in soro_bench.ENV_IDS if env_id.startswith("Trunk")])
def env_id(request: pytest.FixtureRequest) -> str:
    """Every environment of a trunk."""
    return request.param


@pytest.fixture(params=[env_id for env_id in soro_bench.ENV_IDS if re.match("Trunk(Reach|Push|Lift)", env_id)])
def published_id(request: pytest.FixtureRequest) -> str:
    """Every environment of a published task of the trunk."""
    return request.param


@pytest.fixture(params=VARIANTS)
def model(request: pytest.FixtureRequest) -> str:
    """Every model of the trunk."""
    return request.param


@pytest.fixture(params=ACTION_MODES)
def action(request: pytest.FixtureRequest) -> str:
    """Every action mode."""
    return request.param


@pytest.fixture
def make() -> Iterator[Callable[..., gymnasium.Env]]:
    """gymnasium.make that closes what it made."""
    made: list[gymnasium.Env] = []

    def make(*args: Any, **kwargs: Any) -> gymnasium.Env:
        made.append(gymnasium.make(*args, **kwargs))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command of soro-bench and return what it prints."""
    cli = pytest.importorskip("soro_bench.cli", reason="needs the train extra", exc_type=ImportError)

    def call(*arguments: object) -> str:
        monkeypatch.setattr("sys.argv", ["soro-bench", *map(str, arguments)])
        cli.main()
        return capsys.readouterr().out

    return call


@pytest.fixture(scope="module")
def robot() -> Any:
    """The cheap trunk."""
    suite_robot = pytest.importorskip("soro_bench.diagnosis.robots.suite_robot", reason="needs the infer extra")
    return suite_robot.SuiteRobot("TrunkReach-v0", threads=1)


@pytest.fixture(scope="module")
def actions() -> np.ndarray:
    """(50, 8) random actions of the trunk, each held for five control steps."""
    return np.repeat(np.random.default_rng(0).uniform(-1, 1, (10, 8)), 5, axis=0).astype(np.float32)


@pytest.fixture
def paths(tmp_path: Path) -> tuple[Path, Path]:
    """Of an arm's model and its mapping."""
    from tests.arm import ARM, MAP

    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "map.toml").write_text(MAP)
    return tmp_path / "arm.xml", tmp_path / "map.toml"


@pytest.fixture(scope="session")
def diagnosed_arm(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """An arm with friction that its model lacks: ``paths`` of model and mapping, ``recordings`` (fitted to, held out,
    new), and the ``result`` of its diagnosis."""
    from soro_bench.diagnosis.api import diagnose
    from soro_bench.diagnosis.robots.model_robot import ModelRobot
    from soro_bench.effects.effect import Effect, Location
    from tests.arm import ARM, MAP, recording

    folder = tmp_path_factory.mktemp("arm")
    paths = folder / "arm.xml", folder / "map.toml"
    paths[0].write_text(ARM)
    paths[1].write_text(MAP)
    hidden = [Effect("coulomb_friction", Location("joint", "hinge"), {"friction": 0.05})]
    recordings = tuple(recording(paths, hidden, seed) for seed in range(3))
    result = diagnose(ModelRobot(*paths, threads=1), recordings[:1], recordings[1:2])
    return SimpleNamespace(paths=paths, recordings=recordings, result=result)


@pytest.fixture
def robot_of(tmp_path: Path) -> Callable[..., Any]:
    """A function that makes the robot of a mapping, of the arm with a gripper or another model."""
    model_robot = pytest.importorskip("soro_bench.diagnosis.robots.model_robot", reason="needs the infer extra")
    from tests.arm import HAND

    def robot_of(mapping: str, model: str = HAND, **options: Any) -> Any:
        (tmp_path / "hand.xml").write_text(model)
        (tmp_path / "map.toml").write_text(mapping)
        return model_robot.ModelRobot(tmp_path / "hand.xml", tmp_path / "map.toml", threads=1, **options)

    return robot_of
