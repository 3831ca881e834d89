"""Log densities of free numbers: values beside the model's own, gradients beside differences, refusals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
import pytest
from scipy import special, stats

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import BayesmcError, EvidenceError, UnsupportedError
from bayesmc.expression import elementwise, ordered
from bayesmc.network import pose
from bayesmc.passes import alike
from bayesmc.structure import free_nodes, free_terms, unconstrained, unconstrained_check
from bayesmc.structure.free_terms import Elements
from bayesmc.structure.target import Target, Values, target_of
from bayesmc.structure.unconstrained import UnconstrainedDensity, unconstrained_density
from bayesmc.testing import session
from bayesmc.testing.makers.gaussians import gaussian_evidence, random_gaussian_net
from bayesmc.testing.makers.nets import random_net
from bayesmc.testing.makers.observing import random_evidence
from tests.passes.test_log_density import FAMILIES

DISCRETE = {
    name
    for name, (_, values) in FAMILIES.items()
    if np.asarray(values).dtype.kind == "i" and name != "Dirichlet"
}
POINTS = 6


def target(net: bmc.BayesNet, evidence: Mapping[str, Any], also: Any = ()) -> Target:
    return target_of(pose(net, evidence), also)


def own_value(density: UnconstrainedDensity, u: np.ndarray, values: Values | None = None) -> float:
    """The model's own log density, and the change of volume by the maps; NaN where it cannot say."""
    found: Values = {**density.target.known, **(values or {})}
    found.update(density.constrain(u, found))
    with marking_invalid(), np.errstate(all="ignore"):
        try:
            density.target.compute(found, density.target.links)
            log = density.target.log_density(found, density.target.terms_of(density.names))
        except BayesmcError:
            return np.nan
    return float(log + density.log_volume(u, found))


def differences(
    density: UnconstrainedDensity, u: np.ndarray, values: Values | None = None
) -> np.ndarray:
    """Central differences of the sixth order."""
    h, found = 1e-3, np.zeros(density.size)
    for k, step in enumerate(np.eye(density.size) * h):
        ups = [density.value(u + j * step, values) for j in (1, 2, 3)]
        downs = [density.value(u - j * step, values) for j in (1, 2, 3)]
        with np.errstate(invalid="ignore"):
            parts = [w * (a - b) for w, a, b in zip((45, -9, 1), ups, downs, strict=True)]
            found[k] = sum(parts) / (60 * h)
    return found


def check(
    density: UnconstrainedDensity, rng: Any, values: Values | None = None, spread: float = 0.3
) -> int:
    """Values and gradients at random points; how many of these have a density."""
    count, states = 0, density.target.states
    assert states is not None
    for k in range(POINTS):
        row = {n: v if density.target.is_known(n) else v[k % len(v)] for n, v in states.items()}
        u = density.unconstrain({**row, **(values or {})}) + rng.normal(size=density.size) * spread
        value, slopes = density.with_gradient(u, values)
        own = own_value(density, u, values)
        if not np.isnan(own):
            np.testing.assert_allclose(value, own, rtol=1e-8, atol=1e-8)
        assert value == density.value(u, values)
        if not np.isfinite(value):
            assert (slopes == 0).all()
            continue
        count += 1
        wanted = differences(density, u, values)
        if np.isfinite(wanted).all():
            scale = 1.0 + np.abs(wanted).max()
            np.testing.assert_allclose(slopes / scale, wanted / scale, atol=2e-6)
        free = density.unconstrain(density.constrain(u, values) | (values or {}))
        np.testing.assert_allclose(density.value(free, values), value, rtol=1e-6, atol=1e-6)
    batch = rng.normal(size=(2, 3, density.size))
    value, slopes = density.with_gradient(batch, values)
    assert value.shape == (2, 3)
    assert slopes.shape == batch.shape
    one = [density.with_gradient(u, values) for u in batch.reshape(6, -1)]
    np.testing.assert_allclose(value.ravel(), [v for v, _ in one], rtol=1e-10)
    np.testing.assert_allclose(slopes.reshape(6, -1), [g for _, g in one], rtol=1e-7, atol=1e-8)
    return count


def over_family(name: str, is_seen: bool) -> UnconstrainedDensity:
    make, values = FAMILIES[name]
    net = bmc.BayesNet(plates={"point": 3})
    net.add("a", bmc.Normal(1.0, 0.5), plates="point")
    net.add("p", bmc.Normal(0.5, 0.3), plates="point")
    net.add("x", make, plates="point")
    evidence: dict[str, Any] = {"x": [values[1]] * 3}
    if not is_seen:
        axis = tuple(range(1, np.ndim(values[1]) + 1))
        net.add("y", lambda x: bmc.Normal(np.sum(x, axis=-1) if axis else x, 1.0), plates="point")
        evidence = {"y": [0.3, 0.1, 0.7]}
    return unconstrained_density(target(net, evidence))


@pytest.mark.parametrize("name", FAMILIES)
def test_every_family_with_parameters_that_move(name: str) -> None:
    """Out of their range, too, where the density is zero."""
    density = over_family(name, True)
    assert check(density, np.random.default_rng(1)) > 0


@pytest.mark.parametrize("name", sorted(FAMILIES.keys() - DISCRETE))
def test_every_family_that_moves(name: str) -> None:
    density = over_family(name, False)
    assert density.names == ("a", "p", "x")
    assert check(density, np.random.default_rng(2)) > 0


SEEDS = range(session.seed(), session.seed() + session.scaled(12, 4))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["continuous", "hybrid", "gaussian"])
def test_random_nets(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    if kind == "gaussian":
        net, _ = random_gaussian_net(seed, plates=True, vectors=True)
        evidence = gaussian_evidence(net, rng)
    else:
        net = random_net(
            seed, hybrid=kind == "hybrid", plates=True, continuous=kind == "continuous"
        )
        evidence = random_evidence(net, rng)
    found = target(net, evidence)
    try:
        density = unconstrained_density(found)
    except UnsupportedError as error:
        known = ("continuous", "noise", "zero", "asks for a plain array")
        assert any(why in str(error) for why in known), error
        return
    assert found.states is not None
    values = {n: found.states[n][0] for n in found.chain if n not in density.names}
    check(density, rng, values)


def hierarchy(is_partial: bool = True) -> Target:
    """Partly seen nodes within the chain and below it, and bounds that depend on parents."""
    net = bmc.BayesNet(plates={"school": 4, "pupil": 6})
    school = np.array([0, 0, 1, 2, 3, 3])
    hole = np.nan if is_partial else 0.4
    net.add("top", bmc.Gamma(9.0, 3.0))
    net.add("scale", lambda top: bmc.Uniform(0.0, top), plates="school")
    net.add("effect", lambda scale: bmc.Normal(1.0, scale), plates="school")
    net.add("x", lambda effect: bmc.Normal(effect[school], 0.7), plates="pupil")
    net.add("y", lambda x, top: bmc.Poisson(np.exp(0.3 * x) * top), plates="pupil")
    evidence = {
        "scale": [0.5, hole, 0.8, hole],
        "x": [0.3, hole, hole, 1.0, -0.4, hole],
        "y": np.ma.array([3, 0, 5, 2, 9, 1], mask=[is_partial * (k == 4) for k in range(6)]),
    }
    return target(net, evidence)


def test_partly_seen_nodes_move_where_they_are_hidden() -> None:
    density = unconstrained_density(hierarchy())
    assert density.labels == [
        "top", "scale[1]", "scale[3]", "effect[0]", "effect[1]", "effect[2]", "effect[3]",
        "x[1]", "x[2]", "x[5]",
    ]  # fmt: skip
    assert check(density, np.random.default_rng(0)) == POINTS
    u = np.random.default_rng(1).normal(size=(2, density.size))
    values = density.constrain(u)
    np.testing.assert_array_equal(values["scale"][:, [0, 2]], [[0.5, 0.8]] * 2)
    np.testing.assert_array_equal(values["x"][:, [0, 3, 4]], [[0.3, 1.0, -0.4]] * 2)
    np.testing.assert_allclose(density.unconstrain(values), u, atol=1e-9)


def test_an_element_that_nobody_saw_does_not_count() -> None:
    """By the formula: five counts of six."""
    density = unconstrained_density(hierarchy())
    u = np.zeros(density.size)
    values = density.constrain(u)
    rate = np.exp(0.3 * values["x"]) * values["top"]
    counts, seen = np.array([3, 0, 5, 2, 9, 1]), np.arange(6) != 4
    top, scale, effect = values["top"], values["scale"], values["effect"]
    wanted = (
        stats.gamma(9.0, scale=1 / 3).logpdf(top)
        - 4 * np.log(top)
        + stats.norm(1.0, scale).logpdf(effect).sum()
        + stats.norm(effect[[0, 0, 1, 2, 3, 3]], 0.7).logpdf(values["x"]).sum()
        + stats.poisson(rate).logpmf(counts)[seen].sum()
        + np.log(top)  # dx / du of an exponential at 0 is x, of a share a quarter of the width
        + 2 * np.log(top / 4)
    )
    np.testing.assert_allclose(density.value(u), wanted, rtol=1e-12)


#: a net with one node x, and values of it
SUPPORTS: dict[str, Any] = {
    "simplex": lambda: bmc.Dirichlet([2.0, 3.0, 4.0]),
    "circle": lambda: bmc.VonMises(1.0, 2.0),
    "upper bound": lambda: bmc.Truncated(bmc.Normal(0.0, 1.0), high=0.5),
    "both bounds": lambda: bmc.Truncated(bmc.Normal(0.0, 1.0), -1.0, 2.0),
    "mirrored": lambda: bmc.Affine(bmc.Gamma(2.0, 1.0), 3.0, -2.0),
    "vector": lambda: bmc.MvNormal(np.zeros(2), [[1.0, 0.3], [0.3, 2.0]]),
}


@pytest.mark.parametrize("name", SUPPORTS)
def test_supports(name: str) -> None:
    net = bmc.BayesNet(plates={"point": 2})
    net.add("x", SUPPORTS[name](), plates="point")
    density = unconstrained_density(target(net, {}, ["x"]))
    assert check(density, np.random.default_rng(3)) == POINTS


def test_bounds_of_every_element() -> None:
    net = bmc.BayesNet(plates={"point": 3})
    net.add("low", bmc.Normal(0.0, 1.0), plates="point")
    net.add("x", bmc.Uniform([0.0, 1.0, 2.0], [1.0, 3.0, 9.0]), plates="point")
    net.add(
        "y",
        lambda low, x: bmc.Truncated(bmc.Normal(x, 1.0), low, np.inf),
        plates="point",
    )
    density = unconstrained_density(target(net, {"y": [np.nan, 2.5, np.nan]}, ["y"]))
    assert density.labels[-2:] == ["y[0]", "y[2]"]
    assert check(density, np.random.default_rng(3)) > 0
    values = density.constrain(np.random.default_rng(0).normal(size=(50, density.size)) * 9)
    assert (values["y"][:, [0, 2]] > values["low"][:, [0, 2]]).all()


def test_far_out_nothing_is_nan() -> None:
    net = bmc.BayesNet(plates={"point": 3})
    net.add("p", bmc.Beta(2.0, 2.0))
    net.add("w", bmc.Dirichlet([1.0, 2.0, 3.0]))
    net.add("tau", bmc.Gamma(0.01, 0.01))
    net.add("cov", bmc.InverseGamma(2.0, 1.0))
    net.add("m", lambda tau: bmc.Normal(0.0, 1 / np.sqrt(tau)))
    net.add("z", lambda m, p: bmc.Bernoulli(special.expit(m) * p), plates="point")
    net.add("y", lambda w, cov: bmc.Normal(w[..., 0], np.sqrt(cov)), plates="point")
    density = unconstrained_density(target(net, {"z": [0, 1, 0], "y": [0.1, 0.2, 0.3]}))
    rng = np.random.default_rng(0)
    for size in (10.0, 50.0, 300.0, 800.0, 1e6):
        u = rng.normal(size=(200, density.size)) * size
        value, slopes = density.with_gradient(u)
        assert not np.isnan(value).any()
        assert np.isfinite(slopes).all()
        assert (value < np.inf).all()


def test_a_saturated_link_keeps_its_digits() -> None:
    """Where 1 - expit(u) rounds to 0 the density goes on."""
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 100.0))
    net.add("y", lambda a: bmc.Bernoulli(special.expit(a)))
    density = unconstrained_density(target(net, {"y": 0}))
    value, slopes = density.with_gradient(np.array([[60.0], [800.0]]))
    np.testing.assert_allclose(
        value, stats.norm(0.0, 100.0).logpdf([60.0, 800.0]) - [60.0, 800.0], rtol=1e-12
    )
    np.testing.assert_allclose(slopes[:, 0], [-1.006, -1.08], rtol=1e-12)


def test_some_nodes_given_the_others() -> None:
    found = hierarchy()
    density = unconstrained_density(found, ["effect", "top"])
    assert density.names == ("top", "effect")
    whole = unconstrained_density(found)
    rng = np.random.default_rng(5)
    u = rng.normal(size=(4, whole.size))
    values = whole.constrain(u)
    own = density.unconstrain(values)
    value, slopes = density.with_gradient(own, values)
    at = [whole.labels.index(label) for label in density.labels]
    # the bounds of scale move with top, so that its free numbers stay where scale moves
    np.testing.assert_allclose(slopes[:, 1:], whole.with_gradient(u)[1][:, at[1:]], rtol=1e-8)
    assert value.shape == (4,)
    with pytest.raises(UnsupportedError, match="needs a value of node"):
        density.value(own)


def test_refusals_name_node_and_cause() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("n", lambda x: bmc.Poisson(np.exp(x)))
    net.add("y", lambda n: bmc.Normal(n, 1.0))
    with pytest.raises(UnsupportedError, match="'n' is discrete"):
        unconstrained_density(target(net, {"y": 1.0}), ["n"])
    net.node(vectorize=True, name="z")(lambda x: bmc.Normal(float(x), 1.0))
    with pytest.raises(UnsupportedError, match="node 'z' is not followed"):
        unconstrained_density(target(net, {"y": 1.0, "z": 1.0}))
    through = bmc.BayesNet()
    through.add("x", bmc.Normal(0.0, 1.0))
    through.node(vectorize=True, name="b")(lambda x: 2 * float(x))
    through.add("y", lambda b: bmc.Normal(b, 1.0))
    with pytest.raises(UnsupportedError, match="node 'y' reads node 'b', which is not followed"):
        unconstrained_density(target(through, {"y": 1.0}))
    only = bmc.BayesNet()
    only.add("a", bmc.Bernoulli(0.5))
    only.add("b", lambda a: bmc.Bernoulli(0.2 + 0.5 * a))
    with pytest.raises(UnsupportedError, match="no hidden node is continuous"):
        unconstrained_density(target(only, {"b": 1}))


def without_jacobian(self: Any, part: Any, above: Any) -> Any:
    value, volume = EXPRESSIONS(self, part, above)
    return value, elementwise(np.multiply, 0.0, volume)


def without_mask(found: Target, terms: Any, above: Any) -> Any:
    return ELEMENTS(found, [replace(term, mask=None) for term in terms], above)


def not_broadcast(found: Target, terms: Any, above: Any) -> Any:
    """The first element in place of all."""

    def first(log: Any) -> Any:
        return unconstrained.pick([log], np.zeros(log.size, int))

    made = ELEMENTS(found, terms, above)
    return [
        Elements(*map(first, m)) if t.name == "x" else m for t, m in zip(terms, made, strict=True)
    ]


def of_stale_data(found: Target, expressions: Any) -> Any:
    stale = {**found.known, "y": found.known["y"] + 1} if "y" in found.known else found.known
    return KNOWN(replace(found, known=stale), expressions)


EXPRESSIONS, ELEMENTS = free_nodes.FreeNode.expressions, unconstrained.elements_of
KNOWN = free_terms.known_values


@pytest.mark.parametrize(
    ("where", "what", "fault", "told"),
    [
        (free_nodes.FreeNode, "expressions", without_jacobian, "change of volume"),
        (unconstrained, "elements_of", without_mask, "'y'"),
        (unconstrained, "elements_of", not_broadcast, "'x'"),
        (free_terms, "known_values", of_stale_data, "'y'"),
    ],
)
def test_faults_are_seen_before_first_use(where: Any, what: str, fault: Any, told: str) -> None:
    with mock.patch.object(where, what, fault), pytest.raises(UnsupportedError, match=told):
        unconstrained_density(hierarchy())


def test_wrong_gradients_fail_the_check() -> None:
    """Negative control of ``check``."""
    density = unconstrained_density(hierarchy())
    wrong = replace(density, slopes=elementwise(np.multiply, 1 + 1e-4, density.slopes))
    with pytest.raises(AssertionError):
        check(wrong, np.random.default_rng(0))
    shifted = replace(density, root=elementwise(np.add, 1e-4, density.root))
    with pytest.raises(AssertionError):
        check(shifted, np.random.default_rng(0))


def test_counts_that_cannot_be_leave_the_slopes_of_others() -> None:
    """``0 log 0`` is nothing, and so is its derivative: nobody at risk, and nobody died."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("n", lambda a: bmc.Poisson(np.array([1.0, 0.0, 2.0]) * np.exp(a)), plates="i")
    density = unconstrained_density(target_of(pose(net, {"n": [3, 0, 1]})))
    _, slope = density.with_gradient(np.array([0.3]))
    assert slope[0] == pytest.approx(4 - 3 * np.exp(0.3) - 0.3)


@pytest.mark.parametrize("bounded", [False, True])
def test_a_derivative_that_is_no_number_anywhere_is_refused(bounded: bool) -> None:
    """Points at which something else cannot be say nothing of it."""
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a: bmc.Normal(a + np.sqrt(np.square(a - a)), 1.0))
    net.add("b", bmc.Normal(0.0, 1.0))
    net.add("z", lambda b: bmc.Uniform(b - 0.5, b + 0.5) if bounded else bmc.Normal(b, 1.0))
    with pytest.raises(UnsupportedError, match="derivative of the log density by 'a' is no number"):
        unconstrained_density(target_of(pose(net, {"y": 1.0, "z": 2.0})))


def of_slices(steps: int) -> Target:
    dbn = bmc.DynamicBayesNet("counts")

    @dbn.static
    def s() -> Any:
        return bmc.HalfNormal(1.0)

    @dbn.node(initial=bmc.Gamma(2.0, 2.0))
    def x(x_prev: Any, s: Any, t: Any) -> Any:
        return bmc.Gamma(2.0 + s, (2.0 + 0.1 * t) / x_prev)

    @dbn.node
    def y(x: Any) -> Any:
        return bmc.Poisson(x)

    counts = np.array([np.nan if t == 3 else t % 4 for t in range(steps)])
    return target(dbn.unroll(steps), dbn.unrolled_evidence({"y": counts}))


def test_slices_are_one_expression() -> None:
    """Constants that differ, and a slice that nobody saw."""
    few, many = (unconstrained_density(of_slices(steps)) for steps in (15, 30))
    assert len(ordered(many.root, many.slopes)) < 1.2 * len(ordered(few.root, few.slopes))
    assert many.labels[:2] == ["s", "x[0]"]
    assert check(few, np.random.default_rng(0)) == POINTS


def test_constants_of_the_first_slice_for_all_are_seen_before_first_use() -> None:
    def stale(*args: Any) -> Any:
        found = STACKED(*args)
        return replace(found, constants={n: v[:1] + 0 * v for n, v in found.constants.items()})

    with mock.patch.object(alike, "stacked_rows", stale):
        with pytest.raises(UnsupportedError, match="the sum of its terms"):
            unconstrained_density(of_slices(15))


STACKED = alike.stacked_rows


def test_points_of_positive_density_are_looked_for() -> None:
    """Numbers that must be in order, as they are once in 720 draws: no point that is tried at first is."""
    net, names = bmc.BayesNet(), [f"c{k}" for k in range(6)]
    for name in names:
        net.add(name, bmc.Normal(0.0, 1.0))

    def in_order(*c: Any) -> Any:
        inside = c[0] < c[1]
        for low, high in zip(c[1:], c[2:], strict=False):
            inside = inside & (low < high)
        return np.where(inside, -np.abs(c[5] - c[0]), -np.inf)

    net.potential("order", in_order, parents=names)
    density = unconstrained_density(target_of(pose(net, {})))
    u = np.arange(6.0)
    value, slope = density.with_gradient(u)
    np.testing.assert_allclose(value, -0.5 * u @ u - 3 * np.log(2 * np.pi) - 5.0)
    np.testing.assert_allclose(slope, -u + np.array([1.0, 0, 0, 0, 0, -1.0]))


@pytest.mark.parametrize("outside", [-1.0, 0.0, [2.0, -3.0]])
def test_values_outside_their_support_are_refused(outside: Any) -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Gamma(1.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    with pytest.raises(EvidenceError, match="that of 'x' is outside, or at its edge"):
        bmc.log_density(net, {"y": 1.0}).unconstrain({"x": outside})


@pytest.mark.parametrize("seen", [-10.0, 10.0])
def test_a_fault_at_the_height_of_a_narrow_density_counts(seen: float) -> None:
    """Points that agree may all lie far from the mode: a climb ends there."""
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a: bmc.Normal(50.0 * a, 0.01))
    plain = unconstrained_check._check_sum

    def doubted(density: UnconstrainedDensity, parts: Any, u: np.ndarray, values: Values) -> None:
        plain(density, parts, u, values)
        if u[0] * seen > 0.5:
            raise UnsupportedError("the log density is off")

    with mock.patch.object(unconstrained_check, "_check_sum", doubted):
        with pytest.raises(UnsupportedError, match="the log density is off"):
            unconstrained_density(target_of(pose(net, {"y": seen})))


@pytest.mark.parametrize("everywhere", [False, True])
def test_what_differs_where_nobody_gets_counts_for_nothing(everywhere: bool) -> None:
    """Rounding that a coarse solver blows up far out; a fault shows where the density is high, too."""
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a: bmc.Normal(50.0 * a, 0.01))
    plain, refused = unconstrained_check._check_sum, 0

    def doubted(density: UnconstrainedDensity, parts: Any, u: np.ndarray, values: Values) -> None:
        nonlocal refused
        plain(density, parts, u, values)
        if everywhere or density.value(u, values) < -1e4:
            refused += 1
            raise UnsupportedError("the log density is off")

    target = target_of(pose(net, {"y": 0.0}))
    with mock.patch.object(unconstrained_check, "_check_sum", doubted):
        if everywhere:
            with pytest.raises(UnsupportedError, match="the log density is off"):
                unconstrained_density(target)
        else:
            assert unconstrained_density(target).size == 1
    assert refused > 1
