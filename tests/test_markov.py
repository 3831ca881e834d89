"""Finite Markov chains: against eigenvectors, exact fractions, closed forms and simulation."""

from __future__ import annotations

import math
import pickle
from bisect import bisect_right
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from scipy import stats

from bayesmc.errors import ParameterError, ShapeError, StateError, UnsupportedError
from bayesmc.markov import MarkovChain, arrays, total_variation

SEEDS = range(12)
WALK_ON_4 = 0.5 * (np.roll(np.eye(4), 1, axis=1) + np.roll(np.eye(4), -1, axis=1))
# a and b swap for ever, d absorbs, c leads to either
REDUCIBLE = MarkovChain(
    [[0, 1, 0, 0], [1, 0, 0, 0], [0.3, 0, 0.3, 0.4], [0, 0, 0, 1]], states=tuple("abcd")
)


def random_chain(seed: int, size: int = 0, zeros: float = 0.5) -> MarkovChain:
    """Irreducible by a cycle through all states, otherwise sparse and uneven."""
    rng = np.random.default_rng(seed)
    size = size or int(rng.integers(2, 9))
    weights = rng.gamma(0.3, size=(size, size)) * (rng.random((size, size)) > zeros)
    weights += 0.05 * np.roll(np.eye(size), 1, axis=1) + 0.01 * np.eye(size)
    return MarkovChain(weights / weights.sum(axis=1, keepdims=True))


def reversible_chain(seed: int, size: int = 6) -> MarkovChain:
    """A walk on a complete graph with random symmetric weights, lazy ones among them."""
    rng = np.random.default_rng(seed)
    weights = rng.gamma(0.2, size=(size, size)) + 1e-3
    weights = weights + weights.T
    return MarkovChain(weights / weights.sum(axis=1, keepdims=True))


def birth_and_death(up: list[Any], down: list[Any]) -> np.ndarray:
    size = len(up) + 1
    matrix = np.diag(np.array(up, dtype=float), 1) + np.diag(np.array(down, dtype=float), -1)
    return matrix + np.diag(np.ones(size) - matrix.sum(axis=1))


def eigenvector(matrix: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eig(matrix.T)
    vector = vectors[:, np.argmin(np.abs(values - 1))].real
    return vector / vector.sum()


@pytest.mark.parametrize("seed", SEEDS)
def test_stationary_law_of_random_chains(seed: int) -> None:
    chain = random_chain(seed)
    (law,) = chain.stationary
    assert chain.is_ergodic and law.min() > 0
    np.testing.assert_allclose(law, eigenvector(chain.transition), rtol=0, atol=1e-12)
    np.testing.assert_allclose(law @ chain.transition, law, rtol=0, atol=1e-15)
    start = np.eye(len(law))[0]
    np.testing.assert_allclose(chain.step(start, 2**40), law, rtol=0, atol=1e-10)
    for _ in range(5000):
        start = start @ chain.transition
    np.testing.assert_allclose(chain.step(np.eye(len(law)), 5000)[0], start, atol=1e-12)


def test_stationary_law_has_all_digits_where_eigenvectors_have_none() -> None:
    """Two halves coupled by 1e-13, and probabilities down to 1e-40, against exact fractions."""
    up, down = [0.25, 1e-13, 0.125, 1e-9, 1e-14, 1e-12], [0.5, 3e-13, 0.5, 0.5, 0.5, 0.25]
    exact = [Fraction(1)]
    for u, d in zip(up, down, strict=True):
        exact.append(exact[-1] * Fraction(u) / Fraction(d))
    expected = np.array([float(p / sum(exact)) for p in exact])
    (law,) = MarkovChain(birth_and_death(up, down)).stationary
    np.testing.assert_allclose(law, expected, rtol=1e-14)
    # the control: the same comparison fails for eigenvectors
    assert np.abs(eigenvector(birth_and_death(up, down)) / expected - 1).max() > 1e-6
    # and the order of the states does not matter
    order = [6, 2, 0, 5, 3, 1, 4]
    shuffled = MarkovChain(birth_and_death(up, down)[np.ix_(order, order)]).stationary[0]
    np.testing.assert_allclose(shuffled, expected[order], rtol=1e-14)


def test_rare_first_state_does_not_overflow() -> None:
    law = MarkovChain(birth_and_death([0.5] * 4, [1e-120] * 4)).stationary[0]
    np.testing.assert_allclose(law[-2:], [2e-120, 1.0], rtol=1e-12)
    assert np.isfinite(law).all()


def test_reducible_chain_has_two_stationary_laws() -> None:
    np.testing.assert_array_equal(REDUCIBLE.stationary, [[0.5, 0.5, 0, 0], [0, 0, 0, 1]])
    found = [(c.states, c.recurrent, c.period) for c in REDUCIBLE.classes]
    assert found == [(("a", "b"), True, 2), (("c",), False, 1), (("d",), True, 1)]
    assert not REDUCIBLE.is_irreducible and not REDUCIBLE.is_ergodic
    assert REDUCIBLE.period == 2 and not REDUCIBLE.is_aperiodic
    assert REDUCIBLE.spectral_gap == 0 and math.isinf(REDUCIBLE.relaxation_time)
    assert repr(REDUCIBLE) == "MarkovChain(4 states, 2 recurrent of 3 classes, period 2)"
    mixture = [0.15, 0.15, 0.0, 0.7]
    np.testing.assert_allclose(REDUCIBLE.step(mixture, 3), mixture, rtol=1e-15)
    assert REDUCIBLE.is_reversible()
    for ask in (REDUCIBLE.mixing_time, REDUCIBLE.mixing_time_bounds):
        with pytest.raises(UnsupportedError, match="2 recurrent classes"):
            ask()


@pytest.mark.parametrize("seed", SEEDS)
def test_classes_of_random_chains(seed: int) -> None:
    """Against the definitions, written down with the powers of the matrix of possible steps."""
    rng = np.random.default_rng(seed)
    matrix = rng.random((8, 8)) * (rng.random((8, 8)) < 0.15)
    matrix[:, rng.integers(8)] += 0.1  # no empty row
    chain = MarkovChain(matrix / matrix.sum(axis=1, keepdims=True))
    power, walks = np.eye(8, dtype=bool), []
    for _ in range(80):
        power = power @ (chain.transition > 0)
        walks.append(power)
    reach = np.any(walks, axis=0) | np.eye(8, dtype=bool)
    for found in chain.classes:
        i = found.positions[0]
        assert found.positions == tuple(np.flatnonzero(reach[i] & reach[:, i]))
        assert found.recurrent == all(reach[j, i] for j in np.flatnonzero(reach[i]))
        assert found.period == math.gcd(*(n for n, walk in enumerate(walks, 1) if walk[i, i]))
    assert sorted(k for c in chain.classes for k in c.positions) == list(range(8))


@pytest.mark.parametrize(
    ("lengths", "period"), [((4, 6), 2), ((3, 5), 1), ((6, 9), 3), ((5, 5), 5)]
)
def test_period_of_two_cycles_through_one_state(lengths: tuple[int, int], period: int) -> None:
    first, second = lengths
    matrix = np.zeros((first + second - 1,) * 2)
    path = [0, *range(1, first), 0, *range(first, first + second - 1), 0]
    for i, j in zip(path[:-1], path[1:], strict=True):
        matrix[i, j] = 1.0
    chain = MarkovChain(matrix / matrix.sum(axis=1, keepdims=True))
    assert chain.is_irreducible and chain.period == period
    assert chain.is_ergodic == chain.is_aperiodic == (period == 1)
    assert (chain.spectral_gap == 0) == (period > 1)
    assert math.isinf(chain.mixing_time(0.1)) == (period > 1)


@pytest.mark.parametrize(("a", "b"), [(0.3, 0.2), (0.9, 0.8), (1e-6, 3e-6), (0.5, 0.5), (1, 0.75)])
@pytest.mark.parametrize("eps", [0.6, 0.25, 0.01])
def test_two_states_in_closed_form(a: float, b: float, eps: float) -> None:
    """The other eigenvalue is 1 - a - b, and the distance max(law) |1 - a - b|**t."""
    chain = MarkovChain([[1 - a, a], [b, 1 - b]])
    law, other = np.array([b, a]) / (a + b), abs(1 - a - b)
    np.testing.assert_allclose(chain.stationary, [law], rtol=1e-9)  # 1 - a is rounded
    assert chain.spectral_gap == pytest.approx(1 - other, abs=1e-14)
    assert chain.is_reversible()
    expected = 1 if other == 0 else max(0, math.ceil(math.log(eps / law.max()) / math.log(other)))
    assert chain.mixing_time(eps) == (expected if law.max() > eps else 0)
    np.testing.assert_allclose(chain.hitting_times(1), [1 / a, 0], rtol=1e-9)


def test_tie_with_the_bound_counts_as_reached() -> None:
    assert MarkovChain([[0.75, 0.25], [0.25, 0.75]]).mixing_time(0.25) == 1
    for a in (0.1, 0.15, 0.2, 0.3, 0.4):  # most of them miss it by a rounding error
        for t in range(1, 9):
            assert MarkovChain([[1 - a, a], [a, 1 - a]]).mixing_time(0.5 * (1 - 2 * a) ** t) == t


def test_periodic_chain() -> None:
    chain = MarkovChain(WALK_ON_4)
    assert chain.is_irreducible and chain.period == 2 and not chain.is_ergodic
    np.testing.assert_array_equal(chain.stationary, np.full((1, 4), 0.25))
    assert chain.spectral_gap == 0 and math.isinf(chain.relaxation_time)
    assert chain.mixing_time_bounds() == (math.inf, math.inf)
    assert chain.mixing_time(0.25) == math.inf
    assert chain.mixing_time(0.5) == 1  # one of the two halves, evenly
    np.testing.assert_array_equal(chain.step([1, 0, 0, 0], 10**9 + 1), [0, 0.5, 0, 0.5])
    lazy = MarkovChain(0.5 * (np.eye(4) + WALK_ON_4))
    assert lazy.is_ergodic and lazy.spectral_gap == pytest.approx(0.5)
    assert math.isfinite(lazy.mixing_time())


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", [random_chain, reversible_chain])
@pytest.mark.parametrize("eps", [0.25, 0.003])
def test_mixing_time_is_the_first_step_that_is_near(seed: int, kind: Any, eps: float) -> None:
    chain = kind(seed)
    power, steps = np.eye(len(chain.states)), 0
    while total_variation(power, chain.stationary[0]).max() > eps:
        power, steps = power @ chain.transition, steps + 1
    assert chain.mixing_time(eps) == steps


def test_mixing_time_with_transient_states() -> None:
    """From the first state the rest is left with probability 0.9 a step: 0.9**t <= eps."""
    chain = MarkovChain([[0.9, 0.1], [0.0, 1.0]])
    assert chain.mixing_time(0.01) == math.ceil(math.log(0.01) / math.log(0.9))
    assert chain.spectral_gap == pytest.approx(0.1)
    with pytest.raises(UnsupportedError, match="reducible"):
        chain.mixing_time_bounds(0.01)


def test_long_mixing_times() -> None:
    """At 5e6 steps by powers; where no digits are left there is an error, not a number."""
    a = 1e-7
    expected = math.ceil(math.log(0.5) / math.log1p(-2 * a))
    assert MarkovChain([[1 - a, a], [a, 1 - a]]).mixing_time(0.25) == pytest.approx(expected, abs=2)
    a = 1e-16
    stuck = np.array([[1.0, a], [a, 1.0]])
    with pytest.raises(UnsupportedError, match="rounding errors"):
        MarkovChain(stuck).mixing_time()


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("eps", [0.4, 0.25, 1e-3])
def test_spectral_bounds_hold_the_mixing_time(seed: int, eps: float) -> None:
    for matrix in (reversible_chain(seed).transition, 0.99 * np.eye(6) + 0.01 / 6):
        chain = MarkovChain(matrix)
        lower, upper = chain.mixing_time_bounds(eps)
        assert lower <= chain.mixing_time(eps) <= upper
        # the book's simpler upper bound is no smaller
        simple = chain.relaxation_time * math.log(1 / (eps * chain.stationary.min()))
        assert upper <= math.ceil(simple)
    # and neither bound is empty: on the slow chain
    assert 0.25 * chain.mixing_time(eps) < lower and upper < 2 * chain.mixing_time(eps)


@pytest.mark.parametrize("seed", SEEDS)
def test_spectral_gap_against_eigenvalues(seed: int) -> None:
    for chain in (random_chain(seed), reversible_chain(seed)):
        moduli = np.sort(np.abs(np.linalg.eigvals(chain.transition)))
        assert chain.spectral_gap == pytest.approx(1 - moduli[-2], abs=1e-8)


def test_spectral_gap_of_walks_on_cycles() -> None:
    """A lazy walk on n states has the gap (1 - cos(2 pi / n)) / 2 (Levin et al., section 12.3.1)."""
    for n in (3, 10, 101):
        step = np.roll(np.eye(n), 1, axis=1)
        lazy = MarkovChain(0.5 * np.eye(n) + 0.25 * (step + step.T))
        assert lazy.spectral_gap == pytest.approx(0.5 * (1 - math.cos(2 * math.pi / n)), abs=1e-14)
    assert MarkovChain([[1.0]]).spectral_gap == 1.0
    assert MarkovChain([[1.0]]).mixing_time() == 0


@pytest.mark.parametrize("seed", SEEDS)
def test_detailed_balance(seed: int) -> None:
    chain = reversible_chain(seed)
    assert chain.is_reversible() and chain.detailed_balance().violation < 1e-14
    assert chain.is_reversible(chain.stationary[0])
    assert not chain.is_reversible(np.full(6, 1 / 6))
    # a small current round three states is found, and where; its law stays as it was
    current = np.zeros((6, 6))
    current[[0, 2, 4], [2, 4, 0]] += 1e-7
    current[[2, 4, 0], [0, 2, 4]] -= 1e-7
    turned = MarkovChain(chain.transition + current / chain.stationary[0][:, None] / 2)
    np.testing.assert_allclose(turned.stationary, chain.stationary, rtol=1e-9)
    balance = turned.detailed_balance()
    assert not balance and not turned.is_reversible()
    assert set(balance.states) < {0, 2, 4}
    assert abs(balance.flows[0] - balance.flows[1]) == pytest.approx(1e-7, rel=1e-6)
    i, j = balance.states
    scale = math.sqrt(chain.stationary[0][i] * chain.stationary[0][j])
    assert balance.violation == pytest.approx(1e-7 / scale, rel=1e-6)
    with pytest.raises(UnsupportedError, match="is not balanced"):
        turned.mixing_time_bounds()


def test_detailed_balance_judges_rare_states_too() -> None:
    """A one-way ring of probability 1e-15 beside a state that holds the rest."""
    ring = np.zeros((4, 4))
    ring[0, :2] = 1 - 1e-15, 1e-15
    ring[1, 2] = ring[2, 3] = 1.0
    ring[3, [0, 1]] = 0.5
    assert not MarkovChain(ring).is_reversible()
    assert np.ptp(MarkovChain(ring).detailed_balance().flows) < 1e-14


def test_detailed_balance_with_a_law_that_forbids_a_state_that_is_entered() -> None:
    balance = MarkovChain([[0.5, 0.5], [0.5, 0.5]]).detailed_balance([1.0, 0.0])
    assert not balance and balance.violation == math.inf


def test_step() -> None:
    chain = random_chain(3, 5)
    laws = np.random.default_rng(0).dirichlet(np.ones(5), size=(2, 3))
    for n in (0, 1, 2, 5, 6, 37):
        expected = laws @ np.linalg.matrix_power(chain.transition, n)
        np.testing.assert_allclose(chain.step(laws, n), expected, rtol=1e-13)
    assert chain.step(laws, 0) is not laws


def asymptotic_variance(chain: MarkovChain) -> np.ndarray:
    """Of sqrt(n) times each visit frequency, autocorrelation included, by the fundamental matrix.

    2 law_i Z_ii - law_i - law_i**2 with Z = (I - P + 1 law)^-1 (Kemeny and Snell 1960, thm 4.6.1).
    """
    law = chain.stationary[0]
    z = np.linalg.inv(np.eye(len(law)) - chain.transition + law)
    return 2 * law * np.diag(z) - law - law**2


def visit_scores(path: np.ndarray, chain: MarkovChain) -> np.ndarray:
    frequency = np.bincount(path, minlength=len(chain.states)) / len(path)
    error = np.sqrt(asymptotic_variance(chain) / len(path))
    return (frequency - chain.stationary[0]) / error


@pytest.mark.parametrize("seed", range(4))
def test_simulated_million_steps_visit_states_as_often_as_the_stationary_law(seed: int) -> None:
    """Normal scores of all states within a bound that true chains break once in 1e4 runs.

    (Bonferroni over states: 1e-4 each run at most, 4e-4 for all.) Two controls: another chain of
    nearly the same law is told apart, and so is every chain if autocorrelation is left out.
    """
    chain = random_chain(seed, 6)
    path = chain.simulate(0, 1_000_000, rng=seed)
    bound = stats.norm.isf(0.5e-4 / 6)
    assert np.abs(visit_scores(path[1:], chain)).max() < bound
    other = MarkovChain(0.98 * chain.transition + 0.02 / 6)
    assert np.abs(visit_scores(path[1:], other)).max() > bound

    # transitions: Pearson's statistic over all rows, at 1e-4
    counts = np.zeros((6, 6))
    np.add.at(counts, (path[:-1], path[1:]), 1)
    possible = chain.transition > 0
    assert not counts[~possible].any()
    expected = counts.sum(axis=1, keepdims=True) * chain.transition
    chi2 = ((counts - expected)[possible] ** 2 / expected[possible]).sum()
    assert chi2 < stats.chi2.isf(1e-4, possible.sum() - 6)
    off = counts.sum(axis=1, keepdims=True) * np.where(possible, other.transition, 1)
    chi2 = ((counts - off)[possible] ** 2 / off[possible]).sum()
    assert chi2 > stats.chi2.isf(1e-4, possible.sum() - 6)


def test_autocorrelation_must_be_taken_into_account() -> None:
    """Scores of 400 runs of a sticky chain have sd 1 within 5 of its errors; binomial ones 4."""
    chain = MarkovChain([[0.9375, 0.0625], [0.0625, 0.9375]])
    rng = np.random.default_rng(1)
    scores = np.array([
        visit_scores(chain.simulate(chain.stationary[0], 4000, rng)[1:], chain)[0]
        for _ in range(400)
    ])  # fmt: skip
    assert abs(scores.std() - 1) < 5 / np.sqrt(2 * 400)
    binomial = scores * np.sqrt(asymptotic_variance(chain)[0] / 0.25)
    assert binomial.std() > 3


def test_simulate_starts_and_repeats() -> None:
    chain = MarkovChain(random_chain(5, 4).transition, states=("a", "b", "c", "d"))
    path = chain.simulate("c", 50, rng=2)
    assert path.shape == (51,) and path[0] == 2
    np.testing.assert_array_equal(path, chain.simulate("c", 50, rng=2))
    np.testing.assert_array_equal(chain.simulate("b", 0, rng=2), [1])
    starts = [chain.simulate([0, 0.25, 0.75, 0], 0, rng=k)[0] for k in range(400)]
    counts = np.bincount(starts, minlength=4)
    assert counts[0] == counts[3] == 0
    assert stats.binomtest(int(counts[1]), 400, 0.25).pvalue > 1e-4  # false alarms: 1e-4
    assert stats.binomtest(int(counts[1]), 400, 0.5).pvalue < 1e-4


def test_rounding_never_leads_to_an_impossible_state() -> None:
    """A row may sum to a little less than 1; a uniform number above that stays on what is possible."""
    cumulative = arrays.cumulative(np.array([0.0, 0.5, 0.5 - 1e-10, 0.0]))
    assert [bisect_right(cumulative, u) for u in (0.0, 0.5, 1 - 1e-16)] == [1, 2, 2]


def test_gamblers_ruin_lasts_k_times_rest() -> None:
    """Levin et al., proposition 2.1; one end alone may never be met."""
    n = 12
    walk = birth_and_death([0.5] * n, [0.5] * n)
    walk[[0, n]] = np.eye(n + 1)[[0, n]]
    chain, k = MarkovChain(walk), np.arange(n + 1)
    for ends in ([0, n], {0, n}, np.array([0, n])):
        np.testing.assert_allclose(chain.hitting_times(ends), k * (n - k), rtol=1e-13)
    np.testing.assert_array_equal(chain.hitting_times(0), [0] + [math.inf] * n)
    # what follows after the target does not matter
    onward = MarkovChain([[0, 1, 0], [0, 0, 1], [0, 0, 1]])
    np.testing.assert_array_equal(onward.hitting_times(1), [1, 0, math.inf])


@pytest.mark.parametrize("seed", SEEDS)
def test_hitting_times_of_random_chains(seed: int) -> None:
    chain = random_chain(seed, 7)
    rest = np.arange(7) != 3
    inner = chain.transition[np.ix_(rest, rest)]
    expected = np.linalg.solve(np.eye(6) - inner, np.ones(6))
    found = chain.hitting_times(3)
    assert found[3] == 0
    np.testing.assert_allclose(found[rest], expected, rtol=1e-10)
    # Kac: the mean time of return is the inverse of the stationary probability
    assert 1 + chain.transition[3] @ found == pytest.approx(1 / chain.stationary[0, 3], rel=1e-12)


def test_hitting_times_have_all_digits() -> None:
    up, down = [1e-14, 1e-9], [0.5, 0.5]
    h01 = 1 / Fraction(1e-14)
    h12 = (1 + Fraction(0.5) * h01) / Fraction(1e-9)
    found = MarkovChain(birth_and_death(up, down)).hitting_times(2)
    np.testing.assert_allclose(found, [float(h01 + h12), float(h12), 0], rtol=1e-14)


def test_graph() -> None:
    graph = REDUCIBLE.graph()
    assert list(graph) == list("abcd")
    edges = {(i, j): w for i, j, w in graph.edges(data="weight")}
    assert edges == {
        ("a", "b"): 1.0, ("b", "a"): 1.0, ("c", "a"): 0.3, ("c", "c"): 0.3, ("c", "d"): 0.4,
        ("d", "d"): 1.0,
    }  # fmt: skip
    assert dict(graph.nodes(data="recurrent")) == {"a": True, "b": True, "c": False, "d": True}


def test_total_variation_is_the_largest_difference_of_an_event() -> None:
    p, q = np.random.default_rng(0).dirichlet(np.ones(5), size=2)
    events = np.array([[(k >> i) & 1 for i in range(5)] for k in range(32)])
    assert total_variation(p, q) == pytest.approx(np.max(events @ (p - q)))
    assert total_variation(np.eye(5), p).shape == (5,)


def test_a_chain_is_a_value() -> None:
    matrix = np.array([[0.5, 0.5], [0.25, 0.75]])
    chain = MarkovChain(matrix, states=["a", "b"])
    matrix[0] = 0
    assert chain.transition[0, 0] == 0.5 and chain.states == ("a", "b")
    for array in (chain.transition, chain.stationary):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
    with pytest.raises(AttributeError):
        chain.states = ("c", "d")  # type: ignore[misc]
    again = pickle.loads(pickle.dumps(chain))
    np.testing.assert_array_equal(again.stationary, chain.stationary)


@pytest.mark.parametrize(
    ("transition", "states", "error", "message"),
    [
        ([[0.5, 0.5]], None, ShapeError, r"shape \(1, 2\)"),
        ([0.5, 0.5], None, ShapeError, r"shape \(2,\)"),
        (np.ones((0, 0)), None, ShapeError, r"shape \(0, 0\)"),
        (np.full((2, 2, 2), 0.5), None, ShapeError, r"shape \(2, 2, 2\)"),
        ([[1, 0], [0.5, 0.6]], None, ParameterError, "row 1 sums to 1.1"),
        ([[1, 0], [0.5, 0.6]], "ab", ParameterError, r"row 1 sums to 1.1;.*state 'b'"),
        ([[1.5, -0.5], [0, 1]], None, ParameterError, "row 0 has -0.5 in column 1"),
        ([[1, 0], [np.nan, 1]], None, ParameterError, "row 1 has nan in column 0"),
        ([[1, 0], [np.inf, 0]], None, ParameterError, "row 1 sums to inf"),
        ([[1, 0], [0.5, 0.5 + 1e-8]], None, ParameterError, "row 1 sums to"),
        (np.eye(2), ("a",), ShapeError, "1 labels for 2 states"),
        (np.eye(2), ("a", "a"), StateError, "'a' occurs twice"),
        (np.eye(2), ([0], [1]), StateError, "cannot be hashed"),
    ],
)
def test_bad_chains(transition: Any, states: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        MarkovChain(transition, states)
    if isinstance(caught.value, ParameterError):
        assert f"row {caught.value.index[0]}" in str(caught.value)


def test_rounded_rows_are_taken() -> None:
    assert MarkovChain(np.full((3, 3), 1 / 3)).is_ergodic
    assert MarkovChain([[0.1] * 10] * 10).mixing_time() == 1


@pytest.mark.parametrize(
    ("ask", "error", "message"),
    [
        (lambda c: c.mixing_time(0), ParameterError, "eps=0"),
        (lambda c: c.mixing_time_bounds(1.0), ParameterError, "eps=1.0"),
        (lambda c: c.mixing_time(math.nan), ParameterError, "eps=nan"),
        (lambda c: c.mixing_time(1e-13), ParameterError, "below 1e-12.*mixing_time_bounds"),
        (lambda c: c.step([1.0]), ShapeError, "2 states"),
        (lambda c: c.step(1.0), ShapeError, "2 states"),
        (lambda c: c.step([0.5, 0.6]), ParameterError, "sum to 1"),
        (lambda c: c.step([1.5, -0.5]), ParameterError, "nonnegative"),
        (lambda c: c.step([math.nan, 1]), ParameterError, "nonnegative"),
        (lambda c: c.step([1, 0], -1), ParameterError, "n=-1"),
        (lambda c: c.step([1, 0], 1.5), ParameterError, "n=1.5"),
        (lambda c: c.is_reversible(np.full((1, 2), 0.5)), ShapeError, "detailed_balance"),
        (lambda c: c.simulate("c", 5), StateError, "'c' is not a state.*'a', 'b'"),
        (lambda c: c.simulate([0.5, 0.6], 5), ParameterError, "sum to 1"),
        (lambda c: c.simulate("a", -5), ParameterError, "steps=-5"),
        (lambda c: c.hitting_times("c"), StateError, "'c' is not a state"),
        (lambda c: c.hitting_times(["a", "c"]), StateError, "'c' is not a state"),
        (lambda c: c.hitting_times([]), StateError, "empty"),
    ],
)
def test_bad_questions(ask: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        ask(MarkovChain([[0.5, 0.5], [0.25, 0.75]], states=("a", "b")))


def test_probabilities_that_underflow_are_refused() -> None:
    tiny = 1e-200
    sticky = np.array([[1, tiny, 0], [0, 1, tiny], [tiny, 0, 1]])
    np.testing.assert_allclose(MarkovChain(sticky).stationary, [[1 / 3] * 3], rtol=1e-15)
    # the second state reaches the first with probability 1e-400, which is 0 as a float
    chain = MarkovChain([[0, 0, 1.0], [0, 1.0, tiny], [tiny, 1.0, 0]])
    assert chain.is_irreducible
    with pytest.raises(ParameterError, match="underflow"):
        assert chain.stationary.size
