"""Both passes of message passing over a compiled clique tree, in either semiring.

`collect` multiplies messages towards the roots, `distribute` carries normalised beliefs back and
reads off every variable's marginal on the way. Cliques below which nothing is observed keep their
tables from call to call. This room neither chooses a plan nor answers queries.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from .program import CliqueShapes, Program
from .semiring import Semiring
from .structure import Clique

Mask = tuple[int, int, int, int]
"""(before, states, after, state): in a table seen so, only one state of the middle axis stays."""


@dataclass(slots=True)
class Collected:
    """What one clique holds after the collect pass.

    Attributes
    ----------
    work : ndarray
        Potential, evidence and children's messages multiplied: (separator, residual) matrix.
    total : ndarray
        Its row sums.
    message : ndarray or None
        The same rescaled for the parent; None where everything is zero.
    log_scale : float
        Log of what the rescaling divided out.
    """

    work: np.ndarray
    total: np.ndarray
    message: np.ndarray | None
    log_scale: float


@dataclass
class Potentials:
    """One table per clique, with the collected cliques that no evidence has changed."""

    tables: Sequence[np.ndarray]
    semiring: Semiring
    unobserved: dict[int, Collected] = field(default_factory=dict)


def collect(
    cliques: Sequence[Clique],
    program: Program,
    potentials: Potentials,
    changed: set[int],
    slices: Mapping[int, int],
    masks: Mapping[int, Sequence[Mask]],
) -> list[Collected] | None:
    """Messages from the leaves to the roots; None if the total is zero.

    ``changed`` are the cliques at or above evidence; ``slices`` gives the state of each sliced
    variable, ``masks`` the evidence entered by zeroing.
    """
    semiring, tables, kept = potentials.semiring, potentials.tables, potentials.unobserved
    found: list[Collected] = [None] * len(cliques)  # type: ignore[list-item]
    for k in range(len(cliques) - 1, -1, -1):
        if k not in changed:
            one = kept.get(k)
            if one is None:
                one = _collect_one(tables[k], False, k, cliques, program, found, semiring)
                kept[k] = one
        else:
            table, owned = tables[k], False
            if program.cliques[k].sliced:
                index = tuple(
                    slice(slices[v], slices[v] + 1) if v in slices else slice(None)
                    for v in cliques[k].variables
                )
                table, owned = np.array(table[index], order="C"), True
            for mask in masks.get(k, ()):
                table, owned = _masked(table, mask, semiring.zero), True
            one = _collect_one(table, owned, k, cliques, program, found, semiring)
        if one.message is None:
            return None
        found[k] = one
    return found


def distribute(
    cliques: Sequence[Clique],
    program: Program,
    collected: Sequence[Collected],
    semiring: Semiring,
) -> tuple[list[np.ndarray], np.ndarray]:
    """Beliefs from the roots to the leaves.

    Returns
    -------
    ratios : list of ndarray
        For each clique the row weights that turn its collected table into its belief.
    marginals : ndarray
        The marginals of all variables that are not sliced, end to end, linear.
    """
    multiply, ratio_of = semiring.multiply, semiring.ratio
    sum_steps, weighted_rows = semiring.sum_steps, semiring.weighted_rows
    one = np.full(1, 1.0 if semiring.zero == 0.0 else 0.0)
    above: list[np.ndarray] = [one] * len(cliques)
    ratios: list[np.ndarray] = []
    marginals: list[np.ndarray] = []
    shapes = program.cliques
    for k, clique in enumerate(cliques):
        own = collected[k]
        ratio = ratio_of(above[k], own.total)
        ratios.append(ratio)
        outputs = shapes[k].outputs
        if outputs:
            residual = weighted_rows(ratio, own.work)
            for _, steps in outputs:
                marginals.append(sum_steps(residual, steps) if steps else residual)
        if clique.children:
            belief = multiply(own.work, ratio[:, None])
            for child in clique.children:
                above[child] = sum_steps(belief, shapes[child].from_parent)
    if not marginals:
        return ratios, np.zeros(0)
    flat = semiring.to_linear(np.concatenate(marginals))
    # The beliefs are normalised up to rounding, which grows along the tree; end it here.
    flat /= np.repeat(np.add.reduceat(flat, program.starts), program.counts)
    return ratios, flat


def _collect_one(
    table: np.ndarray,
    owned: bool,
    k: int,
    cliques: Sequence[Clique],
    program: Program,
    found: Sequence[Collected],
    semiring: Semiring,
) -> Collected:
    """Multiply the children's messages into a table, in place once the table is our own."""
    multiply = semiring.multiply
    for child in cliques[k].children:
        shapes: CliqueShapes = program.cliques[child]
        message = found[child].message
        assert message is not None
        if not shapes.parent_runs:  # a parent with a single entry
            table, owned = multiply(table, message[0]), True
            continue
        view = table.reshape(shapes.parent_runs)
        factor = message.reshape(shapes.message_runs)
        if owned:
            multiply(view, factor, out=view)
        else:
            table, owned = multiply(view, factor), True
    work = table.reshape(program.cliques[k].matrix)
    total = semiring.row_sums(work)
    message, log_scale = semiring.rescale(total)
    return Collected(work, total, message, log_scale)


def _masked(table: np.ndarray, mask: Mask, zero: float) -> np.ndarray:
    before, states, after, state = mask
    result = np.zeros((before, states, after))
    if zero != 0.0:
        result.fill(zero)
    result[:, state] = table.reshape(before, states, after)[:, state]
    return result


def total_log_scale(collected: Sequence[Collected]) -> float:
    """The log of the total of the product, once collected."""
    return math.fsum(one.log_scale for one in collected)
