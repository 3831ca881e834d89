"""The demonstration behind ``make demo``: all examples, one after the other.

Two nets are asked with every engine that can answer about them, then come the figures: of static models, of
models over time, of robots. Each script also runs by itself; pictures go to ``out/``. ``--fast`` takes few
draws.
"""

from __future__ import annotations

from collections.abc import Sequence

from examples import (
    banana,
    bee_dance,
    bimodal_mixture,
    bioassay,
    ceiling_robot,
    central_limit,
    clutter,
    colour_map,
    corridor_doors,
    coupled_chains,
    diagnosis,
    expectation_and_marginal,
    fading_channel,
    faithful_gibbs,
    gnp_trend_cycle,
    growth_benchmark,
    ising_denoising,
    islands_mpi,
    kernels_as_chains,
    kidnapped_robot,
    landmark_localization,
    laser_localization,
    markov_chains,
    mesquite,
    nile,
    old_faithful,
    parzen,
    pedestrians,
    picture,
    probit_regression,
    pushforward,
    radar_target,
    range_only,
    rejection_and_importance,
    slam_association,
    slam_grid,
    slam_landmarks,
    sonar_localization,
    stochastic_volatility,
    talking_head,
    three_views,
    trueskill,
    van_der_merwe,
    variational_mixture,
    weight_collapse,
)

NETS = (diagnosis, old_faithful)
FIGURES = (
    parzen, central_limit, pushforward, rejection_and_importance, expectation_and_marginal,
    markov_chains, bimodal_mixture, ising_denoising, faithful_gibbs, kernels_as_chains,
    weight_collapse, growth_benchmark, three_views, van_der_merwe, stochastic_volatility, nile,
    banana, bioassay, clutter, trueskill, probit_regression, corridor_doors, ceiling_robot,
    laser_localization, sonar_localization, kidnapped_robot, landmark_localization, range_only,
    slam_landmarks, slam_association, slam_grid,
    coupled_chains, radar_target, bee_dance, gnp_trend_cycle, variational_mixture,
    fading_channel, mesquite,
    colour_map, talking_head, pedestrians, islands_mpi,
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Run every example with the same options."""
    options = picture.options(__doc__, arguments)
    passed_on = [*(["--fast"] if options.fast else []), "--out", str(options.out)]
    for k, example in enumerate((*NETS, *FIGURES)):
        if k:
            print()
        example.main(passed_on)


if __name__ == "__main__":
    main()
