"""Angles: their mean and deviation are circular, whatever way the answer is held."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.mcmc.proposals import RandomWalk
from bayesmc.network import pose
from bayesmc.results import DrawsPosterior
from bayesmc.robotics.pose_distributions import AndAngle, PoseNormal

CENTRE = np.pi - 0.1  # draws fall on both sides of the cut at pi


def compass() -> bmc.BayesNet:
    """A heading near pi, wrapped to (-pi, pi], and something that depends on it."""

    def heading():
        return bmc.Density(
            lambda x: (
                -0.5 * (np.remainder(x - CENTRE + np.pi, 2 * np.pi) - np.pi) ** 2 / 0.25
                - np.log(0.5 * np.sqrt(2 * np.pi))
            ),
            sample=lambda rng, shape: (
                np.remainder(CENTRE + 0.5 * rng.standard_normal(shape) + np.pi, 2 * np.pi) - np.pi
            ),
            support="circle",
        )

    net = bmc.BayesNet()
    net.node(heading)
    net.add("seen", lambda heading: bmc.Normal(np.sin(heading), 0.3))
    return net


def by_quadrature(seen: float) -> tuple[float, float]:
    """Circular mean and standard deviation on a fine grid of unwrapped angles."""
    x = np.linspace(CENTRE - 3, CENTRE + 3, 20_001)
    w = np.exp(-0.5 * ((x - CENTRE) / 0.5) ** 2 - 0.5 * ((seen - np.sin(x)) / 0.3) ** 2)
    resultant = (w * np.exp(1j * x)).sum() / w.sum()
    return float(np.angle(resultant)), float(np.sqrt(-2 * np.log(abs(resultant))))


@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_mean_and_deviation_of_an_angle(keep: str) -> None:
    """Within 4.5 standard errors (false alarm 7e-6); a linear mean would be off by over a radian."""
    engine = bmc.LikelihoodWeighting(40_000)
    posterior = bmc.infer(compass(), {"seen": -0.1}, engine=engine, rng=3, keep=keep)
    mean, deviation = by_quadrature(-0.1)
    off = np.remainder(posterior.mean("heading") - mean + np.pi, 2 * np.pi) - np.pi
    assert abs(off) < 4.5 * posterior.mcse("heading")
    assert posterior.mcse("heading") < 0.01
    assert posterior.std("heading") == pytest.approx(deviation, rel=0.03)


# ---- angles among other numbers -------------------------------------------------------------------


def robots() -> bmc.BayesNet:
    """Two poses whose headings lie near pi, and readings of headings and of x."""
    start = [[1.0, 2.0, CENTRE], [0.0, -1.0, CENTRE - 0.3]]
    net = bmc.BayesNet(plates={"robot": 2})
    net.add("pose", PoseNormal(start, scale_diag=[0.1, 0.2, 0.4]), plates="robot")
    net.add("read", lambda pose: bmc.WrappedNormal(pose[..., 2], 0.4), plates="robot")
    net.add("at", lambda pose: bmc.Normal(pose[..., 0], 0.1), plates="robot")
    return net


READ = {"read": [-3.1, 3.0], "at": [1.2, -0.2]}
#: the posterior: half way between prior and reading, with half the variance, but for y
MEANS = [[1.1, 2.0, np.pi - 0.05 + 0.5 * (np.pi - 3.1)], [-0.1, -1.0, (np.pi - 0.4 + 3.0) / 2]]
DEVIATIONS = np.array([0.1 / np.sqrt(2), 0.2, 0.4 / np.sqrt(2)])

ENGINES = [
    bmc.LikelihoodWeighting(40_000),
    bmc.Gibbs(warmup=50, draws=250),
    bmc.MetropolisHastings(
        warmup=200, draws=2_000, proposal={"pose": RandomWalk([0.1, 0.25, 0.4])}
    ),
]


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
@pytest.mark.parametrize("engine", ENGINES, ids=lambda e: type(e).__name__)
def test_headings_among_other_numbers(engine) -> None:
    """Six numbers within 5 standard errors (false alarm 4e-6); a linear mean is off by over a radian."""
    drawn, summed = (
        bmc.infer(robots(), READ, engine=engine, rng=5, keep=keep)
        for keep in ("draws", "summaries")
    )
    for posterior in (drawn, summed):
        off = posterior.mean("pose") - MEANS
        off[:, 2] = wrap_angle(off[:, 2])
        assert (np.abs(off) < 5 * posterior.mcse("pose")).all()
        assert (posterior.mcse("pose") < 0.2 * DEVIATIONS).all()
        np.testing.assert_allclose(
            posterior.std("pose"), np.broadcast_to(DEVIATIONS, (2, 3)), rtol=0.15
        )
        assert (posterior.ess("pose") > 30).all()
        assert len(posterior.summary(["pose"]).names) == 6
    np.testing.assert_allclose(summed.mean("pose"), drawn.mean("pose"), rtol=0, atol=1e-9)
    np.testing.assert_allclose(summed.var("pose"), drawn.var("pose"), rtol=1e-7)
    # negative control: a linear mean of the same draws points elsewhere
    weights = None if drawn.weights is None else drawn.weights.ravel()
    linear = np.average(drawn["pose"][..., 0, 2].ravel(), weights=weights)
    assert abs(wrap_angle(linear - drawn.mean("pose")[0, 2])) > 1


@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_errors_of_headings_among_other_numbers_are_those_of_headings_alone(keep: str) -> None:
    """The same draws as one pose and as two nodes: every figure is the same."""
    apart, joined = bmc.BayesNet(), bmc.BayesNet()
    apart.add("x", bmc.Normal(1.0, 0.1))
    apart.add("h", bmc.WrappedNormal(CENTRE, 0.4))
    apart.add("read", lambda h: bmc.WrappedNormal(h, 0.4))
    joined.add("pose", AndAngle(bmc.Normal(1.0, 0.1), bmc.WrappedNormal(CENTRE, 0.4)))
    joined.add("read", lambda pose: bmc.WrappedNormal(pose[..., 1], 0.4))
    engine = bmc.LikelihoodWeighting(5_000)
    one, two = (
        bmc.infer(net, {"read": -3.0}, engine=engine, rng=2, keep=keep) for net in (joined, apart)
    )
    for ask in ("mean", "std", "mcse", "ess"):
        figures = [getattr(two, ask)("x"), getattr(two, ask)("h")]
        np.testing.assert_allclose(getattr(one, ask)("pose"), figures, rtol=1e-9)


def test_poses_that_were_seen_keep_their_heading() -> None:
    net = robots()
    seen = {**READ, "pose": [[1.0, 2.0, 3.1], [0.0, 0.0, -3.1]]}
    found = bmc.infer(net, seen, engine=bmc.LikelihoodWeighting(50), rng=0, keep="summaries")
    np.testing.assert_allclose(found.mean("pose"), seen["pose"])
    np.testing.assert_allclose(found.var("pose"), 0.0, atol=1e-15)


def driven() -> bmc.DynamicBayesNet:
    """A number and a heading near the cut of the circle, and a compass."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "pose",
        lambda pose_prev: AndAngle(
            bmc.Normal(0.5 * pose_prev[..., 0], 0.5), bmc.WrappedNormal(pose_prev[..., 1], 0.1)
        ),
        initial=AndAngle(bmc.Normal(1.0, 0.5), bmc.WrappedNormal(CENTRE, 0.3)),
    )
    dbn.add("read", lambda pose: bmc.WrappedNormal(pose[..., 1], 0.3))
    return dbn


@pytest.mark.parametrize(
    ("engine", "keep", "tolerance"),
    [
        (bmc.ParticleFilter(20_000), None, 0.02),  # above 6 standard errors
        (bmc.ParticleFilter(20_000), "particles", 0.02),
        (bmc.GridFilter({"pose": [(-3.0, 4.0, 16), (-np.pi, np.pi, 70)]}), None, 1e-3),
    ],
    ids=["summaries", "particles", "grid"],
)
def test_headings_of_filters(engine, keep: str | None, tolerance: float) -> None:
    """Against Kalman's recursion for the heading, unwrapped: all but no mass is half a turn away."""
    rows = [-3.0, 3.0, np.nan]
    kept = {} if keep is None else {"keep": keep}
    found = bmc.filter(driven(), {"read": rows}, engine=engine, rng=3, **kept)
    mean, var = CENTRE, 0.09
    for t, row in enumerate(rows):
        if t:
            var += 0.01
        if not np.isnan(row):
            gain = var / (var + 0.09)
            mean, var = mean + gain * wrap_angle(row - mean), (1 - gain) * var
        x, heading = found.mean("pose")[t]
        assert abs(wrap_angle(heading - mean)) < tolerance
        assert x == pytest.approx(0.5**t, abs=max(tolerance, 0.03))
        assert found.std("pose")[t, 1] == pytest.approx(np.sqrt(var), rel=0.05)


@pytest.mark.parametrize("engine", [bmc.DiscreteFilter(), bmc.GridFilter()], ids=repr)
def test_hidden_poses_of_finite_nodes(engine) -> None:
    """A pose that nothing depends on is averaged over the states it is read off, in closed form."""
    dbn = bmc.DynamicBayesNet(plates={"robot": 2})
    dbn.table("k", ["k_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5], plates="robot")
    dbn.add("y", lambda k: bmc.Normal(1.0 * k, 1.0), plates="robot")

    def pose(k):
        at = np.stack([1.0 * k, -2.0 * k, 3.0 - 6.0 * k], axis=-1)
        return PoseNormal(at, scale_diag=[0.1, 0.2, 0.3])

    dbn.node(pose, plates="robot")
    nothing = [np.nan] * 3
    rows = {
        "y": [[0.9, 0.1], [0.4, 0.2]],
        "pose": [[nothing, nothing], [[0.0, 1.0, -3.1], nothing]],
    }
    found = bmc.filter(dbn, rows, engine=engine)
    p = found.probabilities("k")[..., 1]
    turn = ((1 - p) * np.exp(3j) + p * np.exp(-3j)) * np.exp(-0.5 * 0.09)
    mean = np.stack([p, -2 * p, np.angle(turn)], axis=-1)
    var = np.stack([0.01 + p * (1 - p), 0.04 + 4 * p * (1 - p), -2 * np.log(abs(turn))], axis=-1)
    mean[1, 0], var[1, 0] = [0.0, 1.0, -3.1], 0.0
    np.testing.assert_allclose(found.mean("pose"), mean, atol=1e-12)
    np.testing.assert_allclose(found.var("pose"), var, atol=1e-12)
    assert abs(wrap_angle(mean[0, 0, 2] - (3.0 - 6.0 * p[0, 0]))) > 1  # what a linear mean says


def test_error_of_an_angle_is_the_spread_of_its_answers() -> None:
    """80 runs: their spread is within 40 % of the stated error (false alarm below 1e-6)."""
    engine = bmc.LikelihoodWeighting(1_000)
    runs = [bmc.infer(compass(), {"seen": -0.1}, engine=engine, rng=k) for k in range(80)]
    means = np.remainder([r.mean("heading") for r in runs], 2 * np.pi)
    assert np.std(means) == pytest.approx(np.mean([r.mcse("heading") for r in runs]), rel=0.4)


def test_quantiles_of_an_angle_are_cut_opposite_its_mean() -> None:
    posterior = bmc.infer(compass(), engine=bmc.LikelihoodWeighting(20_000), rng=0)
    low, middle, high = posterior.quantile("heading", [0.05, 0.5, 0.95])
    assert low < middle < high
    assert high - low == pytest.approx(2 * 1.645 * 0.5, rel=0.05)


@pytest.mark.parametrize("turn", [0.0, 0.5, np.pi, -2.0])
@pytest.mark.parametrize("weighted", [False, True])
def test_covariances_of_headings_do_not_see_the_cut(turn: float, weighted: bool) -> None:
    """However draws of two poses are turned, they covary as they do on a line that is not cut."""
    rng = np.random.default_rng(0)
    line = rng.normal(size=(2, 500, 2, 3)) @ rng.normal(size=(3, 3)) * [1.0, 1.0, 0.2]
    log_weights = rng.normal(size=(2, 500)) if weighted else None
    turned = line + [0.0, 0.0, turn]
    turned[..., 2] = wrap_angle(turned[..., 2])
    problem = pose(robots(), READ)
    posterior = DrawsPosterior(
        problem, bmc.LikelihoodWeighting(1000), {"pose": turned}, (2, 500), log_weights
    )
    weights = None if log_weights is None else np.exp(log_weights).ravel()
    expected = np.cov(line.reshape(1000, 6).T, aweights=weights, ddof=0)
    np.testing.assert_allclose(posterior.cov("pose"), expected, atol=1e-12)
    np.testing.assert_allclose(np.diag(expected)[[2, 5]], posterior.var("pose")[:, 2], rtol=0.3)
    if abs(turn) == np.pi:  # negative control: as numbers of a line they are half a turn off
        linear = np.cov(turned.reshape(1000, 6).T, aweights=weights, ddof=0)
        assert linear[2, 2] > 5 * expected[2, 2]


def test_labels_have_no_expectation() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Bernoulli(0.3), states=("no", "yes"))
    posterior = bmc.infer(net, engine=bmc.LikelihoodWeighting(100), rng=0)
    with pytest.raises(bmc.errors.UnsupportedError, match="labels .* no mean.*a == 'no'"):
        posterior.expectation(lambda a: a)
