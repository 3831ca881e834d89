"""Pictures of answers are held by what is drawn on the axes: lines, bars, bands; not by pixels."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot

import bayesmc as bmc
from bayesmc import plotting
from bayesmc.plotting.chains import _worth
from bayesmc.plotting.particles import _survivors

pyplot.switch_backend("agg")


@pytest.fixture(autouse=True)
def _close_figures():
    settings = dict(matplotlib.rcParams)
    yield
    pyplot.close("all")
    assert dict(matplotlib.rcParams) == settings


@pytest.fixture(scope="module")
def chains():
    net = bmc.BayesNet(plates={"school": ["A", "B"]})
    net.add("mu", bmc.Normal(0.0, 2.0))
    net.add("effect", lambda mu: bmc.Normal(mu, 1.0), plates="school")
    net.add("y", lambda effect: bmc.Normal(effect, 1.0), plates="school")
    return bmc.infer(net, {"y": [1.0, 2.0]}, engine=bmc.Gibbs(300, warmup=50), rng=0)


@pytest.fixture(scope="module")
def level():
    dbn = bmc.DynamicBayesNet("level")
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


ROWS = {"y": [0.3, 1.1, np.nan, 2.0, 1.4]}


@pytest.fixture(scope="module")
def particles(level):
    engine = bmc.ParticleFilter(40, ess_threshold=0.9)
    return bmc.filter(level, ROWS, engine=engine, rng=1, keep="particles")


def lines_of(ax, marker="None"):
    return [line for line in ax.lines if line.get_marker() == marker]


# ---- Markov chains ------------------------------------------------------------------------------


def test_traces_are_the_draws(chains) -> None:
    axes = chains.plot.trace(["mu", ("effect", 1)])
    assert [ax.get_title() for ax in axes[:, 0]] == ["mu", "effect[B]"]
    for k, line in enumerate(axes[1, 1].lines):
        assert np.array_equal(line.get_ydata(), chains["effect"][k, :, 1])
    given = pyplot.subplots(2, 2)[1]
    before = pyplot.get_fignums()
    assert chains.plot.trace(["mu", ("effect", 1)], axes=given)[0, 0] is given[0, 0]
    assert pyplot.get_fignums() == before
    with pytest.raises(ValueError, match="4 axes for 1 x 2 panels"):
        chains.plot.trace("mu", axes=given)
    assert len(chains.plot.trace()) == 3


def test_divergences_are_ticked_and_crossed(chains) -> None:
    chains.divergences = np.zeros((4, 300), dtype=bool)
    chains.divergences[2, [5, 70]] = True
    try:
        trace, pair = chains.plot.trace("mu"), chains.plot.pair(["mu", ("effect", 0)])
    finally:
        chains.divergences = None
    (ticks,) = lines_of(trace[0, 1], "|")
    assert ticks.get_xdata().tolist() == [5, 70]
    (crosses,) = lines_of(pair[1, 0], "x")
    assert np.array_equal(crosses.get_xdata(), chains["mu"][2, [5, 70]])
    assert np.array_equal(crosses.get_ydata(), chains["effect"][2, [5, 70], 0])
    assert not pair[0, 1].axison
    assert [t.get_text() for t in pair[0, 1].get_legend().get_texts()] == ["2 divergences"]


def test_a_chain_elsewhere_leaves_the_band_of_ranks(chains) -> None:
    def farthest(posterior) -> float:
        (ax,) = posterior.plot.rank("mu")
        band = ax.collections[0].get_paths()[0].vertices[:, 1].max()
        return max(np.abs(line.get_ydata()).max() for line in ax.lines[1:]) / band

    assert farthest(chains) < 1.0
    kept = chains._stored
    moved = np.array(kept["mu"])
    moved[1] += 2.0
    chains._stored = {**kept, "mu": moved}
    try:
        assert farthest(chains) > 1.0
    finally:
        chains._stored = kept
    assert _worth(np.random.default_rng(0).normal(size=(4, 500))) > 300


def test_forests_draw_intervals(chains) -> None:
    ax = chains.plot.forest()
    assert [t.get_text() for t in ax.get_yticklabels()] == ["mu", "effect[A]", "effect[B]"]
    outer, inner = lines_of(ax)[:2]
    assert np.allclose(outer.get_xdata(), chains.hdi("mu", 0.89))
    assert np.allclose(inner.get_xdata(), chains.hdi("mu", 0.5))
    both = plotting.plot_forest({"one": chains, "two": chains}, "mu")
    assert [t.get_text() for t in both.get_legend().get_texts()] == ["one", "two"]
    with pytest.raises(bmc.errors.QueryError, match="between 0 and 1"):
        chains.plot.forest(prob=95)


def test_numbers_are_named_as_summaries_name_them(chains) -> None:
    ax = chains.plot.forest(["effect[B]", "mu", ("effect", 0)])
    assert [t.get_text() for t in ax.get_yticklabels()] == ["effect[B]", "mu", "effect[A]"]
    for wrong, said in (
        (
            "effect[C]",
            r"'effect\[C\]' is no number of 'effect'; its numbers are 'effect\[A\]', 'eff",
        ),
        (
            ("effect", 2),
            r"shape \(2,\), and 2 names no number of it; name one, such as \('effect', 0\)",
        ),
        (("effect", "A"), r"'A' names no number of it"),
        (("mu", 0), "'mu' is one number, without an index; got 0"),
        (0, r"names= lists nodes, or numbers of them as 'x\[0\]' or \('x', 0\), not 0"),
    ):
        with pytest.raises(bmc.errors.QueryError, match=said):
            chains.plot.pair(["mu", wrong])
    with pytest.raises(bmc.errors.UnknownNodeError, match="no node 'efect'"):
        chains.plot.pair(["mu", "efect"])


def test_energies_are_those_of_trajectories() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.Normal(0.0, 1.0), plates="i")
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="i")
    engine = bmc.HamiltonianMonteCarlo(600, warmup=200, chains=2)
    posterior = bmc.infer(net, {"y": np.zeros(3)}, engine=engine, rng=0)
    energies = posterior.energies
    assert energies.shape == (2, 600)
    # halves of three squared normals from the density, and of three from momenta: Gamma(3, 1) up to a
    # constant, whose variance 3 is met within 1 in all but 1 of 1,000 runs with 500 independent energies
    assert abs(energies.var() - 3.0) < 1.0
    ratio = np.square(np.diff(energies)).mean(axis=1) / energies.var(axis=1)
    legend = posterior.plot.energy().get_legend()
    assert legend.get_title().get_text() == f"lowest E-BFMI of 2 chains: {ratio.min():.2f}"


def test_pictures_of_the_wrong_answer_say_who_gives_them(chains, level) -> None:
    with pytest.raises(bmc.errors.UnsupportedError, match="of Gibbs.*HamiltonianMonteCarlo"):
        chains.plot.energy()
    exact = bmc.filter(level, ROWS)
    for ask, who in (
        (exact.plot.trace, "Gibbs, MetropolisHastings, HamiltonianMonteCarlo"),
        (exact.plot.weights, "ParticleFilter"),
        (lambda: exact.plot.ancestry("x"), 'keep="particles"'),
        (lambda: chains.plot.bands("mu"), "filter, smooth or forecast"),
        (lambda: exact.plot.predictive("y"), "residual_check"),
        (exact.plot.dag, "posterior of a net"),
    ):
        with pytest.raises(bmc.errors.BayesmcError, match=who):
            ask()
    with pytest.raises(AttributeError, match="no picture 'histogram'; there are ancestry, bands"):
        _ = chains.plot.histogram
    assert {f"plot_{name}" for name in dir(chains.plot)} < set(plotting.__all__)


# ---- over time ----------------------------------------------------------------------------------


def edges(collection):
    """Lower and upper end of a band at each of its times."""
    found = {}
    for x, y in collection.get_paths()[0].vertices:
        low, high = found.get(x, (y, y))
        found[x] = (min(low, y), max(high, y))
    return np.array([found[x] for x in sorted(found)])


def test_bands_lie_between_quantiles(level) -> None:
    filtered = bmc.filter(level, ROWS)
    ax = filtered.plot.bands("x", observed=ROWS["y"])
    wide, narrow = ax.collections
    assert np.allclose(edges(wide), filtered.quantile("x", [0.05, 0.95]))
    assert np.allclose(edges(narrow), filtered.quantile("x", [0.25, 0.75]))
    assert np.allclose(ax.lines[0].get_ydata(), filtered.median("x"))
    (points,) = lines_of(ax, "o")
    assert np.array_equal(points.get_ydata(), ROWS["y"], equal_nan=True)
    drawn = bmc.filter(level, ROWS, engine=bmc.ParticleFilter(50), rng=0).plot.bands("x")
    assert drawn.get_legend().get_texts()[0].get_text() == "filter: mean ± 0.67, 1.64 sd"
    with pytest.raises(bmc.errors.QueryError, match="observed has shape"):
        filtered.plot.bands("x", observed=[1.0])
    with pytest.raises(bmc.errors.QueryError, match="times has shape"):
        filtered.plot.bands("x", times=[1.0])


def test_fans_go_on_from_the_last_slice(level) -> None:
    filtered, ahead = bmc.filter(level, ROWS), bmc.forecast(level, ROWS, steps=3)
    ax = filtered.plot.forecast(ahead, "x", probs=(0.8,), last=2)
    before, fan = (edges(band) for band in ax.collections)
    assert len(before) == 2 and len(fan) == 4
    assert np.allclose(fan[0], before[-1])
    assert np.allclose(fan[1:], ahead.quantile("x", [0.1, 0.9]))
    with pytest.raises(bmc.errors.QueryError, match="forecast that begins at slice 5"):
        filtered.plot.forecast(filtered, "x")


def test_states_are_stacked() -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.table("sky", ["sky_prev"], [[0.8, 0.2], [0.4, 0.6]], ("sun", "rain"), initial=[0.7, 0.3])
    dbn.table("wet", ["sky"], [[0.9, 0.1], [0.2, 0.8]])
    filtered = bmc.filter(dbn, {"wet": [0, 1, 1]})
    first, second = (edges(part) for part in filtered.plot.bands("sky").collections)
    table = filtered.probabilities("sky")
    assert np.isclose(first[:, 1].max(), table[:, 0].max())
    assert np.allclose(first[0], [0.0, table[0, 0]]) and np.allclose(second[0], [table[0, 0], 1.0])


def test_lines_last_as_long_as_their_descendants(particles) -> None:
    rows = particles.ancestors
    alive = np.zeros(rows.shape, dtype=bool)
    for k in range(rows.shape[1]):  # each particle of the end, back to its first ancestor
        for t in range(len(rows) - 1, -1, -1):
            alive[t, k] = True
            k = rows[t, k] if t else k
    assert np.array_equal(_survivors(rows), alive) and not alive[0].all()
    dead, living = particles.plot.ancestry("x").collections
    assert len(living.get_segments()) == alive[1:].sum()
    assert len(dead.get_segments()) == (~alive[1:]).sum()
    start, end = living.get_segments()[-1]
    last = np.flatnonzero(alive[-1])[-1]
    assert np.allclose([start[1], end[1]], [particles.particles("x")[-2, rows[-1, last]],
                                            particles.particles("x")[-1, last]])  # fmt: skip
    short = particles.plot.ancestry("x", last=2, shown=3).collections[0]
    assert len(short.get_segments()) <= 3


def test_weights_over_time(particles, level) -> None:
    top, bottom = particles.plot.weights()
    assert np.array_equal(top.lines[0].get_ydata(), particles.weight_ess)
    (ticks,) = lines_of(top, "|")
    assert np.array_equal(ticks.get_xdata(), np.flatnonzero(particles.resampled))
    largest = next(line for line in bottom.lines if line.get_label() == "largest")
    assert np.allclose(largest.get_ydata(), 40 * particles.weights.max(axis=1))
    bare = bmc.filter(level, ROWS, engine=bmc.ParticleFilter(50), rng=0)
    assert len(bare.plot.weights()) == 1
    with pytest.raises(bmc.errors.UnsupportedError, match="keep"):
        bare.plot.ancestry("x")


# ---- predictions, and nets with marginals -------------------------------------------------------


def test_predictions_stand_beside_what_was_observed(chains) -> None:
    ax = chains.plot.predictive("y", draws=7)
    assert len(ax.lines) == 8 and ax.lines[-1].get_label() == "observed"
    for line in (ax.lines[0], ax.lines[-1]):
        assert np.trapezoid(line.get_ydata(), line.get_xdata()) > 0.5
    net = bmc.BayesNet(plates={"day": 4})
    net.add("rate", bmc.Gamma(2.0, 1.0))
    net.add("count", lambda rate: bmc.Poisson(rate), plates="day")
    net.add("sky", bmc.Categorical([0.5, 0.5]), states=("sun", "rain"), plates="day")
    evidence = {"count": [2, 2, 0, np.nan], "sky": ["sun", "sun", "sun", "rain"]}
    posterior = bmc.infer(net, evidence, engine=bmc.LikelihoodWeighting(2000), rng=0)
    bars = posterior.plot.predictive("count").patches
    assert np.allclose([bar.get_height() for bar in bars][:3], [1 / 3, 0.0, 2 / 3])
    assert [bar.get_height() for bar in posterior.plot.predictive("sky").patches] == [0.75, 0.25]
    with pytest.raises(bmc.errors.QueryError, match="'rate' was not observed"):
        posterior.plot.predictive("rate")


@pytest.mark.parametrize(
    "made, ends",
    [
        (lambda m: bmc.Exponential(np.exp(m)), (0.0, np.inf)),
        (lambda m: bmc.Beta(1.0, np.exp(m)), (0.0, 1.0)),
        (lambda m: bmc.Uniform(-1.0, 1.0), (-1.0, 1.0)),
        (lambda m: bmc.Normal(m, 1.0), (-np.inf, np.inf)),
    ],
)
def test_predicted_densities_end_where_the_support_does(made, ends) -> None:
    """Of a family that is densest at its end: no mass beyond, and none lost before."""
    net = bmc.BayesNet(plates={"day": 200})
    net.add("m", bmc.Normal(0.0, 0.01))
    net.add("y", made, plates="day")
    y = net.sample(1, rng=0)["y"][0]
    posterior = bmc.infer(net, {"y": y}, engine=bmc.LikelihoodWeighting(100), rng=0)
    for line in posterior.plot.predictive("y", draws=3).lines:
        points, heights = line.get_xdata(), line.get_ydata()
        assert points.min() >= ends[0] and points.max() <= ends[1]
        assert np.trapezoid(heights, points) == pytest.approx(1.0, abs=0.05)


def test_marginals_stand_in_the_nodes() -> None:
    net = bmc.BayesNet(plates={"bed": 3})
    net.table("rain", [], [0.8, 0.2], ("no", "yes"))
    net.add("soil", lambda rain: bmc.Normal(np.where(rain == "yes", 3.0, 0.0), 1.0))
    net.add("wet", lambda rain: bmc.Bernoulli(np.where(rain == "yes", 0.9, 0.2)), plates="bed")
    net.table("sign", ["rain"], [[0.7, 0.3], [0.2, 0.8]], ("dry", "damp"))
    posterior = bmc.infer(net, {"sign": "damp"})
    ax = posterior.plot.dag()
    texts = [text.get_text() for text in ax.texts]
    assert "= damp" in texts and "no" in texts
    no, yes = posterior.probabilities("rain")
    assert f"{100 * yes:.0f} %" in texts
    bars = [p for p in ax.patches if p.get_facecolor()[:3] == matplotlib.colors.to_rgb("#0072b2")]
    widths = [bar.get_width() for bar in bars if bar.get_alpha() is None]
    assert np.isclose(widths[1] / widths[0], yes / no)
    cells = [bar.get_alpha() for bar in bars if bar.get_alpha() is not None]
    assert np.allclose(cells, np.repeat(posterior.probabilities("wet")[0], 3))
    (curve,) = [line for line in ax.lines if len(line.get_xdata()) == 120]
    assert np.argmax(curve.get_ydata()) < 60  # no rain is likelier, and lies to the left
    assert {p.get_label() for p in ax.patches} >= {"plate bed", "rain", "soil"}
