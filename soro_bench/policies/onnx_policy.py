"""Policies as ONNX files: a small, checked subset, evaluated in NumPy by the reference evaluator of ONNX.

Everything that a stranger's file could misuse is refused before it is evaluated: other domains, functions, loops and
branches, data in other files, and values that grow without bounds. What is left takes seconds at most; a first action
shows whether it takes too long.
"""

import math
import time
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from soro_bench.arrays import Floats
from soro_bench.files import shown
from soro_bench.policies.policy import PolicyCard, check_observations

if TYPE_CHECKING:
    from onnx import ModelProto

MAX_BYTES = 5_000_000  # of a file; parsed, nodes without content take some seventy times as much
MAX_NODES = 1000
MAX_VALUES = 100_000  # numbers in all results of nodes together
MAX_SECONDS = 0.1  # for an action; a network of a few layers takes a hundredth of that
MAX_INTEGERS = 1000  # among the weights, for sizes and axes; NumPy multiplies matrices of them slowly
FIRST_OPSET = 13  # of older ones, shapes are inferred without broadcasting, and so too small
OPERATORS = frozenset({
    "Add", "ArgMax", "BatchNormalization", "Cast", "Clip", "Concat", "Constant", "Div", "Elu", "Erf", "Flatten", "Gelu",
    "Gemm", "Identity", "LayerNormalization", "LeakyRelu", "MatMul", "Max", "Min", "Mul", "Pow", "ReduceMean", "Relu",
    "Reshape", "Sigmoid", "Softmax", "Softplus", "Sqrt", "Squeeze", "Sub", "Tanh", "Transpose", "Unsqueeze",
})  # fmt: skip
_DOMAINS = ("", "ai.onnx")  # two names of the default one


class OnnxPolicy:
    """A network with one input (n, k) and one output: (n, m) floats, or n integers if it picks discrete actions itself.

    The observations are raw: what normalises them is in the network. k is the ``inputs`` of every policy.
    """

    suffix: ClassVar[str] = ".onnx"

    def __init__(self, card: PolicyCard, data: bytes, model: "ModelProto", source: str | Path):
        from onnx.reference import ReferenceEvaluator

        self.card, self._data, self._source = card, data, source
        entrance = model.graph.input[0]
        self._name, self.inputs = entrance.name, entrance.type.tensor_type.shape.dim[1].dim_value
        self._dtype = _FLOATS[entrance.type.tensor_type.elem_type]
        self._evaluator = ReferenceEvaluator(model)

    @classmethod
    def from_bytes(cls, card: PolicyCard, data: bytes, source: str | Path) -> "OnnxPolicy":
        """The policy in the content of an ONNX file; ``source`` is what errors call it. Nothing else is opened."""
        onnx = _onnx()
        if len(data) > MAX_BYTES:
            raise ValueError(f"{source} has {len(data)} bytes; at most {MAX_BYTES} are read")
        try:
            model = onnx.load_model_from_string(data)
            _check_parts(model)
            policy = cls(card, data, _with_known_shapes(onnx, model), source)
            policy._check_time()
        except Exception as error:  # whatever a stranger's bytes make of a protocol buffer
            raise ValueError(f"{source} holds no valid policy: {shown(str(error).split(chr(10))[0][:200])}") from error
        return policy

    def to_bytes(self) -> bytes:
        """The ONNX file."""
        return self._data

    def act(self, observations: Floats) -> NDArray[Any]:
        """Actions for (n, k) observations: (n,) integers if the action mode is discrete, else (n, nu) in [-1, 1]."""
        check_observations(observations, self.inputs)
        # one row at a time, so that an action does not depend on how many are asked for at once
        rows = [self._evaluated(row) for row in observations]
        found = np.stack([np.ravel(row) for row in rows])
        if not np.issubdtype(found.dtype, np.number) or not np.isfinite(found).all():
            raise ValueError(f"{self._source} answers with {found.ravel()[:3]}; finite numbers are needed")
        if self.card.action == "continuous":
            return np.clip(found, -1.0, 1.0)
        if found.shape[1] > 1:
            return found.argmax(axis=1)
        if not np.issubdtype(found.dtype, np.integer):
            raise ValueError(
                f"{self._source} answers with one float; one integer, or a number for every action is needed"
            )
        return found[:, 0]

    def _check_time(self) -> None:
        """ValueError if an action takes too long, twice: the first may wait for other work of the machine."""
        for _ in range(2):
            begin = time.perf_counter()
            self.act(np.zeros((1, self.inputs)))
            if (took := time.perf_counter() - begin) <= MAX_SECONDS:
                return
        raise ValueError(f"an action takes {took:.2g} s; allowed: {MAX_SECONDS:g} s")

    def _evaluated(self, observation: Floats) -> NDArray[Any]:
        """What the network answers to one observation (k,)."""
        (answer,) = self._evaluator.run(None, {self._name: observation[None].astype(self._dtype)})
        return np.asarray(answer)


_FLOATS = {1: np.float32, 11: np.float64}  # by TensorProto's number
_INTEGERS = (6, 7, 9)  # int32, int64 and bool


def _check_parts(model: "ModelProto") -> None:
    """ValueError if a model holds anything but nodes of the allowed operators and their weights."""
    domains = {o.domain for o in model.opset_import} | {node.domain for node in model.graph.node}
    if foreign := sorted(domains - set(_DOMAINS)):
        raise ValueError(f"it needs the operators of {foreign[0]!r}; only the default domain is allowed")
    if (oldest := min((o.version for o in model.opset_import), default=0)) < FIRST_OPSET:
        raise ValueError(f"it uses version {oldest} of the operators; allowed: {FIRST_OPSET} and later")
    if unknown := sorted({node.op_type for node in model.graph.node} - OPERATORS):
        raise ValueError(f"it has the operator {unknown[0]!r}; allowed: {', '.join(sorted(OPERATORS))}")
    if len(model.graph.node) > MAX_NODES:
        raise ValueError(f"it has {len(model.graph.node)} nodes; allowed: {MAX_NODES}")
    if model.functions or model.training_info or model.graph.sparse_initializer:
        raise ValueError("it has functions, training or sparse weights, which are not allowed")
    attributes = [attribute for node in model.graph.node for attribute in node.attribute]
    if any(a.HasField("g") or a.graphs or a.HasField("sparse_tensor") or a.sparse_tensors for a in attributes):
        raise ValueError("it has graphs or sparse weights in a node, which are not allowed")
    weights = [*model.graph.initializer, *(t for a in attributes for t in (a.t, *a.tensors))]
    if any(tensor.external_data or tensor.data_location for tensor in weights):
        raise ValueError("it has data in another file, which is not allowed")
    if any(tensor.data_type not in (0, *_FLOATS, *_INTEGERS) for tensor in weights):  # 0: there is none
        raise ValueError("it has weights of another type than float, double, int32, int64 and bool")
    if (count := sum(math.prod(t.dims) for t in weights if t.data_type in _INTEGERS)) > MAX_INTEGERS:
        raise ValueError(f"it has {count} integers among its weights; allowed: {MAX_INTEGERS}")
    names = [value.name for value in (*model.graph.input, *model.graph.initializer)]
    names += [name for node in model.graph.node for name in node.output]
    if len(names) > len(set(names)):
        raise ValueError("it gives a name twice")


def _with_known_shapes(onnx: ModuleType, model: "ModelProto") -> "ModelProto":
    """The model for one row of observations, whose results are known to be small before it is evaluated."""
    if len(model.graph.input) != 1 or len(model.graph.output) != 1:
        raise ValueError(f"it has {len(model.graph.input)} inputs and {len(model.graph.output)} outputs; allowed: one")
    entrance = model.graph.input[0].type.tensor_type
    if entrance.elem_type not in _FLOATS or len(entrance.shape.dim) != 2 or entrance.shape.dim[1].dim_value < 1:
        raise ValueError("its input is no array (n, k) of float or double with a fixed k")
    if (size := entrance.shape.dim[1].dim_value) > MAX_VALUES:
        raise ValueError(f"its input has {size} numbers; allowed: {MAX_VALUES}")
    onnx.checker.check_model(model)
    entrance.shape.dim[0].dim_value = 1
    # what the file says of shapes inside may be wrong
    del model.graph.value_info[:]
    model.graph.output[0].type.tensor_type.ClearField("shape")
    model = onnx.shape_inference.infer_shapes(model, check_type=True, strict_mode=True)
    _check_sizes(model)
    return model


def _check_sizes(model: "ModelProto") -> None:
    """ValueError if a row of observations would take much memory."""
    sizes = {}
    for value in (*model.graph.value_info, *model.graph.output):
        dims = value.type.tensor_type.shape.dim
        if value.type.tensor_type.HasField("shape") and all(dim.HasField("dim_value") for dim in dims):
            sizes[value.name] = float(np.prod([float(dim.dim_value) for dim in dims]))
    # the file's size bounds constants
    results = [name for node in model.graph.node if node.op_type != "Constant" for name in node.output]
    if unknown := [name for name in results if name not in sizes]:
        raise ValueError(f"the size of {unknown[0][:40]!r} depends on values; fixed sizes are needed")
    if (total := sum(sizes[name] for name in results)) > MAX_VALUES:
        raise ValueError(f"its nodes give {total:.3g} numbers; allowed: {MAX_VALUES}")


def _onnx() -> ModuleType:
    try:
        import onnx
        import onnx.checker
        import onnx.shape_inference
    except ImportError as error:
        raise ImportError("ONNX policies need onnx: pip install soro_bench[onnx]") from error
    return onnx
