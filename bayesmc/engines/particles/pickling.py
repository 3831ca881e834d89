"""Engines as pickles carry them: without functions, and of no use until they are made anew."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from bayesmc.errors import UnsupportedError


def without_functions(engine: Any, options: Collection[str]) -> dict[str, Any]:
    """Its state as pickles carry it; ``options`` are those that hold functions by node."""
    state = dict(engine.__dict__)
    for option in options:
        if isinstance(state[option], Mapping):
            state[option] = dict.fromkeys(state[option])
    for option in ("resampling", "auxiliary"):
        state[option] = None if callable(state[option]) else state[option]
    return state


def require_functions(engine: Any, options: Collection[str]) -> None:
    """Refuse an engine that came out of a pickle.

    Raises
    ------
    UnsupportedError
    """
    given = [engine.resampling, engine.auxiliary]
    for option in options:
        functions = getattr(engine, option)
        given += functions.values() if isinstance(functions, Mapping) else ()
    whole = engine.recovery is None or engine.recovery.is_whole
    if not whole or any(value is None for value in given):
        raise UnsupportedError(
            "ParticleFilter: this engine was unpickled, and pickles carry no functions; make it anew"
        )
