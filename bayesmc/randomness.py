"""Random streams: the same seed gives the same result, however the work is cut.

Every unit of work draws from its own child of one ``SeedSequence``. What a user passes is never
spawned from, so a seed sequence can be used twice and give the same draws twice.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np


def seed_sequence(rng: Any = None) -> np.random.SeedSequence:
    """A private seed sequence from what SPEC 7 allows: a seed, a SeedSequence, a Generator or None.

    A ``Generator`` is drawn from (so the next call with it differs); a ``SeedSequence`` is copied.
    """
    if isinstance(rng, np.random.SeedSequence):
        return np.random.SeedSequence(
            rng.entropy, spawn_key=(*rng.spawn_key, 0xB1), pool_size=rng.pool_size
        )
    if isinstance(rng, (np.random.Generator, np.random.RandomState)):
        draw = rng.integers if isinstance(rng, np.random.Generator) else rng.randint
        return np.random.SeedSequence([int(n) for n in draw(0, 2**31 - 1, size=8)])
    if isinstance(rng, np.random.BitGenerator):
        return seed_sequence(np.random.Generator(rng))
    try:
        return np.random.SeedSequence(rng)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"rng={rng!r}: give a nonnegative whole number, a SeedSequence, a Generator or None"
        ) from error


class Purpose(IntEnum):
    """What a stream is for: the same seed never gives two kinds of work the same numbers."""

    INFER = 0
    SAMPLE = 1
    RESAMPLE = 2
    PREDICT = 3
    FILTER = 4
    SMOOTH = 5
    TEST = 6
    CHECK = 7


def stream(seed: np.random.SeedSequence, purpose: Purpose, unit: int = 0) -> np.random.Generator:
    """The generator of one unit of work of one kind (its chunk, its chain, ...).

    SFC64 is the fastest of NumPy's generators; its period does not depend on the key.
    """
    key = (int(purpose), unit)
    child = np.random.SeedSequence(
        seed.entropy, spawn_key=(*seed.spawn_key, *key), pool_size=seed.pool_size
    )
    return np.random.Generator(np.random.SFC64(child))


def child(seed: np.random.SeedSequence, unit: int) -> np.random.SeedSequence:
    """The seed of one of many questions that are asked together."""
    key = (*seed.spawn_key, _QUESTIONS, unit)
    return np.random.SeedSequence(seed.entropy, spawn_key=key, pool_size=seed.pool_size)


def parent(seed: np.random.SeedSequence) -> np.random.SeedSequence:
    """The seed that one made by ``child`` came from."""
    return np.random.SeedSequence(
        seed.entropy, spawn_key=seed.spawn_key[:-2], pool_size=seed.pool_size
    )


def resumed(state: Any) -> np.random.Generator:
    """A generator that goes on where another one of ``stream`` was; ``state`` is its bit generator's."""
    bits = np.random.SFC64(_ANY)
    bits.state = state
    return np.random.Generator(bits)


#: marks seeds of many questions: no purpose has this number
_QUESTIONS = 0xB2
#: of a generator whose state is overwritten
_ANY = np.random.SeedSequence(0)
