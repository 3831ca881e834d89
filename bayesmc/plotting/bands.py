"""Beliefs over time as bands, with what was observed, and forecasts as fans that go on from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.errors import QueryError, UnsupportedError
from bayesmc.plotting.look import (
    BLUE,
    INK,
    ORANGE,
    PALETTE,
    dates,
    label_of,
    numbers,
    one_scalar,
    single_axes,
    tidy,
)
from bayesmc.results import Posterior, SeriesPosterior
from bayesmc.results.over_time import slices_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PROBS = (0.5, 0.9)


def plot_bands(
    answer: SeriesPosterior | Posterior,
    name: str,
    index: int | tuple[int, ...] = (),
    *,
    observed: Any = None,
    times: Sequence[Any] | np.ndarray | None = None,
    probs: Sequence[float] = PROBS,
    color: str = BLUE,
    label: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw what is believed of a node in every slice: its median with bands; probabilities of states.

    Bands are between quantiles. Where an answer has none (a ``ParticleFilter`` without ``keep="particles"``,
    tangents that are no densities) they are the mean and its standard deviations, and the legend says so.

    Parameters
    ----------
    answer : SeriesPosterior or Posterior
        Of ``filter``, ``smooth`` or ``forecast``; of ``infer`` given a template.
    name : str
    index : int or tuple of int
        The element of a plated node, the component of a vector.
    observed : array_like, shape (time,), optional
        Drawn as points; NaN, None and masked entries are missing.
    times : sequence, optional
        What stands below the slices: numbers or dates; by default the slices' own numbers.
    probs : sequence of float
        Of the bands.
    color, label : str, optional
    ax : matplotlib.axes.Axes, optional

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    UnknownNodeError
    QueryError
        ``index`` picks no number, or ``times`` and ``observed`` have other lengths than the series.
    UnsupportedError, MissingExtraError

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> rows = [0.4, None, 2.2]
    >>> ax = bmc.filter(dbn, {"y": rows}).plot.bands("x", observed=rows)
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['filter: median, 50 and 90 %', 'observed']
    """
    _levels(probs)
    series = _Series.of(answer, name, index, "plot_bands")
    at = series.axis(times)
    ax = single_axes(ax, (7.2, 3.4))
    if series.tables is not None:
        _stack(ax, series, at)
        return ax
    words = _bands(ax, series.rows(probs), at, color)
    ax.lines[-1].set_label(label if label is not None else f"{series.kind}{words}")
    if observed is not None:
        _points(ax, at, observed, "plot_bands")
    _finish(ax, series.label, at, times)
    return ax


def plot_forecast(
    before: SeriesPosterior,
    ahead: SeriesPosterior,
    name: str,
    index: int | tuple[int, ...] = (),
    *,
    observed: Any = None,
    times: Sequence[Any] | np.ndarray | None = None,
    probs: Sequence[float] = (0.5, 0.8, 0.95),
    last: int | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a forecast as a fan that goes on from the bands of what was filtered or smoothed.

    Parameters
    ----------
    before : SeriesPosterior
        Of ``filter`` or ``smooth``.
    ahead : SeriesPosterior
        Of ``forecast`` with the same rows.
    name : str
        A node of the state, or an observed one: its values are a line then.
    index : int or tuple of int
    observed : array_like, shape (time,), optional
        Drawn as points; it may go on over the forecast's slices, to see how that did.
    times : sequence, optional
        One for each slice, those of the forecast included.
    probs : sequence of float
        Of the bands.
    last : int, optional
        Draw only so many slices of ``before``.
    ax : matplotlib.axes.Axes, optional

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    UnknownNodeError
    QueryError
        The forecast does not begin where ``before`` ends, or lengths differ.
    UnsupportedError, MissingExtraError

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    >>> rows = {"y": [0.4, 1.0, 2.2]}
    >>> filtered, ahead = bmc.filter(dbn, rows), bmc.forecast(dbn, rows, steps=4)
    >>> ax = filtered.plot.forecast(ahead, "x", observed=rows["y"])
    >>> [float(x) for x in ax.get_xlim()]
    [0.0, 6.0]
    """
    _levels(probs)
    first = _Series.of(before, name, index, "plot_forecast")
    second = _Series.of(ahead, name, index, "plot_forecast")
    if getattr(ahead, "kind", "") != "forecast" or second.start != first.start + first.steps:
        raise QueryError(
            f"plot_forecast: the second answer is of slices {second.start} to "
            f"{second.start + second.steps - 1} ({getattr(ahead, 'kind', 'no series')}), and should be the "
            "forecast that begins at slice "
            f"{first.start + first.steps}: forecast(dbn, rows, steps=) with the rows of the first"
        )
    if first.tables is not None or second.tables is not None:
        raise UnsupportedError(
            f"plot_forecast: {name!r} has states, whose probabilities plot_bands draws of either answer"
        )
    total = first.steps + second.steps
    at = _axis(times, first.start, total, "plot_forecast")
    ax = single_axes(ax, (7.2, 3.4))
    begin = 0 if last is None else max(0, first.steps - last)
    rows = [part[begin:] for part in first.rows(probs)[0]]
    words = first.rows(probs)[1]
    _bands(ax, (rows, words), at[begin : first.steps], BLUE)
    ax.lines[-1].set_label(f"{first.kind}{words}")
    fan, words = second.rows(probs)
    joined = [np.concatenate([part[-1:], own]) for part, own in zip(rows, fan, strict=True)]
    _bands(ax, (joined, words), at[first.steps - 1 :], ORANGE)
    ax.lines[-1].set_label("forecast" if words == first.rows(probs)[1] else f"forecast: {words}")
    ax.axvline(at[first.steps - 1], color=INK, linewidth=0.7, linestyle=(0, (3, 3)))
    if observed is not None:
        given = numbers(observed, "plot_forecast")
        if len(given) not in (first.steps, total):
            raise QueryError(
                f"plot_forecast: observed has {len(given)} rows; there are {first.steps} slices before "
                f"the forecast and {second.steps} of it"
            )
        _points(ax, at[begin : len(given)], given[begin:], "plot_forecast")
    _finish(ax, first.label, at, times)
    return ax


# ---- private ------------------------------------------------------------------------------------

Rows = tuple[list[np.ndarray], str]


class _Series:
    """One number of a node over time, or the probabilities of its states."""

    def __init__(
        self, answer: Any, name: str, index: tuple[int, ...], label: str, steps: int, tables: Any
    ) -> None:
        self.answer, self.name, self.index, self.label = answer, name, index, label
        self.steps, self.tables = steps, tables
        self.start = int(getattr(answer, "start", 0))
        kind = getattr(answer, "kind", "")
        self.kind = f"{kind}: " if kind else ""

    @classmethod
    def of(cls, answer: Any, name: str, index: Any, what: str) -> _Series:
        if isinstance(answer, SeriesPosterior):
            node, slices = answer._node(name), None
        elif isinstance(answer, Posterior):
            slices = slices_of(answer.model, name)
            if slices is None:
                raise QueryError(
                    f"{what}: {name!r} has no slices over time here; give an answer of filter, smooth or "
                    "forecast, or of infer(template, rows). plot_marginal and plot_forest draw nodes "
                    "without time"
                )
            node = answer.model.nodes[slices[0]]
        else:
            raise UnsupportedError(
                f"{what}: a {type(answer).__name__} is no answer over time; give that of filter, smooth or "
                "forecast, or of infer(template, rows)"
            )
        scalar = one_scalar(answer, node.name, index, node.value_shape, what)
        label = label_of(answer, node.name, scalar.index).replace(node.name, name, 1)
        if node.domain is not None and (node.domain.labels is not None or node.domain.size <= 2):
            tables = answer.probabilities(name)[(slice(None), *scalar.index)]
            found = cls(answer, name, scalar.index, label, len(tables), tables)
            found.states = [str(s) for s in node.domain.states]
            return found
        steps = len(slices) if slices is not None else len(answer.mean(name))
        return cls(answer, name, scalar.index, label, steps, None)

    states: list[str]

    def axis(self, times: Any) -> np.ndarray:
        return _axis(times, self.start, self.steps, "plot_bands")

    def rows(self, probs: Sequence[float]) -> Rows:
        """The middle, then lower and upper ends of each band, narrow ones first; what they are."""
        levels = sorted(probs)
        every = [0.5, *(q for p in levels for q in (0.5 - p / 2, 0.5 + p / 2))]
        at: Any = (slice(None), slice(None), *self.index)
        said = ", ".join(f"{100 * p:g}" for p in levels[:-1])
        said = f"{said} and {100 * levels[-1]:g} %" if said else f"{100 * levels[-1]:g} %"
        try:
            found = np.asarray(self.answer.quantile(self.name, every), dtype=float)[at]
            return list(found.T), f"median, {said}"
        except UnsupportedError:
            from scipy.special import ndtri

            middle, spread = (
                np.asarray(figure(self.name), dtype=float)[at[1:]]
                for figure in (self.answer.mean, self.answer.std)
            )
            widths = [float(ndtri(q)) for q in every]
            said = ", ".join(f"{ndtri(0.5 + p / 2):.2f}" for p in levels)
            return [middle + w * spread for w in widths], f"mean ± {said} sd"


def _axis(times: Any, start: int, steps: int, what: str) -> np.ndarray:
    if times is None:
        return np.arange(start, start + steps)
    found = np.asarray(times)
    if found.ndim != 1 or len(found) != steps:
        raise QueryError(
            f"{what}: times has shape {found.shape}, and there are {steps} slices; give one for each"
        )
    return found


def _levels(probs: Sequence[float]) -> None:
    if not len(probs) or not all(0 < p < 1 for p in probs):
        raise QueryError(
            f"probs={probs!r}: bands have probabilities between 0 and 1, as (0.5, 0.9)"
        )


def _bands(ax: Axes, found: Rows, at: np.ndarray, color: str) -> str:
    rows, words = found
    bands = list(zip(rows[1::2], rows[2::2], strict=True))
    for k, (low, high) in enumerate(reversed(bands)):
        ax.fill_between(at, low, high, color=color, alpha=0.16 + 0.1 * k, linewidth=0)
    ax.plot(at, rows[0], color=color, linewidth=1.5)
    return words


def _points(ax: Axes, at: np.ndarray, observed: Any, what: str) -> None:
    values = numbers(observed, what)
    if values.shape != (len(at),):
        raise QueryError(
            f"{what}: observed has shape {values.shape}, and there are {len(at)} slices; give one number for "
            "each, NaN where there is none"
        )
    size = 4.0 if len(at) <= 100 else 2.5 if len(at) <= 500 else 1.5
    ax.plot(
        at, values, "o", color=INK, markersize=size, markeredgewidth=0, alpha=0.7, label="observed"
    )


def _stack(ax: Axes, series: _Series, at: np.ndarray) -> None:
    """Probabilities of states on top of each other, a step for each slice."""
    many = series.tables.shape[1]
    if many > len(PALETTE):
        image = ax.pcolormesh(
            at, np.arange(many), series.tables.T, cmap="cividis", vmin=0, shading="nearest"
        )
        ax.set_yticks(range(many), series.states) if many <= 30 else None
        figure: Any = ax.get_figure(root=True)
        figure.colorbar(image, ax=ax, label="probability")
    else:
        below = np.zeros(len(at))
        for k in range(many):
            above = below + series.tables[:, k]
            ax.fill_between(
                at,
                below,
                above,
                step="mid",
                color=PALETTE[k],
                alpha=0.8,
                linewidth=0,
                label=series.states[k],
            )
            below = above
        ax.set_ylim(0, 1)
        ax.set_ylabel("probability")
        ax.legend(frameon=False, fontsize="small", loc="upper left", bbox_to_anchor=(1, 1))
    ax.margins(x=0)
    ax.set_title(f"{series.kind}{series.label}", fontsize="medium", parse_math=False)
    dates(ax, at)
    if at.dtype.kind in "iu":
        ax.set_xlabel("slice")


def _finish(ax: Axes, label: str, at: np.ndarray, times: Any) -> None:
    ax.margins(x=0)
    dates(ax, at)
    ax.set_ylabel(label, parse_math=False)
    if times is None:
        ax.set_xlabel("slice")
        ax.locator_params(axis="x", integer=True)
    legend = ax.legend(
        frameon=False, fontsize="small", loc="lower left", bbox_to_anchor=(0, 1), ncols=3
    )
    for text in legend.get_texts():
        text.set_parse_math(False)
    tidy(ax)
