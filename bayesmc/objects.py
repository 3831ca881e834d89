"""``FrozenObject``: what a value of a node can be besides numbers, and which arrays are made of such values.

What the objects are is the user's affair; here it is only said that they never change, so that one may
stand in many places at once.
"""

from __future__ import annotations

from abc import ABC
from typing import Any

import numpy as np


class FrozenObject(ABC):  # noqa: B024 - a mark, which asks for no method
    """Base of values that are one object each and never change: a map, a tree, a history.

    A computed node of a ``DynamicBayesNet`` may return an array (dtype object) of instances, one for
    each particle; its functions receive such arrays. Particles that are resampled share the objects,
    so a class has to see to it that nobody can write into one: whoever changes it makes another.
    ``==`` says whether two are the same value. Classes that cannot inherit are registered,
    ``FrozenObject.register(Kind)``; sequences are not for it, NumPy takes them apart.

    Only ``ParticleFilter`` takes nodes of objects. They have no density, mean or variance;
    ``belief.particles(name)`` hands them out, and ``belief.expectation`` takes functions that make
    numbers of them.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> class Seen(bmc.FrozenObject):
    ...     def __init__(self, values):
    ...         self.values = frozenset(values)
    ...     def __eq__(self, other):
    ...         return isinstance(other, Seen) and self.values == other.values
    ...     __hash__ = None
    >>> grown = np.frompyfunc(lambda seen, x: Seen({*seen.values, float(x)}), 2, 1)
    >>> dbn = bmc.DynamicBayesNet()
    >>> dbn.add("x", lambda x_prev: bmc.Normal(x_prev, 1.0), initial=bmc.Normal(0.0, 1.0))
    >>> dbn.add("seen", lambda seen_prev, x: grown(seen_prev, x), initial=lambda x: grown(Seen(()), x))
    >>> dbn.add("y", lambda x: bmc.Normal(x, 0.5))
    >>> engine = bmc.ParticleFilter(100)
    >>> belief = engine.start(dbn, rng=0)
    >>> for y in (0.4, 0.9):
    ...     belief = engine.step(belief, {"y": y})
    >>> {len(seen.values) for seen in belief.particles("seen")}
    {2}
    """

    __slots__ = ()


def are_objects(array: Any) -> bool:
    """Whether an array is made of frozen objects, one or more."""
    if not isinstance(array, np.ndarray) or array.dtype != object or not array.size:
        return False
    return all(isinstance(value, FrozenObject) for value in array.flat)
