"""Policies as ONNX files: the same actions as the network's, and nothing else in the file."""

from itertools import pairwise

import numpy as np
import pytest

pytest.importorskip("onnx", reason="needs the onnx extra")

from onnx import TensorProto, helper, numpy_helper

from soro_bench.policies.onnx_policy import MAX_NODES, OnnxPolicy
from soro_bench.policies.policy import Policy, PolicyCard
from tests.test_bad_input import says

INPUTS, HIDDEN, OUTPUTS = 5, 7, 3


def card(action="continuous"):
    return PolicyCard("TrunkReach-v0", "cable", action, "oracle", 0, 1000)


def tensors():
    rng = np.random.default_rng(0)
    return {"mean": rng.normal(size=INPUTS), "std": rng.uniform(1, 2, INPUTS), "w0": rng.normal(size=(HIDDEN, INPUTS)),
            "b0": rng.normal(size=HIDDEN), "w1": rng.normal(size=(OUTPUTS, HIDDEN)),
            "b1": rng.normal(size=OUTPUTS)}  # fmt: skip


NODES = [
    helper.make_node("Sub", ["observation", "mean"], ["centred"]),
    helper.make_node("Div", ["centred", "std"], ["scaled"]),
    helper.make_node("Gemm", ["scaled", "w0", "b0"], ["first"], transB=1),
    helper.make_node("Tanh", ["first"], ["hidden"]),
    helper.make_node("Gemm", ["hidden", "w1", "b1"], ["answer"], transB=1),
]


def model(nodes=(), output="answer", kind=TensorProto.DOUBLE, opsets=(("", 17),), shape=("n", INPUTS), **more):
    """The network of ``tensors``, with further nodes after it."""
    weights = [numpy_helper.from_array(value, name) for name, value in tensors().items()]
    graph = helper.make_graph(
        [*NODES, *nodes],
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.DOUBLE, shape)],
        [helper.make_tensor_value_info(output, kind, ("n", "m"))],
        [*weights, *more.pop("weights", ())],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid(*opset) for opset in opsets], **more)


def loaded(made, action="continuous"):
    return OnnxPolicy.from_bytes(card(action), made.SerializeToString(), "policy.onnx")


@pytest.mark.parametrize("action", ["continuous", "discrete"])
def test_actions_are_those_of_the_same_network_in_numpy(action):
    """Of a batch as of each row alone, bit for bit."""
    observations = np.random.default_rng(1).normal(size=(20, INPUTS))
    policy = loaded(model(), action)
    found = policy.act(observations)
    np.testing.assert_allclose(found, Policy(card(action), tensors()).act(observations), atol=1e-12)
    assert found.tobytes() == np.concatenate([policy.act(row[None]) for row in observations]).tobytes()
    assert np.abs(found).max() > 0


def test_a_network_may_pick_its_discrete_action_itself():
    made = model([helper.make_node("ArgMax", ["answer"], ["picked"], axis=1)], "picked", TensorProto.INT64)
    observations = np.random.default_rng(1).normal(size=(20, INPUTS))
    np.testing.assert_array_equal(
        loaded(made, "discrete").act(observations), loaded(model(), "discrete").act(observations)
    )


def test_of_integers_for_all_discrete_actions_the_largest_counts_and_one_float_is_refused():
    rounded = [helper.make_node("Mul", ["answer", "many"], ["larger"]),
               helper.make_node("Cast", ["larger"], ["whole"], to=TensorProto.INT64)]  # fmt: skip
    made = model(rounded, "whole", TensorProto.INT64, weights=[numpy_helper.from_array(np.array(1e6), "many")])
    observations = np.random.default_rng(1).normal(size=(20, INPUTS))
    expected = loaded(model(), "discrete").act(observations)
    np.testing.assert_array_equal(loaded(made, "discrete").act(observations), expected)
    mean = model([helper.make_node("ReduceMean", ["answer"], ["mean_answer"], axes=[-1])], "mean_answer")
    with pytest.raises(ValueError, match=says("one float", "a number for every action")):
        loaded(mean, "discrete")


def test_networks_may_be_normalised_between_layers():
    """Layer normalisation, whole as PyTorch 2 exports it, and in parts as older exporters do."""
    ones, zeros = np.ones(OUTPUTS), np.zeros(OUTPUTS)
    weights = [numpy_helper.from_array(value, name) for name, value in {
        "ones": ones, "zeros": zeros, "two": np.array(2.0), "tiny": np.array(1e-5)}.items()]  # fmt: skip
    whole = [helper.make_node("LayerNormalization", ["answer", "ones", "zeros"], ["normal"], axis=-1, epsilon=1e-5)]
    parts = [
        helper.make_node("ReduceMean", ["answer"], ["mid"], axes=[-1]),
        helper.make_node("Sub", ["answer", "mid"], ["off"]),
        helper.make_node("Pow", ["off", "two"], ["square"]),
        helper.make_node("ReduceMean", ["square"], ["variance"], axes=[-1]),
        helper.make_node("Add", ["variance", "tiny"], ["sum"]),
        helper.make_node("Sqrt", ["sum"], ["width"]),
        helper.make_node("Div", ["off", "width"], ["normal"]),
    ]
    observations = np.random.default_rng(1).normal(size=(20, INPUTS))
    plain = Policy(card(), {**tensors()})
    answer = (observations - plain.tensors["mean"]) / plain.tensors["std"]
    answer = np.tanh(answer @ plain.tensors["w0"].T + plain.tensors["b0"]) @ plain.tensors["w1"].T + plain.tensors["b1"]
    off = answer - answer.mean(axis=1, keepdims=True)
    expected = np.clip(off / np.sqrt((off**2).mean(axis=1, keepdims=True) + 1e-5), -1, 1)
    for nodes in (whole, parts):
        made = model(nodes, "normal", weights=weights)
        np.testing.assert_allclose(loaded(made).act(observations), expected, atol=1e-6)


def test_its_bytes_are_written_as_they_came():
    data = model().SerializeToString()
    assert OnnxPolicy.from_bytes(card(), data, "policy.onnx").to_bytes() == data


def _external():
    made = model()
    weight = made.graph.initializer[2]
    weight.ClearField("raw_data")
    weight.data_location = TensorProto.EXTERNAL
    weight.external_data.add(key="location", value="/etc/passwd")
    return made


def _loop():
    body = helper.make_graph([], "body", [], [])
    return model([helper.make_node("Loop", ["", "", "answer"], ["again"], body=body)], "again")


def _function():
    function = helper.make_function("", "Tanh", ["x"], ["y"], [helper.make_node("Neg", ["x"], ["y"])],
                                    [helper.make_opsetid("", 17)])  # fmt: skip
    return model(functions=[function])


def _doubling(times):
    """A value that is twice as long with every node."""
    names = ["answer", *(f"long{i}" for i in range(times))]
    return model([helper.make_node("Concat", [a, a], [b], axis=1) for a, b in pairwise(names)],
                 names[-1])  # fmt: skip


def _lying():
    made = _doubling(30)
    for name in ("long20", "long29"):
        made.graph.value_info.append(helper.make_tensor_value_info(name, TensorProto.DOUBLE, (1, 3)))
    return made


def _values_that_double(times):
    """Integers of a weight, which inference of shapes might follow."""
    names = ["sizes", *(f"long{i}" for i in range(times))]
    nodes = [helper.make_node("Concat", [a, a], [b], axis=0) for a, b in pairwise(names)]
    nodes += [helper.make_node("Reshape", ["answer", names[-1]], ["again"])]
    return model(nodes, "again", weights=[numpy_helper.from_array(np.ones(2, np.int64), "sizes")])


def _much_to_multiply(kind, count=1, rows=300, columns=300):
    """A small file with products of two large matrices."""
    sides = {"left": np.zeros((rows, columns), kind), "right": np.zeros((columns, rows), kind)}
    nodes = [helper.make_node("MatMul", ["left", "right"], [f"much{i}"]) for i in range(count)]
    nodes += [helper.make_node("Identity", ["answer"], ["again"])]
    return model(nodes, "again", weights=[numpy_helper.from_array(value, name) for name, value in sides.items()])


def _shape_from_input():
    nodes = [
        helper.make_node("Cast", ["observation"], ["sizes"], to=TensorProto.INT64),
        helper.make_node("Squeeze", ["sizes"], ["size"]),
        helper.make_node("Reshape", ["answer", "size"], ["again"]),
    ]
    return model(nodes, "again")


def _nan():
    made = model()
    made.graph.initializer[1].CopyFrom(numpy_helper.from_array(np.full(INPUTS, np.nan), "std"))
    return made


@pytest.mark.parametrize(
    ("make", "parts"),
    [
        (_external, ("data in another file",)),
        (_loop, ("operator 'Loop'", "Gemm")),
        (lambda: model([helper.make_node("Mine", ["answer"], ["y"], domain="com.example")], "y"), ("'com.example'",)),
        (lambda: model(opsets=(("", 17), ("com.example", 1))), ("'com.example'", "default domain")),
        (_function, ("functions",)),
        (lambda: _doubling(30), ("numbers; allowed: 100000",)),
        (_lying, ("numbers; allowed: 100000",)),
        (lambda: _doubling(MAX_NODES), ("nodes; allowed: 1000",)),
        (_shape_from_input, ("fixed sizes are needed",)),
        (lambda: _values_that_double(30), ("fixed sizes are needed",)),
        (lambda: _much_to_multiply(np.float32, 200, 5, 120_000), ("an action takes", "allowed: 0.1 s")),
        (lambda: _much_to_multiply(np.float16), ("another type than float",)),
        (lambda: _much_to_multiply(np.int64), ("180000 integers among its weights; allowed: 1000",)),
        (lambda: model(opsets=(("", 6),)), ("version 6 of the operators", "13 and later")),
        (lambda: model([helper.make_node("Identity", ["hidden"], ["answer"])]), ("a name twice",)),
        (lambda: model(shape=("n", "k")), ("no array (n, k)",)),
        (lambda: model(shape=(INPUTS,)), ("no array (n, k)",)),
        (lambda: model(shape=("n", 2_000_000_000)), ("input has 2000000000 numbers",)),
        (_nan, ("answers with", "finite")),
    ],
)
def test_a_file_that_could_do_more_than_a_network_is_refused(make, parts):
    with pytest.raises(ValueError, match=says("policy.onnx holds no valid policy", *parts)):
        loaded(make())


def test_a_file_that_is_too_large_to_be_parsed_is_refused():
    with pytest.raises(ValueError, match=says("policy.onnx has 5000001 bytes; at most 5000000 are read")):
        OnnxPolicy.from_bytes(card(), bytes(5_000_001), "policy.onnx")


@pytest.mark.parametrize("data", [b"", b"\x80\x04pickle", b"\x00" * 100, model().SerializeToString()[:300]])
def test_bytes_that_are_no_model_are_refused(data):
    with pytest.raises(ValueError, match=says("policy.onnx holds no valid policy")):
        OnnxPolicy.from_bytes(card(), data, "policy.onnx")


def test_observations_of_another_size_are_refused_in_words():
    with pytest.raises(ValueError, match="observations of 5 numbers; these have 6"):
        loaded(model()).act(np.zeros((2, 6)))
