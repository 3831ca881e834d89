"""Normal blocks against dense linear algebra, the model's own densities and the Kalman smoother.

The invariance of the kernel is tested in ``test_invariance_conjugate``; nothing here is random but the
models.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc.gibbs import plan_of
from bayesmc.errors import DensityError
from bayesmc.kernels import gaussian_block, gaussian_layout, gaussian_rows
from bayesmc.kernels.gaussian_block import GaussianBlock, gaussian_blocks, solved
from bayesmc.kernels.gaussian_layout import Order
from bayesmc.linalg.patterns import Band, Blocks, Pattern
from bayesmc.network import pose
from bayesmc.network.expressions import Opaque
from bayesmc.structure.target import Target, Values, target_of

CHAINS = 3

# ---- patterns ---------------------------------------------------------------------------------------

PATTERNS: list[Pattern] = [
    Blocks(5, 1), Blocks(4, 3), Band(7, 0), Band(30, 1), Band(40, 6), Band(60, 45), Band(3, 2),
]  # fmt: skip


def stored(pattern: Pattern, lead: int, seed: int = 0) -> np.ndarray:
    """Random positive definite matrices of a pattern."""
    rng = np.random.default_rng(seed)
    row, column = np.indices((pattern.size, pattern.size))
    if isinstance(pattern, Blocks):
        inside = row // pattern.width == column // pattern.width
    else:
        assert isinstance(pattern, Band)
        inside = np.abs(row - column) <= pattern.width
    dense = rng.standard_normal((lead, pattern.size, pattern.size)) * inside
    dense = dense + np.swapaxes(dense, -1, -2)
    dense += np.eye(pattern.size) * (1 + np.abs(dense).sum(axis=-1, keepdims=True))
    at = np.where(inside, pattern.entry(row, column), -1)
    kept = np.zeros((lead, pattern.entries))
    kept[:, at[at >= 0]] = dense[:, at >= 0]
    np.testing.assert_array_equal(pattern.dense(kept), dense)
    return kept


@pytest.mark.parametrize("pattern", PATTERNS, ids=lambda p: f"{type(p).__name__}-{p.size}")
@pytest.mark.parametrize("lead", [1, CHAINS])
def test_patterns_solve_as_dense_matrices_do(pattern: Pattern, lead: int) -> None:
    kept = stored(pattern, lead)
    before = kept.copy()
    dense = pattern.dense(kept)
    root, log_det, wrong = pattern.factored(kept)
    right = np.random.default_rng(1).standard_normal((CHAINS, pattern.size, 2))
    lower = np.linalg.cholesky(dense)
    assert not wrong.any()
    np.testing.assert_array_equal(kept, before)
    np.testing.assert_allclose(log_det, np.linalg.slogdet(dense)[1], rtol=1e-12)
    np.testing.assert_allclose(
        pattern.lower(root, right), np.linalg.solve(lower, right), atol=1e-12
    )
    upper = np.linalg.solve(np.swapaxes(lower, -1, -2), right)
    np.testing.assert_allclose(pattern.upper(root, right), upper, atol=1e-12)


@pytest.mark.parametrize("pattern", PATTERNS, ids=lambda p: f"{type(p).__name__}-{p.size}")
@pytest.mark.parametrize("fault", [-1e3, np.nan, np.inf])
def test_a_chain_without_a_factor_is_flagged_and_the_others_are_not(
    pattern: Pattern, fault: float
) -> None:
    kept = stored(pattern, CHAINS)
    fine = pattern.factored(kept)
    last = np.array(pattern.size - 1)
    kept[1, pattern.entry(last, last)] = fault
    with np.errstate(all="ignore"):
        root, log_det, wrong = pattern.factored(kept)
    assert wrong.tolist() == [False, True, False]
    for chain in (0, 2):
        np.testing.assert_allclose(root[chain], fine[0][chain], rtol=1e-13)
        np.testing.assert_allclose(log_det[chain], fine[1][chain], rtol=1e-13)


@pytest.mark.parametrize("pattern", PATTERNS, ids=lambda p: f"{type(p).__name__}-{p.size}")
def test_what_overflows_in_one_chain_stays_there(pattern: Pattern) -> None:
    root, *_ = pattern.factored(stored(pattern, CHAINS))
    right = np.ones((CHAINS, pattern.size, 1))
    right[1] = np.nan
    for solve in (pattern.lower, pattern.upper):
        found = solve(root, right)
        assert np.isnan(found[1]).any()
        assert np.isfinite(found[[0, 2]]).all()


# ---- blocks against the model's densities -----------------------------------------------------------


def lagged() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A series with two lags, coefficients by number, a hidden scale; some of it is seen."""
    rng = np.random.default_rng(2)
    net = bmc.BayesNet(plates={"k": 3})
    net.add("sd", bmc.LogNormal(0.0, 0.3))
    net.add("level", bmc.Normal(1.0, 2.0))
    evidence: dict[str, Any] = {}
    for t in range(9):
        a, b = rng.normal(size=2)
        if t < 2:
            net.add(f"x[{t}]", lambda level, sd: bmc.Normal(level, sd), plates="k")
        else:
            net.add(
                f"x[{t}]",
                lambda x, z, level, sd, a=a, b=b: bmc.Normal(a * x - b * z + level / 2, sd),
                parents=[f"x[{t - 1}]", f"x[{t - 2}]", "level", "sd"],
                plates="k",
            )
        net.add(f"y[{t}]", lambda x: bmc.Normal(1 - x, 0.7), parents=[f"x[{t}]"], plates="k")
        evidence[f"y[{t}]"] = np.where(rng.random(3) < 0.3, np.nan, rng.normal(size=3))
    evidence["x[4]"] = np.array([np.nan, 0.5, np.nan])
    return net, evidence


def moving() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Position and velocity as a vector, beside a scalar series that both feed; scales differ by slice."""
    matrix = np.array([[1.0, 1.0], [-0.3, 0.9]])
    cov = np.array([[0.5, 0.1], [0.1, 0.4]])
    rng = np.random.default_rng(3)
    net = bmc.BayesNet()
    evidence: dict[str, Any] = {}
    net.add("q", bmc.Gamma(2.0, 1.0))
    net.add("x[0]", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add("v[0]", bmc.Normal(0.0, 1.0))
    for t in range(1, 12):
        net.add(
            f"x[{t}]",
            lambda x, q: bmc.MvNormal(np.matvec(matrix, x), cov * q[..., None, None]),
            parents=[f"x[{t - 1}]", "q"],
        )
        net.add(
            f"v[{t}]",
            lambda v, x, t=t: bmc.Normal(0.5 * v + x[..., 0] - x[..., 1], 1.0 + t / 7),
            parents=[f"v[{t - 1}]", f"x[{t - 1}]"],
        )
        net.add(f"y[{t}]", lambda v: bmc.LogNormal(v / 3, 0.4), parents=[f"v[{t}]"])
        evidence[f"y[{t}]"] = float(np.exp(rng.normal()))
    return net, evidence


def labelled() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Means looked up by hidden labels and by fixed ones, their mean, and a deterministic node between."""
    rng = np.random.default_rng(4)
    group = np.arange(8) % 5
    net = bmc.BayesNet(plates={"k": 5, "i": 8})
    net.add("mu", bmc.Normal(0.5, 1.0))
    net.add("a", lambda mu: bmc.Normal(mu, 0.8), plates="k")
    net.add("b", lambda a: bmc.Normal(a / 2, 0.6), plates="k")
    net.add("twice", lambda b: 2 * b + 1, plates="k")
    net.add("label", bmc.Categorical(np.full(5, 0.2)), plates="i")
    net.add("y", lambda a, label: bmc.Normal(a[label], 0.5), plates="i")
    net.add("z", lambda twice: bmc.Normal(twice[group], 0.9), plates="i")
    return net, {"y": rng.normal(size=8), "z": rng.normal(size=8)}


def through_nodes() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Deterministic nodes in every slice: before the next state, and before what is seen."""
    rng = np.random.default_rng(6)
    net = bmc.BayesNet(plates={"k": 2})
    net.add("sd", bmc.LogNormal(0.0, 0.3))
    net.add("level", bmc.Normal(1.0, 2.0))
    net.add("x[0]", bmc.Normal(0.0, 1.0), plates="k")
    evidence: dict[str, Any] = {}
    for t in range(1, 8):
        net.add(
            f"drift[{t}]",
            lambda x, level, t=t: level + (0.5 + t / 9) * (x - level),
            parents=[f"x[{t - 1}]", "level"],
            plates="k",
        )
        net.add(
            f"x[{t}]",
            lambda drift, sd: bmc.Normal(drift, sd),
            parents=[f"drift[{t}]", "sd"],
            plates="k",
        )
        net.add(f"twice[{t}]", lambda x: 2 * x - 1, parents=[f"x[{t}]"], plates="k")
        net.add(
            f"y[{t}]",
            lambda twice, x, sd: bmc.Normal(twice + 0.3 * x, sd / 2),
            parents=[f"twice[{t}]", f"x[{t}]", "sd"],
            plates="k",
        )
        evidence[f"y[{t}]"] = np.where(rng.random(2) < 0.3, np.nan, rng.normal(size=2))
    evidence["x[5]"] = np.array([np.nan, 0.5])
    return net, evidence


def crossed() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Effects of two groupings by fixed indices, a slope, their sum, and every element's own noise."""
    rng = np.random.default_rng(7)
    first, second, x = np.arange(12) % 4, np.arange(12) // 5, rng.normal(size=12)
    net = bmc.BayesNet(plates={"i": 12, "g": 4, "h": 3})
    net.add("mean", bmc.Normal(0.3, 2.0))
    net.add("tau", bmc.Gamma(3.0, 3.0))
    net.add("w", bmc.Gamma(3.0, 3.0), plates="i")
    net.add("a", lambda mean, tau: bmc.Normal(mean, tau**-0.5), plates="g")
    net.add("b", bmc.Normal(0.0, 1.0), plates="h")
    net.add(
        "y",
        lambda a, b, mean, w: bmc.Normal(a[first] + b[second] + mean * x, w**-0.5),
        plates="i",
    )
    net.add("total", lambda a: bmc.Normal(a.sum(), 0.5))
    return net, {"y": np.where(np.arange(12) == 3, np.nan, rng.normal(size=12)), "total": 1.0}


def unfollowed() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A prior whose mean and scale are computed by what shows no expression."""
    net = bmc.BayesNet(plates={"k": 4})
    cosine = np.vectorize(math.cos, otypes=[float])
    net.add("h", bmc.Normal(0.0, 1.0))
    net.add("twice", lambda h: 2 * cosine(h))
    net.add("x", lambda h, twice: bmc.Normal(cosine(h) + twice, 1.5 + cosine(h)), plates="k")
    net.add("z", bmc.Normal(0.0, 1.0), plates="k")
    net.add("v", lambda z: bmc.Normal(z, 0.5), plates="k")
    for t in range(6):
        net.add(f"y[{t}]", lambda x, z, v: bmc.Normal(x + z - v / 2, 0.5), plates="k")
    return net, {f"y[{t}]": np.array([0.3, -1.0, 2.0, 0.1]) * t for t in range(6)}


def sparse(seed: int) -> Callable[[], tuple[bmc.BayesNet, dict[str, Any]]]:
    def made() -> tuple[bmc.BayesNet, dict[str, Any]]:
        """Every node has some earlier ones as parents, near ones mostly; noise differs by chain."""
        rng = np.random.default_rng(seed)
        net = bmc.BayesNet()
        net.add("tau", bmc.Gamma(3.0, 3.0))
        evidence = {}
        for t in range(30):
            near = [f"x[{s}]" for s in range(max(t - 4, 0), t) if s == t - 1 or rng.random() < 0.4]
            net.add(f"x[{t}]", *linear(rng.normal(size=len(near)), near))
            if t == 29 or rng.random() < 0.6:
                net.add(f"y[{t}]", lambda x: bmc.Normal(2 * x, 0.5), parents=[f"x[{t}]"])
                evidence[f"y[{t}]"] = rng.normal()
        return net, evidence

    return made


def linear(weights: np.ndarray, parents: list[str]) -> tuple[Any, ...]:
    def function(tau: Any, *values: Any) -> Any:
        mean = 0.3
        for w, v in zip(weights, values, strict=True):
            mean = mean + w * v
        return bmc.Normal(mean, tau**-0.5)

    names = ["tau", *(f"p{i}" for i in range(len(parents)))]
    source = f"lambda {', '.join(names)}: function({', '.join(names)})"
    return eval(source, {"function": function}), ["tau", *parents]


NETS = {
    "lagged": lagged,
    "moving": moving,
    "labelled": labelled,
    "through nodes": through_nodes,
    "crossed": crossed,
    "unfollowed": unfollowed,
} | {f"sparse {seed}": sparse(seed) for seed in range(3)}


def posed(make: Callable[[], tuple[bmc.BayesNet, dict[str, Any]]]) -> tuple[Target, Values]:
    """The target of a net with its evidence, and some states of it."""
    net, evidence = make()
    target = target_of(pose(net, evidence))
    rng = np.random.default_rng(5)
    values = dict(target.known)
    for name in target.chain:
        node = target.model[name]
        shape = (CHAINS, *node.value_shape)
        if node.domain is not None:
            values[name] = rng.integers(node.domain.size, size=shape).astype(node.domain.dtype)
        else:
            values[name] = rng.uniform(0.5, 1.5, size=shape)
        seen = target.seen(name)
        if seen is not None:
            assert seen.mask is not None
            values[name] = np.where(seen.mask, seen.value, values[name])
    target.refresh(values, target.chain)
    return target, values


def the_block(target: Target) -> GaussianBlock:
    (block,) = gaussian_blocks(target, target.chain)
    return block


def by_differences(
    target: Target, block: GaussianBlock, values: Values
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Precision, linear term and constant of the log density, from its values at 0, e_i and e_i + e_j."""
    layout = block.layout
    size = layout.size
    i, j = np.triu_indices(size)
    points = np.concatenate([np.zeros((1, size)), np.eye(size), np.eye(size)[i] + np.eye(size)[j]])
    lead = (len(points), CHAINS)
    state = {
        n: np.broadcast_to(v, (len(points), *v.shape)).reshape(-1, *v.shape[1:])
        for n, v in values.items()
        if n in (*target.chain, *target.links)
    }
    state = {**values, **state}
    joined = np.broadcast_to(points[:, None], (*lead, size)).reshape(-1, size)
    free = free_of(block)
    for name in block.names:
        start, (count, _) = layout.components.start[name], layout.components.size_of(name)
        at = slice(start, start + count)
        part = np.where(free[at], joined[:, at], state[name].reshape(-1, count))
        state[name] = part.reshape(state[name].shape)
    target.refresh(state, block.names)
    log = np.asarray(target.log_density(state, block.terms)).reshape(lead)
    zero, one, two = log[0], log[1 : size + 1], log[size + 1 :]
    precision = np.zeros((CHAINS, size, size))
    precision[:, i, j] = precision[:, j, i] = -(two - one[i] - one[j] + zero).T
    linear = (one - zero).T + np.linalg.diagonal(precision) / 2
    return precision, linear, zero


def free_of(block: GaussianBlock) -> np.ndarray:
    """Components, in natural order, that are free."""
    components = block.layout.components
    return np.ones(components.size, bool) if components.free is None else components.free


def law_of(block: GaussianBlock, values: Values) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, covariance and log determinant of what the block draws, free components in natural order."""
    layout = block.layout
    sums = block._summed(values, CHAINS)
    mean, log_det, bad = solved(layout, sums, None)
    assert not bad.any()
    steps = [
        solved(layout, sums, np.broadcast_to(noise, mean.shape))[0] - mean
        for noise in np.eye(layout.size)
    ]
    free = free_of(block)
    roots = np.stack(steps)[:, :, layout.position][..., free]
    return mean[:, layout.position][:, free], np.einsum("kci,kcj->cij", roots, roots), log_det


def replaced_data(target: Target, block: GaussianBlock, values: Values) -> Values:
    """Other data, as far as the block's terms have any."""
    seen = [t.name for t in block.terms if t.name not in target.chain]
    return {**values, **{n: values[n] + 0.3 for n in seen}}


def each_order(block: GaussianBlock) -> list[Order]:
    """All ways in which the block may be eliminated."""
    components = block.layout.components
    local = gaussian_layout._local(components)
    dense = Order(np.arange(components.size), Blocks(0, 0))
    return [dense, *([local] if local else []), *gaussian_layout._bands(components)]


@pytest.mark.parametrize("name", NETS)
def test_every_order_gives_the_law_that_the_densities_give(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, values = posed(NETS[name])
    orders = each_order(the_block(target))
    assert any(isinstance(o.first, Band) for o in orders)
    laws = []
    for order in orders:
        monkeypatch.setattr(gaussian_layout, "order_of", lambda components, order=order: order)
        block = the_block(target)
        assert block.layout.first is order.first
        # twice: the second time what stands is not evaluated again
        for _ in range(2):
            laws.append(law_of(block, values))
        integral = block.log_integral(values, CHAINS)
    precision, line, constant = by_differences(target, block, values)
    free = free_of(block)
    precision, line = precision[:, free][:, :, free], line[:, free]
    mean = np.linalg.solve(precision, line[..., None])[..., 0]
    cov, log_det = np.linalg.inv(precision), np.linalg.slogdet(precision)[1]
    for found in laws:
        for part, first in zip(found, laws[0], strict=True):
            np.testing.assert_allclose(part, first, atol=1e-10, rtol=1e-10)
        np.testing.assert_allclose(found[0], mean, atol=1e-8)
        np.testing.assert_allclose(found[1], cov, atol=1e-8)
        np.testing.assert_allclose(found[2], log_det, atol=1e-8)
    whole = constant + 0.5 * np.vecdot(line, mean) - 0.5 * log_det
    np.testing.assert_allclose(integral - integral[0], whole - whole[0], atol=1e-8)


@pytest.mark.parametrize("name", ["lagged", "moving", "through nodes", "sparse 0"])
def test_a_term_that_is_forgotten_shows(name: str) -> None:
    """The negative control of the test above."""
    target, values = posed(NETS[name])
    block = the_block(target)
    precision, *_ = by_differences(target, block, values)
    free = free_of(block)
    cov = np.linalg.inv(precision[:, free][:, :, free])
    np.testing.assert_allclose(law_of(block, values)[1], cov, atol=1e-8)
    forgotten = next(part for part in block.parts if part.names[0] not in block.names)
    block.parts = [part for part in block.parts if part is not forgotten]
    block._standing = None
    assert np.abs(law_of(block, values)[1] - cov).max() > 1e-3


@pytest.mark.parametrize("name", ["lagged", "moving", "labelled", "crossed"])
def test_pairs_that_are_too_many_are_summed_bit_by_bit(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, values = posed(NETS[name])
    at_once = law_of(the_block(target), values)
    monkeypatch.setattr(gaussian_rows, "_MOST_PAIRS", 8)
    block = the_block(target)
    for found in (law_of(block, values), law_of(block, values)):
        for a, b in zip(found, at_once, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-10)
    cut = [c for p in block.parts if (c := p._kept.get("columns")) and c.pair_spots is None]
    assert cut or name == "labelled"


@pytest.mark.parametrize("name", ["lagged", "labelled", "crossed"])
def test_data_that_are_replaced_are_read_anew(name: str) -> None:
    target, values = posed(NETS[name])
    block = the_block(target)
    before = [law_of(block, values) for _ in range(2)][1]
    other = replaced_data(target, block, values)
    precision, line, _ = by_differences(target, block, other)
    free = free_of(block)
    precision, line = precision[:, free][:, :, free], line[:, free]
    mean = np.linalg.solve(precision, line[..., None])[..., 0]
    np.testing.assert_allclose(law_of(block, other)[0], mean, atol=1e-8)
    assert np.abs(before[0] - mean).max() > 1e-3  # the control: the old data say something else
    np.testing.assert_array_equal(law_of(block, values)[0], before[0])


@pytest.mark.parametrize("name", NETS)
def test_stored_precisions_are_those_of_dense_matrices(name: str) -> None:
    target, values = posed(NETS[name])
    for order in each_order(the_block(target)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(gaussian_layout, "order_of", lambda components, order=order: order)
            block = the_block(target)
        layout = block.layout
        sums = block._summed(values, CHAINS)
        dense = layout.dense(layout.with_units(sums.precision))
        mean, log_det, _ = solved(layout, sums, None)
        expected = np.linalg.solve(dense, sums.linear[..., None])[..., 0]
        np.testing.assert_allclose(mean, expected, atol=1e-10)
        np.testing.assert_allclose(log_det, np.linalg.slogdet(dense)[1], atol=1e-10)
        free = free_of(block)[np.argsort(layout.position)]
        again = layout.joined(layout.split(mean, values))
        np.testing.assert_allclose(again, np.where(free, mean, 0.0))


# ---- chains -----------------------------------------------------------------------------------------


def walk() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev + 0.1, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


def pair() -> bmc.DynamicBayesNet:
    dbn = bmc.DynamicBayesNet()
    dbn.add("v", lambda v_prev: bmc.Normal(0.9 * v_prev, 0.3), initial=bmc.Normal(0.0, 1.0))
    dbn.add(
        "x", lambda x_prev, v_prev: bmc.Normal(x_prev + v_prev, 0.2), initial=bmc.Normal(0.0, 1.0)
    )
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


def vector() -> bmc.DynamicBayesNet:
    matrix = np.array([[1.0, 1.0], [0.0, 0.9]])
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev: bmc.MvNormal(np.matvec(matrix, x_prev), 0.1 * np.eye(2)),
        initial=bmc.MvNormal(np.zeros(2), np.eye(2)),
    )
    dbn.add("y", lambda x: bmc.Normal(x[..., 0], 1.0))
    return dbn


CHAIN_MODELS = {
    "walk": (walk, 1, ("x",)),
    "pair": (pair, 3, ("x", "v")),
    "vector": (vector, 3, ("x",)),
}


@pytest.mark.parametrize("name", CHAIN_MODELS)
@pytest.mark.parametrize("steps", [12, 200])
def test_the_mean_of_a_chain_is_that_of_the_kalman_smoother(name: str, steps: int) -> None:
    make, width, states = CHAIN_MODELS[name]
    dbn = make()
    seen = dbn.sample(steps, 1, rng=0)["y"][0].copy()
    seen[3:6] = np.nan
    exact = bmc.smooth(dbn, {"y": seen}, engine=bmc.KalmanFilter())
    problem = pose(dbn.unroll(steps), dbn.unrolled_evidence({"y": seen}))
    (block,) = plan_of(problem).kernels
    assert isinstance(block, GaussianBlock)
    hidden = [f"{s}[{t}]" for s in states for t in range(steps)]
    # nothing observed depends on the last velocity
    assert set(block.names) == set(hidden) - {f"v[{steps - 1}]"}
    if steps == 200:
        assert isinstance(block.layout.first, Band)
        assert block.layout.first.width <= width
        assert block.layout.dg == 0
        assert len(block.parts) <= 8  # of a thousand slices, too: like terms are one
    zeros = {n: np.zeros((1, *block.target.model[n].value_shape)) for n in block.names}
    values = {**block.target.known, **zeros}
    mean, *_ = solved(block.layout, block._summed(values, 1), None)
    found = block.layout.split(mean, values)
    for s in states:
        smoothed = np.asarray(exact.mean(s))
        inside = [f"{s}[{t}]" for t in range(steps) if f"{s}[{t}]" in found]
        together = np.concatenate([found[n] for n in inside])
        smoothed = smoothed[: len(inside)]
        np.testing.assert_allclose(together, smoothed, atol=1e-9)
        # the control: smoothing is not what the filter says
        filtered = np.asarray(bmc.filter(dbn, {"y": seen}, engine=bmc.KalmanFilter()).mean(s))
        assert np.abs(together - filtered[: len(inside)]).max() > 1e-2


def test_priors_that_cannot_be_followed_belong_to_blocks() -> None:
    target, _ = posed(unfollowed)
    assert isinstance(target.terms["x"].read, Opaque)
    assert "x" in the_block(target).names


def test_like_terms_are_one_part() -> None:
    target, _ = posed(lagged)
    groups = [part.names for part in the_block(target).parts if len(part.names) > 1]
    assert sorted(groups) == [
        ("x[0]", "x[1]"),
        tuple(f"x[{t}]" for t in range(2, 9)),  # x[4], of which one element is seen, among them
        tuple(f"y[{t}]" for t in range(9)),
    ]


def test_like_terms_through_deterministic_nodes_are_one_part() -> None:
    target, _ = posed(through_nodes)
    parts = {part.names for part in the_block(target).parts}
    assert parts >= {tuple(f"{what}[{t}]" for t in range(1, 8)) for what in "xy"}


def test_slopes_that_change_are_not_kept() -> None:
    """Through deterministic nodes, and by a hidden number: the law is right in every sweep."""

    def made() -> tuple[bmc.BayesNet, dict[str, Any]]:
        net = bmc.BayesNet()
        net.add("slope", bmc.LogNormal(0.0, 1.0))
        net.add("x[0]", bmc.Normal(0.0, 1.0))
        for t in range(1, 6):
            net.add(f"m[{t}]", lambda x, slope: slope * x, parents=[f"x[{t - 1}]", "slope"])
            net.add(f"x[{t}]", lambda m: bmc.Normal(m, 0.5), parents=[f"m[{t}]"])
        net.add("y", lambda x: bmc.Normal(x, 0.5), parents=["x[5]"])
        return net, {"y": 1.0}

    target, values = posed(made)
    names = tuple(f"x[{t}]" for t in range(6))
    block = GaussianBlock(target, names)
    for factor in (1.0, 1.5):
        values = {**values, "slope": factor * values["slope"]}
        precision, linear, _ = by_differences(target, block, values)
        mean, cov, _ = law_of(block, values)
        np.testing.assert_allclose(cov, np.linalg.inv(precision), atol=1e-8)
        np.testing.assert_allclose(
            mean, np.linalg.solve(precision, linear[..., None])[..., 0], atol=1e-8
        )


def test_what_all_slices_share_is_no_part_of_the_band() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("mu", bmc.Normal(0.0, 2.0))
    dbn.add(
        "x",
        lambda x_prev, mu: bmc.Normal(mu + 0.9 * (x_prev - mu), 0.5),
        initial=lambda mu: bmc.Normal(mu, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    seen = dbn.sample(100, 1, rng=0)["y"][0]
    (block,) = plan_of(pose(dbn.unroll(100), dbn.unrolled_evidence({"y": seen}))).kernels
    assert isinstance(block, GaussianBlock)
    assert isinstance(block.layout.first, Band)
    assert (block.layout.cut, block.layout.width, block.layout.dg) == (100, 1, 1)


def test_small_blocks_stay_dense_and_wide_ones_are_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    target, _ = posed(lagged)
    monkeypatch.setattr(gaussian_layout, "_SMALL", 100)
    (block,) = gaussian_blocks(target, target.chain)
    assert block.layout.cut == 0
    monkeypatch.setattr(gaussian_block, "MAX_DENSE", 15)
    halves = gaussian_blocks(target, target.chain)
    assert len(halves) > 1
    assert sorted(n for b in halves for n in b.names) == sorted(block.names)
    assert all(b.layout.size <= 15 for b in halves)


def test_a_factor_is_kept_while_the_precision_stands() -> None:
    target, values = posed(moving)
    block = the_block(target)
    rng = np.random.default_rng(0)
    block.step(values, {}, rng, False)
    first = block._last
    block.step({**values, "v[0]": values["v[0]"] + 1}, {}, rng, False)
    assert block._last is first
    block.step({**values, "q": 2 * values["q"]}, {}, rng, False)
    assert block._last is not first


def test_the_node_at_fault_is_named() -> None:
    net = bmc.BayesNet()
    net.add("sd", bmc.HalfNormal(1.0))
    net.add("x[0]", bmc.Normal(0.0, 1.0))
    for t in range(1, 8):
        net.add(f"x[{t}]", lambda x, s: bmc.Normal(x, s), parents=[f"x[{t - 1}]", "sd"])
        net.add(f"y[{t}]", lambda x: bmc.Normal(x, 1.0), parents=[f"x[{t}]"])
    target, values = posed(lambda: (net, {f"y[{t}]": 0.1 for t in range(1, 8)}))
    block = the_block(target)
    values["sd"] = np.array([1.0, 0.0, 1.0])
    with marking_invalid(), np.errstate(all="ignore"):
        with pytest.raises(DensityError, match=r"x\[1\].*scale"):
            block.step(values, {}, np.random.default_rng(0), False)
        log = block.log_integral(values, CHAINS)
    assert np.isfinite(log).tolist() == [True, False, True]
