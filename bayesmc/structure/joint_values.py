"""Values of many nodes that one kernel draws together, held as one array beside them in the state.

Whoever sums over the states of a chain of a thousand slices would else look up and join a thousand arrays in
every sweep, which takes longer than the sums.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import is_, itemgetter

import numpy as np

from bayesmc.expression import Expression, leaf, pick
from bayesmc.expression.graph import substituted
from bayesmc.network.expressions import stored_leaf
from bayesmc.network.model import Model
from bayesmc.structure.target import Values

#: nodes from which on it pays
FEWEST = 16


class JointValues:
    """The values of nodes of like shapes and types.

    Parameters
    ----------
    model : Model
    names : sequence of str
        At least two.

    Attributes
    ----------
    key : str
        What the array stands under in a state: shape ``(chains, nodes, *plates, *event)``.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.expression import evaluate, leaf, pick
    >>> from bayesmc.structure.joint_values import JointValues
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Normal(0.0, 1.0))
    >>> net.add("b", bmc.Normal(0.0, 1.0))
    >>> joint = JointValues(net.model(), ["a", "b"])
    >>> both = pick([leaf("a", ()), leaf("b", ())], [1, 0])
    >>> state = joint.placed({"a": np.array([1.0, 2.0]), "b": np.array([10.0, 20.0])})
    >>> evaluate([joint.read_by(both)], state)
    [array([[10.,  1.],
           [20.,  2.]])]
    """

    def __init__(self, model: Model, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.key = f"\0joint values of {names[0]} and {len(names) - 1} others"
        self._of = f"{self.key}: whose"
        self._rows = itemgetter(*names)
        one = stored_leaf(model, model[names[0]])
        whole = leaf(self.key, (len(names), *one.shape), one.dtype)
        places = np.arange(whole.size).reshape(whole.shape)
        self._picks: dict[str, Expression] = {
            n: pick([whole], at) for n, at in zip(names, places, strict=True)
        }

    def kept(self, values: Mapping[str, np.ndarray], joint: np.ndarray) -> Values:
        """What goes into the state with new values, from whoever has them as one array."""
        return {self.key: joint, self._of: self._rows(values)}

    def placed(self, values: Values) -> Values:
        """The state with the array of its own values."""
        rows = self._rows(values)
        of = values.get(self._of)
        if of is not None and all(map(is_, rows, of)):
            return values
        return {**values, **self.kept(values, np.stack(np.broadcast_arrays(*rows), axis=1))}

    def read_by(self, expression: Expression) -> Expression:
        """The expression of the array in place of the values; itself where it reads few of them."""
        if len(expression.leaves & self._picks.keys()) < 2:
            return expression
        return substituted(expression, self._picks)
