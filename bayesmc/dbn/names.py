"""Names that a template does not have, and which are meant."""

from __future__ import annotations

import re
from collections.abc import Collection

from bayesmc.errors import did_you_mean

#: names by which one may try to look further back: x_prev2, x_prev_prev, x_2prev, x_lag2
_FAR_BACK = re.compile(r"(.+?)_?(?:prev((_?prev)+|_?\d+(_prev)?)|\d+_?prev|lag_?(?!1$)\d+)")
#: other ways to write that of the slice before
_TURNED = re.compile(r"(?:prev|previous|last)_(.+)|(.+?)_(?:t_?1|tm1|previous|last|lag_?1?)")
#: names of nodes of the unrolled net
_UNROLLED = re.compile(r"(.+)\[\d+\]")


def meant(name: str, nodes: Collection[str], static: Collection[str]) -> str:
    """That a template of some nodes has none of this name, and which one may be meant."""
    slice_ = _UNROLLED.fullmatch(name)
    if slice_ and slice_[1] in nodes:
        return f"rows go under the name {slice_[1]!r}, time first: row k belongs to slice k"
    before = [n + "_prev" for n in nodes if n not in static]
    turned = _TURNED.fullmatch(name)
    named = (turned[1] or turned[2]) + "_prev" if turned else name
    hint = did_you_mean(named if named in before else name, [*nodes, *before, "t"])
    return f"the template has no node {name!r}{hint}"


def far_back(name: str, nodes: Collection[str], static: Collection[str]) -> str | None:
    """How to look more than one slice back, if that is what a name is meant for."""
    far = _FAR_BACK.fullmatch(name)
    if far is None or far[1] not in nodes or far[1] in static:
        return None
    own, lag = far[1], f"{far[1]}_lag"
    how = f"dbn.add({lag!r}, lambda {own}_prev: {own}_prev, initial=...)"
    return (
        f"functions look one slice back. Carry what is further back on by a lag node, {how}, and read "
        f'{lag + "_prev"!r} (docs/time.md, "Further back than one slice")'
    )
