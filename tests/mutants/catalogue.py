"""All mutants, by family."""

from __future__ import annotations

from tests.mutants import (
    approximate,
    chains,
    densities,
    draws,
    elements,
    exact,
    factored,
    filters,
    hamiltonian,
    lagging,
    linearised,
    propagated,
    slices,
    switching,
    tables,
    variational,
)
from tests.mutants.mutant import Mutant

MUTANTS: tuple[Mutant, ...] = (
    *approximate.MUTANTS,
    *chains.MUTANTS,
    *draws.MUTANTS,
    *elements.MUTANTS,
    *exact.MUTANTS,
    *filters.MUTANTS,
    *switching.MUTANTS,
    *tables.MUTANTS,
    *variational.MUTANTS,
    *factored.MUTANTS,
    *propagated.MUTANTS,
    *hamiltonian.MUTANTS,
    *lagging.MUTANTS,
    *linearised.MUTANTS,
    *slices.MUTANTS,
    *densities.MUTANTS,
)
