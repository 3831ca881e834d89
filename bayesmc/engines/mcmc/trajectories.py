"""What is worth a warning of Hamiltonian trajectories: that they diverged, and where; that they were cut;
energies.

A trajectory diverges where the density bends more sharply than the step that suits the rest can follow.
Chains stay away from there, so draws beside such places, and not there, are what shows it.

References
----------
Betancourt (2017), A conceptual introduction to Hamiltonian Monte Carlo, arXiv 1701.02434, sec. 6.2;
Betancourt (2016), Diagnosing suboptimal cotangent disintegrations in Hamiltonian Monte Carlo, arXiv
1604.00695.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from bayesmc.engines.mcmc.convergence import scalar_name
from bayesmc.kernels.hamiltonian import Hamiltonian
from bayesmc.kernels.rescaled import Rescaled
from bayesmc.results import ChainsPosterior, ChainsSums

#: share of trajectories that may diverge by chance, as at the edge of a support; standard errors beyond it
_CHANCE, _ERRORS = 1e-3, 2.0
#: share of trajectories that may be cut short
_CUT = 0.01
#: E-BFMI below which energies are explored too slowly (Betancourt 2016, sec. 5)
_LEAST_RATIO = 0.3
#: standard errors by which ranks of a number must be off where trajectories diverged; numbers looked at
_LIMIT, _NUMBERS = 4.0, 2_000_000
#: share of trajectories from which on nearly all are cut
_MOSTLY = 0.9


def faulty_trajectories(
    posterior: ChainsPosterior | ChainsSums, kernels: list[Any], state: Mapping[str, Any]
) -> Iterator[str]:
    """What is wrong with the trajectories of a run, in words, and the remedy.

    Parameters
    ----------
    posterior : ChainsPosterior or ChainsSums
    kernels : list of Kernel
    state : dict
        Of the sampler, after the last draw.
    """
    for kernel, memory in zip(kernels, state.get("memory", ()), strict=False):
        if not isinstance(kernel, Hamiltonian) or not memory["moves"]:
            continue
        moves = memory["moves"] * len(memory["divergences"])
        diverged = int(memory["divergences"].sum())
        expected = _CHANCE * moves
        if diverged > expected + _ERRORS * np.sqrt(expected):
            names, where = _where(posterior, kernel)
            apart = _apart_from(kernel, memory, kernels, names)
            yield (
                f"{diverged} of {moves} trajectories diverged{where}: the density bends "
                "there more sharply than their steps can follow, and draws leave it out; "
                f"{apart}give tighter priors, or {_shorter(posterior, memory)}"
            )
        cut = int(memory["saturated"].sum())
        if cut > _CUT * moves:
            yield (
                f"{cut} of {moves} trajectories were cut at {kernel.max_depth} doublings, so that draws stay "
                f"near each other; {_longer(posterior, kernel, cut > _MOSTLY * moves)}"
            )
        ratio = float(np.nanmin(kernel.energy_ratio(memory))) if memory["moves"] > 100 else np.inf
        if ratio < _LEAST_RATIO:
            tied = (
                "write what a potential ties to its scale as scale * z with the potential on z, "
                if posterior.model.potentials
                else ""
            )
            yield (
                f"energies change slowly (E-BFMI {ratio:.2f}, under {_LEAST_RATIO}): heavy tails or a funnel "
                f"are explored slowly, if at all; {_apart_from(kernel, memory, kernels)}{tied}declare heavy "
                "tails as a scale mixture, or give tighter priors"
            )


# ---- private ------------------------------------------------------------------------------------


def _apart_from(
    kernel: Hamiltonian,
    memory: Mapping[str, Any],
    kernels: list[Any],
    names: Sequence[str] = (),
) -> str:
    """Effects that are to be declared apart from their scale, in words; empty where all are.

    Of several scales the first among ``names``, the nodes that tell where trajectories diverged.
    """
    rescaled = [k for k in kernels if isinstance(k, Rescaled)]
    named = [k for k in rescaled if k.name in names]
    if rescaled:
        scaled = (named or rescaled)[0]
        return (
            f"declare {', '.join(map(repr, scaled.below))} apart from the scale {scaled.name!r} "
            "(z ~ Normal(0, 1), b = sigma * z), "
        )
    target: Any = getattr(kernel.density, "target", None)
    if target is None:
        return ""
    terms, moved = target.terms, set(kernel.density.names)
    own = [n for n in moved - kernel.apart(memory) if n in terms]
    if any(moved.intersection(target.hidden_above(terms[n])) - {n} for n in own):
        return "declare effects apart from their scale (z ~ Normal(0, 1), b = sigma * z), "
    return ""


def _longer(
    posterior: ChainsPosterior | ChainsSums, kernel: Hamiltonian, is_nearly_all: bool
) -> str:
    """What helps trajectories that end nowhere, in words, without what is done already."""
    own = getattr(posterior.engine, "max_depth", None)
    deeper = f"max_depth={kernel.max_depth + 2}"
    ways = [] if kernel.metric.kind == "dense" else ['metric="dense"']
    if own is None:
        options = ", ".join([*ways, deeper])
        said = f"use HamiltonianMonteCarlo({options}), or numbers less correlated"
    else:
        said = f"use {', '.join([*ways, deeper])}, or numbers less correlated"
    if not is_nearly_all:
        return said
    return (
        f"{said}; where nearly all are cut, numbers are of very different size (measure in units of their "
        "spread), priors are far wider than what the data tell, or chains start far away (start=)"
    )


def _shorter(posterior: ChainsPosterior | ChainsSums, memory: Mapping[str, Any]) -> str:
    """How steps are made shorter, in words."""
    used = memory["step"].get("target", 0.8)
    higher = " or ".join(f"{a:g}" for a in (0.95, 0.99, 0.999) if a > used + 1e-9)
    known = getattr(posterior.engine, "target_accept", None)
    if known is None:
        return f"use HamiltonianMonteCarlo(target_accept={higher.split()[0]})"
    return f"raise target_accept={known:g} ({higher})" if higher else "another engine"


def _where(posterior: ChainsPosterior | ChainsSums, kernel: Hamiltonian) -> tuple[list[str], str]:
    """The nodes whose numbers tell most where trajectories diverged, and words; empty where none does."""
    diverged = posterior.divergences
    if not isinstance(posterior, ChainsPosterior) or diverged is None:
        return [], ""
    if not diverged.any() or diverged.all():
        return [], ""
    found: list[tuple[float, str, str]] = []
    left = _NUMBERS
    for name in kernel.density.names:
        stored = posterior._stored.get(name)
        if stored is None or left < diverged.size:
            continue
        columns = stored.reshape(*diverged.shape, -1)[..., : left // diverged.size]
        left -= columns.size
        shape = posterior.model[name].value_shape
        for k in range(columns.shape[-1]):
            score, words = _apart(columns[..., k], diverged)
            index = np.unravel_index(k, shape) if shape else ()
            label = scalar_name(posterior.model, name, tuple(int(i) for i in index))
            found.append((score, name, f"{label!r} is {words}"))
    found = sorted((f for f in found if f[0] > _LIMIT), key=lambda f: -f[0])[:2]
    if not found:
        return [], ""
    words = " and ".join(words for _, _, words in found)
    return [name for _, name, _ in found], f", most of them where {words}"


def _apart(values: np.ndarray, diverged: np.ndarray) -> tuple[float, str]:
    """Standard errors by which ranks of diverged draws are off (Mann and Whitney), and which way."""
    ranks = np.empty(values.size)
    ranks[np.argsort(values, axis=None, kind="stable")] = np.arange(values.size)
    there = diverged.ravel()
    count, others = int(there.sum()), int((~there).sum())
    off = ranks[there].mean() - (values.size - 1) / 2
    error = np.sqrt((values.size + 1) * others / (12.0 * count))
    here, elsewhere = np.median(values[diverged]), np.median(values[~diverged])
    way = "low" if off < 0 else "high"
    return float(abs(off) / error), f"{way} (median {here:.3g}, {elsewhere:.3g} elsewhere)"
