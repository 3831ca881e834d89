"""Contours, dynamics and edges: against geometry, known recursions and drawn scenes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

import bayesmc as bmc
from bayesmc.errors import ModelError, ModelMisfitWarning, ParameterError, ShapeError
from bayesmc.vision import (
    Contour,
    ContourEdges,
    SecondOrder,
    ShapeSpace,
    as_frames,
    fit_dynamics,
    grey,
)
from examples import rendered, talking_head

CIRCLE = Contour.ellipse((40.0, 30.0), (15.0, 15.0))


def disc(x: float = 40.0, y: float = 30.0) -> np.ndarray:
    rows, columns = np.mgrid[:60, :80]
    return 100.0 * (np.hypot(columns - x, rows - y) < 15)


# ---- frames -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        ([], "no frames"),
        ([np.zeros((4, 6)), np.zeros((4, 5))], r"frame 1 has shape \(4, 5\), and frame 0 \(4, 6\)"),
        ([np.zeros(4)], r"frame 0 has shape \(4,\)"),
        (["a"], "frame 0 is no array"),
        ([np.zeros((4, 6)), [[1.0, 2.0], [3.0]]], "frame 1 is no array"),
    ],
)
def test_frames_that_are_none_are_refused(frames: list, said: str) -> None:
    with pytest.raises(ShapeError, match=said):
        as_frames(frames)


def test_frames_hold_finite_numbers_and_colours_become_grey() -> None:
    with pytest.raises(ParameterError, match="frame 1 holds"):
        as_frames([np.zeros((2, 2)), np.full((2, 2), np.nan)])
    colour = np.zeros((3, 4, 6, 3))
    colour[..., 1] = 10.0
    np.testing.assert_allclose(grey(as_frames(colour)), 5.87)


# ---- contours -----------------------------------------------------------------------------------


def test_a_contour_goes_through_the_points_it_was_made_of() -> None:
    turn = np.linspace(0, 2 * np.pi, 80, endpoint=False)
    points = np.stack([30 + 12 * np.cos(turn), 40 + 20 * np.sin(turn)], axis=-1)
    outline = Contour.through(points)
    apart = np.hypot(*(outline.points(400)[:, None] - points[None]).T).min(axis=1)
    assert apart.max() < 0.2
    half = Contour.through(points[:40], control=8, closed=False)
    np.testing.assert_allclose(half.points(2), points[[0, 39]], atol=0.2)


def test_states_move_and_deform_and_are_found_again() -> None:
    rng = np.random.default_rng(0)
    for kind in ("translation", "similarity", "affine"):
        space = ShapeSpace(CIRCLE, kind)
        state = rng.normal(scale=3.0, size=space.size)
        moved = Contour(space.place(state, CIRCLE.control))
        np.testing.assert_allclose(space.state_of(moved), state, atol=1e-9)
        linear = space.points(np.zeros(space.size), 7) + space.basis(7) @ state
        np.testing.assert_allclose(space.points(state, 7), linear, atol=1e-9)
        points, normals = space.lines(np.zeros(space.size), 16)
        outward = (points - CIRCLE.center) / np.hypot(*(points - CIRCLE.center).T)[:, None]
        np.testing.assert_allclose(normals, outward, atol=5e-3)


def test_contours_that_are_none_are_refused() -> None:
    for control in (np.zeros((3, 2)), np.zeros((5, 3))):
        with pytest.raises(ShapeError, match="four or more points"):
            Contour(control)
    with pytest.raises(ParameterError, match="one spot"):
        Contour(np.ones((5, 2)))
    for axes in (3, (1.0, 2.0, 3.0)):
        with pytest.raises(ShapeError, match="semi_axes is .* a pair of numbers"):
            Contour.ellipse((0.0, 0.0), axes)
    for axes in ((3.0, 0.0), (-3.0, 2.0)):
        with pytest.raises(ParameterError, match="semi_axes must be positive"):
            Contour.ellipse((0.0, 0.0), axes)
    with pytest.raises(ParameterError, match="center must be finite"):
        Contour.ellipse((0.0, np.nan), (3.0, 3.0))
    with pytest.raises(ParameterError, match="'affine'"):
        ShapeSpace(CIRCLE, "projective")
    with pytest.raises(ShapeError, match="6 components"):
        ShapeSpace(CIRCLE).points(np.zeros(4))


# ---- dynamics -----------------------------------------------------------------------------------


def test_a_known_recursion_is_learned() -> None:
    rng = np.random.default_rng(1)
    true = SecondOrder(
        [5.0, -2.0], [[1.6, 0.1], [0.0, 1.5]], [[-0.8, 0.0], [0.05, -0.7]], np.diag([0.5, 1.0])
    )
    x = np.zeros((4000, 2))
    for t in range(2, len(x)):
        x[t] = true.given(x[t - 1], x[t - 2]).sample(rng)
    found = fit_dynamics(x, prior=0.0)
    for name, error in (("last", 0.08), ("earlier", 0.08), ("root", 0.06), ("mean", 0.6)):
        np.testing.assert_allclose(getattr(found, name), getattr(true, name), atol=error)
    assert found.is_stable


def test_dynamics_that_cannot_be_learned_are_refused() -> None:
    with pytest.raises(ShapeError, match="three or more"):
        fit_dynamics(np.zeros((2, 3)))
    with pytest.raises(ParameterError, match="no noise to learn"):
        fit_dynamics(np.zeros((20, 2)))
    with pytest.raises(ParameterError, match="damping"):
        SecondOrder.steady(2, 1.0, damping=2.0)
    with pytest.raises(ShapeError, match=r"noise has shape \(2,\); give one number, or 6"):
        SecondOrder.steady(6, noise=[1.0, 2.0])
    running = 1.2 ** np.arange(30)[:, None] + 0.1 * np.random.default_rng(0).normal(size=(30, 1))
    assert fit_dynamics(running).is_stable  # and does not run away


# ---- edges --------------------------------------------------------------------------------------


def test_one_normal_counts_as_isard_and_blake_say() -> None:
    """One line across one step edge: the density of one feature, at every distance."""
    frame = np.zeros((21, 61))
    frame[:, 31:] = 50.0  # an edge at x = 30.5
    line = Contour([[0.0, 2.0], [0.0, 8.0], [0.0, 12.0], [0.0, 18.0]], closed=False)
    edges = ContourEdges(
        ShapeSpace(line, "translation"), frame.shape, sigma=3.0, reach=12.0, lines=1, missed=0.2,
        clutter=0.05, tempering=1.0,
    )  # fmt: skip
    at = np.array([22.0, 27.0, 30.0, 36.0])
    found = edges.given(np.stack([at, np.zeros(4)], axis=-1)).log_prob(frame)
    near = np.exp(-0.5 * ((np.array([30.0, 31.0])[:, None] - at) / 3) ** 2) / (
        3 * np.sqrt(2 * np.pi)
    )
    both = np.sort(np.log(0.2 + 0.8 / 0.05 * near), axis=0)  # the feature is one of two pixels
    assert ((both[0] - 1e-4 <= found) & (found <= both[1] + 1e-4)).all()


def test_a_normal_that_is_cut_off_counts_for_what_of_it_is_in_the_frame() -> None:
    """Blank frames: the density is the probability of finding nothing, in closed form, and 1 outside."""
    line = Contour([[0.0, 2.0], [0.0, 8.0], [0.0, 12.0], [0.0, 18.0]], closed=False)
    edges = ContourEdges(
        ShapeSpace(line, "translation"), (21, 61), sigma=3.0, reach=12.0, lines=1, missed=0.2,
        tempering=1.0,
    )  # fmt: skip
    at = np.array([30.0, 55.0, 59.0, 62.0, 71.0, 72.0, 90.0, -4.0])
    found = edges.given(np.stack([at, np.zeros(8)], axis=-1)).log_prob(np.full((21, 61), 9.0))
    # what is found stands out from both its neighbours, so it lies in columns 1 to 59
    low, high = np.maximum(0.5 - at, -12.5) / 3, np.minimum(59.5 - at, 12.5) / 3
    seen = np.maximum(ndtr(high) - ndtr(low), 0.0)
    np.testing.assert_allclose(found, np.log(1 - 0.8 * seen), atol=1e-5)
    assert seen[2] > 0.5 and found[-2] == 0.0  # searched in part, and not at all


def test_an_outline_that_is_half_out_is_found_there_and_not_squeezed_into_the_frame() -> None:
    """Between truth and outlines inside, and one along what can be seen of it, which has more normals."""
    disc_at = disc(78.0)
    edges = ContourEdges(ShapeSpace(CIRCLE, "affine"), (60, 80))
    squeezed = [[dx, 0.0, 38.0 - dx - 15.0 + grown, 0.0, 0.0, 0.0]
                for dx in (26.0, 29.0, 32.0, 35.0) for grown in (-2.0, 0.0, 2.0)]  # fmt: skip
    states = np.array(
        [[38.0, 0, 0, 0, 0, 0], *squeezed, [28.0, 0, 0, 0, 0, 0], [70.0, 0, 0, 0, 0, 0]]
    )
    log = edges.given(states).log_prob(disc_at)
    assert log[0] > log[1:].max() + 0.5 and log[-1] == 0.0


def test_the_density_peaks_at_the_outline_and_blank_frames_say_nothing() -> None:
    edges = ContourEdges(ShapeSpace(CIRCLE, "translation"), (60, 80))
    x, y = np.meshgrid(np.arange(-12.0, 13.0), np.arange(-12.0, 13.0))
    states = np.stack([x, y], axis=-1)
    log = edges.given(states).log_prob(disc(44.0, 27.0))
    best = np.unravel_index(log.argmax(), log.shape)
    assert abs(x[best] - 4) <= 1 and abs(y[best] + 3) <= 1
    blank = edges.given(states[9:-9, 9:-9]).log_prob(np.full((60, 80), 7.0))  # all of it inside
    assert np.isfinite(blank).all() and np.ptp(blank) < 1e-4


def test_a_contour_off_the_frame_weighs_nothing_and_nothing_is_lost() -> None:
    """Out of sight is as likely as the frame without the thing, and the filter comes back."""
    edges = ContourEdges(ShapeSpace(CIRCLE, "translation"), (60, 80))
    log = edges.given([[0.0, 0.0], [-20.0, 0.0], [75.0, 0.0], [1e6, -1e6]]).log_prob(disc())
    assert log[0] > 0 > log[1] and log[2] == log[3] == 0.0
    dbn = bmc.DynamicBayesNet()
    dbn.add("shape", lambda shape_prev: bmc.MvNormal(shape_prev, scale_diag=[5.0, 5.0]),
            initial=bmc.MvNormal([0.0, 0.0], scale_diag=[1.0, 1.0]))  # fmt: skip
    dbn.add("frame", lambda shape: edges.given(shape))
    places = np.array([40, 48, 56, 64, 72, 80, 88, 96, 104, 104, 96, 88, 80, 72, 64, 56.0])
    frames = as_frames([disc(x) for x in places])  # out and back
    with np.errstate(all="raise"):
        found = bmc.filter(dbn, {"frame": frames}, engine=bmc.ParticleFilter(600), rng=0)
    off = found.mean("shape") - np.stack([places - 40.0, np.zeros(16)], axis=-1)
    inside = np.flatnonzero(places < 85)  # up to half of it out
    assert np.abs(off[inside]).max() < 3.0, off
    gone = slice(8, 10)
    assert (found.mean("shape")[gone, 0] > 50.0).all() and (found.std("shape")[gone, 0] > 4.0).all()


def test_contours_that_are_all_out_of_sight_are_told() -> None:
    space = ShapeSpace(Contour.ellipse((500.0, 400.0), (15.0, 15.0)), "translation")
    edges = ContourEdges(space, (60, 80))
    with pytest.raises(ModelError, match=r"all of 3 outlines are 4\d\d px or more off the picture"):
        edges.given(np.zeros((3, 2))).log_prob(disc())
    with pytest.warns(ModelMisfitWarning, match="none of several outlines is in the picture"):
        near = edges.given(np.zeros((3, 2)) + [-350.0, -300.0]).log_prob(disc())
    assert (near == 0.0).all()
    with pytest.raises(ParameterError, match="states must be finite"):
        edges.given([[0.0, np.nan], [0.0, 0.0]])


def test_frames_stand_in_plates_and_in_blocks() -> None:
    edges = ContourEdges(ShapeSpace(CIRCLE, "translation"), (60, 80))
    states = np.random.default_rng(0).normal(size=(5, 2, 2))
    frames = np.stack([disc(), disc(45.0)])
    both = edges.given(states).log_prob(frames)
    for k in (0, 1):
        np.testing.assert_allclose(
            both[:, k], edges.given(states[:, k]).log_prob(frames[k]), rtol=1e-5
        )


def test_edges_that_make_no_sense_are_refused() -> None:
    space = ShapeSpace(CIRCLE)
    for options, said in (
        ({"missed": 0.0}, "missed"),
        ({"sigma": -1.0}, "sigma"),
        ({"lines": 0}, "lines"),
    ):
        with pytest.raises(ParameterError, match=said):
            ContourEdges(space, (60, 80), **options)
    with pytest.raises(ShapeError, match="frame_shape"):
        ContourEdges(space, (60,))
    with pytest.raises(ShapeError, match="size|shape"):
        ContourEdges(space, (60, 80)).given(np.zeros(6)).log_prob(np.zeros((50, 80)))


# ---- scenes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["bean"])
def test_a_drawn_outline_is_followed_within_two_pixels(kind: str) -> None:
    """Worst of 12 frames .5 to 1.0 px over seeds; a filter that is shown other frames is far off."""
    clip = talking_head.silhouette(kind, seed=3, steps=12)
    edges = ContourEdges(clip.space, clip.frames.shape[1:])
    states = talking_head.followed(clip, edges, talking_head.plain(6), 0, 500)
    assert max(talking_head.errors(clip, states).values()) < 2.0
    other = clip._replace(frames=talking_head.silhouette("egg", seed=4, steps=12).frames)
    states = talking_head.followed(other, edges, talking_head.plain(6), 0, 200)
    assert max(talking_head.errors(clip, states).values()) > 2.0


def test_the_kalman_filter_goes_off_with_the_decoy() -> None:
    """Particles that are not lost there take long: ``python -m benchmarks.bench_vision decoy``."""
    scene = rendered.with_decoy()
    off = np.hypot(
        *(scene.space.center(talking_head.kalman(scene)) - scene.space.center(scene.states)).T
    )
    assert off[:20].max() < 2.0 and off[-5:].min() > 30.0
