"""What engines of switching systems share: what they refuse, the forward pass, and rows taken one by one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import ClassVar

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


class SwitchingBelief(SliceBelief):
    """A mixture over the modes of one slice, as ``start`` and ``step`` of its engines give it.

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


class SwitchingEngine(FilterEngine):
    """Base of ``SwitchingKalmanFilter`` and ``ExpectationPropagation``.

    Attributes
    ----------
    linearize : bool
        Whether functions that are not affine are linearised.
    max_modes : int
        Modes above which it refuses.
    """

    linearize: bool
    max_modes: int

    belief: ClassVar[type] = SwitchingBelief

    def __post_init__(self) -> None:
        name = type(self).__name__
        if not isinstance(self.linearize, bool):
            raise ValueError(f"{name}(linearize={self.linearize!r}): give True or False")
        if not _is_count(self.max_modes):
            raise ValueError(
                f"{name}(max_modes={self.max_modes!r}): give a number of modes, 1 or more"
            )

    def refusal(self, problem: SeriesProblem) -> str | None:
        common = super().refusal(problem)
        if common is not None:
            return common
        try:
            with quiet():
                self._run(problem)
        except BayesmcError as error:
            return f"{type(self).__name__}: {str(error).removeprefix(type(self).__name__ + ': ')}"
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
                return f"Gaussian given the mode, merged {how} ({self._told}){partly}"
            if name in layout.seen:
                return "observed, updates modes and Gaussians"
            if name in layout.certain:
                return "observed, updates modes" if modes.names else "observed"
            return "computed"

        return treated

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
                f"keep={keep!r}: {type(self).__name__} has no particles; ask its result for mean, var and "
                "cov, or use a ParticleFilter"
            )
        run = self._run(problem)
        try:
            with Progress(problem.steps, self.label, progress) as bar, quiet():
                found, increments = run.forward(partial(bar.advance, 1))
        except KeyboardInterrupt as stop:
            return answer_so_far(stop, self)
        return run.answers("filter", found, increments, queries)

    def refused_slice(
        self, modes: Modes, layout: Layout, values: Mapping[str, np.ndarray]
    ) -> str | None:
        """Why a slice is refused, or None; ``values`` are of what is known, in some mode."""
        why = modes.why_not(layout)
        if why is not None:
            return why
        bent = _why_not_linearized(layout)
        why = bent if self.linearize else why_not_gaussian(layout, values)
        if why is None:
            return None
        guarded = [n for n in layout.seen if n in modes.names or n in modes.leaves]
        if guarded:
            reads = ", ".join(map(repr, layout.model[guarded[0]].parents))
            return (
                f"the finite node {guarded[0]!r} depends on continuous nodes that are hidden (it reads "
                f"{reads}), and modes must not; use ParticleFilter"
            )
        if self.linearize or bent is not None:
            return f"{why}; use ParticleFilter"
        if not modes.names and not modes.leaves:
            return f"{why}; use ExtendedKalmanFilter or ParticleFilter"
        return f"{why}; use {type(self).__name__}(linearize=True) or ParticleFilter"

    # ---- private -------------------------------------------------------------------------------

    @property
    def _rule(self) -> str:
        """When Gaussians are merged on the way forward: "gpb2", "imm" or "gpb1"."""
        return "gpb2"

    @property
    def _told(self) -> str:
        """The same in words."""
        return self._rule

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
        return Options(self, self._rule, rule, int(self.max_modes))

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


# ---- private ------------------------------------------------------------------------------------


def _is_count(most: object) -> bool:
    return not isinstance(most, bool) and isinstance(most, (int, np.integer)) and bool(most >= 1)


def _why_not_linearized(layout: Layout) -> str | None:
    angular = next((n for n in layout.rows if layout.angles_of(n).any()), None)
    if angular is None:
        return why_not_matched(layout)
    return why_not_matched(layout) or (
        f"node {angular!r} is an angle that is not seen in every row, and Gaussians of several modes are "
        "merged on a line"
    )
