"""What a series says of its model and of its slices together: ranks, innovations, residual checks, paths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.special import ndtri

from bayesmc.errors import QueryError, UnknownNodeError, UnsupportedError
from bayesmc.network import Model
from bayesmc.results.posterior import whole_draws
from bayesmc.results.predictive import Predictive
from bayesmc.results.residuals import check_residuals
from bayesmc.results.table import Summary


class SeriesChecks:
    """A mixin of ``SeriesPosterior``."""

    model: Model
    engine: Any
    kind: str
    predictive: Predictive | None = None
    #: how joint draws of all slices come about; pickles travel without
    paths: Callable[[Any, int, Any], dict[str, np.ndarray]] | None = None

    @property
    def row_ranks(self) -> np.ndarray | None:
        return None if self.predictive is None else self.predictive.row_ranks.copy()

    @property
    def row_deficits(self) -> np.ndarray | None:
        return None if self.predictive is None else self.predictive.row_deficits.copy()

    def predictive_ranks(self, name: str) -> np.ndarray:
        """Where an observed node's values lie among what was expected of them, given the rows before.

        The probability, before the row came, of a smaller value (the probability integral transform): uniform
        on (0, 1) where the model is right, heaped at both ends where its spread is too small, at one end
        where it is off to one side. Kalman filters know them; the others count among 19 draws, and
        break ties by chance, so that ranks of discrete nodes are uniform, too.

        Parameters
        ----------
        name : str

        Returns
        -------
        ndarray, shape (time, *plates, *event)
            NaN where it was not seen or not compared (``row_ranks``).

        Raises
        ------
        UnknownNodeError, QueryError
        UnsupportedError
            The engine does not compare rows with what it expected.

        References
        ----------
        Dawid (1984), Statistical theory: the prequential approach, JRSS A 147; Czado, Gneiting and Held
        (2009), Predictive model assessment for count data, Biometrics 65, for ties.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> dbn = bmc.DynamicBayesNet()
        >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
        >>> dbn.add("y", lambda x: bmc.Normal(x, 1.0))
        >>> filtered = bmc.filter(dbn, {"y": [0.0, 4.0, 4.5]}, engine=bmc.KalmanFilter())
        >>> filtered.predictive_ranks("y").round(3).tolist()
        [0.5, 0.994, 0.904]
        """
        if name not in self.model.nodes:
            raise UnknownNodeError(f"there is no node {name!r}; there are {list(self.model.nodes)}")
        if self.predictive is None:
            raise UnsupportedError(
                f"predictive_ranks({name!r}): this result (of {type(self.engine).__name__}) does not compare "
                "rows with what was expected of them; ask the result of filter or smooth by a filter (not by "
                "another engine), with five rows or more, of nodes that random draws can be taken of"
            )
        if name not in self.predictive.ranks:
            raise QueryError(
                f"predictive_ranks({name!r}): the node is not observed; ask of one that is"
            )
        return self.predictive.ranks[name].copy()

    def innovations(self, name: str) -> np.ndarray:
        """What an observed node was off, in standard normal scores of what was expected of it.

        The normal quantiles of ``predictive_ranks``: standard normal and independent from slice to slice
        where the model is right, whatever the density of the node. Kalman filters answer without ranks,
        exactly.

        Returns
        -------
        ndarray, shape (time, *plates, *event)
            NaN where it was not seen or not compared.

        Raises
        ------
        UnknownNodeError, QueryError
        UnsupportedError
            The engine does not compare rows with what it expected.

        References
        ----------
        Dunn and Smyth (1996), Randomized quantile residuals, Journal of Computational and Graphical
        Statistics 5.
        """
        ranks = self.predictive_ranks(name)
        return ndtri(np.clip(ranks, 1e-15, 1.0 - 1e-15))

    def residual_check(self, *names: str, lags: int = 10) -> Summary:
        """Whether innovations look like independent standard normal numbers, as a right model's do.

        Parameters
        ----------
        names : str
            Observed nodes; all that were compared where none is named.
        lags : int
            How many autocorrelations are judged together.

        Returns
        -------
        Summary
            A row for each number: ``count``, ``mean`` and ``sd`` of its innovations, and chances that a right
            model gives worse ones: ``p_mean``, ``p_sd`` (too small or too large), ``p_autocorrelation``
            (Ljung and Box) and ``p_normality`` (Jarque and Bera). Small ones say what is off. NaN where
            there are too few.

        Raises
        ------
        UnknownNodeError, QueryError, UnsupportedError

        References
        ----------
        Durbin and Koopman (2012), Time Series Analysis by State Space Methods, sec. 2.12.

        Examples
        --------
        >>> import numpy as np
        >>> import bayesmc as bmc
        >>> dbn = bmc.DynamicBayesNet()
        >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 0.1), initial=bmc.Normal(0.0, 1.0))
        >>> dbn.add("y", lambda x: bmc.Normal(x, 1.0))
        >>> rows = np.random.default_rng(0).normal(0.3, 1.0, 200)
        >>> check = bmc.filter(dbn, {"y": rows}).residual_check("y")
        >>> bool(check["y"]["p_autocorrelation"] > 0.01), int(check["y"]["count"])
        (True, 200)
        """
        chosen = names or tuple(self._compared())
        return check_residuals(self.model, {name: self.innovations(name) for name in chosen}, lags)

    def sample_paths(self, draws: int, rng: Any = None) -> dict[str, np.ndarray]:
        """Joint draws of whole trajectories given all rows.

        Answers are about each slice by itself; what hangs together over slices (a maximum, a first time, a
        difference) is asked of paths.

        Parameters
        ----------
        draws : int
        rng : seed, SeedSequence, Generator or None

        Returns
        -------
        dict of ndarray
            Node -> user values, shape ``(draws, time, *plates, *event)``, every node of a slice.

        Raises
        ------
        QueryError
            The answers are those of a filter, each slice given other rows.
        UnsupportedError
            The engine knows slices by themselves alone, or a pickle has lost the model.

        References
        ----------
        Chib (1996), Journal of Econometrics 75, for states; Carter and Kohn (1994), Biometrika 81, for
        numbers; Godsill, Doucet and West (2004), JASA 99, for particles.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> dbn = bmc.DynamicBayesNet()
        >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
        >>> dbn.add("y", lambda x: bmc.Normal(x, 1.0))
        >>> paths = bmc.smooth(dbn, {"y": [0.4, 1.0, 2.2]}).sample_paths(500, rng=0)
        >>> paths["x"].shape, float((paths["x"].max(axis=1) > 2.0).mean().round(1))
        ((500, 3), 0.4)
        """
        if self.kind not in ("smooth", "forecast"):
            raise QueryError(
                f"sample_paths: this is a {self.kind} result, in which each slice is given other "
                "rows; ask the "
                "result of smooth(dbn, observations)"
            )
        if self.paths is None:
            raise UnsupportedError(
                "sample_paths: pickles and forecasts from a belief carry no model to draw from; ask "
                "the result of "
                "smooth or forecast itself"
            )
        return self.paths(self, whole_draws(draws), rng)

    def _compared(self) -> Sequence[str]:
        """Observed nodes that were compared with what was expected of them."""
        if self.predictive is None:
            raise UnsupportedError(
                f"residual_check: this result (of {type(self.engine).__name__}) does not compare rows "
                "with what "
                "was expected of them; ask the result of filter or smooth by a filter"
            )
        return tuple(self.predictive.ranks)
