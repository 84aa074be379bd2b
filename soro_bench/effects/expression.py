"""Expressions as data: trees of numbers, names and a few functions, bounded in size and never run as code.

In JSON a tree is a number, a name (of a parameter, a variable or a state), or a list: a function and its arguments,
``["multiply", "k", "q", ["abs", "q"]]``; or a sum of bumps, ``["bumps", NAMES, WIDTHS, ROWS]``. Values are arrays; what
comes out is ``bounded``.
"""

import functools
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from soro_bench.arrays import Floats
from soro_bench.files import brief

Node: TypeAlias = "float | str | tuple[Any, ...] | Bumps"  # a number, a name, a function with its arguments, or bumps

MOST_NODES = 64
DEEPEST = 10
LARGEST = 1e9  # of numbers, and of all values
_LARGEST_EXPONENT = 6.0
_LEAST_BASE = 1e-6  # of powers, which may be negative
_NAME = 24  # characters
_BUMPS = "bumps"
_MOST_NAMES, MOST_BUMPS = 4, 64  # that bumps are of, and of bumps
_LEAST_WIDTH = 1e-9


class LawError(ValueError):
    """A law that is given as data is not as expected."""


@dataclass(frozen=True)
class Bumps:
    """A sum of Gaussian bumps, sum_i w_i exp(-sum_k ((x_k - c_ik) / s_k)^2 / 2): a black box of a few variables.

    names: (K,) of the variables x. widths: (K,) s. rows: of each bump its centre c (K numbers), then its weight w.
    """

    names: tuple[str, ...]
    widths: tuple[float, ...]
    rows: tuple[tuple[float, ...], ...]

    @functools.cached_property
    def _numbers(self) -> tuple[Floats, Floats]:
        """(K, n) centres in widths and (n,) weights."""
        numbers = np.array(self.rows).T
        return numbers[:-1] / np.array(self.widths)[:, None], numbers[-1]

    def value(self, values: Mapping[str, Floats]) -> Floats:
        """(n,) of it, from values (n,) by names."""
        centres, weights = self._numbers
        squares: Any = 0.0
        for name, width, centre in zip(self.names, self.widths, centres, strict=True):
            squares = squares + (np.asarray(values[name])[..., None] / width - centre) ** 2
        # no product of matrices, whose rounding depends on how many rows there are
        return np.asarray((np.exp(-0.5 * squares) * weights).sum(axis=-1))


def _product(*values: Floats) -> Floats:
    return functools.reduce(operator.mul, values)


def _sum(*values: Floats) -> Floats:
    return functools.reduce(operator.add, values)


def _power(value: Floats, exponent: Floats) -> Floats:
    exponent = np.clip(exponent, -_LARGEST_EXPONENT, _LARGEST_EXPONENT)
    return np.exp(exponent * np.log(np.maximum(np.abs(value), _LEAST_BASE)))


# name: how many arguments (least, most), and what it does
FUNCTIONS: Mapping[str, tuple[int, int, Callable[..., Floats]]] = {
    "add": (2, 12, _sum),
    "multiply": (2, 6, _product),
    "abs": (1, 1, np.abs),
    "sign": (2, 2, lambda value, width: np.tanh(value / np.maximum(np.abs(width), 1e-9))),
    "positive": (1, 1, lambda value: np.maximum(value, 0.0)),
    "negative": (1, 1, lambda value: np.minimum(value, 0.0)),
    "power": (2, 2, _power),
    "tanh": (1, 1, np.tanh),
    "sin": (1, 1, np.sin),
    "cos": (1, 1, np.cos),
    "exp": (1, 1, lambda value: np.exp(np.clip(value, -20.0, 20.0))),
}


def bounded(values: Floats) -> Floats:
    """The values, none above ``LARGEST``; 0 for what is no number."""
    return np.nan_to_num(np.maximum(np.minimum(values, LARGEST), -LARGEST))


def parsed(data: object, names: frozenset[str], where: str) -> Node:
    """The tree that JSON describes.

    Args:
        names: that it may use. where: what it is, for errors.

    Raises:
        LawError: says what is wrong.
    """
    count = [0]
    return _parsed(data, names, where, 1, count)


def _parsed(data: object, names: frozenset[str], where: str, depth: int, count: list[int]) -> Node:
    count[0] += 1
    if count[0] > MOST_NODES:
        raise LawError(f"{where} has more than {MOST_NODES} numbers, names and functions")
    if depth > DEEPEST:
        raise LawError(f"{where} is nested more than {DEEPEST} deep")
    if isinstance(data, str):
        if data not in names:
            raise LawError(f"{where} has the name {brief(data)}; there are {', '.join(sorted(names)) or 'none'}")
        return data
    if isinstance(data, list):
        if data and data[0] == _BUMPS:
            return _bumps(data, names, where)
        if not data or not isinstance(data[0], str) or data[0] not in FUNCTIONS:
            there_are = ", ".join([*FUNCTIONS, _BUMPS])
            raise LawError(f"{where} has the function {brief(data[:1])}; there are {there_are}")
        least, most, _ = FUNCTIONS[data[0]]
        if not least <= len(data) - 1 <= most:
            allowed = f"{least}" if least == most else f"{least} to {most}"
            raise LawError(f"{data[0]} in {where} has {len(data) - 1} arguments; it takes {allowed}")
        return (data[0], *(_parsed(each, names, where, depth + 1, count) for each in data[1:]))
    return number(data, f"a number in {where}")


def _bumps(data: list[object], names: frozenset[str], where: str) -> Bumps:
    lists = [each for each in data[1:] if isinstance(each, list)]
    if len(data) != 4 or len(lists) != 3:
        raise LawError(f"{_BUMPS} in {where} is {brief(data)}; it has three lists: of names, of widths, and of rows")
    of, widths, rows = lists
    if not 1 <= len(of) <= _MOST_NAMES or len(widths) != len(of) or not 1 <= len(rows) <= MOST_BUMPS:
        raise LawError(f"{_BUMPS} in {where} has {len(of)} names, {len(widths)} widths and {len(rows)} rows; "
                       f"allowed are 1 to {_MOST_NAMES} names, as many widths, and 1 to {MOST_BUMPS} rows")  # fmt: skip
    if unknown := [each for each in of if not isinstance(each, str) or each not in names]:
        raise LawError(f"{_BUMPS} in {where} has the name {brief(unknown[0])}; there are {', '.join(sorted(names))}")
    for row in rows:
        if not isinstance(row, list) or len(row) != len(of) + 1:
            raise LawError(f"a row of {_BUMPS} in {where} is {brief(row)}; expected are {len(of)} numbers and a weight")
    sizes = tuple(number(each, f"a width in {where}") for each in widths)
    if min(sizes) < _LEAST_WIDTH:
        raise LawError(f"a width of {_BUMPS} in {where} is {min(sizes):g}; allowed is {_LEAST_WIDTH:g} and more")
    found = tuple(tuple(number(each, f"a number in {where}") for each in row) for row in rows)
    return Bumps(tuple(map(str, of)), sizes, found)


def number(data: object, where: str) -> float:
    """A finite number that is not too large; LawError for anything else."""
    valid = isinstance(data, (int, float)) and not isinstance(data, bool)
    if not valid or not abs(data) <= LARGEST:  # type: ignore[arg-type]
        raise LawError(f"{where} is {brief(data)}; expected is a number, {LARGEST:g} at most")
    return float(data)  # type: ignore[arg-type]


def name_of(data: object, where: str) -> str:
    """A short name of letters, digits and underscores; LawError for anything else."""
    if not isinstance(data, str) or not data.isidentifier() or not data.isascii() or len(data) > _NAME:
        raise LawError(f"{where} is named {brief(data)}; names have letters, digits and _, {_NAME} at most")
    return data


def evaluated(node: Node, values: Mapping[str, Floats]) -> Floats:
    """(n,) of a tree, from values (n,) by names."""
    if isinstance(node, str):
        return values[node]
    if isinstance(node, Bumps):
        return node.value(values)
    if isinstance(node, tuple):
        return FUNCTIONS[node[0]][2](*(evaluated(each, values) for each in node[1:]))
    return np.asarray(node)


def to_json(node: Node) -> Any:
    """As ``parsed`` reads it."""
    if isinstance(node, Bumps):
        return [_BUMPS, list(node.names), list(node.widths), [list(row) for row in node.rows]]
    return [to_json(each) for each in node] if isinstance(node, tuple) else node


def names_in(node: Node) -> set[str]:
    """Names that a tree uses."""
    if isinstance(node, Bumps):
        return set(node.names)
    if isinstance(node, str):
        return {node}
    return {name for each in node[1:] for name in names_in(each)} if isinstance(node, tuple) else set()


def bumps_in(node: Node) -> list[Bumps]:
    """Bumps that a tree has."""
    if isinstance(node, Bumps):
        return [node]
    return [found for each in node[1:] for found in bumps_in(each)] if isinstance(node, tuple) else []


def functions_in(node: Node) -> set[str]:
    """Functions that a tree uses."""
    if not isinstance(node, tuple):
        return set()
    return {node[0]}.union(*(functions_in(each) for each in node[1:]))


def written(node: Node, symbols: Mapping[str, str]) -> str:
    """A tree as one line of text.

    Args:
        symbols: what stands for a name, such as the value of a parameter; the name itself where there is none.
    """
    if isinstance(node, str):
        return symbols.get(node, node)
    if isinstance(node, Bumps):
        return f"g({', '.join(node.names)})"
    if not isinstance(node, tuple):
        return f"{node:.4g}"
    name, arguments = node[0], [written(each, symbols) for each in node[1:]]
    if name == "add":
        return " + ".join(arguments).replace("+ -", "- ")
    if name == "multiply":
        return " ".join(f"({a})" if _is(each, "add") else a for a, each in zip(arguments, node[1:], strict=True))
    if name == "abs":
        return f"|{arguments[0]}|"
    if name == "power":
        return f"|{arguments[0]}|^{arguments[1]}"
    if name == "sign":
        return f"sign({arguments[0]})"
    if name in ("positive", "negative"):
        return f"{'max' if name == 'positive' else 'min'}({arguments[0]}, 0)"
    return f"{name}({', '.join(arguments)})"


def _is(node: Node, function: str) -> bool:
    return isinstance(node, tuple) and node[0] == function
