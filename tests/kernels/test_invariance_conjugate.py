"""Closed forms leave their posteriors invariant: pairs of all families, and jointly Normal blocks.

Geweke's test and the rank test at a chance of false alarm of 1e-4 each, at fixed seeds; ``--bayesmc-seed``
shifts them, and ``--bayesmc-thorough`` makes the tests longer. Each test is shown to fail on a
kernel with a deliberate error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.kernels import gaussian_block
from bayesmc.kernels.collapsed import CollapsedBlock, governing
from bayesmc.kernels.conjugate import Conjugate, conjugate_kernel
from bayesmc.kernels.conjugate_children import children_of
from bayesmc.kernels.conjugate_families import Conditional
from bayesmc.kernels.gaussian_block import GaussianBlock, gaussian_blocks
from bayesmc.kernels.slice import Slice
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target
from tests.kernels.invariance import (
    TESTS,
    Case,
    Make,
    Model,
    each_fault,
    each_test,
    in_turn,
    mixture,
)
from tests.kernels.wrong_naturals import Change, with_naturals

COV = np.array([[1.0, 0.4], [0.4, 0.7]])

# ---- pairs of all families, on three overlapping categories -----------------------------------------


def _wide(x: Any) -> Any:
    return x[..., None, None]


GAMMA, INVERSE_GAMMA = bmc.Gamma(3.0, 2.0), bmc.InverseGamma(3.0, 2.0)
BETA, WORDS = bmc.Beta(2.0, 3.0), bmc.Dirichlet([1.0, 2.0, 0.7, 1.5])

#: kind, family and parameter -> prior, and the child as a function of the node's value
SIDES: dict[tuple[str, str, str], tuple[Any, Callable[[Any], Any]]] = {
    ("mean", "Normal", "loc"): (bmc.Normal(0.5, 1.5), lambda x: bmc.Normal(1 - 2 * x, 1.8)),
    ("mean", "LogNormal", "loc"): (bmc.Normal(0.5, 1.0), lambda x: bmc.LogNormal(x / 2, 0.6)),
    ("mean", "MvNormal", "loc"): (
        bmc.MvNormal([0.5, -0.5], 2 * COV),
        lambda x: bmc.MvNormal(np.matvec(np.array([[1.0, 2.0], [0.0, -1.0]]), x) + 1, 3 * COV),
    ),
    ("scale", "Poisson", "rate"): (GAMMA, lambda x: bmc.Poisson(1.5 * x)),
    ("scale", "Exponential", "rate"): (GAMMA, lambda x: bmc.Exponential(x / 3)),
    ("scale", "Gamma", "rate"): (GAMMA, lambda x: bmc.Gamma(1.2, 2 * x)),
    ("scale", "InverseGamma", "scale"): (GAMMA, lambda x: bmc.InverseGamma(2.2, 2 * x)),
    ("scale", "Normal", "scale"): (GAMMA, lambda x: bmc.Normal(1.0, 2 / np.sqrt(x))),
    ("scale", "LogNormal", "scale"): (GAMMA, lambda x: bmc.LogNormal(0.3, x**-0.5)),
    ("scale", "HalfNormal", "scale"): (GAMMA, lambda x: bmc.HalfNormal(x**-0.5)),
    ("scale", "Laplace", "scale"): (INVERSE_GAMMA, lambda x: bmc.Laplace(0.5, 1.5 * x)),
    ("scale", "MvNormal", "cov"): (
        INVERSE_GAMMA, lambda x: bmc.MvNormal(np.ones(2), _wide(x) * COV)
    ),
    ("scale", "MvNormal", "scale_tril"): (
        GAMMA,
        lambda x: bmc.MvNormal(np.zeros(2), scale_tril=_wide(x**-0.5) * np.linalg.cholesky(COV)),
    ),
    ("scale", "MvNormal", "scale_diag"): (
        INVERSE_GAMMA,
        lambda x: bmc.MvNormal(np.zeros(2), scale_diag=np.sqrt(x)[..., None] * np.array([1.0, 2.0])),
    ),
    ("share", "Bernoulli", "probs"): (BETA, lambda x: bmc.Bernoulli(x)),
    ("share", "Binomial", "probs"): (BETA, lambda x: bmc.Binomial(3, x)),
    ("share", "Geometric", "probs"): (BETA, lambda x: bmc.Geometric(x)),
    ("share", "NegativeBinomial", "probs"): (BETA, lambda x: bmc.NegativeBinomial(2.5, x)),
    ("share", "Categorical", "probs"): (
        BETA, lambda x: bmc.Categorical(bmc.stack([1 - x, 0 * x, x], axis=-1))
    ),
    ("shares", "Categorical", "probs"): (WORDS, lambda x: bmc.Categorical(x)),
    ("shares", "Multinomial", "probs"): (WORDS, lambda x: bmc.Multinomial(3, x)),
    ("covariance", "MvNormal", "cov"): (
        bmc.InverseWishart(4.5, COV), lambda x: bmc.MvNormal(np.ones(2), x)
    ),
    ("precision", "MvNormal", "cov"): (
        bmc.Wishart(4.5, COV), lambda x: bmc.MvNormal(np.ones(2), np.linalg.inv(x))
    ),
}  # fmt: skip

#: priors that no pair above has: flat, truncated, other families
PRIORS: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "flat mean": (bmc.Uniform(-1.0, 1.5), lambda x: bmc.Normal(x, 2.0)),
    "truncated mean": (bmc.Truncated(bmc.Normal(0.0, 1.0), 0.2), lambda x: bmc.Normal(x, 2.0)),
    "mean in vectors": (
        bmc.Normal(0.0, 1.0), lambda x: bmc.MvNormal(bmc.stack([x, 2 * x - 1]), 3 * COV)
    ),
    "regression": (
        bmc.MvNormal(np.zeros(2), COV), lambda x: bmc.Normal(x[..., 0] - 2 * x[..., 1], 1.6)
    ),
    "flat rate": (bmc.Uniform(0.5, 2.0), lambda x: bmc.Poisson(1.5 * x)),
    "exponential rate": (bmc.Exponential(1.5), lambda x: bmc.Exponential(x)),
    "inverse rate": (INVERSE_GAMMA, lambda x: bmc.Exponential(1 / x)),
    "truncated precision": (
        bmc.Truncated(GAMMA, 0.4, 2.0), lambda x: bmc.Normal(1.0, 2 / np.sqrt(x))
    ),
    "variance": (INVERSE_GAMMA, lambda x: bmc.Normal(1.0, np.sqrt(2 * x))),
    "flat sd": (bmc.Uniform(0.5, 3.0), lambda x: bmc.Normal(1.0, x)),
    "flat variance": (bmc.Uniform(0.5, 5.0), lambda x: bmc.Normal(1.0, x**0.5)),
    "flat share": (bmc.Uniform(0.0, 0.8), lambda x: bmc.Bernoulli(x)),
    "truncated share": (bmc.Truncated(BETA, 0.2, 0.7), lambda x: bmc.Binomial(3, x)),
}  # fmt: skip


def _wrong(family: Conditional, times: float = 1.0) -> Change:
    """An error of its kind: a mean that is off, some degrees of freedom more, a neighbour's counts, ..."""
    power = getattr(family, "power", 1.0)
    faults: dict[str, Change] = {
        "NormalConditional": lambda linear, square: (linear - 2.0 * times * square, square),
        "MvNormalConditional": lambda precision, linear: (
            precision,
            linear + times * np.trace(precision, axis1=-2, axis2=-1)[..., None],
        ),
        "GammaConditional": lambda exponent, rate: (exponent + 3.0 * times * power, rate),
        "BetaConditional": lambda a, b: (a, b + 6.0 * times),
        "DirichletConditional": lambda a: (np.roll(a, 1, axis=-1),),
        "InverseWishartConditional": lambda df, scale: (df + 6.0 * times, scale),
        "WishartConditional": lambda df, scale: (df + 6.0 * times, scale),
    }
    return faults[type(family).__name__]


def _right(target: Target) -> Conjugate:
    kernel = conjugate_kernel(Blanket(target, "x"))
    assert isinstance(kernel, Conjugate), kernel
    return kernel


def _faulty(times: float = 1.0) -> Make:
    def make(target: Target) -> Conjugate:
        kernel = _right(target)
        return with_naturals(kernel, _wrong(kernel.forms[0].family, times))

    return make


def _case(prior: Any, child: Callable[[Any], Any], how: str, times: float = 1.0) -> Case:
    model = Model(mixture(prior, child), ("y",), ("x",))
    # draws are independent given the data: short chains do
    sizes = {"draws": 15, "chains": 240}
    return Case(model, _right, {"wrong": _faulty(times)}, how=how, sizes=sizes)


@pytest.mark.parametrize(
    ("key", "fault", "test"),
    in_turn([(k, f) for k in SIDES for f in ("", "wrong")]),
    ids=lambda p: "-".join(p) if isinstance(p, tuple) else None,
)
def test_pair(key: tuple[str, str, str], test: str, fault: str) -> None:
    case = _case(*SIDES[key], "moving")
    kernel = case.make(case.model.target("moving"))
    assert kernel.match.removesuffix(" where it is picked").endswith(f" with {key[1]} {key[2]}")
    case.check(test, fault)


@pytest.mark.parametrize("test", TESTS)
@pytest.mark.parametrize("name", PRIORS)
def test_prior(name: str, test: str) -> None:
    _case(*PRIORS[name], "moving").check(test)


#: pairs whose data are summed beforehand, by label and otherwise
KEPT = (
    ("mean", "Normal", "loc"),
    ("scale", "Poisson", "rate"),
    ("scale", "Normal", "scale"),
    ("covariance", "MvNormal", "cov"),
)


@pytest.mark.parametrize("fault", ["", "wrong"])
@pytest.mark.parametrize("key", KEPT, ids="-".join)
def test_pair_with_what_is_kept_of_the_evidence(key: tuple[str, str, str], fault: str) -> None:
    """Every row has a posed problem of its own; that the sums are right is for ``test_conjugate``."""
    _case(*SIDES[key], "posed", 3.0).check("ranks", fault, replications=60)


# ---- jointly Normal blocks -------------------------------------------------------------------------


def _series(prior: Any, child: Callable[..., Any], size: int = 8) -> Model:
    """Many like children of one node, in the numbers of which the time is."""
    net = bmc.BayesNet()
    net.add("x", lambda: prior)
    for t in range(size):
        net.add(f"y{t}", lambda x, t=t: child(x, 1.0 + t / size), parents=["x"])
    return Model(net, tuple(f"y{t}" for t in range(size)), ("x",))


SERIES = {
    "mean": _series(bmc.Normal(0.5, 1.0), lambda x, s: bmc.Normal(s * x - 1, s)),
    "scale": _series(bmc.Gamma(3.0, 2.0), lambda x, s: bmc.Normal(s, s * x**-0.5)),
    "share": _series(bmc.Beta(2.0, 3.0), lambda x, s: bmc.Binomial(5 + 0 * s, x)),
}


@pytest.mark.parametrize("fault", ["", "wrong"])
@pytest.mark.parametrize(
    ("name", "how"),
    [*((n, "moving") for n in SERIES), pytest.param("mean", "posed", marks=pytest.mark.thorough)],
)
def test_like_children(name: str, how: str, fault: str) -> None:
    """All children are one."""
    sizes = {"replications": 200} if how == "posed" else {}
    case = Case(SERIES[name], _right, {"wrong": _faulty()}, how=how, sizes=sizes)
    (child,) = children_of(Blanket(case.model.target("moving"), "x"))
    assert len(child.terms) == 8
    case.check("ranks", fault)


def _coupled() -> Model:
    """Three overlapping categories whose means have a mean; scales and labels are hidden, and stay."""
    net = bmc.BayesNet(plates={"k": 3, "i": 10})
    net.add("tau", bmc.Gamma(3.0, 2.0))
    net.add("sd", bmc.Uniform(0.5, 1.5), plates="k")
    net.add("centre", bmc.Normal(0.5, 1.0))
    net.add("a", lambda centre, tau: bmc.Normal(2 * centre - 1, tau**-0.5), plates="k")
    net.add("label", bmc.Categorical([0.2, 0.3, 0.5]), plates="i")
    net.add("y", lambda a, label, sd: bmc.Normal(1 - a[label], sd[label]), plates="i")
    return Model(net, ("y",), ("centre", "a"))


def _grown() -> Model:
    """Lines of many individuals: their levels and slopes are eliminated first, one by one."""
    days = np.array([-1.0, 0.0, 2.0])
    net = bmc.BayesNet(plates={"rat": 14, "day": 3})
    net.add("sd", bmc.Uniform(0.5, 1.5))
    net.add("centre", bmc.Normal(0.0, 1.0))
    net.add("level", lambda centre: bmc.Normal(centre, 0.7), plates="rat")
    net.add("slope", lambda sd: bmc.Normal(0.5, sd), plates="rat")
    net.add(
        "y", lambda level, slope, sd: bmc.Normal(level + slope * days, sd), plates=("rat", "day")
    )
    return Model(net, ("y",), ("centre", "slope", "level"))


def _vectors() -> Model:
    """Vectors, one of them deterministic in between; noise of logarithms, and of vectors."""
    group = np.arange(7) % 3
    net = bmc.BayesNet(plates={"k": 3, "i": 7})
    net.add("centre", bmc.MvNormal([0.5, -0.5], COV))
    net.add("x", lambda centre: bmc.MvNormal(centre, 2 * COV), plates="k")
    net.add("turned", lambda x: np.matvec(np.array([[1.0, 2.0], [0.0, -1.0]]), x), plates="k")
    net.add("y", lambda turned: bmc.MvNormal(turned[group], 3 * COV), plates="i")
    net.add("z", lambda x: bmc.LogNormal(x[group][..., 0] / 2, 0.6), plates="i")
    return Model(net, ("y", "z"), ("centre", "x"))


def _slices() -> Model:
    """A chain of slices about a level that all share: like terms are one, and the slices are a band."""
    net = bmc.BayesNet()
    net.add("sd", bmc.Uniform(0.5, 1.5))
    net.add("level", bmc.Normal(0.5, 1.0))
    net.add("x0", lambda level, sd: bmc.Normal(level, 2 * sd))
    for t in range(1, 26):
        net.add(
            f"x{t}",
            lambda x, level, sd: bmc.Normal(level + 0.7 * (x - level), sd),
            parents=[f"x{t - 1}", "level", "sd"],
        )
    for t in range(26):
        net.add(f"y{t}", lambda x, t=t: bmc.Normal(1 - x, 0.6 + t / 26), parents=[f"x{t}"])
    states = tuple(f"x{t}" for t in range(26))
    return Model(net, tuple(f"y{t}" for t in range(26)), ("level", *states))


def _blankets(target: Target, names: tuple[str, ...]) -> dict[str, Blanket]:
    return {n: Blanket(target, n) for n in names}


def _block(
    model: Model, kind: type[GaussianBlock] = GaussianBlock, terms: slice = slice(None)
) -> Make:
    def make(target: Target) -> GaussianBlock:
        (found,) = gaussian_blocks(target, _blankets(target, model.moved))
        assert found.names == model.moved
        block = kind(target, _blankets(target, model.moved))
        block.parts = block.parts[terms]
        return block

    return make


class _Wide(GaussianBlock):
    """Draws with a variance for a standard deviation."""

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        sums = self._summed(values, len(values[self.names[0]]))
        noise = rng.standard_normal(sums.linear.shape)
        mean, *_ = gaussian_block.solved(self.layout, sums, None)
        draw, *_ = gaussian_block.solved(self.layout, sums, noise)
        return self.layout.split(mean + 2.0 * (draw - mean), values), memory


MODELS = {"coupled": _coupled(), "grown": _grown(), "vectors": _vectors(), "slices": _slices()}
BLOCKS = {
    name: Case(
        m,
        _block(m),
        {"wide": _block(m, _Wide), "no prior": _block(m, terms=slice(1, None))},
        sizes={"replications": 3000},
    )
    for name, m in MODELS.items()
}
#: a kernel that forgets the data draws from the prior, to which Geweke's test has no objection
KEPT_BLOCKS = {
    name: Case(m, _block(m), {"no data": _block(m, terms=slice(-1))}, how="posed")
    for name, m in MODELS.items()
}


@pytest.mark.parametrize(("name", "fault", "test"), each_test(BLOCKS))
def test_block(name: str, test: str, fault: str) -> None:
    BLOCKS[name].check(test, fault)


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        pytest.param(*case, marks=[pytest.mark.thorough] if case[0] == "slices" else [])
        for case in each_fault(KEPT_BLOCKS)
    ],
)
def test_block_with_what_is_kept_of_the_evidence(name: str, fault: str) -> None:
    KEPT_BLOCKS[name].check("ranks", fault, replications=32)


# ---- scales with a block integrated out --------------------------------------------------------------


def _variances() -> Model:
    net = bmc.BayesNet(plates={"k": 3, "i": 10})
    net.add("tau", bmc.LogNormal(0.0, 0.6))
    net.add("sigma", bmc.Uniform(0.3, 2.0))
    net.add("mu", bmc.Normal(0.0, 1.5))
    net.add("theta", lambda mu, tau: bmc.Normal(mu, tau), plates="k")
    net.add("label", bmc.Categorical([0.2, 0.3, 0.5]), plates="i")
    net.add("y", lambda theta, label, sigma: bmc.Normal(theta[label], sigma), plates="i")
    return Model(net, ("y",), ("tau", "sigma", "mu", "theta"))


class _NoDeterminant(GaussianBlock):
    """Integrates the exponential, and forgets what is in front of it."""

    def log_integral(self, values: Any, count: int) -> np.ndarray:
        sums = self._summed(values, count)
        return sums.constant + 0.5 * np.vecdot(
            sums.linear, gaussian_block.solved(self.layout, sums, None)[0]
        )


class _Slow(CollapsedBlock):
    """As after a warmup in which all scales were slow."""

    slow = ("tau", "sigma")

    def start(self, values: Any, chains: int) -> Any:
        return {**super().start(values, chains), "slow": {n: n in self.slow for n in self.blankets}}


class _Alone(_Slow):
    """As after a warmup in which nothing was slow."""

    slow = ()


class _Mixed(_Slow):
    """One was slow, the other is drawn given the block."""

    slow = ("tau",)


class _Stale(_Alone):
    """Moves the block first, and the scales given where it was."""

    def step(self, values: Any, memory: Any, rng: Any, warmup: bool) -> Any:
        drawn, _ = self.block.step(values, {}, rng, warmup)
        new, _ = super().step(values, memory, rng, warmup)
        return {**new, **drawn}, memory


def _collapsed(
    kind: type[CollapsedBlock] = _Slow,
    of: type[GaussianBlock] = GaussianBlock,
    backwards: bool = False,
) -> Make:
    def make(target: Target) -> CollapsedBlock:
        block = of(target, _blankets(target, ("mu", "theta")))
        scales = governing(target, block, _blankets(target, target.chain))
        assert set(scales) == {"tau", "sigma"}
        alone = {n: Slice(b) for n, b in scales.items()}
        order = reversed(scales.items()) if backwards else scales.items()
        return kind(target, block, dict(order), alone)

    return make


COLLAPSED = Case(
    _variances(),
    _collapsed(),
    {"no determinant": _collapsed(of=_NoDeterminant)},
    reverse=lambda make, target, memory: (_collapsed(backwards=True)(target), memory),
    how="moving",
)
#: scales and block in turn are irreversible; the rank test is put to whole sweeps
IN_TURN = {
    "alone": Case(_variances(), _collapsed(_Alone), {"stale": _collapsed(_Stale)}, how="moving"),
    "mixed": Case(
        _variances(),
        _collapsed(_Mixed),
        {"no determinant": _collapsed(_Mixed, _NoDeterminant)},
        how="moving",
    ),
}


@pytest.mark.parametrize("fault", ["", "no determinant"])
@pytest.mark.parametrize("test", TESTS)
def test_collapsed(test: str, fault: str) -> None:
    COLLAPSED.check(test, fault)


@pytest.mark.parametrize(("name", "fault"), each_fault(IN_TURN))
def test_scales_given_the_block(name: str, fault: str) -> None:
    IN_TURN[name].check("geweke", fault)
