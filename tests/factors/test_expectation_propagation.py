"""Messages and the loop of expectation propagation, without time: trees, Gaussians, the clutter problem."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import logsumexp

from bayesmc.factors.expectation_propagation import Tilted, Visit, propagate
from bayesmc.factors.messages import ConditionalGaussian


def table(log: Any) -> ConditionalGaussian:
    log = np.asarray(log, dtype=float)
    return ConditionalGaussian(log, np.zeros((*log.shape, 0)), np.zeros((*log.shape, 0, 0)))


class Pair:
    """A table over two finite variables, shape (one, other, *lead)."""

    def __init__(self, scope: tuple[int, int], log: np.ndarray) -> None:
        self.scope, self.log = scope, log

    def tilted(self, cavities: Sequence[ConditionalGaussian], ends: Sequence[int]) -> Tilted:
        joint = self.log + cavities[0].log[:, None] + cavities[1].log[None]
        sums = [table(logsumexp(joint, axis=1 - end)) for end in ends]
        return Tilted(logsumexp(joint, axis=(0, 1)), sums)


def both(count: int) -> list[Visit]:
    return [Visit(f, (0, 1)) for f in range(count)]


def random_messages(
    rng: np.random.Generator, lead: tuple[int, ...] = ()
) -> tuple[ConditionalGaussian, tuple[Any, ...]]:
    log = rng.normal(size=(3, *lead))
    mean = rng.normal(size=(3, *lead, 2))
    factor = np.tril(rng.normal(size=(3, *lead, 2, 2)))
    return ConditionalGaussian.of(log, mean, factor), (log, mean, factor)


def test_messages_and_moments_are_the_same_thing() -> None:
    rng = np.random.default_rng(0)
    for lead in ((), (2,)):
        message, (log, mean, factor) = random_messages(rng, lead)
        found = message.moments
        np.testing.assert_allclose(found.log, log, atol=1e-12)
        np.testing.assert_allclose(found.mean, mean, atol=1e-9)
        square = factor @ factor.swapaxes(-1, -2)
        np.testing.assert_allclose(found.factor @ found.factor.swapaxes(-1, -2), square, rtol=1e-8)
        np.testing.assert_allclose(message.log_total, logsumexp(log, axis=0))
        np.testing.assert_allclose(message.normalised().log_total, 0.0, atol=1e-12)
        other, _ = random_messages(rng, lead)
        again = message.times(other).over(other, other)
        np.testing.assert_allclose(again.linear, message.linear, atol=1e-9)
        halfway = message.towards(other, 0.5).towards(other, 0.5)
        np.testing.assert_allclose(halfway.log, message.towards(other, 0.75).log)


def test_a_message_is_the_function_it_says() -> None:
    """At points, against the density."""
    rng = np.random.default_rng(1)
    message, (log, mean, factor) = random_messages(rng)
    x = rng.normal(size=2)
    for s in range(3):
        z = np.linalg.solve(factor[s], x - mean[s])
        wanted = log[s] - np.log(abs(np.linalg.det(factor[s]))) - 0.5 * z @ z
        found = message.log[s] + message.linear[s] @ x - 0.5 * x @ message.precision[s] @ x
        assert abs(found - wanted) < 1e-9


def test_distances_are_in_standard_deviations() -> None:
    def normal(mean: float, scale: float) -> ConditionalGaussian:
        return ConditionalGaussian.of(
            np.zeros(1), np.array([[mean]]), np.array([[[scale]]])
        ).scaled(np.float64(3.0))

    assert abs(normal(1.0, 2.0).distance(normal(4.0, 2.0)) - 1.5) < 1e-12
    one, two = np.array([0.2, 0.8]), np.array([0.5, 0.5])
    found = table(np.log(one)).distance(table(np.log(two) + 1.0))
    divergence = (one * np.log(one / two) + two * np.log(two / one)).sum()
    assert abs(found - np.sqrt(divergence)) < 1e-12
    assert table([0.0, -np.inf]).distance(table([0.0, 0.0])) == np.inf
    assert table([0.0, -np.inf]).distance(table([5.0, -np.inf])) == 0.0


def test_zeros_stay_zeros_and_nothing_over_nothing_is_left() -> None:
    rng = np.random.default_rng(2)
    message, _ = random_messages(rng)
    none = ConditionalGaussian(message.log.copy(), message.linear, message.precision)
    none.log[1] = -np.inf
    one = ConditionalGaussian.ones(3, (), 2)
    product = none.times(message)
    assert product.log[1] == -np.inf and not product.linear[1].any()
    assert np.isfinite(product.log_total) and product.moments.log[1] == -np.inf
    assert none.over(message, one).log[1] == -np.inf  # zero over something
    assert none.over(none, one).log[1] == 0.0  # zero over zero
    assert none.towards(message, 0.5).log[1] == -np.inf
    assert np.isnan(one.log_total)


# ---- the loop -----------------------------------------------------------------------------------


def random_tree(rng: np.random.Generator, lead: tuple[int, ...]) -> tuple[list[int], list[Pair]]:
    cards = rng.integers(2, 4, size=5).tolist()
    pairs = []
    for k in range(1, 5):
        j = int(rng.integers(k))
        log = rng.normal(size=(cards[j], cards[k], *lead))
        if rng.random() < 0.3:
            log[0, 0] = -np.inf
        pairs.append(Pair((j, k), log))
    return cards, pairs


def brute(cards: list[int], pairs: list[Pair], lead: tuple[int, ...]) -> tuple[Any, list[Any]]:
    log = np.zeros((*cards, *lead))
    for states in itertools.product(*map(range, cards)):
        log[states] = sum(p.log[states[p.scope[0]], states[p.scope[1]]] for p in pairs)
    axes = tuple(range(len(cards)))
    total = logsumexp(log, axis=axes)
    rest = [tuple(a for a in axes if a != k) for k in axes]
    return total, [np.exp(logsumexp(log, axis=r) - total) for r in rest]


@pytest.mark.parametrize("damping", [0.0, 0.4])
@pytest.mark.parametrize("lead", [(), (3,)])
def test_trees_of_tables_are_exact(lead: tuple[int, ...], damping: float) -> None:
    for seed in range(5):
        cards, pairs = random_tree(np.random.default_rng(seed), lead)
        ones = [table(np.zeros((n, *lead))) for n in cards]
        sites = [[ones[a], ones[b]] for a, b in (p.scope for p in pairs)]
        options: dict[str, Any] = {"sweeps": 200, "damping": damping, "tolerance": 1e-9}
        found = propagate(ones, pairs, sites, both(len(pairs)), **options)
        total, margins = brute(cards, pairs, lead)
        assert found.converged.all() and not found.skipped.any()
        assert found.sweeps > 20 if damping else found.sweeps <= 6
        np.testing.assert_allclose(found.log_total(pairs), total, atol=1e-7)
        for belief, margin in zip(found.beliefs, margins, strict=True):
            np.testing.assert_allclose(np.exp(belief.log), margin, atol=1e-7)


class Clutter:
    """A reading that is of the number, or of nothing (Minka 2001, sec. 3.3)."""

    scope = (0,)

    def __init__(self, x: float, share: float, wide: float) -> None:
        self.x, self.share, self.wide = x, share, wide

    def tilted(self, cavities: Sequence[ConditionalGaussian], ends: Sequence[int]) -> Tilted:
        cavity = cavities[0]
        log = cavity.log_total
        if np.isnan(log):
            return Tilted(np.full((), np.nan), cavities[:1])
        mean, var = cavity.moments.mean[0, 0], cavity.moments.factor[0, 0, 0] ** 2

        def density(v: float, m: float) -> float:
            return float(np.exp(-0.5 * (self.x - m) ** 2 / v) / np.sqrt(2 * np.pi * v))

        real, clutter = (
            (1 - self.share) * density(1 + var, mean),
            self.share * density(self.wide, 0.0),
        )
        r = real / (real + clutter)
        gain = var / (1 + var)
        found = mean + gain * r * (self.x - mean)
        spread = var - r * gain * var + r * (1 - r) * (gain * (self.x - mean)) ** 2
        belief = ConditionalGaussian.of(
            np.zeros(1), np.full((1, 1), found), np.full((1, 1, 1), np.sqrt(spread))
        )
        return Tilted(log + np.log(real + clutter), [belief])


def test_the_clutter_problem(reference_data: Path) -> None:
    """The fixed points that are kept: log evidence, mean, variance; assumed density after one sweep."""
    held = json.loads((reference_data / "ep" / "clutter.json").read_text())
    for case in held:
        prior = ConditionalGaussian.of(np.zeros(1), np.zeros((1, 1)), np.full((1, 1, 1), 10.0))
        factors = [Clutter(x, 0.5, 10.0) for x in case["x"]]
        one = ConditionalGaussian.ones(1, (), 1)
        visits = [Visit(f, (0,)) for f in range(len(factors))]
        sites = [[one] for _ in factors]
        for name, sweeps in (("adf", 1), ("ep", 500)):
            found = propagate(
                [prior], factors, sites, visits, sweeps=sweeps, damping=0.0, tolerance=1e-9
            )
            belief = found.beliefs[0].moments
            answer = [belief.mean[0, 0], belief.factor[0, 0, 0] ** 2]
            if name == "ep":
                assert found.converged
                answer = [found.log_total(factors), *answer]
            wanted = case[name][3 - len(answer) : 3]
            np.testing.assert_allclose(answer, wanted, atol=1e-6)


class Flat:
    """Divides more out than there is: without a finite integral until its cavity is slim enough."""

    scope = (0,)

    def tilted(self, cavities: Sequence[ConditionalGaussian], ends: Sequence[int]) -> Tilted:
        shape = cavities[0].log.shape
        wide = ConditionalGaussian(
            np.zeros(shape), np.zeros((*shape, 1)), np.full((*shape, 1, 1), -2.0)
        )
        found = cavities[0].times(wide)
        return Tilted(found.log_total, [found])


def test_improper_messages_are_left_out_and_counted() -> None:
    one = ConditionalGaussian.ones(1, (), 1)
    slim = ConditionalGaussian.of(np.zeros(1), np.zeros((1, 1)), np.full((1, 1, 1), 0.5))
    wide = ConditionalGaussian.of(np.zeros(1), np.zeros((1, 1)), np.full((1, 1, 1), 1.0))
    found = propagate([slim], [Flat()], [[one]], [Visit(0, (0,))], sweeps=10)  # 4 - 2
    assert found.converged and not found.skipped
    np.testing.assert_allclose(found.beliefs[0].precision, 2.0)
    found = propagate([wide], [Flat()], [[one]], [Visit(0, (0,))], sweeps=10)  # 1 - 2
    assert not found.converged and found.open == 1 and found.change == 0.0
    assert np.isnan(found.log_total([Flat()]))
    np.testing.assert_allclose(found.beliefs[0].precision, 1.0)


def test_problems_side_by_side_are_left_out_one_by_one() -> None:
    both = np.array([[0.5, 1.0]])
    prior = ConditionalGaussian.of(np.zeros((1, 2)), np.zeros((1, 2, 1)), both[..., None, None])
    one = ConditionalGaussian.ones(1, (2,), 1)
    found = propagate([prior], [Flat()], [[one]], [Visit(0, (0,))], sweeps=10)
    assert found.converged.tolist() == [True, False] and found.open.tolist() == [0, 1]
    np.testing.assert_allclose(found.beliefs[0].precision[0, :, 0, 0], [2.0, 1.0])
    total = found.log_total([Flat()])
    assert abs(total[0] - 0.5 * np.log(2.0)) < 1e-12 and np.isnan(total[1])  # sqrt(4 / 2)


class Swinging:
    """A factor whose moments never agree with themselves."""

    scope = (0,)
    count = 0

    def tilted(self, cavities: Sequence[ConditionalGaussian], ends: Sequence[int]) -> Tilted:
        self.count += bool(ends)
        return Tilted(np.zeros(()), [table([float(self.count % 2), 0.0])])


def test_what_does_not_settle_says_by_how_much() -> None:
    found = propagate(
        [table([0.0, 0.0])], [Swinging()], [[table([0.0, 0.0])]], [Visit(0, (0,))], sweeps=7
    )
    assert not found.converged and found.sweeps == 7 and not found.skipped
    apart = table([1.0, 0.0]).distance(table([0.0, 0.0]))
    assert abs(found.change - apart) < 1e-12 and apart > 0.1
