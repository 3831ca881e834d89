"""Parameters that finite parents pick (``np.where(s, p, q)``) are drawn in closed form, and no others are.

Exact answers come from sums over all hidden states; every draw is checked against the densities of the
model (``debug=True``) as well, which is seen to refuse a wrong closed form.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import special

import bayesmc as bmc
from bayesmc.expression import elementwise
from bayesmc.kernels import conjugate_naturals
from bayesmc.testing import session

SEED = session.seed()
# few draws, of which the errors tell
pytestmark = pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")

#: the probability of state 1 after state 1 is p, and after state 0 it is q, in many words
SPELT: dict[str, Callable[..., Any]] = {
    "where": lambda s_prev, p, q: bmc.Bernoulli(np.where(s_prev == "on", p, q)),
    "choose": lambda s_prev, p, q: bmc.Bernoulli(np.choose(s_prev == "on", [q, p])),
    "sum": lambda s_prev, p, q: bmc.Bernoulli(p * (s_prev == "on") + q * (s_prev != "on")),
    "step": lambda s_prev, p, q: bmc.Bernoulli(q + (p - q) * (s_prev == "on")),
    "rest": lambda s_prev, p, q: bmc.Bernoulli(1 - np.where(s_prev == "on", 1 - p, 1 - q)),
    "states": lambda s_prev, p, q: bmc.Categorical(
        bmc.stack([np.where(s_prev == "on", 1 - p, 1 - q), np.where(s_prev == "on", p, q)], axis=-1)
    ),
}
Y = np.array([0.2, 1.1, 0.9, 1.4, -0.1, 0.3, -0.4])
NOISE = 0.6


def chain(moved: Callable[..., Any], steps: int = len(Y)) -> tuple[bmc.BayesNet, dict[str, Any]]:
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("p", bmc.Beta(2.0, 1.0))
    dbn.add_static("q", bmc.Beta(1.0, 3.0))
    first = bmc.Bernoulli(0.5) if moved is not SPELT["states"] else bmc.Categorical([0.5, 0.5])
    dbn.add("s", moved, initial=first, states=("off", "on"))
    dbn.add("y", lambda s: bmc.Normal(s == "on", NOISE))
    return dbn.unroll(steps), dbn.unrolled_evidence({"y": np.resize(Y, steps)})


def summed(weigh: Callable[[np.ndarray], tuple[float, float, float]]) -> tuple[float, float]:
    """Means of p and q over all paths; ``weigh`` gives a path's log weight, and both given the path."""
    found = []
    for path in itertools.product((0, 1), repeat=len(Y)):
        s = np.array(path)
        log, p, q = weigh(s)
        found.append((log - 0.5 * (((Y - s) / NOISE) ** 2).sum(), p, q))
    log, p, q = np.array(found).T
    weights = np.exp(log - log.max())
    return float(weights @ p / weights.sum()), float(weights @ q / weights.sum())


def counted(s: np.ndarray, everywhere: bool = False) -> tuple[float, float, float]:
    """Of Beta(2, 1) and Beta(1, 3): only the steps that leave a state tell of its share."""
    before, after = s[:-1], s[1:]
    shares, log = [], 0.0
    for state, (a, b) in ((1, (2.0, 1.0)), (0, (1.0, 3.0))):
        of = (before == state) | everywhere
        up, down = after[of].sum(), (1 - after[of]).sum()
        log += special.betaln(a + up, b + down) - special.betaln(a, b)
        shares.append((a + up) / (a + b + up + down))
    return log, shares[0], shares[1]


@pytest.mark.parametrize(
    "name",
    ["where", "choose", "states"]
    + [pytest.param(n, marks=pytest.mark.thorough) for n in ("sum", "step", "rest")],
)
def test_the_answer_is_the_exact_one(name: str) -> None:
    """Means within 4.5 errors: 12 of them, a false alarm in 12,000 runs."""
    net, evidence = chain(SPELT[name])
    posterior = bmc.infer(net, evidence, engine=bmc.Gibbs(200, 20, 10), rng=SEED)
    exact = summed(counted)
    wrong = summed(lambda s: counted(s, everywhere=True))
    for node, mean, other in zip(("p", "q"), exact, wrong, strict=True):
        error = 4.5 * posterior.mcse(node)
        assert abs(posterior.mean(node) - mean) < error
        assert abs(other - mean) > 2.0 * error  # what all steps together would say is seen


MORE: dict[str, tuple[dict[str, Any], Callable[..., Any]]] = {
    "rates": (
        {"a": bmc.Gamma(2.0, 1.0), "b": bmc.Gamma(4.0, 1.0)},
        lambda z, a, b: bmc.Poisson(np.where(z == 1, 3.0 * a, b)),
    ),
    "times": (
        {"a": bmc.Gamma(2.0, 1.0), "b": bmc.Exponential(1.0)},
        lambda z, a, b: bmc.Exponential(a * (z == 1) + b * (z == 0)),
    ),
    "levels": (
        {"a": bmc.Normal(0.0, 2.0), "b": bmc.Normal(3.0, 2.0)},
        lambda z, a, b: bmc.Normal(np.where(z == 1, a, b), 1.0),
    ),
    "deviations": (
        {"a": bmc.Uniform(0.1, 9.0), "b": bmc.Uniform(0.1, 9.0)},
        lambda z, a, b: bmc.Normal(0.0, np.where(z == 1, a, 2.0 * b)),
    ),
    "rows": (
        {"a": bmc.Dirichlet([1.0, 2.0, 3.0]), "b": bmc.Dirichlet(np.ones(3))},
        lambda z, a, b: bmc.Categorical(np.where((z == 1)[..., None], a, b)),
    ),
    "some rows": (
        {"a": bmc.Dirichlet([1.0, 2.0, 3.0]), "b": bmc.Dirichlet(np.ones(3))},
        lambda z, a, b: bmc.Categorical(
            np.where((z == 1)[..., None], a, np.array([0.2, 0.3, 0.5])) + 0.0 * b
        ),
    ),
    "a plate of shares": (
        {"a": (bmc.Beta(1.0, 2.0), "k"), "b": bmc.Beta(1.0, 1.0)},
        lambda z, a, b: bmc.Bernoulli(np.where(z == 1, 1 - a[z], np.where(z == 0, a[z], b))),
    ),
}


def mixed(priors: dict[str, Any], child: Callable[..., Any]) -> bmc.BayesNet:
    """Labels in a plate, each of which picks a parameter for its reading."""
    net = bmc.BayesNet(plates={"i": 12, "k": 3})
    for name, prior in priors.items():
        prior, plate = prior if isinstance(prior, tuple) else (prior, ())
        net.add(name, prior, plates=plate)
    plated = any(isinstance(prior, tuple) for prior in priors.values())
    net.add("z", bmc.Categorical([0.4, 0.4, 0.2] if plated else [0.5, 0.5]), plates="i")
    net.add("y", child, plates="i")
    return net


@pytest.mark.parametrize("name", MORE)
def test_every_draw_fits_the_densities(name: str) -> None:
    """``debug=True`` ends the run at a draw whose closed form the model's densities contradict."""
    net = mixed(*MORE[name])
    y = net.sample(1, rng=SEED)["y"][0]
    engine = bmc.Gibbs(60, 5, debug=True)
    text = str(bmc.explain(net, {"y": y}, engine=engine))
    assert "slice" not in text and "walk" not in text
    bmc.infer(net, {"y": y}, engine=engine, rng=SEED)


def test_a_wrong_closed_form_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if one more element read the node."""
    right = conjugate_naturals.features_of

    def wrong(*arguments: Any) -> Any:
        found = right(*arguments)
        changed = {f: elementwise(np.add, c, 1.0) for f, c in found.coefficients.items()}
        return dataclasses.replace(
            found, coefficients=changed if found.is_picked else found.coefficients
        )

    monkeypatch.setattr(conjugate_naturals, "features_of", wrong)
    net, evidence = chain(SPELT["where"])
    with pytest.raises(bmc.errors.BayesmcError, match="node '[pq]'"):
        bmc.infer(net, evidence, engine=bmc.Gibbs(60, 5, debug=True), rng=SEED)


#: what looks like a pick, and is none
OTHERS: dict[str, Callable[..., Any]] = {
    "a share of it, too": lambda s_prev, p, q: bmc.Bernoulli(
        np.where(s_prev == "on", p, 0.5 * p + 0.5 * q)
    ),
    "the larger": lambda s_prev, p, q: bmc.Bernoulli(np.where(p > q, p, q) + 0 * (s_prev == "on")),
    "squared": lambda s_prev, p, q: bmc.Bernoulli(np.where(s_prev == "on", p**2, q)),
    "a weight": lambda s_prev, p, q: bmc.Bernoulli(
        p * q + (1 - q) * np.where(s_prev == "on", p, q)
    ),
}


@pytest.mark.parametrize("name", OTHERS)
def test_no_closed_form_is_claimed_of_others(name: str) -> None:
    assert not is_conjugate("p", *chain(OTHERS[name]))


def test_a_state_that_breaks_the_form_takes_a_slice() -> None:
    """One of a hundred states, which none of those tried is, and in which the share is read in another way.

    Six readings of it leave ``(.5 + .4 p)**6`` of a Beta(1, 1). Within 4.5 errors: a false alarm in 150,000
    runs; 1/2, which is left if that state is taken for one without p, is seen.
    """
    net = bmc.BayesNet(plates={"i": 6})
    net.add("p", bmc.Beta(1.0, 1.0))
    net.add("z", bmc.Categorical(np.full(100, 0.01)))
    net.add(
        "x",
        lambda z, p: bmc.Bernoulli(np.where(z < 50, p, np.where(z == 57, 0.5 + 0.4 * p, 0.5))),
        plates="i",
    )
    net.add("w", lambda z: bmc.Normal(z, 0.05))
    evidence = {"x": np.ones(6, int), "w": 57.0}
    assert "where it is picked" in str(bmc.explain(net, evidence, engine=bmc.Gibbs()))
    posterior = bmc.infer(net, evidence, engine=bmc.Gibbs(500, 100, 10), rng=SEED)
    grid = (np.arange(4000) + 0.5) / 4000
    weights = (0.5 + 0.4 * grid) ** 6
    exact = (weights * grid).sum() / weights.sum()
    error = 4.5 * posterior.mcse("p")
    assert abs(posterior.mean("p") - exact) < error
    assert abs(0.5 - exact) > 2.0 * error


# ---- rows, which take no slice -------------------------------------------------------------------

COUNTS = np.array([12, 4, 4])


def is_conjugate(name: str, net: bmc.BayesNet, evidence: dict[str, Any]) -> bool:
    text = str(bmc.explain(net, evidence, engine=bmc.Gibbs())).splitlines()
    (line,) = (row for row in text if row.split()[:1] == [name])
    return "conjugate" in line


def rows(switches: int, breaks: bool) -> bmc.BayesNet:
    """A row that is mixed, or not read, in the one joint state of all switches on, to which they tend."""
    net = bmc.BayesNet(plates={"j": switches, "i": COUNTS.sum()})
    net.add("w", bmc.Dirichlet(np.ones(3)))
    net.add("s", bmc.Bernoulli(0.3), plates="j")
    net.add("z", lambda s: bmc.Bernoulli(np.where(s == 1, 0.99, 0.01)), plates="j")
    net.add("all_on", lambda s: s.sum("j") == switches)
    share = 0.5 if breaks else 0.0
    net.add(
        "y",
        lambda w, all_on: bmc.Categorical(
            np.where((all_on == 1)[..., None], share * w + (1 - share) / 3, w)
        ),
        plates="i",
    )
    return net


def seen(switches: int) -> dict[str, Any]:
    return {"z": np.ones(switches, int), "y": np.repeat(np.arange(3), COUNTS)}


@pytest.mark.parametrize(
    ("switches", "breaks", "claimed"), [(10, True, False), (10, False, True), (15, False, True)]
)
def test_rows_are_claimed_where_all_joint_states_pick(
    switches: int, breaks: bool, claimed: bool
) -> None:
    """One of 1024 joint states, or of 32768: none is tried, the branches are read."""
    text = str(bmc.explain(rows(switches, breaks), seen(switches), engine=bmc.Gibbs()))
    assert ("where it is picked" in text) is claimed
    assert is_conjugate("w", rows(switches, breaks), seen(switches)) is claimed


def test_a_rare_joint_state_that_mixes_a_row_is_answered_right() -> None:
    """Within 4.5 errors: a false alarm in 150,000 runs; the mean without the mix is seen."""
    posterior = bmc.infer(rows(10, True), seen(10), engine=bmc.Gibbs(600, 200, 8), rng=SEED)
    grid = (np.arange(400) + 0.5) / 400
    a, b = np.meshgrid(grid, grid, indexing="ij")
    w = np.stack([a, b, 1 - a - b])[:, a + b < 1]
    plain, mixed_in = (np.prod(r ** COUNTS[:, None], axis=0) for r in (w, 0.5 * w + 1 / 6))
    on = (0.297 / (0.297 + 0.007)) ** 10
    weights = (1 - on) * plain + on * mixed_in
    exact = weights @ w[0] / weights.sum()
    error = 4.5 * posterior.mcse("w")[0]
    assert abs(posterior.mean("w")[0] - exact) < error
    assert abs(plain @ w[0] / plain.sum() - exact) > 2.0 * error


@pytest.mark.parametrize(("mixing", "claimed"), [(0, True), (8, True), (1, False)])
def test_readers_of_two_switches_each_are_tried_in_all_states(mixing: int, claimed: bool) -> None:
    """A chain of 30 readers; the last may mix the row where both its switches are on.

    All of them together have 2**31 joint states; one by one they have four.
    """
    net = bmc.BayesNet()
    net.add("w", bmc.Dirichlet(np.ones(3)))
    for t in range(31):
        net.add(f"s[{t}]", bmc.Bernoulli(0.3))
    for t in range(30):
        wanted = mixing if t == 29 else 8
        net.add(
            f"y[{t}]",
            lambda w, a, b, wanted=wanted: bmc.Categorical(
                np.where(((a == 1) & (b == wanted))[..., None], 0.5 * w + 1 / 6, w)
                if wanted
                else np.where((a == 1)[..., None], w, np.ones(3) / 3)
            ),
            parents=["w", f"s[{t}]", f"s[{t + 1}]"],
        )
    evidence = {f"y[{t}]": t % 3 for t in range(30)}
    assert is_conjugate("w", net, evidence) is claimed


@pytest.mark.thorough
def test_default_settings_are_enough() -> None:
    """400 effective draws of every parameter within 20 s of processor time, planning included."""
    dbn = bmc.DynamicBayesNet()
    dbn.add_static("p", bmc.Beta(1.0, 1.0))
    dbn.add_static("q", bmc.Beta(1.0, 1.0))
    dbn.add_static("low", bmc.Normal(0.0, 3.0))
    dbn.add_static("more", bmc.Gamma(2.0, 1.0))
    dbn.add("s", SPELT["where"], initial=bmc.Bernoulli(0.5), states=("off", "on"))
    dbn.add("y", lambda s, low, more: bmc.Normal(low + np.where(s == "on", more, 0.0), 1.0))
    rng = np.random.default_rng(SEED)
    rows = 3.0 * (np.arange(100) // 9 % 2) + rng.standard_normal(100)
    begin = time.process_time()
    posterior = bmc.infer(dbn, {"y": rows}, rng=SEED)
    assert isinstance(posterior.engine, bmc.Gibbs)
    assert min(posterior.ess(name).min() for name in dbn.static_nodes) >= 400
    assert time.process_time() - begin < 20.0
