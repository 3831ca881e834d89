"""Eight schools and rats by PyMC's default sampler, in a process of its own.

``python pymc_models.py MODEL DATA.json DRAWS.npz`` runs ``pm.sample`` as it comes (NUTS, four
chains on two cores, 1,000 draws each after 1,000 of tuning) and saves the free variables, (chain, draw, ...).
MODEL is ``schools_centred``, ``schools_noncentred`` or ``rats``. Who starts it takes the time:
import and compilation count, as a user waits for them. It imports nothing of bayesmc.
"""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path

import numpy as np
import pymc as pm


def main(model: str, data: str, target: str) -> None:
    """Sample one model."""
    warnings.simplefilter("ignore")
    values = {name: np.array(value) for name, value in json.loads(Path(data).read_text()).items()}
    with {"rats": rats, "schools_centred": centred, "schools_noncentred": noncentred}[model](
        values
    ):
        trace = pm.sample(chains=4, cores=2, random_seed=1, progressbar=False)
    np.savez(target, **{name: trace.posterior[name].values for name in trace.posterior})


def centred(data: dict[str, np.ndarray]) -> pm.Model:
    """Effects drawn around their mean."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 5.0)
        tau = pm.HalfCauchy("tau", 5.0)
        theta = pm.Normal("theta", mu, tau, shape=8)
        pm.Normal("y", theta, data["sigma"], observed=data["y"])
    return model


def noncentred(data: dict[str, np.ndarray]) -> pm.Model:
    """Standard normal effects, scaled and shifted."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 5.0)
        tau = pm.HalfCauchy("tau", 5.0)
        z = pm.Normal("z", 0.0, 1.0, shape=8)
        theta = pm.Deterministic("theta", mu + tau * z)
        pm.Normal("y", theta, data["sigma"], observed=data["y"])
    return model


def rats(data: dict[str, np.ndarray]) -> pm.Model:
    """Intercepts and slopes by rat."""
    days = data["x"] - data["x"].mean()
    with pm.Model() as model:
        tau_c = pm.Gamma("tau_c", 1e-3, 1e-3)
        tau_alpha = pm.Gamma("tau_alpha", 1e-3, 1e-3)
        tau_beta = pm.Gamma("tau_beta", 1e-3, 1e-3)
        alpha_c = pm.Normal("alpha_c", 0.0, 100.0)
        beta_c = pm.Normal("beta_c", 0.0, 100.0)
        alpha = pm.Normal("alpha", alpha_c, tau=tau_alpha, shape=30)
        beta = pm.Normal("beta", beta_c, tau=tau_beta, shape=30)
        pm.Normal("y", alpha[:, None] + beta[:, None] * days, tau=tau_c, observed=data["Y"])
    return model


if __name__ == "__main__":
    main(*sys.argv[1:])
