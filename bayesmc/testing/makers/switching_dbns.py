"""Random switching templates with data: linear-Gaussian given finite nodes, which are hidden, too.

What random linear-Gaussian templates hold, and modes that their means and scales depend on: one finite node
or two, with memory or without, in plates or not, that depend on each other, on inputs and on time, that some
functions read of the slice before, with states that cannot follow each other, and finite sensors of them.
Exact conditioning of the unrolled net, whose cost grows with the histories of modes, gives the answers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bayesmc.distributions import Categorical, MvNormal, Normal
from bayesmc.testing.makers.linear_dbns import LinearMaker, LinearSeries, named


def random_switching_dbn(
    seed: int, difference: float = 1.0, mean: Callable[[Any], Any] | None = None
) -> LinearSeries:
    """A random switching template and a series of 3 or 4 rows.

    Parameters
    ----------
    seed : int
    difference : float
        How much modes differ; with 0 they make no difference to any number.
    mean : callable, optional
        Goes around all means: with one that gives back what it is given, and does not look so, means are
        affine and are not known to be.

    Examples
    --------
    >>> from bayesmc.testing.makers.switching_dbns import random_switching_dbn
    >>> random_switching_dbn(3).dbn["mode"].is_discrete
    True
    """
    return _SwitchingMaker(seed, difference, mean).made()


# ---- private ------------------------------------------------------------------------------------


class _SwitchingMaker(LinearMaker):
    """Declares modes first; every mean and scale may depend on them."""

    def __init__(
        self, seed: int, difference: float, mean: Callable[[Any], Any] | None = None
    ) -> None:
        super().__init__(seed, 2.0)
        self.mean = mean
        self.difference = difference
        self.steps = int(self.rng.integers(3, 5))
        if self.kind in ("joint", "both"):  # one mode for all elements, or histories are too many
            self.kind, self.plates = "joint", ("site",)
        self.modes: dict[str, int] = {}

    def made(self) -> LinearSeries:
        rng = self.rng
        own = self.plates if self.kind == "apart" and rng.random() < 0.7 else ()
        self._mode("mode", int(rng.choice([2, 2, 3])) if not own else 2, own)
        if not own and rng.random() < 0.4:
            self._mode("flag", 2, (), reads=("mode",))
        self.reads_before = rng.random() < 0.3
        self.has_sensor = rng.random() < 0.3
        return super().made()

    def _mode(
        self, name: str, card: int, plates: tuple[str, ...], reads: Sequence[str] = ()
    ) -> None:
        """A finite node with memory or without."""
        rng = self.rng
        within = [n for n in reads if rng.random() < 0.6]
        before = [f"{name}_prev"] if not within or rng.random() < 0.5 else []
        cards = [self.modes.get(p.removesuffix("_prev"), card) for p in (*within, *before)]
        table = rng.dirichlet(np.full(card, 0.8), size=cards)
        if rng.random() < 0.3:  # a state that cannot follow
            table[..., 0, :] = np.eye(card)[-1] if card == 2 else table[..., 0, :]
        self.modes[name] = card
        self.sizes[name], self.within[name] = 0, plates
        first = rng.dirichlet(np.full(card, 2.0))

        def follow(*values: Any) -> Any:
            return Categorical(table[values])

        start = named(lambda: Categorical(first), ()) if before else None
        self.dbn.add(name, follow, (*within, *before), plates=plates, initial=start)

    def _with_data(self, observed: Sequence[str]) -> LinearSeries:
        if self.has_sensor:
            name = next(iter(self.modes))
            table = self.rng.dirichlet(np.ones(2), size=self.modes[name])
            self.dbn.add(
                "sensor", lambda mode: Categorical(table[mode]), [name], plates=self.within[name]
            )
            observed = [*observed, "sensor"]
        return super()._with_data(observed)

    def _known(self) -> list[str]:
        found = super()._known()
        found += [n for n in self.modes if self.rng.random() < 0.7]
        return found

    def _terms(self, name: str, parents: tuple[str, ...]) -> Callable[[Sequence[Any]], Any]:
        """Coefficients, too, depend on the first mode that is read."""
        linear = [p for p in parents if p not in self.modes]
        plain = super()._terms(name, tuple(linear))
        modes = [p for p in parents if p in self.modes]
        gains = [1.0 + 0.5 * self.difference * self.rng.normal(size=self.modes[m]) for m in modes]
        offsets = [self.difference * self.rng.normal(size=self.modes[m]) for m in modes]
        size = self.sizes[name]

        def total(values: Sequence[Any]) -> Any:
            given = dict(zip(parents, values, strict=True))
            found = plain([given[p] for p in linear])
            for mode, gain, offset in zip(modes, gains, offsets, strict=True):
                scale, shift = (self._picked(a, given[mode]) for a in (gain, offset))
                found = found * (scale[..., None] if size else scale)
                found = found + (shift[..., None] if size else shift)
            return found if self.mean is None else self.mean(found)

        return total

    def _picked(self, table: np.ndarray, mode: Any) -> Any:
        """The entry of a mode; where means are to be followed, in operations that can be."""
        if self.mean is None:
            return table[mode]
        chosen = [np.where(mode == k, 1.0, 0.0) for k in range(len(table))]
        if table.ndim > 1:
            chosen = [c[..., None, None] for c in chosen]
        return sum(c * entry for c, entry in zip(chosen, table, strict=True))

    def _function(
        self, name: str, parents: tuple[str, ...], scale: float | None = None
    ) -> Callable[..., Any]:
        size, terms = self.sizes[name], self._terms(name, parents)
        spread = float(np.exp(self.rng.normal(0.0, 0.5))) if scale is None else scale
        modes = [k for k, p in enumerate(parents) if p in self.modes]
        if not modes:
            if not size:
                return lambda *values: Normal(terms(values), spread)
            return lambda *values: MvNormal(terms(values), spread**2 * np.eye(size))
        at = modes[0]
        spreads = spread * np.exp(
            0.5 * self.difference * self.rng.normal(size=self.modes[parents[at]])
        )
        if not size:
            return lambda *values: Normal(terms(values), self._picked(spreads, values[at]))
        covs = spreads[:, None, None] ** 2 * np.eye(size)
        return lambda *values: MvNormal(terms(values), self._picked(covs, values[at]))
