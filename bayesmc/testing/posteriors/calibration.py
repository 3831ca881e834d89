"""Simulation-based calibration: is a sampler's posterior right on average over all that the net can say?

Truth and data are drawn from the net, the sampler is run on the data, and the truth must then look like one
more of its draws. It needs no exact answer and takes any engine; it sees what a posterior gets wrong for data
as the net makes them, not for one data set, and not what no statistic depends on.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.auto import infer
from bayesmc.dbn.template import DynamicBayesNet
from bayesmc.engines.base import Engine
from bayesmc.errors import BayesmcWarning, UnsupportedError
from bayesmc.network import BayesNet, FactorGraph
from bayesmc.randomness import Purpose, seed_sequence, stream
from bayesmc.results import Posterior
from bayesmc.testing.kernels.joint import JointModel, NetJoint, Rows, check_sizes
from bayesmc.testing.posteriors.bands import Uniformity, ecdf_band, ecdf_points, ecdf_uniformity
from bayesmc.testing.posteriors.differences import Differences, draw_differences
from bayesmc.testing.posteriors.quantities import Quantities
from bayesmc.testing.posteriors.shares import Draws, posterior_draws, share_below, users_draws
from bayesmc.testing.verdict import Comparison, Verdict, check_level, counted

_CALL = "simulation_based_calibration"
#: rows of draws whose statistics are evaluated together
_ROWS = 100_000
#: effective weighted draws below which the uniform law of a rank is not to be relied upon
_FEW = 50
#: between the name of a statistic and the point, in words
_SHARE = ": share of ranks up to "


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class CalibrationResult(Verdict):
    """What `simulation_based_calibration` found.

    Attributes
    ----------
    ranks : dict
        Statistic -> share of the posterior below the truth, one for every replication, in (0, 1): the rank
        of the truth with a uniform number in place of its own step, so that there are no ties.
    counts : dict
        Statistic -> draws behind each rank after thinning (effective ones, for weighted draws).
    points : ndarray, shape (K - 1,)
        Where empirical distribution functions are compared with the diagonal.
    low, high : ndarray, shape (K - 1,)
        Band in which ``ecdf_difference`` stays for all statistics, but for a chance of ``alpha``.
    warned : dict
        Kind of warning -> runs that gave it.
    uncertain : int
        Runs whose weights are worth too few draws for the uniform law of their ranks to be relied upon.
    is_default : bool
        Whether the statistics are those taken by default, not a user's own.
    """

    ranks: Mapping[str, np.ndarray]
    counts: Mapping[str, np.ndarray]
    points: np.ndarray
    low: np.ndarray
    high: np.ndarray
    warned: Mapping[str, int]
    uncertain: int
    is_default: bool

    @property
    def deviating(self) -> tuple[str, ...]:
        """Statistics whose ranks are not uniform, least likely first."""
        return tuple(c.what.rsplit(_SHARE, 1)[0] for c in self.rejected)

    @property
    def ecdf_difference(self) -> dict[str, np.ndarray]:
        """Statistic -> share of its ranks up to ``points`` less ``points``."""
        return {
            name: np.searchsorted(np.sort(ranks), self.points, side="right") / len(ranks)
            - self.points
            for name, ranks in self.ranks.items()
        }

    def plot(self, ax: Any = None) -> Any:
        """Draw the differences of distribution functions with their band.

        In panels what deviates is red; in one Axes it is thick, and every statistic has a colour of its own.

        A hump means that truths lie too low among the draws, a dip that they lie too high; up first and down
        later that the posterior is too narrow, down first that it is too wide.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            For all statistics together; by default a new figure, with a panel for each.

        Returns
        -------
        ndarray of matplotlib.axes.Axes

        Raises
        ------
        MissingExtraError
            Without matplotlib (the extra ``plot``).
        """
        band = self.points, self.low, self.high
        return draw_differences(
            Differences(self.ecdf_difference, *band, self.alpha, self.deviating), ax
        )

    def _remarks(self) -> list[str]:
        lines = [
            f"  {name}: {_in_words(self.ranks[name], self.is_default)}" for name in self.deviating
        ]
        runs = len(next(iter(self.ranks.values())))
        lines += [f"  {count} of {runs} runs warned: {kind}" for kind, count in self.warned.items()]
        if self.uncertain:
            lines.append(
                f"  {self.uncertain} of {runs} runs have fewer than {_FEW} effective draws, too few for "
                "ranks by weight to be uniform: take more draws before trusting a deviation"
            )
        return lines


def simulation_based_calibration(
    engine: Any,
    net: BayesNet,
    *,
    observed: str | Sequence[str] | None = None,
    replications: int = 200,
    statistics: Mapping[str, Callable[..., Any]] | None = None,
    inputs: Mapping[str, Any] | None = None,
    draws: int = 100,
    alpha: float = 1e-3,
    rng: Any = None,
) -> CalibrationResult:
    """Simulation-based calibration of an engine, or of a function that samples, on one net.

    Hidden and observed nodes are drawn from the net and the engine is run on the data, ``replications``
    times. If it draws from the posterior, the rank of the true value of any statistic among its draws is
    uniform. The distribution function of the ranks is compared with the diagonal, as a whole, with its exact
    law (`ecdf_uniformity`), and the statistics together by Holm's method.

    **False-alarm rate.** At most ``alpha`` in one call, exactly, where draws are independent (Exact,
    Rejection, a function's own) and for LikelihoodWeighting, whatever the number of draws: there the truth's
    own weight is known. Draws of chains are thinned until those that are left have a correlation of about
    0.05, by their effective size (judged for every statistic and run), so that the rate holds in the limit
    of long chains, and only where they have converged; chains that are too short are rejected as other
    wrong answers are. With other weights it holds in the limit of many effective draws: the law of a rank
    is off by about one over their number.

    Parameters
    ----------
    engine : Engine, callable or None
        Any engine of ``infer`` (None is its choice), or a function ``sampler(evidence, rng)`` that returns
        a dict of hidden node -> draws, shape ``(draws, *plates, *event)`` (of one chain, or independent), or
        a Posterior.
    net : BayesNet
        It must be possible to draw from it: no potentials.
    observed : sequence of str, optional
        Nodes that are data; by default the stochastic nodes without children, if any other node is
        stochastic.
    replications : int
        Runs of the engine, at least 20. With 200, shares of ranks are known to about 0.035. A call takes as
        long as so many runs do: for a chain of a few thousand sweeps, seconds to minutes.
    statistics : dict, optional
        Name -> function whose arguments name nodes, hidden or observed, as in queries, and which returns one
        number for each draw. By default every element of the hidden nodes (codes, of labels; of nodes with
        more than 32 elements 32 of them and their mean), the log density of the data given the rest, and
        the joint log density. The last two depend on the data: without one that does, a posterior that
        ignores the data passes.
    inputs : dict, optional
        As for ``infer``.
    draws : int
        Draws from answers that hold none (Exact).
    alpha : float
        Chance of any false alarm.
    rng : optional
        Seed or generator.

    Returns
    -------
    CalibrationResult
        True if nothing deviates; with ``ranks``, ``ecdf_difference`` and ``plot()``.

    Raises
    ------
    ModelError, UnsupportedError
        The net cannot be drawn from, or is a template or a JointModel, or nothing is hidden.
    TypeError
        ``net`` is something else, or a statistic is not a function.
    DensityError
        A statistic is NaN.
    Exception
        Whatever the engine raises, with a note of the replication and its data.

    Notes
    -----
    Chains cost little in numbers: ``Gibbs(chains=20, draws=25, warmup=50)`` is faster than one long chain.
    Chains so short warn that they cannot tell how well they mix; the answer counts the runs that did.

    References
    ----------
    Talts, Betancourt, Simpson, Vehtari and Gelman (2018), Validating Bayesian inference algorithms with
    simulation-based calibration, arXiv:1804.06788, algorithm 1; Modrák, Moon, Kim, Bürkner, Huurre,
    Faltejsková, Gelman and Vehtari (2023), Simulation-based calibration checking for Bayesian computation:
    the choice of test quantities shapes sensitivity, Bayesian Analysis; Säilynoja, Bürkner and Vehtari
    (2022), Statistics and Computing 32; Holm (1979), Scand. J. Statist. 6.

    Examples
    --------
    A sampler of a user's own, right and with the variance in the place of the standard deviation.

    >>> import bayesmc as bmc
    >>> from bayesmc.testing import simulation_based_calibration
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> def right(evidence, rng):
    ...     return {"x": rng.normal(evidence["y"] / 2, 0.5**0.5, size=50)}
    >>> def wrong(evidence, rng):
    ...     return {"x": rng.normal(evidence["y"] / 2, 0.5, size=50)}
    >>> bool(simulation_based_calibration(right, net, rng=1))
    True
    >>> bool(simulation_based_calibration(wrong, net, rng=1))
    False
    """
    check_sizes(_CALL, replications=(replications, 20), draws=(draws, 1))
    check_level(_CALL, alpha)
    _check_net(engine, net)
    joint = NetJoint(net, observed, inputs)
    figures = Quantities(_CALL, joint, statistics)
    seed = seed_sequence(rng)
    generator = stream(seed, Purpose.TEST)
    state = joint.prior(generator, replications)
    data = joint.simulate(state, generator) if joint.observed else {}
    warned: Counter[str] = Counter()
    runs = _runs(engine, joint, data, draws, seed.spawn(replications), warned)
    found = list(_ranked(figures, state, data, runs, generator))
    shares, counts, uncertain = zip(*found, strict=True)
    ranks = dict(zip(figures.names, np.transpose(shares), strict=True))
    low, high = ecdf_band(replications, alpha / len(ranks))
    return counted(
        CalibrationResult(
            _CALL,
            alpha,
            [_comparison(name, ecdf_uniformity(r), replications) for name, r in ranks.items()],
            ranks=ranks,
            counts=dict(zip(figures.names, np.transpose(counts), strict=True)),
            points=ecdf_points(replications),
            low=low,
            high=high,
            warned=dict(warned),
            uncertain=sum(uncertain),
            is_default=statistics is None,
        )
    )


def _check_net(engine: Any, net: Any) -> None:
    if isinstance(net, DynamicBayesNet):
        raise UnsupportedError(
            f"{_CALL}: a DynamicBayesNet has no fixed number of slices; give the net of some, as in "
            f"{_CALL}(engine, dbn.unroll(10)), with an engine of infer or a function that runs the filter"
        )
    if isinstance(net, JointModel):
        raise UnsupportedError(
            f"{_CALL}: a JointModel has no named nodes to give an engine as evidence; declare the model as a "
            "BayesNet, or test the kernel with rank_test(kernel, model) or geweke_test(kernel, model)"
        )
    if isinstance(engine, (BayesNet, DynamicBayesNet, FactorGraph, JointModel)):
        raise TypeError(f"{_CALL}: the engine comes first; write {_CALL}(engine, net)")
    if not isinstance(net, (BayesNet, FactorGraph)):
        raise TypeError(f"{_CALL}: net is a {type(net).__name__}; give a BayesNet")


# ---- running ------------------------------------------------------------------------------------


def _runs(
    engine: Any,
    joint: NetJoint,
    data: Rows,
    draws: int,
    seeds: Sequence[np.random.SeedSequence],
    warned: Counter[str],
) -> Iterator[Draws]:
    """Draws of each replication; the library's warnings are counted, instead of shown in every run."""
    function = callable(engine) and not isinstance(engine, (Engine, type))
    for row, seed in enumerate(seeds):
        evidence = joint.evidence(data, row)
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", BayesmcWarning)
                if function:
                    answer = engine(evidence, np.random.default_rng(seed))
                else:
                    answer = infer(
                        joint.net, evidence, inputs=joint.user_inputs, engine=engine, rng=seed,
                        progress=False, keep=list(joint.hidden),
                    )  # fmt: skip
            if isinstance(answer, Posterior):
                found = posterior_draws(answer, joint.model, joint.hidden, draws, seed)
            else:
                found = users_draws(_CALL, answer, joint.model, joint.hidden)
        except Exception as error:
            error.add_note(f"{_CALL}: in replication {row}, with evidence {evidence}")
            raise
        ours = {w.category.__name__ for w in caught if issubclass(w.category, BayesmcWarning)}
        warned.update(ours)
        for other in caught:
            if not issubclass(other.category, BayesmcWarning):
                warnings.warn_explicit(
                    str(other.message), other.category, other.filename, other.lineno
                )
        yield found


def _ranked(
    figures: Quantities, state: Rows, data: Rows, runs: Iterator[Draws], rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray, bool]]:
    """Of each run: shares and counts of all statistics, and whether its weights are worth too little."""
    first = 0
    for block in _blocks(runs):
        lengths = [1 + found.count for found in block]
        which = np.repeat(np.arange(first, first + len(block)), lengths)
        together = {
            name: np.concatenate(
                [
                    part
                    for i, found in enumerate(block, first)
                    for part in (v[i, None], found.values[name])
                ]
            )
            for name, v in state.items()
        }
        # One evaluation of truths and draws: equal states get equal values, so that ties are ties.
        values, log_likelihood = figures(together, {n: v[which] for n, v in data.items()})
        ends = np.cumsum(lengths)
        for found, end, length in zip(block, ends, lengths, strict=True):
            own = slice(end - length, end)
            truth, *_ = values[own]
            share, count = share_below(
                truth, values[own][1:], found, float(log_likelihood[end - length]), rng
            )
            yield share, count, not found.likelihood and found.ess < _FEW
        first += len(block)


def _blocks(runs: Iterator[Draws]) -> Iterator[list[Draws]]:
    """Runs whose draws are few enough to be worked on together."""
    block: list[Draws] = []
    for found in runs:
        block.append(found)
        if sum(1 + d.count for d in block) > _ROWS:
            yield block
            block = []
    if block:
        yield block


# ---- in words -----------------------------------------------------------------------------------


def _comparison(name: str, found: Uniformity, count: int) -> Comparison:
    error = math.sqrt(found.point * (1.0 - found.point) / count)
    what = f"{name}{_SHARE}{found.point:.2g}"
    return Comparison(what, found.share, found.point, abs(found.excess) / error, found.p_value)


def _in_words(ranks: np.ndarray, is_default: bool) -> str:
    """What is wrong with the draws, as far as mean and spread of the ranks show it.

    A user's statistic takes the draws elsewhere, and says nothing of where they lie themselves.
    """
    count = len(ranks)
    shift = (ranks.mean() - 0.5) * math.sqrt(12 * count)
    spread = (((ranks - 0.5) ** 2).mean() - 1 / 12) * math.sqrt(180 * count)
    if max(abs(shift), abs(spread)) < 3.0:
        return "neither shifted nor of a wrong spread: look at plot()"
    low, high = (ranks < 0.1).mean(), (ranks > 0.9).mean()
    one_tail = spread > 0 and min(low, high) < 0.1 and abs(shift) >= 3.0
    if abs(shift) > abs(spread) or one_tail:
        side = "low" if shift > 0 else "high"
        draws = "draws" if is_default else "its values at the draws"
        return f"{draws} lie too {side} (ranks of the truth average {ranks.mean():.3f}, not 0.5)"
    width = "draws are too " + ("narrow" if spread > 0 else "wide")
    if not is_default:
        width = "its values at the draws spread too " + ("little" if spread > 0 else "far")
    return f"{width} ({low + high:.0%} of truths in their outer fifth, not 20%)"
