"""What the functions of this room share: densities given in any of three ways, draws in chunks."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, as_distribution
from bayesmc.errors import (
    BayesmcError,
    DensityError,
    ParameterError,
    QueryError,
    ShapeError,
    SupportWarning,
    UnsupportedError,
)
from bayesmc.randomness import Purpose, seed_sequence, stream
from bayesmc.shapes import Shape

CHUNK = 32_768  # numbers held at a time, and draws at most


def single(call: str, name: str, dist: Any) -> Distribution:
    """``dist`` as one distribution, not a batch."""
    found = as_distribution(dist)
    if found is None:
        raise ParameterError(f"{call}: {name} must be a distribution; got {type(dist).__name__}")
    if found.batch_shape:
        raise ShapeError(
            f"{call}: {name} is a batch of shape {found.batch_shape}; give one distribution at a time"
        )
    return found


def log_density(call: str, name: str, density: Any) -> Callable[[np.ndarray], np.ndarray]:
    """The log density of a distribution, or a function that is one, checked on use."""
    function = density
    if not callable(density) or as_distribution(density) is not None:
        function = single(call, name, density).log_prob

    def evaluate(points: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            value = _called(call, f"the log density {name}", function, points)
        value = _real(call, f"the log density {name}", value)
        if value.shape not in ((), points.shape[:1]):
            raise ShapeError(
                f"{call}: {name} returned shape {value.shape} for {len(points)} points of shape "
                f"{points.shape[1:]}; it must give one log density per point"
            )
        bad = np.broadcast_to(np.isnan(value) | (value == np.inf), points.shape[:1])
        if bad.any():
            index = int(np.argmax(bad))
            shown = np.broadcast_to(value, points.shape[:1])[index]
            raise DensityError(
                f"{call}: the log density {name} is {shown} at {show(points[index])}; it must be a "
                "number or minus infinity"
            )
        return np.broadcast_to(value, points.shape[:1])

    return evaluate


def evaluate(call: str, function: Callable[..., Any], points: np.ndarray) -> np.ndarray:
    """A function on points of shape (n, ...), whose result must have the same first axis."""
    value = np.asarray(_called(call, "the function", function, points))
    if value.dtype != bool:
        value = _real(call, "the function", value)
    if value.ndim < 1 or len(value) != len(points):
        raise QueryError(
            f"{call}: the function returned shape {value.shape} for {len(points)} points; it must "
            "act on arrays, with the points along the first axis"
        )
    return value


def check_proposal(call: str, density: Any, proposal: Distribution) -> None:
    """Refuse a proposal of another kind than a declared density; warn where it cannot reach.

    Raises
    ------
    UnsupportedError
        One of the two is discrete and the other continuous.

    Warns
    -----
    SupportWarning
        The proposal's support is narrower than the density's.
    """
    target = as_distribution(density)
    if target is None:  # a function declares nothing
        return
    names = [type(dist).__name__ for dist in (target, proposal)]
    if target.is_discrete != proposal.is_discrete:
        kinds = ["discrete" if dist.is_discrete else "continuous" for dist in (target, proposal)]
        raise UnsupportedError(
            f"{call}: the density {names[0]} is {kinds[0]} and the proposal {names[1]} {kinds[1]}, so "
            f"their ratio is no weight; give a proposal on {target.support.describe()}"
        )
    if not proposal.support.covers(target.support):
        warnings.warn(
            f"{call}: the proposal {names[1]} lies on {proposal.support.describe()}, the density "
            f"{names[0]} on {target.support.describe()}; what lies outside is never reached, and the "
            "weights cannot show it. Use a wider proposal, or declare the density's support, as in "
            "Density(log_prob, support=(low, high))",
            SupportWarning,
            stacklevel=3,
        )


def check_callable(call: str, function: Any) -> None:
    """Refuse what is no function."""
    if not callable(function):
        raise ParameterError(
            f"{call}: function must be callable, on an array of points; got {function!r:.80}"
        )


def number(call: str, name: str, value: Any) -> float:
    """``value`` as one float."""
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ParameterError(f"{call}: {name} must be a number; got {value!r:.80}") from None


def chunk_sizes(draws: int, event_shape: Shape) -> Iterator[int]:
    """Sizes that add up to ``draws``, none too large for memory."""
    step = max(1, CHUNK // max(1, int(np.prod(event_shape))))
    for start in range(0, draws, step):
        yield min(step, draws - start)


def streams(rng: Any) -> Iterator[np.random.Generator]:
    """A generator for each chunk."""
    seed, unit = seed_sequence(rng), 0
    while True:
        yield stream(seed, Purpose.SAMPLE, unit)
        unit += 1


def count_of(call: str, draws: Any, least: int, name: str = "draws") -> int:
    """``draws`` as a whole number of at least ``least``."""
    try:
        whole = not isinstance(draws, (bool, str)) and draws == int(draws) and draws >= least
    except (TypeError, ValueError, OverflowError):
        whole = False
    if not whole:
        raise ParameterError(
            f"{call}: {name} must be a whole number of at least {least}; got {draws!r}"
        )
    return int(draws)


def _called(call: str, what: str, function: Callable[..., Any], points: np.ndarray) -> Any:
    try:
        return function(points)
    except BayesmcError:
        raise
    except Exception as error:
        raise QueryError(
            f"{call}: {what} fails on arrays of shape {points.shape} ({type(error).__name__}: {error}); "
            "it gets many points at once, so write it with NumPy (np.where for if, np.maximum for max)"
        ) from error


def _real(call: str, what: str, value: Any) -> np.ndarray:
    """What a function returned, as floats; complex numbers lose nothing unsaid."""
    array = np.asarray(value)
    if array.dtype.kind == "c":
        raise QueryError(
            f"{call}: {what} returned complex numbers; return their real and imaginary parts, "
            "np.stack([z.real, z.imag], axis=-1)"
        )
    try:
        if array.dtype.kind in "biufO":
            return array.astype(float)
    except (TypeError, ValueError):
        pass
    raise QueryError(f"{call}: {what} returned {value!r:.60}; it must return real numbers")


def show(point: np.ndarray) -> str:
    """A point in a message."""
    return " ".join(np.array2string(np.asarray(point), precision=6, threshold=8).split())
