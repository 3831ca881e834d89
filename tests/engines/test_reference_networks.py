"""Real networks read from BIF, every engine against published exact answers.

Data: the bnlearn repository's networks with references of 10 decimals, four scenarios each.
"""

from __future__ import annotations

import gzip
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import BudgetError, LowEssWarning, ZeroProbabilityError
from bayesmc.testing import compare

EXACT = ["alarm", "asia", "cancer", "earthquake", "hepar2", "mildew", "pigs", "sachs", "survey",
         "water"]  # fmt: skip
#: false-alarm rate per net and scenario (Holm): 1e-3, so 4 % over the 40 of them at fresh seeds
ALPHA = 1e-3


class Reference:
    """A scenario's published answer, as `compare` reads it."""

    def __init__(self, scenario: dict[str, Any]) -> None:
        self.marginals = scenario["marginals"]
        self.names = tuple(self.marginals)
        self.log_marginal_likelihood = scenario["log_p_evidence"]
        self.accuracy = 1e-9  # ten decimals

    def probabilities(self, name: str) -> np.ndarray:
        return np.array(self.marginals[name])


def load(root: Path, name: str) -> tuple[bmc.BayesNet, dict[str, Any]]:
    folder = root / "bn_discrete"
    with gzip.open(folder / "refs" / f"{name}.ref.json.gz", "rt") as file:
        reference = json.load(file)
    net = bmc.io.read(folder / "bif" / f"{name}.bif.gz")
    return net, reference


def test_every_file_loads_with_its_states(reference_data: Path) -> None:
    paths = sorted((reference_data / "bn_discrete" / "bif").glob("*.bif.gz"))
    assert len(paths) >= 11
    for path in paths:
        net, reference = load(reference_data, path.name.removesuffix(".bif.gz"))
        assert len(net) == reference["nodes"]
        assert net.graph.number_of_edges() == reference["arcs"]
        for name, states in reference.get("states", {}).items():
            assert net[name].states == tuple(states)


@pytest.mark.parametrize("name", EXACT)
def test_exact_matches_the_published_answers(reference_data: Path, name: str) -> None:
    net, reference = load(reference_data, name)
    assert len(reference["scenarios"]) == 4
    for scenario in reference["scenarios"].values():
        posterior = bmc.infer(net, scenario["evidence"], engine=bmc.Exact())
        assert posterior.log_marginal_likelihood == pytest.approx(
            scenario["log_p_evidence"], abs=1e-6
        )
        assert set(scenario["marginals"]) >= set(net) - set(scenario["evidence"])
        for node, marginal in scenario["marginals"].items():
            np.testing.assert_allclose(posterior.probabilities(node), marginal, rtol=0, atol=1e-6)


def test_munin1_is_refused_ahead_of_time_with_its_cost(reference_data: Path) -> None:
    net, _ = load(reference_data, "munin1")
    reason = bmc.Exact().unsupported(net)
    assert reason is not None
    for part in ("induced width", "GiB", "LikelihoodWeighting"):
        assert part in reason
    with pytest.raises(BudgetError, match="induced width") as caught:
        bmc.infer(net, engine=bmc.Exact())
    assert caught.value.bytes > 2 * 2**30


def test_munin1_is_answered_without_naming_an_engine(reference_data: Path) -> None:
    net, _ = load(reference_data, "munin1")
    posterior = bmc.infer(net, rng=0, keep="summaries")
    assert isinstance(posterior.engine, bmc.LikelihoodWeighting)


def weighted(
    net: bmc.BayesNet, evidence: dict[str, str], seed: int, draws: int = 20_000
) -> tuple[Any, bool]:
    """An answer and whether it warned; None where no draw was compatible."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            engine = bmc.LikelihoodWeighting(draws)
            posterior = bmc.infer(net, evidence, engine=engine, rng=seed, keep="summaries")
        except ZeroProbabilityError:
            return None, True
    assert all(issubclass(w.category, LowEssWarning) for w in caught)
    return posterior, bool(caught)


@pytest.mark.parametrize("name", EXACT)
def test_likelihood_weighting_matches_or_warns(reference_data: Path, name: str) -> None:
    net, reference = load(reference_data, name)
    for seed, (title, scenario) in enumerate(reference["scenarios"].items()):
        posterior, warned = weighted(net, scenario["evidence"], seed)
        if warned:
            assert scenario["evidence"], f"{name} {title}: a warning without evidence"
            continue
        match = compare(posterior, Reference(scenario), ALPHA)
        assert not match.rejected, f"{name} {title}: " + "\n".join(map(str, match.rejected))
        assert len(match.comparisons) >= len(scenario["marginals"]) / 4


def test_likelihood_weighting_answers_most_scenarios(reference_data: Path) -> None:
    """The warning is no way out: on ALARM, ASIA and SURVEY, weighting carries most answers."""
    answered = 0
    for name in ("alarm", "asia", "cancer", "earthquake", "survey"):
        net, reference = load(reference_data, name)
        for seed, scenario in enumerate(reference["scenarios"].values()):
            answered += not weighted(net, scenario["evidence"], seed)[1]
    assert answered >= 16  # of 20


def test_forgotten_weights_are_caught(reference_data: Path) -> None:
    """Negative control: prior draws do not pass for the posterior."""
    caught = 0
    for name in ("alarm", "asia", "earthquake", "survey"):
        net, reference = load(reference_data, name)
        prior = bmc.infer(net, engine=bmc.LikelihoodWeighting(20_000), rng=0)
        for scenario in reference["scenarios"].values():
            if scenario["evidence"]:
                hidden = [n for n in scenario["marginals"] if n not in scenario["evidence"]]
                caught += bool(compare(prior, Reference(scenario), ALPHA, names=hidden).rejected)
    assert caught >= 11  # of 12
