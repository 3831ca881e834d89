"""Small random nets, for tests of engines against each other.

What a net may hold: conditional tables and functions, labelled, numeric and plain states, zero
probabilities, continuous nodes that are affine in their parents or scaled by them, discrete children of
continuous parents, deterministic nodes, plates (own, shared, foreign by gather or reduction). The number
of configurations is bounded, so that every net can be enumerated. Potentials, inputs, vectors and hidden
infinite parents are left to tests written by hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesmc.distributions import (
    Bernoulli,
    Beta,
    Binomial,
    Categorical,
    DiscreteUniform,
    Distribution,
    Exponential,
    Gamma,
    Normal,
    Poisson,
    StudentT,
    Uniform,
)
from bayesmc.network import BayesNet
from bayesmc.plates import PlateArray, stack
from bayesmc.testing.choices import Choices, seeded

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
    states : int
        Most states of a finite node, 2 to 5.
    parents : int
        Most parents of a node (an index for a gather comes on top).
    hybrid : bool
        Continuous nodes and Poisson leaves.
    plates : bool
        Up to two plates of size 2 or 3.
    deterministic : bool
    zeros : bool
        Probabilities of zero.
    configurations : int
        Bound on the joint states of all nodes, 32 for a continuous scalar.
    """

    nodes: tuple[int, int] = (1, 6)
    states: int = 3
    parents: int = 3
    hybrid: bool = False
    plates: bool = False
    deterministic: bool = True
    zeros: bool = True
    configurations: int = 1 << 15

    def __post_init__(self) -> None:
        low, high = self.nodes
        if not 1 <= low <= high:
            raise ValueError(f"nodes={self.nodes}: give (fewest, most) with 1 <= fewest <= most")
        if not 2 <= self.states <= len(_LABELS):
            raise ValueError(f"states={self.states}: give 2 to {len(_LABELS)}")
        if self.configurations < 2:
            raise ValueError(f"configurations={self.configurations}: give at least 2")


def random_net(rng: Any, **options: Any) -> BayesNet:
    """A small random net.

    Parameters
    ----------
    rng : seed or Generator
        The same seed gives the same net.
    **options
        Fields of `NetOptions`: ``nodes``, ``states``, ``parents``, ``hybrid``, ``plates``,
        ``deterministic``, ``zeros``, ``configurations``.

    Returns
    -------
    BayesNet
        Its ``name`` says what the nodes are.

    Examples
    --------
    >>> from bayesmc.testing import random_net
    >>> random_net(3).name == random_net(3).name
    True
    """
    return build_net(seeded(np.random.default_rng(rng)), NetOptions(**options))


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


@dataclass(frozen=True)
class Term:
    """How one parent enters a number: ``weight`` times its value, or the indicator of a label.

    A foreign plate is gathered by the parent at position ``index``, or averaged over.
    """

    position: int
    weight: float
    label: Any = None
    index: int | None = None

    def __call__(self, arguments: Sequence[Any]) -> Any:
        value = arguments[self.position]
        if self.label is not None:
            value = (value == self.label) * 1.0
        if isinstance(value, PlateArray):
            value = value.mean() if self.index is None else value[arguments[self.index]]
        return self.weight * value


@dataclass(frozen=True)
class Score:
    """A number that is affine in the parents: an offset (per plate element) and terms."""

    offset: Any
    terms: tuple[Term, ...]

    def __call__(self, arguments: Sequence[Any]) -> Any:
        total: Any = self.offset
        for term in self.terms:
            total = total + term(arguments)
        return total


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

    def add(self, number: int, choices: Choices) -> None:
        """Declare one more node, as far as the configurations allow."""
        self.choices = choices
        name = f"v{number}"
        plates = self._plates()
        kind = self.choices.pick(self._kinds())
        if kind in _CONTINUOUS and not self._afford(_POINTS, plates):
            plates, kind = (), "logistic"
        if kind in _CONTINUOUS:
            known = self._continuous(name, kind, plates)
        elif kind == "poisson":
            score, parents = self._score(plates)
            self._declare(name, lambda *a: Poisson(_rate(score(a))), parents, plates)
            known = None  # infinitely many values: no child of it could be enumerated
        elif kind == "deterministic":
            known = self._deterministic(name, plates)
        else:
            card = 2 if kind == "logistic" else self.choices.integer(2, self.options.states)
            if not self._afford(card, plates):
                card, plates = 2, ()
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
        if self.options.deterministic and self.known:
            kinds.append("deterministic")
        if self.options.hybrid:
            kinds += ["normal", "normal", "normal", *_CONTINUOUS[1:], "poisson"]
        return kinds

    def _elements(self, plates: Sequence[str]) -> int:
        return math.prod([self.sizes[p] for p in plates])

    def _afford(self, states: int, plates: Sequence[str]) -> bool:
        return float(states) ** self._elements(plates) <= self.left

    def _declare(
        self,
        name: str,
        function: Callable[..., Any],
        parents: Sequence[str],
        plates: tuple[str, ...],
        states: tuple[Any, ...] | None = None,
    ) -> None:
        self._last_parents = tuple(parents)
        self.net.add(name, function, parents=list(parents), plates=plates, states=states)

    # ---- kinds ------------------------------------------------------------------------------

    def _finite(self, name: str, kind: str, card: int, plates: tuple[str, ...]) -> Known:
        known = Known(name, plates, card)
        if kind in ("table", "rows"):
            return self._tabular(known, kind)
        score, parents = self._score(plates)
        if kind == "uniform integers":
            low = self.choices.integer(-1, 1)
            self._declare(name, lambda: DiscreteUniform(low, low + card - 1), (), plates)
            return replace(known, low=low)
        if kind == "binomial":
            self._declare(name, lambda *a: Binomial(card - 1, _sigmoid(score(a))), parents, plates)
            return known
        known = replace(known, states=self._states(card))
        if kind == "logistic":
            make: Callable[..., Any] = lambda *a: Bernoulli(_sigmoid(score(a)))  # noqa: E731
        else:
            slopes = self.choices.reals(-1.0, 1.0, (card,))
            make = lambda *a: Categorical(_softmax(score(a), slopes))  # noqa: E731
        self._declare(name, make, parents, plates, known.states)
        return known

    def _tabular(self, known: Known, kind: str) -> Known:
        inside = [
            k for k in self.known if k.card is not None and set(k.plates) <= set(known.plates)
        ]
        chosen = self._some(inside)
        cards = tuple(k.card for k in chosen if k.card is not None)
        assert known.card is not None
        rows = self.choices.rows(math.prod(cards), known.card, self.options.zeros)
        table = rows.reshape((*cards, known.card))
        known = replace(known, states=self._states(known.card))
        parents = [k.name for k in chosen]
        if kind == "table":
            self._last_parents = tuple(parents)
            self.net.table(known.name, parents, table, known.states, plates=known.plates)
        else:
            self._declare(
                known.name,
                lambda *a: Categorical(table[tuple(map(_position, a, chosen))]),
                parents,
                known.plates,
                known.states,
            )
        return known

    def _continuous(self, name: str, kind: str, plates: tuple[str, ...]) -> Known:
        score, parents = self._score(plates)
        if kind == "normal" and parents and self.choices.flag():
            spread = self.choices.real(0.0, 1.0)
            term = score.terms[0]  # the scale depends on a parent, too
            make: Callable[..., Any] = lambda *a: Normal(  # noqa: E731
                score(a), 0.75 + spread * _sigmoid(term(a))
            )
        else:
            make = _family(kind, score, self.choices.real(0.75, 2.0))
        self._declare(name, make, parents, plates)
        return Known(name, plates, is_smooth=True)

    def _deterministic(self, name: str, plates: tuple[str, ...]) -> Known:
        score, parents = self._score(plates, at_least=1)
        above = [k for k in self.known if k.name in parents]
        if any(k.is_smooth for k in above) or self.choices.flag():
            self._declare(name, lambda *a: np.asarray(score(a)), parents, plates)
            return Known(name, plates, is_smooth=any(k.is_smooth for k in above))
        # positions 0 and 1; states need finite parents that are not foreign
        inside = all(k.card is not None and set(k.plates) <= set(plates) for k in above)
        states = self._states(2) if inside else None
        self._declare(name, lambda *a: np.where(score(a) > 0.1, 1, 0), parents, plates, states)
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
            weight = self.choices.pick((1.0, -1.0, 0.5, -0.75))
            label = self.choices.pick(known.states) if known.is_labelled and known.states else None
            index = self._index(known, plates, parents)
            terms.append(Term(parents.index(known.name), weight, label, index))
        by_element = plates and self.choices.flag(0.5)
        shape = tuple(self.sizes[p] for p in plates) if by_element else ()
        return Score(self.choices.reals(-1.0, 1.0, shape), tuple(terms)), parents

    def _index(self, known: Known, plates: tuple[str, ...], parents: list[str]) -> int | None:
        """Position of a parent to gather a foreign plate by; it may join the parents."""
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
        return parents.index(name)

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
        if not more or (number and builder.left < 2):
            break
        choices.group(lambda inner, n=number: builder.add(n, inner))  # type: ignore[misc]
    builder.net.name = "; ".join(builder.story)
    return builder.net


_CONTINUOUS = ("normal", "student", "gamma", "beta", "exponential", "uniform")


def _family(kind: str, score: Score, scale: float) -> Callable[..., Distribution]:
    makers: dict[str, Callable[..., Distribution]] = {
        "normal": lambda *a: Normal(score(a), scale),
        "student": lambda *a: StudentT(6.0, score(a), scale),
        "gamma": lambda *a: Gamma(1.0 + scale, _rate(score(a))),
        "beta": lambda *a: Beta(1.0 + scale, 1.0 + _rate(score(a))),
        "exponential": lambda *a: Exponential(_rate(score(a))),
        # bounds that follow a continuous parent would make densities jump
        "uniform": lambda *a: Uniform(-scale, scale + 0.0 * np.asarray(score(a))),
    }
    return makers[kind]


def _rate(score: Any) -> np.ndarray:
    return np.exp(1.5 * np.tanh(np.asarray(score) / 3.0))


def _sigmoid(score: Any) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-np.clip(score, -30.0, 30.0)))


def _softmax(score: Any, slopes: np.ndarray) -> np.ndarray:
    weights = np.exp(np.clip(stack([s * np.asarray(score) for s in slopes]), -30.0, 30.0))
    return weights / weights.sum(axis=-1, keepdims=True)


def _position(value: Any, known: Known) -> np.ndarray:
    """Position of a finite parent's value among its states."""
    if known.states is not None and not known.is_labelled:
        return np.searchsorted(np.array(known.states), value)
    return np.asarray(value) - known.low
