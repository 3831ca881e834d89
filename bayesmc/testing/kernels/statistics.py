"""What tests look at where the user names nothing: numbers that show wrong places, spreads and dependences.

They are bounded, so that heavy tails make no mean uncertain, and scaled by draws of the joint law, so that
one net's units are as good as another's.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from bayesmc.distributions.base import marking_invalid
from bayesmc.testing.kernels.joint import NetJoint, Rows, Statistics

#: what statistics are scaled by is drawn apart from any test
_ENTROPY = 0x5CA1E_0F_4B17
#: draws by which statistics are scaled
_PILOTS = 400
#: pairs of nodes whose products are looked at, at most
_PAIRS = 10
#: states of a node of numbers that are looked at one by one, at most
_FEW = 4
#: states that come less or more often than all but so many are no statistic
_RARE = 0.01
#: deviations, in spreads of the joint law, beyond which numbers are bent
_REACH = 3.0


def default_statistics(joint: NetJoint) -> Statistics:
    """Statistics of the hidden nodes of a net, alone, with each other and with the data.

    Of every hidden node its first number (for few states: whether it is in each but the first) and, where
    it has several, the mean of all, the last one and the product of the first two; mean squares; products of
    the first numbers of two nodes, and with the mean of each observed node; and the joint log density.
    """
    rng = np.random.default_rng(np.random.SeedSequence(_ENTROPY))
    state = joint.prior(rng, _PILOTS)
    pilots = {**state, **joint.simulate(state, rng)}
    numbers = {n: _numbers(joint, n, pilots[n]) for n in (*joint.hidden, *joint.observed)}
    found: dict[str, Callable[[Rows, Rows], Any]] = {"log density": _log_density(joint, pilots)}
    for name in joint.hidden:
        found |= _of_node(joint, name, numbers[name], pilots[name])
    for a, b in itertools.islice(itertools.combinations(joint.hidden, 2), _PAIRS):
        found[f"product of {a} and {b}"] = _product(numbers[a], numbers[b], a, b)
    for a, b in itertools.islice(itertools.product(joint.hidden, joint.observed), _PAIRS):
        found[f"product of {a} and {b}"] = _product(numbers[a], numbers[b], a, b)
    return found


# ---- private ------------------------------------------------------------------------------------

#: stored values of a node -> bounded numbers, shape ``(rows, numbers)``
_Numbers = Callable[[np.ndarray], np.ndarray]


def _of_node(
    joint: NetJoint, name: str, numbers: _Numbers, pilots: np.ndarray
) -> dict[str, Callable]:
    node = joint.model[name]
    domain, elements = node.domain, math.prod(node.value_shape)
    found: dict[str, Callable[[Rows, Rows], Any]] = {}
    if domain is not None and (domain.labels is not None or domain.size <= _FEW):
        for code in range(1, domain.size):  # what is stored are positions among the states
            if not _RARE <= (_flat(pilots)[:, 0] == code).mean() <= 1.0 - _RARE:
                continue  # the log density sees what is rare
            found[f"{name} is {domain.states[code]!r}"] = partial(_is_state, name, code)
    else:
        found[f"mean of {name}"] = lambda s, y: numbers(s[name])[:, 0]
        found[f"square of {name}"] = lambda s, y: (numbers(s[name]) ** 2).mean(axis=1)
    if elements > 1:
        found[f"mean of all {name}"] = lambda s, y: numbers(s[name]).mean(axis=1)
        found[f"last of {name}"] = lambda s, y: numbers(s[name])[:, -1]
        found[f"product of two of {name}"] = lambda s, y: numbers(s[name])[:, :2].prod(axis=1)
    return found


def _is_state(name: str, code: int, state: Rows, data: Rows) -> np.ndarray:
    return _flat(state[name])[:, 0] == code


def _product(first: _Numbers, second: _Numbers, a: str, b: str) -> Callable[[Rows, Rows], Any]:
    def product(state: Rows, data: Rows) -> np.ndarray:
        other = state[b] if b in state else data[b]
        return first(state[a])[:, 0] * second(other).mean(axis=1)

    return product


def _log_density(joint: NetJoint, pilots: Rows) -> Callable[[Rows, Rows], Any]:
    target = joint.target()

    def raw(state: Rows, data: Rows) -> np.ndarray:
        values = {**target.known, **state, **data}
        with marking_invalid(), np.errstate(all="ignore"):
            target.refresh(values, target.chain)
            return np.asarray(target.log_density(values), dtype=float)

    bend = _bending(
        raw({n: pilots[n] for n in joint.hidden}, {n: pilots[n] for n in joint.observed})
    )
    return lambda state, data: bend(raw(state, data))


def _numbers(joint: NetJoint, name: str, pilots: np.ndarray) -> _Numbers:
    """A node's values as bounded numbers about zero."""
    free = _free(joint, name)
    bends = [_bending(column) for column in free(pilots).T]

    def numbers(value: np.ndarray) -> np.ndarray:
        columns = free(value)
        return np.stack([bend(columns[:, i]) for i, bend in enumerate(bends)], axis=1)

    return numbers


def _free(joint: NetJoint, name: str) -> _Numbers:
    """Flat numbers of a node: those above zero as logarithms, angles by their sine and cosine."""
    node = joint.model[name]
    support = node.support
    if node.domain is not None or node.is_discrete or support is None:
        return _flat
    if support.kind == "positive definite":
        return _of_matrix
    if support.kind == "interval" and np.all(support.low == 0) and np.all(support.high == np.inf):
        return lambda v: np.log(_flat(v))
    turns = support.angles(math.prod(node.event_shape))
    if turns is None or not np.any(turns):
        return _flat

    def turned(value: np.ndarray) -> np.ndarray:
        flat = _flat(value).reshape(len(value), -1, len(turns))
        parts = np.concatenate(
            [flat[..., ~turns], np.sin(flat[..., turns]), np.cos(flat[..., turns])], axis=-1
        )
        return parts.reshape(len(value), -1)

    return turned


def _of_matrix(value: np.ndarray) -> np.ndarray:
    """Of covariances: logarithms of variances, and the first correlation."""
    diagonal = np.diagonal(value, axis1=-2, axis2=-1)
    if value.shape[-1] == 1:
        return np.log(_flat(diagonal))
    ratio = value[..., 0, 1] / np.sqrt(diagonal[..., 0] * diagonal[..., 1])
    return np.concatenate([_flat(np.log(diagonal)), _flat(ratio)], axis=1)


def _bending(pilots: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Numbers from their median in units of their spread, straight at first, and bounded."""
    usable = pilots[np.isfinite(pilots)]
    if not usable.size:
        return lambda x: x
    low, middle, high = np.quantile(usable, [0.16, 0.5, 0.84])
    spread = (high - low) / 2 or usable.std() or 1.0

    def bend(x: np.ndarray) -> np.ndarray:
        return _REACH * np.arctan((x - middle) / (spread * _REACH))

    return bend


def _flat(value: np.ndarray) -> np.ndarray:
    return value.reshape(len(value), -1).astype(float)
