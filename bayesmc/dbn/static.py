"""Values of static nodes, given once for all slices."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesmc.dbn.problem import with_computed
from bayesmc.dbn.slices import Slices, Template
from bayesmc.errors import EvidenceError, did_you_mean
from bayesmc.network.evidence import observe
from bayesmc.network.labels import by_label


def given_static(template: Template, static: Any) -> dict[str, Any]:
    """Values of static nodes as they are given, by name; that all are there is seen to later.

    Raises
    ------
    EvidenceError
    """
    if static is not None and not isinstance(static, Mapping):
        raise EvidenceError(
            f"static= is a {type(static).__name__}; give a dict from static node to its value"
        )
    for name in static or {}:
        if name not in template.static:
            raise EvidenceError(
                f"static= gives {name!r}, which is no static node"
                f"{did_you_mean(name, template.static)}; there are {list(template.static)}"
            )
    return dict(static or {})


def read_static(slices: Slices, values: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Stored values of static nodes, all of which must be given or computed from those.

    Raises
    ------
    EvidenceError
    """
    found = {}
    for name in slices.template.static:
        node = slices.first[name]
        if not node.is_stochastic:
            continue
        given = values.get(name)
        labelled = by_label(f"static {name!r}", given, node.plates, slices.first.labels)
        seen = observe(node, labelled) if given is not None else None
        if seen is None or seen.mask is not None:
            raise EvidenceError(
                f"static node {name!r} has no value; give start(dbn, static={{{name!r}: value}})"
            )
        found[name] = seen.value
    for name in values:
        if name not in found:
            raise EvidenceError(
                f"static= gives {name!r}, which is no static node with a density"
                f"{did_you_mean(name, found)}; there are {list(found)}"
            )
    return with_computed(slices, found)
