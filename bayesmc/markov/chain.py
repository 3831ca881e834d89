"""A chain: its classes, its laws, its speed, its paths."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.errors import ShapeError, StateError, UnsupportedError
from bayesmc.markov import arrays, checks
from bayesmc.markov.arrays import total_variation
from bayesmc.markov.findings import CommunicatingClass, DetailedBalance
from bayesmc.shapes import first_index, owned

if TYPE_CHECKING:
    import networkx

#: a distance above a bound by no more than rounding, relative and absolute, counts as reaching it
_TIE, _ROUNDING = 1e-12, 1e-15
#: distances below it have no reliable digits left
_NEAREST = 1e-12
#: mixing times from here on are not computed: the powers would be rounding errors
_LONGEST = 2**50


@dataclass(frozen=True, eq=False, repr=False)
class MarkovChain:
    """A homogeneous Markov chain on finitely many states.

    Parameters
    ----------
    transition : array_like, shape (K, K)
        Row-stochastic: ``transition[i, j]`` is the probability of going from state i to state j. An
        entry counts as possible where it is greater than zero, however small.
    states : sequence of hashable, optional
        K labels; ``0, ..., K - 1`` where absent.

    Raises
    ------
    ShapeError
        For an array that is not square, or a wrong number of labels.
    ParameterError
        For a row that is not a distribution; its position is the error's ``index``.
    StateError
        For a label that occurs twice.

    References
    ----------
    Levin, Peres and Wilmer, Markov Chains and Mixing Times, 2nd ed., 2017, chapters 1, 4 and 12.

    Examples
    --------
    >>> from bayesmc.markov import MarkovChain
    >>> weather = MarkovChain([[0.9, 0.1], [0.5, 0.5]], states=("dry", "wet"))
    >>> weather
    MarkovChain(2 states, irreducible, period 1)
    >>> weather.stationary.round(4).tolist()
    [[0.8333, 0.1667]]
    >>> weather.is_reversible(), round(weather.spectral_gap, 12), weather.mixing_time(0.01)
    (True, 0.6, 5)
    """

    transition: Any
    states: Any = None

    def __post_init__(self) -> None:
        transition = owned(self.transition, dtype=float)
        shape = transition.shape
        if not transition.size or shape != 2 * shape[:1]:
            raise ShapeError(
                f"MarkovChain(transition): it has shape {shape}; a row and a column for "
                "each state are needed"
            )
        labels = tuple(range(len(transition)) if self.states is None else self.states)
        checks.check_labels(labels, len(transition))
        checks.check_rows(transition, labels)
        object.__setattr__(self, "transition", transition)
        object.__setattr__(self, "states", labels)

    @cached_property
    def classes(self) -> tuple[CommunicatingClass, ...]:
        """The communicating classes, ordered by their first states (Levin et al., section 1.7)."""
        from scipy.sparse.csgraph import connected_components

        possible = self.transition > 0
        count, label = connected_components(possible, directed=True, connection="strong")
        members = sorted((np.flatnonzero(label == k) for k in range(count)), key=lambda m: m[0])
        return tuple(self._class(possible, positions) for positions in members)

    @property
    def is_irreducible(self) -> bool:
        """Whether every state can be reached from every other one."""
        return len(self.classes) == 1

    @property
    def period(self) -> int:
        """Least common multiple of the periods of the recurrent classes.

        For an irreducible chain that is its period. It is 1 exactly where every start converges;
        transient states play no part.
        """
        return math.lcm(*(c.period for c in self._recurrent))

    @property
    def is_aperiodic(self) -> bool:
        """Whether the period is 1."""
        return self.period == 1

    @property
    def is_ergodic(self) -> bool:
        """Irreducible and aperiodic: from every start the chain converges to one law."""
        return self.is_irreducible and self.is_aperiodic

    @cached_property
    def stationary(self) -> np.ndarray:
        """The extreme stationary laws, one row per recurrent class, shape (classes, K).

        In the order of ``classes``. Every stationary law is an average of them, and where there is
        one row only, it is the one stationary law. Found by elimination without subtractions, so
        that each probability has all its digits, the smallest ones too, however weakly the states
        are coupled.

        References
        ----------
        Grassmann, Taksar and Heyman, Regenerative analysis and steady state distributions for Markov
        chains, Operations Research 33, 1985. Accuracy: O'Cinneide, Numerische Mathematik 65, 1993.
        """
        laws = np.zeros((len(self._recurrent), len(self.states)))
        for law, closed in zip(laws, self._recurrent, strict=True):
            positions = np.array(closed.positions)
            law[positions] = arrays.stationary_law(self.transition[np.ix_(positions, positions)])
        return owned(laws)

    def detailed_balance(self, law: Any = None, tolerance: float = 1e-10) -> DetailedBalance:
        """The pair of states that is furthest from ``law_i P_ij = law_j P_ji``.

        Parameters
        ----------
        law : array_like, shape (K,), optional
            The stationary law where absent; with several of them, an average (all have the same
            answer, since no path leads from one class to another).
        tolerance : float
            Violations up to it are rounding errors.

        Notes
        -----
        Detailed balance with a law makes that law stationary; the reverse is not true (Levin et al.,
        proposition 1.20).
        """
        average = self.stationary.mean(axis=0)
        p = average if law is None else self._law(law, "detailed_balance", ndim=1)
        flow = p[:, None] * self.transition
        with np.errstate(divide="ignore", invalid="ignore"):
            scaled = np.abs(flow - flow.T) / np.sqrt(p)[:, None] / np.sqrt(p)
        scaled = np.where(flow == flow.T, 0.0, scaled)  # zero over zero is no violation
        i, j = first_index(scaled == scaled.max())
        worst = float(scaled[i, j])
        pair, flows = (self.states[i], self.states[j]), (float(flow[i, j]), float(flow[j, i]))
        return DetailedBalance(worst, pair, flows, worst <= tolerance)

    def is_reversible(self, law: Any = None, tolerance: float = 1e-10) -> bool:
        """Whether detailed balance holds; ``detailed_balance`` says where it does not."""
        return self.detailed_balance(law, tolerance).holds

    @cached_property
    def spectral_gap(self) -> float:
        """Absolute spectral gap: 1 less the largest modulus of the other eigenvalues.

        Exactly 0 where the chain is periodic or has several stationary laws, else to about 1e-15
        for reversible chains, which are symmetrised first; eigenvalues of others can lose half of
        their digits or more where several nearly coincide (Levin et al., section 12.1).
        """
        if len(self._recurrent) > 1 or not self.is_aperiodic:
            return 0.0
        # Taking the stationary part out turns the eigenvalue 1 into 0; nothing has to be picked out.
        p = self.stationary[0]
        if self.is_irreducible and self.is_reversible():
            root = np.sqrt(p)
            similar = root[:, None] * self.transition / root
            others = np.linalg.eigvalsh(0.5 * (similar + similar.T) - np.outer(root, root))
        else:
            others = np.linalg.eigvals(self.transition - p)
        return max(0.0, 1.0 - float(np.abs(others).max()))

    @property
    def relaxation_time(self) -> float:
        """Inverse of the spectral gap, in steps; infinite where that is zero."""
        return 1.0 / self.spectral_gap if self.spectral_gap else math.inf

    def mixing_time(self, eps: float = 0.25) -> float:
        """Steps after which every start is within ``eps`` of the stationary law.

        The smallest t at which the total variation distance of every row of ``transition**t`` from
        the stationary law is at most ``eps`` (Levin et al., section 4.5); infinite for a periodic
        chain that never gets there. Found by squaring the matrix, then by bisection: rounding
        moves it beyond about 1e7 steps only.

        Parameters
        ----------
        eps : float
            At least 1e-12, below 1.

        Raises
        ------
        ParameterError
            For another ``eps``.
        UnsupportedError
            Where there is no single stationary law, or none is near within 2**50 steps.
        """
        checks.check_eps("mixing_time", eps, _NEAREST)
        law = self._only_law("mixing_time")
        reach = eps * (1.0 + _TIE) + _ROUNDING
        if reach < 1.0 - 1.0 / self.period:
            return math.inf  # the law stays on one of the cyclic classes in turn

        def near(power: np.ndarray) -> bool:
            return total_variation(power, law).max() <= reach

        power = np.eye(len(law))
        if near(power):
            return 0
        doublings = [self.transition]
        while not near(doublings[-1]):
            if 2 ** len(doublings) > _LONGEST:
                raise UnsupportedError(
                    f"mixing_time({eps}): above {_LONGEST:.0e} steps, too many to be told from "
                    "rounding errors; use relaxation_time or mixing_time_bounds"
                )
            doublings.append(arrays.squared(doublings[-1]))
        steps = 0
        for k in reversed(range(len(doublings) - 1)):
            further = arrays.rows_normalised(power @ doublings[k])
            if not near(further):
                steps, power = steps + 2**k, further
        return steps + 1

    def mixing_time_bounds(self, eps: float = 0.25) -> tuple[float, float]:
        """Bounds of ``mixing_time(eps)`` from the spectral gap of a reversible chain.

        With relaxation time t, the lower one is ``(t - 1) log(1 / (2 eps))`` and the upper one
        ``t (log(1 / p) / 2 + log(1 / (2 eps)))`` rounded up, p being the smallest stationary
        probability. Both are infinite for a periodic chain and ``eps`` below a half.

        Parameters
        ----------
        eps : float
            Between 0 and 1, both excluded.

        Raises
        ------
        UnsupportedError
            Where the chain is reducible, or not reversible.

        References
        ----------
        Levin, Peres and Wilmer, 2017, theorems 12.5 (lower) and 12.4 (upper).
        """
        checks.check_eps("mixing_time_bounds", eps)
        law = self._only_law("mixing_time_bounds")
        balance = self.detailed_balance()
        if not (self.is_irreducible and balance):
            i, j = balance.states
            fault = f"{i!r} to {j!r} is not balanced" if not balance else "it is reducible"
            raise UnsupportedError(
                f"mixing_time_bounds({eps}): the bounds are for irreducible reversible chains, and "
                f"{fault}; mixing_time finds the time itself"
            )
        t, further = self.relaxation_time, math.log(0.5 / eps)
        lower = (t - 1.0) * further if further > 0 and t > 1 else 0.0
        nats = max(0.0, -0.5 * math.log(law.min()) + further)
        upper = t * nats if math.isfinite(t) else math.inf
        return lower, upper if math.isinf(upper) else max(0, math.ceil(upper))

    def step(self, law: Any, n: int = 1) -> np.ndarray:
        """The law after ``n`` steps, of the same shape as ``law``.

        Parameters
        ----------
        law : array_like, shape (..., K)
            One or more distributions over the states.
        n : int
            Number of steps, 0 or more.

        Examples
        --------
        >>> chain = MarkovChain([[0.5, 0.5], [0.0, 1.0]])
        >>> chain.step([1.0, 0.0], n=3).tolist()
        [0.125, 0.875]
        """
        p = self._law(law, "step")
        steps = checks.whole_number(f"step(n={n!r})", n)
        if steps <= len(self.states):
            for _ in range(steps):
                p = p @ self.transition
            return np.array(p)
        power = self.transition
        while steps:
            if steps % 2:
                p = p @ power
            steps //= 2
            power = arrays.squared(power) if steps else power
        return p

    def simulate(self, start: Any, steps: int, rng: Any = None) -> np.ndarray:
        """One path of the chain, as positions of its states.

        Parameters
        ----------
        start : state, or array_like of shape (K,)
            The label of the first state, or a law that it is drawn from.
        steps : int
            Number of transitions.
        rng : seed, Generator or None
            As ``numpy.random.default_rng`` takes it.

        Returns
        -------
        ndarray of int, shape (steps + 1,)
            The start first; ``chain.states[k]`` is the label of position k.
        """
        generator = np.random.default_rng(rng)
        count = checks.whole_number(f"simulate(steps={steps!r})", steps)
        cumulative = [arrays.cumulative(row) for row in self.transition]
        uniforms = generator.random(count + 1).tolist()
        try:
            at = self._position(start, "simulate")
        except StateError:
            if np.ndim(start) != 1 or len(start) != len(self.states):
                raise
            law = self._law(start, "simulate", ndim=1)
            at = bisect_right(arrays.cumulative(law), uniforms[0])
        path = [at]
        for u in uniforms[1:]:
            at = bisect_right(cumulative[at], u)
            path.append(at)
        return np.array(path)

    def hitting_times(self, target: Any) -> np.ndarray:
        """Expected number of steps from each state until a target state is met, shape (K,).

        Zero on the target, infinite where it may be missed for ever.

        Parameters
        ----------
        target : state, or a list, set or array of states
            Labels; a tuple that is itself a label is one state.

        Notes
        -----
        The system ``h = 1 + P h`` off the target (Levin et al., section 10.2) is solved without
        subtractions, like ``stationary``.

        Examples
        --------
        >>> walk = MarkovChain([[1, 0, 0], [0.5, 0, 0.5], [0, 1, 0]])
        >>> walk.hitting_times(0).tolist()
        [0.0, 3.0, 4.0]
        """
        hit = np.zeros(len(self.states), dtype=bool)
        hit[self._several(target)] = True
        possible = (self.transition > 0) & ~hit[:, None]
        lost = ~arrays.reaching(possible, hit)
        missing = arrays.reaching(possible, lost)
        times = np.where(missing, math.inf, 0.0)
        open_ = np.flatnonzero(~missing & ~hit)
        if len(open_):
            inner = self.transition[np.ix_(open_, open_)]
            leaving = self.transition[open_][:, hit].sum(axis=1)
            times[open_] = arrays.absorption_times(inner, leaving)
        return times

    def graph(self) -> networkx.DiGraph:
        """The transition diagram: labels as nodes, ``weight`` the probability of each possible step.

        Nodes have the attribute ``recurrent``.
        """
        import networkx

        graph = networkx.DiGraph()
        recurrent = {s: c.recurrent for c in self.classes for s in c.states}
        graph.add_nodes_from((state, {"recurrent": recurrent[state]}) for state in self.states)
        for i, j in np.argwhere(self.transition > 0):
            graph.add_edge(self.states[i], self.states[j], weight=float(self.transition[i, j]))
        return graph

    def __repr__(self) -> str:
        kind = f"{len(self._recurrent)} recurrent of {len(self.classes)} classes"
        kind = "irreducible" if self.is_irreducible else kind
        count = f"{len(self.states)} state{'s' if len(self.states) > 1 else ''}"
        return f"MarkovChain({count}, {kind}, period {self.period})"

    @cached_property
    def _recurrent(self) -> tuple[CommunicatingClass, ...]:
        return tuple(c for c in self.classes if c.recurrent)

    @cached_property
    def _positions(self) -> dict[Hashable, int]:
        return {state: k for k, state in enumerate(self.states)}

    def _class(self, possible: np.ndarray, positions: np.ndarray) -> CommunicatingClass:
        inside = possible[np.ix_(positions, positions)]
        closed = possible[positions].sum() == inside.sum()
        labels = tuple(self.states[k] for k in positions)
        where = tuple(positions.tolist())
        return CommunicatingClass(labels, where, bool(closed), arrays.period(inside))

    def _law(self, law: Any, call: str, ndim: int | None = None) -> np.ndarray:
        return checks.law_array(law, len(self.states), call, ndim)

    def _only_law(self, call: str) -> np.ndarray:
        if len(self._recurrent) > 1:
            raise UnsupportedError(
                f"{call}: the chain has {len(self._recurrent)} recurrent classes, so where it settles "
                "depends on the start; ask it of the chain on one of them"
            )
        return self.stationary[0]

    def _position(self, state: Any, call: str) -> int:
        try:
            return self._positions[state]
        except (KeyError, TypeError):  # TypeError: cannot be hashed
            raise StateError(
                f"{call}: {state!r} is not a state of the chain; its states are "
                f"{checks.shortened(self.states)}"
            ) from None

    def _several(self, target: Any) -> list[int]:
        call = "hitting_times(target)"
        try:
            return [self._position(target, call)]
        except StateError:
            if not isinstance(target, (list, tuple, set, frozenset, np.ndarray)):
                raise
        positions = [self._position(state, call) for state in target]
        if not positions:
            raise StateError(f"{call}: it is empty; name at least one state")
        return positions
