"""The examples run in smoke mode, and their nets say what the papers say."""

from __future__ import annotations

import functools
import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc import testing
from bayesmc.markov import MarkovChain
from examples import (
    bee_dance,
    bimodal_mixture,
    bioassay,
    central_limit,
    compare,
    data_faithful,
    demo,
    diagnosis,
    expectation_and_marginal,
    faithful_gibbs,
    ising_denoising,
    kernels_as_chains,
    markov_chains,
    mesquite,
    old_faithful,
    parzen,
    picture,
    pushforward,
    radar_target,
    rejection_and_importance,
    variational_mixture,
)

EXAMPLES = (*demo.NETS, *demo.FIGURES)
#: run twice: exact, sampled, filtered and swept ones that take little time; all of them in a thorough run
TWICE = EXAMPLES if testing.session.is_thorough() else (old_faithful, ising_denoising)

#: whose tables hold times
TIMED = (*demo.NETS, bee_dance, radar_target)


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same in fewer dots, which take most of the time; in a thorough run as they are."""
    if not testing.session.is_thorough():
        monkeypatch.setattr(picture, "DPI", 50)


@pytest.fixture(scope="module")
def tables() -> list[compare.Table]:
    return [table for example in demo.NETS for table in example.questions(200_000)]


def named(example: Any) -> str:
    return example.__name__.split(".")[1]


def global_generators() -> tuple[Any, str]:
    return random.getstate(), str(np.random.get_state())  # noqa: NPY002


@pytest.mark.parametrize("example", EXAMPLES, ids=named)
def test_examples_run(example: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Pictures are written where it is said, and the global generators are left as they were."""
    before = global_generators()
    example.main(["--fast", "--out", str(tmp_path)])
    assert before == global_generators()
    printed = capsys.readouterr().out
    if printed.startswith("skipped: "):
        pytest.skip(printed)
    maps = {path.with_suffix(".png") for path in tmp_path.glob("*.yaml")}  # as ROS has them
    assert all(path.exists() for path in maps)
    pictures = sorted(set(tmp_path.glob("*.png")) - maps)
    assert len(pictures) + len(maps) == len(set(tmp_path.iterdir()) - maps)
    assert (
        len(pictures) + len(maps) == printed.count("wrote ") >= (2 if example in demo.NETS else 1)
    )
    assert example in demo.NETS or tmp_path / f"{named(example)}.png" in pictures
    for path in pictures:
        content = path.read_bytes()
        assert content.startswith(b"\x89PNG") and len(content) > 7_000  # empty axes: 5,600
        assert f"wrote {path}" in printed
    if example in demo.NETS:
        tables = len(list(example.questions(1_000)))
        assert printed.count("Exact ") == tables
        for figure in ("Monte Carlo error", "ESS", "seconds"):
            assert printed.count(figure) >= tables


@pytest.mark.parametrize("example", TWICE, ids=named)
def test_examples_say_the_same_twice(
    example: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Once more after another example, whatever the global generators are at; all of them in a thorough run.

    Of some the pictures alone: their tables hold times, which differ.
    """
    once, again, other = tmp_path / "once", tmp_path / "again", tmp_path / "other"
    example.main(["--fast", "--out", str(once)])
    first = capsys.readouterr().out.replace(str(once), "")
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    rejection_and_importance.main(["--fast", "--out", str(other)])
    capsys.readouterr()
    example.main(["--fast", "--out", str(again)])
    second = capsys.readouterr().out.replace(str(again), "")
    assert example in TIMED or second == first
    for path in once.iterdir():
        assert path.read_bytes() == (again / path.name).read_bytes()


def test_the_demonstration_runs_all_of_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In their order, with the options that it was given."""
    ran: list[tuple[str, list[str]]] = []
    for example in EXAMPLES:
        record = functools.partial(
            lambda name, options: ran.append((name, options)), named(example)
        )
        monkeypatch.setattr(example, "main", record)
    demo.main(["--fast", "--out", "elsewhere"])
    demo.main([])
    names = [named(example) for example in EXAMPLES]
    assert ran == [
        *((name, ["--fast", "--out", "elsewhere"]) for name in names),
        *((name, ["--out", "out"]) for name in names),
    ]
    assert capsys.readouterr().out == "\n" * 2 * (len(names) - 1)


def test_demo_engines_agree(tables: list[compare.Table]) -> None:
    """Every sampled figure lies within 4.5 of its Monte Carlo errors of the exact one.

    The false-alarm rate of that is below 1e-3 for all figures together, at a fixed seed, where at
    least 100 draws count; the table with one effective draw is left out.
    """
    checked = 0
    for table in tables:
        exact = [row for row in table.rows if row.errors == compare.EXACT]
        for row in exact[1:]:
            assert row.answers == pytest.approx(exact[0].answers)
        for row in table.rows:
            if row.ess is not None and row.ess > 100:
                difference = np.abs(np.subtract(row.answers, exact[0].answers))
                assert np.all(difference < 4.5 * np.array(row.errors)), (table.question, row)
                checked += 1
    assert checked == 8


def test_demo_says_what_does_not_work(
    tables: list[compare.Table], capsys: pytest.CaptureFixture[str]
) -> None:
    assert [row.engine for table in tables for row in table.rows if row.refusal] == []
    squared = bmc.BayesNet()
    squared.add("x", bmc.Normal(0.0, 1.0))
    squared.add("y", lambda x: bmc.Normal(x**2, 1.0))
    refused = compare.infer(squared, {"y": 1.0}, bmc.Exact(), lambda posterior: [])
    compare.print_table(compare.Table("a square", ("x",), (refused,)))
    assert "'x'" in refused.refusal
    assert f"refuses: {refused.refusal}" in capsys.readouterr().out
    (warned,) = (table for table in tables if table.warned)
    assert min(row.ess for row in warned.rows if row.ess is not None) < 100


def test_chest_clinic_is_the_published_network(reference_data: Path) -> None:
    published = bmc.io.read(reference_data / "bn_discrete" / "bif" / "asia.bif.gz")
    names = {
        "asia": "asia", "tuberculosis": "tub", "smoking": "smoke", "cancer": "lung",
        "bronchitis": "bronc", "either": "either", "xray": "xray", "dyspnoea": "dysp",
    }  # fmt: skip
    net = diagnosis.chest_clinic()
    ours = bmc.infer(net, diagnosis.WITH_XRAY, engine=bmc.Exact())
    evidence = {names[name]: state for name, state in diagnosis.WITH_XRAY.items()}
    theirs = bmc.infer(published, evidence, engine=bmc.Exact())
    assert ours.log_marginal_likelihood == pytest.approx(theirs.log_marginal_likelihood)
    for name, other in names.items():
        # ours list no before yes, the file yes before no
        np.testing.assert_allclose(ours.probabilities(name), theirs.probabilities(other)[::-1])


def test_eruptions_are_the_published_table(reference_data: Path) -> None:
    table = np.genfromtxt(
        reference_data / "mixtures" / "faithful.csv", delimiter=",", skip_header=1
    )
    np.testing.assert_array_equal(np.array(data_faithful.ERUPTIONS), table[:, 1:])


def test_two_kinds_has_the_likelihood_of_the_published_fit() -> None:
    evidence = {"duration": old_faithful.DURATIONS, "waiting": old_faithful.WAITS}
    posterior = bmc.infer(old_faithful.two_kinds(), evidence, engine=bmc.Exact())
    assert posterior.log_marginal_likelihood == pytest.approx(old_faithful.LOG_LIKELIHOOD)


def test_closed_forms_hold_by_quadrature() -> None:
    """The comparisons that the demonstration prints are themselves held against sums on a grid."""
    net = old_faithful.two_kinds(1)
    grid = np.linspace(0.0, 8.0, 4001)
    density = np.stack([
        np.exp(net.log_prob({
            "kind": np.full((4001, 1), kind), "duration": grid[:, None],
            "waiting": np.full((4001, 1), 66.0),
        }))
        for kind in old_faithful.KINDS
    ])  # fmt: skip
    density /= density.sum()
    expected = density[1].sum(), density.sum(axis=0) @ grid
    assert old_faithful.kind_and_duration_given(66.0) == pytest.approx(expected)

    wait = old_faithful.typical_wait()
    waits = old_faithful.FIRST_LONG_WAITS
    grid = np.linspace(50.0, 110.0, 6001)
    joint = np.exp(
        wait.log_prob({"typical": grid, "wait": np.broadcast_to(waits, (6001, len(waits)))})
    )
    mass = joint / joint.sum()
    mean = mass @ grid
    sd = np.sqrt(mass @ (grid - mean) ** 2)
    log_p = np.log(joint.sum() * (grid[1] - grid[0]))
    assert old_faithful.typical_given(waits) == pytest.approx((mean, sd, log_p))


def test_every_example_is_run_by_the_demonstration_or_marked_as_a_helper() -> None:
    run = {example.__name__.split(".")[1] for example in (*demo.NETS, *demo.FIGURES)}
    for path in Path(demo.__file__).parent.glob("[!_]*.py"):
        marked = path.read_text("utf-8").startswith('"""A helper, not a script: ')
        assert marked != (path.stem in run | {"demo"}), path.name


def test_parzen_improves_with_samples_if_the_window_is_narrow() -> None:
    found = parzen.approximations()
    errors = {key: parzen.error(estimate) for key, estimate in found.items()}
    assert errors[20, 0.15] > 2 * errors[200, 0.15] > 4 * errors[2000, 0.15]
    assert errors[20, "silverman"] > errors[200, "silverman"] > errors[2000, "silverman"] > 0.1
    assert errors[2000, 1.5] > 0.9 * errors[20, 1.5]  # more samples do not mend a wide window
    assert parzen.error(parzen.TRUTH) == 0
    # the rule is for one Gaussian: with the spread of either peak it gives less than half the width
    n = len(parzen.SAMPLES)
    assert parzen.width(n, 0.15) == pytest.approx(0.15)
    rule = (4 / (3 * n)) ** 0.2
    assert parzen.width(n, "silverman") == pytest.approx(rule * parzen.SAMPLES.std(ddof=1))
    assert parzen.width(n, "silverman") > 2 * rule * 1.0
    assert np.trapezoid(parzen.TRUTH, parzen.GRID) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("terms", central_limit.TERMS)
def test_sums_of_uniforms_follow_irwin_and_hall(terms: int) -> None:
    """Kolmogorov-Smirnov at 1e-3; the Gaussian is told from up to four terms, as a control."""
    z = np.sort(central_limit.scaled_sum(terms).sample(100_000, rng=5)["z"])
    cdf = central_limit.exact(terms, z, terms)
    ranks = np.arange(1, len(z) + 1) / len(z)
    bound = 1.95 / np.sqrt(len(z))
    assert np.abs(cdf - ranks).max() < bound
    assert terms > 4 or np.abs(central_limit.GAUSSIAN.cdf(z) - ranks).max() > bound
    grid = np.linspace(-3, 3, 2001)
    slope = np.gradient(central_limit.exact(terms, grid, terms), grid)
    off = np.abs(slope - central_limit.exact(terms, grid, terms - 1))
    assert np.sort(off)[-5] < 1e-3  # but for the corners of the uniform and the triangle


def test_the_gap_to_the_gaussian_shrinks_like_one_over_n() -> None:
    assert [central_limit.gap(n) for n in central_limit.TERMS[:2]] == pytest.approx(
        [0.199, 0.031], abs=5e-4
    )
    # Edgeworth's first term at z = 0, where it is largest: excess kurtosis -1.2 / n, times 3 / 24
    for n in (8, 12):
        expected = 1.2 / n * 3 / 24 / np.sqrt(2 * np.pi)
        assert central_limit.gap(n) == pytest.approx(expected, rel=0.05)


def test_bearing_has_the_density_of_the_change_of_variables() -> None:
    """Kolmogorov-Smirnov at 1e-3; the linearised Gaussian fails it by far."""
    angle = np.sort(pushforward.net.sample(100_000, rng=5)["bearing"])
    ranks = np.arange(1, len(angle) + 1) / len(angle)
    density = pushforward.exact_density(pushforward.GRID)
    cdf = np.cumsum(density) * (pushforward.GRID[1] - pushforward.GRID[0])
    assert cdf[-1] == pytest.approx(1.0, abs=1e-6)
    bound = 1.95 / np.sqrt(len(angle))
    middle = pushforward.GRID + 0.5 * (pushforward.GRID[1] - pushforward.GRID[0])
    assert np.abs(np.interp(angle, middle, cdf) - ranks).max() < bound
    assert np.abs(pushforward.LINEARISED.cdf(angle) - ranks).max() > 20 * bound


def test_envelope_covers_the_target_and_its_moments_are_right() -> None:
    z = np.linspace(-30.0, 30.0, 60_001)
    density = np.exp(rejection_and_importance.target(z))
    cover = rejection_and_importance.K * np.exp(rejection_and_importance.PROPOSAL.log_prob(z))
    assert np.all(cover >= density) and (density / cover).max() > 0.95
    integral = np.trapezoid(density, z)
    assert pytest.approx(integral) == rejection_and_importance.INTEGRAL
    mean = np.trapezoid(z * density, z) / integral
    assert pytest.approx(mean) == rejection_and_importance.MEAN


def test_mean_distance_lies_in_its_band() -> None:
    """Within 4.5 standard errors of the sum on the grid (false alarms below 1e-5)."""
    banana = expectation_and_marginal
    assert np.trapezoid(banana.MARGINAL_Y, banana.Y) == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(
        banana.MARGINAL_X, np.exp(bmc.Normal(0.0, 1.0).log_prob(banana.X)), atol=1e-8
    )
    samples = banana.net.sample(200_000, rng=6)
    values = banana.distance(samples["x"], samples["y"])
    mean, error = banana.running_mean(values)
    assert abs(mean[-1] - banana.EXACT) < 4.5 * error[-1]
    assert abs(mean[-1] + 0.02 - banana.EXACT) > 4.5 * error[-1]  # such a slip would show
    assert mean[99] == pytest.approx(values[:100].mean())
    assert error[99] == pytest.approx(values[:100].std(ddof=1) / 10)


def test_markov_chains_are_what_the_figure_says_of_them() -> None:
    """Laws by hand; Metropolis keeps the law and is balanced; the bounds hold the mixing time."""
    three, balanced = markov_chains.THREE, markov_chains.BALANCED
    law = np.array([0.6, 1 / 0.9, 1.0])  # in terms of the third: 1 from 3 only, 3 from 2 only
    np.testing.assert_allclose(three.stationary, [law / law.sum()], rtol=1e-14)
    np.testing.assert_allclose(balanced.stationary, three.stationary, rtol=1e-13)
    assert balanced.is_reversible() and not three.is_reversible()
    np.testing.assert_array_equal(
        markov_chains.REDUCIBLE.stationary, [[0.5, 0.5, 0, 0], [0, 0, 0, 1]]
    )
    climber, hills = markov_chains.CLIMBER, markov_chains.HILLS
    np.testing.assert_allclose(climber.stationary, [hills / hills.sum()], rtol=1e-12)
    distances = markov_chains.distances(climber, markov_chains.STEPS)
    first = int(np.argmax(distances <= markov_chains.EPS))
    lower, upper = climber.mixing_time_bounds(markov_chains.EPS)
    assert lower <= climber.mixing_time(markov_chains.EPS) == first <= upper < markov_chains.STEPS


def test_random_walks_do_what_the_figure_says_of_them() -> None:
    """Acceptance within 5 errors of the exact rate, from the spread of chains (false alarms: 5e-3)."""
    crossed = {}
    for width in bimodal_mixture.WIDTHS:
        posterior = bimodal_mixture.explored(width, 2_000)
        rates = posterior.acceptance["x"]
        error = rates.std(ddof=1) / np.sqrt(len(rates))
        assert abs(rates.mean() - bimodal_mixture.acceptance(width)) < 5 * error
        shares = bimodal_mixture.right_hill(posterior)
        crossed[width] = ((shares > 0) & (shares < 1)).mean()
        assert (posterior.rhat("x") > 1.3) == (width < 500)
    assert crossed == {1: 0.0, 8: 0.0, 500: 1.0}
    density = np.exp(bimodal_mixture.TARGET.log_prob(bimodal_mixture.GRID))
    assert np.trapezoid(density, bimodal_mixture.GRID) == pytest.approx(1.0, abs=1e-9)
    assert bimodal_mixture.acceptance(1e-3) == pytest.approx(1.0, abs=1e-3)


def test_ising_graph_has_the_energy_of_the_formula() -> None:
    """The graph's log density beside sums over slices, for both kinds of noise."""
    rng = np.random.default_rng(1)
    x = rng.choice([-1, 1], size=(3, 4, 5))
    pairs = (x[:, 1:] * x[:, :-1]).sum(axis=(1, 2)) + (x[:, :, 1:] * x[:, :, :-1]).sum(axis=(1, 2))
    for noise, seen in ising_denoising.noisy(x[0], rng).items():
        pixels = (seen - x) ** 2 / (-2 * ising_denoising.SIGMA**2)
        if noise == "flips":
            odds = np.log((1 - ising_denoising.FLIPPED) / ising_denoising.FLIPPED)
            pixels = 0.5 * odds * x * seen
        expected = ising_denoising.J * pairs + pixels.sum(axis=(1, 2))
        graph = ising_denoising.ising(seen, noise)
        assert len(graph.factors) == 2
        np.testing.assert_allclose(graph.log_prob({"x": x}), expected)


@pytest.mark.parametrize("noise", ["Gaussian", "flips"])
def test_sweeps_clean_the_image(noise: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BAYESMC_DATA", raising=False)
    clean = ising_denoising.image()
    assert clean.shape == (82, 100) and set(np.unique(clean)) == {-1, 1}
    seen = ising_denoising.noisy(clean, np.random.default_rng(5))[noise]
    drawn = ising_denoising.sweeps(ising_denoising.ising(seen, noise))
    assert drawn.shape == (15, 82, 100) and drawn.mean(axis=0)[0].min() >= -1
    shown = ising_denoising.stages(seen, drawn).values()
    before, first, fifth, average = (ising_denoising.error(pixels, clean) for pixels in shown)
    assert before > first > 1.5 * fifth > 3 * average
    assert ising_denoising.error(clean, clean) == 0 and ising_denoising.error(-clean, clean) == 1


def test_horse_is_denoised_nearly_as_well_as_by_the_exact_mode(
    reference_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The published noisy image; its exact MAP has 1.9 % wrong pixels, a long average should not have many
    more."""
    monkeypatch.setenv("BAYESMC_DATA", str(reference_data))
    clean = ising_denoising.image()
    with np.load(reference_data / "ising" / "horse.dev.npz") as arrays:
        seen = arrays["noisy_small_p10"].astype(int)
    references = json.loads((reference_data / "ising" / "ising.dev.ref.json").read_text())
    reference = references["denoise"]["small_p10_J0.5"]
    assert reference["error_noisy"] == pytest.approx(ising_denoising.error(seen, clean))
    monkeypatch.setattr(ising_denoising, "FLIPPED", reference["p"])
    assert reference["J"] == ising_denoising.J
    drawn = ising_denoising.sweeps(ising_denoising.ising(seen, "flips"), 100)
    average = ising_denoising.error(drawn[20:].mean(axis=0), clean)
    assert average < 1.3 * reference["error_MAP"]


def test_mixture_of_waits_is_the_reference(reference_data: Path) -> None:
    """Means within 5 combined errors, spreads within 10 %, of a run of 64 chains (false alarms: 1e-5)."""
    text = (reference_data / "mixtures" / "mixtures.dev.ref.json").read_text()
    reference = json.loads(text)["faithful_waiting_bayes_K2"]
    priors = dict(zip(("m0", "s0", "a0", "b0"), (
        faithful_gibbs.WAIT_MEAN, faithful_gibbs.WAIT_SD, faithful_gibbs.SHAPE, faithful_gibbs.SCALE,
    ), strict=True))  # fmt: skip
    assert reference["priors"] == pytest.approx(priors)
    make, evidence = faithful_gibbs.MODELS[0]
    found = faithful_gibbs.answers(faithful_gibbs.learnt(make(), evidence, 1_500))
    names = {"share": "w", "mean wait": "mu", "sd of waits": "sigma"}
    for name, (mean, spread, error) in found.items():
        for k in (0, 1):
            expected = reference["summary"][f"{names[name]}[{k + 1}]"]
            assert abs(mean[k] - expected["mean"]) < 5 * np.hypot(error[k], expected["mcse"]), name
            assert spread[k] == pytest.approx(expected["sd"], rel=0.1)


@pytest.mark.parametrize("model", [1, 2], ids=["independent", "normal-inverse-wishart"])
def test_gaussian_mixtures_agree_with_a_sampler_by_hand(model: int) -> None:
    """Full conditionals of the textbook in plain NumPy; means within 5 combined errors (2e-3 in all)."""
    make, evidence = faithful_gibbs.MODELS[model]
    found = faithful_gibbs.answers(faithful_gibbs.learnt(make(), evidence, 400))
    draws = _mixture_by_hand(np.random.default_rng(2), joined=model == 2)
    for name, values in draws.items():
        mean, _, error = found[name]
        batches = values.reshape(20, -1, 2).mean(
            axis=1
        )  # of 50 draws, far longer than they remember
        theirs = batches.std(axis=0, ddof=1) / np.sqrt(20)
        assert np.all(np.abs(mean - values.mean(axis=0)) < 5 * np.hypot(error, theirs)), name


def test_every_parameter_of_the_mixtures_has_a_closed_form() -> None:
    for make, evidence in faithful_gibbs.MODELS:
        table = {row.node: row for row in bmc.explain(make(), evidence, bmc.Gibbs()).table}
        for name in table.keys() - evidence.keys() - {"label"}:
            assert table[name].kernel == "conjugate", table[name]
        assert table["label"].kernel == "enumerate"


def test_kernels_keep_the_posterior_as_the_figure_says() -> None:
    """Exact matrices: the law, balance of single updates, and a chain with two laws."""
    law = kernels_as_chains.posterior_law()
    net, wet = kernels_as_chains.wet_grass(), kernels_as_chains.WET
    for name, engine in kernels_as_chains.ENGINES.items():
        sweep = testing.exact_sweep(net, wet, engine())
        chain = MarkovChain(sweep.matrix)
        np.testing.assert_allclose(chain.stationary[0], law, rtol=0, atol=1e-12, err_msg=name)
        assert not chain.is_reversible() and len(sweep.updates) == 3
        for update in sweep.updates:
            assert MarkovChain(update.matrix).is_reversible(law, 1e-10)
        random = kernels_as_chains.in_random_order(sweep)
        lower, upper = random.mixing_time_bounds(kernels_as_chains.EPS)
        assert lower <= random.mixing_time(kernels_as_chains.EPS) <= upper
        counts = kernels_as_chains.simulated(engine, sweep, 50_000)
        assert counts.sum() == 50_000
        assert testing.transition_p_value(sweep.matrix, counts) > 1e-4  # at a fixed seed
    assert list(sweep.elements) == list(kernels_as_chains.HIDDEN)


def _mixture_by_hand(rng: np.random.Generator, joined: bool) -> dict[str, np.ndarray]:
    """1000 draws of the parameters of two clusters, ordered by their waits; joined: by cov / kappa."""
    from scipy.stats import invwishart

    kappa = faithful_gibbs.KAPPA if joined else 0.0
    y, centre = faithful_gibbs.TIMES, faithful_gibbs.CENTRE
    label = (y[:, 1] > 68).astype(int)
    mean = np.array([y[label == k].mean(axis=0) for k in (0, 1)])
    cov = np.stack([np.cov(y[label == k].T) for k in (0, 1)])
    found = []
    for _ in range(1_200):
        counts = np.bincount(label, minlength=2)
        weights = rng.dirichlet(1.0 + counts)
        log = np.empty((2, len(y)))
        for k in (0, 1):
            mine = y[label == k]
            scatter = faithful_gibbs.SCATTER + (mine - mean[k]).T @ (mine - mean[k])
            scatter = scatter + kappa * np.outer(mean[k] - centre, mean[k] - centre)
            df = faithful_gibbs.DF + counts[k] + joined
            cov[k] = invwishart.rvs(df, scatter, random_state=rng)
            prior = np.linalg.inv(cov[k] / kappa if joined else faithful_gibbs.SPREAD)
            each = np.linalg.inv(cov[k])
            spread = np.linalg.inv(prior + counts[k] * each)
            mean[k] = rng.multivariate_normal(
                spread @ (prior @ centre + each @ mine.sum(axis=0)), spread
            )
            off = y - mean[k]
            log[k] = np.log(weights[k]) - 0.5 * np.linalg.slogdet(cov[k])[1]
            log[k] -= 0.5 * np.einsum("ni,ij,nj->n", off, each, off)
        label = (rng.random(len(y)) < 1 / (1 + np.exp(log[0] - log[1]))).astype(int)
        correlation = cov[:, 0, 1] / np.sqrt(cov[:, 0, 0] * cov[:, 1, 1])
        row = [weights, mean[:, 1], np.sqrt(cov[:, 1, 1]), mean[:, 0], correlation]
        found.append(np.array(row)[:, np.argsort(mean[:, 1])])
    names = ("share", "mean wait", "sd of waits", "mean length", "correlation")
    return dict(zip(names, np.moveaxis(np.array(found[200:]), 1, 0), strict=True))


# ---- components that die out --------------------------------------------------------------------------


def test_variational_mixture_ends_with_two_components() -> None:
    """Whatever the number to begin with, and from every start that is drawn; Bishop (2006), fig. 10.6."""
    found = [variational_mixture.learnt(k, variational_mixture.SPARSE, restarts=3) for k in (2, 4)]
    assert [variational_mixture.alive(p) for p in found] == [2, 2]
    weights = np.sort(found[1].mean("weights"))[::-1]
    np.testing.assert_allclose(weights[:2], [0.6429, 0.3571], atol=1e-4)
    on_the_way = variational_mixture.learnt(
        6, variational_mixture.SPARSE, 1, 25, variational_mixture.SEED
    )
    assert 2 < variational_mixture.alive(on_the_way) < 6
    even = variational_mixture.learnt(3, variational_mixture.EVEN, restarts=3)
    assert variational_mixture.alive(even) == 3 and even.elbo < -436.0


def test_bioassay_is_that_of_the_book() -> None:
    """Mode and standard deviations of Gelman et al. (2013), sec. 4.1; the mean, which a grid has."""
    found = bioassay.ask("flat", 301, 500)
    np.testing.assert_allclose(found.laplace.mean("line"), [0.8, 7.7], atol=0.06)
    np.testing.assert_allclose(found.laplace.std("line"), [1.0, 4.9], atol=0.06)
    means, sds = found.exact.moments()
    assert (abs(found.laplace.mean("line") - means) > 0.4 * sds).all()
    check = found.check
    assert check.ok
    away = abs(check.posterior.mean("line") - means)
    assert (away < 4 * check.posterior.mcse("line")).all()
    error = check.log_marginal_likelihood - found.exact.log_evidence
    assert abs(error) < 4 * check.log_marginal_likelihood_mcse + 1e-3


def test_mesquite_ranks_as_posteriordb_and_the_book_have_it() -> None:
    """Means to 5 standard errors, a false alarm in 10^4 runs; leave-one-out against Student t densities."""
    posteriors = mesquite.fitted(500)
    for name, posterior in posteriors.items():
        beta, sigma = mesquite.REFERENCE[name].beta, mesquite.REFERENCE[name].sigma
        share = 5 * np.sqrt(1 + 2000 / 10_000)  # the reference has 10 chains of 1000
        assert (abs(posterior.mean("beta") - beta) < share * posterior.mcse("beta") + 5e-5).all()
        assert abs(posterior.mean("sigma") - sigma) < share * posterior.mcse("sigma") + 5e-5
    found = mesquite.assessed(posteriors)
    for name in mesquite.LOGS:
        assert found[name].elpd == pytest.approx(mesquite.exact_elpd(name).sum(), abs=0.25)
        assert found[name].elpd == pytest.approx(mesquite.REFERENCE[name].elpd, abs=0.25)
    for figures in (found, mesquite.assessed(posteriors, "waic")):
        table = bmc.compare({name: figures[name] for name in mesquite.LOGS})
        assert table.names[-1] == "volume" and set(table.names[:2]) == {
            "without stems",
            "volume, area",
        }
    pair = bmc.compare({name: found[name] for name in ("volume", "full")})
    assert pair["volume"]["elpd_diff"] == pytest.approx(mesquite.BOOK_DIFFERENCE, abs=0.4)
    assert pair["volume"]["dse"] == pytest.approx(mesquite.BOOK_ERROR, abs=0.2)
    with pytest.raises(bmc.errors.QueryError, match="other numbers were observed.*log_jacobian"):
        bmc.compare({name: found[name] for name in ("full", "weights")})
    table = mesquite.of_weights(posteriors)
    assert table.names[0] == "full" and table["weights"]["warning"]
    assert table["full"]["elpd"] == pytest.approx(mesquite.BOOK_OF_WEIGHTS, abs=0.5)
    assert mesquite.exact_elpd("weights").sum() < table["weights"]["elpd"] - 5  # as Pareto k warned
