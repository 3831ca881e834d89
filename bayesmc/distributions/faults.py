"""What is wrong with what a distribution is asked, told once something has failed and not before."""

from __future__ import annotations

import inspect
from typing import Any, Protocol

import numpy as np

from bayesmc.distributions.transforms import Transform
from bayesmc.errors import BayesmcError, ParameterError, ShapeError, UnsupportedError
from bayesmc.shapes import Shape


class Asked(Protocol):
    """What is looked at of a distribution."""

    batch_shape: Shape
    event_shape: Shape

    @property
    def _family(self) -> str: ...

    @property
    def transform(self) -> Transform: ...


def no_marginals(dist: Asked) -> UnsupportedError:
    """That a family cannot say what some components of a vector are by themselves."""
    return UnsupportedError(
        f"{dist._family} has no marginal of some components; a vector seen in part needs an MvNormal, or a "
        "Joint of parts that are seen in full or not at all"
    )


def explain_sample(dist: Asked, sample_shape: Any, error: Exception) -> None:
    """Raise what is wrong with ``sample_shape``, if that is what failed."""
    sizes = np.asarray(sample_shape)
    if isinstance(error, BayesmcError) or (
        sizes.size == 0 or sizes.dtype.kind in "iu" and sizes.min() >= 0
    ):
        return
    raise ShapeError(
        f"{dist._family}.sample: sample_shape must be a nonnegative whole number or a tuple of "
        f"them; got {sample_shape!r}"
    ) from error


def explain_log_prob(dist: Asked, x: Any, error: Exception) -> None:
    """Raise what is wrong with the values ``x``, if that is what failed."""
    if isinstance(error, BayesmcError):
        return
    values = _numbers(dist, "log_prob", "values", x, error)
    cut = max(values.ndim - len(dist.event_shape), 0)
    lead, event = values.shape[:cut], values.shape[cut:]
    if event != dist.event_shape:
        raise ShapeError(
            f"{dist._family}.log_prob: the values have shape {values.shape}, not "
            f"(..., *{dist.event_shape})"
        ) from error
    try:
        np.broadcast_shapes(lead, dist.batch_shape)
    except ValueError:
        raise ShapeError(
            f"{dist._family}.log_prob: values of shape {values.shape} do not broadcast with "
            f"batch shape {dist.batch_shape}; add an axis, as in x[:, None]"
        ) from error


def mapped(dist: Asked, what: str, value: Any) -> np.ndarray:
    """A map of the ``transform``, whose faults are told as the family's."""
    transform = dist.transform
    free = what != "unconstrain"
    try:
        return getattr(transform, what)(value)
    except (TypeError, ValueError) as error:
        noun = "free values" if free else "values"
        shape = _numbers(dist, what, noun, value, error).shape
        wanted = transform.unconstrained_shape if free else dist.event_shape
        if shape[max(len(shape) - len(wanted), 0) :] == wanted:
            fault = f"does not broadcast with batch shape {dist.batch_shape}"
        else:
            fault = f"is not (..., *{wanted})"
        raise ShapeError(
            f"{dist._family}.{what}: the {noun} have shape {shape}, which {fault}"
        ) from error


def missing(owner: Any, what: str) -> NotImplementedError:
    """The error for a method that a class of one's own must have."""
    return NotImplementedError(f"{type(owner).__name__} has no {what}; write one")


def check_form(family: type) -> None:
    """Raise where what a class is given would not be called, or not as a family's ``log_density`` is.

    Raises
    ------
    TypeError
    """
    for asked, own in (("log_prob", "_log_prob"), ("sample", "_sample")):
        if (
            asked in family.__dict__
        ):  # engines have ways round it, so it would count here and not there
            raise TypeError(
                f"{family.__name__}.{asked} checks its arguments and calls {own}: define {own} instead"
            )
    form = family.__dict__.get("log_density")
    if form is None:
        return
    name = f"{family.__name__}.log_density"
    if not isinstance(form, staticmethod):
        raise TypeError(f"{name}(x, **parameters) has no self; put @staticmethod above it")
    _, *given = inspect.signature(form.__func__).parameters
    wanted = list(getattr(family, "parameter_ndim", {}))
    if set(given) != set(wanted):
        raise TypeError(
            f"{name}(x, {', '.join(given)}): parameter_ndim of {family.__name__} names "
            f"{', '.join(wanted) or 'no parameters'}; name the same in both, as in "
            f"parameter_ndim = {dict.fromkeys(given, 0)}"
        )


def check_form_shape(dist: Asked, x: np.ndarray, found: np.ndarray) -> None:
    """Raise where a log density does not keep the axes of its values: a sum over all draws is no density.

    Raises
    ------
    ShapeError
    """
    lead = x.shape[: x.ndim - len(dist.event_shape)]
    wanted = np.broadcast_shapes(lead, dist.batch_shape)
    if np.shape(found) != wanted:
        raise ShapeError(
            f"{dist._family}.log_density gives shape {np.shape(found)} for values of shape {x.shape} and "
            f"parameters of batch shape {dist.batch_shape}, not {wanted}; work element by element, and sum "
            f"over {'the axes of one value only (axis=-1)' if dist.event_shape else 'nothing'}"
        )


# ---- private ------------------------------------------------------------------------------------


def _numbers(dist: Asked, what: str, noun: str, value: Any, error: Exception) -> np.ndarray:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(
            f"{dist._family}.{what}: the {noun} must be numbers; got {value!r:.80}"
        ) from error
