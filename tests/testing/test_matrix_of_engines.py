"""An engine of a user's on random nets: right ones pass, wrong ones do not, refusals are counted."""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc.errors import UnsupportedError
from bayesmc.testing import engine_test


@pytest.mark.parametrize("engine", [bmc.Exact(), bmc.LikelihoodWeighting(2000)])
def test_right_engines_pass(engine):
    found = engine_test(engine, nets=2, rng=3)
    assert found
    assert sum(found.answered.values()) >= 6 and "nets answered" in repr(found)


def test_refusals_are_counted_and_none_answered_fails():
    found = engine_test(bmc.Exact(), kinds=["hybrid"], nets=4, rng=0)
    assert found.answered["hybrid"] + len(found.refused) == 4 and found.refused

    def none(net, evidence, rng):
        raise UnsupportedError("never")

    with pytest.raises(UnsupportedError, match="refuses every net, such as: never"):
        engine_test(none, nets=1, rng=0)


def _forgetful(net, evidence, rng):
    return bmc.infer(net, {}, engine=bmc.Exact())


def _unweighted(net, evidence, rng):
    posterior = bmc.infer(net, evidence, engine=bmc.LikelihoodWeighting(2000), rng=rng)
    draws = {name: posterior[name][0] for name in posterior.names}
    assert all(np.shape(v)[0] == 2000 for v in draws.values())
    return draws


@pytest.mark.parametrize("engine", [_forgetful, _unweighted])
def test_wrong_engines_fail(engine):
    found = engine_test(engine, kinds=["discrete"], nets=5, rng=0)
    assert not found and "net 'discrete'" in repr(found)


def test_what_is_no_engine_is_refused():
    with pytest.raises(TypeError, match="is no engine"):
        engine_test(3)
    with pytest.raises(ValueError, match="no kind 'planar'"):
        engine_test(bmc.Exact(), kinds=["planar"])


def test_nets_that_leave_nothing_to_compare_are_no_fault():
    """Some nets are observed in all their nodes, and these weights come without their evidence."""

    def without_evidence(net, evidence, rng):
        return bmc.infer(net, evidence, engine=bmc.Gibbs(draws=100, warmup=50, chains=8), rng=rng)

    found = engine_test(without_evidence, kinds=["discrete"], nets=5, rng=2)
    assert found.answered == {"discrete": 5}


def test_a_class_is_no_engine():
    with pytest.raises(TypeError, match=r"such as LikelihoodWeighting\(\)"):
        engine_test(bmc.LikelihoodWeighting)
