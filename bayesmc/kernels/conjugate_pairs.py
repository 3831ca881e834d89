"""The conjugate table as data: which parameter of which child a node may enter, how, and what that adds.

A row says what a child's log density is, as a function of the parameter that the node enters, and so what
the child adds to the natural parameters of the node's full conditional. The statistics see an
``Evaluation``: the child's parameters with the node at a neutral value, and its data.

References
----------
Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), ch. 2-3; Bernardo and Smith (1994), table A.2;
Plummer, JAGS user manual, version 4.3, on conjugate samplers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from bayesmc.distributions import (
    Bernoulli,
    Binomial,
    Categorical,
    Exponential,
    Gamma,
    Geometric,
    HalfNormal,
    InverseGamma,
    Laplace,
    LogNormal,
    Multinomial,
    MvNormal,
    NegativeBinomial,
    Normal,
    Poisson,
)
from bayesmc.kernels.conjugate_data import Elements


class Evaluation(Protocol):
    """A child with the node at its neutral value."""

    data: Elements

    def get(self, parameter: str, event_ndim: int = 0) -> np.ndarray:
        """A parameter, shape ``(lead, *plates, ...)``."""

    def whitened(self, residual: np.ndarray) -> np.ndarray:
        """Residuals divided by the Cholesky factor of the noise."""

    def tally(self, states: int) -> np.ndarray:
        """How often each state came, for every element of the node."""


@dataclass(frozen=True)
class Pair:
    """A child's parameter that a node may enter.

    Attributes
    ----------
    kind : str
        Of the node's full conditional (``conjugate_kinds``).
    child : type
        Family.
    parameter : str
        As the family calls it.
    form : str
        How the node must enter: ``affine``, ``power`` (``c * x**p``), ``multiple`` (``c * x``, with one
        number c for a whole matrix), ``copy`` or ``pick`` (of the states that were seen, see
        ``conjugate_picks``, which knows what else need not be read by all elements).
    statistic : callable
        What the child adds, by kind. Mean: a residual divided by the noise. Scale: the power of the
        parameter before the exponential, and the exponential's coefficient. Share: successes and failures.
        Shares: counts of every category. Covariance: degrees of freedom.
    exponent : float
        For a scale, the power of the parameter in the exponential.
    transform : str
        What is done to the child's values first.
    squares : bool
        Whether squares of the values are summed.
    by_label : bool
        Whether sums by a label suffice.
    """

    kind: str
    child: type
    parameter: str
    form: str
    statistic: Callable[..., Any]
    exponent: float = 0.0
    transform: str = "value"
    squares: bool = False
    by_label: bool = True

    @property
    def words(self) -> str:
        return f"{self.child.__name__} {self.parameter}"


def _over_scale(e: Evaluation, residual: np.ndarray) -> np.ndarray:
    return (residual / e.get("scale"))[..., None]


def _over_factor(e: Evaluation, residual: np.ndarray) -> np.ndarray:
    return e.whitened(residual)


def _rate_of_counts(e: Evaluation) -> tuple[Any, Any]:
    return e.data.total, e.data.count * e.get("rate")


def _rate_of_times(e: Evaluation) -> tuple[Any, Any]:
    return e.data.count, e.data.total * e.get("rate")


def _rate_of_gammas(e: Evaluation) -> tuple[Any, Any]:
    return e.data.count * e.get("concentration"), e.data.total * e.get("rate")


def _scale_of_inverse_gammas(e: Evaluation) -> tuple[Any, Any]:
    return e.data.count * e.get("concentration"), e.data.total * e.get("scale")


def _scale_about_loc(e: Evaluation) -> tuple[Any, Any]:
    return -e.data.count, 0.5 * e.data.squares(e.get("loc")) / e.get("scale") ** 2


def _scale_about_zero(e: Evaluation) -> tuple[Any, Any]:
    return -e.data.count, 0.5 * e.data.squares(np.zeros(())) / e.get("scale") ** 2


def _absolute_scale(e: Evaluation) -> tuple[Any, Any]:
    return -e.data.count, np.abs(e.data.deviations(e.get("loc"))) / e.get("scale")


def _scale_of_vectors(e: Evaluation) -> tuple[Any, Any]:
    loc, tril = e.get("loc", 1), e.get("scale_tril", 2)
    return -loc.shape[-1] * e.data.count, 0.5 * e.data.mahalanobis(loc, tril)


def _variance_of_vectors(e: Evaluation) -> tuple[Any, Any]:
    power, coefficient = _scale_of_vectors(e)
    return 0.5 * power, coefficient


def _of_trials(e: Evaluation) -> tuple[Any, Any]:
    return e.data.total, e.data.count * e.get("total_count") - e.data.total


def _of_one_trial(e: Evaluation) -> tuple[Any, Any]:
    return e.data.total, e.data.count - e.data.total


def _one_success(e: Evaluation) -> tuple[Any, Any]:
    return e.data.count, np.zeros(())


def _of_waiting(e: Evaluation) -> tuple[Any, Any]:
    return e.data.count, e.data.total


def _of_failures(e: Evaluation) -> tuple[Any, Any]:
    return e.data.total, e.data.count * e.get("total_count")


def _categories(e: Evaluation) -> np.ndarray:
    return e.tally(e.get("probs", 1).shape[-1])


def _counts(e: Evaluation) -> np.ndarray:
    return e.data.total


def _one_each(e: Evaluation) -> np.ndarray:
    return e.data.count


PAIRS: tuple[Pair, ...] = (
    Pair("mean", Normal, "loc", "affine", _over_scale),
    Pair("mean", LogNormal, "loc", "affine", _over_scale, transform="log"),
    Pair("mean", MvNormal, "loc", "affine", _over_factor),
    Pair("scale", Poisson, "rate", "power", _rate_of_counts, 1.0),
    Pair("scale", Exponential, "rate", "power", _rate_of_times, 1.0),
    Pair("scale", Gamma, "rate", "power", _rate_of_gammas, 1.0),
    Pair("scale", InverseGamma, "scale", "power", _scale_of_inverse_gammas, 1.0, "reciprocal"),
    Pair("scale", Normal, "scale", "power", _scale_about_loc, -2.0, squares=True),
    Pair("scale", LogNormal, "scale", "power", _scale_about_loc, -2.0, "log", True),
    Pair("scale", HalfNormal, "scale", "power", _scale_about_zero, -2.0, squares=True),
    Pair("scale", Laplace, "scale", "power", _absolute_scale, -1.0, by_label=False),
    Pair("scale", MvNormal, "cov", "power", _variance_of_vectors, -1.0, squares=True),
    Pair("scale", MvNormal, "scale_tril", "power", _scale_of_vectors, -2.0, squares=True),
    Pair("scale", MvNormal, "scale_diag", "power", _scale_of_vectors, -2.0, squares=True),
    Pair("share", Bernoulli, "probs", "copy", _of_one_trial),
    Pair("share", Binomial, "probs", "copy", _of_trials),
    Pair("share", Geometric, "probs", "copy", _of_waiting),
    Pair("share", NegativeBinomial, "probs", "copy", _of_failures),
    Pair("share", Categorical, "probs", "pick", _one_success, by_label=False),
    Pair("shares", Categorical, "probs", "copy", _categories, by_label=False),
    Pair("shares", Multinomial, "probs", "copy", _counts, by_label=False),
    Pair("covariance", MvNormal, "cov", "multiple", _one_each, squares=True),
)
