"""Random conditional-Gaussian nets: both forms say the same, and brute force says what it should.

The plain form is held against the net's own ``log_prob``, its posterior against Bayes' rule point by
point, against quadrature, and against likelihood weighting.
"""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

import bayesmc as bmc
from bayesmc.errors import (
    LowEssWarning,
    UnknownNodeError,
    UnsupportedError,
    ZeroProbabilityError,
)
from bayesmc.network import pose
from bayesmc.testing import (
    ConditionalGaussian,
    GaussianAnswer,
    compare,
    enumerate_posterior,
    gaussian_evidence,
    random_gaussian_net,
    session,
)
from bayesmc.testing.oracles.conditional_gaussian import DiscretePart, GaussianPart, PlainNode

KINDS: dict[str, dict[str, Any]] = {
    "scalars": {},
    "plates": {"plates": True},
    "vectors": {"vectors": True},
    "vectors in plates": {"plates": True, "vectors": True},
}
#: false-alarm rate of one comparison of draws with the exact answer (Holm over its figures)
ALPHA = 1e-3


def user_values(draw: dict[str, Any], i: int) -> dict[str, Any]:
    """One of several joint draws, in the form of complete evidence."""
    return {n: v.labels[i] if hasattr(v, "labels") else v[i] for n, v in draw.items()}


@pytest.mark.parametrize("kind", KINDS)
def test_both_forms_have_one_density(kind: str) -> None:
    for seed in range(session.scaled(15, 4)):
        net, plain = random_gaussian_net(seed, **KINDS[kind])
        draw = net.sample(2, rng=seed)
        found = net.log_prob(draw)
        for i in range(2):
            assert plain.log_prob(user_values(draw, i)) == pytest.approx(found[i], abs=1e-9)


def test_a_wrong_coefficient_or_scale_changes_the_density() -> None:
    """Negative control: the comparison of densities notices one part in a hundred."""
    noticed = []
    for seed in range(session.scaled(20, 4)):
        net, plain = random_gaussian_net(seed, **KINDS["vectors in plates"])
        draw = net.sample(1, rng=seed)
        right = plain.log_prob(user_values(draw, 0))
        for field in ("coefficients", "covariance"):
            parts = [
                dataclasses.replace(p, **{field: getattr(p, field) * 1.01}) for p in plain.gaussian
            ]
            wrong = dataclasses.replace(plain, gaussian=tuple(parts))
            if parts and any(getattr(p, field).any() for p in parts):
                noticed.append(abs(wrong.log_prob(user_values(draw, 0)) - right) > 1e-9)
    assert len(noticed) > 25
    assert np.mean(noticed) > 0.95


@pytest.mark.parametrize("kind", KINDS)
def test_both_forms_know_the_same_nodes(kind: str) -> None:
    for seed in range(session.scaled(15, 4)):
        net, plain = random_gaussian_net(seed, **KINDS[kind])
        model = pose(net, {}, None).model
        assert list(plain.nodes) == list(net)
        for name, node in plain.nodes.items():
            compiled = model[name]
            assert (node.plates, node.event_shape) == (compiled.plates, compiled.event_shape)
            assert node.plate_shape == compiled.plate_shape
            assert node.states == (compiled.domain.states if compiled.domain else None)


@pytest.mark.parametrize("kind", KINDS)
def test_the_posterior_is_the_joint_density_over_the_evidence(kind: str) -> None:
    """Bayes' rule at single points. Posterior densities integrate to one by construction, so that this
    holds only if weights, Gaussians and evidence are right, all of them."""
    points = 0
    for seed in range(session.scaled(20, 4)):
        net, plain = random_gaussian_net(seed, **KINDS[kind])
        evidence = gaussian_evidence(net, seed)
        answer = plain.posterior(evidence)
        for draw in range(2):
            values = completed(net, evidence, seed + 1000 + draw)
            joint = float(net.log_prob({n: v for n, v in values.items() if n in stochastic(net)}))
            assert answer_at(answer, plain, net, values) == pytest.approx(joint, rel=1e-9, abs=1e-8)
            points += np.isfinite(joint)
    assert points > 30


def stochastic(net: bmc.BayesNet) -> list[str]:
    return [name for name in net if net[name].kind == "stochastic"]


def completed(net: bmc.BayesNet, evidence: dict[str, Any], seed: int) -> dict[str, Any]:
    """A joint draw with the evidence written into it."""
    values = user_values(net.sample(1, rng=seed), 0)
    for name, seen in evidence.items():
        missing = np.ma.getmaskarray(seen)
        if np.ndim(seen):
            array = np.ma.getdata(seen)
            if array.dtype == object:
                missing = missing | np.equal(array, None)
            elif array.dtype.kind == "f":
                missing = missing | np.isnan(array)
            values[name] = np.where(missing, np.asarray(values[name]), array)
        else:
            values[name] = seen
    return values


def answer_at(
    answer: GaussianAnswer, plain: ConditionalGaussian, net: bmc.BayesNet, values: dict[str, Any]
) -> float:
    """Log of evidence times posterior density at a point; minus infinity where it has no weight.

    Deterministic nodes follow the others, and are left out.
    """
    match = np.ones(len(answer.weights), dtype=bool)
    hidden, at = [], []
    for name in stochastic(net):
        node = plain.nodes[name]
        flat = np.reshape(np.array(values[name], dtype=object), -1).tolist()
        length = int(np.prod(node.event_shape, dtype=int))
        for place, value in enumerate(flat):
            if node.states is not None:
                match &= answer.states[name, place] == node.states.index(value)
                continue
            i = answer.index[name, place // length, place % length]
            if (answer.covs[:, i, i] > 0).any():
                hidden.append(i)
                at.append(value)
    if not match.any():
        return -np.inf
    assert match.sum() == 1
    k = int(np.flatnonzero(match)[0])
    log_density = np.log(answer.weights[k]) + answer.log_marginal_likelihood
    if hidden:
        cov = answer.covs[k][np.ix_(hidden, hidden)]
        log_density += scipy.stats.multivariate_normal.logpdf(at, answer.means[k, hidden], cov)
    return float(log_density)


def close(a: Any, b: Any, tolerance: float) -> bool:
    return bool(np.all(np.abs(np.asarray(a) - b) <= tolerance * np.maximum(1.0, np.abs(b))))


def test_quadrature_agrees_on_tiny_nets() -> None:
    compared = 0
    for seed in range(120):
        net, plain = random_gaussian_net(seed, nodes=(2, 4), discrete=0.5, plates=seed % 2 == 1)
        evidence = gaussian_evidence(net, seed, chance=0.5)
        answer = plain.posterior(evidence)
        noisy = [i for s, i in answer.index.items() if net[s[0]].kind == "stochastic"]
        hidden = sum((answer.covs[:, i, i] > 0).any() for i in noisy)
        if not 1 <= hidden <= 2 or len(answer.weights) > 40:
            continue
        found = enumerate_posterior(net, evidence, points={1: 400, 2: 120}[hidden])
        assert found.log_marginal_likelihood == pytest.approx(
            answer.log_marginal_likelihood, abs=1e-4
        )
        for name, node in plain.nodes.items():
            if node.states is not None:
                assert close(found.probabilities(name), answer.probabilities(name), 1e-4)
            else:
                assert close(found.mean(name), answer.mean(name), 1e-4)
                assert close(found.var(name), answer.var(name), 1e-4)
        compared += 1
    assert compared >= 25


def weighted(net: bmc.BayesNet, evidence: dict[str, Any], seed: int) -> Any:
    """An answer by likelihood weighting; None where its weights do not carry it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        engine = bmc.LikelihoodWeighting(20_000)
        posterior = bmc.infer(net, evidence, engine=engine, rng=seed, keep="summaries")
    assert all(issubclass(w.category, LowEssWarning) for w in caught)
    return None if caught else posterior


@pytest.mark.parametrize("kind", KINDS)
def test_likelihood_weighting_agrees(kind: str) -> None:
    """At fixed seeds; were they fresh, the 12 comparisons would raise a false alarm in 1.2 % of runs."""
    answered = 0
    for seed in range(12):
        net, plain = random_gaussian_net(seed, **KINDS[kind])
        evidence = gaussian_evidence(net, seed, chance=0.25)
        posterior = weighted(net, evidence, seed + 1)
        if posterior is None:
            continue
        match = compare(posterior, plain.posterior(evidence), ALPHA)
        assert not match.rejected, f"{net.name}: " + "\n".join(map(str, match.rejected))
        answered += 1
    assert answered >= 8


def test_forgotten_evidence_is_noticed() -> None:
    """Negative control: draws of the prior are no draws of the posterior."""
    noticed = []
    for seed in range(12):
        net, plain = random_gaussian_net(seed)
        evidence = gaussian_evidence(net, seed, chance=0.5)
        answer = plain.posterior(evidence)
        hidden = [n for n in answer.names if n not in evidence]
        if evidence and any(not close(answer.mean(n), plain.posterior().mean(n), 0.3)
                            for n in hidden if plain.nodes[n].states is None):  # fmt: skip
            match = compare(weighted(net, {}, seed), answer, ALPHA, names=hidden)
            noticed.append(bool(match.rejected))
    assert len(noticed) >= 3
    assert all(noticed)


def mixture_by_hand() -> ConditionalGaussian:
    """``a`` in (-1, 2), ``x`` normal by ``a``, ``y = 2 x``, ``z`` a noisy copy of ``x``."""
    net = bmc.BayesNet()
    net.table("a", probs=[0.25, 0.75], states=(-1.0, 2.0))
    net.add("x", lambda a: bmc.Normal(a, np.where(a == 2.0, 0.5, 1.0)))
    net.add("y", lambda x: 2 * x)
    net.add("z", lambda x: bmc.Normal(x, 1.0))
    a, x = ("a", 0), ("x", 0, 0)
    one = np.ones((1, 1))
    return ConditionalGaussian(
        net,
        {
            "a": PlainNode("a", states=(-1.0, 2.0)),
            **{name: PlainNode(name) for name in ("x", "y", "z")},
        },
        (DiscretePart(a, (), np.array([0.25, 0.75])),),
        (
            GaussianPart(
                (x,),
                (a,),
                (),
                np.array([[-1.0], [2.0]]),
                np.zeros((2, 1, 0)),
                np.array([[[1.0]], [[0.25]]]),
            ),
            GaussianPart((("y", 0, 0),), (), (x,), np.zeros(1), 2 * one, 0 * one),
            GaussianPart((("z", 0, 0),), (), (x,), np.zeros(1), one, one),
        ),
    )


def test_a_mixture_by_hand() -> None:
    prior = mixture_by_hand().posterior()
    assert prior.log_marginal_likelihood == pytest.approx(0.0, abs=1e-12)
    assert prior.mean("x") == pytest.approx(1.25)
    assert prior.var("x") == pytest.approx(0.25 * 1.0 + 0.75 * 0.25 + 9.0 * 0.25 * 0.75)
    assert prior.cov("x", "y") == pytest.approx(prior.var("x") * np.array([[1, 2], [2, 4]]))
    assert prior.cov("a", "x")[0, 1] == pytest.approx(9.0 * 0.25 * 0.75)  # variance of a
    assert prior.cov("a") == pytest.approx(9.0 * 0.25 * 0.75)

    seen = mixture_by_hand().posterior({"z": 0.5})
    parts = np.array([0.25, 0.75]) * scipy.stats.norm.pdf(0.5, [-1, 2], np.sqrt([2.0, 1.25]))
    assert seen.log_marginal_likelihood == pytest.approx(np.log(parts.sum()))
    np.testing.assert_allclose(seen.probabilities("a"), parts / parts.sum())
    weights, means, covs = seen.mixture("x")
    np.testing.assert_allclose(weights, parts / parts.sum())
    np.testing.assert_allclose(means[:, 0], [-0.25, 1.7])
    np.testing.assert_allclose(covs[:, 0, 0], [0.5, 0.2])
    total, _ = scipy.integrate.quad(lambda p: seen.density("x", np.array(p)), -10, 10)
    assert total == pytest.approx(1.0, abs=1e-7)
    assert seen.std("z") == pytest.approx(0.0, abs=1e-12)
    assert seen.mean("z") == pytest.approx(0.5, abs=1e-15)
    assert seen.mean("y") == pytest.approx(2 * seen.mean("x"))


def test_a_net_without_continuous_nodes() -> None:
    net = bmc.BayesNet()
    net.table("a", probs=[0.25, 0.75], states=(-1.0, 2.0))
    part = DiscretePart(("a", 0), (), np.array([0.25, 0.75]))
    plain = ConditionalGaussian(net, {"a": PlainNode("a", states=(-1.0, 2.0))}, (part,), ())
    assert plain.posterior().cov("a", "a") == pytest.approx(np.full((2, 2), 9.0 * 0.25 * 0.75))
    seen = plain.posterior({"a": 2.0})
    assert seen.log_marginal_likelihood == pytest.approx(np.log(0.75))
    assert seen.mean("a") == pytest.approx(2.0)


def test_what_cannot_be_answered_is_refused() -> None:
    plain = mixture_by_hand()
    with pytest.raises(UnsupportedError, match="'x'"):
        plain.posterior().probabilities("x")
    with pytest.raises(UnknownNodeError, match="'w'"):
        plain.posterior().mean("w")
    certain = dataclasses.replace(plain.discrete[0], table=np.array([1.0, 0.0]))
    with pytest.raises(ZeroProbabilityError, match="probability zero"):
        dataclasses.replace(plain, discrete=(certain,)).posterior({"a": 2.0})
    assert plain.log_prob({"a": 2.0, "x": 1.0, "y": 3.0, "z": 0.0}) == -np.inf


def test_missing_values_in_every_form() -> None:
    net = bmc.BayesNet(plates={"k": 3})
    net.add("x", bmc.Normal(0.0, 1.0), plates="k")
    part = GaussianPart((), (), (), np.zeros(1), np.zeros((1, 0)), np.eye(1))
    parts = tuple(dataclasses.replace(part, scalars=(("x", i, 0),)) for i in range(3))
    plain = ConditionalGaussian(net, {"x": PlainNode("x", ("k",), (3,))}, (), parts)
    for seen in (
        [1.0, np.nan, 3.0],
        [1.0, None, 3.0],
        np.ma.MaskedArray([1.0, 2.0, 3.0], [False, True, False]),
    ):
        answer = plain.posterior({"x": seen})
        np.testing.assert_allclose(answer.mean("x"), [1.0, 0.0, 3.0])
        np.testing.assert_allclose(answer.var("x"), [0.0, 1.0, 0.0])


def test_the_same_seed_gives_the_same_net() -> None:
    for seed in range(10):
        (one, plain), (two, again) = (
            random_gaussian_net(np.random.default_rng(seed), **KINDS["vectors in plates"])
            for _ in range(2)
        )
        assert one.name == two.name
        values = user_values(one.sample(1, rng=0), 0)
        assert plain.log_prob(values) == again.log_prob(values)
    assert len({random_gaussian_net(seed)[0].name for seed in range(20)}) > 15


def test_what_nets_hold() -> None:
    """What engines must cope with does occur, none of it rarely."""
    seen: dict[str, int] = {}

    def note(what: str, there: bool = True) -> None:
        seen[what] = seen.get(what, 0) + bool(there)

    for seed in range(session.seed(), session.seed() + 70):
        net, plain = random_gaussian_net(seed, **KINDS["vectors in plates"])
        for name, node in plain.nodes.items():
            kind = net[name].kind
            if node.states is not None:
                plain_states = node.states == tuple(range(len(node.states)))
                label = isinstance(node.states[0], str)
                note("plain" if plain_states else "labels" if label else "numbers")
                note("computed state", kind == "deterministic")
            else:
                note("affine node", kind == "deterministic")
                note("vector", bool(node.event_shape))
            for parent in net[name].parents:
                above = plain.nodes[parent]
                note("foreign plate", not set(above.plates) <= set(node.plates))
                note("shared plate", bool(set(above.plates) & set(node.plates)))
                note("foreign discrete", above.states is not None
                     and not set(above.plates) <= set(node.plates))  # fmt: skip
        for part in plain.gaussian:
            over = tuple(range(len(part.scope)))
            note("several parents", len(part.parents) > 1)
            note("switched coefficient", bool(np.ptp(part.coefficients, axis=over).any()))
            note("switched parents", bool(np.ptp(1 * (part.coefficients == 0), axis=over).any()))
            note("switched noise", bool(np.ptp(part.covariance, axis=over).any()))
            note("coloured noise", bool(np.triu(part.covariance, 1).any()))
        note("zero probability", any((part.table == 0).any() for part in plain.discrete))
    assert min(seen.values()) >= 8, seen
    assert len(seen) == 15


def test_evidence_is_of_every_kind() -> None:
    kinds = set()
    for seed in range(50):
        net, plain = random_gaussian_net(seed, **KINDS["vectors in plates"])
        for name, value in gaussian_evidence(net, seed).items():
            node = plain.nodes[name]
            kinds.add("discrete" if node.states else "vector" if node.event_shape else "scalar")
            if node.event_shape:
                missing = np.isnan(value)
                assert (missing.any(-1) == missing.all(-1)).all()
                assert not missing.all()
                kinds.add("vectors in part" if missing.any() else "vectors whole")
            elif node.states is None and np.ndim(value) and np.isnan(value).any():
                kinds.add("scalars in part")
    assert kinds == {"discrete", "vector", "scalar", "vectors in part", "vectors whole",
                     "scalars in part"}  # fmt: skip


def test_options_are_kept() -> None:
    for seed in range(session.scaled(15, 4)):
        net, plain = random_gaussian_net(seed, nodes=(2, 3), states=2, deterministic=False)
        assert 2 <= len(net) <= 3
        assert all(len(node.states or "ab") == 2 for node in plain.nodes.values())
        assert stochastic(net) == list(net)
        net, plain = random_gaussian_net(seed, discrete=0.0, plates=True, scalars=9)
        assert not plain.discrete
        assert sum(len(part.scalars) for part in plain.gaussian) <= 9
        _, plain = random_gaussian_net(seed, plates=True, configurations=12)
        assert len(plain.posterior().weights) <= 12
        _, plain = random_gaussian_net(seed, zeros=False, deterministic=False)
        assert all((part.table > 0).all() for part in plain.discrete)


@pytest.mark.parametrize(
    "options",
    [{"nodes": (0, 2)}, {"nodes": (3, 2)}, {"states": 1}, {"discrete": 1.5}, {"terms": 0}],
)
def test_options_are_checked(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        random_gaussian_net(0, **options)
