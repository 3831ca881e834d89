"""``Summary``: a table of one row per scalar that prints well without a data-frame library."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.drawing.html import figure, table
from bayesmc.errors import UnknownNodeError, missing_extra
from bayesmc.network import CompiledNode, Observed


@dataclass(frozen=True, eq=False)
class Summary:
    """Rows of figures, one per scalar.

    Attributes
    ----------
    names : tuple of str
        Row names such as ``"mean[0]"`` or ``"rain[yes]"``.
    columns : dict
        Column name -> array, one entry per row.
    title : str

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet()
    >>> net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    >>> summary = bmc.infer(net).summary()
    >>> summary.names, float(summary["rain[yes]"]["mean"].__round__(6))
    (('rain[no]', 'rain[yes]'), 0.2)
    """

    names: tuple[str, ...]
    columns: dict[str, np.ndarray]
    title: str = ""

    def __getitem__(self, key: str) -> Any:
        """A column as an array, or a row as a dict."""
        if key in self.columns:
            return self.columns[key]
        if key in self.names:
            row = self.names.index(key)
            return {column: float(values[row]) for column, values in self.columns.items()}
        raise UnknownNodeError(
            f"summary: no row or column {key!r}; columns are {list(self.columns)}"
        )

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def to_dict(self) -> dict[str, dict[str, float]]:
        """Row name -> {column: figure}."""
        return {name: self[name] for name in self.names}

    def to_dataframe(self) -> Any:
        """As a pandas ``DataFrame``, a row for each name.

        Raises
        ------
        MissingExtraError
            Without pandas (the extra ``pandas``).
        """
        try:
            pandas = importlib.import_module("pandas")
        except ImportError:
            raise missing_extra("pandas", "pandas") from None
        return pandas.DataFrame(self.columns, index=list(self.names))

    def _repr_html_(self) -> str:
        """As notebooks show it."""
        rows = [
            [name, *(figure(v[i]) for v in self.columns.values())]
            for i, name in enumerate(self.names)
        ]
        return table(["", *self.columns], rows, self.title)

    def __str__(self) -> str:
        shown = list(range(len(self.names)))
        if len(shown) > 60:
            shown = [*shown[:30], *shown[-30:]]
        head = ["", *self.columns]
        rows = [[self.names[i], *(figure(v[i]) for v in self.columns.values())] for i in shown]
        if len(self.names) > 60:
            rows.insert(30, ["..."] + [""] * len(self.columns))
        widths = [max(len(r[c]) for r in [head, *rows]) for c in range(len(head))]
        lines = [
            "  ".join(
                [
                    row[0].ljust(widths[0]),
                    *(t.rjust(w) for t, w in zip(row[1:], widths[1:], strict=True)),
                ]
            ).rstrip()
            for row in [head, *rows]
        ]
        return "\n".join([self.title, *lines] if self.title else lines)

    __repr__ = __str__


def row_names(node: CompiledNode, labels: Mapping[str, Sequence[Any]]) -> list[str]:
    """Names of a node's numbers, of a node with labels of its probabilities: ``"rain[yes]"``.

    Parameters
    ----------
    labels : mapping
        Of plates that have some.
    """
    axes = [
        [str(x) for x in labels.get(p, range(n))]
        for p, n in zip(node.plates, node.plate_shape, strict=True)
    ]
    axes += [[str(i) for i in range(n)] for n in node.event_shape]
    if node.domain is not None and node.domain.labels is not None:
        axes.append([str(s) for s in node.domain.states])
    shape = tuple(len(a) for a in axes)
    return [
        node.name + (f"[{', '.join(a[i] for a, i in zip(axes, at, strict=True))}]" if at else "")
        for at in np.ndindex(shape)
    ]


def shown_rows(node: CompiledNode, seen: Observed | None) -> np.ndarray:
    """Which of a node's rows are left where what was seen of it has none."""
    known = np.zeros(node.value_shape, dtype=bool)
    if seen is not None:
        known = known | seen.numbers(len(node.event_shape))
    labelled = node.domain is not None and node.domain.labels is not None
    return np.repeat(~known.ravel(), node.domain.size if labelled and node.domain else 1)
