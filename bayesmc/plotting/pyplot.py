"""matplotlib, loaded when something is drawn and not before."""

from __future__ import annotations

from typing import Any

from bayesmc.errors import missing_extra


def pyplot() -> Any:
    """The module ``matplotlib.pyplot``; without matplotlib, the error that says how to get it."""
    try:
        from matplotlib import pyplot
    except ImportError:
        raise missing_extra("matplotlib", "plot") from None
    return pyplot
