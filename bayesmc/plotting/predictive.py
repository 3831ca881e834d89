"""Data that a posterior predicts, laid over those that were observed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.errors import QueryError, UnsupportedError
from bayesmc.network import CompiledNode
from bayesmc.plotting.look import BLUE, INK, one_scalar, single_axes, tidy
from bayesmc.results import Posterior
from bayesmc.results.over_time import slices_of
from bayesmc.states import StateArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: whole numbers of more values than these are drawn as densities
FEW = 30


def plot_predictive(
    posterior: Posterior,
    name: str,
    component: int | tuple[int, ...] = (),
    *,
    draws: int = 50,
    rng: Any = 0,
    ax: Axes | None = None,
) -> Axes:
    """Draw how an observed node's values spread, over those of data sets that the posterior predicts.

    Numbers are drawn as densities, one thin line for each predicted data set, which end where the node's
    support does; counts and states as the share of each value, with the range of 90 % of the predicted
    shares. A single observed number is a line among what was predicted for it.

    Parameters
    ----------
    posterior : Posterior
        Whatever made it, with its net's functions.
    name : str
        An observed node; of an unrolled template its name there.
    component : int or tuple of int
        Of a node of vectors.
    draws : int
        Data sets that are predicted.
    rng : seed, SeedSequence, Generator or None
    ax : matplotlib.axes.Axes, optional

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    QueryError
        The node was not observed, or ``component`` picks none.
    UnknownNodeError, UnsupportedError, MissingExtraError

    See Also
    --------
    Posterior.predictive_check : statistics of both, side by side.

    References
    ----------
    Gabry, Simpson, Vehtari, Betancourt and Gelman (2019), Visualization in Bayesian workflow, JRSS A 182,
    sec. 4.

    Examples
    --------
    >>> import matplotlib
    >>> matplotlib.use("agg")
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet(plates={"day": 5})
    >>> net.add("rate", bmc.Gamma(2.0, 1.0))
    >>> net.add("count", lambda rate: bmc.Poisson(rate), plates="day")
    >>> posterior = bmc.infer(net, {"count": [3, 0, 2, 2, 4]}, engine=bmc.Gibbs(200), rng=0)
    >>> ax = posterior.plot.predictive("count")
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['predicted, median', '90 % of predictions', 'observed']
    """
    if not isinstance(posterior, Posterior):
        raise UnsupportedError(
            f"plot_predictive: a {type(posterior).__name__} predicts no data; of filters look at "
            "residual_check(name) and innovations(name), or ask infer(template, rows) by an engine of chains"
        )
    if isinstance(draws, bool) or not isinstance(draws, (int, np.integer)) or draws < 1:
        raise QueryError(
            f"plot_predictive(draws={draws!r}): a whole number of data sets, 1 or more"
        )
    node, data, predicted, at = _both(posterior, name, component, int(draws), rng)
    ax = single_axes(ax)
    if isinstance(data, StateArray) or data.dtype.kind in "biu" and len(np.unique(data)) <= FEW:
        _draw_shares(ax, node, data, predicted)
    elif data.size == 1:
        pooled, ends = np.asarray(predicted, dtype=float).ravel(), _ends(node, at)
        style = {"color": BLUE, "linewidth": 1.4, "label": "predicted"}
        _draw_density(ax, pooled, _points(pooled, ends), ends, style)
        ax.axvline(float(data.ravel()[0]), color=INK, linewidth=1.8, label="observed")
    else:
        numbers = np.asarray(data, dtype=float), np.asarray(predicted, dtype=float)
        _draw_densities(ax, *numbers, _ends(node, at))
    ax.set_xlabel(name, parse_math=False)
    ax.set_ylim(bottom=0)
    ax.legend(frameon=False, fontsize="small", loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
    tidy(ax)
    return ax


# ---- private ------------------------------------------------------------------------------------


def _both(
    posterior: Posterior, name: str, component: Any, draws: int, rng: Any
) -> tuple[CompiledNode, Any, Any, tuple[int, ...]]:
    """The node, what was seen of it, shape (data,), predictions, shape (draws, data), and its component."""
    model = posterior.model
    rows = slices_of(model, name) or (posterior._node(name).name,)
    node = model.nodes[rows[0]]
    at: tuple[int, ...] = ()
    if node.event_shape or component != ():
        at = one_scalar(
            posterior, name, component, node.event_shape, "plot_predictive", "component={index}"
        ).index
    drawn = posterior.resample(draws, rng=rng).predict(list(rows), rng=rng)
    seen, made = [], []
    for row in rows:
        own = posterior._seen.get(row)
        if own is None:
            continue
        values, new = model[row].decode(own.value), drawn[row]
        codes: Any = (
            np.asarray(v.codes if isinstance(v, StateArray) else v) for v in (values, new)
        )
        old, anew = (c[(..., *at)] if at else c for c in codes)
        mask = np.ones(old.shape, bool) if own.mask is None else _of_entries(own.mask, old.shape)
        seen.append(old[mask])
        made.append(anew.reshape(-1, *old.shape)[:, mask])
    data = np.concatenate(seen) if seen else np.zeros(0)
    if not data.size:
        raise QueryError(
            f"plot_predictive: {name!r} was not observed; name an observed node, or draw "
            f"plot_marginal(posterior.predict({name!r}), ...)"
        )
    predicted = np.concatenate(made, axis=1)
    if node.domain is not None and node.domain.labels is not None:
        states = node.domain.states
        return node, StateArray(data, states), StateArray(predicted, states), at
    return node, data, predicted, at


def _ends(node: CompiledNode, at: tuple[int, ...]) -> tuple[float, float]:
    """Where the support of a node's number ends, whatever its parents are; infinite where it may differ."""
    support = node.support or node.reach
    if support is not None and support.kind == "product" and len(at) == 1:
        place, component = 0, at[0] % node.event_shape[0]
        for part, count in support.parts:
            place += max(count, 1)
            if component < place:
                support = part
                break
    if support is None or support.kind not in ("interval", "simplex"):
        return -np.inf, np.inf
    if support.kind == "simplex":
        return 0.0, 1.0
    whole = support.at_most
    return float(np.min(whole.low)), float(np.max(whole.high))


def _of_entries(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Which entries were seen; of a vector all components or none."""
    found: Any = np.asarray(mask)
    if found.ndim > len(shape):
        found = found.all(axis=tuple(range(len(shape), found.ndim)))
    return np.broadcast_to(found.reshape(found.shape + (1,) * (len(shape) - found.ndim)), shape)


def _draw_shares(ax: Axes, node: CompiledNode, data: Any, predicted: Any) -> None:
    if isinstance(data, StateArray):
        names, own, made = [str(s) for s in data.states], data.codes, predicted.codes
        values = np.arange(len(names))
    else:
        own, made = data.astype(int), predicted.astype(int)
        low = min(own.min(), int(np.quantile(made, 0.005)))
        high = max(own.max(), int(np.quantile(made, 0.995)))
        values = np.arange(low, high + 1)
        names = [str(v) for v in values]
    observed = (own[None, :] == values[:, None]).mean(axis=1)
    shares = np.array([(made == v).mean(axis=1) for v in values])
    ends = np.quantile(shares, [0.05, 0.5, 0.95], axis=1)
    at = np.arange(len(values))
    ax.bar(at, observed, 0.8, color=INK, alpha=0.3, label="observed")
    ax.plot(at, ends[1], "o", color=BLUE, markersize=4.5, label="predicted, median")
    ax.vlines(at, ends[0], ends[2], color=BLUE, linewidth=1.6, label="90 % of predictions")
    step = 1 + len(values) // 16
    crowded = sum(len(n) for n in names[::step]) > 60
    ax.set_xticks(at[::step], names[::step], rotation=90 if crowded else 0)
    ax.set_ylabel("share")


def _draw_densities(
    ax: Axes, data: np.ndarray, predicted: np.ndarray, ends: tuple[float, float]
) -> None:
    both = np.concatenate([data, predicted.ravel()[:: max(1, predicted.size // 10_000)]])
    points = _points(both, ends, data)
    for k, own in enumerate(predicted):
        style: dict[str, Any] = {"color": BLUE, "linewidth": 0.6, "alpha": 0.35}
        style["label"] = f"{len(predicted)} predicted" if not k else None
        _draw_density(ax, own, points, ends, style)
    _draw_density(ax, data, points, ends, {"color": INK, "linewidth": 1.8, "label": "observed"})
    ax.set_yticks([])
    ax.set_xlim(points[0], points[-1])


def _points(
    values: np.ndarray, ends: tuple[float, float], also: np.ndarray | None = None
) -> np.ndarray:
    """Where densities are drawn: the central part of all, and all that was observed, within the support."""
    low, high = np.quantile(values, [0.005, 0.995])
    if also is not None:
        low, high = min(low, also.min()), max(high, also.max())
    room = 0.08 * (high - low) or 0.5
    return np.linspace(max(low - room, ends[0]), min(high + room, ends[1]), 300)


def _draw_density(
    ax: Axes,
    values: np.ndarray,
    points: np.ndarray,
    ends: tuple[float, float],
    style: dict[str, Any],
) -> None:
    """A kernel density, of the same width rule for all: Scott's, with a robust spread.

    What kernels have beyond the ends of the support is folded back (Silverman 1986, sec. 2.10).
    """
    spread = min(
        values.std(), (np.quantile(values, 0.75) - np.quantile(values, 0.25)) / 1.349 or np.inf
    )
    width = (spread or 0.01 * (points[-1] - points[0])) * len(values) ** -0.2
    kept = values[:: max(1, len(values) // 5000)]
    height = np.zeros(len(points))
    for turned in (kept, *(2 * end - kept for end in ends if np.isfinite(end))):
        z = (points[:, None] - turned) / width
        height += np.exp(-0.5 * z * z).mean(axis=1) / (width * np.sqrt(2 * np.pi))
    ax.plot(points, height, **style)
