"""``ExpectationPropagation`` and ``AssumedDensity``: the options, on nets and over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from bayesmc.dbn import DynamicBayesNet
from bayesmc.engines.propagation.static import MessageEngine, check_families
from bayesmc.engines.propagation.sweeps import Settled, pass_once, settle
from bayesmc.engines.propagation.system import System
from bayesmc.engines.switching.propagation import SeriesPropagation
from bayesmc.network import Problem
from bayesmc.progress import Progress


@dataclass(frozen=True)
class ExpectationPropagation(MessageEngine, SeriesPropagation):
    """Messages in exponential families, passed until they agree: a fast first answer, on nets and over time.

    **On nets** (``infer``) hidden numbers that hang together get one joint Gaussian (those with bounds on the
    line that they are mapped to), finite nodes a table each. What is linear-Gaussian is entered exactly.
    Every other factor is approximated by a Gaussian of the few affine combinations through which it reads the
    numbers, its own directions, and a table for each of its finite nodes: taken out of the belief, the factor
    itself multiplied in, and the result replaced by the member of the family with the same moments. These
    come from closed forms (tables, mixtures of Gaussians, probit), else from quadrature along the direction,
    with breaks where the factor jumps or bends (comparisons, truncations), or in up to three dimensions;
    beyond, by importance sampling. ``explain`` says which. On trees of finite nodes it is belief propagation,
    and exact; on loopy ones it is loopy belief propagation.

    **Over time** (``smooth``, ``filter``, ``forecast``) it takes the templates that ``SwitchingKalmanFilter``
    takes: finite modes, and numbers that are linear-Gaussian given them. Every slice has a belief with one
    Gaussian for each mode, the product of a message from the rows up to it and one from later rows.

    Answers are approximate, the log marginal likelihood included, and nobody knows by how much;
    ``posterior.check()`` tells. Known to fail: posteriors of several hills, of which it takes one or the
    mean, and dependence between finite nodes and numbers, which its answer does not hold. Messages need not
    settle: then there is a ``ConvergenceWarning`` that says by how much beliefs still change.

    Gamma, Beta and Dirichlet nodes with known parameters keep their family where every density that reads
    them is linear in its statistics (counts, labels, waiting times); other numbers between bounds are normal
    scores, whose prior is exact, or mapped to the line.

    Parameters
    ----------
    sweeps : int
        Passes back and forth, at most.
    damping : float, optional
        Share of the old message that is kept, 0 or more and less than 1: slower, and steadier. By default it
        is .2, and grows by itself where messages do not come closer; on nets that is so of a number, too, and
        tables of finite nodes alone are not damped before.
    tolerance : float
        Change of a sweep with which messages have settled; see ``PropagatedPosterior.change``.
    families : dict, optional
        On nets: node -> ``"normal"``, for nodes that are to be mapped to the line instead of keeping their
        own family (Gamma, Beta, Dirichlet).
    linearize : bool
        Over time: makes functions that are not affine linear at each mode's mean on the first pass forward.
    max_modes : int
        Over time: modes above which it refuses.

    Notes
    -----
    On nets all factors of a plate are made anew from the same belief in one array operation, and move it
    together (parallel updates); nodes follow each other, forth and back. Where messages swing, steps get
    shorter and rows are visited in parts, in turn; where the damping is all that slows them it is left out.
    Where a move would leave a belief without an integral it is shortened. Quotients of Gaussians may have no
    finite integral: a factor whose product with its cavity has none is left out, and counted in ``skipped``;
    as long as some are, nothing has settled. Beliefs that narrow without end beside them are refused by name.

    Over time a slice and the one before, with both messages that come from outside, are a mixture over pairs
    of modes; it is collapsed to the belief of the same means and covariances in each mode, and what came from
    outside is divided out again. A message with which a neighbouring slice would have no integral is taken
    back part of the way, and counted. The first pass forward is assumed-density filtering, the same as
    ``SwitchingKalmanFilter("gpb2")``; ``filter`` and ``forecast`` answer what it says. ``smooth`` takes all
    rows; of fixed lags ask ``SwitchingKalmanFilter``. Numbers of a slice that later rows tell without noise
    would make messages infinite, and are refused as they are met.

    References
    ----------
    Minka (2001), A family of algorithms for approximate Bayesian inference, PhD thesis, MIT; Minka (2004),
    Power EP (evidence); Heskes and Zoeter (2002), Expectation propagation for approximate inference in
    dynamic Bayesian networks, UAI 18; Zoeter and Heskes (2005), Change point problems in linear dynamical
    systems, JMLR 6; Herbrich, Minka and Graepel (2006), TrueSkill, NIPS 19.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet("one game")
    >>> for player in ("ann", "bob"):
    ...     net.add(player, bmc.Normal(25.0, 25 / 3))
    >>> net.add("won", lambda ann, bob: bmc.Bernoulli(ann > bob))
    >>> posterior = bmc.infer(net, {"won": 1}, engine=bmc.ExpectationPropagation())
    >>> posterior.converged, posterior.mean("ann").round(3).tolist(), posterior.mean("bob").round(3).tolist()
    (True, 29.702, 20.298)

    >>> dbn = bmc.DynamicBayesNet("level that jumps")
    >>> dbn.table("s", ["s_prev"], [[0.95, 0.05], [0.5, 0.5]], ("still", "jump"), initial=[0.9, 0.1])
    >>> dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev, np.where(s == "jump", 5.0, 0.1)),
    ...         initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    >>> rows = {"y": [0.1, -0.2, 0.1, 6.2, 5.9]}
    >>> smoothed = bmc.smooth(dbn, rows, engine=bmc.ExpectationPropagation())
    >>> smoothed.converged, smoothed.probabilities("s")[:, 1].round(2).tolist()
    (True, [0.06, 0.02, 0.07, 1.0, 0.13])
    """

    families: Mapping[str, str] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_families(self)

    def unsupported(
        self,
        net: Any,
        evidence: Mapping[str, Any] | None = None,
        inputs: Mapping[str, Any] | None = None,
    ) -> str | None:
        """Why this engine cannot answer, or None."""
        from_time = isinstance(net, DynamicBayesNet)
        base: Any = SeriesPropagation if from_time else MessageEngine
        return base.unsupported(self, net, evidence, inputs)

    def refusal(self, problem: Any) -> str | None:
        return self._base(problem).refusal(self, problem)

    def describe(self, problem: Any) -> dict[str, str]:
        return self._base(problem).describe(self, problem)

    def effort(self, problem: Any) -> str:
        return self._base(problem).effort(self, problem)

    def passed(self, system: System, progress: bool | None) -> Settled:
        with Progress(int(self.sweeps), self.label, progress) as bar:
            return settle(
                system, sweeps=int(self.sweeps), damping=_DAMPING if self.damping is None else self.damping,
                tolerance=float(self.tolerance), advance=partial(bar.advance, 1),
            )  # fmt: skip

    def doubt(self, end: Settled) -> str | None:
        if end.converged:
            return None
        out = (
            f", and left out {end.open} improper messages ({end.skipped} in all)"
            if end.open
            else ""
        )
        if end.silent:
            return f"ExpectationPropagation: {_unsaid(end)}; take HamiltonianMonteCarlo or Gibbs"
        if end.open and end.change <= float(
            self.tolerance
        ):  # more of the same would change nothing
            return (
                f"ExpectationPropagation: beliefs rest after {end.sweeps} sweeps, but {end.open} factors "
                "have no integral with what the others say, and their messages were left as they were: the "
                "answer is none of all factors, and the posterior may have no integral (a scale whose "
                "readings are all equal); take Gibbs, or a prior that keeps scales from 0"
            )
        return (
            f"ExpectationPropagation: messages have not settled after {end.sweeps} sweeps: the last one "
            f"changed a belief by {end.change:.2g} (tolerance {float(self.tolerance):.2g}){out}. Give more "
            f"damping than {1.0 - end.share:.2g} or more sweeps, or take Gibbs"
        )

    # ---- private -------------------------------------------------------------------------------

    @staticmethod
    def _base(problem: Any) -> Any:
        return MessageEngine if isinstance(problem, Problem) else SeriesPropagation


@dataclass(frozen=True)
class AssumedDensity(MessageEngine):
    """One pass of expectation propagation: every factor once, in the order of declaration.

    Each factor is multiplied into the belief so far, which is then replaced by the member of its family with
    the same moments, and never seen again. So the answer depends on the order of declaration (of a plate,
    that of its elements), and is mostly further off than that of ``ExpectationPropagation``, which goes on
    until messages agree. What is linear-Gaussian is entered exactly, at once. Its answers are approximate,
    and ``posterior.check()`` tells by how much. Of a node whose factors are taken in before anything observed
    has told of the nodes below (the weights of a mixture with unknown components) one pass learns nothing,
    and a ``ConvergenceWarning`` names it.

    Parameters
    ----------
    families : dict, optional
        As of ``ExpectationPropagation``.

    References
    ----------
    Maybeck (1982), Stochastic Models, Estimation and Control, vol. 2, ch. 12.7; Minka (2001), A family of
    algorithms for approximate Bayesian inference, ch. 3.1.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from scipy import special
    >>> net = bmc.BayesNet("probit", plates={"row": 3})
    >>> net.add("w", bmc.Normal(0.0, 1.0))
    >>> net.add("y", lambda w: bmc.Bernoulli(special.ndtr(2.0 * w)), plates="row")
    >>> bmc.infer(net, {"y": [1, 1, 0]}, engine=bmc.AssumedDensity()).mean("w").round(3).tolist()
    0.155
    """

    families: Mapping[str, str] | None = None

    def __post_init__(self) -> None:
        check_families(self)

    def passed(self, system: System, progress: bool | None) -> Settled:
        return pass_once(system)

    def doubt(self, end: Settled) -> str | None:
        if end.untold:
            return (
                f"AssumedDensity: nothing was said of {', '.join(map(repr, end.untold[:6]))}: factors that "
                "read them come, in the order of declaration, before those that observations enter, and are "
                "not seen again, so that the answers are those of the prior there; take "
                "ExpectationPropagation"
            )
        if not end.open:
            return None
        if end.silent:
            return f"AssumedDensity: {_unsaid(end)}; take ExpectationPropagation or Gibbs"
        return (
            f"AssumedDensity: {end.open} factors have no integral with the belief so far and were left out; "
            "take ExpectationPropagation or Gibbs"
        )


# ---- private ------------------------------------------------------------------------------------

#: that messages on nets begin with
_DAMPING = 0.2


def _unsaid(end: Settled) -> str:
    parts = [f"{n} factors of node {name!r}" for name, n in end.silent.items()]
    return f"no message could be made for {', '.join(parts)}; answers are those of the prior there"
