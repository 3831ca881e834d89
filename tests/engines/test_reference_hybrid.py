"""Published Gaussian and conditional-Gaussian networks, held against references computed elsewhere.

Data: the networks of bnRep and ecoli70, three scenarios each; references by enumeration and Gaussian
conditioning in an independent script.
"""

from __future__ import annotations

import json
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import LowEssWarning
from bayesmc.testing import compare

NETWORKS = ["algal2", "algorithms1", "algorithms5", "building", "cachexia1", "ecoli70",
            "foodsecurity", "healthinsurance", "liquefaction", "stocks", "turbine1"]  # fmt: skip
SCENARIOS = ("prior", "E1", "E2")
#: relative to max(1, |value|)
TOLERANCE = 1e-6
#: false-alarm rate of one network and scenario under likelihood weighting (Holm)
ALPHA = 1e-3


class Reference:
    """A scenario's published answer, as `compare` reads it."""

    accuracy = 1e-9

    def __init__(self, scenario: dict[str, Any]) -> None:
        self.tables = scenario["discrete"]
        self.moments = scenario["continuous"]
        self.names = (*self.tables, *self.moments)
        self.log_marginal_likelihood = scenario["log_p_evidence"]

    def probabilities(self, name: str) -> np.ndarray:
        return np.array(list(self.tables[name].values()))

    def mean(self, name: str) -> np.ndarray:
        return np.array(self.moments[name]["mean"])

    def std(self, name: str) -> np.ndarray:
        return np.array(self.moments[name]["sd"])

    def var(self, name: str) -> np.ndarray:
        return self.std(name) ** 2


def load(root: Path, name: str) -> tuple[bmc.BayesNet, dict[str, Any]]:
    with (root / "bn_hybrid" / f"{name}.json").open() as file:
        data = json.load(file)
    return build(data["nodes"]), data


def build(nodes: dict[str, Any]) -> bmc.BayesNet:
    """The net of a file, its nodes in the file's (alphabetical) order."""
    net = bmc.BayesNet()
    for name, node in nodes.items():
        if node["type"] == "discrete":
            net.table(name, node["parents"], np.array(node["cpt"]), states=tuple(node["states"]))
        elif node["type"] == "gaussian":
            rows = np.array([node["intercept"], *node["coef"].values(), node["sd"]])
            add_gaussian(net, name, [], list(node["coef"]), rows)
        else:
            add_gaussian(net, name, node["dparents"], node["gparents"], rows_of(node, nodes))
    return net


def rows_of(node: dict[str, Any], nodes: dict[str, Any]) -> np.ndarray:
    """Intercept, coefficients and deviation by the discrete parents' states, ``(*cards, 2 + p)``."""
    states = [nodes[parent]["states"] for parent in node["dparents"]]
    rows = np.full((*map(len, states), 2 + len(node["gparents"])), np.nan)
    for row in node["table"]:
        at = tuple(s.index(row["when"][d]) for s, d in zip(states, node["dparents"], strict=True))
        slopes = [row["coef"][parent] for parent in node["gparents"]]
        rows[at] = [row["intercept"], *slopes, row["sd"]]
    assert np.isfinite(rows).all()
    return rows


def add_gaussian(
    net: bmc.BayesNet, name: str, discrete: list[str], smooth: list[str], rows: np.ndarray
) -> None:
    def density(*parents: Any) -> bmc.Normal:
        picked = rows[parents[: len(discrete)]]
        mean = picked[..., 0]
        for k, parent in enumerate(parents[len(discrete) :]):
            mean = mean + picked[..., 1 + k] * parent
        return bmc.Normal(mean, picked[..., -1])

    net.add(name, density, parents=[*discrete, *smooth])


def is_close(found: Any, exact: Any) -> bool:
    found, exact = np.asarray(found), np.asarray(exact)
    assert found.shape == exact.shape
    return bool((np.abs(found - exact) <= TOLERANCE * np.maximum(1.0, np.abs(exact))).all())


def wrong(posterior: Any, exact: Reference) -> list[str]:
    """What a posterior answers differently, in words."""
    found = []
    if not is_close(posterior.log_marginal_likelihood, exact.log_marginal_likelihood):
        found.append(f"log evidence {posterior.log_marginal_likelihood}")
    for name in exact.tables:
        if not is_close(posterior.probabilities(name), exact.probabilities(name)):
            found.append(f"probabilities of {name}")
    for name in exact.moments:
        if not is_close(posterior.mean(name), exact.mean(name)):
            found.append(f"mean of {name}: {posterior.mean(name)} not {exact.mean(name)}")
        if not is_close(posterior.std(name), exact.std(name)):
            found.append(f"sd of {name}: {posterior.std(name)} not {exact.std(name)}")
    return found


def test_every_file_is_tested(reference_data: Path) -> None:
    files = sorted(path.stem for path in (reference_data / "bn_hybrid").glob("*.json"))
    assert files == sorted(NETWORKS)
    for name in NETWORKS:
        net, data = load(reference_data, name)
        assert set(net) == set(data["nodes"])
        assert set(data["reference"]) == set(SCENARIOS)
        for scenario in data["reference"].values():
            assert {*scenario["discrete"], *scenario["continuous"]} == set(net) - set(
                scenario["evidence"]
            )


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("name", NETWORKS)
def test_exact_matches_the_published_answers(
    reference_data: Path, name: str, scenario: str
) -> None:
    net, data = load(reference_data, name)
    reference = data["reference"][scenario]
    posterior = bmc.infer(net, reference["evidence"], engine=bmc.Exact())
    assert not wrong(posterior, Reference(reference))


@pytest.mark.parametrize("name", ["algorithms5", "cachexia1", "healthinsurance"])
def test_other_parameters_do_not_match(reference_data: Path, name: str) -> None:
    """Negative control: one part in a thousand in any one deviation or coefficient is noticed."""
    _, data = load(reference_data, name)
    exact = {key: Reference(data["reference"][key]) for key in SCENARIOS}
    changed = 0
    for node in data["nodes"].values():
        for table in node.get("table", [node]):
            if node["type"] == "discrete":
                continue
            for holder, key in [(table, "sd"), *((table["coef"], k) for k in table["coef"])]:
                value = holder[key]
                holder[key] = 1.001 * value
                net = build(data["nodes"])
                assert any(
                    wrong(
                        bmc.infer(net, data["reference"][s]["evidence"], engine=bmc.Exact()),
                        exact[s],
                    )
                    for s in SCENARIOS
                )
                holder[key] = value
                changed += 1
    assert changed >= 6


@pytest.mark.parametrize("name", NETWORKS)
def test_the_density_of_the_file_is_the_net_s(reference_data: Path, name: str) -> None:
    """The builder of these tests against the file's own numbers, at draws."""
    net, data = load(reference_data, name)
    draws = net.sample(20, rng=3)
    found = net.log_prob(draws)
    for i in range(20):
        values = {n: v.labels[i] if hasattr(v, "labels") else float(v[i]) for n, v in draws.items()}
        total = sum(file_log_prob(data["nodes"], n, values) for n in values)
        assert found[i] == pytest.approx(total, abs=1e-9)


def file_log_prob(nodes: dict[str, Any], name: str, values: dict[str, Any]) -> float:
    node = nodes[name]
    if node["type"] == "discrete":
        row = node["cpt"]
        for parent in node["parents"]:
            row = row[nodes[parent]["states"].index(values[parent])]
        return math.log(row[node["states"].index(values[name])])
    if node["type"] == "clg":
        (node,) = (r for r in node["table"] if all(values[k] == v for k, v in r["when"].items()))
    mean = node["intercept"] + sum(c * values[k] for k, c in node["coef"].items())
    z = (values[name] - mean) / node["sd"]
    return -0.5 * (z * z + math.log(2 * math.pi)) - math.log(node["sd"])


@pytest.mark.parametrize("name", NETWORKS)
def test_likelihood_weighting_matches_or_warns(reference_data: Path, name: str) -> None:
    net, data = load(reference_data, name)
    for seed, key in enumerate(SCENARIOS):
        reference = data["reference"][key]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            engine = bmc.LikelihoodWeighting(20_000)
            posterior = bmc.infer(
                net, reference["evidence"], engine=engine, rng=seed, keep="summaries"
            )
        assert all(issubclass(w.category, LowEssWarning) for w in caught)
        if caught:
            assert reference["evidence"], f"{name} {key}: a warning without evidence"
            continue
        match = compare(posterior, Reference(reference), ALPHA)
        assert not match.rejected, f"{name} {key}: " + "\n".join(map(str, match.rejected))
        assert len(match.comparisons) >= len(reference["continuous"])
