"""Tables of finite nodes: functions of discrete parents evaluated once on all configurations.

Deterministic nodes without a finite domain are passed through: what depends on them depends on the finite
nodes above.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.network import CompiledNode, Model
from bayesmc.network.model import potential_shape
from bayesmc.shapes import Shape

#: table entries up to which a function is evaluated on all configurations of its parents
TABLE_ENTRIES = 1 << 24


@dataclass(frozen=True, eq=False)
class Table:
    """A finite node's probabilities over all configurations of its finite parents.

    Attributes
    ----------
    parents : tuple of str
        Parents that vary, in axis order (fixed nodes and inputs are constants).
    probs : ndarray, shape (*cards, *plates or ones, states)
    invalid : ndarray of bool or None, shape (*cards, *plates or ones)
        Configurations at which the function gives bad parameters.
    """

    parents: tuple[str, ...]
    probs: np.ndarray
    invalid: np.ndarray | None = None


class Reads(NamedTuple):
    """What a function reads, through the deterministic nodes between.

    Attributes
    ----------
    alone : tuple of str
        Finite nodes of which an element reads the one of its own place.
    whole : tuple of str
        Finite nodes of which it may read all elements.
    others : tuple of str
        Stochastic nodes that are not finite.
    """

    alone: tuple[str, ...]
    whole: tuple[str, ...]
    others: tuple[str, ...]


def reads_of(
    model: Model,
    names: Sequence[str],
    plates: Sequence[str],
    is_known: Callable[[str], bool],
    through: bool = False,
) -> Reads:
    """What stands above a function in some plates that reads these nodes.

    What is known is left out. Finite nodes that are computed are not looked behind, unless ``through``.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.tables import reads_of
    >>> net = bmc.BayesNet(plates={"i": 3})
    >>> net.add("k", bmc.Bernoulli(0.5), plates="i")
    >>> net.add("m", bmc.Normal(0.0, 1.0))
    >>> net.add("f", lambda k, m: k * m, plates="i")
    >>> reads_of(pose(net, {}).model, ["f"], ["i"], lambda name: False)
    Reads(alone=('k',), whole=(), others=('m',))
    """
    finite: dict[str, bool] = {}
    others: dict[str, None] = {}

    def visit(names: Sequence[str], plates: Sequence[str], whole: bool) -> None:
        for name in names:
            if is_known(name):
                continue
            node = model[name]
            foreign = whole or any(p not in plates for p in node.plates)
            if node.domain is not None and (node.is_stochastic or not through):
                finite[name] = finite.get(name, False) or foreign
            elif node.is_stochastic:
                others[name] = None
            else:
                visit(node.parents, node.plates, foreign)

    visit(names, plates, False)
    alone = tuple(n for n, is_whole in finite.items() if not is_whole)
    return Reads(alone, tuple(n for n in finite if n not in alone), tuple(others))


def indexed_table(
    model: Model, name: str, known: Mapping[str, np.ndarray], entries: Sequence[int]
) -> np.ndarray:
    """Logs of a potential over rows of an index at all states of some entries, shape ``(*cards, rows)``.

    The others are known.
    """
    potential, links = model.potentials[name]
    cards = tuple(model[potential.scope[i]].domain.size for i in entries)  # type: ignore[union-attr]
    stored = [
        _along(entries.index(i), cards[entries.index(i)], len(cards) + 1, ())
        if i in entries
        else link.place(known[parent])
        for i, (parent, link) in enumerate(links)
    ]
    table = model.potential_at(name, stored)
    return np.broadcast_to(table, (*cards, *potential_shape(model.sizes, potential)))


def tabulate(
    model: Model,
    node: CompiledNode,
    constants: Mapping[str, np.ndarray],
    limit: int = TABLE_ENTRIES,
) -> Table | None:
    """The table of a finite node whose parents are finite and in its own plates; None if there is none.

    ``constants`` are the stored values of inputs and fixed nodes.
    """
    if not node.is_stochastic or node.domain is None or node.has_foreign_parents:
        return None
    varying = tuple(dict.fromkeys(p for p in node.parents if p not in constants))
    if any(model[p].domain is None for p in varying):
        return None
    cards = tuple(model[p].domain.size for p in varying)  # type: ignore[union-attr]
    if float(math.prod(cards)) * node.domain.size * math.prod(node.plate_shape) > limit:
        return None
    values = dict(constants)
    for axis, (parent, card) in enumerate(zip(varying, cards, strict=True)):
        values[parent] = _along(axis, card, len(cards), model[parent].plate_shape)
    with marking_invalid(), np.errstate(all="ignore"):
        dist, _ = model.evaluate(node.name, values)
        probs = dist.probs_table
    ones = (1,) * len(node.plates)
    lead = probs.shape[:-1]
    full = np.broadcast_to(probs, np.broadcast_shapes(lead, cards + ones) + probs.shape[-1:])
    invalid = None
    if dist.invalid is not None and dist.invalid.any():
        invalid = np.broadcast_to(dist.invalid, full.shape[:-1])
    return Table(varying, full, invalid)


def constants_of(model: Model, inputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Stored values that never vary: inputs and nodes fixed by ``do``."""
    fixed = {
        name: node.declaration.value
        for name, node in model.nodes.items()
        if node.declaration.value is not None
    }
    return {**inputs, **fixed}


def configure(
    model: Model,
    known: Mapping[str, np.ndarray],
    alone: Sequence[str],
    whole: Sequence[str],
    names: Sequence[str],
    points: Mapping[str, np.ndarray] | None = None,
) -> tuple[dict[str, np.ndarray], Shape]:
    """Stored values of ``names`` and what they need, over all configurations of the variables.

    Axis k of the batch runs over the k-th of: nodes ``alone`` (one axis each, all plate elements alike),
    then every element of the nodes ``whole``. ``points`` gives further values of some nodes, which run
    along one more batch axis, the last.
    """
    nodes = [model[n] for n in alone], [model[n] for n in whole]
    axes, sizes = configurations(*nodes, behind=int(points is not None))
    values = {**known, **dict(zip((*alone, *whole), axes, strict=True))}
    for name, value in (points or {}).items():
        values[name] = value.reshape((1,) * len(sizes) + value.shape)
    needed = _between(model, names, values)
    for name in model.nodes:
        if name in needed:
            values[name], _ = model.evaluate(name, values)
    return values, sizes


def configurations(
    alone: Sequence[CompiledNode],
    whole: Sequence[CompiledNode],
    apart: Sequence[str] = (),
    ahead: int = 0,
    behind: int = 0,
) -> tuple[list[np.ndarray], Shape]:
    """All states of finite nodes along batch axes of their own, and the sizes of these axes.

    Parameters
    ----------
    alone : sequence of CompiledNode
        One axis each, all plate elements alike.
    whole : sequence of CompiledNode
        One axis for every element, those of plates ``apart`` together.
    ahead, behind : int
        Batch axes of size one before and after these.
    """
    inner = [
        [1 if p in apart else n for p, n in zip(node.plates, node.plate_shape, strict=True)]
        for node in whole
    ]
    sizes = [node.domain.size for node in alone]  # type: ignore[union-attr]
    for node, shape in zip(whole, inner, strict=True):
        sizes += [node.domain.size] * math.prod(shape)  # type: ignore[union-attr]
    ndim = ahead + len(sizes) + behind
    found = [_along(ahead + k, sizes[k], ndim, node.plate_shape) for k, node in enumerate(alone)]
    axis = len(alone)
    for node, shape in zip(whole, inner, strict=True):
        count, card = math.prod(shape), node.domain.size  # type: ignore[union-attr]
        batch = np.ones(ndim, dtype=int)
        batch[ahead + axis : ahead + axis + count] = card
        value = np.empty((*batch, *node.plate_shape), dtype=np.intp)
        for element, at in enumerate(np.ndindex(*shape)):
            place = tuple(
                slice(None) if p in apart else i for p, i in zip(node.plates, at, strict=True)
            )
            shared = (1,) * sum(p in apart for p in node.plates)
            value[(Ellipsis, *place)] = _along(ahead + axis + element, card, ndim, shared)
        found.append(value)
        axis += count
    return found, tuple(sizes)


# ---- private ------------------------------------------------------------------------------------


def _along(axis: int, card: int, ndim: int, plates: Shape) -> np.ndarray:
    """All positions along one batch axis, the same in every plate element."""
    shape = (1,) * axis + (card,) + (1,) * (ndim - 1 - axis)
    values = np.arange(card).reshape(shape + (1,) * len(plates))
    return np.broadcast_to(values, shape + plates)


def _between(model: Model, names: Sequence[str], known: Mapping[str, Any]) -> set[str]:
    """Deterministic nodes to compute on the way from known values to ``names``."""
    return {n for n in model.above(names, lambda n: n not in known) if n not in known}
