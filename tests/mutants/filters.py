"""Faults over time: particle filters, smoothers and the chains made of them, Kalman and discrete filters."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc.testing.oracles.answers import exact
from bayesmc.testing.posteriors.repeated import repeated_test
from bayesmc.testing.verdict import Verdict
from tests.mutants.faults import Edit
from tests.mutants.mutant import ALPHA, Mutant
from tests.mutants.tests_of import Test, evidence_of, matched, slices, stated


def line() -> bmc.DynamicBayesNet:
    """A number that walks, with readings."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.7), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.6))
    return dbn


def lagged() -> bmc.DynamicBayesNet:
    """A number that swings, by its value two slices back."""
    dbn = bmc.DynamicBayesNet()
    start = bmc.Normal(0.0, 1.0)
    dbn.add("x", lambda x_prev, l_prev: bmc.Normal(1.2 * x_prev - 0.8 * l_prev, 0.5), initial=start)
    dbn.add("b", start)
    dbn.add("l", lambda x_prev: x_prev, initial=lambda b: b)
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


def counted() -> bmc.DynamicBayesNet:
    """A number that walks, with counts."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.7), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Binomial(12, logits=x))
    return dbn


def jumping() -> bmc.DynamicBayesNet:
    """A number that stays or jumps, with readings."""
    dbn = bmc.DynamicBayesNet()

    def move(x_prev: np.ndarray) -> bmc.Mixture:
        return bmc.Mixture([0.7, 0.3], [bmc.Normal(x_prev, 0.3), bmc.Normal(x_prev + 2.0, 0.5)])

    dbn.add("x", move, initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.6))
    return dbn


def machine() -> bmc.DynamicBayesNet:
    """Three states that follow each other, with readings."""
    dbn = bmc.DynamicBayesNet()
    step = np.array([[0.1, 0.8, 0.1], [0.1, 0.2, 0.7], [0.6, 0.1, 0.3]])
    dbn.add(
        "z", lambda z_prev: bmc.Categorical(step[z_prev]), initial=bmc.Categorical([0.6, 0.3, 0.1])
    )
    dbn.add("y", lambda z: bmc.Normal(1.5 * z, 1.0))
    return dbn


def driven() -> bmc.DynamicBayesNet:
    """A level that is pushed and shaken by a regime, which starts otherwise than it goes on."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("z", ["z_prev"], [[0.7, 0.3], [0.4, 0.6]], initial=[0.2, 0.8])
    dbn.add(
        "x",
        lambda x_prev, z: bmc.Normal(0.9 * x_prev + 1.5 * z, np.where(z == 1, 1.5, 0.3)),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    return dbn


def driven_by_the_last() -> bmc.DynamicBayesNet:
    """The same by the regime of the slice before."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("z", ["z_prev"], [[0.7, 0.3], [0.4, 0.6]], initial=[0.2, 0.8])
    dbn.add(
        "x",
        lambda x_prev, z_prev: bmc.Normal(0.9 * x_prev + 3.0 * z_prev, 0.5),
        initial=bmc.Normal(0.0, 1.0),
    )
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    return dbn


def shaken() -> bmc.DynamicBayesNet:
    """A level that is shaken, more or less, by a regime that has a sensor of its own."""
    dbn = bmc.DynamicBayesNet()
    dbn.table("z", ["z_prev"], [[0.9, 0.1], [0.1, 0.9]], initial=[0.5, 0.5])
    dbn.add(
        "x",
        lambda x_prev, z: bmc.Normal(x_prev, np.where(z == 1, 3.0, 0.2)),
        initial=bmc.Normal(0.0, 3.0),
    )
    dbn.table("w", ["z"], [[0.9, 0.1], [0.1, 0.9]])
    dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    return dbn


def unknown_drift() -> bmc.DynamicBayesNet:
    """A walk with a drift that is not known."""
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("d", bmc.Normal(0.0, 1.0))
    dbn.add("x", lambda x_prev, d: bmc.Normal(x_prev + d, 0.7), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 0.6))
    return dbn


def counts() -> bmc.DynamicBayesNet:
    """A slow rate of trials."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev: bmc.Normal(-4 + 0.98 * (x_prev + 4), 0.15),
        initial=bmc.Normal(-4.0, 0.754),
    )
    dbn.add("y", lambda x: bmc.Binomial(50, logits=x))
    return dbn


def grid_error(seed: int) -> Verdict:
    """By how much the log evidence on few cells is off beyond its stated error: by nothing."""
    rows = {"y": counts().sample(100, rng=3)["y"][0]}
    fine = bmc.GridFilter({"x": (-10.0, 4.0, 1000)}, tolerance=np.inf)

    def beyond(rng: np.random.Generator) -> float:
        few = bmc.GridFilter(cells=28, tolerance=np.inf)
        found, truth = (bmc.filter(counts(), rows, engine=e) for e in (few, fine))
        off = abs(found.log_marginal_likelihood - truth.log_marginal_likelihood)
        return max(off - found.log_marginal_likelihood_mcse, 0.0)

    return repeated_test(beyond, 0.0, replications=2, alpha=ALPHA, rng=seed)


def squares(seed: int) -> Verdict:
    """A function of the state under the exact filter, by its mean and variance."""

    def asked(rng: np.random.Generator) -> np.ndarray:
        return bmc.filter(line(), ROWS, queries={"q": lambda x: x**2}).queries["q"]

    plain = bmc.filter(line(), ROWS)
    right = plain.mean("x") ** 2 + plain.var("x")
    return repeated_test(asked, right, replications=2, alpha=ALPHA, rng=seed)


def variance_of_driven(seed: int) -> Verdict:
    """Filtered second moments of what is integrated out, times the ratio of evidences."""
    right = exact(driven(), MILD)

    def estimate(rng: np.random.Generator) -> float:
        engine = bmc.ParticleFilter(300, marginalize="auto")
        found = bmc.filter(driven(), MILD, engine=engine, rng=rng)
        ratio = np.exp(found.log_marginal_likelihood - right.log_marginal_likelihood)
        return float(ratio * (found.var("x")[-1] + found.mean("x")[-1] ** 2))

    wanted = right.var("x")[-1] + right.mean("x")[-1] ** 2
    return repeated_test(estimate, wanted, replications=40, alpha=ALPHA, rng=seed)


ROWS = {"y": [0.5, 1.5, 3.0, 2.0]}
RISING = {"y": [0.0, 2.0, 4.0]}
PARTICLES = "unbiased_evidence_test, 100 runs of 30 particles"
MILD = {"y": [0.3, 0.8, 1.2, 0.7]}
STATED = "stated_errors_test, 150 runs of 300 particles"
LONG = {
    "y": [0.3, 0.8, 1.2, 0.7, -0.4, -1.3, -0.5, 0.2, 0.9, 1.6, 1.1, 0.1, -0.7, 0.0, 0.6, 1.4] * 4
}
BLIND = {"y": [np.nan] * 5 + [0.5], "w": [0, 0, 1, 0, 0, 0]}
ALWAYS = bmc.ParticleFilter(30, ess_threshold=2.0)
OPTIMAL = bmc.ParticleFilter(30, marginalize="auto", proposal="optimal")


def after_pickle(engine: Any, rows: list[float] | None, runs: int) -> Test:
    """A belief that goes through a pickle after its first row.

    Of given rows its evidence is judged; of drawn ones (None) its error, which is free of what was seen.
    """

    def test(seed: int) -> Verdict:
        dbn = line()
        log = 0.0 if rows is None else bmc.filter(dbn, {"y": rows}).log_marginal_likelihood

        def estimate(rng: np.random.Generator) -> float:
            drawn = dbn.sample(2, rng=rng)
            seen = drawn["y"][0] if rows is None else rows
            belief = engine.step(engine.start(dbn, rng=rng), {"y": seen[0]})
            belief = engine.start(dbn, belief=pickle.loads(pickle.dumps(belief)))
            for row in seen[1:]:
                belief = engine.step(belief, {"y": row})
            if rows is None:
                return float((drawn["x"][0, -1] - belief.mean("x")) * seen[0])
            return float(np.exp(belief.log_marginal_likelihood - log))

        right = 0.0 if rows is None else 1.0
        return repeated_test(estimate, right, replications=runs, alpha=ALPHA, rng=seed)

    return test


MUTANTS = [
    Mutant(
        "a belief out of a pickle forgets the evidence so far",
        (Edit("bayesmc.engines.particles.belief:bound",
              "belief.log_marginal_likelihood,", "0.0,"),),
        after_pickle(bmc.ParticleFilter(200), MILD["y"], 100),
        "repeated_test, 100 runs of 200 particles",
    ),
    Mutant(
        "a belief out of a pickle expects the opposite",
        (Edit("bayesmc.engines.kalman.filter:GaussianFilter._bound",
              "taken._replace(layout=layout)", "taken._replace(layout=layout, mean=-taken.mean)"),),
        after_pickle(bmc.KalmanFilter(), None, 200),
        "repeated_test, 200 series",
    ),
    Mutant(
        "weights are not reset after resampling",
        (Edit("bayesmc.engines.particles.smc:SMCStep.selected",
              "carried: Any = 0.0", "carried: Any = earlier.log_weights[chosen]"),),
        evidence_of(line, MILD, ALWAYS, 100),
        PARTICLES,
    ),
    Mutant(
        "the log evidence forgets earlier weights where it does not resample",
        (Edit("bayesmc.engines.particles.smc:SMCStep.weighted",
              "log_total - spent, ess,", "float(np.log(np.mean(np.exp(log - carried)))), ess,"),),
        evidence_of(line, MILD, bmc.ParticleFilter(30, ess_threshold=0.0), 200),
        "unbiased_evidence_test, 200 runs of 30 particles",
    ),
    Mutant(
        "an auxiliary filter forgets the first-stage weights",
        (Edit("bayesmc.engines.particles.smc:SMCStep.selected",
              "carried = -np.take_along_axis(factor, chosen, 0)",
              "carried = 0.0"),),
        evidence_of(line, MILD, bmc.ParticleFilter(30, ess_threshold=2.0, auxiliary=True), 100),
        PARTICLES,
    ),
    Mutant(
        "an auxiliary filter's evidence forgets the first stage",
        (Edit("bayesmc.engines.particles.smc:SMCStep.selected",
              "gained = level + np.log(chosen_from) - total", "gained = 0.0"),),
        evidence_of(line, MILD, bmc.ParticleFilter(30, ess_threshold=2.0, auxiliary=True), 100),
        PARTICLES,
    ),
    Mutant(
        "offspring are those of the particle next door",
        (Edit("bayesmc.engines.particles.smc:SMCStep.taken",
              'value.take(ancestors, axis=0, mode="clip")',
              'value.take(ancestors + 1, axis=0, mode="wrap")'),),
        slices(bmc.filter, line, ROWS, bmc.ParticleFilter(300, ess_threshold=2.0), 60),
        "repeated_test of filter, 60 runs of 300 particles",
    ),
    Mutant(
        "the stated error of the evidence is halved",
        (Edit("bayesmc.engines.particles.genealogy:evidence_error",
              "np.sqrt(total + 0.25 * total**2)", "0.5 * np.sqrt(total + 0.25 * total**2)"),),
        stated(line, LONG, bmc.ParticleFilter(300), 150),
        STATED,
    ),
    Mutant(
        "the stated error of the evidence is that of the last families alone",
        (Edit("bayesmc.engines.particles.genealogy:evidence_error",
              "np.maximum(families.settled + variance[OLD], variance[OLD])", "variance[YOUNG]"),),
        stated(line, LONG, bmc.ParticleFilter(300), 150),
        STATED,
    ),
    Mutant(
        "families stay where they were",
        (Edit("bayesmc.engines.particles.genealogy:_searched",
              "ancestors.searchsorted(bounds)", "bounds"),),
        stated(line, LONG, bmc.ParticleFilter(300), 150),
        STATED,
    ),
    Mutant(
        "the stated error of a mean is halved",
        (Edit("bayesmc.engines.particles.errors:by_shares",
              "(parts**2 /", "0.25 * (parts**2 /"),),
        stated(line, {"y": LONG["y"][:16]}, bmc.ParticleFilter(300), 600),
        "stated_errors_test, 600 runs of 300 particles",
        is_long=True,
    ),
    Mutant(
        "backward simulation leaves the transition out",
        (Edit("bayesmc.engines.particles.backward:Backward._drawn",
              "self.log_densities(here, drawn, series, k, len(mine)) + here.log_weights",
              "np.broadcast_to(here.log_weights, (len(mine), *here.log_weights.shape))"),),
        slices(bmc.smooth, line, RISING, bmc.ParticleFilter(300), 20, backward="exact"),
        "repeated_test of smooth, 20 runs of 300 particles",
    ),
    Mutant(
        "backward simulation of lags looks at the next slice alone",
        (Edit("bayesmc.engines.particles.backward:Backward._log",
              "zip(self.layers, after.values, strict=False)",
              "zip(self.layers[:1], after.values, strict=False)"),),
        slices(bmc.smooth, lagged, {"y": [0.0, 2.0, 0.0, -2.0]}, bmc.ParticleFilter(300), 20),
        "repeated_test of smooth, 20 runs of 300 particles",
    ),
    Mutant(
        "a guided draw is weighed as if none came from its own density",
        (Edit("bayesmc.engines.particles.optimal:Guarded.__call__",
              "mixture = np.logaddexp(math.log1p(-SHARE) + log_q, math.log(SHARE) + log_p)",
              "mixture = log_q"),),
        evidence_of(counted, {"y": [9, 2]}, bmc.ParticleFilter(30, proposal="optimal"), 150),
        "unbiased_evidence_test, 150 runs of 30 particles",
    ),
    Mutant(
        "a guide made of cases forgets how likely each is",
        (Edit("bayesmc.engines.particles.mixtures:ByCase.log_density",
              "np.where(share == -np.inf, -np.inf, share + look.log_density(values, belief))",
              "look.log_density(values, belief)"),),
        evidence_of(jumping, {"y": [0.5, 2.0]}, bmc.ParticleFilter(30, proposal="optimal"), 150),
        "unbiased_evidence_test, 150 runs of 30 particles",
    ),
    Mutant(
        "backward simulation by rejection accepts everything",
        (Edit("bayesmc.engines.particles.backward:Backward._by_rejection",
              "< log - bound", "< 0.0 * log"),),
        slices(bmc.smooth, line, RISING, bmc.ParticleFilter(300), 20),
        "repeated_test of smooth, 20 runs of 300 particles",
    ),
    Mutant(
        "a start is sampled, and kept in the covariance as well",
        (Edit("bayesmc.engines.marginal.step:MarginalStep._taken",
              "made.chosen(None)",
              "(lambda g: g._replace(mean=g.drawn(rng)) if row.t == 0 else g)(made.chosen(None))"),),
        evidence_of(shaken, BLIND, bmc.ParticleFilter(100, marginalize="auto"), 200),
        "unbiased_evidence_test, 200 runs of 100 particles",
    ),
    Mutant(
        "finite nodes drawn given the row are not weighed by p/q",
        (Edit("bayesmc.engines.marginal.step:MarginalStep._taken",
              "log + own, after._replace(", "log + each.log.mean(axis=1), after._replace("),),
        evidence_of(driven, MILD, OPTIMAL, 150),
        "unbiased_evidence_test, 150 runs of 30 particles",
    ),
    Mutant(
        "a Kalman filter for each particle takes this slice's regime for the last one's",
        (Edit("bayesmc.engines.marginal.step:MarginalStep._values",
              "self.taken(k, v, selection.ancestors)",
              "values.get(k.removesuffix('_prev'), self.taken(k, v, selection.ancestors))"),),
        evidence_of(driven_by_the_last, MILD, bmc.ParticleFilter(30, marginalize="auto"), 150),
        "unbiased_evidence_test, 150 runs of 30 particles",
    ),
    Mutant(
        "covariances are not resampled",
        (Edit("bayesmc.engines.marginal.gaussians:Gaussians.taken",
              "which=self.which.take(ancestors)", "which=self.which[: len(ancestors)]"),),
        evidence_of(shaken, BLIND,
                    bmc.ParticleFilter(100, marginalize="auto", ess_threshold=2.0), 200),
        "unbiased_evidence_test, 200 runs of 100 particles",
        is_long=True,
    ),
    Mutant(
        "beliefs along smoothed paths are those of the filter",
        (Edit("bayesmc.engines.marginal.smoothing:_Paths.believed",
              "combined(messages[k].numbers, filtered)", "filtered"),),
        slices(bmc.smooth, driven, MILD, bmc.ParticleFilter(100, marginalize="auto"), 25),
        "repeated_test of smooth, 25 runs of 100 particles",
    ),
    Mutant(
        "the variance of what is integrated out is that of the particles' means",
        (Edit("bayesmc.engines.particles.blocks:Block._moments",
              "variance += self.weighted(self.turned(inside, self._axes(node)))", "pass"),),
        variance_of_driven,
        "repeated_test of variances, 40 runs of 300 particles",
    ),
    Mutant(
        "a Kalman filter predicts without process noise",
        (Edit("bayesmc.engines.kalman.covariances:worked_out",
              "rows_of(moves, noise, states.root(state), pattern.absent)",
              "rows_of(moves, np.where(np.arange(len(noise))[:, None] < len(pattern.observed), "
              "noise, 0.0) if k else noise, states.root(state), pattern.absent)"),),
        slices(bmc.filter, line, ROWS, bmc.KalmanFilter(), 2),
        "repeated_test of filter (no draws)",
    ),
    Mutant(
        "a Kalman smoother stops after one slice",
        (Edit("bayesmc.engines.kalman.passes:_back_in_numbers",
              "here = shifts[k] + link * here", "here = shifts[k]"),),
        slices(bmc.smooth, line, ROWS, bmc.KalmanFilter(), 2),
        "repeated_test of smooth (no draws)",
    ),
    Mutant(
        "the stated error of a found grid is half as large",
        (Edit("bayesmc.engines.grid.automatic:_Search.answer", "off = times *", "off = 0.5 *"),),
        grid_error,
        "repeated_test of what exceeds the stated error (no draws)",
    ),
    Mutant(
        "queries under a Gaussian belief take it for narrower",
        (Edit("bayesmc.engines.averages:over_normal", "-0.5 * points**2", "-0.6 * points**2"),),
        squares,
        "repeated_test of a query (no draws)",
    ),
    Mutant(
        "a discrete filter's transition is transposed",
        (Edit("bayesmc.engines.discrete.chain:_forward_one",
              "dot(last, step, out=ahead)", "dot(step, last, out=ahead)"),),
        slices(bmc.filter, machine, ROWS, bmc.DiscreteFilter(), 2),
        "repeated_test of filter (no draws)",
    ),
    Mutant(
        "a discrete smoother's transition is transposed",
        (Edit("bayesmc.engines.discrete.chain:_back", "np.swapaxes(matrix, -1, -2)", "matrix"),),
        slices(bmc.smooth, machine, ROWS, bmc.DiscreteFilter(), 2),
        "repeated_test of smooth (no draws)",
    ),
    Mutant(
        "particle Metropolis forgets the prior",
        (Edit("bayesmc.pmcmc.walk:ParameterWalk.step",
              "(grown - log) + (estimate - likelihood)", "estimate - likelihood"),),
        matched(unknown_drift, RISING,
                bmc.ParticleMetropolis(draws=100, warmup=30, chains=30, particles=20)),
        "compare with exact(), 30 chains of 100 draws",
    ),
    Mutant(
        "particle Metropolis takes the estimate anew at every step",
        (Edit("bayesmc.pmcmc.walk:ParameterWalk.step",
              "np.where(accept, estimate, likelihood)", "estimate"),),
        matched(unknown_drift, RISING,
                bmc.ParticleMetropolis(draws=100, warmup=30, chains=30, particles=10)),
        "compare with exact(), 30 chains of 100 draws",
    ),
    Mutant(
        "particle Metropolis takes steps to anywhere for symmetric",
        (Edit("bayesmc.pmcmc.walk:ParameterWalk.step",
              "(estimate - likelihood) + backward", "(estimate - likelihood)"),),
        matched(unknown_drift, RISING,
                bmc.ParticleMetropolis(draws=100, warmup=30, chains=30, particles=20)),
        "compare with exact(), 30 chains of 100 draws",
    ),
    Mutant(
        "particle Gibbs does not keep the trajectory",
        (Edit("bayesmc.pmcmc.filters:ConditionalStep.kept_among", "found[-1] = trajectory", "pass"),),
        matched(line, RISING, bmc.ParticleGibbs(draws=100, warmup=20, chains=40, particles=4)),
        "compare with exact(), 40 chains of 100 draws",
    ),
]  # fmt: skip
