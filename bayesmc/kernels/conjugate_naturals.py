"""Natural parameters of a full conditional: the prior's and what every child adds, as one program."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import (
    Categorical,
    Dirichlet,
    Distribution,
    InverseWishart,
    MvNormal,
    Truncated,
    Uniform,
)
from bayesmc.errors import BayesmcError, TraceError
from bayesmc.expression import (
    Expression,
    Family,
    Program,
    TracedArray,
    as_expression,
    broadcast,
    elementwise,
    pick,
    reshape,
)
from bayesmc.expression.scalars import SmallProgram
from bayesmc.kernels.conjugate_children import Child, apart, children_of, with_known
from bayesmc.kernels.conjugate_families import (
    Bounds,
    Conditional,
    DirichletConditional,
    InverseWishartConditional,
    MvNormalConditional,
    Naturals,
    NormalConditional,
    family_of_features,
)
from bayesmc.kernels.conjugate_labels import Counts, covariance_by_label, mean_by_label
from bayesmc.kernels.conjugate_range import least_values, refuse
from bayesmc.kernels.conjugate_terms import Added, Moving, features_of, moving, shares_sum_to_one
from bayesmc.kernels.conjugate_vectors import covariance_added, mean_added
from bayesmc.kernels.conjugate_words import why_not
from bayesmc.kernels.label_sums import LabelSums
from bayesmc.kernels.vector_draws import InverseWishartDraw, NormalDraw
from bayesmc.network.expressions import Opaque, stored_leaf
from bayesmc.passes.arithmetic import ZERO, add, multiply
from bayesmc.passes.features import LOG, Feature
from bayesmc.passes.log_density import family_of, has_own_form, log_density
from bayesmc.passes.reads import same_along
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Values


class Form:
    """The full conditional of a class of elements.

    Parameters
    ----------
    family : Conditional
    words : str
        The prior and the children that it rests on.
    naturals : sequence of Expression
        With the node's plates in front, or the members of the class.
    bounds : sequence of Expression
        Of the support, none or two.
    positive : sequence of tuple
        What must be positive, and the child that it is a parameter of.
    placed : sequence
        Sums by label that are beside the state.
    """

    def __init__(
        self,
        family: Conditional,
        words: str,
        naturals: list[Expression],
        bounds: list[Expression],
        positive: list[tuple[Expression, Child]],
        placed: list[LabelSums | Counts],
    ) -> None:
        self.family, self.words, self._placed = family, words, placed
        self._positive = [child for _, child in positive]
        roots = [*naturals, *bounds, *(e for e, _ in positive)]
        self._program = SmallProgram(roots)
        self._count, self._ends = len(naturals), len(naturals) + len(bounds)
        self._ndims = [len(r.shape) for r in roots]
        self._kept: tuple[Naturals, Bounds | None] | None = None
        self._draw = None if bounds or positive else _one_program(family, naturals)
        if not any(r.leaves for r in roots):
            self._kept = self({})

    def __call__(self, values: Values) -> tuple[Naturals, Bounds | None]:
        """Natural parameters, ``(lead, *plates, ...)`` or ``(lead, members, ...)``, and bounds."""
        if self._kept is not None:
            return self._kept
        values = self._with_sums(values)
        found = [
            a if a.ndim > n else a[None]
            for a, n in zip(self._program(values), self._ndims, strict=True)
        ]
        k, end = self._count, self._ends
        for least, child in zip(found[end:], self._positive, strict=True):
            if (least <= 0.0).any():
                refuse(child, values)
        return tuple(found[:k]), (found[k], found[k + 1]) if end > k else None

    def drawn(self, values: Values, rng: np.random.Generator, chains: int) -> np.ndarray | None:
        """A draw by one program, where there is one and it is a number; else None.

        Raises
        ------
        LinAlgError
            A matrix is not positive definite to rounding.
        """
        if self._draw is None:
            return None
        found = self._draw(self._with_sums(values), rng, chains)
        return found if math.isfinite(np.add.reduce(found, axis=None)) else None

    def left(self, values: Values) -> Values:
        """Sums by label that it reads and that are not in the state yet, for others that read them."""
        found: Values = {}
        for placed in self._placed:
            sums = placed.sums if isinstance(placed, Counts) else placed
            state = values if sums is None else sums.placed(values)
            if sums is not None and state is not values:
                found |= sums.kept(state[sums.label], state[sums.key])
        return found

    def _with_sums(self, values: Values) -> Values:
        for sums in self._placed:
            values = sums.placed(values)
        return values


def form_of(blanket: Blanket, members: np.ndarray | None) -> Form | str:
    """The full conditional of some elements of a node, or in words why it has no closed form."""
    try:
        prior = _prior(blanket)
    except TraceError as error:
        return str(error)
    if prior.base.make is Dirichlet:
        return _of_events(blanket, members, prior, DirichletConditional())
    if prior.base.make is MvNormal:
        return _of_events(blanket, members, prior, MvNormalConditional())
    if prior.base.make is InverseWishart:
        return _of_events(blanket, members, prior, InverseWishartConditional())
    return _of_numbers(blanket, members, prior)


# ---- private ------------------------------------------------------------------------------------


def _one_program(
    family: Conditional, naturals: list[Expression]
) -> NormalDraw | InverseWishartDraw | None:
    """Natural parameters and draw as one."""
    if isinstance(family, NormalConditional):
        linear, square = naturals
        return NormalDraw(multiply(square, -2.0), linear)
    if isinstance(family, MvNormalConditional):
        return NormalDraw(*naturals)
    return InverseWishartDraw(*naturals) if isinstance(family, InverseWishartConditional) else None


@dataclass(frozen=True, eq=False)
class _Prior:
    """A prior without its bounds.

    Attributes
    ----------
    low, high : Expression
    is_bounded : bool
        Whether they cut off some of the base.
    """

    base: Family
    words: str
    low: Expression
    high: Expression
    is_bounded: bool

    def ends(self, blanket: Blanket) -> tuple[float, float]:
        """The least and the largest value that it allows, as far as this is seen."""
        states = blanket.target.states
        if states is None:
            return -np.inf, np.inf
        low, high = Program([self.low, self.high])(states)
        return float(np.min(low)), float(np.max(high))


def _prior(blanket: Blanket) -> _Prior:
    assert blanket.own is not None
    read = blanket.own.read
    if isinstance(read, Opaque):
        raise TraceError(f"its prior cannot be followed ({read.reason})")
    family = _as_family(read.result)
    low: Any = as_expression(-np.inf)
    high: Any = as_expression(np.inf)
    words, bounded = getattr(family.make, "__name__", str(family.make)), False
    if family.make is Truncated and isinstance(family.parameters["base"], Family | Distribution):
        low, high = (_known(blanket, family.parameters[k]) for k in ("low", "high"))
        family = _as_family(family.parameters["base"])
        words, bounded = f"truncated {family.make.__name__}", True
    if family.make is Uniform:
        ends = [_known(blanket, family.parameters[k]) for k in ("low", "high")]
        low, high = elementwise(np.maximum, low, ends[0]), elementwise(np.minimum, high, ends[1])
        words, bounded = "Uniform", True
    return _Prior(family, words, low, high, bounded)


def _as_family(result: Any) -> Family:
    if isinstance(result, Family):
        return result
    if isinstance(result, InverseWishart):
        kept = {k: as_expression(getattr(result, k)) for k in ("df", "scale")}
        return Family(InverseWishart, kept)
    try:
        return family_of(result)
    except TraceError:
        raise TraceError(f"a {type(result).__name__} prior has no conjugate pair") from None


def _known(blanket: Blanket, value: Any) -> Expression:
    return with_known(blanket.target, as_expression(value))


def _of_numbers(blanket: Blanket, members: np.ndarray | None, prior: _Prior) -> Form | str:
    """Of numbers, by the features of prior and children."""
    if blanket.event_shape:
        return f"a {prior.words} prior has no conjugate pair"
    of = moving(blanket, members)
    try:
        own = _own_features(blanket, prior, of)
    except TraceError:
        return f"a {prior.words} prior has no conjugate pair"
    low, high = prior.ends(blanket)
    least, most = _SUPPORTS.get(prior.base.make.__name__, (0.0, np.inf))
    low, high = max(low, least), min(high, most)
    found_children = children_of(blanket)
    if not isinstance(found_children, list):
        return why_not(blanket, found_children, prior.words)
    children: dict[Child, Added] = {}
    for child in found_children:
        try:
            children |= _added(blanket, child, of, own, (low, high))
        except TraceError:
            return why_not(blanket, child.terms[0], prior.words)
    if not children:
        return "no child varies with it"
    everything = [own, *(c.coefficients for c in children.values())]
    found = dict.fromkeys(f for some in everything for f in some)
    family = family_of_features(found, low, high)
    if family is None:
        return _unlike(blanket, own, children, prior, low, high)
    naturals = []
    for feature in family.features:
        whole: Expression = ZERO
        for some in everything:
            whole = add(whole, some.get(feature, ZERO))
        naturals.append(_placed(broadcast(whole, (of.count,)), blanket, members))
    words = _words(
        prior,
        [_pair(c, of, a.is_picked and 2.0 not in a.coefficients) for c, a in children.items()],
    )
    positive = _positive(blanket, children)
    sums = [c.sums for c in children if c.sums is not None]
    form = Form(
        family, words, naturals, _bounds(blanket, members, prior, family), positive, list(sums)
    )
    if any(c.is_picked for c in children.values()) and not _is_closed(form, blanket):
        unlike = next(c for c, a in children.items() if a.is_picked)
        return why_not(blanket, unlike.terms[0], prior.words)
    return form


#: support of a prior, where that is not all positive numbers
_SUPPORTS = {"Normal": (-np.inf, np.inf), "Uniform": (-np.inf, np.inf), "Beta": (0.0, 1.0)}


def _own_features(blanket: Blanket, prior: _Prior, of: Moving) -> dict[Feature, Expression]:
    """Features of the prior itself."""
    if prior.base.make is Uniform:
        return {}
    if has_own_form(prior.base) and blanket.own is not None and blanket.own.expression is None:
        raise TraceError("its form gives other values than its log_prob")
    model = blanket.target.model
    density = log_density(prior.base, stored_leaf(model, model[blanket.name]))
    density = broadcast(_known(blanket, density), blanket.node.plate_shape)
    return dict(features_of(density, of, None, True).coefficients)


def _added(
    blanket: Blanket,
    child: Child,
    of: Moving,
    own: dict[Feature, Expression],
    ends: tuple[float, float],
) -> dict[Child, Added]:
    """What a child adds; like ones one by one, where together they are no sum of features."""
    is_share = ends[0] >= 0.0 and ends[1] <= 1.0
    alone = apart(blanket, child)
    try:
        found = {child: features_of(child.density, of, child.mask, False, is_share)}
        both = {**own, **found[child].coefficients}
        if alone and family_of_features(both, *ends) is None:
            raise TraceError("together they have other features")
    except TraceError:
        if not alone:
            raise
        found = {c: features_of(c.density, of, c.mask, False, is_share) for c in alone}
    return {c: a for c, a in found.items() if a.coefficients}


def _positive(blanket: Blanket, children: Iterable[Child]) -> list[tuple[Expression, Child]]:
    """What must be positive of the parameters of children."""
    model = blanket.target.model
    return [(e, c) for c in children for e in least_values(c, blanket.name, model)]


def _pair(child: Child, of: Moving, is_picked: bool) -> str:
    words = f"{child.word} {' and '.join(child.read(of.name))}"
    return f"{words} where it is picked" if is_picked else words


def _words(prior: _Prior, matched: list[str]) -> str:
    return f"{prior.words} with {', '.join(dict.fromkeys(matched))}"


def _unlike(
    blanket: Blanket,
    own: dict[Feature, Expression],
    children: dict[Child, Added],
    prior: _Prior,
    low: float,
    high: float,
) -> str:
    """Why prior and children are of no one family."""
    if family_of_features({**own, **_union(children)}, 0.0, 1.0) is not None:
        return "its flat prior reaches beyond what the parameter allows"
    power, whose = _power(own), f"a {prior.words} prior"
    for child, added in children.items():
        term, wanted = child.terms[0], _power(added.coefficients)
        if wanted is None:
            return why_not(blanket, term, prior.words)
        if power is not None and wanted != power:
            return (
                f"the density of child {term.name!r} has the power {wanted:g} of it in its exponential, and "
                f"{whose} the power {power:g}: no conjugate pair"
            )
        power, whose = wanted, "another child"
    return why_not(blanket, next(iter(children)).terms[0], prior.words)


def _union(children: dict[Child, Added]) -> dict[Feature, Expression]:
    return {f: c for child in children.values() for f, c in child.coefficients.items()}


def _power(found: Mapping[Feature, Any]) -> float | None:
    """The only power that occurs."""
    powers = [f for f in found if not isinstance(f, str)]
    return powers[0] if len(powers) == 1 and LOG in found else None


def _of_events(
    blanket: Blanket, members: np.ndarray | None, prior: _Prior, family: Conditional
) -> Form | str:
    """Of vectors, shares and covariances."""
    if prior.is_bounded:
        return f"a {prior.words} prior has no conjugate pair"
    of = moving(blanket, members, isinstance(family, DirichletConditional))
    naturals = _naturals_of(blanket, prior.base)
    found = children_of(blanket)
    if not isinstance(found, list):
        return why_not(blanket, found, prior.words)
    matched = []
    beside: list[LabelSums | Counts] = []
    for child in found:
        try:
            added, picked, sums = _event_added(blanket, child, of, family)
        except TraceError:
            return why_not(blanket, child.terms[0], prior.words)
        beside += sums
        naturals = [add(a, reshape(b, a.shape)) for a, b in zip(naturals, added, strict=True)]
        matched.append(_pair(child, of, picked))
    if not matched:
        return "no child varies with it"
    placed = [_placed(a, blanket, members) for a in naturals]
    return Form(family, _words(prior, matched), placed, [], _positive(blanket, found), beside)


def _event_added(
    blanket: Blanket, child: Child, of: Moving, family: Conditional
) -> tuple[tuple[Expression, ...], bool, list[LabelSums | Counts]]:
    """What a child adds, whether not all of its entries do, and the sums by label that it needs."""
    if isinstance(family, DirichletConditional):
        counts = _counts(blanket, child)
        if counts is not None:
            return (counts.leaf,), False, [counts]
        (child,) = apart(blanket, child) if child.sums is not None else (child,)
        density = shares_sum_to_one(child.density, blanket)
        found = features_of(density, of, child.mask, True)
        if set(found.coefficients) - {LOG}:
            raise TraceError("it has other features")
        return (found.coefficients.get(LOG, broadcast(ZERO, (of.count,))),), found.is_picked, []
    is_mean = isinstance(family, MvNormalConditional)
    if child.sums is not None:
        try:
            short = mean_by_label if is_mean else covariance_by_label
            return short(child.sums, blanket), False, [child.sums]
        except TraceError:
            (child,) = apart(blanket, child)
    whole = mean_added if is_mean else covariance_added
    return whole(child, of), False, []


def _counts(blanket: Blanket, child: Child) -> Counts | None:
    """How often each state of a child came, where the node is its row and nothing else."""
    target, (term, *more) = blanket.target, child.terms
    if more or child.family.make is not Categorical or blanket.node.plates or not term.shape:
        return None
    if term.name not in target.chain or target.seen(term.name) is not None:
        return None
    row = as_expression(child.family.parameters["probs"])
    row = broadcast(row, (*term.shape, *row.shape[-1:]))
    own = stored_leaf(target.model, blanket.node)
    if same_along(row, range(len(term.shape))) is not own:
        return None
    return Counts(target, term.name)


def _naturals_of(blanket: Blanket, base: Family) -> list[Expression]:
    """Natural parameters of the prior, one block for each element."""
    count = blanket.size
    parameters: dict[str, Any] = {
        k: _by_element(_known(blanket, v), blanket, 2 if k in ("cov", "scale", "scale_tril") else 1)
        for k, v in base.parameters.items()
        if isinstance(v, Expression) and k != "df"
    }
    if base.make is Dirichlet:
        return [add(parameters["concentration"].expression, -1.0)]
    if base.make is InverseWishart:
        df = broadcast(_known(blanket, base.parameters["df"]), blanket.node.plate_shape)
        return [reshape(df, (count,)), parameters["scale"].expression]
    if "scale_diag" in parameters:
        d = blanket.event_shape[-1]
        precision = parameters["scale_diag"][..., None] ** -2.0 * np.eye(d)
    else:
        factor = parameters.get("scale_tril")
        factor = np.linalg.cholesky(parameters["cov"]) if factor is None else factor
        inverse = np.linalg.inv(factor)
        precision = np.matmul(np.matrix_transpose(inverse), inverse)
    linear = np.matvec(precision, parameters["loc"])
    return [
        a.expression if isinstance(a, TracedArray) else as_expression(a)
        for a in (precision, linear)
    ]


def _by_element(value: Expression, blanket: Blanket, event_ndim: int) -> Any:
    """A parameter for each element: ``(count, *event)``."""
    d = blanket.event_shape[-1]
    event = (d,) * event_ndim
    whole = broadcast(value, (*blanket.node.plate_shape, *event))
    return TracedArray(reshape(whole, (blanket.size, *event)))


def _placed(natural: Expression, blanket: Blanket, members: np.ndarray | None) -> Expression:
    """Of all elements as the node's plates, or of those of a class."""
    shape = blanket.node.plate_shape
    block = natural.shape[1:]
    if natural.shape[0] != blanket.size:  # number by number
        block = blanket.event_shape
        natural = reshape(natural, (blanket.size, *block))
    if members is None:
        return reshape(natural, (*shape, *block))
    at = np.arange(natural.size).reshape(natural.shape)
    return pick([natural], at[members])


def _bounds(
    blanket: Blanket, members: np.ndarray | None, prior: _Prior, family: Conditional
) -> list[Expression]:
    """The ends of the support, where they cut off some of the family's."""
    low, high = prior.low, prior.high
    least, most = _SUPPORTS.get(prior.base.make.__name__, (0.0, np.inf))
    if not prior.is_bounded and least <= family.low and most >= family.high:
        return []
    low, high = elementwise(np.maximum, low, least), elementwise(np.minimum, high, most)
    shape, size = blanket.node.plate_shape, blanket.size
    ends = [reshape(broadcast(e, shape), (size,)) for e in (low, high)]
    return [_placed(e, blanket, members) for e in ends]


def _is_closed(form: Form, blanket: Blanket) -> bool:
    """Whether there is a closed form at some states."""
    states: Values | None = blanket.target.states
    if states is None:
        return False
    try:
        naturals, _ = form(states)
    except BayesmcError:
        return False
    return all(bool(np.isfinite(n).all()) for n in naturals)
