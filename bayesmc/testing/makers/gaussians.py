"""Random conditional-Gaussian nets, each with the answer that needs no engine.

A net is made twice from the same random choices: as a ``BayesNet``, in the many ways in which people
write means and scales, and as plain arrays of intercepts, coefficients and covariances per configuration
of the discrete parents, which are answered by brute force (`conditional_gaussian`). Discrete children of
continuous parents, inputs and potentials are left to tests written by hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.distributions import Bernoulli, Categorical, MvNormal, Normal
from bayesmc.network import BayesNet
from bayesmc.testing.makers.choices import Choices, seeded
from bayesmc.testing.makers.gaussian_terms import (
    Arguments,
    At,
    Expression,
    Known,
    States,
    Terms,
    position_of,
)
from bayesmc.testing.makers.observing import random_evidence
from bayesmc.testing.oracles.conditional_gaussian import (
    ConditionalGaussian,
    DiscretePart,
    GaussianPart,
    PlainNode,
    Scalar,
    Variable,
)

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


# ---- private ------------------------------------------------------------------------------------


class _Builder:
    """A net in the making, in both forms."""

    def __init__(self, choices: Choices, options: GaussianOptions) -> None:
        self.choices = choices
        self.options = options
        self.sizes: dict[str, int] = {}
        if options.plates:
            self.sizes = {p: choices.integer(2, 3) for p in ("k", "n")[: choices.integer(1, 2)]}
        self.net = BayesNet("", plates=dict(self.sizes))
        self.known: list[Known] = []
        self.discrete: list[DiscretePart] = []
        self.gaussian: list[GaussianPart] = []
        self.terms = Terms(choices, self.sizes, self.known, options.terms)
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
            chance = self.terms.switch(self.terms.some(above, 1), plates, 0.05, 0.95)
            states = self._states(2)
            self._declare(name, lambda v: Bernoulli(chance.call(v)), chance.names, plates, states)
            known = self._know(name, plates, states=states or (0, 1))
            self._add_discrete(known, lambda at, s: _pair(chance.plain(at, s)))
            return f"switch({', '.join(chance.names)})"
        inside = [k for k in above if k.is_position and not k.foreign(plates)]
        chosen = self.terms.some(
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
        self._add_discrete(known, lambda at, s: table[tuple(position_of(k, at, s) for k in chosen)])
        return f"{kind}({', '.join(names)})"

    def _computed(self, name: str, plates: tuple[str, ...], above: list[Known]) -> str:
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
        self._add_discrete(known, lambda at, s: unit[position_of(a, at, s)])
        return f"computed({a.name})"

    def _add_discrete(self, known: Known, row: Callable[[At, States], np.ndarray]) -> None:
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
        mean = self.terms.vector(plates, length) if length else self.terms.score(plates)
        above = [k for k in self.known if k.name in mean.names]
        # a number computed from discrete parents alone is discrete itself
        is_smooth = bool(length) or any(not k.card or k.foreign(plates) for k in above)
        if above and is_smooth and self.options.deterministic and self.choices.flag(0.25):
            self._declare(name, mean.call, mean.names, plates)
            known = self._know(name, plates, length)
            self._add_gaussian(known, mean, lambda at, s: np.zeros((max(length, 1),) * 2))
            return f"deterministic({', '.join(mean.names)})"
        if length:
            noise, covariance = self.terms.covariance(plates, length)
            make: Callable[[Arguments], Any] = lambda v: MvNormal(mean.call(v), **noise.call(v))  # noqa: E731
        else:
            noise = self.terms.scale(plates)
            covariance = lambda at, s: np.array([[noise.plain(at, s) ** 2]])  # noqa: E731
            make = lambda v: Normal(mean.call(v), noise.call(v))  # noqa: E731
        names = tuple(dict.fromkeys([*mean.names, *noise.names]))
        self._declare(name, make, names, plates)
        self._add_gaussian(self._know(name, plates, length), mean, covariance)
        return f"{'vector' if length else 'normal'}({', '.join(names)})"

    def _add_gaussian(
        self, known: Known, mean: Expression, covariance: Callable[[At, States], np.ndarray]
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

    # ---- small parts ------------------------------------------------------------------------

    def _plates(self) -> tuple[str, ...]:
        names = list(self.sizes)
        options: list[tuple[str, ...]] = [(), *((p,) for p in names)]
        if len(names) == 2:
            options += [tuple(names), tuple(names[::-1])]
        return self.choices.pick(options)

    def _elements(self, plates: Sequence[str]) -> int:
        return math.prod(self.sizes[p] for p in plates)

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
    ) -> Known:
        shape = tuple(self.sizes[p] for p in plates)
        node = PlainNode(name, plates, shape, (length,) if length else (), states)
        self.known.append(Known(node, length))
        return self.known[-1]

    def _each(self, node: PlainNode) -> list[tuple[int, dict[str, int]]]:
        """Every element of a node: its number, and its place in each plate."""
        return list(enumerate(self.terms.places(node.plates)))

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


def _pair(chance: float) -> np.ndarray:
    return np.array([1.0 - chance, chance])
