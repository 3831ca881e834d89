"""Hamiltonian Monte Carlo that sums finite nodes out: answers, what it says, and when it is chosen.

Answers are held against exact ones at a chance of false alarm of 1e-5 each, at fixed seeds.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from scipy.special import betaln, logsumexp

import bayesmc as bmc
from bayesmc import diagnostics
from bayesmc.errors import ConvergenceWarning
from bayesmc.testing import assert_matches, exact

SEEN = np.array([3, 1, 2, 1, 1, *[0] * 25])
OCCASIONS = 4


def logistic(x: Any) -> Any:
    return 1 / (1 + np.exp(-x))


def animals(seen: np.ndarray = SEEN, each: bool = False) -> bmc.BayesNet:
    """Animals that may not be there, beside those that were caught, by a share without a closed form."""
    net = bmc.BayesNet(plates={"animal": len(seen)})
    net.add("share", bmc.Uniform(0.0, 1.0))
    net.add("there", lambda share: bmc.Bernoulli(share), plates="animal")
    net.add("ease", bmc.Normal(-1.0, 1.0))
    if each:
        net.add("sd", bmc.Uniform(0.0, 3.0))
        net.add("own", bmc.Normal(0.0, 1.0), plates="animal")
        net.add(
            "seen",
            lambda there, ease, sd, own: bmc.Binomial(
                OCCASIONS, np.where(there == 1, logistic(ease + sd * own), 0.0)
            ),
            plates="animal",
        )
    else:
        net.add(
            "seen",
            lambda there, ease: bmc.Binomial(OCCASIONS, np.where(there == 1, logistic(ease), 0.0)),
            plates="animal",
        )
    net.add("count", lambda there: there.sum("animal"))
    return net


def exact_count(seen: np.ndarray = SEEN) -> np.ndarray:
    """Probabilities of 0, 1, ... animals: the share in closed form, the ease by quadrature."""
    caught, total = int((seen > 0).sum()), len(seen)
    x = np.linspace(-9.0, 7.0, 4001)
    count = np.arange(caught, total + 1)[:, None]
    p = logistic(x)
    log = -0.5 * (x + 1.0) ** 2 + seen.sum() * np.log(p)
    log = log + (OCCASIONS * count - seen.sum()) * np.log1p(-p)
    log = logsumexp(log, axis=1)
    unseen, free = count[:, 0] - caught, total - caught
    ways = -betaln(unseen + 1, free - unseen + 1) - np.log(free + 1)
    log = log + ways + betaln(count[:, 0] + 1, total - count[:, 0] + 1)
    found = np.zeros(total + 1)
    found[caught:] = np.exp(log - logsumexp(log))
    return found


def infer(net: bmc.BayesNet, evidence: Any, **options: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("error", ConvergenceWarning)
        return bmc.infer(net, evidence, rng=0, **options)


# ---- answers -------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", [None, bmc.HamiltonianMonteCarlo(marginalize=True)])
def test_how_many_there_are(engine: Any) -> None:
    """Mean and variance of the number of animals at 4.4 standard errors: 1e-5 each."""
    posterior = infer(animals(), {"seen": SEEN}, engine=engine)
    truth, k = exact_count(), np.arange(len(SEEN) + 1)
    mean = truth @ k
    assert abs(posterior.mean("count") - mean) < 4.4 * posterior.mcse("count")
    draws = np.square(posterior["count"] - mean)
    error = draws.std() / np.sqrt(float(diagnostics.chain_statistic("ess", draws)))
    assert abs(draws.mean() - truth @ (k - mean) ** 2) < 4.4 * error


def mixed(seed: int) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Labels of a plate, some of them known, a second plate of labels beside them, and one node for all."""
    r = np.random.default_rng(seed)
    net = bmc.BayesNet(plates={"i": 3})
    net.add("all", bmc.Bernoulli(0.3))
    net.add("kind", bmc.Categorical(r.dirichlet(np.ones(3))), plates="i")
    net.add("bad", lambda all: bmc.Bernoulli(0.2 + 0.4 * all), plates="i")
    net.add("x", bmc.Laplace(0.0, 1.0))
    shift, width = r.normal(size=3), r.uniform(0.5, 2.0, 2)
    net.add("y", lambda x, kind, bad: bmc.StudentT(5.0, x + shift[kind], width[bad]), plates="i")
    known = np.ma.masked_array([2, 0, 0], [False, True, True]) if seed % 2 else None
    evidence: dict[str, Any] = {"y": r.normal(size=3)}
    return net, evidence if known is None else {**evidence, "kind": known}


@pytest.mark.parametrize("seed", range(2))
def test_labels_of_several_kinds(seed: int) -> None:
    net, evidence = mixed(seed)
    engine = bmc.HamiltonianMonteCarlo(200, chains=32, warmup=200, marginalize=True)
    table = {row.node: row.kernel for row in bmc.explain(net, evidence, engine=engine).table}
    assert [table[n] for n in ("all", "kind", "bad", "x")] == 3 * ["summed out"] + ["Hamiltonian"]
    posterior = infer(net, evidence, engine=engine)
    assert_matches(posterior, exact(net, evidence), alpha=1e-5)


def test_what_cannot_be_summed_out_is_drawn_in_turn() -> None:
    """Labels that hang together, too many for a list, beside some that do not."""
    net = bmc.BayesNet(plates={"i": 10, "j": 2})
    net.add("x", bmc.Laplace(0.0, 1.0))
    net.add("tied", bmc.Bernoulli(0.5), plates="i")
    net.add("total", lambda tied, x: bmc.Normal(tied.sum("i") + x, 3.0))
    net.add("loose", bmc.Bernoulli(0.5), plates="j")
    net.add("y", lambda x, loose: bmc.Normal(x + loose, 1.0), plates="j")
    evidence = {"total": 3.0, "y": [0.5, 1.0]}
    options: dict[str, Any] = {"draws": 200, "warmup": 200, "chains": 32}
    engine = bmc.HamiltonianMonteCarlo(**options, marginalize=True)
    table = {row.node: row.kernel for row in bmc.explain(net, evidence, engine=engine).table}
    assert table["loose"] == "summed out"
    assert "summed out" not in table["tied"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # what is tied holds x
        one = bmc.infer(net, evidence, engine=engine, rng=0)
        other = bmc.infer(net, evidence, engine=bmc.HamiltonianMonteCarlo(**options), rng=0)
    for name in ("x", "tied", "loose"):
        error = np.hypot(one.mcse(name), other.mcse(name))
        assert np.abs((one.mean(name) - other.mean(name)) / error).max() < 4.9  # 13 of them: 2e-5


def test_a_run_goes_on_as_it_would_have() -> None:
    engine = bmc.HamiltonianMonteCarlo(40, warmup=50, chains=2, marginalize=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        first = bmc.infer(animals(), {"seen": SEEN}, engine=engine, rng=3)
        more = bmc.infer(animals(), {"seen": SEEN}, engine=engine, rng=3, resume=first)
        whole = bmc.HamiltonianMonteCarlo(80, warmup=50, chains=2, marginalize=True)
        at_once = bmc.infer(animals(), {"seen": SEEN}, engine=whole, rng=3)
    for name in ("share", "there"):
        assert np.array_equal(more[name], at_once[name])


def test_options() -> None:
    with pytest.raises(ValueError, match="marginalize is True or False"):
        bmc.HamiltonianMonteCarlo(marginalize="auto")  # type: ignore[arg-type]


# ---- the choice ----------------------------------------------------------------------------------


def test_labels_that_cling_are_summed_out_unasked() -> None:
    """In turn with them, numbers without a closed form move only as far as labels let them."""
    pytest.importorskip("llvmlite", reason="llvmlite is not installed")
    told = bmc.explain(animals(each=True), {"seen": SEEN})
    assert isinstance(told.engine, bmc.HamiltonianMonteCarlo)
    assert told.engine.marginalize
    assert told.reasons[0].startswith("'there' is summed out, element by element")
    assert "enumerate (1)" in told.refused["Gibbs"]


def test_closed_forms_are_swept_over() -> None:
    net = bmc.BayesNet(plates={"animal": len(SEEN)})
    net.add("share", bmc.Uniform(0.0, 1.0))
    net.add("there", lambda share: bmc.Bernoulli(share), plates="animal")
    net.add("p", bmc.Uniform(0.0, 1.0))
    net.add(
        "seen",
        lambda there, p: bmc.Binomial(OCCASIONS, np.where(there == 1, p, 0.0)),
        plates="animal",
    )
    assert isinstance(bmc.explain(net, {"seen": SEEN}).engine, bmc.Gibbs)
