"""Units of work that another process can import."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bayesmc.errors import ZeroProbabilityError


def doubled(shared: Mapping[str, Any], unit: int) -> int:
    return int(shared["factor"]) * unit


def scaled(shared: Mapping[str, Any], unit: int) -> Any:
    return shared["factor"] * unit


def late(shared: Mapping[str, Any], unit: int) -> int:
    time.sleep(0.05 if unit == 0 else 0.0)
    return unit


def failing(shared: Mapping[str, Any], unit: int) -> int:
    if unit == 2:
        raise ZeroProbabilityError("impossible, this one")
    return unit


def stopped(shared: Mapping[str, Any], unit: int) -> int:
    if unit == 2:
        raise KeyboardInterrupt
    return unit


def warned(shared: Mapping[str, Any], unit: int) -> int:
    warnings.warn(f"beware of {unit}", UserWarning, stacklevel=1)
    return unit


def dies_once(shared: Mapping[str, Any], unit: int) -> int:
    """Ends its process the first time that unit 1 is tried."""
    mark = Path(shared["folder"]) / "died"
    if unit == 1 and not mark.exists():
        mark.write_text("")
        os._exit(1)
    return unit


def dies(shared: Mapping[str, Any], unit: int) -> int:
    os._exit(1)


def seen(shared: Mapping[str, Any], unit: Any) -> bool:
    """Whether a unit's problem holds the model that all share."""
    return bool(unit[1].model is shared["first"].model)


def total(shared: Mapping[str, Any], unit: np.ndarray) -> float:
    return float(unit.sum())
