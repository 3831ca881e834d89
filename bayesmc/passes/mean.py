"""The mean of a distribution as an expression of its parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions import (
    Affine,
    Beta,
    BetaBinomial,
    Binomial,
    Distribution,
    Exponential,
    Gamma,
    Geometric,
    HalfNormal,
    InverseGamma,
    Joint,
    Laplace,
    LogNormal,
    MvNormal,
    NegativeBinomial,
    Normal,
    Poisson,
    StudentT,
    Uniform,
    VonMises,
    Weibull,
    WrappedNormal,
)
from bayesmc.errors import TraceError
from bayesmc.expression import Expression, Family, TracedArray
from bayesmc.expression.functions import expression_of


def mean(density: Family | Distribution) -> Expression:
    """The mean; of an angle it may be off by turns.

    Raises
    ------
    TraceError
        The family has no formula here.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.expression import TracedArray, evaluate, leaf, trace
    >>> from bayesmc.passes.mean import mean
    >>> density = trace(lambda x: bmc.Gamma(x, 2.0), [TracedArray(leaf("x", ()))])
    >>> evaluate([mean(density)], {"x": np.array([3.0, 5.0])})
    [array([1.5, 2.5])]
    """
    return expression_of(_mean(density))


# ---- private ------------------------------------------------------------------------------------


def _mean(density: Any) -> Any:
    if isinstance(density, Distribution):
        return density.mean
    formula = FORMULAS.get(density.make)
    if formula is None and isinstance(density.make, type) and issubclass(density.make, Joint):
        return _side_by_side(density)
    if formula is None:
        raise TraceError(f"the mean of {getattr(density.make, '__name__', density.make)}")
    return formula(**{k: _operand(v) for k, v in density.parameters.items()})


def _side_by_side(density: Family) -> Any:
    """Of parts of a vector, each a number or a vector."""
    columns = []
    for part in _parts(density.parameters.values()):
        is_vector = isinstance(part, MvNormal) or getattr(part, "make", None) is MvNormal
        if not is_vector and getattr(part, "event_shape", None):
            raise TraceError(f"the mean of {type(part).__name__} within a Joint")
        own = _mean(part)
        columns.append(own if is_vector else np.expand_dims(own, -1))
    lead = np.broadcast_shapes(*(np.shape(c)[:-1] for c in columns))
    wide = [np.broadcast_to(c, (*lead, np.shape(c)[-1])) for c in columns]
    return np.concatenate(wide, axis=-1)


def _parts(values: Iterable[Any]) -> Iterator[Any]:
    for value in values:
        if isinstance(value, (list, tuple)):
            yield from _parts(value)
        else:
            yield value


def _operand(value: Any) -> Any:
    """A parameter as formulas take it."""
    if isinstance(value, (list, tuple)):
        return TracedArray(expression_of([_operand(v) for v in value]))
    return TracedArray(value) if isinstance(value, Expression) else value


def _located(loc: Any = 0.0, **others: Any) -> Any:
    return loc


def _affine(base: Any, loc: Any, scale: Any) -> Any:
    return loc + scale * _mean(base)


def _half_normal(scale: Any) -> Any:
    return scale * np.sqrt(2 / np.pi)


def _weibull(concentration: Any, scale: Any) -> Any:
    return scale * np.exp(special.gammaln(1.0 + 1.0 / concentration))


def _odds(probs: Any, logits: Any) -> Any:
    """Odds of a success."""
    return np.exp(logits) if probs is None else probs / (1.0 - probs)


def _binomial(total_count: Any, probs: Any, logits: Any) -> Any:
    return total_count * (special.expit(logits) if probs is None else probs)


#: family -> its mean, given the parameters by name
FORMULAS: dict[Any, Callable[..., Any]] = {
    **dict.fromkeys((Normal, MvNormal, Laplace, StudentT, VonMises, WrappedNormal), _located),
    Affine: _affine,
    HalfNormal: _half_normal,
    Weibull: _weibull,
    LogNormal: lambda loc, scale: np.exp(loc + 0.5 * np.square(scale)),
    Uniform: lambda low, high: 0.5 * (low + high),
    Beta: lambda concentration1, concentration0: concentration1 / (concentration1 + concentration0),
    Gamma: lambda concentration, rate: concentration / rate,
    InverseGamma: lambda concentration, scale: scale / (concentration - 1.0),
    Exponential: lambda rate: 1.0 / rate,
    Poisson: lambda rate: rate,
    Binomial: _binomial,
    BetaBinomial: lambda total_count, concentration1, concentration0: (
        total_count * concentration1 / (concentration1 + concentration0)
    ),
    Geometric: lambda probs, logits: 1.0 / _odds(probs, logits),
    NegativeBinomial: lambda total_count, probs, logits: total_count * _odds(probs, logits),
}
