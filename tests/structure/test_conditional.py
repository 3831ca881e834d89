"""Full conditionals as programs say what the model's functions say, or are not used."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import DensityError, UnsupportedError
from bayesmc.expression import elementwise, leaf
from bayesmc.kernels.slice import Slice
from bayesmc.network import pose
from bayesmc.structure import conditional
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.conditional import Conditional, conditional_of
from bayesmc.structure.free_terms import Elements
from bayesmc.structure.target import Target, target_of

DATA = np.random.default_rng(3).normal(size=(4, 6))
TOTALS = np.array([3, 8, 20, 5])


def hierarchy() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Scalars above a plate, a computed node, data in two plates in the other order."""
    net = bmc.BayesNet(plates={"group": 4, "time": 6})
    net.add("centre", bmc.Laplace(1.0, 2.0))
    net.add("spread", bmc.HalfCauchy(1.0))
    net.add("effect", lambda centre, spread: bmc.StudentT(4.0, centre, spread), plates="group")
    net.add("rate", lambda effect: np.exp(0.3 * effect), plates="group")
    net.add("shift", bmc.Gamma(2.0, 1.0))
    net.add("y", lambda effect, shift: bmc.Laplace(effect * shift, 1.0), plates=("group", "time"))
    net.add("n", lambda rate: bmc.Poisson(rate), plates="group")
    return net, {"y": DATA, "n": np.array([0, 1, 4, 2])}


def partly_seen() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet(plates={"point": 5})
    net.add("slope", bmc.Laplace(0.0, 1.0))
    net.add("scale", bmc.LogNormal(0.0, 1.0))
    net.add("y", lambda slope, scale: bmc.StudentT(3.0, slope, scale), plates="point")
    return net, {"y": np.array([1.0, np.nan, 3.0, np.nan, -1.0])}


def counts() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet(plates={"site": 4})
    net.add("rate", bmc.LogNormal(1.0, 1.0))
    net.add("p", bmc.Uniform(0.1, 0.9))
    net.add("n", lambda rate: bmc.Poisson(rate), plates="site")
    net.add("seen", lambda n, p: bmc.Binomial(n + 20, p), plates="site")
    return net, {"seen": TOTALS}


MODELS: list[tuple[Callable[[], tuple[bmc.BayesNet, dict[str, Any]]], str]] = [
    (hierarchy, "centre"),
    (hierarchy, "spread"),
    (hierarchy, "effect"),
    (hierarchy, "shift"),
    (partly_seen, "slope"),
    (partly_seen, "scale"),
    (counts, "rate"),
    (counts, "p"),
    (counts, "n"),
]


def drawn(model: Any, target: Target, chains: int, seed: int) -> dict[str, np.ndarray]:
    """States from the prior, with what is known in place."""
    draws = model()[0].sample(chains, rng=seed)
    values = {**target.known, **{n: draws[n] for n in target.chain}}
    for name in target.chain:
        seen = target.seen(name)
        if seen is not None:
            values[name] = np.where(seen.mask, seen.value, values[name])
    target.compute(values, target.links)
    return values


@pytest.mark.parametrize(("model", "name"), MODELS)
def test_it_says_what_the_functions_say(model: Any, name: str) -> None:
    target = target_of(pose(*model()))
    blanket = Blanket(target, name)
    values, other = drawn(model, target, 7, 1), drawn(model, target, 7, 2)
    at = Conditional(blanket).given(values)
    assert at is not None
    with marking_invalid(), np.errstate(all="ignore"):
        candidates = np.stack([values[name], other[name]])
        found, wanted = at(candidates), blanket.log_density(values, candidates)
    assert np.isfinite(wanted).mean() > 0.5
    np.testing.assert_allclose(*np.broadcast_arrays(found, wanted), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("fault", ["twice", "moved", "unmasked"])
def test_what_differs_is_not_used(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    honest = conditional.elements_of

    def of_one(log: Any) -> Any:
        if fault == "twice":
            return elementwise(np.multiply, log, 2.0)
        return elementwise(np.add, log, leaf("slope", ())) if fault == "moved" else log

    def wrong(target: Target, terms: Any, above: Any) -> Any:
        if fault == "unmasked":
            terms = [replace(term, mask=None) for term in terms]
        return [Elements(*map(of_one, found)) for found in honest(target, terms, above)]

    monkeypatch.setattr(conditional, "elements_of", wrong)
    blanket = Blanket(target_of(pose(*partly_seen())), "slope")
    with pytest.raises(UnsupportedError, match="differs"):
        Conditional(blanket)
    assert conditional_of(blanket) is None


def test_other_data_is_left_to_the_functions() -> None:
    target = target_of(pose(*hierarchy()))
    values = drawn(hierarchy, target, 3, 1)
    found = Conditional(Blanket(target, "shift"))
    assert found.given(values) is not None
    assert found.given({**values, "y": values["y"] + 1.0}) is None
    assert Conditional(Blanket(target, "centre")).given({**values, "y": values["y"] + 1.0})


def test_terms_that_cannot_be_followed_are_left_to_the_functions() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Laplace(0.0, 1.0))
    net.add("y", lambda x: bmc.Normal(float(x), 1.0), vectorize=True)
    assert conditional_of(Blanket(target_of(pose(net, {"y": 1.0})), "x")) is None


def test_impossible_densities_still_raise() -> None:
    net = bmc.BayesNet()
    net.add("x", bmc.Laplace(0.0, 1.0))
    net.potential("spike", lambda x: -np.log(np.maximum(np.abs(x - 9.0) - 1.0, 0.0)))
    target = target_of(pose(net, {}))
    kernel = Slice(Blanket(target, "x"))
    values = {"x": np.full(64, 7.5)}
    with pytest.raises(DensityError, match="spike"), np.errstate(all="ignore"):
        for seed in range(20):
            kernel.step(values, kernel.start(values, 64), np.random.default_rng(seed), True)


def test_slices_take_the_program(monkeypatch: pytest.MonkeyPatch) -> None:
    target = target_of(pose(*hierarchy()))
    kernel = Slice(Blanket(target, "spread"))
    values = drawn(hierarchy, target, 5, 1)
    memory = kernel.start(values, 5)
    first = kernel.step(values, memory, np.random.default_rng(0), True)[0]["spread"]

    def called(*args: Any) -> Any:
        raise AssertionError("the model's functions were asked")

    with monkeypatch.context() as patched:
        patched.setattr(kernel.blanket, "log_density", called)
        kernel.step(values, memory, np.random.default_rng(0), True)
    monkeypatch.setattr(conditional.Conditional, "given", lambda self, values: None)
    plain = kernel.step(values, memory, np.random.default_rng(0), True)[0]["spread"]
    np.testing.assert_allclose(first, plain, rtol=1e-9)


def test_debug_holds_the_program_against_the_functions(monkeypatch: pytest.MonkeyPatch) -> None:
    target = target_of(pose(*hierarchy()))
    kernel = Slice(Blanket(target, "spread"), debug=True)
    values = drawn(hierarchy, target, 5, 1)
    memory = kernel.start(values, 5)
    kernel.step(values, memory, np.random.default_rng(0), True)
    honest = conditional.At.__call__
    monkeypatch.setattr(conditional.At, "__call__", lambda at, x: honest(at, x) + 1e-6 * x)
    with pytest.raises(DensityError, match="node 'spread': the program .* is off by"):
        kernel.step(values, memory, np.random.default_rng(0), True)
