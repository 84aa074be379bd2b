"""Laws outside the catalogue: what a grammar's terms remember, and laws found by regression and replays."""

from dataclasses import replace

import numpy as np
import pytest

from soro_bench.diagnosis.discovery.discovery import discovered
from soro_bench.diagnosis.discovery.library import Term, series
from soro_bench.diagnosis.estimation.fit import Guess, allowing, fitted
from soro_bench.diagnosis.localisation.ranking import ranked_locations
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.custom_law import Memory
from soro_bench.effects.effect import effect_from
from soro_bench.effects.expression import names_in
from tests.arm import ARM, MAP, problem
from tests.test_custom_laws import law


@pytest.mark.parametrize(
    ("of", "expected"),
    [
        ("lag", lambda t: t - 0.2 * (1 - np.exp(-t / 0.2))),
        ("maxwell", lambda t: 0.2 * (1 - np.exp(-t / 0.2))),
        ("play", lambda t: np.maximum(t - 0.1, 0.0)),
        ("bouc_wen", lambda t: 1 - np.exp(-t / 0.2)),
    ],
)
def test_a_term_remembers_along_each_recording(of, expected):
    """Two recordings of the same ramp: the second one begins anew."""
    time = 0.001 * np.arange(400)
    term = Term("z", "1", (), (Memory("z", of, "q", "w"),), ())
    found = series(term, {"q": np.tile(time, 2), "w": np.asarray(0.2)}, [400, 400], 0.001)
    assert np.array_equal(*np.split(found, 2))
    assert found[:400] == pytest.approx(expected(time), abs=2e-3)


@pytest.fixture
def paths(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "arm.toml").write_text(MAP)
    return tmp_path / "arm.xml", tmp_path / "arm.toml"


def test_a_spring_of_one_side_is_written_down_and_holds_on_what_was_not_fitted(paths):
    """It resists only where the angle is positive; no law of the catalogue does."""
    hidden = law(["multiply", -0.8, ["positive", "q"]], {"q": {"of": "position"}})
    effect = {"name": "custom", "location": {"kind": "joint", "name": "hinge"}, "parameters": {}, "law": hidden}
    given = problem(paths, [effect_from(effect, ALL)], steps=225)
    (base,) = fitted(given, [Guess(np.zeros(3))], (0.7, 0.3, 0.1), seed=0)
    given, (base,) = allowing(given, base, [base])
    ranked = [each for each in ranked_locations(given, given.robot, base) if each.location.kind == "body"]
    found = discovered(given, None, given.robot, base, base, ranked, seed=0)
    assert found is not None and found.best is not None
    (written,) = found.best.hypothesis.effects(3)
    assert {each.of for each in written.law.variables if each.name in names_in(written.law.expression)} == {"position"}
    assert found.own_test
    assert found.explained > 0.9
    again = effect_from(written.to_json(), ALL)
    assert replace(again, parameters=written.parameters) == written
