"""Terms that meet their plates through one label only: log densities and sufficient statistics by label.

A mixture's data never change, nor do their statistics; by label stand their coefficients, which are
expressions of what is hidden (``passes.sufficient``). Log densities of every element at every label are a
product of both, and all that other nodes need to know of the data are the statistics' sums by label. These
sums stand in the state beside the labels that they belong to.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, TraceError
from bayesmc.expression import (
    Expression,
    Family,
    Program,
    as_expression,
    broadcast,
    leaf,
    pick,
    reduction,
    reshape,
)
from bayesmc.network.expressions import Opaque, density_at
from bayesmc.passes.arithmetic import add, multiply
from bayesmc.passes.sufficient import VALUE, NaturalForm, log_probabilities, natural_form, tabulated
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Term, Values

#: logarithm of a probability of zero, in products with indicators: 0 times it is 0, and sums stay finite
IMPOSSIBLE = -1e300
#: sums of logs below which something was impossible
NEVER = 0.1 * IMPOSSIBLE
#: values up to which each is counted
_FEW = 32
#: numbers that statistics may fill
_MOST = 1 << 26
#: numbers of the one-hot matrix that stay in cache
_CHUNK = 1 << 14
#: states from which on sums are taken by scattered adding instead
_MANY = 16
#: relative error that log densities may have, and that of the products of which they are sums
_ROUNDING, _CANCELLING = 1e-9, 1e-13


class LabelSums:
    """A known term by a label.

    Attributes
    ----------
    term : Term
    label : str
    key : str
        Name of the sums in the state, and of ``leaf``.
    states : int
    repeats : int
        Elements of the term for each of the label.
    family : Family
        Its distribution at every label: the label's plates are 1, the last of them the labels.
    centre : ndarray, shape the event
        What statistics are taken about.
    statistics : ndarray, shape (rows, elements)
        First one row (or one for each of the repeats) of ones, zero where nothing was seen.
    ones : int
        How many such rows.
    indicators : bool
        Whether all other statistics are 0 or 1.
    coefficients : Expression, shape (labels, rows)
    leaf : Leaf, shape (labels, rows)
        Sums of the statistics by label.
    expression : Expression, shape (labels, repeats)
        Log densities summed by label, up to what does not change.
    """

    def __init__(self, target: Target, term: Term, label: str) -> None:
        model = target.model
        self.target, self.term, self.label = target, term, label
        self.key = f"sums of {term.name} by {label}"
        self._of = f"labels that {self.key} belong to"
        self.node, domain = model[term.name], model[label].domain
        assert domain is not None
        self.states = domain.size
        self._inner = tuple(term.plates.index(p) for p in model[label].plates)
        self._outer = tuple(i for i in range(len(term.plates)) if i not in self._inner)
        self.repeats = math.prod(term.shape[i] for i in self._outer)
        axis = self._inner[-1]
        self.shape = tuple(
            self.states if i == axis else 1 if i in self._inner else size
            for i, size in enumerate(term.shape)
        )
        labels = (1,) * (len(self._inner) - 1) + (self.states,)
        found = density_at(model, term.name, {label: np.arange(self.states).reshape(labels)})
        if not isinstance(found, Family):
            raise TraceError("it is no distribution")
        self.family = found
        mask = None if term.mask is None else self._by_element(term.mask)
        self.ones = 1 if mask is None else self.repeats
        form = self._form(mask)
        self.indicators = form.indicators
        self.statistics = self._measured(form, mask)
        self._express(form)
        self._program = Program([self.coefficients])
        self._check()

    def table(self, values: Values) -> np.ndarray:
        """The coefficients in a state, shape ``(chains or 1, labels, rows)``; not finite where lost."""
        (found,) = self._program(values)
        return found.reshape((-1, *self.coefficients.shape))

    def sums(self, values: Values) -> np.ndarray:
        """Sums of the statistics by label in a state, shape ``(chains, labels, rows)``."""
        label = values[self.label]
        if values.get(self._of) is label:
            return values[self.key]
        return sums_by_label(label.reshape(len(label), -1), self.statistics, self.states)

    def kept(self, label: np.ndarray, sums: np.ndarray) -> Values:
        """What goes into the state with labels, from whoever has their sums at hand."""
        return {self.key: sums, self._of: label}

    def placed(self, values: Values) -> Values:
        """The state with the sums in the place of ``leaf``."""
        if values.get(self._of) is values[self.label]:
            return values
        return {**values, **self.kept(values[self.label], self.sums(values))}

    @property
    def is_asked(self) -> bool:
        """Whether anything else hidden enters: somebody needs the sums."""
        return any(n != self.label for n in self.target.hidden_above(self.term))

    # ---- private -------------------------------------------------------------------------------

    def _by_element(self, array: np.ndarray) -> np.ndarray:
        """``(*plates, *event)`` as ``(elements, repeats, *event)``."""
        event = tuple(range(len(self.shape), array.ndim))
        moved = array.transpose((*self._inner, *self._outer, *event))
        return moved.reshape((-1, self.repeats, *moved.shape[len(self.shape) :]))

    def _form(self, mask: np.ndarray | None) -> NaturalForm:
        value = self._by_element(self._value)
        shown = value if mask is None else value[mask]
        shown = shown.reshape((-1, *self.node.event_shape))
        self.centre = np.zeros(self.node.event_shape)
        if self.node.is_discrete:
            unique = np.unique(shown)
            few = not self.node.event_shape and 0 < len(unique) <= _FEW
            few = few and value.size * len(unique) <= _MOST
            try:
                form = natural_form(self.family)
            except TraceError:
                if not few:
                    raise
                return tabulated(self.family, unique)
            shorter = few and len(unique) < len(form.statistics)
            return tabulated(self.family, unique) if shorter else form
        if not len(shown):
            raise TraceError("nothing was seen")
        # about their mean, so that squares about a cluster's mean do not cancel; counts stay whole
        self.centre = shown.mean(axis=0)
        logs = np.log(shown).mean() if (shown > 0).all() else 0.0
        return natural_form(self.family, self.centre, logs)

    @property
    def _value(self) -> np.ndarray:
        value = self.target.known[self.term.name]
        domain = self.node.domain
        return value if domain is None else domain.to_support(value)

    def _measured(self, form: NaturalForm, mask: np.ndarray | None) -> np.ndarray:
        """The statistics of every element, zero where it was not seen."""
        value = self._by_element(self._value)
        full = value.shape[:2]
        found = Program(form.statistics[1:])({VALUE: value - self.centre})
        rows = [np.broadcast_to(np.asarray(row, dtype=float), full).T for row in found]
        count = np.ones((1, len(value)))
        if mask is not None:
            count = mask.T.astype(float)
            rows = [np.where(mask.T, row, 0.0) for row in rows]
        statistics = np.concatenate([count, *rows])
        if not np.isfinite(statistics).all():
            raise TraceError("its values are not in the support")
        return statistics

    def _express(self, form: NaturalForm) -> None:
        """The expressions, from coefficients whose shapes broadcast to the plates at every label."""
        order = np.arange(math.prod(self.shape)).reshape(self.shape)
        order = order.transpose((*self._inner, *self._outer)).reshape(self.states, self.repeats)
        parts = [pick([broadcast(c, self.shape)], order) for c in form.coefficients]
        first = parts[0] if self.ones == self.repeats else _summed(parts[0])
        columns = [first, *parts[1:]]
        widths = [p.shape[1] for p in columns]
        starts = np.cumsum([0, *widths[:-1]])
        at = [
            self.states * start + np.arange(self.states * width).reshape(self.states, width)
            for start, width in zip(starts, widths, strict=True)
        ]
        self.coefficients = pick(columns, np.concatenate(at, axis=1))
        self.leaf = leaf(self.key, self.coefficients.shape)
        total: Expression = as_expression(0.0)
        for part, start, width in zip(parts, starts, widths, strict=True):
            total = add(total, multiply(part, self.column(int(start), width)))
        self.expression = broadcast(total, (self.states, self.repeats))

    def column(self, start: int, width: int) -> Expression:
        """Some of the sums, shape (labels, width)."""
        rows = np.arange(self.leaf.size).reshape(self.leaf.shape)
        return pick([self.leaf], rows[:, start : start + width])

    def _check(self) -> None:
        """Refuse coefficients that do not say what the model does, up to what no label changes."""
        states = self.target.states
        if states is None:
            raise TraceError("there is no state to try it in")
        above = self.target.hidden_above(self.term)
        elements = self.statistics.shape[1]
        plates = self.target.model[self.label].plate_shape
        kind = self.target.model[self.label].domain.dtype  # type: ignore[union-attr]
        logs, found, sizes = [], [], []
        with marking_invalid(), np.errstate(all="ignore"):
            for row, step in ((0, 0), (0, 1), (-1, 2)):
                label = (np.arange(elements) + step) % self.states
                state = dict(self.target.known)
                state |= {n: states[n][row][None] for n in above}
                state[self.label] = label.reshape((1, *plates)).astype(kind)
                self.target.refresh(state, above)
                try:
                    log = np.broadcast_to(self.term.log(state), (1, *self.term.shape))[0]
                except BayesmcError as error:
                    raise TraceError(str(error)) from error
                logs.append(self._by_element(log).sum(axis=-1))
                table = np.maximum(self.table(state)[0], IMPOSSIBLE)[label]
                terms = table * self.statistics.T
                found.append(terms.sum(axis=-1))
                sizes.append(np.abs(terms).sum(axis=-1))
        for log, own, size in zip(logs, found, sizes, strict=True):
            fine = np.isfinite(log) & np.isfinite(logs[0])
            off = np.abs((log - logs[0]) - (own - found[0]))[fine]
            rounding = _ROUNDING * (1.0 + np.abs(log) + np.abs(logs[0]))
            near = off <= (rounding + _CANCELLING * (size + sizes[0]))[fine]
            # and what is impossible, as values outside of a support are, must be so here, too
            if not (near.all() and (own[log == -np.inf] < NEVER).all()):
                raise TraceError("what was read of it gives other values than the function")


class Counts:
    """How often each of a label's states came, from sums that somebody takes by it where there are any.

    Attributes
    ----------
    leaf : Leaf, shape (states,)
        What stands for them.
    sums : LabelSums or None
        That somebody takes by the label.
    """

    def __init__(self, target: Target, label: str) -> None:
        self.target, self.label = target, label
        domain = target.model[label].domain
        assert domain is not None
        self.leaf = leaf(f"counts of {label}", (domain.size,))

    def placed(self, values: Values) -> Values:
        """A state with the counts beside it."""
        if self.sums is not None:
            return {**values, self.leaf.name: self.sums.sums(values)[..., 0]}
        label = values[self.label]
        ones = np.ones((1, label[0].size))
        found = sums_by_label(label.reshape(len(label), -1), ones, self.leaf.size)
        return {**values, self.leaf.name: found[..., 0]}

    @cached_property
    def sums(self) -> LabelSums | None:
        """Looked up at the first step, when all kernels have been made."""
        return _counted(self.target, self.label)


class LabelPrior:
    """Log prior probabilities of the states: common to all elements, or of every element."""

    def __init__(self, blanket: Blanket, members: np.ndarray | None) -> None:
        self.blanket, self.members = blanket, members
        own, target = blanket.own, blanket.target
        domain = blanket.node.domain
        assert domain is not None and target.states is not None
        axes = len(blanket.node.plates)
        self._candidate = np.arange(domain.size, dtype=domain.dtype).reshape(
            (-1,) + (1,) * (1 + axes)
        )
        self.steep = False
        self._kept: np.ndarray | None = None
        log = self._evaluated(target.first_state)
        self._is_common = log.shape[2:] == (1,) * axes
        #: the common ones, shape (states,), where they are known or followed
        self.expression: Expression | None = None
        above = () if own is None else target.hidden_above(own)
        if not above:
            self._kept = self._shaped(self._evaluated({**target.known}))
            self.steep = bool((self._kept < NEVER).any())
            if self._is_common:
                self.expression = as_expression(self._kept[:, 0])
        elif self._is_common:
            self.expression = self._read()

    def _read(self) -> Expression | None:
        """The common ones as an expression, where the label's function is followed."""
        own, domain = self.blanket.own, self.blanket.node.domain
        if own is None or domain is None or isinstance(own.read, Opaque):
            return None
        values = domain.to_support(np.arange(domain.size))
        try:
            family = density_at(own.model, own.name, {})
            logs = log_probabilities(family, values)
        except TraceError:
            return None
        return reshape(logs, (domain.size,)) if logs.size == domain.size else None

    def common(self, values: Values) -> np.ndarray | None:
        """Shape (states, chains or 1), or None where elements differ or it is an expression."""
        if not self._is_common or self.expression is not None:
            return None
        return self._shaped(self._evaluated(values))

    def by_element(self, values: Values) -> np.ndarray | None:
        """Shape (states, chains or 1, elements), or None where they are alike."""
        if self._is_common:
            return None
        if self._kept is not None:
            return self._kept
        found = self._shaped(self._evaluated(values))
        self.steep = bool((found < NEVER).any())
        return found

    def _evaluated(self, values: Values) -> np.ndarray:
        state: dict[str, Any] = {**values, self.blanket.name: self._candidate}
        log = self.blanket.own_log(state)
        missing = 2 + len(self.blanket.node.plates) - log.ndim
        return log.reshape((*log.shape[:1], *(1,) * missing, *log.shape[1:])) if missing else log

    def _shaped(self, log: np.ndarray) -> np.ndarray:
        log = np.maximum(log, IMPOSSIBLE)
        if self._is_common:
            return log.reshape(log.shape[:2])
        full = np.broadcast_to(log, log.shape[:2] + self.blanket.node.plate_shape)
        flat = full.reshape((*log.shape[:2], -1))
        return flat if self.members is None else flat[..., self.members]


def label_sums(target: Target, term: Term, label: str) -> LabelSums | None:
    """A term by a label, where the label is all that its plates have to do with what is hidden.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.label_sums import label_sums
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet(plates={"kind": 2, "i": 5})
    >>> net.add("rate", bmc.Gamma(2.0, 1.0), plates="kind")
    >>> net.add("label", bmc.Categorical([0.5, 0.5]), plates="i")
    >>> net.add("x", lambda label, rate: bmc.Exponential(rate[label]), plates="i")
    >>> target = target_of(pose(net, {"x": [1.0, 3.0, 2.0, 4.0, 5.0]}))
    >>> found = label_sums(target, target.terms["x"], "label")
    >>> found.centre, found.sums({"label": np.array([[0, 1, 0, 1, 1]])}).tolist()  # how many, x - 3
    (np.float64(3.0), [[[2.0, -3.0], [3.0, 3.0]]])
    """
    if label not in term.summaries:
        term.summaries[label] = _found(target, term, label)
    return term.summaries[label]


def sums_by_label(label: np.ndarray, statistics: np.ndarray, states: int) -> np.ndarray:
    """Sums of ``statistics`` ``(rows, n)`` over the elements of every label ``(chains, n)``.

    Returns
    -------
    ndarray, shape (chains, states, rows)

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.kernels.label_sums import sums_by_label
    >>> sums_by_label(np.array([[0, 1, 0]]), np.array([[1.0, 10.0, 100.0]]), 2).tolist()
    [[[101.0], [10.0]]]
    """
    chains, n = label.shape
    found = np.zeros((chains, states, len(statistics)))
    if states > _MANY:
        index = label.astype(np.intp) + (np.arange(chains) * states)[:, None]
        for k, row in enumerate(statistics):
            weights = np.broadcast_to(row, index.shape).ravel()
            summed = np.bincount(index.ravel(), weights=weights, minlength=chains * states)
            found[:, :, k] = summed.reshape(chains, states)
        return found
    every = np.arange(states, dtype=label.dtype)[:, None]
    width = max(_CHUNK // (chains * states), 256)
    for start in range(0, n, width):
        part = slice(start, start + width)
        one_hot = (label[:, None, part] == every).astype(float)
        found += one_hot @ statistics[:, part].T
    return found


# ---- private ------------------------------------------------------------------------------------


def _counted(target: Target, label: str) -> LabelSums | None:
    """Sums by this very label that count all its elements, if somebody takes any."""
    for term in target.terms.values():
        sums = term.summaries.get(label)
        if sums is not None and sums.ones == 1 and term.mask is None:
            return sums
    return None


def _found(target: Target, term: Term, label: str) -> LabelSums | None:
    model = target.model
    node = model[label]
    own = set(node.plates)
    if term.is_potential or not own or node.domain is None or not own <= set(term.plates):
        return None
    if not node.is_stochastic or label not in target.chain or not target.is_known(term.name):
        return None
    if isinstance(term.read, Opaque):
        return None
    if [p for p in term.parents if own & set(model[p].plates)] != [label]:
        return None
    states = node.domain.size
    if states in (model.sizes[p] for p in own):
        return None  # an array of the function's own might fit by chance
    if not 2 <= states <= math.prod(node.plate_shape):
        return None
    try:
        with np.errstate(all="ignore"):
            return LabelSums(target, term, label)
    except (TraceError, np.linalg.LinAlgError):
        return None


def _summed(part: Expression) -> Expression:
    total = reduction(np.add, part, (1,))
    return pick([total], np.arange(total.size)[:, None])
