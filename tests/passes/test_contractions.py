"""Programs that reach BLAS and write over what is read no more: the same values, whatever the shapes."""

from __future__ import annotations

from typing import Any
from unittest import mock

import numpy as np
import pytest
from scipy import special

from bayesmc.expression import (
    Call,
    Elementwise,
    Expression,
    Program,
    TracedArray,
    as_expression,
    elementwise,
    leaf,
    ordered,
    reduction,
    trace,
)
from bayesmc.expression import buffers as rooms
from bayesmc.passes import contractions
from bayesmc.passes.arrays import for_arrays
from bayesmc.passes.choices import chosen
from bayesmc.passes.contractions import contracted
from bayesmc.passes.derivatives import gradient
from bayesmc.testing import session

RNG = np.random.default_rng(0)
DESIGN = RNG.normal(size=(50, 4))
SQUARE = RNG.normal(size=(4, 4))

#: of b (4,), w (50, 4), v (50,) -> whether it becomes a product of matrices
SUMS: dict[str, tuple[Any, bool]] = {
    "vecdot": (lambda b, w, v: np.vecdot(DESIGN, b), True),
    "matvec": (lambda b, w, v: np.matvec(DESIGN, b), True),
    "matmul": (lambda b, w, v: DESIGN @ b, True),
    "sum by hand": (lambda b, w, v: (DESIGN * b).sum(axis=-1), True),
    "rows": (lambda b, w, v: (DESIGN * v[..., :, None]).sum(axis=-2), True),
    "two that move": (lambda b, w, v: np.vecmat(v, w), True),
    "square": (lambda b, w, v: w @ SQUARE, True),
    "quadratic form": (lambda b, w, v: np.vecdot(DESIGN @ b, v), True),
    "einsum": (lambda b, w, v: np.einsum("...ij,...ik->...jk", w, w), True),
    "outer and sum": (lambda b, w, v: (v[..., :, None] * b[..., None, :]).sum(axis=-1), False),
    "row by row": (lambda b, w, v: (w * np.sin(w)).sum(axis=-1), False),
}
BATCHES = [
    ((), (), ()),
    ((3,), (3,), (3,)),
    ((3,), (), (1,)),
    ((2, 3), (3,), (2, 1)),
    ((), (5,), ()),
]


def traced(function: Any) -> Expression:
    leaves = {"b": (4,), "w": (50, 4), "v": (50,)}
    return trace(function, [TracedArray(leaf(n, s)) for n, s in leaves.items()])


@pytest.mark.parametrize("batches", BATCHES)
@pytest.mark.parametrize("name", SUMS)
def test_products_of_matrices_are_the_sums(name: str, batches: Any) -> None:
    function, is_product = SUMS[name]
    root = traced(function)
    made = contracted([root])
    calls = [n for n in ordered(*made) if isinstance(n, Call)]
    assert bool(calls) == is_product
    shapes = {"b": (4,), "w": (50, 4), "v": (50,)}
    for _ in range(8):  # code for known shapes is made on the way
        values = {
            n: RNG.normal(size=(*batch, *shape))
            for (n, shape), batch in zip(shapes.items(), batches, strict=True)
        }
        (wanted,), (found,) = Program([root])(values), Program(made)(values)
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12)


def test_a_wrong_order_of_axes_is_seen() -> None:
    """Negative control."""
    product = contractions._Product.__call__

    def turned(self: Any, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        found = product(self, a, b)
        return np.flip(found, axis=-1) if found.ndim else found

    with (
        mock.patch.object(contractions._Product, "__call__", turned),
        pytest.raises(AssertionError),
    ):
        test_products_of_matrices_are_the_sums("vecdot", BATCHES[1])


def random_sum(rng: np.random.Generator) -> Expression:
    """A number of large arrays, many of which are read once and some several times."""
    x, y = leaf("x", (40, 20)), leaf("y", (20,))
    nodes: list[Expression] = [x, y]
    unary = (np.exp, np.sin, np.negative, np.tanh, special.expit, special.log_expit, np.square)
    binary = (np.add, np.multiply, np.subtract, np.maximum)
    for _ in range(30):
        first = nodes[-1] if rng.random() < 0.6 else nodes[rng.integers(len(nodes))]
        if rng.random() < 0.5:
            made = elementwise(unary[rng.integers(len(unary))], first)
        else:
            second = nodes[rng.integers(len(nodes))]
            made = elementwise(binary[rng.integers(len(binary))], first, second)
        if rng.random() < 0.15 and made.shape == (40, 20):
            made = TracedArray(made)[::-1].expression
        nodes.append(elementwise(np.tanh, made))
    total = as_expression(0.0)
    for node in nodes[-4:]:
        total = elementwise(np.add, total, reduction(np.add, node, range(len(node.shape))))
    return total


def differs(seed: int) -> bool:
    """Whether the tenth call, on which arrays are written over, differs from the plain way."""
    rng = np.random.default_rng(seed)
    root = random_sum(rng)
    roots = [root, *gradient(root, ["x", "y"]).values()]
    program, plain = Program(for_arrays(roots)), Program(roots)
    values = {"x": rng.normal(size=(3, 40, 20)), "y": rng.normal(size=(3, 20))}
    given = {n: v.copy() for n, v in values.items()}
    wanted = plain(values)
    found = [program(values) for _ in range(10)]
    assert all(np.array_equal(values[n], given[n]) for n in given)
    return not all(
        np.allclose(a, b, rtol=1e-9, atol=1e-9)
        for some in (found[0], found[-1])
        for a, b in zip(some, wanted, strict=True)
    )


SEEDS = range(session.seed(), session.seed() + session.scaled(40, 8))


def test_what_is_written_over_is_of_no_use_any_more() -> None:
    assert not any(map(differs, SEEDS))


def test_writing_over_what_is_still_read_is_seen() -> None:
    """Negative control: the last reader is taken for the first."""
    first: dict[Any, Any] = {}

    def greedy(self: Any, node: Any) -> Any:
        shape = np.shape(self._values[node])
        if not (isinstance(node, Elementwise) and isinstance(node.function, np.ufunc)):
            return None
        for operand in node.operands:
            if isinstance(operand, Elementwise) and np.shape(self._values[operand]) == shape:
                return first.setdefault(operand, operand) if node.dtype == float and shape else None
        return None

    with mock.patch.object(rooms.Buffers, "place_for", greedy):
        assert any(map(differs, SEEDS))


def test_zeros_and_ones_take_one_sigmoid() -> None:
    y = np.array([1, 0, 1])
    x = TracedArray(leaf("x", (3,)))
    one, zero = special.log_expit(x), special.log_expit(-x)
    nested = np.where(y == 0, zero, -np.inf).expression
    found = chosen(as_expression(y == 1), one.expression, nested)
    assert found is not None and found.function is special.log_expit
    values = {"x": np.array([0.3, -2.0, 50.0])}
    wanted = special.log_expit(values["x"] * [1, -1, 1])
    np.testing.assert_allclose(Program([found])(values)[0], wanted, rtol=1e-14)
    # a third state keeps its own branch
    assert (
        chosen(as_expression(y == 1), one.expression, np.where(y > 2, zero, 0.0).expression) is None
    )


def test_a_product_with_a_known_zero_is_left_alone_where_it_may_be_infinite() -> None:
    n = np.array([0.0, 2.0])
    x = TracedArray(leaf("x", (2,)))
    finite = (n * special.log_expit(x)).expression
    unbounded = (n * np.log(x)).expression
    assert chosen(as_expression(n == 0), as_expression(np.zeros(2)), finite) is finite
    assert chosen(as_expression(n == 0), as_expression(np.zeros(2)), unbounded) is None
