"""The errors the contract promises, each by its type, its node and its remedy, in one table.

Faults of the array rules stand in test_validate.py, of evidence in test_evidence.py; here is the list a
newcomer meets first, read as a whole: every message names the node and says what to do.
"""

from __future__ import annotations

import numpy as np
import pytest

import bayesmc as bmc
from bayesmc import errors


def plain(**functions):
    net = bmc.BayesNet(plates={"k": 3, "p": 4})
    for name, function in functions.items():
        net.add(name, function)
    return net


def plated():
    net = bmc.BayesNet(plates={"k": 3, "p": 4})
    net.add("v", bmc.Normal(0.0, 1.0), plates="k")
    net.add("w", bmc.MvNormal(np.zeros(2), np.eye(2)), plates="k")
    return net


def cycle():
    plain(
        a=lambda c: bmc.Normal(c, 1), b=lambda a: bmc.Normal(a, 1), c=lambda b: bmc.Normal(b, 1)
    ).validate()


def unknown_parent():
    plain(height=lambda: bmc.Normal(0, 1), y=lambda heigth: bmc.Normal(heigth, 1)).validate()


def twice():
    net = plain(a=bmc.Normal(0, 1))
    net.add("a", bmc.Normal(0, 1))


def wrong_plate():
    plated().add("y", bmc.Normal(0, 1), plates="points")


def no_broadcast():
    plain(x=bmc.Normal(0, 1), y=lambda x: bmc.Normal(1.0 if x > 0 else 0.0, 1.0)).validate()


def mixes_plate():
    net = plated()
    net.add("y", lambda v: bmc.Normal(v - v.mean(axis=-1, keepdims=True), 1.0), plates="k")
    net.validate()


def negative_scale():
    net = plated()
    net.add("y", lambda: bmc.Normal(0.0, np.array([1.0, -2.0, 3.0])), plates="k")
    net.validate()


def bad_probabilities():
    net = plated()
    net.add(
        "y", lambda: bmc.Categorical(np.array([[0.5, 0.5], [0.5, 0.6], [1.0, 0.0]])), plates="k"
    )
    net.validate()


def bad_covariance():
    plain(y=lambda: bmc.MvNormal(np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]]))).validate()


def not_a_number():
    plain(y=lambda: bmc.Normal(np.nan, 1.0)).validate()


def infinite():
    plain(y=lambda: bmc.Exponential(np.inf)).validate()


def density_not_finite():
    net = plain(y=lambda: bmc.Density(lambda x: x * np.nan))
    net.log_prob({"y": 1.0})


def evidence_unknown():
    bmc.infer(plain(rain=bmc.Bernoulli(0.2)), {"rian": 1})


def evidence_deterministic():
    bmc.infer(plain(a=bmc.Bernoulli(0.2), d=lambda a: 2 * a), {"d": 2})


def evidence_outside():
    net = bmc.BayesNet()
    net.add("season", bmc.Categorical([0.5, 0.5]), states=("dry", "wet"))
    bmc.infer(net, {"season": "humid"})


def evidence_impossible():
    net = plain(a=bmc.Bernoulli(0.5), b=lambda a: bmc.Bernoulli(1.0 * a))
    bmc.infer(net, {"a": 0, "b": 1}, engine=bmc.Exact())


def open_plate():
    net = bmc.BayesNet(plates={"p": None})
    net.add("x", bmc.Normal(0, 1), plates="p")
    net.sample(1)


PROMISED = {
    cycle: (errors.CycleError, r"cycle: a -> b -> c -> a; a net must be acyclic"),
    unknown_parent: (
        errors.UnknownNodeError,
        r"'y' has the parent 'heigth'.*did you mean 'height'.*default.*parents=",
    ),
    twice: (
        errors.DuplicateNodeError,
        r"'a' is declared already; choose another name or pass replace=True",
    ),
    wrong_plate: (errors.PlateError, r"'y' is in plate 'points'.*declare BayesNet\(plates="),
    no_broadcast: (
        errors.BroadcastError,
        r"'y' works on one value at a time.*np\.where for if.*vectorize=True",
    ),
    mixes_plate: (errors.BroadcastError, r"'y'.*moves other elements.*unplated deterministic node"),
    negative_scale: (
        errors.ParameterError,
        r"'y' \(plate element 1\): Normal: scale must be positive and finite; got -2",
    ),
    bad_probabilities: (errors.ParameterError, r"'y' \(plate element 1\): .*sum to 1.*1\.1"),
    bad_covariance: (errors.ParameterError, r"'y': MvNormal: .*positive definite"),
    not_a_number: (errors.ParameterError, r"'y': Normal: loc must be finite; got nan"),
    infinite: (
        errors.ParameterError,
        r"'y': Exponential: rate must be positive and finite; got inf",
    ),
    density_not_finite: (
        errors.DensityError,
        r"'y': the log density of .* is nan; .*check the function",
    ),
    evidence_unknown: (
        errors.EvidenceError,
        r"evidence on 'rian', which the net does not have \(did you mean 'rain'\?\)",
    ),
    evidence_deterministic: (
        errors.EvidenceError,
        r"evidence on 'd', which is a deterministic node.*observe a stochastic node",
    ),
    evidence_outside: (
        errors.EvidenceError,
        r"'season'.*'humid' is not a state; the states are 'dry', 'wet'",
    ),
    evidence_impossible: (errors.ZeroProbabilityError, r"probability zero|zero probability"),
    open_plate: (
        errors.PlateError,
        r"size of plate 'p' is not known; observe a node in it, or declare plates=",
    ),
}


@pytest.mark.parametrize("fault", PROMISED, ids=lambda f: f.__name__)
def test_promised_errors(fault):
    kind, message = PROMISED[fault]
    with pytest.raises(kind, match=message) as caught:
        fault()
    assert isinstance(caught.value, errors.BayesmcError)
    assert isinstance(caught.value, ValueError)  # what a user would catch without reading the docs
    text = str(caught.value)
    assert len(text) < 500


UNGATHERED = {
    "as it stands": lambda v: bmc.Normal(v, 1.0),
    "arithmetic": lambda v: 2 * v + 1,
    "returned": lambda v: v,
    "if": lambda v: bmc.Normal(1.0 if v > 0 else 0.0, 1.0),
    "bool": lambda v: bmc.Normal(bool(v), 1.0),
    "float": lambda v: bmc.Normal(float(v), 1.0),
    "iteration": lambda v: bmc.Normal(sum(x for x in v), 1.0),
    "len": lambda v: bmc.Normal(len(v), 1.0),
    "np.sum": lambda v: bmc.Normal(np.sum(v), 1.0),
    "np.dot": lambda v: bmc.Normal(np.dot(v, v), 1.0),
    "logits": lambda v: bmc.Categorical(logits=v),
    "Dirichlet": lambda v: bmc.Dirichlet(np.exp(v)),
    "MvNormal": lambda v: bmc.MvNormal(v, np.eye(3)),
    "Mixture": lambda v: bmc.Mixture([0.2, 0.3, 0.5], bmc.Normal(v, 1.0)),
    "np.stack": lambda v: bmc.Normal(np.stack([v, v]).sum(), 1.0),
    "asarray": lambda v: bmc.Normal(np.asarray(v).sum(), 1.0),
}


@pytest.mark.parametrize("plates", [(), "p"], ids=["no plates", "in a plate"])
@pytest.mark.parametrize("function", UNGATHERED.values(), ids=UNGATHERED)
def test_an_ungathered_parent_names_node_plate_and_remedy(function, plates):
    net = plated()
    net.add("y", function, plates=plates)
    with pytest.raises(errors.ModelError, match=r"node 'y'.*'k'.*(v\[index\]|v\[i\]).*sum\('k'\)"):
        net.validate()


def test_matmul_on_a_foreign_parent_points_at_vecdot():
    net = plated()
    net.add("y", lambda w: bmc.Normal(np.ones(2) @ w, 1.0))
    with pytest.raises(
        errors.ModelError, match=r"node 'y'.*np\.vecdot\(X, v\) or np\.matvec\(A, v\)"
    ):
        net.validate()


def test_an_index_out_of_range_names_node_plate_and_positions():
    for bad in (-1, 3, np.array([0, 1, 2, 5])):
        net = plated()
        net.add("y", lambda v, bad=bad: bmc.Normal(v[bad], 1.0), plates="p")
        with pytest.raises(
            errors.ModelError, match=r"node 'y'.*outside plate 'k', whose positions are 0\.\.2"
        ):
            net.validate()


def test_errors_are_of_one_family_and_hold_their_facts():
    for kind in (
        errors.ModelError,
        errors.EvidenceError,
        errors.ParameterError,
        errors.DensityError,
    ):
        assert issubclass(kind, errors.BayesmcError) and issubclass(kind, ValueError)
    assert issubclass(errors.UnknownNodeError, KeyError)
    assert issubclass(errors.ZeroProbabilityError, errors.EvidenceError)
    assert issubclass(errors.BudgetError, errors.UnsupportedError)
    assert str(errors.UnknownNodeError("no 'quotes' added")) == "no 'quotes' added"
    assert errors.FileFormatError("bad", "net.bif", 7).args[0] == "net.bif:7: bad"
    assert issubclass(errors.LowEssWarning, UserWarning)
    extra = errors.missing_extra("matplotlib", "plot")
    assert isinstance(extra, ImportError) and "pip install 'bayesmc[plot]'" in str(extra)


def test_a_foreign_plate_among_constants_is_told_with_its_own_remedy() -> None:
    """The parent's name, and ``.array``; no advice to put a reduction into the plate that it reduces."""
    last = np.arange(5) == 4
    net = bmc.BayesNet(plates={"item": 5})
    net.add("free", bmc.Normal(0.0, 3.0), plates="item")
    net.add("total", lambda free: (free * np.where(last, 0.0, 1.0)).sum("item"))
    with pytest.raises(bmc.errors.PlateError, match=r"node 'total'.*use free\.array"):
        net.model()


def test_a_fault_that_one_value_has_too_is_told_once() -> None:
    net = bmc.BayesNet(plates={"item": 5})
    net.add("free", bmc.Normal(0.0, 3.0), plates="item")
    net.add("first", lambda free: np.asarray(free)[0])
    with pytest.raises(bmc.errors.PlateError, match="take free.array") as caught:
        net.model()
    cause = caught.value.__cause__
    assert caught.value.__context__ is cause and cause.__context__ is None
