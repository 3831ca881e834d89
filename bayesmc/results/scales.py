"""On which scale observations have their densities: what was observed, and changes of variables.

Log densities of a number and of its logarithm differ by the log slope of the one in the other (the change of
variables of a density), so that predictions of both are compared on one scale only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesmc.errors import QueryError, did_you_mean
from bayesmc.network import Model, Observed
from bayesmc.results.over_time import slices_of


@dataclass(frozen=True, eq=False)
class Scale:
    """What the pointwise densities of a model are densities of.

    Attributes
    ----------
    names : tuple of str
        Observed nodes.
    values : ndarray
        All numbers observed that have a density, in order; those with probabilities are left out.
    log_jacobian : ndarray or None, shape (observations,)
        What was added to the log densities; None where nothing was.
    """

    names: tuple[str, ...]
    values: np.ndarray
    log_jacobian: np.ndarray | None

    def is_of(self, other: Scale) -> bool:
        """Whether the same numbers were observed."""
        return self.values.shape == other.values.shape and np.allclose(
            self.values, other.values, rtol=1e-5, atol=1e-12
        )

    def why_not(self, other: Scale) -> str | None:
        """Why densities are not on the scale of another's, or None."""
        mine, its = self.log_jacobian, other.log_jacobian
        if self.is_of(other):
            zeros = np.zeros(1)
            first, second = (zeros if x is None else x for x in (mine, its))
            if np.allclose(first, second, rtol=1e-9, atol=1e-9):
                return None
            return "the same was observed, and log_jacobian= is not the same"
        if mine is not None or its is not None:
            return None
        mine_named, its_named = (", ".join(map(repr, s.names)) for s in (self, other))
        return (
            f"other numbers were observed ({mine_named} and {its_named}), and densities of numbers that "
            "were transformed are on another scale; of what was transformed, z = f(y), give log |dz/dy| of "
            "each observation, as in loo(log_jacobian=-np.log(y)) for z = log y, or 0 where it is only "
            "shifted"
        )


def scale_of(
    what: str,
    model: Model,
    observed: Mapping[str, Observed],
    told: Mapping[str, np.ndarray],
    log_jacobian: Any,
) -> tuple[Scale, dict[str, np.ndarray]]:
    """The scale of some nodes' densities, and what is added to them, each ``(*plates)``.

    Parameters
    ----------
    told : dict
        Node -> log densities, ``(chain, draw, *plates)``; NaN where nothing was observed.
    log_jacobian : dict, array_like or None
        Node -> what broadcasts to its plates; an array where there is one node.

    Raises
    ------
    QueryError
    """
    values = [_numbers(model, observed, n) for n in told]
    joined = np.concatenate([np.zeros(0), *values])
    if log_jacobian is None:
        return Scale(tuple(told), joined, None), {}
    if not isinstance(log_jacobian, Mapping):
        if len(told) != 1:
            raise QueryError(
                f"{what}(log_jacobian=...): there are {len(told)} observed nodes, {', '.join(told)}; give a "
                "dict from node to array"
            )
        log_jacobian = {next(iter(told)): log_jacobian}
    added = {}
    for name, given in log_jacobian.items():
        if name not in told:
            raise QueryError(
                f"{what}(log_jacobian=...): {name!r} is none of the observed nodes asked about"
                f"{did_you_mean(name, told)}; these are {list(told)}"
            )
        shape = told[name].shape[2:]
        try:
            array = np.broadcast_to(np.asarray(given, dtype=float), shape)
        except (TypeError, ValueError):
            raise QueryError(
                f"{what}(log_jacobian=...): {name!r} takes numbers that broadcast to its observations, shape "
                f"{shape}, not {np.shape(given)}"
            ) from None
        known = ~np.isnan(told[name]).all(axis=(0, 1))
        if not np.isfinite(array[known]).all():
            raise QueryError(
                f"{what}(log_jacobian=...): {name!r} has an observation whose log |dz/dy| is not finite"
            )
        added[name] = array
    parts = []
    for name, log in told.items():
        known = ~np.isnan(log).all(axis=(0, 1))
        parts.append(np.asarray(added.get(name, np.zeros(known.shape)))[known])
    return Scale(tuple(told), joined, np.concatenate(parts)), added


def refuse_other_scales(names: Sequence[str], scales: Sequence[Scale | None]) -> None:
    """Refuse to compare models whose densities are on different scales.

    Raises
    ------
    QueryError
    """
    for k, mine in enumerate(scales):
        for j, other in enumerate(scales[:k]):
            reason = None if mine is None or other is None else other.why_not(mine)
            if reason is not None:
                raise QueryError(f"compare: {names[j]!r} and {names[k]!r}: {reason}")


# ---- private ------------------------------------------------------------------------------------


def _numbers(model: Model, observed: Mapping[str, Observed], name: str) -> np.ndarray:
    """Numbers that were observed, flat; of a template's node those of all slices."""
    found = [np.zeros(0)]
    for row in slices_of(model, name) or (name,):
        seen, node = observed.get(row), model[row]
        if seen is None or node.is_discrete or node.domain is not None:
            continue
        values = np.asarray(seen.value, dtype=float)
        known = np.broadcast_to(seen.numbers(len(node.event_shape)), values.shape)
        found.append(values[known])
    return np.concatenate(found)
