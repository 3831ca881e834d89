"""Faults of Markov chains: acceptance, adaptation, full conditionals, closed forms, blocks, slices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.kernels.conjugate import conjugate_kernel
from bayesmc.kernels.enumerate import Enumerate
from bayesmc.kernels.factor_slice import FactorSlice
from bayesmc.kernels.random_walk import AdaptiveWalk
from bayesmc.kernels.slice import Slice
from bayesmc.structure.blanket import Blanket
from bayesmc.testing.kernels.balance import detailed_balance, invariant
from bayesmc.testing.kernels.geweke import geweke_test
from bayesmc.testing.kernels.ranks import rank_test
from bayesmc.testing.verdict import Verdict
from tests.mutants.faults import Edit
from tests.mutants.mutant import ALPHA, Mutant
from tests.mutants.tests_of import estimated, matched

Make = Callable[[], Any]
COV = np.array([[1.0, 0.4], [0.4, 0.7]])


def ranks(
    kernel: Make, net: Make, replications: int = 500, **options: Any
) -> Callable[[int], Verdict]:
    """The exact rank test of a kernel, made anew with its net."""
    return lambda seed: rank_test(
        kernel(), net(), replications=replications, alpha=ALPHA, rng=seed, **options
    )


def joint(kernel: Make, net: Make, **options: Any) -> Callable[[int], Verdict]:
    """Geweke's test of a kernel, made anew with its net."""
    return lambda seed: geweke_test(kernel(), net(), alpha=ALPHA, rng=seed, **options)


# ---- nets ---------------------------------------------------------------------------------------


def rate() -> bmc.BayesNet:
    """A rate, with counts."""
    net = bmc.BayesNet(plates={"i": 2})
    net.add("x", bmc.Gamma(2.0, 3.0))
    net.add("y", lambda x: bmc.Poisson(x), plates="i")
    return net


def location() -> bmc.BayesNet:
    """A mean whose prior is not about zero, with a hidden number and its reading."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(2.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.5))
    net.add("z", lambda y: bmc.Normal(y, 1.0))
    return net


def bounded() -> bmc.BayesNet:
    """A number between bounds, of which little is known besides."""
    net = bmc.BayesNet()
    net.add("x", bmc.Uniform(0.0, 1.2))
    net.add("y", lambda x: bmc.Normal(x, 4.0))
    return net


def robust() -> bmc.BayesNet:
    """A mean with two children and no closed form."""
    net = bmc.BayesNet()
    net.add("x", bmc.StudentT(5.0, 0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    net.add("z", lambda x: bmc.Laplace(x, 0.7))
    return net


def covariance() -> bmc.BayesNet:
    """A covariance, with hidden vectors and readings of them."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.InverseWishart(6.0, COV))
    net.add("y", lambda x: bmc.MvNormal(np.zeros(2), x), plates="i")
    net.add("z", lambda y: bmc.MvNormal(y, COV), plates="i")
    return net


def precision() -> bmc.BayesNet:
    """A precision matrix, with hidden vectors and readings of them."""
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.Wishart(6.0, COV))
    net.add("y", lambda x: bmc.MvNormal(np.zeros(2), np.linalg.inv(x)), plates="i")
    net.add("z", lambda y: bmc.MvNormal(y, COV), plates="i")
    return net


def share() -> bmc.BayesNet:
    """A share, with successes among trials."""
    net = bmc.BayesNet()
    net.add("x", bmc.Beta(2.0, 3.0))
    net.add("y", lambda x: bmc.Binomial(4, x))
    return net


def shares() -> bmc.BayesNet:
    """Shares of three words, with hidden words and readings of them."""
    net = bmc.BayesNet(plates={"i": 4})
    net.add("x", bmc.Dirichlet([1.0, 2.0, 0.7]))
    net.add("y", lambda x: bmc.Categorical(x), plates="i")
    net.add("z", lambda y: bmc.Normal(y, 1.0), plates="i")
    return net


def effects() -> bmc.BayesNet:
    """Two coupled means."""
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", lambda a: bmc.Normal(a, 0.4))
    net.add("y", lambda b: bmc.Normal(b, 0.5))
    return net


def scales() -> bmc.BayesNet:
    """A mean and a scale."""
    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("s", bmc.Gamma(3.0, 3.0))
    net.add("y", lambda m, s: bmc.Normal(m, s))
    return net


def veiled() -> bmc.BayesNet:
    """A mean with a reading, and another whose density holds the mean in a closure."""

    def reading(x: Any) -> bmc.Density:
        return bmc.Density(
            lambda z: -0.5 * ((z - x) / 0.5) ** 2 - np.log(0.5 * np.sqrt(2 * np.pi)),
            lambda rng, shape: x + 0.5 * rng.standard_normal(shape + np.shape(x)),
        )

    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(x, 1.0))
    net.add("z", reading)
    return net


def signed() -> bmc.BayesNet:
    """A scale that may be negative."""
    net = bmc.BayesNet()
    net.add("s", bmc.Normal(0.5, 1.0))
    net.add("y", lambda s: bmc.Normal(0.0, s))
    return net


def mean_scale(rng: np.random.Generator) -> dict[str, Any]:
    """An estimate of the mean of that scale."""
    engine = bmc.Gibbs(draws=60, warmup=20, chains=20)
    return {"s": bmc.infer(signed(), {"y": 0.5}, engine=engine, rng=rng).mean("s")}


def exact_mean_scale() -> float:
    s = np.linspace(1e-4, 9.0, 100_001)
    weights = np.exp(-0.5 * (s - 0.5) ** 2 - 0.5 * (0.5 / s) ** 2) / s
    return float((s * weights).sum() / weights.sum())


def count() -> bmc.BayesNet:
    """A number, of which some are seen."""
    net = bmc.BayesNet()
    net.add("x", bmc.Binomial(20, 0.3))
    net.add("y", lambda x: bmc.Binomial(x, 0.2))
    return net


def ring() -> bmc.FactorGraph:
    """Four sites round a ring that like to agree, three of which meet."""
    graph = bmc.FactorGraph("ring", plates={"i": 4})
    graph.variable("s", bmc.Bernoulli(0.5).support, plates="i")
    graph.factor(lambda a, b: 0.9 * (a == b), scope=("s", "s"), index=([0, 1, 2, 3], [1, 2, 3, 0]))
    graph.factor(lambda a, b, c: 0.6 * a * b * c, scope=("s", "s", "s"), index=([0], [1], [2]))
    return graph


def linked() -> bmc.BayesNet:
    """A switch that reaches a reading through what is computed from it."""
    net = bmc.BayesNet()
    net.add("k", bmc.Bernoulli(0.1))
    net.add("x", bmc.Normal(0.0, 0.7))
    net.add("s", lambda k: 3.0 * k)
    net.add("y", lambda s, x: bmc.Normal(s + x, 1.5))
    return net


def three() -> bmc.BayesNet:
    """A node of three states, and a reading of it."""
    net = bmc.BayesNet()
    net.add("x", bmc.Categorical([0.2, 0.3, 0.5]))
    net.add("y", lambda x: bmc.Bernoulli(0.2 + 0.3 * x))
    return net


def slices() -> bmc.BayesNet:
    """A hidden chain of five states that are more likely to go up than down, its middle and end seen."""
    net = bmc.BayesNet()
    net.add("s[0]", bmc.Bernoulli(0.3))
    for t in range(1, 5):
        net.add(f"s[{t}]", lambda s: bmc.Bernoulli(0.35 + 0.5 * s), parents=[f"s[{t - 1}]"])
    for t in (2, 4):
        net.add(f"y[{t}]", lambda s: bmc.Bernoulli(0.2 + 0.5 * s), parents=[f"s[{t}]"])
    return net


def of_slices(seed: int) -> Verdict:
    return invariant(bmc.Gibbs(), slices(), {"y[2]": 1, "y[4]": 0}, alpha=ALPHA, rng=seed)


def enumerated(target: Any) -> Enumerate:
    return Enumerate(Blanket(target, "x"))


def closed_form(target: Any) -> Any:
    return conjugate_kernel(Blanket(target, "x"))


def walk(target: Any) -> AdaptiveWalk:
    return AdaptiveWalk(Blanket(target, "x"), scale=1.2, adaptive=False)


def own_scale_walk(target: Any) -> AdaptiveWalk:
    return AdaptiveWalk(Blanket(target, "x"), scale=1.5, adaptive=False, unconstrained=False)


def sliced(target: Any) -> Slice:
    return Slice(Blanket(target, "x"))


MUTANTS = [
    Mutant(
        "a Hastings term is missing",
        (Edit("bayesmc.kernels.proposed:Proposed.step",
              "log_ratio + self._backward(state, found.new, members)", "log_ratio + forward"),),
        ranks(lambda: bmc.MetropolisHastings(proposal={"x": lambda x: bmc.LogNormal(np.log(x), 1.0)}),
              rate, 1000, warmup=0),
        "rank_test, 1000 replications",
    ),
    Mutant(
        "a Jacobian is missing: a random walk on the free scale",
        (Edit("bayesmc.kernels.random_walk:AdaptiveWalk.step",
              "found.own + found.rest + grown", "found.own + found.rest"),),
        ranks(lambda: walk, rate, 1000, warmup=0),
        "rank_test, 1000 replications",
    ),
    Mutant(
        "a Jacobian is missing: ensembles",
        (Edit("bayesmc.kernels.ensemble:BlockWalk._volume",
              "return (flat if part.free is None else flat[:, part.free]).sum(axis=1)",
              "return np.zeros(len(free))"),),
        ranks(lambda: bmc.MetropolisHastings(), scales, 300, warmup=30),
        "rank_test, 300 replications of ensembles",
    ),
    Mutant(
        "a Jacobian is missing: slices along learnt directions",
        (Edit("bayesmc.kernels.factor_slice:FactorSlice._split",
              "volume + transform.log_abs_det_jacobian(part)", "volume"),),
        ranks(lambda: lambda target: FactorSlice(target, ("m", "s")), scales, 600, warmup=10),
        "rank_test, 600 replications",
    ),
    Mutant(
        "adaptation never freezes",
        (Edit("bayesmc.kernels.ensemble:BlockWalk.step", "if warmup:", "if True:"),),
        ranks(lambda: bmc.MetropolisHastings(), scales, 50, warmup=30),
        "rank_test, 50 replications (for certain)",
    ),
    Mutant(
        "the acceptance ratio is squared",
        (Edit("bayesmc.kernels.densities:accepted", "< log_ratio", "< 2.0 * log_ratio"),),
        ranks(lambda: own_scale_walk, location, 2000, warmup=0, thinning=3),
        "rank_test, 2000 replications",
    ),
    Mutant(
        "a proposal from a node's own density counts that density twice",
        (Edit("bayesmc.kernels.jump:Jump.step",
              "np.where(drawn & ~found.dead, 0.0, found.own)", "found.own"),),
        matched(count, {"y": 1}, bmc.MetropolisHastings(draws=200, warmup=30, chains=100)),
        "compare with exact(), 100 chains of 200 draws",
    ),
    Mutant(
        "a child is left out of a full conditional",
        (Edit("bayesmc.structure.blanket:Blanket.log_density",
              "for child in self.children:", "for child in self.children[:-1]:"),),
        ranks(lambda: bmc.Gibbs(), robust, warmup=20),
        "rank_test, 500 replications",
    ),
    Mutant(
        "a child that hides its parent in a closure is left out of a closed form",
        (Edit("bayesmc.kernels.conjugate_children:children_of", "return term", "continue"),),
        ranks(lambda: bmc.Gibbs(), veiled, warmup=20),
        "rank_test, 500 replications",
    ),
    Mutant(
        "parameters out of range have the density of those put in their place",
        (Edit("bayesmc.structure.target:Term.log_of",
              "np.where(dist.invalid, -np.inf, result)", "result"),),
        estimated(mean_scale, {"s": exact_mean_scale()}, 14),
        "14 runs against a grid",
    ),
    Mutant(
        "slices: the first interval lies about the point, and does not step out",
        (Edit("bayesmc.kernels.slice:slice_move", "x - width * rng.random(x.shape)", "x - 0.5 * width",
              (("going &= left_over > 0", "going &= False"),)),),
        ranks(lambda: sliced, bounded, 4000, warmup=0, thinning=3,
              statistics={"spread": lambda x: (x - 0.6) ** 2}),
        "rank_test, 4000 replications",
    ),
    Mutant(
        "slices: the level is the density itself",
        (Edit("bayesmc.kernels.slice:slice_move",
              "found[0] - rng.standard_exponential(x.shape)", "found[0] - 0.1"),),
        ranks(lambda: sliced, robust, 500, warmup=0),
        "rank_test, 500 replications",
    ),
    Mutant(
        "inverse-Wishart degrees of freedom are off by d",
        (Edit("bayesmc.kernels.conjugate_terms:naturals_of",
              "return [reshape(df, (count,)), ", "return [add(reshape(df, (count,)), 2.0), "),),
        ranks(lambda: closed_form, covariance, 700),
        "rank_test, 700 replications",
    ),
    Mutant(
        "a Wishart's scale is taken for its inverse",
        (Edit("bayesmc.kernels.conjugate_terms:naturals_of",
              "if base.make is Wishart:", "if base.make is None:"),),
        ranks(lambda: closed_form, precision, 700),
        "rank_test, 700 replications",
    ),
    Mutant(
        "a mean is ignored",
        (Edit("bayesmc.passes.features:_square",
              "term = elementwise(np.square, u) if f == g else multiply(2.0, multiply(u, v))",
              "term = elementwise(np.square, u) if f == g else multiply(0.0, multiply(u, v))"),),
        ranks(lambda: closed_form, location, 400),
        "rank_test, 400 replications",
    ),
    Mutant(
        "a conjugate rate is taken for a scale",
        (Edit("bayesmc.kernels.conjugate_families:GammaConditional.draw",
              "rng.standard_gamma(concentration, shape) / rate",
              "rng.standard_gamma(concentration, shape) * rate"),),
        ranks(lambda: bmc.Gibbs(), rate),
        "rank_test, 500 replications",
    ),
    Mutant(
        "a Gamma's shape is off by one",
        (Edit("bayesmc.kernels.conjugate_families:GammaConditional.draw",
              "(naturals[0] + 1.0) / self.power", "(naturals[0] + 2.0) / self.power"),),
        ranks(lambda: bmc.Gibbs(), rate),
        "rank_test, 500 replications",
    ),
    Mutant(
        "failures are counted as trials",
        (Edit("bayesmc.passes.log_density:_binomial",
              "rest = total_count - x", "rest = total_count + 0 * x"),),
        joint(lambda: bmc.Gibbs(), share, draws=40),
        "geweke_test, 40 draws of 64 chains",
    ),
    Mutant(
        "counts go to the neighbouring category",
        (Edit("bayesmc.kernels.conjugate_families:DirichletConditional.posterior",
              "Dirichlet(naturals[0] + 1.0)", "Dirichlet(np.roll(naturals[0] + 1.0, 1, axis=-1))"),),
        ranks(lambda: closed_form, shares, 400),
        "rank_test, 400 replications",
    ),
    Mutant(
        "a variance is taken for a standard deviation: a block of means",
        (Edit("bayesmc.kernels.gaussian_rows:NormalRows._summed",
              "weight = scale**-2.0", "weight = scale**-4.0"),),
        matched(effects, {"y": 1.0}, bmc.Gibbs(draws=100, warmup=0, chains=20)),
        "compare with exact(), 20 chains of 100 draws",
    ),
    Mutant(
        "coupled sites are updated in parallel",
        (Edit("bayesmc.structure.blanket:colours",
              "found = _two(count, both)", "found = np.zeros(count, dtype=np.intp)"),),
        lambda seed: invariant(bmc.Gibbs(), ring(), alpha=ALPHA, rng=seed),
        "invariant (exact)",
    ),
    Mutant(
        "an enumeration loses the last state",
        (Edit("bayesmc.categorical:pick_log", "in sums[1:-1]", "in sums[1:-2]"),),
        lambda seed: detailed_balance(enumerated, three(), {"y": 1}, alpha=ALPHA, rng=seed),
        "detailed_balance (exact)",
    ),
    Mutant(
        "forests: what leaves say is not passed on",
        (Edit("bayesmc.kernels.forest:_Round.sum_out",
              "single[:, self.stems] += sums", "single[:, self.stems] += 0.0 * sums"),),
        of_slices,
        "invariant (exact)",
    ),
    Mutant(
        "forests: backwards one of two neighbours is ignored",
        (Edit("bayesmc.kernels.forest:_Round.draw",
              "log[:, end:] += given[:, : len(self.left.variables)]", "pass"),),
        of_slices,
        "invariant (exact)",
    ),
    Mutant(
        "forests: a table is read the wrong way round",
        (Edit("bayesmc.kernels.forest:_Side._places",
              "first = self.is_first[:, None]", "first = ~self.is_first[:, None]"),),
        of_slices,
        "invariant (exact)",
    ),
    Mutant(
        "forests: a product of tables is normalised by columns alone",
        (Edit("bayesmc.kernels.forest:_log_product",
              "np.log(product) + top_left[:, None] + top_right", "np.log(product) + top_left[:, None]"),),
        of_slices,
        "invariant (exact)",
    ),
    Mutant(
        "a deterministic node is stale",
        (Edit("bayesmc.engines.mcmc.sweep:SweepSampler.step",
              "self.target.refresh(values, kernel.names)", "pass"),),
        matched(linked, {"y": 2.7}, bmc.Gibbs(draws=10, warmup=30, chains=300)),
        "compare with exact(), 300 chains of 10 draws",
    ),
    Mutant(
        "a walk that is drawn to the origin is taken for symmetric",
        (Edit("bayesmc.kernels.random_walk:AdaptiveWalk.step",
              "free + self.steps.draw", "0.7 * free + self.steps.draw"),),
        ranks(lambda: own_scale_walk, location, 3000, warmup=0, thinning=3),
        "rank_test, 3000 replications",
    ),
    Mutant(
        "a node's own density is left out of its full conditional",
        (Edit("bayesmc.structure.blanket:Blanket.log_density",
              "total = self.own_log(state, members)", "total = 0.0 * self.own_log(state, members)"),),
        lambda seed: invariant(enumerated, three(), {"y": 1}, alpha=ALPHA, rng=seed),
        "invariant (exact)",
    ),
]  # fmt: skip
