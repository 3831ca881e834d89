"""Geweke's joint-distribution test of whatever moves states: does it leave its posterior invariant?

What the kernel makes of joint draws of state and data is compared with the joint law itself, so that a wrong
conditional density shows although nobody knows the right posterior. It does not test mixing: a kernel
that never moves passes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
import scipy.special

from bayesmc.network import BayesNet
from bayesmc.randomness import Purpose, seed_sequence, stream
from bayesmc.testing.kernels.joint import JointModel, check_sizes, values_of
from bayesmc.testing.kernels.moves import moves_of
from bayesmc.testing.verdict import Comparison, Verdict, check_level, counted

#: draws of each chain by default, and where each costs a compilation
_DRAWS, _FEW = 200, 30
#: effective draws of the rarer of two values below which a mean has no normal limit
_FEWEST = 30.0


@dataclass(frozen=True, eq=False, repr=False)
class GewekeResult(Verdict):
    """What `geweke_test` found: a `Verdict` on the means of statistics.

    Attributes
    ----------
    p_values, ess : dict
        Statistic -> two-sided p-value; effective number of draws under the kernel.
    is_default : bool
        Whether the statistics are those taken by default: scaled and bounded, but for shares of states.
    """

    p_values: Mapping[str, float] = field(default_factory=dict)
    ess: Mapping[str, float] = field(default_factory=dict)
    is_default: bool = False

    def _remarks(self) -> list[str]:
        if not (self.is_default and self.rejected):
            return []
        return [
            "  (shares of states are as they are; other numbers of nodes less their median under the joint "
            "law, over their spread; of what is above zero, of its logarithm)"
        ]


def geweke_test(
    kernel: Any,
    net: BayesNet | JointModel,
    *,
    observed: str | Sequence[str] | None = None,
    statistics: Mapping[str, Callable[..., Any]] | None = None,
    inputs: Mapping[str, Any] | None = None,
    draws: int | None = None,
    chains: int = 64,
    thinning: int = 1,
    batched: bool = False,
    warmup: int | None = None,
    alpha: float = 1e-3,
    rng: Any = None,
) -> GewekeResult:
    """Geweke's joint-distribution test of a Markov kernel.

    Two simulators of the joint law of state and data are compared. The marginal-conditional one draws the
    state from the prior and data given the state. The successive-conditional one starts there too, and
    then alternates: new data are drawn given the state, and the kernel moves the state given the data.
    If the kernel leaves the posterior invariant for all data, both have the same law, and so the same mean
    of every statistic. Statistics are read from the state with the data that it was moved by.

    A difference of means is judged by its standard error: the variance of the first simulator, whose draws
    are independent, over the number of those and the effective number of the second's (all chains
    together; at most what the spread of the chains' means allows), in the tails of Student's t with
    ``chains - 1`` degrees of freedom, because with slow chains the effective number is known no better
    than that. The chance of a false alarm is at most ``alpha`` as far as means are normal (all statistics
    together, by Holm's method); heavy-tailed statistics with slow chains need more chains.

    Only means are compared: give squares and products too, or an error in a spread or in a dependence
    goes unseen. An error that nearly freezes the chains leaves one effective draw of each: take more
    chains rather than longer ones.

    Parameters
    ----------
    kernel : engine, callable or bayesmc kernel
        An engine of Markov chains (its sweep, after a warmup); a function ``step(state, rng) -> state``,
        where ``state`` maps every node of the net to its value and the result holds the new values of hidden
        nodes (those left out stay); or a function from a `Target` to a kernel of bayesmc.
    net : BayesNet or JointModel
        The joint law. With a `JointModel` a kernel is a function ``kernel(state, data, rng)``.
    observed : str or sequence of str, optional
        Nodes that are data; by default those that nothing stochastic depends on, where others remain.
    statistics : dict, optional
        Name -> function whose arguments are nodes, which returns one finite number for each draw (nodes
        arrive as ``(draws, *plates, *event)``). By default means, squares and products of all
        hidden nodes, products with the data, and the joint log density.
    inputs : dict, optional
        Of the net.
    draws : int, optional
        Draws kept of each chain, at least 10; by default 200, or 30 where an engine reads the evidence
        when it compiles, so that every data set costs a millisecond or more.
    chains : int
        Chains, all in one array; at least 8. The first simulator makes ``draws * chains`` draws too.
    thinning : int
        Rounds of kernel and data between draws that are kept.
    batched : bool
        Whether ``step`` takes and returns arrays with one row for each of many states.
    warmup : int, optional
        Sweeps in which an engine adapts beforehand; by default its own, at most 200 (20 where every data set
        is compiled for).
    alpha : float
        Chance of any false alarm.
    rng : optional
        Seed or generator.

    Returns
    -------
    GewekeResult
        True where nothing deviates.

    Raises
    ------
    ModelError
        The data cannot be drawn given the state; or ``step`` moved data.
    UnsupportedError
        Nothing that moves states, or a net that cannot be drawn forwards.
    ShapeError, DensityError
        A statistic does not return one finite number for each row.

    References
    ----------
    Geweke (2004), Getting it right: joint distribution tests of posterior simulators, JASA 99.
    Holm (1979), Scand. J. Statist. 6.

    Examples
    --------
    The posterior of ``x ~ N(0, 1)`` given ``y ~ N(x, 1)`` is ``N(y / 2, 1 / 2)``; a kernel may draw from
    it, but not with the variance in the place of the standard deviation.

    >>> import bayesmc as bmc
    >>> from bayesmc.testing import geweke_test
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> def right(state, rng):
    ...     return {"x": rng.normal(state["y"] / 2, 0.5**0.5)}
    >>> def wrong(state, rng):
    ...     return {"x": rng.normal(state["y"] / 2, 0.5)}
    >>> bool(geweke_test(right, net, draws=50, rng=0)), bool(geweke_test(wrong, net, draws=50, rng=0))
    (True, False)
    """
    check_level("geweke_test", alpha)
    check_sizes("geweke_test", draws=(10 if draws is None else draws, 10), chains=(chains, 8),
                thinning=(thinning, 1))  # fmt: skip
    generator = stream(seed_sequence(rng), Purpose.TEST)
    moves = moves_of(
        "geweke_test", kernel, net, observed=observed, inputs=inputs, statistics=statistics,
        batched=batched, warmup=warmup, rows=chains,
    )  # fmt: skip
    draws = draws or (_DRAWS if moves.is_quick else _FEW)
    names = list(moves.statistics)
    joint = np.empty((draws, len(names), chains))
    successive = np.empty_like(joint)
    for t in range(draws):
        state = moves.prior(generator, chains)
        data = moves.simulate(state, generator)
        joint[t] = values_of("geweke_test", moves.statistics, state, data, chains)
    state = moves.prior(generator, chains)
    for t in range(draws):
        for _ in range(thinning):
            data = moves.simulate(state, generator)
            state = moves.forward(state, data, generator)
        # with the data that it was moved by: new ones would hide a kernel that pays them no heed
        successive[t] = values_of("geweke_test", moves.statistics, state, data, chains)
    found = [_compare_means(name, joint[:, s], successive[:, s].T) for s, name in enumerate(names)]
    judged = [c for c, _ in found if c is not None]
    comparisons = [*moves.faults, *judged]
    ess = {name: size for name, (_, size) in zip(names, found, strict=True)}
    p_values = MappingProxyType({c.what: c.p_value for c in judged})
    return counted(
        GewekeResult(
            "geweke_test",
            alpha,
            comparisons,
            len(names) - len(judged),
            p_values,
            ess,
            statistics is None and not isinstance(net, JointModel),
        )
    )


# ---- private ------------------------------------------------------------------------------------


def _compare_means(
    name: str, joint: np.ndarray, successive: np.ndarray
) -> tuple[Comparison | None, float]:
    """One statistic, and its effective size; ``successive`` has shape (chain, draw).

    None where nearly all values are the same in both, and too few others for a normal limit.
    """
    ess = _mean_ess(successive)
    found, counts = np.unique(joint, return_counts=True)
    mode = found[counts.argmax()] if len(found) < 5 else np.nan  # of many values none counts
    others = (joint != mode).mean() * joint.size, (successive != mode).mean() * ess
    if 0.0 < max(others) < _FEWEST:
        return None, ess
    with np.errstate(over="ignore"):
        difference = float(successive.mean() - joint.mean())
    # The spread of the independent draws: under the null it is that of the chains too, and a chain
    # that runs off does not hide behind its own spread; one that finds what is rare has only its own.
    spread = float(joint.std())
    if others[0] < _FEWEST:
        spread = max(spread, float(successive.std()))
    error = spread * np.sqrt(1.0 / joint.size + 1.0 / ess)
    tiny = 1e-12 * max(1.0, abs(float(joint.mean())))
    if error <= tiny:  # a constant: equal or not, up to rounding
        z = 0.0 if abs(difference) <= tiny else float(np.copysign(np.inf, difference))
    else:
        z = difference / error
    p_value = 2.0 * float(scipy.special.stdtr(len(successive) - 1, -abs(z)))
    means = float(successive.mean()), float(joint.mean())
    return Comparison(name, *means, abs(z), p_value, "under the joint law"), ess


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
