"""Where trajectories of all numbers together are better than a sweep over them, told without trying.

A sweep moves a plate's elements by slices at once, each by itself: what they share crawls. Where many numbers
are moved so, or by blocks along trajectories beside others, and they are most of all, trajectories in machine
code take less for an effective draw (1.5 to 13 times less on the models that it was tried on); in NumPy they
need not. Their steps are shorter than the
engine's own: hardly slower there, and fewer trajectories diverge.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from bayesmc.engines.mcmc.chains import ChainEngine
from bayesmc.engines.mcmc.gibbs import Gibbs, Plan
from bayesmc.engines.mcmc.hamiltonian import HamiltonianMonteCarlo
from bayesmc.engines.mcmc.jointly import CROWD, continuous, density_of, summed_with
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.ensemble import BlockWalk
from bayesmc.kernels.factor_slice import FactorSlice
from bayesmc.kernels.hamiltonian import GRADIENTS, Hamiltonian
from bayesmc.kernels.hamiltonian_warmup import fitting
from bayesmc.kernels.slice import Slice
from bayesmc.kernels.stacked import Stacked
from bayesmc.network import Problem
from bayesmc.structure.compiled_density import in_machine_code
from bayesmc.structure.free_density import UnconstrainedDensity

#: share of all numbers that have no closed form, at least; numbers of which a density is made to ask, at most
_MOST_OF = 0.5
_LARGEST = 4096
#: share of numbers whose correlations trajectories learn that are in blocks, or moved by slices, at least
_LEAST_OF = 0.2
#: joint states of the labels of an element that are summed over, at most
_STATES = 16
_ACCEPTED = 0.9


def along_trajectories(problem: Problem, plan: Plan) -> tuple[HamiltonianMonteCarlo, str] | None:
    """The engine that moves all numbers together, and why; None where a sweep is the better one.

    Labels beside numbers without a closed form cling to these: the engine sums them out, where it can do so
    element by element.

    Parameters
    ----------
    problem : Problem
    plan : Plan
        Of Gibbs.
    """
    model = problem.model
    moved = {n for kernel in plan.kernels for n in kernel.names}
    labels = [n for n in moved if model[n].domain is not None]
    if any(model[n].is_discrete for n in moved if n not in labels):
        return None
    if not all(model[n].plates for n in labels):
        return None
    if any(isinstance(kernel, BlockWalk) for kernel in plan.kernels):  # it may find another mode
        return None
    sizes = {n: math.prod(model[n].value_shape) for n in moved if n not in labels}
    slices = [k for k in plan.kernels if _is(k, (Slice, FactorSlice))]
    blocks = [k for k in plan.kernels if isinstance(k, Hamiltonian)]
    slow = sum(sizes.get(n, 0) for n in {n for k in (*slices, *blocks) for n in k.names})
    total = sum(sizes.values())
    few = 0 if labels else CROWD
    if not labels and not slices and slow == total:  # Gibbs moves all numbers so
        return None
    # where correlations are learnt, a block that hangs on others costs about what all numbers together do
    learnt = fitting("auto", total) == "dense"
    together = learnt and slow >= _LEAST_OF * total and _hang(plan, blocks, sizes)
    if not together:
        if not few < slow or slow < _MOST_OF * total or total > _LARGEST:
            return None
    engine = HamiltonianMonteCarlo(target_accept=_ACCEPTED, marginalize=bool(labels))
    numbers = continuous(plan.target)
    if labels and not _are_apart(problem, numbers, len(labels)):
        return None
    if engine.refusal(problem) is not None:
        return None
    if not _is_compiled(problem, density_of(problem, numbers, engine.summed(problem)), engine):
        return None
    if labels:
        shown = ", ".join(map(repr, sorted(labels)))
        return (
            engine,
            f"{shown} {'is' if len(labels) == 1 else 'are'} summed out, element by element: drawn in turn, "
            f"labels and the {slow} numbers without a closed form would hold each other",
        )
    how = "apart from those with which they hang together" if together else "one by one"
    return (
        engine,
        f"{slow} of {total} numbers have no closed form, and a sweep would move them {how}",
    )


def follows(problem: Problem, kernels: Sequence[Kernel]) -> bool:
    """Whether one kernel moves all numbers along trajectories, in machine code."""
    if len(kernels) != 1 or not isinstance(kernels[0], Hamiltonian):
        return False
    density = kernels[0].density
    return isinstance(density, UnconstrainedDensity) and _is_compiled(problem, density, Gibbs())


# ---- private ------------------------------------------------------------------------------------


def _is_compiled(problem: Problem, density: UnconstrainedDensity, engine: ChainEngine) -> bool:
    """Whether a run will have trajectories in machine code."""
    lengths = engine.lengths(problem)
    made = in_machine_code(density, GRADIENTS * lengths.warmup, lengths.chains)
    return "trajectories" in made.told


def _hang(plan: Plan, blocks: Sequence[Kernel], names: Iterable[str]) -> bool:
    """Whether blocks share terms with numbers that others move."""
    inside = {n for kernel in blocks for n in kernel.names}
    own, others = (
        {id(t) for t in plan.target.terms_of(tuple(n for n in names if (n in inside) == is_in))}
        for is_in in (True, False)
    )
    return not own.isdisjoint(others)


def _are_apart(problem: Problem, numbers: tuple[str, ...], count: int) -> bool:
    """Whether so many finite nodes are all summed out, element by element, of few joint states."""
    found = summed_with(problem, numbers)
    if len(found) < count:
        return False
    tables = density_of(problem, numbers, found).tables
    return all(len(t.listed) == 1 and 1 < len(t.states) <= _STATES for t in tables)


def _is(kernel: Kernel, kinds: tuple[type, ...]) -> bool:
    return isinstance(kernel.kernel if isinstance(kernel, Stacked) else kernel, kinds)
