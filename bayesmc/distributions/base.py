"""What a distribution is: parameters with a batch shape, and the few things engines ask of it.

Shapes are said once here: a sample has shape ``sample_shape + batch_shape + event_shape`` and a
log probability the broadcast of the value's and the distribution's batch. A family supplies
``_sample``, ``_log_prob``, ``mean``, ``var`` and ``support``; it knows nothing of nodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, ClassVar

import numpy as np

from bayesmc.distributions import faults
from bayesmc.distributions.parameters import check_keywords, read_floats, signature
from bayesmc.distributions.support import Support
from bayesmc.distributions.transforms import Transform, transform_of
from bayesmc.errors import ParameterError, ShapeError, UnsupportedError
from bayesmc.expression.array import TracedCall, is_traced
from bayesmc.shapes import Shape, as_shape, at_index, broadcast_shapes, broadcasts_to, first_index
from bayesmc.states import NumberArray

_mark_invalid: ContextVar[bool] = ContextVar("mark_invalid", default=False)


class Distribution:
    """A batch of probability distributions of one family.

    Attributes
    ----------
    batch_shape, event_shape : tuple of int
        ``log_prob`` has the batch shape; one draw has ``batch_shape + event_shape``.
    is_discrete : bool
        Whether the values are isolated points.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dist: bmc.Distribution = bmc.Normal([0.0, 10.0], 1.0)
    >>> dist.batch_shape, dist.sample(rng=0, sample_shape=3).shape, dist.mean.tolist()
    ((2,), (3, 2), [0.0, 10.0])
    """

    is_discrete: ClassVar[bool] = False
    #: whether it has marginals of some components, and can draw the others given those
    splits: ClassVar[bool] = False
    #: parameter name -> number of axes that one parameter value has (0 for a scalar)
    parameter_ndim: ClassVar[dict[str, int]] = {}

    event_shape: Shape = ()
    batch_shape: Shape = ()
    #: a family's log density as a NumPy function of a value and the parameters by name, for engines that read
    #: its form (conjugate updates, derivatives); ``log_prob`` is it, too, unless ``_log_prob`` is given
    log_density: ClassVar[Callable[..., Any] | None] = None
    #: batch elements with parameters out of range (only while these are marked), else None
    invalid: np.ndarray | None = None
    problem: ParameterError | None = None
    #: batch elements without noise: they can be drawn, but their density is none; ``invalid``, too
    noiseless: np.ndarray | None = None

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        faults.check_form(cls)

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        """A new distribution; of traced parameters, a record of the call in its place."""
        if kwargs:
            check_keywords(cls, kwargs.keys())
        if not _may_be_traced(args) and not (kwargs and _may_be_traced(kwargs.values())):
            return super().__new__(cls)
        if any(map(is_traced, args)) or any(map(is_traced, kwargs.values())):
            bound = signature(cls).bind(*args, **kwargs)  # type: ignore[arg-type]
            bound.apply_defaults()
            return TracedCall(cls, dict(bound.arguments))
        return super().__new__(cls)

    def sample(self, rng: Any = None, sample_shape: int | Shape = ()) -> np.ndarray:
        """Independent draws, shape ``sample_shape + batch_shape + event_shape``.

        Parameters
        ----------
        rng : seed, Generator or None
        sample_shape : int or tuple of int
        """
        try:
            shape = as_shape(sample_shape) + self.batch_shape
            return self._sample(np.random.default_rng(rng), shape)
        except (TypeError, ValueError) as error:
            faults.explain_sample(self, sample_shape, error)
            raise

    def sample_to(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        """Draws of shape ``shape + event_shape``, where the batch broadcasts to ``shape``.

        Every element is an independent draw, also along axes that the parameters do not have.
        """
        if not broadcasts_to(self.batch_shape, shape):
            raise ShapeError(f"batch shape {self.batch_shape} does not broadcast to {shape}")
        return self._sample(rng, shape)

    def log_prob(self, x: Any) -> np.ndarray:
        """Log density (or log probability) at ``x``: minus infinity outside the support.

        ``x`` has shape ``(..., *event_shape)``; the result broadcasts ``...`` and the batch.
        """
        self._require_noise()
        # Outside the support a density takes logarithms of zero and worse: that is no accident.
        try:
            with np.errstate(all="ignore"):
                return self._log_prob(np.asarray(x))
        except (TypeError, ValueError, IndexError) as error:
            faults.explain_log_prob(self, x, error)
            raise

    def log_prob_unchecked(self, x: np.ndarray) -> np.ndarray:
        """``log_prob`` of an array, where the caller has silenced floating-point warnings."""
        return self._log_prob(x)

    def log_prob_of(self, x: np.ndarray, present: np.ndarray) -> np.ndarray:
        raise faults.no_marginals(self)

    def completed(self, *args: Any, **kwargs: Any) -> np.ndarray:
        raise faults.no_marginals(self)

    @property
    def mean(self) -> np.ndarray:
        """Mean, shape ``batch_shape + event_shape``."""
        raise UnsupportedError(f"{type(self).__name__} has no closed mean; average draws instead")

    @property
    def var(self) -> np.ndarray:
        """Variance of each component, shape ``batch_shape + event_shape``."""
        raise UnsupportedError(f"{type(self).__name__} has no closed variance; use draws instead")

    @property
    def support(self) -> Support:
        """Where the mass lies."""
        raise faults.missing(self, "property support")

    @property
    def transform(self) -> Transform:
        """The map between unconstrained numbers and values, for samplers that move freely.

        Raises
        ------
        UnsupportedError
            Discrete values have no unconstrained space.
        """
        if self.is_discrete:
            raise UnsupportedError(
                f"{type(self).__name__}: discrete values ({self.support.describe()}) have no "
                "unconstrained space; enumerate them or update them by Gibbs sampling"
            )
        return transform_of(self.support, self.event_shape)

    def constrain(self, u: Any) -> np.ndarray:
        """The value at unconstrained ``u``, always inside the support.

        Parameters
        ----------
        u : array_like, shape (..., *transform.unconstrained_shape)

        Returns
        -------
        ndarray, shape (..., *event_shape)
            ``...`` broadcast with the batch of bounds that depend on parents.

        References
        ----------
        Stan Reference Manual, version 2.36, chapter "Constraint Transforms".

        Examples
        --------
        >>> import bayesmc as bmc
        >>> rate = bmc.Gamma(2.0, 1.0)
        >>> rate.constrain(0.0).tolist(), rate.unconstrain(1.0).tolist()
        (1.0, 0.0)

        The density of ``u`` is that of the value times the volume that the map stretches:

        >>> float((rate.log_prob(rate.constrain(0.5)) + rate.log_abs_det_jacobian(0.5)).round(4))
        -0.6487
        """
        return faults.mapped(self, "constrain", u)

    def unconstrain(self, x: Any) -> np.ndarray:
        """The unconstrained numbers behind ``x``: the inverse of ``constrain``.

        Outside the open support the numbers are not finite: infinite or NaN at a bound, NaN beyond.

        Parameters
        ----------
        x : array_like, shape (..., *event_shape)

        Returns
        -------
        ndarray, shape (..., *transform.unconstrained_shape)
        """
        return faults.mapped(self, "unconstrain", x)

    def log_abs_det_jacobian(self, u: Any) -> np.ndarray:
        """``log |det dx/du|`` at ``u``, summed over the event.

        Parameters
        ----------
        u : array_like, shape (..., *transform.unconstrained_shape)

        Returns
        -------
        ndarray, shape (...)
            ``...`` broadcast with the batch of bounds that depend on parents.
        """
        return faults.mapped(self, "log_abs_det_jacobian", u)

    def cdf(self, x: Any) -> np.ndarray:
        """Probability of a value at most ``x``."""
        raise UnsupportedError(f"{type(self).__name__} has no closed cdf")

    def ppf(self, q: Any) -> np.ndarray:
        """Quantile: the smallest value whose cdf reaches ``q``."""
        raise UnsupportedError(f"{type(self).__name__} has no closed ppf")

    @property
    def probs_table(self) -> np.ndarray | None:
        """Probabilities of ``support.values``: ``batch_shape + (size,)``; None if infinite."""
        values = self.support.values
        if values is None or self.event_shape:
            return None
        points = values.reshape((-1,) + (1,) * len(self.batch_shape))
        return np.moveaxis(np.exp(self.log_prob(points)), 0, -1)

    def parameters(self) -> list[tuple[np.ndarray, int]]:
        """Each parameter with the number of its trailing axes that are not batch.

        Two distributions of one family with equal parameters are equal; ``validate`` relies on it.
        """
        return [(np.asarray(getattr(self, key)), n) for key, n in self.parameter_ndim.items()]

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(batch_shape={self.batch_shape}, event_shape={self.event_shape})"
        )

    # ---- what a family supplies -------------------------------------------------------------

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        """New writable draws, shape ``shape + event_shape``; the batch broadcasts to ``shape``."""
        raise faults.missing(self, "method _sample(rng, shape)")

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        form = type(self).log_density
        if form is None:
            raise faults.missing(self, "log_density(x, **parameters)")
        found = form(x, **{name: getattr(self, name) for name in self.parameter_ndim})
        faults.check_form_shape(self, x, found)
        return found

    # ---- what a family's constructor calls --------------------------------------------------

    @property
    def _family(self) -> str:
        """The name in messages."""
        return type(self).__name__

    def _set_batch(self, *shapes: Shape) -> None:
        try:
            self.batch_shape = broadcast_shapes(*shapes)
        except ValueError:
            raise ShapeError(
                f"{type(self).__name__}: parameter shapes "
                f"{', '.join(map(str, shapes))} do not broadcast together"
            ) from None

    def _check(
        self, name: str, value: np.ndarray, ok: Any, fallback: Any, requirement: str
    ) -> np.ndarray:
        """``value`` where ``ok``; otherwise raise, or mark the element and use ``fallback``.

        ``ok`` has the parameter's batch shape, ``value`` that and the parameter's own axes.
        Call it after ``_set_batch``.
        """
        if ok.all():
            return value
        index = first_index(~ok)
        self._reject(name, value[index], ~ok, requirement)
        extra = value.ndim - ok.ndim
        return np.where(ok.reshape(ok.shape + (1,) * extra), value, fallback)

    def _reject(self, name: str, value: Any, bad: Any, requirement: str) -> None:
        """Raise for the first ``bad`` element, whose parameter is ``value``; or mark them all."""
        index = first_index(bad)
        error = ParameterError(
            f"{self._family}: {name} must be {requirement}; got {_short(value)}{at_index(index)}",
            index,
            value,
        )
        if not _mark_invalid.get():
            raise error
        bad = np.broadcast_to(bad, self.batch_shape)
        self.invalid = bad if self.invalid is None else self.invalid | bad
        self.problem = self.problem or error

    def _require_noise(self) -> None:
        """Raise for elements without noise, unless these are marked only."""
        if self.noiseless is not None and not _mark_invalid.get():
            assert self.problem is not None
            raise self.problem

    def _without_noise(self, name: str, none: np.ndarray) -> None:
        """Note elements whose distribution is a point; what asks for their density hears of it.

        Call it after ``_set_batch`` and after other checks.
        """
        if self.invalid is not None:
            none = none & ~self.invalid
        if not none.any():
            return
        index = first_index(none)
        error = ParameterError(
            f"{self._family}: {name} is 0{at_index(index)}: a point without noise, which has no density; "
            "declare a function that returns the value, or give it a little noise (Exact() and Kalman "
            "filters take it as it is)", index, 0.0,
        )  # fmt: skip
        self.noiseless = none = np.broadcast_to(none, self.batch_shape)
        self.invalid = none if self.invalid is None else self.invalid | none
        self.problem = self.problem or error

    def _finite(self, name: str, value: np.ndarray, wanted: str = "finite") -> np.ndarray:
        """A scalar parameter that must be finite."""
        if all_finite(value):  # cheaper than looking at every element
            return value
        return self._check(name, value, np.isfinite(value), 0.0, wanted)

    def _positive(self, name: str, value: np.ndarray) -> np.ndarray:
        """A scalar parameter that must be positive and finite."""
        if value.ndim == 0 and 0 < value.item() < math.inf:
            return value
        ok = (value > 0) & (value < np.inf)
        return self._check(name, value, ok, 1.0, "positive and finite")

    def _unit(self, name: str, value: np.ndarray) -> np.ndarray:
        """A scalar parameter that must be a probability."""
        return self._check(name, value, (value >= 0) & (value <= 1), 0.5, "between 0 and 1")

    def _adopt(self, part: Distribution, mask: Any = None) -> None:
        """Take over the marks of a ``part`` of this distribution (``mask`` in our batch)."""
        if part.invalid is None:
            return
        part._require_noise()
        bad = np.broadcast_to(part.invalid if mask is None else mask, self.batch_shape)
        self.invalid = bad if self.invalid is None else self.invalid | bad
        self.problem = self.problem or part.problem


@contextmanager
def marking_invalid() -> Iterator[None]:
    """Within it, bad parameters are marked on the distribution instead of raised.

    Engines evaluate nodes at configurations that may have probability zero, where a function may
    rightly return nonsense; they look at ``invalid`` and raise only where the configuration counts.
    """
    token = _mark_invalid.set(True)
    try:
        yield
    finally:
        _mark_invalid.reset(token)


_FLOAT = np.dtype(float)
#: numbers whose scalar product is taken by one thread, and faster than a sum
_FEW = 8192
_ONES = np.ones(_FEW)


#: types of parameters that are what they seem
_PLAIN = frozenset({np.ndarray, NumberArray, np.float64, float, int})


def _may_be_traced(parameters: Iterable[Any]) -> bool:
    """Whether any may be a stand-in; most calls have plain numbers only."""
    for parameter in parameters:  # a loop, since this is done for every distribution there is
        if type(parameter) not in _PLAIN:
            return True
    return False


def as_float(value: Any) -> np.ndarray:
    """A parameter as a float array; what cannot become one raises and says what it is."""
    if type(value) is np.ndarray and value.dtype is _FLOAT:
        return value
    return read_floats(value)


def all_finite(values: np.ndarray) -> bool:
    """Whether numbers are all finite; numbers so large that their sum overflows may pass for not."""
    if not values.ndim:
        return math.isfinite(values)
    if values.ndim == 1 and values.size <= _FEW:
        return math.isfinite(
            values.dot(_ONES[: values.size])
        )  # five times faster than a sum, for short arrays
    return math.isfinite(np.add.reduce(values, axis=None))


def as_quantile(q: Any) -> np.ndarray:
    """Probabilities as floats, NaN where they are none."""
    q = np.asarray(q, dtype=float)
    return np.where((q >= 0) & (q <= 1), q, np.nan)


def as_whole(value: Any) -> tuple[np.ndarray, np.ndarray]:
    """A parameter as int64, and where it is a whole number (elsewhere it reads 0)."""
    value = np.asarray(value)
    if value.dtype.kind in "iub":
        return value.astype(np.int64, copy=False), np.ones(value.shape, dtype=bool)
    value = np.asarray(value, dtype=float)
    ok = np.isfinite(value) & (value == np.floor(value)) & (np.abs(value) < 2.0**62)
    return np.where(ok, value, 0.0).astype(np.int64), ok


def draw_to(
    draw: Callable[[Shape], np.ndarray], batch: Shape, shape: Shape, event_shape: Shape
) -> np.ndarray:
    """Draws of shape ``shape + event_shape`` from a sampler that only knows leading sample axes.

    ``draw(sample_shape)`` returns ``sample_shape + batch + event_shape``. Axes along which the
    batch has size one are drawn as further sample axes and moved into place, so that every
    element is independent.
    """
    lead = len(shape) - len(batch)
    inner = [i for i, n in enumerate(batch) if n == 1 and shape[lead + i] != 1]
    draws = draw(shape[:lead] + tuple(shape[lead + i] for i in inner))
    if not inner:
        return draws
    first_batch = lead + len(inner)
    # each expanded batch axis (size one) makes way for its sample axis
    axes = list(range(lead))
    axes += [lead + inner.index(i) if i in inner else first_batch + i for i in range(len(batch))]
    axes += range(first_batch + len(batch), draws.ndim)
    dropped = tuple(first_batch + i for i in inner)
    return draws.transpose(axes + list(dropped)).reshape(shape + event_shape)


def _short(value: Any) -> str:
    return " ".join(np.array2string(np.asarray(value), precision=6, threshold=8).split())
