"""Distributions of stand-ins are recorded as calls; nothing looks at what a stand-in stands for."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

import bayesmc as bmc
import bayesmc.distributions as families
from bayesmc.distributions.parameters import signature
from bayesmc.expression import Program, TracedArray, TracedCall, is_traced, leaf, trace

X = TracedArray(leaf("x", (2, 3)))
ONE = TracedArray(leaf("one", ()))


def _traced_of(call: TracedCall) -> list[str]:
    return [key for key, value in call.arguments.items() if is_traced(value)]


def families_with_parameters() -> list[tuple[type, str]]:
    """Every family with every parameter of its constructor."""
    found = []
    for name in families.__all__:
        family = getattr(families, name)
        if inspect.isclass(family) and issubclass(family, bmc.Distribution):
            if family is bmc.Distribution:
                continue
            for key, parameter in signature(family).parameters.items():
                if parameter.kind is not inspect.Parameter.VAR_POSITIONAL:
                    found.append((family, key))
    return found


@pytest.mark.parametrize(("family", "key"), families_with_parameters())
def test_a_call_with_a_traced_parameter_is_recorded(family: type, key: str) -> None:
    parameters = signature(family).parameters
    given = {
        name: ONE if name == key else 0.5
        for name, parameter in parameters.items()
        if name == key or parameter.default is inspect.Parameter.empty
    }
    call = family(**given)
    assert isinstance(call, TracedCall)
    assert call.function is family
    assert list(call.arguments) == list(parameters)
    assert _traced_of(call) == [key]
    assert call.arguments[key] is given[key]


def test_calls_by_place_have_names_too() -> None:
    call = bmc.Normal(X, 2.0)
    assert isinstance(call, TracedCall)
    assert call.arguments["loc"] is X
    assert call.arguments["scale"] == 2.0
    assert bmc.Normal(X).arguments["scale"] == 1.0  # defaults, too
    assert _traced_of(bmc.Normal(0.0, X)) == ["scale"]
    with pytest.raises(TypeError):
        bmc.Normal(X, 1.0, 2.0)
    with pytest.raises(TypeError):
        bmc.Normal(X, sd=2.0)


def test_calls_within_calls() -> None:
    mixture = bmc.Mixture([0.5, 0.5], bmc.Normal(X, 1.0))
    assert isinstance(mixture, TracedCall)
    assert _traced_of(mixture) == ["components"]
    joint = bmc.Joint(bmc.Normal(0.0, 1.0), bmc.Normal(ONE, 1.0))
    assert isinstance(joint, TracedCall)
    assert is_traced(bmc.Truncated(bmc.Normal(ONE, 1.0), 0.0, 1.0))
    assert is_traced([1.0, (2.0, ONE)])
    assert not is_traced([1.0, (2.0, "x")])


def test_methods_of_distributions_do_not_look() -> None:
    for method in ("log_prob", "cdf", "ppf"):
        with pytest.raises(bmc.errors.TraceError):
            getattr(bmc.Normal(0.0, 1.0), method)(X)


def test_methods_of_arrays_are_those_of_numpy() -> None:
    assert X.sum(axis=-1).expression is np.sum(X, axis=-1).expression
    assert X.T.expression is X.transpose(1, 0).expression
    assert X.ravel().expression is X.reshape(-1).expression
    for look in (complex, hash, lambda x: 1.0 in x, float, bool):
        with pytest.raises(bmc.errors.TraceError):
            look(ONE)


def test_differences_with_ends_are_followed():
    x = TracedArray(leaf("x", (3,)))
    root = trace(lambda x: np.diff(x, prepend=0.0, append=x[..., -1:] + 2.0), [x])
    values = np.array([[1.0, 4.0, 9.0], [2.0, 2.0, 2.0]])
    (found,) = Program([root])({"x": values})
    assert np.array_equal(found, [[1.0, 3.0, 5.0, 2.0], [2.0, 0.0, 0.0, 2.0]])
