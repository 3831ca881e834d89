"""Beliefs row by row: the particles of one slice, and what follows from them."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.dbn import DynamicBayesNet, Row, Slices, read_static
from bayesmc.engines.beliefs import OnlineBelief
from bayesmc.engines.marginal.options import AUTO, sampling
from bayesmc.engines.marginal.step import UnseenError
from bayesmc.engines.particles.answers import Answers
from bayesmc.engines.particles.blocks import Block
from bayesmc.engines.particles.enough import COLLAPSED
from bayesmc.engines.particles.errors import ByFamily, node_errors
from bayesmc.engines.particles.families import Families
from bayesmc.engines.particles.filter_step import FilterStep
from bayesmc.engines.particles.genealogy import evidence_error
from bayesmc.engines.particles.lags import looked_back
from bayesmc.engines.particles.smc import Bare, Particles, quiet
from bayesmc.engines.particles.tracking import Tracker
from bayesmc.errors import LowEssWarning, QueryError, UnknownNodeError, UnsupportedError
from bayesmc.network import CompiledNode
from bayesmc.randomness import Purpose, resumed, stream
from bayesmc.results.laws import Laws, TableLaws
from bayesmc.results.marginal_answers import MarginalAnswers
from bayesmc.results.series import no_joint_table, numbers_of_states
from bayesmc.results.statistics import table_variance


class ParticleBelief(OnlineBelief):
    """Particles of one slice, as ``ParticleFilter.start`` and ``step`` give them.

    Attributes
    ----------
    t : int
        The slice whose row was absorbed last; -1 before anything was.
    about : int
        The slice that answers are about: ``t``, or so many before as ``delay=`` says, at the soonest the
        first (see ``back``).
    log_marginal_likelihood : float or ndarray
        Log density of all rows absorbed so far.
    log_marginal_likelihood_mcse : float or ndarray
        Its root mean square error.
    weight_ess : float or ndarray
        Equally weighted particles that these are worth.
    resampled : bool or ndarray of bool
        Whether they were resampled on the way into this slice.
    weights : ndarray, shape (particles, *plates)
        Normalised weights; the plates are those that are filtered separately.
    ancestors : ndarray of int or None
        Positions among the particles of the slice before; None where everybody has itself.
    rejuvenated : bool or ndarray of bool
        Whether they were drawn anew, since no weight was left (``on_degeneracy="rejuvenate"``).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    >>> engine = bmc.ParticleFilter(1000)
    >>> belief = engine.start(dbn, rng=0)
    >>> belief = engine.step(belief, {"y": 0.8})
    >>> belief.t, bool(abs(belief.mean("x") - 0.64) < 0.05)
    (0, True)
    """

    def __init__(
        self,
        dbn: DynamicBayesNet | None,
        seed: np.random.SeedSequence,
        static: Mapping[str, Any],
        made_by: FilterStep | Bare | None = None,
        now: Particles | None = None,
        log_marginal_likelihood: Any = 0.0,
        chance: Mapping[str, Any] | None = None,
        inputs: Mapping[str, np.ndarray] | None = None,
        families: Families | None = None,
        tracker: Tracker | None = None,
        window: tuple[Particles, ...] = (),
    ) -> None:
        self.dbn, self.seed, self.static = dbn, seed, dict(static)
        self.made_by, self.now, self.chance = made_by, now, chance
        self.inputs = dict(inputs or {})
        self.families, self.tracker = families, tracker
        self.log_marginal_likelihood = log_marginal_likelihood
        self.t = -1 if now is None else now.t
        #: slices that can be answered for, from the first on; this one alone without a delay
        self.window = window or (() if now is None else (now,))

    def __getstate__(self) -> dict[str, Any]:
        """Pickles travel without functions; ``start(dbn, belief=...)`` gives them back."""
        step = self.made_by
        bare = None if step is None else Bare(step.slices, step.layout)
        state = {**self.__dict__, "dbn": None, "made_by": bare, "tracker": None}
        state.pop("_particles", None)
        return state

    @property
    def about(self) -> int:
        """The slice that answers are about."""
        return -1 if self.now is None else self.window[0].t

    def back(self, slices: int) -> ParticleBelief:
        """What is believed now about so many slices before the last, as many as ``delay=`` says at most.

        It answers as this belief does; go on by ``step`` with this one.

        Raises
        ------
        QueryError

        Examples
        --------
        >>> import bayesmc as bmc
        >>> dbn = bmc.DynamicBayesNet()
        >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
        >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
        >>> engine = bmc.ParticleFilter(1000, delay=2)
        >>> belief = engine.start(dbn, rng=0)
        >>> for y in [0.8, 1.0, 0.7, 1.2]:
        ...     belief = engine.step(belief, {"y": y})
        >>> belief.t, belief.about, belief.back(0).about
        (3, 1, 3)
        """
        count = len(self.window)
        if slices not in range(count):
            has = f"for the last {count} slices, 0 to {count - 1} back" if count else "for none yet"
            raise QueryError(
                f"back({slices!r}): it answers {has}; ParticleFilter(delay=k) keeps the last k slices beside "
                "the newest, as rows come in"
            )
        found = copy.copy(self.__dict__)
        found.pop("_particles", None)
        other = object.__new__(type(self))
        other.__dict__.update(found, window=self.window[count - 1 - slices :])
        return other

    @property
    def slices(self) -> Slices | None:
        """What rows are read against; None before the first."""
        return None if self.made_by is None else self.made_by.slices

    @property
    def weights(self) -> np.ndarray:
        now = self._particles
        return now.weights / now.total

    @property
    def weight_ess(self) -> Any:
        ess = self._particles.ess if self.now is None else self.now.ess
        return ess if np.ndim(ess) else float(ess)

    @property
    def resampled(self) -> Any:
        found = self._particles.resampled
        return found if np.ndim(found) else bool(found)

    @property
    def ancestors(self) -> np.ndarray | None:
        return self._particles.ancestors

    @property
    def rejuvenated(self) -> Any:
        found = self._particles.rejuvenated
        return found if np.ndim(found) else bool(found)

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes whose particles are kept."""
        return tuple(self._particles.values)

    @property
    def log_marginal_likelihood_mcse(self) -> Any:
        """Root mean square error of ``log_marginal_likelihood``; infinite where particles cannot tell it."""
        if self.now is None or self.families is None:
            return 0.0
        return evidence_error(self.families, self.now)

    def mcse(self, what: str | Callable[..., Any]) -> np.ndarray:
        """Monte Carlo standard error of ``mean(name)`` or of a function's expectation or probability.

        Its shape; of each state's probability, for labels.
        """
        if callable(what):
            return self._answers.mcse(what)[0]
        node, block = self._numbers(what), self._block
        assert self.families is not None
        return node_errors(ByFamily(block, [self.families]), block, node)[0]

    def particles(self, name: str) -> np.ndarray:
        """Values of all particles, ``(particles, *plates, *event)``, not weighted."""
        node, now = self._node(name), self._particles
        full = np.broadcast_to(now.values[name], (len(now.weights), *node.value_shape))
        return np.array(node.decode(full), subok=True)

    def mean(self, name: str) -> np.ndarray:
        """Mean, shape ``(*plates, *event)``; circular for angles."""
        node = self._numbers(name)
        if node.domain is None:
            return self._block.mean(node)[0]
        return self._block.table(node)[0] @ numbers_of_states(node)

    def var(self, name: str) -> np.ndarray:
        """Variance, shape ``(*plates, *event)``; for angles ``-2 log R``."""
        node = self._numbers(name)
        if node.domain is None:
            return self._block.mean_and_variance(node)[1][0]
        return table_variance(self._block.table(node)[0], numbers_of_states(node, "variance"))

    def std(self, name: str) -> np.ndarray:
        """Standard deviation, shape ``(*plates, *event)``."""
        return np.sqrt(self.var(name))

    def probabilities(self, name: str, *others: str) -> np.ndarray:
        """Probabilities of the states of a finite node, shape ``(*plates, states)``; of one at a time."""
        if others:
            raise no_joint_table((name, *others), "ask", "expectation(%s)")
        node = self._numbers(name)
        if node.domain is None:
            raise QueryError(
                f"probabilities({name!r}): the node has no finite set of states; use mean, var or expectation"
            )
        return self._block.table(node)[0]

    def expectation(self, function: Callable[..., Any]) -> np.ndarray:
        """Mean of a function of nodes of the slice, whose arguments have a leading axis of particles."""
        return self._answers.expectation(function)[0]

    def probability(self, function: Callable[..., Any]) -> np.ndarray:
        """Probability of an event: a function of nodes of the slice that returns booleans."""
        return self._answers.probability(function)[0]

    def quantile(self, name: str, q: Any) -> np.ndarray:
        """Quantiles, shape ``(*q.shape, *plates, *event)``; those of angles are cut opposite the mean."""
        return self._answers.quantile(self._numbers(name).name, q)[0]

    def cov(self, *names: str) -> np.ndarray:
        """Covariance matrix of all numbers of the named nodes, in order; of one number, its variance."""
        return self._answers.cov(*(self._numbers(name).name for name in names))[0]

    def __repr__(self) -> str:
        if self.now is None:
            return "ParticleBelief(nothing absorbed yet)"
        ess, late = np.round(self.weight_ess, 1), ""
        if self.about < self.t:
            late = f"about={self.about}, "
        return (
            f"ParticleBelief(t={self.t}, {late}{len(self._particles.weights)} particles, ess={ess})"
        )

    # ---- private -------------------------------------------------------------------------------

    @property
    def _as_series(self) -> MarginalAnswers:
        return _Cloud(self)

    @cached_property
    def _particles(self) -> Particles:
        if self.now is None:
            raise QueryError(
                "the belief has absorbed nothing yet (t is -1); step(belief, row) takes in slice 0"
            )
        if len(self.window) < 2:
            return self.now
        with quiet():
            return looked_back((*self.window[:-1], self.now), self._step, self.seed)

    @property
    def _answers(self) -> Answers:
        step, known = self._step, [] if self.families is None else [self.families]
        return Answers(step.layout, step.slices.first, [self._particles], known)

    @property
    def _block(self) -> Block:
        return Block(self._step.layout, [self._particles])

    @property
    def _step(self) -> FilterStep | Bare:
        assert self.made_by is not None
        return self.made_by

    def _numbers(self, name: str) -> CompiledNode:
        """A node that has numbers, or states."""
        node = self._node(name)
        if node.is_object:
            raise QueryError(
                f"{name!r} holds objects, which have no mean, variance, quantiles or probabilities; see "
                f"particles({name!r}), or ask for the expectation of a function that makes numbers of them"
            )
        return node

    def _node(self, name: str) -> CompiledNode:
        now = self._particles
        if name not in now.values:
            slices = self._step.slices
            if name in slices.template.static or name in slices.template.inputs:
                raise QueryError(f"{name!r} is an input or static: its value is what was given")
            raise UnknownNodeError(
                f"particles of {name!r} are not kept; there are those of {list(now.values)}"
            )
        return self._step.slices.first[name]


class _Cloud(MarginalAnswers):
    """A belief as a series of one slice."""

    def __init__(self, belief: ParticleBelief) -> None:
        self.belief, self.model = belief, belief._step.slices.first

    def quantile(self, name: str, q: Any) -> np.ndarray:
        return self.belief.quantile(name, q)[None]

    def _laws(self, name: str) -> Laws:
        node = self.belief._node(name)
        if node.domain is None:
            return self.belief._answers.laws(name)
        labels = node.domain.labels is not None
        return TableLaws(
            self.belief.probabilities(name)[None], None if labels else numbers_of_states(node), name
        )

    def _lead(self) -> int:
        return 1

    def _answer_shape(self, name: str) -> tuple[int, ...]:
        return (1, *self.belief._node(name).value_shape)


def bound(
    engine: Any, belief: ParticleBelief, dbn: DynamicBayesNet, slices: Slices
) -> ParticleBelief:
    """A belief out of a pickle with the functions of a template that fits it."""
    held, most = len(belief.weights), engine.particles
    if held > most or (held < most and engine.adapt is None):
        raise ValueError(
            f"ParticleFilter({most}).start: the belief has {held} particles; go on with the "
            "engine that it was started with"
        )
    inner = None if belief.now is None else belief.now.inner
    seen = () if inner is None else inner.seen
    if belief.now is not None and inner is None:
        engine = sampling(engine)
    step = engine.step_of(slices, read_static(slices, belief.static), seen=seen)
    step.lag = engine.delay or 0
    return ParticleBelief(
        dbn, belief.seed, belief.static, step, belief.now,
        belief.log_marginal_likelihood, belief.chance, belief.inputs, belief.families,
        window=belief.window,
    )  # fmt: skip


def absorbed(engine: Any, belief: ParticleBelief, slices: Slices, row: Row) -> ParticleBelief:
    """The belief after one more row, by an engine that has a number of particles."""
    step, tracker = belief.made_by, belief.tracker
    if not isinstance(step, FilterStep):
        full = [n for n, o in row.seen.items() if o.mask is None]
        step = engine.step_of(slices, read_static(slices, belief.static), seen=full)
        step.lag = engine.delay or 0
    tracker = Tracker(step) if tracker is None else tracker
    chance = belief.chance
    rng = stream(belief.seed, Purpose.FILTER) if chance is None else resumed(chance)
    before = belief.now
    with quiet():
        try:
            now = step(before, row, rng)
        except UnseenError as error:
            if before is None or step.lag or engine.marginalize != AUTO:
                way = ", or leave delay= out" if step.lag else ""
                raise UnsupportedError(f"{error}{way}") from None
            # a weighted draw of all nodes is one of the belief: go on with that
            step = sampling(engine).step_of(slices, read_static(slices, belief.static))
            tracker, before = Tracker(step), before._replace(inner=None, tables=None)
            now = step(before, row, rng)
        families = tracker.after_one(belief.families, before, now, row)
    total = belief.log_marginal_likelihood + now.increment
    known = step.lag if now.inner is None else min(step.lag, len(now.inner.past) - 1)
    window = belief.window[-known:] if known > 0 else ()
    bare = tuple(p._replace(inner=None) for p in window)  # the newest knows of all before
    return ParticleBelief(
        belief.dbn, belief.seed, belief.static, step, now,
        total if np.ndim(total) else float(total), rng.bit_generator.state,
        {n: row.inputs[n] for n in slices.template.inputs}, families, tracker, (*bare, now),
    )  # fmt: skip


def warn_of_a_lonely_step(
    before: Particles | None, families: Families | None, now: Particles
) -> None:
    """The first step that leaves little more than one particle says so; later ones know by the error."""
    if before is not None and families is not None and np.isinf(families.settled).any():
        return
    worst = float(np.min(now.ess))
    if worst >= min(COLLAPSED, 0.9 * len(now.weights)):
        return
    warnings.warn(
        f"ParticleFilter: step leaves {len(now.weights)} particles that are worth {worst:.1f} equally "
        f"weighted ones in slice {now.t}: from here on the belief cannot tell how far it is off "
        "(log_marginal_likelihood_mcse is infinite); give a larger number of particles, or a proposal= that "
        "looks at the observations",
        LowEssWarning,
        stacklevel=4,
    )
