"""Expectations of expressions by moments, against sums over all outcomes of leaves with few of them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.expression import Expression, TracedArray, evaluate, leaf, trace
from bayesmc.passes.expectation import Expectation
from bayesmc.passes.expected_density import expected_log_density
from bayesmc.passes.log_density import log_density
from bayesmc.passes.moments import Hidden, Meeting, NoMoment, moment
from bayesmc.testing import session

Outcomes = list[tuple[float, np.ndarray]]


class Leaf:
    """A leaf with a few outcomes for each group of its elements, and its moments."""

    def __init__(
        self, rng: np.random.Generator, name: str, kind: str, shape: tuple[int, ...], width: int = 1
    ) -> None:
        self.own = Hidden(name, kind, shape, width)
        self.expression = leaf(name, shape)
        groups = int(np.prod(shape, dtype=int)) // (width if kind == "number" else 1)
        inner = width if kind == "number" else 1
        self.groups: list[Outcomes] = []
        for _ in range(groups):
            weights = rng.dirichlet(np.ones(inner + 1))
            values = rng.normal(size=(inner + 1, inner))
            values = {
                "number": values,
                "positive": np.exp(values),
                "unit": 1 / (1 + np.exp(values)),
            }[kind]
            self.groups.append(list(zip(weights.tolist(), values, strict=True)))

    def joint(self) -> Iterator[tuple[float, np.ndarray]]:
        for chosen in itertools.product(*self.groups):
            weight = float(np.prod([w for w, _ in chosen]))
            yield weight, np.concatenate([v for _, v in chosen]).reshape(self.own.shape)

    def moments(self) -> dict[str, np.ndarray]:
        def mean(function: Any) -> np.ndarray:
            parts = [sum(w * function(v) for w, v in group) for group in self.groups]
            return np.array(parts)

        found = {moment(self.own.name, "mean"): mean(lambda v: v).reshape(self.own.shape)}
        if self.own.kind == "number":
            square = mean(lambda v: np.outer(v, v))
            first = mean(lambda v: v)
            found[moment(self.own.name, "cov")] = square - first[:, :, None] * first[:, None, :]
        features = {"x": lambda v: v, "inv": lambda v: 1 / v, "log": np.log}
        if self.own.kind == "unit":
            features["log1m"] = lambda v: np.log1p(-v)
        if self.own.kind != "number":
            for feature, function in features.items():
                found[moment(self.own.name, feature)] = mean(function).reshape(self.own.shape)
        return found


def by_enumeration(root: Expression, leaves: list[Leaf]) -> Any:
    total: Any = 0.0
    for outcome in itertools.product(*(list(own.joint()) for own in leaves)):
        weight = float(np.prod([w for w, _ in outcome]))
        values = {own.own.name: v for own, (_, v) in zip(leaves, outcome, strict=True)}
        total = total + weight * evaluate([root], values)[0]
    return total


def by_moments(root: Expression, leaves: list[Leaf]) -> Any:
    found = Expectation({own.own.name: own.own for own in leaves})(root)
    values: dict[str, np.ndarray] = {}
    for own in leaves:
        values |= own.moments()
    assert not found.leaves & {own.own.name for own in leaves}  # of moments alone
    return evaluate([found], values)[0]


@pytest.mark.parametrize("seed", range(session.scaled(6, 20)))
def test_random_sums_of_products(seed: int) -> None:
    rng = np.random.default_rng([session.seed(), seed])
    a, b = Leaf(rng, "a", "number", (3,)), Leaf(rng, "b", "number", ())
    p, q = Leaf(rng, "p", "positive", ()), Leaf(rng, "q", "positive", (3,))
    u = Leaf(rng, "u", "unit", ())
    leaves = [a, b, p, q, u]

    shift, gain, own = rng.normal(size=(2, 3)), rng.normal(size=4), rng.normal(size=4)
    mask, chosen = rng.random(3) < 0.5, rng.permutation(8)[:4]

    def function(a: Any, b: Any, p: Any, q: Any, u: Any) -> Any:
        first, second = shift[0] + gain[0] * a + gain[1] * b, shift[1] + gain[2] * b
        parts = [
            np.square(first / np.sqrt(p)),
            first * (a - 2.0) * p,
            second * first / q,
            np.log(3.0 * p / q**2),
            np.log1p(-u) * (b + 1.0) + np.log(u) * a,
            np.sum(a, axis=-1) * p + q**-1.0,
            np.where(mask, np.square(first), second),
            np.square(a * b - 1.0) * q,
        ]
        return sum((w * parts[k] for w, k in zip(own, chosen, strict=True)), shift[0])

    root = trace(function, [TracedArray(own.expression) for own in leaves])
    assert isinstance(root, Expression)
    some = [x for x in leaves if x.own.name in root.leaves]
    got, want = by_moments(root, some), by_enumeration(root, some)
    np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9)


def test_vectors_keep_their_covariance() -> None:
    rng = np.random.default_rng(1)
    w, z = Leaf(rng, "w", "number", (2,), 2), Leaf(rng, "z", "number", (2, 2), 2)
    matrix = rng.normal(size=(4, 2))
    root = trace(
        lambda w, z: (
            np.square(1.0 - np.vecdot(matrix, w)) + np.sum(np.square(np.vecdot(z, w)), axis=-1)
        ),
        [TracedArray(w.expression), TracedArray(z.expression)],
    )
    assert isinstance(root, Expression)
    np.testing.assert_allclose(by_moments(root, [w, z]), by_enumeration(root, [w, z]), rtol=1e-10)


@pytest.mark.parametrize(
    ("function", "names"),
    [
        (lambda a, p: np.exp(a), {"a"}),
        (lambda a, p: a * np.log(p) * p, {"p"}),
        (lambda a, p: np.square(np.square(a)), {"a"}),
        (lambda a, p: np.sqrt(p), {"p"}),
        (lambda a, p: np.where(a > 0, 1.0, p), {"a"}),
        (lambda a, p: np.log(a + p), {"a", "p"}),
    ],
)
def test_refusals_name_who_stands_in_the_way(function: Any, names: set[str]) -> None:
    hidden = {"a": Hidden("a", "number", ()), "p": Hidden("p", "positive", ())}
    root = trace(function, [TracedArray(leaf("a", ())), TracedArray(leaf("p", ()))])
    assert isinstance(root, Expression)
    with pytest.raises(NoMoment) as caught:
        Expectation(hidden)(root)
    assert caught.value.names == names


def test_independent_elements_that_meet_are_told() -> None:
    a = Hidden("a", "number", (3,))
    root = trace(lambda a: np.square(a[..., 1:] - a[..., :-1]), [TracedArray(leaf("a", (3,)))])
    assert isinstance(root, Expression)
    with pytest.raises(Meeting):
        Expectation({"a": a})(root)


# ---- families ---------------------------------------------------------------------------------------


def test_log_normal_and_mixed_families() -> None:
    rng = np.random.default_rng(2)
    m, p = Leaf(rng, "m", "number", ()), Leaf(rng, "p", "positive", ())
    for make, y in (
        (lambda m, p: bmc.Normal(m, p**-0.5), 1.3),
        (lambda m, p: bmc.LogNormal(m, np.sqrt(p)), 1.3),
        (lambda m, p: bmc.Gamma(2.0, p), 0.7),
        (lambda m, p: bmc.Poisson(2.0 * p), 3.0),
        (lambda m, p: bmc.InverseGamma(3.0, p), 0.4),
    ):
        family = trace(make, [TracedArray(m.expression), TracedArray(p.expression)])
        of = Expectation({"m": m.own, "p": p.own})
        found = expected_log_density(of, family, leaf("y", ()))
        got = evaluate([found], {**m.moments(), **p.moments(), "y": np.array(y)})[0]
        plain = log_density(family, leaf("y", ()))
        want = sum(
            w * v * evaluate([plain], {"m": a.reshape(()), "p": b.reshape(()), "y": np.array(y)})[0]
            for (w, a), (v, b) in itertools.product(m.joint(), p.joint())
        )
        np.testing.assert_allclose(got, want, rtol=1e-11)


def matrices(rng: np.random.Generator, count: int, d: int) -> list[np.ndarray]:
    roots = rng.normal(size=(count, d, d + 2))
    return [r @ r.T for r in roots]


@pytest.mark.parametrize("is_inverse", [False, True])
def test_normal_vectors_with_a_matrix_of_their_own(is_inverse: bool) -> None:
    """Mean and covariance together: of a mean that is normal given the precision by its second moments."""
    rng = np.random.default_rng(3)
    d, spread, centre = 2, 0.7, rng.normal(size=2)
    outcomes, weights = matrices(rng, 3, d), rng.dirichlet(np.ones(3))
    m = Hidden("m", "number", (d,), d, "s")
    s = Hidden("s", "matrix", (d, d))

    def make(m: Any, s: Any) -> Any:
        cov = s if is_inverse else np.linalg.inv(s)
        return bmc.MvNormal(2.0 * m + 1.0, 3.0 * cov)

    family = trace(make, [TracedArray(leaf("m", (d,))), TracedArray(leaf("s", (d, d)))])
    found = expected_log_density(Expectation({"m": m, "s": s}), family, leaf("y", (d,)))
    values = {
        moment("m", "mean"): centre,
        moment("m", "spread"): np.array(spread),
        moment("s", "x"): sum(w * x for w, x in zip(weights, outcomes, strict=True)),
        moment("s", "inv"): sum(
            w * np.linalg.inv(x) for w, x in zip(weights, outcomes, strict=True)
        ),
        moment("s", "log"): sum(
            w * np.linalg.slogdet(x)[1] for w, x in zip(weights, outcomes, strict=True)
        ),
        "y": np.array([0.3, -0.8]),
    }
    want = 0.0
    for weight, x in zip(weights, outcomes, strict=True):
        cov = x if is_inverse else np.linalg.inv(x)
        root = np.linalg.cholesky(spread * cov) * np.sqrt(d)
        for sign, column in itertools.product((-1.0, 1.0), root.T):  # two moments of the normal
            dist = bmc.MvNormal(2.0 * (centre + sign * column) + 1.0, 3.0 * cov)
            want += weight / (2 * d) * dist.log_prob(values["y"])
    np.testing.assert_allclose(evaluate([found], values)[0], want, rtol=1e-11)
