"""The exact transition matrix of the engines that run Markov chains, read from the code that draws.

On a net whose hidden nodes have few joint states a kernel *is* a matrix. It is found without a second
formula that could agree with a wrong one: the kernel's own ``step`` runs with a stand-in for the random
generator, whose draws are set from outside. Which state follows is a step function of each draw; where the
steps are is found by bisection, down to the last bit that the generator has, and their lengths are the
probabilities. What a chain with that matrix does, ``bayesmc.markov`` answers.

References
----------
Tierney (1994), Markov chains for exploring posterior distributions, Annals of Statistics 22, sec. 2.
Billingsley (1961), Statistical methods in Markov chains, Annals of Mathematical Statistics 32.
"""

from __future__ import annotations

import copy
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.special

from bayesmc.distributions.base import marking_invalid
from bayesmc.errors import ShapeError
from bayesmc.kernels.accepted import Accepted
from bayesmc.kernels.base import Kernel
from bayesmc.kernels.enumerate import Enumerate
from bayesmc.kernels.jump import Jump
from bayesmc.kernels.proposed import Proposed
from bayesmc.kernels.tables import TableSweep
from bayesmc.network import BayesNet, FactorGraph, pose
from bayesmc.shapes import owned
from bayesmc.testing.kernels.branches import FEW, Branches, StateSpace, Stepper


@dataclass(frozen=True, eq=False)
class KernelMatrix:
    """One kernel of a sweep as a matrix.

    Attributes
    ----------
    names : tuple of str
        The nodes it moves.
    label : str
        The kind of move.
    matrix : ndarray, shape (K, K)
        Row-stochastic: from row to column.
    resolution : float
        The coarsest step of the random numbers it draws: single probabilities are good to a few of these,
        2**-53 for all but lattices.
    parts : tuple of KernelMatrix
        Of a kernel that draws several nodes, blocks or colours in turn, each of these updates, read by
        itself.
    """

    names: tuple[str, ...]
    label: str
    matrix: np.ndarray
    resolution: float
    parts: tuple[KernelMatrix, ...] = ()


@dataclass(frozen=True, eq=False)
class Sweep:
    """An engine's sweep over a small net, kernel by kernel.

    Attributes
    ----------
    elements : tuple of str
        What a state lists: hidden nodes, elements of plates as ``"x[0]"``.
    states : tuple of tuple
        The K joint states of positive probability.
    law : ndarray, shape (K,)
        Their posterior probabilities, from the densities of the model.
    kernels : tuple of KernelMatrix
        In the order of the sweep.
    """

    elements: tuple[str, ...]
    states: tuple[tuple[Hashable, ...], ...]
    law: np.ndarray
    kernels: tuple[KernelMatrix, ...]

    @cached_property
    def matrix(self) -> np.ndarray:
        """Transition matrix of the whole sweep, the product of its kernels'."""
        matrix = np.eye(len(self.states))
        for kernel in self.kernels:
            matrix = matrix @ kernel.matrix
        return owned(matrix)

    @property
    def updates(self) -> tuple[KernelMatrix, ...]:
        """The single updates of the sweep, in their order: kernels, or the parts of those that have any."""
        return tuple(part for kernel in self.kernels for part in kernel.parts or (kernel,))

    @property
    def resolution(self) -> float:
        """The coarsest of the kernels'."""
        return max((kernel.resolution for kernel in self.kernels), default=0.0)


def transition_matrix(
    net: BayesNet | FactorGraph, evidence: Mapping[str, Any] | None, engine: Any
) -> tuple[tuple[tuple[Hashable, ...], ...], np.ndarray]:
    """States and exact transition matrix of one sweep of an engine: see `exact_sweep`.

    Returns
    -------
    states : tuple of tuple
        Joint states of the hidden nodes that the engine moves, of positive probability.
    matrix : ndarray, shape (K, K)

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.markov import MarkovChain
    >>> from bayesmc.testing import transition_matrix
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Bernoulli(0.5))
    >>> net.add("b", lambda a: bmc.Bernoulli(0.2 + 0.6 * a))
    >>> net.add("c", lambda a, b: bmc.Bernoulli(0.1 + 0.4 * a + 0.4 * b))
    >>> states, matrix = transition_matrix(net, {"c": 1}, bmc.Gibbs())
    >>> states
    ((0, 0), (0, 1), (1, 0), (1, 1))
    >>> chain = MarkovChain(matrix, states)
    >>> exact = bmc.infer(net, {"c": 1}, engine=bmc.Exact()).probabilities("a", "b").ravel()
    >>> bool(np.allclose(chain.stationary[0], exact, atol=1e-12))
    True
    """
    sweep = exact_sweep(net, evidence, engine)
    return sweep.states, sweep.matrix


def exact_sweep(
    net: BayesNet | FactorGraph, evidence: Mapping[str, Any] | None, engine: Any
) -> Sweep:
    """Every kernel of an engine's sweep as an exact transition matrix.

    Parameters
    ----------
    net : BayesNet or FactorGraph
        Its hidden nodes that evidence depends on must be finite, with at most 1024 joint states.
    evidence : dict or None
    engine : Gibbs, MetropolisHastings, or anything with ``sampler(problem)``
        Kernels are taken as they are after a warmup that taught them nothing.

    Returns
    -------
    Sweep

    Raises
    ------
    UnsupportedError
        A hidden node is not finite, or a kernel draws in a way that cannot be read: by a method other than
        ``random``, ``integers``, ``standard_exponential``, ``binomial`` or raw words as table look-ups
        take them, or so that what happens to one chain depends on the draws of another.
    BudgetError
        Too many states, or draws in a step.
    ZeroProbabilityError
        A kernel goes where the posterior has no mass.

    Notes
    -----
    Two values of a draw are told apart by what follows from them, given some settings of the draws that
    come after it. All that is found is checked at random places of every cell of the tree of draws; a
    kernel whose steps are narrower than the probes and lie between equal neighbours could still escape.

    Examples
    --------
    Each single-site update keeps detailed balance; the sweep of both does not.

    >>> import bayesmc as bmc
    >>> from bayesmc.markov import MarkovChain
    >>> from bayesmc.testing import exact_sweep
    >>> net = bmc.BayesNet()
    >>> net.add("a", bmc.Categorical([0.2, 0.3, 0.5]))
    >>> net.add("b", lambda a: bmc.Categorical(bmc.stack([0.5 - 0.2 * a, 0.3, 0.2 + 0.2 * a])))
    >>> net.add("c", lambda a, b: bmc.Bernoulli(0.1 + 0.2 * a + 0.2 * b))
    >>> jumps = {"a": lambda: bmc.DiscreteUniform(0, 2), "b": "prior"}
    >>> sweep = exact_sweep(net, {"c": 1}, bmc.MetropolisHastings(proposal=jumps))
    >>> [(k.names, MarkovChain(k.matrix).is_reversible(sweep.law)) for k in sweep.kernels]
    [(('a',), True), (('b',), True)]
    >>> MarkovChain(sweep.matrix).is_reversible()
    False
    """
    sampler = engine.sampler(pose(net, evidence))
    space = StateSpace(sampler.target)
    with marking_invalid(), np.errstate(all="ignore"):
        space.find_states()
        kernels = tuple(_read(space, kernel) for kernel in sampler.kernels)
    return Sweep(space.elements, space.labels(), owned(space.law), kernels)


def transition_p_value(matrix: Any, counts: Any) -> float:
    """p-value of the hypothesis that a simulated chain has a transition matrix, by Pearson's chi-square.

    Given the visits to a state, the steps from it are compared with its row of the matrix; steps of which
    fewer than five are expected are taken together. Successive steps need not be independent: the
    limiting law is the same as if they were (Billingsley 1961).

    Parameters
    ----------
    matrix : array_like, shape (K, K)
    counts : array_like of int, shape (K, K)
        How often the chain went from row to column.

    Returns
    -------
    float
        Zero where a step was seen that the matrix rules out.

    Raises
    ------
    ShapeError
        The two do not have the same square shape.

    Examples
    --------
    >>> from bayesmc.testing import transition_p_value
    >>> round(transition_p_value([[0.5, 0.5], [0.5, 0.5]], [[52, 48], [45, 55]]), 2)
    0.56
    >>> transition_p_value([[0.0, 1.0], [0.5, 0.5]], [[1, 99], [50, 50]])
    0.0
    """
    probs, seen = np.asarray(matrix, dtype=float), np.asarray(counts)
    if probs.shape != seen.shape or probs.shape != 2 * probs.shape[:1]:
        raise ShapeError(
            f"transition_p_value: the matrix has shape {probs.shape}, the counts {seen.shape}; give two "
            "square arrays over the same states"
        )
    if (seen[probs <= 0.0] > 0).any():
        return 0.0
    statistic, freedom = 0.0, 0
    for row, found in zip(probs, seen, strict=True):
        expected = row * found.sum()
        rare = expected < 5.0
        cells = [*zip(expected[~rare], found[~rare], strict=True)]
        if expected[rare].sum() >= 5.0:
            cells.append((expected[rare].sum(), found[rare].sum()))
        elif cells and rare.any():  # too rare even together: with the rarest of the others
            k = min(range(len(cells)), key=lambda i: cells[i][0])
            cells[k] = (cells[k][0] + expected[rare].sum(), cells[k][1] + found[rare].sum())
        statistic += sum((n - e) ** 2 / e for e, n in cells)
        freedom += max(len(cells) - 1, 0)
    return float(scipy.special.chdtrc(freedom, statistic)) if freedom else 1.0


def in_classes(kernel: Any, classes: Sequence[Any]) -> Any:
    """The same kernel that moves these classes of elements only, in this order."""
    other = copy.copy(kernel)
    other.blanket = copy.copy(kernel.blanket)
    other.blanket.classes = classes
    return other


# ---- private ------------------------------------------------------------------------------------


def _read(space: StateSpace, kernel: Kernel) -> KernelMatrix:
    """The matrix of one kernel; of two, where the second hides what the first did, their product."""
    if isinstance(kernel, Accepted) and kernel.other is not None:
        both = [_read(space, one) for one in (kernel.alone(), kernel.other)]
        matrix = both[0].matrix @ both[1].matrix
        resolution = max(one.resolution for one in both)
        parts = tuple(part for one in both for part in one.parts or (one,))
        return KernelMatrix(tuple(kernel.names), kernel.label, owned(matrix), resolution, parts)
    stepper = Stepper(space, kernel)
    tree = Branches(stepper, len(space.codes))
    tree.check()
    matrix = np.zeros((len(space.codes),) * 2)
    np.add.at(matrix, (tree.start, tree.outcome), tree.weight)
    resolution = 1.0 / min((n for n in stepper.ranges if n > FEW), default=1 << 53)
    parts = tuple(_read(space, part) for part in _parts(space, kernel))
    return KernelMatrix(tuple(kernel.names), kernel.label, owned(matrix), resolution, parts)


def _parts(space: StateSpace, kernel: Kernel) -> list[Kernel]:
    """The single updates of table look-ups, or of colours in turn, in the order in which they are drawn."""
    if isinstance(kernel, TableSweep):
        alone = len(kernel.conditionals) == 1
        drawn = [c for group in kernel.groups for c in group.part]
        return [] if alone else [TableSweep(space.target, [c]) for c in drawn]
    if isinstance(kernel, (Enumerate, Jump, Proposed)) and len(kernel.blanket.classes) > 1:
        return [in_classes(kernel, [members]) for members in kernel.blanket.classes]
    return []
