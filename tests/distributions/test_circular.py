"""VonMises and WrappedNormal: densities, distribution functions, circular moments and draws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats

import bayesmc.distributions as d
from bayesmc.distributions.circular import wrap_angle
from bayesmc.testing import session
from tests.distributions.families import assert_close, magnitudes

TURN = 2 * np.pi
ANGLE = st.floats(-20, 20)
CONCENTRATION = st.just(0.0) | magnitudes(1e-9, 1e12)
SCALE = magnitudes(1e-3, 50.0)

#: rate of false alarms of each goodness-of-fit test below, were its seed fresh
ALARM = 1e-6

FAMILIES = [
    *(d.VonMises(loc, k) for loc in (-3.0, 0.0, 2.0, 100.0) for k in (0.0, 0.7, 12.0, 31.0, 4e3)),
    *(d.WrappedNormal(loc, s) for loc in (-3.0, 0.0, 2.0, 100.0) for s in (0.02, 0.8, 1.3, 9.0)),
]


def brute_wrapped_normal(x: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Log density as the sum of 401 normals, in long doubles."""
    turns = np.arange(-200, 201).astype(np.longdouble) * (2 * np.longdouble(np.pi))
    z = (np.asarray(x, np.longdouble)[..., None] + turns) / np.asarray(scale)[..., None]
    logs = -0.5 * z * z
    peak = logs.max(axis=-1, keepdims=True)
    total = np.log(np.exp(logs - peak).sum(axis=-1)) + peak[..., 0]
    return np.asarray(total - np.log(np.sqrt(TURN) * np.asarray(scale, np.longdouble)), float)


@settings(max_examples=session.scaled(60, 10))
@given(st.lists(ANGLE, min_size=1, max_size=8), ANGLE, CONCENTRATION)
def test_von_mises_log_prob_equals_scipys(x: list[float], loc: float, k: float) -> None:
    # SciPy takes cos - 1 of the distance as it comes, which cancels a turn away: x is kept within
    at = loc + wrap_angle(np.array(x) - loc)
    assert_close(d.VonMises(loc, k).log_prob(at), stats.vonmises(k).logpdf(at - loc))


@settings(max_examples=session.scaled(60, 10))
@given(st.floats(-np.pi, np.pi), SCALE)
def test_wrapped_normal_log_prob_equals_the_wrapped_sum(x: float, scale: float) -> None:
    ours = d.WrappedNormal(0.0, scale).log_prob(x)
    np.testing.assert_allclose(ours, brute_wrapped_normal(x, scale), rtol=1e-12, atol=1e-13)


def test_wrapped_normal_is_right_around_the_change_of_formula() -> None:
    x = np.linspace(-np.pi, np.pi, 101)
    scale = np.array([0.5, 1.0, 1.2499999, 1.25, 1.2500001, 1.5, 2.5])[:, None]
    ours = d.WrappedNormal(0.0, scale).log_prob(x)  # a batch on both sides
    np.testing.assert_allclose(ours, brute_wrapped_normal(x, scale), rtol=1e-12, atol=1e-13)
    # negative control: a term less on either side is seen
    narrow = -0.5 * (x / 1.2) ** 2 - np.log(1.2 * np.sqrt(TURN))
    assert np.abs(narrow - brute_wrapped_normal(x, 1.2)).max() > 1e-3


def wrapped_normal_errors(x: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """How far log densities are off, relative to their size or to one."""
    expected = brute_wrapped_normal(x, scale)
    off = d.WrappedNormal(0.0, scale).log_prob(x) - expected
    return np.abs(off) / np.maximum(np.abs(expected), 1.0)


@settings(max_examples=session.scaled(60, 10))
@given(
    st.lists(st.floats(-np.pi, np.pi), min_size=1, max_size=6),
    st.lists(SCALE, min_size=1, max_size=3),
)
def test_wrapped_normal_keeps_its_digits(x: list[float], scales: list[float]) -> None:
    # one scale with all angles, several, and each angle with scales of both formulas
    far = np.pi - 6.5 * np.minimum(np.square(scales), 0.48)  # where the others begin to count
    angles = np.array([*x, *far, *-far, np.pi, -np.pi, 0.0])
    for scale in (np.array(scales[0]), np.array(scales)[:, None]):
        assert wrapped_normal_errors(angles, scale).max() < 1e-14
        for angle in angles[-4:]:  # numbers take no mask
            assert wrapped_normal_errors(angle, scale).max() < 1e-14


@pytest.mark.parametrize("scale", [0.2, 0.5, 0.9, 1.2, 3.5])
def test_wrapped_normal_keeps_its_digits_where_some_angles_have_company(scale: float) -> None:
    for share in (0.02, 0.6):  # the others are added to few elements, and to many
        x = np.linspace(-share * np.pi, share * np.pi, 500)
        x[::50] = np.linspace(0.9 * np.pi, np.pi, 10)
        assert wrapped_normal_errors(x, np.array(scale)).max() < 1e-14
        assert wrapped_normal_errors(x[:, None], scale * np.array([0.5, 1.0])).max() < 1e-14


def test_others_left_out_too_early_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    x = np.linspace(0.0, np.pi, 400)
    assert wrapped_normal_errors(x, np.array(0.4)).max() < 1e-14
    monkeypatch.setattr("bayesmc.distributions.circular._ALONE", 20.0)
    assert wrapped_normal_errors(x, np.array(0.4)).max() > 1e-12


@pytest.mark.parametrize("scale", [5e-324, 1e-160, 0.05, 1.2, 1.3, 9.0, 1e200])
def test_wrapped_normal_of_what_is_no_angle_and_of_far_ones(scale: float) -> None:
    dist = d.WrappedNormal(0.5, scale)
    found = dist.log_prob([np.nan, np.inf, -np.inf, 0.5, np.pi + 0.5, 0.5 + 2.0**70, 0.6])
    assert np.isnan(found[0])
    assert found[1:3].tolist() == [-np.inf, -np.inf]
    assert not np.isnan(found[3:]).any()
    assert (found[3:] <= found[3]).all()
    assert found[6] == dist.log_prob(0.6)  # whatever stands beside it
    assert dist.log_prob(np.full((0, 3), 0.1)).shape == (0, 3)


def test_wrapped_normal_broadcasts_and_changes_no_argument() -> None:
    x, loc = np.linspace(-40.0, 40.0, 7), np.array([[0.1], [3.0]])
    kept = x.copy()
    for scale in (0.3, np.array([[[0.3]], [[2.0]], [[0.9]]])):
        found = d.WrappedNormal(loc, scale).log_prob(x)
        assert found.shape == (*np.shape(scale)[:1], 2, 7)
        np.testing.assert_array_equal(x, kept)
        one_by_one = [d.WrappedNormal(lo, scale).log_prob(x) for lo in loc[:, 0]]
        for k, alone in enumerate(one_by_one):
            wide = np.broadcast_to(alone.reshape(*found.shape[:-2], 7), (*found.shape[:-2], 7))
            np.testing.assert_allclose(found[..., k, :], wide, rtol=1e-13)
    whole = np.array([1, 2, 3])  # integers are angles, too
    np.testing.assert_array_equal(
        d.WrappedNormal(0, 1).log_prob(whole), d.WrappedNormal(0.0, 1.0).log_prob(whole + 0.0)
    )


#: values computed with 50 digits from the definitions: x, expected
GOLDEN = [
    (d.VonMises(0.0, 0.0), 1.0, -1.8378770664093453),
    (d.VonMises(0.5, 4.0), 2.0, -3.9799010552539933),
    (d.VonMises(0.0, 1e10), 1e-5, 10.093986931757222),
    (d.VonMises(0.0, 1e18), 2e-9, 17.804327303741736),
    (d.WrappedNormal(0.0, 1e-3), 0.01, -44.01118325422254),
    (d.WrappedNormal(1.0, 1.0), 4.0, -5.074782801763217),
    (d.WrappedNormal(1.0, 3.0), 4.0, -1.8601181939643472),
]


@pytest.mark.parametrize(("dist", "x", "expected"), GOLDEN)
def test_golden_values(dist: d.Distribution, x: float, expected: float) -> None:
    np.testing.assert_allclose(dist.log_prob(x), expected, rtol=1e-13)


@pytest.mark.parametrize("dist", FAMILIES, ids=repr)
def test_densities_are_periodic_and_integrate_to_one(dist: d.Distribution) -> None:
    x = np.linspace(-np.pi, np.pi, 41)
    for turns in (-3, 1, 2):
        # x + turns is rounded, which moves a steep density
        np.testing.assert_allclose(
            dist.log_prob(x + turns * TURN), dist.log_prob(x), rtol=1e-9, atol=1e-9
        )
    grid = wrap_angle(dist.loc) + TURN * np.arange(20_000) / 20_000
    # the rectangle rule is exact to rounding for smooth periodic functions
    np.testing.assert_allclose(np.exp(dist.log_prob(grid)).mean() * TURN, 1.0, rtol=1e-12)


@pytest.mark.parametrize("dist", FAMILIES, ids=repr)
def test_cdf_is_the_integral_of_the_density(dist: d.Distribution) -> None:
    loc = float(wrap_angle(dist.loc))
    for x in (-3.1, -1.5, -0.01, 0.3, 1.99, 2.5, 3.14):
        cuts = [c for c in (loc - TURN, loc, loc + TURN) if -np.pi < c < x]
        ends = [-np.pi, *cuts, x]
        pieces = [
            integrate.quad(lambda t: np.exp(dist.log_prob(t)), a, b, points=_near(a, b, loc))[0]
            for a, b in zip(ends, ends[1:], strict=False)
        ]
        assert dist.cdf(x) == pytest.approx(sum(pieces), rel=1e-9, abs=1e-9)


def _near(low: float, high: float, loc: float) -> list[float] | None:
    """Where quadrature must not miss a narrow peak."""
    points = [loc + s + t for s in (0.0, -TURN, TURN) for t in (-0.3, -0.05, 0.05, 0.3)]
    return [p for p in points if low < p < high] or None


@settings(max_examples=session.scaled(60, 8))
@given(st.floats(-np.pi, np.pi), magnitudes(1e-3, 49.0))
def test_von_mises_cdf_equals_scipys_series(x: float, k: float) -> None:
    # centred, where both count from -pi; above 50 SciPy approximates by a normal to about 1e-5
    np.testing.assert_allclose(
        d.VonMises(0.0, k).cdf(x), stats.vonmises(k).cdf(x), rtol=1e-9, atol=1e-12
    )


def test_both_formulas_of_the_cdf_meet_where_they_change() -> None:
    x = np.linspace(-np.pi, np.pi, 201)
    below, above = np.nextafter(30.0, 0.0), 30.0
    mixed = d.VonMises(0.0, np.array([below, above, 1.0, 500.0])[:, None]).cdf(x)
    np.testing.assert_allclose(mixed[0], mixed[1], rtol=0, atol=1e-14)
    # negative control: the same tolerance tells concentrations apart that differ in the twelfth digit
    assert np.abs(d.VonMises(0.0, above + 3e-11).cdf(x) - mixed[1]).max() > 1e-14


@pytest.mark.parametrize("k", [1e4, 1e8, 1e14])
def test_concentrated_von_mises_is_normal(k: float) -> None:
    z = np.linspace(-8, 8, 33)
    # the angle is normal to a relative error of order z^4 / k
    np.testing.assert_allclose(
        d.VonMises(0.0, k).cdf(z / np.sqrt(k)), stats.norm.cdf(z), rtol=1e3 / k, atol=1e-15
    )


@pytest.mark.parametrize("dist", FAMILIES, ids=repr)
def test_cdf_and_ppf_are_inverse_and_start_at_minus_pi(dist: d.Distribution) -> None:
    assert dist.cdf([-9.0, -np.pi, np.pi, 9.0]).tolist() == [0.0, 0.0, 1.0, 1.0]
    q = np.linspace(0, 1, 101)
    x = dist.ppf(q)
    assert x[0] == -np.pi
    assert x[-1] == np.pi
    assert (np.diff(x) >= 0).all()
    np.testing.assert_allclose(dist.cdf(x), q, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dist", FAMILIES, ids=repr)
def test_mean_and_var_are_circular(dist: d.Distribution) -> None:
    grid = wrap_angle(dist.loc) + TURN * np.arange(20_000) / 20_000
    weights = np.exp(dist.log_prob(grid)) * TURN / len(grid)
    resultant = (weights * np.exp(1j * grid)).sum()
    assert dist.support.kind == "circle"
    assert -np.pi <= dist.mean < np.pi
    assert dist.mean == wrap_angle(dist.loc)
    if abs(resultant) > 1e-10:
        assert np.exp(1j * dist.mean) == pytest.approx(resultant / abs(resultant), abs=1e-6)
        assert dist.var == pytest.approx(-2 * np.log(abs(resultant)), rel=1e-8)
    else:
        assert dist.var > 40


def test_von_mises_var_keeps_its_digits_when_concentrated() -> None:
    # -2 log A(k) = 1/k + 1/(2 k^2) + ...
    for k in (1e6, 1e10, 1e16):
        assert d.VonMises(0.0, k).var == pytest.approx(1 / k + 0.5 / k**2, rel=1e-12)
    # with 50 digits, on both sides of the change of formula
    expected = [0.0020020437577272228, 0.0020019635972855832]
    np.testing.assert_allclose(d.VonMises(0.0, [499.99, 500.01]).var, expected, rtol=1e-11)


@pytest.mark.parametrize("dist", FAMILIES, ids=repr)
def test_draws_fit(dist: d.Distribution) -> None:
    draws = dist.sample(11, 20_000)
    assert draws.min() >= -np.pi
    assert draws.max() < np.pi
    assert stats.kstest(dist.cdf(draws), "uniform").pvalue > ALARM


@pytest.mark.parametrize(
    ("claimed", "drawn"),
    [
        (d.VonMises(2.0, 12.0), d.VonMises(2.0, 10.0)),
        (d.VonMises(2.0, 0.7), d.VonMises(2.3, 0.7)),
        (d.WrappedNormal(3.0, 0.8), d.WrappedNormal(3.0, 0.9)),
        (d.WrappedNormal(3.0, 1.3), d.VonMises(3.0, 0.3)),
    ],
    ids=repr,
)
def test_draws_of_another_distribution_are_seen(
    claimed: d.Distribution, drawn: d.Distribution
) -> None:
    # negative control of the test above, at its own number of draws and rate
    draws = drawn.sample(11, 20_000)
    assert stats.kstest(claimed.cdf(draws), "uniform").pvalue < ALARM


def test_batches_draw_and_weigh_element_by_element() -> None:
    loc, k = np.array([[-3.0], [0.5]]), np.array([0.0, 5.0, 50.0, 1e7])
    for dist in (d.VonMises(loc, k), d.WrappedNormal(loc, [1e-4, 0.5, 2.0, 1e6])):
        draws = dist.sample(0, (5, 3))
        assert dist.batch_shape == (2, 4)
        assert draws.shape == (5, 3, 2, 4)
        assert dist.mean.shape == dist.var.shape == (2, 4)
        assert np.isfinite(dist.log_prob(draws)).all()
        for i, j in np.ndindex(2, 4):
            parameters = [np.broadcast_to(p, (2, 4))[i, j] for p, _ in dist.parameters()]
            one = type(dist)(*parameters)
            at = draws[..., i, j]
            np.testing.assert_allclose(
                dist.log_prob(draws)[..., i, j], one.log_prob(at), rtol=1e-12
            )
            np.testing.assert_allclose(dist.cdf(draws)[..., i, j], one.cdf(at), atol=1e-14)
            np.testing.assert_allclose(dist.ppf(0.3)[i, j], one.ppf(0.3), atol=1e-12)


def test_a_draw_of_pi_is_turned_to_minus_pi() -> None:
    class Edge:
        """A source of random numbers that is at the end of its range, as chance may be."""

        def vonmises(self, mu: np.ndarray, kappa: np.ndarray, shape: tuple) -> np.ndarray:
            return np.full(shape, np.pi)

    assert d.VonMises(0.0, 1.0).sample_to(Edge(), (2,)).tolist() == [-np.pi, -np.pi]
    assert d.VonMises(0.0, 1.0).sample_to(Edge(), ()).tolist() == -np.pi


def test_infinite_values_are_no_angles() -> None:
    for dist in (d.VonMises(1.0, 2.0), d.WrappedNormal(1.0, 0.5)):
        assert dist.log_prob([np.inf, -np.inf]).tolist() == [-np.inf, -np.inf]
        assert dist.support.contains([7.0, -100.0, np.inf]).tolist() == [True, True, False]


def test_wrap_angle_keeps_digits_inside_and_lands_inside() -> None:
    x = np.array([1e-300, -1e-17, np.pi, -np.pi, np.nextafter(-np.pi, -4), 7.0, -1e9, 1e300])
    wrapped = wrap_angle(x)
    np.testing.assert_array_equal(wrapped[:4], [1e-300, -1e-17, -np.pi, -np.pi])
    assert (wrapped >= -np.pi).all()
    assert (wrapped < np.pi).all()
    np.testing.assert_allclose(np.sin(wrapped[5]), np.sin(7.0))
    assert np.isnan(wrap_angle(np.inf))
