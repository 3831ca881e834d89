"""Exponential families besides the Gaussian: Gamma, and Dirichlet with Beta as the one of two shares.

References
----------
Minka (2000), Estimating a Dirichlet distribution; Minka (2002), Estimating a Gamma distribution (the inverses
of expected logarithms).
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from scipy import special

from bayesmc.distributions import Beta, Dirichlet, Distribution, Gamma

_STEPS = 50
#: share of the weight that members with heavier tails have
_WIDER = 0.5


class Family(ABC):
    """Densities ``exp(natural . T(x) - A(natural))``; leading axes are elements side by side.

    ``size`` is the number of statistics.
    """

    #: what it is called
    words: str
    #: natural parameters of some member, in each statistic
    one: np.ndarray

    def __init__(self, size: int) -> None:
        self.size = size
        self.one = np.zeros(size)

    @property
    def key(self) -> tuple[str, int]:
        """Equal for the same family."""
        return type(self).__name__, self.size

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Family) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)

    @abstractmethod
    def log_total(self, natural: np.ndarray) -> np.ndarray:
        """A; NaN where there is no integral."""

    @abstractmethod
    def expected(self, natural: np.ndarray) -> np.ndarray:
        """Expected statistics."""

    @abstractmethod
    def natural(self, expected: np.ndarray, near: np.ndarray) -> np.ndarray:
        """The parameters with these expected statistics; ``near`` to begin with."""

    @abstractmethod
    def marginal(self, natural: np.ndarray, is_vector: bool) -> Distribution:
        """Of numbers each by itself; of shares as a vector all of them, else the first."""

    @abstractmethod
    def member(self, natural: np.ndarray) -> Distribution:
        """All elements as a distribution: of numbers, or of vectors of shares."""

    @abstractmethod
    def widened(self, natural: np.ndarray) -> np.ndarray:
        """Members about the same centre with heavier tails."""


class GammaFamily(Family):
    """Statistics ``log x`` and ``x``.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.factors.families import GammaFamily
    >>> family, natural = GammaFamily(2), np.array([[2.0, -5.0]])  # concentration 3, rate 5
    >>> family.natural(family.expected(natural), np.array([[0.0, -1.0]])).round(6).tolist()
    [[2.0, -5.0]]
    """

    words = "Gamma"

    def __init__(self, size: int = 2) -> None:
        super().__init__(size)
        self.one = np.array([0.0, -1.0])

    def log_total(self, natural: np.ndarray) -> np.ndarray:
        a, b = natural[..., 0] + 1.0, -natural[..., 1]
        found = special.gammaln(a) - a * np.log(b)
        return np.where((a > 0) & (b > 0), found, np.nan)

    def expected(self, natural: np.ndarray) -> np.ndarray:
        a, b = natural[..., 0] + 1.0, -natural[..., 1]
        return np.stack([special.digamma(a) - np.log(b), a / b], axis=-1)

    def natural(self, expected: np.ndarray, near: np.ndarray) -> np.ndarray:
        log, mean = expected[..., 0], expected[..., 1]
        gap = np.maximum(np.log(mean) - log, 1e-300)
        a = (3.0 - gap + np.sqrt((gap - 3.0) ** 2 + 24.0 * gap)) / (12.0 * gap)
        for _ in range(8):  # Minka 2002
            off = np.log(a) - special.digamma(a) - gap
            a = 1.0 / (1.0 / a + off / (a * a * (1.0 / a - special.polygamma(1, a))))
        return np.stack([a - 1.0, -a / mean], axis=-1)

    def marginal(self, natural: np.ndarray, is_vector: bool) -> Distribution:
        return Gamma(natural[..., 0] + 1.0, -natural[..., 1])

    def member(self, natural: np.ndarray) -> Distribution:
        return Gamma(natural[..., 0] + 1.0, -natural[..., 1])

    def widened(self, natural: np.ndarray) -> np.ndarray:
        return _WIDER * (natural + np.array([1.0, 0.0])) - np.array([1.0, 0.0])


class Shares(Family):
    """Statistics ``log x_j``, of shares that sum to one; a Beta has the shares x and 1 - x.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.factors.families import Shares
    >>> family, natural = Shares(3), np.array([[1.0, 4.0, -0.5]])
    >>> family.natural(family.expected(natural), np.zeros((1, 3))).round(6).tolist()
    [[1.0, 4.0, -0.5]]
    """

    words = "Dirichlet (of two shares: Beta)"

    def log_total(self, natural: np.ndarray) -> np.ndarray:
        alpha = natural + 1.0
        found = special.gammaln(alpha).sum(axis=-1) - special.gammaln(alpha.sum(axis=-1))
        return np.where((alpha > 0).all(axis=-1), found, np.nan)

    def expected(self, natural: np.ndarray) -> np.ndarray:
        alpha = natural + 1.0
        return special.digamma(alpha) - special.digamma(alpha.sum(axis=-1, keepdims=True))

    def natural(self, expected: np.ndarray, near: np.ndarray) -> np.ndarray:
        alpha = np.maximum(near + 1.0, 1e-3)
        for _ in range(_STEPS):  # Newton's step has a closed form (Minka 2000, eq. 15 to 18)
            total = alpha.sum(axis=-1, keepdims=True)
            off = special.digamma(total) - special.digamma(alpha) + expected
            own, common = -special.polygamma(1, alpha), special.polygamma(1, total)
            shift = (off / own).sum(-1, keepdims=True) / (
                1.0 / common + (1.0 / own).sum(-1, keepdims=True)
            )
            step = (off - shift) / own
            new = np.where(alpha - step > 0, alpha - step, 0.5 * alpha)
            small = np.abs(new - alpha) <= 1e-13 * (1.0 + alpha)
            alpha = new
            if small.all():
                break
        return alpha - 1.0

    def marginal(self, natural: np.ndarray, is_vector: bool) -> Distribution:
        alpha = natural + 1.0
        if not is_vector:
            return Beta(alpha[..., 0], alpha[..., 1])
        return Beta(alpha, alpha.sum(axis=-1, keepdims=True) - alpha)

    def member(self, natural: np.ndarray) -> Distribution:
        return Dirichlet(natural + 1.0)

    def widened(self, natural: np.ndarray) -> np.ndarray:
        return _WIDER * (natural + 1.0) - 1.0
