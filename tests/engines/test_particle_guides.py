"""``proposal="optimal"`` and ``auxiliary=True`` where what is hidden or seen is no Normal.

Evidence is held against grids and exact enumeration on many filters at once; a guide is also to be worth
something, and what is not guided is to be named.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.engines.particles.laplace import corrected
from bayesmc.engines.particles.linearisation import LookAhead
from bayesmc.errors import ProposalWarning
from bayesmc.testing import session

pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")

Density = Callable[..., Any]
RUNS, PARTICLES, STEPS = session.scaled(120), 100, 5


def level(seen: Density, moves: Density | None = None, first: Any = None) -> Any:
    """What builds a template with a hidden number and what is seen of it, for many filters side by side."""

    def build(runs: int = 0) -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet(plates={"run": runs} if runs else None)
        own: Any = "run" if runs else ()
        walk = moves or (lambda x_prev: bmc.Normal(0.8 * x_prev, 0.9))
        dbn.add("x", walk, initial=first or bmc.Normal(0.0, 1.0), plates=own)
        dbn.add("y", seen, plates=own)
        return dbn

    return build


def softmax(x: Any) -> bmc.Categorical:
    logits = np.stack(np.broadcast_arrays(0.0 * x, 3.0 * x, -2.0 * x), axis=-1)
    shares = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return bmc.Categorical(shares / shares.sum(axis=-1, keepdims=True))


def apart(x: Any) -> bmc.Mixture:
    return bmc.Mixture([0.7, 0.3], [bmc.Normal(x - 2.0, 0.1), bmc.Normal(x + 2.0, 0.2)])


def outliers(x: Any) -> bmc.Mixture:
    return bmc.Mixture([0.9, 0.1], [bmc.Normal(x, 0.05), bmc.StudentT(3.0, x, 2.0)])


def jumps(x_prev: Any) -> bmc.Mixture:
    return bmc.Mixture([0.8, 0.2], [bmc.Normal(x_prev, 0.1), bmc.Normal(x_prev + 3.0, 0.3)])


def sharply(x: Any) -> bmc.Normal:
    return bmc.Normal(x, 0.1)


def upwards(x_prev: Any) -> bmc.Truncated:
    return bmc.Truncated(bmc.Normal(x_prev, 1.0), 0.0)


WIDE = (-9.0, 9.0, 1200)
#: structure -> template, grid, times by which guided particles are worth more than others in a slice
CASES: dict[str, tuple[Any, Any, float]] = {
    "Binomial": (level(lambda x: bmc.Binomial(500, logits=x)), WIDE, 4),
    "Poisson": (level(lambda x: bmc.Poisson(np.exp(3.0 + x))), WIDE, 1.5),
    "NegativeBinomial": (
        level(lambda x: bmc.NegativeBinomial(20.0, 20.0 / (20.0 + np.exp(3.0 + x)))),
        WIDE,
        1.5,
    ),
    "Categorical": (level(softmax), WIDE, 1.1),
    "Gamma": (level(lambda x: bmc.Gamma(50.0, np.exp(-x))), WIDE, 3),
    "Weibull": (level(lambda x: bmc.Weibull(8.0, np.exp(x))), WIDE, 3),
    "StudentT": (level(lambda x: bmc.StudentT(3.0, x, 0.1)), WIDE, 2.5),
    "volatility": (level(lambda x: bmc.Normal(0.0, np.exp(x))), WIDE, 1.1),
    "Truncated": (level(lambda x: bmc.Truncated(bmc.Normal(x, 0.2), 0.0)), WIDE, 1.2),
    "mixture": (level(apart), WIDE, 4),
    "outliers": (level(outliers), WIDE, 4),
    "jumps": (level(sharply, jumps), (-6.0, 20.0, 2000), 1.5),
    "Truncated, hidden": (
        level(sharply, upwards, bmc.HalfNormal(1.0)),
        (0.0, 20.0, 2000),
        3,
    ),
    "StudentT, hidden": (
        level(sharply, lambda x_prev: bmc.StudentT(4.0, 0.9 * x_prev, 1.0)),
        (-40.0, 40.0, 3000),
        3,
    ),
    "Gamma, hidden": (
        level(
            lambda x: bmc.Poisson(50.0 * x),
            lambda x_prev: bmc.Gamma(4.0, 4.0 / x_prev),
            bmc.Gamma(4.0, 4.0),
        ),
        (1e-4, 20.0, 2000),
        1.2,
    ),
}


#: those much like others
LIKE = {
    *("Poisson", "NegativeBinomial", "Categorical", "Gamma", "Truncated", "mixture"),
    *("StudentT, hidden", "Gamma, hidden"),
}


def side_by_side(rows: Any, runs: int) -> dict[str, Any]:
    return {"y": np.repeat(np.asarray(rows)[:, None], runs, axis=1)}


def deviation(build: Any, rows: Any, exact: float, **options: Any) -> tuple[float, float]:
    """Standard errors by which the mean of evidence over the truth is off 1, and the effective particles."""
    engine = bmc.ParticleFilter(PARTICLES, **options)
    found = bmc.filter(build(RUNS), side_by_side(rows, RUNS), engine=engine, rng=session.seed())
    ratio = np.exp(found.log_marginal_likelihood - exact)
    off = (ratio.mean() - 1.0) / (ratio.std(ddof=1) / np.sqrt(len(ratio)))
    return float(off), float(found.weight_ess.mean())


def by_grid(case: str) -> tuple[Any, float]:
    build, grid, _ = CASES[case]
    rows = build().sample(STEPS, 1, rng=5)["y"][0]
    exact = bmc.filter(build(), {"y": rows}, engine=bmc.GridFilter(grid={"x": grid}))
    return rows, float(exact.log_marginal_likelihood)


@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=pytest.mark.thorough if c in LIKE else ()) for c in CASES]
)
def test_guides_change_no_evidence_and_help(case: str) -> None:
    """Mean of Z-hat / Z within 4 standard errors of 1 (6e-5 each, 2e-3 for all 30)."""
    build, _, gain = CASES[case]
    rows, exact = by_grid(case)
    off, guided = deviation(build, rows, exact, proposal="optimal")
    assert abs(off) < 4
    both, _ = deviation(build, rows, exact, proposal="optimal", auxiliary=True)
    assert abs(both) < 4
    _, plain = deviation(build, rows, exact)
    assert guided > gain * plain, (guided, plain)


def random_case(seed: int) -> Any:
    """A transition and an emission of families and parameters taken at random."""
    rng = np.random.default_rng([43, session.seed(), seed])
    back, drift, noise = rng.uniform(0.5, 0.95), rng.normal(0.0, 0.5), rng.uniform(0.2, 1.2)
    share, shift, other = rng.uniform(0.1, 0.9), rng.normal(0.0, 2.0), rng.uniform(0.1, 1.0)
    slope, size, count = rng.uniform(-1.0, 1.2), rng.uniform(0.2, 30.0), int(rng.integers(1, 300))
    narrow, tail = rng.uniform(0.05, 0.8), rng.uniform(2.5, 6.0)
    moves: list[Density] = [
        lambda x_prev: bmc.Normal(back * x_prev + drift, noise),
        lambda x_prev: bmc.Normal(back * x_prev, 0.2 + 0.3 * np.abs(x_prev)),
        lambda x_prev: bmc.StudentT(tail, back * x_prev + drift, noise),
        lambda x_prev: bmc.Truncated(bmc.Normal(back * x_prev + drift, noise), -6.0, 6.0),
        lambda x_prev: bmc.Mixture(
            [share, 1 - share],
            bmc.Normal(back * x_prev[..., None] + np.array([0.0, shift]), np.array([noise, other])),
        ),
    ]
    looks: list[Density] = [
        lambda x: bmc.Binomial(count, logits=slope * x + drift),
        lambda x: bmc.Poisson(size * np.exp(slope * x)),
        lambda x: bmc.Gamma(size, np.exp(slope * x)),
        lambda x: bmc.Weibull(1.0 + size / 4, np.exp(slope * x)),
        lambda x: bmc.StudentT(tail, slope * x, narrow),
        lambda x: bmc.Cauchy(x, narrow),
        lambda x: bmc.LogNormal(slope * x, narrow),
        lambda x: bmc.Bernoulli(1 / (1 + np.exp(-3 * x))),
        lambda x: bmc.Truncated(bmc.Normal(slope * x, narrow), -1.0, 3.0),
        lambda x: bmc.Mixture(
            [share, 1 - share],
            [bmc.Normal(slope * x, narrow), bmc.Normal(slope * x + shift, other)],
        ),
        lambda x: bmc.Mixture([0.9, 0.1], [bmc.Normal(x, narrow), bmc.Uniform(-40.0, 40.0)]),
        lambda x: bmc.Mixture(
            [0.3, 0.7], [bmc.Poisson(0.01 + 0.0 * x), bmc.Poisson(size * np.exp(slope * x))]
        ),
    ]
    return level(looks[seed % len(looks)], moves[seed % len(moves)])


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.thorough) for k in range(1, 60))]
)
def test_guides_of_random_models_change_no_evidence(seed: int) -> None:
    """Mean of Z-hat / Z within 4 standard errors of 1 (6e-5 each)."""
    build = random_case(seed)
    rows = build().sample(4, 1, rng=session.seed() + seed)["y"][0]
    grid = bmc.GridFilter(grid={"x": (-25.0, 25.0, 2500)})
    exact = float(bmc.filter(build(), {"y": rows}, engine=grid).log_marginal_likelihood)
    for options in ({}, {"auxiliary": True}):
        off, _ = deviation(build, rows, exact, proposal="optimal", **options)
        assert abs(off) < 4, options


@pytest.mark.parametrize("case", ["Binomial", "jumps", "outliers"])
def test_wrong_weights_of_guided_draws_are_caught(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same check fails where the density of what was drawn is off by a tenth."""
    real = LookAhead.log_density
    monkeypatch.setattr(LookAhead, "log_density", lambda *a: real(*a) + 0.1)
    rows, exact = by_grid(case)
    off, _ = deviation(CASES[case][0], rows, exact, proposal="optimal")
    assert off < -4


WEIGHTS = np.array([0.6, 0.4])
COVS = np.array([[[0.02, 0.0], [0.0, 0.5]], [[0.5, 0.1], [0.1, 0.03]]])
SHIFTS = np.array([[0.0, 0.0], [0.0, 2.0]])


def planes(where: str, listed: bool = True, by_state: bool = False) -> Any:
    """Two numbers, and a mixture of MvNormals in the transition or the emission, or its state as a node."""

    def build(runs: int = 0) -> bmc.DynamicBayesNet:
        dbn = bmc.DynamicBayesNet(plates={"run": runs} if runs else None)
        own: Any = "run" if runs else ()
        first = bmc.MvNormal(np.zeros(2), np.eye(2))

        def mixed(at: Any) -> bmc.Mixture:
            if listed:
                parts: Any = [bmc.MvNormal(at + s, c) for s, c in zip(SHIFTS, COVS, strict=True)]
            else:
                parts = bmc.MvNormal(at[..., None, :] + SHIFTS, COVS)
            return bmc.Mixture(WEIGHTS, parts)

        def switched(at: Any, z: Any) -> bmc.MvNormal:
            z = np.asarray(z)
            return bmc.MvNormal(at + SHIFTS[z], COVS[z])

        if by_state:
            dbn.table("z", [], WEIGHTS, plates=own)
        walk: Density = lambda x_prev: bmc.MvNormal(0.8 * x_prev, np.eye(2))  # noqa: E731
        look: Density = lambda x: bmc.MvNormal(x, 0.01 * np.eye(2))  # noqa: E731
        if where == "transition":
            walk = switched if by_state else mixed
        else:
            look = switched if by_state else mixed
        moves = ["x_prev", "z"] if by_state and where == "transition" else ["x_prev"]
        dbn.add("x", walk, moves, initial=first, plates=own)
        looks = ["x", "z"] if by_state and where == "emission" else ["x"]
        dbn.add("y", look, looks, plates=own)
        return dbn

    return build


@pytest.mark.parametrize("listed", [True, False])
@pytest.mark.parametrize("where", ["emission", "transition"])
def test_mixtures_of_mvnormals_are_guided_by_their_components(where: str, listed: bool) -> None:
    """Exact: the same net with the choice as a node. Within 4 standard errors (6e-5 each)."""
    build, truth = planes(where, listed), planes(where, by_state=True)()
    rows = build().sample(4, 1, rng=2)["y"][0]
    net = truth.unroll(4)
    exact = bmc.infer(net, truth.unrolled_evidence({"y": rows}), engine=bmc.Exact())
    log = float(exact.log_marginal_likelihood)
    off, guided = deviation(build, rows, log, proposal="optimal")
    both, _ = deviation(build, rows, log, proposal="optimal", auxiliary=True)
    _, plain = deviation(build, rows, log)
    assert abs(off) < 4 and abs(both) < 4
    assert guided > 4 * plain


def issue() -> bmc.DynamicBayesNet:
    """The series of the issue."""
    dbn = bmc.DynamicBayesNet()
    dbn.add(
        "x",
        lambda x_prev: bmc.Normal(-4.0 + 0.98 * (x_prev + 4.0), 0.15),
        initial=bmc.Normal(-4.0, 0.754),
    )
    dbn.add("y", lambda x: bmc.Binomial(50, logits=x))
    return dbn


def test_binomial_rows_are_looked_at() -> None:
    rows = {"y": issue().sample(300, 1, rng=1)["y"][0]}
    engine = bmc.ParticleFilter(500, proposal="optimal", auxiliary=True)
    told = bmc.explain(issue(), rows, engine)
    assert told.nodes["x"].startswith("sampled with a look at 'y'")
    assert told.nodes["y"].endswith("guides 'x'")
    with warnings.catch_warnings():
        warnings.simplefilter("error", ProposalWarning)
        found = bmc.filter(issue(), rows, engine=engine, rng=session.seed())
    plain = bmc.filter(issue(), rows, engine=bmc.ParticleFilter(500), rng=session.seed())
    exact = bmc.filter(issue(), rows, engine=bmc.GridFilter(grid={"x": (-9.0, 1.0, 1000)}))
    assert abs(found.log_marginal_likelihood - exact.log_marginal_likelihood) < 1.0
    assert found.weight_ess.mean() > plain.weight_ess.mean()


def test_what_is_not_guided_is_named() -> None:
    dbn = issue()
    dbn.add("v", lambda x: bmc.VonMises(x, 4.0))
    dbn.add("q", lambda v: bmc.Normal(np.cos(v), 0.5))
    dbn.table("z", ["z_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5])
    dbn.add("w", lambda x, z: bmc.Normal(x + z, 1.0))
    dbn.add("u", lambda x: bmc.DiscreteUniform(0, 9 + (x > 0)))
    rows: dict[str, Any] = {"y": [1, 2], "q": [0.1, 0.2], "w": [-4.0, -4.0], "u": [1, 2]}
    engine = bmc.ParticleFilter(200, proposal="optimal", auxiliary=True)
    told = bmc.explain(dbn, rows, engine).nodes
    assert "look at 'y', 'w'" in told["x"]
    assert "not guided: VonMises lies on a circle" in told["v"]
    assert "not guided: it is finite" in told["z"]
    assert "guides nothing: DiscreteUniform" in told["u"]
    assert "guides nothing: it depends on no number but through" in told["q"]
    assert "by the look ahead" in told["v"]
    with pytest.warns(ProposalWarning, match="'v': VonMises lies on a circle.*'u'.*'q'") as caught:
        bmc.filter(dbn, rows, engine=engine, rng=0)
    assert "'z'" not in str(caught[0].message)  # x beside it is guided
    assert caught[0].filename == __file__


def test_proposals_of_the_user_are_told_as_such() -> None:
    engine = bmc.ParticleFilter(9, proposal={"x": lambda x_prev: bmc.Normal(x_prev, 1.0)})
    assert bmc.explain(issue(), {"y": [1]}, engine).nodes["x"] == "sampled from its proposal"
    plain = bmc.explain(issue(), {"y": [1]}, bmc.ParticleFilter(9)).nodes
    assert plain["x"] == "sampled given its parents"


def test_a_net_in_which_nothing_is_guided_says_so() -> None:
    hmm = bmc.DynamicBayesNet()
    hmm.table("z", ["z_prev"], [[0.8, 0.2], [0.3, 0.7]], initial=[0.5, 0.5])
    hmm.add("y", lambda z: bmc.Normal(1.0 * z, 1.0))
    engine = bmc.ParticleFilter(100, proposal="optimal")
    with pytest.warns(ProposalWarning, match="'z': it is finite"):
        bmc.filter(hmm, {"y": [0.3, 0.9]}, engine=engine, rng=0)
    with pytest.warns(ProposalWarning, match="'z': it is finite"):
        bmc.smooth(hmm, {"y": [0.3, 0.9]}, engine=engine, rng=0)
    with pytest.warns(ProposalWarning, match="'z': it is finite"):
        engine.step(engine.start(hmm, rng=0), {"y": 0.3})


def test_counts_of_many_numbers_are_not_looked_at_and_named() -> None:
    """Derivatives are taken in six numbers at most; what has moments goes by these beyond."""
    for family, heard in ((bmc.Poisson, True), (lambda m: bmc.Binomial(9, m / (m + 1)), False)):
        dbn = bmc.DynamicBayesNet(plates={"k": 8})
        start = bmc.Normal(0.0, 1.0)
        dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.1), initial=start, plates="k")
        dbn.add("y", lambda x, f=family: f(np.exp(x.sum("k") / 4)))
        engine = bmc.ParticleFilter(500, proposal="optimal")
        told = bmc.explain(dbn, {"y": [1, 2]}, engine).nodes
        assert ("look at 'y'" in told["x"]) is heard
        assert ("more than 6 hidden numbers" in told["y"]) is not heard
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            bmc.filter(dbn, {"y": [1, 2]}, engine=engine, rng=0)
        assert any(w.category is ProposalWarning for w in caught) is not heard


def test_draws_outside_the_support_stand_in_the_next_slice() -> None:
    """A scale that a Gaussian guess may make negative: no weight, and valid in the slice after."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("s", lambda s_prev: bmc.Gamma(1.5, 1.5 / s_prev), initial=bmc.Gamma(1.5, 1.5))
    dbn.add("y", lambda s: bmc.Normal(0.0, s))
    rows = {"y": [0.02, -0.5, 0.01, 1.5, None, 0.3]}
    engine = bmc.ParticleFilter(4000, proposal="optimal", ess_threshold=0.0)
    found = bmc.filter(dbn, rows, engine=engine, rng=session.seed(), keep="particles")
    assert (found.particles("s") > 0).all()
    plain = bmc.filter(dbn, rows, engine=bmc.ParticleFilter(100_000), rng=session.seed())
    assert abs(found.log_marginal_likelihood - plain.log_marginal_likelihood) < 0.5


def test_laplace_finds_far_modes_and_leaves_kinks() -> None:
    """A count of 1000 from a start at 1, a wall of exponentials, and a density without slope."""
    mean, root = np.zeros((3, 1)), 3.0 * np.ones((3, 1, 1))

    def density(points: np.ndarray) -> np.ndarray:
        x = points[..., 0]
        with np.errstate(over="ignore"):
            counted = 1000.0 * x[..., 0] - np.exp(x[..., 0])
            failed = -8.0 * x[..., 1] - np.exp(8.0 * (2.0 - x[..., 1]))
        flat = np.where(np.abs(x[..., 2] - 1.0) < 5.0, 0.0, -np.inf)
        return np.stack([counted, failed, flat], axis=-1)

    with np.errstate(all="ignore"):
        mode, cov, _ = corrected(density, mean, root)
    grid = np.linspace(-9.0, 9.0, 180_001)
    values = density(np.repeat(grid[:, None, None], 3, axis=1)) - 0.5 * (grid / 3.0)[:, None] ** 2
    wanted = grid[values.argmax(axis=0)]
    np.testing.assert_allclose(mode[:2, 0], wanted[:2], atol=0.02)
    assert cov[2, 0, 0] == pytest.approx(9.0) and mode[2, 0] == 0.0
    assert cov[0, 0, 0] == pytest.approx(1.0 / (1.0 / 9.0 + np.exp(wanted[0])), rel=0.05)
