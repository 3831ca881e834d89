"""The nodes of a level as programs: their densities, and how their means move."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Expression, Leaf, Program, broadcast, expressions_of, leaf, ordered
from bayesmc.expression import rebuilt as made_of
from bayesmc.network import Model
from bayesmc.network.expressions import Opaque, density
from bayesmc.passes.derivatives import jumps, tangent
from bayesmc.passes.mean import mean


class Followed:
    """Nodes whose functions can be followed, as functions of what they read in the end.

    Parameters
    ----------
    model : Model
    nodes : sequence of str
    reads : iterable of str
        Nodes whose values move.
    known : iterable of str
        Nodes whose values are known.

    Raises
    ------
    TraceError
        A function cannot be followed.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.kalman.followed import Followed
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(np.sin(x), 0.1))
    >>> y = Followed(net.model(), ["y"], ["x"], [])
    >>> y.slopes({"x": np.array(0.0)}, {"x": np.ones(1)})
    [array([1.])]
    """

    def __init__(
        self, model: Model, nodes: Sequence[str], reads: Iterable[str], known: Iterable[str]
    ) -> None:
        self.nodes = [model[n] for n in nodes]
        self.reads = tuple(reads)
        given = {n for n in (*self.reads, *known) if n in model.nodes}
        cut = frozenset(n for n in given if model[n].kind == "deterministic")
        self.results = []
        for name in nodes:
            found = density(model, name, cut)
            if isinstance(found, Opaque):
                raise TraceError(found.reason)
            self.results.append(found.result)
        self._program = Program([e for r in self.results for e in expressions_of(r)])

    def __call__(self, values: Mapping[str, np.ndarray]) -> list[Any]:
        """A distribution for each node, or its value if it is deterministic."""
        found = iter(self._program(values))
        return [made_of(result, found) for result in self.results]

    def slopes(
        self, values: Mapping[str, np.ndarray], directions: Mapping[str, np.ndarray]
    ) -> list[np.ndarray] | None:
        """How the means move as what is read does.

        Parameters
        ----------
        values : dict
            Without a batch.
        directions : dict
            Of each node that is read, shape (directions, *value shape).

        Returns
        -------
        list of ndarray or None
            For each node, shape (directions, *value shape); None where a mean has no derivative that is
            known, or jumps just there.
        """
        if self._slopes is None:
            return None
        count = len(next(iter(directions.values())))
        moved = {_moved(n): d for n, d in directions.items()}
        *found, jumped = self._slopes({**values, **moved})
        if np.any(jumped):
            return None
        return [
            np.broadcast_to(slope, (count, *node.value_shape))
            for slope, node in zip(found, self.nodes, strict=True)
        ]

    # ---- private -------------------------------------------------------------------------------

    @cached_property
    def _slopes(self) -> Program | None:
        try:
            means = [
                broadcast(mean(r) if node.is_stochastic else r, node.value_shape)
                for node, r in zip(self.nodes, self.results, strict=True)
            ]
            directions = {
                n.name: leaf(_moved(n.name), n.shape)
                for n in ordered(*means)
                if isinstance(n, Leaf) and n.name in self.reads
            }
            slopes: list[Expression] = [tangent(m, directions) for m in means]
            return Program([*slopes, jumps(means, self.reads)])
        except TraceError:
            return None


# ---- private ------------------------------------------------------------------------------------


def _moved(name: str) -> str:
    """The leaf for how a node's value moves."""
    return f"move of {name}"
