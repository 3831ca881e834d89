"""Machine code from the expression graph: the room knows graphs and arrays, no nets.

A graph becomes a text in LLVM's language (``kernel``), llvmlite makes machine code of it (``machine``), and
``compiled`` calls it as ``expression.Program`` is called, ``checked`` holds it against that. Without llvmlite
nothing here is used.
"""

from __future__ import annotations

from bayesmc.lowering.checked import held_against_numpy, is_worth_it
from bayesmc.lowering.compiled import Bound, Compiled, address_of, compiled
from bayesmc.lowering.gaussians import Coefficients, GaussianLoops, gaussian_loops
from bayesmc.lowering.kernel import Kernel
from bayesmc.lowering.lineage import followed
from bayesmc.lowering.machine import is_available
from bayesmc.lowering.series import (
    NO_NUMBERS,
    Cloud,
    Made,
    Noise,
    Numbers,
    SliceCall,
    SliceKernel,
    known_column,
)
from bayesmc.lowering.slices import Slices, Turns
from bayesmc.lowering.trajectory import Told, Trajectories

__all__ = [
    "NO_NUMBERS",
    "Bound",
    "Cloud",
    "Coefficients",
    "Compiled",
    "GaussianLoops",
    "Kernel",
    "Made",
    "Noise",
    "Numbers",
    "SliceCall",
    "SliceKernel",
    "Slices",
    "Told",
    "Trajectories",
    "Turns",
    "address_of",
    "compiled",
    "followed",
    "gaussian_loops",
    "held_against_numpy",
    "is_available",
    "is_worth_it",
    "known_column",
]
