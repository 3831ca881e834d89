"""Tracing: what a function does to some of its arguments, found by calling it once with stand-ins.

A ``Tracer`` behaves like the array it stands for and remembers what is still certain of it: whether it is
affine in the traced values, or an event of what is. Detection is sound
and incomplete: what no rule covers is unknown, and whatever would let a function look at the numbers (``if``,
``float``, iteration, ``out=``) raises. Coefficients of what is affine are not kept here: whoever needs them
calls the function itself. This room knows NumPy only, neither nodes nor distributions.
"""

from bayesmc.tracing.standin import TracedCall, is_traced
from bayesmc.tracing.tracer import Tracer

__all__ = ["TracedCall", "Tracer", "is_traced"]
