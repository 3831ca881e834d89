"""Hypothesis strategies for nets and evidence: the generator of ``nets``, driven by drawn integers.

Failing nets shrink towards few nodes, plain states, no parents and round numbers. Hypothesis is imported
when a strategy is asked for; it comes with the extra ``test``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bayesmc.errors import missing_extra
from bayesmc.network import BayesNet
from bayesmc.testing.choices import Choices
from bayesmc.testing.nets import NetOptions, build_net
from bayesmc.testing.observing import build_evidence

if TYPE_CHECKING:
    from hypothesis.strategies import SearchStrategy


def bayes_nets(**options: Any) -> SearchStrategy[BayesNet]:
    """A strategy for small random nets.

    Parameters
    ----------
    **options
        Fields of `NetOptions`, e.g. ``nodes=(1, 6)``, ``states=3``, ``hybrid=True``, ``plates=True``.

    Raises
    ------
    MissingExtraError
        If Hypothesis is not installed.

    Examples
    --------
    >>> from hypothesis import given, settings
    >>> from bayesmc.testing import bayes_nets
    >>> @settings(max_examples=5, database=None)
    ... @given(bayes_nets(nodes=(1, 3)))
    ... def test_every_net_is_valid(net):
    ...     net.validate()
    >>> test_every_net_is_valid()
    """
    given = NetOptions(**options)
    strategies = _strategies()

    @strategies.composite
    def nets(draw: Any) -> BayesNet:
        return build_net(_drawn(draw, strategies), given)

    return nets()


def evidence_for(net: BayesNet, chance: float = 0.4) -> SearchStrategy[dict[str, Any]]:
    """A strategy for possible evidence on a net: some nodes of one of its joint draws.

    Parameters
    ----------
    net : BayesNet
        Without potentials and inputs.
    chance : float
        Of a node to be seen; plated nodes may be seen in part.

    Examples
    --------
    >>> from hypothesis import given, settings
    >>> from bayesmc.testing import evidence_for, random_net
    >>> net = random_net(5)
    >>> @settings(max_examples=5, database=None)
    ... @given(evidence_for(net))
    ... def test_evidence_is_possible(evidence):
    ...     assert set(evidence) <= set(net)
    >>> test_evidence_is_possible()
    """
    strategies = _strategies()

    @strategies.composite
    def evidence(draw: Any) -> dict[str, Any]:
        return build_evidence(net, _drawn(draw, strategies), chance)

    return evidence()


def _drawn(draw: Any, strategies: Any) -> Choices:
    def group(make: Any) -> Any:
        part = strategies.composite(lambda inner: make(_drawn(inner, strategies)))
        return draw(part())

    return Choices(lambda low, high: draw(strategies.integers(low, high)), group)


def _strategies() -> Any:
    try:
        from hypothesis import strategies
    except ImportError:
        raise missing_extra("hypothesis", "test") from None
    return strategies
