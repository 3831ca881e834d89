"""Deterministic nodes that follow from one another, as one program of the nodes that all follow from.

A recursion over time (the mean of a moving average, the variance of a GARCH model) has a node in every slice,
no two of which can be computed at once: called one by one, their functions take longer than all the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from bayesmc.errors import BayesmcError, TraceError
from bayesmc.expression import Call, Program, ordered
from bayesmc.network.expressions import value_of
from bayesmc.passes.arrays import for_arrays
from bayesmc.shapes import read_only
from bayesmc.structure.like_functions import FEWEST, Facts, LikeLinks, LinkSteps, Values

#: how far its values may be from those of the functions
_CLOSE = 1e-9


class Recursion:
    """Nodes one after the other as one program.

    Parameters
    ----------
    target : Facts
    names : sequence of str
        Parents first.

    Raises
    ------
    TraceError
        The function of one of them cannot be followed.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.recursion import Recursion
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("twice", lambda x: 2 * x)
    >>> net.add("more", lambda twice, x: twice + x)
    >>> net.add("y", lambda more: bmc.Normal(more, 1.0))
    >>> both = Recursion(target_of(pose(net, {"y": 0.0})), ["twice", "more"])
    >>> {n: v.tolist() for n, v in both.computed({"x": np.array([1.0, 2.0])}).items()}
    {'twice': [2.0, 4.0], 'more': [3.0, 6.0]}
    """

    def __init__(self, target: Facts, names: Sequence[str]) -> None:
        self.target, self.names = target, tuple(names)
        roots = [value_of(target.model, n) for n in names]
        if any(isinstance(node, Call) for node in ordered(*roots)):
            raise TraceError("a function is called as it is")
        self.program = Program(for_arrays(roots))
        #: whether it gave what the functions themselves do, at the values that it was first asked for
        self.holds: bool | None = None

    def computed(self, values: Values) -> Values:
        """Values of all, given those that they follow from.

        Raises
        ------
        BayesmcError
            Of the node whose function cannot be called.
        """
        if self.holds is False:
            return self._one_by_one(values)
        try:
            found = [read_only(np.asarray(v)) for v in self.program(values)]
        except (BayesmcError, ArithmeticError, LookupError, ValueError):
            return self._one_by_one(values)  # whose fault it is, is known of each alone
        if self.holds is None:
            alone = self._one_by_one(values)
            self.holds = all(
                np.allclose(a, b, rtol=_CLOSE, atol=_CLOSE, equal_nan=True)
                for a, b in zip(found, alone.values(), strict=True)
            )
            return alone
        return dict(zip(self.names, found, strict=True))

    def _one_by_one(self, values: Values) -> Values:
        found = dict(values)
        for name in self.names:
            found[name], _ = self.target.model.evaluate(name, found)
        return {n: found[n] for n in self.names}


class LinkPlan(LinkSteps):
    """As ``LinkSteps``; of those left alone, several that come one after the other are one program."""

    def __init__(self, target: Facts, links: Sequence[str]) -> None:
        super().__init__(target, links)
        model = target.model
        steps: list[str | LikeLinks | Recursion] = []
        for is_fit, run in groupby(
            self.steps, lambda s: isinstance(s, str) and model[s].domain is None
        ):
            own = list(run)
            if is_fit and len(own) >= FEWEST:
                try:
                    steps.append(Recursion(target, [str(s) for s in own]))
                    continue
                except TraceError:
                    pass
            steps += own
        self.steps = tuple(steps)
