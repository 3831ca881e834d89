"""Labels of mixtures: log densities against the model's, and draws against those of all states tried."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.distributions.base import marking_invalid
from bayesmc.engines.mcmc.starts import start_states
from bayesmc.errors import DensityError, ZeroProbabilityError
from bayesmc.expression import as_expression
from bayesmc.kernels.conjugate import Conjugate, conjugate_kernel
from bayesmc.kernels.enumerate import Enumerate
from bayesmc.kernels.label_sums import sums_by_label
from bayesmc.kernels.labels import Labels, label_kernel
from bayesmc.kernels.vector_draws import DirichletDraw
from bayesmc.network import pose
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.target import Values, target_of

N = 60
RNG = np.random.default_rng(5)
Z = RNG.normal(size=N) * 2.0 + 3.0
POSITIVE = RNG.gamma(2.0, size=N)
COUNTS = RNG.poisson(3.0, size=N)
BITS = RNG.integers(2, size=N)
WORDS = RNG.integers(4, size=N)
TABLE = RNG.normal(size=(N, 5))
SEEN = RNG.random(N) < 0.7


def mixture(
    likelihood: Callable[..., Any],
    states: int = 3,
    plates: Any = "i",
    sizes: dict[str, int] | None = None,
    **parameters: tuple[Any, Any],
) -> bmc.BayesNet:
    """A net of labels with Dirichlet weights; parameters are priors and their plates by name."""
    net = bmc.BayesNet(plates=sizes or {"kind": states, "i": N})
    net.add("weights", bmc.Dirichlet(np.full(states, 2.0)))
    net.add("label", lambda weights: bmc.Categorical(weights), plates="i")
    for name, (prior, where) in parameters.items():
        net.add(name, prior, plates=where)
    net.add("x", likelihood, plates=plates)
    return net


LEVEL = (bmc.Normal(2.0, 2.0), "kind")
SPREAD = (bmc.Gamma(4.0, 2.0), "kind")


def gaussian(states: int, d: int, n: int = N) -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = mixture(
        lambda label, mean, cov: bmc.MvNormal(mean[label], cov[label]),
        states,
        sizes={"kind": states, "i": n},
        mean=(bmc.MvNormal(np.zeros(d), 9.0 * np.eye(d)), "kind"),
        cov=(bmc.InverseWishart(d + 3.0, 2.0 * np.eye(d)), "kind"),
    )
    data = np.random.default_rng(n).normal(size=(n, d)) * 2.0 + np.arange(d)
    return net, {"x": data}


def two_plates() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet(plates={"kind": 3, "i": 12, "j": 7})
    net.add("weights", bmc.Dirichlet(np.full(3, 2.0)))
    net.add("label", lambda weights: bmc.Categorical(weights), plates=("i", "j"))
    net.add("level", bmc.Normal(0.0, 2.0), plates="kind")
    net.add("x", lambda label, level: bmc.Normal(level[label], 0.8), plates=("j", "i"))
    return net, {"x": RNG.normal(size=(7, 12))}


def by_item() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """One label for several items of its own child: latent classes of numbers."""
    net = mixture(
        lambda label, level, spread: bmc.Normal(level[label], spread[label]),
        plates=("i", "item"),
        sizes={"kind": 3, "i": N, "item": 5},
        level=(bmc.Normal(0.0, 2.0), ("kind", "item")),
        spread=(bmc.Gamma(4.0, 2.0), "kind"),
    )
    return net, {"x": TABLE}


def items_partly_seen() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net, _ = by_item()
    return net, {"x": np.where(RNG.random(TABLE.shape) < 0.6, TABLE, np.nan)}


def latent_classes() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = mixture(
        lambda label, share: bmc.Bernoulli(share[label]),
        plates=("i", "item"),
        sizes={"kind": 3, "i": N, "item": 5},
        share=(bmc.Beta(1.0, 1.0), ("kind", "item")),
    )
    return net, {"x": (TABLE > 0.3).astype(int)}


def several_children() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = mixture(lambda label, level: bmc.Normal(level[label], 1.3), level=LEVEL)
    net.add("rate", bmc.Gamma(2.0, 1.0), plates="kind")
    net.add("count", lambda label, rate: bmc.Poisson(rate[label]), plates="i")
    net.add("words", bmc.Dirichlet(np.ones(4)), plates="kind")
    net.add("word", lambda label, words: bmc.Categorical(words[label]), plates="i")
    return net, {"x": np.where(SEEN, Z, np.nan), "count": COUNTS, "word": WORDS}


def labels_partly_seen() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net, evidence = gaussian(3, 2)
    known = np.where(SEEN, np.nan, np.arange(N) % 3)
    return net, {**evidence, "label": known}


def own_priors() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """Elements have weights by group; a group lacks one of the kinds."""
    net = bmc.BayesNet(plates={"kind": 3, "group": 2, "i": N})
    table = np.array([[0.5, 0.5, 0.0], [0.2, 0.3, 0.5]])
    group = np.arange(N) % 2
    net.add("level", bmc.Normal(0.0, 2.0), plates="kind")
    net.add("label", lambda: bmc.Categorical(table[group]), plates="i")
    net.add("x", lambda label, level: bmc.Normal(level[label], 1.0), plates="i")
    return net, {"x": Z}


def hidden_priors() -> tuple[bmc.BayesNet, dict[str, Any]]:
    net = bmc.BayesNet(plates={"kind": 3, "group": 2, "i": N})
    group = np.arange(N) % 2
    net.add("shares", bmc.Dirichlet(np.ones(3)), plates="group")
    net.add("level", bmc.Normal(0.0, 2.0), plates="kind")
    net.add("label", lambda shares: bmc.Categorical(shares[group]), plates="i")
    net.add("x", lambda label, level: bmc.Normal(level[label], 1.0), plates="i")
    return net, {"x": Z}


def impossible_words() -> tuple[bmc.BayesNet, dict[str, Any]]:
    """A constant table with zeros, beside a child that keeps it from being a table alone."""
    rows = np.array([[0.5, 0.5, 0.0, 0.0], [0.1, 0.3, 0.3, 0.3], [0.0, 0.0, 0.5, 0.5]])
    net = mixture(lambda label, level: bmc.Normal(level[label], 1.3), level=LEVEL)
    net.add("word", lambda label: bmc.Categorical(rows[label]), plates="i")
    return net, {"x": Z, "word": WORDS}


SCALARS: dict[str, tuple[Callable[..., Any], np.ndarray, dict[str, tuple[Any, Any]]]] = {
    "normal": (lambda label, level: bmc.Normal(level[label], 1.5), Z, {"level": LEVEL}),
    "normal scales": (
        lambda label, level, spread: bmc.Normal(2 * level[label] + 1, spread[label] ** -0.5),
        Z,
        {"level": LEVEL, "spread": SPREAD},
    ),
    "one mean": (
        lambda label, level, spread: bmc.Normal(level, spread[label]),
        Z,
        {"level": (bmc.Normal(2.0, 1.0), ()), "spread": SPREAD},
    ),
    "lognormal": (
        lambda label, level, spread: bmc.LogNormal(level[label], spread[label]),
        POSITIVE,
        {"level": LEVEL, "spread": SPREAD},
    ),
    "poisson": (lambda label, spread: bmc.Poisson(spread[label]), COUNTS, {"spread": SPREAD}),
    "exponential": (
        lambda label, spread: bmc.Exponential(spread[label]),
        POSITIVE,
        {"spread": SPREAD},
    ),
    "gamma": (
        lambda label, spread: bmc.Gamma(spread[label], 2 * spread[label]),
        POSITIVE,
        {"spread": SPREAD},
    ),
    "bernoulli": (
        lambda label, share: bmc.Bernoulli(share[label]),
        BITS,
        {"share": (bmc.Beta(1.0, 1.0), "kind")},
    ),
    "categorical": (
        lambda label, words: bmc.Categorical(words[label]),
        WORDS,
        {"words": (bmc.Dirichlet(np.ones(4)), "kind")},
    ),
    "negative binomial": (
        lambda label, spread: bmc.NegativeBinomial(spread[label], 0.4),
        COUNTS,
        {"spread": SPREAD},
    ),
    "binomial": (
        lambda label, share: bmc.Binomial(20, share[label]),
        COUNTS,
        {"share": (bmc.Beta(1.0, 1.0), "kind")},
    ),
    "backwards": (
        lambda label, level: bmc.Normal(level[2 - label], 1.5),
        Z,
        {"level": LEVEL},
    ),
}
NETS: dict[str, Callable[[], tuple[bmc.BayesNet, dict[str, Any]]]] = {
    **{
        f"gaussian {k}x{d}": (lambda k=k, d=d: gaussian(k, d)) for k in (2, 3, 7) for d in (1, 2, 4)
    },
    **{
        name: (lambda f=f, z=z, p=p: (mixture(f, **p), {"x": z}))
        for name, (f, z, p) in SCALARS.items()
    },
    **{
        f"{name}, partly seen": (
            lambda f=f, z=z, p=p: (mixture(f, **p), {"x": np.where(SEEN, z, np.nan)})
        )
        for name, (f, z, p) in SCALARS.items()
    },
    "two plates": two_plates,
    "by item": by_item,
    "items partly seen": items_partly_seen,
    "latent classes": latent_classes,
    "several children": several_children,
    "labels partly seen": labels_partly_seen,
    "own priors": own_priors,
    "hidden priors": hidden_priors,
    "impossible words": impossible_words,
    "five thousand": lambda: gaussian(3, 2, 5001),
    "ten thousand numbers": lambda: (
        mixture(
            lambda label, level, spread: bmc.Normal(level[label], spread[label]),
            5,
            sizes={"kind": 5, "i": 10_000},
            level=LEVEL,
            spread=SPREAD,
        ),
        {"x": np.random.default_rng(0).normal(size=10_000)},
    ),
}


def made(name: str, chains: int, seed: int = 0) -> tuple[Labels, Values]:
    """The kernel of a net's labels in debug mode, and a state."""
    net, evidence = NETS[name]()
    target = target_of(pose(net, evidence))
    kernel = label_kernel(Blanket(target, "label"), debug=True)
    assert kernel is not None
    with marking_invalid(), np.errstate(all="ignore"):
        values = start_states(target, chains, np.random.default_rng(seed))
    return kernel, values


def stepped(kernel: Any, values: Values, seed: int = 1) -> np.ndarray:
    with marking_invalid(), np.errstate(all="ignore"):
        new, _ = kernel.step(values, {}, np.random.default_rng(seed), False)
    return new["label"]


@pytest.mark.parametrize("chains", [1, 4])
@pytest.mark.parametrize("name", NETS)
def test_log_densities_and_draws_are_those_of_all_states_tried(name: str, chains: int) -> None:
    """The same uniform numbers give the same labels; debug mode compares log densities to 1e-9."""
    kernel, values = made(name, chains)
    drawn = stepped(kernel, values)
    expected = stepped(Enumerate(kernel.blanket), values)
    assert drawn.shape == expected.shape and drawn.dtype == expected.dtype
    if chains > 1 and len(kernel._chunks(chains)) > 1:
        return  # chunks of several chains take uniform numbers in another order
    np.testing.assert_array_equal(drawn, expected)
    fast = label_kernel(kernel.blanket)
    np.testing.assert_array_equal(stepped(fast, values), expected)


def test_chunks_of_several_chains_follow_the_probabilities() -> None:
    """Counts of 5,001 labels in each of 4 chains within 5 sd of their expectations (60 comparisons:
    false alarms below 1e-4)."""
    kernel, values = made("five thousand", 4)
    assert len(kernel._chunks(4)) > 1
    log = kernel.log_density(values)
    p = np.exp(log - log.max(axis=0))
    p /= p.sum(axis=0)
    drawn = stepped(kernel, values)
    for k in range(3):
        mean, sd = p[k].sum(axis=-1), np.sqrt((p[k] * (1 - p[k])).sum(axis=-1))
        assert (np.abs((drawn == k).sum(axis=-1) - mean) < 5 * sd + 1e-6).all()


def test_a_wrong_coefficient_is_caught() -> None:
    kernel, values = made("gaussian 3x4", 2)
    true = kernel._table

    def wrong(state: Values, chains: int) -> Any:
        found = true(state, chains)
        found.rows[:, :, 1:] *= 1 + 1e-6
        return found

    kernel._table = wrong  # type: ignore[method-assign]
    with pytest.raises(DensityError, match="label"):
        stepped(kernel, values)


def test_far_components_are_drawn_relative_to_the_likeliest() -> None:
    """Log odds of thousands either way: nothing overflows, and nothing is cut."""
    net = mixture(lambda label, level: bmc.Normal(level[label], 1.0), level=LEVEL)
    x = np.tile([-100.0, 0.0, 100.0], 20) + 0.1 * Z
    target = target_of(pose(net, {"x": x}))
    kernel = label_kernel(Blanket(target, "label"), debug=True)
    values = {
        **target.known,
        "weights": np.full((1, 3), 1 / 3),
        "level": np.array([[0.0, 99.0, 100.0]]),
        "label": np.zeros((1, N), dtype=np.uint8),
    }
    drawn = stepped(kernel, values)
    np.testing.assert_array_equal(drawn, stepped(Enumerate(kernel.blanket), values))
    assert (drawn[0, :2] == 0).all() and (drawn[0, 2::3] > 0).all()


def test_products_that_would_cancel_go_the_long_way(monkeypatch: pytest.MonkeyPatch) -> None:
    net = mixture(
        lambda label, level, spread: bmc.Normal(level[label], spread[label]),
        level=LEVEL,
        spread=SPREAD,
    )
    x = Z + np.repeat([0.0, 1e5], N // 2)
    target = target_of(pose(net, {"x": x}))
    kernel = label_kernel(Blanket(target, "label"), debug=True)
    assert kernel is not None
    values = {
        **target.known,
        "weights": np.full((1, 3), 1 / 3),
        "level": np.array([[3.0, 1e5, 1e5 + 3]]),
        "spread": np.full((1, 3), 0.5),
        "label": np.zeros((1, N), dtype=np.uint8),
    }
    taken = []
    plain = kernel._plain.step
    monkeypatch.setattr(kernel._plain, "step", lambda *a: taken.append(1) or plain(*a))
    drawn = stepped(kernel, values)
    np.testing.assert_array_equal(drawn, stepped(Enumerate(kernel.blanket), values))
    assert taken  # and where components are wide, the short way serves
    stepped(kernel, {**values, "spread": np.full((1, 3), 1e3)})
    assert len(taken) == 1


def test_data_far_from_zero_are_centred() -> None:
    """Coordinates of 1e6 with components of size 1: about their mean nothing cancels."""
    net, evidence = gaussian(3, 2)
    target = target_of(pose(net, {"x": evidence["x"] + 1e6}))
    kernel = label_kernel(Blanket(target, "label"), debug=True)
    values = {
        **target.known,
        "weights": np.full((1, 3), 1 / 3),
        "mean": 1e6 + np.arange(6.0).reshape(1, 3, 2),
        "cov": np.broadcast_to(np.eye(2), (1, 3, 2, 2)).copy(),
        "label": np.zeros((1, N), dtype=np.uint8),
    }
    assert kernel is not None
    np.testing.assert_array_equal(
        stepped(kernel, values), stepped(Enumerate(kernel.blanket), values)
    )
    kernel._table(values, 1)  # does not give up


def test_weights_of_zero_are_honoured() -> None:
    kernel, values = made("gaussian 3x2", 2)
    values["weights"] = np.array([[0.0, 0.5, 0.5], [1.0, 0.0, 0.0]])
    drawn = stepped(kernel, values)
    assert (drawn[0] > 0).all() and (drawn[1] == 0).all()
    np.testing.assert_array_equal(drawn, stepped(Enumerate(kernel.blanket), values))


def test_an_impossible_configuration_is_named() -> None:
    kernel, values = made("impossible words", 1)
    values["weights"] = np.array([[1.0, 0.0, 0.0]])
    with pytest.raises(ZeroProbabilityError, match="label"):
        stepped(kernel, values)


def test_what_was_handed_out_is_never_written_to() -> None:
    kernel, values = made("gaussian 3x2", 2)
    first = stepped(kernel, values, 1)
    kept = first.copy()
    stepped(kernel, {**values, "label": first}, 2)
    np.testing.assert_array_equal(first, kept)


# ---- what is refused ------------------------------------------------------------------------------


def _label_of(net: bmc.BayesNet, evidence: dict[str, Any]) -> Labels | None:
    return label_kernel(Blanket(target_of(pose(net, evidence)), "label"))


def test_what_does_not_fit_is_left_to_others() -> None:
    heavy = mixture(lambda label, level: bmc.StudentT(4.0, level[label], 1.0), level=LEVEL)
    assert _label_of(heavy, {"x": Z}) is None
    shifted = bmc.BayesNet(plates={"kind": 3, "i": N})
    shifted.input("z", plates="i")
    shifted.add("level", bmc.Normal(0.0, 1.0), plates="kind")
    shifted.add("label", bmc.Categorical(np.full(3, 1 / 3)), plates="i")
    shifted.add("x", lambda label, level, z: bmc.Normal(level[label] + z, 1.0), plates="i")
    target = target_of(pose(shifted, {"x": Z}, inputs={"z": POSITIVE}))
    assert label_kernel(Blanket(target, "label")) is None
    own = RNG.normal(size=N)
    offset = mixture(lambda label, level: bmc.Normal(level[label] + own, 1.0), level=LEVEL)
    assert _label_of(offset, {"x": Z}) is None
    alone = bmc.BayesNet(plates={"kind": 3})
    alone.add("level", bmc.Normal(0.0, 1.0), plates="kind")
    alone.add("label", bmc.Categorical(np.full(3, 1 / 3)))
    alone.add("x", lambda label, level: bmc.Normal(level[label], 1.0))
    assert _label_of(alone, {"x": 1.0}) is None


def test_a_hidden_child_is_refused() -> None:
    net = mixture(lambda label, level: bmc.Normal(level[label], 1.0), level=LEVEL)
    net.add("y", lambda x: bmc.Normal(x, 1.0), plates="i")
    assert _label_of(net, {"y": Z}) is None


def test_data_outside_of_the_support_are_refused() -> None:
    net = mixture(lambda label, spread: bmc.Gamma(2.0, spread[label]), spread=SPREAD)
    assert _label_of(net, {"x": POSITIVE}) is not None
    target = target_of(pose(net, {"x": POSITIVE}))
    target.known["x"] = -POSITIVE
    assert label_kernel(Blanket(target, "label")) is None


# ---- together with conjugate kernels --------------------------------------------------------------


def sweep(states: int, chains: int, n: int = 400) -> tuple[Labels, list[Conjugate], Values]:
    net, evidence = gaussian(states, 2, n)
    target = target_of(pose(net, evidence))
    label = label_kernel(Blanket(target, "label"))
    kernels = [conjugate_kernel(Blanket(target, n)) for n in ("cov", "mean", "weights")]
    assert label is not None and all(isinstance(k, Conjugate) for k in kernels)
    with marking_invalid(), np.errstate(all="ignore"):
        values = start_states(target, chains, np.random.default_rng(3))
    return label, kernels, values


@pytest.mark.parametrize("chains", [1, 4])
def test_sums_by_label_come_out_of_the_draw(chains: int) -> None:
    label, _, values = sweep(3, chains, 6000)
    (term,) = label.terms
    with marking_invalid(), np.errstate(all="ignore"):
        new, _ = label.step(values, {}, np.random.default_rng(1), False)
    wanted = sums_by_label(new["label"], term.statistics, 3)
    handed = term.sums({**values, **new})
    assert handed is new[term.key]
    np.testing.assert_allclose(handed, wanted, rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(handed[..., 0], wanted[..., 0])


def test_sums_of_labels_that_somebody_else_moved_are_taken_anew() -> None:
    label, kernels, values = sweep(3, 1)
    (term,) = label.terms
    with marking_invalid(), np.errstate(all="ignore"):
        new, _ = label.step(values, {}, np.random.default_rng(1), False)
    moved = {**values, **new, "label": (new["label"] + 1) % 3}
    np.testing.assert_array_equal(
        term.sums(moved), sums_by_label(moved["label"], term.statistics, 3)
    )
    plain = {**values, "label": moved["label"]}
    for kernel in kernels:
        name = kernel.names[0]
        found, wanted = (
            kernel.step(state, {}, np.random.default_rng(2), False)[0][name]
            for state in (moved, plain)
        )
        np.testing.assert_array_equal(found, wanted)


def test_small_concentrations_are_left_to_the_family() -> None:
    small = as_expression(np.array([0.5, 1.0, 8.0]) - 1.0)
    assert DirichletDraw(small)({}, np.random.default_rng(0), 1) is None
