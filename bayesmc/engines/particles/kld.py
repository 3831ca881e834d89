"""How many particles a belief needs: as many as keep the error of a histogram of it small.

The belief is cut into bins; the more bins have mass, the more particles are needed. A robot that is lost
needs many, one that knows where it is needs few.

References
----------
Fox (2003), Adapting the sample size in particle filters through KLD-sampling, IJRR 22(12); Li, Sun and
Sattar (2013), Adapting sample size in particle filters through KLD-resampling, Electronics Letters 49(12).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy import special

from bayesmc.errors import ModelError, UnknownNodeError
from bayesmc.network import Model


@dataclass(frozen=True)
class KLD:
    """As many particles as keep the divergence of the binned belief small with a given probability.

    Parameters
    ----------
    widths : dict
        Node -> width of its bins in the node's own unit: a number, or one for each component. States of
        finite nodes are bins of their own and need none (give the node with a width of 1).
    least : int
        Particles there are at least; at most there are the filter's ``particles``.
    error : float
        Bound on the Kullback-Leibler divergence (nats) between the binned belief and that of the particles.
    probability : float
        With which the bound holds.

    Raises
    ------
    ValueError

    Notes
    -----
    Bins are counted among as many offspring as there may be at most, drawn by the filter's own scheme, so
    that low-variance resampling stays what it is; then as many are drawn as the count of bins asks for.

    Examples
    --------
    >>> from bayesmc import KLD
    >>> KLD({"x": 0.5}, least=50).needed(bins=100)
    1347
    """

    widths: Mapping[str, Any]
    least: int = 100
    error: float = 0.05
    probability: float = 0.99

    def __post_init__(self) -> None:
        if not isinstance(self.widths, Mapping) or not self.widths:
            raise ValueError(
                f"KLD(widths={self.widths!r}): give a dict from node to the width of its bins"
            )
        widths = {name: _width(name, width) for name, width in self.widths.items()}
        object.__setattr__(self, "widths", MappingProxyType(widths))
        if isinstance(self.least, bool) or not isinstance(self.least, Integral) or self.least < 1:
            raise ValueError(f"KLD(least={self.least!r}): give a number of particles, 1 or more")
        if not isinstance(self.error, Real) or not 0 < self.error < math.inf:
            raise ValueError(f"KLD(error={self.error!r}): give a number above 0")
        if not isinstance(self.probability, Real) or not 0 < self.probability < 1:
            raise ValueError(
                f"KLD(probability={self.probability!r}): give a number between 0 and 1"
            )

    def __hash__(self) -> int:
        return hash((frozenset(self.widths.items()), self.least, self.error, self.probability))

    def __getstate__(self) -> dict[str, Any]:
        """A mapping proxy cannot be pickled; what it shows can."""
        return {**self.__dict__, "widths": dict(self.widths)}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        self.__dict__.update(state, widths=MappingProxyType(dict(state["widths"])))

    def needed(self, bins: int) -> int:
        """Particles for so many bins with mass (Fox 2003, eq. 7: the Wilson-Hilferty bound)."""
        if bins <= 1:
            return int(self.least)
        share = 2.0 / (9.0 * (bins - 1))
        root = 1.0 - share + math.sqrt(share) * float(special.ndtri(self.probability))
        return max(int(self.least), math.ceil((bins - 1) / (2.0 * self.error) * root**3))

    def check(self, model: Model, interface: tuple[str, ...]) -> None:
        """Refuse nodes that the template lacks, or that the next slice does not read.

        Raises
        ------
        UnknownNodeError, ModelError
        """
        for name, width in self.widths.items():
            if name not in model.nodes:
                raise UnknownNodeError(f"KLD: widths= names {name!r}, which is no node of a slice")
            if name not in interface:
                raise ModelError(
                    f"KLD: widths= names {name!r}, which the next slice does not read; bins are those of "
                    f"{', '.join(map(repr, interface))}"
                )
            if model[name].is_object:
                raise ModelError(
                    f"KLD: {name!r} holds objects, and bins are of numbers; leave it out of widths="
                )
            size = np.size(width)
            if size not in (1, math.prod(model[name].value_shape)):
                raise ModelError(
                    f"KLD: {name!r} has {math.prod(model[name].value_shape)} components, and widths= gives "
                    f"{size} for it"
                )

    def bins(self, values: Mapping[str, np.ndarray]) -> int:
        """How many bins hold a particle; ``values`` have the particles first."""
        columns = []
        for name, width in self.widths.items():
            value = values[name]
            flat = value.reshape(len(value), -1) / np.asarray(width, dtype=float)
            columns.append(np.floor(flat).astype(np.int64))
        keys = np.concatenate(columns, axis=1)
        keys -= keys.min(axis=0)
        spans = keys.max(axis=0) + 1
        if math.prod(map(int, spans)) >= 2**62:  # too wide for one number: compare rows
            return len(np.unique(keys, axis=0))
        code = keys[:, 0]
        for k in range(1, keys.shape[1]):
            code = code * spans[k] + keys[:, k]
        return len(np.unique(code))


# ---- private ------------------------------------------------------------------------------------


def _width(name: str, given: Any) -> float | tuple[float, ...]:
    """The width of a node's bins, as what compares and hashes."""
    try:
        array = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(())
    if array.ndim > 1 or not array.size or not ((array > 0) & (array < np.inf)).all():
        raise ValueError(
            f"KLD: the width of {name!r} is {given!r}; give a positive number, or one for each component"
        )
    return tuple(array.tolist()) if array.ndim else float(array)
