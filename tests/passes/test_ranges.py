"""Parameters out of their range have no density: closed forms with their conditions beside the families."""

from __future__ import annotations

import itertools
from typing import Any
from unittest import mock

import numpy as np
import pytest
from scipy import special

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.expression import Expression, Program, TracedArray, constant, elementwise, leaf, trace
from bayesmc.passes import ranges
from bayesmc.passes.log_density import log_density
from bayesmc.passes.ranges import TRUE, in_range
from tests.passes.test_log_density import FAMILIES

POINTS = np.array([-1.5, -0.4, 0.0, 0.3, 0.5, 1.0, 1.4])


def forms(make: Any, value: Any) -> Expression:
    family = trace(make, [TracedArray(leaf("a", ())), TracedArray(leaf("p", ()))])
    log = log_density(family, constant(np.asarray(value)))
    return elementwise(np.where, in_range(family), log, -np.inf)


def differing(name: str) -> list[tuple[float, float]]:
    """Parameters for which the form is finite and the family has none, or the other way round."""
    make, values = FAMILIES[name]
    found = []
    for value in values:
        program = Program([forms(make, value)])
        for a, p in itertools.product(POINTS, POINTS):
            try:
                (log,) = program({"a": np.array(a), "p": np.array(p)})
            except np.linalg.LinAlgError:
                log = np.array(np.nan)
            with marking_invalid(), np.errstate(all="ignore"):
                dist = make(np.array(a), np.array(p))
                own = dist.log_prob(value)
            bad = dist.invalid is not None and bool(np.all(dist.invalid))
            if np.isfinite(log).all() != (np.isfinite(own).all() and not bad):
                found.append((a, p))
    return found


@pytest.mark.parametrize("name", FAMILIES)
def test_a_form_ends_where_its_family_does(name: str) -> None:
    assert not differing(name)


@pytest.mark.parametrize(
    "name", ["Gamma", "Beta", "Poisson", "Bernoulli", "Geometric", "Dirichlet", "Categorical"]
)
def test_without_its_condition_it_goes_on(name: str) -> None:
    """Negative control."""
    with mock.patch.object(ranges, "_RANGES", {}):
        assert differing(name)


def test_what_is_seen_costs_nothing() -> None:
    a, p = TracedArray(leaf("a", ())), TracedArray(leaf("p", (3,)))

    def gamma(a: Any, p: Any) -> Any:
        return bmc.Gamma(np.exp(a), a)

    def odds(a: Any, p: Any) -> Any:
        return bmc.Binomial(4, 1.0 - special.expit(p) * special.ndtr(a))

    assert in_range(trace(gamma, [a, p])) is TRUE
    assert in_range(trace(odds, [a, p])) is TRUE
    assert in_range(bmc.Normal(0.0, 1.0)) is TRUE
