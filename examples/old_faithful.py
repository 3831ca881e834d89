"""Old Faithful's two kinds of eruption: hybrid nets on the 272 eruptions of ``data_faithful``.

``two_kinds`` has the parameters of the maximum-likelihood fit of a two-component Gaussian mixture
to these data, log-likelihood -1130.264; the net writes each component's Gaussian over (duration,
waiting) as the density of the duration times that of the waiting time given the duration.
``typical_wait`` learns a mean. Closed forms stand beside the engines, in plain NumPy.
"""

from __future__ import annotations

import math

import numpy as np

import bayesmc as bmc
from examples.data_faithful import ERUPTIONS

KINDS = ("short", "long")
WEIGHTS = np.array([0.355872859773633, 0.6441271402263673])
MEANS = np.array([[2.036388461115325, 54.478516442257565], [4.289661978840258, 79.96811524336044]])
COVARIANCES = np.array(
    [
        [[0.06916767871779178, 0.43516767824999875], [0.43516767824999875, 33.69728243977157]],
        [[0.16996842945731777, 0.9406092264961718], [0.9406092264961718, 36.04621027362193]],
    ]
)
LOG_LIKELIHOOD = -1130.2639601848146  # of the fit, on all 272 eruptions

DURATIONS = np.array([duration for duration, _ in ERUPTIONS])
WAITS = np.array([wait for _, wait in ERUPTIONS], dtype=float)

MEAN, SD = MEANS[:, 0], np.sqrt(COVARIANCES[:, 0, 0])  # minutes an eruption lasts, per kind
SLOPE = COVARIANCES[:, 0, 1] / COVARIANCES[:, 0, 0]  # minutes of waiting per minute of eruption
SPREAD = np.sqrt(COVARIANCES[:, 1, 1] - SLOPE * COVARIANCES[:, 0, 1])


def two_kinds(eruptions: int | None = None) -> bmc.BayesNet:
    """Kind, duration, and waiting time to the next eruption, for a plate of eruptions."""
    net = bmc.BayesNet("Old Faithful", plates={"eruption": eruptions})

    @net.node(plates="eruption", states=KINDS)
    def kind():
        return bmc.Categorical(WEIGHTS)

    # TABLE[k] is a plain NumPy gather: `kind` arrives as an array of positions
    @net.node(plates="eruption")
    def duration(kind):
        return bmc.Normal(MEAN[kind], SD[kind])

    @net.node(plates="eruption")
    def waiting(kind, duration):
        expected = MEANS[kind, 1] + SLOPE[kind] * (duration - MEAN[kind])
        return bmc.Normal(expected, SPREAD[kind])

    return net


def kind_and_duration_given(waiting: float) -> tuple[float, float]:
    """Closed form: probability of a long eruption, and mean duration, given the waiting time."""
    sd = np.sqrt(COVARIANCES[:, 1, 1])
    joint = WEIGHTS / sd * np.exp(-0.5 * ((waiting - MEANS[:, 1]) / sd) ** 2)
    posterior = joint / joint.sum()
    mean = MEAN + COVARIANCES[:, 0, 1] / sd**2 * (waiting - MEANS[:, 1])
    return float(posterior[1]), float(posterior @ mean)


# What a visitor may think before the first eruption, and the noise around the typical wait.
PRIOR_MEAN, PRIOR_SD, NOISE = 70.0, 15.0, 6.0
FIRST_LONG_WAITS = WAITS[DURATIONS > 3.0][:8]


def typical_wait() -> bmc.BayesNet:
    """An unknown mean waiting time after long eruptions, and the waits themselves."""
    net = bmc.BayesNet("typical wait", plates={"eruption": len(FIRST_LONG_WAITS)})
    net.add("typical", bmc.Normal(PRIOR_MEAN, PRIOR_SD))

    @net.node(plates="eruption")
    def wait(typical):
        return bmc.Normal(typical, NOISE)

    return net


def typical_given(waits: np.ndarray) -> tuple[float, float, float]:
    """Closed form: posterior mean and standard deviation of the typical wait; log P(waits)."""
    n = len(waits)
    precision = 1 / PRIOR_SD**2 + n / NOISE**2
    mean = (PRIOR_MEAN / PRIOR_SD**2 + waits.sum() / NOISE**2) / precision
    # the evidence as prior x likelihood / posterior, all at the posterior mean
    log_evidence = (
        -0.5 * ((mean - PRIOR_MEAN) / PRIOR_SD) ** 2
        - math.log(PRIOR_SD)
        - 0.5 * float((((waits - mean) / NOISE) ** 2).sum())
        - n * math.log(NOISE * math.sqrt(2 * math.pi))
        - 0.5 * math.log(precision)
    )
    return float(mean), float(precision**-0.5), float(log_evidence)
