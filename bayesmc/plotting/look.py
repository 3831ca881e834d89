"""What pictures share: colours that the colour-blind tell apart, panels, and which numbers are drawn.

Colours are those of Okabe and Ito (2008), Color universal design; where more than eight lines meet they
get one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.errors import QueryError, UnsupportedError
from bayesmc.plotting.pyplot import pyplot
from bayesmc.results import Posterior, SeriesPosterior
from bayesmc.results.over_time import expanded
from bayesmc.states import StateArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLUE, ORANGE, GREEN, VERMILION = "#0072b2", "#e69f00", "#009e73", "#d55e00"
PALETTE = (BLUE, ORANGE, GREEN, "#cc79a7", "#56b4e9", VERMILION, "#8c7a00", "#444444")
INK, FAINT = "#333333", "#9aa7b2"
#: elements of one node that are drawn without being named; numbers in a picture
EACH, MOST = 12, 24

Names = str | Sequence[str | tuple[str, Any]]


@dataclass(frozen=True)
class Scalar:
    """One number of a node: the node, where it is among its elements and components, what to call it."""

    node: str
    index: tuple[int, ...]
    label: str

    def draws(self, posterior: Posterior) -> np.ndarray:
        """Its draws, shape ``(chain, draw)``."""
        values: Any = posterior[self.node]
        return np.asarray(values[(slice(None), slice(None), *self.index)], dtype=float)


def check_posterior(answer: Any, what: str) -> None:
    """That there are draws or tables of one net, not beliefs slice by slice.

    Raises
    ------
    UnsupportedError
        The message has the pictures that there are.
    """
    if isinstance(answer, Posterior):
        return
    if isinstance(answer, SeriesPosterior):
        particles = getattr(answer, "weight_ess", None) is not None
        others = (
            ", weights() and, of filters with particles kept, ancestry(name)" if particles else ""
        )
        raise UnsupportedError(
            f"{what}: a {type(answer).__name__} has beliefs slice by slice; its pictures are bands(name) and "
            f"forecast(ahead, name){others}. For this one ask infer(template, rows), whose numbers are "
            'named with their slice, "x[3]"'
        )
    raise UnsupportedError(
        f"{what}: {type(answer).__name__} is no posterior; give what infer returned"
    )


def chosen_scalars(
    posterior: Posterior, names: Names | None, what: str, most: int = MOST
) -> tuple[list[Scalar], str]:
    """The numbers that are drawn, and a note where some are left out.

    Raises
    ------
    UnknownNodeError, QueryError
    UnsupportedError
        A named node has labels, which are no numbers; the answer is no posterior of a net.
    """
    check_posterior(posterior, what)
    every = list(_of_names(posterior, names, what))
    if not every:
        raise QueryError(
            f"{what}: no node with numbers is unobserved here; name nodes with names=[...], or draw "
            "plot_marginal(posterior, name) of one with states"
        )
    if len(every) <= most:
        return every, ""
    return every[:most], f"the first {most} of {len(every)} numbers; names= says which"


def one_scalar(
    posterior: Any,
    name: str,
    index: Any,
    shape: tuple[int, ...],
    what: str,
    given: str = "index={index}",
) -> Scalar:
    """The number of a node that an index picks; ``given`` is how that is asked for.

    Raises
    ------
    QueryError
        It picks none, or several.
    """
    at = index if isinstance(index, tuple) else (index,)
    whole = all(isinstance(i, (int, np.integer)) for i in at) and len(at) == len(shape)
    if whole and all(-n <= i < n for i, n in zip(at, shape, strict=True)):
        return Scalar(name, at, label_of(posterior, name, at))
    if shape:
        example = 0 if len(shape) == 1 else (0,) * len(shape)
        raise QueryError(
            f"{what}: {name!r} has shape {shape}, and {index!r} names no number of it; name one, such as "
            f"{given.format(name=name, index=example)}"
        )
    raise QueryError(f"{what}: {name!r} is one number, without an index; got {index!r}")


def label_of(posterior: Any, name: str, index: tuple[int, ...]) -> str:
    """``name[plate label, component]``."""
    model = posterior.model
    node = model.nodes.get(name)
    plates = () if node is None else node.plates
    parts = []
    for k, i in enumerate(index):
        known = model.labels.get(plates[k]) if k < len(plates) else None
        parts.append(str(i if known is None else list(known)[i]))
    return f"{name}[{', '.join(parts)}]" if parts else name


def single_axes(ax: Axes | None, size: tuple[float, float] = (6.4, 3.6)) -> Axes:
    """The axes given, or those of a new figure."""
    if ax is not None:
        return ax
    made: Axes = pyplot().subplots(figsize=size, layout="constrained")[1]
    return made


def grid_axes(
    axes: Any, rows: int, columns: int, size: tuple[float, float], what: str, **options: Any
) -> np.ndarray:
    """Axes in rows and columns: those given, or those of a new figure with panels of a size in inches.

    Raises
    ------
    ValueError
        Other axes are given than are needed.
    """
    if axes is not None:
        given = np.asarray(axes, dtype=object)
        if given.size != rows * columns:
            raise ValueError(
                f"{what}: {given.size} axes for {rows} x {columns} panels; give as many, or none"
            )
        return given.reshape(rows, columns)
    made = pyplot().subplots(
        rows,
        columns,
        figsize=(size[0] * columns, size[1] * rows + 0.3),
        squeeze=False,
        layout="constrained",
        **options,
    )
    return np.asarray(made[1], dtype=object)


def wrapped(count: int, columns: int = 3) -> tuple[int, int]:
    """Rows and columns for so many panels."""
    across = min(count, columns)
    return math.ceil(count / across), across


def tidy(*axes: Axes) -> None:
    """Without the frame's upper and right sides."""
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)


def dates(ax: Axes, at: np.ndarray) -> None:
    """Short dates along the axis, where it has dates."""
    if at.dtype.kind == "M" or (len(at) and isinstance(at[0], date)):
        from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

        locator = AutoDateLocator(minticks=3, maxticks=8)
        ax.xaxis.set_major_locator(locator)
        ax.xaxis.set_major_formatter(ConciseDateFormatter(locator))


def note(ax: Axes, text: str) -> None:
    """A line in small print below a figure's panels."""
    if text:
        figure: Any = ax.get_figure(root=True)
        figure.supxlabel(text, fontsize="small", color=INK)


def title(ax: Axes, text: str) -> None:
    """A node's name as a title: never read as mathematics."""
    ax.set_title(text, fontsize="medium", parse_math=False)


def line_style(k: int, many: int) -> dict[str, Any]:
    """Colour and width of one of several lines; of very many all look the same."""
    if many <= len(PALETTE):
        return {"color": PALETTE[k], "linewidth": 0.9, "alpha": 0.85}
    return {"color": BLUE, "linewidth": 0.5, "alpha": max(0.15, min(0.6, 8 / many))}


def numbers(values: Any, what: str) -> np.ndarray:
    """Values as floats, NaN where missing.

    Raises
    ------
    QueryError
        They are labels.
    """
    if isinstance(values, StateArray):
        raise QueryError(f"{what}: labels cannot be drawn as numbers")
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(float), np.nan)
    try:
        return np.array(
            [np.nan if v is None else v for v in np.asarray(values, dtype=object)], float
        )
    except (TypeError, ValueError):
        raise QueryError(
            f"{what}: give numbers, one for each slice; labels cannot be drawn"
        ) from None


def draw_density(ax: Axes, values: np.ndarray, style: dict[str, Any], fill: bool = False) -> None:
    """A kernel density; of whole numbers their shares; a line where nothing varies."""
    values = values[np.isfinite(values)]
    if len(values) < 2 or values.min() == values.max():
        if len(values):
            ax.axvline(values[0], **style)
        return
    if np.array_equal(values, np.round(values)):
        at, counts = np.unique(values, return_counts=True)
        ax.plot(at, counts / len(values), drawstyle="steps-mid", **style)
        return
    from arviz_stats.base import array_stats

    points, heights, _ = array_stats.kde(values)
    ax.plot(points, heights, **style)
    if fill:
        ax.fill_between(points, heights, color=style["color"], alpha=0.2, linewidth=0)


# ---- private ------------------------------------------------------------------------------------


def _of_names(posterior: Posterior, names: Names | None, what: str) -> Iterator[Scalar]:
    wanted: Iterable[Any]
    if names is None:
        wanted = [n for n in posterior.names if _is_drawn(posterior, n)]
    else:
        wanted = [names] if isinstance(names, str) else names
    for item in wanted:
        name, index = item if isinstance(item, tuple) and len(item) == 2 else (item, None)
        if not isinstance(name, str):
            raise QueryError(
                f"{what}: names= lists nodes, or numbers of them as 'x[0]' or ('x', 0), not {item!r}"
            )
        name, index = _parted(posterior, name, what) if index is None else (name, index)
        for own in expanded(posterior.model, [name]):
            node = posterior._node(own)
            if node.domain is not None and node.domain.labels is not None:
                raise UnsupportedError(
                    f"{what}: {own!r} has the states {node.domain.states}, which are no numbers; draw "
                    f"plot_marginal(posterior, {own!r}) of it"
                )
            shape = node.value_shape
            if index is not None:
                yield one_scalar(posterior, own, index, shape, what, "({name!r}, {index})")
                continue
            for at in np.ndindex(shape):
                yield Scalar(own, at, label_of(posterior, own, at))


def _parted(posterior: Posterior, name: str, what: str) -> tuple[str, tuple[int, ...] | None]:
    """A name and None, or of ``x[label]``, as summaries have it, the node and the index of the number.

    Raises
    ------
    QueryError
        The node has no number of this name.
    """
    model = posterior.model
    stems = (name[:k] for k, letter in enumerate(name) if letter == "[")
    base = next((stem for stem in stems if stem in model.nodes), None)
    if name in model.nodes or base is None:
        return name, None
    shape = posterior._node(base).value_shape
    labels = {label_of(posterior, base, at): at for at in np.ndindex(shape)}
    if name not in labels:
        some = ", ".join(map(repr, list(labels)[:4])) + (", ..." if len(labels) > 4 else "")
        raise QueryError(f"{what}: {name!r} is no number of {base!r}; its numbers are {some}")
    return base, labels[name]


def _is_drawn(posterior: Posterior, name: str) -> bool:
    node = posterior.model.nodes[name]
    labelled = node.domain is not None and node.domain.labels is not None
    few = math.prod(node.value_shape) <= EACH
    return posterior._is_free(name) and not labelled and not node.is_object and few
