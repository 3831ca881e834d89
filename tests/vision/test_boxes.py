"""Boxes: detections as evidence and as proposal, who they are of, histograms, and a trained detector."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.testing import session
from bayesmc.vision import (
    BoxDetections,
    BoxMotion,
    Histograms,
    boosted,
    claims,
    iou,
    left_free,
    padded,
    precision_recall,
    train_detector,
)
from bayesmc.vision.haar import KINDS, HaarFeatures
from examples import pedestrians, rendered

SHAPE = (100, 200)


def test_overlap_and_scores() -> None:
    assert iou([[5, 5, 10, 10]], [[5, 5, 10, 10], [10, 5, 10, 10], [50, 50, 1, 1]]).round(
        3
    ).tolist() == [[1.0, 0.333, 0.0]]
    one, far = [5.0, 5.0, 10.0, 10.0], [90.0, 5.0, 10.0, 10.0]
    found = precision_recall([[one, one, far], []], [[one], [one]])  # doubles do not count twice
    assert found == (1 / 3, 1 / 2, 1, 3, 2)
    assert np.isnan(precision_recall([[]], [[]]).precision)
    with pytest.raises(ShapeError, match="2 frames are true"):
        precision_recall([[]], [[], []])


def test_rows_are_filled_up_and_faults_are_named() -> None:
    found = padded([[], [[1.0, 2.0, 3.0, 4.0, 0.5]]], most=2)
    assert found.shape == (2, 2, 5) and not found[0].any()
    with pytest.raises(ShapeError, match="frame 0"):
        padded([[[1.0, 2.0]]])
    with pytest.raises(ParameterError, match="frame 1"):
        padded([[], [[1.0, 2.0, 0.0, 4.0, 0.5]]])
    with pytest.raises(ShapeError, match="most=1"):
        padded([[[1.0, 2.0, 3.0, 4.0, 0.5]] * 2], most=1)


def test_scores_and_shares_that_are_no_probabilities_are_refused() -> None:
    state, motion = [50.0, 40.0, 2.0, 3.0, 0.0, 0.0], BoxMotion()
    for score in (90.0, -1.0):
        row = [[10.0, 20.0, 4.0, 8.0, score]]
        with pytest.raises(ParameterError, match=r"frame 1 scores .* got .*logistic"):
            padded([[], row])
        with pytest.raises(ParameterError, match="BoxDetections: scores"):
            BoxDetections(SHAPE).given(state, True, [1.0]).log_prob(row)
        with pytest.raises(ParameterError, match="boosted: scores"):
            boosted(motion.given(state), row, [1.0])
    good = [[10.0, 20.0, 4.0, 8.0, 1.0]]
    for free in (2.0, -1.0, np.nan):
        with pytest.raises(ParameterError, match="given: free are probabilities"):
            BoxDetections(SHAPE).given(state, True, [free])
        with pytest.raises(ParameterError, match="boosted: free are probabilities"):
            boosted(motion.given(state), good, [free])
    dbn = bmc.DynamicBayesNet()
    dbn.add("box", lambda box_prev: motion.given(box_prev), initial=motion.given(state))
    dbn.add("boxes", lambda box: BoxDetections(SHAPE).given(box, True, np.ones(1)))
    dbn.validate()


def test_boxes_and_frames_without_a_size_are_refused() -> None:
    for shape in ((160,), (0, 0)):
        with pytest.raises(ShapeError, match="BoxDetections: frame_shape"):
            BoxDetections(shape)
    with pytest.raises(ParameterError, match="negative"):
        iou([[0.0, 0.0, 2.0, 2.0]], [[0.0, 0.0, -2.0, 2.0]])
    with pytest.raises(ParameterError, match="no width or height"):
        Histograms((20, 30)).of(np.full((20, 30), 9.0), [5.0, 5.0, 0.0, 4.0])


def test_detections_weigh_as_one_thing_in_clutter() -> None:
    reads = BoxDetections(SHAPE, detected=0.9, place=0.05, size=0.1, clutter=2.0)
    state = np.array([50.0, 40.0, np.log(10.0), np.log(20.0), 0.0, 0.0])
    row = [51.0, 40.0, 10.0, 22.0, 0.8]
    seen = padded([[row, [150.0, 50.0, 10.0, 20.0, 0.5]]], most=3)[0]
    normal = bmc.MvNormal(state[:4], scale_diag=[1.0, 1.0, 0.1, 0.1])
    near = float(np.exp(normal.log_prob([51.0, 40.0, np.log(10.0), np.log(22.0)])))
    expected = 0.1 + 0.5 * 0.9 * 4.0 * near * 4 * 100 * 200 / 2.0
    free = [0.5, 1.0, 1.0]
    log = reads.given(state, [True, False], free).log_prob(seen)
    np.testing.assert_allclose(log, [np.log(expected), 0.0], rtol=1e-9)
    assert np.isclose(reads.given(state, True, free).log_prob(np.zeros((3, 5))), np.log(0.1))
    with pytest.raises(ShapeError, match="log width"):
        reads.given([1.0, 2.0], True, free)
    with pytest.raises(ParameterError, match="detected"):
        BoxDetections(SHAPE, detected=1.0)
    with pytest.raises(ParameterError, match="damping"):
        BoxMotion(damping=2.0)


# ---- the boosted proposal -----------------------------------------------------------------------

PRIOR = bmc.MvNormal([50.0, 40.0, 2.0, 3.0, 0.0, 0.0], scale_diag=[6.0, 6.0, 0.2, 0.2, 1.0, 1.0])
SEEN = np.array([[58.0, 44.0, 8.0, 22.0, 0.9], [70.0, 40.0, 8.0, 20.0, 0.6], [0.0] * 5])
READING, NOISE = np.array([60.0, 43.0]), 2.0


def posterior_errors(proposal: Any, seed: int, runs: int = 30) -> np.ndarray:
    """Standard scores of evidence and mean against the exact ones, over independent runs."""
    dbn = bmc.DynamicBayesNet()
    dbn.add("box", PRIOR)
    dbn.add("reading", lambda box: bmc.MvNormal(box[..., :2], scale_diag=[NOISE, NOISE]))
    engine = bmc.ParticleFilter(1500, ess_threshold=0.0, initial_proposal={"box": lambda: proposal})
    found = []
    for k in range(runs):
        run = bmc.filter(dbn, {"reading": READING[None]}, engine=engine, rng=[seed, k])
        found.append([np.exp(run.log_marginal_likelihood), *run.mean("box")[0, :2]])
    var = 36.0 / (36.0 + NOISE**2)
    mean = PRIOR.mean[:2] + var * (READING - PRIOR.mean[:2])
    law = bmc.Normal(PRIOR.mean[:2], np.sqrt(36.0 + NOISE**2))
    exact = np.array([np.exp(law.log_prob(READING).sum()), *mean])
    values = np.array(found)
    return (values.mean(axis=0) - exact) / (values.std(axis=0, ddof=1) / np.sqrt(runs))


class WithoutRatio(bmc.Mixture):
    """A fault: draws of the mixture that are weighed as if they were the transition's (p/q left out)."""

    def _log_prob(self, x: np.ndarray) -> np.ndarray:
        return PRIOR.log_prob(x)


def test_weights_make_up_for_the_boosted_proposal_and_p_over_q_is_needed() -> None:
    """Three scores of 30 runs beyond 5: false alarms below 1e-4. Without p/q they are beyond 50."""
    good = boosted(PRIOR, SEEN, np.ones(3), share=0.7)
    seed = session.seed()
    assert np.abs(posterior_errors(good, seed)).max() < 5.0
    fault = WithoutRatio(good.weights, good.components)
    assert np.abs(posterior_errors(fault, seed)).max() > 8.0


def test_the_mixture_is_what_it_says() -> None:
    mixture = boosted(PRIOR, SEEN, [1.0, 0.5, 1.0], share=0.5)
    np.testing.assert_allclose(mixture.weights, [0.5, 0.375, 0.125, 0.0])  # scores .9 and .5 * .6
    nothing = boosted(PRIOR, SEEN, np.zeros(3))
    x = PRIOR.sample(rng=0, sample_shape=5)
    np.testing.assert_allclose(nothing.log_prob(x), PRIOR.log_prob(x))
    with pytest.raises(ParameterError, match="never drawn"):
        boosted(PRIOR, SEEN, np.ones(3), share=1.0)


# ---- who detections are of ----------------------------------------------------------------------


def test_claims_are_near_to_all_assignments_summed() -> None:
    """Belief propagation against enumeration: within .1, exact where things do not share detections."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        ratios = rng.gamma(0.5, 4.0, size=(3, 3))
        total, marginal = 0.0, np.zeros((3, 3))
        for chosen in itertools.product(range(-1, 3), repeat=3):
            taken = [j for j in chosen if j >= 0]
            if len(set(taken)) == len(taken):
                weight = np.prod([ratios[k, j] if j >= 0 else 1.0 for k, j in enumerate(chosen)])
                total += weight
                for k, j in enumerate(chosen):
                    if j >= 0:
                        marginal[k, j] += weight
        np.testing.assert_allclose(claims(ratios), marginal / total, atol=0.1)
    apart = np.diag([3.0, 1.0, 9.0])
    np.testing.assert_allclose(claims(apart), np.diag([0.75, 0.5, 0.9]), atol=1e-9)
    assert claims(np.zeros((2, 0))).shape == (2, 0)
    assert left_free([[1.0, 0.2], [0.0, 0.3]]).round(6).tolist() == [[1.0, 0.7], [0.0, 0.8]]
    with pytest.raises(ParameterError, match="negative"):
        claims([[-1.0]])
    with pytest.raises(ShapeError, match="things, detections"):
        claims([1.0])


def synthetic(seed: int = 0) -> pedestrians.Clip:
    """Walkers whose boxes are seen with noise, misses and clutter."""
    rng, made = np.random.default_rng(seed), rendered.walkers(seed, 30)
    rows = []
    for boxes in made.boxes:
        seen = boxes[rng.random(len(boxes)) < 0.85]
        noisy = seen[:, :4] + rng.normal(size=(len(seen), 4)) * [1.0, 1.0, 0.5, 1.0]
        found = [np.append(row, rng.uniform(0.7, 0.99)) for row in noisy]
        if rng.random() < 0.2:
            found.append(
                np.array([*rng.uniform([0, 40], [160, 90]), 15.0, 38.0, rng.uniform(0.3, 0.6)])
            )
        rows.append(np.array(found).reshape(-1, 5))
    return pedestrians.Clip("made", padded(rows), made.boxes, (rendered.HEIGHT, rendered.WIDTH))


def test_several_come_and_go_and_boosted_proposals_are_ahead_at_equal_particles() -> None:
    clip = synthetic()
    scores = {}
    for guided in (True, False):
        found = pedestrians.Tracker(clip, 300, guided, speed=0.05).follow(clip.detections, 0)
        scores[guided] = precision_recall(found, clip.truth)
    assert scores[True].recall > 0.75 and scores[True].precision > 0.75
    assert scores[True].recall > scores[False].recall + 0.2


# ---- histograms ---------------------------------------------------------------------------------


def test_histograms_count_pixels_and_frames_that_do_not_fit_are_refused() -> None:
    rng = np.random.default_rng(0)
    frame = rng.integers(0, 256, size=(30, 40)).astype(float)
    looks = Histograms(frame.shape, bins=4)
    found = looks.of(frame, [[9.5, 14.5, 10.0, 6.0], [500.0, 0.0, 4.0, 4.0]])
    counted = np.histogram(frame[12:18, 5:15], bins=4, range=(0, 256))[0] / 60
    np.testing.assert_allclose(found, [counted, np.full(4, 0.25)])
    with pytest.raises(ShapeError, match=r"\(30, 40\)"):
        looks.of(frame[:-1], [[1.0, 1.0, 2.0, 2.0]])
    with pytest.raises(ParameterError, match="no reference"):
        looks.given(np.zeros(6))
    with pytest.raises(ShapeError, match="4 cells"):
        Histograms(frame.shape, np.ones(3), bins=4)
    known = Histograms(frame.shape, counted, bins=4)
    state = [9.5, 14.5, np.log(10.0), np.log(6.0), 0.0, 0.0]
    np.testing.assert_allclose(known.given(state, [1, 0]).log_prob(frame), [10.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("white", [1.0, 255.0, 65535.0])
def test_histograms_go_by_what_white_is(white: float) -> None:
    """Frames of other ranges answer as those in 0..255 do, and not with one bin for all pixels."""
    frame = np.linspace(0, 255, 600).reshape(20, 30)
    box, scaled = [12.0, 9.0, 8.0, 8.0], frame * white / 255
    plain = Histograms(frame.shape).of(frame, box)
    np.testing.assert_allclose(Histograms(frame.shape, white=white).of(scaled, box), plain)
    other = Histograms(frame.shape, plain, white=255.0 if white != 255 else 1.0)
    state = [12.0, 9.0, 2.0, 2.0, 0.0, 0.0]
    for ask in (lambda: other.of(scaled, box), lambda: other.given(state).log_prob(scaled)):
        with pytest.raises(ParameterError, match="white="):
            ask()
    dark = Histograms(frame.shape, plain).given(state)
    assert np.isfinite(dark.log_prob(np.zeros(frame.shape)))
    assert np.isfinite(dark.log_prob(np.eye(20, 30)))  # whole numbers, all but dark
    with pytest.raises(ParameterError, match="white must be positive"):
        Histograms(frame.shape, white=0.0)


def test_colours_are_told_apart_that_are_one_grey() -> None:
    pytest.importorskip("skimage", reason="needs the extra [vision]")
    frame = np.zeros((20, 40, 3))
    frame[:, :20] = [200.0, 20.0, 20.0]
    frame[:, 20:] = [20.0, 200.0, 20.0]
    plain = Histograms(frame.shape)
    red = Histograms(frame.shape, plain.of(frame, [9.5, 9.5, 10.0, 10.0]))
    state = np.array([[9.5, 9.5, 2.0, 2.0, 0, 0], [30.0, 9.5, 2.0, 2.0, 0, 0]])
    np.testing.assert_allclose(red.given(state).log_prob(frame), [10.0, -10.0], atol=1e-9)


# ---- the detector -------------------------------------------------------------------------------


def test_haar_features_are_those_of_scikit_image() -> None:
    pytest.importorskip("skimage", reason="needs the extra [vision]")
    from skimage.feature import haar_like_feature, haar_like_feature_coord
    from skimage.transform import integral_image

    rng = np.random.default_rng(0)
    patch = rng.random((8, 6))
    patch = (patch - patch.mean()) / patch.std()
    for kind in KINDS:
        coords, _ = haar_like_feature_coord(6, 8, kind)
        theirs = haar_like_feature(integral_image(patch), 0, 0, 6, 8, kind)
        ours = HaarFeatures.drawn(8, 6, 10_000, np.random.default_rng(1))
        values = ours.of(patch, [0], [0])[0] * patch.size
        assert len(theirs) == len(coords)
        # all of them are drawn, in another order
        missing = [v for v in theirs if np.abs(np.abs(values) - abs(v)).min() > 1e-8]
        assert missing == []


def test_a_detector_finds_walkers_of_another_scene() -> None:
    """Measured: precision .9, recall .8; trained on what is above the walkers it finds next to none."""
    pytest.importorskip("skimage", reason="needs the extra [vision]")
    pytest.importorskip("sklearn", reason="needs the extra [vision]")
    train, test = rendered.walkers(0), rendered.walkers(1)
    options = {"features": 120, "rounds": 20, "mining": 1, "rng": 0}
    frames, boxes = train.frames[8::6], train.boxes[8::6]
    found = train_detector(frames, boxes, **options)
    shown = range(10, 40, 8)
    truth = [test.boxes[k] for k in shown]
    score = precision_recall([found.detect(test.frames[k], 0.9) for k in shown], truth)
    assert score.precision > 0.6 and score.recall > 0.5
    wrong = train_detector(
        frames, [rows - [0, 45, 0, 0, 0] for rows in boxes], **(options | {"mining": 0})
    )
    other = precision_recall([wrong.detect(test.frames[k], 0.9) for k in shown], truth)
    assert not other.recall > 0.3


def test_training_that_cannot_be_is_refused() -> None:
    frames = np.zeros((2, 40, 60))
    with pytest.raises(ShapeError, match="2 frames and boxes of 1"):
        train_detector(frames, [[]])
    with pytest.raises(ParameterError, match="two boxes"):
        train_detector(frames, [[], []])
    with pytest.raises(ParameterError, match="outside the frame"):
        train_detector(frames, [[[200.0, 10.0, 5.0, 5.0]], []])
    with pytest.raises(ParameterError, match="no size"):
        train_detector(frames, [[[20.0, 10.0, 0.0, 5.0]], []])
