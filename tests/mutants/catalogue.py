"""All mutants, by family."""

from __future__ import annotations

from tests.mutants import (
    chains,
    densities,
    draws,
    exact,
    factored,
    filters,
    hamiltonian,
    slices,
    switching,
    tables,
)
from tests.mutants.mutant import Mutant

MUTANTS: tuple[Mutant, ...] = (
    *chains.MUTANTS,
    *draws.MUTANTS,
    *exact.MUTANTS,
    *filters.MUTANTS,
    *switching.MUTANTS,
    *tables.MUTANTS,
    *factored.MUTANTS,
    *hamiltonian.MUTANTS,
    *slices.MUTANTS,
    *densities.MUTANTS,
)
