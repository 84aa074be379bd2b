"""Laws outside the catalogue: what a grammar's terms remember, and laws found by regression and replays."""

from dataclasses import replace

import numpy as np
import pytest

from soro_bench.diagnosis.discovery.discovery import discovered
from soro_bench.diagnosis.discovery.library import Term, series
from soro_bench.diagnosis.estimation.fit import Guess, allowing, fitted
from soro_bench.diagnosis.localisation.ranking import ranked_locations
from soro_bench.diagnosis.render.html import html
from soro_bench.diagnosis.render.summary import summary
from soro_bench.diagnosis.result import Result
from soro_bench.diagnosis.result_parts import DiscoveredLaw, Estimate
from soro_bench.effects.catalogue import ALL
from soro_bench.effects.custom_law import Memory
from soro_bench.effects.effect import effect_from
from soro_bench.effects.expression import names_in
from tests.arm import ARM, MAP, problem
from tests.results import outside_catalogue
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


def test_a_result_says_the_law_its_ranges_and_what_it_explains():
    effect = effect_from(
        {"name": "custom", "location": {"kind": "joint", "name": "hinge"}, "parameters": {"c": -0.8},
         "law": law(["multiply", "c", ["positive", "q"]], {"q": {"of": "position", "range": [-0.5, 0.7]}})}, ALL
    )  # fmt: skip
    assert effect.law is not None
    told = DiscoveredLaw(
        location=effect.location, effects=(effect.to_json(),), equations=(effect.law.equation(effect.parameters),),
        legend=effect.law.legend(), estimates=(Estimate("c", -0.8, "N m/rad", -0.9, -0.7),), explained=0.96,
        noise_share=0.001, nearest=0.4, own_test=False, others=(), state=(0.0, 0.5), force=(0.0, -0.41),
        law=(0.0, -0.4), state_label="position [rad]", force_label="input [N m]", peak=0.5,
    )  # fmt: skip
    result = replace(outside_catalogue(), discovery=told)
    assert Result.from_json(result.to_json()).discovery == told
    for text in (" ".join(summary(result).split()), " ".join(html(result).split())):
        assert "outside the catalogue, described by F = -0.8 max(q, 0)" in text
        assert "position, seen from -0.5 to 0.7" in text
        assert "96.0 % of the squared error (0.1 % is noise), the nearest law of the catalogue 40.0 %" in text
    nothing = replace(result, discovery=replace(told, effects=(), equations=(), estimates=()))
    assert "Its spectrum peaks at 0.5 Hz" in " ".join(summary(nothing).replace("\u00a0", " ").split())
