"""Small random templates over time whose hidden nodes are finite, with data, for tests of filters.

What a template may hold: tables and functions, of the slice before, of the time and of an input; labels and
numbers; plates (own, shared, read across); deterministic nodes that later slices read; continuous and finite
observed nodes, some of which read what was observed before. Every template can be unrolled and answered
exactly. Every node is a line of code that was run, which ``as_code`` shows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesmc.dbn import DynamicBayesNet
from bayesmc.testing.makers.choices import Choices, read_options, read_range, seeded
from bayesmc.testing.makers.spelling import (
    affine,
    array,
    as_code,
    call,
    declare,
    function,
    literal,
    over,
    softmax,
)

_LABELS = ("low", "mid", "high")


@dataclass(frozen=True)
class DbnOptions:
    """What a random template may hold.

    Attributes
    ----------
    nodes : (int, int)
        Fewest and most hidden finite nodes.
    steps : (int, int)
        Fewest and most slices.
    zeros : bool
        Tables may have zeros.
    """

    nodes: tuple[int, int] = (1, 4)
    steps: tuple[int, int] = (1, 6)
    zeros: bool = True

    def __post_init__(self) -> None:
        read_range("nodes", self.nodes, 1)
        read_range("steps", self.steps, 1)


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

    def __repr__(self) -> str:
        """The code that declares the template and its data."""
        lines = [as_code(self.dbn), f"observations = {_listed(self.observations)}"]
        if self.inputs is not None:
            lines.append(f"inputs = {_listed(self.inputs)}")
        return "\n".join(lines)


def random_dbn(seed: Any, **options: Any) -> RandomDbn:
    """A small random discrete template with data.

    Parameters
    ----------
    seed : seed or Generator
        The same seed gives the same template and data.
    **options
        Fields of `DbnOptions`: ``nodes``, ``steps``, ``zeros``.

    Returns
    -------
    RandomDbn
        It prints as the code that declares it.

    Raises
    ------
    ValueError, TypeError
        An option that is out of range, or unknown.

    Examples
    --------
    >>> from bayesmc.testing import random_dbn
    >>> random_dbn(3).story == random_dbn(3).story
    True
    """
    given = read_options("random_dbn", DbnOptions, options)
    rng = np.random.default_rng(seed)
    builder = _Builder(seeded(rng), given.zeros)
    builder.build(*given.nodes)
    count = int(rng.integers(given.steps[0], given.steps[1] + 1))
    return _with_data(builder, count, rng, lambda: rng.random() >= 0.3)


def build_dbn(choices: Choices, options: DbnOptions) -> RandomDbn:
    """A random template from any source of choices; its data are drawn from a seed, which is one of them."""
    count = choices.integer(*options.steps)
    builder = _Builder(choices, options.zeros)
    builder.build(*options.nodes)
    rng = np.random.default_rng(choices.integer(0, 2**31 - 1))
    return _with_data(builder, count, rng, lambda: choices.flag(0.7))


def _with_data(
    builder: _Builder, count: int, rng: np.random.Generator, has_gaps: Callable[[], bool]
) -> RandomDbn:
    inputs = {"u": rng.normal(size=count).round(2)} if builder.has_input else None
    drawn = builder.dbn.sample(count, inputs=inputs, rng=rng)
    observations = {}
    for name, full in builder.seen.items():
        values = np.asarray(_plain(drawn[name][0]))
        if not full and has_gaps():
            values = np.ma.MaskedArray(values, mask=rng.random(values.shape) < 0.35)
        observations[name] = values
    return RandomDbn(builder.dbn, count, observations, inputs, "; ".join(builder.story))


# ---- private ------------------------------------------------------------------------------------


@dataclass
class _Known:
    """What later nodes need to know of an earlier one."""

    name: str
    plates: tuple[str, ...]
    card: int = 0
    labels: tuple[str, ...] | None = None


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
            declare(self.dbn, 'input("u")')

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
            first = [k.name for k in tabular]
            initial = _looked_up(self._rows(tabular, card), first, tabular) if past else ""
            self._table(own, parents, self._rows([*tabular, *past], card), initial)
            self._tell(name, "table", parents, plates)
        else:
            score, parents = self._score(plates, now, before)
            start, own_slice = self._score(plates, now, [])
            slopes = c.reals(-1.5, 1.5, (card,)).tolist()
            initial = ""
            if any(p.endswith("_prev") for p in parents):
                initial = function(own_slice, softmax(start, slopes))
            self._add(own, function(parents, softmax(score, slopes)), initial)
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
        total = " + ".join([f"{weight!r} * {parents[0]}", *parents[1:]])
        self._add(_Known(name, plates), function(parents, f"0.5 * ({total})"))
        self._tell(name, "computed", parents, plates)
        shift = c.real(-1.0, 1.0)
        logits = affine(shift, [(1.0, "np.sin(d_prev)")])
        body = function(["d_prev"], f"bmc.Bernoulli(logits={logits})")
        self._add(_Known("e", plates), body, "bmc.Bernoulli(0.4)")
        self._tell("e", "bernoulli", ["d_prev"], plates)
        self.known.append(_Known("e", plates, 2))

    def _normal(self, name: str) -> None:
        """A continuous observed node; with the value before among its parents it has no gaps."""
        c = self.choices
        plates, recalls = self._plates(), c.flag(0.25)
        some = [k for k in self.known if c.flag(0.7)] or self.known[-1:]
        score, parents = self._score(plates, some, [k for k in self.known if c.flag(0.2)])
        spread = c.real(0.5, 1.5)
        if recalls:
            parents = [*parents, name + "_prev"]
            score = f"{score} + 0.5 * {name}_prev"
        first, own = self._score(plates, some, [])
        reads_back = any(p.endswith("_prev") for p in parents)
        initial = function(own, f"bmc.Normal({first}, {spread!r})") if reads_back else ""
        body = function(parents, f"bmc.Normal({score}, {spread!r})")
        self._add(_Known(name, plates), body, initial)
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
        rows = self._rows([*inside, *([own] if recalls else [])], 2)
        self._table(own, parents, rows, "[0.3, 0.7]" if recalls else "")
        self._tell(name, "leaf", parents, plates)
        self.seen[name] = False

    # ---- code -------------------------------------------------------------------------------

    def _table(self, own: _Known, parents: list[str], rows: np.ndarray, initial: str) -> None:
        self._run("table", own, initial, literal(parents), repr(rows.tolist()))

    def _add(self, own: _Known, cpd: str, initial: str = "") -> None:
        self._run("add", own, initial, cpd)

    def _run(self, method: str, own: _Known, initial: str, *texts: str) -> None:
        start = [f"initial={initial}"] if initial else []
        options = {"states": own.labels, "plates": over(own.plates)}
        declare(self.dbn, call(method, f'"{own.name}"', *texts, *start, **options))

    def _rows(self, above: list[_Known], card: int) -> np.ndarray:
        cards = tuple(k.card for k in above)
        rows = self.choices.rows(math.prod(cards), card, self.zeros and self.choices.flag(0.3))
        return rows.reshape((*cards, card))

    def _score(
        self, plates: tuple[str, ...], now: list[_Known], before: list[_Known]
    ) -> tuple[str, list[str]]:
        """A number that is affine in finite nodes, and may read the time and the input."""
        c = self.choices
        parents = [k.name for k in now] + [k.name + "_prev" for k in before]
        terms = []
        for known, parent in zip([*now, *before], parents, strict=True):
            value = f"({parent} == {literal(known.labels[-1])})" if known.labels else parent
            if set(known.plates) - set(plates):
                value = f"{value}.mean()"
            terms.append((c.real(-1.5, 1.5), value))
        if c.flag(0.3):
            parents.append("t")
            terms.append((0.3, "t"))
        if self.has_input and c.flag(0.6):
            parents.append("u")
            terms.append((0.7, "u"))
        return affine(c.real(-1.0, 1.0), terms), parents

    def _tell(self, name: str, kind: str, parents: list[str], plates: tuple[str, ...]) -> None:
        self.story.append(f"{name}[{','.join(plates)}]: {kind}({', '.join(parents)})")


def _looked_up(rows: np.ndarray, names: list[str], above: list[_Known]) -> str:
    """A table as ``initial=`` takes it: probabilities, or a function of nodes of the slice."""
    if not names:
        return repr(rows.tolist())
    at = ", ".join(f"np.asarray({k.name})" if k.labels else k.name for k in above)
    return function(names, f"bmc.Categorical({array(rows)}[{at}])")


def _plain(values: Any) -> Any:
    return values.labels if hasattr(values, "labels") and hasattr(values, "codes") else values


def _listed(values: Mapping[str, np.ndarray]) -> str:
    """Rows as literals, None where they are missing."""
    return "{" + ", ".join(f'"{name}": {_rows_of(rows)}' for name, rows in values.items()) + "}"


def _rows_of(rows: Any) -> str:
    if not isinstance(rows, np.ma.MaskedArray):
        return f"np.array({literal(rows.tolist())})"
    data, mask = rows.data.tolist(), np.ma.getmaskarray(rows).astype(int).tolist()
    return f"np.ma.MaskedArray({literal(data)}, {mask!r})"
