"""Densities held against themselves: right ones pass, every kind of fault is told in words."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.special
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import BroadcastError, UnknownNodeError, UnsupportedError
from bayesmc.testing.densities.conditionals import check_cpd
from bayesmc.testing.densities.density import check_density
from bayesmc.testing.densities.masses import Element, table_of, volume_of
from bayesmc.testing.verdict import uncounted

HALF = 0.5 * math.log(2 * math.pi)
D = bmc.Density


def gauss(x: np.ndarray) -> np.ndarray:
    return -0.5 * x**2 - HALF


def plane(x: np.ndarray) -> np.ndarray:
    return -0.5 * (x**2).sum(axis=-1) - x.shape[-1] * HALF


RIGHT = {
    "density": D(gauss, lambda rng, shape: rng.normal(size=shape)),
    "no sampler": D(lambda x: np.log(2 * x), support="unit interval"),
    "vector": D(plane, lambda rng, shape: rng.normal(size=(*shape, 2)), event_shape=2),
    "five dimensions": D(plane, lambda rng, shape: rng.normal(size=(*shape, 5)), event_shape=5),
    "batch, far and narrow": bmc.Normal([0.0, 1e6, -3.0], [1.0, 0.01, 1e4]),
    "infinite variance": bmc.StudentT(1.5, 0.0, 1.0),
    "infinite density": bmc.Beta(0.5, 0.5),
    "angles": bmc.VonMises(3.0, 2.0),
    "whole numbers": bmc.Poisson([2.0, 300.0]),
    "zeros": bmc.Categorical([0.2, 0.0, 0.8]),
    "simplex": bmc.Dirichlet([0.5, 2.0, 3.0]),
    "coupled": bmc.MvNormal([0.0, 1.0], [[1.0, 0.8], [0.8, 1.0]]),
    "counts": bmc.Multinomial(4, [0.3, 0.7]),
    "SciPy's": scipy.stats.gumbel_r(1.0, 2.0),
}


@pytest.mark.parametrize("kind", RIGHT)
def test_right_densities_pass(kind: str) -> None:
    """14 calls at alpha 1e-3, at fixed seeds."""
    assert check_density(RIGHT[kind], draws=2000, rng=0)


def normal(size: float = 1.0):
    return lambda rng, shape: size * rng.normal(size=shape)


def shared(rng: np.random.Generator, shape: tuple) -> np.ndarray:
    return np.array([0.0, 1.0]) + rng.normal(size=shape)[..., None]


def leaning(rng: np.random.Generator, shape: tuple) -> np.ndarray:
    x, z = rng.normal(size=(2, *shape))
    return np.stack([x, 0.9 * x + math.sqrt(0.19) * z], axis=-1)


ROOT = np.linalg.cholesky([[1.0, 0.6], [0.6, 1.0]])
SAMPLERS = {
    "right": lambda z: z @ ROOT.T,
    "no correlation": lambda z: z,
    "the root's transpose": lambda z: z @ ROOT,
    "wide": lambda z: 1.2 * z @ ROOT.T,
    "shifted": lambda z: 0.2 + z @ ROOT.T,
}


@pytest.mark.parametrize(
    ("kind", "size"), [*((kind, 2) for kind in SAMPLERS), ("right", 4), ("the root's transpose", 4)]
)
def test_moments_of_vectors_are_those_of_the_integral(kind: str, size: int) -> None:
    """By the product rule and by importance sampling; each fault is 6 standard errors off or more."""
    cov = scipy.linalg.block_diag(*[ROOT @ ROOT.T] * (size // 2))
    right = bmc.MvNormal(np.zeros(size), cov)

    def draw(rng: np.random.Generator, shape: tuple) -> np.ndarray:
        pairs = SAMPLERS[kind](rng.normal(size=(*shape, size // 2, 2)))
        return pairs.reshape(*shape, size)

    density = D(right.log_prob, draw, event_shape=size)
    check = check_density(density, draws=3000, rng=0)
    assert bool(check) == (kind == "right"), check
    assert check or any("far values drawn in" in fault for fault in check.faults)


def test_a_spread_off_by_a_twentieth_is_seen() -> None:
    """The mean square of 10,000 draws is 7 standard errors off; missed with probability 1e-3 each."""
    for seed in range(5):
        check = check_density(D(gauss, normal(1.05)), draws=10_000, rng=seed)
        assert any("mean square of the draws' normal scores" in fault for fault in check.faults)
    wide = D(bmc.Poisson(20.0).log_prob, lambda r, s: r.poisson(20.0, size=s) + 4 * (r.random(s) < 0.1),
             support="nonnegative integer")  # fmt: skip
    check = check_density(wide, draws=10_000, rng=0)
    assert any("draws' normal scores" in fault for fault in check.faults), check


class Wrong(bmc.Normal):
    """A normal whose figures can be set."""

    @property
    def mean(self) -> np.ndarray:
        return super().mean + 0.01

    @property
    def var(self) -> np.ndarray:
        return super().var * 1.01

    def cdf(self, x):
        return super().cdf(x) * 0.999

    def ppf(self, q):
        return super().ppf(q) + 0.01


def counted(rate: float) -> Any:
    return lambda k: k * np.log(rate) - rate - scipy.special.gammaln(k + 1.0)


def zeta_like(k: Any) -> Any:
    return -1.5 * np.log(k + 1.0) - np.log(scipy.special.zeta(1.5))


FAULTS = {
    "not normalised": (D(lambda x: gauss(x) + 0.1), "integrates to 1.105"),
    "no logarithm": (D(lambda x: np.exp(gauss(x)), support="positive"), "the LOG density"),
    "wrong scale drawn": (D(gauss, normal(1.2)), "draws against the density"),
    "off its support": (D(lambda x: -x, normal(), support="positive"), "off the support (numbers"),
    "NaN": (
        D(lambda x: np.where(x > 2, np.nan, -x), lambda r, s: r.exponential(size=s), (), "positive"),
        "log_prob is nan at its own draw",
    ),
    "support too wide": (
        D(lambda x: np.where(x > 0, -x, -np.inf), lambda r, s: r.exponential(size=s)),
        "log_prob is -inf in the support at",
    ),
    "its own randomness": (
        D(gauss, lambda r, s: np.random.default_rng().normal(size=s)),
        "take all randomness from the given rng",
    ),
    "no broadcasting": (D(lambda x: gauss(x - x.mean()), normal()), "does not broadcast"),
    "shape of draws": (D(gauss, lambda r, s: r.normal(size=(*s, 1))), "returned shape"),
    "shared noise": (
        D(lambda x: gauss(x - np.array([0.0, 1.0])), shared),
        "rank correlation of draws of batch elements (0,) and (1,)",
    ),
    "one draw repeated": (
        D(gauss, lambda r, s: np.sort(r.normal(size=s), axis=None).reshape(s)),
        "rank correlation of successive draws",
    ),
    "wrong coupling": (D(plane, leaning, event_shape=2), "energy distance"),
    "vector not normalised": (D(lambda x: plane(x) + 0.5, event_shape=2), "integrates to 1.64"),
    "five not normalised": (
        D(lambda x: plane(x) + 0.5, lambda r, s: r.normal(size=(*s, 5)), event_shape=5),
        "by importance sampling",
    ),
    "whole numbers off by one": (
        D(lambda k: (k + 1) * np.log(0.5), lambda r, s: r.geometric(0.5, size=s), (),
          "nonnegative integer"),
        "draws against the probabilities",
    ),
    "half numbers for whole ones": (
        D(counted(2.0), lambda r, s: r.poisson(2.0, s) + 0.5, (), "nonnegative integer"),
        "sample gives 3.5, off the support",
    ),
    "millions, twice as many": (
        D(counted(1e6), lambda r, s: r.poisson(2e6, s), (), "nonnegative integer"),
        "share of the draws from",
    ),
    "millions, of a few": (
        D(counted(2.0), lambda r, s: r.poisson(2.0, s) + 10**7, (), "nonnegative integer"),
        "share of the draws from",
    ),
    "a tail too light": (
        D(zeta_like, lambda r, s: np.minimum(r.zipf(1.7, s), 2**50) - 1.0, (), "nonnegative integer"),
        "draws against the probabilities",
    ),
    "complex numbers": (D(gauss, lambda r, s: r.normal(size=s) + 1j), "return real ones"),
    "whole numbers not normalised": (
        D(lambda k: k * np.log(0.5), support="nonnegative integer"),
        "probabilities sum to 2",
    ),
    "mean": (Wrong(0.0, 1.0), "mean is 0.01, by the integral"),
    "var": (Wrong(0.0, 1.0), "var is 1.01, by the integral 1"),
    "cdf": (Wrong(0.0, 1.0), "by the integral"),
    "ppf": (Wrong(0.0, 1.0), "ppf("),
}  # fmt: skip


@pytest.mark.parametrize("kind", FAULTS)
def test_every_fault_is_told_in_words(kind: str) -> None:
    density, words = FAULTS[kind]
    check = check_density(density, draws=2000, rng=0)
    assert not check
    assert any(words in fault for fault in check.faults), check


def test_a_point_between_whole_numbers_is_tried_where_draws_are_none() -> None:
    density, _ = FAULTS["half numbers for whole ones"]
    assert "log_prob is" not in repr(check_density(density, draws=500, rng=0))


@pytest.mark.parametrize("dist", [bmc.Bernoulli(1e-7), bmc.NegativeBinomial(0.5, 1e-7)])
def test_draws_that_are_all_equal(dist: Any) -> None:
    """The mean of equal numbers is off by a rounding error, which is no error of theirs."""
    assert check_density(dist, draws=1000, rng=0)


@pytest.mark.parametrize(
    ("dist", "words"),
    [
        (
            D(lambda k: np.where(k == 1001, np.nan, zeta_like(k)),
              lambda r, s: np.minimum(r.zipf(1.5, s), 900) - 1.0, (), "nonnegative integer"),
            "log_prob is nan at 1001",
        ),
        (
            D(counted(2.0), lambda r, s: np.full(s, np.inf), (), "nonnegative integer"),
            "sample gives inf, off the support",
        ),
        (
            D(counted(2.0), lambda r, s: np.full(s, 1e300), (), "nonnegative integer"),
            "draws against the probabilities",
        ),
    ],
)  # fmt: skip
def test_faults_far_out_are_told_in_words(dist: Any, words: str) -> None:
    found = repr(check_density(dist, draws=500, rng=0))
    assert words in found, found
    assert "arange" not in found and "must be in range" not in found and "axis 0" not in found


def test_whole_numbers_in_the_millions_are_summed() -> None:
    def right(rng: Any, shape: Any) -> Any:
        return rng.poisson(1e6, shape)

    check = check_density(D(counted(1e6), right, (), "nonnegative integer"), draws=2000, rng=0)
    assert check
    assert "draws against the probabilities" in str([c.what for c in check.comparisons])


def test_a_density_off_its_support_is_heard_of() -> None:
    """``Density`` cuts at its support; a family of one's own has to."""

    class Leaky(bmc.Exponential):
        def _log_prob(self, x: np.ndarray) -> np.ndarray:
            return np.log(self.rate) - self.rate * x

    check = check_density(Leaky(1.0), draws=500, rng=0)
    assert any("it must be -inf there" in fault for fault in check.faults)


def test_gaps_are_allowed_on_demand() -> None:
    def two(x: np.ndarray) -> np.ndarray:
        return np.where(abs(x) > 1, np.log(0.5), -np.inf)

    def draw(rng: np.random.Generator, shape: tuple) -> np.ndarray:
        return rng.choice([-1.0, 1.0], size=shape) * (1 + rng.random(shape))

    density = D(two, draw, support=(-2.0, 2.0))
    assert not check_density(density, draws=500, rng=0)
    assert check_density(density, draws=500, gaps=True, rng=0)


def test_false_alarms_are_as_rare_as_stated() -> None:
    """Checks at alpha = 0.05: more alarms than the bound have probability 1e-3."""
    for density, count in ((RIGHT["whole numbers"], 60), (bmc.Gamma(0.7, 2.0), 8)):
        alarms = sum(not check_density(density, draws=300, alpha=0.05, rng=s) for s in range(count))
        assert alarms <= scipy.stats.binom.ppf(0.999, count, 0.05)
    density = RIGHT["whole numbers"]
    assert any(not check_density(density, draws=300, alpha=0.9, rng=s) for s in range(20))


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: check_density(3.0), TypeError, "give a distribution"),
        (lambda: check_density(bmc.Normal(0, 1), draws=5), ValueError, "100 or more"),
        (lambda: check_density(bmc.Normal(0, 1), alpha=0), ValueError, "strictly between"),
    ],
)
def test_wrong_arguments_are_named(call, error: type, words: str) -> None:
    with pytest.raises(error, match=words):
        call()


# ---- what densities integrate to ----------------------------------------------------------------


@pytest.mark.parametrize(
    "dist",
    [
        bmc.Dirichlet([0.4, 2.0]),
        bmc.Wishart(4.0, [[1.0, 0.5], [0.5, 2.0]]),
        bmc.Dirichlet([2.0, 3.0, 4.0, 5.0]),
    ],
)
def test_volumes_are_found_without_the_sampler(dist: bmc.Distribution) -> None:
    volume = volume_of(Element(dist, ()), None, np.random.default_rng(0))
    assert abs(volume.total - 1) <= max(volume.error, 1e-6)
    assert volume.error < 1e-3
    assert abs(volume.drawn.value - 1) < 5 * volume.drawn.error
    off = volume.draws.mean(axis=0) - dist.mean
    assert (np.abs(off) < 5 * np.sqrt(dist.var / len(volume.draws))).all()


def test_sums_reach_far_and_say_when_they_do_not() -> None:
    table = table_of(Element(bmc.Poisson(5000.0), ()), np.array([3.0]))
    assert table.is_whole and abs(table.probs.sum() - 1) < 1e-10
    heavy = D(zeta_like, support="nonnegative integer")
    assert not table_of(Element(heavy, ()), np.array([0.0])).is_whole
    assert "tail is too long" in repr(check_density(heavy, rng=0))


def test_draws_of_a_tail_that_is_not_summed_are_held_against_it() -> None:
    """Half of the draws choose a range, in which the others come as often as they should; at 0.01."""

    def right(rng: Any, shape: Any) -> Any:
        return np.minimum(rng.zipf(1.5, shape), 2**50) - 1.0

    heavy = D(zeta_like, right, (), "nonnegative integer")
    with uncounted():
        found = [check_density(heavy, draws=1000, alpha=0.01, rng=s) for s in range(5)]
    assert sum(not check for check in found) <= 1
    assert "share of the draws" in str([c.what for c in found[0].comparisons])


# ---- nodes --------------------------------------------------------------------------------------


def clinic() -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"i": 3})
    net.input("dose")
    net.add("ill", bmc.Bernoulli(0.4))
    net.add("b", bmc.Normal(0.0, 1.0))
    net.table("state", ["ill"], [[0.9, 0.1], [0.2, 0.8]], states=("well", "unwell"))
    net.add(
        "x", lambda state, dose: bmc.Normal(np.where(state == "well", 0.0, dose), 1.0), plates="i"
    )
    net.add("total", lambda x: x.sum("i"))
    net.add("n", lambda x: bmc.Poisson(np.exp(x)), plates="i")
    return net


@pytest.mark.parametrize("name", ["ill", "state", "x", "n"])
def test_right_nodes_pass(name: str) -> None:
    assert check_cpd(clinic(), name, parents=2, draws=1000, inputs={"dose": 2.0}, rng=0)


def laplace(ill: np.ndarray, factor: float = 1.0) -> bmc.Distribution:
    scale = 1.0 + np.asarray(ill)
    return D(
        lambda x: -np.abs(x) / scale - np.log(2 * scale) * factor,
        lambda rng, shape: rng.laplace(0.0, scale, size=shape + scale.shape),
    )


CPDS = {
    "right": (laplace, None),
    "at one value of a parent": (lambda ill: laplace(ill, 1.0 + ill), "at ill=1: the density integrates"),
    "mixing": (lambda b: bmc.Normal(np.mean(b), 1.0), "does not broadcast"),
    "rarely out of range": (lambda b: bmc.Normal(0.0, 1.5 + b), "must be positive and finite"),
    "random": (lambda ill: bmc.Normal(np.random.default_rng().normal(), 1.0), "must not draw random numbers"),
}  # fmt: skip


@pytest.mark.parametrize("kind", CPDS)
def test_faults_of_nodes_come_with_the_parents_values(kind: str) -> None:
    function, words = CPDS[kind]
    net = clinic()
    net.add("z", function)
    check = check_cpd(net, "z", parents=2, draws=1000, inputs={"dose": 2.0}, rng=0)
    if words is None:
        assert check
    else:
        assert any(words in fault for fault in check.faults), check


def test_faults_elsewhere_are_no_faults_of_a_node() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.5, 0.5))
    net.add("x", lambda a: bmc.Normal(a, 1.0))
    net.add("mixing", lambda a: bmc.Normal(np.mean(a), 1.0))
    net.add("after", lambda mixing: bmc.Normal(mixing, 1.0))
    net.add("orphan", lambda nobody: bmc.Normal(nobody, 1.0))
    assert check_cpd(net, "x", draws=1000, rng=0)
    assert not check_cpd(net, "mixing", draws=1000, rng=0)
    with pytest.raises(BroadcastError, match="node 'mixing'"):  # an ancestor's
        check_cpd(net, "after", draws=1000, rng=0)


def test_negative_probabilities_come_with_the_parents_values() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.5, 0.5))
    net.add("k", lambda a: bmc.Categorical(np.stack([a, 1 - a], axis=-1)))
    fault = check_cpd(net, "k", rng=0).faults[0]
    assert fault.startswith("at a=1.152: Categorical"), fault
    assert "(this row holds -0.152" in fault, fault


def test_what_has_no_density_is_refused() -> None:
    net, inputs = clinic(), {"dose": 1.0}
    with pytest.raises(UnknownNodeError, match="no node 'z'"):
        check_cpd(net, "z", inputs=inputs)
    for name in ("total", "dose"):
        with pytest.raises(UnsupportedError, match="has no density"):
            check_cpd(net, name, inputs=inputs)
    with pytest.raises(TypeError, match="BayesNet, not dict"):
        check_cpd({}, "x")  # type: ignore[arg-type]
    net.add("d", D(gauss))
    net.add("e", lambda d: bmc.Normal(d, 1.0))
    with pytest.raises(UnsupportedError, match="check_cpd"):
        check_cpd(net, "e", inputs=inputs)
    assert "without a way to sample" in repr(check_cpd(net, "d", inputs=inputs, rng=0))
