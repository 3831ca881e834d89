"""What the BUGS models share: their vague priors, their files, and reading benchmarks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import bayesmc as bmc
from references.case import Case, Figures, Question

#: Normal with precision 1e-6, 1e-5 and 1e-4
VAGUE = bmc.Normal(0.0, 1e3)
VAGUE_5 = bmc.Normal(0.0, 10.0**2.5)
VAGUE_4 = bmc.Normal(0.0, 1e2)
#: the usual prior of a precision
VAGUE_PRECISION = bmc.Gamma(0.001, 0.001)

_OPENBUGS = "bugs/openbugs_doc/r2openbugs_valid_results.dev.json"


def jags_case(
    model: str,
    test: str,
    build: Callable[..., Question],
    *,
    cdfs: Callable[[Any], Mapping[str, Callable[[Any], Any]]] | None = None,
    **options: Any,
) -> Case:
    """A test of the JAGS suite; ``build`` takes its data, ``cdfs`` gives exact cdfs from them."""

    def question(content: Any) -> Question:
        return build(_data(content["jags"], test))

    def publish(content: Any) -> dict[str, Figures]:
        exact = cdfs(_data(content["jags"], test)) if cdfs else {}
        benchmark = content["jags"]["tests"][test]["benchmark"]
        return {
            name: Figures(b["mean"], b["sd"], b["ts_se"], exact.get(name))
            for name, b in benchmark.items()
        }

    files = {"jags": f"bugs/jags_classic/{model}.json"}
    return Case(model, test, files, question, publish, "bugs", **options)


def openbugs_case(
    model: str,
    test: str,
    entry: str,
    build: Callable[[Any], Question],
    data: str = "",
    **options: Any,
) -> Case:
    """The example ``entry`` of OpenBUGS's validation runs, with the data of that run.

    The data are under ``entry`` too, unless ``data`` names another one.
    """

    def publish(content: Any) -> dict[str, Figures]:
        figures = content["openbugs"]["results"][entry]
        return {name: Figures(f["mean"], f["sd"]) for name, f in figures.items()}

    def question(content: Any) -> Question:
        return build(content["openbugs"]["data"][data or entry])

    return Case(model, test, {"openbugs": _OPENBUGS}, question, publish, "bugs", **options)


def _data(content: Any, test: str) -> dict[str, Any]:
    """The variables of a test's data files."""
    merged: dict[str, Any] = {}
    for file in content["tests"][test]["data"]:
        merged |= content["data"][file]
    return merged
