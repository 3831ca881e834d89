"""Unconstraining maps: round trips, Jacobians against finite differences, far out, and refusals.

Every family that ``bayesmc.distributions`` exports must have examples here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import bayesmc.distributions as d
from bayesmc.distributions.support import (
    Support,
    as_support,
    circle,
    correlation,
    increasing,
    integers,
    interval,
    positive,
    positive_definite,
    product,
    real,
    real_vector,
    simplex,
)
from bayesmc.distributions.transforms import (
    Bounded,
    LogCholesky,
    SideBySide,
    StickBreaking,
    Transform,
    Wrapped,
    transform_of,
)
from bayesmc.errors import ShapeError, UnsupportedError

INF = np.inf
Make = Callable[[], d.Distribution]


def _waits() -> d.Density:
    """Two positive numbers side by side, on one support for both."""
    return d.Density(
        lambda v: -v.sum(axis=-1),
        lambda rng, shape: rng.exponential(size=(*shape, 2)),
        event_shape=(2,),
        support="positive",
    )


def _normals(size: int) -> d.Distribution:
    return d.MvNormal(np.zeros(size), np.eye(size) + 0.3)


def _positive_vector() -> d.Distribution:
    return d.Density(
        lambda x: -np.sum(x, axis=-1),
        sample=lambda rng, shape: rng.exponential(size=(*shape, 3)),
        event_shape=(3,),
        support="positive",
    )


def _triangle() -> d.Distribution:
    return d.Density(
        lambda x: np.log(2 * x),
        sample=lambda rng, shape: np.sqrt(rng.random(shape)),
        support="unit interval",
    )


#: of every family: a batch of one, and batches that broadcast
EXAMPLES: dict[str, tuple[Make, ...]] = {
    "Affine": (
        lambda: d.Affine(d.Gamma(2.0, 1.0), 1.0, 3.0),
        lambda: d.Affine(d.Gamma([2.0, 3.0], 1.0), [[1.0], [-1.0]], -2.0),
        lambda: d.Affine(d.Beta(2.0, 3.0), [-4.0, 1.0, 2.0], [0.5, -3.0, 10.0]),
        lambda: d.Affine(_normals(2), 1.0, [2.0, 3.0]),
        lambda: d.Affine(_waits(), [[0.0, 5.0], [1.0, 1.0]], [1.0, -2.0]),
    ),
    "Bernoulli": (lambda: d.Bernoulli(0.3),),
    "Beta": (lambda: d.Beta(2.0, 3.0), lambda: d.Beta([[0.7], [4.0]], [1.0, 2.0, 3.0])),
    "BetaBinomial": (lambda: d.BetaBinomial(5, 2.0, 3.0),),
    "Binomial": (lambda: d.Binomial(5, 0.3),),
    "Categorical": (lambda: d.Categorical([0.2, 0.8]),),
    "Cauchy": (lambda: d.Cauchy(1.0, 2.0), lambda: d.Cauchy([0.0, 1.0], 1.0)),
    "Density": (_triangle, _positive_vector),
    "Dirichlet": (
        lambda: d.Dirichlet([1.0]),
        lambda: d.Dirichlet([2.0, 1.5]),
        lambda: d.Dirichlet([[[1.0, 2.0, 3.0, 0.7]], [[4.0, 4.0, 4.0, 4.0]]]),
    ),
    "DiscreteUniform": (lambda: d.DiscreteUniform(0, [3, 4]),),
    "Exponential": (lambda: d.Exponential(2.0), lambda: d.Exponential([[1.0, 20.0]])),
    "Gamma": (lambda: d.Gamma(2.0, 1.0), lambda: d.Gamma([1.0, 2.0, 30.0], [[1.0], [0.1]])),
    "Geometric": (lambda: d.Geometric(0.3),),
    "HalfCauchy": (lambda: d.HalfCauchy(1.0), lambda: d.HalfCauchy([1.0, 2.0])),
    "HalfNormal": (lambda: d.HalfNormal(1.0), lambda: d.HalfNormal([[1.0], [2.0]])),
    "InverseCdf": (
        lambda: d.InverseCdf(_triangle()),
        lambda: d.InverseCdf(d.Density(lambda x: -(x**4))),
    ),
    "InverseGamma": (lambda: d.InverseGamma(3.0, 2.0), lambda: d.InverseGamma([3.0, 5.0], 2.0)),
    "InverseWishart": (
        lambda: d.InverseWishart(4.0, [[2.0]]),
        lambda: d.InverseWishart([[6.0], [9.0]], [np.eye(3), np.eye(3) + 0.4]),
    ),
    "Joint": (
        lambda: d.Joint(d.Normal(0.0, 1.0), d.Gamma(2.0, 1.0)),
        lambda: d.Joint(d.Uniform([0.0, 1.0], 3.0), d.Dirichlet([1.0, 2.0, 3.0]), _normals(2)),
    ),
    "KernelDensity": (
        lambda: d.KernelDensity([0.0, 1.0, 3.0]),
        lambda: d.KernelDensity([[0.0, 1.0], [2.0, 0.0], [1.0, 1.5]], vectors=True),
    ),
    "LKJ": (
        lambda: d.LKJ(1),
        lambda: d.LKJ(2, [[1.0], [5.0]]),
        lambda: d.LKJ(4, 2.0),
    ),
    "Laplace": (lambda: d.Laplace(0.0, 1.0), lambda: d.Laplace([0.0, 1.0], 2.0)),
    "LogNormal": (lambda: d.LogNormal(0.0, 1.0), lambda: d.LogNormal([0.0, 1.0], [[1.0], [0.5]])),
    "Mixture": (
        lambda: d.Mixture([0.5, 0.5], d.Normal([-1.0, 1.0], 1.0)),
        lambda: d.Mixture([0.5, 0.5], d.Gamma([[1.0, 2.0], [3.0, 4.0]], 1.0)),
        lambda: d.Mixture([0.5, 0.5], d.Uniform([0.0, 0.0], [2.0, 2.0])),
        lambda: d.Mixture([0.5, 0.5], d.Uniform([[0.0, 1.0], [2.0, 3.0]], 4.0)),
        lambda: d.Mixture([0.2, 0.8], [d.Gamma(1.0, 1.0), d.Uniform(1.0, 2.0)]),
        lambda: d.Mixture([0.2, 0.8], d.Dirichlet([[1.0, 2.0, 3.0], [5.0, 5.0, 5.0]])),
        lambda: d.Mixture([0.2, 0.8], d.Poisson([1.0, 2.0])),
    ),
    "Multinomial": (lambda: d.Multinomial(4, [0.2, 0.8]),),
    "MvNormal": (
        lambda: _normals(1),
        lambda: d.MvNormal(np.zeros((2, 1, 3)), scale_diag=np.ones((4, 3))),
    ),
    "NegativeBinomial": (lambda: d.NegativeBinomial(2.0, 0.3),),
    "Normal": (lambda: d.Normal(0.0, 1.0), lambda: d.Normal([0.0, 1.0], [[1.0], [2.0]])),
    "Ordered": (
        lambda: d.Ordered(d.Normal(0.0, 1.0), 1),
        lambda: d.Ordered(d.Normal([0.0, 5.0], [[1.0], [2.0]]), 4),
        lambda: d.Ordered(d.Exponential([1.0, 20.0]), 3),
        lambda: d.Ordered(d.Uniform(-1.0, 2.0), 3),
        lambda: d.Ordered(d.Affine(d.Gamma(2.0, 1.0), 3.0, -1.0), 3),
    ),
    "OrderedLogistic": (lambda: d.OrderedLogistic(0.0, [-1.0, 1.0]),),
    "Poisson": (lambda: d.Poisson(3.0),),
    "StudentT": (lambda: d.StudentT(5.0, 0.0, 1.0), lambda: d.StudentT([5.0, 9.0], 0.0, 1.0)),
    "Truncated": (
        lambda: d.Truncated(d.Normal(0.0, 1.0), 0.5, 2.0),
        lambda: d.Truncated(d.Normal(0.0, 1.0), [0.0, -INF, -1.0, -INF], [INF, 1.0, 2.0, INF]),
        lambda: d.Truncated(d.Gamma(2.0, 1.0), [[1.0], [0.0]], [3.0, INF]),
        lambda: d.Truncated(d.Poisson(3.0), 1, 5),
    ),
    "Uniform": (
        lambda: d.Uniform(-2.0, 5.0),
        lambda: d.Uniform([[0.0], [-3.0]], [1.0, 10.0, 100.0]),
        lambda: d.Uniform([0.0, 0.0], [2.0, 2.0]),
    ),
    "VonMises": (lambda: d.VonMises(0.5, 2.0), lambda: d.VonMises([3.0, -3.0], 1.0)),
    "Weibull": (lambda: d.Weibull(1.5, 2.0), lambda: d.Weibull([1.0, 2.0], 2.0)),
    "Wishart": (
        lambda: d.Wishart(3.0, [[2.0]]),
        lambda: d.Wishart([4.0, 9.0], [[[2.0, 0.3], [0.3, 1.0]]]),
        lambda: d.Wishart(7.0, np.eye(4) + 0.2),
    ),
    "WrappedNormal": (lambda: d.WrappedNormal(3.0, 1.0), lambda: d.WrappedNormal([0.0, 3.0], 1.0)),
}


def exported() -> list[str]:
    """Names of the families that the package exports."""
    named = ((name, getattr(d, name)) for name in d.__all__)
    return sorted(
        name
        for name, value in named
        if isinstance(value, type) and issubclass(value, d.Distribution) and name != "Distribution"
    )


def made(name: str, k: int) -> d.Distribution:
    return EXAMPLES[name][k]()


CASES = [(name, k) for name in exported() for k in range(len(EXAMPLES.get(name, ())))]
CASE_IDS = [f"{name}-{k}" for name, k in CASES]


def test_every_family_has_examples() -> None:
    assert len(exported()) > 30
    assert sorted(EXAMPLES) == exported()


# ---- the checks, which the negative controls below see fail ----------------------------------


def assert_same_value(support: Support, x: np.ndarray, y: np.ndarray) -> None:
    assert x.shape == y.shape
    if support.kind == "circle":
        x, y = np.exp(1j * x), np.exp(1j * y)
    scale = np.abs(x)
    if support.kind == "positive definite":
        diagonal = np.sqrt(np.linalg.diagonal(x))
        scale = diagonal[..., :, None] * diagonal[..., None, :]
    assert (np.abs(x - y) <= 1e-10 * scale + 1e-13).all()


def check_values(transform: Transform, support: Support, x: np.ndarray) -> None:
    """Values come back from their unconstrained numbers."""
    u = transform.unconstrain(x)
    cut = x.ndim - len(transform.event_shape)
    assert u.shape == x.shape[:cut] + transform.unconstrained_shape
    assert np.isfinite(u).all()
    back = transform.constrain(u)
    assert support.contains(back).all()
    assert_same_value(support, x, back)


def check_numbers(transform: Transform, support: Support, u: np.ndarray) -> None:
    """Unconstrained numbers come back from their values, which lie in the support."""
    x = transform.constrain(u)
    assert support.contains(x).all()
    back = transform.unconstrain(x)
    if support.kind == "circle":
        u, back = np.exp(1j * u), np.exp(1j * back)
    np.testing.assert_allclose(back, np.broadcast_to(u, back.shape), rtol=1e-9, atol=1e-9)


def check_jacobian(transform: Transform, support: Support, u: np.ndarray) -> None:
    """The claimed log determinant equals that of finite differences."""
    claimed = transform.log_abs_det_jacobian(u)
    lead = u.ndim - len(transform.unconstrained_shape)
    x = transform.constrain(u)
    assert claimed.shape == x.shape[: x.ndim - len(transform.event_shape)]
    expected = numerical_log_det(transform, support, u, lead)
    np.testing.assert_allclose(claimed, expected, rtol=1e-8, atol=1e-8)


def numerical_log_det(
    transform: Transform, support: Support, u: np.ndarray, lead: int
) -> np.ndarray:
    """Log determinant of central differences of fourth order, in the event's free coordinates."""
    h, shape = 1e-3, u.shape
    flat = u.reshape((*shape[:lead], -1))
    columns = []
    for step in np.eye(flat.shape[-1]):

        def at(k: float, step: np.ndarray = step) -> np.ndarray:
            moved = (flat + k * h * step).reshape(shape)
            return coordinates(support, transform.event_shape, transform.constrain(moved))

        slopes = [
            turned(support, at(k) - at(-k)) / (2 * k * h) for k in (1.0, 2.0)
        ]  # an angle may pass the cut in between
        columns.append((4 * slopes[0] - slopes[1]) / 3)
    if not columns:
        return np.zeros(shape[:lead])
    sign, log_det = np.linalg.slogdet(np.stack(columns, axis=-1))
    assert (sign != 0).all()
    return log_det


def turned(support: Support, difference: np.ndarray) -> np.ndarray:
    if support.kind != "circle":
        return difference
    return np.angle(np.exp(1j * difference))


def coordinates(support: Support, event: tuple[int, ...], x: np.ndarray) -> np.ndarray:
    """Free coordinates of values, along one last axis."""
    if support.kind == "simplex":
        return x[..., :-1]
    if support.kind == "positive definite":
        return x[..., *np.tril_indices(event[0])]
    if support.kind == "correlation":
        return x[..., *np.tril_indices(event[0], -1)]
    if support.kind == "product":
        parts, start = [], 0
        for part, count in support.parts:
            piece = x[..., start : start + max(count, 1)]
            parts.append(coordinates(part, (max(count, 1),), piece))
            start += max(count, 1)
        return np.concatenate(parts, axis=-1)
    return x.reshape((*x.shape[: x.ndim - len(event)], -1))


# ---- every family ----------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "k"), CASES, ids=CASE_IDS)
def test_the_map_of_a_family(name: str, k: int) -> None:
    dist = made(name, k)
    if dist.is_discrete:
        with pytest.raises(UnsupportedError, match="no unconstrained space; enumerate"):
            dist.transform  # noqa: B018 - the property raises
        return
    rng = np.random.default_rng([k, *name.encode()])
    transform = dist.transform
    assert transform.event_shape == dist.event_shape
    check_values(transform, dist.support, dist.sample(rng, 40))
    for lead in ((), (7,), (2, 3)):
        shape = lead + dist.batch_shape + transform.unconstrained_shape
        u = rng.normal(0.0, 1.3, shape)
        check_numbers(transform, dist.support, u)
        check_jacobian(transform, dist.support, u)
        np.testing.assert_array_equal(dist.constrain(u), transform.constrain(u))
        np.testing.assert_array_equal(
            dist.log_abs_det_jacobian(u), transform.log_abs_det_jacobian(u)
        )
        # a point that the map reaches has a density
        assert not np.isnan(dist.log_prob(dist.constrain(u))).any()
        assert (dist.log_prob(dist.constrain(u)) > -INF).all()


@pytest.mark.parametrize(
    ("name", "k"), [case for case in CASES if not made(*case).is_discrete], ids=str
)
def test_far_out_nothing_is_nan(name: str, k: int) -> None:
    dist = made(name, k)
    transform = dist.transform
    for far in (700.0, -700.0, 745.0, -1e4, 1e4):
        u = np.full(dist.batch_shape + transform.unconstrained_shape, far)
        with np.errstate(all="raise"):
            x, log_det = transform.constrain(u), transform.log_abs_det_jacobian(u)
        assert np.isfinite(x).all() and np.isfinite(log_det).all()
        if dist.support.kind not in (
            "positive definite",
            "correlation",
        ):  # such matrices are singular to rounding
            assert dist.support.contains(x).all()
            assert np.isfinite(transform.unconstrain(x)).all()  # not on an open bound


# ---- supports by themselves ------------------------------------------------------------------

MIXED = interval([[0.0, -INF, -INF, 1.0], [-5.0, 2.0, 0.0, -INF]], [INF, 3.0, INF, 2.5])
BOTH = product(
    [
        (interval([0.0, 1.0], 2.0), 0),
        (simplex, 3),
        (real, 0),
        (real_vector, 2),
        (positive, 2),
        (interval(-INF, [1.0, 4.0]), 0),
    ]
)
KINDS: dict[str, tuple[Support, tuple[int, ...], tuple[int, ...]]] = {
    "real": (real, (), ()),
    "real of several": (real, (2, 2), ()),
    "positive": (positive, (), ()),
    "several positive": (positive, (3,), ()),
    "bounds by component": (interval(0.0, [1.0, 2.0, INF]), (3,), ()),
    "upper": (interval(-INF, 4.0), (), ()),
    "interval": (interval(-1.0, 3.0), (), ()),
    "bounds of all sorts": (MIXED, (), (2, 4)),
    "circle": (circle, (), ()),
    "simplex": (simplex, (5,), ()),
    "real vector": (real_vector, (3,), ()),
    "positive definite": (positive_definite, (4, 4), ()),
    "correlation": (correlation, (4, 4), ()),
    "increasing": (increasing(), (4,), ()),
    "increasing from below": (increasing(-1.0), (3,), ()),
    "increasing up to": (increasing(-INF, 2.0), (3,), ()),
    "increasing between": (increasing(-1.0, 3.0), (3,), ()),
    "product": (BOTH, (10,), (2,)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_map_of_a_support(kind: str) -> None:
    support, event, batch = KINDS[kind]
    transform = transform_of(support, event)
    rng = np.random.default_rng(3)
    u = rng.normal(0.0, 1.5, (5, *batch, *transform.unconstrained_shape))
    check_numbers(transform, support, u)
    check_jacobian(transform, support, u)
    one = rng.normal(size=transform.unconstrained_shape)
    assert transform.constrain(one).shape == batch + event  # the bounds' batch, not the numbers'
    assert transform.log_abs_det_jacobian(one).shape == batch


def test_zero_is_the_centre() -> None:
    np.testing.assert_allclose(transform_of(simplex, (5,)).constrain(np.zeros(4)), 0.2, rtol=1e-15)
    assert transform_of(interval(-1.0, 3.0)).constrain(0.0) == 1.0
    np.testing.assert_array_equal(
        transform_of(positive_definite, (2, 2)).constrain(np.zeros(3)), np.eye(2)
    )


def test_golden_values() -> None:
    # by hand: 2 + e; 2 - e; 1 + 3 / (1 + 1 / e); log of 3 e / (1 + e)^2
    e = np.e
    assert transform_of(interval(2.0, INF)).constrain(1.0) == pytest.approx(2 + e)
    assert transform_of(interval(-INF, 2.0)).constrain(1.0) == pytest.approx(2 - e)
    between = transform_of(interval(1.0, 4.0))
    assert between.constrain(1.0) == pytest.approx(1 + 3 / (1 + 1 / e))
    assert between.log_abs_det_jacobian(1.0) == pytest.approx(np.log(3 * e / (1 + e) ** 2))
    # [[e, 0], [2, 1]] times its transpose; 2^2 L_00^3 L_11^2 of Stan's manual
    matrix = transform_of(positive_definite, (2, 2))
    np.testing.assert_allclose(
        matrix.constrain([1.0, 2.0, 0.0]), [[e * e, 2 * e], [2 * e, 5.0]], rtol=1e-15
    )
    assert matrix.log_abs_det_jacobian([1.0, 2.0, 0.0]) == pytest.approx(2 * np.log(2) + 3)


@given(
    st.floats(-1e3, 1e3),
    st.floats(1e-3, 1e6),
    st.floats(-700, 700),
    st.sampled_from(["low", "high", "both"]),
)
def test_bounds_hold_for_any_number(low: float, width: float, u: float, which: str) -> None:
    high = low + width
    support = interval(-INF if which == "high" else low, INF if which == "low" else high)
    open_support = Support("interval", support.low, support.high, True, True)
    transform = transform_of(support)
    x = transform.constrain(u)
    assert open_support.contains(x)
    assert np.isfinite(transform.log_abs_det_jacobian(u))
    # as many digits come back as x has beyond its bound
    if abs(u) < 5 and width > 1:
        assert transform.unconstrain(x) == pytest.approx(u, rel=1e-6, abs=1e-6)


def test_angles_wrap_and_keep_their_digits() -> None:
    wrap = transform_of(circle)
    for angle in (0.0, 1e-300, -1e-20, 3.0, -np.pi):
        assert wrap.constrain(angle) == angle
    turns = wrap.constrain(np.array([np.pi, 3 * np.pi, -3.5 * np.pi, 100.0]))
    np.testing.assert_allclose(turns, [-np.pi, -np.pi, 0.5 * np.pi, 100 - 32 * np.pi], rtol=1e-13)
    near = np.pi * (1 + np.arange(-400, 400) * 2.0**-53)
    wrapped = wrap.constrain(np.concatenate([near, -near, near + 1e5]))
    assert ((wrapped >= -np.pi) & (wrapped < np.pi)).all()


@pytest.mark.parametrize(
    ("support", "event", "x"),
    [
        (positive, (), [0.0, -1.0, INF, np.nan]),
        (interval(-INF, 1.0), (), [1.0, 2.0, -INF]),
        (interval(0.0, 1.0), (), [0.0, 1.0, -0.5, 1.5]),
        (simplex, (3,), [[0.5, 0.5, 0.0], [1.0, 0.0, 0.0], [0.7, 0.7, -0.4], [0.5, 0.3, 0.1]]),
        (positive_definite, (2, 2), [-np.eye(2), [[1.0, 0.3], [0.1, 1.0]], np.ones((2, 2))]),
        (product([(positive, 0), (real, 0)]), (2,), [[0.0, 1.0], [-1.0, 1.0]]),
    ],
    ids=["lower", "upper", "interval", "simplex", "positive definite", "product"],
)
def test_values_outside_the_open_support_give_no_finite_numbers(
    support: Support, event: tuple[int, ...], x: Any
) -> None:
    u = transform_of(support, event).unconstrain(x)
    axes = tuple(range(u.ndim))[1:]
    assert not np.isfinite(u).all(axis=axes).any()


def test_discrete_supports_have_no_map() -> None:
    for support in (integers(0, 3), as_support("counts")):
        with pytest.raises(UnsupportedError, match="enumerate them or update them by Gibbs"):
            transform_of(support, (2,))


@pytest.mark.parametrize(
    ("support", "event"),
    [
        (simplex, ()),
        (simplex, (0,)),
        (positive_definite, (2, 3)),
        (positive_definite, (2,)),
        (product([(positive, 0), (real, 0)]), (3,)),
    ],
)
def test_event_shapes_that_do_not_fit_are_refused(support: Support, event: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match="event shape"):
        transform_of(support, event)


def test_values_of_another_shape_are_refused() -> None:
    transform = transform_of(simplex, (3,))
    for call in (transform.constrain, transform.log_abs_det_jacobian):
        with pytest.raises(ShapeError, match=r"not \(..., \*\(2,\)\)"):
            call(np.zeros(3))
    with pytest.raises(ShapeError, match="not"):
        transform.unconstrain(0.5)


def test_arguments_are_left_alone() -> None:
    for support, event, batch in KINDS.values():
        transform = transform_of(support, event)
        u = np.zeros(batch + transform.unconstrained_shape)
        u.flags.writeable = False
        x = transform.constrain(u)
        x.flags.writeable = False
        assert transform.unconstrain(x) is not x
        transform.log_abs_det_jacobian(u)


# ---- densities of the unconstrained numbers --------------------------------------------------


def _line(width: float = 60.0) -> tuple[np.ndarray, float]:
    grid = np.linspace(-width, width, 6001)
    return grid, grid[1] - grid[0]


@pytest.mark.parametrize(
    "dist",
    [
        d.Gamma(2.0, 3.0),
        d.Gamma(0.5, 3.0),
        d.Beta(0.7, 2.5),
        d.Uniform(-2.0, 5.0),
        d.Normal(1.0, 2.0),
        d.Density(lambda x: x - 4.0, support=(-INF, 4.0)),
        d.Mixture([0.3, 0.7], [d.Uniform(0.0, 5.0), d.Gamma(2.0, 1.0)]),
    ],
    ids=repr,
)
def test_the_density_of_the_number_integrates_to_one(dist: d.Distribution) -> None:
    # the trapezoidal rule is exact to rounding for smooth densities with tails this light; the
    # mixture's jump costs digits
    u, step = _line()
    density = np.exp(dist.log_prob(dist.constrain(u)) + dist.log_abs_det_jacobian(u))
    jump = isinstance(dist, d.Mixture)
    assert density.sum() * step == pytest.approx(1.0, abs=1e-2 * step if jump else 1e-9)


def test_the_density_of_vectors_and_matrices_integrates_to_one() -> None:
    u = np.stack(np.meshgrid(*[np.linspace(-25, 25, 401)] * 2, indexing="ij"), axis=-1)
    dist: d.Distribution = d.Dirichlet([1.0, 2.0, 3.5])
    density = np.exp(dist.log_prob(dist.constrain(u)) + dist.log_abs_det_jacobian(u))
    assert density.sum() * (50 / 400) ** 2 == pytest.approx(1.0, abs=1e-9)
    axes = [np.linspace(-7, 3, 81), np.linspace(-9, 9, 101), np.linspace(-7, 3, 81)]
    u = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    cell = np.prod([axis[1] - axis[0] for axis in axes])
    dist = d.Wishart(5.0, [[1.0, 0.3], [0.3, 0.8]])
    density = np.exp(dist.log_prob(dist.constrain(u)) + dist.log_abs_det_jacobian(u))
    assert density.sum() * cell == pytest.approx(1.0, abs=1e-6)


# ---- the checks can fail ---------------------------------------------------------------------


def _wrong(kind: type[Transform], error: float) -> type[Transform]:
    class Wrong(kind):  # type: ignore[misc, valid-type]
        def log_det_formula(self, u: np.ndarray) -> np.ndarray:
            return super().log_det_formula(u) + error

    return Wrong


@pytest.mark.parametrize("error", [1e-5, 0.0])
@pytest.mark.parametrize(
    ("kind", "support", "event"),
    [
        (Wrapped, circle, ()),
        (StickBreaking, simplex, (4,)),
        (LogCholesky, positive_definite, (3, 3)),
    ],
)
def test_a_wrong_jacobian_is_caught(
    kind: type[Transform], support: Support, event: tuple[int, ...], error: float
) -> None:
    # at error 0 the same class passes, so that it is the error that is caught
    transform = _wrong(kind, error)(event)
    u = np.random.default_rng(0).normal(size=(5, *transform.unconstrained_shape))
    if error:
        with pytest.raises(AssertionError):
            check_jacobian(transform, support, u)
    else:
        check_jacobian(transform, support, u)


def test_a_forgotten_width_is_caught() -> None:
    class Forgetful(Bounded):
        def log_det_formula(self, u: np.ndarray) -> np.ndarray:
            return Bounded((), np.array(0.0), np.array(1.0)).log_det_formula(u)

    transform = Forgetful((), np.array(0.0), np.array(2.0))
    with pytest.raises(AssertionError):
        check_jacobian(transform, interval(0.0, 2.0), np.linspace(-1, 1, 5))


def test_wrong_values_are_caught() -> None:
    above = transform_of(interval(1.0, INF))
    with pytest.raises(AssertionError):
        check_numbers(above, interval(5.0, INF), np.zeros(3))  # beyond the support
    with pytest.raises(AssertionError):
        check_values(above, positive, np.array([0.5]))  # no finite numbers

    class Lossy(LogCholesky):
        def formula(self, u: np.ndarray) -> np.ndarray:
            return super().formula(u) * (1 + 1e-9)

    with pytest.raises(AssertionError):
        check_values(Lossy((2, 2)), positive_definite, np.eye(2)[None])


# ---- supports --------------------------------------------------------------------------------


def test_supports_are_equal_by_value() -> None:
    assert interval(0.0, INF, open_low=True) == positive
    assert hash(interval(0.0, INF, open_low=True)) == hash(positive)
    assert interval(0.0, INF) != positive  # closed
    assert interval(0.0, [1.0, 2.0]) == interval(0.0, np.array([1.0, 2.0]))
    assert interval(0.0, [1.0, 2.0]) != interval(0.0, [1.0, 3.0])
    assert interval(0.0, 1.0) != interval(0.0, [1.0, 1.0])  # a bound of another batch
    assert integers(0, 3) != interval(0, 3)
    assert real != "real"
    assert product([(positive, 0), (simplex, 2)]) == product([(positive, 0), (simplex, 2)])
    assert product([(positive, 0), (simplex, 2)]) != product([(positive, 0), (simplex, 3)])


def test_a_product_contains_what_its_parts_contain() -> None:
    support = product([(positive, 0), (interval(0.0, 1.0), 2), (simplex, 2)])
    assert support.event_ndim == 1 and not support.is_discrete
    good = [2.0, 0.0, 1.0, 0.3, 0.7]
    assert support.contains(good)
    for k in range(5):
        bad = np.array(good)
        bad[k] = -0.5
        assert not support.contains(bad)
    assert support.contains(np.stack([good, [np.nan] * 5])).tolist() == [True, False]
    assert support.describe() == (
        "vectors whose parts are numbers > 0; numbers in [0, 1] (2 components); "
        "vectors of probabilities that sum to 1 (2 components)"
    )
    with pytest.raises(ShapeError, match="5 components"):
        support.contains(np.ones(4))


def test_a_product_knows_whether_its_bounds_may_differ() -> None:
    assert BOTH.contains(transform_of(BOTH, (10,)).constrain(np.zeros((2, 9)))).all()
    assert not BOTH.is_constant and not BOTH.is_single
    fixed = product([(positive, 0), (simplex, 2)])
    assert fixed.is_constant and fixed.is_single
    same = product([(interval(0.0, [1.0, 1.0]), 0)])
    assert same.is_constant and not same.is_single


def test_a_product_refuses_parts_that_are_no_components() -> None:
    for part in (integers(0, 1), as_support("counts"), positive_definite):
        with pytest.raises(UnsupportedError, match="cannot be components"):
            product([(part, 2)])
    with pytest.raises(ShapeError, match="number of components"):
        product([(simplex, 0)])


def test_parts_side_by_side_have_the_maps_of_their_supports() -> None:
    transform = transform_of(product([(positive, 0), (real, 0)]), (2,))
    assert isinstance(transform, SideBySide)
    assert transform.constrain([0.0, 5.0]).tolist() == [1.0, 5.0]


@pytest.mark.parametrize(
    "matrix",
    [
        [[1.0, 0.5], [0.1, 1.0]],
        [[1.0, 2.0], [2.0, 1.0]],
        [[np.nan, 0.0], [0.0, 1.0]],
        [[INF, 0.0], [0.0, 1.0]],
    ],
)
def test_only_symmetric_positive_definite_matrices_are_contained(matrix: list) -> None:
    assert not positive_definite.contains(matrix)
    assert positive_definite.contains([matrix, np.eye(2)]).tolist() == [False, True]


def test_between_two_bounds_nothing_jumps_down_to_the_smallest_double() -> None:
    """``expit`` underflows at -709, where ``exp`` has still 36 powers of e to go."""
    dist = d.Beta(0.01, 0.02)
    u = np.linspace(-740.0, -600.0, 400)
    log = dist.log_prob(dist.constrain(u)) + dist.log_abs_det_jacobian(u)
    np.testing.assert_allclose(np.diff(log), 0.01 * (u[1] - u[0]), atol=0.01)
    np.testing.assert_array_equal(dist.constrain(np.array([-1e4, 1e4])) > 0, True)
