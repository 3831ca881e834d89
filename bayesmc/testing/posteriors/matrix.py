"""An engine on random nets of every kind, against exact answers: the matrix that ours go through.

What one answer must be stands in ``matching``; where nets and exact answers come from, in ``makers`` and
``oracles``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from bayesmc.auto import infer
from bayesmc.engines.base import Engine
from bayesmc.errors import BudgetError, UnsupportedError, ZeroProbabilityError
from bayesmc.network import BayesNet
from bayesmc.randomness import seed_sequence
from bayesmc.testing.makers.gaussians import gaussian_evidence, random_gaussian_net
from bayesmc.testing.makers.nets import random_net
from bayesmc.testing.makers.observing import random_evidence
from bayesmc.testing.oracles.enumeration import enumerate_posterior
from bayesmc.testing.posteriors.matching import compare
from bayesmc.testing.verdict import NothingToCompare, Verdict, counted, uncounted

#: kinds of nets: options of ``random_net``, of "gaussian" those of ``random_gaussian_net``
KINDS: dict[str, dict[str, Any]] = {
    "discrete": {},
    "plates": {"plates": True},
    "hybrid": {"hybrid": True},
    "hybrid plates": {"hybrid": True, "plates": True},
    "gaussian": {"plates": True, "vectors": True},
}


@dataclass(frozen=True, eq=False, repr=False)
class EngineResult(Verdict):
    """What deviates on which nets.

    Attributes
    ----------
    answered : dict
        Kind of net -> how many the engine answered.
    refused : tuple of str
        Why it did not answer others.
    """

    answered: Mapping[str, int] = None  # type: ignore[assignment]
    refused: tuple[str, ...] = ()

    def _remarks(self) -> list[str]:
        told = ", ".join(f"{count} {kind}" for kind, count in self.answered.items())
        refused = [f"  refused: {why}" for why in dict.fromkeys(self.refused)]
        return [f"  nets answered: {told}", *refused[:5]]


def engine_test(
    engine: Any,
    *,
    kinds: Sequence[str] = tuple(KINDS),
    nets: int = 10,
    alpha: float = 1e-3,
    rng: Any = None,
) -> EngineResult:
    """Hold an engine against exact answers on random nets of every kind.

    What an engine refuses is not judged, but counted; an engine that answers nothing fails. Warnings of
    low effective sizes and of chains that do not converge are silent: what the draws do show must be right.

    **False-alarm rate.** At most ``alpha`` for a call (Holm's method over all figures of all nets), as exact
    as `compare` is for each.

    Parameters
    ----------
    engine : Engine or callable
        One of ours or your own; or ``engine(net, evidence, rng)``, which returns a posterior, or raises
        ``UnsupportedError``.
    kinds : sequence of str
        Some of "discrete", "plates", "hybrid", "hybrid plates", "gaussian".
    nets : int
        Of each kind.
    alpha : float
        Family-wise false-alarm rate.
    rng : seed, Generator or None

    Returns
    -------
    EngineResult
        True where nothing deviates.

    Raises
    ------
    ValueError
        A kind that there is not.

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.testing import engine_test
    >>> found = engine_test(bmc.LikelihoodWeighting(2000), kinds=["discrete"], nets=3, rng=0)
    >>> bool(found), found.answered
    (True, {'discrete': 3})

    One that forgets the evidence is seen:

    >>> def forgetful(net, evidence, rng):
    ...     return bmc.infer(net, {}, engine=bmc.Exact())
    >>> bool(engine_test(forgetful, kinds=["discrete"], nets=3, rng=0))
    False
    """
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown:
        raise ValueError(f"engine_test: no kind {unknown[0]!r}; there are {list(KINDS)}")
    ask = _asked(engine)
    comparisons, refused, skipped = [], [], 0
    answered = dict.fromkeys(kinds, 0)
    for number, seed in enumerate(seed_sequence(rng).spawn(len(kinds) * nets)):
        kind = kinds[number % len(kinds)]
        first, second = (int(s) for s in seed.generate_state(2))
        net, evidence, exact = matrix_case(kind, first)
        try:
            with warnings.catch_warnings(), uncounted():
                warnings.simplefilter("ignore")
                match = compare(ask(net, evidence, second), exact(evidence), alpha)
        except (UnsupportedError, BudgetError, ZeroProbabilityError) as error:
            refused.append(str(error))
            continue
        except NothingToCompare:  # all is observed, or what is not is known to one of them only
            answered[kind] += 1
            continue
        answered[kind] += 1
        skipped += match.skipped
        where = f"net {kind!r}, {first}: "
        comparisons += [replace(c, what=where + c.what) for c in match.comparisons]
    if not any(answered.values()):
        raise UnsupportedError(f"engine_test: it refuses every net, such as: {refused[0]}")
    return counted(
        EngineResult("engine_test", alpha, comparisons, skipped, answered, tuple(refused))
    )


def matrix_case(
    kind: str, seed: int
) -> tuple[BayesNet, dict[str, Any], Callable[[Mapping[str, Any] | None], Any]]:
    """A random net of a kind, evidence on it, and its exact answer given evidence."""
    if kind == "gaussian":
        net, plain = random_gaussian_net(seed, **KINDS[kind])
        return (
            net,
            gaussian_evidence(net, seed, chance=0.25),
            lambda seen: plain.posterior(seen or {}),
        )
    net = random_net(seed, **KINDS[kind])
    return net, random_evidence(net, seed), lambda seen: enumerate_posterior(net, seen or None)


# ---- private ------------------------------------------------------------------------------------


def _asked(engine: Any) -> Callable[[BayesNet, dict[str, Any], int], Any]:
    if isinstance(engine, Engine):
        return lambda net, evidence, seed: infer(net, evidence, engine=engine, rng=seed)
    if isinstance(engine, type) or not callable(engine):
        raise TypeError(
            f"engine_test: {engine!r} is no engine; give one, such as {_shown(engine)}(), or a function "
            "(net, evidence, rng)"
        )
    return engine


def _shown(engine: Any) -> str:
    return engine.__name__ if isinstance(engine, type) else "Exact"
