"""Is the mean of a random answer what it should be? Any figures that can be worked out again and again.

For answers that come without errors of their own, and for single steps of an algorithm: a smoother's means, a
resampling scheme's offspring, a user's estimator of an integral. Only means are judged; posteriors with
draws are for `compare`, estimates of the evidence for `unbiased_evidence_test`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bayesmc.errors import ShapeError
from bayesmc.randomness import seed_sequence
from bayesmc.testing.kernels.joint import check_sizes
from bayesmc.testing.posteriors.skewed import mean_p_value
from bayesmc.testing.verdict import Comparison, Verdict, as_real, check_level, counted

_CALL = "repeated_test"
#: relative difference of figures without chance in them
_ROUNDING = 1e-9
#: numbers above it are judged in units of the largest
_HUGE = 1e90
#: standard errors beyond which it does not matter how many
_FAR = 1e12


def repeated_test(
    estimate: Callable[[np.random.Generator], Any],
    exact: Any,
    *,
    replications: int = 200,
    accuracy: float = 0.0,
    alpha: float = 1e-3,
    rng: Any = None,
) -> Verdict:
    """Hold the mean of a random answer over many runs against the exact answer.

    **False-alarm rate.** At most ``alpha`` for all figures of a call (Holm's method), in the limit of many
    runs, where the answer is unbiased. A mean is judged in each tail by Student's t and by Hall's
    transformation of it, which removes skewness to first order; the larger p-value counts. It is exact for
    normal figures. What ``accuracy`` explains does not count. A figure that is the same in every run has no
    chance in it, and must agree to 1e-9 (and ``accuracy``); leave out probabilities so small that all runs
    together may miss the event.

    An answer may be right in the limit of many particles and biased before, as averages by normalised weights
    are: then take many particles, few runs, or an ``accuracy``.

    Parameters
    ----------
    estimate : callable
        ``estimate(rng)`` returns numbers: an array, or a dict of them.
    exact : array_like or dict
        Of the same shapes.
    replications : int
        At least 2; few tell of large errors only.
    accuracy : float
        Error that is allowed, in units of ``max(1, |exact|)``.
    alpha : float
        Chance of any false alarm.
    rng : optional
        Seed or generator.

    Returns
    -------
    Verdict
        True where no mean deviates.

    Raises
    ------
    ShapeError
        An answer has other names or shapes than the exact one.
    ValueError
        An exact figure, or the accuracy, is no number.

    References
    ----------
    Hall (1992), On the removal of skewness by transformation, JRSS B 54, eq. 2.4; Holm (1979), Scand. J.
    Statist. 6.

    Examples
    --------
    Is each particle's share of offspring its weight?

    >>> import numpy as np
    >>> from bayesmc.resampling import systematic
    >>> from bayesmc.testing import repeated_test
    >>> weights = np.array([0.55, 0.25, 0.2])
    >>> def offspring(rng):
    ...     return np.bincount(systematic(weights, 4, rng), minlength=3) / 4
    >>> bool(repeated_test(offspring, weights, rng=0))
    True
    """
    if not callable(estimate):
        raise TypeError(f"{_CALL}: estimate={estimate!r}; give a function estimate(rng)")
    check_sizes(_CALL, replications=(replications, 2))
    if not (math.isfinite(accuracy) and accuracy >= 0.0):
        raise ValueError(f"{_CALL}(accuracy={accuracy!r}): give a number, 0 or more")
    check_level(_CALL, alpha)
    wanted = _named("exact", exact)
    if not sum(value.size for value in wanted.values()):
        raise ValueError(f"{_CALL}: exact={exact!r} holds no figure; give one number or more")
    for name, value in wanted.items():
        if not np.isfinite(value).all():
            raise ValueError(f"{_CALL}: exact{_of(name)} holds what is no number: {value}")
    runs: dict[str, list[np.ndarray]] = {name: [] for name in wanted}
    for child in seed_sequence(rng).spawn(replications):
        found = _named("estimate(rng)", estimate(np.random.default_rng(child)))
        _check(found, wanted)
        for name, value in found.items():
            runs[name].append(value)
    comparisons = [
        _judged(f"mean{_of(name)}{list(at) if at else ''}", np.array([r[at] for r in rows]),
                float(wanted[name][at]), accuracy)
        for name, rows in runs.items()
        for at in np.ndindex(wanted[name].shape)
    ]  # fmt: skip
    return counted(Verdict(_CALL, alpha, comparisons))


# ---- private ------------------------------------------------------------------------------------


def _named(what: str, answer: Any) -> dict[str, np.ndarray]:
    named = answer if isinstance(answer, Mapping) else {"": answer}
    try:
        return {name: as_real(f"{what}{_of(name)}", value) for name, value in named.items()}
    except TypeError as error:
        raise TypeError(
            f"{_CALL}: {error}, or a dict of name -> numbers, as in {_CALL}(estimate, exact) with a function "
            "estimate(rng)"
        ) from None


def _of(name: str) -> str:
    return f" of {name!r}" if name else ""


def _check(found: Mapping[str, np.ndarray], wanted: Mapping[str, np.ndarray]) -> None:
    if found.keys() != wanted.keys():
        raise ShapeError(
            f"{_CALL}: estimate(rng) returned {sorted(found)}, exact holds {sorted(wanted)}; return the "
            "same names"
        )
    for name, value in found.items():
        if value.shape != wanted[name].shape:
            raise ShapeError(
                f"{_CALL}: estimate(rng) returned{_of(name)} shape {value.shape}, exact has "
                f"{wanted[name].shape}; return one number for each exact one"
            )


def _judged(what: str, values: np.ndarray, exact: float, accuracy: float) -> Comparison:
    """The mean of some runs against the exact figure."""
    count, mean = len(values), float(values.mean())
    largest = float(np.abs(values).max())
    if not math.isfinite(mean):
        return Comparison(what, mean, exact, math.inf, 0.0)
    if largest > _HUGE:  # squares and cubes would overflow
        allowed = accuracy * min(1.0, max(1.0, abs(exact)) / largest)
        shrunk = _judged(what, values / largest, exact / largest, allowed)
        return Comparison(what, mean, exact, shrunk.errors, shrunk.p_value)
    unit = max(1.0, abs(exact))
    off = mean - exact
    excess = math.copysign(max(abs(off) - accuracy * unit, 0.0), off)
    spread = float(values.std(ddof=1))
    if spread <= _ROUNDING * unit:
        errors, p_value = (0.0, 1.0) if abs(excess) <= _ROUNDING * unit else (math.inf, 0.0)
        return Comparison(what, mean, exact, errors, p_value)
    z = min(max(excess * math.sqrt(count) / spread, -_FAR), _FAR)
    return Comparison(what, mean, exact, abs(z), mean_p_value(values, z))
