"""Draws marginals: bars for discrete nodes, histogram and kernel density for continuous ones.

Everything is weighted as the posterior is. It needs matplotlib (the extra ``plot``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.errors import UnsupportedError
from bayesmc.plotting.look import check_posterior
from bayesmc.plotting.pyplot import pyplot
from bayesmc.results import Marginal, Posterior

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PRIOR, POSTERIOR = "#9aa7b2", "#2a6f97"
POINTS = 400  # at which a density is drawn
PANEL = (2.6, 2.1)  # inches
COLUMNS = 4
OUTSIDE = 0.002  # probability left out of the picture at either end
WIDEST = 12.0  # how many posterior ranges a prior's tails may take


def plot_marginal(
    posterior: Posterior,
    name: str,
    index: int | tuple[int, ...] = (),
    *,
    ax: Axes | None = None,
    color: str = POSTERIOR,
    label: str | None = None,
) -> Axes:
    """Draw the marginal of one scalar.

    Parameters
    ----------
    posterior : Posterior
    name : str
        A node.
    index : int or tuple of int
        The element of a plated node, the component of a vector.
    ax : matplotlib.axes.Axes, optional
    color, label : str, optional

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    UnsupportedError
        When the node is no scalar and ``index`` does not pick one.
    MissingExtraError
        Without matplotlib.

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> from bayesmc.plotting import plot_marginal
    >>> net = bmc.BayesNet()
    >>> net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    >>> ax = plot_marginal(bmc.infer(net, {}, engine=bmc.Exact()), "rain")
    >>> [round(float(bar.get_height()), 3) for bar in ax.patches]
    [0.8, 0.2]
    """
    check_posterior(posterior, "plot_marginal")
    marginal = _scalar(posterior, name, index)
    if ax is None:
        ax = pyplot().subplots(figsize=(4.0, 3.0), layout="constrained")[1]
    bars = _bars(marginal)
    if bars is not None:
        _draw_bars(ax, [bars], [color], [label])
    else:
        low, high = _range(marginal)
        points = np.linspace(low, high, POINTS)
        density = marginal.density(points)
        if marginal.distribution is None:
            # Rice's rule, with the weights' effective number of draws
            count = int(np.clip(2 * _effective(marginal) ** (1 / 3), 10, 60))
            heights, edges = marginal.histogram(np.linspace(low, high, count + 1), density=False)
            ax.stairs(heights / np.diff(edges), edges, fill=True, color=color, alpha=0.25)
        else:
            ax.fill_between(points, density, color=color, alpha=0.25, linewidth=0)
        ax.plot(points, density, color=color, label=label)
        ax.set_ylim(bottom=0)
        ax.set_ylabel("density")
    ax.set_xlabel(_title(name, index))
    _tidy(ax)
    return ax


def plot_prior_posterior(
    prior: Posterior,
    posterior: Posterior,
    names: Sequence[str | tuple[str, int | tuple[int, ...]]] | None = None,
    *,
    axes: Sequence[Axes] | None = None,
) -> np.ndarray:
    """Draw marginals before and after the evidence, a panel for each scalar.

    Parameters
    ----------
    prior, posterior : Posterior
        Answers of one net; the prior is ``infer(net, {})``.
    names : sequence, optional
        Nodes, or pairs of a node and an index. By default all scalar nodes that are not observed.
    axes : sequence of matplotlib.axes.Axes, optional
        One for each name; by default a new figure.

    Returns
    -------
    ndarray of matplotlib.axes.Axes, shape (len(names),)

    Raises
    ------
    ValueError
        When ``axes`` are fewer than the names, or there is nothing to draw.
    UnsupportedError, MissingExtraError
        As for ``plot_marginal``.

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> from bayesmc.plotting import plot_prior_posterior
    >>> net = bmc.BayesNet()
    >>> net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    >>> net.add("wet", lambda rain: bmc.Bernoulli(0.1 + 0.8 * (rain == "yes")))
    >>> before, after = (bmc.infer(net, e, engine=bmc.Exact()) for e in ({}, {"wet": 1}))
    >>> axes = plot_prior_posterior(before, after, ["rain"])
    >>> [round(float(bar.get_height()), 3) for bar in axes[0].patches]
    [0.8, 0.2, 0.308, 0.692]
    """
    for answer in (prior, posterior):
        check_posterior(answer, "plot_prior_posterior")
    plt = pyplot()
    wanted = [n if isinstance(n, tuple) else (n, ()) for n in names or _scalars(posterior)]
    if not wanted:
        raise ValueError("plot_prior_posterior: no scalar node is free; give names=[(node, index)]")
    if axes is None:
        axes = _panels(plt, len(wanted))
    elif len(axes) < len(wanted):
        raise ValueError(f"plot_prior_posterior: {len(axes)} axes for {len(wanted)} names")
    for ax, (name, index) in zip(axes, wanted, strict=False):
        _draw_pair(ax, _scalar(prior, name, index), _scalar(posterior, name, index))
        ax.set_title(_title(name, index), fontsize="medium")
        _tidy(ax)
    axes[0].legend(frameon=False, fontsize="small")
    return np.array(list(axes[: len(wanted)]), dtype=object)


def _draw_pair(ax: Axes, before: Marginal, after: Marginal) -> None:
    pair = [_bars(before), _bars(after)]
    if pair[0] is not None and pair[1] is not None:
        _draw_bars(ax, [pair[0], pair[1]], [PRIOR, POSTERIOR], ["prior", "posterior"])
        return
    points = np.linspace(*_common_range(before, after), POINTS)
    for marginal, color, label in ((before, PRIOR, "prior"), (after, POSTERIOR, "posterior")):
        density = marginal.density(points)
        ax.plot(points, density, color=color, label=label)
        ax.fill_between(points, density, color=color, alpha=0.25, linewidth=0)
    ax.set_ylim(bottom=0)
    ax.set_yticks([])


def _scalar(posterior: Posterior, name: str, index: Any) -> Marginal:
    marginal = posterior.marginal(name, index)
    cells = marginal.probabilities if marginal.states is not None else marginal.values
    if cells.ndim != 1:
        raise UnsupportedError(
            f"plotting {name!r}: it has shape {cells.shape[:-1] or cells.shape[1:]}; "
            f"name one scalar of it, such as index={(0,) * (cells.ndim - 1)}"
        )
    return marginal


def _scalars(posterior: Posterior) -> list[str]:
    """Unobserved nodes without plates and components."""
    return [
        name
        for name in posterior.names
        if posterior._is_free(name) and not posterior.model.nodes[name].value_shape
    ]


def _bars(marginal: Marginal) -> tuple[list[str], np.ndarray] | None:
    """Names and probabilities of a discrete node's values; None for a continuous one."""
    if marginal.states is not None:
        return [str(state) for state in marginal.states], np.asarray(marginal.probabilities)
    if marginal.values.dtype.kind not in "biu":
        return None
    values, inverse = np.unique(marginal.values, return_inverse=True)
    return [str(v) for v in values], np.bincount(inverse, weights=marginal.weights)


def _draw_bars(
    ax: Axes,
    groups: list[tuple[list[str], np.ndarray]],
    colors: list[str],
    labels: list[str | None],
) -> None:
    ticks = list(dict.fromkeys(name for names, _ in groups for name in names))
    if all(tick.lstrip("-").isdigit() for tick in ticks):
        ticks.sort(key=int)
    width = 0.8 / len(groups)
    for i, ((names, probabilities), color, label) in enumerate(
        zip(groups, colors, labels, strict=True)
    ):
        shift = (i - (len(groups) - 1) / 2) * width
        places = [ticks.index(name) + shift for name in names]
        ax.bar(places, probabilities, width, color=color, label=label)
    shown = range(0, len(ticks), 1 + len(ticks) // 12)
    crowded = sum(len(ticks[i]) for i in shown) > 24
    ax.set_xticks(list(shown), [ticks[i] for i in shown], rotation=90 if crowded else 0)
    if len(ticks) <= 12:
        ax.set_ylim(0, 1)


def _effective(marginal: Marginal) -> float:
    return float(1 / np.sum(marginal.weights**2))


def _range(marginal: Marginal) -> tuple[float, float]:
    """The central part, with some room on both sides."""
    low, high = marginal.bounds(OUTSIDE)
    room = 0.08 * (high - low) or max(abs(low), 1.0) * 1e-2
    return max(float(low - room), marginal.ends[0]), min(float(high + room), marginal.ends[1])


def _common_range(before: Marginal, after: Marginal) -> tuple[float, float]:
    """Both ranges, but not so much of a wide prior that the posterior becomes a line."""
    (low, high), (left, right) = _range(after), _range(before)
    most = WIDEST / 2 * (high - low)
    middle = (low + high) / 2
    return max(min(low, left), middle - most), min(max(high, right), middle + most)


def _panels(plt: Any, count: int) -> list[Axes]:
    columns = min(count, COLUMNS)
    rows = -(-count // columns)
    size = (PANEL[0] * columns, PANEL[1] * rows)
    _, grid = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    for ax in grid.flat[count:]:
        ax.set_axis_off()
    return list(grid.flat[:count])


def _title(name: str, index: Any) -> str:
    at = index if isinstance(index, tuple) else (index,)
    return f"{name}[{', '.join(map(str, at))}]" if at else name


def _tidy(ax: Axes) -> None:
    ax.spines[["top", "right"]].set_visible(False)
