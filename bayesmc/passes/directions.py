"""Through which affine combinations of some leaves an expression reads them: a factor's own directions.

A logistic likelihood of many coefficients is a function of one number, the affine combination inside.
Integrals over all coefficients are then integrals over that number, and where the function jumps or bends is
a place on its line.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bayesmc.errors import TraceError
from bayesmc.expression import Elementwise, Expression, elementwise, leaf, ordered, replaced
from bayesmc.passes.affine import Affine, affine
from bayesmc.passes.arithmetic import rewritten
from bayesmc.passes.reads import sunk

#: functions that jump or bend where their operands meet
_COMPARED = (np.greater, np.greater_equal, np.less, np.less_equal)
_BENT_BETWEEN = (np.maximum, np.minimum, np.fmax, np.fmin)
_BENT_AT_ZERO = (np.abs, np.fabs, np.sign, np.heaviside)
_JUMPING = (np.floor, np.ceil, np.rint, np.trunc, np.equal, np.not_equal, np.fmod, np.remainder)
#: bends inside of one comparison that are told apart
_MOST = 3


@dataclass(frozen=True, eq=False)
class Directions:
    """An expression of some leaves as a function of affine combinations of these.

    Attributes
    ----------
    residual : Expression
        Of leaves ``direction 0``, ``direction 1``, ... and of those that were not asked for.
    combinations : tuple of Affine
    names : tuple of str
        The new leaves.
    """

    residual: Expression
    combinations: tuple[Affine, ...]
    names: tuple[str, ...]


def directions(root: Expression, names: Collection[str]) -> Directions:
    """The affine combinations through which an expression reads some leaves, as large as they can be.

    Raises
    ------
    TraceError
        A leaf is read otherwise, as an index is.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.passes.directions import directions
    >>> x = TracedArray(leaf("x", (3,)))
    >>> found = directions(trace(lambda x: np.tanh(2 * x[..., 0] - x[..., 2] + 1), [x]), ["x"])
    >>> found.residual, found.combinations[0].reads["x"].gain.value
    (<Elementwise tanh ()>, array([ 2., -1.]))
    """
    wanted = frozenset(names)
    (root,) = rewritten([root], lambda node, new: _differences(node, new, wanted))
    for name in sorted(wanted & root.leaves):
        root = sunk(root, name)
    forms: dict[Expression, Affine | None] = {}
    for node in ordered(root):
        if not node.leaves & wanted:
            continue
        if any(forms.get(a, True) is None for a in node.operands):
            forms[node] = None
            continue
        try:
            forms[node] = affine(node, wanted)
        except TraceError:
            forms[node] = None
    outer = [
        a
        for node in ordered(root)
        if node.leaves & wanted and forms[node] is None
        for a in node.operands
        if forms.get(a) is not None
    ]
    if forms.get(root) is not None:
        outer.append(root)
    instead: dict[Expression, Expression] = {}
    combinations: list[Affine] = []
    called: list[str] = []
    for node in dict.fromkeys(outer):
        form = forms[node]
        assert form is not None
        called.append(f"direction {len(called)}")
        combinations.append(form)
        instead[node] = leaf(called[-1], node.shape)
    residual = replaced(root, instead)
    left = residual.leaves & wanted
    if left:
        raise TraceError(f"{sorted(left)[0]} is read otherwise than through affine combinations")
    return Directions(residual, tuple(combinations), tuple(called))


def breaks(root: Expression, names: Collection[str]) -> list[Expression]:
    """Numbers that are affine in some leaves, and zero wherever an expression jumps or bends.

    Raises
    ------
    TraceError
        It jumps or bends at places that are not known.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.expression import TracedArray, leaf, trace
    >>> from bayesmc.passes.directions import breaks
    >>> x = TracedArray(leaf("x", ()))
    >>> breaks(trace(lambda x: np.where(np.abs(x) < 2.0, 0.0, -np.inf), [x]), ["x"])
    [<Leaf x ()>, <Elementwise subtract ()>, <Elementwise subtract ()>]
    """
    wanted = frozenset(names)
    found: dict[Expression, None] = {}
    for node in ordered(root):
        if not isinstance(node, Elementwise) or not node.leaves & wanted:
            continue
        function, inner = node.function, node.operands
        if function in _JUMPING:
            raise TraceError(f"np.{function.__name__} jumps")
        if function in _COMPARED or function in _BENT_BETWEEN:
            margin = elementwise(np.subtract, *inner)
        elif function in _BENT_AT_ZERO:
            margin = inner[0]
        else:
            continue
        for straight in _straightened(margin, wanted):
            try:
                affine(straight, wanted)
            except TraceError as error:
                raise TraceError(
                    f"np.{function.__name__} of what is not affine ({error})"
                ) from error
            found[straight] = None
    return list(found)


# ---- private ------------------------------------------------------------------------------------


def _differences(
    node: Expression, new: Sequence[Expression], wanted: frozenset[str]
) -> Expression | None:
    """Two numbers compared as their difference with zero, which is one number."""
    if not isinstance(node, Elementwise) or node.function not in _COMPARED:
        return None
    if not all(a.leaves & wanted for a in new):
        return None
    return elementwise(node.function, elementwise(np.subtract, *new), 0.0)


def _straightened(margin: Expression, wanted: frozenset[str]) -> Iterator[Expression]:
    """With absolute values and extremes inside replaced by what they may be."""
    bent = [
        node
        for node in ordered(margin)
        if isinstance(node, Elementwise)
        and node.leaves & wanted
        and (node.function in _BENT_BETWEEN or node.function in (np.abs, np.fabs))
    ]
    if len(bent) > _MOST:
        raise TraceError("it compares what bends in many places")
    for choice in itertools.product((0, 1), repeat=len(bent)):
        yield _chosen(margin, bent, choice)


def _chosen(margin: Expression, bent: Sequence[Elementwise], choice: Sequence[int]) -> Expression:
    instead: dict[Expression, Expression] = {}
    for node, which in zip(bent, choice, strict=True):
        inner = [replaced(a, instead) for a in node.operands]
        if node.function in (np.abs, np.fabs):
            made = elementwise(np.negative, inner[0]) if which else inner[0]
        else:
            made = inner[which]
            if made.shape != node.shape:
                raise TraceError("it compares numbers of several shapes")
        instead[node] = made
    return replaced(margin, instead)
