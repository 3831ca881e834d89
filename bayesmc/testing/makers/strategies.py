"""Hypothesis strategies: the generators of this room, driven by drawn integers.

What fails shrinks towards few nodes, plain states, no parents and round numbers, and prints as the code that
declares it. Hypothesis is imported when a strategy is asked for; it comes with the extra ``test``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesmc.dbn import DynamicBayesNet
from bayesmc.distributions import Distribution
from bayesmc.errors import ModelError, missing_extra
from bayesmc.network import BayesNet, FactorGraph
from bayesmc.testing.makers.choices import Choices, read_options
from bayesmc.testing.makers.families import DistributionOptions, build_distribution
from bayesmc.testing.makers.graphs import GraphOptions, build_factor_graph
from bayesmc.testing.makers.nets import NetOptions, build_net
from bayesmc.testing.makers.observing import build_evidence
from bayesmc.testing.makers.spelling import as_code
from bayesmc.testing.makers.templates import DbnOptions, RandomDbn, build_dbn
from bayesmc.testing.makers.weights import WeightOptions, build_log_weights

if TYPE_CHECKING:
    from hypothesis.strategies import SearchStrategy


def bayes_nets(**options: Any) -> SearchStrategy[BayesNet]:
    """A strategy for small random nets.

    Parameters
    ----------
    **options
        Fields of `NetOptions`, e.g. ``nodes=(1, 6)``, ``states=3``, ``hybrid=True``, ``continuous=True``,
        ``plates=True``, ``coupling=2.0``.

    Raises
    ------
    MissingExtraError
        If Hypothesis is not installed.
    ValueError, TypeError
        An option that is out of range, or unknown.

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
    given = read_options("bayes_nets", NetOptions, options)
    return _strategy(lambda choices: build_net(choices, given))


def evidence_for(net: BayesNet, chance: float = 0.4) -> SearchStrategy[dict[str, Any]]:
    """A strategy for possible evidence on a net: some nodes of one of its joint draws.

    Parameters
    ----------
    net : BayesNet
        Without potentials and inputs.
    chance : float
        Of a node to be seen; plated nodes may be seen in part.

    Raises
    ------
    TypeError, ValueError
        No net, or no probability.

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
    if not isinstance(net, BayesNet):
        raise TypeError(f"evidence_for({net!r}): give a BayesNet, not {type(net).__name__}")
    if not isinstance(chance, (int, float, np.number)) or not 0.0 <= chance <= 1.0:
        raise ValueError(f"evidence_for(chance={chance!r}): give a probability")
    return _strategy(lambda choices: build_evidence(net, choices, chance))


def dbns(**options: Any) -> SearchStrategy[RandomDbn]:
    """A strategy for small templates over time with data: hidden nodes are finite, observed ones any.

    Parameters
    ----------
    **options
        Fields of `DbnOptions`: ``nodes=(1, 4)``, ``steps=(1, 6)``, ``zeros=True``.

    Returns
    -------
    strategy of RandomDbn
        With ``dbn``, ``steps``, ``observations`` and ``inputs``.

    Raises
    ------
    MissingExtraError
        If Hypothesis is not installed.
    ValueError, TypeError
        An option that is out of range, or unknown.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from hypothesis import given, settings
    >>> from bayesmc.testing import dbns
    >>> @settings(max_examples=5, database=None, deadline=None)
    ... @given(dbns(nodes=(1, 2), steps=(1, 3)))
    ... def test_the_unrolled_net_agrees(case):
    ...     found = bmc.filter(case.dbn, case.observations, inputs=case.inputs)
    ...     net = case.dbn.unroll(case.steps, case.inputs)
    ...     exact = bmc.infer(net, case.dbn.unrolled_evidence(case.observations), engine=bmc.Exact())
    ...     error = np.sum(found.log_marginal_likelihood) - exact.log_marginal_likelihood
    ...     assert abs(error) < 1e-8
    >>> test_the_unrolled_net_agrees()
    """
    given = read_options("dbns", DbnOptions, options)
    return _strategy(lambda choices: build_dbn(choices, given))


def factor_graphs(**options: Any) -> SearchStrategy[FactorGraph]:
    """A strategy for small factor graphs of positive, finite total.

    Parameters
    ----------
    **options
        Fields of `GraphOptions`, e.g. ``variables=(1, 4)``, ``states=3``, ``plates=True``,
        ``continuous=False``, ``zeros=True``, ``coupling=1.0``.

    Raises
    ------
    MissingExtraError
        If Hypothesis is not installed.
    ValueError, TypeError
        An option that is out of range, or unknown.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from hypothesis import given, settings
    >>> from bayesmc.testing import factor_graphs
    >>> @settings(max_examples=5, database=None)
    ... @given(factor_graphs(variables=(1, 3)))
    ... def test_every_graph_is_normalisable(graph):
    ...     posterior = bmc.infer(graph, engine=bmc.Exact())
    ...     assert np.isfinite(posterior.log_marginal_likelihood)
    >>> test_every_graph_is_normalisable()
    """
    given = read_options("factor_graphs", GraphOptions, options)
    return _strategy(lambda choices: build_factor_graph(choices, given))


def distributions(**options: Any) -> SearchStrategy[Distribution]:
    """A strategy for distributions of any family with valid parameters whose shapes broadcast.

    Parameters
    ----------
    **options
        Fields of `DistributionOptions`, e.g. ``kind="discrete"``, ``event_ndim=0``, ``extreme=True``,
        ``families=("Normal", "Gamma")``.

    Raises
    ------
    MissingExtraError
        If Hypothesis is not installed.
    ValueError, TypeError
        An option that is out of range, or unknown.

    Examples
    --------
    >>> import numpy as np
    >>> from hypothesis import given, settings
    >>> from bayesmc.testing import distributions
    >>> @settings(max_examples=5, database=None)
    ... @given(distributions(extreme=True))
    ... def test_draws_are_possible(dist):
    ...     draws = dist.sample(rng=0, sample_shape=4)
    ...     assert draws.shape == (4, *dist.batch_shape, *dist.event_shape)
    >>> test_draws_are_possible()
    """
    given = read_options("distributions", DistributionOptions, options)
    return _strategy(lambda choices: build_distribution(choices, given))


def log_weights(**options: Any) -> SearchStrategy[np.ndarray]:
    """A strategy for log weights: with ties, minus infinity and huge ranges, not normalised.

    Parameters
    ----------
    **options
        Fields of `WeightOptions`: ``size=(1, 32)`` or a number, ``ties``, ``zeros``, ``huge``,
        ``all_zero=False``.

    Returns
    -------
    strategy of ndarray, shape (size,)
        All minus infinity only with ``all_zero=True``.

    Raises
    ------
    MissingExtraError
        If Hypothesis is not installed.
    ValueError, TypeError
        An option that is out of range, or unknown.

    Examples
    --------
    >>> import numpy as np
    >>> from hypothesis import given, settings
    >>> from bayesmc.diagnostics import normalised
    >>> from bayesmc.testing import log_weights
    >>> @settings(max_examples=5, database=None)
    ... @given(log_weights())
    ... def test_they_normalise(log_w):
    ...     assert abs(normalised(log_w).sum() - 1.0) < 1e-12
    >>> test_they_normalise()
    """
    given = read_options("log_weights", WeightOptions, options)
    return _strategy(lambda choices: build_log_weights(choices, given))


# ---- private ------------------------------------------------------------------------------------


def _strategy(make: Callable[[Choices], Any]) -> Any:
    """A strategy for what ``make`` makes of choices."""
    try:
        from hypothesis import strategies
        from hypothesis.vendor import pretty
    except ImportError:
        raise missing_extra("hypothesis", "test") from None
    for kind in (BayesNet, DynamicBayesNet, FactorGraph, Distribution, RandomDbn):
        pretty.for_type_by_name(kind.__module__, kind.__name__, _print)

    @strategies.composite
    def made(draw: Any, make: Callable[[Choices], Any]) -> Any:
        def integer(low: int, high: int) -> int:
            return draw(strategies.integers(low, high))

        return make(Choices(integer, lambda part: draw(made(part)), zero_first=True))

    return made(make)


def _print(value: Any, printer: Any, cycle: bool) -> None:
    """How Hypothesis shows one of ours: as code, where it is known."""
    try:
        text = repr(value) if isinstance(value, RandomDbn) else as_code(value)
    except ModelError:
        text = repr(value)
    if (
        "\n" in text
    ):  # statements cannot stand behind an argument's name: they have lines of their own
        text = "\n" + "\n".join("        " + line for line in text.splitlines()) + "\n    "
    printer.text(text)
