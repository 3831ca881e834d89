"""Labels of mixtures: the full conditionals of all elements as one matrix product, then a draw of each.

Log densities of every element at every state are features of the data times coefficients of the states
(``label_sums``), taken through chunks that stay in cache. The sums by label that conjugate kernels ask
for next come out of the same pass. A sweep whose products would cancel (components narrow beside the
spread of the data) or whose parameters are lost goes to ``Enumerate``, which works on residuals.

References
----------
Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), ch. 22; Diebolt and Robert (1994), JRSS B 56.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from bayesmc.categorical import impossible
from bayesmc.errors import BayesmcError
from bayesmc.expression import (
    Expression,
    as_expression,
    broadcast,
    elementwise,
    pick,
    reduction,
)
from bayesmc.expression.scalars import SmallProgram
from bayesmc.kernels.base import Kernel, Memory, check_ratio
from bayesmc.kernels.enumerate import Enumerate
from bayesmc.kernels.label_sums import (
    IMPOSSIBLE,
    NEVER,
    LabelPrior,
    LabelSums,
    label_sums,
)
from bayesmc.passes.arithmetic import add, multiply, subtract
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Values

#: sum of the sizes of the products in a log density, from which on rounding could reach 1e-9 of it
_LARGEST = 2.0**19
#: log odds that neither overflow nor, added up, reach infinity
_STEEP = 600.0
#: numbers in a chunk of log densities, and least elements of one
_CHUNK, _NARROW = 1 << 14, 512


class LostParameters(Exception):
    """Parameters that overflowed or are out of range: the model's own density says what follows."""


class Labels(Kernel):
    """Draws a finite plated node whose children's log densities are features times coefficients.

    Parameters
    ----------
    blanket : Blanket
    terms : sequence of LabelSums
        Its children.
    debug : bool
        Check log densities against the model's in every step.
    """

    label = "enumerate"

    def __init__(self, blanket: Blanket, terms: Sequence[LabelSums], debug: bool = False) -> None:
        self.blanket, self.terms, self.debug = blanket, tuple(terms), debug
        self.names = (blanket.name,)
        domain = blanket.node.domain
        assert domain is not None
        self.states, self.dtype = domain.size, domain.dtype
        self.match = f"{domain.size} states, as one matrix product"
        self.evaluations = float(domain.size)
        self.members = blanket.classes[0]
        self._plain = Enumerate(blanket)
        self._prior = LabelPrior(blanket, self.members)
        self._layout()
        self._parts: dict[int, list[tuple[slice, np.ndarray, _Buffers]]] = {}
        self._codes = np.arange(self.states, dtype=self.dtype)[:, None, None]

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        name = self.blanket.name
        chains = len(values[name])
        try:
            table = self._table(values, chains)
        except (LostParameters, np.linalg.LinAlgError):
            return self._plain.step(values, memory, rng, warmup)
        by_element = self._prior.by_element(values)
        if self.debug:
            self._check(values, table, by_element)
        label = np.empty((chains, self._features.shape[1]), dtype=self.dtype)
        sums = self._draw(table, by_element, rng, label)
        shape = values[name].shape
        if self.members is None:
            label = label.reshape(shape)
        new = {name: self.blanket.moved(values, label, self.members)}
        if self._is_asked:
            for at, term in zip(self._at, self.terms, strict=True):
                part = sums[..., at : at + len(term.statistics)]
                new |= term.kept(new[name], part)
        return new, memory

    # ---- log densities -------------------------------------------------------------------------

    def log_density(self, values: Values) -> np.ndarray:
        """Log full conditionals up to constants, shape ``(states, chains, elements)``.

        Impossible states have at most a tenth of ``IMPOSSIBLE``.
        """
        table = self._table(values, len(values[self.blanket.name]))
        return self._product(table, self._prior.by_element(values))

    def _product(self, table: _Table, by_element: np.ndarray | None) -> np.ndarray:
        log = table.rows @ self._features
        return log if by_element is None else log + by_element

    def _layout(self) -> None:
        """Stack the statistics of all children; find the row of ones that the prior multiplies."""
        parts, self._at = [], []
        start = 0
        for term in self.terms:
            parts.append(term.statistics)
            self._at.append(start)
            start += len(term.statistics)
        whole = (a for a, t in zip(self._at, self.terms, strict=True) if t.term.mask is None)
        self._one = next(whole, start)
        if self._one == start:
            parts.append(np.ones((1, parts[0].shape[1])))
        features = parts[0] if len(parts) == 1 else np.concatenate(parts)
        self._features = features if self.members is None else features[:, self.members]
        self._most = np.abs(self._features).max(axis=1, initial=1.0)
        may_vanish = np.zeros(len(self._features), dtype=bool)
        may_vanish[self._one] = True
        for at, term in zip(self._at, self.terms, strict=True):
            may_vanish[at + term.ones : at + len(term.statistics)] = term.indicators
        self._may_vanish = may_vanish
        self._plan()
        own = self.blanket.own
        weighed = own is not None and bool(self.blanket.target.hidden_above(own))
        #: whether somebody needs sums by label
        self._is_asked = self.members is None and (weighed or any(t.is_asked for t in self.terms))

    def _plan(self) -> None:
        """Programs: log odds' coefficients and the size that products can have; coefficients of states."""
        width = len(self._most)
        parts: list[Expression] = [t.coefficients for t in self.terms]
        if self._one == sum(p.shape[1] for p in parts):
            parts.append(broadcast(as_expression(0.0), (self.states, 1)))
        starts = np.cumsum([0, *(p.size for p in parts)])
        at = np.concatenate(
            [a + np.arange(p.size).reshape(p.shape) for a, p in zip(starts, parts, strict=False)], 1
        )
        prior = self._prior.expression
        if prior is not None:  # in the place of the column of what multiplies ones
            parts.append(add(pick(parts, at[:, self._one]), prior))
            at[:, self._one] = starts[-1] + np.arange(self.states)
        rows = pick(parts, at)
        assert rows.shape == (self.states, width)
        at = np.arange(rows.size).reshape(rows.shape)
        odds = subtract(pick([rows], at[1:]), pick([rows], at[:1]))
        sizes = reduction(np.add, multiply(elementwise(np.abs, rows), self._most), (1,))
        most = reduction(np.maximum, sizes, (0,))
        self._odds, self._rows = SmallProgram([odds, most]), SmallProgram([rows])

    def _table(self, values: Values, chains: int) -> _Table:
        """The coefficients of a state; raises ``LostParameters`` where products would cancel."""
        more = self._prior.common(values)
        if more is None:
            odds, most = self._odds(values)
            if np.maximum.reduce(most, axis=None) < _LARGEST:
                if odds.ndim == 2 or len(odds) < chains:
                    odds = np.broadcast_to(odds, (chains, *odds.shape[-2:]))
                return _Table(odds, lambda: self._by_state(values, chains), self._prior.steep)
        table = self._by_state(values, chains)
        if more is not None:
            table[:, :, self._one] += more
        finite = np.where(self._may_vanish & (table < NEVER), 0.0, table)
        if not (np.abs(finite) @ self._most).max() < _LARGEST:
            raise LostParameters
        table = np.maximum(table, 3 * IMPOSSIBLE)
        odds = (table[1:] - table[:1]).swapaxes(0, 1)
        lost = bool((self._may_vanish & (table < NEVER)).any())
        return _Table(odds, lambda: table, lost or self._prior.steep)

    def _by_state(self, values: Values, chains: int) -> np.ndarray:
        """Coefficients, shape (states, chains, rows)."""
        (rows,) = self._rows(values)
        full = (chains, self.states, len(self._most))
        return np.array(np.broadcast_to(rows, full).swapaxes(0, 1))

    # ---- draws ---------------------------------------------------------------------------------

    def _draw(
        self,
        table: _Table,
        by_element: np.ndarray | None,
        rng: np.random.Generator,
        label: np.ndarray,
    ) -> np.ndarray:
        """Fill in labels ``(chains, elements)``; the features' sums ``(chains, states, features)``."""
        chains, total = len(label), None
        for part, features, buffers in self._chunks(chains):
            own = None if by_element is None else by_element[..., part]
            if table.steep or self._prior.steep or not buffers.odds(table.odds, features, own):
                if buffers.tilted(table.flat, features, own) < NEVER:
                    raise impossible(f"node {self.blanket.name!r}")
            drawn = label[:, part]
            buffers.draw(rng, drawn)
            if self._is_asked:
                sums = buffers.summed(drawn, self._codes, features)
                total = sums if total is None else total + sums
        if total is None:
            return np.zeros((chains, self.states, len(self._features)))
        return total.reshape(self.states, chains, -1).swapaxes(0, 1)

    def _chunks(self, chains: int) -> list[tuple[slice, np.ndarray, _Buffers]]:
        """Equal parts of the elements: a short one at the end would cost as many calls as a long one.

        Features are copied: products with rows that lie apart in memory take three times as long.
        """
        if chains not in self._parts:
            n = self._features.shape[1]
            width = max(_CHUNK // (chains * self.states), _NARROW)
            count = max(-(-n // width), 1)
            ends = [n * i // count for i in range(count + 1)]
            sizes = {b - a for a, b in itertools.pairwise(ends)}
            buffers = {size: _Buffers(self.states, chains, size) for size in sizes}
            self._parts = {
                chains: [
                    (slice(a, b), np.ascontiguousarray(self._features[:, a:b]), buffers[b - a])
                    for a, b in itertools.pairwise(ends)
                ]
            }
        return self._parts[chains]

    def _check(self, values: Values, table: _Table, by_element: np.ndarray | None) -> None:
        """Refuse log densities that are not the model's."""
        found = self._product(table, by_element)
        axes = len(self.blanket.node.plates) if self.members is None else 1
        candidate = np.arange(self.states, dtype=self.dtype).reshape((-1, 1) + (1,) * axes)
        if self.members is not None:
            candidate = np.broadcast_to(candidate, (self.states, 1, len(self.members)))
        log = self.blanket.log_density(values, candidate, self.members)
        shape = self.blanket.current(values, self.members).shape
        log = np.broadcast_to(log, (self.states, *shape)).reshape(found.shape)
        best = log.argmax(axis=0)[None]
        top = np.take_along_axis(log, best, axis=0)
        here = found - np.take_along_axis(found, best, axis=0)
        zero = log == -np.inf
        target = np.where(zero, 0.0, log - top)
        here = np.where(zero & (here < NEVER), 0.0, here)
        sizes = np.where(zero, 0.0, np.abs(log)) + np.abs(top)
        check_ratio(self.blanket.name, self.match, target, here, sizes)


class _Table:
    """Coefficients of every state, as differences to the first or, where these may overflow, as such.

    Parameters
    ----------
    odds : ndarray, shape (chains, states - 1, features)
    rows : callable
        Gives the coefficients, shape (states, chains, features).
    steep : bool
        Whether any state may be impossible.
    """

    def __init__(self, odds: np.ndarray, rows: Callable[[], np.ndarray], steep: bool) -> None:
        self._rows, self.steep = rows, steep
        wide = len(odds) > 1
        self.odds = odds.swapaxes(0, 1).reshape(-1, odds.shape[-1]) if wide else odds[0]

    @cached_property
    def rows(self) -> np.ndarray:
        return self._rows()

    @property
    def flat(self) -> np.ndarray:
        return self.rows.reshape(-1, self.rows.shape[-1])


class _Buffers:
    """Room for one chunk, filled anew each time and never handed out."""

    def __init__(self, states: int, chains: int, width: int) -> None:
        self.log = np.empty((states, chains, width))
        self.flat = self.log.reshape(-1, width)
        self.log_odds = self.log[1:]
        self.flat_odds = self.log_odds.reshape(-1, width)
        self.level = np.empty((chains, width))
        self.passed = np.empty((states - 1, chains, width), dtype=bool)
        self.bytes = self.passed.view(np.uint8)
        self.hot = np.empty((states, chains, width))
        self.flat_hot = self.hot.reshape(-1, width)

    def odds(self, table: np.ndarray, features: np.ndarray, own: np.ndarray | None) -> bool:
        """Cumulative odds against the first state; False where these could overflow."""
        log_odds = self.log_odds
        np.dot(table, features, out=self.flat_odds)
        if own is not None:
            log_odds += own[1:] - own[0]
        if not np.maximum.reduce(log_odds, axis=None) < _STEEP:
            return False
        np.exp(log_odds, out=log_odds)
        self.log[0] = 1.0
        self._cumulate()
        return True

    def tilted(self, table: np.ndarray, features: np.ndarray, own: np.ndarray | None) -> float:
        """Cumulative densities relative to the likeliest state; the least log density of that."""
        np.dot(table, features, out=self.flat)
        if own is not None:
            self.log += own
        top = self.log.max(axis=0)
        self.log -= top
        np.exp(self.log, out=self.log)
        self._cumulate()
        return float(top.min(initial=0.0))

    def draw(self, rng: np.random.Generator, label: np.ndarray) -> None:
        """States drawn from the cumulative densities: how many of these a uniform number passes."""
        rng.random(out=self.level)
        self.level *= self.log[-1]
        np.greater_equal(self.level, self.log[:-1], out=self.passed)
        if len(self.passed) == 1:
            label[...] = self.bytes[0]
        elif len(self.passed) == 2:
            np.add(self.bytes[0], self.bytes[1], out=label)
        else:
            np.sum(self.bytes, axis=0, dtype=label.dtype, out=label)

    def summed(self, label: np.ndarray, codes: np.ndarray, features: np.ndarray) -> np.ndarray:
        """Sums of the features by state: ``(states * chains, features)``."""
        np.equal(label, codes, out=self.hot)
        return np.dot(self.flat_hot, features.T)

    def _cumulate(self) -> None:
        for k in range(1, len(self.log)):
            np.add(self.log[k], self.log[k - 1], out=self.log[k])


def label_kernel(blanket: Blanket, debug: bool = False) -> Labels | None:
    """The kernel of a mixture's labels, where the model has that form.

    A finite node in plates, all of whose children are known and depend on these plates through the node
    alone, with log densities that are features times coefficients. None where it is not so.

    Parameters
    ----------
    blanket : Blanket
    debug : bool
        Check log densities against the model's in every step (slow).

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.labels import label_kernel
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet(plates={"kind": 2, "i": 5})
    >>> net.add("level", bmc.Normal(0.0, 3.0), plates="kind")
    >>> net.add("label", bmc.Categorical([0.5, 0.5]), plates="i")
    >>> net.add("x", lambda label, level: bmc.Normal(level[label], 1.0), plates="i")
    >>> target = target_of(pose(net, {"x": [0.0, 4.0, 0.5, -0.5, 3.5]}))
    >>> kernel = label_kernel(Blanket(target, "label"))
    >>> state = {"level": np.array([[0.0, 4.0]]), "label": np.zeros((1, 5), dtype=np.uint8)}
    >>> log = kernel.log_density({**target.known, **state})
    >>> (log[1] - log[0]).round(6).tolist()  # log odds of the second kind
    [[-8.0, 8.0, -6.0, -10.0, 6.0]]
    """
    node = blanket.node
    if node.domain is None or not 2 <= node.domain.size <= 255 or not node.plates:
        return None
    if blanket.path or len(blanket.classes) != 1 or not blanket.children:
        return None
    if blanket.target.states is None:
        return None
    found = []
    with np.errstate(all="ignore"):
        for child in blanket.children:
            term = label_sums(blanket.target, child.term, blanket.name)
            if term is None or child.relation.kind != "aligned":
                return None
            found.append(term)
        kernel = Labels(blanket, found, debug)
        return kernel if _is_right(kernel) else None


# ---- private ------------------------------------------------------------------------------------


def _is_right(kernel: Labels) -> bool:
    """Whether log densities at a reachable state are the model's."""
    state = kernel.blanket.target.first_state
    try:
        table = kernel._table(state, 1)
        kernel._check(state, table, kernel._prior.by_element(state))
    except (LostParameters, np.linalg.LinAlgError):
        return True  # nothing to compare there: such states go to the plain kernel
    except BayesmcError:
        return False
    return True
