"""Answers as pandas data frames: draws, summaries, tables of states, beliefs over time.

pandas loads only here, when it is asked for.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.errors import QueryError, UnsupportedError, missing_extra
from bayesmc.network import CompiledNode, Model
from bayesmc.results.over_time import expanded
from bayesmc.states import StateArray

_KINDS = ("draws", "summary", "probabilities")


def pandas() -> Any:
    """The package.

    Raises
    ------
    MissingExtraError
    """
    try:
        return importlib.import_module("pandas")
    except ImportError:
        raise missing_extra("pandas", "pandas") from None


class Framed:
    """What a posterior says of its nodes, as data frames."""

    model: Any
    weights: Any

    def to_dataframe(
        self,
        what: str = "draws",
        names: str | Sequence[str] | None = None,
        resample: int | None = None,
        rng: Any = None,
    ) -> Any:
        """Draws, the summary or tables of states as a pandas ``DataFrame``.

        Parameters
        ----------
        what : "draws", "summary" or "probabilities"
            Draws: a row for each (index ``chain``, ``draw``) and a column for each number, ``"x"``,
            ``"x[a, 0]"``; states with labels are categories. The summary: a row for each number.
            Probabilities: a row for each state of each element of the finite nodes, with columns ``node``,
            ``element``, ``state`` and ``probability``.
        names : str or sequence of str, optional
            Nodes; by default those that are not wholly observed.
        resample : int, optional
            So many draws of equal weight, of posteriors that have weighted ones or none.
        rng : seed, SeedSequence, Generator or None

        Raises
        ------
        MissingExtraError
            Without pandas (the extra ``pandas``).
        UnknownNodeError, UnsupportedError, QueryError

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet()
        >>> net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
        >>> frame = bmc.infer(net).to_dataframe("probabilities")  # doctest: +SKIP
        >>> frame["probability"].tolist()  # doctest: +SKIP
        [0.8, 0.2]
        """
        if what not in _KINDS:
            raise QueryError(f"to_dataframe({what!r}): give one of {', '.join(map(repr, _KINDS))}")
        asked: Any = self
        listed = [names] if isinstance(names, str) else names
        if listed is None:
            chosen = [n for n in asked.names if asked._is_free(n)]
        else:
            chosen = expanded(self.model, listed)
        for name in chosen:
            asked._node(name)
        if what == "summary":
            return asked.summary(None if listed is None else chosen).to_dataframe()
        if what == "probabilities":
            return _probabilities(asked, chosen, listed is not None)
        if resample is not None:
            asked = asked.resample(resample, rng)
        elif self.weights is not None:
            raise UnsupportedError(
                "to_dataframe: these draws are weighted, and a table would drop the weights; pass "
                "resample=draws for equally weighted ones"
            )
        return _draws(asked, chosen)


def series_frame(found: Any, names: str | Sequence[str] | None, quantiles: Sequence[float]) -> Any:
    """See ``SeriesPosterior.to_dataframe``."""
    listed = [names] if isinstance(names, str) else names
    columns: dict[tuple[str, str, str], np.ndarray] = {}
    for name in found.names if listed is None else listed:
        node = found._node(name)
        if node.domain is not None and name in found._tables:
            table = found.probabilities(name)
            kinds = [str(s) for s in node.domain.states]
            parts = {kind: table[..., k] for k, kind in enumerate(kinds)}
        else:
            parts = {"mean": found.mean(name), "sd": found.std(name)}
            if quantiles:
                values = found.quantile(name, list(quantiles))
                parts |= {f"{100 * q:g}%": values[:, k] for k, q in enumerate(quantiles)}
        elements = element_names(found.model, node)
        flat = {kind: np.reshape(v, (found.steps, -1)) for kind, v in parts.items()}
        for k, element in enumerate(elements):
            columns |= {(name, element, kind): v[:, k] for kind, v in flat.items()}
    frames = pandas()
    rows = found.times
    if rows is None:
        rows = np.arange(found.start, found.start + found.steps)
    index = frames.Index(rows, name="time")
    levels = frames.MultiIndex.from_tuples(list(columns), names=["node", "element", "statistic"])
    data = np.stack(list(columns.values()), axis=1) if columns else np.zeros((found.steps, 0))
    return frames.DataFrame(data, index=index, columns=levels)


def posteriors_frame(found: Any, names: str | Sequence[str] | None) -> Any:
    """See ``Posteriors.to_dataframe``."""
    listed = [names] if isinstance(names, str) else names
    frames = pandas()
    if found.model is None:
        if len(found):
            raise UnsupportedError("to_dataframe: no evidence set was answered")
        return frames.DataFrame(index=frames.Index([], name="evidence_set"))
    columns: dict[tuple[str, str, str], np.ndarray] = {}
    for name in found._free() if listed is None else listed:
        columns |= {
            (name, element, kind): values
            for element, kind, values in posteriors_columns(found, name)
        }
    index = frames.RangeIndex(len(found), name="evidence_set")
    levels = frames.MultiIndex.from_tuples(list(columns), names=["node", "element", "statistic"])
    data = np.stack(list(columns.values()), axis=1) if columns else np.zeros((len(found), 0))
    return frames.DataFrame(data, index=index, columns=levels)


def posteriors_columns(found: Any, name: str) -> Iterator[tuple[str, str, np.ndarray]]:
    """Element, statistic and numbers of all evidence sets: probabilities of states, or mean and sd."""
    node = found._some()._node(name)
    if node.domain is not None and not node.event_shape:
        table = found.probabilities(name)
        parts = {str(s): table[..., k] for k, s in enumerate(node.domain.states)}
    else:
        parts = {"mean": found.mean(name), "sd": found.std(name)}
    flat = {kind: np.reshape(v, (len(found), -1)) for kind, v in parts.items()}
    for k, element in enumerate(element_names(found.model, node)):
        yield from ((element, kind, v[:, k]) for kind, v in flat.items())


def element_names(model: Model, node: CompiledNode) -> list[str]:
    """What the numbers of a node are called: labels of plates, then places in a vector; one ``""`` of one
    number.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.results.dataframes import element_names
    >>> net = bmc.BayesNet(plates={"city": ["Bonn", "Ulm"]})
    >>> net.add("y", bmc.Normal(0.0, 1.0), plates="city")
    >>> element_names(net.model(), net.model()["y"])
    ['Bonn', 'Ulm']
    """
    axes = [
        [str(x) for x in model.labels.get(p, range(n))]
        for p, n in zip(node.plates, node.plate_shape, strict=True)
    ]
    axes += [[str(i) for i in range(n)] for n in node.event_shape]
    shape = tuple(map(len, axes))
    return [
        ", ".join(axis[i] for axis, i in zip(axes, at, strict=True)) for at in np.ndindex(shape)
    ]


# ---- private ------------------------------------------------------------------------------------


def _draws(posterior: Any, names: Sequence[str]) -> Any:
    frames = pandas()
    columns: dict[str, Any] = {}
    chains, draws = 1, 1
    for name in names:
        try:
            values = posterior[name]
        except UnsupportedError as error:
            raise UnsupportedError(
                f"to_dataframe: {error}; for draws of an answer that has none pass resample=draws, or ask "
                'for "summary" or "probabilities"'
            ) from None
        chains, draws = values.shape[:2]
        flat = values.reshape(chains * draws, -1)
        for k, element in enumerate(element_names(posterior.model, posterior._node(name))):
            own = f"{name}[{element}]" if element else name
            if isinstance(flat, StateArray):
                columns[own] = frames.Categorical.from_codes(flat.codes[:, k], list(flat.states))
            else:
                columns[own] = np.asarray(flat)[:, k]
    index = frames.MultiIndex.from_product([range(chains), range(draws)], names=["chain", "draw"])
    return frames.DataFrame(columns, index=index)


def _probabilities(posterior: Any, names: Sequence[str], named: bool) -> Any:
    """Of finite nodes; others are refused where they were asked for."""
    frames = pandas()
    rows: list[Mapping[str, Any]] = []
    for name in names:
        node = posterior._node(name)
        if (node.domain is None or node.event_shape) and not named:
            continue
        table = posterior.probabilities(name)
        flat = table.reshape(-1, table.shape[-1])
        for element, shares in zip(element_names(posterior.model, node), flat, strict=True):
            rows += [
                {"node": name, "element": element, "state": state, "probability": float(share)}
                for state, share in zip(node.domain.states, shares, strict=True)
            ]
    return frames.DataFrame(rows, columns=["node", "element", "state", "probability"])
