"""Pictures are held by what is drawn on the axes: artists, places, heights; not by pixels."""

from __future__ import annotations

import subprocess
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.patches import Ellipse, FancyArrowPatch, FancyBboxPatch

import bayesmc as bmc
from bayesmc.drawing.layout import Layout, Rectangle, layered_layout
from bayesmc.errors import UnsupportedError
from bayesmc.plotting import plot_dag, plot_marginal, plot_prior_posterior

pyplot.switch_backend("agg")


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    pyplot.close("all")


def mixture() -> bmc.BayesNet:
    net = bmc.BayesNet("mixture", plates={"cluster": 3, "point": 272})
    net.add("weights", bmc.Dirichlet(np.ones(3)))
    net.add("mean", bmc.Normal(0.0, 10.0), plates="cluster")
    net.add("label", lambda weights: bmc.Categorical(weights), plates="point")
    net.add("x", lambda label, mean: bmc.Normal(mean[label], 1.0), plates="point")
    return net


# ---- the graph ----------------------------------------------------------------------------------


def shape_of(ax, name):
    (patch,) = [p for p in ax.patches if p.get_label() == name]
    return patch


def box_of(patch) -> Rectangle:
    extents = patch.get_path().get_extents(patch.get_patch_transform())
    return Rectangle(extents.x0, extents.y0, extents.x1, extents.y1)


def holds(outer: Rectangle, inner: Rectangle) -> bool:
    return (
        outer.left < inner.left
        and outer.bottom < inner.bottom
        and inner.right < outer.right
        and inner.top < outer.top
    )


def overlap(a: Rectangle, b: Rectangle) -> bool:
    return a.left < b.right and b.left < a.right and a.bottom < b.top and b.bottom < a.top


def test_kinds_of_node_look_different() -> None:
    net = bmc.BayesNet()
    net.input("dose")
    net.add("ill", bmc.Bernoulli(0.2))
    net.add("effect", lambda ill, dose: dose * (1.0 - ill))
    net.add("pulse", lambda effect: bmc.Normal(effect, 1.0))
    net.add("fever", lambda ill: bmc.Normal(37.0 + ill, 0.5))
    ax = plot_dag(net, observed={"fever": 38.0})
    assert isinstance(shape_of(ax, "ill"), FancyBboxPatch)
    assert isinstance(shape_of(ax, "pulse"), Ellipse)
    assert shape_of(ax, "dose").get_linestyle() != shape_of(ax, "ill").get_linestyle()
    assert shape_of(ax, "fever").get_facecolor() != shape_of(ax, "pulse").get_facecolor()
    rings = [p for p in ax.patches if isinstance(p, Ellipse) and p.get_facecolor()[3] == 0]
    assert len(rings) == 2  # the second border of `effect`, and of its legend entry
    texts = {t.get_text() for t in ax.texts}
    assert texts == {*net, "continuous", "discrete", "input", "deterministic", "observed"}


def test_every_edge_has_an_arrow_that_ends_at_the_borders() -> None:
    net = mixture()
    ax = plot_dag(net)
    arrows = [p for p in ax.patches if isinstance(p, FancyArrowPatch)]
    assert len(arrows) == net.graph.number_of_edges()
    boxes = [box_of(shape_of(ax, name)) for name in net]
    for arrow in arrows:
        path = arrow._path_original.vertices
        for x, y in path:
            assert not any(overlap(_shrunk(b), Rectangle(x, y, x, y)) for b in boxes)
        for end in (path[0], path[-1]):
            assert min(_distance(b, end) for b in boxes) < 0.12


def _shrunk(box: Rectangle) -> Rectangle:
    """The middle of a node, which an ellipse of that size surely covers."""
    across, up = 0.3 * (box.right - box.left) / 2, 0.3 * (box.top - box.bottom) / 2
    return Rectangle(box.left + across, box.bottom + up, box.right - across, box.top - up)


def _distance(box: Rectangle, point) -> float:
    dx = max(box.left - point[0], 0, point[0] - box.right)
    dy = max(box.bottom - point[1], 0, point[1] - box.top)
    return float(np.hypot(dx, dy))


def test_plates_hold_their_members_only_and_say_their_size() -> None:
    net = mixture()
    ax = plot_dag(net)
    for plate in ("cluster", "point"):
        outer = box_of(shape_of(ax, f"plate {plate}"))
        for name in net:
            inside = plate in net[name].plates
            box = box_of(shape_of(ax, name))
            assert holds(outer, box) if inside else not overlap(outer, box)
    texts = {t.get_text() for t in ax.texts}
    assert {"cluster: 3", "point: 272"} <= texts


def test_plate_of_open_size_shows_its_name() -> None:
    net = bmc.BayesNet(plates={"row": None})
    net.add("x", bmc.Normal(0.0, 1.0), plates="row")
    assert "row" in {t.get_text() for t in plot_dag(net).texts}


def test_potential_is_drawn_without_an_arrowhead() -> None:
    net = bmc.BayesNet()
    net.add("a", bmc.Normal(0.0, 1.0))
    net.add("b", bmc.Normal(0.0, 1.0))
    net.potential("near", lambda a, b: -np.abs(a - b))
    ax = plot_dag(net)
    lines = [p for p in ax.patches if isinstance(p, FancyArrowPatch)]
    assert len(lines) == 2
    assert "near" in {t.get_text() for t in ax.texts}
    assert all(type(p.get_arrowstyle()).__name__ == "Curve" for p in lines)


def test_draws_on_given_axes_at_their_scale() -> None:
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(4, 2))
    assert plot_dag(mixture(), ax=left) is left
    assert not right.patches
    assert left.texts[0].get_fontsize() < 8  # a picture of 2.5 by 4 inches in less than 2 by 2
    assert len(figure.axes) == 2


def test_unknown_observed_node_is_an_error() -> None:
    with pytest.raises(bmc.errors.UnknownNodeError, match="lable"):
        plot_dag(mixture(), observed=["lable"])


def test_odd_names_are_drawn_as_they_stand() -> None:
    net = bmc.BayesNet()
    net.add("x[0]", bmc.Normal(0.0, 1.0))
    net.add("price $a_b$", bmc.Normal(0.0, 1.0))
    ax = plot_dag(net)
    ax.figure.canvas.draw()
    assert {"x[0]", "price $a_b$"} <= {t.get_text() for t in ax.texts}


# ---- the layout ---------------------------------------------------------------------------------


def random_dag(seed: int, count: int) -> tuple[list, dict]:
    rng = np.random.default_rng(seed)
    names = [f"n{i}" for i in range(count)]
    edges = [
        (names[j], names[i])
        for i in range(1, count)
        for j in rng.choice(i, size=min(i, int(rng.integers(0, 4))), replace=False)
    ]
    kinds = [(), ("a",), ("b",), ("a", "c")]
    return edges, {name: kinds[int(rng.integers(4))] for name in names}


def boxes_of(layout: Layout, sizes: dict) -> dict[str, Rectangle]:
    return {
        n: Rectangle(x - w / 2, y - h / 2, x + w / 2, y + h / 2)
        for n, (x, y) in layout.centres.items()
        for w, h in [sizes[n]]
    }


@pytest.mark.parametrize("seed", range(12))
def test_random_layouts_are_clean(seed: int) -> None:
    edges, plates = random_dag(seed, count=6 + 2 * seed)
    sizes = {name: (0.5 + 0.1 * (i % 5), 0.4) for i, name in enumerate(plates)}
    layout = layered_layout(edges, plates, sizes)
    boxes = boxes_of(layout, sizes)
    assert not any(overlap(a, b) for a, b in combinations(boxes.values(), 2))
    for parent, child in edges:
        assert boxes[parent].bottom > boxes[child].top
        route = layout.routes[parent, child]
        assert route[0] == layout.centres[parent]
        assert route[-1] == layout.centres[child]
        for x, y in route[1:-1]:  # where it bends, it is clear of every node
            assert not any(overlap(box, Rectangle(x, y, x, y)) for box in boxes.values())
    for plate, outer in layout.plates.items():
        assert all(holds(outer, boxes[n]) for n, own in plates.items() if plate in own)


@pytest.mark.parametrize("seed", range(12))
def test_plates_keep_outsiders_out(seed: int) -> None:
    edges, plates = random_dag(seed, count=8)
    plates = {name: () if own == ("b",) else own for name, own in plates.items()}
    sizes = dict.fromkeys(plates, (0.6, 0.4))
    layout = layered_layout(edges, plates, sizes)
    boxes = boxes_of(layout, sizes)
    inside = {
        (plate, name)
        for plate, outer in layout.plates.items()
        for name, box in boxes.items()
        if overlap(outer, box)
    }
    assert inside == {(plate, name) for name, own in plates.items() for plate in own}


def test_layout_is_the_same_every_time() -> None:
    edges, plates = random_dag(3, count=15)
    sizes = dict.fromkeys(plates, (0.6, 0.4))
    assert layered_layout(edges, plates, sizes) == layered_layout(edges, plates, sizes)


def test_a_tree_has_no_crossings_and_parents_over_their_children() -> None:
    edges = [("r", "a"), ("r", "b"), ("a", "c"), ("a", "d"), ("b", "e"), ("b", "f")]
    names = dict.fromkeys("rabcdef", ())
    centres = layered_layout(edges, names, dict.fromkeys(names, (0.5, 0.4))).centres
    order = sorted("cdef", key=lambda n: centres[n][0])
    assert {frozenset(order[:2]), frozenset(order[2:])} == {frozenset("cd"), frozenset("ef")}
    for parent, pair in (("a", "cd"), ("b", "ef"), ("r", "ab")):
        assert centres[parent][0] == pytest.approx(np.mean([centres[n][0] for n in pair]))


def test_a_template_is_drawn_over_two_slices() -> None:
    """Frames hold their slice only, arrows cross from one to the other, static nodes stand outside."""
    dbn = bmc.DynamicBayesNet(plates={"beacon": 3})
    dbn.input("u")
    dbn.add_static("bias", bmc.Normal(0.0, 1.0))
    dbn.add("x", lambda x_prev, u, t: bmc.Normal(x_prev + u, 1.0 + t), initial=bmc.Normal(0.0, 1.0))
    dbn.add(
        "y",
        lambda x, y_prev, bias: bmc.Normal(x + 0.1 * y_prev + bias, 1.0),
        initial=lambda x: bmc.Normal(x, 1.0),
        plates="beacon",
    )
    ax = plot_dag(dbn, observed={"y": 0})
    before, now = (box_of(shape_of(ax, f"plate slice {t}")) for t in ("t - 1", "t"))
    assert not overlap(before, now)
    for name, outer in (("x_prev", before), ("y_prev", before), ("x", now), ("y", now), ("u", now)):
        assert holds(outer, box_of(shape_of(ax, name))), name
    bias = box_of(shape_of(ax, "bias"))
    assert not overlap(before, bias) and not overlap(now, bias)
    assert len([p for p in ax.patches if isinstance(p, FancyArrowPatch)]) == 5


def test_empty_net_is_drawn() -> None:
    assert not plot_dag(bmc.BayesNet()).patches


# ---- marginals ----------------------------------------------------------------------------------


def weather() -> bmc.BayesNet:
    net = bmc.BayesNet()
    net.add("rain", bmc.Bernoulli(0.2), states=("no", "yes"))
    net.add("level", lambda rain: bmc.Normal(np.where(rain == "yes", 3.0, 1.0), 0.5))
    net.add("guests", bmc.Poisson(2.0))
    return net


def weighted(evidence: dict, draws: int = 20_000) -> bmc.Posterior:
    return bmc.infer(weather(), evidence, engine=bmc.LikelihoodWeighting(draws), rng=0)


def test_bars_are_the_probabilities() -> None:
    posterior = bmc.infer(weather(), {"level": 2.2, "guests": 3}, engine=bmc.Exact())
    ax = plot_marginal(posterior, "rain")
    heights = [bar.get_height() for bar in ax.patches]
    np.testing.assert_allclose(heights, posterior.probabilities("rain"))
    assert [t.get_text() for t in ax.get_xticklabels()] == ["no", "yes"]


def test_counts_are_drawn_as_weighted_bars() -> None:
    ax = plot_marginal(weighted({}), "guests")
    heights = np.array([bar.get_height() for bar in ax.patches])
    assert heights.sum() == pytest.approx(1)
    # P(0) = exp(-2); the error of 20,000 draws is .0024, four of them make a false alarm of 6e-5
    assert heights[0] == pytest.approx(np.exp(-2), abs=0.01)


def test_densities_are_weighted_and_integrate_to_one() -> None:
    posterior = weighted({"rain": "yes"})  # the prior's draws lie at 1, the posterior's at 3
    ax = plot_marginal(posterior, "level")
    (line,) = ax.lines
    x, y = line.get_data()
    assert np.trapezoid(y, x) == pytest.approx(1, abs=0.02)
    assert x[np.argmax(y)] == pytest.approx(3, abs=0.2)
    (histogram,) = ax.patches
    values, edges, _ = histogram.get_data()
    assert (values * np.diff(edges)).sum() == pytest.approx(1, abs=0.02)


def test_element_of_a_plate_is_chosen_by_index() -> None:
    net = bmc.BayesNet(plates={"room": 3})
    net.add("heat", bmc.Normal([0.0, 50.0, 100.0], 1.0), plates="room")
    posterior = bmc.infer(net, {}, engine=bmc.LikelihoodWeighting(2000), rng=0)
    ax = plot_marginal(posterior, "heat", 1)
    x, y = ax.lines[0].get_data()
    assert x[np.argmax(y)] == pytest.approx(50, abs=1)
    assert ax.get_xlabel() == "heat[1]"
    with pytest.raises(bmc.errors.UnsupportedError, match="index"):
        plot_marginal(posterior, "heat")


def test_prior_beside_posterior() -> None:
    axes = plot_prior_posterior(weighted({}), weighted({"level": 2.4}), ["rain", "guests"])
    heights = [[bar.get_height() for bar in container] for container in axes[0].containers]
    assert heights[0] == pytest.approx([0.8, 0.2], abs=0.015)
    assert heights[1][1] > 0.5
    assert [t.get_text() for t in axes[0].get_legend().get_texts()] == ["prior", "posterior"]


def test_names_default_to_what_is_not_observed() -> None:
    axes = plot_prior_posterior(weighted({}), weighted({"level": 2.4}))
    assert [ax.get_title() for ax in axes] == ["rain", "guests"]
    with pytest.raises(ValueError, match="1 axes for 2 names"):
        plot_prior_posterior(weighted({}), weighted({}), ["rain", "level"], axes=list(axes[:1]))


def test_wide_prior_does_not_hide_the_posterior() -> None:
    net = bmc.BayesNet()
    net.add("mu", bmc.Normal(0.0, 1000.0))
    net.add("y", lambda mu: bmc.Normal(mu, 20.0))
    before, after = (
        bmc.infer(net, e, engine=bmc.LikelihoodWeighting(20_000), rng=0) for e in ({}, {"y": 0.0})
    )
    (ax,) = plot_prior_posterior(before, after, ["mu"])
    shown = ax.lines[1].get_data()
    high = shown[0][shown[1] > 0.1 * shown[1].max()]
    assert np.ptp(high) > 0.05 * np.ptp(shown[0])


# ---- without matplotlib -------------------------------------------------------------------------


def test_without_matplotlib_the_error_names_the_extra(tmp_path: Path) -> None:
    (tmp_path / "matplotlib.py").write_text("raise ImportError('absent')\n")
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import bayesmc as bmc, bayesmc.plotting as plotting\n"
        "try:\n    plotting.plot_dag(bmc.BayesNet())\n"
        "except bmc.errors.MissingExtraError as error:\n    print(error)\n"
    )
    root = Path(__file__).resolve().parents[1]
    ran = subprocess.run([sys.executable, "-c", code, str(tmp_path)], cwd=root, text=True,
                         capture_output=True, check=True)  # fmt: skip
    assert "pip install 'bayesmc[plot]'" in ran.stdout


def test_an_exact_marginal_is_drawn_as_the_curve_it_is() -> None:
    net = bmc.BayesNet()
    net.add("s", bmc.Bernoulli(0.3))
    net.add("x", lambda s: bmc.Normal(4.0 * s, 0.5))
    posterior = bmc.infer(net, engine=bmc.Exact())
    ax = plot_marginal(posterior, "x")
    (line,) = ax.get_lines()
    points, heights = line.get_data()
    expected = np.exp(bmc.Mixture([0.7, 0.3], bmc.Normal([0.0, 4.0], 0.5)).log_prob(points))
    np.testing.assert_allclose(heights, expected, atol=1e-12)
    assert points[0] < -1.2 and points[-1] > 5.2
    pyplot.close(ax.figure)


def test_densities_of_draws_end_where_the_support_does() -> None:
    net = bmc.BayesNet()
    net.add("s", bmc.HalfNormal(5.0))
    net.add("u", bmc.Uniform(0.0, 1.0))
    prior = bmc.prior_predict(net, 4000, rng=0)
    for name, low, high, height in (
        ("s", 0.0, np.inf, 2 / (5 * np.sqrt(2 * np.pi))),
        ("u", 0, 1, 1),
    ):
        (line,) = plot_marginal(prior, name).get_lines()
        points, heights = line.get_data()
        assert points[0] == low and points[-1] <= high
        assert heights[0] == pytest.approx(height, rel=0.15)  # half of it without the reflection
        assert np.trapezoid(heights, points) == pytest.approx(1.0, abs=0.01)
        assert prior.marginal(name).density([-0.1]) == 0.0
    for ax in plot_prior_posterior(prior, prior, ["s", "u"]):
        assert ax.get_lines()[0].get_xdata()[0] == 0.0


@pytest.mark.parametrize("picture", ["forest", "pair", "marginal"])
def test_beliefs_over_time_say_which_pictures_they_have(picture: str) -> None:
    dbn = bmc.DynamicBayesNet()
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 3.0))
    dbn.add("y", lambda x: bmc.Normal(x, 1.5))
    for engine in (bmc.KalmanFilter(), bmc.GridFilter(), bmc.ParticleFilter(50)):
        filtered = bmc.filter(dbn, {"y": [1.0, 2.0]}, engine=engine, rng=0)
        with pytest.raises(UnsupportedError, match=rf"plot_{picture}: .* bands\(name\)"):
            getattr(filtered.plot, picture)("x")
