"""Which terms are Normal, and in which nodes their residuals are affine: read off the expression graph.

A Normal term says that ``value - mean`` over its scale is standard normal. Where that residual is affine in
some nodes, and the scale is free of them, the term is Gaussian in these nodes jointly. Like terms (the
transitions of a chain of slices) are one template, so a thousand slices are asked once.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import LogNormal, MvNormal, Normal
from bayesmc.errors import DensityError, TraceError
from bayesmc.expression import (
    Expression,
    Family,
    as_expression,
    call,
    elementwise,
    expressions_of,
    mapped,
    pick,
)
from bayesmc.network.expressions import Opaque, stored_leaf, value_of
from bayesmc.passes.affine import Affine, affine
from bayesmc.passes.templates import Template, template
from bayesmc.structure.programs import family_read, roots_of, template_of
from bayesmc.structure.target import Target, Term

_FAMILIES = (Normal, MvNormal, LogNormal)


@dataclass(frozen=True, eq=False)
class NormalKind:
    """What like Normal terms are.

    Attributes
    ----------
    first : Term
    family : Family
        Of the first: ``Normal``, ``MvNormal``, or ``LogNormal``, of which the logarithm is meant.
    spread : str
        What ``scale`` is: ``"scale"`` standard deviations, ``"cov"``, ``"scale_tril"`` or ``"scale_diag"``.
    """

    first: Term
    family: Family
    spread: str

    @property
    def roots(self) -> tuple[Expression, ...]:
        """The first one's parameters and its stored value."""
        own = stored_leaf(self.first.model, self.first.model[self.first.name])
        return (*expressions_of(self.family), own)

    def parts(self, roots: Sequence[Expression]) -> tuple[Expression, Expression]:
        """The value less the mean, shape ``(*plates, *event)``, and the scale as it was given.

        Parameters
        ----------
        roots : sequence of Expression
            In the place of its own.
        """
        *parameters, value = roots
        given = iter(parameters)
        family = mapped(self.family, lambda _: next(given))
        if family.make is LogNormal:
            value = elementwise(np.log, value)
        residual = elementwise(np.subtract, value, family.parameters["loc"])
        return residual, as_expression(family.parameters[self.spread])


@dataclass(frozen=True, eq=False)
class NormalTerm:
    """A Normal term.

    Attributes
    ----------
    term : Term
    kind : NormalKind
    template : Template
        Of parameters and value.
    key : hashable
        Equal for like terms.
    """

    term: Term
    kind: NormalKind
    template: Template
    key: Hashable

    @property
    def leaves(self) -> tuple[str, ...]:
        """The nodes that it reads, in the order in which like terms correspond."""
        return self.template.leaves

    @property
    def roots(self) -> tuple[Expression, ...]:
        """Its parameters and its stored value."""
        return self.kind.roots if self.kind.first is self.term else roots_of(self.term)


class NormalTerms:
    """The Normal terms of a target, each read once.

    Parameters
    ----------
    target : Target

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.gaussian_terms import NormalTerms
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Normal(0.0, 1.0))
    >>> net.add("b", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda a, b: bmc.Normal(a + b, 1.0))
    >>> net.add("z", lambda a, b: bmc.Normal(a * b, 1.0))
    >>> terms = NormalTerms(target_of(pose(net, {"y": 1.0, "z": 1.0})))
    >>> [terms.are_joint(terms.of(n), {"a", "b"}) for n in "yz"]
    [True, False]
    """

    def __init__(self, target: Target) -> None:
        self.target = target
        self._found: dict[str, NormalTerm | None] = {}
        self._forms: dict[Hashable, Affine | None] = {}
        self._kinds: dict[Hashable, NormalKind | None] = {}

    def of(self, name: str) -> NormalTerm | None:
        """A term; None where it is not Normal."""
        if name not in self._found:
            self._found[name] = self._read(self.target.terms[name])
        return self._found[name]

    def is_prior(self, name: str) -> bool:
        """Whether a node's own density is that of a Normal number or vector."""
        own = self.of(name) if name in self.target.terms else None
        event = self.target.model[name].event_shape
        return own is not None and own.kind.family.make is not LogNormal and len(event) < 2

    def are_joint(self, found: NormalTerm, names: Collection[str]) -> bool:
        """Whether the nodes among ``names`` that a term reads enter it in an affine way.

        Of several, none may be looked up by what varies.
        """
        places = tuple(k for k, n in enumerate(found.leaves) if n in names)
        key = found.key, places
        if key not in self._forms:
            self._forms[key] = _form(found, [found.leaves[k] for k in places])
        form = self._forms[key]
        if form is None or len(places) < 2:
            return form is not None
        target = self.target
        return all(
            target.is_known(n) or n.startswith("constant ")
            for read in form.reads.values()
            for n in read.at.leaves
        )

    def like(self, terms: Sequence[Term], inside: Collection[str]) -> list[list[NormalTerm]]:
        """Terms by likeness, in the order in which they begin, those that ``inside`` enters alike."""
        groups: dict[Hashable, list[NormalTerm]] = {}
        for term in terms:
            found = self.of(term.name)
            assert found is not None, "a block has Normal terms only"
            within = tuple(n in inside for n in found.leaves)
            groups.setdefault((found.key, within, term.name in inside), []).append(found)
        return list(groups.values())

    # ---- private -------------------------------------------------------------------------------

    def _read(self, term: Term) -> NormalTerm | None:
        if term.is_potential or term.model[term.name].is_discrete:
            return None
        if isinstance(term.read, Opaque):
            kind = _kind(term, _called(self.target, term))
            made = None if kind is None else template(*kind.roots)
        else:
            made = template_of(term)
            if made.key not in self._kinds:
                self._kinds[made.key] = _kind(term, family_read(term))
            kind = self._kinds[made.key]
        if kind is None or made is None:
            return None
        known = tuple(map(self.target.is_known, made.leaves))
        return NormalTerm(term, kind, made, (made.key, known))


# ---- private ------------------------------------------------------------------------------------


def _kind(term: Term, family: Any) -> NormalKind | None:
    """What a term is, if it is Normal."""
    if not isinstance(family, Family) or family.make not in _FAMILIES:
        return None
    spreads = (
        k for k in ("scale", "cov", "scale_tril", "scale_diag")
        if family.parameters.get(k) is not None
    )  # fmt: skip
    return NormalKind(term, family, next(spreads))


def _called(target: Target, term: Term) -> Family | None:
    """A term whose function cannot be followed, but returns a Normal: Gaussian in its own value."""
    model = term.model
    node, parents = model[term.name], tuple(dict.fromkeys(term.parents))
    try:
        values = {n: target.known.get(n, model.probe[n]) for n in parents}
        tried = type(model.evaluate(term.name, values)[0])
    except Exception:
        return None
    if tried is not Normal:
        return None
    if any(model[n].kind == "deterministic" and model[n].domain is not None for n in parents):
        return None
    leaves = [
        value_of(model, n) if model[n].kind == "deterministic" else stored_leaf(model, model[n])
        for n in parents
    ]
    both = call(_Parameters(term, parents), leaves, (2, *node.plate_shape), float)
    at = np.arange(both.size).reshape(both.shape)
    return Family(Normal, {"loc": pick([both], at[0]), "scale": pick([both], at[1])})


@dataclass(frozen=True)
class _Parameters:
    """Mean and scale of a Normal term, as its function gives them, shape ``(*batch, 2, *plates)``."""

    term: Term
    parents: tuple[str, ...]

    def __call__(self, *values: np.ndarray) -> np.ndarray:
        given = dict(zip(self.parents, values, strict=True))
        dist, batch = self.term.distribution(given)
        if not isinstance(dist, Normal):
            raise DensityError(f"node {self.term.name!r} is not always Normal")
        full = batch + self.term.shape
        parts = [np.broadcast_to(p, full) for p in (dist.loc, dist.scale)]
        return np.stack(parts, axis=len(batch))


def _form(found: NormalTerm, names: Sequence[str]) -> Affine | None:
    residual, scale = found.kind.parts(found.roots)
    if scale.leaves & set(names):
        return None
    try:
        return affine(residual, names)
    except TraceError:
        return None
