"""The exact rank test of whatever moves states: does it leave its posterior invariant?

A state that is known to be a draw of the posterior is put among those that a kernel makes of it; if the
kernel is right, nothing tells it from the others. No exact answer is needed, no effective size and no normal
limit. It does not test mixing: a kernel that never moves passes.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from bayesmc.errors import UnsupportedError
from bayesmc.network import BayesNet
from bayesmc.randomness import Purpose, seed_sequence, stream
from bayesmc.testing.kernels.joint import JointModel, Move, Statistics, check_sizes, values_of
from bayesmc.testing.kernels.moves import moves_of
from bayesmc.testing.kernels.uniformity import uniformity_p_value
from bayesmc.testing.verdict import Comparison, Verdict, check_level, counted


@dataclass(frozen=True, eq=False, repr=False)
class RankResult(Verdict):
    """What `rank_test` found: a `Verdict` on the ranks of statistics.

    A comparison shows the rank that came too often or too seldom by most, its count against what was
    expected; its p-value is that of the chi-square test of all ranks.

    Attributes
    ----------
    p_values : dict
        Statistic -> p-value.
    counts : dict
        Statistic -> how often each rank came, in the last stage; shape ``(steps + 1,)``.
    stage : int
        Stages run.
    judged : float
        Family-wise level that the last stage was judged at; ``alpha`` itself where only one was planned.
    is_own_reverse : bool
        Whether a function was taken for its own reverse.
    """

    p_values: Mapping[str, float] = field(default_factory=dict)
    counts: Mapping[str, np.ndarray] = field(default_factory=dict)
    stage: int = 1
    judged: float = 0.0
    is_own_reverse: bool = False

    @property
    def level(self) -> float:
        return self.judged

    def _remarks(self) -> list[str]:
        found = []
        if self.judged != self.alpha:
            found.append(f"  stage {self.stage}, judged at {self.judged:.3g}")
        if self.is_own_reverse and self.rejected:
            found.append(
                "  it is wrong; or it is right, keeps no detailed balance, and wants its reverse (reverse=)"
            )
        return found


def rank_test(
    kernel: Any,
    net: BayesNet | JointModel,
    reverse: Any = None,
    *,
    observed: str | Sequence[str] | None = None,
    statistics: Mapping[str, Callable[..., Any]] | None = None,
    inputs: Mapping[str, Any] | None = None,
    steps: int = 4,
    replications: int = 1000,
    thinning: int = 1,
    batched: bool = False,
    warmup: int | None = None,
    alpha: float = 1e-3,
    stages: int = 1,
    growth: int = 4,
    rng: Any = None,
) -> RankResult:
    """The exact rank test of a Markov kernel, of Gandy and Scott.

    A state is drawn from the prior, data given the state; so the state is a draw of the posterior. It is
    put at a random position of a chain of ``steps + 1`` states, which the kernel continues to the end, and
    the reversed kernel to the beginning. If the kernel leaves the posterior invariant, that is a
    stationary chain whatever the position, and the rank of the first state's statistic among all has the
    uniform law *exactly*: no effective sizes, no normal limit. Ties are broken at random. The ranks of
    independent replications are judged by Pearson's chi-square, with its exact p-value (see
    `uniformity_p_value`), and the statistics together by Holm's method.

    **An irreversible kernel needs its reverse.** One Metropolis-Hastings or slice move is its own reverse,
    and so is a Gibbs update of one block, or a sweep in random order. A sweep over blocks A, B, C in fixed
    order is not: its reverse is the sweep C, B, A of the reverses, which is what the test takes for
    engines; with a function of your own, give it. With a wrong reverse the test rejects a right kernel,
    sooner or later: the error may be small, and needs statistics that join the blocks.

    With ``stages`` > 1 the test is sequential (their algorithm 3): the first stage is judged at
    ``alpha / stages``; a p-value that leaves doubt calls for another stage of ``growth`` times as many
    replications, at a level raised by the rarity of coming so far. The chance of a false alarm over all
    stages is at most ``alpha``, which may then be as low as their 1e-5 with 7 stages, at the cost of
    hardly more than one stage for a right kernel.

    Parameters
    ----------
    kernel, net, observed, statistics, inputs, batched, warmup
        As `geweke_test` takes them.
    reverse : callable, optional
        The reverse of ``kernel``, in the same form. By default that of an engine's sweep, and of a function
        the function itself, which is right where it keeps detailed balance.
    steps : int
        Moves in the chain, at least 1; there are ``steps + 1`` ranks. As the chain of every replication has
        its own length either side, ``steps`` moves are made both ways and those beyond its ends not used.
    replications : int
        Independent chains, at least 20. More of them see smaller errors, and cost little where steps are
        batched; so do ``thinning`` and ``stages``.
    thinning : int
        Applications of the kernel in one move; for kernels that move little.
    alpha : float
        Chance of any false alarm.
    stages : int
        At most so many stages.
    growth : int
        Factor by which later stages are larger than the first.
    rng : optional
        Seed or generator.

    Returns
    -------
    RankResult

    Raises
    ------
    UnsupportedError
        Nothing that moves states; a net that cannot be drawn forwards; or an engine with a kernel whose
        reverse is not known.
    ModelError, ShapeError, DensityError
        As `geweke_test`.

    References
    ----------
    Gandy and Scott (2020), Unit testing for MCMC and other Monte Carlo methods, arXiv:2001.06465.
    Holm (1979), Scand. J. Statist. 6.

    Examples
    --------
    Metropolis-Hastings for ``x ~ N(0, 1)`` given ``y ~ N(x, 1)``, and one that forgets the prior.

    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.testing import rank_test
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> def metropolis(log_density):
    ...     def step(state, rng):
    ...         x, y = state["x"], state["y"]
    ...         new = rng.normal(x, 1.0)
    ...         log_ratio = log_density(new, y) - log_density(x, y)
    ...         return {"x": new if np.log(rng.random()) < log_ratio else x}
    ...     return step
    >>> right = metropolis(lambda x, y: -0.5 * x**2 - 0.5 * (y - x) ** 2)
    >>> wrong = metropolis(lambda x, y: -0.5 * (y - x) ** 2)
    >>> bool(rank_test(right, net, rng=0)), bool(rank_test(wrong, net, rng=0))
    (True, False)
    """
    check_level("rank_test", alpha)
    check_sizes("rank_test", steps=(steps, 1), replications=(replications, 20),
                thinning=(thinning, 1), stages=(stages, 1), growth=(growth, 1))  # fmt: skip
    generator = stream(seed_sequence(rng), Purpose.TEST)
    moves = moves_of(
        "rank_test", kernel, net, reverse=reverse, observed=observed, inputs=inputs,
        statistics=statistics, batched=batched, warmup=warmup, rows=replications,
    )  # fmt: skip
    if moves.backward is None:
        raise UnsupportedError(moves.why)
    level = alpha / stages
    doubt = level ** (1.0 / stages)
    for stage in range(1, stages + 1):
        count = replications if stage == 1 else growth * replications
        middle = moves.prior(generator, count)
        data = moves.simulate(middle, generator)
        both = (moves.forward, moves.backward)
        ranks = _ranks(moves.statistics, middle, data, both, (steps, thinning, count), generator)
        counts = {n: np.bincount(r, minlength=steps + 1) for n, r in ranks.items()}
        judged = {n: _judged(n, c) for n, c in counts.items()}
        comparisons = [*moves.faults, *judged.values()]
        lowest = min(c.p_value for c in comparisons) * len(comparisons)
        if stage == stages or lowest < level or lowest > doubt + level:
            break
        level /= doubt
    p_values = MappingProxyType({n: c.p_value for n, c in judged.items()})
    return counted(
        RankResult(
            "rank_test", alpha, comparisons, 0, p_values, counts, stage, level, moves.is_own_reverse
        )
    )


# ---- private ------------------------------------------------------------------------------------


def _judged(name: str, counts: np.ndarray) -> Comparison:
    """Are all ranks equally likely? Shown is the one that is farthest off."""
    expected = counts.sum() / len(counts)
    at = int(np.abs(counts - expected).argmax())
    errors = abs(counts[at] - expected) / np.sqrt(expected * (1.0 - 1.0 / len(counts)))
    p_value = uniformity_p_value(counts)
    what, count = f"{name}, rank {at}", float(counts[at])
    return Comparison(what, count, float(expected), float(errors), p_value, "expected")


def _ranks(
    statistics: Statistics,
    middle: Any,
    data: Any,
    moves: tuple[Move, Move],
    sizes: tuple[int, int, int],
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Rank, from 0, of every replication's first state in its chain; ``moves`` are forward, backward."""
    steps, thinning, count = sizes
    first = values_of("rank_test", statistics, middle, data, count)
    below = np.zeros(first.shape, dtype=int)
    tied = np.zeros(first.shape, dtype=int)
    # The position must differ between replications: given the position, ranks are not uniform.
    after = rng.integers(0, steps + 1, size=count)
    for move, length in zip(moves, (after, steps - after), strict=True):
        state = copy.deepcopy(middle)  # a kernel that works in place must not spoil the other way
        for t in range(steps):
            for _ in range(thinning):
                state = move(state, data, rng)
            values = values_of("rank_test", statistics, state, data, count)
            used = t < length
            below += (values < first) & used
            tied += (values == first) & used
    ranks = below + rng.integers(0, tied + 1)
    return dict(zip(statistics, ranks, strict=True))
