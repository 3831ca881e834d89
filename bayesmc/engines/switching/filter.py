"""``SwitchingKalmanFilter``: options, refusals and the calls."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

import numpy as np

from bayesmc.dbn import PREVIOUS, DynamicBayesNet, Row, SeriesProblem, Slices, read_static
from bayesmc.engines.beliefs import SliceBelief
from bayesmc.engines.filtering import Asked, FilterEngine, Queries, answer_so_far, quiet
from bayesmc.engines.kalman.data import SeriesData
from bayesmc.engines.kalman.levels import why_not_matched
from bayesmc.engines.kalman.nonlinear import ExtendedKalmanFilter
from bayesmc.engines.kalman.reading import why_not_gaussian
from bayesmc.engines.kalman.slices import Layout
from bayesmc.engines.switching.modes import Modes
from bayesmc.engines.switching.posterior import SwitchingSeries
from bayesmc.engines.switching.run import Options, SwitchingRun, SwitchingState, row_taken
from bayesmc.errors import BayesmcError, UnsupportedError
from bayesmc.network.node import nodes_read
from bayesmc.progress import Progress

_RULES = ("gpb1", "imm", "gpb2")


class SwitchingBelief(SliceBelief):
    """A mixture over the modes of one slice, as ``start`` and ``step`` of ``SwitchingKalmanFilter`` give it.

    Attributes
    ----------
    t : int
        The slice; -1 before anything was absorbed.
    log_marginal_likelihood : float or ndarray
        Of all rows absorbed so far; approximate.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc import SwitchingKalmanFilter
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.table("s", ["s_prev"], [[0.9, 0.1], [0.2, 0.8]], initial=[0.5, 0.5])
    >>> dbn.add("x", lambda x_prev, s: bmc.Normal(x_prev + s, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    >>> engine = SwitchingKalmanFilter()
    >>> belief = engine.step(engine.step(engine.start(dbn), {"y": 0.1}), {"y": 2.0})
    >>> belief.t, belief.probabilities("s").round(3).tolist()
    (1, [0.315, 0.685])
    """

    def cov(self, *names: str) -> np.ndarray:
        """Joint covariance, shape ``(*plates, d, d)``, of nodes one after the other."""
        return self._posterior.cov(*names)[0]

    @property
    def _of_functions(self) -> SwitchingSeries:
        return self._posterior

    def _answered(self) -> SwitchingSeries:
        return self.state.posterior(self.t)

    def _without_functions(self) -> SwitchingState:
        return self.state._replace(memory=None)


@dataclass(frozen=True)
class SwitchingKalmanFilter(FilterEngine):
    """Approximate beliefs about switching systems: linear-Gaussian given finite nodes that are hidden, too.

    The hidden finite nodes of a slice make its *mode*, each joint state of theirs that is possible one.
    Modes depend on modes of the slice before and of the same one, on inputs and on what is observed
    throughout, never on hidden numbers. Given the modes of both slices everything else that is hidden, and
    what is observed of it, is Normal or MvNormal with affine means, as ``KalmanFilter`` has it.

    The exact belief is a mixture with one Gaussian for every history of modes. Here every mode has one
    Gaussian, of the same mean and covariance as what it stands for, so everything it says is approximate, the
    log marginal likelihood included, and nobody knows by how much: hold it against ``ParticleFilter``, or
    against ``infer(dbn, first_rows, engine=Exact())`` of a short series. It is exact where modes make no
    difference and for one slice.

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
        ``ExtendedKalmanFilter`` does; otherwise templates with such are refused.
    max_modes : int
        Modes above which it refuses.

    Notes
    -----
    ``smooth`` is Kim's smoother, on the filter's Gaussians whatever rule made them: given the mode of the
    next slice, later rows are taken to tell no more of this one's. Gaussians are carried as triangular
    roots of their covariances, and merged as such; no covariance is subtracted or inverted. All pairs of
    modes are one array operation, with ``linearize`` one after the other. Plates whose elements never
    meet have a mode for each element. Finite nodes that nothing reads are averaged over where they are
    missing, and so are other families that depend on modes alone.

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
    belief: ClassVar[type] = SwitchingBelief

    def __post_init__(self) -> None:
        if self.merging not in _RULES:
            raise ValueError(
                f"SwitchingKalmanFilter(merging={self.merging!r}): there are {', '.join(map(repr, _RULES))}"
            )
        if not isinstance(self.linearize, bool):
            raise ValueError(
                f"SwitchingKalmanFilter(linearize={self.linearize!r}): give True or False"
            )
        most = self.max_modes
        if isinstance(most, bool) or not isinstance(most, (int, np.integer)) or most < 1:
            raise ValueError(
                f"SwitchingKalmanFilter(max_modes={most!r}): give a number of modes, 1 or more"
            )

    def refusal(self, problem: SeriesProblem) -> str | None:
        common = super().refusal(problem)
        if common is not None:
            return common
        try:
            with quiet():
                self._run(problem)
        except BayesmcError as error:
            return f"SwitchingKalmanFilter: {str(error).removeprefix('SwitchingKalmanFilter: ')}"
        return None

    def unable(self, problem: SeriesProblem, asked: Asked) -> str | None:
        reason = super().unable(problem, asked)
        silent = (
            {*self._modes(problem).leaves, *self.unanswered(problem)} if asked.queries else set()
        )
        for query, function in asked.queries.items():
            for name in nodes_read(function) if reason is None else ():
                if name in silent:
                    return f"queries={{{query!r}: ...}} reads {name!r}, of which no function is answered"
        return reason

    def unanswered(self, problem: SeriesProblem) -> tuple[str, ...]:
        run = self._run(problem)
        told = {*run.data.known, *run.modes.names, *run.data.layouts[0].rows, *run.data.computed(1)}
        told |= set(run.told)
        return tuple(n for n in problem.slices.dynamic if n not in told)

    def treatment(self, problem: SeriesProblem) -> Callable[[str], str]:
        run = self._run(problem)
        modes, layout, count = run.modes, run.data.layouts[1], len(run.now)
        how = "approximately" if count > 1 else "exactly"

        def treated(name: str) -> str:
            if name in modes.names:
                return f"part of a mode with {count} states"
            if name in modes.leaves:
                return "averaged over modes where it is missing"
            if name in layout.drawn:
                partly = ", observed in part" if name in problem.series.observed else ""
                return f"Gaussian given the mode, merged {how} ({self.merging}){partly}"
            if name in layout.seen:
                return "observed, updates modes and Gaussians"
            if name in layout.certain:
                return "observed, updates modes" if modes.names else "observed"
            return "computed"

        return treated

    def effort(self, problem: SeriesProblem) -> str:
        run = self._run(problem)
        pairs = run.stretches[-1].pairs
        filters = len(pairs.dst) if self.merging == "gpb2" else len(pairs.of_kind)
        how = " in machine code" if run.is_compiled else ""
        return (
            f"{len(run.now)} modes, {filters} Kalman filters a slice{how}; the log marginal likelihood is an "
            "approximation of unknown error"
        )

    def filter(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        keep: str | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> SwitchingSeries:
        if keep is not None:
            raise UnsupportedError(
                f"keep={keep!r}: SwitchingKalmanFilter has no particles; ask its result for mean, var and "
                "cov, or use a ParticleFilter"
            )
        run = self._run(problem)
        try:
            with Progress(problem.steps, self.label, progress) as bar, quiet():
                found, increments = run.forward(partial(bar.advance, 1))
        except KeyboardInterrupt as stop:
            return answer_so_far(stop, self)
        return run.answers("filter", found, increments, queries)

    def smooth(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        lag: int | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> SwitchingSeries:
        run = self._run(problem)
        with Progress(problem.steps, self.label, progress) as bar, quiet():
            found, increments = run.forward(partial(bar.advance, 1))
            found = run.smoothed(found, lag)
        kind = "smooth" if lag is None else "fixed-lag"
        return run.answers(kind, found, increments, queries)

    def refused_slice(
        self, modes: Modes, layout: Layout, values: Mapping[str, np.ndarray]
    ) -> str | None:
        """Why a slice is refused, or None; ``values`` are of what is known, in some mode."""
        why = modes.why_not(layout)
        if why is not None:
            return why
        if self.linearize:
            why = why_not_matched(layout)
            angular = next((n for n in layout.placed if layout.angles_of(n).any()), None)
            if why is None and angular is not None:
                why = f"node {angular!r} is an angle, and Gaussians of several modes are merged on a line"
        else:
            why = why_not_gaussian(layout, values)
        if why is None:
            return None
        guarded = [n for n in layout.seen if n in modes.names or n in modes.leaves]
        if guarded:
            reads = ", ".join(map(repr, layout.model[guarded[0]].parents))
            return (
                f"the finite node {guarded[0]!r} depends on continuous nodes that are hidden (it reads "
                f"{reads}), and modes must not; use ParticleFilter"
            )
        if self.linearize:
            return f"{why}; use ParticleFilter"
        if not modes.names:
            return f"{why}; use ExtendedKalmanFilter or ParticleFilter"
        return f"{why}; use SwitchingKalmanFilter(linearize=True) or ParticleFilter"

    # ---- private -------------------------------------------------------------------------------

    def _bound(
        self, belief: SwitchingBelief, dbn: DynamicBayesNet, slices: Slices
    ) -> SwitchingBelief:
        old = belief.state.layout
        layout = Layout(slices, old.apart, old.first, old.before, old.unknown)
        modes = Modes(slices, frozenset())
        return belief.bound(dbn, slices, belief.state._replace(layout=layout, modes=modes))

    def _absorbed(self, belief: SwitchingBelief, slices: Slices, row: Row) -> SwitchingBelief:
        static = read_static(slices, belief.static)
        with quiet():
            modes = Modes(slices, frozenset()) if belief.state is None else belief.state.modes
            state, increment = row_taken(slices, modes, static, row, belief.state, self._options())
        return belief.after(slices, row, increment, state)

    def _options(self) -> Options:
        rule = ExtendedKalmanFilter().made_linear if self.linearize else None
        return Options(self, self.merging, rule, int(self.max_modes))

    def _modes(self, problem: SeriesProblem) -> Modes:
        if "switching modes" not in problem.cache:
            problem.cache["switching modes"] = Modes(problem.slices, problem.seen)
        return problem.cache["switching modes"]

    def _run(self, problem: SeriesProblem) -> SwitchingRun:
        key = f"switching {self!r}"
        if key not in problem.cache:
            modes = self._modes(problem)
            data = SeriesData(problem, modes.known(problem.seen))
            self._check(problem, modes, data)
            problem.cache[key] = SwitchingRun(problem, modes, data, self._options())
        return problem.cache[key]

    def _check(self, problem: SeriesProblem, modes: Modes, data: SeriesData) -> None:
        """Raises UnsupportedError."""
        for name in (*modes.names, *modes.leaves):
            seen = problem.series.observed.get(name)
            if seen is not None and seen.parts is not None:
                raise UnsupportedError(
                    f"some components of node {name!r} are missing where others are observed; use "
                    "ParticleFilter"
                )
        for later in (0, 1):
            layout = data.layouts[later]
            values = data.at(min(later, data.steps - 1))
            some = np.zeros((), dtype=np.intp)
            values |= modes.at(some)
            if later:
                values |= modes.at(some, PREVIOUS)
            why = self.refused_slice(modes, layout, values)
            if why is not None:
                raise UnsupportedError(why)
