"""Components that a model does not tell apart: found, and put in an order draw by draw.

The posterior of a mixture is the same however its components are named, so chains may name them
differently, and one chain may change its mind. That is no fault of theirs: what does not depend on the
names can mix all the same, and among it every figure of components that are named by their order.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.network import CompiledNode, Model, Problem

#: vectors that may or may not belong to the components, each way of which is tried
_VECTORS = 6
#: nodes of a plate of which some alone may be exchangeable, at most
_NODES = 4
_CLOSE = 1e-7


@dataclass(frozen=True)
class Symmetry:
    """Components whose names may be exchanged without changing the posterior.

    Attributes
    ----------
    size : int
        How many there are.
    plate : str or None
        The plate of the components, if they have one.
    axes : dict
        Hidden node -> axes of its value, counted from the end, that run over the components.
    labels : frozenset of str
        Hidden finite nodes whose states name components.
    """

    size: int
    plate: str | None
    axes: Mapping[str, tuple[int, ...]]
    labels: frozenset[str]

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes whose values depend on the names."""
        return (*self.axes, *sorted(self.labels))


def symmetries(problem: Problem, values: Mapping[str, np.ndarray]) -> list[Symmetry]:
    """The components that a question does not tell apart.

    Whether it does is tried: the joint density must be the same at some draws and with components exchanged.

    Parameters
    ----------
    problem : Problem
    values : dict
        Stored values of all nodes at some draws of the chains, ``(chain, *plates, *event)``.

    References
    ----------
    Stephens (2000), Dealing with label switching in mixture models, JRSS B 62.
    """
    found: list[Symmetry] = []
    with marking_invalid(), np.errstate(all="ignore"):
        base = _log_joint(problem, values)
        if base is None or not np.isfinite(base).all():
            return []
        for candidate in _candidates(problem):
            if any(set(candidate.names) & set(other.names) for other in found):
                continue
            if all(_same(problem, values, base, candidate, p) for p in _generators(candidate.size)):
                found.append(candidate)
    return found


def pivot_of(symmetry: Symmetry, model: Model) -> str | None:
    """The node that components are best ordered by: a number for each of them."""
    fit = [
        name
        for name, axes in symmetry.axes.items()
        if len(axes) == 1
        and model[name].value_shape == (symmetry.size,)
        and not model[name].is_discrete
    ]
    # weights of components are often much alike
    return min(fit, key=lambda n: _is_simplex(model[n]), default=None)


def _is_simplex(node: CompiledNode) -> bool:
    return node.support is not None and node.support.kind == "simplex"


def ordered(
    problem: Problem, stored: Mapping[str, np.ndarray], symmetry: Symmetry, by: str
) -> dict[str, np.ndarray]:
    """Draws whose components are named by the order of node ``by``, draw by draw.

    Nodes that are computed from others are computed again; where these were not kept they are left out.

    Parameters
    ----------
    problem : Problem
    stored : dict
        Node -> stored values, ``(chain, draw, *plates, *event)``.
    symmetry : Symmetry
    by : str
        A node with one number for each component.
    """
    order = np.argsort(stored[by], axis=-1, kind="stable")
    rank = np.argsort(order, axis=-1, kind="stable")
    found = dict(stored)
    for name, axes in symmetry.axes.items():
        if name in stored:
            for axis in axes:
                found[name] = _taken(found[name], order, axis)
    for name in symmetry.labels:
        if name in stored:
            codes = stored[name].astype(np.intp)
            chain, draw = (
                a.reshape(a.shape + (1,) * (codes.ndim - 2))
                for a in np.ogrid[: codes.shape[0], : codes.shape[1]]
            )
            found[name] = rank[chain, draw, codes].astype(stored[name].dtype)
    return _computed_again(problem, found, set(symmetry.names))


# ---- private ------------------------------------------------------------------------------------


def _computed_again(
    problem: Problem, stored: dict[str, np.ndarray], changed: set[str]
) -> dict[str, np.ndarray]:
    """Draws with the values of nodes that are computed from changed ones."""
    seen = {n: o.value for n, o in problem.observed.items() if o.mask is None}
    at = {**problem.inputs, **seen, **stored}
    for name, node in problem.model.nodes.items():
        if node.kind != "deterministic" or not changed & set(node.parents):
            continue
        changed = changed | {name}
        at.pop(name, None)
        if all(parent in at for parent in node.parents):
            with marking_invalid(), np.errstate(all="ignore"):
                values = np.asarray(problem.model.evaluate(name, at)[0])
            at[name] = values if name not in stored else values.astype(stored[name].dtype)
    return {n: at[n] for n in stored if n in at}


def _hidden(problem: Problem) -> dict[str, CompiledNode]:
    return {
        n: c for n, c in problem.model.nodes.items()
        if c.is_stochastic and n not in problem.observed
    }  # fmt: skip


def _candidates(problem: Problem) -> Iterator[Symmetry]:
    """What may be exchangeable: elements of a plate, or entries of vectors, and states beside them."""
    hidden = _hidden(problem)
    for plate, size in problem.model.sizes.items():
        own = {
            n: (c.plates.index(plate) - len(c.value_shape),)
            for n, c in hidden.items()
            if plate in c.plates
        }
        if own and size > 1:
            # all of them, or some: what is sorted before anybody reads it is exchanged alone
            fewest = 1 if len(own) <= _NODES else len(own)
            for many in range(len(own), fewest - 1, -1):
                for some in itertools.combinations(own, many):
                    yield from _with_others(hidden, plate, size, {n: own[n] for n in some})
    for size in sorted({c.event_shape[-1] for c in hidden.values() if c.event_shape}):
        if size > 1:
            yield from _with_others(hidden, None, size, {})


def _with_others(
    hidden: Mapping[str, CompiledNode],
    plate: str | None,
    size: int,
    own: Mapping[str, tuple[int, ...]],
) -> Iterator[Symmetry]:
    vectors = [n for n, c in hidden.items() if c.event_shape and c.event_shape[-1] == size]
    labels = frozenset(
        n for n, c in hidden.items()
        if c.domain is not None and c.domain.size == size and n not in own and not c.event_shape
    )  # fmt: skip
    vectors = vectors[:_VECTORS]
    for many in range(len(vectors), -1, -1):
        for chosen in itertools.combinations(vectors, many):
            axes = dict(own)
            for name in chosen:
                axes[name] = (*axes.get(name, ()), -1)
            if axes:
                for finite in (labels, frozenset()) if labels else (labels,):
                    yield Symmetry(size, plate, axes, finite)


def _generators(size: int) -> list[np.ndarray]:
    """Two exchanges that every other one is made of."""
    swap, turn = np.arange(size), np.roll(np.arange(size), 1)
    swap[:2] = 1, 0
    return [swap, turn]


def _same(
    problem: Problem,
    values: Mapping[str, np.ndarray],
    base: np.ndarray,
    symmetry: Symmetry,
    permutation: np.ndarray,
) -> bool:
    changed = dict(values)
    for name, axes in symmetry.axes.items():
        for axis in axes:
            changed[name] = np.take(changed[name], permutation, axis=axis)
    back = np.argsort(permutation)
    for name in symmetry.labels:
        changed[name] = back[changed[name].astype(np.intp)].astype(changed[name].dtype)
    found = _log_joint(problem, changed)
    return found is not None and bool(
        np.allclose(found, base, rtol=_CLOSE, atol=_CLOSE * max(1.0, float(np.abs(base).max())))
    )


def _log_joint(problem: Problem, values: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Log density of everything, for every chain; None where it cannot be evaluated."""
    model, at = problem.model, {**problem.inputs, **values}
    total: Any = np.zeros(1)
    try:
        for name, node in model.nodes.items():
            if node.kind == "deterministic":
                at[name] = np.asarray(model.evaluate(name, at)[0])
            elif node.is_stochastic:
                given, _ = model.evaluate(name, at)
                log = model.log_density(name, given, at[name])
                total = total + log.sum(axis=tuple(range(log.ndim - len(node.plates), log.ndim)))
        for name in model.potentials:
            total = total + model.potential(name, at)
    except (BayesmcError, ValueError, FloatingPointError):
        # a function that minds being asked where no draw was: nothing is known
        return None
    return np.atleast_1d(total)


def _taken(values: np.ndarray, order: np.ndarray, axis: int) -> np.ndarray:
    """``values`` with components in the order of each draw, ``(chain, draw, size)``."""
    moved = np.moveaxis(values, axis, -1)
    lead = order[(slice(None),) * 2 + (None,) * (moved.ndim - 3)]
    taken = np.take_along_axis(moved, np.broadcast_to(lead, moved.shape), axis=-1)
    return np.moveaxis(taken, -1, axis)
