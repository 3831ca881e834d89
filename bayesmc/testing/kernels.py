"""Does a Markov kernel leave its posterior invariant? Two tests that need no exact answer.

Both work on plain functions: a prior, a simulator of data given the state, and the kernel. They compare
what the kernel makes of joint draws of state and data with the joint law itself, so that a wrong
conditional density shows although nobody knows the right posterior. They do not test mixing: a kernel
that never moves passes.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import scipy.special

from bayesmc.errors import DensityError, ShapeError
from bayesmc.randomness import seed_sequence
from bayesmc.testing.matching import holm
from bayesmc.testing.uniformity import uniformity_p_value

#: ``prior(rng, n)``: ``n`` draws of the state, in arrays (or a container of arrays) of ``n`` rows
Prior = Callable[[np.random.Generator, int], Any]
#: ``simulate(state, rng)``: data for every row of the state
Simulate = Callable[[Any, np.random.Generator], Any]
#: ``kernel(state, data, rng)``: the next state of every row
Kernel = Callable[[Any, Any, np.random.Generator], Any]
#: name -> ``statistic(state, data)``, one real number for every row
Statistics = Mapping[str, Callable[[Any, Any], Any]]


@dataclass(frozen=True, eq=False, repr=False)
class GewekeResult:
    """What `geweke_test` found.

    Attributes
    ----------
    p_values : dict
        Name of the statistic -> two-sided p-value.
    z : dict
        Mean under the kernel minus mean under the joint law, in standard errors.
    ess : dict
        Effective number of draws under the kernel.
    """

    p_values: Mapping[str, float]
    z: Mapping[str, float]
    ess: Mapping[str, float]

    def rejected(self, alpha: float = 1e-3) -> tuple[str, ...]:
        """Statistics whose means differ, least likely first; ``alpha`` is the chance of any false alarm."""
        return _rejected(self.p_values, alpha)

    def __repr__(self) -> str:
        rows = [
            f"  {name}: p = {self.p_values[name]:.3g}, z = {self.z[name]:+.2f}, ess = {self.ess[name]:.0f}"
            for name in _by_p_value(self.p_values)
        ]
        return "\n".join(["GewekeResult", *rows])


@dataclass(frozen=True, eq=False, repr=False)
class RankResult:
    """What `rank_test` found.

    Attributes
    ----------
    p_values : dict
        Name of the statistic -> p-value of the chi-square test that its ranks are uniform, in the last
        stage that was run.
    counts : dict
        Name of the statistic -> how often each rank came, in that stage; shape ``(steps + 1,)``.
    alpha : float
        Chance of any false alarm, over all statistics and stages.
    stage : int
        Stages run.
    level : float
        Family-wise level the last stage was judged at; ``alpha`` itself where only one was planned.
    """

    p_values: Mapping[str, float]
    counts: Mapping[str, np.ndarray]
    alpha: float
    stage: int
    level: float

    def rejected(self) -> tuple[str, ...]:
        """Statistics whose ranks are not uniform, least likely first (Holm's method at ``level``)."""
        return _rejected(self.p_values, self.level)

    def __repr__(self) -> str:
        head = f"RankResult, alpha = {self.alpha:g}, stage {self.stage} judged at {self.level:.3g}"
        rows = [
            f"  {name}: p = {self.p_values[name]:.3g}, ranks {self.counts[name].tolist()}"
            for name in _by_p_value(self.p_values)
        ]
        return "\n".join([head, *rows])


def geweke_test(
    prior: Prior,
    simulate: Simulate,
    kernel: Kernel,
    statistics: Statistics,
    *,
    draws: int = 500,
    chains: int = 64,
    thinning: int = 1,
    rng: Any = None,
) -> GewekeResult:
    """Geweke's joint-distribution test of a Markov kernel.

    Two simulators of the joint law of state and data are compared. The marginal-conditional one draws the
    state from the prior and data given the state. The successive-conditional one starts there too, and
    then alternates: the kernel moves the state given the data, and new data are drawn given the state.
    If the kernel leaves the posterior invariant for all data, both have the same law, and so the same mean
    of every statistic.

    A difference of means is judged by its standard error: the variance of the first simulator, whose draws
    are independent, over the number of those and the effective number of the second's (all chains
    together; at most what the spread of the chains' means allows), in the tails of Student's t with
    ``chains - 1`` degrees of freedom, because with slow chains the effective number is known no better
    than that. The chance of a false alarm is at most ``alpha`` of `GewekeResult.rejected` as far as means
    are normal; heavy-tailed statistics with slow chains need more chains.

    Only means are compared: give squares and products too, or an error in a spread or in a dependence
    goes unseen. An error that nearly freezes the chains leaves one effective draw of each: take more
    chains rather than longer ones. A kernel that adapts must be frozen first.

    Parameters
    ----------
    prior : callable
        ``prior(rng, n)`` returns ``n`` independent states; arrays with ``n`` rows, in any container.
    simulate : callable
        ``simulate(state, rng)`` returns data given each row of ``state``.
    kernel : callable
        ``kernel(state, data, rng)`` returns the next state; each row moves given its own data.
    statistics : dict
        Name -> ``statistic(state, data)``, which returns one finite number for each row.
    draws : int
        Draws kept of each chain, at least 10.
    chains : int
        Chains, all in one array; at least 8. The first simulator makes ``draws * chains`` draws too.
    thinning : int
        Rounds of kernel and data between draws that are kept.
    rng : optional
        Seed or generator.

    Returns
    -------
    GewekeResult

    Raises
    ------
    ShapeError
        A statistic does not return one number for each row.
    DensityError
        A statistic is not finite.

    References
    ----------
    Geweke (2004), Getting it right: joint distribution tests of posterior simulators, JASA 99.
    Holm (1979), Scand. J. Statist. 6.

    Examples
    --------
    The posterior of ``x ~ N(0, 1)`` given ``y ~ N(x, 1)`` is ``N(y / 2, 1 / 2)``; a kernel may draw from
    it, but not with the variance in the place of the standard deviation.

    >>> from bayesmc.testing import geweke_test
    >>> def prior(rng, n):
    ...     return rng.normal(size=n)
    >>> def simulate(x, rng):
    ...     return rng.normal(x, 1.0)
    >>> def right(x, y, rng):
    ...     return rng.normal(y / 2, 0.5**0.5)
    >>> def wrong(x, y, rng):
    ...     return rng.normal(y / 2, 0.5)
    >>> statistics = {"x": lambda x, y: x, "x^2": lambda x, y: x**2}
    >>> geweke_test(prior, simulate, right, statistics, draws=100, rng=0).rejected()
    ()
    >>> geweke_test(prior, simulate, wrong, statistics, draws=100, rng=0).rejected()
    ('x^2',)
    """
    _check("geweke_test", statistics, draws=(draws, 10), chains=(chains, 8), thinning=(thinning, 1))
    generator = np.random.default_rng(seed_sequence(rng))
    joint = np.empty((draws, len(statistics), chains))
    successive = np.empty_like(joint)
    for t in range(draws):
        state = prior(generator, chains)
        joint[t] = _values("geweke_test", statistics, state, simulate(state, generator), chains)
    state = prior(generator, chains)
    data = simulate(state, generator)
    for t in range(draws):
        for _ in range(thinning):
            state = kernel(state, data, generator)
            data = simulate(state, generator)
        successive[t] = _values("geweke_test", statistics, state, data, chains)
    found = [_compare_means(joint[:, s], successive[:, s].T) for s in range(len(statistics))]
    p_values, z, ess = (
        MappingProxyType(dict(zip(statistics, column, strict=True)))
        for column in zip(*found, strict=True)
    )
    return GewekeResult(p_values, z, ess)


def rank_test(
    prior: Prior,
    simulate: Simulate,
    kernel: Kernel,
    statistics: Statistics,
    *,
    steps: int = 9,
    replications: int = 1000,
    thinning: int = 1,
    reverse_kernel: Kernel | None = None,
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
    order is not: its reverse is the sweep C, B, A of the reverses. With a wrong reverse the test rejects
    a right kernel, sooner or later: the error may be small, and needs statistics that join the blocks.

    With ``stages`` > 1 the test is sequential (their algorithm 3): the first stage is judged at
    ``alpha / stages``; a p-value that leaves doubt calls for another stage of ``growth`` times as many
    replications, at a level raised by the rarity of coming so far. The chance of a false alarm over all
    stages is at most ``alpha``, which may then be as low as their 1e-5 with 7 stages, at the cost of
    hardly more than one stage for a right kernel.

    Parameters
    ----------
    prior, simulate, kernel, statistics
        As `geweke_test` takes them. ``kernel`` may overwrite the state it is given, but not the data.
    steps : int
        Moves in the chain, at least 1; there are ``steps + 1`` ranks. As the chain of every replication has
        its own length either side, ``steps`` moves are made both ways and those beyond its ends not used.
    replications : int
        Independent chains, all in one array. Fewer than 5 for each rank leave little power.
    thinning : int
        Applications of the kernel in one move; for kernels that move little.
    reverse_kernel : callable, optional
        The reverse of ``kernel``; by default the kernel itself, which is right where it satisfies
        detailed balance.
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
    ShapeError
        A statistic does not return one number for each row.
    DensityError
        A statistic is not finite.

    References
    ----------
    Gandy and Scott (2020), Unit testing for MCMC and other Monte Carlo methods, arXiv:2001.06465.
    Holm (1979), Scand. J. Statist. 6.

    Examples
    --------
    Metropolis-Hastings for ``x ~ N(0, 1)`` given ``y ~ N(x, 1)``, and one that forgets the prior.

    >>> import numpy as np
    >>> from bayesmc.testing import rank_test
    >>> def prior(rng, n):
    ...     return rng.normal(size=n)
    >>> def simulate(x, rng):
    ...     return rng.normal(x, 1.0)
    >>> def metropolis(log_density):
    ...     def kernel(x, y, rng):
    ...         new = rng.normal(x, 1.0)
    ...         log_ratio = log_density(new, y) - log_density(x, y)
    ...         return np.where(np.log(rng.random(len(x))) < log_ratio, new, x)
    ...     return kernel
    >>> right = metropolis(lambda x, y: -0.5 * x**2 - 0.5 * (y - x) ** 2)
    >>> wrong = metropolis(lambda x, y: -0.5 * (y - x) ** 2)
    >>> statistics = {"x": lambda x, y: x, "x^2": lambda x, y: x**2}
    >>> rank_test(prior, simulate, right, statistics, replications=300, rng=0).rejected()
    ()
    >>> rank_test(prior, simulate, wrong, statistics, replications=300, rng=0).rejected()
    ('x^2',)
    """
    _check("rank_test", statistics, steps=(steps, 1), replications=(replications, 1),
           thinning=(thinning, 1), stages=(stages, 1), growth=(growth, 1))  # fmt: skip
    if not 0.0 < alpha < 1.0:
        raise ValueError(f"rank_test(alpha={alpha}): give a probability strictly between 0 and 1")
    generator = np.random.default_rng(seed_sequence(rng))
    level = alpha / stages
    doubt = level ** (1.0 / stages)
    for stage in range(1, stages + 1):
        count = replications if stage == 1 else growth * replications
        middle = prior(generator, count)
        data = simulate(middle, generator)
        moves = (kernel, kernel if reverse_kernel is None else reverse_kernel)
        ranks = _ranks(statistics, middle, data, moves, (steps, thinning, count), generator)
        counts = {n: np.bincount(r, minlength=steps + 1) for n, r in ranks.items()}
        p_values = {n: uniformity_p_value(c) for n, c in counts.items()}
        lowest = min(p_values.values()) * len(p_values)
        if stage == stages or lowest < level or lowest > doubt + level:
            break
        level /= doubt
    return RankResult(MappingProxyType(p_values), MappingProxyType(counts), alpha, stage, level)


# ---- private ------------------------------------------------------------------------------------


def _compare_means(joint: np.ndarray, successive: np.ndarray) -> tuple[float, float, float]:
    """p-value, z and effective size of one statistic; ``successive`` has shape (chain, draw)."""
    ess = _mean_ess(successive)
    with np.errstate(over="ignore"):
        difference = float(successive.mean() - joint.mean())
    # The spread of the independent draws: under the null it is that of the chains too, and a chain
    # that runs off does not hide behind its own spread.
    error = float(joint.std()) * np.sqrt(1.0 / joint.size + 1.0 / ess)
    tiny = 1e-12 * max(1.0, abs(float(joint.mean())))
    if error <= tiny:  # a constant: equal or not, up to rounding
        z = 0.0 if abs(difference) <= tiny else float(np.copysign(np.inf, difference))
    else:
        z = difference / error
    p_value = 2.0 * float(scipy.special.stdtr(len(successive) - 1, -abs(z)))
    return p_value, z, ess


def _mean_ess(values: np.ndarray) -> float:
    """Effective size for the mean, without the ranks of ArviZ's default: means are what is compared."""
    from arviz_stats.base import array_stats

    if np.ptp(values) == 0:
        return float(values.size)
    # Scaled, so that the squares of a chain that runs off do not overflow; the size does not change.
    scaled = values / np.max(np.abs(values))
    ess = float(array_stats.ess(scaled, chain_axis=0, draw_axis=1, method="mean"))
    # Autocorrelations longer than half a chain are cut off there; the spread of the chains' own means
    # sees them, so that the error is never below that of independent chains.
    spread = float(scaled.mean(axis=1).var(ddof=1))
    return min(ess, len(values) * float(scaled.var()) / spread) if spread > 0 else ess


def _ranks(
    statistics: Statistics,
    middle: Any,
    data: Any,
    moves: tuple[Kernel, Kernel],
    sizes: tuple[int, int, int],
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Rank, from 0, of every replication's first state in its chain; ``moves`` are forward, backward."""
    steps, thinning, count = sizes
    first = _values("rank_test", statistics, middle, data, count)
    below = np.zeros(first.shape, dtype=int)
    tied = np.zeros(first.shape, dtype=int)
    # The position must differ between replications: given the position, ranks are not uniform.
    after = rng.integers(0, steps + 1, size=count)
    for move, length in zip(moves, (after, steps - after), strict=True):
        state = copy.deepcopy(middle)  # a kernel that works in place must not spoil the other way
        for t in range(steps):
            for _ in range(thinning):
                state = move(state, data, rng)
            values = _values("rank_test", statistics, state, data, count)
            used = t < length
            below += (values < first) & used
            tied += (values == first) & used
    ranks = below + rng.integers(0, tied + 1)
    return dict(zip(statistics, ranks, strict=True))


def _values(call: str, statistics: Statistics, state: Any, data: Any, rows: int) -> np.ndarray:
    """All statistics, shape ``(statistics, rows)``; a copy, for kernels that work in place."""
    out = np.empty((len(statistics), rows))
    for i, (name, statistic) in enumerate(statistics.items()):
        value = np.asarray(statistic(state, data))
        if value.shape != (rows,):
            raise ShapeError(
                f"{call}: statistic {name!r} returned shape {value.shape} for {rows} rows; "
                f"return one number for each row, shape ({rows},)"
            )
        out[i] = value
        if not np.isfinite(out[i]).all():
            row = int(np.flatnonzero(~np.isfinite(out[i]))[0])
            raise DensityError(
                f"{call}: statistic {name!r} is {out[i, row]} in row {row}; "
                "look for a kernel that leaves the support, or use a bounded statistic"
            )
    return out


def _check(call: str, statistics: Statistics, **sizes: tuple[Any, int]) -> None:
    if not statistics:
        raise ValueError(f"{call}: no statistics; give a dict of name -> function(state, data)")
    for name, (size, least) in sizes.items():
        if not isinstance(size, (int, np.integer)) or size < least:
            raise ValueError(f"{call}({name}={size!r}): give a whole number, at least {least}")


def _by_p_value(p_values: Mapping[str, float]) -> list[str]:
    return sorted(p_values, key=p_values.__getitem__)


def _rejected(p_values: Mapping[str, float], alpha: float) -> tuple[str, ...]:
    """Step down through the p-values, smallest first, until one is not rejected."""
    names = _by_p_value(p_values)
    return tuple(names[: holm([p_values[name] for name in names], alpha)])
