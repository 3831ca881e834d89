"""Filters whose particles lie evenly: sorted before they have offspring, and moved by a lattice of points.

Where one number of each chain goes from slice to slice, particles are sorted by it and resampled on a comb,
so that offspring lie as evenly as the weights say. The normal numbers that move them are the quantiles of
``frac(i a + U)`` for the i-th particle, with ``a`` irrational and U uniform: ancestors and moves together are
a lattice rule of two dimensions. Ancestors are chosen in proportion to the weights on average over
particles, and so is what follows of them: the likelihood is estimated without bias, as with independent
draws, and with a fraction of their variance.

It is no filter for a kept trajectory, whose companions must be independent. Draws other than normal ones, and
several for one element at once, are made as they always are.

References
----------
Gerber and Chopin (2015), Sequential quasi Monte Carlo, JRSS B 77; Lécot and Tuffin (2004), Monte Carlo and
quasi-Monte Carlo methods 2002 (sorted particles); Owen (2013), Monte Carlo theory, methods and examples,
ch. 17 (shifted lattices).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from scipy.special import ndtri

from bayesmc.dbn import PREVIOUS
from bayesmc.engines.particles.smc import Particles, Selection
from bayesmc.pmcmc.filters import ChainStep, Filter
from bayesmc.pmcmc.trellis import Slice, Trellis
from bayesmc.resampling import systematic
from bayesmc.structure.target import Values

#: numbers far from all fractions, whose multiples lie evenly on a circle: for the draws of a slice, in order
_FAR = np.sqrt([5.0, 2.0, 3.0, 7.0]) / [2.0, 1.0, 1.0, 1.0] + [0.5, 0.0, 0.0, 0.0]


def filter_of(trellis: Trellis, particles: int, chosen: bool = False) -> Filter:
    """The filter with the smallest variance that the house has for a question."""
    key = _key(trellis)
    if key is None:
        return Filter(trellis, particles, chosen)
    return QuasiFilter(trellis, particles, chosen, key)


class QuasiStep(ChainStep):
    """Sorts particles by one number of each chain, and moves them by points that lie evenly."""

    def __init__(
        self, trellis: Trellis, particles: int, values: Values, chains: int, key: str
    ) -> None:
        super().__init__(trellis, particles, values, chains)
        self.key = key + PREVIOUS

    def propagated(self, steps: Any, row: Any, before: Any, selection: Selection, rng: Any) -> Any:
        shape = (self.layout.particles, *self.layout.lead)
        return super().propagated(steps, row, before, selection, Even(rng.bit_generator, shape))

    def selected(
        self,
        earlier: Particles,
        before: Mapping[str, np.ndarray],
        row: Slice,
        rng: np.random.Generator,
    ) -> Selection:
        """Resample in every slice: evenly, it costs next to nothing of what is known."""
        value, weights = before.get(self.key), earlier.weights
        if value is None or value.shape != weights.shape:  # seen, so that all agree
            return super().selected(earlier, before, row, rng)
        order = np.argsort(value, axis=0)
        chosen = systematic(np.take_along_axis(weights, order, axis=0), len(weights), rng)
        found = np.take_along_axis(order, chosen, axis=0)
        everybody = np.ones(self.layout.lead, dtype=bool)
        return Selection(len(weights), found, everybody, 0.0, self._log_particles)


class QuasiFilter(Filter):
    """As ``Filter``, for questions where one number of each chain goes from slice to slice.

    Parameters
    ----------
    trellis : Trellis
    particles : int
    chosen : bool
        Whether another number may be chosen for the data (``of``).
    key : str
        The node whose number it is.
    """

    best = 0.7  # variance falls so fast that more particles cost less than chains that stand still

    def __init__(self, trellis: Trellis, particles: int, chosen: bool, key: str) -> None:
        super().__init__(trellis, particles, chosen, partial(QuasiStep, key=key))


class Even(np.random.Generator):
    """A generator whose first few arrays of normal numbers lie evenly along the first axis.

    Each number by itself is standard normal, and independent of all others of its position on that axis.

    Parameters
    ----------
    chance : BitGenerator
    shape : tuple of int
        Of arrays that are drawn so; others are drawn as ever.

    Examples
    --------
    >>> import numpy as np
    >>> from bayesmc.pmcmc.quasi import Even
    >>> z = Even(np.random.PCG64(0), (100, 3)).standard_normal((100, 3))
    >>> bool((abs(z.mean(axis=0)) < 0.05).all()), bool((abs(z.std(axis=0) - 1.0) < 0.05).all())
    (True, True)
    """

    def __init__(self, chance: Any, shape: tuple[int, ...]) -> None:
        super().__init__(chance)
        self.shape, self._drawn = shape, 0

    def standard_normal(self, size: Any = None, *rest: Any, **options: Any) -> Any:
        if size != self.shape or rest or options or self._drawn >= len(_FAR):
            return super().standard_normal(size, *rest, **options)
        steps = np.arange(self.shape[0]) * _FAR[self._drawn]
        self._drawn += 1
        shift = self.random(self.shape[1:])
        points = np.add(steps.reshape(-1, *(1,) * shift.ndim), shift)
        points -= np.floor(points)
        return ndtri(np.maximum(points, 1e-17, out=points), out=points)


# ---- private ------------------------------------------------------------------------------------


def _key(trellis: Trellis) -> str | None:
    """The one hidden number of each chain that goes from slice to slice, if that is all that does."""
    interface = trellis.series.slices.interface
    hidden = {n for place in trellis.slices for n in place.hidden if n in interface}
    if len(hidden) != 1:
        return None
    (name,) = hidden
    node = trellis.model[name]
    is_number = node.domain is None and not node.is_discrete and not node.event_shape
    return name if is_number and node.plates == trellis.apart else None
