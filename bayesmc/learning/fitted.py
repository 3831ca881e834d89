"""``Fit``: what was learned, with its errors, and the net in which it stands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.errors import UnknownNodeError, did_you_mean
from bayesmc.results.table import Summary

#: nats within which two climbs have ended at the same height
SAME = 0.01


def agreeing(ends: Sequence[float] | np.ndarray) -> int:
    """How many climbs ended as high as the highest."""
    return int((np.asarray(ends) > np.max(ends) - SAME).sum())


def lonely(ends: np.ndarray) -> str | None:
    """What to say where only one of several climbs ended at the highest value, or None."""
    if len(ends) < 2 or agreeing(ends) > 1:
        return None
    return (
        f"starts disagree: of {len(ends)} climbs one ended at {ends[0]:.4f}, and the others "
        f"{ends[0] - ends[1]:.4g} and more below, so that there may be higher maxima; give more restarts= "
        "(20, 50), start= near what you expect, or priors that say more"
    )


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters learned from data; made by ``bayesmc.fit``.

    Attributes
    ----------
    net : BayesNet or DynamicBayesNet
        The one given, with what was learned in place: nodes fixed at their values, tables filled in.
    values : dict
        Node -> estimate, shape ``(*plates, *event)``; of tables probabilities, the parents' axes first (the
        initial ones of a template's node ``x`` under ``"x initial"``).
    std_errors : dict
        Node -> standard error of every number, from the curvature of the log likelihood (of the log
        posterior, with ``prior=True``) at the maximum; NaN where a number lies at the edge of its support or
        the data do not tell it.
    log_likelihood : float
        Of the data at the estimates, everything hidden summed out.
    objective : float
        What was maximised: ``log_likelihood``, and with ``prior=True`` the log prior in it.
    history : ndarray
        The objective after each iteration.
    converged : bool
    iterations : int
    method : str
    covariance : ndarray or None
        Of the numbers in ``labels``.
    labels : tuple of str
    climbs : ndarray
        The objective where each climb, or EM, ended, highest first; what is returned is the first.
    at_edge : tuple of str
        Numbers that lie at the edge of their support, and have no standard error; those of the others are
        with these held.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet(plates={"i": 4})
    >>> net.add("m", bmc.Normal(0.0, 10.0))
    >>> net.add("y", lambda m: bmc.Normal(m, 1.0), plates="i")
    >>> fit = bmc.fit(net, {"y": [1.0, 2.0, 3.0, 2.0]})
    >>> round(float(fit["m"]), 4), round(float(fit.std_errors["m"]), 4)
    (2.0, 0.5)
    """

    net: Any
    values: Mapping[str, np.ndarray]
    std_errors: Mapping[str, np.ndarray]
    log_likelihood: float
    objective: float
    history: np.ndarray
    converged: bool
    iterations: int
    method: str
    covariance: np.ndarray | None = field(default=None, repr=False)
    labels: tuple[str, ...] = ()
    climbs: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)
    at_edge: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.values:
            raise UnknownNodeError(
                f"fit: {name!r} was not learned{did_you_mean(name, list(self.values))}; learned are "
                f"{', '.join(map(repr, self.values))}"
            )
        return self.values[name]

    def summary(self) -> Summary:
        """A row for each number: its estimate, standard error, and the ends of a 95 % interval."""
        names: list[str] = []
        rows: list[tuple[float, float]] = []
        for name, value in self.values.items():
            errors = self.std_errors.get(name, np.full(np.shape(value), np.nan))
            own = [label for label in self.labels if label == name or label.startswith(f"{name}[")]
            for k, at in enumerate(np.ndindex(np.shape(value))):
                inside = f"{name}[{', '.join(map(str, at))}]" if at else name
                names.append(own[k] if len(own) == np.size(value) else inside)
                rows.append((float(value[at]), float(errors[at])))
        estimate, error = np.array(rows, dtype=float).reshape(-1, 2).T
        columns = {
            "estimate": estimate,
            "se": error,
            "2.5%": estimate - 1.959964 * error,
            "97.5%": estimate + 1.959964 * error,
        }
        return Summary(tuple(names), columns, self._title())

    def to_dataframe(self) -> Any:
        """``summary()`` as a pandas ``DataFrame``, a row for each number.

        Raises
        ------
        MissingExtraError
            Without pandas (the extra ``pandas``).
        """
        return self.summary().to_dataframe()

    def _repr_html_(self) -> str:
        """As notebooks show it."""
        return self.summary()._repr_html_()

    def _title(self) -> str:
        how = "converged" if self.converged else "NOT converged"
        told = f"log likelihood {self.log_likelihood:.4f}, {how} after {self.iterations} iterations"
        if len(self.climbs) > 1:
            told += f"; {agreeing(self.climbs)} of {len(self.climbs)} climbs ended there"
        if self.at_edge:
            more = " and others" if len(self.at_edge) > 6 else ""
            told += f"; at its edge: {', '.join(self.at_edge[:6])}{more}"
        return f"{self.method}: {told}"

    def __repr__(self) -> str:
        return f"Fit({', '.join(self.values)}; {self._title()})"
