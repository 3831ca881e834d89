"""What is found of a chain: its classes of states, and how far it is from detailed balance."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass


@dataclass(frozen=True)
class CommunicatingClass:
    """A largest set of states that all reach each other.

    Attributes
    ----------
    states : tuple
        Their labels, in the chain's order.
    positions : tuple of int
        Their positions in the transition matrix.
    recurrent : bool
        Whether the chain never leaves them (a closed class); otherwise they are transient.
    period : int
        Greatest common divisor of the lengths of all ways back; 0 for a single state without one.
    """

    states: tuple[Hashable, ...]
    positions: tuple[int, ...]
    recurrent: bool
    period: int


@dataclass(frozen=True)
class DetailedBalance:
    """How far a chain is from detailed balance, and where; true where it holds.

    Attributes
    ----------
    violation : float
        Largest ``|p_i P_ij - p_j P_ji| / sqrt(p_i p_j)`` of all pairs: by how much the symmetrised
        matrix fails to be symmetric, which judges rare states as strictly as frequent ones. Infinite
        where a state of probability zero is entered.
    states : tuple
        The pair ``(i, j)`` where it is.
    flows : tuple of float
        ``p_i P_ij`` and ``p_j P_ji`` of that pair.
    holds : bool
        Whether the violation is within the tolerance.
    """

    violation: float
    states: tuple[Hashable, Hashable]
    flows: tuple[float, float]
    holds: bool

    def __bool__(self) -> bool:
        return self.holds
