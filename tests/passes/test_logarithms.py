"""Exponentials and their logarithms taken together: the same values, and finite ones far out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np
import pytest
from scipy import special

from bayesmc.expression import Expression, Program, TracedArray, leaf, trace
from bayesmc.passes import logarithms
from bayesmc.passes.logarithms import stable
from bayesmc.testing import session
from tests.expression.random_functions import ARGUMENTS, random_arguments, random_function
from tests.expression.test_random_functions import stand_ins

#: a function of (u, c) -> its value for u = 800 and c = 2.5, NaN where it is infinite or zero for good
RULES: dict[str, tuple[Callable[..., Any], float]] = {
    "log of exp": (lambda u, c: np.log(np.exp(u)), 800.0),
    "log of a product": (lambda u, c: np.log(c * np.exp(u)), 800.0 + np.log(2.5)),
    "log of a product of two": (lambda u, c: np.log(np.exp(u) * np.exp(u)), 1600.0),
    "log of a quotient": (lambda u, c: np.log(c / np.exp(u)), np.log(2.5) - 800.0),
    "log of a root": (lambda u, c: np.log(1 / np.sqrt(np.exp(u))), -400.0),
    "log of a square": (lambda u, c: np.log(np.exp(u) ** 2), 1600.0),
    "log of a power": (lambda u, c: np.log(np.exp(u) ** c), 2000.0),
    "log of a reciprocal": (lambda u, c: np.log(np.reciprocal(np.exp(u))), -800.0),
    "log of a share": (lambda u, c: np.log(special.expit(-u)), -800.0),
    "log of the rest": (lambda u, c: np.log(1 - special.expit(u)), -800.0),
    "log1p of the rest": (lambda u, c: np.log1p(-special.expit(u)), -800.0),
    "log of a tail": (lambda u, c: np.log(special.ndtr(-u)), special.log_ndtr(-800.0)),
    "log of the rest of it": (lambda u, c: np.log(1 - special.ndtr(u)), special.log_ndtr(-800.0)),
    "log1p of the rest of it": (lambda u, c: np.log1p(-special.ndtr(u)), special.log_ndtr(-800.0)),
    "exp of a log tail": (lambda u, c: np.exp(special.log_ndtr(u)), 1.0),
    "softplus": (lambda u, c: np.log1p(np.exp(u)), 800.0),
    "log of a sum": (lambda u, c: np.log(1 + np.exp(u)), 800.0),
    "xlogy": (lambda u, c: special.xlogy(c, np.exp(u)), 2000.0),
    "xlog1py": (lambda u, c: special.xlog1py(c, -special.expit(u)), -2000.0),
    "logit": (lambda u, c: special.logit(special.expit(u)), 800.0),
    "log of picks": (lambda u, c: np.log(np.stack([np.exp(u), np.exp(u)])).sum(), 1600.0),
    "root of a precision": (lambda u, c: np.log(c * np.sqrt(np.exp(u))), 400.0 + np.log(2.5)),
    "double negative": (lambda u, c: np.negative(np.negative(u)), 800.0),
    "exp of a log share": (lambda u, c: np.exp(special.log_expit(u)), 1.0),
}


def traced(function: Callable[..., Any]) -> Expression:
    return trace(function, [TracedArray(leaf("u", ())), TracedArray(leaf("c", ()))])


def values(root: Expression, u: Any) -> np.ndarray:
    (found,) = Program([root])({"u": np.asarray(u, float), "c": np.asarray(2.5)})
    return found


@pytest.mark.parametrize("name", RULES)
def test_rules(name: str) -> None:
    function, far = RULES[name]
    root = traced(function)
    (found,) = stable([root])
    near = np.linspace(-3.0, 3.0, 25)
    np.testing.assert_allclose(values(found, near), values(root, near), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(values(found, 800.0), far, rtol=1e-14)


def test_what_is_negative_stays_no_number() -> None:
    root = traced(lambda u, c: np.log((c - 3.0) * np.exp(u)))
    assert np.isnan(values(root, 1.0))
    assert np.isnan(values(*stable([root]), 1.0))


def test_a_wrong_rule_is_seen() -> None:
    """Negative control."""
    wrong = {**logarithms._RULES, np.sqrt: lambda x: x}
    with mock.patch.object(logarithms, "_RULES", wrong), pytest.raises(AssertionError):
        test_rules("log of a root")


SEEDS = range(session.seed(), session.seed() + session.scaled(150, 20))


def test_random_functions_keep_their_values() -> None:
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        root = trace(random_function(rng, 12), stand_ins())
        given = random_arguments(rng, dict.fromkeys(ARGUMENTS, ()))
        plain, written = Program([root, *stable([root])])(given)
        np.testing.assert_allclose(written, plain, rtol=1e-11, atol=1e-11, err_msg=str(seed))
