"""Kernels of stacks: exact answers of a hidden Markov model, invariance, errors, adaptation."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import special, stats

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import DensityError, ZeroProbabilityError
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.enumerate import Enumerate
from bayesmc.kernels.slice import Slice
from bayesmc.kernels.stacked import Stacked
from bayesmc.network import pose
from bayesmc.structure import stacked
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.stacked import stacks
from bayesmc.structure.target import Target, target_of
from tests.kernels.invariance import Case, Model, each_fault, running

STEPS = 30
#: chance that right kernels fail a test of exact answers, all nodes together
ALPHA = 1e-4


def hidden_markov(steps: int = STEPS) -> bmc.BayesNet:
    """Three overlapping states, emissions that differ by the time, too."""
    net = bmc.BayesNet()
    rows = np.array([[0.7, 0.2, 0.1], [0.2, 0.6, 0.2], [0.1, 0.3, 0.6]])
    means = np.array([-1.0, 0.0, 1.5])
    net.add("z[0]", bmc.Categorical([0.5, 0.3, 0.2]))
    for t in range(1, steps):
        net.add(f"z[{t}]", lambda z: bmc.Categorical(rows[z]), parents=[f"z[{t - 1}]"])
    for t in range(steps):
        net.add(f"y[{t}]", lambda z, t=t: bmc.Normal(means[z] + 0.02 * t, 1.0), parents=[f"z[{t}]"])
    return net


def kernels_of(target: Target, make: Callable[[Blanket], Kernel], letter: str = "") -> list[Kernel]:
    """Kernels of all nodes, or of those whose names begin so."""
    names = [n for n in target.chain if n.startswith(letter)]
    blankets = {n: Blanket(target, n) for n in names}
    found, left = stacks(target, blankets, names)
    return [*(Stacked(s, make) for s in found), *(make(blankets[n]) for n in left)]


def together(target: Target, make: Callable[[Blanket], Kernel], pick: str) -> Kernel:
    """A deliberate error: neighbours are moved at once, each given where the other was."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stacked, "_apart", lambda group: [list(group)])
        return next(k for k in kernels_of(target, make, pick[0]) if pick in k.names)


def deviations(target: Target, kernels: list[Kernel], exact: Any, seed: int) -> np.ndarray:
    """Standard scores of the probabilities of neighbours' joint states, from independent chains.

    Moved at once, neighbours would still have the right probabilities each; their joint states tell.
    """
    chains, warmup, sweeps = 300, 40, 60
    rng = np.random.default_rng(seed)
    values = dict(target.known)
    for name in target.chain:
        values[name] = rng.integers(3, size=chains).astype(np.uint8)
    pairs = list(itertools.pairwise(target.chain))
    seen = np.zeros((len(pairs), chains, 9))
    with running():
        memories = [k.start(values, chains) for k in kernels]
        for sweep in range(warmup + sweeps):
            for i, kernel in enumerate(kernels):
                new, memories[i] = kernel.step(values, memories[i], rng, sweep < warmup)
                values.update(new)
            if sweep >= warmup:
                for counts, (a, b) in zip(seen, pairs, strict=True):
                    counts += (3 * values[a] + values[b])[:, None] == np.arange(9)
    wanted = np.array([exact.probabilities(*pair).ravel() for pair in pairs])
    error = seen.std(axis=1, ddof=1) / np.sqrt(chains)
    # states so rare that hardly a chain has seen them have no normal score
    often = (seen > 0).sum(axis=1) > 50
    return (seen.mean(axis=1) - sweeps * wanted)[often] / error[often]


@pytest.fixture(scope="module")
def question() -> tuple[Target, Any]:
    net = hidden_markov()
    draw = net.sample(1, rng=5)
    evidence = {f"y[{t}]": float(draw[f"y[{t}]"][0]) for t in range(STEPS)}
    return target_of(pose(net, evidence)), bmc.infer(net, evidence, engine=bmc.Exact())


def test_exact_answers(question: tuple[Target, Any]) -> None:
    """A false alarm in 1e-4 of seeds: normal scores, Bonferroni over pairs and states."""
    target, exact = question
    kernels = kernels_of(target, Enumerate)
    assert [len(k.names) for k in kernels] == [14, 14, 1, 1]
    scores = deviations(target, kernels, exact, 1)
    assert len(scores) > 100
    assert np.abs(scores).max() < stats.norm.isf(ALPHA / 2 / scores.size)


def test_neighbours_at_once_are_wrong(question: tuple[Target, Any]) -> None:
    """Negative control: all nodes inside moved at once have another stationary law."""
    target, exact = question
    kernels = [k for k in kernels_of(target, Enumerate) if len(k.names) == 1]
    kernels.append(together(target, Enumerate, "z[1]"))
    scores = deviations(target, kernels, exact, 1)
    assert np.abs(scores).max() > stats.norm.isf(ALPHA / 2 / scores.size)


# ---- invariance ---------------------------------------------------------------------------------


def switching() -> Model:
    """Overlapping categories with a hidden mean, six steps."""
    net = bmc.BayesNet()
    net.add("mu", bmc.Normal(0.0, 1.0))
    net.add("z[0]", bmc.Categorical([0.5, 0.3, 0.2]))
    rows = np.array([[0.6, 0.3, 0.1], [0.2, 0.6, 0.2], [0.1, 0.3, 0.6]])
    for t in range(1, 10):
        net.add(f"z[{t}]", lambda z: bmc.Categorical(rows[z]), parents=[f"z[{t - 1}]"])
    net.add(
        "y",
        lambda mu, *z: bmc.Normal(mu * z[0] + z[-1], 1.0),
        parents=["mu", "z[1]", "z[9]"],
    )
    for t in range(2, 9):
        net.add(f"w[{t}]", lambda z, mu: bmc.Normal(mu * z, 1.0), parents=[f"z[{t}]", "mu"])
    seen = ("y", *(f"w[{t}]" for t in range(2, 9)))
    return Model(net, seen, moved=("z[2]", "z[3]", "z[4]"))


def growth() -> Model:
    """Numbers above zero: slices on their logarithms, and functions that differ by the time."""
    net = bmc.BayesNet()
    net.add("x[0]", bmc.Gamma(2.0, 1.0))
    for t in range(1, 10):
        net.add(
            f"x[{t}]",
            lambda x, t=t: bmc.Gamma(6.0, 6.0 / (0.2 + 0.9 * x / t**0.1)),
            parents=[f"x[{t - 1}]"],
        )
    for t in range(10):
        net.add(f"y[{t}]", lambda x: bmc.Poisson(x), parents=[f"x[{t}]"])
    return Model(net, tuple(f"y[{t}]" for t in range(10)), moved=("x[2]", "x[3]", "x[4]"))


def first_stack(make: Callable[[Blanket], Kernel], pick: str) -> Callable[[Target], Kernel]:
    def made(target: Target) -> Kernel:
        return next(k for k in kernels_of(target, make, pick[0]) if pick in k.names)

    return made


def neighbours(make: Callable[[Blanket], Kernel], pick: str) -> Callable[[Target], Kernel]:
    return lambda target: together(target, make, pick)


CASES = {
    "enumerate": Case(
        switching(),
        first_stack(Enumerate, "z[2]"),
        {"neighbours": neighbours(Enumerate, "z[2]")},
        how="moving",
        statistics={"neighbours": lambda s, y: (s["z[4]"] - 1.0) * (s["z[5]"] - 1.0)},
    ),
    "slice": Case(
        growth(),
        first_stack(Slice, "x[2]"),
        {"neighbours": neighbours(Slice, "x[2]")},
        how="moving",
        warmup=30,
        statistics={"neighbours": lambda s, y: np.log(s["x[3]"]) * np.log(s["x[4]"])},
    ),
}


@pytest.mark.parametrize("test", ["geweke", "ranks"])
@pytest.mark.parametrize(("name", "fault"), each_fault(CASES))
def test_invariance(name: str, fault: str, test: str) -> None:
    """The false-alarm rate of each test is that of ``invariance.ALPHA``."""
    CASES[name].check(test, fault)


# ---- what else a kernel is ----------------------------------------------------------------------


def separate(count: int, function: Callable[..., Any]) -> tuple[bmc.BayesNet, dict[str, float]]:
    net = bmc.BayesNet()
    for j in range(count):
        net.add(f"x[{j}]", lambda j=j: bmc.Laplace(0.0, 1.0 + j))
        net.add(f"y[{j}]", function, parents=[f"x[{j}]"])
    return net, {f"y[{j}]": float(j) for j in range(count)}


def stacked_slice(net: Any, evidence: dict[str, Any]) -> tuple[Target, Stacked]:
    target = target_of(pose(net, evidence))
    (kernel,) = kernels_of(target, Slice)
    assert isinstance(kernel, Stacked)
    return target, kernel


def test_widths_are_each_node_s_own() -> None:
    """Nodes of a group may live on different scales."""
    net = bmc.BayesNet()
    for j in range(5):
        net.add(f"x[{j}]", lambda j=j: bmc.Laplace(0.0, 10.0 ** (j - 2)))
        net.add(f"y[{j}]", lambda x, j=j: bmc.Laplace(x, 10.0**j), parents=[f"x[{j}]"])
    target, kernel = stacked_slice(net, {f"y[{j}]": 0.0 for j in range(5)})
    values = {**target.known, **{n: np.zeros(8) for n in kernel.names}}
    rng = np.random.default_rng(0)
    memory = kernel.start(values, 8)
    with running():
        for _ in range(200):
            new, memory = kernel.step(values, memory, rng, True)
            values.update(new)
    width = kernel.end_warmup(memory)["width"]
    assert width.shape == (5,)
    # each scale is ten times the one before; mean steps of 8 chains are known to a factor of two or so
    assert (width[1:] / width[:-1] > 3).all()


def test_the_first_argument_is_not_changed() -> None:
    net, evidence = separate(5, lambda x: bmc.Poisson(np.exp(x)))
    target, kernel = stacked_slice(net, evidence)
    values = {**target.known, **{n: np.zeros(3) for n in kernel.names}}
    before = {n: v.copy() for n, v in values.items()}
    memory = kernel.start(values, 3)
    with running():
        kernel.step(values, memory, np.random.default_rng(0), True)
    assert all((values[n] == v).all() for n, v in before.items())
    assert (memory["width"] == 1).all() and memory["count"] == 0


def test_an_error_names_the_node_at_fault() -> None:
    """Not the first of the group, whose function is called for all."""

    def density(x: Any) -> Any:
        return bmc.Density(lambda y: np.where(x > 30, np.nan, -((y - x) ** 2)))

    net, evidence = separate(6, density)
    target, kernel = stacked_slice(net, evidence)
    values = {**target.known, **{n: np.zeros(2) for n in kernel.names}}
    values["x[3]"] = np.array([1.0, 31.0])
    with running(), pytest.raises(DensityError, match=r"node 'y\[3\]'.*x\[3\] = 31"):
        kernel.step(values, kernel.start(values, 2), np.random.default_rng(0), False)


def test_an_impossible_configuration_names_the_node() -> None:
    net = bmc.BayesNet()
    for j in range(5):
        net.add(f"z[{j}]", bmc.Bernoulli(0.5))
        net.add(f"u[{j}]", bmc.Laplace(0.0, 1.0))
        net.add(
            f"y[{j}]",
            lambda z, u: bmc.Uniform(u, u + 1.0 + z),
            parents=[f"z[{j}]", f"u[{j}]"],
        )
    target = target_of(pose(net, {f"y[{j}]": 0.5 for j in range(5)}))
    blankets = {n: Blanket(target, n) for n in target.chain}
    (stack,), _ = stacks(target, blankets, [f"z[{j}]" for j in range(5)])
    kernel = Stacked(stack, Enumerate)
    values = {**target.known, **{f"u[{j}]": np.zeros(2) for j in range(5)}}
    values |= {n: np.zeros(2, dtype=np.uint8) for n in kernel.names}
    values["u[4]"] = np.array([0.0, 9.0])
    with running(), pytest.raises(ZeroProbabilityError, match=r"'z\[4\]'"):
        kernel.step(values, {}, np.random.default_rng(0), False)


def test_words() -> None:
    net, evidence = separate(5, lambda x: bmc.Poisson(np.exp(x)))
    _, kernel = stacked_slice(net, evidence)
    assert kernel.words("x[3]") == ("slice", "5 like nodes at once")


def test_a_function_is_called_once_for_all() -> None:
    calls = []

    def counted(x: Any) -> Any:
        calls.append(x.shape)
        return bmc.Poisson(special.expit(x))

    net, evidence = separate(40, counted)
    target, kernel = stacked_slice(net, evidence)
    values = {**target.known, **{n: np.zeros(2) for n in kernel.names}}
    calls.clear()
    with marking_invalid():
        kernel.stack.log_density(values, np.zeros((3, 2, 40)))
    assert calls == [(3, 2, 40)]
