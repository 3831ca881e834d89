"""Nodes that are drawn in slice 0 and computed in later ones: lags, read as distributions without choice.

Of ``dbn.add("x_lag", lambda x_prev: x_prev, initial=Normal(0.0, 1.0))`` the value is drawn in slice 0, copied
later. To engines a node is one thing in all slices, so the copy is a point mass: ``Normal(x_prev, 0.0)`` of
numbers, one state for certain of finite nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from bayesmc.distributions import (
    Bernoulli,
    Categorical,
    DiscreteUniform,
    Distribution,
    MvNormal,
    Normal,
)
from bayesmc.errors import ModelError
from bayesmc.network import CompiledNode, Model
from bayesmc.network.labels import Domain
from bayesmc.network.node import Declaration, as_lag, way_out_of_lag
from bayesmc.states import StateArray


def lags_by_chance(
    later: Mapping[str, Declaration], drawn: Model, computed: Model
) -> dict[str, Declaration]:
    """Other declarations for later slices of nodes that have a density in slice 0 only.

    Parameters
    ----------
    later : dict
        Name -> declaration in later slices, of these nodes.
    drawn, computed : Model
        What slice 0 and two slices in a row compile to.

    Raises
    ------
    ModelError
        No point mass has the values that slice 0 draws.
    """
    return {
        n: replace(d, function=_certain(d, _mass(drawn[n], computed[n]))) for n, d in later.items()
    }


# ---- private ------------------------------------------------------------------------------------


def _certain(
    declaration: Declaration, mass: Callable[[Any], Distribution]
) -> Callable[..., Distribution]:
    """The function of a node, with a point mass about what it returns."""
    function = declaration.function
    assert function is not None

    def certain(*values: Any) -> Distribution:
        return mass(function(*values))

    return as_lag(certain)


def _mass(drawn: CompiledNode, computed: CompiledNode) -> Callable[[Any], Distribution]:
    """What a value for certain is, on the values that slice 0 draws."""
    refused = _refusal(drawn, computed)
    if refused is not None:
        named = replace(computed.declaration, function=as_lag(lambda: None))
        raise ModelError(f"node {drawn.name!r}: {refused}. {way_out_of_lag(named)}")
    if not drawn.is_discrete:
        return _vector if drawn.event_shape else _number
    if drawn.domain is None:
        return _count
    plain = drawn.domain.labels is None and drawn.domain.size == 2
    return _bit if plain else _State(drawn.domain)


def _refusal(drawn: CompiledNode, computed: CompiledNode) -> str | None:
    """Why a node has no point mass."""
    domain = drawn.domain
    if computed.is_object or drawn.is_object:
        return "objects have no distribution that is certain"
    if drawn.event_shape != computed.event_shape:
        return f"the values have shapes {drawn.event_shape} and {computed.event_shape}"
    if drawn.angles is not None:
        return "no distribution on a circle is certain"
    if len(drawn.event_shape) > 1 or (drawn.event_shape and drawn.is_discrete):
        kind = "whole numbers" if drawn.is_discrete else "axes"
        return f"no distribution of values with {kind} and shape {drawn.event_shape} is certain"
    if not drawn.is_discrete:
        what = computed.declaration.states is not None or computed.domain is not None
        labelled = what and computed.domain is not None and computed.domain.labels is not None
        return "one is a number, the other a state with a label" if labelled else None
    if domain is None:
        return None if computed.is_discrete else "one is a whole number, the other is not"
    if domain.low or domain.values is not None:
        return f"its states are the numbers {domain.states[0]}..{domain.states[-1]}, not 0, 1, ..."
    return _unlike(domain, computed)


def _unlike(domain: Domain, computed: CompiledNode) -> str | None:
    """How computed states differ from those that are drawn, as far as that can be told."""
    own = computed.domain
    if own is None:
        return None if computed.is_discrete else "one is a state, the other a number"
    labelled = domain.labels is not None
    if own.labels != domain.labels and not (labelled and own.labels is None):
        return f"its states are {domain.states} in slice 0 and {own.states} later"
    if own.numbers is not None:
        beyond = ~np.isin(own.numbers, np.arange(domain.size))
        if beyond.any():
            value = own.numbers[beyond][0]
            return f"{value} is none of the {domain.size} states of slice 0"
    return None


def _number(value: Any) -> Distribution:
    return Normal(value, 0.0)


def _vector(value: Any) -> Distribution:
    size = np.shape(value)[-1]
    return MvNormal(value, np.zeros((size, size)))


def _count(value: Any) -> Distribution:
    return DiscreteUniform(value, value)


def _bit(value: Any) -> Distribution:
    return Bernoulli(1.0 * value)


class _State:
    """One state for certain, of labelled ones and of more than two."""

    def __init__(self, domain: Domain) -> None:
        self.states, self.size = domain.labels, domain.size

    def __call__(self, value: Any) -> Distribution:
        if isinstance(value, StateArray) and self.states is not None:
            rows = [np.asarray(value == label) for label in self.states]
        else:
            rows = [value == k for k in range(self.size)]
        return Categorical(np.stack([1.0 * row for row in rows], axis=-1))
