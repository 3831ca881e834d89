"""Ctrl-C among several series: those that are done are kept, one that is cut short is none of them."""

import pytest

import bayesmc as bmc


def walk(stop_at: int) -> bmc.DynamicBayesNet:
    """A walk whose sensor breaks off, as Ctrl-C would, in the slice whose input says so."""
    dbn = bmc.DynamicBayesNet()
    dbn.input("row")
    dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))

    def sensor(x, row):
        if float(row) == stop_at:
            raise KeyboardInterrupt
        return bmc.Normal(float(x), 1.0)

    dbn.add("y", sensor, vectorize=True)
    return dbn


@pytest.mark.filterwarnings("ignore:ParticleFilter")
def test_a_series_that_is_cut_short_is_left_out() -> None:
    rows = [{"y": [0.1 * k] * 4} for k in range(3)]
    inputs = [{"row": [10.0 * k + t for t in range(4)]} for k in range(3)]
    engine = bmc.ParticleFilter(5)
    with pytest.warns(bmc.errors.InterruptWarning, match="1 of 3 series"):
        found = bmc.filter(walk(12), rows, inputs=inputs, engine=engine, rng=0)
    assert [None if one is None else one.steps for one in found] == [4, None, None]
    whole = bmc.filter(walk(-1), rows, inputs=inputs, engine=engine, rng=0)
    assert [one.steps for one in whole] == [4, 4, 4]
