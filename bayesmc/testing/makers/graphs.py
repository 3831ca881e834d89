"""Small random factor graphs, for tests of engines that need no directed graph.

What a graph may hold: finite variables with plain, labelled and numeric states, in a plate or not;
tables and functions; one factor per element of a plate, factors by an index, factors of a whole plate;
forbidden configurations, but never all. With ``continuous`` there are numbers, too, whose factors are
negative squares, so that the density has a finite integral and is Gaussian given the finite variables.
Every variable and factor is a line of code that was run, which ``as_code`` shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.network import FactorGraph
from bayesmc.testing.makers.choices import Choices, read_options, read_range, seeded
from bayesmc.testing.makers.spelling import affine, call, declare, function, literal, over

_LABELS = ("red", "green", "blue", "black", "white")
_NUMBERS = (-1, 1, 2, 5, 9)


@dataclass(frozen=True)
class GraphOptions:
    """What a random factor graph may hold.

    Attributes
    ----------
    variables : (int, int)
        Fewest and most variables.
    factors : (int, int)
        Fewest and most batches of factors, besides the one that each continuous variable has.
    states : int
        Most states of a finite variable, 2 to 5.
    plates : bool
        A plate of size 2 or 3.
    continuous : bool
        Continuous variables besides finite ones; ``Exact`` takes none of these.
    zeros : bool
        Forbidden configurations.
    coupling : float
        Factor of all logs of factors between variables.
    configurations : int
        Bound on the joint states of the finite variables.
    """

    variables: tuple[int, int] = (1, 4)
    factors: tuple[int, int] = (0, 4)
    states: int = 3
    plates: bool = True
    continuous: bool = False
    zeros: bool = True
    coupling: float = 1.0
    configurations: int = 1 << 12

    def __post_init__(self) -> None:
        read_range("variables", self.variables, 1)
        read_range("factors", self.factors, 0)
        if not 2 <= self.states <= len(_LABELS):
            raise ValueError(f"states={self.states}: give 2 to {len(_LABELS)}")
        if not 0.0 <= self.coupling < math.inf:
            raise ValueError(f"coupling={self.coupling}: give a factor, 0 or larger")
        if 2 ** self.variables[0] > self.configurations:
            raise ValueError(
                f"configurations={self.configurations}: {self.variables[0]} variables have at least "
                f"{2 ** self.variables[0]}"
            )


def random_factor_graph(rng: Any, **options: Any) -> FactorGraph:
    """A small random factor graph.

    Parameters
    ----------
    rng : seed or Generator
        The same seed gives the same graph.
    **options
        Fields of `GraphOptions`: ``variables``, ``factors``, ``states``, ``plates``, ``continuous``,
        ``zeros``, ``coupling``, ``configurations``.

    Raises
    ------
    ValueError, TypeError
        An option that is out of range, or unknown.

    Examples
    --------
    >>> from bayesmc.testing import as_code, random_factor_graph
    >>> print(as_code(random_factor_graph(5, variables=(2, 2), plates=False)))
    graph = bmc.FactorGraph()
    graph.variable("x0", (-1, 1, 2))
    graph.variable("x1", (-1, 1))
    graph.factor([[1.0, -1.0, -0.5], [-0.25, 0.125, -0.25]], ["x1", "x0"])
    """
    choices = seeded(np.random.default_rng(rng))
    return build_factor_graph(choices, read_options("random_factor_graph", GraphOptions, options))


def build_factor_graph(choices: Choices, options: GraphOptions) -> FactorGraph:
    """``random_factor_graph`` from any source of choices."""
    builder = _Builder(choices, options)
    for number in _numbers(choices, options.variables):
        choices.group(lambda inner, n=number: builder.variable(n, inner))  # type: ignore[misc]
    for _ in _numbers(choices, options.factors):
        choices.group(builder.factor)
    return builder.graph


# ---- private ------------------------------------------------------------------------------------


def _numbers(choices: Choices, bounds: tuple[int, int]) -> Any:
    """0, 1, ..., asked for one by one, so that each can be shrunk away."""
    fewest, most = bounds
    for number in range(most):
        if number >= fewest and choices.integer(0, most - fewest) == 0:
            return
        yield number


@dataclass(frozen=True)
class _Variable:
    """What factors need to know; ``states`` is None for a continuous number."""

    name: str
    plates: tuple[str, ...]
    states: tuple[Any, ...] | None

    @property
    def card(self) -> int:
        return len(self.states or ())

    def number(self, choices: Choices, argument: str) -> str:
        """Code of a number made of a value."""
        if self.states is not None and isinstance(self.states[0], str):
            return f"({argument} == {literal(choices.pick(self.states))})"
        return argument


class _Builder:
    """A graph in the making."""

    def __init__(self, choices: Choices, options: GraphOptions) -> None:
        self.choices = choices
        self.options = options
        self.size = choices.integer(2, 3) if options.plates and choices.flag(0.7) else 0
        self.graph = FactorGraph(plates={"k": self.size} if self.size else None)
        self.variables: list[_Variable] = []
        self.left = float(options.configurations)

    def variable(self, number: int, choices: Choices) -> None:
        """Declare one more variable."""
        self.choices = c = choices
        name, plates = f"x{number}", ("k",) if self.size and c.flag() else ()
        if self.options.continuous and c.flag():
            self._declare("variable", f'"{name}"', '"real"', plates=over(plates))
            self.variables.append(_Variable(name, plates, None))
            square = f"({name} - {c.real(-2.0, 2.0)!r}) ** 2"  # makes the integral finite
            body = f"-{c.pick((0.5, 1.0, 2.0))!r} * {square}"
            self._declare("factor", function([name], body))
            return
        card = c.integer(2, self.options.states)
        after = 2.0 ** max(0, self.options.variables[0] - number - 1)
        if float(card) ** (self.size if plates else 1) * after > self.left:
            card, plates = 2, ()
        self.left /= float(card) ** (self.size if plates else 1)
        states = c.pick((tuple(range(card)), _LABELS[:card], _NUMBERS[:card]))
        support = str(card) if states[0] == 0 else literal(states)
        self._declare("variable", f'"{name}"', support, plates=over(plates))
        self.variables.append(_Variable(name, plates, states))

    def factor(self, choices: Choices) -> None:
        """Declare one more batch of factors."""
        self.choices = c = choices
        count = min(1 + c.integer(0, 2), len(self.variables))
        scope = [c.pick(self.variables)]
        while len(scope) < count:
            scope.append(c.pick([v for v in self.variables if v not in scope]))
        forms = ["each"]
        if any(v.plates for v in scope):
            forms += ["index", "index", "whole"]
        form = c.pick(forms)
        if form == "whole":
            self._whole(scope)
            return
        index = None
        if form == "index":
            if c.flag() and scope[0].plates:
                scope = [scope[0], scope[0], *scope[2:]]
            index = self._index(scope)
        if any(v.states is None for v in scope) or c.flag():
            self._function(scope, index)
        else:
            self._table(scope, index)

    def _index(self, scope: Sequence[_Variable]) -> str:
        """For each entry of the scope one position per row; a variable twice is at two positions."""
        c, rows = self.choices, self.choices.integer(1, 3)
        entries: list[list[int] | None] = []
        for k, variable in enumerate(scope):
            if not variable.plates:
                entries.append(None)
            elif k and variable is scope[0]:
                steps = [c.integer(1, self.size - 1) for _ in range(rows)]
                assert entries[0] is not None
                entries.append(
                    [(i + s) % self.size for i, s in zip(entries[0], steps, strict=True)]
                )
            else:
                entries.append([c.integer(0, self.size - 1) for _ in range(rows)])
        return f"index={tuple(entries)!r}"

    def _table(self, scope: Sequence[_Variable], index: str | None) -> None:
        """Logs on a coarse grid; the first entry is never forbidden, so that all first states are allowed."""
        cards = tuple(v.card for v in scope)
        logs = self.options.coupling * self.choices.reals(-1.0, 1.0, cards)
        text = repr(logs.tolist())
        if self.options.zeros and self.choices.flag(0.3):
            allowed = [self.choices.flag(0.6) for _ in range(logs.size - 1)]
            logs.reshape(-1)[1:][~np.array(allowed)] = -np.inf
            text = repr(logs.tolist()).replace("-inf", "-np.inf")
        names = literal([v.name for v in scope])
        self._declare("factor", text, names, *([index] if index else []))

    def _function(self, scope: Sequence[_Variable], index: str | None) -> None:
        """A product of finite values, or the square of what is affine in continuous ones."""
        c = self.choices
        arguments = [v.name for v in scope]
        if len(set(arguments)) < len(arguments):
            arguments = ["a", "b", *arguments[2:]]
        numbers = [v.number(c, a) for v, a in zip(scope, arguments, strict=True)]
        weight = self.options.coupling * c.pick((1.0, 0.5, -0.5, -1.0))
        if any(v.states is None for v in scope):
            terms = [(c.pick((1.0, -1.0, 0.5)), number) for number in numbers]
            body = f"-{abs(weight)!r} * ({affine(0.0, terms)}) ** 2"
        else:
            body = " * ".join([repr(weight), *numbers])
        names = literal([v.name for v in scope])
        self._declare("factor", function(arguments, body), names, *([index] if index else []))

    def _whole(self, scope: Sequence[_Variable]) -> None:
        """One factor of whole plates."""
        c = self.choices
        terms = []
        for variable in scope:
            number = variable.number(c, variable.name)
            terms.append((c.pick((1.0, -1.0, 0.5)), number + (".sum()" if variable.plates else "")))
        body = f"-{self.options.coupling * c.pick((0.25, 0.5))!r} * ({affine(0.0, terms)}) ** 2"
        self._declare("factor", function([v.name for v in scope], body), "plates=()")

    def _declare(self, method: str, *texts: str, **options: Any) -> None:
        declare(self.graph, call(method, *texts, **options))
