"""What a slice of a template does to its particles, as expressions: values, log weights, and what must hold.

Random numbers are leaves of their own (standard normals, or uniform numbers), so that whatever evaluates the
expressions gets the same particles from a seed. A node whose density cannot be followed, or is drawn in
another way, is refused with the reason.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from bayesmc import distributions as d
from bayesmc.errors import TraceError
from bayesmc.expression import (
    Constant,
    Expression,
    Family,
    as_expression,
    elementwise,
    leaf,
    reduction,
)
from bayesmc.expression.functions import product
from bayesmc.expression.graph import substituted
from bayesmc.network import Model
from bayesmc.network.expressions import Opaque, density, log_density_of, value_of
from bayesmc.passes.arithmetic import ZERO, add
from bayesmc.passes.log_density import family_of
from bayesmc.passes.logarithms import log_of
from bayesmc.passes.ranges import TRUE, in_range

#: families of what is seen whose parameters are known to be right by ``in_range`` and these signs
_SEEN = (
    d.Normal, d.StudentT, d.Laplace, d.Cauchy, d.LogNormal, d.Poisson, d.Exponential, d.Gamma, d.InverseGamma,
    d.Weibull, d.Beta, d.Bernoulli, d.Geometric, d.NegativeBinomial, d.HalfNormal, d.HalfCauchy,
)  # fmt: skip
_POSITIVE = ("scale", "rate", "df", "concentration", "concentration0", "concentration1")
#: families whose log density is finite only where location and scale are
_TELLING = (d.Normal, d.MvNormal, d.StudentT, d.Laplace, d.Cauchy)
#: families that are drawn by a uniform number from [0, 1)
_UNIFORM = (d.Uniform, d.Laplace)


@dataclass(frozen=True)
class Drawn:
    """A hidden node as it is drawn.

    Attributes
    ----------
    name : str
    noise : str
        The leaf of its standard normals.
    shape : tuple of int
        Of these.
    value : Expression
    is_uniform : bool
        They are uniform numbers from [0, 1) instead.
    """

    name: str
    noise: str
    shape: tuple[int, ...]
    value: Expression
    is_uniform: bool = False

    def draw(self, rng: np.random.Generator, batch: tuple[int, ...]) -> np.ndarray:
        """Its random numbers, of a batch."""
        draw = rng.random if self.is_uniform else rng.standard_normal
        return np.asarray(draw((*batch, *self.shape)))


@dataclass(frozen=True)
class SliceDensities:
    """One kind of slice.

    Attributes
    ----------
    values : dict
        Node -> its value, of nodes that are asked for.
    log : Expression
        Log density of what is seen.
    good : Expression
        What must hold and does not show in these numbers.
    shows : Expression
        What holds where draws and the log density are finite.
    drawn : tuple of Drawn
        In the order in which the steps of a slice draw them.
    """

    values: dict[str, Expression]
    log: Expression
    good: Expression
    shows: Expression
    drawn: tuple[Drawn, ...]

    @property
    def flagged(self) -> Expression:
        """The log density, no number where something does not hold that must."""
        return elementwise(np.where, self.every, self.log, math.nan)

    @property
    def every(self) -> Expression:
        """All that must hold."""
        return _and(self.good, self.shows)


def read_slice(
    model: Model, dynamic: Collection[str], seen: Collection[str], kept: Collection[str]
) -> SliceDensities:
    """What is done in a slice in which some nodes are seen.

    Parameters
    ----------
    model : Model
        Of slice 0, or of later ones.
    dynamic : collection of str
        Nodes of a slice.
    seen, kept : collection of str
        Those that are seen, in full; those whose values are asked for.

    Raises
    ------
    TraceError
    """
    if any(model[n].plates for n in dynamic):
        raise TraceError("plates are drawn by plain steps")
    given: dict[str, Expression] = {}
    # what the slice before computed is known: as of slice 0, the model would have it follow otherwise
    cut = frozenset(n for n in model.nodes if n not in dynamic)
    log, good, shows, drawn = ZERO, TRUE, TRUE, []
    for name in (n for n in model.nodes if n in dynamic):
        node = model[name]
        if not node.is_stochastic:
            if name in kept:
                given[name] = substituted(value_of(model, name, cut), given)
                if node.domain is not None:
                    raise TraceError(f"node {name!r} is computed and finite")
            continue
        family = _family(model, name, given, cut)
        must, told = _in_range(name, family, name in seen)
        if name in seen:
            if family.make not in _SEEN and not _has_known_spread(family):
                raise TraceError(f"node {name!r} is seen through a family without machine code")
            each = substituted(log_density_of(model, name, cut), given)
            log = add(log, reduction(np.add, each, range(len(each.shape))))
        else:
            noise, shape = f"\0noise of {name}", (*node.plate_shape, *node.event_shape)
            given[name] = _draw(name, family, leaf(noise, shape))
            is_uniform = family.make in _UNIFORM
            drawn.append(Drawn(name, noise, shape, given[name], is_uniform))
            told = _and(told, _everywhere(elementwise(np.isfinite, given[name])))
        good, shows = _and(good, must), _and(shows, told)
    values = {n: given[n] for n in kept if n in given}
    return SliceDensities(values, log, good, shows, tuple(drawn))


# ---- private ------------------------------------------------------------------------------------


def _family(
    model: Model, name: str, given: Mapping[str, Expression], cut: frozenset[str]
) -> Family:
    """A node's family, its parameters by what is drawn before."""
    read = density(model, name, cut)
    if isinstance(read, Opaque):
        raise TraceError(f"node {name!r}: {read.reason}")
    family = read.result
    if not isinstance(family, Family):
        family = family_of(family)
    known = dict(given)
    parameters = {
        k: substituted(v, known) if isinstance(v, Expression) else v
        for k, v in family.parameters.items()
    }
    return Family(family.make, parameters)


def _has_known_spread(family: Family) -> bool:
    """Whether it is a multivariate normal whose covariance is known."""
    scales = [family.parameters.get(k) for k in ("cov", "scale_tril", "scale_diag")]
    known = all(s is None or isinstance(s, Constant) for s in scales)
    return family.make is d.MvNormal and known


def _draw(name: str, family: Family, noise: Expression) -> Expression:
    """A draw of a hidden node as its family makes it of standard normals, or of uniform numbers."""
    p = family.parameters
    if family.make is d.HalfNormal:
        return elementwise(np.multiply, elementwise(np.absolute, noise), p["scale"])
    if family.make is d.Uniform:
        width = elementwise(np.subtract, p["high"], p["low"])
        draw = elementwise(np.add, elementwise(np.multiply, noise, width), p["low"])
        return elementwise(np.minimum, draw, p["high"])
    if family.make is d.Laplace:
        return elementwise(np.add, elementwise(np.multiply, _laplace(noise), p["scale"]), p["loc"])
    if family.make in (d.Normal, d.LogNormal):
        draw = elementwise(np.add, elementwise(np.multiply, noise, p["scale"]), p["loc"])
        return draw if family.make is d.Normal else elementwise(np.exp, draw)
    if _has_known_spread(family):
        cov, tril, diag = (p.get(k) for k in ("cov", "scale_tril", "scale_diag"))
        if diag is not None:
            moved = elementwise(np.multiply, noise, diag)
        else:
            factor = np.linalg.cholesky(cov.value) if tril is None else tril.value  # type: ignore[union-attr]
            moved = product(np.matvec, as_expression(factor), noise)
        return elementwise(np.add, moved, p["loc"])
    raise TraceError(f"node {name!r} is drawn from a family without machine code")


def _laplace(u: Expression) -> Expression:
    """What NumPy makes of a uniform number; it draws another one in place of 0, which is infinite here."""
    twice = elementwise(np.add, u, u)
    upper = elementwise(np.negative, elementwise(np.log, elementwise(np.subtract, 2.0, twice)))
    above = elementwise(np.greater_equal, u, 0.5)
    return elementwise(np.where, above, upper, elementwise(np.log, twice))


def _in_range(name: str, family: Family, is_seen: bool) -> tuple[Expression, Expression]:
    """Whether all parameters are what the family takes, and of that what a finite number shows.

    Those that are known have been looked at.
    """
    good, shows = _everywhere(in_range(family)), TRUE
    telling = family.make in (_TELLING if is_seen else (d.Normal, d.MvNormal, d.Laplace))
    if family.make is d.Uniform:
        above = elementwise(np.greater, family.parameters["high"], family.parameters["low"])
        good = _and(good, _everywhere(above))
    for key, value in family.parameters.items():
        if value is None or isinstance(value, Constant):
            continue
        if not isinstance(value, Expression):
            raise TraceError(f"node {name!r} is made of other distributions")
        tells = telling and key in ("loc", "scale")
        # its logarithm may be taken past it: then it may overflow unseen, and is 0 by underflow alone
        past = is_seen and key in _POSITIVE and log_of(value) is not None
        if value.dtype.kind == "f":
            finite = _everywhere(elementwise(np.isfinite, value))
            if tells and not past:
                shows = _and(shows, finite)
            else:
                good = _and(good, finite)
        if key in _POSITIVE:
            positive = _everywhere(elementwise(np.greater, value, 0.0))
            if tells and past:
                shows = _and(shows, positive)
            else:
                good = _and(good, positive)
    return good, shows


def _and(a: Expression, b: Expression) -> Expression:
    if a is TRUE or b is TRUE:
        return b if a is TRUE else a
    return elementwise(np.logical_and, a, b)


def _everywhere(condition: Expression) -> Expression:
    return reduction(np.logical_and, condition, range(len(condition.shape)))
