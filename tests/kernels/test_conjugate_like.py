"""Like children of conjugate nodes as one: against one by one, and against a grid."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc.gibbs import plan_of
from bayesmc.engines.mcmc.sweep import SweepSampler
from bayesmc.errors import BayesmcError
from bayesmc.kernels import conjugate_children
from bayesmc.kernels.collapsed import CollapsedBlock, governing
from bayesmc.kernels.conjugate import Conjugate, conjugate_kernel
from bayesmc.kernels.conjugate_children import children_of
from bayesmc.kernels.gaussian_block import GaussianBlock
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Values, target_of
from tests.kernels.wrong_naturals import with_naturals
from tests.structure.test_stacked import CHAINS, a_state

DATA = np.random.default_rng(31)
#: net, evidence, and for each node how many children are one
Asked = tuple[Any, dict[str, Any], dict[str, list[int]]]
STEPS = 7


def autoregression() -> Asked:
    """Hidden children whose coefficients change, and a mean whose slopes do not."""
    net = bmc.BayesNet()
    net.add("phi", bmc.Normal(0.0, 1.0))
    net.add("tau", bmc.Gamma(2.0, 1.0))
    net.add("bias", bmc.Normal(0.0, 2.0))
    net.add("noise", bmc.InverseGamma(3.0, 1.0))
    net.add("x[0]", bmc.Normal(0.0, 1.0))
    for t in range(1, STEPS):
        net.add(
            f"x[{t}]",
            lambda x, phi, tau: bmc.Normal(phi * x, tau**-0.5),
            parents=[f"x[{t - 1}]", "phi", "tau"],
        )
    for t in range(STEPS):
        net.add(
            f"y[{t}]",
            lambda x, bias, noise, t=t: bmc.Normal(x - (1 + t) * bias, np.sqrt(noise) * (1 + t)),
            parents=[f"x[{t}]", "bias", "noise"],
        )
    evidence: dict[str, Any] = {f"y[{t}]": DATA.normal() for t in range(STEPS)}
    return net, evidence, {"phi": [6], "tau": [6], "bias": [7], "noise": [7]}


def markov() -> Asked:
    """Rows of a transition matrix and means by label, some children known and one label seen."""
    net = bmc.BayesNet(plates={"state": 3})
    net.add("row", bmc.Dirichlet(np.ones(3)), plates="state")
    net.add("mu", bmc.Normal(0.0, 2.0), plates="state")
    net.add("v", bmc.InverseGamma(3.0, 1.0), plates="state")
    net.add("p", bmc.Beta(1.0, 1.0))
    net.add("z[0]", bmc.Categorical(np.ones(3) / 3))
    for t in range(1, STEPS):
        net.add(
            f"z[{t}]",
            lambda before, row: bmc.Categorical(row[before]),
            parents=[f"z[{t - 1}]", "row"],
        )
    for t in range(STEPS):
        net.add(
            f"y[{t}]",
            lambda z, mu, v: bmc.Normal(2 * mu[z] + 1, np.sqrt(v[z])),
            parents=[f"z[{t}]", "mu", "v"],
        )
        net.add(f"b[{t}]", lambda p: bmc.Bernoulli(p), parents=["p"])
        net.add(f"w[{t}]", lambda b: bmc.Normal(b, 1.0), parents=[f"b[{t}]"])
    evidence: dict[str, Any] = {f"y[{t}]": DATA.normal() for t in range(STEPS)}
    evidence |= {f"w[{t}]": DATA.normal() for t in range(STEPS)} | {"b[2]": 1, "z[3]": 2}
    # z[4] looks up a row that never changes
    return net, evidence, {"row": [5, 1], "mu": [7], "v": [7], "p": [7]}


def plates() -> Asked:
    """Children in plates, missing elements, an index that never changes, a node that is partly seen."""
    net = bmc.BayesNet(plates={"i": 4, "k": 3})
    site = np.array([0, 2, 2, 1])
    net.add("rate", bmc.Gamma(2.0, 1.0), plates="k")
    net.add("effect", bmc.Normal(0.0, 1.0), plates="k")
    net.add("tau", bmc.Gamma(2.0, 1.0), plates="i")
    evidence: dict[str, Any] = {}
    for t in range(5):
        net.add(
            f"n[{t}]",
            lambda rate, t=t: bmc.Poisson(rate * (1 + t)),
            parents=["rate"],
            plates=("i", "k"),
        )
        net.add(
            f"y[{t}]",
            lambda effect, tau, t=t: bmc.Normal(effect[site] * (1 + t), tau**-0.5),
            parents=["effect", "tau"],
            plates="i",
        )
        counts = np.ma.masked_array(DATA.poisson(3.0, (4, 3)), DATA.random((4, 3)) < 0.3)
        evidence[f"n[{t}]"] = counts
        evidence[f"y[{t}]"] = np.where(DATA.random(4) < 0.3, np.nan, DATA.normal(size=4))
    evidence["n[1]"] = DATA.poisson(3.0, (4, 3))  # of one nothing is missing
    evidence["tau"] = np.array([1.0, np.nan, np.nan, 0.5])
    return net, evidence, {"rate": [5], "effect": [5], "tau": [5]}


def players() -> Asked:
    """Several elements of the node in each child: classes of elements."""
    net = bmc.BayesNet(plates={"player": 5, "game": 4})
    first, second = np.array([0, 1, 2, 3]), np.array([1, 2, 3, 4])
    net.add("skill", bmc.Normal(0.0, 1.0), plates="player")
    for t in range(4):
        net.add(
            f"won[{t}]",
            lambda skill, t=t: bmc.Normal(skill[first] - skill[second], 1.0 + t),
            parents=["skill"],
            plates="game",
        )
    return net, {f"won[{t}]": DATA.normal(size=4) for t in range(4)}, {"skill": [4]}


def vectors() -> Asked:
    """Vectors and their covariance, coefficients, and children of two kinds."""
    net = bmc.BayesNet()
    design = DATA.normal(size=(STEPS, 2))
    net.add("cov", bmc.InverseWishart(5.0, np.eye(2)))
    net.add("beta", bmc.MvNormal(np.zeros(2), 2 * np.eye(2)))
    net.add("sd", bmc.Uniform(0.0, 5.0))
    net.add("x[0]", bmc.MvNormal(np.zeros(2), np.eye(2)))
    for t in range(1, STEPS):
        net.add(
            f"x[{t}]",
            lambda x, cov, beta: bmc.MvNormal(0.9 * x + beta, cov),
            parents=[f"x[{t - 1}]", "cov", "beta"],
        )
    for t in range(STEPS):
        net.add(
            f"y[{t}]",
            lambda x, beta, sd, row=design[t]: bmc.Normal(x[..., 0] + np.vecdot(beta, row), sd),
            parents=[f"x[{t}]", "beta", "sd"],
        )
    evidence: dict[str, Any] = {f"y[{t}]": DATA.normal() for t in range(STEPS)}
    return net, evidence, {"cov": [6], "beta": [6, 7], "sd": [7]}


def through_nodes() -> Asked:
    """One deterministic node for all, and one for each."""
    net = bmc.BayesNet(plates={"i": 2})
    net.add("tau", bmc.Gamma(2.0, 1.0), plates="i")
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("sd", lambda tau: tau**-0.5, plates="i")
    for t in range(5):
        net.add(f"m[{t}]", lambda a, t=t: a * (1.0 + t), parents=["a"])
        net.add(
            f"y[{t}]",
            lambda m, sd: bmc.Normal(m - 1.0, 2 * sd),
            parents=[f"m[{t}]", "sd"],
            plates="i",
        )
    return net, {f"y[{t}]": DATA.normal(size=2) for t in range(5)}, {"tau": [5], "a": [5]}


CASES = [autoregression, markov, plates, players, vectors, through_nodes]
NODES = [(case, name) for case in CASES for name in case()[2]]


def posed(case: Callable[[], Asked]) -> tuple[Target, dict[str, list[int]]]:
    net, evidence, expected = case()
    return target_of(pose(net, evidence)), expected


def kernel_of(target: Target, name: str, debug: bool = False) -> Conjugate:
    kernel = conjugate_kernel(Blanket(target, name), debug=debug)
    assert isinstance(kernel, Conjugate), kernel
    return kernel


def state(target: Target, seed: int) -> Values:
    """A state in which what was seen stays, and matrices are covariances."""
    values = a_state(target, seed)
    for name in target.chain:
        seen = target.seen(name)
        if seen is not None:
            values[name] = np.where(seen.mask, seen.value, values[name])
        support = target.model[name].support
        if support is not None and support.kind == "interval" and np.all(support.high == 1.0):
            values[name] = values[name] / (1.0 + values[name])
        if target.model[name].event_shape == (2, 2):
            values[name] = values[name] @ np.matrix_transpose(values[name]) + np.eye(2)
    target.refresh(values, target.chain)
    return values


def sizes(target: Target, name: str) -> list[int]:
    found = children_of(Blanket(target, name))
    assert isinstance(found, list)
    return [len(c.terms) for c in found]


def worst_difference(kernel: Conjugate, other: Conjugate, values: Values) -> float:
    """Between natural parameters, over the larger ones."""
    worst = 0.0
    with marking_invalid(), np.errstate(all="ignore"):
        for ours, theirs in zip(kernel.forms, other.forms, strict=True):
            for a, b in zip(ours(values)[0], theirs(values)[0], strict=True):
                worst = max(worst, float(np.max(np.abs(a - b) / (np.abs(a) + np.abs(b) + 1e-9))))
    return worst


def apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if no children were alike."""
    monkeypatch.setattr(conjugate_children, "_joined", lambda blanket, terms: None)


@pytest.mark.parametrize(("case", "name"), NODES, ids=lambda c: getattr(c, "__name__", c))
def test_what_children_add(
    case: Callable[[], Asked], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, expected = posed(case)
    kernel = kernel_of(target, name)
    assert sum(sizes(target, name)) == sum(expected[name])
    assert len(sizes(target, name)) <= 1 + len(expected[name])
    apart(monkeypatch)
    other = kernel_of(target, name)
    for seed in range(3):
        assert worst_difference(kernel, other, state(target, seed)) < 1e-12


@pytest.mark.parametrize(("case", "name"), NODES, ids=lambda c: getattr(c, "__name__", c))
def test_draws_against_the_densities(case: Callable[[], Asked], name: str) -> None:
    """With ``debug`` every draw is compared with the densities of all children, one by one."""
    target, _ = posed(case)
    kernel = kernel_of(target, name, debug=True)
    values = state(target, 0)
    rng = np.random.default_rng(1)
    with marking_invalid(), np.errstate(all="ignore"):
        for _ in range(3):
            new, _ = kernel.step(values, {}, rng, False)
            assert new[name].shape == values[name].shape
            values |= new
            target.refresh(values, (name,))


def test_the_wrong_neighbours_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: values of other slices in their places, and the numbers of one for all."""
    target, _ = posed(autoregression)
    values = state(target, 1)
    right = conjugate_children.like_roots

    def wrong(terms: Any) -> Any:
        found = right(terms)
        first, *rest = found.leaves
        mixed = [(*a[:-1], b[-1]) for a, b in zip(rest, reversed(rest), strict=True)]
        same = {k: np.broadcast_to(v[:1], v.shape) for k, v in found.constants.items()}
        return dataclasses.replace(found, leaves=(first, *mixed), constants=same)

    kernels = {name: kernel_of(target, name) for name in ("phi", "tau", "bias")}
    monkeypatch.setattr(conjugate_children, "like_roots", wrong)
    for name, kernel in kernels.items():
        assert worst_difference(kernel, kernel_of(target, name), values) > 1e-3, name


def test_functions_are_not_called() -> None:
    calls = []

    def emission(x: Any, tau: Any) -> Any:
        calls.append(1)
        return bmc.Normal(x, tau**-0.5)

    net = bmc.BayesNet()
    net.add("tau", bmc.Gamma(2.0, 1.0))
    for t in range(30):
        net.add(f"x[{t}]", bmc.Laplace(0.0, 1.0))
        net.add(f"y[{t}]", emission, parents=[f"x[{t}]", "tau"])
    target = target_of(pose(net, {f"y[{t}]": float(t) for t in range(30)}))
    kernel = kernel_of(target, "tau")
    values = state(target, 0)
    calls.clear()
    kernel.full_conditional(values)
    assert not calls


def test_children_of_different_powers_are_no_group() -> None:
    """The same function up to a number, which is the power of the node."""
    net = bmc.BayesNet()
    net.add("tau", bmc.Gamma(2.0, 1.0))
    for t in range(8):
        power = -0.5 if t % 2 else -1.0
        net.add(
            f"y[{t}]",
            lambda tau, power=power: bmc.Normal(0.0, tau**power),
            parents=["tau"],
        )
    target = target_of(pose(net, {f"y[{t}]": 0.5 for t in range(8)}))
    assert "has the power 2 of it" in str(conjugate_kernel(Blanket(target, "tau")))


def test_an_error_names_the_child_at_fault() -> None:
    net = bmc.BayesNet()
    net.add("mu", bmc.Normal(0.0, 1.0))
    for t in range(5):
        net.add(f"s[{t}]", bmc.Normal(2.0, 0.1))
        net.add(f"y[{t}]", lambda mu, s: bmc.Normal(mu, s), parents=["mu", f"s[{t}]"])
    target = target_of(pose(net, {f"y[{t}]": 0.0 for t in range(5)}))
    kernel = kernel_of(target, "mu")
    assert sizes(target, "mu") == [5]
    values = {**target.known, "mu": np.zeros(2)}
    values |= {f"s[{t}]": np.array([1.0, -1.0 if t == 3 else 2.0]) for t in range(5)}
    with marking_invalid(), np.errstate(all="ignore"):
        with pytest.raises(BayesmcError, match=r"node 'y\[3\]'"):
            kernel.step(values, {}, np.random.default_rng(0), False)


# ---- scales with a block integrated out --------------------------------------------------------------


def test_a_collapsed_density_is_the_same_at_one_candidate_and_at_several() -> None:
    """A node between scale and block, and children outside of the block, asked in both ways."""
    net = bmc.BayesNet()
    net.add("tau", bmc.Gamma(2.0, 1.0))
    net.add("other", bmc.Gamma(2.0, 1.0))
    net.add("x[0]", bmc.Normal(0.0, 1.0))
    for t in range(1, 6):
        net.add(f"x[{t}]", lambda x, tau: bmc.Normal(x, tau**-0.5), parents=[f"x[{t - 1}]", "tau"])
        net.add(f"m[{t}]", lambda x, tau, other: x * tau + other,
                parents=[f"x[{t}]", "tau", "other"])  # fmt: skip
        net.add(f"twice[{t}]", lambda tau, t=t: tau * (1 + t), parents=["tau"])
        net.add(f"y[{t}]", lambda m: bmc.Normal(m, 0.7), parents=[f"m[{t}]"])
        net.add(f"w[{t}]", lambda twice: bmc.Exponential(twice), parents=[f"twice[{t}]"])
    evidence: dict[str, Any] = {f"y[{t}]": 0.3 * t for t in range(1, 6)}
    evidence |= {f"w[{t}]": 0.2 * t for t in range(1, 6)}
    target = target_of(pose(net, evidence))
    names = tuple(f"x[{t}]" for t in range(6))
    blankets = {n: Blanket(target, n) for n in target.chain}
    block = GaussianBlock(target, {n: blankets[n] for n in names})
    scales = governing(target, block, blankets)
    assert set(scales) == {"tau", "other"}
    kernel = CollapsedBlock(target, block, scales, {})
    values = state(target, 2)
    tried = np.random.default_rng(3).gamma(2.0, size=(3, CHAINS))
    with marking_invalid(), np.errstate(all="ignore"):
        for name in scales:
            found = kernel._log(values, name, tried)
            for k in range(3):
                alone = {**values, name: tried[k]}
                target.refresh(alone, (name,))
                expected = block.log_integral(alone, CHAINS) + target.terms[name].log(alone)
                inside = {t.name for t in block.terms}
                for child in scales[name].children:
                    if child.term.name not in inside:
                        expected = expected + scales[name].child_log(child, alone)
                np.testing.assert_allclose(found[k], expected, rtol=1e-10)
                np.testing.assert_allclose(
                    kernel._log(values, name, tried[k]), expected, rtol=1e-10
                )


# ---- the posterior of an autoregression's parameters --------------------------------------------------

LENGTH, SERIES = 25, 300
#: standard errors at which a right kernel is called wrong: 7e-6 of all seeds for each of four figures
LIMIT = 4.5


def noisy_autoregression() -> tuple[bmc.DynamicBayesNet, np.ndarray]:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("phi", bmc.Normal(0.0, 0.5))
    dbn.add_static("tau", bmc.Gamma(3.0, 1.0))
    dbn.add(
        "x",
        lambda x_prev, phi, tau: bmc.Normal(phi * x_prev, tau**-0.5),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    rng = np.random.default_rng(8)
    x = [rng.normal()]
    for _ in range(LENGTH - 1):
        x.append(0.7 * x[-1] + 0.6 * rng.normal())
    return dbn, np.array(x) + 0.5 * rng.normal(size=LENGTH)


def on_a_grid(y: np.ndarray) -> dict[str, float]:
    """Posterior means, the states integrated out by hand: y is Normal given both parameters."""
    phis = np.linspace(-1.3, 1.6, 117)
    taus = np.exp(np.linspace(-3.5, 3.5, 141))
    lag = np.subtract.outer(np.arange(LENGTH), np.arange(LENGTH))
    log = np.empty((len(phis), len(taus)))
    for i, phi in enumerate(phis):
        respond = np.where(lag >= 0, phi ** np.maximum(lag, 0), 0.0)
        first = np.outer(respond[:, 0], respond[:, 0]) + 0.25 * np.eye(LENGTH)
        later = respond[:, 1:] @ respond[:, 1:].T
        cov = first + later / taus[:, None, None]
        distance = np.vecdot(
            y, np.linalg.solve(cov, np.broadcast_to(y[:, None], (*cov.shape[:2], 1)))[..., 0]
        )
        log[i] = -0.5 * (distance + np.linalg.slogdet(cov)[1]) - 0.5 * (phi / 0.5) ** 2
    log += 3.0 * np.log(taus) - taus  # Gamma(3, 1), and the volume of a grid of logs
    weight = np.exp(log - log.max())
    edge = weight[[0, -1]].sum() + weight[:, [0, -1]].sum()
    assert edge < 1e-5 * weight.sum()
    weight /= weight.sum()
    return {
        "phi": float((weight.sum(axis=1) * phis).sum()),
        "phi^2": float((weight.sum(axis=1) * phis**2).sum()),
        "log tau": float((weight.sum(axis=0) * np.log(taus)).sum()),
        "log tau^2": float((weight.sum(axis=0) * np.log(taus) ** 2).sum()),
    }


def scores(change: Callable[[Conjugate], None]) -> dict[str, float]:
    """How many standard errors the means of independent chains are off the grid's."""
    dbn, y = noisy_autoregression()
    plan = plan_of(pose(dbn.unroll(LENGTH), dbn.unrolled_evidence({"y": y})))
    target = plan.target
    states = tuple(n for n in target.chain if n.startswith("x"))
    kernels: list[Any] = [kernel_of(target, "phi"), kernel_of(target, "tau")]
    for kernel in kernels:
        assert sizes(target, kernel.names[0]) == [LENGTH - 1]
        change(kernel)
    kernels.append(GaussianBlock(target, {n: plan.blankets[n] for n in states}))
    sampler = SweepSampler(target, kernels)
    rng = np.random.default_rng(4)
    kept = []
    with marking_invalid(), np.errstate(all="ignore"):
        chain = sampler.start(rng, SERIES)
        for sweep in range(160):
            chain = sampler.step(chain, rng, False)
            if sweep >= 100:
                kept.append((chain["values"]["phi"], np.log(chain["values"]["tau"])))
    phi, log_tau = (np.array(v) for v in zip(*kept, strict=True))
    expected = on_a_grid(y)
    found = {"phi": phi, "phi^2": phi**2, "log tau": log_tau, "log tau^2": log_tau**2}
    each = {name: v.mean(axis=0) for name, v in found.items()}  # one number of every chain
    return {
        name: float((v.mean() - expected[name]) / (v.std(ddof=1) / np.sqrt(SERIES)))
        for name, v in each.items()
    }


def test_parameters_of_an_autoregression() -> None:
    found = scores(lambda kernel: None)
    assert max(map(abs, found.values())) < LIMIT, found


def test_transitions_that_count_half_show() -> None:
    """The negative control: each of the group adds half of its share to the precision's shape."""

    def half_a_shape(kernel: Conjugate) -> None:
        if kernel.names == ("tau",):  # the prior is Gamma(3, 1)
            wrong = with_naturals(kernel, lambda a, b: (2.0 + 0.5 * (a - 2.0), b))
            kernel.forms = wrong.forms

    found = scores(half_a_shape)
    assert max(map(abs, found.values())) > LIMIT, found
