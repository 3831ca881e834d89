"""Parameters of distributions as users write them."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayesmc.errors import BayesmcError, ParameterError


def read_floats(value: Any) -> np.ndarray:
    """A parameter as a float array; text is no number even where it could be read as one.

    Raises
    ------
    ParameterError
    """
    try:
        numbers = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        if isinstance(error, BayesmcError):
            raise
        raise ParameterError(f"a distribution's parameter is {value!r}, not numbers") from error
    if type(value) is not float and type(value) is not int and _holds_text(value):
        raise ParameterError(
            f"a distribution's parameter is {value!r}, which is text, not numbers; give {numbers.tolist()}"
        )
    return numbers


def _holds_text(value: Any) -> bool:
    if isinstance(value, (str, bytes)):
        return True
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "SU" or (
            value.dtype.kind == "O" and any(map(_holds_text, value.flat))
        )
    return isinstance(value, (list, tuple)) and any(map(_holds_text, value))
