"""``ExpectationPropagation`` of probit regression beside the same by hand in NumPy, two ways."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

import bayesmc as bmc
from benchmarks.floors import probit
from benchmarks.harness import interleave, table

ROWS, COLUMNS = 1_000, 10
GOAL = 2.0


def data(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A design and labels."""
    rng = np.random.default_rng(seed)
    design = rng.normal(size=(ROWS, COLUMNS))
    return design, (design @ rng.normal(size=COLUMNS) + rng.normal(size=ROWS) > 0).astype(int)


def net(design: np.ndarray) -> bmc.BayesNet:
    """Probit regression with standard normal weights."""
    found = bmc.BayesNet("probit", plates={"row": len(design)})
    found.add("w", bmc.MvNormal(np.zeros(design.shape[1]), np.eye(design.shape[1])))
    found.add("y", lambda w: bmc.Bernoulli(special.ndtr(np.vecdot(design, w))), plates="row")
    return found


def main() -> None:
    """Print medians; every answer has means, covariance and log evidence, to the same tolerance."""
    design, y = data()
    ours = net(design)
    ours.validate()

    def asked() -> Any:
        return bmc.infer(ours, {"y": y}, engine=bmc.ExpectationPropagation())

    found = asked()
    for floor in (probit.one_by_one(design, y), probit.in_parallel(design, y)):
        np.testing.assert_allclose(found.mean("w"), floor.mean, atol=1e-4)
        np.testing.assert_allclose(found.cov("w"), floor.cov, atol=1e-5)
        np.testing.assert_allclose(found.log_marginal_likelihood, floor.log_evidence, atol=1e-3)
    times = interleave(
        {
            "by hand, row by row": lambda: probit.one_by_one(design, y),
            "by hand, all rows at once, damped": lambda: probit.in_parallel(design, y, damping=0.2),
            "by hand, all rows at once": lambda: probit.in_parallel(design, y),
            "bayesmc": asked,
        },
        7,
        budget=4.0,
    )
    one, damped, whole = (times[name].median for name in list(times)[:3])
    lines: list[list[object]] = [
        [name, 1e3 * t.median, t.median / one, t.median / damped, t.median / whole]
        for name, t in times.items()
    ]
    lines.append(["goal", "", GOAL, GOAL, GOAL])
    title = f"EP, probit regression, {ROWS} rows, {COLUMNS} weights, {found.sweeps} sweeps"
    heads = ["", "ms", "over row by row", "over damped", "over all at once"]
    print(table(title, heads, lines))


if __name__ == "__main__":
    main()
