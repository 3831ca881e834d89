"""One step of a particle filter, three ways: the same algorithm, down to every particle.

A robot goes round a ring of 24 places and reads a poor sensor. From weighted particles of one slice to those
of the next one gets

(a) by resampling them, then moving each: what ``bmc.ParticleFilter`` does;
(b) by drawing from the predictive mixture, sum_i w_i p(x | x_i): a component, then a place within it;
(c) by elimination in a factor graph, where the particles of the slice before are the states of a variable
    ``parent``: summing it out leaves the predictive, summing out ``x`` too leaves the evidence, and drawing
    goes back through the eliminated tables.

Two uniform numbers make a particle. The three are given the same, read through inverse distribution
functions: one is a point for the resampling, which is a function of weights, and the other a node of the
template, ``u``, of which the place is computed. So the filter's own random numbers can be asked for. The
particles are then equal, and so is the evidence that each estimates; summed out instead of drawn, the
evidence is what their estimate is on average.

Koller and Friedman (2009), Probabilistic Graphical Models, sections 12.3 and 15.3.3; Thrun, Burgard and Fox
(2005), Probabilistic Robotics, section 8.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

import bayesmc as bmc
from examples import picture

PLACES = 24
STEPS = (0.05, 0.15, 0.3, 0.3, 0.15, 0.05)  # probabilities to move on by 0, 1, ... places
ROWS = [3, 5, 9, 10, 13]  # readings; the last is that of the step looked at


def transition() -> np.ndarray:
    """Probabilities of the next place, shape (place, next)."""
    return sum(p * np.roll(np.eye(PLACES), k, axis=1) for k, p in enumerate(STEPS))


def sensor() -> np.ndarray:
    """Probabilities of a reading, near the place or one time in five anywhere; shape (place, reading)."""
    off = (np.arange(PLACES) - np.arange(PLACES)[:, None] + PLACES // 2) % PLACES - PLACES // 2
    near = np.exp(-0.5 * (off / 1.5) ** 2)
    return 0.8 * near / near.sum(axis=1, keepdims=True) + 0.2 / PLACES


MOVE, READ = transition(), sensor()


def ring() -> bmc.DynamicBayesNet:
    """The template; the uniform number that moves the robot is a node of its own."""
    dbn = bmc.DynamicBayesNet("ring")
    dbn.add("u", bmc.Uniform(0.0, 1.0))
    dbn.add("x", lambda x_prev, u: quantile(MOVE[x_prev], u), initial=lambda u: anywhere(u))
    dbn.add("y", lambda x: bmc.Categorical(READ[x]))
    return dbn


def anywhere(u: Any) -> np.ndarray:
    """The first place, uniform on the ring."""
    return quantile(np.full(PLACES, 1 / PLACES), u)


def quantile(probs: np.ndarray, u: Any) -> np.ndarray:
    """The inverse distribution function: the state that a uniform number falls on."""
    edges = np.cumsum(probs, axis=-1)[..., :-1]  # the last is one, whatever rounding says
    return (np.asarray(u)[..., None] >= edges).sum(axis=-1)


@dataclass
class Multinomial:
    """A resampling scheme that remembers the uniform numbers it used last."""

    points: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __call__(self, weights: np.ndarray, draws: int, rng: np.random.Generator) -> np.ndarray:
        self.points = np.sort(rng.random(draws))
        return quantile(weights / weights.sum(), self.points)


class Cloud(NamedTuple):
    """Weighted particles of one slice."""

    places: np.ndarray
    weights: np.ndarray


class Step(NamedTuple):
    """A step's particles, and the log of its estimate of the reading's probability."""

    parents: np.ndarray
    places: np.ndarray
    log_evidence: float


class Numbers(NamedTuple):
    """Uniform numbers of a step: for whom a particle descends from, and for where it goes."""

    points: np.ndarray
    moves: np.ndarray


def by_filter(particles: int, seed: int = 0) -> tuple[Cloud, Numbers, Step]:
    """The cloud before the last reading, the numbers that the filter took, and its step (a)."""
    scheme = Multinomial()
    # above one: in every slice, even where weights are equal
    engine = bmc.ParticleFilter(particles, resampling=scheme, ess_threshold=2.0)
    belief = engine.start(ring(), rng=seed)
    for reading in ROWS[:-1]:
        belief = engine.step(belief, {"y": reading})
    before = Cloud(belief.particles("x"), belief.weights)
    after = engine.step(belief, {"y": ROWS[-1]})
    log_evidence = after.log_marginal_likelihood - belief.log_marginal_likelihood
    step = Step(after.ancestors, after.particles("x"), log_evidence)
    return before, Numbers(scheme.points, after.particles("u")), step


def by_mixture(before: Cloud, numbers: Numbers) -> Step:
    """A step (b): a component of the predictive mixture, then a place within it, then weights."""
    component = quantile(before.weights, numbers.points)
    places = quantile(MOVE[before.places[component]], numbers.moves)
    return Step(component, places, float(np.log(READ[places, ROWS[-1]].mean())))


def mixture(before: Cloud) -> np.ndarray:
    """Probabilities of the predictive mixture, shape (places,)."""
    found = bmc.Mixture(before.weights, bmc.Categorical(MOVE[before.places]))
    return np.exp(found.log_prob(np.arange(PLACES)))


def factor_graph(before: Cloud, reading: int | None = None) -> bmc.FactorGraph:
    """Who the parent is, and where it went: w_i p(x | x_i), and p(y | x) where y is given."""
    graph = bmc.FactorGraph("one step")
    graph.variable("parent", len(before.places))
    graph.variable("x", PLACES)
    with np.errstate(divide="ignore"):  # impossible moves
        graph.factor(np.log(before.weights), scope="parent")
        graph.factor(np.log(MOVE[before.places]), scope=("parent", "x"))
    if reading is not None:
        graph.factor(np.log(READ[:, reading]), scope="x")
    return graph


def by_elimination(before: Cloud, numbers: Numbers) -> Step:
    """A step (c): eliminate x, draw the parent; draw x from its table given the parent; then weights."""
    found = bmc.infer(factor_graph(before), engine=bmc.Exact())
    joint = found.probabilities("parent", "x")
    parents = quantile(joint.sum(axis=1), numbers.points)
    places = quantile(joint[parents] / joint[parents].sum(axis=1, keepdims=True), numbers.moves)
    return Step(parents, places, float(np.log(READ[places, ROWS[-1]].mean())))


class Eliminated(NamedTuple):
    """What is left where ``parent``, then ``x`` are summed out and nothing is drawn."""

    predictive: np.ndarray
    filtered: np.ndarray
    log_evidence: float


def eliminated(before: Cloud) -> Eliminated:
    """The predictive, the belief after the reading, and the log of the reading's probability."""
    ahead = bmc.infer(factor_graph(before), engine=bmc.Exact())
    after = bmc.infer(factor_graph(before, ROWS[-1]), engine=bmc.Exact())
    log_evidence = after.log_marginal_likelihood - ahead.log_marginal_likelihood
    return Eliminated(ahead.probabilities("x"), after.probabilities("x"), log_evidence)


def exact() -> tuple[np.ndarray, float]:
    """The belief after the last reading and the log of its probability, without particles."""
    belief = np.full(PLACES, 1 / PLACES)
    for k, reading in enumerate(ROWS):
        belief = (belief @ MOVE if k else belief) * READ[:, reading]
        evidence = belief.sum()
        belief = belief / evidence
    return belief, float(np.log(evidence))


def report(particles: int = 10) -> None:
    """Print a few particles by all three, and what each says of the evidence."""
    before, numbers, filtered = by_filter(particles)
    steps = {
        "(a) filter": filtered,
        "(b) mixture": by_mixture(before, numbers),
        "(c) elimination": by_elimination(before, numbers),
    }
    print(f"  {'numbers':>15}   {'parent, at':>12}   {'(a)  (b)  (c)':>15}   p(reading | x)")
    for j in range(particles):
        parent = filtered.parents[j]
        chance = f"{numbers.points[j]:7.3f} {numbers.moves[j]:7.3f}"
        places = "".join(f"{step.places[j]:5d}" for step in steps.values())
        print(f"  {chance}   {parent:6d} {before.places[parent]:5d}   "
              f"{places}   {READ[filtered.places[j], ROWS[-1]]:10.4f}")  # fmt: skip
    print("  log-evidence of the reading")
    for name, step in steps.items():
        print(f"    {name:33} {step.log_evidence:.12f}")
    print(f"    summed out, which they are on average  {eliminated(before).log_evidence:.6f}")
    print(f"    exact, without particles              {exact()[1]:.6f}")


def draw(particles: int = 80) -> Any:
    """Genealogy of a step, the predictive, and the belief after the reading; places upwards."""
    before, _, step = by_filter(particles, seed=4)
    left, likely = eliminated(before), READ[step.places, ROWS[-1]]
    figure, panels = picture.axes([["a", "b", "c"]], (12, 5.6), sharey=True)
    draw_genealogy(panels["a"], before, step)
    bars(
        panels["b"],
        left.predictive,
        "summed out",
        step.places,
        np.ones(particles),
        "the filter's draws",
    )
    panels["b"].set(title="(b) the predictive mixture", xlabel="probability")
    bars(panels["c"], left.filtered, "summed out", step.places, likely, "the filter's weights")
    panels["c"].plot(exact()[0], range(PLACES), ".", color=picture.EXACT, label="exact belief")
    panels["c"].axhline(ROWS[-1], color=picture.FAINT, ls=":", lw=1, label="reading")
    panels["c"].set(
        title="(c) eliminated, given the reading", xlabel="probability", ylim=(4.5, 19.5)
    )
    for name in "bc":
        panels[name].legend(frameon=False, loc="upper right")
    return figure


def draw_genealogy(ax: Any, before: Cloud, step: Step) -> None:
    """Particles before and after with a line from each to its offspring; areas are weights."""
    jitter = np.random.default_rng(0).uniform(-0.3, 0.3, (2, len(before.places)))
    old, new = before.places + jitter[0], step.places + jitter[1]
    for parent, place in zip(step.parents, new, strict=True):
        ax.plot([0, 1], [old[parent], place], color=picture.DRAWS, lw=0.7, alpha=0.7)
    likely = READ[step.places, ROWS[-1]]
    for at, places, weights, colour in (
        (0, old, before.weights, picture.EXACT),
        (1, new, likely / likely.sum(), picture.OTHER),
    ):
        ax.scatter(
            np.full(len(places), at),
            places,
            4000 * weights,
            color=colour,
            alpha=0.6,
            lw=0,
            zorder=3,
        )
    ax.set(title="(a) resample, then move", ylabel="place", xlim=(-0.25, 1.25))
    ax.set_xticks([0, 1], ["weighted", "moved, weighted anew"])


def bars(ax: Any, probs: np.ndarray, label: str, places: Any, weights: Any, drawn: str) -> None:
    """Probabilities of places as bars, and those of particles as an outline."""
    ax.barh(range(PLACES), probs, 0.9, color=picture.FAINT, alpha=0.55, label=label)
    shares = np.bincount(places, weights, minlength=PLACES) / np.sum(weights)
    edges = np.arange(PLACES + 1) - 0.5
    ax.stairs(shares, edges, orientation="horizontal", color=picture.OTHER, lw=1.3, label=drawn)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a step of a few particles, and draw one of more."""
    options = picture.options(__doc__, arguments)
    print(f"One step of a particle filter, three ways; after readings {ROWS[:-1]} comes {ROWS[-1]}")
    report()
    picture.save(draw(), options.out, "three_views")


if __name__ == "__main__":
    main()
