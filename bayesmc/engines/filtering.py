"""What engines over time share: refusals, the calls, and the one loop of those that go slice by slice.

A *sequential* engine turns the state of one slice and the row of the next into the state of that slice, in
the loop ``pass_slices`` or by ``start`` and ``step``. Where all slices are alike, engines go their own way.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np

from bayesmc.dbn import (
    DynamicBayesNet,
    Row,
    SeriesProblem,
    Slices,
    given_static,
    pose_series,
    read_row,
)
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.beliefs import SliceBelief, refuse_unbound, slices_like
from bayesmc.engines.options import Options
from bayesmc.engines.picks import pick_outside
from bayesmc.engines.refusals import common_refusal
from bayesmc.errors import (
    BayesmcError,
    EvidenceError,
    InterruptWarning,
    ModelError,
    QueryError,
    UnsupportedError,
)
from bayesmc.results import SeriesPosterior

#: functions whose expectation is wanted in every slice, by name
Queries = Mapping[str, Callable[..., Any]]


class Asked(NamedTuple):
    """What is asked of the slices.

    Attributes
    ----------
    what : str
        ``"filter"``, ``"smooth"``, ``"fixed-lag"``, ``"forecast"`` or ``"most_likely"``.
    keep : str or None
    queries : dict
        Functions whose expectations are wanted, by name.
    """

    what: str = "filter"
    keep: str | None = None
    queries: Queries = MappingProxyType({})


def read_queries(call: str, queries: Any) -> Queries:
    """The functions asked for by name; anything else is refused with what to give."""
    if queries is None:
        return {}
    fix = "give queries={'name': function}, functions whose arguments name nodes"
    if not isinstance(queries, Mapping):
        raise QueryError(
            f"{call}(queries={queries!r}): a {type(queries).__name__} is no dict; {fix}"
        )
    for name, function in queries.items():
        if not isinstance(name, str) or not callable(function):
            what = f"{name!r} is no name of a function"
            if isinstance(name, str):
                what = f"a {type(function).__name__} is no function"
            raise QueryError(f"{call}(queries={{{name!r}: {function!r}}}): {what}; {fix}")
    return queries


class FilterEngine(Options):
    """Base of the engines over time; ``filter``, ``smooth``, ``forecast`` and ``most_likely`` are the way in.

    A family supplies ``refusal``, ``treatment`` and ``filter``, and of the other questions those that it can
    answer.
    """

    label: ClassVar[str] = ""  #: what stands beside the progress bar
    #: whether it has particles that can be kept, and whether it answers for functions of nodes
    keeps: ClassVar[bool] = False
    #: what its ``start`` and ``step`` return
    belief: ClassVar[type] = object
    takes_queries: ClassVar[bool] = True
    spreads: ClassVar[bool] = False  #: whether ``filter`` takes an ``executor``
    #: whether ``filter`` takes ``checkpoint=`` and saves itself as it goes on; others are saved at the end
    saves: ClassVar[bool] = False
    is_exact: ClassVar[bool] = False  #: whether its answers are the model's, up to rounding

    def refusal(self, problem: SeriesProblem) -> str | None:
        """Why this engine cannot answer, or None; a family's own reasons come after the common ones."""
        return common_refusal(self, problem)

    def unable(self, problem: SeriesProblem, asked: Asked) -> str | None:
        """Why this engine has no answer to what is asked of a problem that it does not refuse, or None."""
        if asked.what in ("smooth", "fixed-lag") and type(self).smooth is FilterEngine.smooth:
            return f"{type(self).__name__} does not smooth"
        if asked.what == "most_likely" and type(self).most_likely is FilterEngine.most_likely:
            return f"{type(self).__name__} does not find the most likely trajectory"
        if asked.keep is not None and not self.keeps:
            return f"{type(self).__name__} has no particles to keep"
        if asked.queries and not self.takes_queries:
            return f"{type(self).__name__} does not answer queries={list(asked.queries)}"
        return None

    def unanswered(self, problem: SeriesProblem) -> tuple[str, ...]:
        """Hidden nodes that its answers would leave out."""
        return ()

    def unasked(self, problem: SeriesProblem, asked: Asked) -> str | None:
        """Why this engine is not taken where the user names none, though it can answer; or None."""
        return None

    def is_displaced(self, problem: SeriesProblem) -> bool:
        """Whether it would be asked before others, were it not for an option; told without a run."""
        return not self.unanswered(problem)

    def reasons(self, problem: SeriesProblem) -> tuple[str, ...]:
        """Why this engine is taken where the user names none, if there is more to say than of its kind."""
        return ()

    def describe(self, problem: SeriesProblem) -> dict[str, str]:
        """What the engine does to each node of a slice."""
        template, treated = problem.slices.template, self.treatment(problem)
        found = dict.fromkeys(template.inputs, "input")
        found |= dict.fromkeys(template.static, "static, known")
        return {n: found.get(n) or treated(n) for n in template.later}

    def treatment(self, problem: SeriesProblem) -> Callable[[str], str]:
        """From a node that is neither input nor static to what the engine does to it."""
        raise NotImplementedError

    def effort(self, problem: SeriesProblem) -> str:
        """How it passes a series, where there is something to say."""
        return ""

    def effort_for(self, problem: SeriesProblem, asked: Asked) -> str:
        """The same for what is asked."""
        return self.effort(problem)

    def filter(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        keep: str | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> SeriesPosterior:
        """Every slice given the rows up to it."""
        raise NotImplementedError

    def smooth(
        self,
        problem: SeriesProblem,
        seed: np.random.SeedSequence,
        *,
        lag: int | None = None,
        queries: Queries | None = None,
        progress: bool | None = None,
    ) -> SeriesPosterior:
        """Every slice given all rows, or given rows up to ``lag`` slices later."""
        raise self._cannot("smooth")

    def most_likely(
        self, problem: SeriesProblem, seed: np.random.SeedSequence, progress: bool | None = None
    ) -> dict[str, np.ndarray]:
        """The most likely trajectory of the hidden nodes, as user values, time first."""
        raise self._cannot("find the most likely trajectory")

    def start(
        self,
        dbn: DynamicBayesNet,
        *,
        static: Mapping[str, Any] | None = None,
        rng: Any = None,
        belief: Any = None,
    ) -> Any:
        """A belief that has absorbed nothing yet, or one from a pickle that goes on.

        Parameters
        ----------
        static : dict, optional
            Values of the static nodes.
        rng : seed, SeedSequence, Generator or None
            For filters that draw.
        belief : optional
            One of this kind of filter, which pickles without functions: it gets those of ``dbn`` and goes
            on with the same random numbers. Whether the functions are the same, nobody can tell.

        Raises
        ------
        ModelError, EvidenceError, UnsupportedError

        Examples
        --------
        >>> import bayesmc as bmc
        >>> dbn = bmc.DynamicBayesNet()
        >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
        >>> dbn.add("y", lambda x: bmc.Normal(x, 1.0))
        >>> engine = bmc.KalmanFilter()
        >>> belief = engine.step(engine.start(dbn), {"y": 1.0})
        >>> belief.t, round(float(belief.mean("x")), 6)
        (0, 0.5)
        """
        if not isinstance(dbn, DynamicBayesNet):
            raise ModelError(
                f"{type(self).__name__}().start: expected a DynamicBayesNet, not {type(dbn).__name__}"
            )
        dbn.validate()
        if belief is not None:
            return self._resumed(dbn, belief, static, rng)
        return self._nothing(dbn.copy(), given_static(dbn.template, static), rng)

    def step(
        self,
        belief: Any,
        observations: Mapping[str, Any] | None = None,
        *,
        inputs: Mapping[str, Any] | None = None,
    ) -> Any:
        """The belief about the next slice, whose row this is; the old belief stays as it is.

        Parameters
        ----------
        observations : dict, optional
            Node -> its value in this slice, without an axis for time; what is left out is missing.
        inputs : dict, optional
            Input -> its value in this slice.

        Raises
        ------
        EvidenceError, UnsupportedError, DegeneracyError, ZeroProbabilityError
        """
        self._check_family("step", belief)
        refuse_unbound(self, belief)
        belief.dbn.template.check_captured()
        slices, row = read_row(
            belief.dbn, belief.slices, belief.t + 1, observations, inputs, belief.inputs
        )
        with in_slice(row.t), picks_told(slices, [row]):
            return self._absorbed(belief, slices, row)

    def unsupported(
        self,
        dbn: Any,
        observations: Mapping[str, Any] | None,
        inputs: Mapping[str, Any] | None = None,
    ) -> str | None:
        """Why this engine cannot answer, or None."""
        problem = pose_series(dbn, observations, inputs)
        try:
            return self.refusal(problem)
        except BayesmcError as error:  # options that do not fit the template
            return str(error)

    def _check_family(self, what: str, belief: Any) -> None:
        family: Any = self.belief
        if not isinstance(belief, family):
            raise TypeError(
                f"{type(self).__name__}().{what}: the belief is a {type(belief).__name__}; give what start "
                "or step of this kind of filter returned"
            )

    def _resumed(self, dbn: DynamicBayesNet, belief: Any, static: Any, rng: Any) -> Any:
        """A belief bound to a template."""
        self._check_family("start", belief)
        if static is not None or rng is not None:
            raise ValueError(
                f"{type(self).__name__}().start: belief= brings its own static values and random numbers; "
                "leave static= and rng= out"
            )
        slices = slices_like(dbn, belief)
        if slices is None:
            found = self._nothing(dbn.copy(), belief.static, None)
            if hasattr(belief, "seed"):  # as it is: seeds that are read anew count on
                found.seed = belief.seed
            return found
        return self._bound(belief, dbn.copy(), slices)

    def _bound(self, belief: Any, dbn: DynamicBayesNet, slices: Slices) -> Any:
        """A family's belief with the functions of a template that fits it."""
        raise self._cannot("go row by row")

    def _nothing(self, dbn: DynamicBayesNet, static: Mapping[str, Any], rng: Any) -> Any:
        """A family's belief before the first row."""
        if issubclass(self.belief, SliceBelief):
            return self.belief(dbn, static)
        raise self._cannot("go row by row")

    def _absorbed(self, belief: Any, slices: Slices, row: Row) -> Any:
        """A family's belief after one more row."""
        raise self._cannot("go row by row")

    def _cannot(self, what: str) -> UnsupportedError:
        return UnsupportedError(
            f"{type(self).__name__} does not {what}; use engine=None, which finds one that does where "
            "there is one, or ask a static engine on dbn.unroll(steps)"
        )


def pass_slices(
    start: int,
    steps: int,
    move: Callable[[int], None],
    answer: Callable[[int], Any] | None,
    advance: Callable[[], None],
) -> None:
    """The loop over the slices of a series; what is done is not lost where it ends early.

    Parameters
    ----------
    start : int
        The slice that the first row belongs to.
    steps : int
    move : callable
        Takes in the k-th row and keeps its answers.
    answer : callable or None
        The posterior over the first k slices, k at least 1; None where there is none to give.
    advance : callable
        Notes that one more slice is done.

    Raises
    ------
    Exception, KeyboardInterrupt
        What ``move`` raises, with the slice it happened in and, in ``filtered``, the answer about the slices
        before.
    """
    k = 0
    try:
        for k in range(steps):
            with in_slice(start + k):
                move(k)
            advance()
    except (Exception, KeyboardInterrupt) as stop:
        hand_over(stop, answer(k) if answer is not None and k else None)
        raise


def hand_over(stop: BaseException, found: SeriesPosterior | None) -> None:
    """Put the answer so far where whoever catches the exception finds it, and say so."""
    with suppress(AttributeError):  # an exception of somebody else's may take no attributes
        stop.filtered = found  # type: ignore[attr-defined]
        if found is not None:
            last = found.start + found.steps - 1
            before = f"slices {found.start} to {last}" if found.steps > 1 else f"slice {last}"
            stop.add_note(f"the answer about {before} is in `error.filtered`")


@contextmanager
def quiet() -> Iterator[None]:
    """Parameters out of range are marked, and floating-point warnings silent, while functions run."""
    with marking_invalid(), np.errstate(all="ignore"):
        yield


@contextmanager
def in_slice(t: int) -> Iterator[None]:
    """Has errors say which slice they happened in."""
    try:
        yield
    except BayesmcError as error:
        if not re.search(rf"\bslice {t}\b|^slice \d+: ", told := str(error)):
            error.args = (f"slice {t}: {told}", *error.args[1:])
        raise
    except Exception as error:  # somebody else's: its arguments may mean anything
        with suppress(AttributeError):
            error.add_note(f"this was in slice {t}")
        raise


@contextmanager
def picks_told(slices: Slices, rows: Any) -> Iterator[None]:
    """Has an index that is outside of a plate say which input of some rows it comes from."""
    try:
        yield
    except IndexError as error:
        if why := pick_outside(slices, rows):
            raise EvidenceError(why) from error
        raise


def answer_so_far(stop: KeyboardInterrupt, engine: FilterEngine) -> Any:
    """The posterior over the slices that a filter has done before Ctrl-C; call it from ``filter`` itself.

    Raises
    ------
    KeyboardInterrupt
        No slice is done, or the engine has no answer about some of them.

    Warns
    -----
    InterruptWarning
    """
    found = getattr(stop, "filtered", None)
    if found is None:
        raise stop
    last = found.start + found.steps - 1
    warnings.warn(
        f"{type(engine).__name__}: interrupted in slice {last + 1}; the posterior has the {found.steps} "
        f"slices up to {last}",
        InterruptWarning,
        stacklevel=4,
    )
    found.interrupted = True
    return found


def refuse_forecast(found: SeriesPosterior, kind: str) -> None:
    """The last slices of a filter that was interrupted are none ahead of the data: the interrupt goes on."""
    if kind == "forecast" and getattr(found, "interrupted", False):
        raise KeyboardInterrupt


class Answers(NamedTuple):
    """Tables, means and variances by node, time first."""

    tables: dict[str, np.ndarray]
    means: dict[str, np.ndarray]
    variances: dict[str, np.ndarray]


def observed_answers(problem: SeriesProblem, steps: int | None = None) -> Answers:
    """What is known of nodes that are observed in full throughout: their values (in the first slices)."""
    found = Answers({}, {}, {})
    for name, seen in problem.series.observed.items():
        node = problem.model[name]
        if seen.mask is not None:
            continue
        value = seen.value[:steps]
        if node.domain is not None:
            found.tables[name] = np.eye(node.domain.size)[value.astype(np.intp)]
        else:
            found.means[name] = value.astype(float)
            found.variances[name] = np.zeros(value.shape)
    return found


def first_slices(arrays: Mapping[str, np.ndarray], steps: int) -> dict[str, np.ndarray]:
    """The first so many rows of arrays by node, time first."""
    return {n: a[:steps] for n, a in arrays.items()}
