"""Conjugate nodes: draws from a full conditional in closed form.

A node is conjugate where its prior and the children that it enters are sums of features that one family has
(``conjugate_families``): the sums of their coefficients are the natural parameters, evaluated by one
program. Flat and truncated priors stay in closed form; where rounding leaves none (an interval far out in
a tail, a flat prior and too few data for a proper posterior) the elements concerned take a slice step
instead, which leaves the same distribution invariant.

References
----------
Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), ch. 2-3, 11.3; Plummer, JAGS user manual, 4.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from bayesmc.distributions import Distribution
from bayesmc.errors import DensityError, UnsupportedError
from bayesmc.kernels.base import Kernel, Memory, check_ratio
from bayesmc.kernels.conjugate_families import (
    Bounds,
    Form,
)
from bayesmc.kernels.conjugate_naturals import form_of
from bayesmc.kernels.slice import slice_move
from bayesmc.structure.blanket import Blanket
from bayesmc.structure.like_terms import with_like_children
from bayesmc.structure.programs import JointValues
from bayesmc.structure.target import Values


class Conjugate(Kernel):
    """Draws a node from its full conditional, a distribution of its prior's family.

    Parameters
    ----------
    blanket : Blanket
    forms : sequence of Form
        For each class of elements, the family and its natural parameters.
    debug : bool
        Check every draw against the model's densities.
    """

    label = "conjugate"

    def __init__(self, blanket: Blanket, forms: Sequence[Form], debug: bool = False) -> None:
        self.blanket, self.forms, self.debug = blanket, tuple(forms), debug
        self.names = (blanket.name,)
        self.match = forms[0].words

    def step(
        self, values: Values, memory: Memory, rng: np.random.Generator, warmup: bool
    ) -> tuple[Values, Memory]:
        blanket = self.blanket
        derived = self.forms[0].left(values)
        state = {**values, **derived} if derived else values
        for part, members in enumerate(blanket.classes):
            if part:  # what follows from the classes before
                blanket.target.refresh(state, self.names)
            try:
                new = self._moved(state, part, members, rng)
            except np.linalg.LinAlgError as error:
                raise self._degenerate(error) from error
            new = blanket.moved(state, new, members)
            if part + 1 < len(blanket.classes):
                state = {**state, blanket.name: new}
        return {blanket.name: new, **derived}, memory

    def full_conditional(self, values: Values, part: int = 0) -> Distribution:
        """The distribution of a class's elements given all others.

        Returns
        -------
        Distribution
            Batch broadcasts to ``(chains, *plates)``, or ``(chains, members)`` for a class of elements.
        """
        return self.forms[part].family.posterior(*self.forms[part](values))

    def reading(self, joints: Sequence[JointValues]) -> Conjugate:
        """The same kernel, with what others draw together read as one array."""
        forms = self.forms
        for joint in joints:
            forms = tuple(f.reading(joint) for f in forms)
        return self if forms is self.forms else Conjugate(self.blanket, forms, self.debug)

    # ---- private -------------------------------------------------------------------------------

    def _moved(
        self, values: Values, part: int, members: np.ndarray | None, rng: np.random.Generator
    ) -> np.ndarray:
        """New values of one class of elements."""
        if not self.debug:
            quick = self.forms[part].drawn(values, rng, len(values[self.blanket.name]))
            if quick is not None:
                return quick
        now = self.blanket.current(values, members)
        shape = now.shape[: now.ndim - len(self.blanket.event_shape)]
        naturals, bounds = self.forms[part](values)
        family = self.forms[part].family
        drawn = family.draw(naturals, bounds, rng, shape)
        if drawn is not None and not self.debug:
            return drawn
        posterior = family.posterior(naturals, bounds)
        if drawn is None:
            drawn = self._drawn(values, part, posterior, bounds, now, rng)
        if self.debug:
            self._check(values, members, posterior, now, drawn)
        return drawn

    def _drawn(
        self,
        values: Values,
        part: int,
        posterior: Distribution,
        bounds: Bounds | None,
        now: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        shape = now.shape[: now.ndim - len(self.blanket.event_shape)]
        new = posterior.sample_to(rng, shape)
        if posterior.invalid is None:
            return new
        if self.blanket.event_shape:
            raise self._degenerate(posterior.problem)
        lost = np.broadcast_to(posterior.invalid, shape)
        return np.where(lost, self._sliced(values, part, bounds, now, rng), new)

    def _degenerate(self, problem: Exception | None) -> DensityError:
        return DensityError(
            f"node {self.blanket.name!r}: its full conditional ({self.match}) is degenerate to rounding: "
            f"{problem}; rescale its children's coefficients, or give it a tighter prior"
        )

    def _sliced(
        self,
        values: Values,
        part: int,
        bounds: Bounds | None,
        now: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """One slice step of every element."""
        family, members = self.forms[part].family, self.blanket.classes[part]
        low, high = (-np.inf, np.inf) if bounds is None else bounds
        low, high = np.maximum(low, family.low), np.minimum(high, family.high)
        span = np.asarray(high) - np.asarray(low)
        width = np.where(np.isfinite(span), span, np.maximum(np.abs(now), 1e-3))

        def log_density(tried: np.ndarray) -> np.ndarray:
            return np.broadcast_to(self._density.log_density(values, tried, members), tried.shape)

        return slice_move(log_density, now, width, rng, low, high)

    @cached_property
    def _density(self) -> Blanket:  # what slice steps ask
        return with_like_children(self.blanket)

    # ---- verified conjugacy --------------------------------------------------------------------

    def _check(
        self,
        values: Values,
        members: np.ndarray | None,
        posterior: Distribution,
        now: np.ndarray,
        new: np.ndarray,
    ) -> None:
        """Refuse a draw that would not always be accepted as a proposal."""
        logs, sizes, proposal = [], [], []
        for value in (now, new):
            log, size = self._log_and_size(values, value, members)
            logs.append(log)
            q = posterior.log_prob(value)
            proposal.append(q)
            sizes.append(size + np.abs(q))
        # rounding puts a draw on the edge of the support, where neither density is a number
        fine = np.isfinite(proposal[0]) & np.isfinite(proposal[1])
        if posterior.invalid is not None:
            fine = fine & ~posterior.invalid
        ratios = [np.where(fine, b - a, 0.0) for a, b in (logs, proposal)]
        check_ratio(self.blanket.name, self.match, ratios[0], ratios[1], sizes[0] + sizes[1])

    def _log_and_size(
        self, values: Values, value: np.ndarray, members: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Log full conditional, and the sum of the sizes of all its terms."""
        blanket = self.blanket
        state = blanket.placed(values, value, members)
        total = blanket.own_log(state, members)
        size = np.abs(total)
        for child in blanket.children:
            log = child.term.log(state)
            collect = child.relation.collect
            total = total + collect(log, child.term.shape, members, state)
            size = size + collect(np.abs(log), child.term.shape, members, state)
        return total, size


def conjugate_kernel(blanket: Blanket, debug: bool = False) -> Conjugate | str:
    """The conjugate kernel of a node, or in words why there is none.

    Parameters
    ----------
    blanket : Blanket
    debug : bool
        Check every draw against the model's densities (slow).

    Examples
    --------
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.conjugate import conjugate_kernel
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet()
    >>> net.add("rate", bmc.Gamma(2.0, 1.0))
    >>> net.add("shape", bmc.Gamma(2.0, 1.0))
    >>> net.add("count", lambda rate: bmc.Poisson(10 * rate))
    >>> net.add("time", lambda shape: bmc.Gamma(shape, 1.0))
    >>> target = target_of(pose(net, {"count": 3, "time": 0.5}))
    >>> conjugate_kernel(Blanket(target, "rate")).match
    'Gamma with Poisson rate'
    >>> conjugate_kernel(Blanket(target, "shape"))
    "it enters the concentration of Gamma 'time'"
    """
    if blanket.own is None:
        return "it has no prior density of its own"
    if blanket.node.is_discrete or blanket.node.domain is not None:
        return "it is discrete"
    forms = []
    for members in blanket.classes:
        form = form_of(blanket, members)
        if isinstance(form, str):
            return form
        forms.append(form)
    return Conjugate(blanket, forms, debug)


def full_conditional(blanket: Blanket, values: Values, part: int = 0) -> Distribution:
    """The full conditional of a conjugate node in a state.

    Parameters
    ----------
    values : dict
        Stored values of all nodes, hidden ones ``(chains, *plates, *event)``.
    part : int
        Which of ``blanket.classes``.

    Returns
    -------
    Distribution
        Batch broadcasts to ``(chains, *plates)``, or to ``(chains, members)`` of a class of elements.

    Raises
    ------
    UnsupportedError
        The node is not conjugate; the message says why.

    Examples
    --------
    >>> import numpy as np
    >>> import bayesmc as bmc
    >>> from bayesmc.kernels.conjugate import full_conditional
    >>> from bayesmc.network import pose
    >>> from bayesmc.structure.blanket import Blanket
    >>> from bayesmc.structure.target import target_of
    >>> net = bmc.BayesNet(plates={"toss": 4})
    >>> net.add("p", bmc.Beta(1.0, 1.0))
    >>> net.add("heads", lambda p: bmc.Bernoulli(p), plates="toss")
    >>> target = target_of(pose(net, {"heads": [1, 0, 1, 1]}))
    >>> found = full_conditional(Blanket(target, "p"), {**target.known, "p": np.array([0.5])})
    >>> found.concentration1.tolist(), found.concentration0.tolist()
    ([4.0], [2.0])
    """
    kernel = conjugate_kernel(blanket)
    if isinstance(kernel, str):
        raise UnsupportedError(
            f"full_conditional: node {blanket.name!r} is not conjugate: {kernel}; evaluate "
            "blanket.log_density on a grid instead"
        )
    return kernel.full_conditional(values, part)
