"""How heavy are the leaves of a mesquite bush? Six regressions, compared by what they predict.

46 bushes were measured (two diameters of the canopy, its height, the bush's height, its stems) in two groups,
cut, and their leaves weighed. One model is linear in the measures, five are linear in logarithms:

    weight ~ N(X beta, sigma),    log weight ~ N(log X beta, sigma);    flat priors

``bmc.compare`` ranks the five by leave-one-out (PSIS-LOO) and by WAIC. The full model and one in logs of the
canopy's volume, area and shape say the same, as their columns span the same space; without stems nothing is
lost that can be told; volume alone predicts worse. Whether logs are better at all is asked of weights, not of
their logs: log densities of log weight become densities of weight by a change of variables
(``log_jacobian=-log(weight)``). Without it they are on other scales, and ``compare`` refuses.

With flat priors a bush that is left out has a Student t density, so that all of it can be held against exact
figures. PSIS is near for logs, and far off for weights, of which three bushes decide too much; their Pareto k
says so.

Gelman and Hill (2007), Data Analysis Using Regression and Multilevel/Hierarchical Models, sec. 4.6, has the
data; Gelman, Hill and Vehtari (2020), Regression and Other Stories, sec. 12.6, the figures of ``BOOK``, which
are with weak priors. The models are those of posteriordb (Magnusson, Burkner and Vehtari 2023, version 0.5);
means and leave-one-out of its reference draws stand in ``REFERENCE``.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t as student

import bayesmc as bmc
from bayesmc.errors import LowEssWarning
from examples import picture

#: diameters, heights of canopy and bush in metres, stems, group, weight in grams
BUSHES = np.array(
    """
1.8 1.15 1 1.3 1 0 401.3         1.7 1.35 1.33 1.35 1 0 513.7     2.8 2.55 .6 2.16 1 0 1179.2
1.3 .85 1.2 1.8 1 0 308          3.3 1.9 1.05 1.55 1 0 855.2      1.4 1.4 1 1.2 1 0 268.7
1.5 .5 .9 1 1 0 155.5            3.9 2.3 1.3 1.7 2 0 1253.2       1.8 1.35 .6 .8 1 0 328
2.1 1.6 .8 1.2 1 0 614.6         .8 .63 .6 .9 1 0 60.2            1.3 .95 .95 1.35 1 0 269.6
1.2 .9 1.2 1.4 1 0 448.4         1.5 .7 .7 1 1 0 120.4            2.8 1.7 1.2 1.7 1 0 378.7
1.4 .85 1.1 1.5 1 0 266.4        1.5 .6 .64 .65 1 0 138.9         2.4 2.4 1.2 1.5 1 0 1020.8
1.9 1.55 1.2 1.7 1 0 635.7       2.3 1.6 1.3 1.7 1 0 621.8        2.1 1.7 1 1.5 1 0 579.8
2.4 1.3 .9 1.5 2 0 326.8         1 .4 1 1.2 1 0 66.7              1.3 .6 .5 .7 1 0 68
1.1 .7 .9 1.2 1 0 153.1          1.3 1.2 .6 .8 1 0 256.4          2.5 2.3 1.4 1.7 5 1 723
5.2 4 2.5 3 9 1 4052             2 1.6 1.4 1.7 1 1 345            1.6 1.6 1.3 1.6 1 1 330.9
1.4 1 1.1 1.5 1 1 163.5          3.2 1.9 1.5 1.9 3 1 1160         1.9 1.8 .8 1.1 1 1 386.6
2.4 2.4 1.1 1.6 3 1 693.5        2.5 1.8 1.3 2 7 1 674.4          2.1 1.5 .85 1.25 1 1 217.5
2.4 2.2 1.5 2 2 1 771.3          2.4 1.7 1.2 1.3 2 1 341.7        1.9 1.2 1.15 1.45 2 1 125.7
2.7 2.5 1.5 2.2 3 1 462.5        1.3 1.1 .7 .7 1 1 64.5           2.9 2.7 1.9 1.9 1 1 850.6
2.1 1 1.5 1.8 2 1 226            4.1 3.8 1.5 2 2 1 1745.1         2.8 2.5 1.5 2.2 1 1 908
1.27 1 .62 .92 1 1 213.5
""".split(),
    dtype=float,
).reshape(-1, 7)
LONG, SHORT, CANOPY, HEIGHT, STEMS, GROUP, WEIGHT = BUSHES.T


def columns() -> dict[str, np.ndarray]:
    """The columns of each regression, shape (bushes, numbers); those of weights come last."""
    one, area, shape = np.ones(len(BUSHES)), np.log(LONG * SHORT), np.log(LONG / SHORT)
    volume, height, stems = area + np.log(CANOPY), np.log(HEIGHT), np.log(STEMS)
    named = {
        "full": [one, np.log(LONG), np.log(SHORT), np.log(CANOPY), height, stems, GROUP],
        "volume, area": [one, volume, area, GROUP],
        "volume, area, shape": [one, volume, area, shape, height, stems, GROUP],
        "without stems": [one, volume, area, shape, height, GROUP],
        "volume": [one, volume],
        "weights": [one, LONG, SHORT, CANOPY, HEIGHT, STEMS, GROUP],
    }
    return {name: np.stack(each, axis=1) for name, each in named.items()}


LOGS = ("full", "volume, area", "volume, area, shape", "without stems", "volume")


class Reference(NamedTuple):
    """What posteriordb's reference draws say: 10 chains of 1000.

    Attributes
    ----------
    model : str
        Its name there.
    beta : tuple of float
        Means.
    sigma : float
    elpd : float
        PSIS-LOO.
    """

    model: str
    beta: tuple[float, ...]
    sigma: float
    elpd: float


REFERENCE = {
    "full": Reference(
        "logmesquite", (5.3504, 0.3986, 1.1492, 0.3772, 0.3900, 0.1093, -0.5847), 0.3407, -19.38
    ),
    "volume, area": Reference(
        "logmesquite_logva", (5.2241, 0.6122, 0.2924, -0.5273), 0.3479, -19.03
    ),
    "volume, area, shape": Reference(
        "logmesquite_logvas",
        (5.3515, 0.3759, 0.3974, -0.3749, 0.3894, 0.1100, -0.5847),
        0.3408,
        -19.37,
    ),
    "without stems": Reference(
        "logmesquite_logvash", (5.3099, 0.3872, 0.4096, -0.3175, 0.4235, -0.5386), 0.3394, -18.85
    ),
    "volume": Reference("logmesquite_logvolume", (5.1708, 0.7220), 0.4267, -26.73),
    "weights": Reference(
        "mesquite", (-727.04, 187.04, 373.70, 355.61, -101.69, 132.06, -365.33), 277.76, -335.61
    ),
}
#: elpd of leave-one-out (of weights by inferring anew), the difference that volume makes, and the full model
#: on the scale of weights
BOOK = {"full": -19.3, "volume, area, shape": -19.4, "volume": -26.6, "weights": -351.2}
BOOK_DIFFERENCE, BOOK_ERROR, BOOK_OF_WEIGHTS = 7.3, 5.0, -292.0


def regression(name: str) -> bmc.BayesNet:
    """The net of one model; priors are so wide that they count for flat."""
    x = columns()[name]
    wide = 1e6 if name == "weights" else 1e3
    net = bmc.BayesNet(name, plates={"bush": len(x)})
    net.add("beta", bmc.MvNormal(np.zeros(x.shape[1]), scale_diag=np.full(x.shape[1], wide)))
    net.add("sigma", bmc.Uniform(0.0, wide))

    @net.node(plates="bush")
    def weight(beta, sigma):
        return bmc.Normal(np.vecdot(x, beta), sigma)

    return net


def observed(name: str) -> np.ndarray:
    """What a model observes: weights, or their logs."""
    return WEIGHT if name == "weights" else np.log(WEIGHT)


def fitted(draws: int, names: Sequence[str] = (*LOGS, "weights")) -> dict[str, Any]:
    """Posteriors by name."""
    engine = bmc.Gibbs(draws=draws, warmup=200)
    return {
        name: bmc.infer(regression(name), {"weight": observed(name)}, engine=engine, rng=k)
        for k, name in enumerate(names)
    }


def exact_elpd(name: str) -> np.ndarray:
    """Log densities of every bush given all others, without draws: Student t densities, shape (bushes,).

    With flat priors on coefficients and sigma, n - 1 bushes and k columns, n - k - 2 degrees of freedom; one
    more where log sigma has the flat prior (Gelman et al. 2013, Bayesian Data Analysis, sec. 14.2).
    """
    x, y = columns()[name], observed(name)
    found = np.empty(len(y))
    for i in range(len(y)):
        rest, seen = np.delete(x, i, axis=0), np.delete(y, i)
        beta, *_ = np.linalg.lstsq(rest, seen)
        squares, free = ((seen - rest @ beta) ** 2).sum(), len(seen) - x.shape[1] - 1
        more = 1 + x[i] @ np.linalg.solve(rest.T @ rest, x[i])
        found[i] = student.logpdf(y[i], free, x[i] @ beta, np.sqrt(squares / free * more))
    return found


def assessed(posteriors: Mapping[str, Any], criterion: str = "loo") -> dict[str, Any]:
    """Each on the scale that it observes; what its warnings say, ``Elpd`` keeps."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)
        return {name: getattr(each, criterion)() for name, each in posteriors.items()}


def of_weights(posteriors: Mapping[str, Any]) -> Any:
    """Logs against weights, both as densities of weight."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LowEssWarning)
        return bmc.compare(
            {
                "full": posteriors["full"].loo(log_jacobian=-np.log(WEIGHT)),
                "weights": posteriors["weights"].loo(),
            }
        )


def draw(found: Mapping[str, Any]) -> Any:
    """Differences to the best of the five; of weights, PSIS beside exact figures, bush by bush."""
    figure, panels = picture.axes([["logs", "bushes"]], (10, 4))
    ax, table = panels["logs"], bmc.compare({n: found[n] for n in LOGS})
    rank = {name: k for k, name in enumerate(table.names)}
    ax.errorbar(
        -table["elpd_diff"], list(rank.values()), xerr=table["dse"], fmt="o", color=picture.EXACT,
        label="draws (difference, its error)",
    )  # fmt: skip
    best = exact_elpd(table.names[0]).sum()
    ax.plot(
        [exact_elpd(n).sum() - best for n in rank], list(rank.values()), "x", zorder=3,
        color=picture.OTHER, label="exact",
    )  # fmt: skip
    ax.axvline(0.0, color=picture.FAINT, lw=1, zorder=0)
    ax.set_yticks(list(rank.values()), list(rank))
    ax.invert_yaxis()
    ax.set(xlabel="elpd less that of the best", title="five models of log weight")
    ax.legend(fontsize=8)
    ax, psis = panels["bushes"], found["weights"]
    bad = psis.pareto_k > psis.good_k
    exact = exact_elpd("weights")
    for which, colour, label in (
        (~bad, picture.EXACT, "Pareto k good"),
        (bad, picture.OTHER, "bad"),
    ):
        ax.plot(exact[which], psis.pointwise[which], "o", color=colour, ms=5, label=label)
    span = [min(exact.min(), psis.pointwise.min()) - 1, max(exact.max(), psis.pointwise.max()) + 1]
    ax.plot(span, span, color=picture.FAINT, lw=1, zorder=0)
    ax.set(
        xlabel="exact log density of a bush left out",
        ylabel="by PSIS",
        title="the model of weights",
    )
    ax.legend(fontsize=8)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Print all comparisons, and draw."""
    options = picture.options(__doc__, arguments)
    posteriors = fitted(200 if options.fast else 5000)
    found = assessed(posteriors)
    print("Mesquite: 46 bushes, leave-one-out of six regressions")
    print(f"  {'':20}{'PSIS':>8}{'exact':>8}{'reference':>11}{'book':>8}{'worst k':>9}")
    for name, each in found.items():
        book = f"{BOOK[name]:8.1f}" if name in BOOK else f"{'':8}"
        print(
            f"  {name:20}{each.elpd:8.2f}{exact_elpd(name).sum():8.2f}{REFERENCE[name].elpd:11.2f}{book}"
            f"{each.pareto_k.max():9.2f}"
        )
    print(bmc.compare({n: found[n] for n in LOGS}))
    print(bmc.compare({n: each for n, each in assessed(posteriors, "waic").items() if n in LOGS}))
    print(
        "on the scale of weights (the book: the full model in logs has", BOOK_OF_WEIGHTS, "there)"
    )
    print(of_weights(posteriors))
    picture.save(draw(found), options.out, "mesquite")


if __name__ == "__main__":
    main()
