"""Every error and warning bayesmc raises, so that callers can catch them by type.

A message says the call, the fault and the fix, with the node's name. This room knows nothing of
models or engines: it only names what can go wrong.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Sequence
from typing import Any


def did_you_mean(name: Any, names: Iterable[Any]) -> str:
    """``" (did you mean 'x'?)"`` for a name that is near one of some, upper and lower case apart; or nothing.

    Examples
    --------
    >>> from bayesmc.errors import did_you_mean
    >>> did_you_mean("Rian", ["rain", "wet"]), did_you_mean("a", ["b"])
    (" (did you mean 'rain'?)", '')
    """
    known = list(dict.fromkeys(map(str, names)))
    folded = {k.lower(): k for k in known}
    same = folded.get(str(name).lower())
    near = [same] if same is not None else difflib.get_close_matches(str(name), known, n=1)
    if not near:
        near = [folded[k] for k in difflib.get_close_matches(str(name).lower(), folded, n=1)]
    return f" (did you mean {near[0]!r}?)" if near else ""


class BayesmcError(Exception):
    """Base of every error raised on purpose by bayesmc.

    Attributes
    ----------
    filtered : SeriesPosterior or None
        Where a filter that goes slice by slice fails: its answer about the slices before the one that failed.
        None where there is none, or where the error comes from elsewhere. Exceptions of other kinds that such
        a filter passes on (a function of the model that breaks, ``KeyboardInterrupt``) have it, too.
    """

    filtered: Any = None


class ModelError(BayesmcError, ValueError):
    """The net as declared is wrong."""


class DuplicateNodeError(ModelError):
    """A name was declared twice without ``replace=True``."""


class UnknownNodeError(ModelError, KeyError):
    """A name that the net does not have."""

    def __str__(self) -> str:  # KeyError would show the repr of the message
        return str(self.args[0]) if self.args else ""


class CycleError(ModelError):
    """The parents form a directed cycle; ``path`` lists its names, first repeated at the end."""

    def __init__(self, message: str, path: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.path = tuple(path)


class PlateError(ModelError):
    """A plate that is unknown, has no known size, or is used ungathered."""


class ShapeError(ModelError):
    """A value or a distribution whose shape does not fit the node's batch, plates and event."""


class BroadcastError(ModelError):
    """A function that does not act element by element over batch axes or a shared plate."""


class QueryError(BayesmcError, ValueError):
    """A function passed to a posterior that cannot be evaluated on arrays of draws."""


class StateError(ModelError):
    """A label that is not among a node's states."""


class ParameterError(BayesmcError, ValueError):
    """A distribution's parameter is out of range.

    Attributes
    ----------
    index : tuple of int
        First offending position in the parameter's batch shape.
    value : object
        The offending value there, where known.
    """

    def __init__(self, message: str, index: tuple[int, ...] = (), value: Any = None) -> None:
        super().__init__(message)
        self.index = index
        self.value = value

    @property
    def is_overflow(self) -> bool:
        """Whether the value is infinite or zero: it over- or underflowed on the way, as vague priors make it,
        rather than being wrong for what it is.
        """
        if not isinstance(self.value, (int, float)) and not hasattr(self.value, "dtype"):
            return False
        return all(v in (math.inf, -math.inf, 0) for v in _numbers(self.value))

    @property
    def has_grown(self) -> bool:
        """Whether the value is infinite, zero or NaN, as arithmetic that over- or underflows leaves it."""
        if self.is_overflow:
            return True
        if not isinstance(self.value, (int, float)) and not hasattr(self.value, "dtype"):
            return False
        return all(v in (math.inf, -math.inf, 0) or v != v for v in _numbers(self.value))


def _numbers(value: Any) -> list[Any]:
    flat = value.ravel().tolist() if hasattr(value, "ravel") else [value]
    return flat if isinstance(flat, list) else [flat]


class DensityError(BayesmcError, ValueError):
    """A log density came out NaN or plus infinity.

    Attributes
    ----------
    index : tuple of int
        First such place among batch and plates, where known.
    """

    def __init__(self, message: str, index: tuple[int, ...] = ()) -> None:
        super().__init__(message)
        self.index = index


class EnvelopeError(BayesmcError, ValueError):
    """A density rises above the envelope or the box that must hold it.

    Attributes
    ----------
    point : ndarray
        Where it does.
    ratio : float
        The density there over what the envelope allows.
    """

    def __init__(self, message: str, point: Any = None, ratio: float = float("nan")) -> None:
        super().__init__(message)
        self.point = point
        self.ratio = ratio


class EvidenceError(BayesmcError, ValueError):
    """Evidence or inputs that the net cannot take."""


class ZeroProbabilityError(EvidenceError):
    """The evidence has probability zero under the net."""


class DegeneracyError(BayesmcError, RuntimeError):
    """All particles have weight zero: nothing that was tried explains what was seen.

    Attributes
    ----------
    t : int
        The slice.
    node : str or None
        The first observed node, in the order of the slice, at which no weight was left.
    """

    def __init__(self, message: str, t: int, node: str | None = None) -> None:
        super().__init__(message)
        self.t, self.node = t, node


class UnsupportedError(BayesmcError, NotImplementedError):
    """The engine, distribution or posterior cannot answer this; the message names what can."""


class TraceError(UnsupportedError):
    """A function does what cannot be followed; engines that need none of it go on without."""


class BudgetError(UnsupportedError):
    """An exact answer would cost more memory than allowed; ``bytes`` is the estimate."""

    def __init__(self, message: str, bytes: int = 0) -> None:  # noqa: A002 - the unit is the name
        super().__init__(message)
        self.bytes = bytes


class FileFormatError(BayesmcError, ValueError):
    """A file that does not read as its format; carries ``path`` and ``line`` (from 1)."""

    def __init__(self, message: str, path: Any = None, line: int | None = None) -> None:
        where = "" if path is None else f"{path}:{line}: " if line is not None else f"{path}: "
        super().__init__(where + message)
        self.path = path
        self.line = line


class DamagedFileError(FileFormatError):
    """A file of ours is cut off, or is not what was written.

    Attributes
    ----------
    blocks : int
        How many of its blocks are whole.
    """

    def __init__(self, message: str, blocks: int = 0) -> None:
        super().__init__(message)
        self.blocks = blocks


class CheckpointError(BayesmcError, RuntimeError):
    """A run cannot be saved, or its file belongs to another one."""


class MissingExtraError(BayesmcError, ImportError):
    """An optional dependency is not installed; the message says which extra brings it."""


class WorkerError(BayesmcError, RuntimeError):
    """What an executor was asked to do does not travel to its workers, or they were lost over and over."""


class BayesmcWarning(UserWarning):
    """Base of every warning issued by bayesmc."""


class LowEssWarning(BayesmcWarning):
    """Importance weights rest on too few draws for the answer to be trusted."""


class ConvergenceWarning(BayesmcWarning):
    """Chains that have not mixed, a block that accepts too few or too many proposals, unsettled messages."""


class InterruptWarning(BayesmcWarning):
    """A run was interrupted; its answer rests on the draws made, or is of the slices done, before."""


class ReducibleWarning(BayesmcWarning):
    """Zero probabilities may keep a Markov chain from configurations that are possible."""


class SupportWarning(BayesmcWarning):
    """A proposal that cannot reach values that have mass."""


class ProposalWarning(BayesmcWarning):
    """A proposal that is asked to look at what is seen and does not, for some nodes."""


class GridWarning(BayesmcWarning):
    """A grid that is too small or too coarse for the densities on it."""


class EvidenceWarning(BayesmcWarning):
    """Evidence that is possible but hardly what was meant: degrees for radians, swapped columns."""


class ModelMisfitWarning(BayesmcWarning):
    """Rows of a series are, as a whole, far less likely than the model says that rows are."""


class EngineWarning(BayesmcWarning):
    """An option has another engine answer than would without it, or an engine leaves something out."""


class CheckpointWarning(BayesmcWarning):
    """A function reads something whose content a file of a run cannot be held against."""


class WorkerWarning(BayesmcWarning):
    """A worker of an executor was lost; what it was at is run again."""


class LogWarning(BayesmcWarning):
    """Lines of a log were skipped, since they do not read."""


def missing_extra(package: str, extra: str) -> MissingExtraError:
    """The error for an absent optional ``package`` that ``bayesmc[extra]`` installs."""
    return MissingExtraError(
        f"{package} is not installed; it comes with the extra: pip install 'bayesmc[{extra}]'"
    )
