"""Observed nodes whose probability is a normal cdf of one affine combination, read off their expressions.

What the combination is does not depend on what is observed, and is kept with the model for its next question.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy import special

from bayesmc.distributions import Bernoulli
from bayesmc.engines.propagation.coordinates import Numbers
from bayesmc.engines.propagation.kernels import Probit
from bayesmc.engines.propagation.scopes import basis
from bayesmc.errors import TraceError
from bayesmc.expression import Elementwise, Expression, Family, broadcast
from bayesmc.network import Model
from bayesmc.passes.affine import Affine, affine


class Directed(NamedTuple):
    """Rows as factors of a direction each: coordinates (f, m), weights (f, 1, m)."""

    kernel: Probit
    coordinates: np.ndarray
    weights: np.ndarray


class Reader(Protocol):
    """What is asked of ``Terms``."""

    model: Model
    known: Mapping[str, np.ndarray]
    numbers: Mapping[str, Numbers]
    cut: frozenset[str]

    def result(self, name: str) -> Any: ...

    def substituted(self, root: Expression) -> Expression: ...

    def coefficients(
        self, forms: Any, values: Any, cards: Any, shape: Any, at: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]: ...


def probit_of(terms: Reader, name: str, shape: tuple[int, ...], at: np.ndarray) -> Directed | None:
    """Some elements of an observed node, where it has such a probability; else None."""
    if name not in terms.model.nodes or name not in terms.known:
        return None
    form = _inside_cdf(terms, name, shape)
    if form is None or form.beyond - set(terms.known):
        return None
    offset, gain, coordinates, weights = _directions(terms, form, shape, at)
    sign = 2.0 * np.broadcast_to(terms.known[name], shape).reshape(-1)[at] - 1.0
    return Directed(Probit(sign, offset, gain), coordinates, weights)


# ---- private ------------------------------------------------------------------------------------


class _Inside(NamedTuple):
    """An affine form, what it reads besides of hidden numbers, and coefficients as of the last question."""

    form: Affine
    beyond: frozenset[str]
    kept: dict[Any, Any]


def _inside_cdf(terms: Reader, name: str, shape: tuple[int, ...]) -> _Inside | None:
    is_plain = all(x.is_plain for x in terms.numbers.values())
    kept = terms.model.cache.setdefault("affine inside of probits", {})
    key = name, terms.cut, frozenset(terms.numbers)
    if is_plain and key in kept:
        return kept[key]
    family, found = terms.result(name), None
    if isinstance(family, Family) and family.make is Bernoulli:
        probs = family.parameters.get("probs")
        if isinstance(probs, Elementwise) and probs.function is special.ndtr:
            inside = broadcast(terms.substituted(probs.operands[0]), shape)
            names = {x.leaf.name for x in terms.numbers.values()}  # type: ignore[attr-defined]
            free = names & inside.leaves
            with suppress(TraceError):
                found = _Inside(affine(inside, free), inside.leaves - free, {})
    if is_plain:
        kept[key] = found
    return found


def _directions(
    terms: Reader, inside: _Inside, shape: tuple[int, ...], at: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Offsets and gains of rows' directions, shape (f,), their coordinates and weights."""
    numbers = terms.numbers.items()
    token = at.tobytes(), *((n, x.at.tobytes(), x.seen.tobytes()) for n, x in numbers)
    if token in inside.kept:
        return inside.kept[token]
    offset, gain, coordinates = terms.coefficients((inside.form,), terms.known, (), shape, at)
    weights, within = basis(gain.reshape(len(at), 1, -1))
    found = offset[:, 0, 0], within[:, 0, 0], coordinates, weights
    if not inside.beyond:  # what is known may be something else next time
        inside.kept.clear()
        inside.kept[token] = found
    return found
