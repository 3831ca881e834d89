"""Scales of 0 and singular covariances: exact where that is defined, refused by name where it is not.

There is no chance in these tests but for the draws of two engines, whose rates are said where they are.
"""

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc.errors import EvidenceError, ParameterError, UnsupportedError, ZeroProbabilityError

GAUSSIAN = (bmc.KalmanFilter(), bmc.ExtendedKalmanFilter(), bmc.UnscentedKalmanFilter())


def link():
    """The model of the issue: a deterministic link written as a Normal."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("d", lambda x: bmc.Normal(2 * x, 0.0))
    net.add("y", lambda d: bmc.Normal(d, 1.0))
    return net


def normal(x, loc, scale):
    return float(stats.norm(loc, scale).logpdf(x))


def test_exact_answers_through_a_link():
    found = bmc.infer(link(), {"y": 1.0}, engine=bmc.Exact())
    assert [float(found.mean(n)) for n in ("x", "d")] == pytest.approx([0.4, 0.8])
    assert [float(found.var(n)) for n in ("x", "d")] == pytest.approx([0.2, 0.8])
    assert found.log_marginal_likelihood == pytest.approx(normal(1.0, 0.0, np.sqrt(5.0)))
    draws = found.resample(50, rng=0)
    np.testing.assert_allclose(draws["d"], 2 * draws["x"])


def test_exact_answers_given_the_link():
    found = bmc.infer(link(), {"d": 1.0, "y": 2.0}, engine=bmc.Exact())
    assert found.mean("x") == pytest.approx(0.5) and found.var("x") == 0.0
    wanted = normal(1.0, 0.0, 2.0) + normal(2.0, 1.0, 1.0)
    assert found.log_marginal_likelihood == pytest.approx(wanted)
    both = bmc.infer(link(), {"d": 1.0, "x": 0.5, "y": 2.0}, engine=bmc.Exact())
    wanted = normal(0.5, 0.0, 1.0) + normal(2.0, 1.0, 1.0)
    assert both.log_marginal_likelihood == pytest.approx(wanted)  # d is a probability: one
    with pytest.raises(ZeroProbabilityError):
        bmc.infer(link(), {"d": 1.0, "x": 0.6}, engine=bmc.Exact())


def test_two_links_of_one_number():
    net = link()
    net.add("e", lambda x: bmc.Normal(3 * x - 1, 0.0))
    found = bmc.infer(net, {"d": 1.0, "e": 0.5}, engine=bmc.Exact())
    assert found.log_marginal_likelihood == pytest.approx(normal(1.0, 0.0, 2.0))
    with pytest.raises(ZeroProbabilityError):
        bmc.infer(net, {"d": 1.0, "e": 0.51}, engine=bmc.Exact())


def dense(net, order, evidence):
    """Log evidence, means and variances by conditioning one dense Gaussian number by number."""
    model = net.model(evidence)
    mean, rows = [], []
    for k, name in enumerate(order):
        parents = model[name].parents
        zero = {p: np.zeros(()) for p in parents}
        base = model.evaluate(name, zero)[0]
        m, row = float(base.loc), np.zeros(len(order))
        for p in parents:
            slope = float(model.evaluate(name, {**zero, p: np.ones(())})[0].loc) - float(base.loc)
            at = order.index(p)
            m, row = m + slope * mean[at], row + slope * rows[at]
        row[k] += float(base.scale)
        mean.append(m)
        rows.append(row)
    mean, cov = np.array(mean), np.array(rows) @ np.array(rows).T
    total = 0.0
    for name in (n for n in order if n in evidence):
        k = order.index(name)
        off = evidence[name] - mean[k]
        if cov[k, k] < 1e-10:
            assert abs(off) < 1e-6
            continue
        total += normal(off, 0.0, np.sqrt(cov[k, k]))
        gain = cov[:, k] / cov[k, k]
        mean, cov = mean + gain * off, cov - np.outer(gain, cov[k])
    return total, mean, np.diag(cov)


@pytest.mark.parametrize("seed", range(12))
def test_exact_against_a_dense_gaussian(seed):
    rng = np.random.default_rng(seed)
    net, order = bmc.BayesNet(), [f"n{k}" for k in range(7)]
    for k, name in enumerate(order):
        above = [order[j] for j in range(k) if rng.random() < 0.5]
        slopes, scale = rng.integers(-2, 3, len(above)), float(rng.choice([0.0, 0.0, 1.0, 0.5]))
        if not above:
            scale = 1.0

        def density(*values, slopes=slopes, scale=scale, k=k):
            return bmc.Normal(
                sum((s * v for s, v in zip(slopes, values, strict=True)), start=float(k)), scale
            )

        net.add(name, density, parents=above)
    drawn = net.sample(1, rng=seed)
    seen = [n for n in order if rng.random() < 0.5]
    evidence = {n: float(drawn[n][0]) for n in seen}
    total, mean, var = dense(net, order, evidence)
    found = bmc.infer(net, evidence, engine=bmc.Exact())
    assert found.log_marginal_likelihood == pytest.approx(total, abs=1e-8)
    hidden = [n for n in order if n not in seen]
    for name in hidden:
        assert found.mean(name) == pytest.approx(mean[order.index(name)], abs=1e-8)
        assert found.var(name) == pytest.approx(var[order.index(name)], abs=1e-8)


def test_links_that_finite_nodes_switch():
    net = bmc.BayesNet(plates={"p": 3})
    net.add("s", bmc.Bernoulli(0.3))
    net.add("x", lambda s: bmc.Normal(1.0 * s, 1.0 + s))
    net.add("d", lambda x, s: bmc.Normal(x * (1 + s), 0.0), plates="p")
    found = bmc.infer(net, {"d": [1.0, np.nan, np.nan]}, engine=bmc.Exact())
    weights = [0.7 * stats.norm(0, 1).pdf(1.0), 0.3 * stats.norm(2, 4).pdf(1.0)]
    assert found.mean("s") == pytest.approx(weights[1] / sum(weights))
    assert found.mean("d") == pytest.approx([1.0] * 3)
    assert found.log_marginal_likelihood == pytest.approx(np.log(sum(weights)))


def test_finite_nodes_seen_through_a_link():
    net = bmc.BayesNet()
    net.add("s", bmc.Bernoulli(0.3))
    net.add("y", lambda s: bmc.Normal(2.0 * s, 0.0))
    net.add("z", lambda s: bmc.Normal(2.0, 1.0 * s))
    found = bmc.infer(net, {"y": 2.0}, engine=bmc.Exact())
    assert found.mean("s") == 1.0
    assert found.log_marginal_likelihood == pytest.approx(np.log(0.3))
    with pytest.raises(ZeroProbabilityError):
        bmc.infer(net, {"y": 1.0}, engine=bmc.Exact())
    with pytest.raises(UnsupportedError, match="'z' is observed with noise at some configurations"):
        bmc.infer(net, {"z": 2.0}, engine=bmc.Exact())


def test_singular_covariances():
    """The model of the issue, diag([a, b, 0, c]), in one node, and correlated components."""
    net = bmc.BayesNet()
    net.add("w", bmc.MvNormal([0.0, 1.0, 2.0, 3.0], np.diag([1.0, 2.0, 0.0, 4.0])))
    net.add("v", lambda w: bmc.MvNormal(w, np.diag([1.0, 0.0, 1.0, 1.0])))
    found = bmc.infer(net, {"v": [2.0, 5.0, 2.5, 4.0]}, engine=bmc.Exact())
    assert found.mean("w").tolist() == pytest.approx([1.0, 5.0, 2.0, 3.8])
    assert found.var("w").tolist() == pytest.approx([0.5, 0.0, 0.0, 0.8])
    parts = [(2, 0, 2), (5, 1, 2), (2.5, 2, 1), (4, 3, 5)]
    wanted = sum(normal(x, loc, np.sqrt(var)) for x, loc, var in parts)
    assert found.log_marginal_likelihood == pytest.approx(wanted)
    line = bmc.MvNormal([0.0, 0.0], [[1.0, 2.0], [2.0, 4.0]])
    draws = line.sample(0, 20)
    np.testing.assert_allclose(draws[:, 1], 2 * draws[:, 0])
    with pytest.raises(ParameterError, match="no density"):
        line.log_prob([1.0, 2.0])
    with pytest.raises(ParameterError, match="symmetric positive definite"):
        bmc.MvNormal([0.0, 0.0], [[1.0, 2.0], [2.0, 1.0]])


# ---- over time ------------------------------------------------------------------------------------


def moving():
    """Positions that follow velocities without noise, at unlike time steps, one of them zero."""
    dbn = bmc.DynamicBayesNet()
    dbn.input("dt")
    dbn.add("v", lambda v_prev, dt: bmc.Normal(v_prev, np.sqrt(dt)), initial=bmc.Normal(0.0, 1.0))
    dbn.add(
        "p", lambda p_prev, v_prev, dt: bmc.Normal(p_prev + v_prev * dt, 0.0),
        initial=bmc.Normal(0.0, 1.0),
    )  # fmt: skip
    dbn.add("y", lambda p: bmc.Normal(p, 0.5))
    dbn.add("z", lambda v: bmc.Normal(v, 0.0))
    return dbn, {"dt": [1.0, 1.0, 0.0, 0.5]}


def tracked():
    """The same with one singular covariance, and a vector seen without noise in part."""
    dbn = bmc.DynamicBayesNet()
    step, noise = np.array([[1.0, 0.5], [0.0, 1.0]]), np.diag([0.0, 0.3])
    dbn.add(
        "x", lambda x_prev: bmc.MvNormal(np.matvec(step, x_prev), noise),
        initial=bmc.MvNormal(np.zeros(2), np.eye(2)),
    )  # fmt: skip
    dbn.add("y", lambda x: bmc.MvNormal(x, np.diag([0.4, 0.0])))
    return dbn, None


ROWS = {
    "position": (moving, {"y": [0.1, 0.5, 1.0, 1.2]}),
    "velocity": (moving, {"y": [0.1, np.nan, 1.0, 1.2], "z": [0.3, 0.4, 0.4, 0.2]}),
    "seen now and then": (moving, {"z": [0.3, np.nan, 0.4, np.nan], "p": [0.0, np.nan, 0.3, 0.5]}),
    "vector": (tracked, {"y": [[0.1, 0.2], [0.3, 0.1], [0.2, -0.5]]}),
}


@pytest.mark.parametrize("engine", GAUSSIAN)
@pytest.mark.parametrize("case", ROWS)
def test_gaussian_filters_against_exact_answers(case, engine):
    (dbn, inputs), rows = ROWS[case][0](), ROWS[case][1]
    steps = len(next(iter(rows.values())))
    given = {f"{n}[{t}]": inputs[n][t] for n in inputs for t in range(steps)} if inputs else None
    exact = bmc.infer(
        dbn.unroll(steps), dbn.unrolled_evidence(rows), inputs=given, engine=bmc.Exact()
    )
    smoothed = bmc.smooth(dbn, rows, inputs=inputs, engine=engine)
    filtered = bmc.filter(dbn, rows, inputs=inputs, engine=engine)
    for found in (smoothed, filtered):
        assert found.log_marginal_likelihood == pytest.approx(exact.log_marginal_likelihood)
    for name in set(smoothed.names) - set(rows):
        for t in range(steps):
            one = f"{name}[{t}]"
            assert smoothed.mean(name)[t] == pytest.approx(exact.mean(one), abs=1e-9)
            assert smoothed.var(name)[t] == pytest.approx(exact.var(one), abs=1e-9)
    belief = engine.start(dbn)
    for t in range(steps):
        row = {n: v[t] for n, v in rows.items()}
        belief = engine.step(belief, row, inputs={n: v[t] for n, v in (inputs or {}).items()})
    assert belief.log_marginal_likelihood == pytest.approx(exact.log_marginal_likelihood)


@pytest.mark.parametrize("engine", GAUSSIAN)
def test_rows_that_contradict_what_is_known(engine):
    dbn, inputs = moving()
    rows = {"z": [0.3, 0.4, 0.5, 0.2]}  # no time goes by between slices 1 and 2
    with pytest.raises(ZeroProbabilityError, match="slice 2.*contradicts what is known without"):
        bmc.filter(dbn, rows, inputs=inputs, engine=engine)


def test_a_known_number_read_without_noise():
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    dbn.add("c", lambda t: bmc.Normal(2.0 * t, 0.0))
    dbn.add("y", lambda x, c: bmc.Normal(x + c, 1.0))
    rows = {"y": [1.0, 2.0]}
    alone = bmc.filter(dbn, rows).log_marginal_likelihood
    both = bmc.filter(dbn, {**rows, "c": [0.0, 2.0]}).log_marginal_likelihood
    assert both == pytest.approx(alone)
    with pytest.raises(ZeroProbabilityError, match="slice 1"):
        bmc.filter(dbn, {**rows, "c": [0.0, 3.0]})


# ---- engines that draw, or evaluate densities -------------------------------------------------------


def test_draws_follow_a_link():
    drawn = link().sample(5, rng=0)
    np.testing.assert_array_equal(drawn["d"], 2 * drawn["x"])
    for engine in (bmc.LikelihoodWeighting(20_000), bmc.Rejection(5_000)):
        found = bmc.infer(link(), {"y": 1.0}, engine=engine, rng=1)
        # five standard errors: an alarm in two million
        assert abs(found.mean("d") - 0.8) < 5 * found.mcse("d")
    dbn, inputs = moving()
    exact = bmc.filter(dbn, {"y": [0.1, 0.5, 1.0, 1.2]}, inputs=inputs)
    rows = {"y": [0.1, 0.5, 1.0, 1.2]}
    found = bmc.filter(dbn, rows, inputs=inputs, engine=bmc.ParticleFilter(20_000), rng=1)
    assert found.mean("p") == pytest.approx(exact.mean("p"), abs=0.05)


@pytest.mark.parametrize(
    ("engine", "evidence"),
    [
        (bmc.LikelihoodWeighting(100), {"d": 1.0}),
        (bmc.Rejection(100), {"d": 1.0}),
        (bmc.Importance(100, proposal={"d": lambda: bmc.Normal(0.0, 1.0)}), {"y": 1.0}),
        (bmc.Gibbs(100), {"y": 1.0}),
        (bmc.Gibbs(100), {"d": 1.0}),
        (bmc.MetropolisHastings(100), {"y": 1.0}),
    ],
)
def test_engines_that_need_a_density_name_the_node(engine, evidence):
    with pytest.raises(UnsupportedError, match="density of 'd', which has none: it is without"):
        bmc.infer(link(), evidence, engine=engine, rng=0)


def test_filters_that_need_a_density_name_the_node():
    dbn, inputs = moving()
    rows = {"z": [0.3, 0.4, 0.4, 0.2]}
    grid = bmc.GridFilter({"v": (-5.0, 5.0, 20), "p": (-5.0, 5.0, 20)})
    for engine in (bmc.ParticleFilter(100), grid):
        with pytest.raises(UnsupportedError, match="density of '[zp]', which has none"):
            bmc.filter(dbn, rows, inputs=inputs, engine=engine, rng=0)
    with pytest.raises(ParameterError, match="'p'.*no density"):
        bmc.smooth(dbn, {"y": [0.1, 0.2, 0.3, 0.4]}, inputs=inputs, engine=bmc.ParticleFilter(100))


def test_log_prob_names_the_node():
    with pytest.raises(ParameterError, match="node 'd'.*scale is 0: a point without noise"):
        link().log_prob({"x": 1.0, "d": 2.0, "y": 0.0})
    with pytest.raises(ParameterError, match="Normal: scale is 0"):
        bmc.Normal(0.0, 0.0).log_prob(0.0)
    point = bmc.Normal([0.0, 1.0], [0.0, 1.0])
    assert point.cdf(0.0).tolist() == pytest.approx([1.0, stats.norm.cdf(-1.0)])
    with pytest.raises(ParameterError, match="scale is 0"):
        bmc.Mixture([0.5, 0.5], point)


# ---- computed nodes that are observed -----------------------------------------------------------


@pytest.mark.parametrize("offset", [1.0, -4.0, 250.0])
def test_an_observed_computed_node_is_conditioned_on(offset: float) -> None:
    """A sum that is known: the closed form, and the same net with the sum declared without noise."""
    found = []
    for sums in (lambda x, z: 2 * x + z + offset, lambda x, z: bmc.Normal(2 * x + z + offset, 0.0)):
        net = bmc.BayesNet()
        net.add("x", bmc.Normal(0.0, 1.0))
        net.add("z", bmc.Normal(0.0, 1.0))
        net.add("y", sums)
        found.append(bmc.infer(net, {"y": offset + 2.0}, engine=bmc.Exact()))
    for posterior in found:
        assert posterior.mean("x") == pytest.approx(0.8)
        assert posterior.var("x") == pytest.approx(0.2)
        right = stats.norm.logpdf(2.0, 0.0, np.sqrt(5.0))
        assert posterior.log_marginal_likelihood == pytest.approx(right)


def test_observed_computed_nodes_in_plates_vectors_and_over_time() -> None:
    net = bmc.BayesNet(plates={"i": 3})
    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("e", bmc.Normal(0.0, 1.0), plates="i")
    net.add("y", lambda x, e: x + e, plates="i")
    assert bmc.infer(net, {"y": [1.0, 2.0, 3.0]}).mean("x") == pytest.approx(1.5)
    net = bmc.BayesNet()
    net.add("x", bmc.MvNormal(np.zeros(2), np.eye(2)))
    net.add("y", lambda x: 3 * x)
    np.testing.assert_allclose(bmc.infer(net, {"y": [3.0, 1.0]}).mean("x"), [1.0, 1 / 3])
    answers = []
    for computed in (True, False):
        dbn = bmc.DynamicBayesNet()
        dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
        if computed:
            dbn.add("v", bmc.Normal(0.0, 1.0))
            dbn.add("y", lambda x, v: x + v)
        else:
            dbn.add("y", lambda x: bmc.Normal(x, 1.0))
        answers.append(bmc.filter(dbn, {"y": [1.0, 2.0, np.nan, 1.0]}))
    np.testing.assert_allclose(*(a.mean("x") for a in answers))
    assert answers[0].log_marginal_likelihood == pytest.approx(answers[1].log_marginal_likelihood)


def test_computed_nodes_that_are_counts_take_no_evidence() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Poisson(3.0))
    net.add("s", lambda a: a + 1)
    with pytest.raises(EvidenceError, match="'s', which is a deterministic node and takes none"):
        bmc.infer(net, {"s": 5})
