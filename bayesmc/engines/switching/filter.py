"""``SwitchingKalmanFilter``: its options, and Kim's smoother."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

import numpy as np

from bayesmc.dbn import SeriesProblem
from bayesmc.engines.filtering import Asked, Queries, quiet
from bayesmc.engines.switching.engine import SwitchingEngine
from bayesmc.engines.switching.posterior import SwitchingSeries
from bayesmc.engines.switching.smoothing import warn_where_lost
from bayesmc.progress import Progress

_RULES = ("gpb1", "imm", "gpb2")


@dataclass(frozen=True)
class SwitchingKalmanFilter(SwitchingEngine):
    """Approximate beliefs about switching systems: linear-Gaussian given finite nodes that are hidden, too.

    The hidden finite nodes of a slice make its *mode*, each joint state of theirs that is possible one.
    Modes depend on modes of the slice before and of the same one, on inputs and on what is observed
    throughout, never on hidden numbers. Given the modes of both slices everything else that is hidden, and
    what is observed of it, is Normal or MvNormal with affine means, as ``KalmanFilter`` has it.

    The exact belief is a mixture with one Gaussian for every history of modes. Here every mode has one
    Gaussian, of the same mean and covariance as what it stands for, so everything it says is approximate, the
    log marginal likelihood included, and nobody knows by how much: hold it against ``ParticleFilter``, or
    against ``infer(dbn, first_rows, engine=Exact())`` of a short series. It is exact where modes make no
    difference and for one slice. ``ExpectationPropagation`` starts where it ends, and is mostly nearer.

    Parameters
    ----------
    merging : {"gpb2", "imm", "gpb1"}
        When Gaussians are merged. ``"gpb2"``: those of all modes are taken through all modes of the next
        slice, and those that meet in a mode are merged (the square of the modes in Kalman filters a slice).
        ``"imm"``, the interacting multiple model: merged before, for every mode of the next slice with the
        weights that it gives them (as many as there are modes, unless numbers depend on the mode before,
        too). ``"gpb1"``: one Gaussian, merged over all modes, is taken on.
    linearize : bool
        Makes functions that are not affine linear at each mode's mean by their derivatives, as
        ``ExtendedKalmanFilter`` does; otherwise templates with such are refused. Readings that are angles
        (``WrappedNormal``, ``VonMises``) have wrapped residuals; hidden angles are refused, and angles
        that are missing in some row.
    max_modes : int
        Modes above which it refuses.

    Notes
    -----
    ``smooth`` is Kim's smoother, on the filter's Gaussians whatever rule made them. It stands on two further
    approximations: given the mode of the next slice, later rows tell no more of this one's; and p(x[t+1] |
    s[t], s[t+1], all rows) is p(x[t+1] | s[t+1], all rows), numbers given two modes as given the later one
    alone. The second fails where rows are missing that would tell which modes went with which numbers: before
    and within a gap smoothed deviations come out too wide, and it warns (EngineWarning) where they are more
    than 1.5 times the filtered ones. From the last row with data on they are the filtered ones.

    Gaussians are carried as triangular roots of their covariances, and merged as such; no covariance is
    subtracted or inverted. All pairs of modes are one array operation, with ``linearize`` one after the
    other. Plates whose elements never meet have a mode for each element. Finite nodes that nothing reads are
    averaged over where they are missing, and so are other families that depend on modes alone.

    References
    ----------
    Kim (1994), Dynamic linear models with Markov-switching, J. Econometrics 60; Blom and Bar-Shalom (1988),
    The interacting multiple model algorithm, IEEE Trans. Automatic Control 33; Bar-Shalom, Li and Kirubarajan
    (2001), Estimation with Applications to Tracking and Navigation, sec. 11.6; Murphy (1998), Switching
    Kalman filters.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc import SwitchingKalmanFilter
    >>> dbn = bmc.DynamicBayesNet("level that jumps")
    >>> dbn.table("s", ["s_prev"], [[0.95, 0.05], [0.5, 0.5]], ("still", "jump"), initial=[0.9, 0.1])
    >>> dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev, np.where(s == "jump", 5.0, 0.1)),
    ...         initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    >>> rows = {"y": [0.1, -0.2, 0.1, 6.2, 5.9]}
    >>> smoothed = bmc.smooth(dbn, rows, engine=SwitchingKalmanFilter())
    >>> smoothed.probabilities("s")[:, 1].round(2).tolist()
    [0.06, 0.02, 0.07, 1.0, 0.13]
    >>> smoothed.mean("x").round(1).tolist()
    [0.0, 0.0, 0.0, 6.0, 6.0]
    """

    merging: Literal["gpb1", "imm", "gpb2"] = "gpb2"
    linearize: bool = False
    max_modes: int = 64

    label: ClassVar[str] = "switching Kalman filter"

    def __post_init__(self) -> None:
        if self.merging not in _RULES:
            raise ValueError(
                f"SwitchingKalmanFilter(merging={self.merging!r}): there are {', '.join(map(repr, _RULES))}"
            )
        super().__post_init__()

    def effort(self, problem: SeriesProblem) -> str:
        run = self._run(problem)
        pairs = run.stretches[-1].pairs
        filters = len(pairs.dst) if self.merging == "gpb2" else len(pairs.of_kind)
        how = " in machine code" if run.is_compiled else ""
        return (
            f"{len(run.now)} modes, {filters} Kalman filters a slice{how}; the log marginal likelihood is an "
            "approximation of unknown error"
        )

    def effort_for(self, problem: SeriesProblem, asked: Asked) -> str:
        found = self.effort(problem)
        if asked.what not in ("smooth", "fixed-lag"):
            return found
        return (
            f"{found}; smoothed by Kim's approximations, p(x[t+1] | s[t], s[t+1], all rows) taken to be "
            "p(x[t+1] | s[t+1], all rows), which is too wide where rows are missing"
        )

    def smooth(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        lag: int | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> SwitchingSeries:
        others = "ExpectationPropagation() or ParticleFilter(particles)"
        return self.smoothed(problem, others, lag=lag, queries=queries, progress=progress)

    def smoothed(
        self,
        problem: SeriesProblem,
        others: str,
        *,
        lag: int | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> SwitchingSeries:
        """What ``smooth`` gives; ``others`` are engines that its warning names."""
        run = self._run(problem)
        with Progress(problem.steps, self.label, progress) as bar, quiet():
            filtered, increments = run.forward(partial(bar.advance, 1))
            found = run.smoothed(filtered, lag)
            both = run.whole(filtered), run.whole(found)
        first = run.data.layouts[0], *both, run.last_rows, run.data.series.start
        warn_where_lost(*first, others)
        kind = "smooth" if lag is None else "fixed-lag"
        return run.answers(kind, found, increments, queries)

    # ---- private -------------------------------------------------------------------------------

    @property
    def _rule(self) -> str:
        return self.merging
