"""Posteriors and beliefs over time as notebooks show them."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from bayesmc.drawing.html import band, figure, table
from bayesmc.errors import BayesmcError
from bayesmc.results.dataframes import element_names, posteriors_columns, series_frame

#: lines of beliefs that are shown
_LINES = 24
#: numbers of each evidence set that are shown
_COLUMNS = 8


class ShownSeries:
    """Beliefs over time as a data frame, and as notebooks show them."""

    def to_dataframe(
        self, names: str | Sequence[str] | None = None, quantiles: Sequence[float] = ()
    ) -> Any:
        """Beliefs as a pandas ``DataFrame``: a row for each slice, ``times`` as index where there are some.

        Columns have levels ``node``, ``element`` (labels of plates, places in a vector) and ``statistic``:
        ``mean``, ``sd`` and quantiles such as ``5%``, or of finite nodes the probability of each state.

        Raises
        ------
        MissingExtraError
            Without pandas (the extra ``pandas``).
        UnknownNodeError, UnsupportedError, QueryError
        """
        return series_frame(self, names, quantiles)

    def _repr_html_(self) -> str:
        """As notebooks show it."""
        return series_html(self)


def posterior_html(posterior: Any) -> str:
    """What a posterior is, and its summary or why there is none."""
    evidence = posterior.log_marginal_likelihood
    said = repr(posterior)
    if isinstance(evidence, float) and np.isfinite(evidence):
        said += f", log evidence {round(evidence, 9) + 0.0:.6g}"
    try:
        inside = posterior.summary()._repr_html_()
    except BayesmcError as error:
        inside = f"<div>{escape(str(error))}</div>"
    return f"<div><div><b>{escape(said)}</b></div>{inside}</div>"


def posteriors_html(found: Any) -> str:
    """A line for each evidence set: its log evidence, and the first numbers; of many sets some."""
    count = len(found)
    half = _LINES // 2
    chosen = list(range(count))
    if count > _LINES:
        chosen = [*range(half), *range(count - half, count)]
    head = ["evidence set", "log evidence"]
    columns: list[np.ndarray] = []
    ones = [found[k] for k in chosen]
    some = next((one for one in ones if one is not None), None)
    shown = type(found).of(ones) if some is not None else None
    left = 0
    for name in [] if shown is None else shown._free():
        try:
            numbers = list(posteriors_columns(shown, name))
        except (BayesmcError, ValueError):  # plates of other sizes in some sets, nothing to tell
            continue
        for element, kind, values in numbers:
            if len(columns) >= _COLUMNS:
                left += 1
                continue
            own = f"{name}[{element}]" if element else name
            head.append(f"P({own}={kind})" if kind not in ("mean", "sd") else f"{own}, {kind}")
            columns.append(values)
    rows = []
    for j, (k, one) in enumerate(zip(chosen, ones, strict=True)):
        if one is None:
            why = "impossible" if k in found.impossible else "not answered"
            rows.append([str(k), why, *[""] * len(columns)])
            continue
        log = one.log_marginal_likelihood
        told = "" if log is None else figure(float(log))
        rows.append([str(k), told, *(figure(float(v[j])) for v in columns)])
    if count > _LINES:
        rows.insert(half, [f"... {count - _LINES} more ...", *[""] * (len(head) - 1)])
    more = f"<div>... and {left} more columns</div>" if left else ""
    return f"<div><div><b>{escape(repr(found))}</b></div>{table(head, rows)}{more}</div>"


def series_html(found: Any) -> str:
    """A line for each number, or each state, with its mean or probability over time."""
    rows: list[list[str]] = []
    total = 0
    for name in found.names:
        node = found.model.nodes[name]
        elements = element_names(found.model, node)
        if node.domain is not None and name in found._tables:
            table_ = found.probabilities(name).reshape(found.steps, len(elements), -1)
            states = [str(s) for s in node.domain.states]
            total += len(elements) * len(states)
            for k, element in enumerate(elements[: _LINES - len(rows)]):
                for i, state in enumerate(states[: _LINES - len(rows)]):
                    rows.append(_line(name, element, f"P({state})", table_[:, k, i], None))
        else:
            mean = found.mean(name).reshape(found.steps, -1)
            spread = found.std(name).reshape(found.steps, -1)
            total += len(elements)
            for k, element in enumerate(elements[: _LINES - len(rows)]):
                rows.append(_line(name, element, "mean, 2 sd", mean[:, k], spread[:, k]))
    said = f"{found.kind} by {type(found.engine).__name__}, {found.steps} slices"
    if found.times is not None and len(found.times):
        said += f" from {_date(found.times[0])} to {_date(found.times[-1])}"
    evidence = found.log_marginal_likelihood
    if isinstance(evidence, float) and np.isfinite(evidence):
        said += f", log evidence {round(evidence, 9) + 0.0:.6g}"
    head = ["node", "", "over time", "first", "last", "sd at the end"]
    more = f"<div>... and {total - len(rows)} more</div>" if total > len(rows) else ""
    return f"<div><div><b>{escape(said)}</b></div>{table(head, rows, raw=(2,))}{more}</div>"


# ---- private ------------------------------------------------------------------------------------


def _line(
    name: str, element: str, what: str, middle: np.ndarray, spread: np.ndarray | None
) -> list[str]:
    if spread is None:
        picture = band(middle)
    else:
        picture = band(middle, middle - 2 * spread, middle + 2 * spread)
    ends = [figure(float(middle[k])) if len(middle) else "" for k in (0, -1)]
    last = "" if spread is None or not len(spread) else figure(float(spread[-1]))
    return [f"{name}[{element}]" if element else name, what, picture, *ends, last]


def _date(time: Any) -> str:
    return str(time).partition("T00:00:00")[0]
