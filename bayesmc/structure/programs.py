"""Expressions on the state of chains: of like terms as one program, of many nodes' values as one array.

The group stands in an axis between chains and plates. What depends on nothing that a chain moves is computed
once, as long as the known values are the same arrays. Values of many nodes that one kernel draws together are
held as one array beside them in the state: whoever sums over the states of a chain of a thousand slices would
else look up and join a thousand arrays in every sweep, which takes longer than the sums.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from operator import is_, itemgetter
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import TraceError
from bayesmc.expression import Expression, Program, expressions_of, leaf, pick
from bayesmc.expression.graph import substituted
from bayesmc.network.expressions import stored_leaf
from bayesmc.network.model import Model
from bayesmc.network.readings import frame
from bayesmc.passes.log_density import family_of
from bayesmc.passes.templates import Stacked, Template, stacked_rows, template
from bayesmc.structure.like_functions import Slots
from bayesmc.structure.target import Target, Term, Values

#: nodes from which on it pays
FEWEST = 16


def family_read(term: Term) -> Any:
    """What the function of a node that was followed computes; a known distribution as its family, if any."""
    result = term.read.result  # type: ignore[union-attr]
    if isinstance(result, Distribution):
        with suppress(TraceError):
            return family_of(result)
    return result


def roots_of(term: Term) -> tuple[Expression, ...]:
    """The parameters of a node that was followed, and its stored value."""
    own = stored_leaf(term.model, term.model[term.name])
    return (*expressions_of(family_read(term)), own)


def template_of(term: Term) -> Template:
    """What the roots of a term are, apart from constants and names, and what is around them.

    Nodes that share a reading, all of whose parents are stored, have one template and names of their own.
    """
    known = term.model.cache.setdefault("templates of terms", {})
    if term.name not in known:
        known[term.name] = _template(term)
    return known[term.name]


def like_roots(terms: Sequence[Term]) -> Stacked:
    """The roots of terms of like templates as one."""
    found = stacked_rows([roots_of(terms[0])], [template_of(t) for t in terms])
    assert found is not None, "their templates are alike"
    return found


class StateProgram:
    """Values of some expressions for several members at once.

    Parameters
    ----------
    target : Target
    roots : sequence of Expression
        Of the names that the first member reads, and of ``constants``.
    leaves : sequence of tuple of str
        For each member what it reads, in the order in which they correspond.
    constants : dict
        Leaf -> what it is for each member, shape ``(members, *shape)``.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.expression import elementwise, leaf
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.programs import StateProgram
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("rate", bmc.LogNormal(0.0, 1.0))
    >>> for t in range(3):
    ...     net.add(f"y[{t}]", lambda rate: bmc.Poisson(rate), parents=["rate"])
    >>> target = target_of(pose(net, {f"y[{t}]": t for t in range(3)}))
    >>> root = elementwise(np.multiply, leaf("rate", ()), leaf("y[0]", (), int, None))
    >>> program = StateProgram(target, [root], [("rate", f"y[{t}]") for t in range(3)], {})
    >>> values = {**target.known, "rate": np.array([1.0, 10.0])}
    >>> program(values, program.are_known(values))[0].tolist()  # chains, members
    [[0.0, 1.0, 2.0], [0.0, 10.0, 20.0]]
    """

    def __init__(
        self,
        target: Target,
        roots: Sequence[Expression],
        leaves: Sequence[tuple[str, ...]],
        constants: Mapping[str, np.ndarray],
    ) -> None:
        self.target = target
        read = frozenset().union(*(r.leaves for r in roots))
        places = {these[0]: these for these in zip(*leaves, strict=True) if these[0] in read}
        still = {n: these for n, these in places.items() if all(map(target.is_known, these))}
        hidden = {n: these for n, these in places.items() if n not in still}
        self._known_slots = Slots(target, still, len(leaves))
        self._hidden_slots = Slots(target, hidden, len(leaves))
        self._constants = dict(constants)
        self._given = still.keys() | self._constants.keys()
        #: names of known values, and the arrays that they were
        self.watched = tuple({n for these in still.values() for n in these})
        self._arrays = [target.known[n] for n in self.watched]
        self._is_known = [self.is_known(r) for r in roots]
        self._moving = Program([r for r in roots if not self.is_known(r)])
        self._still = Program([r for r in roots if self.is_known(r)])
        self._cache: tuple[Values, list[np.ndarray]] | None = None

    def is_known(self, root: Expression) -> bool:
        """Whether an expression depends on nothing that a chain moves."""
        return root.leaves <= self._given

    def are_known(self, values: Mapping[str, np.ndarray]) -> bool:
        """Whether what is known still is what it was."""
        return all(map(is_, map(values.__getitem__, self.watched), self._arrays))

    def known(self) -> list[Any]:
        """Values of what is known, None for the rest."""
        return self._merged(self._standing(self.target.known, True)[1], None)

    def __call__(self, values: Mapping[str, np.ndarray], still: bool) -> list[np.ndarray]:
        """Values of all expressions, shape ``(*lead, group, *shape)`` or what broadcasts to it.

        A lead of chains is there where something that has one is read.

        Parameters
        ----------
        values : mapping
        still : bool
            Whether what is known is what it was (``are_known``).
        """
        given, found = self._standing(values, still)
        if all(self._is_known):
            return found
        return self._merged(found, self._moving({**given, **self._hidden_slots.gathered(values)}))

    # ---- private -------------------------------------------------------------------------------

    def _standing(
        self, values: Mapping[str, np.ndarray], still: bool
    ) -> tuple[Values, list[np.ndarray]]:
        """What is known, stacked, and the values of what follows from it."""
        if still and self._cache is not None:
            return self._cache
        given = {**self._known_slots.gathered(values), **self._constants}
        found = given, self._still(given)
        if still:
            self._cache = found
        return found

    def _merged(self, still: Sequence[Any], moving: Sequence[Any] | None) -> list[Any]:
        """In the order of the expressions."""
        a, b = iter(still), iter(moving or [None] * len(self._is_known))
        return [next(a) if known else next(b) for known in self._is_known]


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
    >>> from bayesmc.structure.programs import JointValues
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


# ---- private ------------------------------------------------------------------------------------


def _template(term: Term) -> Template:
    read, node = term.read, term.model[term.name]
    names = (*read.parents, term.name)  # type: ignore[union-attr]
    shared: dict[Hashable, Any] = term.model.cache.setdefault("templates of readings", {})
    computed = any(term.model[n].kind == "deterministic" for n in names)
    states = None if node.domain is None else node.domain.size
    key = read.reading, node.value_shape, node.is_discrete, states  # type: ignore[union-attr]
    stamp = None if computed or read.numbers else shared.get(key)  # type: ignore[union-attr]
    if stamp is not None:
        made, places = stamp
        return replace(made, leaves=tuple(names[k] for k in places))
    made = template(*roots_of(term))
    made = replace(made, key=(frame(family_read(term)), made.key))
    if not (computed or read.numbers):  # type: ignore[union-attr]
        shared[key] = made, tuple(map(names.index, made.leaves))
    return made
