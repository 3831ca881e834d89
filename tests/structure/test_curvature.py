"""Second derivatives of log densities: of the graph, its calls and special functions; by differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import special

import bayesmc as bmc
from bayesmc.errors import TraceError
from bayesmc.expression import TracedArray, evaluate, leaf, reduction
from bayesmc.network import pose
from bayesmc.passes.derivatives import gradient, tangent
from bayesmc.structure import curvature as module
from bayesmc.structure.curvature import Curvature
from bayesmc.structure.free_density import UnconstrainedDensity
from bayesmc.structure.target import target_of
from bayesmc.structure.unconstrained import unconstrained_density, without_volume

RNG = np.random.default_rng(5)
AT = np.array([0, 2, 2, 1, 0, 0])


def density_of(net: bmc.BayesNet, evidence: dict[str, Any]) -> UnconstrainedDensity:
    target = target_of(pose(net, evidence))
    finite = [n for n in target.chain if target.model[n].domain is not None]
    return unconstrained_density(target, None, finite)


def effects() -> UnconstrainedDensity:
    """Gathers, a scale, a share, and labels that are summed out."""
    net = bmc.BayesNet(plates={"school": 3, "pupil": 6})
    net.add("scale", bmc.HalfNormal(1.0))
    net.add("effect", lambda scale: bmc.StudentT(4.0, 0.0, scale), plates="school")
    net.add("share", bmc.Beta(2.0, 2.0))
    net.add("odd", lambda share: bmc.Bernoulli(share), plates="pupil")
    net.add(
        "y", lambda effect, odd: bmc.Normal(effect[AT], np.where(odd, 3.0, 0.5)), plates="pupil"
    )
    return density_of(net, {"y": RNG.normal(size=6)})


def matrices() -> UnconstrainedDensity:
    net = bmc.BayesNet(plates={"i": 6})
    net.add("S", bmc.InverseWishart(4.0, np.eye(2)))
    net.add("m", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add("w", bmc.Dirichlet(np.ones(3)))
    net.add("x", lambda S, m: bmc.MvNormal(m, S), plates="i")
    net.add("k", lambda w: bmc.Multinomial(9, w))
    return density_of(net, {"x": RNG.normal(size=(6, 2)), "k": [2, 3, 4]})


def special_functions() -> UnconstrainedDensity:
    net = bmc.BayesNet(plates={"i": 2})
    net.add("a", bmc.Gamma(2.0, 1.0))
    net.add("y", lambda a: bmc.Beta(a, 2.0 * a), plates="i")
    net.add("t", lambda a: bmc.StudentT(a, 0.0, 1.0))
    net.add("d", lambda a: bmc.VonMises(0.3, a))
    return density_of(net, {"y": [0.2, 0.3], "t": 0.7, "d": 0.9})


@pytest.mark.parametrize("made", [effects, matrices, special_functions])
def test_exact_ones_are_differences_of_the_gradient(made: Callable[[], Any]) -> None:
    for density in (whole := made(), without_volume(whole)):
        curvature = Curvature(density)
        assert curvature.has_derivatives
        for _ in range(3):
            u = 0.5 * RNG.normal(size=density.size)
            found, other = curvature.at(u), curvature._differences(u)
            assert found.is_exact
            assert not other.is_exact
            size = np.sqrt(np.abs(np.diag(found.matrix)) + 1e-3)
            off = np.abs(found.matrix - other.matrix) / np.outer(size, size)
            assert off.max() < max(1e-5, 4 * other.error)


def test_without_the_change_of_volume() -> None:
    density = matrices()
    bare = without_volume(density)
    u = RNG.normal(size=(4, density.size))
    np.testing.assert_allclose(
        density.value(u) - bare.value(u), density.log_volume(u), rtol=1e-10, atol=1e-10
    )
    step = 1e-6 * np.eye(density.size)
    away = (bare.value(u[0] + step) - bare.value(u[0] - step)) / 2e-6
    np.testing.assert_allclose(bare.with_gradient(u[0])[1], away, atol=1e-5)


def test_wrong_second_derivatives_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of them: differences of the gradient differ, and are taken."""
    density = effects()
    right = Curvature(density).at(np.zeros(density.size))

    def half(*arguments: Any) -> Any:
        found = TracedArray(tangent(*arguments))
        return (0.5 * found).expression

    monkeypatch.setattr(module, "tangent", half)
    found = Curvature(density).at(np.zeros(density.size))
    assert not found.is_exact
    np.testing.assert_allclose(found.matrix, right.matrix, atol=1e-5)


def test_a_kink_shows_as_an_error() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Laplace(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 3.0))
    found = Curvature(density_of(net, {"y": 0.5})).at(np.zeros(1))
    assert not found.is_exact
    assert found.error > 0.1


# ---- passes -----------------------------------------------------------------------------------------


def second(function: Callable[[Any], Any], x: np.ndarray) -> np.ndarray:
    """Second derivatives of a sum, forward over reverse."""
    here, along = leaf("x", x.shape), leaf("v", x.shape)
    root = function(TracedArray(here)).expression
    total = reduction(np.add, root, range(len(root.shape)))
    moved = tangent(gradient(total, ["x"])["x"], {"x": along})
    rows = np.eye(x.size).reshape(x.size, *x.shape)
    (found,) = evaluate([moved], {"x": x, "v": rows})
    return np.broadcast_to(found, (x.size, *x.shape)).reshape(x.size, x.size)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: np.prod(x),
        lambda x: np.prod(np.sin(x)) ** 2,
        lambda x: np.prod(np.reshape(np.take(x, [0, 1, 1, 2, 0, 2]), (2, 3)), axis=1),
        lambda x: np.take(x, [0, 2, 2, 2, 1]) ** 3,
        lambda x: np.cumsum(x**2) ** 2,
        lambda x: special.gammaln(1.0 + x**2),
        lambda x: np.log(special.i0e(x)),
        lambda x: np.where(x > 0.5, np.log(np.where(x > 0.5, x, 1.0)), x**2),
        lambda x: np.logaddexp.reduce(2.0 * x),
    ],
)
def test_second_derivatives_of_calls(function: Callable[[Any], Any]) -> None:
    x = np.array([0.7, -1.2, 0.4])

    def value(at: np.ndarray) -> float:
        return float(np.sum(function(at)))

    h, eye = 1e-4, np.eye(3)
    away = [
        [
            (
                value(x + h * (a + b))
                - value(x + h * (a - b))
                - value(x - h * (a - b))
                + value(x - h * (a + b))
            )
            / (4 * h * h)
            for b in eye
        ]
        for a in eye
    ]
    np.testing.assert_allclose(second(function, x), away, atol=2e-6)


def test_what_a_branch_leaves_out_adds_nothing_to_second_derivatives() -> None:
    found = second(lambda x: np.where(x > 0, np.log(x), x**2), np.array([-1.0, 2.0]))
    np.testing.assert_allclose(found, [[2.0, 0.0], [0.0, -0.25]])


def test_products_over_several_axes_say_that_they_have_none() -> None:
    with pytest.raises(TraceError, match="several axes"):
        second(lambda x: np.prod(np.sin(x), axis=(0, 1)), np.ones((2, 2)))
