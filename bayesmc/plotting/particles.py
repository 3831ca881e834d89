"""Pictures of particle filters: who descends from whom, what weights and ESS do over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.errors import QueryError, UnsupportedError
from bayesmc.plotting.look import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    VERMILION,
    dates,
    grid_axes,
    label_of,
    one_scalar,
    single_axes,
    tidy,
)
from bayesmc.results import SeriesPosterior

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_ancestry(
    filtered: SeriesPosterior,
    name: str,
    index: int | tuple[int, ...] = (),
    *,
    last: int | None = None,
    shown: int = 200,
    times: Sequence[Any] | np.ndarray | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw particles over time with lines to their ancestors; lines that last to the end stand out.

    All particles of the last slice descend from few of early ones: paths that particles carry along say
    little of slices long past, and ``smooth`` goes back over them.

    Parameters
    ----------
    filtered : SeriesPosterior
        Of ``filter`` with a ``ParticleFilter`` and ``keep="particles"``.
    name : str
        A node whose particles are numbers.
    index : int or tuple of int
    last : int, optional
        Draw only the last slices.
    shown : int
        Of the lines that have died out so many per slice at most, evenly taken; those that last are all
        drawn.
    times : sequence, optional
        One for each slice of the series.
    ax : matplotlib.axes.Axes, optional

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    UnsupportedError
        There are no ancestors: another engine, or particles were not kept.
    UnknownNodeError, QueryError, MissingExtraError

    References
    ----------
    Jacob, Murray and Rubenthaler (2015), Path storage in the particle filter, Statistics and Computing 25.

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> engine = bmc.ParticleFilter(20)
    >>> filtered = bmc.filter(dbn, {"y": [0.4, 1.0, 2.2]}, engine=engine, rng=0, keep="particles")
    >>> filtered.plot.ancestry("x").get_ylabel()
    'x'
    """
    from matplotlib.collections import LineCollection

    ancestors: Any = _kept(filtered, "ancestors", "plot_ancestry")
    node = filtered._node(name)
    if node.domain is not None and node.domain.labels is not None:
        raise UnsupportedError(
            f"plot_ancestry: {name!r} has labels, which have no height; name a node with numbers"
        )
    scalar = one_scalar(filtered, name, index, node.value_shape, "plot_ancestry")
    every: Any = np.array(filtered.particles(name), dtype=float)  # type: ignore[attr-defined]
    values = every[(slice(None), slice(None), *scalar.index)]
    apart = ancestors.shape[2:]
    rows = ancestors[(slice(None), slice(None), *scalar.index[: len(apart)])]
    steps, size = values.shape
    at = _times(times, steps, filtered.start, "plot_ancestry")
    dated = at.dtype.kind not in "biuf"
    if dated:
        from matplotlib.dates import date2num

        where = np.asarray(date2num(at))
    else:
        where = at.astype(float)
    begin = 0 if last is None else max(0, steps - last)
    alive = _survivors(rows)
    ax = single_axes(ax, (7.2, 3.6))
    some = "" if size <= shown else " (some)"
    for lasts, color, width, alpha, label in (
        (False, FAINT, 0.5, 0.5, f"died out{some}"),
        (True, BLUE, 0.9, 0.8, "lasts to the end"),
    ):
        most = size if lasts else shown
        segments = _segments(values, rows, alive if lasts else ~alive, where, begin, most)
        style: Any = {"colors": color, "linewidths": width, "alpha": alpha, "label": label}
        ax.add_collection(LineCollection(list(segments), **style))
    ax.plot(np.repeat(where[begin], size), values[begin], ".", color=FAINT, markersize=2)
    ax.autoscale_view()
    if dated:
        ax.xaxis_date()
        dates(ax, at)
    ax.margins(x=0.01)
    roots = int(alive[begin].sum())
    said = f"{size} particles, {roots} ancestor{'s' if roots != 1 else ''}"
    ax.set_title(f"{said} in slice {filtered.start + begin}", fontsize="medium", loc="left")
    ax.legend(frameon=False, fontsize="small", loc="lower right", bbox_to_anchor=(1, 1), ncols=2)
    ax.set_ylabel(label_of(filtered, name, scalar.index), parse_math=False)
    if times is None:
        ax.set_xlabel("slice")
    tidy(ax)
    return ax


def plot_weights(
    filtered: SeriesPosterior,
    index: int | tuple[int, ...] = (),
    *,
    times: Sequence[Any] | np.ndarray | None = None,
    axes: Any = None,
) -> np.ndarray:
    """Draw what particles are worth over time: effective number, resampling, and their weights.

    Parameters
    ----------
    filtered : SeriesPosterior
        Of a particle filter; with ``keep="particles"`` the weights themselves are drawn in a second panel.
    index : int or tuple of int
        The element of plates that are filtered separately.
    times : sequence, optional
        One for each slice.
    axes : sequence of matplotlib.axes.Axes, optional
        Two where particles were kept, else one.

    Returns
    -------
    ndarray of matplotlib.axes.Axes, shape (1,) or (2,)

    Raises
    ------
    UnsupportedError
        No particle filter made it.
    QueryError, ValueError, MissingExtraError

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> filtered = bmc.filter(dbn, {"y": [0.4, 1.0, 2.2]}, engine=bmc.ParticleFilter(200), rng=0)
    >>> len(filtered.plot.weights())
    1
    """
    ess = getattr(filtered, "weight_ess", None)
    if not isinstance(filtered, SeriesPosterior) or ess is None:
        engine = type(getattr(filtered, "engine", None)).__name__
        raise UnsupportedError(
            f"plot_weights: this answer (of {engine}) has no particles over time; filter(dbn, rows, "
            "engine=ParticleFilter(particles)) has"
        )
    scalar = one_scalar(filtered, "weight_ess", index, ess.shape[1:], "plot_weights")
    at = _times(times, len(ess), filtered.start, "plot_weights")
    pick: Any = (slice(None), *scalar.index)
    held = _held_weights(filtered)
    panels = grid_axes(
        axes, 1 if held is None else 2, 1, (7.2, 2.1), "plot_weights", sharex=True
    ).ravel()
    _effective(panels[0], filtered, ess[pick], pick, at)
    if held is not None:
        _spread(panels[1], [one[pick] if one.ndim > 1 else one for one in held], at)
    panels[-1].set_xlabel("slice" if times is None else "")
    dates(panels[-1], at)
    for ax in panels:
        ax.margins(x=0.01)
        tidy(ax)
    return panels


# ---- private ------------------------------------------------------------------------------------


def _kept(filtered: Any, what: str, picture: str) -> np.ndarray:
    if not isinstance(filtered, SeriesPosterior) or getattr(filtered, "weight_ess", None) is None:
        engine = type(getattr(filtered, "engine", None)).__name__
        raise UnsupportedError(
            f"{picture}: this answer (of {engine}) has no particles with ancestors; filter(dbn, rows, "
            'engine=ParticleFilter(particles), keep="particles") has'
        )
    if filtered.kind != "filter":
        raise UnsupportedError(
            f"{picture}: the particles of a {filtered.kind} result have no ancestors; ask the result of "
            "filter"
        )
    try:
        return np.asarray(getattr(filtered, what))
    except UnsupportedError as error:
        raise UnsupportedError(f"{picture}: {error}") from None


def _survivors(rows: np.ndarray) -> np.ndarray:
    """Which particles have descendants in the last slice, shape (time, particles)."""
    alive = np.ones(rows.shape, dtype=bool)
    for t in range(len(rows) - 1, 0, -1):
        parents = rows[t][alive[t]]
        alive[t - 1] = False
        alive[t - 1, parents[parents >= 0]] = True
    return alive


def _segments(
    values: np.ndarray,
    rows: np.ndarray,
    chosen: np.ndarray,
    where: np.ndarray,
    begin: int,
    most: int,
) -> np.ndarray:
    """Lines from chosen particles to their ancestors, ``(lines, 2, 2)``; so many of each slice at most."""
    found = [np.zeros((0, 2, 2))]
    for t in range(begin + 1, len(values)):
        own = np.flatnonzero(chosen[t] & (rows[t] >= 0))
        own = own[:: max(1, -(-len(own) // max(most, 1)))]
        ends = np.stack([values[t - 1, rows[t][own]], values[t, own]], axis=1)
        span = np.broadcast_to(where[t - 1 : t + 1], ends.shape)
        found.append(np.stack([span, ends], axis=2))
    return np.concatenate(found)


def _held_weights(filtered: Any) -> list[np.ndarray] | None:
    """Weights of every slice, ``(particles, *plates)``; None where they were not kept."""
    clouds = getattr(filtered, "clouds", None)
    return None if clouds is None else [np.asarray(cloud.weights / cloud.total) for cloud in clouds]


def _effective(
    ax: Axes, filtered: Any, ess: np.ndarray, pick: tuple[Any, ...], at: np.ndarray
) -> None:
    counts = filtered.counts if getattr(filtered, "counts", None) is not None else None
    ax.plot(at, ess, color=BLUE, linewidth=1.3, label="effective")
    if counts is not None:
        ax.plot(at, counts, color=INK, linewidth=0.9, linestyle=(0, (4, 3)), label="particles")
    if filtered.unique_ancestors is not None:
        found = np.asarray(filtered.unique_ancestors)
        found = found[pick] if found.ndim == ess.ndim + len(pick) - 1 else found
        if found.shape == at.shape:
            ax.plot(at, found, color=GREEN, linewidth=0.9, alpha=0.8, label="with offspring")
    resampled = np.asarray(filtered.resampled, dtype=bool)
    resampled = resampled[pick] if resampled.ndim > 1 else resampled
    ax.set_ylim(bottom=0)
    ax.plot(at[resampled], np.zeros(int(resampled.sum())), "|", color=VERMILION, markersize=8, clip_on=False,
            label="resampled")  # fmt: skip
    ax.set_ylabel("particles")
    ax.legend(frameon=False, fontsize="small", loc="lower left", bbox_to_anchor=(0, 1), ncols=4)


def _spread(ax: Axes, held: list[np.ndarray], at: np.ndarray) -> None:
    """Weights in units of an equal share: the largest, and between which most of the mass lies."""
    levels = []
    for weights in held:
        order = np.sort(weights)[::-1] * len(weights)
        mass = np.cumsum(order) / len(weights)
        levels.append(
            [
                order[0],
                *(
                    order[np.searchsorted(mass, p)] if mass[-1] > p else order[-1]
                    for p in (0.1, 0.5, 0.9)
                ),
            ]
        )
    top, high, middle, low = np.maximum(np.array(levels), 1e-6).T
    ax.fill_between(at, low, high, color=BLUE, alpha=0.25, linewidth=0, label="80 % of the mass")
    ax.plot(at, middle, color=BLUE, linewidth=1.2, label="half of the mass above")
    ax.plot(at, top, color=ORANGE, linewidth=1.0, label="largest")
    ax.axhline(1.0, color=INK, linewidth=0.7)
    ax.set_yscale("log")
    ax.set_ylabel("weight / equal share")
    ax.legend(frameon=False, fontsize="small", loc="lower left", bbox_to_anchor=(0, 1), ncols=3)


def _times(times: Any, steps: int, start: int, what: str) -> np.ndarray:
    if times is None:
        return np.arange(start, start + steps)
    found = np.asarray(times)
    if found.shape != (steps,):
        raise QueryError(
            f"{what}: times has shape {found.shape}, and there are {steps} slices; give one for each"
        )
    return found
