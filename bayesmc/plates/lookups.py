"""Parents in foreign plates that note how they are looked up.

``Lookups`` stands in for the ``PlateArray`` of a parent and behaves like it; whoever passed it learns
by which indices the function gathered (``mean[label]``), and of a traced parent also whether that was all
that the function did with it. What the indices mean is the caller's business.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayesmc.plates.array import PlateArray


class Lookups(PlateArray):
    """A ``PlateArray`` that keeps the indices by which its elements are gathered.

    Where the array is a ``Tracer`` of a source ``x``, what is gathered along all foreign plates by
    ``keys[k]`` has the source ``x[k]``: element i of the child's plates varies with the element of x
    that element i of that index names, and with no other. Anything else has the source ``x[*]``. Results
    of ufuncs and of ``np.where`` can be looked up too (``np.exp(s)[label]``, ``(a + b)[label]``), and
    so can components (``v[..., 2][label]``).

    Parameters
    ----------
    array : ndarray or Tracer
        The values, as in ``PlateArray``.
    plates : tuple of str
    own, event_ndim : int
    name : str
        The parent's name, for whoever reads the keys.

    Attributes
    ----------
    keys : list of tuple
        The indices of every gather along all foreign plates, one for each plate: the objects themselves,
        in the order of first use. The same objects, and equal whole numbers, are one key; arrays that
        are merely equal are two, because they may differ in another call.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.plates import Lookups
    >>> from bayesmc.tracing import Tracer
    >>> label = np.array([2, 0, 0, 1])
    >>> mean = Lookups(np.array([[10.0, 20.0, 30.0]]), ("cluster",), own=1)
    >>> mean[label], mean.keys[0][0] is label
    (array([30., 10., 10., 20.]), True)
    >>> mean = Lookups(Tracer(np.zeros((1, 3)), ["mean"]), ("cluster",), own=1)
    >>> sorted((2.0 * mean[label]).sources), sorted((mean[label] - mean.sum()).sources)
    (['mean[0]'], ['mean[*]', 'mean[0]'])
    """

    __slots__ = ("_copies", "_labels", "_mixed", "_roots", "keys", "name")

    def __init__(
        self,
        array: Any,
        plates: tuple[str, ...],
        own: int = 0,
        event_ndim: int = 0,
        name: str = "",
    ) -> None:
        self._labels: dict[str, str] = {}
        if not isinstance(array, np.ndarray) and hasattr(array, "as_whole"):
            array, self._labels = array.as_whole()
        super().__init__(array, plates, own, event_ndim)
        self.keys: list[tuple[Any, ...]] = []
        self.name = name
        self._copies: list[tuple[np.ndarray, ...]] = []
        self._roots: tuple[Lookups, ...] | None = None
        self._mixed: frozenset[str] = frozenset()

    @property
    def keys_changed(self) -> bool:
        """Of a traced parent: whether an index was changed in place after it had been used."""
        return any(map(_differ, self.keys, self._copies))

    # ---- what gathers -------------------------------------------------------------------------

    def _gather(self, keys: tuple[Any, ...]) -> Any:
        result = super()._gather(keys)
        if len(keys) != len(self.plates):
            return result
        for key in keys:
            if isinstance(key, (slice, PlateArray)):
                return result
        if self._roots is None and not self._labels:
            self._note(keys)
            return result
        return self._noted(keys, result)

    def _noted(self, keys: tuple[Any, ...], result: Any) -> Any:
        """A gather of traced elements, or of what was made of several parents."""
        places: list[tuple[Lookups, int | None]] = []
        names: dict[str, str] = {}
        shared = set(self._mixed)  # and what came in by two parents: two lists of keys
        for root in self._roots or (self,):
            place = root._note(tuple(keys[self.plates.index(p)] for p in root.plates))
            places.append((root, place))
            shared |= set(names) & set(root._labels)
            if place is not None:
                names |= {whole: f"{source}[{place}]" for whole, source in root._labels.items()}
        if not any(root._labels for root, _ in places):
            return result
        names = {whole: name for whole, name in names.items() if whole not in shared}
        certain = all(place is not None for _, place in places)
        where = tuple((id(root.keys), place) for root, place in places) if certain else object()
        return self.array.looked_up(result, names, self.event_ndim, where)  # type: ignore[attr-defined]

    def _note(self, keys: tuple[Any, ...]) -> int | None:
        """Position of an index among the keys; None if it is no longer what it was when first used."""
        for k, old in enumerate(self.keys):
            if all(map(_is_same, old, keys)):
                return None if self._labels and _differ(old, self._copies[k]) else k
        self.keys.append(keys)
        if self._labels:
            self._copies.append(tuple(np.array(key) for key in keys))
        return len(self.keys) - 1

    # ---- what can still be looked up -------------------------------------------------------------

    def _component(self, keys: tuple[Any, ...]) -> PlateArray:
        return _watched(super()._component(keys), (self,))

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        result = super().__array_ufunc__(ufunc, method, *inputs, **kwargs)
        if isinstance(result, tuple):
            return tuple(_watched(r, inputs) for r in result)
        return _watched(result, inputs)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        result = super().__array_function__(func, types, args, kwargs)
        return _watched(result, args) if func is np.where else result


# ---- private ------------------------------------------------------------------------------------


def _watched(made: Any, operands: Sequence[Any]) -> Lookups:
    """What was made plate element by plate element of some parents, so that its gathers are theirs."""
    roots: list[Lookups] = []
    mixed: set[str] = set()  # sources that are in it in other ways as well
    for x in operands:
        if isinstance(x, Lookups):
            roots += [r for r in x._roots or (x,) if not any(r is known for known in roots)]
            mixed |= x._mixed
        else:
            mixed |= getattr(x.array if isinstance(x, PlateArray) else x, "wholes", frozenset())
    watched = Lookups.__new__(Lookups)
    PlateArray.__init__(watched, made.array, made.plates, made.own, made.event_ndim)
    watched._labels, watched._copies, watched._roots = {}, [], tuple(roots)
    watched._mixed = frozenset(mixed)
    watched.keys, watched.name = [], ""
    if len(roots) == 1:
        watched.keys, watched.name = roots[0].keys, roots[0].name
    return watched


def _is_same(first: Any, second: Any) -> bool:
    """Whether an index is the same in every call if it is in this one."""
    return first is second or (type(first) is type(second) is int and first == second)


def _differ(keys: tuple[Any, ...], copies: tuple[np.ndarray, ...]) -> bool:
    return not all(np.array_equal(np.asarray(k), c) for k, c in zip(keys, copies, strict=True))
