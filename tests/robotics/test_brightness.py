"""The ceiling's brightness against SciPy's interpolation, and what a reading says of places."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

import bayesmc as bmc
from bayesmc.errors import ParameterError, ShapeError
from bayesmc.robotics.brightness import Ceiling

IMAGE = np.random.default_rng(0).random((12, 7))


@pytest.mark.parametrize("shape", [(12, 7), (1, 7), (12, 1), (1, 1)])
def test_interpolation(shape: tuple[int, int]):
    image = IMAGE[: shape[0], : shape[1]]
    ceiling = Ceiling(image, 0.5, origin=(-2.0, 1.0))
    places = np.random.default_rng(1).uniform((-4.0, 0.0), (5.0, 6.0), (200, 2))
    cells = (places - ceiling.origin) / 0.5 - 0.5
    expected = ndimage.map_coordinates(image, cells.T, order=1, mode="nearest")
    np.testing.assert_allclose(ceiling.brightness(places), expected, atol=1e-12)


def test_centres_poses_and_shapes():
    ceiling = Ceiling(IMAGE, 0.5, origin=(-2.0, 1.0))
    assert ceiling.extent == (-2.0, 4.0, 1.0, 4.5)
    pose = np.array([[[-2.0 + 0.25, 1.0 + 0.75, 3.0]]])
    assert ceiling.brightness(pose).shape == (1, 1)
    assert ceiling.brightness(pose)[0, 0] == pytest.approx(IMAGE[0, 1])
    assert np.isnan(ceiling.brightness([np.nan, 1.0]))
    assert ceiling.brightness([1e300, -1e300]) == IMAGE[-1, 0]


def test_likelihood_image():
    ceiling = Ceiling(IMAGE, 0.5)
    image = ceiling.likelihood_image(0.4, 0.1)
    assert image.shape == IMAGE.shape and image.max() == 1.0
    assert np.unravel_index(image.argmax(), image.shape) == np.unravel_index(
        np.abs(IMAGE - 0.4).argmin(), IMAGE.shape
    )
    one, two = image[0, 0], image[5, 5]
    log = -0.5 * ((IMAGE[0, 0] - 0.4) ** 2 - (IMAGE[5, 5] - 0.4) ** 2) / 0.01
    assert np.log(one / two) == pytest.approx(log)
    assert np.isfinite(ceiling.likelihood_image(1e4, 0.1)).all()  # no cell fits: still a picture


def test_a_robot_under_a_ramp():
    """Brightness grows along x: the sensor finds x and says nothing of y (a conjugate normal)."""
    ramp = Ceiling(np.arange(20.0)[:, None] * np.ones((1, 20)), 0.5)
    net = bmc.BayesNet()
    net.add("place", bmc.MvNormal([5.0, 5.0], scale_diag=[1.0, 1.0]))
    net.add("light", lambda place: ramp.given(place, 2.0))
    posterior = bmc.infer(net, {"light": 12.0}, engine=bmc.LikelihoodWeighting(40_000), rng=0)
    # light = 2 x - 1/2: precision 4 / 4 beside the prior's 1
    mean, sd = posterior.mean("place"), posterior.std("place")
    np.testing.assert_allclose(mean, [(5.0 + 6.25) / 2, 5.0], atol=0.03)
    np.testing.assert_allclose(sd, [np.sqrt(0.5), 1.0], atol=0.03)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((np.zeros((0, 4)), 0.1), ShapeError, "at least one cell"),
        ((np.zeros((4, 4, 3)), 0.1), ShapeError, "not colour"),
        (([[0.0, np.nan]], 0.1), ParameterError, r"got nan at cell \(0, 1\)"),
        (([[0.0]], np.nan), ParameterError, "resolution must be positive"),
        (([[0.0]], 1.0, (np.inf, 0.0)), ParameterError, "origin must be two finite numbers"),
    ],
)
def test_bad_ceilings(arguments: tuple, error: type[Exception], message: str):
    with pytest.raises(error, match=message):
        Ceiling(*arguments)


def test_bad_places():
    ceiling = Ceiling(IMAGE, 0.5)
    with pytest.raises(ShapeError, match=r"places have shape \(1,\)"):
        ceiling.brightness([1.0])
    with pytest.raises(ParameterError, match="scale must be positive"):
        ceiling.given([1.0, 1.0], -1.0)


def test_nothing_is_shared():
    image = IMAGE.copy()
    ceiling = Ceiling(image, 0.5)
    image[:] = 0.0
    assert ceiling.image[3, 3] == IMAGE[3, 3]
    with pytest.raises(ValueError, match="read-only"):
        ceiling.image[0, 0] = 1.0
