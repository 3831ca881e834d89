"""What simulation-based calibration ranks: numbers of states and data, among them the densities of both.

All statistics of many states are evaluated together. How they are ranked is not known here.

References
----------
Modrák, Moon, Kim, Bürkner, Huurre, Faltejsková, Gelman and Vehtari (2023), Simulation-based calibration
checking for Bayesian computation: the choice of test quantities shapes sensitivity, Bayesian Analysis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import DensityError
from bayesmc.network.joint import node_log_prob
from bayesmc.testing.kernels.joint import NetJoint, Rows

#: elements of a node that are ranked by default, at most
_ELEMENTS = 32


class Quantities:
    """Statistics of states and data, all at once, and the log likelihood.

    Parameters
    ----------
    call : str
        Who asks, for messages.
    joint : NetJoint
    statistics : dict or None
        A user's own; None takes the elements of the hidden nodes and the log densities.

    Attributes
    ----------
    names : list of str
    """

    def __init__(
        self, call: str, joint: NetJoint, statistics: Mapping[str, Callable[..., Any]] | None
    ) -> None:
        self.call, self.joint = call, joint
        self.asked = None if statistics is None else joint.read(call, statistics)
        self.names = list(self._own()) if self.asked is None else list(self.asked)

    def __call__(self, state: Rows, data: Rows) -> tuple[np.ndarray, np.ndarray]:
        """Values, shape ``(rows, statistics)``, and log likelihoods, shape ``(rows,)``."""
        rows = len(next(iter(state.values())))
        complete = self.joint.complete(state, data)
        likelihood, log_joint = self._log_densities(complete)
        if self.asked is None:
            columns = [pick(complete, likelihood, log_joint) for pick in self._own().values()]
        else:
            columns = [function(state, data) for function in self.asked.values()]
        values = np.empty((rows, len(columns)))
        for s, column in enumerate(columns):
            values[:, s] = column
        undefined = np.isnan(values).any(axis=0)
        if undefined.any():
            name = self.names[int(undefined.argmax())]
            raise DensityError(
                f"{self.call}: statistic {name!r} is NaN for some draws; look for a sampler that leaves the "
                "support, or use a statistic that is defined everywhere"
            )
        return values, np.broadcast_to(likelihood, (rows,))

    def _own(self) -> dict[str, Callable[[Rows, Any, Any], Any]]:
        """The statistics that are taken by default."""
        own: dict[str, Callable[[Rows, Any, Any], Any]] = {}
        for name in self.joint.hidden:
            shape = self.joint.model[name].value_shape
            size = math.prod(shape)
            few = np.linspace(0, size - 1, min(size, _ELEMENTS)).round().astype(int)
            for flat in np.unique(few):
                at = tuple(int(i) for i in np.unravel_index(flat, shape))
                what = f"node {name!r}" + (f"[{', '.join(map(str, at))}]" if at else "")
                own[what] = partial(_element, name, at)
            if size > _ELEMENTS:
                own[f"mean of node {name!r}"] = partial(_mean, name)
        if self.joint.observed:
            own["log density of the data"] = lambda _, likelihood, _j: likelihood
        own["joint log density"] = lambda _, _l, log_joint: log_joint
        return own

    def _log_densities(self, complete: Rows) -> tuple[Any, Any]:
        """Of the data given the rest, and of everything."""
        model, observed = self.joint.model, self.joint.observed
        likelihood: Any = np.zeros(())
        total: Any = np.zeros(())
        with marking_invalid(), np.errstate(all="ignore"):
            for name in self.joint.stochastic:
                density = node_log_prob(model, name, complete[name], complete, total)
                total = total + density
                likelihood = likelihood + density if name in observed else likelihood
        return likelihood, total


# ---- private ------------------------------------------------------------------------------------


def _element(name: str, at: tuple[int, ...], values: Rows, *_: Any) -> np.ndarray:
    index: tuple[Any, ...] = (slice(None), *at)
    return values[name][index]


def _mean(name: str, values: Rows, *_: Any) -> np.ndarray:
    return values[name].reshape(len(values[name]), -1).mean(axis=1)
