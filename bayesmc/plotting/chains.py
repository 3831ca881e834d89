"""Pictures of Markov chains: traces, ranks, energies.

The figures behind them (kernel densities, effective sizes) are arviz-stats', by its array interface. ArviZ's
own pictures are not called: they take no axes and no weights, and releases of arviz-plots for Python 3.11 do
not load beside matplotlib 3.11.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.errors import QueryError, UnsupportedError
from bayesmc.plotting.look import (
    BLUE,
    FAINT,
    INK,
    ORANGE,
    Names,
    chosen_scalars,
    draw_density,
    grid_axes,
    line_style,
    note,
    single_axes,
    tidy,
    title,
    wrapped,
)
from bayesmc.results import ChainsPosterior, Posterior

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: chance that a band of ranks leaves out a chain that has mixed
ALARM = 0.05
_CHAINS = "an engine of Markov chains makes them: Gibbs, MetropolisHastings, HamiltonianMonteCarlo"


def plot_trace(posterior: Posterior, names: Names | None = None, *, axes: Any = None) -> np.ndarray:
    """Draw the chains of some numbers: the density of each chain, and its draws in order.

    Chains that have mixed look alike and like noise. Ticks at the bottom are draws whose Hamiltonian
    trajectory diverged.

    Parameters
    ----------
    posterior : Posterior
        Of Markov chains, with draws.
    names : str or sequence, optional
        Nodes, or pairs of a node and an index. By default all unobserved nodes of at most 12 numbers, and of
        these the first 24.
    axes : array of matplotlib.axes.Axes, optional
        Two for each number; by default a new figure.

    Returns
    -------
    ndarray of matplotlib.axes.Axes, shape (numbers, 2)

    Raises
    ------
    UnsupportedError
        The posterior has no chains.
    UnknownNodeError, QueryError, ValueError, MissingExtraError

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Gamma(2.0, 1.0))
    >>> posterior = bmc.infer(net, engine=bmc.Gibbs(200), rng=0)
    >>> posterior.plot.trace("x").shape
    (1, 2)
    """
    chains = _with_chains(posterior, "plot_trace")
    scalars, left_out = chosen_scalars(chains, names, "plot_trace")
    panels = grid_axes(axes, len(scalars), 2, (4.2, 1.6), "plot_trace")
    diverged = chains.divergences
    for (left, right), scalar in zip(panels, scalars, strict=True):
        values = scalar.draws(chains)
        for k, own in enumerate(values):
            style = line_style(k, len(values))
            draw_density(left, own, style)
            right.plot(own, **{**style, "linewidth": 0.6})
        if diverged is not None and diverged.any():
            low, high = right.get_ylim()
            at = np.flatnonzero(diverged.any(axis=0))
            right.plot(at, np.full(len(at), low), "|", color=INK, markersize=9, clip_on=False)
            right.set_ylim(low, high)
        title(left, scalar.label)
        left.set_yticks([])
        left.set_ylim(bottom=0)
        right.margins(x=0)
        tidy(left, right)
    panels[-1, 0].set_xlabel("value")
    panels[-1, 1].set_xlabel(
        "draw" if diverged is None or not diverged.any() else "draw (ticks: divergences)"
    )
    note(panels[0, 0], left_out)
    return panels


def plot_rank(posterior: Posterior, names: Names | None = None, *, axes: Any = None) -> np.ndarray:
    """Draw how the ranks of each chain's draws among all draws differ from those of equal chains.

    A line for each chain: the share of its draws with ranks up to r, less r. Chains that tell the same stay
    within the band, all of them 19 times in 20; the band is that of as many independent draws as each
    chain is worth by itself.

    Parameters
    ----------
    posterior : Posterior
        Of Markov chains, two or more, with draws.
    names : str or sequence, optional
        As for ``plot_trace``.
    axes : sequence of matplotlib.axes.Axes, optional
        One for each number.

    Returns
    -------
    ndarray of matplotlib.axes.Axes, shape (numbers,)

    Raises
    ------
    UnsupportedError
        The posterior has no chains, or one.
    UnknownNodeError, QueryError, ValueError, MissingExtraError

    References
    ----------
    Vehtari, Gelman, Simpson, Carpenter and Buerkner (2021), Rank-normalization, folding, and localization,
    Bayesian Analysis 16; Massart (1990), Annals of Probability 18, for the band.

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Gamma(2.0, 1.0))
    >>> posterior = bmc.infer(net, engine=bmc.Gibbs(200), rng=0)
    >>> len(posterior.plot.rank("x")[0].lines)
    5
    """
    chains = _with_chains(posterior, "plot_rank")
    count, draws = chains._shape
    if count < 2:
        raise UnsupportedError("plot_rank: there is one chain, and ranks compare several; chains=4")
    scalars, left_out = chosen_scalars(chains, names, "plot_rank")
    rows, columns = wrapped(len(scalars))
    shape = (1, len(scalars)) if axes is not None else (rows, columns)
    panels = grid_axes(axes, *shape, (3.0, 2.2), "plot_rank").ravel()
    for ax in panels[len(scalars) :]:
        ax.set_axis_off()
    grid = np.linspace(0.0, 1.0, 201)
    for ax, scalar in zip(panels, scalars, strict=False):
        values = scalar.draws(chains)
        ranks = _ranks(values)
        band = np.sqrt(np.log(2 * count / ALARM) / (2 * _worth(values)))
        ax.fill_between(grid, -band, band, color=FAINT, alpha=0.25, linewidth=0)
        ax.axhline(0.0, color=INK, linewidth=0.7)
        for k, own in enumerate(ranks):
            share = np.searchsorted(np.sort(own), grid, side="right") / draws
            ax.plot(grid, share - grid, **line_style(k, count))
        ax.set_xlim(0, 1)
        title(ax, scalar.label)
        ax.set_xlabel("rank", fontsize="small")
        tidy(ax)
    panels[0].set_ylabel("share below, less rank", fontsize="small")
    note(panels[0], left_out)
    return panels[: len(scalars)]


def plot_energy(posterior: Posterior, *, ax: Axes | None = None) -> Axes:
    """Draw how energies of Hamiltonian trajectories spread, and how far one is from the next.

    Where the second curve is much narrower than the first, fresh momenta do not take chains through all
    energies, and tails are explored slowly: E-BFMI, the ratio of the mean square step to the variance, is
    given for the worst chain, and below 0.3 is too small.

    Parameters
    ----------
    posterior : Posterior
        Of ``HamiltonianMonteCarlo``, with draws.
    ax : matplotlib.axes.Axes, optional

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    UnsupportedError
        There are no energies.
    MissingExtraError

    References
    ----------
    Betancourt (2016), Diagnosing suboptimal cotangent disintegrations in Hamiltonian Monte Carlo.

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("x", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> posterior = bmc.infer(net, {"y": 0.4}, engine=bmc.HamiltonianMonteCarlo(500), rng=0)
    >>> ax = posterior.plot.energy()
    >>> ax.get_xlabel()
    'energy, less its mean (nats)'
    """
    energies = getattr(posterior, "energies", None)
    if energies is None:
        engine = type(getattr(posterior, "engine", None)).__name__
        raise UnsupportedError(
            f"plot_energy: this answer (of {engine}) has no energies, which Hamiltonian trajectories have; "
            'engine=HamiltonianMonteCarlo(draws) makes those, with draws kept (not keep="summaries"), and '
            "Gibbs where one block of nodes is moved so (explain says)"
        )
    if energies.shape[1] < 4:
        raise QueryError(
            f"plot_energy: {energies.shape[1]} draws of each chain are too few; ask for more draws="
        )
    ax = single_axes(ax)
    centred = energies - energies.mean(axis=1, keepdims=True)
    steps = np.diff(energies, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.square(steps).mean(axis=1) / energies.var(axis=1)
    for values, color, label in (
        (centred, BLUE, "energies"),
        (steps, ORANGE, "steps from one to the next"),
    ):
        draw_density(
            ax, values.ravel(), {"color": color, "linewidth": 1.4, "label": label}, fill=True
        )
    ax.set_ylim(bottom=0)
    ax.set_yticks([])
    ax.set_xlabel("energy, less its mean (nats)")
    said = f"lowest E-BFMI of {len(ratio)} chains: {np.nanmin(ratio):.2f}"
    ax.legend(frameon=False, fontsize="small", title=said, title_fontsize="small")
    tidy(ax)
    return ax


# ---- private ------------------------------------------------------------------------------------


def _with_chains(posterior: Any, what: str) -> ChainsPosterior:
    if isinstance(posterior, ChainsPosterior):
        return posterior
    engine = type(getattr(posterior, "engine", None)).__name__
    raise UnsupportedError(
        f"{what}: this answer (of {engine}) has no Markov chains with draws; {_CHAINS}, with draws kept (not "
        'keep="summaries"). plot_marginal, plot_forest and plot_pair draw any posterior'
    )


def _ranks(values: np.ndarray) -> np.ndarray:
    """Ranks among all draws, in (0, 1); ties share theirs."""
    from scipy.stats import rankdata

    found: np.ndarray = (rankdata(values.ravel()) - 0.5) / values.size
    return found.reshape(values.shape)


def _worth(values: np.ndarray) -> float:
    """Independent draws that one chain is worth by itself, on average."""
    from arviz_stats.base import array_stats

    draws = values.shape[1]
    if draws < 8:
        return float(draws)
    with np.errstate(all="ignore"):
        each = np.array([array_stats.ess(own[None], chain_axis=0, draw_axis=1) for own in values])
    each = each[np.isfinite(each)]
    return float(np.clip(each.mean(), 1.0, draws)) if each.size else float(draws)
