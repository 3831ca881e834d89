"""scikit-learn's classifiers with a Bayes net behind them; scikit-learn (extra ``sklearn``) loads with
this module.

What is learned are tables, by ``bayesmc.fit``; features that are numbers of many values are cut into bins.
Structure is not learned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.auto import infer_many
from bayesmc.errors import EvidenceError, ModelError, did_you_mean, missing_extra
from bayesmc.learning import fit
from bayesmc.network import BayesNet
from bayesmc.network.columns import columns_of, is_frame

try:
    from sklearn.base import BaseEstimator, ClassifierMixin
    from sklearn.utils.multiclass import check_classification_targets
    from sklearn.utils.validation import check_is_fitted, validate_data
except ImportError:
    raise missing_extra("scikit-learn", "sklearn") from None

__all__ = ["BayesNetClassifier"]

#: rows that are asked about at a time
_AT_ONCE = 10_000


class BayesNetClassifier(ClassifierMixin, BaseEstimator):
    """A classifier that asks a Bayes net for the probabilities of one of its nodes, given the others.

    Without ``net`` it is naive Bayes: features are independent given the class. Features that are labels have
    a state for each; of numbers each value is a state, if there are at most ``bins``, and otherwise each
    of so many bins between quantiles. Missing features (NaN, None, NA) are filled in by
    expectation-maximisation when tables are learned, and left out of the evidence when classes are predicted.

    Parameters
    ----------
    net : BayesNet, optional
        Over finite nodes without plates, one of which is the class. Columns of ``X`` are its nodes by name;
        nodes without a column stay hidden. Of an array the columns are the other nodes in the net's order.
    target : str, optional
        The node that is the class; to be given with ``net``.
    learn : bool
        Learn the net's tables. Otherwise it is asked as it is, and may hold other nodes, too.
    counts : float
        Dirichlet counts that are added to every entry of a table that is learned; 0 is maximum likelihood.
    bins : int
        Of features that are numbers, without ``net``.
    handle_unknown : "error" or "ignore"
        What is done where a row to be classified has a label that is no state: it is refused, or counts as
        missing.

    Attributes
    ----------
    classes_ : ndarray, shape (classes,)
    net_ : BayesNet
        With its tables learned; ask it anything, e.g. with ``bayesmc.infer``.
    target_ : str
    fit_ : Fit or None
        What ``bayesmc.fit`` said.
    n_features_in_ : int
    feature_names_in_ : ndarray of str
        Where ``X`` has names.

    Raises
    ------
    MissingExtraError
        Without scikit-learn, when the module is imported.

    References
    ----------
    Friedman, Geiger and Goldszmidt (1997), Bayesian network classifiers, Machine Learning 29, sec. 2.

    Examples
    --------
    >>> from bayesmc.sklearn import BayesNetClassifier
    >>> X = [["red", "round"], ["red", "long"], ["green", "round"], ["green", "long"]] * 5
    >>> y = ["apple", "pepper", "apple", "cucumber"] * 5
    >>> classifier = BayesNetClassifier().fit(X, y)
    >>> classifier.predict([["green", "round"], ["red", None]]).tolist()
    ['apple', 'apple']
    >>> classifier.predict_proba([["green", "long"]]).round(2).tolist()
    [[0.08, 0.79, 0.13]]
    """

    def __init__(
        self,
        net: BayesNet | None = None,
        target: str | None = None,
        *,
        learn: bool = True,
        counts: float = 1.0,
        bins: int = 8,
        handle_unknown: str = "error",
    ) -> None:
        self.net = net
        self.target = target
        self.learn = learn
        self.counts = counts
        self.bins = bins
        self.handle_unknown = handle_unknown

    def fit(self, X: Any, y: Any) -> BayesNetClassifier:
        """Learn the tables from rows of features and their classes.

        Parameters
        ----------
        X : array_like or data frame, shape (rows, features)
        y : array_like, shape (rows,)

        Raises
        ------
        ValueError, ModelError, EvidenceError
        """
        if self.handle_unknown not in ("error", "ignore"):
            raise ValueError(f"handle_unknown={self.handle_unknown!r}: give 'error' or 'ignore'")
        array, y = validate_data(self, X, y, dtype=None, ensure_all_finite="allow-nan", reset=True)
        check_classification_targets(y)
        self.classes_, codes = np.unique(y, return_inverse=True)
        columns = _columns(X, array)
        if self.net is None:
            net, target = self._naive(columns)
        else:
            net, target = self._given(columns)
        self.target_ = target
        names = self._names = list(columns) if self.net is None else self._nodes(columns)
        data = dict(zip(names, self._coded(columns), strict=True))
        self.fit_ = None
        if self.learn or self.net is None:
            data[target] = self.classes_[codes]
            self.fit_ = fit(net, data, counts=self.counts)
            net = self.fit_.net
        self.net_ = net
        self._order = self._class_order()
        return self

    def predict_proba(self, X: Any) -> np.ndarray:
        """Probabilities of the classes, shape ``(rows, classes)``, in the order of ``classes_``."""
        check_is_fitted(self)
        array = validate_data(self, X, dtype=None, ensure_all_finite="allow-nan", reset=False)
        columns = self._known(self._coded(_columns(X, array)))
        missing = [[v is None or v != v for v in c.tolist()] for c in columns]
        found = []
        for start in range(0, len(array), _AT_ONCE):
            rows = range(start, min(start + _AT_ONCE, len(array)))
            sets = [
                {
                    n: c[k]
                    for n, c, gaps in zip(self._names, columns, missing, strict=True)
                    if not gaps[k]
                }
                for k in rows
            ]
            found.append(infer_many(self.net_, sets, progress=False).probabilities(self.target_))
        shares = np.concatenate(found)[:, self._order]
        return shares / shares.sum(axis=1, keepdims=True)

    def predict(self, X: Any) -> np.ndarray:
        """The most probable classes, shape ``(rows,)``."""
        shares = self.predict_proba(X)
        return self.classes_[shares.argmax(axis=1)]

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.allow_nan = True
        tags.input_tags.categorical = True
        tags.input_tags.string = True
        return tags

    # ---- private -------------------------------------------------------------------------------

    def _naive(self, columns: Mapping[str, np.ndarray]) -> tuple[BayesNet, str]:
        """Features that are independent given the class."""
        if (
            isinstance(self.bins, bool)
            or not isinstance(self.bins, (int, np.integer))
            or self.bins < 2
        ):
            raise ValueError(
                f"BayesNetClassifier(bins={self.bins!r}): give a whole number, 2 or more"
            )
        target = self.target or "class"
        while target in columns:
            target += "_"
        net, size = BayesNet("naive Bayes"), len(self.classes_)
        states = tuple(_plain(c) for c in self.classes_)
        net.table(target, [], np.full(size, 1 / size), states)
        self._edges: dict[str, np.ndarray | None] = {}
        for name, column in columns.items():
            self._edges[name], own = _states(column, self.bins)
            rows = np.full((size, len(own)), 1 / len(own))
            net.table(name, [target], rows, own)
        return net, target

    def _given(self, columns: Mapping[str, np.ndarray]) -> tuple[BayesNet, str]:
        """The user's net, as far as it fits the data."""
        net, target = self.net, self.target
        if not isinstance(net, BayesNet):
            raise ModelError(f"BayesNetClassifier: net is a {type(net).__name__}; give a BayesNet")
        if target is None or target not in net:
            near = did_you_mean(target, net) if target else ""
            raise ModelError(
                f"BayesNetClassifier(target={target!r}): give the node of the net that is the class{near}; "
                f"there are {', '.join(map(repr, list(net)[:8]))}"
            )
        states = net[target].states
        if states is None:
            raise ModelError(
                f"BayesNetClassifier(target={target!r}): the class is a node with finitely many states"
            )
        for name in net if self.learn else ():
            node = net[name]
            if node.states is None or node.plates or node.kind != "stochastic":
                raise ModelError(
                    f"BayesNetClassifier: node {name!r} is no table, and tables are what is "
                    f"learned, of nets that "
                    "describe one case; learn other parameters with bmc.fit, and give the net with "
                    "learn=False"
                )
        for label in self.classes_:
            if _plain(label) not in states:
                raise EvidenceError(
                    f"BayesNetClassifier: y has {_plain(label)!r}, which is no state of {target!r}"
                    f"{did_you_mean(label, states)}; its states are {', '.join(map(repr, states))}"
                )
        self._edges = {}
        return net.copy(), target

    def _nodes(self, columns: Mapping[str, np.ndarray]) -> list[str]:
        """The node that each column is about."""
        assert self.net is not None
        others = [n for n in self.net if n != self.target]
        if not hasattr(self, "feature_names_in_"):
            if len(columns) != len(others):
                raise EvidenceError(
                    f"BayesNetClassifier: X has {len(columns)} columns without names, and the net has "
                    f"{len(others)} nodes beside {self.target!r}; give a data frame whose columns are nodes"
                )
            return others
        for name in columns:
            if name not in others:
                raise EvidenceError(
                    f"BayesNetClassifier: column {name!r} is no node of the net beside {self.target!r}"
                    f"{did_you_mean(name, others)}; drop it, or rename it"
                )
        return list(columns)

    def _coded(self, columns: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Columns as the net's states, in the order of the columns."""
        found = []
        for name, column in columns.items():
            edges = self._edges.get(name)
            if edges is None:
                found.append(column)
                continue
            numbers = _numbers(name, column)
            bins = np.searchsorted(edges, numbers, side="right").astype(float)
            found.append(np.where(np.isnan(numbers), np.nan, bins))
        return found

    def _known(self, columns: list[np.ndarray]) -> list[np.ndarray]:
        """Columns without labels that are no states.

        Raises
        ------
        ValueError
        """
        found = []
        for k, (name, column) in enumerate(zip(self._names, columns, strict=True)):
            states = self.net_[name].states
            if column.dtype.kind != "O" or states is None:
                found.append(column)
                continue
            unknown = [v is not None and v not in states for v in column.tolist()]
            if any(unknown) and self.handle_unknown == "error":
                odd = sorted({str(v) for v, u in zip(column.tolist(), unknown, strict=True) if u})
                shown = str(odd[:5])[:-1] + (", ...]" if len(odd) > 5 else "]")
                raise ValueError(
                    f"Found unknown categories {shown} in column {k} ({name!r}) during predict; known are "
                    f'{list(states)}. Give handle_unknown="ignore", which takes them for missing'
                )
            column = column.copy()
            column[unknown] = None
            found.append(column)
        return found

    def _class_order(self) -> list[int]:
        """Where the classes are among the states of the target."""
        states = list(self.net_[self.target_].states or ())
        return [states.index(_plain(label)) for label in self.classes_]


# ---- private ------------------------------------------------------------------------------------


def _columns(given: Any, array: np.ndarray) -> dict[str, np.ndarray]:
    """Features by name, numbers as floats and all else as objects, with NaN or None where missing."""
    if is_frame(given):
        named: Mapping[str, Any] = columns_of(given, "BayesNetClassifier")
        named = {str(n): named[str(n)] for n in _names(given)}
    else:
        named = {f"x{k}": array[:, k] for k in range(array.shape[1])}
    return {name: _clean(name, column) for name, column in named.items()}


def _names(frame: Any) -> Sequence[Any]:
    return list(frame.column_names if hasattr(frame, "column_names") else frame.columns)


def _clean(name: str, column: np.ndarray) -> np.ndarray:
    if column.dtype.kind in "biuf":
        return column.astype(float)
    values = [None if v is None or v != v else v for v in column.tolist()]
    known = [v for v in values if v is not None]
    if all(isinstance(v, (bool, int, float)) for v in known):
        return _finite(name, np.array([np.nan if v is None else v for v in values], dtype=float))
    odd = next((v for v in known if not isinstance(v, (str, bool, int, float))), None)
    if odd is not None:
        raise TypeError(
            f"feature {name!r}: argument must be a string or a number, not {type(odd).__name__!r}"
        )
    cleaned = np.empty(len(values), dtype=object)
    cleaned[:] = [None if v is None else str(v) for v in values]
    return cleaned


def _finite(name: str, numbers: np.ndarray) -> np.ndarray:
    if np.isinf(numbers).any():
        raise ValueError(f"feature {name!r} contains infinity; give numbers, or NaN where missing")
    return numbers


def _states(column: np.ndarray, bins: int) -> tuple[np.ndarray | None, tuple[Any, ...]]:
    """Edges between bins (None of labels), and the states."""
    if column.dtype.kind == "O":
        return None, tuple(sorted({v for v in column.tolist() if v is not None}))
    known = np.unique(column[~np.isnan(column)])
    if len(known) <= bins:
        edges = 0.5 * (known[1:] + known[:-1])
    else:
        values = column[~np.isnan(column)]
        edges = np.unique(np.quantile(values, np.arange(1, bins) / bins))
    return edges, tuple(range(len(edges) + 1))


def _numbers(name: str, column: np.ndarray) -> np.ndarray:
    if column.dtype.kind != "O":
        return column
    odd = next(v for v in column.tolist() if v is not None)
    raise EvidenceError(f"feature {name!r} has {odd!r}, and had numbers when it was learned")


def _plain(label: Any) -> Any:
    """A label as Python has it."""
    return label.item() if isinstance(label, np.generic) else label
