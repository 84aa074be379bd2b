"""What the answers of a diagnosis are worth, and the verdict."""

from types import SimpleNamespace

import pytest

from soro_bench.diagnosis import compare
from soro_bench.diagnosis.pipeline import Diagnosis, Outliers
from soro_bench.diagnosis.suspects import Suspect
from soro_bench.effects.effect import Port


def test_a_lead_like_those_of_nulls_is_no_detection():
    assert compare.p_value(100.0) > 0.1
    assert compare.p_value(1000.0) < 1e-3


@pytest.mark.parametrize(
    ("answers", "unknown", "verdict"),
    [
        ([(0.8, "none"), (0.1, "payload")], 0.1, "none_detected"),
        ([(0.3, "payload"), (0.2, "none")], 0.5, "unknown_physics"),
        ([(0.35, "payload"), (0.2, "none")], 0.45, "unknown_physics"),
        ([(0.3, "payload"), (0.3, "payload"), (0.0, "none")], 0.4, "missing_physics"),
        ([(0.6, "sensor_delay"), (0.1, "none")], 0.3, "measurement_fault"),
    ],
)
def test_the_verdict_is_what_is_likeliest(answers, unknown, verdict):
    def answer(chance, name):
        where = Port("sensor", "keypoints") if name == "sensor_delay" else Port("body", "vertebra4")
        some = () if name == "none" else (Suspect(name, where, (0.1,), (True,)),)
        names = tuple(s.name for s in some)
        return SimpleNamespace(probability=chance, names=names, hypothesis=SimpleNamespace(suspects=some))

    comparison = compare.Comparison(tuple(answer(*each) for each in answers), unknown, 0.0)
    found = Diagnosis(None, (), Outliers(0.0, 0.0), None, comparison, (), None, 0.0)
    assert found.verdict == verdict
