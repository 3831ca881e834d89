"""From XMLBIF to records: variables, definitions, and the tables in them.

It builds no net and checks no cycle. The format is the "Interchange Format for Bayesian Networks",
XMLBIF 0.3 (Cozman, 1998).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np

from bayesmc.errors import FileFormatError
from bayesmc.io.record import TableNode
from bayesmc.io.rows import first_improbable, renormalised, sum_fault
from bayesmc.io.xmlbif.elements import Element, parse_elements


def parse_xmlbif(data: bytes | str, path: Any = None) -> list[TableNode]:
    """The variables of an XMLBIF file, in the order in which the file declares them.

    A ``TABLE`` lists its numbers with the outcomes of the variable it is ``FOR`` fastest and the
    first ``GIVEN`` slowest. Rows whose sum is off by rounding (at most 1e-6, or 5e-7 for each entry)
    are renormalised. Only random variables (``TYPE="nature"``) are read, one ``FOR`` to a definition.
    Blanks around names are dropped, and so are the properties of the network and of definitions.

    Parameters
    ----------
    data : bytes or str
        The file's content; bytes are decoded as the XML declaration says.
    path : str or path-like, optional
        Named in errors; nothing is opened.

    Raises
    ------
    FileFormatError
        With the line (from 1): malformed XML, entities, elements that are not of the format,
        decisions and utilities, unknown or repeated names, a variable without definition or with
        two, a wrong number of entries, or a row that is no probability vector.

    Examples
    --------
    >>> from bayesmc.io.xmlbif import parse_xmlbif
    >>> text = '''<BIF VERSION="0.3"><NETWORK><NAME>tiny</NAME>
    ... <VARIABLE><NAME>age</NAME> <OUTCOME>young</OUTCOME> <OUTCOME>old</OUTCOME></VARIABLE>
    ... <VARIABLE><NAME>ill</NAME> <OUTCOME>yes</OUTCOME> <OUTCOME>no</OUTCOME></VARIABLE>
    ... <DEFINITION><FOR>age</FOR> <TABLE>0.4 0.6</TABLE></DEFINITION>
    ... <DEFINITION><FOR>ill</FOR> <GIVEN>age</GIVEN>
    ...   <TABLE> 0.1 0.9 <!-- young --> 0.3 0.7 <!-- old --> </TABLE></DEFINITION>
    ... </NETWORK></BIF>'''
    >>> age, ill = parse_xmlbif(text)
    >>> age.states, ill.parents
    (('young', 'old'), ('age',))
    >>> ill.probs[age.states.index("old")]
    array([0.3, 0.7])

    References
    ----------
    Cozman, F. G. (1998). The Interchange Format for Bayesian Networks, XMLBIF version 0.3.
    """
    return _Reader(path).nodes(parse_elements(data, path))


class _Reader:
    """Definitions may precede their variables, so that variables are read first."""

    def __init__(self, path: Any) -> None:
        self.path = path
        self.variables: dict[str, Element] = {}
        self.states: dict[str, tuple[str, ...]] = {}

    def nodes(self, root: Element) -> list[TableNode]:
        network = self.only(root, "NETWORK", "the file")
        for element in network.all("VARIABLE"):
            self.read_variable(element)
        definitions: dict[str, Element] = {}
        for element in network.all("DEFINITION"):
            name = self.only(element, "FOR", "this DEFINITION").text
            if name in definitions:
                self.fail(
                    f"variable {name!r} has a second DEFINITION; the first is on line "
                    f"{definitions[name].line}",
                    element,
                )
            definitions[name] = element
            self.check_scope(name, element)
        for name, element in self.variables.items():
            if name not in definitions:
                self.fail(f"variable {name!r} has no DEFINITION; add one", element)
        return [self.node(name, definitions[name]) for name in self.variables]

    def read_variable(self, element: Element) -> None:
        name = self.only(element, "NAME", "this VARIABLE").text
        if not name:
            self.fail("this VARIABLE has an empty NAME", element)
        kind = element.attributes.get("TYPE", "nature").strip().lower()
        if kind != "nature":
            self.fail(
                f"variable {name!r} is of TYPE {kind!r}; a Bayes net has random variables only, "
                "TYPE 'nature'",
                element,
            )
        if name in self.variables:
            self.fail(f"variable {name!r} is declared twice", element)
        outcomes = element.all("OUTCOME")
        states = tuple(outcome.text for outcome in outcomes)
        if not states:
            self.fail(f"variable {name!r} has no OUTCOME", element)
        for k, (state, outcome) in enumerate(zip(states, outcomes, strict=True)):
            if not state:
                self.fail(f"variable {name!r} has an empty OUTCOME", outcome)
            if state in states[:k]:
                self.fail(f"variable {name!r} lists the outcome {state!r} twice", outcome)
        self.variables[name] = element
        self.states[name] = states

    def check_scope(self, name: str, definition: Element) -> None:
        scope = [*definition.all("FOR"), *definition.all("GIVEN")]
        for k, element in enumerate(scope):
            if element.text not in self.variables:
                self.fail(
                    f"definition of {name!r}: {element.text!r} is not a declared variable", element
                )
            if element.text in [other.text for other in scope[:k]]:
                self.fail(f"definition of {name!r}: {element.text!r} is listed twice", element)

    def node(self, name: str, definition: Element) -> TableNode:
        parents = tuple(element.text for element in definition.all("GIVEN"))
        probs = self.read_table(name, parents, definition)
        probs.flags.writeable = False
        texts = (element.text for element in self.variables[name].all("PROPERTY"))
        properties = tuple(text for text in texts if text)
        return TableNode(name, self.states[name], parents, probs, properties, definition.line)

    def read_table(self, name: str, parents: Sequence[str], definition: Element) -> np.ndarray:
        shape = [len(self.states[variable]) for variable in (*parents, name)]
        inside = f"definition of {name!r}"
        table = self.only(definition, "TABLE", inside)
        values = self.numbers(table, inside)
        if len(values) != math.prod(shape):
            sizes = " x ".join(map(str, shape))
            self.fail(
                f"{inside}: expected {math.prod(shape)} numbers ({sizes}), found {len(values)}",
                table,
            )
        bad = first_improbable(values)
        if bad is not None:
            message = f"{inside}: {table.words()[bad]} is not a probability"
            raise FileFormatError(message, self.path, table.line_of(bad))
        rows = np.array(values).reshape(-1, shape[-1])
        normal, bad = renormalised(rows)
        if bad is not None:
            message = f"{inside}: {sum_fault(rows[bad])}"
            raise FileFormatError(message, self.path, table.line_of(bad * shape[-1]))
        return normal.reshape(shape)

    def numbers(self, table: Element, inside: str) -> list[float]:
        values = []
        for k, word in enumerate(table.words()):
            try:
                if "_" in word:  # float() would take 0_5 for 5
                    raise ValueError
                values.append(float(word))
            except ValueError:
                message = f"{inside}: {word!r} is not a number"
                raise FileFormatError(message, self.path, table.line_of(k)) from None
        return values

    def only(self, parent: Element, tag: str, where: str) -> Element:
        """The one child of a kind."""
        found = parent.all(tag)
        if len(found) != 1:
            count = "no" if not found else str(len(found))
            self.fail(
                f"{where} has {count} {tag}; give one", found[1] if len(found) > 1 else parent
            )
        return found[0]

    def fail(self, message: str, element: Element) -> NoReturn:
        raise FileFormatError(message, self.path, element.line)
