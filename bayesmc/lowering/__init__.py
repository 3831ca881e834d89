"""Machine code from the expression graph: the room knows graphs and arrays, no nets.

A graph becomes a text in LLVM's language (``kernel``), llvmlite makes machine code of it (``machine``), and
``compiled`` calls it as ``expression.Program`` is called, ``checked`` holds it against that. Without llvmlite
nothing here is used.
"""

from __future__ import annotations

from bayesmc.lowering.checked import held_against_numpy, is_worth_it
from bayesmc.lowering.compiled import Bound, Compiled, SliceKernel, compiled
from bayesmc.lowering.gaussians import Coefficients, GaussianLoops, gaussian_loops
from bayesmc.lowering.kernel import Kernel
from bayesmc.lowering.machine import is_available
from bayesmc.lowering.trajectory import Told, Trajectories
from bayesmc.lowering.weights import weight_loops

__all__ = [
    "Bound",
    "Coefficients",
    "Compiled",
    "GaussianLoops",
    "Kernel",
    "SliceKernel",
    "Told",
    "Trajectories",
    "compiled",
    "gaussian_loops",
    "held_against_numpy",
    "is_available",
    "is_worth_it",
    "weight_loops",
]
