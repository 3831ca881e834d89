"""The templates that filters are timed on, with their numbers and simulated series.

``bmc`` is handed in as the module that supplies templates and distributions, as in
``benchmarks.models_gibbs``: nothing here imports bayesmc. The same models by hand are under
``floors/``, for peers in ``peers/particles_run.py`` and ``peers/filterpy_run.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Growth:
    """The benchmark of de Freitas: x' = x/2 + 25x/(1 + x^2) + 8cos(1.2t) + v, y = x^2/20 + e."""

    state_variance: float = 10.0
    noise_variance: float = 1.0
    start_variance: float = 5.0


@dataclass(frozen=True)
class Trend:
    """A position that moves with a speed that wanders, seen in noise whose log scale wanders."""

    position_scale: float = 0.5
    speed_scale: float = 0.3
    speed_decay: float = 0.9
    log_scale_decay: float = 0.95
    log_scale_scale: float = 0.2
    start_scale: float = 1.0


@dataclass(frozen=True)
class Lorenz:
    """Lorenz's equations of 1963 by Euler's steps, with correlated noise; x alone is seen."""

    step: float = 0.02
    sigma: float = 10.0
    rho: float = 28.0
    beta: float = 8.0 / 3.0
    noise_scale: float = 1.0
    root: tuple[tuple[float, float, float], ...] = (
        (0.30, 0.00, 0.00),
        (0.10, 0.40, 0.00),
        (-0.05, 0.10, 0.35),
    )
    start_mean: tuple[float, float, float] = (1.0, 1.0, 20.0)
    start_scale: float = 2.0


@dataclass(frozen=True)
class Volatility:
    """Stochastic volatility: x' = mu + rho(x - mu) + sigma v, y = exp(x/2) e."""

    mu: float = -1.02
    rho: float = 0.9702
    sigma: float = 0.178


GROWTH, TREND, LORENZ, VOLATILITY = Growth(), Trend(), Lorenz(), Volatility()

STATES, MEANS_APART = 10, 1.5
"""Of the hidden Markov model: so many states, whose emissions' means are so far apart."""

_STEP, _DRIVE = 0.1, 0.2
MOTION = np.block([[np.eye(2), _STEP * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
MOTION_NOISE = np.kron(
    _DRIVE * np.array([[_STEP**3 / 3, _STEP**2 / 2], [_STEP**2 / 2, _STEP]]), np.eye(2)
)
SIGHT = np.eye(2, 4)
SIGHT_NOISE = 0.25 * np.eye(2)
START_MEAN, START_COVARIANCE = np.zeros(4), np.eye(4)
"""Motion at nearly constant speed in the plane, (position, speed); positions are seen."""


def growth(bmc: Any) -> Any:
    """The benchmark of de Freitas; observations are ``{"y": growth_series(steps)}``."""
    q, r, start = np.sqrt([GROWTH.state_variance, GROWTH.noise_variance, GROWTH.start_variance])
    dbn = bmc.DynamicBayesNet("growth")

    @dbn.node(initial=bmc.Normal(0.0, start))
    def x(x_prev, t):
        return bmc.Normal(
            0.5 * x_prev + 25.0 * x_prev / (1.0 + x_prev**2) + 8.0 * np.cos(1.2 * t), q
        )

    @dbn.node
    def y(x):
        return bmc.Normal(x**2 / 20.0, r)

    return dbn


def growth_series(steps: int, seed: int = 0) -> np.ndarray:
    """y of slices 0 to ``steps``, shape (steps + 1,); slice 0 is not seen."""
    rng = np.random.default_rng(seed)
    q, r, start = np.sqrt([GROWTH.state_variance, GROWTH.noise_variance, GROWTH.start_variance])
    x, found = start * rng.standard_normal(), [np.nan]
    for t in range(1, steps + 1):
        x = 0.5 * x + 25.0 * x / (1.0 + x**2) + 8.0 * np.cos(1.2 * t) + q * rng.standard_normal()
        found.append(x**2 / 20.0 + r * rng.standard_normal())
    return np.array(found)


def trend(bmc: Any) -> Any:
    """Three scalar states; observations are ``{"y": trend_series(steps)}``."""
    m = TREND
    dbn = bmc.DynamicBayesNet("trend")

    @dbn.node(initial=bmc.Normal(0.0, m.start_scale))
    def log_scale(log_scale_prev):
        return bmc.Normal(m.log_scale_decay * log_scale_prev, m.log_scale_scale)

    @dbn.node(initial=bmc.Normal(0.0, m.start_scale))
    def speed(speed_prev):
        return bmc.Normal(m.speed_decay * speed_prev, m.speed_scale)

    @dbn.node(initial=bmc.Normal(0.0, m.start_scale))
    def position(position_prev, speed):
        return bmc.Normal(position_prev + speed, m.position_scale)

    @dbn.node
    def y(position, log_scale):
        return bmc.Normal(position, np.exp(log_scale))

    return dbn


def trend_series(steps: int, seed: int = 0) -> np.ndarray:
    """y of all slices, shape (steps,)."""
    m, rng = TREND, np.random.default_rng(seed)
    log_scale, speed, position = m.start_scale * rng.standard_normal(3)
    found = []
    for t in range(steps):
        if t:
            log_scale = m.log_scale_decay * log_scale + m.log_scale_scale * rng.standard_normal()
            speed = m.speed_decay * speed + m.speed_scale * rng.standard_normal()
            position = position + speed + m.position_scale * rng.standard_normal()
        found.append(position + np.exp(log_scale) * rng.standard_normal())
    return np.array(found)


def lorenz(bmc: Any) -> Any:
    """One state that is a 3-vector; observations are ``{"y": lorenz_series(steps)}``."""
    m, root = LORENZ, np.array(LORENZ.root)
    covariance = root @ root.T
    dbn = bmc.DynamicBayesNet("lorenz")
    start = bmc.MvNormal(np.array(m.start_mean), m.start_scale**2 * np.eye(3))

    @dbn.node(initial=start)
    def x(x_prev):
        return bmc.MvNormal(lorenz_step(x_prev), covariance)

    @dbn.node
    def y(x):
        return bmc.Normal(x[..., 0], m.noise_scale)

    return dbn


def lorenz_step(x: np.ndarray) -> np.ndarray:
    """One step of Euler's without noise, shape (..., 3)."""
    m = LORENZ
    a, b, c = x[..., 0], x[..., 1], x[..., 2]
    slope = [m.sigma * (b - a), a * (m.rho - c) - b, a * b - m.beta * c]
    return x + m.step * np.stack(slope, axis=-1)


def lorenz_series(steps: int, seed: int = 0) -> np.ndarray:
    """y of all slices, shape (steps,)."""
    m, root, rng = LORENZ, np.array(LORENZ.root), np.random.default_rng(seed)
    x = np.array(m.start_mean) + m.start_scale * rng.standard_normal(3)
    found = []
    for t in range(steps):
        if t:
            x = lorenz_step(x) + root @ rng.standard_normal(3)
        found.append(x[0] + m.noise_scale * rng.standard_normal())
    return np.array(found)


def hmm_numbers() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Initial probabilities (K,), transition probabilities (K, K), means of the emissions (K,)."""
    rng = np.random.default_rng(10)
    transition = 0.2 * rng.dirichlet(np.ones(STATES), STATES) + 0.8 * np.eye(STATES)
    return rng.dirichlet(np.ones(STATES)), transition, MEANS_APART * np.arange(STATES)


def hmm(bmc: Any, sequences: int = 1) -> Any:
    """Ten states, unit Gaussian emissions; observations are ``{"y": hmm_series(steps)}``.

    With several sequences they are a plate, and y has shape (steps, sequences).
    """
    initial, transition, means = hmm_numbers()
    plates = {} if sequences == 1 else {"sequence": sequences}
    dbn = bmc.DynamicBayesNet("hmm", plates=plates)
    dbn.table("state", ["state_prev"], transition, initial=initial, plates=tuple(plates))
    dbn.add("y", lambda state: bmc.Normal(means[state], 1.0), plates=tuple(plates))
    return dbn


def hmm_series(steps: int, sequences: int = 1, seed: int = 0) -> np.ndarray:
    """y, shape (steps,), or (steps, sequences) where there are several."""
    initial, transition, means = hmm_numbers()
    rng = np.random.default_rng(seed)
    rows, u = np.cumsum(transition, axis=1), rng.random((steps, sequences))
    states = np.empty((steps, sequences), int)
    states[0] = np.searchsorted(np.cumsum(initial), u[0])
    for t in range(1, steps):
        states[t] = (u[t][:, None] > rows[states[t - 1], :-1]).sum(axis=1)
    y = means[np.minimum(states, STATES - 1)] + rng.standard_normal((steps, sequences))
    return y[:, 0] if sequences == 1 else y


def motion(bmc: Any) -> Any:
    """A linear-Gaussian state of four numbers; observations are ``{"y": motion_series(steps)}``."""
    dbn = bmc.DynamicBayesNet("motion")

    @dbn.node(initial=bmc.MvNormal(START_MEAN, START_COVARIANCE))
    def x(x_prev):
        return bmc.MvNormal(x_prev @ MOTION.T, MOTION_NOISE)

    @dbn.node
    def y(x):
        return bmc.MvNormal(x @ SIGHT.T, SIGHT_NOISE)

    return dbn


def motion_series(steps: int, seed: int = 0) -> np.ndarray:
    """Positions seen in all slices, shape (steps, 2)."""
    rng = np.random.default_rng(seed)
    root, noise = np.linalg.cholesky(MOTION_NOISE), rng.standard_normal((steps, 4))
    x = START_MEAN + np.linalg.cholesky(START_COVARIANCE) @ noise[0]
    found = [SIGHT @ x]
    for t in range(1, steps):
        x = MOTION @ x + root @ noise[t]
        found.append(SIGHT @ x)
    scale = np.linalg.cholesky(SIGHT_NOISE)
    return np.array(found) + rng.standard_normal((steps, 2)) @ scale.T


def chain(bmc: Any) -> Any:
    """An autoregression seen in noise, for smoothing; observations are ``{"y": numbers}``."""
    dbn = bmc.DynamicBayesNet("chain")
    dbn.add("x", lambda x_prev: bmc.Normal(0.9 * x_prev, 0.5), initial=bmc.Normal(0.0, 1.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.0))
    return dbn


def volatility(bmc: Any) -> Any:
    """Stochastic volatility, stationary from the start; observations are ``{"y": returns}``."""
    m = VOLATILITY
    dbn = bmc.DynamicBayesNet("volatility")

    @dbn.node(initial=bmc.Normal(m.mu, m.sigma / np.sqrt(1.0 - m.rho**2)))
    def x(x_prev):
        return bmc.Normal(m.mu + m.rho * (x_prev - m.mu), m.sigma)

    @dbn.node
    def y(x):
        return bmc.Normal(0.0, np.exp(0.5 * x))

    return dbn


def volatility_series(steps: int, seed: int = 0) -> np.ndarray:
    """Returns in per cent of a simulated series, shape (steps,)."""
    m, rng = VOLATILITY, np.random.default_rng(seed)
    x = m.mu + m.sigma / np.sqrt(1.0 - m.rho**2) * rng.standard_normal()
    found = []
    for t in range(steps):
        if t:
            x = m.mu + m.rho * (x - m.mu) + m.sigma * rng.standard_normal()
        found.append(np.exp(0.5 * x) * rng.standard_normal())
    return np.array(found)


def pounds(data: Path) -> np.ndarray:
    """Daily log returns of GBP against USD in 1997-98, in per cent, from the reference data, (750,)."""
    path = data / "statespace" / "GBP_vs_USD_9798.txt"
    rates = np.loadtxt(path, skiprows=2, usecols=3, max_rows=751)  # a notice of rights follows
    return 100.0 * np.diff(np.log(rates))
