"""Natural parameters of a full conditional: the prior's and its children's; or why there are none."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np

from bayesmc.distributions import (
    Categorical,
    Dirichlet,
    InverseWishart,
    Multinomial,
    MvNormal,
    Wishart,
)
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Expression,
    Family,
    as_expression,
    broadcast,
    expressions_of,
    leaf,
    reshape,
)
from bayesmc.kernels.conjugate_children import Child, apart, children_of, least_values
from bayesmc.kernels.conjugate_families import (
    Conditional,
    DirichletConditional,
    Form,
    InverseWishartConditional,
    MvNormalConditional,
    WishartConditional,
    family_of_features,
    is_closed,
)
from bayesmc.kernels.conjugate_terms import (
    Added,
    Moving,
    Prior,
    bounds_of,
    features_of,
    moving,
    naturals_of,
    of_members,
    own_features,
    prior_of,
    refuse_moving_support,
    shares_sum_to_one,
)
from bayesmc.kernels.conjugate_vectors import (
    covariance_added,
    covariance_by_label,
    mean_added,
    mean_by_label,
)
from bayesmc.kernels.label_sums import Counts, LabelSums
from bayesmc.network.expressions import Opaque, stored_leaf
from bayesmc.passes.affine import affine
from bayesmc.passes.arithmetic import ZERO, add
from bayesmc.passes.features import LOG, LOG1M, Feature, statistics
from bayesmc.passes.log_density import log_density
from bayesmc.passes.reads import is_recursion, same_along
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Term

#: parameters of vectors -> how a node must enter them
_OF_VECTORS: dict[tuple[Any, str], str] = {
    (MvNormal, "loc"): "mean", (MvNormal, "cov"): "multiple", (MvNormal, "scale_tril"): "power",
    (MvNormal, "scale_diag"): "power", (Categorical, "probs"): "shares",
    (Multinomial, "probs"): "shares",
}  # fmt: skip


_OF_EVENTS: dict[Any, type[Conditional]] = {
    Dirichlet: DirichletConditional, MvNormal: MvNormalConditional,
    InverseWishart: InverseWishartConditional, Wishart: WishartConditional,
}  # fmt: skip


def form_of(blanket: Blanket, members: np.ndarray | None) -> Form | str:
    """The full conditional of some elements of a node, or in words why it has no closed form."""
    try:
        prior = prior_of(blanket)
    except TraceError as error:
        return str(error)
    if prior.base.make in _OF_EVENTS:
        return _of_events(blanket, members, prior, _OF_EVENTS[prior.base.make]())
    return _of_numbers(blanket, members, prior)


def why_not(blanket: Blanket, term: Term, prior: str) -> str:
    """Why a child makes no conjugate pair with a node under a prior."""
    name, child = blanket.name, term.name
    if term.is_potential:
        return f"it enters the potential {child!r}"
    if isinstance(term.read, Opaque):
        return f"child {child!r} cannot be followed ({term.read.reason})"
    family = term.read.result
    if not isinstance(family, Family):
        return f"child {child!r} is no distribution that can be followed"
    word = getattr(family.make, "__name__", str(family.make))
    parameters = family.parameters.items()
    read = [k for k, v in parameters if any(name in e.leaves for e in expressions_of(v))]
    forms = {k: form for k in family.parameters if (form := _form(family, k, read)) is not None}
    if not forms:
        return f"child {child!r} is {word}, which makes no conjugate pair"
    if len(read) > 1:
        return f"it enters {' and '.join(read)} of child {child!r}"
    (parameter,) = read
    if prior == "Wishart" and parameter == "cov":
        told = "a number times the inverse of one element of it"
        return f"the cov of child {child!r} is not known to be {told}"
    if parameter not in forms:
        return f"it enters the {parameter} of {word} {child!r}"
    told = f"the {parameter} of child {child!r}"
    fits = _fits(forms[parameter], prior)
    if not fits:
        return f"child {child!r} is {word}, which makes no conjugate pair with a {prior} prior"
    why = _bent(family.parameters[parameter], name) if forms[parameter] == "mean" else ""
    if why:
        return f"{told} is not known to be affine in it (after {why})"
    if len(blanket.classes) > 1 or forms[parameter] == "mean":
        return f"{told} may depend on several elements of {name!r}"
    if forms[parameter] == "power":
        return f"{told} is not known to be a power of it times a constant"
    if forms[parameter] == "multiple":
        many = blanket.event_shape == (family.parameters[parameter].shape[-1],) * 2
        what = "its value times a number" if many else "a power of it times a constant"
        return f"{told} is not known to be {what}"
    return f"{told} is not known to be its value itself"


# ---- private ------------------------------------------------------------------------------------


def _of_numbers(blanket: Blanket, members: np.ndarray | None, prior: Prior) -> Form | str:
    """Of numbers, by the features of prior and children."""
    if blanket.event_shape:
        return f"the prior, {prior.words}, has no conjugate pair"
    terms = [t.expression for t in blanket.target.terms_of((blanket.name,))]
    if is_recursion([e for e in terms if e is not None], blanket.name):
        return "terms of its children are made of each other, and would be long if each were written out"
    of = moving(blanket, members)
    try:
        own = own_features(blanket, prior, of)
    except TraceError:
        return f"the prior, {prior.words}, has no conjugate pair"
    low, high = prior.ends(blanket)
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
        naturals.append(of_members(broadcast(whole, (of.count,)), blanket, members))
    words = _words(
        prior,
        [_pair(c, of, a.is_picked and 2.0 not in a.coefficients) for c, a in children.items()],
    )
    positive = _positive(blanket, children)
    sums = [c.sums for c in children if c.sums is not None]
    form = Form(
        family, words, naturals, bounds_of(blanket, members, prior, family), positive, list(sums)
    )
    if any(c.is_picked for c in children.values()) and not is_closed(form, blanket):
        unlike = next(c for c, a in children.items() if a.is_picked)
        return why_not(blanket, unlike.terms[0], prior.words)
    return form


def _added(
    blanket: Blanket,
    child: Child,
    of: Moving,
    own: dict[Feature, Expression],
    ends: tuple[float, float],
) -> dict[Child, Added]:
    """What a child adds; like ones one by one, where together they are no sum of features."""
    is_share = ends[0] >= 0.0 and ends[1] <= 1.0
    refuse_moving_support(child.density, blanket.name)
    try:
        found = {child: features_of(child.density, of, child.mask, False, is_share)}
        both = {**own, **found[child].coefficients}
        if not child.is_alone and family_of_features(both, *ends) is None:
            raise TraceError("together they have other features")
    except TraceError:
        if child.is_alone:
            raise
        alone = apart(blanket, child)
        found = {c: features_of(c.density, of, c.mask, False, is_share) for c in alone}
    return {c: a for c, a in found.items() if a.coefficients}


def _positive(blanket: Blanket, children: Iterable[Child]) -> list[tuple[Expression, Child]]:
    """What must be positive of the parameters of children."""
    model = blanket.target.model
    return [(e, c) for c in children for e in least_values(c, blanket.name, model)]


def _pair(child: Child, of: Moving, is_picked: bool) -> str:
    words = f"{child.word} {' and '.join(child.read(of.name))}"
    return f"{words} where it is picked" if is_picked else words


def _words(prior: Prior, matched: list[str]) -> str:
    return f"{prior.words} with {', '.join(dict.fromkeys(matched))}"


def _unlike(
    blanket: Blanket,
    own: dict[Feature, Expression],
    children: dict[Child, Added],
    prior: Prior,
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
    blanket: Blanket, members: np.ndarray | None, prior: Prior, family: Conditional
) -> Form | str:
    """Of vectors, shares and covariances."""
    if prior.is_bounded:
        return f"the prior, {prior.words}, has no conjugate pair"
    of = moving(blanket, members, isinstance(family, DirichletConditional))
    naturals = naturals_of(blanket, prior.base)
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
    placed = [of_members(a, blanket, members) for a in naturals]
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
    is_inverse = isinstance(family, WishartConditional)
    if child.sums is not None:
        try:
            short = (
                mean_by_label if is_mean else partial(covariance_by_label, is_inverse=is_inverse)
            )
            return short(child.sums, of), False, [child.sums]
        except TraceError:
            (child,) = apart(blanket, child)
    whole = mean_added if is_mean else partial(covariance_added, is_inverse=is_inverse)
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


_PRIORS = {
    "mean": ("Normal", "MvNormal", "Uniform"),
    "power": ("Gamma", "InverseGamma", "Exponential", "Uniform"),
    "multiple": ("Gamma", "InverseGamma", "Exponential", "Uniform", "InverseWishart"),
    "share": ("Beta", "Uniform"),
    "shares": ("Beta", "Dirichlet", "Uniform"),
}


def _fits(form: str, prior: str) -> bool:
    return prior.removeprefix("truncated ") in _PRIORS[form]


def _form(family: Family, parameter: str, read: list[str]) -> str | None:
    """How a node must enter a parameter: as the features tell that this parameter has itself."""
    if (family.make, parameter) in _OF_VECTORS:
        return _OF_VECTORS[family.make, parameter]
    others: dict[str, Any] = {**family.parameters}
    if family.parameters[parameter] is None:  # given instead of what is read
        others |= dict.fromkeys(read)
    others[parameter] = leaf("\0itself", ())
    try:
        found = statistics(
            log_density(Family(family.make, others), leaf("\0value", ())), "\0itself"
        )
    except (TraceError, TypeError, IndexError):  # of a vector or a matrix, which this is not
        return None
    if set(found.coefficients) == {1.0, 2.0}:
        return "mean"
    return "share" if LOG1M in found.coefficients else "power"


def _bent(value: Any, name: str) -> str:
    """The operation after which a parameter is no longer affine."""
    try:
        affine(value, [name])
    except TraceError as error:
        return str(error).removesuffix(" is not affine")
    return ""
