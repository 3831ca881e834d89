"""TrueSkill as a net: who plays how well, from who beat whom.

    skill_i ~ N(25, (25/3)^2),   performance_i ~ N(skill_i, (25/6)^2)
    a team plays as well as its players together; who wins, plays better by more than a margin

The rating system of Herbrich, Minka and Graepel (2006), TrueSkill: a Bayesian skill rating system, NIPS 19,
is expectation propagation on this net. Games are observed comparisons, draws differences within the margin.
First single games, beside the published ratings; then a season of games between players whose skills are
known, rated all at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import special

import bayesmc as bmc
from examples import picture

MEAN, SPREAD, LUCK, DRIFT, DRAWS = 25.0, 25 / 3, 25 / 6, 25 / 300, 0.10


def margin(players: int) -> float:
    """By how much less teams may differ in a draw, where a share ``DRAWS`` of games are drawn."""
    return float(np.sqrt(players) * LUCK * special.ndtri(0.5 * (DRAWS + 1.0)))


def rated(teams: Sequence[Sequence[str]], drawn: bool = False) -> Any:
    """Ratings after one game of new players; teams in the order in which they came in."""
    net, evidence = bmc.BayesNet("game"), {}
    for name in (n for team in teams for n in team):
        net.add(name, bmc.Normal(MEAN, np.hypot(SPREAD, DRIFT)))
        net.add(f"{name} plays", lambda skill: bmc.Normal(skill, LUCK), parents=[name])
    for k, (better, worse) in enumerate(zip(teams, teams[1:], strict=False)):
        parents = [f"{n} plays" for n in (*better, *worse)]
        gap, sizes = margin(len(parents)), len(better)

        def result(*plays: Any, gap: float = gap, sizes: int = sizes) -> bmc.Bernoulli:
            lead = sum(plays[:sizes]) - sum(plays[sizes:])
            return bmc.Bernoulli(np.abs(lead) < gap if drawn else lead > gap)

        net.add(f"result {k}", result, parents=parents)
        evidence[f"result {k}"] = 1
    return bmc.infer(net, evidence, engine=bmc.ExpectationPropagation())


def games() -> None:
    """Single games, beside the ratings of the package trueskill 0.4.5."""
    print("one game of new players       mean     sd   published")
    shown = (
        ("a beats b", [["a"], ["b"]], False, (("a", 29.396, 7.171), ("b", 20.604, 7.171))),
        ("a and b draw", [["a"], ["b"]], True, (("a", 25.0, 6.458),)),
        ("a, b beat c, d", [["a", "b"], ["c", "d"]], False, (("a", 28.108, 7.774),)),
        (
            "a beats b beats c", [["a"], ["b"], ["c"]], False,
            (("a", 31.675, 6.656), ("b", 25.0, 6.208), ("c", 18.325, 6.656)),
        ),
    )  # fmt: skip
    for words, teams, drawn, published in shown:
        posterior = rated(teams, drawn)
        for name, mean, sd in published:
            ours = f"{posterior.mean(name):9.3f}{posterior.std(name):7.3f}"
            print(f"  {words:<18}{name}:  {ours}   {mean:.3f} {sd:.3f}")


def season(
    players: int, rounds: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """True skills, first and second player of every game, and whether the first won, lost or neither."""
    rng = np.random.default_rng(seed)
    skill = rng.normal(MEAN, SPREAD, players)
    pairs = rng.integers(players, size=(rounds, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    first, second = pairs.T
    lead = rng.normal(skill[first] - skill[second], np.sqrt(2.0) * LUCK)
    return skill, first, second, np.where(np.abs(lead) < margin(2), 0, np.sign(lead)).astype(int)


def league(
    players: int, first: np.ndarray, second: np.ndarray, result: np.ndarray
) -> tuple[bmc.BayesNet, dict[str, Any]]:
    """All games of a season as three plates: won, lost, drawn."""
    won, lost, drawn = (np.flatnonzero(result == r) for r in (1, -1, 0))
    winner = np.concatenate([first[won], second[lost]])
    loser = np.concatenate([second[won], first[lost]])
    sizes = {"player": players, "decided": len(winner), "drawn": len(drawn)}
    net = bmc.BayesNet("season", plates=sizes)
    net.add("skill", bmc.Normal(MEAN, SPREAD), plates="player")
    luck = np.sqrt(2.0) * LUCK  # of both players

    @net.node(plates="decided")
    def lead(skill):
        return bmc.Normal(skill[winner] - skill[loser], luck)

    @net.node(plates="drawn")
    def gap(skill):
        return bmc.Normal(skill[first[drawn]] - skill[second[drawn]], luck)

    net.add("win", lambda lead: bmc.Bernoulli(lead > margin(2)), plates="decided")
    net.add("draw", lambda gap: bmc.Bernoulli(np.abs(gap) < margin(2)), plates="drawn")
    return net, {"win": np.ones(len(winner)), "draw": np.ones(len(drawn))}


def main(arguments: Sequence[str] | None = None) -> None:
    options = picture.options(__doc__, arguments)
    games()
    players, rounds = (12, 60) if options.fast else (30, 400)
    skill, *played = season(players, rounds, 1)
    net, evidence = league(players, *played)
    posterior = bmc.infer(net, evidence, engine=bmc.ExpectationPropagation())
    mean, sd = posterior.mean("skill"), posterior.std("skill")
    inside = np.mean(np.abs(mean - skill) < 2 * sd)
    print(f"\na season: {players} players, {len(played[0])} games, {posterior.sweeps} sweeps")
    print(f"  correlation of ratings with skills {np.corrcoef(mean, skill)[0, 1]:.3f}")
    print(f"  within two standard deviations {100 * inside:.0f} %")
    figure, panels = picture.axes([["season"]], (6, 5))
    ax = panels["season"]
    ax.errorbar(skill, mean, 2 * sd, fmt="o", ms=4, color=picture.DRAWS, ecolor=picture.FAINT)
    ends = [skill.min(), skill.max()]
    ax.plot(ends, ends, color=picture.EXACT)
    ax.set(
        xlabel="skill", ylabel="rating, two standard deviations", title=f"{len(played[0])} games"
    )
    picture.save(figure, options.out, "trueskill")


if __name__ == "__main__":
    main()
