"""Derivatives of the means of nodes, followed through the declared functions.

Functions are called with ``Dual`` stand-ins in place of the numbers that move. Where a function or a family
cannot be followed there is no answer; whoever asks takes differences then. Nothing here knows slices or
Gaussian beliefs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import special

from bayesmc.distributions import (
    Affine,
    Beta,
    Binomial,
    Distribution,
    Exponential,
    Gamma,
    Geometric,
    HalfNormal,
    InverseGamma,
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
from bayesmc.distributions.base import marking_invalid
from bayesmc.network import Model
from bayesmc.network.model import arguments_of
from bayesmc.tracing import Dual, NoTangent, TracedCall


def mean_slopes(model: Model, order: Sequence[str], values: Mapping[str, Any]) -> dict[str, Dual]:
    """Means of nodes and how they move with some numbers.

    Parameters
    ----------
    model : Model
    order : sequence of str
        Nodes to evaluate, parents first: those whose means are wanted, and the deterministic ones between
        them and what moves.
    values : dict
        Stored values of the parents, without or with a batch, of which some are ``Dual``.

    Returns
    -------
    dict
        Node -> mean of its distribution, or its value if it is deterministic, shape ``(*batch, *plates,
        *event)``. Means of angles may be off by turns.

    Raises
    ------
    NoTangent
        A function or a family cannot be followed (``always``), or has no derivative here.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.engines.kalman.slopes import mean_slopes
    >>> from bayesmc.tracing import Dual
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(np.sin(x), 0.1))
    >>> mean_slopes(net.model(), ["y"], {"x": Dual(0.0, [1.0])})["y"].tangent.tolist()
    [1.0]
    """
    known: dict[str, Any] = dict(values)
    found: dict[str, Any] = {}
    width = next(v.tangent.shape[-1] for v in known.values() if isinstance(v, Dual))
    with marking_invalid(), np.errstate(all="ignore"):
        for name in order:
            node = model[name]
            result, batch = _called(model, name, known)
            mean = mean_of(result) if node.is_stochastic else result
            mean = np.broadcast_to(mean, batch + node.value_shape)
            if not node.is_stochastic:
                known[name] = (
                    mean  # where it does not move its type is kept: functions choose by booleans
                )
            if not isinstance(mean, Dual):
                mean = Dual(mean, np.zeros((*mean.shape, width)))
            found[name] = mean
    return found


def mean_of(result: Any) -> Any:
    """Mean of what a function returned, a distribution or the record of one with ``Dual`` parameters.

    Raises
    ------
    NoTangent
        The family has no formula here.
    """
    if isinstance(result, Distribution):
        return result.mean
    formula = _MEANS.get(result.function) if isinstance(result, TracedCall) else None
    if formula is None:
        what = getattr(result, "function", type(result)).__name__
        raise NoTangent(f"the mean of {what}")
    return formula(**result.arguments)


# ---- private ------------------------------------------------------------------------------------


def _called(model: Model, name: str, values: Mapping[str, Any]) -> tuple[Any, tuple[int, ...]]:
    """What a function makes of its parents, and their batch shape."""
    node = model[name]
    if not any(isinstance(values.get(p), Dual) for p in node.parents):
        return model.evaluate(name, values)
    declaration = node.declaration
    if declaration.function is None or declaration.vectorize or node.domain is not None:
        raise NoTangent(f"node {name!r} is called element by element, or has states")
    arguments, batch = arguments_of(node.links, values)
    try:
        return declaration.function(*arguments), batch
    except NoTangent:
        raise
    except Exception as error:
        raise NoTangent(f"node {name!r}: {error}") from error


def _located(loc: Any = 0.0, **others: Any) -> Any:
    return loc


def _affine(base: Any, loc: Any, scale: Any) -> Any:
    return loc + scale * mean_of(base)


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
_MEANS: dict[Any, Callable[..., Any]] = {
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
    Geometric: lambda probs, logits: 1.0 / _odds(probs, logits),
    NegativeBinomial: lambda total_count, probs, logits: total_count * _odds(probs, logits),
}
