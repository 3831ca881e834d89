"""Several like functions called as one: the group becomes a batch axis, before the plates.

Terms and deterministic nodes are alike where their functions are, up to numbers, and what they read has the
same shapes. The first of them then stands for all: its parents' names stand for arrays in which the parents
of all are stacked. Numbers by which the functions differ (``t=t``) are stacked, too, but functions need not
broadcast over those as they do over parents. So it is tried in several ways, and what does not give what the
functions give one by one is not used.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import is_, itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError
from bayesmc.network import CompiledNode, Model
from bayesmc.network.align import Aligner
from bayesmc.network.domain import Domain
from bayesmc.shapes import Shape
from bayesmc.structure.likeness import Skeleton, same_number, skeleton, with_numbers

if TYPE_CHECKING:  # a target recomputes like links as one
    from bayesmc.structure.target import Target, Term, Values

#: stands for a parent that only lengthens the batch
GROUP = "\0group"
#: relative error that rounding may make
_EXACT = 1e-12
#: event axes that numbers may meet
_EVENT_NDIM = 3


@dataclass(frozen=True, eq=False)
class Signature:
    """What a term or a deterministic node is.

    Attributes
    ----------
    key : hashable
        Equal where functions are, up to numbers, and values have the same shapes and states.
    skeleton : Skeleton
        Of its function.
    scope : tuple of str
        What it reads: parents in the order of arguments, and itself.
    """

    key: Hashable
    skeleton: Skeleton
    scope: tuple[str, ...]


class Signatures:
    """Signatures of a target's terms and deterministic nodes, each found once."""

    def __init__(self, target: Target) -> None:
        self.target = target
        self._found: dict[str, Signature | None] = {}

    def of(self, name: str) -> Signature | None:
        """The signature; None for what is called element by element or over the rows of an index."""
        if name not in self._found:
            self._found[name] = self._read(name)
        return self._found[name]

    def _read(self, name: str) -> Signature | None:
        model = self.target.model
        term = self.target.terms.get(name)
        what: Hashable
        if term is not None and term.is_potential:
            potential, _ = model.potentials[name]
            if potential.index is not None:
                return None
            found, scope = skeleton(potential.function), potential.parents
            what = ("potential", potential.plates, potential.is_table)
        else:
            node = model[name]
            declaration = node.declaration
            if declaration.vectorize:
                return None
            found, scope = skeleton(declaration.function), (*node.parents, name)
            what = tuple(
                None if t is None else (t.shape, t.dtype.str, t.tobytes())
                for t in (declaration.probs, node.table)
            )
        read = tuple(value_key(model[n]) for n in scope)
        return Signature((found.key, what, read), found, scope)


class Slots:
    """What names stand for: of each one name for all of a group, or one for each.

    Parameters
    ----------
    sources : dict
        Name -> tuple of one name, or of one for each.
    count : int
        Size of the group.
    """

    def __init__(self, target: Target, sources: Mapping[str, Sequence[str]], count: int) -> None:
        self.sources = {name: _once(these) for name, these in sources.items()}
        self.count = count
        self._group = np.zeros(count)
        self._trailing = {name: len(target.model[name].value_shape) for name in self.sources}
        known = target.known
        self._taken = {name: _taking(these) for name, these in self.sources.items()}
        self._known = {
            name: self._taken[name](known)
            for name, these in self.sources.items()
            if all(n in known for n in these)
        }
        self._fixed = {
            name: stack_arrays(arrays, self._trailing[name]) for name, arrays in self._known.items()
        }

    def gathered(self, values: Mapping[str, np.ndarray]) -> Values:
        """Values by these names, ``(*lead, group, *plates, *event)``; the group is 1 for a shared one."""
        found: Values = {GROUP: self._group}
        for name, taken in self._taken.items():
            arrays = taken(values)
            known = self._known.get(name)
            if known is not None and all(map(is_, arrays, known)):
                found[name] = self._fixed[name]
            else:
                found[name] = stack_arrays(arrays, self._trailing[name])
        return found


@dataclass(frozen=True, eq=False)
class LikeFunctions:
    """Terms or deterministic nodes whose functions differ in numbers at most.

    Attributes
    ----------
    names : tuple of str
        The group; the first stands for all.
    signatures : tuple of Signature
        Theirs, with equal keys.
    """

    names: tuple[str, ...]
    signatures: tuple[Signature, ...]

    @cached_property
    def varying(self) -> dict[int, tuple[Any, ...]]:
        """The numbers by which the functions differ, by their places in the skeletons."""
        columns = enumerate(zip(*(s.skeleton.numbers for s in self.signatures), strict=True))
        return {
            k: these
            for k, these in columns
            if not all(same_number(these[0], other) for other in these)
        }

    def mask(self, target: Target) -> np.ndarray | None:
        """The elements that count, of terms ``(group, *plates)``; None where all do."""
        terms = [target.terms[n] for n in self.names]
        if all(t.mask is None for t in terms):
            return None
        return np.stack([np.ones(t.shape, bool) if t.mask is None else t.mask for t in terms])

    def as_one(
        self, target: Target, model: Model, gathered: Values, states: Values
    ) -> Model | None:
        """A model in which the first function has the numbers of all; None where none agrees with them.

        Parameters
        ----------
        model : Model
            The target's, or one in which others have been replaced.
        gathered, states : dict
            Values by the names of the first, the group before the plates; and by everybody's own names.
        """
        alone = [_evaluated(target, target.model, n, states) for n in self.names]
        for scalars, after_plates in itertools.product(range(_EVENT_NDIM), (True, False)):
            try:
                tried = self._replaced(target, model, scalars, after_plates)
                together = _evaluated(target, tried, self.names[0], gathered)
                shape = np.broadcast_shapes(*(a[:, None].shape for a in alone))
                full = np.broadcast_to(together, (shape[0], len(alone), *shape[2:]))
            except (BayesmcError, ValueError):
                continue  # the numbers do not broadcast in this way
            rows = [np.broadcast_to(a, full[:, 0].shape) for a in alone]
            if all(close(full[:, i], row) for i, row in enumerate(rows)):
                return tried
        return None

    def _replaced(self, target: Target, model: Model, scalars: int, after_plates: bool) -> Model:
        """The model with the numbers of all in the first function.

        Parameters
        ----------
        scalars : int
            How many event axes scalars are to meet.
        after_plates : bool
            Whether the axes of arrays come after the plates, as those of an unplated parent's event do.
        """
        name = self.names[0]
        term = target.terms.get(name)
        plates = len(model[name].plate_shape if term is None else term.shape)
        numbers = list(self.signatures[0].skeleton.numbers)
        for k, these in self.varying.items():
            own = np.ndim(these[0])
            if not own:
                axes = plates + scalars
            else:
                axes = plates + own if after_plates else max(plates, own)
            numbers[k] = _column(these, axes)
        link = (GROUP, Aligner((), (), 0, None))
        if term is not None and term.is_potential:
            potential, links = model.potentials[name]
            function = _longer(with_numbers(potential.function, numbers))
            made = replace(potential, function=function), (*links, link)
            return replace(model, potentials={**model.potentials, name: made}, cache={})
        node = model[name]
        assert node.declaration.function is not None
        function = _longer(with_numbers(node.declaration.function, numbers))
        declaration = replace(node.declaration, function=function)
        node = replace(node, declaration=declaration, links=(*node.links, link))
        return replace(model, nodes={**model.nodes, name: node}, cache={})


def stack_arrays(arrays: Sequence[np.ndarray], trailing: int) -> np.ndarray:
    """Arrays ``(*lead, *trailing)`` as one, the new axis in between: of size one for a single hidden one."""
    first = arrays[0]
    lead = first.ndim - trailing
    if len(arrays) == 1:
        return first if not lead else first.reshape(*first.shape[:lead], 1, *first.shape[lead:])
    rows = _rows(arrays)
    if rows is None:  # some of them are known, or have more candidates
        rows = _broadcast_rows(arrays)
        lead = rows.ndim - 1 - trailing
    return rows.swapaxes(0, 1) if lead == 1 else np.moveaxis(rows, 0, lead)


def in_model(target: Target, model: Model, terms: Mapping[str, Term]) -> Target:
    """The target with other functions."""
    problem = replace(target.problem, model=model, cache={})
    own = {name: replace(term, model=model) for name, term in terms.items()}
    return replace(target, problem=problem, terms=own, _below={})


def close(a: np.ndarray, b: np.ndarray) -> bool:
    """Equal up to rounding; infinities in the same places."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    with np.errstate(invalid="ignore"):
        near = np.abs(a - b) <= _EXACT * (1.0 + np.abs(b))
    return bool((near | (a == b)).all())


def value_key(node: CompiledNode) -> Hashable:
    """What a node's values are: equal where shapes and states are."""
    return node.plates, node.event_shape, node.is_discrete, _domain_key(node.domain)


# ---- private ------------------------------------------------------------------------------------


def _rows(arrays: Sequence[np.ndarray]) -> np.ndarray | None:
    """Arrays of one shape as the rows of one; None where they merely broadcast against each other."""
    shape = arrays[0].shape
    try:
        rows = np.concatenate(arrays) if shape else np.array(arrays)
    except ValueError:
        return None
    # of first axes that broadcast, those that are not of the first one's size are all longer, or all shorter
    if rows.size != len(arrays) * arrays[0].size:
        return None
    return rows.reshape(len(arrays), *shape)


def _broadcast_rows(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays of few shapes as the rows of one."""
    places: dict[Shape, list[int]] = {}
    for i, array in enumerate(arrays):
        places.setdefault(array.shape, []).append(i)
    full = np.broadcast_shapes(*places)
    rows = np.empty((len(arrays), *full), np.result_type(*{a.dtype for a in arrays}))
    for shape, at in places.items():
        part = np.array([arrays[i] for i in at])
        rows[at] = part.reshape(len(at), *(1,) * (len(full) - len(shape)), *shape)
    return rows


def _taking(names: Sequence[str]) -> Callable[[Any], tuple[np.ndarray, ...]]:
    """What takes the values of some names from a mapping: for thousands, as fast as can be."""
    if len(names) > 1:
        return itemgetter(*names)
    (name,) = names
    return lambda values: (values[name],)


def _once(names: Sequence[str]) -> tuple[str, ...]:
    return (names[0],) if len(set(names)) == 1 else tuple(names)


def _domain_key(domain: Domain | None) -> Hashable:
    if domain is None:
        return None
    values = None if domain.values is None else (domain.values.dtype.str, domain.values.tobytes())
    return domain.size, domain.low, values, domain.labels


def _evaluated(target: Target, model: Model, name: str, values: Values) -> np.ndarray:
    """A deterministic node's value or a term's log factors, as part of a model."""
    term = target.terms.get(name)
    with marking_invalid(), np.errstate(all="ignore"):
        if term is None:
            return model.evaluate(name, values)[0]
        return np.asarray(replace(term, model=model, mask=None).log(values))


def _longer(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with one more argument, which only lengthens the batch."""

    def call(*values: Any) -> Any:
        return function(*values[:-1])

    return call


def _column(numbers: Sequence[Any], axes: int) -> np.ndarray:
    """Numbers of a group ``(group, *shape)``, as arrays with that many axes after the group's."""
    rows = np.stack([np.asarray(n) for n in numbers])
    rows = rows.reshape(len(rows), *(1,) * (axes - rows.ndim + 1), *rows.shape[1:])
    rows.flags.writeable = False
    return rows
