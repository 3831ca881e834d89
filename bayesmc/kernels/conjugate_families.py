"""Full conditionals in closed form: families by the features of their log density.

A family is known by which features (``passes.features``) its log density is a sum of; the sums of their
coefficients over a node's prior and children are its natural parameters: expressions of the state, one
program. The support of the prior only truncates it.

References
----------
Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), ch. 2-3; Bernardo and Smith (1994), table A.2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import (
    Beta,
    Dirichlet,
    Distribution,
    Gamma,
    InverseGamma,
    InverseWishart,
    MvNormal,
    Normal,
    Truncated,
    Wishart,
)
from bayesmc.distributions.support import Support, interval
from bayesmc.errors import BayesmcError
from bayesmc.expression import Expression
from bayesmc.expression.scalars import SmallProgram
from bayesmc.kernels.conjugate_children import Child, refuse
from bayesmc.kernels.label_sums import Counts, LabelSums
from bayesmc.kernels.vector_draws import (
    DirichletDraw,
    InverseWishartDraw,
    NormalDraw,
    WishartDraw,
)
from bayesmc.passes.arithmetic import multiply
from bayesmc.passes.features import LOG, LOG1M, Feature
from bayesmc.shapes import Shape
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.programs import JointValues
from bayesmc.structure.target import Values

Naturals = tuple[np.ndarray, ...]
#: lower and upper end of a truncated full conditional
Bounds = tuple[Any, Any]
#: numbers that are added up one by one
_FEW = 64


class Conditional:
    """One family of full conditionals.

    Attributes
    ----------
    features : tuple
        Those whose coefficients are its natural parameters.
    low, high : float
        Of its support, where it is one of numbers.
    """

    features: tuple[Feature, ...] = ()
    low, high = -math.inf, math.inf

    def posterior(self, naturals: Naturals, bounds: Bounds | None) -> Distribution:
        """The distribution with these natural parameters, between the bounds."""
        raise NotImplementedError

    def draw(
        self, naturals: Naturals, bounds: Bounds | None, rng: np.random.Generator, shape: Shape
    ) -> np.ndarray | None:
        """A draw of ``shape`` and the event without the checks of a distribution, or None."""
        return None


class NormalConditional(Conditional):
    """``exp(h x - P x^2 / 2)`` of a number."""

    features = (1.0, 2.0)

    def posterior(self, naturals: Naturals, bounds: Bounds | None) -> Distribution:
        linear, square = naturals
        precision = -2.0 * square
        base = Normal(linear / precision, precision**-0.5)
        return base if bounds is None else Truncated(base, *bounds)


class GammaConditional(Conditional):
    """``x^a exp(-b x^power)``: a power of x is Gamma."""

    low = 0.0

    def __init__(self, power: float) -> None:
        self.power = power
        self.features = (LOG, power)

    def posterior(self, naturals: Naturals, bounds: Bounds | None) -> Distribution:
        power, rate = self.power, -naturals[1]
        concentration = (naturals[0] + 1.0) / power
        if bounds is not None and _covers(bounds, 0.0, np.inf):
            bounds = None
        if power == -1.0:
            base: Distribution = InverseGamma(concentration, rate)
        else:
            base = Gamma(concentration, rate)
        if power in (1.0, -1.0):
            return base if bounds is None else Truncated(base, *bounds)
        if bounds is not None:
            ends = [np.asarray(b, dtype=float) ** power for b in bounds]
            base = Truncated(base, *(ends if power > 0 else ends[::-1]))
        return RootOf(base, power)

    def draw(
        self, naturals: Naturals, bounds: Bounds | None, rng: np.random.Generator, shape: Shape
    ) -> np.ndarray | None:
        if bounds is not None and not _covers(bounds, 0.0, np.inf):
            return None
        concentration, rate = (naturals[0] + 1.0) / self.power, -naturals[1]
        if not (concentration.min(initial=1.0) >= 1.0 and rate.min(initial=1.0) > 0.0):
            return None  # the family looks after what underflows
        drawn = rng.standard_gamma(concentration, shape) / rate
        if self.power != 1.0:
            drawn = 1.0 / drawn if self.power == -1.0 else drawn ** (1.0 / self.power)
        return drawn if math.isfinite(drawn.sum()) and drawn.min(initial=1.0) > 0.0 else None


class BetaConditional(Conditional):
    """``x^a (1 - x)^b``."""

    features = (LOG, LOG1M)
    low, high = 0.0, 1.0

    def posterior(self, naturals: Naturals, bounds: Bounds | None) -> Distribution:
        base = Beta(naturals[0] + 1.0, naturals[1] + 1.0)
        if bounds is None or _covers(bounds, 0.0, 1.0):
            return base
        return Truncated(base, *bounds)

    def draw(
        self, naturals: Naturals, bounds: Bounds | None, rng: np.random.Generator, shape: Shape
    ) -> np.ndarray | None:
        if bounds is not None and not _covers(bounds, 0.0, 1.0):
            return None
        first, second = naturals[0] + 1.0, naturals[1] + 1.0
        least = min(first.min(initial=1.0), second.min(initial=1.0))
        if not (least >= 1.0 and np.isfinite(first + second).all()):
            return None
        return rng.beta(first, second, shape)


class DirichletConditional(Conditional):
    """``prod x_k^a_k`` on the simplex."""

    features = (LOG,)

    def posterior(self, naturals: Naturals, bounds: Bounds | None) -> Distribution:
        return Dirichlet(naturals[0] + 1.0)


class MvNormalConditional(Conditional):
    """``exp(h'x - x'Px / 2)`` of a vector."""

    def posterior(self, naturals: Naturals, bounds: Bounds | None) -> Distribution:
        precision, linear = naturals
        factor = _root_of_inverse(precision)
        mean = np.matvec(factor, np.vecmat(linear, factor))
        return MvNormal(mean, scale_tril=factor)


class InverseWishartConditional(Conditional):
    """``|x|^-(df + d + 1)/2 exp(-tr(S x^-1) / 2)``: inverse Wishart."""

    def posterior(self, naturals: Naturals, bounds: Bounds | None) -> Distribution:
        return InverseWishart(*naturals)


class WishartConditional(Conditional):
    """``|x|^(df - d - 1)/2 exp(-tr(S x) / 2)``: Wishart, of the scale ``S^-1``."""

    def posterior(self, naturals: Naturals, bounds: Bounds | None) -> Distribution:
        root = _root_of_inverse(naturals[1])
        return Wishart(naturals[0], root @ np.matrix_transpose(root))


def family_of_features(found: Mapping[Feature, Any], low: float, high: float) -> Conditional | None:
    """The family of numbers with these features on a support, if there is one.

    Examples
    --------
    >>> from bayesmc.kernels.conjugate_families import family_of_features
    >>> family_of_features({"log x": 1, -2.0: 1}, 0.0, 9.0).features
    ('log x', -2.0)
    """
    powers = [f for f in found if not isinstance(f, str)]
    rows: list[Conditional] = [BetaConditional()]
    if 2.0 in found:
        rows.append(NormalConditional())
    if len(powers) == 1:
        rows.append(GammaConditional(float(powers[0])))
    fits = (r for r in rows if set(found) <= set(r.features) and low >= r.low and high <= r.high)
    return next(fits, None)


class RootOf(Distribution):
    """The distribution of x where ``x**power`` is drawn from ``base``, on positive numbers.

    Parameters
    ----------
    base : Distribution
        Of one positive number.
    power : float
        Not zero.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.conjugate_families import RootOf
    >>> sd = RootOf(bmc.Gamma(2.0, 1.0), -2.0)  # 1 / sd**2 is Gamma
    >>> float(sd.log_prob(1.0).round(4))
    -0.3069
    """

    def __init__(self, base: Distribution, power: float) -> None:
        self.base, self.exponent = base, power
        self._set_batch(base.batch_shape)
        self._adopt(base)

    def _sample(self, rng: np.random.Generator, shape: Shape) -> np.ndarray:
        return self.base.sample_to(rng, shape) ** (1.0 / self.exponent)

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        volume = np.log(abs(self.exponent)) + (self.exponent - 1.0) * np.log(x)
        return np.where(x > 0, self.base.log_prob(x**self.exponent) + volume, -np.inf)

    @property
    def support(self) -> Support:
        inner = self.base.support
        ends = [np.asarray(e, dtype=float) for e in (inner.low, inner.high)]
        with np.errstate(divide="ignore"):
            ends = [e ** (1.0 / self.exponent) for e in ends]
        low, high = ends if self.exponent > 0 else ends[::-1]
        return interval(low, high, True, True)


class Form:
    """The full conditional of a class of elements.

    Parameters
    ----------
    family : Conditional
    words : str
        The prior and the children that it rests on.
    naturals : sequence of Expression
        With the node's plates in front, or the members of the class.
    bounds : sequence of Expression
        Of the support, none or two.
    positive : sequence of tuple
        What must be positive, and the child that it is a parameter of.
    placed : sequence
        What it reads beside the state: sums by label, and values of many nodes as one array.
    """

    def __init__(
        self,
        family: Conditional,
        words: str,
        naturals: list[Expression],
        bounds: list[Expression],
        positive: list[tuple[Expression, Child]],
        placed: Sequence[LabelSums | Counts | JointValues],
    ) -> None:
        self.family, self.words, self._placed = family, words, placed
        self._naturals, self._bounds, self._least = naturals, bounds, positive
        roots = [*naturals, *bounds]
        self._program, self._range = SmallProgram(roots), SmallProgram([e for e, _ in positive])
        self._ndims = [len(r.shape) for r in roots]
        self._kept: tuple[Naturals, Bounds | None] | None = None
        self._draw = None if bounds else _one_program(family, naturals)
        if not any(r.leaves for r in (*roots, *(e for e, _ in positive))):
            self._kept = self({})

    def reading(self, joint: JointValues) -> Form:
        """The same, with an array of many nodes' values in their place where it reads several of them."""

        def changed(found: list[Expression]) -> list[Expression]:
            return [joint.read_by(e) for e in found]

        naturals, bounds = changed(self._naturals), changed(self._bounds)
        positive = [(joint.read_by(e), child) for e, child in self._least]
        before = [*self._naturals, *self._bounds, *(e for e, _ in self._least)]
        after = [*naturals, *bounds, *(e for e, _ in positive)]
        if all(a is b for a, b in zip(before, after, strict=True)):
            return self
        return Form(self.family, self.words, naturals, bounds, positive, [*self._placed, joint])

    def __call__(self, values: Values) -> tuple[Naturals, Bounds | None]:
        """Natural parameters, ``(lead, *plates, ...)`` or ``(lead, members, ...)``, and bounds."""
        if self._kept is not None:
            return self._kept
        found = [
            a if a.ndim > n else a[None]
            for a, n in zip(self._program(self._ready(values)), self._ndims, strict=True)
        ]
        k = len(self._naturals)
        return tuple(found[:k]), (found[k], found[k + 1]) if self._bounds else None

    def drawn(self, values: Values, rng: np.random.Generator, chains: int) -> np.ndarray | None:
        """A draw by one program, where there is one and it is a number; else None.

        Raises
        ------
        LinAlgError
            A matrix is not positive definite to rounding.
        """
        if self._draw is None:
            return None
        found = self._draw(self._ready(values), rng, chains)
        return found if found is None or _is_finite(found) else None

    def left(self, values: Values) -> Values:
        """Sums by label that it reads and that are not in the state yet, for others that read them."""
        found: Values = {}
        for placed in self._placed:
            if isinstance(placed, JointValues):  # left by who draws them
                continue
            sums = placed.sums if isinstance(placed, Counts) else placed
            state = values if sums is None else sums.placed(values)
            if sums is not None and state is not values:
                found |= sums.kept(state[sums.label], state[sums.key])
        return found

    def _ready(self, values: Values) -> Values:
        """The state with what is read beside it, parameters of children in their range."""
        for placed in self._placed:
            values = placed.placed(values)
        if self._least:
            for least, (_, child) in zip(self._range(values), self._least, strict=True):
                if (least <= 0.0).any():
                    refuse(child, values)
        return values


def is_closed(form: Form, blanket: Blanket) -> bool:
    """Whether there is a closed form at some states."""
    states: Values | None = blanket.target.states
    if states is None:
        return False
    try:
        naturals, _ = form(states)
    except BayesmcError:
        return False
    return all(bool(np.isfinite(n).all()) for n in naturals)


# ---- private ------------------------------------------------------------------------------------


def _covers(bounds: Bounds, low: float, high: float) -> bool:
    return bool(np.all(bounds[0] <= low) and np.all(bounds[1] >= high))


def _root_of_inverse(precision: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor of the inverse of each matrix.

    With rows and columns reversed, a Cholesky factor turns into an upper triangle U with
    ``precision = U U'``, whose inverse is back substitution.
    """
    spread = (
        np.linalg.diagonal(precision) ** -0.5
    )  # unit diagonal, whatever the units of components
    scaled = precision * (spread[..., :, None] * spread[..., None, :])
    upper = np.linalg.cholesky(scaled[..., ::-1, ::-1])[..., ::-1, ::-1]
    return spread[..., :, None] * np.matrix_transpose(np.linalg.inv(upper))


def _is_finite(numbers: np.ndarray) -> bool:
    if numbers.size <= _FEW:
        return math.isfinite(sum(numbers.ravel().tolist()))
    return math.isfinite(np.add.reduce(numbers, axis=None))


def _one_program(
    family: Conditional, naturals: list[Expression]
) -> NormalDraw | InverseWishartDraw | WishartDraw | DirichletDraw | None:
    """Natural parameters and draw as one."""
    if isinstance(family, NormalConditional):
        linear, square = naturals
        return NormalDraw(multiply(square, -2.0), linear)
    if isinstance(family, MvNormalConditional):
        return NormalDraw(*naturals)
    if isinstance(family, InverseWishartConditional):
        return InverseWishartDraw(*naturals)
    if isinstance(family, WishartConditional):
        return WishartDraw(*naturals)
    return DirichletDraw(*naturals) if isinstance(family, DirichletConditional) else None
