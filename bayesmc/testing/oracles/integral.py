"""The integral of a posterior over its free numbers: coordinates that fit it, and cells that fit its peaks.

Free numbers are standardised at the highest peak and stretched by ``sinh``. The first coordinate moves one
free number alone, so that the cells give its marginal distribution; for another number the integral is
done over in another order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesmc.distributions.transforms import Identity
from bayesmc.errors import BudgetError, UnsupportedError, ZeroProbabilityError
from bayesmc.network import CompiledNode
from bayesmc.testing.oracles.cells import Cells, halved, integrate
from bayesmc.testing.oracles.hidden import HiddenPart
from bayesmc.testing.oracles.peaks import Peak, find_peaks

#: |asinh| of standardised numbers that are integrated: 1e17 widths, for tails as heavy as 1 / x^1.5
REACH = 40.0
#: the first cell around the highest peak, in the same numbers: seven widths
_CORE = 2.6
#: a cell with a peak in it is no wider than so many widths of that peak
_FINE = 8.0
#: order of the rule, by dimension
_ORDERS = (0, 16, 24, 20, 16)
#: share of the mass that may lie closer to a bound than floating point tells
_LOST = 1e-4


@dataclass(frozen=True, eq=False)
class Coordinates:
    """``u[order] = centre[order] + root @ sinh(w)``, with a lower triangular root: the first coordinate
    is the first number of ``order`` alone."""

    order: np.ndarray
    centre: np.ndarray
    root: np.ndarray

    def free(self, w: np.ndarray) -> np.ndarray:
        u = np.empty(w.shape)
        u[..., self.order] = self.centre[self.order] + np.sinh(w) @ self.root.T
        return u

    def log_volume(self, w: np.ndarray) -> np.ndarray:
        cosh = np.logaddexp(w, -w) - math.log(2.0)
        return cosh.sum(axis=-1) + np.log(np.diag(self.root)).sum()

    def of_peak(self, peak: Peak) -> tuple[np.ndarray, np.ndarray]:
        """Where a peak lies, and its widths."""
        inverse = np.linalg.inv(self.root)
        v = inverse @ (peak.point - self.centre)[self.order]
        cov = inverse @ peak.cov[np.ix_(self.order, self.order)] @ inverse.T
        return np.arcsinh(v), np.sqrt(np.diag(cov)) / np.hypot(1.0, v)


@dataclass(frozen=True, eq=False)
class Marginal:
    """The distribution of one number by the first coordinate."""

    of_coordinate: Callable[[np.ndarray], np.ndarray]
    value_of: Callable[[np.ndarray], np.ndarray]
    coordinate_of: Callable[[np.ndarray], np.ndarray]

    def cdf(self, x: np.ndarray) -> np.ndarray:
        return self.of_coordinate(np.clip(self.coordinate_of(x), -REACH, REACH))


class Integral:
    """The cells over what is hidden, and over again in other orders of the numbers for their marginals."""

    def __init__(self, hidden: HiddenPart, rtol: float, most: int, starts: int) -> None:
        self.hidden, self.rtol, self.most = hidden, rtol, most
        self.peaks: list[Peak] = []
        self.lost = 0.0
        self.found: dict[int, tuple[Coordinates, Cells]] = {}
        if hidden.dimension:
            self.peaks = find_peaks(hidden, np.random.default_rng(20_011), starts)
            if not self.peaks:
                raise ZeroProbabilityError(
                    "quadrature_posterior: the evidence has probability zero at all draws of the "
                    "prior; if it is possible, observe less or widen the priors"
                )
            self.cells_by(0)

    def cells_by(self, first: int) -> tuple[Coordinates, Cells]:
        """The integral with a number as the first coordinate."""
        if first not in self.found:
            order = np.array([first, *(k for k in range(self.hidden.dimension) if k != first)])
            best = self.peaks[0]
            root = np.linalg.cholesky(best.cov[np.ix_(order, order)])
            coordinates = Coordinates(order, best.point, root)
            self.found[first] = coordinates, self._integrated(coordinates)
        return self.found[first]

    def free_number(self, name: str, at: tuple[int, ...]) -> int | None:
        """The place of a number among the free ones, where it is a monotone function of its own one."""
        hidden, node = self.hidden, self.hidden.model[name]
        kinds = ("real", "real vector") if node.event_shape else ("real", "interval", "circle")
        if node.support is None or node.support.kind not in kinds or name not in hidden.transforms:
            return None
        cut = len(node.plate_shape)
        element = int(np.ravel_multi_index(at[:cut], node.plate_shape)) if cut else 0
        component = int(np.ravel_multi_index(at[cut:], node.event_shape)) if node.event_shape else 0
        found = [f for f in hidden.free if f.name == name and f.element == element]
        return found[0].start + component if found else None

    def is_core(self, name: str, at: tuple[int, ...]) -> bool:
        """Whether an element is observed, or integrated over."""
        node = self.hidden.model[name]
        if name in self.hidden.read:
            return True
        seen = self.hidden.problem.observed.get(name)
        return seen is not None and (
            seen.mask is None or bool(seen.mask[at[: len(node.plate_shape)]])
        )

    def marginal(self, name: str, at: tuple[int, ...]) -> Marginal | None:
        """The distribution of one number; None where it is none of the integrated ones."""
        number = self.free_number(name, at)
        if number is None:
            return None
        coordinates, cells = self.cells_by(number)
        node, transform = self.hidden.model[name], self.hidden.transforms[name]
        if node.event_shape:
            transform = Identity(())
        centre, scale = coordinates.centre[number], coordinates.root[0, 0]
        turn = 1.0 if transform.constrain(1.0) > transform.constrain(0.0) else -1.0
        low, high = _bounds(node)
        cdf = cells.first_axis_cdf()

        def value_of(w: np.ndarray) -> np.ndarray:
            return transform.constrain(centre + scale * np.sinh(turn * w))

        def coordinate_of(x: np.ndarray) -> np.ndarray:
            inside = np.clip(x, np.nextafter(low, np.inf), np.nextafter(high, -np.inf))
            w = turn * np.arcsinh((transform.unconstrain(inside) - centre) / scale)
            return np.where(x <= low, -REACH, np.where(x >= high, REACH, w))

        def of_coordinate(w: np.ndarray) -> np.ndarray:
            return cdf(w) if turn > 0 else 1.0 - cdf(-w)

        return Marginal(of_coordinate, value_of, coordinate_of)

    def _integrated(self, coordinates: Coordinates) -> Cells:
        hidden = self.hidden
        tops = np.full(2, -np.inf)

        def log_function(w: np.ndarray) -> np.ndarray:
            logs, *others = hidden.log_density(coordinates.free(w))
            volume = coordinates.log_volume(w)
            for k, other in enumerate(others):
                tops[k] = max(tops[k], float((other + volume).max()))
            return logs + volume

        batch = max(1, 1_000_000 // hidden.count)
        try:
            cells = integrate(
                log_function,
                _first_cells([coordinates.of_peak(p) for p in self.peaks], hidden.dimension),
                rtol=self.rtol,
                order=_ORDERS[hidden.dimension],
                max_evaluations=self.most,
                max_batch=batch,
            )
        except BudgetError as error:
            raise BudgetError(f"quadrature_posterior: {error}", error.bytes) from error
        if cells.log_integral == -math.inf:
            raise ZeroProbabilityError("quadrature_posterior: the evidence has probability zero")
        bad, lost = np.exp(np.minimum(tops - cells.log_integral, 0.0))
        if hidden.trouble is not None and bad > self.rtol:
            raise hidden.trouble
        if lost > _LOST:
            raise UnsupportedError(
                f"quadrature_posterior: a share of about {lost:.0e} lies closer to a bound of the hidden "
                f"{', '.join(dict.fromkeys(repr(f.name) for f in hidden.free))} than floating point tells; "
                "use priors that are less extreme there"
            )
        self.lost = max(self.lost, float(lost))
        return cells


# ---- private ------------------------------------------------------------------------------------


def _bounds(node: CompiledNode) -> tuple[float, float]:
    support = node.support
    assert support is not None
    if support.kind == "circle":
        return -math.pi, math.pi
    return float(np.ravel(support.low)[0]), float(np.ravel(support.high)[0])


def _first_cells(
    peaks: list[tuple[np.ndarray, np.ndarray]], dimension: int
) -> tuple[np.ndarray, np.ndarray]:
    """A core around the highest peak and slabs around it, halved until they fit all peaks."""
    low, high = np.full((1, dimension), -_CORE), np.full((1, dimension), _CORE)
    outer_low, outer_high = np.full(dimension, -REACH), np.full(dimension, REACH)
    slabs = []
    for k in range(dimension):
        for a, b in ((-REACH, -_CORE), (_CORE, REACH)):
            one_low, one_high = outer_low.copy(), outer_high.copy()
            one_low[k], one_high[k] = a, b
            slabs.append((one_low, one_high))
        outer_low[k], outer_high[k] = -_CORE, _CORE
    low = np.concatenate([low, [s[0] for s in slabs]])
    high = np.concatenate([high, [s[1] for s in slabs]])
    for point, width in peaks:
        for _ in range(64 * dimension):
            inside = ((low <= point) & (point <= high)).all(axis=1)
            excess = (high - low) / np.maximum(width, 1e-14)
            rows = np.flatnonzero(inside & (excess.max(axis=1) > _FINE))
            if not rows.size:
                break
            pair = halved(low[rows], high[rows], excess[rows].argmax(axis=1))
            keep = np.setdiff1d(np.arange(len(low)), rows)
            low = np.concatenate([low[keep], pair[0]])
            high = np.concatenate([high[keep], pair[1]])
    return low, high
