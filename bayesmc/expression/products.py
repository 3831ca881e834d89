"""Matrix products as sums of products: one element-wise product, one reduction.

Whoever evaluates sees a reduction of a product and may hand it to a matrix multiplication.
"""

from __future__ import annotations

import string
from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import graph
from bayesmc.expression.graph import Expression

#: products of the last axes -> how many of each operand's axes take part
PRODUCTS: dict[Any, tuple[int, int]] = {
    np.matmul: (2, 2),
    np.vecdot: (1, 1),
    np.matvec: (2, 1),
    np.vecmat: (1, 2),
}


def product(ufunc: Any, first: Expression, second: Expression) -> Expression:
    """``np.matmul``, ``np.vecdot``, ``np.matvec`` or ``np.vecmat`` of two expressions."""
    cores = list(PRODUCTS[ufunc])
    for k, node in enumerate((first, second)):
        if not node.shape:
            raise TraceError(f"np.{ufunc.__name__} of a scalar")
        if ufunc is np.matmul:
            cores[k] = min(len(node.shape), 2)
        elif len(node.shape) < cores[k]:
            raise TraceError(f"np.{ufunc.__name__} of a vector where a matrix belongs")
    left, right = {1: "j", 2: "ij"}[cores[0]], {1: "j", 2: "jk"}[cores[1]]
    lead = max(len(first.shape) - cores[0], len(second.shape) - cores[1])
    names = [c for c in string.ascii_letters if c not in "ijk"][:lead]
    own = [names[lead - (len(n.shape) - c) :] for n, c in zip((first, second), cores, strict=True)]
    out = [*names, *(c for c in left + right if c != "j")]
    return _summed([[*own[0], *left], [*own[1], *right]], [first, second], out)


def einsum(spec: Any, *operands: Any) -> Expression:
    """``np.einsum`` with a string that names every axis."""
    nodes = [graph.as_expression(getattr(x, "expression", x)) for x in operands]
    if not isinstance(spec, str):
        raise TraceError("np.einsum without a string of axes")
    given = spec.replace(" ", "").split("->")
    terms = given[0].split(",")
    ndim = max(len(n.shape) - len(t.replace("...", "")) for n, t in zip(nodes, terms, strict=True))
    free = [c for c in string.ascii_uppercase if c not in spec][: max(ndim, 0)]
    named = []
    for node, term in zip(nodes, terms, strict=True):
        count = len(node.shape) - len(term.replace("...", ""))
        if count < 0 or (count and "..." not in term):
            raise TraceError(f"np.einsum({spec!r}) of shape {node.shape}")
        before, dots, after = term.partition("...")
        named.append([*before, *(free[len(free) - count :] if dots else ()), *after])
    if len(given) > 1:
        before, dots, after = given[1].partition("...")
        out = [*before, *(free if dots else ()), *after]
    else:
        flat = [c for t in named for c in t]
        once = sorted(c for c in set(flat) if flat.count(c) == 1 and c not in free)
        out = [*(free if "..." in spec else ()), *once]
    return _summed(named, nodes, out)


# ---- private ------------------------------------------------------------------------------------


def _summed(
    terms: Sequence[Sequence[str]], nodes: Sequence[Expression], out: Sequence[str]
) -> Expression:
    """The product of operands whose axes have names, summed over those that are not in ``out``."""
    sizes: dict[str, int] = {}
    for term, node in zip(terms, nodes, strict=True):
        for name, size in zip(term, node.shape, strict=True):
            if sizes.get(name, 1) != size and size != 1 and sizes.get(name, 1) != 1:
                raise TraceError(f"a product of axes of sizes {sizes[name]} and {size}")
            sizes[name] = max(sizes.get(name, 1), size) if size else 0
    order = [*out, *sorted(set(sizes) - set(out))]
    found: Expression | None = None
    for term, node in zip(terms, nodes, strict=True):
        part = _aligned(node, term, order)
        found = part if found is None else graph.elementwise(np.multiply, found, part)
    assert found is not None
    whole = tuple(sizes[c] for c in order)
    if found.shape != whole:
        found = graph.broadcast(found, whole)
    return graph.reduction(np.add, found, range(len(out), len(order)))


def _aligned(node: Expression, term: Sequence[str], order: Sequence[str]) -> Expression:
    """An operand with its axes in order, of size 1 where it has none; repeated ones are the diagonal."""
    at = np.arange(node.size).reshape(node.shape)
    kept = [c for c in order if c in term]
    numbers = {c: k for k, c in enumerate(order)}
    at = np.einsum(at, [numbers[c] for c in term], [numbers[c] for c in kept])
    shape = iter(at.shape)
    return graph.pick([node], at.reshape([next(shape) if c in kept else 1 for c in order]))
