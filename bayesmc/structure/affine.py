"""Which nodes are linear-Gaussian in the hidden continuous nodes above them, read off their expressions."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayesmc.distributions import Distribution, MvNormal, Normal
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Call,
    Expression,
    Family,
    Program,
    broadcast,
    expressions_of,
    ordered,
    rebuilt,
)
from bayesmc.network import CompiledNode, Model, Observed
from bayesmc.network.expressions import (
    Followed,
    NodeCall,
    Opaque,
    density,
    value_of,
)
from bayesmc.network.given import read_given
from bayesmc.network.model import deterministic_above
from bayesmc.passes.affine import affine
from bayesmc.passes.arithmetic import ZERO
from bayesmc.passes.templates import without_names

_GAUSSIAN = (Normal, MvNormal)


class NotLinearError(TraceError):
    """A node is not linear-Gaussian, or not seen to be; the message goes on after the node's name."""


@dataclass(frozen=True, eq=False)
class Gains:
    """Coefficients of the elements of one node.

    Attributes
    ----------
    gain, at : ndarray, shape (*batch, *value shape, k)
        Coefficients and flat positions of the elements that they belong to.
    """

    gain: np.ndarray
    at: np.ndarray


@dataclass(frozen=True, eq=False)
class LinearNode:
    """A Normal, MvNormal or deterministic node, affine in some hidden ones.

    Attributes
    ----------
    mean : LinearMean
    scale : Family, Distribution or None
        The family without its mean, or a distribution of no parents; None of a deterministic node.
    """

    mean: LinearMean
    scale: Any

    @cached_property
    def _program(self) -> Program:
        return Program(list(expressions_of(self.scale)))

    def __call__(self, values: Mapping[str, np.ndarray]) -> tuple[Any, dict[str, Gains]]:
        """What the function returns where the hidden nodes are 0, and coefficients by node.

        Parameters
        ----------
        values : dict
            Stored values of all other leaves, a batch in front or not.

        Returns
        -------
        Distribution or ndarray
        dict
        """
        if isinstance(self.scale, Distribution):
            return self.scale, {}
        offset, gains = self.mean(values)
        if self.scale is None:
            return np.asarray(offset), gains
        own = rebuilt(list(self.scale.parameters.values()), iter(self._program(values)))
        return self.scale.make(offset, **dict(zip(self.scale.parameters, own, strict=True))), gains


@dataclass(frozen=True, eq=False)
class LinearMean:
    """An affine mean, which others that are the same but for constants and names share.

    Attributes
    ----------
    program : Program
        Of the offset, then of gains and positions of each hidden leaf.
    hidden : tuple of str
    names : dict
        Leaf of the program -> node.
    constants : dict
        Values of the program's other leaves.
    """

    program: Program
    hidden: tuple[str, ...]
    names: Mapping[str, str]
    constants: Mapping[str, np.ndarray]

    def __call__(self, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, dict[str, Gains]]:
        known = {leaf: values[n] for leaf, n in self.names.items() if n in values}
        offset, *parts = self.program({**known, **self.constants})
        pairs = zip(parts[::2], parts[1::2], strict=True)
        return offset, {self.names[n]: Gains(*p) for n, p in zip(self.hidden, pairs, strict=True)}


def linear_node(
    model: Model,
    name: str,
    hidden: Collection[str],
    cut: frozenset[str],
    values: Mapping[str, np.ndarray],
) -> LinearNode:
    """A node as an affine mean and a scale free of hidden nodes.

    Parameters
    ----------
    hidden : collection of str
        Continuous nodes whose values are not known.
    cut : frozenset of str
        Deterministic nodes that are leaves, too.
    values : dict
        Of other leaves, a batch in front or not: functions that cannot be followed without are read with
        these in place.

    Raises
    ------
    NotLinearError
    """
    found = density(model, name, cut)
    above = found.leaves.intersection(hidden)
    if isinstance(found, Followed):
        known = model.cache.setdefault("linear nodes", {})
        key = found, above
        try:
            if key not in known:
                known[key] = _linear(model, model[name], found.result, above, cut)
            return known[key]
        except NotLinearError:
            if not _calls_nodes(found):
                raise
    try:
        if isinstance(found, Opaque) and above == found.leaves:  # nothing that is known would help
            raise TraceError(found.reason)
        known = {n: values[n] for n in values if n not in above}
        result = read_given(model, name, known, cut)
    except TraceError as error:
        on = f"depends on the continuous {_nodes(model, above)} in a way that " if above else ""
        raise NotLinearError(f"{on}cannot be traced ({error})") from error
    return _linear(model, model[name], result, above, cut)


def is_hidden(node: CompiledNode, observed: Mapping[str, Observed]) -> bool:
    """Whether a node is continuous and at least partly unobserved."""
    seen = observed.get(node.name)
    free = seen is None or seen.mask is not None
    return node.is_stochastic and not node.is_discrete and node.domain is None and free


def gaussian_nodes(model: Model, observed: Mapping[str, Observed]) -> tuple[str, ...]:
    """The hidden continuous nodes, and observed ones that depend on them."""
    found = _carried(model, observed)
    return tuple(
        name
        for name, node in model.nodes.items()
        if is_hidden(node, observed)
        or (node.is_stochastic and name in observed and _reaching(node.parents, found))
    )


def finite_leaves(model: Model) -> frozenset[str]:
    """Deterministic nodes with a finite domain, which are variables of their own."""
    if "finite leaves" not in model.cache:
        model.cache["finite leaves"] = frozenset(
            n for n, node in model.nodes.items() if node.kind == "deterministic" and node.domain
        )
    return model.cache["finite leaves"]


def why_not_linear(
    model: Model, observed: Mapping[str, Observed], inputs: Mapping[str, np.ndarray]
) -> str | None:
    """Why a net with this evidence is no conditional linear-Gaussian net, or None.

    Discrete nodes must not depend on hidden continuous ones; hidden continuous nodes and whatever observed
    depends on them must be Normal or MvNormal, with a mean affine in them and a scale free of them.
    """
    kept = model.cache.setdefault("why not linear", {})
    pattern = frozenset((name, seen.mask is None) for name, seen in observed.items())
    if pattern in kept:  # what expressions tell holds for all values
        return kept[pattern]
    if len(kept) > 256:
        kept.clear()
    reason = kept[pattern] = _find_reason(model, observed, inputs)
    return reason


def affine_nodes(
    model: Model, observed: Mapping[str, Observed], inputs: Mapping[str, np.ndarray]
) -> Iterator[str]:
    """Deterministic nodes that are affine in hidden continuous ones."""
    found = _carried(model, observed)
    question = _question(model, observed, inputs)
    for name, node in model.nodes.items():
        if node.kind == "deterministic" and found[name] and node.domain is None:
            try:
                linear_node(model, name, *question)
            except NotLinearError:
                continue
            yield name


# ---- private ------------------------------------------------------------------------------------


def _carried(model: Model, observed: Mapping[str, Observed]) -> dict[str, tuple[str, ...]]:
    """For every node the hidden continuous nodes whose values it hands on to its children.

    A hidden continuous node hands on itself, a deterministic node what its parents do.
    """
    found: dict[str, tuple[str, ...]] = {}
    for name, node in model.nodes.items():
        if is_hidden(node, observed):
            found[name] = (name,)
        elif node.kind == "deterministic":
            found[name] = _reaching(node.parents, found)
        else:
            found[name] = ()
    return found


def _reaching(parents: Iterable[str], found: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """The hidden continuous nodes that reach a function through its parents."""
    return tuple(dict.fromkeys(source for p in parents for source in found[p]))


def _question(
    model: Model, observed: Mapping[str, Observed], inputs: Mapping[str, np.ndarray]
) -> tuple[frozenset[str], frozenset[str], dict[str, np.ndarray]]:
    """Hidden continuous nodes, finite leaves, and possible values of all others."""
    hidden = frozenset(n for n, node in model.nodes.items() if is_hidden(node, observed))
    seen = {n: o.value for n, o in observed.items() if o.mask is None}
    leaves = finite_leaves(model)
    possible = {n: model.probe[n] for n in model.nodes if n not in hidden}
    values = {
        n: v
        for n, v in {**possible, **inputs, **seen}.items()
        if model[n].kind != "deterministic" or n in leaves
    }
    return hidden, leaves, values


def _find_reason(
    model: Model, observed: Mapping[str, Observed], inputs: Mapping[str, np.ndarray]
) -> str | None:
    found = _carried(model, observed)
    question = _question(model, observed, inputs)
    for name, node in model.nodes.items():
        above = _reaching(node.parents, found)
        why = None
        if node.kind == "deterministic":
            if above and node.domain is not None:
                on = _nodes(model, above)
                why = f"takes finitely many values, which depend on the continuous {on}"
        elif node.is_stochastic and (node.is_discrete or node.domain is not None):
            why = _why_not_discrete_child(model, node, above, observed.get(name))
        elif is_hidden(node, observed) or (node.is_stochastic and above):
            if len(node.event_shape) > 1:
                why = f"is a matrix of shape {node.event_shape}"
            else:
                try:
                    linear_node(model, name, *question)
                except NotLinearError as error:
                    why = str(error)
        if why is not None:
            return f"node {name!r} {why}"
    for name, (potential, _) in model.potentials.items():
        above = _reaching(potential.parents, found)
        if above:
            return f"potential {name!r} depends on the continuous {_nodes(model, above)}"
    return None


def _why_not_discrete_child(
    model: Model, node: CompiledNode, above: tuple[str, ...], seen: Observed | None
) -> str | None:
    if above:
        return f"is discrete and depends on the continuous {_nodes(model, above)}"
    if node.domain is None and (seen is None or seen.mask is not None):
        assert node.support is not None
        partly = "" if seen is None else "observed only in part and "
        return f"is {partly}discrete with too many values to enumerate ({node.support.describe()})"
    return None


def _linear(
    model: Model, node: CompiledNode, result: Any, hidden: frozenset[str], cut: frozenset[str]
) -> LinearNode:
    if not node.is_stochastic:
        return LinearNode(_mean(model, node, result, hidden, cut), None)
    family = result.make if isinstance(result, Family) else type(result)
    if family not in _GAUSSIAN:
        on = f" (it depends on the continuous {_nodes(model, hidden)})" if hidden else ""
        name = getattr(family, "__name__", "a distribution of scipy.stats")
        raise NotLinearError(f"is {name}, not Normal or MvNormal{on}")
    if isinstance(result, Distribution):
        return LinearNode(_mean(model, node, ZERO, hidden, cut), result)
    for key, value in result.parameters.items():
        bent = frozenset().union(*(e.leaves for e in expressions_of(value))) & hidden
        if key != "loc" and bent:
            raise NotLinearError(
                f"has a {key} that depends on the continuous {_nodes(model, bent)}"
            )
    parameters = dict(result.parameters)
    mean = _mean(model, node, parameters.pop("loc"), hidden, cut)
    return LinearNode(mean, Family(result.make, parameters))


def _mean(
    model: Model,
    node: CompiledNode,
    value: Expression,
    hidden: frozenset[str],
    cut: frozenset[str],
) -> LinearMean:
    """The affine form of a mean, in the shape of the node's values."""
    value = broadcast(value, np.broadcast_shapes(value.shape, node.value_shape))
    like, constants, names = without_names(value)
    places = tuple(n for n, of in names.items() if of in hidden)
    forms = model.cache.setdefault("affine forms", {})
    if (like, places) not in forms:
        try:
            form = affine(like, places)
        except TraceError as error:
            above = _nodes(model, value.leaves & hidden)
            after = str(error).removesuffix(" is not affine")
            where = _first_bent(model, node, hidden, cut)
            what = "a mean that is" if node.is_stochastic else "values that are"
            raise NotLinearError(
                f"has {what} not known to be affine in {above} (after {after}{where})"
            ) from error
        parts = [e for r in form.reads.values() for e in (r.gain, r.at)]
        forms[like, places] = Program([form.offset, *parts]), tuple(form.reads)
    program, read = forms[like, places]
    return LinearMean(program, read, names, constants)


def _calls_nodes(found: Followed) -> bool:
    """Whether a deterministic node above cannot be followed."""
    return any(
        isinstance(node, Call) and isinstance(node.call, NodeCall)
        for node in ordered(*expressions_of(found.result))
    )


def _first_bent(
    model: Model, node: CompiledNode, hidden: frozenset[str], cut: frozenset[str]
) -> str:
    """The first deterministic node above one that is not affine, if any, in words."""
    for name in deterministic_above(model, node.name, cut):
        try:
            affine(value_of(model, name, cut), hidden)
        except TraceError:
            return f" in node {name!r}"
    return ""


def _nodes(model: Model, names: Collection[str]) -> str:
    """Names of nodes in the order of the net, in words."""
    ordered = [n for n in model.nodes if n in names]
    return ("node " if len(ordered) == 1 else "nodes ") + ", ".join(map(repr, ordered))
