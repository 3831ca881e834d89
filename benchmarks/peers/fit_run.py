"""Learning by statsmodels, hmmlearn and pyAgrum: ``python fit_run.py`` reads JSON and prints JSON.

Every model is declared as ``bench_fit`` declares it, initial densities included, so that likelihoods are one
function and optima can be compared.
"""

from __future__ import annotations

import json
import sys
import time
import warnings

import numpy as np

warnings.simplefilter("ignore")


class _Linear:
    """A state-space model of statsmodels with two or three parameters, made from the name of its kind."""

    def __new__(cls, kind: str, y: np.ndarray, mean: float, var: float):
        from statsmodels.tsa.statespace.mlemodel import MLEModel

        class Model(MLEModel):
            def __init__(self) -> None:
                super().__init__(y, k_states=1, k_posdef=1)
                self["design"] = np.eye(1)
                self["selection"] = np.eye(1)
                self.ssm.initialize_known(np.array([mean]), np.array([[var]]))

            @property
            def param_names(self) -> list[str]:
                return ["drift", "noise", *(["slope"] if kind == "AR(1)" else [])]

            @property
            def start_params(self) -> np.ndarray:
                spread = np.nanvar(y)
                return np.array([0.3 * spread, 0.3 * spread, *([0.7] if kind == "AR(1)" else [])])

            def transform_params(self, free):
                return np.r_[free[:2] ** 2, free[2:]]

            def untransform_params(self, params):
                return np.r_[np.sqrt(params[:2]), params[2:]]

            def update(self, params, **kwargs):
                params = super().update(params, **kwargs)
                self["state_cov", 0, 0], self["obs_cov", 0, 0] = params[0], params[1]
                self["transition", 0, 0] = params[2] if kind == "AR(1)" else 1.0

        return Model()


def kalman(question: dict) -> dict:
    y = np.array(question["y"], dtype=float)
    model = _Linear(question["kind"], y, *question["initial"])
    start = time.perf_counter()
    found = model.fit(method="bfgs", maxiter=500, gtol=1e-9, disp=0, cov_type="none")
    found = model.fit(
        found.params, method="nm", maxiter=4000, xtol=1e-10, ftol=1e-12, disp=0, cov_type="none"
    )
    seconds = time.perf_counter() - start
    # its own ways to the information approximate it; here are plain differences of its log likelihood
    errors = np.sqrt(np.diag(np.linalg.inv(-curvature(model.loglike, found.params))))
    return {
        "seconds": seconds,
        "log_likelihood": float(found.llf),
        "values": dict(zip(model.param_names, map(float, found.params), strict=True)),
        "std_errors": dict(zip(model.param_names, map(float, errors), strict=True)),
    }


def curvature(function, at: np.ndarray) -> np.ndarray:
    """Second derivatives by central differences."""
    steps = 2e-3 * np.maximum(np.abs(at), 1e-2)

    def value(i: int, a: int, j: int, b: int) -> float:
        moved = at.copy()
        moved[i] += a * steps[i]
        moved[j] += b * steps[j]
        return function(moved)

    found = np.empty((len(at), len(at)))
    for i, j in np.ndindex(found.shape):
        corners = value(i, 1, j, 1) - value(i, 1, j, -1) - value(i, -1, j, 1) + value(i, -1, j, -1)
        found[i, j] = corners / (4 * steps[i] * steps[j])
    return found


def switching(question: dict) -> dict:
    """Two normal regimes by statsmodels, which states standard errors."""
    from statsmodels.tsa.regime_switching.markov_regression import MarkovRegression

    model = MarkovRegression(np.array(question["y"]), k_regimes=2, switching_variance=True)
    model.initialize_known(np.array([0.5, 0.5]))
    start = time.perf_counter()
    best = model.fit(search_reps=20, search_iter=5, disp=False)
    best = model.fit(
        best.params, method="nm", maxiter=20_000, xtol=1e-10, ftol=1e-12, disp=False, em_iter=0
    )
    names, values = model.param_names, dict(zip(model.param_names, best.params, strict=True))
    return {
        "seconds": time.perf_counter() - start,
        "log_likelihood": float(best.llf),
        "values": {n: float(values[n]) for n in names},
        "std_errors": dict(zip(names, map(float, best.bse), strict=True)),
    }


def hidden_markov(question: dict) -> dict:
    """The best of many starts of hmmlearn's EM, the first state's distribution given."""
    from hmmlearn.hmm import GaussianHMM, PoissonHMM

    rows = np.array(question["y"], dtype=float).reshape(-1, 1)
    best, start = None, time.perf_counter()
    for seed in range(20):
        options = {
            "n_iter": 5000,
            "tol": 1e-9,
            "random_state": seed,
            "params": "tmcl",
            "init_params": "tmcl",
        }
        if question["kind"] == "poisson":
            options |= {"params": "tl", "init_params": "tl"}
            model = PoissonHMM(2, lambdas_prior=0.0, lambdas_weight=0.0, **options)
            rows = rows.astype(int)
        else:
            options |= {"params": "tmc", "init_params": "tmc"}
            model = GaussianHMM(
                2, "diag", covars_prior=0.0, covars_weight=1.0, min_covar=1e-8, **options
            )
        model.startprob_ = np.array([0.5, 0.5])
        model.fit(rows)
        score = model.score(rows)
        if best is None or score > best:
            best = score
    return {"seconds": time.perf_counter() - start, "log_likelihood": float(best)}


def tables(question: dict) -> dict:
    """pyAgrum's EM from given tables, in one thread, without noise and prior; what is missing is '?'."""
    import pandas as pd
    import pyagrum as gum

    frame = pd.DataFrame(
        {n: ["?" if v is None else v for v in c] for n, c in question["cases"].items()}
    )
    net = _net(question)
    learner = gum.BNLearner(frame, net, ["?"])
    learner.useNoPrior()
    learner.setNumberOfThreads(1)
    learner.useEMWithDiffCriterion(question["difference"], 0.0)
    learner.EMsetMaxIter(question["iterations"])
    learner.EMsetMaxTime(question["milliseconds"])
    busy = time.process_time()
    found = learner.learnParameters(net, False)
    busy = time.process_time() - busy
    learned = {}
    for name, (parents, _) in question["start"].items():
        cpt = found.cpt(name)
        backwards = list(reversed(cpt.names))
        order = [backwards.index(axis) for axis in [*parents, name]]
        learned[name] = np.transpose(cpt.toarray(), order).tolist()
    return {"cpu_seconds": busy, "iterations": learner.EMnbrIterations(), "tables": learned}


def likelihood(question: dict) -> dict:
    """Log probability of what cases show, under given tables."""
    import pyagrum as gum

    engine, total = gum.LazyPropagation(_net(question)), 0.0
    for row in question["rows"]:
        engine.setEvidence(row)
        total += float(np.log(engine.evidenceProbability()))
    return {"log_likelihood": total}


def _net(question: dict):
    """A net of pyAgrum with tables of numbers (its BIF reader rounds), the node's own states last."""
    import pyagrum as gum

    net = gum.loadBN(question["network"])
    for name, (parents, table) in question["start"].items():
        cpt = net.cpt(name)
        # its arrays have the axes of `names` backwards
        order = [[*parents, name].index(axis) for axis in reversed(cpt.names)]
        cpt.fillWith(np.transpose(np.array(table), order).ravel().tolist())
    return net


if __name__ == "__main__":
    asked = json.load(sys.stdin)
    jobs = {
        "kalman": kalman,
        "switching": switching,
        "hidden Markov": hidden_markov,
        "tables": tables,
        "likelihood": likelihood,
    }
    print(json.dumps(jobs[asked["job"]](asked)))
