"""Small random templates over time whose hidden nodes are finite, with data, for tests of filters.

What a template may hold: tables and functions, of the slice before, of the time and of an input; labels and
numbers; plates (own, shared, read across); deterministic nodes that later slices read; continuous and finite
observed nodes, some of which read what was observed before. Every template can be unrolled and answered
exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.dbn import DynamicBayesNet
from bayesmc.distributions import Bernoulli, Categorical, Normal
from bayesmc.testing.choices import Choices, seeded

_LABELS = ("low", "mid", "high")


@dataclass(frozen=True, eq=False)
class RandomDbn:
    """A random template and data for it.

    Attributes
    ----------
    dbn : DynamicBayesNet
    steps : int
    observations : dict
        Node -> rows; masked where they are missing.
    inputs : dict or None
    story : str
        What the nodes are.
    """

    dbn: DynamicBayesNet
    steps: int
    observations: dict[str, Any]
    inputs: dict[str, np.ndarray] | None
    story: str


def random_dbn(seed: Any, *, nodes: tuple[int, int] = (1, 4), steps: tuple[int, int] = (1, 6),
               zeros: bool = True) -> RandomDbn:  # fmt: skip
    """A small random discrete template with data.

    Parameters
    ----------
    seed : seed or Generator
        The same seed gives the same template and data.
    nodes : (int, int)
        Fewest and most hidden finite nodes.
    steps : (int, int)
        Fewest and most slices.
    zeros : bool
        Tables may have zeros.

    Returns
    -------
    RandomDbn

    Examples
    --------
    >>> from bayesmc.testing.dbns import random_dbn
    >>> random_dbn(3).story == random_dbn(3).story
    True
    """
    for name, (low, high) in (("nodes", nodes), ("steps", steps)):
        if not 1 <= low <= high:
            raise ValueError(
                f"random_dbn({name}={(low, high)}): give (fewest, most), 1 <= fewest <= most"
            )
    rng = np.random.default_rng(seed)
    builder = _Builder(seeded(rng), zeros)
    builder.build(*nodes)
    count = int(rng.integers(steps[0], steps[1] + 1))
    inputs = {"u": rng.normal(size=count).round(2)} if builder.has_input else None
    drawn = builder.dbn.sample(count, inputs=inputs, rng=rng)
    observations = {
        name: _with_gaps(np.asarray(_plain(drawn[name][0])), full, rng)
        for name, full in builder.seen.items()
    }
    return RandomDbn(builder.dbn, count, observations, inputs, "; ".join(builder.story))


# ---- private ------------------------------------------------------------------------------------


@dataclass
class _Known:
    """What later nodes need to know of an earlier one."""

    name: str
    plates: tuple[str, ...]
    card: int
    labels: tuple[str, ...] | None


@dataclass
class _Builder:
    """A template in the making."""

    choices: Choices
    zeros: bool
    dbn: DynamicBayesNet = field(init=False)
    known: list[_Known] = field(default_factory=list)
    seen: dict[str, bool] = field(default_factory=dict)
    story: list[str] = field(default_factory=list)
    has_input: bool = False
    left: float = 1 << 10  # joint states of a slice that may still be added

    def __post_init__(self) -> None:
        c = self.choices
        self.everywhere = c.flag(0.25)  # all nodes in one plate: sequences that never meet
        self.has_plate = self.everywhere or c.flag(0.3)
        self.dbn = DynamicBayesNet("", plates={"k": 2} if self.has_plate else None)
        self.has_input = c.flag(0.3)
        if self.has_input:
            self.dbn.input("u")

    def build(self, low: int, high: int) -> None:
        c = self.choices
        for k in range(c.integer(low, high)):
            self._finite(f"x{k}")
        if c.flag(0.4):
            self._deterministic("d")
        if c.flag(0.8):
            self._normal("y")
        if c.flag(0.5):
            self._leaf("z")
        if not self.seen or c.flag(0.15):
            self.seen[self.known[0].name] = False
        if c.flag(0.15):
            self.seen[self.known[-1].name] = True

    def _plates(self) -> tuple[str, ...]:
        if not self.has_plate:
            return ()
        return ("k",) if self.everywhere or self.choices.flag(0.4) else ()

    def _finite(self, name: str) -> None:
        """A finite node that reads itself in the slice before, and others now and then."""
        c = self.choices
        plates, card = self._plates(), c.integer(2, 3)
        if float(card) ** (2 if plates and not self.everywhere else 1) > self.left:
            plates, card = ("k",) if self.everywhere else (), 2
        self.left /= float(card) ** (2 if plates and not self.everywhere else 1)
        own = _Known(name, plates, card, _LABELS[:card] if c.flag(0.3) else None)
        now = [k for k in self.known if c.flag(0.4)]
        before = [k for k in (*self.known, own) if c.flag(0.7 if k is own else 0.3)]
        tabular = [k for k in now if set(k.plates) <= set(plates)]
        past = [k for k in before if set(k.plates) <= set(plates)]
        if c.flag(0.6):
            parents = [k.name for k in tabular] + [k.name + "_prev" for k in past]
            initial: Any = None
            if past:
                rows = self._rows(tabular, card)
                initial = _looked_up(rows, [k.name for k in tabular], [k.labels for k in tabular])
            probs = self._rows([*tabular, *past], card)
            self.dbn.table(name, parents, probs, own.labels, plates=plates, initial=initial)
            self._tell(name, "table", parents, plates)
        else:
            score, parents = self._score(now, before)
            first, own_slice = self._score(now, [])
            slopes = c.reals(-1.5, 1.5, (card,))
            options: dict[str, Any] = {"parents": parents, "plates": plates, "states": own.labels}
            if any(p.endswith("_prev") for p in parents):
                options["initial"] = _named(_softmaxed(first, slopes), own_slice)
            self.dbn.add(name, _softmaxed(score, slopes), **options)
            self._tell(name, "softmax", parents, plates)
        self.known.append(own)

    def _deterministic(self, name: str) -> None:
        """A number computed from finite nodes, which the next slice reads through one more finite node."""
        c = self.choices
        plates = self._plates()
        above = [k for k in self.known if not k.labels and set(k.plates) <= set(plates)][:2]
        if not above:
            return
        parents, clock = [k.name for k in above], c.flag(0.4)
        weight = c.real(0.5, 1.5)
        if clock:
            parents.append("t")
        self.dbn.add(name, lambda *a: sum(a[1:], weight * a[0]) * 0.5, parents, plates)
        self._tell(name, "computed", parents, plates)
        shift = c.real(-1.0, 1.0)
        self.dbn.add(
            "e", lambda d_prev: Bernoulli(_sigmoid(np.sin(d_prev) + shift)), plates=plates,
            initial=Bernoulli(0.4),
        )  # fmt: skip
        self._tell("e", "bernoulli", ["d_prev"], plates)
        self.known.append(_Known("e", plates, 2, None))

    def _normal(self, name: str) -> None:
        """A continuous observed node; with the value before among its parents it has no gaps."""
        c = self.choices
        plates, recalls = self._plates(), c.flag(0.25)
        some = [k for k in self.known if c.flag(0.7)] or self.known[-1:]
        score, parents = self._score(some, [k for k in self.known if c.flag(0.2)])
        spread, count = c.real(0.5, 1.5), len(parents)
        if recalls:
            parents = [*parents, name + "_prev"]
        first, own = self._score(some, [])
        make: Callable[..., Any] = lambda *a: Normal(score(a) + 0.5 * sum(a[count:]), spread)  # noqa: E731
        start: Callable[..., Any] = lambda *a: Normal(first(a), spread)  # noqa: E731
        reads_back = any(p.endswith("_prev") for p in parents)
        initial = _named(start, own) if reads_back else None
        self.dbn.add(name, make, parents, plates, initial=initial)
        self._tell(name, "density", parents, plates)
        self.seen[name] = recalls

    def _leaf(self, name: str) -> None:
        """A finite observed node, which may read its own value of the slice before."""
        c = self.choices
        plates = self._plates()
        inside = [k for k in self.known if set(k.plates) <= set(plates) and c.flag(0.6)]
        own = _Known(name, plates, 2, ("no", "yes") if c.flag(0.3) else None)
        recalls = c.flag(0.3)
        parents = [k.name for k in inside] + ([name + "_prev"] if recalls else [])
        initial = [0.3, 0.7] if recalls else None
        probs = self._rows([*inside, *([own] if recalls else [])], 2)
        self.dbn.table(name, parents, probs, own.labels, plates=plates, initial=initial)
        self._tell(name, "leaf", parents, plates)
        self.seen[name] = False

    def _rows(self, above: list[_Known], card: int) -> np.ndarray:
        cards = tuple(k.card for k in above)
        rows = self.choices.rows(math.prod(cards), card, self.zeros and self.choices.flag(0.3))
        return rows.reshape((*cards, card))

    def _score(
        self, now: list[_Known], before: list[_Known]
    ) -> tuple[Callable[[Any], Any], list[str]]:
        """A number that is affine in finite nodes, and may read the time and the input."""
        c = self.choices
        parents = [k.name for k in now] + [k.name + "_prev" for k in before]
        terms = [(c.real(-1.5, 1.5), k.labels[-1] if k.labels else None) for k in (*now, *before)]
        if c.flag(0.3):
            parents.append("t")
            terms.append((0.3, None))
        if self.has_input and c.flag(0.6):
            parents.append("u")
            terms.append((0.7, None))
        offset = c.real(-1.0, 1.0)

        def score(arguments: Any) -> Any:
            total: Any = offset
            for (weight, label), value in zip(terms, arguments, strict=False):
                number = value if label is None else (value == label) * 1.0
                if hasattr(number, "mean") and hasattr(number, "plates"):
                    number = number.mean()
                total = total + weight * number
            return total

        return score, parents

    def _tell(self, name: str, kind: str, parents: list[str], plates: tuple[str, ...]) -> None:
        self.story.append(f"{name}[{','.join(plates)}]: {kind}({', '.join(parents)})")


def _named(function: Callable[..., Any], names: list[str]) -> Any:
    """The function with arguments of these names, which is how ``initial=`` finds its parents."""
    if not names:
        return function()
    source = f"lambda {', '.join(names)}: function({', '.join(names)})"
    return eval(source, {"function": function})


def _looked_up(rows: np.ndarray, names: list[str], labels: list[Any]) -> Any:
    """A table as ``initial=`` takes it: probabilities, or a function of nodes of the slice."""
    if not names:
        return rows
    return _named(lambda *a: Categorical(rows[tuple(map(_position, a, labels))]), names)


def _position(value: Any, labels: Any) -> Any:
    if labels is None:
        return value
    return sum(k * (value == label) for k, label in enumerate(labels))


def _softmaxed(score: Callable[[Any], Any], slopes: np.ndarray) -> Callable[..., Any]:
    def make(*arguments: Any) -> Categorical:
        logits = np.asarray(score(arguments), dtype=float)[..., None] * slopes
        weights = np.exp(logits - logits.max(axis=-1, keepdims=True))
        return Categorical(weights / weights.sum(axis=-1, keepdims=True))

    return make


def _sigmoid(x: Any) -> Any:
    return 1.0 / (1.0 + np.exp(-np.asarray(x, dtype=float)))


def _plain(values: Any) -> Any:
    return values.labels if hasattr(values, "labels") and hasattr(values, "codes") else values


def _with_gaps(values: np.ndarray, full: bool, rng: np.random.Generator) -> Any:
    """The rows with some missing, as a masked array."""
    if full or rng.random() < 0.3:
        return values
    return np.ma.MaskedArray(values, mask=rng.random(values.shape) < 0.35)
