"""Children of a label as features of their data times coefficients of every state.

Where a child's parameters depend on the label's plates through the label alone, the log density of an
element is linear in features of its value: ``1, x, x x'`` of a normal, ``1, log x, x`` of a gamma, and
one indicator per value where few values occur. Features never change; coefficients come from calling the
child's function on every state, or are read off the nodes where tracing shows that this is the same.
Terms in which states do not differ are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions import (
    Distribution,
    Exponential,
    Gamma,
    LogNormal,
    MvNormal,
    Normal,
    Poisson,
)
from bayesmc.kernels.conjugate_data import TRANSFORMS, Groups, groups_of
from bayesmc.kernels.conjugate_evaluation import padded
from bayesmc.kernels.conjugate_labels import ByLabel, read_directly
from bayesmc.kernels.conjugate_planar import planar_coefficients
from bayesmc.kernels.precisions import Precision, precision_of
from bayesmc.network.model import arguments_of, call
from bayesmc.structure.blanket import Blanket, Child
from bayesmc.structure.target import Target, Values

#: logarithm of a probability of zero, in products with indicators: 0 times it is 0, and sums stay finite
IMPOSSIBLE = -1e300
#: values up to which there is one indicator for each
_FEW = 32
#: numbers that features may fill
_MOST = 1 << 26


class LostParameters(Exception):
    """Parameters that overflowed or are out of range: the model's own density says what follows."""


@dataclass(frozen=True, eq=False)
class Coefficients:
    """By state, shapes ``(chains or 1, states or 1, ...)``.

    Attributes
    ----------
    constant : ndarray, shape (..., rows that count)
    rows : ndarray, shape (..., features)
    """

    constant: np.ndarray
    rows: np.ndarray


class LabelTerm:
    """One child of a label.

    Attributes
    ----------
    features : ndarray, shape (rows, elements)
        First one row (or one for each of the child's further plates) of ones, zero where the child was
        not seen.
    ones : int
        How many such rows.
    indicators : bool
        Whether all features are 0 or 1, so that ``IMPOSSIBLE`` may multiply them.
    groups : Groups or None
        Sums by label that conjugate kernels share, if their features are these.
    """

    def __init__(self, blanket: Blanket, child: Child) -> None:
        self.blanket, self.child, self.term = blanket, child, child.term
        target, model = blanket.target, blanket.target.model
        self.node = model[child.term.name]
        domain = blanket.node.domain
        assert domain is not None
        self.states = domain.size
        plates = self.term.plates
        self._inner = tuple(plates.index(p) for p in blanket.node.plates)
        self._outer = tuple(i for i in range(len(plates)) if i not in self._inner)
        self.repeats = math.prod(self.term.shape[i] for i in self._outer)
        axis = self._inner[-1]
        self.shape = tuple(
            self.states if i == axis else 1 if i in self._inner else size
            for i, size in enumerate(self.term.shape)
        )
        labels = (1,) * (len(self._inner) - 1) + (self.states,)
        self._labels = np.arange(self.states, dtype=domain.dtype).reshape(labels)
        self.groups: Groups | None = None
        self._way: ByLabel | None = None
        self._means: str | None = None
        self._above = target.hidden_above(self.term)
        self._unique: np.ndarray | None = None
        self._family: _Family | None = None
        self.centre: np.ndarray = np.zeros(())
        self.indicators = False
        self.features = np.empty((0, 0))
        self.ones = 1

    # ---- coefficients -------------------------------------------------------------------------

    def coefficients(self, values: Values) -> Coefficients:
        """Coefficients of the features in a state."""
        if self._family is None:
            return self._tabulated(values)
        if self._way is not None:
            return self._family.coefficients(_Direct(self._way, values), self.centre)
        return self._family.coefficients(_Called(self, self.at_labels(values)), self.centre)

    def planar(self, values: Values, chains: int) -> list[list[float]] | None:
        """Coefficients by chain and state for normals in the plane whose parameters are nodes, or None."""
        if self._means is None or self._way is None:
            return None
        loc = values[self._means]
        precision = self._way.precision(values)
        if precision.batch != (chains, self.states) or len(loc) != chains:
            return None
        return planar_coefficients(precision.entries, (loc - self.centre).reshape(-1, 2).tolist())

    def at_labels(self, values: Values) -> Distribution:
        """The child's distribution for every state of the label."""
        dist = self._called(values)
        if dist.invalid is not None:
            raise LostParameters
        return dist

    def by_state(self, array: Any, event_ndim: int, full: bool = False) -> np.ndarray:
        """A parameter ``(lead, *plates, *event)`` as ``(lead, states or 1, repeats, *event)``.

        With ``full`` the plates are the child's own, and so every element takes the place of a state.
        """
        plates = len(self.shape)
        array = padded(array, 1 + plates + event_ndim)
        if plates == 1:
            return array[:, :, None]
        event = tuple(range(1 + plates, array.ndim))
        moved = (0, *(1 + i for i in self._inner), *(1 + i for i in self._outer), *event)
        array = array.transpose(moved)
        inner = array.shape[1 : 1 + len(self._inner)]
        if full:
            inner = tuple(self.term.shape[i] for i in self._inner)
        outer = tuple(self.term.shape[i] for i in self._outer)
        wanted = (len(array), *inner, *outer, *array.shape[1 + plates :])
        array = np.broadcast_to(array, wanted)
        return array.reshape((len(array), math.prod(inner), self.repeats, *wanted[1 + plates :]))

    # ---- private -------------------------------------------------------------------------------

    def _called(self, values: Values) -> Distribution:
        state = {**values, self.blanket.name: self._labels}
        arguments, batch = arguments_of(self.node.links, state)
        return call(self.node.declaration, arguments, batch + self.shape, self.node.links)

    def _tabulated(self, values: Values) -> Coefficients:
        """Log densities of the values that occur."""
        assert self._unique is not None
        dist = self.at_labels(values)
        log = self.blanket.target.model.log_density(self.term.name, dist, self._unique)
        log = np.maximum(log, IMPOSSIBLE)
        rows = np.stack([self.by_state(a, 0) for a in log], axis=-1)
        rows = rows.reshape((*rows.shape[:2], -1))
        return Coefficients(np.zeros((1, 1, self.ones)), rows)

    def _settle(self) -> bool:
        """Find features; False where there are none or the label does not suffice."""
        if not self._suffices():
            return False
        value = self.blanket.target.known[self.term.name]
        by_element = self.by_state(value[None], len(self.node.event_shape), True)[0]
        mask = None if self.term.mask is None else self.by_state(self.term.mask[None], 0, True)[0]
        self.ones = 1 if mask is None else self.repeats
        family = _FAMILIES.get(type(self._called(example_of(self.blanket.target))))
        if family is None:
            return self._few_values(by_element, mask)
        self._family = family
        if self._shares(family, mask):
            return True
        shown = by_element if mask is None else by_element[mask]
        shown = TRANSFORMS[family.how](shown)
        if not np.isfinite(shown).all():
            return False
        self.centre = shown.reshape((-1, *self.node.event_shape)).mean(axis=0)
        if family.is_count:
            self.centre = np.zeros_like(self.centre)
        with np.errstate(all="ignore"):
            rows = family.features(TRANSFORMS[family.how](by_element) - self.centre)
        self.features = self._stacked(rows, mask)
        return bool(np.isfinite(self.features).all())

    def _shares(self, family: _Family, mask: np.ndarray | None) -> bool:
        """Take the features of the sums by label, where a conjugate kernel could sum by these."""
        alone = self.repeats == 1 and mask is None and self.term.plates == self.blanket.node.plates
        if not alone or not family.sums:
            return False
        target = self.blanket.target
        groups = groups_of(target, self.term, self.blanket.name, family.how)
        if not np.isfinite(groups.values).all():
            return False
        groups.second = groups.second or family.squares
        self.groups, self.centre = groups, groups.centre
        self.features = groups.made()
        way = ByLabel(self.blanket, self.child, groups)
        if read_directly(way, np.asarray(self._labels), self._above) is not None:
            self._way = way
            loc = way.direct.get("loc") if way.direct is not None else None
            if self.centre.shape == (2,) and loc is not None and loc.is_copy and loc.trailing == 2:
                self._means = loc.node
        return True

    def _few_values(self, value: np.ndarray, mask: np.ndarray | None) -> bool:
        """Indicators of the values that occur, where these are few numbers."""
        if self.node.event_shape:
            return False
        unique = np.unique(value if mask is None else value[mask])
        if not 0 < len(unique) <= _FEW or not self.node.is_discrete:
            return False
        self._unique = unique.reshape((-1,) + (1,) * (1 + len(self.shape)))
        if value.size * len(unique) > _MOST:
            return False
        hot = unique == value[..., None]  # (elements, repeats, values)
        self.features = self._stacked(hot.transpose(1, 2, 0).astype(float), mask)
        self.indicators = True
        return True

    def _stacked(self, rows: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        """Ones, then features ``(repeats, f, elements)``, zero where nothing was seen."""
        flat = rows.reshape((-1, rows.shape[-1]))
        if mask is None:
            return np.concatenate([np.ones((1, rows.shape[-1])), flat])
        flat = np.where(mask.T[:, None], rows, 0.0).reshape(flat.shape)
        return np.concatenate([mask.T.astype(float), flat])

    def _suffices(self) -> bool:
        """Whether parameters at every state are those of the elements with that label."""
        state = example_of(self.blanket.target)
        rng = np.random.default_rng(0)
        size = self.blanket.size
        label = rng.permutation(np.arange(size) % self.states)
        state[self.blanket.name] = label.reshape(self.blanket.node.plate_shape).astype(
            self._labels.dtype
        )
        try:
            full, _ = self.term.distribution(state)
            short = self._called(state)
        except Exception:  # a function that does not broadcast like this tells so in its own way
            return False
        if type(full) is not type(short):
            return False
        for (a, n), (b, _) in zip(full.parameters(), short.parameters(), strict=True):
            try:
                wanted, found = self.by_state(a, n, True), self.by_state(b, n)
            except ValueError:
                return False
            if found.shape[1] not in (1, self.states):
                return False
            if found.shape[1] != 1:
                found = found[:, label]
            if not ((wanted == found) | (np.isnan(wanted) & np.isnan(found))).all():
                return False
        return True


def example_of(target: Target) -> Values:
    """A state with one reachable value of every hidden node, ``(1, *plates, *event)``."""
    state: Values = dict(target.known)
    for name in target.chain:
        rows = np.asarray(target.model.probe[name])
        state[name] = rows.reshape((-1, *target.model[name].value_shape))[:1]
    target.refresh(state, target.chain)
    return state


def label_term(blanket: Blanket, child: Child) -> LabelTerm | None:
    """A child of a label as features, where it can be.

    The child's values are known, and of its parents only the label lives in the label's plates.
    """
    target, term = blanket.target, child.term
    own = set(blanket.node.plates)
    if child.relation.kind != "aligned" or term.is_potential or not own <= set(term.plates):
        return None
    if not target.is_known(term.name):
        return None
    if [p for p in term.parents if own & set(target.model[p].plates)] != [blanket.name]:
        return None
    assert blanket.node.domain is not None
    states = blanket.node.domain.size
    if states in (term.shape[term.plates.index(p)] for p in own):
        return None  # an array of the function's own might fit by chance
    if states > blanket.size:
        return None
    found = LabelTerm(blanket, child)
    return found if found._settle() else None


# ---- families -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Direct:
    """Parameters read off the nodes, ``(lead, states or 1, *event)``."""

    way: ByLabel
    values: Values

    def get(self, parameter: str, event_ndim: int = 0) -> np.ndarray:
        found = self.way.parameter(parameter, self.values)
        if len(self.way.shape) == 1:
            return found
        return found.reshape((len(found), -1, *found.shape[found.ndim - event_ndim :]))

    def precision(self) -> Precision:
        return self.way.precision(self.values)


@dataclass(frozen=True, eq=False)
class _Called:
    """Parameters of a distribution, ``(lead, states or 1, repeats, *event)``."""

    term: LabelTerm
    dist: Any

    def get(self, parameter: str, event_ndim: int = 0) -> np.ndarray:
        return self.term.by_state(getattr(self.dist, parameter), event_ndim)

    def precision(self) -> Precision:
        return precision_of(self.get("cov", 2))


@dataclass(frozen=True)
class _Family:
    """How a family's log density is a product.

    Attributes
    ----------
    features : callable
        Of values ``(elements, repeats, *event)``: ``(repeats, f, elements)``.
    linear : callable
        Of parameters and the centre of values: the constant, and the coefficients of the features.
    how : str
        What is done to values before anything else.
    squares, sums : bool
        Whether features are ``x, x x'`` or ``x`` alone, as in the sums that conjugate kernels take.
    """

    features: Callable[[np.ndarray], np.ndarray]
    linear: Callable[[Any, np.ndarray], tuple[np.ndarray, np.ndarray]]
    how: str = "value"
    squares: bool = False
    sums: bool = True
    is_count: bool = False

    def coefficients(self, parameters: _Direct | _Called, centre: np.ndarray) -> Coefficients:
        constant, rows = self.linear(parameters, centre)
        if rows.ndim == 3:
            return Coefficients(constant[..., None], rows)
        return Coefficients(constant, rows.reshape((*rows.shape[:2], -1)))


def _powers(v: np.ndarray) -> np.ndarray:
    return np.stack([v.T, v.T**2], axis=1)


def _first(v: np.ndarray) -> np.ndarray:
    return v.T[:, None]


def _products(v: np.ndarray) -> np.ndarray:
    v = v.transpose(1, 2, 0)
    i, j = np.tril_indices(v.shape[1])
    return np.concatenate([v, v[:, i] * v[:, j]], axis=1)


def _with_log(v: np.ndarray) -> np.ndarray:
    return np.stack([v.T, np.log(v.T)], axis=1)


def _of_normal(p: Any, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scale, off = p.get("scale"), p.get("loc") - centre
    weight = scale**-2.0
    linear = weight * off
    return -0.5 * linear * off - np.log(scale), _last_axis(linear, -0.5 * weight)


def _of_vectors(p: Any, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    precision, off = p.precision(), p.get("loc", 1) - centre
    linear = np.matvec(precision.matrix, off)
    constant = precision.half_log_det - 0.5 * np.vecdot(linear, off)
    at, factor = _packing(off.shape[-1])
    d = off.shape[-1]
    packed = precision.matrix.reshape((*precision.matrix.shape[:-2], d * d))[..., at] * factor
    if packed.shape[:-1] != linear.shape[:-1]:
        batch = np.broadcast_shapes(packed.shape[:-1], linear.shape[:-1])
        packed, linear = (np.broadcast_to(a, (*batch, a.shape[-1])) for a in (packed, linear))
    return constant, np.concatenate([linear, packed], axis=-1)


def _packing(d: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the lower triangle stands in a flat matrix, and what multiplies the products of values."""
    if d not in _PACKINGS:
        i, j = np.tril_indices(d)
        _PACKINGS[d] = i * d + j, np.where(i == j, -0.5, -1.0)
    return _PACKINGS[d]


_PACKINGS: dict[int, tuple[np.ndarray, np.ndarray]] = {}


def _of_counts(p: Any, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rate = p.get("rate")
    return -rate, np.log(rate)[..., None]


def _of_times(p: Any, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rate = p.get("rate")
    return np.log(rate) - rate * centre, -rate[..., None]


def _of_gammas(p: Any, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    concentration, rate = p.get("concentration"), p.get("rate")
    constant = concentration * np.log(rate) - special.gammaln(concentration)
    return constant, _last_axis(-rate, concentration - 1.0)


def _last_axis(*rows: np.ndarray) -> np.ndarray:
    return np.stack(np.broadcast_arrays(*rows), axis=-1)


_FAMILIES: dict[type, _Family] = {
    Normal: _Family(_powers, _of_normal, squares=True),
    LogNormal: _Family(_powers, _of_normal, "log", squares=True),
    MvNormal: _Family(_products, _of_vectors, squares=True),
    Poisson: _Family(_first, _of_counts, is_count=True),
    Exponential: _Family(_first, _of_times),
    Gamma: _Family(_with_log, _of_gammas, sums=False, is_count=True),
}
