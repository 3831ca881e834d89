"""Begin anew with some particles in every slice, so that a filter which is lost finds back.

With a small probability the state of a slice does not come from the one before but from a given density: the
robot that may have been carried away. That is a mixture of two transitions, and particles are weighted as
such; with a constant share the answers are those of the model with this transition. The share may also follow
how well the last observations were explained (augmented Monte Carlo localization).

References
----------
Thrun, Burgard and Fox (2005), Probabilistic Robotics, table 8.3; Gutmann and Fox (2002), An experimental
comparison of localization methods continued.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from numbers import Real
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from bayesmc.dbn import Row
from bayesmc.engines.proposal import FUNCTION, as_function, check_specification

#: sets of what was seen whose averages are kept: beliefs of endless series stay small
_SETS = 64


@dataclass(frozen=True)
class Recovery:
    """Which share of the particles begins anew in every slice, and where.

    Parameters
    ----------
    density : dict
        Node -> density that its state has where a slice begins anew: a distribution, or a function of inputs,
        ``t`` and nodes drawn before; what depends on the node cannot be read (see ``proposal``). All nodes
        that the next slice reads are named.
    share : float
        Probability that a slice begins anew, between 0 and 1.
    draws : float
        Share of the particles that are drawn anew, where that is more than ``share``; weights make up for
        it. Below 1, unless ``share`` is 1. With a ``proposal`` that knows where to look, a robot that is
        hardly ever carried away (a ``share`` of 1e-6, say) is still looked for elsewhere in every slice.
    slow, fast : float
        Rates at which two running averages of the density of the rows forget, ``0 < slow < fast <= 1``; the
        share is then at least one minus their ratio, fast over slow. Both 0 leave the share as it is. Rows
        are compared with rows that have the same nodes seen (and the same elements of these): each such set
        has averages of its own, the share follows those of the last row, and a set that is new leaves it
        as it is.
    proposal : dict, optional
        Node -> what is drawn from where a slice begins anew, which may look at observed nodes: the sensor
        says where the robot could be. Weights are multiplied by density over proposal.

    Raises
    ------
    ValueError, TypeError, ModelError

    Notes
    -----
    With averages the share depends on rows that were seen, and the evidence is no longer that of one model.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc import Recovery
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.1), initial=bmc.Uniform(0.0, 100.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    >>> recovery = Recovery({"x": bmc.Uniform(0.0, 100.0)}, share=0.02)
    >>> engine = bmc.ParticleFilter(2000, recovery=recovery)
    >>> filtered = bmc.filter(dbn, {"y": [20.0] * 5 + [80.0] * 5}, engine=engine, rng=0)
    >>> filtered.mean("x")[[4, 9]].round(0).tolist()
    [20.0, 80.0]
    """

    density: Mapping[Any, Any] = field(hash=False)
    share: float = 0.0
    slow: float = 0.0
    fast: float = 0.0
    draws: float = 0.0
    proposal: Mapping[Any, Any] | None = field(default=None, hash=False)

    def __post_init__(self) -> None:
        self._check_densities()
        for option in ("share", "draws"):
            given = getattr(self, option)
            is_number = isinstance(given, Real)
            if not is_number or not 0.0 <= given <= 1.0:
                raise ValueError(f"Recovery({option}={given!r}): give a probability, 0 to 1")
        if self.draws == 1.0 and self.share < 1.0:
            raise ValueError(
                f"Recovery(share={self.share!r}, draws=1.0): no particle would come from the slice before, "
                f"which a share of {1.0 - self.share:.3g} of the model does; give draws= below 1"
            )
        off = self.slow == 0.0 and self.fast == 0.0
        numbers = isinstance(self.slow, Real) and isinstance(self.fast, Real)
        if not off and not (numbers and 0.0 < self.slow < self.fast <= 1.0):
            raise ValueError(
                f"Recovery(slow={self.slow!r}, fast={self.fast!r}): give rates with 0 < slow < fast <= 1, "
                "such as 0.001 and 0.1, or neither"
            )
        if off and self.share == 0.0:
            raise ValueError(
                "Recovery: give a share= above 0, or the rates slow= and fast=; nothing would begin anew"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions."""
        bare = {o: dict.fromkeys(getattr(self, o) or {}) for o in ("density", "proposal")}
        return {**self.__dict__, **bare}

    def __deepcopy__(self, memo: Any) -> Recovery:
        return self

    @property
    def is_whole(self) -> bool:
        """Whether it has its functions, which pickles leave behind."""
        given = [*self.density.values(), *(self.proposal or {}).values()]
        return all(value is not None for value in given)

    def _check_densities(self) -> None:
        for option in ("density", "proposal"):
            given = getattr(self, option)
            if given is None and option == "proposal":
                continue
            checked = check_specification("Recovery", given, FUNCTION, option)
            for key, spec in checked.items():
                if not isinstance(key, str):
                    raise TypeError(
                        f"Recovery: {option}= has the key {key!r}; name one node, whose density may read "
                        "those named before"
                    )
                as_function("Recovery", key, spec, FUNCTION, option)
            object.__setattr__(self, option, MappingProxyType(checked))

    def share_of(self, averages: Averages | None) -> float:
        """The share of the next slice."""
        if averages is None or not self.slow:
            return self.share
        slow, fast = averages.logs[averages.last]
        return max(self.share, 1.0 - math.exp(min(fast - slow, 0.0)))

    def drawn(self, share: float) -> float:
        """The share of the particles that are drawn anew."""
        return max(share, self.draws) if share > 0.0 else 0.0

    def averaged(self, averages: Averages | None, row: Row, increment: Any) -> Averages | None:
        """The averages after one more row, whose log density this is."""
        if not self.slow:
            return None
        now, seen = float(np.asarray(increment)), _what_is_seen(row)
        logs = {} if averages is None else dict(averages.logs)
        slow, fast = logs.pop(seen, (now, now))
        logs[seen] = (_mixed(slow, now, self.slow), _mixed(fast, now, self.fast))
        if len(logs) > _SETS:
            del logs[next(iter(logs))]
        return Averages(seen, logs)


class Averages(NamedTuple):
    """Running averages of the densities of rows, for each set of entries that rows were seen to have.

    Densities of different numbers of readings, or of readings in different units, do not compare.

    Attributes
    ----------
    last : tuple
        What the last row had seen of it.
    logs : dict
        What was seen -> logs of the slow and of the fast average; those that moved last come last.
    """

    last: tuple[Any, ...]
    logs: Mapping[tuple[Any, ...], tuple[float, float]]


# ---- private ------------------------------------------------------------------------------------


def _what_is_seen(row: Row) -> tuple[Any, ...]:
    """The entries of a row that were seen: nodes, with masks where these are seen in part."""
    masks = {name: seen.mask for name, seen in row.seen.items()}
    return tuple((n, None if m is None else m.tobytes()) for n, m in sorted(masks.items()))


def _mixed(log: float, now: float, rate: float) -> float:
    """Log of the average that moves at a rate towards what is now."""
    if rate >= 1.0:
        return now
    return float(np.logaddexp(math.log1p(-rate) + log, math.log(rate) + now))
