"""A vector of which some components are missing is conditioned on those present, or refused by name."""

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import EvidenceError, ModelError, UnsupportedError

COV = np.array([[2.0, 0.8, 0.3], [0.8, 1.0, 0.2], [0.3, 0.2, 1.5]])
NAN = np.nan


def sensors():
    """Two vectors that depend on one number; of one a component is missing, of the other all are."""
    net = bmc.BayesNet(plates={"p": 2})
    net.add("m", bmc.Normal(0.0, 2.0))
    net.add("v", lambda m: bmc.MvNormal(m[..., None] * np.array([1.0, 2.0, 0.0]), COV), plates="p")
    net.add("w", lambda v: bmc.Normal(v[..., 1], 1.0), plates="p")
    return net


def dense():
    """Moments of (m, v[0], v[1], w[0]) from first principles."""
    rows = np.zeros((8, 9))
    rows[0, 0] = 2.0
    root = np.linalg.cholesky(COV)
    for k in (0, 1):
        own = slice(1 + 3 * k, 4 + 3 * k)
        rows[own, 0] = 2.0 * np.array([1.0, 2.0, 0.0])
        rows[own, own] = root
    rows[7] = rows[2]
    rows[7, 8] = 1.0
    return rows @ rows.T


def given(cov, seen, values):
    rest = [k for k in range(len(cov)) if k not in seen]
    gain = cov[np.ix_(rest, seen)] @ np.linalg.inv(cov[np.ix_(seen, seen)])
    mean, var = np.zeros(len(cov)), np.zeros(len(cov))
    mean[seen], mean[rest] = values, gain @ values
    var[rest] = np.diag(cov[np.ix_(rest, rest)] - gain @ cov[np.ix_(seen, rest)])
    return mean, var, stats.multivariate_normal(cov=cov[np.ix_(seen, seen)]).logpdf(values)


EVIDENCE = {"v": [[1.0, NAN, 0.5], [NAN, NAN, NAN]], "w": [0.3, NAN]}


def test_exact_answers():
    mean, var, log = given(dense(), [1, 3, 7], np.array([1.0, 0.5, 0.3]))
    found = bmc.infer(sensors(), EVIDENCE, engine=bmc.Exact())
    assert found.mean("m") == pytest.approx(mean[0])
    assert found.mean("v").ravel() == pytest.approx(mean[1:7])
    assert found.var("v").ravel() == pytest.approx(var[1:7], abs=1e-12)
    assert found.log_marginal_likelihood == pytest.approx(log)
    whole = {"v": [[1.0, 0.0, 0.5], [NAN, NAN, NAN]], "w": [0.3, NAN]}  # zero is not missing
    assert abs(bmc.infer(sensors(), whole).log_marginal_likelihood - log) > 0.1


def test_masked_arrays_and_nodes_without_plates():
    net = bmc.BayesNet()
    net.add("v", bmc.MvNormal(np.zeros(3), COV))
    mean, var, log = given(COV, [1], np.array([1.0]))
    masked = np.ma.MaskedArray([9.0, 1.0, 9.0], mask=[True, False, True])
    for value in ([NAN, 1.0, NAN], masked):
        found = bmc.infer(net, {"v": value})
        assert found.mean("v") == pytest.approx(mean)
        assert found.var("v") == pytest.approx(var)
        assert found.log_marginal_likelihood == pytest.approx(log)


def test_weighted_draws():
    """Within five standard errors: an alarm in two million for each of seven figures."""
    mean, _, log = given(dense(), [1, 3, 7], np.array([1.0, 0.5, 0.3]))
    found = bmc.infer(sensors(), EVIDENCE, engine=bmc.LikelihoodWeighting(20_000), rng=2)
    off = np.abs(found.mean("v").ravel() - mean[1:7])
    assert (off <= 5 * found.mcse("v").ravel() + 1e-12).all()
    assert abs(found.log_marginal_likelihood - log) < 5 * found.log_marginal_likelihood_mcse
    assert (found["v"][..., 0, [0, 2]] == [1.0, 0.5]).all()
    assert found["v"][..., 0, 1].std() > 0.5


def test_weighted_draws_of_independent_parts():
    """Five standard errors, as above: parts of a Joint that are there, or are not, or only in part."""
    net = bmc.BayesNet()
    net.add("v", bmc.MvNormal(np.zeros(3), COV))
    net.add(
        "j", lambda v: bmc.Joint(
            bmc.Normal(v[..., 0], 1.0), bmc.Gamma(2.0, 1.0), bmc.MvNormal(v[..., :2], np.eye(2))
        ),
    )  # fmt: skip
    rows = np.array([[1.0, 0, 0], [1.0, 0, 0]])
    cov = np.block([[COV, COV @ rows.T], [rows @ COV, rows @ COV @ rows.T + np.eye(2)]])
    mean, _, log = given(cov, [3, 4], np.array([1.0, 0.5]))
    engine = bmc.LikelihoodWeighting(20_000)
    found = bmc.infer(net, {"j": [1.0, NAN, 0.5, NAN]}, engine=engine, rng=1)
    assert (np.abs(found.mean("v") - mean[:3]) <= 5 * found.mcse("v")).all()
    assert abs(found.log_marginal_likelihood - log) < 5 * found.log_marginal_likelihood_mcse


def moving():
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x", lambda x_prev: bmc.MvNormal(0.9 * x_prev, np.eye(2)),
        initial=bmc.MvNormal(np.zeros(2), np.eye(2)),
    )  # fmt: skip
    dbn.add("y", lambda x: bmc.MvNormal(x, [[0.5, 0.2], [0.2, 0.4]]))
    return dbn


ROWS = {"y": [[1.0, NAN], [0.5, 0.3], [NAN, NAN], [NAN, 1.0]]}


@pytest.mark.parametrize(
    "engine", [bmc.KalmanFilter(), bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter()]
)
def test_gaussian_filters(engine):
    """Over time, against each component of the rows as an unrolled net's evidence."""
    dbn = moving()
    exact = bmc.infer(dbn.unroll(4), dbn.unrolled_evidence(ROWS), engine=bmc.Exact())
    smoothed = bmc.smooth(dbn, ROWS, engine=engine)
    for t in range(4):
        assert smoothed.mean("x")[t] == pytest.approx(exact.mean(f"x[{t}]"))
        assert smoothed.var("x")[t] == pytest.approx(exact.var(f"x[{t}]"))
    assert smoothed.log_marginal_likelihood == pytest.approx(exact.log_marginal_likelihood)
    belief = engine.start(dbn)
    for row in ROWS["y"]:
        belief = engine.step(belief, {"y": row})
    assert belief.log_marginal_likelihood == pytest.approx(exact.log_marginal_likelihood)


def test_rows_of_two_numbers_say_the_same_as_two_nodes():
    apart = bmc.DynamicBayesNet()
    apart.add(
        "x", lambda x_prev: bmc.MvNormal(0.9 * x_prev, np.eye(2)),
        initial=bmc.MvNormal(np.zeros(2), np.eye(2)),
    )  # fmt: skip
    apart.add("a", lambda x: bmc.Normal(x[..., 0], 1.0))
    apart.add("b", lambda x: bmc.Normal(x[..., 1], 2.0))
    joint = bmc.DynamicBayesNet()
    joint.add(
        "x", lambda x_prev: bmc.MvNormal(0.9 * x_prev, np.eye(2)),
        initial=bmc.MvNormal(np.zeros(2), np.eye(2)),
    )  # fmt: skip
    joint.add("y", lambda x: bmc.MvNormal(x, scale_diag=[1.0, 2.0]))
    rows = np.array(ROWS["y"])
    wanted = bmc.filter(apart, {"a": rows[:, 0], "b": rows[:, 1]})
    found = bmc.filter(joint, {"y": rows})
    np.testing.assert_allclose(found.mean("x"), wanted.mean("x"))
    np.testing.assert_allclose(found.log_marginal_increments, wanted.log_marginal_increments)


def test_particles():
    """Twenty runs of 2,000 particles: their mean evidence within five standard errors."""
    dbn, wanted = moving(), bmc.filter(moving(), ROWS)
    runs = [bmc.filter(dbn, ROWS, engine=bmc.ParticleFilter(2000), rng=k) for k in range(20)]
    ratios = np.exp([r.log_marginal_likelihood - wanted.log_marginal_likelihood for r in runs])
    assert abs(ratios.mean() - 1) < 5 * ratios.std(ddof=1) / np.sqrt(20)
    means = np.array([r.mean("x") for r in runs])
    off = np.abs(means.mean(axis=0) - wanted.mean("x"))
    assert (off < 5 * means.std(axis=0, ddof=1) / np.sqrt(20) + 2e-3).all()


@pytest.mark.parametrize(
    "engine",
    [
        bmc.MetropolisHastings(50),
        bmc.Rejection(50),
        bmc.Importance(50, proposal={"m": lambda: bmc.Normal(0.0, 1.0)}),
    ],
)
def test_other_engines_name_the_node(engine):
    with pytest.raises(UnsupportedError, match="of 'v' some components are missing"):
        bmc.infer(sensors(), EVIDENCE, engine=engine, rng=0)
    with pytest.raises(EvidenceError, match="of 'v' some components are missing"):
        sensors().to_factor_graph(EVIDENCE)


def test_other_filters_name_the_node():
    grid = bmc.GridFilter({"x": (-5.0, 5.0, 10)})
    given = {"x": lambda y: bmc.MvNormal(y, np.eye(2))}
    for engine in (
        grid,
        bmc.ParticleFilter(50, proposal=given),
        bmc.ParticleFilter(50, auxiliary=True),
    ):
        with pytest.raises(UnsupportedError, match="of 'y' some components are missing"):
            bmc.filter(moving(), ROWS, engine=engine, rng=0)
        if engine is not grid:
            belief = engine.start(moving(), rng=0)
            with pytest.raises(UnsupportedError, match="of 'y' some components are missing"):
                for row in ROWS["y"]:
                    belief = engine.step(belief, {"y": row})


def test_the_derived_proposal_looks_at_the_components_that_are_there():
    """Narrow correlated noise; five standard errors of the evidence: one false alarm in 10^6 or so."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev: bmc.MvNormal(0.9 * x_prev, np.eye(2)),
        initial=bmc.MvNormal(np.zeros(2), np.eye(2)),
    )
    dbn.add("y", lambda x: bmc.MvNormal(x, 0.01 * np.array([[1.0, 0.8], [0.8, 1.0]])))
    rows = np.array([[0.2, NAN], [0.9, 1.1], [NAN, 2.0], [NAN, NAN], [1.0, NAN], [1.5, 0.2]])
    exact = bmc.filter(dbn, {"y": rows}, engine=bmc.KalmanFilter())
    engine = bmc.ParticleFilter(2000, proposal="optimal")
    found = bmc.filter(dbn, {"y": rows}, engine=engine, rng=0)
    off = abs(found.log_marginal_likelihood - exact.log_marginal_likelihood)
    assert off < 5 * found.log_marginal_likelihood_mcse < 0.5
    assert np.abs(found.mean("x") - exact.mean("x")).max() < 0.15
    assert found.weight_ess[2] > 1000
    belief = engine.start(dbn, rng=0)
    for row in rows:
        belief = engine.step(belief, {"y": row})
    assert belief.log_marginal_likelihood == pytest.approx(found.log_marginal_likelihood, rel=1e-12)


CHAINS = [
    bmc.Gibbs(1000, warmup=200, chains=8, debug=True),
    bmc.HamiltonianMonteCarlo(1000, warmup=300),
]


def held(found, name, mean, std):
    """Means within five of their errors, an alarm in two million each; deviations within a tenth."""
    assert (np.abs(found.mean(name) - mean) <= 5 * found.mcse(name) + 1e-12).all()
    assert (np.abs(found.std(name) - std) <= 0.1 * std + 1e-12).all()


@pytest.mark.parametrize("engine", CHAINS, ids=["Gibbs", "Hamiltonian"])
@pytest.mark.parametrize("seed", range(3))
def test_chains_draw_what_is_missing(engine, seed):
    """Random rows, what depends on them, and their mean, against exact answers."""
    rng = np.random.default_rng(seed)
    root, slope, by = rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), rng.normal(size=3)
    net = bmc.BayesNet(plates={"row": 6})
    net.add("mean", bmc.MvNormal(np.zeros(3), 2 * np.eye(3)))
    cov = root @ root.T + 0.3 * np.eye(3)
    net.add("x", lambda mean: bmc.MvNormal(np.matvec(slope, mean), cov), plates="row")
    net.add("y", lambda x: bmc.Normal(np.vecdot(x, by), 0.7), plates="row")
    x, y = rng.normal(size=(6, 3)), rng.normal(size=6)
    x[rng.random((6, 3)) < 0.4] = NAN
    x[0], x[1, 1], y[2:4] = NAN, NAN, NAN
    wanted = bmc.infer(net, {"x": x, "y": y}, engine=bmc.Exact())
    found = bmc.infer(net, {"x": x, "y": y}, engine=engine, rng=seed)
    held(found, "mean", wanted.mean("mean"), wanted.std("mean"))
    held(found, "x", wanted.mean("x"), wanted.std("x"))
    there = np.isfinite(x)
    assert (found["x"][..., there] == x[there]).all()


def counted(count):
    """Counts that depend on two numbers of each row, in no affine way."""
    net = bmc.BayesNet(plates={"row": 3})
    net.add("x", bmc.MvNormal([0.5, 0.0], [[1.0, 0.6], [0.6, 1.0]]), plates="row")
    net.add("n", lambda x: count(np.exp(x[..., 0] + 0.5 * x[..., 1])), plates="row")
    return net, {"x": [[NAN, 1.0], [0.2, NAN], [NAN, NAN]], "n": [4, 0, 2]}


@pytest.mark.parametrize("engine", [*CHAINS, None], ids=["Gibbs", "Hamiltonian", "default"])
def test_what_is_missing_may_have_children(engine):
    net, evidence = counted(bmc.Poisson)
    found = bmc.infer(net, evidence, engine=engine, rng=3)
    at = np.linspace(-5.0, 6.0, 276)
    a, b = np.meshgrid(at, at, indexing="ij")
    log = stats.multivariate_normal([0.5, 0.0], [[1.0, 0.6], [0.6, 1.0]]).logpdf(np.dstack([a, b]))
    for k, (first, second) in enumerate(evidence["x"]):
        logs = log + stats.poisson(np.exp(a + 0.5 * b)).logpmf(evidence["n"][k])
        weight = np.exp(logs - logs.max())
        near = [np.abs(at - v).argmin() if np.isfinite(v) else slice(None) for v in (first, second)]
        kept = np.zeros_like(weight)
        kept[tuple(near)] = weight[tuple(near)]
        kept /= kept.sum()
        mean = np.array([(kept * a).sum(), (kept * b).sum()])
        std = np.sqrt([(kept * (x - m) ** 2).sum() for x, m in zip((a, b), mean, strict=True)])
        off = np.abs(found.mean("x")[k] - mean)
        assert (off <= 5 * found.mcse("x")[k] + 1e-3).all()
        assert (np.abs(found.std("x")[k] - std) <= 0.12 * std + 1e-6).all()


def camel():
    """A covariance that is not known, of pairs most of which lack a number: Tanner and Wong (1987)."""
    net = bmc.BayesNet(plates={"pair": 12})
    net.add("precision", bmc.Wishart(2.0, 1000 * np.eye(2)))
    net.add(
        "x", lambda precision: bmc.MvNormal(np.zeros(2), np.linalg.inv(precision)), plates="pair"
    )
    rows = [[1, 1], [1, -1], [-1, 1], [-1, -1], *[[2, NAN], [-2, NAN], [NAN, 2], [NAN, -2]] * 2]
    return net, {"x": np.array(rows)}


def test_a_covariance_of_rows_seen_in_part():
    """Published: means .862 and 0, deviations .512 of the diagonal and .659 of the correlation."""
    net, evidence = camel()
    found = bmc.infer(net, evidence, rng=0)
    assert isinstance(found.engine, bmc.Gibbs)
    precision = found["precision"]
    rho = -precision[..., 0, 1] / np.sqrt(precision[..., 0, 0] * precision[..., 1, 1])
    assert np.abs(found.mean("precision").diagonal() - 0.862).max() < 0.03
    assert np.abs(found.std("precision").diagonal() - 0.512).max() < 0.03
    assert abs(rho.mean()) < 0.1 and abs(rho.std() - 0.659) < 0.03


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
def test_log_likelihoods_are_of_what_was_seen():
    net, evidence = camel()
    found = bmc.infer(net, evidence, engine=bmc.Gibbs(400, warmup=100, chains=8), rng=0)
    log = found.log_likelihood("x")["x"]
    cov = np.linalg.inv(found["precision"])
    for k, row in ((0, [0, 1]), (4, [0]), (6, [1])):
        part = cov[3, 7][np.ix_(row, row)]
        wanted = stats.multivariate_normal(cov=part).logpdf(evidence["x"][k][row])
        assert log[3, 7, k] == pytest.approx(wanted)
    assert len(found.loo().pointwise) == 12


def test_a_kernel_that_moves_what_was_seen_is_refused(monkeypatch):
    from bayesmc.kernels.completed import Completed

    net, evidence = camel()
    step = Completed.step

    def wrong(self, values, memory, rng, warmup):
        new, memory = step(self, values, memory, rng, warmup)
        return {n: v + 1e-9 for n, v in new.items()}, memory

    monkeypatch.setattr(Completed, "step", wrong)
    with pytest.raises(ModelError, match="other values than were observed of it"):
        bmc.infer(net, evidence, engine=bmc.Gibbs(5, warmup=5), rng=0)


def test_parts_without_marginals_are_refused_before_a_run():
    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("j", lambda m: bmc.Joint(bmc.Normal(m, 1.0), bmc.Dirichlet(np.ones(3))))
    evidence = {"j": [0.3, 0.2, NAN, NAN]}
    assert "Dirichlet has no marginal" in bmc.Gibbs().unsupported(net, evidence)
    found = bmc.infer(net, {"j": [0.3, NAN, NAN, NAN]}, engine=bmc.Gibbs(2000, warmup=100), rng=0)
    held(found, "m", 0.15, np.sqrt(0.5))
    assert np.abs(found.mean("j")[1:] - 1 / 3).max() < 0.03


def test_families_without_marginals_are_refused():
    net = bmc.BayesNet(plates={"p": 2})
    net.add("d", bmc.Dirichlet(np.ones(3)), plates="p")
    with pytest.raises(EvidenceError, match="of one vector.*is not supported; split"):
        bmc.infer(net, {"d": [[NAN, 0.5, 0.5], [0.2, 0.3, 0.5]]})
