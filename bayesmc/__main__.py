"""Queries from a shell: ``python -m bayesmc net.bif --evidence smoke=yes --query lung``.

Reads a net from a file, asks `infer` and prints a table or JSON; draws the answers where asked.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.auto import infer
from bayesmc.errors import BayesmcError
from bayesmc.io import read
from bayesmc.plotting import plot_marginal
from bayesmc.plotting.pyplot import pyplot

if TYPE_CHECKING:
    from bayesmc.network import BayesNet
    from bayesmc.results import Posterior

#: as `argparse` has it where a command is wrong
WRONG = 2
WIDTH = 30  # of the bars of a table, in characters


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit status: 0, or 2 with the fault on standard error.

    Parameters
    ----------
    arguments : sequence of str, optional
        Of the command line; by default those that Python was given.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> import bayesmc as bmc
    >>> net = bmc.BayesNet("lungs")
    >>> net.table("smoke", probs=[0.7, 0.3], states=("no", "yes"))
    >>> net.table("cough", ["smoke"], [[0.9, 0.1], [0.5, 0.5]], states=("no", "yes"))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "lungs.bif"
    >>> bmc.io.write(net, path)
    >>> main([str(path), "--evidence", "cough=yes", "--query", "smoke"])
    evidence: cough=yes  (log probability -1.514, Exact)
    smoke
      no    0.318182  ##########
      yes   0.681818  ####################
    0
    """
    asked = _parser().parse_args(arguments)
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            net = read(asked.net)
            evidence = _evidence(net, asked.evidence)
            posterior = infer(net, evidence, rng=asked.seed)
            names = list(dict.fromkeys(asked.query)) or [n for n in net if n not in evidence]
            answers = {name: _answer(net, posterior, name) for name in names}
            if asked.picture:
                _draw(posterior, names, asked.picture)
    except (BayesmcError, OSError) as error:
        print(f"bayesmc: {error}", file=sys.stderr)
        return WRONG
    for warning in said:
        print(f"bayesmc: {warning.message}", file=sys.stderr)
    found = {
        "evidence": evidence,
        "log_evidence": _number(posterior.log_marginal_likelihood),
        "engine": type(posterior.engine).__name__,
        "probabilities": answers,
    }
    print(json.dumps(found, indent=2) if asked.json else _table(found))
    return 0


# ---- private ------------------------------------------------------------------------------------


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m bayesmc", description="Ask a discrete Bayesian network for probabilities."
    )
    parser.add_argument("net", help="a file: BIF (.bif) or XMLBIF (.xmlbif, .xml), also as .gz")
    parser.add_argument(
        "--evidence", "-e", nargs="+", default=[], action="extend", metavar="NODE=STATE",
        help="what is observed",
    )  # fmt: skip
    parser.add_argument(
        "--query", "-q", nargs="+", default=[], action="extend", metavar="NODE",
        help="what is asked; by default all that is not observed",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print JSON in place of a table")
    parser.add_argument("--picture", metavar="FILE", help="draw the answers to .png, .svg or .pdf")
    parser.add_argument("--seed", type=int, help="of random numbers, where the answer needs some")
    return parser


def _evidence(net: BayesNet, given: Sequence[str]) -> dict[str, str]:
    """States by node, as the file spells them; what is wrong with a state `infer` says."""
    found: dict[str, str] = {}
    for part in given:
        name, equals, state = part.partition("=")
        if not equals:
            raise BayesmcError(f"--evidence {part!r} is not of the form NODE=STATE")
        if found.setdefault(name, state) != state:
            raise BayesmcError(
                f"--evidence: {name!r} is given twice, as {found[name]!r} and {state!r}"
            )
    return found


def _answer(net: BayesNet, posterior: Posterior, name: str) -> dict[str, float]:
    table = posterior.probabilities(name)
    states = net[name].states or range(len(table))
    return {str(state): float(p) for state, p in zip(states, table, strict=True)}


def _number(log_evidence: Any) -> float | None:
    """JSON knows no infinity."""
    return float(log_evidence) if log_evidence is not None and np.isfinite(log_evidence) else None


def _table(found: dict[str, Any]) -> str:
    given = ", ".join(f"{k}={v}" for k, v in found["evidence"].items()) or "none"
    log = found["log_evidence"]
    how = found["engine"] if log is None else f"log probability {log:.4g}, {found['engine']}"
    lines = [f"evidence: {given}  ({how})"]
    wide = max((len(state) for p in found["probabilities"].values() for state in p), default=0) + 2
    for name, probabilities in found["probabilities"].items():
        lines.append(name)
        for state, p in probabilities.items():
            bar = "#" * round(WIDTH * p)
            lines.append(f"  {state:{wide}} {p:.6f}  {bar}".rstrip())
    return "\n".join(lines)


def _draw(posterior: Posterior, names: Sequence[str], path: str) -> None:
    plt = pyplot()
    columns = min(len(names), 4)
    rows = -(-len(names) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(3.2 * columns, 2.6 * rows), squeeze=False, layout="constrained"
    )
    for ax, name in zip(axes.flat, names, strict=False):
        plot_marginal(posterior, name, ax=ax)
    for ax in axes.flat[len(names) :]:
        ax.set_axis_off()
    try:
        figure.savefig(path)
    except ValueError as error:  # a format that matplotlib does not write
        raise BayesmcError(f"--picture {path!r}: {error}") from error
    finally:
        plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
