"""Random distributions: any family of the package, with valid parameters whose shapes broadcast.

For properties that every family has: draws lie in the support, densities broadcast, cdf and ppf invert each
other. Every distribution is an expression that was evaluated, which ``as_code`` shows. Densities given as
functions (``Density``, ``InverseCdf``) and SciPy's distributions are left to tests written by hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.shapes import Shape
from bayesmc.testing.makers.choices import Choices, read_options, seeded
from bayesmc.testing.makers.spelling import array, evaluate

_KINDS = ("any", "continuous", "discrete")


@dataclass(frozen=True)
class DistributionOptions:
    """Which distributions.

    Attributes
    ----------
    kind : str
        ``"continuous"``, ``"discrete"`` or ``"any"``.
    event_ndim : int, optional
        Axes of one value: 0 for numbers, 1 for vectors, 2 for matrices. By default any.
    families : tuple of str, optional
        Names such as ``"Normal"``, if not all.
    extreme : bool
        Parameters at the far ends of what is valid: scales from 1e-8 to 1e8, probabilities of 0 and 1.
    batch_ndim : int
        Most axes of the batch, each of 1 to 3 elements.
    """

    kind: str = "any"
    event_ndim: int | None = None
    families: tuple[str, ...] | None = None
    extreme: bool = False
    batch_ndim: int = 2

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise ValueError(f"kind={self.kind!r}: give one of {', '.join(map(repr, _KINDS))}")
        if self.event_ndim not in (None, 0, 1, 2):
            raise ValueError(f"event_ndim={self.event_ndim!r}: give 0, 1, 2 or None for any")
        if not isinstance(self.batch_ndim, int) or self.batch_ndim < 0:
            raise ValueError(f"batch_ndim={self.batch_ndim!r}: give the most axes, 0 or more")
        if isinstance(self.families, str):
            raise ValueError(f"families={self.families!r}: give a tuple of names")
        unknown = [name for name in self.families or () if name not in _FAMILIES]
        if unknown:
            raise ValueError(f"families: {unknown[0]!r} is none of {', '.join(_FAMILIES)}")
        if not self.names:
            raise ValueError(
                f"kind={self.kind!r}, event_ndim={self.event_ndim}, families={self.families}: no family "
                "is all of these"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Families that fit."""
        return tuple(
            name
            for name, family in _FAMILIES.items()
            if (self.families is None or name in self.families)
            and (self.kind == "any" or family.is_discrete == (self.kind == "discrete"))
            and self.event_ndim in (None, family.event_ndim)
        )


def random_distribution(rng: Any, **options: Any) -> Distribution:
    """A random distribution.

    Parameters
    ----------
    rng : seed or Generator
        The same seed gives the same distribution.
    **options
        Fields of `DistributionOptions`: ``kind``, ``event_ndim``, ``families``, ``extreme``, ``batch_ndim``.

    Raises
    ------
    ValueError, TypeError
        An option that is out of range, or unknown.

    Examples
    --------
    >>> from bayesmc.testing import as_code, random_distribution
    >>> as_code(random_distribution(4, families=("Gamma",), batch_ndim=1))
    'bmc.Gamma(np.array([0.25, 0.5, 0.25]), 0.25)'
    """
    choices = seeded(np.random.default_rng(rng))
    return build_distribution(
        choices, read_options("random_distribution", DistributionOptions, options)
    )


def build_distribution(choices: Choices, options: DistributionOptions) -> Distribution:
    """``random_distribution`` from any source of choices."""
    name = choices.pick(options.names)
    batch = tuple(choices.integer(1, 3) for _ in range(choices.integer(0, options.batch_ndim)))
    return evaluate(_FAMILIES[name].spell(_Parameters(choices, options.extreme, batch)))


# ---- parameters ---------------------------------------------------------------------------------


class _Parameters:
    """Spelled parameters; each has the batch shape, or one that broadcasts to it."""

    def __init__(self, choices: Choices, extreme: bool, batch: Shape) -> None:
        self.choices = choices
        self.extreme = extreme
        self.batch = batch
        self.is_first = True

    def shape(self) -> Shape:
        """The batch for the first parameter; then some axes of length one, or missing in front."""
        if self.is_first:
            self.is_first = False
            return self.batch
        lead = self.choices.integer(0, len(self.batch))
        return tuple(n if self.choices.flag(0.6) else 1 for n in self.batch[lead:])

    def values(self, draw: Callable[[], Any], event: Shape = ()) -> np.ndarray:
        shape = self.shape() + event
        return np.reshape([draw() for _ in range(math.prod(shape))], shape)

    def real(self, event: Shape = ()) -> str:
        """Locations."""
        return array(self.values(self._real, event))

    def positive(self, event: Shape = (), low: int = -8, high: int = 8) -> str:
        """Scales, rates and concentrations; ``low`` and ``high`` are decades of extreme ones."""
        return array(self.values(lambda: self._positive(low, high), event))

    def probability(self, inside: bool = False) -> str:
        """Probabilities, zero and one among the extreme; with ``inside`` neither."""
        return array(self.values(lambda: self._probability(inside)))

    def count(self, most: int = 8, least: int = 0) -> str:
        """Whole numbers; of the extreme ones some are large."""
        return array(self.values(lambda: self._count(most, least)).astype(int))

    def rows(self, states: int) -> str:
        """Rows of probabilities."""
        shape = self.shape()
        rows = self.choices.rows(math.prod(shape), states, zeros=self.extreme)
        return array(rows.reshape(*shape, states))

    def matrices(self, size: int, high: int = 3) -> str:
        """Positive definite matrices; the extreme ones are close to singular, or huge."""

        def root() -> np.ndarray:
            lower = np.tril(self.choices.reals(-1.0, 1.0, (size, size)), -1)
            scales = [self._positive(-high, high) for _ in range(size)]
            return (np.eye(size) + lower) * np.reshape(scales, (size, 1))

        shape = self.shape()
        found = [(r := root()) @ r.T for _ in range(math.prod(shape))]
        return array(np.reshape(found, (*shape, size, size)))

    def _real(self) -> float:
        size = self.choices.pick((0.0, 1.0, -1.0, 0.5, -2.0))
        return size * 10.0 ** self.choices.integer(0, 6) if self.extreme else size

    def _positive(self, low: int, high: int) -> float:
        size = self.choices.pick((1.0, 2.0, 0.5, 4.0, 0.25))
        if not self.extreme:
            return size
        power = self.choices.integer(0, high - low)  # 0, 1, -1, 2, -2, ...: plain numbers first
        away = (power + 1) // 2 * (1 if power % 2 else -1)
        return size * 10.0 ** min(max(away, low), high)

    def _probability(self, inside: bool) -> float:
        if self.extreme and self.choices.flag():
            ends = (1e-12, 1.0 - 1e-12) if inside else (0.0, 1.0, 1e-12, 1.0 - 1e-12)
            return self.choices.pick(ends)
        return self.choices.integer(1, 15) / 16

    def _count(self, most: int, least: int) -> int:
        if self.extreme and self.choices.flag(0.3):
            return self.choices.pick((1000, 100_000))
        return self.choices.integer(least, most)


# ---- families -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Family:
    spell: Callable[[_Parameters], str]
    event_ndim: int = 0
    is_discrete: bool = False


def _ordered(p: _Parameters) -> str:
    low = p.values(p._real)
    width = p._positive(-3, 3)
    return f"{array(low)}, {array(low + width)}"


def _increasing(p: _Parameters) -> str:
    """What numbers in order are drawn from: on the line, above zero, between two bounds, below one."""
    return p.choices.pick(
        (f"bmc.Normal({p.real()}, {p.positive()})", "bmc.Exponential(2.0)", "bmc.Uniform(-1.0, 2.0)",
         "bmc.Affine(bmc.Exponential(0.5), 1.0, -1.0)")
    )  # fmt: skip


def _cutpoints(p: _Parameters) -> str:
    shape = (*p.shape(), p.choices.integer(1, 3))
    steps = [p._positive(-3, 3) for _ in range(math.prod(shape))]
    return array(np.cumsum(np.reshape(steps, shape), axis=-1) - 2.0)


def _truncated(p: _Parameters) -> str:
    loc, scale = p.values(p._real), p._positive(-4, 4)
    # the tails of the extreme ones, up to ten standard deviations out
    start = p.choices.integer(-10, 10) if p.extreme else p.choices.integer(-2, 1)
    low = loc + scale * start
    bounds = p.choices.pick((f"{array(low)}, {array(low + 2 * scale)}", array(low)))
    return f"bmc.Truncated(bmc.Normal({array(loc)}, {scale!r}), {bounds})"


def _mixture(p: _Parameters) -> str:
    count = p.choices.integer(1, 3)
    weights = p.rows(count)
    return f"bmc.Mixture({weights}, bmc.Normal({p.real((count,))}, {p.positive((count,))}))"


def _affine(p: _Parameters) -> str:
    base = f"bmc.Gamma({p.positive(low=-2)}, 1.0)"
    return f"bmc.Affine({base}, {p.real()}, {p.choices.pick(('', '-'))}{p._positive(-8, 8)!r})"


def _integers(p: _Parameters) -> str:
    low = p.values(lambda: p.choices.integer(-3, 3)).astype(int)
    return f"bmc.DiscreteUniform({array(low)}, {array(low + p._count(4, 0))})"


def _normal_vector(p: _Parameters) -> str:
    size = p.choices.integer(1, 3)
    loc = p.real((size,))
    form = p.choices.pick(("scale_diag", "cov", "scale_tril"))
    if form == "scale_diag":
        return f"bmc.MvNormal({loc}, scale_diag={p.positive((size,))})"
    matrices = p.matrices(size)
    if form == "cov":
        return f"bmc.MvNormal({loc}, {matrices})"
    return f"bmc.MvNormal({loc}, scale_tril=np.linalg.cholesky({matrices}))"


def _joint(p: _Parameters) -> str:
    gamma = f"bmc.Gamma({p.positive(low=-2)}, {p.positive()})"
    return f"bmc.Joint(bmc.Normal({p.real()}, {p.positive()}), {gamma})"


def _matrix(name: str) -> Callable[[_Parameters], str]:
    def spell(p: _Parameters) -> str:
        size = p.choices.integer(1, 3)
        df = p.values(lambda: size + p._positive(-3, 4))
        return f"bmc.{name}({array(df)}, {p.matrices(size, high=2)})"

    return spell


#: the order is that of shrinking: the plainest first
_FAMILIES: dict[str, _Family] = {
    "Normal": _Family(lambda p: f"bmc.Normal({p.real()}, {p.positive()})"),
    "Uniform": _Family(lambda p: f"bmc.Uniform({_ordered(p)})"),
    "Exponential": _Family(lambda p: f"bmc.Exponential({p.positive()})"),
    "Gamma": _Family(lambda p: f"bmc.Gamma({p.positive(low=-2, high=5)}, {p.positive()})"),
    "Beta": _Family(lambda p: f"bmc.Beta({p.positive((), -1, 4)}, {p.positive((), -1, 4)})"),
    "StudentT": _Family(
        lambda p: f"bmc.StudentT({p.positive(low=-1, high=6)}, {p.real()}, {p.positive()})"
    ),
    "Laplace": _Family(lambda p: f"bmc.Laplace({p.real()}, {p.positive()})"),
    "Cauchy": _Family(lambda p: f"bmc.Cauchy({p.real()}, {p.positive()})"),
    "HalfNormal": _Family(lambda p: f"bmc.HalfNormal({p.positive()})"),
    "HalfCauchy": _Family(lambda p: f"bmc.HalfCauchy({p.positive()})"),
    "LogNormal": _Family(
        lambda p: (
            f"bmc.LogNormal({array(p.values(lambda: p.choices.real(-4.0, 4.0)))}, "
            f"{p.positive(low=-3, high=0)})"
        )
    ),
    "InverseGamma": _Family(
        lambda p: f"bmc.InverseGamma({p.positive(low=-1, high=5)}, {p.positive()})"
    ),
    "Weibull": _Family(lambda p: f"bmc.Weibull({p.positive(low=-1, high=2)}, {p.positive()})"),
    "VonMises": _Family(lambda p: f"bmc.VonMises({p.real()}, {p.positive(high=5)})"),
    "WrappedNormal": _Family(
        lambda p: f"bmc.WrappedNormal({p.real()}, {p.positive(low=-3, high=2)})"
    ),
    "Truncated": _Family(_truncated),
    "Affine": _Family(_affine),
    "Mixture": _Family(_mixture),
    "KernelDensity": _Family(
        lambda p: f"bmc.KernelDensity({p.real((3,))}, bandwidth={p._positive(-3, 3)!r})"
    ),
    "Bernoulli": _Family(lambda p: f"bmc.Bernoulli({p.probability()})", 0, True),
    "Categorical": _Family(
        lambda p: f"bmc.Categorical({p.rows(p.choices.integer(1, 4))})", 0, True
    ),
    "Binomial": _Family(lambda p: f"bmc.Binomial({p.count()}, {p.probability()})", 0, True),
    "DiscreteUniform": _Family(_integers, 0, True),
    "Poisson": _Family(lambda p: f"bmc.Poisson({p.positive(high=5)})", 0, True),
    "Geometric": _Family(lambda p: f"bmc.Geometric({p.probability(inside=True)})", 0, True),
    "NegativeBinomial": _Family(
        lambda p: (
            f"bmc.NegativeBinomial({p.positive(low=-1, high=3)}, {p.probability(inside=True)})"
        ),
        0,
        True,
    ),
    "MvNormal": _Family(_normal_vector, 1),
    "Dirichlet": _Family(
        lambda p: f"bmc.Dirichlet({p.positive((p.choices.integer(2, 4),), -1, 4)})", 1
    ),
    "Joint": _Family(_joint, 1),
    "Multinomial": _Family(
        lambda p: f"bmc.Multinomial({p.count()}, {p.rows(p.choices.integer(2, 4))})", 1, True
    ),
    "Ordered": _Family(lambda p: f"bmc.Ordered({_increasing(p)}, {p.choices.integer(1, 4)})", 1),
    "OrderedLogistic": _Family(
        lambda p: f"bmc.OrderedLogistic({p.real()}, {_cutpoints(p)})", 0, True
    ),
    "BetaBinomial": _Family(
        lambda p: (
            f"bmc.BetaBinomial({p.count()}, {p.positive((), -1, 2)}, {p.positive((), -1, 2)})"
        ),
        0,
        True,
    ),
    "LKJ": _Family(
        lambda p: f"bmc.LKJ({p.choices.integer(1, 3)}, {p.positive(low=-1, high=3)})", 2
    ),
    "Wishart": _Family(_matrix("Wishart"), 2),
    "InverseWishart": _Family(_matrix("InverseWishart"), 2),
}
