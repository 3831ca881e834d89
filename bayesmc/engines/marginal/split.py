"""Which hidden nodes of a template are integrated out, and which are sampled, and why not fewer.

What is integrated out is linear-Gaussian given everything else: means affine in each other and in their
values of the slice before, scales free of them, coefficients any function of sampled nodes, of what is seen,
of inputs and of time. Nothing that is sampled depends on it. Where a density breaks this, as few numbers as
possible are sampled instead, with whatever they depend on. Of nodes that are named means may be bent
(``linearised``).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from bayesmc.dbn import PREVIOUS, Slices
from bayesmc.engines.kalman.reading import why_not_placed
from bayesmc.engines.kalman.slices import Layout, always_unknown
from bayesmc.engines.marginal.linearised import why_not_bent
from bayesmc.engines.marginal.tables.plan import TablePlan, nodes_read
from bayesmc.engines.marginal.tables.search import found_plan, is_finite, named_plan
from bayesmc.engines.slice_steps import plates_apart
from bayesmc.errors import UnsupportedError, did_you_mean

AUTO = "auto"
#: why some numbers are not integrated out, but where they are measured and missing
_ANGLE = "is an angle"
_UNNAMED = "marginalize= does not name it"


@dataclass(frozen=True)
class Split:
    """The hidden nodes of a template in two.

    Attributes
    ----------
    seen : frozenset of str
        Nodes that are taken to be seen in full in every slice.
    inner : tuple of str
        Nodes with a density that are integrated out, in the order of the slice.
    below : frozenset of str
        Nodes seen that depend on these.
    why : dict
        Hidden node that is sampled -> why it is not integrated out.
    linearised : dict
        Node whose mean is linearised at each particle's own mean -> why it must be.
    tables : TablePlan or None
        Finite nodes that are integrated out.
    """

    seen: frozenset[str]
    inner: tuple[str, ...]
    below: frozenset[str]
    why: Mapping[str, str] = field(default_factory=dict, hash=False)
    linearised: Mapping[str, str] = field(default_factory=dict, hash=False)
    tables: TablePlan | None = field(default=None, compare=False)

    @property
    def names(self) -> tuple[str, ...]:
        """All nodes that are integrated out."""
        return self.inner if self.tables is None else (*self.inner, *sorted(self.tables.names))

    @property
    def waiting(self) -> frozenset[str]:
        """These, and what is worked out after them, of which no particle has a value that others may read."""
        tables = self.tables
        late = frozenset() if tables is None else tables.computed | (tables.below - self.seen)
        return late.union(self.names)


def split_of(
    slices: Slices,
    seen: frozenset[str],
    asked: str | tuple[str, ...],
    static: Mapping[str, np.ndarray],
    untabled: str | None = None,
) -> Split:
    """The split that is asked for: ``"auto"``, which integrates out what it can, or nodes by name.

    Parameters
    ----------
    seen : frozenset of str
        Nodes that are seen in full in every slice.
    static : dict
        Values of the static nodes.
    untabled : str or None
        Why finite nodes may not be integrated out.

    Raises
    ------
    UnsupportedError
        A node that is named cannot be integrated out.
    """
    kept = slices.later.cache.setdefault("splits", {})
    key = (seen, asked, untabled, tuple((n, np.asarray(v).tobytes()) for n, v in static.items()))
    if key not in kept:
        kept[key] = _found(slices, seen, asked, static, untabled)
    return kept[key]


def blocks_of(slices: Slices, split: Split) -> tuple[str, ...]:
    """Plates whose elements never meet given what is sampled: each has a Gaussian of its own.

    All that depends on what is integrated out lives in them, and reads its own element of it.
    """
    if not split.inner:
        return ()
    layouts = layouts_of(slices, split.inner, ())
    placed = {n for layout in layouts for n in (*layout.placed, *layout.silent)}
    some = next(iter(placed))
    found = [
        p for p in slices.first[some].plates if all(p in slices.first[n].plates for n in placed)
    ]
    for layout in layouts:
        hidden = layout.unknown | {n + PREVIOUS for n in layout.before}
        for name in layout.placed:
            for parent, link in layout.model[name].links:
                if parent in hidden:
                    found = [p for p in found if p not in link.foreign]
    return tuple(found)


def layouts_of(
    slices: Slices, inner: Collection[str], apart: tuple[str, ...]
) -> tuple[Layout, Layout]:
    """Slice 0 and later ones, where all nodes with a density are known but some."""
    known = frozenset(slices.stochastic) - frozenset(inner)
    unknown = always_unknown(slices, known)
    before = tuple(n for n in slices.interface if n in unknown)
    first, later = (Layout(slices, apart, k == 0, before, unknown) for k in range(2))
    return first, later


# ---- private ------------------------------------------------------------------------------------


def _found(
    slices: Slices,
    seen: frozenset[str],
    asked: str | tuple[str, ...],
    static: Mapping[str, np.ndarray],
    untabled: str | None,
) -> Split:
    """Numbers first, then finite nodes that these leave."""
    search = _Search(slices, seen, static)
    if asked == AUTO:
        numbers = search.found()
        if untabled is not None:
            return numbers
        # what is measured and missing, of nothing that is integrated out, can as well wait for tables
        loose = search.loose(numbers.inner)
        apart_from = {*numbers.inner, *numbers.below} - loose
        tables, why = found_plan(slices, search.hidden, seen, apart_from, static)
        waits = frozenset() if tables is None else loose & tables.below
        inner = tuple(n for n in numbers.inner if n not in waits)
        return replace(numbers, inner=inner, why={**numbers.why, **why}, tables=tables)
    finite = [n for n in asked if n in search.hidden and is_finite(slices, n)]
    others = tuple(n for n in asked if n not in finite)
    if finite and untabled is not None:
        raise UnsupportedError(
            f"marginalize= names {finite[0]!r}, of which tables tell nothing of slices before here: "
            f"{untabled}; leave {', '.join(map(repr, finite))} out"
        )
    numbers = search.named(others, finite)
    apart_from = {*numbers.inner, *numbers.below}
    return replace(numbers, tables=named_plan(slices, finite, seen, apart_from, static))


class _Search:
    """Takes nodes out of those that are integrated out until all that is left is linear-Gaussian."""

    def __init__(
        self, slices: Slices, seen: frozenset[str], static: Mapping[str, np.ndarray]
    ) -> None:
        self.slices, self.seen = slices, seen
        self.apart = plates_apart(slices)
        self.hidden = [n for n in slices.stochastic if n not in seen]
        self.models = (slices.first, slices.later)
        self._computed = set(slices.dynamic) - set(slices.stochastic)
        dynamic = {*slices.dynamic, *(n + PREVIOUS for n in slices.dynamic)}
        # a batch, as what is sampled has another value for every particle
        self.values = {
            n: np.stack([v, v]) if n in dynamic else v
            for model in self.models
            for n, v in model.probe.items()
        } | dict(static)
        self.why: dict[str, str] = {}
        #: nodes that are linearised, once it is asked for by name
        self.bent: dict[str, str] | None = None

    def found(self) -> Split:
        inner = set(self.hidden)
        for name in self.hidden:
            reason = self._never(name)
            if reason is not None:
                inner = self._without(inner, (name,), reason)
        while True:
            fault = self._fault(inner)
            if fault is None:
                break
            name, reason = fault
            inner = self._without(inner, self._given_up(inner, name), f"node {name!r} {reason}")
        return self._split(inner, self.why)

    def named(self, names: tuple[str, ...], finite: Collection[str] = ()) -> Split:
        if not names and finite:
            return self._split((), {n: _UNNAMED for n in self.hidden if n not in finite})
        for name in names:
            if name not in self.slices.dynamic:
                raise UnsupportedError(
                    f"marginalize= names {name!r}, which is no node of a slice"
                    f"{did_you_mean(name, self.hidden)}; hidden are {self.hidden}"
                )
            reason = self._never(name) if name in self.hidden else "is not hidden, or computed"
            if reason is not None:
                raise UnsupportedError(
                    f"marginalize= names {name!r}, and that node {reason}; leave it out"
                )
        inner = set(names)
        read = {p for model in self.models for n in self.slices.dynamic for p in model[n].parents}
        read = {p.removesuffix(PREVIOUS) for p in read}
        for name in self.hidden:  # what is measured of them, where it is missing
            fits = self._never(name) in (None, _ANGLE)
            if name not in read and fits and self._above((name,), inner):
                inner.add(name)
        for name in self.hidden:
            above = [] if name in inner else sorted(self._above((name,), inner))
            if above:
                raise UnsupportedError(
                    f"marginalize= names {above[0]!r}, on which {name!r} depends, which is sampled; name "
                    f"{name!r}, too, or leave {above[0]!r} out"
                )
        self.bent = {}
        fault = self._fault(inner)
        if fault is not None:
            name, reason = fault
            raise UnsupportedError(
                f"marginalize={list(names)} is not linear-Gaussian given the rest: node {name!r} {reason}; "
                'name fewer, or give marginalize="auto"'
            )
        why = {n: _UNNAMED for n in self.hidden if n not in inner and n not in finite}
        return self._split(inner, why)

    def loose(self, inner: Collection[str]) -> frozenset[str]:
        """Numbers integrated out that depend on none of the others, and that nothing reads."""
        read = nodes_read(self.slices)
        return frozenset(n for n in inner if n not in read and not self._above((n,), inner))

    # ---- private -------------------------------------------------------------------------------

    def _split(self, inner: Collection[str], why: Mapping[str, str]) -> Split:
        order = tuple(n for n in self.slices.dynamic if n in inner)
        below = frozenset(n for n in self.seen if self._above((n,), inner))
        numbers = {n: w for n, w in why.items() if self._is_number(n)}
        return Split(self.seen, order, below, numbers, self.bent or {})

    def _is_number(self, name: str) -> bool:
        node = self.slices.later[name]
        return node.domain is None and not node.is_discrete

    def _never(self, name: str) -> str | None:
        """Why a node by itself is not integrated out, whatever the others are."""
        for model in self.models:
            node = model[name]
            if node.domain is not None:
                return "has finitely many states"
            if node.is_discrete:
                return "takes whole numbers"
            if node.angles is not None:
                return _ANGLE
        return None

    def _above(self, names: Iterable[str], inner: Collection[str]) -> set[str]:
        """Nodes integrated out that others depend on in any slice, through computed ones or not."""
        found: set[str] = set()
        todo, met = list(names), set(names)
        while todo:
            name = todo.pop()
            for parent in (p for model in self.models for p in model[name].parents):
                stem = parent.removesuffix(PREVIOUS)
                if stem in inner:
                    found.add(stem)
                elif stem in self._computed and stem not in met:
                    met.add(stem)
                    todo.append(stem)
        return found

    def _closed(self, inner: Collection[str], names: Iterable[str]) -> set[str]:
        """Nodes with all of the others that they depend on, in any slice."""
        found = set(names)
        while True:
            more = self._above(found, inner) - found
            if not more:
                return found
            found |= more

    def _without(self, inner: set[str], names: Iterable[str], reason: str) -> set[str]:
        given_up = self._closed(inner, names)
        direct = set(names)
        for name in given_up:
            if name in direct:
                self.why.setdefault(name, reason)
        for name in given_up - direct:
            by = next((n for n in self.slices.dynamic if n in direct), None)
            what = "sampled" if by is None or self._is_number(by) else "no number"
            self.why.setdefault(name, f"{by!r}, which is {what}, depends on it")
        return inner - given_up

    def _given_up(self, inner: set[str], name: str) -> tuple[str, ...]:
        """What is sampled so that a node is linear-Gaussian in the rest: the fewest numbers."""
        above = sorted(self._above((name,), inner), key=self.slices.dynamic.index)
        ways: list[tuple[str, ...]] = [(n,) for n in above]
        if len(above) > 1:
            ways.append(tuple(above))
        if name in inner:
            ways.append((name,))
        best: tuple[int, tuple[str, ...]] | None = None
        for way in ways:
            left = inner - self._closed(inner, way)
            hidden = name in self.hidden and name not in left
            if not hidden and self._reason(left, name) is not None:
                continue
            lost = sum(self._size(n) for n in inner - left)
            if best is None or lost < best[0]:
                best = lost, way
        return tuple(inner) if best is None else best[1]

    def _size(self, name: str) -> int:
        return math.prod(self.slices.first[name].value_shape)

    def _fault(self, inner: Collection[str]) -> tuple[str, str] | None:
        """The first node that is not linear-Gaussian in what is integrated out, and why."""
        for layout in layouts_of(self.slices, inner, self.apart):
            for name in layout.order:
                reason = self._reason_in(layout, name)
                if reason is not None:
                    return name, reason
        return None

    def _reason(self, inner: Collection[str], name: str) -> str | None:
        reasons = (
            self._reason_in(layout, name) for layout in layouts_of(self.slices, inner, self.apart)
        )
        return next((r for r in reasons if r is not None), None)

    def _reason_in(self, layout: Layout, name: str) -> str | None:
        if name in layout.silent:
            return "is computed from hidden numbers and takes no continuous values"
        if name not in layout.placed:
            return None
        hidden = layout.unknown | {n + PREVIOUS for n in layout.before}
        values = {n: v for n, v in self.values.items() if n not in hidden}
        reason = why_not_placed(layout, name, values)
        if reason is None or self.bent is None:
            return reason
        why = why_not_bent(layout, name, values)
        if why is None:
            self.bent[name] = reason
            return None
        return f"{reason}; it cannot be linearised, either: it {why}"
