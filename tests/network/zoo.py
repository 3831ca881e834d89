"""Good models of the kinds people write; every one must pass validate() and sample."""

from __future__ import annotations

import functools

import numpy as np
import scipy.special
import scipy.stats

import bayesmc as bmc

ZOO = {}


def model(plates=None, inputs=None):
    """Register a function that declares nodes on a net with these plates."""

    def register(declare):
        ZOO[declare.__name__] = (declare, plates, inputs)
        return declare

    return register


def build(name):
    """The net of a model of the zoo, and its inputs."""
    declare, plates, inputs = ZOO[name]
    net = bmc.BayesNet(name, plates=plates)
    declare(net)
    return net, inputs


RNG = np.random.default_rng(7)
X = RNG.normal(size=(6, 3))
T = np.linspace(-1.0, 1.0, 6)


@model({"point": 6})
def linear_regression(net):
    net.add("a", bmc.Normal(0.0, 10.0))
    net.add("b", bmc.Normal(0.0, 10.0))
    net.add("s", bmc.Exponential(1.0))
    net.add("y", lambda a, b, s: bmc.Normal(a + b * T, s), plates="point")


@model({"point": 6})
def design_matrix_regression(net):
    net.add("beta", bmc.MvNormal(np.zeros(3), np.eye(3)))
    net.add("y", lambda beta: bmc.Normal(np.vecdot(X, beta), 1.0), plates="point")


@model({"point": 6})
def polynomial_regression(net):
    powers = T[:, None] ** np.arange(4)
    net.add("c", bmc.MvNormal(np.zeros(4), np.eye(4)))
    net.add("y", lambda c: bmc.Normal((powers * c).sum(axis=-1), 0.1), plates="point")


@model({"point": 6})
def logistic_regression(net):
    net.add("beta", bmc.MvNormal(np.zeros(3), np.eye(3)))
    net.add("y", lambda beta: bmc.Bernoulli(logits=np.vecdot(X, beta)), plates="point")


@model({"point": 6})
def poisson_regression(net):
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("n", lambda a: bmc.Poisson(np.exp(a * T)), plates="point")


@model({"point": 6, "feature": 3})
def plate_of_coefficients(net):
    """Coefficients as a foreign plate, reduced by name."""
    net.add("tau", bmc.Gamma(2.0, 2.0))
    net.add("beta", lambda tau: bmc.Normal(0.0, tau), plates="feature")
    net.add("y", lambda beta: bmc.Normal((beta.array * X).sum(axis=-1), 1.0), plates="point")


@model({"point": 6})
def robust_regression(net):
    net.add("df", bmc.Gamma(2.0, 0.1))
    net.add("b", bmc.Normal(0.0, 1.0))
    net.add("y", lambda b, df: bmc.StudentT(df + 1.0, b * T, 1.0), plates="point")


@model({"point": 6})
def heteroscedastic(net):
    net.add("w", bmc.Normal(0.0, 0.3))
    net.add("y", lambda w: bmc.Normal(0.0, np.exp(w * T)), plates="point")


@model({"cluster": 3, "point": 8})
def mixture(net):
    net.add("weights", bmc.Dirichlet(np.ones(3)))
    net.add("mean", bmc.Normal(0.0, 10.0), plates="cluster")
    net.add("scale", bmc.Gamma(2.0, 1.0), plates="cluster")
    net.add("label", lambda weights: bmc.Categorical(weights), plates="point")
    net.add("x", lambda label, mean, scale: bmc.Normal(mean[label], scale[label]), plates="point")


@model({"cluster": 3, "point": 8})
def mixture_marginalised(net):
    net.add("weights", bmc.Dirichlet(np.ones(3)))
    net.add("mean", bmc.MvNormal(np.zeros(3), 4 * np.eye(3)))
    net.add(
        "x",
        lambda weights, mean: bmc.Mixture(weights, bmc.Normal(mean, 1.0)),
        plates="point",
    )


@model({"cluster": 2, "point": 8})
def multivariate_mixture(net):
    net.add("mu", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="cluster")
    net.add("z", bmc.Bernoulli(0.4), plates="point")
    net.add("x", lambda mu, z: bmc.MvNormal(mu[z], 0.1 * np.eye(2)), plates="point")


@model({"topic": 3, "document": 4, "token": 9})
def topic_model(net):
    document = np.array([0, 0, 1, 1, 1, 2, 3, 3, 3])
    net.add("phi", bmc.Dirichlet(np.full(5, 0.5)), plates="topic")
    net.add("theta", bmc.Dirichlet(np.full(3, 0.5)), plates="document")
    net.add("z", lambda theta: bmc.Categorical(theta[document]), plates="token")
    net.add("word", lambda phi, z: bmc.Categorical(phi[z]), plates="token")


@model({"topic": 3, "document": 4, "word": 5})
def topic_model_in_two_plates(net):
    net.add("phi", bmc.Dirichlet(np.full(7, 0.5)), plates="topic")
    net.add("theta", bmc.Dirichlet(np.full(3, 0.5)), plates="document")
    net.add("z", lambda theta: bmc.Categorical(theta), plates=("document", "word"))
    net.add("w", lambda phi, z: bmc.Categorical(phi[z]), plates=("word", "document"))


@model({"school": 8})
def eight_schools(net):
    sd = np.array([15.0, 10, 16, 11, 9, 11, 10, 18])
    net.add("mu", bmc.Normal(0.0, 5.0))
    net.add("log_tau", bmc.Normal(0.0, 1.0))
    net.add("raw", bmc.Normal(0.0, 1.0), plates="school")
    net.add("theta", lambda mu, log_tau, raw: mu + np.exp(log_tau) * raw, plates="school")
    net.add("y", lambda theta: bmc.Normal(theta, sd), plates="school")


@model({"school": 3, "pupil": 7})
def pupils_in_schools(net):
    school = np.array([0, 0, 1, 1, 1, 2, 2])
    net.add("mu", bmc.Normal(0.0, 5.0))
    net.add("effect", lambda mu: bmc.Normal(mu, 1.0), plates="school")
    net.add("slope", bmc.Normal(0.0, 1.0), plates="school")
    net.add(
        "score",
        lambda effect, slope: bmc.Normal(effect[school] + slope[school] * T[0], 1.0),
        plates="pupil",
    )


@model({"user": 3, "item": 4})
def matrix_factorisation(net):
    net.add("u", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="user")
    net.add("v", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="item")
    net.add("r", lambda u, v: bmc.Normal(np.vecdot(u, v), 0.5), plates=("user", "item"))


@model({"user": 3, "item": 4, "rating": 5})
def ratings_by_index(net):
    user, item = np.array([0, 1, 2, 2, 0]), np.array([3, 2, 1, 0, 0])
    net.add("u", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="user")
    net.add("v", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="item")
    net.add("r", lambda u, v: bmc.Normal(np.vecdot(u[user], v[item]), 0.5), plates="rating")


@model({"state": 2, "next": 2})
def hidden_markov_loop(net):
    """Unrolled by a Python loop with the idiom i=i; gathers rows of a transition matrix."""
    net.add("row", bmc.Dirichlet(np.ones(2)), plates="state")
    for i in range(5):
        if i == 0:
            net.add("h0", bmc.Categorical([0.5, 0.5]))
        else:
            net.add(f"h{i}", lambda h, row: bmc.Categorical(row[h]), parents=[f"h{i - 1}", "row"])
        net.add(f"o{i}", lambda h, i=i: bmc.Normal(h + 0.1 * i, 1.0), parents=[f"h{i}"])


@model()
def random_walk_loop(net):
    net.add("x0", bmc.Normal(0.0, 1.0))
    for i in range(1, 6):
        net.add(f"x{i}", lambda prev, i=i: bmc.Normal(prev + i, 1.0), parents=[f"x{i - 1}"])


@model()
def vector_dynamics(net):
    a = np.array([[1.0, 0.1], [0.0, 0.95]])
    net.add("s0", bmc.MvNormal(np.zeros(2), np.eye(2)))
    for i in range(1, 4):
        net.add(
            f"s{i}", lambda s: bmc.MvNormal(np.matvec(a, s), 0.1 * np.eye(2)), parents=[f"s{i - 1}"]
        )
        net.add(f"y{i}", lambda s: bmc.Normal(s[..., 0], 0.5), parents=[f"s{i}"])


@model({"robot": 3})
def bearings(net):
    net.add("pose", bmc.MvNormal(np.array([3.0, 4.0, 0.0]), 0.1 * np.eye(3)), plates="robot")
    net.add(
        "z",
        lambda pose: bmc.MvNormal(
            bmc.stack(
                [np.hypot(pose[..., 0], pose[..., 1]), np.arctan2(pose[..., 1], pose[..., 0])]
            ),
            0.01 * np.eye(2),
        ),
        plates="robot",
    )


@model()
def stack_of_mixed_ranks(net):
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", bmc.Normal(0.0, 1.0))
    net.add("c", bmc.Bernoulli(0.5))
    net.add("v", lambda a, b, c: bmc.stack([a, b * c, 1.0]))
    net.add("y", lambda v: bmc.MvNormal(v, np.eye(3)))


@model({"point": 6})
def switch_by_where(net):
    net.add("on", bmc.Bernoulli(0.3), plates="point")
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add(
        "y",
        lambda on, m: bmc.Normal(np.where(on == 1, m, 5.0), np.where(on, 1.0, 2.0)),
        plates="point",
    )


@model({"point": 6})
def labels_by_where(net):
    net.add("kind", bmc.Categorical([0.2, 0.5, 0.3]), plates="point", states=("low", "mid", "high"))
    net.add(
        "y",
        lambda kind: bmc.Normal(np.select([kind == "low", kind == "high"], [-1.0, 1.0], 0.0), 1.0),
        plates="point",
    )


@model({"point": 4})
def masked_by_constant(net):
    mask = np.array([True, False, True, True])
    net.add("m", bmc.Normal(0.0, 1.0), plates="point")
    net.add(
        "y", lambda m: bmc.Normal(np.where(mask, m, 0.0), np.where(mask, 1.0, 10.0)), plates="point"
    )


@model({"point": 6})
def truncation_by_where(net):
    net.add("x", bmc.Normal(0.0, 1.0), plates="point")
    net.add("y", lambda x: bmc.Exponential(np.where(x > 0, x, 1e-3) + 0.1), plates="point")


@model({"side": 4})
def dirichlet_categorical(net):
    net.add("p", bmc.Dirichlet([1.0, 2.0, 3.0]))
    net.add("alpha", bmc.Gamma(2.0, 1.0))
    net.add("q", lambda p, alpha: bmc.Dirichlet(p * (1 + alpha[..., None])), plates="side")
    net.add("c", lambda q: bmc.Categorical(q), plates="side")


@model({"point": 4})
def softmax_classifier(net):
    net.add("w", bmc.MvNormal(np.zeros(3), np.eye(3)))
    net.add(
        "c",
        lambda w: bmc.Categorical(scipy.special.softmax(w * T[:4, None], axis=-1)),
        plates="point",
    )


@model({"point": 4})
def ordinal(net):
    net.add("f", bmc.Normal(0.0, 1.0), plates="point")

    def grade(f):
        low, high = scipy.special.expit(-1.0 - f), scipy.special.expit(1.0 - f)
        return bmc.Categorical(bmc.stack([low, high - low, 1 - high]))

    net.add("grade", grade, plates="point")


@model()
def sprinkler(net):
    net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    net.table("sprinkler", ["rain"], [[0.6, 0.4], [0.99, 0.01]], states=("off", "on"))
    net.table(
        "wet",
        ["sprinkler", "rain"],
        [[[1.0, 0.0], [0.2, 0.8]], [[0.1, 0.9], [0.01, 0.99]]],
        states=("no", "yes"),
    )


@model()
def logic_gates(net):
    net.add("a", bmc.Bernoulli(0.5))
    net.add("b", bmc.Bernoulli(0.5), states=(False, True))
    net.add("both", lambda a, b: a & b)
    net.add("either", lambda a, b: (a == 1) | b)
    net.add("odd", lambda a, b, both: (a + b + both) % 2)
    net.add("seen", lambda either, odd: bmc.Bernoulli(np.where(either & (odd == 0), 0.9, 0.1)))


@model()
def signed_states(net):
    net.add("spin", bmc.Bernoulli(0.5), states=(-1, 1))
    net.add("other", lambda spin: bmc.Bernoulli(logits=2.0 * spin), states=(-1, 1))
    net.add("energy", lambda spin, other: -spin * other)
    net.add("x", lambda energy: bmc.Normal(energy, 0.5))


@model()
def sum_of_dice(net):
    net.add("a", bmc.DiscreteUniform(1, 6))
    net.add("b", bmc.DiscreteUniform(1, 6))
    net.add("total", lambda a, b: a + b)
    net.add("high", lambda total: bmc.Bernoulli(np.where(total >= 9, 0.95, 0.05)))


@model()
def narrow_support(net):
    """A child whose support depends on its parent."""
    net.add("b", bmc.Gamma(3.0, 1.0))
    net.add("u", lambda b: bmc.Uniform(0.0, b))
    net.add("v", lambda u, b: bmc.Uniform(u, b + u))
    net.add("p", lambda u, b: bmc.Bernoulli(u / b))
    net.add("r", lambda u, b: bmc.Normal(np.sqrt(b - u), 1.0))


@model()
def stick_breaking(net):
    net.add("b1", bmc.Beta(1.0, 2.0))
    net.add("b2", bmc.Beta(1.0, 2.0))
    net.add("w", lambda b1, b2: bmc.stack([b1, (1 - b1) * b2, (1 - b1) * (1 - b2)]))
    net.add("z", lambda w: bmc.Categorical(w))


@model()
def binomial_of_random_size(net):
    net.add("n", bmc.Poisson(6.0))
    net.add("p", bmc.Beta(2.0, 2.0))
    net.add("k", lambda n, p: bmc.Binomial(n, p))
    net.add("rest", lambda n, k: n - k)
    net.add("again", lambda rest: bmc.Binomial(rest, 0.5))


@model({"site": 4})
def binomial_thinning_in_plates(net):
    net.add("rate", bmc.Gamma(3.0, 0.5), plates="site")
    net.add("n", lambda rate: bmc.Poisson(rate), plates="site")
    net.add("seen", lambda n: bmc.Binomial(n, 0.3), plates="site")


@model()
def discrete_uniform_of_random_bounds(net):
    net.add("low", bmc.DiscreteUniform(0, 3))
    net.add("width", bmc.Poisson(2.0))
    net.add("k", lambda low, width: bmc.DiscreteUniform(low, low + width))


@model({"point": 5})
def underflowing_probabilities(net):
    net.add("x", bmc.Normal(0.0, 300.0), plates="point")
    net.add("c", lambda x: bmc.Bernoulli(scipy.special.expit(-x * x)), plates="point")
    net.add("d", lambda x: bmc.Categorical(logits=bmc.stack([x, -x, 0.0])), plates="point")


@model({"point": 5})
def scipy_frozen(net):
    net.add("a", scipy.stats.gamma(2.0, scale=1.0))
    net.add("b", lambda a: scipy.stats.norm(a, 2.0))
    net.add("c", lambda a, b: scipy.stats.gumbel_r(loc=b, scale=a + 0.1), plates="point")
    net.add("n", lambda a: scipy.stats.nbinom(3.0, 1 / (1 + a)), plates="point")


@model()
def density_only(net):
    net.add("a", bmc.Gamma(2.0, 1.0))
    net.add(
        "x",
        lambda a: bmc.Density(
            lambda x: np.log(a) - a * x,
            sample=lambda rng, shape: rng.exponential(1 / a, size=shape + np.shape(a)),
            support="positive",
        ),
    )
    net.add("y", lambda x: bmc.Normal(np.log(x), 1.0))


@model({"point": 5})
def deterministic_chain(net):
    net.add("x", bmc.Normal(0.0, 1.0), plates="point")
    net.add("centre", lambda x: x.mean("point"))
    net.add("spread", lambda x, centre: np.sqrt(((x - centre) ** 2).mean("point")))
    net.add("z", lambda x, centre, spread: (x - centre) / spread, plates="point")
    net.add("largest", lambda z: z.max("point"))
    net.add("y", lambda largest: bmc.Normal(largest, 1.0))


@model({"point": 5})
def votes(net):
    net.add("p", bmc.Beta(1.0, 1.0))
    net.add("vote", lambda p: bmc.Bernoulli(p), plates="point")
    net.add("count", lambda vote: vote.sum("point"))
    net.add("won", lambda count: count >= 3)
    net.add("report", lambda won: bmc.Bernoulli(np.where(won, 0.99, 0.01)))


@model({"point": 5})
def labelled_votes(net):
    net.add("vote", bmc.Categorical([0.5, 0.3, 0.2]), plates="point", states=("a", "b", "none"))
    net.add("for_a", lambda vote: (vote == "a").sum("point"))
    net.add("any_none", lambda vote: (vote == "none").any("point"))
    net.add("x", lambda for_a, any_none: bmc.Normal(for_a, np.where(any_none, 2.0, 1.0)))


@model({"t": 5})
def whole_plate_cumulative(net):
    """A cumulative sum over a plate in an unplated vector node, as the contract asks."""
    net.add("step", bmc.Normal(0.0, 1.0), plates="t")
    net.add("path", lambda step: np.cumsum(step.array, axis=-1))
    net.add("y", lambda path: bmc.MvNormal(path, np.eye(5)))


@model({"t": 4, "series": 3})
def cumulative_in_another_plate(net):
    net.add("step", bmc.Normal(0.0, 1.0), plates=("t", "series"))
    net.add("path", lambda step: np.cumsum(step.array, axis=-1), plates="series")
    net.add("y", lambda path: bmc.MvNormal(path, np.eye(4)), plates="series")


@model({"t": 4})
def ornstein_uhlenbeck_covariance(net):
    lag = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
    net.add("length", bmc.Gamma(3.0, 1.0))
    net.add(
        "f",
        lambda length: bmc.MvNormal(np.zeros(4), np.exp(-lag / (length[..., None, None] + 0.5))),
    )


@model({"a": 2, "b": 3})
def crossed_effects(net):
    net.add("row", bmc.Normal(0.0, 1.0), plates="a")
    net.add("column", bmc.Normal(0.0, 1.0), plates="b")
    net.add("both", bmc.Normal(0.0, 1.0), plates=("b", "a"))
    net.add("y", lambda row, column, both: bmc.Normal(row + column + both, 1.0), plates=("a", "b"))


@model({"a": 2, "b": 3})
def marginal_of_a_plate(net):
    net.add("x", bmc.Normal(0.0, 1.0), plates=("a", "b"))
    net.add("mean_a", lambda x: x.mean("b"), plates="a")
    net.add("both", lambda x, mean_a: bmc.Normal(x - mean_a, 1.0), plates=("b", "a"))


@model({"knot": 4, "point": 6})
def interpolation(net):
    left = np.minimum(((T + 1) * 1.5).astype(int), 2)
    weight = (T + 1) * 1.5 - left
    net.add("h", bmc.Normal(0.0, 1.0), plates="knot")
    net.add(
        "y",
        lambda h: bmc.Normal((1 - weight) * h[left] + weight * h[left + 1], 0.1),
        plates="point",
    )


@model({"team": 4, "game": 5})
def bradley_terry(net):
    home, away = np.array([0, 1, 2, 3, 0]), np.array([1, 2, 3, 0, 2])
    net.add("skill", bmc.Normal(0.0, 1.0), plates="team")
    net.add(
        "won",
        lambda skill: bmc.Bernoulli(logits=skill[home] - skill[away]),
        plates="game",
        states=("away", "home"),
    )


@model({"point": 3}, {"u": np.array([0.1, 0.2, 0.3]), "level": 2.0})
def with_inputs(net):
    net.input("u", plates="point")
    net.input("level")
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("y", lambda a, u, level: bmc.Normal(a * u + level, 1.0), plates="point")


@model({"k": 3, "point": 4}, {"group": np.array([2, 0, 1, 1])})
def index_from_inputs(net):
    net.input("group", plates="point")
    net.add("m", bmc.Normal(0.0, 1.0), plates="k")
    net.add("y", lambda m, group: bmc.Normal(m[group], 1.0), plates="point")


@model()
def partial_and_methods(net):
    class Sensor:
        gain = 2.0

        def read(self, x):
            return bmc.Normal(self.gain * x, 1.0)

        def __call__(self, x):
            return bmc.Normal(-x, 1.0)

    net.add("x", bmc.Normal(0.0, 1.0))
    net.add("y", Sensor().read)
    net.add("z", Sensor())
    net.add("w", functools.partial(lambda x, s: bmc.Normal(x, s), s=2.0))
    net.add("v", bmc.Normal, parents={"loc": "x", "scale": "one"})
    net.add("one", lambda: np.array(1.0))


@model({"point": 3})
def elementwise_loop(net):
    net.add("x", bmc.Normal(0.0, 1.0), plates="point")
    net.add("w", bmc.Dirichlet(np.ones(4)))

    def y(x, w):
        return bmc.Normal(1.0, 1.0) if x > 0 else bmc.Normal(float(w[0] - w[3]), 2.0)

    net.add("y", y, plates="point", vectorize=True)


@model()
def elementwise_families(net):
    net.add("a", bmc.Bernoulli(0.5))
    net.add(
        "y", lambda a: bmc.Normal(0.0, 1.0) if a else bmc.StudentT(3.0, 0.0, 1.0), vectorize=True
    )


@model({"point": 1, "k": 1})
def plates_of_size_one(net):
    net.add("m", bmc.Normal(0.0, 1.0), plates="k")
    net.add("z", bmc.Categorical([1.0]), plates="point")
    net.add("y", lambda m, z: bmc.Normal(m[z], 1.0), plates="point")


@model({"point": 0, "k": 3})
def an_empty_plate(net):
    net.add("m", bmc.Normal(0.0, 1.0), plates="k")
    net.add("z", bmc.DiscreteUniform(0, 2), plates="point")
    net.add("y", lambda m, z: bmc.Normal(m[z], 1.0), plates="point")
    net.add("total", lambda y: y.sum("point"))


@model()
def large_and_small_scales(net):
    net.add("big", bmc.Normal(1e8, 1e3))
    net.add("small", bmc.Normal(0.0, 1e-9))
    net.add("difference", lambda big, small: (big + small) - big)
    net.add("y", lambda big, small: bmc.Normal(big * small, 1e-6))


@model({"point": 4})
def many_roots(net):
    """Roots enough to meet every batch rank the validator gives them."""
    for i in range(9):
        net.add(f"r{i}", bmc.Gamma(2.0, 1.0))
        net.add(f"c{i}", lambda r: bmc.Uniform(0.0, r), parents=[f"r{i}"], plates="point")
    net.add("all", lambda *r: sum(r), parents=[f"r{i}" for i in range(9)])


@model({"noisy": 3})
def noisy_or(net):
    weight = np.array([0.2, 0.5, 0.9])
    net.add("cause", bmc.Bernoulli(0.3), plates="noisy")
    net.add(
        "effect", lambda cause: bmc.Bernoulli(1 - 0.99 * (1 - weight * cause.array).prod(axis=-1))
    )


@model({"time": 6})
def change_point(net):
    net.add("when", bmc.DiscreteUniform(0, 5))
    net.add("early", bmc.Exponential(1.0))
    net.add("late", bmc.Exponential(1.0))
    net.add(
        "n",
        lambda when, early, late: bmc.Poisson(np.where(np.arange(6) < when, early, late)),
        plates="time",
    )


@model()
def labelled_table_with_function_child(net):
    net.add("season", bmc.Categorical([0.25, 0.25, 0.25, 0.25]), states=("sp", "su", "au", "wi"))
    warm = {"sp": 12.0, "su": 22.0, "au": 11.0, "wi": 1.0}
    net.add("t", lambda season: bmc.Normal(sum(w * (season == s) for s, w in warm.items()), 3.0))
    net.add("cold", lambda t: t < 5.0)
    net.add("coat", lambda cold: bmc.Bernoulli(0.1 + 0.8 * cold), states=("no", "yes"))


@model()
def lookup_in_a_constant_table(net):
    rate = np.array([0.5, 2.0, 8.0])
    net.add("level", bmc.Categorical([0.2, 0.3, 0.5]))
    net.add("n", lambda level: bmc.Poisson(rate[level]))
    net.add("m", lambda level: bmc.Poisson(np.take(rate, level)))


@model({"point": 4})
def mixture_distribution(net):
    net.add("w", bmc.Beta(1.0, 1.0))
    net.add("m", bmc.Normal(0.0, 1.0))

    def y(w, m):
        weights = bmc.stack([w, 1 - w])
        return bmc.Mixture(weights, bmc.Normal(bmc.stack([m, m + 3.0]), 1.0))

    net.add("y", y)
