"""``ParticleFilter(delay=)``: what is wrong with it, what it does not go with, and what it does."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.engines.filtering import Asked

#: options that change who the particles of a slice are
_ALONE = ("adapt", "recovery")


def read_delay(engine: Any) -> int | None:
    """A number of slices; None without delay.

    Raises
    ------
    TypeError, ValueError
    """
    delay = engine.delay
    if delay is None:
        return None
    if isinstance(delay, bool) or not isinstance(delay, (int, np.integer)) or delay < 0:
        raise ValueError(
            f"ParticleFilter(delay={delay!r}): give a number of rows to look ahead, 0 or more, or None"
        )
    if not delay:
        return None
    for option in _ALONE:
        if getattr(engine, option) is not None:
            raise ValueError(
                f"ParticleFilter: delay= looks at ancestors of later particles, and {option}= lets their "
                "number change, or begins anew; leave one of them out"
            )
    if engine.compiled:
        raise ValueError(
            "ParticleFilter: answers with delay= have no machine code; leave compiled= out"
        )
    return int(delay)


def not_delayed(delay: int | None, asked: Asked) -> str | None:
    """Why what is asked does not go with a delay, or None."""
    if delay is None or asked.what in ("filter", "forecast"):
        return None
    return (
        f"ParticleFilter: delay={delay} is of filter, forecast and step; smooth looks at all rows, or as "
        "many ahead as its own lag= says; leave delay= out"
    )


def ahead_told(delay: int | None, effort: str) -> str:
    """The effort, and how far answers look ahead."""
    if delay is None:
        return effort
    rows = "one row" if delay == 1 else f"{delay} rows"
    said = f"answers look {rows} ahead, by the weights of later particles on their ancestors"
    return f"{effort}; {said}" if effort else said
