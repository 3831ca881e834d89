"""The examples about robots that move say what exact moments, densities and grids say.

That they run and write their pictures is held in ``test_examples``, for all examples.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

import bayesmc as bmc
from bayesmc import robotics
from examples import banana, ceiling_robot, corridor_doors

# ---- bananas --------------------------------------------------------------------------------------

FLOOR = 1e-4  # of the noise, as the two models of motion have it by default

NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(9)
WEIGHTS = np.prod(np.meshgrid(*[_WEIGHTS / _WEIGHTS.sum()] * 3), axis=0)
NOISE = np.meshgrid(*[NODES] * 3)


def steps(model: str, v: float, turn: float, alphas: np.ndarray) -> tuple[Any, Any, float]:
    """Displacement in the old frame and turn as complex numbers at nodes of the noise; isotropic variance."""
    e = NOISE
    if model == "the notes' steps":
        sd = np.asarray(alphas)
        return v + 0 * e[0], np.exp(1j * (turn + sd[2] * e[0])), 2 * sd[0] ** 2
    if model.startswith("velocities"):
        a = alphas
        length = v + e[0] * np.sqrt(a[0] * v**2 + a[1] * turn**2 + FLOOR**2)
        arc = turn + e[1] * np.sqrt(a[2] * v**2 + a[3] * turn**2 + FLOOR**2)
        last = e[2] * np.sqrt(a[4] * v**2 + a[5] * turn**2 + FLOOR**2)
        chord = length * np.sinc(arc / 2 / np.pi)
        return chord * np.exp(1j * arc / 2), np.exp(1j * (arc + last)), 0.0
    rotation, chord = turn / 2, v * np.sinc(turn / 2 / np.pi)
    sd = np.sqrt(alphas[0] * rotation**2 + alphas[1] * chord**2 + FLOOR**2)
    along = np.sqrt(alphas[2] * chord**2 + alphas[3] * 2 * rotation**2 + FLOOR**2)
    d = (chord + along * e[1]) * np.exp(1j * (rotation + sd * e[0]))
    return d, np.exp(1j * (turn + sd * (e[0] + e[2]))), 0.0


def moments(model: str, alphas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact mean and covariance of position in every slice, by recursion in complex numbers.

    With p the position, c = exp(i heading), d a displacement in the old frame and r = exp(i turn), a step is
    p + c d and c r; p and c of the past are independent of d and r, so products of two close under it.
    """
    s2 = banana.START**2
    p, pp, p2, pc, cp = 0j, 2 * s2, 0j, 0j, 0j  # E p, |p|^2, p^2, p conj(c), p c
    c, c2 = np.exp(-s2 / 2) + 0j, np.exp(-2 * s2) + 0j
    means, covs = [], []
    for k, (v, turn) in enumerate(banana.DRIVEN):
        if k:
            d, r, more = steps(model, v, turn, alphas)

            def mean(x: Any) -> Any:
                return (WEIGHTS * x).sum()

            pp = pp + 2 * (pc * np.conj(mean(d))).real + mean(np.abs(d) ** 2) + more
            p2 = p2 + 2 * cp * mean(d) + c2 * mean(d**2)
            pc = pc * np.conj(mean(r)) + mean(d * np.conj(r))
            cp = cp * mean(r) + c2 * mean(d * r)
            p, c, c2 = p + c * mean(d), c * mean(r), c2 * mean(r**2)
        whole, split = pp - abs(p) ** 2, p2 - p**2
        means.append([p.real, p.imag])
        x, y, xy = (whole + split.real) / 2, (whole - split.real) / 2, split.imag / 2
        covs.append([[x, xy], [xy, y]])
    return np.array(means), np.array(covs)


ALPHAS = dict(zip(banana.MODELS, (banana.NOISE, banana.VELOCITY, banana.ODOMETRY), strict=True))


def worst(cloud: np.ndarray, mean: np.ndarray, cov: np.ndarray) -> float:
    """The largest of five moments' deviations over the slices shown, in standard errors."""
    found = 0.0
    for t in banana.SHOWN:
        off = cloud[:, t, :2] - mean[t]
        x, y = off.T
        for values, right in (
            (x, 0.0), (y, 0.0), (x * x, cov[t, 0, 0]), (x * y, cov[t, 0, 1]), (y * y, cov[t, 1, 1]),
        ):  # fmt: skip
            error = values.std() / np.sqrt(len(values))
            found = max(found, abs(values.mean() - right) / error)
    return found


@pytest.fixture(scope="module")
def clouds() -> dict[str, np.ndarray]:
    return {name: banana.clouds(model()) for name, model in banana.MODELS.items()}


@pytest.mark.parametrize("model", banana.MODELS)
def test_clouds_have_the_exact_moments(model: str, clouds: dict[str, np.ndarray]) -> None:
    """Within 4.5 standard errors, 20 each (false alarms: 4e-4 in all); other noise is noticed."""
    assert worst(clouds[model], *moments(model, ALPHAS[model])) < 4.5
    other = ALPHAS[model] * np.where(np.arange(len(ALPHAS[model])) > 0, 1.15, 1.0)
    assert worst(clouds[model], *moments(model, other)) > 6


@pytest.mark.parametrize("model", banana.MODELS)
def test_bananas_are_no_ellipses(model: str, clouds: dict[str, np.ndarray]) -> None:
    """What is printed; and with a hundredth of the noise everything is as for a Gaussian."""
    dbn = banana.MODELS[model]()
    found = banana.figures(dbn, clouds[model])
    exact = moments(model, ALPHAS[model])[0][-1]
    assert found["mean of the cloud from start"] == pytest.approx(np.hypot(*exact), abs=0.2)
    assert found["mean of the cloud from start"] < found["EKF's end from start"] - 1.0
    assert found["inside of 95 %"] < 0.92 and found["bend"] > 0.35
    little = banana.MODELS[model](0.01)
    flat = banana.clouds(little)
    same = banana.figures(little, flat)
    draws = len(flat)
    assert abs(same["inside of 95 %"] - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / draws)
    assert same["bend"] < 4.5 * np.sqrt(2 / draws)
    assert same["cloud's mean to EKF's"] < 0.01


def test_the_path_is_the_drive_without_noise() -> None:
    """The EKF's means: exact arcs, and in the notes' model the same with steps along the old heading."""
    pose = np.zeros(3)
    for v, turn in banana.DRIVEN[1:]:
        pose = robotics.unicycle(pose, v, turn, 1.0)
    heading = np.cumsum(banana.DRIVEN[1:, 1]) - banana.DRIVEN[1:, 1]
    straight = np.array([np.cos(heading).sum(), np.sin(heading).sum()])
    end = {name: banana.predicted(model(0.01))[0][-1] for name, model in banana.MODELS.items()}
    np.testing.assert_allclose(end["the notes' steps"], straight, atol=1e-3)
    np.testing.assert_allclose(end["velocities, and an arc"], pose[:2], atol=1e-3)
    np.testing.assert_allclose(end["odometry"], pose[:2], atol=1e-3)


# ---- the ceiling ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def above() -> robotics.Ceiling:
    return ceiling_robot.ceiling()


def test_likelihood_images_are_the_density_of_the_reading(above: robotics.Ceiling) -> None:
    """At the centre of every cell, from the template's own sensor; another spread gives another picture."""
    nx, ny = above.image.shape
    assert (nx * above.resolution, ny * above.resolution) == pytest.approx((60.0, 40.0))
    at = np.stack(np.meshgrid(np.arange(nx) + 0.5, np.arange(ny) + 0.5, indexing="ij"), -1)
    places = at * above.resolution
    spread = ceiling_robot.SPREAD
    lit = {}
    for reading in (ceiling_robot.BRIGHT, ceiling_robot.EDGE, ceiling_robot.DARK):
        density = stats.norm.pdf(reading, above.brightness(places), spread)
        np.testing.assert_allclose(
            above.likelihood_image(reading, spread), density / density.max(), atol=1e-9
        )
        assert (
            np.abs(above.likelihood_image(reading, 2 * spread) - density / density.max()).max()
            > 0.1
        )
        lit[reading] = density / density.max() > 0.5
    shares = [mask.mean() for mask in lit.values()]
    assert shares[1] < shares[0] < 0.15 and shares[2] > 0.7  # rims, lights, and all the rest
    assert not (lit[ceiling_robot.BRIGHT] & lit[ceiling_robot.DARK]).any()


def test_the_template_weighs_poses_by_that_density(above: robotics.Ceiling) -> None:
    """The first slice: particles from the start, weighted by the brightness over each."""
    found: Any = bmc.filter(
        ceiling_robot.robot(above), {"z": [[0.9]]}, inputs={"u": ceiling_robot.DRIVEN[:1]},
        engine=bmc.ParticleFilter(500), rng=0, keep="particles",
    )  # fmt: skip
    x, y, _ = found.particles("pose")[0, :, 0].T
    # bilinear between the centres of cells, by another program
    from scipy.ndimage import map_coordinates

    bright = map_coordinates(above.image, [x / 0.1 - 0.5, y / 0.1 - 0.5], order=1, mode="nearest")
    density = stats.norm.pdf(0.9, bright, ceiling_robot.SPREAD)
    np.testing.assert_allclose(
        found.weights[0, :, 0], density / density.sum(), rtol=1e-6, atol=1e-12
    )
    assert found.log_marginal_likelihood[0] == pytest.approx(np.log(density.mean()))


def test_no_shift_carries_the_mosaic_onto_itself(above: robotics.Ceiling) -> None:
    """Autocorrelation beyond two metres; the control is a ceiling that repeats."""

    def most(image: np.ndarray) -> float:
        spectrum = np.abs(np.fft.rfft2(image - image.mean())) ** 2
        again = np.fft.irfft2(spectrum, s=image.shape)
        again /= again[0, 0]
        nx, ny = image.shape
        x, y = (np.minimum(np.arange(n), n - np.arange(n)) for n in (nx, ny))
        return float(again[np.hypot(x[:, None], y) > 25].max())

    assert most(above.image) < 0.6
    assert most(np.tile(above.image[:300, :200], (2, 2))) > 0.95


@pytest.mark.filterwarnings("ignore::bayesmc.errors.LowEssWarning")
def test_the_sensor_holds_the_robot_on_the_map_and_a_wrong_map_does_not(
    above: robotics.Ceiling,
) -> None:
    """Twenty drives, paired: the gain is 3 standard errors or more (no gain would pass in 4e-3).

    With 1,000 and 2,000 particles and four seeds both came to between 2.4 and 7.8 standard errors.
    """
    runs, particles = 20, 600
    found = ceiling_robot.errors(above, runs, particles)
    drives = {name: np.sqrt((off**2).mean(axis=0)) for name, off in found.items()}
    gain = drives["motion alone"] - drives["with the sensor"]
    assert gain.mean() > 3 * gain.std(ddof=1) / np.sqrt(runs)
    # the fault: particles that are weighed by a ceiling of another seed
    truth, z = ceiling_robot.simulated(ceiling_robot.robot(above, runs))
    wrong = ceiling_robot.robot(ceiling_robot.ceiling(seed=6), runs)
    lost = bmc.filter(
        wrong, {"z": z}, inputs={"u": ceiling_robot.DRIVEN},
        engine=bmc.ParticleFilter(particles), rng=2,
    )  # fmt: skip
    off = robotics.pose_errors(lost.mean("pose"), truth)[0]
    worse = np.sqrt((off**2).mean(axis=0)) - drives["with the sensor"]
    assert worse.mean() > 3 * worse.std(ddof=1) / np.sqrt(runs)


# ---- the corridor ---------------------------------------------------------------------------------

RUNS, PARTICLES = 60, 2_000


@pytest.fixture(scope="module")
def grid() -> Any:
    return corridor_doors.exact()


def test_the_grid_has_the_belief_of_the_first_door(grid: Any) -> None:
    """A uniform blurred by the first metre, times the sensor: in closed form."""
    points, density = grid.grid("x"), grid.density("x")[1, 0]
    blur = np.hypot(0.05, 0.1)
    before = stats.norm.cdf((points - 1) / blur) - stats.norm.cdf((points - 17) / blur)
    after = before * corridor_doors.door_seen(points)
    width = points[1] - points[0]
    np.testing.assert_allclose(density, after / (after.sum() * width), atol=1e-4)
    # the average over sixteen metres, of which a door takes up sqrt(2 pi) widths
    seen = 0.1 + 0.8 * 3 * np.sqrt(2 * np.pi) * corridor_doors.WIDTH / 16
    assert np.exp(grid.log_marginal_increments[1]) == pytest.approx(seen, rel=1e-3)


def test_three_hills_become_one(grid: Any) -> None:
    """What the panels show: as much at each door, then more than half at one, then nearly all at the last."""
    points, density = grid.grid("x"), grid.density("x")[:, 0]

    def near(t: int, *places: float) -> list[float]:
        mass = density[t] * (points[1] - points[0])
        return [float(mass[np.abs(points - place) < 1.2].sum()) for place in places]

    first, second, third = near(1, *corridor_doors.DOORS)
    assert first == pytest.approx(second, rel=0.01) and second == pytest.approx(third, rel=0.01)
    assert 0.2 < first < 1 / 3
    assert near(3, 6.0)[0] > 0.6 > 5 * near(3, 12.0)[0]
    assert near(5, 12.0)[0] > 0.85
    assert abs(points[density[5].argmax()] - corridor_doors.TRUTH[5]) < 0.1


def test_the_grid_is_fine_enough(grid: Any) -> None:
    finer = corridor_doors.exact(cells=2 * corridor_doors.CELLS)
    np.testing.assert_allclose(grid.mean("x"), finer.mean("x"), atol=1e-4)
    assert grid.log_marginal_likelihood == pytest.approx(finer.log_marginal_likelihood, abs=1e-5)


def furthest(shares: np.ndarray, right: np.ndarray) -> float:
    """The largest deviation of the mean share of a bin, in standard errors between runs."""
    error = shares.std(axis=-1, ddof=1) / np.sqrt(shares.shape[-1])
    off = np.abs(shares.mean(axis=-1) - right)
    return float((off / np.maximum(error, 1e-12))[right > 0.005].max())


def test_particles_have_the_exact_belief_and_a_wrong_map_of_doors_does_not(grid: Any) -> None:
    """Some 130 bins within 5.5 errors of 60 runs (Student t: 2e-4 false alarms in all)."""
    right = corridor_doors.grid_shares(grid)
    np.testing.assert_allclose(right.sum(axis=1), 1.0, atol=1e-5)
    assert 80 < (right > 0.005).sum() < 200
    belief = corridor_doors.by_particles(PARTICLES, RUNS)
    shares = corridor_doors.particle_shares(belief)
    assert furthest(shares, right) < 5.5
    factor = np.exp(belief.log_marginal_likelihood - grid.log_marginal_likelihood)
    assert abs(factor.mean() - 1) < 4.5 * factor.std(ddof=1) / np.sqrt(RUNS)
    # the fault: the middle door is a metre further on
    moved = corridor_doors.by_particles(PARTICLES, RUNS, doors=(3.0, 7.0, 12.0))
    wrong = corridor_doors.particle_shares(moved)
    assert furthest(wrong, right) > 50
    assert corridor_doors.distances(wrong, right)[3].min() > 0.3
    evidence = moved.log_marginal_likelihood.mean() - grid.log_marginal_likelihood
    assert evidence < -0.5


def test_the_distance_falls_with_the_root_of_the_number(grid: Any) -> None:
    """A hundredfold makes a tenth, and slice 0 is as far as independent draws are (six errors each)."""
    right = corridor_doors.grid_shares(grid)
    few, many = (
        corridor_doors.distances(
            corridor_doors.particle_shares(corridor_doors.by_particles(n, 30)), right
        )
        for n in (100, 10_000)
    )
    np.testing.assert_allclose(few.mean(axis=1) / many.mean(axis=1), 10, rtol=0.25)
    draws = corridor_doors.of_independent(right, 100)[0]
    assert abs(few[0].mean() - draws) < 6 * few[0].std(ddof=1) / np.sqrt(30)
