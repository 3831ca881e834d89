"""What a slice says of its finite variables, read off the declared functions with time as an array axis.

``SliceReader`` finds the variables that a node's density reads, through the deterministic nodes between, and
evaluates it on all their states and on all rows of a series in one call. How the tables are summed is no
affair of this module.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.dbn import PREVIOUS, TIME, Slices, with_computed
from bayesmc.distributions import Distribution
from bayesmc.engines.discrete.rows import Key, Piece, Rows, Term, Variable
from bayesmc.engines.filtering import quiet
from bayesmc.errors import BayesmcError, UnsupportedError
from bayesmc.factors.named import Named, aligned
from bayesmc.network import CompiledNode, Model
from bayesmc.shapes import padded
from bayesmc.structure.tables import configurations

#: reads arrays off a term in some slices
Read = Callable[["Term", "Rows"], tuple[Any, ...]]


class SliceReader:
    """Reads terms off a template.

    Parameters
    ----------
    slices : Slices
    apart : tuple of str
        Plates whose elements are filtered separately: they are array axes.
    variables : frozenset of str
        Finite nodes to sum over; all their elements but for the plates ``apart`` are variables.
    static : dict
        Stored values of static nodes.
    """

    def __init__(
        self,
        slices: Slices,
        apart: tuple[str, ...],
        variables: frozenset[str],
        static: Mapping[str, np.ndarray],
    ) -> None:
        self.slices, self.apart, self.variables = slices, apart, variables
        self.static = with_computed(slices, static)
        self.lead = tuple(slices.first.sizes[p] for p in apart)
        self.sequences = math.prod(self.lead)
        self._slow: set[tuple[str, int]] = set()

    def term(self, name: str, kind: int) -> Term:
        """What a node reads.

        Raises
        ------
        UnsupportedError
            A deterministic node hands on what is two slices back.
        """
        node = self.model(kind, 0)[name]
        found: dict[Key, bool] = {}
        reads: dict[Key, None] = {}
        clock = hands_on = False

        def visit(parents: Sequence[str], lag: int, own: tuple[str, ...], whole: bool) -> None:
            nonlocal clock, hands_on
            for parent in parents:
                stem, back = self.origin(parent, lag)
                if stem == TIME or stem in self.slices.template.inputs:
                    clock = True
                    continue
                if stem in self.static:
                    continue
                above = self.slices.first[stem]
                foreign = whole or any(p not in own for p in above.plates)
                if stem in self.variables:
                    self._check_back(name, stem, back)
                    found[back, stem] = found.get((back, stem), False) or foreign
                elif above.is_stochastic:
                    reads[back, stem] = None
                else:
                    self._check_back(name, stem, back)
                    hands_on |= back > lag
                    visit(self.model(kind, back)[stem].parents, back, above.plates, foreign)

        visit(node.parents, 0, node.plates, False)
        alone = tuple(k for k, is_whole in found.items() if not is_whole)
        whole_keys = tuple(k for k, is_whole in found.items() if is_whole)
        return Term(name, kind, alone, whole_keys, tuple(reads), clock, hands_on)

    def origin(self, parent: str, lag: int) -> tuple[str, int]:
        """The node that a parent of the slice ``lag`` back is, and how far back it stands."""
        if parent.endswith(PREVIOUS):
            return parent.removesuffix(PREVIOUS), lag + 1
        return parent, lag

    def model(self, kind: int, lag: int) -> Model:
        """The model of the slice ``lag`` slices before one of a kind."""
        return self.slices.first if kind - lag <= 0 and kind < 2 else self.slices.later

    def card(self, name: str) -> int:
        """States of a finite node."""
        domain = self.slices.first[name].domain
        assert domain is not None
        return domain.size

    def elements(self, name: str) -> int:
        """Elements of a node in the plates that are not apart."""
        node = self.slices.first[name]
        return math.prod(self._inner(node))

    def scope(self, term: Term, element: int) -> tuple[Variable, ...]:
        """The variables that one element of a term's node reads."""
        node = self.slices.first[term.name]
        plates = [p for p in node.plates if p not in self.apart]
        at = np.unravel_index(element, self._inner(node)) if plates else ()
        scope: list[Variable] = []
        for lag, name in term.alone:
            other = self.slices.first[name]
            own = tuple(int(at[plates.index(p)]) for p in other.plates if p not in self.apart)
            flat = int(np.ravel_multi_index(own, self._inner(other))) if own else 0
            scope.append((lag, name, flat))
        for lag, name in term.whole:
            scope += [(lag, name, e) for e in range(self.elements(name))]
        return tuple(scope)

    def question(self, names: Sequence[str], kind: int) -> Term:
        """A term that reads several nodes of a slice, all elements of each."""
        whole: dict[Key, None] = {}
        reads: dict[Key, None] = {}
        clock = False
        for name in names:
            node = self.slices.first[name]
            if name in self.variables:
                whole[0, name] = None
            elif name in self.slices.template.inputs or name == TIME:
                clock = True
            elif name not in self.static and node.is_stochastic:
                reads[0, name] = None
            elif name not in self.static:
                above = self.term(name, kind)
                whole.update(dict.fromkeys((*above.alone, *above.whole)))
                reads.update(dict.fromkeys(above.reads))
                clock |= above.clock
        return Term("", kind, (), tuple(whole), tuple(reads), clock)

    def scope_of_keys(self, term: Term) -> tuple[Variable, ...]:
        """The variables of a question."""
        return tuple((lag, n, e) for lag, n in term.whole for e in range(self.elements(n)))

    def shares_scope(self, term: Term) -> bool:
        """Whether all elements of a term's node read the same variables."""
        return all(self.elements(name) == 1 for _, name in term.alone)

    def cards(self, term: Term) -> tuple[int, ...]:
        """Sizes of the axes of a term's configurations."""
        sizes = [self.card(name) for _, name in term.alone]
        for _, name in term.whole:
            sizes += [self.card(name)] * self.elements(name)
        return tuple(sizes)

    # ---- evaluating -------------------------------------------------------------------------

    def evaluate(self, term: Term, rows: Rows) -> tuple[Any, Rows]:
        """A term's node on all configurations: a distribution or stored values, and where they stand.

        Its batch axes are rows (1 where nothing varies) and one for each entry of ``cards``.
        """
        placed = self.placed(term, rows)
        model = self.model(term.kind, 0)
        result, _ = model.evaluate(term.name, self._arguments(placed, model, term.name, 0))
        return result, placed

    def placed(self, term: Term, rows: Rows) -> Rows:
        """Rows with a term's variables along axes of their own."""
        first = self.slices.first
        alone, whole = ([first[name] for _, name in keys] for keys in (term.alone, term.whole))
        values, cards = configurations(alone, whole, self.apart, ahead=1)
        axes = dict(zip((*term.alone, *term.whole), values, strict=True))
        return rows.at(axes, 1 + len(cards))

    def value(self, rows: Rows, name: str, lag: int) -> np.ndarray:
        """Stored values of a node of the slice ``lag`` back, on rows whose variables have values."""
        if name == TIME or name in rows.series.inputs:
            return rows.clock(name, lag)
        if name in self.static:
            return self.static[name]
        if (lag, name) in rows.axes:
            return rows.axes[lag, name]
        if self.slices.first[name].is_stochastic:
            seen = rows.observed(name, lag)
            if seen is None:
                raise UnsupportedError(f"node {name!r} is needed and was not observed")
            return seen[0]
        model = self.model(rows.kind, lag)
        return np.asarray(model.evaluate(name, self._arguments(rows, model, name, lag))[0])

    def over_rows(self, term: Term, rows: Rows, read: Read) -> tuple[Any, ...]:
        """Arrays read off a term, all rows in one call where its functions broadcast over time.

        ``read(term, rows)`` returns arrays with time as the first axis (size 1 where nothing varies), or None
        in place of one. What a call for all rows says is held against calls for single ones.
        """
        if not term.clock or rows.count == 1:
            return read(term, rows)
        if (term.name, term.kind) not in self._slow:
            found = self._at_once(term, rows, read)
            if found is not None:
                return found
            self._slow.add((term.name, term.kind))
        singles = [read(term, rows.one(k)) for k in range(rows.count)]
        return tuple(_stacked(parts) for parts in zip(*singles, strict=True))

    def pieces(self, term: Term, rows: Rows) -> list[Piece]:
        """The factors of a term, element by element."""
        node = self.slices.first[term.name]
        own = term.name in self.variables
        log, invalid = self.over_rows(term, rows, self._log_tables)
        cards = len(self.cards(term))
        if not own and self.shares_scope(term):
            log = self._sum_inner(log, node, cards)
            if invalid is not None:
                invalid = self._sum_inner(invalid.astype(float), node, cards) > 0
            count = 1
        else:
            count = self.elements(term.name)
        found = []
        for element in range(count):
            scope = self.scope(term, element)
            if own:
                scope += ((0, term.name, element),)
            part = self.at_element(log, node, cards, element, int(own))
            bad = None
            if invalid is not None:
                bad = self.at_element(invalid, node, cards, element, int(own))
            found.append(Piece(term.name, scope, part, not own, bad))
        return found

    def indicators(self, name: str, rows: Rows) -> list[Piece]:
        """What was seen of a variable that is not always seen."""
        node, size = self.slices.first[name], self.card(name)
        seen = rows.observed(name, 0)
        if seen is None:
            return []
        value, mask = seen
        with np.errstate(divide="ignore"):
            log = np.log((value[..., None] == np.arange(size)) | ~mask[..., None])
        return [
            Piece(name, ((0, name, e),), self.at_element(log, node, 0, e, 1), True)
            for e in range(self.elements(name))
        ]

    # ---- elements of plates -----------------------------------------------------------------

    def at_element(
        self, array: np.ndarray, node: CompiledNode, cards: int, element: int, rest: int
    ) -> np.ndarray:
        """One element of an array ``(rows, *cards, *plates, *rest)``: ``(rows, sequences, *cards, *rest)``.

        Sequences are one where nothing differs between them.
        """
        array = padded(array, 1 + cards + len(node.plates) + rest)
        sizes = array.shape[1 + cards : 1 + cards + len(node.plates)]
        place = zip(self._place(node, element), sizes, strict=True)
        index = tuple(at if isinstance(at, slice) or n > 1 else 0 for at, n in place)
        array = array[(slice(None),) * (1 + cards) + index]
        outer = [p for p in node.plates if p in self.apart]
        before, behind = range(cards), range(cards, cards + rest)
        scope = (*before, *outer, *behind)
        array = aligned(Named(scope, array), (*self.apart, *before, *behind))
        tail = array.shape[1 + len(self.apart) :]
        if math.prod(array.shape[1 : 1 + len(self.apart)]) == 1:
            return array.reshape(len(array), 1, *tail)
        full = np.broadcast_to(array, (len(array), *self.lead, *tail))
        flat = full.reshape(len(array), self.sequences, *tail)
        if len(flat) == 1 and (flat == flat[:, :1]).all():  # one matrix for all is much cheaper
            return flat[:, :1]
        return flat

    def put_element(
        self, out: np.ndarray, node: CompiledNode, element: int, array: np.ndarray
    ) -> None:
        """Write ``(rows, sequences or 1, *rest)`` where an element stands in ``(rows, *plates, *rest)``."""
        lead = self.lead if array.shape[1] > 1 else (1,) * len(self.lead)
        full = array.reshape(len(array), *lead, *array.shape[2:])
        kept = [p for p in self.apart if p in node.plates]
        full = full[(slice(None), *(slice(None) if p in kept else 0 for p in self.apart))]
        order = [1 + kept.index(p) for p in node.plates if p in kept]
        full = full.transpose(0, *order, *range(1 + len(order), full.ndim))
        out[(slice(None), *self._place(node, element))] = full

    # ---- private ----------------------------------------------------------------------------

    def _inner(self, node: CompiledNode) -> tuple[int, ...]:
        return tuple(
            n for p, n in zip(node.plates, node.plate_shape, strict=True) if p not in self.apart
        )

    def _place(self, node: CompiledNode, element: int) -> tuple[int | slice, ...]:
        """Where an element stands among a node's plates; plates apart are taken whole."""
        at = iter(np.unravel_index(element, self._inner(node)) if self._inner(node) else ())
        return tuple(slice(None) if p in self.apart else int(next(at)) for p in node.plates)

    def _arguments(self, rows: Rows, model: Model, name: str, lag: int) -> dict[str, np.ndarray]:
        """Values of a node's parents, of the slice ``lag`` back."""
        found = {}
        for parent in model[name].parents:
            stem, back = self.origin(parent, lag)
            value = self.value(rows, stem, back)
            if back > lag and not self.slices.first[stem].is_stochastic:
                source = self.model(rows.kind, back)[stem] if back <= 1 else model[parent]
                value = _handed_on(value, source, model[parent])
            found[parent] = value
        return found

    def _check_back(self, name: str, stem: str, back: int) -> None:
        if back > 1:
            raise UnsupportedError(
                f"node {name!r} depends on {stem!r} of two slices before, through a deterministic node that "
                "is handed on to the next slice; give that node states=, so that it becomes part of the state"
            )

    def _at_once(self, term: Term, rows: Rows, read: Read) -> tuple[Any, ...] | None:
        """All rows in one call; None where that fails or calls for single rows say otherwise."""
        try:
            found = read(term, rows)
            for k in {0, rows.count // 2, rows.count - 1}:
                for many, one in zip(found, read(term, rows.one(k)), strict=True):
                    if not _agree(many, one, k):
                        return None
        except BayesmcError:
            return None
        return found

    def _log_tables(self, term: Term, rows: Rows) -> tuple[np.ndarray, np.ndarray | None]:
        node = self.slices.first[term.name]
        with quiet():
            result, placed = self.evaluate(term, rows)
            lead = 1 + len(self.cards(term)) + len(node.plates)
            if not isinstance(result, Distribution):
                size = self.card(term.name)
                return np.log(padded(np.asarray(result), lead)[..., None] == np.arange(size)), None
            bad = result.invalid if result.invalid is not None and result.invalid.any() else None
            if term.name in self.variables:
                table = result.probs_table
                assert table is not None
                log = padded(np.log(table), lead + 1)
                bad = None if bad is None else padded(bad, lead)[..., None]
            else:
                seen = placed.observed(term.name, 0)
                assert seen is not None
                value, mask = seen
                log = self.model(term.kind, 0).log_density(term.name, result, value)
                log = padded(log, lead)
                bad = None if bad is None else padded(bad, lead)
                if not mask.all():
                    log = np.where(mask, log, 0.0)
                    bad = None if bad is None else bad & mask
        if bad is None or not bad.any():
            return log, None
        return np.where(bad, 0.0, log), np.broadcast_to(
            bad, np.broadcast_shapes(bad.shape, log.shape)
        )

    def _sum_inner(self, array: np.ndarray, node: CompiledNode, cards: int) -> np.ndarray:
        """Summed over the plates that are not apart, whose axes stay with size one."""
        axes = tuple(1 + cards + k for k, p in enumerate(node.plates) if p not in self.apart)
        if not axes:
            return array
        shape = list(array.shape)
        for axis in axes:
            shape[axis] = node.plate_shape[axis - 1 - cards]
        return np.broadcast_to(array, shape).sum(axis=axes, keepdims=True)


# ---- private ------------------------------------------------------------------------------------


def _agree(many: Any, one: Any, k: int) -> bool:
    """Whether row k of an array for many rows is the one worked out alone."""
    if many is None or one is None:
        return many is None and one is None
    row = many[k : k + 1] if len(many) > 1 else many
    if row.ndim != one.ndim:
        return False
    return bool(np.allclose(row, one, rtol=1e-9, atol=1e-9, equal_nan=True))


def _stacked(parts: Sequence[Any]) -> Any:
    """Arrays of single rows one after the other."""
    known = [p for p in parts if p is not None]
    if not known:
        return None
    shape = np.broadcast_shapes(*(p.shape[1:] for p in known))
    blank = np.zeros((1, *shape), dtype=known[0].dtype)
    return np.concatenate([blank if p is None else np.broadcast_to(p, blank.shape) for p in parts])


def _handed_on(value: np.ndarray, source: CompiledNode, target: CompiledNode) -> np.ndarray:
    """Stored values of a deterministic node as the next slice reads them, which may number them otherwise."""
    if source.domain is None and target.domain is None:
        return value
    if source.domain is not None and target.domain is not None:
        if source.domain.states == target.domain.states:
            return value
    plain = source.decode(value)
    if target.domain is None:
        return np.asarray(plain)
    states = target.domain.numbers
    if states is not None:
        order = np.argsort(states)
        at = order[np.minimum(np.searchsorted(states[order], plain), len(states) - 1)]
        if (states[at] == plain).all():
            return at
    raise UnsupportedError(
        f"deterministic node {source.name!r} takes other values in slice 0 than later; give it states="
    )
