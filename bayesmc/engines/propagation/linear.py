"""Normal nodes that are linear in coordinates given finite variables: exact, or mixtures of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from bayesmc.engines.propagation.coordinates import Numbers
from bayesmc.engines.propagation.scopes import Rows
from bayesmc.engines.propagation.scores import NormalScores
from bayesmc.errors import UnsupportedError, ZeroProbabilityError
from bayesmc.factors.gaussian import likelihood_rows
from bayesmc.network import Model, Observed
from bayesmc.structure import Variable
from bayesmc.structure.reading import Reading, hidden_elements


def linear_rows(
    model: Model,
    name: str,
    observed: Mapping[str, Observed],
    known: Mapping[str, np.ndarray],
    states: Mapping[Variable, int],
    numbers: Mapping[str, Numbers],
) -> Iterator[Rows] | None:
    """What the elements of a Normal node say; None where they are not linear in plain coordinates.

    Raises
    ------
    BudgetError
        Too many configurations.
    """
    try:
        reading = Reading(model, name, observed, known)
    except UnsupportedError:
        return None
    blocks = {model_name for model_name, _ in reading.columns}
    if any(b not in numbers or not numbers[b].is_plain for b in blocks):
        return None
    return _rows(reading, observed.get(name), states, numbers)


def score_rows(x: Numbers, seen: Observed | None) -> Iterator[Rows]:
    """The standard normal priors of normal scores, and the densities of elements that are observed."""
    assert isinstance(x.transform, NormalScores)
    one, none = np.array([[1.0, 0.0]]), np.zeros((0, 1))
    values = None if seen is None else np.broadcast_to(seen.value, x.node.value_shape).reshape(-1)
    for e, at in enumerate(x.at):
        if at[0] >= 0:
            scale = np.array(-0.5 * np.log(2.0 * np.pi))
            yield Rows(x.node.name, e, (), at, one, scale, True)
        elif values is not None:
            log = np.asarray(x.transform.prior.log_prob(values[e]))
            yield Rows(x.node.name, e, (), np.zeros(0, dtype=int), none, log, False)


# ---- private ------------------------------------------------------------------------------------


def _rows(
    reading: Reading,
    seen: Observed | None,
    states: Mapping[Variable, int],
    numbers: Mapping[str, Numbers],
) -> Iterator[Rows]:
    name, d = reading.node.name, math.prod(reading.node.event_shape)
    if reading.without_noise(np.arange(reading.count)).any():
        raise UnsupportedError(
            f"ExpectationPropagation: node {name!r} has no noise, and messages about it would be infinite; "
            "give it a little, compute it (a function that returns an array), or use Exact or Gibbs"
        )
    hidden = set(hidden_elements(reading.node, seen))
    values = None if seen is None else seen.value.reshape(reading.count, d)
    _refuse_invalid(reading)
    for e in range(reading.count):
        if e in hidden and name not in numbers:
            continue  # drawn afterwards
        given = reading.conditional(e, states)
        at = [numbers[b].at[k] for b, k in given.parents]
        if e in hidden:
            at = [numbers[name].at[e], *at]
            matrix = np.concatenate(
                [np.broadcast_to(np.eye(d), (*given.gain.shape[:-1], d)), -given.gain], axis=-1
            )
            rows, scale = likelihood_rows(matrix, given.offset, given.root)
        else:
            assert values is not None
            rows, scale = likelihood_rows(given.gain, values[e] - given.offset, given.root)
        coordinates = np.concatenate(at) if at else np.zeros(0, dtype=int)
        yield Rows(name, e, given.scope, coordinates, rows, scale, e in hidden)


def _refuse_invalid(reading: Reading) -> None:
    for name, element, scope, bad in reading.invalid_rows():
        if not scope and bad.all():
            raise ZeroProbabilityError(f"node {name!r} has bad parameters at element {element}")
        raise UnsupportedError(
            f"ExpectationPropagation: node {name!r} has bad parameters at some states of "
            f"{', '.join(repr(n) for n, _ in scope)}"
        )
