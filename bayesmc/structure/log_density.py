"""``bmc.log_density``: the log posterior of a net as a plain function of free numbers, for others' code.

The function is made of the model's expression graph (``unconstrained``); this room puts a question to it, and
speaks user values.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any, Never

import numpy as np

from bayesmc.distributions.parameters import by_keyword, refuse_positions
from bayesmc.errors import EvidenceError, ShapeError, TraceError, UnsupportedError
from bayesmc.lowering import Bound
from bayesmc.network import BayesNet, FactorGraph, Problem, pose
from bayesmc.network.evidence import store
from bayesmc.structure.compiled_density import in_machine_code
from bayesmc.structure.free_density import UnconstrainedDensity
from bayesmc.structure.target import target_of
from bayesmc.structure.unconstrained import unconstrained_density


class LogDensity:
    """A log density of unconstrained numbers, with its gradient; made by ``bmc.log_density``.

    Called with ``u`` of shape ``(*batch, size)`` it returns the log density, shape ``(*batch,)``, and the
    gradient, shape ``(*batch, size)``.

    Attributes
    ----------
    names : tuple of str
        Hidden continuous nodes, parents first.
    size : int
        How many free numbers they are.
    labels : list of str
        A name for each: ``"sd[2]"``.
    summed : tuple of str
        Hidden finite nodes that are summed out.
    """

    def __init__(
        self,
        net: BayesNet | FactorGraph,
        evidence: Mapping[str, Any] | None,
        inputs: Mapping[str, Any] | None,
        compiled: bool = False,
    ) -> None:
        problem = pose(net, evidence, inputs)
        self._question = problem.net, evidence, inputs, compiled
        self._problem: Problem = problem
        self._density: UnconstrainedDensity = _density_of(problem)
        self._bound: Bound | None = None
        if compiled:
            fast = in_machine_code(self._density, calls=sys.maxsize)
            try:
                self._density, self._bound = fast, fast.bound()
            except TraceError as error:
                raise UnsupportedError(f"log_density(compiled=True): {error}") from error

    @property
    def names(self) -> tuple[str, ...]:
        return self._density.names

    @property
    def size(self) -> int:
        return self._density.size

    @property
    def labels(self) -> list[str]:
        return list(self._density.labels)

    @property
    def summed(self) -> tuple[str, ...]:
        return self._density.summed

    @property
    def address(self) -> int | None:
        """Of the function in C; None where it is not compiled.

        ``int32_t f(int64_t points, const double *u, double *value, double *gradient, void **arguments)`` with
        ``arguments`` as its last argument, as long as this object lives, and for one thread at a time: others
        make their own. Where it returns something else than 0 its results must not be used; values and
        derivatives that are no numbers are left as they are.
        """
        return None if self._bound is None else self._bound.address

    @property
    def arguments(self) -> int | None:
        """The address of what the function at ``address`` reads besides."""
        return None if self._bound is None else self._bound.arguments

    def __call__(self, u: Any) -> tuple[np.ndarray, np.ndarray]:
        """The log density at ``u``, minus infinity where it is zero, and its gradient, 0 there."""
        return self._density.with_gradient(self._checked(u))

    def value(self, u: Any) -> np.ndarray:
        """The log density at ``u``, shape ``(*batch,)``."""
        return self._density.value(self._checked(u))

    def gradient(self, u: Any) -> np.ndarray:
        """The gradient at ``u``, shape ``(*batch, size)``."""
        return self(u)[1]

    def constrain(self, u: Any) -> dict[str, np.ndarray]:
        """Node -> values at ``u``, shape ``(*batch, *plates, *event)``; what was seen stands in its place."""
        return self._density.constrain(self._checked(u))

    def unconstrain(self, values: Mapping[str, Any]) -> np.ndarray:
        """The free numbers behind values of all nodes in ``names``, shape ``(*batch, size)``.

        Raises
        ------
        EvidenceError
            A value is missing, does not fit its node, or is not inside of its support.
        """
        model, stored = self._problem.model, {}
        for name in self.names:
            if name not in values:
                raise EvidenceError(f"log_density: unconstrain wants a value of node {name!r}")
            stored[name] = store(model[name], np.asarray(values[name], float))
        with np.errstate(all="ignore"):
            found = self._density.unconstrain(stored)
        for k, label in enumerate(self.labels):
            if not np.isfinite(found[..., k]).all():
                raise EvidenceError(
                    "log_density: unconstrain wants values inside of their support, and that of "
                    f"{label!r} is outside, or at its edge"
                )
        return found

    def __reduce__(self) -> Any:
        net, *known = self._question
        return log_density_again, (net.copy(), *known)  # a copy has nothing compiled

    def __repr__(self) -> str:
        shown = ", ".join(self.labels[:6]) + (", ..." if self.size > 6 else "")
        return f"<log density of {self.size} unconstrained numbers: {shown}>"

    # ---- private -------------------------------------------------------------------------------

    def _checked(self, u: Any) -> np.ndarray:
        array = np.asarray(u, float)
        if array.shape[-1:] != (self.size,):
            raise ShapeError(
                f"log_density: u has shape {array.shape}, not (..., {self.size}): one number for each of "
                f"{', '.join(self.labels[:6])}{', ...' if self.size > 6 else ''}"
            )
        return array


@by_keyword
def log_density(
    net: BayesNet | FactorGraph,
    evidence: Mapping[str, Any] | None = None,
    *beyond: Never,
    inputs: Mapping[str, Any] | None = None,
    compiled: bool = False,
) -> LogDensity:
    """The log posterior density on unconstrained numbers, up to a constant, with its gradient.

    What ``blackjax``, ``nutpie`` or ``scipy.optimize`` take: hidden continuous nodes become free numbers
    (logarithms of positive ones, log odds of shares, stick breaking of simplices, log-Cholesky factors of
    covariances, partial correlations, steps of numbers in order), with the change of volume in the density.
    Hidden finite nodes are summed out: labels of a plate element by element, others by their joint states, at
    most 512. Of continuous nodes those count, too, on which nothing observed depends, but not elements of
    data that are missing and that nothing hangs on.

    Parameters
    ----------
    net : BayesNet or FactorGraph
    evidence : mapping, optional
        As of ``bmc.infer``.
    inputs : mapping, optional
    compiled : bool
        Machine code, with an ``address`` for callers in C; needs the extra ``fast``.

    Returns
    -------
    LogDensity
        ``f(u) -> (value, gradient)`` with ``f.value``, ``f.gradient``, ``f.names``, ``f.size``, ``f.labels``,
        ``f.constrain``, ``f.unconstrain``. It travels by cloudpickle.

    Raises
    ------
    UnsupportedError
        A function cannot be followed or has no derivative, a hidden node is discrete without finite states,
        or finite nodes have too many joint states; the message names it and the remedy. With ``compiled``,
        there is no compiler, or something has no machine code.

    References
    ----------
    Stan Reference Manual, version 2.36, chapter "Constraint Transforms".

    Examples
    --------
    The posterior mode of a rate, on the log scale, by SciPy:

    >>> import numpy as np
    >>> from scipy.optimize import minimize
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet("counts", plates={"day": 3})
    >>> net.add("rate", bmc.Gamma(2.0, 1.0))
    >>> net.add("count", lambda rate: bmc.Poisson(rate), plates="day")
    >>> f = bmc.log_density(net, {"count": [3, 1, 4]})
    >>> found = minimize(lambda u: [-part for part in f(u)], np.zeros(f.size), jac=True)
    >>> f.labels, round(float(f.constrain(found.x)["rate"]), 3)
    (['rate'], 2.5)
    """
    if beyond:
        refuse_positions(log_density, beyond)
    return LogDensity(net, evidence, inputs, compiled)


def log_density_again(net: Any, evidence: Any, inputs: Any, compiled: bool) -> LogDensity:
    """A log density that was sent, made anew where it arrives."""
    return LogDensity(net, evidence, inputs, compiled)


# ---- private ------------------------------------------------------------------------------------


def _density_of(problem: Problem) -> UnconstrainedDensity:
    model = problem.model

    def is_free(name: str) -> bool:
        node = model[name]
        return node.kind == "stochastic" and not node.is_discrete and node.domain is None

    hidden = [n for n in model.nodes if is_free(n) and n not in problem.observed]
    target = target_of(problem, hidden)
    finite = [n for n in target.chain if not is_free(n)]
    try:
        return unconstrained_density(target, None, finite)
    except UnsupportedError as error:
        raise UnsupportedError(f"log_density: {error}") from error
