"""What a user waits for: eight schools and rats, from the call to the posterior, and its ESS.

Every sampler runs in a process of its own, so that imports and compilation count; the seconds from
call to posterior stand beside. The smallest bulk ESS over all hidden scalars is worked out by one
function for all. ``--long`` adds PyMC on the centred schools, which suit no gradient; ``--cold`` gives
PyMC an empty compilation cache, as on a machine that never ran it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import bayesmc as bmc
from benchmarks import THREADS, models_gibbs
from benchmarks.harness import HERE, data_folder, peer_python, table
from benchmarks.peers import jags_run

MODELS = ("schools_noncentred", "schools_centred", "rats")
TITLES = {
    "schools_noncentred": "eight schools, not centred",
    "schools_centred": "eight schools, centred",
    "rats": "rats",
}
JAGS_DRAWS = {"schools_noncentred": 10_000, "schools_centred": 10_000, "rats": 4_000}
OWN_DRAWS = {"schools_noncentred": 4_000, "schools_centred": 4_000, "rats": 4_000}
GOAL = "JAGS's seconds, at an ESS of 4,000"


@dataclass(frozen=True)
class Wait:
    """Seconds of the process and of the call, and draws by name, (chain, draw, ...)."""

    process: float
    call: float | None
    draws: Mapping[str, np.ndarray]


def main(arguments: Sequence[str]) -> None:
    """Print one table for each model; ``arguments`` are those of the command line."""
    for model in MODELS:
        if model == "rats" and not data_folder().exists():
            print(f"no data at {data_folder()}: rats are left out")
            continue
        waits: dict[str, Wait] = {}
        if hasattr(bmc, "Gibbs"):
            waits["bayesmc, defaults"] = _own(model, 0)
            waits[f"bayesmc, {OWN_DRAWS[model]} draws"] = _own(model, OWN_DRAWS[model])
        if jags_run.installed():
            waits["JAGS"] = _jags(model)
        if peer_python() is not None and (model != "schools_centred" or "--long" in arguments):
            found = _pymc(model, cold="--cold" in arguments)
            waits |= {"PyMC": found} if found else {}
        print(_table(TITLES[model], waits) + "\n", flush=True)


def own(model: str, draws: int, target: str) -> None:
    """One call of bayesmc in this process; saves the draws and the seconds of the call."""
    warnings.simplefilter("ignore")
    net, evidence = _net(model)
    engine = bmc.Gibbs(draws=draws) if draws else bmc.Gibbs()
    start = time.perf_counter()
    posterior = bmc.infer(net, evidence, engine=engine, rng=1)
    seconds = time.perf_counter() - start
    names = [name for name in net if name not in evidence]
    np.savez(target, seconds=seconds, **{name: posterior[name] for name in names})


def smallest_ess(draws: Mapping[str, np.ndarray]) -> tuple[float, str]:
    """The smallest bulk ESS (Vehtari et al. 2021, by ArviZ) and whose it is."""
    from arviz_stats.base import array_stats

    found = []
    for name, values in draws.items():
        for index, one in enumerate(np.moveaxis(values.reshape(*values.shape[:2], -1), -1, 0)):
            ess = array_stats.ess(one, chain_axis=0, draw_axis=1, method="bulk")
            found.append((float(ess), f"{name}[{index}]" if values.ndim > 2 else name))
    return min(found)


def _table(title: str, waits: Mapping[str, Wait]) -> str:
    rows = []
    for name, wait in waits.items():
        chains, draws = next(iter(wait.draws.values())).shape[:2]
        ess, whose = smallest_ess(wait.draws)
        call = wait.process if wait.call is None else wait.call
        row = [name, wait.process, wait.call or "", f"{chains}x{draws}", ess, whose, ess / call]
        rows.append(row)
    header = ["", "process, s", "call, s", "draws", "smallest ESS", "of", "ESS per s"]
    return table(f"{title} (goal: {GOAL})", header, rows)


def _own(model: str, draws: int) -> Wait:
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "draws.npz"
        start = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "benchmarks.bench_waiting", model, str(draws), str(target)],
            check=True,
            cwd=HERE.parent,
        )
        seconds = time.perf_counter() - start
        found = dict(np.load(target))
    return Wait(seconds, float(found.pop("seconds")), found)


def _jags(model: str) -> Wait:
    monitors, starts = ["mu", "tau", "theta"], {}
    if model == "rats":
        tau = dict.fromkeys(("tau_c", "tau_alpha", "tau_beta"), 1.0)
        means = {"alpha": np.full(30, 250.0), "beta": np.full(30, 6.0)}
        starts = {**tau, **means, "alpha_c": 250.0, "beta_c": 6.0}
        monitors = list(starts)
    run = jags_run.run(
        jags_run.packaged(model),
        _data(model, centred=True),
        monitors,
        draws=JAGS_DRAWS[model],
        starts=starts,
    )
    return Wait(run.seconds, None, run.draws)


def _pymc(model: str, cold: bool) -> Wait | None:
    environment = {name: value for name, value in os.environ.items() if name not in THREADS}
    with tempfile.TemporaryDirectory() as folder:
        if cold:
            environment["PYTENSOR_FLAGS"] = f"base_compiledir={folder}"
        data, target = Path(folder) / "data.json", Path(folder) / "draws.npz"
        data.write_text(json.dumps({k: v.tolist() for k, v in _data(model).items()}))
        script = HERE / "peers" / "pymc_models.py"
        start = time.perf_counter()
        done = subprocess.run(
            [str(peer_python()), str(script), model, str(data), str(target)],
            env=environment,
            capture_output=True,
            text=True,
        )
        seconds = time.perf_counter() - start
        if done.returncode:
            print(f"PyMC failed on {model}: {done.stderr.strip().splitlines()[-1]}")
            return None
        found = dict(np.load(target))
    return Wait(seconds, None, found)


def _data(model: str, centred: bool = False) -> dict[str, np.ndarray]:
    if model != "rats":
        return {name: np.array(values) for name, values in models_gibbs.EIGHT_SCHOOLS.items()}
    data = models_gibbs.rats_data(data_folder())
    return {**data, "x": data["x"] - data["x"].mean()} if centred else data


def _net(model: str) -> tuple[bmc.BayesNet, dict[str, np.ndarray]]:
    data = _data(model)
    if model == "rats":
        return models_gibbs.rats(bmc, data["x"]), {"y": data["Y"]}
    return models_gibbs.eight_schools(bmc, model == "schools_centred"), {"y": data["y"]}


if __name__ == "__main__":
    if len(sys.argv) == 4:
        own(sys.argv[1], int(sys.argv[2]), sys.argv[3])
    else:
        main(sys.argv[1:])
