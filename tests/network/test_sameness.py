"""Functions declared anew by the same lines are the same; any difference that counts is seen."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import UnsupportedError
from bayesmc.network.sameness import same


def closing_over(value: Any) -> Any:
    return lambda x: bmc.Normal(x, value)


def with_default(value: Any) -> Any:
    def density(x: Any, value: Any = value) -> Any:
        return bmc.Normal(x, value)

    return density


def nested(value: Any) -> Any:
    def helper(x: Any) -> Any:
        return x * value

    return lambda x: bmc.Normal(helper(x), [helper(k) for k in range(2)])


class Callable_:
    def __init__(self, value: Any) -> None:
        self.value = value

    def __call__(self, x: Any) -> Any:
        return bmc.Normal(x, self.value)

    def method(self, x: Any) -> Any:
        return bmc.Normal(x, self.value)


MAKERS = [
    closing_over,
    with_default,
    nested,
    Callable_,
    lambda value: Callable_(value).method,
    lambda value: functools.partial(closing_over, value),
]


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize(
    "values", [(1.0, 2.0), (np.arange(3.0), np.arange(3.0) + 1e-12), ({"a": [1]}, {"a": [2]})]
)
def test_functions_are_told_by_what_they_hold(make: Any, values: Any) -> None:
    one, other = values
    assert same(make(one), make(one))
    assert not same(make(one), make(other))


def test_code_counts() -> None:
    assert same(lambda x: x + 1.0, lambda x: x + 1.0)
    for other in (lambda x: x + 2.0, lambda x: x - 1.0, lambda x: np.exp(x), lambda y: y + 1.0):
        assert not same(lambda x: x + 1.0, other)


def test_globals_of_other_modules_count() -> None:
    source = "def f(x):\n    return x * scale\n"
    spaces: list[dict[str, Any]] = [{"scale": 1.0}, {"scale": 1.0}, {"scale": 2.0}]
    for space in spaces:
        exec(source, space)
    first, second, third = (space["f"] for space in spaces)
    assert same(first, second) and not same(first, third)


def test_unknown_is_not_the_same() -> None:
    assert (
        same(closing_over(np.random.default_rng(0)), closing_over(np.random.default_rng(0))) is None
    )


def test_objects_that_hold_each_other_end() -> None:
    def ring() -> list[Any]:
        found: list[Any] = [1]
        found.append(found)
        return found

    assert same(ring(), ring())


def declared(scale: float, low: float = 0.0) -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(low, scale))

    @net.node
    def y(x: Any) -> Any:
        return bmc.Normal(np.where(x > 50, 7.0, x), scale)

    return net


def elsewhere(scale: float) -> bmc.BayesNet:
    """The same but where no draw ever is."""
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, scale))

    @net.node
    def y(x: Any) -> Any:
        return bmc.Normal(np.where(x > 50, 8.0, x), scale)

    return net


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
@pytest.mark.parametrize(
    "engine",
    [bmc.Gibbs(40, 10, 2), bmc.MetropolisHastings(40, 10, 2), bmc.LikelihoodWeighting(2000)],
)
def test_a_net_declared_anew_is_gone_on_with(engine: Any) -> None:
    first = bmc.infer(declared(1.0), {"y": 0.5}, engine=engine, rng=0)
    more = bmc.infer(declared(1.0), {"y": 0.5}, engine=engine, rng=0, resume=first)
    assert more["x"].shape[1] == 2 * engine.draws
    words = {
        "'x' has another density|function of node 'y'": declared(2.0),
        "'x' has another density": declared(1.0, 0.1),
        "the function of node 'y' is another one": elsewhere(1.0),
    }
    for why, net in words.items():
        with pytest.raises(UnsupportedError, match=f"resume=.*; .*({why})"):
            bmc.infer(net, {"y": 0.5}, engine=engine, rng=0, resume=first)
    with pytest.raises(UnsupportedError, match=r"resume=.*; the evidence of 'y' is another one"):
        bmc.infer(declared(1.0), {"y": 0.6}, engine=engine, rng=0, resume=first)


# ---- names of the module ---------------------------------------------------------------------------

SCALE: Any = 1.0


def helper(x: Any) -> Any:
    return x


def of_the_module(potential: bool = False) -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("x", bmc.Normal(0.0, 1.0))
    if potential:
        net.add("y", lambda x: bmc.Normal(x, 1.0))
        net.potential("pull", lambda x: -0.5 * (helper(x) / SCALE) ** 2)
    else:
        net.add("y", lambda x: bmc.Normal(helper(x), SCALE))
    return net


@pytest.mark.filterwarnings("ignore::bayesmc.errors.ConvergenceWarning")
@pytest.mark.parametrize("potential", [False, True])
@pytest.mark.parametrize(
    "engine",
    [bmc.Gibbs(40, 10, 2), bmc.MetropolisHastings(40, 10, 2), bmc.LikelihoodWeighting(2000)],
)
def test_a_name_of_the_module_that_has_changed(
    engine: Any, potential: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A constant, an array that is written over, and a function that is defined anew."""
    here = globals()

    def refused(first: Any, why: str) -> None:
        with pytest.raises(UnsupportedError, match=rf"resume=.*; .*({why})"):
            bmc.infer(of_the_module(potential), {"y": 0.5}, engine=engine, rng=0, resume=first)

    first = bmc.infer(of_the_module(potential), {"y": 0.5}, engine=engine, rng=0)
    again = bmc.infer(of_the_module(potential), {"y": 0.5}, engine=engine, rng=0, resume=first)
    assert again["x"].shape[1] == 2 * engine.draws
    monkeypatch.setitem(here, "SCALE", 100.0)
    refused(first, r"reads 'SCALE', which was 1\.0 then and is 100\.0 now")
    monkeypatch.setitem(here, "SCALE", np.array(1.0))
    first = bmc.infer(of_the_module(potential), {"y": 0.5}, engine=engine, rng=0)
    here["SCALE"][...] = 100.0
    refused(first, "reads 'SCALE'")
    here["SCALE"][...] = 1.0
    monkeypatch.setitem(here, "helper", lambda x: 3.0 * x)
    refused(first, "another density")


@pytest.mark.parametrize("engine", [bmc.Exact(), bmc.LikelihoodWeighting(2000)])
def test_predictions_by_a_function_that_says_something_else(
    engine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    posterior = bmc.infer(of_the_module(), {"y": 0.5}, engine=engine, rng=0)
    posterior.predict(["y"], rng=0)
    monkeypatch.setitem(globals(), "SCALE", 100.0)
    with pytest.raises(bmc.errors.ModelError, match=r"'y': .* reads 'SCALE' .* 100\.0 now"):
        posterior.predict(["y"], rng=0)
