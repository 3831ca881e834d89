"""What an exact posterior says of finite nodes: tables read off a calibrated clique tree."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from bayesmc.factors import Calibrated
from bayesmc.network import Model
from bayesmc.structure import DiscreteNet, Variable


class TableAnswers:
    """Marginal and joint tables.

    Parameters
    ----------
    model : Model
    net : DiscreteNet
    calibrated : Calibrated
    known : mapping
        Stored values that do not vary: inputs, fixed and observed nodes without a finite domain.
    """

    def __init__(
        self,
        model: Model,
        net: DiscreteNet,
        calibrated: Calibrated,
        known: Mapping[str, np.ndarray],
    ) -> None:
        self.model, self.known_values = model, known
        self._cards, self.calibrated = net.cards, calibrated

    def table(self, name: str) -> np.ndarray:
        """Marginal tables of all elements of a finite node, shape ``(*plates, states)``."""
        node = self.model[name]
        assert node.domain is not None
        if node.kind == "fixed":
            assert node.declaration.value is not None
            return np.eye(node.domain.size)[node.declaration.value.astype(np.intp)]
        if not node.plate_shape:
            return self.calibrated.marginal((name, 0)).copy()
        count = math.prod(node.plate_shape)
        rows = [self.calibrated.marginal((name, e)) for e in range(count)]
        if not rows:
            return np.zeros((*node.plate_shape, node.domain.size))
        return np.reshape(np.stack(rows), (*node.plate_shape, node.domain.size))

    def joint(self, variables: Sequence[Variable]) -> np.ndarray:
        """Joint table of variables that may repeat or be fixed by ``do``."""
        free = [v for v in dict.fromkeys(variables) if v in self._cards]
        table = self.calibrated.joint(free)
        grid = np.ix_(*(range(self.card(v)) for v in variables))
        index = tuple(grid[variables.index(v)] for v in free)
        shape = tuple(self.card(v) for v in variables)
        full = np.array(np.broadcast_to(table[index], shape))
        for axis, variable in enumerate(variables):
            first = variables.index(variable)
            if first < axis:
                full = np.where(grid[first] == grid[axis], full, 0.0)
            elif variable not in self._cards:
                value = self.model[variable[0]].declaration.value
                assert value is not None
                full = np.where(grid[axis] == value.flat[variable[1]], full, 0.0)
        return full

    def card(self, variable: Variable) -> int:
        """Number of states of one element."""
        domain = self.model[variable[0]].domain
        assert domain is not None
        return domain.size

    def element(self, name: str, plates: Sequence[str], at: Sequence[int]) -> Variable:
        """The element of a node at an index of some plates, which hold all of the node's."""
        node = self.model[name]
        own = tuple(at[plates.index(p)] for p in node.plates)
        return name, int(np.ravel_multi_index(own, node.plate_shape)) if own else 0

    def elements(self, name: str) -> list[Variable]:
        """All elements of a node."""
        return [(name, e) for e in range(math.prod(self.model[name].plate_shape))]

    def known(self, name: str) -> np.ndarray | None:
        """The value of a node without a domain that does not vary."""
        return self.known_values.get(name) if self.model[name].domain is None else None

    def above(self, nodes: Sequence[str]) -> tuple[str, ...]:
        """Finite nodes that the named ones are, or are computed from."""
        model = self.model

        def is_finite(name: str) -> bool:
            return model[name].domain is not None and model[name].kind != "fixed"

        def passes(name: str) -> bool:
            known = is_finite(name) or self.known(name) is not None
            return not known and not model[name].is_stochastic

        return tuple(filter(is_finite, model.above(nodes, passes)))

    def missing(self, nodes: Sequence[str]) -> list[str]:
        """The named nodes that have neither a finite domain nor a known value."""
        return [n for n in nodes if self.model[n].domain is None and self.known(n) is None]
