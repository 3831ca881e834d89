"""Small random nets, for tests of engines against each other.

What a net may hold: conditional tables and functions, labelled, numeric and plain states, zero
probabilities, continuous nodes that are affine in their parents or scaled by them, discrete children of
continuous parents, deterministic nodes, plates (own, shared, foreign by gather or reduction). The number
of configurations is bounded, so that every net can be enumerated. Every node is a line of code that was run,
which ``as_code`` shows. Potentials, inputs, vectors and hidden infinite parents are left to tests written by
hand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesmc.network import BayesNet
from bayesmc.network.parts import without_idle_plates
from bayesmc.testing.makers.choices import Choices, read_options, read_range, seeded
from bayesmc.testing.makers.spelling import (
    affine,
    array,
    call,
    declare,
    function,
    literal,
    over,
    softmax,
)

_LABELS = ("no", "yes", "maybe", "never", "always")
_NUMBERS = (-1.0, 0.5, 2.0, 3.5, 7.0)
#: points that a hidden continuous scalar counts for
_POINTS = 32


@dataclass(frozen=True)
class NetOptions:
    """What a random net may hold.

    Attributes
    ----------
    nodes : (int, int)
        Fewest and most nodes.
    states : int or (int, int)
        Most states of a finite node, 2 to 5, or fewest and most.
    parents : int
        Most parents of a node (an index for a gather comes on top).
    hybrid : bool
        Continuous nodes and Poisson leaves, besides finite nodes.
    continuous : bool
        Continuous nodes only.
    plates : bool
        Up to two plates of size 2 or 3.
    deterministic : bool
    zeros : bool
        Probabilities of zero.
    coupling : float
        How strongly nodes depend on their parents: a factor of the parents' weights in functions, a power
        of the rows of tables. With 0 parents are read and change nothing.
    configurations : int
        Bound on the joint states of all nodes, 32 for a continuous scalar.
    """

    nodes: tuple[int, int] = (1, 6)
    states: int | tuple[int, int] = 3
    parents: int = 3
    hybrid: bool = False
    plates: bool = False
    deterministic: bool = True
    zeros: bool = True
    configurations: int = 1 << 15
    continuous: bool = False
    coupling: float = 1.0

    def __post_init__(self) -> None:
        fewest, _ = read_range("nodes", self.nodes, 1)
        if isinstance(self.states, tuple):
            least, most = read_range("states", self.states, 2)
        else:
            least, most = 2, self.states
        if not 2 <= least <= most <= len(_LABELS):
            raise ValueError(f"states={self.states}: give 2 to {len(_LABELS)}")
        if self.configurations < least:
            raise ValueError(f"configurations={self.configurations}: give at least {least}")
        if self.parents < 0:
            raise ValueError(f"parents={self.parents}: give the most parents of a node, 0 or more")
        if not 0.0 <= self.coupling < math.inf:
            raise ValueError(f"coupling={self.coupling}: give a factor, 0 or larger")
        if self.continuous and self.hybrid:
            raise ValueError("continuous=True leaves no finite nodes for hybrid=True; give one")
        if self.continuous and _POINTS**fewest > self.configurations:
            raise ValueError(
                f"configurations={self.configurations}: {fewest} continuous nodes count for "
                f"{_POINTS}**{fewest} = {_POINTS**fewest}; allow as many, or fewer nodes"
            )

    @property
    def cards(self) -> tuple[int, int]:
        """Fewest and most states of a finite node."""
        return self.states if isinstance(self.states, tuple) else (2, self.states)


def random_net(rng: Any, **options: Any) -> BayesNet:
    """A small random net.

    Parameters
    ----------
    rng : seed or Generator
        The same seed gives the same net.
    **options
        Fields of `NetOptions`: ``nodes``, ``states``, ``parents``, ``hybrid``, ``continuous``, ``plates``,
        ``deterministic``, ``zeros``, ``coupling``, ``configurations``.

    Returns
    -------
    BayesNet
        Its ``name`` says what the nodes are; ``as_code`` shows the code that declares it.

    Raises
    ------
    ValueError, TypeError
        An option that is out of range, or unknown.

    Examples
    --------
    >>> from bayesmc.testing import random_net
    >>> random_net(3).name == random_net(3).name
    True
    >>> random_net(6, nodes=(2, 2)).name
    'v0[]: logistic(); v1[]: logistic(v0)'
    """
    choices = seeded(np.random.default_rng(rng))
    return build_net(choices, read_options("random_net", NetOptions, options))


# ---- building -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Known:
    """What later nodes need to know of an earlier one.

    ``card`` is None for a number without states; ``is_smooth`` says that it varies continuously, so that
    only smooth functions of it are left to exact quadrature.
    """

    name: str
    plates: tuple[str, ...]
    card: int | None = None
    states: tuple[Any, ...] | None = None
    low: int = 0
    is_smooth: bool = False

    @property
    def is_labelled(self) -> bool:
        return self.states is not None and isinstance(self.states[0], str)

    @property
    def is_index(self) -> bool:
        """Whether its values are positions 0, 1, ..."""
        return self.card is not None and self.states is None and self.low == 0

    @property
    def position(self) -> str:
        """Code of the position of its value among its states."""
        if self.is_labelled:
            return f"np.asarray({self.name})"
        if self.states is not None:
            return f"np.searchsorted({list(self.states)!r}, {self.name})"
        return (
            f"{self.name} {'-' if self.low > 0 else '+'} {abs(self.low)}" if self.low else self.name
        )


@dataclass(frozen=True)
class Score:
    """A number that is affine in the parents: an offset (per plate element) and (weight, code) terms."""

    offset: Any
    terms: tuple[tuple[float, str], ...]

    def __str__(self) -> str:
        return affine(self.offset, self.terms)

    @property
    def factor(self) -> str:
        """Code that may stand in a product."""
        return f"({self})" if self.terms else str(self)


class _Builder:
    """A net in the making, and how many configurations it may still grow by."""

    def __init__(self, choices: Choices, options: NetOptions) -> None:
        self.choices = choices
        self.options = options
        self.sizes: dict[str, int] = {}
        if options.plates:
            self.sizes = {p: choices.integer(2, 3) for p in ("k", "n")[: choices.integer(1, 2)]}
        self.net = BayesNet("", plates=dict(self.sizes))
        self.known: list[Known] = []
        self.left = float(options.configurations)
        self.story: list[str] = []

    @property
    def is_full(self) -> bool:
        """Whether no further node could be enumerated."""
        return self.left < (_POINTS if self.options.continuous else self.options.cards[0])

    def add(self, number: int, choices: Choices) -> None:
        """Declare one more node, as far as the configurations allow."""
        self.choices = choices
        name = f"v{number}"
        plates = self._plates()
        kind = self.choices.pick(self._kinds())
        if kind in _CONTINUOUS and not self._afford(_POINTS, plates, number):
            plates = ()
            if not self.options.continuous:
                kind = "logistic" if self.options.cards[0] == 2 else "softmax"
        if kind in _CONTINUOUS:
            known = self._continuous(name, kind, plates)
        elif kind == "poisson":
            score, parents = self._score(plates)
            self._declare(name, f"bmc.Poisson({_rate(score)})", parents, plates)
            known = None  # infinitely many values: no child of it could be enumerated
        elif kind == "deterministic":
            known = self._deterministic(name, plates)
        else:
            fewest, most = self.options.cards
            card = 2 if kind == "logistic" else self.choices.integer(fewest, most)
            if not self._afford(card, plates):
                card, plates = fewest, ()
            known = self._finite(name, kind, card, plates)
            self.left /= float(card) ** self._elements(plates)
        if kind in _CONTINUOUS:
            self.left /= float(_POINTS) ** self._elements(plates)
        self.story.append(f"{name}[{','.join(plates)}]: {kind}({', '.join(self._last_parents)})")
        if known is not None:
            self.known.append(known)

    def _plates(self) -> tuple[str, ...]:
        names = list(self.sizes)
        options: list[tuple[str, ...]] = [(), *((p,) for p in names)]
        if len(names) == 2:
            options += [tuple(names), tuple(names[::-1])]
        return self.choices.pick(options)

    def _kinds(self) -> list[str]:
        kinds = ["table", "rows", "logistic", "softmax", "uniform integers", "binomial"]
        if self.options.cards[0] > 2:
            kinds.remove("logistic")
        if self.options.continuous:
            kinds = ["normal", "normal", "normal", *_CONTINUOUS[1:]]
        if self.options.deterministic and self.known:
            kinds.append("deterministic")
        if self.options.hybrid:
            kinds += ["normal", "normal", "normal", *_CONTINUOUS[1:], "poisson"]
        return kinds

    def _elements(self, plates: Sequence[str]) -> int:
        return math.prod([self.sizes[p] for p in plates])

    def _afford(self, states: int, plates: Sequence[str], number: int | None = None) -> bool:
        """Whether a node of so many states fits; of the continuous nets, with those that must follow."""
        after = 0
        if number is not None and self.options.continuous:
            after = max(0, self.options.nodes[0] - number - 1)
        return float(states) ** (self._elements(plates) + after) <= self.left

    def _declare(
        self,
        name: str,
        body: str,
        parents: Sequence[str],
        plates: tuple[str, ...],
        states: tuple[Any, ...] | None = None,
    ) -> None:
        self._last_parents = tuple(parents)
        text = function(parents, body)
        declare(self.net, call("add", f'"{name}"', text, plates=over(plates), states=states))

    # ---- kinds ------------------------------------------------------------------------------

    def _finite(self, name: str, kind: str, card: int, plates: tuple[str, ...]) -> Known:
        known = Known(name, plates, card)
        if kind in ("table", "rows"):
            return self._tabular(known, kind)
        score, parents = self._score(plates)
        if kind == "uniform integers":
            low = self.choices.integer(-1, 1)
            self._declare(name, f"bmc.DiscreteUniform({low}, {low + card - 1})", (), plates)
            return replace(known, low=low)
        if kind == "binomial":
            self._declare(name, f"bmc.Binomial({card - 1}, logits={score})", parents, plates)
            return known
        known = replace(known, states=self._states(card))
        if kind == "logistic":
            body = f"bmc.Bernoulli(logits={score})"
        else:
            slopes = self.choices.reals(-1.0, 1.0, (card,)).tolist()
            body = softmax(str(score), slopes)
        self._declare(name, body, parents, plates, known.states)
        return known

    def _tabular(self, known: Known, kind: str) -> Known:
        inside = [
            k for k in self.known if k.card is not None and set(k.plates) <= set(known.plates)
        ]
        chosen = self._some(inside)
        cards = tuple(k.card for k in chosen if k.card is not None)
        assert known.card is not None
        rows = self.choices.rows(math.prod(cards), known.card, self.options.zeros)
        if chosen and self.options.coupling != 1.0:
            rows = rows**self.options.coupling
            rows = rows / rows.sum(axis=1, keepdims=True)
        table = rows.reshape((*cards, known.card))
        known = replace(known, states=self._states(known.card))
        parents = [k.name for k in chosen]
        if kind == "table":
            self._last_parents = tuple(parents)
            states = [] if known.states is None else [literal(known.states)]
            texts = [f'"{known.name}"', literal(parents), repr(table.tolist()), *states]
            declare(self.net, call("table", *texts, plates=over(known.plates)))
        else:
            at = ", ".join(k.position for k in chosen)
            probs = f"{array(table)}[{at}]" if chosen else repr(table.tolist())
            body = f"bmc.Categorical({probs})"
            self._declare(known.name, body, parents, known.plates, known.states)
        return known

    def _continuous(self, name: str, kind: str, plates: tuple[str, ...]) -> Known:
        score, parents = self._score(plates)
        if kind == "normal" and parents and self.choices.flag():
            spread = self.choices.real(0.0, 1.0)
            term = affine(0.0, score.terms[:1])  # the scale depends on a parent, too
            share = f"(1.0 + np.tanh(0.5 * ({term})))"  # twice a sigmoid, which cannot overflow
            body = f"bmc.Normal({score}, 0.75 + {spread / 2!r} * {share})"
        else:
            body = _family(kind, score, self.choices.real(0.75, 2.0))
        self._declare(name, body, parents, plates)
        return Known(name, plates, is_smooth=True)

    def _deterministic(self, name: str, plates: tuple[str, ...]) -> Known:
        score, parents = self._score(plates, at_least=1)
        above = [k for k in self.known if k.name in parents]
        if any(k.is_smooth for k in above) or self.choices.flag():
            self._declare(name, str(score), parents, plates)
            return Known(name, plates, is_smooth=any(k.is_smooth for k in above))
        # positions 0 and 1; states need finite parents that are not foreign
        inside = all(k.card is not None and set(k.plates) <= set(plates) for k in above)
        states = self._states(2) if inside else None
        self._declare(name, f"np.where({score} > 0.1, 1, 0)", parents, plates, states)
        return Known(name, plates, 2 if states else None, states)

    # ---- parents ----------------------------------------------------------------------------

    def _some(self, candidates: Sequence[Known], at_least: int = 0) -> list[Known]:
        chosen = [k for k in candidates if self.choices.flag(0.5)][: self.options.parents]
        return chosen if len(chosen) >= at_least or not candidates else [candidates[-1]]

    def _score(self, plates: tuple[str, ...], at_least: int = 0) -> tuple[Score, list[str]]:
        chosen = self._some(self.known, at_least)
        parents = [k.name for k in chosen]
        terms = []
        for known in chosen:
            weight = self.options.coupling * self.choices.pick((1.0, -1.0, 0.5, -0.75))
            value = known.name
            if known.is_labelled and known.states:
                value = f"({value} == {literal(self.choices.pick(known.states))})"
            index = self._index(known, plates, parents)
            if index is not None:
                value = f"{value}[{index}]"
            elif set(known.plates) - set(plates):
                value = f"{value}.mean()"
            terms.append((weight, value))
        by_element = plates and self.choices.flag(0.5)
        shape = tuple(self.sizes[p] for p in plates) if by_element else ()
        return Score(self.choices.reals(-1.0, 1.0, shape), tuple(terms)), parents

    def _index(self, known: Known, plates: tuple[str, ...], parents: list[str]) -> str | None:
        """Name of a parent to gather a foreign plate by; it may join the parents."""
        foreign = [p for p in known.plates if p not in plates]
        if len(foreign) != 1:
            return None
        able = [
            k
            for k in self.known
            if k.is_index and k.card == self.sizes[foreign[0]] and set(k.plates) <= set(plates)
        ]
        if not able or not self.choices.flag(0.75):
            return None
        name = self.choices.pick(able).name
        if name not in parents:
            parents.append(name)
        return name

    def _states(self, card: int) -> tuple[Any, ...] | None:
        kind = self.choices.integer(0, 2)
        return None if kind == 0 else (_LABELS if kind == 1 else _NUMBERS)[:card]


def build_net(choices: Choices, options: NetOptions) -> BayesNet:
    """``random_net`` from any source of choices."""
    builder = _Builder(choices, options)
    fewest, most = options.nodes
    for number in range(most):
        # asked before every node, not once for their number, so that any node can be shrunk away
        more = number < fewest or choices.integer(0, most - fewest) > 0
        if not more or (number and builder.is_full):
            break
        choices.group(lambda inner, n=number: builder.add(n, inner))  # type: ignore[misc]
    builder.net.name = "; ".join(builder.story)
    return without_idle_plates(builder.net)


_CONTINUOUS = ("normal", "student", "gamma", "beta", "exponential", "uniform")


def _family(kind: str, score: Score, scale: float) -> str:
    bodies = {
        "normal": f"bmc.Normal({score}, {scale!r})",
        "student": f"bmc.StudentT(6.0, {score}, {scale!r})",
        "gamma": f"bmc.Gamma({1.0 + scale!r}, {_rate(score)})",
        "beta": f"bmc.Beta({1.0 + scale!r}, 1.0 + {_rate(score)})",
        "exponential": f"bmc.Exponential({_rate(score)})",
        # bounds that follow a continuous parent would make densities jump
        "uniform": f"bmc.Uniform({-scale!r}, {scale!r}"
        + (f" + 0.0 * {score.factor})" if score.terms else ")"),
    }
    return bodies[kind]


def _rate(score: Score) -> str:
    return f"np.exp(1.5 * np.tanh({score.factor} / 3.0))"
