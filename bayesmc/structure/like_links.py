"""Deterministic nodes recomputed in few calls: like ones, in all slices of a series, as one.

Links that are alike (``like_functions``) and do not follow from each other get a group axis, after the batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from bayesmc.errors import BayesmcError
from bayesmc.shapes import Shape
from bayesmc.structure.like_functions import Signature, Slots, as_one

if TYPE_CHECKING:  # a target recomputes its links with this
    from bayesmc.structure.target import Target, Values

#: links that are worth a group
FEWEST = 4
#: elements of one link from which on arrays, not calls, take the time
_LARGE = 512


class LinkSteps:
    """Deterministic nodes that are recomputed together, parents first.

    Parameters
    ----------
    target : Target
    links : sequence of str
        In an order in which they can be computed.
    also : callable, optional
        What of a link must be equal within a group, besides what it is.

    Attributes
    ----------
    steps : tuple
        Names that are computed alone, and groups of like ones.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.like_links import LinkSteps
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> for t in range(5):
    ...     net.add(f"m[{t}]", lambda x, t=t: x * t)
    ...     net.add(f"y[{t}]", lambda m: bmc.Normal(m, 1.0), parents=[f"m[{t}]"])
    >>> target = target_of(pose(net, {f"y[{t}]": 0.0 for t in range(5)}))
    >>> steps = LinkSteps(target, target.links)
    >>> len(steps.steps)
    1
    >>> values = {**target.known, "x": np.array([1.0, 2.0])}
    >>> steps.compute(values)
    >>> values["m[3]"].tolist()
    [3.0, 6.0]
    """

    def __init__(
        self,
        target: Target,
        links: Sequence[str],
        also: Callable[[str], Hashable] | None = None,
    ) -> None:
        self.target = target
        self.steps: tuple[str | LikeLinks, ...] = tuple(_steps(target, links, also))

    def compute(self, values: Values) -> None:
        """Put the links' values, given all others, in place."""
        for step in self.steps:
            if isinstance(step, str):
                values[step], _ = self.target.model.evaluate(step, values)
            else:
                values.update(step.computed(values))


class LikeLinks:
    """Links that are alike, none of which follows from another, as one call.

    Attributes
    ----------
    names : tuple of str
    """

    def __init__(
        self, target: Target, names: Sequence[str], signatures: Sequence[Signature]
    ) -> None:
        self.target = target
        self.names = tuple(names)
        self.function = as_one(signatures)
        scopes = [s.scope[:-1] for s in signatures]  # the last is the link itself
        sources = {name: tuple(s[i] for s in scopes) for i, name in enumerate(scopes[0])}
        self.slots = Slots(target, sources, len(names))

    def computed(self, values: Values) -> Values:
        """Values of all, each with the batch of the parents of all."""
        try:
            found, batch = self._evaluated(self.slots.gathered(values))
        except BayesmcError:
            for name in self.names:  # the group knows the first one's name only
                self.target.model.evaluate(name, values)
            raise
        shape = self.target.model[self.names[0]].value_shape
        full = np.broadcast_to(found, (*batch[:-1], len(self.names), *shape))
        rows = np.ascontiguousarray(np.moveaxis(full, len(batch) - 1, 0))
        rows.flags.writeable = False
        return dict(zip(self.names, rows, strict=True))

    def _evaluated(self, values: Values) -> tuple[np.ndarray, Shape]:
        if self.function is not None:
            return self.function(values)
        return self.target.model.evaluate(self.names[0], values)


# ---- private ------------------------------------------------------------------------------------


def _steps(
    target: Target, links: Sequence[str], also: Callable[[str], Hashable] | None
) -> list[str | LikeLinks]:
    """Each link alone, or in the first group of its like that comes after all it is computed from."""
    groups: list[list[str]] = []
    place: dict[str, int] = {}
    last: dict[Hashable, int] = {}
    signatures = target.signatures
    for link in links:
        after = max((place[p] for p in target.model[link].parents if p in place), default=-1)
        signature = signatures.of(link)
        at = -1
        if signature is not None and math.prod(target.model[link].value_shape) < _LARGE:
            repeated = tuple(signature.scope.index(n) for n in signature.scope)
            key = signature.key, repeated, None if also is None else also(link)
            at = last.get(key, -1)
            if at <= after:
                at = last[key] = len(groups)
        if at < 0 or at == len(groups):
            at = len(groups)
            groups.append([])
        groups[at].append(link)
        place[link] = at
    return [step for group in groups for step in _as_one(target, group)]


def _as_one(target: Target, names: Sequence[str]) -> Sequence[str | LikeLinks]:
    if len(names) < FEWEST:
        return names
    found = [target.signatures.of(n) for n in names]
    return [LikeLinks(target, names, [s for s in found if s is not None])]
