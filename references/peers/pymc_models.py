"""Some reference models by PyMC's default sampler, in a process of its own.

``python pymc_models.py MODEL DATA.json DRAWS.npz`` runs ``pm.sample`` as it comes (NUTS, four chains, 1,000
draws each after 1,000 of tuning), on one core, and saves what is published, (chain, draw, ...), with the
processor seconds from the model's declaration to its draws, compiling included and imports not. It imports
nothing of bayesmc. Random effects are a scale times standard Normals, labels are summed out: as is advised.
"""

from __future__ import annotations

import json
import resource
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pymc.math as pmm
from scipy.special import gammaln

Data = dict[str, Any]


def main(model: str, data: str, target: str) -> None:
    """Sample one model."""
    warnings.simplefilter("ignore")
    values = json.loads(Path(data).read_text())
    before = used()
    with pm.Model():
        kept = MODELS[model](**{name: np.array(value) for name, value in values.items()})
        trace = pm.sample(chains=4, cores=1, random_seed=1, progressbar=False)
    seconds = used() - before
    found = {name: trace.posterior[name].values for name in kept}
    np.savez(target, seconds=seconds, **found)


def used() -> float:
    """Seconds of processor time of this process and of its children that have ended (the compiler)."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def flat(most: float) -> Any:
    """A scale between 0 and ``most``."""
    return pm.Uniform("sigma", 0.0, most)


def half_cauchy() -> Any:
    """A scale with a heavy tail."""
    return pm.HalfCauchy("sigma", 2.5)


def vague() -> Any:
    """The scale whose precision is all but flat on the log."""
    return pm.Deterministic("sigma", pm.Gamma("tau", 1e-3, 1e-3) ** -0.5)


def exponential() -> Any:
    """An exponential scale."""
    return pm.Exponential("sigma", 1.0)


def regression(sigma: Any) -> Any:
    """A linear regression with a prior of its scale."""

    def model(X: Any, y: Any, means: Any, precision: Any, K: Any, N: Any) -> list[str]:
        beta = pm.Normal("beta", means, np.diag(precision) ** -0.5, shape=int(K))
        pm.Normal("y", X @ beta, sigma(), observed=y)
        return ["beta", "sigma"]

    return model


def schools(y: Any, sigma: Any) -> list[str]:
    """Coaching effects, not centred."""
    mu, tau = pm.Normal("mu", 0.0, 5.0), pm.HalfCauchy("tau", 5.0)
    z = pm.Normal("z", 0.0, 1.0, shape=len(y))
    theta = pm.Deterministic("theta", mu + tau * z)
    pm.Normal("y", theta, sigma, observed=y)
    return ["theta", "mu", "tau"]


def seeds(sigma: Any, to_zero: bool = False) -> Any:
    """Germination, a random effect for every plot."""

    def model(r: Any, n: Any, x1: Any, x2: Any, N: Any) -> list[str]:
        names = ["alpha0", "alpha1", "alpha2", "alpha12"]
        a0, a1, a2, a12 = (pm.Normal(name, 0.0, 1e3) for name in names)
        z = pm.Normal("z", 0.0, 1.0, shape=int(N))
        b = sigma() * (z - z.mean() if to_zero else z)
        logit = a0 + a1 * x1 + a2 * x2 + a12 * x1 * x2 + b
        pm.Binomial("r", n, logit_p=logit, observed=r)
        return [*names, "sigma"]

    return model


def salm(sigma: Any) -> Any:
    """Counts by dose with more spread than Poisson."""

    def model(x: Any, y: Any, doses: Any, plates: Any) -> list[str]:
        log_x = np.log(x + 10)
        star = pm.Normal("star", 0.0, 1e2)
        beta, gamma = pm.Normal("beta", 0.0, 1e2), pm.Normal("gamma", 0.0, 1e5)
        pm.Deterministic("alpha", star - beta * log_x.mean() - gamma * x.mean())
        fit = star + beta * (log_x - log_x.mean()) + gamma * (x - x.mean())
        z = pm.Normal("z", 0.0, 1.0, shape=y.shape)
        eta = fit[:, None] + sigma() * z
        density = y * eta - pmm.exp(eta) - gammaln(y + 1)
        pm.Deterministic("deviance", -2 * density.sum())
        pm.Poisson("y", pmm.exp(eta), observed=y)
        return ["alpha", "beta", "gamma", "sigma", "deviance"]

    return model


def epil(visits: bool) -> Any:
    """Seizures, random effects of patients and, if asked, visits."""

    def model(y: Any, Trt: Any, Base: Any, Age: Any, V4: Any, N: Any, T: Any) -> list[str]:
        names = ["alpha0", "alpha.Base", "alpha.Trt", "alpha.BT", "alpha.Age", "alpha.V4"]
        a0, base, treated, both, age, fourth = (pm.Normal(name, 0.0, 1e2) for name in names)
        s1 = pm.Deterministic("sigma.b1", pm.Gamma("tau1", 1e-3, 1e-3) ** -0.5)
        log_base = np.log(Base / 4)
        patient = a0 + base * log_base + treated * Trt + both * Trt * log_base
        patient = patient + age * np.log(Age) + s1 * pm.Normal("z1", 0.0, 1.0, shape=int(N))
        eta, more = patient[:, None] + fourth * V4, []
        if visits:
            s = pm.Deterministic("sigma.b", pm.Gamma("tau", 1e-3, 1e-3) ** -0.5)
            eta, more = eta + s * pm.Normal("z", 0.0, 1.0, shape=y.shape), ["sigma.b"]
        pm.Poisson("y", pmm.exp(eta), observed=y)
        return [*names, "sigma.b1", *more]

    return model


def mixture(y: Any, N: Any) -> list[str]:
    """Two Gaussians, labels summed out."""
    theta = pm.Beta("theta", 5.0, 5.0)
    ordered = pm.distributions.transforms.ordered
    mu = pm.Normal("mu", 0.0, 2.0, shape=2, transform=ordered, initval=np.array([-1.0, 1.0]))
    sigma = pm.HalfNormal("sigma", 2.0, shape=2)
    weights = pmm.stack([theta, 1 - theta])
    pm.NormalMixture("y", w=weights, mu=mu, sigma=sigma, observed=y)
    return ["theta", "mu", "sigma"]


MODELS = {
    "regression, flat": regression(lambda: flat(100.0)),
    "regression, flat and wide": regression(lambda: flat(1e6)),
    "regression": regression(half_cauchy),
    "schools": schools,
    "seeds": seeds(vague),
    "seeds, to zero": seeds(vague, True),
    "seeds, exponential": seeds(exponential),
    "seeds, uniform": seeds(lambda: flat(10.0)),
    "salm": salm(vague),
    "salm, uniform": salm(lambda: flat(5.0)),
    "epil": epil(False),
    "epil, visits": epil(True),
    "mixture": mixture,
}


if __name__ == "__main__":
    main(*sys.argv[1:])
