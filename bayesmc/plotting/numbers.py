"""Pictures of any posterior's numbers: intervals below each other, numbers against each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.errors import QueryError
from bayesmc.plotting.look import (
    BLUE,
    PALETTE,
    VERMILION,
    Names,
    Scalar,
    chosen_scalars,
    draw_density,
    grid_axes,
    note,
    single_axes,
    tidy,
)
from bayesmc.results import DrawsPosterior, Posterior

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_forest(
    posterior: Posterior | Mapping[str, Posterior],
    names: Names | None = None,
    *,
    prob: float = 0.89,
    inner: float = 0.5,
    ax: Axes | None = None,
) -> Axes:
    """Draw medians and narrowest intervals of many numbers below each other.

    Parameters
    ----------
    posterior : Posterior or dict
        Whatever made it; or several, name -> posterior, drawn beside each other in colours.
    names : str or sequence, optional
        As for ``plot_trace``, 40 numbers at most.
    prob, inner : float
        Of the thin line, and of the thick one.
    ax : matplotlib.axes.Axes, optional

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    UnknownNodeError, QueryError, UnsupportedError, MissingExtraError

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet(plates={"school": ["A", "B"]})
    >>> net.add("effect", bmc.Normal(0.0, 1.0), plates="school")
    >>> ax = bmc.infer(net).plot.forest()
    >>> [label.get_text() for label in ax.get_yticklabels()]
    ['effect[A]', 'effect[B]']
    """
    several = posterior if isinstance(posterior, Mapping) else {"": posterior}
    if not several:
        raise QueryError("plot_forest: there is no posterior; give one, or {name: posterior}")
    if not 0 < inner <= prob < 1:
        raise QueryError(
            f"plot_forest(prob={prob!r}, inner={inner!r}): intervals have probabilities between 0 and 1, the "
            "inner one no larger"
        )
    rows: dict[str, list[tuple[int, Posterior, Scalar]]] = {}
    left_out = ""
    for k, own in enumerate(several.values()):
        scalars, left_out = chosen_scalars(own, names, "plot_forest", 40)
        for scalar in scalars:
            rows.setdefault(scalar.label, []).append((k, own, scalar))
    ax = single_axes(ax, (6.0, 0.9 + 0.26 * len(rows) * max(1, 0.7 * len(several))))
    known: dict[tuple[int, str], tuple[np.ndarray, ...]] = {}
    for at, members in enumerate(rows.values()):
        for k, own, scalar in members:
            if (k, scalar.node) not in known:
                name = scalar.node
                known[k, name] = (own.median(name), own.hdi(name, prob), own.hdi(name, inner))
            middle, outer, core = (part[scalar.index] for part in known[k, scalar.node])
            y = at + (0.6 * (k + 0.5) / len(several) - 0.3 if len(several) > 1 else 0.0)
            color = PALETTE[k % len(PALETTE)]
            ax.plot(outer, [y, y], color=color, linewidth=1.3, solid_capstyle="butt")
            ax.plot(core, [y, y], color=color, linewidth=3.6, solid_capstyle="butt")
            ax.plot(middle, y, "o", color=color, markeredgecolor="white", markersize=5.5)
    ax.set_yticks(range(len(rows)), list(rows), parse_math=False)
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.set_xlabel(f"median, {100 * inner:g} % and {100 * prob:g} % intervals")
    if len(several) > 1:
        from matplotlib.lines import Line2D

        lines = [Line2D([], [], color=PALETTE[k % 8], linewidth=3) for k in range(len(several))]
        ax.legend(
            lines,
            list(several),
            frameon=False,
            fontsize="small",
            loc="upper left",
            bbox_to_anchor=(1, 1),
        )
    tidy(ax)
    note(ax, left_out)
    return ax


def plot_pair(
    posterior: Posterior,
    names: Names | None = None,
    *,
    draws: int = 2000,
    axes: Any = None,
) -> np.ndarray:
    """Draw numbers against each other, with the draws whose Hamiltonian trajectory diverged on top.

    Divergences that gather in a corner say where the chains could not go: into a funnel's neck, mostly.

    Parameters
    ----------
    posterior : Posterior
        Weighted and exact ones are resampled.
    names : str or sequence, optional
        As for ``plot_trace``, two to eight numbers; by default the first four.
    draws : int
        Drawn at most, evenly taken; divergences are all drawn.
    axes : array of matplotlib.axes.Axes, optional
        Numbers by numbers.

    Returns
    -------
    ndarray of matplotlib.axes.Axes, shape (numbers, numbers)
        What lies above the diagonal is switched off.

    Raises
    ------
    UnknownNodeError, QueryError, UnsupportedError, ValueError, MissingExtraError

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Normal(0.0, 1.0))
    >>> net.add("b", lambda a: bmc.Normal(a, 1.0))
    >>> bmc.infer(net).plot.pair(["a", "b"]).shape
    (2, 2)
    """
    scalars, left_out = chosen_scalars(posterior, names, "plot_pair", 4 if names is None else 8)
    if len(scalars) < 2:
        raise QueryError(
            "plot_pair: one number has no pair; name two or more, or draw plot_marginal"
        )
    drawn = _equal_draws(posterior, draws)
    columns = [scalar.draws(drawn).ravel() for scalar in scalars]
    size = len(columns[0])
    kept = np.arange(0, size, max(1, size // max(draws, 1)))
    diverged = getattr(posterior, "divergences", None)
    bad = np.zeros(0, int) if diverged is None else np.flatnonzero(diverged.ravel())
    many = len(scalars)
    side = 2.1 if many > 2 else 2.6
    panels = grid_axes(axes, many, many, (side, side), "plot_pair")
    for i, j in np.ndindex(many, many):
        ax: Any = panels[i, j]
        if j > i:
            ax.set_axis_off()
            continue
        if i == j:
            draw_density(ax, columns[i], {"color": BLUE, "linewidth": 1.2})
            ax.set_yticks([])
            ax.set_ylim(bottom=0)
        else:
            x, y = columns[j], columns[i]
            ax.plot(
                x[kept],
                y[kept],
                ".",
                color=BLUE,
                markersize=2.5,
                alpha=0.35,
                markeredgewidth=0,
                rasterized=True,
            )
            ax.plot(x[bad], y[bad], "x", color=VERMILION, markersize=4, markeredgewidth=1.0)
        if i == many - 1:
            ax.set_xlabel(scalars[j].label, parse_math=False)
        else:
            ax.set_xticklabels([])
        if j == 0 and i > 0:
            ax.set_ylabel(scalars[i].label, parse_math=False)
        elif j != i:
            ax.set_yticklabels([])
        tidy(ax)
    if many > 1 and len(bad):
        from matplotlib.lines import Line2D

        mark = Line2D([], [], color=VERMILION, marker="x", linestyle="none", markersize=5)
        panels[0, -1].legend([mark], [f"{len(bad)} divergences"], frameon=False, loc="center")
    _share_ranges(panels, columns)
    note(panels[0, 0], left_out)
    return panels


# ---- private ------------------------------------------------------------------------------------


def _equal_draws(posterior: Posterior, draws: int) -> DrawsPosterior:
    """The posterior itself where its draws weigh the same, else draws of it."""
    if isinstance(posterior, DrawsPosterior) and posterior.weights is None:
        return posterior
    found: DrawsPosterior = posterior.resample(draws, rng=0)  # type: ignore[assignment]
    return found


def _share_ranges(panels: np.ndarray, columns: Sequence[np.ndarray]) -> None:
    """Rows and columns of panels over the same ranges, without a pixel-wide outlier's say."""
    for k, values in enumerate(columns):
        low, high = np.nanmin(values), np.nanmax(values)
        room = 0.04 * (high - low) or 0.5
        for ax in panels[k:, k]:
            ax.set_xlim(low - room, high + room)
        for ax in panels[k, :k]:
            ax.set_ylim(low - room, high + room)
