"""What every posterior says of a node's numbers one by one, over time or not: a mixin over ``laws``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bayesmc.errors import QueryError, UnsupportedError
from bayesmc.network import Model
from bayesmc.results.laws import Laws, TableLaws, entropy_of, interval_probability
from bayesmc.results.over_time import take_templates
from bayesmc.results.pictures import Pictures


@take_templates
class MarginalAnswers:
    """Medians, intervals, modes, cdfs and entropies; a subclass says what it knows in ``_laws``."""

    model: Model

    @property
    def plot(self) -> Pictures:
        """Pictures of this answer, as ``posterior.plot.forest()``; see ``bayesmc.plotting``."""
        return Pictures(self)

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Posterior quantiles of every number."""
        raise NotImplementedError

    #: probabilities of the states of finite nodes
    probabilities: Callable[..., np.ndarray]

    def _laws(self, name: str) -> Laws:
        """What is known of each number of a node."""
        raise NotImplementedError

    def median(self, name: str) -> np.ndarray:
        """Posterior medians, of the node's shape (time first, where there is time).

        Raises
        ------
        UnsupportedError
            Labels have no order.
        """
        return self.quantile(name, 0.5)

    def hdi(self, name: str, prob: float = 0.89) -> np.ndarray:
        """The narrowest interval that holds each number with probability ``prob``.

        Of draws it is ArviZ's; of finite nodes and weighted draws it holds at least ``prob``. It is one
        interval where a distribution has several hills, too.

        Parameters
        ----------
        name : str
        prob : float
            Between 0 and 1.

        Returns
        -------
        ndarray, shape (*plates, *event, 2)
            Lower and upper ends; time first, where there is time.

        Raises
        ------
        UnknownNodeError, QueryError
        UnsupportedError
            Labels have no order, or the posterior keeps too little.

        References
        ----------
        Hyndman (1996), Computing and graphing highest density regions, American Statistician 50.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet()
        >>> net.add("x", bmc.Normal(1.0, 2.0))
        >>> bmc.infer(net).hdi("x", 0.95).round(2).tolist()
        [-2.92, 4.92]
        """
        level = interval_probability(name, prob)
        return self._laws(name).hdi(level)

    def mode(self, name: str) -> np.ndarray:
        """Where the marginal of each number is highest: user values, labels where states have some.

        Exact where densities are known. Of draws of continuous nodes it is the top of a kernel density, and
        errs by some tenths of a standard deviation. The most likely values together are another question:
        ``bayesmc.map``, ``bayesmc.most_likely``.

        Raises
        ------
        UnknownNodeError, UnsupportedError
        """
        laws = self._laws(name)
        found = laws.mode()
        domain = self.model[name].domain
        if isinstance(laws, TableLaws) and domain is not None:
            return domain.decode(found.astype(domain.dtype))
        return found

    def cdf(self, name: str, points: Any) -> np.ndarray:
        """Probabilities that each number is at or below some points.

        Parameters
        ----------
        name : str
        points : array_like
            Each is held against every number of the node.

        Returns
        -------
        ndarray, shape (*points.shape, *plates, *event)
            Over time ``(time, *points.shape, *plates, *event)``, as quantiles are.

        Raises
        ------
        UnknownNodeError, QueryError, UnsupportedError

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet()
        >>> net.add("die", bmc.DiscreteUniform(1, 6))
        >>> bmc.infer(net).cdf("die", [0.5, 2.0, 6.0]).round(3).tolist()
        [0.0, 0.333, 1.0]
        """
        try:
            at = np.asarray(points, dtype=float)
        except (TypeError, ValueError):
            raise QueryError(
                f"cdf({name!r}, {points!r}): points are numbers; give one or an array of them"
            ) from None
        laws = self._laws(name)
        lead = self._lead()
        shape = self._answer_shape(name)
        trailing = len(shape) - lead
        found = laws.cdf(at.reshape(at.shape + (1,) * len(shape)))
        found = np.broadcast_to(found, at.shape + shape)
        if lead:
            found = np.moveaxis(found, at.ndim, 0)
        assert found.ndim == lead + at.ndim + trailing
        return np.array(found)

    def entropy(self, *names: str) -> np.ndarray:
        """Entropies in nats.

        Of one node: of each number's marginal, differential where it is continuous (minus infinity of what is
        known). Of several finite nodes: of their joint distribution, element by element of their plates.
        Exact where the marginals are; of draws estimated from spacings, to some hundredths of a nat.

        Parameters
        ----------
        names : str

        Returns
        -------
        ndarray, shape (*plates, *event)
            Time first, where there is time.

        Raises
        ------
        UnknownNodeError, QueryError, UnsupportedError

        References
        ----------
        Cover and Thomas (2006), Elements of Information Theory, eqs. 2.1 and 8.1; Vasicek (1976), A test for
        normality based on sample entropy, JRSS B 38, and Ebrahimi, Pflughoeft and Soofi (1994), Statistics
        and Probability Letters 20, for draws.

        Examples
        --------
        >>> import bayesmc as bmc
        >>> net = bmc.BayesNet()
        >>> net.add("rain", bmc.Bernoulli(0.5), states=("no", "yes"))
        >>> float(bmc.infer(net).entropy("rain").round(4))
        0.6931
        """
        if not names:
            raise QueryError("entropy(): name at least one node")
        if len(names) == 1:
            return self._laws(names[0]).entropy()
        if self._lead():
            raise UnsupportedError(
                f"entropy{names}: over time it is one node's at a time; of several nodes together ask "
                "a plain "
                "posterior, infer(dbn, observations)"
            )
        table = self.probabilities(*names)
        lead = table.ndim - len(names)
        return entropy_of(table.reshape((*table.shape[:lead], -1)))

    def _lead(self) -> int:
        """Axes that stand before those of a node's value: 1 where there is time."""
        return 0

    def _answer_shape(self, name: str) -> tuple[int, ...]:
        """The shape of what is answered about a node."""
        return self.model[name].value_shape
