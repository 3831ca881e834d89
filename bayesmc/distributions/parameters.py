"""Arguments as users write them: names that a family or an engine does not have, numbers that are none,
and arguments that go by keyword."""

from __future__ import annotations

import functools
import inspect
import math
import operator
from collections.abc import Callable, Iterable, KeysView, Mapping
from typing import Any, NoReturn, TypeVar

import numpy as np

from bayesmc.errors import BayesmcError, ParameterError, did_you_mean

_Call = TypeVar("_Call", bound=Callable[..., Any])

#: another name -> what it is called here, or how to say it: the first that a family takes
_OTHERWISE: dict[str, tuple[tuple[str, str], ...]] = {
    "alpha": (("concentration1", "concentration1"), ("concentration", "concentration")),
    "a": (("concentration1", "concentration1"), ("concentration", "concentration")),
    "b": (("concentration0", "concentration0"), ("rate", "rate"), ("scale", "scale")),
    "beta": (("concentration0", "concentration0"), ("rate", "rate"), ("scale", "scale")),
    "covariance": (("cov", "cov"),),
    "covariance_matrix": (("cov", "cov"),),
    "dof": (("df", "df"),),
    "dimension": (("size", "size"),),
    "eta": (("loc", "loc"), ("concentration", "concentration")),
    "kappa": (("concentration", "concentration"),),
    "lam": (("rate", "rate"),),
    "max": (("high", "high"),),
    "mean": (("loc", "loc"),),
    "min": (("low", "low"),),
    "mu": (("loc", "loc"),),
    "n": (("total_count", "total_count"), ("size", "size")),
    "nu": (("df", "df"),),
    "p": (("probs", "probs"),),
    "precision": (("scale", "scale = precision**-0.5"),),
    "prob": (("probs", "probs"),),
    "probabilities": (("probs", "probs"),),
    "scale": (("rate", "rate = 1 / scale"),),
    "sd": (("scale", "scale"),),
    "shape": (("concentration", "concentration"),),
    "sigma": (("scale", "scale"), ("cov", "cov")),
    "std": (("scale", "scale"),),
    "stddev": (("scale", "scale"),),
    "tau": (("scale", "scale = tau**-0.5"),),
    "trials": (("total_count", "total_count"),),
    "var": (("scale", "scale = np.sqrt(var)"),),
    "variance": (("scale", "scale = np.sqrt(variance)"),),
}


#: families -> the names that their constructors are known to take
_KNOWN: dict[type, frozenset[str]] = {}


@functools.cache
def signature(family: type) -> inspect.Signature:
    """The parameters of a family's constructor.

    Those of ``__init__``: Python 3.11.2 reads a class whose ``__init__`` is inherited by its ``__new__``,
    which takes anything.
    """
    return inspect.Signature(list(inspect.signature(family.__init__).parameters.values())[1:])  # type: ignore[misc]


def check_keywords(family: type, keywords: KeysView[str]) -> None:
    """Raise for a parameter that a family does not have.

    Raises
    ------
    TypeError
        Says what it takes and which was meant.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> bmc.Gamma(2.0, scale=3.0)
    Traceback (most recent call last):
        ...
    TypeError: Gamma has no parameter 'scale' (did you mean rate = 1 / scale?); it takes concentration, rate
    """
    if family in _KNOWN and keywords <= _KNOWN[family]:  # for every distribution there is
        return
    parameters = signature(family).parameters
    if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        return
    _KNOWN[family] = frozenset(parameters)
    for keyword in keywords:
        if keyword not in parameters:
            meant = _meant(keyword, parameters)
            raise TypeError(
                f"{family.__name__} has no parameter {keyword!r}{meant}; it takes {', '.join(parameters)}"
            )


class Named:
    """What data classes of options are built from: an option they do not have goes to ``refuse_option``."""

    def __new__(cls, *_: Any, **options: Any) -> Any:
        if options:
            known: Any = getattr(getattr(cls.__init__, "__code__", None), "co_varnames", options)
            for name in options:
                if name not in known:
                    cls.refuse_option(name)
        return super().__new__(cls)

    @classmethod
    def refuse_option(cls, name: str) -> None:
        """Raise for an option, if it is none; what is not raised for meets the constructor."""


def by_keyword(call: _Call) -> _Call:
    """A call whose ``*beyond`` are arguments that go by keyword; its signature does not show them.

    It is no wrapper: warnings count the calls up to the user's own line.
    """
    signed = inspect.signature(call)
    kept = [p for p in signed.parameters.values() if p.kind is not p.VAR_POSITIONAL]
    call.__signature__ = signed.replace(parameters=kept)  # type: ignore[attr-defined]
    return call


def refuse_positions(call: Callable[..., Any], beyond: tuple[Any, ...]) -> NoReturn:
    """Raise for arguments by position that go by keyword, with what to write.

    Raises
    ------
    TypeError

    Examples
    --------
    >>> import bayesmc as bmc
    >>> bmc.infer(bmc.BayesNet(), {}, {"x": 1.0})
    Traceback (most recent call last):
        ...
    TypeError: infer takes what follows evidence by keyword; write infer(net, evidence, inputs=...)
    """
    parameters = inspect.signature(call).parameters.values()
    leading = [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
    named = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
    written = ", ".join([*leading, f"{_looks_like(beyond[0], named)}=..."])
    name = call.__name__
    raise TypeError(f"{name} takes what follows {leading[-1]} by keyword; write {name}({written})")


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


def as_number(value: Any) -> float:
    """A single number as a float; NaN for anything else, text included."""
    try:
        return math.nan if isinstance(value, (str, bytes)) or np.ndim(value) else float(value)
    except (TypeError, ValueError):
        return math.nan


def _holds_text(value: Any) -> bool:
    if isinstance(value, (str, bytes)):
        return True
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "SU" or (
            value.dtype.kind == "O" and any(map(_holds_text, value.flat))
        )
    return isinstance(value, (list, tuple)) and any(map(_holds_text, value))


# ---- private ------------------------------------------------------------------------------------


def _meant(keyword: str, known: Iterable[str]) -> str:
    for parameter, said in _OTHERWISE.get(keyword, ()):
        if parameter in known:
            return f" (did you mean {said}?)"
    return did_you_mean(keyword, known)


def _looks_like(value: Any, named: list[str]) -> str:
    """The keyword that a value looks like."""
    looks = "rng" if isinstance(value, int) else "engine"
    if isinstance(value, Mapping) or hasattr(value, "columns"):
        looks = "inputs"
    elif isinstance(value, str) or (isinstance(value, (list, tuple)) and _holds_text(value)):
        looks = "learn"  # names
    return looks if looks in named else named[0]


def as_size(family: str, size: Any) -> int:
    """How many components or rows: a positive whole number."""
    try:
        found = operator.index(np.asarray(size)[()])
    except TypeError:
        raise ParameterError(f"{family}: size must be a whole number; got {size!r}") from None
    if found < 1:
        raise ParameterError(f"{family}: size must be at least 1; got {size!r}")
    return found
