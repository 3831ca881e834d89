"""Effects and their scale: nodes ``loc + scale * z`` whose location and scale move as well.

A scale that the data say little of and its effects make a funnel: where the scale is small, so are the
effects, and no one length of a step suits both ends. Free numbers that lie between the effect and ``z`` have
no such shape, or another: for each effect there is a share of centring that leaves the least of it.

References
----------
Papaspiliopoulos, Roberts and Skold (2007), A general framework for the parametrization of
hierarchical models, Statistical Science 22; Gorinova, Moore and Hoffman (2020), Automatic
reparameterisation of probabilistic programs, ICML, sec. 4.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions import Cauchy, Laplace, MvNormal, Normal, StudentT
from bayesmc.distributions.transform import Transform
from bayesmc.expression import (
    Expression,
    Family,
    Program,
    TracedArray,
    as_expression,
    broadcast,
)
from bayesmc.expression.functions import expression_of
from bayesmc.network.expressions import Opaque
from bayesmc.structure.target import Target

#: families of ``loc + scale * z``
_FAMILIES = frozenset((Normal, StudentT, Laplace, Cauchy))


@dataclass(frozen=True, eq=False)
class Centred(Transform):
    """Numbers between an effect and its standardised value.

    ``x = loc + scale ** (1 - share) * (u - share * loc)``: with share 1 ``u`` is the effect, with 0 ``z``.

    Attributes
    ----------
    loc, scale : array, or what stands for one
        With those of the value broadcast.
    share : ndarray
        From 0 to 1, for each element.
    """

    loc: Any
    scale: Any
    share: np.ndarray

    def formula(self, u: Any) -> Any:
        return self.loc + self._stretch * (u - self.share * self.loc)

    def _unconstrain(self, x: np.ndarray) -> np.ndarray:
        return np.asarray((x - self.loc) / self._stretch + self.share * self.loc)

    def log_det_formula(self, u: Any) -> Any:
        return self._summed((1.0 - self.share) * np.log(self.scale) + 0.0 * u)

    @property
    def _stretch(self) -> Any:
        return np.exp((1.0 - self.share) * np.log(self.scale))


def location_and_scale(
    target: Target, name: str, moving: Collection[str]
) -> tuple[Expression, Expression] | None:
    """Of an effect whose scale moves: both as expressions of stored values, shape the node's; else None.

    Of vectors the scale is that of each component: what is left of their correlation is no funnel.

    Parameters
    ----------
    moving : collection of str
        Nodes that move with it. What else its location and scale depend on has to be known.
    """
    node, term = target.model[name], target.terms.get(name)
    if term is None or isinstance(term.read, Opaque) or not isinstance(term.read.result, Family):
        return None
    family = term.read.result
    if family.make is MvNormal and target.free_elements(name) is None:
        both = family.parameters["loc"], _deviations(family.parameters)
    elif family.make in _FAMILIES:
        both = family.parameters["loc"], family.parameters["scale"]
    else:
        return None
    found = [broadcast(as_expression(expression_of(b)), node.value_shape) for b in both]
    hidden = [(f.leaves & frozenset(target.chain)) - {name} for f in found]
    if not hidden[1] or not (hidden[0] | hidden[1]) <= frozenset(moving):
        return None
    return found[0], found[1]


def _deviations(parameters: Mapping[str, Any]) -> Any:
    """Standard deviations of a vector's components."""
    given = {k: v for k, v in parameters.items() if v is not None and k != "loc"}
    ((kind, value),) = given.items()
    value = TracedArray(as_expression(expression_of(value)))
    if kind == "scale_diag":
        return value
    if kind == "cov":
        return np.sqrt(np.linalg.diagonal(value))
    return np.sqrt(np.sum(np.square(value), axis=-1))


class Effects:
    """All effects of a density whose scales move with them.

    Parameters
    ----------
    density : UnconstrainedDensity
        Its nodes are as they were declared.

    Attributes
    ----------
    at : ndarray of int
        Their places among the free numbers.
    places : dict
        Node -> those of its elements.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.centring import Effects
    >>> from bayesmc.structure.target import target_of
    >>> from bayesmc.structure.unconstrained import unconstrained_density
    >>> net = bmc.BayesNet(plates={"group": 3})
    >>> net.add("sd", bmc.HalfNormal(1.0))
    >>> net.add("effect", lambda sd: bmc.Normal(0.5, sd), plates="group")
    >>> net.add("y", lambda effect: bmc.StudentT(3.0, effect, 1.0), plates="group")
    >>> effects = Effects(unconstrained_density(target_of(pose(net, {"y": [1.0, 2.0, 3.0]}))))
    >>> effects.at
    array([1, 2, 3])
    >>> x, loc, scale = effects.told({"sd": np.array([2.0]), "effect": np.array([[1.0, 2.0, 3.0]])})
    >>> x, scale
    (array([[1., 2., 3.]]), array([[2., 2., 2.]]))
    """

    def __init__(self, density: Any) -> None:
        self._target: Target = density.target
        self._found = []
        for node in density.nodes:
            both = location_and_scale(self._target, node.name, density.names)
            if both is not None and node.size > 1:
                self._found.append((node, both))
        self.places = {n.name: n.start + np.arange(n.size) for n, _ in self._found}
        self.at = np.concatenate([np.zeros(0, int), *self.places.values()])

    def told(self, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Effects, locations and scales, shape ``(chains, len(at))`` each, at values of nodes that move."""
        numbers = iter(self._program({**self._target.known, **values}))
        rows: list[list[np.ndarray]] = [[], [], []]
        for node, _ in self._found:
            x = values[node.name]
            chains, shape = len(x), node.node.value_shape
            for row, part in zip(rows, (x, next(numbers), next(numbers)), strict=True):
                wide = np.broadcast_to(part, (chains, *shape)).reshape(chains, math.prod(shape))
                row.append(wide if node.elements is None else wide[:, node.elements])
        x, loc, scale = (np.concatenate(row, axis=1) for row in rows)
        return x, loc, scale

    @cached_property
    def _program(self) -> Program:
        return Program([e for _, both in self._found for e in both])
