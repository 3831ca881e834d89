"""Categorical: lazy gathers, shared rows, renormalisation, and states without mass."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import bayesmc.distributions as d
from bayesmc.errors import ParameterError
from tests.distributions.families import FEW


class LazyGather:
    """Rows of a table picked by an index, which refuses to be built."""

    def __init__(self, table: np.ndarray, rows: np.ndarray) -> None:
        self.table = table
        self.rows = rows
        self.shape = rows.shape + table.shape[1:]

    def __array__(self, dtype: object = None, copy: object = None) -> np.ndarray:
        raise AssertionError("the gather was materialised")


@FEW
@given(
    st.integers(1, 5), st.integers(1, 70), st.sampled_from([(), (7,), (3, 4)]), st.integers(0, 999)
)
def test_a_gather_answers_like_its_array(rows: int, size: int, batch: tuple, seed: int) -> None:
    rng = np.random.default_rng(seed)
    table = rng.dirichlet(np.full(size, 0.3), size=rows)
    table /= table.sum(axis=-1, keepdims=True)
    picked = rng.integers(rows, size=batch)
    lazy, plain = d.Categorical(LazyGather(table, picked)), d.Categorical(table[picked])
    assert lazy.batch_shape == plain.batch_shape == batch
    x = rng.integers(-1, size + 1, size=(2, *batch))
    np.testing.assert_allclose(lazy.log_prob(x), plain.log_prob(x), rtol=1e-13)
    np.testing.assert_allclose(lazy.log_prob(0), plain.log_prob(0), rtol=1e-13)
    np.testing.assert_array_equal(lazy.probs, plain.probs)
    np.testing.assert_allclose(lazy.mean, plain.mean)
    np.testing.assert_allclose(lazy.var, plain.var)
    # one uniform per draw against the same running sums, by whichever search
    np.testing.assert_array_equal(lazy.sample(seed, 50), plain.sample(seed, 50))
    q = rng.random(batch)
    np.testing.assert_array_equal(lazy.ppf(q), plain.ppf(q))
    np.testing.assert_allclose(lazy.cdf(x), plain.cdf(x))


def test_a_huge_gather_reads_only_the_entries_asked_for() -> None:
    # materialised, the gather would have 3e6 x 2000 entries, 45 GiB
    table = np.full((4, 2000), 1 / 2000)
    rows = np.random.default_rng(0).integers(4, size=3_000_000)
    dist = d.Categorical(LazyGather(table, rows))
    assert dist.log_prob(np.zeros(3_000_000, dtype=np.uint8)).shape == (3_000_000,)
    draws = dist.sample(1)
    assert draws.min() < 10
    assert draws.max() > 1990


def test_a_gather_is_faulty_only_where_a_faulty_row_is_used() -> None:
    table = np.array([[0.5, 0.5], [0.5, 0.6]])
    assert d.Categorical(LazyGather(table, np.zeros(3, int))).invalid is None
    with pytest.raises(ParameterError, match=r"sums to 1.1.*got \[0.5 0.6\] at index 2") as caught:
        d.Categorical(LazyGather(table, np.array([0, 0, 1, 1])))
    assert caught.value.index == (2,)
    with d.marking_invalid():
        dist = d.Categorical(LazyGather(table, np.array([0, 1])))
    assert dist.invalid.tolist() == [False, True]


def test_shared_rows_are_held_once() -> None:
    dist = d.Categorical(np.broadcast_to([0.2, 0.3, 0.5], (1000, 1000, 3)))
    assert dist.batch_shape == (1000, 1000)
    assert dist._table.shape == (1, 3)
    mixed = d.Categorical(np.broadcast_to(np.full((4, 1, 3), 1 / 3), (4, 1000, 3)))
    assert mixed._table.shape == (4, 3)
    assert mixed.probs.shape == (4, 1000, 3)
    assert mixed.sample(0).shape == (4, 1000)


@pytest.mark.parametrize("size", [2, 7, 40])
@pytest.mark.parametrize("form", ["one row", "rows", "gather", "logits"])
def test_states_without_mass_are_never_drawn(size: int, form: str) -> None:
    # Runs of zeros at the start, inside and at the end, with uniforms on and just beside every
    # running sum, where rounding decides, and the largest uniform there is.
    rng = np.random.default_rng(size)
    rows = rng.dirichlet(np.ones(size), size=200)
    rows[rng.random(rows.shape) < 0.6] = 0.0
    rows[rows.sum(axis=-1) == 0, 0] = 1.0
    rows /= rows.sum(axis=-1, keepdims=True)
    rows *= 1 - 3e-16 * rng.random((200, 1))  # sums that fall short of one by rounding

    class Edges(np.random.Generator):
        def random(self, size: tuple) -> np.ndarray:  # type: ignore[override]
            flat = np.empty(size)
            exact = np.cumsum(rows, axis=-1)
            pool = np.concatenate([exact.ravel(), np.nextafter(exact.ravel(), 0), [0.0]])
            pool = np.append(pool[pool < 1], 1 - 2.0**-53)
            flat[...] = rng.choice(pool, size=size)
            flat[..., 0] = 1 - 2.0**-53
            return flat

    generator = Edges(np.random.PCG64(0))
    if form == "one row":
        for row in rows[:40]:
            draws = d.Categorical(row).sample_to(generator, (500, 2))
            assert (row[draws] > 0).all()
        return
    with np.errstate(divide="ignore"):
        dist = {
            "rows": lambda: d.Categorical(rows[:, None]),
            "gather": lambda: d.Categorical(LazyGather(rows, np.arange(200)[:, None])),
            "logits": lambda: d.Categorical(logits=np.log(rows[:, None])),
        }[form]()
    draws = dist.sample_to(generator, (200, 500))
    assert (np.take_along_axis(rows, draws, axis=-1) > 0).all()
    assert draws.min() >= 0


@pytest.mark.parametrize("off", [1e-9, -9e-7, 9e-7])
def test_rows_off_by_rounding_are_renormalised(off: float) -> None:
    dist = d.Categorical([0.25, 0.75 + off])
    np.testing.assert_allclose(dist.probs.sum(), 1.0, rtol=1e-15)
    np.testing.assert_allclose(dist.log_prob(0), np.log(0.25 / (1 + off)), rtol=1e-14)


@pytest.mark.parametrize("off", [2e-6, -2e-6])
def test_rows_off_by_more_are_refused(off: float) -> None:
    with pytest.raises(ParameterError, match="this row sums to"):
        d.Categorical([0.25, 0.75 + off])


def test_probabilities_that_sum_to_one_are_kept_to_the_bit() -> None:
    probs = np.array([0.1] * 10)
    np.testing.assert_array_equal(d.Categorical(probs).log_prob(np.arange(10)), np.log(probs))


def test_one_state_is_certain() -> None:
    dist = d.Categorical(np.ones((3, 1)))
    assert (dist.sample(0, 20) == 0).all()
    assert (dist.log_prob(0) == 0).all()
    assert dist.support.size == 1
