"""Resampling: means and bounds of offspring, joint laws, zeros and rounding, batches, adaptive use.

The checks are functions of a scheme, and the last section shows that broken schemes fail them.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import scipy.stats
from hypothesis import example, given
from hypothesis import strategies as st

from bayesmc.diagnostics import weight_ess
from bayesmc.resampling import (
    SCHEMES,
    Adaptive,
    Resampled,
    ess,
    multinomial,
    residual,
    scheme_of,
    ssp,
    stratified,
    systematic,
)

EVERY = pytest.mark.parametrize("scheme", SCHEMES.values(), ids=SCHEMES)
LAST_BELOW_ONE = 1 - 2.0**-53
#: ties, a zero, shares that are whole numbers for 10 draws, one tiny
SKEWED = np.array([0.07, 0.3, 0.0, 0.13, 0.13, 0.3, 0.069, 0.001])


def offspring(picked: np.ndarray, n: int) -> np.ndarray:
    """Counts of shape (n, *batch) from indices of shape (draws, *batch)."""
    return (picked[None] == np.arange(n).reshape(n, *(1,) * picked.ndim)).sum(axis=1)


def many(scheme, weights: np.ndarray, draws: int, runs: int, seed: int) -> np.ndarray:
    """Offspring of independent runs, shape (n, runs)."""
    batch = np.broadcast_to(weights[:, None], (len(weights), runs))
    return offspring(scheme(batch, draws, np.random.default_rng(seed)), len(weights))


def one_by_one(scheme, weights: np.ndarray, draws: int, runs: int, seed: int) -> np.ndarray:
    """The same by calls without a batch."""
    rng = np.random.default_rng(seed)
    picked = np.stack([scheme(weights, draws, rng) for _ in range(runs)], axis=1)
    return offspring(picked, len(weights))


def worst_bias(counts: np.ndarray, expected: np.ndarray) -> float:
    """Largest deviation of a mean from its expectation, in standard errors."""
    runs = counts.shape[1]
    # of a number that hardly ever differs from its floor, the spread may not show: at least one run's worth
    spread = np.maximum(counts.std(axis=1), 1 / np.sqrt(runs))
    return float(np.max(np.abs(counts.mean(axis=1) - expected) / spread * np.sqrt(runs)))


class Given(np.random.Generator):
    """A generator whose uniforms are all the same, and whose last exponential is zero."""

    def __new__(cls, value: float):
        return super().__new__(cls, np.random.PCG64(0))

    def __init__(self, value: float) -> None:
        super().__init__(np.random.PCG64(0))
        self.value = value

    def random(self, size=None, dtype=float, out=None):
        if out is None:
            return self.value if size is None else np.full(size, self.value)
        out[...] = self.value
        return out

    def standard_exponential(self, size=None, dtype=float, method="zig", out=None):
        steps = np.ones(size)
        if len(steps) > 1:
            steps[-1] = 0.0
        return steps


# ---- every scheme, whatever the weights ---------------------------------------------------------

numbers = st.one_of(
    st.just(0.0),
    st.sampled_from([1.0, 0.5, 0.25, 1 / 3, 5e-324, 1e-300]),
    st.floats(0.0, 1.0),
    st.floats(-300, 0).map(lambda power: 10.0**power),
)
clouds = st.lists(numbers, min_size=1, max_size=30).filter(any).map(np.array)
generators = st.one_of(
    st.integers(0, 1000).map(np.random.default_rng),
    st.sampled_from([0.0, 0.5, LAST_BELOW_ONE]).map(Given),
)


def assert_sound(scheme, weights: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
    """Shape, type, order, bounds, no weight of zero; gives the offspring."""
    picked = scheme(weights, draws, rng)
    assert picked.shape == (draws,) and picked.dtype == np.intp
    assert (np.diff(picked) >= 0).all()
    assert not draws or 0 <= picked[0] <= picked[-1] < len(weights)
    counts = np.bincount(picked, minlength=len(weights))
    assert counts[weights == 0].sum() == 0
    return counts


@EVERY
@given(weights=clouds, draws=st.integers(0, 200), rng=generators)
@example(weights=np.array([1.0, 0.0]), draws=10**5, rng=Given(LAST_BELOW_ONE))
@example(weights=np.array([0.0, 1.0]), draws=10**5, rng=Given(0.0))
@example(weights=np.array([0.1] * 10 + [0.0]), draws=10, rng=Given(0.0))
def test_indices_are_sound(scheme, weights, draws, rng):
    counts = assert_sound(scheme, weights, draws, rng)
    # numbers of offspring are compared with the shares in exact arithmetic, give or take rounding
    total = sum(map(Fraction, weights.tolist()))
    shares = np.array([float(draws * Fraction(w) / total) for w in weights.tolist()])
    below, above = np.floor(shares - 1e-9), np.ceil(shares + 1e-9)
    if scheme in (systematic, ssp):
        assert (counts >= below).all() and (counts <= above).all()
    elif scheme is residual:
        assert (counts >= below).all()
    elif scheme is stratified:
        assert (counts >= below - 1).all() and (counts <= above + 1).all()


@EVERY
@given(
    weights=clouds, draws=st.integers(0, 60), seed=st.integers(0, 100), power=st.integers(-60, 60)
)
def test_scale_does_not_matter(scheme, weights, draws, seed, power):
    # a power of two changes no digit, where it makes no subnormal number
    weights = np.where(weights < 1e-250, 0.0, weights) + (weights == weights.max())
    one, other = (
        scheme(w, draws, np.random.default_rng(seed)) for w in (weights, weights * 2.0**power)
    )
    np.testing.assert_array_equal(one, other)


@EVERY
@pytest.mark.parametrize("scale", [5e-324, 1e-310, 1e-200, 1e200, 1e307])
def test_scales_beyond_the_square_root_of_the_largest_number(scheme, scale):
    weights = scale * np.array([4.0, 0.0, 2.0, 2.0])
    picked = scheme(weights, 4000, np.random.default_rng(1))
    # 6 standard deviations of a multinomial count: false alarm below 1e-8
    assert np.abs(np.bincount(picked, minlength=4) - [2000, 0, 1000, 1000]).max() < 190
    assert ess(weights) == pytest.approx(64 / 24)


@EVERY
def test_many_particles_at_once(scheme):
    weights = np.random.default_rng(0).standard_exponential(200_000) ** 3
    weights[-5:] = 0.0
    counts = assert_sound(scheme, weights, 100_000, np.random.default_rng(1))
    shares = 100_000 * weights / weights.sum()
    # multinomial: 6 standard deviations, for one number and for the half of the cloud
    half = shares[:100_000].sum()
    assert abs(counts[:100_000].sum() - half) < 6 * np.sqrt(half * (1 - half / 1e5))
    assert (np.abs(counts - shares) < 6 * np.sqrt(shares) + 6).all()


@EVERY
def test_the_same_seed_gives_the_same_indices(scheme):
    one, two, *others = (
        scheme(SKEWED, 50, np.random.default_rng(seed)) for seed in (3, 3, *range(4, 24))
    )
    np.testing.assert_array_equal(one, two)
    assert any((one != other).any() for other in others)


@EVERY
def test_weights_are_not_written_to(scheme):
    weights = SKEWED.copy()
    weights.setflags(write=False)
    scheme(weights, 5, np.random.default_rng(0))
    np.testing.assert_array_equal(weights, SKEWED)
    assert scheme([1, 0], 2, np.random.default_rng(0)).tolist() == [0, 0]


@EVERY
@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ([0.0, 0.0], "all weights are zero"),
        ([0.5, np.nan], "a weight is nan"),
        ([0.5, np.inf], "a weight is inf"),
        ([0.5, -1e-3, 1.0], r"weight at \[1\] is negative"),
        ([-np.inf, 1.0], r"weight at \[0\] is negative"),
        ([], "at least one"),
        (1.0, "at least one"),
        ([[1.0, 0.0], [1.0, 0.0]], r"all weights are zero in batch element \(1,\)"),
        ([[1.0, np.nan], [1.0, 0.0]], r"a weight is nan in batch element \(1,\)"),
    ],
)
def test_weights_that_are_none(scheme, weights, message):
    with pytest.raises(ValueError, match=message):
        scheme(np.array(weights), 3, np.random.default_rng(0))


@EVERY
@pytest.mark.parametrize("draws", [-1, 2.5, "3", None])
def test_draws_that_are_no_number(scheme, draws):
    with pytest.raises(ValueError, match="whole number"):
        scheme(SKEWED, draws, np.random.default_rng(0))


# ---- laws -----------------------------------------------------------------------------------------


@EVERY
@pytest.mark.parametrize("draws", [1, 3, 10, 37])
@pytest.mark.parametrize("runs", [many, one_by_one])
def test_offspring_are_unbiased(scheme, draws, runs):
    """8 means in each of 40 tests beyond 5 standard errors: false alarm below 1e-3 in all."""
    counts = runs(scheme, SKEWED, draws, 20_000 if runs is many else 1500, seed=draws)
    assert worst_bias(counts, draws * SKEWED / SKEWED.sum()) < 5


def p_value(counts: np.ndarray, law: dict[tuple[int, ...], float]) -> float:
    """Of a chi-squared test that offspring, shape (n, runs), follow a joint law."""
    seen, times = np.unique(counts, axis=1, return_counts=True)
    seen = {tuple(column): number for column, number in zip(seen.T.tolist(), times, strict=True)}
    if set(seen) - set(law):
        return 0.0
    expected = np.array(list(law.values())) * counts.shape[1]
    observed = np.array([seen.get(outcome, 0) for outcome in law])
    assert expected.min() > 5
    return float(scipy.stats.chi2.sf(((observed - expected) ** 2 / expected).sum(), len(law) - 1))


def pivotal_law(weights: list[Fraction], draws: int) -> dict[tuple[int, ...], float]:
    """Exact joint law of offspring under the Srinivasan sampling process, by the book: two residuals
    at a time, along every branch (Gerber, Chopin and Whiteley 2019).
    """
    shares = [draws * w / sum(weights) for w in weights]
    law: dict[tuple[int, ...], Fraction] = {}

    def fight(left: list[Fraction], i: int, j: int, chance: Fraction) -> None:
        if not chance:
            return
        if j == len(left):
            outcome = tuple(int(s // 1 + r) for s, r in zip(shares, left, strict=True))
            law[outcome] = law.get(outcome, Fraction(0)) + chance
            return
        up, down = min(left[j], 1 - left[i]), min(left[i], 1 - left[j])
        first = up / (up + down) if up + down else Fraction(0)
        # the mean of left[i] stays: up and down have each the other's probability
        for change, odds in ((up, 1 - first), (-down, first)):
            after = left.copy()
            after[i] += change
            after[j] -= change
            still = i if 0 < after[i] < 1 else j
            fight(after, still, j + 1, chance * odds)

    fight([s % 1 for s in shares], 0, 1, Fraction(1))
    assert sum(law.values()) == 1
    return {outcome: float(chance) for outcome, chance in law.items()}


TENTHS = [
    ([3, 8, 5, 6, 3, 5], 3),
    ([5, 5, 5, 5, 5, 5], 3),
    ([9, 9, 9, 9, 9, 5], 5),
    ([2, 2, 2, 2, 1, 1], 1),
    ([13, 4, 0, 26, 10, 7], 6),
    ([4, 6, 7, 3, 0, 10, 5, 5], 4),
]


@pytest.mark.parametrize(("tenths", "draws"), TENTHS)
@pytest.mark.parametrize("runs", [many, one_by_one])
def test_ssp_has_the_law_of_the_process(tenths, draws, runs):
    """False alarm 1e-5 in each of 12 tests."""
    law = pivotal_law([Fraction(t, 10) for t in tenths], draws)
    counts = runs(ssp, np.array(tenths) / 10, draws, 20_000 if runs is many else 4000, seed=5)
    assert p_value(counts, law) > 1e-5


def test_a_batch_may_have_different_numbers_left_over():
    """All clouds of six in one call, so that strata end at different places. False alarm 1e-4."""
    clouds = [np.array(t) / 10 for t, draws in TENTHS[:5]]
    runs, draws = 20_000, 3
    batch = np.repeat(np.stack(clouds, axis=1)[:, :, None], runs, axis=2)
    counts = offspring(ssp(batch, draws, np.random.default_rng(0)), 6)
    kept = offspring(residual(batch, draws, np.random.default_rng(0)), 6)
    for lane, (tenths, _) in enumerate(TENTHS[:5]):
        law = pivotal_law([Fraction(t, 10) for t in tenths], draws)
        assert p_value(counts[:, lane], law) > 1e-5
        assert p_value(kept[:, lane], residual_law(tenths, draws)) > 1e-5


def residual_law(tenths: list[int], draws: int) -> dict[tuple[int, ...], float]:
    shares = [Fraction(draws * t, sum(tenths)) for t in tenths]
    floors = np.array([int(s // 1) for s in shares])
    left = draws - floors.sum()
    if not left:
        return {tuple(floors.tolist()): 1.0}
    probs = np.array([float(s % 1) for s in shares]) / float(left)
    grid = np.stack(np.meshgrid(*[np.arange(left + 1)] * len(shares), indexing="ij"), -1)
    extra = grid.reshape(-1, len(shares))
    extra = extra[extra.sum(axis=1) == left]
    chances = scipy.stats.multinomial.pmf(extra, left, probs)
    return {
        tuple((floors + row).tolist()): chance
        for row, chance in zip(extra, chances, strict=True)
        if chance > 0
    }


@pytest.mark.parametrize("runs", [many, one_by_one])
def test_multinomial_and_residual_have_their_laws(runs):
    """Every joint outcome; false alarm 1e-5 in each of 4 comparisons."""
    size = 100_000 if runs is many else 6000
    weights = np.array([0.45, 0.0, 0.25, 0.3])
    outcomes = np.array([(a, 0, b, 3 - a - b) for a in range(4) for b in range(4 - a)])
    chances = scipy.stats.multinomial.pmf(outcomes, 3, weights)
    law = {tuple(row.tolist()): p for row, p in zip(outcomes, chances, strict=True)}
    assert p_value(runs(multinomial, weights, 3, size, seed=1), law) > 1e-5
    assert p_value(runs(residual, weights, 3, size, seed=2), residual_law([9, 0, 5, 6], 3)) > 1e-5


def test_stratified_and_systematic_have_the_points_they_say():
    """Given the same uniforms, offspring are those of the definition: points (k + p) / draws in cells."""
    weights = np.random.default_rng(0).dirichlet(np.full(7, 0.5))
    draws = 40
    for scheme, size in ((stratified, draws), (systematic, None)):
        picked = scheme(weights, draws, np.random.default_rng(8))
        points = (np.arange(draws) + np.random.default_rng(8).random(size)) / draws
        np.testing.assert_array_equal(picked, np.searchsorted(np.cumsum(weights), points))


def test_variances_of_offspring_are_in_their_order():
    """Sums of variances over 20,000 runs, known up to 1.2 % (sd); bounds are 5 sd wide."""
    weights = np.random.default_rng(0).dirichlet(np.ones(30))
    variance = {
        name: float(many(scheme, weights, 40, 20_000, seed=1).var(axis=1).sum())
        for name, scheme in SCHEMES.items()
    }
    shares = 40 * weights
    rest = shares % 1
    # no unbiased numbers of offspring vary less than those next to their expectation
    assert variance["systematic"] == pytest.approx((rest * (1 - rest)).sum(), rel=0.06)
    assert variance["ssp"] == pytest.approx((rest * (1 - rest)).sum(), rel=0.06)
    assert variance["residual"] == pytest.approx((rest * (1 - rest / rest.sum())).sum(), rel=0.06)
    assert variance["multinomial"] == pytest.approx((shares * (1 - weights)).sum(), rel=0.06)
    assert 1.2 * variance["systematic"] < variance["stratified"] < 0.8 * variance["multinomial"]
    assert 1.2 * variance["systematic"] < variance["residual"] < 0.8 * variance["multinomial"]


def test_variances_of_a_mean_are_in_their_order():
    """Means of sorted particles after resampling, 20,000 runs: a variance is known up to 1 % (sd)."""
    rng = np.random.default_rng(0)
    values = np.sort(rng.normal(size=50))
    weights = np.exp(-0.5 * (values - 1) ** 2)
    variance = {
        name: float(np.var(values @ many(scheme, weights, 50, 20_000, seed=1) / 50))
        for name, scheme in SCHEMES.items()
    }
    exact = np.average((values - np.average(values, weights=weights)) ** 2, weights=weights) / 50
    assert variance["multinomial"] == pytest.approx(exact, rel=0.05)
    assert variance["residual"] < 0.9 * variance["multinomial"]
    assert variance["ssp"] < 0.9 * variance["residual"]
    assert variance["stratified"] < 0.9 * variance["residual"]
    # one uniform for all strata: they err together, here more than strata that err apart
    assert variance["stratified"] < 0.9 * variance["systematic"] < 0.9 * variance["residual"]


# ---- batches ----------------------------------------------------------------------------------------


class Lane(np.random.Generator):
    """Sees of every array of random numbers the part that one element of a batch of ``lanes`` sees."""

    def __new__(cls, *args):
        return super().__new__(cls, np.random.PCG64(0))

    def __init__(self, seed: int, lanes: int, lane: int) -> None:
        super().__init__(np.random.PCG64(seed))
        self.lanes, self.lane = lanes, lane

    def _part(self, draw, size, out):
        shape = out.shape if out is not None else () if size is None else np.atleast_1d(size)
        part = draw((*shape, self.lanes))[..., self.lane]
        if out is None:
            return part
        out[...] = part
        return out

    def random(self, size=None, dtype=float, out=None):
        return self._part(super().random, size, out)

    def standard_exponential(self, size=None, dtype=float, method="zig", out=None):
        return self._part(super().standard_exponential, size, out)


@EVERY
@pytest.mark.parametrize("draws", [0, 1, 12, 30])
def test_a_batch_is_one_resampling_per_element(scheme, draws):
    # the same weights in other orders, so that every element has as many draws left over
    rng = np.random.default_rng(2)
    weights = rng.permuted(np.repeat(rng.dirichlet(np.ones(12))[:, None], 6, axis=1), axis=0)
    weights[:, 0] = np.sort(weights[:, 0])
    together = scheme(weights, draws, np.random.Generator(np.random.PCG64(9)))
    assert together.shape == (draws, 6) and together.dtype == np.intp
    for lane in range(6):
        alone = scheme(weights[:, lane], draws, Lane(9, 6, lane))
        np.testing.assert_array_equal(together[:, lane], alone)
    again = scheme(weights.reshape(12, 2, 3), draws, np.random.Generator(np.random.PCG64(9)))
    np.testing.assert_array_equal(again.reshape(draws, 6), together)


@EVERY
@given(
    st.integers(1, 12).flatmap(
        lambda n: st.lists(
            st.lists(numbers, min_size=n, max_size=n).filter(any), min_size=0, max_size=5
        ).map(lambda lanes: np.array(lanes).reshape(-1, n).T)
    ),
    st.integers(0, 40),
    generators,
)
def test_every_element_of_a_batch_is_sound(scheme, weights, draws, rng):
    picked = scheme(weights, draws, rng)
    assert picked.shape == (draws, weights.shape[1]) and picked.dtype == np.intp
    assert (np.diff(picked, axis=0) >= 0).all()
    assert (picked >= 0).all() and (picked < len(weights)).all()
    assert (np.take_along_axis(weights, picked, axis=0) > 0).all()


# ---- effective size, adaptive, names ------------------------------------------------------------------


@given(st.lists(st.floats(-500, 0), min_size=1, max_size=20))
def test_ess_is_that_of_log_weights(log_weights):
    log_weights = np.array(log_weights)
    assert ess(np.exp(log_weights)) == pytest.approx(weight_ess(log_weights), rel=1e-9)
    assert type(ess(np.exp(log_weights))) is float


def test_ess_of_a_batch():
    weights = np.random.default_rng(0).random((9, 2, 3))
    sizes = ess(weights)
    assert sizes.shape == (2, 3)
    assert sizes[1, 2] == pytest.approx(ess(weights[:, 1, 2]))
    with pytest.raises(ValueError, match="zero"):
        ess(np.zeros(3))


@EVERY
def test_adaptive_wraps_any_scheme(scheme):
    uneven = np.array([0.9, 0.1, 0.0, 0.0])  # ess 1.22
    done = Adaptive(scheme, 0.5)(uneven, 4, np.random.default_rng(0))
    assert isinstance(done, Resampled) and done.which is True
    np.testing.assert_array_equal(done.indices, scheme(uneven, 4, np.random.default_rng(0)))
    rng = np.random.default_rng(0)
    assert Adaptive(scheme, 0.3)(uneven, 4, rng) == (None, False)
    assert rng.random() == np.random.default_rng(0).random()  # nothing was drawn


@pytest.mark.parametrize(
    ("threshold", "even", "nearly", "one"),
    [(0.0, False, False, False), (0.5, False, False, True), (1.0, False, True, True),
     (1.5, True, True, True), (np.inf, True, True, True)],
)  # fmt: skip
def test_thresholds(threshold, even, nearly, one):
    adaptive, rng = Adaptive(threshold=threshold), np.random.default_rng(0)
    clouds = np.array([[1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 1.0, 0.9], [1.0, 0.0, 0.0, 0.0]])
    decided = [adaptive(cloud, 4, rng).which for cloud in clouds]
    assert decided == [even, nearly, one]
    indices, which = adaptive(clouds.T, 4, rng)
    assert which.tolist() == decided
    assert (indices is None) == (not any(decided))


def test_adaptive_batch_leaves_the_others_alone():
    rng = np.random.default_rng(0)
    weights = np.stack([np.ones(5), np.eye(5)[3], np.ones(5), np.eye(5)[1]], axis=1)
    indices, which = Adaptive("ssp")(weights.reshape(5, 2, 2), 5, rng)
    assert which.tolist() == [[False, True], [False, True]]
    assert indices[:, 0, 0].tolist() == indices[:, 1, 0].tolist() == [0, 1, 2, 3, 4]
    assert (indices[:, 0, 1] == 3).all() and (indices[:, 1, 1] == 1).all()


def test_adaptive_takes_the_size_that_is_known():
    weights = np.array([1.0, 0.0])
    assert Adaptive()(weights, 2, np.random.default_rng(0), weight_ess=2.0).which is False
    batch = np.eye(2)
    known = Adaptive()(batch, 2, np.random.default_rng(0), weight_ess=np.array([2.0, 0.5]))
    assert known.which.tolist() == [False, True]


def test_adaptive_refuses():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="draws=3 of 2 particles"):
        Adaptive()(np.ones(2), 3, rng)
    assert len(Adaptive(threshold=2.0)(np.ones(2), 3, rng).indices) == 3
    for threshold in (-0.1, np.nan):
        with pytest.raises(ValueError, match="threshold"):
            Adaptive(threshold=threshold)
    with pytest.raises(ValueError, match="did you mean 'residual'"):
        Adaptive("residuals")
    with pytest.raises(ValueError, match="the scheme inside"):
        Adaptive(Adaptive())
    with pytest.raises(ValueError, match="zero"):
        Adaptive(threshold=0)(np.zeros(2), 2, rng)


def test_schemes_by_name():
    assert list(SCHEMES) == ["multinomial", "stratified", "systematic", "residual", "ssp"]
    assert all(scheme_of(name) is scheme for name, scheme in SCHEMES.items())
    assert scheme_of(ssp) is ssp
    assert scheme_of(Adaptive("ssp")) == Adaptive("ssp")
    with pytest.raises(ValueError, match="there are 'multinomial', 'stratified'"):
        scheme_of("bootstrap")
    with pytest.raises(ValueError, match="no scheme"):
        scheme_of(3)


# ---- what the checks above would find -------------------------------------------------------------------


def one_by_one_only(scheme):
    """A scheme for a batch out of one that knows none."""
    return lambda weights, draws, rng: np.stack([scheme(w, draws, rng) for w in weights.T], axis=1)


def off_by_one(weights, draws, rng):
    cumulative = np.cumsum(weights)
    points = (np.arange(draws) + rng.random()) / draws * cumulative[-1]
    return np.minimum(np.searchsorted(cumulative, points) + 1, len(weights) - 1)


def biased_residual(weights, draws, rng):
    """The rest in proportion to the weights, not to what the floors left."""
    counts = np.floor(draws * weights / weights.sum()).astype(int)
    extra = rng.choice(len(weights), draws - counts.sum(), p=weights / weights.sum())
    return np.sort(np.concatenate([np.repeat(np.arange(len(weights)), counts), extra]))


def last_takes_the_rest(weights, draws, rng):
    counts = np.floor(draws * weights / weights.sum()).astype(int)
    counts[-1] += draws - counts.sum()
    return np.repeat(np.arange(len(weights)), counts)


@pytest.mark.parametrize("broken", [off_by_one, biased_residual, last_takes_the_rest])
def test_biased_schemes_are_found(broken):
    counts = many(one_by_one_only(broken), SKEWED, 10, 5000, seed=1)
    assert worst_bias(counts, 10 * SKEWED) > 5


def test_weights_of_zero_are_found():
    # the last edge is set, whether or not the last index has any weight
    def careless(weights, draws, rng):
        edges = np.ceil(draws * np.cumsum(weights) / np.sum(weights) - rng.random())
        edges[-1] = draws
        counts = np.diff(np.clip(edges, 0, draws).astype(np.intp), prepend=0)
        return np.repeat(np.arange(len(weights)), counts)

    with pytest.raises(AssertionError):
        assert_sound(careless, np.array([1.0, 0.0]), 10**5, Given(LAST_BELOW_ONE))


@pytest.mark.parametrize("other", [systematic, residual, stratified])
def test_other_laws_than_that_of_ssp_are_found(other):
    law = pivotal_law([Fraction(t, 10) for t in TENTHS[0][0]], 3)
    counts = many(other, np.array(TENTHS[0][0]) / 10, 3, 20_000, seed=5)
    assert p_value(counts, law) < 1e-10
