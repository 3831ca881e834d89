"""What a test may ask of the run it is in: its seed, whether it is thorough, how many draws that makes.

Runs of pytest are steered by ``--bayesmc-seed N`` and ``--bayesmc-thorough`` (the plugin comes with bayesmc).
An ordinary run has the seed 0, so that it gives the same result every time; a thorough one draws a fresh
seed, prints it, and has more draws where tests call `scaled`, and only there. Module-level code of tests and
conftest files may ask already, and gets the same on all workers; without pytest, the environment variables
``BAYESMC_SEED`` and ``BAYESMC_THOROUGH`` say it. Inside a test the fixture ``rng`` is shorter: a generator of
the run's seed and the test's name.

Examples
--------
>>> from bayesmc.testing import session
>>> SEEDS = range(session.seed(), session.seed() + 20)
>>> DRAWS = session.scaled(1_000)  # 8000 in a thorough run
"""

from __future__ import annotations

import operator
import os


def seed() -> int:
    """Seed of the run: ``--bayesmc-seed``, else ``BAYESMC_SEED``, else 0 or, in a thorough run, a fresh one.

    Raises
    ------
    ValueError
        If ``BAYESMC_SEED`` is not a nonnegative whole number.
    """
    text = os.environ.get("BAYESMC_SEED") or "0"
    if not (text.isascii() and text.isdigit()):
        raise ValueError(
            f"environment variable BAYESMC_SEED: {text!r} is not a seed; give a nonnegative whole number"
        )
    return int(text)


def is_thorough() -> bool:
    """Whether the run is a thorough one: ``--bayesmc-thorough``, or ``BAYESMC_THOROUGH=1``."""
    return os.environ.get("BAYESMC_THOROUGH", "") not in ("", "0")


def scaled(count: int, times: int = 8) -> int:
    """Draws, replications or examples: ``count``, or ``times`` as many in a thorough run.

    Raises
    ------
    ValueError
        If one of the two is not a positive whole number.
    """
    for name, value in (("count", count), ("times", times)):
        if not _is_positive(value):
            raise ValueError(f"scaled({name}={value!r}): give a positive whole number")
    return count * times if is_thorough() else count


def _is_positive(value: object) -> bool:
    try:
        return operator.index(value) > 0  # type: ignore[arg-type]
    except TypeError:
        return False
