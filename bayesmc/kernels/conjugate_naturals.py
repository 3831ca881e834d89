"""Natural parameters of a full conditional: the prior's and what every child adds, as one program."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from bayesmc.distributions import Categorical, Dirichlet, InverseWishart, MvNormal
from bayesmc.errors import TraceError
from bayesmc.expression import Expression, as_expression, broadcast, reshape
from bayesmc.kernels.conjugate_children import Child, apart, children_of
from bayesmc.kernels.conjugate_families import (
    Conditional,
    DirichletConditional,
    InverseWishartConditional,
    MvNormalConditional,
    family_of_features,
)
from bayesmc.kernels.conjugate_forms import Form, is_closed
from bayesmc.kernels.conjugate_labels import Counts, covariance_by_label, mean_by_label
from bayesmc.kernels.conjugate_priors import (
    Prior,
    bounds_of,
    naturals_of,
    of_members,
    own_features,
    prior_of,
)
from bayesmc.kernels.conjugate_range import least_values
from bayesmc.kernels.conjugate_terms import (
    Added,
    Moving,
    features_of,
    moving,
    refuse_moving_support,
    shares_sum_to_one,
)
from bayesmc.kernels.conjugate_vectors import covariance_added, mean_added
from bayesmc.kernels.conjugate_words import why_not
from bayesmc.kernels.label_sums import LabelSums
from bayesmc.network.expressions import stored_leaf
from bayesmc.passes.arithmetic import ZERO, add
from bayesmc.passes.features import LOG, Feature
from bayesmc.passes.reads import same_along
from bayesmc.structure.blanket import Blanket


def form_of(blanket: Blanket, members: np.ndarray | None) -> Form | str:
    """The full conditional of some elements of a node, or in words why it has no closed form."""
    try:
        prior = prior_of(blanket)
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


def _of_numbers(blanket: Blanket, members: np.ndarray | None, prior: Prior) -> Form | str:
    """Of numbers, by the features of prior and children."""
    if blanket.event_shape:
        return f"a {prior.words} prior has no conjugate pair"
    of = moving(blanket, members)
    try:
        own = own_features(blanket, prior, of)
    except TraceError:
        return f"a {prior.words} prior has no conjugate pair"
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
    alone = apart(blanket, child)
    refuse_moving_support(child.density, blanket.name)
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
        return f"a {prior.words} prior has no conjugate pair"
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
