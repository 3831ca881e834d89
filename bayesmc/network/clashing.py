"""Data in the wrong place, told with the right one: beyond a node's plates, around its function, in evidence.

A function is called for any number of values at a time, so an array of data in a closure clashes with the
batch, unless its elements are a plate of the node.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from bayesmc.errors import EvidenceError
from bayesmc.network.node import Declaration
from bayesmc.shapes import Shape


def data_around(declaration: Declaration, plates: Shape, sizes: Iterable[int]) -> str | None:
    """What to do about an array around a node's function that has one of some sizes, no plate's among them.

    Parameters
    ----------
    plates : tuple of int
        Sizes of the node's plates.
    sizes : iterable of int
        Those that clash.

    Returns
    -------
    str or None
        None where there is no such array.
    """
    clashing = {n for n in sizes if n > 1} - set(plates)
    for seen in declaration.captured:
        shape = _data_shape(seen.now)
        size = next((n for n in shape if n in clashing), None)
        if size is None:
            continue
        name, own = seen.name, declaration.plates
        held = f"of shape {shape} from around it"
        if own:
            has = ", ".join(f"{p}={n}" for p, n in zip(own, plates, strict=True))
            return f"it reads {name!r} {held}, and the node's plates are {has}; one element each is wanted"
        return (
            f"it reads {name!r} {held}, and the node is in no plate: a function gives one value of its node. "
            f"Let {size} values be a plate, BayesNet(plates={{'row': {size}}}), and the array an input, "
            f"net.input({name!r}, plates='row'), which the function has among its arguments; declare "
            f"{declaration.name!r} with plates='row' and give infer inputs={{{name!r}: {name}}}"
        )
    return None


def sizes_in(message: str, batch: Shape) -> set[int]:
    """The sizes in what NumPy says of shapes that do not broadcast, those of values in a batch apart.

    Examples
    --------
    >>> from bayesmc.network.clashing import sizes_in
    >>> sizes_in("operands could not be broadcast together with shapes (3,2) (5,)", (3, 2))
    {5}
    """
    return {n for shape in _shapes_in(message) if shape[: len(batch)] != batch for n in shape}


def picked_by_row(
    plates: Mapping[str, int],
    vectors: Mapping[str, Shape],
    batch: Shape,
    message: str,
    elsewhere: Mapping[str, tuple[tuple[str, ...], Shape]] | None = None,
) -> str | None:
    """What to write where an array over plates has picked components of a vector parent, and adds an axis.

    Parameters
    ----------
    plates : mapping
        Of the node, with their sizes.
    vectors : mapping
        Vector parent -> its shape as it arrives, behind the batch.
    batch : tuple of int
    message : str
        It tells the shape that does not fit.
    elsewhere : mapping, optional
        Parent whose elements are of other plates -> those, and the shape of an element.

    Examples
    --------
    >>> from bayesmc.network.clashing import picked_by_row
    >>> picked_by_row({"row": 7}, {"beta": (1, 3)}, (3, 2), "batch shape (3, 2, 1, 7)")[:59]
    "its parent 'beta' is a vector and arrives as (*batch, 1, 3)"
    """
    over = tuple(plates.values())
    others = [_of_elements(n, *found, plates) for n, found in (elsewhere or {}).items()]
    for shape in _shapes_in(message):
        for name, arrives in vectors.items():
            own, rest = (*batch, *arrives[:-1]), shape[len(batch) :]
            told = f"its parent {name!r} is a vector and arrives as (*batch, {', '.join(map(str, arrives))})"
            if (
                batch
                and shape[: len(batch)] == batch
                and rest[-len(batch + over) :] == batch + over
            ):
                return (
                    f"{told}; {name}[..., k] with a k that has a batch of its own pairs every value of one "
                    f"with every value of the other: let the components be a plate and write {name}[k]"
                )
            added = shape[len(own) :]
            if not added or shape != own + added or added != over[len(over) - len(added) :]:
                continue
            each = ", ".join(f"np.arange({n})" if n > 1 else "0" for n in arrives[:-1])
            by_plate = f", or let the components be a plate and write {name}[k]"
            return (
                f"{told}, plates before components; {name}[..., k] with an array k over "
                f"{' and '.join(map(repr, plates))} keeps the axes of both, shape {shape}. Write "
                f"{name}[..., {each}, k] for each element's component k, {name}[..., 0] for the first "
                f"component of all{by_plate if max(arrives[:-1]) == 1 else ''}"
                f"{''.join(f'. Or it is {text}' for text in others)}"
            )
        if others and over and shape == (*batch, *(1 for _ in over), *over):
            return " or ".join(others)
    return None


def _of_elements(name: str, own: tuple[str, ...], event: Shape, plates: Iterable[str]) -> str:
    """What to write for the elements of a parent of other plates, or for their components."""
    zeros = ", ".join("0" for _ in plates)
    told = (
        f"its parent {name!r}, whose {'vectors' if event else 'elements'} are of "
        f"{' and '.join(map(repr, own))}: {name}.array has an axis of one for "
        f"{' and '.join(map(repr, plates))} before theirs, so write"
    )
    if event:
        index = ", ".join([*own, "k"])
        return f"{told} {name}.array[..., {zeros}, {index}] for component k of each row's element"
    picked = f"{told} {name}[{', '.join(own)}] for each row's element"
    if len(own) > 1:
        return picked
    return (
        f"{picked}, or np.vecdot(X, {name}.array) for a sum with weights X (np.matvec adds an axis)"
    )


def sizes_beyond(shape: Shape, target: Shape) -> set[int]:
    """The sizes by which a shape does not broadcast to another.

    Examples
    --------
    >>> from bayesmc.network.clashing import sizes_beyond
    >>> sizes_beyond((3, 2, 7), (3, 2)), sizes_beyond((3, 7), (3, 2)), sizes_beyond((5,), ())
    ({7}, {7}, {5})
    """
    if target and shape[: len(target)] == target:
        return {*shape[len(target) :]}
    paired = zip(reversed(shape), reversed(target), strict=False)
    return {a for a, b in paired if a not in (1, b)} | {*shape[: max(len(shape) - len(target), 0)]}


def surplus(name: str, plates: tuple[str, ...], wanted: Shape, shape: Shape) -> str:
    """What to declare where data of some shape have more axes than the node, whose values have ``wanted``.

    Examples
    --------
    >>> from bayesmc.network.clashing import surplus
    >>> surplus("y", (), (), (3,))
    "; for many values declare plates=: BayesNet(plates={'row': 3}) and plates='row' of 'y'"
    """
    more = len(shape) - len(wanted)
    if more <= 0:
        return ""
    if shape[more:] != wanted:
        return f"; the data have {_axes(more)} too many"
    free = [n for n in ("row", "column", "layer", "block") if n not in plates]
    names = free[:more] if more <= len(free) else [f"axis{k}" for k in range(more)]
    new = ", ".join(f"{p!r}: {n}" for p, n in zip(names, shape, strict=False))
    own = (*names, *plates)
    return (
        f"; for many values declare plates=: BayesNet(plates={{{new}}}) and "
        f"plates={own if len(own) > 1 else own[0]!r} of {name!r}"
    )


def many_axes(
    shapes: Mapping[str, Shape], declarations: Mapping[str, Declaration], names: tuple[str, ...]
) -> str:
    """Which of two data has more axes than its node has plates, unless its values are vectors."""
    for name in names:
        shape, node = shapes.get(name, ()), declarations[name]
        wanted = len(node.plates) + len(node.event_shape or ())
        if len(shape) > wanted:
            return (
                f"; the data of {name!r} have shape {shape}, and its plates are {node.plates}: of numbers "
                f"(not vectors) that is {_axes(len(shape) - wanted)} too many; declare a plate for each"
            )
    return ""


def refuse_misplaced(net: Any, evidence: Mapping[str, Any], inputs: Any) -> None:
    """Refuse inputs that stand in the evidence, where their values are missed.

    Raises
    ------
    EvidenceError
    """
    given = inputs if isinstance(inputs, Mapping) else {}
    for name in evidence:
        if name not in given and name in net and net[name].kind == "input":
            raise EvidenceError(
                f"evidence on {name!r}, which is an input: its value is known, not observed; pass "
                f"inputs={{{name!r}: value}} and leave it out of the evidence"
            )


# ---- private ------------------------------------------------------------------------------------


def _shapes_in(message: str) -> list[Shape]:
    """The shapes in what is said of some that do not broadcast."""
    if not any(word in message for word in ("broadcast", "mismatch", "batch shape")):
        return []
    found = re.findall(r"\(((?:\d+,? ?)+)\)", message)
    return [tuple(int(n) for n in re.findall(r"\d+", shape)) for shape in found]


def _data_shape(value: Any) -> Shape:
    """Shape of an array, a column of a data frame or a list of numbers; () of anything else."""
    if not isinstance(value, (np.ndarray, list, tuple)) and not hasattr(value, "__array__"):
        return ()
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return ()
    return array.shape if array.dtype.kind in "biuf" else ()


def _axes(count: int) -> str:
    return f"{count} axis" if count == 1 else f"{count} axes"
