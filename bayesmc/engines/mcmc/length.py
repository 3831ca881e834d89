"""How many chains, how long a warmup, how many draws: where a run is asked for an effective size.

Chains are an array axis: up to some thousand numbers a sweep costs Python's calls and hardly more for many
chains than for few. Their number depends on the model's size alone, never on a clock, so that a seed gives
the same answer everywhere. Many chains are short, and their starts must be forgotten: groups of them
(superchains) start as one, and nested R-hat compares the groups.

References
----------
Margossian et al. (2024), Nested R-hat: assessing the convergence of Markov chain Monte Carlo when running
many short chains, Bayesian Analysis.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from bayesmc.network import Problem
from bayesmc.structure.target import target_of

#: numbers of all chains up to which a sweep costs little more than that of one chain
_NUMBERS = 4096
#: chains, least and most; effective draws that each must give at least, so that its own memory is judged
_LEAST, _MOST, _EACH = 4, 128, 8
#: superchains where there are enough chains, and chains that each has at least
_SUPERCHAINS, _MEMBERS = 8, 2
#: warmup where none is said, at most where its end is judged; the first sweep at which it may end
WARMUP, _FIRST = 1000, 100
#: draws of each chain after which one that did not get to its effective size gives up, and numbers that
#: are kept at most if these are enough for ``_FEWEST`` draws
_BUDGET, _KEPT, _FEWEST = 4000, 1 << 24, 1000
#: draws of each chain in the first round, at least, and how much longer a later round may make a run
_ROUND, _GROWTH = 16, 3.0


@dataclass(frozen=True)
class Lengths:
    """What a run makes.

    Attributes
    ----------
    chains : int
    superchains : int
        Groups of consecutive chains that start as one; 0 where every chain starts by itself.
    warmup : int
        Sweeps; at most, where ``judged``.
    judged : bool
        Whether the warmup ends as soon as chains have forgotten where they started.
    draws : int
        Of each chain; at most, where there is an ``ess``.
    ess : float or None
        Effective size after which nothing more is drawn.
    """

    chains: int
    superchains: int
    warmup: int
    judged: bool
    draws: int
    ess: float | None

    def ends(self) -> Iterator[int]:
        """Sweeps at which the warmup may end."""
        end = _FIRST
        while self.judged and end < self.warmup:
            yield end
            end *= 2
        yield self.warmup

    def first(self) -> int:
        """Draws of each chain in the first round."""
        if self.ess is None:
            return self.draws
        return min(max(math.ceil(self.ess / self.chains), _ROUND), self.draws)

    def further(self, made: int, share: float) -> int:
        """Draws of each chain in the next round, where those made are a share of what is wanted."""
        needed = made * min(1.05 / max(share, 1e-9), _GROWTH)
        return min(max(math.ceil(needed) - made, made // 8, 1), self.draws - made)

    def words(self, size: int) -> str:
        """What a run will do, for those who ask before."""
        many = f"{self.chains} chains"
        if self.superchains:
            many += f" from {self.superchains} starts"
        warm = f"at most {self.warmup}" if self.judged else f"{self.warmup}"
        if self.ess is None:
            return f"{many}, {warm} sweeps of warmup, {self.draws} draws each"
        return (
            f"{many}, all in one array of some {size * self.chains} numbers; {warm} sweeps of warmup; then draws "
            f"until the smallest effective size is {self.ess:g}, at most {self.draws} of each chain"
        )


def lengths_of(
    problem: Problem,
    draws: int | None,
    warmup: int | None,
    chains: int | None,
    ess: float,
    *,
    judges: bool,
    ensembles: bool,
    kept: Iterable[str] | None,
) -> Lengths:
    """What a run makes of its options: what is said is done, and the rest is chosen.

    Parameters
    ----------
    problem : Problem
    draws, warmup, chains : int or None
    ess : float
        The effective size that is asked for where ``draws`` is None.
    judges : bool
        Whether the engine's kernels learn in few sweeps, so that a warmup may end early.
    ensembles : bool
        Whether each chain is an array of members itself.
    kept : iterable of str or None
        Nodes whose draws are held; None where draws are summed.
    """
    if draws is not None:
        warm = WARMUP if warmup is None else warmup
        return Lengths(_LEAST if chains is None else chains, 0, warm, False, draws, None)
    if chains is None:
        chains = _LEAST
        if not ensembles and kept is not None:
            most = min(_MOST, ess / _EACH, _NUMBERS / size_of(problem))
            chains = max(_LEAST, 1 << int(math.log2(max(most, 1.0))))
    judged = judges and warmup is None
    warm = WARMUP if warmup is None else warmup
    groups = 0 if ensembles else _superchains(chains)
    budget = _BUDGET
    if kept is not None:
        numbers = sum(math.prod(problem.model[n].value_shape) for n in kept)
        budget = min(budget, max(_KEPT // max(numbers * chains, 1), _FEWEST))
    return Lengths(chains, groups, warm, judged, budget, ess)


def size_of(problem: Problem) -> int:
    """Numbers that the terms of one chain's density are made of: what a sweep's arithmetic grows with."""
    size = 0
    for term in target_of(problem).terms.values():
        event = () if term.is_potential else problem.model[term.name].event_shape
        size += math.prod(term.shape) * max(math.prod(event), 1)
    return max(size, 1)


# ---- private ------------------------------------------------------------------------------------


def _superchains(chains: int) -> int:
    """How many equal groups there may be; 0 where chains are few, and long enough to be judged alone."""
    for count in range(_SUPERCHAINS, _LEAST - 1, -1):
        if chains % count == 0 and chains // count >= _MEMBERS and chains >= 2 * _SUPERCHAINS:
            return count
    return 0
