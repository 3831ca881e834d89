"""Whether what was read of a function gives what the function gives, at probe points."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, as_distribution
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, TraceError
from bayesmc.expression import Expression, Program, rebuilt
from bayesmc.network.model import CompiledNode, Model
from bayesmc.shapes import Shape, nearly_equal

#: how far an expression may be off what the function gives, relative to the largest entry
_RTOL = 1e-11


class Probe(dict[str, np.ndarray]):
    """Stored values of all nodes at probe points; of deterministic ones as they are asked for."""

    def __init__(self, model: Model, variant: int) -> None:
        super().__init__()
        self.model, self.variant = model, variant
        self._place = {n: k for k, n in enumerate(model.nodes)}

    @classmethod
    def of(cls, model: Model, variant: int) -> Probe:
        known = model.cache.setdefault("expression probes", {})
        if variant not in known:
            known[variant] = cls(model, variant)
        return known[variant]

    def __missing__(self, name: str) -> np.ndarray:
        node = self.model[name]
        if node.kind == "deterministic":
            for above in deterministic_above(self.model, name, self):
                self[above] = self.model.evaluate(above, self)[0]
            value = self.model.evaluate(name, self)[0]
        else:
            value = self.model.probe[name]
            rank = value.ndim - len(node.value_shape)
            value = VARIANTS[self.variant](value, rank, self._place[name])
        self[name] = value
        return value


#: unlike batch shapes: all of the probe, one entry, mixed ranks; that a function gives the same whatever
#: the rank is for ``validate`` to see
VARIANTS: tuple[Callable[[np.ndarray, int, int], np.ndarray], ...] = (
    lambda v, rank, _: v,
    lambda v, rank, _: v[(0,) * rank],
    lambda v, rank, k: (v, v[0], v[:, :1], v[0, 0])[k % 4] if rank == 2 else v,
)


def deterministic_above(model: Model, name: str, known: Container[str]) -> list[str]:
    """Deterministic nodes above one that are not known, those first on which others depend."""
    found: dict[str, None] = {}
    todo = [(name, False)]
    while todo:
        above, is_done = todo.pop()
        if is_done:
            found[above] = None
            continue
        if above != name:
            todo.append((above, True))
        parents = (
            model[above].parents if above in model.nodes else model.potentials[above][0].parents
        )
        todo += [
            (p, False)
            for p in parents
            if model[p].kind == "deterministic" and p not in known and p not in found
        ]
    return list(found)


def hold_against(
    model: Model,
    name: str,
    result: Any,
    program: Program,
    given: Callable[[Probe], Mapping[str, np.ndarray]],
    values: Probe,
) -> None:
    """Refuse what was read of a node or potential where its function gives something else.

    Parameters
    ----------
    result : Family, Expression or Distribution
    program : Program
        Of its expressions.
    given : callable
        From values of all nodes to those of the program's leaves.
    values : Probe

    Raises
    ------
    TraceError
    """
    is_node = name in model.nodes
    with marking_invalid(), np.errstate(all="ignore"):
        try:
            if is_node:
                expected, batch = model.evaluate(name, values)
                shape = batch + model[name].plate_shape
            else:
                expected = model.potential(name, values, total=False)
                shape = expected.shape
            leaves = given(values)
        except BayesmcError:
            return  # the function's own fault, or out of range: nothing to compare
        try:
            made = rebuilt(result, iter(program(leaves)))
            if is_node and model[name].is_stochastic and not isinstance(made, Distribution):
                made = as_distribution(made)
        except (BayesmcError, ValueError, TypeError, IndexError) as error:
            raise TraceError(f"what was read of it fails: {error}") from error
        if not _agree(model.nodes.get(name), expected, made, shape):
            raise TraceError("what was read of it gives other values than the function")


def hold_form(model: Model, name: str, form: Expression) -> None:
    """Refuse a family's own log density where ``log_prob`` gives something else.

    Raises
    ------
    TraceError
    """
    program = Program([form])
    for variant in range(len(VARIANTS)):
        values = Probe.of(model, variant)
        with marking_invalid(), np.errstate(all="ignore"):
            dist, _ = model.evaluate(name, values)
            expected = model.log_density(name, dist, values[name])
            (found,) = program(values)
        if not _near(*np.broadcast_arrays(expected, found)):
            raise TraceError("its log_density gives other values than its log_prob")


# ---- private ------------------------------------------------------------------------------------


def _agree(node: CompiledNode | None, expected: Any, made: Any, shape: Shape) -> bool:
    if isinstance(expected, Distribution) != isinstance(made, Distribution):
        return False
    if not isinstance(expected, Distribution):
        full = shape if node is None else shape + node.event_shape
        stored = np.asarray(expected)
        value = node.decode(stored) if node is not None and node.domain is not None else stored
        return _near(np.asarray(value), np.broadcast_to(np.asarray(made), full))
    if type(expected) is not type(made):
        return False
    pairs = zip(expected.parameters(), made.parameters(), strict=True)
    return all(n == m and _alike(a, b, shape, n) for (a, n), (b, m) in pairs)


def _alike(a: np.ndarray, b: np.ndarray, shape: Shape, own: int) -> bool:
    """Whether parameters are the same, whose last axes are their own and the others broadcast."""
    if a.shape != b.shape:
        a, b = (np.broadcast_to(x, (*shape, *x.shape[x.ndim - own :])) for x in (a, b))
    return _near(a, b)


def _near(a: np.ndarray, b: np.ndarray) -> bool:
    return nearly_equal(a, b, _RTOL, 1e-3 * _RTOL)
