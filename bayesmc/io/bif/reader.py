"""From BIF text to records: the blocks of the file, and the tables in them.

It builds no net and checks no cycle.

The grammar is that of the "Interchange Format for Bayesian Networks" (UAI, 1998), as the bnlearn
repository and JavaBayes write it, comments and ``property`` lines included.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from bayesmc.io.bif.cursor import NAME, Cursor, after_gap, word_offset
from bayesmc.io.record import TableNode
from bayesmc.io.rows import first_improbable, renormalised, sum_fault


def parse_bif(text: str, path: Any = None) -> list[TableNode]:
    """The variables of a BIF file, in the order in which the file declares them.

    Rows ``(states of the parents) numbers;`` may come in any order; ``default numbers;`` fills the
    rows not given. A ``table`` with parents lists its numbers with the child slowest and the last
    parent fastest, as the format's definition does. Rows whose sum is off by rounding
    (at most 1e-6, or 5e-7 for each entry) are renormalised.

    Parameters
    ----------
    text : str
        The file's content.
    path : str or path-like, optional
        Named in errors; nothing is opened.

    Raises
    ------
    FileFormatError
        With the line (from 1), for anything that does not read as BIF: unknown or repeated names,
        states, rows or blocks, missing rows, a wrong number of entries, an entry that is not a
        probability, a row that does not sum to 1, or a file that ends in the middle of a block.

    Examples
    --------
    >>> from bayesmc.io.bif import parse_bif
    >>> text = '''network tiny { }
    ... variable age { type discrete [ 2 ] { <5, 5-12 }; }
    ... variable ill { type discrete [ 2 ] { yes, no }; }
    ... probability ( age ) { table 0.4, 0.6; }
    ... probability ( ill | age ) { (5-12) 0.1, 0.9; (<5) 0.3, 0.7; }'''
    >>> age, ill = parse_bif(text)
    >>> age.states, ill.parents
    (('<5', '5-12'), ('age',))
    >>> ill.probs[age.states.index("<5")]
    array([0.3, 0.7])
    """
    return _Reader(text, path).nodes()


# Possessive, as backtracking into an unclosed block would take exponential time.
_TO_CLOSING_BRACE = re.compile(r'(?:[^"{}]++|"[^"\n]*+")*+\}')
_NETWORK_HEAD = re.compile(rf"(?:{NAME})?[^{{}}]*\{{")
_TYPE = re.compile(r'discrete\s*\[\s*(\d+)\s*\]\s*\{((?:"[^"\n]*"|[^"{};])*)\}\s*;')
_SCOPE = re.compile(r'\(((?:"[^"\n]*"|[^"(){};])*)\)\s*\{')
_ROW = re.compile(r'\(((?:"[^"\n]*"|[^"();])*)\)([^;{}()"]*);')
_NUMBERS = re.compile(r'([^;{}()"]*);')


@dataclass
class _Variable:
    """A variable block, before its probability block is known."""

    at: int
    states: tuple[str, ...]
    codes: Mapping[str, int]
    properties: tuple[str, ...]


class _Row(NamedTuple):
    """The numbers of one row, and where it starts."""

    at: int
    numbers: list[float]


@dataclass
class _Entries:
    """What one probability block gives."""

    rows: dict[int, _Row] = field(default_factory=dict)
    default: _Row | None = None
    table: _Row | None = None


class _Reader(Cursor):
    """What is known of the file so far; blocks may come in any order."""

    def __init__(self, text: str, path: Any) -> None:
        super().__init__(text, path)
        self.variables: dict[str, _Variable] = {}
        self.tables: dict[str, tuple[tuple[str, ...], np.ndarray, int]] = {}

    def nodes(self) -> list[TableNode]:
        blocks: list[int] = []  # probability blocks wait: they may precede their variables
        while (keyword := self.keyword("")) is not None:
            at = self.at
            if keyword == "network":
                self.skip_network(at)
            elif keyword == "variable":
                self.read_variable(at)
            elif keyword == "probability":
                blocks.append(at)
                self.skip_block(at, "probability")
            else:
                self.fail(f"expected 'network', 'variable' or 'probability', found {keyword!r}")
        line, counted = 1, 0
        for at in blocks:
            line, counted = line + self.text.count("\n", counted, at), at
            self.at = at
            self.read_probability(at, line)
        return [self.node(name, variable) for name, variable in self.variables.items()]

    def node(self, name: str, variable: _Variable) -> TableNode:
        if name not in self.tables:
            self.fail(f"variable {name!r} has no probability block; add one", variable.at)
        parents, probs, line = self.tables[name]
        probs.flags.writeable = False
        return TableNode(name, variable.states, parents, probs, variable.properties, line)

    def skip_network(self, at: int) -> None:
        match = _NETWORK_HEAD.match(self.text, self.at)
        if match is None:
            self.fail("the network block does not open with '{'", at)
        self.at = match.end()
        while (keyword := self.keyword("the network block")) != "}":
            if keyword != "property":
                self.fail(f"expected 'property' or '}}' in the network block, found {keyword!r}")
            self.property_text()

    def skip_block(self, at: int, what: str) -> None:
        match = _SCOPE.match(self.text, self.at)
        if match is None:
            self.fail(f"expected '( child | parents ) {{' after '{what}'", at)
        self.at = match.end()
        end = _TO_CLOSING_BRACE.match(self.text, self.at)
        if end is None:
            self.fail(f"this {what} block is not closed by '}}'; the file looks truncated", at)
        self.at = end.end()

    def read_variable(self, at: int) -> None:
        name = self.name_before_brace(at)
        if name in self.variables:
            self.fail(f"variable {name!r} is declared twice", at)
        states: tuple[str, ...] | None = None
        properties = []
        inside = f"the block of variable {name!r}"
        while (keyword := self.keyword(inside)) != "}":
            if keyword == "property":
                properties.append(self.property_text())
            elif keyword == "type" and states is None:
                states = self.read_states(name)
            else:
                self.fail(f"expected one 'type', 'property' or '}}' in {inside}, found {keyword!r}")
        if states is None:
            self.fail(f"variable {name!r} has no 'type discrete [ n ] {{ ... }};'", at)
        codes = {state: code for code, state in enumerate(states)}
        self.variables[name] = _Variable(at, states, codes, tuple(properties))

    def read_states(self, name: str) -> tuple[str, ...]:
        match = _TYPE.match(self.text, self.at)
        if match is None:
            self.fail(f"variable {name!r}: expected 'discrete [ n ] {{ states }};' after 'type'")
        states = self.names(match[2], match.start(2))
        if len(states) != int(match[1]) or not states:
            self.fail(
                f"variable {name!r} announces {match[1]} states and lists {len(states)}: "
                f"{', '.join(states)} (a state that holds a space needs double quotes)"
            )
        if len(set(states)) != len(states):
            self.fail(f"variable {name!r} lists a state twice: {', '.join(states)}")
        self.at = match.end()
        return states

    def read_probability(self, at: int, line: int) -> None:
        scope = _SCOPE.match(self.text, self.at)
        assert scope is not None  # the first pass matched it here
        child, *parents = self.names(scope[1], scope.start(1)) or ("",)
        for name in (child, *parents):
            if name not in self.variables:
                self.fail(f"probability of {child!r}: {name!r} is not a declared variable", at)
        if len({child, *parents}) != 1 + len(parents):
            self.fail(f"probability of {child!r}: a variable is listed twice in its scope", at)
        if child in self.tables:
            self.fail(f"variable {child!r} has a second probability block", at)
        self.at = scope.end()
        self.tables[child] = (tuple(parents), self.read_table(child, parents, at), line)

    def read_table(self, child: str, parents: list[str], at: int) -> np.ndarray:
        """The table of one block; ``self.at`` is after its opening brace."""
        shape = [len(self.variables[p].states) for p in parents]
        shape.append(len(self.variables[child].states))
        size, count = shape[-1], math.prod(shape[:-1])
        entries = self.read_entries(child, parents, size, count)
        if entries.table is not None:
            if entries.rows or entries.default is not None:
                self.fail(f"probability of {child!r} mixes 'table' with rows", entries.table.at)
            table = np.array(entries.table.numbers).reshape(size, count).T.copy()
            lines = [entries.table.at] * count
        else:
            rows = self.completed(entries, child, parents, shape[:-1], at)
            table = np.array([row.numbers for row in rows])
            lines = [row.at for row in rows]
        normal, bad = renormalised(table)
        if bad is not None:
            self.fail(f"probability of {child!r}: {sum_fault(table[bad])}", lines[bad])
        return normal.reshape(shape)

    def read_entries(self, child: str, parents: list[str], size: int, count: int) -> _Entries:
        """Everything up to the block's closing brace."""
        codes = [self.variables[p].codes for p in parents]
        found = _Entries()
        while True:
            self.at = start = after_gap(self.text, self.at)
            row = _ROW.match(self.text, start)
            if row is not None:
                index = self.row_index(row[1], row.start(1), child, parents, codes)
                if index in found.rows:
                    self.fail(f"probability of {child!r}: row ({row[1].strip()}) is given twice")
                numbers = self.probabilities(row[2], row.start(2), size, child)
                found.rows[index] = _Row(start, numbers)
                self.at = row.end()
                continue
            if self.text.startswith("(", start):
                self.fail(f"probability of {child!r}: expected '(states) numbers;'")
            keyword = self.keyword(f"the probability block of {child!r}")
            if keyword == "}":
                return found
            if keyword == "property":
                self.property_text()
                continue
            match = _NUMBERS.match(self.text, self.at)
            if keyword == "table" and match and found.table is None:
                numbers = self.probabilities(match[1], match.start(1), size * count, child)
                found.table = _Row(start, numbers)
            elif keyword == "default" and match and found.default is None:
                numbers = self.probabilities(match[1], match.start(1), size, child)
                found.default = _Row(start, numbers)
            else:
                self.fail(
                    f"probability of {child!r}: expected '(states) numbers;', one 'table numbers;' "
                    f"or one 'default numbers;', found {keyword!r}",
                    start,
                )
            self.at = match.end()

    def completed(
        self, entries: _Entries, child: str, parents: list[str], shape: list[int], at: int
    ) -> list[_Row]:
        """One row per configuration of the parents, the default where none is given."""
        count = math.prod(shape)
        if entries.default is None and len(entries.rows) < count:
            first = next(k for k in range(count) if k not in entries.rows)
            states = np.unravel_index(first, shape) if parents else ()
            named = [self.variables[p].states[k] for p, k in zip(parents, states, strict=True)]
            self.fail(
                f"probability of {child!r}: {count - len(entries.rows)} of {count} rows are "
                f"missing, first ({', '.join(named)}); give them, or a 'default' row",
                at,
            )
        return [entries.rows.get(k, entries.default) for k in range(count)]  # type: ignore[misc]

    def row_index(
        self, text: str, at: int, child: str, parents: list[str], codes: list[Mapping[str, int]]
    ) -> int:
        names = self.names(text, at)
        if len(names) != len(parents):
            self.fail(
                f"probability of {child!r}: row ({text.strip()}) names {len(names)} states for "
                f"{len(parents)} parents ({', '.join(parents)})"
            )
        index = 0
        for name, parent, code in zip(names, parents, codes, strict=True):
            if name not in code:
                self.fail(
                    f"probability of {child!r}: {name!r} is not a state of its parent {parent!r} "
                    f"({', '.join(code)})"
                )
            index = index * len(code) + code[name]
        return index

    def probabilities(self, text: str, at: int, count: int, child: str) -> list[float]:
        inside = f"probability of {child!r}"
        values = self.numbers(text, at, inside)
        if len(values) != count:
            self.fail(f"{inside}: expected {count} numbers, found {len(values)}")
        bad = first_improbable(values)
        if bad is not None:
            word = text.replace(",", " ").split()[bad]
            self.fail(f"{inside}: {word} is not a probability", at + word_offset(text, bad))
        return values
