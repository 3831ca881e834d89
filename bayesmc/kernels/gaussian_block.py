"""Coupled Normal nodes drawn jointly: random effects and their mean, coefficients of one regression.

Given everything else the block is Gaussian. Its precision and linear term are sums over the terms it
enters, whose coefficients come from evaluating the user's functions at zero and at unit steps. The nodes of
one plate that meet only element by element are eliminated first (many small matrices), then the rest (one
dense matrix): the cost is linear in the elements of that plate.

References
----------
Rue and Held (2005), Gaussian Markov Random Fields, sec. 2.3; Gelfand, Sahu and Carlin (1995), Biometrika 82,
on why one at a time mixes slowly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import LogNormal, MvNormal, Normal
from bayesmc.errors import DensityError
from bayesmc.gaussian import try_cholesky
from bayesmc.kernels.base import Kernel, Memory
from bayesmc.kernels.verify import check_ratio
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.target import Target, Term, Values
from bayesmc.structure.traced import Untraceable, traced_term
from bayesmc.tracing import TracedCall, Tracer

#: components that one dense matrix may have
MAX_DENSE = 400
#: components up to which plates are not eliminated apart
_SMALL = 24

_FAMILIES = (Normal, MvNormal, LogNormal)


class GaussianBlock(Kernel):
    """Draws several Normal nodes from their joint full conditional."""

    label = "conjugate block"

    def __init__(
        self, target: Target, blankets: Mapping[str, Blanket], debug: bool = False
    ) -> None:
        self.target = target
        self.names = tuple(blankets)
        self.debug = debug
        self.terms = target.terms_of(self.names)
        self.path = target.below(self.names)
        self.layout = _Layout(target, self.names, blankets, self.terms)
        self.parts = [_Part(target, blankets, self.layout, term) for term in self.terms]
        self.match = "jointly Normal with " + ", ".join(self.names)

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        sums = self._summed(self._at_zero(values), len(values[self.names[0]]))
        noise = rng.standard_normal(sums.linear.shape)
        draw, _, bad = _solved(self.layout, sums, noise)
        if bad.any():
            raise DensityError(self._why_bad(sums))
        new = self.layout.split(draw, values)
        if self.debug:
            self._check(values, new, sums.precision, sums.linear)
        return new, memory

    def log_integral(self, values: Values, count: int) -> np.ndarray:
        """Log of the block's terms, integrated over the block, shape (count,), up to a constant.

        Minus infinity where a parameter overflows or the precision is not positive definite.
        """
        sums = self._summed(self._at_zero(values), count)
        mean, log_det, bad = _solved(self.layout, sums, None)
        log = sums.constant + 0.5 * np.vecdot(sums.linear, mean) - 0.5 * log_det
        return np.where(bad | np.isnan(log), -np.inf, log)

    # ---- private -------------------------------------------------------------------------------

    def _summed(self, base: Values, chains: int) -> _Sums:
        """What all terms say, given the state with the block at zero."""
        sums = _Sums(chains, self.layout)
        for part in self.parts:
            part.add(base, sums)
        return sums

    def _why_bad(self, sums: _Sums) -> str:
        if sums.problem is not None:
            return str(sums.problem)
        return (
            f"nodes {', '.join(map(repr, self.names))}: their joint precision given the others is not "
            "positive definite; a scale is near zero or infinite"
        )

    def _at_zero(self, values: Values) -> Values:
        """The state with the block at zero (what is seen of it stays)."""
        state = dict(values)
        for name in self.names:
            state[name] = self.layout.base[name]
        for link in self.path:
            state[link], _ = self.target.model.evaluate(link, state)
        return state

    def _check(
        self, values: Values, new: Values, precision: np.ndarray, linear: np.ndarray
    ) -> None:
        after = {**values, **new}
        self.target.refresh(after, self.names)
        logs, sizes = [], []
        for state in (values, after):
            parts = [np.asarray(self.target.log_density(state, [t])) for t in self.terms]
            logs.append(sum(parts))
            sizes.append(sum(np.abs(p) for p in parts))
        joined = [self.layout.joined(state) for state in (values, after)]
        dense = self.layout.dense(precision)
        gauss = []
        for x in joined:
            gauss.append(np.vecdot(linear, x) - 0.5 * np.vecdot(x, np.matvec(dense, x)))
            sizes.append(np.abs(np.vecdot(linear, x)) + np.abs(np.vecdot(x, np.matvec(dense, x))))
        check_ratio(
            ", ".join(self.names), self.match, logs[1] - logs[0], gauss[1] - gauss[0], sum(sizes)
        )


class _Sums:
    """Precision, linear term and constant of the log density of a block, per chain, as terms add to them."""

    def __init__(self, chains: int, layout: _Layout) -> None:
        self.precision = np.zeros((chains, layout.entries))
        self.linear = np.zeros((chains, layout.size))
        self.constant = np.zeros(chains)
        self.bad = np.zeros(chains, dtype=bool)
        self.problem: str | None = None

    def add(self, precision: Any, linear: Any, constant: Any) -> None:
        self.precision += precision
        self.linear += linear
        self.constant += constant

    def mark(self, bad: np.ndarray, problem: str) -> None:
        """Chains in which a term has no meaning."""
        self.bad |= bad
        self.problem = self.problem or problem


class _Layout:
    """Where every component of the block stands: local ones by element, then the dense rest."""

    def __init__(
        self,
        target: Target,
        names: Sequence[str],
        blankets: Mapping[str, Blanket],
        terms: Sequence[Term],
    ) -> None:
        self.names = tuple(names)
        self.nodes = {n: target.model[n] for n in names}
        self.counts = {n: math.prod(self.nodes[n].plate_shape) for n in names}
        self.dims = {n: math.prod(self.nodes[n].event_shape) for n in names}
        self.free: dict[str, np.ndarray] = {}
        self.base: Values = {}
        for n in names:
            seen = target.seen(n)
            free = np.ones(self.nodes[n].plate_shape, dtype=bool)
            base = np.zeros((1, *self.nodes[n].value_shape))
            if seen is not None:
                assert seen.mask is not None
                free = ~seen.mask
                mask = seen.mask.reshape(seen.mask.shape + (1,) * len(self.nodes[n].event_shape))
                base[0] = np.where(mask, seen.value, 0.0)
            self.free[n] = free.ravel()
            self.base[n] = base
        self.local = _local_nodes(target, self.names, blankets, terms, self.counts, self.dims)
        self.rest = tuple(n for n in names if n not in self.local)
        self.n = self.counts[self.local[0]] if self.local else 0
        self.dl = sum(self.dims[n] for n in self.local)
        self.dg = sum(self.counts[n] * self.dims[n] for n in self.rest)
        self.size = self.n * self.dl + self.dg
        self.offset: dict[str, int] = {}
        at = 0
        for n in self.local:
            self.offset[n] = at
            at += self.dims[n]
        at = 0
        for n in self.rest:
            self.offset[n] = at
            at += self.counts[n] * self.dims[n]
        #: entries of the three parts of the precision, and one to throw away
        self.entries = self.n * self.dl * (self.dl + self.dg) + self.dg**2 + 1

    def place(self, name: str, component: int, elements: np.ndarray) -> np.ndarray:
        """Position in the joined vector of one component of some elements."""
        if name in self.local:
            return elements * self.dl + self.offset[name] + component
        return self.n * self.dl + self.offset[name] + elements * self.dims[name] + component

    def entry(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Entry of the precision for two positions; what is kept elsewhere goes to the last."""
        cut = self.n * self.dl
        n, dl, dg = self.n, self.dl, self.dg
        # all kinds are computed and one picked
        element, inner = np.divmod(row, max(dl, 1))
        both = element * dl * dl + inner * dl + column % max(dl, 1)
        mixed = n * dl * dl + row * dg + (column - cut)
        rest = n * dl * (dl + dg) + (row - cut) * dg + (column - cut)
        row_local, column_local = row < cut, column < cut
        found = np.where(row_local & column_local, both, self.entries - 1)
        found = np.where(row_local & ~column_local, mixed, found)
        return np.where(~row_local & ~column_local, rest, found)

    def blocks(self, precision: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Precision of local elements, between them and the rest, and of the rest."""
        chains = len(precision)
        n, dl, dg = self.n, self.dl, self.dg
        first, second = n * dl * dl, n * dl * (dl + dg)
        local = precision[:, :first].reshape(chains, n, dl, dl)
        mixed = precision[:, first:second].reshape(chains, n, dl, dg)
        rest = precision[:, second:-1].reshape(chains, dg, dg)
        return local, mixed, rest

    def dense(self, precision: np.ndarray) -> np.ndarray:
        """The whole precision matrix (for checks)."""
        local, mixed, rest = self.blocks(precision)
        chains, cut = len(precision), self.n * self.dl
        full = np.zeros((chains, self.size, self.size))
        for e in range(self.n):
            at = slice(e * self.dl, (e + 1) * self.dl)
            full[:, at, at] = local[:, e]
            full[:, at, cut:] = mixed[:, e]
            full[:, cut:, at] = np.swapaxes(mixed[:, e], -1, -2)
        full[:, cut:, cut:] = rest
        return full

    def split(self, joined: np.ndarray, values: Mapping[str, np.ndarray]) -> Values:
        """A joined vector per chain as values of the nodes; what was seen stays."""
        new: Values = {}
        chains = len(joined)
        cut = self.n * self.dl
        local = joined[:, :cut].reshape(chains, self.n, self.dl)
        for name in self.names:
            d, count, at = self.dims[name], self.counts[name], self.offset[name]
            if name in self.local:
                part = local[:, :, at : at + d]
            else:
                part = joined[:, cut + at : cut + at + count * d].reshape(chains, count, d)
            if not self.free[name].all():
                old = values[name].reshape(chains, count, d)
                part = np.where(self.free[name][:, None], part, old)
            new[name] = np.ascontiguousarray(part).reshape(chains, *self.nodes[name].value_shape)
        return new

    def joined(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Values of the nodes as one vector per chain, what was seen as zero."""
        chains = len(values[self.names[0]])
        joined = np.zeros((chains, self.size))
        for name in self.names:
            flat = values[name].reshape(chains, self.counts[name], self.dims[name])
            flat = np.where(self.free[name][:, None], flat, 0.0)
            for c in range(self.dims[name]):
                joined[:, self.place(name, c, np.arange(self.counts[name]))] = flat[..., c]
        return joined


class _Part:
    """What one term says of the block: rows ``constant + coefficients @ unknowns``, whitened.

    Coefficients and the data's part are kept where they cannot change; a noise that is the same for all
    elements of a chain then only scales what was summed before.
    """

    def __init__(
        self, target: Target, blankets: Mapping[str, Blanket], layout: _Layout, term: Term
    ) -> None:
        self.target, self.layout, self.term = target, layout, term
        self.node = target.model[term.name]
        self.own = term.name in layout.names
        self.d = math.prod(self.node.event_shape)
        self.count = math.prod(term.shape)
        self.children: dict[str, Child] = {}
        for name, blanket in blankets.items():
            for child in blanket.children:
                if child.term is term:
                    self.children[name] = child
        self.blankets = blankets
        self.columns = [(n, c) for n in self.children for c in range(layout.dims[n])]
        self.dynamic = next(
            (n for n, c in self.children.items() if c.relation.kind == "lookup"), None
        )
        above = _hidden_above(target, term)
        sources = None if above is None or self.dynamic else _affine_sources(target, term, above)
        #: coefficients never change; nor does anything else but the noise; nor does that
        self.constant = sources is not None
        self.fixed = sources is not None and sources <= set(layout.names)
        self.fixed &= self.own or term.name not in target.chain  # a hidden child's value changes
        self.frozen = self.fixed and set(above or ()) <= set(layout.names)
        self.kept: Any = None
        self.slopes: np.ndarray | None = None
        self.summed: Any = None
        self.spots = None if self.dynamic else self._spots(())

    def add(self, base: Values, sums: _Sums) -> None:
        """Add what the term says, given the state with the block at zero."""
        fixed = self.fixed and (
            self.own or base[self.term.name] is self.target.known[self.term.name]
        )
        if fixed and self.frozen and self.summed is not None:
            sums.add(*self.summed)
            return
        dist, _, keys = self._distribution(base)
        if dist.invalid is not None:
            plates = len(self.term.shape)
            invalid = np.broadcast_to(
                dist.invalid, dist.invalid.shape[: dist.invalid.ndim - plates] + self.term.shape
            )
            bad = invalid.reshape(*invalid.shape[: invalid.ndim - plates], -1).any(axis=-1)
            sums.mark(bad, f"node {self.term.name!r}: {dist.problem}")
        spots = self.spots if self.spots is not None else self._spots(keys)
        uniform = self._uniform_scale(dist)
        if fixed and not self.frozen and uniform is not None:
            if self.summed is None:
                self.summed = _first(self._sums(*self._rows(base, dist), spots))
            weight = uniform**-2.0
            precision, linear, constant = self.summed
            constant = weight * constant - self.count * np.log(uniform)
            sums.add(weight[:, None] * precision, weight[:, None] * linear, constant)
            return
        rows = self.kept
        if rows is None or not fixed:
            rows = self._rows(base, dist)
            self.kept = _first(rows) if fixed else None
        whitened, log_det = self._whitened(dist, *rows)
        precision, linear, constant = self._sums(*whitened, spots)
        summed = precision, linear, constant - log_det
        if fixed and self.frozen:
            self.summed = _first(summed)
        sums.add(*summed)

    # ---- private -------------------------------------------------------------------------------

    def _distribution(self, state: Values) -> tuple[Any, Any, Any]:
        if self.dynamic is not None:
            return self.blankets[self.dynamic].distribution(self.children[self.dynamic], state)
        return (*self.term.distribution(state), ())

    def _uniform_scale(self, dist: Any) -> np.ndarray | None:
        """The noise of a scalar term where it is the same for all its elements, shape (chains or 1,)."""
        if self.d != 1 or isinstance(dist, MvNormal) or self.term.mask is not None:
            return None
        scale = dist.scale
        plates = len(self.term.shape)
        if plates and scale.ndim >= 1 and any(n != 1 for n in scale.shape[-plates:]):
            return None
        return scale.reshape(-1)

    def _rows(self, base: Values, dist: Any) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients ``(lead, elements, d, columns)`` and constants ``(lead, elements, d)`` of residuals."""
        zero = self._flat(dist.loc)
        if self.slopes is not None:
            slopes = self.slopes
        else:
            steps = [self._flat(self._stepped(base, n, c).loc) - zero for n, c in self.columns]
            lead = np.broadcast_shapes((1,), *(s.shape[:1] for s in steps))
            slopes = np.zeros((*lead, self.count, self.d, len(steps)))
            for k, step in enumerate(steps):
                slopes[..., k] = step
            if self.constant:  # the same for all chains
                slopes = self.slopes = slopes[:1]
        coefficients = -slopes
        if not self.own:
            value = base[self.term.name]
            if isinstance(dist, LogNormal):
                value = np.log(value)
            return coefficients, self._flat(value) - zero
        free = self.layout.free[self.term.name].astype(float)
        identity = np.eye(self.d) * free[:, None, None]
        identity = np.broadcast_to(identity, (*coefficients.shape[:-1], self.d))
        seen = self._flat(self.layout.base[self.term.name])
        return np.concatenate([coefficients, identity], axis=-1), seen - zero

    def _stepped(self, base: Values, name: str, component: int) -> Any:
        """The term's distribution with one component of all free elements of a node at one."""
        node = self.layout.nodes[name]
        step = np.zeros((1, self.layout.counts[name], self.layout.dims[name]))
        step[0, self.layout.free[name], component] = 1.0
        state = dict(base)
        state[name] = base[name] + step.reshape(1, *node.value_shape)
        for link in self.target.below((name,)):
            state[link], _ = self.target.model.evaluate(link, state)
        return self._distribution(state)[0]

    def _flat(self, array: np.ndarray) -> np.ndarray:
        """``(*lead, *plates, *event)`` as ``(lead, elements, d)``."""
        shape = self.term.shape + self.node.event_shape
        array = np.asarray(array)
        lead = array.shape[: max(array.ndim - len(shape), 0)]
        full = np.broadcast_to(array, lead + shape)
        return full.reshape(math.prod(lead), self.count, self.d)

    def _whitened(
        self, dist: Any, rows: np.ndarray, rest: np.ndarray
    ) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
        """Rows over the noise, and the log determinant of its root over all elements, shape (lead,)."""
        shape = np.broadcast_shapes(rows.shape[:-1], rest.shape)
        rows = np.broadcast_to(rows, (*shape, rows.shape[-1]))
        joint = np.concatenate([rows, np.broadcast_to(rest, shape)[..., None]], axis=-1)
        if isinstance(dist, MvNormal):
            factor = dist.scale_tril
            lead = factor.shape[: max(factor.ndim - 2 - len(self.term.shape), 0)]
            factor = np.broadcast_to(factor, (*lead, *self.term.shape, self.d, self.d))
            factor = factor.reshape(math.prod(lead), self.count, self.d, self.d)
            joint = np.linalg.solve(factor, joint)
            log_scale = np.log(np.linalg.diagonal(factor)).sum(axis=-1)
        else:
            scale = self._flat(dist.scale)
            joint = joint / scale[..., None]
            log_scale = np.log(scale).sum(axis=-1)
        if self.term.mask is not None:
            joint = joint * self.term.mask.reshape(-1, 1, 1)
            log_scale = log_scale * self.term.mask.reshape(-1)
        return (joint[..., :-1], joint[..., -1]), log_scale.sum(axis=-1)

    def _spots(self, keys: Any) -> tuple[np.ndarray, np.ndarray]:
        """Positions of the columns ``(lead, elements, columns)``, and entries of their pairs."""
        places = []
        for name, component in self.columns:
            at = self._elements_of(name, keys)
            places.append(self.layout.place(name, component, at))
        if self.own:
            own = np.arange(self.count)[None]
            places += [self.layout.place(self.term.name, c, own) for c in range(self.d)]
        at = np.stack(np.broadcast_arrays(*places), axis=-1)
        return at, self.layout.entry(at[..., :, None], at[..., None, :])

    def _elements_of(self, name: str, keys: Any) -> np.ndarray:
        """Element of a node that each element of the term depends on, shape (lead, elements)."""
        relation = self.children[name].relation
        if relation.kind == "lookup":
            index = relation.index_of(keys, self.term.shape)
            return index.reshape(-1, self.count)
        if relation.kind == "rows":
            return relation.rows[0][None]
        node = self.layout.nodes[name]
        if not node.plates:
            return np.zeros((1, self.count), dtype=np.intp)
        at = np.unravel_index(np.arange(self.count), self.term.shape)
        picked = [at[self.term.plates.index(p)] for p in node.plates]
        return np.ravel_multi_index(picked, node.plate_shape)[None]

    def _sums(
        self,
        rows: np.ndarray,
        rest: np.ndarray,
        spots: tuple[np.ndarray, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Precision entries, linear terms and constants summed over elements, lead in front."""
        pairs = np.einsum("...ka,...kb->...ab", rows, rows)
        line = -np.einsum("...ka,...k->...a", rows, rest)
        return (
            _scattered(pairs, spots[1], self.layout.entries),
            _scattered(line, spots[0], self.layout.size),
            -0.5 * (rest * rest).sum(axis=(-2, -1)),
        )


def gaussian_blocks(
    target: Target, blankets: Mapping[str, Blanket], debug: bool = False
) -> list[GaussianBlock]:
    """Blocks of two or more coupled Normal nodes whose terms are jointly affine in them."""
    able = [n for n, b in blankets.items() if _is_able(target, b)]
    groups: list[list[str]] = []
    for name in able:
        shared = [g for g in groups if _meets(target, name, g)]
        merged = [name]
        for group in shared:
            if _jointly_affine(target, [*group, *merged], blankets):
                merged = [*group, *merged]
                groups.remove(group)
        groups.append(merged)
    found = []
    for group in groups:
        order = [n for n in target.chain if n in group]
        if len(order) < 2:
            continue
        block = GaussianBlock(target, {n: blankets[n] for n in order}, debug)
        if block.layout.dg <= MAX_DENSE:
            found.append(block)
    return found


# ---- private ------------------------------------------------------------------------------------


def _solved(
    layout: _Layout, sums: _Sums, noise: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean plus noise of the Gaussian's covariance, the log determinant of its precision, and bad chains."""
    linear = sums.linear
    chains = len(linear)
    local, mixed, rest = layout.blocks(sums.precision)
    local, rest = _with_units(layout, local, rest)
    cut, n, dl, dg = layout.n * layout.dl, layout.n, layout.dl, layout.dg
    joined = np.empty_like(linear)
    right = linear[:, cut:]
    log_det = np.zeros(chains)
    bad = sums.bad
    if cut:
        root, wrong = _factor(local)
        bad = bad | wrong.any(axis=-1)
        head = linear[:, :cut].reshape(chains, n, dl)
        both = np.concatenate([mixed, head[..., None]], axis=-1)
        both = both / root if dl == 1 else np.linalg.solve(root, both)
        mixed, head = both[..., :-1], both[..., -1]
        tall = mixed.reshape(chains, cut, dg)
        rest = rest - np.swapaxes(tall, -1, -2) @ tall
        right = right - np.vecmat(head.reshape(chains, cut), tall)
        log_det += 2.0 * np.log(np.linalg.diagonal(root)).sum(axis=(-2, -1))
    if dg:
        factor, wrong = _factor(rest)
        bad = bad | wrong
        half = np.linalg.solve(factor, right[..., None])[..., 0]
        if noise is not None:
            half = half + noise[:, cut:]
        joined[:, cut:] = np.linalg.solve(np.swapaxes(factor, -1, -2), half[..., None])[..., 0]
        log_det += 2.0 * np.log(np.linalg.diagonal(factor)).sum(axis=-1)
    if cut:
        if noise is not None:
            head = head + noise[:, :cut].reshape(head.shape)
        if dg:
            head = head - np.matvec(mixed, joined[:, None, cut:])
        if dl == 1:
            drawn = head / root[..., 0]
        else:
            drawn = np.linalg.solve(np.swapaxes(root, -1, -2), head[..., None])[..., 0]
        joined[:, :cut] = drawn.reshape(chains, cut)
    return joined, log_det, bad


def _factor(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cholesky factors, and which matrices have none (those get the identity)."""
    try:
        if matrices.shape[-1] == 1:
            wrong = ~((matrices > 0) & (matrices < np.inf))[..., 0, 0]
            return np.sqrt(np.where(wrong[..., None, None], 1.0, matrices)), wrong
        factor = np.linalg.cholesky(matrices)
        wrong = ~np.isfinite(factor).all(axis=(-2, -1))
        if not wrong.any():
            return factor, wrong
    except np.linalg.LinAlgError:
        pass
    factor, refused = try_cholesky(matrices)
    found = np.zeros(matrices.shape[:-2], dtype=bool) if refused is None else refused
    return factor, found


def _with_units(
    layout: _Layout, local: np.ndarray, rest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ones on the diagonal of what was seen, which nothing else says anything about."""
    for name in layout.names:
        free = layout.free[name]
        if free.all():
            continue
        seen = np.flatnonzero(~free)
        for c in range(layout.dims[name]):
            if name in layout.local:
                local = local.copy()
                local[:, seen, layout.offset[name] + c, layout.offset[name] + c] = 1.0
            else:
                at = layout.offset[name] + seen * layout.dims[name] + c
                rest = rest.copy()
                rest[:, at, at] = 1.0
    return local, rest


def _first(arrays: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """What is the same for all chains, once."""
    return tuple(a[:1] for a in arrays)


def _scattered(values: np.ndarray, spots: np.ndarray, count: int) -> np.ndarray:
    """Sums of ``values (lead, *rest)`` by ``spots (lead or 1, *rest)``, shape (lead, count)."""
    lead = max(len(values), len(spots))
    values = np.broadcast_to(values, (lead, *values.shape[1:])).reshape(lead, -1)
    spots = np.broadcast_to(spots, (lead, *spots.shape[1:])).reshape(lead, -1)
    if lead == 1:
        return np.bincount(spots[0], weights=values[0], minlength=count)[None]
    offsets = np.arange(lead)[:, None] * count
    flat = np.bincount((spots + offsets).ravel(), weights=values.ravel(), minlength=lead * count)
    return flat.reshape(lead, count)


def _is_able(target: Target, blanket: Blanket) -> bool:
    """Whether a node is Normal with a Gaussian full conditional, as far as blocks can use it."""
    if blanket.own is None or len(blanket.event_shape) > 1 or blanket.node.is_discrete:
        return False
    for child in blanket.children:
        kind = child.relation.kind
        if kind == "whole" or (kind == "rows" and len(child.relation.rows) != 1):
            return False
        if child.term.is_potential or not _is_affine(target, (blanket.name,), child.term):
            return False
    return _is_affine(target, (), blanket.own, (Normal, MvNormal))


def _is_affine(
    target: Target, names: tuple[str, ...], term: Term, families: tuple[type, ...] = _FAMILIES
) -> bool:
    """Whether a term is Gaussian with a mean affine in the nodes, and nothing else of it varies with them."""
    if not names:
        try:
            result = target.model.evaluate(term.name, {**target.model.probe, **target.known})[0]
        except Exception:
            return False
        return type(result) in families
    try:
        result = traced_term(target, names, term).result
    except Untraceable:
        return False
    if not isinstance(result, TracedCall):
        return not isinstance(result, Tracer)  # it names the nodes and does nothing with them
    if result.function not in families:
        return False
    traced = result.traced
    return set(traced) <= {"loc"} and all(
        isinstance(v, Tracer) and v.is_affine for v in traced.values()
    )


def _meets(target: Target, name: str, group: Sequence[str]) -> bool:
    mine = {id(t) for t in target.terms_of((name,))}
    return any(id(t) in mine for other in group for t in target.terms_of((other,)))


def _jointly_affine(target: Target, names: Sequence[str], blankets: Mapping[str, Blanket]) -> bool:
    for term in target.terms_of(tuple(names)):
        entering = tuple(n for n in names if any(c.term is term for c in blankets[n].children))
        lookups = [
            n
            for n in entering
            for c in blankets[n].children
            if c.term is term and c.relation.kind == "lookup"
        ]
        if len(lookups) > 1 or (lookups and len(entering) > 1):
            return False
        if len(entering) > 1 and not _is_affine(target, entering, term):
            return False
    return True


def _affine_sources(target: Target, term: Term, above: Sequence[str]) -> set[str] | None:
    """The hidden nodes that a term's mean is jointly affine in; None where it is not in some."""
    if not above:
        return set()
    try:
        result = traced_term(target, tuple(above), term).result
    except Untraceable:
        return None
    loc = result.arguments.get("loc") if isinstance(result, TracedCall) else None
    if not isinstance(loc, Tracer):
        return set()
    return {s.split("[")[0] for s in loc.sources} if loc.is_affine else None


def _hidden_above(target: Target, term: Term) -> list[str] | None:
    """Hidden continuous nodes above a term; None where a discrete one is among them."""
    todo, seen, found = list(term.parents), set(), []
    while todo:
        name = todo.pop()
        if name in seen or name in target.known:
            continue
        seen.add(name)
        node = target.model[name]
        if not node.is_stochastic:
            todo += node.parents
        elif node.is_discrete:
            return None
        else:
            found.append(name)
    return [n for n in target.chain if n in found]


def _local_nodes(
    target: Target,
    names: Sequence[str],
    blankets: Mapping[str, Blanket],
    terms: Sequence[Term],
    counts: Mapping[str, int],
    dims: Mapping[str, int],
) -> tuple[str, ...]:
    """Nodes of one plate that meet only element by element, to be eliminated first."""
    if sum(counts[n] * dims[n] for n in names) <= _SMALL:
        return ()
    groups: dict[tuple[str, ...], list[str]] = {}
    for n in names:
        if target.model[n].plates:
            groups.setdefault(target.model[n].plates, []).append(n)
    order = sorted(groups.values(), key=lambda g: -sum(counts[n] * dims[n] for n in g))
    for group in order:
        if all(_meet_alone(target, group, blankets, term) for term in terms):
            return tuple(group)
    return ()


def _meet_alone(
    target: Target, group: Sequence[str], blankets: Mapping[str, Blanket], term: Term
) -> bool:
    """Whether every element of a term depends on one element of the group's plates only."""
    indices = []
    for name in group:
        if term.name == name:
            indices.append(np.arange(math.prod(term.shape)))
        for child in blankets[name].children:
            if child.term is not term:
                continue
            relation = child.relation
            if relation.kind == "lookup":
                indices.append(None)
            elif relation.kind == "rows":
                indices.append(relation.rows[0])
            else:
                at = np.unravel_index(np.arange(math.prod(term.shape)), term.shape)
                picked = [at[term.plates.index(p)] for p in relation.plates]
                indices.append(np.ravel_multi_index(picked, relation.shape))
    if len(indices) <= 1:
        return True
    if any(i is None for i in indices):
        return False
    return all(np.array_equal(indices[0], i) for i in indices[1:])
