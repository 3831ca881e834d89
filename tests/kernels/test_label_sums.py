"""Sums of statistics by label: against loops over the elements, and against the model's densities."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc.starts import start_states
from bayesmc.expression import evaluate
from bayesmc.kernels.conjugate import conjugate_kernel
from bayesmc.kernels.label_sums import LabelSums, label_sums, sums_by_label
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Target, Values, target_of

N = 40
RNG = np.random.default_rng(4)
TABLE = RNG.normal(size=(N, 5))


def _mixture(child: Any, data: Any, plates: Any = "i", chains: int = 2) -> tuple[Target, Values]:
    net = bmc.BayesNet(plates={"kind": 3, "i": N, "item": 5})
    net.add("level", bmc.Normal(0.0, 2.0), plates=("kind", "item") if plates != "i" else "kind")
    net.add("spread", bmc.Gamma(4.0, 2.0), plates="kind")
    net.add("label", bmc.Categorical([0.2, 0.3, 0.5]), plates="i")
    net.add("x", child, parents=["label", "level", "spread"], plates=plates)
    target = target_of(pose(net, {"x": data}))
    with marking_invalid(), np.errstate(all="ignore"):
        return target, start_states(target, chains, np.random.default_rng(0))


def _normal(label: Any, level: Any, spread: Any) -> Any:
    return bmc.Normal(level[label], spread[label])


def _sums(target: Target) -> LabelSums:
    found = label_sums(target, target.terms["x"], "label")
    assert found is not None
    assert label_sums(target, target.terms["x"], "label") is found
    return found


def _assert_are_log_densities(target: Target, values: Values) -> None:
    """Log densities of the elements, one by one in a loop, summed by label, between two states."""
    sums = _sums(target)
    term = target.terms["x"]
    other = {**values, "level": values["level"] + 0.5, "spread": values["spread"] * 1.5}
    found, expected = [], []
    for state in (values, other):
        (log,) = evaluate([sums.expression], sums.placed(state))
        found.append(log)
        full = np.broadcast_to(term.log(state), (2, *term.shape))
        full = full.reshape(2, N, -1) if term.plates[0] == "i" else full.swapaxes(1, 2)
        by_label = np.zeros((2, 3, full.shape[-1]))
        for chain in range(2):
            for i in range(N):
                by_label[chain, state["label"][chain, i]] += full[chain, i]
        expected.append(by_label)
    np.testing.assert_allclose(found[1] - found[0], expected[1] - expected[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seen", ["all", "some"])
@pytest.mark.parametrize("plates", ["i", ("i", "item"), ("item", "i")])
def test_sums_are_those_of_a_loop(plates: Any, seen: str) -> None:
    data = TABLE[:, 0] if plates == "i" else TABLE if plates[0] == "i" else TABLE.T
    if seen == "some":
        data = np.where(RNG.random(data.shape) < 0.6, data, np.nan)
    target, values = _mixture(_normal, data, plates)
    _assert_are_log_densities(target, values)
    sums = _sums(target)
    assert sums.repeats == (1 if plates == "i" else 5)
    counts = sums.sums(values)[..., : sums.ones].sum(axis=(1, 2))
    whole = sums.repeats if sums.ones > 1 or sums.repeats == 1 else 1
    assert (counts == (np.isfinite(data).sum() if whole > 1 or plates == "i" else N)).all()


def test_an_empty_label_adds_nothing() -> None:
    target, values = _mixture(_normal, TABLE[:, 0])
    values["label"] = np.zeros((2, N), dtype=values["label"].dtype)
    sums = _sums(target).sums(values)
    assert (sums[:, 1:] == 0).all() and (sums[:, 0, 0] == N).all()
    kernel = conjugate_kernel(Blanket(target, "level"))
    with marking_invalid(), np.errstate(all="ignore"):
        posterior = kernel.full_conditional(values)
    np.testing.assert_allclose(posterior.loc[:, 1:], 0.0, atol=1e-12)
    np.testing.assert_allclose(posterior.scale[:, 1:], 2.0)


def test_a_huge_offset_loses_no_digits() -> None:
    """Data of size 1e8, components of size 1: the posterior of a spread as near zero, to 1e-7."""
    data = np.round(TABLE[:, 0] * 64) / 64
    found = []
    for offset in (0.0, 1e8):
        net = bmc.BayesNet(plates={"kind": 3, "i": N})
        net.add("level", bmc.Normal(offset, 2.0), plates="kind")
        net.add("spread", bmc.InverseGamma(3.0, 1.0), plates="kind")
        net.add("label", bmc.Categorical([0.2, 0.3, 0.5]), plates="i")
        net.add(
            "x",
            lambda label, level, spread: bmc.Normal(level[label], np.sqrt(spread[label])),
            plates="i",
        )
        target = target_of(pose(net, {"x": data + offset}))
        values = {
            **target.known,
            "level": np.array([[0.25, -1.0, 0.5]]) + offset,
            "spread": np.ones((1, 3)),
            "label": np.arange(N)[None] % 3,
        }
        kernel = conjugate_kernel(Blanket(target, "spread"))
        found.append(kernel.full_conditional(values).scale)
        group = [data[k::3] - level for k, level in enumerate((0.25, -1.0, 0.5))]
        expected = [1.0 + 0.5 * (g**2).sum() for g in group]
        np.testing.assert_allclose(found[-1][0], expected, rtol=1e-7)


@pytest.mark.parametrize(
    "child",
    [
        lambda label, level, spread: bmc.StudentT(4.0, level[label], 1.0),
        lambda label, level, spread: bmc.Normal(level[label] + TABLE[:, 0], 1.0),
        lambda label, level, spread: bmc.Normal(level[label], TABLE[: np.shape(label)[-1], 0] ** 2),
    ],
)
def test_what_a_label_does_not_tell_is_refused(child: Any) -> None:
    """No exponential family; arrays of a function's own, and one that peeks at its plate."""
    target, _ = _mixture(child, TABLE[:, 0])
    assert label_sums(target, target.terms["x"], "label") is None


def test_trials_of_each_element_by_label() -> None:
    """An array of the function's own where the family's other parameter is read by label (BUGS, hearts)."""
    trials = np.arange(3, 3 + N)
    net = bmc.BayesNet(plates={"i": N})
    net.add("p", bmc.Beta(1.0, 1.0))
    net.add("label", bmc.Bernoulli(0.4), plates="i")
    net.add(
        "x",
        lambda label, p: bmc.Binomial(trials, np.where(label == 1, 0.05, p)),
        plates="i",
    )
    target = target_of(pose(net, {"x": np.ones(N, int)}))
    assert label_sums(target, target.terms["x"], "label") is None
    posterior = bmc.infer(net, {"x": np.ones(N, int)}, engine=bmc.Gibbs(300, 50, 4), rng=0)
    assert 0.0 < posterior.mean("p") < 0.5


@pytest.mark.parametrize("states", [2, 3, 40])
def test_scattered_and_chunked_sums(states: int) -> None:
    label = RNG.integers(states, size=(3, 5000)).astype(np.uint8)
    statistics = RNG.normal(size=(4, 5000))
    found = sums_by_label(label, statistics, states)
    for chain, k in ((0, 0), (2, states - 1)):
        expected = statistics[:, label[chain] == k].sum(axis=1)
        np.testing.assert_allclose(found[chain, k], expected, rtol=1e-11, atol=1e-11)
