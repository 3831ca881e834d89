"""Posteriors and beliefs in files: what ArviZ and xarray read of them, and all that loading needs.

Draws stand once, under ``posterior`` (``weighted_posterior`` with their weights, which ArviZ would not know
of); a finite node's as the positions of its states, with what these mean as an attribute, and numbers of
states packed the way NetCDF packs numbers. Answers without draws stand node by node under ``answers``.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bayesmc.errors import BayesmcError
from bayesmc.network import CompiledNode, Model, Observed
from bayesmc.states import StateArray
from bayesmc.storage import Group, Lazy, Saver, Variable, packed, write_image
from bayesmc.storage.blocks import refused
from bayesmc.storage.image import Stored

#: kinds of files
ANSWER, RUN = "answer", "run"
#: along which answers to many questions stand
_SETS = "evidence_set"


def save(
    answer: Any, path: str | os.PathLike[str], header: Mapping[str, Any] | None = None
) -> None:
    """Write a posterior, a belief or a posterior over time to a file, in the place of any that is there.

    ``header`` is what is said of it besides.
    """
    _write(answer, Path(path), {"kind": ANSWER}, None, header)


class RunFile(Saver):
    """The file of a run: saves blocks, and in the end the answer."""

    #: whether the answer is in the file
    finished = False

    def finish(self, answer: Any, lazily: Mapping[str, Any] | None = None) -> None:
        """Put the answer in the place of the blocks.

        Parameters
        ----------
        lazily : dict, optional
            Draws that are in blocks, by node (and ``log_weights``, ``weights``); the answer, whose arrays are
            mere stand-ins for these, then reads them from the file.

        Raises
        ------
        CheckpointError
            There is no room for it; all blocks are left as they are.
        """
        if lazily is not None:
            _take_in(answer, lazily)
        _write(answer, self.path, {"kind": ANSWER, "of": RUN}, lazily, self.header)
        self.finished = True
        if lazily is not None:
            read = Stored(self.path, mapped=True)
            places = _elsewhere(answer, lazily)
            for name in answer._stored:
                if id(answer._stored[name]) in places:
                    answer._stored[name] = read(places[id(answer._stored[name])])
            for name in ("log_weights", "weights"):
                if name in lazily:
                    setattr(answer, name, read(places[id(getattr(answer, name))]))


def state_attributes(node: CompiledNode) -> dict[str, Any]:
    """What a finite node's positions mean, as NetCDF says it."""
    domain = node.domain
    if domain is None:
        return {}
    if domain.labels is None:
        low, step = _even(node)
        return {} if (low, step) == (0.0, 1.0) else {"scale_factor": step, "add_offset": low}
    states = [str(s).replace(" ", "_") for s in domain.states]
    return {
        "flag_values": np.arange(domain.size, dtype=domain.dtype),
        "flag_meanings": " ".join(states),
        "states": json.dumps([str(s) for s in domain.states]),
    }


# ---- private ------------------------------------------------------------------------------------


def _write(
    answer: Any,
    path: Path,
    attributes: Mapping[str, Any],
    lazily: Mapping[str, Any] | None,
    header: Mapping[str, Any] | None = None,
) -> None:
    elsewhere = _elsewhere(answer, lazily)
    parts = packed({"answer": answer, "header": header}, elsewhere)
    versions = {"bayesmc_version": _version(), "class": type(answer).__name__}
    try:
        groups = groups_of(answer, elsewhere, lazily)
        write_image(path, groups, parts, {**attributes, **versions})
    except OSError as error:
        raise refused(path, error) from error


def _take_in(answer: Any, lazily: Mapping[str, Any]) -> None:
    """Hold what cannot be left in the file: draws that stand there in another form than they are kept in."""
    places = _elsewhere(answer, lazily)
    for name, lazy in lazily.items():
        stored = answer._stored.get(name)
        if isinstance(lazy, Lazy) and stored is not None and id(stored) not in places:
            whole = np.empty(lazy.shape, lazy.dtype)
            for where, piece in lazy.pieces():
                whole[where] = piece
            whole.flags.writeable = False
            answer._stored[name] = whole


def groups_of(
    answer: Any, elsewhere: Mapping[int, str], lazily: Mapping[str, Any] | None = None
) -> dict[str, Group]:
    """What xarray sees of an answer."""
    model: Model | None = getattr(answer, "model", None)
    if model is None:
        return {}
    if hasattr(answer, "_each"):
        return _groups_of_many(answer, model, elsewhere)
    coordinates: dict[str, Any] = {p: model.labels.get(p, range(n)) for p, n in model.sizes.items()}
    groups: dict[str, Group] = {}
    if hasattr(answer, "_stored"):
        name, variables = _draws(answer, model, elsewhere, lazily or {})
        chains, draws = answer._shape
        axes = {"chain": range(chains)} | ({"draw": range(draws)} if lazily is None else {})
        groups[name] = Group(variables, {**axes, **coordinates})
        told = {"diverging": "divergences", "energy": "energies"}
        rows = {n: getattr(answer, own, None) for n, own in told.items()}
        stats = {n: Variable(("chain", "draw"), v) for n, v in rows.items() if v is not None}
        if stats:
            groups["sample_stats"] = Group(stats, axes)
    else:
        found = _answers(answer, model)
        if found:
            groups["answers"] = Group(found, coordinates)
    seen = getattr(answer, "_seen", {})
    if seen:
        groups["observed_data"] = Group(observed_variables(model, seen), coordinates)
    return groups


def _groups_of_many(answer: Any, model: Model, elsewhere: Mapping[int, str]) -> dict[str, Group]:
    """Answers of all evidence sets side by side, and the groups of each, below a group of its own."""
    coordinates: dict[str, Any] = {p: model.labels.get(p, range(n)) for p, n in model.sizes.items()}
    groups: dict[str, Group] = {}
    found = _answers(answer, model) if answer.done.any() else {}
    if found:
        found["log_marginal_likelihood"] = Variable((_SETS,), answer.log_marginal_likelihood)
        groups["answers"] = Group(found, {_SETS: range(len(answer)), **coordinates})
    for k, one in answer._each():
        own = {n: g for n, g in groups_of(one, elsewhere).items() if n != "answers"}
        groups |= {f"set{k}/{name}": group for name, group in own.items()}
    return groups


def observed_variables(model: Model, seen: Mapping[str, Observed]) -> dict[str, Variable]:
    """What was observed, with gaps where nothing was."""
    return {n: Variable(_dims(model[n]), _gapped(model[n], o)) for n, o in seen.items()}


def _gapped(node: CompiledNode, seen: Observed) -> np.ndarray:
    values = node.decode(seen.value)
    if isinstance(values, StateArray):
        labels = np.array(values.labels, dtype=object)
        if seen.mask is not None:
            labels[~seen.mask] = ""
        return labels
    if seen.mask is None:
        return np.asarray(values)
    numbers = np.array(values, dtype=float)
    numbers[~seen.mask] = np.nan
    return numbers


def _draws(
    answer: Any, model: Model, elsewhere: Mapping[int, str], lazily: Mapping[str, Any]
) -> tuple[str, dict[str, Variable]]:
    """The draws of all nodes: with them stand log weights where there are any."""
    weighted = answer.log_weights is not None
    found: dict[str, Variable] = {}
    for name, stored in answer._stored.items():
        node = model[name]
        dims = ("chain", "draw", *_dims(node))
        if id(stored) in elsewhere:
            found[name] = Variable(dims, lazily.get(name, stored), state_attributes(node))
        elif node.kind != "fixed" and name not in answer._observed:
            values = answer[name]
            values = values.labels if isinstance(values, StateArray) else values
            found[name] = Variable(dims, np.asarray(values))
    if weighted:
        for name in ("log_weights", "weights"):
            own = getattr(answer, name)
            found[name] = Variable(("chain", "draw"), lazily.get(name, own))
    return ("weighted_posterior" if weighted else "posterior"), found


def _elsewhere(answer: Any, lazily: Mapping[str, Any] | None) -> dict[int, str]:
    """Arrays that stand where ArviZ looks for draws, and are not packed besides."""
    found: dict[int, str] = {}
    if hasattr(answer, "_each"):
        for k, one in answer._each():
            found |= {at: f"set{k}/{name}" for at, name in _elsewhere(one, None).items()}
    if not hasattr(answer, "_stored"):
        return found
    weighted = answer.log_weights is not None
    group = "weighted_posterior" if weighted else "posterior"
    for name, stored in answer._stored.items():
        node = answer.model[name]
        whole = stored.shape == answer._shape + node.value_shape and stored.size > 0
        plain = stored.dtype.kind in "iuf"
        if whole and plain and (node.domain is None or _is_positional(node)):
            found[id(stored)] = f"{group}/{name.replace('/', '∕')}"
    if weighted:
        found[id(answer.log_weights)] = f"{group}/log_weights"
        found[id(answer.weights)] = f"{group}/weights"
    return found


def _is_positional(node: CompiledNode) -> bool:
    """Whether positions say the states, by a formula or by what they mean."""
    return node.domain is not None and (node.domain.labels is not None or _even(node)[1] != 0.0)


def _even(node: CompiledNode) -> tuple[float, float]:
    """First state and distance of states that are evenly spaced; a distance of 0 where they are not."""
    assert node.domain is not None
    numbers = np.asarray(node.domain.numbers, dtype=float)
    if len(numbers) < 2:
        return (float(numbers[0]) if len(numbers) else 0.0), 1.0
    steps = np.diff(numbers)
    return float(numbers[0]), float(steps[0]) if (steps == steps[0]).all() else 0.0


def _dims(node: CompiledNode) -> tuple[str, ...]:
    return (*node.plates, *(f"{node.name}_dim_{i}" for i in range(len(node.event_shape))))


def _answers(answer: Any, model: Model) -> dict[str, Variable]:
    """Means, variances and probabilities of every node that has them; time first, where there is time."""
    found: dict[str, Variable] = {}
    for name in answer.names if hasattr(answer, "names") else ():
        node = model[name]
        for what, ask, more in (
            ("mean", answer.mean, ()),
            ("var", answer.var, ()),
            ("probabilities", answer.probabilities, (f"{name}_state",)),
        ):
            if what == "probabilities" and node.domain is None:
                continue
            try:
                value = np.asarray(ask(name), dtype=float)
            except (BayesmcError, ValueError):
                continue
            dims = (*_dims(node), *more)
            if value.ndim == len(dims) + 1:
                dims = (_SETS if hasattr(answer, "_each") else "time", *dims)
            if value.ndim == len(dims):
                found[f"{name}_{what}"] = Variable(dims, value)
    increments = getattr(answer, "log_marginal_increments", None)
    if increments is not None and np.ndim(increments) == 1 and len(increments):
        found["log_marginal_increments"] = Variable(("time",), increments)
    return found


def _version() -> str:
    return str(getattr(sys.modules.get("bayesmc"), "__version__", ""))


__all__ = ["ANSWER", "RUN", "Lazy", "RunFile", "groups_of", "observed_variables", "save"]
