"""The loop of chains: what is kept, going on bit for bit, interruption, errors and warnings.

A small sampler of autoregressive chains stands in for the engines, so that every number is known.
"""

from __future__ import annotations

import functools
import math
import os
import pickle
import signal
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from arviz_stats.base import array_stats

import bayesmc as bmc
from bayesmc import diagnostics
from bayesmc.distributions.circular import wrap_angle
from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.engines.mcmc.convergence import poor_acceptance, poor_mixing
from bayesmc.errors import ConvergenceWarning, DensityError, InterruptWarning, UnsupportedError
from bayesmc.network import Problem, pose
from bayesmc.randomness import Purpose, seed_sequence, stream
from bayesmc.results import ChainsPosterior
from bayesmc.robotics import AndAngle

KEEPS = ["draws", ["x", "s"], "summaries"]


def net_of(shift: float = 0.0) -> bmc.BayesNet:
    net = bmc.BayesNet(plates={"p": 3})
    net.add("x", bmc.Normal(shift, 1.0), plates="p")
    net.add("s", bmc.Bernoulli(0.3), states=("no", "yes"))
    net.add("n", bmc.DiscreteUniform(1, 3))
    net.add("angle", bmc.VonMises(0.5, 4.0))
    net.add("double", lambda x: 2.0 * x, plates="p")
    net.add("nine", lambda n: 9.0)
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="p")
    return net


DATA = {"y": [0.5, -0.5, 1.5]}


class Walker:
    """x is AR(1) with coefficient ``phi``, s and n are drawn afresh, angle too, outside the chain."""

    forward_nodes = frozenset({"angle"})

    def __init__(self, engine: Autoregression) -> None:
        self.engine = engine
        if engine.ensemble > 1:
            self.ensemble = engine.ensemble

    def start(self, rng: np.random.Generator, chains: int) -> dict[str, Any]:
        shape = (chains, self.engine.ensemble, 3)
        x = rng.normal(size=shape) + self.engine.apart * np.arange(chains)[:, None, None]
        return {"x": x, "n": np.zeros(chains, int), "sweeps": 0, "turn": 0, "s": np.zeros(chains)}

    def step(self, state: Mapping[str, Any], rng: np.random.Generator, warmup: bool) -> Any:
        engine, sweeps = self.engine, state["sweeps"] + 1
        if engine.at_sweep is not None:
            engine.at_sweep(sweeps, warmup)
        centre = engine.apart * np.arange(len(state["x"]))[:, None, None]
        noise = rng.normal(size=state["x"].shape) * np.sqrt(1 - engine.phi**2)
        x = centre + engine.phi * (state["x"] - centre) + noise
        if engine.in_place:
            state["x"][...] = x
            x = state["x"]
        chains = len(x)
        n = rng.integers(3, size=chains) if not engine.stuck else np.arange(chains) % 3
        s = rng.random(chains) < (0.3 if engine.stuck is None else 0.0)
        return {"x": x, "n": n, "s": s, "sweeps": sweeps, "turn": state["turn"]}

    def end_warmup(self, state: Mapping[str, Any]) -> dict[str, Any]:
        return {**state, "sweeps": 0}

    def values(self, state: Any, rng: np.random.Generator) -> dict[str, np.ndarray]:
        chosen = state["x"][:, state["sweeps"] % self.engine.ensemble].copy()
        angle = rng.vonmises(0.5, 4.0, size=len(chosen))
        found = {"x": chosen, "s": state["s"], "n": state["n"], "angle": angle}
        return {**found, "double": 2 * chosen, "nine": np.array(0)}  # a position

    def acceptance(self, state: Mapping[str, Any]) -> dict[str, np.ndarray]:
        return {"x": np.full(len(state["x"]), self.engine.rate) + state["sweeps"] * 1e-9}


@dataclass(frozen=True)
class Autoregression(ChainEngine):
    draws: int = 1000
    warmup: int = 10
    chains: int = 4
    thinning: int = 1
    phi: float = 0.5
    apart: float = 0.0
    stuck: bool | None = None
    ensemble: int = 1
    rate: float = 0.4
    in_place: bool = False
    at_sweep: Callable[[int, bool], None] | None = field(default=None, compare=False)

    label = "autoregression"

    def refusal(self, problem: Problem) -> None:
        return None

    def describe(self, problem: Problem) -> dict[str, str]:
        return {}

    def sampler(self, problem: Problem) -> Walker:
        return Walker(self)


def quiet(**options: Any) -> bmc.Posterior:
    """An answer whose warnings are not of interest."""
    rest: dict[str, Any] = {k: options.pop(k) for k in ("keep", "resume") if k in options}
    net = options.pop("net", NET)
    evidence = options.pop("evidence", DATA)
    seed = options.pop("rng", 7)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return bmc.infer(net, evidence, engine=Autoregression(**options), rng=seed, **rest)


NET = net_of()


# ---- what is kept --------------------------------------------------------------------------------


def test_draws_are_the_samplers_own() -> None:
    engine = Autoregression(draws=20, warmup=5, chains=2, thinning=3)
    posterior = quiet(draws=20, warmup=5, chains=2, thinning=3)
    walker, rng = Walker(engine), stream(seed_sequence(7), Purpose.INFER)
    state = walker.start(rng, 2)
    for _ in range(5):
        state = walker.step(state, rng, True)
    state = walker.end_warmup(state)
    for draw in range(20):
        for _ in range(3):
            state = walker.step(state, rng, False)
        values = walker.values(state, rng)
        for name in ("x", "angle", "double"):
            np.testing.assert_array_equal(posterior[name][:, draw], values[name])
        np.testing.assert_array_equal(posterior["n"][:, draw], values["n"] + 1)
    assert posterior.warmup == 5 and posterior.ensemble_size == 1
    np.testing.assert_allclose(posterior.acceptance["x"], [0.4, 0.4], atol=1e-6)
    assert str(posterior.summary(["x"])).startswith(
        "Autoregression: 2 chains of 20 draws after 5 of warmup\n"
    )


def test_kept_in_the_stored_types() -> None:
    posterior = quiet(draws=20)
    assert posterior._stored["s"].dtype == np.uint8 and posterior._stored["n"].dtype == np.uint8
    assert posterior._stored["x"].shape == (4, 20, 3)
    assert posterior._stored["nine"].shape == (1, 1)
    assert posterior._stored["y"].shape == (1, 1, 3)  # observed, and not among the sampler's values
    assert posterior["nine"].tolist() == [[9.0] * 20] * 4
    assert all(not a.flags.writeable for a in posterior._stored.values())


def test_only_what_is_asked_for_is_kept() -> None:
    posterior = quiet(draws=20, keep=["s", "x"])
    assert posterior.names == ("x", "s")
    np.testing.assert_array_equal(posterior["x"], quiet(draws=20)["x"])


def test_sums_of_the_same_draws() -> None:
    draws, sums = quiet(draws=777, phi=0.9), quiet(draws=777, phi=0.9, keep="summaries")
    for name in ("x", "double", "n", "angle", "nine"):
        np.testing.assert_allclose(sums.mean(name), draws.mean(name), rtol=1e-9)
        np.testing.assert_allclose(sums.var(name), draws.var(name), rtol=1e-9)
    np.testing.assert_allclose(sums.probabilities("s"), draws.probabilities("s"), rtol=1e-9)
    for name in ("x", "s", "n", "angle"):  # 24 batches of 32: a fifth either way would be rare
        np.testing.assert_allclose(sums.mcse(name), draws.mcse(name), rtol=0.35)
    assert (sums.rhat("x") < 1.1).all() and (sums.rhat("x") > 0.99).all()
    assert sums.mcse("nine") == 0.0 and np.isnan(sums.rhat("nine"))
    assert str(sums.summary()).startswith("Autoregression: 4 chains of 777 draws")


def test_same_seed_same_draws() -> None:
    np.testing.assert_array_equal(quiet(draws=9)["x"], quiet(draws=9)["x"])
    assert (quiet(draws=9)["x"] != quiet(draws=9, rng=8)["x"]).any()


@pytest.mark.parametrize(
    "options",
    [{"draws": 0}, {"warmup": -1}, {"warmup": 2.0}, {"warmup": True}, {"chains": 0}, {"thinning": 0}],
)  # fmt: skip
def test_options_are_checked(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=rf"Autoregression\({next(iter(options))}="):
        Autoregression(**options)
    assert Autoregression(warmup=0).warmup == 0


def test_what_does_not_fit_in_memory_is_said() -> None:
    with pytest.raises(bmc.errors.BudgetError, match='keep="summaries"'):
        quiet(draws=10**15, warmup=0)


# ---- going on ------------------------------------------------------------------------------------


def same(a: bmc.Posterior, b: bmc.Posterior) -> None:
    assert type(a) is type(b) and a.names == b.names and a._title() == b._title()
    assert a.acceptance.keys() == b.acceptance.keys()
    for key, rates in a.acceptance.items():
        np.testing.assert_array_equal(rates, b.acceptance[key])
    if isinstance(a, ChainsPosterior):
        for name in a.names:
            assert a._stored[name].dtype == b._stored[name].dtype
            np.testing.assert_array_equal(a._stored[name], b._stored[name])
        return
    for name in a.names:
        for figure in ("mcse", "ess", "rhat"):
            np.testing.assert_array_equal(getattr(a, figure)(name), getattr(b, figure)(name))
    np.testing.assert_array_equal(a.probabilities("s"), b.probabilities("s"))
    for name in ("x", "n", "angle", "double", "nine", "y"):
        np.testing.assert_array_equal(a.mean(name), b.mean(name))
        np.testing.assert_array_equal(a.var(name), b.var(name))


@functools.cache
def unbroken(draws: int, keep: str, **options: Any) -> bmc.Posterior:
    """Chains that were never stopped; what to keep by its text, as lists have no hash."""
    (kept,) = (k for k in KEEPS if str(k) == keep)
    return quiet(draws=draws, keep=kept, **options)


@pytest.mark.parametrize("keep", KEEPS, ids=["draws", "list", "summaries"])
@pytest.mark.parametrize("cut", [130, 64])
@pytest.mark.parametrize("pickled", [False, True], ids=["live", "pickled"])
@pytest.mark.parametrize("options", [{}, {"in_place": True, "thinning": 2}, {"ensemble": 5}])
def test_going_on_is_as_if_never_stopped(
    keep: Any, cut: int, pickled: bool, options: dict[str, Any]
) -> None:
    whole = unbroken(200, str(keep), **options)
    first = quiet(draws=cut, keep=keep, **options)
    if pickled:
        first = pickle.loads(pickle.dumps(first))
    for _ in range(2):  # the first part is not used up
        both = quiet(draws=200 - cut, keep=keep, resume=first, rng=99, **options)
        same(whole, both)
    third = quiet(draws=50, keep=keep, resume=both, **options)
    same(third, unbroken(250, str(keep), **options))


def test_one_draw_of_one_chain_goes_on() -> None:
    first = quiet(draws=1, chains=1)
    same(quiet(draws=4, chains=1), quiet(draws=3, chains=1, resume=first))


@pytest.mark.parametrize("pickled", [False, True], ids=["live", "pickled"])
@pytest.mark.parametrize(
    "other",
    [
        {"evidence": {"y": [0.5, -0.5, 1.0]}},
        {"evidence": {"y": np.ma.array([0.5, -0.5, 1.5], mask=[0, 0, 1])}},
        {"evidence": {}},
        {"net": net_of(0.1)},
        {"phi": 0.6},
        {"chains": 3},
        {"thinning": 2},
        {"keep": ["x"]},
        {"keep": "summaries"},
    ],
    ids=["value", "mask", "nothing", "net", "option", "chains", "thinning", "nodes", "summaries"],
)
def test_another_question_does_not_go_on(pickled: bool, other: dict[str, Any]) -> None:
    first = quiet(draws=20)
    if pickled:
        first = pickle.loads(pickle.dumps(first))
    with pytest.raises(UnsupportedError, match="resume= takes an earlier Autoregression"):
        quiet(draws=20, resume=first, **other)


def test_other_posteriors_do_not_go_on() -> None:
    weighted = bmc.infer(NET, DATA, engine=bmc.LikelihoodWeighting(2000), rng=0)
    predicted = quiet(draws=20).predict("y", rng=0)
    for old in (weighted, predicted):
        with pytest.raises(UnsupportedError, match="resume="):
            quiet(draws=20, resume=old)


def test_a_pickle_needs_the_same_functions() -> None:
    """Functions are lost in pickles; a net declared anew is recognised by its densities."""
    loaded = pickle.loads(pickle.dumps(quiet(draws=20)))
    same(quiet(draws=30), quiet(draws=10, resume=loaded, net=net_of()))
    with pytest.raises(UnsupportedError, match="resume="):
        quiet(draws=10, resume=loaded, net=net_of(0.1))


def test_a_net_declared_anew_goes_on() -> None:
    """The same lines make other functions, which are the same; what differs is named."""
    live = quiet(draws=20)
    same(quiet(draws=30), quiet(draws=10, resume=live, net=net_of()))
    with pytest.raises(UnsupportedError, match="resume=.*; 'x' has another density"):
        quiet(draws=10, resume=live, net=net_of(0.1))
    other = {
        "the function of node 'y' is another": lambda n: n.add(
            "y", lambda x: bmc.Normal(x, 1.5), plates="p", replace=True
        ),
        "node 'n' has another states": lambda n: n.add(
            "n", bmc.DiscreteUniform(1, 4), replace=True
        ),
        "node 'nine' has other parents": lambda n: n.add("nine", lambda angle: 9.0, replace=True),
    }
    for words, change in other.items():
        net = net_of()
        change(net)
        with pytest.raises(UnsupportedError, match=f"resume=.*; {words}"):
            quiet(draws=10, resume=live, net=net)


# ---- interruption --------------------------------------------------------------------------------


def raising(at: int, error: Callable[[], BaseException]) -> Callable[[int, bool], None]:
    def hook(sweep: int, warmup: bool) -> None:
        if sweep == at and not warmup:
            raise error()

    return hook


@pytest.mark.parametrize("keep", KEEPS, ids=["draws", "list", "summaries"])
@pytest.mark.parametrize("sweep", [61, 62])
def test_an_interrupt_in_a_sweep_returns_whole_draws(keep: Any, sweep: int) -> None:
    options: dict[str, Any] = {"keep": keep, "thinning": 2}
    with pytest.warns(
        InterruptWarning, match="has the 30 draws of each of 4 chains .* resume=post"
    ):
        cut = quiet(draws=100, at_sweep=raising(sweep, KeyboardInterrupt), **options)
    same(cut, quiet(draws=30, **options))
    same(quiet(draws=100, **options), quiet(draws=70, resume=cut, **options))


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Python's own handler, which processes started in the background lack."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_waits_for_the_end_of_a_draw() -> None:
    """A sampler that writes into its own state is interrupted between sweeps, and goes on bit for bit."""

    def press(sweep: int, warmup: bool) -> None:
        if sweep == 41 and not warmup:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)  # were it not put off, it would be raised here

    handler = signal.getsignal(signal.SIGINT)
    options: dict[str, Any] = {"in_place": True, "thinning": 2}
    with pytest.warns(InterruptWarning, match="has the 21 draws"):
        cut = quiet(draws=100, at_sweep=press, **options)
    assert signal.getsignal(signal.SIGINT) is handler
    same(quiet(draws=100, **options), quiet(draws=79, resume=cut, **options))


@pytest.mark.usefixtures("ctrl_c")
def test_a_second_ctrl_c_does_not_wait() -> None:
    passed = []

    def press_twice(sweep: int, warmup: bool) -> None:
        if sweep == 41 and not warmup:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
            passed.append(sweep)

    with pytest.warns(InterruptWarning, match="has the 40 draws"):
        quiet(draws=100, at_sweep=press_twice)
    assert not passed


def test_interrupted_before_any_draw_there_is_nothing() -> None:
    def in_warmup(sweep: int, warmup: bool) -> None:
        if sweep == 4 and warmup:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        quiet(at_sweep=in_warmup)
    with pytest.raises(KeyboardInterrupt):
        quiet(at_sweep=raising(1, KeyboardInterrupt))


@pytest.mark.parametrize("keep", KEEPS, ids=["draws", "list", "summaries"])
def test_interrupted_at_once_while_going_on_the_earlier_draws_return(keep: Any) -> None:
    first = quiet(draws=30, keep=keep)
    with pytest.warns(InterruptWarning, match="has the 30 draws"):
        again = quiet(draws=9, keep=keep, resume=first, at_sweep=raising(31, KeyboardInterrupt))
    same(first, again)
    same(quiet(draws=39, keep=keep), quiet(draws=9, keep=keep, resume=again))


# ---- errors --------------------------------------------------------------------------------------


def test_an_error_says_when() -> None:
    def fails(sweep: int, warmup: bool) -> None:
        if sweep == (4 if during else 17) and warmup == during:
            raise DensityError("node 'x': the log density is nan at x = 3")

    during = True
    with pytest.raises(DensityError, match=r"nan at x = 3, at iteration 4 \(warmup\)$"):
        quiet(at_sweep=fails)
    during = False
    with pytest.raises(DensityError, match=r"nan at x = 3, at iteration 17$"):
        quiet(at_sweep=fails)
    first = quiet(draws=10)
    with pytest.raises(DensityError, match="at iteration 17$"):
        quiet(at_sweep=fails, resume=first)


# ---- warnings ------------------------------------------------------------------------------------


def warned(keep: str = "draws", **options: Any) -> list[str]:
    engine = Autoregression(**options)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        bmc.infer(NET, DATA, engine=engine, rng=3, keep=keep)
    assert all(w.category is ConvergenceWarning and w.filename == __file__ for w in caught)
    return [str(w.message) for w in caught]


def test_good_chains_are_not_warned_of() -> None:
    assert warned() == []
    assert warned(chains=1, draws=2000) == []
    assert warned(ensemble=5, draws=2000) == []


def test_chains_apart_are() -> None:
    mixed, *rest = warned(apart=1.0)
    assert "have not mixed: R-hat of 'x[" in mixed and "resume=" in mixed and "warmup=" in mixed
    # x and double, in three elements each; n and s are looked at, but not worth judging
    assert "and so are 5 more of the 6 that look worst of 8" in mixed
    assert all("R-hat" not in message for message in rest)


def test_slow_chains_are() -> None:
    messages = warned(phi=0.99)
    assert any("independent ones (bulk ESS, under 100 per chain" in m for m in messages)
    assert warned(phi=0.9, draws=4000) == []


def test_too_few_draws_to_tell() -> None:
    (message,) = warned(draws=3)
    assert "3 draws per chain are too few to tell" in message


def test_summaries_are_judged_too() -> None:
    assert warned("summaries", draws=4000) == []
    assert "have not mixed: R-hat of 'x[" in warned("summaries", draws=4000, apart=1.0)[0]
    assert any("bulk ESS" in m for m in warned("summaries", phi=0.99))
    assert "20 draws per chain are too few to tell" in warned("summaries", draws=20)[0]


def test_states_never_left_are_no_fault_unless_they_differ() -> None:
    assert warned(stuck=False) == []  # s is "no" in all chains, always
    first, *_ = warned(stuck=True)  # n stands at 1, 2, 3, 1
    assert "R-hat of 'n' is inf (every chain stands still, at different values)" in first


@pytest.mark.parametrize("keep", ["draws", "summaries"])
def test_numbers_that_never_move_are_told_of(keep: str) -> None:
    """Sizes and errors of a constant mean nothing: here steps that are nothing beside the number."""
    net = bmc.BayesNet(plates={"p": 2})
    net.add("x", bmc.Normal([0.0, 1e17], 1.0), plates="p")
    net.add("y", lambda x: bmc.StudentT(3.0, x, 1e9), plates="p")
    walk = bmc.MetropolisHastings(50, chains=2, proposal={"x": bmc.RandomWalk(1.0)})
    with pytest.warns(ConvergenceWarning) as told:
        bmc.infer(net, {"y": [0.0, 1e17]}, engine=walk, rng=1, keep=keep)
    assert any("1 of 2 elements of 'x' never moved, in any chain" in str(w.message) for w in told)


def test_an_effective_size_is_asked_for_instead_of_draws() -> None:
    for options, words in (
        ({"draws": 10, "ess": 50}, r"Gibbs\(draws=10, ess=50\): give one of both"),
        ({"ess": math.inf}, "give an effective size"),
        ({"ess": math.nan}, "give an effective size"),
    ):
        with pytest.raises(ValueError, match=words):
            bmc.Gibbs(**options)


def test_an_ensembles_members_do_not_pass_for_independent_draws() -> None:
    """Members that hardly move look independent draw by draw; blocks of them tell."""
    assert any("ESS, under 100 per chain" in m for m in warned(ensemble=10, phi=0.999, draws=2000))
    slow = quiet(ensemble=10, phi=0.999, draws=2000)
    naive = diagnostics.chain_statistic("ess", slow["x"])
    assert (slow.ess("x") < 0.2 * naive).all()


def test_nodes_outside_the_chain_are_not_looked_at() -> None:
    assert all("angle" not in m for m in warned(apart=2.0, phi=0.99))


def test_acceptance_outside_the_band() -> None:
    (low,) = warned(rate=0.04)
    assert low.startswith(
        "Autoregression: 'x' accepts 4 % of its proposals, under 10 %; use narrower"
    )
    (high,) = warned(rate=0.97)
    assert "'x' accepts 97 % of its proposals, over 90 %" in high and "use wider" in high
    rates = {"a": np.array([0.95, 1.0]), "b": np.array([0.95, 1.0])}
    assert len(list(poor_acceptance(rates, (0.1, 0.9)))) == 2
    (only,) = poor_acceptance(rates, {"a": None, "b": (0.2, 0.6)})
    assert "'b'" in only


def posterior_of(x: np.ndarray, ensemble: int = 1) -> ChainsPosterior:
    """Draws ``(chain, draw, p)`` of one node."""
    net = bmc.BayesNet(plates={"p": x.shape[2]})
    net.add("x", bmc.Normal(0.0, 1.0), plates="p")
    return ChainsPosterior(
        pose(net, {}), Autoregression(), {"x": x}, x.shape[:2], ensemble_size=ensemble
    )


def slow(rng: np.random.Generator, phi: float) -> np.ndarray:
    noise = rng.normal(size=(4, 1000)) * np.sqrt(1 - phi**2)
    x = noise / np.sqrt(1 - phi**2)
    for draw in range(1, 1000):
        x[:, draw] = phi * x[:, draw - 1] + noise[:, draw]
    return x


LAST = np.array([0.0, 0.0, 0.0, 1.0])[:, None]
#: what is wrong with one scalar, made of others that are not -> what the warning says
FAULTS: dict[str, tuple[Callable[[np.random.Generator, np.ndarray], np.ndarray], str]] = {
    "a chain apart": (lambda rng, x: x + 0.6 * LAST, "R-hat"),
    "a wide chain": (lambda rng, x: x * (1 + LAST), "R-hat"),
    "a chain apart of heavy tails": (lambda rng, x: x / rng.normal(size=x.shape) + LAST, "R-hat"),
    "a rare state of one chain": (lambda rng, x: (x < -2.0 + LAST).astype(float), "R-hat"),
    "a drift": (lambda rng, x: x + np.linspace(0, 1, 1000), "R-hat"),
    "stuck chains": (lambda rng, x: np.arange(4.0)[:, None] + 0 * x, "R-hat"),
    "a slow one": (lambda rng, x: slow(rng, 0.98), "bulk ESS"),
    "slow tails": (lambda rng, x: x * np.exp(1.5 * slow(rng, 0.99)), "tail ESS"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_the_one_bad_scalar_of_many_is_found(fault: str) -> None:
    """Among 150 that are sound; the figure in the warning is ArviZ's."""
    rng = np.random.default_rng(list(FAULTS).index(fault))
    x = rng.normal(size=(4, 1000, 150))
    x[..., ::3] = np.round(x[..., ::3])
    x[..., 1::3] /= rng.normal(size=(4, 1000, 50))
    assert poor_mixing(posterior_of(x), frozenset()) == []  # negative control
    change, word = FAULTS[fault]
    x[..., 77] = change(rng, rng.normal(size=(4, 1000)))
    (message,) = (m for m in poor_mixing(posterior_of(x), frozenset()) if word in m)
    assert "'x[77]'" in message
    with np.errstate(all="ignore"):
        if word == "R-hat":
            figure = float(array_stats.rhat(x[..., 77], chain_axis=0, draw_axis=1))
            expected = f"R-hat of 'x[77]' is {figure if figure < 1e8 else np.inf:.3f} "
        else:
            options: dict[str, Any] = {"method": "tail", "prob": 0.05} if "tail" in word else {}
            figure = float(array_stats.ess(x[..., 77], chain_axis=0, draw_axis=1, **options))
            expected = f"worth {figure:.0f} independent ones ({word}"
    assert expected in message


HEADINGS = {
    "sound": (lambda rng, x: x, False),
    "a slow one": (lambda rng, x: slow(rng, 0.9), True),
    "a chain apart": (lambda rng, x: x + 0.6 * LAST, True),
}


@pytest.mark.parametrize("case", HEADINGS)
@pytest.mark.parametrize("turn", [1.0, np.pi - 0.3, -np.pi])
def test_headings_are_judged_alike_wherever_they_point(case: str, turn: float) -> None:
    """A cut through draws of an angle would make slow chains look fast: signs forget sooner than numbers."""
    change, bad = HEADINGS[case]
    rng = np.random.default_rng(3)
    here = 0.3 * change(rng, rng.normal(size=(4, 1000)))

    def judged(heading: np.ndarray, last: bmc.Distribution) -> list[str]:
        net = bmc.BayesNet(plates={"p": 1})
        net.add("x", last if last.event_shape else bmc.Normal(0.0, 1.0), plates="p")
        x = np.stack([rng.normal(size=heading.shape), heading], axis=-1)[:, :, None]
        drawn = {"x": x if last.event_shape else x[..., 1]}
        posterior = ChainsPosterior(pose(net, {}), Autoregression(), drawn, heading.shape)
        return [m.replace("x[0, 1]", "x[0]") for m in poor_mixing(posterior, frozenset())]

    there = wrap_angle(here + turn)
    of_pose = AndAngle(bmc.Normal(0.0, 1.0), bmc.VonMises(0.0, 1.0))
    on_the_line = judged(here, bmc.Normal(0.0, 1.0))
    assert bool(on_the_line) == bad
    assert judged(there, of_pose) == on_the_line
    if case == "a slow one" and turn > 2:  # negative control: what numbers of the line hide
        assert "independent ones" in on_the_line[-1]
        assert not any("independent ones" in m for m in judged(there, bmc.Normal(0.0, 1.0)))


def test_members_apart_do_not_hide_an_ensemble_apart() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(4, 1000, 40)) + 5.0 * np.tile(np.arange(5.0), 200)[:, None]
    assert poor_mixing(posterior_of(x, 5), frozenset()) == []
    x[3, :, 17] += 8.0  # a standard deviation of the draws
    message, *_ = poor_mixing(posterior_of(x, 5), frozenset())
    assert "R-hat of 'x[17]'" in message


def test_odd_scalars_are_screened_without_ado() -> None:
    """Infinite draws, a scalar that moves in the last partial batch only, one of tiny values."""
    x = np.random.default_rng(0).normal(size=(4, 1007, 4))
    x[2, 5, 0] = np.inf
    x[..., 1] = 0.0
    x[0, -1, 1] = 1.0
    x[..., 2] *= 1e-200
    assert poor_mixing(posterior_of(x), frozenset()) == []
    message, *_ = poor_mixing(posterior_of(x + 0.6 * LAST[..., None]), frozenset())
    assert "R-hat of 'x[" in message


@pytest.mark.parametrize(("draws", "ensemble"), [(1, 1), (3, 1), (19, 5), (3, 5)])
def test_too_few_blocks_to_tell(draws: int, ensemble: int) -> None:
    x = np.random.default_rng(0).normal(size=(4, draws, 9))
    (message,) = poor_mixing(posterior_of(x, ensemble), frozenset())
    assert f"{draws} draws per chain are too few to tell" in message


@pytest.mark.parametrize(
    ("chains", "draws", "size"), [(4, 1000, 1000), (256, 1000, 30), (2, 200_000, 8)]
)
def test_the_check_is_cheap(chains: int, draws: int, size: int) -> None:
    """Many scalars, many chains, long ones: 0.1 to 0.25 s of the processor, ArviZ's import apart."""
    x = np.random.default_rng(0).normal(size=(chains, draws, 1))
    posterior = posterior_of(np.broadcast_to(x, (chains, draws, size)))
    start = time.process_time()
    assert poor_mixing(posterior, frozenset()) == []
    assert time.process_time() - start < 1.0


def test_flags_that_are_computed_are_judged_too() -> None:
    """Truth values of a deterministic node are numbers to the screen of convergence."""
    net = bmc.BayesNet()
    net.add("m", bmc.Normal(0.0, 1.0))
    net.add("big", lambda m: m > 0.3)
    net.add("y", lambda m, big: bmc.StudentT(3, m + big, 1))
    posterior = bmc.infer(net, {"y": 0.5}, engine=bmc.Gibbs(300, 100), rng=1)
    assert posterior.mean("big") == (posterior["m"] > 0.3).mean()
