"""The reference models in JAGS's language, and how many draws it takes for an effective size.

The texts stand in ``jags/``; what differs between models of one text (a prior, a link) is a word in capitals
there. Regressions get all coefficients as one multivariate Normal, which JAGS draws as one block.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import xlogy

from bayesmc import diagnostics
from benchmarks.peers import jags_run
from references.case import Case
from references.peers.figures import Peer

_HERE = Path(__file__).parent / "jags"

#: draws of each chain at first and at most, chains, and seconds after which it is not tried with more
_FIRST, _LAST, CHAINS, _PATIENCE = 1000, 1 << 20, 4, 30.0

Data = dict[str, Any]


@dataclass(frozen=True)
class Text:
    """A model's text, and how a case's data and names go with it.

    Attributes
    ----------
    file : str
        Name of the text in ``jags/``.
    words : mapping
        Word in capitals -> what stands for it.
    data : callable
        Case and data folder -> variables of the text.
    names : mapping
        Published name -> that of the text, where they differ.
    starts : mapping
        Where chains start, if not where JAGS would.
    modules : sequence of str
        JAGS's modules that the text needs.
    """

    file: str
    data: Callable[[Case, Path], Data]
    words: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    starts: Mapping[str, Any] = field(default_factory=dict)
    modules: tuple[str, ...] = ()

    def read(self) -> str:
        """The text with its words put in."""
        text = (_HERE / f"{self.file}.bug").read_text(encoding="utf-8")
        for word, meaning in self.words.items():
            text = text.replace(word, meaning)
        return text


@dataclass(frozen=True)
class Reached:
    """One run: its draws of each chain, modules besides the usual, smallest effective size, seconds."""

    draws: int
    modules: tuple[str, ...]
    ess: float
    seconds: float
    values: Mapping[str, np.ndarray]

    @property
    def rate(self) -> float:
        """Effective draws in a second."""
        return self.ess / self.seconds


def run(case: Case, root: Path, draws: int, modules: Sequence[str] = (), seed: int = 1) -> Reached:
    """One run of a case: four chains, 1,000 sweeps of adaptation and warmup, then ``draws`` of each."""
    text = TEXTS[case.name]
    names = {name: text.names.get(name, name) for name in case.published(root)}
    loaded = (*text.modules, *modules)
    found = jags_run.run(
        text.read(),
        text.data(case, root),
        list(names.values()),
        chains=CHAINS,
        draws=draws,
        starts=text.starts,
        modules=loaded,
        seed=seed,
    )
    values = {name: found.draws[own] for name, own in names.items()}
    return Reached(draws, loaded, smallest(values), found.cpu, values)


def reach(
    case: Case, root: Path, ess: float, modules: Sequence[str] = (), patience: float = _PATIENCE
) -> Reached:
    """The run with as many draws as it takes: their number is doubled until ``ess`` is reached.

    It ends without, too: after a run of more than ``patience`` seconds.
    """
    draws = _FIRST
    while True:
        found = run(case, root, draws, modules)
        if found.ess >= ess or found.seconds > patience or draws >= _LAST:
            return found
        draws *= 2


def best(case: Case, root: Path, ess: float) -> Peer:
    """The better of JAGS as it comes and with its module ``glm``, which draws regressions as blocks.

    What takes longer than the other and has not got there is not tried with more draws.
    """
    blocks = reach(case, root, ess, ("glm",))
    run = max((reach(case, root, ess, (), blocks.seconds), blocks), key=lambda run: run.rate)
    how = " ".join([f"{CHAINS} x {run.draws}", *run.modules])
    return Peer(round(run.ess, 1), round(run.seconds, 4), how)


def smallest(values: Mapping[str, np.ndarray]) -> float:
    """The smallest bulk effective size of some scalars, (chain, draw) each, of those that move."""
    sizes = [float(diagnostics.chain_statistic("ess", draws)) for draws in values.values()]
    return float(np.nanmin(sizes))


# ---- data ---------------------------------------------------------------------------------------


def _published(case: Case, root: Path) -> Data:
    """The variables that a BUGS case is published with."""
    content = case.read(root)
    if "openbugs" in content:
        return dict(content["openbugs"]["data"][case.model.capitalize()])
    if "jags" not in content:
        return dict(content["data"])
    files = content["jags"]["tests"][case.test]["data"]
    return {name: v for file in files for name, v in content["jags"]["data"][file].items()}


def _only(*wanted: str, **more: Any) -> Callable[[Case, Path], Data]:
    """Some of the published variables, and others."""

    def data(case: Case, root: Path) -> Data:
        found = _published(case, root)
        return {name: _numbers(found[name]) for name in wanted} | more

    return data


def _numbers(values: Any) -> np.ndarray:
    """An array in which what is missing is NaN."""
    array = np.array(values)
    return array.astype(float) if array.dtype == object else array


def _beetles(case: Case, root: Path) -> Data:
    found = _only("x", "n", "r", "N")(case, root)
    n, r = found["n"], found["r"]
    return found | {"saturated": float(np.sum(xlogy(r, r / n) + xlogy(n - r, 1 - r / n)))}


def _hidden(case: Case, root: Path) -> Data:
    return _only("N", "y", ordered=1)(case, root)


def _regression(scales: float | Sequence[float], at: Sequence[float] | None = None) -> Any:
    """Design and response as bayesmc gets them; coefficients have standard deviations ``scales``."""

    def data(case: Case, root: Path) -> Data:
        question = case.question(root)
        assert question.inputs is not None
        X = np.array(question.inputs.get("X", question.inputs.get("lags")))
        if "lags" in question.inputs:
            X = np.column_stack([np.ones(len(X)), X])
        K = X.shape[1]
        return {
            "X": X,
            "K": K,
            "N": len(X),
            "y": question.evidence["response"],
            "means": np.zeros(K) if at is None else np.array(at),
            "precision": np.diag(1 / np.broadcast_to(scales, K) ** 2),
        }

    return data


def _kilpisjarvi(case: Case, root: Path) -> Data:
    found = _published(case, root)
    at, scales = ([found[f"{kind}{name}"] for name in ("alpha", "beta")] for kind in ("pmu", "ps"))
    return dict(_regression(scales, at)(case, root))


# ---- texts --------------------------------------------------------------------------------------

_VAGUE = {"PRIOR": "dgamma(0.001, 0.001)"}
_HALF_CAUCHY = {"PRIOR": "dt(0, 1 / 6.25, 1) T(0, )"}
_FLAT = {"PRIOR": "dunif(0, 100)"}
_RATS = ("x", "N", "T", "Y")
_SEEDS = ("N", "r", "n", "x1", "x2")
_EPIL = ("N", "T", "y", "Trt", "Base", "Age", "V4")
_SALM = ("doses", "plates", "x", "y")
_TABLES = ("p.tuberculosis", "p.smoking", "p.lung.cancer", "p.xray", "p.dyspnoea")
_CLINIC = ("asia", "dyspnoea", *_TABLES)
_SEEN = ("smoking", "tuberculosis", "lung.cancer", "bronchitis", "xray", "N")

TEXTS: dict[str, Text] = {
    "rats test1": Text("rats", _only(*_RATS)),
    "rats test2": Text("rats", _only(*_RATS)),
    "line test1": Text("line", _only("x", "Y", "N")),
    "dyes test1": Text("dyes", _only("y", "BATCHES", "SAMPLES")),
    "equiv test1": Text("equiv", _only("Y", "group", "N", "T")),
    "equiv test2": Text("equiv", _only("Y", "group", "N", "T")),
    "stacks": Text("stacks", _only("Y", "x", "N", "p")),
    "seeds test1": Text("seeds", _only(*_SEEDS), _VAGUE),
    "seeds test2": Text("seeds_zero", _only(*_SEEDS)),
    "seeds test3": Text("seeds_scaled", _only(*_SEEDS), {"PRIOR": "dexp(1)"}),
    "seeds test4": Text("seeds_scaled", _only(*_SEEDS), {"PRIOR": "dunif(0, 10)"}),
    "seeds test5": Text("seeds", _only(*_SEEDS), {"PRIOR": "dpar(0.5, 0.01)"}),
    "surgical fixed": Text("surgical_fixed", _only("n", "r", "N")),
    "surgical random": Text("surgical_random", _only("n", "r", "N")),
    "beetles test1": Text("beetles", _beetles, {"LINK": "logit"}),
    "beetles test2": Text("beetles", _beetles, {"LINK": "probit"}),
    "beetles test3": Text("beetles", _beetles, {"LINK": "cloglog"}),
    "hearts test1": Text("hearts", _only("N", "y", "t")),
    "pump test1": Text("pump", _only("N", "t", "x")),
    "salm test1": Text("salm", _only(*_SALM), _VAGUE, modules=("dic",)),
    "salm test2": Text("salm", _only(*_SALM), {"PRIOR": "dpar(0.5, 0.04)"}, modules=("dic",)),
    "epil test1": Text("epil", _only(*_EPIL)),
    "epil test2": Text("epil_visits", _only(*_EPIL)),
    "asia test1": Text("asia", _only(*_CLINIC, "p.bronchitis")),
    "asia test2": Text("asia_learnt", _only(*_CLINIC, *_SEEN)),
    "eyes test1": Text(
        "eyes", _only("N", "y", both=1), starts={"T": np.tile([1, 2], 24), "theta": 5.0}
    ),
    "arK": Text(
        "regression",
        _regression(10.0),
        _HALF_CAUCHY,
        names={"alpha": "beta[1]"} | {f"beta[{k}]": f"beta[{k + 1}]" for k in range(1, 6)},
    ),
    "earn_height": Text("regression", _regression(1e8), {"PRIOR": "dunif(0, 1.0E6)"}),
    **{
        name: Text("regression", _regression(1e4), _FLAT)
        for name in (
            "log10earn_height",
            "logearn_height",
            "logearn_height_male",
            "logearn_interaction",
            "logearn_interaction_z",
            "logearn_logheight_male",
        )
    },
    "eight_schools_noncentered": Text("schools", _only("y", "sigma")),
    "hmm_example": Text("hmm", _hidden),
    **{
        f"kidscore_{name}": Text("regression", _regression(1e4), _HALF_CAUCHY)
        for name in ("momhs", "momiq", "momhsiq", "interaction")
    },
    "kilpisjarvi": Text(
        "regression", _kilpisjarvi, _FLAT, names={"alpha": "beta[1]", "beta": "beta[2]"}
    ),
    "low_dim_gauss_mix": Text("mixture", _only("N", "y")),
    "Rate_1": Text("one_rate", _only("k", "n")),
    "Rate_2": Text("two_rates", _only("k1", "n1", "k2", "n2")),
    "Rate_3": Text("common_rate", _only("k1", "n1", "k2", "n2")),
    "Rate_4": Text("one_rate", _only("k", "n")),
    "Rate_5": Text("common_rate", _only("k1", "n1", "k2", "n2")),
}
