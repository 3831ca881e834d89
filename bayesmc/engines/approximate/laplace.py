"""Laplace's method: a Gaussian at the mode, with the curvature there."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from bayesmc.distributions.transforms import Bounded, Identity, Wrapped
from bayesmc.engines.approximate.evidence import log_constants, why_not
from bayesmc.engines.approximate.free_gaussian import FreeGaussian
from bayesmc.engines.approximate.modes import Mode, NoMode, modes_of
from bayesmc.engines.approximate.posterior import DRAWS, ApproximatePosterior
from bayesmc.engines.approximate.question import (
    free_density,
    linear_below,
    refuse_jumps,
    start_points,
)
from bayesmc.engines.base import Engine
from bayesmc.engines.weighted.drawing import check_count
from bayesmc.errors import ConvergenceWarning, UnsupportedError
from bayesmc.network import Problem
from bayesmc.results import Posterior
from bayesmc.structure.free_density import UnconstrainedDensity
from bayesmc.structure.free_nodes import FreeNode

#: modes that a warning shows
_SHOWN = 4


class LaplacePosterior(ApproximatePosterior):
    """Answers of Laplace's method: of a Gaussian in unconstrained numbers, carried back by their maps.

    Attributes
    ----------
    modes : tuple of dict
        Of every mode that was found: ``values`` there by node, ``log_density`` in unconstrained numbers,
        ``log_evidence`` of a Gaussian there, and how many ``starts`` led to it. The first is the one that
        answers.
    """

    modes: tuple[dict[str, Any], ...] = ()


@dataclass(frozen=True)
class LaplaceApproximation(Engine):
    """A Gaussian at the mode of the log posterior, in unconstrained numbers.

    The continuous nodes become free numbers (logs of positive ones, log odds of shares, ...), the change of
    volume counts, and the posterior is taken for the Gaussian that has its mode and the curvature there, from
    second derivatives of the densities. It is exact where nodes are Normal and linear in one another, near
    where data are many, and wrong where the posterior is skewed, heavy-tailed, curved or has several modes:
    hierarchies whose scale is poorly known, above all. ``posterior.check()`` tells.

    ``engine=bmc.Laplace()`` asks for it, too: the standard distribution of that name cannot be an engine.

    Parameters
    ----------
    starts : int
        Climbs, from draws of the prior weighed by what was seen; the mode with the largest evidence answers,
        and where there are others a warning says so. They do not depend on ``rng``.
    draws : int
        Draws that answer what has no closed form: functions of nodes, simplices and covariance matrices,
        nodes that are computed in a way that bends, or on which nothing observed depends.

    Notes
    -----
    Finite hidden nodes are summed out (labels of a plate element by element, others by their joint states,
    512 at most); their states are drawn given the numbers. Nodes on which nothing observed depends are drawn
    from the net. Means, variances and quantiles of single numbers are exact for the Gaussian (in closed form,
    or by quadrature along a line), and so are covariances of unbounded nodes; ``mcse`` is the error of draws,
    0 where there are none, and says nothing of the bias.

    ``log_marginal_likelihood`` is Laplace's approximation, too: that of the Gaussian's integral.

    Raises
    ------
    UnsupportedError
        A density cannot be followed or has no gradient, or jumps within reach of the mode or of draws of the
        prior, a hidden node is discrete without finite states, no climb found a mode: what stands in the way
        is named, such as a ridge with its directions.

    Warns
    -----
    ConvergenceWarning
        Several modes were found (with the log evidence of each), or some climbs did not settle.

    References
    ----------
    Laplace (1774), Mémoire sur la probabilité des causes par les évènements; Tierney and Kadane (1986), JASA
    81, eq. 2.2; MacKay (2003), Information Theory, Inference, and Learning Algorithms, ch. 27.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> dose = np.array([-0.86, -0.3, -0.05, 0.73])
    >>> net = bmc.BayesNet(plates={"group": 4})
    >>> net.add("a", bmc.Normal(0.0, 2.0))
    >>> net.add("b", bmc.Normal(0.0, 10.0))
    >>> net.add("dead", lambda a, b: bmc.Binomial(5, logits=a + b * dose), plates="group")
    >>> posterior = bmc.infer(net, {"dead": [0, 1, 3, 5]}, engine=bmc.LaplaceApproximation())
    >>> posterior.mean("b").round(2), posterior.std("b").round(2)
    (np.float64(6.24), np.float64(3.35))
    """

    starts: int = 8
    draws: int = DRAWS

    label: ClassVar[str] = "Laplace's method"

    def __post_init__(self) -> None:
        check_count(self, "starts", self.starts, "8")
        check_count(self, "draws", self.draws, "4000")

    def refusal(self, problem: Problem) -> str | None:
        return why_not(problem, type(self).__name__, lambda: self._density(problem).target)

    def describe(self, problem: Problem) -> dict[str, str]:
        density = self._density(problem)
        free = {node.name: node for node in density.nodes}
        found = {}
        for name, node in problem.model.nodes.items():
            seen = problem.observed.get(name)
            if node.kind in ("input", "fixed"):
                found[name] = "given"
            elif name in free:
                found[name] = _described(free[name])
            elif name in density.summed:
                found[name] = "summed out; its states are drawn given the numbers"
            elif not node.is_stochastic:
                found[name] = "computed from its parents"
            elif seen is not None and seen.mask is None:
                found[name] = "observed"
            else:
                found[name] = (
                    "nothing observed depends on it: drawn from the net, without approximation"
                )
        return found

    def effort(self, problem: Problem) -> str:
        size = self._density(problem).size
        return (
            f"on {size} unconstrained numbers: a Gaussian at their mode, for the evidence, too; exact where "
            "nodes are Normal and linear in one another, wrong where the posterior is skewed, heavy-tailed "
            "or has several modes (posterior.check() tells how far)"
        )

    def run(
        self,
        problem: Problem,
        seed: np.random.SeedSequence,
        keep: Any = "draws",
        progress: bool | None = None,
        resume: Posterior | None = None,
    ) -> Posterior:
        if resume is not None:
            raise UnsupportedError(
                "infer: resume= continues draws of chains, and this engine has none"
            )
        density = self._density(problem)
        found, lost = modes_of(density, start_points(density, self.starts))
        if not found:
            raise UnsupportedError(_without_mode(density, lost))
        found = sorted(found, key=lambda mode: -mode.log_volume)
        refuse_jumps(density, found[0], type(self).__name__, edges=True)
        constant = log_constants(density.target)
        _warn(density, found, lost, constant)
        best = found[0]
        posterior = LaplacePosterior(
            problem,
            self,
            FreeGaussian(density, best.u, best.root),
            seed,
            best.log_volume + constant,
            self.draws,
        )
        posterior.modes = tuple(_shown(density, mode, constant) for mode in found)
        return posterior

    def _density(self, problem: Problem) -> UnconstrainedDensity:
        kept = problem.cache.setdefault("nodes that follow linearly", {})
        if "names" not in kept:
            kept["names"] = linear_below(problem)
        return free_density(problem, kept["names"], type(self).__name__)


# ---- private ------------------------------------------------------------------------------------


def _described(node: FreeNode) -> str:
    kind = node.transform
    if isinstance(kind, Identity):
        return "Gaussian; moments and quantiles in closed form"
    if isinstance(kind, Wrapped):
        return "Gaussian angle, wrapped"
    if isinstance(kind, Bounded) and not node.node.event_shape:
        return "Gaussian in its free number; moments by quadrature, quantiles through its map"
    return "Gaussian in its free numbers; answered by draws of it"


def _shown(density: UnconstrainedDensity, mode: Mode, constant: float) -> dict[str, Any]:
    model = density.target.model
    values = density.constrain(mode.u)
    return {
        "values": {n: np.asarray(model[n].decode(v)) for n, v in values.items()},
        "log_density": mode.log_density + constant,
        "log_evidence": mode.log_volume + constant,
        "starts": mode.starts,
    }


def _without_mode(density: UnconstrainedDensity, lost: Sequence[NoMode]) -> str:
    best = max(lost, key=lambda end: end.log_density)
    return (
        f"LaplaceApproximation: {best.reason} (the same of {len(lost)} climbs, or worse); use "
        "HamiltonianMonteCarlo() or Gibbs()"
    )


def _warn(
    density: UnconstrainedDensity, found: Sequence[Mode], lost: Sequence[NoMode], constant: float
) -> None:
    name = "LaplaceApproximation"
    higher = [end for end in lost if end.log_density > found[0].log_density + 1e-6]
    if higher:
        warnings.warn(
            f"{name}: {len(higher)} of {sum(m.starts for m in found) + len(lost)} climbs went higher than "
            f"the mode that answers, and found none: {higher[0].reason}",
            ConvergenceWarning,
            stacklevel=4,
        )
    if len(found) == 1:
        return
    logs = np.array([mode.log_volume for mode in found])
    shares = np.exp(logs - np.logaddexp.reduce(logs))
    words = []
    for mode, share in zip(found[:_SHOWN], shares, strict=False):
        away = np.abs(mode.u - found[0].u) if mode is not found[0] else np.abs(mode.u - found[1].u)
        k = int(np.argmax(away * np.abs(found[0].root).max(axis=1)))
        words.append(
            f"{mode.log_volume + constant:.4g} ({density.labels[k]} free at {mode.u[k]:.3g}, share "
            f"{share:.2g}, {mode.starts} starts)"
        )
    more = f", and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
    warnings.warn(
        f"{name}: {len(found)} modes were found, and the answers describe the first alone; log evidence of "
        f"each: {'; '.join(words)}{more}. Modes may be the same up to the names of components; where they "
        "are not, ask an engine that visits them all (HamiltonianMonteCarlo(), Gibbs())",
        ConvergenceWarning,
        stacklevel=4,
    )
