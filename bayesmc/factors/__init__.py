"""Exact inference over discrete factors: tables, elimination orders and clique trees.

This package knows variables, cardinalities and arrays; nets, labels and evidence by name belong to
the layers above.
"""

from __future__ import annotations

from .calibrated import Calibrated
from .cliquetree import BoundTree, CliqueTree, FactorLike, LogTable, factor_from_log
from .elimination import HEURISTICS, Elimination, elimination_order
from .structure import TreeCost

__all__ = [
    "HEURISTICS",
    "BoundTree",
    "Calibrated",
    "CliqueTree",
    "Elimination",
    "FactorLike",
    "LogTable",
    "TreeCost",
    "elimination_order",
    "factor_from_log",
]
