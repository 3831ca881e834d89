"""Options of a particle filter: what is wrong with them, read and frozen."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np

from bayesmc.dbn import Slices
from bayesmc.engines.filtering import Queries
from bayesmc.engines.proposal import FUNCTION, as_function, check_specification
from bayesmc.errors import UnknownNodeError, did_you_mean
from bayesmc.network.reading import nodes_read


def check_count(option: str, given: Any, what: str, call: str = "ParticleFilter") -> None:
    """A whole number, 1 or more."""
    if isinstance(given, bool) or not isinstance(given, (int, np.integer)) or given < 1:
        raise ValueError(
            f"{call}({option}={given!r}): give a number of {option}, 1 or more, {what}"
        )


def check_budget(tolerance: Any, budget: Any) -> None:
    """What a number of particles is chosen by."""
    if isinstance(tolerance, bool) or not isinstance(tolerance, (int, float)) or not tolerance > 0:
        raise ValueError(
            f"ParticleFilter(tolerance={tolerance!r}): give an error of the log evidence above 0, such as "
            "0.5"
        )
    if isinstance(budget, bool) or not isinstance(budget, (int, np.integer)) or budget < 1:
        raise ValueError(
            f"ParticleFilter(budget={budget!r}): give a number of particles times slices, such as 30_000_000"
        )


def check_threshold(given: Any) -> None:
    """A share of the particles."""
    if isinstance(given, bool) or not isinstance(given, (int, float)) or not given >= 0:
        raise ValueError(
            f"ParticleFilter(ess_threshold={given!r}): give a share of the particles, 0 (never resample) "
            "to 1 (always)"
        )


def check_choice(
    option: str, given: Any, one: str, other: str, call: str = "ParticleFilter"
) -> None:
    """One of two words."""
    if given not in (one, other):
        raise ValueError(f'{call}({option}={given!r}): give "{one}" or "{other}"')


def check_kind(option: str, given: Any, kind: type) -> None:
    """An object of a kind, or None."""
    if given is not None and not isinstance(given, kind):
        raise TypeError(f"ParticleFilter({option}={given!r}): give a {kind.__name__}(...), or None")


def read_functions(option: str, given: Any) -> Any:
    """Functions by node, checked and frozen; ``"optimal"`` and None as they are."""
    if option == "proposal" and isinstance(given, str):
        if given != "optimal":
            raise ValueError(
                f'ParticleFilter(proposal={given!r}): give "optimal", or a dict from node name to {FUNCTION}'
            )
        return given
    if given is None:
        return None
    functions = check_specification("ParticleFilter", given, FUNCTION, option)
    for key, spec in functions.items():
        as_function("ParticleFilter", key, spec, FUNCTION, option)
    return MappingProxyType(functions)


def read_by(queries: Queries, slices: Slices) -> list[str]:
    """Nodes that queries read."""
    found = []
    for query, function in queries.items():
        for name in nodes_read(function):
            if name not in slices.dynamic:
                raise UnknownNodeError(
                    f"queries={{{query!r}: ...}} reads {name!r}, which is no node of a slice"
                    f"{did_you_mean(name, slices.dynamic)}; there are "
                    f"{list(slices.dynamic)}"
                )
            found.append(name)
    return found
