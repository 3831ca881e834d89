"""The beam model: normalised, drawn from as it says, and learned back from its own draws."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import ConvergenceWarning, ParameterError, ShapeError
from bayesmc.robotics.beam_fit import fit_beams
from bayesmc.robotics.beams import BeamModel, Beams, clean_ranges
from bayesmc.testing import session

END = 8.0
MODEL = BeamModel(0.5, 0.2, 0.1, 0.2, sigma_hit=0.3, lambda_short=0.7, max_range=END)
NAN = float("nan")


def mass(model: BeamModel, expected: float, low: float = 0.0, high: float = END) -> float:
    """Of readings below ``max_range``, by quadrature; the corners of the density are told to it."""
    dist = Beams([expected], model)
    width = model.sigma_hit
    corners = [expected + k * width for k in (-8, -4, -2, -1, 0, 1, 2, 4, 8)]
    edges = sorted({low, high, *(c for c in corners if low < c < high)})

    def density(z: float) -> float:
        return float(np.exp(dist.log_prob([z])))

    parts = zip(edges, edges[1:], strict=False)
    return sum(integrate.quad(density, a, b, epsabs=1e-11, limit=200)[0] for a, b in parts)


def mass_at_end(model: BeamModel, expected: float) -> float:
    return float(np.exp(Beams([expected], model).log_prob([END])))


@pytest.mark.parametrize("expected", [0.0, 1e-3, 0.1, 3.0, 7.9, END - 1e-9, END, 50.0, np.inf])
@pytest.mark.parametrize(
    "model",
    [MODEL, replace(MODEL, sigma_hit=5.0), replace(MODEL, sigma_hit=0.02, lambda_short=4.0)],
)
def test_normalised(model: BeamModel, expected: float):
    assert mass(model, expected) + mass_at_end(model, expected) == pytest.approx(1.0, abs=1e-7)


def test_what_is_cut_off_matters():
    """Without its truncation, the hit near a wall would lack half its mass: quadrature would see it."""
    hit = BeamModel(1.0, 0.0, 0.0, 0.0, sigma_hit=0.3, max_range=END)
    assert mass(hit, 0.1) == pytest.approx(1.0, abs=1e-7)
    whole = integrate.quad(lambda z: stats.norm.pdf(z, 0.1, 0.3), 0.0, END, points=[0.1])[0]
    assert abs(whole - 1.0) > 0.3


@pytest.mark.parametrize(
    ("cause", "expected", "reading", "density"),
    [
        ("z_hit", 3.0, 3.3, stats.norm.pdf(1.0) / 0.3),
        ("z_short", 3.0, 1.0, 0.7 * np.exp(-0.7) / (1 - np.exp(-2.1))),
        ("z_short", 3.0, 3.1, 0.0),
        ("z_rand", 3.0, 1.0, 1 / END),
        ("z_max", 3.0, END, 1.0),
        ("z_max", 3.0, 7.99, 0.0),
        ("z_hit", END, END, 1.0),
        ("z_hit", END, 7.99, 0.0),
        ("z_short", 0.0, 0.1, stats.norm.pdf(0.1 / 0.3) / 0.3 * 2),
    ],
)
def test_each_cause(cause: str, expected: float, reading: float, density: float):
    shares = {name: float(name == cause) for name in ("z_hit", "z_short", "z_max", "z_rand")}
    dist = Beams([expected], replace(MODEL, **shares))
    assert np.exp(dist.log_prob([reading])) == pytest.approx(density, rel=1e-9)


def p_value(draws: np.ndarray, model: BeamModel, expected: float) -> float:
    """Chi-square test of draws against masses by quadrature in 16 bins and at the end."""
    edges = np.linspace(0.0, END, 17)
    masses = [mass(model, expected, a, b) for a, b in zip(edges, edges[1:], strict=False)]
    masses.append(mass_at_end(model, expected))
    counts = [*np.histogram(draws[draws < END], edges)[0], (draws == END).sum()]
    return float(stats.chisquare(counts, len(draws) * np.array(masses) / sum(masses)).pvalue)


@pytest.mark.parametrize("expected", [0.0, 0.2, 3.0, 7.9, END])
def test_draws_follow_the_density(expected: float):
    """False alarm 1e-4 each (fixed seed); draws of another rate or scale are found out."""
    draws = Beams(np.full(20_000, expected), MODEL).sample(rng=5)
    assert (draws >= 0).all() and (draws <= END).all()
    assert p_value(draws, MODEL, expected) > 1e-4
    other = replace(MODEL, z_hit=0.45, z_rand=0.25)
    assert p_value(Beams(np.full(20_000, expected), other).sample(rng=5), MODEL, expected) < 1e-4


def test_scans_are_products():
    expected = np.array([[1.0, 4.0, END], [2.0, 0.0, 5.0]])
    ranges = np.array([1.1, 3.0, END])
    dist = Beams(expected, MODEL)
    assert dist.batch_shape == (2,) and dist.event_shape == (3,)
    single = [[float(Beams([e], MODEL).log_prob([z])) for e, z in zip(row, ranges, strict=True)]
              for row in expected]  # fmt: skip
    np.testing.assert_allclose(dist.log_prob(ranges), np.sum(single, axis=1))
    np.testing.assert_allclose(dist.log_prob_by_beam(ranges), single)
    assert dist.sample(rng=0, sample_shape=(4,)).shape == (4, 2, 3)
    assert dist.log_prob(np.ones((5, 1, 3))).shape == (5, 2)


def test_tempering_is_an_exponent_of_the_density_only():
    tempered = replace(MODEL, tempering=0.25)
    expected, ranges = np.array([1.0, 4.0]), np.array([1.1, 3.0])
    plain = Beams(expected, MODEL)
    np.testing.assert_allclose(
        Beams(expected, tempered).log_prob(ranges), 0.25 * plain.log_prob(ranges)
    )
    np.testing.assert_array_equal(Beams(expected, tempered).sample(1), plain.sample(1))


def test_readings_that_are_none():
    dist = Beams([2.0, 3.0], MODEL)
    alone = float(Beams([2.0], MODEL).log_prob([2.2]))
    assert float(dist.log_prob([2.2, NAN])) == pytest.approx(alone)
    for beyond in (END, 80.0, np.inf):
        assert float(Beams([2.0], MODEL).log_prob([beyond])) == pytest.approx(np.log(0.1))
    assert float(Beams([2.0], MODEL).log_prob([-0.1])) == -np.inf
    assert clean_ranges([0.0, 7.99, END, 81.0, -1.0, NAN, np.inf], END).tolist() == [
        0.0, 7.99, *[END] * 5,
    ]  # fmt: skip


def test_far_tails_do_not_underflow():
    hit = BeamModel(0.9, 0.1, 0.0, 0.0, sigma_hit=0.01, lambda_short=100.0, max_range=END)
    assert float(Beams([1.0], hit).log_prob([7.0])) == pytest.approx(-180_000, rel=1e-3)


@settings(max_examples=session.scaled(40, 5))
@given(st.floats(0, 10), st.floats(0, 10), st.floats(0.01, 10), st.floats(0.01, 10))
def test_never_nan(expected: float, reading: float, sigma: float, rate: float):
    model = replace(MODEL, sigma_hit=sigma, lambda_short=rate)
    assert np.isfinite(Beams([expected], model).log_prob([reading]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"z_hit": 0.6}, "must sum to 1; they sum to 1.1"),
        ({"z_hit": -0.5}, "z_hit must be between 0 and 1; got -0.5"),
        ({"sigma_hit": 0.0}, "sigma_hit must be positive"),
        ({"lambda_short": NAN}, "lambda_short must be positive"),
        ({"max_range": np.inf}, "max_range must be positive"),
        ({"tempering": 0.0}, "tempering must be positive"),
    ],
)
def test_bad_models(change: dict[str, float], message: str):
    with pytest.raises(ParameterError, match=message):
        replace(MODEL, **change)


def test_bad_expectations():
    with pytest.raises(ParameterError, match="expected must be nonnegative.*at index 1"):
        Beams([[1.0, 2.0], [NAN, 2.0]], MODEL)
    with marking_invalid():
        dist = Beams([[1.0, 2.0], [-1.0, 2.0]], MODEL)
    assert dist.invalid is not None and dist.invalid.tolist() == [False, True]
    with pytest.raises(ShapeError, match=r"give \(\.\.\., beams\)"):
        Beams(1.0, MODEL)
    with pytest.raises(ShapeError, match=r"\(3,\)"):
        Beams([1.0, 2.0], MODEL).log_prob([1.0, 2.0, 3.0])


# ---- learning -----------------------------------------------------------------------------------

PLANTED = BeamModel(
    0.6, 0.15, 0.05, 0.2, sigma_hit=0.15, lambda_short=0.9, max_range=END, tempering=0.3
)


def planted(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    expected = np.where(rng.random(count) < 0.1, END, rng.uniform(0.0, 7.5, count))
    expected[:50] = 0.0
    return Beams(expected, PLANTED).sample(rng), expected


def test_planted_parameters_come_back():
    """Within 4 standard errors, about 1e-3 false alarm over six numbers (fixed seed)."""
    ranges, expected = planted(16_000, 2)
    fit = fit_beams(ranges, expected, BeamModel(0.3, 0.3, 0.2, 0.2, 1.0, 3.0, max_range=END))
    assert fit.converged
    found, truth = fit.model, PLANTED
    np.testing.assert_allclose(found.shares, truth.shares, atol=4 * np.sqrt(0.25 / 16_000) * 1.5)
    assert found.sigma_hit == pytest.approx(truth.sigma_hit, rel=4 * 1.3 / np.sqrt(2 * 9_600))
    assert found.lambda_short == pytest.approx(truth.lambda_short, rel=0.2)
    assert found.max_range == END and found.tempering == 1.0
    assert fit.log_likelihood[-1] >= _log_likelihood(
        replace(truth, tempering=1.0), ranges, expected
    )


@pytest.mark.parametrize("seed", range(4))
def test_likelihood_never_falls(seed: int):
    rng = np.random.default_rng(seed)
    ranges, expected = planted(500, seed)
    ranges[::7] = rng.uniform(0, 9, len(ranges[::7]))  # also where the model is wrong
    shares = rng.dirichlet(np.ones(4)).tolist()
    start = BeamModel(*shares, *rng.uniform(0.05, 3.0, 2), max_range=END)
    fit = fit_beams(ranges, expected, start, iterations=30, tolerance=0.0)
    steps = np.diff(fit.log_likelihood)
    assert (steps >= -1e-9 * np.abs(fit.log_likelihood[1:])).all()
    assert fit.log_likelihood[0] == pytest.approx(_log_likelihood(start, ranges, expected))
    assert fit.log_likelihood[-1] == pytest.approx(_log_likelihood(fit.model, ranges, expected))


def test_closed_forms_of_the_table_would_do_worse():
    """Negative control: scale and rate without regard to truncation are biased, and less likely."""
    rng = np.random.default_rng(0)
    expected = rng.uniform(0.0, 0.6, 20_000)
    model = BeamModel(0.5, 0.5, 0.0, 0.0, sigma_hit=0.2, lambda_short=0.5, max_range=END)
    ranges = Beams(expected, model).sample(rng)
    fit = fit_beams(ranges, expected, model)
    assert fit.model.sigma_hit == pytest.approx(0.2, rel=0.05)
    naive = replace(model, lambda_short=1 / ranges.mean())
    assert (
        _log_likelihood(fit.model, ranges, expected) > _log_likelihood(naive, ranges, expected) + 50
    )


def test_what_cannot_be_used_is_left_out():
    ranges, expected = planted(2_000, 3)
    garbage = np.array([NAN, -1.0])
    fits = [
        fit_beams(ranges, expected, MODEL, iterations=3),
        fit_beams(np.append(ranges, garbage), np.append(expected, [1.0, 1.0]), MODEL, iterations=3),
    ]
    assert fits[0].model == fits[1].model


def test_shares_of_zero_stay():
    ranges, expected = planted(2_000, 4)
    start = BeamModel(0.5, 0.0, 0.2, 0.3, max_range=END)
    assert fit_beams(ranges, expected, start).model.z_short == 0.0


def test_readings_that_are_what_is_expected_have_a_least_scale():
    expected = np.random.default_rng(0).uniform(1.0, 7.0, 300)
    for options, least in (({}, 1e-3), ({"least_sigma": 0.02}, 0.02)):
        with pytest.warns(ConvergenceWarning, match=f"sigma_hit ended at least_sigma={least:g} m"):
            fit = fit_beams(expected, expected, BeamModel(max_range=END), **options)
        assert fit.model.sigma_hit == least and fit.at_bound == ("sigma_hit",)
        assert not fit.converged and (np.diff(fit.log_likelihood) >= 0).all()
    noisy = Beams(expected, BeamModel(sigma_hit=0.05, max_range=END)).sample(1)
    found = fit_beams(noisy, expected, BeamModel(max_range=END), least_sigma=0.01)
    assert found.model == fit_beams(noisy, expected, BeamModel(max_range=END)).model
    assert found.at_bound == () and found.converged


def test_short_readings_that_do_not_thin_out_are_reported():
    rng = np.random.default_rng(0)
    expected = rng.uniform(1.0, 7.0, 2000)
    hit = np.clip(expected + 0.1 * rng.normal(size=2000), 0.0, END)
    ranges = np.where(rng.random(2000) < 0.4, expected * rng.random(2000) ** 0.7, hit)
    fit = fit_beams(ranges, expected, BeamModel(max_range=END))
    assert fit.at_bound == ("lambda_short",) and fit.converged
    assert fit.model.lambda_short == pytest.approx(1e-3 / END)
    assert fit.model.z_short == pytest.approx(0.4, abs=0.05)


def test_least_scales_that_make_no_sense():
    for least in (0.0, NAN, "a"):
        with pytest.raises(ParameterError, match="least_sigma must be positive"):
            fit_beams([1.0], [1.0], least_sigma=least)
    with pytest.raises(ParameterError, match="sigma_hit=0.2, below least_sigma=0.5"):
        fit_beams([1.0], [1.0], least_sigma=0.5)


def test_wrong_objects_are_named():
    with pytest.raises(TypeError, match=r"Beams: give a BeamModel, such as .*; got 8.0"):
        Beams([1.0], 8.0)
    with pytest.raises(TypeError, match="fit_beams: give a BeamModel"):
        fit_beams([1.0], [1.0], 8.0)
    with pytest.raises(ParameterError, match="sigma_hit must be positive and finite; got 'a'"):
        BeamModel(sigma_hit="a")
    with pytest.raises(ParameterError, match="z_hit must be between 0 and 1; got '1'"):
        BeamModel(z_hit="1")


@pytest.mark.parametrize("reach", [0.0, -1.0, NAN, np.inf, "a", None])
def test_clean_ranges_of_no_reach(reach: Any):
    with pytest.raises(ParameterError, match="clean_ranges: max_range must be positive and finite"):
        clean_ranges([1.0, 2.0], reach)


def test_bad_data():
    with pytest.raises(ShapeError, match=r"ranges have shape \(2,\), expected ranges \(3,\)"):
        fit_beams(np.ones(2), np.ones(3))
    with pytest.raises(ShapeError, match="no usable reading"):
        fit_beams([NAN, -1.0], [1.0, 1.0])
    with pytest.raises(ParameterError, match="got nan at usable reading 0"):
        fit_beams([1.0], [NAN])
    sure = BeamModel(1.0, 0.0, 0.0, 0.0, max_range=END)
    with pytest.raises(ParameterError, match="the reading 8 m .* probability zero; start with"):
        fit_beams([1.0, 9.0], [1.0, 1.0], sure)


def _log_likelihood(model: BeamModel, ranges: Any, expected: Any) -> float:
    return float(Beams(expected, model).log_prob_by_beam(ranges).sum())
