"""Old Faithful's two kinds of eruption: hybrid nets on the 272 eruptions of ``data_faithful``.

``two_kinds`` has the parameters of the maximum-likelihood fit of a two-component Gaussian mixture
to these data, log-likelihood -1130.264; the net writes each component's Gaussian over (duration,
waiting) as the density of the duration times that of the waiting time given the duration.
``typical_wait`` learns a mean. Closed forms stand beside the engines, in plain NumPy.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

import bayesmc as bmc
from bayesmc import plotting
from examples import compare, picture
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


def questions(draws: int) -> Iterator[compare.Table]:
    """Every question with the answers of every engine that takes it."""
    yield which_kind(draws)
    yield how_long(draws)
    yield which_kinds_all(draws // 50)
    yield learn_typical_wait(draws)


def which_kind(draws: int) -> compare.Table:
    """One eruption of Old Faithful: the kind is hidden, both times are measured."""
    net = two_kinds(1)
    evidence = {"duration": [2.9], "waiting": [66.0]}

    def ask(posterior: Any) -> list[tuple[float, float]]:
        return [(posterior.probabilities("kind")[0, 1], posterior.mcse("kind")[0, 1])]

    rows = (
        compare.infer(net, evidence, bmc.Exact(), ask),
        compare.infer(net, evidence, bmc.LikelihoodWeighting(draws), ask),
    )
    return compare.Table(
        "Old Faithful: it lasted 2.9 min, the next came 66 min later", ("long",), rows
    )


def how_long(draws: int) -> compare.Table:
    """The same when nobody timed it: the duration is hidden, too, and is integrated out."""
    net = two_kinds(1)
    evidence = {"waiting": [66.0]}

    def ask(posterior: Any) -> list[tuple[float, float]]:
        return [
            (posterior.probabilities("kind")[0, 1], posterior.mcse("kind")[0, 1]),
            (posterior.mean("duration")[0], posterior.mcse("duration")[0]),
        ]

    counted = compare.count(
        net,
        draws,
        # waiting times are recorded to the minute
        lambda values: np.abs(values["waiting"][:, 0] - 66.0) < 0.5,
        lambda kept: [kept["kind"][:, 0] == "long", kept["duration"][:, 0]],
    )
    rows = (
        compare.Row("closed form", kind_and_duration_given(66.0), compare.EXACT),
        compare.infer(net, evidence, bmc.Exact(), ask),
        compare.infer(net, evidence, bmc.LikelihoodWeighting(draws), ask),
        counted,
    )
    question = "Old Faithful: nobody timed it, the next came 66 min later"
    return compare.Table(question, ("long", "mean minutes"), rows)


def which_kinds_all(draws: int) -> compare.Table:
    """All 272 eruptions at once: easy for elimination, hopeless for importance weights."""
    net = two_kinds()
    evidence = {"duration": DURATIONS, "waiting": WAITS}

    def ask(posterior: Any) -> list[tuple[float, float]]:
        return [(posterior.log_marginal_likelihood, posterior.log_marginal_likelihood_mcse)]

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rows = (
            compare.Row("published fit", (LOG_LIKELIHOOD,), compare.EXACT),
            compare.infer(net, evidence, bmc.Exact(), ask),
            compare.infer(net, evidence, bmc.LikelihoodWeighting(draws), ask),
        )
    warned = tuple(dict.fromkeys(str(warning.message) for warning in caught))
    return compare.Table("Old Faithful: all 272 eruptions at once", ("log P(times)",), rows, warned)


def learn_typical_wait(draws: int) -> compare.Table:
    """An unknown mean, learnt from the first eight waits after long eruptions."""
    net = typical_wait()
    evidence = {"wait": FIRST_LONG_WAITS}

    def ask(posterior: Any) -> list[tuple[float, float]]:
        return [
            (posterior.mean("typical"), posterior.mcse("typical")),
            (posterior.log_marginal_likelihood, posterior.log_marginal_likelihood_mcse),
        ]

    mean, _, log_p = typical_given(FIRST_LONG_WAITS)
    rows = (
        compare.Row("closed form", (mean, log_p), compare.EXACT),
        compare.infer(net, evidence, bmc.Exact(), ask),
        compare.infer(net, evidence, bmc.LikelihoodWeighting(draws), ask),
    )
    question = "Old Faithful: the typical wait after a long eruption, from eight of them"
    return compare.Table(question, ("mean minutes", "log P(waits)"), rows)


def draw() -> dict[str, Any]:
    """The graph with its plate, and the typical wait before and after eight waits."""
    figure, panels = picture.axes([["typical"]], (5.2, 3.4))
    ax, minutes = panels["typical"], np.linspace(20.0, 120.0, 501)
    for evidence, label, color in (
        ({}, "prior", picture.FAINT),
        ({"wait": FIRST_LONG_WAITS}, "posterior", picture.EXACT),
    ):
        posterior = bmc.infer(typical_wait(), evidence, engine=bmc.Exact())
        density = posterior.marginal("typical").density(minutes)
        ax.plot(minutes, density, color=color, label=label)
        ax.fill_between(minutes, density, color=color, alpha=0.25, lw=0)
    ax.plot(FIRST_LONG_WAITS, 0 * FIRST_LONG_WAITS, "|", ms=12, color=picture.OTHER, label="waits")
    ax.set(
        xlabel="typical wait after a long eruption, minutes", ylabel="density, per minute", ylim=0
    )
    ax.legend(frameon=False, loc="upper left")
    observed = ["duration", "waiting"]
    return {
        "old_faithful": plotting.plot_dag(two_kinds(len(ERUPTIONS)), observed=observed).figure,
        "old_faithful_marginals": figure,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table for each question, and draw a net and what it learnt."""
    options = picture.options(__doc__, arguments)
    for table in questions(20_000 if options.fast else 1_000_000):
        compare.print_table(table)
    for name, figure in draw().items():
        picture.save(figure, options.out, name)


if __name__ == "__main__":
    main()
