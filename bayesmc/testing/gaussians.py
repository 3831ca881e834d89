"""Random conditional-Gaussian nets, each with the answer that needs no engine.

A net is made twice from the same random choices: as a ``BayesNet``, in the many ways in which people
write means and scales (gathers, ``np.where``, arithmetic, ``np.matvec``, plates), and as plain arrays of
intercepts, coefficients and covariances per configuration of the discrete parents. The second form is
answered by brute force: every joint state of the discrete elements, each with one dense Gaussian over all
continuous scalars, conditioned by one linear solve. It shares no code with distributions, tracing or
elimination; evidence on hidden nodes of other families is left to ``enumerate_posterior``.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Bernoulli, Categorical, MvNormal, Normal
from bayesmc.errors import UnknownNodeError, UnsupportedError, ZeroProbabilityError
from bayesmc.network import BayesNet, Model, pose
from bayesmc.plates import stack
from bayesmc.testing.choices import Choices, seeded
from bayesmc.testing.observing import random_evidence

#: one element of a discrete node; one component of one element of a continuous node
Variable = tuple[str, int]
Scalar = tuple[str, int, int]

_LABELS = ("no", "yes", "maybe", "never")
_NUMBERS = (-1.0, 0.5, 2.0, 3.5)


@dataclass(frozen=True)
class GaussianOptions:
    """What a random conditional-Gaussian net may hold.

    Attributes
    ----------
    nodes : (int, int)
        Fewest and most nodes.
    states : int
        Most states of a discrete node, 2 to 4.
    terms : int
        Most terms in the mean of a continuous scalar.
    discrete : float
        Share of discrete nodes.
    plates : bool
        Up to two plates of size 2 or 3.
    vectors : bool
        Vector nodes of length 2 or 3.
    deterministic : bool
        Deterministic nodes: affine ones, and indicators of discrete parents.
    zeros : bool
        Probabilities of zero.
    configurations, scalars : int
        Bounds on the joint states of all discrete elements, and on continuous scalars.
    """

    nodes: tuple[int, int] = (3, 9)
    states: int = 3
    terms: int = 3
    discrete: float = 0.4
    plates: bool = False
    vectors: bool = False
    deterministic: bool = True
    zeros: bool = True
    configurations: int = 512
    scalars: int = 24

    def __post_init__(self) -> None:
        low, high = self.nodes
        if not 1 <= low <= high:
            raise ValueError(f"nodes={self.nodes}: give (fewest, most) with 1 <= fewest <= most")
        if not 2 <= self.states <= len(_LABELS):
            raise ValueError(f"states={self.states}: give 2 to {len(_LABELS)}")
        if not 0.0 <= self.discrete <= 1.0:
            raise ValueError(f"discrete={self.discrete}: give a share between 0 and 1")
        if min(self.configurations, self.scalars, self.terms) < 1:
            raise ValueError("configurations, scalars and terms are at least 1")


def random_gaussian_net(rng: Any, **options: Any) -> tuple[BayesNet, ConditionalGaussian]:
    """A random conditional-Gaussian net, and the same net as plain arrays.

    Parameters
    ----------
    rng : seed or Generator
        The same seed gives the same net.
    **options
        Fields of `GaussianOptions`.

    Returns
    -------
    BayesNet
        Its ``name`` says what the nodes are.
    ConditionalGaussian
        Its ``posterior(evidence)`` is the exact answer.

    References
    ----------
    Lauritzen (1992), Propagation of probabilities, means and variances in mixed graphical association
    models, JASA 87.

    Examples
    --------
    >>> from bayesmc.testing import gaussian_evidence, random_gaussian_net
    >>> net, plain = random_gaussian_net(4)
    >>> answer = plain.posterior(gaussian_evidence(net, 0))
    >>> bool(abs(answer.weights.sum() - 1) < 1e-12)
    True
    """
    builder = _Builder(seeded(np.random.default_rng(rng)), GaussianOptions(**options))
    builder.build()
    return builder.net, builder.plain()


def gaussian_evidence(net: BayesNet, rng: Any, chance: float = 0.4) -> dict[str, Any]:
    """Possible evidence: some nodes of one joint draw, plated ones also in part, vectors whole.

    Parameters
    ----------
    net : BayesNet
    rng : seed or Generator
    chance : float
        Of a node to be seen.

    Examples
    --------
    >>> from bayesmc.testing import gaussian_evidence, random_gaussian_net
    >>> net, _ = random_gaussian_net(4)
    >>> set(gaussian_evidence(net, 0)) <= set(net)
    True
    """
    evidence = random_evidence(net, rng, chance)
    for name, value in list(evidence.items()):
        if net[name].event_shape:
            missing = np.isnan(value).any(axis=-1, keepdims=True)
            evidence[name] = np.where(missing, np.nan, value)
            if missing.all():
                del evidence[name]
    return evidence


# ---- the plain form, and its answer ---------------------------------------------------------------


@dataclass(frozen=True)
class PlainNode:
    """What is known of a node by name: its axes, and the user values of a discrete one."""

    name: str
    plates: tuple[str, ...] = ()
    plate_shape: tuple[int, ...] = ()
    event_shape: tuple[int, ...] = ()
    states: tuple[Any, ...] | None = None

    @property
    def elements(self) -> int:
        """Number of plate elements."""
        return math.prod(self.plate_shape)


@dataclass(frozen=True, eq=False)
class DiscretePart:
    """One discrete element: ``table`` has shape ``(*cards of scope, card)``."""

    variable: Variable
    scope: tuple[Variable, ...]
    table: np.ndarray


@dataclass(frozen=True, eq=False)
class GaussianPart:
    """d continuous scalars: normal, affine in p others, by the states of ``scope``.

    ``intercept`` has shape ``(*cards, d)``, ``coefficients`` ``(*cards, d, p)`` and ``covariance``
    ``(*cards, d, d)``, all zero where the scalars are computed.
    """

    scalars: tuple[Scalar, ...]
    scope: tuple[Variable, ...]
    parents: tuple[Scalar, ...]
    intercept: np.ndarray
    coefficients: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class ConditionalGaussian:
    """A conditional-Gaussian net as arrays, parents before children.

    Attributes
    ----------
    net : BayesNet
        The same net in words.
    nodes : dict
        Name -> `PlainNode`.
    discrete : tuple of DiscretePart
    gaussian : tuple of GaussianPart
    """

    net: BayesNet
    nodes: dict[str, PlainNode]
    discrete: tuple[DiscretePart, ...]
    gaussian: tuple[GaussianPart, ...]

    def posterior(self, evidence: Mapping[str, Any] | None = None) -> GaussianAnswer:
        """The exact posterior, by enumeration and dense conditioning.

        Parameters
        ----------
        evidence : dict, optional
            As for ``infer``: NaN, None and masked entries are not seen.

        Raises
        ------
        ZeroProbabilityError
            No configuration explains the evidence.
        """
        seen_states, seen = self._read(evidence or {})
        states, log_prior = self._configurations(seen_states)
        mean, cov = self._joint(states)
        index = {scalar: i for i, scalar in enumerate(s for p in self.gaussian for s in p.scalars)}
        at = [index[scalar] for scalar in seen]
        log_density, mean, cov = _condition(mean, cov, at, np.array(list(seen.values())))
        log_weights = log_prior + log_density
        top = log_weights.max()
        total = float(top + np.log(np.exp(log_weights - top).sum()))
        weights = np.exp(log_weights - total)
        model = pose(self.net, {}, None).model
        return GaussianAnswer(model, self.nodes, total, weights, states, index, mean, cov)

    def log_prob(self, values: Mapping[str, Any]) -> float:
        """Log joint density of complete user values, one for every node."""
        states, values_of = self._read(values)
        total = 0.0
        for part in self.discrete:
            at = tuple(states[v] for v in (*part.scope, part.variable))
            with np.errstate(divide="ignore"):
                total += float(np.log(part.table[at]))
        for gaussian in self.gaussian:
            row = tuple(states[v] for v in gaussian.scope)
            above = np.array([values_of[s] for s in gaussian.parents])
            off = np.array([values_of[s] for s in gaussian.scalars]) - gaussian.intercept[row]
            off = off - gaussian.coefficients[row] @ above
            if gaussian.covariance[row].any():
                total += float(_log_normal(off[None], gaussian.covariance[row][None])[0])
            elif np.abs(off).max() > 1e-9:
                return -math.inf
        return total

    def _read(self, given: Mapping[str, Any]) -> tuple[dict[Variable, int], dict[Scalar, float]]:
        """Positions of the discrete elements and values of the scalars that are given."""
        states: dict[Variable, int] = {}
        scalars: dict[Scalar, float] = {}
        for name, value in given.items():
            node = self.nodes[name]
            flat = np.reshape(np.array(value, dtype=object), -1).tolist()
            missing = np.ravel(np.ma.getmaskarray(value)).tolist()
            length = math.prod(node.event_shape)
            for place, (one, masked) in enumerate(zip(flat, missing, strict=True)):
                if masked or one is None or (isinstance(one, float) and math.isnan(one)):
                    continue
                if node.states is not None:
                    states[name, place] = node.states.index(one)
                else:
                    scalars[name, place // length, place % length] = float(one)
        return states, scalars

    def _configurations(
        self, seen: Mapping[Variable, int]
    ) -> tuple[dict[Variable, np.ndarray], np.ndarray]:
        """All possible joint states that agree with what is seen, with their log probabilities."""
        options = [
            [seen[p.variable]] if p.variable in seen else range(p.table.shape[-1])
            for p in self.discrete
        ]
        rows = list(itertools.product(*options))
        grid = np.array(rows, dtype=int).reshape(len(rows), len(options))
        states = {p.variable: grid[:, i] for i, p in enumerate(self.discrete)}
        prior = np.ones(len(grid))
        for part in self.discrete:
            prior = prior * part.table[tuple(states[v] for v in (*part.scope, part.variable))]
        possible = prior > 0
        if not possible.any():
            raise ZeroProbabilityError("ConditionalGaussian: the evidence has probability zero")
        return {v: s[possible] for v, s in states.items()}, np.log(prior[possible])

    def _joint(self, states: Mapping[Variable, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Prior means ``(C, n)`` and covariances ``(C, n, n)`` of all scalars by configuration."""
        count = len(next(iter(states.values()))) if states else 1
        total = sum(len(part.scalars) for part in self.gaussian)
        mean, cov = np.zeros((count, total)), np.zeros((count, total, total))
        index: dict[Scalar, int] = {}
        for part in self.gaussian:
            at, end = len(index), len(index) + len(part.scalars)
            row = tuple(states[v] for v in part.scope)
            above = [index[s] for s in part.parents]
            matrix = part.coefficients[row]
            mean[:, at:end] = part.intercept[row]
            mean[:, at:end] += np.matvec(matrix, mean[:, above])
            across = matrix @ cov[:, above, :at]
            cov[:, at:end, :at] = across
            cov[:, :at, at:end] = np.matrix_transpose(across)
            cov[:, at:end, at:end] = across[:, :, above] @ np.matrix_transpose(matrix)
            cov[:, at:end, at:end] += part.covariance[row]
            index.update((scalar, at + k) for k, scalar in enumerate(part.scalars))
        return mean, cov


@dataclass(frozen=True, eq=False)
class GaussianAnswer:
    """A posterior as a list of configurations, each with its weight and one dense Gaussian.

    Attributes
    ----------
    model : Model
        Of the net that was asked.
    nodes : dict
    log_marginal_likelihood : float
        Log probability (density) of the evidence.
    weights : ndarray, shape (configurations,)
        They sum to 1.
    states : dict
        Discrete element -> its position by configuration.
    index : dict
        Continuous scalar -> its place in ``means``.
    means, covs : ndarray, shapes (configurations, n) and (configurations, n, n)
    """

    model: Model
    nodes: dict[str, PlainNode]
    log_marginal_likelihood: float
    weights: np.ndarray
    states: dict[Variable, np.ndarray]
    index: dict[Scalar, int]
    means: np.ndarray
    covs: np.ndarray

    #: what the answer is good to: linear algebra in double precision
    accuracy = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Nodes that can be asked about."""
        return tuple(self.nodes)

    def probabilities(self, *names: str) -> np.ndarray:
        """Probabilities of the states, ``(*plates, states)``, or of several nodes jointly, whose plates
        lead in order of appearance and are shared by name."""
        nodes = [self._node(name) for name in names]
        sizes = {p: n for node in nodes for p, n in zip(node.plates, node.plate_shape, strict=True)}
        cards = tuple(len(_states_of(node)) for node in nodes)
        out = np.zeros((*sizes.values(), *cards))
        for at in np.ndindex(*sizes.values()):
            where = dict(zip(sizes, at, strict=True))
            picked = tuple(self.states[n.name, _element(n, where)] for n in nodes)
            np.add.at(out[at], picked, self.weights)
        return out

    def mean(self, name: str) -> np.ndarray:
        """Posterior mean of a numeric node, shape ``(*plates, *event)``."""
        means, _ = self._moments([name])
        node = self._node(name)
        return (self.weights @ means).reshape(node.plate_shape + node.event_shape)

    def var(self, name: str) -> np.ndarray:
        """Posterior variance of every scalar, shape ``(*plates, *event)``."""
        node = self._node(name)
        return np.diagonal(self._cov([name])).reshape(node.plate_shape + node.event_shape).copy()

    def std(self, name: str) -> np.ndarray:
        """Posterior standard deviation, shape ``(*plates, *event)``."""
        return np.sqrt(np.maximum(self.var(name), 0.0))

    def cov(self, *names: str) -> np.ndarray:
        """Covariance matrix of all scalars of the named nodes, in order; of one scalar, its variance."""
        matrix = self._cov(names)
        return matrix[0, 0] if matrix.size == 1 else matrix

    def mixture(self, *names: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Weights ``(C,)``, means ``(C, n)`` and covariances ``(C, n, n)`` of all scalars of the nodes."""
        return (self.weights, *self._moments(names))

    def density(self, name: str, points: np.ndarray) -> np.ndarray:
        """Marginal density of every scalar at ``points``, shape ``(*points.shape, *plates, *event)``.

        A component without variance counts as zero.
        """
        node = self._node(name)
        means, covs = self._moments([name])
        variances = np.diagonal(covs, axis1=1, axis2=2)
        points = np.asarray(points, dtype=float)[..., None, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = -0.5 * ((points - means) ** 2 / variances + np.log(2 * np.pi * variances))
            parts = np.where(variances > 0, np.exp(logs), 0.0)
        density = (parts * self.weights[:, None]).sum(axis=-2)
        return density.reshape(points.shape[:-2] + node.plate_shape + node.event_shape)

    def _moments(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Means and covariances by configuration; a discrete node's number has no variance there."""
        columns, places = [], []
        for node in map(self._node, names):
            for element in range(node.elements):
                if node.states is not None:
                    numbers = np.array(node.states, dtype=float)
                    columns.append(numbers[self.states[node.name, element]])
                    places.append(-1)
                    continue
                for k in range(math.prod(node.event_shape)):
                    places.append(self.index[node.name, element, k])
                    columns.append(self.means[:, places[-1]])
        smooth = np.array(places) >= 0
        covs = self.covs[:, places][:, :, places] * (smooth[:, None] & smooth)
        return np.stack(columns, axis=-1), covs

    def _cov(self, names: Sequence[str]) -> np.ndarray:
        means, covs = self._moments(names)
        off = means - self.weights @ means
        return np.tensordot(self.weights, covs, axes=1) + (self.weights[:, None] * off).T @ off

    def _node(self, name: str) -> PlainNode:
        if name not in self.nodes:
            raise UnknownNodeError(f"GaussianAnswer: no node {name!r}; ask {', '.join(self.nodes)}")
        return self.nodes[name]


def _condition(
    mean: np.ndarray, cov: np.ndarray, at: list[int], values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log density of the seen scalars, and the moments of all given them, by configuration."""
    if not at:
        return np.zeros(len(mean)), mean, cov
    across = cov[:, at]
    block = across[:, :, at]
    gain = np.linalg.solve(block, across)
    off = values - mean[:, at]
    log_density = _log_normal(off, block)
    mean = mean + np.vecmat(off, gain)
    cov = cov - np.matrix_transpose(across) @ gain
    mean[:, at] = values
    cov[:, at] = 0.0
    cov[:, :, at] = 0.0
    return log_density, mean, 0.5 * (cov + np.matrix_transpose(cov))


def _log_normal(off: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Log density of centred normals, ``(C, d)`` under ``(C, d, d)``."""
    distance = np.vecdot(off, np.linalg.solve(cov, off[..., None])[..., 0])
    return -0.5 * (distance + np.linalg.slogdet(2 * np.pi * cov)[1])


def _states_of(node: PlainNode) -> tuple[Any, ...]:
    if node.states is None:
        raise UnsupportedError(f"probabilities({node.name!r}): the node is continuous")
    return node.states


def _element(node: PlainNode, at: Mapping[str, int]) -> int:
    """Position of a node's element in a plate configuration that may have more plates."""
    own = tuple(at[p] for p in node.plates)
    return int(np.ravel_multi_index(own, node.plate_shape)) if own else 0


# ---- building both forms --------------------------------------------------------------------------

At = Mapping[str, int]
States = Callable[[Variable], int]
Arguments = Mapping[str, Any]


@dataclass(frozen=True)
class _Affine:
    """A number (or a vector) that is affine in continuous scalars; all parts have one shape."""

    constant: Any
    slopes: dict[Scalar, Any]

    def __add__(self, other: _Affine) -> _Affine:
        keys = dict.fromkeys([*self.slopes, *other.slopes])
        slopes = {k: self.slopes.get(k, 0.0) + other.slopes.get(k, 0.0) for k in keys}
        return _Affine(self.constant + other.constant, slopes)

    def map(self, linear: Callable[[Any], Any]) -> _Affine:
        return _Affine(linear(self.constant), {k: linear(v) for k, v in self.slopes.items()})


@dataclass(frozen=True)
class _Expression:
    """One expression in both forms: what a function computes from its arguments, and what that is at one
    plate element and one joint state of the discrete elements."""

    names: tuple[str, ...]
    call: Callable[[Arguments], Any]
    plain: Callable[[At, States], Any]


@dataclass(frozen=True)
class _Known:
    """What later nodes need to know of an earlier one: ``length`` is 0 for a scalar."""

    node: PlainNode
    length: int = 0

    @property
    def name(self) -> str:
        return self.node.name

    @property
    def states(self) -> tuple[Any, ...]:
        return self.node.states or ()

    @property
    def card(self) -> int:
        return len(self.states)

    @property
    def is_number(self) -> bool:
        return not isinstance(self.states[0], str)

    @property
    def is_position(self) -> bool:
        """Whether functions receive it as a position or a label, which picks rows of constant arrays."""
        return not self.is_number or self.states == tuple(range(self.card))

    def foreign(self, plates: Sequence[str]) -> list[str]:
        return [p for p in self.node.plates if p not in plates]


class _Builder:
    """A net in the making, in both forms."""

    def __init__(self, choices: Choices, options: GaussianOptions) -> None:
        self.choices = choices
        self.options = options
        self.sizes: dict[str, int] = {}
        if options.plates:
            self.sizes = {p: choices.integer(2, 3) for p in ("k", "n")[: choices.integer(1, 2)]}
        self.net = BayesNet("", plates=dict(self.sizes))
        self.known: list[_Known] = []
        self.discrete: list[DiscretePart] = []
        self.gaussian: list[GaussianPart] = []
        self.configurations = 1
        self.scalars = 0

    def build(self) -> None:
        fewest, most = self.options.nodes
        story = []
        for number in range(self.choices.integer(fewest, most)):
            if number and self.scalars >= self.options.scalars:
                break
            name, plates = f"v{number}", self._plates()
            if self.choices.flag(self.options.discrete):
                what = self._discrete(name, plates)
            else:
                what = self._continuous(name, plates)
            story.append(f"{name}[{','.join(self.net[name].plates)}]: {what}")
        self.net.name = "; ".join(story)

    def plain(self) -> ConditionalGaussian:
        nodes = {k.name: k.node for k in self.known}
        return ConditionalGaussian(self.net, nodes, tuple(self.discrete), tuple(self.gaussian))

    # ---- discrete nodes ---------------------------------------------------------------------

    def _discrete(self, name: str, plates: tuple[str, ...]) -> str:
        card = self.choices.integer(2, self.options.states)
        if self.configurations * card ** self._elements(plates) > self.options.configurations:
            card, plates = 2, ()
        if self.configurations * card ** self._elements(plates) > self.options.configurations:
            return self._continuous(name, plates)
        above = [k for k in self.known if k.card]
        kinds = ["table", "rows"] + ["switch"] * (card == 2) * bool(above)
        if self.options.deterministic and any(not k.foreign(plates) for k in above):
            kinds.append("computed")
        kind = self.choices.pick(kinds)
        if kind == "computed":
            return self._computed(name, plates, [k for k in above if not k.foreign(plates)])
        self.configurations *= card ** self._elements(plates)
        if kind == "switch":
            chance = self._switch(self._some(above, 1), plates, 0.05, 0.95)
            states = self._states(2)
            self._declare(name, lambda v: Bernoulli(chance.call(v)), chance.names, plates, states)
            known = self._know(name, plates, states=states or (0, 1))
            self._add_discrete(known, lambda at, s: _pair(chance.plain(at, s)))
            return f"switch({', '.join(chance.names)})"
        inside = [k for k in above if k.is_position and not k.foreign(plates)]
        chosen = self._some(
            inside if kind == "rows" else [k for k in above if not k.foreign(plates)]
        )
        cards = [k.card for k in chosen]
        table = self.choices.rows(math.prod(cards), card, self.options.zeros).reshape(*cards, card)
        states, names = self._states(card), tuple(k.name for k in chosen)
        if kind == "table":
            self.net.table(name, list(names), table, states, plates=plates)
        else:
            pick = lambda v: Categorical(table[tuple(v[n] for n in names)])  # noqa: E731
            self._declare(name, pick, names, plates, states)
        known = self._know(name, plates, states=states or tuple(range(card)))
        self._add_discrete(known, lambda at, s: table[tuple(_at(k, at, s) for k in chosen)])
        return f"{kind}({', '.join(names)})"

    def _computed(self, name: str, plates: tuple[str, ...], above: list[_Known]) -> str:
        """A deterministic node of one discrete parent: which states it has, or finds for itself."""
        a = self.choices.pick(above)
        if a.is_position and self.choices.flag():
            steps = np.cumsum(self.choices.reals(0.5, 1.5, (a.card,)))
            numbers = steps * self.choices.pick((1.0, -1.0))
            self._declare(name, lambda v: numbers[v[a.name]], (a.name,), plates)
            found = np.sort(numbers)  # the net takes the distinct values in their order
            unit = np.eye(a.card)[np.searchsorted(found, numbers)]
            known = self._know(name, plates, states=tuple(found.tolist()))
        else:
            position = self.choices.integer(0, a.card - 1)
            value = a.states[position]
            states = self._states(2) or (0, 1)
            here = lambda v: np.where(v[a.name] == value, 1, 0)  # noqa: E731
            self._declare(name, here, (a.name,), plates, states)
            unit = np.eye(2)[(np.arange(a.card) == position).astype(int)]
            known = self._know(name, plates, states=states)
        self._add_discrete(known, lambda at, s: unit[_at(a, at, s)])
        return f"computed({a.name})"

    def _add_discrete(self, known: _Known, row: Callable[[At, States], np.ndarray]) -> None:
        for element, at in self._each(known.node):
            scope, tables = self._table(lambda s, at=at: (row(at, s),))  # type: ignore[misc]
            self.discrete.append(DiscretePart((known.name, element), scope, tables[0]))

    # ---- continuous nodes -------------------------------------------------------------------

    def _continuous(self, name: str, plates: tuple[str, ...]) -> str:
        length = 0
        if self.options.vectors and self.choices.flag(0.4):
            length = self.choices.integer(2, 3)
        if self.scalars + max(length, 1) * self._elements(plates) > self.options.scalars:
            length, plates = 0, ()
        self.scalars += max(length, 1) * self._elements(plates)
        mean = self._vector(plates, length) if length else self._score(plates)
        above = [k for k in self.known if k.name in mean.names]
        # a number computed from discrete parents alone is discrete itself
        is_smooth = bool(length) or any(not k.card or k.foreign(plates) for k in above)
        if above and is_smooth and self.options.deterministic and self.choices.flag(0.25):
            self._declare(name, mean.call, mean.names, plates)
            known = self._know(name, plates, length)
            self._add_gaussian(known, mean, lambda at, s: np.zeros((max(length, 1),) * 2))
            return f"deterministic({', '.join(mean.names)})"
        if length:
            noise, covariance = self._covariance(plates, length)
            make: Callable[[Arguments], Any] = lambda v: MvNormal(mean.call(v), **noise.call(v))  # noqa: E731
        else:
            noise = self._scale(plates)
            covariance = lambda at, s: np.array([[noise.plain(at, s) ** 2]])  # noqa: E731
            make = lambda v: Normal(mean.call(v), noise.call(v))  # noqa: E731
        names = tuple(dict.fromkeys([*mean.names, *noise.names]))
        self._declare(name, make, names, plates)
        self._add_gaussian(self._know(name, plates, length), mean, covariance)
        return f"{'vector' if length else 'normal'}({', '.join(names)})"

    def _add_gaussian(
        self, known: _Known, mean: _Expression, covariance: Callable[[At, States], np.ndarray]
    ) -> None:
        d = max(known.length, 1)
        for element, at in self._each(known.node):
            scalars: dict[Scalar, None] = {}

            def row(
                s: States, at: At = at, scalars: dict[Scalar, None] = scalars
            ) -> tuple[np.ndarray, dict[Scalar, Any], np.ndarray]:
                value = mean.plain(at, s)
                scalars.update(dict.fromkeys(value.slopes))
                return np.broadcast_to(value.constant, d), value.slopes, covariance(at, s)

            self._table(row)  # a first pass, to know all scalars that any configuration reads
            parents = tuple(scalars)

            def full(
                s: States, row: Any = row, parents: Any = parents
            ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
                constant, slopes, noise = row(s)
                columns = [np.broadcast_to(slopes.get(p, 0.0), d) for p in parents]
                return constant, np.reshape(columns, (len(parents), d)).T, noise

            scope, arrays = self._table(full)
            own = tuple((known.name, element, k) for k in range(d))
            self.gaussian.append(GaussianPart(own, scope, parents, *arrays))

    def _score(self, plates: tuple[str, ...]) -> _Expression:
        """A sum of terms, and a constant that may differ by plate element."""
        count = self.choices.integer(0, self.options.terms) if self.known else 0
        return self._sum([self._constant(plates), *(self._term(plates) for _ in range(count))])

    def _term(self, plates: tuple[str, ...]) -> _Expression:
        smooth = [k for k in self.known if not k.card]
        finite = [k for k in self.known if k.card]
        if not smooth or (finite and self.choices.flag(0.2)):
            return _lifted(self._switch(self._some(finite, 1), plates, -2.0, 2.0))
        x = self._reading(self.choices.pick(smooth), plates)
        w, c = self.choices.real(-1.5, 1.5), self.choices.real(-1.0, 1.0)
        inside = [k for k in finite if not k.foreign(plates)]
        kind = self.choices.pick(
            ["weight", "arithmetic"] + ["switched", "branch", "choice"] * bool(inside)
        )
        if kind == "weight":
            return _Expression(x.names, lambda v: w * x.call(v), _mapped(x, lambda y: w * y))
        if kind == "arithmetic":
            call = lambda v: -(x.call(v) - c) / 2  # noqa: E731
            half = _mapped(x, lambda y: -y / 2)
            return _Expression(x.names, call, lambda at, s: half(at, s) + _Affine(c / 2, {}))
        if kind == "switched":
            return _product(self._switch(self._some(inside, 1), plates, -1.5, 1.5), x, operator.mul)
        return self._branch(x, self.choices.pick(inside), plates, both=kind == "choice")

    def _branch(
        self, x: _Expression, a: _Known, plates: tuple[str, ...], both: bool
    ) -> _Expression:
        """``np.where(a == value, w * x, -y + c)``, where ``y`` is another reading, or ``x`` itself."""
        other = self._reading(self.choices.pick([k for k in self.known if not k.card]), plates)
        y = other if both else x
        w, c = self.choices.real(-1.5, 1.5), self.choices.real(-1.0, 1.0)
        position = self.choices.integer(0, a.card - 1)
        value = a.states[position]

        def plain(at: At, s: States) -> _Affine:
            yes = x.plain(at, s).map(lambda u: w * u)
            no = y.plain(at, s).map(lambda u: -u) + _Affine(c, {})
            return yes if _at(a, at, s) == position else no

        call = lambda v: np.where(v[a.name] == value, w * x.call(v), -y.call(v) + c)  # noqa: E731
        return _Expression((*x.names, *y.names, a.name), call, plain)

    def _scale(self, plates: tuple[str, ...]) -> _Expression:
        finite = [k for k in self.known if k.card]
        if finite and self.choices.flag(0.6):
            return self._switch(self._some(finite, 1), plates, 0.5, 2.0)
        array = self._array(plates, 0.5, 2.0)
        return _Expression((), lambda v: array, lambda at, s: _entry(array, plates, at))

    # ---- vectors ----------------------------------------------------------------------------

    def _vector(self, plates: tuple[str, ...], d: int) -> _Expression:
        """A mean of length ``d``."""
        vectors = [k for k in self.known if k.length]
        inside = [k for k in self.known if k.card and k.is_position and not k.foreign(plates)]
        equal = [k for k in vectors if k.length == d]
        smooth = [k for k in self.known if not k.card]
        kinds = ["stack", "rows"] + ["matrix", "matrix", "moved"] * bool(smooth)
        kind = self.choices.pick(kinds + ["branch"] * bool(equal and inside))
        if kind == "stack":
            return _stacked([self._score(plates) for _ in range(d)])
        a = self.choices.pick(inside) if inside and self.choices.flag(0.6) else None
        if kind == "rows":
            rows = self._rows(a, -1.5, 1.5, (d,))
            return _lifted(rows)
        if kind == "branch":
            return self._vector_branch(self.choices.pick(equal), self.choices.pick(inside), plates)
        if vectors and self.choices.flag(0.75):
            parent = self.choices.pick(vectors)
            x, length = self._whole(parent, plates), parent.length
        else:
            length = self.choices.integer(2, 3)
            x = _stacked([self._reading(self.choices.pick(smooth), plates) for _ in range(length)])
        matrix = self._rows(a, -1.0, 1.0, (d, length))
        moved = _product(matrix, x, np.matvec)
        if kind == "matrix":
            return moved
        offset = self._rows(None, -1.0, 1.0, (d,))
        return self._sum([moved, _lifted(offset)])

    def _vector_branch(self, x: _Known, a: _Known, plates: tuple[str, ...]) -> _Expression:
        """``np.where((a == value)[..., None], x, w * x + b)``."""
        whole, w = self._whole(x, plates), self.choices.real(-1.0, 1.0)
        b = self.choices.reals(-1.0, 1.0, (x.length,))
        position = self.choices.integer(0, a.card - 1)
        value = a.states[position]

        def call(v: Arguments) -> Any:
            u = whole.call(v)
            return np.where((v[a.name] == value)[..., None], u, w * u + b)

        def plain(at: At, s: States) -> _Affine:
            u = whole.plain(at, s)
            return u if _at(a, at, s) == position else u.map(lambda y: w * y) + _Affine(b, {})

        return _Expression((*whole.names, a.name), call, plain)

    def _covariance(
        self, plates: tuple[str, ...], d: int
    ) -> tuple[_Expression, Callable[[At, States], np.ndarray]]:
        """What `MvNormal` is given beside the mean, and the covariance that this is."""
        inside = [k for k in self.known if k.card and k.is_position and not k.foreign(plates)]
        a = self.choices.pick(inside) if inside and self.choices.flag() else None
        kind = self.choices.pick(["scale_diag", "cov", "scale_tril"])
        count = a.card if a else 1
        diagonal = self.choices.reals(0.5, 1.5, (count, d))
        tril = np.tril(self.choices.reals(-0.75, 0.75, (count, d, d)), -1) * (kind != "scale_diag")
        tril[:, range(d), range(d)] = diagonal
        covs = tril @ np.matrix_transpose(tril)
        given = {"scale_diag": diagonal, "cov": covs, "scale_tril": tril}[kind]
        names = (a.name,) if a else ()
        noise = _Expression(
            names, lambda v: {kind: given[v[a.name]] if a else given[0]}, lambda at, s: None
        )
        return noise, lambda at, s: covs[_at(a, at, s) if a else 0]

    # ---- readings of parents ----------------------------------------------------------------

    def _reading(self, known: _Known, plates: tuple[str, ...]) -> _Expression:
        """One number of a continuous parent."""
        whole = self._whole(known, plates)
        if not known.length:
            return whole
        if self.choices.flag():
            k = self.choices.integer(0, known.length - 1)
            return _Expression(
                whole.names, lambda v: whole.call(v)[..., k], _mapped(whole, lambda u: u[k])
            )
        w = self.choices.reals(-1.0, 1.0, (known.length,))
        return _Expression(
            whole.names,
            lambda v: np.vecdot(whole.call(v), w),
            _mapped(whole, lambda u: float(w @ u)),
        )

    def _whole(self, known: _Known, plates: tuple[str, ...]) -> _Expression:
        """A continuous parent, a foreign plate reduced or gathered."""
        name, foreign = known.name, known.foreign(plates)
        if not foreign:
            return _Expression((name,), lambda v: v[name], lambda at, s: _value(known, at))
        if len(foreign) == 2 or self.choices.flag():
            how = self.choices.pick(("sum", "mean"))
            each = self._places(foreign)
            share = 1.0 if how == "sum" else 1.0 / len(each)

            def reduced(at: At, s: States) -> _Affine:
                parts = [_value(known, {**at, **e}).map(lambda y: share * y) for e in each]
                return sum(parts[1:], parts[0])

            return _Expression((name,), lambda v: getattr(v[name], how)(*foreign), reduced)
        return self._gathered(known, plates, foreign[0])

    def _gathered(self, known: _Known, plates: tuple[str, ...], plate: str) -> _Expression:
        """An element of a foreign plate: by a number, by a constant array, or by a discrete parent."""
        name, size = known.name, self.sizes[plate]
        pickers = [
            k for k in self.known if k.states == tuple(range(size)) and not k.foreign(plates)
        ]
        if pickers and self.choices.flag(0.75):
            a = self.choices.pick(pickers)
            return _Expression(
                (name, a.name),
                lambda v: v[name][v[a.name]],
                lambda at, s: _value(known, {**at, plate: _at(a, at, s)}),
            )
        index = np.array(self.choices.integer(0, size - 1))
        if plates and self.choices.flag():
            shape = tuple(self.sizes[p] for p in plates)
            draws = [self.choices.integer(0, size - 1) for _ in range(math.prod(shape))]
            index = np.reshape(draws, shape)
        given = index if index.ndim else int(index)
        return _Expression(
            (name,),
            lambda v: v[name][given],
            lambda at, s: _value(known, {**at, plate: int(_entry(index, plates, at))}),
        )

    def _switch(
        self, chosen: Sequence[_Known], plates: tuple[str, ...], low: float, high: float
    ) -> _Expression:
        """A number between ``low`` and ``high`` that discrete parents choose."""
        inside = [k for k in chosen if not k.foreign(plates)]
        able = [k for k in inside if k.is_position]
        if len(able) == 2:
            a, b = able
            table = self.choices.reals(low, high, (a.card, b.card))
            return _Expression(
                (a.name, b.name),
                lambda v: table[v[a.name], v[b.name]],
                lambda at, s: float(table[_at(a, at, s), _at(b, at, s)]),
            )
        a = chosen[0]
        foreign = a.foreign(plates)
        position = self.choices.integer(0, a.card - 1)
        value = a.states[position]
        yes, no = self.choices.real(low, high), self.choices.real(low, high)
        if foreign:
            each = self._places(foreign)
            return _Expression(
                (a.name,),
                lambda v: np.where((v[a.name] == value).any(*foreign), yes, no),
                lambda at, s: (
                    yes if max([_at(a, {**at, **e}, s) == position for e in each]) else no
                ),
            )
        kinds = (
            ["where", "indicator"]
            + ["gather"] * a.is_position
            + ["number"] * (a.is_number and low < 0)
        )
        kind = self.choices.pick(kinds)
        if kind == "gather":
            return self._rows(a, low, high, ())
        if kind == "number":
            numbers = a.states
            return _Expression(
                (a.name,), lambda v: yes * v[a.name], lambda at, s: yes * numbers[_at(a, at, s)]
            )
        if kind == "indicator":
            call: Callable[[Arguments], Any] = lambda v: no + (yes - no) * (v[a.name] == value)  # noqa: E731
        else:
            call = lambda v: np.where(v[a.name] == value, yes, no)  # noqa: E731
        return _Expression((a.name,), call, lambda at, s: yes if _at(a, at, s) == position else no)

    def _rows(
        self, a: _Known | None, low: float, high: float, shape: tuple[int, ...]
    ) -> _Expression:
        """A constant array, or a row of one that the parent ``a`` picks."""
        array = self.choices.reals(low, high, (a.card if a else 1, *shape))
        if a is None:
            return _Expression((), lambda v: array[0], lambda at, s: array[0])
        return _Expression(
            (a.name,), lambda v: array[v[a.name]], lambda at, s: array[_at(a, at, s)]
        )

    def _constant(self, plates: tuple[str, ...]) -> _Expression:
        array = self._array(plates, -1.0, 1.0)
        return _Expression(
            (), lambda v: array, lambda at, s: _Affine(_entry(array, plates, at), {})
        )

    def _array(self, plates: tuple[str, ...], low: float, high: float) -> Any:
        """A number, or one for each plate element."""
        if plates and self.choices.flag():
            return self.choices.reals(low, high, tuple(self.sizes[p] for p in plates))
        return self.choices.real(low, high)

    def _sum(self, parts: Sequence[_Expression]) -> _Expression:
        names = tuple(dict.fromkeys(n for part in parts for n in part.names))

        def call(v: Arguments) -> Any:
            total = parts[0].call(v)
            for part in parts[1:]:
                total = total + part.call(v)
            return total

        def plain(at: At, s: States) -> _Affine:
            values = [part.plain(at, s) for part in parts]
            return sum(values[1:], values[0])

        return _Expression(names, call, plain)

    # ---- small parts ------------------------------------------------------------------------

    def _plates(self) -> tuple[str, ...]:
        names = list(self.sizes)
        options: list[tuple[str, ...]] = [(), *((p,) for p in names)]
        if len(names) == 2:
            options += [tuple(names), tuple(names[::-1])]
        return self.choices.pick(options)

    def _elements(self, plates: Sequence[str]) -> int:
        return math.prod(self.sizes[p] for p in plates)

    def _some(self, candidates: Sequence[_Known], at_least: int = 0) -> list[_Known]:
        chosen = [k for k in candidates if self.choices.flag()][:2]
        return chosen if len(chosen) >= at_least else [self.choices.pick(candidates)]

    def _states(self, card: int) -> tuple[Any, ...] | None:
        return self.choices.pick((None, _LABELS[:card], _NUMBERS[:card]))

    def _declare(
        self,
        name: str,
        make: Callable[[Arguments], Any],
        names: Sequence[str],
        plates: tuple[str, ...],
        states: tuple[Any, ...] | None = None,
    ) -> None:
        parents = list(dict.fromkeys(names))
        function = lambda *values: make(dict(zip(parents, values, strict=True)))  # noqa: E731
        self.net.add(name, function, parents=parents, plates=plates, states=states)

    def _know(
        self,
        name: str,
        plates: tuple[str, ...],
        length: int = 0,
        states: tuple[Any, ...] | None = None,
    ) -> _Known:
        shape = tuple(self.sizes[p] for p in plates)
        node = PlainNode(name, plates, shape, (length,) if length else (), states)
        self.known.append(_Known(node, length))
        return self.known[-1]

    def _places(self, plates: Sequence[str]) -> list[dict[str, int]]:
        """Every element of these plates."""
        shape = [self.sizes[p] for p in plates]
        return [dict(zip(plates, at, strict=True)) for at in np.ndindex(*shape)]

    def _each(self, node: PlainNode) -> list[tuple[int, dict[str, int]]]:
        """Every element of a node: its number, and its place in each plate."""
        return list(enumerate(self._places(node.plates)))

    def _table(
        self, row: Callable[[States], tuple[Any, ...]]
    ) -> tuple[tuple[Variable, ...], list[np.ndarray]]:
        """What ``row`` gives at every joint state of the discrete elements that it looks at."""
        scope: dict[Variable, None] = {}
        row(lambda v: scope.setdefault(v) or 0)
        cards = [next(k.card for k in self.known if k.name == name) for name, _ in scope]
        rows = [row(dict(zip(scope, at, strict=True)).__getitem__) for at in np.ndindex(*cards)]
        arrays = [np.array(column) for column in zip(*rows, strict=True)]
        return tuple(scope), [a.reshape((*cards, *a.shape[1:])) for a in arrays]


def _at(known: _Known, at: At, states: States) -> int:
    """Position of a discrete parent's element."""
    return states((known.name, _element(known.node, at)))


def _value(known: _Known, at: At) -> _Affine:
    """A continuous parent's element, as an affine function of its own scalars."""
    element = _element(known.node, at)
    if not known.length:
        return _Affine(0.0, {(known.name, element, 0): 1.0})
    unit = np.eye(known.length)
    slopes = {(known.name, element, k): unit[k] for k in range(known.length)}
    return _Affine(np.zeros(known.length), slopes)


def _product(
    factor: _Expression, x: _Expression, function: Callable[[Any, Any], Any]
) -> _Expression:
    """``function(factor, x)``, linear in ``x``, where discrete parents choose the factor."""

    def plain(at: At, s: States) -> _Affine:
        chosen = factor.plain(at, s)
        return x.plain(at, s).map(lambda u: function(chosen, u))

    names = (*x.names, *factor.names)
    return _Expression(names, lambda v: function(factor.call(v), x.call(v)), plain)


def _mapped(x: _Expression, linear: Callable[[Any], Any]) -> Callable[[At, States], _Affine]:
    return lambda at, s: x.plain(at, s).map(linear)


def _lifted(number: _Expression) -> _Expression:
    """An expression of discrete parents as an affine one."""
    return _Expression(number.names, number.call, lambda at, s: _Affine(number.plain(at, s), {}))


def _stacked(parts: Sequence[_Expression]) -> _Expression:
    """Numbers as a vector."""

    def plain(at: At, s: States) -> _Affine:
        values = [part.plain(at, s) for part in parts]
        keys = dict.fromkeys(k for value in values for k in value.slopes)
        slopes = {k: np.array([value.slopes.get(k, 0.0) for value in values]) for k in keys}
        return _Affine(np.array([value.constant for value in values]), slopes)

    names = tuple(dict.fromkeys(n for part in parts for n in part.names))
    return _Expression(names, lambda v: stack([part.call(v) for part in parts]), plain)


def _entry(array: Any, plates: Sequence[str], at: At) -> float:
    return float(array[tuple(at[p] for p in plates)]) if np.ndim(array) else float(array)


def _pair(chance: float) -> np.ndarray:
    return np.array([1.0 - chance, chance])
