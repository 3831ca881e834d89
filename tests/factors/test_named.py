"""Tables with named axes: elimination equals the whole product, whatever is summed, maximised or kept."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.special

from bayesmc.categorical import log_sum_exp
from bayesmc.factors.named import Named, connected, contract, largest, maximise, summed

SCOPES = ["ab", "bcd", "de", "ce", "f"]
SIZES = dict(zip("abcdef", (3, 4, 2, 3, 5, 2), strict=True))


def tables(lead=()):
    rng = np.random.default_rng(0)
    return [Named(tuple(s), rng.normal(size=[*lead, *(SIZES[x] for x in s)])) for s in SCOPES]


def product(terms):
    return sum(
        t.values.reshape(
            [*t.values.shape[: -len(t.scope)], *(SIZES[x] if x in t.scope else 1 for x in "abcdef")]
        )
        for t in terms
    )


def test_contraction_equals_einsum():
    terms = tables()
    arguments = [part for t in terms for part in (t.values, [ord(x) - 97 for x in t.scope])]
    whole = np.einsum(*arguments, [0, 4])
    np.testing.assert_allclose(contract(terms, ("a", "e")).values, whole)
    assert largest([t.scope for t in terms], ("a", "e"), SIZES) < np.prod(list(SIZES.values()))


def test_maxima_and_where_they_are():
    terms = tables()
    total = product(terms)
    best, choices = maximise(terms, ("a", "e"), SIZES)
    np.testing.assert_allclose(best, total.max(axis=(1, 2, 3, 5)))
    at = {"a": 1, "e": 2}
    for choice in reversed(choices):
        at.update(choice.look_up(at))
    assert total[tuple(at[x] for x in "abcdef")] == pytest.approx(best[1, 2])


@pytest.mark.parametrize("keep", ["ea", "", "f", "abcdef"])
def test_sums_of_logs_with_batch_axes(keep):
    """Batch axes of size one broadcast; the axes of the answer follow what is kept."""
    terms = tables((7, 2))
    terms[1] = Named(terms[1].scope, terms[1].values[:1, :1])
    gone = tuple(2 + k for k, x in enumerate("abcdef") if x not in keep)
    for reduce, whole in ((log_sum_exp, scipy.special.logsumexp), (np.max, np.max)):
        expected = whole(product(terms), axis=gone) if gone else product(terms)
        order = [sorted(keep).index(x) for x in keep]
        found = summed(terms, tuple(keep), SIZES, reduce)
        np.testing.assert_allclose(found, expected.transpose(0, 1, *(2 + k for k in order)))


def test_classes_that_no_scope_connects():
    assert connected("gabcdef", SCOPES) == [("g",), ("a", "b", "c", "d", "e"), ("f",)]
